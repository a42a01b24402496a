// tests/stability.h - one synthetic take, its input made worse in one way or another, solved in
// process and judged: what tests/test_stability.c and `make stability` are made of.
//
// Only the input is touched; the truth stays. Everything random is named by the seed.
#pragma once
#include "solver/joint.h"
#include "solver/misfit.h"
#include "solver/random.h"
#include "solver/take/half.h"
#include "tests/judgement.h"

#include <time.h>

struct stability_size {
    int n_views, n_lights, n_sub; // n_lights groups of n_sub lights each
    int texture, thin;            // of thin x thin texels one is looked at: small texels, few samples
};

enum { NOTHING_MISSING = -1, STRONGEST_LIGHT_MISSING = 100 }; // else: the bright panel of that number

struct perturbation {
    uint64_t seed;
    enum method method;
    double start_m;                  // of every light; 0: the method's own
    double w_sim;                    // the last; 0: the method's own
    double rotation_deg, centre_m;   // of the start from the truth; axis and direction are random
    double noise;                    // standard deviation of every sample, of white
    double camera_px;                // of every camera's pose, as it moves the picture
    double bumps_mm, roughness_mm;   // of the vertices along their normals: waves of 10 .. 20 cm; each by itself
    double gain;                     // standard deviation of every camera's log exposure
    double clipped;                  // share of the samples, by a longer exposure
    double moved_mm;                 // the object, in half of the views
    int n_views;                     // 0: all of the size's
    int missing;                     // from the panorama
    bool solve_gain, mirrored;
};

struct stability_result {
    int err; // 0, or -errno: then nothing else
    bool success, trusted, must_doubt;
    unsigned doubts;
    double distance_percent, distance_median_percent, distance_weighted_percent, distance_weighted_median_percent;
    double centre_cm, rotation_deg, theta_worst; // of all but clearcoatGloss
    double rmse_fit_percent, rmse_held_out_percent, clipped_percent, seconds, w_sim;
    struct misfit misfit;
    double said_percent[2], patches_percent[2], inflation; // median and mean standard deviation of the distances: joint's, and of misfit.h
    int n_jacobians;
    char stop[24];
};

static const double stability_success_percent = 5; // mean error of the distances below this

struct studio {
    struct stability_size size;
    bool diffuse; // D1, D2: Lambert, albedo .5, known; else Disney, free
    struct take *take;
    struct mesh mesh;
    struct texels texels;
    struct rays *rays;
    struct cameras cameras; // all of the take's
    struct panorama panorama;
    struct samples samples; // of the size's views
    struct judge_truth truth;
    double theta[DISNEY_N]; // true
};

static inline void studio_close(struct studio *s)
{
    samples_free(&s->samples), panorama_free(&s->panorama);
    cameras_free(&s->cameras), rays_free(s->rays), texels_free(&s->texels), mesh_free(&s->mesh);
    take_close(s->take);
    memset(s, 0, sizeof(*s));
}

// The paper's lights are not split, as in `rigsolve solve`.
static inline int stability_n_sub(const struct studio *s, enum method method)
{
    return method == METHOD_ALTERNATING ? 1 : s->size.n_sub;
}

static inline int stability_cut(struct lights *out, const struct studio *s, const struct panorama *p, int n_sub)
{
    struct lights cut;
    int err = lights_median_cut(&cut, p, s->size.n_lights);
    if (!err)
        err = lights_refine(out, &cut, p, s->size.n_lights * n_sub);
    lights_free(&cut);
    if (err)
        return err;
    memcpy(out->centre_m, s->truth.centre_m, sizeof(out->centre_m));
    memcpy(out->world_from_probe, s->truth.world_from_probe, sizeof(out->world_from_probe));
    return 0;
}

// n of the take's views, spread over it; by seed, if it is not 0.
static inline void stability_pick_views(const struct studio *s, int n, uint64_t seed, const char **picture)
{
    const int all = s->cameras.n;
    for (int v = 0; v < all; v++)
        picture[v] = NULL;
    for (int k = 0; k < n && n < all; k++) {
        const double u = seed ? random_uniform(seed, 20, (uint64_t)k) : .5;
        picture[(int)((k + u) * all / n)] = s->take->view_paths[(int)((k + u) * all / n)];
    }
    for (int v = 0; v < all && n >= all; v++)
        picture[v] = s->take->view_paths[v];
}

// Leaves texels without samples.
static inline void stability_thin(struct samples *m, const struct texels *t, int thin)
{
    int64_t to = 0, begin = 0;
    for (int texel = 0; texel < m->n_texels; texel++) {
        const int64_t end = m->first[texel + 1];
        const int x = (int)t->pixel[texel] % t->size, y = (int)t->pixel[texel] / t->size;
        m->first[texel] = to;
        for (int64_t i = begin; x % thin == 0 && y % thin == 0 && i < end; i++, to++) {
            m->view[to] = m->view[i], m->gradient[to] = m->gradient[i], m->flags[to] = m->flags[i];
            memmove(m->radiance[to], m->radiance[i], sizeof(m->radiance[to]));
        }
        begin = end;
    }
    m->first[m->n_texels] = m->n = to;
}

static inline int stability_gather(struct samples *out, const struct studio *s, const struct texels *texels,
                                   const struct rays *rays, const struct cameras *cameras, int n_views, uint64_t seed,
                                   int n_threads)
{
    const char **picture = calloc((size_t)s->cameras.n, sizeof(*picture));
    struct samples_settings settings = samples_defaults();
    settings.n_threads = n_threads;
    if (!picture)
        return -ENOMEM;
    stability_pick_views(s, n_views, seed, picture);
    const int err = samples_gather(out, texels, rays, cameras, picture, &settings);
    if (!err)
        stability_thin(out, texels, s->size.thin);
    free(picture);
    return err;
}

static inline int studio_open(struct studio *s, const char *take_dir, const struct stability_size *size, int n_threads)
{
    char path[PATH_MAX];
    bool uniform = true;
    memset(s, 0, sizeof(*s));
    s->size = *size;
    int err = take_open(&s->take, take_dir);
    if (!err)
        err = take_require(s->take, TAKE_MESH | TAKE_CAMERAS | TAKE_PANORAMA | TAKE_VIEWS);
    if (!err)
        err = mesh_read(&s->mesh, NULL, s->take->mesh_path);
    if (!err)
        err = texels_rasterise(&s->texels, &s->mesh, size->texture);
    if (!err)
        err = rays_new(&s->rays, &s->mesh);
    if (!err)
        err = cameras_read(&s->cameras, s->take->cameras_path);
    for (int v = 0; !err && v < s->cameras.n; v++)
        if (v >= s->take->n_views || strcmp(s->take->view_names[v], s->cameras.view[v].name)) {
            log_error("stability: %s: views and cameras differ at the %d-th", take_dir, v + 1);
            err = -EINVAL;
        }
    if (!err)
        err = panorama_read(&s->panorama, s->take->panorama_path);
    if (!err)
        err = judge_read_truth(&s->truth, take_dir);
    for (int k = 0; k < DISNEY_N; k++)
        s->theta[k] = NAN; // of a path-traced studio: not one for all
    s->diffuse = !err && !judge_has(path, take_dir, "truth/brdf.exr") && !judge_has(path, take_dir, "truth/rough_metal_spec.exr");
    if (!err && judge_has(path, take_dir, "truth/brdf.exr"))
        err = judge_theta_means(s->theta, &uniform, disney_parameter_names, &s->mesh, path);
    if (!err)
        err = stability_gather(&s->samples, s, &s->texels, s->rays, &s->cameras, size->n_views, 0, n_threads);
    if (err)
        studio_close(s);
    return err;
}

// ---- the input, made worse ----------------------------------------------------------------------

static inline void stability_direction(double d[3], uint64_t seed, uint64_t stream)
{
    for (int c = 0; c < 3; c++)
        d[c] = random_normal(seed, stream, (uint64_t)c);
    vec3_normalise(d);
}

struct input { // what is the studio's own stays so; owned: what had to be made
    struct texels texels;
    struct rays *rays;
    struct lights lights;
    struct samples samples;
    struct panorama panorama;
    bool owns_geometry, owns_panorama;
    uint8_t *held_out;
};

static inline void input_free(struct input *in)
{
    if (in->owns_geometry)
        texels_free(&in->texels), rays_free(in->rays);
    if (in->owns_panorama)
        panorama_free(&in->panorama);
    lights_free(&in->lights), samples_free(&in->samples);
    free(in->held_out);
    memset(in, 0, sizeof(*in));
}

static inline int stability_bend(struct input *in, const struct studio *s, const struct perturbation *p)
{
    enum { N_WAVES = 8 };
    const size_t n = (size_t)s->mesh.n_vertices, m = (size_t)s->mesh.n_triangles;
    float(*position)[3] = malloc(n * sizeof(*position)), (*uv)[2] = malloc(n * sizeof(*uv));
    uint32_t(*triangle)[3] = malloc(m * sizeof(*triangle));
    struct mesh bent = {0};
    double wave[N_WAVES][4]; // per metre, and the phase
    if (!position || !uv || !triangle) {
        free(position), free(uv), free(triangle);
        return -ENOMEM;
    }
    for (uint64_t w = 0; w < N_WAVES; w++) {
        stability_direction(wave[w], p->seed, 30 + w);
        const double length_m = .1 * (1 + random_uniform(p->seed, 40, w));
        for (int c = 0; c < 3; c++)
            wave[w][c] *= 2 * M_PI / length_m;
        wave[w][3] = 2 * M_PI * random_uniform(p->seed, 41, w);
    }
    for (size_t i = 0; i < n; i++) {
        double at[3], off_m = 1e-3 * p->roughness_mm * random_normal(p->seed, 42, s->mesh.point[i]);
        for (int c = 0; c < 3; c++)
            at[c] = (double)s->mesh.position_m[i][c];
        for (int w = 0; w < N_WAVES; w++)
            off_m += 1e-3 * p->bumps_mm * sqrt(2. / N_WAVES) * cos(vec3_dot(wave[w], at) + wave[w][3]);
        for (int c = 0; c < 3; c++)
            position[i][c] = (float)(at[c] + off_m * (double)s->mesh.normal[i][c]);
    }
    memcpy(uv, s->mesh.uv, n * sizeof(*uv));
    memcpy(triangle, s->mesh.triangle, m * sizeof(*triangle));
    int err = mesh_from_arrays(&bent, (int)n, position, NULL, uv, (int)m, triangle);
    if (!err)
        err = texels_rasterise(&in->texels, &bent, s->size.texture);
    if (!err && (err = rays_new(&in->rays, &bent)))
        texels_free(&in->texels);
    in->owns_geometry = !err;
    mesh_free(&bent);
    return err;
}

// Turned and shifted at random; each moves the object's picture by camera_px / sqrt(2) each way.
static inline void stability_move_camera(struct camera *c, const double target_m[3], double px, uint64_t seed, int view)
{
    double turn[9], w[3], away[3];
    vec3_sub(away, target_m, c->centre_m);
    for (int k = 0; k < 3; k++) {
        const uint64_t id = (uint64_t)(6 * view + k);
        w[k] = px / sqrt(2) / c->fx * random_normal(seed, 50, id);
        c->centre_m[k] += px / sqrt(2) / c->fx * vec3_norm(away) * random_normal(seed, 51, id);
    }
    mat3_from_rotation_vector(turn, w);
    mat3_mul(c->cam_from_world, turn, c->cam_from_world);
    mat3_mul_vec(c->t_m, c->cam_from_world, c->centre_m);
    for (int k = 0; k < 3; k++)
        c->t_m[k] = -c->t_m[k];
}

// Pictures read anew where geometry, cameras or views differ from the studio's own.
static inline int stability_look(struct input *in, const struct studio *s, const struct perturbation *p, int n_threads)
{
    const size_t n = (size_t)s->cameras.n;
    struct cameras cameras = {.n = s->cameras.n, .view = malloc(n * sizeof(*cameras.view))};
    double middle_m[3], off_m[3];
    if (!cameras.view)
        return -ENOMEM;
    memcpy(cameras.view, s->cameras.view, n * sizeof(*cameras.view));
    stability_direction(off_m, p->seed, 52);
    for (int c = 0; c < 3; c++) {
        middle_m[c] = (s->mesh.bounds_m[0][c] + s->mesh.bounds_m[1][c]) / 2;
        off_m[c] *= 1e-3 * p->moved_mm;
    }
    for (int v = 0; v < cameras.n; v++) {
        struct camera *c = &cameras.view[v];
        if (p->camera_px > 0)
            stability_move_camera(c, middle_m, p->camera_px, p->seed, v);
        if (p->moved_mm > 0 && random_uniform(p->seed, 53, (uint64_t)v) < .5) {
            double shift[3];
            mat3_mul_vec(shift, c->cam_from_world, off_m);
            vec3_add_scaled(c->t_m, c->t_m, 1, shift);
            vec3_sub(c->centre_m, c->centre_m, off_m);
        }
    }
    int err = stability_gather(&in->samples, s, &in->texels, in->rays, &cameras, p->n_views ? p->n_views : s->size.n_views,
                               p->n_views ? p->seed : 0, n_threads);
    for (int v = 0; !err && p->moved_mm > 0 && v < cameras.n; v++) // where the solver believes them to be
        memcpy(in->samples.centre_m[v], s->cameras.view[v].centre_m, sizeof(s->cameras.view[v].centre_m));
    free(cameras.view);
    return err;
}

static inline int stability_copy_samples(struct samples *to, const struct samples *from)
{
    const size_t n = (size_t)from->n, n_views = (size_t)from->n_views;
    *to = *from;
    to->first = malloc(((size_t)from->n_texels + 1) * sizeof(*to->first));
    to->view = malloc((n + 1) * sizeof(*to->view)), to->radiance = malloc((n + 1) * sizeof(*to->radiance));
    to->gradient = malloc((n + 1) * sizeof(*to->gradient)), to->flags = malloc(n + 1);
    to->centre_m = malloc((n_views + 1) * sizeof(*to->centre_m)), to->name = malloc((n_views + 1) * sizeof(*to->name));
    if (!to->first || !to->view || !to->radiance || !to->gradient || !to->flags || !to->centre_m || !to->name) {
        samples_free(to);
        return -ENOMEM;
    }
    memcpy(to->first, from->first, ((size_t)from->n_texels + 1) * sizeof(*to->first));
    memcpy(to->view, from->view, n * sizeof(*to->view));
    memcpy(to->radiance, from->radiance, n * sizeof(*to->radiance));
    memcpy(to->gradient, from->gradient, n * sizeof(*to->gradient));
    memcpy(to->flags, from->flags, n);
    memcpy(to->centre_m, from->centre_m, n_views * sizeof(*to->centre_m));
    memcpy(to->name, from->name, n_views * sizeof(*to->name));
    return 0;
}

static inline int stability_by_float(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

// The exposure at which the asked share of the samples clips.
static inline double stability_exposure(const struct samples *m, double share)
{
    float *most = malloc((size_t)m->n * sizeof(*most) + 1);
    double exposure = 1;
    for (int64_t i = 0; most && i < m->n; i++) {
        float rgb[3];
        samples_radiance(m, i, rgb);
        most[i] = fmaxf(fmaxf(rgb[0], rgb[1]), rgb[2]);
    }
    if (most && m->n) {
        qsort(most, (size_t)m->n, sizeof(*most), stability_by_float);
        exposure = 1 / (double)most[(int64_t)((1 - share) * (double)(m->n - 1))];
    }
    free(most);
    return exposure;
}

// Exposure, gains, noise, and the camera's white.
static inline void stability_expose(struct input *in, const struct perturbation *p)
{
    struct samples *m = &in->samples;
    const double exposure = p->clipped > 0 ? stability_exposure(m, p->clipped) : 1;
    int64_t n_clipped = 0;
    for (int i = 0; i < in->lights.n; i++)
        for (int c = 0; c < 3; c++)
            in->lights.irradiance[i][c] *= exposure;
    for (int64_t i = 0; i < m->n; i++) {
        const double gain = exposure * exp(p->gain * random_normal(p->seed, 60, m->view[i]));
        float rgb[3];
        samples_radiance(m, i, rgb);
        for (int c = 0; c < 3; c++) {
            const double seen = gain * (double)rgb[c] + p->noise * random_normal(p->seed, 61, (uint64_t)(3 * i + c));
            if (seen >= 1)
                m->flags[i] |= SAMPLE_CLIPPED;
            m->radiance[i][c] = half_from_float((float)fmin(seen, 1));
        }
        n_clipped += m->flags[i] & SAMPLE_CLIPPED;
    }
    m->clipped_share = m->n ? (double)n_clipped / (double)m->n : 0;
}

// The panorama as it was taken: a panel that was off, or all of it mirrored.
static inline int stability_change_panorama(struct input *in, const struct studio *s, const struct perturbation *p)
{
    struct image *image = &in->panorama.image;
    const int err = image_new(image, s->panorama.image.width, s->panorama.image.height, 3, NULL);
    if (err)
        return err;
    in->owns_panorama = true;
    struct judge_truth only = s->truth;
    only.n_panels = 1;
    if (p->missing >= 0 && p->missing < s->truth.n_panels)
        only.panel[0] = s->truth.panel[p->missing];
    for (int y = 0; y < image->height; y++)
        for (int x = 0; x < image->width; x++) {
            const int from = p->mirrored ? image->width - 1 - x : x;
            float *to = image->data + 3 * ((int64_t)y * image->width + x);
            double dir[3];
            panorama_direction(image->width, image->height, x + .5, y + .5, dir);
            const bool dark = p->missing >= 0 && judge_true_inverse_distance(&only, dir) > 0;
            for (int c = 0; c < 3; c++)
                to[c] = dark ? 0 : s->panorama.image.data[3 * ((int64_t)y * image->width + from) + c];
        }
    return 0;
}

static inline void stability_darken_strongest(struct lights *l)
{
    double luminance[l->n];
    int strongest = 0;
    memset(luminance, 0, sizeof(luminance));
    for (int i = 0; i < l->n; i++)
        luminance[l->group[i]] += judge_light_luminance(l, i);
    for (int g = 1; g < l->n; g++)
        if (luminance[g] > luminance[strongest])
            strongest = g;
    for (int i = 0; i < l->n; i++)
        if (l->group[i] == strongest)
            memset(l->irradiance[i], 0, sizeof(l->irradiance[i]));
}

static inline int input_make(struct input *in, const struct studio *s, const struct perturbation *p, int n_threads)
{
    int err = 0, seen = 0;
    memset(in, 0, sizeof(*in));
    in->texels = s->texels, in->rays = s->rays, in->panorama = s->panorama;
    if (p->bumps_mm > 0 || p->roughness_mm > 0)
        err = stability_bend(in, s, p);
    if (!err && (in->owns_geometry || p->camera_px > 0 || p->moved_mm > 0 || p->n_views))
        err = stability_look(in, s, p, n_threads);
    else if (!err)
        err = stability_copy_samples(&in->samples, &s->samples);
    const bool panel = p->missing >= 0 && p->missing < STRONGEST_LIGHT_MISSING;
    if (!err && (panel || p->mirrored))
        err = stability_change_panorama(in, s, p);
    if (!err)
        err = stability_cut(&in->lights, s, &in->panorama, stability_n_sub(s, p->method));
    in->held_out = calloc((size_t)s->cameras.n, 1);
    if (!err && !in->held_out)
        err = -ENOMEM;
    if (err) {
        input_free(in);
        return err;
    }
    if (p->missing == STRONGEST_LIGHT_MISSING)
        stability_darken_strongest(&in->lights);
    if (p->gain > 0 || p->noise > 0 || p->clipped > 0)
        stability_expose(in, p);
    const char *picture[s->cameras.n];
    stability_pick_views(s, p->n_views ? p->n_views : s->size.n_views, p->n_views ? p->seed : 0, picture);
    for (int v = 0; v < s->cameras.n; v++) // every 7th, as `rigsolve solve` does
        in->held_out[v] = picture[v] && seen++ % 7 == 6;
    double axis[3], w[3], direction[3], turn[9];
    stability_direction(axis, p->seed, 70), stability_direction(direction, p->seed, 71);
    for (int c = 0; c < 3; c++)
        w[c] = axis[c] * p->rotation_deg * M_PI / 180;
    mat3_from_rotation_vector(turn, w);
    mat3_mul(in->lights.world_from_probe, turn, in->lights.world_from_probe);
    vec3_add_scaled(in->lights.centre_m, in->lights.centre_m, p->centre_m, direction);
    return 0;
}

// ---- solved and judged --------------------------------------------------------------------------

static inline struct joint_settings stability_settings(const struct studio *s, const struct perturbation *p, int n_threads)
{
    struct joint_settings set = joint_defaults(p->method);
    set.model = s->diffuse ? REFLECT_LAMBERT : REFLECT_DISNEY, set.variant = DISNEY_2017;
    set.albedo = s->diffuse ? ALBEDO_GIVEN : ALBEDO_FREE;
    for (int c = 0; c < 3; c++)
        set.given_albedo[c] = .5;
    if (p->start_m > 0)
        set.start_distance_m = p->start_m;
    if (p->w_sim > 0)
        set.w_sim = p->w_sim;
    set.gain = p->solve_gain, set.n_threads = n_threads;
    return set;
}

static inline int stability_by_double(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// 1/r of every group: its first light's.
static inline void stability_distances(double *q, const struct lights *l)
{
    for (int i = l->n - 1; i >= 0; i--)
        q[l->group[i]] = l->inverse_distance[i];
}

// Of the lights that shine: deviation of 1/r over 1/r, median and mean, in percent.
static inline void stability_spread(double percent[2], const struct lights *l, int n_groups, const double *deviation)
{
    double relative[n_groups], q[n_groups], sum = 0;
    int n = 0;
    stability_distances(q, l);
    for (int g = 0; g < n_groups; g++)
        if (isfinite(deviation[g]) && q[g] > 0)
            sum += relative[n++] = 100 * deviation[g] / q[g];
    qsort(relative, (size_t)n, sizeof(double), stability_by_double);
    percent[0] = n ? relative[n / 2] : NAN, percent[1] = n ? sum / n : NAN;
}

// Eq. 11 in log 1/r as knowledge: neighbours' distances differ as along a wall seen at 45 degrees.
static inline void stability_prior(double *prior, const struct lights *l, int n_groups, const struct photometric_layout *layout)
{
    enum { N_NEIGHBOURS = 8 };
    double dir[n_groups][3], q[n_groups];
    stability_distances(q, l);
    memset(dir, 0, sizeof(dir));
    for (int i = 0; i < l->n; i++)
        vec3_add_scaled(dir[l->group[i]], dir[l->group[i]], judge_light_luminance(l, i), l->dir_probe[i]);
    for (int i = 0; i < n_groups; i++)
        vec3_normalise(dir[i]);
    for (int i = 0; i < n_groups; i++) {
        bool taken[n_groups];
        memset(taken, 0, sizeof(taken));
        for (int k = 0; k < N_NEIGHBOURS && k < n_groups - 1; k++) {
            int nearest = -1;
            for (int j = 0; j < n_groups; j++)
                if (j != i && !taken[j] && (nearest < 0 || vec3_dot(dir[i], dir[j]) > vec3_dot(dir[i], dir[nearest])))
                    nearest = j;
            taken[nearest] = true;
            double off[3];
            vec3_sub(off, dir[i], dir[nearest]);
            const double qi = q[i], qj = q[nearest];
            const double w = 1 / fmax(vec3_dot(off, off), 1e-6) / N_NEIGHBOURS;
            const size_t n = (size_t)layout->n, a = (size_t)(layout->inverse_distance + i), b = (size_t)(layout->inverse_distance + nearest);
            if (!(qi > 0 && qj > 0))
                continue;
            prior[a * n + a] += w / (qi * qi), prior[b * n + b] += w / (qj * qj);
            prior[a * n + b] -= w / (qi * qj), prior[b * n + a] -= w / (qi * qj);
        }
    }
}

static inline int stability_measure_misfit(struct stability_result *out, const struct input *in, const struct studio *s,
                                           const struct joint_settings *set, const struct joint_result *r, int n_threads)
{
    const int n_groups = s->size.n_lights;
    const struct photometric_layout layout = photometric_layout_of(s->cameras.n, n_groups);
    uint8_t fit[s->cameras.n];
    unsigned char is_free[layout.n];
    double deviation[layout.n];
    const struct photometric p = {.texels = &in->texels, .samples = &in->samples, .model = set->model,
                                  .variant = set->variant, .albedo = set->albedo, .group_of_light = in->lights.group,
                                  .n_groups = n_groups, .use_view = fit, .texel_step = 1, .n_threads = n_threads};
    for (int v = 0; v < s->cameras.n; v++)
        fit[v] = !in->held_out[v];
    memset(is_free, 1, sizeof(is_free));
    memset(is_free + layout.theta, !s->diffuse, DISNEY_N);
    memset(is_free + layout.albedo, 0, 3);
    memset(is_free + layout.gain, set->gain, (size_t)layout.n_views);
    int err = misfit_measure(&out->misfit, &p, &r->state);
    double *prior = calloc((size_t)layout.n * (size_t)layout.n, sizeof(*prior));
    if (!err && !prior)
        err = -ENOMEM;
    if (!err)
        stability_prior(prior, &r->state.lights, n_groups, &layout);
    if (!err)
        err = misfit_deviations(deviation, &out->inflation, &p, &r->state, is_free, prior);
    free(prior);
    if (!err) {
        stability_spread(out->said_percent, &r->state.lights, n_groups, r->inverse_distance_std);
        stability_spread(out->patches_percent, &r->state.lights, n_groups, deviation + layout.inverse_distance);
    }
    return err;
}

static inline int stability_judge(struct stability_result *out, const struct input *in, const struct studio *s,
                                  const struct joint_result *r, int n_sub)
{
    struct judgement j;
    struct lights l = in->lights;
    double off[3];
    memcpy(l.centre_m, r->state.lights.centre_m, sizeof(l.centre_m));
    memcpy(l.world_from_probe, r->state.lights.world_from_probe, sizeof(l.world_from_probe));
    l.inverse_distance = r->state.lights.inverse_distance;
    judge_clear(&j);
    const int err = judge_lights(&j, &s->truth, &in->panorama, &l, n_sub);
    vec3_sub(off, l.centre_m, s->truth.centre_m);
    out->centre_cm = 100 * vec3_norm(off);
    out->rotation_deg = judge_angle_between(l.world_from_probe, s->truth.world_from_probe) * 180 / M_PI;
    out->distance_percent = j.distance_percent, out->distance_median_percent = j.distance_median_percent;
    out->distance_weighted_percent = j.distance_weighted_percent;
    out->distance_weighted_median_percent = j.distance_weighted_median_percent;
    out->theta_worst = s->diffuse ? NAN : 0;
    for (int k = 0; !s->diffuse && k < DISNEY_N; k++)
        if (k != DISNEY_CLEARCOAT_GLOSS)
            out->theta_worst = fmax(out->theta_worst, fabs(r->state.theta[k] - s->theta[k]));
    return err;
}

static inline void stability_run(struct stability_result *out, const struct studio *s, const struct perturbation *p, int n_threads)
{
    struct input in;
    struct joint_result r;
    struct timespec begin, end;
    const struct joint_settings set = stability_settings(s, p, n_threads);
    memset(out, 0, sizeof(*out));
    out->err = input_make(&in, s, p, n_threads);
    if (out->err)
        return;
    clock_gettime(CLOCK_MONOTONIC, &begin);
    out->err = joint_solve(&r, &in.texels, &in.samples, in.rays, &in.lights, in.held_out, &set);
    clock_gettime(CLOCK_MONOTONIC, &end);
    out->seconds = (double)(end.tv_sec - begin.tv_sec) + 1e-9 * (double)(end.tv_nsec - begin.tv_nsec);
    if (!out->err) {
        out->doubts = r.doubts, out->trusted = !r.doubts;
        out->rmse_fit_percent = r.rmse_fit_percent, out->rmse_held_out_percent = r.rmse_held_out_percent;
        out->clipped_percent = 100 * in.samples.clipped_share;
        out->n_jacobians = r.n_jacobians, out->w_sim = r.w_sim;
        snprintf(out->stop, sizeof(out->stop), "%s", r.stop_reason);
        out->must_doubt = p->mirrored || (p->missing >= 0 && p->missing < STRONGEST_LIGHT_MISSING);
        out->err = stability_judge(out, &in, s, &r, stability_n_sub(s, p->method));
        if (!out->err)
            out->err = stability_measure_misfit(out, &in, s, &set, &r, n_threads);
        out->success = out->distance_percent < stability_success_percent;
        joint_result_free(&r);
    }
    input_free(&in);
}
