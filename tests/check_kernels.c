// tests/check_kernels.c - every float kernel of this CPU against the double formulas, on random and on hard inputs.
//
// Errors are relative to the light that could arrive, sum V_i c_i of the channel, or to the sample's largest true entry where a lobe
// makes that larger (a mirror gives 1e5 times what arrives, and float has 7 digits). Prints errors and times as TAP diagnostics.
#include "solver/kernels/kernels.h"
#include "solver/random.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <cmocka.h>

static const char *const names[] = { "reference", "portable", "avx2", "avx512" };
enum { N_NAMES = sizeof(names) / sizeof(names[0]) };
enum { N_VALUES = sizeof(struct shade_jacobian) / sizeof(float) };
static const double max_bound = 1e-4, rms_bound = 1e-6;

enum kind {
    PLAIN, NEAR_FIELD, SOFT, HIDDEN, GRAZING_LIGHTS, GRAZING_VIEW, MIRROR, SHARP_MIRROR, CORNERS, BLACK, AT_HORIZON, BEHIND, MANY,
    N_KINDS
};
static const char *const kind_names[N_KINDS] = {
    "plain", "near field", "soft", "hidden", "grazing lights", "grazing view", "mirror", "sharp mirror", "0/1 parameters",
    "black", "at the horizon", "behind", "many lights",
};

struct setup_truth {
    double *inverse_distance[3], centre[3][3], rotation[3][3];
};

struct scene {
    int n;
    struct light_arrays lights;
    struct lit lit;
    uint16_t *visible;
    uint8_t *soft;
    struct surface_point surface;
    struct shade_material material;
    float v[3];
    double truth[N_VALUES], irradiance[3], arriving[3], scale; // of brute force too, unless something is hidden
    struct setup_truth shade_setup, irradiance_setup;
};

static uint64_t seed, draws;

static double uniform(void)
{
    return random_uniform(seed, 1, draws++);
}

static void random_unit(double d[3])
{
    for (int c = 0; c < 3; c++)
        d[c] = random_normal(seed, 2, draws++);
    vec3_normalise(d);
}

static int channel_of(int value)
{
    enum { THETA = 3, ALBEDO = THETA + 3 * DISNEY_N, OWN = ALBEDO + 9 };
    return value < THETA ? value : value < ALBEDO ? (value - THETA) / DISNEY_N : value < OWN ? (value - ALBEDO) / 3 : value - OWN;
}

// By u and d, as they stand: G = dL/du through l and g, H = dL/dd through g alone; u = d + q e, and w moves d by w x d.
static void add_setup(struct setup_truth *t, int i, int c, const double u[3], const double d[3], double q, const double e[3], double VC,
                      double F, const double F_l[3])
{
    const double length = vec3_norm(u), ud = vec3_dot(u, d), r3 = pow(length, -3);
    double l[3], G[3], GH[3], turn[3];
    memcpy(l, u, sizeof(l));
    vec3_normalise(l);
    for (int j = 0; j < 3; j++) {
        const double g_u = d[j] * r3 - 3 * ud * u[j] * r3 / (length * length);
        G[j] = VC * (g_u * F + ud * r3 * (F_l[j] - vec3_dot(F_l, l) * l[j]) / length);
        GH[j] = G[j] + VC * F * u[j] * r3;
    }
    t->inverse_distance[c][i] = vec3_dot(G, e);
    vec3_add_scaled(t->centre[c], t->centre[c], q, G);
    vec3_cross(turn, d, GH);
    vec3_add_scaled(t->rotation[c], t->rotation[c], 1, turn);
}

static double share_of(const struct scene *s, int i, bool soft)
{
    const double bit = s->visible ? s->visible[i / 16] >> i % 16 & 1 : 1;
    return soft && s->soft ? bit * s->soft[i] / 255. : bit;
}

static double channel_colour(const struct light_arrays *a, int i, int c)
{
    return (double)(c == 0 ? a->cr : c == 1 ? a->cg : a->cb)[i];
}

// Eqs. 1-5 of the floats that the kernels are given, in double.
static void find_truth(struct scene *s)
{
    struct disney m = { .variant = s->material.variant };
    struct disney_frame frame;
    double v[3];
    for (int i = 0; i < DISNEY_N; i++)
        m.theta[i] = (double)s->material.theta[i];
    for (int c = 0; c < 3; c++) {
        m.albedo[c] = (double)s->material.albedo[c], v[c] = (double)s->v[c];
        frame.n[c] = (double)s->surface.normal[c], frame.x[c] = (double)s->surface.tangent[c];
        frame.y[c] = (double)s->surface.bitangent[c];
    }
    const struct light_arrays *a = &s->lights;
    for (int i = 0; i < s->n; i++) {
        const double d[3] = { (double)a->dx[i], (double)a->dy[i], (double)a->dz[i] };
        const double colour[3] = { (double)a->cr[i], (double)a->cg[i], (double)a->cb[i] };
        double l[3], e[3], u[3];
        for (int c = 0; c < 3; c++) {
            e[c] = (double)a->centre_m[c] - (double)s->surface.position_m[c];
            l[c] = u[c] = d[c] + (double)a->q[i] * e[c];
        }
        const double facing = vec3_dot(l, d), length = vec3_normalise(l);
        const double bit = share_of(s, i, false);
        const double unshadowed = fmax(facing, 0) / (length * length * length), weight = share_of(s, i, true) * unshadowed;
        const double nl = fmax(vec3_dot(frame.n, l), 0);
        struct disney_gradient g;
        disney_eval_gradient(&m, &frame, l, v, &g);
        double values[N_VALUES]; // L, theta, albedo as in g; then own
        memcpy(values, &g, (N_VALUES - 3) * sizeof(double));
        // f scaled with all of C at once keeps its tint: sum_j C_j df_c/dC_j = C_c own_c.
        for (int c = 0; c < 3; c++)
            values[N_VALUES - 3 + c] = m.albedo[c] > 0 ? vec3_dot(g.albedo[c], m.albedo) / m.albedo[c] : g.albedo[c][c];
        for (int j = 0; j < N_VALUES; j++)
            s->truth[j] += values[j] * nl * weight * colour[channel_of(j)];
        for (int c = 0; c < 3; c++) {
            s->arriving[c] += unshadowed * colour[c];
            s->irradiance[c] += nl * bit * unshadowed * colour[c]; // irradiance() knows bits only
        }
        for (int c = 0; c < 3 && nl > 0 && facing > 0; c++) {
            double F_l[3];
            for (int j = 0; j < 3; j++)
                F_l[j] = nl * g.light[c][j] + g.f[c] * frame.n[j];
            if (vec3_dot(frame.n, v) > 0)
                add_setup(&s->shade_setup, i, c, u, d, (double)a->q[i], e, share_of(s, i, true) * colour[c], nl * g.f[c], F_l);
            add_setup(&s->irradiance_setup, i, c, u, d, (double)a->q[i], e, bit * colour[c], nl, frame.n);
        }
    }
    for (int j = 0; j < N_VALUES; j++)
        s->scale = fmax(s->scale, fabs(s->truth[j]));
}

static void make_scene(struct scene *s, enum kind kind, uint64_t id)
{
    *s = (struct scene){ 0 };
    seed = id, draws = 0;
    static const int few[] = { 1, 2, 7, 8, 9, 15, 16, 17, 33, 100, 256, 300 };
    const size_t count = kind == MANY ? 20000 + id % 16 : (size_t)few[id % 12];
    s->n = (int)count;
    const double near = kind == PLAIN || kind == SHARP_MIRROR ? 0 : .6;
    struct lights lights = { .n = s->n, .dir_probe = calloc(count, sizeof(*lights.dir_probe)),
                             .irradiance = calloc(count, sizeof(*lights.irradiance)),
                             .inverse_distance = calloc(count, sizeof(double)) };
    double n[3], x[3], y[3], v[3], w[3];
    random_unit(w);
    mat3_from_rotation_vector(lights.world_from_probe, w);
    random_unit(n), random_unit(x);
    vec3_add_scaled(x, x, -vec3_dot(x, n), n);
    vec3_normalise(x);
    vec3_cross(y, n, x);
    for (int c = 0; c < 3 && id % 7 == 3; c++)
        y[c] = -y[c]; // a mirrored texture
    do
        random_unit(v);
    while (vec3_dot(v, n) < .05);
    if (kind == GRAZING_VIEW) { // nv from 1e-6 to .1
        vec3_add_scaled(v, v, -vec3_dot(v, n) + pow(10, -1 - 5 * uniform()), n);
        vec3_normalise(v);
    }
    double roughness = .05 + .95 * uniform();
    if (kind == MIRROR || kind == SHARP_MIRROR)
        roughness = kind == MIRROR ? .032 + .2 * uniform() : .06 * uniform();
    for (int i = 0; i < DISNEY_N; i++)
        s->material.theta[i] = (float)(kind == CORNERS ? uniform() < .5 : uniform());
    if (kind != CORNERS)
        s->material.theta[DISNEY_ROUGHNESS] = (float)roughness;
    for (int c = 0; c < 3; c++) {
        s->material.albedo[c] = kind == BLACK ? 0 : (float)uniform();
        s->surface.normal[c] = (float)n[c], s->surface.tangent[c] = (float)x[c], s->surface.bitangent[c] = (float)y[c];
        s->surface.position_m[c] = (float)(near * (uniform() - .5));
        lights.centre_m[c] = near * (uniform() - .5);
        s->v[c] = (float)v[c];
    }
    s->material.variant = id / 12 % 2 ? DISNEY_2012 : DISNEY_2017;
    for (int i = 0; i < s->n; i++) {
        double l[3];
        random_unit(l);
        const double nl = vec3_dot(l, n);
        if (kind == GRAZING_LIGHTS) // from 1e-6 to .1, either side
            vec3_add_scaled(l, l, -nl + (uniform() < .8 ? 1 : -1) * pow(10, -1 - 5 * uniform()), n);
        else if (kind == AT_HORIZON)
            vec3_add_scaled(l, l, -nl, n);
        else if (kind == BEHIND) // some of them exactly opposite n
            for (int c = 0; c < 3; c++)
                l[c] = i % 3 ? l[c] - (nl > 0 ? 2 * nl : 0) * n[c] : -n[c];
        else if ((kind == MIRROR || kind == SHARP_MIRROR) && i % 2 == 0) { // within a few alpha of the mirror direction
            const double alpha = fmax(.001, roughness * roughness);
            double h[3] = { n[0], n[1], n[2] };
            vec3_add_scaled(h, h, alpha * random_normal(seed, 3, draws++), x);
            vec3_add_scaled(h, h, alpha * random_normal(seed, 3, draws++), y);
            vec3_normalise(h);
            const double vh = vec3_dot(v, h);
            for (int c = 0; c < 3; c++)
                l[c] = 2 * vh * h[c] - v[c];
        }
        vec3_normalise(l);
        mat3_tmul_vec(lights.dir_probe[i], lights.world_from_probe, l);
        for (int c = 0; c < 3; c++)
            lights.irradiance[i][c] = i % 11 == 5 ? 0 : uniform() / s->n;
        lights.inverse_distance[i] = near > 0 && i % 5 ? 1.2 * uniform() : 0;
    }
    assert_int_equal(light_arrays_new(&s->lights, &lights), 0);
    assert_int_equal(lit_new(&s->lit, s->n), 0);
    free(lights.dir_probe);
    free(lights.irradiance);
    free(lights.inverse_distance);
    if (kind == SOFT || kind == HIDDEN) {
        s->visible = calloc((count + 15) / 16, sizeof(uint16_t));
        for (int i = 0; i < s->n; i++)
            s->visible[i / 16] |= (uint16_t)((uniform() < .6) << i % 16);
    }
    if (kind == SOFT) {
        s->soft = calloc(count, 1); // no byte more: reading beyond shows under ASan
        for (int i = 0; i < s->n; i++)
            s->soft[i] = (uint8_t)random_u64(seed, 4, draws++);
    }
    for (int c = 0; c < 3; c++) {
        s->shade_setup.inverse_distance[c] = calloc(count, sizeof(double));
        s->irradiance_setup.inverse_distance[c] = calloc(count, sizeof(double));
    }
    find_truth(s);
}

static void free_scene(struct scene *s)
{
    for (int c = 0; c < 3; c++) {
        free(s->shade_setup.inverse_distance[c]);
        free(s->irradiance_setup.inverse_distance[c]);
    }
    light_arrays_free(&s->lights);
    lit_free(&s->lit);
    free(s->visible);
    free(s->soft);
}

struct error {
    double max, squares;
    long n;
};

static void add_error(struct error *e, double difference, double scale)
{
    const double error = scale > 0 ? fabs(difference) / scale : fabs(difference);
    e->max = error > e->max || isnan(error) ? error : e->max;
    e->squares += error * error;
    e->n++;
}

static void assert_small(const struct error *e, const char *kernel, const char *function, enum kind kind)
{
    const double rms = sqrt(e->squares / (double)e->n);
    if (!(e->max <= max_bound && rms <= rms_bound))
        fail_msg("%s %s, %s: max %.3g (bound %g), RMS %.3g (bound %g)", kernel, function, kind_names[kind], e->max, max_bound,
                 rms, rms_bound);
}

// What a kernel writes; full of NaN at first.
static void setup_new(struct shade_setup *out, const struct light_arrays *a)
{
    memset(out, 0xff, sizeof(*out));
    for (int c = 0; c < 3; c++) {
        out->inverse_distance[c] = aligned_alloc(64, (size_t)a->n_padded * sizeof(float));
        memset(out->inverse_distance[c], 0xff, (size_t)a->n_padded * sizeof(float));
    }
}

static void setup_free(struct shade_setup *s)
{
    for (int c = 0; c < 3; c++)
        free(s->inverse_distance[c]);
}

static double largest(const double *x, int n, double least)
{
    for (int i = 0; i < n; i++)
        least = fmax(least, fabs(x[i]));
    return least;
}

// Each of the three kinds to its own largest entry, or to the arriving light.
static void add_setup_errors(struct error *e, const struct shade_setup *got, const struct setup_truth *truth, const struct scene *s)
{
    double by_q = 0;
    for (int c = 0; c < 3; c++)
        by_q = largest(truth->inverse_distance[c], s->n, by_q);
    for (int c = 0; c < 3; c++) {
        for (int i = 0; i < s->n; i++) {
            const double difference = (double)got->inverse_distance[c][i] - truth->inverse_distance[c][i];
            add_error(e, difference, fmax(s->arriving[c], by_q));
        }
        for (int i = s->n; i < s->lights.n_padded; i++)
            assert_true(got->inverse_distance[c][i] == 0);
        for (int j = 0; j < 3; j++) {
            add_error(e, (double)got->centre[c][j] - truth->centre[c][j], largest(truth->centre[0], 9, s->arriving[c]));
            add_error(e, (double)got->rotation[c][j] - truth->rotation[c][j], largest(truth->rotation[0], 9, s->arriving[c]));
        }
    }
}

enum function { SHADE, SHADE_JACOBIAN, BRUTE_JACOBIAN, IRRADIANCE, VIEWS, AFFINE, SETUP, IRRADIANCE_SETUP, N_FUNCTIONS };
static const char *const function_names[N_FUNCTIONS] = { "shade", "shade_jacobian", "brute_jacobian", "irradiance",
                                                           "shade_views", "shade_affine", "shade_setup", "irrad._setup" };

// A light at the horizon is a kink of L, where rounding chooses the side: no derivative to compare.
static void add_scene_setup(struct error errors[N_FUNCTIONS], const struct kernels *k, const struct scene *s,
                            const struct shade_jacobian *expected, bool at_horizon)
{
    struct shade_setup setup;
    struct shade_jacobian j;
    float E[3];
    setup_new(&setup, &s->lights);
    memset(&j, 0xff, sizeof(j));
    k->shade_setup(&j, &setup, &s->lit, &s->lights, &s->surface, s->v, &s->material);
    assert_memory_equal(&j, expected, sizeof(j));
    if (!at_horizon)
        add_setup_errors(&errors[SETUP], &setup, &s->shade_setup, s);
    setup_free(&setup);
    setup_new(&setup, &s->lights);
    k->irradiance_setup(E, &setup, &s->lights, &s->surface, s->visible);
    for (int c = 0; c < 3; c++)
        add_error(&errors[IRRADIANCE_SETUP], (double)E[c] - s->irradiance[c], s->arriving[c]);
    if (!at_horizon)
        add_setup_errors(&errors[IRRADIANCE_SETUP], &setup, &s->irradiance_setup, s);
    setup_free(&setup);
}

static void add_scene(struct error errors[N_FUNCTIONS], const struct kernels *k, struct scene *s, enum kind kind)
{
    union {
        struct shade_jacobian j;
        float values[N_VALUES];
    } shared, brute, views[3];
    float L[3], E[3], constant[3], own[3];
    memset(&shared, 0xff, sizeof(shared)), memset(&brute, 0xff, sizeof(brute));
    k->gather(&s->lit, &s->lights, &s->surface, s->visible, s->soft);
    k->shade(L, &s->lit, &s->surface, s->v, &s->material);
    k->shade_jacobian(&shared.j, &s->lit, &s->surface, s->v, &s->material);
    // The middle one of three views, the last of them below the horizon.
    const float v3[3][3] = { { s->surface.normal[0], s->surface.normal[1], s->surface.normal[2] },
                             { s->v[0], s->v[1], s->v[2] },
                             { -s->v[0], -s->v[1], -s->v[2] } };
    memset(views, 0xff, sizeof(views));
    k->shade_jacobian_views(&views[0].j, 3, &s->lit, &s->surface, v3, &s->material);
    k->irradiance(E, &s->lights, &s->surface, s->visible);
    k->shade_affine(constant, own, &s->lit, &s->surface, s->v, &s->material);
    for (int c = 0; c < 3; c++) {
        const double true_own = s->truth[N_VALUES - 3 + c], L_c = s->truth[c];
        const double scale = fmax(s->arriving[c], fmax(true_own, L_c));
        add_error(&errors[AFFINE], (double)own[c] - true_own, scale);
        add_error(&errors[AFFINE], (double)constant[c] - (L_c - true_own * (double)s->material.albedo[c]), scale);
    }
    add_scene_setup(errors, k, s, &shared.j, kind == AT_HORIZON);
    const bool whole = !s->visible && !s->soft; // brute force knows no visibility
    if (whole)
        k->brute_jacobian(&brute.j, &s->lights, &s->surface, s->v, &s->material);
    for (int j = 0; j < N_VALUES; j++) {
        const double scale = fmax(s->arriving[channel_of(j)], s->scale);
        add_error(&errors[SHADE_JACOBIAN], (double)shared.values[j] - s->truth[j], scale);
        add_error(&errors[VIEWS], (double)views[1].values[j] - s->truth[j], scale);
        assert_true(views[2].values[j] == 0);
        if (whole)
            add_error(&errors[BRUTE_JACOBIAN], (double)brute.values[j] - s->truth[j], scale);
        if (j < 3)
            add_error(&errors[SHADE], (double)L[j] - s->truth[j], fmax(s->arriving[j], s->truth[j]));
        if (j < 3)
            add_error(&errors[IRRADIANCE], (double)E[j] - s->irradiance[j], s->arriving[j]);
    }
}

static void every_kernel_is_right_on_hard_inputs(void **state)
{
    (void)state;
    for (int k = 0; k < N_NAMES; k++) {
        const struct kernels *kernels = kernels_by_name(names[k]);
        if (!kernels) {
            printf("# %s: not on this CPU\n", names[k]);
            continue;
        }
        assert_string_equal(kernels->name, names[k]);
        struct error all[N_FUNCTIONS] = { 0 };
        for (int kind = 0; kind < N_KINDS; kind++) {
            struct error errors[N_FUNCTIONS] = { 0 };
            for (uint64_t id = 0; id < (kind == MANY ? 2 : 120); id++) {
                struct scene s;
                make_scene(&s, (enum kind)kind, 1000 * (uint64_t)kind + id);
                add_scene(errors, kernels, &s, (enum kind)kind);
                free_scene(&s);
            }
            for (int f = 0; f < N_FUNCTIONS; f++) {
                if (errors[f].n)
                    assert_small(&errors[f], names[k], function_names[f], (enum kind)kind);
                all[f].max = fmax(all[f].max, errors[f].max);
                all[f].squares += errors[f].squares, all[f].n += errors[f].n;
            }
        }
        for (int f = 0; f < N_FUNCTIONS; f++)
            printf("# %-9s %-14s max %.2g RMS %.2g\n", names[k], function_names[f], all[f].max,
                   sqrt(all[f].squares / (double)all[f].n));
    }
}

// Eqs. 1-5 once more, for light i of a set-up that has moved: L and E of this light.
static void moved_light(double out[6], const struct scene *s, int i, const double move_m[3], const double w[3], double more_q)
{
    const struct light_arrays *a = &s->lights;
    const double d0[3] = { (double)a->dx[i], (double)a->dy[i], (double)a->dz[i] }, q = (double)a->q[i] + more_q;
    struct disney m = { .variant = s->material.variant };
    struct disney_frame frame;
    double R[9], d[3], u[3], v[3], f[3];
    for (int k = 0; k < DISNEY_N; k++)
        m.theta[k] = (double)s->material.theta[k];
    mat3_from_rotation_vector(R, w);
    mat3_mul_vec(d, R, d0);
    for (int c = 0; c < 3; c++) {
        m.albedo[c] = (double)s->material.albedo[c], v[c] = (double)s->v[c];
        frame.n[c] = (double)s->surface.normal[c], frame.x[c] = (double)s->surface.tangent[c];
        frame.y[c] = (double)s->surface.bitangent[c];
        u[c] = d[c] + q * ((double)a->centre_m[c] + move_m[c] - (double)s->surface.position_m[c]);
    }
    const double facing = fmax(vec3_dot(u, d), 0), length = vec3_normalise(u), nl = fmax(vec3_dot(frame.n, u), 0);
    disney_eval(&m, &frame, u, v, f);
    for (int c = 0; c < 3; c++) {
        const double irradiance = facing / (length * length * length) * nl * channel_colour(a, i, c);
        out[c] = irradiance * share_of(s, i, true) * f[c], out[3 + c] = irradiance * share_of(s, i, false);
    }
}

// Central differences of double precision by all of the set-up's numbers.
static void the_reference_is_the_slope_when_the_setup_moves(void **state)
{
    (void)state;
    static const enum kind kinds[] = { PLAIN, NEAR_FIELD, SOFT, GRAZING_VIEW, MIRROR, SHARP_MIRROR, CORNERS, BLACK };
    const struct kernels *k = kernels_by_name("reference");
    const double step = 1e-7, bound = 1e-5;
    double worst = 0;
    for (size_t kind = 0; kind < sizeof(kinds) / sizeof(kinds[0]); kind++)
        for (uint64_t id = 0; id < 24; id++) {
            struct scene s;
            struct shade_setup setup[2];
            struct shade_jacobian j;
            float E[3];
            make_scene(&s, kinds[kind], 110000 + 100 * kind + id);
            setup_new(&setup[0], &s.lights), setup_new(&setup[1], &s.lights);
            k->gather(&s.lit, &s.lights, &s.surface, s.visible, s.soft);
            k->shade_setup(&j, &setup[0], &s.lit, &s.lights, &s.surface, s.v, &s.material);
            k->irradiance_setup(E, &setup[1], &s.lights, &s.surface, s.visible);
            double slope[6][6] = { { 0 } }; // [centre, rotation][L, E]
            double difference[2] = { 0 }, scale[2] = { 0 };
            for (int i = 0; i < s.n; i++)
                for (int p = 0; p < 7; p++) {
                    double out[2][6];
                    for (int side = 0; side < 2; side++) {
                        double moved[7] = { 0 };
                        moved[p] = side ? step : -step;
                        moved_light(out[side], &s, i, moved, moved + 3, moved[6]);
                    }
                    for (int c = 0; c < 6; c++) {
                        const double by_p = (out[1][c] - out[0][c]) / (2 * step);
                        if (p < 6) {
                            slope[p][c] += by_p;
                            continue;
                        }
                        const double got = (double)setup[c / 3].inverse_distance[c % 3][i];
                        difference[c / 3] = fmax(difference[c / 3], fabs(got - by_p)), scale[c / 3] = fmax(scale[c / 3], fabs(by_p));
                    }
                }
            for (int of = 0; of < 2; of++) {
                assert_true(difference[of] <= bound * scale[of]);
                worst = fmax(worst, scale[of] > 0 ? difference[of] / scale[of] : 0);
                for (int first = 0; first < 6; first += 3) { // centre, rotation
                    double most = 0, off = 0;
                    for (int p = first; p < first + 3; p++)
                        for (int c = 0; c < 3; c++) {
                            const double want = slope[p][3 * of + c];
                            const double got = (double)(first ? setup[of].rotation : setup[of].centre)[c][p - first];
                            most = fmax(most, fabs(want)), off = fmax(off, fabs(got - want));
                        }
                    assert_true(off <= bound * most);
                    worst = fmax(worst, most > 0 ? off / most : 0);
                }
            }
            setup_free(&setup[0]), setup_free(&setup[1]);
            free_scene(&s);
        }
    printf("# reference against central differences: max %.2g of the largest of the kind\n", worst);
}

// What a solve meets: hundreds of lights, roughness from .3 up. Here the arriving light alone is the scale.
static void ordinary_samples_are_right_to_the_arriving_light(void **state)
{
    (void)state;
    for (int k = 0; k < N_NAMES; k++) {
        const struct kernels *kernels = kernels_by_name(names[k]);
        struct error error = { 0 };
        for (uint64_t id = 0; kernels && id < 200; id++) {
            struct scene s;
            make_scene(&s, NEAR_FIELD, 50000 + 12 * id + 10); // 256 lights
            s.material.theta[DISNEY_ROUGHNESS] = (float)(.3 + .7 * uniform());
            memset(s.truth, 0, sizeof(s.truth)), memset(s.arriving, 0, sizeof(s.arriving));
            find_truth(&s);
            union {
                struct shade_jacobian j;
                float values[N_VALUES];
            } out;
            kernels->gather(&s.lit, &s.lights, &s.surface, NULL, NULL);
            kernels->shade_jacobian(&out.j, &s.lit, &s.surface, s.v, &s.material);
            for (int j = 0; j < N_VALUES; j++)
                add_error(&error, (double)out.values[j] - s.truth[j], s.arriving[channel_of(j)]);
            free_scene(&s);
        }
        if (kernels) {
            printf("# %-9s to the arriving light: max %.2g RMS %.2g\n", names[k], error.max, sqrt(error.squares / (double)error.n));
            assert_small(&error, names[k], "shade_jacobian", NEAR_FIELD);
        }
    }
}

static void what_one_kernel_gathers_another_may_shade(void **state)
{
    (void)state;
    for (int from = 0; from < N_NAMES; from++)
        for (int to = 0; to < N_NAMES; to++) {
            const struct kernels *a = kernels_by_name(names[from]), *b = kernels_by_name(names[to]);
            for (uint64_t id = 0; a && b && id < 24; id++) {
                struct scene s;
                float L[3];
                make_scene(&s, SOFT, 70000 + id);
                a->gather(&s.lit, &s.lights, &s.surface, s.visible, s.soft);
                b->shade(L, &s.lit, &s.surface, s.v, &s.material);
                for (int c = 0; c < 3; c++)
                    assert_true(fabs((double)L[c] - s.truth[c]) <= max_bound * fmax(s.arriving[c], s.truth[c]));
                struct shade_setup setup;
                struct shade_jacobian j;
                struct error error = { 0 };
                setup_new(&setup, &s.lights);
                b->shade_setup(&j, &setup, &s.lit, &s.lights, &s.surface, s.v, &s.material);
                add_setup_errors(&error, &setup, &s.shade_setup, &s);
                assert_true(error.max <= max_bound);
                setup_free(&setup);
                free_scene(&s);
            }
        }
}

static void only_lights_that_arrive_are_kept(void **state)
{
    (void)state;
    for (int k = 0; k < N_NAMES; k++) {
        const struct kernels *kernels = kernels_by_name(names[k]);
        for (uint64_t id = 0; kernels && id < 120; id++) {
            struct scene s;
            make_scene(&s, HIDDEN, 80000 + id);
            kernels->gather(&s.lit, &s.lights, &s.surface, s.visible, NULL);
            int expected = 0;
            const int32_t *index = s.lit.index;
            for (int i = 0; i < s.n; i++) {
                const struct light_arrays *a = &s.lights;
                const double d[3] = { (double)a->dx[i], (double)a->dy[i], (double)a->dz[i] };
                double u[3], n[3];
                for (int c = 0; c < 3; c++) {
                    u[c] = d[c] + (double)a->q[i] * ((double)a->centre_m[c] - (double)s.surface.position_m[c]);
                    n[c] = (double)s.surface.normal[c];
                }
                if (vec3_dot(u, n) > 0 && vec3_dot(u, d) > 0 && (s.visible[i / 16] >> i % 16 & 1)) {
                    assert_true(expected < s.lit.n);
                    assert_int_equal(index[expected++], i);
                }
            }
            assert_int_equal(s.lit.n, expected);
            for (int i = 0; i < s.lit.n; i++)
                assert_true(s.lit.nl[i] > 0 && s.lit.wr[i] >= 0);
            for (int i = s.lit.n; i % KERNEL_WIDTH; i++)
                assert_true(s.lit.wr[i] == 0 && s.lit.wg[i] == 0 && s.lit.wb[i] == 0 && index[i] == 0);
            free_scene(&s);
        }
    }
}

static void a_view_from_below_sees_nothing(void **state)
{
    (void)state;
    for (int k = 0; k < N_NAMES; k++) {
        const struct kernels *kernels = kernels_by_name(names[k]);
        if (!kernels)
            continue;
        struct scene s;
        struct shade_jacobian j, zero = { 0 };
        float L[3] = { 1, 1, 1 };
        make_scene(&s, PLAIN, 90010);
        for (int c = 0; c < 3; c++)
            s.v[c] = -s.v[c];
        kernels->gather(&s.lit, &s.lights, &s.surface, NULL, NULL);
        kernels->shade(L, &s.lit, &s.surface, s.v, &s.material);
        assert_true(L[0] == 0 && L[1] == 0 && L[2] == 0);
        float constant[3] = { 1, 1, 1 }, own[3] = { 1, 1, 1 };
        kernels->shade_affine(constant, own, &s.lit, &s.surface, s.v, &s.material);
        for (int c = 0; c < 3; c++)
            assert_true(constant[c] == 0 && own[c] == 0);
        memset(&j, 0xff, sizeof(j));
        kernels->shade_jacobian(&j, &s.lit, &s.surface, s.v, &s.material);
        assert_memory_equal(&j, &zero, sizeof(j));
        memset(&j, 0xff, sizeof(j));
        kernels->brute_jacobian(&j, &s.lights, &s.surface, s.v, &s.material);
        assert_memory_equal(&j, &zero, sizeof(j));
        struct shade_setup setup;
        setup_new(&setup, &s.lights);
        memset(&j, 0xff, sizeof(j));
        kernels->shade_setup(&j, &setup, &s.lit, &s.lights, &s.surface, s.v, &s.material);
        assert_memory_equal(&j, &zero, sizeof(j));
        for (int c = 0; c < 3; c++)
            for (int i = 0; i < s.lights.n_padded; i++)
                assert_true(setup.inverse_distance[c][i] == 0 && setup.centre[c][i % 3] == 0 && setup.rotation[c][i % 3] == 0);
        setup_free(&setup);
        free_scene(&s);
    }
}

static void updated_lights_are_those_made_anew(void **state)
{
    (void)state;
    double direction[2][3] = { { 0, 0, 1 }, { .6, 0, .8 } }, irradiance[2][3] = { { 1, 2, 3 }, { 4, 5, 6 } };
    double inverse_distance[2] = { 0, .5 };
    struct lights lights = { .n = 2, .dir_probe = direction, .irradiance = irradiance, .inverse_distance = inverse_distance,
                             .world_from_probe = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
    struct light_arrays a, b;
    assert_int_equal(light_arrays_new(&a, &lights), 0);
    const double quarter_turn[9] = { 0, -1, 0, 1, 0, 0, 0, 0, 1 };
    memcpy(lights.world_from_probe, quarter_turn, sizeof(quarter_turn));
    lights.centre_m[1] = 2, inverse_distance[0] = .25;
    light_arrays_update(&a, &lights);
    assert_int_equal(light_arrays_new(&b, &lights), 0);
    assert_true(a.dy[1] == .6f && a.dz[1] == .8f && a.q[0] == .25f && a.centre_m[1] == 2 && a.cb[1] == 6);
    assert_int_equal(a.n_padded, KERNEL_WIDTH);
    assert_memory_equal(a.dx, b.dx, 7 * KERNEL_WIDTH * sizeof(float));
    light_arrays_free(&a);
    light_arrays_free(&b);
}

static void count_warnings(void *arg, enum log_level level, const char *message)
{
    *(int *)arg += level == LOG_WARNING && strstr(message, "RIGSOLVE_KERNEL") != NULL;
}

static void the_environment_chooses_the_kernel(void **state)
{
    (void)state;
    static const unsigned bits[] = { KERNELS_REFERENCE, KERNELS_PORTABLE, KERNELS_AVX2, KERNELS_AVX512 };
    int n_warnings = 0, best = 0;
    unsetenv("RIGSOLVE_KERNEL");
    for (int k = 0; k < N_NAMES; k++) {
        if (!kernels_by_name(names[k])) {
            assert_string_equal(kernels_select(bits[k])->name, "reference");
            continue;
        }
        best = k;
        assert_string_equal(kernels_select(bits[k])->name, names[k]);
        setenv("RIGSOLVE_KERNEL", names[k], 1);
        assert_string_equal(kernels_select(KERNELS_ALL)->name, names[k]);
        unsetenv("RIGSOLVE_KERNEL");
    }
    assert_string_equal(kernels_select(KERNELS_ALL)->name, names[best]);
    assert_null(kernels_by_name("sse"));
    log_set_hook(count_warnings, &n_warnings);
    setenv("RIGSOLVE_KERNEL", "abacus", 1);
    assert_string_equal(kernels_select(KERNELS_ALL)->name, names[best]);
    assert_int_equal(n_warnings, 1);
    unsetenv("RIGSOLVE_KERNEL");
    log_set_hook(NULL, NULL);
}

static double cpu_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// Not a test of speed: the figures stand beside the errors. `make bench` measures properly.
static void times_are_printed(void **state)
{
    (void)state;
    struct scene s;
    make_scene(&s, NEAR_FIELD, 10);
    assert_int_equal(s.n, 256);
    struct shade_setup setup;
    setup_new(&setup, &s.lights);
    for (int k = 0; k < N_NAMES; k++) {
        const struct kernels *kernels = kernels_by_name(names[k]);
        if (!kernels)
            continue;
        for (int f = 0; f < N_FUNCTIONS; f++) {
            const double begin = cpu_s();
            double spent = 0;
            long n = 0;
            struct shade_jacobian j;
            float L[3];
            kernels->gather(&s.lit, &s.lights, &s.surface, NULL, NULL);
            for (; spent < .01; n += s.n, spent = cpu_s() - begin)
                if (f == SHADE)
                    kernels->shade(L, &s.lit, &s.surface, s.v, &s.material);
                else if (f == SHADE_JACOBIAN)
                    kernels->shade_jacobian(&j, &s.lit, &s.surface, s.v, &s.material);
                else if (f == BRUTE_JACOBIAN)
                    kernels->brute_jacobian(&j, &s.lights, &s.surface, s.v, &s.material);
                else if (f == VIEWS)
                    kernels->shade_jacobian_views(&j, 1, &s.lit, &s.surface, &s.v, &s.material);
                else if (f == AFFINE)
                    kernels->shade_affine(j.L, j.own, &s.lit, &s.surface, s.v, &s.material);
                else if (f == SETUP)
                    kernels->shade_setup(&j, &setup, &s.lit, &s.lights, &s.surface, s.v, &s.material);
                else if (f == IRRADIANCE_SETUP)
                    kernels->irradiance_setup(L, &setup, &s.lights, &s.surface, NULL);
                else
                    kernels->irradiance(L, &s.lights, &s.surface, NULL);
            printf("# %-9s %-14s %.2f ns per sample and light\n", names[k], function_names[f], 1e9 * spent / (double)n);
            assert_true(n > 0);
        }
    }
    setup_free(&setup);
    free_scene(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(every_kernel_is_right_on_hard_inputs),
        cmocka_unit_test(the_reference_is_the_slope_when_the_setup_moves),
        cmocka_unit_test(ordinary_samples_are_right_to_the_arriving_light),
        cmocka_unit_test(what_one_kernel_gathers_another_may_shade),
        cmocka_unit_test(only_lights_that_arrive_are_kept),
        cmocka_unit_test(a_view_from_below_sees_nothing),
        cmocka_unit_test(updated_lights_are_those_made_anew),
        cmocka_unit_test(the_environment_chooses_the_kernel),
        cmocka_unit_test(times_are_printed),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
