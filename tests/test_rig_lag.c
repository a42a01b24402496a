// tests/test_rig_lag.c - the rig takes as many shots for the lag of its bodies as they need, in virtual time.
#include "tests/rig_world.h"

enum { BODIES = 24, SHOTS = 30 };

// How many shots it took; *worst_ms: the furthest mean from the truth. within_ms 0: a fixed number.
static int calibrate(uint64_t seed, double within_ms, double scatter_ms, bool cancel, double *worst_ms)
{
    char why[200] = "";
    int n_shots = 0;
    *worst_ms = 0;
    set_up(BODIES, seed);
    w.config.lag_within_ms = within_ms;
    for (int i = 0; i < BODIES; i++) {
        w.camera[i].lag_ms = 90 + i;
        w.camera[i].jitter_ms = scatter_ms;
    }
    open_all();
    assert_int_equal(rig_calibrate(w.rig, w.now, SHOTS, why), 0);
    w.calibrating = true;
    if (cancel) {
        run(10 * S, true);
        rig_cancel(w.rig, w.now, why);
    }
    run(4000 * S, true);
    w.calibrating = false;
    drain_actions();
    assert_int_equal(w.n_lags_done, 1);
    for (int i = 0; i < BODIES; i++) {
        const struct lag lag = rig_camera(w.rig, i).lag;
        const int n = lag.n + lag.n_rejected;
        n_shots = n > n_shots ? n : n_shots;
        *worst_ms = fmax(*worst_ms, fabs(lag.mean_ms - w.camera[i].lag_ms));
    }
    tear_down();
    return n_shots;
}

static void each_mean_is_within_a_tenth_of_a_millisecond(void **state)
{
    (void)state;
    enum { RIGS = 12 };
    double worst, most[2] = { 0 };
    int n_off[2] = { 0 }, n_shots = 0;
    for (uint64_t seed = 1; seed <= RIGS; seed++)
        for (int how = 0; how < 2; how++) {
            const int n = calibrate(seed, how ? .1 : 0, .25, false, &worst);
            assert_true(how ? n > SHOTS && n <= CONFIG_SHOTS_FACTOR * SHOTS : n == SHOTS);
            n_off[how] += worst > .1;
            most[how] = fmax(most[how], worst);
            n_shots += how ? n : 0;
        }
    print_message("# worst of %d bodies in %d rigs: %.3f ms with %d shots, %.3f ms with as many as needed (%.0f)\n", BODIES, RIGS, most[0], SHOTS, most[1], (double)n_shots / RIGS);
    assert_true(n_off[0] > 0);
    assert_true(n_off[1] <= 1);
}

static void bodies_that_cannot_get_there_cost_no_shots(void **state)
{
    (void)state;
    double worst;
    assert_int_equal(calibrate(1, .1, 3, false, &worst), SHOTS);
}

static void cancelled_it_ends(void **state)
{
    (void)state;
    double worst;
    assert_true(calibrate(1, .1, .25, true, &worst) < SHOTS);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(each_mean_is_within_a_tenth_of_a_millisecond),
        cmocka_unit_test(bodies_that_cannot_get_there_cost_no_shots),
        cmocka_unit_test(cancelled_it_ends),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
