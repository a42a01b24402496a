// solver/levels.c - the pyramid's tree, neighbours and delegates.
#include "solver/levels.h"

#include "solver/random.h"

#include <math.h>

#include <errno.h>
#include <stdlib.h>
#include <string.h>

static const float seam_reach_texels = 2.5f, seam_cos = .5f;
enum { SAME_CHART_TEXELS = 8 };

// ---- the tree -----------------------------------------------------------------------------------------------------------

// A coarser level under construction.
struct draft {
    int32_t *index, *chart;
    uint32_t *pixel;
    float (*position)[3], (*normal)[3];
};

static int own(struct level *l, const struct draft *d)
{
    void *all[5] = { d->index, d->chart, d->pixel, d->position, d->normal };
    memcpy(l->owned, all, sizeof(all));
    l->index = d->index, l->chart = d->chart, l->pixel = d->pixel;
    l->position_m = (const float(*)[3])d->position, l->normal = (const float(*)[3])d->normal;
    return d->index && d->chart && d->pixel && d->position && d->normal ? 0 : -ENOMEM;
}

// weight[i]: finest texels of its chart beneath texel i of `fine`; the new ones' go into *coarse_weight.
static int coarsen(struct level *coarse, struct level *fine, const int32_t *weight, int32_t **coarse_weight)
{
    const int size = (fine->size + 1) / 2;
    struct draft d = { 0 };
    coarse->size = size;
    d.index = malloc((size_t)size * (size_t)size * sizeof(*d.index));
    fine->parent = malloc(((size_t)fine->n + 1) * sizeof(*fine->parent));
    if (!d.index || !fine->parent) {
        free(d.index);
        return -ENOMEM;
    }
    memset(d.index, -1, (size_t)size * (size_t)size * sizeof(*d.index));
    for (int i = 0; i < fine->n; i++) // -2: covered
        d.index[(int)fine->pixel[i] / fine->size / 2 * size + (int)fine->pixel[i] % fine->size / 2] = -2;
    for (int p = 0; p < size * size; p++)
        if (d.index[p] == -2)
            d.index[p] = coarse->n++;
    const size_t n = (size_t)coarse->n;
    d.chart = malloc((n + 1) * sizeof(*d.chart)), d.pixel = malloc((n + 1) * sizeof(*d.pixel));
    d.position = calloc(n + 1, sizeof(*d.position)), d.normal = calloc(n + 1, sizeof(*d.normal));
    *coarse_weight = calloc(n + 1, sizeof(**coarse_weight));
    int err = own(coarse, &d);
    if (err || !*coarse_weight)
        return -ENOMEM;
    for (int p = 0; p < size * size; p++) {
        int32_t child[4];
        int n_children = 0;
        const int i = d.index[p], x = p % size, y = p / size;
        if (i < 0)
            continue;
        d.pixel[i] = (uint32_t)p;
        for (int k = 0; k < 4; k++) {
            const int cx = 2 * x + k % 2, cy = 2 * y + k / 2;
            const int32_t c = cx < fine->size && cy < fine->size ? fine->index[cy * fine->size + cx] : -1;
            if (c >= 0)
                child[n_children++] = c, fine->parent[c] = i;
        }
        d.chart[i] = -1;
        for (int a = 0; a < n_children; a++) {
            int32_t sum = 0;
            const int32_t chart = fine->chart[child[a]];
            for (int b = 0; b < n_children; b++)
                sum += fine->chart[child[b]] == chart ? weight[child[b]] : 0;
            if (sum > (*coarse_weight)[i] || (sum == (*coarse_weight)[i] && chart < d.chart[i]))
                (*coarse_weight)[i] = sum, d.chart[i] = chart;
        }
        double position[3] = { 0 }, normal[3] = { 0 };
        for (int a = 0; a < n_children; a++)
            for (int c = 0; c < 3 && fine->chart[child[a]] == d.chart[i]; c++) {
                position[c] += (double)weight[child[a]] * (double)fine->position_m[child[a]][c];
                normal[c] += (double)weight[child[a]] * (double)fine->normal[child[a]][c];
            }
        const double length = sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]);
        for (int c = 0; c < 3; c++) {
            d.position[i][c] = (float)(position[c] / (double)(*coarse_weight)[i]);
            d.normal[i][c] = length > 0 ? (float)(normal[c] / length) : fine->normal[child[0]][c];
        }
    }
    return 0;
}

// ---- neighbours ---------------------------------------------------------------------------------------------------------

struct edge {
    int32_t a, b; // a < b
};

static int by_ends(const void *x, const void *y)
{
    const struct edge *a = x, *b = y;
    return a->a != b->a ? (a->a > b->a) - (a->a < b->a) : (a->b > b->b) - (a->b < b->b);
}

// The texel beside i (0: left, 1: right, 2: above, 3: below) of its chart, or -1.
static int32_t beside(const struct level *l, int i, int side)
{
    const int x = (int)l->pixel[i] % l->size + (side == 1) - (side == 0);
    const int y = (int)l->pixel[i] / l->size + (side == 3) - (side == 2);
    if (x < 0 || y < 0 || x >= l->size || y >= l->size)
        return -1;
    const int32_t j = l->index[y * l->size + x];
    return j >= 0 && l->chart[j] == l->chart[i] ? j : -1;
}

// Boundary texels sorted into the cells of a hashed grid.
struct grid {
    float cell_m;
    uint32_t n_buckets; // a power of two
    int32_t *first;     // [n_buckets + 1]
    int32_t *member;
};

static uint32_t bucket_of(const struct grid *g, const int64_t cell[3])
{
    return (uint32_t)(random_mix((uint64_t)cell[0] * 0x9e3779b1u ^ (uint64_t)cell[1] << 21 ^ (uint64_t)cell[2] << 42) & (g->n_buckets - 1));
}

static void cell_of(const struct grid *g, const float position_m[3], int64_t cell[3])
{
    for (int c = 0; c < 3; c++)
        cell[c] = (int64_t)floor((double)position_m[c] / (double)g->cell_m);
}

static int grid_new(struct grid *g, const struct level *l, const int32_t *boundary, int n, float cell_m)
{
    *g = (struct grid){ .cell_m = cell_m, .n_buckets = 16 };
    while ((int64_t)g->n_buckets < n)
        g->n_buckets *= 2;
    g->first = calloc((size_t)g->n_buckets + 2, sizeof(*g->first));
    g->member = malloc(((size_t)n + 1) * sizeof(*g->member));
    if (!g->first || !g->member)
        return -ENOMEM;
    for (int pass = 0; pass < 2; pass++) {
        for (int k = 0; k < n; k++) {
            int64_t cell[3];
            cell_of(g, l->position_m[boundary[k]], cell);
            const uint32_t b = bucket_of(g, cell);
            if (pass)
                g->member[g->first[b + 1]++] = boundary[k];
            else
                g->first[b + 2]++;
        }
        for (uint32_t b = 2; !pass && b <= g->n_buckets; b++)
            g->first[b] += g->first[b - 1];
    }
    return 0;
}

static bool is_across(const struct level *l, int i, int j, float reach_m, float *distance2)
{
    const float *p = l->position_m[i], *q = l->position_m[j], *a = l->normal[i], *b = l->normal[j];
    const float d2 = (p[0] - q[0]) * (p[0] - q[0]) + (p[1] - q[1]) * (p[1] - q[1]) + (p[2] - q[2]) * (p[2] - q[2]);
    if (i == j || !(d2 <= reach_m * reach_m) || a[0] * b[0] + a[1] * b[1] + a[2] * b[2] < seam_cos)
        return false;
    *distance2 = d2;
    const int dx = abs((int)l->pixel[i] % l->size - (int)l->pixel[j] % l->size);
    const int dy = abs((int)l->pixel[i] / l->size - (int)l->pixel[j] / l->size);
    return l->chart[i] != l->chart[j] || dx > SAME_CHART_TEXELS || dy > SAME_CHART_TEXELS;
}

// The `most` nearest across the seam from i, nearest first. Returns how many.
static int find_across(const struct level *l, const struct grid *g, int i, int most, int32_t found[4])
{
    float distance2[4];
    int n = 0;
    int64_t cell[3];
    uint32_t done[27];
    int n_done = 0;
    cell_of(g, l->position_m[i], cell);
    for (int k = 0; k < 27; k++) {
        const int64_t near[3] = { cell[0] + k % 3 - 1, cell[1] + k / 3 % 3 - 1, cell[2] + k / 9 - 1 };
        const uint32_t b = bucket_of(g, near);
        bool again = false; // two cells in one bucket
        for (int m = 0; m < n_done; m++)
            again = again || done[m] == b;
        if (again)
            continue;
        done[n_done++] = b;
        for (int32_t m = g->first[b]; m < g->first[b + 1]; m++) {
            float d2;
            const int32_t j = g->member[m];
            if (!is_across(l, i, j, g->cell_m, &d2))
                continue;
            int at = n < most ? n : most;
            for (; at > 0 && (d2 < distance2[at - 1] || (d2 == distance2[at - 1] && j < found[at - 1])); at--)
                if (at < most)
                    distance2[at] = distance2[at - 1], found[at] = found[at - 1];
            if (at < most)
                distance2[at] = d2, found[at] = j;
            n += n < most;
        }
    }
    return n;
}

static int find_seams(const struct level *l, float spacing_m, struct edge **edges, int *n_edges)
{
    struct grid g = { 0 };
    int n = 0;
    int32_t *boundary = malloc(((size_t)l->n + 1) * sizeof(*boundary));
    int err = boundary ? 0 : -ENOMEM;
    for (int i = 0; !err && i < l->n; i++) {
        int sides = 0;
        for (int side = 0; side < 4; side++)
            sides += beside(l, i, side) >= 0;
        if (sides < 4)
            boundary[n++] = i;
    }
    if (!err)
        err = grid_new(&g, l, boundary, n, seam_reach_texels * spacing_m);
    *edges = err ? NULL : malloc(((size_t)n + 1) * 4 * sizeof(**edges));
    *n_edges = 0;
    if (!*edges)
        err = -ENOMEM;
    for (int k = 0; !err && k < n; k++) {
        int32_t found[4];
        int sides = 0;
        for (int side = 0; side < 4; side++)
            sides += beside(l, boundary[k], side) >= 0;
        const int n_found = find_across(l, &g, boundary[k], 4 - sides, found);
        for (int m = 0; m < n_found; m++)
            (*edges)[(*n_edges)++] = boundary[k] < found[m] ? (struct edge){ boundary[k], found[m] } : (struct edge){ found[m], boundary[k] };
    }
    if (!err) {
        int kept = 0;
        qsort(*edges, (size_t)*n_edges, sizeof(**edges), by_ends);
        for (int k = 0; k < *n_edges; k++)
            if (!kept || by_ends(&(*edges)[kept - 1], &(*edges)[k]))
                (*edges)[kept++] = (*edges)[k];
        *n_edges = kept;
    }
    free(boundary);
    free(g.first);
    free(g.member);
    return err;
}

static int by_index(const void *a, const void *b)
{
    const int32_t x = *(const int32_t *)a, y = *(const int32_t *)b;
    return (x > y) - (x < y);
}

static int find_neighbours(struct level *l, bool seams, float spacing_m)
{
    struct edge *across = NULL;
    int n_across = 0, err = 0;
    if (seams)
        err = find_seams(l, spacing_m, &across, &n_across);
    int32_t *first = calloc((size_t)l->n + 2, sizeof(*first)); // one place up while counting
    l->first_neighbour = first;
    if (!first)
        err = -ENOMEM;
    for (int pass = 0; !err && pass < 2; pass++) {
        for (int i = 0; i < l->n; i++)
            for (int side = 0; side < 4; side++) {
                const int32_t j = beside(l, i, side);
                if (j < 0)
                    continue;
                if (pass)
                    l->neighbour[first[i + 1]++] = j;
                else
                    first[i + 2]++;
            }
        for (int k = 0; k < n_across; k++)
            for (int end = 0; end < 2; end++) {
                const int32_t i = end ? across[k].b : across[k].a, j = end ? across[k].a : across[k].b;
                if (pass)
                    l->neighbour[first[i + 1]++] = j;
                else
                    first[i + 2]++;
            }
        if (pass)
            break;
        for (int i = 2; i <= l->n + 1; i++)
            first[i] += first[i - 1];
        l->neighbour = malloc(((size_t)first[l->n + 1] + 1) * sizeof(*l->neighbour));
        if (!l->neighbour)
            err = -ENOMEM;
    }
    for (int i = 0; !err && i < l->n; i++)
        qsort(l->neighbour + first[i], (size_t)(first[i + 1] - first[i]), sizeof(*l->neighbour), by_index);
    free(across);
    return err;
}

// ---- delegates ----------------------------------------------------------------------------------------------------------

static int children_of(const struct level *coarse, const struct level *fine, int i, int32_t child[4])
{
    const int x = (int)coarse->pixel[i] % coarse->size, y = (int)coarse->pixel[i] / coarse->size;
    const unsigned turn = (unsigned)random_u64(1, (uint64_t)coarse->size, (uint64_t)i) & 3;
    int n = 0;
    for (unsigned k = 0; k < 4; k++) {
        const int cx = 2 * x + (int)((k + turn) & 1), cy = 2 * y + (int)((k + turn) >> 1 & 1);
        const int32_t c = cx < fine->size && cy < fine->size ? fine->index[cy * fine->size + cx] : -1;
        if (c >= 0)
            child[n++] = c;
    }
    return n;
}

static int find_delegates(struct level *coarse, const struct level *fine, const int32_t *n_samples, const struct levels_settings *set)
{
    int64_t n = 0, room = 1024;
    coarse->first_delegate = calloc((size_t)coarse->n + 1, sizeof(int32_t));
    coarse->delegate = malloc((size_t)room * sizeof(int32_t));
    if (!coarse->first_delegate || !coarse->delegate)
        return -ENOMEM;
    for (int i = 0; i < coarse->n; i++) {
        int32_t child[4];
        const int n_children = children_of(coarse, fine, i, child);
        int n_seen = 0;
        bool more = true;
        for (int round = 0; more && n_seen < set->cap; round++) {
            more = false;
            for (int k = 0; k < n_children && n_seen < set->cap; k++) {
                int32_t t;
                if (fine->first_delegate) {
                    if (fine->first_delegate[child[k]] + round >= fine->first_delegate[child[k] + 1])
                        continue;
                    t = fine->delegate[fine->first_delegate[child[k]] + round];
                } else {
                    if (round || !n_samples[child[k]])
                        continue;
                    t = child[k];
                }
                more = true;
                n_seen += n_samples[t] < set->most_views ? n_samples[t] : set->most_views;
                if (n == room) {
                    int32_t *larger = realloc(coarse->delegate, 2 * (size_t)room * sizeof(int32_t));
                    if (!larger)
                        return -ENOMEM;
                    coarse->delegate = larger, room *= 2;
                }
                coarse->delegate[n++] = t;
            }
        }
        coarse->first_delegate[i + 1] = (int32_t)n;
    }
    return 0;
}

// ---- all levels ---------------------------------------------------------------------------------------------------------

int levels_new(struct levels *out, const struct texels *texels, const int32_t *n_samples, const struct levels_settings *settings)
{
    memset(out, 0, sizeof(*out));
    out->n = 1;
    for (int size = texels->size; size > 1; size = (size + 1) / 2)
        out->n++;
    struct level *finest = &out->level[out->n - 1];
    finest->size = texels->size, finest->n = texels->n;
    finest->index = texels->index, finest->pixel = texels->pixel, finest->chart = texels->chart;
    finest->position_m = (const float(*)[3])texels->position_m, finest->normal = (const float(*)[3])texels->normal;
    int32_t *weight = malloc(((size_t)texels->n + 1) * sizeof(*weight));
    int err = weight ? 0 : -ENOMEM;
    for (int i = 0; !err && i < texels->n; i++)
        weight[i] = 1;
    for (int k = out->n - 1; !err && k >= 0; k--) {
        struct level *l = &out->level[k];
        err = find_neighbours(l, settings->seams, texels->texel_size_m * (float)texels->size / (float)l->size);
        if (err || !k)
            break;
        int32_t *coarse_weight = NULL;
        err = coarsen(&out->level[k - 1], l, weight, &coarse_weight);
        if (!err)
            err = find_delegates(&out->level[k - 1], l, n_samples, settings);
        free(weight);
        weight = coarse_weight;
    }
    free(weight);
    if (err)
        levels_free(out);
    return err;
}

void levels_free(struct levels *l)
{
    for (int k = 0; k < l->n; k++) {
        struct level *v = &l->level[k];
        free(v->parent);
        free(v->first_neighbour);
        free(v->neighbour);
        free(v->first_delegate);
        free(v->delegate);
        for (int i = 0; i < 5; i++)
            free(v->owned[i]);
    }
    memset(l, 0, sizeof(*l));
}
