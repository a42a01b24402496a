// rigd/rig_body.c - one camera with its worker: its steps and commands, and the ladder it climbs when it is in trouble.
#include "rigd/rig_inside.h"

#include <assert.h>
#include <stdio.h>
#include <string.h>

// ---- steps ---------------------------------------------------------------------------------------------------------------------

void rig_set_step(struct rig *r, int i, enum step step)
{
    struct body *b = &r->body[i];
    r->n_pending += (step != STEP_NONE) - (b->step != STEP_NONE);
    b->step = step;
    b->n_failed = 0;
}

// What to do about trouble, for people.
const char *rig_remedy(enum camera_trouble trouble)
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
void rig_explain(char why[200], const char *found, const char *to_do)
{
    const int room = 199 - (int)strlen(to_do) - 2, n = (int)strlen(found);
    if (n <= room)
        snprintf(why, 200, "%s; %s", found, to_do);
    else
        snprintf(why, 200, "%.*s...; %s", room - 3, found, to_do);
}

// Before the shot: this body takes no part. After it: its frames are missed, for now.
void rig_give_up(struct rig *r, int i, const char *why)
{
    struct body *b = &r->body[i];
    if (b->step == STEP_NONE)
        return;
    const enum step step = b->step;
    rig_set_step(r, i, STEP_NONE);
    if (r->phase == PHASE_ADJUST) {
        snprintf(r->panorama.lost, sizeof(r->panorama.lost), "%.199s", why);
    } else if (r->phase == PHASE_PREFLIGHT || r->phase == PHASE_ARM) {
        b->part = false;
        rig_find(r, RIG_ERROR, i, "%s", why);
        if (r->purpose == FOR_TAKE) {
            rig_entry(r, i)->expected = false;
            snprintf(rig_entry(r, i)->note, sizeof(rig_entry(r, i)->note), "left out: %.180s", why);
        }
    } else if (r->phase == PHASE_COLLECT && r->purpose != FOR_LAG) {
        struct ledger_camera *c = rig_entry(r, i);
        c->debt = DEBT_MISSED;
        snprintf(c->note, sizeof(c->note), "%.199s", why);
        rig_changed(r);
        if (r->purpose != FOR_PANORAMA || !r->panorama.looking)
            rig_say(r, r->purpose == FOR_PANORAMA ? RIG_WARNING : RIG_ERROR, i, "its frame was not fetched: %s", why);
    } else if (r->phase == PHASE_DELETE && step == STEP_DELETE) {
        rig_say(r, RIG_WARNING, i, "frames stay on its card, they were not deleted: %s", why);
    }
}

// ---- commands ------------------------------------------------------------------------------------------------------------------

// Between the last answer before half-press and the end of the exposure no camera hears anything.
bool rig_is_silent(const struct rig *r)
{
    return r->phase == PHASE_CREATE || r->phase == PHASE_NOTE || r->phase == PHASE_FIRE || r->phase == PHASE_EXPOSE;
}

// Nothing is wanted of any camera but a sign of life. (A person may take minutes to turn a head.)
bool rig_rests(const struct rig *r)
{
    return r->phase == PHASE_IDLE || r->phase == PHASE_TURN;
}

static struct camera_command *send(struct rig *r, int i, int64_t now, enum camera_command_kind kind, uint32_t timeout_ms)
{
    struct body *b = &r->body[i];
    struct camera_command *c = &rig_act(r, RIG_SEND, i)->command;
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

bool rig_is_copy(enum camera_command_kind kind)
{
    return kind == CAMERA_FETCH || kind == CAMERA_THUMBNAIL;
}

void rig_flight_ends(struct rig *r, struct body *b)
{
    if (b->flight.on && rig_is_copy(b->flight.kind))
        r->copying[b->config->controller]--;
    b->flight.on = false;
    b->bytes_now = 0;
}

// The next object to copy: its name is durable. -1: none now.
static int to_copy(struct rig *r, int i)
{
    const struct ledger_camera *c = rig_entry(r, i);
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
void rig_copy_next(struct rig *r, int controller, int64_t now)
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
        const struct ledger_object *o = &rig_entry(r, i)->object[k];
        char file[96];
        struct camera_command *c;
        if (thumbnail >= 0) {
            c = send(r, i, now, CAMERA_THUMBNAIL, 5000);
            snprintf(file, sizeof(file), "thumbnails/%s.jpg", rig_entry(r, i)->name);
            take_path(r, c->path, sizeof(c->path), file);
        } else {
            c = send(r, i, now, CAMERA_FETCH, r->config->fetch_timeout_ms);
            b->flight.due_ns = now + (r->purpose == FOR_PANORAMA ? 2 : 1) * PROGRESS_MS * MS; // it is judged, too
            if (r->purpose == FOR_PANORAMA)
                memcpy(c->judge, r->panorama.judge, sizeof(c->judge));
            take_path(r, c->path, sizeof(c->path), o->file);
        }
        c->object = o->object;
        b->flight.object = k;
        r->copying[controller]++;
    }
}

// The exposure that is wanted in place of the configuration's.
static void set_shutter(struct camera_command *c, const char *label)
{
    int k = 0;
    while (k < c->n_settings && strcmp(c->setting[k].name, "shutter"))
        k++;
    if (k == CAMERA_SETTINGS_MAX)
        return; // config.c leaves room
    c->n_settings += k == c->n_settings;
    snprintf(c->setting[k].name, sizeof(c->setting[k].name), "shutter");
    snprintf(c->setting[k].value, sizeof(c->setting[k].value), "%s", label);
}

static void reconcile_next(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    struct camera_command *c = send(r, i, now, CAMERA_LIST, 6000);
    c->n_objects = CAMERA_LISTING_MAX;
    c->n_after = b->n_cursor;
    memcpy(c->after, b->cursor, sizeof(c->after));
}

void rig_begin_reconcile(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    const struct ledger_camera *c = rig_entry(r, i);
    rig_set_step(r, i, STEP_RECONCILE);
    b->n_cursor = c->n_before;
    memcpy(b->cursor, c->before, sizeof(b->cursor));
    if (!b->owed_due_ns)
        b->owed_due_ns = now + RECONCILE_MS * MS;
}

// What it announced was lost with its connection: to wait for that would be in vain.
void rig_collect_from_card(struct rig *r, int i, int64_t now)
{
    r->body[i].owed_due_ns = now + (RECONCILE_MS + r->config->collect_timeout_ms) * MS;
    rig_begin_reconcile(r, i, now);
}

// Everything this body owes is here?
void rig_look_at_debt(struct rig *r, int i, int64_t now)
{
    struct ledger_camera *c = rig_entry(r, i);
    int n_here = 0;
    for (int k = 0; k < c->n_objects; k++) {
        if (c->object[k].state == OBJECT_FOUND)
            return; // being copied, or waiting for its turn
        n_here += c->object[k].state == OBJECT_COPIED || c->object[k].state == OBJECT_DELETED;
    }
    if (n_here < r->ledger.objects_per_shot && n_here < c->n_objects) {
        rig_give_up(r, i, "a frame that was on its card is neither there nor here any more");
        return;
    }
    if (n_here < r->ledger.objects_per_shot) {
        rig_begin_reconcile(r, i, now);
        return;
    }
    c->debt = DEBT_PAID;
    c->note[0] = 0;
    rig_changed(r);
    rig_set_step(r, i, STEP_NONE);
}

static bool has_copies(const struct ledger_camera *c)
{
    for (int k = 0; k < c->n_objects; k++)
        if (c->object[k].state == OBJECT_COPIED)
            return true;
    return false;
}

int rig_to_delete(struct rig *r, int i)
{
    if (r->purpose == FOR_PANORAMA) // the first entry with something to delete becomes the present one
        for (r->panorama.entry = 0; r->panorama.entry < r->ledger.n_cameras - 1; r->panorama.entry++)
            if (has_copies(rig_entry(r, i)))
                break;
    const struct ledger_camera *c = rig_entry(r, i);
    if (!c->expected)
        return -1;
    for (int k = 0; k < c->n_objects; k++)
        if (c->object[k].state == OBJECT_COPIED)
            return k;
    return -1;
}

void rig_pump(struct rig *r, int i, int64_t now)
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
    if (rig_is_silent(r))
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
        if (rig_makes_panoramas(r, i))
            set_shutter(c, rig_entry(r, i)->exposure.label);
        return;
    case STEP_STATUS:
        send(r, i, now, CAMERA_STATUS, 4000);
        return;
    case STEP_DRAIN:
        send(r, i, now, CAMERA_DRAIN, 5000)->quiet_ms = r->phase == PHASE_ADJUST ? ADJUST_QUIET_MS : DRAIN_QUIET_MS;
        return;
    case STEP_BEFORE:
        send(r, i, now, CAMERA_LIST, 6000);
        return;
    case STEP_COLLECT:
        send(r, i, now, CAMERA_COLLECT, r->config->collect_timeout_ms)->n_objects = r->purpose == FOR_PANORAMA ? 1 : r->config->objects_per_shot;
        return;
    case STEP_RECONCILE:
        reconcile_next(r, i, now);
        return;
    case STEP_COPY:
        rig_copy_next(r, b->config->controller, now);
        return;
    case STEP_DELETE: {
        const int k = rig_to_delete(r, i);
        if (k < 0) {
            rig_set_step(r, i, STEP_NONE);
            return;
        }
        const struct ledger_object *o = &rig_entry(r, i)->object[k];
        c = send(r, i, now, CAMERA_DELETE, 8000);
        c->object = o->object;
        take_path(r, c->path, sizeof(c->path), o->file);
        memcpy(c->xxh128, o->xxh128, sizeof(c->xxh128));
        b->flight.object = k;
        return;
    }
    case STEP_NONE:
        if (rig_rests(r) && now >= b->heartbeat_ns) {
            send(r, i, now, CAMERA_STATUS, 4000);
            b->heartbeat_ns = now + r->config->heartbeat_s * S;
        }
    }
}

void rig_pump_all(struct rig *r, int64_t now)
{
    for (int i = 0; i < r->n; i++)
        rig_pump(r, i, now);
}

// ---- workers and the ladder -------------------------------------------------------------------------------------------------------

void rig_start_worker(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    b->worker = true;
    b->greeted = false;
    b->start_ns = 0;
    b->greet_due_ns = now + GREETING_MS * MS;
    rig_act(r, RIG_SPAWN, i);
}

// A worker that cannot be started, or dies at once, is not started over and over: the loop would do nothing else.
static void start_again(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    if (b->n_starts++ < STARTS_AT_ONCE)
        rig_start_worker(r, i, now);
    else
        b->start_ns = now + REOPEN_MS * MS;
}

void rig_kill_worker(struct rig *r, int i)
{
    struct body *b = &r->body[i];
    rig_flight_ends(r, b);
    b->press = false;
    if (!b->worker || b->killing)
        return;
    b->killing = true;
    rig_act(r, RIG_KILL, i);
}

// At the start: a few at a time. A body in trouble does not queue.
void rig_start_more(struct rig *r, int64_t now)
{
    int n_starting = 0;
    for (int i = 0; i < r->n; i++)
        n_starting += r->body[i].condition == RIG_STARTING || r->body[i].condition == RIG_OPENING;
    for (int i = 0; i < r->n && n_starting < STARTING_MAX; i++)
        if (r->body[i].condition == RIG_OFF) {
            r->body[i].condition = RIG_STARTING;
            rig_start_worker(r, i, now);
            n_starting++;
        }
}

void rig_identified(struct rig *r, int i, const char *why)
{
    struct body *b = &r->body[i];
    if (!b->identifying)
        return;
    b->identify = b->identifying = false;
    struct rig_action *a = rig_act(r, RIG_IDENTIFIED, i);
    snprintf(a->text, sizeof(a->text), "%.199s", why);
}

void rig_restore_supply(struct rig *r, int i)
{
    struct body *b = &r->body[i];
    if (b->supply == POWER_IS_OFF)
        rig_act(r, RIG_POWER, i)->on = true;
    if (b->supply == RELAY_IS_CUT)
        rig_act(r, RIG_RELAY, i)->on = true;
    b->supply = WIRED;
}

void rig_quarantine(struct rig *r, int i, int64_t now, const char *why)
{
    struct body *b = &r->body[i];
    const bool known = b->condition == RIG_QUARANTINED;
    if (why != b->note)
        snprintf(b->note, sizeof(b->note), "%.199s", why);
    rig_restore_supply(r, i);
    rig_kill_worker(r, i);
    b->condition = RIG_QUARANTINED;
    b->again_ns = now + QUARANTINE_MS * MS;
    b->trouble_ns = 0;
    b->rung = 0;
    b->retry_ns = b->start_ns = 0;
    rig_identified(r, i, b->note);
    if (!known)
        rig_say(r, RIG_ERROR, i, "quarantined: %s", b->note);
    rig_give_up(r, i, b->note);
    rig_start_more(r, now);
}

static void climb(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    const bool wired_power = b->config->power[0], wired_relay = b->config->relay_line != CONFIG_NONE && r->abilities >= 0 && (r->abilities & TRIGGER_RELAYS);
    b->condition = RIG_RECOVERING;
    rig_start_more(r, now); // its place at the start is free
    if (rig_is_silent(r)) { // its worker may come again, its port and its supply are left alone: its shutter may be open
        if (!b->worker)
            start_again(r, i, now);
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
        rig_kill_worker(r, i);
        break;
    case 3:
        rig_kill_worker(r, i);
        b->supply = POWER_IS_OFF;
        b->retry_ns = now + POWER_OFF_MS * MS;
        rig_act(r, RIG_POWER, i)->on = false;
        break;
    case 4:
        rig_kill_worker(r, i);
        b->supply = RELAY_IS_CUT;
        b->retry_ns = now + RELAY_OFF_MS * MS;
        rig_act(r, RIG_RELAY, i)->on = false;
        break;
    default: // nothing left but patience
        b->retry_ns = now + REOPEN_MS * MS;
    }
    if (!b->worker)
        start_again(r, i, now);
    rig_pump(r, i, now);
}

// suspect: the command that failed; CAMERA_OPEN for a worker that died without one. since: its last sign of life
void rig_trouble(struct rig *r, int i, int64_t now, int64_t since, enum camera_command_kind suspect, const char *text)
{
    struct body *b = &r->body[i];
    if (b->condition == RIG_QUARANTINED)
        return;
    snprintf(b->note, sizeof(b->note), "%.199s", text);
    b->busy_since_ns = 0;
    rig_identified(r, i, b->note);
    if (suspect == CAMERA_THUMBNAIL)
        b->thumbed = true; // a preview is not worth a second crash
    if (suspect == CAMERA_THUMBNAIL || suspect == CAMERA_IDENTIFY || suspect == CAMERA_TRIGGER)
        suspect = CAMERA_OPEN; // not tried again: reopening is all the proof there will be
    if (b->step == STEP_COLLECT && r->purpose != FOR_LAG) {
        rig_collect_from_card(r, i, now);
        if (suspect == CAMERA_COLLECT)
            suspect = CAMERA_LIST;
    }
    if (!b->trouble_ns) {
        b->trouble_ns = since > now - SILENCE_MS * MS ? since : now - SILENCE_MS * MS;
        b->rung = b->n_starts = 0;
        b->suspect = suspect;
        b->n_recoveries++;
        rig_say(r, RIG_WARNING, i, "%s; recovering", b->note);
    }
    if (now >= b->trouble_ns + TROUBLE_MS * MS)
        rig_quarantine(r, i, now, b->note);
    else
        climb(r, i, now);
}

void rig_works_again(struct rig *r, int i, int64_t now, enum camera_command_kind kind)
{
    struct body *b = &r->body[i];
    if (!b->trouble_ns || (kind != b->suspect && !(kind == CAMERA_STATUS && rig_rests(r))))
        return;
    rig_say(r, RIG_INFO, i, "works again after %.1f s", 1e-9 * (double)(now - b->trouble_ns));
    b->trouble_ns = 0;
    b->rung = 0;
    b->note[0] = 0;
}
// ---- time ------------------------------------------------------------------------------------------------------------------------------

void rig_body_time(struct rig *r, int i, int64_t now)
{
    struct body *b = &r->body[i];
    if (b->worker && !b->greeted && !b->killing && now >= b->greet_due_ns) {
        rig_kill_worker(r, i);
        rig_trouble(r, i, now, now, CAMERA_OPEN, "its worker does not start; look into the journal");
    }
    if (b->flight.on && now >= b->flight.due_ns) {
        const enum camera_command_kind kind = b->flight.kind;
        const bool copy = rig_is_copy(kind);
        char why[200];
        snprintf(why, sizeof(why), "no answer to %s in time; %s", camera_command_name(kind), rig_remedy(CAMERA_STALLED));
        rig_kill_worker(r, i);
        rig_trouble(r, i, now, b->flight.since_ns, kind, why);
        if (copy)
            rig_copy_next(r, b->config->controller, now);
    }
    if (b->condition == RIG_RECOVERING && now >= b->trouble_ns + TROUBLE_MS * MS)
        rig_quarantine(r, i, now, b->note);
    if (b->condition == RIG_RECOVERING && b->supply != WIRED && now >= b->retry_ns) {
        const bool relay = b->supply == RELAY_IS_CUT;
        rig_restore_supply(r, i);
        b->retry_ns = now + (relay ? RELAY_ON_MS : POWER_ON_MS) * MS;
    }
    if (b->condition == RIG_RECOVERING && b->start_ns && now >= b->start_ns && !b->worker)
        rig_start_worker(r, i, now);
    if (b->condition == RIG_QUARANTINED && r->phase == PHASE_IDLE && !b->worker && now >= b->again_ns) {
        b->condition = RIG_RECOVERING;
        b->trouble_ns = now;
        b->n_starts = 0;
        b->rung = 1; // the next one resets its port
        b->suspect = CAMERA_OPEN;
        rig_start_worker(r, i, now);
    }
    if (b->flight.on || !b->greeted || now < b->retry_ns)
        return;
    if (b->retry_ns || (b->condition == RIG_READY && rig_rests(r) && now >= b->heartbeat_ns)) {
        b->retry_ns = 0; // whatever comes of it: a time in the past must not wake us again
        rig_pump(r, i, now);
    }
}
