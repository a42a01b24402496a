// rigd/personality.h - what a family of bodies calls its settings: config/cameras/*.conf.
//
// People write neutral names and values (shutter = 1/125, imageformat = raw); a personality translates them into the names and
// choices of the driver, which differ by vendor, by model, and by where the dials stand. The file:
//
//   [body]                            what is asked of any body; each the driver's names, first that the body has counts
//   serial = eosserialnumber | serialnumber
//   [imageformat]                     a setting; sections stand in the order in which settings are written
//   driver = imageformat              the driver's names, first that the body has counts
//   kind = text                       text (the default), number (f/8 is 8, 1.60 is 1.6), seconds (1/125 is 0.0080s)
//   raw = RAW | cRAW                  a neutral value and the driver's choices for it, first that the body offers counts
//   objects.raw+jpeg = 2              objects that one shot makes with that value
//
// A setting or value that the file does not name is the driver's own word. NULL is a personality that names nothing.
// Names and values are compared without case, and never with a driver's labels: those are translated and cut.
#pragma once
#include <stdbool.h>
#include <stddef.h>

struct personality;

enum { PERSONALITY_NAME = 48 }; // room for a driver's name or value

// 0, -errno of the open, -EFBIG, -EINVAL (logged: file, line, found, expected).
int personality_read(struct personality **out, const char *path);
int personality_parse(struct personality **out, const char *text, size_t n_bytes, const char *name);
void personality_free(struct personality *p);

// The driver's i-th name for a setting, or for something of [body]. false: there are no more.
bool personality_setting_name(const struct personality *p, const char *setting, int i, char out[PERSONALITY_NAME]);
bool personality_body_name(const struct personality *p, const char *what, int i, char out[PERSONALITY_NAME]);
int personality_n_settings(const struct personality *p);
const char *personality_setting(const struct personality *p, int i); // neutral name, in the order of writing
int personality_order(const struct personality *p, const char *setting); // its i; unnamed settings come last

// Which of the driver's choices means `wanted`? -1: none. n_choices 0 (a free text): out is what to write then.
int personality_choose(const struct personality *p, const char *setting, const char *wanted, const char *const *choice, int n_choices);
void personality_driver_value(const struct personality *p, const char *setting, const char *wanted, char out[PERSONALITY_NAME]);
// Does what the driver says mean `wanted`?
bool personality_means(const struct personality *p, const char *setting, const char *wanted, const char *found);
// Neutral name of what the driver says, else its own word.
void personality_neutral(const struct personality *p, const char *setting, const char *found, char *out, size_t room);
int personality_objects(const struct personality *p, const char *setting, const char *found); // per shot; -1: not said
