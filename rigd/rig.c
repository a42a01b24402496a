// rigd/rig.c - the rig as a state machine: what is asked of it, what time does to it, and when a phase is over.
//
// Two layers. A *body* (rig_body.c, rig_answers.c) is one camera with its worker: it has at most one command in flight, climbs the
// ladder when in trouble, and in each phase works off its step. A *phase* (rig_take.c) belongs to the rig and ends when no body has a
// step left (n_pending == 0), when the answer it waits for is here, or at its deadline. Nothing else moves the rig on: every input ends
// in rig_settle(), which looks whether a phase is over and whether the ledger has to be written.
#include "rigd/rig_inside.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// ---- actions -----------------------------------------------------------------------------------------------------------------

struct rig_action *rig_act(struct rig *r, enum rig_action_kind kind, int camera)
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

__attribute__((format(printf, 4, 5))) void rig_say(struct rig *r, enum rig_severity severity, int camera, const char *format, ...)
{
    struct rig_action *a = rig_act(r, RIG_SAY, camera);
    va_list args;
    a->severity = severity;
    int n = 0;
    if (camera != CONFIG_NONE)
        n = snprintf(a->text, sizeof(a->text), "camera %s (%s): ", r->config->camera[camera].name, r->config->camera[camera].port);
    va_start(args, format);
    vsnprintf(a->text + n, sizeof(a->text) - (size_t)n, format, args);
    va_end(args);
}

__attribute__((format(printf, 4, 5))) void rig_find(struct rig *r, enum rig_severity severity, int camera, const char *format, ...)
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

uint64_t rig_changed(struct rig *r)
{
    return ++r->change;
}

static void flush(struct rig *r, int64_t now)
{
    if (!r->created || r->committing || r->change == r->durable || now < r->commit_retry_ns)
        return;
    r->committing = true;
    r->covered = r->change;
    rig_act(r, RIG_COMMIT, CONFIG_NONE);
}

void rig_set_state(struct rig *r, enum take_state state)
{
    if (r->ledger.state == state)
        return;
    r->ledger.state = state;
    rig_changed(r);
    rig_act(r, RIG_STATE, CONFIG_NONE);
}

struct ledger_camera *rig_entry(struct rig *r, int i)
{
    return &r->ledger.camera[r->purpose == FOR_PANORAMA ? r->panorama.entry : i];
}
// Move on as long as a phase is over; then see to the ledger.
void rig_settle(struct rig *r, int64_t now)
{
    for (enum phase before = -1; before != r->phase;) {
        before = r->phase;
        switch (r->phase) {
        case PHASE_IDLE:
            break;
        case PHASE_PREFLIGHT:
            if (!r->n_pending && r->space_known)
                rig_end_preflight(r, now);
            break;
        case PHASE_ARM:
            if (r->n_pending || rig_too_many_missing(r, now))
                break;
            if (r->purpose == FOR_LAG) {
                rig_begin_fire(r, now);
            } else {
                r->phase = PHASE_CREATE;
                rig_set_state(r, TAKE_ARMED);
                r->committing = true;
                r->covered = r->change;
                rig_act(r, RIG_CREATE, CONFIG_NONE);
            }
            break;
        case PHASE_TURN:
        case PHASE_STILL:
        case PHASE_ADJUST:
        case PHASE_NOTE:
            rig_panorama_phase_over(r, now);
            break;
        case PHASE_CREATE:
        case PHASE_FIRE:
        case PHASE_MANIFEST:
            break; // an answer is awaited
        case PHASE_EXPOSE:
            if (now >= r->quiet_until_ns)
                rig_begin_collect(r, now);
            break;
        case PHASE_COLLECT:
            if (!r->n_pending)
                rig_end_collect(r, now);
            break;
        case PHASE_SETTLE:
            if (r->durable == r->change)
                rig_begin_delete(r, now);
            break;
        case PHASE_DELETE:
            if (!r->n_pending)
                r->phase = PHASE_END;
            break;
        case PHASE_END:
            if (r->durable == r->change)
                rig_finish(r, now);
            break;
        }
    }
    flush(r, now);
}

void rig_time(struct rig *r, int64_t now)
{
    for (int i = 0; i < r->n; i++)
        rig_body_time(r, i, now);
    if ((r->phase == PHASE_PREFLIGHT || r->phase == PHASE_ARM) && now >= r->phase_due_ns) {
        for (int i = 0; i < r->n; i++)
            rig_give_up(r, i, r->body[i].note[0] ? r->body[i].note : "not ready in time; check cable and power");
        if (r->phase == PHASE_PREFLIGHT && !r->space_known) {
            r->space_known = true;
            r->free_bytes = -ETIMEDOUT;
        }
    }
    if (now >= r->phase_due_ns)
        rig_panorama_time(r, now);
    if (r->phase == PHASE_FIRE && now >= r->phase_due_ns) {
        rig_say(r, RIG_ERROR, CONFIG_NONE, "the trigger did not report the shot; its lines are released");
        rig_act(r, RIG_RELEASE, CONFIG_NONE);
        rig_fired(r, now, -EIO, r->at_ns, -1);
    }
    rig_settle(r, now);
}

static int64_t sooner(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

int64_t rig_deadline_ns(const struct rig *r)
{
    int64_t due = INT64_MAX;
    const bool silent = rig_is_silent(r);
    for (int i = 0; i < r->n; i++) {
        const struct body *b = &r->body[i];
        if (b->worker && !b->greeted && !b->killing)
            due = sooner(due, b->greet_due_ns);
        if (b->flight.on)
            due = sooner(due, b->flight.due_ns);
        else if (b->retry_ns && (b->supply != WIRED || (b->greeted && (!silent || b->press))))
            due = sooner(due, b->retry_ns);
        else if (b->condition == RIG_READY && rig_rests(r))
            due = sooner(due, b->heartbeat_ns);
        if (b->condition == RIG_RECOVERING)
            due = sooner(due, b->trouble_ns + TROUBLE_MS * MS);
        if (b->condition == RIG_RECOVERING && b->start_ns && !b->worker)
            due = sooner(due, b->start_ns);
        if (b->condition == RIG_QUARANTINED && r->phase == PHASE_IDLE && !b->worker)
            due = sooner(due, b->again_ns);
    }
    if (r->phase == PHASE_PREFLIGHT || r->phase == PHASE_ARM || r->phase == PHASE_FIRE || r->phase == PHASE_TURN || r->phase == PHASE_STILL || r->phase == PHASE_ADJUST)
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
    if (abilities < 0)
        rig_head_arrived(r, now, -EIO); // if one was asked to move
    rig_settle(r, now);
}
void rig_space(struct rig *r, int64_t now, int64_t free_bytes)
{
    r->space_known = true;
    r->free_bytes = free_bytes;
    rig_settle(r, now);
}

void rig_committed(struct rig *r, int64_t now, int err)
{
    if (!r->committing)
        return;
    r->committing = false;
    if (r->phase == PHASE_CREATE) {
        if (err) {
            rig_fail_take(r, now, "its folder cannot be created: %s; free space or choose another folder; no shutter was pressed", strerror(-err));
        } else {
            r->created = true;
            r->durable = r->covered;
            if (r->cancelled)
                rig_fail_take(r, now, "cancelled");
            else if (r->purpose == FOR_PANORAMA)
                rig_panorama_next(r, now);
            else
                rig_begin_fire(r, now);
        }
    } else if (!err) {
        r->n_commit_failures = 0;
        r->durable = r->covered;
        if (r->phase == PHASE_COLLECT)
            rig_pump_all(r, now);
    } else {
        r->commit_retry_ns = now + S;
        if (!r->n_commit_failures++)
            rig_say(r, RIG_ERROR, CONFIG_NONE, "take %s: its ledger cannot be written: %s; free space or mend the disk. Frames stay on the cards", r->ledger.id, strerror(-err));
        if (r->n_commit_failures >= COMMIT_TRIES_MAX) {
            snprintf(r->outcome, sizeof(r->outcome), "its ledger cannot be written: %s; mend that, then rigctl resume", strerror(-err));
            memcpy(r->ledger.reason, r->outcome, sizeof(r->ledger.reason));
            r->ledger.state = TAKE_FAILED;
            r->created = false; // no more attempts: what is on disk stands
            r->durable = r->change;
            for (int i = 0; i < r->n; i++)
                if (r->body[i].flight.on && (rig_is_copy(r->body[i].flight.kind) || r->body[i].flight.kind == CAMERA_DELETE)) {
                    rig_kill_worker(r, i);
                    r->body[i].condition = RIG_RECOVERING;
                    r->body[i].trouble_ns = now;
                    r->body[i].suspect = CAMERA_OPEN;
                }
            rig_finish(r, now);
        }
    }
    rig_settle(r, now);
}
// ---- requests -------------------------------------------------------------------------------------------------------------------------------

int rig_may_begin(const struct rig *r, bool needs_trigger, char *why)
{
    if (r->phase != PHASE_IDLE) {
        snprintf(why, 200, "a %s is under way (%s); wait for it", r->purpose == FOR_TAKE || r->purpose == FOR_RESUME ? "take" : r->purpose == FOR_PANORAMA ? "panorama" : "preflight or calibration", take_state_name(rig_state(r)));
        return -EBUSY;
    }
    if (needs_trigger && r->abilities < 0) {
        snprintf(why, 200, "there is no working trigger; rigctl doctor says why");
        return -ENOTCONN;
    }
    return 0;
}

// The ledger is the caller's to fill.
void rig_new_ledger(struct rig *r)
{
    ledger_free(&r->ledger);
    r->has_ledger = true;
    r->created = r->committing = false;
    r->change = r->durable = r->covered = 0;
    r->n_commit_failures = r->n_fire_tries = 0;
    r->commit_retry_ns = 0;
    r->shot_ns = r->thumbed_ns = 0;
    r->outcome[0] = 0;
    r->cancelled = false;
}

void rig_name_take(struct rig *r, int64_t now, const struct rig_take *take)
{
    snprintf(r->ledger.id, sizeof(r->ledger.id), "%s", take->id);
    snprintf(r->ledger.name, sizeof(r->ledger.name), "%s", take->name);
    snprintf(r->ledger.created, sizeof(r->ledger.created), "%s", take->created);
    snprintf(r->ledger.panorama_take, sizeof(r->ledger.panorama_take), "%s", take->panorama_take ? take->panorama_take : "");
    snprintf(r->takes_dir, sizeof(r->takes_dir), "%s", take->takes_dir);
    r->utc_ms = take->utc_ms;
    r->utc_at_ns = now;
}

int rig_capture(struct rig *r, int64_t now, const struct rig_take *take, bool without_missing, char *why)
{
    const int err = rig_may_begin(r, true, why);
    if (err)
        return err;
    if (take->on_button && !(r->abilities & TRIGGER_WAITS)) {
        snprintf(why, 200, "this trigger has no button that fires by itself; a trigger board ([trigger] kind = usb) has");
        return -EINVAL;
    }
    rig_new_ledger(r);
    ledger_init(&r->ledger, r->config);
    if (!r->ledger.camera)
        abort();
    rig_name_take(r, now, take);
    r->without_missing = without_missing;
    r->on_button = take->on_button;
    r->purpose = FOR_TAKE;
    rig_set_state(r, TAKE_PREFLIGHT);
    rig_begin_preflight(r, now);
    rig_settle(r, now);
    return 0;
}

int rig_preflight(struct rig *r, int64_t now, char *why)
{
    const int err = rig_may_begin(r, false, why);
    if (err)
        return err;
    r->purpose = FOR_PREFLIGHT;
    r->outcome[0] = 0;
    rig_begin_preflight(r, now);
    rig_settle(r, now);
    return 0;
}

int rig_calibrate(struct rig *r, int64_t now, int n_shots, char *why)
{
    const int err = rig_may_begin(r, true, why);
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
        double *grown = realloc(r->body[i].sample_ms, (size_t)n_shots * CONFIG_SHOTS_FACTOR * sizeof(double));
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
    r->n_shots_most = n_shots * CONFIG_SHOTS_FACTOR;
    rig_begin_preflight(r, now);
    rig_settle(r, now);
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

int rig_resume(struct rig *r, int64_t now, struct ledger *old, const char *takes_dir, bool attended, char *why)
{
    const int err = rig_may_begin(r, false, why);
    if (err)
        return err;
    r->panorama.attended = attended;
    if (old->kind == LEDGER_PANORAMA)
        return rig_resume_panorama(r, now, old, takes_dir, why);
    rig_new_ledger(r);
    if (!adopt(r, old)) {
        snprintf(why, 200, "out of memory");
        return -ENOMEM;
    }
    snprintf(r->takes_dir, sizeof(r->takes_dir), "%s", takes_dir);
    r->purpose = FOR_RESUME;
    r->created = true;
    r->phase = PHASE_COLLECT;
    r->n_findings = 0;
    rig_set_state(r, TAKE_COLLECTING);
    rig_changed(r);
    for (int i = 0; i < r->n; i++) {
        struct body *b = &r->body[i];
        struct ledger_camera *c = rig_entry(r, i);
        bool owes = c->expected && c->debt != DEBT_PAID;
        for (int k = 0; k < c->n_objects; k++) {
            owes |= c->object[k].state == OBJECT_FOUND;
            b->noted[k] = r->change;
        }
        b->part = c->expected;
        b->saw_nothing = false;
        b->thumbed = !r->config->thumbnails; // for the contact sheet
        b->owed_due_ns = now + RECONCILE_MS * MS;
        if (!owes)
            continue;
        c->debt = DEBT_OPEN;
        rig_begin_reconcile(r, i, now);
        if (b->condition == RIG_QUARANTINED) // a person asks: try once more, now
            b->again_ns = now;
    }
    for (int i = 0; i < r->n; i++) {
        struct body *b = &r->body[i];
        if (b->step == STEP_RECONCILE && b->condition == RIG_QUARANTINED)
            rig_reinstate(r, now, i, why);
        if (b->step == STEP_RECONCILE && b->facts.serial[0] && rig_entry(r, i)->serial[0] && strcmp(b->facts.serial, rig_entry(r, i)->serial))
            rig_give_up(r, i, "another body hangs in its place now; put the one with its serial number back, then rigctl resume");
    }
    rig_pump_all(r, now);
    rig_settle(r, now);
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
    r->body[i].identify = r->body[i].identifying = true;
    rig_pump(r, i, now);
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
    b->rung = b->n_starts = 0;
    b->suspect = CAMERA_OPEN;
    if (!b->worker)
        rig_start_worker(r, i, now); // else it is being killed: its end starts the next
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
        rig_fail_take(r, now, "cancelled");
    else if (r->phase == PHASE_TURN || r->phase == PHASE_STILL || r->phase == PHASE_ADJUST || r->phase == PHASE_NOTE)
        rig_fail_take(r, now, "cancelled");
    else if (r->phase == PHASE_FIRE)
        rig_act(r, RIG_RELEASE, CONFIG_NONE);
    rig_settle(r, now);
    return 0;
}

void rig_stop(struct rig *r, int64_t now)
{
    (void)now;
    rig_act(r, RIG_RELEASE, CONFIG_NONE);
    for (int i = 0; i < r->n; i++)
        rig_restore_supply(r, i);
}

void rig_start(struct rig *r, int64_t now)
{
    rig_start_more(r, now);
    rig_settle(r, now);
}

// ---- life and views -------------------------------------------------------------------------------------------------------------------------

static bool judge_through(struct rig *r, const struct lens *lens)
{
    struct json *o = lens_json(lens);
    char *text = json_text(o);
    const bool fits = text && strlen(text) < sizeof(r->panorama.judge);
    if (fits)
        strcpy(r->panorama.judge, text);
    free(text);
    json_free(o);
    return fits;
}

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
    if (config_panorama_camera(config) != CONFIG_NONE && !judge_through(r, &config->panorama.lens)) {
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
    if (r->purpose == FOR_TAKE || r->purpose == FOR_RESUME || r->purpose == FOR_PANORAMA)
        return r->ledger.state;
    return r->phase == PHASE_PREFLIGHT ? TAKE_PREFLIGHT : r->phase == PHASE_COLLECT ? TAKE_COLLECTING : r->phase == PHASE_ARM ? TAKE_ARMED : TAKE_EXPOSING;
}

bool rig_waits_for_button(const struct rig *r)
{
    return r->phase == PHASE_FIRE && r->purpose == FOR_TAKE && r->on_button;
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
