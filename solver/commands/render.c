// solver/commands/render.c - rigsolve render: a solved (or true) material from new views, under its
// own light or another.
//
// SOLVE_DIR holds albedo.exr, brdf.exr (absent: Lambertian), lights.json and report.json, which
// names the mesh and may say how its pictures were made ("render": samples, shadows, ...). Options
// beat the report.
#include "solver/cameras.h"
#include "solver/commands/arguments.h"
#include "solver/commands/commands.h"
#include "solver/commands/output.h"
#include "solver/panorama.h"
#include "solver/render.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"

#include <argp.h>
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum {
    KEY_CAMERAS = 256,
    KEY_LIGHTS,
    KEY_PANORAMA,
    KEY_PROBE,
    KEY_PANELS,
    KEY_RADIUS,
    KEY_MESH,
    KEY_SIZE,
    KEY_SAMPLES,
    KEY_NO_SHADOWS,
    KEY_THREADS,
    KEY_JSON
};
enum {
    MAX_PANELS = 4096,
    EXACT_SHADOWS_UP_TO = 1024,
    DEFAULT_SHADOW_RAYS = 2,
    MAX_SHADOW_RAYS = 256,
    MAX_BOUNCE_RAYS = 4096,
    MAX_BOUNCE_TEXTURE = 4096
};

static const struct argp_option options[] = {
    {"cameras", KEY_CAMERAS, "PATH", 0, "The views to render: a camera file or folder; required",
     0},
    {"output", 'o', "DIR", 0, "Where <view>.exr and <view>.png go; required", 0},
    {"lights", KEY_LIGHTS, "FILE", 0, "Light it by this lights.json instead of SOLVE_DIR's", 1},
    {"panorama", KEY_PANORAMA, "FILE", 0, "Light it by this panorama (needs --world-from-probe)",
     1},
    {"world-from-probe", KEY_PROBE, "FILE", 0,
     "JSON with the panorama's world_from_probe and centre_m", 1},
    {"lights-count", 'n', "N", 0, "Cut the panorama into N lights, a power of two (256)", 1},
    {"panels", KEY_PANELS, "FILE", 0,
     "JSON with the panels' corners: a light is as far as the panel its ray meets", 1},
    {"radius", KEY_RADIUS, "M", 0, "Metres to lights that meet no panel (3); inf: directional", 1},
    {"mesh", KEY_MESH, "FILE", 0, "Instead of the mesh that report.json names", 2},
    {"size", KEY_SIZE, "WxH", 0, "Pixels, instead of the cameras' own", 2},
    {"samples", KEY_SAMPLES, "N", 0, "Rays per pixel and side (2)", 2},
    {"no-shadows", KEY_NO_SHADOWS, 0, 0, "The object does not shadow itself", 2},
    {"threads", KEY_THREADS, "N", 0, "Default: all cores. The result does not depend on it", 2},
    {"json", KEY_JSON, 0, 0, "Print a summary as JSON", 2},
    {0},
};

struct arguments {
    const char *solve_dir, *cameras, *output, *lights, *panorama, *probe, *panels, *mesh;
    double radius_m;
    int n_lights, width_px, height_px, samples, n_threads;
    bool no_shadows, json;
};

static error_t parse(int key, char *text, struct argp_state *state)
{
    struct arguments *a = state->input;
    char *end;
    switch (key) {
    case KEY_CAMERAS:
        a->cameras = text;
        return 0;
    case 'o':
        a->output = text;
        return 0;
    case KEY_LIGHTS:
        a->lights = text;
        return 0;
    case KEY_PANORAMA:
        a->panorama = text;
        return 0;
    case KEY_PROBE:
        a->probe = text;
        return 0;
    case 'n':
        a->n_lights = argument_power_of_two(state, "-n", text, LIGHTS_MAX);
        return 0;
    case KEY_PANELS:
        a->panels = text;
        return 0;
    case KEY_RADIUS:
        a->radius_m = strtod(text, &end);
        if (end == text || *end || !(a->radius_m > 0))
            argp_error(state, "--radius %s: expected metres above 0, or inf", text);
        return 0;
    case KEY_MESH:
        a->mesh = text;
        return 0;
    case KEY_SIZE:
        argument_size(state, "--size", text, 1, 16384, &a->width_px, &a->height_px);
        return 0;
    case KEY_SAMPLES:
        a->samples = (int)argument_integer(state, "--samples", text, 1, 16);
        return 0;
    case KEY_NO_SHADOWS:
        a->no_shadows = true;
        return 0;
    case KEY_THREADS:
        a->n_threads = (int)argument_integer(state, "--threads", text, 1, 256);
        return 0;
    case KEY_JSON:
        a->json = true;
        return 0;
    case ARGP_KEY_ARG:
        if (a->solve_dir)
            argp_error(state, "one SOLVE_DIR at a time: '%s' is too many", text);
        a->solve_dir = text;
        return 0;
    case ARGP_KEY_END:
        if (!a->solve_dir)
            argp_error(state, "which SOLVE_DIR?");
        if (!a->cameras || !a->output)
            argp_error(state, "--cameras and -o are needed");
        if (a->lights && a->panorama)
            argp_error(state, "--lights and --panorama: one light at a time");
        if (!a->panorama != !a->probe)
            argp_error(state, "--panorama and --world-from-probe need each other");
        if (a->panels && !a->panorama)
            argp_error(state, "--panels belongs to --panorama");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static const struct argp argp = {
    options,
    parse,
    "SOLVE_DIR --cameras PATH -o DIR",
    "Re-render a solved material (or a synthetic studio's truth/) from given cameras.\v"
    "Without --lights or --panorama it is lit by SOLVE_DIR/lights.json. Pictures are linear EXR "
    "(R, G, B, A as 32-bit floats, "
    "not clipped) and PNG with the sRGB curve.",
    0,
    0,
    0,
};

// ---- what to render -----------------------------------------------------------------------------

struct scene {
    struct json *report; // NULL: none
    struct mesh mesh;
    struct rays *rays;
    struct image albedo, parameters;
    struct lights lights;
    struct cameras cameras;
    struct render_material material;
    struct render_settings settings;
};

static void scene_free(struct scene *s)
{
    json_free(s->report);
    rays_free(s->rays);
    mesh_free(&s->mesh);
    image_free(&s->albedo), image_free(&s->parameters);
    lights_free(&s->lights);
    cameras_free(&s->cameras);
}

static int join(char path[PATH_MAX], const char *dir, const char *name)
{
    const int n = *name == '/' ? snprintf(path, PATH_MAX, "%s", name)
                               : snprintf(path, PATH_MAX, "%s/%s", dir, name);
    if (n < PATH_MAX)
        return 0;
    log_error("render: the path %s/%s is too long", dir, name);
    return -ENAMETOOLONG;
}

// A whole number of the report's "render" object, if it is there and in range.
static int setting(const struct json *report, const char *key, int low, int high, int otherwise)
{
    int64_t value;
    if (!report || json_get_int(report, key, &value))
        return otherwise;
    if (value >= low && value <= high)
        return (int)value;
    log_warning("render: report.json: %s is %lld, expected %d to %d; %d is used", key,
                (long long)value, low, high, otherwise);
    return otherwise;
}

static void choose_settings(struct scene *s, const struct arguments *a)
{
    const struct json *r = s->report;
    const int shadow_rays = s->lights.n <= EXACT_SHADOWS_UP_TO ? 0 : DEFAULT_SHADOW_RAYS;
    int64_t seed = 0;
    bool shadows = true, nearest = false;
    const char *variant;
    if (r && json_get_bool(r, "render.shadows", &shadows))
        shadows = true;
    if (r && json_get_bool(r, "render.nearest", &nearest))
        nearest = false;
    if (r && json_get_int(r, "render.seed", &seed))
        seed = 0;
    s->settings = (struct render_settings){
        .samples = a->samples ? a->samples : setting(r, "render.samples", 1, 16, 2),
        .shadows = shadows && !a->no_shadows,
        .shadow_rays = setting(r, "render.shadow_rays", 0, MAX_SHADOW_RAYS, shadow_rays),
        .bounce_rays = setting(r, "render.bounce_rays", 0, MAX_BOUNCE_RAYS, 0),
        .bounce_texture = setting(r, "render.bounce_texture", 16, MAX_BOUNCE_TEXTURE, 256),
        .seed = (uint64_t)seed,
        .n_threads = a->n_threads,
    };
    s->material = (struct render_material){
        .model = s->parameters.data ? REFLECT_DISNEY : REFLECT_LAMBERT,
        .variant = DISNEY_2017,
        .albedo = &s->albedo,
        .parameters = s->parameters.data ? &s->parameters : NULL,
        .nearest = nearest,
    };
    if (r && !json_get_string(r, "variant", &variant) &&
        !strcmp(variant, disney_variant_name(DISNEY_2012)))
        s->material.variant = DISNEY_2012;
}

static int read_texture(struct image *out, const char *path)
{
    int err = image_read(out, path);
    if (err)
        return err;
    err = image_require_finite(out, NULL, path);
    if (err)
        image_free(out);
    return err;
}

static int read_material(struct scene *s, const struct arguments *a)
{
    char path[PATH_MAX];
    int err = join(path, a->solve_dir, "albedo.exr");
    if (!err)
        err = read_texture(&s->albedo, path);
    if (!err)
        err = join(path, a->solve_dir, "brdf.exr");
    if (err || access(path, F_OK))
        return err;
    return read_texture(&s->parameters, path);
}

static int read_mesh(struct scene *s, const struct arguments *a)
{
    char path[PATH_MAX];
    const char *name = a->mesh;
    struct mesh_check check;
    int err = 0;
    if (!name) {
        if (!s->report || json_get_string(s->report, "inputs.mesh", &name)) {
            log_error("render: %s/report.json does not name a mesh (inputs.mesh); give --mesh",
                      a->solve_dir);
            return -ENOENT;
        }
        err = join(path, a->solve_dir, name);
        name = path;
    }
    if (!err)
        err = mesh_read(&s->mesh, &check, name);
    if (err)
        return err;
    mesh_check_log(&check, &s->mesh, name);
    return rays_new(&s->rays, &s->mesh);
}

// ---- light from a panorama ----------------------------------------------------------------------

struct panel {
    double corner[3], side[2][3], normal[3]; // the front is where the normal points
};

static int read_panels(struct panel **out, int *n_out, const char *path)
{
    struct json *doc;
    int err = json_read(&doc, path);
    if (err)
        return err;
    const int n = json_length(doc, "panels");
    struct panel *panels = NULL;
    err = -EINVAL;
    if (n < 1 || n > MAX_PANELS) {
        log_error("render: %s: 'panels' must be a list of 1 to %d panels with 'corners'", path,
                  MAX_PANELS);
        goto done;
    }
    panels = calloc((size_t)n, sizeof(*panels));
    err = panels ? 0 : -ENOMEM;
    for (int i = 0; !err && i < n; i++) {
        char key[64];
        double corner[12];
        struct panel *p = &panels[i];
        snprintf(key, sizeof(key), "panels.%d.corners", i);
        err = json_require_numbers(doc, key, corner, 12, path);
        if (err)
            break;
        memcpy(p->corner, corner, sizeof(p->corner));
        vec3_sub(p->side[0], corner + 3, corner);
        vec3_sub(p->side[1], corner + 9, corner);
        vec3_cross(p->normal, p->side[0], p->side[1]);
        if (vec3_normalise(p->normal) > 0)
            continue;
        log_error("render: %s: %s span no area; expected four corners in turn", path, key);
        err = -EINVAL;
    }
done:
    json_free(doc);
    if (err) {
        free(panels);
        return err;
    }
    *out = panels, *n_out = n;
    return 0;
}

// Distance along dir to the panel's front side, or infinity.
static double meet_panel(const struct panel *p, const double from_m[3], const double dir[3])
{
    double away[3], at[3];
    vec3_sub(away, p->corner, from_m);
    const double towards = vec3_dot(dir, p->normal), t = vec3_dot(away, p->normal) / towards;
    if (!(towards < 0) || !(t > 0))
        return INFINITY;
    for (int k = 0; k < 3; k++)
        at[k] = t * dir[k] - away[k];
    // at = a side0 + b side1
    const double uu = vec3_dot(p->side[0], p->side[0]), uv = vec3_dot(p->side[0], p->side[1]),
                 vv = vec3_dot(p->side[1], p->side[1]), u = vec3_dot(at, p->side[0]),
                 v = vec3_dot(at, p->side[1]);
    const double det = uu * vv - uv * uv, a = (u * vv - v * uv) / det, b = (v * uu - u * uv) / det;
    return a >= 0 && a <= 1 && b >= 0 && b <= 1 ? t : INFINITY;
}

static int cut_panorama(struct lights *out, const struct arguments *a)
{
    struct panorama panorama;
    struct panel *panels = NULL;
    int n_panels = 0, n_met = 0;
    int err = panorama_read(&panorama, a->panorama);
    if (err)
        return err;
    err = lights_median_cut(out, &panorama, a->n_lights);
    panorama_free(&panorama);
    if (!err)
        err = lights_read_pose(out, NULL, a->probe);
    if (!err && a->panels)
        err = read_panels(&panels, &n_panels, a->panels);
    for (int i = 0; !err && i < out->n; i++) {
        double dir[3], nearest = INFINITY;
        mat3_mul_vec(dir, out->world_from_probe, out->dir_probe[i]);
        for (int k = 0; k < n_panels; k++) {
            const double t = meet_panel(&panels[k], out->centre_m, dir);
            if (t < nearest * (1 - 1e-9)) // in one plane: the first of them
                nearest = t, out->group[i] = k;
        }
        n_met += nearest < INFINITY;
        out->inverse_distance[i] = 1 / (nearest < INFINITY ? nearest : a->radius_m);
    }
    free(panels);
    if (!err && a->panels)
        log_info("render: %d of %d lights lie on a panel", n_met, out->n);
    return err;
}

static int read_lights(struct scene *s, const struct arguments *a)
{
    char path[PATH_MAX];
    if (a->panorama)
        return cut_panorama(&s->lights, a);
    if (a->lights)
        return lights_read_json(&s->lights, a->lights);
    const int err = join(path, a->solve_dir, "lights.json");
    return err ? err : lights_read_json(&s->lights, path);
}

static int read_scene(struct scene *s, const struct arguments *a)
{
    char path[PATH_MAX];
    int err = join(path, a->solve_dir, "report.json");
    if (!err && !access(path, F_OK))
        err = json_read(&s->report, path);
    if (!err)
        err = read_material(s, a);
    if (!err)
        err = read_mesh(s, a);
    if (!err)
        err = read_lights(s, a);
    if (!err)
        err = cameras_read(&s->cameras, a->cameras);
    for (int i = 0; !err && a->width_px && i < s->cameras.n; i++)
        camera_resize(&s->cameras.view[i], a->width_px, a->height_px);
    if (!err)
        choose_settings(s, a);
    return err;
}

// ---- pictures -----------------------------------------------------------------------------------

static int render_one(const struct renderer *renderer, const struct camera *camera, const char *dir)
{
    struct image image;
    int err = render_view(renderer, camera, &image);
    if (err)
        return err;
    char *exr = output_path(dir, camera->name, "exr"), *png = output_path(dir, camera->name, "png");
    err = exr && png ? image_write_exr(&image, exr, IMAGE_FLOAT, IMAGE_ZIP) : -ENOMEM;
    if (!err)
        err = image_write_png_srgb(&image, png, 0);
    free(exr);
    free(png);
    image_free(&image);
    return err;
}

static int print_summary(const struct scene *s, const struct arguments *a, double wall_s)
{
    struct json *doc = json_object(), *views = json_array();
    json_set_string(doc, "output", a->output);
    json_set_int(doc, "n_views", s->cameras.n);
    json_set_int(doc, "n_lights", s->lights.n);
    json_set_string(doc, "model", s->parameters.data ? "disney" : "lambert");
    json_set_int(doc, "samples", s->settings.samples);
    json_set_bool(doc, "shadows", s->settings.shadows);
    json_set_int(doc, "shadow_rays", s->settings.shadow_rays);
    json_set_int(doc, "bounce_rays", s->settings.bounce_rays);
    json_set_number(doc, "wall_s", wall_s);
    for (int i = 0; i < s->cameras.n; i++)
        json_append_string(views, s->cameras.view[i].name);
    json_set(doc, "views", views);
    return output_json("render", doc);
}

int command_render(int argc, char **argv)
{
    struct arguments a = {.radius_m = 3, .n_lights = 256};
    struct scene s = {0};
    struct renderer *renderer = NULL;
    argp_parse(&argp, argc, argv, 0, 0, &a);
    const double begin_s = output_clock_s();
    int err = read_scene(&s, &a);
    if (!err)
        err = make_directories(a.output);
    if (!err)
        err = renderer_new(&renderer, &s.mesh, s.rays, &s.lights, &s.material, &s.settings);
    if (!err) {
        progress_begin("render", s.cameras.n);
        for (int i = 0; !err && i < s.cameras.n; i++, progress_add(1))
            err = render_one(renderer, &s.cameras.view[i], a.output);
        progress_end();
    }
    if (!err && a.json)
        err = print_summary(&s, &a, output_clock_s() - begin_s);
    if (err == -ENOMEM)
        log_error("render: out of memory");
    renderer_free(renderer);
    scene_free(&s);
    return err ? EXIT_FAILED : EXIT_DONE;
}
