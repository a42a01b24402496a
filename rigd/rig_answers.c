// rigd/rig_answers.c - what a camera's worker answered, and what follows from it.
#include "rigd/rig_inside.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

// ---- answers of cameras ----------------------------------------------------------------------------------------------------------------

static void note_object(struct rig *r, int i, const struct camera_object *o)
{
    struct ledger_camera *c = rig_entry(r, i);
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
        rig_say(r, RIG_ERROR, i, "more than %d new files on its card: %s stays there", LEDGER_OBJECTS_MAX, o->name);
        return;
    }
    r->body[i].noted[c->n_objects - 1] = rig_changed(r);
    if (c->n_objects > r->ledger.objects_per_shot)
        rig_say(r, RIG_WARNING, i, "%s is one file more than a shot writes; it is fetched too", o->name);
}

static void listed(struct rig *r, int i, int64_t now, const struct camera_event *e)
{
    struct body *b = &r->body[i];
    struct ledger_camera *c = rig_entry(r, i);
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
        rig_set_step(r, i, STEP_COPY);
        rig_look_at_debt(r, i, now);
    } else if (now < b->owed_due_ns) {
        rig_begin_reconcile(r, i, now);
        b->retry_ns = now + 500 * MS;
    } else {
        char why[160];
        snprintf(why, sizeof(why), "%d of %d frames on its card; did its shutter open? Check shutter cable, lens and mode", c->n_objects, r->ledger.objects_per_shot);
        rig_give_up(r, i, why);
    }
}

static void done(struct rig *r, int i, int64_t now, const struct camera_event *e, int k)
{
    struct body *b = &r->body[i];
    const bool keeps_frames = r->purpose == FOR_TAKE || r->purpose == FOR_RESUME || rig_makes_panoramas(r, i);
    struct ledger_camera *c = r->has_ledger && keeps_frames ? rig_entry(r, i) : NULL;
    b->busy_since_ns = 0;
    switch (e->command) {
    case CAMERA_OPEN:
        if (c && c->expected && r->phase == PHASE_COLLECT && c->serial[0] && e->facts.serial[0] && strcmp(c->serial, e->facts.serial))
            rig_give_up(r, i, "another body hangs in its place now; put the one with its serial number back, then rigctl resume");
        b->facts = e->facts;
        b->condition = RIG_READY;
        b->heartbeat_ns = now;
        if (!b->trouble_ns)
            b->note[0] = 0;
        rig_start_more(r, now);
        break;
    case CAMERA_CONFIGURE:
        b->n_settings = e->n_settings;
        memcpy(b->setting, e->setting, sizeof(b->setting));
        if (b->step != STEP_CONFIGURE)
            break;
        if (r->phase == PHASE_ADJUST) {
            rig_panorama_configured(r, i);
            break;
        }
        for (int s = 0; s < e->n_settings; s++)
            if (!e->setting[s].equal) {
                char why[200];
                snprintf(why, sizeof(why), "%s is '%s', '%s' wanted and not accepted; set it by hand or correct rigd.conf", e->setting[s].name, e->setting[s].found, e->setting[s].wanted);
                rig_give_up(r, i, why);
                break;
            }
        if (b->step == STEP_CONFIGURE)
            rig_set_step(r, i, STEP_STATUS);
        break;
    case CAMERA_STATUS:
        b->status = e->status;
        b->has_status = true;
        if (b->step == STEP_STATUS)
            rig_check_status(r, i);
        break;
    case CAMERA_DRAIN:
        if (b->step == STEP_DRAIN)
            rig_set_step(r, i, r->purpose == FOR_LAG || (r->phase == PHASE_ADJUST && !r->panorama.list_before) ? STEP_NONE : STEP_BEFORE);
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
            c->has_until = r->panorama.list_before = false;
            rig_set_step(r, i, STEP_NONE);
        } else if (b->step == STEP_RECONCILE && c) {
            listed(r, i, now, e);
        }
        break;
    case CAMERA_TRIGGER:
        if (e->pressed_ns && b->flash_ns == INT64_MIN)
            b->flash_ns = e->pressed_ns; // the best that is known without wires
        if (rig_makes_panoramas(r, i) && rig_pressed_by_driver(r))
            rig_fired(r, now, 0, e->pressed_ns, 0);
        break;
    case CAMERA_COLLECT:
        if (b->step != STEP_COLLECT)
            break;
        if (!c) {
            rig_set_step(r, i, STEP_NONE);
        } else if (c->n_objects < r->ledger.objects_per_shot) {
            rig_begin_reconcile(r, i, now);
        } else {
            rig_set_step(r, i, STEP_COPY);
            rig_look_at_debt(r, i, now);
        }
        break;
    case CAMERA_THUMBNAIL:
        b->thumbed = true;
        r->thumbed_ns = now;
        break;
    case CAMERA_FETCH:
        if (!c || k < 0 || k >= c->n_objects || b->step != STEP_COPY)
            break;
        c->object[k].state = OBJECT_COPIED;
        c->object[k].object.size_bytes = e->size_bytes;
        memcpy(c->object[k].xxh128, e->xxh128, sizeof(c->object[k].xxh128));
        c->object[k].copied_ms = r->shot_ns ? (now - r->shot_ns) / MS : -1;
        rig_changed(r);
        if (r->purpose == FOR_PANORAMA)
            rig_panorama_frame(r, k, e);
        b->n_failed = 0;
        rig_look_at_debt(r, i, now);
        break;
    case CAMERA_DELETE:
        if (!c || k < 0 || k >= c->n_objects || b->step != STEP_DELETE)
            break;
        c->object[k].state = OBJECT_DELETED;
        rig_changed(r);
        break;
    case CAMERA_IDENTIFY:
        rig_identified(r, i, "");
        break;
    case CAMERA_CLOSE:
    case CAMERA_N_COMMANDS:
        break;
    }
    rig_works_again(r, i, now, e->command);
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
    if (e->command == CAMERA_IDENTIFY)
        b->identify = true;
    const int64_t wait = (INT64_C(50) << (b->n_busy < 5 ? b->n_busy : 5)) * MS;
    b->n_busy++;
    if (now + wait - b->busy_since_ns > BUSY_MS * MS) {
        char found[300], why[200];
        snprintf(found, sizeof(found), "busy for %.1f s (%s): %s", 1e-9 * (double)(now - b->busy_since_ns), camera_command_name(e->command), e->text);
        rig_explain(why, found, rig_remedy(CAMERA_BUSY));
        b->busy_since_ns = 0;
        rig_quarantine(r, i, now, why);
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
    rig_explain(why, found, rig_remedy(e->trouble));
    switch (e->command) {
    case CAMERA_THUMBNAIL:
        b->thumbed = true; // a preview is not worth a second try
        return;
    case CAMERA_IDENTIFY:
        rig_identified(r, i, why);
        return;
    case CAMERA_TRIGGER: // it may have fired all the same: the card will tell
        rig_say(r, RIG_WARNING, i, "%s", why);
        if (rig_makes_panoramas(r, i) && rig_pressed_by_driver(r))
            rig_fired(r, now, -EIO, now, -1);
        return;
    case CAMERA_OPEN:
        rig_trouble(r, i, now, b->flight.since_ns, CAMERA_OPEN, why);
        return;
    case CAMERA_STATUS:
        if (b->step == STEP_STATUS) {
            rig_find(r, RIG_WARNING, i, "%s", why);
            rig_set_step(r, i, STEP_NONE);
        }
        return;
    case CAMERA_CLOSE:
        return;
    default:
        break;
    }
    if (r->has_ledger && e->command == CAMERA_FETCH && k >= 0)
        rig_entry(r, i)->object[k].n_retries++;
    if (++b->n_failed < (e->trouble == CAMERA_DISK ? DISK_TRIES_MAX : TRIES_MAX)) {
        b->retry_ns = now + (e->trouble == CAMERA_DISK ? 1000 : 250) * MS;
        return;
    }
    if (b->step == STEP_COLLECT)
        rig_begin_reconcile(r, i, now); // the card is the truth
    else
        rig_give_up(r, i, why);
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
            rig_quarantine(r, i, now, why);
        } else {
            b->greeted = true;
            if (b->condition == RIG_STARTING)
                b->condition = RIG_OPENING;
        }
    } else if (!b->flight.on || e->seq != b->seq) {
        return; // of a command that nobody waits for any more
    } else if (e->kind == CAMERA_OBJECT) {
        if (r->phase == PHASE_COLLECT && r->purpose != FOR_LAG && (r->purpose != FOR_PANORAMA || rig_makes_panoramas(r, i)) && rig_entry(r, i)->expected && b->flight.kind == CAMERA_COLLECT)
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
        rig_flight_ends(r, b);
        if (e->command != kind) {
            char why[120];
            snprintf(why, sizeof(why), "its worker answered %s to %s", camera_command_name(e->command), camera_command_name(kind));
            rig_kill_worker(r, i);
            rig_trouble(r, i, now, b->flight.since_ns, kind, why);
        } else if (e->kind == CAMERA_DONE) {
            done(r, i, now, e, k);
        } else if (e->trouble == CAMERA_BUSY) {
            busy(r, i, now, e);
        } else if (e->trouble == CAMERA_WRONG) {
            char why[200];
            rig_explain(why, e->text, rig_remedy(CAMERA_WRONG));
            rig_quarantine(r, i, now, why);
        } else if (e->trouble == CAMERA_LOST || e->trouble == CAMERA_STALLED || e->trouble == CAMERA_BROKEN) {
            char found[300], why[200];
            snprintf(found, sizeof(found), "%s, %s: %s", camera_command_name(kind), camera_trouble_name(e->trouble), e->text);
            rig_explain(why, found, rig_remedy(e->trouble));
            rig_trouble(r, i, now, b->flight.since_ns, kind, why);
        } else {
            failed_softly(r, i, now, e, k);
        }
        if (rig_is_copy(kind))
            rig_copy_next(r, b->config->controller, now);
    }
    rig_pump(r, i, now);
    rig_settle(r, now);
}

void rig_worker_gone(struct rig *r, int64_t now, int i, const char *how)
{
    struct body *b = &r->body[i];
    const bool expected = b->killing;
    const bool in_flight = b->flight.on;
    const enum camera_command_kind suspect = in_flight ? b->flight.kind : CAMERA_OPEN;
    const bool copied = in_flight && rig_is_copy(b->flight.kind);
    rig_flight_ends(r, b);
    b->worker = b->greeted = b->killing = false;
    b->press = false;
    if (b->condition == RIG_QUARANTINED || b->condition == RIG_OFF) {
        ;
    } else if (expected) {
        rig_start_worker(r, i, now); // a rung of the ladder
    } else {
        char why[200];
        snprintf(why, sizeof(why), "its worker ended (%.60s) during %s; %s", how, camera_command_name(suspect), rig_remedy(CAMERA_BROKEN));
        rig_trouble(r, i, now, in_flight ? b->flight.since_ns : now, suspect, why);
    }
    if (copied)
        rig_copy_next(r, b->config->controller, now);
    rig_settle(r, now);
}
