// solver/interreflection.c - a few rays per texel, each bringing back what the texel it meets reflects.
#include "solver/interreflection.h"

#include "solver/parallel.h"
#include "solver/random.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

struct job {
    const struct interreflection *s;
    float (*radiosity)[3]; // [n_texels] reflectance x irradiance
    float (*indirect)[3];  // in: of the bounces so far
};

static void surface_of(struct surface_point *out, const struct texels *t, int texel)
{
    memcpy(out->position_m, t->position_m[texel], sizeof(out->position_m));
    memcpy(out->normal, t->normal[texel], sizeof(out->normal));
    memcpy(out->tangent, t->tangent[texel], sizeof(out->tangent));
    const float *n = out->normal, *x = out->tangent;
    out->bitangent[0] = n[1] * x[2] - n[2] * x[1];
    out->bitangent[1] = n[2] * x[0] - n[0] * x[2];
    out->bitangent[2] = n[0] * x[1] - n[1] * x[0];
}

static void send(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct job *j = arg;
    (void)worker;
    for (int t = (int)begin; t < (int)end; t++) {
        struct surface_point p;
        float E[3];
        surface_of(&p, j->s->texels, t);
        j->s->kernels->irradiance(E, j->s->lights, &p, j->s->visible ? j->s->visible + (size_t)t * (size_t)j->s->words_per_texel : NULL);
        for (int c = 0; c < 3; c++)
            j->radiosity[t][c] = j->s->diffuse[t][c] * (E[c] + j->indirect[t][c]);
    }
}

// The texel at a place of the surface, or one beside it; -1: the atlas has none there.
static int32_t texel_at(const struct job *j, const struct ray_hit *hit)
{
    const struct mesh *m = j->s->mesh;
    const struct texels *t = j->s->texels;
    const uint32_t *v = m->triangle[hit->triangle];
    const float w = 1 - hit->u - hit->v;
    const float u = w * m->uv[v[0]][0] + hit->u * m->uv[v[1]][0] + hit->v * m->uv[v[2]][0];
    const float up = w * m->uv[v[0]][1] + hit->u * m->uv[v[1]][1] + hit->v * m->uv[v[2]][1];
    const int x = (int)floorf(u * (float)t->size), y = (int)floorf((1 - up) * (float)t->size);
    for (int k = 0; k < 9; k++) {
        static const int order[9][2] = { { 0, 0 }, { 1, 0 }, { -1, 0 }, { 0, 1 }, { 0, -1 }, { 1, 1 }, { -1, 1 }, { 1, -1 }, { -1, -1 } };
        const int px = x + order[k][0], py = y + order[k][1];
        if (px >= 0 && py >= 0 && px < t->size && py < t->size && t->index[py * t->size + px] >= 0)
            return t->index[py * t->size + px];
    }
    return -1;
}

static void receive(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct job *j = arg;
    const struct texels *t = j->s->texels;
    (void)worker;
    for (int i = (int)begin; i < (int)end; i++) {
        struct surface_point p;
        float start[3];
        double sum[3] = { 0 };
        surface_of(&p, t, i);
        rays_start(j->s->rays, t->triangle[i], t->barycentric[i], start);
        const double shift = random_uniform(11, (uint64_t)i, 0), turn = random_uniform(11, (uint64_t)i, 1);
        for (int k = 0; k < j->s->n_rays; k++) { // a spiral (Fibonacci), turned from texel to texel
            const double u = (k + shift) / j->s->n_rays, phi = 2 * M_PI * (k * .6180339887498949 + turn);
            const float s = (float)sqrt(u), z = (float)sqrt(1 - u), x = s * (float)cos(phi), y = s * (float)sin(phi);
            float dir[3];
            struct ray_hit hit;
            for (int c = 0; c < 3; c++)
                dir[c] = x * p.tangent[c] + y * p.bitangent[c] + z * p.normal[c];
            if (!rays_hit(j->s->rays, start, dir, 0, INFINITY, &hit))
                continue;
            const int32_t met = texel_at(j, &hit);
            if (met < 0)
                continue;
            const float *n = t->normal[met];
            if (n[0] * dir[0] + n[1] * dir[1] + n[2] * dir[2] >= 0) // its back
                continue;
            for (int c = 0; c < 3; c++)
                sum[c] += (double)j->radiosity[met][c];
        }
        for (int c = 0; c < 3; c++)
            j->indirect[i][c] = (float)(sum[c] / j->s->n_rays);
    }
}

int interreflection_gather(const struct interreflection *s, float (*indirect)[3])
{
    const size_t n = (size_t)s->texels->n + 1;
    struct job j = { .s = s, .radiosity = malloc(n * sizeof(*j.radiosity)), .indirect = indirect };
    if (!j.radiosity)
        return -ENOMEM;
    parallel_for(s->n_threads, s->texels->n, 256, send, &j); // reads all of `indirect` ahead of what receive writes
    parallel_for(s->n_threads, s->texels->n, 256, receive, &j);
    free(j.radiosity);
    return 0;
}
