// tests/rig_world.h - a world for the rig's state machine on virtual time: workers, cameras, trigger, head and disk.
//
// It obeys every action after a random time and checks, at each one, what must never happen: a command to a camera while shutters are
// held, a copy under a name that is not durable, a deletion before `verified` is durable, two commands at once, an exposure whose
// entry in the ledger is not durable.
#pragma once
#include "rigd/rig.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#define MS INT64_C(1000000)
#define S (1000 * MS)
enum { CARD_MAX = 64, N_MAX = CONFIG_CAMERAS_MAX };

// What is wrong with a camera. Counters count down; -1 is for ever.
struct fault {
    int hang[CAMERA_N_COMMANDS];  // no answer
    int crash[CAMERA_N_COMMANDS]; // the worker dies of it
    int lost[CAMERA_N_COMMANDS];  // fails with LOST
    int busy[CAMERA_N_COMMANDS];
    int fails[CAMERA_N_COMMANDS]; // with trouble below
    enum camera_trouble trouble;
    bool dead;          // nothing opens it,
    bool power_heals, relay_heals, reset_heals; // but this
    int lost_events;    // COLLECT hears nothing, the card has it
    int no_shot;        // the shutter does not open
    int extra;          // writes one file more
    bool wrong_setting, low_battery, autofocus, no_card;
    int unreadable;     // LibRaw does not know this copy
    int no_start;       // its worker cannot be started (no memory, no program)
    int late_file;      // the picture is announced and listed after the next exposure only
};

// How the panorama camera made a file.
struct picture {
    double exposure_s, f_number, yaw_deg, pitch_deg;
    bool head_moved; // while it was exposed
};

struct sim_camera {
    bool worker, open;
    int n_card;                       // objects on the card, numbered from 1
    bool on_card[CARD_MAX * 100];
    int n_new;                        // not yet announced
    int take_first;                   // first object of the current take
    int n_thumbnails;                 // that were fetched
    uint32_t seq;
    bool in_flight;
    struct camera_command command;
    int generation;                   // of the worker: answers of a killed one do not arrive
    double lag_ms, jitter_ms;
    struct fault fault;
};

enum what { W_HELLO, W_ANSWER, W_GONE, W_COMMITTED, W_SPACE, W_FIRED, W_FLASH, W_MANIFEST, W_PRESS, W_CALL, W_HEAD, W_PERSON };
struct happening {
    int64_t at_ns;
    uint64_t order;
    enum what what;
    int camera, generation;
    int64_t value;
};

struct copy { char file[64]; int camera, object; };

static struct world {
    struct rig *rig;
    struct config config;
    int64_t now;
    uint64_t random, order;
    struct happening heap[8192];
    int n_heap;
    struct sim_camera camera[N_MAX];
    // disk
    struct ledger durable, pending;
    bool has_durable;
    int commit_err, n_commit_fails, create_err, manifest_err;
    int64_t free_bytes;
    struct copy copy[N_MAX * 8];
    int n_copies;
    // trigger
    bool shutters_held, calibrating;
    int64_t silent_until_ns; // INT64_MAX: it is not known yet when the last exposure ends
    int64_t exposed_ns, released_ns;
    int n_to_open;           // pressed bodies whose shutter has not opened
    double shutter_s;
    int n_fired, fire_err, n_fire_refusals, abilities;
    int64_t fire_lead_ns[16]; // of each shot that was asked for, the last ones: how long before it was due
    int n_fires_asked;
    bool waits_for_button;   // loaded, not pressed
    struct trigger_shot loaded;
    int64_t open_first_ns[N_MAX];
    bool supply_off[N_MAX];
    // what was seen
    int n_takes_done, n_preflights_done, n_lags_done, n_kills, n_said, n_not_started;
    int n_identified[N_MAX];
    char identified[320]; // the last one's text
    uint64_t trace; // hash of all actions
    char said[400][320];
    int64_t quarantined_ns[N_MAX], ready_again_ns[N_MAX];
    int64_t last_copy_ns[N_MAX];
    // panorama
    struct picture picture[2000]; // by number of the file
    double shutter_set_s, shortest_s, longest_s, f_number; // what its camera is set to, and can
    double brightest, darkest;    // of what it sees: signal per second
    double head_yaw_deg, head_pitch_deg, head_to_yaw_deg, head_to_pitch_deg;
    bool head_moves, nobody_there;
    int n_head_fails, n_head_moves, n_head_silent, n_prompts;
    int n_steps[4];
} w;

static inline uint64_t random_bits(void)
{
    w.random ^= w.random << 13, w.random ^= w.random >> 7, w.random ^= w.random << 17;
    return w.random;
}

static inline double uniform(double a, double b)
{
    return a + (b - a) * (double)(random_bits() >> 11) * 0x1p-53;
}

static inline double normal(void)
{
    double sum = -6;
    for (int i = 0; i < 12; i++)
        sum += uniform(0, 1);
    return sum;
}

static inline bool before(const struct happening *a, const struct happening *b)
{
    return a->at_ns != b->at_ns ? a->at_ns < b->at_ns : a->order < b->order;
}

static inline void later(int64_t delay_ns, enum what what, int camera, int64_t value)
{
    assert_true(w.n_heap < (int)(sizeof(w.heap) / sizeof(w.heap[0])));
    struct happening h = { w.now + delay_ns, w.order++, what, camera, camera >= 0 ? w.camera[camera].generation : 0, value };
    int k = w.n_heap++;
    for (; k > 0 && before(&h, &w.heap[(k - 1) / 2]); k = (k - 1) / 2)
        w.heap[k] = w.heap[(k - 1) / 2];
    w.heap[k] = h;
}

static inline struct happening next_happening(void)
{
    const struct happening first = w.heap[0], last = w.heap[--w.n_heap];
    int k = 0;
    for (int child; (child = 2 * k + 1) < w.n_heap; k = child) {
        if (child + 1 < w.n_heap && before(&w.heap[child + 1], &w.heap[child]))
            child++;
        if (!before(&w.heap[child], &last))
            break;
        w.heap[k] = w.heap[child];
    }
    w.heap[k] = last;
    return first;
}

static inline void name_object(struct camera_object *o, int number)
{
    snprintf(o->folder, sizeof(o->folder), "/store_00010001/DCIM/%03dNIKON", 100 + number / 9999);
    snprintf(o->name, sizeof(o->name), "DSC_%04d.NEF", 1 + (number - 1) % 9999);
    o->size_bytes = 8000000 + number;
}

static inline int object_number(const struct camera_object *o)
{
    int folder = 0, file = 0;
    if (sscanf(o->folder, "/store_00010001/DCIM/%3d", &folder) == 1 && sscanf(o->name, "DSC_%4d", &file) == 1)
        return (folder - 100) * 9999 + file;
    return 0;
}

static inline void hash_of(char hex[33], int camera, int number)
{
    snprintf(hex, 33, "%016x%016x", camera + 1, number);
}

static inline bool strikes(int *counter)
{
    if (!*counter)
        return false;
    if (*counter > 0)
        --*counter;
    return true;
}

static inline const struct ledger_object *durable_object(int camera, const struct camera_object *o)
{
    if (!w.has_durable)
        return NULL;
    if (w.durable.kind != LEDGER_PANORAMA)
        return ledger_find(&w.durable.camera[camera], o);
    const struct ledger_object *found = NULL;
    for (int e = 0; e < w.durable.n_cameras && !found; e++)
        found = ledger_find(&w.durable.camera[e], o);
    return found;
}

static inline bool is_panorama_camera(int i)
{
    return i == config_panorama_camera(&w.config);
}

static inline void expose(int i)
{
    struct sim_camera *c = &w.camera[i];
    if (w.abilities ? w.supply_off[i] || c->fault.dead : !c->open) // a wire presses whatever the worker does
        return;
    if (strikes(&c->fault.no_shot))
        return;
    const int n_files = w.config.objects_per_shot + strikes(&c->fault.extra);
    for (int n = 0; n < n_files; n++) {
        c->n_card++;
        assert_true(c->n_card < (int)(sizeof(c->on_card) / sizeof(c->on_card[0])));
        c->on_card[c->n_card] = true;
        c->n_new++;
        if (is_panorama_camera(i)) {
            assert_true(c->n_card < (int)(sizeof(w.picture) / sizeof(w.picture[0])));
            w.picture[c->n_card] = (struct picture){ w.shutter_set_s, w.f_number, w.head_yaw_deg, w.head_pitch_deg, w.head_moves };
        }
    }
}

// What the panorama camera's file shows: brightness times time, and where it clips.
static inline void judge(struct camera_event *e, int number)
{
    const struct picture *p = &w.picture[number];
    struct bracket_statistics *s = &e->frame.light;
    e->judged = true;
    e->frame.f_number = p->f_number;
    e->frame.iso = 100;
    snprintf(e->frame.serial, sizeof(e->frame.serial), "%s", w.config.camera[w.config.panorama.camera].serial);
    s->exposure_s = p->exposure_s;
    for (int k = 0; k < 3; k++) {
        s->n_sites[k] = 1000000;
        s->brightest[k] = fmin(1, w.brightest * p->exposure_s);
        s->n_over[k] = s->brightest[k] > .9 ? 50 : 0;
        s->first_percentile[k] = fmin(1, w.darkest * p->exposure_s);
        s->median[k] = fmin(1, 10 * w.darkest * p->exposure_s);
    }
}

// ---- the worker's side ----------------------------------------------------------------------------------------------------------

static inline void reply(int i, struct camera_event *e)
{
    struct sim_camera *c = &w.camera[i];
    e->seq = c->seq;
    e->command = c->command.kind;
    if (e->kind == CAMERA_DONE || e->kind == CAMERA_FAILED)
        c->in_flight = false;
    rig_camera_event(w.rig, w.now, i, e);
}

static inline void fail_with(int i, enum camera_trouble trouble, int err, const char *text)
{
    struct camera_event e = { .kind = CAMERA_FAILED, .trouble = trouble, .err = err };
    snprintf(e.text, sizeof(e.text), "%s", text);
    reply(i, &e);
}

static inline void answer_list(int i)
{
    struct sim_camera *c = &w.camera[i];
    struct camera_event e = { .kind = CAMERA_DONE };
    int after = 0;
    for (int n = 1; n <= c->n_card; n++)
        e.n_objects += c->on_card[n];
    if (!c->command.n_objects) {
        int newest = c->n_card;
        while (newest && !c->on_card[newest])
            newest--;
        if (newest) {
            name_object(&e.object[0], newest);
            e.n_listed = 1;
        }
    } else {
        if (c->command.n_after)
            after = object_number(&c->command.after[0]);
        for (int n = after + 1; n <= c->n_card; n++) {
            if (!c->on_card[n])
                continue;
            if (e.n_listed == 1) { // as short as can be, so that paging is exercised
                e.more = true;
                break;
            }
            name_object(&e.object[e.n_listed++], n);
        }
        c->n_new = 0;
    }
    reply(i, &e);
}

static inline void answer(int i)
{
    struct sim_camera *c = &w.camera[i];
    const struct camera_command *k = &c->command;
    struct camera_event e = { .kind = CAMERA_DONE };
    if (strikes(&c->fault.hang[k->kind]))
        return;
    if (strikes(&c->fault.crash[k->kind])) {
        later(MS, W_GONE, i, 0);
        return;
    }
    if (strikes(&c->fault.lost[k->kind])) {
        c->open = false;
        fail_with(i, CAMERA_LOST, -EIO, "I/O error");
        return;
    }
    if (strikes(&c->fault.busy[k->kind])) {
        fail_with(i, CAMERA_BUSY, -EBUSY, "device busy (0x2019)");
        return;
    }
    if (strikes(&c->fault.fails[k->kind])) {
        fail_with(i, c->fault.trouble, -EIO, "as told");
        return;
    }
    if (k->kind != CAMERA_OPEN && !c->open) {
        fail_with(i, CAMERA_LOST, -ENODEV, "no such device");
        return;
    }
    switch (k->kind) {
    case CAMERA_OPEN:
        if (k->reset && c->fault.reset_heals)
            c->fault.dead = false;
        if (c->fault.dead || w.supply_off[i]) {
            fail_with(i, CAMERA_LOST, -ENODEV, "no such device");
            return;
        }
        c->open = true;
        snprintf(e.facts.serial, sizeof(e.facts.serial), "%s", w.config.camera[i].serial);
        strcpy(e.facts.model, "Nikon DSC D850");
        strcpy(e.facts.firmware, "1.20");
        if (!w.open_first_ns[i])
            w.open_first_ns[i] = w.now;
        break;
    case CAMERA_CONFIGURE:
        e.n_settings = k->n_settings;
        for (int s = 0; s < k->n_settings; s++) {
            memcpy(e.setting[s].name, k->setting[s].name, sizeof(e.setting[s].name));
            memcpy(e.setting[s].wanted, k->setting[s].value, sizeof(e.setting[s].wanted));
            memcpy(e.setting[s].found, k->setting[s].value, sizeof(e.setting[s].found));
            e.setting[s].equal = !c->fault.wrong_setting;
            if (is_panorama_camera(i) && !strcmp(k->setting[s].name, "shutter")) {
                double above = 0, below = 1;
                sscanf(k->setting[s].value, "%lf/%lf", &above, &below);
                char label[16];
                const double t = ledger_exposure_label(above / below, label);
                e.setting[s].equal = t > .99 * w.shortest_s && t < 1.01 * w.longest_s;
                if (e.setting[s].equal)
                    w.shutter_set_s = t;
            }
        }
        break;
    case CAMERA_STATUS:
        e.status = (struct camera_status){ c->fault.low_battery ? 3 : 80, !c->fault.no_card, 1000, INT64_C(1) << 36, .1, !c->fault.autofocus, 1, -1, "50mm" };
        break;
    case CAMERA_DRAIN:
        c->n_new = 0;
        break;
    case CAMERA_TRIGGER:
        e.pressed_ns = w.now;
        expose(i);
        break;
    case CAMERA_COLLECT:
        if (strikes(&c->fault.lost_events))
            c->n_new = 0;
        e.n_objects = c->n_new;
        for (; c->n_new > 0; c->n_new--) {
            struct camera_event o = { .kind = CAMERA_OBJECT, .at_ns = w.now };
            name_object(&o.object[0], c->n_card - c->n_new + 1);
            reply(i, &o);
        }
        break;
    case CAMERA_LIST:
        answer_list(i);
        return;
    case CAMERA_FETCH: {
        const struct ledger_object *o = durable_object(i, &k->object);
        char path[600];
        snprintf(path, sizeof(path), "/takes/%s/%s", w.durable.id, o ? o->file : "?");
        assert_non_null(o); // the name of a copy is durable before there is a copy
        assert_string_equal(k->path, path);
        const int number = object_number(&k->object);
        assert_true(c->on_card[number]);
        struct copy *copy = NULL;
        for (int n = 0; n < w.n_copies; n++)
            if (w.copy[n].camera == i && !strcmp(w.copy[n].file, o->file))
                copy = &w.copy[n];
        if (!copy) {
            copy = &w.copy[w.n_copies++];
            snprintf(copy->file, sizeof(copy->file), "%s", o->file);
            copy->camera = i;
            copy->object = number;
        }
        assert_int_equal(copy->object, number); // one name, one frame
        e.size_bytes = k->object.size_bytes;
        hash_of(e.xxh128, i, number);
        if (k->judge[0] && !strikes(&c->fault.unreadable))
            judge(&e, number);
        w.last_copy_ns[i] = w.now;
        break;
    }
    case CAMERA_THUMBNAIL:
        c->n_thumbnails++;
        hash_of(e.xxh128, i, 0);
        break;
    case CAMERA_DELETE: {
        const struct ledger_object *o = durable_object(i, &k->object);
        assert_non_null(o);
        assert_int_equal(w.durable.state, TAKE_VERIFIED);
        assert_string_equal(o->xxh128, k->xxh128);
        bool copied = false;
        for (int n = 0; n < w.n_copies; n++)
            copied |= w.copy[n].camera == i && w.copy[n].object == object_number(&k->object);
        assert_true(copied);
        c->on_card[object_number(&k->object)] = false;
        break;
    }
    default:
        break;
    }
    reply(i, &e);
}

// ---- actions --------------------------------------------------------------------------------------------------------------------

static inline void copy_ledger(struct ledger *to, const struct ledger *from)
{
    ledger_free(to);
    *to = *from;
    to->camera = calloc((size_t)from->n_cameras + 1, sizeof(*to->camera));
    memcpy(to->camera, from->camera, (size_t)from->n_cameras * sizeof(*to->camera));
}

static inline int64_t latency(const struct camera_command *c)
{
    switch (c->kind) {
    case CAMERA_OPEN:
        return (int64_t)(uniform(60, 200) * MS);
    case CAMERA_FETCH:
        return (int64_t)(uniform(150, 400) * MS);
    case CAMERA_COLLECT:
        return (int64_t)(uniform(80, 300) * MS);
    case CAMERA_DRAIN:
        return 200 * MS;
    default:
        return (int64_t)(uniform(2, 30) * MS);
    }
}

// The trigger carries out a shot.
static inline void execute(const struct trigger_shot *shot)
{
    w.shutters_held = true;
    w.n_fired++;
    w.exposed_ns = w.released_ns = shot->at_ns + (int64_t)shot->hold_ms * MS;
    w.n_to_open = 0;
    for (int i = 0; i < w.config.n_cameras; i++) {
        if (shot->skip[i / 64] >> i % 64 & 1)
            continue;
        const int64_t press = shot->at_ns - w.now + (int64_t)shot->delay_us[i] * 1000;
        const int64_t release = w.now + press + (int64_t)shot->hold_ms * MS;
        later(press, W_PRESS, i, 0);
        w.n_to_open++;
        w.released_ns = release > w.released_ns ? release : w.released_ns;
        assert_true(shot->half_ms + shot->delay_us[i] / 1000 + shot->hold_ms <= w.config.trigger.max_hold_ms); // it would be refused
    }
    later(w.released_ns - w.now, W_FIRED, -1, shot->at_ns);
}

static inline void press_button(void)
{
    assert_true(w.waits_for_button);
    w.waits_for_button = false;
    w.loaded.at_ns = w.now + (int64_t)w.loaded.half_ms * MS;
    execute(&w.loaded);
}

static inline void obey(const struct rig_action *a)
{
    struct sim_camera *c = a->camera >= 0 ? &w.camera[a->camera] : NULL;
    w.trace = (w.trace ^ (uint64_t)a->kind ^ (uint64_t)a->camera << 8 ^ (uint64_t)w.now) * UINT64_C(0x100000001b3);
    switch (a->kind) {
    case RIG_SPAWN:
        assert_false(c->worker);
        c->worker = true;
        c->generation++;
        c->in_flight = c->open = false;
        if (strikes(&c->fault.no_start)) {
            c->worker = false;
            w.n_not_started++;
            rig_worker_gone(w.rig, w.now, a->camera, "cannot start: Cannot allocate memory");
            break;
        }
        later((int64_t)(uniform(30, 90) * MS), W_HELLO, a->camera, 0);
        break;
    case RIG_KILL:
        assert_true(c->worker);
        w.n_kills++;
        later((int64_t)(uniform(1, 20) * MS), W_GONE, a->camera, 0);
        break;
    case RIG_SEND:
        assert_true(c->worker);
        assert_false(c->in_flight);
        if (a->command.kind != CAMERA_TRIGGER) {
            assert_false(w.shutters_held);
            assert_true(w.now >= w.silent_until_ns);
        }
        assert_true(a->command.seq > 0);
        c->in_flight = true;
        c->command = a->command;
        c->seq = a->command.seq;
        w.trace = (w.trace ^ (uint64_t)a->command.kind) * UINT64_C(0x100000001b3);
        later(latency(&a->command), W_ANSWER, a->camera, 0);
        break;
    case RIG_POWER:
    case RIG_RELAY:
        w.supply_off[a->camera] = !a->on;
        if (!a->on)
            c->open = false;
        if (a->on && (a->kind == RIG_POWER ? c->fault.power_heals : c->fault.relay_heals))
            c->fault.dead = false;
        break;
    case RIG_SPACE:
        later(MS, W_SPACE, -1, w.free_bytes);
        break;
    case RIG_CREATE:
    case RIG_COMMIT:
        if (a->kind == RIG_CREATE && rig_ledger(w.rig)->kind == LEDGER_CAPTURE)
            w.silent_until_ns = INT64_MAX; // all have answered; what is sent now may still be on its way at half-press
        copy_ledger(&w.pending, rig_ledger(w.rig));
        later((int64_t)(uniform(2, 40) * MS), W_COMMITTED, -1, a->kind == RIG_CREATE);
        break;
    case RIG_FIRE:
        if (w.has_durable && w.durable.kind == LEDGER_PANORAMA && !w.calibrating) {
            const struct ledger *l = rig_ledger(w.rig);
            int n_open = 0;
            for (int e = 0; e < l->n_cameras; e++) // the exposure that is made now is noted, and what was on the card before it
                if (l->camera[e].expected && l->camera[e].debt == DEBT_OPEN) {
                    n_open++;
                    assert_true(e < w.durable.n_cameras);
                    assert_memory_equal(l->camera[e].before, w.durable.camera[e].before, sizeof(l->camera[e].before));
                    assert_true(l->camera[e].exposure.wanted_s == w.durable.camera[e].exposure.wanted_s);
                }
            assert_int_equal(n_open, 1);
            assert_false(w.head_moves);
        } else if (!w.calibrating) {
            assert_true(w.has_durable);
            assert_int_equal(w.durable.state, TAKE_ARMED); // before any shutter moves
        }
        for (int i = 0; i < w.config.n_cameras; i++) // a camera that hears something now may lock up
            if (!(a->shot.skip[i / 64] >> i % 64 & 1))
                assert_false(w.camera[i].in_flight);
        w.fire_lead_ns[w.n_fires_asked++ % 16] = a->shot.at_ns - w.now;
        if (w.n_fire_refusals > 0) {
            w.n_fire_refusals--;
            rig_fired(w.rig, w.now, -ETIME, 0, 0);
            break;
        }
        w.silent_until_ns = INT64_MAX;
        w.loaded = a->shot;
        w.waits_for_button = a->shot.on_button;
        if (!w.waits_for_button)
            execute(&a->shot);
        break;
    case RIG_RELEASE:
        if (w.waits_for_button) {
            w.waits_for_button = false;
            w.silent_until_ns = 0; // no shot
            later(MS, W_CALL, -1, 0);
        }
        w.shutters_held = false;
        break;
    case RIG_MANIFEST:
        later(20 * MS, W_MANIFEST, -1, 0);
        break;
    case RIG_SAY:
        if (a->severity == RIG_ERROR && a->camera >= 0 && strstr(a->text, "quarantined"))
            w.quarantined_ns[a->camera] = w.now;
        if (a->severity == RIG_INFO && a->camera >= 0 && strstr(a->text, "works again"))
            w.ready_again_ns[a->camera] = w.now;
        if (w.n_said < 400)
            snprintf(w.said[w.n_said++], 320, "%s", a->text);
        break;
    case RIG_TAKE_DONE:
        w.n_takes_done++;
        break;
    case RIG_PREFLIGHT_DONE:
        w.n_preflights_done++;
        break;
    case RIG_LAG_DONE:
        w.n_lags_done++;
        break;
    case RIG_STATE:
        if (rig_state(w.rig) == TAKE_FAILED && !w.shutters_held)
            w.silent_until_ns = 0; // no shot
        break;
    case RIG_IDENTIFIED:
        w.n_identified[a->camera]++;
        memcpy(w.identified, a->text, sizeof(w.identified));
        break;
    case RIG_HEAD:
        assert_false(w.shutters_held);
        if (w.head_moves) {
            rig_head_arrived(w.rig, w.now, -EBUSY);
            break;
        }
        w.n_head_moves++;
        w.head_moves = true;
        w.head_to_yaw_deg = 1e-3 * a->head.yaw_mdeg;
        w.head_to_pitch_deg = 1e-3 * a->head.pitch_mdeg;
        later((int64_t)(uniform(500, 4000) * MS), W_HEAD, -1, 0);
        break;
    case RIG_PROMPT:
        w.n_prompts += a->on;
        if (a->on && !w.nobody_there)
            later((int64_t)(uniform(2, 200) * S), W_PERSON, -1, 0);
        break;
    case RIG_PROGRESS:
        w.n_steps[a->progress.step]++;
        break;
    }
}

// One more body was pressed: its shutter closes then. After the last of them is known, so is the end of the silence.
static inline void exposes_until(int64_t at_ns)
{
    w.exposed_ns = at_ns > w.exposed_ns ? at_ns : w.exposed_ns;
    if (!--w.n_to_open)
        w.silent_until_ns = w.exposed_ns;
}

static inline void happen(const struct happening *h)
{
    struct sim_camera *c = h->camera >= 0 ? &w.camera[h->camera] : NULL;
    if (c && (h->what == W_HELLO || h->what == W_ANSWER || h->what == W_GONE) && (h->generation != c->generation || !c->worker))
        return;
    switch (h->what) {
    case W_HELLO: {
        struct camera_event e = { .kind = CAMERA_HELLO, .protocol = CAMERA_PROTOCOL, .pid = 1 };
        rig_camera_event(w.rig, w.now, h->camera, &e);
        break;
    }
    case W_ANSWER:
        if (c->in_flight)
            answer(h->camera);
        break;
    case W_GONE:
        c->worker = c->open = c->in_flight = false;
        rig_worker_gone(w.rig, w.now, h->camera, "killed by signal 9");
        break;
    case W_COMMITTED: {
        int err = 0;
        if (h->value)
            err = w.create_err;
        else if (w.n_commit_fails)
            err = w.n_commit_fails > 0 ? (w.n_commit_fails--, w.commit_err) : w.commit_err;
        if (!err) {
            copy_ledger(&w.durable, &w.pending);
            w.has_durable = true;
        }
        rig_committed(w.rig, w.now, err);
        break;
    }
    case W_SPACE:
        rig_space(w.rig, w.now, h->value);
        break;
    case W_PRESS: {
        if (w.abilities == 0) {
            exposes_until(w.now);
            rig_press_camera(w.rig, w.now, h->camera);
            break;
        }
        const double lag_ms = c->lag_ms + c->jitter_ms * normal();
        expose(h->camera);
        exposes_until(w.now + (int64_t)(lag_ms * 1e6 + (is_panorama_camera(h->camera) ? w.shutter_set_s : w.shutter_s) * 1e9));
        if (w.abilities & TRIGGER_FEEDBACK)
            later((int64_t)(lag_ms * 1e6), W_FLASH, h->camera, w.now + (int64_t)(lag_ms * 1e6));
        break;
    }
    case W_FLASH:
        rig_feedback(w.rig, w.now, h->camera, h->value);
        break;
    case W_FIRED:
        w.shutters_held = false;
        rig_fired(w.rig, w.now, w.fire_err, h->value, 30000);
        break;
    case W_MANIFEST:
        rig_manifest_written(w.rig, w.now, w.manifest_err);
        break;
    case W_CALL: // released while it waited
        rig_fired(w.rig, w.now, -ECANCELED, 0, 0);
        break;
    case W_HEAD: {
        const bool fails = w.n_head_fails > 0;
        w.n_head_fails -= fails;
        w.head_moves = false;
        if (!fails)
            w.head_yaw_deg = w.head_to_yaw_deg, w.head_pitch_deg = w.head_to_pitch_deg;
        if (!strikes(&w.n_head_silent))
            rig_head_arrived(w.rig, w.now, fails ? -ETIME : 0);
        break;
    }
    case W_PERSON: {
        char why[200];
        double yaw, pitch;
        int stop, n_stops;
        if (sscanf(rig_prompt(w.rig), "stop %d of %d: turn the head to yaw %lf degrees (to the left is positive), pitch %lf", &stop, &n_stops, &yaw, &pitch) != 4)
            break; // it has gone
        w.head_yaw_deg = yaw, w.head_pitch_deg = pitch;
        assert_int_equal(rig_continue(w.rig, w.now, why), 0);
        break;
    }
    }
}

static inline void drain_actions(void)
{
    static struct rig_action a;
    while (rig_next(w.rig, &a))
        obey(&a);
}

// Until the rig rests (and nothing but heartbeats would come), or for so long.
static inline void run(int64_t for_ns, bool until_idle)
{
    const int64_t end = w.now + for_ns;
    drain_actions();
    for (;;) {
        if (until_idle && !rig_is_busy(w.rig))
            return;
        const int64_t due = rig_deadline_ns(w.rig);
        const int64_t happens = w.n_heap ? w.heap[0].at_ns : INT64_MAX;
        const int64_t at = due < happens ? due : happens;
        if (at > end) {
            w.now = end;
            return;
        }
        w.now = at > w.now ? at : w.now;
        if (happens <= due) {
            const struct happening h = next_happening();
            happen(&h);
        } else {
            const int64_t asked = due;
            rig_time(w.rig, w.now);
            drain_actions();
            assert_true(rig_deadline_ns(w.rig) > asked || w.n_heap); // no busy loop
        }
        drain_actions();
    }
}

static inline void set_up_with(int n_cameras, uint64_t seed, void (*also)(struct config *config))
{
    memset(&w, 0, sizeof(w));
    w.random = seed * UINT64_C(0x9e3779b97f4a7c15) + 1;
    w.now = 1000 * S;
    w.free_bytes = INT64_C(1) << 42;
    w.shutter_s = 1. / 125;
    w.abilities = TRIGGER_SYNCHRONISED | TRIGGER_HALF_PRESS | TRIGGER_DELAYS | TRIGGER_FEEDBACK | TRIGGER_RELAYS;
    struct config *c = &w.config;
    *c = (struct config){ .objects_per_shot = 1, .raw_mb = 30, .free_space_mb = 1000, .thumbnails = true, .fetch_limit = 8, .heartbeat_s = 25,
                          .battery_min_percent = 20, .clock_max_s = 5, .collect_timeout_ms = 3000, .fetch_timeout_ms = 60000,
                          .trigger = { .half_press_ms = 400, .hold_ms = 100, .max_hold_ms = 1000 } };
    strcpy(c->takes_dir, "/takes");
    c->n_cameras = n_cameras;
    c->camera = calloc((size_t)n_cameras, sizeof(*c->camera));
    for (int i = 0; i < n_cameras; i++) {
        struct config_camera *k = &c->camera[i];
        snprintf(k->name, sizeof(k->name), "A%02d", i);
        snprintf(k->serial, sizeof(k->serial), "60%05d", i);
        snprintf(k->port, sizeof(k->port), "usb:%d-%d.%d", i / 24 + 1, i / 6 % 4 + 1, i % 6 + 1);
        k->controller = i / 24;
        k->relay_line = k->full_line = k->half_line = k->feedback_line = CONFIG_NONE;
        k->n_settings = 2;
        k->setting[0] = (struct camera_setting){ "shutter", "1/125" };
        k->setting[1] = (struct camera_setting){ "iso", "100" };
        w.camera[i].lag_ms = i & 1 ? 117 : 97;
        w.camera[i].jitter_ms = i & 1 ? 3 : 7;
        w.camera[i].n_card = i % 3; // some cards are empty
        for (int n = 1; n <= w.camera[i].n_card; n++)
            w.camera[i].on_card[n] = true;
    }
    if (also)
        also(c);
    assert_int_equal(rig_create(&w.rig, c), 0);
    rig_trigger_is(w.rig, w.now, w.abilities);
    rig_start(w.rig, w.now);
}

static inline void set_up(int n_cameras, uint64_t seed)
{
    set_up_with(n_cameras, seed, NULL);
}

static inline void open_all(void)
{
    run(30 * S, false);
}

static inline void tear_down(void)
{
    rig_free(w.rig);
    free(w.config.camera);
    ledger_free(&w.durable);
    ledger_free(&w.pending);
}

static inline const struct ledger *capture_as(const char *id, bool without_missing)
{
    char why[200] = "";
    const struct rig_take take = { id, "story", "2026-11-22T09:00:00Z", 1795338000000, "/takes", NULL, false };
    w.n_copies = 0;
    w.has_durable = false;
    for (int i = 0; i < w.config.n_cameras; i++)
        w.camera[i].take_first = w.camera[i].n_card + 1;
    const int done = w.n_takes_done;
    if (rig_capture(w.rig, w.now, &take, without_missing, why))
        fail_msg("capture refused: %s", why);
    run(120 * S, true);
    assert_false(rig_is_busy(w.rig));
    drain_actions();
    assert_int_equal(w.n_takes_done, done + 1);
    return rig_ledger(w.rig);
}

static inline const struct ledger *capture(void)
{
    return capture_as("20261122T090000_story", false);
}

// Whatever happened: the ledger on disk is the rig's, each expected camera is accounted for, and what it says is true of the world.
static inline void check_accounts(const struct ledger *l)
{
    int n_copied = 0;
    for (int i = 0; i < w.config.n_cameras; i++) {
        const struct ledger_camera *c = &l->camera[i];
        if (!c->expected) {
            assert_true(c->note[0]);
            continue;
        }
        assert_int_not_equal(c->debt, DEBT_OPEN);
        if (c->debt == DEBT_MISSED)
            assert_true(c->note[0]);
        int n = 0;
        for (int k = 0; k < c->n_objects; k++) {
            const struct ledger_object *o = &c->object[k];
            const int number = object_number(&o->object);
            assert_true(number >= w.camera[i].take_first);
            n += o->state == OBJECT_COPIED || o->state == OBJECT_DELETED;
            bool here = false;
            char hex[33];
            hash_of(hex, i, number);
            for (int m = 0; m < w.n_copies; m++)
                here |= w.copy[m].camera == i && w.copy[m].object == number && !strcmp(w.copy[m].file, o->file);
            if (o->state == OBJECT_COPIED || o->state == OBJECT_DELETED) {
                assert_true(here);
                assert_string_equal(o->xxh128, hex);
            }
            assert_true(here || w.camera[i].on_card[number]); // never neither here nor there
        }
        n_copied += n;
        if (c->debt == DEBT_PAID)
            assert_int_equal(n, w.camera[i].n_card - w.camera[i].take_first + 1);
    }
    assert_int_equal(n_copied <= w.n_copies, 1);
    assert_int_equal(l->state == TAKE_VERIFIED, ledger_is_whole(l) && !w.manifest_err);
    if (w.has_durable && !w.n_commit_fails) {
        assert_int_equal(l->state, w.durable.state);
        assert_string_equal(l->reason, w.durable.reason);
        assert_memory_equal(l->camera, w.durable.camera, (size_t)l->n_cameras * sizeof(*l->camera));
    }
    assert_false(w.shutters_held);
    for (int i = 0; i < w.config.n_cameras; i++)
        assert_false(w.supply_off[i]);
}
