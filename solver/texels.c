// solver/texels.c - the atlas rasterised in exact integer arithmetic.
//
// UVs are snapped to a grid of about 2^-24 (what a float near 1 can say), a whole number of steps per texel. Edge functions are
// then 64-bit integers without rounding, so neighbours agree about their common edge to the last bit.
#include "solver/texels.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

enum { SIZE_MAX_TEXELS = 16384, OVERLAPPED = 1 << 30 };
static const float uv_limit = 16; // corners further out: the triangle is left out; keeps edge functions below 2^62

// A texel is 2 << half_bits grid steps wide; texel i has its centre at (2 i + 1) << half_bits.
struct grid {
    int size, half_bits;
};

static struct grid grid_of(int size)
{
    int half_bits = 23;
    while (half_bits > 0 && ((int64_t)size << (half_bits + 1)) > 1 << 25)
        half_bits--;
    return (struct grid){ size, half_bits };
}

// A triangle on the grid, counter-clockwise. Edge k faces corner k: inside, e_k(x, y) = a x + b y + c > 0, or >= 0 on the edges
// that own their points (those that go up, or level to the left: of two neighbours exactly one does).
struct outline {
    int64_t a[3], b[3], c[3], owns[3];
    int64_t area2;     // e_0 + e_1 + e_2 everywhere
    int64_t y_min, y_max;
};

static bool outline_of(struct outline *o, const struct mesh *mesh, int triangle, struct grid g)
{
    int64_t x[3], y[3];
    const double steps = (double)((int64_t)g.size << (g.half_bits + 1));
    for (int k = 0; k < 3; k++) {
        const float *uv = mesh->uv[mesh->triangle[triangle][k]];
        if (!(fabsf(uv[0]) <= uv_limit && fabsf(uv[1]) <= uv_limit))
            return false;
        x[k] = (int64_t)floor((double)uv[0] * steps + .5);
        y[k] = (int64_t)floor((double)uv[1] * steps + .5);
    }
    o->area2 = (x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0]);
    if (!o->area2)
        return false;
    const int sign = o->area2 < 0 ? -1 : 1; // mirrored: walk the edges the other way round
    o->area2 *= sign;
    for (int k = 0; k < 3; k++) {
        const int p = (k + 1) % 3, q = (k + 2) % 3;
        const int64_t dx = sign * (x[q] - x[p]), dy = sign * (y[q] - y[p]);
        o->a[k] = -dy, o->b[k] = dx, o->c[k] = dy * x[p] - dx * y[p];
        o->owns[k] = dy > 0 || (dy == 0 && dx < 0);
    }
    o->y_min = y[0] < y[1] ? y[0] : y[1];
    o->y_min = y[2] < o->y_min ? y[2] : o->y_min;
    o->y_max = y[0] > y[1] ? y[0] : y[1];
    o->y_max = y[2] > o->y_max ? y[2] : o->y_max;
    return true;
}

static int64_t floor_div(int64_t a, int64_t b) // b > 0
{
    return a / b - (a % b < 0);
}

// Rows counted from the bottom (v upwards) whose centres lie between y_min and y_max.
static void rows_of(const struct outline *o, struct grid g, int *first, int *last)
{
    const int64_t h = (int64_t)1 << g.half_bits;
    const int64_t lo = floor_div(o->y_min - h + 2 * h - 1, 2 * h), hi = floor_div(o->y_max - h, 2 * h);
    *first = (int)(lo < 0 ? 0 : lo);
    *last = (int)(hi > g.size - 1 ? g.size - 1 : hi);
}

// Columns first..last of one row whose centres lie inside; none if first > last.
static void columns_of(const struct outline *o, struct grid g, int row, int *first, int *last)
{
    const int64_t h = (int64_t)1 << g.half_bits, y = (2 * (int64_t)row + 1) * h;
    int64_t lo = 0, hi = g.size - 1;
    for (int k = 0; k < 3; k++) {
        // a (2 i + 1) h + rest >= 0
        const int64_t rest = o->b[k] * y + o->c[k] - !o->owns[k] + o->a[k] * h, step = 2 * h * o->a[k];
        if (step > 0) {
            const int64_t i = -floor_div(rest, step); // ceil(-rest / step)
            lo = i > lo ? i : lo;
        } else if (step < 0) {
            const int64_t i = floor_div(rest, -step);
            hi = i < hi ? i : hi;
        } else if (rest < 0) {
            hi = -1;
        }
    }
    *first = (int)(lo <= hi ? lo : 0);
    *last = (int)(lo <= hi ? hi : -1);
}

void texels_count_cover(uint8_t *count, const struct mesh *mesh, int size)
{
    assert(size >= 1 && size <= SIZE_MAX_TEXELS);
    const struct grid g = grid_of(size);
    memset(count, 0, (size_t)size * (size_t)size);
    for (int i = 0; i < mesh->n_triangles; i++) {
        struct outline o;
        if (!outline_of(&o, mesh, i, g))
            continue;
        int row, top, first, last;
        for (rows_of(&o, g, &row, &top); row <= top; row++) {
            columns_of(&o, g, row, &first, &last);
            uint8_t *line = count + (size_t)(size - 1 - row) * (size_t)size;
            for (int x = first; x <= last; x++)
                line[x] += line[x] < UINT8_MAX;
        }
    }
}

static void corner_positions(double p[3][3], const struct mesh *mesh, int triangle)
{
    for (int k = 0; k < 3; k++)
        for (int c = 0; c < 3; c++)
            p[k][c] = mesh->position_m[mesh->triangle[triangle][k]][c];
}

static double triangle_area_m2(const struct mesh *mesh, int triangle)
{
    double p[3][3], a[3], b[3], cross[3];
    corner_positions(p, mesh, triangle);
    vec3_sub(a, p[1], p[0]);
    vec3_sub(b, p[2], p[0]);
    vec3_cross(cross, a, b);
    return vec3_norm(cross) / 2;
}

static bool is_in_unit_square(const struct mesh *mesh, int triangle)
{
    for (int k = 0; k < 3; k++) {
        const float *uv = mesh->uv[mesh->triangle[triangle][k]];
        if (!(uv[0] >= 0 && uv[0] <= 1 && uv[1] >= 0 && uv[1] <= 1))
            return false;
    }
    return true;
}

// Unit d position / d u of one triangle; zero where its UVs have no area.
static void u_direction(double out[3], const struct mesh *mesh, int triangle)
{
    double p[3][3], e1[3], e2[3];
    corner_positions(p, mesh, triangle);
    vec3_sub(e1, p[1], p[0]);
    vec3_sub(e2, p[2], p[0]);
    const uint32_t *t = mesh->triangle[triangle];
    const float *uv0 = mesh->uv[t[0]], *uv1 = mesh->uv[t[1]], *uv2 = mesh->uv[t[2]];
    const double du1 = (double)uv1[0] - uv0[0], dv1 = (double)uv1[1] - uv0[1];
    const double du2 = (double)uv2[0] - uv0[0], dv2 = (double)uv2[1] - uv0[1];
    const double area2 = du1 * dv2 - du2 * dv1, sign = area2 < 0 ? -1 : area2 > 0 ? 1 : 0;
    for (int c = 0; c < 3; c++)
        out[c] = sign * (dv2 * e1[c] - dv1 * e2[c]);
    vec3_normalise(out);
}

// Per vertex: the mean of its triangles' u directions, weighted by area, so that the frame is smooth inside a chart.
static float (*vertex_tangents(const struct mesh *mesh))[3]
{
    float(*sum)[3] = calloc((size_t)mesh->n_vertices, sizeof(*sum));
    if (!sum)
        return NULL;
    for (int i = 0; i < mesh->n_triangles; i++) {
        double d[3];
        u_direction(d, mesh, i);
        const double area = triangle_area_m2(mesh, i);
        for (int k = 0; k < 3; k++)
            for (int c = 0; c < 3; c++)
                sum[mesh->triangle[i][k]][c] += (float)(area * d[c]);
    }
    for (int i = 0; i < mesh->n_vertices; i++) {
        double d[3] = { sum[i][0], sum[i][1], sum[i][2] };
        vec3_normalise(d);
        for (int c = 0; c < 3; c++)
            sum[i][c] = (float)d[c];
    }
    return sum;
}

static void interpolate(double out[3], const float (*values)[3], const uint32_t t[3], const double w[3])
{
    for (int c = 0; c < 3; c++)
        out[c] = w[0] * values[t[0]][c] + w[1] * values[t[1]][c] + w[2] * values[t[2]][c];
}

// Makes t unit and orthogonal to the unit vector n; false: it is along n, or zero.
static bool orthogonalise(double t[3], const double n[3])
{
    vec3_add_scaled(t, t, -vec3_dot(t, n), n);
    if (vec3_normalise(t) < 1e-6)
        return false;
    vec3_add_scaled(t, t, -vec3_dot(t, n), n); // once more: the first pass leaves rounding of the part removed
    vec3_normalise(t);
    return true;
}

static void shade_texel(struct texels *t, int i, const struct mesh *mesh, const struct outline *o,
                        struct grid g, const float (*tangents)[3])
{
    const int triangle = (int)t->triangle[i];
    const uint32_t *corners = mesh->triangle[triangle];
    const int64_t h = (int64_t)1 << g.half_bits;
    const int64_t x = (2 * (int64_t)(t->pixel[i] % (uint32_t)g.size) + 1) * h;
    const int64_t y = (2 * (int64_t)(g.size - 1 - t->pixel[i] / (uint32_t)g.size) + 1) * h;
    double w[3], position[3], n[3], d[3];
    for (int k = 0; k < 3; k++)
        w[k] = (double)(o->a[k] * x + o->b[k] * y + o->c[k]) / (double)o->area2;
    interpolate(position, (const float(*)[3])mesh->position_m, corners, w);
    interpolate(n, (const float(*)[3])mesh->normal, corners, w);
    if (vec3_normalise(n) < 1e-6) { // normals that cancel out: the face's
        double p[3][3], a[3], b[3];
        corner_positions(p, mesh, triangle);
        vec3_sub(a, p[1], p[0]);
        vec3_sub(b, p[2], p[0]);
        vec3_cross(n, a, b);
        if (vec3_normalise(n) == 0)
            n[2] = 1;
    }
    interpolate(d, tangents, corners, w);
    if (!orthogonalise(d, n)) {
        u_direction(d, mesh, triangle);
        if (!orthogonalise(d, n)) { // u runs along the normal: any direction in the plane
            const bool x_is_small = fabs(n[0]) < .6;
            d[0] = x_is_small, d[1] = !x_is_small, d[2] = 0;
            orthogonalise(d, n);
        }
    }
    for (int c = 0; c < 3; c++) {
        t->position_m[i][c] = (float)position[c];
        t->normal[i][c] = (float)n[c];
        t->tangent[i][c] = (float)d[c];
    }
    t->barycentric[i][0] = (float)w[1], t->barycentric[i][1] = (float)w[2];
    t->chart[i] = mesh->chart[triangle];
}

static bool is_same_chart(const struct texels *t, int row, int column, int32_t chart)
{
    if (row < 0 || column < 0 || row >= t->size || column >= t->size)
        return false;
    const int32_t i = t->index[(size_t)row * (size_t)t->size + (size_t)column];
    return i >= 0 && t->chart[i] == chart;
}

static void flag_boundary(struct texels *t)
{
    for (int i = 0; i < t->n; i++) {
        const int row = (int)(t->pixel[i] / (uint32_t)t->size), column = (int)(t->pixel[i] % (uint32_t)t->size);
        const int32_t chart = t->chart[i];
        if (!is_same_chart(t, row - 1, column, chart) || !is_same_chart(t, row + 1, column, chart) ||
            !is_same_chart(t, row, column - 1, chart) || !is_same_chart(t, row, column + 1, chart))
            t->flags[i] |= TEXEL_BOUNDARY;
    }
}

int texels_rasterise(struct texels *out, const struct mesh *mesh, int size)
{
    int err = -EINVAL;
    float(*tangents)[3] = NULL;
    struct texels t = { .size = size };
    memset(out, 0, sizeof(*out));
    if (size < 1 || size > SIZE_MAX_TEXELS) {
        log_error("texels: a texture of %d x %d texels; expected 1 to %d", size, size, SIZE_MAX_TEXELS);
        return err;
    }
    const struct grid g = grid_of(size);
    const size_t n_pixels = (size_t)size * (size_t)size;
    err = -ENOMEM;
    t.index = malloc(n_pixels * sizeof(*t.index));
    if (!t.index)
        goto fail;
    memset(t.index, 0xff, n_pixels * sizeof(*t.index));
    // First the triangle of each texel (and whether there are several), then its compact index in the same place.
    int64_t n_in_range = 0;
    double area_m2 = 0;
    for (int i = 0; i < mesh->n_triangles; i++) {
        struct outline o;
        if (!outline_of(&o, mesh, i, g))
            continue;
        const bool in_range = is_in_unit_square(mesh, i);
        if (in_range)
            area_m2 += triangle_area_m2(mesh, i);
        int row, top, first, last;
        for (rows_of(&o, g, &row, &top); row <= top; row++) {
            columns_of(&o, g, row, &first, &last);
            int32_t *line = t.index + (size_t)(size - 1 - row) * (size_t)size;
            for (int x = first; x <= last; x++) {
                t.n += line[x] < 0;
                line[x] = line[x] < 0 ? i : line[x] | OVERLAPPED;
            }
            if (in_range)
                n_in_range += last - first + 1;
        }
    }
    if (!t.n) {
        log_error("texels: no triangle covers the centre of a texel at %d x %d: unwrap the mesh into [0,1], or ask for a "
                  "larger texture", size, size);
        err = -EINVAL;
        goto fail;
    }
    const size_t n = (size_t)t.n;
    t.pixel = malloc(n * sizeof(*t.pixel));
    t.position_m = malloc(n * sizeof(*t.position_m));
    t.normal = malloc(n * sizeof(*t.normal));
    t.tangent = malloc(n * sizeof(*t.tangent));
    t.barycentric = malloc(n * sizeof(*t.barycentric));
    t.triangle = malloc(n * sizeof(*t.triangle));
    t.chart = malloc(n * sizeof(*t.chart));
    t.flags = calloc(n, sizeof(*t.flags));
    tangents = vertex_tangents(mesh);
    if (!t.pixel || !t.position_m || !t.normal || !t.tangent || !t.barycentric || !t.triangle || !t.chart ||
        !t.flags || !tangents)
        goto fail;
    int i = 0, outlined = -1;
    struct outline o;
    for (size_t pixel = 0; pixel < n_pixels; pixel++) {
        const int32_t owner = t.index[pixel];
        if (owner < 0)
            continue;
        t.flags[i] = owner & OVERLAPPED ? TEXEL_OVERLAP : 0;
        t.triangle[i] = (uint32_t)(owner & ~OVERLAPPED);
        t.pixel[i] = (uint32_t)pixel;
        t.index[pixel] = i;
        if (outlined != (int)t.triangle[i]) {
            outlined = (int)t.triangle[i];
            const bool has_area = outline_of(&o, mesh, outlined, g);
            assert(has_area);
            (void)has_area;
        }
        shade_texel(&t, i, mesh, &o, g, (const float(*)[3])tangents);
        i++;
    }
    flag_boundary(&t);
    t.texel_size_m = n_in_range ? (float)sqrt(area_m2 / (double)n_in_range) : 0;
    free(tangents);
    *out = t;
    return 0;
fail:
    free(tangents);
    texels_free(&t);
    return err;
}

void texels_free(struct texels *t)
{
    if (!t)
        return;
    free(t->index);
    free(t->pixel);
    free(t->position_m);
    free(t->normal);
    free(t->tangent);
    free(t->barycentric);
    free(t->triangle);
    free(t->chart);
    free(t->flags);
    memset(t, 0, sizeof(*t));
}

// near[row][column]: row of the nearest covered texel of the same column (ties to the upper), or -1 if further than radius.
static void nearest_in_columns(int16_t *near, const struct texels *t, int radius)
{
    const int size = t->size;
    for (int column = 0; column < size; column++) {
        int above = -1;
        for (int row = 0; row < size; row++) {
            const size_t i = (size_t)row * (size_t)size + (size_t)column;
            if (t->index[i] >= 0)
                above = row;
            near[i] = (int16_t)(above >= 0 && row - above <= radius ? above : -1);
        }
        int below = -1;
        for (int row = size - 1; row >= 0; row--) {
            const size_t i = (size_t)row * (size_t)size + (size_t)column;
            if (t->index[i] >= 0)
                below = row;
            if (below >= 0 && below - row <= radius && (near[i] < 0 || below - row < row - near[i]))
                near[i] = (int16_t)below;
        }
    }
}

int texels_fill_gutter(const struct texels *t, float *image, int n_channels, int radius_px)
{
    const int size = t->size;
    const int radius = radius_px < 2 * size ? radius_px : 2 * size; // nothing is further away
    if (radius <= 0)
        return 0;
    int16_t *near = malloc((size_t)size * (size_t)size * sizeof(*near));
    if (!near)
        return -ENOMEM;
    nearest_in_columns(near, t, radius);
    for (int row = 0; row < size; row++)
        for (int column = 0; column < size; column++) {
            const size_t line = (size_t)row * (size_t)size;
            if (t->index[line + (size_t)column] >= 0)
                continue;
            int64_t best2 = (int64_t)radius * radius;
            size_t best = SIZE_MAX;
            for (int dx = 0; (int64_t)dx * dx <= best2 && dx < size; dx++)
                for (int side = -1; side <= 1; side += 2) {
                    const int x = column + side * dx;
                    if (x < 0 || x >= size || near[line + (size_t)x] < 0)
                        continue;
                    const int64_t dy = near[line + (size_t)x] - row, d2 = (int64_t)dx * dx + dy * dy;
                    const size_t from = (size_t)near[line + (size_t)x] * (size_t)size + (size_t)x;
                    if (d2 < best2 || (d2 == best2 && from < best))
                        best2 = d2, best = from;
                }
            if (best != SIZE_MAX)
                memcpy(image + (line + (size_t)column) * (size_t)n_channels, image + best * (size_t)n_channels,
                       (size_t)n_channels * sizeof(*image));
        }
    free(near);
    return 0;
}
