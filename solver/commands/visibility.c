// solver/commands/visibility.c - rigsolve visibility: which cameras and lights see which texel, as
// pictures and numbers.
#include "solver/cameras.h"
#include "solver/commands/commands.h"
#include "solver/lights.h"
#include "solver/mesh.h"
#include "solver/parallel.h"
#include "solver/rays.h"
#include "solver/take/atomic_file.h"
#include "solver/take/image.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/take/take.h"
#include "solver/texels.h"
#include "solver/vec3.h"
#include "solver/visibility.h"

#include <argp.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

// ---- arguments ----

struct settings {
    const char *take, *mesh, *cameras, *panorama, *lights, *world_from_probe, *images, *out,
        *overlay;
    int n_lights, texture, n_sub, n_threads;
    uint64_t seed;
    double grazing_cos, distance_m, centre_m[3];
    bool has_centre, json;
};

enum {
    OPTION_MESH = 256,
    OPTION_CAMERAS,
    OPTION_PANORAMA,
    OPTION_LIGHTS,
    OPTION_WORLD_FROM_PROBE,
    OPTION_TEXTURE,
    OPTION_SOFT,
    OPTION_GRAZING,
    OPTION_CENTRE,
    OPTION_DISTANCE,
    OPTION_IMAGES,
    OPTION_OVERLAY,
    OPTION_THREADS,
    OPTION_SEED,
    OPTION_JSON,
};

static const struct argp_option options[] = {
    { 0, 0, 0, 0, "Input (with TAKE: in place of the take's own)", 1 },
    { "mesh", OPTION_MESH, "FILE", 0, "OBJ, PLY, glTF or GLB with a UV atlas", 1 },
    { "cameras", OPTION_CAMERAS, "PATH", 0, "calibrated views: a COLMAP folder", 1 },
    { "panorama", OPTION_PANORAMA, "FILE", 0, "HDR panorama the lights are cut from", 1 },
    { "lights", OPTION_LIGHTS, "N|FILE", 0,
      "how many lights to cut from the panorama (a power of two; default 256), or a lights.json",
      1 },
    { "world-from-probe", OPTION_WORLD_FROM_PROBE, "FILE", 0,
      "JSON with world_from_probe (3x3) and perhaps centre_m; default: the take's start.json", 1 },
    { "centre", OPTION_CENTRE, "X,Y,Z", 0,
      "where the panorama was taken, metres; default: what lights.json says by the places of its "
      "lights, else the middle of the mesh's bounding box", 1 },
    { "distance", OPTION_DISTANCE, "M", 0,
      "distance of all lights from there, metres; default: infinity (or what lights.json says)",
      1 },
    { "images", OPTION_IMAGES, "DIR", 0, "the views' pictures, for --overlay", 1 },
    { 0, 0, 0, 0, "What is traced", 2 },
    { "texture", OPTION_TEXTURE, "N", 0, "N x N texels (default 512)", 2 },
    { "grazing", OPTION_GRAZING, "COS", 0,
      "views flatter than this cosine count as grazing (default .15)", 2 },
    { "soft", OPTION_SOFT, "K", 0,
      "soft visibility from K = 4..16 directions within each light's own panorama pixels; 0: off "
      "(default)",
      2 },
    { "threads", OPTION_THREADS, "N", 0, "default: all cores; the result is the same", 2 },
    { "seed", OPTION_SEED, "N", 0, "of the soft directions (default 1)", 2 },
    { 0, 0, 0, 0, "Output", 3 },
    { "output", 'o', "DIR", 0, "where visibility/ is written (required)", 3 },
    { "overlay", OPTION_OVERLAY, "DIR", 0,
      "draw the mesh's silhouette over every view that has a picture: DIR/<view>.png", 3 },
    { "json", OPTION_JSON, 0, 0, "report as one line of JSON", 3 },
    { 0 },
};

static const char doc[] =
    "Trace which cameras and which lights see which texel of the mesh's atlas.\v"
    "TAKE is a folder with geometry/, linear/, panorama.exr and perhaps start.json; or name the "
    "pieces one by one. "
    "Without a panorama or lights only the cameras are traced.\n\n"
    "DIR/visibility/<view>.png: 255 visible, 170 grazing, 85 occluded or facing away, 0 outside "
    "the image. "
    "coverage.png: share of the views that see a texel. shadow.png: share of the light above a "
    "texel's horizon that "
    "reaches it. lights.bin: one bit per texel and light (solver/visibility.h).\n\n"
    "Exit status: 0 done, 1 failed, 2 usage, 3 done, but no camera sees the mesh.";

static long long integer_of(struct argp_state *state, const char *option, const char *text,
                            long long least, long long most)
{
    char *end;
    errno = 0;
    const long long value = strtoll(text, &end, 10);
    if (end == text || *end || errno || value < least || value > most)
        argp_error(state, "--%s '%s': expected a whole number from %lld to %lld", option, text,
                   least, most);
    return value;
}

static double number_of(struct argp_state *state, const char *option, const char *text,
                        double least, double most)
{
    char *end;
    const double value = strtod(text, &end);
    if (end == text || *end || !(value >= least && value <= most))
        argp_error(state, "--%s '%s': expected a number from %g to %g", option, text, least, most);
    return value;
}

static void parse_centre(struct argp_state *state, const char *text, double centre_m[3])
{
    const char *at = text;
    for (int c = 0; c < 3; c++) {
        char *end;
        centre_m[c] = strtod(at, &end);
        if (end == at || *end != (c < 2 ? ',' : '\0') || !(fabs(centre_m[c]) <= 1e9))
            argp_error(state, "--centre '%s': expected three numbers in metres, as 0,0.1,1.2",
                       text);
        at = end + 1;
    }
}

static error_t parse_option(int key, char *text, struct argp_state *state)
{
    struct settings *s = state->input;
    switch (key) {
    case OPTION_MESH:
        s->mesh = text;
        return 0;
    case OPTION_CAMERAS:
        s->cameras = text;
        return 0;
    case OPTION_PANORAMA:
        s->panorama = text;
        return 0;
    case OPTION_LIGHTS:
        // All digits: a number. Anything else names a file.
        s->lights = text[strspn(text, "0123456789")] ? text : NULL;
        if (!s->lights) {
            s->n_lights = (int)integer_of(state, "lights", text, 1, LIGHTS_MAX);
            if (s->n_lights & (s->n_lights - 1))
                argp_error(state,
                           "--lights '%s': expected a power of two up to %d, or a lights.json",
                           text, LIGHTS_MAX);
        }
        return 0;
    case OPTION_WORLD_FROM_PROBE:
        s->world_from_probe = text;
        return 0;
    case OPTION_CENTRE:
        parse_centre(state, text, s->centre_m);
        s->has_centre = true;
        return 0;
    case OPTION_DISTANCE:
        s->distance_m = number_of(state, "distance", text, 1e-3, 1e6);
        return 0;
    case OPTION_IMAGES:
        s->images = text;
        return 0;
    case OPTION_TEXTURE:
        s->texture = (int)integer_of(state, "texture", text, 1, 16384);
        return 0;
    case OPTION_GRAZING:
        s->grazing_cos = number_of(state, "grazing", text, 0, 1);
        return 0;
    case OPTION_SOFT:
        s->n_sub = (int)integer_of(state, "soft", text, 0, 16);
        if (s->n_sub > 0 && s->n_sub < 4)
            argp_error(state, "--soft '%s': expected 0 (off) or 4 to 16", text);
        s->n_sub = s->n_sub ? s->n_sub : 1;
        return 0;
    case OPTION_THREADS:
        s->n_threads = (int)integer_of(state, "threads", text, 1, 256);
        return 0;
    case OPTION_SEED:
        s->seed = (uint64_t)integer_of(state, "seed", text, 0, INT64_MAX);
        return 0;
    case OPTION_OVERLAY:
        s->overlay = text;
        return 0;
    case OPTION_JSON:
        s->json = true;
        return 0;
    case 'o':
        s->out = text;
        return 0;
    case ARGP_KEY_ARG:
        if (s->take)
            argp_error(state, "a second take '%s': expected one", text);
        s->take = text;
        return 0;
    case ARGP_KEY_END:
        if (!s->take && (!s->mesh || !s->cameras))
            argp_error(state, "expected a TAKE, or --mesh and --cameras");
        if (!s->out)
            argp_error(state, "no -o DIR: where shall the result go?");
        if (s->overlay && !s->take && !s->images)
            argp_error(state, "--overlay needs pictures: a TAKE, or --images DIR");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

// ---- what is loaded ----

struct scene {
    struct take *take;
    struct mesh mesh;
    struct rays *rays;
    struct texels texels;
    struct cameras cameras;
    struct panorama panorama; // no pixels: none
    struct lights lights;     // n = 0: none
    struct light_visibility visibility;
};

static void free_scene(struct scene *s)
{
    light_visibility_free(&s->visibility);
    lights_free(&s->lights);
    panorama_free(&s->panorama);
    cameras_free(&s->cameras);
    texels_free(&s->texels);
    rays_free(s->rays);
    mesh_free(&s->mesh);
    take_close(s->take);
}

static int open_take(struct scene *scene, struct settings *s)
{
    if (!s->take)
        return 0;
    int err = take_open(&scene->take, s->take);
    if (err)
        return err;
    err = take_require(scene->take, (s->mesh ? 0 : TAKE_MESH) | (s->cameras ? 0 : TAKE_CAMERAS) |
                                        (s->overlay && !s->images ? TAKE_VIEWS : 0));
    if (err)
        return err;
    if (!s->mesh)
        s->mesh = scene->take->mesh_path;
    if (!s->cameras)
        s->cameras = scene->take->cameras_path;
    if (!s->panorama)
        s->panorama = scene->take->panorama_path;
    if (!s->world_from_probe && !s->lights)
        s->world_from_probe = scene->take->start_path;
    return 0;
}

// R, and c if the file has it.
static int read_world_from_probe(const char *path, struct lights *l, bool *has_centre)
{
    struct json *doc_ = NULL;
    double rotation[9], centre_m[3], gram[9];
    int err = json_read(&doc_, path);
    if (err)
        return err;
    err = json_require_numbers(doc_, "world_from_probe", rotation, 9, path);
    if (err)
        goto done;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            gram[3 * i + j] = vec3_dot(rotation + 3 * i, rotation + 3 * j) - (i == j);
    for (int i = 0; i < 9; i++)
        if (!(fabs(gram[i]) < 1e-4) || !(mat3_det(rotation) > 0)) {
            log_error("visibility: %s: world_from_probe is not a rotation (determinant %g): "
                      "expected three "
                      "orthonormal rows, right-handed",
                      path, mat3_det(rotation));
            err = -EINVAL;
            goto done;
        }
    memcpy(l->world_from_probe, rotation, sizeof(rotation));
    if (json_get(doc_, "centre_m")) {
        err = json_require_numbers(doc_, "centre_m", centre_m, 3, path);
        if (err)
            goto done;
        memcpy(l->centre_m, centre_m, sizeof(centre_m));
        *has_centre = true;
    }
done:
    json_free(doc_);
    return err;
}

static int load_lights(struct scene *scene, const struct settings *s)
{
    if (!s->panorama && !s->lights)
        return 0;
    const bool needs_pixels = !s->lights || s->n_sub > 1;
    int err = needs_pixels && s->panorama ? panorama_read(&scene->panorama, s->panorama) : 0;
    if (err)
        return err;
    struct lights *l = &scene->lights;
    err = s->lights ? lights_read_json(l, s->lights)
                    : lights_median_cut(l, &scene->panorama, s->n_lights);
    if (err)
        return err;
    bool has_centre = false; // a lights.json tells it by the places of its lights
    for (int i = 0; s->lights && i < l->n; i++)
        has_centre = has_centre || l->inverse_distance[i] > 0;
    if (s->world_from_probe) {
        err = read_world_from_probe(s->world_from_probe, l, &has_centre);
        if (err)
            return err;
    } else if (!s->lights) {
        log_warning(
            "visibility: no --world-from-probe: the panorama is taken to have the world's axes");
    }
    for (int c = 0; c < 3; c++) {
        if (s->has_centre)
            l->centre_m[c] = s->centre_m[c];
        else if (!has_centre)
            l->centre_m[c] = (scene->mesh.bounds_m[0][c] + scene->mesh.bounds_m[1][c]) / 2;
    }
    for (int i = 0; s->distance_m > 0 && i < l->n; i++)
        l->inverse_distance[i] = 1 / s->distance_m;
    return 0;
}

static int load(struct scene *scene, struct settings *s)
{
    struct mesh_check check;
    int err = open_take(scene, s);
    if (err)
        return err;
    err = mesh_read(&scene->mesh, &check, s->mesh);
    if (err)
        return err;
    mesh_check_log(&check, &scene->mesh, s->mesh);
    err = texels_rasterise(&scene->texels, &scene->mesh, s->texture);
    if (err)
        return err;
    err = rays_new(&scene->rays, &scene->mesh);
    if (err)
        return err;
    err = cameras_read(&scene->cameras, s->cameras);
    if (err)
        return err;
    return load_lights(scene, s);
}

// ---- cameras ----

struct view_report {
    int n_visible, n_grazing, n_occluded, n_outside;
    bool drawn;
    double iou; // of the silhouette and the picture's alpha; negative: no alpha
};

struct report {
    struct view_report *view; // [n_views]
    int n_seen_by_none, n_lit_by_none;
    double camera_s, light_s;
};

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// dir/<name>.<extension>; a view's name may hold folders, a file's may not.
static char *path_in(const char *dir, const char *name, const char *extension)
{
    char *path;
    if (asprintf(&path, "%s/%s.%s", dir, name, extension) < 0)
        return NULL;
    for (char *p = path + strlen(dir) + 1; *p; p++)
        if (*p == '/')
            *p = '_';
    return path;
}

static int write_bytes_png(const char *dir, const char *name, const struct texels *t,
                           const uint8_t *bytes)
{
    char *path = path_in(dir, name, "png");
    const int err = path ? visibility_write_mask_png(bytes, t, path) : -ENOMEM;
    free(path);
    return err;
}

static int trace_cameras(const struct scene *scene, const struct settings *s, const char *dir,
                         struct report *report)
{
    const struct texels *t = &scene->texels;
    const int n_views = scene->cameras.n;
    int err = -ENOMEM;
    uint8_t *mask = malloc((size_t)t->n);
    int *n_seeing = calloc((size_t)t->n, sizeof(n_seeing[0]));
    if (!mask || !n_seeing)
        goto done;
    const double begin_s = now_s();
    progress_begin("trace cameras", n_views);
    for (int i = 0; i < n_views; i++) {
        const struct camera *camera = &scene->cameras.view[i];
        struct view_report *view = &report->view[i];
        visibility_camera_mask(mask, scene->rays, t, camera, s->grazing_cos, s->n_threads);
        for (int k = 0; k < t->n; k++) {
            view->n_visible += mask[k] == MASK_VISIBLE;
            view->n_grazing += mask[k] == MASK_GRAZING;
            view->n_occluded += mask[k] == MASK_OCCLUDED;
            view->n_outside += mask[k] == MASK_OUTSIDE;
            n_seeing[k] += mask[k] == MASK_VISIBLE;
        }
        err = write_bytes_png(dir, camera->name, t, mask);
        if (err) {
            progress_end();
            goto done;
        }
        progress_add(1);
    }
    progress_end();
    report->camera_s = now_s() - begin_s;
    for (int k = 0; k < t->n; k++) {
        report->n_seen_by_none += !n_seeing[k];
        mask[k] = (uint8_t)((255 * n_seeing[k] + n_views / 2) / (n_views ? n_views : 1));
    }
    err = write_bytes_png(dir, "coverage", t, mask);
done:
    free(mask);
    free(n_seeing);
    return err;
}

// ---- lights ----

struct shadow_job {
    const struct scene *scene;
    uint8_t *share; // of the light above the horizon that arrives, x 255
    uint8_t *lit;
};

static void shade_texels(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    const struct shadow_job *job = arg;
    const struct texels *t = &job->scene->texels;
    const struct lights *l = &job->scene->lights;
    const struct light_visibility *v = &job->scene->visibility;
    for (int64_t i = begin; i < end; i++) {
        const double point[3] = { t->position_m[i][0], t->position_m[i][1], t->position_m[i][2] };
        const double normal[3] = { t->normal[i][0], t->normal[i][1], t->normal[i][2] };
        double above = 0, arrives = 0;
        for (int k = 0; k < l->n; k++) {
            struct light_at at;
            light_at_point(l, k, point, &at);
            const double *irradiance = l->irradiance[k];
            const double energy =
                fmax(vec3_dot(normal, at.l), 0) * at.weight *
                (.2126 * irradiance[0] + .7152 * irradiance[1] + .0722 * irradiance[2]);
            const bool bit = v->bits[i * v->words_per_texel + k / 16] >> k % 16 & 1;
            above += energy;
            arrives += energy * (v->soft ? v->soft[i * v->n_lights + k] / 255. : bit);
        }
        job->share[i] = above > 0 ? (uint8_t)lround(255 * arrives / above) : 0;
        job->lit[i] = arrives > 0;
    }
}

static int trace_lights(struct scene *scene, const struct settings *s, const char *dir,
                        struct report *report)
{
    const struct texels *t = &scene->texels;
    uint8_t *share = malloc((size_t)t->n), *lit = malloc((size_t)t->n);
    char *path = path_in(dir, "lights", "bin");
    int err = -ENOMEM;
    if (!share || !lit || !path)
        goto done;
    const double begin_s = now_s();
    err = light_visibility_trace(&scene->visibility, scene->rays, t, &scene->lights,
                                 scene->panorama.image.data ? &scene->panorama : NULL, s->n_sub,
                                 s->seed, s->n_threads);
    if (err)
        goto done;
    report->light_s = now_s() - begin_s;
    err = light_visibility_write(&scene->visibility, t->size, path);
    if (err)
        goto done;
    parallel_for(s->n_threads, t->n, 256, shade_texels, &(struct shadow_job){ scene, share, lit });
    for (int i = 0; i < t->n; i++)
        report->n_lit_by_none += !lit[i];
    err = write_bytes_png(dir, "shadow", t, share);
done:
    free(share);
    free(lit);
    free(path);
    return err;
}

// ---- overlays ----

struct silhouette_job {
    const struct rays *rays;
    const struct camera *camera;
    uint8_t *hit; // [height][width]
};

static void trace_rows(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    const struct silhouette_job *job = arg;
    const struct camera *camera = job->camera;
    const float origin[3] = { (float)camera->centre_m[0], (float)camera->centre_m[1],
                              (float)camera->centre_m[2] };
    for (int64_t y = begin; y < end; y++)
        for (int x = 0; x < camera->width_px; x++) {
            double dir[3] = { 0 };
            const bool ok = camera_ray(camera, (const double[2]){ x + .5, (double)y + .5 }, dir);
            const float d[3] = { (float)dir[0], (float)dir[1], (float)dir[2] };
            job->hit[y * camera->width_px + x] =
                ok && rays_blocked(job->rays, origin, d, 0, INFINITY);
        }
}

static int compare_floats(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

// So that the subject's 98th percentile (of the first channel) comes out just below white.
static double exposure_for(const struct image *image, const uint8_t *hit)
{
    const size_t n_pixels = (size_t)image->width * (size_t)image->height;
    float *value = malloc(n_pixels * sizeof(value[0]));
    size_t n = 0;
    for (size_t i = 0; value && i < n_pixels; i++)
        if (hit[i] && isfinite(image->data[i * (size_t)image->n_channels]))
            value[n++] = image->data[i * (size_t)image->n_channels];
    double exposure_ev = 0;
    if (n) {
        qsort(value, n, sizeof(value[0]), compare_floats);
        exposure_ev = log2(.8 / fmax(value[n - 1 - n / 50], 1e-6));
    }
    free(value);
    return exposure_ev;
}

static bool is_hit(const uint8_t *hit, int width, int height, int x, int y)
{
    return x >= 0 && y >= 0 && x < width && y < height && hit[y * width + x];
}

// The picture, a small one magnified, with a line along the edge between hit and missed pixels: on
// the missed ones' side, so that no pixel of the subject is painted over.
static int draw_outline(const struct image *image, const uint8_t *hit, const char *path)
{
    const int width = image->width, height = image->height;
    const int scale = width <= 960 ? 2 : 1;
    const double exposure_ev = exposure_for(image, hit);
    const float on = (float)exp2(-exposure_ev);
    struct image out;
    int err = image_new(&out, width * scale, height * scale, 3, NULL);
    if (err)
        return err;
    for (int y = 0; y < out.height; y++)
        for (int x = 0; x < out.width; x++) {
            const int sx = x / scale, sy = y / scale, ix = x % scale, iy = y % scale;
            const float *from =
                image->data + ((size_t)sy * (size_t)width + (size_t)sx) * (size_t)image->n_channels;
            float *to = out.data + ((size_t)y * (size_t)out.width + (size_t)x) * 3;
            const bool line = !hit[sy * width + sx] &&
                              ((ix == 0 && is_hit(hit, width, height, sx - 1, sy)) ||
                               (ix == scale - 1 && is_hit(hit, width, height, sx + 1, sy)) ||
                               (iy == 0 && is_hit(hit, width, height, sx, sy - 1)) ||
                               (iy == scale - 1 && is_hit(hit, width, height, sx, sy + 1)));
            for (int c = 0; c < 3; c++)
                to[c] = line ? (c == 1 ? 0 : on) : from[image->n_channels >= 3 ? c : 0];
        }
    err = image_write_png_srgb(&out, path, exposure_ev);
    image_free(&out);
    return err;
}

// Intersection over union of the silhouette and what the picture itself calls subject (alpha > .5).
static double silhouette_iou(const struct image *image, const uint8_t *hit)
{
    const int alpha = image_channel(image, "A");
    if (alpha < 0)
        return -1;
    int64_t both = 0, either = 0;
    for (int64_t i = 0; i < (int64_t)image->width * image->height; i++) {
        const bool subject = image->data[i * image->n_channels + alpha] > .5f;
        both += subject && hit[i];
        either += subject || hit[i];
    }
    return either ? (double)both / (double)either : 1;
}

// The picture of a view; NULL: there is none. The caller frees it.
static char *picture_of(const struct scene *scene, const struct settings *s, const char *name)
{
    static const char *const extensions[] = { "exr", "tif", "tiff", "hdr", "png" };
    for (int i = 0; s->images && i < 5; i++) {
        char *path;
        if (asprintf(&path, "%s/%s.%s", s->images, name, extensions[i]) < 0)
            return NULL;
        if (!access(path, F_OK))
            return path;
        free(path);
    }
    for (int i = 0; !s->images && scene->take && i < scene->take->n_views; i++)
        if (!strcmp(scene->take->view_names[i], name))
            return strdup(scene->take->view_paths[i]);
    return NULL;
}

static int draw_view(const struct scene *scene, const struct settings *s, const struct camera *view,
                     const char *picture, struct view_report *report)
{
    struct image image;
    int err = image_read(&image, picture);
    if (err)
        return err;
    struct camera camera = *view;
    if (image.width != camera.width_px || image.height != camera.height_px)
        camera_resize(&camera, image.width, image.height);
    uint8_t *hit = malloc((size_t)image.width * (size_t)image.height);
    char *path = path_in(s->overlay, view->name, "png");
    err = -ENOMEM;
    if (hit && path) {
        parallel_for(s->n_threads, image.height, 4, trace_rows,
                     &(struct silhouette_job){ scene->rays, &camera, hit });
        report->iou = silhouette_iou(&image, hit);
        err = draw_outline(&image, hit, path);
        report->drawn = !err;
    }
    free(hit);
    free(path);
    image_free(&image);
    return err;
}

static int draw_overlays(const struct scene *scene, const struct settings *s, struct report *report)
{
    int n_drawn = 0, err = make_directories(s->overlay);
    if (err)
        return err;
    progress_begin("draw overlays", scene->cameras.n);
    for (int i = 0; !err && i < scene->cameras.n; i++) {
        const struct camera *view = &scene->cameras.view[i];
        char *picture = picture_of(scene, s, view->name);
        if (picture) {
            err = draw_view(scene, s, view, picture, &report->view[i]);
            n_drawn += report->view[i].drawn;
        }
        free(picture);
        progress_add(1);
    }
    progress_end();
    if (!err && n_drawn < scene->cameras.n)
        log_warning("visibility: %d of %d views have no picture of their name: not drawn over",
                    scene->cameras.n - n_drawn, scene->cameras.n);
    return err;
}

// ---- report ----

static double mrays_per_s(const struct scene *scene, const struct report *report)
{
    return report->light_s > 0 ? (double)scene->visibility.n_rays / report->light_s * 1e-6 : 0;
}

static double below_horizon_percent(const struct light_visibility *v)
{
    const double asked = (double)v->n_texels * v->n_lights * v->n_sub;
    return asked > 0 ? 100 * (1 - (double)v->n_rays / asked) : 0;
}

static int64_t bytes_of(const struct light_visibility *v)
{
    const int64_t n = v->n_texels;
    return n * v->words_per_texel * 2 + (v->soft ? n * v->n_lights : 0);
}

static void print_text(const struct scene *scene, const struct report *report)
{
    const struct light_visibility *v = &scene->visibility;
    printf("%-24s %9s %9s %9s %9s\n", "view", "visible", "grazing", "occluded", "outside");
    for (int i = 0; i < scene->cameras.n; i++) {
        const struct view_report *view = &report->view[i];
        printf("%-24s %9d %9d %9d %9d", scene->cameras.view[i].name, view->n_visible,
               view->n_grazing, view->n_occluded, view->n_outside);
        if (view->drawn && view->iou >= 0)
            printf("  silhouette IoU %.4f", view->iou);
        putchar('\n');
    }
    printf("%d triangles, %d texels of %d x %d; %d seen by no camera; cameras took %.2f s\n",
           scene->mesh.n_triangles, scene->texels.n, scene->texels.size, scene->texels.size,
           report->n_seen_by_none, report->camera_s);
    if (v->n_lights)
        printf("%d lights: %lld rays in %.2f s (%.2f Mray/s), %.1f %% below the horizon, %lld "
               "bytes; %d texels "
               "lit by nothing\n",
               v->n_lights, (long long)v->n_rays, report->light_s, mrays_per_s(scene, report),
               below_horizon_percent(v), (long long)bytes_of(v), report->n_lit_by_none);
}

static int print_json(const struct scene *scene, const struct report *report)
{
    const struct light_visibility *v = &scene->visibility;
    struct json *root = json_object(), *views = json_array();
    json_set_int(root, "n_triangles", scene->mesh.n_triangles);
    json_set_int(root, "texture", scene->texels.size);
    json_set_int(root, "n_texels", scene->texels.n);
    json_set_int(root, "n_views", scene->cameras.n);
    json_set_int(root, "n_seen_by_none", report->n_seen_by_none);
    json_set_number(root, "cameras_wall_s", report->camera_s);
    for (int i = 0; i < scene->cameras.n; i++) {
        const struct view_report *view = &report->view[i];
        struct json *one = json_object();
        json_set_string(one, "name", scene->cameras.view[i].name);
        json_set_int(one, "visible", view->n_visible);
        json_set_int(one, "grazing", view->n_grazing);
        json_set_int(one, "occluded", view->n_occluded);
        json_set_int(one, "outside", view->n_outside);
        if (view->drawn && view->iou >= 0)
            json_set_number(one, "silhouette_iou", view->iou);
        json_append(views, one);
    }
    json_set(root, "views", views);
    if (v->n_lights) {
        struct json *lights = json_object();
        json_set_int(lights, "n_lights", v->n_lights);
        json_set_int(lights, "n_sub", v->n_sub);
        json_set_int(lights, "n_rays", v->n_rays);
        json_set_int(lights, "n_lit_by_none", report->n_lit_by_none);
        json_set_number(lights, "below_horizon_percent", below_horizon_percent(v));
        json_set_int(lights, "bytes", bytes_of(v));
        json_set_number(lights, "wall_s", report->light_s);
        json_set_number(lights, "mrays_per_s", mrays_per_s(scene, report));
        json_set(root, "lights", lights);
    }
    char *text = json_text(root);
    json_free(root);
    if (!text)
        return -ENOMEM;
    puts(text);
    free(text);
    return 0;
}

// 3 where every texel of every view is hidden or outside: the result exists, but mesh and cameras
// do not belong together.
static int judge(const struct scene *scene, const struct report *report)
{
    int64_t n_visible = 0, n_outside = 0;
    for (int i = 0; i < scene->cameras.n; i++) {
        n_visible += report->view[i].n_visible + report->view[i].n_grazing;
        n_outside += report->view[i].n_outside;
    }
    if (n_visible)
        return EXIT_DONE;
    const double asked = (double)scene->cameras.n * scene->texels.n;
    log_error("visibility: none of %d cameras sees the mesh (%.0f %% of its texels fall outside "
              "the images, the rest face "
              "away or are blocked): are mesh and cameras in the same axes and units?",
              scene->cameras.n, asked > 0 ? 100 * (double)n_outside / asked : 0);
    return EXIT_NOT_TRUSTED;
}

int command_visibility(int argc, char **argv)
{
    struct settings s = { .n_lights = 256,
                          .texture = 512,
                          .n_sub = 1,
                          .seed = 1,
                          .grazing_cos = MASK_GRAZING_COS_PERCENT / 100. };
    const struct argp argp = { options, parse_option, "[TAKE]", doc, NULL, NULL, NULL };
    argp_parse(&argp, argc, argv, 0, NULL, &s);

    struct scene scene = { 0 };
    struct report report = { 0 };
    char *dir = NULL;
    int status = EXIT_FAILED, err = load(&scene, &s);
    if (err)
        goto done;
    report.view = calloc((size_t)scene.cameras.n + 1, sizeof(report.view[0]));
    if (!report.view || asprintf(&dir, "%s/visibility", s.out) < 0) {
        dir = NULL;
        err = -ENOMEM;
        goto done;
    }
    err = make_directories(dir);
    if (!err)
        err = trace_cameras(&scene, &s, dir, &report);
    if (!err && scene.lights.n)
        err = trace_lights(&scene, &s, dir, &report);
    if (!err && s.overlay)
        err = draw_overlays(&scene, &s, &report);
    if (err)
        goto done;
    if (s.json)
        err = print_json(&scene, &report);
    else
        print_text(&scene, &report);
    if (!err)
        status = judge(&scene, &report);
done:
    if (err == -ENOMEM)
        log_error("visibility: out of memory: try a smaller --texture");
    free(dir);
    free(report.view);
    free_scene(&scene);
    return status;
}
