// solver/alternating.c - the paper's alternation (Eqs. 8-12), as plainly as it can be had: the yardstick for joint.c.
#include "solver/stage1.h"

#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

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

// Where the search for the distances begins: 1/r of each light.
static void first_distances(const struct stage1 *s, double *inverse_distance)
{
    const double common_m = s->set->start_distance_m > 0 ? s->set->start_distance_m : 2;
    for (int i = 0; i < s->base.lights.n; i++) {
        const double own = s->base.lights.inverse_distance[i];
        inverse_distance[i] = s->set->start_distance_m > 0 || own <= 0 ? 1 / common_m : own;
    }
}

// No light is inside the object: there, where what it lights ends, the search sticks.
static void keep_lights_off(struct stage1 *s)
{
    const struct texels *t = s->p.texels;
    double radius_m = 0;
    for (int i = 0; i < t->n; i++) {
        double off[3];
        for (int c = 0; c < 3; c++)
            off[c] = t->position_m[i][c] - s->first_centre_m[c];
        radius_m = fmax(radius_m, vec3_norm(off));
    }
    for (int g = 0; g < s->p.n_groups; g++) {
        double *lower = &s->lower[s->layout.inverse_distance + g];
        *lower = fmin(fmax(*lower, 1.5 * radius_m), s->upper[s->layout.inverse_distance + g]);
    }
}

int stage1_alternate(struct stage1 *s, const uint8_t *fit)
{
    const size_t n = (size_t)s->p.samples->n, n_lights = (size_t)s->base.lights.n;
    float *low = malloc((n + 1) * sizeof(float)), *high = malloc((n + 1) * sizeof(float));
    double *first = malloc(n_lights * sizeof(double));
    struct photometric_error e;
    double cost = INFINITY; // of a bright sample
    int err = low && high && first ? 0 : -ENOMEM;
    if (err)
        goto end;
    first_distances(s, first);
    keep_lights_off(s);
    s->p.use_view = fit;
    s->p.texel_step = 1;
    s->w_sim = s->set->w_sim;
    if (s->p.model == REFLECT_LAMBERT) { // data sets 1 and 2: the albedo is known or shared, so there is nothing to alternate
        memcpy(s->base.lights.inverse_distance, first, n_lights * sizeof(double));
        err = stage1_minimise(s, 100, 1e-6, NULL); // small studios took 22 to 62
        s->w_sim_sum = s->w_sim * s->n_residuals;
        goto end;
    }
    progress_begin("alternating", 30);
    stage1_set_distances(s, 0); // Eq. 8
    for (int round = 0; !err && round < 30; round++) {
        struct photometric dark = s->p;
        dark.model = REFLECT_LAMBERT, dark.albedo = ALBEDO_FREE, dark.weight = low;
        err = split_by_luminosity(s, low, high);
        if (!err)
            err = photometric_evaluate(&dark, &s->base, true, &e);
        if (!err)
            err = split_by_luminosity(s, low, high); // with the new albedo
        if (err)
            break;
        if (round == 0)
            memcpy(s->base.lights.inverse_distance, first, n_lights * sizeof(double));
        s->p.weight = high, s->p.albedo = ALBEDO_GIVEN;
        err = photometric_evaluate(&s->p, &s->base, false, &e);
        if (err)
            break;
        if (!e.n) {
            s->stop = "no bright samples";
            break;
        }
        err = stage1_minimise(s, 20, 1e-6, NULL);
        s->w_sim_sum = s->w_sim * s->n_residuals;
        if (!err)
            err = photometric_evaluate(&s->p, &s->base, false, &e);
        progress_add(1);
        // The two halves do not fall along one function, so from some round on they may well rise together.
        const double before = cost;
        cost = e.cost / (double)e.n;
        s->stop = "max_iterations";
        if (!err && cost > (1 - 1e-4) * before) {
            s->stop = "cost";
            break;
        }
    }
    progress_end();
end:
    s->p.weight = NULL;
    free(low);
    free(high);
    free(first);
    return err;
}
