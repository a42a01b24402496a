// tests/judgement.h - how far a solve is from the truth of its take.
//
// The solve: SOLVE_DIR/lights.json, report.json and, where there are any, albedo.exr,
// validity.exr, brdf.exr. The truth, which no solver may read: TAKE/truth/ of a synthetic studio
// (synth.h) or of a path-traced one. Both say where light comes from as rectangles that shine on
// one side (panels.json, of synth: with the walls; else "panels" of lights.json), so one ray
// answers for both how far what emits in a direction really is. That takes nothing from the true
// lights of a synthetic studio: its truth/ judged as a solve must give zeros.
//
// A light stands for the pixels of its region: its true distance is 1 / mean(1/r) over their true
// rays, weighted by luminance x solid angle; of a light without a region, that of the ray R* dh.
// Light that comes from no rectangle, or from behind one, has no true distance: a light with less
// than half of its energy from rectangles is counted as off the panels and left out. Where
// the report has n_sub_lights > 1, neighbours of one group are one light of all their regions: what
// a solver splits is judged as what it did not split.
#pragma once
#include "solver/disney.h"
#include "solver/lights.h"
#include "solver/mesh.h"
#include "solver/take/image.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/take.h"
#include "solver/texels.h"
#include "solver/vec3.h"

#include <errno.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

// NAN: not known, or does not apply. An error is infinite where a light is directional and its
// emitter is not.
struct judgement {
    char method[32];
    int trusted;                                                         // -1: not said
    double rmse_fit_percent, rmse_held_out_percent, wall_s, n_jacobians; // as the report says
    // Over the lights with energy that come from a panel; "weighted": by their luminance.
    int n_lights, n_off_panels, n_directional;
    double distance_percent, distance_median_percent;
    double distance_weighted_percent, distance_weighted_median_percent;
    double position_cm, position_weighted_cm; // |c + r R dh - (c* + r* R* dh)|
    double centre_cm, rotation_deg;
    double theta[DISNEY_N], theta_std[DISNEY_N]; // the report's; without: means of brdf.exr
    double theta_true[DISNEY_N];                 // means over the covered texels
    double theta_error[DISNEY_N];                // |theta - theta_true|
    bool theta_uniform;                          // all texels of the truth are equal
    // sqrt(sum |a - a*|^2 / sum |a*|^2) over the texels that the solve calls valid; "scaled": of k
    // a, with the one k that fits best.
    int n_texels, n_covered_texels;
    double albedo_percent, albedo_scaled_percent, albedo_scale;
};

enum { JUDGE_PANELS_MAX = 64 };

struct judge_panel {
    double corner[3], edge[2][3], normal[3];
};

struct judge_truth {
    double centre_m[3], world_from_probe[9];
    bool directional; // lights at infinity: no distance is right
    int n_panels;
    struct judge_panel panel[JUDGE_PANELS_MAX];
};

static inline int judge_path(char path[PATH_MAX], const char *dir, const char *name)
{
    if (snprintf(path, PATH_MAX, "%s/%s", dir, name) < PATH_MAX)
        return 0;
    log_error("judge: the path %s/%s is too long", dir, name);
    return -ENAMETOOLONG;
}

// Also the path, for reading. False: not there.
static inline bool judge_has(char path[PATH_MAX], const char *dir, const char *name)
{
    return !judge_path(path, dir, name) && !access(path, F_OK);
}

static inline double judge_number(const struct json *v, const char *key)
{
    double value;
    return v && !json_get_number(v, key, &value) ? value : NAN;
}

// ---- what really shines -------------------------------------------------------------------------

static inline int judge_read_panel(struct judge_panel *p, const struct json *doc, int i,
                                   const char *file)
{
    char key[64];
    double corner[12];
    snprintf(key, sizeof(key), "panels.%d.corners", i);
    int err = json_require_numbers(doc, key, corner, 12, file);
    snprintf(key, sizeof(key), "panels.%d.normal", i);
    if (!err)
        err = json_require_numbers(doc, key, p->normal, 3, file);
    if (err)
        return err;
    memcpy(p->corner, corner, sizeof(p->corner));
    vec3_sub(p->edge[0], corner + 3, corner);
    vec3_sub(p->edge[1], corner + 9, corner);
    return 0;
}

static inline int judge_read_truth(struct judge_truth *t, const char *take)
{
    char path[PATH_MAX];
    struct json *doc = NULL;
    memset(t, 0, sizeof(*t));
    int err = judge_path(path, take, "truth/probe.json");
    if (!err)
        err = json_read(&doc, path);
    if (!err)
        err = json_require_numbers(doc, "centre_m", t->centre_m, 3, path);
    if (!err)
        err = json_require_numbers(doc, "world_from_probe", t->world_from_probe, 9, path);
    json_free(doc), doc = NULL;
    if (!err && judge_has(path, take, "truth/report.json")) {
        err = json_read(&doc, path);
        if (!err)
            json_get_bool(doc, "directional", &t->directional);
        json_free(doc), doc = NULL;
    }
    if (!err && !judge_has(path, take, "truth/panels.json"))
        err = judge_path(path, take, "truth/lights.json");
    if (!err)
        err = json_read(&doc, path);
    if (!err) {
        t->n_panels = json_length(doc, "panels");
        if (t->n_panels < 1 || t->n_panels > JUDGE_PANELS_MAX) {
            log_error("judge: %s: panels: expected a list of 1 to %d", path, JUDGE_PANELS_MAX);
            err = -EINVAL;
        }
    }
    for (int i = 0; !err && i < t->n_panels; i++)
        err = judge_read_panel(&t->panel[i], doc, i, path);
    json_free(doc);
    return err;
}

// 1 / distance from the true centre to what the ray meets first; 0: nothing, or a panel's dark
// side.
static inline double judge_true_inverse_distance(const struct judge_truth *t,
                                                 const double dir_probe[3])
{
    static const double slack = 1e-9; // where rectangles share an edge
    double dir[3], nearest_m = INFINITY;
    bool front = false;
    mat3_mul_vec(dir, t->world_from_probe, dir_probe);
    for (int i = 0; i < t->n_panels; i++) {
        const struct judge_panel *p = &t->panel[i];
        double off[3];
        const double facing = vec3_dot(p->normal, dir);
        vec3_sub(off, p->corner, t->centre_m);
        const double r_m = vec3_dot(off, p->normal) / facing;
        if (facing == 0 || !(r_m > 0) || r_m >= nearest_m)
            continue;
        double at[3] = {-off[0], -off[1], -off[2]};
        vec3_add_scaled(at, at, r_m, dir);
        bool inside = true;
        for (int k = 0; k < 2; k++) {
            const double x = vec3_dot(at, p->edge[k]) / vec3_dot(p->edge[k], p->edge[k]);
            inside = inside && x >= -slack && x <= 1 + slack;
        }
        if (inside)
            nearest_m = r_m, front = facing < 0;
    }
    return front ? 1 / nearest_m : 0;
}

static inline double judge_luminance(double r, double g, double b)
{
    return .2126 * r + .7152 * g + .0722 * b;
}

struct judge_seen { // energy that reaches the true centre, that part of it from panels, and 1/r* x
                    // that
    double all, met, sum;
};

static inline void judge_add_ray(struct judge_seen *seen, const struct judge_truth *t,
                                 const double dir_probe[3], double energy)
{
    const double q = judge_true_inverse_distance(t, dir_probe);
    seen->all += energy;
    seen->met += q > 0 ? energy : 0;
    seen->sum += q * energy;
}

static inline double judge_light_luminance(const struct lights *l, int i)
{
    return judge_luminance(l->irradiance[i][0], l->irradiance[i][1], l->irradiance[i][2]);
}

static inline void judge_add_light(struct judge_seen *seen, const struct judge_truth *t,
                                   const struct panorama *p, const struct lights *l, int i)
{
    const int width = p->image.width, height = p->image.height;
    struct light_region r = l->region ? l->region[i] : (struct light_region){0};
    const double before = seen->all;
    if (l->region) { // it may have been cut from a copy of another size
        r.x0 = (int)((int64_t)r.x0 * width / l->panorama_width_px);
        r.x1 = (int)((int64_t)r.x1 * width / l->panorama_width_px);
        r.y0 = (int)((int64_t)r.y0 * height / l->panorama_height_px);
        r.y1 = (int)((int64_t)r.y1 * height / l->panorama_height_px);
    }
    for (int y = r.y0; y < r.y1; y++) {
        const double omega = panorama_solid_angle(width, height, y);
        for (int x = r.x0; x < r.x1; x++) {
            const float *rgb = p->image.data + 3 * ((int64_t)y * width + x);
            const double energy = omega * judge_luminance(rgb[0], rgb[1], rgb[2]);
            double dir[3];
            if (energy <= 0)
                continue;
            panorama_direction(width, height, x + .5, y + .5, dir);
            judge_add_ray(seen, t, dir, energy);
        }
    }
    if (seen->all <= before)
        judge_add_ray(seen, t, l->dir_probe[i], judge_light_luminance(l, i));
}

// ---- lights -------------------------------------------------------------------------------------

struct judge_weighted {
    double value, weight;
};

static inline int judge_by_value(const void *a, const void *b)
{
    const struct judge_weighted *x = a, *y = b;
    return (x->value > y->value) - (x->value < y->value);
}

// The value at which half of the weight is reached; plain: all weights 1. Of v, sorted.
static inline double judge_median(const struct judge_weighted *v, int n, bool plain)
{
    double total = 0, before = 0;
    for (int i = 0; i < n; i++)
        total += plain ? 1 : v[i].weight;
    for (int i = 0; i < n; i++) {
        before += plain ? 1 : v[i].weight;
        if (before >= .5 * total)
            return v[i].value;
    }
    return NAN;
}

static inline int judge_lights(struct judgement *out, const struct judge_truth *t,
                               const struct panorama *p, const struct lights *l, int n_sub)
{
    struct judge_weighted *error = calloc((size_t)l->n, sizeof(*error));
    double sum = 0, sum_weighted = 0, away = 0, away_weighted = 0, weights = 0;
    int n = 0;
    if (!error)
        return -ENOMEM;
    for (int i = 0, end; i < l->n; i = end) {
        struct judge_seen seen = {0};
        double weight = 0, q = 0, dir[3] = {0}, here[3], there[3], off[3];
        for (end = i + 1; n_sub > 1 && end < l->n && l->group[i] >= 0 && l->group[end] == l->group[i];)
            end++;
        for (int k = i; k < end; k++) {
            const double luminance = judge_light_luminance(l, k);
            if (luminance <= 0)
                continue;
            weight += luminance;
            q += luminance * l->inverse_distance[k];
            vec3_add_scaled(dir, dir, luminance, l->dir_probe[k]);
            judge_add_light(&seen, t, p, l, k);
        }
        if (weight <= 0)
            continue;
        if (seen.met < .5 * seen.all) {
            out->n_off_panels++;
            continue;
        }
        q /= weight;
        const double q_true = seen.sum / seen.met, relative = fabs(1 / q - 1 / q_true) * q_true;
        if (n_sub > 1)
            vec3_normalise(dir);
        else
            memcpy(dir, l->dir_probe[i], sizeof(dir));
        mat3_mul_vec(here, l->world_from_probe, dir);
        mat3_mul_vec(there, t->world_from_probe, dir);
        vec3_add_scaled(here, l->centre_m, 1 / q, here);
        vec3_add_scaled(there, t->centre_m, 1 / q_true, there);
        vec3_sub(off, here, there);
        const double off_m = q > 0 ? vec3_norm(off) : INFINITY;
        out->n_directional += q <= 0;
        sum += relative, sum_weighted += weight * relative;
        away += off_m, away_weighted += weight * off_m, weights += weight;
        error[n++] = (struct judge_weighted){relative, weight};
    }
    out->n_lights = n;
    if (n) {
        qsort(error, (size_t)n, sizeof(*error), judge_by_value);
        out->distance_percent = 100 * sum / n;
        out->distance_weighted_percent = 100 * sum_weighted / weights;
        out->distance_median_percent = 100 * judge_median(error, n, true);
        out->distance_weighted_median_percent = 100 * judge_median(error, n, false);
        out->position_cm = 100 * away / n;
        out->position_weighted_cm = 100 * away_weighted / weights;
    }
    free(error);
    return 0;
}

// Of a b^T, in radians; exact for small angles: |a - b|^2 = 8 sin^2(angle / 2).
static inline double judge_angle_between(const double a[9], const double b[9])
{
    double sum = 0;
    for (int k = 0; k < 9; k++)
        sum += (a[k] - b[k]) * (a[k] - b[k]);
    return 2 * asin(fmin(sqrt(sum / 8), 1));
}

// lights.json and report.json say the set-up twice.
static inline void judge_check_report(const struct json *report, const struct lights *l,
                                      const char *dir)
{
    double c[3], world_from_probe[9], off[3];
    if (json_get_numbers(report, "centre_m", c, 3) ||
        json_get_numbers(report, "world_from_probe", world_from_probe, 9))
        return;
    vec3_sub(off, c, l->centre_m);
    const double angle_rad = judge_angle_between(world_from_probe, l->world_from_probe);
    if (vec3_norm(off) > 1e-4 || angle_rad > 1e-4)
        log_warning("judge: %s: report.json and lights.json disagree by %.4g cm and %.4g degrees "
                    "about the probe; lights.json is judged",
                    dir, 100 * vec3_norm(off), angle_rad * 180 / M_PI);
}

static inline int judge_set_up(struct judgement *out, const struct judge_truth *t,
                               const struct json *report, const struct panorama *p,
                               const char *solve)
{
    char path[PATH_MAX];
    struct lights l;
    int err = judge_path(path, solve, "lights.json");
    if (!err)
        err = lights_read_json(&l, path);
    if (err)
        return err;
    bool placed = false;
    for (int i = 0; i < l.n; i++)
        placed = placed || l.inverse_distance[i] > 0;
    out->rotation_deg = judge_angle_between(l.world_from_probe, t->world_from_probe) * 180 / M_PI;
    if (placed) { // else the file does not know a centre
        double off[3];
        vec3_sub(off, l.centre_m, t->centre_m);
        out->centre_cm = 100 * vec3_norm(off);
        judge_check_report(report, &l, solve);
    }
    int64_t n_sub = 1;
    json_get_int(report, "n_sub_lights", &n_sub);
    if (n_sub < 1 || n_sub > l.n) {
        log_error("judge: %s: report.json: n_sub_lights is %lld, of %d lights", solve,
                  (long long)n_sub, l.n);
        err = -EINVAL;
    }
    if (!err && !t->directional)
        err = judge_lights(out, t, p, &l, (int)n_sub);
    lights_free(&l);
    return err;
}

// ---- material -----------------------------------------------------------------------------------

static inline int judge_read_texture(struct image *out, const char *path)
{
    const int err = image_read(out, path);
    if (err)
        return err;
    if (out->width == out->height)
        return 0;
    log_error("judge: %s: %d x %d px: a texture is square", path, out->width, out->height);
    image_free(out);
    return -EINVAL;
}

// Means of the ten textures, by channel name, over the covered texels; what is not there stays.
static inline int judge_theta_means(double theta[DISNEY_N], bool *uniform,
                                    const char *const names[DISNEY_N], const struct mesh *mesh,
                                    const char *path)
{
    struct image image;
    struct texels texels;
    int err = judge_read_texture(&image, path);
    if (err)
        return err;
    err = texels_rasterise(&texels, mesh, image.width);
    for (int k = 0; !err && k < DISNEY_N; k++) {
        const int channel = names[k] ? image_channel(&image, names[k]) : -1;
        double sum = 0, low = INFINITY, high = -INFINITY;
        for (int i = 0; channel >= 0 && i < texels.n; i++) {
            const double v =
                image.data[(size_t)texels.pixel[i] * (size_t)image.n_channels + (size_t)channel];
            sum += v, low = fmin(low, v), high = fmax(high, v);
        }
        if (channel < 0)
            continue;
        theta[k] = sum / texels.n;
        *uniform = *uniform && high - low <= 1e-6;
    }
    if (!err)
        texels_free(&texels);
    image_free(&image);
    return err;
}

static inline int judge_theta(struct judgement *out, const struct json *report,
                              const struct mesh *mesh, const char *solve, const char *take)
{
    static const char *const cycles_names[DISNEY_N] = {
        [DISNEY_ROUGHNESS] = "R", [DISNEY_METALLIC] = "G", [DISNEY_SPECULAR] = "B"};
    char path[PATH_MAX], key[64];
    struct json *material = NULL;
    bool ignored = true;
    int err = 0;
    out->theta_uniform = true;
    if (judge_has(path, take, "truth/brdf.exr")) {
        err = judge_theta_means(out->theta_true, &out->theta_uniform, disney_parameter_names, mesh,
                                path);
    } else if (judge_has(path, take, "truth/rough_metal_spec.exr")) {
        err = judge_theta_means(out->theta_true, &out->theta_uniform, cycles_names, mesh, path);
        if (!err && judge_has(path, take, "truth/material.json"))
            err = json_read(&material, path);
        for (int k = 0; material && k < DISNEY_N; k++) {
            snprintf(key, sizeof(key), "constant.%s", disney_parameter_names[k]);
            json_get_number(material, key, &out->theta_true[k]);
        }
        json_free(material);
    }
    if (!err && !json_get(report, "theta") && judge_has(path, solve, "brdf.exr"))
        err = judge_theta_means(out->theta, &ignored, disney_parameter_names, mesh, path);
    for (int k = 0; k < DISNEY_N; k++) {
        snprintf(key, sizeof(key), "theta.%s", disney_parameter_names[k]);
        json_get_number(report, key, &out->theta[k]);
        snprintf(key, sizeof(key), "theta_std.%s", disney_parameter_names[k]);
        json_get_number(report, key, &out->theta_std[k]);
        out->theta_error[k] = fabs(out->theta[k] - out->theta_true[k]);
    }
    return err;
}

// The truth over one texel of the solve: its mean where the truth is finer.
static inline void judge_true_albedo(const struct image *truth, int size, uint32_t pixel,
                                     double albedo[3])
{
    const int n = truth->width > size ? (truth->width + size / 2) / size : 1;
    const double step = (double)truth->width / size;
    const double x = pixel % (uint32_t)size, y = pixel / (uint32_t)size;
    albedo[0] = albedo[1] = albedo[2] = 0;
    for (int j = 0; j < n * n; j++) {
        float rgb[IMAGE_MAX_CHANNELS];
        image_bilinear(truth, (x + (j % n + .5) / n) * step, (y + (j / n + .5) / n) * step, rgb);
        for (int c = 0; c < 3; c++)
            albedo[c] += rgb[c] / (double)(n * n);
    }
}

static inline int judge_compare_albedo(struct judgement *out, const struct image *a,
                                       const struct image *truth, const struct image *validity,
                                       const struct mesh *mesh)
{
    struct texels texels;
    double aa = 0, at = 0, tt = 0, off = 0;
    const int err = texels_rasterise(&texels, mesh, a->width);
    if (err)
        return err;
    for (int i = 0; i < texels.n; i++) {
        const size_t pixel = texels.pixel[i];
        const float *rgb = a->data + pixel * (size_t)a->n_channels;
        double expected[3];
        if (validity->data && !(validity->data[pixel * (size_t)validity->n_channels] > 0))
            continue;
        judge_true_albedo(truth, a->width, texels.pixel[i], expected);
        for (int c = 0; c < 3; c++) {
            aa += (double)rgb[c] * rgb[c], at += rgb[c] * expected[c];
            tt += expected[c] * expected[c];
            off += (rgb[c] - expected[c]) * (rgb[c] - expected[c]);
        }
        out->n_texels++;
    }
    out->n_covered_texels = texels.n;
    texels_free(&texels);
    if (!(tt > 0 && aa > 0))
        return 0;
    out->albedo_percent = 100 * sqrt(off / tt);
    out->albedo_scale = at / aa;
    out->albedo_scaled_percent = 100 * sqrt(fmax(1 - at * at / (aa * tt), 0));
    return 0;
}

// validity.exr (first channel > 0: measured) says which texels count; without it all do.
static inline int judge_albedo(struct judgement *out, const struct mesh *mesh, const char *solve,
                               const char *take)
{
    static const char *const rgb[] = {"R", "G", "B", NULL};
    char path[PATH_MAX], truth_path[PATH_MAX];
    struct image a = {0}, truth = {0}, validity = {0};
    if (!judge_has(truth_path, take, "truth/albedo.exr") &&
        !judge_has(truth_path, take, "truth/basecolor.exr"))
        return 0;
    if (!judge_has(path, solve, "albedo.exr"))
        return 0;
    int err = judge_read_texture(&a, path);
    if (!err)
        err = image_require_finite(&a, rgb, path);
    if (!err)
        err = judge_read_texture(&truth, truth_path);
    if (!err && (image_channel(&a, "R") || image_channel(&truth, "R") || a.n_channels < 3 ||
                 truth.n_channels < 3)) {
        log_error("judge: %s, %s: expected channels R, G, B", path, truth_path);
        err = -EINVAL;
    }
    if (!err && judge_has(path, solve, "validity.exr")) {
        err = judge_read_texture(&validity, path);
        if (!err && validity.width != a.width) {
            log_error("judge: %s: %d px a side, albedo.exr has %d", path, validity.width, a.width);
            err = -EINVAL;
        }
    }
    if (!err)
        err = judge_compare_albedo(out, &a, &truth, &validity, mesh);
    image_free(&a), image_free(&truth), image_free(&validity);
    return err;
}

// ---- all of it ----------------------------------------------------------------------------------

static inline void judge_clear(struct judgement *out)
{
    *out = (struct judgement){.trusted = -1,
                              .distance_percent = NAN,
                              .distance_median_percent = NAN,
                              .distance_weighted_percent = NAN,
                              .distance_weighted_median_percent = NAN,
                              .position_cm = NAN,
                              .position_weighted_cm = NAN,
                              .centre_cm = NAN,
                              .rotation_deg = NAN,
                              .albedo_percent = NAN,
                              .albedo_scaled_percent = NAN,
                              .albedo_scale = NAN};
    for (int k = 0; k < DISNEY_N; k++)
        out->theta[k] = out->theta_std[k] = out->theta_true[k] = out->theta_error[k] = NAN;
}

static inline void judge_read_report(struct judgement *out, const struct json *report)
{
    const char *method = "?";
    bool trusted;
    json_get_string(report, "method", &method);
    snprintf(out->method, sizeof(out->method), "%s", method);
    if (!json_get_bool(report, "trusted", &trusted))
        out->trusted = trusted;
    out->rmse_fit_percent = judge_number(report, "rmse_fit_percent");
    out->rmse_held_out_percent = judge_number(report, "rmse_held_out_percent");
    out->wall_s = judge_number(report, "wall_s");
    out->n_jacobians = judge_number(report, "n_jacobians");
}

// 0, or the first error (logged).
static inline int judge_solve(struct judgement *out, const char *solve, const char *take_dir)
{
    char path[PATH_MAX];
    struct take *take = NULL;
    struct judge_truth truth;
    struct json *report = NULL;
    struct panorama panorama = {0};
    struct mesh mesh = {0};
    judge_clear(out);
    int err = take_open(&take, take_dir);
    if (!err)
        err = take_require(take, TAKE_MESH | TAKE_PANORAMA);
    if (!err)
        err = judge_read_truth(&truth, take_dir);
    if (!err)
        err = judge_path(path, solve, "report.json");
    if (!err)
        err = json_read(&report, path);
    if (!err)
        err = panorama_read(&panorama, take->panorama_path);
    if (!err)
        err = mesh_read(&mesh, NULL, take->mesh_path);
    if (!err)
        judge_read_report(out, report);
    if (!err)
        err = judge_set_up(out, &truth, report, &panorama, solve);
    if (!err)
        err = judge_theta(out, report, &mesh, solve, take_dir);
    if (!err)
        err = judge_albedo(out, &mesh, solve, take_dir);
    mesh_free(&mesh), panorama_free(&panorama);
    json_free(report), take_close(take);
    return err;
}
