// rigd/rig.c - the rig as a state machine: phases of a take, and beside them the life of each camera.
//
// Two layers. A *body* is one camera with its worker: it has at most one command in flight, climbs the ladder when in trouble, and
// in each phase works off its step. A *phase* belongs to the rig and ends when no body has a step left (n_pending == 0), when the
// answer it waits for is here, or at its deadline. Nothing else moves the rig on: every input ends in settle(), which looks whether
// a phase is over and whether the ledger has to be written.
#include "rigd/rig.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MS INT64_C(1000000)
#define S (1000 * MS)

enum {
    STARTING_MAX = 16,        // workers that are started and opened at once: more only fight for the processor
    READY_WAIT_S = 20,        // preflight and arming wait so long for a body that is being opened
    GRACE_MS = 1000,          // an answer may be so much later than the command's timeout
    GREETING_MS = 8000,       // from spawn to HELLO
    BUSY_MS = 5000,           // back-off in all
    TROUBLE_MS = 14500,       // ladder in all, counted from
    SILENCE_MS = 4000,        // when the command was sent that failed, but at most so long before it did: drivers wait 3 s for an answer
    POWER_OFF_MS = 1500, POWER_ON_MS = 2000, RELAY_OFF_MS = 2000, RELAY_ON_MS = 2500,
    REOPEN_MS = 1000,         // between tries when the ladder has no rung left
    QUARANTINE_MS = 60000,    // between tries from quarantine
    DRAIN_QUIET_MS = 200,
    PROGRESS_MS = 6000,       // a copy without a byte for so long is stalled
    TRIES_MAX = 3, DISK_TRIES_MAX = 10, COMMIT_TRIES_MAX = 30, FIRE_TRIES_MAX = 3,
    FIRE_LEAD_MS = 150,       // from the decision to half-press: the board is told of each body first, 200 of them in some 60 ms
    AFTER_EXPOSURE_MS = 100,
    UNMEASURED_LAG_MS = 350,  // from full-press to the open shutter, of a body whose lag is not known; one that slept takes so long
    FEEDBACK_WAIT_MS = 1000,  // calibration: flash-sync contacts close within
    RECONCILE_MS = 4000,      // how long a card is listed again before a frame counts as missed
    LATE_MS = 2,              // a shutter further than this from the median is named
    MAX_DELAY_US = 990000,
    FINDINGS_MAX = 4 * CONFIG_CAMERAS_MAX,
    CONTROLLERS_MAX = 256,
};

enum phase { PHASE_IDLE, PHASE_PREFLIGHT, PHASE_ARM, PHASE_CREATE, PHASE_FIRE, PHASE_EXPOSE, PHASE_COLLECT, PHASE_MANIFEST, PHASE_SETTLE, PHASE_DELETE, PHASE_END };
enum purpose { FOR_PREFLIGHT, FOR_TAKE, FOR_LAG, FOR_RESUME };
enum step { STEP_NONE, STEP_CONFIGURE, STEP_STATUS, STEP_DRAIN, STEP_BEFORE, STEP_COLLECT, STEP_RECONCILE, STEP_COPY, STEP_DELETE };

struct body {
    const struct config_camera *config;
    enum rig_condition condition;
    bool worker, greeted, killing;  // a process is there | said HELLO | was killed and has not gone yet
    bool reset_next;                // the next OPEN resets the port
    struct {
        bool on;
        enum camera_command_kind kind;
        int object;                 // FETCH, DELETE: which of the ledger's
        int64_t since_ns;           // sent, or last PROGRESS
        int64_t due_ns, limit_ns;   // due moves on with PROGRESS, the limit does not
    } flight;
    uint32_t seq;
    int64_t greet_due_ns, retry_ns, busy_since_ns, heartbeat_ns;
    int n_busy, n_failed;

    int64_t trouble_ns; // 0: none
    int rung, n_recoveries;
    enum camera_command_kind suspect; // trouble is over when this works again
    enum { WIRED, POWER_IS_OFF, RELAY_IS_CUT } supply;
    int64_t again_ns; // from quarantine
    char note[200];

    bool part;       // of the take under way
    enum step step;
    bool identify, press, thumbed;
    int64_t owed_due_ns; // RECONCILE: miss it after
    bool saw_nothing;    // RECONCILE: the card was listed and holds nothing new
    struct camera_object cursor[CAMERA_STORES_MAX];
    int n_cursor;
    uint64_t noted[LEDGER_OBJECTS_MAX];
    int64_t flash_ns; // INT64_MIN: not seen
    int64_t bytes_now;
    struct camera_facts facts;
    struct camera_status status;
    bool has_status;
    int n_settings;
    struct camera_setting_found setting[CAMERA_SETTINGS_MAX];
    struct lag lag;
    double *sample_ms;
    int n_samples;
};

struct rig {
    const struct config *config;
    int n;
    struct body *body;
    int abilities; // of the trigger; -1: none

    enum phase phase;
    enum purpose purpose;
    int64_t phase_due_ns;
    int n_pending;
    bool cancelled, without_missing;
    char outcome[200]; // why the last take, preflight or calibration failed; "" it did not
    bool created; // the take's folder is there
    bool has_ledger;
    struct ledger ledger;
    char takes_dir[300];
    int64_t utc_ms, utc_at_ns; // wall clock at a monotonic time

    bool space_known;
    int64_t free_bytes;

    uint64_t change, covered, durable; // the ledger's changes: made | in the commit under way | on disk
    bool committing;
    int n_commit_failures;
    int64_t commit_retry_ns;

    int n_fire_tries, n_shots, n_shots_wanted;
    int64_t at_ns, pressed_ns, late_ns, released_ns, quiet_until_ns, shot_ns;
    uint32_t *delay_us;
    uint64_t skip[CONFIG_CAMERAS_MAX / 64];

    int copying[CONTROLLERS_MAX];
    int n_findings;
    struct rig_finding *finding;

    struct rig_action *queue; // a ring
    int queue_begin, queue_n, queue_room;
};

// ---- actions -----------------------------------------------------------------------------------------------------------------

static struct rig_action *act(struct rig *r, enum rig_action_kind kind, int camera)
{
    if (r->queue_n == r->queue_room) {
        const int room = r->queue_room ? 2 * r->queue_room : 64;
        struct rig_action *grown = calloc((size_t)room, sizeof(*grown));
        if (!grown)
            abort(); // a rig that forgets what it has to do is worse than one that starts again
        for (int i = 0; i < r->queue_n; i++)
            grown[i] = r->queue[(r->queue_begin + i) % r->queue_room];
        free(r->queue);
        r->queue = grown;
        r->queue_begin = 0;
        r->queue_room = room;
    }
    struct rig_action *a = &r->queue[(r->queue_begin + r->queue_n++) % r->queue_room];
    memset(a, 0, sizeof(*a));
    a->kind = kind;
    a->camera = camera;
    return a;
}

bool rig_next(struct rig *r, struct rig_action *out)
{
    if (!r->queue_n)
        return false;
    *out = r->queue[r->queue_begin];
    r->queue_begin = (r->queue_begin + 1) % r->queue_room;
    r->queue_n--;
    return true;
}

__attribute__((format(printf, 4, 5))) static void say(struct rig *r, enum rig_severity severity, int camera, const char *format, ...)
{
    struct rig_action *a = act(r, RIG_SAY, camera);
    va_list args;
    a->severity = severity;
    int n = 0;
    if (camera != CONFIG_NONE)
        n = snprintf(a->text, sizeof(a->text), "camera %s (%s): ", r->config->camera[camera].name, r->config->camera[camera].port);
    va_start(args, format);
    vsnprintf(a->text + n, sizeof(a->text) - (size_t)n, format, args);
    va_end(args);
}

__attribute__((format(printf, 4, 5))) static void find(struct rig *r, enum rig_severity severity, int camera, const char *format, ...)
{
    va_list args;
    if (r->n_findings == FINDINGS_MAX)
        return;
    struct rig_finding *f = &r->finding[r->n_findings++];
    f->severity = severity;
    f->camera = camera;
    va_start(args, format);
    vsnprintf(f->text, sizeof(f->text), format, args);
    va_end(args);
}

// ---- the ledger's changes -----------------------------------------------------------------------------------------------------

static uint64_t changed(struct rig *r)
{
    return ++r->change;
}

static void flush(struct rig *r, int64_t now)
{
    if (!r->created || r->committing || r->change == r->durable || now < r->commit_retry_ns)
        return;
    r->committing = true;
    r->covered = r->change;
    act(r, RIG_COMMIT, CONFIG_NONE);
}

static void set_state(struct rig *r, enum take_state state)
{
    if (r->ledger.state == state)
        return;
    r->ledger.state = state;
    changed(r);
    act(r, RIG_STATE, CONFIG_NONE);
}

static struct ledger_camera *entry(struct rig *r, int i)
{
    return &r->ledger.camera[i];
}

// ---- steps ---------------------------------------------------------------------------------------------------------------------

static void set_step(struct rig *r, int i, enum step step)
{
    struct body *b = &r->body[i];
    r->n_pending += (step != STEP_NONE) - (b->step != STEP_NONE);
    b->step = step;
    b->n_failed = 0;
}

// What to do about trouble, for people.
static const char *remedy(enum camera_trouble trouble)
{
    switch (trouble) {
    case CAMERA_BUSY:
        return "set manual focus and mode M, check its card";
    case CAMERA_LOST:
    case CAMERA_STALLED:
    case CAMERA_BROKEN:
        return "check cable, hub and power, then rigctl reinstate";
    case CAMERA_REFUSED:
        return "compare its settings and mode dial with rigd.conf";
    case CAMERA_CARD:
        return "check its card";
    case CAMERA_WRONG:
        return "put the configured body there, or correct rigd.conf";
    case CAMERA_CORRUPT:
        return "check cable and card; the frame stays on the card: rigctl resume";
    case CAMERA_DISK:
        return "free space or mend the disk; the frame stays on the card: rigctl resume";
    default:
        return "look into the journal";
    }
}

// Found, then what to do about it: where both do not fit, what was found is cut.
static void explain(char why[200], const char *found, const char *to_do)
{
    const int room = 199 - (int)strlen(to_do) - 2, n = (int)strlen(found);
    if (n <= room)
        snprintf(why, 200, "%s; %s", found, to_do);
    else
        snprintf(why, 200, "%.*s...; %s", room - 3, found, to_do);
}

// Before the shot: this body takes no part. After it: its frames are missed, for now.
static void give_up(struct rig *r, int i, const char *why)
{
    struct body *b = &r->body[i];
    if (b->step == STEP_NONE)
        return;
    const enum step step = b->step;
    set_step(r, i, STEP_NONE);
    if (r->phase == PHASE_PREFLIGHT || r->phase == PHASE_ARM) {
        b->part = false;
        find(r, RIG_ERROR, i, "%s", why);
        if (r->purpose == FOR_TAKE) {
            entry(r, i)->expected = false;
            snprintf(entry(r, i)->note, sizeof(entry(r, i)->note), "left out: %.180s", why);
        }
    } else if (r->phase == PHASE_COLLECT && r->purpose != FOR_LAG) {
        struct ledger_camera *c = entry(r, i);
        c->debt = DEBT_MISSED;
        snprintf(c->note, sizeof(c->note), "%.199s", why);
        changed(r);
        say(r, RIG_ERROR, i, "its frame was not fetched: %s", why);
    } else if (r->phase == PHASE_DELETE && step == STEP_DELETE) {
        say(r, RIG_WARNING, i, "frames stay on its card, they were not deleted: %s", why);
    }
}

// ---- commands ------------------------------------------------------------------------------------------------------------------

// Between the last answer before half-press and the end of the exposure no camera hears anything.
static bool is_silent(const struct rig *r)
{
    return r->phase == PHASE_CREATE || r->phase == PHASE_FIRE || r->phase == PHASE_EXPOSE;
}

static struct camera_command *send(struct rig *r, int i, int64_t now, enum camera_command_kind kind, uint32_t timeout_ms)
{
    struct body *b = &r->body[i];
    struct camera_command *c = &act(r, RIG_SEND, i)->command;
    assert(!b->flight.on);
    c->kind = kind;
    c->timeout_ms = timeout_ms;
    c->seq = ++b->seq ? b->seq : ++b->seq;
    b->flight.on = true;
    b->flight.kind = kind;
    b->flight.object = -1;
    b->flight.since_ns = now;
    b->flight.due_ns = b->flight.limit_ns = now + (timeout_ms + GRACE_MS) * MS;
    b->retry_ns = 0;
    return c;
}

static void send_open(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    struct camera_command *c = send(r, i, now, CAMERA_OPEN, 5000);
    memcpy(c->port, b->config->port, sizeof(c->port));
    memcpy(c->model, b->config->model, sizeof(c->model));
    memcpy(c->personality, b->config->personality, sizeof(c->personality));
    memcpy(c->serial, b->config->serial, sizeof(c->serial));
    c->reset = b->reset_next;
    b->reset_next = false;
}

static void take_path(const struct rig *r, char *out, size_t room, const char *file)
{
    snprintf(out, room, "%s/%s/%s", r->takes_dir, r->ledger.id, file);
}

static bool is_copy(enum camera_command_kind kind)
{
    return kind == CAMERA_FETCH || kind == CAMERA_THUMBNAIL;
}

static void flight_ends(struct rig *r, struct body *b)
{
    if (b->flight.on && is_copy(b->flight.kind))
        r->copying[b->config->controller]--;
    b->flight.on = false;
    b->bytes_now = 0;
}

// The next object to copy: its name is durable. -1: none now.
static int to_copy(struct rig *r, int i)
{
    const struct ledger_camera *c = entry(r, i);
    for (int k = 0; k < c->n_objects; k++)
        if (c->object[k].state == OBJECT_FOUND && r->body[i].noted[k] <= r->durable)
            return k;
    return -1;
}

static bool is_free(const struct body *b, int64_t now)
{
    return b->condition == RIG_READY && b->greeted && !b->killing && !b->flight.on && now >= b->retry_ns;
}

// Fill the controller's slots: all its thumbnails before any raw.
static void copy_next(struct rig *r, int controller, int64_t now)
{
    while (r->copying[controller] < r->config->fetch_limit) {
        int raw = -1, thumbnail = -1;
        for (int i = 0; i < r->n && thumbnail < 0; i++) {
            struct body *b = &r->body[i];
            if (b->config->controller != controller || b->step != STEP_COPY || !is_free(b, now) || to_copy(r, i) < 0)
                continue;
            if (!b->thumbed)
                thumbnail = i;
            else if (raw < 0)
                raw = i;
        }
        const int i = thumbnail >= 0 ? thumbnail : raw;
        if (i < 0)
            return;
        struct body *b = &r->body[i];
        const int k = to_copy(r, i);
        const struct ledger_object *o = &entry(r, i)->object[k];
        char file[96];
        struct camera_command *c;
        if (thumbnail >= 0) {
            c = send(r, i, now, CAMERA_THUMBNAIL, 5000);
            snprintf(file, sizeof(file), "thumbnails/%s.jpg", entry(r, i)->name);
            take_path(r, c->path, sizeof(c->path), file);
        } else {
            c = send(r, i, now, CAMERA_FETCH, r->config->fetch_timeout_ms);
            b->flight.due_ns = now + PROGRESS_MS * MS;
            take_path(r, c->path, sizeof(c->path), o->file);
        }
        c->object = o->object;
        b->flight.object = k;
        r->copying[controller]++;
    }
}

static void reconcile_next(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    struct camera_command *c = send(r, i, now, CAMERA_LIST, 6000);
    c->n_objects = CAMERA_LISTING_MAX;
    c->n_after = b->n_cursor;
    memcpy(c->after, b->cursor, sizeof(c->after));
}

static void begin_reconcile(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    const struct ledger_camera *c = entry(r, i);
    set_step(r, i, STEP_RECONCILE);
    b->n_cursor = c->n_before;
    memcpy(b->cursor, c->before, sizeof(b->cursor));
    if (!b->owed_due_ns)
        b->owed_due_ns = now + RECONCILE_MS * MS;
}

// What it announced was lost with its connection: to wait for that would be in vain.
static void collect_from_card(struct rig *r, int i, int64_t now)
{
    r->body[i].owed_due_ns = now + (RECONCILE_MS + r->config->collect_timeout_ms) * MS;
    begin_reconcile(r, i, now);
}

// Everything this body owes is here?
static void look_at_debt(struct rig *r, int i, int64_t now)
{
    struct ledger_camera *c = entry(r, i);
    int n_here = 0;
    for (int k = 0; k < c->n_objects; k++) {
        if (c->object[k].state == OBJECT_FOUND)
            return; // being copied, or waiting for its turn
        n_here += c->object[k].state == OBJECT_COPIED || c->object[k].state == OBJECT_DELETED;
    }
    if (n_here < r->ledger.objects_per_shot && n_here < c->n_objects) {
        give_up(r, i, "a frame that was on its card is neither there nor here any more");
        return;
    }
    if (n_here < r->ledger.objects_per_shot) {
        begin_reconcile(r, i, now);
        return;
    }
    c->debt = DEBT_PAID;
    c->note[0] = 0;
    changed(r);
    set_step(r, i, STEP_NONE);
}

static int to_delete(struct rig *r, int i)
{
    const struct ledger_camera *c = entry(r, i);
    for (int k = 0; k < c->n_objects; k++)
        if (c->object[k].state == OBJECT_COPIED)
            return k;
    return -1;
}

static void pump(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    struct camera_command *c;
    if (!b->greeted || b->killing || b->flight.on || now < b->retry_ns)
        return;
    if (b->press && b->condition == RIG_READY) { // the software trigger asks in the silent phase
        b->press = false;
        send(r, i, now, CAMERA_TRIGGER, 4000);
        return;
    }
    if (is_silent(r))
        return;
    if (b->condition == RIG_OPENING || b->condition == RIG_RECOVERING) {
        if (b->supply == WIRED)
            send_open(r, i, now);
        return;
    }
    if (b->condition != RIG_READY)
        return;
    if (b->identify) {
        b->identify = false;
        send(r, i, now, CAMERA_IDENTIFY, 12000);
        return;
    }
    switch (b->step) {
    case STEP_CONFIGURE:
        c = send(r, i, now, CAMERA_CONFIGURE, 8000);
        c->n_settings = b->config->n_settings;
        memcpy(c->setting, b->config->setting, sizeof(c->setting));
        return;
    case STEP_STATUS:
        send(r, i, now, CAMERA_STATUS, 4000);
        return;
    case STEP_DRAIN:
        send(r, i, now, CAMERA_DRAIN, 5000)->quiet_ms = DRAIN_QUIET_MS;
        return;
    case STEP_BEFORE:
        send(r, i, now, CAMERA_LIST, 6000);
        return;
    case STEP_COLLECT:
        send(r, i, now, CAMERA_COLLECT, r->config->collect_timeout_ms)->n_objects = r->config->objects_per_shot;
        return;
    case STEP_RECONCILE:
        reconcile_next(r, i, now);
        return;
    case STEP_COPY:
        copy_next(r, b->config->controller, now);
        return;
    case STEP_DELETE: {
        const int k = to_delete(r, i);
        if (k < 0) {
            set_step(r, i, STEP_NONE);
            return;
        }
        const struct ledger_object *o = &entry(r, i)->object[k];
        c = send(r, i, now, CAMERA_DELETE, 8000);
        c->object = o->object;
        take_path(r, c->path, sizeof(c->path), o->file);
        memcpy(c->xxh128, o->xxh128, sizeof(c->xxh128));
        b->flight.object = k;
        return;
    }
    case STEP_NONE:
        if (r->phase == PHASE_IDLE && now >= b->heartbeat_ns) {
            send(r, i, now, CAMERA_STATUS, 4000);
            b->heartbeat_ns = now + r->config->heartbeat_s * S;
        }
    }
}

static void pump_all(struct rig *r, int64_t now)
{
    for (int i = 0; i < r->n; i++)
        pump(r, i, now);
}

// ---- workers and the ladder -------------------------------------------------------------------------------------------------------

static void start_worker(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    b->worker = true;
    b->greeted = false;
    b->greet_due_ns = now + GREETING_MS * MS;
    act(r, RIG_SPAWN, i);
}

static void kill_worker(struct rig *r, int i)
{
    struct body *b = &r->body[i];
    flight_ends(r, b);
    b->press = false;
    if (!b->worker || b->killing)
        return;
    b->killing = true;
    act(r, RIG_KILL, i);
}

// At the start: a few at a time. A body in trouble does not queue.
static void start_more(struct rig *r, int64_t now)
{
    int n_starting = 0;
    for (int i = 0; i < r->n; i++)
        n_starting += r->body[i].condition == RIG_STARTING || r->body[i].condition == RIG_OPENING;
    for (int i = 0; i < r->n && n_starting < STARTING_MAX; i++)
        if (r->body[i].condition == RIG_OFF) {
            r->body[i].condition = RIG_STARTING;
            start_worker(r, i, now);
            n_starting++;
        }
}

static void restore_supply(struct rig *r, int i)
{
    struct body *b = &r->body[i];
    if (b->supply == POWER_IS_OFF)
        act(r, RIG_POWER, i)->on = true;
    if (b->supply == RELAY_IS_CUT)
        act(r, RIG_RELAY, i)->on = true;
    b->supply = WIRED;
}

static void quarantine(struct rig *r, int i, int64_t now, const char *why)
{
    struct body *b = &r->body[i];
    const bool known = b->condition == RIG_QUARANTINED;
    if (why != b->note)
        snprintf(b->note, sizeof(b->note), "%.199s", why);
    restore_supply(r, i);
    kill_worker(r, i);
    b->condition = RIG_QUARANTINED;
    b->again_ns = now + QUARANTINE_MS * MS;
    b->trouble_ns = 0;
    b->rung = 0;
    b->retry_ns = 0;
    if (!known)
        say(r, RIG_ERROR, i, "quarantined: %s", b->note);
    give_up(r, i, b->note);
    start_more(r, now);
}

static void climb(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    const bool wired_power = b->config->power[0], wired_relay = b->config->relay_line != CONFIG_NONE && r->abilities >= 0 && (r->abilities & TRIGGER_RELAYS);
    b->condition = RIG_RECOVERING;
    start_more(r, now); // its place at the start is free
    if (is_silent(r)) { // its worker may come again, its port and its supply are left alone: its shutter may be open
        if (!b->worker)
            start_worker(r, i, now);
        return;
    }
    b->rung++;
    if (b->rung == 3 && !wired_power)
        b->rung++;
    if (b->rung == 4 && !wired_relay)
        b->rung++;
    b->retry_ns = 0;
    switch (b->rung) {
    case 1: // open anew; a worker that still answers may keep its libraries
        break;
    case 2:
        b->reset_next = true;
        kill_worker(r, i);
        break;
    case 3:
        kill_worker(r, i);
        b->supply = POWER_IS_OFF;
        b->retry_ns = now + POWER_OFF_MS * MS;
        act(r, RIG_POWER, i)->on = false;
        break;
    case 4:
        kill_worker(r, i);
        b->supply = RELAY_IS_CUT;
        b->retry_ns = now + RELAY_OFF_MS * MS;
        act(r, RIG_RELAY, i)->on = false;
        break;
    default: // nothing left but patience
        b->retry_ns = now + REOPEN_MS * MS;
    }
    if (!b->worker)
        start_worker(r, i, now);
    pump(r, i, now);
}

// suspect: the command that failed; CAMERA_OPEN for a worker that died without one. since: its last sign of life
static void trouble(struct rig *r, int i, int64_t now, int64_t since, enum camera_command_kind suspect, const char *text)
{
    struct body *b = &r->body[i];
    if (b->condition == RIG_QUARANTINED)
        return;
    snprintf(b->note, sizeof(b->note), "%.199s", text);
    b->busy_since_ns = 0;
    if (suspect == CAMERA_THUMBNAIL)
        b->thumbed = true; // a preview is not worth a second crash
    if (suspect == CAMERA_THUMBNAIL || suspect == CAMERA_IDENTIFY || suspect == CAMERA_TRIGGER)
        suspect = CAMERA_OPEN; // not tried again: reopening is all the proof there will be
    if (b->step == STEP_COLLECT && r->purpose != FOR_LAG) {
        collect_from_card(r, i, now);
        if (suspect == CAMERA_COLLECT)
            suspect = CAMERA_LIST;
    }
    if (!b->trouble_ns) {
        b->trouble_ns = since > now - SILENCE_MS * MS ? since : now - SILENCE_MS * MS;
        b->rung = 0;
        b->suspect = suspect;
        b->n_recoveries++;
        say(r, RIG_WARNING, i, "%s; recovering", b->note);
    }
    if (now >= b->trouble_ns + TROUBLE_MS * MS)
        quarantine(r, i, now, b->note);
    else
        climb(r, i, now);
}

static void works_again(struct rig *r, int i, int64_t now, enum camera_command_kind kind)
{
    struct body *b = &r->body[i];
    if (!b->trouble_ns || (kind != b->suspect && !(kind == CAMERA_STATUS && r->phase == PHASE_IDLE)))
        return;
    say(r, RIG_INFO, i, "works again after %.1f s", 1e-9 * (double)(now - b->trouble_ns));
    b->trouble_ns = 0;
    b->rung = 0;
    b->note[0] = 0;
}

// ---- phases --------------------------------------------------------------------------------------------------------------------------

static void finish(struct rig *r, int64_t now)
{
    const bool was_take = r->has_ledger && (r->purpose == FOR_TAKE || r->purpose == FOR_RESUME);
    r->phase = PHASE_IDLE;
    for (int i = 0; i < r->n; i++) {
        r->body[i].part = false;
        set_step(r, i, STEP_NONE);
        r->body[i].heartbeat_ns = now + r->config->heartbeat_s * S * (i + 1) / r->n; // not all at once
    }
    act(r, was_take ? RIG_TAKE_DONE : r->purpose == FOR_PREFLIGHT ? RIG_PREFLIGHT_DONE : RIG_LAG_DONE, CONFIG_NONE);
}

__attribute__((format(printf, 3, 4))) static void fail_take(struct rig *r, int64_t now, const char *format, ...)
{
    va_list args;
    va_start(args, format);
    vsnprintf(r->outcome, sizeof(r->outcome), format, args);
    va_end(args);
    for (int i = 0; i < r->n; i++)
        set_step(r, i, STEP_NONE);
    if (r->purpose == FOR_LAG || r->purpose == FOR_PREFLIGHT) {
        say(r, RIG_ERROR, CONFIG_NONE, "%s: %s", r->purpose == FOR_LAG ? "calibration" : "preflight", r->outcome);
        finish(r, now);
        return;
    }
    say(r, RIG_ERROR, CONFIG_NONE, "take %s: %s", r->ledger.id, r->outcome);
    memcpy(r->ledger.reason, r->outcome, sizeof(r->ledger.reason));
    set_state(r, TAKE_FAILED);
    if (r->created)
        r->phase = PHASE_END;
    else
        finish(r, now);
}

static void begin_preflight(struct rig *r, int64_t now)
{
    r->phase = PHASE_PREFLIGHT;
    r->phase_due_ns = now + READY_WAIT_S * S;
    r->n_findings = 0;
    r->cancelled = false;
    r->space_known = false;
    act(r, RIG_SPACE, CONFIG_NONE);
    for (int i = 0; i < r->n; i++) {
        struct body *b = &r->body[i];
        b->part = true;
        b->thumbed = !r->config->thumbnails;
        b->owed_due_ns = 0;
        b->flash_ns = INT64_MIN;
        b->saw_nothing = false;
        set_step(r, i, STEP_CONFIGURE);
        if (b->condition == RIG_QUARANTINED) {
            char why[220];
            snprintf(why, sizeof(why), "quarantined: %.199s", b->note);
            give_up(r, i, why);
        }
    }
    pump_all(r, now);
}

static void check_status(struct rig *r, int i)
{
    struct body *b = &r->body[i];
    const struct camera_status *s = &b->status;
    const struct config *config = r->config;
    char why[200] = "";
    if (s->battery_percent >= 0 && s->battery_percent < config->battery_min_percent)
        snprintf(why, sizeof(why), "battery at %d %%, at least %d %% wanted; change or charge it", s->battery_percent, config->battery_min_percent);
    else if (s->card_present == 0)
        snprintf(why, sizeof(why), "no card; insert one");
    else if (s->free_images >= 0 && s->free_images < config->objects_per_shot)
        snprintf(why, sizeof(why), "card has room for %lld pictures, %d wanted; empty it", (long long)s->free_images, config->objects_per_shot);
    else if (s->free_bytes >= 0 && s->free_bytes < (int64_t)config->raw_mb * config->objects_per_shot << 20)
        snprintf(why, sizeof(why), "card has %lld MB free, %d wanted; empty it", (long long)(s->free_bytes >> 20), (int)config->raw_mb * config->objects_per_shot);
    else if (s->manual_focus == 0)
        snprintf(why, sizeof(why), "autofocus is on; set the lens to manual focus");
    else if (s->manual_exposure == 0)
        snprintf(why, sizeof(why), "exposure is automatic; turn the mode dial to M");
    else if (s->objects_per_shot >= 0 && s->objects_per_shot != config->objects_per_shot)
        snprintf(why, sizeof(why), "its image format writes %d files per shot, rigd.conf says %d; set the format to RAW", s->objects_per_shot, config->objects_per_shot);
    else if (b->config->lens[0] && s->lens[0] && strcmp(b->config->lens, s->lens))
        snprintf(why, sizeof(why), "lens is '%.50s', '%.50s' wanted; change it or rigd.conf", s->lens, b->config->lens);
    if (!isnan(s->clock_offset_s) && fabs(s->clock_offset_s) > config->clock_max_s)
        find(r, RIG_WARNING, i, "its clock is %+.1f s off", s->clock_offset_s);
    if (why[0])
        give_up(r, i, why);
    else
        set_step(r, i, STEP_NONE);
}

// Bodies of one model with different firmware behave differently: said once per model, against its first body.
static void check_firmware(struct rig *r)
{
    for (int i = 0; i < r->n; i++)
        for (int k = 0; r->body[i].part && k < i; k++) {
            const struct camera_facts *a = &r->body[i].facts, *b = &r->body[k].facts;
            if (!r->body[k].part || strcmp(a->model, b->model))
                continue;
            if (strcmp(a->firmware, b->firmware))
                find(r, RIG_WARNING, i, "firmware %s, camera %s has %s; update to one version", a->firmware, r->config->camera[k].name, b->firmware);
            break;
        }
}

static void begin_arm(struct rig *r, int64_t now)
{
    r->phase = PHASE_ARM;
    r->phase_due_ns = now + READY_WAIT_S * S;
    for (int i = 0; i < r->n; i++)
        if (r->body[i].part)
            set_step(r, i, STEP_DRAIN);
    pump_all(r, now);
}

// A body that is not fit: how many may be left out?
static bool too_many_missing(struct rig *r, int64_t now)
{
    int n_out = 0, first = -1;
    for (int i = 0; i < r->n; i++)
        if (!r->body[i].part) {
            n_out++;
            first = first < 0 ? i : first;
        }
    if (n_out == r->n || (n_out > r->config->may_miss && !r->without_missing)) {
        const char *text = "";
        for (int f = 0; f < r->n_findings && !text[0]; f++)
            if (r->finding[f].camera == first && r->finding[f].severity == RIG_ERROR)
                text = r->finding[f].text;
        fail_take(r, now, "%d of %d cameras not fit, first %s: %.120s", n_out, r->n, r->config->camera[first].name, text);
        return true;
    }
    return false;
}

static void end_preflight(struct rig *r, int64_t now)
{
    const struct config *config = r->config;
    check_firmware(r);
    const int64_t needed = ((int64_t)config->raw_mb * config->objects_per_shot * r->n + config->free_space_mb) << 20;
    const bool no_space = r->purpose != FOR_LAG && r->free_bytes < needed;
    if (r->free_bytes < 0)
        find(r, RIG_ERROR, CONFIG_NONE, "%.120s: cannot tell its free space: %s", config->takes_dir, strerror((int)-r->free_bytes));
    else if (no_space)
        find(r, RIG_ERROR, CONFIG_NONE, "%.100s: %lld MB free, %lld MB needed; remove old takes", config->takes_dir, (long long)(r->free_bytes >> 20), (long long)(needed >> 20));
    if (r->purpose == FOR_PREFLIGHT)
        finish(r, now);
    else if (no_space)
        fail_take(r, now, "%.190s", r->finding[r->n_findings - 1].text);
    else if (!too_many_missing(r, now))
        begin_arm(r, now);
}

// "1/125", "1/125s", "0.6", "30", "2.5s" in seconds; 0 for a word.
static double shutter_s(const char *text)
{
    double n = 0, d = 0, place = 0;
    for (; *text && *text != '/'; text++) {
        if (*text >= '0' && *text <= '9') {
            n = place ? n + (*text - '0') * place : n * 10 + (*text - '0');
            place /= 10;
        } else if (*text == '.' && !place) {
            place = .1;
        } else {
            break;
        }
    }
    if (*text == '/')
        for (text++; *text >= '0' && *text <= '9'; text++)
            d = d * 10 + (*text - '0');
    const double t = d > 0 ? n / d : n;
    return t < 3600 ? t : 0;
}

static double longest_shutter_s(const struct rig *r)
{
    double longest = 0;
    for (int i = 0; i < r->n; i++)
        for (int k = 0; r->body[i].part && k < r->body[i].n_settings; k++)
            if (!strcmp(r->body[i].setting[k].name, "shutter"))
                longest = fmax(longest, shutter_s(r->body[i].setting[k].found));
    return longest;
}

// When the last exposure is over, or cannot last longer: where a flash-sync contact was seen, it says when its shutter opened.
static int64_t exposed_ns(const struct rig *r)
{
    int64_t open_ns = r->pressed_ns;
    for (int i = 0; i < r->n; i++) {
        const struct body *b = &r->body[i];
        const double lag_ms = r->purpose == FOR_LAG ? FEEDBACK_WAIT_MS : b->lag.n ? b->lag.mean_ms + 5 * b->lag.std_ms : UNMEASURED_LAG_MS;
        const bool seen = b->flash_ns != INT64_MIN && r->abilities >= 0 && (r->abilities & TRIGGER_FEEDBACK);
        const int64_t at = seen ? b->flash_ns : r->pressed_ns + (int64_t)(1e3 * r->delay_us[i] + 1e6 * lag_ms);
        if (b->part && at > open_ns)
            open_ns = at;
    }
    return open_ns + (int64_t)(longest_shutter_s(r) * 1e9);
}

static int64_t quiet_until_ns(const struct rig *r)
{
    const int64_t exposed = exposed_ns(r);
    return (exposed > r->released_ns ? exposed : r->released_ns) + AFTER_EXPOSURE_MS * MS;
}

static void begin_fire(struct rig *r, int64_t now)
{
    const struct trigger_config *t = &r->config->trigger;
    struct lag lag[CONFIG_CAMERAS_MAX];
    bool measured = false;
    if (r->abilities < 0) {
        fail_take(r, now, "the trigger is gone; see the journal");
        return;
    }
    r->phase = PHASE_FIRE;
    memset(r->skip, 0, sizeof(r->skip));
    memset(r->delay_us, 0, (size_t)r->n * sizeof(*r->delay_us));
    for (int i = 0; i < r->n; i++) {
        lag[i] = r->body[i].lag;
        measured |= lag[i].n > 0;
        if (!r->body[i].part)
            r->skip[i / 64] |= UINT64_C(1) << i % 64;
        r->body[i].flash_ns = INT64_MIN;
    }
    const uint32_t half_ms = r->abilities & TRIGGER_HALF_PRESS ? t->half_press_ms : 0;
    if (measured && (r->abilities & TRIGGER_DELAYS) && r->purpose == FOR_TAKE) {
        const uint32_t held_ms = half_ms + t->hold_ms; // half-press waits for the slowest: delays count towards max_hold_ms
        const uint32_t room_us = t->max_hold_ms > held_ms ? 1000 * (t->max_hold_ms - held_ms) : 0;
        const int n_clipped = lag_delays(lag, r->n, room_us < MAX_DELAY_US ? room_us : MAX_DELAY_US, r->delay_us);
        if (n_clipped)
            say(r, RIG_WARNING, CONFIG_NONE, "lag of %d cameras is not made up for in full: max_hold_ms = %u leaves %u ms for delays; raise it in rigd.conf", n_clipped, t->max_hold_ms,
                (room_us < MAX_DELAY_US ? room_us : MAX_DELAY_US) / 1000);
    }
    struct trigger_shot *shot = &act(r, RIG_FIRE, CONFIG_NONE)->shot;
    r->at_ns = now + (FIRE_LEAD_MS + (int64_t)half_ms) * MS;
    *shot = (struct trigger_shot){ .at_ns = r->at_ns, .half_ms = half_ms, .hold_ms = t->hold_ms, .delay_us = r->delay_us, .skip = r->skip };
    r->phase_due_ns = r->at_ns + MAX_DELAY_US * 1000 + (t->hold_ms + 2000) * MS;
}

static void begin_collect(struct rig *r, int64_t now)
{
    r->phase = PHASE_COLLECT;
    for (int i = 0; i < r->n; i++)
        if (r->body[i].part && r->body[i].condition == RIG_READY)
            set_step(r, i, STEP_COLLECT);
        else if (r->body[i].part && r->purpose == FOR_TAKE)
            collect_from_card(r, i, now);
    if (r->purpose == FOR_TAKE)
        set_state(r, TAKE_COLLECTING);
    for (int i = 0; i < r->n; i++) // who fell into quarantine while all was silent
        if (r->body[i].part && r->body[i].condition == RIG_QUARANTINED)
            give_up(r, i, r->body[i].note);
    pump_all(r, now);
}

static void measure_shot(struct rig *r)
{
    struct shot_timing t;
    int64_t at_ns[CONFIG_CAMERAS_MAX];
    for (int i = 0; i < r->n; i++) {
        const struct body *b = &r->body[i];
        at_ns[i] = b->part ? b->flash_ns : INT64_MIN;
        if (r->purpose != FOR_TAKE)
            continue;
        entry(r, i)->delay_us = r->delay_us[i];
        entry(r, i)->lag_ns = at_ns[i] == INT64_MIN ? INT64_MIN : at_ns[i] - r->pressed_ns - (int64_t)r->delay_us[i] * 1000;
    }
    if (r->purpose != FOR_TAKE)
        return;
    shot_timing(&t, at_ns, r->n, LATE_MS * MS);
    r->ledger.n_measured = t.n_measured;
    r->ledger.spread_ns = t.n_measured > 1 ? t.spread_ns : -1;
    r->ledger.sigma_ns = t.n_measured > 1 ? t.sigma_ns : -1;
    for (int i = 0; i < r->n; i++)
        if (t.late[i / 64] >> i % 64 & 1)
            say(r, RIG_WARNING, i, "its shutter opened more than %d ms from the others'; rigctl calibrate lag", LATE_MS);
}

static void end_lag_shot(struct rig *r, int64_t now)
{
    for (int i = 0; i < r->n; i++) {
        struct body *b = &r->body[i];
        if (b->part && b->flash_ns != INT64_MIN && b->n_samples < r->n_shots_wanted)
            b->sample_ms[b->n_samples++] = 1e-6 * (double)(b->flash_ns - r->pressed_ns);
    }
    if (++r->n_shots < r->n_shots_wanted && !r->cancelled) {
        begin_arm(r, now);
        return;
    }
    for (int i = 0; i < r->n; i++) {
        struct lag lag;
        if (!lag_estimate(&lag, r->body[i].sample_ms, r->body[i].n_samples))
            r->body[i].lag = lag;
        else if (r->body[i].part)
            say(r, RIG_WARNING, i, "no flash-sync contact in %d shots; check its cable", r->n_shots);
    }
    finish(r, now);
}

static void end_collect(struct rig *r, int64_t now)
{
    if (r->purpose == FOR_LAG) {
        end_lag_shot(r, now);
        return;
    }
    measure_shot(r);
    r->phase = PHASE_MANIFEST;
    changed(r);
    act(r, RIG_MANIFEST, CONFIG_NONE);
}

static void conclude(struct rig *r, int manifest_err)
{
    struct ledger *l = &r->ledger;
    int n_missed = 0, n_found = 0, first = -1;
    bool nothing_anywhere = true;
    for (int i = 0; i < l->n_cameras; i++) {
        const struct ledger_camera *c = &l->camera[i];
        if (!c->expected)
            continue;
        n_found += c->n_objects;
        nothing_anywhere &= i < r->n && r->body[i].saw_nothing;
        if (c->debt == DEBT_PAID)
            continue;
        n_missed++;
        first = first < 0 ? i : first;
    }
    l->reason[0] = 0;
    if (r->purpose == FOR_RESUME && nothing_anywhere && !n_found)
        snprintf(l->reason, sizeof(l->reason), "the shutters were never pressed: no card holds a new frame");
    else if (n_missed)
        snprintf(l->reason, sizeof(l->reason), "%d of %d cameras did not deliver, first %s: %.100s", n_missed, l->n_cameras, l->camera[first].name, l->camera[first].note);
    else if (!ledger_is_whole(l))
        snprintf(l->reason, sizeof(l->reason), "the ledger does not add up; see the journal");
    else if (manifest_err)
        snprintf(l->reason, sizeof(l->reason), "the manifest could not be written: %s; all frames are here: rigctl resume", strerror(-manifest_err));
    memcpy(r->outcome, l->reason, sizeof(r->outcome));
    if (l->reason[0])
        say(r, RIG_ERROR, CONFIG_NONE, "take %s: %s", l->id, l->reason);
    set_state(r, l->reason[0] ? TAKE_FAILED : TAKE_VERIFIED);
    changed(r);
    r->phase = PHASE_SETTLE;
}

static void begin_delete(struct rig *r, int64_t now)
{
    r->phase = PHASE_DELETE;
    if (r->ledger.state == TAKE_VERIFIED && r->config->delete_after_verify)
        for (int i = 0; i < r->n; i++)
            if (entry(r, i)->expected && to_delete(r, i) >= 0 && r->body[i].condition == RIG_READY)
                set_step(r, i, STEP_DELETE);
    pump_all(r, now);
}

// Move on as long as a phase is over; then see to the ledger.
static void settle(struct rig *r, int64_t now)
{
    for (enum phase before = -1; before != r->phase;) {
        before = r->phase;
        switch (r->phase) {
        case PHASE_IDLE:
            break;
        case PHASE_PREFLIGHT:
            if (!r->n_pending && r->space_known)
                end_preflight(r, now);
            break;
        case PHASE_ARM:
            if (r->n_pending || too_many_missing(r, now))
                break;
            if (r->purpose == FOR_LAG) {
                begin_fire(r, now);
            } else {
                r->phase = PHASE_CREATE;
                set_state(r, TAKE_ARMED);
                r->committing = true;
                r->covered = r->change;
                act(r, RIG_CREATE, CONFIG_NONE);
            }
            break;
        case PHASE_CREATE:
        case PHASE_FIRE:
        case PHASE_MANIFEST:
            break; // an answer is awaited
        case PHASE_EXPOSE:
            if (now >= r->quiet_until_ns)
                begin_collect(r, now);
            break;
        case PHASE_COLLECT:
            if (!r->n_pending)
                end_collect(r, now);
            break;
        case PHASE_SETTLE:
            if (r->durable == r->change)
                begin_delete(r, now);
            break;
        case PHASE_DELETE:
            if (!r->n_pending)
                r->phase = PHASE_END;
            break;
        case PHASE_END:
            if (r->durable == r->change)
                finish(r, now);
            break;
        }
    }
    flush(r, now);
}

// ---- answers of cameras ----------------------------------------------------------------------------------------------------------------

static void note_object(struct rig *r, int i, const struct camera_object *o)
{
    struct ledger_camera *c = entry(r, i);
    struct ledger_object *known = ledger_find(c, o);
    if (known) {
        if (known->object.size_bytes < 0)
            known->object.size_bytes = o->size_bytes;
        return;
    }
    if (!ledger_owns(c, o))
        return; // a late event of an earlier shot, or a frame of a later take
    known = ledger_add(c, o);
    if (!known) {
        say(r, RIG_ERROR, i, "more than %d new files on its card: %s stays there", LEDGER_OBJECTS_MAX, o->name);
        return;
    }
    r->body[i].noted[c->n_objects - 1] = changed(r);
    if (c->n_objects > r->ledger.objects_per_shot)
        say(r, RIG_WARNING, i, "%s is one file more than a shot writes; it is fetched too", o->name);
}

static void listed(struct rig *r, int i, int64_t now, const struct camera_event *e)
{
    struct body *b = &r->body[i];
    struct ledger_camera *c = entry(r, i);
    for (int k = 0; k < e->n_listed; k++) {
        note_object(r, i, &e->object[k]);
        int s = 0;
        while (s < b->n_cursor && !camera_same_store(&b->cursor[s], &e->object[k]))
            s++;
        if (s < CAMERA_STORES_MAX && (s == b->n_cursor || camera_object_order(&e->object[k], &b->cursor[s]) > 0)) {
            b->cursor[s] = e->object[k];
            b->n_cursor += s == b->n_cursor;
        }
    }
    if (e->more && e->n_listed && c->n_objects < LEDGER_OBJECTS_MAX)
        return; // STEP_RECONCILE goes on from the cursor
    int n_found = 0;
    for (int k = 0; k < c->n_objects; k++)
        n_found += c->object[k].state == OBJECT_FOUND;
    b->saw_nothing = !c->n_objects;
    if (n_found || c->n_objects >= r->ledger.objects_per_shot) {
        set_step(r, i, STEP_COPY);
        look_at_debt(r, i, now);
    } else if (now < b->owed_due_ns) {
        begin_reconcile(r, i, now);
        b->retry_ns = now + 500 * MS;
    } else {
        char why[160];
        snprintf(why, sizeof(why), "%d of %d frames on its card; did its shutter open? Check shutter cable, lens and mode", c->n_objects, r->ledger.objects_per_shot);
        give_up(r, i, why);
    }
}

static void done(struct rig *r, int i, int64_t now, const struct camera_event *e, int k)
{
    struct body *b = &r->body[i];
    const bool keeps_frames = r->purpose == FOR_TAKE || r->purpose == FOR_RESUME;
    struct ledger_camera *c = r->has_ledger && keeps_frames ? entry(r, i) : NULL;
    b->busy_since_ns = 0;
    switch (e->command) {
    case CAMERA_OPEN:
        if (c && c->expected && r->phase == PHASE_COLLECT && c->serial[0] && e->facts.serial[0] && strcmp(c->serial, e->facts.serial))
            give_up(r, i, "another body hangs in its place now; put the one with its serial number back, then rigctl resume");
        b->facts = e->facts;
        b->condition = RIG_READY;
        b->heartbeat_ns = now;
        if (!b->trouble_ns)
            b->note[0] = 0;
        start_more(r, now);
        break;
    case CAMERA_CONFIGURE:
        b->n_settings = e->n_settings;
        memcpy(b->setting, e->setting, sizeof(b->setting));
        if (b->step != STEP_CONFIGURE)
            break;
        for (int s = 0; s < e->n_settings; s++)
            if (!e->setting[s].equal) {
                char why[200];
                snprintf(why, sizeof(why), "%s is '%s', '%s' wanted and not accepted; set it by hand or correct rigd.conf", e->setting[s].name, e->setting[s].found, e->setting[s].wanted);
                give_up(r, i, why);
                break;
            }
        if (b->step == STEP_CONFIGURE)
            set_step(r, i, STEP_STATUS);
        break;
    case CAMERA_STATUS:
        b->status = e->status;
        b->has_status = true;
        if (b->step == STEP_STATUS)
            check_status(r, i);
        break;
    case CAMERA_DRAIN:
        if (b->step == STEP_DRAIN)
            set_step(r, i, r->purpose == FOR_LAG ? STEP_NONE : STEP_BEFORE);
        break;
    case CAMERA_LIST:
        if (b->step == STEP_BEFORE && c) {
            c->n_before = e->n_listed < CAMERA_STORES_MAX ? e->n_listed : CAMERA_STORES_MAX;
            memcpy(c->before, e->object, sizeof(c->before));
            memcpy(c->model, b->facts.model, sizeof(c->model));
            memcpy(c->serial, b->facts.serial, sizeof(c->serial));
            memcpy(c->firmware, b->facts.firmware, sizeof(c->firmware));
            memcpy(c->lens, b->status.lens, sizeof(c->lens));
            c->battery_percent = b->status.battery_percent;
            c->n_settings = b->n_settings;
            memcpy(c->setting, b->setting, sizeof(c->setting));
            set_step(r, i, STEP_NONE);
        } else if (b->step == STEP_RECONCILE && c) {
            listed(r, i, now, e);
        }
        break;
    case CAMERA_TRIGGER:
        if (e->pressed_ns && b->flash_ns == INT64_MIN)
            b->flash_ns = e->pressed_ns; // the best that is known without wires
        break;
    case CAMERA_COLLECT:
        if (b->step != STEP_COLLECT)
            break;
        if (!c) {
            set_step(r, i, STEP_NONE);
        } else if (c->n_objects < r->ledger.objects_per_shot) {
            begin_reconcile(r, i, now);
        } else {
            set_step(r, i, STEP_COPY);
            look_at_debt(r, i, now);
        }
        break;
    case CAMERA_THUMBNAIL:
        b->thumbed = true;
        break;
    case CAMERA_FETCH:
        if (!c || k < 0 || k >= c->n_objects || b->step != STEP_COPY)
            break;
        c->object[k].state = OBJECT_COPIED;
        c->object[k].object.size_bytes = e->size_bytes;
        memcpy(c->object[k].xxh128, e->xxh128, sizeof(c->object[k].xxh128));
        c->object[k].copied_ms = r->shot_ns ? (now - r->shot_ns) / MS : -1;
        changed(r);
        b->n_failed = 0;
        look_at_debt(r, i, now);
        break;
    case CAMERA_DELETE:
        if (!c || k < 0 || k >= c->n_objects || b->step != STEP_DELETE)
            break;
        c->object[k].state = OBJECT_DELETED;
        changed(r);
        break;
    case CAMERA_IDENTIFY:
        act(r, RIG_IDENTIFIED, i);
        break;
    case CAMERA_CLOSE:
    case CAMERA_N_COMMANDS:
        break;
    }
    works_again(r, i, now, e->command);
}

static void busy(struct rig *r, int i, int64_t now, const struct camera_event *e)
{
    struct body *b = &r->body[i];
    if (!b->busy_since_ns) {
        b->busy_since_ns = now;
        b->n_busy = 0;
    }
    if (e->command == CAMERA_TRIGGER)
        b->press = true;
    const int64_t wait = (INT64_C(50) << (b->n_busy < 5 ? b->n_busy : 5)) * MS;
    b->n_busy++;
    if (now + wait - b->busy_since_ns > BUSY_MS * MS) {
        char found[300], why[200];
        snprintf(found, sizeof(found), "busy for %.1f s (%s): %s", 1e-9 * (double)(now - b->busy_since_ns), camera_command_name(e->command), e->text);
        explain(why, found, remedy(CAMERA_BUSY));
        b->busy_since_ns = 0;
        quarantine(r, i, now, why);
        return;
    }
    b->retry_ns = now + wait;
}

// A command failed, the link did not: try again where that helps, else go without.
static void failed_softly(struct rig *r, int i, int64_t now, const struct camera_event *e, int k)
{
    struct body *b = &r->body[i];
    char found[300], why[200];
    snprintf(found, sizeof(found), "%s: %s", camera_command_name(e->command), e->text);
    explain(why, found, remedy(e->trouble));
    switch (e->command) {
    case CAMERA_THUMBNAIL:
        b->thumbed = true; // a preview is not worth a second try
        return;
    case CAMERA_IDENTIFY:
        snprintf(act(r, RIG_IDENTIFIED, i)->text, sizeof(why), "%.199s", why);
        return;
    case CAMERA_TRIGGER: // it may have fired all the same: the card will tell
        say(r, RIG_WARNING, i, "%s", why);
        return;
    case CAMERA_OPEN:
        trouble(r, i, now, b->flight.since_ns, CAMERA_OPEN, why);
        return;
    case CAMERA_STATUS:
        if (b->step == STEP_STATUS) {
            find(r, RIG_WARNING, i, "%s", why);
            set_step(r, i, STEP_NONE);
        }
        return;
    case CAMERA_CLOSE:
        return;
    default:
        break;
    }
    if (r->has_ledger && e->command == CAMERA_FETCH && k >= 0)
        entry(r, i)->object[k].n_retries++;
    if (++b->n_failed < (e->trouble == CAMERA_DISK ? DISK_TRIES_MAX : TRIES_MAX)) {
        b->retry_ns = now + (e->trouble == CAMERA_DISK ? 1000 : 250) * MS;
        return;
    }
    if (b->step == STEP_COLLECT)
        begin_reconcile(r, i, now); // the card is the truth
    else
        give_up(r, i, why);
}

void rig_camera_event(struct rig *r, int64_t now, int i, const struct camera_event *e)
{
    struct body *b = &r->body[i];
    if (b->killing || !b->worker)
        return;
    if (e->kind == CAMERA_HELLO) {
        if (b->greeted)
            return;
        if (e->protocol != CAMERA_PROTOCOL) {
            char why[120];
            snprintf(why, sizeof(why), "its worker speaks protocol %d, rigd %d; install both from one version", e->protocol, CAMERA_PROTOCOL);
            quarantine(r, i, now, why);
        } else {
            b->greeted = true;
            if (b->condition == RIG_STARTING)
                b->condition = RIG_OPENING;
        }
    } else if (!b->flight.on || e->seq != b->seq) {
        return; // of a command that nobody waits for any more
    } else if (e->kind == CAMERA_OBJECT) {
        if (r->phase == PHASE_COLLECT && r->purpose != FOR_LAG && entry(r, i)->expected && b->flight.kind == CAMERA_COLLECT)
            note_object(r, i, &e->object[0]);
    } else if (e->kind == CAMERA_PROGRESS) {
        if (e->size_bytes > b->bytes_now) { // only bytes count
            b->bytes_now = e->size_bytes;
            b->flight.since_ns = now;
            b->flight.due_ns = now + PROGRESS_MS * MS < b->flight.limit_ns ? now + PROGRESS_MS * MS : b->flight.limit_ns;
        }
    } else {
        const int k = b->flight.object;
        const enum camera_command_kind kind = b->flight.kind;
        flight_ends(r, b);
        if (e->command != kind) {
            char why[120];
            snprintf(why, sizeof(why), "its worker answered %s to %s", camera_command_name(e->command), camera_command_name(kind));
            kill_worker(r, i);
            trouble(r, i, now, b->flight.since_ns, kind, why);
        } else if (e->kind == CAMERA_DONE) {
            done(r, i, now, e, k);
        } else if (e->trouble == CAMERA_BUSY) {
            busy(r, i, now, e);
        } else if (e->trouble == CAMERA_WRONG) {
            char why[200];
            explain(why, e->text, remedy(CAMERA_WRONG));
            quarantine(r, i, now, why);
        } else if (e->trouble == CAMERA_LOST || e->trouble == CAMERA_STALLED || e->trouble == CAMERA_BROKEN) {
            char found[300], why[200];
            snprintf(found, sizeof(found), "%s, %s: %s", camera_command_name(kind), camera_trouble_name(e->trouble), e->text);
            explain(why, found, remedy(e->trouble));
            trouble(r, i, now, b->flight.since_ns, kind, why);
        } else {
            failed_softly(r, i, now, e, k);
        }
        if (is_copy(kind))
            copy_next(r, b->config->controller, now);
    }
    pump(r, i, now);
    settle(r, now);
}

void rig_worker_gone(struct rig *r, int64_t now, int i, const char *how)
{
    struct body *b = &r->body[i];
    const bool expected = b->killing;
    const bool in_flight = b->flight.on;
    const enum camera_command_kind suspect = in_flight ? b->flight.kind : CAMERA_OPEN;
    const bool copied = in_flight && is_copy(b->flight.kind);
    flight_ends(r, b);
    b->worker = b->greeted = b->killing = false;
    b->press = false;
    if (b->condition == RIG_QUARANTINED || b->condition == RIG_OFF) {
        ;
    } else if (expected) {
        start_worker(r, i, now); // a rung of the ladder
    } else {
        char why[200];
        snprintf(why, sizeof(why), "its worker ended (%.60s) during %s; %s", how, camera_command_name(suspect), remedy(CAMERA_BROKEN));
        trouble(r, i, now, in_flight ? b->flight.since_ns : now, suspect, why);
    }
    if (copied)
        copy_next(r, b->config->controller, now);
    settle(r, now);
}

// ---- time ------------------------------------------------------------------------------------------------------------------------------

static void body_time(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    if (b->worker && !b->greeted && !b->killing && now >= b->greet_due_ns) {
        kill_worker(r, i);
        trouble(r, i, now, now, CAMERA_OPEN, "its worker does not start; look into the journal");
    }
    if (b->flight.on && now >= b->flight.due_ns) {
        const enum camera_command_kind kind = b->flight.kind;
        const bool copy = is_copy(kind);
        char why[200];
        snprintf(why, sizeof(why), "no answer to %s in time; %s", camera_command_name(kind), remedy(CAMERA_STALLED));
        kill_worker(r, i);
        trouble(r, i, now, b->flight.since_ns, kind, why);
        if (copy)
            copy_next(r, b->config->controller, now);
    }
    if (b->condition == RIG_RECOVERING && now >= b->trouble_ns + TROUBLE_MS * MS)
        quarantine(r, i, now, b->note);
    if (b->condition == RIG_RECOVERING && b->supply != WIRED && now >= b->retry_ns) {
        const bool relay = b->supply == RELAY_IS_CUT;
        restore_supply(r, i);
        b->retry_ns = now + (relay ? RELAY_ON_MS : POWER_ON_MS) * MS;
    }
    if (b->condition == RIG_QUARANTINED && r->phase == PHASE_IDLE && !b->worker && now >= b->again_ns) {
        b->condition = RIG_RECOVERING;
        b->trouble_ns = now;
        b->rung = 1; // the next one resets its port
        b->suspect = CAMERA_OPEN;
        start_worker(r, i, now);
    }
    if (b->flight.on || !b->greeted || now < b->retry_ns)
        return;
    if (b->retry_ns || (b->condition == RIG_READY && r->phase == PHASE_IDLE && now >= b->heartbeat_ns)) {
        b->retry_ns = 0; // whatever comes of it: a time in the past must not wake us again
        pump(r, i, now);
    }
}

void rig_time(struct rig *r, int64_t now)
{
    for (int i = 0; i < r->n; i++)
        body_time(r, i, now);
    if ((r->phase == PHASE_PREFLIGHT || r->phase == PHASE_ARM) && now >= r->phase_due_ns) {
        for (int i = 0; i < r->n; i++)
            give_up(r, i, r->body[i].note[0] ? r->body[i].note : "not ready in time; check cable and power");
        if (r->phase == PHASE_PREFLIGHT && !r->space_known) {
            r->space_known = true;
            r->free_bytes = -ETIMEDOUT;
        }
    }
    if (r->phase == PHASE_FIRE && now >= r->phase_due_ns) {
        say(r, RIG_ERROR, CONFIG_NONE, "the trigger did not report the shot; its lines are released");
        act(r, RIG_RELEASE, CONFIG_NONE);
        rig_fired(r, now, -EIO, r->at_ns, -1);
    }
    settle(r, now);
}

static int64_t sooner(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

int64_t rig_deadline_ns(const struct rig *r)
{
    int64_t due = INT64_MAX;
    const bool silent = is_silent(r);
    for (int i = 0; i < r->n; i++) {
        const struct body *b = &r->body[i];
        if (b->worker && !b->greeted && !b->killing)
            due = sooner(due, b->greet_due_ns);
        if (b->flight.on)
            due = sooner(due, b->flight.due_ns);
        else if (b->retry_ns && (b->supply != WIRED || (b->greeted && !silent)))
            due = sooner(due, b->retry_ns);
        else if (b->condition == RIG_READY && r->phase == PHASE_IDLE)
            due = sooner(due, b->heartbeat_ns);
        if (b->condition == RIG_RECOVERING)
            due = sooner(due, b->trouble_ns + TROUBLE_MS * MS);
        if (b->condition == RIG_QUARANTINED && r->phase == PHASE_IDLE && !b->worker)
            due = sooner(due, b->again_ns);
    }
    if (r->phase == PHASE_PREFLIGHT || r->phase == PHASE_ARM || r->phase == PHASE_FIRE)
        due = sooner(due, r->phase_due_ns);
    if (r->phase == PHASE_EXPOSE)
        due = sooner(due, r->quiet_until_ns);
    if (r->created && !r->committing && r->change != r->durable)
        due = sooner(due, r->commit_retry_ns);
    return due;
}

// ---- answers of trigger and disk ------------------------------------------------------------------------------------------------------------

void rig_trigger_is(struct rig *r, int64_t now, int abilities)
{
    r->abilities = abilities;
    settle(r, now);
}

void rig_press_camera(struct rig *r, int64_t now, int i)
{
    if (r->phase != PHASE_FIRE || !r->body[i].part)
        return;
    r->body[i].press = true;
    pump(r, i, now);
    settle(r, now);
}

void rig_feedback(struct rig *r, int64_t now, int i, int64_t at_ns)
{
    (void)now;
    struct body *b = &r->body[i];
    const bool shooting = r->phase == PHASE_FIRE || r->phase == PHASE_EXPOSE || r->phase == PHASE_COLLECT;
    if (shooting && b->part && b->flash_ns == INT64_MIN && at_ns >= r->at_ns - MS)
        b->flash_ns = at_ns;
    if (r->phase == PHASE_EXPOSE)
        r->quiet_until_ns = quiet_until_ns(r);
}

void rig_fired(struct rig *r, int64_t now, int err, int64_t pressed_ns, int64_t late_ns)
{
    if (r->phase != PHASE_FIRE)
        return;
    const bool refused = err == -ETIME || err == -EBUSY || err == -EINVAL || err == -ENODEV;
    if (err == -ETIME && ++r->n_fire_tries < FIRE_TRIES_MAX) {
        begin_fire(r, now);
    } else if (refused) {
        fail_take(r, now, "the trigger refused the shot: %s; no shutter was pressed", strerror(-err));
    } else {
        if (err)
            say(r, RIG_ERROR, CONFIG_NONE, "trigger: %s in the middle of a shot; what the cameras wrote is collected", strerror(-err));
        r->pressed_ns = pressed_ns ? pressed_ns : r->at_ns;
        r->late_ns = late_ns;
        r->shot_ns = r->pressed_ns;
        r->released_ns = now;
        r->quiet_until_ns = quiet_until_ns(r);
        r->phase = PHASE_EXPOSE;
        if (r->purpose == FOR_TAKE) {
            r->ledger.synchronised = r->abilities >= 0 && (r->abilities & TRIGGER_SYNCHRONISED);
            r->ledger.jitter_ns = late_ns;
            r->ledger.shot_utc_ms = r->utc_ms + (r->pressed_ns - r->utc_at_ns) / MS;
            set_state(r, TAKE_EXPOSING);
        }
    }
    settle(r, now);
}

void rig_space(struct rig *r, int64_t now, int64_t free_bytes)
{
    r->space_known = true;
    r->free_bytes = free_bytes;
    settle(r, now);
}

void rig_committed(struct rig *r, int64_t now, int err)
{
    if (!r->committing)
        return;
    r->committing = false;
    if (r->phase == PHASE_CREATE) {
        if (err) {
            fail_take(r, now, "its folder cannot be created: %s; free space or choose another folder; no shutter was pressed", strerror(-err));
        } else {
            r->created = true;
            r->durable = r->covered;
            if (r->cancelled)
                fail_take(r, now, "cancelled");
            else
                begin_fire(r, now);
        }
    } else if (!err) {
        r->n_commit_failures = 0;
        r->durable = r->covered;
        if (r->phase == PHASE_COLLECT)
            pump_all(r, now);
    } else {
        r->commit_retry_ns = now + S;
        if (!r->n_commit_failures++)
            say(r, RIG_ERROR, CONFIG_NONE, "take %s: its ledger cannot be written: %s; free space or mend the disk. Frames stay on the cards", r->ledger.id, strerror(-err));
        if (r->n_commit_failures >= COMMIT_TRIES_MAX) {
            snprintf(r->outcome, sizeof(r->outcome), "its ledger cannot be written: %s; mend that, then rigctl resume", strerror(-err));
            memcpy(r->ledger.reason, r->outcome, sizeof(r->ledger.reason));
            r->ledger.state = TAKE_FAILED;
            r->created = false; // no more attempts: what is on disk stands
            r->durable = r->change;
            for (int i = 0; i < r->n; i++)
                if (r->body[i].flight.on && (is_copy(r->body[i].flight.kind) || r->body[i].flight.kind == CAMERA_DELETE)) {
                    kill_worker(r, i);
                    r->body[i].condition = RIG_RECOVERING;
                    r->body[i].trouble_ns = now;
                    r->body[i].suspect = CAMERA_OPEN;
                }
            finish(r, now);
        }
    }
    settle(r, now);
}

void rig_manifest_written(struct rig *r, int64_t now, int err)
{
    if (r->phase == PHASE_MANIFEST)
        conclude(r, err);
    settle(r, now);
}

// ---- requests -------------------------------------------------------------------------------------------------------------------------------

static int may_begin(const struct rig *r, bool needs_trigger, char *why)
{
    if (r->phase != PHASE_IDLE) {
        snprintf(why, 200, "a %s is under way (%s); wait for it", r->purpose == FOR_TAKE || r->purpose == FOR_RESUME ? "take" : "preflight or calibration", take_state_name(rig_state(r)));
        return -EBUSY;
    }
    if (needs_trigger && r->abilities < 0) {
        snprintf(why, 200, "there is no working trigger; rigctl doctor says why");
        return -ENOTCONN;
    }
    return 0;
}

static void new_ledger(struct rig *r)
{
    ledger_free(&r->ledger);
    ledger_init(&r->ledger, r->config);
    if (!r->ledger.camera)
        abort();
    r->has_ledger = true;
    r->created = r->committing = false;
    r->change = r->durable = r->covered = 0;
    r->n_commit_failures = r->n_fire_tries = 0;
    r->commit_retry_ns = 0;
    r->shot_ns = 0;
}

int rig_capture(struct rig *r, int64_t now, const struct rig_take *take, bool without_missing, char *why)
{
    const int err = may_begin(r, true, why);
    if (err)
        return err;
    new_ledger(r);
    snprintf(r->ledger.id, sizeof(r->ledger.id), "%s", take->id);
    snprintf(r->ledger.name, sizeof(r->ledger.name), "%s", take->name);
    snprintf(r->ledger.created, sizeof(r->ledger.created), "%s", take->created);
    snprintf(r->takes_dir, sizeof(r->takes_dir), "%s", take->takes_dir);
    r->outcome[0] = 0;
    r->utc_ms = take->utc_ms;
    r->utc_at_ns = now;
    r->without_missing = without_missing;
    r->purpose = FOR_TAKE;
    set_state(r, TAKE_PREFLIGHT);
    begin_preflight(r, now);
    settle(r, now);
    return 0;
}

int rig_preflight(struct rig *r, int64_t now, char *why)
{
    const int err = may_begin(r, false, why);
    if (err)
        return err;
    r->purpose = FOR_PREFLIGHT;
    r->outcome[0] = 0;
    begin_preflight(r, now);
    settle(r, now);
    return 0;
}

int rig_calibrate(struct rig *r, int64_t now, int n_shots, char *why)
{
    const int err = may_begin(r, true, why);
    if (err)
        return err;
    if (!(r->abilities & TRIGGER_FEEDBACK)) {
        snprintf(why, 200, "the trigger has no flash-sync inputs: lag cannot be measured; wire feedback_line in rigd.conf");
        return -EINVAL;
    }
    if (n_shots < 3 || n_shots > 1000) {
        snprintf(why, 200, "found %d shots, expected 3 to 1000", n_shots);
        return -EINVAL;
    }
    for (int i = 0; i < r->n; i++) {
        double *grown = realloc(r->body[i].sample_ms, (size_t)n_shots * sizeof(double));
        if (!grown) {
            snprintf(why, 200, "out of memory");
            return -ENOMEM;
        }
        r->body[i].sample_ms = grown;
        r->body[i].n_samples = 0;
    }
    r->purpose = FOR_LAG;
    r->outcome[0] = 0;
    r->without_missing = true;
    r->n_shots = 0;
    r->n_fire_tries = 0;
    r->n_shots_wanted = n_shots;
    begin_preflight(r, now);
    settle(r, now);
    return 0;
}

// Entries follow the bodies by serial number, else by name; who is no longer configured goes last and stays missed.
static bool adopt(struct rig *r, struct ledger *old)
{
    struct ledger fresh;
    int n_left = 0;
    ledger_init(&fresh, r->config);
    bool *used = calloc((size_t)old->n_cameras + 1, sizeof(*used));
    if (!fresh.camera || !used)
        goto fail;
    for (int i = 0; i < r->n; i++) {
        const char *serial = r->body[i].facts.serial[0] ? r->body[i].facts.serial : r->config->camera[i].serial;
        int match = -1;
        for (int k = 0; k < old->n_cameras && match < 0; k++)
            if (!used[k] && serial[0] && !strcmp(old->camera[k].serial, serial))
                match = k;
        for (int k = 0; k < old->n_cameras && match < 0; k++)
            if (!used[k] && !strcmp(old->camera[k].name, r->config->camera[i].name) && (!serial[0] || !old->camera[k].serial[0]))
                match = k;
        fresh.camera[i].expected = false; // a camera that this take does not know
        if (match >= 0) {
            fresh.camera[i] = old->camera[match];
            used[match] = true;
        }
    }
    for (int k = 0; k < old->n_cameras; k++)
        n_left += !used[k];
    struct ledger_camera *grown = realloc(fresh.camera, (size_t)(r->n + n_left) * sizeof(*grown));
    if (!grown)
        goto fail;
    fresh.camera = grown;
    for (int k = 0; k < old->n_cameras; k++) {
        if (used[k])
            continue;
        struct ledger_camera *c = &fresh.camera[fresh.n_cameras++];
        *c = old->camera[k];
        if (c->expected && c->debt != DEBT_PAID) {
            c->debt = DEBT_MISSED;
            snprintf(c->note, sizeof(c->note), "no camera with its serial number is configured any more; its frames stay on its card");
        }
    }
    free(used);
    struct ledger_camera *cameras = fresh.camera;
    const int n = fresh.n_cameras;
    ledger_free(&r->ledger);
    r->ledger = *old;
    free(old->camera);
    *old = (struct ledger){ 0 };
    r->ledger.camera = cameras;
    r->ledger.n_cameras = n;
    return true;
fail:
    free(used);
    ledger_free(&fresh);
    return false;
}

int rig_resume(struct rig *r, int64_t now, struct ledger *old, const char *takes_dir, char *why)
{
    const int err = may_begin(r, false, why);
    if (err)
        return err;
    new_ledger(r);
    if (!adopt(r, old)) {
        snprintf(why, 200, "out of memory");
        return -ENOMEM;
    }
    snprintf(r->takes_dir, sizeof(r->takes_dir), "%s", takes_dir);
    r->purpose = FOR_RESUME;
    r->outcome[0] = 0;
    r->cancelled = false;
    r->created = true;
    r->phase = PHASE_COLLECT;
    r->n_findings = 0;
    set_state(r, TAKE_COLLECTING);
    changed(r);
    for (int i = 0; i < r->n; i++) {
        struct body *b = &r->body[i];
        struct ledger_camera *c = entry(r, i);
        bool owes = c->expected && c->debt != DEBT_PAID;
        for (int k = 0; k < c->n_objects; k++) {
            owes |= c->object[k].state == OBJECT_FOUND;
            b->noted[k] = r->change;
        }
        b->part = c->expected;
        b->saw_nothing = false;
        b->thumbed = true;
        b->owed_due_ns = now + RECONCILE_MS * MS;
        if (!owes)
            continue;
        c->debt = DEBT_OPEN;
        begin_reconcile(r, i, now);
        if (b->condition == RIG_QUARANTINED) // a person asks: try once more, now
            b->again_ns = now;
    }
    for (int i = 0; i < r->n; i++) {
        struct body *b = &r->body[i];
        if (b->step == STEP_RECONCILE && b->condition == RIG_QUARANTINED)
            rig_reinstate(r, now, i, why);
        if (b->step == STEP_RECONCILE && b->facts.serial[0] && entry(r, i)->serial[0] && strcmp(b->facts.serial, entry(r, i)->serial))
            give_up(r, i, "another body hangs in its place now; put the one with its serial number back, then rigctl resume");
    }
    pump_all(r, now);
    settle(r, now);
    return 0;
}

int rig_identify(struct rig *r, int64_t now, int i, char *why)
{
    if (i < 0 || i >= r->n) {
        snprintf(why, 200, "no such camera");
        return -EINVAL;
    }
    if (r->phase != PHASE_IDLE || r->body[i].condition != RIG_READY) {
        snprintf(why, 200, "%s", r->phase != PHASE_IDLE ? "a take is under way; wait for it" : "this camera does not answer");
        return -EBUSY;
    }
    r->body[i].identify = true;
    pump(r, i, now);
    return 0;
}

int rig_reinstate(struct rig *r, int64_t now, int i, char *why)
{
    if (i < 0 || i >= r->n) {
        snprintf(why, 200, "no such camera");
        return -EINVAL;
    }
    struct body *b = &r->body[i];
    if (b->condition != RIG_QUARANTINED)
        return 0;
    b->condition = RIG_RECOVERING;
    b->trouble_ns = now;
    b->rung = 0;
    b->suspect = CAMERA_OPEN;
    if (!b->worker)
        start_worker(r, i, now); // else it is being killed: its end starts the next
    return 0;
}

int rig_cancel(struct rig *r, int64_t now, char *why)
{
    if (r->phase == PHASE_IDLE) {
        snprintf(why, 200, "nothing is under way");
        return -EINVAL;
    }
    r->cancelled = true;
    if (r->phase == PHASE_PREFLIGHT || r->phase == PHASE_ARM)
        fail_take(r, now, "cancelled");
    else if (r->phase == PHASE_FIRE)
        act(r, RIG_RELEASE, CONFIG_NONE);
    settle(r, now);
    return 0;
}

void rig_stop(struct rig *r, int64_t now)
{
    (void)now;
    act(r, RIG_RELEASE, CONFIG_NONE);
    for (int i = 0; i < r->n; i++)
        restore_supply(r, i);
}

void rig_start(struct rig *r, int64_t now)
{
    start_more(r, now);
    settle(r, now);
}

// ---- life and views -------------------------------------------------------------------------------------------------------------------------

int rig_create(struct rig **out, const struct config *config)
{
    struct rig *r = calloc(1, sizeof(*r));
    if (!r)
        return -ENOMEM;
    r->config = config;
    r->n = config->n_cameras;
    r->abilities = -1;
    r->body = calloc((size_t)r->n + 1, sizeof(*r->body));
    r->delay_us = calloc((size_t)r->n + 1, sizeof(*r->delay_us));
    r->finding = calloc(FINDINGS_MAX, sizeof(*r->finding));
    if (!r->body || !r->delay_us || !r->finding) {
        rig_free(r);
        return -ENOMEM;
    }
    for (int i = 0; i < r->n; i++) {
        struct body *b = &r->body[i];
        b->config = &config->camera[i];
        b->flash_ns = INT64_MIN;
        b->status = (struct camera_status){ -1, -1, -1, -1, NAN, -1, -1, -1, "" };
    }
    *out = r;
    return 0;
}

void rig_free(struct rig *r)
{
    if (!r)
        return;
    for (int i = 0; r->body && i < r->n; i++)
        free(r->body[i].sample_ms);
    ledger_free(&r->ledger);
    free(r->body);
    free(r->delay_us);
    free(r->finding);
    free(r->queue);
    free(r);
}

struct rig_camera_view rig_camera(const struct rig *r, int i)
{
    const struct body *b = &r->body[i];
    return (struct rig_camera_view){
        .condition = b->condition, .busy = b->flight.on, .command = b->flight.kind, .note = b->note, .facts = &b->facts, .status = &b->status,
        .setting = b->setting, .n_settings = b->n_settings, .lag = b->lag, .n_recoveries = b->n_recoveries, .bytes_now = b->bytes_now,
    };
}

int rig_n_findings(const struct rig *r)
{
    return r->n_findings;
}

const struct rig_finding *rig_finding(const struct rig *r, int i)
{
    return &r->finding[i];
}

const char *rig_outcome(const struct rig *r)
{
    return r->outcome;
}

enum take_state rig_state(const struct rig *r)
{
    if (r->phase == PHASE_IDLE)
        return TAKE_IDLE;
    if (r->purpose == FOR_TAKE || r->purpose == FOR_RESUME)
        return r->ledger.state;
    return r->phase == PHASE_PREFLIGHT ? TAKE_PREFLIGHT : r->phase == PHASE_COLLECT ? TAKE_COLLECTING : r->phase == PHASE_ARM ? TAKE_ARMED : TAKE_EXPOSING;
}

bool rig_is_busy(const struct rig *r)
{
    return r->phase != PHASE_IDLE;
}

const struct ledger *rig_ledger(const struct rig *r)
{
    return r->has_ledger ? &r->ledger : NULL;
}

void rig_set_lag(struct rig *r, const struct lag *lag)
{
    for (int i = 0; i < r->n; i++)
        r->body[i].lag = lag[i];
}

const char *rig_condition_name(enum rig_condition c)
{
    static const char *const names[] = { "off", "starting", "opening", "ready", "recovering", "quarantined" };
    return (unsigned)c < sizeof(names) / sizeof(names[0]) ? names[c] : "?";
}
