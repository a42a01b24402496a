// tests/truth.h - read a synthetic studio's truth/ back and set up its renderer, for tests and
// benches.
#pragma once
#include "solver/render.h"
#include "solver/take/json.h"

#include <limits.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

struct truth {
    struct json *report;
    struct mesh mesh;
    struct rays *rays;
    struct lights lights;
    struct cameras cameras;
    struct image albedo, parameters; // no parameters: Lambertian
    struct render_material material;
    struct render_settings settings; // as the report says
};

static inline const char *truth_path(char path[PATH_MAX], const char *dir, const char *name)
{
    return snprintf(path, PATH_MAX, "%s/%s", dir, name) < PATH_MAX ? path : "";
}

static inline void truth_close(struct truth *t)
{
    json_free(t->report);
    mesh_free(&t->mesh), rays_free(t->rays), lights_free(&t->lights), cameras_free(&t->cameras);
    image_free(&t->albedo), image_free(&t->parameters);
    memset(t, 0, sizeof(*t));
}

// take: the folder that holds truth/. 0, or the first error (logged by whom it met).
static inline int truth_open(struct truth *t, const char *take)
{
    char path[PATH_MAX];
    int64_t samples, rays, bounce_rays, bounce_texture, seed;
    bool shadows, nearest;
    memset(t, 0, sizeof(*t));
    int err = json_read(&t->report, truth_path(path, take, "truth/report.json"));
    if (!err)
        err = mesh_read(&t->mesh, NULL, truth_path(path, take, "geometry/mesh.obj"));
    if (!err)
        err = rays_new(&t->rays, &t->mesh);
    if (!err)
        err = lights_read_json(&t->lights, truth_path(path, take, "truth/lights.json"));
    if (!err)
        err = cameras_read(&t->cameras, truth_path(path, take, "geometry/cameras"));
    if (!err)
        err = image_read(&t->albedo, truth_path(path, take, "truth/albedo.exr"));
    if (!err && !access(truth_path(path, take, "truth/brdf.exr"), F_OK))
        err = image_read(&t->parameters, path);
    if (!err && (json_get_int(t->report, "render.samples", &samples) ||
                 json_get_bool(t->report, "render.shadows", &shadows) ||
                 json_get_int(t->report, "render.shadow_rays", &rays) ||
                 json_get_int(t->report, "render.bounce_rays", &bounce_rays) ||
                 json_get_int(t->report, "render.bounce_texture", &bounce_texture) ||
                 json_get_bool(t->report, "render.nearest", &nearest) ||
                 json_get_int(t->report, "render.seed", &seed)))
        err = -1;
    if (err) {
        truth_close(t);
        return err;
    }
    t->settings = (struct render_settings){.samples = (int)samples,
                                           .shadows = shadows,
                                           .shadow_rays = (int)rays,
                                           .bounce_rays = (int)bounce_rays,
                                           .bounce_texture = (int)bounce_texture,
                                           .seed = (uint64_t)seed};
    t->material =
        (struct render_material){.model = t->parameters.data ? REFLECT_DISNEY : REFLECT_LAMBERT,
                                 .albedo = &t->albedo,
                                 .parameters = t->parameters.data ? &t->parameters : NULL,
                                 .nearest = nearest};
    return 0;
}
