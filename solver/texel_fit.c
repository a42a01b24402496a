// solver/texel_fit.c - one texel's samples against a reflectance.
#include "solver/texel_fit.h"

#include "solver/interreflection.h"
#include "solver/packed.h"
#include "solver/random.h"
#include "solver/surface.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#if defined(__x86_64__) && defined(__OPTIMIZE__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
#define VECTOR_CLONES __attribute__((target_clones("avx512f", "avx2", "default"), optimize("O3")))
#else
#define VECTOR_CLONES
#endif

static const float most_albedo = 1.5f, white = 1;
static const float registration_px = .25f, usual_error = .02f; // a sample may lie so far off; what its error is without that
enum { OWN = DISNEY_N, RESIDUAL, N_COLUMNS, STRIDE = 16, ROBUST_ROUNDS = 3 };

struct observation {
    int view;
    float o[3], base, gain; // base: weight before robustness
    bool clipped;
    float r[3], own[3];     // L - o at the albedo of the moment
};

struct texel_worker {
    struct lit lit;
    struct shade_jacobian *jacobian; // [TEXEL_VIEWS_MAX]
    float (*v)[3];
    struct observation *seen;
    float *rows;                     // [TEXEL_VIEWS_MAX][STRIDE]
    float *weight;                   // [TEXEL_VIEWS_MAX]
    int64_t *sample;
    struct texel_row *full;          // [3 TEXEL_VIEWS_MAX]
};

int texel_worker_new(struct texel_worker **out, const struct texel_scene *s)
{
    struct texel_worker *w = calloc(1, sizeof(*w));
    if (!w)
        return -ENOMEM;
    w->jacobian = malloc(TEXEL_VIEWS_MAX * sizeof(*w->jacobian));
    w->v = malloc(TEXEL_VIEWS_MAX * sizeof(*w->v));
    w->seen = malloc(TEXEL_VIEWS_MAX * sizeof(*w->seen));
    w->rows = aligned_alloc(64, TEXEL_VIEWS_MAX * STRIDE * sizeof(float));
    w->weight = malloc(TEXEL_VIEWS_MAX * sizeof(float));
    w->sample = malloc(TEXEL_VIEWS_MAX * sizeof(*w->sample));
    w->full = malloc(3 * TEXEL_VIEWS_MAX * sizeof(*w->full));
    if (!w->jacobian || !w->v || !w->seen || !w->rows || !w->weight || !w->sample || !w->full || lit_new(&w->lit, s->lights.n)) {
        texel_worker_free(w);
        return -ENOMEM;
    }
    *out = w;
    return 0;
}

void texel_worker_free(struct texel_worker *w)
{
    if (!w)
        return;
    lit_free(&w->lit);
    free(w->jacobian);
    free(w->v);
    free(w->seen);
    free(w->rows);
    free(w->weight);
    free(w->sample);
    free(w->full);
    free(w);
}

// ---- what is known of the texel -----------------------------------------------------------------------------------------

// The lights that reach a texel.
static void gather_lights(const struct texel_scene *s, struct texel_worker *w, int texel, const struct surface_point *point)
{
    const size_t t = (size_t)texel;
    s->kernels->gather(&w->lit, &s->lights, point, s->visible && !s->soft ? s->visible + t * (size_t)s->words_per_texel : NULL,
                       s->soft ? s->soft + t * (size_t)s->lights.n : NULL);
}

// Fills seen and v. What a camera clipped is a lower bound no higher than white, however much a file without clipping says.
static int observe(const struct texel_scene *s, struct texel_worker *w, int texel, int most_views)
{
    const struct samples *m = s->samples;
    int n = 0;
    for (int64_t i = m->first[texel]; i < m->first[texel + 1] && n < TEXEL_VIEWS_MAX; i++)
        if (!s->use_view || s->use_view[m->view[i]])
            w->sample[n++] = i;
    const int n_used = most_views > 0 && n > most_views ? most_views : n;
    const int turn = n_used < n ? (int)(random_u64(2, 0, (uint64_t)texel) % (uint64_t)n) : 0;
    for (int k = 0; k < n_used; k++) {
        const int64_t i = w->sample[n_used < n ? (turn + (int)((int64_t)k * n / n_used)) % n : k];
        struct observation *o = &w->seen[k];
        o->view = m->view[i];
        o->clipped = m->flags[i] & SAMPLE_CLIPPED;
        o->gain = s->gain ? s->gain[o->view] : 1;
        samples_radiance(m, i, o->o);
        for (int c = 0; c < 3 && o->clipped; c++)
            o->o[c] = fminf(o->o[c], white);
        samples_view_direction(m, s->texels, texel, o->view, w->v[k]);
        const float *v = w->v[k], *N = s->texels->normal[texel], nv = N[0] * v[0] + N[1] * v[1] + N[2] * v[2];
        const float slip = samples_gradient(m, i) * registration_px / usual_error;
        o->base = s->weigh_grazing ? fminf(1, fmaxf(2 * nv, 0)) / (1 + slip * slip) : 1;
    }
    return n_used;
}

// Jacobians of the observations, and their residuals; gain and indirect light are in.
static void shade(const struct texel_scene *s, struct texel_worker *w, int texel, int n, const float theta[DISNEY_N],
                  const float albedo[3])
{
    struct surface_point point;
    struct shade_material m = { .variant = s->variant };
    memcpy(m.theta, theta, sizeof(m.theta));
    memcpy(m.albedo, albedo, sizeof(m.albedo));
    surface_of_texel(&point, s->texels, texel);
    gather_lights(s, w, texel, &point);
    s->kernels->shade_jacobian_views(w->jacobian, n, &w->lit, &point, (const float(*)[3])w->v, &m);
    for (int k = 0; k < n; k++) {
        struct shade_jacobian *d = &w->jacobian[k];
        struct observation *o = &w->seen[k];
        for (int c = 0; c < 3; c++) {
            if (s->indirect) {
                const float E = s->indirect[texel][c], own = indirect_own(E);
                float by_specular, by_metallic;
                indirect_constant_gradient(E, theta, &by_specular, &by_metallic);
                d->L[c] += indirect_constant(E, theta) + own * albedo[c];
                d->own[c] += own;
                d->albedo[c][c] += own;
                d->theta[c][DISNEY_METALLIC] += by_metallic;
                d->theta[c][DISNEY_SPECULAR] += by_specular;
            }
            o->own[c] = o->gain * d->own[c];
            o->r[c] = o->gain * d->L[c] - o->o[c];
        }
    }
}

// ---- weights, albedo, sums ----------------------------------------------------------------------------------------------

static bool is_silent(const struct observation *o, int c)
{
    return o->clipped && o->r[c] > 0;
}

// |L - o| of the channels that speak.
static float distance_of(const struct observation *o)
{
    float sum = 0;
    for (int c = 0; c < 3; c++)
        sum += is_silent(o, c) ? 0 : o->r[c] * o->r[c];
    return sqrtf(sum);
}

static void weigh(const struct texel_scene *s, struct texel_worker *w, int n)
{
    const float scale = (float)s->robust_scale;
    for (int k = 0; k < n; k++) {
        const float u = scale > 0 ? distance_of(&w->seen[k]) / scale : 0;
        w->weight[k] = w->seen[k].base / sqrtf(1 + u * u);
    }
}

// Charbonnier: s^2 (sqrt(1 + u^2) - 1), which is u^2 s^2 / 2 for small u.
static double cost_of(const struct texel_scene *s, const struct observation *o)
{
    const double d = (double)distance_of(o), scale = s->robust_scale;
    if (!(scale > 0))
        return .5 * (double)o->base * d * d;
    return (double)o->base * d * d / (1 + sqrt(1 + d * d / (scale * scale)));
}

// Where the albedo is free each sample has pulled it to itself by its share h of what is known: without it, its residual is r / (1 - h). An
// albedo at a bound stays where it is.
static double left_out_cost(const struct texel_scene *s, const struct texel_worker *w, int n, const float albedo[3])
{
    static const float least_left = .02f; // a residual grows to no more than fifty times
    double own2[3] = { 0 }, sum = 0;
    for (int c = 0; c < 3 && s->free_albedo; c++)
        for (int k = 0; k < n && albedo[c] > 0 && albedo[c] < most_albedo; k++)
            own2[c] += is_silent(&w->seen[k], c) ? 0 : (double)(w->weight[k] * w->seen[k].own[c] * w->seen[k].own[c]);
    for (int k = 0; k < n; k++) {
        struct observation o = w->seen[k];
        for (int c = 0; c < 3; c++)
            if (own2[c] > 1e-9)
                o.r[c] /= fmaxf(1 - (float)((double)(w->weight[k] * o.own[c] * o.own[c]) / own2[c]), least_left);
        sum += cost_of(s, &o);
    }
    return sum;
}

// Best albedo for these weights; residuals follow. Returns the largest relative change.
static float solve_albedo(struct texel_worker *w, int n, float albedo[3])
{
    float change = 0;
    for (int c = 0; c < 3; c++) {
        double own2 = 0, own_r = 0;
        for (int k = 0; k < n; k++) {
            const struct observation *o = &w->seen[k];
            if (is_silent(o, c))
                continue;
            own2 += (double)(w->weight[k] * o->own[c] * o->own[c]);
            own_r += (double)(w->weight[k] * o->own[c] * o->r[c]);
        }
        if (!(own2 > 1e-9))
            continue;
        const float next = fminf(fmaxf(albedo[c] - (float)(own_r / own2), 0), most_albedo), step = next - albedo[c];
        for (int k = 0; k < n; k++)
            w->seen[k].r[c] += w->seen[k].own[c] * step;
        change = fmaxf(change, fabsf(step) / (albedo[c] + .02f));
        albedo[c] = next;
    }
    return change;
}

// A[i][j] += sum over rows of weight row_i row_j.
VECTOR_CLONES static void add_rows(float (*restrict A)[STRIDE], const float *restrict rows, const float *restrict weight, int n)
{
    for (int k = 0; k < n; k++) {
        const float *row = rows + (size_t)k * STRIDE;
        for (int i = 0; i < N_COLUMNS; i++) {
            const float scaled = weight[k] * row[i];
            for (int j = 0; j < STRIDE; j++)
                A[i][j] += scaled * row[j];
        }
    }
}

static int fit(const struct texel_scene *s, struct texel_worker *w, int texel, int most_views, const float theta[DISNEY_N],
               float albedo[3])
{
    const int n = observe(s, w, texel, most_views);
    if (!n)
        return 0;
    for (int round = 0; round < 2; round++) { // a second look where derivatives and tint were those of another albedo
        float change = 0;
        shade(s, w, texel, n, theta, albedo);
        for (int k = 0; k < ROBUST_ROUNDS && s->free_albedo; k++) {
            weigh(s, w, n);
            change = fmaxf(change, solve_albedo(w, n, albedo));
        }
        weigh(s, w, n);
        if (change < .5f)
            break;
    }
    return n;
}

// texel_fit without its derivatives. Returns how many samples there are.
static int fit_and_add(const struct texel_scene *s, struct texel_worker *w, int texel, int most_views, const float theta[DISNEY_N],
                       float albedo[3], double scale, struct texel_sums *out)
{
    const int n = fit(s, w, texel, most_views, theta, albedo);
    for (int k = 0; k < n; k++) {
        out->cost += scale * cost_of(s, &w->seen[k]);
        out->distance += (double)distance_of(&w->seen[k]);
    }
    out->left_out_cost += n ? scale * left_out_cost(s, w, n, albedo) : 0;
    out->n += n;
    return n;
}

void texel_fit_albedo(const struct texel_scene *s, struct texel_worker *w, int texel, int most_views, const float theta[DISNEY_N],
                      float albedo[3], double scale, struct texel_sums *out)
{
    fit_and_add(s, w, texel, most_views, theta, albedo, scale, out);
}

void texel_fit(const struct texel_scene *s, struct texel_worker *w, int texel, int most_views, const float theta[DISNEY_N],
               float albedo[3], double scale, struct texel_sums *out)
{
    const int n = fit_and_add(s, w, texel, most_views, theta, albedo, scale, out);
    for (int c = 0; n && c < 3; c++) {
        float A[N_COLUMNS][STRIDE] = { { 0 } };
        for (int k = 0; k < n; k++) {
            float *row = w->rows + (size_t)k * STRIDE;
            const struct observation *o = &w->seen[k];
            const float gain = is_silent(o, c) ? 0 : o->gain;
            for (int i = 0; i < DISNEY_N; i++)
                row[i] = gain * w->jacobian[k].theta[c][i];
            row[OWN] = is_silent(o, c) ? 0 : o->own[c];
            row[RESIDUAL] = is_silent(o, c) ? 0 : o->r[c];
            memset(row + N_COLUMNS, 0, (STRIDE - N_COLUMNS) * sizeof(float));
        }
        add_rows(A, w->rows, w->weight, n);
        const bool eliminated = s->free_albedo && A[OWN][OWN] > 1e-9f && albedo[c] > 0 && albedo[c] < most_albedo;
        const float inverse = eliminated ? 1 / A[OWN][OWN] : 0;
        for (int i = 0; i < DISNEY_N; i++) {
            for (int j = 0; j <= i; j++)
                out->H[packed_at(i, j)] += scale * (double)(A[i][j] - A[OWN][i] * inverse * A[OWN][j]);
            out->g[i] += scale * (double)(A[i][RESIDUAL] - A[OWN][i] * inverse * A[OWN][RESIDUAL]);
        }
        out->own2[c] += (double)A[OWN][OWN];
    }
}

void texel_measure(const struct texel_scene *s, struct texel_worker *w, int texel, const float theta[DISNEY_N],
                   const float albedo[3], struct texel_error *out)
{
    struct surface_point point;
    struct shade_material m = { .variant = s->variant };
    const int n = observe(s, w, texel, 0);
    if (!n)
        return;
    memcpy(m.theta, theta, sizeof(m.theta));
    memcpy(m.albedo, albedo, sizeof(m.albedo));
    surface_of_texel(&point, s->texels, texel);
    gather_lights(s, w, texel, &point);
    for (int k = 0; k < n; k++) {
        struct observation *o = &w->seen[k];
        float L[3];
        s->kernels->shade(L, &w->lit, &point, w->v[k], &m);
        for (int c = 0; c < 3; c++) {
            if (s->indirect)
                L[c] += indirect_constant(s->indirect[texel][c], theta) + indirect_own(s->indirect[texel][c]) * albedo[c];
            L[c] *= o->gain;
            o->r[c] = L[c] - o->o[c];
            const float shown = fminf(fmaxf(L[c], 0), white) - fminf(fmaxf(o->o[c], 0), white);
            out->squares += (double)(shown * shown);
        }
        out->cost += cost_of(s, o);
    }
    out->n += n;
}

int texel_rows(const struct texel_scene *s, struct texel_worker *w, int texel, const float theta[DISNEY_N],
               const float albedo[3], const struct texel_row **rows)
{
    const int n = observe(s, w, texel, 0);
    int n_rows = 0;
    *rows = w->full;
    if (!n)
        return 0;
    shade(s, w, texel, n, theta, albedo);
    weigh(s, w, n);
    for (int k = 0; k < n; k++)
        for (int c = 0; c < 3; c++) {
            const struct observation *o = &w->seen[k];
            if (is_silent(o, c))
                continue;
            struct texel_row *row = &w->full[n_rows++];
            const float root = sqrtf(w->weight[k]);
            for (int i = 0; i < DISNEY_N; i++)
                row->J[i] = root * o->gain * w->jacobian[k].theta[c][i];
            for (int i = 0; i < 3; i++)
                row->J[DISNEY_N + i] = root * o->gain * w->jacobian[k].albedo[c][i];
            row->residual = root * o->r[c];
            row->view = o->view;
        }
    return n_rows;
}
