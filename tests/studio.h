// tests/studio.h - a take in memory as `rigsolve solve` loads it, to be solved many times and judged against its truth.
#pragma once
#include "solver/joint.h"
#include "tests/judgement.h"

struct studio {
    const char *take_dir; // the caller's
    struct mesh mesh;
    struct texels texels;
    struct rays *rays;
    struct cameras cameras;
    struct panorama panorama;
    struct lights lights; // n_lights x n_sub, in the rough set-up: start.json, the middle of the mesh
    struct samples samples;
    int n_lights, n_sub;
    uint8_t *held_out;
};

// The take's true lights in place of those cut from the panorama: only their places are not known.
static inline int studio_true_lights(struct lights *out, const char *take_dir)
{
    char path[PATH_MAX];
    int err = judge_path(path, take_dir, "truth/lights.json");
    if (!err)
        err = lights_read_json(out, path);
    for (int i = 0; !err && i < out->n; i++)
        out->inverse_distance[i] = 0, out->group[i] = -1;
    return err;
}

// n_lights 0: the true ones. Every hold_out-th view is held out; 0: none. Close it even when this fails.
static inline int studio_open(struct studio *s, const char *take_dir, int texture, int n_lights, int n_sub, int hold_out)
{
    struct samples_settings gather = samples_defaults();
    struct take *take = NULL;
    const char **picture = NULL;
    memset(s, 0, sizeof(*s));
    s->take_dir = take_dir, s->n_sub = n_sub;
    int err = take_open(&take, take_dir);
    if (!err)
        err = mesh_read(&s->mesh, NULL, take->mesh_path);
    if (!err)
        err = texels_rasterise(&s->texels, &s->mesh, texture);
    if (!err)
        err = rays_new(&s->rays, &s->mesh);
    if (!err)
        err = cameras_read(&s->cameras, take->cameras_path);
    if (!err)
        err = panorama_read(&s->panorama, take->panorama_path);
    if (!err)
        err = n_lights ? lights_median_cut(&s->lights, &s->panorama, n_lights * n_sub) : studio_true_lights(&s->lights, take_dir);
    if (!err)
        err = lights_read_pose(&s->lights, &(bool){ false }, take->start_path);
    for (int c = 0; !err && c < 3; c++)
        s->lights.centre_m[c] = (s->mesh.bounds_m[0][c] + s->mesh.bounds_m[1][c]) / 2;
    s->n_lights = s->lights.n / n_sub;
    for (int i = 0; n_sub > 1 && i < s->lights.n; i++)
        s->lights.group[i] = i / n_sub;
    if (!err) {
        picture = calloc((size_t)s->cameras.n, sizeof(*picture));
        s->held_out = calloc((size_t)s->cameras.n, 1);
        err = picture && s->held_out ? 0 : -ENOMEM;
    }
    for (int v = 0; !err && v < s->cameras.n; v++) { // both in the order of their names
        err = v < take->n_views && !strcmp(take->view_names[v], s->cameras.view[v].name) ? 0 : -EINVAL;
        picture[v] = err ? NULL : take->view_paths[v];
        s->held_out[v] = hold_out && v % hold_out == hold_out - 1;
    }
    if (!err)
        err = samples_gather(&s->samples, &s->texels, s->rays, &s->cameras, picture, &gather);
    free(picture);
    take_close(take);
    return err;
}

static inline void studio_close(struct studio *s)
{
    samples_free(&s->samples), lights_free(&s->lights), panorama_free(&s->panorama), cameras_free(&s->cameras);
    rays_free(s->rays), texels_free(&s->texels), mesh_free(&s->mesh);
    free(s->held_out);
    memset(s, 0, sizeof(*s));
}

static inline int studio_solve(struct joint_result *out, const struct studio *s, const struct joint_settings *set)
{
    return joint_solve(out, &s->texels, &s->samples, s->rays, &s->lights, s->held_out, set);
}

// Centre, rotation, distances and places of the lights against the truth.
static inline int studio_judge(struct judgement *j, const struct studio *s, const struct joint_result *r)
{
    struct judge_truth truth;
    double off[3];
    struct lights l = s->lights; // their regions; the set-up is the result's
    memcpy(l.centre_m, r->state.lights.centre_m, sizeof(l.centre_m));
    memcpy(l.world_from_probe, r->state.lights.world_from_probe, sizeof(l.world_from_probe));
    l.inverse_distance = r->state.lights.inverse_distance;
    judge_clear(j);
    int err = judge_read_truth(&truth, s->take_dir);
    if (!err)
        err = judge_lights(j, &truth, &s->panorama, &l, s->n_sub);
    if (err)
        return err;
    vec3_sub(off, l.centre_m, truth.centre_m);
    j->centre_cm = 100 * vec3_norm(off);
    j->rotation_deg = judge_angle_between(l.world_from_probe, truth.world_from_probe) * 180 / M_PI;
    j->rmse_fit_percent = r->rmse_fit_percent, j->rmse_held_out_percent = r->rmse_held_out_percent;
    j->n_jacobians = r->n_jacobians;
    return 0;
}
