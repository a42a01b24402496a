// solver/mirrored.c - a few rays per sample along its mirrored lobe, each bringing back what leaves the place it meets.
#include "solver/mirrored.h"

#include "solver/interreflection.h"
#include "solver/parallel.h"
#include "solver/random.h"
#include "solver/surface.h"
#include "solver/take/half.h"
#include "solver/vec3.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

struct job {
    const struct mirrored *m;
    const struct kernels *kernels;
    struct light_arrays lights;
    struct lit *lit; // [threads]
    float (*radiance)[3];
};

// The texel at a place of the surface, or one beside it; -1: the atlas has none there.
static int32_t texel_at(const struct mirrored *m, const struct ray_hit *hit)
{
    const struct mesh *mesh = m->mesh;
    const struct texels *t = m->texels;
    const uint32_t *v = mesh->triangle[hit->triangle];
    const float w = 1 - hit->u - hit->v;
    const float u = w * mesh->uv[v[0]][0] + hit->u * mesh->uv[v[1]][0] + hit->v * mesh->uv[v[2]][0];
    const float up = w * mesh->uv[v[0]][1] + hit->u * mesh->uv[v[1]][1] + hit->v * mesh->uv[v[2]][1];
    const int x = (int)floorf(u * (float)t->size), y = (int)floorf((1 - up) * (float)t->size);
    for (int k = 0; k < 9; k++) {
        static const int order[9][2] = { { 0, 0 }, { 1, 0 }, { -1, 0 }, { 0, 1 }, { 0, -1 }, { 1, 1 }, { -1, 1 }, { 1, -1 }, { -1, -1 } };
        const int px = x + order[k][0], py = y + order[k][1];
        if (px >= 0 && py >= 0 && px < t->size && py < t->size && t->index[py * t->size + px] >= 0)
            return t->index[py * t->size + px];
    }
    return -1;
}

// Radiance that leaves a texel towards `to` (unit). False: its back.
static bool leaving(const struct job *j, struct lit *lit, int texel, const float to[3], float L[3])
{
    const struct mirrored *m = j->m;
    struct surface_point s;
    struct shade_material material = { .variant = m->variant };
    surface_of_texel(&s, m->texels, texel);
    if (s.normal[0] * to[0] + s.normal[1] * to[1] + s.normal[2] * to[2] <= 0)
        return false;
    memcpy(material.theta, m->theta[texel], sizeof(material.theta));
    memcpy(material.albedo, m->albedo[texel], sizeof(material.albedo));
    j->kernels->gather(lit, &j->lights, &s, m->visible ? m->visible + (size_t)texel * (size_t)m->words_per_texel : NULL,
                       m->soft ? m->soft + (size_t)texel * (size_t)m->lights->n : NULL);
    j->kernels->shade(L, lit, &s, to, &material);
    for (int c = 0; m->indirect && c < 3; c++)
        L[c] += indirect_constant(m->indirect[texel][c], material.theta) + indirect_own(m->indirect[texel][c]) * material.albedo[c];
    return true;
}

static void specular_colour(const float theta[DISNEY_N], const float albedo[3], double F0[3])
{
    const double luminance = .3 * (double)albedo[0] + .6 * (double)albedo[1] + .1 * (double)albedo[2], metallic = (double)theta[DISNEY_METALLIC];
    for (int c = 0; c < 3; c++) {
        const double tint = luminance > 0 ? (double)albedo[c] / luminance : 1;
        const double plain = .08 * (double)theta[DISNEY_SPECULAR] * (1 + (double)theta[DISNEY_SPECULAR_TINT] * (tint - 1));
        F0[c] = plain + metallic * ((double)albedo[c] - plain);
    }
}

// Half vectors are drawn by D <n,h>, so a ray's weight is F G <n,l> 4 <v,h> / <n,h>.
static void gather_texels(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct job *j = arg;
    const struct mirrored *m = j->m;
    for (int t = (int)begin; t < (int)end; t++) {
        struct surface_point s;
        float start[3];
        double F0[3];
        surface_of_texel(&s, m->texels, t);
        rays_start(m->rays, m->texels->triangle[t], m->texels->barycentric[t], start);
        specular_colour(m->theta[t], m->albedo[t], F0);
        const double r = (double)m->theta[t][DISNEY_ROUGHNESS], a2 = fmax(r * r, .001) * fmax(r * r, .001);
        for (int64_t i = m->samples->first[t]; i < m->samples->first[t + 1]; i++) {
            float to_view[3];
            double v[3], sum[3] = { 0 };
            samples_view_direction(m->samples, m->texels, t, m->samples->view[i], to_view);
            v[0] = v[1] = v[2] = 0;
            for (int c = 0; c < 3; c++) {
                v[0] += (double)(s.tangent[c] * to_view[c]), v[1] += (double)(s.bitangent[c] * to_view[c]);
                v[2] += (double)(s.normal[c] * to_view[c]);
            }
            const double shift = random_uniform(13, (uint64_t)i, 0), turn = random_uniform(13, (uint64_t)i, 1);
            const double gv = 1 / (v[2] + sqrt(a2 + v[2] * v[2] * (1 - a2)));
            for (int k = 0; k < m->n_rays && v[2] > 0; k++) { // a spiral (Fibonacci), turned from sample to sample
                const double u = (k + shift) / m->n_rays, phi = 2 * M_PI * (k * .6180339887498949 + turn);
                const double nh = sqrt((1 - u) / (1 + (a2 - 1) * u)), side = sqrt(fmax(1 - nh * nh, 0));
                const double h[3] = { side * cos(phi), side * sin(phi), nh }, vh = vec3_dot(v, h);
                const double l[3] = { 2 * vh * h[0] - v[0], 2 * vh * h[1] - v[1], 2 * vh * h[2] - v[2] };
                struct ray_hit hit;
                float dir[3], back[3], L[3];
                if (!(vh > 0) || !(l[2] > 1e-3))
                    continue;
                for (int c = 0; c < 3; c++)
                    dir[c] = (float)(l[0] * (double)s.tangent[c] + l[1] * (double)s.bitangent[c] + l[2] * (double)s.normal[c]), back[c] = -dir[c];
                if (!rays_hit(m->rays, start, dir, 0, INFINITY, &hit))
                    continue;
                const int32_t met = texel_at(m, &hit);
                if (met < 0 || !leaving(j, &j->lit[worker], met, back, L))
                    continue;
                const double weight = 4 * vh * l[2] / nh * gv / (l[2] + sqrt(a2 + l[2] * l[2] * (1 - a2))), grazing = pow(1 - fmin(vh, 1), 5);
                for (int c = 0; c < 3; c++)
                    sum[c] += weight * (F0[c] + (1 - F0[c]) * grazing) * (double)L[c];
            }
            for (int c = 0; c < 3; c++)
                j->radiance[i][c] = (float)(sum[c] / m->n_rays);
        }
    }
}

int mirrored_gather(const struct mirrored *m, float (*radiance)[3])
{
    const int n_workers = m->n_threads > 0 ? m->n_threads : parallel_n_cores();
    struct job j = { .m = m, .kernels = kernels_select(KERNELS_ALL), .lit = calloc((size_t)n_workers, sizeof(*j.lit)), .radiance = radiance };
    int err = j.lit ? light_arrays_new(&j.lights, m->lights) : -ENOMEM;
    for (int i = 0; !err && i < n_workers; i++)
        err = lit_new(&j.lit[i], m->lights->n);
    if (!err)
        parallel_for(n_workers, m->texels->n, 64, gather_texels, &j);
    for (int i = 0; j.lit && i < n_workers; i++)
        lit_free(&j.lit[i]);
    light_arrays_free(&j.lights);
    free(j.lit);
    return err;
}

int mirrored_take_off(struct samples *out, const struct samples *samples, const float (*radiance)[3])
{
    *out = *samples;
    out->radiance = malloc(((size_t)samples->n + 1) * sizeof(*out->radiance));
    if (!out->radiance)
        return -ENOMEM;
    for (int64_t i = 0; i < samples->n; i++)
        for (int c = 0; c < 3; c++)
            out->radiance[i][c] = half_from_float(float_from_half(samples->radiance[i][c]) - radiance[i][c]);
    return 0;
}
