// tests/test_calibrate.c - lag is measured well enough to be worth compensating, whatever one body does once.
#include "rigd/calibrate.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

static uint64_t seed;

static double uniform(void)
{
    seed ^= seed << 13, seed ^= seed >> 7, seed ^= seed << 17;
    return ((double)(seed >> 11) + .5) * 0x1p-53;
}

static double normal(void)
{
    return sqrt(-2 * log(uniform())) * cos(6.283185307179586 * uniform());
}

static void the_error_it_states_is_the_error_it_makes(void **state)
{
    (void)state;
    static const double bodies[][2] = { { 117, 3 }, { 97, 7 }, { 60, .2 } };
    seed = 7;
    for (int b = 0; b < 3; b++) {
        enum { RUNS = 4000, SHOTS = 30 };
        int n_inside = 0;
        double std = 0;
        for (int run = 0; run < RUNS; run++) {
            double v[SHOTS];
            struct lag lag;
            for (int i = 0; i < SHOTS; i++)
                v[i] = bodies[b][0] + bodies[b][1] * normal();
            assert_int_equal(lag_estimate(&lag, v, SHOTS), 0);
            n_inside += fabs(lag.mean_ms - bodies[b][0]) <= lag.error_ms;
            std += lag.std_ms / RUNS;
        }
        // 95 % of the time; 4000 runs scatter by .35 %, rejecting costs a little.
        assert_true(n_inside > .93 * RUNS && n_inside < .97 * RUNS);
        assert_true(fabs(std / bodies[b][1] - 1) < .03);
    }
}

static void a_body_that_dozed_off_does_not_move_the_mean(void **state)
{
    (void)state;
    double v[30];
    struct lag lag;
    seed = 11;
    for (int i = 0; i < 30; i++)
        v[i] = 117 + 3 * normal() + (i % 7 == 0 ? 200 : 0); // 5 of 30
    assert_int_equal(lag_estimate(&lag, v, 30), 0);
    assert_int_equal(lag.n_rejected, 5);
    assert_int_equal(lag.n, 25);
    assert_true(fabs(lag.mean_ms - 117) < lag.error_ms * 2);
}

static void too_few_shots_are_no_measurement(void **state)
{
    (void)state;
    const double v[3] = { 60, 60, 60 };
    struct lag lag;
    assert_int_equal(lag_estimate(&lag, v, 2), -ENODATA);
    assert_int_equal(lag.n, 0);
    assert_int_equal(lag_estimate(&lag, v, 3), 0);
    assert_true(lag.mean_ms == 60 && lag.std_ms == 0 && lag.n_rejected == 0);
}

// Twenty-four bodies in virtual time: shots until lag_more_shots() asks for no more. The worst error of a mean; *n_shots: taken.
static double calibrate(double scatter_ms, int least, double within_ms, int most, int *n_shots)
{
    enum { BODIES = 24, SHOTS_MAX = 1000 };
    static double sample[BODIES][SHOTS_MAX];
    struct lag lag[BODIES];
    double worst = 0;
    int n = 0;
    for (int more = least; more;) {
        for (int i = 0; i < BODIES; i++) {
            for (int k = 0; k < more; k++)
                sample[i][n + k] = 60 + i + scatter_ms * normal();
            lag_estimate(&lag[i], sample[i], n + more);
        }
        n += more;
        more = lag_more_shots(lag, BODIES, within_ms, most - n);
        assert_true(more >= 0 && more <= most - n);
    }
    for (int i = 0; i < BODIES; i++)
        worst = fmax(worst, fabs(lag[i].mean_ms - 60 - i));
    *n_shots = n;
    return worst;
}

static void shots_are_taken_until_all_means_are_known_well_enough(void **state)
{
    (void)state;
    enum { RIGS = 400 };
    int n_off[3] = { 0 }, n, n_shots = 0;
    double worst[3] = { 0 };
    seed = 3;
    for (int rig = 0; rig < RIGS; rig++)
        for (int how = 0; how < 3; how++) {
            const double off = calibrate(.25, how == 1 ? 60 : 30, how < 2 ? 0 : .1, 120, &n);
            n_off[how] += off > .1;
            worst[how] = fmax(worst[how], off);
            n_shots += how == 2 ? n : 0;
        }
    print_message("# worst of 24 bodies in 400 rigs: %.3f ms with 30 shots (%d rigs beyond .1), %.3f ms with 60 (%d), %.3f ms with %.1f as needed (%d)\n", worst[0], n_off[0], worst[1], n_off[1],
                  worst[2], (double)n_shots / RIGS, n_off[2]);
    assert_true(n_off[0] > RIGS / 3); // what a fixed number does
    assert_true(n_off[2] <= RIGS / 50); // 1 % is promised; twice that is six standard deviations
}

static void no_shots_are_wasted_on_what_they_cannot_reach(void **state)
{
    (void)state;
    int n;
    seed = 5;
    calibrate(3, 30, .1, 120, &n);
    assert_int_equal(n, 30); // ten thousand would not do
    calibrate(.02, 30, .1, 120, &n);
    assert_int_equal(n, 30); // these did
    calibrate(.02, 3, .1, 12, &n);
    assert_int_equal(n, 10); // three that lie together by chance tell nothing
    const struct lag none[2] = { { .n = 0 }, { .n = 0 } };
    assert_int_equal(lag_more_shots(none, 2, .1, 100), 0);
}

static void delays_bring_all_shutters_to_the_slowest(void **state)
{
    (void)state;
    const struct lag lag[4] = { { .mean_ms = 97, .n = 30 }, { .mean_ms = 117.25, .n = 30 }, { .n = 0 }, { .mean_ms = 60, .n = 30 } };
    uint32_t delay_us[4];
    assert_int_equal(lag_delays(lag, 4, 990000, delay_us), 0);
    assert_int_equal(delay_us[0], 20250);
    assert_int_equal(delay_us[1], 0);
    assert_int_equal(delay_us[2], 25833); // not measured: as the mean of the others
    assert_int_equal(delay_us[3], 57250);
    assert_int_equal(lag_delays(lag, 4, 30000, delay_us), 1);
    assert_int_equal(delay_us[3], 30000);
    const struct lag none[2] = { { .n = 0 }, { .n = 0 } };
    assert_int_equal(lag_delays(none, 2, 1000, delay_us), 0);
    assert_int_equal(delay_us[0] + delay_us[1], 0);
}

static void a_shots_late_bodies_are_named(void **state)
{
    (void)state;
    const int64_t at[5] = { 1000000000, INT64_MIN, 1000400000, 1000200000, 1034000000 };
    struct shot_timing t;
    shot_timing(&t, at, 5, 2000000);
    assert_int_equal(t.n_measured, 4);
    assert_int_equal(t.spread_ns, 34000000);
    assert_int_equal(t.n_late, 1);
    assert_int_equal(t.late[0], 1 << 4);
    assert_true(fabs((double)t.sigma_ns - 16900789) < 2); // sqrt(sum of squares / 3), by hand
    const int64_t none[2] = { INT64_MIN, INT64_MIN };
    shot_timing(&t, none, 2, 1);
    assert_int_equal(t.n_measured, 0);
}

// Who is off while the others are measured has said no serial number, and keeps the lag it had.
static void a_body_that_is_off_keeps_its_lag(void **state)
{
    (void)state;
    struct config_camera camera[2] = { { .name = "A01", .serial = "11" }, { .name = "A02", .serial = "22" } };
    const struct config config = { .n_cameras = 2, .camera = camera };
    const char *const serial[2] = { "11", "" };
    const struct lag lag[2] = { { 97, 7, 2, 30, 0 }, { 117, 3, 1, 29, 1 } };
    struct lag back[2];
    char path[] = "/tmp/studiorig-test-XXXXXX";
    close(mkstemp(path));
    assert_int_equal(lag_write(path, &config, serial, lag, "2026-11-22T09:00:00Z"), 0);
    assert_int_equal(lag_read(path, &config, back), 0);
    assert_memory_equal(back, lag, sizeof(lag));
    unlink(path);
}

static void lag_follows_the_body_not_its_place(void **state)
{
    (void)state;
    struct config_camera camera[3] = { { .name = "A01", .serial = "11" }, { .name = "A02", .serial = "22" }, { .name = "A03" } };
    const struct config config = { .n_cameras = 3, .camera = camera };
    const char *const serial[3] = { "11", "22", "33" };
    const struct lag lag[3] = { { 97, 7, 2, 30, 0 }, { 117, 3, 1, 29, 1 }, { 60, 1, .5, 30, 0 } };
    struct lag back[3];
    char path[] = "/tmp/studiorig-test-XXXXXX";
    close(mkstemp(path));
    assert_int_equal(lag_write(path, &config, serial, lag, "2026-11-22T09:00:00Z"), 0);
    strcpy(camera[0].serial, "22"), strcpy(camera[1].serial, "44"); // one moved, one new
    assert_int_equal(lag_read(path, &config, back), 0);
    assert_memory_equal(&back[0], &lag[1], sizeof(lag[0]));
    assert_int_equal(back[1].n, 0);
    assert_memory_equal(&back[2], &lag[2], sizeof(lag[0]));
    FILE *f = fopen(path, "w");
    fputs("{\"lag\":[{\"serial\":\"22\",\"mean_ms\":1e300,\"std_ms\":1,\"error_ms\":1,\"n\":3,\"n_rejected\":0}]}", f);
    fclose(f);
    log_set_level(LOG_SILENT);
    assert_int_equal(lag_read(path, &config, back), -EINVAL);
    log_set_level(LOG_INFO);
    assert_int_equal(back[0].n, 0);
    unlink(path);
    assert_int_equal(lag_read(path, &config, back), -ENOENT);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(the_error_it_states_is_the_error_it_makes),
        cmocka_unit_test(a_body_that_dozed_off_does_not_move_the_mean),
        cmocka_unit_test(too_few_shots_are_no_measurement),
        cmocka_unit_test(shots_are_taken_until_all_means_are_known_well_enough),
        cmocka_unit_test(no_shots_are_wasted_on_what_they_cannot_reach),
        cmocka_unit_test(delays_bring_all_shutters_to_the_slowest),
        cmocka_unit_test(a_shots_late_bodies_are_named),
        cmocka_unit_test(a_body_that_is_off_keeps_its_lag),
        cmocka_unit_test(lag_follows_the_body_not_its_place),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
