// tests/bench/chart_lights.c - `make chart`: how many lights a picture needs, and what they cost.
//
// Five softboxes in a dim room are cut into N lights; 1,000 random surface points with random views are shaded with
// each N, roughness and kernel, and compared with the same points under 65,536 lights. CSV on stdout. Lights are
// directional: distance is another question.
#include "solver/kernels/kernels.h"
#include "solver/panorama.h"
#include "solver/random.h"
#include "solver/vec3.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { WIDTH = 1024, HEIGHT = 512, N_SAMPLES = 1000, N_REFERENCE = 65536 };
static const double roughnesses[] = { .1, .2, .35, .5, .7, 1 };
enum { N_ROUGHNESS = sizeof(roughnesses) / sizeof(roughnesses[0]) };

static double cpu_seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int softboxes(struct panorama *p)
{
    static const double box[5][4] = { // longitude, latitude, half sizes, degrees
        { 20, 40, 14, 9 }, { 100, 25, 8, 14 }, { -60, 30, 10, 10 }, { -140, 10, 16, 6 }, { 170, 60, 20, 8 },
    };
    const int err = image_new(&p->image, WIDTH, HEIGHT, 3, NULL);
    if (err)
        return err;
    for (int y = 0; y < HEIGHT; y++)
        for (int x = 0; x < WIDTH; x++) {
            const double lon = 180 - 360 * (x + .5) / WIDTH, lat = 90 - 180 * (y + .5) / HEIGHT;
            float *pixel = p->image.data + 3 * ((size_t)y * WIDTH + (size_t)x);
            for (int c = 0; c < 3; c++)
                pixel[c] = .05f;
            for (int b = 0; b < 5; b++)
                if (fabs(lon - box[b][0]) < box[b][2] && fabs(lat - box[b][1]) < box[b][3])
                    for (int c = 0; c < 3; c++)
                        pixel[c] = (float)(8 + b + c * .5);
        }
    return 0;
}

// Sample i: a frame and a view in its upper hemisphere, cosine to the normal above .15.
static void random_sample(int i, struct surface_point *s, float v[3])
{
    double n[3], t[3], b[3], w[3];
    do {
        for (int c = 0; c < 3; c++)
            n[c] = random_normal(1, (uint64_t)i, (uint64_t)c), t[c] = random_normal(2, (uint64_t)i, (uint64_t)c);
    } while (vec3_normalise(n) <= 0);
    vec3_add_scaled(t, t, -vec3_dot(n, t), n);
    vec3_normalise(t);
    vec3_cross(b, n, t);
    uint64_t k = 0;
    do {
        for (int c = 0; c < 3; c++)
            w[c] = random_normal(3, (uint64_t)i, k++);
        vec3_normalise(w);
    } while (vec3_dot(n, w) < .15);
    memset(s, 0, sizeof(*s));
    for (int c = 0; c < 3; c++) {
        s->normal[c] = (float)n[c], s->tangent[c] = (float)t[c], s->bitangent[c] = (float)b[c];
        v[c] = (float)w[c];
    }
}

// out[N_ROUGHNESS][N_SAMPLES][3]; returns CPU seconds per sample (gather and one shade), averaged over roughness.
static double shade_all(const struct kernels *k, const struct panorama *p, int n, float *out)
{
    struct lights lights = { 0 };
    struct light_arrays arrays = { 0 };
    struct lit lit = { 0 };
    if (lights_median_cut(&lights, p, n) || light_arrays_new(&arrays, &lights) || lit_new(&lit, n))
        exit(EXIT_FAILURE);
    struct shade_material m = { .albedo = { .5f, .4f, .3f } };
    m.theta[DISNEY_SPECULAR] = .5f;
    const double start = cpu_seconds();
    for (int r = 0; r < N_ROUGHNESS; r++) {
        m.theta[DISNEY_ROUGHNESS] = (float)roughnesses[r];
        for (int i = 0; i < N_SAMPLES; i++) {
            struct surface_point s;
            float v[3];
            random_sample(i, &s, v);
            k->gather(&lit, &arrays, &s, NULL, NULL);
            k->shade(out + 3 * (r * N_SAMPLES + i), &lit, &s, v, &m);
        }
    }
    const double seconds = (cpu_seconds() - start) / (N_ROUGHNESS * N_SAMPLES);
    lit_free(&lit);
    light_arrays_free(&arrays);
    lights_free(&lights);
    return seconds;
}

int main(void)
{
    static const char *const names[] = { "portable", "avx2", "avx512" };
    struct panorama p = { 0 };
    const size_t n_values = 3 * N_ROUGHNESS * N_SAMPLES;
    float *truth = malloc(n_values * sizeof(float)), *values = malloc(n_values * sizeof(float));
    if (!truth || !values || softboxes(&p))
        return EXIT_FAILURE;
    shade_all(kernels_select(KERNELS_ALL), &p, N_REFERENCE, truth);
    printf("kernel,lights,roughness,rmse_percent,us_per_sample\n");
    for (size_t j = 0; j < sizeof(names) / sizeof(names[0]); j++) {
        const struct kernels *k = kernels_by_name(names[j]);
        if (!k)
            continue;
        for (int n = 16; n <= 16384; n *= 4) {
            const double seconds = shade_all(k, &p, n, values);
            for (int r = 0; r < N_ROUGHNESS; r++) {
                double error = 0, power = 0;
                for (int i = 3 * r * N_SAMPLES; i < 3 * (r + 1) * N_SAMPLES; i++) {
                    error += ((double)values[i] - truth[i]) * ((double)values[i] - truth[i]);
                    power += (double)truth[i] * truth[i];
                }
                printf("%s,%d,%g,%.4f,%.3f\n", names[j], n, roughnesses[r], 100 * sqrt(error / power),
                       1e6 * seconds);
            }
        }
    }
    free(truth);
    free(values);
    panorama_free(&p);
    return EXIT_SUCCESS;
}
