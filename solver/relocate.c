// solver/relocate.c - the lights once more, under materials that are known per texel.
#include "solver/relocate.h"

#include "solver/stage1.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { SAMPLES = 60000, FINE_SAMPLES = 200000 };
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
    for (double w = first_w_sim; !err && w >= .5 * last_w_sim; w /= 10) {
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
    return err;
}

int relocate_lights(struct photometric_state *state, const struct texels *texels, const struct samples *samples, const struct rays *rays,
                    const uint8_t *hold_out, const float (*theta)[DISNEY_N], const float (*indirect)[3],
                    const struct joint_settings *settings, double *error_before, double *error_after)
{
    const int n_views = samples->n_views;
    const struct joint_settings set = *settings;
    struct relocation r = { .fit = calloc((size_t)n_views + 1, 1), .aside = calloc((size_t)n_views + 1, 1) };
    struct stage1 *s = &r.s;
    int32_t *group = malloc((size_t)state->lights.n * sizeof(*group));
    struct photometric p = { .texels = texels, .samples = samples, .model = REFLECT_DISNEY, .variant = set.variant, .albedo = ALBEDO_FREE,
                             .group_of_light = group, .n_groups = group ? lights_number_distances(&state->lights, group) : 0, .use_view = r.fit, .texel_step = 1, .n_threads = set.n_threads,
                             .theta_of_texel = theta, .indirect = indirect };
    int err = group && r.fit && r.aside ? 0 : -ENOMEM;
    for (int v = 0, seen = 0; !err && v < n_views; v++)
        if (!(hold_out && hold_out[v])) {
            r.aside[v] = seen++ % 6 == 3;
            r.fit[v] = !r.aside[v];
        }
    if (!err)
        err = stage1_new(s, &p, &state->lights, rays, &set);
    if (!err)
        err = photometric_state_new(&r.best, &p, &state->lights);
    if (err)
        goto end;
    stage1_keep_ratios(s);
    memcpy(s->base.theta, state->theta, sizeof(s->base.theta));
    memcpy(s->base.albedo, state->albedo, (size_t)texels->n * sizeof(*state->albedo));
    memcpy(s->base.log_gain, state->log_gain, (size_t)n_views * sizeof(double));
    memset(s->is_free + s->layout.theta, 0, DISNEY_N);
    err = stage1_trace_visibility(s);
    if (!err)
        err = measure_aside(&r, error_before);
    r.error = *error_before;
    photometric_state_copy(&p, &r.best, &s->base);
    if (!err)
        err = search(&r);
    *error_after = r.error;
    if (!err)
        photometric_state_copy(&p, state, &r.best);
end:
    stage1_free(s);
    photometric_state_free(&r.best);
    free(group);
    free(r.fit);
    free(r.aside);
    return err;
}
