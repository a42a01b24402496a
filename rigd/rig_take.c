// rigd/rig_take.c - the phases of a take: preflight, arming, the shot, collecting, the verdict.
#include "rigd/rig_inside.h"

#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

// ---- phases --------------------------------------------------------------------------------------------------------------------------

void rig_finish(struct rig *r, int64_t now)
{
    const bool was_take = r->has_ledger && (r->purpose == FOR_TAKE || r->purpose == FOR_RESUME || r->purpose == FOR_PANORAMA);
    r->phase = PHASE_IDLE;
    for (int i = 0; i < r->n; i++) {
        r->body[i].part = false;
        rig_set_step(r, i, STEP_NONE);
        r->body[i].heartbeat_ns = now + r->config->heartbeat_s * S * (i + 1) / r->n; // not all at once
    }
    rig_act(r, was_take ? RIG_TAKE_DONE : r->purpose == FOR_PREFLIGHT ? RIG_PREFLIGHT_DONE : RIG_LAG_DONE, CONFIG_NONE);
}

__attribute__((format(printf, 3, 4))) void rig_fail_take(struct rig *r, int64_t now, const char *format, ...)
{
    va_list args;
    va_start(args, format);
    vsnprintf(r->outcome, sizeof(r->outcome), format, args);
    va_end(args);
    for (int i = 0; i < r->n; i++)
        rig_set_step(r, i, STEP_NONE);
    rig_panorama_unprompt(r);
    if (r->purpose == FOR_LAG || r->purpose == FOR_PREFLIGHT) {
        rig_say(r, RIG_ERROR, CONFIG_NONE, "%s: %s", r->purpose == FOR_LAG ? "calibration" : "preflight", r->outcome);
        rig_finish(r, now);
        return;
    }
    rig_say(r, RIG_ERROR, CONFIG_NONE, "take %s: %s", r->ledger.id, r->outcome);
    memcpy(r->ledger.reason, r->outcome, sizeof(r->ledger.reason));
    if (r->created && r->purpose == FOR_PANORAMA) { // what is here can be used, and is to be handed over like all else
        r->panorama.failed = true;
        rig_begin_manifest(r);
        return;
    }
    rig_set_state(r, TAKE_FAILED);
    if (r->created)
        r->phase = PHASE_END;
    else
        rig_finish(r, now);
}

void rig_begin_preflight(struct rig *r, int64_t now)
{
    r->phase = PHASE_PREFLIGHT;
    r->phase_due_ns = now + READY_WAIT_S * S;
    r->n_findings = 0;
    r->cancelled = false;
    r->space_known = false;
    rig_act(r, RIG_SPACE, CONFIG_NONE);
    r->n_wanted = 0;
    for (int i = 0; i < r->n; i++) {
        struct body *b = &r->body[i];
        b->part = (i == config_panorama_camera(r->config)) == (r->purpose == FOR_PANORAMA);
        if (!b->part)
            continue;
        r->n_wanted++;
        b->thumbed = !r->config->thumbnails || r->purpose == FOR_PANORAMA;
        b->owed_due_ns = 0;
        b->flash_ns = INT64_MIN;
        b->saw_nothing = false;
        rig_set_step(r, i, STEP_CONFIGURE);
        if (b->condition == RIG_QUARANTINED) {
            char why[220];
            snprintf(why, sizeof(why), "quarantined: %.199s", b->note);
            rig_give_up(r, i, why);
        }
    }
    rig_pump_all(r, now);
}

void rig_check_status(struct rig *r, int i)
{
    struct body *b = &r->body[i];
    const struct camera_status *s = &b->status;
    const struct config *config = r->config;
    const int objects_per_shot = r->purpose == FOR_PANORAMA ? 1 : config->objects_per_shot;
    char why[200] = "";
    if (s->battery_percent >= 0 && s->battery_percent < config->battery_min_percent)
        snprintf(why, sizeof(why), "battery at %d %%, at least %d %% wanted; change or charge it", s->battery_percent, config->battery_min_percent);
    else if (s->card_present == 0)
        snprintf(why, sizeof(why), "no card; insert one");
    else if (s->free_images >= 0 && s->free_images < objects_per_shot)
        snprintf(why, sizeof(why), "card has room for %lld pictures, %d wanted; empty it", (long long)s->free_images, objects_per_shot);
    else if (s->free_bytes >= 0 && s->free_bytes < (int64_t)config->raw_mb * objects_per_shot << 20)
        snprintf(why, sizeof(why), "card has %lld MB free, %d wanted; empty it", (long long)(s->free_bytes >> 20), (int)config->raw_mb * objects_per_shot);
    else if (s->manual_focus == 0)
        snprintf(why, sizeof(why), "autofocus is on; set the lens to manual focus");
    else if (s->manual_exposure == 0)
        snprintf(why, sizeof(why), "exposure is automatic; turn the mode dial to M");
    else if (s->objects_per_shot >= 0 && s->objects_per_shot != objects_per_shot)
        snprintf(why, sizeof(why), "its image format writes %d files per shot, rigd.conf says %d; set the format to RAW", s->objects_per_shot, objects_per_shot);
    else if (b->config->lens[0] && s->lens[0] && strcmp(b->config->lens, s->lens))
        snprintf(why, sizeof(why), "lens is '%.50s', '%.50s' wanted; change it or rigd.conf", s->lens, b->config->lens);
    if (!isnan(s->clock_offset_s) && fabs(s->clock_offset_s) > config->clock_max_s)
        rig_find(r, RIG_WARNING, i, "its clock is %+.1f s off", s->clock_offset_s);
    if (why[0])
        rig_give_up(r, i, why);
    else
        rig_set_step(r, i, STEP_NONE);
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
                rig_find(r, RIG_WARNING, i, "firmware %s, camera %s has %s; update to one version", a->firmware, r->config->camera[k].name, b->firmware);
            break;
        }
}

static void begin_arm(struct rig *r, int64_t now)
{
    r->phase = PHASE_ARM;
    r->phase_due_ns = now + READY_WAIT_S * S;
    for (int i = 0; i < r->n; i++)
        if (r->body[i].part)
            rig_set_step(r, i, STEP_DRAIN);
    rig_pump_all(r, now);
}

// A body that is not fit: how many may be left out?
bool rig_too_many_missing(struct rig *r, int64_t now)
{
    int n_out = 0, first = -1;
    for (int i = 0; i < r->n; i++)
        if (!r->body[i].part && (i == config_panorama_camera(r->config)) == (r->purpose == FOR_PANORAMA)) {
            n_out++;
            first = first < 0 ? i : first;
        }
    if (n_out == r->n_wanted || (n_out > r->config->may_miss && !r->without_missing)) {
        const char *text = "";
        for (int f = 0; f < r->n_findings && !text[0]; f++)
            if (r->finding[f].camera == first && r->finding[f].severity == RIG_ERROR)
                text = r->finding[f].text;
        rig_fail_take(r, now, "%d of %d cameras not fit, first %s: %.120s", n_out, r->n_wanted, r->config->camera[first].name, text);
        return true;
    }
    return false;
}

void rig_end_preflight(struct rig *r, int64_t now)
{
    const struct config *config = r->config;
    check_firmware(r);
    const int n_frames = r->purpose == FOR_PANORAMA ? config->panorama.n_stops * config->panorama.frames_max : config->objects_per_shot * r->n_wanted;
    const int64_t needed = ((int64_t)config->raw_mb * n_frames + config->free_space_mb) << 20;
    const bool no_space = r->purpose != FOR_LAG && r->free_bytes < needed;
    if (r->free_bytes < 0)
        rig_find(r, RIG_ERROR, CONFIG_NONE, "%.120s: cannot tell its free space: %s", config->takes_dir, strerror((int)-r->free_bytes));
    else if (no_space)
        rig_find(r, RIG_ERROR, CONFIG_NONE, "%.100s: %lld MB free, %lld MB needed; remove old takes", config->takes_dir, (long long)(r->free_bytes >> 20), (long long)(needed >> 20));
    if (r->purpose == FOR_PREFLIGHT)
        rig_finish(r, now);
    else if (no_space)
        rig_fail_take(r, now, "%.190s", r->finding[r->n_findings - 1].text);
    else if (!rig_too_many_missing(r, now))
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
    char label[16];
    for (int i = 0; i < r->n; i++)
        for (int k = 0; r->body[i].part && k < r->body[i].n_settings; k++)
            if (!strcmp(r->body[i].setting[k].name, "shutter"))
                longest = fmax(longest, shutter_s(r->body[i].setting[k].found));
    return longest > 0 ? fmax(longest, ledger_exposure_label(longest, label)) : 0; // what is called 15 s lasts 16
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

void rig_begin_fire(struct rig *r, int64_t now)
{
    const struct trigger_config *t = &r->config->trigger;
    struct lag lag[CONFIG_CAMERAS_MAX];
    bool measured = false;
    const bool by_driver = r->purpose == FOR_PANORAMA && rig_pressed_by_driver(r);
    if (r->abilities < 0 && !by_driver) {
        rig_fail_take(r, now, "the trigger is gone; see the journal");
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
    if (by_driver) {
        const int i = r->config->panorama.camera;
        r->at_ns = now;
        r->phase_due_ns = now + DRIVER_PRESS_MS * MS;
        r->body[i].press = true;
        rig_pump(r, i, now);
        return;
    }
    uint32_t half_ms = r->abilities & TRIGGER_HALF_PRESS ? t->half_press_ms : 0;
    if (r->purpose == FOR_PANORAMA && half_ms > AWAKE_HALF_PRESS_MS)
        half_ms = AWAKE_HALF_PRESS_MS; // it was spoken to right now, and stands alone: nothing has to be exact
    if (measured && (r->abilities & TRIGGER_DELAYS) && r->purpose == FOR_TAKE) {
        const uint32_t held_ms = half_ms + t->hold_ms; // half-press waits for the slowest: delays count towards max_hold_ms
        const uint32_t room_us = t->max_hold_ms > held_ms ? 1000 * (t->max_hold_ms - held_ms) : 0;
        const int n_clipped = lag_delays(lag, r->n, room_us < MAX_DELAY_US ? room_us : MAX_DELAY_US, r->delay_us);
        if (n_clipped)
            rig_say(r, RIG_WARNING, CONFIG_NONE, "lag of %d cameras is not made up for in full: max_hold_ms = %u leaves %u ms for delays; raise it in rigd.conf", n_clipped, t->max_hold_ms,
                (room_us < MAX_DELAY_US ? room_us : MAX_DELAY_US) / 1000);
    }
    struct trigger_shot *shot = &rig_act(r, RIG_FIRE, CONFIG_NONE)->shot;
    r->at_ns = now + (((int64_t)FIRE_LEAD_MS << r->n_fire_tries) + half_ms) * MS; // a machine that was late once gets longer
    *shot = (struct trigger_shot){ .at_ns = r->at_ns, .half_ms = half_ms, .hold_ms = t->hold_ms, .delay_us = r->delay_us, .skip = r->skip };
    r->phase_due_ns = r->at_ns + MAX_DELAY_US * 1000 + (t->hold_ms + 2000) * MS;
    if (rig_waits_for_button(r)) {
        shot->on_button = true;
        r->phase_due_ns = INT64_MAX; // until it is pressed, somebody cancels, or the link breaks: the trigger says each
        rig_say(r, RIG_INFO, CONFIG_NONE, "take %s: armed; the button fires", r->ledger.id);
    }
}

void rig_begin_collect(struct rig *r, int64_t now)
{
    r->phase = PHASE_COLLECT;
    for (int i = 0; i < r->n; i++)
        if (r->body[i].part && r->body[i].condition == RIG_READY)
            rig_set_step(r, i, STEP_COLLECT);
        else if (r->body[i].part && (r->purpose == FOR_TAKE || r->purpose == FOR_PANORAMA))
            rig_collect_from_card(r, i, now);
    if (r->purpose == FOR_TAKE)
        rig_set_state(r, TAKE_COLLECTING);
    for (int i = 0; i < r->n; i++) // who fell into quarantine while all was silent
        if (r->body[i].part && r->body[i].condition == RIG_QUARANTINED)
            rig_give_up(r, i, r->body[i].note);
    rig_pump_all(r, now);
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
        rig_entry(r, i)->delay_us = r->delay_us[i];
        rig_entry(r, i)->lag_ns = at_ns[i] == INT64_MIN ? INT64_MIN : at_ns[i] - r->pressed_ns - (int64_t)r->delay_us[i] * 1000;
    }
    if (r->purpose != FOR_TAKE)
        return;
    shot_timing(&t, at_ns, r->n, LATE_MS * MS);
    r->ledger.n_measured = t.n_measured;
    r->ledger.spread_ns = t.n_measured > 1 ? t.spread_ns : -1;
    r->ledger.sigma_ns = t.n_measured > 1 ? t.sigma_ns : -1;
    for (int i = 0; i < r->n; i++)
        if (t.late[i / 64] >> i % 64 & 1)
            rig_say(r, RIG_WARNING, i, "its shutter opened more than %d ms from the others'; rigctl calibrate lag", LATE_MS);
}

void rig_begin_manifest(struct rig *r)
{
    r->phase = PHASE_MANIFEST;
    rig_changed(r);
    rig_act(r, RIG_MANIFEST, CONFIG_NONE);
}

static void end_lag_shot(struct rig *r, int64_t now)
{
    for (int i = 0; i < r->n; i++) {
        struct body *b = &r->body[i];
        if (b->part && b->flash_ns != INT64_MIN && b->n_samples < r->n_shots_wanted)
            b->sample_ms[b->n_samples++] = 1e-6 * (double)(b->flash_ns - r->pressed_ns);
    }
    struct lag lag[CONFIG_CAMERAS_MAX];
    if (++r->n_shots >= r->n_shots_wanted) {
        for (int i = 0; i < r->n; i++)
            lag_estimate(&lag[i], r->body[i].sample_ms, r->body[i].n_samples); // n = 0: too few
        r->n_shots_wanted = r->n_shots + lag_more_shots(lag, r->n, r->config->lag_within_ms, r->n_shots_most - r->n_shots);
    }
    rig_say(r, RIG_INFO, CONFIG_NONE, "lag: shot %d of %d", r->n_shots, r->n_shots_wanted);
    if (r->n_shots < r->n_shots_wanted && !r->cancelled) {
        begin_arm(r, now);
        return;
    }
    for (int i = 0; i < r->n; i++) {
        if (!lag_estimate(&lag[i], r->body[i].sample_ms, r->body[i].n_samples))
            r->body[i].lag = lag[i];
        else if (r->body[i].part)
            rig_say(r, RIG_WARNING, i, "no flash-sync contact in %d shots; check its cable", r->n_shots);
    }
    rig_finish(r, now);
}

void rig_end_collect(struct rig *r, int64_t now)
{
    if (r->purpose == FOR_LAG) {
        end_lag_shot(r, now);
        return;
    }
    if (r->purpose == FOR_PANORAMA) {
        rig_panorama_collected(r, now);
        return;
    }
    measure_shot(r);
    rig_begin_manifest(r);
}

static int64_t utc_at(const struct rig *r, int64_t ns)
{
    return r->utc_ms + (ns - r->utc_at_ns) / MS;
}

static void draw_time_line(struct rig *r, int64_t now)
{
    struct ledger *l = &r->ledger;
    const int64_t pressed_ms = l->shot_utc_ms, exposed_ms = utc_at(r, exposed_ns(r));
    int64_t collected_ms = exposed_ms;
    for (int i = 0; i < l->n_cameras; i++)
        for (int k = 0; k < l->camera[i].n_objects; k++) {
            const int64_t copied_ms = pressed_ms + l->camera[i].object[k].copied_ms;
            collected_ms = copied_ms > collected_ms ? copied_ms : collected_ms;
        }
    ledger_note_stage(l, "button", r->utc_ms, pressed_ms);
    ledger_note_stage(l, "exposed", pressed_ms, exposed_ms);
    if (r->thumbed_ns)
        ledger_note_stage(l, "thumbnails", exposed_ms, utc_at(r, r->thumbed_ns));
    ledger_note_stage(l, "collected", exposed_ms, collected_ms);
    ledger_note_stage(l, "verified", collected_ms, utc_at(r, now));
}

static void conclude(struct rig *r, int64_t now, int manifest_err)
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
    if (r->purpose == FOR_PANORAMA && r->panorama.failed) {
        memcpy(l->reason, r->outcome, sizeof(l->reason)); // said already
        rig_set_state(r, TAKE_FAILED);
        rig_changed(r);
        r->phase = PHASE_SETTLE;
        return;
    }
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
        rig_say(r, RIG_ERROR, CONFIG_NONE, "take %s: %s", l->id, l->reason);
    if (r->purpose == FOR_TAKE && l->shot_utc_ms)
        draw_time_line(r, now);
    rig_set_state(r, l->reason[0] ? TAKE_FAILED : TAKE_VERIFIED);
    rig_changed(r);
    r->phase = PHASE_SETTLE;
}

void rig_begin_delete(struct rig *r, int64_t now)
{
    r->phase = PHASE_DELETE;
    if (r->ledger.state == TAKE_VERIFIED && r->config->delete_after_verify)
        for (int i = 0; i < r->n; i++)
            if ((r->purpose != FOR_PANORAMA || rig_makes_panoramas(r, i)) && rig_to_delete(r, i) >= 0 && r->body[i].condition == RIG_READY)
                rig_set_step(r, i, STEP_DELETE);
    rig_pump_all(r, now);
}
void rig_press_camera(struct rig *r, int64_t now, int i)
{
    if (r->phase != PHASE_FIRE || !r->body[i].part)
        return;
    r->body[i].press = true;
    rig_pump(r, i, now);
    rig_settle(r, now);
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
        rig_begin_fire(r, now);
    } else if (err == -ECANCELED && !pressed_ns && rig_waits_for_button(r)) {
        rig_fail_take(r, now, "cancelled; the button was not pressed");
    } else if (refused) {
        rig_fail_take(r, now, "the trigger refused the shot: %s; no shutter was pressed", strerror(-err));
    } else {
        if (err)
            rig_say(r, RIG_ERROR, CONFIG_NONE, "trigger: %s in the middle of a shot; what the cameras wrote is collected", strerror(-err));
        r->pressed_ns = pressed_ns ? pressed_ns : r->at_ns;
        r->late_ns = late_ns;
        r->shot_ns = r->pressed_ns;
        r->released_ns = now;
        r->quiet_until_ns = quiet_until_ns(r);
        r->phase = PHASE_EXPOSE;
        if (r->purpose == FOR_PANORAMA && !r->ledger.shot_utc_ms)
            r->ledger.shot_utc_ms = utc_at(r, r->pressed_ns);
        if (r->purpose == FOR_PANORAMA)
            rig_set_state(r, TAKE_EXPOSING); // until all of it is here
        if (r->purpose == FOR_TAKE) {
            r->ledger.synchronised = r->abilities >= 0 && (r->abilities & TRIGGER_SYNCHRONISED);
            r->ledger.jitter_ns = late_ns;
            r->ledger.shot_utc_ms = utc_at(r, r->pressed_ns);
            rig_set_state(r, TAKE_EXPOSING);
        }
    }
    rig_settle(r, now);
}
void rig_manifest_written(struct rig *r, int64_t now, int err)
{
    if (r->phase == PHASE_MANIFEST)
        conclude(r, now, err);
    rig_settle(r, now);
}
