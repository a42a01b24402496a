// solver/cameras_frame.c - cameras and mesh in one frame, or a refusal that says what is wrong.
#include "solver/cameras_frame.h"
#include "solver/take/image.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_VERTICES = 1000, MAX_VIEWS = 100, N_TURNS = 3, N_MIRRORS = 3, N_POINTS = 500, MAX_PICTURES = 8 };

// In order: as it is; turns (a rotation: may be applied); mirrors; scales.
static const struct cameras_trial all_trials[CAMERAS_N_TRIALS] = {
    { .name = "as it is", .mesh = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } },
    { .name = "(x, z, -y)", .mesh = { 1, 0, 0, 0, 0, 1, 0, -1, 0 } },
    { .name = "(x, -z, y)", .mesh = { 1, 0, 0, 0, 0, -1, 0, 1, 0 } },
    { .name = "(x, -y, -z)", .mesh = { 1, 0, 0, 0, -1, 0, 0, 0, -1 } },
    { .name = "mirrored (-x, y, z)", .mesh = { -1, 0, 0, 0, 1, 0, 0, 0, 1 } },
    { .name = "mirrored (x, -y, z)", .mesh = { 1, 0, 0, 0, -1, 0, 0, 0, 1 } },
    { .name = "mirrored (x, y, -z)", .mesh = { 1, 0, 0, 0, 1, 0, 0, 0, -1 } },
    { .name = "1000 x larger", .mesh = { 1000, 0, 0, 0, 1000, 0, 0, 0, 1000 } },
    { .name = "100 x larger", .mesh = { 100, 0, 0, 0, 100, 0, 0, 0, 100 } },
    { .name = "10 x larger", .mesh = { 10, 0, 0, 0, 10, 0, 0, 0, 10 } },
    { .name = "39.37 x smaller (inches)", .mesh = { .0254, 0, 0, 0, .0254, 0, 0, 0, .0254 } },
    { .name = "10 x smaller", .mesh = { .1, 0, 0, 0, .1, 0, 0, 0, .1 } },
    { .name = "100 x smaller", .mesh = { .01, 0, 0, 0, .01, 0, 0, 0, .01 } },
    { .name = "1000 x smaller", .mesh = { .001, 0, 0, 0, .001, 0, 0, 0, .001 } },
};

static int compare_doubles(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return x < y ? -1 : x > y;
}

static void run_trial(struct cameras_trial *trial, const struct cameras *c, const struct mesh *mesh)
{
    const int vertex_step = (mesh->n_vertices + MAX_VERTICES - 1) / MAX_VERTICES, view_step = (c->n + MAX_VIEWS - 1) / MAX_VIEWS;
    double spans[MAX_VIEWS];
    int n_views = 0;
    int64_t n_pairs = 0, n_hits = 0;
    for (int v = 0; v < c->n; v += view_step) {
        const struct camera *camera = &c->view[v];
        double low[2] = { INFINITY, INFINITY }, high[2] = { -INFINITY, -INFINITY };
        for (int i = 0; i < mesh->n_vertices; i += vertex_step, n_pairs++) {
            const double at[3] = { mesh->position_m[i][0], mesh->position_m[i][1], mesh->position_m[i][2] };
            double p[3], uv[2];
            mat3_mul_vec(p, trial->mesh, at);
            if (!camera_project(camera, p, uv, NULL) || !(uv[0] >= 0 && uv[0] <= camera->width_px) ||
                !(uv[1] >= 0 && uv[1] <= camera->height_px))
                continue;
            n_hits++;
            for (int k = 0; k < 2; k++)
                low[k] = fmin(low[k], uv[k]), high[k] = fmax(high[k], uv[k]);
        }
        spans[n_views++] = high[0] >= low[0]
                               ? hypot(high[0] - low[0], high[1] - low[1]) / hypot(camera->width_px, camera->height_px)
                               : 0;
    }
    qsort(spans, (size_t)n_views, sizeof(*spans), compare_doubles);
    trial->hit_rate = n_pairs ? (double)n_hits / (double)n_pairs : 0;
    trial->span = n_views ? spans[n_views / 2] : 0;
}

void cameras_try_frames(struct cameras_trial trials[CAMERAS_N_TRIALS], const struct cameras *c, const struct mesh *mesh)
{
    memcpy(trials, all_trials, sizeof(all_trials));
    for (int i = 0; i < CAMERAS_N_TRIALS; i++)
        run_trial(&trials[i], c, mesh);
}

// A mesh shrunk to a dot is in every picture: what spans less than a tenth of one counts for less.
static double score_of(const struct cameras_trial *t)
{
    return t->hit_rate * fmin(1, t->span / .1);
}

// Close-ups show a small part of the mesh each; that is still far from nothing.
static bool is_plausible(const struct cameras_trial *t)
{
    return t->hit_rate >= .05 && t->span >= .02;
}

static int refuse(const struct cameras_trial *trials, int best, const char *path, const char *mesh_path)
{
    char rates[CAMERAS_N_TRIALS * 64], verdict[256];
    int n = 0;
    for (int i = 0; i < CAMERAS_N_TRIALS; i++)
        n += snprintf(rates + n, sizeof(rates) - (size_t)n, "%s%s %.1f%%", i ? ", " : "", trials[i].name, 100 * trials[i].hit_rate);
    if (score_of(&trials[best]) < .5)
        snprintf(verdict, sizeof(verdict), "no turn, mirroring or unit helps: they are of different scenes or origins; export both from "
                 "one project in one coordinate system");
    else if (best <= N_TURNS)
        snprintf(verdict, sizeof(verdict), "its axes differ: export it with the cameras' axes");
    else if (best <= N_TURNS + N_MIRRORS)
        snprintf(verdict, sizeof(verdict), "the mesh is mirrored: export it without any flip of axes or handedness");
    else
        snprintf(verdict, sizeof(verdict), "the mesh is in another unit: it should be %s", trials[best].name);
    log_error("cameras: %s does not see %s: %s. Share of its vertices in the pictures when the mesh is: %s; spanning %.3g%% of a "
              "picture as it is", path, mesh_path, verdict, rates, 100 * trials[0].span);
    return -EDOM;
}

// Cameras that saw the turned mesh, as they stand around the mesh itself. turn: a rotation.
static void turn_cameras(struct cameras *c, const double turn[9])
{
    for (int i = 0; i < c->n; i++) {
        struct camera *v = &c->view[i];
        mat3_mul(v->cam_from_world, v->cam_from_world, turn);
        mat3_tmul_vec(v->centre_m, turn, v->centre_m);
    }
}

static int fit(struct cameras *c, const struct mesh *mesh, const char *path, const char *mesh_path)
{
    struct cameras_trial trials[CAMERAS_N_TRIALS];
    run_trial(memcpy(&trials[0], &all_trials[0], sizeof(trials[0])), c, mesh);
    if (score_of(&trials[0]) >= .5) // no trial could be three times as good
        return 0;
    cameras_try_frames(trials, c, mesh);
    int best = 0, second = -1;
    // Where the mesh as it is makes sense, only another place, not another size, is an objection.
    const int n_compared = is_plausible(&trials[0]) ? 1 + N_TURNS + N_MIRRORS : CAMERAS_N_TRIALS;
    for (int i = 1; i < n_compared; i++)
        if (score_of(&trials[i]) > score_of(&trials[best]))
            best = i;
    for (int i = 0; i < 1 + N_TURNS + N_MIRRORS; i++)
        if (i != best && (second < 0 || score_of(&trials[i]) > score_of(&trials[second])))
            second = i;
    const bool is_clear = score_of(&trials[best]) >= .5 && score_of(&trials[best]) >= 3 * score_of(&trials[0]);
    if (is_plausible(&trials[0]) && !is_clear)
        return 0;
    if (!is_clear || best > N_TURNS || score_of(&trials[best]) < 2 * score_of(&trials[second]))
        return refuse(trials, best, path, mesh_path);
    turn_cameras(c, trials[best].mesh);
    log_warning("cameras: %s has other axes than %s: %.1f%% of the mesh's vertices are in the pictures as it is, %.1f%% as %s, %.1f%% as "
                "the next best (%s): the cameras are turned to the mesh's axes", path, mesh_path, 100 * trials[0].hit_rate,
                100 * trials[best].hit_rate, trials[best].name, 100 * trials[second].hit_rate, trials[second].name);
    return 0;
}

static bool same_places(const struct cameras *a, const struct cameras *b)
{
    for (int i = 0; i < a->n; i++)
        if (memcmp(a->view[i].centre_m, b->view[i].centre_m, sizeof(a->view[i].centre_m)) ||
            memcmp(a->view[i].cam_from_world, b->view[i].cam_from_world, sizeof(a->view[i].cam_from_world)))
            return false;
    return true;
}

int cameras_read_for_mesh(struct cameras *out, const char *path, const struct cameras_options *options,
                          const struct mesh *mesh, const char *mesh_path)
{
    struct cameras with = { 0 }, without = { 0 };
    struct cameras_options untransformed = options ? *options : (struct cameras_options){ 0 };
    struct cameras_trial t[2] = { all_trials[0], all_trials[0] };
    bool has_transform = false;
    memset(out, 0, sizeof(*out));
    untransformed.has_transform = &has_transform;
    int err = cameras_read_with(&with, path, &untransformed);
    if (err)
        return err;
    if (has_transform) {
        untransformed.without_transform = true;
        err = cameras_read_with(&without, path, &untransformed);
        if (!err && !same_places(&with, &without)) {
            run_trial(&t[0], &with, mesh);
            run_trial(&t[1], &without, mesh);
            const bool is_better = score_of(&t[1]) > score_of(&t[0]);
            log_info("cameras: %s: taken %s the chunk's transform, which puts %.1f%% of %s into the pictures (%s it: %.1f%%)", path,
                     is_better ? "without" : "with", 100 * t[is_better].hit_rate, mesh_path, is_better ? "with" : "without",
                     100 * t[!is_better].hit_rate);
            if (is_better) {
                const struct cameras better = without;
                without = with, with = better;
            }
        }
        cameras_free(&without);
    }
    if (!err)
        err = fit(&with, mesh, path, mesh_path);
    if (err) {
        cameras_free(&with);
        return err;
    }
    *out = with;
    return 0;
}

// ---- what the pictures say ----------------------------------------------------------------------------------------------

// log brightness of each point in each picture under each trial; NAN: not seen
typedef float brightness[CAMERAS_N_AGREEMENTS][N_POINTS][MAX_PICTURES];

static void look(brightness value, int k, const struct camera *camera, const struct image *image, const struct mesh *mesh,
                 const struct rays *rays)
{
    int rgb[3];
    for (int c = 0; c < 3; c++) {
        static const char *const names[3] = { "R", "G", "B" };
        rgb[c] = image_channel(image, names[c]);
    }
    for (int trial = 0; trial < CAMERAS_N_AGREEMENTS; trial++) {
        const double *turn = all_trials[trial].mesh;
        double eye[3]; // among the mesh as it is
        mat3_tmul_vec(eye, turn, camera->centre_m);
        for (int i = 0; i < N_POINTS; i++) {
            const uint32_t triangle = (uint32_t)((int64_t)i * mesh->n_triangles / N_POINTS);
            static const float third[2] = { 1.f / 3, 1.f / 3 };
            double at[3], p[3], to_eye[3], uv[2], normal[3] = { 0, 0, 0 };
            float start[3], dir[3], channels[IMAGE_MAX_CHANNELS];
            value[trial][i][k] = NAN;
            rays_start(rays, triangle, third, start);
            for (int c = 0; c < 3; c++) {
                at[c] = start[c];
                for (int j = 0; j < 3; j++)
                    normal[c] += mesh->normal[mesh->triangle[triangle][j]][c];
                to_eye[c] = eye[c] - at[c];
                dir[c] = (float)to_eye[c];
            }
            mat3_mul_vec(p, turn, at);
            if (!camera_project(camera, p, uv, NULL) || !(uv[0] >= 0 && uv[0] <= camera->width_px) ||
                !(uv[1] >= 0 && uv[1] <= camera->height_px) || rgb[0] < 0 || rgb[1] < 0 || rgb[2] < 0)
                continue;
            vec3_normalise(normal);
            if (vec3_dot(normal, to_eye) < .4 * vec3_norm(to_eye) || rays_blocked(rays, start, dir, 0, 1))
                continue;
            image_bilinear(image, uv[0], uv[1], channels);
            const float y = .2126f * channels[rgb[0]] + .7152f * channels[rgb[1]] + .0722f * channels[rgb[2]];
            value[trial][i][k] = isfinite(y) ? logf(fmaxf(y, 1e-6f)) : NAN;
        }
    }
}

static double agreement_of(float value[N_POINTS][MAX_PICTURES])
{
    double within = 0, sum = 0, square = 0;
    int n_within = 0, n = 0, n_points = 0;
    for (int i = 0; i < N_POINTS; i++) {
        double mean = 0, deviation = 0;
        int n_seen = 0;
        for (int k = 0; k < MAX_PICTURES; k++)
            if (!isnan(value[i][k]))
                mean += value[i][k], n_seen++;
        if (n_seen < 2)
            continue;
        mean /= n_seen;
        for (int k = 0; k < MAX_PICTURES; k++)
            if (!isnan(value[i][k])) {
                deviation += (value[i][k] - mean) * (value[i][k] - mean);
                sum += value[i][k], square += (double)value[i][k] * value[i][k], n++;
            }
        within += deviation, n_within += n_seen - 1, n_points++;
    }
    const double total = n ? square / n - sum / n * (sum / n) : 0;
    return n_points >= N_POINTS / 5 && total > 1e-4 ? 1 - within / n_within / total : NAN;
}

int cameras_measure_agreement(double agreement[CAMERAS_N_AGREEMENTS], const struct cameras *c, const struct mesh *mesh,
                              const struct rays *rays, char *const *picture)
{
    int n_pictures = 0, n_met = 0, n_looked = 0, err = 0;
    float (*value)[N_POINTS][MAX_PICTURES] = malloc(sizeof(brightness));
    if (!value)
        return -ENOMEM;
    for (int t = 0; t < CAMERAS_N_AGREEMENTS; t++)
        for (int i = 0; i < N_POINTS; i++)
            for (int k = 0; k < MAX_PICTURES; k++)
                value[t][i][k] = NAN;
    for (int v = 0; v < c->n; v++)
        n_pictures += picture[v] != NULL;
    const int n_wanted = n_pictures < MAX_PICTURES ? n_pictures : MAX_PICTURES;
    for (int v = 0; v < c->n && !err; v++) { // evenly spread over those that have one
        if (!picture[v] || (int64_t)n_looked * n_pictures > (int64_t)n_met++ * n_wanted || n_looked == n_wanted)
            continue;
        struct image image;
        struct camera camera = c->view[v];
        err = image_read(&image, picture[v]);
        if (err)
            break;
        camera_resize(&camera, image.width, image.height);
        look(value, n_looked++, &camera, &image, mesh, rays);
        image_free(&image);
    }
    for (int t = 0; t < CAMERAS_N_AGREEMENTS && !err; t++)
        agreement[t] = agreement_of(value[t]);
    free(value);
    return err;
}

int cameras_check_pictures(const struct cameras *c, const struct mesh *mesh, const struct rays *rays, char *const *picture,
                           const char *path, const char *mesh_path)
{
    double agreement[CAMERAS_N_AGREEMENTS];
    const int err = cameras_measure_agreement(agreement, c, mesh, rays, picture);
    if (err)
        return err;
    int best = 0, n = 0;
    char all[CAMERAS_N_AGREEMENTS * 64];
    for (int i = 0; i < CAMERAS_N_AGREEMENTS; i++) {
        if (agreement[i] > agreement[best])
            best = i;
        n += isnan(agreement[i])
                 ? snprintf(all + n, sizeof(all) - (size_t)n, "%s%s unseen", i ? ", " : "", all_trials[i].name)
                 : snprintf(all + n, sizeof(all) - (size_t)n, "%s%s %.2f", i ? ", " : "", all_trials[i].name, agreement[i]);
    }
    log_debug("cameras: agreement of the pictures on %s: %s", mesh_path, all);
    if (agreement[best] > .5 && agreement[best] > agreement[0] + .3)
        log_warning("cameras: the pictures of %s agree about the surface of %s better if it is %s%s: it was %s on export; agreement "
                    "(1: all of them see the same) by what is done to the mesh: %s", path, mesh_path, best > N_TURNS ? "" : "turned to ",
                    all_trials[best].name, best > N_TURNS ? "mirrored" : "turned", all);
    return 0;
}
