// tests/test_misfit.c - noise told from structure, on residuals that are made to measure: pictures of a pebble by the model itself, and
// something added.
#include "solver/misfit.h"
#include "solver/random.h"
#include "solver/shapes.h"
#include "solver/take/half.h"
#include "solver/vec3.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { N_VIEWS = 12, N_LIGHTS = 6, TEXTURE = 64 };

struct scene {
    struct mesh mesh;
    struct texels texels;
    struct samples samples;
    struct photometric p;
    struct photometric_state s;
    int32_t group[N_LIGHTS];
    float (*model)[3]; // what the pictures show without anything added
};
static struct scene scene;

// Every view sees what faces it.
static void see(struct samples *m, const struct texels *t)
{
    m->n_texels = t->n, m->n_views = N_VIEWS;
    m->first = calloc((size_t)t->n + 1, sizeof(*m->first));
    m->centre_m = calloc(N_VIEWS, sizeof(*m->centre_m));
    m->name = calloc(N_VIEWS, sizeof(*m->name));
    const size_t most = (size_t)t->n * N_VIEWS;
    m->view = calloc(most, sizeof(*m->view)), m->radiance = calloc(most, sizeof(*m->radiance));
    m->gradient = calloc(most, sizeof(*m->gradient)), m->flags = calloc(most, 1);
    assert_true(m->first && m->centre_m && m->name && m->view && m->radiance && m->gradient && m->flags);
    for (int v = 0; v < N_VIEWS; v++) {
        for (int c = 0; c < 3; c++)
            m->centre_m[v][c] = random_normal(1, 0, (uint64_t)(3 * v + c));
        vec3_normalise(m->centre_m[v]);
        for (int c = 0; c < 3; c++)
            m->centre_m[v][c] *= 3;
    }
    for (int i = 0; i < t->n; i++) {
        for (int v = 0; v < N_VIEWS; v++) {
            float d[3];
            samples_view_direction(m, t, i, v, d);
            const float *n = t->normal[i];
            if (d[0] * n[0] + d[1] * n[1] + d[2] * n[2] > .2f)
                m->view[m->n++] = (uint16_t)v;
        }
        m->first[i + 1] = m->n;
    }
}

static int open_scene(void **state)
{
    (void)state;
    struct scene *w = &scene;
    struct lights lights;
    if (shape_make(&w->mesh, SHAPE_PEBBLE, (const double[3]){0, 0, 0}, .3, 5000) || texels_rasterise(&w->texels, &w->mesh, TEXTURE) || lights_new(&lights, N_LIGHTS))
        return -1;
    see(&w->samples, &w->texels);
    for (int i = 0; i < N_LIGHTS; i++) {
        lights.dir_probe[i][i / 2] = i % 2 ? -1 : 1;
        lights.inverse_distance[i] = .5;
        for (int c = 0; c < 3; c++)
            lights.irradiance[i][c] = .8;
        w->group[i] = i;
    }
    w->p = (struct photometric){.texels = &w->texels, .samples = &w->samples, .model = REFLECT_DISNEY, .variant = DISNEY_2017,
                                .albedo = ALBEDO_GIVEN, .group_of_light = w->group, .n_groups = N_LIGHTS, .texel_step = 1, .n_threads = 1};
    if (photometric_state_new(&w->s, &w->p, &lights))
        return -1;
    lights_free(&lights);
    w->s.theta[DISNEY_ROUGHNESS] = .4, w->s.theta[DISNEY_METALLIC] = 0;
    w->model = malloc((size_t)w->samples.n * sizeof(*w->model));
    return w->model ? photometric_residuals(&w->p, &w->s, w->model) : -1; // less black pictures
}

static int close_scene(void **state)
{
    (void)state;
    photometric_state_free(&scene.s), samples_free(&scene.samples), texels_free(&scene.texels), mesh_free(&scene.mesh);
    free(scene.model);
    return 0;
}

// Pictures: the model's, and noise, and something of opposite sign on the two halves of it, and of every other view.
static void show(double noise, double halves, double views)
{
    struct samples *m = &scene.samples;
    memset(m->flags, 0, (size_t)m->n);
    for (int t = 0; t < m->n_texels; t++)
        for (int64_t i = m->first[t]; i < m->first[t + 1]; i++)
            for (int c = 0; c < 3; c++) {
                const double added = noise * random_normal(2, 0, (uint64_t)(3 * i + c)) +
                                     (scene.texels.position_m[t][0] > 0 ? halves : -halves) + (m->view[i] % 2 ? views : -views);
                m->radiance[i][c] = half_from_float(scene.model[i][c] + (float)added);
            }
}

static struct misfit measure(void)
{
    struct misfit out;
    assert_int_equal(misfit_measure(&out, &scene.p, &scene.s), 0);
    return out;
}

static void near(const char *what, double found, double expected, double tolerance)
{
    if (!(fabs(found - expected) <= tolerance))
        fail_msg("%s is %.6g, expected %.6g +- %.2g", what, found, expected, tolerance);
}

// ---- noise and structure ------------------------------------------------------------------------

static void white_noise_is_noise(void **state)
{
    (void)state;
    show(.02, 0, 0);
    const struct misfit m = measure();
    near("noise", m.noise, .02, .0004);
    near("residual", m.residual, .02, .0004);
    near("structure", m.structure, 0, .001);
    near("by view", m.by_view, 0, .001);
    near("by normal", m.by_normal, 0, .001);
    near("by mirror", m.by_mirror, 0, .001);
    assert_false(misfit_is_poor(&m));
    assert_int_equal(m.n_samples, scene.samples.n);
}

static void what_neighbours_share_is_structure(void **state)
{
    (void)state;
    show(0, .02, 0);
    const struct misfit m = measure();
    near("structure", m.structure, .02, .001); // the few pairs across the border differ
    near("noise", m.noise, 0, .006);
    near("by normal", m.by_normal, .02, .001);
    near("by view", m.by_view, 0, .012); // views see both halves, in unequal parts
    assert_true(misfit_is_poor(&m));
}

static void noise_is_taken_off_structure(void **state)
{
    (void)state;
    show(.03, .02, 0);
    const struct misfit m = measure();
    near("structure", m.structure, .02, .001);
    near("noise", m.noise, .03, .002);
    near("residual", m.residual, hypot(.02, .03), .0006);
}

static void uneven_views_are_seen_by_view(void **state)
{
    (void)state;
    show(.01, 0, .02);
    const struct misfit m = measure();
    near("structure", m.structure, .02, .0005);
    near("by view", m.by_view, .02, .0005);
}

static void exact_pictures_have_no_misfit(void **state)
{
    (void)state;
    show(0, 0, 0);
    const struct misfit m = measure();
    near("residual", m.residual, 0, 3e-4); // half floats
    assert_true(m.level > .1);
    assert_false(misfit_is_poor(&m));
}

static void clipped_samples_are_left_out(void **state)
{
    (void)state;
    show(.01, 0, 0);
    struct samples *m = &scene.samples;
    for (int64_t i = 0; i < m->n; i += 3) {
        m->flags[i] = SAMPLE_CLIPPED;
        m->radiance[i][0] = half_from_float(9); // the model is darker: a residual of thousands of percent
    }
    const struct misfit found = measure();
    near("residual", found.residual, .01, .0003);
    assert_int_equal(found.n_samples, m->n - (m->n + 2) / 3);
}

static void views_left_out_are_not_looked_at(void **state)
{
    (void)state;
    uint8_t even[N_VIEWS];
    int64_t n = 0;
    show(.01, 0, .02);
    for (int v = 0; v < N_VIEWS; v++)
        even[v] = v % 2 == 0;
    for (int64_t i = 0; i < scene.samples.n; i++)
        n += even[scene.samples.view[i]];
    scene.p.use_view = even;
    const struct misfit m = measure();
    float(*r)[3] = malloc((size_t)scene.samples.n * sizeof(*r));
    assert_non_null(r);
    assert_int_equal(photometric_residuals(&scene.p, &scene.s, r), 0);
    scene.p.use_view = NULL;
    double mean = 0;
    for (int64_t i = 0; i < scene.samples.n; i++) {
        assert_int_equal(!isnan(r[i][0]), even[scene.samples.view[i]]);
        mean += even[scene.samples.view[i]] ? (double)r[i][0] / (double)n : 0;
    }
    free(r);
    assert_int_equal(m.n_samples, n);
    near("L - o where the picture is darker", mean, .02, .001);
}

// ---- a light that the model lacks ---------------------------------------------------------------

static void missing_light_is_poor_and_pointed_at(void **state)
{
    (void)state;
    for (int i = 0; i < N_LIGHTS; i++) {
        double kept[3];
        show(.01, 0, 0);
        memcpy(kept, scene.s.lights.irradiance[i], sizeof(kept));
        memset(scene.s.lights.irradiance[i], 0, sizeof(kept));
        const struct misfit m = measure();
        memcpy(scene.s.lights.irradiance[i], kept, sizeof(kept));
        assert_true(misfit_is_poor(&m));
        near("unit", vec3_norm(m.brighter), 1, 1e-12);
        near("cosine to the missing light", vec3_dot(m.brighter, scene.s.lights.dir_probe[i]), 1, .15); // bins are 25 degrees wide
    }
}

// ---- deviations ---------------------------------------------------------------------------------

static void free_distances(unsigned char *is_free, struct photometric_layout *l)
{
    *l = photometric_layout_of(N_VIEWS, N_LIGHTS);
    memset(is_free, 0, (size_t)l->n);
    memset(is_free + l->inverse_distance, 1, N_LIGHTS);
}

static double first_deviation(double *inflation, const double *prior)
{
    struct photometric_layout l;
    unsigned char is_free[DISNEY_N + 9 + N_VIEWS + N_LIGHTS];
    double deviation[sizeof(is_free)];
    free_distances(is_free, &l);
    assert_int_equal(l.n, sizeof(is_free));
    assert_int_equal(misfit_deviations(deviation, inflation, &scene.p, &scene.s, is_free, prior), 0);
    assert_true(isinf(deviation[l.centre])); // not free
    return deviation[l.inverse_distance];
}

static void noise_alone_inflates_nothing_and_halves_with_itself(void **state)
{
    (void)state;
    double inflation;
    show(.02, 0, 0);
    const double two = first_deviation(&inflation, NULL);
    assert_true(inflation >= 1 && inflation < 2); // of some 30 patches
    show(.01, 0, 0);
    const double one = first_deviation(&inflation, NULL);
    near("ratio", two / one, 2, .05);
}

static void structure_inflates(void **state)
{
    (void)state;
    double inflation, plain;
    show(.02, 0, 0);
    const double by_noise = first_deviation(&plain, NULL);
    show(0, .02, 0); // the same RMS
    const double by_structure = first_deviation(&inflation, NULL);
    assert_true(inflation > 10);
    near("ratio", by_structure / by_noise, sqrt(inflation / plain), .05 * sqrt(inflation / plain));
}

// Of two independent statements about one number.
static void prior_knowledge_is_added(void **state)
{
    (void)state;
    const struct photometric_layout l = photometric_layout_of(N_VIEWS, N_LIGHTS);
    const size_t n = (size_t)l.n, i = (size_t)l.inverse_distance;
    double *prior = calloc(n * n, sizeof(double)), inflation;
    assert_non_null(prior);
    show(.02, 0, 0);
    const double alone = first_deviation(&inflation, NULL), known = alone / 100;
    prior[i * n + i] = 1 / (known * known);
    near("deviation", first_deviation(&inflation, prior), known, .01 * known);
    free(prior);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(white_noise_is_noise),
        cmocka_unit_test(what_neighbours_share_is_structure),
        cmocka_unit_test(noise_is_taken_off_structure),
        cmocka_unit_test(uneven_views_are_seen_by_view),
        cmocka_unit_test(exact_pictures_have_no_misfit),
        cmocka_unit_test(clipped_samples_are_left_out),
        cmocka_unit_test(views_left_out_are_not_looked_at),
        cmocka_unit_test(missing_light_is_poor_and_pointed_at),
        cmocka_unit_test(noise_alone_inflates_nothing_and_halves_with_itself),
        cmocka_unit_test(structure_inflates),
        cmocka_unit_test(prior_knowledge_is_added),
    };
    return cmocka_run_group_tests(tests, open_scene, close_scene);
}
