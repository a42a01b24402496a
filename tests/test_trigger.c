// tests/test_trigger.c - no shutter is pressed early, short, twice or for ever.
//
// The plan (edges.c) on a clock that the test turns; the thread, the guard and the inputs (trigger_lines.c) on a chip made of
// memory that a forked process sees as well; the simulated rig's wire against a server; the software kind.
#include "rigd/shutter_line.h"
#include "rigd/trigger_lines.h"
#include "solver/take/log.h"

#include <errno.h>
#include <poll.h>
#include <setjmp.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>
#include <cmocka.h>

#define MS INT64_C(1000000)

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static struct config_camera camera[CONFIG_CAMERAS_MAX];
static struct config config;

// n cameras with lines of their own from 100 (full), 400 (half), 700 (feedback) and 1000 (supply) on.
static const struct config *studio(int n)
{
    memset(&config, 0, sizeof(config));
    config.camera = camera;
    config.n_cameras = n;
    config.trigger = (struct trigger_config){ .kind = TRIGGER_GPIO, .full_line = CONFIG_NONE, .half_line = CONFIG_NONE,
        .button_line = 5, .button_debounce_ms = 20, .max_hold_ms = 3000 };
    for (int i = 0; i < n; i++) {
        camera[i] = (struct config_camera){ .full_line = 100 + i, .half_line = 400 + i, .feedback_line = 700 + i, .relay_line = 1000 + i };
        snprintf(camera[i].name, sizeof(camera[i].name), "A%02d", i);
    }
    return &config;
}

// ---- the plan -----------------------------------------------------------------------------------------------------------------------

static _Atomic int64_t limit[EDGES_WIRES_MAX];

static void plan_for(struct edges *e, const struct config *c)
{
    memset((void *)limit, 0, sizeof(limit));
    assert_int_equal(edges_init(e, c, false, limit), 0);
}

static int wire_of_line(const struct edges *e, int line)
{
    for (int w = 0; w < e->n_wires; w++)
        if (e->line[w].line == line)
            return w;
    fail_msg("no wire has line %d", line);
    return -1;
}

// When each wire was pressed and released; 0: never.
struct pulses {
    int64_t press_ns[EDGES_WIRES_MAX], release_ns[EDGES_WIRES_MAX];
    int n_presses[EDGES_WIRES_MAX], n_done, n_first;
    bool cut, too_late;
};

static void note(struct pulses *p, const struct edges *e, const struct edges_step *s, int64_t now_ns)
{
    for (int w = 0; w < e->n_wires; w++) {
        if (!(s->changed[w / 64] >> w % 64 & 1))
            continue;
        if (s->active[w / 64] >> w % 64 & 1)
            p->press_ns[w] = now_ns, p->n_presses[w]++;
        else
            p->release_ns[w] = now_ns;
    }
    p->n_done += s->done;
    p->n_first += s->first;
    p->cut |= s->cut;
    p->too_late |= s->too_late;
}

// Run the plan to its end; every step comes late_ns() after it was due.
static void run_plan(struct edges *e, struct pulses *p, unsigned *seed, int64_t late_max_ns)
{
    int64_t now_ns = 0, next_ns;
    memset(p, 0, sizeof(*p));
    while ((next_ns = edges_next_ns(e)) != EDGES_NEVER) {
        struct edges_step s;
        const int64_t late_ns = late_max_ns ? (int64_t)((double)rand_r(seed) / RAND_MAX * (double)late_max_ns) : 0;
        now_ns = next_ns > now_ns ? next_ns : now_ns;
        now_ns += late_ns;
        edges_step(e, now_ns, &s);
        assert_true(s.any);
        note(p, e, &s, now_ns);
    }
}

static void presses_half_then_full_and_releases_both(void **state)
{
    (void)state;
    struct edges e;
    struct pulses p;
    plan_for(&e, studio(85));
    const struct trigger_shot shot = { .at_ns = 1000 * MS, .half_ms = 300, .hold_ms = 150 };
    assert_int_equal(edges_plan(&e, &shot, 0), 0);
    run_plan(&e, &p, NULL, 0);
    for (int i = 0; i < 85; i++) {
        const int full = wire_of_line(&e, 100 + i), half = wire_of_line(&e, 400 + i);
        assert_int_equal(p.press_ns[half], 700 * MS);
        assert_int_equal(p.press_ns[full], 1000 * MS);
        assert_int_equal(p.release_ns[full], 1150 * MS);
        assert_int_equal(p.release_ns[half], 1150 * MS);
        assert_int_equal(p.n_presses[wire_of_line(&e, 1000 + i)], 0); // supplies are not touched
    }
    assert_int_equal(p.n_done, 1);
    assert_int_equal(p.n_first, 1);
}

static void delays_each_body_and_skips_the_quarantined(void **state)
{
    (void)state;
    struct edges e;
    struct pulses p;
    uint32_t delay_us[70];
    const uint64_t skip[4] = { UINT64_C(1) << 3, UINT64_C(1) << 1 }; // 3 and 65
    for (int i = 0; i < 70; i++)
        delay_us[i] = 137 * (uint32_t)((i * 31) % 70);
    plan_for(&e, studio(70));
    const struct trigger_shot shot = { .at_ns = 5000 * MS, .half_ms = 200, .hold_ms = 100, .delay_us = delay_us, .skip = skip };
    assert_int_equal(edges_plan(&e, &shot, 0), 0);
    run_plan(&e, &p, NULL, 0);
    for (int i = 0; i < 70; i++) {
        const int full = wire_of_line(&e, 100 + i), half = wire_of_line(&e, 400 + i);
        const bool pressed = i != 3 && i != 65;
        const int64_t due_ns = 5000 * MS + delay_us[i] * INT64_C(1000);
        assert_int_equal(p.n_presses[full], pressed);
        assert_int_equal(p.n_presses[half], pressed);
        assert_int_equal(p.press_ns[full], pressed ? due_ns : 0);
        assert_int_equal(p.release_ns[full], pressed ? due_ns + 100 * MS : 0);
        assert_int_equal(p.release_ns[half], pressed ? due_ns + 100 * MS : 0);
    }
}

// Bodies 0 to 2 on common lines, body 3 on its own.
static void common_lines_serve_bodies_without_their_own(void **state)
{
    (void)state;
    struct edges e;
    struct pulses p;
    studio(4);
    config.trigger.full_line = 10;
    config.trigger.half_line = 11;
    for (int i = 0; i < 3; i++)
        camera[i].full_line = camera[i].half_line = CONFIG_NONE;
    camera[3].half_line = CONFIG_NONE;
    plan_for(&e, &config);
    assert_false(edges_abilities(&e) & TRIGGER_DELAYS);
    const uint32_t delay_us[] = { 1000, 9000, 3000, 50000 };
    const uint64_t skip[4] = { 1 << 1 }; // cannot be kept from firing, but its 9 ms do not count
    const struct trigger_shot shot = { .at_ns = 1000 * MS, .half_ms = 500, .hold_ms = 100, .delay_us = delay_us, .skip = skip };
    assert_int_equal(edges_plan(&e, &shot, 0), 0);
    run_plan(&e, &p, NULL, 0);
    const int full = wire_of_line(&e, 10), half = wire_of_line(&e, 11), own = wire_of_line(&e, 103);
    assert_int_equal(p.press_ns[full], 1002 * MS);
    assert_int_equal(p.press_ns[own], 1050 * MS);
    assert_int_equal(p.press_ns[half], 500 * MS);
    assert_int_equal(p.release_ns[full], 1102 * MS);
    assert_int_equal(p.release_ns[half], p.release_ns[own]); // body 3 needs it longest
    assert_int_equal(p.release_ns[own], 1150 * MS);

    const uint64_t only_own[4] = { 7 };
    const struct trigger_shot second = { .at_ns = 9000 * MS, .half_ms = 500, .hold_ms = 100, .skip = only_own };
    assert_int_equal(edges_plan(&e, &second, 2000 * MS), 0);
    run_plan(&e, &p, NULL, 0);
    assert_int_equal(p.n_presses[full], 0);
    assert_int_equal(p.n_presses[own], 1);
    assert_int_equal(p.n_presses[half], 1);
}

// Whatever the host's jitter: pressed once, never early, never short, half before full, everything released, nothing for too long.
static void a_late_host_shifts_pulses_but_never_bends_them(void **state)
{
    (void)state;
    static struct edges e;
    static struct pulses p;
    for (unsigned round = 1; round <= 300; round++) {
        unsigned seed = round;
        uint32_t delay_us[256];
        uint64_t skip[4];
        const int n = 1 + rand_r(&seed) % 60;
        studio(n);
        for (int i = 0; i < n; i++)
            delay_us[i] = (uint32_t)rand_r(&seed) % 100000;
        for (int i = 0; i < 4; i++)
            skip[i] = (uint64_t)rand_r(&seed) & (uint64_t)rand_r(&seed) & ~UINT64_C(1);
        const int64_t late_ns = (rand_r(&seed) % 200) * MS;
        plan_for(&e, &config);
        const struct trigger_shot shot = { .at_ns = 4000 * MS, .half_ms = 400, .hold_ms = 1 + (uint32_t)rand_r(&seed) % 500,
            .delay_us = delay_us, .skip = skip };
        assert_int_equal(edges_plan(&e, &shot, 0), 0);
        run_plan(&e, &p, &seed, late_ns);
        assert_false(p.too_late);
        assert_int_equal(p.n_done, 1);
        assert_int_equal(p.n_first, 1);
        for (int i = 0; i < n; i++) {
            const int full = wire_of_line(&e, 100 + i), half = wire_of_line(&e, 400 + i);
            const bool skipped = skip[i / 64] >> i % 64 & 1;
            assert_int_equal(p.n_presses[full], !skipped);
            assert_int_equal(p.n_presses[half], !skipped);
            if (skipped)
                continue;
            assert_true(p.press_ns[full] >= shot.at_ns + delay_us[i] * INT64_C(1000));
            assert_true(p.press_ns[half] < p.press_ns[full]);
            assert_true(p.release_ns[full] - p.press_ns[full] >= shot.hold_ms * MS);
            assert_true(p.release_ns[full] - p.press_ns[full] <= shot.hold_ms * MS + late_ns);
            assert_true(p.release_ns[half] - p.press_ns[half] <= 3000 * MS + late_ns);
            assert_true(p.release_ns[half] >= p.release_ns[full]);
        }
        for (int w = 0; w < e.n_wires; w++)
            assert_int_equal(limit[w], 0);
    }
}

static void a_press_that_comes_far_too_late_is_not_done(void **state)
{
    (void)state;
    struct edges e;
    struct edges_step s;
    plan_for(&e, studio(2));
    const uint32_t delay_us[] = { 0, 900000 };
    const struct trigger_shot shot = { .at_ns = 1000 * MS, .hold_ms = 1000, .delay_us = delay_us };
    assert_int_equal(edges_plan(&e, &shot, 0), 0);
    edges_step(&e, 1000 * MS, &s);
    assert_true(s.first && s.any && !s.done);
    edges_step(&e, 1900 * MS + EDGES_LATE_MAX_NS + 1, &s); // stopped for over a second
    assert_true(s.too_late && s.done);
    for (int w = 0; w < LINES_WORDS; w++)
        assert_int_equal(s.active[w], 0);
    assert_true(edges_next_ns(&e) == EDGES_NEVER);
}

static void refuses_what_it_must_not_do(void **state)
{
    (void)state;
    struct edges e;
    uint32_t delay_us[] = { 0, 0, 0 };
    const uint64_t all[4] = { 7 };
    struct trigger_shot shot = { .at_ns = 1000 * MS, .half_ms = 500, .hold_ms = 100, .delay_us = delay_us };
    plan_for(&e, studio(3));
    assert_int_equal(edges_plan(&e, &shot, 500 * MS + 1), -ETIME); // half-press would be late
    shot.hold_ms = 3001;
    assert_int_equal(edges_plan(&e, &shot, 0), -EINVAL);
    shot.hold_ms = 0;
    assert_int_equal(edges_plan(&e, &shot, 0), -EINVAL);
    shot.hold_ms = 2500; // with half-press 3000, and then a delay
    delay_us[1] = 1;
    assert_int_equal(edges_plan(&e, &shot, 0), -EINVAL);
    delay_us[1] = 1000000;
    shot.hold_ms = 100;
    assert_int_equal(edges_plan(&e, &shot, 0), -EINVAL);
    delay_us[1] = 0;
    shot.skip = all;
    assert_int_equal(edges_plan(&e, &shot, 0), -EINVAL);
    shot.skip = NULL;
    assert_true(edges_next_ns(&e) == EDGES_NEVER); // nothing refused left a trace
    assert_int_equal(edges_plan(&e, &shot, 500 * MS), 0);
    assert_int_equal(edges_plan(&e, &shot, 500 * MS), -EBUSY);
}

static void a_camera_without_any_line_is_refused(void **state)
{
    (void)state;
    struct edges e;
    studio(2);
    camera[1].full_line = CONFIG_NONE;
    log_set_level(LOG_SILENT);
    assert_int_equal(edges_init(&e, &config, false, limit), -EINVAL);
    log_set_level(LOG_INFO);
}

// The one that makes panoramas may do without: its driver presses it, and a shot of all others leaves it alone.
static void the_panorama_camera_needs_no_line(void **state)
{
    (void)state;
    struct edges e;
    studio(3);
    camera[2].full_line = camera[2].half_line = CONFIG_NONE;
    strcpy(config.panorama.camera_name, "A02");
    config.panorama.camera = 2;
    plan_for(&e, &config);
    const struct trigger_shot shot = { .at_ns = 1000 * MS, .half_ms = 100, .hold_ms = 50 };
    assert_int_equal(edges_plan(&e, &shot, 0), 0);
    for (int64_t now_ns; (now_ns = edges_next_ns(&e)) != EDGES_NEVER;) {
        struct edges_step step;
        edges_step(&e, now_ns, &step);
    }
    const uint64_t others = 3;
    const struct trigger_shot alone = { .at_ns = 9000 * MS, .hold_ms = 50, .skip = &others };
    assert_int_equal(edges_plan(&e, &alone, 0), -EINVAL); // nobody is left to press
}

static void a_supply_comes_back_however_often_it_is_cut(void **state)
{
    (void)state;
    struct edges e;
    struct edges_step s;
    plan_for(&e, studio(1));
    const int relay = wire_of_line(&e, 1000);
    edges_relay(&e, relay, true, 100 * MS, &s);
    assert_true(s.any && (s.active[relay / 64] >> relay % 64 & 1));
    edges_relay(&e, relay, true, 3000 * MS, &s);
    assert_false(s.any);
    assert_int_equal(edges_next_ns(&e), 3100 * MS);
    edges_step(&e, 3100 * MS, &s);
    assert_true(s.any && !s.active[relay / 64] && !s.done);
}

// ---- the thread, the guard, the inputs, on a chip made of memory -----------------------------------------------------------------------

enum { SETS_MAX = 4000 };

struct fake_chip { // shared with forked processes
    atomic_int n_begun, n_sets, failing, failing_from; // calls of set(); those that are noted; that set() fails, counted from 1; from that one on; 0: none
    atomic_int slow_ms; // a call takes so long: the host stood still on the way to the wires
    atomic_int level[CONFIG_CAMERAS_MAX + 1];
    struct { uint64_t active[LINES_WORDS], changed[LINES_WORDS]; int64_t at_ns; pid_t by; } set[SETS_MAX];
    int edges[2];                 // socketpair of struct lines_edge
    atomic_int n_open;
};
static struct fake_chip *chip;

static int fake_open(void **self, const struct config *c, const struct lines_wanted *wanted)
{
    (void)c, (void)wanted;
    assert_int_equal(socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0, chip->edges), 0);
    chip->n_open++;
    *self = chip;
    return 0;
}

static bool presses(int set)
{
    uint64_t pressed = 0;
    for (int w = 0; w < LINES_WORDS; w++)
        pressed |= chip->set[set].active[w] & chip->set[set].changed[w];
    return pressed;
}

static int fake_set(void *self, const uint64_t *active, const uint64_t *changed, int64_t at_ns)
{
    struct fake_chip *c = self;
    const int i = atomic_fetch_add(&c->n_begun, 1);
    (void)at_ns;
    if (i >= SETS_MAX)
        abort();
    poll(NULL, 0, c->slow_ms);
    memcpy(c->set[i].active, active, sizeof(c->set[i].active));
    memcpy(c->set[i].changed, changed, sizeof(c->set[i].changed));
    c->set[i].at_ns = clock_ns();
    c->set[i].by = getpid();
    c->n_sets++;
    return (i + 1 == c->failing && (presses(i) || i == 2)) || (c->failing_from && i + 1 >= c->failing_from) ? -ENODEV : 0;
}

static int fake_fd(const void *self)
{
    return ((const struct fake_chip *)self)->edges[0];
}

static int fake_read(void *self, struct lines_edge *edge, int max)
{
    struct fake_chip *c = self;
    const ssize_t size = recv(c->edges[0], edge, (size_t)max * sizeof(*edge), 0);
    return size == 0 ? -ENODEV : size < 0 ? 0 : (int)(size / (ssize_t)sizeof(*edge));
}

static int fake_level(void *self, int input)
{
    return ((struct fake_chip *)self)->level[input];
}

static void fake_close(void *self)
{
    struct fake_chip *c = self;
    close(c->edges[0]);
    close(c->edges[1]);
    c->n_open--;
}

static const struct lines_ops fake_lines = { .guarded = true, .open = fake_open, .set = fake_set, .fd = fake_fd, .read = fake_read,
    .level = fake_level, .close = fake_close };

static struct heard {
    int n_fired, err, n_feedback, n_button, n_broken, n_pressed;
    int camera[64];
    int64_t pressed_ns, late_ns, at_ns[64], button_ns;
} heard;

static void on_fired(void *arg, int err, int64_t pressed_ns, int64_t late_ns)
{
    assert_ptr_equal(arg, &heard);
    heard.n_fired++;
    heard.err = err;
    heard.pressed_ns = pressed_ns;
    heard.late_ns = late_ns;
}

static void on_feedback(void *arg, int cam, int64_t at_ns)
{
    (void)arg;
    assert_true(heard.n_feedback < 64);
    heard.camera[heard.n_feedback] = cam;
    heard.at_ns[heard.n_feedback++] = at_ns;
}

static void on_button(void *arg, int64_t at_ns)
{
    (void)arg;
    heard.n_button++;
    heard.button_ns = at_ns;
}

static void on_press_camera(void *arg, int cam)
{
    (void)arg;
    heard.camera[heard.n_pressed++] = cam;
}

static void on_broken(void *arg, int err)
{
    (void)arg;
    assert_true(err < 0);
    assert_int_equal(heard.n_fired <= 1, 1);
    heard.n_broken++;
}

static const struct trigger_host host = { .fired = on_fired, .feedback = on_feedback, .button = on_button, .press_camera = on_press_camera,
    .broken = on_broken, .arg = &heard };

static struct trigger_lines *open_fake(int n)
{
    struct trigger_lines *t;
    memset(&heard, 0, sizeof(heard));
    memset((void *)chip, 0, sizeof(*chip));
    assert_int_equal(trigger_lines_open(&t, studio(n), &host, &fake_lines, false), 0);
    return t;
}

enum { PATIENCE_MS = 60000 }; // of a machine that is too busy

// Serve t until *count reaches n.
static void serve(void *t, const int *count, int n)
{
    const int64_t end_ns = clock_ns() + PATIENCE_MS * MS;
    while (*count < n) {
        struct pollfd p = { trigger_lines_fd(t), POLLIN, 0 };
        assert_true(clock_ns() < end_ns);
        poll(&p, 1, 100);
        trigger_lines_dispatch(t);
    }
}

static void serve_for(void *t, int ms)
{
    const int64_t end_ns = clock_ns() + ms * MS;
    while (clock_ns() < end_ns) {
        struct pollfd p = { trigger_lines_fd(t), POLLIN, 0 };
        poll(&p, 1, 10);
        trigger_lines_dispatch(t);
    }
}

static int n_active(int set)
{
    int n = 0;
    for (int w = 0; w < LINES_WORDS; w++)
        n += __builtin_popcountll(chip->set[set].active[w]);
    return n;
}

static void wait_for_sets(int n)
{
    const int64_t end_ns = clock_ns() + PATIENCE_MS * MS;
    while (chip->n_sets < n) {
        assert_true(clock_ns() < end_ns);
        poll(NULL, 0, 1);
    }
}

// Fires, lead_ms from now, and returns when the chip was called n times for it: to press. A machine that stands still until it is too late gets
// another shot: nothing of it may be seen of the first but that it was given up.
static void press(struct trigger_lines *t, struct trigger_shot *shot, int lead_ms, int n)
{
    const int before = chip->n_sets, n_fired = heard.n_fired;
    for (;;) {
        int err;
        do {
            shot->at_ns = clock_ns() + lead_ms * MS;
            err = trigger_lines_fire(t, shot);
        } while (err == -ETIME);
        assert_int_equal(err, 0);
        for (int i = before; i < before + n; i++) {
            wait_for_sets(i + 1);
            if (!presses(i))
                break;
            if (i == before + n - 1)
                return;
        }
        serve(t, &heard.n_fired, n_fired + 1); // none of them was pressed late, and it is told
        assert_int_equal(heard.err, -EIO);
        assert_int_equal(heard.n_broken, 0);
        assert_int_equal(n_active(chip->n_sets - 1), 0);
        heard.n_fired = n_fired;
        chip->n_begun = chip->n_sets = before;
    }
}

enum { HALF_MS = EDGES_LATE_MAX_NS / MS + 50 }; // a host that is so late that half-press and full-press come together is too late

static void one_shot_is_three_calls_to_the_chip(void **state)
{
    (void)state;
    struct trigger_lines *t = open_fake(85);
    assert_int_equal(trigger_lines_abilities(t), TRIGGER_SYNCHRONISED | TRIGGER_HALF_PRESS | TRIGGER_DELAYS | TRIGGER_FEEDBACK |
        TRIGGER_BUTTON | TRIGGER_RELAYS);
    struct trigger_shot shot = { .half_ms = HALF_MS, .hold_ms = 20 };
    press(t, &shot, HALF_MS + 50, 2);
    assert_int_equal(trigger_lines_fire(t, &shot), -EBUSY);
    serve(t, &heard.n_fired, 1);
    assert_int_equal(heard.err, 0);
    assert_int_equal(chip->n_sets, 3);
    assert_int_equal(n_active(0), 85);
    assert_int_equal(n_active(1), 170);
    assert_int_equal(n_active(2), 0);
    assert_true(chip->set[0].at_ns >= shot.at_ns - HALF_MS * MS); // never early
    assert_true(chip->set[1].at_ns >= shot.at_ns);
    assert_true(chip->set[2].at_ns - chip->set[1].at_ns >= 20 * MS); // never short
    assert_true(heard.pressed_ns >= chip->set[1].at_ns && heard.pressed_ns < chip->set[2].at_ns);
    assert_int_equal(heard.pressed_ns - shot.at_ns, heard.late_ns);
    serve_for(t, 30);
    assert_int_equal(heard.n_fired, 1);

    const struct trigger_shot past = { .at_ns = clock_ns() - 1, .hold_ms = 20 };
    assert_int_equal(trigger_lines_fire(t, &past), -ETIME);
    assert_int_equal(chip->n_sets, 3);
    trigger_lines_close(t);
    assert_int_equal(n_active(chip->n_sets - 1), 0);
    assert_int_equal(chip->n_open, 0);
}

static void a_host_that_stands_still_shortens_no_pulse(void **state)
{
    (void)state;
    struct trigger_lines *t = open_fake(3);
    struct trigger_shot shot = { .hold_ms = 30 };
    chip->slow_ms = 100;
    press(t, &shot, 50, 1);
    serve(t, &heard.n_fired, 1);
    assert_int_equal(heard.err, 0);
    assert_int_equal(chip->n_sets, 2);
    assert_true(chip->set[1].at_ns - chip->set[0].at_ns >= (30 + 100) * MS);
    trigger_lines_close(t);
}

static void release_in_the_middle_opens_everything_and_says_so_once(void **state)
{
    (void)state;
    struct trigger_lines *t = open_fake(3);
    for (int round = 1; round <= 2; round++) { // and the next shot is a new one
        struct trigger_shot s = { .half_ms = HALF_MS, .hold_ms = 2500 };
        press(t, &s, HALF_MS + 50, 2);
        trigger_lines_release(t);
        assert_int_equal(n_active(chip->n_sets - 1), 0);
        assert_int_equal(trigger_lines_fire(t, &s), -EBUSY); // until fired() is told
        serve(t, &heard.n_fired, round);
        assert_int_equal(heard.err, -ECANCELED);
    }
    trigger_lines_release(t); // without a shot: nothing to tell
    serve_for(t, 30);
    assert_int_equal(heard.n_fired, 2);
    trigger_lines_close(t);
}

static int n_active_when_told;

static void look_when_told(void *arg, enum log_level level, const char *message)
{
    (void)arg, (void)message;
    if (level >= LOG_WARNING)
        n_active_when_told += n_active(chip->n_sets - 1);
}

static void a_line_that_breaks_in_the_middle_releases_all_and_tells_once(void **state)
{
    (void)state;
    log_set_level(LOG_SILENT);
    log_set_hook(look_when_told, NULL);
    n_active_when_told = 0;
    for (int failing = 1; failing <= 3; failing++) { // half, full, release
        struct trigger_lines *t = open_fake(4);
        chip->failing = failing;
        assert_int_equal(trigger_lines_relay(t, 2, false), 0);
        struct trigger_shot shot = { .half_ms = HALF_MS, .hold_ms = 10 };
        press(t, &shot, HALF_MS + 50, failing < 2 ? 1 : 2);
        serve(t, &heard.n_broken, 1);
        assert_int_equal(heard.n_fired, 1);
        assert_int_equal(heard.err, -EIO);
        assert_int_equal(chip->n_sets, failing + 1);
        assert_int_equal(n_active(failing), 0);
        assert_int_equal(trigger_lines_fire(t, &shot), -EIO);
        assert_int_equal(trigger_lines_relay(t, 2, true), -EIO);
        serve_for(t, 20);
        assert_int_equal(heard.n_broken, 1);
        assert_int_equal(heard.n_fired, 1);
        trigger_lines_close(t);
    }
    log_set_hook(NULL, NULL);
    log_set_level(LOG_INFO);
    assert_int_equal(n_active_when_told, 0); // a journal may take its time: first the lines, then the words
}

static char told[2000];

static void keep_told(void *arg, enum log_level level, const char *message)
{
    const size_t n = strlen(told);
    (void)arg;
    if (level >= LOG_WARNING)
        snprintf(told + n, sizeof(told) - n, "%s\n", message);
}

static void lines_that_cannot_be_released_are_not_said_to_be(void **state)
{
    (void)state;
    struct trigger_lines *t = open_fake(2);
    struct trigger_shot shot = { .hold_ms = 10 };
    chip->failing_from = 2; // from the release on
    told[0] = 0;
    log_set_level(LOG_SILENT);
    log_set_hook(keep_told, NULL);
    press(t, &shot, 50, 1);
    serve(t, &heard.n_broken, 1);
    trigger_lines_close(t);
    log_set_hook(NULL, NULL);
    log_set_level(LOG_INFO);
    assert_int_equal(heard.err, -EIO);
    assert_null(strstr(told, "all are released"));
    const char *stuck = strstr(told, "may still be pressed");
    assert_non_null(stuck);
    assert_null(strstr(stuck + 1, "may still be pressed")); // once
}

static void a_chip_that_is_gone_is_told(void **state)
{
    (void)state;
    struct trigger_lines *t = open_fake(2);
    struct trigger_shot shot = { .hold_ms = 2000 };
    press(t, &shot, 10, 1);
    shutdown(chip->edges[1], SHUT_RDWR);
    serve(t, &heard.n_broken, 1);
    assert_int_equal(heard.n_fired, 1);
    assert_int_equal(heard.err, -EIO);
    assert_int_equal(n_active(chip->n_sets - 1), 0);
    trigger_lines_close(t);
}

static void close_in_the_middle_opens_everything(void **state)
{
    (void)state;
    struct trigger_lines *t = open_fake(2);
    struct trigger_shot shot = { .hold_ms = 2000 };
    press(t, &shot, 10, 1);
    assert_int_equal(trigger_lines_relay(t, 1, true), 0);
    assert_int_equal(n_active(1), 3);
    trigger_lines_close(t);
    assert_int_equal(n_active(chip->n_sets - 1), 0);
    assert_int_equal(heard.n_fired, 0);
}

// A process that presses for 2.5 s of at most max_hold_ms and is then ended by `how`, in the middle.
static pid_t process_that_presses(int how, uint32_t max_hold_ms)
{
    memset(&heard, 0, sizeof(heard));
    memset((void *)chip, 0, sizeof(*chip));
    const pid_t pid = fork();
    if (pid == 0) {
        struct trigger_lines *t;
        studio(3);
        config.trigger.max_hold_ms = max_hold_ms;
        if (trigger_lines_open(&t, &config, &host, &fake_lines, false))
            _exit(1);
        struct trigger_shot shot = { .hold_ms = max_hold_ms };
        press(t, &shot, 10, 1);
        if (trigger_lines_relay(t, 0, true))
            _exit(2);
        kill(getpid(), how);
        _exit(3);
    }
    assert_true(pid > 0);
    return pid;
}

// Reaped or not: it is not our child, and who adopted it may not look.
static void wait_until_gone(pid_t pid)
{
    const int64_t end_ns = clock_ns() + PATIENCE_MS * MS;
    char path[64], line[400], state = 'R';
    snprintf(path, sizeof(path), "/proc/%d/stat", (int)pid);
    for (FILE *f; state != 'Z' && (f = fopen(path, "r")); poll(NULL, 0, 1)) {
        const char *name_end = fgets(line, sizeof(line), f) ? strrchr(line, ')') : NULL;
        state = name_end ? name_end[2] : 'Z';
        fclose(f);
        assert_true(clock_ns() < end_ns);
    }
}

static void killed_in_the_middle_the_guard_lets_go(void **state)
{
    (void)state;
    int status;
    const pid_t pid = process_that_presses(SIGKILL, 10000);
    assert_int_equal(waitpid(pid, &status, 0), pid);
    assert_true(WIFSIGNALED(status) && WTERMSIG(status) == SIGKILL);
    wait_for_sets(3);
    assert_int_equal(n_active(2), 0);
    assert_true(chip->set[2].at_ns - chip->set[1].at_ns < 9000 * MS); // not only at the limit of 10 s
    assert_int_not_equal(chip->set[2].by, pid);
    wait_until_gone(chip->set[2].by);
}

static void stopped_in_the_middle_the_guard_lets_go_at_the_limit(void **state)
{
    (void)state;
    int status;
    const pid_t pid = process_that_presses(SIGSTOP, 1200);
    wait_for_sets(3);
    while (n_active(chip->n_sets - 1) > 0)
        poll(NULL, 0, 1);
    assert_int_not_equal(chip->set[2].by, pid);
    kill(pid, SIGKILL);
    assert_int_equal(waitpid(pid, &status, 0), pid);
    wait_until_gone(chip->set[2].by); // it lets go once more: not of the next test's
}

// Of the trigger that is open; 0: this kernel does not tell.
static pid_t guard_process(void)
{
    char path[64], children[64] = "";
    snprintf(path, sizeof(path), "/proc/self/task/%d/children", getpid());
    FILE *f = fopen(path, "r");
    if (!f || !fgets(children, sizeof(children), f))
        fprintf(stderr, "# no %s here: the guard cannot be found\n", path);
    if (f)
        fclose(f);
    return atoi(children);
}

static long n_sleeps(pid_t pid)
{
    char path[64], line[200];
    long n = -1;
    snprintf(path, sizeof(path), "/proc/%d/status", (int)pid);
    FILE *f = fopen(path, "r");
    while (f && fgets(line, sizeof(line), f))
        sscanf(line, "voluntary_ctxt_switches: %ld", &n);
    if (f)
        fclose(f);
    return n;
}

// It looks a hundred times a second while something is pressed or cut, and a rig stands idle for weeks.
static void with_nothing_to_watch_the_guard_sleeps(void **state)
{
    (void)state;
    for (int how = 0; how < 3; how++) {
        struct trigger_lines *t = open_fake(2);
        const pid_t guard = guard_process();
        struct trigger_shot shot = { .hold_ms = how ? 2500 : 10 };
        if (how < 2) {
            press(t, &shot, 10, 1);
            if (how)
                trigger_lines_release(t);
            serve(t, &heard.n_fired, 1);
        } else {
            assert_int_equal(trigger_lines_relay(t, 0, true), 0);
            assert_int_equal(trigger_lines_relay(t, 0, false), 0);
        }
        poll(NULL, 0, 50);
        const long before = guard ? n_sleeps(guard) : 0;
        poll(NULL, 0, 300);
        const long n = guard ? n_sleeps(guard) - before : 0;
        if (n > 3)
            fail_msg("after %s: it woke %ld times in 300 ms", how == 0 ? "a shot" : how == 1 ? "a release" : "a supply was given back", n);
        trigger_lines_close(t);
    }
}

static void without_its_guard_nothing_is_pressed(void **state)
{
    (void)state;
    struct trigger_lines *t = open_fake(2);
    const pid_t guard = guard_process();
    if (!guard) {
        trigger_lines_close(t);
        return;
    }
    struct trigger_shot shot = { .hold_ms = 2000 };
    press(t, &shot, 10, 1);
    log_set_level(LOG_SILENT);
    kill(guard, SIGKILL);
    serve(t, &heard.n_broken, 1);
    log_set_level(LOG_INFO);
    assert_int_equal(heard.err, -EIO);
    assert_int_equal(n_active(chip->n_sets - 1), 0);
    assert_int_equal(trigger_lines_fire(t, &shot), -EIO);
    trigger_lines_close(t);
}

static void move(int input, bool active, int64_t at_ns)
{
    const struct lines_edge edge = { input, active, at_ns };
    chip->level[input] = active;
    assert_int_equal(send(chip->edges[1], &edge, sizeof(edge), 0), sizeof(edge));
}

// To the given level and back n times, half a millisecond each, and then there or not; all of it is there at once.
static void bounce(int input, bool to, int n, bool there, int64_t at_ns)
{
    struct lines_edge edge[20];
    const int n_edges = 2 * n + there;
    assert_true(n_edges <= 20);
    for (int i = 0; i < n_edges; i++)
        edge[i] = (struct lines_edge){ input, (i % 2 == 0) == to, at_ns + i * MS / 2 };
    chip->level[input] = edge[n_edges - 1].active;
    assert_int_equal(send(chip->edges[1], edge, (size_t)n_edges * sizeof(edge[0]), 0), (size_t)n_edges * sizeof(edge[0]));
}

static void a_button_is_heard_once_however_it_bounces(void **state)
{
    (void)state;
    enum { BUTTON = 2 }; // after two feedback inputs
    struct trigger_lines *t = open_fake(2);
    const int64_t down_ns = clock_ns();
    bounce(BUTTON, true, 4, true, down_ns);
    serve(t, &heard.n_button, 1);
    assert_int_equal(heard.button_ns, down_ns); // the first touch, not the end of the debounce time
    bounce(BUTTON, false, 1, false, clock_ns()); // held, but loose for an instant
    serve_for(t, 60);
    assert_int_equal(heard.n_button, 1);
    bounce(BUTTON, false, 4, true, clock_ns()); // let go
    serve_for(t, 60);
    assert_int_equal(heard.n_button, 1);
    bounce(BUTTON, true, 1, false, clock_ns()); // a flash pack's spike: back before it could rest
    serve_for(t, 60);
    assert_int_equal(heard.n_button, 1);
    move(BUTTON, true, clock_ns());
    serve(t, &heard.n_button, 2);
    trigger_lines_close(t);
}

static void a_sync_contact_is_heard_once_with_its_own_time(void **state)
{
    (void)state;
    memset(&heard, 0, sizeof(heard));
    memset((void *)chip, 0, sizeof(*chip));
    struct trigger_lines *t;
    studio(3);
    camera[1].feedback_line = CONFIG_NONE; // inputs are those of cameras 0 and 2, then the button
    assert_int_equal(trigger_lines_open(&t, &config, &host, &fake_lines, false), 0);
    const int64_t now_ns = clock_ns();
    move(1, true, now_ns - 5 * MS);
    move(1, false, now_ns - 4 * MS);
    move(1, true, now_ns - 4 * MS + 1); // bounce
    move(0, true, now_ns - 3 * MS);
    move(0, false, now_ns + 2 * MS);
    move(1, false, now_ns + 2 * MS);
    move(1, true, now_ns + 50 * MS); // the next shot
    serve(t, &heard.n_feedback, 3);
    serve_for(t, 20);
    assert_int_equal(heard.n_feedback, 3);
    const int who[] = { 2, 0, 2 };
    const int64_t when[] = { now_ns - 5 * MS, now_ns - 3 * MS, now_ns + 50 * MS };
    for (int i = 0; i < 3; i++) {
        assert_int_equal(heard.camera[i], who[i]);
        assert_int_equal(heard.at_ns[i], when[i]);
    }
    assert_int_equal(heard.n_button, 0);
    trigger_lines_close(t);
}

static void a_cut_supply_is_given_back_by_itself(void **state)
{
    (void)state;
    memset((void *)chip, 0, sizeof(*chip));
    struct trigger_lines *t;
    studio(1);
    config.trigger.max_hold_ms = 50;
    assert_int_equal(trigger_lines_open(&t, &config, &host, &fake_lines, false), 0);
    assert_int_equal(trigger_lines_relay(t, 0, true), 0);
    wait_for_sets(2);
    assert_int_equal(n_active(0), 1);
    assert_int_equal(n_active(1), 0);
    camera[0].relay_line = CONFIG_NONE;
    trigger_lines_close(t);
    assert_int_equal(trigger_lines_open(&t, &config, &host, &fake_lines, false), 0);
    assert_int_equal(trigger_lines_relay(t, 0, true), -ENOTSUP);
    trigger_lines_close(t);
}

// ---- kinds, through trigger.h ------------------------------------------------------------------------------------------------------------

static void serve_trigger(struct trigger *t, const int *count, int n)
{
    const int64_t end_ns = clock_ns() + PATIENCE_MS * MS;
    while (*count < n) {
        struct pollfd p = { trigger_fd(t), POLLIN, 0 };
        assert_true(clock_ns() < end_ns);
        poll(&p, 1, 100);
        trigger_dispatch(t);
    }
}

static void fire(struct trigger *t, struct trigger_shot *shot, int lead_ms) // once more on a machine that stood still until it was too late
{
    int err;
    do {
        shot->at_ns = clock_ns() + lead_ms * MS;
        err = trigger_fire(t, shot);
    } while (err == -ETIME);
    assert_int_equal(err, 0);
}

static int receive(int fd, struct shutter_line *record)
{
    struct pollfd p = { fd, POLLIN, 0 };
    assert_int_equal(poll(&p, 1, PATIENCE_MS), 1);
    const ssize_t size = recv(fd, record, SHUTTER_LINE_PER_PACKET * sizeof(*record), 0);
    assert_int_equal(size % (ssize_t)sizeof(*record), 0);
    return (int)(size / (ssize_t)sizeof(*record));
}

static void the_simulated_rig_gets_exact_times_and_answers(void **state)
{
    (void)state;
    struct trigger *t;
    struct shutter_line record[SHUTTER_LINE_PER_PACKET];
    struct sockaddr_un a = { .sun_family = AF_UNIX };
    memset(&heard, 0, sizeof(heard));
    studio(200);
    config.trigger.kind = TRIGGER_SIMULATED;
    snprintf(config.trigger.address, sizeof(config.trigger.address), "@studiorig-test-%d", getpid());
    memcpy(a.sun_path + 1, config.trigger.address + 1, strlen(config.trigger.address) - 1);
    const socklen_t length = offsetof(struct sockaddr_un, sun_path) + strlen(config.trigger.address);
    const int listening = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    log_set_level(LOG_SILENT);
    assert_int_equal(trigger_open(&t, &config, &host), -ENODEV);
    log_set_level(LOG_INFO);
    assert_null(t);
    assert_int_equal(bind(listening, (struct sockaddr *)&a, length), 0);
    assert_int_equal(listen(listening, 1), 0);
    assert_int_equal(trigger_open(&t, &config, &host), 0);
    assert_int_equal(trigger_abilities(t), TRIGGER_SYNCHRONISED | TRIGGER_HALF_PRESS | TRIGGER_DELAYS | TRIGGER_FEEDBACK |
        TRIGGER_RELAYS | TRIGGER_HEAD);
    const int rigsim = accept(listening, NULL, NULL);
    for (int cut = 1; cut >= 0; cut--) {
        assert_int_equal(trigger_relay(t, 150, cut), 0);
        assert_int_equal(receive(rigsim, record), 1);
        assert_int_equal(record[0].line, SHUTTER_LINE_POWER);
        assert_int_equal(record[0].level, cut);
        assert_int_equal(record[0].channel, 150);
    }

    uint32_t delay_us[200] = { [7] = 1234 };
    struct trigger_shot shot = { .half_ms = 150, .hold_ms = 10, .delay_us = delay_us };
    fire(t, &shot, 200);
    const struct { int n, line, level; int64_t at_ns; } expected[] = {
        { 200, SHUTTER_LINE_HALF, 1, shot.at_ns - 150 * MS },
        { 199, SHUTTER_LINE_FULL, 1, shot.at_ns },
        { 1, SHUTTER_LINE_FULL, 1, shot.at_ns + 1234000 },
        { 398, 0, 0, shot.at_ns + 10 * MS },
        { 2, 0, 0, shot.at_ns + 1234000 + 10 * MS },
    };
    for (size_t i = 0; i < sizeof(expected) / sizeof(expected[0]); i++) {
        assert_int_equal(receive(rigsim, record), expected[i].n);
        for (int k = 0; k < expected[i].n; k++) {
            assert_int_equal(record[k].kind, SHUTTER_LINE_SET);
            assert_int_equal(record[k].level, expected[i].level);
            assert_int_equal(record[k].at_ns, expected[i].at_ns);
            if (expected[i].line)
                assert_int_equal(record[k].line, expected[i].line);
            if (expected[i].n <= 2)
                assert_int_equal(record[k].channel, 7);
        }
    }
    serve_trigger(t, &heard.n_fired, 1);
    assert_int_equal(heard.err, 0);
    assert_int_equal(heard.pressed_ns, shot.at_ns);
    assert_int_equal(heard.late_ns, 0);

    const struct shutter_line sync[] = { { .kind = SHUTTER_LINE_SYNC, .channel = 199, .at_ns = shot.at_ns + 7 },
        { .kind = SHUTTER_LINE_SYNC, .channel = 200, .at_ns = 1 }, // there is no such camera here
        { .kind = SHUTTER_LINE_SYNC, .channel = 0, .at_ns = shot.at_ns + 8 } };
    assert_int_equal(send(rigsim, sync, sizeof(sync), 0), sizeof(sync));
    serve_trigger(t, &heard.n_feedback, 2);
    assert_int_equal(heard.camera[0], 199);
    assert_int_equal(heard.at_ns[0], shot.at_ns + 7);
    assert_int_equal(heard.camera[1], 0);

    log_set_level(LOG_SILENT);
    close(rigsim);
    serve_trigger(t, &heard.n_broken, 1);
    log_set_level(LOG_INFO);
    assert_int_equal(trigger_fire(t, &shot), -EIO);
    trigger_close(t);
    close(listening);
}

static void a_hostile_simulated_rig_only_breaks_the_link(void **state)
{
    (void)state;
    const size_t sizes[] = { 1, 47, 49, 48 * 512 + 48 };
    static char rubbish[48 * 513];
    memset(rubbish, 0xa5, sizeof(rubbish));
    log_set_level(LOG_SILENT);
    for (size_t i = 0; i < sizeof(sizes) / sizeof(sizes[0]); i++) {
        struct trigger *t;
        struct sockaddr_un a = { .sun_family = AF_UNIX };
        memset(&heard, 0, sizeof(heard));
        studio(2);
        config.trigger.kind = TRIGGER_SIMULATED;
        snprintf(config.trigger.address, sizeof(config.trigger.address), "@studiorig-test-%d-%d", getpid(), (int)i);
        memcpy(a.sun_path + 1, config.trigger.address + 1, strlen(config.trigger.address) - 1);
        const int listening = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
        assert_int_equal(bind(listening, (struct sockaddr *)&a, offsetof(struct sockaddr_un, sun_path) +
            strlen(config.trigger.address)), 0);
        assert_int_equal(listen(listening, 1), 0);
        assert_int_equal(trigger_open(&t, &config, &host), 0);
        const int rigsim = accept(listening, NULL, NULL);
        assert_int_equal(send(rigsim, rubbish, 48 * 512, 0), 48 * 512); // whole records of no known kind: ignored
        assert_int_equal(send(rigsim, rubbish, sizes[i], 0), sizes[i]);
        serve_trigger(t, &heard.n_broken, 1);
        assert_int_equal(heard.n_feedback, 0);
        trigger_close(t);
        close(rigsim);
        close(listening);
    }
    log_set_level(LOG_INFO);
}

static void software_presses_each_camera_through_its_driver(void **state)
{
    (void)state;
    struct trigger *t;
    const uint64_t skip[4] = { 2 };
    memset(&heard, 0, sizeof(heard));
    studio(3);
    config.trigger.kind = TRIGGER_SOFTWARE;
    assert_int_equal(trigger_open(&t, &config, &host), 0);
    assert_int_equal(trigger_abilities(t), 0); // and says that it is not synchronised
    struct trigger_shot shot = { .at_ns = clock_ns() + PATIENCE_MS * MS, .hold_ms = 100, .skip = skip };
    struct trigger_shot bad = shot;
    bad.hold_ms = 3001;
    assert_int_equal(trigger_fire(t, &bad), -EINVAL);
    bad = shot;
    bad.at_ns = 1;
    assert_int_equal(trigger_fire(t, &bad), -ETIME);
    fire(t, &shot, 10);
    assert_int_equal(trigger_fire(t, &shot), -EBUSY);
    serve_trigger(t, &heard.n_fired, 1);
    assert_int_equal(heard.n_pressed, 2);
    assert_int_equal(heard.camera[0], 0);
    assert_int_equal(heard.camera[1], 2);
    assert_true(heard.late_ns >= 0);

    const struct trigger_shot far = { .at_ns = clock_ns() + 60000 * MS, .hold_ms = 100 };
    assert_int_equal(trigger_fire(t, &far), 0);
    trigger_release(t);
    serve_trigger(t, &heard.n_fired, 2);
    assert_int_equal(heard.err, -ECANCELED);
    assert_int_equal(heard.n_pressed, 2);
    trigger_close(t);
}

static void keep_message(void *arg, enum log_level level, const char *message)
{
    (void)level;
    snprintf(arg, 400, "%s", message);
}

static void a_chip_that_is_not_there_is_named_with_a_remedy(void **state)
{
    (void)state;
    char message[400] = "";
    struct trigger *t;
    studio(1);
    log_set_level(LOG_SILENT);
    log_set_hook(keep_message, message);
    snprintf(config.trigger.chip, sizeof(config.trigger.chip), "studiorig-no-such-chip");
    assert_int_equal(trigger_open(&t, &config, &host), -ENODEV);
    assert_null(t);
    assert_non_null(strstr(message, "studiorig-no-such-chip"));
    assert_non_null(strstr(message, "gpiodetect"));
    snprintf(config.trigger.chip, sizeof(config.trigger.chip), "/dev/null");
    assert_int_not_equal(trigger_open(&t, &config, &host), 0);
    assert_non_null(strstr(message, "/dev/null"));
    config.trigger.kind = TRIGGER_USB;
    assert_int_equal(trigger_open(&t, &config, &host), -ENODEV);
    log_set_hook(NULL, NULL);
    log_set_level(LOG_INFO);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(presses_half_then_full_and_releases_both),
        cmocka_unit_test(delays_each_body_and_skips_the_quarantined),
        cmocka_unit_test(common_lines_serve_bodies_without_their_own),
        cmocka_unit_test(a_late_host_shifts_pulses_but_never_bends_them),
        cmocka_unit_test(a_press_that_comes_far_too_late_is_not_done),
        cmocka_unit_test(refuses_what_it_must_not_do),
        cmocka_unit_test(a_camera_without_any_line_is_refused),
        cmocka_unit_test(the_panorama_camera_needs_no_line),
        cmocka_unit_test(a_supply_comes_back_however_often_it_is_cut),
        cmocka_unit_test(one_shot_is_three_calls_to_the_chip),
        cmocka_unit_test(a_host_that_stands_still_shortens_no_pulse),
        cmocka_unit_test(release_in_the_middle_opens_everything_and_says_so_once),
        cmocka_unit_test(a_line_that_breaks_in_the_middle_releases_all_and_tells_once),
        cmocka_unit_test(lines_that_cannot_be_released_are_not_said_to_be),
        cmocka_unit_test(a_chip_that_is_gone_is_told),
        cmocka_unit_test(close_in_the_middle_opens_everything),
        cmocka_unit_test(killed_in_the_middle_the_guard_lets_go),
        cmocka_unit_test(stopped_in_the_middle_the_guard_lets_go_at_the_limit),
        cmocka_unit_test(with_nothing_to_watch_the_guard_sleeps),
        cmocka_unit_test(without_its_guard_nothing_is_pressed),
        cmocka_unit_test(a_button_is_heard_once_however_it_bounces),
        cmocka_unit_test(a_sync_contact_is_heard_once_with_its_own_time),
        cmocka_unit_test(a_cut_supply_is_given_back_by_itself),
        cmocka_unit_test(the_simulated_rig_gets_exact_times_and_answers),
        cmocka_unit_test(a_hostile_simulated_rig_only_breaks_the_link),
        cmocka_unit_test(software_presses_each_camera_through_its_driver),
        cmocka_unit_test(a_chip_that_is_not_there_is_named_with_a_remedy),
    };
    chip = mmap(NULL, sizeof(*chip), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (chip == MAP_FAILED)
        return 1;
    return cmocka_run_group_tests(tests, NULL, NULL);
}
