// solver/relocate.c - the lights once more, under materials that are known per texel.
#include "solver/relocate.h"

#include "solver/stage1.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { SAMPLES = 60000, FINE_SAMPLES = 200000, N_WEIGHTS = 7 }; // from the first w_sim to the last by tens
static const double first_w_sim = 1e-3, last_w_sim = 1e-9;
static const double least_gain = .045; // percent of white, root of the difference of squares: less is sampling and points for lights

struct relocation {
    struct stage1 s;
    struct photometric_state best;
    uint8_t *fit, *aside;
    double error; // of `best`, percent
};

static int measure_aside(struct relocation *r, double *percent)
{
    struct stage1 *s = &r->s;
    struct photometric_error e;
    s->p.texel_step = stage1_step_for(s, FINE_SAMPLES);
    int err = photometric_evaluate(&s->p, &s->base, true, &e);
    if (!err)
        err = stage1_measure(s, &s->base, r->aside, &e);
    *percent = photometric_rmse_percent(&e);
    s->p.texel_step = stage1_step_for(s, SAMPLES);
    return err;
}

// The continuation. What views aside like better becomes the best.
static int search(struct relocation *r)
{
    struct stage1 *s = &r->s;
    int err = 0, n_worse = 0;
    double least = INFINITY;
    progress_begin("lights again", N_WEIGHTS);
    for (double w = first_w_sim; !err && w >= .5 * last_w_sim; w /= 10, progress_add(1)) {
        double error;
        s->w_sim = w;
        err = stage1_minimise(s, 8, 1e-3, NULL);
        if (!err)
            err = stage1_trace_visibility(s);
        if (!err)
            err = measure_aside(r, &error);
        if (err)
            break;
        log_debug("relocate: w_sim %.0e: views aside %.4f %%", w, error);
        if (error < r->error && error * error < r->error * r->error - least_gain * least_gain) {
            r->error = error;
            photometric_state_copy(&s->p, &r->best, &s->base);
        }
        n_worse = error < .99 * least ? 0 : n_worse + 1;
        least = fmin(least, error);
        if (n_worse > 1 && w < 1e-6)
            break;
    }
    progress_end();
    return err;
}

// Everything but theta free, from the lights of `from`. `group` and `use_view` are kept.
static int begin(struct stage1 *s, const struct photometric_state *from, int32_t *group, const struct texels *texels, const struct samples *samples,
                 const struct rays *rays, const uint8_t *use_view, const float (*theta)[DISNEY_N], const float (*indirect)[3],
                 const struct joint_settings *set)
{
    const struct photometric p = { .texels = texels, .samples = samples, .model = REFLECT_DISNEY, .variant = set->variant, .albedo = ALBEDO_FREE,
                                   .group_of_light = group, .n_groups = lights_number_distances(&from->lights, group), .use_view = use_view,
                                   .texel_step = 1, .n_threads = set->n_threads, .theta_of_texel = theta, .indirect = indirect };
    const int err = stage1_new(s, &p, &from->lights, rays, set);
    if (err)
        return err;
    stage1_keep_ratios(s);
    memcpy(s->base.theta, from->theta, sizeof(s->base.theta));
    memcpy(s->base.albedo, from->albedo, (size_t)texels->n * sizeof(*from->albedo));
    memcpy(s->base.log_gain, from->log_gain, (size_t)samples->n_views * sizeof(double));
    memset(s->is_free + s->layout.theta, 0, DISNEY_N);
    return stage1_trace_visibility(s);
}

int relocate_lights(struct photometric_state *state, const struct texels *texels, const struct samples *samples, const struct rays *rays,
                    const uint8_t *hold_out, const float (*theta)[DISNEY_N], const float (*indirect)[3],
                    const struct joint_settings *settings, double *error_before, double *error_after)
{
    const int n_views = samples->n_views;
    struct relocation r = { .fit = calloc((size_t)n_views + 1, 1), .aside = calloc((size_t)n_views + 1, 1) };
    struct stage1 *s = &r.s;
    int32_t *group = malloc((size_t)state->lights.n * sizeof(*group));
    int err = group && r.fit && r.aside ? 0 : -ENOMEM;
    for (int v = 0, seen = 0; !err && v < n_views; v++)
        if (!(hold_out && hold_out[v])) {
            r.aside[v] = seen++ % 6 == 3;
            r.fit[v] = !r.aside[v];
        }
    if (!err)
        err = begin(s, state, group, texels, samples, rays, r.fit, theta, indirect, settings);
    if (!err)
        err = photometric_state_new(&r.best, &s->p, &state->lights);
    if (err)
        goto end;
    err = measure_aside(&r, error_before);
    r.error = *error_before;
    photometric_state_copy(&s->p, &r.best, &s->base);
    if (!err)
        err = search(&r);
    *error_after = r.error;
    if (!err)
        photometric_state_copy(&s->p, state, &r.best);
end:
    stage1_free(s);
    photometric_state_free(&r.best);
    free(group);
    free(r.fit);
    free(r.aside);
    return err;
}

int relocate_doubt(struct joint_result *result, const struct texels *texels, const struct samples *samples, const struct rays *rays,
                   const uint8_t *hold_out, const float (*theta)[DISNEY_N], const float (*indirect)[3], const struct joint_settings *settings)
{
    const int n_views = samples->n_views;
    struct stage1 s = { 0 };
    struct photometric_error e;
    int32_t *group = malloc((size_t)result->state.lights.n * sizeof(*group));
    uint8_t *fit = calloc((size_t)n_views + 1, 1);
    int err = group && fit ? 0 : -ENOMEM, n_fit = 0;
    for (int v = 0; !err && v < n_views; v++)
        fit[v] = !(hold_out && hold_out[v]), n_fit += fit[v];
    if (!err)
        err = begin(&s, &result->state, group, texels, samples, rays, fit, theta, indirect, settings);
    if (!err)
        err = photometric_evaluate(&s.p, &s.base, true, &e);
    double theta_std[DISNEY_N]; // theta is held here: stage 1's own deviations stay
    memcpy(theta_std, result->theta_std, sizeof(theta_std));
    if (!err)
        err = stage1_uncertainty(&s, result);
    memcpy(result->theta_std, theta_std, sizeof(theta_std));
    if (!err) {
        result->doubts &= ~(unsigned)(DOUBT_UNCERTAIN | DOUBT_POOR_FIT);
        stage1_doubt(&s, result, n_fit);
        log_debug("relocate: structure %.4f of level %.4f, distances' deviation %.1f %%, centre's %.1f cm", result->misfit.structure, result->misfit.level,
                  100 * result->distance_std_relative, 100 * vec3_norm(result->centre_std_m));
    }
    stage1_free(&s);
    free(group);
    free(fit);
    return err;
}
