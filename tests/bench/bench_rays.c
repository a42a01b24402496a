// tests/bench/bench_rays.c - shadow bits of a million texel-light pairs on 100,000 triangles: rays
// per second, memory, and whether Embree and a brute-force intersector in double agree.
#include "solver/parallel.h"
#include "solver/rays.h"
#include "solver/take/log.h"
#include "solver/visibility.h"
#include "tests/ray_margin.h"
#include "tests/ray_meshes.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { TEXTURE = 64, N_LIGHTS = 256, N_RUNS = 3, N_COMPARED = 10000 };

static double seconds(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static double resident_mib(void)
{
    long total = 0, resident = 0;
    FILE *f = fopen("/proc/self/statm", "r");
    if (!f || fscanf(f, "%ld %ld", &total, &resident) != 2)
        resident = 0;
    if (f)
        fclose(f);
    return (double)resident * 4096 / 1048576;
}

// Evenly over the sphere (a golden spiral), 2 m away.
static struct lights lights_all_round(void)
{
    struct lights l;
    if (lights_new(&l, N_LIGHTS))
        abort();
    for (int i = 0; i < N_LIGHTS; i++) {
        const double z = 1 - (2 * i + 1.) / N_LIGHTS, lon = 2.399963229728653 * i,
                     s = sqrt(1 - z * z);
        l.dir_probe[i][0] = s * cos(lon), l.dir_probe[i][1] = s * sin(lon), l.dir_probe[i][2] = z;
        l.inverse_distance[i] = .5;
        l.irradiance[i][0] = l.irradiance[i][1] = l.irradiance[i][2] = 1;
    }
    return l;
}

struct timing {
    double wall_s, cpu_s; // of the quickest run of N_RUNS by CPU time
    int64_t n_rays;
};

static struct timing time_trace(const struct rays *r, const struct texels *t,
                                const struct lights *l, int n_threads)
{
    struct timing best = { .cpu_s = INFINITY };
    for (int run = 0; run < N_RUNS; run++) {
        struct light_visibility v;
        const double wall_s = seconds(CLOCK_MONOTONIC), cpu_s = seconds(CLOCK_PROCESS_CPUTIME_ID);
        if (light_visibility_trace(&v, r, t, l, NULL, 1, 1, n_threads))
            abort();
        const struct timing one = { seconds(CLOCK_MONOTONIC) - wall_s,
                                    seconds(CLOCK_PROCESS_CPUTIME_ID) - cpu_s, v.n_rays };
        if (one.cpu_s < best.cpu_s)
            best = one;
        light_visibility_free(&v);
    }
    return best;
}

struct comparison {
    const struct mesh *mesh;
    const struct rays *rays;
    const struct texels *texels;
    const struct lights *lights;
    double tolerance_m;
    struct {
        bool differs, blocked, near_edge;
    } *answer;
};

// Even i: a shadow ray from a texel's start to a light. Odd: any ray through the bounding box.
static void compare_rays(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    struct comparison *k = arg;
    for (int64_t i = begin; i < end; i++) {
        float origin[3], dir[3], t_max = INFINITY;
        if (i % 2) {
            for (int c = 0; c < 3; c++) {
                const double extent_m = k->mesh->bounds_m[1][c] - k->mesh->bounds_m[0][c];
                origin[c] = (float)(k->mesh->bounds_m[0][c] +
                                    extent_m * random_uniform(1, (uint64_t)i, (uint64_t)c));
                dir[c] = (float)random_normal(2, (uint64_t)i, (uint64_t)c);
            }
        } else {
            const int texel = (int)(random_u64(3, (uint64_t)i, 0) % (uint64_t)k->texels->n);
            const int light = (int)(random_u64(3, (uint64_t)i, 1) % N_LIGHTS);
            rays_start(k->rays, k->texels->triangle[texel], k->texels->barycentric[texel], origin);
            for (int c = 0; c < 3; c++)
                dir[c] = (float)(2 * k->lights->dir_probe[light][c] - origin[c]);
            t_max = 1;
        }
        const double o[3] = { origin[0], origin[1], origin[2] }, d[3] = { dir[0], dir[1], dir[2] };
        const bool brute = rays_blocked_brute_force(k->mesh, o, d, 0, t_max);
        k->answer[i].blocked = brute;
        k->answer[i].differs = brute != rays_blocked(k->rays, origin, dir, 0, t_max);
        if (k->answer[i].differs)
            k->answer[i].near_edge = fabs(ray_margin_m(k->mesh, o, d, 0, t_max)) < k->tolerance_m;
    }
}

int main(int argc, char **argv)
{
    const bool json = argc == 2 && !strcmp(argv[1], "--json");
    if (argc > 1 && !json) {
        fprintf(stderr, "usage: %s [--json]\n", argv[0]);
        return 2;
    }
    struct mesh mesh = ray_mesh_bumpy(317, 159);
    struct lights lights = lights_all_round();
    struct texels texels;
    struct rays *rays;
    if (texels_rasterise(&texels, &mesh, TEXTURE))
        return 1;
    const double before_mib = resident_mib(), before_s = seconds(CLOCK_MONOTONIC);
    if (rays_new(&rays, &mesh))
        return 1;
    const double build_s = seconds(CLOCK_MONOTONIC) - before_s,
                 tree_mib = resident_mib() - before_mib;
    const int64_t n_pairs = (int64_t)texels.n * N_LIGHTS;
    const struct timing one = time_trace(rays, &texels, &lights, 1),
                        two = time_trace(rays, &texels, &lights, 2);
    const double below_percent = 100 * (1 - (double)one.n_rays / (double)n_pairs);

    double diagonal_m[3];
    vec3_sub(diagonal_m, mesh.bounds_m[1], mesh.bounds_m[0]);
    struct comparison k = { &mesh,
                            rays,
                            &texels,
                            &lights,
                            1e-6 * vec3_norm(diagonal_m),
                            calloc(N_COMPARED, sizeof(k.answer[0])) };
    if (!k.answer)
        return 1;
    parallel_for(0, N_COMPARED, 16, compare_rays, &k);
    int n_blocked = 0, n_different = 0, n_near_edge = 0;
    for (int i = 0; i < N_COMPARED; i++) {
        n_blocked += k.answer[i].blocked;
        n_different += k.answer[i].differs;
        n_near_edge += k.answer[i].near_edge;
    }
    const int64_t bytes = (int64_t)texels.n * ((N_LIGHTS + 15) / 16) * 2;

    if (json) {
        printf("{\"n_triangles\":%d,\"n_texels\":%d,\"n_lights\":%d,\"n_pairs\":%lld,\"below_"
               "horizon_percent\":%.2f,"
               "\"n_rays\":%lld,\"build_s\":%.4f,\"tree_mib\":%.1f,\"bits_bytes\":%lld,"
               "\"one_thread\":{\"wall_s\":%.4f,\"cpu_s\":%.4f,\"mrays_per_cpu_s\":%.3f,\"mrays_"
               "per_wall_s\":%.3f},"
               "\"two_threads\":{\"wall_s\":%.4f,\"cpu_s\":%.4f,\"mrays_per_cpu_s\":%.3f,\"mrays_"
               "per_wall_s\":%.3f},"
               "\"compared\":%d,\"blocked\":%d,\"different\":%d,\"different_within_edge_"
               "tolerance\":%d,"
               "\"edge_tolerance_m\":%.3g}\n",
               mesh.n_triangles, texels.n, N_LIGHTS, (long long)n_pairs, below_percent,
               (long long)one.n_rays, build_s, tree_mib, (long long)bytes, one.wall_s, one.cpu_s,
               1e-6 * (double)one.n_rays / one.cpu_s, 1e-6 * (double)one.n_rays / one.wall_s,
               two.wall_s, two.cpu_s, 1e-6 * (double)two.n_rays / two.cpu_s,
               1e-6 * (double)two.n_rays / two.wall_s, N_COMPARED, n_blocked, n_different,
               n_near_edge, k.tolerance_m);
    } else {
        printf("%d triangles (tree built in %.3f s, %.1f MiB); %d texels x %d lights = %lld pairs, "
               "%.1f %% below the horizon; "
               "bits: %lld bytes\n",
               mesh.n_triangles, build_s, tree_mib, texels.n, N_LIGHTS, (long long)n_pairs,
               below_percent, (long long)bytes);
        printf("%-8s %9s %9s %9s %14s %14s   (quickest of %d runs by CPU time)\n", "threads",
               "rays", "wall s", "CPU s", "Mray/s wall", "Mray/s CPU", N_RUNS);
        for (int n = 1; n <= 2; n++) {
            const struct timing *t = n == 1 ? &one : &two;
            printf("%-8d %9lld %9.4f %9.4f %14.3f %14.3f\n", n, (long long)t->n_rays, t->wall_s,
                   t->cpu_s, 1e-6 * (double)t->n_rays / t->wall_s,
                   1e-6 * (double)t->n_rays / t->cpu_s);
        }
        printf("%d rays against brute force in double: %d blocked, %d answers differ, %d of them "
               "within %.2g m of an edge\n",
               N_COMPARED, n_blocked, n_different, n_near_edge, k.tolerance_m);
    }
    free(k.answer);
    rays_free(rays);
    texels_free(&texels);
    lights_free(&lights);
    mesh_free(&mesh);
    return n_different > n_near_edge;
}
