// tests/rigsim/body.h - one camera body as a pure model: settings, shutter, lag, files, card, battery, events.
//
// It owns no clock, socket or thread: every call says what time it is (CLOCK_MONOTONIC ns, never going back), body_step() brings
// the model there, body_next_ns() says when something will happen by itself. Same seed, index and calls: same answers.
#pragma once
#include "tests/rigsim/personality.h"
#include "tests/rigsim/scene.h"

enum { BODY_OBJECTS_MAX = 9999, BODY_PENDING_MAX = 96, BODY_EVENTS_MAX = 512, BODY_TEXT_MAX = 64 };

// PTP response codes that the model itself gives.
enum ptp_response {
    PTP_OK = 0x2001, PTP_GENERAL_ERROR = 0x2002, PTP_SESSION_NOT_OPEN = 0x2003, PTP_INVALID_TRANSACTION = 0x2004,
    PTP_NOT_SUPPORTED = 0x2005, PTP_PARAMETER_NOT_SUPPORTED = 0x2006, PTP_INVALID_STORAGE = 0x2008,
    PTP_INVALID_HANDLE = 0x2009, PTP_NO_SUCH_PROPERTY = 0x200a, PTP_STORE_FULL = 0x200c, PTP_WRITE_PROTECTED = 0x200d,
    PTP_ACCESS_DENIED = 0x200f, PTP_NO_THUMBNAIL = 0x2010, PTP_BUSY = 0x2019, PTP_BAD_FORMAT = 0x201b, PTP_BAD_VALUE = 0x201c,
    PTP_INVALID_PARAMETER = 0x201d, PTP_SESSION_ALREADY_OPEN = 0x201e
};

// One release of the shutter, all that a file needs to be made again at any time.
struct exposure {
    uint32_t shot; // 1, 2, ... per body
    int64_t at_ns; // first instant at which the whole frame is exposed
    int64_t utc_ns; // the same by the camera's own clock, since 1970
    double time_s;  // true time, a power of two in thirds
    double f_number;
    int iso;
    struct scene_view view;
};

struct body_object {
    uint32_t handle, parent; // parent 0: the storage's root, or in RAM
    uint16_t format;         // PTP object format; 0x3001: folder
    bool in_ram, corrupt;
    int file;          // FILES_RAW or FILES_JPEG; 0: folder
    uint64_t size;     // as it was measured
    uint64_t told;     // size to report and send: less than size for a short object
    uint32_t thumbnail_bytes; // 0: not made yet
    char name[24];
    struct exposure exposure;
};

enum body_event_kind {
    BODY_EXPOSED,         // the flash-sync contact: at_ns, end_ns, lag_ns, tag
    BODY_OBJECT_ADDED,    // value: handle
    BODY_OBJECT_REMOVED,  // value: handle
    BODY_CAPTURE_COMPLETE, // value: 1 if to RAM
    BODY_STORE_FULL,
    BODY_PROPERTY_CHANGED // value: code; not for what the client itself set
};
struct body_event {
    enum body_event_kind kind;
    uint32_t value;
    int64_t at_ns, end_ns, lag_ns;
    uint64_t tag;
};

enum pending_kind { PENDING_LINE, PENDING_END, PENDING_FILE, PENDING_COMPLETE, PENDING_EVENT };
struct pending {
    int64_t due_ns;
    enum pending_kind kind;
    int line, level; // LINE
    int64_t lag_ns;
    uint64_t tag;
    struct exposure exposure;
    int file; // FILE: FILES_*
    bool to_ram;
    struct body_event event; // EVENT
};

// Faults that live in the body; tests/rigsim/faults.h sets them.
struct body_faults {
    int64_t busy_until_ns;
    bool no_power, card_full;
    int lose_object_added, lose_complete; // how many to come
    int corrupt_objects, short_objects;
    int closed_shutters; // so many releases that expose nothing
    double flicker;      // sigma of the lamps' brightness from shot to shot, relative
    int64_t late_event_ns; // ObjectAdded and CaptureComplete come this much later
    int late_events;
    uint16_t drift_code; // after it is set next time, it takes drift_value instead
    int64_t drift_value;
    int drifts;
};

struct body {
    const struct personality *personality;
    unsigned index;
    uint64_t seed;
    char serial[32];
    int64_t lag_ns; // of this body, without jitter
    // The size in bytes of the file (FILES_RAW or FILES_JPEG) that an exposure makes.
    uint64_t (*measure)(void *arg, const struct body *b, const struct exposure *e, int file);
    void *measure_arg;
    void (*aim)(void *arg, int64_t at_ns, struct scene_view *out); // where it points then; NULL: it is not on a head
    void *aim_arg;

    int64_t now_ns, utc_offset_ns; // UTC by the camera's clock - CLOCK_MONOTONIC
    bool fixed_clock;              // exposures are stamped 10 s apart, whatever the time
    int64_t value[PERSONALITY_PROPERTIES_MAX];
    char text[PERSONALITY_PROPERTIES_MAX][BODY_TEXT_MAX];
    double battery_percent;
    uint64_t card_used;

    bool half, full;
    int64_t awake_ns, wake_ready_ns; // last sign of life; when a half-press has woken it
    int64_t ready_ns;                // no release before
    uint32_t n_shots;                // releases, ever
    int n_in_work;                   // exposures whose files are not all there

    struct body_object *object; // [n_objects], by handle's order of making
    int n_objects, capacity;
    uint32_t next_handle, next_ram;
    struct pending pending[BODY_PENDING_MAX]; // by due_ns
    int n_pending;
    struct body_event event[BODY_EVENTS_MAX]; // ring; the oldest is lost when full
    unsigned event_head, n_events;
    struct body_faults faults;
};

// 0 or -ENOMEM. personality is kept; utc_ns is the time since 1970 at now_ns.
int body_init(struct body *b, const struct personality *personality, unsigned index, uint64_t seed, int64_t now_ns,
              int64_t utc_ns);
void body_free(struct body *b);

void body_step(struct body *b, int64_t now_ns);
int64_t body_next_ns(const struct body *b); // INT64_MAX: nothing is to come
bool body_take_event(struct body *b, struct body_event *out);
// Silent towards USB: half- or full-press is closed and this model then does not answer, or it has no power.
bool body_is_silent(const struct body *b);
void body_touch(struct body *b); // traffic keeps it awake
void body_push_event(struct body *b, struct body_event event); // as if it had happened: for floods

// A contact changes (shutter_line.h). 0, -ENOSPC (too many waiting), -ENXIO (no power).
int body_line(struct body *b, int line, int level, int64_t at_ns, uint64_t tag);
void body_open_lines(struct body *b); // now, and forget changes to come
// Release by command, to the card or to RAM. PTP_OK, PTP_BUSY, PTP_STORE_FULL.
uint16_t body_release(struct body *b, bool to_ram);

// Settings. Values of a property: numbers, or text for TYPE_STR. PTP_OK or the response that says why not.
int64_t body_value(const struct body *b, int property);
void body_value_text(const struct body *b, int property, char text[BODY_TEXT_MAX]);
uint16_t body_set(struct body *b, int property, int64_t value, const char *text);
// What the settings mean.
double body_exposure_time_s(const struct body *b);
double body_f_number(const struct body *b);
int body_iso(const struct body *b);
int body_files(const struct body *b); // FILES_*

struct body_object *body_object(const struct body *b, uint32_t handle); // NULL: none
uint16_t body_delete(struct body *b, uint32_t handle);                  // PTP_OK, PTP_INVALID_HANDLE, PTP_WRITE_PROTECTED
uint64_t body_card_free(const struct body *b);
uint32_t body_free_images(const struct body *b);

// Labels on dials are rounded; shutters are not: 1/125 is 1/128, 1/60 is 1/64, 1/100 is 2^(-20/3).
double body_true_time_s(double label_s);
