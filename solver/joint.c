// solver/joint.c - stage 1 of the solver: three methods over photometric.h and lm.h.
#include "solver/joint.h"

#include "solver/lm.h"
#include "solver/parallel.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"
#include "solver/visibility.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

const char *const method_names[3] = { "joint", "alternating", "directional" };

struct joint_settings joint_defaults(enum method method)
{
    return (struct joint_settings){ .method = method, .w_sim = method == METHOD_ALTERNATING ? 1e-3 : -1,
                                    .start_distance_m = method == METHOD_ALTERNATING ? 2 : 0, .visibility = method == METHOD_JOINT,
                                    .robust = false };
}

const char *joint_doubt_text(unsigned one_bit)
{
    switch (one_bit) {
    case DOUBT_NO_INFORMATION:
        return "a purely diffuse object with unknown albedo says nothing about the distances of the lights: give the albedo, or "
               "let it be one shared colour";
    case DOUBT_FEW_VIEWS:
        return "fewer than 3 views see the object";
    case DOUBT_MIRRORED:
        return "the mirrored panorama explains the pictures better: was it flipped on export?";
    case DOUBT_UNCERTAIN:
        return "the pictures do not determine where the lights are: the standard deviations are too large";
    case DOUBT_POOR_FIT:
        return "the model does not explain the pictures: a light may be missing from the panorama, or something moved";
    }
    return "";
}

enum { N_NEIGHBOURS = 8 };
static const double least_q = .02, most_q = 5; // 50 m .. 20 cm
static const double centre_guess_m = .3;       // how well the centre of the panorama is known at the start
static const double first_w_sim = 1e-3;        // of the continuation, and of the sweep

struct pair {
    int i, j;
    double weight; // 1 / |dh_i - dh_j|^2
};

struct stage1 {
    const struct joint_settings *set;
    struct photometric p;
    struct photometric_layout layout;
    struct photometric_state base, trial;
    int n_pairs;
    struct pair *pairs;
    bool in_distance;      // the unknown is r, not 1/r, and E_sim is Eq. 11 to the letter (paper)
    double w_sim;          // beside the mean of squares
    double first_centre_m[3]; // joint: the centre is held near its first guess with the same weight, which ends at (nearly) 0
    double n_residuals;    // samples x 3 in use
    unsigned char *is_free;
    double *x, *lower, *upper;
    struct light_visibility visibility;
    const struct rays *rays;
    int n_jacobians, n_evaluations;
    const char *stop;
};

// ---- E_sim --------------------------------------------------------------------------------------------------------------

// The group's direction: energy-weighted. Groups without energy are left out of everything.
static int find_pairs(struct stage1 *s, const struct lights *l)
{
    const int n = s->p.n_groups;
    double(*d)[3] = calloc((size_t)n, sizeof(*d));
    unsigned char *lit = calloc((size_t)n, 1);
    s->pairs = malloc((size_t)n * N_NEIGHBOURS * sizeof(*s->pairs));
    int err = d && lit && s->pairs ? 0 : -ENOMEM;
    for (int i = 0; !err && i < l->n; i++) {
        const int g = s->p.group_of_light[i];
        const double energy = l->irradiance[i][0] + l->irradiance[i][1] + l->irradiance[i][2];
        vec3_add_scaled(d[g], d[g], energy, l->dir_probe[i]);
        lit[g] |= energy > 0;
    }
    for (int g = 0; !err && g < n; g++) {
        vec3_normalise(d[g]);
        s->is_free[s->layout.inverse_distance + g] = lit[g];
    }
    s->n_pairs = 0;
    for (int g = 0; !err && g < n; g++) {
        int nearest[N_NEIGHBOURS], m = 0;
        double distance2[N_NEIGHBOURS];
        for (int h = 0; h < n && lit[g]; h++) {
            double e[3];
            vec3_sub(e, d[g], d[h]);
            const double d2 = vec3_dot(e, e);
            if (h == g || !lit[h] || (m == N_NEIGHBOURS && d2 >= distance2[m - 1]))
                continue;
            int k = m < N_NEIGHBOURS ? m++ : m - 1;
            for (; k > 0 && distance2[k - 1] > d2; k--)
                nearest[k] = nearest[k - 1], distance2[k] = distance2[k - 1];
            nearest[k] = h, distance2[k] = d2;
        }
        for (int k = 0; k < m; k++) // each direction of a neighbourhood counts, as in Eq. 11
            s->pairs[s->n_pairs++] = (struct pair){ g, nearest[k], 1 / fmax(distance2[k], 1e-6) };
    }
    free(d);
    free(lit);
    return err;
}

// u(x): log(1/r), or r itself in paper mode; and du/dx.
static double similarity_of(const struct stage1 *s, double x, double *slope)
{
    if (s->in_distance) {
        *slope = 1;
        return x;
    }
    *slope = 1 / x;
    return log(x);
}

// Eq. 11, and for joint the first guess of the centre.
static double add_similarity(const struct stage1 *s, const double *x, double *A, double *g)
{
    const int first = s->layout.inverse_distance, n = s->layout.n;
    double cost = 0;
    for (int k = 0; s->w_sim > 0 && k < s->n_pairs; k++) {
        const int i = first + s->pairs[k].i, j = first + s->pairs[k].j;
        double si, sj;
        const double w = s->w_sim * s->pairs[k].weight;
        const double e = similarity_of(s, x[i], &si) - similarity_of(s, x[j], &sj);
        cost += .5 * w * e * e;
        if (!A)
            continue;
        g[i] += w * e * si, g[j] -= w * e * sj;
        A[(size_t)i * n + i] += w * si * si, A[(size_t)j * n + j] += w * sj * sj;
        A[(size_t)(i > j ? i : j) * n + (i > j ? j : i)] -= w * si * sj;
    }
    for (int c = 0; s->set->method == METHOD_JOINT && c < 3; c++) {
        const int i = s->layout.centre + c;
        const double w = s->w_sim / (centre_guess_m * centre_guess_m), e = x[i] - s->first_centre_m[c];
        cost += .5 * w * e * e;
        if (A)
            A[(size_t)i * n + i] += w, g[i] += w * e;
    }
    return cost;
}

// ---- the problem as lm.h sees it ----------------------------------------------------------------------------------------

static double gain_precision(void)
{
    return 1 / (.02 * .02);
}

static void to_state(struct stage1 *s, const double *x, double *scratch)
{
    memcpy(scratch, x, (size_t)s->layout.n * sizeof(double));
    for (int g = 0; s->in_distance && g < s->p.n_groups; g++)
        scratch[s->layout.inverse_distance + g] = 1 / x[s->layout.inverse_distance + g];
    photometric_state_copy(&s->p, &s->trial, &s->base);
    photometric_unpack(&s->p, &s->trial, scratch);
}

static int evaluate_at(struct stage1 *s, const double *x, double *cost)
{
    double scratch[s->layout.n];
    struct photometric_error e;
    to_state(s, x, scratch);
    const int err = photometric_evaluate(&s->p, &s->trial, s->p.albedo == ALBEDO_FREE, &e);
    if (err)
        return err;
    s->n_residuals = 3 * (double)e.n;
    *cost = e.cost / fmax(s->n_residuals, 1) + add_similarity(s, x, NULL, NULL);
    for (int v = 0; s->set->gain && v < s->layout.n_views; v++) {
        const double gain = x[s->layout.gain + v];
        *cost += .5 * 1e-6 * gain_precision() * gain * gain / s->layout.n_views;
    }
    return 0;
}

static int cost_callback(void *arg, const double *x, double *cost)
{
    struct stage1 *s = arg;
    s->n_evaluations++;
    return evaluate_at(s, x, cost);
}

// A, g for the step w at R = exp([w]x) R0 instead of w = 0: columns times the left Jacobian of the rotation.
static void turn_rotation(const struct stage1 *s, const double *x, double *A, double *g)
{
    const int n = s->layout.n, first = s->layout.rotation;
    const double *w = x + first, a2 = vec3_dot(w, w), a = sqrt(a2);
    if (a2 == 0)
        return;
    const double k1 = a > 1e-4 ? (1 - cos(a)) / a2 : .5, k2 = a > 1e-4 ? (a - sin(a)) / (a2 * a) : 1. / 6;
    const double W[9] = { 0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0 };
    double W2[9], T[9];
    mat3_mul(W2, W, W);
    for (int i = 0; i < 9; i++)
        T[i] = (i % 4 == 0) + k1 * W[i] + k2 * W2[i];
    // rows and columns of the symmetric matrix (lower triangle held)
    for (int i = 0; i < n; i++) {
        if (i >= first && i < first + 3)
            continue;
        double v[3];
        for (int c = 0; c < 3; c++)
            v[c] = i > first + c ? A[(size_t)i * n + first + c] : A[(size_t)(first + c) * n + i];
        mat3_tmul_vec(v, T, v);
        for (int c = 0; c < 3; c++)
            *(i > first + c ? &A[(size_t)i * n + first + c] : &A[(size_t)(first + c) * n + i]) = v[c];
    }
    double B[9], Tt[9];
    for (int i = 0; i < 3; i++)
        for (int c = 0; c < 3; c++) {
            B[3 * i + c] = i >= c ? A[(size_t)(first + i) * n + first + c] : A[(size_t)(first + c) * n + first + i];
            Tt[3 * i + c] = T[3 * c + i];
        }
    mat3_mul(B, Tt, B);
    mat3_mul(B, B, T);
    for (int i = 0; i < 3; i++)
        for (int c = 0; c <= i; c++)
            A[(size_t)(first + i) * n + first + c] = B[3 * i + c];
    mat3_tmul_vec(g + first, T, g + first);
}

static int normal_callback(void *arg, const double *x, double *cost, double *A, double *g)
{
    struct stage1 *s = arg;
    const int n = s->layout.n;
    int err = evaluate_at(s, x, cost);
    if (err)
        return err;
    s->n_jacobians++;
    err = photometric_normal_equations(&s->p, &s->trial, s->is_free, A, g);
    if (err)
        return err;
    const double scale = 1 / fmax(s->n_residuals, 1);
    for (int i = 0; i < n; i++) {
        g[i] *= scale;
        for (int j = 0; j <= i; j++)
            A[(size_t)i * n + j] *= scale;
    }
    for (int k = 0; s->in_distance && k < s->p.n_groups; k++) { // d/dr = -1/r^2 d/dq
        const int i = s->layout.inverse_distance + k;
        const double slope = -1 / (x[i] * x[i]);
        g[i] *= slope;
        for (int j = 0; j <= i; j++)
            A[(size_t)i * n + j] *= slope;
        for (int j = i; j < n; j++)
            A[(size_t)j * n + i] *= slope;
    }
    turn_rotation(s, x, A, g);
    for (int v = 0; s->set->gain && v < s->layout.n_views; v++) {
        const int i = s->layout.gain + v;
        const double w = 1e-6 * gain_precision() / s->layout.n_views;
        A[(size_t)i * n + i] += w, g[i] += w * x[i];
    }
    add_similarity(s, x, A, g);
    // The colour of the tint in the next evaluations.
    memcpy(s->base.albedo, s->trial.albedo, (size_t)s->p.texels->n * sizeof(*s->base.albedo));
    return 0;
}

static void set_bounds(struct stage1 *s)
{
    const struct photometric_layout *l = &s->layout;
    for (int i = 0; i < l->n; i++)
        s->lower[i] = -INFINITY, s->upper[i] = INFINITY;
    for (int i = 0; i < DISNEY_N; i++)
        s->lower[l->theta + i] = 0, s->upper[l->theta + i] = 1;
    for (int i = 0; i < 3; i++) {
        s->lower[l->albedo + i] = 0, s->upper[l->albedo + i] = 1.5;
        s->lower[l->rotation + i] = -1, s->upper[l->rotation + i] = 1;
    }
    for (int g = 0; g < l->n_groups; g++) {
        s->lower[l->inverse_distance + g] = s->set->method == METHOD_DIRECTIONAL ? 0 : s->in_distance ? 1 / most_q : least_q;
        s->upper[l->inverse_distance + g] = s->in_distance ? 1 / least_q : most_q;
    }
}

static int trace_visibility(struct stage1 *s)
{
    if (!s->set->visibility || !s->rays)
        return 0;
    const double moved_rad = .5 * M_PI / 180;
    const int err = s->visibility.bits
                        ? light_visibility_refresh(&s->visibility, s->rays, s->p.texels, &s->base.lights, NULL, moved_rad, 0,
                                                   s->set->n_threads)
                        : light_visibility_trace(&s->visibility, s->rays, s->p.texels, &s->base.lights, NULL, 1, 0,
                                                 s->set->n_threads);
    s->p.visible = s->visibility.bits;
    s->p.words_per_texel = s->visibility.words_per_texel;
    return err < 0 ? err : 0; // refresh counts
}

// LM from base; base is the result. cost may be NULL.
static int minimise(struct stage1 *s, int max_iterations, double relative_cost, double *cost)
{
    const struct lm_problem problem = { s->layout.n, s->lower, s->upper, cost_callback, normal_callback, s };
    struct lm_settings settings = lm_defaults();
    struct lm_result r;
    double scratch[s->layout.n];
    settings.max_iterations = max_iterations;
    settings.relative_cost = relative_cost;
    photometric_pack(&s->p, &s->base, s->x);
    for (int g = 0; s->in_distance && g < s->p.n_groups; g++)
        s->x[s->layout.inverse_distance + g] = 1 / s->x[s->layout.inverse_distance + g];
    int err = lm_minimise(&problem, &settings, s->x, &r);
    if (err)
        return err;
    to_state(s, s->x, scratch);
    struct photometric_error e;
    err = photometric_evaluate(&s->p, &s->trial, s->p.albedo == ALBEDO_FREE, &e);
    photometric_state_copy(&s->p, &s->base, &s->trial);
    s->stop = lm_stop_name(r.stop);
    if (cost)
        *cost = r.cost;
    log_debug("joint: w_sim %.1e, step %d, %d groups: cost %.4e -> %.4e, %d Jacobians, stop %s, RMSE %.4f %%", s->w_sim, s->p.texel_step,
              s->p.n_groups, r.first_cost, r.cost, r.n_jacobians, s->stop, photometric_rmse_percent(&e));
    return err;
}

static void set_distances(struct stage1 *s, double distance_m)
{
    for (int i = 0; i < s->base.lights.n; i++)
        s->base.lights.inverse_distance[i] = distance_m > 0 ? 1 / distance_m : 0;
}

// ---- the stages of a solve ----------------------------------------------------------------------------------------------

static int stage1_new(struct stage1 *s, const struct photometric *p, const struct lights *lights, const struct rays *rays,
                      const struct joint_settings *set)
{
    memset(s, 0, sizeof(*s));
    s->set = set, s->p = *p, s->rays = rays;
    s->layout = photometric_layout_of(p->samples->n_views, p->n_groups);
    s->in_distance = set->method == METHOD_ALTERNATING;
    memcpy(s->first_centre_m, lights->centre_m, sizeof(s->first_centre_m));
    const size_t n = (size_t)s->layout.n;
    s->is_free = calloc(n, 1);
    s->x = calloc(n, sizeof(double));
    s->lower = calloc(n, sizeof(double));
    s->upper = calloc(n, sizeof(double));
    if (!s->is_free || !s->x || !s->lower || !s->upper)
        return -ENOMEM;
    int err = photometric_state_new(&s->base, p, lights);
    if (!err)
        err = photometric_state_new(&s->trial, p, lights);
    if (!err)
        err = find_pairs(s, lights);
    if (err)
        return err;
    for (int i = 0; i < DISNEY_N; i++)
        s->is_free[s->layout.theta + i] = p->model == REFLECT_DISNEY;
    for (int i = 0; i < 3; i++) {
        s->is_free[s->layout.rotation + i] = 1;
        s->is_free[s->layout.centre + i] = set->method != METHOD_DIRECTIONAL;
        s->is_free[s->layout.albedo + i] = p->albedo == ALBEDO_SHARED;
    }
    for (int v = 0; v < s->layout.n_views; v++)
        s->is_free[s->layout.gain + v] = set->gain;
    for (int g = 0; g < p->n_groups; g++)
        s->is_free[s->layout.inverse_distance + g] &= set->method != METHOD_DIRECTIONAL;
    for (int t = 0; p->albedo == ALBEDO_GIVEN && t < p->texels->n; t++)
        for (int c = 0; c < 3; c++)
            s->base.albedo[t][c] = (float)set->given_albedo[c];
    set_bounds(s);
    return 0;
}

static void stage1_free(struct stage1 *s)
{
    photometric_state_free(&s->base);
    photometric_state_free(&s->trial);
    light_visibility_free(&s->visibility);
    free(s->pairs);
    free(s->is_free);
    free(s->x);
    free(s->lower);
    free(s->upper);
    memset(s, 0, sizeof(*s));
}

// Over the texels that the views in s->p saw: others have no albedo to be judged.
static int measure(const struct stage1 *s, const struct photometric_state *state, const uint8_t *use_view,
                   struct photometric_error *e)
{
    const struct samples *m = s->p.samples;
    struct photometric p = s->p;
    uint8_t *fitted = calloc((size_t)m->n_texels, 1);
    if (!fitted)
        return -ENOMEM;
    for (int t = 0; t < m->n_texels; t++)
        for (int64_t i = m->first[t]; i < m->first[t + 1]; i++)
            fitted[t] |= !s->p.use_view || s->p.use_view[m->view[i]];
    p.use_view = use_view;
    p.use_texel = fitted;
    p.weight = NULL;
    const int err = photometric_evaluate(&p, (struct photometric_state *)state, false, e);
    free(fitted);
    return err;
}

// Runs of `run` lights become one: the sum of their irradiance, from its mean direction.
static int merge_lights(struct lights *out, const struct lights *fine, int run)
{
    const int err = lights_new(out, fine->n / run);
    if (err)
        return err;
    memcpy(out->centre_m, fine->centre_m, sizeof(out->centre_m));
    memcpy(out->world_from_probe, fine->world_from_probe, sizeof(out->world_from_probe));
    for (int i = 0; i < out->n; i++) {
        double d[3] = { 0 };
        for (int k = i * run; k < (i + 1) * run; k++) {
            const double *C = fine->irradiance[k];
            vec3_add_scaled(d, d, C[0] + C[1] + C[2], fine->dir_probe[k]);
            vec3_add_scaled(out->irradiance[i], out->irradiance[i], 1, C);
        }
        if (vec3_normalise(d) == 0)
            memcpy(d, fine->dir_probe[i * run], sizeof(d));
        memcpy(out->dir_probe[i], d, sizeof(d));
        out->inverse_distance[i] = fine->inverse_distance[i * run];
    }
    return 0;
}

// Every so many texels, so that about n_samples are left; odd, so as not to fall in step with the texture's rows.
static int step_for(const struct stage1 *s, int64_t n_samples)
{
    const int64_t step = s->p.samples->n / n_samples;
    return step < 1 ? 1 : (int)step | 1;
}
// Few are enough to follow the valley, more to tell one weight from the next and for the last word; the albedo is then
// solved for every texel.
enum { SWEEP_SAMPLES = 30000, COARSE_SAMPLES = 30000, FINE_SAMPLES = 200000 };

// The common distance of all lights, by brute trial at few texels: one group, so a Jacobian costs little.
static int sweep(const struct photometric *p, const struct lights *lights, const struct rays *rays,
                 const struct joint_settings *set, struct photometric_state *best, double *best_cost, struct stage1 *total)
{
    static const double distances_m[] = { .7, 1.1, 1.7, 2.6, 4 };
    int32_t *one_group = calloc((size_t)lights->n, sizeof(*one_group));
    struct photometric coarse = *p;
    struct stage1 s = { 0 };
    int err = one_group ? 0 : -ENOMEM;
    *best_cost = INFINITY;
    coarse.group_of_light = one_group;
    coarse.n_groups = 1;
    const struct stage1 all = { .p = *p };
    coarse.texel_step = step_for(&all, SWEEP_SAMPLES);
    const int n = set->start_distance_m > 0 ? 1 : (int)(sizeof(distances_m) / sizeof(distances_m[0]));
    for (int k = 0; !err && k < n; k++) {
        double cost;
        err = stage1_new(&s, &coarse, lights, rays, set);
        if (!err) {
            set_distances(&s, n == 1 ? set->start_distance_m : distances_m[k]);
            err = trace_visibility(&s);
        }
        if (!err) {
            s.w_sim = first_w_sim;
            err = minimise(&s, 12, 1e-4, &cost);
        }
        if (!err && cost < *best_cost) {
            *best_cost = cost;
            photometric_state_copy(&coarse, best, &s.base);
        }
        total->n_jacobians += s.n_jacobians, total->n_evaluations += s.n_evaluations;
        stage1_free(&s);
    }
    free(one_group);
    return err;
}

// Half floats and bilinear look-ups leave about this much (percent of white) in any comparison; to gain less is to gain nothing.
static const double floor_percent = .03;

// Continuation: w_sim falls by decades, and after each step the views set aside are measured. Kept is the *largest* weight whose
// error is within 3 % of the best, or within the pictures' own rounding: below that, lights that the pictures hardly see drift off
// for nothing.
static int continuation(struct stage1 *s, const uint8_t *aside)
{
    enum { MAX_STEPS = 13 };
    const double last = s->set->w_sim >= 0 ? s->set->w_sim : 0;
    struct photometric_state at[MAX_STEPS] = { { .theta = { 0 } } };
    double error[MAX_STEPS], weight[MAX_STEPS], best = INFINITY;
    int n = 0, n_worse = 0, chosen = 0, err = 0;
    progress_begin("joint", MAX_STEPS);
    for (double w = first_w_sim; !err && n < MAX_STEPS; w = w > 1e-13 ? w / 10 : 0) {
        struct photometric_error e;
        s->w_sim = weight[n] = w > last ? w : last;
        s->p.texel_step = step_for(s, COARSE_SAMPLES);
        err = trace_visibility(s);
        if (!err)
            err = minimise(s, 8, 2e-3, NULL);
        s->p.texel_step = step_for(s, FINE_SAMPLES);
        if (!err) // the albedo of more texels, for the views set aside
            err = photometric_evaluate(&s->p, &s->base, s->p.albedo == ALBEDO_FREE, &e);
        if (!err)
            err = measure(s, &s->base, aside, &e);
        if (!err)
            err = photometric_state_new(&at[n], &s->p, &s->base.lights);
        progress_add(1);
        if (err)
            break;
        photometric_state_copy(&s->p, &at[n], &s->base);
        error[n] = photometric_rmse_percent(&e);
        log_debug("joint: w_sim %.0e: views set aside %.4f %%", w, error[n]);
        n_worse = error[n] < .97 * best ? 0 : n_worse + 1;
        best = fmin(best, error[n++]);
        if (w <= last || (s->set->w_sim < 0 && w < 1e-8 && n_worse >= 3))
            break;
    }
    if (!err) {
        for (chosen = 0; s->set->w_sim < 0 && error[chosen] > hypot(1.03 * best, floor_percent);)
            chosen++;
        if (s->set->w_sim >= 0)
            chosen = n - 1;
        photometric_state_copy(&s->p, &s->base, &at[chosen]);
        s->w_sim = weight[chosen];
    }
    progress_end();
    for (int i = 0; i < MAX_STEPS; i++)
        photometric_state_free(&at[i]);
    return err;
}

// The last word: all texels, all fitted views, the finest lights.
static int refine(struct stage1 *s, const uint8_t *fit)
{
    float *weight = NULL;
    struct photometric_error e;
    s->p.use_view = fit;
    s->p.texel_step = step_for(s, FINE_SAMPLES);
    int err = trace_visibility(s);
    if (!err && s->set->robust) {
        double sigma;
        weight = malloc((size_t)s->p.samples->n * sizeof(float) + 1);
        err = weight ? photometric_scale(&s->p, &s->base, &sigma) : -ENOMEM;
        if (!err)
            err = photometric_robust_weights(&s->p, &s->base, 3 * sigma, NULL, weight);
        s->p.weight = weight;
    }
    if (!err)
        err = minimise(s, s->set->method == METHOD_JOINT ? 15 : 40, 1e-4, NULL);
    s->p.weight = NULL;
    s->p.texel_step = 1;
    if (!err)
        err = photometric_evaluate(&s->p, &s->base, s->p.albedo == ALBEDO_FREE, &e);
    free(weight);
    return err;
}

// Sweep, continuation with coarse lights and texels, refinement. s is made for the finest lights.
static int solve_joint(struct stage1 *s, const struct photometric *p, const struct lights *lights, const uint8_t *fit,
                       struct joint_result *out)
{
    const int n_views = s->layout.n_views, run = lights->n / p->n_groups, coarse_run = run < 4 ? run : 4;
    struct lights one = { 0 }, few = { 0 };
    struct photometric coarse = *p;
    struct photometric_state start = { 0 };
    struct stage1 c = { 0 };
    double cost, mirrored_cost;
    int32_t *group = malloc((size_t)lights->n * sizeof(*group));
    uint8_t *inner = malloc((size_t)n_views), *aside = malloc((size_t)n_views);
    int err = group && inner && aside ? 0 : -ENOMEM, seen = 0;
    for (int v = 0; !err && v < n_views; v++) {
        aside[v] = fit[v] && seen++ % 6 == 3;
        inner[v] = fit[v] && !aside[v];
    }
    if (!err)
        err = merge_lights(&one, lights, run);
    if (!err)
        err = merge_lights(&few, lights, run / coarse_run);
    if (err)
        goto end;
    coarse.group_of_light = group;
    for (int i = 0; i < one.n; i++)
        group[i] = i;
    err = photometric_state_new(&start, &coarse, &one);
    if (!err)
        err = sweep(&coarse, &one, s->rays, s->set, &start, &cost, s);
    if (!err) { // is the panorama mirrored?
        struct photometric_state unused = { 0 };
        for (int i = 0; i < one.n; i++)
            one.dir_probe[i][0] *= -1;
        err = photometric_state_new(&unused, &coarse, &one);
        if (!err)
            err = sweep(&coarse, &one, s->rays, s->set, &unused, &mirrored_cost, s);
        photometric_state_free(&unused);
        if (!err && mirrored_cost < .5 * cost)
            out->doubts |= DOUBT_MIRRORED;
    }
    if (err)
        goto end;
    photometric_pack(&coarse, &start, s->x);
    for (int i = 0; i < few.n; i++)
        group[i] = i / coarse_run;
    err = stage1_new(&c, &coarse, &few, s->rays, s->set);
    if (err)
        goto end;
    memcpy(c.base.lights.world_from_probe, start.lights.world_from_probe, sizeof(start.lights.world_from_probe));
    photometric_unpack(&c.p, &c.base, s->x);
    c.p.use_view = seen >= 8 ? inner : fit;
    err = continuation(&c, seen >= 8 ? aside : fit);
    if (err)
        goto end;
    photometric_pack(&c.p, &c.base, s->x);
    memcpy(s->base.lights.world_from_probe, c.base.lights.world_from_probe, sizeof(start.lights.world_from_probe));
    photometric_unpack(&s->p, &s->base, s->x);
    memcpy(s->base.albedo, c.base.albedo, (size_t)p->texels->n * sizeof(*c.base.albedo));
    s->w_sim = c.w_sim;
    s->n_jacobians += c.n_jacobians, s->n_evaluations += c.n_evaluations;
    err = refine(s, fit);
end:
    stage1_free(&c);
    photometric_state_free(&start);
    lights_free(&one);
    lights_free(&few);
    free(group);
    free(inner);
    free(aside);
    return err;
}

// ---- the paper's alternation ----------------------------------------------------------------------------------------

static int by_luminance(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

// Per texel: the darkest quarter (at least 3) into low; the brightest quarter that exceeds 1.3 x the predicted diffuse into high.
static int split_by_luminosity(const struct stage1 *s, float *low, float *high)
{
    const struct samples *m = s->p.samples;
    struct light_arrays lights;
    int err = light_arrays_new(&lights, &s->base.lights);
    const struct kernels *k = kernels_select(KERNELS_ALL);
    float sorted[2048];
    for (int t = 0; !err && t < s->p.texels->n; t++) {
        int n = 0;
        for (int64_t i = m->first[t]; i < m->first[t + 1]; i++) {
            float rgb[3];
            samples_radiance(m, i, rgb);
            low[i] = high[i] = 0;
            if (s->p.use_view && !s->p.use_view[m->view[i]])
                continue;
            if (n < 2048)
                sorted[n++] = rgb[0] + rgb[1] + rgb[2];
        }
        if (!n)
            continue;
        qsort(sorted, (size_t)n, sizeof(float), by_luminance);
        const int quarter = n / 4;
        const float dark = sorted[quarter < 3 ? (n < 3 ? n : 3) - 1 : quarter - 1], bright = sorted[n - 1 - quarter];
        struct surface_point point = { 0 };
        memcpy(point.position_m, s->p.texels->position_m[t], sizeof(point.position_m));
        memcpy(point.normal, s->p.texels->normal[t], sizeof(point.normal));
        float E[3], diffuse = 0;
        k->irradiance(E, &lights, &point, NULL);
        for (int c = 0; c < 3; c++)
            diffuse += E[c] * s->base.albedo[t][c] * (float)M_1_PI;
        for (int64_t i = m->first[t]; i < m->first[t + 1]; i++) {
            float rgb[3];
            samples_radiance(m, i, rgb);
            const float sum = rgb[0] + rgb[1] + rgb[2];
            if (s->p.use_view && !s->p.use_view[m->view[i]])
                continue;
            low[i] = sum <= dark;
            high[i] = sum >= bright && sum > 1.3f * diffuse;
        }
    }
    if (!err)
        light_arrays_free(&lights);
    return err;
}

static int solve_alternating(struct stage1 *s, const uint8_t *fit)
{
    const size_t n = (size_t)s->p.samples->n;
    float *low = malloc((n + 1) * sizeof(float)), *high = malloc((n + 1) * sizeof(float));
    struct photometric_error e;
    int err = low && high ? 0 : -ENOMEM;
    s->p.use_view = fit;
    s->p.texel_step = 1;
    const double start_m = s->set->start_distance_m > 0 ? s->set->start_distance_m : 2;
    set_distances(s, start_m);
    s->stop = "cost";
    if (!err && s->p.model == REFLECT_LAMBERT) { // data sets 1 and 2: the albedo is known or shared, so there is nothing to alternate
        err = photometric_evaluate(&s->p, &s->base, false, &e);
        s->w_sim = s->set->w_sim / fmax(3 * (double)e.n, 1);
        if (!err)
            err = minimise(s, 60, 1e-6, NULL);
        goto end;
    }
    progress_begin("alternating", 30);
    set_distances(s, 0); // Eq. 8
    for (int round = 0; !err && round < 30; round++) {
        struct photometric dark = s->p;
        dark.model = REFLECT_LAMBERT, dark.albedo = ALBEDO_FREE, dark.weight = low;
        err = split_by_luminosity(s, low, high);
        if (!err)
            err = photometric_evaluate(&dark, &s->base, true, &e);
        if (!err)
            err = split_by_luminosity(s, low, high); // with the new albedo
        if (round == 0)
            set_distances(s, start_m);
        if (err)
            break;
        s->p.weight = high, s->p.albedo = ALBEDO_GIVEN;
        err = photometric_evaluate(&s->p, &s->base, false, &e);
        if (err)
            break;
        if (!e.n) {
            s->stop = "no bright samples";
            break;
        }
        s->w_sim = s->set->w_sim / (3 * (double)e.n);
        const double before = e.cost;
        err = minimise(s, 20, 1e-6, NULL);
        if (!err)
            err = photometric_evaluate(&s->p, &s->base, false, &e);
        progress_add(1);
        if (!err && round > 0 && fabs(before - e.cost) < 1e-4 * before)
            break;
        if (round == 29)
            s->stop = "max_iterations";
    }
    progress_end();
end:
    s->p.weight = NULL;
    free(low);
    free(high);
    return err;
}

// ---- the answer -----------------------------------------------------------------------------------------------------------

// Standard deviations from the final normal equations: sigma^2 A^-1, sigma from the residuals' own mean square.
static int uncertainty(struct stage1 *s, struct joint_result *out)
{
    const size_t n = (size_t)s->layout.n;
    double *A = calloc(n * n, sizeof(double)), *C = calloc(n * n, sizeof(double)), *g = calloc(n, sizeof(double)), cost;
    int err = A && C && g ? 0 : -ENOMEM;
    photometric_pack(&s->p, &s->base, s->x);
    const bool in_distance = s->in_distance;
    s->in_distance = false; // of 1/r
    const double w_sim = s->w_sim;
    if (in_distance)
        s->w_sim = 0;
    s->p.texel_step = step_for(s, FINE_SAMPLES);
    if (!err)
        err = normal_callback(s, s->x, &cost, A, g);
    s->in_distance = in_distance;
    s->w_sim = w_sim;
    if (!err) {
        struct photometric_error e;
        err = measure(s, &s->base, s->p.use_view, &e);
        out->objective = 2 * e.cost / fmax(3 * (double)e.n, 1);
        // A is of the mean of squares: covariance = sigma^2 / n_residuals A^-1.
        unsigned char is_free[n];
        for (size_t i = 0; i < n; i++)
            is_free[i] = s->is_free[i] && A[i * n + i] > 0;
        for (size_t i = 0; i < n; i++)
            A[i * n + i] *= 1 + 1e-12;
        const int singular = lm_inverse((int)n, A, is_free, C);
        const double scale = singular ? NAN : out->objective / fmax(3 * (double)e.n, 1);
        double deviation[n]; // infinite: nothing depends on it
        for (size_t i = 0; i < n; i++)
            deviation[i] = is_free[i] ? sqrt(scale * C[i * (n + 1)]) : INFINITY;
        memcpy(out->theta_std, deviation + s->layout.theta, sizeof(out->theta_std));
        memcpy(out->centre_std_m, deviation + s->layout.centre, sizeof(out->centre_std_m));
        memcpy(out->rotation_std_rad, deviation + s->layout.rotation, sizeof(out->rotation_std_rad));
        memcpy(out->inverse_distance_std, deviation + s->layout.inverse_distance, (size_t)s->p.n_groups * sizeof(double));
    }
    s->p.texel_step = 1;
    free(A);
    free(C);
    free(g);
    return err;
}

static int by_double(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static void doubt(const struct stage1 *s, struct joint_result *out, int n_fit_views)
{
    if (n_fit_views < 3)
        out->doubts |= DOUBT_FEW_VIEWS;
    if (s->set->method == METHOD_DIRECTIONAL)
        return;
    double relative[s->p.n_groups];
    int n = 0;
    for (int g = 0; g < s->p.n_groups; g++)
        for (int i = 0; s->is_free[s->layout.inverse_distance + g] && i < s->base.lights.n; i++) // not those without light
            if (s->p.group_of_light[i] == g) {
                relative[n++] = out->inverse_distance_std[g] / s->base.lights.inverse_distance[i];
                break;
            }
    qsort(relative, (size_t)n, sizeof(double), by_double);
    const double centre = vec3_norm(out->centre_std_m);
    if (!(centre < .1) || !(n && relative[n / 2] < .15))
        out->doubts |= DOUBT_UNCERTAIN;
    if (sqrt(out->objective) > .06)
        out->doubts |= DOUBT_POOR_FIT;
}

int joint_solve(struct joint_result *out, const struct texels *texels, const struct samples *samples,
                const struct rays *rays, const struct lights *lights, int n_groups, const uint8_t *hold_out,
                const struct joint_settings *set)
{
    struct stage1 s = { 0 };
    int32_t *group_of_light = malloc((size_t)lights->n * sizeof(*group_of_light));
    struct photometric p = { .texels = texels, .samples = samples, .model = set->model, .variant = set->variant, .albedo = set->albedo,
                             .group_of_light = group_of_light, .n_groups = n_groups, .texel_step = 1, .n_threads = set->n_threads };
    memset(out, 0, sizeof(*out));
    uint8_t *fit = calloc((size_t)samples->n_views + 1, 1), *held = calloc((size_t)samples->n_views + 1, 1);
    int64_t *per_view = calloc((size_t)samples->n_views + 1, sizeof(*per_view));
    out->inverse_distance_std = calloc((size_t)n_groups, sizeof(double));
    int err = fit && held && per_view && group_of_light && out->inverse_distance_std ? 0 : -ENOMEM, n_fit_views = 0, n_held = 0;
    for (int i = 0; !err && i < lights->n; i++)
        group_of_light[i] = i / (lights->n / n_groups);
    for (int64_t i = 0; !err && i < samples->n; i++)
        per_view[samples->view[i]]++;
    for (int v = 0; !err && v < samples->n_views; v++) {
        held[v] = hold_out && hold_out[v] && per_view[v];
        fit[v] = !(hold_out && hold_out[v]) && per_view[v];
        n_fit_views += fit[v], n_held += held[v];
    }
    if (!err && (!samples->n || !n_fit_views)) {
        log_error("joint: no view sees the mesh: are mesh and cameras in one frame?");
        err = -EINVAL;
    }
    struct joint_settings directional = *set;
    if (!err && set->model == REFLECT_LAMBERT && set->albedo == ALBEDO_FREE && set->method != METHOD_DIRECTIONAL) {
        log_warning("joint: %s; the lights are left at infinity", joint_doubt_text(DOUBT_NO_INFORMATION));
        out->doubts |= DOUBT_NO_INFORMATION;
        directional.method = METHOD_DIRECTIONAL;
        set = &directional;
    }
    if (!err) {
        p.use_view = fit;
        err = stage1_new(&s, &p, lights, rays, set);
    }
    if (!err && set->method == METHOD_JOINT) {
        err = solve_joint(&s, &p, lights, fit, out);
    } else if (!err && set->method == METHOD_ALTERNATING) {
        err = solve_alternating(&s, fit);
    } else if (!err) {
        set_distances(&s, 0);
        err = refine(&s, fit);
    }
    struct photometric_error e;
    if (!err)
        err = uncertainty(&s, out);
    if (!err)
        err = measure(&s, &s.base, fit, &e);
    if (!err) {
        out->rmse_fit_percent = photometric_rmse_percent(&e);
        out->n_fit = e.n;
        out->rmse_held_out_percent = -1;
        if (n_held && !(err = measure(&s, &s.base, held, &e))) {
            out->rmse_held_out_percent = photometric_rmse_percent(&e);
            out->n_held_out = e.n;
        }
    }
    if (!err) {
        doubt(&s, out, n_fit_views);
        out->n_jacobians = s.n_jacobians;
        out->n_evaluations = s.n_evaluations;
        out->w_sim = s.w_sim;
        // the paper's is of the bright samples
        out->w_sim_sum = set->method == METHOD_ALTERNATING ? set->w_sim : s.w_sim * s.n_residuals;
        out->stop_reason = s.stop ? s.stop : "";
        out->state = s.base;
        memset(&s.base, 0, sizeof(s.base));
    }
    stage1_free(&s);
    free(fit);
    free(held);
    free(per_view);
    free(group_of_light);
    if (err)
        joint_result_free(out);
    return err;
}

void joint_result_free(struct joint_result *r)
{
    photometric_state_free(&r->state);
    free(r->inverse_distance_std);
    r->inverse_distance_std = NULL;
}
