// solver/interreflection.c - a few hundred rays per place, each bringing back what the part of the texture it meets reflects.
//
// What is sent back is looked up in a picture of the atlas, which is no finer than the places where light is gathered: so a
// ray brings the mean of what lies around the point it meets, and detail of the albedo does not become noise of the light.
#include "solver/interreflection.h"

#include "solver/parallel.h"
#include "solver/random.h"
#include "solver/surface.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

static const float alike_cos = .8f; // a texel does not take over light from a place whose normal is further off
static const float enough = .3f;    // share of the four places around it that a texel must be able to use

enum { CHUNK = 64 };

struct job {
    const struct interreflection *s;
    const struct texels *places;  // where light is gathered: s->texels, or coarser ones
    int size;                     // of the picture of what is sent back
    float (*sent)[3];             // [n_texels] reflectance x irradiance
    float (*radiosity)[3];        // [size * size] its mean
    int32_t *count;               // [size * size] of so many texels; 0: none there
    float (*received)[3];         // [places->n]
    float (*indirect)[3];         // [n_texels] in: of the bounces so far
};

// ---- what is sent -------------------------------------------------------------------------------

struct sender {
    const struct job *job;
    struct lit *lit; // [workers]; only with soft
};

static void send(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct sender *a = arg;
    const struct job *j = a->job;
    const struct interreflection *s = j->s;
    for (int t = (int)begin; t < (int)end; t++) {
        struct surface_point p;
        float E[3] = { 0 };
        surface_of_texel(&p, s->texels, t);
        if (s->soft) {
            struct lit *lit = &a->lit[worker];
            s->kernels->gather(lit, s->lights, &p, NULL, s->soft + (size_t)t * (size_t)s->lights->n);
            for (int i = 0; i < lit->n; i++)
                E[0] += lit->wr[i], E[1] += lit->wg[i], E[2] += lit->wb[i];
        } else {
            s->kernels->irradiance(E, s->lights, &p, s->visible ? s->visible + (size_t)t * (size_t)s->words_per_texel : NULL);
        }
        for (int c = 0; c < 3; c++)
            j->sent[t][c] = s->diffuse[t][c] * (E[c] + j->indirect[t][c]);
    }
}

static int send_all(const struct job *j)
{
    const int n_workers = j->s->n_threads > 0 ? j->s->n_threads : parallel_n_cores();
    struct sender a = { .job = j, .lit = calloc((size_t)n_workers, sizeof(*a.lit)) };
    int err = a.lit ? 0 : -ENOMEM;
    for (int i = 0; !err && j->s->soft && i < n_workers; i++)
        err = lit_new(&a.lit[i], j->s->lights->n_padded);
    if (!err)
        parallel_for(n_workers, j->s->texels->n, CHUNK, send, &a);
    for (int i = 0; a.lit && i < n_workers; i++)
        lit_free(&a.lit[i]);
    free(a.lit);
    return err;
}

static void average(const struct job *j)
{
    const struct texels *t = j->s->texels;
    for (int i = 0; i < t->n; i++) {
        const int64_t x = t->pixel[i] % (uint32_t)t->size, y = t->pixel[i] / (uint32_t)t->size;
        const int64_t at = y * j->size / t->size * j->size + x * j->size / t->size;
        for (int c = 0; c < 3; c++)
            j->radiosity[at][c] += j->sent[i][c];
        j->count[at]++;
    }
    for (int64_t at = 0; at < (int64_t)j->size * j->size; at++)
        for (int c = 0; j->count[at] && c < 3; c++)
            j->radiosity[at][c] /= (float)j->count[at];
}

// ---- what arrives -------------------------------------------------------------------------------

// What the surface sends back where a ray along dir meets it. False: nothing, or its back.
static bool sent_from(const struct job *j, const struct ray_hit *hit, const float dir[3], const float **out)
{
    static const int order[9][2] = { { 0, 0 }, { 1, 0 }, { -1, 0 }, { 0, 1 }, { 0, -1 }, { 1, 1 }, { -1, 1 }, { 1, -1 }, { -1, -1 } };
    const struct mesh *m = j->s->mesh;
    const uint32_t *v = m->triangle[hit->triangle];
    const float weight[3] = { 1 - hit->u - hit->v, hit->u, hit->v };
    float uv[2] = { 0 }, towards = 0;
    for (int k = 0; k < 3; k++) {
        for (int i = 0; i < 2; i++)
            uv[i] += weight[k] * m->uv[v[k]][i];
        for (int i = 0; i < 3; i++)
            towards += weight[k] * (float)m->normal[v[k]][i] * dir[i];
    }
    if (towards >= 0)
        return false;
    const int x = (int)floorf(uv[0] * (float)j->size), y = (int)floorf((1 - uv[1]) * (float)j->size);
    for (int k = 0; k < 9; k++) { // there, or beside it: the atlas may have no texel just there
        const int px = x + order[k][0], py = y + order[k][1];
        if (px >= 0 && py >= 0 && px < j->size && py < j->size && j->count[py * j->size + px]) {
            *out = j->radiosity[py * j->size + px];
            return true;
        }
    }
    return false;
}

static void gather_at(const struct job *j, const struct texels *t, int i, float out[3])
{
    struct surface_point p;
    float start[3];
    double sum[3] = { 0 };
    surface_of_texel(&p, t, i);
    rays_start(j->s->rays, t->triangle[i], t->barycentric[i], start);
    const double shift = random_uniform(11, (uint64_t)i, 0), turn = random_uniform(11, (uint64_t)i, 1);
    for (int k = 0; k < j->s->n_rays; k++) { // a spiral (Fibonacci), turned from texel to texel
        const double u = (k + shift) / j->s->n_rays, phi = 2 * M_PI * (k * .6180339887498949 + turn);
        const float s = (float)sqrt(u), z = (float)sqrt(1 - u), x = s * (float)cos(phi), y = s * (float)sin(phi);
        float dir[3];
        const float *sent;
        struct ray_hit hit;
        for (int c = 0; c < 3; c++)
            dir[c] = x * p.tangent[c] + y * p.bitangent[c] + z * p.normal[c];
        if (rays_hit(j->s->rays, start, dir, 0, INFINITY, &hit) && sent_from(j, &hit, dir, &sent))
            for (int c = 0; c < 3; c++)
                sum[c] += (double)sent[c];
    }
    for (int c = 0; c < 3; c++)
        out[c] = (float)(sum[c] / j->s->n_rays);
}

static void receive(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct job *j = arg;
    (void)worker;
    for (int64_t i = begin; i < end; i++)
        gather_at(j, j->places, (int)i, j->received[i]);
}

// Bilinear between the four places around a texel that belong to its piece of surface; its own rays where those are too few.
static void interpolate(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct job *j = arg;
    const struct texels *t = j->s->texels, *c = j->places;
    (void)worker;
    for (int i = (int)begin; i < (int)end; i++) {
        const float scale = (float)c->size / (float)t->size, *n = t->normal[i];
        const float x = ((float)(t->pixel[i] % (uint32_t)t->size) + .5f) * scale - .5f, y = ((float)(t->pixel[i] / (uint32_t)t->size) + .5f) * scale - .5f;
        const int x0 = (int)floorf(x), y0 = (int)floorf(y);
        float sum[3] = { 0 }, total = 0;
        for (int k = 0; k < 4; k++) {
            const int px = x0 + k % 2, py = y0 + k / 2;
            const int32_t at = px < 0 || py < 0 || px >= c->size || py >= c->size ? -1 : c->index[py * c->size + px];
            if (at < 0 || c->chart[at] != t->chart[i] || n[0] * c->normal[at][0] + n[1] * c->normal[at][1] + n[2] * c->normal[at][2] < alike_cos)
                continue;
            const float w = (k % 2 ? x - (float)x0 : 1 - x + (float)x0) * (k / 2 ? y - (float)y0 : 1 - y + (float)y0);
            for (int channel = 0; channel < 3; channel++)
                sum[channel] += w * j->received[at][channel];
            total += w;
        }
        for (int channel = 0; total >= enough && channel < 3; channel++)
            j->indirect[i][channel] = sum[channel] / total;
        if (total < enough)
            gather_at(j, t, i, j->indirect[i]);
    }
}

int interreflection_gather(const struct interreflection *s, float (*indirect)[3])
{
    struct texels coarse = { 0 };
    const bool between = s->size > 0 && s->size < s->texels->size;
    struct job j = { .s = s, .places = between ? &coarse : s->texels, .size = between ? s->size : s->texels->size, .indirect = indirect };
    const size_t n_pixels = (size_t)j.size * (size_t)j.size;
    int err = between ? texels_rasterise(&coarse, s->mesh, s->size) : 0;
    j.sent = malloc(((size_t)s->texels->n + 1) * sizeof(*j.sent));
    j.radiosity = calloc(n_pixels, sizeof(*j.radiosity)), j.count = calloc(n_pixels, sizeof(*j.count));
    j.received = malloc(((size_t)j.places->n + 1) * sizeof(*j.received));
    if (!err && (!j.sent || !j.radiosity || !j.count || !j.received))
        err = -ENOMEM;
    if (!err)
        err = send_all(&j); // reads all of `indirect` ahead of what is written below
    if (!err) {
        average(&j);
        parallel_for(s->n_threads, j.places->n, CHUNK, receive, &j);
        if (between)
            parallel_for(s->n_threads, s->texels->n, CHUNK, interpolate, &j);
        else
            memcpy(indirect, j.received, (size_t)s->texels->n * sizeof(*indirect));
    }
    free(j.sent), free(j.radiosity), free(j.count), free(j.received);
    texels_free(&coarse);
    return err;
}
