// tests/rigsim/personality.h - what kind of camera: names, operations, properties, lag, sensor. Data, read from text.
//
// A text has one statement per line; '#' begins a comment:
//   base = generic | nikon | canon        first line, optional: begin with a built-in personality and change what follows
//   KEY = VALUE                           the fields of struct personality below, by name
//   operations = 0x1001 0x1002 ...        replaces the list; so do events, capture_formats, object_formats, formats
//   formats = 4:raw 7:raw+jpeg 0:jpeg     which value of the property with role `format` takes which files
//   property CODE TYPE ACCESS ROLE FORM [= VALUE]     replaces the property of that code, or adds one
//     TYPE i8 u8 i16 u16 i32 u32 i64 u64 str; ACCESS ro rw;
//     ROLE none, or what the body does with it: iso, iso.eos, shutter.100us, shutter.ratio, shutter.eos, aperture.100,
//       aperture.eos, format, battery, clock.ptp, clock.unix, free_images, free_bytes, shots, serial, target, focus
//     FORM any | range MIN MAX STEP | enum V,V,...   (str: enum texts have no spaces or commas)
//   no_property CODE
// Several properties of one role show one setting in several ways: setting one moves the others.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum vendor { VENDOR_GENERIC, VENDOR_NIKON, VENDOR_CANON };

// PTP's data type codes.
enum property_type {
    TYPE_I8 = 1, TYPE_U8 = 2, TYPE_I16 = 3, TYPE_U16 = 4, TYPE_I32 = 5, TYPE_U32 = 6, TYPE_I64 = 7, TYPE_U64 = 8,
    TYPE_STR = 0xffff
};
enum property_form { FORM_ANY = 0, FORM_RANGE = 1, FORM_ENUM = 2 }; // PTP's form flags

enum property_role {
    ROLE_NONE, ROLE_ISO, ROLE_ISO_EOS, ROLE_SHUTTER_100US, ROLE_SHUTTER_RATIO, ROLE_SHUTTER_EOS, ROLE_APERTURE_100,
    ROLE_APERTURE_EOS, ROLE_FORMAT, ROLE_BATTERY, ROLE_CLOCK_PTP, ROLE_CLOCK_UNIX, ROLE_FREE_IMAGES, ROLE_FREE_BYTES,
    ROLE_SHOTS, ROLE_SERIAL, ROLE_TARGET, ROLE_FOCUS
};

enum { PERSONALITY_PROPERTIES_MAX = 96, PERSONALITY_CODES_MAX = 128, PROPERTY_CHOICES_MAX = 80, PROPERTY_TEXT_MAX = 48 };

struct property {
    uint16_t code;
    enum property_type type;
    bool writable;
    enum property_role role;
    enum property_form form;
    int64_t min, max, step;
    int n_choices;
    int64_t choice[PROPERTY_CHOICES_MAX]; // str: byte offsets in texts
    char texts[256];
    int64_t initial;
    char initial_text[PROPERTY_TEXT_MAX];
};

struct code_list {
    int n;
    uint16_t code[PERSONALITY_CODES_MAX];
};

enum { FILES_RAW = 1, FILES_JPEG = 2 };
struct format_choice {
    int64_t value;
    int files; // FILES_*
};

struct personality {
    enum vendor vendor; // which family of operations it answers: vendor = generic | nikon | canon
    char manufacturer[48], model[48], firmware[32], lens[48];
    uint32_t extension;         // VendorExtensionID
    uint16_t extension_version; // 100: 1.00
    char extension_text[64];
    char serial[32];     // of the first body; digits at its end count up
    char file_prefix[8]; // names are file_prefix, 4 digits, extension: "DSC_" -> DSC_0001.DNG
    char raw_extension[5], folder[16];
    uint16_t raw_format; // PTP object format of raws
    int older_folders;   // beside it on the card, empty, before it in every listing: "00000OLD", "00001OLD", ...
    uint32_t storage;

    double lag_ms, lag_spread_ms, lag_jitter_ms; // full-press to exposure: mean, sigma between bodies, sigma between shots
    double wire_lag_ms, wire_jitter_ms;          // the same for a release by command
    double sleep_after_s, sleep_extra_ms;        // semi-sleep
    double process_ms;                           // end of exposure to first file
    double second_file_ms;                       // first file to second
    double complete_ms;                          // last file to CaptureComplete
    double recycle_ms;                           // end of exposure to the next possible one
    bool half_press_blocks_usb;
    double battery_percent, battery_per_shot;
    double card_bytes;

    int black_level, white_level; // DN of 14 bits
    double full_well_e;           // electrons at white_level, ISO 100
    double read_noise_e;
    double gain_spread;           // sigma between bodies of what each channel gathers, relative; 0
    double wb[3];                 // response of R, G, B to a white of linear sRGB; the largest is 1
    double t_ref_s, n_ref;        // scene value 1 is white_level at ISO 100, this time (power of two) and f-number

    struct code_list operations, events, capture_formats, object_formats;
    int n_formats;
    struct format_choice format[16];
    int n_properties;
    struct property property[PERSONALITY_PROPERTIES_MAX];
};

// name: generic, nikon, canon, or a file. Errors, logged with file, line, what was found and what is accepted: -EINVAL, -errno of the
// open, -EFBIG.
int personality_load(struct personality *out, const char *name);
// One more statement, e.g. "lag_jitter_ms = 3" (rigsim --set). name_for_errors and line go into the message.
int personality_statement(struct personality *p, const char *text, const char *name_for_errors, int line);
// The text of a built-in one, to begin a file with; NULL if there is none of that name.
const char *personality_builtin(const char *name);
const struct property *personality_property(const struct personality *p, uint16_t code); // NULL: not there
