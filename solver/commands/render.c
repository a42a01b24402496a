// solver/commands/render.c - rigsolve render: a solved (or true) material from new views, under its
// own light or another.
//
// SOLVE_DIR is what solved.h says; its report.json may also say how its pictures were made ("render":
// samples, shadows, ...). Options beat the report.
//
// A turntable turns the object before a camera and lights that stand still. What is computed turns
// camera and lights the other way about the object, which gives the same picture.
#include "solver/cameras.h"
#include "solver/commands/arguments.h"
#include "solver/commands/commands.h"
#include "solver/commands/output.h"
#include "solver/commands/solved.h"
#include "solver/panorama.h"
#include "solver/render.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/vec3.h"

#include <argp.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum {
    KEY_CAMERAS = 256,
    KEY_LIGHTS,
    KEY_PANORAMA,
    KEY_PROBE,
    KEY_PANELS,
    KEY_RADIUS,
    KEY_TURNTABLE,
    KEY_TURN_LIGHTS,
    KEY_EXPOSURE,
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
    MAX_BOUNCE_TEXTURE = 4096,
    MAX_TURNTABLE = 3600
};

static const struct argp_option options[] = {
    {"cameras", KEY_CAMERAS, "PATH", 0, "The views to render: a camera file or folder; required without --turntable",
     0},
    {"turntable", KEY_TURNTABLE, "N", 0,
     "N views turn000... of the object turning once about the vertical, before the first of --cameras or one that sees it whole",
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
    {"turn-lights", KEY_TURN_LIGHTS, "DEG", 0,
     "Turn the light about the vertical through the object, against the clock from above", 1},
    {"mesh", KEY_MESH, "FILE", 0, "Instead of the mesh that report.json names", 2},
    {"size", KEY_SIZE, "WxH", 0, "Pixels, instead of the cameras' own (a turntable's own: 640x480)", 2},
    {"samples", KEY_SAMPLES, "N", 0, "Rays per pixel and side (2)", 2},
    {"exposure", KEY_EXPOSURE, "EV", 0, "Stops by which the PNGs are made brighter (0)", 2},
    {"no-shadows", KEY_NO_SHADOWS, 0, 0, "The object does not shadow itself", 2},
    {"threads", KEY_THREADS, "N", 0, "Default: all cores. The result does not depend on it", 2},
    {"json", KEY_JSON, 0, 0, "Print a summary as JSON", 2},
    {0},
};

struct arguments {
    const char *solve_dir, *cameras, *output, *lights, *panorama, *probe, *panels, *mesh;
    double radius_m, turn_lights_deg, exposure_ev;
    int n_lights, width_px, height_px, samples, n_threads, n_turntable;
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
    case KEY_TURNTABLE:
        a->n_turntable = (int)argument_integer(state, "--turntable", text, 1, MAX_TURNTABLE);
        return 0;
    case KEY_TURN_LIGHTS:
        a->turn_lights_deg = argument_number(state, "--turn-lights", text, "degrees", -360, 360);
        return 0;
    case KEY_EXPOSURE:
        a->exposure_ev = argument_number(state, "--exposure", text, "stops", -40, 40);
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
        if (!a->output)
            argp_error(state, "-o is needed");
        if (!a->cameras && !a->n_turntable)
            argp_error(state, "--cameras or --turntable is needed");
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
    "SOLVE_DIR --cameras PATH -o DIR\nSOLVE_DIR --turntable N -o DIR",
    "Re-render a solved material (or a synthetic studio's truth/) from given cameras or on a turntable.\v"
    "Without --lights or --panorama it is lit by SOLVE_DIR/lights.json. Pictures are linear EXR "
    "(R, G, B, A as 32-bit floats, "
    "not clipped) and PNG with the sRGB curve.",
    0,
    0,
    0,
};

// ---- what to render -----------------------------------------------------------------------------

struct scene {
    struct solved solved; // its lights are those in use
    struct rays *rays;
    struct cameras cameras;
    struct render_material material;
    struct render_settings settings;
};

static void scene_free(struct scene *s)
{
    rays_free(s->rays);
    solved_free(&s->solved);
    cameras_free(&s->cameras);
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
    const struct json *r = s->solved.report;
    const int shadow_rays = s->solved.lights.n <= EXACT_SHADOWS_UP_TO ? 0 : DEFAULT_SHADOW_RAYS;
    int64_t seed = 0;
    bool shadows = true, nearest = false;
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
        .count_rows = true,
    };
    s->material = (struct render_material){
        .model = s->solved.parameters.data ? REFLECT_DISNEY : REFLECT_LAMBERT,
        .variant = s->solved.variant,
        .albedo = &s->solved.albedo,
        .parameters = s->solved.parameters.data ? &s->solved.parameters : NULL,
        .nearest = nearest,
    };
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
    if (a->panorama)
        return cut_panorama(&s->solved.lights, a);
    if (a->lights)
        return lights_read_json(&s->solved.lights, a->lights);
    const int err = solved_read_lights(&s->solved, a->solve_dir);
    if (err == -ENOENT)
        log_error("render: %s has no lights.json; give --lights or --panorama", a->solve_dir);
    return err;
}

// ---- turning ------------------------------------------------------------------------------------

struct turn {
    double rotation[9], axis[3], centre_m[3]; // about the mesh's middle
};

// The axis is the world's, nearest to the probe's +Y.
static void make_turn(struct turn *t, const struct scene *s, double angle_rad)
{
    const double *r = s->solved.lights.world_from_probe, up[3] = {r[1], r[4], r[7]};
    double w[3];
    int axis = 0;
    for (int c = 0; c < 3; c++) {
        axis = fabs(up[c]) > fabs(up[axis]) ? c : axis;
        t->centre_m[c] = (s->solved.mesh.bounds_m[0][c] + s->solved.mesh.bounds_m[1][c]) / 2;
    }
    for (int c = 0; c < 3; c++)
        t->axis[c] = c == axis ? copysign(1, up[axis]) : 0, w[c] = angle_rad * t->axis[c];
    mat3_from_rotation_vector(t->rotation, w);
}

static void turn_point(const struct turn *t, double point_m[3])
{
    double away[3];
    vec3_sub(away, point_m, t->centre_m);
    mat3_mul_vec(point_m, t->rotation, away);
    for (int c = 0; c < 3; c++)
        point_m[c] += t->centre_m[c];
}

static void turn_lights(const struct turn *t, struct lights *l)
{
    turn_point(t, l->centre_m);
    mat3_mul(l->world_from_probe, t->rotation, l->world_from_probe);
}

static void turn_camera(const struct turn *t, struct camera *c)
{
    double back[9];
    for (int i = 0; i < 9; i++)
        back[i] = t->rotation[3 * (i % 3) + i / 3];
    turn_point(t, c->centre_m);
    mat3_mul(c->cam_from_world, c->cam_from_world, back);
    mat3_mul_vec(c->t_m, c->cam_from_world, c->centre_m);
    for (int i = 0; i < 3; i++)
        c->t_m[i] = -c->t_m[i];
}

// A camera that sees the whole object from a little above, where the world's first other axis points.
static int make_camera(struct scene *s)
{
    const double field_rad = .6, elevation_rad = .3;
    const double(*bounds)[3] = (const double(*)[3])s->solved.mesh.bounds_m;
    struct camera *c = calloc(1, sizeof(*c));
    struct turn t;
    double diagonal[3], aside[3], centre_m[3];
    if (!c)
        return -ENOMEM;
    make_turn(&t, s, 0);
    vec3_sub(diagonal, bounds[1], bounds[0]);
    const double distance_m = .55 * vec3_norm(diagonal) / sin(field_rad / 2);
    for (int k = 0; k < 3; k++)
        aside[k] = t.axis[0] != 0 ? k == 1 : k == 0;
    for (int k = 0; k < 3; k++)
        centre_m[k] = t.centre_m[k] + distance_m * (cos(elevation_rad) * aside[k] + sin(elevation_rad) * t.axis[k]);
    *c = (struct camera){.name = "turntable", .width_px = 640, .height_px = 480, .cx = 320, .cy = 240};
    c->fx = c->fy = 240 / tan(field_rad / 2);
    camera_look_at(c, centre_m, t.centre_m, t.axis);
    s->cameras = (struct cameras){.n = 1, .view = c};
    return 0;
}

static int read_scene(struct scene *s, const struct arguments *a)
{
    int err = solved_read(&s->solved, "render", a->solve_dir, a->mesh);
    if (!err)
        err = rays_new(&s->rays, &s->solved.mesh);
    if (!err)
        err = read_lights(s, a);
    if (!err)
        err = a->cameras ? cameras_read(&s->cameras, a->cameras) : make_camera(s);
    for (int i = 0; !err && a->width_px && i < s->cameras.n; i++)
        camera_resize(&s->cameras.view[i], a->width_px, a->height_px);
    if (err)
        return err;
    if (a->turn_lights_deg != 0) {
        struct turn t;
        make_turn(&t, s, a->turn_lights_deg * M_PI / 180);
        turn_lights(&t, &s->solved.lights);
    }
    choose_settings(s, a);
    return 0;
}

// ---- pictures -----------------------------------------------------------------------------------

static int render_one(const struct renderer *renderer, const struct camera *camera, const struct arguments *a)
{
    struct image image;
    int err = render_view(renderer, camera, &image);
    if (err)
        return err;
    char *exr = output_path(a->output, camera->name, "exr"), *png = output_path(a->output, camera->name, "png");
    err = exr && png ? image_write_exr_noted(&image, &(struct image_note){ IMAGE_SPREAD_NOTE, "0", 0 }, 1, exr, IMAGE_FLOAT, IMAGE_ZIP) : -ENOMEM;
    if (!err)
        err = image_write_png_srgb(&image, png, a->exposure_ev);
    free(exr);
    free(png);
    image_free(&image);
    return err;
}

static int render_views(const struct scene *s, const struct arguments *a)
{
    struct renderer *renderer;
    int err = renderer_new(&renderer, &s->solved.mesh, s->rays, &s->solved.lights, &s->material, &s->settings);
    if (err)
        return err;
    int64_t n_rows = 0;
    for (int i = 0; i < s->cameras.n; i++)
        n_rows += s->cameras.view[i].height_px;
    progress_begin("render", n_rows);
    for (int i = 0; !err && i < s->cameras.n; i++)
        err = render_one(renderer, &s->cameras.view[i], a);
    progress_end();
    renderer_free(renderer);
    return err;
}

// A step of the object against the clock, seen from above, is one of camera and lights with it.
static int render_turntable(const struct scene *s, const struct arguments *a)
{
    const struct lights still = s->solved.lights;
    int err = 0;
    progress_begin("turntable", (int64_t)a->n_turntable * s->cameras.view[0].height_px);
    for (int i = 0; !err && i < a->n_turntable; i++) {
        struct lights lights = still; // its arrays are shared
        struct camera camera = s->cameras.view[0];
        struct renderer *renderer;
        struct turn t;
        make_turn(&t, s, -2 * M_PI * i / a->n_turntable);
        turn_lights(&t, &lights);
        turn_camera(&t, &camera);
        snprintf(camera.name, sizeof(camera.name), "turn%03d", i);
        err = renderer_new(&renderer, &s->solved.mesh, s->rays, &lights, &s->material, &s->settings);
        if (err)
            break;
        err = render_one(renderer, &camera, a);
        renderer_free(renderer);
    }
    progress_end();
    return err;
}

static int print_summary(const struct scene *s, const struct arguments *a, double wall_s)
{
    struct json *doc = json_object(), *views = json_array();
    json_set_string(doc, "output", a->output);
    json_set_int(doc, "n_views", a->n_turntable ? a->n_turntable : s->cameras.n);
    json_set_int(doc, "n_lights", s->solved.lights.n);
    json_set_string(doc, "model", s->solved.parameters.data ? "disney" : "lambert");
    json_set_int(doc, "samples", s->settings.samples);
    json_set_bool(doc, "shadows", s->settings.shadows);
    json_set_int(doc, "shadow_rays", s->settings.shadow_rays);
    json_set_int(doc, "bounce_rays", s->settings.bounce_rays);
    json_set_number(doc, "wall_s", wall_s);
    for (int i = 0; !a->n_turntable && i < s->cameras.n; i++)
        json_append_string(views, s->cameras.view[i].name);
    for (int i = 0; i < a->n_turntable; i++) {
        char name[16];
        snprintf(name, sizeof(name), "turn%03d", i);
        json_append_string(views, name);
    }
    json_set(doc, "views", views);
    return output_json("render", doc);
}

int command_render(int argc, char **argv)
{
    struct arguments a = {.radius_m = 3, .n_lights = 256};
    struct scene s = {0};
    argp_parse(&argp, argc, argv, 0, 0, &a);
    const double begin_s = output_clock_s();
    int err = read_scene(&s, &a);
    if (!err)
        err = make_directories(a.output);
    if (!err)
        err = a.n_turntable ? render_turntable(&s, &a) : render_views(&s, &a);
    if (!err && a.json)
        err = print_summary(&s, &a, output_clock_s() - begin_s);
    if (err == -ENOMEM)
        log_error("render: out of memory");
    scene_free(&s);
    return err ? EXIT_FAILED : EXIT_DONE;
}
