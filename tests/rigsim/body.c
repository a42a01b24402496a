// tests/rigsim/body.c - see body.h. All that will happen by itself is one list ordered by time; body_step() works it off.
#include "tests/rigsim/body.h"
#include "solver/random.h"
#include "rigd/shutter_line.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { STREAM_BODY_LAG = 0x6c6167, STREAM_SHOT_LAG, STREAM_WIRE_LAG, STREAM_FLICKER }; // names of random streams (solver/random.h)
enum { HANDLE_DCIM = 0x00010001, HANDLE_FOLDER = 0x00010002, HANDLE_FIRST_FILE = 0x00010010, HANDLE_RAM = 0xffff0001 };
#define MS 1000000
#define FIXED_EPOCH_NS (INT64_C(1767225600) * 1000000000) // 2026-01-01T00:00:00

static int64_t ms_to_ns(double ms)
{
    return (int64_t)llround(ms * MS);
}

// ---- settings --------------------------------------------------------------------------------------------------------------

double body_true_time_s(double label_s)
{
    return exp2(round(log2(label_s) * 3) / 3);
}

// Canon counts in eighths of a stop; thirds are written 3/8 and 5/8.
static double eos_stops(int64_t eighths)
{
    static const double fraction[8] = { 0, 0, 0, 1. / 3, .5, 2. / 3, 0, 0 };
    const int64_t rest = ((eighths % 8) + 8) % 8;
    return (double)((eighths - rest) / 8) + fraction[rest];
}

// What a value of this role means: seconds, f-number, ISO, files.
static double meaning(const struct personality *p, enum property_role role, int64_t v)
{
    switch (role) {
    case ROLE_ISO:
        return (double)v;
    case ROLE_ISO_EOS: {
        // the labels on the dial: 100 125 160 200 ...
        static const double third[3] = { 100, 125, 160 };
        const int steps = (int)lround(eos_stops(v - 72) * 3);
        const int stop = steps >= 0 ? steps / 3 : (steps - 2) / 3;
        return third[steps - 3 * stop] * exp2(stop);
    }
    case ROLE_SHUTTER_100US:
        return body_true_time_s((double)v * 1e-4);
    case ROLE_SHUTTER_RATIO:
        return body_true_time_s((double)(v >> 16 & 0xffff) / (double)(v & 0xffff ? v & 0xffff : 1));
    case ROLE_SHUTTER_EOS:
        return exp2(-eos_stops(v - 56));
    case ROLE_APERTURE_100:
        return (double)v / 100;
    case ROLE_APERTURE_EOS: {
        static const double label[24] = { 1,   1.1, 1.2, 1.4, 1.6, 1.8, 2,  2.2, 2.5, 2.8, 3.2, 3.5,
                                          4,   4.5, 5,   5.6, 6.3, 7.1, 8,  9,   10,  11,  13,  14 };
        const int steps = (int)lround(eos_stops(v - 8) * 3);
        if (steps >= 0 && steps < 24)
            return label[steps];
        return steps >= 24 && steps < 36 ? round(label[steps - 12] * 4) : 1;
    }
    case ROLE_FORMAT:
        for (int i = 0; i < p->n_formats; i++)
            if (p->format[i].value == v)
                return p->format[i].files;
        return 0;
    default:
        return 0;
    }
}

// 0: nothing that is shown in several ways; else the same number for all roles that show one setting.
static int family(enum property_role role)
{
    switch (role) {
    case ROLE_ISO:
    case ROLE_ISO_EOS:
        return 1;
    case ROLE_SHUTTER_100US:
    case ROLE_SHUTTER_RATIO:
    case ROLE_SHUTTER_EOS:
        return 2;
    case ROLE_APERTURE_100:
    case ROLE_APERTURE_EOS:
        return 3;
    case ROLE_FORMAT:
        return 4;
    default:
        return 0;
    }
}

static double setting(const struct body *b, int which, double fallback)
{
    const struct personality *p = b->personality;
    double found = fallback;
    bool exact = false; // in 0.1 ms, 1/4000 and 1/5000 look alike
    for (int i = 0; i < p->n_properties && !exact; i++)
        if (family(p->property[i].role) == which) {
            const double v = meaning(p, p->property[i].role, b->value[i]);
            found = v > 0 ? v : fallback;
            exact = p->property[i].role != ROLE_SHUTTER_100US;
        }
    return found;
}

int body_iso(const struct body *b)
{
    return (int)lround(setting(b, 1, 100));
}

double body_exposure_time_s(const struct body *b)
{
    return setting(b, 2, 0x1p-7);
}

double body_f_number(const struct body *b)
{
    return setting(b, 3, 8);
}

int body_files(const struct body *b)
{
    return (int)setting(b, 4, FILES_RAW);
}

int64_t body_value(const struct body *b, int property)
{
    assert(property >= 0 && property < b->personality->n_properties);
    switch (b->personality->property[property].role) {
    case ROLE_BATTERY:
        return (int64_t)ceil(b->battery_percent);
    case ROLE_CLOCK_UNIX:
        return (b->now_ns + b->utc_offset_ns) / 1000000000;
    case ROLE_FREE_IMAGES:
        return body_free_images(b);
    case ROLE_FREE_BYTES:
        return (int64_t)body_card_free(b);
    case ROLE_SHOTS:
        return b->n_shots;
    default:
        return b->value[property];
    }
}

void body_value_text(const struct body *b, int property, char text[BODY_TEXT_MAX])
{
    const struct property *q = &b->personality->property[property];
    if (q->role == ROLE_SERIAL) {
        snprintf(text, BODY_TEXT_MAX, "%s", b->serial);
    } else if (q->role == ROLE_CLOCK_PTP) {
        const time_t t = (time_t)((b->now_ns + b->utc_offset_ns) / 1000000000);
        struct tm tm;
        gmtime_r(&t, &tm);
        strftime(text, BODY_TEXT_MAX, "%Y%m%dT%H%M%S", &tm);
    } else {
        memcpy(text, b->text[property], BODY_TEXT_MAX);
    }
}

static bool is_allowed(const struct property *q, int64_t value, const char *text)
{
    if (q->form == FORM_RANGE)
        return value >= q->min && value <= q->max && (value - q->min) % q->step == 0;
    if (q->form == FORM_ENUM) {
        for (int i = 0; i < q->n_choices; i++)
            if (q->type == TYPE_STR ? text && !strcmp(q->texts + q->choice[i], text) : q->choice[i] == value)
                return true;
        return false;
    }
    return true;
}

static uint16_t set_clock(struct body *b, const struct property *q, int64_t value, const char *text)
{
    int64_t utc_s = value;
    if (q->role == ROLE_CLOCK_PTP) {
        struct tm tm = { 0 };
        if (!text || !strptime(text, "%Y%m%dT%H%M%S", &tm))
            return PTP_BAD_VALUE;
        utc_s = timegm(&tm);
    }
    if (utc_s < 0 || utc_s > INT64_C(4102444800)) // 2100
        return PTP_BAD_VALUE;
    b->utc_offset_ns = utc_s * 1000000000 - b->now_ns;
    return PTP_OK;
}

// Store a value and move the properties that show the same setting to their nearest choice.
static void store(struct body *b, int property, int64_t value)
{
    const struct personality *p = b->personality;
    const struct property *q = &p->property[property];
    const double target = meaning(p, q->role, value);
    b->value[property] = value;
    for (int i = 0; i < p->n_properties; i++) {
        const struct property *other = &p->property[i];
        if (i == property || !family(q->role) || family(other->role) != family(q->role))
            continue;
        double best = INFINITY;
        for (int k = 0; k < other->n_choices; k++) {
            const double d = fabs(log(meaning(p, other->role, other->choice[k]) / target));
            if (d < best)
                best = d, b->value[i] = other->choice[k];
        }
    }
}

uint16_t body_set(struct body *b, int property, int64_t value, const char *text)
{
    const struct property *q = &b->personality->property[property];
    if (!q->writable)
        return PTP_ACCESS_DENIED;
    if (!is_allowed(q, value, text))
        return PTP_BAD_VALUE;
    if (q->role == ROLE_CLOCK_PTP || q->role == ROLE_CLOCK_UNIX)
        return set_clock(b, q, value, text);
    if (q->type == TYPE_STR) {
        snprintf(b->text[property], BODY_TEXT_MAX, "%s", text ? text : "");
        return PTP_OK;
    }
    if (b->faults.drifts && b->faults.drift_code == q->code) {
        b->faults.drifts--;
        store(b, property, b->faults.drift_value);
        return PTP_OK;
    }
    store(b, property, value);
    return PTP_OK;
}

// ---- events ----------------------------------------------------------------------------------------------------------------

void body_push_event(struct body *b, struct body_event event)
{
    if (b->n_events == BODY_EVENTS_MAX) {
        b->event_head = (b->event_head + 1) % BODY_EVENTS_MAX;
        b->n_events--;
    }
    b->event[(b->event_head + b->n_events++) % BODY_EVENTS_MAX] = event;
}

bool body_take_event(struct body *b, struct body_event *out)
{
    if (!b->n_events)
        return false;
    *out = b->event[b->event_head];
    b->event_head = (b->event_head + 1) % BODY_EVENTS_MAX;
    b->n_events--;
    return true;
}

// In order of time; equal times in order of arrival.
static bool schedule(struct body *b, const struct pending *p)
{
    if (b->n_pending == BODY_PENDING_MAX)
        return false;
    int i = b->n_pending++;
    for (; i > 0 && b->pending[i - 1].due_ns > p->due_ns; i--)
        b->pending[i] = b->pending[i - 1];
    b->pending[i] = *p;
    return true;
}

// ObjectAdded and CaptureComplete pass the faults: lost, or late.
static void announce(struct body *b, enum body_event_kind kind, uint32_t value)
{
    const struct body_event e = { .kind = kind, .value = value, .at_ns = b->now_ns };
    int *lose = kind == BODY_OBJECT_ADDED ? &b->faults.lose_object_added : &b->faults.lose_complete;
    if (*lose) {
        --*lose;
        return;
    }
    if (b->faults.late_events) {
        b->faults.late_events--;
        if (schedule(b, &(struct pending){ .due_ns = b->now_ns + b->faults.late_event_ns, .kind = PENDING_EVENT, .event = e }))
            return;
    }
    body_push_event(b, e);
}

// ---- the shutter -----------------------------------------------------------------------------------------------------------

uint64_t body_card_free(const struct body *b)
{
    const uint64_t capacity = (uint64_t)b->personality->card_bytes;
    return b->faults.card_full || b->card_used >= capacity ? 0 : capacity - b->card_used;
}

static uint64_t bytes_per_shot(const struct body *b)
{
    const struct exposure e = { .shot = b->n_shots + 1, .time_s = body_exposure_time_s(b), .f_number = body_f_number(b),
                                .iso = body_iso(b) };
    const int files = body_files(b);
    uint64_t n = 0;
    for (int file = FILES_RAW; file <= FILES_JPEG; file <<= 1)
        if (files & file)
            n += b->measure(b->measure_arg, b, &e, file);
    return n ? n : 1;
}

uint32_t body_free_images(const struct body *b)
{
    const uint64_t n = body_card_free(b) / bytes_per_shot(b);
    const uint64_t slots = (uint64_t)(BODY_OBJECTS_MAX - b->n_objects);
    return (uint32_t)(n < slots ? n : slots);
}

// at_ns: when the shutter opens. Whoever calls knows that it may.
static void expose(struct body *b, int64_t at_ns, int64_t lag_ns, uint64_t tag, bool to_ram)
{
    b->n_shots++;
    b->battery_percent = fmax(0, b->battery_percent - b->personality->battery_per_shot);
    struct pending p = {
        .kind = PENDING_END, .lag_ns = lag_ns, .tag = tag, .to_ram = to_ram, .file = body_files(b),
        .exposure = { .shot = b->n_shots, .at_ns = at_ns,
                      .utc_ns = b->fixed_clock ? FIXED_EPOCH_NS + b->n_shots * INT64_C(10000000000) : at_ns + b->utc_offset_ns,
                      .time_s = body_exposure_time_s(b), .f_number = body_f_number(b), .iso = body_iso(b) },
    };
    p.exposure.view.lamps = fmax(0, 1 + b->faults.flicker * random_normal(b->seed ^ STREAM_FLICKER, b->index, b->n_shots));
    if (b->aim)
        b->aim(b->aim_arg, at_ns, &p.exposure.view);
    p.due_ns = at_ns + (int64_t)llround(p.exposure.time_s * 1e9);
    b->ready_ns = p.due_ns + ms_to_ns(b->personality->recycle_ms);
    b->n_in_work++;
    const bool scheduled = schedule(b, &p);
    assert(scheduled); // body_line() and body_release() keep room for the files of a shot
    (void)scheduled;
}

// 0x2001 if the shutter may be released at at_ns.
static uint16_t may_release(const struct body *b, int64_t at_ns, bool to_ram)
{
    if (b->faults.no_power || b->battery_percent <= 0)
        return PTP_GENERAL_ERROR;
    if (at_ns < b->ready_ns || b->n_pending > BODY_PENDING_MAX - 8)
        return PTP_BUSY;
    return !to_ram && !body_free_images(b) ? PTP_STORE_FULL : PTP_OK;
}

static int64_t shot_lag_ns(const struct body *b)
{
    const double jitter_ms = b->personality->lag_jitter_ms * random_normal(b->seed ^ STREAM_SHOT_LAG, b->index, b->n_shots);
    const int64_t lag = b->lag_ns + ms_to_ns(jitter_ms);
    return lag > MS ? lag : MS;
}

static void line_changes(struct body *b, int line, int level, int64_t at_ns, uint64_t tag)
{
    const struct personality *p = b->personality;
    const int64_t sleep_ns = (int64_t)llround(p->sleep_after_s * 1e9), extra_ns = ms_to_ns(p->sleep_extra_ms);
    const bool held = b->half || b->full, slept = !held && at_ns - b->awake_ns > sleep_ns;
    bool *const contact = line == SHUTTER_LINE_HALF ? &b->half : &b->full;
    if (*contact == (level != 0))
        return;
    *contact = level;
    if (level && slept)
        b->wake_ready_ns = at_ns + extra_ns;
    if (at_ns > b->awake_ns)
        b->awake_ns = at_ns;
    if (line != SHUTTER_LINE_FULL || !level)
        return;
    const uint16_t may = may_release(b, at_ns, false);
    if (may == PTP_STORE_FULL)
        body_push_event(b, (struct body_event){ .kind = BODY_STORE_FULL, .at_ns = b->now_ns });
    if (may != PTP_OK)
        return;
    if (b->faults.closed_shutters) {
        b->faults.closed_shutters--;
        return;
    }
    const int64_t lag = shot_lag_ns(b) + (b->wake_ready_ns > at_ns ? b->wake_ready_ns - at_ns : 0);
    expose(b, at_ns + lag, lag, tag, false);
}

int body_line(struct body *b, int line, int level, int64_t at_ns, uint64_t tag)
{
    if (b->faults.no_power || b->battery_percent <= 0)
        return -ENXIO;
    int waiting = 0;
    for (int i = 0; i < b->n_pending; i++)
        waiting += b->pending[i].kind == PENDING_LINE;
    if (waiting >= SHUTTER_LINE_PENDING_MAX)
        return -ENOSPC;
    if (at_ns <= b->now_ns) {
        line_changes(b, line, level, at_ns ? at_ns : b->now_ns, tag);
        return 0;
    }
    const struct pending p = { .due_ns = at_ns, .kind = PENDING_LINE, .line = line, .level = level, .tag = tag };
    return schedule(b, &p) ? 0 : -ENOSPC;
}

void body_open_lines(struct body *b)
{
    int n = 0;
    for (int i = 0; i < b->n_pending; i++)
        if (b->pending[i].kind != PENDING_LINE)
            b->pending[n++] = b->pending[i];
    b->n_pending = n;
    line_changes(b, SHUTTER_LINE_FULL, 0, b->now_ns, 0);
    line_changes(b, SHUTTER_LINE_HALF, 0, b->now_ns, 0);
}

uint16_t body_release(struct body *b, bool to_ram)
{
    const uint16_t may = may_release(b, b->now_ns, to_ram);
    if (may != PTP_OK)
        return may;
    if (b->faults.closed_shutters) {
        b->faults.closed_shutters--;
        return PTP_OK;
    }
    const struct personality *p = b->personality;
    const double jitter_ms = p->wire_jitter_ms * random_normal(b->seed ^ STREAM_WIRE_LAG, b->index, b->n_shots);
    const int64_t lag = ms_to_ns(fmax(1, p->wire_lag_ms + jitter_ms));
    expose(b, b->now_ns + lag, lag, 0, to_ram);
    return PTP_OK;
}

// ---- files -----------------------------------------------------------------------------------------------------------------

static struct body_object *new_object(struct body *b)
{
    if (b->n_objects == b->capacity) {
        const int capacity = b->capacity ? b->capacity * 2 : 16;
        struct body_object *object = b->n_objects < BODY_OBJECTS_MAX ? realloc(b->object, (size_t)capacity * sizeof(*object)) : NULL;
        if (!object)
            return NULL;
        b->object = object;
        b->capacity = capacity;
    }
    struct body_object *o = &b->object[b->n_objects++];
    *o = (struct body_object){ 0 };
    return o;
}

struct body_object *body_object(const struct body *b, uint32_t handle)
{
    for (int i = 0; i < b->n_objects; i++)
        if (b->object[i].handle == handle)
            return &b->object[i];
    return NULL;
}

uint16_t body_delete(struct body *b, uint32_t handle)
{
    struct body_object *o = body_object(b, handle);
    if (!o)
        return PTP_INVALID_HANDLE;
    if (!o->file)
        return PTP_WRITE_PROTECTED;
    if (!o->in_ram)
        b->card_used -= o->size;
    memmove(o, o + 1, (size_t)(b->object + b->n_objects - (o + 1)) * sizeof(*o));
    b->n_objects--;
    return PTP_OK;
}

static void file_is_there(struct body *b, const struct pending *p)
{
    const struct personality *q = b->personality;
    const bool raw = p->file == FILES_RAW;
    const uint64_t size = b->measure(b->measure_arg, b, &p->exposure, p->file);
    struct body_object *o = p->to_ram || body_card_free(b) >= size ? new_object(b) : NULL;
    if (!o) {
        body_push_event(b, (struct body_event){ .kind = BODY_STORE_FULL, .at_ns = b->now_ns });
        return;
    }
    bool ram_in_use = false;
    for (int i = 0; i < b->n_objects; i++)
        ram_in_use |= b->object[i].in_ram;
    if (!ram_in_use)
        b->next_ram = HANDLE_RAM;
    *o = (struct body_object){ .handle = p->to_ram ? b->next_ram++ : b->next_handle++,
                               .parent = p->to_ram ? 0 : HANDLE_FOLDER, .format = raw ? q->raw_format : 0x3801,
                               .in_ram = p->to_ram, .file = p->file, .size = size, .told = size, .exposure = p->exposure };
    snprintf(o->name, sizeof(o->name), "%.7s%04u.%.4s", q->file_prefix, (p->exposure.shot - 1) % 9999 + 1,
             raw ? q->raw_extension : "JPG");
    if (!p->to_ram)
        b->card_used += size;
    if (b->faults.corrupt_objects) {
        b->faults.corrupt_objects--;
        o->corrupt = true;
    }
    if (b->faults.short_objects) {
        b->faults.short_objects--;
        o->told = size / 2;
    }
    announce(b, BODY_OBJECT_ADDED, o->handle);
}

static void happen(struct body *b, struct pending p)
{
    const struct personality *q = b->personality;
    struct pending next = { .exposure = p.exposure, .to_ram = p.to_ram };
    switch (p.kind) {
    case PENDING_LINE:
        line_changes(b, p.line, p.level, p.due_ns, p.tag);
        return;
    case PENDING_END:
        body_push_event(b, (struct body_event){ .kind = BODY_EXPOSED, .at_ns = p.exposure.at_ns, .end_ns = p.due_ns,
                                                .lag_ns = p.lag_ns, .tag = p.tag });
        next.kind = PENDING_FILE;
        next.due_ns = p.due_ns + ms_to_ns(q->process_ms);
        for (int file = FILES_RAW; file <= FILES_JPEG; file <<= 1)
            if (p.file & file) {
                next.file = file;
                schedule(b, &next);
                next.due_ns += ms_to_ns(q->second_file_ms);
            }
        next.due_ns += ms_to_ns(q->complete_ms) - ms_to_ns(q->second_file_ms);
        next.kind = PENDING_COMPLETE;
        schedule(b, &next);
        return;
    case PENDING_FILE:
        file_is_there(b, &p);
        return;
    case PENDING_COMPLETE:
        b->n_in_work--;
        announce(b, BODY_CAPTURE_COMPLETE, p.to_ram);
        return;
    case PENDING_EVENT:
        body_push_event(b, p.event);
        return;
    }
}

void body_step(struct body *b, int64_t now_ns)
{
    while (b->n_pending && b->pending[0].due_ns <= now_ns) {
        const struct pending p = b->pending[0];
        memmove(b->pending, b->pending + 1, (size_t)--b->n_pending * sizeof(p));
        if (p.due_ns > b->now_ns)
            b->now_ns = p.due_ns;
        happen(b, p);
    }
    if (now_ns > b->now_ns)
        b->now_ns = now_ns;
}

int64_t body_next_ns(const struct body *b)
{
    return b->n_pending ? b->pending[0].due_ns : INT64_MAX;
}

bool body_is_silent(const struct body *b)
{
    return b->faults.no_power || b->battery_percent <= 0 ||
           (b->personality->half_press_blocks_usb && (b->half || b->full));
}

void body_touch(struct body *b)
{
    b->awake_ns = b->now_ns;
}

// ---- life ------------------------------------------------------------------------------------------------------------------

// The digits at the end of the first body's serial, counted up.
static void make_serial(char out[32], const char *first, unsigned index)
{
    size_t n = strlen(first), digits = 0;
    while (digits < n && digits < 9 && first[n - 1 - digits] >= '0' && first[n - 1 - digits] <= '9')
        digits++;
    const unsigned long number = strtoul(first + n - digits, NULL, 10) + index;
    snprintf(out, 32, "%.*s%0*lu", (int)(n - digits < 20 ? n - digits : 20), first, (int)digits, number);
}

int body_init(struct body *b, const struct personality *personality, unsigned index, uint64_t seed, int64_t now_ns,
              int64_t utc_ns)
{
    *b = (struct body){ .personality = personality, .index = index, .seed = seed, .now_ns = now_ns, .awake_ns = now_ns,
                        .ready_ns = now_ns, .utc_offset_ns = utc_ns - now_ns, .battery_percent = personality->battery_percent,
                        .next_handle = HANDLE_FIRST_FILE, .next_ram = HANDLE_RAM };
    make_serial(b->serial, personality->serial, index);
    const double lag_ms = personality->lag_ms + personality->lag_spread_ms * random_normal(seed, STREAM_BODY_LAG, index);
    b->lag_ns = ms_to_ns(fmax(1, lag_ms));
    for (int i = 0; i < personality->n_properties; i++) {
        b->value[i] = personality->property[i].initial;
        snprintf(b->text[i], BODY_TEXT_MAX, "%s", personality->property[i].initial_text);
    }
    struct body_object *dcim = new_object(b);
    if (!dcim)
        return -ENOMEM;
    *dcim = (struct body_object){ .handle = HANDLE_DCIM, .format = 0x3001, .name = "DCIM" };
    for (int i = 0; i < personality->older_folders; i++) {
        struct body_object *older = new_object(b);
        if (!older)
            return -ENOMEM;
        *older = (struct body_object){ .handle = b->next_handle++, .parent = HANDLE_DCIM, .format = 0x3001 };
        snprintf(older->name, sizeof(older->name), "%05dOLD", i);
    }
    struct body_object *folder = new_object(b);
    if (!folder)
        return -ENOMEM;
    *folder = (struct body_object){ .handle = HANDLE_FOLDER, .parent = HANDLE_DCIM, .format = 0x3001 };
    snprintf(folder->name, sizeof(folder->name), "%s", personality->folder);
    return 0;
}

void body_free(struct body *b)
{
    free(b->object);
    *b = (struct body){ 0 };
}
