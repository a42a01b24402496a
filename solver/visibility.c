// solver/visibility.c - who sees which texel: cameras, and lights.
//
// Everything is asked texel by texel, each by one thread, so the answers do not depend on how many
// there are.
#include "solver/visibility.h"
#include "solver/parallel.h"
#include "solver/random.h"
#include "solver/take/atomic_file.h"
#include "solver/take/image.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>

enum { CHUNK = 256, LEAST_SUB = 4, MOST_SUB = 16, SECTORS = 6, QUESTIONS = 64 };
static const double near_cos = .7071; // lights further apart than 45 degrees are no neighbours

static void to_double(double out[3], const float in[3])
{
    out[0] = in[0], out[1] = in[1], out[2] = in[2];
}

// ---- cameras ----

struct camera_job {
    uint8_t *mask;
    const struct rays *rays;
    const struct texels *texels;
    const struct camera *camera;
    double grazing_cos;
};

static uint8_t mask_of_texel(const struct camera_job *job, int64_t i)
{
    const struct texels *t = job->texels;
    const struct camera *camera = job->camera;
    double point[3], normal[3], view[3], uv_px[2];
    to_double(point, t->position_m[i]);
    to_double(normal, t->normal[i]);
    if (!camera_project(camera, point, uv_px, NULL) ||
        !(uv_px[0] >= 0 && uv_px[0] < camera->width_px) ||
        !(uv_px[1] >= 0 && uv_px[1] < camera->height_px))
        return MASK_OUTSIDE;
    vec3_sub(view, camera->centre_m, point);
    vec3_normalise(view);
    const double cosine = vec3_dot(normal, view);
    if (!(cosine > 0))
        return MASK_OCCLUDED;
    float start[3], dir[3];
    rays_start(job->rays, t->triangle[i], t->barycentric[i], start);
    for (int c = 0; c < 3; c++)
        dir[c] = (float)(camera->centre_m[c] - start[c]);
    if (rays_blocked(job->rays, start, dir, 0, 1))
        return MASK_OCCLUDED;
    return cosine < job->grazing_cos ? MASK_GRAZING : MASK_VISIBLE;
}

static void mask_texels(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    const struct camera_job *job = arg;
    for (int64_t i = begin; i < end; i++)
        job->mask[i] = mask_of_texel(job, i);
}

void visibility_camera_mask(uint8_t *mask, const struct rays *r, const struct texels *t,
                            const struct camera *camera, double grazing_cos, int n_threads)
{
    parallel_for(n_threads, t->n, CHUNK, mask_texels,
                 &(struct camera_job){ mask, r, t, camera, grazing_cos });
}

int visibility_write_mask_png(const uint8_t *mask, const struct texels *t, const char *path)
{
    uint8_t *pixels = calloc((size_t)t->size, (size_t)t->size);
    if (!pixels)
        return -ENOMEM;
    for (int i = 0; i < t->n; i++)
        pixels[t->pixel[i]] = mask[i];
    const int err = image_write_png(path, t->size, t->size, 1, pixels);
    free(pixels);
    return err;
}

// ---- lights: where from ----

static double luminance_of(const struct image *image, int x, int y)
{
    const float *p =
        image->data + ((size_t)y * (size_t)image->width + (size_t)x) * (size_t)image->n_channels;
    return .2126 * p[0] + .7152 * p[1] + .0722 * p[2];
}

// The pixel in which the running sum passes target, and where in it (as a fraction): weight(arg, i)
// for i in [begin, end). Rounding may leave target unpassed: then the end of the last pixel that
// has any weight.
static double invert_sum(double target, int begin, int end,
                         double (*weight)(const void *arg, int i), const void *arg)
{
    double position = begin;
    for (int i = begin; i < end; i++) {
        const double w = weight(arg, i);
        if (!(w > 0))
            continue;
        if (target < w)
            return i + fmin(fmax(target, 0) / w, 1 - 1e-9); // never rounded up into the next one
        position = i + .5;
        target -= w;
    }
    return position;
}

struct region_row {
    const struct image *image;
    struct light_region region;
    int y;
};

static double energy_of_pixel(const void *arg, int x)
{
    const struct region_row *row = arg;
    return luminance_of(row->image, x, row->y);
}

static double energy_of_row(const void *arg, int y)
{
    struct region_row row = *(const struct region_row *)arg;
    row.y = y;
    double sum = 0;
    for (int x = row.region.x0; x < row.region.x1; x++)
        sum += energy_of_pixel(&row, x);
    return sum * panorama_solid_angle(row.image->width, row.image->height, y);
}

// n_sub probe directions within light i's region, with density proportional to its energy: rows by
// their share, columns within the row by theirs (inverse of both cumulative sums), at the points of
// a rank-1 lattice shifted by the seed. A region without energy is looked at along its middle.
static void draw_sub_directions(double (*dir)[3], const struct lights *l, int i,
                                const struct panorama *p, int n_sub, uint64_t seed)
{
    struct region_row row = { &p->image, l->region[i], 0 };
    const struct light_region *g = &row.region;
    double total = 0;
    for (int y = g->y0; y < g->y1; y++)
        total += energy_of_row(&row, y);
    for (int k = 0; k < n_sub; k++) {
        if (!(total > 0)) {
            memcpy(dir[k], l->dir_probe[i], sizeof(dir[k]));
            continue;
        }
        const double by_row = (k + random_uniform(seed, (uint64_t)i, 0)) / n_sub;
        double by_column = k * .6180339887498949 + random_uniform(seed, (uint64_t)i, 1);
        by_column -= floor(by_column);
        const double y_px = invert_sum(by_row * total, g->y0, g->y1, energy_of_row, &row);
        row.y = (int)y_px;
        const double of_row = energy_of_row(&row, row.y) /
                              panorama_solid_angle(row.image->width, row.image->height, row.y);
        const double x_px = invert_sum(by_column * of_row, g->x0, g->x1, energy_of_pixel, &row);
        panorama_direction(row.image->width, row.image->height, x_px, y_px, dir[k]);
    }
}

// A light's place: its position, or where q = 1/r = 0 its direction.
static bool place_of_light(const struct lights *l, int i, double place[3])
{
    mat3_mul_vec(place, l->world_from_probe, l->dir_probe[i]);
    if (!(l->inverse_distance[i] > 0))
        return true;
    for (int c = 0; c < 3; c++)
        place[c] = l->centre_m[c] + place[c] / l->inverse_distance[i];
    return false;
}

static double angle_between(const double a[3], const double b[3])
{
    double across[3];
    vec3_cross(across, a, b);
    return atan2(vec3_norm(across), vec3_dot(a, b));
}

// The largest angle the light has moved by, seen from the middle and the corners of the texels'
// box.
static double moved_rad(const struct light_visibility *v, int i, const double place[3],
                        bool directional)
{
    double largest = 0;
    for (int k = 0; k < 9; k++) {
        double before[3], after[3];
        for (int c = 0; c < 3; c++) {
            const double from = v->reference_m[c] + (k == 8         ? 0
                                                     : (k >> c & 1) ? v->half_size_m[c]
                                                                    : -v->half_size_m[c]);
            before[c] = v->traced_from_m[i][c] - (v->traced_directional[i] ? 0 : from);
            after[c] = place[c] - (directional ? 0 : from);
        }
        largest = fmax(largest, angle_between(before, after));
    }
    return largest;
}

// ---- lights: who is whose neighbour in the sky ----

// The nearest light in each of six sectors around each one: the edge of a shadow that crosses a light's region parts its centre from
// that of a neighbour, or has not reached either. -1: nobody there, so nobody tells.
static int32_t (*find_neighbours(const struct lights *l))[SECTORS]
{
    int32_t(*neighbour)[SECTORS] = malloc(((size_t)l->n + 1) * sizeof(*neighbour));
    for (int i = 0; neighbour && i < l->n; i++) {
        const double *d = l->dir_probe[i], axis[3] = { fabs(d[0]) < .6, fabs(d[0]) >= .6, 0 };
        double x[3], y[3], nearest[SECTORS];
        vec3_cross(x, axis, d);
        vec3_normalise(x);
        vec3_cross(y, d, x);
        for (int k = 0; k < SECTORS; k++)
            neighbour[i][k] = -1, nearest[k] = near_cos;
        for (int j = 0; j < l->n; j++) {
            const double cosine = vec3_dot(d, l->dir_probe[j]);
            if (cosine < near_cos || cosine > 1 - 1e-12) // itself, or another in its place
                continue;
            const double turn = atan2(vec3_dot(y, l->dir_probe[j]), vec3_dot(x, l->dir_probe[j])) / (2 * M_PI);
            const int k = (int)((turn + 1) * SECTORS) % SECTORS;
            if (cosine > nearest[k])
                nearest[k] = cosine, neighbour[i][k] = j;
        }
    }
    return neighbour;
}

// ---- lights: tracing ----

// Where a direction lies on the octahedron, unfolded to a square of 1024 x 1024 and walked along a Z curve: who is near in the order is
// near in the sky.
static uint32_t place_in_sky(const double dir[3])
{
    const double sum = fmax(fabs(dir[0]) + fabs(dir[1]) + fabs(dir[2]), 1e-300);
    double x = dir[0] / sum, y = dir[1] / sum;
    if (dir[2] < 0) {
        const double folded = (1 - fabs(y)) * (x < 0 ? -1 : 1);
        y = (1 - fabs(x)) * (y < 0 ? -1 : 1);
        x = folded;
    }
    const uint32_t column = (uint32_t)((x + 1) * 511.5), row = (uint32_t)((y + 1) * 511.5);
    uint32_t key = 0;
    for (int bit = 0; bit < 10; bit++)
        key |= (column >> bit & 1) << 2 * bit | (row >> bit & 1) << (2 * bit + 1);
    return key;
}

struct listed_light {
    uint32_t place;
    int light;
};

static int by_place(const void *a, const void *b)
{
    const struct listed_light *one = a, *two = b;
    return one->place != two->place ? (one->place < two->place ? -1 : 1) : (one->light > two->light) - (one->light < two->light);
}

// Rays of neighbours in the list are traced together: the more alike, the quicker.
static int sort_by_place(int *listed, int n, const struct lights *l)
{
    struct listed_light *order = malloc(((size_t)n + 1) * sizeof(*order));
    if (!order)
        return -ENOMEM;
    for (int i = 0; i < n; i++)
        order[i] = (struct listed_light){ place_in_sky(l->dir_probe[listed[i]]), listed[i] };
    qsort(order, (size_t)n, sizeof(*order), by_place);
    for (int i = 0; i < n; i++)
        listed[i] = order[i].light;
    free(order);
    return 0;
}

struct light_job {
    struct light_visibility *v;
    const struct rays *rays;
    const struct texels *texels;
    const struct lights *lights;
    int n_listed;
    const int *listed;      // the lights to trace
    const double (*dir)[3]; // [n_listed][n_sub] R dh, of every sub-direction
    const double (*centre)[3];              // [n_lights] R dh
    const int32_t (*neighbour)[SECTORS];    // [n_lights], or NULL: n_sub is 1
    uint8_t *seen;                          // [workers][n_lights (1 + n_sub)] enum seen; n_sub is 0 where it is 1
    _Atomic int64_t n_rays;
};

// u = R dh + q (c - x) points from x to the light, which is at x + u / q.
static void towards_light(double u[3], const double rotated_dir[3], double q,
                          const double centre_m[3], const double x[3])
{
    for (int c = 0; c < 3; c++)
        u[c] = rotated_dir[c] + q * (centre_m[c] - x[c]);
}

enum seen { NOT_ASKED, BELOW, BLOCKED, SEEN };

// What one texel asks, many rays at a time.
struct questions {
    const struct light_job *job;
    double point[3], normal[3];
    float start[3];
    int n;
    float dir[QUESTIONS][3], t_max[QUESTIONS];
    uint8_t *answer[QUESTIONS]; // enum seen
    int64_t n_rays;
};

static void answer(struct questions *q)
{
    uint8_t blocked[QUESTIONS];
    rays_blocked_from(q->job->rays, q->start, q->n, (const float(*)[3])q->dir, q->t_max, blocked);
    for (int i = 0; i < q->n; i++)
        *q->answer[i] = blocked[i] ? BLOCKED : SEEN;
    q->n_rays += q->n;
    q->n = 0;
}

// Does the texel see light i at R dh = rotated_dir? *seen is BELOW or, after the next answer(), BLOCKED or SEEN.
static void ask(struct questions *q, int i, const double rotated_dir[3], uint8_t *seen)
{
    const struct light_job *job = q->job;
    const double inverse_distance = job->lights->inverse_distance[i];
    double u[3], from[3];
    towards_light(u, rotated_dir, inverse_distance, job->lights->centre_m, q->point);
    *seen = BELOW;
    if (!(vec3_dot(q->normal, u) > 0))
        return;
    *seen = BLOCKED; // so that it is not asked twice
    to_double(from, q->start);
    towards_light(u, rotated_dir, inverse_distance, job->lights->centre_m, from);
    for (int c = 0; c < 3; c++)
        q->dir[q->n][c] = (float)u[c];
    q->t_max[q->n] = inverse_distance > 0 ? (float)(1 / inverse_distance - (double)rays_offset_m(job->rays) / vec3_norm(u)) : INFINITY;
    q->answer[q->n] = seen;
    if (++q->n == QUESTIONS)
        answer(q);
}

// Whether the edge of a shadow may cross light i's region; centre[n_lights]: who is seen.
static bool on_an_edge(const struct light_job *job, int i, const uint8_t *centre)
{
    for (int k = 0; k < SECTORS; k++) {
        const int32_t j = job->neighbour[i][k];
        if (j < 0 || (centre[j] != BELOW && centre[j] != centre[i]))
            return true;
    }
    return false;
}

static void trace_texels(void *arg, int64_t begin, int64_t end, int worker)
{
    struct light_job *job = arg;
    struct light_visibility *v = job->v;
    const struct texels *t = job->texels;
    const bool soft = v->n_sub > 1;
    uint8_t *centre = job->seen + (size_t)worker * (size_t)v->n_lights * (size_t)(soft ? 1 + v->n_sub : 1);
    uint8_t *sub = centre + v->n_lights; // [n_listed][n_sub]
    struct questions q = { .job = job };
    for (int64_t i = begin; i < end; i++) {
        to_double(q.point, t->position_m[i]);
        to_double(q.normal, t->normal[i]);
        rays_start(job->rays, t->triangle[i], t->barycentric[i], q.start);
        memset(centre, NOT_ASKED, (size_t)v->n_lights);
        for (int k = 0; k < job->n_listed; k++)
            ask(&q, job->listed[k], job->centre[job->listed[k]], &centre[job->listed[k]]);
        answer(&q);
        for (int k = 0; soft && k < job->n_listed; k++)
            for (int s = 0; centre[job->listed[k]] != BELOW && s < SECTORS; s++) {
                const int32_t j = job->neighbour[job->listed[k]][s];
                if (j >= 0 && centre[j] == NOT_ASKED)
                    ask(&q, j, job->centre[j], &centre[j]);
            }
        answer(&q);
        for (int k = 0; soft && k < job->n_listed; k++) {
            const int light = job->listed[k];
            uint8_t *seen = sub + (size_t)k * (size_t)v->n_sub;
            seen[0] = NOT_ASKED;
            if (centre[light] == BELOW || on_an_edge(job, light, centre))
                for (int s = 0; s < v->n_sub; s++)
                    ask(&q, light, job->dir[(int64_t)k * v->n_sub + s], &seen[s]);
        }
        answer(&q);
        uint16_t *bits = v->bits + i * v->words_per_texel;
        for (int k = 0; k < job->n_listed; k++) {
            const int light = job->listed[k];
            const uint8_t *seen = sub + (size_t)k * (size_t)v->n_sub;
            int n_above = 1, n_visible = centre[light] == SEEN;
            if (soft && seen[0] != NOT_ASKED) {
                n_above = n_visible = 0;
                for (int s = 0; s < v->n_sub; s++)
                    n_above += seen[s] != BELOW, n_visible += seen[s] == SEEN;
            }
            const unsigned bit = 1u << light % 16, word = bits[light / 16];
            bits[light / 16] = (uint16_t)(n_visible ? word | bit : word & ~bit);
            if (v->soft)
                v->soft[i * v->n_lights + light] =
                    (uint8_t)(n_above ? (255 * n_visible + n_above / 2) / n_above : 0);
        }
    }
    atomic_fetch_add_explicit(&job->n_rays, q.n_rays, memory_order_relaxed);
    progress_add(end - begin);
}

static int trace_listed(struct light_visibility *v, const struct rays *r, const struct texels *t,
                        const struct lights *l, const struct panorama *p, int *listed, int n_listed,
                        uint64_t seed, int n_threads)
{
    const size_t n_lights = (size_t)l->n + 1, n_workers = (size_t)(n_threads > 0 ? n_threads : parallel_n_cores());
    double(*dir)[3] = v->n_sub > 1 ? malloc(((size_t)n_listed * (size_t)v->n_sub + 1) * sizeof(dir[0])) : NULL;
    double(*centre)[3] = malloc(n_lights * sizeof(centre[0]));
    uint8_t *seen = malloc(n_workers * n_lights * (v->n_sub > 1 ? 1 + (size_t)v->n_sub : 1));
    int32_t(*neighbour)[SECTORS] = v->n_sub > 1 ? find_neighbours(l) : NULL;
    int err = sort_by_place(listed, n_listed, l);
    if (!centre || !seen || (v->n_sub > 1 && (!dir || !neighbour)))
        err = -ENOMEM;
    if (err)
        goto done;
    for (int i = 0; i < l->n; i++)
        mat3_mul_vec(centre[i], l->world_from_probe, l->dir_probe[i]);
    for (int k = 0; k < n_listed; k++) {
        double(*of_light)[3] = dir + (size_t)k * (size_t)v->n_sub;
        if (v->n_sub > 1)
            draw_sub_directions(of_light, l, listed[k], p, v->n_sub, seed);
        for (int s = 0; v->n_sub > 1 && s < v->n_sub; s++)
            mat3_mul_vec(of_light[s], l->world_from_probe, of_light[s]);
        v->traced_directional[listed[k]] =
            place_of_light(l, listed[k], v->traced_from_m[listed[k]]);
    }
    struct light_job job = { .v = v,
                             .rays = r,
                             .texels = t,
                             .lights = l,
                             .n_listed = n_listed,
                             .listed = listed,
                             .dir = (const double(*)[3])dir,
                             .centre = (const double(*)[3])centre,
                             .neighbour = (const int32_t(*)[SECTORS])neighbour,
                             .seen = seen };
    progress_begin("trace lights", t->n);
    parallel_for(n_threads, t->n, CHUNK, trace_texels, &job);
    progress_end();
    v->n_rays += job.n_rays;
    err = 0;
done:
    free(dir);
    free(centre);
    free(seen);
    free(neighbour);
    return err;
}

// Soft visibility draws from the pixels each light was cut from: are they all there?
static int check_regions(const struct lights *l, const struct panorama *p)
{
    if (!l->region || !p) {
        log_error(
            "visibility: soft visibility needs lights cut from a panorama, and that panorama");
        return -EINVAL;
    }
    if (l->panorama_width_px != p->image.width || l->panorama_height_px != p->image.height) {
        log_error("visibility: the lights were cut from a panorama of %d x %d, this one has %d x "
                  "%d: cut them from this one",
                  l->panorama_width_px, l->panorama_height_px, p->image.width, p->image.height);
        return -EINVAL;
    }
    for (int i = 0; i < l->n; i++) {
        const struct light_region *g = &l->region[i];
        if (g->x0 < 0 || g->y0 < 0 || g->x0 > g->x1 || g->y0 > g->y1 || g->x1 > p->image.width ||
            g->y1 > p->image.height) {
            log_error("visibility: light %d was cut from pixels [%d,%d) x [%d,%d), outside the "
                      "panorama of "
                      "%d x %d: cut the lights from this panorama",
                      i, g->x0, g->x1, g->y0, g->y1, p->image.width, p->image.height);
            return -EINVAL;
        }
    }
    return 0;
}

static void set_reference(struct light_visibility *v, const struct texels *t)
{
    for (int c = 0; c < 3; c++) {
        double least = INFINITY, most = -INFINITY;
        for (int i = 0; i < t->n; i++) {
            least = fmin(least, t->position_m[i][c]);
            most = fmax(most, t->position_m[i][c]);
        }
        v->reference_m[c] = t->n ? (least + most) / 2 : 0;
        v->half_size_m[c] = t->n ? (most - least) / 2 : 0;
    }
}

int light_visibility_trace(struct light_visibility *out, const struct rays *r,
                           const struct texels *t, const struct lights *l, const struct panorama *p,
                           int n_sub, uint64_t seed, int n_threads)
{
    memset(out, 0, sizeof(*out));
    if (n_sub != 1 && (n_sub < LEAST_SUB || n_sub > MOST_SUB)) {
        log_error("visibility: %d sub-directions per light: use 1 (hard) or %d to %d", n_sub,
                  LEAST_SUB, MOST_SUB);
        return -EINVAL;
    }
    int err = n_sub > 1 ? check_regions(l, p) : 0;
    if (err)
        return err;
    struct light_visibility v = {
        .n_texels = t->n, .n_lights = l->n, .words_per_texel = (l->n + 15) / 16, .n_sub = n_sub
    };
    const size_t n_texels = (size_t)t->n, n_lights = (size_t)l->n;
    int *all = malloc((n_lights + 1) * sizeof(all[0]));
    v.bits = calloc(n_texels * (size_t)v.words_per_texel + 1, sizeof(v.bits[0]));
    v.soft = n_sub > 1 ? malloc(n_texels * n_lights + 1) : NULL;
    v.traced_from_m = calloc(n_lights + 1, sizeof(v.traced_from_m[0]));
    v.traced_directional = calloc(n_lights + 1, 1);
    if (!all || !v.bits || (n_sub > 1 && !v.soft) || !v.traced_from_m || !v.traced_directional) {
        err = -ENOMEM;
        goto fail;
    }
    set_reference(&v, t);
    for (int i = 0; i < l->n; i++)
        all[i] = i;
    err = trace_listed(&v, r, t, l, p, all, l->n, seed, n_threads);
    if (err)
        goto fail;
    free(all);
    *out = v;
    return 0;
fail:
    free(all);
    light_visibility_free(&v);
    return err;
}

int light_visibility_refresh(struct light_visibility *v, const struct rays *r,
                             const struct texels *t, const struct lights *l,
                             const struct panorama *p, double min_move_rad, uint64_t seed,
                             int n_threads)
{
    assert(v->n_lights == l->n && v->n_texels == t->n);
    int err = v->n_sub > 1 ? check_regions(l, p) : 0;
    if (err)
        return err;
    int *moved = malloc(((size_t)l->n + 1) * sizeof(moved[0])), n_moved = 0;
    if (!moved)
        return -ENOMEM;
    for (int i = 0; i < l->n; i++) {
        double place[3];
        const bool directional = place_of_light(l, i, place);
        if (moved_rad(v, i, place, directional) > min_move_rad)
            moved[n_moved++] = i;
    }
    if (n_moved)
        err = trace_listed(v, r, t, l, p, moved, n_moved, seed, n_threads);
    free(moved);
    return err ? err : n_moved;
}

void light_visibility_free(struct light_visibility *v)
{
    if (!v)
        return;
    free(v->bits);
    free(v->soft);
    free(v->traced_from_m);
    free(v->traced_directional);
    memset(v, 0, sizeof(*v));
}

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__,
               "the raw file is written as it lies in memory");

int light_visibility_write(const struct light_visibility *v, int texture_size, const char *path)
{
    const struct {
        char magic[8];
        uint32_t n_texels, n_lights, words_per_texel, n_sub, texture_size, zero;
    } header = { "RIGVIS01",
                 (uint32_t)v->n_texels,
                 (uint32_t)v->n_lights,
                 (uint32_t)v->words_per_texel,
                 (uint32_t)v->n_sub,
                 (uint32_t)texture_size,
                 0 };
    _Static_assert(sizeof(header) == 32, "as the header promises");
    const size_t n_words = (size_t)v->n_texels * (size_t)v->words_per_texel;
    const size_t n_soft = v->soft ? (size_t)v->n_texels * (size_t)v->n_lights : 0;
    struct atomic_file f;
    int err = atomic_file_open(&f, path);
    if (err)
        return err;
    if (fwrite(&header, sizeof(header), 1, f.stream) != 1 ||
        fwrite(v->bits, sizeof(v->bits[0]), n_words, f.stream) != n_words ||
        (n_soft && fwrite(v->soft, 1, n_soft, f.stream) != n_soft)) {
        err = errno ? -errno : -EIO;
        log_error("visibility: cannot write %s: %s", path, strerror(-err));
        atomic_file_abandon(&f);
        return err;
    }
    return atomic_file_commit(&f);
}
