// solver/joint.c - stage 1 of the solver: three methods over photometric.h and lm.h.
#include "solver/stage1.h"

#include "solver/lm.h"
#include "solver/misfit.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

const char *const method_names[3] = { "joint", "alternating", "directional" };

struct joint_settings joint_defaults(enum method method)
{
    return (struct joint_settings){ .method = method, .w_sim = method == METHOD_ALTERNATING ? 3e-9 : -1,
                                    .start_distance_m = method == METHOD_ALTERNATING ? 2 : 0, .visibility = method == METHOD_JOINT,
                                    .continuation = true, .coarse_samples = 30000, .fine_samples = 200000, .planes = method == METHOD_JOINT, .robust = false };
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

// ---- the stages of a solve ----------------------------------------------------------------------------------------------

static const double first_w_sim = 1e-3; // of the continuation, and of the sweep

// Of each group, every `run` neighbours become one light: the sum of their irradiance, from its mean direction. run 0: the whole group.
static int merge_lights(struct lights *out, int32_t *group, const struct lights *fine, const int32_t *fine_group, int run)
{
    int n = 0, since = 0;
    for (int i = 0; i < fine->n; i++) { // group[] of the fine ones first
        if (i == 0 || fine_group[i] != fine_group[i - 1] || (run && since == run))
            n++, since = 0;
        since++;
    }
    const int err = lights_new(out, n);
    if (err)
        return err;
    memcpy(out->centre_m, fine->centre_m, sizeof(out->centre_m));
    memcpy(out->world_from_probe, fine->world_from_probe, sizeof(out->world_from_probe));
    for (int i = 0, first = 0; i < n; i++) {
        double d[3] = { 0 };
        int k = first;
        for (; k < fine->n && fine_group[k] == fine_group[first] && (!run || k < first + run); k++) {
            const double *C = fine->irradiance[k];
            vec3_add_scaled(d, d, C[0] + C[1] + C[2], fine->dir_probe[k]);
            vec3_add_scaled(out->irradiance[i], out->irradiance[i], 1, C);
        }
        if (vec3_normalise(d) == 0)
            memcpy(d, fine->dir_probe[first], sizeof(d));
        memcpy(out->dir_probe[i], d, sizeof(d));
        out->inverse_distance[i] = fine->inverse_distance[first];
        group[i] = fine_group[first];
        first = k;
    }
    return 0;
}

enum { N_SWEPT = 5 };

// The common distance of all lights, by brute trial at few texels: one group, so a Jacobian costs little.
static int sweep(const struct photometric *p, const struct lights *lights, const struct rays *rays,
                 const struct joint_settings *set, struct photometric_state *best, double *best_cost, struct stage1 *total)
{
    static const double distances_m[N_SWEPT] = { .7, 1.1, 1.7, 2.6, 4 };
    int32_t *one_group = calloc((size_t)lights->n, sizeof(*one_group));
    struct photometric coarse = *p;
    struct stage1 s = { 0 };
    int err = one_group ? 0 : -ENOMEM;
    *best_cost = INFINITY;
    coarse.group_of_light = one_group;
    coarse.n_groups = 1;
    const struct stage1 all = { .p = *p };
    coarse.texel_step = stage1_step_for(&all, set->coarse_samples);
    const int n = set->start_distance_m > 0 ? 1 : N_SWEPT;
    for (int k = 0; !err && k < n; k++) {
        double cost;
        err = stage1_new(&s, &coarse, lights, rays, set);
        if (!err) {
            stage1_set_distances(&s, n == 1 ? set->start_distance_m : distances_m[k]);
            err = stage1_trace_visibility(&s);
        }
        if (!err) {
            s.w_sim = first_w_sim;
            err = stage1_minimise(&s, 12, 1e-4, &cost);
        }
        if (!err && cost < *best_cost) {
            *best_cost = cost;
            photometric_state_copy(&coarse, best, &s.base);
        }
        total->n_jacobians += s.n_jacobians, total->n_evaluations += s.n_evaluations;
        total->n_sweep_jacobians += s.n_jacobians;
        stage1_free(&s);
        progress_add(N_SWEPT / n);
    }
    free(one_group);
    return err;
}

// To gain less than this is to gain nothing (percent of white, root of the difference of squares): sampling the pictures, and lights that
// are points, leave as much. And a quarter of what else the model lacks, as the best fit shows it; all of it where that is much (several
// materials, say): lights would go anywhere to explain a little of it.
static const double floor_percent = .045, floor_of_structure = .25;
// A plane's lights are held on it this much harder than neighbours on one sphere, of which each has 8 at 1 / |dh_i - dh_j|^2 ~ 50.
static const double plane_share = 400, plane_tolerance = .06;

// Lights that lie on one plane by now are held on it.
static int find_planes(struct stage1 *s, double tolerance, double w_plane)
{
    struct emitters planes;
    const int first = s->layout.inverse_distance, n_groups = s->p.n_groups;
    double q[n_groups];
    int n_on = 0;
    photometric_pack(&s->p, &s->base, s->x);
    for (int g = 0; g < n_groups; g++)
        q[g] = s->is_free[first + g] ? s->x[first + g] : 0;
    const int err = emitters_find(&planes, n_groups, (const double(*)[3])s->group_dir, q, tolerance);
    if (err)
        return err;
    for (int g = 0; g < n_groups; g++)
        n_on += planes.of[g] >= 0;
    log_debug("joint: %d of %d lights on %d planes", n_on, n_groups, planes.n);
    stage1_set_planes(s, &planes, w_plane);
    return 0;
}

// Lights that lie on one plane are held on it; twice, for lights that stand better may join. `before`, without planes, is what remains
// where the views set aside do not like it.
static int put_on_planes(struct stage1 *s, const uint8_t *aside, const struct photometric_state *before, double error_before)
{
    struct emitters none = { 0 };
    struct photometric_error e;
    int err = 0;
    for (int k = 0; !err && k < 2; k++) {
        err = find_planes(s, plane_tolerance, plane_share * s->w_sim);
        s->p.texel_step = stage1_step_for(s, s->set->coarse_samples);
        if (!err)
            err = stage1_minimise(s, 8, 2e-3, NULL);
        s->p.texel_step = stage1_step_for(s, s->set->fine_samples);
        if (!err)
            err = photometric_evaluate(&s->p, &s->base, s->p.albedo == ALBEDO_FREE, &e);
        if (!err)
            err = stage1_measure(s, &s->base, aside, &e);
        log_debug("joint: views set aside %.4f %%, before %.4f %%", photometric_rmse_percent(&e), error_before);
    }
    if (err || photometric_rmse_percent(&e) <= error_before)
        return err;
    stage1_set_planes(s, &none, 0);
    photometric_state_copy(&s->p, &s->base, before);
    return 0;
}

// Continuation: w_sim falls by decades, and after each step the views set aside are measured. Kept is the *largest* weight whose
// error is as good as the best: below that, lights that the pictures hardly see drift off for nothing. Then planes.
static int continuation(struct stage1 *s, const uint8_t *aside)
{
    enum { MAX_STEPS = 13 };
    const double last = s->set->w_sim >= 0 ? s->set->w_sim : 0;
    struct photometric_state at[MAX_STEPS] = { { .theta = { 0 } } };
    double error[MAX_STEPS], weight[MAX_STEPS], best = INFINITY;
    int n = 0, n_worse = 0, chosen = 0, err = 0;
    progress_begin("joint", MAX_STEPS);
    for (double w = s->set->continuation ? first_w_sim : last; !err && n < MAX_STEPS; w = w > 1e-13 ? w / 10 : 0) {
        struct photometric_error e;
        s->w_sim = weight[n] = w > last ? w : last;
        s->p.texel_step = stage1_step_for(s, s->set->coarse_samples);
        err = stage1_trace_visibility(s);
        if (!err)
            err = stage1_minimise(s, 8, 2e-3, NULL);
        s->p.texel_step = stage1_step_for(s, s->set->fine_samples);
        if (!err) // the albedo of more texels, for the views set aside
            err = photometric_evaluate(&s->p, &s->base, s->p.albedo == ALBEDO_FREE, &e);
        if (!err)
            err = stage1_measure(s, &s->base, aside, &e);
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
    struct misfit left = { 0 };
    for (int k = 0; !err && k < n; k++)
        if (error[k] == best) {
            photometric_state_copy(&s->p, &s->base, &at[k]);
            err = misfit_measure(&left, &s->p, &s->base);
        }
    if (!err) {
        const double lacking = (misfit_is_poor(&left) ? 1 : floor_of_structure) * left.structure;
        const double enough = hypot(best, hypot(floor_percent, 100 * lacking));
        log_debug("joint: views set aside %.4f %% at best, %.4f %% is as good (structure %.4f %%)", best, enough, 100 * left.structure);
        for (chosen = 0; s->set->w_sim < 0 && error[chosen] > enough;)
            chosen++;
        if (s->set->w_sim >= 0)
            chosen = n - 1;
        photometric_state_copy(&s->p, &s->base, &at[chosen]);
        s->w_sim = weight[chosen];
        log_debug("joint: w_sim %.0e it is", s->w_sim);
        if (s->set->planes)
            err = put_on_planes(s, aside, &at[chosen], error[chosen]);
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
    s->p.texel_step = stage1_step_for(s, s->set->fine_samples);
    int err = stage1_trace_visibility(s);
    if (!err && s->set->robust) {
        double sigma;
        weight = malloc((size_t)s->p.samples->n * sizeof(float) + 1);
        err = weight ? photometric_scale(&s->p, &s->base, &sigma) : -ENOMEM;
        if (!err)
            err = photometric_robust_weights(&s->p, &s->base, 3 * sigma, NULL, weight);
        s->p.weight = weight;
    }
    if (!err)
        err = stage1_minimise(s, 15, 1e-5, NULL);
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
    const int n_views = s->layout.n_views, run = lights->n / (4 * p->n_groups);
    struct lights one = { 0 }, few = { 0 };
    struct photometric coarse = *p;
    struct photometric_state start = { 0 };
    struct stage1 c = { 0 };
    double cost, mirrored_cost;
    int32_t *group = malloc((size_t)lights->n * sizeof(*group)), *few_group = malloc((size_t)lights->n * sizeof(*group));
    uint8_t *inner = malloc((size_t)n_views), *aside = malloc((size_t)n_views);
    int err = group && few_group && inner && aside ? 0 : -ENOMEM, seen = 0;
    for (int v = 0; !err && v < n_views; v++) {
        aside[v] = fit[v] && seen++ % 6 == 3;
        inner[v] = fit[v] && !aside[v];
    }
    if (!err)
        err = merge_lights(&one, group, lights, p->group_of_light, 0);
    if (!err)
        err = merge_lights(&few, few_group, lights, p->group_of_light, run > 1 ? run : 1);
    if (err)
        goto end;
    coarse.group_of_light = group;
    progress_begin("sweep", 2 * N_SWEPT);
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
    progress_end();
    if (err)
        goto end;
    photometric_pack(&coarse, &start, s->x);
    coarse.group_of_light = few_group;
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
    if (c.emitters.n)
        stage1_set_planes(s, &c.emitters, c.w_plane);
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
    free(few_group);
    free(inner);
    free(aside);
    return err;
}

// ---- the answer -----------------------------------------------------------------------------------------------------------

// Standard deviations, and whether what is left of the pictures is more than noise.
int stage1_uncertainty(struct stage1 *s, struct joint_result *out)
{
    const size_t n = (size_t)s->layout.n;
    double *prior = calloc(n * n, sizeof(double)), deviation[n];
    struct photometric_error e;
    int err = prior ? 0 : -ENOMEM;
    s->p.texel_step = stage1_step_for(s, s->set->fine_samples);
    if (!err) {
        stage1_add_prior(s, prior);
        for (size_t i = 0; i < n; i++) // both triangles
            for (size_t j = 0; j < i; j++)
                prior[j * n + i] = prior[i * n + j];
        err = misfit_deviations(deviation, &out->inflation, &s->p, &s->base, s->is_free, prior);
    }
    if (!err)
        err = misfit_measure(&out->misfit, &s->p, &s->base);
    if (!err)
        err = stage1_measure(s, &s->base, s->p.use_view, &e);
    if (!err) {
        out->objective = 2 * e.cost / fmax(3 * (double)e.n, 1);
        memcpy(out->theta_std, deviation + s->layout.theta, sizeof(out->theta_std));
        memcpy(out->centre_std_m, deviation + s->layout.centre, sizeof(out->centre_std_m));
        memcpy(out->rotation_std_rad, deviation + s->layout.rotation, sizeof(out->rotation_std_rad));
        memcpy(out->inverse_distance_std, deviation + s->layout.inverse_distance, (size_t)s->p.n_groups * sizeof(double));
    }
    s->p.texel_step = 1;
    free(prior);
    return err;
}

void stage1_doubt(const struct stage1 *s, struct joint_result *out, int n_fit_views)
{
    if (n_fit_views < 3)
        out->doubts |= DOUBT_FEW_VIEWS;
    if (s->set->method == METHOD_DIRECTIONAL)
        return;
    double sum = 0;
    int n = 0;
    for (int g = 0, i = 0; g < s->p.n_groups; g++) {
        for (; i < s->base.lights.n && s->p.group_of_light[i] < g; i++)
            ;
        if (s->is_free[s->layout.inverse_distance + g] && i < s->base.lights.n) { // not those without light
            sum += out->inverse_distance_std[g] / s->base.lights.inverse_distance[i];
            n++;
        }
    }
    out->distance_std_relative = n ? sum / n : INFINITY;
    if (!(vec3_norm(out->centre_std_m) < .1) || !(out->distance_std_relative < .15))
        out->doubts |= DOUBT_UNCERTAIN;
    if (misfit_is_poor(&out->misfit))
        out->doubts |= DOUBT_POOR_FIT;
}

int joint_solve(struct joint_result *out, const struct texels *texels, const struct samples *samples,
                const struct rays *rays, const struct lights *lights, const uint8_t *hold_out, const struct joint_settings *set)
{
    struct stage1 s = { 0 };
    int32_t *group_of_light = malloc((size_t)lights->n * sizeof(*group_of_light));
    const int n_groups = group_of_light ? lights_number_distances(lights, group_of_light) : 0;
    struct photometric p = { .texels = texels, .samples = samples, .model = set->model, .variant = set->variant, .albedo = set->albedo,
                             .group_of_light = group_of_light, .n_groups = n_groups, .texel_step = 1, .n_threads = set->n_threads };
    memset(out, 0, sizeof(*out));
    out->n_distances = n_groups;
    uint8_t *fit = calloc((size_t)samples->n_views + 1, 1), *held = calloc((size_t)samples->n_views + 1, 1);
    int64_t *per_view = calloc((size_t)samples->n_views + 1, sizeof(*per_view));
    out->inverse_distance_std = calloc((size_t)n_groups, sizeof(double));
    int err = fit && held && per_view && group_of_light && out->inverse_distance_std ? 0 : -ENOMEM, n_fit_views = 0, n_held = 0;
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
        err = stage1_alternate(&s, fit);
    } else if (!err) {
        stage1_set_distances(&s, 0);
        err = refine(&s, fit);
    }
    struct photometric_error e;
    if (!err)
        err = stage1_uncertainty(&s, out);
    if (!err)
        err = stage1_measure(&s, &s.base, fit, &e);
    if (!err) {
        out->rmse_fit_percent = photometric_rmse_percent(&e);
        out->n_fit = e.n;
        out->rmse_held_out_percent = -1;
        if (n_held && !(err = stage1_measure(&s, &s.base, held, &e))) {
            out->rmse_held_out_percent = photometric_rmse_percent(&e);
            out->n_held_out = e.n;
        }
    }
    if (!err) {
        stage1_doubt(&s, out, n_fit_views);
        out->n_jacobians = s.n_jacobians;
        out->n_sweep_jacobians = s.n_sweep_jacobians;
        out->n_evaluations = s.n_evaluations;
        out->w_sim = s.w_sim;
        out->w_sim_sum = set->method == METHOD_ALTERNATING ? s.w_sim_sum : s.w_sim * s.n_residuals;
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
