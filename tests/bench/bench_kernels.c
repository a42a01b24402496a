// tests/bench/bench_kernels.c - `make bench`: what a sample costs, per kernel, beside Ceres' automatic differentiation.
//
// CPU seconds of one thread per million (sample x light), L and its 13-column Jacobian unless said. A studio of 256 lights on a cuboid of
// 3.6 x 2.4 x 1.2 m (near field); texels on a ball of .1 m radius, each with a material of its own and 28 views from 1.8 m; roughness from .2 to
// .9. Pairs are counted before compaction: samples x 256. Nothing is hidden; about half of the lights are below a texel's horizon. Every
// round runs every way once, so that they share the machine's moods; medians over the rounds. Option: --json.
#include "solver/kernels/kernels.h"
#include "solver/random.h"
#include "solver/vec3.h"

#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { N_LIGHTS = 256, N_VIEWS = 28, N_TEXELS = 64, N_ROUNDS = 15 };

// ceres_peer.cc, where libceres-dev is.
__attribute__((weak)) void ceres_peer_jacobian(double L[3], double jacobian[3][13], int form, const double (*lights)[7], int n,
                                               const double centre[3], const double position[3],
                                               const double frame_rows[9], const double view[3],
                                               const double theta[10], const double albedo[3]);

struct texel {
    struct surface_point surface;
    struct shade_material material;
    float view[N_VIEWS][3];
};

static struct light_arrays lights;
static struct lit lit;
static _Alignas(64) float by_inverse_distance[3][N_LIGHTS];
static struct shade_setup setup = {
    .inverse_distance = { by_inverse_distance[0], by_inverse_distance[1], by_inverse_distance[2] },
};
static struct texel texels[N_TEXELS];
static volatile float sink;

static void normal_direction(double d[3], uint64_t stream, uint64_t index)
{
    for (int c = 0; c < 3; c++)
        d[c] = random_normal(1, stream, 3 * index + (uint64_t)c);
    vec3_normalise(d);
}

static void build_studio(void)
{
    static double direction[N_LIGHTS][3], irradiance[N_LIGHTS][3], inverse_distance[N_LIGHTS];
    const struct lights l = { .n = N_LIGHTS, .dir_probe = direction, .irradiance = irradiance,
                              .inverse_distance = inverse_distance, .world_from_probe = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
    static const double half_m[3] = { 1.8, 1.2, .6 };
    for (uint64_t i = 0; i < N_LIGHTS; i++) {
        normal_direction(direction[i], 1, i);
        double distance_m = INFINITY;
        for (int c = 0; c < 3; c++) {
            distance_m = fmin(distance_m, half_m[c] / fabs(direction[i][c]));
            irradiance[i][c] = (.5 + random_uniform(1, 2, 3 * i + (uint64_t)c)) / N_LIGHTS;
        }
        inverse_distance[i] = 1 / distance_m;
    }
    if (light_arrays_new(&lights, &l) || lit_new(&lit, N_LIGHTS))
        exit(EXIT_FAILURE);
    for (uint64_t t = 0; t < N_TEXELS; t++) {
        struct texel *texel = &texels[t];
        double n[3], x[3], y[3], v[3];
        normal_direction(n, 3, t), normal_direction(x, 4, t);
        vec3_add_scaled(x, x, -vec3_dot(x, n), n);
        vec3_normalise(x);
        vec3_cross(y, n, x);
        for (int c = 0; c < 3; c++) {
            texel->surface.position_m[c] = (float)(.1 * n[c]), texel->surface.normal[c] = (float)n[c];
            texel->surface.tangent[c] = (float)x[c], texel->surface.bitangent[c] = (float)y[c];
            texel->material.albedo[c] = (float)random_uniform(1, 5, 3 * t + (uint64_t)c);
        }
        for (uint64_t i = 0; i < DISNEY_N; i++)
            texel->material.theta[i] = (float)random_uniform(1, 6, DISNEY_N * t + i);
        texel->material.theta[DISNEY_ROUGHNESS] = (float)(.2 + .7 * random_uniform(1, 7, t));
        for (uint64_t i = 0, k = 0; i < N_VIEWS; k++) {
            normal_direction(v, 8 + t, k);
            for (int c = 0; c < 3; c++)
                v[c] = 1.8 * v[c] - .1 * n[c];
            vec3_normalise(v);
            if (vec3_dot(v, n) < .15)
                continue;
            for (int c = 0; c < 3; c++)
                texel->view[i][c] = (float)v[c];
            i++;
        }
    }
}

enum way { BRUTE, SHARED, VIEWS, VALUE, AFFINE, SETUP, GATHER, PEER_PLAIN, PEER_FIXED, PEER_CAREFUL };
struct method {
    const char *kernel, *what;
    enum way way;
    int n_texels, n_views; // how much of the studio one round takes
    double seconds[N_ROUNDS], median;
};
static struct method methods[] = {
    { "ceres", "Jet<double,13>, plain", PEER_PLAIN, 2, 4, { 0 }, 0 },
    { "ceres", "Jet<double,13>, fixed", PEER_FIXED, 2, 4, { 0 }, 0 },
    { "ceres", "Jet<double,13>, careful", PEER_CAREFUL, 2, 4, { 0 }, 0 },
    { "reference", "brute", BRUTE, 2, 8, { 0 }, 0 },
    { "portable", "brute", BRUTE, 32, N_VIEWS, { 0 }, 0 },
    { "avx2", "brute", BRUTE, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "avx512", "brute", BRUTE, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "portable", "gathered per texel, exact", SHARED, 32, N_VIEWS, { 0 }, 0 },
    { "avx2", "gathered per texel, exact", SHARED, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "avx512", "gathered per texel, exact", SHARED, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "portable", "shared by all views, exact", VIEWS, 32, N_VIEWS, { 0 }, 0 },
    { "portable", "shared, value only", VALUE, 32, N_VIEWS, { 0 }, 0 },
    { "portable", "shared, affine in albedo", AFFINE, 32, N_VIEWS, { 0 }, 0 },
    { "portable", "shared, and by the set-up", SETUP, 32, N_VIEWS, { 0 }, 0 },
    { "avx2", "shared by all views, exact", VIEWS, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "avx2", "shared, value only", VALUE, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "avx2", "shared, affine in albedo", AFFINE, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "avx2", "shared, and by the set-up", SETUP, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "avx512", "shared by all views, exact", VIEWS, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "avx512", "shared, value only", VALUE, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "avx512", "shared, affine in albedo", AFFINE, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "avx512", "shared, and by the set-up", SETUP, N_TEXELS, N_VIEWS, { 0 }, 0 },
    { "portable", "gather alone, 1 view", GATHER, N_TEXELS, 1, { 0 }, 0 },
    { "avx2", "gather alone, 1 view", GATHER, N_TEXELS, 1, { 0 }, 0 },
    { "avx512", "gather alone, 1 view", GATHER, N_TEXELS, 1, { 0 }, 0 },
};
enum { N_METHODS = sizeof(methods) / sizeof(methods[0]) };

static double cpu_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void peer(double L[3], double jacobian[3][13], int form, const struct texel *t, const float view[3])
{
    static double rows[N_LIGHTS][7];
    if (rows[0][0] == 0)
        for (int i = 0; i < N_LIGHTS; i++) {
            const double row[7] = { (double)lights.dx[i], (double)lights.dy[i], (double)lights.dz[i], (double)lights.q[i],
                                    (double)lights.cr[i], (double)lights.cg[i], (double)lights.cb[i] };
            memcpy(rows[i], row, sizeof(row));
        }
    double centre[3], position[3], frame[9], v[3], theta[DISNEY_N], albedo[3];
    for (int c = 0; c < 3; c++) {
        centre[c] = (double)lights.centre_m[c], position[c] = (double)t->surface.position_m[c], v[c] = (double)view[c];
        frame[c] = (double)t->surface.tangent[c], frame[3 + c] = (double)t->surface.bitangent[c];
        frame[6 + c] = (double)t->surface.normal[c], albedo[c] = (double)t->material.albedo[c];
    }
    for (int i = 0; i < DISNEY_N; i++)
        theta[i] = (double)t->material.theta[i];
    ceres_peer_jacobian(L, jacobian, form, rows, N_LIGHTS, centre, position, frame, v, theta, albedo);
}

static double run(const struct method *m)
{
    const struct kernels *k = m->way >= PEER_PLAIN ? NULL : kernels_by_name(m->kernel);
    const double begin = cpu_s();
    for (int t = 0; t < m->n_texels; t++) {
        const struct texel *texel = &texels[t];
        if (m->way == SHARED || m->way == VIEWS || m->way == VALUE || m->way == AFFINE || m->way == SETUP ||
            m->way == GATHER)
            k->gather(&lit, &lights, &texel->surface, NULL, NULL);
        if (m->way == VIEWS) {
            struct shade_jacobian j[N_VIEWS];
            k->shade_jacobian_views(j, m->n_views, &lit, &texel->surface, texel->view, &texel->material);
            sink = j[m->n_views - 1].L[0];
        }
        for (int i = 0; i < m->n_views && m->way != GATHER && m->way != VIEWS; i++) {
            struct shade_jacobian j;
            double L[3], jacobian[3][13];
            if (m->way == BRUTE)
                k->brute_jacobian(&j, &lights, &texel->surface, texel->view[i], &texel->material);
            else if (m->way == SHARED)
                k->shade_jacobian(&j, &lit, &texel->surface, texel->view[i], &texel->material);
            else if (m->way == VALUE)
                k->shade(j.L, &lit, &texel->surface, texel->view[i], &texel->material);
            else if (m->way == AFFINE)
                k->shade_affine(j.L, j.own, &lit, &texel->surface, texel->view[i], &texel->material);
            else if (m->way == SETUP)
                k->shade_setup(&j, &setup, &lit, &lights, &texel->surface, texel->view[i], &texel->material);
            else
                peer(L, jacobian, (int)m->way - PEER_PLAIN, texel, texel->view[i]), j.L[0] = (float)L[0];
            sink = j.L[0];
        }
    }
    return (cpu_s() - begin) / ((double)m->n_texels * m->n_views * N_LIGHTS * 1e-6);
}

static bool available(const struct method *m)
{
    return m->way >= PEER_PLAIN ? ceres_peer_jacobian != NULL : kernels_by_name(m->kernel) != NULL;
}

static int by_value(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// The peer must compute what the kernels do, or the ratio means nothing: largest difference relative to the sample's largest entry.
static double peer_difference(void)
{
    const struct kernels *reference = kernels_by_name("reference");
    double worst = 0;
    for (int t = 0; t < 8; t++)
        for (int form = 0; form < 3; form++) {
            const struct texel *texel = &texels[t];
            struct shade_jacobian j;
            double L[3], jacobian[3][13], scale = 0, difference = 0;
            reference->brute_jacobian(&j, &lights, &texel->surface, texel->view[0], &texel->material);
            peer(L, jacobian, form, texel, texel->view[0]);
            for (int c = 0; c < 3; c++)
                for (int i = -1; i < 13; i++) {
                    const double want = i < 0          ? (double)j.L[c]
                                        : i < DISNEY_N ? (double)j.theta[c][i]
                                                       : (double)j.albedo[c][i - DISNEY_N];
                    const double got = i < 0 ? L[c] : jacobian[c][i];
                    scale = fmax(scale, fabs(want)), difference = fmax(difference, fabs(got - want));
                }
            worst = fmax(worst, difference / scale);
        }
    return worst;
}

int main(int argc, char **argv)
{
    const bool json = argc == 2 && !strcmp(argv[1], "--json");
    if (argc > 1 && !json) {
        fprintf(stderr, "usage: bench_kernels [--json]\n");
        return 2;
    }
    build_studio();
    double share = 0;
    for (int t = 0; t < N_TEXELS; t++) {
        kernels_select(KERNELS_ALL)->gather(&lit, &lights, &texels[t].surface, NULL, NULL);
        share += lit.n / (double)N_LIGHTS / N_TEXELS;
    }
    for (int round = -1; round < N_ROUNDS; round++) // the first warms up
        for (int i = 0; i < N_METHODS; i++)
            if (available(&methods[i])) {
                const double seconds = run(&methods[i]);
                if (round >= 0)
                    methods[i].seconds[round] = seconds;
            }
    for (int i = 0; i < N_METHODS; i++) {
        qsort(methods[i].seconds, N_ROUNDS, sizeof(double), by_value);
        methods[i].median = methods[i].seconds[N_ROUNDS / 2];
    }
    const double plain = methods[0].median, careful = methods[2].median;
    const double difference = ceres_peer_jacobian ? peer_difference() : 0;
    if (json)
        printf("{\"lights\":%d,\"views\":%d,\"rounds\":%d,\"share_above_horizon\":%.4f,\"ceres_difference\":%.3g,\"ways\":[", N_LIGHTS,
               N_VIEWS, N_ROUNDS, share, difference);
    else
        printf("CPU seconds per million (sample x light): medians of %d rounds; %.0f%% of the lights are above the horizon\n"
               "%-10s %-26s %10s %10s %10s %14s %14s\n", N_ROUNDS, 100 * share, "kernel", "way", "median", "least", "most",
               "x ceres plain", "x careful");
    for (int i = 0, n = 0; i < N_METHODS; i++) {
        const struct method *m = &methods[i];
        if (!available(m))
            continue;
        if (json)
            printf("%s{\"kernel\":\"%s\",\"way\":\"%s\",\"median_s\":%.6g,\"least_s\":%.6g,\"most_s\":%.6g,\"times_ceres_plain\":%.6g,"
                   "\"times_ceres_careful\":%.6g}", n++ ? "," : "", m->kernel, m->what, m->median, m->seconds[0],
                   m->seconds[N_ROUNDS - 1], plain / m->median, careful / m->median);
        else
            printf("%-10s %-26s %10.5f %10.5f %10.5f", m->kernel, m->what, m->median, m->seconds[0], m->seconds[N_ROUNDS - 1]);
        if (!json && ceres_peer_jacobian)
            printf(" %14.1f %14.1f", plain / m->median, careful / m->median);
        if (!json)
            putchar('\n');
    }
    if (json)
        puts("]}");
    else if (ceres_peer_jacobian)
        printf("the peer's L and Jacobian differ from the reference's by at most %.2g of a sample's largest entry\n", difference);
    else
        printf("no Ceres here at build time (libceres-dev): no peer to compare with\n");
    light_arrays_free(&lights);
    lit_free(&lit);
    return EXIT_SUCCESS;
}
