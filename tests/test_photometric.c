// tests/test_photometric.c - E_photo, its elimination of the albedo and its normal equations, against Eqs. 1-6 as a plain double loop.
//
// A pebble, cameras around it, lights in its near field. The samples are made by hand from the double BRDF, and so are all
// references: residuals, the best albedo (bisection on the derivative), J (central differences), its projection.
#include "solver/photometric.h"
#include "solver/random.h"
#include "solver/shapes.h"
#include "solver/take/half.h"
#include "solver/vec3.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { TEXTURE = 24, N_VIEWS = 7, N_LIGHTS = 20, N_GROUPS = 9, WORDS = 2, N_UNKNOWNS = DISNEY_N + 9 + N_VIEWS + N_GROUPS,
       MOST_UNKNOWNS = DISNEY_N + 9 + N_VIEWS + N_LIGHTS + 1 };
// Kernels are float; what a row of J or a residual may be off by, relative to the column's and the residuals' norm.
static const double float_bound = 1e-5;

struct studio {
    struct mesh mesh;
    struct texels texels;
    struct samples samples;
    struct lights lights; // where they are in truth
    int32_t group[N_LIGHTS];
    uint16_t (*visible)[WORDS];
    struct photometric p;
    struct photometric_state truth;
};

static struct photometric_layout layout_of(const struct photometric *p)
{
    return photometric_layout_of(N_VIEWS, p->n_groups);
}

// ---- Eqs. 1-6 in double ------------------------------------------------------------------------------------------------

static bool in_use(const struct photometric *p, int texel, int64_t i)
{
    return texel % p->texel_step == 0 && (!p->use_view || p->use_view[p->samples->view[i]]) && (!p->weight || p->weight[i] > 0);
}

static double root_weight(const struct photometric *p, int64_t i)
{
    return p->weight ? sqrt((double)p->weight[i]) : 1;
}

static void radiance(const struct photometric *p, const struct photometric_state *s, int texel, int view, const double albedo[3],
                     double L[3])
{
    const struct texels *t = p->texels;
    struct disney m = { .variant = p->variant };
    struct disney_frame frame;
    double point[3], v[3];
    memcpy(m.theta, s->theta, sizeof(m.theta));
    memcpy(m.albedo, albedo, sizeof(m.albedo));
    for (int c = 0; c < 3; c++) {
        point[c] = (double)t->position_m[texel][c];
        frame.n[c] = (double)t->normal[texel][c], frame.x[c] = (double)t->tangent[texel][c];
        v[c] = p->samples->centre_m[view][c] - point[c];
        L[c] = 0;
    }
    vec3_cross(frame.y, frame.n, frame.x);
    vec3_normalise(v);
    for (int i = 0; i < s->lights.n; i++) {
        if (p->visible && !(p->visible[texel * p->words_per_texel + i / 16] >> i % 16 & 1))
            continue;
        struct light_at at;
        double f[3] = { albedo[0] / M_PI, albedo[1] / M_PI, albedo[2] / M_PI };
        light_at_point(&s->lights, i, point, &at);
        const double nl = fmax(vec3_dot(frame.n, at.l), 0);
        if (p->model == REFLECT_DISNEY)
            disney_eval(&m, &frame, at.l, v, f);
        for (int c = 0; c < 3; c++)
            L[c] += exp(s->log_gain[view]) * f[c] * nl * at.weight * s->lights.irradiance[i][c];
    }
    // Light from all around: its colour times the albedo, and what a dielectric's surface sends back of it (F0 = .08 specular).
    const double surface = p->model == REFLECT_DISNEY ? .08 * m.theta[DISNEY_SPECULAR] * (1 - m.theta[DISNEY_METALLIC]) : 0;
    for (int c = 0; p->indirect && c < 3; c++)
        L[c] += exp(s->log_gain[view]) * (double)p->indirect[texel][c] / M_PI * (albedo[c] + surface);
}

// L = constant + own * albedo at the tint of `tint`: a colour twice as bright has the same tint.
static void affine(const struct photometric *p, const struct photometric_state *s, int texel, int view, const double tint[3],
                   double constant[3], double own[3])
{
    double once[3], twice[3], L[3], L2[3];
    for (int c = 0; c < 3; c++)
        once[c] = fmax(tint[c], 1e-6), twice[c] = 2 * once[c];
    radiance(p, s, texel, view, once, L);
    radiance(p, s, texel, view, twice, L2);
    for (int c = 0; c < 3; c++)
        own[c] = (L2[c] - L[c]) / once[c], constant[c] = 2 * L[c] - L2[c];
}

static double observed(const struct photometric *p, int64_t i, int c)
{
    return (double)float_from_half(p->samples->radiance[i][c]);
}

static double one_sided(const struct photometric *p, int64_t i, double r)
{
    return p->samples->flags[i] & SAMPLE_CLIPPED && r > 0 ? 0 : r;
}

// Best albedo in [0, 1.5] of a texel with its tint held: where the derivative changes sign.
static void best_albedo(const struct photometric *p, const struct photometric_state *s, int texel, double albedo[3])
{
    const int64_t begin = p->samples->first[texel], end = p->samples->first[texel + 1];
    double constant[N_VIEWS][3], own[N_VIEWS][3], low[3] = { 0 }, high[3] = { 1.5, 1.5, 1.5 };
    int n = 0;
    for (int64_t i = begin; i < end; i++) {
        affine(p, s, texel, p->samples->view[i], albedo, constant[i - begin], own[i - begin]);
        n += in_use(p, texel, i);
    }
    for (int round = 0; n && round < 60; round++)
        for (int c = 0; c < 3; c++) {
            double slope = 0;
            const double a = .5 * (low[c] + high[c]);
            for (int64_t i = begin; i < end; i++)
                if (in_use(p, texel, i))
                    slope += pow(root_weight(p, i), 2) * own[i - begin][c] *
                             one_sided(p, i, constant[i - begin][c] + own[i - begin][c] * a - observed(p, i, c));
            *(slope > 0 ? &high[c] : &low[c]) = a;
        }
    for (int c = 0; n && c < 3; c++)
        albedo[c] = low[c] < 1e-12 ? 0 : high[c] > 1.5 - 1e-12 ? 1.5 : .5 * (low[c] + high[c]);
}

// The albedo of every texel as the mode has it. FREE starts from the state's, whose tint is held.
static double (*albedo_of(const struct photometric *p, const struct photometric_state *s))[3]
{
    double(*albedo)[3] = malloc((size_t)p->texels->n * sizeof(*albedo));
    assert_non_null(albedo);
    for (int t = 0; t < p->texels->n; t++) {
        for (int c = 0; c < 3; c++)
            albedo[t][c] = p->albedo == ALBEDO_SHARED ? s->shared_albedo[c] : (double)s->albedo[t][c];
        if (p->albedo == ALBEDO_FREE && t % p->texel_step == 0)
            best_albedo(p, s, t, albedo[t]);
    }
    return albedo;
}

// r[n_samples][3]: weighted residuals, 0 for samples not in use; the cost is returned.
static double residuals(const struct photometric *p, const struct photometric_state *s, double (*albedo)[3], double (*r)[3])
{
    double cost = 0;
    for (int t = 0; t < p->texels->n; t++)
        for (int64_t i = p->samples->first[t]; i < p->samples->first[t + 1]; i++) {
            double L[3] = { 0 };
            if (in_use(p, t, i))
                radiance(p, s, t, p->samples->view[i], albedo[t], L);
            for (int c = 0; c < 3; c++) {
                r[i][c] = in_use(p, t, i) ? root_weight(p, i) * one_sided(p, i, L[c] - observed(p, i, c)) : 0;
                cost += .5 * r[i][c] * r[i][c];
            }
        }
    return cost;
}

static double cost_of(const struct photometric *p, const struct photometric_state *s)
{
    double(*albedo)[3] = albedo_of(p, s), (*r)[3] = malloc((size_t)p->samples->n * sizeof(*r));
    assert_non_null(r);
    const double cost = residuals(p, s, albedo, r);
    free(albedo);
    free(r);
    return cost;
}

// ---- the studio --------------------------------------------------------------------------------------------------------

static double uniform(uint64_t stream, uint64_t index)
{
    return random_uniform(41, stream, index);
}

static void make_samples(struct studio *s)
{
    struct samples *m = &s->samples;
    const struct texels *t = &s->texels;
    const size_t most = (size_t)t->n * N_VIEWS;
    *m = (struct samples){ .n_texels = t->n, .n_views = N_VIEWS,
                           .first = calloc((size_t)t->n + 1, sizeof(*m->first)), .view = calloc(most, sizeof(*m->view)),
                           .radiance = calloc(most, sizeof(*m->radiance)), .gradient = calloc(most, sizeof(*m->gradient)),
                           .flags = calloc(most, 1), .centre_m = calloc(N_VIEWS, sizeof(*m->centre_m)),
                           .name = calloc(N_VIEWS, sizeof(*m->name)) };
    assert_true(m->first && m->view && m->radiance && m->gradient && m->flags && m->centre_m && m->name);
    for (int v = 0; v < N_VIEWS; v++) {
        const double angle = 2 * M_PI * v / N_VIEWS;
        m->centre_m[v][0] = .9 * cos(angle), m->centre_m[v][1] = .9 * sin(angle), m->centre_m[v][2] = v % 3 * .5 - .3;
    }
    for (int k = 0; k < t->n; k++) {
        for (int v = 0; v < N_VIEWS; v++) {
            float to_view[3];
            samples_view_direction(m, t, k, v, to_view);
            const float *n = t->normal[k];
            if (n[0] * to_view[0] + n[1] * to_view[1] + n[2] * to_view[2] > .2f)
                m->view[m->n++] = (uint16_t)v;
        }
        m->first[k + 1] = m->n;
    }
}

// What the cameras measure of the truth, a share `noise` off.
static void photograph(struct studio *s, double noise)
{
    for (int t = 0; t < s->texels.n; t++)
        for (int64_t i = s->samples.first[t]; i < s->samples.first[t + 1]; i++) {
            double L[3], albedo[3];
            for (int c = 0; c < 3; c++)
                albedo[c] = s->p.albedo == ALBEDO_SHARED ? s->truth.shared_albedo[c] : (double)s->truth.albedo[t][c];
            radiance(&s->p, &s->truth, t, s->samples.view[i], albedo, L);
            for (int c = 0; c < 3; c++)
                s->samples.radiance[i][c] =
                    half_from_float((float)(L[c] * (1 + noise * (2 * uniform(9, (uint64_t)(3 * i + c)) - 1))));
        }
}

static void studio_open(struct studio *s, enum reflectance model, enum albedo_mode albedo)
{
    memset(s, 0, sizeof(*s));
    assert_int_equal(shape_make(&s->mesh, SHAPE_PEBBLE, (const double[3]){ .02, -.01, .03 }, .15, 600), 0);
    assert_int_equal(texels_rasterise(&s->texels, &s->mesh, TEXTURE), 0);
    make_samples(s);
    assert_int_equal(lights_new(&s->lights, N_LIGHTS), 0);
    struct lights *l = &s->lights;
    for (int i = 0; i < N_LIGHTS; i++) {
        for (int c = 0; c < 3; c++) {
            l->dir_probe[i][c] = random_normal(41, 1, (uint64_t)(3 * i + c));
            l->irradiance[i][c] = .1 + .5 * uniform(2, (uint64_t)(3 * i + c));
        }
        vec3_normalise(l->dir_probe[i]);
        s->group[i] = i * N_GROUPS / N_LIGHTS;
        l->inverse_distance[i] = s->group[i] == 4 ? 0 : .4 + uniform(3, (uint64_t)s->group[i]);
    }
    l->centre_m[0] = .05, l->centre_m[1] = -.03, l->centre_m[2] = .02;
    mat3_from_rotation_vector(l->world_from_probe, (const double[3]){ .4, -.2, .7 });
    s->visible = malloc((size_t)s->texels.n * sizeof(*s->visible));
    assert_non_null(s->visible);
    for (int t = 0; t < s->texels.n; t++)
        for (int w = 0; w < WORDS; w++)
            s->visible[t][w] = (uint16_t)(random_u64(41, 4, (uint64_t)(WORDS * t + w)) | random_u64(41, 5, (uint64_t)(WORDS * t + w)));
    s->p = (struct photometric){ .texels = &s->texels, .samples = &s->samples, .model = model, .albedo = albedo,
                                 .group_of_light = s->group, .n_groups = N_GROUPS, .texel_step = 1,
                                 .visible = s->visible[0], .words_per_texel = WORDS, .n_threads = 2 };
    assert_int_equal(photometric_state_new(&s->truth, &s->p, l), 0);
    static const double theta[DISNEY_N] = { .15, .3, .6, .45, 0, .35, .4, 0, .5, .3 };
    memcpy(s->truth.theta, theta, sizeof(theta));
    for (int t = 0; t < s->texels.n; t++)
        for (int c = 0; c < 3; c++)
            s->truth.albedo[t][c] = (float)(.1 + .7 * uniform(6, (uint64_t)(3 * t + c)));
    s->truth.shared_albedo[0] = .3, s->truth.shared_albedo[1] = .5, s->truth.shared_albedo[2] = .2;
    for (int v = 0; v < N_VIEWS; v++)
        s->truth.log_gain[v] = .1 * (uniform(7, (uint64_t)v) - .5);
    photograph(s, 0);
}

static void studio_close(struct studio *s)
{
    photometric_state_free(&s->truth);
    lights_free(&s->lights);
    samples_free(&s->samples);
    texels_free(&s->texels);
    mesh_free(&s->mesh);
    free(s->visible);
}

static void new_copy(const struct studio *s, struct photometric_state *to, const struct photometric_state *from)
{
    assert_int_equal(photometric_state_new(to, &s->p, &from->lights), 0);
    photometric_state_copy(&s->p, to, from);
}

// A state away from the truth in every unknown that the model has.
static void wrong_state(const struct studio *s, struct photometric_state *to)
{
    const struct photometric_layout l = layout_of(&s->p);
    double x[MOST_UNKNOWNS];
    new_copy(s, to, &s->truth);
    photometric_pack(&s->p, to, x);
    for (int i = 0; i < l.n; i++) {
        const double off = 2 * uniform(8, (uint64_t)i) - 1;
        if (i == DISNEY_SPECULAR_TINT || i == DISNEY_SHEEN_TINT)
            continue;
        x[i] += (i < l.centre ? .1 : i < l.inverse_distance ? .04 : .15) * off;
    }
    if (s->p.n_groups > 4)
        x[l.inverse_distance + 4] = .1;
    photometric_unpack(&s->p, to, x);
    for (int t = 0; t < s->texels.n; t++)
        for (int c = 0; c < 3; c++)
            to->albedo[t][c] *= (float)(.8 + .4 * uniform(10, (uint64_t)(3 * t + c)));
}

static struct photometric_error evaluate(const struct photometric *p, struct photometric_state *s, bool fit)
{
    struct photometric_error e;
    assert_int_equal(photometric_evaluate(p, s, fit, &e), 0);
    return e;
}

static void close_to(double found, double expected, double bound)
{
    if (!(fabs(found - expected) <= bound))
        print_error("found %.9g, expected %.9g, bound %.3g\n", found, expected, bound);
    assert_true(fabs(found - expected) <= bound);
}

// ---- evaluation --------------------------------------------------------------------------------------------------------

static void truth_explains_all_but_the_rounding(enum reflectance model, enum albedo_mode albedo, enum disney_variant variant)
{
    struct studio s;
    studio_open(&s, model, albedo);
    s.p.variant = variant;
    photograph(&s, 0);
    struct photometric_error e = evaluate(&s.p, &s.truth, false);
    double bound = 0;
    for (int64_t i = 0; i < s.samples.n; i++)
        for (int c = 0; c < 3; c++)
            bound += pow(observed(&s.p, i, c) * 0x1p-11 + 1e-5, 2);
    assert_int_equal(e.n, s.samples.n);
    assert_true(e.n > 500);
    assert_true(2 * e.cost <= bound && e.squares <= bound);
    studio_close(&s);
}

static void true_states_leave_half_rounding_only(void **state)
{
    (void)state;
    truth_explains_all_but_the_rounding(REFLECT_DISNEY, ALBEDO_GIVEN, DISNEY_2017);
    truth_explains_all_but_the_rounding(REFLECT_DISNEY, ALBEDO_GIVEN, DISNEY_2012);
    truth_explains_all_but_the_rounding(REFLECT_DISNEY, ALBEDO_SHARED, DISNEY_2017);
    truth_explains_all_but_the_rounding(REFLECT_LAMBERT, ALBEDO_GIVEN, DISNEY_2017);
    truth_explains_all_but_the_rounding(REFLECT_LAMBERT, ALBEDO_SHARED, DISNEY_2017);
}

// cost, squares, n are Eq. 6's at any state, in every mode.
static void the_cost_is_eq_6s(void **state)
{
    (void)state;
    for (int model = REFLECT_DISNEY; model <= REFLECT_LAMBERT; model++)
        for (int albedo = ALBEDO_FREE; albedo <= ALBEDO_SHARED; albedo++) {
            struct studio s;
            struct photometric_state wrong;
            studio_open(&s, (enum reflectance)model, (enum albedo_mode)albedo);
            wrong_state(&s, &wrong);
            const double expected = cost_of(&s.p, &wrong);
            const struct photometric_error e = evaluate(&s.p, &wrong, true);
            close_to(e.cost, expected, float_bound * expected);
            assert_true(expected > 1e-3);
            double(*r)[3] = malloc((size_t)s.samples.n * sizeof(*r)), (*a)[3] = malloc((size_t)s.texels.n * sizeof(*a));
            assert_true(r && a);
            for (int t = 0; t < s.texels.n; t++)
                for (int c = 0; c < 3; c++)
                    a[t][c] = albedo == ALBEDO_SHARED ? wrong.shared_albedo[c] : (double)wrong.albedo[t][c];
            residuals(&s.p, &wrong, a, r);
            double squares = 0;
            for (int64_t i = 0; i < s.samples.n; i++)
                for (int c = 0; c < 3; c++) {
                    const double o = observed(&s.p, i, c);
                    squares += pow(fmin(r[i][c] + o, 1) - fmin(o, 1), 2);
                }
            close_to(e.squares, squares, float_bound * squares);
            close_to(photometric_rmse_percent(&e), 100 * sqrt(squares / (3 * (double)s.samples.n)), 1e-3);
            free(r);
            free(a);
            photometric_state_free(&wrong);
            studio_close(&s);
        }
}

static void albedo_comes_back(enum reflectance model, bool tinted)
{
    struct studio s;
    struct photometric_state start;
    studio_open(&s, model, ALBEDO_FREE);
    if (tinted)
        s.truth.theta[DISNEY_SPECULAR_TINT] = .7, s.truth.theta[DISNEY_SHEEN_TINT] = .6;
    photograph(&s, 0);
    new_copy(&s, &start, &s.truth);
    for (int t = 0; t < s.texels.n; t++)
        start.albedo[t][0] = .5f, start.albedo[t][1] = .4f, start.albedo[t][2] = .6f;
    double(*best)[3] = albedo_of(&s.p, &start), worst[8] = { 0 };
    const int n_rounds = tinted ? 8 : 1; // a tint is that of the last round's colour
    for (int t = 0; tinted && t < s.texels.n; t++)
        best_albedo(&s.p, &s.truth, t, best[t]); // an evaluation solves twice
    for (int round = 0; round < n_rounds; round++) {
        evaluate(&s.p, &start, true);
        for (int t = 0; round == 0 && t < s.texels.n; t++)
            for (int c = 0; c < 3; c++)
                close_to((double)start.albedo[t][c], best[t][c], 2e-5);
        for (int t = 0; t < s.texels.n; t++)
            for (int c = 0; c < 3; c++)
                if (s.samples.first[t + 1] > s.samples.first[t])
                    worst[round] = fmax(worst[round], fabs((double)(start.albedo[t][c] - s.truth.albedo[t][c])));
    }
    print_message("# %s, %s: albedo off by %.2g", model == REFLECT_LAMBERT ? "Lambert" : "Disney", tinted ? "tinted" : "no tint",
                  worst[0]);
    for (int round = 1; round < n_rounds; round++)
        print_message(", %.2g", worst[round]);
    print_message("\n");
    for (int t = 0; t < s.texels.n; t++)
        for (int c = 0; c < 3; c++) {
            const double true_albedo = (double)s.truth.albedo[t][c];
            if (s.samples.first[t + 1] == s.samples.first[t]) {
                assert_true(start.albedo[t][c] == (c == 0 ? .5f : c == 1 ? .4f : .6f)); // texels nobody saw keep theirs
                continue;
            }
            close_to((double)start.albedo[t][c], true_albedo, 2e-3); // radiances are half floats
        }
    free(best);
    photometric_state_free(&start);
    studio_close(&s);
}

static void free_albedo_finds_the_least_squares_one(void **state)
{
    (void)state;
    albedo_comes_back(REFLECT_LAMBERT, false);
    albedo_comes_back(REFLECT_DISNEY, false);
    albedo_comes_back(REFLECT_DISNEY, true);
}

// fit = false measures, and touches nothing.
static void measuring_leaves_the_albedo_alone(void **state)
{
    (void)state;
    struct studio s;
    struct photometric_state wrong;
    studio_open(&s, REFLECT_DISNEY, ALBEDO_FREE);
    wrong_state(&s, &wrong);
    const size_t bytes = (size_t)s.texels.n * sizeof(*wrong.albedo);
    float(*before)[3] = malloc(bytes);
    assert_non_null(before);
    memcpy(before, wrong.albedo, bytes);
    const struct photometric_error e = evaluate(&s.p, &wrong, false);
    assert_memory_equal(before, wrong.albedo, bytes);
    s.p.albedo = ALBEDO_GIVEN;
    close_to(e.cost, cost_of(&s.p, &wrong), float_bound * e.cost);
    free(before);
    photometric_state_free(&wrong);
    studio_close(&s);
}

// ---- normal equations --------------------------------------------------------------------------------------------------

// Small: where a light passes a horizon or a clipped sample its bound within a step, the difference is half a slope. At 1e-5 that
// happened on 3 of 8 seeds, at 1e-6 on none; the rounding of doubles stays below 1e-9.
static const double difference_step = 1e-7;

static void moved(const struct studio *s, const struct photometric_state *from, int unknown, double by, struct photometric_state *to)
{
    double x[MOST_UNKNOWNS];
    photometric_pack(&s->p, from, x);
    x[unknown] += by;
    new_copy(s, to, from);
    photometric_unpack(&s->p, to, x);
}

// A = J^T W J and g = J^T W r from differences of the double residuals at the albedo of `at`; where the albedo is free, with
// what it explains taken out of J. raw: the diagonal before that.
static void reference_equations(const struct studio *s, const struct photometric_state *at, const unsigned char *is_free, double *A,
                                double *g, double *raw)
{
    const struct photometric *p = &s->p;
    const struct photometric_layout l = layout_of(&s->p);
    const size_t n_rows = (size_t)s->samples.n * 3;
    double(*r)[3] = malloc(n_rows * sizeof(double)), (*plus)[3] = malloc(n_rows * sizeof(double));
    double *own = calloc(n_rows, sizeof(double)), *J = calloc(n_rows * MOST_UNKNOWNS, sizeof(double));
    struct photometric given = *p;
    given.albedo = p->albedo == ALBEDO_SHARED ? ALBEDO_SHARED : ALBEDO_GIVEN; // the state holds the best
    double(*albedo)[3] = albedo_of(&given, at);
    assert_true(r && plus && own && J);
    residuals(p, at, albedo, r);
    for (int u = 0; u < l.n; u++) {
        const double h = difference_step;
        for (int side = -1; is_free[u] && side <= 1; side += 2) {
            struct photometric_state there;
            moved(s, at, u, side * h, &there);
            double(*shared)[3] = albedo_of(&given, &there);
            residuals(p, &there, shared, plus);
            for (size_t k = 0; k < n_rows; k++)
                J[k * MOST_UNKNOWNS + (size_t)u] += side * plus[k / 3][k % 3] / (2 * h);
            free(shared);
            photometric_state_free(&there);
        }
    }
    for (int t = 0; t < s->texels.n; t++)
        for (int64_t i = s->samples.first[t]; i < s->samples.first[t + 1]; i++) {
            double constant[3], slope[3];
            if (!in_use(p, t, i))
                continue;
            affine(p, at, t, s->samples.view[i], albedo[t], constant, slope);
            for (int c = 0; c < 3; c++)
                own[3 * i + c] = r[i][c] == 0 ? 0 : root_weight(p, i) * slope[c];
        }
    for (size_t k = 0; k < n_rows; k++)
        for (int u = 0; u < l.n; u++)
            raw[u] += J[k * MOST_UNKNOWNS + (size_t)u] * J[k * MOST_UNKNOWNS + (size_t)u];
    for (int t = 0; p->albedo == ALBEDO_FREE && t < s->texels.n; t++)
        for (int c = 0; c < 3; c++) {
            const int64_t begin = s->samples.first[t], end = s->samples.first[t + 1];
            double own2 = 0;
            for (int64_t i = begin; i < end; i++)
                own2 += own[3 * i + c] * own[3 * i + c];
            if (own2 == 0 || albedo[t][c] <= 0 || albedo[t][c] >= 1.5)
                continue;
            for (int u = 0; u < l.n; u++) {
                double dot = 0;
                for (int64_t i = begin; i < end; i++)
                    dot += own[3 * i + c] * J[(3 * i + c) * MOST_UNKNOWNS + u];
                for (int64_t i = begin; i < end; i++)
                    J[(3 * i + c) * MOST_UNKNOWNS + u] -= own[3 * i + c] * dot / own2;
            }
        }
    for (size_t k = 0; k < n_rows; k++)
        for (int u = 0; u < l.n; u++) {
            g[u] += J[k * MOST_UNKNOWNS + (size_t)u] * r[k / 3][k % 3];
            for (int w = 0; w <= u; w++)
                A[u * l.n + w] += J[k * MOST_UNKNOWNS + (size_t)u] * J[k * MOST_UNKNOWNS + (size_t)w];
        }
    free(r);
    free(plus);
    free(own);
    free(J);
    free(albedo);
}

static void choose_free(const struct photometric *p, unsigned char *is_free)
{
    const struct photometric_layout l = layout_of(p);
    memset(is_free, 1, (size_t)l.n);
    for (int i = 0; i < DISNEY_N; i++)
        is_free[l.theta + i] = p->model == REFLECT_DISNEY;
    for (int c = 0; c < 3; c++)
        is_free[l.albedo + c] = p->albedo == ALBEDO_SHARED;
}

// At the wrong state: A and g as J says, and g also as the differences of the (minimised) cost say.
static void equations_hold_with(struct studio *s, bool gains)
{
    const struct photometric_layout l = layout_of(&s->p);
    struct photometric_state at;
    unsigned char is_free[MOST_UNKNOWNS];
    double A[MOST_UNKNOWNS * MOST_UNKNOWNS] = { 0 }, g[MOST_UNKNOWNS] = { 0 }, raw[MOST_UNKNOWNS] = { 0 };
    double A_found[MOST_UNKNOWNS * MOST_UNKNOWNS] = { 0 }, g_found[MOST_UNKNOWNS] = { 0 }, worst_A = 0, worst_g = 0, worst_cost = 0;
    wrong_state(s, &at);
    choose_free(&s->p, is_free);
    for (int v = 0; v < l.n_views; v++)
        is_free[l.gain + v] = gains;
    const struct photometric_error e = evaluate(&s->p, &at, true);
    assert_true(l.n <= MOST_UNKNOWNS);
    assert_int_equal(photometric_normal_equations(&s->p, &at, is_free, A_found, g_found), 0);
    reference_equations(s, &at, is_free, A, g, raw);
    for (int u = 0; u < l.n; u++) {
        for (int w = 0; w <= u; w++) {
            const double scale = sqrt(raw[u] * raw[w]);
            if (!is_free[u] || !is_free[w])
                assert_true(A_found[u * l.n + w] == 0);
            else
                worst_A = fmax(worst_A, fabs(A_found[u * l.n + w] - A[u * l.n + w]) / (scale > 0 ? scale : 1));
        }
        if (!is_free[u]) {
            assert_true(g_found[u] == 0);
            continue;
        }
        const double scale = sqrt(raw[u] * 2 * e.cost), h = difference_step;
        struct photometric_state there;
        if (raw[u] == 0) { // a view left out, a group without lights
            assert_true((s->p.use_view || u == l.n - 1) && g_found[u] == 0 && A_found[u * l.n + u] == 0);
            continue;
        }
        moved(s, &at, u, h, &there);
        double slope = cost_of(&s->p, &there) / (2 * h);
        photometric_state_free(&there);
        moved(s, &at, u, -h, &there);
        slope -= cost_of(&s->p, &there) / (2 * h);
        photometric_state_free(&there);
        worst_g = fmax(worst_g, fabs(g_found[u] - g[u]) / scale);
        worst_cost = fmax(worst_cost, fabs(g_found[u] - slope) / scale);
    }
    print_message("# model %d, albedo %d: A off by %.2g, g by %.2g, from the cost's slope by %.2g\n", s->p.model, s->p.albedo, worst_A,
                  worst_g, worst_cost);
    assert_true(worst_A < float_bound);
    assert_true(worst_g < float_bound);
    assert_true(worst_cost < float_bound);
    photometric_state_free(&at);
}

// A diffuse texel whose views need no gain has its rows made another way.
static void equations_hold(struct studio *s)
{
    equations_hold_with(s, true);
    if (s->p.model == REFLECT_LAMBERT)
        equations_hold_with(s, false);
}

static void equations_are_those_of_the_residuals(void **state)
{
    (void)state;
    for (int model = REFLECT_DISNEY; model <= REFLECT_LAMBERT; model++)
        for (int albedo = ALBEDO_FREE; albedo <= ALBEDO_SHARED; albedo++) {
            struct studio s;
            studio_open(&s, (enum reflectance)model, (enum albedo_mode)albedo);
            equations_hold(&s);
            studio_close(&s);
        }
}

// Groups that are aligned runs of lights, which have a loop of their own; then with a group more that is empty.
static void equations_hold_for_runs_of_lights(void **state)
{
    (void)state;
    static const int runs[] = { 1, 2, 4, 20 };
    for (int k = 0; k < 4; k++) {
        struct studio s;
        studio_open(&s, k % 2 ? REFLECT_LAMBERT : REFLECT_DISNEY, ALBEDO_GIVEN);
        for (int i = 0; i < N_LIGHTS; i++) {
            s.group[i] = i / runs[k];
            s.truth.lights.inverse_distance[i] = .4 + uniform(3, (uint64_t)s.group[i]);
        }
        s.p.n_groups = N_LIGHTS / runs[k];
        photograph(&s, 0);
        equations_hold(&s);
        s.p.n_groups++; // one that no light is in
        equations_hold(&s);
        studio_close(&s);
    }
}

static void equations_hold_under_light_from_the_object_itself(void **state)
{
    (void)state;
    for (int model = REFLECT_DISNEY; model <= REFLECT_LAMBERT; model++)
        for (int albedo = ALBEDO_FREE; albedo <= ALBEDO_SHARED; albedo++) {
            struct studio s;
            studio_open(&s, (enum reflectance)model, (enum albedo_mode)albedo);
            float(*indirect)[3] = malloc((size_t)s.texels.n * sizeof(*indirect));
            assert_non_null(indirect);
            for (int t = 0; t < s.texels.n; t++)
                for (int c = 0; c < 3; c++)
                    indirect[t][c] = (float)uniform(14, (uint64_t)(3 * t + c));
            s.p.indirect = (const float(*)[3])indirect;
            photograph(&s, 0);
            equations_hold(&s);
            free(indirect);
            studio_close(&s);
        }
}

// Groups of unequal sizes whose lights have distances of their own, in a fixed ratio to their group's.
static void equations_hold_for_lights_in_ratio_to_their_group(void **state)
{
    (void)state;
    for (int model = REFLECT_DISNEY; model <= REFLECT_LAMBERT; model++) {
        struct studio s;
        float ratio[N_LIGHTS];
        studio_open(&s, (enum reflectance)model, ALBEDO_FREE);
        s.p.ratio_of_light = ratio;
        s.p.n_groups = 0;
        for (int i = 0; i < N_LIGHTS; i++) {
            s.group[i] = i == 0 ? 0 : s.group[i - 1] + (i % 5 == 1 || i % 3 == 0);
            s.p.n_groups = s.group[i] + 1;
            ratio[i] = (float)(.6 + .9 * uniform(4, (uint64_t)i));
            s.truth.lights.inverse_distance[i] = (.4 + uniform(3, (uint64_t)s.group[i])) * (double)ratio[i];
        }
        photograph(&s, 0);
        equations_hold(&s);
        double x[layout_of(&s.p).n];
        struct photometric_state back;
        new_copy(&s, &back, &s.truth);
        photometric_pack(&s.p, &s.truth, x);
        photometric_unpack(&s.p, &back, x);
        for (int i = 0; i < N_LIGHTS; i++)
            close_to(back.lights.inverse_distance[i], s.truth.lights.inverse_distance[i], 1e-14);
        photometric_state_free(&back);
        studio_close(&s);
    }
}

// Weights with zeros, views and texels left out. What is left out must not matter: it is filled with nonsense.
struct choice {
    uint8_t use_view[N_VIEWS];
    float *weight;
};

static void choose(struct studio *s, struct choice *c)
{
    memset(c->use_view, 1, sizeof(c->use_view));
    c->use_view[2] = c->use_view[5] = 0;
    c->weight = malloc((size_t)s->samples.n * sizeof(float));
    assert_non_null(c->weight);
    s->p.use_view = c->use_view, s->p.weight = c->weight, s->p.texel_step = 3;
    for (int t = 0; t < s->texels.n; t++)
        for (int64_t i = s->samples.first[t]; i < s->samples.first[t + 1]; i++) {
            c->weight[i] = (float)fmax(2 * uniform(11, (uint64_t)i) - .4, 0);
            if (!in_use(&s->p, t, i))
                s->samples.radiance[i][0] = s->samples.radiance[i][1] = s->samples.radiance[i][2] = half_from_float(3e4f);
        }
}

static void what_is_left_out_does_not_count(void **state)
{
    (void)state;
    for (int model = REFLECT_DISNEY; model <= REFLECT_LAMBERT; model++)
        for (int albedo = ALBEDO_FREE; albedo <= ALBEDO_SHARED; albedo++) {
            struct studio s;
            struct choice c;
            struct photometric_state wrong;
            int64_t n = 0;
            studio_open(&s, (enum reflectance)model, (enum albedo_mode)albedo);
            choose(&s, &c);
            for (int t = 0; t < s.texels.n; t++)
                for (int64_t i = s.samples.first[t]; i < s.samples.first[t + 1]; i++)
                    n += in_use(&s.p, t, i);
            wrong_state(&s, &wrong);
            const double expected = cost_of(&s.p, &wrong);
            const struct photometric_error e = evaluate(&s.p, &wrong, true);
            assert_int_equal(e.n, n);
            assert_true(n > 100);
            close_to(e.cost, expected, float_bound * expected);
            photometric_state_free(&wrong);
            equations_hold(&s);
            free(c.weight);
            studio_close(&s);
        }
}

// Every sample but a texel's first may be clipped at a share of what was there.
static void clip_some(struct studio *s)
{
    for (int t = 0; t < s->texels.n; t++)
        for (int64_t i = s->samples.first[t] + 1; i < s->samples.first[t + 1]; i++) {
            if (uniform(12, (uint64_t)i) > .5)
                continue;
            s->samples.flags[i] |= SAMPLE_CLIPPED;
            for (int c = 0; c < 3; c++)
                s->samples.radiance[i][c] =
                    half_from_float((float)((.5 + .5 * uniform(13, (uint64_t)i)) * observed(&s->p, i, c)));
        }
}

static void clipped_samples_are_lower_bounds(void **state)
{
    (void)state;
    for (int model = REFLECT_DISNEY; model <= REFLECT_LAMBERT; model++)
        for (int albedo = ALBEDO_FREE; albedo <= ALBEDO_SHARED; albedo++) {
            struct studio s;
            struct photometric_state wrong;
            studio_open(&s, (enum reflectance)model, (enum albedo_mode)albedo);
            clip_some(&s);
            wrong_state(&s, &wrong);
            const double expected = cost_of(&s.p, &wrong);
            const struct photometric_error e = evaluate(&s.p, &wrong, true);
            close_to(e.cost, expected, float_bound * expected);
            photometric_state_free(&wrong);
            equations_hold(&s);
            studio_close(&s);
        }
}

// ... whichever side of the bound the search starts on.
static void clipped_samples_do_not_pull_the_albedo(void **state)
{
    (void)state;
    static const float starts[] = { .01f, .3f, 1.4f };
    for (int model = REFLECT_DISNEY; model <= REFLECT_LAMBERT; model++)
        for (int k = 0; k < 3; k++) {
            struct studio s;
            struct photometric_state start;
            studio_open(&s, (enum reflectance)model, ALBEDO_FREE);
            clip_some(&s);
            new_copy(&s, &start, &s.truth);
            for (int t = 0; t < s.texels.n; t++)
                start.albedo[t][0] = start.albedo[t][1] = start.albedo[t][2] = starts[k];
            evaluate(&s.p, &start, true);
            for (int t = 0; t < s.texels.n; t++)
                for (int c = 0; c < 3 && s.samples.first[t + 1] > s.samples.first[t]; c++)
                    close_to((double)start.albedo[t][c], (double)s.truth.albedo[t][c], 2e-3);
            photometric_state_free(&start);
            studio_close(&s);
        }
}

static void equations_are_added_to_what_is_there(void **state)
{
    (void)state;
    struct studio s;
    struct photometric_state at;
    unsigned char is_free[N_UNKNOWNS], some[N_UNKNOWNS];
    double A[N_UNKNOWNS * N_UNKNOWNS] = { 0 }, g[N_UNKNOWNS] = { 0 }, A2[N_UNKNOWNS * N_UNKNOWNS], g2[N_UNKNOWNS];
    studio_open(&s, REFLECT_DISNEY, ALBEDO_GIVEN);
    wrong_state(&s, &at);
    choose_free(&s.p, is_free);
    const struct photometric_error e = evaluate(&s.p, &at, true);
    assert_int_equal(photometric_normal_equations(&s.p, &at, is_free, A, g), 0);
    for (int u = 0; u < N_UNKNOWNS; u++) {
        some[u] = is_free[u] && u % 3 != 1;
        g2[u] = 5;
        for (int w = 0; w < N_UNKNOWNS; w++)
            A2[u * N_UNKNOWNS + w] = 7;
    }
    assert_int_equal(photometric_normal_equations(&s.p, &at, some, A2, g2), 0);
    for (int u = 0; u < N_UNKNOWNS; u++) {
        const double norm = sqrt(A[u * N_UNKNOWNS + u]);
        close_to(g2[u], 5 + (some[u] ? g[u] : 0), float_bound * norm * sqrt(2 * e.cost));
        for (int w = 0; w < N_UNKNOWNS; w++)
            close_to(A2[u * N_UNKNOWNS + w], 7 + (some[u] && some[w] && w <= u ? A[u * N_UNKNOWNS + w] : 0),
                     float_bound * norm * sqrt(A[w * N_UNKNOWNS + w]));
    }
    memset(some, 0, sizeof(some));
    memcpy(A, A2, sizeof(A));
    assert_int_equal(photometric_normal_equations(&s.p, &at, some, A2, g2), 0); // nothing free: nothing added
    assert_memory_equal(A, A2, sizeof(A));
    photometric_state_free(&at);
    studio_close(&s);
}

// With a tint the equations hold it: the gradient is not exact, but downhill it must point, and nearly so near the solution.
static void tinted_gradients_point_downhill(void **state)
{
    (void)state;
    for (int k = 0; k < 3; k++) {
        struct studio s;
        struct photometric_state at, there;
        unsigned char is_free[N_UNKNOWNS];
        double A[N_UNKNOWNS * N_UNKNOWNS] = { 0 }, g[N_UNKNOWNS] = { 0 }, x[N_UNKNOWNS], promised = 0;
        studio_open(&s, REFLECT_DISNEY, ALBEDO_FREE);
        s.truth.theta[DISNEY_SPECULAR_TINT] = s.truth.theta[DISNEY_SHEEN_TINT] = k == 0 ? .2 : k == 1 ? .5 : .9;
        photograph(&s, .05);
        wrong_state(&s, &at);
        choose_free(&s.p, is_free);
        evaluate(&s.p, &at, true);
        const struct photometric_error before = evaluate(&s.p, &at, true); // the second time at its tint
        assert_int_equal(photometric_normal_equations(&s.p, &at, is_free, A, g), 0);
        photometric_pack(&s.p, &at, x);
        for (int u = 0; u < N_UNKNOWNS; u++) {
            const double step = A[u * N_UNKNOWNS + u] > 0 ? -1e-3 * g[u] / A[u * N_UNKNOWNS + u] : 0;
            x[u] += step, promised -= g[u] * step;
        }
        new_copy(&s, &there, &at);
        photometric_unpack(&s.p, &there, x);
        const double gain = before.cost - evaluate(&s.p, &there, true).cost;
        print_message("# tint %.1f: a short step gains %.3f of what the gradient promises\n", s.truth.theta[DISNEY_SHEEN_TINT],
                      gain / promised);
        assert_true(gain > 0);
        photometric_state_free(&there);
        photometric_state_free(&at);
        studio_close(&s);
    }
}

// ---- the state ---------------------------------------------------------------------------------------------------------

static void packing_comes_back(void **state)
{
    (void)state;
    struct studio s;
    struct photometric_state a, b;
    const struct photometric_layout l = photometric_layout_of(N_VIEWS, N_GROUPS);
    double x[N_UNKNOWNS], y[N_UNKNOWNS];
    studio_open(&s, REFLECT_DISNEY, ALBEDO_SHARED);
    assert_int_equal(photometric_state_new(&a, &s.p, &s.lights), 0);
    assert_true(a.lights.dir_probe != s.lights.dir_probe && a.theta[3] == .5 && a.albedo[1][2] == .5f && a.log_gain[1] == 0);
    assert_memory_equal(a.lights.dir_probe, s.lights.dir_probe, N_LIGHTS * sizeof(*a.lights.dir_probe));
    assert_memory_equal(a.lights.irradiance, s.lights.irradiance, N_LIGHTS * sizeof(*a.lights.irradiance));
    for (int i = 0; i < l.n; i++)
        x[i] = .01 * (i + 1);
    x[l.rotation] = x[l.rotation + 1] = x[l.rotation + 2] = 0;
    photometric_unpack(&s.p, &a, x);
    assert_memory_equal(a.lights.world_from_probe, s.lights.world_from_probe, sizeof(a.lights.world_from_probe));
    photometric_pack(&s.p, &a, y);
    assert_memory_equal(x, y, sizeof(x));
    for (int i = 0; i < N_LIGHTS; i++)
        assert_true(a.lights.inverse_distance[i] == x[l.inverse_distance + s.group[i]]);
    assert_true(a.theta[DISNEY_ROUGHNESS] == x[DISNEY_ROUGHNESS] && a.lights.centre_m[2] == x[l.centre + 2]);
    assert_true(a.shared_albedo[1] == x[l.albedo + 1] && a.log_gain[3] == x[l.gain + 3]);

    // Two turns, the second on the left.
    const double turns[2][3] = { { .3, -.2, .5 }, { -.1, .7, .2 } };
    double expected[9], turn[9];
    memcpy(expected, s.lights.world_from_probe, sizeof(expected));
    for (int k = 0; k < 2; k++) {
        photometric_pack(&s.p, &a, x);
        assert_true(x[l.rotation] == 0 && x[l.rotation + 1] == 0 && x[l.rotation + 2] == 0);
        memcpy(x + l.rotation, turns[k], sizeof(turns[k]));
        photometric_unpack(&s.p, &a, x);
        mat3_from_rotation_vector(turn, turns[k]);
        mat3_mul(expected, turn, expected);
    }
    for (int i = 0; i < 9; i++)
        close_to(a.lights.world_from_probe[i], expected[i], 1e-15);

    // A copy is the same to the last byte that packing and evaluation see.
    a.albedo[3][1] = .123f;
    assert_int_equal(photometric_state_new(&b, &s.p, &s.lights), 0);
    photometric_state_copy(&s.p, &b, &a);
    photometric_pack(&s.p, &a, x);
    photometric_pack(&s.p, &b, y);
    assert_memory_equal(x, y, sizeof(x));
    assert_memory_equal(a.lights.world_from_probe, b.lights.world_from_probe, sizeof(a.lights.world_from_probe));
    assert_memory_equal(a.albedo, b.albedo, (size_t)s.texels.n * sizeof(*a.albedo));
    photometric_state_free(&a);
    photometric_state_free(&b);
    studio_close(&s);
}

static void threads_give_the_same_bytes(void **state)
{
    (void)state;
    for (int albedo = ALBEDO_FREE; albedo <= ALBEDO_SHARED; albedo++) {
        struct studio s;
        struct photometric_state wrong, at;
        struct photometric_error e[3];
        double A[3][N_UNKNOWNS * N_UNKNOWNS] = { 0 }, g[3][N_UNKNOWNS] = { 0 }, sigma[3];
        unsigned char is_free[N_UNKNOWNS];
        studio_open(&s, REFLECT_DISNEY, (enum albedo_mode)albedo);
        wrong_state(&s, &wrong);
        choose_free(&s.p, is_free);
        const size_t bytes = (size_t)s.texels.n * sizeof(*wrong.albedo), n = (size_t)s.samples.n;
        float(*first)[3] = malloc(bytes), *weight = malloc(2 * n * sizeof(float));
        assert_true(first && weight);
        for (int k = 0; k < 3; k++) {
            s.p.n_threads = k == 0 ? 1 : k == 1 ? 3 : 16;
            new_copy(&s, &at, &wrong);
            e[k] = evaluate(&s.p, &at, true);
            assert_int_equal(photometric_normal_equations(&s.p, &at, is_free, A[k], g[k]), 0);
            assert_int_equal(photometric_scale(&s.p, &at, &sigma[k]), 0);
            assert_int_equal(photometric_robust_weights(&s.p, &at, sigma[k], NULL, weight + (k ? n : 0)), 0);
            if (k == 0)
                memcpy(first, at.albedo, bytes);
            assert_memory_equal(first, at.albedo, bytes);
            assert_memory_equal(&e[0], &e[k], sizeof(e[0]));
            assert_memory_equal(A[0], A[k], sizeof(A[0]));
            assert_memory_equal(g[0], g[k], sizeof(g[0]));
            assert_true(sigma[0] == sigma[k]);
            assert_memory_equal(weight, weight + (k ? n : 0), n * sizeof(float));
            photometric_state_free(&at);
        }
        free(first);
        free(weight);
        photometric_state_free(&wrong);
        studio_close(&s);
    }
}

// ---- robust weights ----------------------------------------------------------------------------------------------------

static int by_double(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static void robust_weights_are_geman_mcclures(void **state)
{
    (void)state;
    struct studio s;
    struct choice choice;
    struct photometric_state at;
    studio_open(&s, REFLECT_DISNEY, ALBEDO_GIVEN);
    photograph(&s, .1);
    choose(&s, &choice);
    new_copy(&s, &at, &s.truth);
    const size_t n = (size_t)s.samples.n;
    double(*r)[3] = malloc(n * sizeof(*r)), (*albedo)[3] = albedo_of(&s.p, &at), sigma;
    double *size = malloc(n * sizeof(double)), *all = malloc(3 * n * sizeof(double));
    float *weight = malloc(n * sizeof(float)), *flat = malloc(n * sizeof(float));
    assert_true(r && weight && flat && size && all);
    s.p.weight = NULL;
    residuals(&s.p, &at, albedo, r);
    s.p.weight = choice.weight;
    assert_int_equal(photometric_scale(&s.p, &at, &sigma), 0);
    assert_int_equal(photometric_robust_weights(&s.p, &at, sigma, choice.weight, weight), 0);
    assert_int_equal(photometric_robust_weights(&s.p, &at, sigma, NULL, flat), 0);
    size_t m = 0, n_outliers = 0;
    for (int t = 0; t < s.texels.n; t++)
        for (int64_t i = s.samples.first[t]; i < s.samples.first[t + 1]; i++) {
            size[i] = fmax(fmax(fabs(r[i][0]), fabs(r[i][1])), fabs(r[i][2]));
            const bool seen = t % s.p.texel_step == 0 && choice.use_view[s.samples.view[i]];
            const double u = size[i] / sigma, expected = seen ? 1 / ((1 + u * u) * (1 + u * u)) : 0;
            close_to((double)flat[i], expected, 1e-4);
            close_to((double)weight[i], expected * (double)choice.weight[i], 1e-4);
            n_outliers += seen && flat[i] < .01f;
            for (int c = 0; c < 3 && in_use(&s.p, t, i); c++)
                all[m++] = fabs(r[i][c]);
        }
    assert_true(n_outliers > 10); // the nonsense with weight 0
    qsort(all, m, sizeof(double), by_double);
    close_to(sigma, 1.4826 * all[m / 2], 1e-3 * sigma);
    free(r);
    free(albedo);
    free(size);
    free(all);
    free(weight);
    free(flat);
    free(choice.weight);
    photometric_state_free(&at);
    studio_close(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(true_states_leave_half_rounding_only),
        cmocka_unit_test(the_cost_is_eq_6s),
        cmocka_unit_test(free_albedo_finds_the_least_squares_one),
        cmocka_unit_test(measuring_leaves_the_albedo_alone),
        cmocka_unit_test(equations_are_those_of_the_residuals),
        cmocka_unit_test(equations_hold_for_runs_of_lights),
        cmocka_unit_test(equations_hold_under_light_from_the_object_itself),
        cmocka_unit_test(equations_hold_for_lights_in_ratio_to_their_group),
        cmocka_unit_test(what_is_left_out_does_not_count),
        cmocka_unit_test(clipped_samples_are_lower_bounds),
        cmocka_unit_test(clipped_samples_do_not_pull_the_albedo),
        cmocka_unit_test(equations_are_added_to_what_is_there),
        cmocka_unit_test(tinted_gradients_point_downhill),
        cmocka_unit_test(packing_comes_back),
        cmocka_unit_test(threads_give_the_same_bytes),
        cmocka_unit_test(robust_weights_are_geman_mcclures),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
