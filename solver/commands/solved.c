// solver/commands/solved.c - a solve's folder, loaded.
#include "solver/commands/solved.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

char *solved_path(const char *dir, const char *name)
{
    char *path;
    if (*name == '/')
        return strdup(name);
    return asprintf(&path, "%s/%s", dir, name) < 0 ? NULL : path;
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

static int read_material(struct solved *s, const char *dir)
{
    char *albedo = solved_path(dir, "albedo.exr"), *parameters = solved_path(dir, "brdf.exr");
    int err = albedo && parameters ? read_texture(&s->albedo, albedo) : -ENOMEM;
    if (!err && !access(parameters, F_OK))
        err = read_texture(&s->parameters, parameters);
    free(albedo);
    free(parameters);
    return err;
}

static int read_mesh(struct solved *s, const char *command, const char *dir, const char *mesh_path)
{
    struct mesh_check check;
    const char *name = mesh_path;
    char *path = NULL;
    if (!name) {
        if (!s->report || json_get_string(s->report, "inputs.mesh", &name)) {
            log_error("%s: %s/report.json does not name a mesh (inputs.mesh); give --mesh", command, dir);
            return -ENOENT;
        }
        path = solved_path(dir, name);
        if (!path)
            return -ENOMEM;
        if (access(path, F_OK)) {
            log_error("%s: the mesh that %s/report.json names is not there any more: %s; give --mesh", command, dir, path);
            free(path);
            return -ENOENT;
        }
        name = path;
    }
    const int err = mesh_read(&s->mesh, &check, name);
    if (!err && mesh_path) // of its own mesh, solve has told already
        mesh_check_log(&check, &s->mesh, name);
    free(path);
    return err;
}

int solved_read(struct solved *out, const char *command, const char *dir, const char *mesh_path)
{
    const char *variant;
    memset(out, 0, sizeof(*out));
    char *report = solved_path(dir, "report.json");
    int err = report ? 0 : -ENOMEM;
    if (!err && !access(report, F_OK))
        err = json_read(&out->report, report);
    free(report);
    if (!err)
        err = read_material(out, dir);
    if (!err)
        err = read_mesh(out, command, dir, mesh_path);
    out->variant = DISNEY_2017;
    if (out->report &&
        (!json_get_string(out->report, "disney_variant", &variant) || !json_get_string(out->report, "variant", &variant)) &&
        !strcmp(variant, disney_variant_name(DISNEY_2012)))
        out->variant = DISNEY_2012;
    return err;
}

int solved_read_lights(struct solved *s, const char *dir)
{
    char *path = solved_path(dir, "lights.json");
    if (!path)
        return -ENOMEM;
    const int err = access(path, F_OK) ? -ENOENT : lights_read_json(&s->lights, path);
    free(path);
    return err;
}

void solved_free(struct solved *s)
{
    json_free(s->report);
    mesh_free(&s->mesh);
    image_free(&s->albedo);
    image_free(&s->parameters);
    lights_free(&s->lights);
    memset(s, 0, sizeof(*s));
}
