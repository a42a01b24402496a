// solver/export.c - from a solved material to textures that other programs shade with, and the report of what was lost.
//
// The Disney layers leave as they are where a format knows Disney (MaterialX, Blender). GLB and MTL shade with glTF's reflectance: every
// texel is fitted to it once (gltf_brdf.h), rounded to bytes, and the gutter is filled far outwards for mip maps.
#include "solver/export.h"
#include "solver/export_format.h"
#include "solver/gltf_brdf.h"
#include "solver/parallel.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/texels.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

enum { GUTTER_PX = 16, CHUNK = 256, MEASURED = 1 << 16 };
// What the fit leaves per texel.
enum { BASE = 0, SPECULAR = 3, SHEEN = 6, METALLIC = 9, ROUGHNESS, COAT, COAT_ROUGHNESS, ANISOTROPY, N_FITTED };

char *export_path(const struct export_job *job, const char *name)
{
    char *path;
    return asprintf(&path, "%s/%s", job->dir, name) < 0 ? NULL : path;
}

int export_wrote(struct export_job *job, const char *name)
{
    struct stat s;
    char *path = export_path(job, name);
    if (!path)
        return -ENOMEM;
    if (!stat(path, &s))
        job->summary.bytes += s.st_size;
    free(path);
    json_append_string(job->files, name);
    return 0;
}

// ---- what the source must be ----------------------------------------------------------------------------------------------

struct layout {
    int albedo[3], parameter[DISNEY_N];
};

static int find_channel(int *out, const struct image *image, const char *file, const char *name)
{
    *out = image_channel(image, name);
    if (*out >= 0)
        return 0;
    log_error("export: %s has no channel '%s'; it must have been written by rigsolve solve", file, name);
    return -EINVAL;
}

static int find_layout(struct layout *out, const struct export_source *s)
{
    static const char *const rgb[3] = { "R", "G", "B" };
    int err = 0;
    if (s->albedo->width != s->albedo->height) {
        log_error("export: the albedo has %d x %d pixels; expected a square atlas", s->albedo->width, s->albedo->height);
        return -EINVAL;
    }
    if (s->parameters && (s->parameters->width != s->albedo->width || s->parameters->height != s->albedo->height)) {
        log_error("export: brdf.exr has %d x %d pixels, albedo.exr %d x %d; expected the same", s->parameters->width,
                  s->parameters->height, s->albedo->width, s->albedo->height);
        return -EINVAL;
    }
    for (int k = 0; !err && k < 3; k++)
        err = find_channel(&out->albedo[k], s->albedo, "albedo.exr", rgb[k]);
    for (int p = 0; !err && s->parameters && p < DISNEY_N; p++)
        err = find_channel(&out->parameter[p], s->parameters, "brdf.exr", disney_parameter_names[p]);
    return err;
}

// ---- the fit --------------------------------------------------------------------------------------------------------------

struct fit {
    const struct export_source *source;
    const struct layout *layout;
    const struct texels *texels;
    const struct gltf_brdf *brdf;
    float (*fitted)[N_FITTED]; // [size * size]
    float *error;              // [texels->n] sum of squares of the fit, of every stride-th
    int stride;                // large atlases are measured on some 65,536 texels
};

static void get_disney(struct disney *m, const struct fit *f, size_t pixel)
{
    const struct export_source *s = f->source;
    *m = (struct disney){ .variant = s->variant };
    for (int k = 0; k < 3; k++)
        m->albedo[k] = fmax(0, (double)s->albedo->data[pixel * (size_t)s->albedo->n_channels + (size_t)f->layout->albedo[k]]);
    for (int p = 0; s->parameters && p < DISNEY_N; p++) {
        const double v =
            (double)s->parameters->data[pixel * (size_t)s->parameters->n_channels + (size_t)f->layout->parameter[p]];
        m->theta[p] = v < 0 ? 0 : v > 1 ? 1 : v;
    }
}

static void fit_texels(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    const struct fit *f = arg;
    (void)worker;
    for (int64_t i = begin; i < end; i++) {
        const size_t pixel = f->texels->pixel[i];
        float *out = f->fitted[pixel];
        struct gltf_fit_error error = { 0 };
        struct gltf_material g;
        struct disney m;
        get_disney(&m, f, pixel);
        if (f->source->parameters)
            gltf_from_disney(f->brdf, &g, &m, i % f->stride == 0 ? &error : NULL);
        else
            gltf_from_lambert(&g, m.albedo);
        for (int k = 0; k < 3; k++) {
            out[BASE + k] = (float)g.base_color[k];
            out[SPECULAR + k] = (float)g.specular_color[k];
            out[SHEEN + k] = (float)g.sheen_color[k];
        }
        out[METALLIC] = (float)g.metallic, out[ROUGHNESS] = (float)g.roughness;
        out[COAT] = (float)g.clearcoat, out[COAT_ROUGHNESS] = (float)g.clearcoat_roughness;
        out[ANISOTROPY] = (float)g.anisotropy;
        f->error[i] = (float)error.fitted;
        partial[0] += error.fitted, partial[1] += error.by_name;
    }
}

// ---- bytes ----------------------------------------------------------------------------------------------------------------

static uint8_t linear_byte(double v)
{
    return (uint8_t)lround(255 * fmin(fmax(v, 0), 1));
}

// Where a picture's three values come from; -1: none, byte 0.
struct recipe {
    int from[3];
    bool srgb;
};
static const struct recipe recipes[PICTURE_N] = {
    [PICTURE_BASE] = { { BASE, BASE + 1, BASE + 2 }, true },
    [PICTURE_METALLIC_ROUGHNESS] = { { -1, ROUGHNESS, METALLIC }, false },
    [PICTURE_SPECULAR] = { { SPECULAR, SPECULAR + 1, SPECULAR + 2 }, true },
    [PICTURE_COAT] = { { COAT, COAT_ROUGHNESS, -1 }, false },
    [PICTURE_SHEEN] = { { SHEEN, SHEEN + 1, SHEEN + 2 }, true },
    [PICTURE_ANISOTROPY] = { { -1, -1, ANISOTROPY }, false },
};

static int make_picture(struct export_job *job, int which, const struct texels *texels, const float (*fitted)[N_FITTED])
{
    const struct recipe *r = &recipes[which];
    struct export_picture *p = &job->picture[which];
    const double scale = which == PICTURE_SPECULAR ? job->specular_scale : 1;
    const size_t n = (size_t)job->size * (size_t)job->size;
    p->pixels = malloc(n * sizeof(*p->pixels));
    if (!p->pixels)
        return -ENOMEM;
    for (size_t i = 0; i < n; i++)
        for (int c = 0; c < 3; c++) {
            const double v = r->from[c] < 0 ? 0 : (double)fitted[i][r->from[c]] / scale;
            p->pixels[i][c] = r->srgb ? image_srgb_byte(v) : linear_byte(v);
        }
    if (which == PICTURE_ANISOTROPY)
        for (size_t i = 0; i < n; i++)
            p->pixels[i][0] = 255, p->pixels[i][1] = 128; // along the tangent
    const size_t first = texels->pixel[0];
    p->constant = true;
    for (int c = 0; c < 3; c++) {
        p->channel_constant[c] = true;
        for (int i = 0; i < texels->n; i++) {
            const uint8_t byte = p->pixels[texels->pixel[i]][c];
            p->channel_constant[c] = p->channel_constant[c] && byte == p->pixels[first][c];
            p->most[c] = byte > p->most[c] ? byte : p->most[c];
        }
        p->constant = p->constant && p->channel_constant[c];
        p->value[c] = r->from[c] < 0 ? 0 : (double)fitted[first][r->from[c]];
    }
    return 0;
}

static int make_pictures(struct export_job *job, const struct layout *layout, const struct texels *texels)
{
    const struct export_source *s = job->source;
    const size_t n = (size_t)job->size * (size_t)job->size;
    double sums[2] = { 0 };
    float most_specular = 0, worst = 0;
    struct gltf_brdf *brdf = NULL;
    struct fit fit = { .source = s, .layout = layout, .texels = texels, .stride = 1 + texels->n / MEASURED };
    int err = gltf_brdf_new(&brdf);
    fit.brdf = brdf;
    fit.fitted = calloc(n, sizeof(*fit.fitted));
    fit.error = calloc((size_t)texels->n, sizeof(*fit.error));
    if (!err && (!fit.fitted || !fit.error))
        err = -ENOMEM;
    if (!err)
        err = parallel_sum(s->n_threads, texels->n, CHUNK, fit_texels, &fit, 2, sums);
    if (!err)
        err = texels_fill_gutter(texels, fit.fitted[0], N_FITTED, GUTTER_PX);
    for (int i = 0; !err && i < texels->n; i++) {
        const float *f = fit.fitted[texels->pixel[i]];
        most_specular = fmaxf(most_specular, fmaxf(f[SPECULAR], fmaxf(f[SPECULAR + 1], f[SPECULAR + 2])));
        worst = fmaxf(worst, fit.error[i]);
    }
    job->specular_scale = most_specular > 1 ? (double)most_specular : 1;
    job->specular_factor = s->parameters ? 1 : 0;
    for (int p = 0; !err && p < PICTURE_N; p++)
        err = make_picture(job, p, texels, (const float(*)[N_FITTED])fit.fitted);
    if (!err) {
        struct gltf_material any;
        const struct disney grey = { .albedo = { .5, .5, .5 } };
        gltf_from_disney(brdf, &any, &grey, NULL);
        job->sheen_roughness = any.sheen_roughness;
        const int n_measured = (texels->n - 1) / fit.stride + 1;
        job->summary.rmse_percent = gltf_rmse_percent(sums[0], n_measured);
        job->summary.rmse_by_name_percent = gltf_rmse_percent(sums[1], n_measured);
        job->summary.worst_percent = gltf_rmse_percent((double)worst, 1);
    }
    free(fit.fitted);
    free(fit.error);
    gltf_brdf_free(brdf);
    return err;
}

// ---- the layers as they are -----------------------------------------------------------------------------------------------

static int write_exr(struct export_job *job, const struct image *image, const char *name)
{
    char *path = export_path(job, name);
    int err = path ? image_write_exr(image, path, IMAGE_FLOAT, IMAGE_ZIP) : -ENOMEM;
    free(path);
    return err ? err : export_wrote(job, name);
}

static int write_layers(struct export_job *job, const struct layout *layout)
{
    static const char *const y[] = { "Y" };
    const struct image *from = job->source->parameters;
    int err = job->source->in_place ? 0 : write_exr(job, job->source->albedo, "albedo.exr");
    for (int p = 0; !err && from && p < DISNEY_N; p++) {
        struct image layer;
        char name[64];
        if (job->map[p].constant)
            continue;
        char *maps = export_path(job, "maps");
        err = maps ? make_directories(maps) : -ENOMEM;
        free(maps);
        if (!err)
            err = image_new(&layer, job->size, job->size, 1, y);
        if (err)
            return err;
        const size_t n = (size_t)job->size * (size_t)job->size;
        for (size_t i = 0; i < n; i++)
            layer.data[i] = from->data[i * (size_t)from->n_channels + (size_t)layout->parameter[p]];
        snprintf(name, sizeof(name), "maps/%s.exr", disney_parameter_names[p]);
        err = write_exr(job, &layer, name);
        image_free(&layer);
    }
    return err;
}

static void find_constants(struct export_job *job, const struct layout *layout, const struct texels *texels)
{
    const struct image *from = job->source->parameters;
    for (int p = 0; p < DISNEY_N; p++) {
        job->map[p].constant = true;
        for (int i = 0; from && i < texels->n; i++) {
            const float v = from->data[texels->pixel[i] * (size_t)from->n_channels + (size_t)layout->parameter[p]];
            if (i == 0)
                job->map[p].value = v;
            job->map[p].constant = job->map[p].constant && v == job->map[p].value;
        }
    }
    if (!from)
        job->map[DISNEY_ROUGHNESS].value = 1; // specular 0 remains: Burley's diffuse is not Lambert's, and the notes say so
}

// ---- the report -----------------------------------------------------------------------------------------------------------

static int write_report(struct export_job *job)
{
    static const char *const names[] = { "glb", "mtlx", "obj", "blender" };
    const struct export_summary *s = &job->summary;
    const bool layers = s->formats & (EXPORT_MTLX | EXPORT_BLENDER), fitted = s->formats & (EXPORT_GLB | EXPORT_OBJ);
    struct json *doc = json_object(), *formats = json_array(), *material = json_object(), *refit = json_object(),
                *notes = json_array();
    for (int i = 0; i < 4; i++)
        if (s->formats & 1u << i)
            json_append_string(formats, names[i]);
    json_set(doc, "formats", formats);
    json_set(doc, "files", job->files);
    job->files = NULL;
    json_set_int(doc, "texture", job->size);
    json_set_int(doc, "n_texels", job->n_texels);
    json_set_string(doc, "brdf", job->source->parameters ? "disney" : "lambert");
    json_set_string(doc, "disney_variant", disney_variant_name(job->source->variant));
    if (layers) {
        json_set_string(material, "albedo", "albedo.exr");
        for (int p = 0; p < DISNEY_N; p++) {
            char name[64];
            snprintf(name, sizeof(name), "maps/%s.exr", disney_parameter_names[p]);
            if (job->map[p].constant)
                json_set_number(material, disney_parameter_names[p], (double)job->map[p].value);
            else
                json_set_string(material, disney_parameter_names[p], name);
        }
        json_set(doc, "material", material);
    } else {
        json_free(material);
    }
    if (fitted) {
        json_set_number(refit, "rmse_percent", s->rmse_percent);
        json_set_number(refit, "rmse_by_name_percent", s->rmse_by_name_percent);
        json_set_number(refit, "worst_texel_percent", s->worst_percent);
        json_set_int(refit, "n_pairs_of_directions", GLTF_N_PAIRS);
        json_set_number(refit, "sheen_roughness", job->sheen_roughness);
        json_set(doc, "refit", refit);
        json_append_string(notes, "GLB and MTL hold glTF's reflectance: subsurface, the diffuse lobe's retro-reflection and most of sheen "
                                  "have no counterpart there; the base colour makes up for what it can, the specular colour keeps F0. "
                                  "rmse_percent compares the two under a white light, before rounding to 8 bits.");
    } else {
        json_free(refit);
    }
    if (!job->source->parameters && layers)
        json_append_string(notes, "The solve was Lambertian: its layers are written as Disney with specular 0 and roughness 1, whose "
                                  "diffuse lobe differs from Lambert's at grazing angles.");
    json_set(doc, "notes", notes);
    char *path = export_path(job, "export.json");
    const int err = path ? json_write(doc, path) : -ENOMEM;
    free(path);
    json_free(doc);
    return err;
}

static int write_lights(struct export_job *job)
{
    char *path = export_path(job, "lights.json");
    int err = path ? lights_write_json(job->source->lights, path) : -ENOMEM;
    free(path);
    return err ? err : export_wrote(job, "lights.json");
}

int export_write(struct export_summary *out, const struct export_source *source, unsigned formats, const char *dir)
{
    struct export_job job = { .source = source, .dir = dir, .size = source->albedo->width, .summary.formats = formats };
    struct texels texels = { 0 };
    struct layout layout;
    memset(out, 0, sizeof(*out));
    int err = find_layout(&layout, source);
    if (!err)
        err = texels_rasterise(&texels, source->mesh, job.size);
    if (err)
        return err;
    job.files = json_array();
    job.n_texels = job.summary.n_texels = texels.n;
    find_constants(&job, &layout, &texels);
    err = make_directories(dir);
    if (!err && (formats & (EXPORT_GLB | EXPORT_OBJ)))
        err = make_pictures(&job, &layout, &texels);
    if (!err && (formats & (EXPORT_MTLX | EXPORT_BLENDER)))
        err = write_layers(&job, &layout);
    if (!err && (formats & EXPORT_GLB))
        err = export_glb(&job);
    if (!err && (formats & EXPORT_MTLX))
        err = export_materialx(&job);
    if (!err && (formats & (EXPORT_OBJ | EXPORT_BLENDER)))
        err = export_obj(&job, formats & EXPORT_OBJ);
    if (!err && (formats & EXPORT_BLENDER) && source->lights && !source->in_place)
        err = write_lights(&job);
    if (!err)
        err = write_report(&job);
    for (int p = 0; p < PICTURE_N; p++)
        free(job.picture[p].pixels);
    json_free(job.files);
    texels_free(&texels);
    if (!err)
        *out = job.summary;
    return err;
}
