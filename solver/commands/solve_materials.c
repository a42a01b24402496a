// solver/commands/solve_materials.c - stage 2 of `rigsolve solve`: ten textures and the albedo under lights that are known.
#include "solver/commands/solve_materials.h"

#include "solver/commands/arguments.h"
#include "solver/mirrored.h"
#include "solver/relocate.h"
#include "solver/take/image.h"
#include "solver/take/log.h"
#include "solver/visibility.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static const int64_t most_soft_bytes = INT64_C(1) << 30;
enum { KEY_STAGE = 0x20000, KEY_LIGHTS_FROM, KEY_W_REG, KEY_W_PARENT, KEY_NO_SEAMS, KEY_BOUNCES, KEY_NO_SELECTION, KEY_RELOCATE, KEY_PARAMETER_TEXTURE, KEY_MATERIAL_LIGHTS };

static const struct argp_option options[] = {
    { 0, 0, 0, 0, "Materials", 4 },
    { "stage", KEY_STAGE, "1|2", 0, "the last stage: 1 finds the lights and one shared reflectance, 2 (default; with --preset preview: 1) the textures too", 4 },
    { "lights-from", KEY_LIGHTS_FROM, "PATH", 0, "no stage 1: lights of an earlier solve's folder, or of a lights.json", 4 },
    { "w-reg", KEY_W_REG, "W", 0, "weight of the textures' smoothness beside the sum of squares (joint: .02; alternating: 1)", 4 },
    { "w-parent", KEY_W_PARENT, "W", 0, "weight that draws a texel towards its coarser parent (joint: .02; alternating: 0)", 4 },
    { "parameter-texture", KEY_PARAMETER_TEXTURE, "N", 0, "the ten parameters no finer than N x N; the albedo keeps --texture", 4 },
    { "no-seams", KEY_NO_SEAMS, 0, 0, "charts of the atlas know nothing of each other", 4 },
    { "no-selection", KEY_NO_SELECTION, 0, 0, "every parameter is free at every texel", 4 },
    { "relocate", KEY_RELOCATE, "N", 0, "find the lights again under the materials, at most N times (joint: 2; with --lights-from: 0)", 4 },
    { "material-lights", KEY_MATERIAL_LIGHTS, "N", 0, "point lights to shade the textures by (joint: 4096 if something is glossy, else those of stage 1)", 4 },
    { "bounces", KEY_BOUNCES, "N", 0, "light that the object sends to itself, as if diffuse: N bounces (joint: 1; else 0)", 4 },
    { 0 },
};

static error_t parse(int key, char *text, struct argp_state *state)
{
    struct solve_materials *s = state->input;
    switch (key) {
    case ARGP_KEY_INIT:
        s->last_stage = 0;
        s->w_reg = s->w_parent = -1;
        s->n_relocations = s->n_bounces = -1;
        return 0;
    case KEY_STAGE:
        s->last_stage = (int)argument_integer(state, "--stage", text, 1, 2);
        return 0;
    case KEY_LIGHTS_FROM:
        s->lights_from = text;
        return 0;
    case KEY_W_REG:
        s->w_reg = argument_number(state, "--w-reg", text, "a number", 0, 1e6);
        return 0;
    case KEY_W_PARENT:
        s->w_parent = argument_number(state, "--w-parent", text, "a number", 0, 1e6);
        return 0;
    case KEY_PARAMETER_TEXTURE:
        s->most_size = (int)argument_integer(state, "--parameter-texture", text, 1, 4096);
        return 0;
    case KEY_NO_SEAMS:
        s->no_seams = true;
        return 0;
    case KEY_NO_SELECTION:
        s->no_selection = true;
        return 0;
    case KEY_RELOCATE:
        s->n_relocations = (int)argument_integer(state, "--relocate", text, 0, 10);
        return 0;
    case KEY_MATERIAL_LIGHTS:
        s->n_lights = (int)argument_integer(state, "--material-lights", text, 1, LIGHTS_MAX);
        return 0;
    case KEY_BOUNCES:
        s->n_bounces = (int)argument_integer(state, "--bounces", text, 0, 10);
        return 0;
    case ARGP_KEY_END:
        if (s->lights_from && s->last_stage == 1)
            argp_error(state, "--lights-from leaves stage 1 out, --stage 1 all the rest");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

const struct argp solve_materials_argp = { options, parse, NULL, NULL, NULL, NULL, NULL };

// ---- lights of an earlier solve -----------------------------------------------------------------------------------------

static int by_float(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

// 1 for each texel's darkest quarter of samples, at least 3 (the paper's choice for the albedo).
static void mark_darkest(const struct samples *s, const uint8_t *use_view, float *weight)
{
    float sorted[4096];
    for (int t = 0; t < s->n_texels; t++) {
        int n = 0;
        for (int pass = 0; pass < 2; pass++) {
            const int quarter = n / 4 < 3 ? (n < 3 ? n : 3) : n / 4;
            const float darkest = pass && n ? sorted[quarter - 1] : 0;
            for (int64_t i = s->first[t]; i < s->first[t + 1]; i++) {
                float rgb[3];
                samples_radiance(s, i, rgb);
                const float sum = rgb[0] + rgb[1] + rgb[2];
                if (pass)
                    weight[i] = use_view[s->view[i]] && sum <= darkest;
                else if (use_view[s->view[i]] && n < 4096)
                    sorted[n++] = sum;
            }
            qsort(sorted, (size_t)n, sizeof(float), by_float);
        }
    }
}

// Eq. 10: the Lambertian albedo of the darkest samples.
static int darkest_albedo(struct joint_result *r, const struct texels *texels, const struct samples *samples, const uint8_t *use_view, int n_threads)
{
    const int n = r->state.lights.n;
    int32_t *group = malloc((size_t)n * sizeof(*group));
    float *weight = malloc(((size_t)samples->n + 1) * sizeof(float));
    struct photometric p = { .texels = texels, .samples = samples, .model = REFLECT_LAMBERT, .albedo = ALBEDO_FREE, .group_of_light = group,
                             .n_groups = n, .use_view = use_view, .texel_step = 1, .weight = weight, .n_threads = n_threads };
    struct photometric_error e;
    int err = group && weight ? 0 : -ENOMEM;
    for (int i = 0; !err && i < n; i++)
        group[i] = i;
    if (!err) {
        mark_darkest(samples, use_view, weight);
        err = photometric_evaluate(&p, &r->state, true, &e);
    }
    free(group);
    free(weight);
    return err;
}

static int read_theta(double theta[DISNEY_N], const char *dir)
{
    struct json *report = NULL;
    char *path;
    if (asprintf(&path, "%s/report.json", dir) < 0)
        return -ENOMEM;
    const int err = access(path, F_OK) ? 0 : json_read(&report, path);
    for (int p = 0; !err && report && p < DISNEY_N; p++) {
        char key[64];
        double value;
        snprintf(key, sizeof(key), "theta.%s", disney_parameter_names[p]);
        if (!json_get_number(report, key, &value) && value >= 0 && value <= 1)
            theta[p] = value;
    }
    json_free(report);
    free(path);
    return err;
}

int solve_read_lights(struct joint_result *out, struct lights *lights, const struct solve_materials *set, const struct inputs *in,
                      const struct samples *samples, const uint8_t *held_out, enum method method, int n_threads)
{
    struct stat st;
    struct lights from = { 0 };
    const bool is_dir = !stat(set->lights_from, &st) && S_ISDIR(st.st_mode);
    char *path;
    memset(out, 0, sizeof(*out));
    if (asprintf(&path, "%s%s", set->lights_from, is_dir ? "/lights.json" : "") < 0)
        return -ENOMEM;
    int err = lights_read_json(&from, path);
    free(path);
    if (err)
        return err;
    lights_free(lights);
    *lights = from;
    struct photometric p = { .texels = &in->texels, .samples = samples };
    err = photometric_state_new(&out->state, &p, lights);
    out->stop_reason = "lights given";
    out->rmse_held_out_percent = -1;
    out->inverse_distance_std = calloc((size_t)lights->n + 1, sizeof(double));
    if (!err && !out->inverse_distance_std)
        err = -ENOMEM;
    if (!err && is_dir)
        err = read_theta(out->state.theta, set->lights_from);
    if (!err && method != METHOD_JOINT) {
        uint8_t *use = malloc((size_t)samples->n_views + 1);
        for (int v = 0; use && v < samples->n_views; v++)
            use[v] = !held_out[v];
        err = use ? darkest_albedo(out, &in->texels, samples, use, n_threads) : -ENOMEM;
        free(use);
    }
    if (err)
        joint_result_free(out);
    return err;
}

// ---- shadows ------------------------------------------------------------------------------------------------------------

// Directions to each light, all together about as many for any number of lights; 1: hard shadows.
static int sub_directions(const struct lights *l, const struct inputs *in)
{
    const int64_t n_bytes = (int64_t)in->texels.n * l->n;
    const bool known = l->region && in->panorama.image.data && l->panorama_width_px == in->panorama.image.width &&
                       l->panorama_height_px == in->panorama.image.height;
    if (known && n_bytes > most_soft_bytes)
        log_info("materials: hard shadows: soft ones of %d texels and %d lights would take %.1f GiB", in->texels.n, l->n,
                 (double)n_bytes / (1 << 30));
    return !known || n_bytes > most_soft_bytes ? 1 : l->n <= 256 ? 16 : l->n <= 512 ? 8 : 4;
}

// ---- the lights' number ---------------------------------------------------------------------------------------------------

// Of points a glossy lobe would show each for itself (SOLVER.md 6: at roughness .2, 1024 are 1 % off, 4096 a third of that).
enum { GLOSSY_LIGHTS = 4096 };
static const float glossy_roughness = .25f, glossy_share = .01f;

static bool is_glossy(const struct materials *m)
{
    int n = 0;
    for (int t = 0; t < m->n_texels; t++)
        n += m->theta[t][DISNEY_ROUGHNESS] < glossy_roughness;
    return (float)n > glossy_share * (float)m->n_texels;
}

// Glossy, or metal: it shows a picture of its surroundings.
static bool is_mirroring(const struct materials *m)
{
    int n = 0;
    for (int t = 0; t < m->n_texels; t++)
        n += m->theta[t][DISNEY_METALLIC] > .5f;
    return (float)n > glossy_share * (float)m->n_texels || is_glossy(m);
}

// The lights' regions once more in parts, at their distances: in `lights` and in stage1.
static int cut_finer(struct joint_result *stage1, struct lights *lights, const struct inputs *in, int n)
{
    struct lights from = *lights, fine[2] = { { 0 }, { 0 } };
    if (!lights->region || !lights->spread_rad || n <= lights->n || in->panorama.image.width != lights->panorama_width_px ||
        in->panorama.image.height != lights->panorama_height_px)
        return 0;
    from.inverse_distance = stage1->state.lights.inverse_distance;
    memcpy(from.centre_m, stage1->state.lights.centre_m, sizeof(from.centre_m));
    memcpy(from.world_from_probe, stage1->state.lights.world_from_probe, sizeof(from.world_from_probe));
    int err = 0, new_group = 0;
    for (int i = 0; i < lights->n; i++)
        new_group = lights->group[i] >= new_group ? lights->group[i] + 1 : new_group;
    for (int k = 0; !err && k < 2; k++) {
        err = lights_refine(&fine[k], &from, &in->panorama, n);
        for (int i = 0; !err && i < fine[k].n; i++) { // a light without a group is now one of several: they are one
            const int parent = fine[k].group[i];
            fine[k].group[i] = lights->group[parent] >= 0 ? lights->group[parent] : new_group + parent;
        }
    }
    if (err) {
        lights_free(&fine[0]);
        return err;
    }
    log_debug("materials: %d lights in place of %d", fine[0].n, lights->n);
    lights_free(lights);
    lights_free(&stage1->state.lights);
    *lights = fine[0], stage1->state.lights = fine[1];
    return 0;
}

// ---- the object in its own gloss ------------------------------------------------------------------------------------------

enum { MIRROR_RAYS = 16 };

// The materials once more, from samples without what the object mirrors of itself under those found so far.
static int solve_without_mirrored(struct materials *m, struct samples *without, const struct materials_input *input, const struct inputs *in,
                                  const struct materials_settings *set)
{
    const struct mirrored mirrored = { .texels = input->texels, .mesh = input->mesh, .rays = in->rays, .lights = input->lights, .samples = input->samples,
                                       .visible = input->visible, .soft = input->soft, .words_per_texel = input->words_per_texel,
                                       .theta = (const float(*)[DISNEY_N])m->theta, .albedo = (const float(*)[3])m->albedo,
                                       .indirect = (const float(*)[3])m->indirect, .variant = set->variant, .n_rays = MIRROR_RAYS, .n_threads = set->n_threads };
    struct materials_input again = *input;
    struct materials better;
    float(*radiance)[3] = calloc((size_t)input->samples->n + 1, sizeof(*radiance));
    int err = radiance ? mirrored_gather(&mirrored, radiance) : -ENOMEM;
    if (!err)
        err = mirrored_take_off(without, input->samples, (const float(*)[3])radiance);
    free(radiance);
    if (err)
        return err;
    again.samples = without;
    err = materials_solve(&better, &again, set);
    if (err)
        return err;
    log_debug("materials: without what the object mirrors of itself: held out %.3f -> %.3f %%", m->rmse_held_out_percent, better.rmse_held_out_percent);
    materials_free(m);
    *m = better;
    return 0;
}

// ---- the stage ----------------------------------------------------------------------------------------------------------

static int trace(struct materials_input *input, struct light_visibility *v, const struct inputs *in, int n_threads)
{
    light_visibility_free(v);
    const int err = light_visibility_trace(v, in->rays, &in->texels, input->lights, &in->panorama, sub_directions(input->lights, in), 1, n_threads);
    input->soft = v->soft, input->visible = v->bits, input->words_per_texel = v->words_per_texel;
    return err;
}

int solve_find_materials(struct materials *out, const struct solve_materials *set, struct joint_result *stage1, struct lights *lights,
                         const struct joint_settings *joint, const struct inputs *in, const struct samples *samples, const uint8_t *held_out,
                         int n_threads)
{
    struct light_visibility visibility = { 0 };
    struct samples without = { 0 }; // what the object mirrors of itself
    const enum method method = joint->method;
    const int n_relocations = set->n_relocations >= 0 ? set->n_relocations : set->lights_from || method != METHOD_JOINT ? 0 : 2;
    struct materials_settings settings = method == METHOD_JOINT ? materials_defaults() : materials_paper();
    struct materials_input input = { .texels = &in->texels, .samples = samples, .lights = &stage1->state.lights, .hold_out = held_out,
                                     .log_gain = stage1->state.log_gain, .rays = in->rays, .mesh = &in->mesh,
                                     .start_albedo = (const float(*)[3])stage1->state.albedo };
    input.inverse_distance_std = stage1->inverse_distance_std;
    memcpy(input.centre_std_m, stage1->centre_std_m, sizeof(input.centre_std_m));
    memcpy(input.start_theta, stage1->state.theta, sizeof(input.start_theta));
    settings.n_threads = n_threads;
    settings.seams = !set->no_seams;
    settings.selection = settings.selection && !set->no_selection;
    settings.n_bounces = set->n_bounces >= 0 ? set->n_bounces : method == METHOD_JOINT && !set->no_visibility;
    if (set->w_reg >= 0)
        settings.w_reg = set->w_reg;
    if (set->w_parent >= 0)
        settings.w_parent = set->w_parent;
    const bool shadows = method == METHOD_JOINT && !set->no_visibility;
    int n_lights = set->n_lights;
    int err = shadows ? trace(&input, &visibility, in, n_threads) : 0;
    for (int round = 0; !err && round < n_relocations; round++) {
        struct materials look = { 0 };
        double before, after;
        settings.most_size = set->most_size && set->most_size < 64 ? set->most_size : 64, settings.look = true;
        err = materials_solve(&look, &input, &settings);
        if (!err)
            err = relocate_lights(&stage1->state, &in->texels, samples, in->rays, held_out, (const float(*)[DISNEY_N])look.theta,
                                  (const float(*)[3])look.indirect, joint, &before, &after);
        if (!err && !set->n_lights)
            n_lights = is_glossy(&look) ? GLOSSY_LIGHTS : 0;
        materials_free(&look);
        if (!err && visibility.bits)
            err = light_visibility_refresh(&visibility, in->rays, &in->texels, &stage1->state.lights, &in->panorama, .5 * M_PI / 180, 1, n_threads);
        if (err > 0)
            err = 0; // so many lights were traced again
        log_debug("materials: lights again: views aside %.3f -> %.3f %%", before, after);
        if (!err && after > .97 * before)
            break;
    }
    settings.most_size = set->most_size, settings.look = false;
    if (!err && n_lights > stage1->state.lights.n)
        err = cut_finer(stage1, lights, in, n_lights);
    if (!err && shadows && visibility.n_lights != stage1->state.lights.n)
        err = trace(&input, &visibility, in, n_threads);
    if (!err)
        err = materials_solve(out, &input, &settings);
    if (!err && settings.n_bounces > 0 && is_mirroring(out))
        err = solve_without_mirrored(out, &without, &input, in, &settings);
    if (!err && n_relocations > 0)
        err = relocate_doubt(stage1, &in->texels, without.radiance ? &without : samples, in->rays, held_out, (const float(*)[DISNEY_N])out->theta, (const float(*)[3])out->indirect, joint);
    if (err)
        materials_free(out);
    light_visibility_free(&visibility);
    free(without.radiance);
    return err;
}

// ---- what is written ----------------------------------------------------------------------------------------------------

typedef float value_of(const struct materials *m, int texel, int channel);

static float albedo_of(const struct materials *m, int t, int c)
{
    return m->albedo[t][c];
}

static float theta_of(const struct materials *m, int t, int c)
{
    return m->theta[t][c];
}

static float std_of(const struct materials *m, int t, int c)
{
    return m->std[t][c];
}

static float validity_of(const struct materials *m, int t, int c)
{
    return c == 0 ? .5f * (float)m->validity[t] : c == 1 ? (float)m->coverage[t] : (float)m->region[t];
}

static int write_layer(const struct materials *m, const struct texels *t, const char *dir, const char *name, int n_channels,
                       const char *const *names, value_of *value, int gutter)
{
    struct image image;
    char *path;
    if (asprintf(&path, "%s/%s", dir, name) < 0)
        return -ENOMEM;
    int err = image_new(&image, t->size, t->size, n_channels, names);
    for (int i = 0; !err && i < t->n; i++)
        for (int c = 0; c < n_channels; c++)
            image.data[(size_t)t->pixel[i] * (size_t)n_channels + (size_t)c] = value(m, i, c);
    if (!err)
        err = texels_fill_gutter(t, image.data, n_channels, gutter);
    if (!err)
        err = image_write_exr(&image, path, IMAGE_FLOAT, IMAGE_ZIP);
    image_free(&image);
    free(path);
    return err;
}

int solve_write_materials(const struct materials *m, const struct texels *t, const char *dir)
{
    static const char *const validity[] = { "Y", "coverage", "region" };
    const char *std[DISNEY_N + 3];
    memcpy(std, disney_parameter_names, sizeof(disney_parameter_names));
    std[DISNEY_N] = "albedo_R", std[DISNEY_N + 1] = "albedo_G", std[DISNEY_N + 2] = "albedo_B";
    int err = write_layer(m, t, dir, "albedo.exr", 3, NULL, albedo_of, 4);
    if (!err)
        err = write_layer(m, t, dir, "brdf.exr", DISNEY_N, disney_parameter_names, theta_of, 4);
    if (!err)
        err = write_layer(m, t, dir, "std.exr", DISNEY_N + 3, std, std_of, 4);
    return err ? err : write_layer(m, t, dir, "validity.exr", 3, validity, validity_of, 0);
}

static struct json *by_name(const float *values)
{
    struct json *o = json_object();
    for (int p = 0; p < DISNEY_N; p++)
        json_set_number(o, disney_parameter_names[p], (double)values[p]);
    return o;
}

void solve_warn_of_materials(struct json *warnings, const struct materials *m)
{
    char text[160];
    if (!materials_make_light(m))
        return;
    snprintf(text, sizeof(text), "a material sends back %.2f times the light that it gets: it makes light; is the panorama's scale that of the views?",
             m->most_directional_albedo);
    json_append_string(warnings, text);
}

void solve_report_materials(struct json *report, struct json *stages, const struct materials *m, double wall_s)
{
    struct json *stage = json_object(), *levels = json_array(), *regions = json_array();
    int n_valid = 0, n_weak = 0;
    for (int t = 0; t < m->n_texels; t++)
        n_valid += m->validity[t] == MATERIAL_VALID, n_weak += m->validity[t] == MATERIAL_WEAK;
    json_set_number(stage, "wall_s", wall_s);
    json_set_number(stage, "rmse_fit_percent", m->rmse_fit_percent);
    json_set_number(stage, "rmse_held_out_percent", m->rmse_held_out_percent >= 0 ? m->rmse_held_out_percent : NAN);
    json_set_int(stage, "n_texels", m->n_texels);
    json_set_int(stage, "n_valid", n_valid);
    json_set_int(stage, "n_weak", n_weak);
    json_set_int(stage, "n_unobserved", m->n_texels - n_valid - n_weak);
    json_set_number(stage, "most_directional_albedo", m->most_directional_albedo);
    for (int k = 0; k < m->n_levels; k++) {
        struct json *o = json_object();
        json_set_int(o, "size", m->level[k].size);
        json_set_int(o, "n_texels", m->level[k].n_texels);
        json_set_int(o, "iterations", m->level[k].n_iterations);
        json_set_int(o, "pcg_iterations", m->level[k].n_pcg);
        json_set_int(o, "n_shaded", m->level[k].n_shaded);
        json_set_number(o, "objective", m->level[k].objective);
        json_append(levels, o);
    }
    json_set(stage, "levels", levels);
    for (int k = 0; k < m->regions.n; k++) {
        const struct region *r = &m->regions.region[k];
        struct json *o = json_object(), *freedom = json_object();
        json_set_int(o, "id", k);
        json_set_int(o, "n_texels", r->n_texels);
        json_set(o, "theta", by_name(r->theta));
        json_set(o, "theta_std", by_name(r->std));
        for (int p = 0; p < DISNEY_N; p++)
            json_set_string(freedom, disney_parameter_names[p], parameter_freedom_names[r->freedom[p]]);
        json_set(o, "model", freedom);
        json_set_number(o, "rmse_aside_percent", r->aside_rmse_percent);
        json_append(regions, o);
    }
    json_set(stage, "regions", regions);
    json_set(stages, "materials", stage);
    json_set_number(report, "rmse_fit_percent", m->rmse_fit_percent);
    json_set_number(report, "rmse_held_out_percent", m->rmse_held_out_percent >= 0 ? m->rmse_held_out_percent : NAN);
}

void solve_print_materials(const struct materials *m)
{
    printf("materials: RMSE %.3f %% on %lld fitted samples", m->rmse_fit_percent, (long long)m->n_fit);
    if (m->rmse_held_out_percent >= 0)
        printf(", %.3f %% on %lld held out", m->rmse_held_out_percent, (long long)m->n_held_out);
    printf("; %d texels, %d region%s\n", m->n_texels, m->regions.n, m->regions.n == 1 ? "" : "s");
    for (int k = 0; k < m->regions.n; k++) {
        const struct region *r = &m->regions.region[k];
        printf("region %d, %d texels:", k, r->n_texels);
        for (int p = 0; p < DISNEY_N; p++)
            printf(" %s %.3f+-%.3f%s", disney_parameter_names[p], (double)r->theta[p], (double)r->std[p],
                   r->freedom[p] == PARAMETER_FREE ? " (free)" : r->freedom[p] == PARAMETER_FROZEN ? " (frozen)" : "");
        printf("\n");
    }
}
