// solver/export_obj.c - model.obj, model.mtl and its pictures: the PBR keys that came to MTL after Wavefront's.
//
// Pm metallic, Pr roughness, Ps sheen, Pc and Pcr clearcoat and its roughness, aniso; map_* in their place where they vary. Kd and Ks
// are for readers that know no others. Values are those fitted to glTF's reflectance, which is what readers of these keys shade with.
#include "solver/export_format.h"
#include "solver/take/atomic_file.h"

#include <errno.h>
#include <locale.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

static void write_geometry(FILE *f, const struct mesh *m, bool with_material)
{
    if (with_material)
        fputs("mtllib model.mtl\n", f);
    fputs("o model\n", f);
    for (int i = 0; i < m->n_vertices; i++) {
        const float *p = m->position_m[i], *t = m->uv[i], *n = m->normal[i];
        fprintf(f, "v %.9g %.9g %.9g\nvt %.9g %.9g\nvn %.9g %.9g %.9g\n", (double)p[0], (double)p[1], (double)p[2], (double)t[0],
                (double)t[1], (double)n[0], (double)n[1], (double)n[2]);
    }
    if (with_material)
        fputs("usemtl studiorig\n", f);
    for (int i = 0; i < m->n_triangles; i++) {
        const uint32_t a = m->triangle[i][0] + 1, b = m->triangle[i][1] + 1, c = m->triangle[i][2] + 1;
        fprintf(f, "f %u/%u/%u %u/%u/%u %u/%u/%u\n", a, a, a, b, b, b, c, c, c);
    }
}

// One value of a picture as a grey PNG.
static int write_plane(struct export_job *job, int which, int channel, const char *name)
{
    const size_t n = (size_t)job->size * (size_t)job->size;
    uint8_t *plane = malloc(n);
    char *path = export_path(job, name);
    int err = plane && path ? 0 : -ENOMEM;
    for (size_t i = 0; !err && i < n; i++)
        plane[i] = job->picture[which].pixels[i][channel];
    if (!err)
        err = image_write_png(path, job->size, job->size, 1, plane);
    free(plane);
    free(path);
    return err ? err : export_wrote(job, name);
}

static int write_base(struct export_job *job)
{
    char *path = export_path(job, "model_base.png");
    const int err = path ? image_write_png(path, job->size, job->size, 3, job->picture[PICTURE_BASE].pixels[0]) : -ENOMEM;
    free(path);
    return err ? err : export_wrote(job, "model_base.png");
}

static const struct key {
    const char *value, *map, *file;
    int which, channel;
} keys[] = {
    { "Pr", "map_Pr", "model_roughness.png", PICTURE_METALLIC_ROUGHNESS, 1 },
    { "Pm", "map_Pm", "model_metallic.png", PICTURE_METALLIC_ROUGHNESS, 2 },
    { "Ps", "map_Ps", "model_sheen.png", PICTURE_SHEEN, 1 },
    { "Pc", "map_Pc", "model_clearcoat.png", PICTURE_COAT, 0 },
    { "Pcr", "map_Pcr", "model_clearcoat_roughness.png", PICTURE_COAT, 1 },
    { "aniso", "map_aniso", "model_anisotropy.png", PICTURE_ANISOTROPY, 2 },
};
enum { N_KEYS = sizeof(keys) / sizeof(keys[0]) };

static void write_material(FILE *f, const struct export_job *job)
{
    const struct export_picture *base = &job->picture[PICTURE_BASE], *specular = &job->picture[PICTURE_SPECULAR];
    fputs("# linear values; model_base.png carries the sRGB curve, the other pictures none\nnewmtl studiorig\nillum 2\n", f);
    fprintf(f, "Kd %.6f %.6f %.6f\n", base->constant ? base->value[0] : 1, base->constant ? base->value[1] : 1,
            base->constant ? base->value[2] : 1);
    if (!base->constant)
        fputs("map_Kd model_base.png\n", f);
    fprintf(f, "Ks %.6f %.6f %.6f\n", .04 * job->specular_factor * specular->value[0], .04 * job->specular_factor * specular->value[1],
            .04 * job->specular_factor * specular->value[2]);
    for (int i = 0; i < N_KEYS; i++) {
        const struct export_picture *p = &job->picture[keys[i].which];
        const bool constant = p->channel_constant[keys[i].channel];
        fprintf(f, "%s %.6f\n", keys[i].value, constant ? p->value[keys[i].channel] : 1);
        if (!constant)
            fprintf(f, "%s %s\n", keys[i].map, keys[i].file);
    }
}

static int write_text(struct export_job *job, const char *name, bool geometry, bool with_material)
{
    struct atomic_file f;
    char *path = export_path(job, name);
    int err = path ? atomic_file_open(&f, path) : -ENOMEM;
    free(path);
    if (err)
        return err;
    const locale_t c_locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    if (!c_locale) {
        atomic_file_abandon(&f);
        return -ENOMEM;
    }
    const locale_t before = uselocale(c_locale); // a decimal point, whatever the user's language
    if (geometry)
        write_geometry(f.stream, job->source->mesh, with_material);
    else
        write_material(f.stream, job);
    uselocale(before);
    freelocale(c_locale);
    err = atomic_file_commit(&f);
    return err ? err : export_wrote(job, name);
}

int export_obj(struct export_job *job, bool with_material)
{
    int err = write_text(job, "model.obj", true, with_material);
    if (err || !with_material)
        return err;
    if (!job->picture[PICTURE_BASE].constant)
        err = write_base(job);
    for (int i = 0; !err && i < N_KEYS; i++)
        if (!job->picture[keys[i].which].channel_constant[keys[i].channel])
            err = write_plane(job, keys[i].which, keys[i].channel, keys[i].file);
    return err ? err : write_text(job, "model.mtl", false, false);
}
