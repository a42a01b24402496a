// rigd/rig_panorama.c - the panorama: one camera, stop by stop, exposure by exposure.
//
// Each exposure is a shot like any other - armed, noted durably, fired, collected, fetched - with an entry of its own in the ledger; the
// present one is panorama.entry. In between: TURN (the head, or a person, is asked), STILL (nothing swings any more), ADJUST (the exposure
// time is set), NOTE (the ledger with the entry is durable). What is next follows from the ledger alone (rig_panorama_next), so a panorama
// that was interrupted anywhere goes on there.
#include "rigd/rig_inside.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { EXPOSURE_TRIES_MAX = 3, REJECTED_MAX = 3, TURN_AGAIN_MS = 1000 };
#define WRONG_EV .25 // neighbouring exposure times are 1/3 apart

bool rig_makes_panoramas(const struct rig *r, int i)
{
    return r->purpose == FOR_PANORAMA && i == r->config->panorama.camera;
}

bool rig_pressed_by_driver(const struct rig *r)
{
    const enum trigger_kind kind = r->config->trigger.kind;
    return (kind == TRIGGER_GPIO || kind == TRIGGER_USB) && r->config->camera[r->config->panorama.camera].full_line == CONFIG_NONE;
}

const char *rig_prompt(const struct rig *r)
{
    return r->panorama.prompt;
}

static struct rig_progress *progress(struct rig *r, enum rig_step step)
{
    const struct ledger_exposure *e = &rig_entry(r, 0)->exposure;
    struct rig_progress *p = &rig_act(r, RIG_PROGRESS, r->config->panorama.camera)->progress;
    *p = (struct rig_progress){ .step = step, .stop = e->stop, .n_stops = r->ledger.n_stops, .bracket = e->bracket, .yaw_deg = e->yaw_deg, .pitch_deg = e->pitch_deg };
    memcpy(p->label, e->label, sizeof(p->label));
    return p;
}

void rig_panorama_unprompt(struct rig *r)
{
    if (r->panorama.prompt[0])
        rig_act(r, RIG_PROMPT, CONFIG_NONE);
    r->panorama.prompt[0] = 0;
}

// ---- the head ------------------------------------------------------------------------------------------------------------------

static void begin_adjust(struct rig *r, int64_t now)
{
    const int i = r->config->panorama.camera;
    struct body *b = &r->body[i];
    r->phase = PHASE_ADJUST;
    r->phase_due_ns = now + READY_WAIT_S * S;
    r->panorama.lost[0] = 0;
    r->panorama.refused = false;
    b->flash_ns = INT64_MIN;
    b->owed_due_ns = 0;
    rig_set_step(r, i, STEP_CONFIGURE);
    if (b->condition == RIG_QUARANTINED)
        rig_give_up(r, i, b->note);
    rig_pump(r, i, now);
}

static void ask_head(struct rig *r, int64_t now)
{
    const struct ledger_exposure *e = &rig_entry(r, 0)->exposure;
    struct rig_action *a = rig_act(r, RIG_HEAD, CONFIG_NONE);
    a->head.yaw_mdeg = (int32_t)lround(1e3 * e->yaw_deg);
    a->head.pitch_mdeg = (int32_t)lround(1e3 * e->pitch_deg);
    r->panorama.turn_again = false;
    r->phase_due_ns = now + TURN_MS * MS;
}

static void begin_still(struct rig *r, int64_t now)
{
    r->panorama.stop_at = rig_entry(r, 0)->exposure.stop;
    r->phase = PHASE_STILL;
    r->phase_due_ns = now + r->config->panorama.settle_ms * MS;
}

static void begin_turn(struct rig *r, int64_t now)
{
    const struct ledger_exposure *e = &rig_entry(r, 0)->exposure;
    progress(r, RIG_STEP_TURN);
    r->panorama.stop_at = -1;
    r->panorama.n_turns = 0;
    r->body[r->config->panorama.camera].heartbeat_ns = now + r->config->heartbeat_s * S;
    switch (r->config->panorama.head) {
    case HEAD_NONE:
        r->panorama.stop_at = e->stop;
        begin_adjust(r, now);
        return;
    case HEAD_BOARD:
        r->phase = PHASE_TURN;
        r->panorama.turn_limit_ns = now + TURN_MS * MS;
        ask_head(r, now);
        return;
    case HEAD_MANUAL:
        if (!r->panorama.attended) {
            rig_fail_take(r, now, "stop %d of %d (yaw %g, pitch %g degrees) is not done and nobody is asked to turn the head; rigctl resume goes on there", e->stop + 1, r->ledger.n_stops, e->yaw_deg, e->pitch_deg);
            return;
        }
        r->phase = PHASE_TURN;
        r->phase_due_ns = INT64_MAX;
        snprintf(r->panorama.prompt, sizeof(r->panorama.prompt), "stop %d of %d: turn the head to yaw %g degrees (to the left is positive), pitch %g degrees (up), let go, then rigctl continue",
                 e->stop + 1, r->ledger.n_stops, e->yaw_deg, e->pitch_deg);
        struct rig_action *a = rig_act(r, RIG_PROMPT, CONFIG_NONE);
        a->on = true;
        memcpy(a->text, r->panorama.prompt, sizeof(a->text));
    }
}

void rig_head_arrived(struct rig *r, int64_t now, int err)
{
    if (r->phase != PHASE_TURN || r->config->panorama.head != HEAD_BOARD || r->panorama.turn_again)
        return;
    const struct ledger_exposure *e = &rig_entry(r, 0)->exposure;
    if (!err) {
        begin_still(r, now);
    } else if (err == -EBUSY && now < r->panorama.turn_limit_ns) { // it still obeys somebody else: a daemon that died
        r->panorama.turn_again = true;
        r->phase_due_ns = now + TURN_AGAIN_MS * MS;
    } else if (err != -ENOTSUP && err != -EINVAL && ++r->panorama.n_turns < TURN_TRIES_MAX) {
        rig_say(r, RIG_WARNING, CONFIG_NONE, "the head did not reach yaw %g, pitch %g degrees (%s); it is asked again", e->yaw_deg, e->pitch_deg, strerror(-err));
        r->panorama.turn_again = true;
        r->phase_due_ns = now + TURN_AGAIN_MS * MS;
    } else {
        rig_fail_take(r, now, "stop %d of %d: the head does not reach yaw %g, pitch %g degrees: %s; clear its way, check its cables and limits, then rigctl resume", e->stop + 1, r->ledger.n_stops, e->yaw_deg,
                      e->pitch_deg, strerror(-err));
    }
    rig_settle(r, now);
}

int rig_continue(struct rig *r, int64_t now, char *why)
{
    if (!r->panorama.prompt[0]) {
        snprintf(why, 200, "nothing waits for a person");
        return -EINVAL;
    }
    rig_panorama_unprompt(r);
    begin_still(r, now);
    rig_settle(r, now);
    return 0;
}

// ---- one exposure ----------------------------------------------------------------------------------------------------------------

// Later than these on the card belongs to the next exposure.
static void begin_after(struct ledger_camera *next, const struct ledger_camera *last)
{
    next->n_before = last->n_before;
    memcpy(next->before, last->before, sizeof(next->before));
    for (int k = 0; k < last->n_objects; k++) {
        const struct camera_object *o = &last->object[k].object;
        int s = 0;
        while (s < next->n_before && !camera_same_store(&next->before[s], o))
            s++;
        if (s < CAMERA_STORES_MAX && (s == next->n_before || camera_object_order(o, &next->before[s]) > 0)) {
            next->before[s] = *o;
            next->n_before += s == next->n_before;
        }
    }
}

static void become(struct rig *r, int entry)
{
    struct body *b = &r->body[r->config->panorama.camera];
    if (entry != r->panorama.entry)
        r->panorama.n_tries = 0;
    r->panorama.entry = entry;
    memset(b->noted, 0, sizeof(b->noted)); // what an entry of before knows is durable
}

static bool is_usable(const struct ledger_camera *c)
{
    return c->debt == DEBT_PAID && c->exposure.object >= 0 && !c->exposure.rejected;
}

static void go_to_stop(struct rig *r, int64_t now)
{
    if (r->panorama.stop_at == rig_entry(r, 0)->exposure.stop)
        begin_adjust(r, now);
    else
        begin_turn(r, now);
}

// What an earlier life may have left on the card, before anything is exposed again.
static void look_on_card(struct rig *r, int64_t now)
{
    const int i = r->config->panorama.camera;
    struct body *b = &r->body[i];
    char why[200];
    r->phase = PHASE_COLLECT;
    r->panorama.looked = r->panorama.entry;
    r->panorama.looking = true;
    b->owed_due_ns = now;
    rig_begin_reconcile(r, i, now);
    rig_reinstate(r, now, i, why);
    rig_pump(r, i, now);
}

static struct bracket_plan plan_of(const struct rig *r)
{
    return (struct bracket_plan){ .metered_s = r->panorama.metered_s, .shortest_s = r->panorama.shortest_s, .longest_s = r->panorama.longest_s,
                                  .max_frames = r->config->panorama.frames_max, .repeat_shortest = true };
}

// The next exposure of this stop becomes the present one: true. It has all it needs: false. (Or the take has failed: true.)
static bool plan_stop(struct rig *r, int64_t now, int stop)
{
    struct bracket_statistics so_far[CONFIG_FRAMES_MAX];
    const struct bracket_plan plan = plan_of(r);
    struct ledger *l = &r->ledger;
    struct bracket_next next;
    int n = 0, n_entries = 0, n_rejected = 0, last = -1;
    for (int e = 0; e < l->n_cameras; e++) {
        const struct ledger_camera *c = &l->camera[e];
        if (c->exposure.stop != stop)
            continue;
        n_entries++;
        n_rejected += c->exposure.rejected;
        if (is_usable(c) && n < CONFIG_FRAMES_MAX)
            so_far[n++] = c->exposure.facts.light;
        if (is_usable(c))
            last = e;
    }
    if (n_rejected > REJECTED_MAX) {
        rig_fail_take(r, now, "stop %d of %d: %d exposures could not be used, the last one: %.90s; mend that, then rigctl resume", stop + 1, l->n_stops, n_rejected, rig_entry(r, 0)->note);
        return true;
    }
    if (bracket_next(&next, &plan, so_far, n)) {
        rig_fail_take(r, now, "stop %d of %d: its raws do not say how long they were exposed", stop + 1, l->n_stops);
        return true;
    }
    if (next.is_done) {
        struct ledger_camera *c = last >= 0 ? &l->camera[last] : NULL;
        if (!c || c->note[0])
            return false;
        snprintf(c->note, sizeof(c->note), "%.159s", next.why);
        rig_changed(r);
        if (next.needs_nd)
            rig_say(r, RIG_WARNING, r->config->panorama.camera, "stop %d of %d: %s; its light will be a lower bound", stop + 1, l->n_stops, next.why);
        memcpy(progress(r, RIG_STEP_STOP_DONE)->text, c->note, sizeof(c->note));
        return false;
    }
    const int entry = ledger_expose(l, r->config, stop, n_entries, next.exposure_s);
    if (entry < 0) {
        rig_fail_take(r, now, "no room for one exposure more in its ledger: %s", strerror(-entry));
        return true;
    }
    if (entry > 0)
        begin_after(&l->camera[entry], &l->camera[entry - 1]);
    rig_changed(r);
    become(r, entry);
    go_to_stop(r, now);
    return true;
}

void rig_panorama_next(struct rig *r, int64_t now)
{
    struct ledger *l = &r->ledger;
    if (r->cancelled) {
        rig_fail_take(r, now, "cancelled");
        return;
    }
    for (int e = 0; e < l->n_cameras; e++) {
        if (!l->camera[e].expected || l->camera[e].debt == DEBT_PAID)
            continue;
        l->camera[e].debt = DEBT_OPEN;
        become(r, e);
        if (e < r->panorama.n_old && r->panorama.looked < e)
            look_on_card(r, now);
        else
            go_to_stop(r, now);
        return;
    }
    for (int stop = 0; stop < l->n_stops; stop++)
        if (plan_stop(r, now, stop))
            return;
    rig_begin_manifest(r);
}

// The camera does not have this time: what is beyond it is not asked for again.
static void exclude(struct rig *r, int64_t now)
{
    struct ledger *l = &r->ledger;
    const struct ledger_exposure *e = &rig_entry(r, 0)->exposure;
    const double third = exp2(1. / 3), wanted_s = e->wanted_s;
    rig_say(r, RIG_INFO, r->config->panorama.camera, "it has no exposure of %s s", e->label);
    if (wanted_s < r->panorama.metered_s * .99)
        r->panorama.shortest_s = wanted_s * third;
    else if (wanted_s > r->panorama.metered_s * 1.01)
        r->panorama.longest_s = wanted_s / third;
    else {
        rig_fail_take(r, now, "its camera does not take meter = %s; name another time in rigd.conf", e->label);
        return;
    }
    if (r->panorama.entry == l->n_cameras - 1 && !rig_entry(r, 0)->n_objects) {
        l->n_cameras--;
        r->panorama.entry--;
    } else {
        rig_entry(r, 0)->expected = false;
        snprintf(rig_entry(r, 0)->note, sizeof(rig_entry(r, 0)->note), "left out: the camera does not have this exposure time");
    }
    rig_changed(r);
    rig_panorama_next(r, now);
}

void rig_panorama_configured(struct rig *r, int i)
{
    const struct body *b = &r->body[i];
    for (int s = 0; s < b->n_settings; s++) {
        const struct camera_setting_found *f = &b->setting[s];
        const bool shutter = !strcmp(f->name, "shutter");
        if (f->equal && f->written && !shutter)
            rig_say(r, RIG_WARNING, i, "%s had changed and was set back to %s; did somebody turn a dial?", f->name, f->found);
        if (f->equal)
            continue;
        if (shutter) {
            r->panorama.refused = true;
            rig_set_step(r, i, STEP_NONE);
        } else {
            char why[200];
            snprintf(why, sizeof(why), "%s is '%s', '%s' wanted and not accepted; set it by hand or correct rigd.conf", f->name, f->found, f->wanted);
            rig_give_up(r, i, why);
        }
        return;
    }
    rig_set_step(r, i, STEP_DRAIN);
}

void rig_panorama_phase_over(struct rig *r, int64_t now)
{
    switch (r->phase) {
    case PHASE_STILL:
        if (now >= r->phase_due_ns)
            begin_adjust(r, now);
        return;
    case PHASE_ADJUST:
        if (r->panorama.lost[0]) {
            rig_fail_take(r, now, "stop %d of %d: %.120s; then rigctl resume", rig_entry(r, 0)->exposure.stop + 1, r->ledger.n_stops, r->panorama.lost);
        } else if (!r->n_pending && r->panorama.refused) {
            exclude(r, now);
        } else if (!r->n_pending) {
            rig_changed(r);
            r->phase = PHASE_NOTE;
        }
        return;
    case PHASE_NOTE:
        if (r->durable != r->change)
            return;
        r->n_fire_tries = 0;
        progress(r, RIG_STEP_EXPOSE);
        rig_begin_fire(r, now);
        return;
    default:
        return;
    }
}

void rig_panorama_time(struct rig *r, int64_t now)
{
    if (r->phase == PHASE_TURN && r->panorama.turn_again)
        ask_head(r, now);
    else if (r->phase == PHASE_TURN && r->config->panorama.head == HEAD_BOARD)
        rig_head_arrived(r, now, -ETIME);
    else if (r->phase == PHASE_ADJUST)
        rig_give_up(r, r->config->panorama.camera, r->body[r->config->panorama.camera].note[0] ? r->body[r->config->panorama.camera].note : "not ready in time; check cable and power");
}

void rig_panorama_frame(struct rig *r, int k, const struct camera_event *e)
{
    struct ledger_exposure *x = &rig_entry(r, 0)->exposure;
    if (x->object >= 0 || !e->judged)
        return;
    x->object = k;
    x->facts = e->frame;
}

// Not the frame that was asked for? What is wrong with it.
static bool is_wrong(const struct rig *r, const struct ledger_camera *c, char why[200])
{
    const struct frame_facts *f = &c->exposure.facts;
    const double ev = f->light.exposure_s > 0 ? log2(f->light.exposure_s / c->exposure.wanted_s) : 0;
    const struct frame_facts *first = NULL;
    for (int e = 0; e < r->ledger.n_cameras && !first; e++)
        if (&r->ledger.camera[e] != c && is_usable(&r->ledger.camera[e]))
            first = &r->ledger.camera[e].exposure.facts;
    if (!(f->light.exposure_s > 0))
        snprintf(why, 200, "its raw does not say how long it was exposed");
    else if (fabs(ev) > WRONG_EV)
        snprintf(why, 200, "it was exposed for %.3g s, %s wanted; is the mode dial at M?", f->light.exposure_s, c->exposure.label);
    else if (first && fabs(first->f_number - f->f_number) > .01 * first->f_number)
        snprintf(why, 200, "its aperture is f/%g, f/%g before; turn it back", f->f_number, first->f_number);
    else if (first && fabs(first->iso - f->iso) > .01 * first->iso)
        snprintf(why, 200, "its ISO is %g, %g before; turn it back", f->iso, first->iso);
    else if (first && strcmp(first->serial, f->serial))
        snprintf(why, 200, "it was made by the body with serial number %.40s, those before by %.40s", f->serial, first->serial);
    else
        return false;
    return true;
}

void rig_panorama_collected(struct rig *r, int64_t now)
{
    const int i = r->config->panorama.camera;
    struct ledger_camera *c = rig_entry(r, i);
    struct ledger_exposure *x = &c->exposure;
    char why[200];
    const bool looked = r->panorama.looking;
    r->panorama.looking = false;
    if (c->debt != DEBT_PAID) {
        c->debt = DEBT_OPEN;
        if (c->n_objects) { // it is on the card, and cannot be used
            c->debt = DEBT_MISSED;
            c->expected = false;
            x->rejected = true;
        } else if (!looked && r->panorama.n_tries >= EXPOSURE_TRIES_MAX - 1) {
            rig_fail_take(r, now, "stop %d of %d, %s s: %.110s; then rigctl resume", x->stop + 1, r->ledger.n_stops, x->label, c->note);
            return;
        } else {
            r->panorama.n_tries += !looked;
            if (!looked)
                rig_say(r, RIG_WARNING, i, "stop %d of %d, %s s: no frame; it is exposed again", x->stop + 1, r->ledger.n_stops, x->label);
            c->note[0] = 0;
        }
        rig_changed(r);
        if (r->cancelled || !c->expected) {
            rig_panorama_next(r, now);
        } else {
            go_to_stop(r, now);
        }
        return;
    }
    if (x->object < 0) {
        rig_fail_take(r, now, "stop %d of %d: LibRaw cannot read %.30s, so nobody knows what exposures are needed", x->stop + 1, r->ledger.n_stops, c->object[0].object.name);
        return;
    }
    if (is_wrong(r, c, why)) {
        x->rejected = true;
        memcpy(c->note, why, sizeof(c->note));
        rig_changed(r);
        rig_say(r, RIG_WARNING, i, "stop %d of %d: %s is not used: %s", x->stop + 1, r->ledger.n_stops, c->object[x->object].object.name, why);
    } else {
        const struct bracket_statistics *s = &x->facts.light;
        struct rig_progress *p = progress(r, RIG_STEP_FRAME);
        const double bright = fmax(s->brightest[0], fmax(s->brightest[1], s->brightest[2]));
        snprintf(p->text, sizeof(p->text), "brightest light %.2f of white, darkest percent %.5f", bright, fmin(s->first_percentile[0], fmin(s->first_percentile[1], s->first_percentile[2])));
    }
    rig_panorama_next(r, now);
}

// ---- requests ----------------------------------------------------------------------------------------------------------------------

static void begin(struct rig *r)
{
    char label[16];
    const struct panorama_config *p = &r->config->panorama;
    r->purpose = FOR_PANORAMA;
    r->panorama.entry = r->panorama.n_tries = r->panorama.n_turns = r->panorama.n_old = 0;
    r->panorama.stop_at = r->panorama.looked = -1;
    r->panorama.metered_s = ledger_exposure_label(p->meter_s, label);
    r->panorama.shortest_s = ledger_exposure_label(p->shortest_s, label);
    r->panorama.longest_s = ledger_exposure_label(p->longest_s, label);
    r->panorama.failed = r->panorama.turn_again = r->panorama.looking = r->panorama.list_before = false;
    r->panorama.prompt[0] = 0;
    r->without_missing = false;
}

int rig_panorama(struct rig *r, int64_t now, const struct rig_take *take, char *why)
{
    const bool board = r->config->panorama.head == HEAD_BOARD;
    if (config_panorama_camera(r->config) == CONFIG_NONE) {
        snprintf(why, 200, "rigd.conf has no [panorama]: say there which camera makes them");
        return -EINVAL;
    }
    const int err = rig_may_begin(r, board || !rig_pressed_by_driver(r), why);
    if (err)
        return err;
    if (board && !(r->abilities & TRIGGER_HEAD)) {
        snprintf(why, 200, "the trigger has no panorama head; head = manual in rigd.conf asks a person to turn it");
        return -ENOTCONN;
    }
    rig_new_ledger(r);
    ledger_init_panorama(&r->ledger, r->config);
    rig_name_take(r, now, take);
    begin(r);
    r->panorama.attended = true;
    if (ledger_expose(&r->ledger, r->config, 0, 0, r->panorama.metered_s) < 0)
        abort();
    rig_set_state(r, TAKE_PREFLIGHT);
    rig_begin_preflight(r, now);
    rig_settle(r, now);
    return 0;
}

int rig_resume_panorama(struct rig *r, int64_t now, struct ledger *old, const char *takes_dir, char *why)
{
    const int i = config_panorama_camera(r->config);
    const char *serial = i == CONFIG_NONE ? "" : r->body[i].facts.serial[0] ? r->body[i].facts.serial : r->config->camera[i].serial;
    if (i == CONFIG_NONE || !old->n_stops) {
        snprintf(why, 200, i == CONFIG_NONE ? "rigd.conf has no [panorama] any more" : "its ledger names no stops");
        return -EINVAL;
    }
    if (old->n_cameras && serial[0] && old->camera[0].serial[0] && strcmp(serial, old->camera[0].serial)) {
        snprintf(why, 200, "it was begun with the body %.39s, and %.39s is the panorama camera now; put the one from before back", old->camera[0].serial, serial);
        return -EINVAL;
    }
    const bool attended = r->panorama.attended;
    rig_new_ledger(r);
    r->ledger = *old;
    *old = (struct ledger){ 0 };
    snprintf(r->takes_dir, sizeof(r->takes_dir), "%s", takes_dir);
    begin(r);
    r->panorama.attended = attended;
    r->panorama.n_old = r->ledger.n_cameras;
    r->panorama.list_before = true; // who knows what was done with this camera since
    r->created = true;
    r->phase = PHASE_COLLECT;
    for (int e = 0; e < r->ledger.n_cameras; e++) {
        struct ledger_camera *c = &r->ledger.camera[e];
        for (int k = 0; c->exposure.object < 0 && !c->exposure.rejected && k < c->n_objects; k++)
            if (c->object[k].state == OBJECT_COPIED) { // a copy that nobody has judged: to fetch it again does that
                c->object[k].state = OBJECT_FOUND;
                c->debt = DEBT_OPEN;
            }
        if (e + 1 < r->ledger.n_cameras && !c->has_until) { // the next exposure's frames are not this one's
            c->has_until = true;
            c->n_until = c[1].n_before;
            memcpy(c->until, c[1].before, sizeof(c->until));
        }
    }
    for (int k = 0; k < r->n; k++)
        r->body[k].part = k == i;
    r->body[i].thumbed = true;
    r->body[i].saw_nothing = false;
    r->ledger.reason[0] = 0;
    rig_set_state(r, TAKE_EXPOSING);
    rig_changed(r);
    rig_panorama_next(r, now);
    rig_settle(r, now);
    return 0;
}
