// solver/relocate.c - the lights once more, under materials that are known per texel.
#include "solver/relocate.h"

#include "solver/stage1.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

enum { SAMPLES = 60000, JUDGED_SAMPLES = 150000 };
static const double first_w_sim = 1e-3, last_w_sim = 1e-8;

static int measure_aside(struct stage1 *s, const uint8_t *aside, double *percent)
{
    struct photometric_error e;
    s->p.texel_step = stage1_step_for(s, JUDGED_SAMPLES);
    int err = photometric_evaluate(&s->p, &s->base, true, &e);
    if (!err)
        err = stage1_measure(s, &s->base, aside, &e);
    *percent = photometric_rmse_percent(&e);
    s->p.texel_step = stage1_step_for(s, SAMPLES);
    return err;
}

int relocate_lights(struct photometric_state *state, const struct texels *texels, const struct samples *samples, const struct rays *rays,
                    const uint8_t *hold_out, const float (*theta)[DISNEY_N], const float (*indirect)[3],
                    const struct joint_settings *settings, double *error_before, double *error_after)
{
    const int n_views = samples->n_views;
    struct joint_settings set = *settings;
    struct stage1 s = { 0 };
    struct photometric_state best = { 0 };
    int32_t *group = malloc((size_t)state->lights.n * sizeof(*group));
    uint8_t *fit = calloc((size_t)n_views + 1, 1), *aside = calloc((size_t)n_views + 1, 1);
    struct photometric p = { .texels = texels, .samples = samples, .model = REFLECT_DISNEY, .variant = set.variant, .albedo = ALBEDO_FREE,
                             .group_of_light = group, .n_groups = group ? lights_number_distances(&state->lights, group) : 0, .use_view = fit, .texel_step = 1, .n_threads = set.n_threads,
                             .theta_of_texel = theta, .indirect = indirect };
    int err = group && fit && aside ? 0 : -ENOMEM;
    for (int v = 0, seen = 0; !err && v < n_views; v++)
        if (!(hold_out && hold_out[v])) {
            aside[v] = seen++ % 6 == 3;
            fit[v] = !aside[v];
        }
    if (!err)
        err = stage1_new(&s, &p, &state->lights, rays, &set);
    if (!err)
        err = photometric_state_new(&best, &p, &state->lights);
    if (err)
        goto end;
    stage1_keep_ratios(&s);
    memcpy(s.base.theta, state->theta, sizeof(s.base.theta));
    memcpy(s.base.albedo, state->albedo, (size_t)texels->n * sizeof(*state->albedo));
    memcpy(s.base.log_gain, state->log_gain, (size_t)n_views * sizeof(double));
    memset(s.is_free + s.layout.theta, 0, DISNEY_N);
    s.p.texel_step = stage1_step_for(&s, SAMPLES);
    err = stage1_trace_visibility(&s);
    if (!err)
        err = measure_aside(&s, aside, error_before);
    *error_after = *error_before;
    photometric_state_copy(&p, &best, &s.base);
    for (double w = first_w_sim; !err && w >= .5 * last_w_sim; w /= 10) {
        double error;
        s.w_sim = w;
        err = stage1_minimise(&s, 8, 1e-3, NULL);
        if (!err)
            err = stage1_trace_visibility(&s);
        if (!err)
            err = measure_aside(&s, aside, &error);
        if (err)
            break;
        log_debug("relocate: w_sim %.0e: views aside %.4f %%", w, error);
        if (error < *error_after) {
            *error_after = error;
            photometric_state_copy(&p, &best, &s.base);
        } else if (w < 1e-5) {
            break;
        }
    }
    if (!err)
        photometric_state_copy(&p, state, &best);
end:
    stage1_free(&s);
    photometric_state_free(&best);
    free(group);
    free(fit);
    free(aside);
    return err;
}
