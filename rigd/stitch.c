// rigd/stitch.c - a stop's photosites cut along the panorama's texels, in coordinates where area is solid angle.
//
// In longitude and sin(latitude) the sphere is a rectangle of true area (Lambert's cylinder) and the texels of a 2:1 panorama are rectangles
// in it. Corners are shared by neighbouring pixels, so whatever the shape of an edge between them, what one loses the other gains. Only
// at the poles, where a pixel spans much of the longitude, is it divided until its parts are small.
#include "rigd/stitch.h"
#include "rigd/resting.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { CELLS_X = 256, CELLS_Y = 128, MOST_DIVISIONS = 6, POLYGON_MAX = 16 };

struct texel { // sums over the pixels' parts in it; area in units of 4 pi / (width height)
    float cover;          // area
    float weight;         // area x feather
    float num[3], var[3]; // weight x radiance; weight^2 x variance
    float clip;           // weight x share of clipped sites
};

struct cell { // of the coarse grid in which stops are compared: green, unclipped
    double area, sum, squares, var;
};

struct stitch {
    int width, height, n_stops;
    struct texel *texel;
    bool is_in_file;            // texel is a file without a name, mapped
    struct texel *touched;      // the same for contributions of stops to texels where they had clipped pixels; NULL: none yet
    uint8_t *is_touched;        // [width height] of the stop being added
    double *sine;               // [height + 1] sin(latitude) of row borders
    struct cell *before, *stop; // [CELLS_X CELLS_Y]
};

int stitch_new(struct stitch **out, int width)
{
    *out = NULL;
    if (width < 16 || width > 16384 || width % 2)
        return -EINVAL;
    struct stitch *s = calloc(1, sizeof(*s));
    if (!s)
        return -ENOMEM;
    s->width = width, s->height = width / 2;
    const size_t n = (size_t)s->width * (size_t)s->height;
    s->texel = calloc(n, sizeof(*s->texel));
    s->sine = malloc((size_t)(s->height + 1) * sizeof(*s->sine));
    s->before = calloc(CELLS_X * CELLS_Y, sizeof(*s->before));
    s->stop = calloc(CELLS_X * CELLS_Y, sizeof(*s->stop));
    if (!s->texel || !s->sine || !s->before || !s->stop) {
        stitch_free(s);
        return -ENOMEM;
    }
    for (int j = 0; j <= s->height; j++)
        s->sine[j] = cos(M_PI * j / s->height);
    *out = s;
    return 0;
}

void stitch_rest(struct stitch *s, const char *folder)
{
    const size_t n_bytes = (size_t)s->width * (size_t)s->height * sizeof(*s->texel);
    if (!s->is_in_file && !s->n_stops) {
        struct texel *at = resting_new(folder, n_bytes);
        if (at) {
            free(s->texel);
            s->texel = at;
            s->is_in_file = true;
        }
    }
    if (s->is_in_file)
        resting_leave(s->texel, 0, n_bytes);
}

void stitch_free(struct stitch *s)
{
    if (!s)
        return;
    if (s->is_in_file)
        resting_free(s->texel, (size_t)s->width * (size_t)s->height * sizeof(*s->texel));
    else
        free(s->texel);
    free(s->touched);
    free(s->is_touched);
    free(s->sine);
    free(s->before);
    free(s->stop);
    free(s);
}

// ---- mosaic to colours ----------------------------------------------------------------------------------------------------------

// Where pixel (x, y) finds colour c: its own site, the two beside it, or the four around it.
struct taps {
    int n, dx[4], dy[4];
};

struct mosaic {
    const struct merged *m;
    struct taps taps[2][2][3];
};

struct pixel {
    float rgb[3], var[3]; // var: of the mean of many such pixels, times their number: each site of a colour stands for 4 (green: 2) pixels
    float clip;           // share of clipped sites in the worst colour
    double feather;
};

static void find_taps(struct mosaic *mo)
{
    for (int y = 0; y < 2; y++)
        for (int x = 0; x < 2; x++)
            for (int c = 0; c < 3; c++) {
                struct taps *t = &mo->taps[y][x][c];
                for (int ring = 0; ring <= 2 && !t->n; ring++) // centre, edges, corners
                    for (int dy = -1; dy <= 1; dy++)
                        for (int dx = -1; dx <= 1; dx++)
                            if (dx * dx + dy * dy == ring && mo->m->cfa[(y + dy) & 1][(x + dx) & 1] == c)
                                t->dx[t->n] = dx, t->dy[t->n++] = dy;
            }
}

static void interpolate(const struct mosaic *mo, int x, int y, struct pixel *out)
{
    const struct merged *m = mo->m;
    out->clip = 0;
    for (int c = 0; c < 3; c++) {
        const struct taps *t = &mo->taps[y & 1][x & 1][c];
        float sum = 0, var = 0, clipped = 0;
        int n = 0;
        for (int k = 0; k < t->n; k++) {
            const int u = x + t->dx[k], v = y + t->dy[k];
            if (u < 0 || v < 0 || u >= m->width || v >= m->height)
                continue;
            const size_t i = (size_t)v * (size_t)m->width + (size_t)u;
            sum += m->radiance[i];
            var += m->variance[i];
            clipped += m->quality[i] == BRACKET_CLIPPED;
            n++;
        }
        out->rgb[c] = n ? sum / (float)n : 0; // every colour is within reach but in a corner of the frame
        out->var[c] = n ? (c == RAW_GREEN ? 2.f : 4.f) * var / (float)n : 0;
        out->clip = n ? fmaxf(out->clip, clipped / (float)n) : 1;
    }
}

// ---- a patch into texels ----------------------------------------------------------------------------------------------------------

struct corner {
    double dir[3]; // probe axes
    double x, y;   // panorama pixels; y by latitude, while areas are in dir[1] = sin(latitude)
    bool is_seen;
};

struct polygon {
    int n;
    double x[POLYGON_MAX], s[POLYGON_MAX]; // panorama column, sin(latitude)
};

static void place(const struct stitch *s, struct corner *c)
{
    c->x = s->width * (.5 - atan2(c->dir[0], c->dir[2]) / (2 * M_PI));
    c->y = s->height * (.5 - atan2(c->dir[1], hypot(c->dir[0], c->dir[2])) / M_PI);
}

static double area_of(const struct polygon *p)
{
    double twice = 0;
    for (int i = 1; i + 1 < p->n; i++)
        twice += (p->x[i] - p->x[0]) * (p->s[i + 1] - p->s[0]) - (p->x[i + 1] - p->x[0]) * (p->s[i] - p->s[0]);
    return .5 * twice;
}

static void add_vertex(struct polygon *p, double x, double s)
{
    if (p->n < POLYGON_MAX) // a patch cut by a rectangle has 8; one that a mad lens twisted may have more
        p->x[p->n] = x, p->s[p->n++] = s;
}

// p into what lies below and above v[i] = at, v being x or s.
static void cut(const struct polygon *p, bool by_x, double at, struct polygon *below, struct polygon *above)
{
    const double *v = by_x ? p->x : p->s;
    below->n = above->n = 0;
    for (int i = 0; i < p->n; i++) {
        const int j = i + 1 < p->n ? i + 1 : 0;
        add_vertex(v[i] < at ? below : above, p->x[i], p->s[i]);
        if ((v[i] < at) != (v[j] < at)) {
            const double t = (at - v[i]) / (v[j] - v[i]);
            const double x = by_x ? at : p->x[i] + t * (p->x[j] - p->x[i]), s = by_x ? p->s[i] + t * (p->s[j] - p->s[i]) : at;
            add_vertex(below, x, s);
            add_vertex(above, x, s);
        }
    }
}

// What is done with each piece: sum it up, or only note its texel.
struct deposit {
    struct stitch *s;
    const struct pixel *pixel; // NULL: note the texel
};

static void put(const struct deposit *d, int x, int y, double area)
{
    struct stitch *s = d->s;
    if (!(area > 0)) // a sliver of rounding
        return;
    x = x < 0 ? x + s->width : x >= s->width ? x - s->width : x;
    y = y < 0 ? 0 : y >= s->height ? s->height - 1 : y;
    const size_t i = (size_t)y * (size_t)s->width + (size_t)x;
    if (!d->pixel) {
        s->is_touched[i] = 1;
        return;
    }
    struct texel *t = s->is_touched && s->is_touched[i] ? s->touched + i : s->texel + i;
    const float w = (float)(area * d->pixel->feather);
    t->cover += (float)area;
    t->weight += w;
    t->clip += w * d->pixel->clip;
    for (int c = 0; c < 3; c++) {
        t->num[c] += w * d->pixel->rgb[c];
        t->var[c] += w * w * d->pixel->var[c];
    }
}

// The part of p in row y, column by column. unit: texel areas per area of (x, s).
static void put_row(const struct deposit *d, struct polygon *p, int y, double unit)
{
    struct polygon left, right;
    double lo = p->x[0], hi = p->x[0];
    for (int i = 1; i < p->n; i++)
        lo = fmin(lo, p->x[i]), hi = fmax(hi, p->x[i]);
    int x = (int)floor(lo);
    for (; x + 1 < hi; x++) {
        cut(p, true, x + 1, &left, &right);
        const double area = area_of(&left) * unit;
        put(d, x, y, area);
        *p = right;
    }
    put(d, x, y, area_of(p) * unit);
}

// Corners in order round the patch. Solid angle of what was put, in steradians.
static double put_patch(const struct deposit *d, const struct corner *c[4], int division)
{
    const struct stitch *s = d->s;
    struct polygon p = { .n = 4 };
    double y_lo = INFINITY, y_hi = -INFINITY, x_lo = INFINITY, x_hi = -INFINITY;
    for (int i = 0; i < 4; i++) {
        p.x[i] = c[i]->x - s->width * round((c[i]->x - c[0]->x) / s->width);
        p.s[i] = c[i]->dir[1];
        x_lo = fmin(x_lo, p.x[i]), x_hi = fmax(x_hi, p.x[i]);
        y_lo = fmin(y_lo, c[i]->y), y_hi = fmax(y_hi, c[i]->y);
    }
    const double steradians = 2 * M_PI / s->width, per_texel = s->width * (double)s->height / (4 * M_PI);
    if (x_hi - x_lo > s->width / 128. && division < MOST_DIVISIONS) { // by a pole
        struct corner grid[3][3];
        double sum = 0;
        for (int v = 0; v < 3; v++)
            for (int u = 0; u < 3; u++) {
                double norm = 0;
                for (int k = 0; k < 3; k++) {
                    grid[v][u].dir[k] = .25 * ((2 - v) * ((2 - u) * c[0]->dir[k] + u * c[1]->dir[k]) + v * ((2 - u) * c[3]->dir[k] + u * c[2]->dir[k]));
                    norm += grid[v][u].dir[k] * grid[v][u].dir[k];
                }
                for (int k = 0; k < 3; k++)
                    grid[v][u].dir[k] /= sqrt(norm);
                place(s, &grid[v][u]);
            }
        for (int v = 0; v < 2; v++)
            for (int u = 0; u < 2; u++)
                sum += put_patch(d, (const struct corner *[4]){ &grid[v][u], &grid[v][u + 1], &grid[v + 1][u + 1], &grid[v + 1][u] }, division + 1);
        return sum;
    }
    if (x_hi - x_lo > s->width / 128.) { // as small as it gets: all of it where it is
        double across[3], along[3], n[3], area = 0, middle[3];
        for (int k = 0; k < 3; k++) {
            across[k] = c[2]->dir[k] - c[0]->dir[k], along[k] = c[3]->dir[k] - c[1]->dir[k];
            middle[k] = c[0]->dir[k] + c[1]->dir[k] + c[2]->dir[k] + c[3]->dir[k];
        }
        n[0] = across[1] * along[2] - across[2] * along[1], n[1] = across[2] * along[0] - across[0] * along[2], n[2] = across[0] * along[1] - across[1] * along[0];
        area = .5 * sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
        struct corner at = { .dir = { middle[0], middle[1], middle[2] } };
        place(s, &at);
        put(d, (int)floor(at.x), (int)floor(at.y), area * per_texel);
        return area;
    }
    const double signed_area = area_of(&p), unit = (signed_area < 0 ? -1 : 1) * steradians * per_texel;
    int y = (int)floor(y_lo);
    y = y < 0 ? 0 : y >= s->height ? s->height - 1 : y;
    struct polygon above, below; // of a row's lower border, by sin(latitude): above comes first
    for (; y + 1 < y_hi && y + 1 < s->height; y++) {
        cut(&p, false, s->sine[y + 1], &below, &above);
        if (above.n >= 3)
            put_row(d, &above, y, unit);
        p = below;
    }
    if (p.n >= 3)
        put_row(d, &p, y, unit);
    return fabs(signed_area) * steradians;
}

// ---- a stop -----------------------------------------------------------------------------------------------------------------------

static double smooth(double t)
{
    t = t < 0 ? 0 : t > 1 ? 1 : t;
    return t * t * (3 - 2 * t);
}

// 1 inside, falling to nearly 0 at the border of frame and circle over a tenth of the frame.
static double feather(const struct lens *l, double reach, double x, double y)
{
    const double range = .1 * fmin(fmin(l->width_px, l->height_px), 2 * reach);
    const double border = fmin(fmin(x, l->width_px - x), fmin(y, l->height_px - y));
    const double rim = reach - hypot(x - l->centre_px[0], y - l->centre_px[1]);
    return fmax(smooth(border / range) * smooth(rim / range), 1e-3);
}

struct view {
    const struct lens *lens;
    double reach; // lens_reach_px()
    const double *R; // probe_from_camera
    struct corner *upper, *lower; // corners of a row of pixels, [width + 1]
};

static void see_corners(const struct stitch *s, const struct view *v, struct corner *row, int y)
{
    for (int x = 0; x <= v->lens->width_px; x++) {
        double d[3];
        struct corner *c = row + x;
        c->is_seen = lens_ray(v->lens, (double[2]){ x, y }, d);
        if (!c->is_seen)
            continue;
        for (int k = 0; k < 3; k++)
            c->dir[k] = v->R[3 * k] * d[0] + v->R[3 * k + 1] * d[1] + v->R[3 * k + 2] * d[2];
        place(s, c);
    }
}

// To the next row: what was below is above.
static void step_row(const struct stitch *s, struct view *v, int y)
{
    struct corner *t = v->upper;
    v->upper = v->lower;
    v->lower = t;
    if (y == 0)
        see_corners(s, v, v->upper, 0);
    see_corners(s, v, v->lower, y + 1);
}

// Pixels whose colours would come from sites beyond the rim are left out.
static bool patch_of(const struct view *v, int x, int y, const struct corner *c[4])
{
    const struct lens *l = v->lens;
    if (hypot(x + .5 - l->centre_px[0], y + .5 - l->centre_px[1]) > v->reach - 2.2)
        return false;
    c[0] = v->upper + x, c[1] = v->upper + x + 1, c[2] = v->lower + x + 1, c[3] = v->lower + x;
    return c[0]->is_seen && c[1]->is_seen && c[2]->is_seen && c[3]->is_seen;
}

static void note_cell(struct stitch *s, const struct corner *c, const struct pixel *p, double area)
{
    const int x = (int)(c->x * CELLS_X / s->width), y = (int)(c->y * CELLS_Y / s->height);
    struct cell *k = s->stop + (y < 0 ? 0 : y >= CELLS_Y ? CELLS_Y - 1 : y) * CELLS_X + (x < 0 ? 0 : x % CELLS_X);
    k->area += area;
    k->sum += area * (double)p->rgb[RAW_GREEN];
    k->squares += area * (double)p->rgb[RAW_GREEN] * (double)p->rgb[RAW_GREEN];
    k->var += area * area * (double)p->var[RAW_GREEN];
}

// Texels that a clipped pixel of this stop reaches: there its contributions are kept apart.
static int note_touched(struct stitch *s, struct view *v, const struct mosaic *mo)
{
    const size_t n = (size_t)s->width * (size_t)s->height;
    const struct merged *m = mo->m;
    if (!memchr(m->quality, BRACKET_CLIPPED, (size_t)m->width * (size_t)m->height))
        return 0;
    s->is_touched = calloc(n, 1);
    if (!s->touched)
        s->touched = calloc(n, sizeof(*s->touched)); // pages that stay untouched take no memory
    if (!s->is_touched || !s->touched)
        return -ENOMEM;
    const struct deposit d = { .s = s };
    for (int y = 0; y < m->height; y++) {
        step_row(s, v, y);
        for (int x = 0; x < m->width; x++) {
            struct pixel p;
            const struct corner *c[4];
            interpolate(mo, x, y, &p);
            if (p.clip > 0 && patch_of(v, x, y, c))
                put_patch(&d, c, 0);
        }
    }
    return 0;
}

static int compare_doubles(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// Seen well, and even: at the edge of a lamp a pixel more or less would be a difference.
static bool is_plain(const struct cell *c, double whole)
{
    const double mean = c->sum / c->area;
    return c->area > .9 * whole && c->sum > 30 * sqrt(c->var) && c->squares / c->area < 1.05 * mean * mean;
}

static int compare_with_before(struct stitch *s, struct stitch_stop_report *r)
{
    enum { N = CELLS_X * CELLS_Y };
    double *ratio = malloc(N * sizeof(*ratio));
    int n = 0;
    if (!ratio)
        return -ENOMEM;
    for (int i = 0; i < N; i++) {
        const struct cell *a = s->before + i, *b = s->stop + i;
        const double whole = 2 * M_PI / CELLS_X * (cos(M_PI * (i / CELLS_X) / CELLS_Y) - cos(M_PI * (i / CELLS_X + 1) / CELLS_Y));
        if (is_plain(a, whole) && is_plain(b, whole))
            ratio[n++] = b->sum / b->area * a->area / a->sum;
    }
    r->n_cells = n;
    r->seam_gain = 1;
    if (n) {
        qsort(ratio, (size_t)n, sizeof(*ratio), compare_doubles);
        r->seam_gain = ratio[n / 2];
        for (int i = 0; i < n; i++)
            ratio[i] = fabs(log2(ratio[i] / r->seam_gain));
        qsort(ratio, (size_t)n, sizeof(*ratio), compare_doubles);
        r->seam_ev = ratio[n / 2];
    }
    free(ratio);
    for (int i = 0; i < N; i++) {
        s->before[i].area += s->stop[i].area;
        s->before[i].sum += s->stop[i].sum;
        s->before[i].squares += s->stop[i].squares;
        s->before[i].var += s->stop[i].var;
        s->stop[i] = (struct cell){ 0 };
    }
    return 0;
}

// Of a picture that was put up to row y: what is not looked at again.
static void leave_rows(const struct merged *m, int y)
{
    const size_t n = (size_t)(y > 2 ? y - 2 : 0) * (size_t)m->width;
    resting_leave(m->radiance, 0, n * sizeof(*m->radiance));
    resting_leave(m->variance, 0, n * sizeof(*m->variance));
    resting_leave(m->quality, 0, n);
}

static int add_stop(struct stitch *s, const struct lens *lens, const double R[9], const struct merged *m, bool is_last_use, struct stitch_stop_report *r)
{
    *r = (struct stitch_stop_report){ .seam_gain = 1 };
    if (lens->width_px != m->width || lens->height_px != m->height) {
        log_error("stitch: the lens is for pictures of %dx%d, the frames have %dx%d photosites: calibrate the lens for these frames",
                  lens->width_px, lens->height_px, m->width, m->height);
        return -EINVAL;
    }
    struct mosaic mo = { .m = m };
    const size_t n_corners = (size_t)m->width + 1;
    struct view v = { .lens = lens, .reach = lens_reach_px(lens), .R = R, .upper = malloc(n_corners * sizeof(*v.upper)), .lower = malloc(n_corners * sizeof(*v.lower)) };
    int err = v.upper && v.lower ? 0 : -ENOMEM;
    find_taps(&mo);
    if (!err)
        err = note_touched(s, &v, &mo);
    struct pixel p;
    const struct deposit d = { .s = s, .pixel = &p };
    for (int y = 0; !err && y < m->height; y++) {
        if (is_last_use && y % 64 == 0)
            leave_rows(m, y);
        if (s->is_in_file && y % 512 == 0) // texels that an earlier part of the stop lay on
            resting_leave(s->texel, 0, (size_t)s->width * (size_t)s->height * sizeof(*s->texel));
        step_row(s, &v, y);
        for (int x = 0; x < m->width; x++) {
            const struct corner *c[4];
            if (!patch_of(&v, x, y, c))
                continue;
            interpolate(&mo, x, y, &p);
            p.feather = feather(lens, v.reach, x + .5, y + .5);
            const double area = put_patch(&d, c, 0);
            r->solid_angle_sr += area;
            if (p.clip > 0)
                r->clipped_sr += area * (double)p.clip;
            else
                note_cell(s, c[0], &p, area);
        }
    }
    if (!err)
        err = compare_with_before(s, r);
    s->n_stops += !err;
    free(s->is_touched);
    s->is_touched = NULL;
    free(v.upper);
    free(v.lower);
    return err;
}

int stitch_add_last(struct stitch *s, const struct lens *lens, const double R[9], struct merged *m, struct stitch_stop_report *r)
{
    return add_stop(s, lens, R, m, true, r);
}

int stitch_add(struct stitch *s, const struct lens *lens, const double R[9], const struct merged *m, struct stitch_stop_report *r)
{
    return add_stop(s, lens, R, m, false, r);
}

// ---- the whole --------------------------------------------------------------------------------------------------------------------

const char *const stitch_channels[STITCH_CHANNELS] = { "R", "G", "B", "variance.R", "variance.G", "variance.B", "coverage", "clip" };

static void finish_texel(const struct stitch *s, const double M[9], size_t i, double whole, float to[STITCH_CHANNELS])
{
    struct texel t = s->texel[i];
    memset(to, 0, STITCH_CHANNELS * sizeof(*to));
    // What a stop saw clipped counts unless another saw at least half of the texel unclipped.
    if (s->touched && t.cover < .5 * whole) {
        const struct texel *more = s->touched + i;
        t.cover += more->cover, t.weight += more->weight, t.clip += more->clip;
        for (int c = 0; c < 3; c++)
            t.num[c] += more->num[c], t.var[c] += more->var[c];
    }
    if (!(t.cover > 1e-5 * whole))
        return;
    const double w = (double)t.weight;
    for (int c = 0; c < 3; c++) {
        double sum = 0, var = 0;
        for (int k = 0; k < 3; k++) {
            sum += M[3 * c + k] * (double)t.num[k] / w;
            var += M[3 * c + k] * M[3 * c + k] * (double)t.var[k] / (w * w);
        }
        to[c] = (float)fmax(sum, 0); // noise of the dark, or a colour out of gamut: light is not negative
        to[3 + c] = (float)var;
    }
    to[6] = (float)fmin((double)t.cover / whole, 1);
    to[7] = (float)fmin((double)t.clip / w, 1);
}

static double texel_area(const struct stitch *s, int y)
{
    return (s->sine[y] - s->sine[y + 1]) * s->height / 2;
}

// Of sums that rest: the rows above y.
static void leave_texels(struct stitch *s, int y)
{
    if (s->is_in_file && y % 64 == 0)
        resting_leave(s->texel, 0, (size_t)y * (size_t)s->width * sizeof(*s->texel));
}

int stitch_row(void *arg, int y, float *row)
{
    const struct stitch_rows *r = arg;
    leave_texels(r->stitch, y);
    for (int x = 0; x < r->stitch->width; x++)
        finish_texel(r->stitch, r->rgb_from_camera, (size_t)y * (size_t)r->stitch->width + (size_t)x, texel_area(r->stitch, y), row + (size_t)x * STITCH_CHANNELS);
    return 0;
}

static int compare_lights(const void *a, const void *b)
{
    const struct clipped_light *l = a, *k = b;
    const double x = l->irradiance_at_least[0] + l->irradiance_at_least[1] + l->irradiance_at_least[2];
    const double y = k->irradiance_at_least[0] + k->irradiance_at_least[1] + k->irradiance_at_least[2];
    return (x < y) - (x > y);
}

static void keep_brightest(struct panorama_report *r, const struct clipped_light *l)
{
    enum { MOST = sizeof(r->light) / sizeof(r->light[0]) };
    r->n_lights++;
    if (r->n_listed < MOST)
        r->light[r->n_listed++] = *l;
    else if (compare_lights(l, r->light + MOST - 1) < 0)
        r->light[MOST - 1] = *l;
    qsort(r->light, (size_t)r->n_listed, sizeof(r->light[0]), compare_lights);
}

struct source { // of texels: a picture, or sums
    int width, height;
    int clip, coverage, variance; // channels; -1: none
    const struct image *picture;
    const struct stitch_rows *rows;
};

static const float *look_at(const struct source *p, int x, int y, float room[STITCH_CHANNELS])
{
    const size_t i = (size_t)y * (size_t)p->width + (size_t)x;
    if (p->picture)
        return p->picture->data + i * (size_t)p->picture->n_channels;
    finish_texel(p->rows->stitch, p->rows->rgb_from_camera, i, texel_area(p->rows->stitch, y), room);
    return room;
}

// mark: 1 clipped; becomes 2 when visited. stack: as many as texels are marked.
static void collect_light(struct panorama_report *r, const struct source *p, uint8_t *mark, int32_t *stack, int32_t seed, int least)
{
    struct clipped_light l = { 0 };
    int n = 0, count = 0;
    stack[n++] = seed;
    mark[seed] = 2;
    while (n) {
        const int32_t at = stack[--n];
        const int x = at % p->width, y = at / p->width;
        const double lon = M_PI - 2 * M_PI * (x + .5) / p->width, lat = M_PI / 2 - M_PI * (y + .5) / p->height;
        const double area = 2 * M_PI / p->width * (cos(M_PI * y / p->height) - cos(M_PI * (y + 1) / p->height));
        float room[STITCH_CHANNELS];
        const float *v = look_at(p, x, y, room);
        const double light = (double)v[0] + (double)v[1] + (double)v[2];
        count++;
        l.solid_angle_sr += area;
        for (int c = 0; c < 3; c++)
            l.irradiance_at_least[c] += area * (double)v[c];
        l.dir_probe[0] += light * area * sin(lon) * cos(lat), l.dir_probe[1] += light * area * sin(lat), l.dir_probe[2] += light * area * cos(lon) * cos(lat);
        for (int dy = -1; dy <= 1; dy++)
            for (int dx = -1; dx <= 1; dx++) {
                const int u = (x + dx + p->width) % p->width, w = y + dy;
                if (w >= 0 && w < p->height && mark[w * p->width + u] == 1) {
                    mark[w * p->width + u] = 2;
                    stack[n++] = w * p->width + u;
                }
            }
    }
    const double norm = sqrt(l.dir_probe[0] * l.dir_probe[0] + l.dir_probe[1] * l.dir_probe[1] + l.dir_probe[2] * l.dir_probe[2]);
    for (int c = 0; c < 3 && norm > 0; c++)
        l.dir_probe[c] /= norm;
    if (count < least)
        return;
    r->clipped_sr += l.solid_angle_sr;
    keep_brightest(r, &l);
}

static int compare_floats(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

static int examine(struct panorama_report *r, const struct source *p)
{
    const size_t n = (size_t)p->width * (size_t)p->height;
    float highest = 0, lowest = INFINITY, room[STITCH_CHANNELS];
    int32_t *stack = NULL;
    *r = (struct panorama_report){ 0 };
    uint8_t *mark = calloc(n, 1);
    float *snr = p->variance >= 0 ? malloc(n * sizeof(*snr)) : NULL;
    size_t n_snr = 0, n_marked = 0;
    int err = mark && (snr || p->variance < 0) ? 0 : -ENOMEM;
    if (err)
        goto out;
    for (int y = 0; y < p->height && p->clip < 0; y++)
        for (int x = 0; x < p->width; x++)
            for (int c = 0; c < 3; c++) {
                const float v = look_at(p, x, y, room)[c];
                highest = fmaxf(highest, v);
                lowest = fminf(lowest, v);
            }
    for (int y = 0; y < p->height; y++) {
        const double area = 2 * M_PI / p->width * (cos(M_PI * y / p->height) - cos(M_PI * (y + 1) / p->height));
        if (p->rows)
            leave_texels(p->rows->stitch, y);
        for (int x = 0; x < p->width; x++) {
            const size_t i = (size_t)y * (size_t)p->width + (size_t)x;
            const float *v = look_at(p, x, y, room);
            const double covered = p->coverage >= 0 ? (double)v[p->coverage] : 1;
            r->uncovered_sr += area * (1 - covered);
            for (int c = 0; c < 3; c++)
                r->total[c] += area * (double)v[c];
            mark[i] = p->clip >= 0 ? v[p->clip] > 1e-3f : highest > 2 * lowest && fmaxf(v[0], fmaxf(v[1], v[2])) >= .999f * highest;
            n_marked += mark[i];
            if (snr && covered > 0 && v[p->variance] > 0)
                snr[n_snr++] = v[1] / sqrtf(v[p->variance]);
        }
    }
    stack = malloc((n_marked + 1) * sizeof(*stack));
    if (!stack) {
        err = -ENOMEM;
        goto out;
    }
    for (size_t i = 0; i < n; i++)
        if (mark[i] == 1)
            collect_light(r, p, mark, stack, (int32_t)i, p->clip >= 0 ? 1 : 8);
    if (n_snr) {
        qsort(snr, n_snr, sizeof(*snr), compare_floats);
        r->median_snr = (double)snr[n_snr / 2];
        r->dark_snr = (double)snr[n_snr / 100];
    }
out:
    free(mark);
    free(stack);
    free(snr);
    return err;
}

int panorama_examine(struct panorama_report *r, const struct image *p)
{
    return examine(r, &(struct source){ .width = p->width, .height = p->height, .picture = p, .clip = image_channel(p, "clip"),
                                        .coverage = image_channel(p, "coverage"), .variance = image_channel(p, "variance.G") });
}

int stitch_examine(struct panorama_report *r, const struct stitch_rows *rows)
{
    return examine(r, &(struct source){ .width = rows->stitch->width, .height = rows->stitch->height, .rows = rows, .clip = 7, .coverage = 6, .variance = 4 });
}

int stitch_finish(struct image *out, struct stitch *s, const double M[9], struct panorama_report *report)
{
    struct stitch_rows rows = { .stitch = s };
    memcpy(rows.rgb_from_camera, M, sizeof(rows.rgb_from_camera));
    int err = image_new(out, s->width, s->height, STITCH_CHANNELS, stitch_channels);
    for (int y = 0; y < s->height && !err; y++)
        err = stitch_row(&rows, y, out->data + (size_t)y * (size_t)s->width * STITCH_CHANNELS);
    if (!err)
        err = panorama_examine(report, out);
    if (err)
        image_free(out);
    return err;
}
