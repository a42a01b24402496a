// rigd/camera_gphoto.h - one camera, through libgphoto2; camera_worker.c's hands.
//
// Every call fills the answer it is given (zeroed by the caller): what its command promises in camera.h, or trouble, err and
// text. It returns 0, or a negative number with these three set. Calls end at the deadline as far as the driver lets them;
// `gone` is asked in between and may end the process.
#pragma once
#include "rigd/camera.h"
#include "rigd/personality.h"

struct gphoto;

// In-memory settings for the driver, its language, limits of the process. Once, before anything else. 0 or -ENOMEM.
int gphoto_create(struct gphoto **out, void (*gone)(void *arg), void *arg);
void gphoto_free(struct gphoto *g);
void gphoto_deadline(struct gphoto *g, int64_t at_ns); // of what follows
void gphoto_rest(struct gphoto *g); // nothing is to be done: give memory back

// personality stays the caller's until the next gphoto_open() or gphoto_free().
int gphoto_open(struct gphoto *g, const struct camera_command *c, const struct personality *personality, struct camera_event *e);
void gphoto_close(struct gphoto *g);
bool gphoto_is_open(const struct gphoto *g);

int gphoto_configure(struct gphoto *g, const struct camera_command *c, struct camera_event *e);
int gphoto_status(struct gphoto *g, struct camera_event *e);
int gphoto_trigger(struct gphoto *g, struct camera_event *e);
int gphoto_list(struct gphoto *g, const struct camera_command *c, struct camera_event *e);
int gphoto_delete(struct gphoto *g, const struct camera_object *o, struct camera_event *e);
int gphoto_identify(struct gphoto *g, struct camera_event *e);

// Wait for one event, at most until until_ns (and the deadline). 1: an object, in e->object[0] and e->at_ns; 2: another event;
// 0: none came; < 0: trouble.
enum { GPHOTO_NOTHING, GPHOTO_OBJECT, GPHOTO_OTHER };
int gphoto_wait(struct gphoto *g, int64_t until_ns, struct camera_event *e);

// The object's bytes (or its preview's) in order. sink returns 0, or -errno to end it: then gphoto_read returns that and
// leaves e alone. e->size_bytes is what the camera announces (0 for a preview); fewer or more bytes are trouble: corrupt.
typedef int gphoto_sink(void *arg, const void *bytes, size_t n);
int gphoto_read(struct gphoto *g, const struct camera_object *o, bool preview, gphoto_sink *sink, void *arg, struct camera_event *e);

// For the caller's own findings: trouble, err, text ("what: remedy").
int gphoto_fail(struct camera_event *e, enum camera_trouble trouble, int err, const char *format, ...)
    __attribute__((format(printf, 4, 5)));
