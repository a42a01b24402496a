// tests/test_joint.c - stage 1 on small synthetic studios: how near each method comes to the truth,
// and when it says that it is not to be trusted.
#include "solver/joint.h"
#include "solver/synth.h"
#include "tests/judgement.h"
#include "tests/scratch.h"

#include <ftw.h>

enum { N_LIGHTS = 64, N_SUB = 4, N_VIEWS = 24, EVERY = 6, TEXTURE = 32 };

struct studio { // a take as `rigsolve solve` loads it
    char take_dir[800];
    struct mesh mesh;
    struct texels texels;
    struct rays *rays;
    struct cameras cameras;
    struct panorama panorama;
    struct lights lights;
    struct samples samples;
    uint8_t held_out[N_VIEWS];
    struct joint_result solved[3]; // by method; made when first asked for
};
static struct studio studios[2]; // D2, D3

static struct studio *studio_of(int data_set)
{
    return &studios[data_set - 2];
}

static int open_studio(int data_set)
{
    struct studio *s = studio_of(data_set);
    struct synth_settings synth = synth_defaults(data_set);
    struct samples_settings gather = samples_defaults();
    struct take *take = NULL;
    const char *picture[N_VIEWS];
    synth.n_true_lights = 4096, synth.panorama_width_px = 512, synth.texture_size = 64;
    synth.width_px = 120, synth.height_px = 80, synth.n_views = N_VIEWS, synth.samples = 1;
    snprintf(s->take_dir, sizeof(s->take_dir), "%s/D%d", scratch_dir, data_set);
    int err = synth_write(&synth, s->take_dir);
    if (!err)
        err = take_open(&take, s->take_dir);
    if (!err)
        err = mesh_read(&s->mesh, NULL, take->mesh_path);
    if (!err)
        err = texels_rasterise(&s->texels, &s->mesh, TEXTURE);
    if (!err)
        err = rays_new(&s->rays, &s->mesh);
    if (!err)
        err = cameras_read(&s->cameras, take->cameras_path);
    if (!err)
        err = panorama_read(&s->panorama, take->panorama_path);
    if (!err)
        err = lights_median_cut(&s->lights, &s->panorama, N_LIGHTS * N_SUB);
    for (int i = 0; !err && i < s->lights.n; i++)
        s->lights.group[i] = i / N_SUB;
    if (!err)
        err = lights_read_pose(&s->lights, &(bool){false}, take->start_path);
    for (int c = 0; !err && c < 3; c++)
        s->lights.centre_m[c] = (s->mesh.bounds_m[0][c] + s->mesh.bounds_m[1][c]) / 2;
    for (int v = 0; !err && v < N_VIEWS; v++) { // both in the order of their names
        err = strcmp(take->view_names[v], s->cameras.view[v].name);
        picture[v] = take->view_paths[v];
        s->held_out[v] = v % EVERY == EVERY - 1;
    }
    if (!err)
        err = samples_gather(&s->samples, &s->texels, s->rays, &s->cameras, picture, &gather);
    take_close(take);
    return err;
}

static int remove_one(const char *path, const struct stat *st, int kind, struct FTW *at)
{
    (void)st, (void)kind, (void)at;
    return remove(path);
}

static int open_studios(void **state)
{
    (void)state;
    log_set_level(LOG_ERROR);
    return scratch_open() || open_studio(2) || open_studio(3);
}

static int close_studios(void **state)
{
    (void)state;
    for (int i = 0; i < 2; i++) {
        struct studio *s = &studios[i];
        for (int m = 0; m < 3; m++)
            joint_result_free(&s->solved[m]);
        samples_free(&s->samples), lights_free(&s->lights), panorama_free(&s->panorama);
        cameras_free(&s->cameras), rays_free(s->rays), texels_free(&s->texels);
        mesh_free(&s->mesh);
    }
    return nftw(scratch_dir, remove_one, 16, FTW_DEPTH | FTW_PHYS);
}

// As `rigsolve solve` sets it: D2's reflectance is known, D3's is not.
static struct joint_settings settings_of(int data_set, enum method method)
{
    struct joint_settings set = joint_defaults(method);
    if (data_set == 2) {
        set.model = REFLECT_LAMBERT, set.albedo = ALBEDO_GIVEN;
        set.given_albedo[0] = set.given_albedo[1] = set.given_albedo[2] = .5;
    } else {
        set.model = REFLECT_DISNEY, set.variant = DISNEY_2017, set.albedo = ALBEDO_FREE;
    }
    return set;
}

static int solve(struct joint_result *out, const struct studio *s, const struct joint_settings *set)
{
    return joint_solve(out, &s->texels, &s->samples, s->rays, &s->lights, s->held_out, set);
}

static const struct joint_result *solved(int data_set, enum method method)
{
    struct studio *s = studio_of(data_set);
    struct joint_result *r = &s->solved[method];
    if (!r->inverse_distance_std) {
        const struct joint_settings set = settings_of(data_set, method);
        assert_int_equal(solve(r, s, &set), 0);
    }
    return r;
}

// Against the truth: centre, rotation, distances and places of the lights.
static struct judgement judge(const struct studio *s, const struct joint_result *r)
{
    struct judgement j;
    struct judge_truth truth;
    double off[3];
    struct lights l = s->lights;
    memcpy(l.centre_m, r->state.lights.centre_m, sizeof(l.centre_m));
    memcpy(l.world_from_probe, r->state.lights.world_from_probe, sizeof(l.world_from_probe));
    l.inverse_distance = r->state.lights.inverse_distance;
    judge_clear(&j);
    assert_int_equal(judge_read_truth(&truth, s->take_dir), 0);
    assert_int_equal(judge_lights(&j, &truth, &s->panorama, &l, N_SUB), 0);
    vec3_sub(off, l.centre_m, truth.centre_m);
    j.centre_cm = 100 * vec3_norm(off);
    j.rotation_deg = judge_angle_between(l.world_from_probe, truth.world_from_probe) * 180 / M_PI;
    return j;
}

static void below(const char *what, double found, double bound)
{
    if (!(found < bound))
        fail_msg("%s is %.6g, expected less than %.6g", what, found, bound);
}

static void assert_same_state(const struct studio *s, const struct photometric_state *a,
                              const struct photometric_state *b)
{
    const struct lights *l = &a->lights, *m = &b->lights;
    assert_memory_equal(a->theta, b->theta, sizeof(a->theta));
    assert_memory_equal(a->shared_albedo, b->shared_albedo, sizeof(a->shared_albedo));
    assert_memory_equal(a->albedo, b->albedo, (size_t)s->texels.n * sizeof(*a->albedo));
    assert_memory_equal(a->log_gain, b->log_gain, N_VIEWS * sizeof(double));
    assert_memory_equal(l->centre_m, m->centre_m, sizeof(l->centre_m));
    assert_memory_equal(l->world_from_probe, m->world_from_probe, sizeof(l->world_from_probe));
    assert_memory_equal(l->inverse_distance, m->inverse_distance, (size_t)l->n * sizeof(double));
}

// ---- near the truth -----------------------------------------------------------------------------
//
// Bounds are twice what the worst of seeds 1 to 4 gave, rounded. What limits the method here is
// that 256 lights stand for 4096, and the texels' size: without noise the standard deviations are
// far smaller. The start is 44 cm off centre and 2 to 10 degrees turned.

static void joint_finds_the_lights_about_a_known_diffuse_object(void **state)
{
    (void)state;
    const struct joint_result *r = solved(2, METHOD_JOINT);
    const struct judgement j = judge(studio_of(2), r);
    below("centre, cm", j.centre_cm, 4);                                  // 1.8
    below("rotation, degrees", j.rotation_deg, 3.5);                      // 1.6
    below("distances, median %", j.distance_weighted_median_percent, 20); // 9.8
    below("RMSE fitted, %", r->rmse_fit_percent, .2);                     // .09
    below("RMSE held out, %", r->rmse_held_out_percent, .2);              // .105
    assert_int_equal(r->doubts, 0);
    assert_int_equal(r->n_fit + r->n_held_out, studio_of(2)->samples.n);
}

static void joint_finds_material_and_lights(void **state)
{
    (void)state;
    const struct studio *s = studio_of(3);
    const struct joint_result *r = solved(3, METHOD_JOINT);
    const struct judgement j = judge(s, r);
    double true_theta[DISNEY_N];
    char path[PATH_MAX];
    bool uniform = true;
    assert_true(judge_has(path, s->take_dir, "truth/brdf.exr"));
    assert_int_equal(
        judge_theta_means(true_theta, &uniform, disney_parameter_names, &s->mesh, path), 0);
    assert_true(uniform);
    below("centre, cm", j.centre_cm, 9);                                  // 4.4
    below("rotation, degrees", j.rotation_deg, 2);                        // 1.0
    below("distances, median %", j.distance_weighted_median_percent, 20); // 9.7
    below("RMSE held out, %", r->rmse_held_out_percent, .36);             // .18
    below("roughness", fabs(r->state.theta[DISNEY_ROUGHNESS] - true_theta[DISNEY_ROUGHNESS]),
          .02); // .009
    below("metallic", fabs(r->state.theta[DISNEY_METALLIC] - true_theta[DISNEY_METALLIC]),
          .03); // .013
    below("subsurface", fabs(r->state.theta[DISNEY_SUBSURFACE] - true_theta[DISNEY_SUBSURFACE]),
          .03); // .014
    assert_int_equal(r->doubts, 0);
}

// Measured: 3 % dark. Lights a little nearer and a darker surface look almost the same.
static void joint_finds_the_one_albedo_of_a_diffuse_object(void **state)
{
    (void)state;
    struct joint_settings set = settings_of(2, METHOD_JOINT);
    struct joint_result r;
    set.albedo = ALBEDO_SHARED;
    assert_int_equal(solve(&r, studio_of(2), &set), 0);
    below("centre, cm", judge(studio_of(2), &r).centre_cm, 4); // 1.8
    for (int c = 0; c < 3; c++)
        below("albedo", fabs(r.state.shared_albedo[c] - .5), .03); // .016
    joint_result_free(&r);
}

// ---- method against method ----------------------------------------------------------------------

// A studio 1 to 2 m away is not at infinity: by 90 on D2, 9 on D3, where the albedo of every texel
// takes up much of the error.
static void joint_leaves_a_fraction_of_the_directional_error(void **state)
{
    (void)state;
    const double diffuse = solved(2, METHOD_DIRECTIONAL)->rmse_held_out_percent;
    const double disney = solved(3, METHOD_DIRECTIONAL)->rmse_held_out_percent;
    below("D2, RMSE held out, %", solved(2, METHOD_JOINT)->rmse_held_out_percent, diffuse / 40);
    below("D3, RMSE held out, %", solved(3, METHOD_JOINT)->rmse_held_out_percent, disney / 4);
}

// The paper's: by 40 on D2. On D3 it does not always come near (on one of four seeds it is worse
// than directional); there, only that it runs to its end, and that joint does at least twice as
// well (measured: 4 to 12 times).
static void alternating_improves_on_directional_and_joint_on_alternating(void **state)
{
    (void)state;
    const struct joint_result *diffuse = solved(2, METHOD_ALTERNATING);
    const struct joint_result *disney = solved(3, METHOD_ALTERNATING);
    const double directional = solved(2, METHOD_DIRECTIONAL)->rmse_held_out_percent;
    below("D2, RMSE held out, %", diffuse->rmse_held_out_percent, directional / 20);
    below("D3, RMSE held out, %", solved(3, METHOD_JOINT)->rmse_held_out_percent,
          disney->rmse_held_out_percent / 2);
    assert_true(disney->n_jacobians > 0 && *disney->stop_reason);
    // The weight of Eq. 11 is what was asked for.
    below("D2, weight", fabs(diffuse->w_sim / 3e-9 - 1), 1e-9);
    below("D3, weight", fabs(disney->w_sim / 3e-9 - 1), 1e-9);
}

// ---- the same again -----------------------------------------------------------------------------

// Every part of it, but few steps: the start is given, the last weight too.
static struct joint_settings all_parts(void)
{
    struct joint_settings set = settings_of(3, METHOD_JOINT);
    set.start_distance_m = 1.5, set.w_sim = 1e-6, set.robust = true, set.gain = true;
    return set;
}

static void thread_count_does_not_change_a_byte(void **state)
{
    (void)state;
    struct {
        int data_set;
        struct joint_settings settings;
    } solves[] = {{3, all_parts()},
                  {2, settings_of(2, METHOD_ALTERNATING)},
                  {3, settings_of(3, METHOD_DIRECTIONAL)}};
    for (size_t i = 0; i < sizeof(solves) / sizeof(solves[0]); i++) {
        const struct studio *s = studio_of(solves[i].data_set);
        struct joint_result one, three;
        solves[i].settings.n_threads = 1;
        assert_int_equal(solve(&one, s, &solves[i].settings), 0);
        solves[i].settings.n_threads = 3;
        assert_int_equal(solve(&three, s, &solves[i].settings), 0);
        assert_same_state(s, &one.state, &three.state);
        assert_memory_equal(one.inverse_distance_std, three.inverse_distance_std,
                            N_LIGHTS * sizeof(double));
        assert_true(one.rmse_held_out_percent == three.rmse_held_out_percent);
        assert_int_equal(one.n_evaluations, three.n_evaluations);
        joint_result_free(&one), joint_result_free(&three);
    }
}

// Also not by the choice of the weight: held-out views are not the ones set aside for that.
static void held_out_views_are_only_reported(void **state)
{
    (void)state;
    static const struct {
        int data_set;
        enum method method;
    } solves[] = {{2, METHOD_JOINT}, {3, METHOD_ALTERNATING}, {3, METHOD_DIRECTIONAL}};
    for (size_t i = 0; i < sizeof(solves) / sizeof(solves[0]); i++) {
        const struct studio *s = studio_of(solves[i].data_set);
        const struct joint_settings set = settings_of(solves[i].data_set, solves[i].method);
        const struct joint_result *expected = solved(solves[i].data_set, solves[i].method);
        struct studio black = *s;
        struct joint_result r;
        black.samples.radiance = calloc((size_t)s->samples.n, sizeof(*s->samples.radiance));
        assert_non_null(black.samples.radiance);
        for (int64_t k = 0; k < s->samples.n; k++)
            if (!s->held_out[s->samples.view[k]])
                memcpy(black.samples.radiance[k], s->samples.radiance[k],
                       sizeof(*black.samples.radiance));
        assert_int_equal(solve(&r, &black, &set), 0);
        assert_same_state(s, &r.state, &expected->state);
        assert_true(r.rmse_fit_percent == expected->rmse_fit_percent);
        assert_true(r.rmse_held_out_percent > 10); // of pictures about 25 % bright
        assert_int_equal(r.n_held_out, expected->n_held_out);
        joint_result_free(&r);
        free(black.samples.radiance);
    }
}

static void without_rays_everything_is_visible(void **state)
{
    (void)state;
    struct studio blind = *studio_of(3);
    struct joint_settings set = all_parts();
    struct joint_result r, not_traced;
    blind.rays = NULL;
    assert_int_equal(solve(&r, &blind, &set), 0);
    set.visibility = false;
    assert_int_equal(solve(&not_traced, studio_of(3), &set), 0);
    assert_same_state(&blind, &r.state, &not_traced.state);
    joint_result_free(&r), joint_result_free(&not_traced);
}

// What the median cut leaves where the sky is black: no reason to trust the answer less.
static void empty_lights_change_nothing(void **state)
{
    (void)state;
    const struct studio *s = studio_of(2);
    struct studio more = *s;
    const struct joint_settings set = settings_of(2, METHOD_JOINT);
    const struct joint_result *expected = solved(2, METHOD_JOINT);
    struct joint_result r;
    assert_int_equal(lights_new(&more.lights, 2 * N_LIGHTS * N_SUB), 0);
    memcpy(more.lights.centre_m, s->lights.centre_m, sizeof(s->lights.centre_m));
    memcpy(more.lights.world_from_probe, s->lights.world_from_probe,
           sizeof(s->lights.world_from_probe));
    for (int i = 0; i < more.lights.n; i++) {
        const int k = i % s->lights.n;
        more.lights.group[i] = i / N_SUB;
        memcpy(more.lights.dir_probe[i], s->lights.dir_probe[k], sizeof(*s->lights.dir_probe));
        if (i < s->lights.n)
            memcpy(more.lights.irradiance[i], s->lights.irradiance[k],
                   sizeof(*s->lights.irradiance));
    }
    assert_int_equal(joint_solve(&r, &more.texels, &more.samples, more.rays, &more.lights,
                                 more.held_out, &set), 0);
    assert_int_equal(r.doubts, 0);
    below("RMSE held out, change in %",
          fabs(r.rmse_held_out_percent - expected->rmse_held_out_percent), 1e-3);
    for (int c = 0; c < 3; c++)
        below("centre, change in m",
              fabs(r.state.lights.centre_m[c] - expected->state.lights.centre_m[c]), 1e-3);
    joint_result_free(&r);
    lights_free(&more.lights);
}

// ---- doubts -------------------------------------------------------------------------------------

static void mirrored_panorama_is_doubted(void **state)
{
    (void)state;
    for (int data_set = 2; data_set <= 3; data_set++) {
        struct studio *s = studio_of(data_set);
        struct joint_settings set = settings_of(data_set, METHOD_JOINT);
        struct joint_result r;
        set.w_sim = 1e-4; // the doubt comes from the sweep: one step is enough
        for (int i = 0; i < s->lights.n; i++)
            s->lights.dir_probe[i][0] *= -1;
        const int err = solve(&r, s, &set);
        for (int i = 0; i < s->lights.n; i++)
            s->lights.dir_probe[i][0] *= -1;
        assert_int_equal(err, 0);
        assert_true(r.doubts & DOUBT_MIRRORED);
        joint_result_free(&r);
    }
}

static void fewer_than_three_views_are_doubted(void **state)
{
    (void)state;
    for (int n_fitted = 2; n_fitted <= 3; n_fitted++) {
        struct studio s = *studio_of(2);
        const struct joint_settings set = settings_of(2, METHOD_JOINT);
        struct joint_result r;
        for (int v = 0; v < N_VIEWS; v++) // spread about the object
            s.held_out[v] = v % 2 || v >= 2 * n_fitted;
        assert_int_equal(solve(&r, &s, &set), 0);
        assert_int_equal((r.doubts & DOUBT_FEW_VIEWS) != 0, n_fitted < 3);
        joint_result_free(&r);
    }
}

static void diffuse_with_free_albedo_is_solved_as_directional(void **state)
{
    (void)state;
    static const enum method methods[] = {METHOD_JOINT, METHOD_ALTERNATING};
    for (int i = 0; i < 2; i++) {
        struct joint_settings set = settings_of(2, methods[i]);
        struct joint_result r;
        set.albedo = ALBEDO_FREE;
        assert_int_equal(solve(&r, studio_of(2), &set), 0);
        assert_int_equal(r.doubts, DOUBT_NO_INFORMATION);
        for (int k = 0; k < r.state.lights.n; k++)
            assert_true(r.state.lights.inverse_distance[k] == 0);
        for (int g = 0; g < N_LIGHTS; g++)
            assert_true(isinf(r.inverse_distance_std[g]));
        joint_result_free(&r);
    }
}

// No lights explain pictures of which every other one is twice as bright.
static void pictures_that_no_lights_explain_are_doubted(void **state)
{
    (void)state;
    const struct studio *s = studio_of(2);
    const struct joint_settings set = settings_of(2, METHOD_JOINT);
    struct studio uneven = *s;
    struct joint_result r;
    uneven.samples.radiance = malloc((size_t)s->samples.n * sizeof(*s->samples.radiance));
    assert_non_null(uneven.samples.radiance);
    for (int64_t k = 0; k < s->samples.n; k++)
        for (int c = 0; c < 3; c++) // the exponent of a half begins at bit 10
            uneven.samples.radiance[k][c] =
                (uint16_t)(s->samples.radiance[k][c] + (s->samples.view[k] % 2 << 10));
    assert_int_equal(solve(&r, &uneven, &set), 0);
    assert_true(r.doubts & DOUBT_POOR_FIT);
    joint_result_free(&r);
    free(uneven.samples.radiance);
}

static void every_doubt_has_its_words(void **state)
{
    (void)state;
    for (unsigned bit = 1; bit <= DOUBT_POOR_FIT; bit <<= 1)
        assert_true(*joint_doubt_text(bit));
}

// ---- refused ------------------------------------------------------------------------------------

static void nothing_to_fit_is_an_error(void **state)
{
    (void)state;
    struct studio s = *studio_of(2);
    const struct joint_settings set = settings_of(2, METHOD_JOINT);
    const struct samples_settings gather = samples_defaults();
    const char *const none[N_VIEWS] = {0};
    struct joint_result r;
    log_set_level(LOG_SILENT);
    memset(s.held_out, 1, sizeof(s.held_out));
    assert_int_equal(solve(&r, &s, &set), -EINVAL);
    assert_null(r.state.albedo);
    assert_null(r.inverse_distance_std);
    memset(s.held_out, 0, sizeof(s.held_out));
    assert_int_equal(samples_gather(&s.samples, &s.texels, s.rays, &s.cameras, none, &gather), 0);
    assert_int_equal(solve(&r, &s, &set), -EINVAL);
    assert_null(r.state.albedo);
    assert_null(r.inverse_distance_std);
    samples_free(&s.samples);
    log_set_level(LOG_ERROR);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(joint_finds_the_lights_about_a_known_diffuse_object),
        cmocka_unit_test(joint_finds_material_and_lights),
        cmocka_unit_test(joint_finds_the_one_albedo_of_a_diffuse_object),
        cmocka_unit_test(joint_leaves_a_fraction_of_the_directional_error),
        cmocka_unit_test(alternating_improves_on_directional_and_joint_on_alternating),
        cmocka_unit_test(thread_count_does_not_change_a_byte),
        cmocka_unit_test(held_out_views_are_only_reported),
        cmocka_unit_test(without_rays_everything_is_visible),
        cmocka_unit_test(empty_lights_change_nothing),
        cmocka_unit_test(mirrored_panorama_is_doubted),
        cmocka_unit_test(fewer_than_three_views_are_doubted),
        cmocka_unit_test(diffuse_with_free_albedo_is_solved_as_directional),
        cmocka_unit_test(pictures_that_no_lights_explain_are_doubted),
        cmocka_unit_test(every_doubt_has_its_words),
        cmocka_unit_test(nothing_to_fit_is_an_error),
    };
    return cmocka_run_group_tests(tests, open_studios, close_studios);
}
