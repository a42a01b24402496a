// solver/render.c - pictures of a known object: rays per pixel, Eq. 5 at what they hit.
//
// Light on a surface point is gathered and shaded by the kernels. Shadows and the bounce only
// decide what reaches the point:
//   shadows  a visible share per light: exact (one ray each), or per group of neighbouring lights,
//   estimated by a few rays bounce   Lambertian radiosity of the direct light in a texture,
//   gathered by cosine-distributed rays:
//            L = pi / K sum_k f(l_k, v) B(hit of l_k)
// Random numbers are named by seed, view, pixel and sample, so threads do not matter.
#include "solver/render.h"
#include "solver/parallel.h"
#include "solver/random.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/texels.h"
#include "solver/vec3.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

enum {
    MAX_GROUPS = 256,
    GROUP_LEVELS = 8,
    TILE = 1024,
    GUTTER_PX = 8,
    MAX_BOUNCE_RAYS = 4096,
    MAX_WORKERS = 256
};
enum {
    BOUNCE_INDEX = 1 << 24,
    GROUP_INDEX_STEP = 1 << 12
}; // places in a sample's stream of random numbers

// Bounds of R dh and q of some lights.
struct light_box {
    float low[3], high[3], q_low, q_high;
};

// Lights [begin, end) with neighbouring directions, whose shadows are judged together.
struct light_group {
    int begin, end;
    struct light_box box;
};

// TILE lights in a row, also neighbours: skipped together below the horizon, and few enough that
// what the kernels gather stays in the cache.
struct light_tile {
    int begin;
    struct light_arrays lights; // borrowed
    struct light_box box;
};

struct renderer {
    const struct mesh *mesh;
    const struct rays *rays;
    struct render_material material;
    struct render_settings settings;
    const struct kernels *kernels;
    int albedo_channel[3], theta_channel[DISNEY_N];
    struct light_arrays lights; // in the order of the groups
    int n_groups;
    struct light_group group[MAX_GROUPS];
    int n_tiles;
    struct light_tile *tile;
    float *cumulative; // [n] share of the group's energy up to and including this light
    struct image radiosity; // outgoing diffuse radiance of the direct light; no pixels: no bounce
};

// What one thread needs while shading.
struct scratch {
    struct lit lit;
    struct light_arrays bounced; // what the bounce rays met, as lights at infinity
    uint16_t *visible;
    uint8_t *share;
};

static int n_workers_of(const struct renderer *r)
{
    const int n = r->settings.n_threads > 0 ? r->settings.n_threads : parallel_n_cores();
    return n < MAX_WORKERS ? n : MAX_WORKERS;
}

static void scratch_free(struct scratch *s, int n)
{
    for (int i = 0; s && i < n; i++) {
        lit_free(&s[i].lit);
        light_arrays_free(&s[i].bounced);
        free(s[i].visible), free(s[i].share);
    }
    free(s);
}

static struct scratch *scratch_new(const struct renderer *r, int n)
{
    const int n_bounced = r->settings.bounce_rays > 0 ? r->settings.bounce_rays : 1;
    struct lights bounced;
    if (lights_new(&bounced, n_bounced))
        return NULL;
    struct scratch *s = calloc((size_t)n, sizeof(*s));
    for (int i = 0; s && i < n; i++) {
        s[i].visible = calloc((size_t)r->lights.n_padded / 16, sizeof(*s[i].visible));
        s[i].share = calloc((size_t)r->lights.n_padded, sizeof(*s[i].share));
        if (!s[i].visible || !s[i].share ||
            lit_new(&s[i].lit, n_bounced > TILE ? n_bounced : TILE) ||
            light_arrays_new(&s[i].bounced, &bounced)) {
            scratch_free(s, n);
            s = NULL;
        }
    }
    lights_free(&bounced);
    return s;
}

// ---- surface points and material ----------------------------------------------------------------

struct point {
    uint32_t triangle;
    float barycentric[2];
    float uv[2];
    struct surface_point surface;
    struct shade_material material;
};

static void get_corners(const struct mesh *mesh, uint32_t triangle, double corner[3][3])
{
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < 3; i++)
            corner[k][i] = mesh->position_m[mesh->triangle[triangle][k]][i];
}

static void facet_normal(const struct mesh *mesh, uint32_t triangle, double normal[3])
{
    double corner[3][3], e1[3], e2[3];
    get_corners(mesh, triangle, corner);
    vec3_sub(e1, corner[1], corner[0]);
    vec3_sub(e2, corner[2], corner[0]);
    vec3_cross(normal, e1, e2);
    vec3_normalise(normal);
}

static void interpolate_uv(const struct mesh *mesh, uint32_t triangle, const float barycentric[2],
                           float uv[2])
{
    const float weight[3] = {1 - barycentric[0] - barycentric[1], barycentric[0], barycentric[1]};
    uv[0] = uv[1] = 0;
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < 2; i++)
            uv[i] += weight[k] * mesh->uv[mesh->triangle[triangle][k]][i];
}

// Direction of growing u in the triangle, made orthogonal to the normal; any orthogonal one where
// the atlas gives none.
static void tangent_along_u(const struct mesh *mesh, uint32_t triangle, const double normal[3],
                            double tangent[3])
{
    const uint32_t *t = mesh->triangle[triangle];
    double corner[3][3], e1[3], e2[3];
    get_corners(mesh, triangle, corner);
    vec3_sub(e1, corner[1], corner[0]);
    vec3_sub(e2, corner[2], corner[0]);
    const double u1 = (double)mesh->uv[t[1]][0] - mesh->uv[t[0]][0],
                 v1 = (double)mesh->uv[t[1]][1] - mesh->uv[t[0]][1],
                 u2 = (double)mesh->uv[t[2]][0] - mesh->uv[t[0]][0],
                 v2 = (double)mesh->uv[t[2]][1] - mesh->uv[t[0]][1];
    const double sign = u1 * v2 - u2 * v1 < 0 ? -1 : 1;
    for (int i = 0; i < 3; i++)
        tangent[i] = sign * (v2 * e1[i] - v1 * e2[i]);
    vec3_normalise(tangent);
    vec3_add_scaled(tangent, tangent, -vec3_dot(tangent, normal), normal);
    if (vec3_normalise(tangent) > 1e-9)
        return;
    const double axis[3] = {fabs(normal[0]) < .6, fabs(normal[0]) >= .6, 0};
    vec3_cross(tangent, axis, normal);
    vec3_normalise(tangent);
}

static void look_up(const struct image *texture, bool nearest, const float uv[2], float *values)
{
    const double x = (double)uv[0] * texture->width, y = (1 - (double)uv[1]) * texture->height;
    if (!nearest) {
        image_bilinear(texture, x, y, values);
        return;
    }
    const int i = (int)fmin(fmax(floor(x), 0), texture->width - 1),
              j = (int)fmin(fmax(floor(y), 0), texture->height - 1);
    memcpy(values,
           texture->data +
               ((size_t)j * (size_t)texture->width + (size_t)i) * (size_t)texture->n_channels,
           (size_t)texture->n_channels * sizeof(*values));
}

static void get_material(const struct renderer *r, const float uv[2], struct shade_material *out)
{
    const struct render_material *m = &r->material;
    float values[IMAGE_MAX_CHANNELS];
    out->variant = m->variant;
    memcpy(out->albedo, m->constant_albedo, sizeof(out->albedo));
    memcpy(out->theta, m->constant_theta, sizeof(out->theta));
    if (m->albedo) {
        look_up(m->albedo, m->nearest, uv, values);
        for (int c = 0; c < 3; c++)
            out->albedo[c] = values[r->albedo_channel[c]];
    }
    if (m->parameters) {
        look_up(m->parameters, m->nearest, uv, values);
        for (int k = 0; k < DISNEY_N; k++)
            out->theta[k] = fminf(fmaxf(values[r->theta_channel[k]], 0), 1);
    }
}

// False for a triangle without area and without normals.
static bool get_point(const struct renderer *r, uint32_t triangle, const float barycentric[2],
                      struct point *out)
{
    const struct mesh *mesh = r->mesh;
    const uint32_t *t = mesh->triangle[triangle];
    const double weight[3] = {1. - barycentric[0] - barycentric[1], barycentric[0], barycentric[1]};
    double position[3] = {0}, normal[3] = {0}, tangent[3], bitangent[3];
    for (int k = 0; k < 3; k++) {
        for (int i = 0; i < 3; i++) {
            position[i] += weight[k] * mesh->position_m[t[k]][i];
            normal[i] += weight[k] * mesh->normal[t[k]][i];
        }
    }
    if (vec3_normalise(normal) < 1e-6) {
        facet_normal(mesh, triangle, normal);
        if (vec3_norm(normal) == 0)
            return false;
    }
    tangent_along_u(mesh, triangle, normal, tangent);
    vec3_cross(bitangent, normal, tangent);
    out->triangle = triangle;
    memcpy(out->barycentric, barycentric, sizeof(out->barycentric));
    interpolate_uv(mesh, triangle, barycentric, out->uv);
    for (int i = 0; i < 3; i++) {
        out->surface.position_m[i] = (float)position[i];
        out->surface.normal[i] = (float)normal[i];
        out->surface.tangent[i] = (float)tangent[i];
        out->surface.bitangent[i] = (float)bitangent[i];
    }
    get_material(r, out->uv, &out->material);
    return true;
}

// ---- light groups -------------------------------------------------------------------------------

struct sort_key {
    double value;
    int index;
};

static int compare_keys(const void *pa, const void *pb)
{
    const struct sort_key *a = pa, *b = pb;
    return a->value < b->value   ? -1
           : a->value > b->value ? 1
                                 : (a->index > b->index) - (a->index < b->index);
}

static double luminance(const double rgb[3])
{
    return .2126 * rgb[0] + .7152 * rgb[1] + .0722 * rgb[2];
}

// Sort order[begin, end) along the longest side of its box of directions; the index where half of
// its energy (or of its lights) is reached.
static int split(const struct lights *l, int *order, struct sort_key *keys, int begin, int end,
                 bool by_energy)
{
    double low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY},
           total = 0, sum = 0;
    for (int i = begin; i < end; i++) {
        for (int k = 0; k < 3; k++) {
            low[k] = fmin(low[k], l->dir_probe[order[i]][k]);
            high[k] = fmax(high[k], l->dir_probe[order[i]][k]);
        }
        total += by_energy ? luminance(l->irradiance[order[i]]) : 1;
    }
    int axis = 0;
    for (int k = 1; k < 3; k++)
        if (high[k] - low[k] > high[axis] - low[axis])
            axis = k;
    for (int i = begin; i < end; i++)
        keys[i] = (struct sort_key){l->dir_probe[order[i]][axis], order[i]};
    qsort(keys + begin, (size_t)(end - begin), sizeof(*keys), compare_keys);
    int middle = begin;
    for (int i = begin; i < end; i++) {
        order[i] = keys[i].index;
        sum += by_energy ? luminance(l->irradiance[order[i]]) : 1;
        if (sum <= total / 2)
            middle = i + 1;
    }
    return middle <= begin ? begin + 1 : middle >= end ? end - 1 : middle;
}

// Bring neighbours together down to a fraction of a tile.
static void order_within(const struct lights *l, int *order, struct sort_key *keys, int begin,
                         int end)
{
    if (end - begin <= TILE / 4)
        return;
    const int middle = split(l, order, keys, begin, end, false);
    order_within(l, order, keys, begin, middle);
    order_within(l, order, keys, middle, end);
}

// order[n]: the lights group by group. Groups have about equal energy.
static void partition_lights(struct renderer *r, const struct lights *l, int *order,
                             struct sort_key *keys)
{
    for (int i = 0; i < l->n; i++)
        order[i] = i;
    r->n_groups = 1;
    r->group[0] = (struct light_group){.end = l->n};
    for (int level = 0; level < GROUP_LEVELS; level++) {
        for (int g = r->n_groups - 1; g >= 0; g--) {
            struct light_group *group = &r->group[g];
            if (group->end - group->begin < 2)
                continue;
            const int middle = split(l, order, keys, group->begin, group->end, true);
            r->group[r->n_groups++] = (struct light_group){.begin = middle, .end = group->end};
            group->end = middle;
        }
    }
    for (int g = 0; g < r->n_groups; g++)
        order_within(l, order, keys, r->group[g].begin, r->group[g].end);
}

static struct light_box bound(const struct light_arrays *a, int begin, int end)
{
    struct light_box box = {
        {INFINITY, INFINITY, INFINITY}, {-INFINITY, -INFINITY, -INFINITY}, INFINITY, -INFINITY};
    for (int i = begin; i < end; i++) {
        const float d[3] = {a->dx[i], a->dy[i], a->dz[i]};
        for (int k = 0; k < 3; k++)
            box.low[k] = fminf(box.low[k], d[k]), box.high[k] = fmaxf(box.high[k], d[k]);
        box.q_low = fminf(box.q_low, a->q[i]), box.q_high = fmaxf(box.q_high, a->q[i]);
    }
    return box;
}

static int make_tiles(struct renderer *r)
{
    const struct light_arrays *a = &r->lights;
    r->n_tiles = (a->n + TILE - 1) / TILE;
    r->tile = calloc((size_t)r->n_tiles, sizeof(*r->tile));
    if (!r->tile)
        return -ENOMEM;
    for (int i = 0; i < r->n_tiles; i++) {
        struct light_tile *t = &r->tile[i];
        const int begin = i * TILE, n = a->n - begin < TILE ? a->n - begin : TILE;
        const int n_padded = a->n_padded - begin < TILE ? a->n_padded - begin : TILE;
        t->begin = begin;
        t->lights =
            (struct light_arrays){.n = n,
                                  .n_padded = n_padded,
                                  .centre_m = {a->centre_m[0], a->centre_m[1], a->centre_m[2]},
                                  .dx = a->dx + begin,
                                  .dy = a->dy + begin,
                                  .dz = a->dz + begin,
                                  .q = a->q + begin,
                                  .cr = a->cr + begin,
                                  .cg = a->cg + begin,
                                  .cb = a->cb + begin};
        t->box = bound(a, begin, begin + n);
    }
    return 0;
}

static int prepare_lights(struct renderer *r, const struct lights *l)
{
    struct lights sorted = {0};
    int err = -ENOMEM;
    int *order = malloc((size_t)l->n * sizeof(*order));
    struct sort_key *keys = malloc((size_t)l->n * sizeof(*keys));
    r->cumulative = malloc((size_t)l->n * sizeof(*r->cumulative));
    if (!order || !keys || !r->cumulative || lights_new(&sorted, l->n))
        goto done;
    partition_lights(r, l, order, keys);
    memcpy(sorted.centre_m, l->centre_m, sizeof(sorted.centre_m));
    memcpy(sorted.world_from_probe, l->world_from_probe, sizeof(sorted.world_from_probe));
    for (int i = 0; i < l->n; i++) {
        memcpy(sorted.dir_probe[i], l->dir_probe[order[i]], sizeof(sorted.dir_probe[i]));
        memcpy(sorted.irradiance[i], l->irradiance[order[i]], sizeof(sorted.irradiance[i]));
        sorted.inverse_distance[i] = l->inverse_distance[order[i]];
    }
    if (light_arrays_new(&r->lights, &sorted))
        goto done;
    for (int g = 0; g < r->n_groups; g++) {
        struct light_group *group = &r->group[g];
        double total = 0, sum = 0;
        group->box = bound(&r->lights, group->begin, group->end);
        for (int i = group->begin; i < group->end; i++)
            total += luminance(sorted.irradiance[i]);
        for (int i = group->begin; i < group->end; i++) {
            sum += luminance(sorted.irradiance[i]);
            r->cumulative[i] = total > 0 ? (float)(sum / total) : 1;
        }
    }
    if (make_tiles(r))
        goto done;
    err = 0;
done:
    lights_free(&sorted);
    free(order), free(keys);
    return err;
}

// ---- shadows ------------------------------------------------------------------------------------

// A sample's place in the random numbers.
struct stream {
    uint64_t seed, stream;
};

// u = R dh + q (c - p): the direction to light i, which lies at t = 1 / q along it.
static void towards_light(const struct light_arrays *a, int i, const float p[3], float u[3])
{
    u[0] = a->dx[i] + a->q[i] * (a->centre_m[0] - p[0]);
    u[1] = a->dy[i] + a->q[i] * (a->centre_m[1] - p[1]);
    u[2] = a->dz[i] + a->q[i] * (a->centre_m[2] - p[2]);
}

static float dot3f(const float a[3], const float b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static bool light_blocked(const struct renderer *r, int i, const float start_m[3])
{
    float u[3];
    towards_light(&r->lights, i, start_m, u);
    return rays_blocked(r->rays, start_m, u, 0,
                        r->lights.q[i] > 0 ? .9999f / r->lights.q[i] : INFINITY);
}

static void trace_every_light(const struct renderer *r, const struct point *p,
                              const float start_m[3], uint16_t *visible)
{
    memset(visible, 0, (size_t)r->lights.n_padded / 16 * sizeof(*visible));
    for (int i = 0; i < r->lights.n; i++) {
        float u[3];
        towards_light(&r->lights, i, p->surface.position_m, u);
        if (dot3f(u, p->surface.normal) > 0 && !light_blocked(r, i, start_m))
            visible[i / 16] |= (uint16_t)(1u << (i % 16));
    }
}

// False only if every light in the box lies below the point's horizon: the largest possible <n, u>,
// less rounding, is below 0.
static bool may_rise(const struct renderer *r, const struct light_box *box, const struct point *p)
{
    const float *n = p->surface.normal, *x = p->surface.position_m, *c = r->lights.centre_m;
    const float towards_centre = n[0] * (c[0] - x[0]) + n[1] * (c[1] - x[1]) + n[2] * (c[2] - x[2]);
    float highest = towards_centre * (towards_centre > 0 ? box->q_high : box->q_low);
    for (int k = 0; k < 3; k++)
        highest += n[k] * (n[k] > 0 ? box->high[k] : box->low[k]);
    return highest > -1e-5f;
}

// The light of the group at share x of its energy.
static int draw_light(const struct renderer *r, const struct light_group *g, float x)
{
    int low = g->begin, high = g->end - 1;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (r->cumulative[middle] > x)
            high = middle;
        else
            low = middle + 1;
    }
    return low;
}

// The share of the group that arrives, judged by shadow_rays of its lights above the horizon.
static float group_share(const struct renderer *r, const struct light_group *g,
                         const struct point *p, const float start_m[3], struct stream s,
                         uint64_t index)
{
    enum { TRIES = 4 }; // a drawn light below the horizon says nothing: draw again
    const int n = r->settings.shadow_rays;
    int n_traced = 0, n_visible = 0;
    for (int k = 0; k < n; k++) {
        for (int attempt = 0; attempt < TRIES; attempt++) {
            const double x =
                random_uniform(s.seed, s.stream, index + (uint64_t)(k * TRIES + attempt));
            const int i = draw_light(r, g, (float)(attempt ? x : (k + x) / n));
            float u[3];
            towards_light(&r->lights, i, p->surface.position_m, u);
            if (dot3f(u, p->surface.normal) <= 0)
                continue;
            n_traced++, n_visible += !light_blocked(r, i, start_m);
            break;
        }
    }
    return n_traced ? (float)n_visible / (float)n_traced : 1;
}

static void estimate_shares(const struct renderer *r, const struct point *p, const float start_m[3],
                            struct stream s, uint8_t *share)
{
    for (int g = 0; g < r->n_groups; g++) {
        const struct light_group *group = &r->group[g];
        const uint64_t index = (uint64_t)g * GROUP_INDEX_STEP;
        uint8_t byte = 0;
        if (may_rise(r, &group->box, p)) { // rounded up or down at random: no bias by the byte
            const double rounding = random_uniform(s.seed, s.stream, index + GROUP_INDEX_STEP - 1);
            const double x = 255. * group_share(r, group, p, start_m, s, index) + rounding;
            byte = x < 255 ? (uint8_t)x : 255;
        }
        memset(share + group->begin, byte, (size_t)(group->end - group->begin));
    }
}

// ---- light on a point ---------------------------------------------------------------------------

// Find out which lights reach p: by bits or by bytes in s, or without looking where there are no
// shadows.
static void find_shadows(const struct renderer *r, const struct point *p, const float start_m[3],
                         struct stream stream, struct scratch *s)
{
    if (!r->settings.shadows)
        return;
    if (r->settings.shadow_rays > 0)
        estimate_shares(r, p, start_m, stream, s->share);
    else
        trace_every_light(r, p, start_m, s->visible);
}

// Direct light: outgoing radiance towards v, or with v = NULL the irradiance. Call find_shadows()
// before.
static void add_direct(const struct renderer *r, const struct point *p, const float v[3],
                       struct scratch *s, float out[3])
{
    const bool estimated = r->settings.shadows && r->settings.shadow_rays > 0;
    double sum[3] = {0};
    for (int k = 0; k < r->n_tiles; k++) {
        const struct light_tile *t = &r->tile[k];
        const uint16_t *visible =
            r->settings.shadows && !estimated ? s->visible + t->begin / 16 : NULL;
        const uint8_t *share = estimated ? s->share + t->begin : NULL;
        float part[3] = {0};
        if (!may_rise(r, &t->box, p))
            continue;
        if (!v && !estimated) {
            r->kernels->irradiance(part, &t->lights, &p->surface, visible);
        } else {
            r->kernels->gather(&s->lit, &t->lights, &p->surface, visible, share);
            if (v)
                r->kernels->shade(part, &s->lit, &p->surface, v, &p->material);
            for (int i = 0; !v && i < s->lit.n; i++)
                part[0] += s->lit.wr[i], part[1] += s->lit.wg[i], part[2] += s->lit.wb[i];
        }
        for (int c = 0; c < 3; c++)
            sum[c] += part[c];
    }
    for (int c = 0; c < 3; c++)
        out[c] = (float)sum[c];
}

static double radical_inverse2(uint32_t k)
{
    double x = 0, half = .5;
    for (; k; k >>= 1, half /= 2)
        x += half * (k & 1);
    return x;
}

// Light from other parts of the object into s->bounced: a light per ray that gives pi / K times the
// radiance it met, after the cosine that the kernels will multiply by.
static void gather_bounce(const struct renderer *r, const struct point *p, const float start_m[3],
                          struct stream stream, struct scratch *s)
{
    const int n = r->settings.bounce_rays;
    const double shift[2] = {random_uniform(stream.seed, stream.stream, BOUNCE_INDEX),
                             random_uniform(stream.seed, stream.stream, BOUNCE_INDEX + 1)};
    const struct surface_point *f = &p->surface;
    struct light_arrays *a = &s->bounced;
    for (int k = 0; k < n; k++) {
        const double x = (k + shift[0]) / n, y = radical_inverse2((uint32_t)k) + shift[1];
        const double sine = sqrt(x), cosine = sqrt(1 - x), angle = 2 * M_PI * y;
        float dir[3], radiance[IMAGE_MAX_CHANNELS] = {0}, uv[2];
        double facet[3];
        struct ray_hit hit;
        for (int i = 0; i < 3; i++)
            dir[i] = (float)(sine * cos(angle) * f->tangent[i] +
                             sine * sin(angle) * f->bitangent[i] + cosine * f->normal[i]);
        const float towards = dot3f(dir, f->normal);
        if (towards > 0 && rays_hit(r->rays, start_m, dir, 0, INFINITY, &hit)) {
            facet_normal(r->mesh, hit.triangle, facet);
            if (facet[0] * dir[0] + facet[1] * dir[1] + facet[2] * dir[2] < 0) { // not from inside
                interpolate_uv(r->mesh, hit.triangle, (const float[2]){hit.u, hit.v}, uv);
                look_up(&r->radiosity, false, uv, radiance);
            }
        }
        const float weight = towards > 0 ? (float)(M_PI / n) / towards : 0;
        a->dx[k] = dir[0], a->dy[k] = dir[1], a->dz[k] = dir[2];
        a->cr[k] = weight * radiance[0], a->cg[k] = weight * radiance[1],
        a->cb[k] = weight * radiance[2];
    }
}

static void shade_point(const struct renderer *r, const struct point *p, const float eye_m[3],
                        struct stream stream, struct scratch *s, float L[3])
{
    const bool lambert = r->material.model == REFLECT_LAMBERT, bounce = r->radiosity.data;
    float start_m[3] = {0}, indirect[3] = {0};
    double v[3];
    for (int i = 0; i < 3; i++)
        v[i] = (double)eye_m[i] - p->surface.position_m[i];
    vec3_normalise(v);
    const float vf[3] = {(float)v[0], (float)v[1], (float)v[2]};
    if (r->settings.shadows || bounce)
        rays_start(r->rays, p->triangle, p->barycentric, start_m);
    find_shadows(r, p, start_m, stream, s);
    add_direct(r, p, lambert ? NULL : vf, s, L);
    if (bounce) {
        gather_bounce(r, p, start_m, stream, s);
        if (lambert) {
            r->kernels->irradiance(indirect, &s->bounced, &p->surface, NULL);
        } else {
            r->kernels->gather(&s->lit, &s->bounced, &p->surface, NULL, NULL);
            r->kernels->shade(indirect, &s->lit, &p->surface, vf, &p->material);
        }
    }
    for (int c = 0; c < 3; c++)
        L[c] = (L[c] + indirect[c]) * (lambert ? p->material.albedo[c] * (float)M_1_PI : 1);
}

// ---- radiosity ----------------------------------------------------------------------------------

struct radiosity_job {
    struct renderer *renderer;
    const struct texels *texels;
    struct scratch *scratch;
    uint64_t seed;
};

static void light_texels(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct radiosity_job *job = arg;
    struct renderer *r = job->renderer;
    const struct texels *t = job->texels;
    for (int64_t i = begin; i < end; i++) {
        struct point p;
        float start_m[3], E[3];
        if (!get_point(r, t->triangle[i], t->barycentric[i], &p))
            continue;
        rays_start(r->rays, p.triangle, p.barycentric, start_m);
        find_shadows(r, &p, start_m, (struct stream){job->seed, t->pixel[i]},
                     &job->scratch[worker]);
        add_direct(r, &p, NULL, &job->scratch[worker], E);
        const float diffuse =
            r->material.model == REFLECT_LAMBERT ? 1 : 1 - p.material.theta[DISNEY_METALLIC];
        for (int c = 0; c < 3; c++)
            r->radiosity.data[3 * (size_t)t->pixel[i] + (size_t)c] =
                E[c] * p.material.albedo[c] * diffuse * (float)M_1_PI;
    }
}

static int make_radiosity(struct renderer *r)
{
    struct texels texels = {0};
    struct scratch *scratch = NULL;
    const int size = r->settings.bounce_texture, n_workers = n_workers_of(r);
    int err = texels_rasterise(&texels, r->mesh, size);
    if (err)
        return err;
    err = image_new(&r->radiosity, size, size, 3, NULL);
    if (err)
        goto done;
    err = -ENOMEM;
    scratch = scratch_new(r, n_workers);
    if (!scratch)
        goto done;
    struct radiosity_job job = {r, &texels, scratch,
                                random_mix(r->settings.seed ^ 0x7261646975736974u)};
    parallel_for(n_workers, texels.n, 64, light_texels, &job);
    err = texels_fill_gutter(&texels, r->radiosity.data, 3, GUTTER_PX);
done:
    scratch_free(scratch, n_workers);
    texels_free(&texels);
    return err;
}

// ---- the renderer -------------------------------------------------------------------------------

static int find_channels(const struct image *texture, const char *what, const char *const *names,
                         int n, int *channel)
{
    for (int i = 0; texture && i < n; i++) {
        channel[i] = image_channel(texture, names[i]);
        if (channel[i] < 0) {
            log_error("render: the %s texture has no channel '%s'; it needs %d channels named as "
                      "in brdf.exr or R, G, B",
                      what, names[i], n);
            return -EINVAL;
        }
    }
    return 0;
}

int renderer_new(struct renderer **out, const struct mesh *mesh, const struct rays *rays,
                 const struct lights *lights, const struct render_material *material,
                 const struct render_settings *settings)
{
    static const char *const rgb[3] = {"R", "G", "B"};
    *out = NULL;
    struct renderer *r = calloc(1, sizeof(*r));
    if (!r)
        return -ENOMEM;
    r->mesh = mesh, r->rays = rays, r->material = *material, r->settings = *settings;
    assert(settings->samples >= 1 && settings->shadow_rays >= 0 && settings->bounce_rays >= 0);
    assert(settings->shadow_rays < GROUP_INDEX_STEP / 8 &&
           settings->bounce_rays <= MAX_BOUNCE_RAYS);
    if (r->material.model == REFLECT_LAMBERT)
        r->material.parameters = NULL;
    r->kernels = kernels_select(KERNELS_ALL);
    int err = find_channels(r->material.albedo, "albedo", rgb, 3, r->albedo_channel);
    if (!err)
        err = find_channels(r->material.parameters, "BRDF", disney_parameter_names, DISNEY_N,
                            r->theta_channel);
    if (!err)
        err = prepare_lights(r, lights);
    if (!err && settings->bounce_rays > 0)
        err = make_radiosity(r);
    if (err) {
        renderer_free(r);
        return err;
    }
    *out = r;
    return 0;
}

void renderer_free(struct renderer *r)
{
    if (!r)
        return;
    light_arrays_free(&r->lights);
    free(r->cumulative), free(r->tile);
    image_free(&r->radiosity);
    free(r);
}

// ---- pictures -----------------------------------------------------------------------------------

struct view_job {
    const struct renderer *renderer;
    const struct camera *camera;
    struct image *out;
    struct scratch *scratch;
    float eye_m[3];
    uint64_t seed;
};

static bool see(const struct view_job *job, double x_px, double y_px, struct point *p)
{
    const struct renderer *r = job->renderer;
    double dir[3];
    struct ray_hit hit;
    if (!camera_ray(job->camera, (const double[2]){x_px, y_px}, dir))
        return false;
    const float dirf[3] = {(float)dir[0], (float)dir[1], (float)dir[2]};
    if (!rays_hit(r->rays, job->eye_m, dirf, 0, INFINITY, &hit))
        return false;
    return get_point(r, hit.triangle, (const float[2]){hit.u, hit.v}, p);
}

// Do p and the pixel's centre lie on one smooth piece of one material?
static bool alike(const struct view_job *job, const struct point *p, const struct point *centre)
{
    double away = 0, distance = 0;
    for (int i = 0; i < 3; i++) {
        away += pow((double)p->surface.position_m[i] - centre->surface.position_m[i], 2);
        distance += pow((double)job->eye_m[i] - centre->surface.position_m[i], 2);
    }
    const double pixel_m = sqrt(distance) / fmin(job->camera->fx, job->camera->fy);
    if (sqrt(away) > 3 * pixel_m || dot3f(p->surface.normal, centre->surface.normal) < .999f)
        return false;
    for (int k = 0; k < DISNEY_N; k++)
        if (fabsf(p->material.theta[k] - centre->material.theta[k]) > .005f)
            return false;
    return true;
}

static void render_pixel(const struct view_job *job, int x, int y, struct scratch *scratch,
                         float rgba[4])
{
    const struct renderer *r = job->renderer;
    const int n = r->settings.samples, n_samples = n * n;
    const uint64_t first_stream =
        ((uint64_t)y * (uint64_t)job->camera->width_px + (uint64_t)x) * (uint64_t)(n_samples + 1);
    double sum[3] = {0}, albedo[3] = {0};
    int n_hits = 0;
    struct point p, centre;
    bool once = n > 1 && !r->settings.shade_every_sample && see(job, x + .5, y + .5, &centre);
    for (int k = 0; once && k < n_samples; k++) {
        once = see(job, x + (k % n + .5) / n, y + (k / n + .5) / n, &p) && alike(job, &p, &centre);
        for (int c = 0; once && c < 3; c++)
            albedo[c] += p.material.albedo[c];
    }
    if (once) {
        for (int c = 0; c < 3; c++)
            centre.material.albedo[c] = (float)(albedo[c] / n_samples);
        shade_point(r, &centre, job->eye_m,
                    (struct stream){job->seed, first_stream + (uint64_t)n_samples}, scratch, rgba);
        rgba[3] = 1;
        return;
    }
    for (int k = 0; k < n_samples; k++) {
        float L[3];
        if (!see(job, x + (k % n + .5) / n, y + (k / n + .5) / n, &p))
            continue;
        n_hits++;
        shade_point(r, &p, job->eye_m, (struct stream){job->seed, first_stream + (uint64_t)k},
                    scratch, L);
        for (int c = 0; c < 3; c++)
            sum[c] += L[c];
    }
    for (int c = 0; c < 3; c++)
        rgba[c] = (float)(sum[c] / n_samples);
    rgba[3] = (float)n_hits / (float)n_samples;
}

static void render_rows(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct view_job *job = arg;
    for (int64_t y = begin; y < end; y++)
        for (int x = 0; x < job->out->width; x++)
            render_pixel(job, x, (int)y, &job->scratch[worker],
                         job->out->data + 4 * ((size_t)y * (size_t)job->out->width + (size_t)x));
    if (job->renderer->settings.count_rows)
        progress_add(end - begin);
}

static uint64_t hash_name(const char *name)
{
    uint64_t h = 0xcbf29ce484222325u; // FNV-1a
    for (; *name; name++)
        h = (h ^ (unsigned char)*name) * 0x100000001b3u;
    return h;
}

int render_view(const struct renderer *r, const struct camera *camera, struct image *out)
{
    static const char *const names[4] = {"R", "G", "B", "A"};
    const int n_workers = n_workers_of(r);
    int err = image_new(out, camera->width_px, camera->height_px, 4, names);
    if (err)
        return err;
    struct view_job job = {
        .renderer = r, .camera = camera, .out = out, .scratch = scratch_new(r, n_workers)};
    if (!job.scratch) {
        image_free(out);
        return -ENOMEM;
    }
    job.seed = random_mix(r->settings.seed ^ hash_name(camera->name));
    for (int i = 0; i < 3; i++)
        job.eye_m[i] = (float)camera->centre_m[i];
    parallel_for(n_workers, camera->height_px, 1, render_rows, &job);
    scratch_free(job.scratch, n_workers);
    return 0;
}
