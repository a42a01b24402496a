// solver/samples.c - what the cameras measured of every texel: project, look, read, store.
//
// View by view, so that one picture is in memory at a time; within a view each texel is one
// thread's own, so the store does not depend on how many there are. A view's samples are kept
// compactly in texel order with one bit per texel that says which texels have one; at the end all
// views are dealt out to the texels by counting.
#include "solver/samples.h"
#include "solver/parallel.h"
#include "solver/silhouette.h"
#include "solver/take/half.h"
#include "solver/take/image.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"
#include "solver/visibility.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { CHUNK_TEXELS = 256, CHUNK_ROWS = 4, MAX_FOOTPRINT_PX = 8, MAX_VIEWS = UINT16_MAX + 1 };

// What a pixel sees is the texel's own surface if it lies no further off the texel's tangent plane
// than this many texels plus this share of its distance along the plane: the mesh bends, and its
// normals are interpolated over flat facets.
static const double LEAVE_TEXELS = 4, BEND = .25;
// The gradient is the difference of two means this far to either side.
static const double GRADIENT_STEP_PX = .5;

struct samples_settings samples_defaults(void)
{
    return (struct samples_settings){
        .grazing_cos = MASK_GRAZING_COS_PERCENT / 100., .erode_px = ERODE_BY_PICTURE, .at_centre = true, .white = 1};
}

// ---- where a texel lies in a view -----------------------------------------------------------

// The pixels a sample is the mean of: a box, centred where the texel's centre falls.
struct footprint {
    double u_px, v_px, half_width_px, half_height_px;
    int x0, x1, y0, y1;          // pixels it reads: columns x0 .. x1-1, rows y0 .. y1-1
    double texels_from_pixel[4]; // 2 x 2: along tangent and bitangent
};

// hypot, fmin and fmax are calls, and guard against what does not occur here.
static double length_of(double x, double y)
{
    return sqrt(x * x + y * y);
}

static double lesser(double x, double y)
{
    return x < y ? x : y;
}

static double greater(double x, double y)
{
    return x > y ? x : y;
}

static double half_side(double spread_px)
{
    return .5 * lesser(greater(spread_px, 1), MAX_FOOTPRINT_PX);
}

// A texel is a square of texel_size_m on the surface, a parallelogram in the picture; the box has
// its spread along x and y. A box of one pixel is bilinear interpolation. False: the box, or those
// that are compared with it, leave the picture.
static bool footprint_of(struct footprint *f, const struct texels *t, int64_t i,
                         const struct camera *camera, bool at_centre)
{
    const double margin_px = at_centre ? 1 : GRADIENT_STEP_PX;
    double point[3], tangent[3], bitangent[3], normal[3], uv_px[2], J[6], M[4];
    for (int c = 0; c < 3; c++) {
        point[c] = (double)t->position_m[i][c];
        normal[c] = (double)t->normal[i][c], tangent[c] = (double)t->tangent[i][c];
    }
    vec3_cross(bitangent, normal, tangent);
    if (!camera_project_jacobian(camera, point, uv_px, J))
        return false;
    for (int k = 0; k < 2; k++) {
        M[2 * k] = vec3_dot(J + 3 * k, tangent) * (double)t->texel_size_m;
        M[2 * k + 1] = vec3_dot(J + 3 * k, bitangent) * (double)t->texel_size_m;
    }
    f->u_px = uv_px[0], f->v_px = uv_px[1];
    f->half_width_px = half_side(length_of(M[0], M[1]));
    f->half_height_px = half_side(length_of(M[2], M[3]));
    const double x_reach = f->half_width_px + margin_px, y_reach = f->half_height_px + margin_px;
    if (!(f->u_px >= x_reach && f->u_px <= camera->width_px - x_reach && f->v_px >= y_reach &&
          f->v_px <= camera->height_px - y_reach))
        return false;
    f->x0 = (int)(f->u_px - f->half_width_px), f->x1 = (int)ceil(f->u_px + f->half_width_px);
    f->y0 = (int)(f->v_px - f->half_height_px), f->y1 = (int)ceil(f->v_px + f->half_height_px);
    const double det = M[0] * M[3] - M[1] * M[2];
    f->texels_from_pixel[0] = M[3] / det, f->texels_from_pixel[1] = -M[1] / det;
    f->texels_from_pixel[2] = -M[2] / det, f->texels_from_pixel[3] = M[0] / det;
    return true;
}

// ---- one view -------------------------------------------------------------------------------

struct view_job {
    const struct texels *texels;
    const struct rays *rays;
    const struct samples_settings *settings;
    const struct camera *camera; // of the picture's size
    const struct image *image;
    int rgb[3], clip;        // channels; clip: -1 if there is none
    int erode_px;            // of this picture
    uint8_t *mask;           // [n texels] MASK_VISIBLE: has a sample; others are left out
    _Atomic uint8_t *wanted; // [height][width] pixels whose ray is asked for
    float (*seen_m)[3];      // [height][width] what it hits; NaN: nothing
    uint16_t (*value)[4];    // [n texels] half floats: R, G, B, gradient
    uint8_t *flags;          // [n texels]
};

struct pixel_range {
    int x0, x1, y0, y1;
};

// The pixels that must see the texel's own surface: those it reads and erode_px around them.
static struct pixel_range pixels_around(const struct view_job *job, const struct footprint *f)
{
    const int e = job->erode_px;
    return (struct pixel_range){
        f->x0 > e ? f->x0 - e : 0,
        job->camera->width_px - f->x1 > e ? f->x1 + e : job->camera->width_px,
        f->y0 > e ? f->y0 - e : 0,
        job->camera->height_px - f->y1 > e ? f->y1 + e : job->camera->height_px};
}

static void want_pixels(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    struct view_job *job = arg;
    const size_t width = (size_t)job->camera->width_px;
    for (int64_t i = begin; i < end; i++) {
        struct footprint f;
        if (job->mask[i] != MASK_VISIBLE)
            continue;
        if (!footprint_of(&f, job->texels, i, job->camera, job->settings->at_centre)) {
            job->mask[i] = MASK_OUTSIDE;
            continue;
        }
        const struct pixel_range p = pixels_around(job, &f);
        for (int y = p.y0; y < p.y1; y++)
            for (int x = p.x0; x < p.x1; x++)
                atomic_store_explicit(&job->wanted[(size_t)y * width + (size_t)x], 1,
                                      memory_order_relaxed);
    }
}

static void see_rows(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    struct view_job *job = arg;
    const struct camera *camera = job->camera;
    const float from[3] = {(float)camera->centre_m[0], (float)camera->centre_m[1],
                           (float)camera->centre_m[2]};
    for (int64_t y = begin; y < end; y++)
        for (int x = 0; x < camera->width_px; x++) {
            const size_t k = (size_t)y * (size_t)camera->width_px + (size_t)x;
            if (!atomic_load_explicit(&job->wanted[k], memory_order_relaxed))
                continue;
            double ray[3];
            struct ray_hit hit = {.t = NAN};
            const double centre_px[2] = {x + .5, (double)y + .5};
            const bool has_ray = camera_ray(camera, centre_px, ray);
            const float dir[3] = {(float)ray[0], (float)ray[1], (float)ray[2]};
            if (!has_ray || !rays_hit(job->rays, from, dir, 0, INFINITY, &hit))
                hit.t = NAN;
            for (int c = 0; c < 3; c++)
                job->seen_m[k][c] = (float)(camera->centre_m[c] + (double)hit.t * ray[c]);
        }
}

static bool sees_only_its_surface(const struct view_job *job, int64_t i, const struct footprint *f)
{
    const struct texels *t = job->texels;
    const struct pixel_range p = pixels_around(job, f);
    const double texel_m = (double)t->texel_size_m, *to_texels = f->texels_from_pixel;
    for (int y = p.y0; y < p.y1; y++)
        for (int x = p.x0; x < p.x1; x++) {
            const float *seen = job->seen_m[(size_t)y * (size_t)job->camera->width_px + (size_t)x];
            double off_m = 0;
            for (int c = 0; c < 3; c++)
                off_m += (double)t->normal[i][c] * ((double)seen[c] - (double)t->position_m[i][c]);
            off_m = fabs(off_m);
            if (off_m <= LEAVE_TEXELS * texel_m)
                continue;
            const double dx = x + .5 - f->u_px, dy = y + .5 - f->v_px;
            const double along = length_of(to_texels[0] * dx + to_texels[1] * dy,
                                           to_texels[2] * dx + to_texels[3] * dy);
            if (!(off_m <= (LEAVE_TEXELS + BEND * along) * texel_m)) // NaN too
                return false;
        }
    return true;
}

static const float *pixel_at(const struct image *image, int x, int y)
{
    return image->data + ((size_t)y * (size_t)image->width + (size_t)x) * (size_t)image->n_channels;
}

// How far what mean_over() weighs lies from the footprint's centre on average, and the mean square of that, along one axis. A
// pixel is itself the mean over its area, which adds 1/12.
static void moments_of(double *first, double *second, double centre_px, double half_px)
{
    const double a = centre_px - half_px, b = centre_px + half_px;
    *first = 0, *second = 1. / 12;
    for (int x = (int)a; x < b; x++) {
        const double share = (lesser(x + 1, b) - greater(x, a)) / (b - a), off = x + .5 - centre_px;
        *first += share * off, *second += share * off * off;
    }
}

// The mean over the footprint moved by (dx, dy): every pixel by the area it shares with the box.
static void mean_over(double rgb[3], const struct view_job *job, const struct footprint *f,
                      double dx_px, double dy_px)
{
    const struct image *image = job->image;
    const double u_px = f->u_px + dx_px, v_px = f->v_px + dy_px; // inside but for rounding
    const double x0 = greater(u_px - f->half_width_px, 0),
                 y0 = greater(v_px - f->half_height_px, 0);
    const double x1 = lesser(u_px + f->half_width_px, image->width),
                 y1 = lesser(v_px + f->half_height_px, image->height);
    rgb[0] = rgb[1] = rgb[2] = 0;
    for (int y = (int)y0; y < y1; y++) {
        const double rows = lesser(y + 1, y1) - greater(y, y0);
        for (int x = (int)x0; x < x1; x++) {
            const double area = rows * (lesser(x + 1, x1) - greater(x, x0));
            const float *pixel = pixel_at(image, x, y);
            for (int c = 0; c < 3; c++)
                rgb[c] += area * (double)pixel[job->rgb[c]];
        }
    }
    for (int c = 0; c < 3; c++)
        rgb[c] /= (x1 - x0) * (y1 - y0);
}

// The value at the footprint's centre of a radiance that is quadratic there: the mean over the footprint less what slope and
// curvature, from the footprints a pixel away, add to it. Less of that for wide footprints: it would let sharp edges ring, and noise in.
static void value_at_centre(double rgb[3], const struct view_job *job, const struct footprint *f)
{
    double mean[3], at[4][3];
    mean_over(mean, job, f, 0, 0);
    mean_over(at[0], job, f, -1, 0);
    mean_over(at[1], job, f, 1, 0);
    mean_over(at[2], job, f, 0, -1);
    mean_over(at[3], job, f, 0, 1);
    double first[2], second[2], share[2];
    share[0] = lesser(1, 1 / (f->half_width_px * f->half_width_px));
    share[1] = lesser(1, 1 / (f->half_height_px * f->half_height_px));
    moments_of(&first[0], &second[0], f->u_px, f->half_width_px);
    moments_of(&first[1], &second[1], f->v_px, f->half_height_px);
    for (int c = 0; c < 3; c++) {
        rgb[c] = mean[c];
        for (int axis = 0; axis < 2; axis++) {
            const double before = at[2 * axis][c], after = at[2 * axis + 1][c];
            rgb[c] -= first[axis] * (after - before) / 2 + share[axis] * second[axis] * (after - 2 * mean[c] + before) / 2;
        }
    }
}

static double luminance_at(const struct view_job *job, const struct footprint *f, double dx_px,
                           double dy_px)
{
    double rgb[3];
    mean_over(rgb, job, f, dx_px, dy_px);
    return .2126 * rgb[0] + .7152 * rgb[1] + .0722 * rgb[2];
}

static bool is_clipped(const struct view_job *job, const struct footprint *f)
{
    const float white = job->settings->white > 0 ? (float)job->settings->white : INFINITY;
    for (int y = f->y0; y < f->y1; y++)
        for (int x = f->x0; x < f->x1; x++) {
            const float *pixel = pixel_at(job->image, x, y);
            if (job->clip >= 0 ? pixel[job->clip] > .5f
                               : pixel[job->rgb[0]] >= white || pixel[job->rgb[1]] >= white ||
                                     pixel[job->rgb[2]] >= white)
                return true;
        }
    return false;
}

static void read_texels(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    struct view_job *job = arg;
    for (int64_t i = begin; i < end; i++) {
        struct footprint f;
        if (job->mask[i] != MASK_VISIBLE)
            continue;
        if (!footprint_of(&f, job->texels, i, job->camera, job->settings->at_centre) || !sees_only_its_surface(job, i, &f)) {
            job->mask[i] = MASK_OCCLUDED;
            continue;
        }
        double rgb[3];
        const double step = GRADIENT_STEP_PX;
        const double across = luminance_at(job, &f, step, 0) - luminance_at(job, &f, -step, 0),
                     down = luminance_at(job, &f, 0, step) - luminance_at(job, &f, 0, -step);
        if (job->settings->at_centre && job->erode_px > 0)
            value_at_centre(rgb, job, &f);
        else
            mean_over(rgb, job, &f, 0, 0);
        for (int c = 0; c < 3; c++)
            job->value[i][c] = half_from_float((float)rgb[c]);
        job->value[i][3] = half_from_float((float)(length_of(across, down) / (2 * step)));
        job->flags[i] = is_clipped(job, &f) ? SAMPLE_CLIPPED : 0;
    }
}

static int find_channels(struct view_job *job, const struct image *image, const char *path)
{
    static const char *const read[] = {"R", "G", "B", "clip", NULL};
    for (int c = 0; c < 3; c++) {
        job->rgb[c] = image_channel(image, read[c]);
        if (job->rgb[c] < 0) {
            log_error("samples: view %s: %s has no channel %s; a picture needs R, G and B",
                      job->camera->name, path, read[c]);
            return -EINVAL;
        }
    }
    job->clip = image_channel(image, "clip");
    return image_require_finite(image, read, path);
}

// A view's picture, and its camera of the picture's size. On failure there is nothing to free.
static int open_view(struct view_job *job, struct camera *camera, struct image *image, const char *path)
{
    int err = image_read(image, path);
    if (err)
        return err;
    job->camera = camera, job->image = image;
    err = find_channels(job, image, path);
    if (!err && !camera_has_aspect(camera, image->width, image->height)) {
        log_error("samples: view %s: %s has %d x %d pixels, but its camera is calibrated for %d x "
                  "%d, another aspect: is it cropped or turned?",
                  camera->name, path, image->width, image->height, camera->width_px, camera->height_px);
        err = -EINVAL;
    }
    if (err)
        image_free(image);
    else
        camera_resize(camera, image->width, image->height);
    return err;
}

// Marks the texels that have a sample in job->mask and fills their value and flags.
static int gather_view(struct view_job *job, const struct camera *calibrated, const char *path)
{
    struct camera camera = *calibrated;
    struct image image;
    int err = open_view(job, &camera, &image, path);
    if (err)
        return err;
    const size_t n_pixels = (size_t)image.width * (size_t)image.height;
    job->wanted = calloc(n_pixels, sizeof(job->wanted[0]));
    job->seen_m = malloc(n_pixels * sizeof(job->seen_m[0])); // touched only where wanted
    if (!job->wanted || !job->seen_m) {
        err = -ENOMEM;
        goto done;
    }
    const int n_threads = job->settings->n_threads, n = job->texels->n;
    visibility_camera_mask(job->mask, job->rays, job->texels, &camera, job->settings->grazing_cos,
                           n_threads);
    parallel_for(n_threads, n, CHUNK_TEXELS, want_pixels, job);
    parallel_for(n_threads, image.height, CHUNK_ROWS, see_rows, job);
    parallel_for(n_threads, n, CHUNK_TEXELS, read_texels, job);
done:
    free(job->wanted);
    free(job->seen_m);
    job->wanted = NULL, job->seen_m = NULL;
    image_free(&image);
    return err;
}

// ---- how far from edges ---------------------------------------------------------------------

// Light from beyond an edge, in pixels well inside of it, is not noise: it says the same in every view that the edge is in, and
// moves lights. The note says how far developing may look, the pictures themselves how far light has come, by whatever way.
enum { NO_NOTE = -1, AHD_SPREAD_PX = 3, MOST_SPREAD_PX = 16, LOOKED_AT_VIEWS = 8 };

static int spread_noted_px(const char *path)
{
    enum { ROOM = 12 };
    char text[ROOM], *end;
    if (image_read_note(path, IMAGE_SPREAD_NOTE, text, sizeof(text)))
        return NO_NOTE;
    const long px = strtol(text, &end, 10);
    return end == text || *end || px < 0 ? NO_NOTE : px > MOST_SPREAD_PX ? MOST_SPREAD_PX : (int)px;
}

// A pixel is itself the mean over its area, half a pixel to either side: less than SHARP_PX looks like that alone.
static int spread_seen_px(double reach_px)
{
    static const double SHARP_PX = 1, OWN_PX = .5;
    return reach_px <= SHARP_PX ? 0 : (int)lesser(ceil(reach_px - OWN_PX), MOST_SPREAD_PX);
}

// out->edge_reach_px and edge_offset_px.
static int look_at_edges(struct samples *out, struct view_job *job, const struct cameras *cameras, const char *const *image_paths)
{
    struct silhouette together = {0};
    int n = 0, err = 0;
    for (int v = 0; v < cameras->n; v++)
        n += image_paths[v] != NULL;
    const int n_looked_at = n < LOOKED_AT_VIEWS ? n : LOOKED_AT_VIEWS;
    for (int v = 0, i = 0, k = 0; v < cameras->n && k < n_looked_at && !err; v++) {
        if (!image_paths[v] || i++ != (2 * k + 1) * n / (2 * n_looked_at))
            continue;
        struct camera camera = cameras->view[v];
        struct image image;
        k++;
        err = open_view(job, &camera, &image, image_paths[v]);
        if (err)
            break;
        silhouette_add(&together, job->rays, &camera, &image, job->rgb);
        image_free(&image);
    }
    if (!err)
        (void)silhouette_reach(&together, &out->edge_reach_px, &out->edge_offset_px); // or NaN
    return err;
}

struct edge_words { // what is said about edges, once for all views
    int n_unknown, n_beyond_note;
    int noted_px; // of the last view beyond its note
};

static int edge_px_of(const char *path, const struct samples *s, const struct samples_settings *settings, struct edge_words *words)
{
    if (settings->erode_px != ERODE_BY_PICTURE)
        return settings->erode_px;
    const int noted = spread_noted_px(path);
    if (isnan(s->edge_reach_px)) {
        words->n_unknown += noted == NO_NOTE;
        return 1 + (noted == NO_NOTE ? AHD_SPREAD_PX : noted);
    }
    const int seen = spread_seen_px(s->edge_reach_px);
    if (noted >= seen)
        return 1 + noted;
    if (noted != NO_NOTE && seen > noted + 1)
        words->n_beyond_note++, words->noted_px = noted;
    return 1 + seen;
}

static void say_edges(const struct samples *s, const struct edge_words *words)
{
    if (words->n_unknown)
        log_warning("samples: in %d of %d views neither a note in the picture nor the object's outline says how far light has spread over "
                    "edges: samples keep %d px away, as after demosaicing by AHD",
                    words->n_unknown, s->n_views, 1 + AHD_SPREAD_PX);
    if (words->n_beyond_note)
        log_warning("samples: pixels up to %.1f px from the object's outline see both sides of it, though their notes say that developing spread light by "
                    "%d px: out of focus, moved, or are cameras or mesh off (on average by %.1f px)? Samples keep %d px away",
                    s->edge_reach_px, words->noted_px, fabs(s->edge_offset_px), s->edge_px);
}

// ---- all views ------------------------------------------------------------------------------

// One view's samples in texel order.
struct kept_view {
    uint64_t *has;        // [ceil(n_texels / 64)] bit t: texel t has one; NULL: no samples at all
    uint16_t (*value)[4]; // R, G, B, gradient
    uint8_t *flags;
};

static void kept_view_free(struct kept_view *k)
{
    free(k->has);
    free(k->value);
    free(k->flags);
    *k = (struct kept_view){0};
}

// Keep what job found, and add it to the texels' counts.
static int keep_view(struct kept_view *k, const struct view_job *job, int64_t *count)
{
    const size_t n_texels = (size_t)job->texels->n;
    size_t n = 0;
    for (size_t t = 0; t < n_texels; t++)
        n += job->mask[t] == MASK_VISIBLE;
    k->has = calloc(n_texels / 64 + 1, sizeof(k->has[0]));
    k->value = malloc((n + 1) * sizeof(k->value[0]));
    k->flags = malloc(n + 1);
    if (!k->has || !k->value || !k->flags)
        return -ENOMEM; // the caller frees
    n = 0;
    for (size_t t = 0; t < n_texels; t++) {
        if (job->mask[t] != MASK_VISIBLE)
            continue;
        k->has[t / 64] |= UINT64_C(1) << t % 64;
        memcpy(k->value[n], job->value[t], sizeof(k->value[n]));
        k->flags[n++] = job->flags[t];
        count[t]++;
    }
    return 0;
}

// s->first holds the texels' counts, one place up: make them places, and put every view's samples
// into theirs. A view is freed as soon as it is dealt out.
static int deal_out(struct samples *s, struct kept_view *kept)
{
    for (int t = 0; t < s->n_texels; t++)
        s->first[t + 1] += s->first[t];
    s->n = s->first[s->n_texels];
    s->view = malloc(((size_t)s->n + 1) * sizeof(s->view[0]));
    s->radiance = malloc(((size_t)s->n + 1) * sizeof(s->radiance[0]));
    s->gradient = malloc(((size_t)s->n + 1) * sizeof(s->gradient[0]));
    s->flags = malloc((size_t)s->n + 1);
    if (!s->view || !s->radiance || !s->gradient || !s->flags)
        return -ENOMEM;
    int64_t n_clipped = 0;
    for (int v = 0; v < s->n_views; v++) {
        const struct kept_view *k = &kept[v];
        for (int64_t t = 0, from = 0; k->has && t < s->n_texels; t++) {
            if (!(k->has[t / 64] >> t % 64 & 1))
                continue;
            const int64_t to = s->first[t]++; // ends up where the next texel's begin
            s->view[to] = (uint16_t)v;
            memcpy(s->radiance[to], k->value[from], sizeof(s->radiance[to]));
            s->gradient[to] = k->value[from][3];
            s->flags[to] = k->flags[from++];
            n_clipped += s->flags[to] & SAMPLE_CLIPPED;
        }
        kept_view_free(&kept[v]);
    }
    memmove(s->first + 1, s->first, (size_t)s->n_texels * sizeof(s->first[0]));
    s->first[0] = 0;
    s->clipped_share = s->n ? (double)n_clipped / (double)s->n : 0;
    return 0;
}

int samples_gather(struct samples *out, const struct texels *t, const struct rays *r,
                   const struct cameras *cameras, const char *const *image_paths,
                   const struct samples_settings *settings)
{
    assert(settings->erode_px >= ERODE_BY_PICTURE);
    memset(out, 0, sizeof(*out));
    if (cameras->n > MAX_VIEWS) {
        log_error("samples: %d views; at most %d are taken", cameras->n, MAX_VIEWS);
        return -EINVAL;
    }
    const size_t n_texels = (size_t)t->n, n_views = (size_t)cameras->n;
    struct samples s = {.n_texels = t->n, .n_views = cameras->n, .edge_reach_px = NAN, .edge_offset_px = NAN};
    struct edge_words words = {0};
    struct view_job job = {.texels = t, .rays = r, .settings = settings};
    struct kept_view *kept = calloc(n_views + 1, sizeof(kept[0]));
    job.mask = malloc(n_texels + 1);
    job.value = malloc((n_texels + 1) * sizeof(job.value[0]));
    job.flags = malloc(n_texels + 1);
    s.first = calloc(n_texels + 1, sizeof(s.first[0]));
    s.centre_m = calloc(n_views + 1, sizeof(s.centre_m[0]));
    s.name = calloc(n_views + 1, sizeof(s.name[0]));
    int err = -ENOMEM;
    if (!kept || !job.mask || !job.value || !job.flags || !s.first || !s.centre_m || !s.name)
        goto done;
    err = settings->erode_px == ERODE_BY_PICTURE ? look_at_edges(&s, &job, cameras, image_paths) : 0;
    progress_begin("gather samples", cameras->n);
    for (int v = 0; v < cameras->n && !err; v++) {
        const struct camera *camera = &cameras->view[v];
        memcpy(s.centre_m[v], camera->centre_m, sizeof(s.centre_m[v]));
        memcpy(s.name[v], camera->name, sizeof(s.name[v]));
        if (image_paths[v]) {
            job.erode_px = edge_px_of(image_paths[v], &s, settings, &words);
            s.edge_px = job.erode_px > s.edge_px ? job.erode_px : s.edge_px;
            err = gather_view(&job, camera, image_paths[v]);
        }
        if (image_paths[v] && !err)
            err = keep_view(&kept[v], &job, s.first + 1);
        progress_add(1);
    }
    progress_end();
    if (!err)
        say_edges(&s, &words);
    if (!err)
        err = deal_out(&s, kept);
done:
    for (size_t v = 0; kept && v < n_views; v++)
        kept_view_free(&kept[v]);
    free(kept);
    free(job.mask);
    free(job.value);
    free(job.flags);
    if (err)
        samples_free(&s);
    *out = s;
    return err;
}

void samples_free(struct samples *s)
{
    if (!s)
        return;
    free(s->first);
    free(s->view);
    free(s->radiance);
    free(s->gradient);
    free(s->flags);
    free(s->centre_m);
    free(s->name);
    memset(s, 0, sizeof(*s));
}

// ---- reading it -----------------------------------------------------------------------------

void samples_radiance(const struct samples *s, int64_t i, float rgb[3])
{
    for (int c = 0; c < 3; c++)
        rgb[c] = float_from_half(s->radiance[i][c]);
}

float samples_gradient(const struct samples *s, int64_t i)
{
    return float_from_half(s->gradient[i]);
}

void samples_view_direction(const struct samples *s, const struct texels *t, int texel, int view,
                            float v[3])
{
    double towards[3];
    for (int c = 0; c < 3; c++)
        towards[c] = s->centre_m[view][c] - (double)t->position_m[texel][c];
    vec3_normalise(towards);
    for (int c = 0; c < 3; c++)
        v[c] = (float)towards[c];
}
