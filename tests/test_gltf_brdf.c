// tests/test_gltf_brdf.c - glTF's reflectance against what the specification says of it, and the fit against Disney's.
#include "solver/gltf_brdf.h"
#include "solver/random.h"
#include "solver/vec3.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <cmocka.h>

static struct gltf_brdf *brdf;
static const struct disney_frame frame = { { 0, 0, 1 }, { 1, 0, 0 }, { 0, 1, 0 } };
static uint64_t state, drawn; // a test chooses state, its stream of numbers

static double uniform(void)
{
    return random_uniform(state, 0, drawn++);
}

static void random_direction(double out[3], double least_cosine)
{
    const double c = least_cosine + (1 - least_cosine) * uniform(), s = sqrt(1 - c * c), a = 2 * M_PI * uniform();
    out[0] = s * cos(a), out[1] = s * sin(a), out[2] = c;
}

static struct disney random_disney(void)
{
    struct disney m = { .variant = DISNEY_2017 };
    for (int p = 0; p < DISNEY_N; p++)
        m.theta[p] = uniform();
    for (int k = 0; k < 3; k++)
        m.albedo[k] = .05 + .8 * uniform();
    return m;
}

// Metals have no diffuse lobe and no sheen, and the GGX of both is one formula: the fit must be exact.
static void a_bare_metal_is_the_same_in_both(void **unused)
{
    (void)unused;
    state = 1;
    for (int i = 0; i < 2000; i++) {
        struct disney m = random_disney();
        struct gltf_material g;
        double l[3], v[3], want[3], got[3];
        m.theta[DISNEY_METALLIC] = 1;
        m.theta[DISNEY_ROUGHNESS] = .05 + .95 * uniform();
        m.theta[DISNEY_ANISOTROPIC] = m.theta[DISNEY_CLEARCOAT] = m.theta[DISNEY_SHEEN] = 0;
        gltf_from_disney(brdf, &g, &m, NULL);
        random_direction(l, .01), random_direction(v, .01);
        disney_eval(&m, &frame, l, v, want);
        gltf_brdf_eval(brdf, &g, &frame, l, v, got);
        for (int k = 0; k < 3; k++)
            assert_true(fabs(got[k] - want[k]) <= 1e-9 * (1 + want[k]));
    }
}

// D is kept by the alphas along x and y; V is the height-correlated one, so only the peak's shape is compared: at l = v both V are 1/4.
static void anisotropy_keeps_both_alphas(void **unused)
{
    (void)unused;
    state = 2;
    for (int i = 0; i < 500; i++) {
        struct disney m = { .albedo = { .9, .6, .3 } };
        struct gltf_material g;
        m.theta[DISNEY_METALLIC] = 1;
        m.theta[DISNEY_ROUGHNESS] = .1 + .4 * uniform();
        m.theta[DISNEY_ANISOTROPIC] = uniform();
        gltf_from_disney(brdf, &g, &m, NULL);
        const double aspect = sqrt(1 - .9 * m.theta[DISNEY_ANISOTROPIC]), r2 = m.theta[DISNEY_ROUGHNESS] * m.theta[DISNEY_ROUGHNESS];
        const double alpha = g.roughness * g.roughness, along = alpha + (1 - alpha) * g.anisotropy * g.anisotropy;
        assert_true(fabs(alpha - r2 * aspect) < 1e-12);
        assert_true(fabs(along - r2 / aspect) < 1e-12);
        const double v[3] = { 0, 0, 1 };
        double want[3], got[3];
        disney_eval(&m, &frame, v, v, want);
        gltf_brdf_eval(brdf, &g, &frame, v, v, got);
        assert_true(fabs(got[1] / want[1] - 1) < 1e-9);
    }
}

static void a_lambertian_is_exact(void **unused)
{
    (void)unused;
    state = 3;
    const double albedo[3] = { .8, .5, .02 };
    struct gltf_material g;
    gltf_from_lambert(&g, albedo);
    for (int i = 0; i < 100; i++) {
        double l[3], v[3], f[3];
        random_direction(l, .01), random_direction(v, .01);
        gltf_brdf_eval(brdf, &g, &frame, l, v, f);
        for (int k = 0; k < 3; k++)
            assert_true(fabs(f[k] - albedo[k] / M_PI) < 1e-12);
    }
}

// F0 = (1-m) .04 S + m C, whatever the base colour became; both sides are what a perfect mirror at the normal would show.
static void f0_survives_the_fit(void **unused)
{
    (void)unused;
    state = 4;
    for (int i = 0; i < 2000; i++) {
        struct disney m = random_disney();
        struct gltf_material g;
        m.theta[DISNEY_METALLIC] *= .9;
        gltf_from_disney(brdf, &g, &m, NULL);
        const double lum = .3 * m.albedo[0] + .6 * m.albedo[1] + .1 * m.albedo[2], metallic = m.theta[DISNEY_METALLIC];
        for (int k = 0; k < 3; k++) {
            const double tint = 1 + m.theta[DISNEY_SPECULAR_TINT] * (m.albedo[k] / lum - 1);
            const double want = (1 - metallic) * .08 * m.theta[DISNEY_SPECULAR] * tint + metallic * m.albedo[k];
            const double got = (1 - metallic) * .04 * g.specular_color[k] + metallic * g.base_color[k];
            assert_true(fabs(got - want) < 1e-9);
            assert_true(g.base_color[k] >= 0 && g.base_color[k] <= 1 && g.specular_color[k] >= 0);
        }
    }
}

// Copying parameters by name is what the fit must beat, one parameter at a time and all at once.
static void the_fit_beats_the_mapping_by_name(void **unused)
{
    (void)unused;
    state = 5;
    for (int p = -1; p <= DISNEY_N; p++) {
        double fitted = 0, by_name = 0;
        for (int i = 0; i < 200; i++) {
            struct disney m = random_disney();
            struct gltf_fit_error e;
            struct gltf_material g;
            if (p < DISNEY_N) { // a plain dielectric, and one parameter of its own
                const double value = p < 0 ? 0 : m.theta[p];
                memset(m.theta, 0, sizeof(m.theta));
                m.theta[DISNEY_SPECULAR] = .5, m.theta[DISNEY_ROUGHNESS] = .2 + .7 * uniform();
                if (p == DISNEY_SHEEN_TINT)
                    m.theta[DISNEY_SHEEN] = 1;
                if (p == DISNEY_CLEARCOAT_GLOSS)
                    m.theta[DISNEY_CLEARCOAT] = 1;
                if (p >= 0)
                    m.theta[p] = value;
            }
            gltf_from_disney(brdf, &g, &m, &e);
            fitted += e.fitted, by_name += e.by_name;
        }
        if (!(fitted < by_name))
            fail_msg("%s: fitted %g %%, by name %g %%", p < 0 ? "plain" : p < DISNEY_N ? disney_parameter_names[p] : "all",
                     gltf_rmse_percent(fitted, 200), gltf_rmse_percent(by_name, 200));
    }
}

// Sheen scales what lies below by what it takes: over a white ground nothing may come back that was not sent.
static void sheen_gains_no_energy(void **unused)
{
    (void)unused;
    enum { RINGS = 60, STEPS = 60 };
    for (int r = 1; r <= 10; r++)
        for (int e = 1; e < 10; e++) {
            const double albedo[3] = { 1, 1, 1 }, c = e / 10., v[3] = { sqrt(1 - c * c), 0, c };
            double sum = 0;
            struct gltf_material g;
            gltf_from_lambert(&g, albedo);
            g.sheen_color[0] = g.sheen_color[1] = g.sheen_color[2] = 1, g.sheen_roughness = r / 10.;
            for (int i = 0; i < RINGS * STEPS; i++) {
                const double z = (i % RINGS + .5) / RINGS, a = 2 * M_PI * (i / RINGS + .5) / STEPS, s = sqrt(1 - z * z);
                const double l[3] = { s * cos(a), s * sin(a), z };
                double f[3];
                gltf_brdf_eval(brdf, &g, &frame, l, v, f);
                sum += f[0] * z * 2 * M_PI / (RINGS * STEPS);
            }
            assert_true(sum < 1.01);
            assert_true(sum > .5);
        }
}

static void light_and_view_may_change_places(void **unused)
{
    (void)unused;
    state = 6;
    for (int i = 0; i < 1000; i++) {
        const struct disney m = random_disney();
        struct gltf_material g;
        double l[3], v[3], a[3], b[3];
        gltf_from_disney(brdf, &g, &m, NULL);
        g.clearcoat = 0; // its share depends on the view alone
        random_direction(l, .01), random_direction(v, .01);
        gltf_brdf_eval(brdf, &g, &frame, l, v, a);
        gltf_brdf_eval(brdf, &g, &frame, v, l, b);
        for (int k = 0; k < 3; k++)
            assert_true(fabs(a[k] - b[k]) <= 1e-9 * (1 + a[k]));
    }
}

static void below_the_horizon_is_black(void **unused)
{
    (void)unused;
    const struct disney m = { .theta = { .5, .5, .5, .5, .5, .5, .5, .5, .5, .5 }, .albedo = { .5, .5, .5 } };
    const double up[3] = { 0, 0, 1 }, down[3] = { 0, .6, -.8 }, level[3] = { 1, 0, 0 };
    struct gltf_material g;
    double f[3] = { 1, 1, 1 };
    gltf_from_disney(brdf, &g, &m, NULL);
    gltf_brdf_eval(brdf, &g, &frame, down, up, f);
    assert_true(f[0] == 0 && f[1] == 0 && f[2] == 0);
    gltf_brdf_eval(brdf, &g, &frame, up, level, f);
    assert_true(f[0] == 0 && f[1] == 0 && f[2] == 0);
}

static int set_up(void **unused)
{
    (void)unused;
    return gltf_brdf_new(&brdf);
}

static int tear_down(void **unused)
{
    (void)unused;
    gltf_brdf_free(brdf);
    return 0;
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_bare_metal_is_the_same_in_both),
        cmocka_unit_test(anisotropy_keeps_both_alphas),
        cmocka_unit_test(a_lambertian_is_exact),
        cmocka_unit_test(f0_survives_the_fit),
        cmocka_unit_test(the_fit_beats_the_mapping_by_name),
        cmocka_unit_test(sheen_gains_no_energy),
        cmocka_unit_test(light_and_view_may_change_places),
        cmocka_unit_test(below_the_horizon_is_black),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
