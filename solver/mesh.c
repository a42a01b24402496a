// solver/mesh.c - what follows from triangles and an atlas: points, normals, charts, bounds; the check; OBJ output.
//
// Edges and points are found by hashing exact bits, never by a distance: a tolerance would weld what the modeller kept apart.
#include "solver/mesh.h"
#include "solver/mesh_import.h"
#include "solver/random.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/texels.h"
#include "solver/vec3.h"

#include <assert.h>
#include <errno.h>
#include <locale.h>
#include <stdlib.h>
#include <string.h>

enum { CHECK_SIZE = 1024, MAX_TRIANGLES = 1 << 26, MAX_VERTICES = 3 * MAX_TRIANGLES };
static const double out_of_range_uv = 1e-5;
// A triangle lower than this share of its longest side has no area: float coordinates cannot tell it from a line.
static const double flat_ratio = 1e-10;

int64_t mesh_number_distinct(uint32_t *ids, const void *items, size_t n_words, size_t n)
{
    const uint32_t *words = items;
    size_t n_slots = 16;
    while (n_slots < 2 * n)
        n_slots *= 2;
    uint32_t *slots = malloc(n_slots * sizeof(*slots)); // index of the first such item, or all ones
    if (!slots)
        return -ENOMEM;
    memset(slots, 0xff, n_slots * sizeof(*slots));
    uint32_t n_distinct = 0;
    for (size_t i = 0; i < n; i++) {
        const uint32_t *item = words + i * n_words;
        uint64_t hash = 0;
        for (size_t w = 0; w < n_words; w++)
            hash = random_mix(hash ^ item[w]);
        size_t s = hash & (n_slots - 1);
        while (slots[s] != UINT32_MAX && memcmp(words + slots[s] * n_words, item, n_words * sizeof(*item)))
            s = (s + 1) & (n_slots - 1);
        if (slots[s] == UINT32_MAX) {
            slots[s] = (uint32_t)i;
            ids[i] = n_distinct++;
        } else {
            ids[i] = ids[slots[s]];
        }
    }
    free(slots);
    return n_distinct;
}

static void edge_between(double out[3], const struct mesh *m, uint32_t from, uint32_t to)
{
    for (int c = 0; c < 3; c++)
        out[c] = (double)m->position_m[to][c] - m->position_m[from][c];
}

// Twice the area along the normal; false: no area.
static bool triangle_cross(double cross[3], const struct mesh *m, const uint32_t t[3])
{
    double a[3], b[3], c[3];
    edge_between(a, m, t[0], t[1]);
    edge_between(b, m, t[0], t[2]);
    edge_between(c, m, t[1], t[2]);
    vec3_cross(cross, a, b);
    const double longest2 = fmax(vec3_dot(a, a), fmax(vec3_dot(b, b), vec3_dot(c, c)));
    return vec3_norm(cross) > flat_ratio * longest2;
}

bool mesh_triangle_has_area(const struct mesh *m, int triangle)
{
    double cross[3];
    return triangle_cross(cross, m, m->triangle[triangle]);
}

// Twice the signed area in UV; 0 where there is none.
static double uv_cross(const struct mesh *m, const uint32_t t[3])
{
    const float *p = m->uv[t[0]], *q = m->uv[t[1]], *r = m->uv[t[2]];
    const double a[2] = { (double)q[0] - p[0], (double)q[1] - p[1] };
    const double b[2] = { (double)r[0] - p[0], (double)r[1] - p[1] };
    const double c[2] = { (double)r[0] - q[0], (double)r[1] - q[1] };
    const double longest2 = fmax(a[0] * a[0] + a[1] * a[1],
                                 fmax(b[0] * b[0] + b[1] * b[1], c[0] * c[0] + c[1] * c[1]));
    const double cross = a[0] * b[1] - a[1] * b[0];
    return fabs(cross) > flat_ratio * longest2 ? cross : 0;
}

static double angle_between(const double a[3], const double b[3])
{
    double cross[3];
    vec3_cross(cross, a, b);
    return atan2(vec3_norm(cross), vec3_dot(a, b));
}

// Each vertex without a usable normal gets the mean of the faces at its point, weighted by their angle there: a seam of the
// atlas is no crease.
static int fill_normals(struct mesh *m)
{
    double(*sum)[3] = calloc((size_t)m->n_points, sizeof(*sum));
    if (!sum)
        return -ENOMEM;
    for (int i = 0; i < m->n_triangles; i++) {
        const uint32_t *t = m->triangle[i];
        double n[3];
        if (!triangle_cross(n, m, t))
            continue;
        vec3_normalise(n);
        for (int k = 0; k < 3; k++) {
            double a[3], b[3];
            edge_between(a, m, t[k], t[(k + 1) % 3]);
            edge_between(b, m, t[k], t[(k + 2) % 3]);
            double *s = sum[m->point[t[k]]];
            vec3_add_scaled(s, s, angle_between(a, b), n);
        }
    }
    for (int i = 0; i < m->n_vertices; i++) {
        float *out = m->normal[i];
        double n[3] = { out[0], out[1], out[2] };
        const double length = vec3_norm(n);
        if (fabs(length - 1) < 1e-6)
            continue;
        if (!(length > 1e-6 && length < 1e30)) {
            memcpy(n, sum[m->point[i]], sizeof(n));
            if (vec3_norm(n) < 1e-9) // no face there, or faces that cancel out
                n[0] = n[1] = 0, n[2] = 1;
        }
        vec3_normalise(n);
        for (int c = 0; c < 3; c++)
            out[c] = (float)n[c];
    }
    free(sum);
    return 0;
}

// edge[3 i + k]: number of the edge from corner k to k + 1 of triangle i, where corners are told apart by id[vertex].
static int64_t number_edges(uint32_t *edge, const struct mesh *m, const uint32_t *id)
{
    const size_t n = 3 * (size_t)m->n_triangles;
    uint32_t(*ends)[2] = malloc(n * sizeof(*ends));
    if (!ends)
        return -ENOMEM;
    for (size_t i = 0; i < n; i++) {
        const uint32_t *t = m->triangle[i / 3];
        const uint32_t a = id[t[i % 3]], b = id[t[(i + 1) % 3]];
        ends[i][0] = a < b ? a : b, ends[i][1] = a < b ? b : a;
    }
    const int64_t n_edges = mesh_number_distinct(edge, ends, 2, n);
    free(ends);
    return n_edges;
}

static int32_t find_root(int32_t *parent, int32_t i)
{
    while (parent[i] != i)
        i = parent[i] = parent[parent[i]];
    return i;
}

static int fill_charts(struct mesh *m)
{
    int err = -ENOMEM;
    const size_t n_corners = 3 * (size_t)m->n_triangles;
    uint32_t(*place)[3] = malloc((size_t)m->n_vertices * sizeof(*place)); // point and UV of each vertex
    uint32_t *id = malloc((size_t)m->n_vertices * sizeof(*id));
    uint32_t *edge = malloc(n_corners * sizeof(*edge));
    int32_t *first = NULL; // [edge] a triangle that has it
    if (!place || !id || !edge)
        goto fail;
    for (int i = 0; i < m->n_vertices; i++) {
        place[i][0] = m->point[i];
        memcpy(place[i] + 1, m->uv[i], sizeof(m->uv[i]));
    }
    if (mesh_number_distinct(id, place, 3, (size_t)m->n_vertices) < 0)
        goto fail;
    const int64_t n_edges = number_edges(edge, m, id);
    if (n_edges < 0)
        goto fail;
    first = malloc((size_t)n_edges * sizeof(*first));
    if (!first)
        goto fail;
    memset(first, 0xff, (size_t)n_edges * sizeof(*first));
    int32_t *parent = m->chart; // until the charts are numbered
    for (int i = 0; i < m->n_triangles; i++)
        parent[i] = i;
    for (size_t i = 0; i < n_corners; i++) {
        const uint32_t *t = m->triangle[i / 3];
        if (id[t[i % 3]] == id[t[(i + 1) % 3]])
            continue;
        if (first[edge[i]] < 0) {
            first[edge[i]] = (int32_t)(i / 3);
            continue;
        }
        const int32_t a = find_root(parent, first[edge[i]]), b = find_root(parent, (int32_t)(i / 3));
        if (a != b)
            parent[a > b ? a : b] = a > b ? b : a; // the root is the lowest triangle
    }
    for (int i = 0; i < m->n_triangles; i++) // roots come before their members, already as ~number
        m->chart[i] = parent[i] == i ? ~m->n_charts++ : m->chart[parent[i]];
    for (int i = 0; i < m->n_triangles; i++)
        m->chart[i] = ~m->chart[i];
    err = 0;
fail:
    free(place);
    free(id);
    free(edge);
    free(first);
    return err;
}

int mesh_from_arrays(struct mesh *out, int n_vertices, float (*position_m)[3], float (*normal)[3],
                     float (*uv)[2], int n_triangles, uint32_t (*triangle)[3])
{
    int err = -EINVAL;
    struct mesh m = {
        .n_vertices = n_vertices, .n_triangles = n_triangles,
        .position_m = position_m, .normal = normal, .uv = uv, .triangle = triangle,
    };
    if (n_vertices < 1 || n_vertices > MAX_VERTICES || n_triangles < 1 || n_triangles > MAX_TRIANGLES) {
        log_error("mesh: %d vertices and %d triangles; expected 1 to %d and 1 to %d", n_vertices, n_triangles,
                  MAX_VERTICES, MAX_TRIANGLES);
        goto fail;
    }
    for (int i = 0; i < n_vertices; i++) {
        float *p = position_m[i], *t = uv[i];
        if (!isfinite(p[0]) || !isfinite(p[1]) || !isfinite(p[2]) || !isfinite(t[0]) || !isfinite(t[1])) {
            log_error("mesh: vertex %d: position (%g, %g, %g), UV (%g, %g): expected finite numbers", i,
                      (double)p[0], (double)p[1], (double)p[2], (double)t[0], (double)t[1]);
            goto fail;
        }
        for (int c = 0; c < 3; c++)
            p[c] += 0.f; // -0 becomes +0: equal places have equal bits
        t[0] += 0.f, t[1] += 0.f;
    }
    for (int i = 0; i < n_triangles; i++)
        for (int k = 0; k < 3; k++)
            if (triangle[i][k] >= (uint32_t)n_vertices) {
                log_error("mesh: triangle %d: vertex %u of %d does not exist", i, triangle[i][k], n_vertices);
                goto fail;
            }
    err = -ENOMEM;
    if (!m.normal)
        m.normal = calloc((size_t)n_vertices, sizeof(*m.normal));
    m.point = malloc((size_t)n_vertices * sizeof(*m.point));
    m.chart = malloc((size_t)n_triangles * sizeof(*m.chart));
    if (!m.normal || !m.point || !m.chart)
        goto fail;
    const int64_t n_points = mesh_number_distinct(m.point, position_m, 3, (size_t)n_vertices);
    if (n_points < 0)
        goto fail;
    m.n_points = (int)n_points;
    err = fill_normals(&m);
    if (!err)
        err = fill_charts(&m);
    if (err)
        goto fail;
    for (int c = 0; c < 3; c++) { // over the triangles: a stray vertex counts for nothing
        m.bounds_m[0][c] = m.bounds_m[1][c] = position_m[triangle[0][0]][c];
        for (int i = 0; i < 3 * n_triangles; i++) {
            const double x = position_m[triangle[i / 3][i % 3]][c];
            m.bounds_m[0][c] = fmin(m.bounds_m[0][c], x);
            m.bounds_m[1][c] = fmax(m.bounds_m[1][c], x);
        }
    }
    *out = m;
    return 0;
fail:
    mesh_free(&m);
    memset(out, 0, sizeof(*out));
    return err;
}

static int check_edges(struct mesh_check *check, const struct mesh *m)
{
    int err = -ENOMEM;
    uint32_t *n_uses = NULL;
    uint32_t *edge = malloc(3 * (size_t)m->n_triangles * sizeof(*edge));
    if (!edge)
        return err;
    const int64_t n_edges = number_edges(edge, m, m->point);
    if (n_edges < 0)
        goto fail;
    n_uses = calloc((size_t)n_edges, sizeof(*n_uses));
    if (!n_uses)
        goto fail;
    for (size_t i = 0; i < 3 * (size_t)m->n_triangles; i++) {
        const uint32_t *t = m->triangle[i / 3];
        if (m->point[t[i % 3]] != m->point[t[(i + 1) % 3]])
            n_uses[edge[i]]++;
    }
    for (int64_t i = 0; i < n_edges; i++) {
        check->n_boundary_edges += n_uses[i] == 1;
        check->n_non_manifold_edges += n_uses[i] > 2;
    }
    err = 0;
fail:
    free(edge);
    free(n_uses);
    return err;
}

static int check_overlap(struct mesh_check *check, const struct mesh *m)
{
    const size_t n = (size_t)CHECK_SIZE * CHECK_SIZE;
    uint8_t *count = malloc(n);
    if (!count)
        return -ENOMEM;
    texels_count_cover(count, m, CHECK_SIZE);
    int64_t n_covered = 0, n_overlapping = 0;
    for (size_t i = 0; i < n; i++)
        n_covered += count[i] > 0, n_overlapping += count[i] > 1;
    check->overlap_fraction = n_covered ? (double)n_overlapping / (double)n_covered : 0;
    free(count);
    return 0;
}

void mesh_check_run(const struct mesh *m, struct mesh_check *check)
{
    *check = (struct mesh_check){ .n_charts = m->n_charts };
    for (int i = 0; i < m->n_triangles; i++) {
        const uint32_t *t = m->triangle[i];
        double cross[3];
        if (!triangle_cross(cross, m, t)) {
            check->n_zero_area++;
            continue;
        }
        bool outside = false, missing = true;
        for (int k = 0; k < 3; k++) {
            const float *uv = m->uv[t[k]];
            missing = missing && uv[0] == 0 && uv[1] == 0;
            for (int c = 0; c < 2; c++)
                outside = outside || uv[c] < -out_of_range_uv || uv[c] > 1 + out_of_range_uv;
        }
        const double uv_area = uv_cross(m, t);
        check->n_missing_uv += missing;
        check->n_zero_area_uv += !missing && uv_area == 0;
        check->n_mirrored_uv += uv_area < 0;
        check->n_out_of_range_uv += outside;
    }
    if (check_edges(check, m) || check_overlap(check, m))
        log_warning("mesh: not enough memory to check edges and overlaps of %d triangles", m->n_triangles);
}

void mesh_check_log(const struct mesh_check *check, const struct mesh *m, const char *path)
{
    const int n = m->n_triangles;
    if (check->n_zero_area)
        log_warning("mesh: %s: %d triangles without area in 3-D, beside %d with: dropped", path,
                    check->n_zero_area, n);
    if (check->n_missing_uv)
        log_warning("mesh: %s: %d of %d triangles have no UVs: they get no texture; unwrap them", path,
                    check->n_missing_uv, n);
    if (check->n_zero_area_uv)
        log_warning("mesh: %s: %d of %d triangles have no area in UV: they get no texture; unwrap them", path,
                    check->n_zero_area_uv, n);
    if (check->n_out_of_range_uv)
        log_warning("mesh: %s: %d of %d triangles have UVs outside [0,1]: what lies outside gets no texture; "
                    "pack the atlas into one tile", path, check->n_out_of_range_uv, n);
    if (check->n_mirrored_uv)
        log_warning("mesh: %s: %d of %d triangles have mirrored UVs: %s", path, check->n_mirrored_uv, n,
                    2 * check->n_mirrored_uv > n ?
                    "the whole atlas seems upside down: check that the exporter wrote v the way the format says" :
                    "textures are solved all the same; tangent-space normal maps need a renderer that keeps handedness");
    if (check->overlap_fraction > 0)
        log_warning("mesh: %s: %.3g %% of the atlas (at %d x %d) is covered by several triangles: each texel goes to "
                    "the first of them; unwrap without overlap", path, 100 * check->overlap_fraction,
                    CHECK_SIZE, CHECK_SIZE);
    if (check->n_non_manifold_edges)
        log_warning("mesh: %s: %d edges belong to more than two triangles: shadows there may be doubtful", path,
                    check->n_non_manifold_edges);
    if (check->n_boundary_edges)
        log_warning("mesh: %s: %d edges belong to one triangle only: the surface is open, light may pass "
                    "behind it; close holes that are not real", path, check->n_boundary_edges);
}

int mesh_write_obj(const struct mesh *m, const char *path)
{
    struct atomic_file f;
    int err = atomic_file_open(&f, path);
    if (err)
        return err;
    const locale_t c_locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    if (!c_locale) {
        atomic_file_abandon(&f);
        log_error("mesh: cannot write %s: %s", path, strerror(ENOMEM));
        return -ENOMEM;
    }
    const locale_t before = uselocale(c_locale); // a decimal point, whatever the user's language
    for (int i = 0; i < m->n_vertices; i++) {
        const float *p = m->position_m[i], *t = m->uv[i], *n = m->normal[i];
        fprintf(f.stream, "v %.9g %.9g %.9g\nvt %.9g %.9g\nvn %.9g %.9g %.9g\n", (double)p[0], (double)p[1],
                (double)p[2], (double)t[0], (double)t[1], (double)n[0], (double)n[1], (double)n[2]);
    }
    for (int i = 0; i < m->n_triangles; i++) {
        const uint32_t a = m->triangle[i][0] + 1, b = m->triangle[i][1] + 1, c = m->triangle[i][2] + 1;
        fprintf(f.stream, "f %u/%u/%u %u/%u/%u %u/%u/%u\n", a, a, a, b, b, b, c, c, c);
    }
    uselocale(before);
    freelocale(c_locale);
    return atomic_file_commit(&f);
}

void mesh_free(struct mesh *m)
{
    if (!m)
        return;
    free(m->position_m);
    free(m->normal);
    free(m->uv);
    free(m->triangle);
    free(m->point);
    free(m->chart);
    memset(m, 0, sizeof(*m));
}
