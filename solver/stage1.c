// solver/stage1.c - stage 1 as a problem for lm.h: E_photo + w_sim E_sim (Eqs. 6, 11, 12) over theta, c, R and the distances.
#include "solver/stage1.h"

#include "solver/lm.h"
#include "solver/parallel.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

enum { N_NEIGHBOURS = 8 };
static const double least_q = .02, most_q = 5; // 50 m .. 20 cm
static const double centre_guess_m = .3;       // how well the centre of the panorama is known at the start

struct neighbour_pair {
    int i, j;
    double weight; // 1 / |dh_i - dh_j|^2
};

// ---- E_sim --------------------------------------------------------------------------------------------------------------

// The group's direction: energy-weighted. Groups without energy are left out of everything.
static int find_pairs(struct stage1 *s, const struct lights *l)
{
    const int n = s->p.n_groups;
    double(*d)[3] = s->group_dir = calloc((size_t)n, sizeof(*d));
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
            s->pairs[s->n_pairs++] = (struct neighbour_pair){ g, nearest[k], 1 / fmax(distance2[k], 1e-6) };
    }
    free(lit);
    return err;
}

static const double similarity_on_planes = .1;

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

// Eq. 11 or, between lights on planes, these; and for joint the first guess of the centre.
static double add_similarity(const struct stage1 *s, const double *x, double *A, double *g)
{
    const int first = s->layout.inverse_distance, n = s->layout.n;
    double cost = 0;
    for (int k = 0; s->w_sim > 0 && k < s->n_pairs; k++) {
        const int i = first + s->pairs[k].i, j = first + s->pairs[k].j;
        double si, sj;
        // Of lights on planes, these say more; but a plane that the pictures hardly see must not drift off either.
        const bool on_planes = s->emitters.n && s->emitters.of[i - first] >= 0 && s->emitters.of[j - first] >= 0;
        const double w = (on_planes ? similarity_on_planes : 1) * s->w_sim * s->pairs[k].weight;
        const double e = similarity_of(s, x[i], &si) - similarity_of(s, x[j], &sj);
        cost += .5 * w * e * e;
        if (!A)
            continue;
        g[i] += w * e * si, g[j] -= w * e * sj;
        A[(size_t)i * n + i] += w * si * si, A[(size_t)j * n + j] += w * sj * sj;
        A[(size_t)(i > j ? i : j) * n + (i > j ? j : i)] -= w * si * sj;
    }
    if (s->emitters.n)
        cost += emitters_add_cost(&s->emitters, s->p.n_groups, (const double(*)[3])s->group_dir, x + first, s->plane_scale, s->w_plane, n,
                                  first, A, g);
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
    if (!err && s->p.albedo == ALBEDO_FREE && s->p.model == REFLECT_DISNEY) { // the tint follows; the cost again, for the next trials' sake
        memcpy(s->base.albedo, s->trial.albedo, (size_t)s->p.texels->n * sizeof(*s->base.albedo));
        err = evaluate_at(s, x, cost);
    }
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
    return 0;
}

void stage1_add_prior(const struct stage1 *s, double *P)
{
    const int n = s->layout.n;
    struct stage1 known = *s;
    double g[n];
    memset(g, 0, sizeof(g));
    if (s->set->method == METHOD_DIRECTIONAL)
        return;
    known.in_distance = false;
    known.w_sim = 1. / N_NEIGHBOURS;
    known.w_plane = s->w_sim > 0 ? s->w_plane / s->w_sim * known.w_sim : 0;
    photometric_pack(&s->p, &s->base, s->x);
    add_similarity(&known, s->x, P, g);
    for (int v = 0; s->set->gain && v < s->layout.n_views; v++)
        P[(size_t)(s->layout.gain + v) * n + s->layout.gain + v] += gain_precision();
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

void stage1_set_planes(struct stage1 *s, struct emitters *e, double w_plane)
{
    photometric_pack(&s->p, &s->base, s->x);
    const double *q = s->x + s->layout.inverse_distance;
    emitters_free(&s->emitters);
    s->emitters = *e;
    memset(e, 0, sizeof(*e));
    s->w_plane = w_plane;
    for (int g = 0; g < s->p.n_groups; g++)
        s->plane_scale[g] = q[g];
    s->p.ratio_of_light = s->ratio;
    for (int i = 0; i < s->base.lights.n; i++) {
        const int g = s->p.group_of_light[i], k = s->emitters.n ? s->emitters.of[g] : -1;
        const double *m = k < 0 ? NULL : s->emitters.plane[k];
        s->ratio[i] = 1;
        if (m)
            s->ratio[i] = (float)fmin(fmax(vec3_dot(m, s->base.lights.dir_probe[i]) / vec3_dot(m, s->group_dir[g]), .5), 2);
        s->base.lights.inverse_distance[i] = q[g] * (double)s->ratio[i];
    }
}

void stage1_keep_ratios(struct stage1 *s)
{
    const struct lights *l = &s->base.lights;
    for (int g = 0; g < s->p.n_groups; g++) {
        double sum = 0;
        int n = 0;
        bool infinite = false;
        for (int i = 0; i < l->n; i++)
            if (s->p.group_of_light[i] == g)
                sum += l->inverse_distance[i], n++, infinite |= l->inverse_distance[i] <= 0;
        for (int i = 0; i < l->n; i++)
            if (s->p.group_of_light[i] == g)
                s->ratio[i] = infinite ? 1 : (float)(l->inverse_distance[i] * n / sum);
    }
    s->p.ratio_of_light = s->ratio;
}

int stage1_trace_visibility(struct stage1 *s)
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
int stage1_minimise(struct stage1 *s, int max_iterations, double relative_cost, double *cost)
{
    const struct lm_problem problem = { s->layout.n, s->lower, s->upper, cost_callback, normal_callback, s };
    struct lm_settings settings = lm_defaults();
    struct lm_result r;
    double scratch[s->layout.n];
    settings.max_iterations = max_iterations;
    settings.relative_cost = relative_cost;
    if (s->in_distance) // radiance is far from linear in r, and a light that comes near the object changes everything
        settings.mu = 10, settings.fresh_scale = true;
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

void stage1_set_distances(struct stage1 *s, double distance_m)
{
    for (int i = 0; i < s->base.lights.n; i++)
        s->base.lights.inverse_distance[i] = distance_m > 0 ? 1 / distance_m : 0;
}

// ---- a stage's life --------------------------------------------------------------------------------------------------------

int stage1_new(struct stage1 *s, const struct photometric *p, const struct lights *lights, const struct rays *rays,
               const struct joint_settings *set)
{
    memset(s, 0, sizeof(*s));
    s->set = set, s->p = *p, s->rays = rays;
    s->layout = photometric_layout_of(p->samples->n_views, p->n_groups);
    s->in_distance = set->method == METHOD_ALTERNATING;
    memcpy(s->first_centre_m, lights->centre_m, sizeof(s->first_centre_m));
    const size_t n = (size_t)s->layout.n;
    s->is_free = calloc(n, 1);
    s->ratio = calloc((size_t)lights->n, sizeof(float));
    s->plane_scale = calloc((size_t)p->n_groups, sizeof(double));
    s->x = calloc(n, sizeof(double));
    s->lower = calloc(n, sizeof(double));
    s->upper = calloc(n, sizeof(double));
    if (!s->is_free || !s->ratio || !s->plane_scale || !s->x || !s->lower || !s->upper)
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

void stage1_free(struct stage1 *s)
{
    photometric_state_free(&s->base);
    photometric_state_free(&s->trial);
    light_visibility_free(&s->visibility);
    emitters_free(&s->emitters);
    free(s->plane_scale);
    free(s->ratio);
    free(s->group_dir);
    free(s->pairs);
    free(s->is_free);
    free(s->x);
    free(s->lower);
    free(s->upper);
    memset(s, 0, sizeof(*s));
}

// Over the texels that the views in s->p saw: others have no albedo to be judged.
int stage1_measure(const struct stage1 *s, const struct photometric_state *state, const uint8_t *use_view,
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

// Every so many texels, so that about n_samples are left; odd, so as not to fall in step with the texture's rows.
int stage1_step_for(const struct stage1 *s, int64_t n_samples)
{
    const int64_t step = s->p.samples->n / n_samples;
    return step < 1 ? 1 : (int)step | 1;
}
