// solver/commands/visibility.c - rigsolve visibility: which cameras and lights see which texel, as
// pictures and numbers.
#include "solver/commands/arguments.h"
#include "solver/commands/commands.h"
#include "solver/commands/inputs.h"
#include "solver/commands/output.h"
#include "solver/parallel.h"
#include "solver/take/atomic_file.h"
#include "solver/take/image.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"
#include "solver/visibility.h"

#include <argp.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// ---- arguments ----

struct settings {
    struct inputs in;
    const char *lights, *out, *overlay;
    int n_lights, n_sub, n_threads;
    uint64_t seed;
    double grazing_cos, distance_m, centre_m[3];
    bool has_centre, json;
};

enum {
    OPTION_LIGHTS = 256,
    OPTION_TEXTURE,
    OPTION_SOFT,
    OPTION_GRAZING,
    OPTION_CENTRE,
    OPTION_DISTANCE,
    OPTION_OVERLAY,
    OPTION_THREADS,
    OPTION_SEED,
    OPTION_JSON,
};

static const struct argp_option options[] = {
    { "lights", OPTION_LIGHTS, "N|FILE", 0,
      "how many lights to cut from the panorama (a power of two; default 256), or a lights.json",
      1 },
    { "centre", OPTION_CENTRE, "X,Y,Z", 0,
      "where the panorama was taken, metres; default: what lights.json says by the places of its "
      "lights, else the middle of the mesh's bounding box", 1 },
    { "distance", OPTION_DISTANCE, "M", 0,
      "distance of all lights from there, metres; default: infinity (or what lights.json says)",
      1 },
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

static error_t parse_option(int key, char *text, struct argp_state *state)
{
    struct settings *s = state->input;
    switch (key) {
    case OPTION_LIGHTS:
        // All digits: a number. Anything else names a file.
        s->lights = text[strspn(text, "0123456789")] ? text : NULL;
        if (!s->lights) {
            s->n_lights = (int)argument_integer(state, "--lights", text, 1, LIGHTS_MAX);
            if (s->n_lights & (s->n_lights - 1))
                argp_error(state,
                           "--lights '%s': expected a power of two up to %d, or a lights.json",
                           text, LIGHTS_MAX);
        }
        return 0;
    case OPTION_CENTRE:
        argument_point(state, "--centre", text, s->centre_m);
        s->has_centre = true;
        return 0;
    case OPTION_DISTANCE:
        s->distance_m = argument_number(state, "--distance", text, "a number", 1e-3, 1e6);
        return 0;
    case OPTION_TEXTURE:
        s->in.texture = (int)argument_integer(state, "--texture", text, 1, 16384);
        return 0;
    case OPTION_GRAZING:
        s->grazing_cos = argument_number(state, "--grazing", text, "a number", 0, 1);
        return 0;
    case OPTION_SOFT:
        s->n_sub = (int)argument_integer(state, "--soft", text, 0, 16);
        if (s->n_sub > 0 && s->n_sub < 4)
            argp_error(state, "--soft '%s': expected 0 (off) or 4 to 16", text);
        s->n_sub = s->n_sub ? s->n_sub : 1;
        return 0;
    case OPTION_THREADS:
        s->n_threads = (int)argument_integer(state, "--threads", text, 1, 256);
        return 0;
    case OPTION_SEED:
        s->seed = (uint64_t)argument_integer(state, "--seed", text, 0, INT64_MAX);
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
    case ARGP_KEY_INIT:
        state->child_inputs[0] = &s->in;
        return 0;
    case ARGP_KEY_END:
        if (!s->out)
            argp_error(state, "no -o DIR: where shall the result go?");
        if (!s->overlay)
            return 0;
        if (!s->in.take_dir && !s->in.images_dir)
            argp_error(state, "--overlay needs pictures: a TAKE, or --images DIR");
        s->in.needs |= TAKE_VIEWS;
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

// ---- what is loaded ----

struct scene {
    struct inputs in;
    struct lights lights; // n = 0: none
    struct light_visibility visibility;
};

static void free_scene(struct scene *s)
{
    light_visibility_free(&s->visibility);
    lights_free(&s->lights);
    inputs_free(&s->in);
}

static int load_lights(struct scene *scene, const struct settings *s)
{
    struct inputs *in = &scene->in;
    struct lights *l = &scene->lights;
    if (!in->panorama_path && !s->lights)
        return 0;
    int err = inputs_lights(l, in, s->lights, s->n_lights);
    if (!err && s->lights && s->n_sub > 1 && in->panorama_path)
        err = panorama_read(&in->panorama, in->panorama_path);
    if (err)
        return err;
    if (s->has_centre)
        memcpy(l->centre_m, s->centre_m, sizeof(l->centre_m));
    for (int i = 0; s->distance_m > 0 && i < l->n; i++)
        l->inverse_distance[i] = 1 / s->distance_m;
    return 0;
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

static int write_bytes_png(const char *dir, const char *name, const struct texels *t,
                           const uint8_t *bytes)
{
    char *path = output_path(dir, name, "png");
    const int err = path ? visibility_write_mask_png(bytes, t, path) : -ENOMEM;
    free(path);
    return err;
}

static int trace_cameras(const struct scene *scene, const struct settings *s, const char *dir,
                         struct report *report)
{
    const struct texels *t = &scene->in.texels;
    const int n_views = scene->in.cameras.n;
    int err = -ENOMEM;
    uint8_t *mask = malloc((size_t)t->n);
    int *n_seeing = calloc((size_t)t->n, sizeof(n_seeing[0]));
    if (!mask || !n_seeing)
        goto done;
    const double begin_s = output_clock_s();
    progress_begin("trace cameras", n_views);
    for (int i = 0; i < n_views; i++) {
        const struct camera *camera = &scene->in.cameras.view[i];
        struct view_report *view = &report->view[i];
        visibility_camera_mask(mask, scene->in.rays, t, camera, s->grazing_cos, s->n_threads);
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
    report->camera_s = output_clock_s() - begin_s;
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
    const struct texels *t = &job->scene->in.texels;
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
    const struct texels *t = &scene->in.texels;
    uint8_t *share = malloc((size_t)t->n), *lit = malloc((size_t)t->n);
    char *path = output_path(dir, "lights", "bin");
    int err = -ENOMEM;
    if (!share || !lit || !path)
        goto done;
    const double begin_s = output_clock_s();
    err = light_visibility_trace(&scene->visibility, scene->in.rays, t, &scene->lights,
                                 scene->in.panorama.image.data ? &scene->in.panorama : NULL,
                                 s->n_sub, s->seed, s->n_threads);
    if (err)
        goto done;
    report->light_s = output_clock_s() - begin_s;
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
    char *path = output_path(s->overlay, view->name, "png");
    err = -ENOMEM;
    if (hit && path) {
        parallel_for(s->n_threads, image.height, 4, trace_rows,
                     &(struct silhouette_job){ scene->in.rays, &camera, hit });
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
    const struct inputs *in = &scene->in;
    int err = make_directories(s->overlay);
    if (err)
        return err;
    progress_begin("draw overlays", in->cameras.n);
    for (int i = 0; !err && i < in->cameras.n; i++) {
        if (in->picture[i])
            err = draw_view(scene, s, &in->cameras.view[i], in->picture[i], &report->view[i]);
        progress_add(1);
    }
    progress_end();
    if (!err && in->n_pictures < in->cameras.n)
        log_warning("visibility: %d of %d views have no picture of their name: not drawn over",
                    in->cameras.n - in->n_pictures, in->cameras.n);
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

static int print_text(const struct scene *scene, const struct report *report)
{
    const struct light_visibility *v = &scene->visibility;
    const struct texels *t = &scene->in.texels;
    printf("%-24s %9s %9s %9s %9s\n", "view", "visible", "grazing", "occluded", "outside");
    for (int i = 0; i < scene->in.cameras.n; i++) {
        const struct view_report *view = &report->view[i];
        printf("%-24s %9d %9d %9d %9d", scene->in.cameras.view[i].name, view->n_visible,
               view->n_grazing, view->n_occluded, view->n_outside);
        if (view->drawn && view->iou >= 0)
            printf("  silhouette IoU %.4f", view->iou);
        putchar('\n');
    }
    printf("%d triangles, %d texels of %d x %d; %d seen by no camera; cameras took %.2f s\n",
           scene->in.mesh.n_triangles, t->n, t->size, t->size, report->n_seen_by_none,
           report->camera_s);
    if (v->n_lights)
        printf("%d lights: %lld rays in %.2f s (%.2f Mray/s), %.1f %% below the horizon, %lld "
               "bytes; %d texels "
               "lit by nothing\n",
               v->n_lights, (long long)v->n_rays, report->light_s, mrays_per_s(scene, report),
               below_horizon_percent(v), (long long)bytes_of(v), report->n_lit_by_none);
    return output_flush("visibility");
}

static int print_json(const struct scene *scene, const struct report *report)
{
    const struct light_visibility *v = &scene->visibility;
    struct json *root = json_object(), *views = json_array();
    json_set_int(root, "n_triangles", scene->in.mesh.n_triangles);
    json_set_int(root, "texture", scene->in.texels.size);
    json_set_int(root, "n_texels", scene->in.texels.n);
    json_set_int(root, "n_views", scene->in.cameras.n);
    json_set_int(root, "n_seen_by_none", report->n_seen_by_none);
    json_set_number(root, "cameras_wall_s", report->camera_s);
    for (int i = 0; i < scene->in.cameras.n; i++) {
        const struct view_report *view = &report->view[i];
        struct json *one = json_object();
        json_set_string(one, "name", scene->in.cameras.view[i].name);
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
    return output_json("visibility", root);
}

// 3 where every texel of every view is hidden or outside: the result exists, but mesh and cameras
// do not belong together.
static int judge(const struct scene *scene, const struct report *report)
{
    int64_t n_visible = 0, n_outside = 0;
    for (int i = 0; i < scene->in.cameras.n; i++) {
        n_visible += report->view[i].n_visible + report->view[i].n_grazing;
        n_outside += report->view[i].n_outside;
    }
    if (n_visible)
        return EXIT_DONE;
    const double asked = (double)scene->in.cameras.n * scene->in.texels.n;
    log_error("visibility: none of %d cameras sees the mesh (%.0f %% of its texels fall outside "
              "the images, the rest face "
              "away or are blocked): are mesh and cameras in the same axes and units?",
              scene->in.cameras.n, asked > 0 ? 100 * (double)n_outside / asked : 0);
    return EXIT_NOT_TRUSTED;
}

int command_visibility(int argc, char **argv)
{
    struct settings s = { .in.needs = TAKE_MESH | TAKE_CAMERAS,
                          .in.texture = 512,
                          .in.png_too = true,
                          .n_lights = 256,
                          .n_sub = 1,
                          .seed = 1,
                          .grazing_cos = MASK_GRAZING_COS_PERCENT / 100. };
    const struct argp_child children[] = { { &inputs_argp, 0, NULL, 0 }, { 0 } };
    const struct argp argp = { options, parse_option, "[TAKE]", doc, children, NULL, NULL };
    argp_parse(&argp, argc, argv, 0, NULL, &s);

    struct scene scene = { .in = s.in };
    struct report report = { 0 };
    char *dir = NULL;
    int status = EXIT_FAILED, err = inputs_load(&scene.in);
    if (!err)
        err = load_lights(&scene, &s);
    if (err)
        goto done;
    report.view = calloc((size_t)scene.in.cameras.n + 1, sizeof(report.view[0]));
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
    err = s.json ? print_json(&scene, &report) : print_text(&scene, &report);
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
