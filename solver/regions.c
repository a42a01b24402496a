// solver/regions.c - dealing texels out to shared reflectances, merging those, and choosing what each texel may have for itself.
#include "solver/regions.h"

#include "solver/labelling.h"
#include "solver/lm.h"
#include "solver/packed.h"
#include "solver/parallel.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

const char *const parameter_freedom_names[3] = { "frozen", "tied", "free" };

enum {
    FIRST_REGIONS = 6,    // cut into so many before merging
    WITNESSES = 192,      // texels a region is fitted to
    EXPLORERS = 48,       // of them, where many places are tried
    DEAL_ROUNDS = 3,
    PATCHES = 64,         // of the surface: within one, errors of the model go together
    MOST_VIEWS = 2048,
};
static const double least_share = .03;       // a smaller region is dissolved: what borders and rims look like, mostly
static const double worth_a_region = 1.10;   // squared error of views set aside, of one reflectance for two regions
static const double worth_a_doubtful_one = 1.5; // the same where no parameter is known to differ: a fifth of the RMSE
static const double certain = 3;             // standard deviations by which a parameter is known to differ
static const double worth_a_metal = 1.5;     // the same where a dielectric would do: a little metal lets every texel choose its own specular colour
static const double worth_a_parameter = .97; // the same with a parameter free per texel
static const double worth_a_layer = 1.01;    // the same without clearcoat, sheen, ...
static const double better_without = .99;
static const double rounding2 = 3e-4 * 3e-4; // what half floats and look-ups leave in any comparison: to gain less is to gain nothing
static const float unknown_misfit = 1.75f; // errors that go together in none of the ways looked at: measured on D3 (90 % intervals over seeds, coverage.sh)
static const double most_free_std = .15;
static const double first_hold = 1e-3;       // until the pictures' error is known
static const double plain_variance = 1. / 12; // a parameter is somewhere in [0,1] before any picture
static const double own_hold = .02;          // the same of one texel's own parameter

// What a parameter is when nothing speaks for it.
static const float plain[DISNEY_N] = { [DISNEY_SPECULAR] = .5f, [DISNEY_ROUGHNESS] = .5f, [DISNEY_CLEARCOAT_GLOSS] = .5f };

struct search {
    const struct texel_scene *scene;
    struct texel_scene inner, aside;     // scene with two thirds of its views, and with the others
    const struct level *level;
    int32_t *texel;                      // [level n] the finest texel that speaks for it, -1: nobody
    float (*albedo)[3];                  // [texels n]
    struct texel_worker **worker;
    int n_workers, n_threads;
    uint8_t *region;                     // [level n]
    float *cost;                         // [level n][REGIONS_MAX] of a sample, in the mean
    float *evidence;                     // the same as nats
    int *n_samples;                      // [level n]
    float (*colour)[3];                  // [level n] of a matt surface, logarithms; NAN: not known
    float bandwidth[3];
    double hold;                         // draws what nothing determines towards plain, beside the sum of squares
    struct regions *out;
    uint16_t frozen[REGIONS_MAX];        // of each region: metallic, or nothing
};

struct witnesses {
    int n, node[WITNESSES];
    int32_t texel[WITNESSES];
};

// Evenly spread over the nodes of the regions in `mask`; those amid their own kind first.
static void call_witnesses(const struct search *s, unsigned mask, struct witnesses *w)
{
    const struct level *l = s->level;
    w->n = 0;
    for (int inner = 1; inner >= 0 && w->n < 16; inner--) {
        int n = 0, seen = 0;
        for (int pass = 0; pass < 2; pass++)
            for (int i = 0; i < l->n; i++) {
                bool amid = s->texel[i] >= 0 && (mask >> s->region[i] & 1);
                for (int32_t m = l->first_neighbour[i]; inner && amid && m < l->first_neighbour[i + 1]; m++)
                    amid = mask >> s->region[l->neighbour[m]] & 1;
                if (!amid)
                    continue;
                if (!pass) {
                    n++;
                    continue;
                }
                const int keep = n < WITNESSES ? n : WITNESSES; // the k-th is kept where k keep / n rises
                if ((int64_t)(seen + 1) * keep / n > (int64_t)seen * keep / n && w->n < WITNESSES) {
                    w->node[w->n] = i;
                    w->texel[w->n++] = s->texel[i];
                }
                seen++;
            }
        if (inner && w->n < 16)
            w->n = 0; // a sliver: take its rim as well
    }
}

// ---- one reflectance for many texels ------------------------------------------------------------------------------------

enum { N_SHARED = 1 + DISNEY_N + THETA_PACKED };

struct shared_fit {
    struct search *s;
    const struct texel_scene *scene;
    const struct witnesses *w;
    uint16_t frozen;         // parameters that stay plain
    float theta[DISNEY_N];
    double sums[N_SHARED];   // at theta: cost, g, H
    bool known;
};

static void add_witnesses(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    struct shared_fit *f = arg;
    for (int64_t k = begin; k < end; k++) {
        struct texel_sums sums = { 0 };
        texel_fit(f->scene, f->s->worker[worker], f->w->texel[k], 0, f->theta, f->s->albedo[f->w->texel[k]], 1, &sums);
        partial[0] += sums.cost;
        for (int p = 0; p < DISNEY_N; p++)
            partial[1 + p] += sums.g[p];
        for (int p = 0; p < THETA_PACKED; p++)
            partial[1 + DISNEY_N + p] += sums.H[p];
    }
}

static int shared_equations(void *arg, const double *x, double *cost, double *A, double *g)
{
    struct shared_fit *f = arg;
    bool known = f->known; // a step that is taken was just looked at
    for (int p = 0; p < DISNEY_N; p++) {
        known = known && f->theta[p] == (float)x[p];
        f->theta[p] = (float)x[p];
    }
    if (!known)
        memset(f->sums, 0, sizeof(f->sums));
    const double *sums = f->sums;
    const int err = known ? 0 : parallel_sum(f->s->n_threads, f->w->n, 4, add_witnesses, f, N_SHARED, f->sums);
    f->known = !err;
    *cost = sums[0];
    for (int p = 0; p < DISNEY_N; p++) {
        const double d = x[p] - (double)plain[p];
        *cost += .5 * f->s->hold * d * d;
        if (!A)
            continue;
        g[p] += sums[1 + p] + f->s->hold * d;
        for (int q = 0; q <= p; q++)
            A[p * DISNEY_N + q] += sums[1 + DISNEY_N + packed_at(p, q)] + (p == q ? f->s->hold : 0);
    }
    return err;
}

static int shared_cost(void *arg, const double *x, double *cost)
{
    return shared_equations(arg, x, cost, NULL, NULL);
}

static int fit_from(struct shared_fit *f, const float start[DISNEY_N], int most_iterations, double relative_cost,
                    float theta[DISNEY_N], double *cost)
{
    static const double lower[DISNEY_N] = { 0 }, upper[DISNEY_N] = { 1, 1, 1, 1, 1, 1, 1, 1, 1, 1 };
    double low[DISNEY_N], high[DISNEY_N], x[DISNEY_N];
    const struct lm_problem problem = { .n = DISNEY_N, .lower = low, .upper = high, .cost = shared_cost,
                                        .normal_equations = shared_equations, .arg = f };
    struct lm_settings set = lm_defaults();
    struct lm_result result = { 0 };
    set.max_iterations = most_iterations, set.relative_cost = relative_cost;
    for (int p = 0; p < DISNEY_N; p++) {
        const bool frozen = f->frozen >> p & 1;
        x[p] = frozen ? (double)plain[p] : fmin(fmax((double)start[p], .02), .98); // at a bound nothing moves
        low[p] = frozen ? x[p] : lower[p], high[p] = frozen ? x[p] : upper[p];
    }
    const int err = lm_minimise(&problem, &set, x, &result);
    *cost = result.cost;
    for (int p = 0; p < DISNEY_N && !err; p++)
        theta[p] = (float)x[p];
    return err;
}

// theta: a guess in. Highlights have many wrong explanations, so from a few places: the guess, dielectrics and metals, dull and sharp.
static int fit_shared(struct search *s, const struct texel_scene *scene, const struct witnesses *w, uint16_t frozen, bool anywhere,
                      float theta[DISNEY_N])
{
    static const float starts[][2] = { { 0, .15f }, { 0, .35f }, { 0, .7f }, { 1, .2f }, { 1, .45f } }; // metallic, roughness
    struct witnesses some = { 0 }; // are enough to choose a place
    struct shared_fit f = { .s = s, .scene = scene, .w = anywhere ? &some : w, .frozen = frozen };
    float best[DISNEY_N];
    double least;
    if (!w->n)
        return 0;
    for (int k = 0; k < EXPLORERS && k < w->n; k++)
        some.texel[some.n++] = w->texel[(int64_t)k * w->n / (w->n < EXPLORERS ? w->n : EXPLORERS)];
    int err = fit_from(&f, theta, anywhere ? 8 : 30, 1e-5, best, &least);
    for (size_t k = 0; !err && anywhere && k < sizeof(starts) / sizeof(*starts); k++) {
        float from[DISNEY_N], to[DISNEY_N];
        double cost;
        memcpy(from, plain, sizeof(from));
        from[DISNEY_METALLIC] = starts[k][0], from[DISNEY_ROUGHNESS] = starts[k][1];
        err = fit_from(&f, from, 8, 1e-3, to, &cost);
        if (!err && cost < least) {
            least = cost;
            memcpy(best, to, sizeof(best));
        }
    }
    f.w = w, f.known = false;
    if (!err && anywhere)
        err = fit_from(&f, best, 30, 1e-5, best, &least);
    if (!err)
        memcpy(theta, best, sizeof(best));
    return err;
}

struct testing {
    struct search *s;
    const struct witnesses *w;
    const float *theta;
    uint16_t free_mask;  // parameters each texel has for itself
    int candidate;       // whose standard deviation is asked for
    float *std;          // [w->n]
    float *error2;       // [w->n] mean squared error of each
};

// One texel's own values of the free parameters, drawn towards the region's. The standard deviation of the candidate.
static void fit_own(const struct testing *t, struct texel_worker *worker, int k, float theta[DISNEY_N], float albedo[3])
{
    double mu = 1e-3, cost = INFINITY, H[THETA_PACKED] = { 0 }, g[DISNEY_N] = { 0 };
    float trial[DISNEY_N], trial_albedo[3];
    int n = 0;
    memcpy(trial, theta, sizeof(trial)), memcpy(trial_albedo, albedo, sizeof(trial_albedo));
    for (int iteration = 0; iteration < 8; iteration++) {
        struct texel_sums sums = { 0 };
        texel_fit(&t->s->inner, worker, t->w->texel[k], 0, trial, trial_albedo, 1, &sums);
        for (int p = 0; p < DISNEY_N; p++) {
            const double d = (double)(trial[p] - t->theta[p]);
            sums.cost += .5 * own_hold * d * d;
            sums.g[p] += own_hold * d;
            sums.H[packed_at(p, p)] += own_hold;
        }
        const double gain = cost - sums.cost;
        if (gain > 0) {
            memcpy(theta, trial, sizeof(trial)), memcpy(albedo, trial_albedo, sizeof(trial_albedo));
            memcpy(H, sums.H, sizeof(H)), memcpy(g, sums.g, sizeof(g));
            cost = sums.cost, n = sums.n, mu = fmax(mu / 5, 1e-7);
        } else {
            mu *= 8;
        }
        if (gain > 0 && gain < 1e-4 * cost)
            break;
        double M[THETA_PACKED], x[DISNEY_N];
        memcpy(M, H, sizeof(M));
        for (int p = 0; p < DISNEY_N; p++) {
            x[p] = -g[p];
            const int at = packed_at(p, p);
            M[at] += mu * M[at];
            if ((t->free_mask >> p & 1) && !(theta[p] <= 0 && g[p] > 0) && !(theta[p] >= 1 && g[p] < 0))
                continue;
            for (int q = 0; q < DISNEY_N; q++)
                M[packed_at(p, q)] = 0;
            M[at] = 1, x[p] = 0;
        }
        if (!packed_factor(DISNEY_N, M))
            break;
        packed_solve(DISNEY_N, M, x);
        memcpy(trial, theta, sizeof(trial)), memcpy(trial_albedo, albedo, sizeof(trial_albedo));
        for (int p = 0; p < DISNEY_N; p++)
            trial[p] = fminf(fmaxf(theta[p] + (float)x[p], 0), 1);
    }
    t->std[k] = INFINITY;
    if (t->candidate < 0 || !n)
        return;
    for (int p = 0; p < DISNEY_N; p++)
        for (int q = 0; q < DISNEY_N && !(t->free_mask >> p & 1); q++)
            H[packed_at(p, q)] = p == q;
    double x[DISNEY_N] = { 0 };
    x[t->candidate] = 1;
    if (packed_factor(DISNEY_N, H)) {
        packed_solve(DISNEY_N, H, x);
        t->std[k] = (float)sqrt(2 * cost / fmax(3 * n - 6, 3) * x[t->candidate]);
    }
}

// partial: squares, samples of the views set aside, with the albedo of the others.
static void test_witnesses(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    const struct testing *t = arg;
    for (int k = (int)begin; k < (int)end; k++) {
        float theta[DISNEY_N], albedo[3];
        struct texel_sums sums = { 0 };
        struct texel_error error = { 0 };
        memcpy(theta, t->theta, sizeof(theta));
        memcpy(albedo, t->s->albedo[t->w->texel[k]], sizeof(albedo));
        if (t->free_mask)
            fit_own(t, t->s->worker[worker], k, theta, albedo);
        else
            texel_fit_albedo(&t->s->inner, t->s->worker[worker], t->w->texel[k], 0, theta, albedo, 1, &sums);
        texel_measure(&t->s->aside, t->s->worker[worker], t->w->texel[k], theta, albedo, &error);
        t->error2[k] = error.n ? (float)(error.squares / (3 * (double)error.n)) : 0;
        partial[0] += error.squares, partial[1] += 3 * (double)error.n;
    }
}

// Mean squared error of the views set aside. each[WITNESSES]: of every witness, or NULL.
static int test(struct search *s, const struct witnesses *w, const float theta[DISNEY_N], uint16_t free_mask, int candidate, double *error2,
                double *median_std, float *each)
{
    float std[WITNESSES], errors[WITNESSES];
    struct testing t = { s, w, theta, free_mask, candidate, std, each ? each : errors };
    double sums[2] = { 0 };
    const int err = parallel_sum(s->n_threads, w->n, 4, test_witnesses, &t, 2, sums);
    *error2 = sums[0] / fmax(sums[1], 1);
    if (!err && median_std) { // by insertion
        for (int k = 1; k < w->n; k++) {
            const float x = std[k];
            int at = k;
            for (; at > 0 && std[at - 1] > x; at--)
                std[at] = std[at - 1];
            std[at] = x;
        }
        *median_std = w->n ? (double)std[w->n / 2] : INFINITY;
    }
    return err;
}

// ---- dealing out --------------------------------------------------------------------------------------------------------

static void cost_nodes(void *arg, int64_t begin, int64_t end, int worker)
{
    struct search *s = arg;
    for (int64_t i = begin; i < end; i++)
        for (int r = 0; r < s->out->n; r++) {
            float albedo[3];
            struct texel_sums sums = { 0 };
            s->cost[i * REGIONS_MAX + r] = 0;
            if (s->texel[i] < 0)
                continue;
            memcpy(albedo, s->albedo[s->texel[i]], sizeof(albedo));
            texel_fit_albedo(s->scene, s->worker[worker], s->texel[i], 0, s->out->region[r].theta, albedo, 1, &sums);
            s->cost[i * REGIONS_MAX + r] = (float)(sums.left_out_cost / fmax(sums.n, 1));
            s->n_samples[i] = sums.n;
        }
}

static int by_float(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

// Nats against each region of a texel whose errors have a variance of their own, unknown: n/2 log(sum of squares). Errors of a texel's samples go
// together: lights, shape.
static void weigh_evidence(const float *cost, int n_regions, int n_samples, float *evidence)
{
    static const float independent = .25f; // of its samples
    for (int r = 0; r < n_regions; r++)
        evidence[r] = isinf(cost[r]) ? INFINITY : .5f * independent * (float)n_samples * logf(cost[r] + (float)rounding2);
}

static int deal_out(struct search *s)
{
    const struct level *l = s->level;
    parallel_for(s->n_threads, l->n, 16, cost_nodes, s);
    float *least = malloc(((size_t)l->n + 1) * sizeof(float));
    if (!least)
        return -ENOMEM;
    int n = 0;
    for (int i = 0; i < l->n; i++) {
        if (s->texel[i] < 0)
            continue;
        least[n] = INFINITY;
        for (int r = 0; r < s->out->n; r++)
            least[n] = fminf(least[n], s->cost[(size_t)i * REGIONS_MAX + (size_t)r]);
        n++;
    }
    qsort(least, (size_t)n, sizeof(float), by_float);
    const double median = n ? (double)least[n / 2] : 0; // half the squares of a sample's three channels
    s->hold = fmin(2 * median / 3 / plain_variance, first_hold);
    free(least);
    for (int i = 0; i < l->n; i++)
        weigh_evidence(s->cost + (size_t)i * REGIONS_MAX, s->out->n, s->n_samples[i], s->evidence + (size_t)i * REGIONS_MAX);
    const struct labelling job = { .level = l, .n_labels = s->out->n, .stride = REGIONS_MAX, .evidence = s->evidence,
                                   .colour = (const float(*)[3])s->colour, .bandwidth = s->bandwidth, .votes = true };
    return labelling_find(s->region, &job);
}

// A matt surface's albedo by the median of the samples: what most views see, whatever a few see mirrored. False: no light, no samples.
static bool colour_of(const struct texel_scene *scene, struct texel_worker *worker, int texel, float colour[3])
{
    static const float matt[DISNEY_N] = { [DISNEY_ROUGHNESS] = 1 }, grey[3] = { .5f, .5f, .5f };
    static const float least_albedo = .01f;
    const struct texel_row *rows;
    struct texel_scene plainly = *scene;
    float of_sample[3][TEXEL_VIEWS_MAX];
    int n[3] = { 0 };
    plainly.robust_scale = 0;
    const int n_rows = texel_rows(&plainly, worker, texel, matt, grey, &rows);
    for (int k = 0; k < n_rows; k++)
        for (int c = 0; c < 3; c++)
            if (rows[k].J[DISNEY_N + c] > 1e-4f)
                of_sample[c][n[c]++] = grey[c] - rows[k].residual / rows[k].J[DISNEY_N + c];
    for (int c = 0; c < 3; c++) {
        if (!n[c])
            return false;
        qsort(of_sample[c], (size_t)n[c], sizeof(float), by_float);
        colour[c] = logf(fmaxf(of_sample[c][n[c] / 2], 0) + least_albedo);
    }
    return true;
}

static void colour_nodes(void *arg, int64_t begin, int64_t end, int worker)
{
    struct search *s = arg;
    for (int64_t i = begin; i < end; i++)
        if (s->texel[i] < 0 || !colour_of(s->scene, s->worker[worker], s->texel[i], s->colour[i]))
            s->colour[i][0] = NAN;
}

static void count(struct search *s)
{
    for (int r = 0; r < s->out->n; r++)
        s->out->region[r].n_texels = 0;
    for (int i = 0; i < s->level->n; i++)
        s->out->region[s->region[i]].n_texels++;
}

static void rename_region(struct search *s, int from, int to)
{
    for (int i = 0; i < s->level->n; i++)
        if (s->region[i] == from)
            s->region[i] = (uint8_t)to;
}

// Region r's nodes have gone elsewhere.
static void drop(struct search *s, int r)
{
    const int last = --s->out->n;
    if (r != last) {
        rename_region(s, last, r);
        s->out->region[r] = s->out->region[last];
        s->frozen[r] = s->frozen[last];
    }
}

// As a dielectric, or with what metal the samples want where views set aside are explained far better so: true metal, even a fifth of it, leaves a
// dielectric with several times its squared error; under lights that are off a glaze with free specular colours gains a tenth or a quarter.
static int fit_either(struct search *s, const struct witnesses *w, bool anywhere, float theta[DISNEY_N], uint16_t *frozen)
{
    float dielectric[DISNEY_N];
    double with, without;
    memcpy(dielectric, theta, sizeof(dielectric));
    int err = fit_shared(s, &s->inner, w, 0, anywhere, theta);
    if (!err)
        err = fit_shared(s, &s->inner, w, 1 << DISNEY_METALLIC, anywhere, dielectric);
    if (!err)
        err = test(s, w, theta, 0, -1, &with, NULL, NULL);
    if (!err)
        err = test(s, w, dielectric, 0, -1, &without, NULL, NULL);
    if (err)
        return err;
    *frozen = without < worth_a_metal * with + rounding2 ? 1 << DISNEY_METALLIC : 0;
    if (*frozen)
        memcpy(theta, dielectric, sizeof(dielectric));
    return 0;
}

static int fit_all(struct search *s, bool anywhere)
{
    int err = 0;
    for (int r = 0; !err && r < s->out->n; r++) {
        struct witnesses w;
        call_witnesses(s, 1u << r, &w);
        if (w.n)
            err = fit_either(s, &w, anywhere, s->out->region[r].theta, &s->frozen[r]);
    }
    return err;
}

// Nodes fall into FIRST_REGIONS by what the coarse solve found: k-means over metallic, specular, roughness and albedo.
enum { N_FEATURES = 6 };

static void features_of(const struct search *s, const float (*theta)[DISNEY_N], int i, float f[N_FEATURES])
{
    const float *a = s->albedo[s->texel[i]], sum = a[0] + a[1] + a[2] + 1e-3f;
    f[0] = theta[i][DISNEY_METALLIC], f[1] = .5f * theta[i][DISNEY_SPECULAR], f[2] = 2 * theta[i][DISNEY_ROUGHNESS];
    f[3] = .5f * sum / 3, f[4] = a[0] / sum, f[5] = a[2] / sum;
}

static float apart(const float a[N_FEATURES], const float b[N_FEATURES])
{
    float sum = 0;
    for (int k = 0; k < N_FEATURES; k++)
        sum += (a[k] - b[k]) * (a[k] - b[k]);
    return sum;
}

static int nearest_of(const float f[N_FEATURES], float (*centre)[N_FEATURES], int n)
{
    int best = 0;
    for (int k = 1; k < n; k++)
        best = apart(f, centre[k]) < apart(f, centre[best]) ? k : best;
    return best;
}

static int cut(struct search *s, const float (*theta)[DISNEY_N])
{
    const struct level *l = s->level;
    float(*f)[N_FEATURES] = calloc((size_t)l->n + 1, sizeof(*f)), centre[FIRST_REGIONS][N_FEATURES] = { { 0 } };
    int n_known = 0, n = 0;
    if (!f)
        return -ENOMEM;
    for (int i = 0; i < l->n; i++) {
        if (s->texel[i] < 0)
            continue;
        features_of(s, theta, i, f[i]);
        for (int k = 0; k < N_FEATURES; k++)
            centre[0][k] += f[i][k];
        n_known++;
    }
    for (int k = 0; k < N_FEATURES; k++)
        centre[0][k] /= (float)(n_known ? n_known : 1);
    // Seeds far from those there are, but not the farthest of all: an outlier is no material.
    float *far = malloc(((size_t)l->n + 1) * sizeof(float));
    for (n = 1; far && n < FIRST_REGIONS && n_known > 16 * n; n++) {
        int m = 0, chosen = -1;
        for (int i = 0; i < l->n; i++)
            if (s->texel[i] >= 0)
                far[m++] = apart(f[i], centre[nearest_of(f[i], centre, n)]);
        qsort(far, (size_t)m, sizeof(float), by_float);
        const float wanted = far[m - 1 - m / 50];
        for (int i = 0; i < l->n && chosen < 0; i++)
            if (s->texel[i] >= 0 && apart(f[i], centre[nearest_of(f[i], centre, n)]) >= wanted)
                chosen = i;
        memcpy(centre[n], f[chosen], sizeof(centre[n]));
    }
    for (int round = 0; far && round < 12; round++) {
        double sum[FIRST_REGIONS][N_FEATURES] = { { 0 } };
        int members[FIRST_REGIONS] = { 0 };
        for (int i = 0; i < l->n; i++) {
            s->region[i] = 0;
            if (s->texel[i] < 0)
                continue;
            s->region[i] = (uint8_t)nearest_of(f[i], centre, n);
            members[s->region[i]]++;
            for (int k = 0; k < N_FEATURES; k++)
                sum[s->region[i]][k] += (double)f[i][k];
        }
        for (int r = 0; r < n; r++)
            for (int k = 0; k < N_FEATURES && members[r]; k++)
                centre[r][k] = (float)(sum[r][k] / members[r]);
    }
    s->out->n = n;
    for (int r = 0; r < n; r++) {
        double sum[DISNEY_N] = { 0 };
        int members = 0;
        for (int i = 0; i < l->n; i++)
            if (s->region[i] == r && s->texel[i] >= 0) {
                members++;
                for (int p = 0; p < DISNEY_N; p++)
                    sum[p] += (double)theta[i][p];
            }
        for (int p = 0; p < DISNEY_N; p++)
            s->out->region[r].theta[p] = members ? (float)(sum[p] / members) : .5f;
    }
    free(f);
    const int err = far ? 0 : -ENOMEM;
    free(far);
    return err;
}

static int dissolve_small(struct search *s)
{
    int err = 0;
    count(s);
    for (int r = s->out->n - 1; !err && r >= 0 && s->out->n > 1; r--) {
        if (s->out->region[r].n_texels >= least_share * s->level->n)
            continue;
        for (int i = 0; i < s->level->n; i++) { // to the next best
            if (s->region[i] != r)
                continue;
            const float *c = s->cost + (size_t)i * REGIONS_MAX;
            int best = -1;
            for (int q = 0; q < s->out->n; q++)
                if (q != r && (best < 0 || c[q] < c[best]))
                    best = q;
            s->region[i] = (uint8_t)best;
        }
        drop(s, r);
        err = deal_out(s);
        count(s);
    }
    return err;
}

// What a model lacks goes together in some way: in a view (exposure, camera), in a patch of the surface (shape), in views as oblique
// (footprints near the outline), in normals and mirrored views alike (lights). The scores, J^T residual, are summed over each such group.
enum { BY_VIEW, BY_PATCH, BY_SLANT, BY_NORMAL, BY_MIRROR, N_WAYS, N_SLANTS = 8 };

static int octant_of(const float d[3])
{
    return (d[0] > 0) | (d[1] > 0) << 1 | (d[2] > 0) << 2;
}

static void groups_of(const struct texel_scene *scene, int texel, int view, int patch, int group[N_WAYS])
{
    const float *n = scene->texels->normal[texel];
    float v[3], mirrored[3];
    samples_view_direction(scene->samples, scene->texels, texel, view, v);
    const float nv = n[0] * v[0] + n[1] * v[1] + n[2] * v[2];
    for (int c = 0; c < 3; c++)
        mirrored[c] = 2 * nv * n[c] - v[c];
    group[BY_VIEW] = view, group[BY_PATCH] = patch;
    group[BY_SLANT] = (int)fminf(fmaxf(nv * N_SLANTS, 0), N_SLANTS - 1);
    group[BY_NORMAL] = octant_of(n), group[BY_MIRROR] = octant_of(mirrored);
}

// B += sign * the sum of g g^T.
static void add_squares(double B[THETA_PACKED], const double g[DISNEY_N], double sign)
{
    for (int p = 0; p < DISNEY_N; p++)
        for (int q = 0; q <= p; q++)
            B[packed_at(p, q)] += sign * g[p] * g[q];
}

// Covariance of a region's theta, albedos eliminated: A^-1 B A^-1 with B the squared scores of samples, and what they are more than that
// when summed over the groups of each way (Cameron, Gelbach, Miller 2011).
static int region_uncertainty(struct search *s, const struct texel_scene *scene, const struct witnesses *w, uint16_t frozen, struct region *r)
{
    double A[THETA_PACKED] = { 0 }, B[THETA_PACKED] = { 0 }, B_samples[THETA_PACKED] = { 0 }, C[DISNEY_N][DISNEY_N] = { { 0 } };
    const int n_views = s->scene->samples->n_views, n_groups = n_views > PATCHES ? n_views : PATCHES;
    double(*score)[DISNEY_N] = calloc((size_t)n_groups * N_WAYS, sizeof(*score));
    double(*J)[DISNEY_N] = malloc(3 * TEXEL_VIEWS_MAX * sizeof(*J));
    int err = score && J ? 0 : -ENOMEM;
    for (int k = 0; !err && k < w->n; k++) {
        const struct texel_row *rows;
        struct texel_sums sums = { 0 };
        texel_fit_albedo(scene, s->worker[0], w->texel[k], 0, r->theta, s->albedo[w->texel[k]], 1, &sums);
        const int n = texel_rows(scene, s->worker[0], w->texel[k], r->theta, s->albedo[w->texel[k]], &rows);
        double own[6] = { 1e-12, 0, 1e-12, 0, 0, 1e-12 }, mixed[DISNEY_N][3] = { { 0 } };
        for (int i = 0; i < n; i++)
            for (int a = 0; a < 3; a++) {
                for (int b = 0; b <= a; b++)
                    own[packed_at(a, b)] += (double)rows[i].J[DISNEY_N + a] * (double)rows[i].J[DISNEY_N + b];
                for (int p = 0; p < DISNEY_N; p++)
                    mixed[p][a] += (double)rows[i].J[DISNEY_N + a] * (double)rows[i].J[p];
            }
        if (!packed_factor(3, own))
            continue;
        for (int p = 0; p < DISNEY_N; p++)
            packed_solve(3, own, mixed[p]);
        double of_sample[DISNEY_N] = { 0 };
        for (int i = 0; i < n; i++) {
            int group[N_WAYS];
            groups_of(scene, w->texel[k], rows[i].view, (int)((int64_t)k * PATCHES / w->n), group);
            for (int p = 0; p < DISNEY_N; p++) {
                J[i][p] = (double)rows[i].J[p];
                for (int a = 0; a < 3; a++)
                    J[i][p] -= mixed[p][a] * (double)rows[i].J[DISNEY_N + a];
                const double g = frozen >> p & 1 ? 0 : J[i][p] * (double)rows[i].residual;
                of_sample[p] += g;
                for (int way = 0; way < N_WAYS; way++)
                    score[way * n_groups + group[way]][p] += g;
            }
            if (i + 1 == n || rows[i + 1].view != rows[i].view) { // its three channels
                add_squares(B_samples, of_sample, 1);
                memset(of_sample, 0, sizeof(of_sample));
            }
            add_squares(A, J[i], 1);
        }
    }
    for (int i = 0; !err && i < n_groups * N_WAYS; i++)
        add_squares(B, score[i], 1);
    for (int p = 0; p < THETA_PACKED; p++)
        B[p] -= (N_WAYS - 1) * B_samples[p];
    for (int p = 0; p < DISNEY_N; p++) {
        A[packed_at(p, p)] += s->hold;
    }
    free(score);
    free(J);
    if (err)
        return err;
    for (int p = 0; p < DISNEY_N; p++) {
        for (int q = 0; q < DISNEY_N && (frozen >> p & 1); q++)
            A[packed_at(p, q)] = p == q;
        B[packed_at(p, p)] += frozen >> p & 1 ? 0 : plain_variance * s->hold * s->hold; // drawn from a truth that is so far away
    }
    double inverse[DISNEY_N][DISNEY_N] = { { 0 } };
    const bool regular = packed_factor(DISNEY_N, A);
    for (int p = 0; regular && p < DISNEY_N; p++) {
        inverse[p][p] = 1;
        packed_solve(DISNEY_N, A, inverse[p]);
    }
    double least[DISNEY_N] = { 0 };
    for (int p = 0; p < DISNEY_N; p++)
        for (int q = 0; q < DISNEY_N; q++)
            for (int a = 0; a < DISNEY_N; a++)
                for (int b = 0; b < DISNEY_N; b++) {
                    C[p][q] += inverse[p][a] * B[packed_at(a, b)] * inverse[b][q];
                    least[p] += p == q ? inverse[p][a] * B_samples[packed_at(a, b)] * inverse[b][q] : 0;
                }
    for (int p = 0; p < DISNEY_N; p++) {
        C[p][p] = fmax(C[p][p], least[p]); // a difference of squares may be anything
        // what the data do not say, or say no better than that it is a number in [0,1], has no standard deviation
        const double said = regular && !(frozen >> p & 1) ? 1 - s->hold * inverse[p][p] : 0;
        r->std[p] = said > .5 && C[p][p] < plain_variance ? (float)sqrt(C[p][p]) : INFINITY;
        for (int q = 0; q <= p; q++)
            r->covariance[packed_at(p, q)] = C[p][q];
    }
    return 0;
}

// By what factor the witnesses' errors grow from `alone` to `shared`: the mean over them of the logarithm, as texels are very unlike; and as
// much less as could be chance (two standard errors).
static double how_much_worse(const float *shared, const float *alone, int n)
{
    double sum = 0, squares = 0;
    for (int k = 0; k < n; k++) {
        const double worse = log(((double)shared[k] + rounding2) / ((double)alone[k] + rounding2));
        sum += worse, squares += worse * worse;
    }
    if (n < 2)
        return 1;
    const double mean = sum / n, variance = fmax(squares / n - mean * mean, 0) / (n - 1);
    return exp(mean - 2 * sqrt(variance));
}

// Does some parameter of the two differ by more than is not known of it?
static bool known_to_differ(const struct region *a, const struct region *b)
{
    for (int p = 0; p < DISNEY_N; p++) {
        const int at = packed_at(p, p);
        const double d = (double)(a->theta[p] - b->theta[p]), std = (double)unknown_misfit * sqrt(a->covariance[at] + b->covariance[at]);
        if (fabs(d) > certain * std)
            return true;
    }
    return false;
}

// As many of either.
static void call_both(const struct witnesses *a, const struct witnesses *b, struct witnesses *both)
{
    both->n = 0;
    for (int side = 0; side < 2; side++) {
        const struct witnesses *w = side ? b : a;
        const int n = w->n < WITNESSES / 2 ? w->n : WITNESSES / 2;
        for (int k = 0; k < n; k++)
            both->texel[both->n++] = w->texel[(int64_t)k * w->n / n];
    }
}

// Two regions are one as long as both do as well under one reflectance: no worse than by a tenth of the squared error, or by half of it while
// no parameter is known to differ. Where the lights are wrong every piece of the surface does better by itself, in views set aside too, which
// share the lights' error.
static int merge(struct search *s)
{
    int err = 0;
    while (!err && s->out->n > 1) {
        double least = INFINITY, error2;
        float alone[REGIONS_MAX][WITNESSES];
        struct witnesses w[REGIONS_MAX];
        float best_theta[DISNEY_N];
        int best_a = -1, best_b = -1;
        for (int r = 0; !err && r < s->out->n; r++) {
            call_witnesses(s, 1u << r, &w[r]);
            err = test(s, &w[r], s->out->region[r].theta, 0, -1, &error2, NULL, alone[r]);
            if (!err)
                err = region_uncertainty(s, &s->inner, &w[r], 0, &s->out->region[r]);
        }
        for (int a = 0; !err && a < s->out->n; a++)
            for (int b = a + 1; !err && b < s->out->n; b++) {
                struct witnesses both;
                const float *start[] = { NULL, s->out->region[a].theta, s->out->region[b].theta };
                const double allowed = known_to_differ(&s->out->region[a], &s->out->region[b]) ? worth_a_region : worth_a_doubtful_one;
                float theta[DISNEY_N], tried[DISNEY_N], one[WITNESSES], other[WITNESSES];
                double worse = INFINITY;
                call_both(&w[a], &w[b], &both);
                for (int k = 0; !err && k < 6 && !(worse <= 1); k++) { // a wrong valley is no reason for two materials
                    const uint16_t metal = k % 2 ? 1 << DISNEY_METALLIC : 0;
                    for (int p = 0; p < DISNEY_N; p++)
                        tried[p] = k / 2 ? start[k / 2][p] : .5f * (start[1][p] + start[2][p]);
                    err = fit_shared(s, &s->inner, &both, metal, false, tried);
                    if (!err)
                        err = test(s, &w[a], tried, 0, -1, &error2, NULL, one);
                    if (!err)
                        err = test(s, &w[b], tried, 0, -1, &error2, NULL, other);
                    if (err)
                        break;
                    const double worse_a = how_much_worse(one, alone[a], w[a].n), worse_b = how_much_worse(other, alone[b], w[b].n);
                    log_debug("regions: %d and %d of %d as one: views aside %.4f x, %.4f x; allowed %.1f", a, b, s->out->n, worse_a, worse_b, allowed);
                    if (fmax(worse_a, worse_b) / allowed < worse) {
                        worse = fmax(worse_a, worse_b) / allowed;
                        memcpy(theta, tried, sizeof(theta));
                    }
                }
                if (err)
                    break;
                if (worse < least) {
                    least = worse, best_a = a, best_b = b;
                    memcpy(best_theta, theta, sizeof(theta));
                }
            }
        if (err || !(least <= 1))
            break;
        log_debug("regions: %d and %d of %d become one", best_a, best_b, s->out->n);
        rename_region(s, best_b, best_a);
        memcpy(s->out->region[best_a].theta, best_theta, sizeof(best_theta));
        drop(s, best_b);
        err = fit_all(s, false);
        if (!err)
            err = deal_out(s);
        if (!err)
            err = dissolve_small(s);
    }
    return err;
}

// ---- what is free -------------------------------------------------------------------------------------------------------

// Does the region do without? What views set aside are better off without, or neither miss nor tell from plain by two standard deviations,
// stays plain. Metal first: a little of it passes for anything.
static int simplify(struct search *s, const struct witnesses *w, struct region *r, int at, uint16_t *frozen, double *error2,
                    struct region *full)
{
    static const uint16_t without[] = {
        1 << DISNEY_METALLIC, 1 << DISNEY_CLEARCOAT | 1 << DISNEY_CLEARCOAT_GLOSS, 1 << DISNEY_SUBSURFACE, 1 << DISNEY_SHEEN | 1 << DISNEY_SHEEN_TINT,
        1 << DISNEY_ANISOTROPIC, 1 << DISNEY_SPECULAR_TINT,
    };
    int err = test(s, w, r->theta, 0, -1, error2, NULL, NULL);
    for (size_t k = 0; !err && k < sizeof(without) / sizeof(*without); k++) {
        struct region simpler = *r;
        const int p = __builtin_ctz(without[k]); // the layer's amount; the other says how it looks
        double error;
        err = region_uncertainty(s, s->scene, w, *frozen, r);
        if (!k && !err) {
            *full = *r;
            err = region_uncertainty(s, s->scene, w, 0, full);
        }
        if (*frozen & without[k])
            continue;
        if (!err)
            err = fit_shared(s, &s->inner, w, *frozen | without[k], false, simpler.theta);
        if (!err)
            err = test(s, w, simpler.theta, 0, -1, &error, NULL, NULL);
        if (err)
            break;
        const bool plain_enough = !(r->theta[p] - plain[p] > 2 * unknown_misfit * r->std[p]);
        log_debug("regions: region %d without %s (%.3f +- %.3f): views aside %.4f -> %.4f %%", at, disney_parameter_names[p], (double)r->theta[p],
                  (double)r->std[p], 100 * sqrt(*error2), 100 * sqrt(error));
        if (error < (k ? better_without : worth_a_metal) * *error2 || (plain_enough && error < worth_a_layer * *error2 + rounding2)) {
            *frozen |= without[k];
            *error2 = error;
            memcpy(r->theta, simpler.theta, sizeof(r->theta));
        }
    }
    return err;
}

static int choose_freedom(struct search *s, struct region *r, int at)
{
    // By what a texel can tell, best first (SOLVER.md 4); the rest belongs to regions.
    static const int candidates[] = { DISNEY_ROUGHNESS, DISNEY_METALLIC, DISNEY_SPECULAR, DISNEY_SUBSURFACE };
    struct witnesses w;
    struct region full = { 0 };
    double error2 = 0, std;
    uint16_t free_mask = 0, frozen = s->frozen[at];
    call_witnesses(s, 1u << at, &w);
    struct shared_fit first = { .s = s, .scene = &s->inner, .w = &w, .frozen = frozen };
    double cost;
    int err = w.n ? fit_from(&first, r->theta, 100, 1e-8, r->theta, &cost) : 0; // to the end: clearcoat against sheen is a long valley
    if (!err)
        err = simplify(s, &w, r, at, &frozen, &error2, &full);
    for (int p = 0; p < DISNEY_N; p++)
        r->freedom[p] = frozen >> p & 1 ? PARAMETER_FROZEN : PARAMETER_TIED;
    for (size_t k = 0; !err && k < sizeof(candidates) / sizeof(*candidates); k++) {
        double with;
        const uint16_t tried = (uint16_t)(free_mask | 1 << candidates[k]);
        if (frozen >> candidates[k] & 1)
            continue;
        err = test(s, &w, r->theta, tried, candidates[k], &with, &std, NULL);
        log_debug("regions: region %d, %s free per texel: views aside %.4f -> %.4f %%, std %.3f", at, disney_parameter_names[candidates[k]],
                  100 * sqrt(error2), 100 * sqrt(with), std);
        if (!err && std < most_free_std && with + rounding2 < worth_a_parameter * error2) {
            free_mask = tried, error2 = with;
            r->freedom[candidates[k]] = PARAMETER_FREE;
        }
    }
    r->aside_rmse_percent = 100 * sqrt(error2);
    struct shared_fit last = { .s = s, .scene = s->scene, .w = &w, .frozen = frozen };
    if (!err && w.n)
        err = fit_from(&last, r->theta, 100, 1e-8, r->theta, &cost);
    if (!err)
        err = region_uncertainty(s, s->scene, &w, frozen, r);
    // What was frozen might have been otherwise: the doubt is that of the full model, and how far freezing moved the others.
    for (int p = 0; !err && p < DISNEY_N; p++)
        if (isfinite(r->std[p]))
            r->std[p] = unknown_misfit * hypotf(fmaxf(r->std[p], full.std[p]), r->theta[p] - full.theta[p]);
    for (int p = 0; p < THETA_PACKED; p++)
        r->covariance[p] = (double)(unknown_misfit * unknown_misfit) * full.covariance[p];
    return err;
}

// ---- the whole ----------------------------------------------------------------------------------------------------------

static void search_free(struct search *s)
{
    for (int i = 0; s->worker && i < s->n_workers; i++)
        texel_worker_free(s->worker[i]);
    free(s->worker);
    free((void *)s->inner.use_view);
    free((void *)s->aside.use_view);
    free(s->texel);
    free(s->cost);
    free(s->evidence);
    free(s->n_samples);
    free(s->colour);
}

static int search_new(struct search *s, const struct texel_scene *scene, const struct level *level)
{
    const int n_views = scene->samples->n_views;
    uint8_t *inner = calloc((size_t)n_views + 1, 1), *aside = calloc((size_t)n_views + 1, 1);
    s->scene = scene, s->level = level;
    s->inner = s->aside = *scene;
    s->inner.use_view = inner, s->aside.use_view = aside;
    s->texel = malloc(((size_t)level->n + 1) * sizeof(*s->texel));
    s->cost = malloc(((size_t)level->n + 1) * REGIONS_MAX * sizeof(float));
    s->evidence = malloc(((size_t)level->n + 1) * REGIONS_MAX * sizeof(float));
    s->n_samples = calloc((size_t)level->n + 1, sizeof(*s->n_samples));
    s->colour = malloc(((size_t)level->n + 1) * sizeof(*s->colour));
    s->n_workers = s->n_threads > 0 ? s->n_threads : parallel_n_cores();
    s->worker = calloc((size_t)s->n_workers, sizeof(*s->worker));
    if (!inner || !aside || !s->texel || !s->cost || !s->evidence || !s->n_samples || !s->colour || !s->worker)
        return -ENOMEM;
    for (int i = 0; i < s->n_workers; i++)
        if (texel_worker_new(&s->worker[i], scene))
            return -ENOMEM;
    for (int v = 0, k = 0; v < n_views; v++)
        if (!scene->use_view || scene->use_view[v]) {
            aside[v] = k++ % 3 == 1;
            inner[v] = !aside[v];
        }
    for (int i = 0; i < level->n; i++) {
        s->texel[i] = !level->first_delegate ? i : level->first_delegate[i] < level->first_delegate[i + 1] ? level->delegate[level->first_delegate[i]] : -1;
        if (s->texel[i] >= 0 && scene->samples->first[s->texel[i]] == scene->samples->first[s->texel[i] + 1])
            s->texel[i] = -1;
    }
    parallel_for(s->n_threads, level->n, 16, colour_nodes, s);
    return labelling_bandwidth(s->bandwidth, level, (const float(*)[3])s->colour);
}

int regions_find(struct regions *out, uint8_t *region_of, const struct texel_scene *scene, const struct level *level,
                 const float (*theta)[DISNEY_N], float (*albedo)[3], int n_threads)
{
    struct search s = { .albedo = albedo, .n_threads = n_threads, .region = region_of, .out = out, .hold = first_hold };
    memset(out, 0, sizeof(*out));
    int err = search_new(&s, scene, level);
    if (!err)
        err = cut(&s, theta);
    if (!err)
        err = fit_all(&s, true);
    for (int round = 0; !err && round < DEAL_ROUNDS; round++) {
        err = deal_out(&s);
        if (!err)
            err = dissolve_small(&s);
        if (!err)
            err = fit_all(&s, true);
    }
    if (!err)
        err = merge(&s);
    for (int r = 0; !err && r < out->n; r++)
        err = choose_freedom(&s, &out->region[r], r);
    if (!err)
        count(&s);
    search_free(&s);
    return err;
}

// ---- finer levels -------------------------------------------------------------------------------------------------------

struct refinement {
    const struct regions *r;
    const struct texel_scene *scene;
    const struct level *level;
    const float (*albedo)[3];
    uint8_t *region;
    uint8_t *candidates; // [level n] a bit per region; 0: no doubt
    float *evidence;     // [level n][REGIONS_MAX]
    float (*colour)[3];
    struct texel_worker **worker;
};

static void weigh_doubtful(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct refinement *f = arg;
    const struct level *l = f->level;
    for (int i = (int)begin; i < (int)end; i++) {
        float cost[REGIONS_MAX];
        const int32_t first = l->first_delegate ? l->first_delegate[i] : 0, n = l->first_delegate ? l->first_delegate[i + 1] - first : 1;
        int n_samples = 0;
        bool asked = f->candidates[i] && n > 0; // for its colour: by itself or beside one in doubt
        for (int32_t m = l->first_neighbour[i]; n > 0 && m < l->first_neighbour[i + 1]; m++)
            asked = asked || f->candidates[l->neighbour[m]];
        if (!asked || !colour_of(f->scene, f->worker[worker], l->first_delegate ? l->delegate[first] : i, f->colour[i]))
            f->colour[i][0] = NAN;
        for (int r = 0; r < f->r->n; r++) {
            struct texel_sums sums = { 0 };
            cost[r] = f->candidates[i] ? f->candidates[i] >> r & 1 ? 0 : INFINITY : f->region[i] == r ? 0 : INFINITY;
            for (int32_t d = 0; d < n && (f->candidates[i] >> r & 1); d++) {
                const int32_t t = l->first_delegate ? l->delegate[first + d] : i;
                float albedo[3];
                memcpy(albedo, f->albedo[t], sizeof(albedo));
                texel_fit_albedo(f->scene, f->worker[worker], t, 0, f->r->region[r].theta, albedo, 1, &sums);
            }
            if (f->candidates[i] >> r & 1)
                cost[r] = (float)(sums.left_out_cost / fmax(sums.n, 1)), n_samples = sums.n;
        }
        weigh_evidence(cost, f->r->n, n_samples, f->evidence + (size_t)i * REGIONS_MAX);
    }
}

int regions_refine(const struct regions *r, uint8_t *region_of, const uint8_t *parent_region_of, const struct texel_scene *scene,
                   const struct level *level, const float (*albedo)[3], int n_threads)
{
    const size_t n = (size_t)level->n + 1;
    const int n_workers = n_threads > 0 ? n_threads : parallel_n_cores();
    struct refinement f = { .r = r, .scene = scene, .level = level, .albedo = albedo, .region = region_of,
                            .candidates = calloc(n, 1), .evidence = malloc(n * REGIONS_MAX * sizeof(float)),
                            .colour = malloc(n * sizeof(*f.colour)),
                            .worker = calloc((size_t)n_workers, sizeof(*f.worker)) };
    int err = f.candidates && f.evidence && f.colour && f.worker ? 0 : -ENOMEM;
    for (int i = 0; !err && i < n_workers; i++)
        err = texel_worker_new(&f.worker[i], scene);
    for (int i = 0; i < level->n; i++)
        region_of[i] = parent_region_of[level->parent[i]];
    // two texels wide: a border may lie a parent's width off
    for (int i = 0; !err && i < level->n; i++) {
        unsigned around = 1u << region_of[i];
        for (int32_t m = level->first_neighbour[i]; m < level->first_neighbour[i + 1]; m++) {
            const int j = level->neighbour[m];
            around |= 1u << region_of[j];
            for (int32_t o = level->first_neighbour[j]; o < level->first_neighbour[j + 1]; o++)
                around |= 1u << region_of[level->neighbour[o]];
        }
        f.candidates[i] = (uint8_t)(around & (around - 1) ? around : 0);
    }
    if (!err) {
        float bandwidth[3];
        parallel_for(n_threads, level->n, 64, weigh_doubtful, &f);
        err = labelling_bandwidth(bandwidth, level, (const float(*)[3])f.colour);
        const struct labelling job = { .level = level, .n_labels = r->n, .stride = REGIONS_MAX, .evidence = f.evidence,
                                       .colour = (const float(*)[3])f.colour, .bandwidth = bandwidth };
        if (!err)
            err = labelling_find(region_of, &job);
    }
    for (int i = 0; f.worker && i < n_workers; i++)
        texel_worker_free(f.worker[i]);
    free(f.worker);
    free(f.candidates);
    free(f.evidence);
    free(f.colour);
    return err;
}
