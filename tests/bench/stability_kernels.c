// tests/bench/stability_kernels.c - `make stability`: where float32 shading loses digits.
//
// Every kernel against the double reference over a grid of roughness and of the light's elevation above the horizon; in each cell
// 200 random views and materials, one light each. The error is that of L and of its 13-column Jacobian, relative to the larger of the
// arriving light and the reference's own largest entry. CSV on stdout: median and maximum per cell.
#include "solver/kernels/kernels.h"
#include "solver/random.h"
#include "solver/vec3.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { PER_CELL = 200, N_VALUES = sizeof(struct shade_jacobian) / sizeof(float) };
static const double roughnesses[] = { 0, .02, .031, .033, .05, .1, .2, .35, .5, .7, 1 };
static const double elevations_deg[] = { .01, .1, 1, 3, 10, 30, 60, 89, 90 };

static int by_value(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// The light stands in the plane of n and the tangent; the view is random, or (every fourth) near its mirror direction.
static double one_error(const struct kernels *k, const struct kernels *reference, double roughness,
                        double elevation_deg, int i)
{
    const uint64_t id = random_u64((uint64_t)(roughness * 1e6), (uint64_t)(elevation_deg * 1e3), (uint64_t)i);
    const double e = elevation_deg * M_PI / 180, azimuth = 2 * M_PI * random_uniform(id, 0, 0);
    struct lights lights = { 0 };
    struct light_arrays arrays = { 0 };
    struct lit lit = { 0 };
    if (lights_new(&lights, 1))
        exit(EXIT_FAILURE);
    lights.dir_probe[0][0] = cos(e) * cos(azimuth), lights.dir_probe[0][1] = cos(e) * sin(azimuth);
    lights.dir_probe[0][2] = sin(e);
    for (int c = 0; c < 3; c++)
        lights.irradiance[0][c] = 1;
    const struct surface_point s = { .normal = { 0, 0, 1 }, .tangent = { 1, 0, 0 }, .bitangent = { 0, 1, 0 } };
    double v[3];
    for (int c = 0; c < 3; c++)
        v[c] = i % 4 ? random_normal(id, 1, (uint64_t)c)
                     : (c < 2 ? -1 : 1) * lights.dir_probe[0][c] + 3e-3 * random_normal(id, 1, (uint64_t)c);
    v[2] = fabs(v[2]);
    vec3_normalise(v);
    const float view[3] = { (float)v[0], (float)v[1], (float)v[2] };
    struct shade_material m = { 0 };
    for (int p = 0; p < DISNEY_N; p++)
        m.theta[p] = (float)random_uniform(id, 2, (uint64_t)p);
    for (int c = 0; c < 3; c++)
        m.albedo[c] = (float)random_uniform(id, 3, (uint64_t)c);
    m.theta[DISNEY_ROUGHNESS] = (float)roughness;
    struct shade_jacobian out[2];
    const struct kernels *both[2] = { reference, k };
    if (light_arrays_new(&arrays, &lights) || lit_new(&lit, 1))
        exit(EXIT_FAILURE);
    for (int j = 0; j < 2; j++) {
        both[j]->gather(&lit, &arrays, &s, NULL, NULL);
        both[j]->shade_jacobian(&out[j], &lit, &s, view, &m);
    }
    float a[2][N_VALUES];
    memcpy(a, out, sizeof(a));
    double scale = 1, error = 0;
    for (int j = 0; j < N_VALUES; j++) {
        scale = fmax(scale, fabs((double)a[0][j]));
        error = fmax(error, fabs((double)a[1][j] - a[0][j]));
    }
    lit_free(&lit);
    light_arrays_free(&arrays);
    lights_free(&lights);
    return error / scale;
}

int main(void)
{
    static const char *const names[] = { "portable", "avx2", "avx512" };
    const struct kernels *reference = kernels_by_name("reference");
    printf("kernel,roughness,elevation_deg,median_error,max_error\n");
    for (size_t j = 0; j < sizeof(names) / sizeof(names[0]); j++) {
        const struct kernels *k = kernels_by_name(names[j]);
        for (size_t r = 0; k && r < sizeof(roughnesses) / sizeof(roughnesses[0]); r++)
            for (size_t e = 0; e < sizeof(elevations_deg) / sizeof(elevations_deg[0]); e++) {
                double errors[PER_CELL];
                for (int i = 0; i < PER_CELL; i++)
                    errors[i] = one_error(k, reference, roughnesses[r], elevations_deg[e], i);
                qsort(errors, PER_CELL, sizeof(double), by_value);
                printf("%s,%g,%g,%.3g,%.3g\n", names[j], roughnesses[r], elevations_deg[e], errors[PER_CELL / 2],
                       errors[PER_CELL - 1]);
            }
    }
    return EXIT_SUCCESS;
}
