// solver/materials.c - stage 2: Levenberg-Marquardt over a pyramid of textures, tile by tile.
#include "solver/materials.h"

#include "solver/interreflection.h"
#include "solver/packed.h"
#include "solver/parallel.h"
#include "solver/pcg.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

enum {
    TILE_TEXELS = 1 << 17, // 260 bytes of normal equations and as much of factors each
    DELEGATE_VIEWS = 32,   // a delegate shows at most so many of its views
    DELEGATES_MAX = 256,
    SELECT_SIZE = 64,      // regions are found on the finest level no larger
    EVALUATE_CHUNK = 32, ROW_CHUNK = 2048,
    WEAK_SAMPLES = 8,
    ALL_TIED = (1 << DISNEY_N) - 1,
    BOUNCE_RAYS = 256, BOUNCE_SIZE = 256, // rays per place where indirect light is gathered; textures finer than this interpolate it
    BOUNCE_LOOKS = 3,      // how often the albedo is found and light sent out again
};
static const double first_mu = 1e-3, least_mu = 1e-7, most_mu = 1e9;
static const float settled = 5e-4f; // a smaller step is not worth looking at the samples again
static const double light_settled = 3e-4; // of white: what half floats and look-ups leave in any comparison

struct materials_settings materials_defaults(void)
{
    return (struct materials_settings){ .free_albedo = true, .w_reg = .02, .w_parent = .02, .seams = true, .weigh_grazing = true,
                                        .robust = true, .selection = true, .cap = 128 };
}

struct materials_settings materials_paper(void)
{
    return (struct materials_settings){ .w_reg = 1, .seams = true, .whole_weight = true, .cap = 128 };
}

struct estimate {
    const struct materials_settings *set;
    struct texel_scene scene;
    struct levels levels;
    struct texel_worker **worker;
    int n_workers;
    int32_t *n_samples;   // [texels n] that may be fitted
    float (*albedo)[3];   // [texels n]
    const struct regions *regions; // NULL: every parameter is free
    double mean_distance; // |L - o| over the last level
};

// A run of a level's texels, solved together; what lies outside stands still.
struct tile {
    struct estimate *e;
    const struct level *level;
    int begin, n;
    bool finest;
    float (*theta)[DISNEY_N];              // [level n]
    const float (*parent_theta)[DISNEY_N]; // of the coarser level; NULL: none
    const uint8_t *region;                 // [level n] or NULL
    const double *scale;                   // [level n] or NULL: 1
    double kappa, w_parent;
    float (*H)[THETA_PACKED], (*g)[DISNEY_N]; // [n]
    double *cost;                             // [n] of the samples
    float *mu;
    uint16_t *frozen;                         // [n] a bit per parameter that does not move in this step
    float (*M)[THETA_PACKED];                 // factors of H + damping + neighbours + parent
    float *b, *x;                             // [n][DISNEY_N]
    float (*trial)[DISNEY_N];                 // [n]
    uint8_t *tried;
    bool first;                               // evaluate at theta itself
};

static bool coupled(const struct tile *t, int i, int j)
{
    return !t->region || t->region[i] == t->region[j];
}

static uint16_t tied_of(const struct tile *t, int i)
{
    uint16_t mask = 0;
    for (int p = 0; t->region && p < DISNEY_N; p++)
        if (t->e->regions->region[t->region[i]].freedom[p] != PARAMETER_FREE)
            mask |= (uint16_t)(1 << p);
    return mask;
}

static const float *now_of(const struct tile *t, int j, bool trial)
{
    return trial && j >= t->begin && j < t->begin + t->n ? t->trial[j - t->begin] : t->theta[j];
}

// A texel's share of the regularisation: half of each of its edges, and its parent.
static double regularisation(const struct tile *t, int i, bool trial)
{
    const struct level *l = t->level;
    const float *here = now_of(t, i, trial);
    double sum = 0;
    for (int32_t m = l->first_neighbour[i]; m < l->first_neighbour[i + 1]; m++) {
        if (!coupled(t, i, l->neighbour[m]))
            continue;
        const float *other = now_of(t, l->neighbour[m], trial);
        for (int p = 0; p < DISNEY_N; p++)
            sum += .25 * t->kappa * (double)(here[p] - other[p]) * (double)(here[p] - other[p]);
    }
    for (int p = 0; t->parent_theta && p < DISNEY_N; p++) {
        const double d = (double)(here[p] - t->parent_theta[l->parent[i]][p]);
        sum += .5 * t->w_parent * d * d;
    }
    return sum;
}

// partial: objective, distance, samples, views shaded, gained.
static void evaluate(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    struct tile *t = arg;
    struct estimate *e = t->e;
    const struct level *l = t->level;
    for (int k = (int)begin; k < (int)end; k++) {
        const int i = t->begin + k;
        float albedo[DELEGATES_MAX][3];
        struct texel_sums sums = { 0 };
        if (!t->first && !t->tried[k]) {
            partial[0] += t->cost[k] + regularisation(t, i, false);
            continue;
        }
        const float *theta = t->first ? t->theta[i] : t->trial[k];
        const int32_t self = i;
        const int32_t *delegate = l->first_delegate ? l->delegate + l->first_delegate[i] : &self;
        int n_delegates = l->first_delegate ? l->first_delegate[i + 1] - l->first_delegate[i] : 1;
        if (n_delegates > DELEGATES_MAX)
            n_delegates = DELEGATES_MAX;
        const bool moves = tied_of(t, i) != ALL_TIED;
        for (int d = 0; d < n_delegates; d++) {
            memcpy(albedo[d], e->albedo[delegate[d]], sizeof(albedo[d]));
            (moves ? texel_fit : texel_fit_albedo)(&e->scene, e->worker[worker], delegate[d], l->first_delegate ? DELEGATE_VIEWS : 0, theta, albedo[d],
                      t->scale ? t->scale[i] : 1, &sums);
        }
        partial[1] += sums.distance, partial[2] += sums.n, partial[3] += sums.n;
        double before = 0, after = sums.cost;
        if (!t->first) {
            before = t->cost[k] + regularisation(t, i, false);
            after += regularisation(t, i, true);
        }
        if (t->first || after < before) {
            for (int d = 0; d < n_delegates; d++)
                memcpy(e->albedo[delegate[d]], albedo[d], sizeof(albedo[d]));
            for (int p = 0; p < THETA_PACKED; p++)
                t->H[k][p] = (float)sums.H[p];
            for (int p = 0; p < DISNEY_N; p++)
                t->g[k][p] = (float)sums.g[p];
            t->cost[k] = sums.cost;
        } else {
            t->tried[k] = 2; // refused
        }
        partial[0] += t->first ? after + regularisation(t, i, false) : fmin(after, before);
        partial[4] += t->first ? 0 : fmax(before - after, 0);
    }
}

// Right-hand side and factors, for this damping.
static void assemble(void *arg, int64_t begin, int64_t end, int worker)
{
    struct tile *t = arg;
    const struct level *l = t->level;
    (void)worker;
    for (int k = (int)begin; k < (int)end; k++) {
        const int i = t->begin + k;
        double g[DISNEY_N], M[THETA_PACKED], most = 0;
        int n_edges = 0;
        for (int p = 0; p < DISNEY_N; p++)
            g[p] = (double)t->g[k][p];
        for (int32_t m = l->first_neighbour[i]; m < l->first_neighbour[i + 1]; m++) {
            if (!coupled(t, i, l->neighbour[m]))
                continue;
            n_edges++;
            for (int p = 0; p < DISNEY_N; p++)
                g[p] += t->kappa * (double)(t->theta[i][p] - t->theta[l->neighbour[m]][p]);
        }
        const double w_parent = t->parent_theta ? t->w_parent : 0;
        for (int p = 0; w_parent > 0 && p < DISNEY_N; p++)
            g[p] += w_parent * (double)(t->theta[i][p] - t->parent_theta[l->parent[i]][p]);
        for (int p = 0; p < THETA_PACKED; p++)
            M[p] = (double)t->H[k][p];
        for (int p = 0; p < DISNEY_N; p++)
            most = fmax(most, M[packed_at(p, p)]);
        t->frozen[k] = tied_of(t, i);
        for (int p = 0; p < DISNEY_N; p++) {
            const float theta = t->theta[i][p];
            if ((theta <= 0 && g[p] > 0) || (theta >= 1 && g[p] < 0))
                t->frozen[k] |= (uint16_t)(1 << p);
        }
        for (int p = 0; p < DISNEY_N; p++) {
            const int at = packed_at(p, p);
            M[at] += (double)t->mu[k] * (M[at] + 1e-3 * most) + t->kappa * n_edges + w_parent + 1e-9 + 1e-7 * most;
            if (!(t->frozen[k] >> p & 1))
                continue;
            for (int q = 0; q < DISNEY_N; q++)
                M[packed_at(p, q)] = 0;
            M[at] = 1;
            g[p] = 0;
        }
        if (!packed_factor(DISNEY_N, M)) { // rounding: stand still, and damp more
            memset(g, 0, sizeof(g));
            memset(M, 0, sizeof(M));
            for (int p = 0; p < DISNEY_N; p++)
                M[packed_at(p, p)] = 1;
            t->frozen[k] = ALL_TIED;
            t->mu[k] *= 10;
        }
        for (int p = 0; p < THETA_PACKED; p++)
            t->M[k][p] = (float)M[p];
        for (int p = 0; p < DISNEY_N; p++)
            t->b[k * DISNEY_N + p] = (float)-g[p];
    }
}

struct product {
    struct tile *t;
    const float *in;
    float *out;
};

static void load_factor(double L[THETA_PACKED], const float *from)
{
    for (int p = 0; p < THETA_PACKED; p++)
        L[p] = (double)from[p];
}

static void multiply(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct product *a = arg;
    const struct tile *t = a->t;
    const struct level *l = t->level;
    (void)worker;
    for (int k = (int)begin; k < (int)end; k++) {
        const int i = t->begin + k;
        const float *x = a->in + (size_t)k * DISNEY_N;
        double L[THETA_PACKED], u[DISNEY_N], y[DISNEY_N];
        load_factor(L, t->M[k]);
        for (int p = 0; p < DISNEY_N; p++) { // u = L^T x; the diagonal holds its inverse
            u[p] = (double)x[p] / L[packed_at(p, p)];
            for (int q = p + 1; q < DISNEY_N; q++)
                u[p] += L[packed_at(q, p)] * (double)x[q];
        }
        for (int p = 0; p < DISNEY_N; p++) {
            y[p] = u[p] / L[packed_at(p, p)];
            for (int q = 0; q < p; q++)
                y[p] += L[packed_at(p, q)] * u[q];
        }
        for (int32_t m = l->first_neighbour[i]; m < l->first_neighbour[i + 1]; m++) {
            const int j = l->neighbour[m] - t->begin;
            if (j < 0 || j >= t->n || !coupled(t, i, l->neighbour[m]))
                continue;
            for (int p = 0; p < DISNEY_N; p++)
                if (!(t->frozen[k] >> p & 1))
                    y[p] -= t->kappa * (double)a->in[(size_t)j * DISNEY_N + (size_t)p];
        }
        for (int p = 0; p < DISNEY_N; p++)
            a->out[(size_t)k * DISNEY_N + (size_t)p] = (float)y[p];
    }
}

static void apply(void *arg, const float *x, float *y)
{
    struct product a = { arg, x, y };
    parallel_for(a.t->e->set->n_threads, a.t->n, ROW_CHUNK, multiply, &a);
}

static void divide(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct product *a = arg;
    (void)worker;
    for (int64_t k = begin; k < end; k++) {
        double L[THETA_PACKED], x[DISNEY_N];
        load_factor(L, a->t->M[k]);
        for (int p = 0; p < DISNEY_N; p++)
            x[p] = (double)a->in[k * DISNEY_N + p];
        packed_solve(DISNEY_N, L, x);
        for (int p = 0; p < DISNEY_N; p++)
            a->out[k * DISNEY_N + p] = (float)x[p];
    }
}

static void precondition(void *arg, const float *r, float *z)
{
    struct product a = { arg, r, z };
    parallel_for(a.t->e->set->n_threads, a.t->n, ROW_CHUNK, divide, &a);
}

static void tile_free(struct tile *t)
{
    free(t->H);
    free(t->g);
    free(t->cost);
    free(t->mu);
    free(t->frozen);
    free(t->M);
    free(t->b);
    free(t->x);
    free(t->trial);
    free(t->tried);
}

static int tile_new(struct tile *t)
{
    const size_t n = (size_t)t->n + 1;
    t->H = malloc(n * sizeof(*t->H)), t->g = malloc(n * sizeof(*t->g));
    t->cost = malloc(n * sizeof(*t->cost)), t->mu = malloc(n * sizeof(*t->mu));
    t->frozen = malloc(n * sizeof(*t->frozen)), t->M = malloc(n * sizeof(*t->M));
    t->b = malloc(n * DISNEY_N * sizeof(float)), t->x = malloc(n * DISNEY_N * sizeof(float));
    t->trial = malloc(n * sizeof(*t->trial)), t->tried = malloc(n);
    if (!t->H || !t->g || !t->cost || !t->mu || !t->frozen || !t->M || !t->b || !t->x || !t->trial || !t->tried) {
        tile_free(t);
        return -ENOMEM;
    }
    for (int k = 0; k < t->n; k++)
        t->mu[k] = (float)first_mu;
    return 0;
}

// Steps into trial; whether anything moves.
static bool step(struct tile *t)
{
    bool any = false;
    for (int k = 0; k < t->n; k++) {
        float longest = 0;
        for (int p = 0; p < DISNEY_N; p++) {
            const float from = t->theta[t->begin + k][p];
            t->trial[k][p] = fminf(fmaxf(from + t->x[k * DISNEY_N + p], 0), 1);
            longest = fmaxf(longest, fabsf(t->trial[k][p] - from));
        }
        t->tried[k] = longest > settled;
        if (!t->tried[k])
            memcpy(t->trial[k], t->theta[t->begin + k], sizeof(t->trial[k]));
        any = any || t->tried[k];
    }
    return any;
}

static int solve_tile(struct tile *t, int most_iterations, struct materials_level *level)
{
    double sums[5] = { 0 };
    const int n_threads = t->e->set->n_threads;
    int err = tile_new(t);
    if (err)
        return err;
    t->first = true;
    err = parallel_sum(n_threads, t->n, EVALUATE_CHUNK, evaluate, t, 5, sums);
    t->first = false;
    level->n_shaded += (int64_t)sums[3];
    for (int iteration = 0; !err && iteration < most_iterations; iteration++) {
        struct pcg_result solved;
        const struct pcg_problem problem = { (int64_t)t->n * DISNEY_N, apply, precondition, t };
        parallel_for(n_threads, t->n, ROW_CHUNK, assemble, t);
        memset(t->x, 0, (size_t)t->n * DISNEY_N * sizeof(float));
        err = pcg_solve(&problem, t->b, t->x, .03, 40, n_threads, &solved);
        if (err == -EDOM) // x holds the last good iterate
            err = 0;
        level->n_pcg += solved.iterations;
        if (err || !step(t))
            break;
        memset(sums, 0, sizeof(sums));
        err = parallel_sum(n_threads, t->n, EVALUATE_CHUNK, evaluate, t, 5, sums);
        if (err)
            break;
        for (int k = 0; k < t->n; k++) {
            if (t->tried[k] == 2) {
                t->mu[k] = (float)fmin((double)t->mu[k] * 8, most_mu);
            } else if (t->tried[k]) {
                memcpy(t->theta[t->begin + k], t->trial[k], sizeof(t->trial[k]));
                t->mu[k] = (float)fmax((double)t->mu[k] / 5, least_mu);
            }
        }
        level->n_shaded += (int64_t)sums[3];
        if (iteration + 1 > level->n_iterations)
            level->n_iterations = iteration + 1;
        if (sums[4] < (t->finest ? 1e-3 : 5e-3) * sums[0])
            break;
    }
    if (!err) {
        for (int k = 0; k < t->n; k++)
            level->objective += t->cost[k];
        if (sums[2] > 0)
            t->e->mean_distance = sums[1] / sums[2];
    }
    tile_free(t);
    return err;
}

static bool any_free(const struct regions *r)
{
    for (int k = 0; r && k < r->n; k++)
        for (int p = 0; p < DISNEY_N; p++)
            if (r->region[k].freedom[p] == PARAMETER_FREE)
                return true;
    return !r || !r->n;
}

// theta[level n] in and out. scale[level n] or NULL.
static int solve_level(struct estimate *e, int k, float (*theta)[DISNEY_N], const float (*parent_theta)[DISNEY_N],
                       const uint8_t *region, const double *scale, struct materials_level *report)
{
    const struct level *l = &e->levels.level[k];
    const bool finest = k == e->levels.n - 1;
    int err = 0;
    *report = (struct materials_level){ .size = l->size, .n_texels = l->n };
    e->scene.robust_scale = e->set->robust && k >= 3 ? 2.5 * e->mean_distance : 0;
    for (int i = 0; region && i < l->n; i++)
        for (int p = 0; p < DISNEY_N; p++)
            if (e->regions->region[region[i]].freedom[p] != PARAMETER_FREE)
                theta[i][p] = e->regions->region[region[i]].theta[p];
    if (!finest && !any_free(region ? e->regions : NULL))
        return 0; // what is left to find is the albedo, and that is the finest texels'
    for (int begin = 0; !err && begin < l->n; begin += TILE_TEXELS) {
        struct tile t = { .e = e, .level = l, .begin = begin, .n = l->n - begin < TILE_TEXELS ? l->n - begin : TILE_TEXELS, .finest = finest,
                          .theta = theta, .parent_theta = parent_theta, .region = region, .scale = scale,
                          .kappa = 2 * e->set->w_reg, .w_parent = e->set->w_parent };
        err = solve_tile(&t, l->size <= 8 ? 40 : !finest ? 6 : l->size > 256 ? 4 : 12, report);
    }
    report->objective /= fmax((double)report->n_shaded, 1);
    return err;
}

// ---- from coarse to fine ------------------------------------------------------------------------------------------------

static void estimate_free(struct estimate *e)
{
    for (int i = 0; e->worker && i < e->n_workers; i++)
        texel_worker_free(e->worker[i]);
    free(e->worker);
    free(e->n_samples);
    free((void *)e->scene.use_view);
    free((void *)e->scene.gain);
    free((void *)e->scene.indirect);
    light_arrays_free(&e->scene.lights);
    levels_free(&e->levels);
}

static int estimate_new(struct estimate *e, const struct materials_input *in, const struct materials_settings *set)
{
    const struct samples *s = in->samples;
    memset(e, 0, sizeof(*e));
    e->set = set;
    e->scene.texels = in->texels, e->scene.samples = s, e->scene.kernels = kernels_select(KERNELS_ALL);
    e->scene.variant = set->variant;
    e->scene.visible = in->visible, e->scene.words_per_texel = in->words_per_texel;
    e->scene.soft = in->soft;
    e->scene.free_albedo = set->free_albedo, e->scene.weigh_grazing = set->weigh_grazing;
    uint8_t *use = calloc((size_t)s->n_views + 1, 1);
    e->scene.use_view = use;
    e->n_samples = calloc((size_t)in->texels->n + 1, sizeof(*e->n_samples));
    e->n_workers = set->n_threads > 0 ? set->n_threads : parallel_n_cores();
    if (!use || !e->n_samples || light_arrays_new(&e->scene.lights, in->lights))
        return -ENOMEM;
    for (int v = 0; v < s->n_views; v++)
        use[v] = !(in->hold_out && in->hold_out[v]);
    if (in->log_gain) {
        float *gain = malloc(((size_t)s->n_views + 1) * sizeof(float));
        e->scene.gain = gain;
        for (int v = 0; gain && v < s->n_views; v++)
            gain[v] = (float)exp(in->log_gain[v]);
        if (!gain)
            return -ENOMEM;
    }
    int64_t n = 0;
    for (int t = 0; t < in->texels->n; t++) {
        for (int64_t i = s->first[t]; i < s->first[t + 1]; i++)
            e->n_samples[t] += use[s->view[i]];
        n += e->n_samples[t];
    }
    if (!n) {
        log_error("materials: no view sees the mesh: are mesh and cameras in one frame?");
        return -EINVAL;
    }
    e->worker = calloc((size_t)e->n_workers, sizeof(*e->worker));
    for (int i = 0; i < e->n_workers; i++)
        if (!e->worker || texel_worker_new(&e->worker[i], &e->scene))
            return -ENOMEM;
    const struct levels_settings levels = { .seams = set->seams, .cap = set->cap, .most_views = DELEGATE_VIEWS };
    return levels_new(&e->levels, in->texels, e->n_samples, &levels);
}

static int spread(float (**theta)[DISNEY_N], const struct level *l, const float (*parent)[DISNEY_N], const double start[DISNEY_N])
{
    *theta = malloc(((size_t)l->n + 1) * sizeof(**theta));
    for (int i = 0; *theta && i < l->n; i++)
        for (int p = 0; p < DISNEY_N; p++)
            (*theta)[i][p] = parent ? parent[l->parent[i]][p] : (float)start[p];
    return *theta ? 0 : -ENOMEM;
}

// Weight of a coarse texel that looks at a few samples and stands for all beneath it.
static int whole_weights(const struct estimate *e, int k, double **scale)
{
    const struct level *l = &e->levels.level[k];
    *scale = NULL;
    if (!l->first_delegate || !e->set->whole_weight)
        return 0;
    double *seen = calloc((size_t)l->n + 1, sizeof(double));
    *scale = calloc((size_t)l->n + 1, sizeof(double));
    int err = seen && *scale ? 0 : -ENOMEM;
    for (int t = 0; !err && t < e->scene.texels->n; t++) {
        int i = t;
        for (int m = e->levels.n - 1; m > k; m--)
            i = e->levels.level[m].parent[i];
        (*scale)[i] += e->n_samples[t];
    }
    for (int i = 0; !err && i < l->n; i++) {
        for (int32_t m = l->first_delegate[i]; m < l->first_delegate[i + 1]; m++)
            seen[i] += e->n_samples[l->delegate[m]] < DELEGATE_VIEWS ? e->n_samples[l->delegate[m]] : DELEGATE_VIEWS;
        (*scale)[i] = seen[i] > 0 ? (*scale)[i] / seen[i] : 1;
    }
    free(seen);
    return err;
}

// ---- what the samples did not say ---------------------------------------------------------------------------------------

// Texels without samples or light get the mean albedo of neighbours that have one, ring by ring; what nobody reaches, the mean of all.
static int fill_unobserved(const struct estimate *e, struct materials *m)
{
    const struct level *l = &e->levels.level[e->levels.n - 1];
    double mean[3] = { 0 };
    int n_known = 0;
    uint8_t *known = malloc((size_t)m->n_texels + 1);
    int32_t *ring = malloc(((size_t)m->n_texels + 1) * sizeof(*ring));
    int err = known && ring ? 0 : -ENOMEM;
    for (int t = 0; !err && t < m->n_texels; t++) {
        known[t] = m->validity[t] != MATERIAL_UNOBSERVED;
        for (int c = 0; known[t] && c < 3; c++)
            mean[c] += (double)m->albedo[t][c];
        n_known += known[t];
    }
    for (bool more = !err && n_known; more;) {
        int n = 0;
        more = false;
        for (int t = 0; t < m->n_texels; t++) {
            int n_around = 0;
            float sum[3] = { 0 };
            for (int32_t k = l->first_neighbour[t]; !known[t] && k < l->first_neighbour[t + 1]; k++) {
                if (known[l->neighbour[k]] != 1)
                    continue;
                for (int c = 0; c < 3; c++)
                    sum[c] += m->albedo[l->neighbour[k]][c];
                n_around++;
            }
            for (int c = 0; n_around && c < 3; c++)
                m->albedo[t][c] = sum[c] / (float)n_around;
            if (n_around)
                ring[n++] = t, more = true;
        }
        for (int k = 0; k < n; k++)
            known[ring[k]] = 1;
    }
    for (int t = 0; !err && t < m->n_texels; t++)
        for (int c = 0; !known[t] && c < 3; c++)
            m->albedo[t][c] = n_known ? (float)(mean[c] / n_known) : .5f;
    free(known);
    free(ring);
    return err;
}

// ---- the answer ---------------------------------------------------------------------------------------------------------

struct judging {
    struct estimate *e;
    struct materials *m;
    const struct materials_input *in;
    const float *inverse_distance_std; // [lights n] or NULL: known
    double error2; // squared residual of a channel, mean over all: where a texel knows too little of its own
};

// Standard deviations and validity. partial: squares, n (fitted), squares, n (held out)
static void measure_texels(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    struct judging *j = arg;
    struct estimate *e = j->e;
    struct texel_scene held = e->scene;
    held.use_view = NULL;
    for (int t = (int)begin; t < (int)end; t++) {
        struct texel_error all = { 0 }, fit = { 0 };
        texel_measure(&e->scene, e->worker[worker], t, j->m->theta[t], j->m->albedo[t], &fit);
        texel_measure(&held, e->worker[worker], t, j->m->theta[t], j->m->albedo[t], &all);
        partial[0] += fit.squares, partial[1] += (double)fit.n;
        partial[2] += all.squares - fit.squares, partial[3] += (double)(all.n - fit.n);
    }
}

// What is not known of the lights, as a standard deviation of the log of a texel's light. Irradiance of light i goes as <n,w> <w,d> / |w|^4,
// w = d + (c - p) / r its direction from p. Distances err together (E_sim leaves smooth errors), the centre along three axes.
static double light_doubt(const struct judging *j, int texel)
{
    const struct texel_scene *s = &j->e->scene;
    const struct light_arrays *l = &s->lights;
    const float *p = s->texels->position_m[texel], *n = s->texels->normal[texel];
    const uint16_t *visible = s->visible ? s->visible + (size_t)texel * (size_t)s->words_per_texel : NULL;
    double E = 0, of_distances = 0, of_centre[3] = { 0 }, variance = 0;
    if (!j->inverse_distance_std)
        return 0;
    for (int i = 0; i < l->n; i++) {
        const float d[3] = { l->dx[i], l->dy[i], l->dz[i] };
        float w[3], w2 = 0, wd = 0, nw = 0;
        for (int c = 0; c < 3; c++) {
            w[c] = d[c] + (l->centre_m[c] - p[c]) * l->q[i];
            w2 += w[c] * w[c], wd += w[c] * d[c], nw += n[c] * w[c];
        }
        if (nw <= 0 || wd <= 0 || (visible && !(visible[i / 16] >> i % 16 & 1)))
            continue;
        const float here = (l->cr[i] + l->cg[i] + l->cb[i]) * nw * wd / (w2 * w2);
        float along = 0;
        for (int c = 0; c < 3; c++) {
            const float slope = n[c] / nw + d[c] / wd - 4 * w[c] / w2; // d log E_i / d w_c
            along += slope * (l->centre_m[c] - p[c]);
            of_centre[c] += (double)(here * slope * l->q[i]);
        }
        E += (double)here;
        of_distances += (double)(here * fabsf(along) * j->inverse_distance_std[i]);
    }
    for (int c = 0; c < 3; c++)
        if (of_centre[c] != 0) // lights at infinity leave the centre open, and nothing depends on it
            variance += of_centre[c] * of_centre[c] * j->in->centre_std_m[c] * j->in->centre_std_m[c];
    return E > 0 ? sqrt(variance + of_distances * of_distances) / E : 0;
}

static void doubt_texels(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    struct judging *j = arg;
    struct estimate *e = j->e;
    struct materials *m = j->m;
    const double prior = e->set->w_parent + 8 * e->set->w_reg;
    (void)partial;
    for (int t = (int)begin; t < (int)end; t++) {
        const struct texel_row *rows;
        const int n_rows = texel_rows(&e->scene, e->worker[worker], t, m->theta[t], m->albedo[t], &rows), n = DISNEY_N + 3;
        double A[PACKED_MOST * (PACKED_MOST + 1) / 2] = { 0 }, squares = 0, own2 = 0;
        const struct region *r = m->regions.n ? &m->regions.region[m->region[t]] : NULL;
        for (int k = 0; k < n_rows; k++) {
            squares += (double)rows[k].residual * (double)rows[k].residual;
            for (int a = 0; a < n; a++)
                for (int b = 0; b <= a; b++)
                    A[packed_at(a, b)] += (double)rows[k].J[a] * (double)rows[k].J[b];
        }
        for (int c = DISNEY_N; c < n; c++)
            own2 += A[packed_at(c, c)];
        m->coverage[t] = (uint16_t)(e->n_samples[t] < UINT16_MAX ? e->n_samples[t] : UINT16_MAX);
        m->validity[t] = !(own2 > 1e-6) ? MATERIAL_UNOBSERVED : n_rows < 3 * WEAK_SAMPLES ? MATERIAL_WEAK : MATERIAL_VALID;
        const double shared = 24; // so many rows' worth of the scene's own residual
        const double error2 = (squares + shared * j->error2) / fmax(n_rows + shared - n, 12);
        // what the region's theta leaves open of the albedo: d albedo = -own^-1 mixed d theta
        double own[6] = { 0 }, mixed[DISNEY_N][3], of_region[3] = { 0 };
        for (int a = 0; r && a < 3; a++) {
            for (int b = 0; b <= a; b++)
                own[packed_at(a, b)] = A[packed_at(DISNEY_N + a, DISNEY_N + b)] + (a == b ? 1e-12 : 0);
            for (int p = 0; p < DISNEY_N; p++)
                mixed[p][a] = r->freedom[p] != PARAMETER_FREE ? A[packed_at(DISNEY_N + a, p)] : 0;
        }
        if (r && packed_factor(3, own)) {
            for (int p = 0; p < DISNEY_N; p++)
                packed_solve(3, own, mixed[p]);
            for (int a = 0; a < 3; a++)
                for (int p = 0; p < DISNEY_N; p++)
                    for (int q = 0; q < DISNEY_N; q++)
                        of_region[a] += mixed[p][a] * r->covariance[packed_at(p, q)] * mixed[q][a];
        }
        bool is_free[DISNEY_N + 3];
        for (int p = 0; p < n; p++) {
            is_free[p] = p >= DISNEY_N || !r || r->freedom[p] == PARAMETER_FREE;
            if (is_free[p]) {
                A[packed_at(p, p)] += (p < DISNEY_N ? prior : 0) + 1e-12;
                continue;
            }
            for (int q = 0; q < n; q++)
                A[packed_at(p, q)] = 0;
            A[packed_at(p, p)] = 1;
        }
        if (m->validity[t] == MATERIAL_UNOBSERVED || !packed_factor(n, A)) {
            for (int p = 0; p < n; p++)
                m->std[t][p] = r && !is_free[p] ? r->std[p] : INFINITY;
            continue;
        }
        const double of_light = light_doubt(j, t);
        for (int p = 0; p < n; p++) {
            double x[DISNEY_N + 3] = { 0 };
            x[p] = 1;
            packed_solve(n, A, x);
            const double of_lights = p < DISNEY_N ? 0 : of_light * (double)m->albedo[t][p - DISNEY_N];
            m->std[t][p] = is_free[p] ? (float)sqrt(error2 * x[p] + (p < DISNEY_N ? 0 : fmax(of_region[p - DISNEY_N], 0)) + of_lights * of_lights) : r->std[p];
        }
    }
}

// Every light's own deviation from that of its distance. NULL: known, or no memory.
static float *light_stds(const struct materials_input *in)
{
    const int n = in->lights->n;
    float *std = in->inverse_distance_std ? malloc(((size_t)n + 1) * sizeof(*std)) : NULL;
    int32_t *distance_of = std ? malloc(((size_t)n + 1) * sizeof(*distance_of)) : NULL;
    if (distance_of)
        lights_number_distances(in->lights, distance_of);
    for (int i = 0; distance_of && i < n; i++) {
        const double own = in->inverse_distance_std[distance_of[i]];
        std[i] = isfinite(own) ? (float)own : 0; // a light without irradiance
    }
    if (!distance_of) {
        free(std);
        return NULL;
    }
    free(distance_of);
    return std;
}

static int judge(struct estimate *e, const struct materials_input *in, struct materials *m)
{
    struct judging j = { .e = e, .m = m, .in = in };
    double sums[4] = { 0 };
    e->scene.robust_scale = 0;
    int err = parallel_sum(e->set->n_threads, m->n_texels, EVALUATE_CHUNK, measure_texels, &j, 4, sums);
    m->n_fit = (int64_t)sums[1], m->n_held_out = (int64_t)sums[3];
    m->rmse_fit_percent = 100 * sqrt(sums[0] / fmax(3 * sums[1], 1));
    m->rmse_held_out_percent = sums[3] > 0 ? 100 * sqrt(sums[2] / (3 * sums[3])) : -1;
    j.error2 = sums[0] / fmax(3 * sums[1], 1);
    float *stds = light_stds(in);
    j.inverse_distance_std = stds;
    if (in->inverse_distance_std && !stds)
        err = -ENOMEM;
    if (!err)
        err = parallel_sum(e->set->n_threads, m->n_texels, EVALUATE_CHUNK, doubt_texels, &j, 1, sums);
    free(stds);
    return err ? err : fill_unobserved(e, m);
}

// Of texels here and there: those that are well known or, where none is, any that was observed.
static void check_energy(const struct estimate *e, struct materials *m)
{
    enum { LOOKS = 96 };
    int n_known = 0;
    for (int t = 0; t < m->n_texels; t++)
        n_known += m->validity[t] == MATERIAL_VALID;
    const uint8_t least = n_known ? MATERIAL_VALID : MATERIAL_WEAK;
    for (int k = 0; k < LOOKS && k < m->n_texels; k++) {
        const int t = (int)((int64_t)k * m->n_texels / (m->n_texels < LOOKS ? m->n_texels : LOOKS));
        if (m->validity[t] < least)
            continue;
        m->most_directional_albedo = fmax(m->most_directional_albedo, materials_directional_albedo(m->theta[t], m->albedo[t], e->set->variant));
    }
    if (materials_make_light(m))
        log_warning("materials: a texel sends back %.2f times the light that it gets: such a material makes light; is the panorama's scale that of the views?",
                    m->most_directional_albedo);
}

static int pyramid(struct estimate *e, const struct materials_input *in, struct materials *m)
{
    float(*theta)[DISNEY_N] = NULL, (*parent)[DISNEY_N] = NULL;
    uint8_t *region = NULL;
    int err = 0, select_at = -1;
    for (int k = 0; e->set->selection && k < e->levels.n; k++)
        if (e->levels.level[k].size <= SELECT_SIZE)
            select_at = k;
    progress_begin("materials", e->levels.n);
    for (int k = 0; !err && k < e->levels.n; k++) {
        const struct level *l = &e->levels.level[k];
        const bool solved = !e->set->most_size || l->size <= e->set->most_size;
        double *scale = NULL;
        err = spread(&theta, l, (const float(*)[DISNEY_N])parent, in->start_theta);
        if (!err)
            err = whole_weights(e, k, &scale);
        if (!err && region) {
            uint8_t *finer = malloc((size_t)l->n + 1);
            for (int i = 0; finer && !solved && i < l->n; i++)
                finer[i] = region[l->parent[i]];
            err = !finer ? -ENOMEM : !solved ? 0 : regions_refine(&m->regions, finer, region, &e->scene, l, (const float(*)[3])e->albedo, e->set->n_threads);
            free(region);
            region = finer;
        }
        if (!err && solved)
            err = solve_level(e, k, theta, (const float(*)[DISNEY_N])parent, region, scale, &m->level[m->n_levels++]);
        if (!err && k == select_at) {
            region = malloc((size_t)l->n + 1);
            err = region ? regions_find(&m->regions, region, &e->scene, l, (const float(*)[DISNEY_N])theta, e->albedo, e->set->n_threads) : -ENOMEM;
            e->regions = &m->regions;
            if (!err) // the same level again, with what was chosen
                err = solve_level(e, k, theta, (const float(*)[DISNEY_N])parent, region, scale, &m->level[m->n_levels++]);
        }
        free(scale);
        free(parent);
        parent = theta, theta = NULL;
        progress_add(1);
    }
    progress_end();
    m->theta = parent;
    free(theta);
    if (err) {
        free(region);
        return err;
    }
    m->region = region ? region : calloc((size_t)m->n_texels + 1, 1);
    return m->region ? 0 : -ENOMEM;
}

// Light from the object itself, under the albedo that fits what theta the last look found.
static void fit_albedos(void *arg, int64_t begin, int64_t end, int worker)
{
    struct judging *j = arg;
    for (int t = (int)begin; t < (int)end; t++) {
        struct texel_sums sums = { 0 };
        texel_fit(&j->e->scene, j->e->worker[worker], t, DELEGATE_VIEWS, j->m->theta[t], j->e->albedo[t], 1, &sums);
    }
}

// *settled_now: the pictures would not know this light from that before.
static int bounce(struct estimate *e, const struct materials_input *in, struct materials *m, float (*indirect)[3], bool *settled_now)
{
    struct judging j = { .e = e, .m = m };
    const size_t n = (size_t)m->n_texels;
    double change2 = 0;
    float(*diffuse)[3] = malloc((n + 1) * sizeof(*diffuse)), (*before)[3] = malloc((n + 1) * sizeof(*before));
    if (!diffuse || !before) {
        free(diffuse);
        free(before);
        return -ENOMEM;
    }
    const struct interreflection light = { .texels = in->texels, .mesh = in->mesh, .rays = in->rays, .lights = &e->scene.lights, .kernels = e->scene.kernels,
                                           .visible = in->visible, .words_per_texel = in->words_per_texel, .soft = in->soft,
                                           .diffuse = (const float(*)[3])diffuse, .n_rays = BOUNCE_RAYS, .size = BOUNCE_SIZE, .n_threads = e->set->n_threads };
    int err = 0;
    parallel_for(e->set->n_threads, m->n_texels, EVALUATE_CHUNK, fit_albedos, &j);
    for (int t = 0; t < m->n_texels; t++)
        for (int c = 0; c < 3; c++)
            diffuse[t][c] = e->albedo[t][c] * (1 - m->theta[t][DISNEY_METALLIC]);
    memcpy(before, indirect, n * sizeof(*before));
    memset(indirect, 0, n * sizeof(*indirect));
    for (int k = 0; !err && k < e->set->n_bounces; k++)
        err = interreflection_gather(&light, indirect);
    for (size_t t = 0; t < n; t++)
        for (int c = 0; c < 3; c++) {
            const double change = (double)(e->albedo[t][c] * (indirect[t][c] - before[t][c])) / M_PI;
            change2 += change * change;
        }
    *settled_now = change2 < light_settled * light_settled * 3 * (double)n;
    free(diffuse);
    free(before);
    return err;
}

static void clear_look(struct materials *m)
{
    free(m->theta), free(m->region);
    m->theta = NULL, m->region = NULL, m->n_levels = 0;
    memset(&m->regions, 0, sizeof(m->regions));
}

int materials_solve(struct materials *out, const struct materials_input *in, const struct materials_settings *set)
{
    struct estimate e;
    struct materials m = { .n_texels = in->texels->n, .rmse_held_out_percent = -1 };
    struct materials_settings look = *set;
    bool whole = false;
    const size_t n = (size_t)m.n_texels + 1;
    memset(out, 0, sizeof(*out));
    int err = estimate_new(&e, in, set);
    m.albedo = malloc(n * sizeof(*m.albedo));
    if (!err && !m.albedo)
        err = -ENOMEM;
    for (int t = 0; !err && t < m.n_texels; t++)
        for (int c = 0; c < 3; c++)
            m.albedo[t][c] = in->start_albedo ? in->start_albedo[t][c] : .5f;
    e.albedo = m.albedo;
    if (!err && set->n_bounces > 0) {
        float(*indirect)[3] = calloc(n, sizeof(*indirect));
        err = indirect ? 0 : -ENOMEM;
        look.most_size = set->most_size && set->most_size < SELECT_SIZE ? set->most_size : SELECT_SIZE;
        bool settled_now = false;
        e.set = &look;
        for (int k = 0; !err && k < BOUNCE_LOOKS && !settled_now; k++) {
            err = pyramid(&e, in, &m);
            if (!err)
                err = bounce(&e, in, &m, indirect, &settled_now);
            if (!err && settled_now && look.most_size >= in->texels->size)
                whole = true; // the last look was all there is to see
            e.scene.indirect = (const float(*)[3])indirect; // freed with the estimate
            if (!whole) {
                e.regions = NULL;
                clear_look(&m);
            }
        }
        if (!e.scene.indirect)
            free(indirect);
        e.set = set;
    }
    if (!err && !whole)
        err = pyramid(&e, in, &m);
    if (!err && set->most_size && set->most_size < in->texels->size && set->free_albedo) {
        struct judging j = { .e = &e, .m = &m };
        parallel_for(set->n_threads, m.n_texels, EVALUATE_CHUNK, fit_albedos, &j);
    }
    if (!err && !set->look) {
        m.std = malloc(n * sizeof(*m.std)), m.validity = calloc(n, 1), m.coverage = calloc(n, sizeof(*m.coverage));
        err = m.std && m.validity && m.coverage ? judge(&e, in, &m) : -ENOMEM;
        if (!err)
            check_energy(&e, &m);
    }
    m.indirect = (float(*)[3])e.scene.indirect;
    e.scene.indirect = NULL;
    estimate_free(&e);
    if (err)
        materials_free(&m);
    else
        *out = m;
    return err;
}

void materials_free(struct materials *m)
{
    free(m->albedo);
    free(m->theta);
    free(m->std);
    free(m->validity);
    free(m->coverage);
    free(m->region);
    free(m->indirect);
    memset(m, 0, sizeof(*m));
}

// ---- energy -------------------------------------------------------------------------------------------------------------

double materials_directional_albedo(const float theta[DISNEY_N], const float albedo[3], enum disney_variant variant)
{
    enum { RINGS = 40, SECTORS = 32 };
    struct disney m = { .variant = variant };
    const struct disney_frame frame = { { 0, 0, 1 }, { 1, 0, 0 }, { 0, 1, 0 } };
    double most = 0;
    for (int p = 0; p < DISNEY_N; p++)
        m.theta[p] = (double)theta[p];
    for (int c = 0; c < 3; c++)
        m.albedo[c] = (double)albedo[c];
    for (int k = 0; k < 4; k++) {
        const double tilt = .35 * k, v[3] = { sin(tilt), 0, cos(tilt) };
        double sum[3] = { 0 }, total = 0;
        // rings about the mirror direction (-vx, -vy, vz), dense near it: cos(angle) = 1 - 2 u^4
        for (int i = 0; i < RINGS; i++)
            for (int j = 0; j < SECTORS; j++) {
                const double u = (i + .5) / RINGS, phi = 2 * M_PI * (j + .5) / SECTORS, z = 1 - 2 * u * u * u * u, s = sqrt(fmax(1 - z * z, 0));
                const double omega = 8 * u * u * u / RINGS * 2 * M_PI / SECTORS, x = s * cos(phi), y = s * sin(phi);
                const double l[3] = { x * v[2] - z * v[0], y, x * v[0] + z * v[2] };
                double f[3];
                if (l[2] <= 0)
                    continue;
                total += omega * l[2];
                disney_eval(&m, &frame, l, v, f);
                for (int c = 0; c < 3; c++)
                    sum[c] += f[c] * l[2] * omega;
            }
        for (int c = 0; c < 3; c++)
            most = fmax(most, sum[c] * M_PI / total);
    }
    return most;
}
