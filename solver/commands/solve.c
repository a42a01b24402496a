// solver/commands/solve.c - rigsolve solve: from a take to the lights' places and a shared reflectance with per-texel albedo.
#include "solver/commands/arguments.h"
#include "solver/commands/commands.h"
#include "solver/commands/export.h"
#include "solver/commands/inputs.h"
#include "solver/commands/presets.h"
#include "solver/commands/report.h"
#include "solver/commands/solve_materials.h"
#include "solver/joint.h"
#include "solver/kernels/kernels.h"
#include "solver/padding.h"
#include "solver/parallel.h"
#include "solver/samples.h"
#include "solver/take/atomic_file.h"
#include "solver/take/image.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <argp.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <time.h>

struct settings {
    const char *out, *hold_out;
    const struct preset *preset;
    struct joint_settings joint;
    struct solve_materials materials;
    double w_sim;
    bool has_w_sim, no_visibility, no_planes, no_continuation, footprint_mean, json;
    int texture, n_lights, n_sub, n_threads, edge_px;
    uint64_t seed;
    struct inputs in;
};

enum {
    OPTION_PRESET = 512, OPTION_METHOD,
    OPTION_TEXTURE, OPTION_LIGHTS, OPTION_SUB_LIGHTS, OPTION_HOLD_OUT, OPTION_THREADS, OPTION_SEED, OPTION_JSON,
    OPTION_REFLECTANCE, OPTION_ALBEDO, OPTION_DISTANCE, OPTION_W_SIM, OPTION_NO_PLANES, OPTION_NO_CONTINUATION, OPTION_FOOTPRINT_MEAN, OPTION_EDGE_PX, OPTION_NO_VISIBILITY, OPTION_ROBUST, OPTION_GAIN,
    OPTION_VERBOSE,
};

static const struct argp_option options[] = {
    { 0, 0, 0, 0, "Method", 2 },
    { "preset", OPTION_PRESET, "NAME", 0, "preview (stage 1, texture 128, 64 lights, in seconds), standard (512, default) or final (2048); with --stage 1: 128, 256, 512", 2 },
    { "method", OPTION_METHOD, "NAME", 0, "joint (default), alternating (the paper) or directional", 2 },
    { "texture", OPTION_TEXTURE, "N", 0, "N x N texels", 2 },
    { "lights", OPTION_LIGHTS, "N", 0, "lights with a distance of their own, a power of two (256; preview: 64)", 2 },
    { "sub-lights", OPTION_SUB_LIGHTS, "K", 0, "each light is K lights of one distance, a power of two (joint: 4; else 1)", 2 },
    { "reflectance", OPTION_REFLECTANCE, "NAME", 0, "disney (default) or lambert", 2 },
    { "albedo", OPTION_ALBEDO, "free|shared|VALUE", 0, "per texel (default), one unknown colour, or known", 2 },
    { "distance", OPTION_DISTANCE, "M", 0, "first distance of all lights (joint: swept; alternating: 2)", 2 },
    { "w-sim", OPTION_W_SIM, "W", 0, "weight of the similarity term beside the mean of squares: alternating 3e-9; joint: the last one "
      "(default: chosen by views set aside)", 2 },
    { "edge-px", OPTION_EDGE_PX, "N", 0, "leave out samples within N pixels of a silhouette or depth edge (1, and as far as light has "
      "spread by the pictures' own notes and by what the object's outline shows; 4 where neither tells)", 2 },
    { "footprint-mean", OPTION_FOOTPRINT_MEAN, 0, 0, "a sample is the mean over its footprint, not the value at its centre", 2 },
    { "no-continuation", OPTION_NO_CONTINUATION, 0, 0, "joint: begin at --w-sim itself", 2 },
    { "no-planes", OPTION_NO_PLANES, 0, 0, "joint: do not look for lights that lie on one plane", 2 },
    { "no-visibility", OPTION_NO_VISIBILITY, 0, 0, "every light reaches every texel above its horizon", 2 },
    { "robust", OPTION_ROBUST, 0, 0, "down-weight outliers in the last stage", 2 },
    { "gain", OPTION_GAIN, 0, 0, "one unknown exposure factor per camera", 2 },
    { "hold-out", OPTION_HOLD_OUT, "every:K|list:FILE", 0, "views that are never fitted, only reported (every:7)", 2 },
    { "threads", OPTION_THREADS, "N", 0, "default: all cores; the result is the same", 2 },
    { "seed", OPTION_SEED, "N", 0, "written into the report; nothing here is random (1)", 2 },
    { 0, 0, 0, 0, "Output", 3 },
    { "output", 'o', "DIR", 0, "where the result is written (required)", 3 },
    { "json", OPTION_JSON, 0, 0, "print report.json", 3 },
    { "verbose", OPTION_VERBOSE, 0, 0, "say what every stage did", 3 },
    { 0 },
};

static const char doc[] =
    "Find where the studio's lights are, one shared reflectance, and every texel's albedo.\v"
    "TAKE is a folder with geometry/, linear/, panorama.exr and start.json; or name the pieces one by one. Writes "
    "DIR/lights.json, albedo.exr, brdf.exr, std.exr, validity.exr and report.json; `rigsolve render DIR` makes pictures of it.\n\n"
    "Exit status: 0 done, 1 failed, 2 usage, 3 done, but the result is not to be trusted: the report says why.";

static error_t parse_option(int key, char *text, struct argp_state *state)
{
    static const char *const models[] = { "disney", "lambert" };
    struct settings *s = state->input;
    switch (key) {
    case ARGP_KEY_INIT:
        state->child_inputs[0] = &s->in;
        state->child_inputs[1] = &s->materials;
        return 0;
    case OPTION_PRESET:
        s->preset = &presets[argument_choice(state, "--preset", text, preset_names, N_PRESETS)];
        return 0;
    case OPTION_METHOD:
        s->joint.method = (enum method)argument_choice(state, "--method", text, method_names, 3);
        return 0;
    case OPTION_TEXTURE:
        s->texture = (int)argument_integer(state, "--texture", text, 1, 4096);
        return 0;
    case OPTION_LIGHTS:
        s->n_lights = argument_power_of_two(state, "--lights", text, 1024);
        return 0;
    case OPTION_SUB_LIGHTS:
        s->n_sub = argument_power_of_two(state, "--sub-lights", text, 64);
        return 0;
    case OPTION_REFLECTANCE:
        s->joint.model = (enum reflectance)argument_choice(state, "--reflectance", text, models, 2);
        return 0;
    case OPTION_ALBEDO:
        if (!strcmp(text, "free")) {
            s->joint.albedo = ALBEDO_FREE;
        } else if (!strcmp(text, "shared")) {
            s->joint.albedo = ALBEDO_SHARED;
        } else {
            s->joint.albedo = ALBEDO_GIVEN;
            s->joint.given_albedo[0] = s->joint.given_albedo[1] = s->joint.given_albedo[2] = argument_number(state, "--albedo", text, "'free', 'shared' or a number", 0, 1.5);
        }
        return 0;
    case OPTION_DISTANCE:
        s->joint.start_distance_m = argument_number(state, "--distance", text, "metres", .2, 50);
        return 0;
    case OPTION_W_SIM:
        s->w_sim = argument_number(state, "--w-sim", text, "a number", 0, 1e6);
        s->has_w_sim = true;
        return 0;
    case OPTION_NO_CONTINUATION:
        s->no_continuation = true;
        return 0;
    case OPTION_FOOTPRINT_MEAN:
        s->footprint_mean = true;
        return 0;
    case OPTION_EDGE_PX:
        s->edge_px = (int)argument_integer(state, "--edge-px", text, 0, 64);
        return 0;
    case OPTION_NO_PLANES:
        s->no_planes = true;
        return 0;
    case OPTION_NO_VISIBILITY:
        s->no_visibility = true;
        return 0;
    case OPTION_ROBUST:
        s->joint.robust = true;
        return 0;
    case OPTION_GAIN:
        s->joint.gain = true;
        return 0;
    case OPTION_HOLD_OUT:
        if (strncmp(text, "every:", 6) && strncmp(text, "list:", 5))
            argp_error(state, "--hold-out '%s': expected every:K or list:FILE", text);
        if (!strncmp(text, "every:", 6))
            argument_integer(state, "--hold-out every:", text + 6, 2, 1000);
        s->hold_out = text;
        return 0;
    case OPTION_THREADS:
        s->n_threads = (int)argument_integer(state, "--threads", text, 1, 256);
        return 0;
    case OPTION_SEED:
        s->seed = (uint64_t)argument_integer(state, "--seed", text, 0, INT32_MAX);
        return 0;
    case OPTION_JSON:
        s->json = true;
        return 0;
    case OPTION_VERBOSE:
        log_set_level(LOG_DEBUG);
        return 0;
    case 'o':
        s->out = text;
        return 0;
    case ARGP_KEY_END:
        if (s->no_continuation && !s->has_w_sim)
            argp_error(state, "--no-continuation: give the weight to begin (and end) with by --w-sim");
        if (!s->out)
            argp_error(state, "no -o DIR: where shall the result go?");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

// ---- what is loaded -------------------------------------------------------------------------------------------------------

struct scene {
    struct lights lights;
    struct samples samples;
    struct padding padding; // zero where no texture is solved for
    uint8_t *held_out; // [cameras.n]
};

static void free_scene(struct scene *s)
{
    free(s->held_out);
    samples_free(&s->samples);
    lights_free(&s->lights);
}

static int choose_held_out(struct scene *scene, const struct settings *s)
{
    const struct cameras *c = &s->in.cameras;
    scene->held_out = calloc((size_t)c->n + 1, 1);
    if (!scene->held_out)
        return -ENOMEM;
    if (!strncmp(s->hold_out, "every:", 6)) {
        const int k = atoi(s->hold_out + 6);
        for (int v = k - 1; v < c->n; v += k)
            scene->held_out[v] = 1;
        return 0;
    }
    char *text;
    size_t n;
    const int err = file_read(&text, &n, s->hold_out + 5, 1 << 24);
    if (err)
        return err;
    char *save = NULL;
    for (char *name = strtok_r(text, "\r\n", &save); name; name = strtok_r(NULL, "\r\n", &save)) {
        char stem[CAMERA_NAME_MAX]; // "views/cam001.exr" names cam001
        const char *base = strrchr(name, '/') ? strrchr(name, '/') + 1 : name, *dot = strrchr(base, '.');
        snprintf(stem, sizeof(stem), "%.*s", (int)(dot ? dot - base : (long)strlen(base)), base);
        const struct camera *found = cameras_find(c, name) ? cameras_find(c, name) : cameras_find(c, stem);
        if (!found) {
            log_error("solve: %s: there is no view '%s' among the cameras", s->hold_out + 5, name);
            free(text);
            return -EINVAL;
        }
        scene->held_out[found - c->view] = 1;
    }
    free(text);
    return 0;
}

static int load(struct scene *scene, struct settings *s)
{
    struct samples_settings gather = samples_defaults();
    struct lights cut = { 0 };
    gather.n_threads = s->n_threads;
    gather.at_centre = !s->footprint_mean;
    gather.erode_px = s->edge_px;
    s->in.needs = TAKE_MESH | TAKE_CAMERAS | TAKE_PANORAMA | TAKE_VIEWS;
    s->in.texture = s->texture;
    int err = inputs_load(&s->in);
    if (!err && s->joint.albedo == ALBEDO_FREE)
        err = padding_measure(&scene->padding, &s->in.mesh, &s->in.texels);
    if (!err && padding_is_short(&scene->padding)) {
        char text[PADDING_TEXT];
        padding_text(text, sizeof(text), &scene->padding);
        log_warning("mesh: %s: %s", s->in.mesh_path, text);
    }
    if (!err)
        err = choose_held_out(scene, s);
    if (!err)
        err = inputs_lights(&cut, &s->in, NULL, s->n_lights);
    if (!err)
        err = lights_refine(&scene->lights, &cut, &s->in.panorama, s->n_lights * s->n_sub);
    lights_free(&cut);
    if (err)
        return err;
    return samples_gather(&scene->samples, &s->in.texels, s->in.rays, &s->in.cameras, (const char *const *)s->in.picture,
                          &gather);
}

// ---- what is written ------------------------------------------------------------------------------------------------------

static double wall_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int write_texture(const struct settings *s, const char *name, int n_channels,
                         const char *const *names, const float *constant, const float (*per_texel)[3])
{
    const struct texels *t = &s->in.texels;
    struct image image;
    char *path;
    if (asprintf(&path, "%s/%s", s->out, name) < 0)
        return -ENOMEM;
    int err = image_new(&image, t->size, t->size, n_channels, names);
    for (int i = 0; !err && i < t->n; i++) {
        float *pixel = image.data + (size_t)t->pixel[i] * (size_t)n_channels;
        for (int c = 0; c < n_channels; c++)
            pixel[c] = per_texel ? per_texel[i][c] : constant[c];
    }
    if (!err)
        err = texels_fill_gutter(t, image.data, n_channels, 4);
    if (!err)
        err = image_write_exr(&image, path, IMAGE_FLOAT, IMAGE_ZIP);
    image_free(&image);
    free(path);
    return err;
}

static struct json *numbers_by_name(const double *values)
{
    struct json *o = json_object();
    for (int i = 0; i < DISNEY_N; i++)
        json_set_number(o, disney_parameter_names[i], values[i]);
    return o;
}

// Absolute, so that a solve's folder may be read from anywhere; nothing where path is NULL.
static void set_path(struct json *inputs, const char *key, const char *path)
{
    char *real = path ? realpath(path, NULL) : NULL;
    if (path)
        json_set_string(inputs, key, real ? real : path);
    free(real);
}

// What other programs and people read: model.glb, model.mtlx, report.html.
static int write_for_others(const struct settings *s)
{
    struct export_summary exported;
    const struct report_inputs page = { .solve_dir = s->out, .n_views = s->preset->page_views, .quick = s->preset->quick_page, .n_threads = s->n_threads };
    const int err = export_folder(&exported, s->out, NULL, s->out, EXPORT_GLB | EXPORT_MTLX, s->n_threads);
    return err ? err : report_folder(&page);
}

static struct json *make_report(const struct scene *scene, const struct settings *s, const struct joint_result *r, const struct materials *m,
                                double wall, double stage_s, double materials_s)
{
    struct rusage use;
    getrusage(RUSAGE_SELF, &use);
    struct json *o = json_object(), *warnings = json_array(), *inputs = json_object(), *stages = json_object(),
                *stage1 = json_object();
    json_set_string(o, "method", method_names[s->joint.method]);
    json_set_string(o, "preset", s->preset->name);
    json_set_string(o, "kernel", kernels_select(KERNELS_ALL)->name);
    json_set_int(o, "seed", (int64_t)s->seed);
    json_set_int(o, "threads", s->n_threads > 0 ? s->n_threads : parallel_n_cores());
    json_set_number(o, "wall_s", wall);
    json_set_number(o, "cpu_s", (double)(use.ru_utime.tv_sec + use.ru_stime.tv_sec) +
                                    1e-6 * (double)(use.ru_utime.tv_usec + use.ru_stime.tv_usec));
    json_set_int(o, "peak_rss_bytes", (int64_t)use.ru_maxrss * 1024);
    json_set_int(o, "n_views", s->in.n_pictures);
    json_set_int(o, "n_lights", s->n_lights);
    json_set_int(o, "n_sub_lights", s->n_sub);
    json_set_int(o, "texture", s->texture);
    json_set_int(o, "n_observations", scene->samples.n);
    json_set_number(o, "clipped_share", scene->samples.clipped_share);
    json_set_int(o, "edge_px", scene->samples.edge_px);
    json_set_number(o, "edge_reach_px", scene->samples.edge_reach_px);
    json_set_number(o, "edge_offset_px", scene->samples.edge_offset_px);
    json_set_number(o, "rmse_fit_percent", r->rmse_fit_percent);
    json_set_number(o, "rmse_held_out_percent", r->rmse_held_out_percent >= 0 ? r->rmse_held_out_percent : NAN);
    json_set_numbers(o, "centre_m", r->state.lights.centre_m, 3);
    json_set_numbers(o, "centre_std_m", r->centre_std_m, 3);
    json_set_matrix3(o, "world_from_probe", r->state.lights.world_from_probe);
    json_set_numbers(o, "rotation_std_rad", r->rotation_std_rad, 3);
    json_set_string(o, "brdf", s->joint.model == REFLECT_LAMBERT ? "lambert" : "disney");
    json_set_string(o, "disney_variant", disney_variant_name(s->joint.variant));
    if (s->joint.model == REFLECT_DISNEY) {
        json_set(o, "theta", numbers_by_name(r->state.theta));
        json_set(o, "theta_std", numbers_by_name(r->theta_std));
    }
    json_set_number(o, "w_sim_mean", r->w_sim);
    json_set_number(o, "w_sim_sum", r->w_sim_sum);
    json_set_int(o, "n_jacobians", r->n_jacobians);
    json_set_int(o, "n_sweep_jacobians", r->n_sweep_jacobians);
    json_set_number(o, "structure", r->misfit.structure);
    json_set_number(o, "distance_std_relative", r->distance_std_relative);
    json_set_int(o, "n_evaluations", r->n_evaluations);
    json_set_string(o, "stop_reason", r->stop_reason);
    json_set_bool(o, "trusted", r->doubts == 0);
    for (unsigned bit = 1; bit <= DOUBT_POOR_FIT; bit <<= 1)
        if (r->doubts & bit)
            json_append_string(warnings, joint_doubt_text(bit));
    if (m->theta)
        solve_warn_of_materials(warnings, m);
    if (padding_is_short(&scene->padding)) {
        char text[PADDING_TEXT];
        padding_text(text, sizeof(text), &scene->padding);
        json_append_string(warnings, text);
    }
    json_set(o, "warnings", warnings);
    json_set_number(stage1, "wall_s", stage_s);
    json_set_int(stage1, "iterations", r->n_jacobians);
    json_set(stages, "joint", stage1);
    if (m->theta)
        solve_report_materials(o, stages, m, materials_s);
    json_set(o, "stages", stages);
    set_path(inputs, "take", s->in.take_dir);
    set_path(inputs, "mesh", s->in.mesh_path);
    set_path(inputs, "cameras", s->in.cameras_path);
    set_path(inputs, "images", s->in.images_dir);
    json_set(o, "inputs", inputs);
    struct json *held_out = json_array();
    for (int v = 0; v < s->in.cameras.n; v++)
        if (scene->held_out[v])
            json_append_string(held_out, s->in.cameras.view[v].name);
    json_set(o, "views_held_out", held_out);
    return o;
}

static int write_result(const struct scene *scene, const struct settings *s, const struct joint_result *r, const struct materials *m,
                        struct json *report)
{
    float theta[DISNEY_N];
    char *lights = NULL, *path = NULL;
    for (int i = 0; i < DISNEY_N; i++)
        theta[i] = (float)r->state.theta[i];
    int err = make_directories(s->out);
    if (!err && (asprintf(&lights, "%s/lights.json", s->out) < 0 || asprintf(&path, "%s/report.json", s->out) < 0))
        err = -ENOMEM;
    // The regions are the cut's; the set-up is the result's.
    struct lights solved = scene->lights;
    solved.inverse_distance = r->state.lights.inverse_distance;
    memcpy(solved.centre_m, r->state.lights.centre_m, sizeof(solved.centre_m));
    memcpy(solved.world_from_probe, r->state.lights.world_from_probe, sizeof(solved.world_from_probe));
    if (!err)
        err = lights_write_json(&solved, lights);
    float(*albedo)[3] = malloc((size_t)s->in.texels.n * sizeof(*albedo));
    float(*seen)[3] = malloc((size_t)s->in.texels.n * sizeof(*seen));
    if (!err && (!albedo || !seen))
        err = -ENOMEM;
    for (int t = 0; !err && t < s->in.texels.n; t++)
        for (int c = 0; c < 3; c++) {
            albedo[t][c] = s->joint.albedo == ALBEDO_SHARED ? (float)r->state.shared_albedo[c] : r->state.albedo[t][c];
            seen[t][c] = (float)(scene->samples.first[t + 1] > scene->samples.first[t]);
        }
    if (!err && m->theta)
        err = solve_write_materials(m, &s->in.texels, s->out);
    if (!err && !m->theta)
        err = write_texture(s, "albedo.exr", 3, NULL, NULL, (const float(*)[3])albedo);
    if (!err && !m->theta)
        err = write_texture(s, "validity.exr", 3, NULL, NULL, (const float(*)[3])seen);
    if (!err && !m->theta && s->joint.model == REFLECT_DISNEY)
        err = write_texture(s, "brdf.exr", DISNEY_N, disney_parameter_names, theta, NULL);
    if (!err)
        err = json_write(report, path);
    free(albedo);
    free(seen);
    free(lights);
    free(path);
    return err;
}

static void print_summary(const struct settings *s, const struct samples *samples, const struct joint_result *r)
{
    const double *c = r->state.lights.centre_m;
    printf("%s: RMSE %.3f %% on %lld fitted samples", method_names[s->joint.method], r->rmse_fit_percent, (long long)r->n_fit);
    if (r->rmse_held_out_percent >= 0)
        printf(", %.3f %% on %lld held out", r->rmse_held_out_percent, (long long)r->n_held_out);
    printf("; %d Jacobians, stop: %s\n", r->n_jacobians, r->stop_reason);
    printf("centre (%.4f, %.4f, %.4f) m, standard deviation %.1f mm\n", c[0], c[1], c[2], 1e3 * vec3_norm(r->centre_std_m));
    if (!isnan(samples->edge_reach_px))
        printf("object and background are mixed up to %.1f px from its outline; samples keep %d px away\n", samples->edge_reach_px, samples->edge_px);
    for (int i = 0; s->joint.model == REFLECT_DISNEY && i < DISNEY_N; i++)
        printf("%-16s %.4f +- %.4f\n", disney_parameter_names[i], r->state.theta[i], r->theta_std[i]);
    for (unsigned bit = 1; bit <= DOUBT_POOR_FIT; bit <<= 1)
        if (r->doubts & bit)
            printf("not to be trusted: %s\n", joint_doubt_text(bit));
}

int command_solve(int argc, char **argv)
{
    const struct argp_child children[] = { { &inputs_argp, 0, NULL, 0 }, { &solve_materials_argp, 0, NULL, 0 }, { 0 } };
    const struct argp argp = { options, parse_option, "TAKE -o DIR\n--mesh M --cameras C --images DIR --panorama P -o DIR", doc,
                               children, 0, 0 };
    struct settings s = { .preset = &presets[PRESET_STANDARD], .hold_out = "every:7", .seed = 1, .edge_px = ERODE_BY_PICTURE };
    struct scene scene = { 0 };
    struct joint_result result = { 0 };
    struct materials materials = { 0 };
    const double begin = wall_s();
    argp_parse(&argp, argc, argv, 0, NULL, &s);
    const struct joint_settings defaults = joint_defaults(s.joint.method);
    if (!s.joint.start_distance_m)
        s.joint.start_distance_m = defaults.start_distance_m;
    s.joint.w_sim = s.has_w_sim ? s.w_sim : defaults.w_sim;
    s.joint.visibility = defaults.visibility && !s.no_visibility;
    s.joint.planes = defaults.planes && !s.no_planes;
    s.joint.continuation = !s.no_continuation;
    s.joint.n_threads = s.n_threads;
    s.materials.no_visibility = s.no_visibility;
    if (!s.materials.last_stage)
        s.materials.last_stage = s.materials.lights_from ? 2 : s.preset->last_stage;
    if (!s.n_lights)
        s.n_lights = s.preset->n_lights;
    s.joint.coarse_samples = s.preset->coarse_samples;
    s.joint.fine_samples = s.preset->fine_samples;
    if (!s.n_sub)
        s.n_sub = s.joint.method == METHOD_JOINT ? 4 : 1;
    if (!s.texture)
        s.texture = s.materials.last_stage == 2 ? s.preset->texture : s.preset->texture_stage1;
    int err = load(&scene, &s);
    const double stage_begin = wall_s();
    if (!err && s.materials.lights_from)
        err = solve_read_lights(&result, &scene.lights, &s.materials, &s.in, &scene.samples, scene.held_out, s.joint.method, s.n_threads);
    else if (!err)
        err = joint_solve(&result, &s.in.texels, &scene.samples, s.in.rays, &scene.lights, scene.held_out, &s.joint);
    const double materials_begin = wall_s();
    if (!err && s.materials.last_stage == 2 && s.joint.model == REFLECT_DISNEY && s.joint.albedo == ALBEDO_FREE)
        err = solve_find_materials(&materials, &s.materials, &result, &scene.lights, &s.joint, &s.in, &scene.samples, scene.held_out, s.n_threads);
    if (!err) {
        const double now = wall_s();
        struct json *report = make_report(&scene, &s, &result, &materials, now - begin, materials_begin - stage_begin, now - materials_begin);
        err = write_result(&scene, &s, &result, &materials, report);
        if (!err)
            err = write_for_others(&s);
        if (!err && s.json) {
            char *text = json_text(report);
            puts(text ? text : "");
            free(text);
        } else if (!err) {
            print_summary(&s, &scene.samples, &result);
            if (materials.theta)
                solve_print_materials(&materials);
        }
        json_free(report);
    }
    const int code = err ? EXIT_FAILED : result.doubts ? EXIT_NOT_TRUSTED : EXIT_DONE;
    joint_result_free(&result);
    materials_free(&materials);
    free_scene(&scene);
    inputs_free(&s.in);
    return code;
}
