// tests/test_judge.c - the judge of solves says by how much a solve is wrong: hand-made solves,
// wrong by known amounts.
#include "solver/synth.h"
#include "tests/judgement.h"

#include <ftw.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/stat.h>
#include <cmocka.h>

static char test_dir[256], take[300], solve[300];

struct known { // the take's truth, and what a test makes of it
    struct lights lights;
    struct json *report;
    struct image albedo;
    double centre_m[3], world_from_probe[9];
};

static int remove_one(const char *path, const struct stat *st, int kind, struct FTW *at)
{
    (void)st, (void)kind, (void)at;
    return remove(path);
}

static int make_take(void **state)
{
    (void)state;
    const char *tmp = getenv("TMPDIR");
    struct synth_settings s = synth_defaults(3);
    s.n_true_lights = 2048, s.panorama_width_px = 512, s.texture_size = 64;
    s.width_px = s.height_px = 16, s.samples = 1, s.n_views = 5;
    log_set_level(LOG_ERROR);
    snprintf(test_dir, sizeof(test_dir), "%s/studiorig-test-XXXXXX", tmp ? tmp : "/tmp");
    if (!mkdtemp(test_dir))
        return -1;
    snprintf(take, sizeof(take), "%s/take", test_dir);
    snprintf(solve, sizeof(solve), "%s/solve", test_dir);
    return synth_write(&s, take);
}

static int remove_take(void **state)
{
    (void)state;
    return nftw(test_dir, remove_one, 16, FTW_DEPTH | FTW_PHYS);
}

static const char *path_in(const char *dir, const char *name)
{
    static char path[PATH_MAX];
    assert_int_equal(judge_path(path, dir, name), 0);
    return path;
}

static void open_known(struct known *k)
{
    assert_int_equal(lights_read_json(&k->lights, path_in(take, "truth/lights.json")), 0);
    assert_int_equal(image_read(&k->albedo, path_in(take, "truth/albedo.exr")), 0);
    memcpy(k->centre_m, k->lights.centre_m, sizeof(k->centre_m));
    memcpy(k->world_from_probe, k->lights.world_from_probe, sizeof(k->world_from_probe));
    k->report = json_object();
    json_set_string(k->report, "method", "test");
}

static struct judgement judge_known(struct known *k)
{
    struct judgement j;
    mkdir(solve, 0777);
    assert_int_equal(lights_write_json(&k->lights, path_in(solve, "lights.json")), 0);
    assert_int_equal(json_write(k->report, path_in(solve, "report.json")), 0);
    assert_int_equal(
        image_write_exr(&k->albedo, path_in(solve, "albedo.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    assert_int_equal(judge_solve(&j, solve, take), 0);
    lights_free(&k->lights), image_free(&k->albedo), json_free(k->report);
    nftw(solve, remove_one, 16, FTW_DEPTH | FTW_PHYS);
    return j;
}

static void near(double found, double expected, double tolerance)
{
    if (!(fabs(found - expected) <= tolerance))
        fail_msg("found %.12g, expected %.12g +- %g", found, expected, tolerance);
}

// Along +z: a panel 1 x 2 m at 2 m, a larger one behind it at 3 m, the back of a small one at 4 m.
static void first_panel_that_the_ray_meets_counts(void **state)
{
    (void)state;
    const struct judge_truth t = {
        .world_from_probe = {1, 0, 0, 0, 1, 0, 0, 0, 1},
        .n_panels = 3,
        .panel = {{{-.5, -1, 2}, {{0, 2, 0}, {1, 0, 0}}, {0, 0, -1}},
                  {{-3, -3, 3}, {{0, 3, 0}, {6, 0, 0}}, {0, 0, -1}},
                  {{-3, 0, 4}, {{6, 0, 0}, {0, 3, 0}}, {0, 0, 1}}},
    };
    const struct {
        double through[3], z; // the height at which it ends; 0: nothing shines there
    } ray[] = {
        {{0, 0, 2}, 2},     {{.49, .99, 2}, 2}, {{-.51, -1.01, 2}, 3},
        {{0, -1.01, 2}, 3}, {{.51, .5, 2}, 0},  {{2.99, -2.99, 3}, 3},
        {{3.01, -1, 3}, 0}, {{0, 0, -2}, 0},    {{1, 0, 0}, 0},
    };
    for (size_t i = 0; i < sizeof(ray) / sizeof(ray[0]); i++) {
        double dir[3] = {ray[i].through[0], ray[i].through[1], ray[i].through[2]};
        vec3_normalise(dir);
        near(judge_true_inverse_distance(&t, dir), ray[i].z > 0 ? dir[2] / ray[i].z : 0, 1e-12);
    }
}

static void truth_itself_has_no_error(void **state)
{
    (void)state;
    struct judgement j;
    char truth[400];
    snprintf(truth, sizeof(truth), "%s/truth", take);
    assert_int_equal(judge_solve(&j, truth, take), 0);
    assert_string_equal(j.method, "truth");
    assert_int_equal(j.trusted, 1);
    assert_int_equal(j.n_lights, 2048);
    assert_int_equal(j.n_off_panels, 0);
    near(j.distance_percent, 0, 1e-9);
    near(j.distance_weighted_percent, 0, 1e-9);
    near(j.position_cm, 0, 1e-9);
    near(j.centre_cm, 0, 1e-9);
    near(j.rotation_deg, 0, 1e-9);
    for (int k = 0; k < DISNEY_N; k++)
        near(j.theta_error[k], 0, 0);
    assert_true(j.theta_uniform);
    near(j.albedo_percent, 0, 1e-9);
    assert_true(j.n_texels > 0 && j.n_texels == j.n_covered_texels);
}

static void distances_ten_percent_long(void **state)
{
    (void)state;
    struct known k;
    double mean_m = 0;
    open_known(&k);
    for (int i = 0; i < k.lights.n; i++) {
        mean_m += 1 / k.lights.inverse_distance[i] / k.lights.n;
        k.lights.inverse_distance[i] /= 1.1;
    }
    const struct judgement j = judge_known(&k);
    near(j.distance_percent, 10, 1e-9);
    near(j.distance_median_percent, 10, 1e-9);
    near(j.distance_weighted_percent, 10, 1e-9);
    near(j.distance_weighted_median_percent, 10, 1e-9);
    near(j.position_cm, 10 * mean_m, 1e-9);
    near(j.centre_cm, 0, 1e-9);
    near(j.rotation_deg, 0, 1e-9);
}

static void one_light_twice_as_far_weighs_its_share(void **state)
{
    (void)state;
    struct known k;
    int brightest = 0;
    double most = 0, sum = 0;
    open_known(&k);
    const int n = k.lights.n;
    for (int i = 0; i < n; i++) {
        const double weight = judge_light_luminance(&k.lights, i);
        sum += weight;
        if (weight > most)
            most = weight, brightest = i;
    }
    k.lights.inverse_distance[brightest] /= 2;
    const struct judgement j = judge_known(&k);
    near(j.distance_percent, 100. / n, 1e-9);
    near(j.distance_weighted_percent, 100 * most / sum, 1e-9);
    assert_true(most / sum > 2. / n);
    near(j.distance_median_percent, 0, 1e-9);
}

static void medians_of_many_dim_and_few_bright(void **state)
{
    (void)state;
    struct known k;
    open_known(&k);
    for (int i = 0; i < k.lights.n; i++) { // true groups: panels 0..3, walls -1
        const bool panel = k.lights.group[i] >= 0;
        k.lights.inverse_distance[i] /= panel ? 1.2 : 1.1;
    }
    const struct judgement j = judge_known(&k);
    near(j.distance_median_percent, 10, 1e-9);          // 91 % of the lights
    near(j.distance_weighted_median_percent, 20, 1e-9); // most of the light
}

static void centre_three_centimetres_off(void **state)
{
    (void)state;
    struct known k;
    open_known(&k);
    k.lights.centre_m[0] += .01, k.lights.centre_m[1] -= .02, k.lights.centre_m[2] += .02;
    const struct judgement j = judge_known(&k);
    near(j.centre_cm, 3, 1e-9);
    near(j.position_cm, 3, 1e-9);
    near(j.position_weighted_cm, 3, 1e-9);
    near(j.distance_percent, 0, 1e-9);
    near(j.rotation_deg, 0, 1e-9);
}

static void two_degrees_turned(void **state)
{
    (void)state;
    struct known k;
    const double w = 2 * M_PI / 180 / 3, axis[3] = {w, 2 * w, -2 * w};
    double turn[9], mean_m = 0;
    open_known(&k);
    mat3_from_rotation_vector(turn, axis);
    mat3_mul(k.lights.world_from_probe, turn, k.world_from_probe);
    for (int i = 0; i < k.lights.n; i++) {
        double here[3], there[3];
        mat3_mul_vec(here, k.lights.world_from_probe, k.lights.dir_probe[i]);
        mat3_mul_vec(there, k.world_from_probe, k.lights.dir_probe[i]);
        vec3_sub(here, here, there);
        mean_m += vec3_norm(here) / k.lights.inverse_distance[i] / k.lights.n;
    }
    const struct judgement j = judge_known(&k);
    near(j.rotation_deg, 2, 1e-9);
    near(j.distance_percent, 0, 1e-9); // true distances are along the true rays
    near(j.centre_cm, 0, 1e-9);
    near(j.position_cm, 100 * mean_m, 1e-9);
}

static void directional_lights_are_infinitely_wrong(void **state)
{
    (void)state;
    struct known k;
    open_known(&k);
    for (int i = 0; i < k.lights.n; i++)
        k.lights.inverse_distance[i] = 0;
    const struct judgement j = judge_known(&k);
    assert_int_equal(j.n_directional, 2048);
    assert_true(isinf(j.distance_percent) && isinf(j.distance_median_percent));
    assert_true(isinf(j.position_cm));
    assert_true(isnan(j.centre_cm));
    near(j.rotation_deg, 0, 1e-9);
}

// What judgement.h promises of regions, from the true lights that the judge does not look at.
static void region_is_as_far_as_its_true_lights(void **state)
{
    (void)state;
    struct known k;
    struct panorama p;
    struct lights cut;
    enum { N = 32 };
    double energy[N] = {0}, sum[N] = {0};
    open_known(&k);
    assert_int_equal(panorama_read(&p, path_in(take, "panorama.exr")), 0);
    assert_int_equal(lights_median_cut(&cut, &p, N), 0);
    for (int i = 0; i < k.lights.n; i++) {
        const double weight = judge_light_luminance(&k.lights, i);
        double x_px, y_px;
        panorama_pixel(512, 256, k.lights.dir_probe[i], &x_px, &y_px);
        for (int m = 0; m < N; m++)
            if (x_px > cut.region[m].x0 && x_px < cut.region[m].x1 && y_px > cut.region[m].y0 &&
                y_px < cut.region[m].y1)
                energy[m] += weight, sum[m] += weight * k.lights.inverse_distance[i];
    }
    memcpy(cut.centre_m, k.centre_m, sizeof(cut.centre_m));
    memcpy(cut.world_from_probe, k.world_from_probe, sizeof(cut.world_from_probe));
    for (int m = 0; m < N; m++) {
        assert_true(energy[m] > 0);
        cut.inverse_distance[m] = sum[m] / energy[m] / 1.25;
    }
    lights_free(&k.lights);
    k.lights = cut;
    const struct judgement by_region = judge_known(&k);
    near(by_region.distance_percent, 25, 1e-5); // panorama pixels are floats
    near(by_region.distance_median_percent, 25, 1e-5);

    // Without regions a light is as far as the wall where its own ray ends: not the same.
    open_known(&k);
    lights_free(&k.lights);
    assert_int_equal(lights_median_cut(&cut, &p, N), 0);
    memcpy(cut.centre_m, k.centre_m, sizeof(cut.centre_m));
    memcpy(cut.world_from_probe, k.world_from_probe, sizeof(cut.world_from_probe));
    for (int m = 0; m < N; m++)
        cut.inverse_distance[m] = sum[m] / energy[m];
    free(cut.region), cut.region = NULL;
    k.lights = cut;
    const double own = judge_known(&k).distance_percent;
    assert_true(own > 1e-3 && own < 25);
    panorama_free(&p);
}

// Four sub-lights of one distance against the light that they were cut from.
static void sub_lights_are_judged_as_one(void **state)
{
    (void)state;
    struct known k;
    struct panorama p;
    struct lights cut;
    struct judgement j[2];
    enum { N = 32 };
    assert_int_equal(panorama_read(&p, path_in(take, "panorama.exr")), 0);
    for (int split = 0; split < 2; split++) {
        const int n_sub = split ? 4 : 1;
        open_known(&k);
        assert_int_equal(lights_median_cut(&cut, &p, N * n_sub), 0);
        memcpy(cut.centre_m, k.centre_m, sizeof(cut.centre_m));
        memcpy(cut.world_from_probe, k.world_from_probe, sizeof(cut.world_from_probe));
        for (int i = 0; i < cut.n; i++)
            cut.inverse_distance[i] = 1 / (1 + .02 * (i / n_sub)), cut.group[i] = i / n_sub;
        json_set_int(k.report, "n_sub_lights", n_sub);
        lights_free(&k.lights);
        k.lights = cut;
        j[split] = judge_known(&k);
    }
    assert_int_equal(j[0].n_lights, N);
    assert_int_equal(j[1].n_lights, N);
    near(j[1].distance_percent, j[0].distance_percent, 1e-9);
    near(j[1].distance_median_percent, j[0].distance_median_percent, 1e-9);
    near(j[1].distance_weighted_percent, j[0].distance_weighted_percent, 1e-6);
    assert_true(j[0].distance_percent > 1);
    near(j[1].position_cm, j[0].position_cm, .01 * j[0].position_cm); // mean of unit vectors
    panorama_free(&p);
}

static void theta_is_judged_in_its_own_deviations(void **state)
{
    (void)state;
    static const double wrong[DISNEY_N] = {.25, .2, .5, .6, .9, 0, .3, .4, .2, .95};
    struct known k;
    struct json *theta = json_object(), *std = json_object();
    open_known(&k);
    for (int i = 0; i < DISNEY_N; i++) {
        json_set_number(theta, disney_parameter_names[i], wrong[i]);
        json_set_number(std, disney_parameter_names[i], i == DISNEY_METALLIC ? .025 : .5);
    }
    json_set(k.report, "theta", theta);
    json_set(k.report, "theta_std", std);
    const struct judgement j = judge_known(&k);
    for (int i = 0; i < DISNEY_N; i++)
        near(j.theta_error[i],
             i == DISNEY_METALLIC          ? .05
             : i == DISNEY_CLEARCOAT_GLOSS ? .75
                                           : 0,
             1e-7); // the truth is in floats
    near(j.theta_error[DISNEY_METALLIC] / j.theta_std[DISNEY_METALLIC], 2, 1e-5);
}

static void albedo_too_bright_by_a_tenth(void **state)
{
    (void)state;
    struct known k;
    open_known(&k);
    for (int i = 0; i < 3 * 64 * 64; i++)
        k.albedo.data[i] *= 1.1f;
    const struct judgement j = judge_known(&k);
    near(j.albedo_percent, 10, 1e-4);
    near(j.albedo_scale, 1 / 1.1, 1e-6);
    near(j.albedo_scaled_percent, 0, 1e-3);
}

static void albedo_counts_only_where_the_solve_calls_it_valid(void **state)
{
    (void)state;
    static const char *const y[] = {"Y"};
    struct known k;
    struct image validity;
    open_known(&k);
    assert_int_equal(image_new(&validity, 64, 64, 1, y), 0);
    for (int i = 0; i < 64 * 64; i++) {
        validity.data[i] = i % 64 < 32;
        for (int c = 0; c < 3; c++)
            k.albedo.data[3 * i + c] *= i % 64 < 32 ? 1 : 7;
    }
    mkdir(solve, 0777);
    assert_int_equal(
        image_write_exr(&validity, path_in(solve, "validity.exr"), IMAGE_HALF, IMAGE_ZIP), 0);
    image_free(&validity);
    const struct judgement j = judge_known(&k);
    near(j.albedo_percent, 0, 1e-9);
    assert_true(j.n_texels > 0 && j.n_texels < j.n_covered_texels);
}

// The same albedo at a quarter of the resolution, each texel the mean of sixteen.
static void albedo_of_a_coarser_solve_is_judged_by_means(void **state)
{
    (void)state;
    struct known k;
    struct image coarse;
    open_known(&k);
    assert_int_equal(image_new(&coarse, 16, 16, 3, NULL), 0);
    for (int i = 0; i < 3 * 64 * 64; i++) {
        const int x = i / 3 % 64 / 4, y = i / 3 / 64 / 4;
        coarse.data[3 * (16 * y + x) + i % 3] += k.albedo.data[i] / 16;
    }
    image_free(&k.albedo);
    k.albedo = coarse;
    near(judge_known(&k).albedo_percent, 0, 1e-4);
}

static void path_traced_studio_panels_and_what_lies_beside_them(void **state)
{
    (void)state;
    static const char studio[] = "../shared/data/studio-pebble";
    char path[PATH_MAX];
    struct judge_truth t;
    struct json *doc;
    struct judgement j;
    if (!judge_has(path, studio, "truth/lights.json")) {
        fprintf(stderr, "test_judge: no %s: not judged\n", studio);
        return;
    }
    assert_int_equal(judge_read_truth(&t, studio), 0);
    assert_int_equal(json_read(&doc, path), 0);
    const int n = t.n_panels;
    struct lights l;
    assert_int_equal(lights_new(&l, n + 1), 0);
    memcpy(l.centre_m, t.centre_m, sizeof(l.centre_m));
    memcpy(l.world_from_probe, t.world_from_probe, sizeof(l.world_from_probe));
    for (int i = 0; i <= n; i++) { // the middle of each panel, 20 % too near; straight down nothing
        double to[3] = {0, 0, -1};
        char key[64];
        snprintf(key, sizeof(key), "panels.%d.centre", i);
        if (i < n) {
            assert_int_equal(json_get_numbers(doc, key, to, 3), 0);
            vec3_sub(to, to, t.centre_m);
        }
        l.inverse_distance[i] = 1 / (.8 * vec3_normalise(to));
        mat3_tmul_vec(l.dir_probe[i], l.world_from_probe, to);
        l.irradiance[i][0] = l.irradiance[i][1] = l.irradiance[i][2] = 1 + i;
    }
    json_free(doc);
    doc = json_object();
    mkdir(solve, 0777);
    assert_int_equal(lights_write_json(&l, path_in(solve, "lights.json")), 0);
    assert_int_equal(json_write(doc, path_in(solve, "report.json")), 0);
    assert_int_equal(judge_solve(&j, solve, studio), 0);
    assert_int_equal(j.n_lights, n);
    assert_int_equal(j.n_off_panels, 1);
    near(j.distance_percent, 20, 1e-4); // the file's orthonormality
    near(j.distance_median_percent, 20, 1e-4);
    near(j.theta_true[DISNEY_METALLIC], 0, 1e-6);
    assert_true(j.theta_true[DISNEY_ROUGHNESS] > .48 && j.theta_true[DISNEY_ROUGHNESS] < .75);
    near(j.theta_true[DISNEY_SHEEN], 0, 0);
    assert_true(isnan(j.theta_true[DISNEY_CLEARCOAT_GLOSS]));
    assert_false(j.theta_uniform);
    json_free(doc), lights_free(&l);
    nftw(solve, remove_one, 16, FTW_DEPTH | FTW_PHYS);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(first_panel_that_the_ray_meets_counts),
        cmocka_unit_test(truth_itself_has_no_error),
        cmocka_unit_test(distances_ten_percent_long),
        cmocka_unit_test(one_light_twice_as_far_weighs_its_share),
        cmocka_unit_test(medians_of_many_dim_and_few_bright),
        cmocka_unit_test(centre_three_centimetres_off),
        cmocka_unit_test(two_degrees_turned),
        cmocka_unit_test(directional_lights_are_infinitely_wrong),
        cmocka_unit_test(region_is_as_far_as_its_true_lights),
        cmocka_unit_test(sub_lights_are_judged_as_one),
        cmocka_unit_test(theta_is_judged_in_its_own_deviations),
        cmocka_unit_test(albedo_too_bright_by_a_tenth),
        cmocka_unit_test(albedo_counts_only_where_the_solve_calls_it_valid),
        cmocka_unit_test(albedo_of_a_coarser_solve_is_judged_by_means),
        cmocka_unit_test(path_traced_studio_panels_and_what_lies_beside_them),
    };
    return cmocka_run_group_tests_name("judge", tests, make_take, remove_take);
}
