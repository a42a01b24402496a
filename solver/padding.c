// solver/padding.c - the borders of charts are cut into pieces of half a texel, sorted into the texture's texels; each looks for the
// nearest piece of border, within two texels, that is somewhere else on the surface.
#include "solver/padding.h"
#include "solver/random.h"
#include "solver/vec3.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MOST_BORDERS = 1 << 22, MOST_PIECES = 1 << 21, N_BINS = 64, LARGEST_TEXTURE = 4096 }; // that --texture takes
static const double piece_px = .5, enough_px = 2;
static const double neighbours_px = 4;  // so many texels apart on the surface, colours are expected to be alike at this size
static const double most_looks = 5e7;   // pairs of pieces; atlases of splinters are looked at here and there
static const double worth_a_word = 1e-3; // of the surface
static const float uv_limit = 16;       // texels_rasterise leaves out what reaches further

struct border { // an edge of one triangle only, in the atlas
    uint32_t vertex[2];
    double uv[2][2], length_px;
    double stretch_m;  // most metres per unit of uv
    double density_m2; // square metres per unit square of uv
};

struct piece {
    uint32_t border;
    float from, to; // along it, 0..1
};

struct borders {
    int size, n, n_pieces;
    struct border *border;
    struct piece *piece;  // [n_pieces] by texel
    int32_t *first;       // [size * size + 1]
};

static void borders_free(struct borders *b)
{
    free(b->border), free(b->piece), free(b->first);
}

// ---- which edges ----------------------------------------------------------------------------------------------------------

static bool is_same_corner(const struct mesh *m, uint32_t a, uint32_t b)
{
    return m->point[a] == m->point[b] && !memcmp(m->uv[a], m->uv[b], sizeof(m->uv[a]));
}

static uint64_t corner_hash(const struct mesh *m, uint32_t v)
{
    uint32_t bits[2];
    memcpy(bits, m->uv[v], sizeof(bits));
    return random_mix(random_mix((uint64_t)bits[0] << 32 | bits[1]) ^ m->point[v]);
}

// n_uses[3 i + k]: how many triangles have the edge from corner k to k + 1 of triangle i in the atlas; of the first that has it,
// 0 of the others.
static int count_uses(uint32_t *n_uses, const struct mesh *m)
{
    const size_t n = 3 * (size_t)m->n_triangles;
    size_t n_slots = 16;
    while (n_slots < 2 * n)
        n_slots *= 2;
    uint32_t *slot = malloc(n_slots * sizeof(*slot));
    if (!slot)
        return -ENOMEM;
    memset(slot, 0xff, n_slots * sizeof(*slot));
    for (size_t i = 0; i < n; i++) {
        const uint32_t *t = m->triangle[i / 3], a = t[i % 3], b = t[(i + 1) % 3];
        size_t s = (corner_hash(m, a) + corner_hash(m, b)) & (n_slots - 1);
        for (; slot[s] != UINT32_MAX; s = (s + 1) & (n_slots - 1)) {
            const uint32_t *u = m->triangle[slot[s] / 3], c = u[slot[s] % 3], d = u[(slot[s] + 1) % 3];
            if ((is_same_corner(m, a, c) && is_same_corner(m, b, d)) || (is_same_corner(m, a, d) && is_same_corner(m, b, c)))
                break;
        }
        if (slot[s] == UINT32_MAX)
            slot[s] = (uint32_t)i;
        n_uses[i] = 0;
        n_uses[slot[s]]++;
    }
    free(slot);
    return 0;
}

static void place_of(double out[3], const struct mesh *m, uint32_t vertex)
{
    for (int c = 0; c < 3; c++)
        out[c] = (double)m->position_m[vertex][c];
}

// False: no area in the atlas, or too far away.
static bool describe(struct border *b, const struct mesh *m, const uint32_t t[3], int corner, int size)
{
    double p[3][3], e1[3], e2[3], du[3], dv[3], uv[3][2], cross[3];
    for (int k = 0; k < 3; k++) {
        place_of(p[k], m, t[k]);
        for (int c = 0; c < 2; c++) {
            if (!(fabsf(m->uv[t[k]][c]) <= uv_limit))
                return false;
            uv[k][c] = (double)m->uv[t[k]][c];
        }
    }
    vec3_sub(e1, p[1], p[0]), vec3_sub(e2, p[2], p[0]);
    const double u1 = uv[1][0] - uv[0][0], v1 = uv[1][1] - uv[0][1], u2 = uv[2][0] - uv[0][0], v2 = uv[2][1] - uv[0][1];
    const double area2 = u1 * v2 - u2 * v1;
    if (!(fabs(area2) > 1e-14))
        return false;
    for (int c = 0; c < 3; c++) {
        du[c] = (v2 * e1[c] - v1 * e2[c]) / area2;
        dv[c] = (u1 * e2[c] - u2 * e1[c]) / area2;
    }
    vec3_cross(cross, du, dv);
    // the larger singular value of (du dv)
    const double sum = vec3_dot(du, du) + vec3_dot(dv, dv), density = vec3_norm(cross);
    b->stretch_m = sqrt(.5 * (sum + sqrt(fmax(sum * sum - 4 * density * density, 0))));
    b->density_m2 = density;
    for (int k = 0; k < 2; k++) {
        b->vertex[k] = t[(corner + k) % 3];
        memcpy(b->uv[k], uv[(corner + k) % 3], sizeof(b->uv[k]));
    }
    b->length_px = size * hypot(b->uv[1][0] - b->uv[0][0], b->uv[1][1] - b->uv[0][1]);
    return isfinite(b->stretch_m) && b->length_px > 0;
}

// ---- pieces ---------------------------------------------------------------------------------------------------------------

static void along(double out[2], const struct border *b, double at)
{
    for (int c = 0; c < 2; c++)
        out[c] = b->uv[0][c] + at * (b->uv[1][c] - b->uv[0][c]);
}

// Texel of the piece's middle, or -1: outside.
static int64_t texel_of(const struct borders *all, const struct border *b, double from, double to)
{
    double uv[2];
    along(uv, b, .5 * (from + to));
    if (!(uv[0] >= 0 && uv[0] <= 1 && uv[1] >= 0 && uv[1] <= 1))
        return -1;
    const int last = all->size - 1, x = (int)(uv[0] * all->size), y = (int)((1 - uv[1]) * all->size);
    return (int64_t)(y < last ? y : last) * all->size + (x < last ? x : last);
}

// Once to count (piece NULL), once to put each in its texel's place.
static void cut(struct borders *all, double length_px, struct piece *piece)
{
    for (int i = 0; i < all->n; i++) {
        const struct border *b = &all->border[i];
        const int n = (int)ceil(b->length_px / length_px);
        for (int k = 0; k < n; k++) {
            const double from = (double)k / n, to = (double)(k + 1) / n;
            const int64_t texel = texel_of(all, b, from, to);
            if (texel < 0)
                continue;
            if (piece)
                piece[all->first[texel]++] = (struct piece){ (uint32_t)i, (float)from, (float)to };
            else
                all->first[texel + 1]++;
        }
    }
}

static int borders_cut(struct borders *all)
{
    const size_t n_texels = (size_t)all->size * (size_t)all->size;
    double length_px = 0;
    for (int i = 0; i < all->n; i++)
        length_px += all->border[i].length_px;
    length_px = fmax(length_px / MOST_PIECES, piece_px);
    all->first = calloc(n_texels + 2, sizeof(*all->first));
    if (!all->first)
        return -ENOMEM;
    cut(all, length_px, NULL);
    for (size_t i = 0; i < n_texels; i++)
        all->first[i + 1] += all->first[i];
    all->n_pieces = all->first[n_texels];
    all->piece = malloc(((size_t)all->n_pieces + 1) * sizeof(*all->piece));
    if (!all->piece)
        return -ENOMEM;
    cut(all, length_px, all->piece);
    memmove(all->first + 1, all->first, n_texels * sizeof(*all->first)); // each is now where the next one begins
    all->first[0] = 0;
    return 0;
}

static int borders_of(struct borders *all, const struct mesh *m, int size)
{
    *all = (struct borders){ .size = size };
    const size_t n = 3 * (size_t)m->n_triangles;
    size_t n_borders = 0;
    uint32_t *n_uses = malloc(n * sizeof(*n_uses));
    int err = n_uses ? count_uses(n_uses, m) : -ENOMEM;
    for (size_t i = 0; !err && i < n; i++)
        n_borders += n_uses[i] == 1;
    if (n_borders > MOST_BORDERS) // not an atlas of charts
        n_borders = 0, memset(n_uses, 0, n * sizeof(*n_uses));
    if (!err && !(all->border = malloc((n_borders + 1) * sizeof(*all->border))))
        err = -ENOMEM;
    for (size_t i = 0; !err && i < n; i++)
        if (n_uses[i] == 1 && describe(&all->border[all->n], m, m->triangle[i / 3], (int)(i % 3), size))
            all->n++;
    free(n_uses);
    return err ? err : borders_cut(all);
}

// ---- looking --------------------------------------------------------------------------------------------------------------

// Columns and rows of texels within two of a piece's own.
static void window(const struct borders *all, int64_t texel, int *x0, int *x1, int *y0, int *y1)
{
    const int x = (int)(texel % all->size), y = (int)(texel / all->size), last = all->size - 1;
    *x0 = x > 3 ? x - 3 : 0, *x1 = x < last - 3 ? x + 3 : last;
    *y0 = y > 3 ? y - 3 : 0, *y1 = y < last - 3 ? y + 3 : last;
}

static double count_pairs(const struct borders *all)
{
    double n = 0;
    for (int64_t texel = 0; texel < (int64_t)all->size * all->size; texel++) {
        int x0, x1, y0, y1;
        const int own = all->first[texel + 1] - all->first[texel];
        if (!own)
            continue;
        window(all, texel, &x0, &x1, &y0, &y1);
        for (int y = y0; y <= y1; y++)
            n += (double)own * (all->first[(int64_t)y * all->size + x1 + 1] - all->first[(int64_t)y * all->size + x0]);
    }
    return n;
}

static void surface_at(double out[3], const struct mesh *m, const struct border *b, double at)
{
    double p[3], q[3];
    place_of(p, m, b->vertex[0]), place_of(q, m, b->vertex[1]);
    for (int c = 0; c < 3; c++)
        out[c] = p[c] + at * (q[c] - p[c]);
}

// Texels from a piece's middle to the nearest piece that is no neighbour on the surface, at most enough_px.
static double gap_of(const struct borders *all, const struct mesh *m, const struct piece *p, int64_t texel)
{
    const struct border *b = &all->border[p->border];
    const double at = .5 * ((double)p->from + (double)p->to);
    double gap = enough_px, uv[2], here[3];
    int x0, x1, y0, y1;
    along(uv, b, at);
    surface_at(here, m, b, at);
    window(all, texel, &x0, &x1, &y0, &y1);
    for (int y = y0; y <= y1; y++)
        for (int k = all->first[(int64_t)y * all->size + x0]; k < all->first[(int64_t)y * all->size + x1 + 1]; k++) {
            const struct piece *q = &all->piece[k];
            const struct border *c = &all->border[q->border];
            double from[2], to[2], there[3];
            if (q->border == p->border)
                continue;
            along(from, c, (double)q->from), along(to, c, (double)q->to);
            const double dx = to[0] - from[0], dy = to[1] - from[1], length2 = dx * dx + dy * dy;
            const double t = fmax(fmin(((uv[0] - from[0]) * dx + (uv[1] - from[1]) * dy) / length2, 1), 0);
            const double distance = all->size * hypot(from[0] + t * dx - uv[0], from[1] + t * dy - uv[1]);
            if (!(distance < gap))
                continue;
            surface_at(there, m, c, (double)q->from + t * ((double)q->to - (double)q->from));
            vec3_sub(there, there, here);
            if (vec3_norm(there) > neighbours_px / all->size * fmax(b->stretch_m, c->stretch_m))
                gap = distance;
        }
    return gap;
}

static bool is_overlapped(const struct texels *t, int64_t texel)
{
    const int column = (int)(texel % t->size), row = (int)(texel / t->size);
    for (int y = row - 1; y <= row + 1; y++)
        for (int x = column - 1; x <= column + 1; x++)
            if (x >= 0 && y >= 0 && x < t->size && y < t->size) {
                const int32_t i = t->index[(size_t)y * (size_t)t->size + (size_t)x];
                if (i >= 0 && t->flags[i] & TEXEL_OVERLAP)
                    return true;
            }
    return false;
}

static double surface_m2(const struct mesh *m)
{
    double sum = 0;
    for (int i = 0; i < m->n_triangles; i++) {
        double p[3][3], a[3], b[3], cross[3];
        for (int k = 0; k < 3; k++)
            place_of(p[k], m, m->triangle[i][k]);
        vec3_sub(a, p[1], p[0]), vec3_sub(b, p[2], p[0]);
        vec3_cross(cross, a, b);
        sum += .5 * vec3_norm(cross);
    }
    return sum;
}

int padding_measure(struct padding *out, const struct mesh *mesh, const struct texels *t)
{
    struct borders all;
    double strip_m2[N_BINS] = { 0 }, gaps[N_BINS] = { 0 }, short_m2 = 0;
    *out = (struct padding){ .size = t->size, .gap_px = enough_px, .enough_size = t->size };
    int err = borders_of(&all, mesh, t->size);
    if (err)
        goto end;
    const int64_t step = (int64_t)ceil(fmax(count_pairs(&all) / most_looks, 1));
    const double all_m2 = surface_m2(mesh);
    for (int64_t texel = 0; texel < (int64_t)t->size * t->size; texel++) {
        int64_t k = (all.first[texel] + step - 1) / step * step;
        if (k >= all.first[texel + 1] || is_overlapped(t, texel))
            continue;
        for (; k < all.first[texel + 1]; k += step) {
            const struct piece *p = &all.piece[k];
            const struct border *b = &all.border[p->border];
            const double gap = gap_of(&all, mesh, p, texel);
            if (gap > enough_px - 1e-3)
                continue;
            // Beyond the middle of the gap texels are the other's, and whoever reads reaches a texel far: the strip that may show them.
            const double length_px = ((double)p->to - (double)p->from) * b->length_px, strip_px = 1 - gap / 2;
            const double m2 = (double)step * length_px * strip_px * b->density_m2 / ((double)t->size * t->size);
            const int bin = (int)(gap / enough_px * N_BINS);
            strip_m2[bin] += m2, gaps[bin] += m2 * gap, short_m2 += m2;
        }
    }
    out->share = all_m2 > 0 ? fmin(short_m2 / all_m2, 1) : 0;
    double closer = 0;
    for (int k = 0; k < N_BINS && closer < worth_a_word * all_m2; k++)
        if (strip_m2[k] > 0)
            closer += strip_m2[k], out->gap_px = gaps[k] / strip_m2[k];
    if (out->share >= worth_a_word) {
        const double enough = ceil(t->size * enough_px / fmax(out->gap_px, 1e-6));
        out->enough_size = enough <= LARGEST_TEXTURE ? (int)enough : 0;
    }
end:
    borders_free(&all);
    return err;
}

// ---- in words -------------------------------------------------------------------------------------------------------------

bool padding_is_short(const struct padding *p)
{
    return p->share >= worth_a_word;
}

void padding_text(char *text, size_t n, const struct padding *p)
{
    char larger[80] = "";
    if (p->enough_size)
        snprintf(larger, sizeof(larger), "a larger texture (--texture %d or more), or ", p->enough_size);
    snprintf(text, n,
             "the atlas is too tight for %d x %d texels: charts that are no neighbours on the surface lie %.1f texels apart where they are closest. "
             "Below two, each shows the other's colour at its border, on up to some %.2g %% of the surface. What helps: %smore padding between charts "
             "(two texels are %.4f of the atlas's side)",
             p->size, p->size, p->gap_px, 100 * p->share, larger, enough_px / p->size);
}
