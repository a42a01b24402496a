// tests/test_board_clock.c - host and board agree on the time, and know how well.
//
// In virtual time: a counter that is off by up to 100 ppm and wanders, behind a USB of 1 ms frames whose host is late now and then, by
// tens of milliseconds too. Delays out and back differ.
#include "rigd/board_clock.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <cmocka.h>

#define S INT64_C(1000000000)
enum { TICKS_PER_S = 2000000, SEEDS = 16 };

struct world {
    uint64_t state; // of the random numbers
    double out_us, back_us; // shortest delays
    bool every_waits;       // each transfer waits for a frame; otherwise most do
    double fast_ppm, wander_ns_per_s2, phase;
    int64_t now_ns, began_ns;
};

static double chance(struct world *w)
{
    w->state ^= w->state << 13;
    w->state ^= w->state >> 7;
    w->state ^= w->state << 17;
    return (double)(w->state >> 11) / 9007199254740992.;
}

static struct world world_of(int seed, double out_us, double back_us, bool every_waits, bool wanders)
{
    struct world w = { .state = (uint64_t)seed * 0x9e3779b97f4a7c15u, .out_us = out_us, .back_us = back_us, .every_waits = every_waits };
    for (int i = 0; i < 10; i++)
        chance(&w);
    w.fast_ppm = 200 * chance(&w) - 100;
    w.wander_ns_per_s2 = wanders ? BOARD_CLOCK_WANDER_NS : 0;
    w.phase = 2 * M_PI * chance(&w);
    w.now_ns = w.began_ns = (int64_t)(chance(&w) * 1e15);
    return w;
}

// What the counter shows, in ticks: its rate swings about fast_ppm, by as much per second as it is allowed to.
static double counter(const struct world *w, int64_t ns)
{
    const double s = 1e-9 * (double)(ns - w->began_ns), turn = 2 * M_PI / 40;
    const double swing = 1e-9 * w->wander_ns_per_s2 / (turn * turn) * (sin(turn * s + w->phase) - sin(w->phase));
    return 1e6 + TICKS_PER_S * (s * (1 + 1e-6 * w->fast_ppm) + swing);
}

static int64_t delay_ns(struct world *w, double least_us)
{
    double us = least_us;
    if (w->every_waits || chance(w) < .7)
        us += 1000 * chance(w);
    else
        us += -20 * log(1 - chance(w));
    if (chance(w) < .05)
        us += fmin(200 * pow(1 - chance(w), -1 / 1.2), 50000);
    return (int64_t)(1e3 * us);
}

// One round trip, and the pause after it.
static bool round_trip(struct world *w, struct board_clock *c, double pause_ms)
{
    const int64_t sent_ns = w->now_ns, stamped_ns = sent_ns + delay_ns(w, w->out_us), received_ns = stamped_ns + delay_ns(w, w->back_us);
    const int64_t next_ns = sent_ns + (int64_t)(1e6 * pause_ms * (.5 + chance(w)));
    w->now_ns = next_ns > received_ns ? next_ns : received_ns;
    return board_clock_add(c, sent_ns, received_ns, (int64_t)floor(counter(w, stamped_ns)));
}

static void run_until(struct world *w, struct board_clock *c, double s)
{
    while (w->now_ns < w->began_ns + (int64_t)(s * 1e9))
        assert_true(round_trip(w, c, 20));
}

static double error_us(const struct world *w, const struct board_clock *c, int64_t at_ns)
{
    const double ticks = counter(w, at_ns), whole = floor(ticks);
    return 1e-3 * ((double)(board_clock_ns(c, (int64_t)whole) - at_ns) + 1e9 / TICKS_PER_S * (ticks - whole));
}

static const struct {
    double out_us, back_us;
    bool every_waits;
} wires[] = { { 20, 20, false }, { 50, 30, false }, { 30, 50, false }, { 20, 20, true }, { 300, 20, false }, { 20, 300, false }, { 300, 20, true },
    { 200, 0, false }, { 0, 200, false }, { 1, 1, false } };
enum { FAIR_WIRES = 4, WIRES = sizeof(wires) / sizeof(wires[0]) };

static void after_ten_seconds_the_error_is_below_20_us(void **state)
{
    (void)state;
    for (int wire = 0; wire < FAIR_WIRES; wire++) {
        double worst_us = 0;
        for (int seed = 1; seed <= SEEDS; seed++) {
            static struct board_clock c;
            struct world w = world_of(seed, wires[wire].out_us, wires[wire].back_us, wires[wire].every_waits, seed % 2);
            board_clock_init(&c, TICKS_PER_S);
            run_until(&w, &c, 10);
            worst_us = fmax(worst_us, fabs(error_us(&w, &c, w.began_ns + 10 * S)));
        }
        print_message("out %g us, back %g us%s: at most %.1f us off after 10 s\n", wires[wire].out_us, wires[wire].back_us, wires[wire].every_waits ? ", all wait for frames" : "", worst_us);
        assert_true(worst_us <= 20);
    }
}

static void it_is_never_further_off_than_it_says(void **state)
{
    (void)state;
    for (int wire = 0; wire < WIRES; wire++)
        for (int seed = 1; seed <= SEEDS; seed++) {
            static struct board_clock c;
            struct world w = world_of(100 + seed, wires[wire].out_us, wires[wire].back_us, wires[wire].every_waits, true);
            board_clock_init(&c, TICKS_PER_S);
            assert_false(board_clock_is_known(&c));
            for (int i = 0; i < 400; i++) {
                assert_true(round_trip(&w, &c, i < 20 ? 1 : 20));
                const int64_t at_ns = w.now_ns + (int64_t)(chance(&w) * (i % 8 ? 1e9 : 30e9)); // a shot ahead, or a link that fell silent
                assert_true(fabs(error_us(&w, &c, at_ns)) <= 1e-3 * (double)board_clock_uncertainty_ns(&c, at_ns));
            }
            // And it is not merely afraid: what cannot be known (half the shortest round trip), a little for chance, drift to some ppm.
            double drift_ppm;
            assert_true(1e-3 * (double)board_clock_uncertainty_ns(&c, w.now_ns) < .5 * (wires[wire].out_us + wires[wire].back_us) * 1.5 + 60);
            assert_true(fabs(board_clock_fast_ppm(&c, &drift_ppm) - w.fast_ppm) < drift_ppm + 3);
            assert_true(drift_ppm < 60);
        }
}

// Over a wire so short that bending shows: no round trip seems to lie, and the uncertainty still holds.
static void a_crystal_that_warms_up_is_followed(void **state)
{
    (void)state;
    for (int seed = 1; seed <= 4; seed++) {
        static struct board_clock c;
        struct world w = world_of(200 + seed, 1, 1, false, true);
        board_clock_init(&c, TICKS_PER_S);
        for (int i = 0; i < 2000; i++) {
            assert_true(round_trip(&w, &c, 50));
            const int64_t at_ns = w.now_ns + (int64_t)(chance(&w) * 20e9);
            assert_true(fabs(error_us(&w, &c, at_ns)) <= 1e-3 * (double)board_clock_uncertainty_ns(&c, at_ns));
        }
    }
}

static void a_false_stamp_changes_nothing(void **state)
{
    (void)state;
    static struct board_clock c;
    struct world w = world_of(7, 20, 20, false, false);
    board_clock_init(&c, TICKS_PER_S);
    run_until(&w, &c, 1);
    for (int i = 0; i < 100; i++) {
        const struct board_clock before = c;
        const int64_t now = w.now_ns, ticks = (int64_t)counter(&w, now);
        assert_false(board_clock_add(&c, now, now + 100000, ticks + (i % 2 ? 1 : -1) * (1000 + 1000 * (i % 5))));
        assert_int_equal(board_clock_ns(&c, ticks), board_clock_ns(&before, ticks));
        run_until(&w, &c, 1 + .05 * (i + 1)); // truth in between
    }
    assert_true(fabs(error_us(&w, &c, w.now_ns)) < 20);
}

static void a_first_lie_does_not_last(void **state)
{
    (void)state;
    static struct board_clock c;
    struct world w = world_of(8, 20, 20, false, false);
    board_clock_init(&c, TICKS_PER_S);
    board_clock_add(&c, w.now_ns, w.now_ns + 100000, 77);
    for (int i = 0; i < 2 * BOARD_CLOCK_LIES_MAX; i++)
        round_trip(&w, &c, 1);
    run_until(&w, &c, 1);
    assert_true(fabs(error_us(&w, &c, w.now_ns)) < 20);
}

static void a_counter_that_began_anew_is_learnt_anew(void **state)
{
    (void)state;
    static struct board_clock c;
    struct world w = world_of(9, 20, 20, false, false);
    board_clock_init(&c, TICKS_PER_S);
    run_until(&w, &c, 5);
    w.began_ns = w.now_ns; // its reset
    for (int i = 0; i < BOARD_CLOCK_LIES_MAX; i++)
        assert_false(round_trip(&w, &c, 1));
    assert_true(board_clock_is_known(&c));
    run_until(&w, &c, 2);
    assert_true(fabs(error_us(&w, &c, w.now_ns)) < 20);
}

static void what_cannot_be_is_refused(void **state)
{
    (void)state;
    static struct board_clock c;
    board_clock_init(&c, TICKS_PER_S);
    assert_false(board_clock_add(&c, 1000, 999, 0));
    assert_false(board_clock_add(&c, 0, 61 * S, 0));
    assert_false(board_clock_is_known(&c));
    assert_true(board_clock_add(&c, 5 * S, 5 * S + 1000, INT64_MAX / 2));
    assert_false(board_clock_add(&c, 6 * S, 6 * S + 1000, INT64_MIN / 2));
    assert_true(board_clock_add(&c, 90000 * S, 90000 * S + 1000, 7)); // what was known a day ago contradicts nothing
    assert_true(board_clock_is_known(&c));
}

static void ticks_and_nanoseconds_are_each_other_s_inverse(void **state)
{
    (void)state;
    static struct board_clock c;
    struct world w = world_of(10, 20, 20, false, false);
    board_clock_init(&c, TICKS_PER_S);
    run_until(&w, &c, 3);
    for (int i = 0; i < 1000; i++) {
        const int64_t ns = w.now_ns + (int64_t)(chance(&w) * 20e9) - 10 * S, ticks = board_clock_ticks(&c, ns);
        assert_true(llabs(board_clock_ns(&c, ticks) - ns) <= S / TICKS_PER_S / 2 + 1);
        assert_int_equal(board_clock_ticks(&c, board_clock_ns(&c, ticks)), ticks);
    }
}

static void a_counter_of_32_bits_is_followed_round_its_turns(void **state)
{
    (void)state;
    int64_t full = 5;
    for (int i = 0; i < 1000; i++) {
        const int64_t next = full + (i % 3 ? INT64_C(0x7ffffff0) : -INT64_C(0x3fffffff));
        assert_int_equal(board_clock_unwrap(full, (uint32_t)next), next);
        full = next;
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(after_ten_seconds_the_error_is_below_20_us),
        cmocka_unit_test(it_is_never_further_off_than_it_says),
        cmocka_unit_test(a_crystal_that_warms_up_is_followed),
        cmocka_unit_test(a_false_stamp_changes_nothing),
        cmocka_unit_test(a_first_lie_does_not_last),
        cmocka_unit_test(a_counter_that_began_anew_is_learnt_anew),
        cmocka_unit_test(what_cannot_be_is_refused),
        cmocka_unit_test(ticks_and_nanoseconds_are_each_other_s_inverse),
        cmocka_unit_test(a_counter_of_32_bits_is_followed_round_its_turns),
    };
    return cmocka_run_group_tests_name("board_clock", tests, NULL, NULL);
}
