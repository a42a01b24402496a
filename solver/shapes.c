// solver/shapes.c - objects made by code: a pebble, a vase, a knot, a bowl, each with its UV atlas.
//
// Every shape is a handful of grids ("charts"). A chart's vertices carry a place, a normal and a
// flat position in metres; grids that meet compute the place of a shared border from the same
// integers, so both get the same bits and the mesh closes. At the end the charts' flat boxes are
// packed into the unit square at one common scale.
#include "solver/shapes.h"
#include "solver/vec3.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

const char *const shape_names[SHAPE_N] = {"pebble", "vase", "knot", "bowl"};

enum { MAX_CHARTS = 32, PROFILE_STEPS = 8192 };
// Between charts, and to the border of the atlas. A texture that is read bilinearly on one chart never
// shows the colour of the next (its gutter filled) where this is more than two texels: from 128 on.
static const double MARGIN_UV = 1. / 48;

struct chart_box {
    double min[2], max[2]; // flat, same unit as the place
    double shift[2];       // uv = (flat - min) * scale + shift
};

struct builder {
    int n_vertices, n_triangles, n_charts;
    int max_vertices, max_triangles;
    double (*place)[3], (*normal)[3], (*flat)[2];
    int *chart;
    uint32_t (*triangle)[3];
    struct chart_box box[MAX_CHARTS];
};

static void builder_free(struct builder *b)
{
    free(b->place), free(b->normal), free(b->flat), free(b->chart), free(b->triangle);
    *b = (struct builder){0};
}

static int builder_new(struct builder *b, int max_vertices, int max_triangles)
{
    *b = (struct builder){.max_vertices = max_vertices, .max_triangles = max_triangles};
    const size_t n = (size_t)max_vertices;
    b->place = malloc(n * sizeof(*b->place));
    b->normal = malloc(n * sizeof(*b->normal));
    b->flat = malloc(n * sizeof(*b->flat));
    b->chart = malloc(n * sizeof(*b->chart));
    b->triangle = malloc((size_t)max_triangles * sizeof(*b->triangle));
    if (b->place && b->normal && b->flat && b->chart && b->triangle)
        return 0;
    builder_free(b);
    return -ENOMEM;
}

static void begin_chart(struct builder *b)
{
    assert(b->n_charts < MAX_CHARTS);
    b->box[b->n_charts++] = (struct chart_box){{INFINITY, INFINITY}, {-INFINITY, -INFINITY}, {0}};
}

static uint32_t add_vertex(struct builder *b, const double place[3], const double normal[3],
                           double x, double y)
{
    assert(b->n_vertices < b->max_vertices);
    const int i = b->n_vertices++;
    struct chart_box *box = &b->box[b->n_charts - 1];
    for (int k = 0; k < 3; k++)
        b->place[i][k] = place[k], b->normal[i][k] = normal[k];
    b->flat[i][0] = x, b->flat[i][1] = y;
    b->chart[i] = b->n_charts - 1;
    for (int k = 0; k < 2; k++) {
        box->min[k] = fmin(box->min[k], b->flat[i][k]);
        box->max[k] = fmax(box->max[k], b->flat[i][k]);
    }
    return (uint32_t)i;
}

static void add_triangle(struct builder *b, uint32_t i, uint32_t j, uint32_t k)
{
    assert(b->n_triangles < b->max_triangles);
    uint32_t *t = b->triangle[b->n_triangles++];
    t[0] = i, t[1] = j, t[2] = k;
}

// A grid of (n_columns + 1) x (n_rows + 1) vertices, added row by row from `first`; columns x rows
// is outwards.
static void add_grid_triangles(struct builder *b, uint32_t first, int n_columns, int n_rows)
{
    const uint32_t stride = (uint32_t)n_columns + 1;
    for (int j = 0; j < n_rows; j++) {
        for (int i = 0; i < n_columns; i++) {
            const uint32_t a = first + (uint32_t)j * stride + (uint32_t)i;
            add_triangle(b, a, a + 1, a + 1 + stride);
            add_triangle(b, a, a + 1 + stride, a + stride);
        }
    }
}

// Shelves: charts in order, left to right, a new shelf where the next does not fit.
static int pack_at(struct builder *b, double scale)
{
    double x = MARGIN_UV, y = MARGIN_UV, shelf = 0;
    for (int c = 0; c < b->n_charts; c++) {
        struct chart_box *box = &b->box[c];
        const double w = scale * (box->max[0] - box->min[0]),
                     h = scale * (box->max[1] - box->min[1]);
        if (x > MARGIN_UV && x + w + MARGIN_UV > 1)
            x = MARGIN_UV, y += shelf + MARGIN_UV, shelf = 0;
        if (x + w + MARGIN_UV > 1 || y + h + MARGIN_UV > 1)
            return 0;
        box->shift[0] = x, box->shift[1] = y;
        x += w + MARGIN_UV;
        shelf = fmax(shelf, h);
    }
    return 1;
}

// The largest scale whose shelves fit (coarse sweep: whether they fit is not monotonic in the
// scale).
static double pack(struct builder *b)
{
    double largest = 0;
    for (int c = 0; c < b->n_charts; c++)
        for (int k = 0; k < 2; k++)
            largest = fmax(largest, b->box[c].max[k] - b->box[c].min[k]);
    double scale = 1 / largest;
    while (!pack_at(b, scale))
        scale *= .995;
    return scale;
}

// Bounding box to centre_m, bounding sphere about it to radius_m, atlas packed, handed over to the
// mesh.
static int finish(struct mesh *out, struct builder *b, const double centre_m[3], double radius_m)
{
    double low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
    double middle[3], radius = 0;
    for (int i = 0; i < b->n_vertices; i++)
        for (int k = 0; k < 3; k++)
            low[k] = fmin(low[k], b->place[i][k]), high[k] = fmax(high[k], b->place[i][k]);
    for (int k = 0; k < 3; k++)
        middle[k] = (low[k] + high[k]) / 2;
    for (int i = 0; i < b->n_vertices; i++) {
        double d[3];
        vec3_sub(d, b->place[i], middle);
        radius = fmax(radius, vec3_norm(d));
    }
    const double scale_uv = pack(b), scale = radius_m / radius;
    float(*position_m)[3] = malloc((size_t)b->n_vertices * sizeof(*position_m));
    float(*normal)[3] = malloc((size_t)b->n_vertices * sizeof(*normal));
    float(*uv)[2] = malloc((size_t)b->n_vertices * sizeof(*uv));
    uint32_t(*triangle)[3] = malloc((size_t)b->n_triangles * sizeof(*triangle));
    if (!position_m || !normal || !uv || !triangle) {
        free(position_m), free(normal), free(uv), free(triangle);
        return -ENOMEM;
    }
    for (int i = 0; i < b->n_vertices; i++) {
        const struct chart_box *box = &b->box[b->chart[i]];
        vec3_normalise(b->normal[i]);
        for (int k = 0; k < 3; k++) {
            position_m[i][k] = (float)(centre_m[k] + scale * (b->place[i][k] - middle[k]));
            normal[i][k] = (float)b->normal[i][k];
        }
        for (int k = 0; k < 2; k++)
            uv[i][k] = (float)((b->flat[i][k] - box->min[k]) * scale_uv + box->shift[k]);
    }
    memcpy(triangle, b->triangle, (size_t)b->n_triangles * sizeof(*triangle));
    return mesh_from_arrays(out, b->n_vertices, position_m, normal, uv, b->n_triangles, triangle);
}

// ---- pebble: a convex body by its support function ----------------------------------------------
//
// h(n) is how far the body reaches along n. Then the surface point with normal n is the gradient of
// h, made homogeneous of degree one, and the body is convex while h's second derivatives stay
// positive. For h = P(n) / |n|^(k-1) with P of degree k the gradient at a unit n is grad P - (k -
// 1) P n. So the normals are exact: they are the parameter.
static void pebble_place(double place[3], const double n[3])
{
    static const double axes[3] = {1, .8, .68}; // ellipsoid: h = |axes * n|
    const double x = n[0], y = n[1], z = n[2];
    double e[3] = {axes[0] * x, axes[1] * y, axes[2] * z};
    const double h = vec3_norm(e);
    for (int k = 0; k < 3; k++)
        place[k] = axes[k] * axes[k] * n[k] / h;
    const double cubic = .055 * (x * y * z) + .03 * (z * z * z - x * x * y);
    const double cubic_gradient[3] = {.055 * y * z - .06 * x * y, .055 * x * z - .03 * x * x,
                                      .055 * x * y + .09 * z * z};
    const double quartic = .03 * (x * x * x * y - y * y * y * z);
    const double quartic_gradient[3] = {.09 * x * x * y, .03 * x * x * x - .09 * y * y * z,
                                        -.03 * y * y * y};
    for (int k = 0; k < 3; k++)
        place[k] += cubic_gradient[k] - 2 * cubic * n[k] + quartic_gradient[k] - 3 * quartic * n[k];
}

static int make_pebble(struct builder *b, int detail)
{
    // Right, up and out of each face; right x up = out.
    static const int faces[6][3][3] = {
        {{0, 1, 0}, {0, 0, 1}, {1, 0, 0}},  {{0, -1, 0}, {0, 0, 1}, {-1, 0, 0}},
        {{-1, 0, 0}, {0, 0, 1}, {0, 1, 0}}, {{1, 0, 0}, {0, 0, 1}, {0, -1, 0}},
        {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}},  {{1, 0, 0}, {0, -1, 0}, {0, 0, -1}},
    };
    const int n = fmax(3, round(sqrt(detail / 12.)));
    int err = builder_new(b, 6 * (n + 1) * (n + 1), 12 * n * n);
    if (err)
        return err;
    for (int f = 0; f < 6; f++) {
        begin_chart(b);
        const uint32_t first = (uint32_t)b->n_vertices;
        for (int j = 0; j <= n; j++) {
            for (int i = 0; i <= n; i++) {
                // Equal angles per step. The exact 1 at the rim lets neighbouring faces agree to
                // the bit.
                const int a = 2 * i - n, c = 2 * j - n;
                const double s = a == n ? 1 : a == -n ? -1 : tan(M_PI / 4 * a / n);
                const double t = c == n ? 1 : c == -n ? -1 : tan(M_PI / 4 * c / n);
                double d[3], place[3];
                for (int k = 0; k < 3; k++)
                    d[k] = faces[f][0][k] * s + faces[f][1][k] * t + faces[f][2][k];
                vec3_normalise(d);
                pebble_place(place, d);
                add_vertex(b, place, d, a, c);
            }
        }
        add_grid_triangles(b, first, n, n);
    }
    return 0;
}

// ---- vase and bowl: a closed profile turned about z ---------------------------------------------
//
// The profile (r, z) is a uniform cubic B-spline from the lower pole to the upper pole; its control
// points are mirrored at both poles, so the surface is smooth there. Charts: a disc about each
// pole, and between them bands of wall in two halves.
struct profile {
    int n_control;
    double control[16][2];
    double r[PROFILE_STEPS + 1], z[PROFILE_STEPS + 1],
        s[PROFILE_STEPS + 1]; // sampled; s: arc length
};

static void control_point(const struct profile *p, int i, double out[2])
{
    const int last = p->n_control - 1;
    const double *c = i < 0      ? p->control[-i - 1]
                      : i > last ? p->control[2 * last + 1 - i]
                                 : p->control[i];
    out[0] = i < 0 || i > last ? -c[0] : c[0];
    out[1] = c[1];
}

static void sample_profile(struct profile *p)
{
    // The mirror lies half way between control points 0 and -1: knots run from there over n_control
    // whole spans.
    for (int i = 0; i <= PROFILE_STEPS; i++) {
        const double t = (double)p->n_control * i / PROFILE_STEPS - .5;
        const int span = (int)floor(t);
        const double f = t - span, g = 1 - f;
        const double w[4] = {g * g * g / 6, (3 * f * f * f - 6 * f * f + 4) / 6,
                             (3 * g * g * g - 6 * g * g + 4) / 6, f * f * f / 6};
        double at[2] = {0, 0};
        for (int k = 0; k < 4; k++) {
            double c[2];
            control_point(p, span - 1 + k, c);
            at[0] += w[k] * c[0], at[1] += w[k] * c[1];
        }
        p->r[i] = i == 0 || i == PROFILE_STEPS ? 0 : at[0]; // on the axis to the bit
        p->z[i] = at[1];
        p->s[i] = i ? p->s[i - 1] + hypot(p->r[i] - p->r[i - 1], p->z[i] - p->z[i - 1]) : 0;
    }
}

// Radius, height and normal (n_r, n_z) at arc length s.
static void profile_at(const struct profile *p, double s, double *r, double *z, double normal[2])
{
    int low = 0, high = PROFILE_STEPS;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (p->s[middle] <= s)
            low = middle;
        else
            high = middle;
    }
    const double f = (s - p->s[low]) / (p->s[high] - p->s[low]);
    *r = p->r[low] + f * (p->r[high] - p->r[low]);
    *z = p->z[low] + f * (p->z[high] - p->z[low]);
    double slope[2][2]; // central differences at both ends, blended; beyond a pole the profile is
                        // its own mirror image
    for (int e = 0; e < 2; e++) {
        const int i = low + e, i0 = i > 0 ? i - 1 : 1,
                  i1 = i < PROFILE_STEPS ? i + 1 : PROFILE_STEPS - 1;
        slope[e][0] = (i < PROFILE_STEPS ? p->r[i1] : -p->r[i1]) - (i > 0 ? p->r[i0] : -p->r[i0]);
        slope[e][1] = p->z[i1] - p->z[i0];
    }
    normal[0] = slope[0][1] + f * (slope[1][1] - slope[0][1]);
    normal[1] = -(slope[0][0] + f * (slope[1][0] - slope[0][0]));
}

struct turned {
    struct profile profile;
    int n_around, n_rows; // n_around even
    double step;          // arc length per row
};

// Vertex of row j at the column'th step around; everything from the integers, so shared borders
// agree.
static void turned_at(const struct turned *t, int column, int j, double place[3], double normal[3])
{
    double r, z, n[2];
    const double length = t->profile.s[PROFILE_STEPS];
    profile_at(&t->profile, j == t->n_rows ? length : t->step * j, &r, &z, n);
    if (j == 0 || j == t->n_rows)
        r = 0, n[0] = 0;
    const double angle = 2 * M_PI * (column % t->n_around) / t->n_around;
    const double x = cos(angle), y = sin(angle);
    place[0] = r * x, place[1] = r * y, place[2] = z;
    normal[0] = n[0] * x, normal[1] = n[0] * y, normal[2] = n[1];
}

// The disc about a pole, rows 0..rim (lower) or rim..n_rows (upper), flattened so that lengths from
// the pole are kept.
static void add_disc(struct builder *b, const struct turned *t, bool upper, int rim)
{
    const int n_rings = upper ? t->n_rows - rim : rim;
    const double turn = upper ? 1 : -1; // the lower disc is seen from below
    double place[3], normal[3];
    begin_chart(b);
    turned_at(t, 0, upper ? t->n_rows : 0, place, normal);
    const uint32_t pole = add_vertex(b, place, normal, 0, 0);
    for (int k = 1; k <= n_rings; k++) {
        for (int i = 0; i < t->n_around; i++) {
            const double angle = 2 * M_PI * i / t->n_around;
            turned_at(t, i, upper ? t->n_rows - k : k, place, normal);
            add_vertex(b, place, normal, k * t->step * cos(angle), turn * k * t->step * sin(angle));
        }
    }
    for (int k = 0; k < n_rings; k++) {
        for (int i = 0; i < t->n_around; i++) {
            const int i1 = (i + 1) % t->n_around;
            const uint32_t outer = pole + 1 + (uint32_t)(k * t->n_around),
                           inner = outer - (uint32_t)t->n_around;
            const uint32_t a = inner + (uint32_t)i, c = inner + (uint32_t)i1,
                           d = outer + (uint32_t)i, e = outer + (uint32_t)i1;
            if (k == 0) {
                add_triangle(b, pole, upper ? d : e, upper ? e : d);
            } else if (upper) {
                add_triangle(b, a, d, e);
                add_triangle(b, a, e, c);
            } else {
                add_triangle(b, a, e, d);
                add_triangle(b, a, c, e);
            }
        }
    }
}

// cut[n_cuts]: where along the profile one chart ends and the next begins, as shares of its length.
static int make_turned(struct builder *b, int detail, const double (*control)[2], int n_control,
                       const double *cut, int n_cuts)
{
    struct turned *t = calloc(1, sizeof(*t));
    if (!t)
        return -ENOMEM;
    t->profile.n_control = n_control;
    memcpy(t->profile.control, control, (size_t)n_control * sizeof(*control));
    sample_profile(&t->profile);
    const double length = t->profile.s[PROFILE_STEPS];
    double widest = 0;
    for (int i = 0; i <= PROFILE_STEPS; i++)
        widest = fmax(widest, t->profile.r[i]);
    // 2 n_around n_rows triangles, cells square where the body is widest
    const double rows_per_column = length / (2 * M_PI * widest);
    t->n_around = 2 * (int)fmax(4, round(sqrt(detail / 2. / rows_per_column) / 2));
    t->n_rows = (int)fmax(8, round(detail / 2. / t->n_around));
    t->step = length / t->n_rows;
    const int n_half = t->n_around / 2;
    int row[8]; // where the charts meet: at least one row each
    for (int k = 0; k < n_cuts; k++) {
        row[k] = (int)fmax(k ? row[k - 1] + 1 : 1, round(cut[k] * t->n_rows));
        row[k] = (int)fmin(row[k], t->n_rows - n_cuts + k);
    }
    int err = builder_new(b, (t->n_around + 2) * (t->n_rows + 2 + n_cuts) + 2,
                          2 * t->n_around * t->n_rows);
    if (err)
        goto done;
    for (int part = 0; part < 2 * (n_cuts - 1); part++) {
        const int from = row[part / 2], to = row[part / 2 + 1], half = part % 2;
        const uint32_t first = (uint32_t)b->n_vertices;
        begin_chart(b);
        for (int j = from; j <= to; j++) {
            for (int i = 0; i <= n_half; i++) {
                double place[3], normal[3];
                turned_at(t, half * n_half + i, j, place, normal);
                // Rows keep their length, areas are kept (the sinusoidal map).
                const double r = hypot(place[0], place[1]);
                add_vertex(b, place, normal, r * M_PI * ((double)i / n_half - .5), t->step * j);
            }
        }
        add_grid_triangles(b, first, n_half, to - from);
    }
    add_disc(b, t, false, row[0]);
    add_disc(b, t, true, row[n_cuts - 1]);
done:
    free(t);
    return err;
}

static int make_vase(struct builder *b, int detail)
{
    static const double control[][2] = {
        {.16, 0}, {.42, 0},    {.6, .12},  {.82, .5},  {.8, .98},   {.48, 1.36}, {.32, 1.68},
        {.42, 2}, {.56, 2.14}, {.5, 2.28}, {.36, 2.2}, {.26, 1.95}, {.18, 1.76}, {.06, 1.72},
    };
    return make_turned(b, detail, control, sizeof(control) / sizeof(control[0]),
                       (const double[]){.1, .82}, 2);
}

static int make_bowl(struct builder *b, int detail)
{
    static const double control[][2] = {
        {.15, 0},  {.5, 0},   {.84, .12}, {1.04, .48}, {1.08, .9}, {1.04, 1.1},
        {.9, 1.1}, {.84, .9}, {.8, .52},  {.6, .27},   {.2, .2},
    };
    return make_turned(b, detail, control, sizeof(control) / sizeof(control[0]),
                       (const double[]){.16, .56, .79}, 3);
}

// ---- knot: a tube along a (2,3) torus knot ------------------------------------------------------
//
// The tube's frame is the torus' own normal and its product with the tangent: both close after one
// turn of the parameter. The tube is cut into N_PIECES pieces of equal length, each unrolled to a
// rectangle: one chart each.
enum { N_PIECES = 24, KNOT_STEPS = 16384 };

static void knot_frame(double t, double at[3], double tangent[3], double normal[3])
{
    const double R = 1, r = .42;
    const double a = 2 * t, c = 3 * t; // about the axis, about the tube of the torus
    const double d = R + r * cos(c);
    at[0] = d * cos(a), at[1] = d * sin(a), at[2] = r * sin(c);
    tangent[0] = -3 * r * sin(c) * cos(a) - 2 * d * sin(a);
    tangent[1] = -3 * r * sin(c) * sin(a) + 2 * d * cos(a);
    tangent[2] = 3 * r * cos(c);
    normal[0] = cos(c) * cos(a), normal[1] = cos(c) * sin(a), normal[2] = sin(c);
}

static int make_knot(struct builder *b, int detail)
{
    const double tube = .24;
    double *s = malloc((KNOT_STEPS + 1) * sizeof(*s)); // arc length at t = 2 pi i / KNOT_STEPS
    if (!s)
        return -ENOMEM;
    s[0] = 0;
    for (int i = 1; i <= KNOT_STEPS; i++) {
        double at[3], tangent[3], normal[3];
        knot_frame(2 * M_PI * (i - .5) / KNOT_STEPS, at, tangent, normal);
        s[i] = s[i - 1] + 2 * M_PI / KNOT_STEPS * vec3_norm(tangent);
    }
    const double length = s[KNOT_STEPS], around = 2 * M_PI * tube;
    const int n_around = (int)fmax(6, round(sqrt(detail / 2. * around / length)));
    const int n_along = (int)fmax(2, round(detail / 2. / n_around / N_PIECES)),
              n_total = n_along * N_PIECES;
    int err = builder_new(b, N_PIECES * (n_along + 1) * (n_around + 1), 2 * n_total * n_around);
    if (err)
        goto done;
    for (int piece = 0; piece < N_PIECES; piece++) {
        begin_chart(b);
        const uint32_t first = (uint32_t)b->n_vertices;
        for (int j = 0; j <= n_around; j++) {
            for (int i = 0; i <= n_along; i++) {
                const int column = (piece * n_along + i) % n_total;
                const double here = length * column / n_total;
                int low = 0, high = KNOT_STEPS;
                while (high - low > 1) {
                    const int middle = (low + high) / 2;
                    if (s[middle] <= here)
                        low = middle;
                    else
                        high = middle;
                }
                const double t =
                    2 * M_PI / KNOT_STEPS * (low + (here - s[low]) / (s[high] - s[low]));
                double at[3], tangent[3], normal[3], side[3], out[3], place[3];
                knot_frame(t, at, tangent, normal);
                vec3_normalise(tangent);
                vec3_cross(side, normal, tangent); // tangent x side = normal: outwards
                const double angle = 2 * M_PI * (j % n_around) / n_around;
                for (int k = 0; k < 3; k++) {
                    out[k] = cos(angle) * normal[k] + sin(angle) * side[k];
                    place[k] = at[k] + tube * out[k];
                }
                add_vertex(b, place, out, length * i / n_total, around * j / n_around);
            }
        }
        add_grid_triangles(b, first, n_along, n_around);
    }
done:
    free(s);
    return err;
}

int shape_make(struct mesh *out, enum shape shape, const double centre_m[3], double radius_m,
               int detail)
{
    static int (*const make[SHAPE_N])(struct builder *, int) = {make_pebble, make_vase, make_knot,
                                                                make_bowl};
    struct builder b = {0};
    *out = (struct mesh){0};
    if ((unsigned)shape >= SHAPE_N || !(radius_m > 0) || !isfinite(radius_m) || detail < 100 ||
        detail > 4000000)
        return -EINVAL;
    int err = make[shape](&b, detail);
    if (!err)
        err = finish(out, &b, centre_m, radius_m);
    builder_free(&b);
    return err;
}
