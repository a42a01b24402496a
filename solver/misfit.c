// solver/misfit.c - is what is left of the pictures noise, or something that the model lacks?
//
// One pass over the residuals for moments and bins, one over pairs of texels some steps apart in the
// atlas, right and below, in one chart.
#include "solver/misfit.h"

#include "solver/lm.h"
#include "solver/vec3.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

// Equal areas: bands of equal height on the sphere, cut into equal longitudes.
enum { N_BANDS = 8, N_LONGITUDES = 16, N_BINS = N_BANDS * N_LONGITUDES };
enum { APART = 32 }; // pairs are this part of the texture apart
static const double CERTAIN = 3; // standard deviations: less may be chance

struct bin {
    double sum[3], n;
};

static int bin_of(const double d[3])
{
    const int band = (int)(.5 * (d[2] + 1) * N_BANDS);
    const int longitude = (int)((atan2(d[1], d[0]) / (2 * M_PI) + .5) * N_LONGITUDES);
    return (band < 0 ? 0 : band < N_BANDS ? band : N_BANDS - 1) * N_LONGITUDES + (longitude < N_LONGITUDES ? longitude : N_LONGITUDES - 1);
}

static void direction_of(int bin, double d[3])
{
    const double z = 2 * (bin / N_LONGITUDES + .5) / N_BANDS - 1, lon = 2 * M_PI * ((bin % N_LONGITUDES + .5) / N_LONGITUDES - .5);
    d[0] = sqrt(1 - z * z) * cos(lon), d[1] = sqrt(1 - z * z) * sin(lon), d[2] = z;
}

static void add(struct bin *b, const float r[3])
{
    for (int c = 0; c < 3; c++)
        b->sum[c] += (double)r[c];
    b->n++;
}

// RMS over samples of their bin's mean, less what noise of the given variance (per channel) leaves in a mean.
static double rms_of_means(const struct bin *b, int n_bins, double noise_variance)
{
    double sum = 0, n = 0;
    for (int i = 0; i < n_bins; i++)
        for (int c = 0; b[i].n > 0 && c < 3; c++)
            sum += b[i].sum[c] * b[i].sum[c] / b[i].n - noise_variance, n += b[i].n;
    return n > 0 && sum > 0 ? sqrt(sum / n) : 0;
}

static bool in_use(const struct samples *m, const float (*r)[3], int64_t i)
{
    return !isnan(r[i][0]) && !(m->flags[i] & SAMPLE_CLIPPED);
}

// Of the views that both texels have: r . r', and (|r|^2 + |r'|^2) / 2.
static void add_pair(const struct samples *m, const float (*r)[3], int a, int b, double *shared, double *own, int64_t *n)
{
    int64_t j = m->first[b];
    for (int64_t i = m->first[a]; i < m->first[a + 1]; i++) {
        while (j < m->first[b + 1] && m->view[j] < m->view[i])
            j++;
        if (j == m->first[b + 1])
            return;
        if (m->view[j] != m->view[i] || !in_use(m, r, i) || !in_use(m, r, j))
            continue;
        for (int c = 0; c < 3; c++) {
            const double x = (double)r[i][c], y = (double)r[j][c];
            *shared += x * y;
            *own += .5 * (x * x + y * y);
        }
        ++*n;
    }
}

static void measure_pairs(struct misfit *out, const struct photometric *p, const float (*r)[3])
{
    const struct texels *t = p->texels;
    const int apart = t->size / APART > 1 ? t->size / APART : 1;
    double shared = 0, own = 0;
    for (int a = 0; a < t->n; a++) {
        const int x = (int)t->pixel[a] % t->size, y = (int)t->pixel[a] / t->size;
        for (int k = 0; k < 2; k++) {
            const int bx = x + (k ? 0 : apart), by = y + (k ? apart : 0);
            const int b = bx < t->size && by < t->size ? t->index[by * t->size + bx] : -1;
            if (b >= 0 && t->chart[a] == t->chart[b])
                add_pair(p->samples, r, a, b, &shared, &own, &out->n_pairs);
        }
    }
    const double n = 3 * (double)out->n_pairs, scale = n > 0 ? 1 / n : 0;
    const double noise2 = fmax((own - shared) * scale, 0), chance = n > 0 ? noise2 / sqrt(n) : 0; // of white noise's covariance
    out->structure = sqrt(fmax(shared * scale - CERTAIN * chance, 0));
    out->noise = sqrt(noise2);
}

int misfit_measure(struct misfit *out, const struct photometric *p, const struct photometric_state *s)
{
    const struct samples *m = p->samples;
    float(*r)[3] = malloc((size_t)m->n * sizeof(*r) + 1);
    struct bin *by_view = calloc((size_t)m->n_views + 1, sizeof(*by_view));
    struct bin by_normal[N_BINS] = { 0 }, by_mirror[N_BINS] = { 0 };
    double squares = 0, light = 0;
    memset(out, 0, sizeof(*out));
    int err = r && by_view ? photometric_residuals(p, s, r) : -ENOMEM;
    if (err)
        goto end;
    for (int t = 0; t < m->n_texels; t++)
        for (int64_t i = m->first[t]; i < m->first[t + 1]; i++) {
            float v[3], o[3];
            double n[3], mirrored[3];
            if (!in_use(m, r, i))
                continue;
            samples_radiance(m, i, o);
            samples_view_direction(m, p->texels, t, m->view[i], v);
            for (int c = 0; c < 3; c++) {
                squares += (double)r[i][c] * (double)r[i][c];
                light += (double)o[c] * (double)o[c];
                n[c] = (double)p->texels->normal[t][c];
                mirrored[c] = -(double)v[c];
            }
            vec3_add_scaled(mirrored, mirrored, -2 * vec3_dot(n, mirrored), n);
            add(&by_view[m->view[i]], r[i]);
            add(&by_normal[bin_of(n)], r[i]);
            add(&by_mirror[bin_of(mirrored)], r[i]);
            out->n_samples++;
        }
    if (out->n_samples) {
        out->residual = sqrt(squares / (3 * (double)out->n_samples));
        out->level = sqrt(light / (3 * (double)out->n_samples));
    }
    measure_pairs(out, p, (const float(*)[3])r);
    const double variance = out->noise * out->noise;
    out->by_view = rms_of_means(by_view, m->n_views, variance);
    out->by_normal = rms_of_means(by_normal, N_BINS, variance);
    out->by_mirror = rms_of_means(by_mirror, N_BINS, variance);
    double most = 0;
    for (int i = 0; i < N_BINS; i++) { // the model is too dark there: L - o < 0
        const double lack = by_mirror[i].n > 0 ? -(by_mirror[i].sum[0] + by_mirror[i].sum[1] + by_mirror[i].sum[2]) / sqrt(by_mirror[i].n) : 0;
        if (lack > most)
            most = lack, direction_of(i, out->brighter);
    }
end:
    free(r);
    free(by_view);
    return err;
}

enum { PATCHES = 6, N_PATCHES = PATCHES * PATCHES }; // of the texture

static int by_double(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// A of all, and g of every patch (0 where nothing is in it).
static int pull_of_patches(double *A, double *g, const struct photometric *p, const struct photometric_state *s, const unsigned char *is_free,
                           size_t n_unknowns)
{
    const struct texels *t = p->texels;
    struct photometric patch = *p;
    uint8_t *use = malloc((size_t)t->n + 1);
    int err = use ? 0 : -ENOMEM;
    patch.use_texel = use;
    for (int k = 0; !err && k < N_PATCHES; k++) {
        for (int i = 0; i < t->n; i++) {
            const int x = (int)t->pixel[i] % t->size * PATCHES / t->size, y = (int)t->pixel[i] / t->size * PATCHES / t->size;
            use[i] = y * PATCHES + x == k && (!p->use_texel || p->use_texel[i]);
        }
        err = photometric_normal_equations(&patch, s, is_free, A, g + (size_t)k * n_unknowns);
    }
    free(use);
    return err;
}

// Squares of `wide` x `wide` patches become one draw each: their pulls into out, those without any left out. Returns how many.
static int widen(double *out, const double *g, int wide, size_t n)
{
    const int side = PATCHES / wide;
    int n_draws = 0;
    for (int k = 0; k < side * side; k++) {
        double *draw = out + (size_t)n_draws * n, most = 0;
        memset(draw, 0, n * sizeof(double));
        for (int i = 0; i < wide * wide; i++) {
            const int patch = (k / side * wide + i / wide) * PATCHES + k % side * wide + i % wide;
            for (size_t j = 0; j < n; j++)
                draw[j] += g[(size_t)patch * n + j];
        }
        for (size_t j = 0; j < n; j++)
            most = fmax(most, fabs(draw[j]));
        n_draws += most > 0;
    }
    return n_draws;
}

// How much larger each unknown's variance is than sigma2 C says when a patch is one draw ([n]): raised to that where it is less.
// Returns the median over the distances: one of them alone is told by few patches.
static double inflate(double *inflation, const double *C, const double *draws, int n_draws, double sigma2, const unsigned char *used,
                      const struct photometric_layout *l)
{
    const size_t n = (size_t)l->n;
    double of_distances[l->n_groups], mean[n];
    int m = 0;
    for (size_t j = 0; j < n; j++) {
        mean[j] = 0;
        for (int k = 0; k < n_draws; k++)
            mean[j] += draws[(size_t)k * n + j] / n_draws;
    }
    for (size_t i = 0; i < n; i++) {
        double sum = 0;
        for (int k = 0; used[i] && k < n_draws; k++) {
            double step = 0;
            for (size_t j = 0; j < n; j++)
                step += C[i * n + j] * (draws[(size_t)k * n + j] - mean[j]);
            sum += step * step;
        }
        const double here = used[i] ? sum * n_draws / (n_draws - 1) / (sigma2 * C[i * n + i]) : 1;
        inflation[i] = fmax(inflation[i], here);
        if (used[i] && i >= (size_t)l->inverse_distance)
            of_distances[m++] = here;
    }
    qsort(of_distances, (size_t)m, sizeof(double), by_double);
    return m ? of_distances[m / 2] : 1;
}

int misfit_deviations(double *deviation, double *inflation, const struct photometric *p, const struct photometric_state *s,
                      const unsigned char *is_free, const double *prior)
{
    const struct photometric_layout l = photometric_layout_of(p->samples->n_views, p->n_groups);
    const size_t n = (size_t)l.n;
    double *A = calloc(n * n, sizeof(double)), *C = calloc(n * n, sizeof(double)), *g = calloc(N_PATCHES * n, sizeof(double)),
           *draws = calloc(N_PATCHES * n, sizeof(double));
    unsigned char used[n];
    double own[n];
    struct photometric_error e = { 0 };
    int singular = 0;
    int err = A && C && g && draws ? pull_of_patches(A, g, p, s, is_free, n) : -ENOMEM;
    if (!err)
        err = photometric_evaluate(p, (struct photometric_state *)s, false, &e);
    if (err)
        goto end;
    const double sigma2 = 2 * e.cost / fmax(3 * (double)e.n, 1);
    for (size_t i = 0; i < n; i++) {
        used[i] = is_free[i] && A[i * n + i] > 0;
        A[i * n + i] *= 1 + 1e-12;
    }
    *inflation = 1;
    for (size_t i = 0; i < n; i++)
        own[i] = 1;
    singular = lm_inverse(l.n, A, used, C);
    for (int wide = 1; !singular && sigma2 > 0 && wide <= 2; wide++) { // nobody knows how far structure reaches: the worse of two
        const int n_draws = widen(draws, g, wide, n);
        if (n_draws > 1)
            *inflation = fmax(*inflation, inflate(own, C, draws, n_draws, sigma2, used, &l));
    }
    if (singular != -ENOMEM && prior && sigma2 > 0) {
        for (size_t i = 0; i < n * n; i++)
            A[i] += *inflation * sigma2 * prior[i];
        singular = lm_inverse(l.n, A, used, C);
    }
    err = singular == -ENOMEM ? -ENOMEM : 0;
    for (size_t i = 0; !err && i < n; i++)
        deviation[i] = !used[i] ? INFINITY : singular ? NAN
                       : sqrt((i < (size_t)l.inverse_distance ? fmax(own[i], *inflation) : *inflation) * sigma2 * C[i * (n + 1)]);
end:
    free(A), free(C), free(g), free(draws);
    return err;
}
