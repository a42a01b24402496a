// tests/test_rig.c - stories of a whole rig on virtual time: what the state machine promises, whatever the cameras do.
//
// The world below plays workers, cameras, trigger and disk. It obeys every action after a random time and checks, at each one, what
// must never happen: a command to a camera while shutters are held, a copy under a name that is not durable, a deletion before
// `verified` is durable, two commands at once.
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
};

struct sim_camera {
    bool worker, open;
    int n_card;                       // objects on the card, numbered from 1
    bool on_card[CARD_MAX * 100];
    int n_new;                        // not yet announced
    int take_first;                   // first object of the current take
    uint32_t seq;
    bool in_flight;
    struct camera_command command;
    int generation;                   // of the worker: answers of a killed one do not arrive
    double lag_ms, jitter_ms;
    struct fault fault;
};

enum what { W_HELLO, W_ANSWER, W_GONE, W_COMMITTED, W_SPACE, W_FIRED, W_FLASH, W_MANIFEST, W_PRESS, W_CALL };
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
    int64_t open_first_ns[N_MAX];
    bool supply_off[N_MAX];
    // what was seen
    int n_takes_done, n_preflights_done, n_lags_done, n_kills, n_said;
    uint64_t trace; // hash of all actions
    char said[400][320];
    int64_t quarantined_ns[N_MAX], ready_again_ns[N_MAX];
    int64_t last_copy_ns[N_MAX];
} w;

static uint64_t random_bits(void)
{
    w.random ^= w.random << 13, w.random ^= w.random >> 7, w.random ^= w.random << 17;
    return w.random;
}

static double uniform(double a, double b)
{
    return a + (b - a) * (double)(random_bits() >> 11) * 0x1p-53;
}

static double normal(void)
{
    double sum = -6;
    for (int i = 0; i < 12; i++)
        sum += uniform(0, 1);
    return sum;
}

static bool before(const struct happening *a, const struct happening *b)
{
    return a->at_ns != b->at_ns ? a->at_ns < b->at_ns : a->order < b->order;
}

static void later(int64_t delay_ns, enum what what, int camera, int64_t value)
{
    assert_true(w.n_heap < (int)(sizeof(w.heap) / sizeof(w.heap[0])));
    struct happening h = { w.now + delay_ns, w.order++, what, camera, camera >= 0 ? w.camera[camera].generation : 0, value };
    int k = w.n_heap++;
    for (; k > 0 && before(&h, &w.heap[(k - 1) / 2]); k = (k - 1) / 2)
        w.heap[k] = w.heap[(k - 1) / 2];
    w.heap[k] = h;
}

static struct happening next_happening(void)
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

static void name_object(struct camera_object *o, int number)
{
    snprintf(o->folder, sizeof(o->folder), "/store_00010001/DCIM/%03dNIKON", 100 + number / 9999);
    snprintf(o->name, sizeof(o->name), "DSC_%04d.NEF", 1 + (number - 1) % 9999);
    o->size_bytes = 8000000 + number;
}

static int object_number(const struct camera_object *o)
{
    int folder = 0, file = 0;
    if (sscanf(o->folder, "/store_00010001/DCIM/%3d", &folder) == 1 && sscanf(o->name, "DSC_%4d", &file) == 1)
        return (folder - 100) * 9999 + file;
    return 0;
}

static void hash_of(char hex[33], int camera, int number)
{
    snprintf(hex, 33, "%016x%016x", camera + 1, number);
}

static bool strikes(int *counter)
{
    if (!*counter)
        return false;
    if (*counter > 0)
        --*counter;
    return true;
}

static const struct ledger_object *durable_object(int camera, const struct camera_object *o)
{
    if (!w.has_durable)
        return NULL;
    return ledger_find(&w.durable.camera[camera], o);
}

static void expose(int i)
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
    }
}

// ---- the worker's side ----------------------------------------------------------------------------------------------------------

static void reply(int i, struct camera_event *e)
{
    struct sim_camera *c = &w.camera[i];
    e->seq = c->seq;
    e->command = c->command.kind;
    if (e->kind == CAMERA_DONE || e->kind == CAMERA_FAILED)
        c->in_flight = false;
    rig_camera_event(w.rig, w.now, i, e);
}

static void fail_with(int i, enum camera_trouble trouble, int err, const char *text)
{
    struct camera_event e = { .kind = CAMERA_FAILED, .trouble = trouble, .err = err };
    snprintf(e.text, sizeof(e.text), "%s", text);
    reply(i, &e);
}

static void answer_list(int i)
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

static void answer(int i)
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
        w.last_copy_ns[i] = w.now;
        break;
    }
    case CAMERA_THUMBNAIL:
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

static void copy_ledger(struct ledger *to, const struct ledger *from)
{
    ledger_free(to);
    *to = *from;
    to->camera = calloc((size_t)from->n_cameras + 1, sizeof(*to->camera));
    memcpy(to->camera, from->camera, (size_t)from->n_cameras * sizeof(*to->camera));
}

static int64_t latency(const struct camera_command *c)
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

static void obey(const struct rig_action *a)
{
    struct sim_camera *c = a->camera >= 0 ? &w.camera[a->camera] : NULL;
    w.trace = (w.trace ^ (uint64_t)a->kind ^ (uint64_t)a->camera << 8 ^ (uint64_t)w.now) * UINT64_C(0x100000001b3);
    switch (a->kind) {
    case RIG_SPAWN:
        assert_false(c->worker);
        c->worker = true;
        c->generation++;
        c->in_flight = c->open = false;
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
        if (a->kind == RIG_CREATE)
            w.silent_until_ns = INT64_MAX; // all have answered; what is sent now may still be on its way at half-press
        copy_ledger(&w.pending, rig_ledger(w.rig));
        later((int64_t)(uniform(2, 40) * MS), W_COMMITTED, -1, a->kind == RIG_CREATE);
        break;
    case RIG_FIRE:
        if (!w.calibrating) {
            assert_true(w.has_durable);
            assert_int_equal(w.durable.state, TAKE_ARMED); // before any shutter moves
        }
        for (int i = 0; i < w.config.n_cameras; i++) // a camera that hears something now may lock up
            if (!(a->shot.skip[i / 64] >> i % 64 & 1))
                assert_false(w.camera[i].in_flight);
        if (w.n_fire_refusals > 0) {
            w.n_fire_refusals--;
            rig_fired(w.rig, w.now, -ETIME, 0, 0);
            break;
        }
        w.shutters_held = true;
        w.n_fired++;
        w.silent_until_ns = INT64_MAX;
        w.exposed_ns = w.released_ns = a->shot.at_ns + (int64_t)a->shot.hold_ms * MS;
        w.n_to_open = 0;
        for (int i = 0; i < w.config.n_cameras; i++) {
            if (a->shot.skip[i / 64] >> i % 64 & 1)
                continue;
            const int64_t press = a->shot.at_ns - w.now + (int64_t)a->shot.delay_us[i] * 1000;
            const int64_t release = w.now + press + (int64_t)a->shot.hold_ms * MS;
            later(press, W_PRESS, i, 0);
            w.n_to_open++;
            w.released_ns = release > w.released_ns ? release : w.released_ns;
            assert_true(a->shot.half_ms + a->shot.delay_us[i] / 1000 + a->shot.hold_ms <= w.config.trigger.max_hold_ms); // it would be refused
        }
        later(w.released_ns - w.now, W_FIRED, -1, a->shot.at_ns);
        break;
    case RIG_RELEASE:
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
    case RIG_HEAD:
    case RIG_PROMPT:
    case RIG_PROGRESS:
        break;
    }
}

// One more body was pressed: its shutter closes then. After the last of them is known, so is the end of the silence.
static void exposes_until(int64_t at_ns)
{
    w.exposed_ns = at_ns > w.exposed_ns ? at_ns : w.exposed_ns;
    if (!--w.n_to_open)
        w.silent_until_ns = w.exposed_ns;
}

static void happen(const struct happening *h)
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
        exposes_until(w.now + (int64_t)(lag_ms * 1e6 + w.shutter_s * 1e9));
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
    case W_CALL:
        break;
    }
}

static void drain_actions(void)
{
    static struct rig_action a;
    while (rig_next(w.rig, &a))
        obey(&a);
}

// Until the rig rests (and nothing but heartbeats would come), or for so long.
static void run(int64_t for_ns, bool until_idle)
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

static void set_up(int n_cameras, uint64_t seed)
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
    assert_int_equal(rig_create(&w.rig, c), 0);
    rig_trigger_is(w.rig, w.now, w.abilities);
    rig_start(w.rig, w.now);
}

static void open_all(void)
{
    run(30 * S, false);
}

static void tear_down(void)
{
    rig_free(w.rig);
    free(w.config.camera);
    ledger_free(&w.durable);
    ledger_free(&w.pending);
}

static const struct ledger *capture_as(const char *id, bool without_missing)
{
    char why[200] = "";
    const struct rig_take take = { id, "story", "2026-11-22T09:00:00Z", 1795338000000, "/takes", NULL };
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

static const struct ledger *capture(void)
{
    return capture_as("20261122T090000_story", false);
}

// Whatever happened: the ledger on disk is the rig's, each expected camera is accounted for, and what it says is true of the world.
static void check_accounts(const struct ledger *l)
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

// ---- stories --------------------------------------------------------------------------------------------------------------------------

static void two_hundred_cameras_deliver_every_frame(void **state)
{
    (void)state;
    set_up(200, 1);
    open_all();
    for (int i = 0; i < 200; i++)
        assert_int_equal(rig_camera(w.rig, i).condition, RIG_READY);
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_int_equal(w.n_copies, 200);
    assert_true(l->synchronised);
    assert_int_equal(l->n_measured, 200);
    assert_string_equal(l->camera[7].object[0].file, "raw/A07.nef");
    assert_int_equal(w.n_kills, 0);
    tear_down();
}

static void the_same_inputs_give_the_same_actions(void **state)
{
    (void)state;
    uint64_t trace[2];
    for (int k = 0; k < 2; k++) {
        set_up(30, 5);
        w.camera[3].fault.hang[CAMERA_FETCH] = 1;
        open_all();
        capture();
        trace[k] = w.trace;
        tear_down();
    }
    assert_true(trace[0] == trace[1]);
}

static void a_lost_event_is_found_on_the_card(void **state)
{
    (void)state;
    set_up(6, 2);
    open_all();
    w.camera[1].fault.lost_events = 1;
    w.camera[4].fault.lost_events = 1;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    tear_down();
}

static void a_camera_that_came_back_is_not_waited_for_but_its_card_is_read(void **state)
{
    (void)state;
    set_up(6, 2);
    open_all();
    w.camera[1].fault.crash[CAMERA_COLLECT] = 2; // its events went with the worker
    w.camera[4].fault.hang[CAMERA_COLLECT] = 2;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_int_equal(w.camera[1].fault.crash[CAMERA_COLLECT], 1);
    assert_int_equal(w.camera[4].fault.hang[CAMERA_COLLECT], 1);
    tear_down();
}

static void a_shutter_that_stays_closed_is_named_with_slot_and_remedy(void **state)
{
    (void)state;
    set_up(6, 3);
    open_all();
    w.camera[2].fault.no_shot = 1;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_FAILED);
    assert_non_null(strstr(l->reason, "A02"));
    bool named = false;
    for (int i = 0; i < w.n_said; i++)
        named |= strstr(w.said[i], "A02") && strstr(w.said[i], "usb:1-1.3") && strstr(w.said[i], "heck");
    assert_true(named);
    tear_down();
}

// Each fault at each command, once: the take is whole, the others are not disturbed.
static void one_fault_at_any_command_costs_no_frame(void **state)
{
    (void)state;
    for (int kind = CAMERA_CONFIGURE; kind <= CAMERA_THUMBNAIL; kind++) {
        for (int fault = 0; fault < 4; fault++) {
            if (kind == CAMERA_TRIGGER)
                continue;
            set_up(5, 100 + (uint64_t)(kind * 8 + fault));
            open_all();
            struct fault *f = &w.camera[2].fault;
            *(fault == 0 ? &f->hang[kind] : fault == 1 ? &f->crash[kind] : fault == 2 ? &f->lost[kind] : &f->busy[kind]) = fault == 3 ? 4 : 1;
            const struct ledger *l = capture();
            check_accounts(l);
            if (l->state != TAKE_VERIFIED)
                fail_msg("%s with fault %d: %s", camera_command_name(kind), fault, l->reason);
            for (int i = 0; i < 5; i++)
                assert_int_equal(rig_camera(w.rig, i).condition, RIG_READY);
            tear_down();
        }
    }
}

// The world asserts it at each command; here something happens that makes the rig want to send.
static void nothing_is_sent_from_the_last_answer_before_half_press_to_the_end_of_exposure(void **state)
{
    (void)state;
    for (int calibrated = 0; calibrated < 2; calibrated++)
        for (int ms = 0; ms < 3000; ms += 50) {
            const struct rig_take take = { "20261122T090000_story", "story", "2026-11-22T09:00:00Z", 1795338000000, "/takes", NULL };
            struct lag lag[5];
            char why[200];
            set_up(5, 200 + (uint64_t)ms);
            w.shutter_s = 1.6;
            for (int i = 0; i < 5; i++) {
                strcpy(w.config.camera[i].setting[0].value, "1.6");
                lag[i] = (struct lag){ .mean_ms = w.camera[i].lag_ms, .std_ms = w.camera[i].jitter_ms, .n = 30 };
                w.camera[i].take_first = w.camera[i].n_card + 1;
            }
            w.config.camera[2].relay_line = 7;
            if (calibrated) {
                rig_set_lag(w.rig, lag);
            } else { // nothing is known, nothing is seen, and a body slept
                w.camera[3].lag_ms += 200;
                w.abilities &= ~TRIGGER_FEEDBACK;
                rig_trigger_is(w.rig, w.now, w.abilities);
            }
            open_all();
            assert_int_equal(rig_capture(w.rig, w.now, &take, false, why), 0);
            while (w.silent_until_ns != INT64_MAX)
                run(MS, false);
            run(ms * MS, false);
            const bool silent = w.now < w.silent_until_ns;
            for (int crashes = 0; crashes < 5 && silent && w.now < w.silent_until_ns; crashes++) { // enough for each rung of the ladder
                w.camera[2].worker = w.camera[2].open = w.camera[2].in_flight = false;
                rig_worker_gone(w.rig, w.now, 2, "killed by signal 11");
                run(MS, false);
                assert_false(w.supply_off[2]);
                run(99 * MS, false); // it is back, and could be opened
            }
            run(120 * S, true);
            drain_actions();
            const struct ledger *l = rig_ledger(w.rig);
            check_accounts(l);
            if (l->state != TAKE_VERIFIED)
                fail_msg("crash after %d ms: %s", ms, l->reason);
            assert_true(silent || ms > 1500);
            tear_down();
        }
}

static void others_do_not_wait_for_a_camera_in_trouble(void **state)
{
    (void)state;
    int64_t undisturbed[20];
    for (int run_with_fault = 0; run_with_fault < 2; run_with_fault++) {
        set_up(20, 7);
        w.config.fetch_limit = 20;
        open_all();
        if (run_with_fault)
            w.camera[5].fault.hang[CAMERA_FETCH] = -1;
        const int64_t begin = w.now;
        const struct ledger *l = capture();
        check_accounts(l);
        for (int i = 0; i < 20; i++) {
            if (!run_with_fault)
                undisturbed[i] = w.last_copy_ns[i] - begin;
            else if (i != 5) // the random numbers are drawn in another order: only by that may it differ
                assert_true(w.last_copy_ns[i] - begin < undisturbed[i] + 900 * MS);
        }
        if (run_with_fault) {
            assert_int_equal(l->state, TAKE_FAILED);
            assert_int_equal(l->camera[5].debt, DEBT_MISSED);
            assert_int_equal(rig_camera(w.rig, 5).condition, RIG_QUARANTINED);
        }
        tear_down();
    }
}

static void a_camera_is_recovered_or_quarantined_within_15_s(void **state)
{
    (void)state;
    for (int story = 0; story < 5; story++) {
        set_up(4, 40 + (uint64_t)story);
        strcpy(w.config.camera[1].power, "1-4:3");
        w.config.camera[1].relay_line = 9;
        if (story == 4)
            w.config.camera[1].power[0] = 0, w.config.camera[1].relay_line = CONFIG_NONE;
        open_all();
        struct fault *f = &w.camera[1].fault;
        f->dead = true;
        f->reset_heals = story == 1, f->power_heals = story == 2, f->relay_heals = story == 3;
        w.camera[1].open = false;
        run(26 * S, false); // a heartbeat notices
        const int64_t noticed = w.now;
        run(60 * S, false);
        if (story == 0 || story == 4) {
            assert_true(w.quarantined_ns[1] > 0);
            assert_true(w.quarantined_ns[1] - noticed <= 15 * S);
        } else {
            assert_true(w.ready_again_ns[1] > 0);
            assert_int_equal(rig_camera(w.rig, 1).condition, RIG_READY);
            assert_true(w.quarantined_ns[1] == 0);
        }
        assert_false(w.supply_off[1]);
        if (story == 0) { // comes back by itself, when somebody plugged it in
            f->dead = false;
            run(90 * S, false);
            assert_int_equal(rig_camera(w.rig, 1).condition, RIG_READY);
        }
        tear_down();
    }
}

static void a_camera_that_stays_busy_is_quarantined_after_5_s(void **state)
{
    (void)state;
    set_up(4, 8);
    open_all();
    w.camera[1].fault.busy[CAMERA_COLLECT] = -1;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->camera[1].debt, DEBT_MISSED);
    assert_int_equal(rig_camera(w.rig, 1).condition, RIG_QUARANTINED);
    assert_non_null(strstr(rig_camera(w.rig, 1).note, "busy"));
    tear_down();
}

static void an_unfit_camera_stops_the_take_unless_it_may_be_left_out(void **state)
{
    (void)state;
    for (int story = 0; story < 6; story++) {
        set_up(5, 50 + (uint64_t)story);
        open_all();
        struct fault *f = &w.camera[3].fault;
        f->wrong_setting = story == 0, f->low_battery = story == 1, f->autofocus = story == 2, f->no_card = story == 3;
        f->busy[CAMERA_DRAIN] = story == 4 ? -1 : 0;
        if (story == 5)
            w.config.camera[3].lens[0] = 'x';
        const struct ledger *l = capture();
        assert_int_equal(l->state, TAKE_FAILED);
        assert_int_equal(w.n_fired, 0);
        assert_non_null(strstr(l->reason, "A03"));
        f->busy[CAMERA_DRAIN] = story == 4 ? -1 : 0;
        l = capture_as("20261122T090001_story", true);
        check_accounts(l);
        assert_int_equal(l->state, TAKE_VERIFIED);
        assert_false(l->camera[3].expected);
        assert_int_equal(w.n_copies, 4);
        tear_down();
    }
}

static void a_full_disk_stops_before_the_shutters(void **state)
{
    (void)state;
    set_up(5, 9);
    open_all();
    w.free_bytes = INT64_C(1000) << 20;
    const struct ledger *l = capture();
    assert_int_equal(l->state, TAKE_FAILED);
    assert_non_null(strstr(l->reason, "free"));
    w.free_bytes = INT64_C(1) << 42;
    w.create_err = -ENOSPC;
    l = capture();
    assert_int_equal(l->state, TAKE_FAILED);
    assert_int_equal(w.n_fired, 0);
    assert_non_null(strstr(l->reason, "No space"));
    tear_down();
}

static void a_ledger_that_cannot_be_written_leaves_the_frames_on_the_cards(void **state)
{
    (void)state;
    set_up(5, 10);
    open_all();
    w.n_commit_fails = -1, w.commit_err = -EIO;
    const struct ledger *l = capture();
    assert_int_equal(l->state, TAKE_FAILED);
    assert_int_equal(w.n_copies, 0);
    w.n_commit_fails = 3; // and one that can again, after a while
    run(60 * S, false);
    l = capture_as("20261122T090002_story", false);
    w.n_commit_fails = 0;
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    tear_down();
}

static void a_copy_that_fails_is_tried_again_then_left_on_the_card(void **state)
{
    (void)state;
    for (int story = 0; story < 4; story++) {
        set_up(5, 60 + (uint64_t)story);
        open_all();
        w.camera[0].fault.fails[CAMERA_FETCH] = story & 1 ? -1 : 2;
        w.camera[0].fault.trouble = story & 2 ? CAMERA_DISK : CAMERA_CORRUPT;
        const struct ledger *l = capture();
        check_accounts(l);
        assert_int_equal(l->state, story & 1 ? TAKE_FAILED : TAKE_VERIFIED);
        if (story & 1) {
            assert_true(w.camera[0].on_card[w.camera[0].n_card]);
            assert_non_null(strstr(l->camera[0].note, "rigctl resume"));
        }
        tear_down();
    }
}

static void frames_are_deleted_only_after_verified_is_durable(void **state)
{
    (void)state;
    set_up(5, 11);
    w.config.delete_after_verify = true;
    open_all();
    const struct ledger *l = capture(); // the world checks each DELETE
    check_accounts(l);
    for (int i = 0; i < 5; i++) {
        assert_int_equal(l->camera[i].object[0].state, OBJECT_DELETED);
        assert_false(w.camera[i].on_card[w.camera[i].n_card]);
    }
    w.camera[2].fault.no_shot = 1; // a take that is not whole deletes nothing
    l = capture_as("20261122T090001_story", false);
    check_accounts(l);
    for (int i = 0; i < 5; i++)
        for (int k = 0; k < l->camera[i].n_objects; k++)
            assert_int_equal(l->camera[i].object[k].state, OBJECT_COPIED);
    tear_down();
}

static void extra_files_and_pairs_are_fetched_under_names_of_their_own(void **state)
{
    (void)state;
    set_up(4, 12);
    w.config.objects_per_shot = 2;
    open_all();
    w.camera[1].fault.extra = 1;
    w.camera[2].fault.lost_events = 1;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_int_equal(l->camera[1].n_objects, 3);
    assert_string_equal(l->camera[1].object[2].file, "raw/A01_3.nef");
    assert_int_equal(w.n_copies, 9);
    tear_down();
}

static void a_trigger_that_fails_is_survived(void **state)
{
    (void)state;
    set_up(4, 13);
    open_all();
    w.n_fire_refusals = 2; // too late twice, then it works
    assert_int_equal(capture()->state, TAKE_VERIFIED);
    w.n_fire_refusals = 9;
    const struct ledger *l = capture_as("20261122T090001_story", false);
    assert_int_equal(l->state, TAKE_FAILED);
    assert_non_null(strstr(l->reason, "no shutter was pressed"));
    w.n_fire_refusals = 0;
    w.fire_err = -EIO; // broke in the middle: what was exposed is collected
    l = capture_as("20261122T090002_story", false);
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    rig_trigger_is(w.rig, w.now, -1);
    char why[200];
    const struct rig_take take = { "x", "x", "", 0, "/takes", NULL };
    assert_int_equal(rig_capture(w.rig, w.now, &take, false, why), -ENOTCONN);
    tear_down();
}

static void the_software_trigger_asks_each_camera(void **state)
{
    (void)state;
    set_up(6, 14);
    w.abilities = 0;
    rig_trigger_is(w.rig, w.now, 0);
    open_all();
    w.camera[3].fault.busy[CAMERA_TRIGGER] = 2;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_false(l->synchronised);
    tear_down();
}

static void lag_is_measured_and_compensated(void **state)
{
    (void)state;
    set_up(100, 15);
    open_all();
    const struct ledger *l = capture();
    const int64_t spread_before = l->spread_ns, sigma_before = l->sigma_ns;
    char why[200];
    const int64_t begin = w.now;
    assert_int_equal(rig_calibrate(w.rig, w.now, 40, why), 0);
    w.calibrating = true;
    run(4000 * S, true);
    w.calibrating = false;
    drain_actions();
    assert_int_equal(w.n_lags_done, 1);
    for (int i = 0; i < 100; i++) {
        const struct lag lag = rig_camera(w.rig, i).lag;
        assert_true(lag.n + lag.n_rejected == 40);
        assert_true(fabs(lag.mean_ms - w.camera[i].lag_ms) < 4.5 * w.camera[i].jitter_ms / sqrt(lag.n));
    }
    assert_true(w.now - begin < 300 * S);
    l = capture_as("20261122T090001_story", false);
    check_accounts(l);
    assert_true(l->sigma_ns < sigma_before * 2 / 3);
    assert_true(l->spread_ns < spread_before);
    w.config.trigger.max_hold_ms = 510; // leaves 10 ms of the 20 that are needed
    w.n_said = 0;
    l = capture_as("20261122T090002_story", false);
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    bool told = false;
    for (int i = 0; i < w.n_said; i++)
        told |= strstr(w.said[i], "max_hold_ms = 510 leaves 10 ms") != NULL;
    assert_true(told);
    tear_down();
}

static void a_take_is_resumed_from_its_ledger(void **state)
{
    (void)state;
    for (int story = 0; story < 3; story++) {
        set_up(8, 70 + (uint64_t)story);
        open_all();
        w.camera[4].fault.fails[CAMERA_FETCH] = -1;
        w.camera[4].fault.trouble = CAMERA_DISK;
        assert_int_equal(capture()->state, TAKE_FAILED);
        // A new life of the daemon, with the ledger from disk.
        char *text = ledger_text(&w.durable);
        struct ledger old;
        assert_int_equal(ledger_parse(&old, text, strlen(text), "old"), 0);
        free(text);
        w.camera[4].fault.fails[CAMERA_FETCH] = 0;
        if (story == 1) // somebody took another picture with it meanwhile, in a later take: not ours
            expose(4);
        if (story == 2) // and this body does not come back
            w.camera[4].fault.dead = true, w.camera[4].open = false;
        rig_free(w.rig);
        w.n_heap = 0;
        for (int i = 0; i < 8; i++)
            w.camera[i].worker = false;
        assert_int_equal(rig_create(&w.rig, &w.config), 0);
        rig_start(w.rig, w.now);
        if (story == 1) {
            old.camera[4].has_until = true;
            old.camera[4].n_until = 1;
            name_object(&old.camera[4].until[0], w.camera[4].n_card - 1);
        }
        char why[200];
        assert_int_equal(rig_resume(w.rig, w.now, &old, "/takes", true, why), 0);
        run(120 * S, true);
        drain_actions();
        const struct ledger *l = rig_ledger(w.rig);
        assert_int_equal(l->state, story == 2 ? TAKE_FAILED : TAKE_VERIFIED);
        if (story == 1)
            assert_int_equal(l->camera[4].n_objects, 1);
        else
            check_accounts(l);
        tear_down();
    }
}

static void a_take_that_was_never_exposed_says_so(void **state)
{
    (void)state;
    set_up(4, 16);
    open_all();
    struct ledger old;
    char why[200];
    ledger_init(&old, &w.config);
    strcpy(old.id, "20261122T080000_x");
    old.state = TAKE_ARMED;
    for (int i = 0; i < 4; i++)
        if (w.camera[i].n_card) {
            old.camera[i].n_before = 1;
            name_object(&old.camera[i].before[0], w.camera[i].n_card);
        }
    assert_int_equal(rig_resume(w.rig, w.now, &old, "/takes", true, why), 0);
    run(60 * S, true);
    drain_actions();
    assert_int_equal(rig_ledger(w.rig)->state, TAKE_FAILED);
    assert_non_null(strstr(rig_ledger(w.rig)->reason, "never pressed"));
    tear_down();
}

static void cancelling_before_the_shot_costs_nothing_after_it_no_frame(void **state)
{
    (void)state;
    for (int ms = 0; ms < 3000; ms += 100) {
        char why[200];
        set_up(4, 80);
        open_all();
        const struct rig_take take = { "20261122T090000_c", "c", "", 0, "/takes", NULL };
        for (int i = 0; i < 4; i++)
            w.camera[i].take_first = w.camera[i].n_card + 1;
        assert_int_equal(rig_capture(w.rig, w.now, &take, false, why), 0);
        run(ms * MS, true);
        rig_cancel(w.rig, w.now, why);
        run(60 * S, true);
        drain_actions();
        assert_int_equal(w.n_takes_done, 1);
        if (w.n_fired)
            check_accounts(rig_ledger(w.rig));
        else
            assert_int_equal(rig_ledger(w.rig)->state, TAKE_FAILED);
        tear_down();
    }
}

// Five thousand takes with every fault there is, unattended.
static void five_thousand_takes_lose_nothing(void **state)
{
    (void)state;
    enum { N = 12, TAKES = 5000 };
    int n_verified = 0, n_failed = 0;
    set_up(N, 99);
    w.config.may_miss = N - 1;
    open_all();
    for (int t = 0; t < TAKES; t++) {
        char id[40];
        snprintf(id, sizeof(id), "take%06d", t);
        if (random_bits() % 3 == 0) {
            struct fault *f = &w.camera[random_bits() % N].fault;
            const int kind = (int)(random_bits() % CAMERA_N_COMMANDS);
            switch (random_bits() % 8) {
            case 0: f->hang[kind] = 1; break;
            case 1: f->crash[kind] = 1; break;
            case 2: f->lost[kind] = 1; break;
            case 3: f->busy[kind] = (int)(random_bits() % 8); break;
            case 4: f->lost_events = 1; break;
            case 5: f->no_shot = 1; break;
            case 6: f->fails[kind] = (int)(random_bits() % 4), f->trouble = random_bits() % CAMERA_N_TROUBLES; break;
            case 7: f->extra = 1; break;
            }
        }
        const struct ledger *l = capture_as(id, false);
        check_accounts(l);
        n_verified += l->state == TAKE_VERIFIED;
        n_failed += l->state == TAKE_FAILED;
        if (t % 100 == 99)
            run(100 * S, false); // a pause: quarantined bodies come back
        for (int i = 0; i < N; i++)
            if (w.camera[i].n_card > CARD_MAX * 100 - 10) { // a new card
                memset(w.camera[i].on_card, 0, sizeof(w.camera[i].on_card));
                w.camera[i].n_card = 0;
            }
    }
    assert_int_equal(n_verified + n_failed, TAKES);
    assert_true(n_verified > TAKES * 3 / 4);
    run(200 * S, false);
    for (int i = 0; i < N; i++)
        assert_int_equal(rig_camera(w.rig, i).condition, RIG_READY);
    tear_down();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(two_hundred_cameras_deliver_every_frame),
        cmocka_unit_test(the_same_inputs_give_the_same_actions),
        cmocka_unit_test(a_lost_event_is_found_on_the_card),
        cmocka_unit_test(a_camera_that_came_back_is_not_waited_for_but_its_card_is_read),
        cmocka_unit_test(a_shutter_that_stays_closed_is_named_with_slot_and_remedy),
        cmocka_unit_test(one_fault_at_any_command_costs_no_frame),
        cmocka_unit_test(nothing_is_sent_from_the_last_answer_before_half_press_to_the_end_of_exposure),
        cmocka_unit_test(others_do_not_wait_for_a_camera_in_trouble),
        cmocka_unit_test(a_camera_is_recovered_or_quarantined_within_15_s),
        cmocka_unit_test(a_camera_that_stays_busy_is_quarantined_after_5_s),
        cmocka_unit_test(an_unfit_camera_stops_the_take_unless_it_may_be_left_out),
        cmocka_unit_test(a_full_disk_stops_before_the_shutters),
        cmocka_unit_test(a_ledger_that_cannot_be_written_leaves_the_frames_on_the_cards),
        cmocka_unit_test(a_copy_that_fails_is_tried_again_then_left_on_the_card),
        cmocka_unit_test(frames_are_deleted_only_after_verified_is_durable),
        cmocka_unit_test(extra_files_and_pairs_are_fetched_under_names_of_their_own),
        cmocka_unit_test(a_trigger_that_fails_is_survived),
        cmocka_unit_test(the_software_trigger_asks_each_camera),
        cmocka_unit_test(lag_is_measured_and_compensated),
        cmocka_unit_test(a_take_is_resumed_from_its_ledger),
        cmocka_unit_test(a_take_that_was_never_exposed_says_so),
        cmocka_unit_test(cancelling_before_the_shot_costs_nothing_after_it_no_frame),
        cmocka_unit_test(five_thousand_takes_lose_nothing),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
