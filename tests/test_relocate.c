// tests/test_relocate.c - lights found again under materials that are known per texel: on a small studio whose true
// lights and textures are known.
#include "solver/relocate.h"
#include "solver/random.h"
#include "solver/synth.h"
#include "solver/take/half.h"
#include "tests/scratch.h"
#include "tests/studio.h"

#include <ftw.h>

enum { N_LIGHTS = 64, N_VIEWS = 40, HOLD_OUT = 5, TEXTURE = 48 };

static struct studio studio;
static struct lights truth;                   // where the lights are
static float (*true_theta)[DISNEY_N];         // [texels]

static int read_theta(void)
{
    struct image image;
    int err = image_read(&image, scratch_path("take/truth/brdf.exr"));
    true_theta = calloc((size_t)studio.texels.n, sizeof(*true_theta));
    for (int t = 0; !err && t < studio.texels.n; t++) {
        const uint32_t x = studio.texels.pixel[t] % TEXTURE, y = studio.texels.pixel[t] / TEXTURE;
        const size_t at = (size_t)(y * 2 + 1) * (size_t)image.height / (2 * TEXTURE) * (size_t)image.width + (x * 2 + 1) * (size_t)image.width / (2 * TEXTURE);
        for (int p = 0; p < DISNEY_N; p++)
            true_theta[t][p] = image.data[at * (size_t)image.n_channels + (size_t)image_channel(&image, disney_parameter_names[p])];
    }
    image_free(&image);
    return err;
}

static int open_studio(void **state)
{
    (void)state;
    struct synth_settings synth = synth_defaults(3);
    synth.n_true_lights = N_LIGHTS, synth.panorama_width_px = 512, synth.texture_size = 192;
    synth.width_px = 240, synth.height_px = 160, synth.n_views = N_VIEWS, synth.samples = 1, synth.final_float = true;
    if (scratch_open() || synth_write(&synth, scratch_path("take")))
        return -1;
    static char take[800];
    snprintf(take, sizeof(take), "%s", scratch_path("take"));
    int err = studio_open(&studio, take, TEXTURE, 0, 1, HOLD_OUT);
    if (!err)
        err = lights_read_json(&truth, scratch_path("take/truth/lights.json"));
    if (!err)
        err = read_theta();
    return err;
}

static int remove_one(const char *path, const struct stat *st, int kind, struct FTW *at)
{
    (void)st, (void)kind, (void)at;
    return remove(path);
}

static int close_studio(void **state)
{
    (void)state;
    free(true_theta);
    lights_free(&truth);
    studio_close(&studio);
    return nftw(scratch_dir, remove_one, 8, FTW_DEPTH | FTW_PHYS);
}

// The true lights, but those of a group `wrong` as near, the ratio of their distances kept. Groups are of 1, 2, 3, 1, ... neighbours.
static void start_at(struct photometric_state *state, const float wrong[4], const double off_m[3])
{
    const struct photometric p = { .texels = &studio.texels, .samples = &studio.samples };
    struct lights l = studio.lights;
    assert_int_equal(photometric_state_new(state, &p, &l), 0);
    memcpy(state->lights.world_from_probe, truth.world_from_probe, sizeof(truth.world_from_probe));
    for (int c = 0; c < 3; c++)
        state->lights.centre_m[c] = truth.centre_m[c] + off_m[c];
    for (int i = 0, group = 0, left = 1; i < truth.n; i++) {
        state->lights.group[i] = group;
        state->lights.inverse_distance[i] = truth.inverse_distance[i] * (double)wrong[group % 4];
        if (--left == 0)
            group++, left = 1 + group % 3;
    }
}

static const float all_wrong[4] = { .7f, .65f, .75f, .7f };
static const double off_m[3] = { .04, -.03, .03 };

static struct joint_settings settings(int n_threads)
{
    struct joint_settings set = joint_defaults(METHOD_JOINT);
    set.n_threads = n_threads;
    return set;
}

static void relocate(struct photometric_state *state, const float (*theta)[DISNEY_N], int n_threads, double *before, double *after)
{
    const struct joint_settings set = settings(n_threads);
    assert_int_equal(relocate_lights(state, &studio.texels, &studio.samples, studio.rays, studio.held_out, theta, NULL, &set, before, after), 0);
}

static double distance_error(const struct photometric_state *s)
{
    double sum = 0;
    for (int i = 0; i < truth.n; i++)
        sum += fabs(truth.inverse_distance[i] / s->lights.inverse_distance[i] - 1);
    return sum / truth.n;
}

static double centre_error_m(const struct photometric_state *s)
{
    double off[3];
    vec3_sub(off, s->lights.centre_m, truth.centre_m);
    return vec3_norm(off);
}

static void lights_come_nearer_to_the_truth_and_their_groups_keep_together(void **unused)
{
    (void)unused;
    struct photometric_state s;
    double before, after;
    start_at(&s, all_wrong, off_m);
    const double wrong = distance_error(&s), off = centre_error_m(&s);
    assert_true(wrong > .3);
    relocate(&s, (const float(*)[DISNEY_N])true_theta, 0, &before, &after);
    print_message("# distances %.1f -> %.1f %%, centre %.2f -> %.2f cm, views aside %.3f -> %.3f %%\n", 100 * wrong, 100 * distance_error(&s), 100 * off,
                  100 * centre_error_m(&s), before, after);
    assert_true(after < .2 * before);
    assert_true(distance_error(&s) < wrong / 3);
    assert_true(centre_error_m(&s) < off / 2);
    for (int i = 1; i < truth.n; i++)
        if (s.lights.group[i] == s.lights.group[i - 1]) {
            const double ratio = s.lights.inverse_distance[i] / s.lights.inverse_distance[i - 1];
            assert_true(fabs(ratio / (truth.inverse_distance[i] / truth.inverse_distance[i - 1]) - 1) < 1e-5);
        }
    photometric_state_free(&s);
}

static const float right[4] = { 1, 1, 1, 1 };
static const double nothing[3] = { 0, 0, 0 };

// Whatever the start, and whatever the materials: of those, what explains the views set aside is what the step is for.
static void the_start_does_not_matter_but_the_materials_do(void **unused)
{
    (void)unused;
    struct photometric_state from_truth, from_afar, misled;
    double before, after, error[3];
    static const float far[4] = { .6f, .6f, .6f, .6f };
    float(*theta)[DISNEY_N] = calloc((size_t)studio.texels.n, sizeof(*theta));
    for (int t = 0; t < studio.texels.n; t++)
        for (int p = 0; p < DISNEY_N; p++)
            theta[t][p] = .5f;
    start_at(&from_truth, right, nothing);
    start_at(&from_afar, far, nothing);
    start_at(&misled, right, nothing);
    relocate(&from_truth, (const float(*)[DISNEY_N])true_theta, 0, &before, &after);
    error[0] = distance_error(&from_truth);
    assert_true(after <= before);
    relocate(&from_afar, (const float(*)[DISNEY_N])true_theta, 0, &before, &after);
    error[1] = distance_error(&from_afar);
    assert_true(after <= before);
    relocate(&misled, (const float(*)[DISNEY_N])theta, 0, &before, &after);
    error[2] = distance_error(&misled);
    assert_true(after <= before);
    print_message("# distances %.1f %% from the truth, %.1f %% from afar, %.1f %% under a wrong material\n", 100 * error[0], 100 * error[1], 100 * error[2]);
    assert_true(fabs(error[0] - error[1]) < .02);
    assert_true(error[0] < .5 * error[2]);
    photometric_state_free(&from_truth);
    photometric_state_free(&from_afar);
    photometric_state_free(&misled);
    free(theta);
}

// Lights stand right, and what is fitted is noisy: the search only makes the views aside worse, so nothing may move.
static void what_does_not_help_is_not_taken(void **unused)
{
    (void)unused;
    struct photometric_state s, first;
    double before, after;
    const size_t n_bytes = (size_t)studio.samples.n * sizeof(*studio.samples.radiance);
    uint16_t(*kept)[3] = malloc(n_bytes);
    memcpy(kept, studio.samples.radiance, n_bytes);
    for (int64_t i = 0; i < studio.samples.n; i++) {
        int seen = 0; // the views aside are each sixth, from the fourth, of those that are not held out
        for (int v = 0; v < studio.samples.view[i]; v++)
            seen += !studio.held_out[v];
        float rgb[3];
        samples_radiance(&studio.samples, i, rgb);
        for (int c = 0; seen % 6 != 3 && c < 3; c++)
            studio.samples.radiance[i][c] = half_from_float(rgb[c] * (float)exp(.3 * random_normal(5, (uint64_t)studio.samples.view[i], (uint64_t)i / 50)));
    }
    start_at(&s, right, nothing);
    start_at(&first, right, nothing);
    relocate(&s, (const float(*)[DISNEY_N])true_theta, 0, &before, &after);
    memcpy(studio.samples.radiance, kept, n_bytes);
    print_message("# noisy: views aside %.3f -> %.3f %%\n", before, after);
    assert_true(after == before);
    assert_memory_equal(s.lights.inverse_distance, first.lights.inverse_distance, (size_t)truth.n * sizeof(double));
    assert_memory_equal(s.lights.centre_m, first.lights.centre_m, sizeof(first.lights.centre_m));
    photometric_state_free(&s);
    photometric_state_free(&first);
    free(kept);
}

static void doubts_are_asked_again_under_the_materials_but_for_those_that_none_can_lift(void **unused)
{
    (void)unused;
    const struct joint_settings set = settings(0);
    const unsigned stays = DOUBT_MIRRORED;
    struct joint_result r = { .doubts = stays | DOUBT_UNCERTAIN | DOUBT_POOR_FIT, .inverse_distance_std = calloc((size_t)truth.n, sizeof(double)) };
    float(*theta)[DISNEY_N] = calloc((size_t)studio.texels.n, sizeof(*theta));
    for (int t = 0; t < studio.texels.n; t++) // a rough metal
        theta[t][DISNEY_METALLIC] = theta[t][DISNEY_ROUGHNESS] = .9f;
    start_at(&r.state, right, nothing);
    assert_int_equal(relocate_doubt(&r, &studio.texels, &studio.samples, studio.rays, studio.held_out, (const float(*)[DISNEY_N])true_theta, NULL, &set), 0);
    print_message("# under the true material: structure %.4f of %.3f, distances' deviation %.1f %%, centre's %.2f cm\n", r.misfit.structure, r.misfit.level,
                  100 * r.distance_std_relative, 100 * vec3_norm(r.centre_std_m));
    assert_int_equal(r.doubts, stays);
    assert_true(r.distance_std_relative > 0 && vec3_norm(r.centre_std_m) > 0);
    assert_int_equal(relocate_doubt(&r, &studio.texels, &studio.samples, studio.rays, studio.held_out, (const float(*)[DISNEY_N])theta, NULL, &set), 0);
    assert_true(r.doubts & DOUBT_POOR_FIT);
    assert_true(r.doubts & stays);
    assert_true(fabs(distance_error(&r.state)) < 1e-12); // looked at, not moved
    joint_result_free(&r);
    free(theta);
}

static void held_out_views_are_not_looked_at_and_threads_do_not_matter(void **unused)
{
    (void)unused;
    struct photometric_state one, two;
    double before[2], after[2];
    start_at(&one, all_wrong, off_m);
    start_at(&two, all_wrong, off_m);
    relocate(&one, (const float(*)[DISNEY_N])true_theta, 1, &before[0], &after[0]);
    for (int64_t i = 0; i < studio.samples.n; i++)
        for (int c = 0; studio.held_out[studio.samples.view[i]] && c < 3; c++)
            studio.samples.radiance[i][c] ^= 0x1f; // they do not come back: this is the last test
    relocate(&two, (const float(*)[DISNEY_N])true_theta, 2, &before[1], &after[1]);
    assert_memory_equal(before, before + 1, sizeof(double));
    assert_memory_equal(after, after + 1, sizeof(double));
    assert_memory_equal(one.lights.inverse_distance, two.lights.inverse_distance, (size_t)truth.n * sizeof(double));
    assert_memory_equal(one.lights.centre_m, two.lights.centre_m, sizeof(one.lights.centre_m));
    assert_memory_equal(one.lights.world_from_probe, two.lights.world_from_probe, sizeof(one.lights.world_from_probe));
    assert_memory_equal(one.albedo, two.albedo, (size_t)studio.texels.n * sizeof(*one.albedo));
    photometric_state_free(&one);
    photometric_state_free(&two);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(lights_come_nearer_to_the_truth_and_their_groups_keep_together),
        cmocka_unit_test(the_start_does_not_matter_but_the_materials_do),
        cmocka_unit_test(what_does_not_help_is_not_taken),
        cmocka_unit_test(doubts_are_asked_again_under_the_materials_but_for_those_that_none_can_lift),
        cmocka_unit_test(held_out_views_are_not_looked_at_and_threads_do_not_matter),
    };
    return cmocka_run_group_tests_name("relocate", tests, open_studio, close_studio);
}
