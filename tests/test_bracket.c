// tests/test_bracket.c - the merge against the numbers it promises: no bias, the Poisson bound, clipping declared, intruders named; the
// sensor measured; the planner.
#include "rigd/bracket.h"
#include "tests/panorama_camera.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <errno.h>
#include <cmocka.h>

enum { W = 192, H = 128 };
static const double whole = 1; // the longest exposure: h = 1 with f/1

// Frames of a scene given by radiance per site (site's own colour), times 1, 1/4, 1/16 ...
static struct sim_camera camera_of(double read_noise_e)
{
    struct sim_camera c = sim_usual;
    c.lens = (struct lens){ .model = LENS_EQUIDISTANT, .width_px = W, .height_px = H, .focal_px = 60, .centre_px = { W / 2, H / 2 } };
    c.f_number = 1;
    c.read_noise_e = read_noise_e;
    assert_int_equal(lens_init(&c.lens, "test"), 0);
    return c;
}

static struct bracket_options options_of(const struct sim_camera *c)
{
    // Rounding to DN is noise as well.
    const double dn_e = c->electrons_at_white / (c->white - c->black);
    return (struct bracket_options){ .noise = { c->electrons_at_white, sqrt(c->read_noise_e * c->read_noise_e + dn_e * dn_e / 12) } };
}

static void merge(struct merged *out, const float *scene, const struct sim_camera *c, int n_frames, uint64_t seed, struct bracket_frame_report *reports,
                  int64_t *n_clipped, int64_t *n_defects)
{
    struct sim_camera camera = *c;
    struct bracket *b = NULL;
    const struct bracket_options options = options_of(c);
    int64_t ignored[2];
    camera.seed = seed;
    struct raw_frame f[8] = { 0 };
    for (int i = 0; i < n_frames; i++)
        assert_int_equal(sim_expose(f + i, scene, &camera, whole * pow(.25, i), 1, (uint64_t)i), 0);
    assert_int_equal(bracket_new(&b, f, &options), 0);
    for (int i = 0; i < n_frames; i++) {
        struct bracket_frame_report r;
        assert_int_equal(bracket_add(b, f + i, i + 1 < n_frames ? f + i + 1 : NULL, &r), 0);
        if (reports)
            reports[i] = r;
    }
    for (int i = 0; i < n_frames; i++)
        free(f[i].site);
    assert_int_equal(bracket_finish(out, b, n_clipped ? n_clipped : ignored, n_defects ? n_defects : ignored + 1), 0);
}

static float *levels(double lo, double hi) // columns from lo to hi, in equal ratios
{
    float *scene = malloc(W * H * sizeof(*scene));
    assert_non_null(scene);
    for (int i = 0; i < W * H; i++)
        scene[i] = (float)(lo * pow(hi / lo, (i % W) / (W - 1.)));
    return scene;
}

// Columns are one radiance each: mean and variance over H sites and RUNS noises. h of frames: 1, 1/4, 1/16, 1/64, 1/256.
static void the_merge_has_no_bias_and_reaches_the_poisson_bound(void **state)
{
    (void)state;
    enum { RUNS = 24, FRAMES = 5 };
    const struct sim_camera c = camera_of(4);
    const double w = c.electrons_at_white, s2 = c.read_noise_e * c.read_noise_e + pow(w / (c.white - c.black), 2) / 12;
    float *scene = levels(1e-3, 200); // 60 electrons in the longest frame, .78 of white in the shortest
    static double sum[W], square[W], said[W];
    memset(sum, 0, sizeof(sum));
    for (int k = 0; k < RUNS; k++) {
        struct merged m;
        merge(&m, scene, &c, FRAMES, 100 + (uint64_t)k, NULL, NULL, NULL);
        for (int i = 0; i < W * H; i++) {
            const double e = (double)m.radiance[i] - (double)scene[i];
            assert_true(m.quality[i] != BRACKET_CLIPPED);
            sum[i % W] += e, square[i % W] += e * e, said[i % W] += (double)m.variance[i];
        }
        merged_free(&m);
    }
    double bound_ratio = 0, said_ratio = 0, worst_bias = 0, poisson_ratio = 0, worst_poisson = 0;
    int n_bright = 0, n_plain = 0;
    for (int x = 0; x < W; x++) {
        const double n = (double)RUNS * H, X = (double)scene[x], variance = square[x] / n;
        double information = 0, exposure = 0; // of the frames that are usable at this radiance, and not near the edge of being so
        bool is_plain = true;
        for (int i = 0; i < FRAMES; i++) {
            const double h = pow(.25, i);
            if (X * h > .88 && X * h < .92)
                is_plain = false;
            if (X * h <= .9)
                information += w * w * h * h / (w * X * h + s2), exposure += h;
        }
        if (!is_plain)
            continue;
        n_plain++;
        bound_ratio += variance * information;
        said_ratio += said[x] / n / variance;
        worst_bias = fmax(worst_bias, fabs(sum[x] / n) / X);
        // Bias must drown: 4.5 standard errors of the mean, and a thousandth.
        assert_true(fabs(sum[x] / n) < 4.5 * sqrt(variance / n) + 1e-3 * X);
        if (X * exposure * w > 1000) { // photons prevail
            poisson_ratio += variance * exposure * w / X;
            worst_poisson = fmax(worst_poisson, variance * exposure * w / X);
            n_bright++;
        }
    }
    bound_ratio /= n_plain, said_ratio /= n_plain, poisson_ratio /= n_bright;
    if (getenv("VERBOSE"))
        fprintf(stderr, "variance / bound with read noise %.4f, / Poisson bound %.4f (worst level %.4f), said / found %.4f, worst bias %.2e\n", bound_ratio, poisson_ratio,
                worst_poisson, said_ratio, worst_bias);
    assert_true(bound_ratio > .97 && bound_ratio < 1.03);
    assert_true(poisson_ratio > .97 && poisson_ratio < 1.05);
    assert_true(said_ratio > .97 && said_ratio < 1.03);
    free(scene);
}

static void without_read_noise_it_is_the_sum_of_signals_over_the_sum_of_exposures(void **state)
{
    (void)state;
    const struct sim_camera c = camera_of(0);
    const struct bracket_options options = { .noise = { c.electrons_at_white, 0 } };
    float *scene = levels(.01, .8);
    struct raw_frame f[3];
    struct bracket *b;
    struct bracket_frame_report r;
    struct merged m;
    int64_t n[2];
    for (int i = 0; i < 3; i++)
        assert_int_equal(sim_expose(f + i, scene, &c, pow(.25, i), 1, (uint64_t)i), 0);
    assert_int_equal(bracket_new(&b, f, &options), 0);
    for (int i = 0; i < 3; i++)
        assert_int_equal(bracket_add(b, f + i, NULL, &r), 0);
    assert_int_equal(bracket_finish(&m, b, n, n + 1), 0);
    for (int i = 0; i < W * H; i++) {
        const double y = f[0].site[i] + f[1].site[i] + f[2].site[i] - 3 * c.black;
        assert_float_equal((double)m.radiance[i], y / (c.white - c.black) / 1.3125, 1e-6 * (double)scene[i]);
    }
    for (int i = 0; i < 3; i++)
        free(f[i].site);
    merged_free(&m);
    free(scene);
}

static void a_light_that_clips_in_every_frame_is_marked_with_a_lower_bound(void **state)
{
    (void)state;
    const struct sim_camera c = camera_of(4);
    float *scene = levels(.1, .1);
    for (int y = 40; y < 60; y++)
        for (int x = 80; x < 100; x++)
            scene[y * W + x] = 50; // clips at h = 1, 1/4, 1/16 (.9 there is 14.4), not at 1/64
    struct merged m;
    int64_t n_clipped;
    merge(&m, scene, &c, 3, 5, NULL, &n_clipped, NULL);
    assert_int_equal(n_clipped, 400);
    for (int y = 40; y < 60; y++)
        for (int x = 80; x < 100; x++) {
            assert_int_equal(m.quality[y * W + x], BRACKET_CLIPPED);
            assert_true((double)m.radiance[y * W + x] >= 15.9 && m.radiance[y * W + x] <= 50);
        }
    // Beside it nothing is known less well than by the rules: a ring of one site is poor, all else good.
    for (int y = 0; y < H; y++)
        for (int x = 0; x < W; x++) {
            const bool is_lit = y >= 40 && y < 60 && x >= 80 && x < 100, is_near = y >= 39 && y <= 60 && x >= 79 && x <= 100;
            if (!is_lit)
                assert_int_equal(m.quality[y * W + x], is_near ? BRACKET_POOR : BRACKET_GOOD);
        }
    merged_free(&m);
    merge(&m, scene, &c, 4, 5, NULL, &n_clipped, NULL);
    assert_int_equal(n_clipped, 0);
    assert_true(m.quality[50 * W + 90] == BRACKET_GOOD && fabs((double)m.radiance[50 * W + 90] / 50 - 1) < .05);
    merged_free(&m);
    free(scene);
}

static void light_that_bloomed_over_does_not_count_while_a_clean_frame_is_there(void **state)
{
    (void)state;
    const struct sim_camera c = camera_of(2);
    const struct bracket_options options = options_of(&c);
    float *scene = levels(.1, .1);
    scene[64 * W + 96] = 20;
    struct raw_frame f[4];
    struct bracket *b;
    struct bracket_frame_report r;
    struct merged m;
    int64_t n[2];
    for (int i = 0; i < 4; i++)
        assert_int_equal(sim_expose(f + i, scene, &c, pow(.25, i), 1, (uint64_t)i), 0);
    for (int i = 0; i < 2; i++) // where the lamp saturates, its neighbour gets what it cannot hold
        f[i].site[64 * W + 97] = (uint16_t)(c.black + 9000);
    assert_int_equal(bracket_new(&b, f, &options), 0);
    for (int i = 0; i < 4; i++)
        assert_int_equal(bracket_add(b, f + i, i < 3 ? f + i + 1 : NULL, &r), 0);
    assert_int_equal(bracket_finish(&m, b, n, n + 1), 0);
    assert_int_equal(m.quality[64 * W + 97], BRACKET_GOOD);
    assert_true(fabs((double)m.radiance[64 * W + 97] - .1) < 5 * sqrt((double)m.variance[64 * W + 97]));
    assert_true(fabs((double)m.radiance[64 * W + 96] / 20 - 1) < .1);
    for (int i = 0; i < 4; i++)
        free(f[i].site);
    merged_free(&m);
    free(scene);
}

// Lamps all over the frame; where they saturate, their neighbours get `spill` DN of what they cannot hold. What the neighbours' variance is
// said to be over the Poisson bound of all frames, and their mean over the truth.
static void beside_lamps(double spill, double *over_bound, double *mean)
{
    const struct sim_camera c = camera_of(2);
    const struct bracket_options options = options_of(&c);
    float *scene = levels(.1, .1);
    struct raw_frame f[4];
    struct bracket *b;
    struct bracket_frame_report r;
    struct merged m;
    int64_t n[2];
    int count = 0;
    for (int y = 8; y < H - 8; y += 8)
        for (int x = 8; x < W - 8; x += 8)
            scene[y * W + x] = 20;
    for (int i = 0; i < 4; i++) {
        assert_int_equal(sim_expose(f + i, scene, &c, pow(.25, i), 1, (uint64_t)i), 0);
        for (int k = 0; k < W * H - 1 && i < 2; k++)
            if (scene[k] > 1)
                f[i].site[k + 1] = (uint16_t)(f[i].site[k + 1] + spill);
    }
    assert_int_equal(bracket_new(&b, f, &options), 0);
    for (int i = 0; i < 4; i++)
        assert_int_equal(bracket_add(b, f + i, i < 3 ? f + i + 1 : NULL, &r), 0);
    assert_int_equal(bracket_finish(&m, b, n, n + 1), 0);
    *over_bound = *mean = 0;
    for (int k = 0; k < W * H - 1; k++)
        if (scene[k] > 1) {
            assert_int_equal(m.quality[k + 1], BRACKET_GOOD);
            *over_bound += (double)m.variance[k + 1] * c.electrons_at_white * (1 + .25 + .0625 + .015625) / .1;
            *mean += (double)m.radiance[k + 1] / .1;
            count++;
        }
    *over_bound /= count, *mean /= count;
    for (int i = 0; i < 4; i++)
        free(f[i].site);
    merged_free(&m);
    free(scene);
}

static void what_lies_beside_lamps_counts_in_full_on_a_sensor_that_does_not_bloom(void **state)
{
    (void)state;
    double over_bound, mean;
    beside_lamps(0, &over_bound, &mean);
    assert_true(over_bound < 1.05 && fabs(mean - 1) < .005);
    beside_lamps(150, &over_bound, &mean); // a tenth of what is there
    assert_true(over_bound > 3 && fabs(mean - 1) < .01);
}

// Green saturates first: red and blue beside it still count, or coloured sensors would lose their best frame over half a stop.
static void a_site_beside_one_that_is_just_saturated_counts(void **state)
{
    (void)state;
    const struct sim_camera c = camera_of(2);
    float *scene = levels(.7, .7);
    for (int i = 0; i < W * H; i++)
        if (((i / W) & 1) + (i % W & 1) == 1)
            scene[i] = 1.4f;
    struct merged m;
    merge(&m, scene, &c, 2, 5, NULL, NULL, NULL);
    double said = 0;
    for (int i = 0; i < W * H; i++) {
        assert_int_equal(m.quality[i], BRACKET_GOOD);
        if (((i / W) & 1) + (i % W & 1) != 1)
            said += (double)m.variance[i] / (W * H / 2);
    }
    assert_float_equal(said * c.electrons_at_white * 1.25 / .7, 1, .01); // both frames: the Poisson bound
    merged_free(&m);
    free(scene);
}

static void a_stuck_site_is_no_light(void **state)
{
    (void)state;
    const struct sim_camera c = camera_of(4);
    const struct bracket_options options = options_of(&c);
    float *scene = levels(.1, .1);
    struct bracket *b = NULL;
    struct bracket_frame_report r;
    struct bracket_statistics s;
    struct merged m;
    int64_t n[2];
    for (int i = 0; i < 3; i++) {
        struct raw_frame f;
        assert_int_equal(sim_expose(&f, scene, &c, pow(.25, i), 1, (uint64_t)i), 0);
        f.site[33 * W + 77] = 16383;
        if (!b)
            assert_int_equal(bracket_new(&b, &f, &options), 0);
        assert_int_equal(bracket_add(b, &f, NULL, &r), 0);
        assert_int_equal(bracket_measure(&s, &f, NULL), 0);
        assert_true(s.n_over[0] + s.n_over[1] + s.n_over[2] == 0);
        free(f.site);
    }
    assert_int_equal(bracket_finish(&m, b, n, n + 1), 0);
    assert_true(n[0] == 0 && n[1] == 1);
    assert_int_equal(m.quality[33 * W + 77], BRACKET_DEFECT);
    assert_true(fabs((double)m.radiance[33 * W + 77] - .1) < .01);
    merged_free(&m);
    free(scene);
}

// ---- frames that do not belong ------------------------------------------------------------------------------------------------

static void frames_that_do_not_belong_are_named_and_left_out(void **state)
{
    (void)state;
    const struct sim_camera c = camera_of(4);
    const struct bracket_options options = options_of(&c);
    float *scene = levels(.05, .5);
    struct raw_frame first, f;
    struct bracket *b;
    struct bracket_frame_report r;
    struct merged m;
    int64_t n[2];
    assert_int_equal(sim_expose(&first, scene, &c, 1, 1, 0), 0);
    assert_int_equal(sim_expose(&f, scene, &c, .25, 1, 1), 0);
    assert_int_equal(bracket_new(&b, &first, &options), 0);
    assert_int_equal(bracket_add(b, &first, NULL, &r), 0);
    assert_int_equal(r.fault, BRACKET_FITS);
    struct raw_frame bad[8];
    const enum bracket_fault expected[8] = { BRACKET_OTHER_CAMERA, BRACKET_OTHER_CAMERA, BRACKET_OTHER_ISO, BRACKET_OTHER_APERTURE, BRACKET_OTHER_LEVELS,
                                             BRACKET_OTHER_LEVELS, BRACKET_OTHER_FILTERS, BRACKET_NO_TIME };
    for (int i = 0; i < 8; i++)
        bad[i] = f;
    strcpy(bad[0].serial, "2");
    strcpy(bad[1].model, "Other");
    bad[2].iso = 200;
    bad[3].f_number = 1.4;
    bad[4].white = 15300;
    bad[5].black[1][0] = 500;
    bad[6].cfa[0][0] = 2, bad[6].cfa[1][1] = 0;
    bad[7].exposure_s = 0;
    for (int i = 0; i < 8; i++) {
        assert_int_equal(bracket_add(b, bad + i, NULL, &r), 0);
        assert_int_equal(r.fault, expected[i]);
    }
    // The file says nothing, the light does: stopped down by one, with an old lens that reports no aperture.
    free(f.site);
    assert_int_equal(sim_expose(&f, scene, &c, .25, .5, 2), 0);
    assert_int_equal(bracket_add(b, &f, NULL, &r), 0);
    assert_int_equal(r.fault, BRACKET_OTHER_BRIGHTNESS);
    assert_float_equal(r.gain, .5, .01);
    // Exchanged: a frame of 1/16 s that is said to be of 1/4 s.
    free(f.site);
    assert_int_equal(sim_expose(&f, scene, &c, 1. / 16, 1, 3), 0);
    f.exposure_s = .25;
    assert_int_equal(bracket_add(b, &f, NULL, &r), 0);
    assert_int_equal(r.fault, BRACKET_OTHER_BRIGHTNESS);
    assert_float_equal(r.gain, .25, .01);
    free(f.site);
    assert_int_equal(sim_expose(&f, scene, &c, .25, 1, 4), 0);
    assert_int_equal(bracket_add(b, &f, NULL, &r), 0);
    assert_int_equal(r.fault, BRACKET_FITS);
    assert_int_equal(bracket_finish(&m, b, n, n + 1), 0);
    double sum = 0;
    for (int i = 0; i < W * H; i++)
        sum += (double)m.radiance[i] / (double)scene[i];
    assert_float_equal(sum / (W * H), 1, 1e-3);
    merged_free(&m);
    free(first.site);
    free(f.site);
    free(scene);
}

static void flicker_shows_as_gain_and_movement_as_a_patch(void **state)
{
    (void)state;
    const struct sim_camera c = camera_of(4);
    const struct bracket_options options = options_of(&c);
    float *scene = levels(.1, .8), *moved = levels(.1, .8);
    for (int y = 64; y < 96; y++)
        for (int x = 32; x < 80; x++)
            moved[y * W + x] *= 1.3f;
    struct raw_frame f[5];
    struct bracket *b;
    struct bracket_frame_report r[5];
    struct merged m;
    int64_t n[2];
    assert_int_equal(sim_expose(f, scene, &c, 1, 1, 0), 0);
    assert_int_equal(sim_expose(f + 1, scene, &c, .25, 1.02, 1), 0); // 2 % brighter
    assert_int_equal(sim_expose(f + 2, moved, &c, 1. / 16, 1, 2), 0);
    assert_int_equal(sim_expose(f + 3, scene, &c, 1. / 64, 1, 3), 0);
    assert_int_equal(sim_expose(f + 4, scene, &c, 1. / 64, .98, 4), 0); // a repeat, 2 % darker
    assert_int_equal(bracket_new(&b, f, &options), 0);
    for (int i = 0; i < 5; i++) {
        assert_int_equal(bracket_add(b, f + i, i < 4 ? f + i + 1 : NULL, r + i), 0);
        assert_int_equal(r[i].fault, BRACKET_FITS);
    }
    for (int i = 0; i < 5; i++)
        free(f[i].site);
    assert_int_equal(bracket_finish(&m, b, n, n + 1), 0);
    assert_true(isinf(r[0].gain_error) && r[0].n_blocks == 0);
    assert_float_equal(r[1].gain, 1.02, 1e-3);
    assert_true(r[1].gain_error < 1e-3 && r[1].n_changed == 0 && fabs(r[1].chi2 - 1) < .05);
    assert_true(r[2].largest_change == 6 && r[2].n_changed == 6); // 3 x 2 blocks
    assert_float_equal(r[2].changed_at_px[0], 56, 1e-9);
    assert_float_equal(r[2].changed_at_px[1], 80, 1e-9);
    assert_float_equal(r[2].change, 1.3, .03);
    assert_true(!r[3].is_repeat && r[4].is_repeat);
    assert_float_equal(r[4].gain / r[3].gain, .98, 4e-3);
    merged_free(&m);
    free(scene);
    free(moved);
}

// ---- the sensor -------------------------------------------------------------------------------------------------------------------

static void the_sensor_is_measured_from_two_frames(void **state)
{
    (void)state;
    const double truth[3][2] = { { 60000, 4 }, { 15000, 9 }, { 90000, 0 } };
    for (int k = 0; k < 3; k++) {
        struct sim_camera c = camera_of(truth[k][1]);
        c.electrons_at_white = truth[k][0];
        c.seed = 77;
        float *scene = levels(.0005, .9);
        struct raw_frame a, b;
        struct sensor_noise noise;
        assert_int_equal(sim_expose(&a, scene, &c, 1, 1, 0), 0);
        for (int y = 20; y < 60; y++) // a tenth of the frame moves
            for (int x = 60; x < 120; x++)
                scene[y * W + x] *= 1.5f;
        assert_int_equal(sim_expose(&b, scene, &c, .25, 1, 1), 0);
        assert_int_equal(sensor_noise_measure(&noise, &a, &b), 0);
        const double dn_e = c.electrons_at_white / (c.white - c.black), read = sqrt(truth[k][1] * truth[k][1] + dn_e * dn_e / 12);
        if (getenv("VERBOSE"))
            fprintf(stderr, "sensor: %.0f electrons (%.0f), read noise %.2f e (%.2f)\n", noise.electrons_at_white, truth[k][0], noise.read_noise_e, read);
        assert_float_equal(noise.electrons_at_white / truth[k][0], 1, .08);
        assert_true(fabs(noise.read_noise_e - read) < 1 + .15 * read);
        free(a.site);
        free(b.site);
        free(scene);
    }
    // Two frames of the dark tell nothing.
    const struct sim_camera c = camera_of(4);
    float *dark = levels(1e-6, 1e-6);
    struct raw_frame a, b;
    struct sensor_noise noise;
    assert_int_equal(sim_expose(&a, dark, &c, 1, 1, 0), 0);
    assert_int_equal(sim_expose(&b, dark, &c, .25, 1, 1), 0);
    assert_int_equal(sensor_noise_measure(&noise, &a, &b), -ENODATA);
    free(a.site);
    free(b.site);
    free(dark);
}

static void a_sensor_that_clips_below_its_white_level_is_found_out(void **state)
{
    (void)state;
    struct sim_camera c = camera_of(4);
    c.clip = 15000;
    float *scene = levels(.1, 3);
    struct raw_frame f;
    struct bracket *b;
    struct bracket_frame_report r;
    struct bracket_statistics s;
    struct merged m;
    int64_t n[2];
    const struct bracket_options options = options_of(&c);
    assert_int_equal(sim_expose(&f, scene, &c, 1, 1, 0), 0);
    assert_int_equal(bracket_measure(&s, &f, NULL), 0);
    assert_int_equal(s.plateau_dn, 15000);
    assert_int_equal(bracket_new(&b, &f, &options), 0);
    assert_int_equal(bracket_add(b, &f, NULL, &r), 0);
    assert_int_equal(r.plateau_dn, 15000);
    assert_int_equal(bracket_finish(&m, b, n, n + 1), 0);
    for (int x = 0; x < W; x++)
        if ((double)scene[x] > 1) // would pass for .91 of white
            assert_int_equal(m.quality[x], BRACKET_CLIPPED);
    merged_free(&m);
    free(f.site);
    free(scene);
}

static void wells_that_are_full_before_white_are_found_out(void **state)
{
    (void)state;
    struct sim_camera c = camera_of(4);
    c.clip = 15600, c.clip_spread = 35; // above .9, below .98 of white: passed for light once
    float *scene = levels(.02, 30);
    const struct bracket_options options = options_of(&c);
    for (int with_shorter = 0; with_shorter < 2; with_shorter++) {
        struct raw_frame f[2];
        struct bracket *b;
        struct bracket_frame_report r;
        struct merged m;
        int64_t n_clipped, n_defects;
        assert_int_equal(sim_expose(&f[0], scene, &c, 1, 1, 0), 0);
        assert_int_equal(sim_expose(&f[1], scene, &c, 1. / 64, 1, 1), 0);
        assert_int_equal(bracket_new(&b, &f[0], &options), 0);
        assert_int_equal(bracket_add(b, &f[0], with_shorter ? &f[1] : NULL, &r), 0);
        assert_true(r.plateau_dn > 15600 - 6 * 35 && r.plateau_dn < 15600);
        if (with_shorter)
            assert_int_equal(bracket_add(b, &f[1], NULL, &r), 0);
        assert_int_equal(bracket_finish(&m, b, &n_clipped, &n_defects), 0);
        double sum = 0, expected = 0;
        for (int i = 0; i < W * H; i++) {
            const double light = (double)scene[i];
            if (light < 1.1)
                continue;
            assert_int_equal(m.quality[i] == BRACKET_CLIPPED, !with_shorter);
            sum += (double)m.radiance[i], expected += light;
        }
        if (with_shorter)
            assert_true(fabs(sum / expected - 1) < .005);
        merged_free(&m);
        free(f[0].site);
        free(f[1].site);
    }
    free(scene);
}

// ---- the planner ------------------------------------------------------------------------------------------------------------------

static int follow(const struct bracket_plan *plan, const float *scene, const struct sim_camera *c, double *times, int most, struct bracket_next *next)
{
    struct bracket_statistics s[32];
    int n = 0;
    for (;;) {
        struct raw_frame f;
        assert_int_equal(bracket_next(next, plan, s, n), 0);
        assert_true(next->why[0]);
        if (next->is_done)
            return n;
        assert_true(n < most);
        assert_int_equal(sim_expose(&f, scene, c, next->exposure_s, 1, (uint64_t)n), 0);
        assert_int_equal(bracket_measure(s + n, &f, NULL), 0);
        times[n++] = next->exposure_s;
        free(f.site);
    }
}

static void the_planner_stops_when_no_light_clips_and_the_dark_is_seen(void **state)
{
    (void)state;
    const struct sim_camera c = camera_of(4);
    float *scene = levels(.02, .2);
    for (int y = 50; y < 54; y++)
        for (int x = 100; x < 104; x++)
            scene[y * W + x] = 60; // a lamp of 16 sites
    struct bracket_plan plan = { .metered_s = 1, .shortest_s = 1. / 8192, .longest_s = 32, .repeat_shortest = true,
                                 .noise = { c.electrons_at_white, c.read_noise_e } };
    struct bracket_next next;
    double t[32];
    // 60 x h <= .9: h <= 1/67: 1, 1/4, 1/16, 1/64 (clips), 1/256. The dark: .02 x 60000 electrons at 1 s: SNR 34.
    assert_int_equal(follow(&plan, scene, &c, t, 32, &next), 6);
    assert_true(t[4] == 1. / 256 && t[5] == t[4] && !next.needs_nd && !next.too_dark);
    // A shutter that ends at 1/64 s cannot: a filter is asked for.
    plan.shortest_s = 1. / 64;
    assert_int_equal(follow(&plan, scene, &c, t, 32, &next), 5);
    assert_true(next.needs_nd && next.nd_ev_at_least >= 1 && t[3] == 1. / 64 && t[4] == t[3]);
    // Metered short: longer ones follow until the darkest percent has SNR 10 (about 110 electrons of 1200 per second).
    plan.shortest_s = 1. / 8192;
    plan.metered_s = 1. / 256;
    plan.repeat_shortest = false;
    assert_int_equal(follow(&plan, scene, &c, t, 32, &next), 4); // 1/256, 1/64, 1/16 (75 electrons), 1/4
    assert_true(t[3] == .25);
    assert_false(next.too_dark);
    plan.longest_s = 1. / 32;
    follow(&plan, scene, &c, t, 32, &next);
    assert_true(next.too_dark && !next.needs_nd);
    plan.max_frames = 2, plan.longest_s = 32, plan.metered_s = 1;
    assert_int_equal(follow(&plan, scene, &c, t, 32, &next), 2);
    assert_true(next.needs_nd);
    plan.shortest_s = 0;
    assert_int_equal(bracket_next(&next, &plan, NULL, 0), -EINVAL);
    free(scene);
}

static void what_the_lens_does_not_see_does_not_count(void **state)
{
    (void)state;
    struct sim_camera c = camera_of(4);
    float *scene = levels(.2, .2);
    c.lens.circle_px = 50;
    assert_int_equal(lens_init(&c.lens, "test"), 0);
    for (int i = 0; i < W * H; i++)
        if (hypot(i % W + .5 - W / 2, i / W + .5 - H / 2) > 50)
            scene[i] = 0;
    struct raw_frame f;
    struct bracket_statistics s;
    assert_int_equal(sim_expose(&f, scene, &c, 1, 1, 0), 0);
    assert_int_equal(bracket_measure(&s, &f, NULL), 0);
    assert_true(s.first_percentile[1] < .01);
    assert_int_equal(bracket_measure(&s, &f, &c.lens), 0);
    for (int k = 0; k < 3; k++) {
        assert_float_equal(s.first_percentile[k], .2, .01);
        assert_float_equal(s.median[k], .2, .002);
    }
    assert_true(s.n_sites[1] > 3800 && s.n_sites[1] < 4000); // half of pi 50^2
    free(f.site);
    free(scene);
}

// A file or a plan may say anything; what cannot be is as if it said nothing. No sum becomes infinite or none.
static void an_exposure_that_cannot_be_is_none(void **state)
{
    (void)state;
    static const struct { double time_s, f_number, iso; } wrong[] = {
        { 1e-10, 999, 1e-30 }, { 1e-300, 1, 100 }, { 1e300, 8, 100 }, { INFINITY, 8, 100 }, { NAN, 8, 100 }, { 1, 1e-12, 100 }, { 1, INFINITY, 100 }, { 1, 8, INFINITY },
    };
    for (size_t k = 0; k < sizeof(wrong) / sizeof(wrong[0]); k++) {
        struct raw_frame f = { .exposure_s = wrong[k].time_s, .f_number = wrong[k].f_number, .iso = wrong[k].iso };
        if (bracket_exposure(&f) != 0)
            fail_msg("%g s, f/%g, ISO %g: %g", wrong[k].time_s, wrong[k].f_number, wrong[k].iso, bracket_exposure(&f));
    }
    struct raw_frame f = { .exposure_s = exp2(-15) * exp2(-20), .f_number = 64, .iso = 50 }; // the shortest, through a filter for the sun
    assert_true(bracket_exposure(&f) > 0);
    f = (struct raw_frame){ .exposure_s = 3600, .f_number = .95, .iso = 409600 };
    assert_true(bracket_exposure(&f) > 0);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(the_merge_has_no_bias_and_reaches_the_poisson_bound),
        cmocka_unit_test(without_read_noise_it_is_the_sum_of_signals_over_the_sum_of_exposures),
        cmocka_unit_test(a_light_that_clips_in_every_frame_is_marked_with_a_lower_bound),
        cmocka_unit_test(light_that_bloomed_over_does_not_count_while_a_clean_frame_is_there),
        cmocka_unit_test(what_lies_beside_lamps_counts_in_full_on_a_sensor_that_does_not_bloom),
        cmocka_unit_test(a_site_beside_one_that_is_just_saturated_counts),
        cmocka_unit_test(a_stuck_site_is_no_light),
        cmocka_unit_test(frames_that_do_not_belong_are_named_and_left_out),
        cmocka_unit_test(flicker_shows_as_gain_and_movement_as_a_patch),
        cmocka_unit_test(the_sensor_is_measured_from_two_frames),
        cmocka_unit_test(a_sensor_that_clips_below_its_white_level_is_found_out),
        cmocka_unit_test(wells_that_are_full_before_white_are_found_out),
        cmocka_unit_test(the_planner_stops_when_no_light_clips_and_the_dark_is_seen),
        cmocka_unit_test(what_the_lens_does_not_see_does_not_count),
        cmocka_unit_test(an_exposure_that_cannot_be_is_none),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
