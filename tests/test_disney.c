// tests/test_disney.c - the BRDF against reference cases, closed forms, central differences, reciprocity and energy.
#include "solver/csv.h"
#include "solver/disney.h"
#include "solver/random.h"
#include "solver/vec3.h"

#include <math.h>
#include <setjmp.h>
#include <stdbool.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

struct scene {
    struct disney m;
    struct disney_frame frame;
    double l[3], v[3];
};

static void random_unit(double d[3], uint64_t id, uint64_t stream)
{
    for (int c = 0; c < 3; c++)
        d[c] = random_normal(id, stream, (uint64_t)c);
    vec3_normalise(d);
}

static struct scene random_scene(uint64_t id)
{
    struct scene s = { .m.variant = id % 2 ? DISNEY_2012 : DISNEY_2017 };
    for (int i = 0; i < DISNEY_N; i++)
        s.m.theta[i] = .02 + .96 * random_uniform(id, 1, (uint64_t)i);
    for (int c = 0; c < 3; c++)
        s.m.albedo[c] = .02 + .96 * random_uniform(id, 2, (uint64_t)c);
    s.m.theta[DISNEY_ROUGHNESS] = .08 + .9 * random_uniform(id, 1, DISNEY_ROUGHNESS); // alpha above its clamp
    random_unit(s.frame.n, id, 3);
    random_unit(s.frame.x, id, 4);
    vec3_add_scaled(s.frame.x, s.frame.x, -vec3_dot(s.frame.x, s.frame.n), s.frame.n);
    vec3_normalise(s.frame.x);
    vec3_cross(s.frame.y, s.frame.n, s.frame.x);
    for (uint64_t k = 5; vec3_dot(s.l, s.frame.n) <= .02; k += 2)
        random_unit(s.l, id, k);
    for (uint64_t k = 6; vec3_dot(s.v, s.frame.n) <= .02; k += 2)
        random_unit(s.v, id, k);
    return s;
}

// n along z, so that directions can be written down.
static struct scene upright_scene(void)
{
    struct scene s = { .frame = { .n = { 0, 0, 1 }, .x = { 1, 0, 0 }, .y = { 0, 1, 0 } }, .l = { 0, 0, 1 }, .v = { 0, 0, 1 } };
    return s;
}

static double f_of(const struct scene *s, int channel)
{
    double f[3];
    disney_eval(&s->m, &s->frame, s->l, s->v, f);
    return f[channel];
}

static void reference_cases_are_reproduced(void **state)
{
    (void)state;
    static const char path[] = "../shared/data/brdf_cases.csv", rgb[] = "rgb", xyz[] = "xyz";
    if (access(path, R_OK)) {
        fprintf(stderr, "# no %s: reference cases are not checked\n", path);
        return;
    }
    struct csv csv;
    assert_int_equal(csv_open(&csv, path), 0);
    int n = 0;
    double worst = 0;
    while (csv_next_row(&csv) == 1) {
        struct scene s = { .m.variant = DISNEY_2017 };
        struct disney_gradient g;
        const struct {
            const char *prefix, *suffix;
            double *values;
            int n;
        } inputs[] = { { "n_", xyz, s.frame.n, 3 }, { "tx_", xyz, s.frame.x, 3 }, { "ty_", xyz, s.frame.y, 3 },
                       { "v_", xyz, s.v, 3 },       { "l_", xyz, s.l, 3 },        { "albedo_", rgb, s.m.albedo, 3 } };
        char name[64];
        for (size_t i = 0; i < sizeof(inputs) / sizeof(inputs[0]); i++)
            for (int c = 0; c < 3; c++) {
                snprintf(name, sizeof(name), "%s%c", inputs[i].prefix, inputs[i].suffix[c]);
                assert_int_equal(csv_number(&csv, csv_find(&csv, name), &inputs[i].values[c]), 0);
            }
        for (int i = 0; i < DISNEY_N; i++)
            assert_int_equal(csv_number(&csv, csv_find(&csv, disney_parameter_names[i]), &s.m.theta[i]), 0);
        disney_eval_gradient(&s.m, &s.frame, s.l, s.v, &g);
        double f[3];
        disney_eval(&s.m, &s.frame, s.l, s.v, f);
        for (int k = 0; k < 3; k++)
            for (int i = -1; i < DISNEY_N + 6; i++) {
                double got, want;
                if (i < 0)
                    snprintf(name, sizeof(name), "f_%c", rgb[k]), got = g.f[k], assert_true(fabs(f[k] - g.f[k]) <= 1e-14 * g.f[k]);
                else if (i < DISNEY_N)
                    snprintf(name, sizeof(name), "df_%c_d%s", rgb[k], disney_parameter_names[i]), got = g.theta[k][i];
                else if (i < DISNEY_N + 3)
                    snprintf(name, sizeof(name), "df_%c_dalbedo_%c", rgb[k], rgb[i - DISNEY_N]),
                        got = g.albedo[k][i - DISNEY_N];
                else
                    snprintf(name, sizeof(name), "df_%c_dl_%c", rgb[k], xyz[i - DISNEY_N - 3]),
                        got = g.light[k][i - DISNEY_N - 3];
                assert_int_equal(csv_number(&csv, csv_find(&csv, name), &want), 0);
                const double error = want == 0 ? fabs(got) : fabs(got - want) / fabs(want);
                if (!(error <= 1e-9))
                    fail_msg("line %d, %s: %.17g, expected %.17g", csv.line, name, got, want);
                worst = fmax(worst, error);
            }
        n++;
    }
    csv_close(&csv);
    printf("# %d reference cases, worst relative error %.2g\n", n, worst);
    assert_true(n > 0);
}

// At l = v = n every Fresnel weight is 0: f = C/pi + F0/(4 pi ax ay) + coat.
static void normal_incidence_has_a_closed_form(void **state)
{
    (void)state;
    for (uint64_t id = 0; id < 200; id++) {
        struct scene s = upright_scene();
        s.m = random_scene(2 * id).m;
        if (id % 4 == 0)
            s.m.theta[DISNEY_ROUGHNESS] = .031 * random_uniform(id, 9, 9); // both alphas on their clamp, or one
        const double *t = s.m.theta, *c = s.m.albedo, lum = .3 * c[0] + .6 * c[1] + .1 * c[2];
        const double r = t[DISNEY_ROUGHNESS], aspect = sqrt(1 - .9 * t[DISNEY_ANISOTROPIC]);
        const double ax = fmax(.001, r * r / aspect), ay = fmax(.001, r * r * aspect);
        const double a = .1 + t[DISNEY_CLEARCOAT_GLOSS] * (.001 - .1);
        const double dc = (a * a - 1) / (M_PI * log(a * a) * a * a);
        // Fss = 1 and 1/(nl+nv) = 1/2: ss = 1.25 / 2.
        const double base = 1 + t[DISNEY_SUBSURFACE] * (1.25 * .5 - 1);
        for (int k = 0; k < 3; k++) {
            const double tint = 1 + t[DISNEY_SPECULAR_TINT] * (c[k] / lum - 1), m = t[DISNEY_METALLIC];
            const double f0 = (1 - m) * .08 * t[DISNEY_SPECULAR] * tint + m * c[k];
            const double want = (1 - m) * c[k] * base / M_PI + f0 / (4 * M_PI * ax * ay) +
                                .25 * t[DISNEY_CLEARCOAT] * .25 * .04 * dc;
            assert_true(fabs(f_of(&s, k) - want) <= 1e-12 * want);
        }
    }
}

static void swapping_light_and_view_changes_nothing(void **state)
{
    (void)state;
    for (uint64_t id = 0; id < 2000; id++) {
        const struct scene s = random_scene(id);
        struct scene swapped = s;
        memcpy(swapped.l, s.v, sizeof(s.v));
        memcpy(swapped.v, s.l, sizeof(s.l));
        for (int k = 0; k < 3; k++)
            assert_true(fabs(f_of(&s, k) - f_of(&swapped, k)) <= 1e-12 * f_of(&s, k));
    }
}

static void turning_the_whole_scene_changes_nothing(void **state)
{
    (void)state;
    for (uint64_t id = 0; id < 500; id++) {
        const struct scene s = random_scene(id);
        struct scene turned = s;
        double w[3], rotation[9];
        random_unit(w, id, 77);
        mat3_from_rotation_vector(rotation, w);
        mat3_mul_vec(turned.frame.n, rotation, s.frame.n), mat3_mul_vec(turned.frame.x, rotation, s.frame.x);
        mat3_mul_vec(turned.frame.y, rotation, s.frame.y);
        mat3_mul_vec(turned.l, rotation, s.l), mat3_mul_vec(turned.v, rotation, s.v);
        for (int k = 0; k < 3; k++)
            assert_true(fabs(f_of(&s, k) - f_of(&turned, k)) <= 1e-10 * f_of(&s, k));
    }
}

static void nothing_comes_from_or_goes_below_the_horizon(void **state)
{
    (void)state;
    static const double below[][3] = { { 1, 0, 0 }, { .8, 0, -.6 }, { 0, 0, -1 } };
    struct scene s = upright_scene();
    s.m = random_scene(0).m;
    for (size_t i = 0; i < sizeof(below) / sizeof(below[0]); i++)
        for (int which = 0; which < 2; which++) {
            struct disney_gradient g, zero;
            memset(&zero, 0, sizeof(zero));
            memset(&g, 0xff, sizeof(g));
            disney_eval_gradient(&s.m, &s.frame, which ? below[i] : s.l, which ? s.v : below[i], &g);
            assert_memory_equal(&g, &zero, sizeof(g));
        }
}

// (f(+step) - f(-step)) / (2 step), step changing one thing of a scene.
typedef void change(struct scene *s, int index, double step);

static void change_theta(struct scene *s, int index, double step)
{
    s->m.theta[index] += step;
}

static void change_albedo(struct scene *s, int index, double step)
{
    s->m.albedo[index] += step;
}

static void turn(double v[3], const double axis[3], double angle)
{
    double w[3] = { axis[0] * angle, axis[1] * angle, axis[2] * angle }, rotation[9];
    mat3_from_rotation_vector(rotation, w);
    mat3_mul_vec(v, rotation, v);
}

// l moves by step towards the index-th of two directions across it.
static void across(double out[2][3], const double v[3])
{
    const double axis[3] = { fabs(v[0]) < .7, fabs(v[0]) >= .7, 0 };
    vec3_cross(out[0], v, axis);
    vec3_normalise(out[0]);
    vec3_cross(out[1], v, out[0]);
}

static void change_light(struct scene *s, int index, double step)
{
    double u[2][3], axis[3];
    across(u, s->l);
    vec3_cross(axis, s->l, u[index]);
    turn(s->l, axis, step);
}

static void change_normal(struct scene *s, int index, double step)
{
    double u[2][3], axis[3];
    across(u, s->frame.n);
    vec3_cross(axis, s->frame.n, u[index]);
    turn(s->frame.n, axis, step);
    turn(s->frame.x, axis, step);
    turn(s->frame.y, axis, step);
}

static void derivatives_are_those_of_the_values(void **state)
{
    (void)state;
    const double step = 1e-5;
    double worst = 0;
    for (uint64_t id = 0; id < 1000; id++) {
        const struct scene s = random_scene(id);
        struct disney_gradient g;
        double across_l[2][3], across_n[2][3];
        across(across_l, s.l), across(across_n, s.frame.n);
        disney_eval_gradient(&s.m, &s.frame, s.l, s.v, &g);
        const struct {
            change *how;
            int n;
        } kinds[] = { { change_theta, DISNEY_N }, { change_albedo, 3 }, { change_light, 2 }, { change_normal, 2 } };
        for (int kind = 0; kind < 4; kind++)
            for (int i = 0; i < kinds[kind].n; i++) {
                // Richardson: the error of the central difference falls from step^2 to step^4.
                struct scene at[4] = { s, s, s, s };
                kinds[kind].how(&at[0], i, step), kinds[kind].how(&at[1], i, -step);
                kinds[kind].how(&at[2], i, 2 * step), kinds[kind].how(&at[3], i, -2 * step);
                for (int k = 0; k < 3; k++) {
                    const double near = (f_of(&at[0], k) - f_of(&at[1], k)) / (2 * step);
                    const double far = (f_of(&at[2], k) - f_of(&at[3], k)) / (4 * step);
                    const double want = (4 * near - far) / 3;
                    const double got = kind == 0   ? g.theta[k][i]
                                       : kind == 1 ? g.albedo[k][i]
                                       : kind == 2 ? vec3_dot(g.light[k], across_l[i])
                                                   : vec3_dot(g.normal[k], across_n[i]);
                    // The difference's own rounding is f 1e-16 / step; the lobe is alpha wide, so its scale is f / alpha.
                    const double r = s.m.theta[DISNEY_ROUGHNESS];
                    const double error = fabs(got - want) / (fabs(want) + g.f[k] / (r * r));
                    worst = fmax(worst, error);
                    if (!(error <= 1e-7))
                        fail_msg("case %d, kind %d, %d, channel %d: %.12g, difference %.12g", (int)id, kind, i, k, got, want);
                }
            }
        for (int k = 0; k < 3; k++) {
            assert_true(fabs(vec3_dot(g.light[k], s.l)) <= 1e-12 * (vec3_norm(g.light[k]) + g.f[k]));
            assert_true(fabs(vec3_dot(g.normal[k], s.frame.n)) <= 1e-12 * (vec3_norm(g.normal[k]) + g.f[k]));
        }
    }
    printf("# central differences: worst %.2g\n", worst);
}

static void clamps_and_grey_kill_their_derivatives(void **state)
{
    (void)state;
    struct scene s = random_scene(4);
    struct disney_gradient g;
    s.m.theta[DISNEY_METALLIC] = 1; // the specular lobe alone
    s.m.theta[DISNEY_ROUGHNESS] = .01;
    disney_eval_gradient(&s.m, &s.frame, s.l, s.v, &g);
    for (int k = 0; k < 3; k++) {
        assert_true(g.f[k] > 0);
        assert_true(g.theta[k][DISNEY_ROUGHNESS] == 0 && g.theta[k][DISNEY_ANISOTROPIC] == 0);
        // metallic = 1: these no longer matter
        assert_true(g.theta[k][DISNEY_SUBSURFACE] == 0 && g.theta[k][DISNEY_SPECULAR] == 0);
        assert_true(g.theta[k][DISNEY_SPECULAR_TINT] == 0 && g.theta[k][DISNEY_SHEEN] == 0 && g.theta[k][DISNEY_SHEEN_TINT] == 0);
    }
    // 2012: G has its own alpha without a clamp, so roughness still matters.
    s.m.variant = DISNEY_2012;
    disney_eval_gradient(&s.m, &s.frame, s.l, s.v, &g);
    assert_true(g.theta[0][DISNEY_ROUGHNESS] != 0 && g.theta[0][DISNEY_ANISOTROPIC] == 0);

    s = random_scene(4);
    s.m.albedo[0] = s.m.albedo[1] = s.m.albedo[2] = .5;
    disney_eval_gradient(&s.m, &s.frame, s.l, s.v, &g);
    for (int k = 0; k < 3; k++)
        assert_true(fabs(g.theta[k][DISNEY_SHEEN_TINT]) < 1e-15 && fabs(g.theta[k][DISNEY_SPECULAR_TINT]) < 1e-15);
}

static void black_albedo_is_finite_and_untinted(void **state)
{
    (void)state;
    for (uint64_t id = 0; id < 100; id++) {
        struct scene s = random_scene(id);
        s.m.albedo[0] = s.m.albedo[1] = s.m.albedo[2] = 0;
        struct disney_gradient g;
        disney_eval_gradient(&s.m, &s.frame, s.l, s.v, &g);
        const double *all = (const double *)&g;
        for (size_t i = 0; i < sizeof(g) / sizeof(double); i++)
            assert_true(isfinite(all[i]));
        assert_true(g.f[0] == g.f[1] && g.f[1] == g.f[2] && g.f[0] > 0);
    }
}

// ---- Energy -------------------------------------------------------------------------------------------------------------

static const double view_nv[] = { 1, .7, .4, .15, .05 };
enum { N_VIEWS = sizeof(view_nv) / sizeof(view_nv[0]), N_ELEVATIONS = 400, N_AZIMUTHS = 128 };

static void view_at(double v[3], double nv, double azimuth)
{
    const double s = sqrt(1 - nv * nv);
    v[0] = s * cos(azimuth), v[1] = s * sin(azimuth), v[2] = nv;
}

// The w-th half vector's cosine, and its derivative by w, such that equal steps of w are equal parts of a GGX lobe of alpha^2 (except
// near the horizon, where they are closer): tan^2 = alpha^2 u/(1-u), u = 1 - (1-w)^2.
static void lobe_point(double w, double alpha2, double *cosine, double *weight)
{
    const double left = (1 - w) * (1 - w), c = 1 / sqrt(1 + alpha2 * (1 - left) / left);
    *cosine = c;
    *weight = c * c * c * alpha2 / (left * (1 - w));
}

// Integral of f <n,l> over the hemisphere by half vectors (dl = 4 lh dh), as the lobes are narrow; midpoint rule.
static double albedo_by_half_vectors(const struct scene *s, double alpha)
{
    double sum = 0;
    for (int i = 0; i < N_ELEVATIONS; i++)
        for (int j = 0; j < N_AZIMUTHS; j++) {
            double h[3], f[3], cosine, weight;
            lobe_point((i + .5) / N_ELEVATIONS, alpha * alpha, &cosine, &weight);
            view_at(h, cosine, 2 * M_PI * (j + .5) / N_AZIMUTHS);
            const double vh = vec3_dot(h, s->v);
            if (vh <= 0)
                continue;
            const double l[3] = { 2 * vh * h[0] - s->v[0], 2 * vh * h[1] - s->v[1], 2 * vh * h[2] - s->v[2] };
            disney_eval(&s->m, &s->frame, l, s->v, f);
            sum += f[0] * fmax(l[2], 0) * 4 * vh * weight;
        }
    return sum * 2 * M_PI / (N_ELEVATIONS * (double)N_AZIMUTHS);
}

static double albedo_by_directions(const struct scene *s)
{
    double sum = 0;
    for (int i = 0; i < N_ELEVATIONS; i++)
        for (int j = 0; j < N_AZIMUTHS; j++) {
            const double nl = (i + .5) / N_ELEVATIONS;
            double l[3], f[3];
            view_at(l, nl, 2 * M_PI * (j + .5) / N_AZIMUTHS);
            disney_eval(&s->m, &s->frame, l, s->v, f);
            sum += f[0] * nl;
        }
    return sum * 2 * M_PI / (N_ELEVATIONS * (double)N_AZIMUTHS);
}

static struct scene white_scene(void)
{
    struct scene s = upright_scene();
    s.m.albedo[0] = s.m.albedo[1] = s.m.albedo[2] = 1;
    return s;
}

// Seen along n, Fd = 1 + (r(1+nl) - 1/2)(1-nl)^5, so its albedo is 1 + (2r-1)/42 + r/84.
static void diffuse_energy_is_the_closed_form_and_reported(void **state)
{
    (void)state;
    printf("# albedo of the diffuse lobe (specular 0, base colour 1) at nv = 1, .7, .4, .15, .05; above 1 is Burley's retro-reflection\n");
    for (int subsurface = 0; subsurface <= 1; subsurface++)
        for (double r = 0; r <= 1; r += .25) {
            struct scene s = white_scene();
            s.m.theta[DISNEY_ROUGHNESS] = r, s.m.theta[DISNEY_SUBSURFACE] = subsurface;
            printf("#   subsurface %d roughness %.2f:", subsurface, r);
            for (int i = 0; i < N_VIEWS; i++) {
                view_at(s.v, view_nv[i], 0);
                // The specular lobe of F0 = 0 still reflects S(lh): a grazing view has it. Away with it by a difference in albedo:
                // f is C base + rest.
                struct scene half = s;
                half.m.albedo[0] = half.m.albedo[1] = half.m.albedo[2] = .5;
                const double albedo = 2 * (albedo_by_directions(&s) - albedo_by_directions(&half));
                printf(" %.4f", albedo);
                if (i == 0 && !subsurface)
                    assert_true(fabs(albedo - (1 + (2 * r - 1) / 42 + r / 84)) < 1e-5);
                if (r == 0 && !subsurface) // no retro-reflection: the Fresnel factors only take away
                    assert_true(albedo < 1);
            }
            putchar('\n');
        }
}

// White metal is F = 1: f = G D with single scattering, which can only lose light.
static void white_metal_reflects_at_most_what_arrives(void **state)
{
    (void)state;
    printf("# albedo of white metal at nv = 1, .7, .4, .15, .05 (white furnace; the rest is multiple scattering, not in the model)\n");
    for (int anisotropic = 0; anisotropic <= 1; anisotropic++)
        for (double r = .25; r <= 1; r += .25) {
            struct scene s = white_scene();
            s.m.theta[DISNEY_METALLIC] = 1, s.m.theta[DISNEY_ROUGHNESS] = r, s.m.theta[DISNEY_ANISOTROPIC] = anisotropic * .5;
            printf("#   anisotropic %.1f roughness %.2f:", anisotropic * .5, r);
            for (int i = 0; i < N_VIEWS; i++) {
                view_at(s.v, view_nv[i], .5);
                const double albedo = albedo_by_half_vectors(&s, r * r);
                printf(" %.4f", albedo);
                assert_true(albedo < 1 + 1e-4);
                // alpha = 1 is Lambert's D = 1/pi with g = 1/(1+cos): along n, the integral of nl/(1+nl) is 1 - ln 2.
                if (r == 1 && i == 0 && !anisotropic)
                    assert_true(fabs(albedo - (1 - log(2))) < 1e-4);
            }
            putchar('\n');
        }
}

// D is read off at l = v = h, where F = C for a metal: D = f / g(h)^2. It integrates to 1 over projected area, and (Smith) to
// nv/G1(v) over the area projected towards any v, G1 = 2 nv g(v). The same first law holds for clearcoat's D.
static void facets_fill_the_surface_from_every_side(void **state)
{
    (void)state;
    for (int which = 0; which < 4; which++) {
        struct scene s = white_scene();
        const double r = which == 1 ? .3 : .7;
        s.m.theta[DISNEY_METALLIC] = 1, s.m.theta[DISNEY_ROUGHNESS] = r;
        s.m.theta[DISNEY_ANISOTROPIC] = which == 2 ? .8 : 0;
        const bool coat = which == 3;
        if (coat) {
            s.m.albedo[0] = s.m.albedo[1] = s.m.albedo[2] = 0;
            s.m.theta[DISNEY_CLEARCOAT] = 1, s.m.theta[DISNEY_CLEARCOAT_GLOSS] = .2;
        }
        const double aspect = sqrt(1 - .9 * s.m.theta[DISNEY_ANISOTROPIC]);
        const double ax = coat ? .0802 : r * r / aspect, ay = coat ? .0802 : r * r * aspect;
        double area = 0, towards[N_VIEWS] = { 0 };
        const int n_elevations = 4 * N_ELEVATIONS;
        for (int i = 0; i < n_elevations; i++)
            for (int j = 0; j < N_AZIMUTHS; j++) {
                // Points where the lobe is, by inverting its distribution; weight = |d cosine / du|.
                const double u = (i + .5) / n_elevations, phi = 2 * M_PI * (j + .5) / N_AZIMUTHS;
                double cosine, weight;
                if (coat) {
                    const double a2 = ax * ax, power = pow(a2, 1 - u);
                    cosine = sqrt((1 - power) / (1 - a2));
                    weight = -log(a2) * power / (1 - a2) / (2 * cosine);
                } else {
                    lobe_point(u, ax * ay, &cosine, &weight);
                }
                double h[3], f[3];
                view_at(h, cosine, phi);
                disney_eval(&s.m, &s.frame, h, h, f);
                const double smith = coat ? sqrt(.0625 + .9375 * h[2] * h[2])
                                          : sqrt(h[0] * h[0] * ax * ax + h[1] * h[1] * ay * ay + h[2] * h[2]);
                const double g = 1 / (h[2] + smith), d = f[0] / (g * g * (coat ? .25 * .04 : 1));
                area += d * h[2] * weight;
                for (int k = 0; k < N_VIEWS; k++) {
                    double v[3];
                    view_at(v, view_nv[k], .3);
                    towards[k] += d * fmax(vec3_dot(v, h), 0) * weight;
                }
            }
        const double unit = 2 * M_PI / (n_elevations * (double)N_AZIMUTHS);
        assert_true(fabs(area * unit - 1) < 1e-3);
        for (int k = 0; !coat && k < N_VIEWS; k++) {
            double v[3];
            view_at(v, view_nv[k], .3);
            const double g = 1 / (v[2] + sqrt(v[0] * v[0] * ax * ax + v[1] * v[1] * ay * ay + v[2] * v[2]));
            assert_true(fabs(2 * g * towards[k] * unit - 1) < 1e-3);
        }
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(reference_cases_are_reproduced),
        cmocka_unit_test(normal_incidence_has_a_closed_form),
        cmocka_unit_test(swapping_light_and_view_changes_nothing),
        cmocka_unit_test(turning_the_whole_scene_changes_nothing),
        cmocka_unit_test(nothing_comes_from_or_goes_below_the_horizon),
        cmocka_unit_test(derivatives_are_those_of_the_values),
        cmocka_unit_test(clamps_and_grey_kill_their_derivatives),
        cmocka_unit_test(black_albedo_is_finite_and_untinted),
        cmocka_unit_test(diffuse_energy_is_the_closed_form_and_reported),
        cmocka_unit_test(white_metal_reflects_at_most_what_arrives),
        cmocka_unit_test(facets_fill_the_surface_from_every_side),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
