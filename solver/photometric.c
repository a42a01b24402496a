// solver/photometric.c - E_photo over samples: texels in parallel, each texel's samples together because they share lights and albedo.
#include "solver/photometric.h"

#include "solver/interreflection.h"
#include "solver/normal_equations.h"
#include "solver/parallel.h"
#include "solver/surface.h"
#include "solver/vec3.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

// The inner loops over columns, for the vectors that the machine has.
#if defined(__x86_64__) && defined(__OPTIMIZE__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
#define VECTOR_CLONES __attribute__((target_clones("avx512f", "avx2", "default"), optimize("O3")))
#else
#define VECTOR_CLONES
#endif

enum { N_CHUNKS = 24, MAX_VIEWS_PER_TEXEL = 1024 };
static const float most_albedo = 1.5f;

struct photometric_layout photometric_layout_of(int n_views, int n_groups)
{
    struct photometric_layout l = { .n_views = n_views, .n_groups = n_groups };
    l.theta = 0;
    l.centre = DISNEY_N;
    l.rotation = l.centre + 3;
    l.albedo = l.rotation + 3;
    l.gain = l.albedo + 3;
    l.inverse_distance = l.gain + n_views;
    l.n = l.inverse_distance + n_groups;
    return l;
}

static struct photometric_layout layout_of(const struct photometric *p)
{
    return photometric_layout_of(p->samples->n_views, p->n_groups);
}

int photometric_state_new(struct photometric_state *out, const struct photometric *p, const struct lights *lights)
{
    memset(out, 0, sizeof(*out));
    const size_t n_texels = (size_t)p->texels->n;
    out->albedo = malloc(n_texels * sizeof(*out->albedo));
    out->log_gain = calloc((size_t)p->samples->n_views, sizeof(double));
    const size_t n = (size_t)lights->n;
    const int err = lights_new(&out->lights, lights->n);
    if (!err && lights->region)
        out->lights.region = malloc((n + 1) * sizeof(*lights->region));
    if (!out->albedo || !out->log_gain || err || (lights->region && !out->lights.region)) {
        photometric_state_free(out);
        return -ENOMEM;
    }
    if (lights->region)
        memcpy(out->lights.region, lights->region, n * sizeof(*lights->region));
    out->lights.panorama_width_px = lights->panorama_width_px, out->lights.panorama_height_px = lights->panorama_height_px;
    memcpy(out->lights.dir_probe, lights->dir_probe, n * sizeof(*lights->dir_probe));
    memcpy(out->lights.irradiance, lights->irradiance, n * sizeof(*lights->irradiance));
    memcpy(out->lights.inverse_distance, lights->inverse_distance, n * sizeof(double));
    memcpy(out->lights.group, lights->group, n * sizeof(*lights->group));
    memcpy(out->lights.centre_m, lights->centre_m, sizeof(lights->centre_m));
    memcpy(out->lights.world_from_probe, lights->world_from_probe, sizeof(lights->world_from_probe));
    for (size_t t = 0; t < n_texels; t++)
        out->albedo[t][0] = out->albedo[t][1] = out->albedo[t][2] = .5f;
    for (int i = 0; i < DISNEY_N; i++)
        out->theta[i] = .5;
    for (int c = 0; c < 3; c++)
        out->shared_albedo[c] = .5;
    return 0;
}

void photometric_state_free(struct photometric_state *s)
{
    lights_free(&s->lights);
    free(s->albedo);
    free(s->log_gain);
    memset(s, 0, sizeof(*s));
}

// The arrays' sizes belong to the problem; both states were made for it.
static void copy_state(const struct photometric *p, struct photometric_state *to, const struct photometric_state *from)
{
    const size_t n = (size_t)from->lights.n;
    memcpy(to->lights.inverse_distance, from->lights.inverse_distance, n * sizeof(double));
    memcpy(to->lights.centre_m, from->lights.centre_m, sizeof(to->lights.centre_m));
    memcpy(to->lights.world_from_probe, from->lights.world_from_probe, sizeof(to->lights.world_from_probe));
    memcpy(to->theta, from->theta, sizeof(to->theta));
    memcpy(to->shared_albedo, from->shared_albedo, sizeof(to->shared_albedo));
    memcpy(to->albedo, from->albedo, (size_t)p->texels->n * sizeof(*to->albedo));
    memcpy(to->log_gain, from->log_gain, (size_t)p->samples->n_views * sizeof(double));
}

void photometric_state_copy(const struct photometric *p, struct photometric_state *to,
                            const struct photometric_state *from)
{
    copy_state(p, to, from);
}

static double ratio_of(const struct photometric *p, int light)
{
    return p->ratio_of_light ? (double)p->ratio_of_light[light] : 1;
}

void photometric_pack(const struct photometric *p, const struct photometric_state *s, double *x)
{
    const struct photometric_layout l = layout_of(p);
    memset(x, 0, (size_t)l.n * sizeof(double));
    memcpy(x + l.theta, s->theta, sizeof(s->theta));
    memcpy(x + l.centre, s->lights.centre_m, sizeof(s->lights.centre_m));
    memcpy(x + l.albedo, s->shared_albedo, sizeof(s->shared_albedo));
    memcpy(x + l.gain, s->log_gain, (size_t)l.n_views * sizeof(double));
    for (int i = 0; i < s->lights.n; i++)
        x[l.inverse_distance + p->group_of_light[i]] = s->lights.inverse_distance[i] / ratio_of(p, i);
}

void photometric_unpack(const struct photometric *p, struct photometric_state *s, const double *x)
{
    const struct photometric_layout l = layout_of(p);
    double turn[9];
    memcpy(s->theta, x + l.theta, sizeof(s->theta));
    memcpy(s->lights.centre_m, x + l.centre, sizeof(s->lights.centre_m));
    mat3_from_rotation_vector(turn, x + l.rotation);
    mat3_mul(s->lights.world_from_probe, turn, s->lights.world_from_probe);
    memcpy(s->shared_albedo, x + l.albedo, sizeof(s->shared_albedo));
    memcpy(s->log_gain, x + l.gain, (size_t)l.n_views * sizeof(double));
    for (int i = 0; i < s->lights.n; i++)
        s->lights.inverse_distance[i] = x[l.inverse_distance + p->group_of_light[i]] * ratio_of(p, i);
}

double photometric_rmse_percent(const struct photometric_error *e)
{
    return e->n ? 100 * sqrt(e->squares / (3 * (double)e->n)) : 0;
}

// ---- one texel's samples ------------------------------------------------------------------------------------------------

// What a thread works with.
struct worker {
    struct lit lit;
    struct normal_rows rows;
    float *by_light[3];           // [n_padded]
    float *block;                 // [MAX_VIEWS][3][n]: the texel's rows before the projection
    struct observation *seen;     // [MAX_VIEWS]
};

struct observation {
    int view;
    float o[3], v[3], weight, gain;
    bool clipped;
    float constant[3], own[3];
};

struct job {
    const struct photometric *p;
    struct photometric_state *s;
    const struct kernels *kernels;
    struct light_arrays lights;
    struct photometric_layout layout;
    struct worker *workers;
    int n_workers;
    bool fit;
    int n_free, *column;          // the compact place of each unknown, -1: not free
    bool one_row;                 // diffuse, with neither gains nor albedos to find: a texel's views differ in a row's length only
    int *group_first;             // [n_groups + 1] where the lights of each group begin, when they are ascending and all groups are free; else NULL
    bool tinted;                  // the tint matters: solve the albedo twice
    float (*residual)[3];         // [samples n] L - o, or NULL
};

static void job_free(struct job *j)
{
    for (int i = 0; j->workers && i < j->n_workers; i++) {
        struct worker *w = &j->workers[i];
        lit_free(&w->lit);
        normal_rows_free(&w->rows);
        for (int c = 0; c < 3; c++)
            free(w->by_light[c]);
        free(w->block);
        free(w->seen);
    }
    free(j->workers);
    free(j->column);
    free(j->group_first);
    light_arrays_free(&j->lights);
}

// is_free NULL: no rows are made.
static int job_new(struct job *j, const struct photometric *p, struct photometric_state *s, const unsigned char *is_free)
{
    memset(j, 0, sizeof(*j));
    j->p = p, j->s = s;
    j->kernels = kernels_select(KERNELS_ALL);
    j->layout = layout_of(p);
    j->n_workers = p->n_threads > 0 ? p->n_threads : parallel_n_cores();
    j->tinted = p->model == REFLECT_DISNEY && p->albedo == ALBEDO_FREE &&
                (p->theta_of_texel ||
                s->theta[DISNEY_SPECULAR_TINT] * s->theta[DISNEY_SPECULAR] + s->theta[DISNEY_SHEEN_TINT] * s->theta[DISNEY_SHEEN] > 1e-4);
    if (light_arrays_new(&j->lights, &s->lights))
        return -ENOMEM;
    j->workers = calloc((size_t)j->n_workers, sizeof(*j->workers));
    j->column = malloc((size_t)j->layout.n * sizeof(int));
    for (int i = 0; j->column && is_free && i < j->layout.n; i++)
        j->column[i] = is_free[i] ? j->n_free++ : -1;
    if (!j->column)
        goto fail;
    j->one_row = p->model == REFLECT_LAMBERT && p->albedo != ALBEDO_FREE;
    for (int v = 0; is_free && v < j->layout.n_views; v++)
        j->one_row &= !is_free[j->layout.gain + v];
    bool ascending = is_free;
    for (int i = 0; ascending && i < s->lights.n; i++)
        ascending = (i == 0 || p->group_of_light[i] >= p->group_of_light[i - 1]);
    for (int g = 0; ascending && g < p->n_groups; g++)
        ascending = j->column[j->layout.inverse_distance + g] >= 0;
    if (ascending) {
        if (!(j->group_first = calloc((size_t)p->n_groups + 1, sizeof(int))))
            goto fail;
        for (int i = 0; i < s->lights.n; i++)
            j->group_first[p->group_of_light[i] + 1] = i + 1;
        for (int g = 0; g < p->n_groups; g++) // a group without lights begins and ends where the one before ends
            if (j->group_first[g + 1] < j->group_first[g])
                j->group_first[g + 1] = j->group_first[g];
    }
    for (int i = 0; j->workers && i < j->n_workers; i++) {
        struct worker *w = &j->workers[i];
        w->seen = malloc(MAX_VIEWS_PER_TEXEL * sizeof(*w->seen));
        if (!w->seen || lit_new(&w->lit, s->lights.n))
            goto fail;
        if (!is_free)
            continue;
        for (int c = 0; c < 3; c++)
            if (!(w->by_light[c] = aligned_alloc(64, (size_t)j->lights.n_padded * sizeof(float))))
                goto fail;
        w->block = malloc(((size_t)j->n_free + 1) * 3 * MAX_VIEWS_PER_TEXEL * sizeof(float));
        if (!w->block || normal_rows_new(&w->rows, j->n_free))
            goto fail;
    }
    if (j->workers)
        return 0;
fail:
    job_free(j);
    return -ENOMEM;
}

static const uint16_t *visible_of(const struct photometric *p, int texel)
{
    return p->visible ? p->visible + (size_t)texel * (size_t)p->words_per_texel : NULL;
}

// The samples of a texel that count. Returns how many.
static int observe(const struct job *j, int texel, struct observation *seen)
{
    const struct samples *s = j->p->samples;
    int m = 0;
    for (int64_t i = s->first[texel]; i < s->first[texel + 1] && m < MAX_VIEWS_PER_TEXEL; i++) {
        const int view = s->view[i];
        const float weight = j->p->weight ? j->p->weight[i] : 1;
        if ((j->p->use_view && !j->p->use_view[view]) || !(weight > 0))
            continue;
        struct observation *o = &seen[m++];
        *o = (struct observation){ .view = view, .weight = weight, .gain = expf((float)j->s->log_gain[view]),
                                   .clipped = s->flags[i] & SAMPLE_CLIPPED };
        samples_radiance(s, i, o->o);
        samples_view_direction(s, j->p->texels, texel, view, o->v);
    }
    return m;
}

static void material_of(const struct job *j, int texel, struct shade_material *m)
{
    m->variant = j->p->variant;
    for (int i = 0; i < DISNEY_N; i++)
        m->theta[i] = j->p->theta_of_texel ? j->p->theta_of_texel[texel][i] : (float)j->s->theta[i];
    for (int c = 0; c < 3; c++)
        m->albedo[c] = j->p->albedo == ALBEDO_SHARED ? (float)j->s->shared_albedo[c] : j->s->albedo[texel][c];
}

static float indirect_of(const struct job *j, int texel, int c)
{
    return j->p->indirect ? j->p->indirect[texel][c] : 0;
}

// Into the radiance that the lights give.
static void add_indirect(const struct job *j, int texel, const struct shade_material *m, struct shade_jacobian *d)
{
    for (int c = 0; c < 3; c++) {
        const float E = indirect_of(j, texel, c), own = indirect_own(E);
        float by_specular, by_metallic;
        indirect_constant_gradient(E, m->theta, &by_specular, &by_metallic);
        d->L[c] += indirect_constant(E, m->theta) + own * m->albedo[c];
        d->own[c] += own, d->albedo[c][c] += own;
        d->theta[c][DISNEY_METALLIC] += by_metallic, d->theta[c][DISNEY_SPECULAR] += by_specular;
    }
}

// constant and own of every observation, for the tint of m's albedo; the gain is in.
static void find_affine(const struct job *j, struct worker *w, int texel, const struct surface_point *point,
                        const struct shade_material *m, struct observation *seen, int n_seen)
{
    if (j->p->model == REFLECT_LAMBERT) {
        float E[3];
        j->kernels->irradiance(E, &j->lights, point, visible_of(j->p, texel));
        for (int k = 0; k < n_seen; k++)
            for (int c = 0; c < 3; c++) {
                seen[k].constant[c] = 0;
                seen[k].own[c] = seen[k].gain * (E[c] + indirect_of(j, texel, c)) * (float)M_1_PI;
            }
        return;
    }
    for (int k = 0; k < n_seen; k++) {
        j->kernels->shade_affine(seen[k].constant, seen[k].own, &w->lit, point, seen[k].v, m);
        for (int c = 0; c < 3; c++) {
            const float indirect = indirect_of(j, texel, c);
            seen[k].constant[c] = seen[k].gain * (seen[k].constant[c] + indirect_constant(indirect, m->theta));
            seen[k].own[c] = seen[k].gain * (seen[k].own[c] + indirect_own(indirect));
        }
    }
}

// A clipped observation says nothing when the model is brighter still.
static float residual_of(const struct observation *o, int c, float albedo)
{
    const float r = o->constant[c] + o->own[c] * albedo - o->o[c];
    return o->clipped && r > 0 ? 0 : r;
}

// Newton on the derivative by the albedo: own >= 0, so it rises, and clipped observations, which fall silent above their bound, bend it
// downwards: from the second step on the albedo only grows, and with each step but the last an observation falls silent.
static void solve_albedo(const struct observation *seen, int n_seen, float albedo[3])
{
    for (int c = 0; c < 3; c++) {
        double a = (double)albedo[c];
        for (int step = 0; step < n_seen + 2; step++) {
            double own2 = 0, rhs = 0;
            for (int k = 0; k < n_seen; k++) {
                const struct observation *o = &seen[k];
                const double own = (double)o->own[c], needed = (double)o->o[c] - (double)o->constant[c];
                if (o->clipped && own * a >= needed)
                    continue;
                own2 += (double)o->weight * own * own;
                rhs += (double)o->weight * own * needed;
            }
            const double next = own2 > 0 ? rhs / own2 : a, before = a;
            a = next;
            if (fabs(next - before) <= 1e-9)
                break;
        }
        albedo[c] = fminf(fmaxf((float)a, 0), most_albedo);
    }
}

static float clip01(float x)
{
    return x < 0 ? 0 : x > 1 ? 1 : x;
}

// partial: cost, squares, n.
static void evaluate_texels(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    struct job *j = arg;
    struct worker *w = &j->workers[worker];
    for (int texel = (int)begin; texel < (int)end; texel++) {
        if (texel % j->p->texel_step || (j->p->use_texel && !j->p->use_texel[texel]))
            continue;
        struct surface_point point;
        struct shade_material m;
        const int n_seen = observe(j, texel, w->seen);
        if (!n_seen)
            continue;
        surface_of_texel(&point, j->p->texels, texel);
        if (j->p->model == REFLECT_DISNEY)
            j->kernels->gather(&w->lit, &j->lights, &point, visible_of(j->p, texel), NULL);
        material_of(j, texel, &m);
        find_affine(j, w, texel, &point, &m, w->seen, n_seen);
        if (j->fit && j->p->albedo == ALBEDO_FREE) {
            solve_albedo(w->seen, n_seen, m.albedo);
            if (j->tinted) {
                find_affine(j, w, texel, &point, &m, w->seen, n_seen);
                solve_albedo(w->seen, n_seen, m.albedo);
            }
            memcpy(j->s->albedo[texel], m.albedo, sizeof(m.albedo));
        }
        int64_t i = j->p->samples->first[texel];
        for (int k = 0; k < n_seen; k++) {
            const struct observation *o = &w->seen[k];
            while (j->p->samples->view[i] != o->view)
                i++;
            for (int c = 0; c < 3; c++) {
                const float L = o->constant[c] + o->own[c] * m.albedo[c], r = residual_of(o, c, m.albedo[c]);
                const float shown = clip01(L) - clip01(o->o[c]);
                partial[0] += .5 * (double)o->weight * (double)r * (double)r;
                partial[1] += (double)shown * (double)shown;
                if (j->residual)
                    j->residual[i][c] = r;
            }
            partial[2] += 1;
        }
    }
}

static int64_t chunk_of(const struct photometric *p)
{
    return (p->texels->n + N_CHUNKS - 1) / N_CHUNKS;
}

static int evaluate(const struct photometric *p, struct photometric_state *s, bool fit, float (*residual)[3],
                    struct photometric_error *error)
{
    struct job j;
    double sums[3] = { 0 };
    int err = job_new(&j, p, s, NULL);
    if (err)
        return err;
    j.fit = fit;
    j.residual = residual;
    err = parallel_sum(j.n_workers, p->texels->n, chunk_of(p), evaluate_texels, &j, 3, sums);
    *error = (struct photometric_error){ sums[0], sums[1], (int64_t)sums[2] };
    job_free(&j);
    return err;
}

int photometric_evaluate(const struct photometric *p, struct photometric_state *s, bool fit,
                         struct photometric_error *error)
{
    return evaluate(p, s, fit, NULL, error);
}

// ---- normal equations ---------------------------------------------------------------------------------------------------

static void put(const struct job *j, float *row, int unknown, float value)
{
    if (j->column[unknown] >= 0)
        row[j->column[unknown]] += value;
}

VECTOR_CLONES static void add_groups(float *restrict row, const float *restrict by_light, const float *restrict ratio,
                                     const int *restrict first, int n_groups, int n_lights, float scale)
{
    if (n_lights == n_groups && !ratio && first[n_groups - 1] == n_groups - 1) { // one each
        for (int g = 0; g < n_groups; g++)
            row[g] += scale * by_light[g];
        return;
    }
    for (int g = 0; g < n_groups; g++) {
        float sum = 0;
        for (int i = first[g]; i < first[g + 1]; i++)
            sum += ratio ? ratio[i] * by_light[i] : by_light[i];
        row[g] += scale * sum;
    }
}

// The row of channel c of an observation over the free unknowns, times `scale`.
static void fill_row(const struct job *j, float *row, int c, int view, float scale, const struct shade_jacobian *d,
                     const struct shade_setup *setup)
{
    const struct photometric_layout *l = &j->layout;
    memset(row, 0, (size_t)j->n_free * sizeof(float));
    for (int i = 0; i < DISNEY_N; i++)
        put(j, row, l->theta + i, scale * d->theta[c][i]);
    for (int i = 0; i < 3; i++) {
        put(j, row, l->centre + i, scale * setup->centre[c][i]);
        put(j, row, l->rotation + i, scale * setup->rotation[c][i]);
        put(j, row, l->albedo + i, scale * d->albedo[c][i]);
    }
    put(j, row, l->gain + view, scale * d->L[c]);
    if (j->group_first) {
        add_groups(row + j->column[l->inverse_distance], setup->inverse_distance[c], j->p->ratio_of_light, j->group_first, l->n_groups,
                   j->lights.n, scale);
        return;
    }
    for (int i = 0; i < j->lights.n; i++)
        put(j, row, l->inverse_distance + j->p->group_of_light[i],
            scale * (float)ratio_of(j->p, i) * setup->inverse_distance[c][i]);
}

// Remove from the texel's rows of one channel what a change of its albedo would explain.
VECTOR_CLONES static void project_rows(float *rows, size_t stride, int n, const struct observation *seen, int n_seen, int c,
                         float *explained)
{
    double own2 = 0;
    memset(explained, 0, (size_t)n * sizeof(float));
    for (int k = 0; k < n_seen; k++) {
        const float b = sqrtf(seen[k].weight) * seen[k].own[c];
        const float *row = rows + (size_t)k * stride;
        own2 += (double)b * (double)b;
        for (int i = 0; i < n; i++)
            explained[i] += b * row[i];
    }
    if (!(own2 > 0))
        return;
    for (int i = 0; i < n; i++)
        explained[i] /= (float)own2;
    for (int k = 0; k < n_seen; k++) {
        const float b = sqrtf(seen[k].weight) * seen[k].own[c];
        float *row = rows + (size_t)k * stride;
        for (int i = 0; i < n; i++)
            row[i] -= b * explained[i];
    }
}

// One row for all views of a diffuse texel: as long as theirs together, with what their residuals have along it.
static void add_diffuse(const struct job *j, struct worker *w, int n_seen, const float albedo[3], const struct shade_jacobian *d,
                        const struct shade_setup *setup)
{
    for (int c = 0; c < 3; c++) {
        double length2 = 0, along = 0;
        for (int k = 0; k < n_seen; k++) {
            struct observation *o = &w->seen[k];
            const double gain = (double)o->gain, weighted = (double)o->weight * gain;
            o->constant[c] = 0, o->own[c] = o->gain * d->own[c];
            const float r = residual_of(o, c, albedo[c]);
            if (o->clipped && r == 0)
                continue;
            length2 += weighted * gain;
            along += weighted * (double)r;
        }
        if (!(length2 > 0))
            continue;
        const float length = (float)sqrt(length2);
        float *row = normal_rows_next(&w->rows, (float)(along / (double)length));
        fill_row(j, row, c, 0, 1, d, setup); // scaled afterwards, so as to round alike whichever loop sums a group's lights
        for (int i = 0; i < j->n_free; i++)
            row[i] *= length;
    }
}

static void add_texels(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    struct job *j = arg;
    struct worker *w = &j->workers[worker];
    const int n = j->n_free;
    const size_t stride = (size_t)n * 3;
    float explained[n + 1];
    w->rows.A = partial, w->rows.g = partial + (size_t)n * (size_t)n;
    for (int texel = (int)begin; texel < (int)end; texel++) {
        if (texel % j->p->texel_step || (j->p->use_texel && !j->p->use_texel[texel]))
            continue;
        struct surface_point point;
        struct shade_material m;
        struct shade_jacobian d = { 0 };
        struct shade_setup setup = { .inverse_distance = { w->by_light[0], w->by_light[1], w->by_light[2] } };
        const int n_seen = observe(j, texel, w->seen);
        if (!n_seen)
            continue;
        surface_of_texel(&point, j->p->texels, texel);
        material_of(j, texel, &m);
        const bool lambert = j->p->model == REFLECT_LAMBERT;
        if (lambert) {
            float E[3];
            j->kernels->irradiance_setup(E, &setup, &j->lights, &point, visible_of(j->p, texel));
            for (int c = 0; c < 3; c++) {
                const float k = m.albedo[c] * (float)M_1_PI, all = E[c] + indirect_of(j, texel, c);
                d.own[c] = all * (float)M_1_PI;
                d.L[c] = k * all;
                d.albedo[c][c] = d.own[c];
                for (int i = 0; i < 3; i++)
                    setup.centre[c][i] *= k, setup.rotation[c][i] *= k;
                for (int i = 0; i < j->lights.n; i++)
                    setup.inverse_distance[c][i] *= k;
            }
            if (j->one_row) {
                add_diffuse(j, w, n_seen, m.albedo, &d, &setup);
                continue;
            }
        } else {
            j->kernels->gather(&w->lit, &j->lights, &point, visible_of(j->p, texel), NULL);
        }
        bool constrained[3]; // albedo at a bound: nothing to eliminate
        for (int c = 0; c < 3; c++)
            constrained[c] = m.albedo[c] <= 0 || m.albedo[c] >= most_albedo;
        for (int k = 0; k < n_seen; k++) {
            struct observation *o = &w->seen[k];
            if (!lambert) {
                j->kernels->shade_setup(&d, &setup, &w->lit, &j->lights, &point, o->v, &m);
                if (j->p->indirect)
                    add_indirect(j, texel, &m, &d);
            }
            for (int c = 0; c < 3; c++) {
                o->own[c] = o->gain * d.own[c];
                o->constant[c] = o->gain * d.L[c] - o->own[c] * m.albedo[c];
                const bool silent = o->clipped && residual_of(o, c, m.albedo[c]) == 0;
                fill_row(j, w->block + (size_t)k * stride + (size_t)c * (size_t)n, c, o->view,
                         silent ? 0 : sqrtf(o->weight) * o->gain, &d, &setup);
                if (silent)
                    o->own[c] = 0;
            }
        }
        for (int c = 0; c < 3; c++) {
            float *rows = w->block + (size_t)c * (size_t)n;
            if (j->p->albedo == ALBEDO_FREE && !constrained[c])
                project_rows(rows, stride, n, w->seen, n_seen, c, explained);
            for (int k = 0; k < n_seen; k++) {
                const struct observation *o = &w->seen[k];
                const float r = o->own[c] == 0 && o->clipped ? 0 : sqrtf(o->weight) * residual_of(o, c, m.albedo[c]);
                memcpy(normal_rows_next(&w->rows, r), rows + (size_t)k * stride, (size_t)n * sizeof(float));
            }
        }
    }
    normal_rows_flush(&w->rows);
}

int photometric_normal_equations(const struct photometric *p, const struct photometric_state *s,
                                 const unsigned char *is_free, double *A, double *g)
{
    struct job j;
    double *sums = NULL;
    int err = job_new(&j, p, (struct photometric_state *)s, is_free);
    if (err)
        return err;
    const size_t n = (size_t)j.layout.n, m = (size_t)j.n_free, n_sums = m * m + m;
    sums = calloc(n_sums + 1, sizeof(double));
    err = !sums ? -ENOMEM : parallel_sum(j.n_workers, p->texels->n, chunk_of(p), add_texels, &j, (int)n_sums, sums);
    for (size_t i = 0; !err && i < n; i++) {
        if (j.column[i] < 0)
            continue;
        const size_t row = (size_t)j.column[i];
        for (size_t k = 0; k <= i; k++)
            if (j.column[k] >= 0)
                A[i * n + k] += sums[row * m + (size_t)j.column[k]];
        g[i] += sums[m * m + row];
    }
    free(sums);
    job_free(&j);
    return err;
}

// ---- residuals, robust weights -------------------------------------------------------------------------------------------

int photometric_residuals(const struct photometric *p, const struct photometric_state *s, float (*residual)[3])
{
    struct photometric_error error;
    for (int64_t i = 0; i < p->samples->n; i++)
        residual[i][0] = residual[i][1] = residual[i][2] = NAN;
    return evaluate(p, (struct photometric_state *)s, false, residual, &error);
}

static int by_float(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

int photometric_scale(const struct photometric *p, const struct photometric_state *s, double *sigma)
{
    float(*r)[3] = malloc((size_t)p->samples->n * sizeof(*r) + 1);
    int err = r ? photometric_residuals(p, s, r) : -ENOMEM;
    if (!err) {
        float *all = r[0];
        int64_t n = 0;
        for (int64_t i = 0; i < 3 * p->samples->n; i++)
            if (!isnan(all[i]))
                all[n++] = fabsf(all[i]);
        qsort(all, (size_t)n, sizeof(float), by_float);
        *sigma = n ? 1.4826 * (double)all[n / 2] : 0;
    }
    free(r);
    return err;
}

int photometric_robust_weights(const struct photometric *p, const struct photometric_state *s, double sigma,
                               const float *base, float *weight)
{
    float(*r)[3] = malloc((size_t)p->samples->n * sizeof(*r) + 1);
    struct photometric plain = *p;
    plain.weight = NULL;
    const int err = r ? photometric_residuals(&plain, s, r) : -ENOMEM;
    for (int64_t i = 0; !err && i < p->samples->n; i++) {
        const float largest = fmaxf(fmaxf(fabsf(r[i][0]), fabsf(r[i][1])), fabsf(r[i][2]));
        const double u = (double)largest / (sigma > 0 ? sigma : 1), w = 1 / (1 + u * u);
        weight[i] = isnan(r[i][0]) ? 0 : (float)(w * w) * (base ? base[i] : 1);
    }
    free(r);
    return err;
}
