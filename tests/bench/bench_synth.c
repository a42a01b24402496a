// tests/bench/bench_synth.c - synthetic studios: seconds per view of 360 x 240 px, the difference
// that lights at a distance make (beside the paper's error of directional lights after a fit), and
// what shading smooth pixels once costs in accuracy.
#include "solver/compare.h"
#include "solver/parallel.h"
#include "solver/synth.h"
#include "solver/take/log.h"
#include "tests/truth.h"

#include <ftw.h>
#include <math.h>
#include <stdlib.h>
#include <time.h>

enum { WIDTH_PX = 360, HEIGHT_PX = 240, N_COMPARED = 10, N_TIMED = 2 };

static double seconds(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void require(int ok, const char *what)
{
    if (ok)
        return;
    fprintf(stderr, "bench_synth: %s failed\n", what);
    exit(1);
}

static int remove_one(const char *path, const struct stat *st, int kind, struct FTW *at)
{
    (void)st, (void)kind, (void)at;
    return remove(path);
}

// A studio whose own pictures are tiny: only its truth is wanted.
static void open_studio(struct truth *t, int data_set, int n_lights)
{
    char dir[] = "/tmp/studiorig-bench-XXXXXX", take[64];
    struct synth_settings s = synth_defaults(data_set);
    s.n_true_lights = n_lights;
    s.width_px = s.height_px = 16, s.samples = 1, s.n_views = N_COMPARED;
    s.texture_size = s.texture_size < 512 ? s.texture_size : 512;
    require(mkdtemp(dir) != NULL, "mkdtemp");
    snprintf(take, sizeof(take), "%s/take", dir);
    require(!synth_write(&s, take), "synth");
    require(!truth_open(t, take), "reading the truth");
    nftw(dir, remove_one, 16, FTW_DEPTH | FTW_PHYS);
    for (int i = 0; i < t->cameras.n; i++) {
        struct camera *c = &t->cameras.view[i];
        const double scale = (double)HEIGHT_PX / c->height_px;
        c->fx *= scale, c->fy *= scale;
        c->cx = WIDTH_PX / 2., c->cy = HEIGHT_PX / 2.;
        c->width_px = WIDTH_PX, c->height_px = HEIGHT_PX;
    }
    t->settings.samples = 2;
}

static struct renderer *renderer_of(const struct truth *t, const struct render_settings *settings)
{
    struct renderer *r;
    require(!renderer_new(&r, &t->mesh, t->rays, &t->lights, &t->material, settings), "renderer");
    return r;
}

static void time_views(const struct truth *t, int data_set)
{
    double cpu_s[2], wall_s[2];
    for (int all = 0; all < 2; all++) {
        struct render_settings settings = t->settings;
        settings.n_threads = all ? 0 : 1;
        const double cpu = seconds(CLOCK_PROCESS_CPUTIME_ID), wall = seconds(CLOCK_MONOTONIC);
        struct renderer *r = renderer_of(t, &settings);
        for (int i = 0; i < N_TIMED; i++) {
            struct image image;
            require(!render_view(r, &t->cameras.view[2 * i], &image), "render");
            image_free(&image);
        }
        renderer_free(r);
        cpu_s[all] = (seconds(CLOCK_PROCESS_CPUTIME_ID) - cpu) / N_TIMED;
        wall_s[all] = (seconds(CLOCK_MONOTONIC) - wall) / N_TIMED;
    }
    printf("D%d  %6d lights  %8.3f s CPU (1 thread)  %8.3f s wall (%d threads)\n", data_set,
           t->lights.n, cpu_s[0], wall_s[1], parallel_n_cores());
}

// The views of both renderers over the object's pixels.
static struct comparison compare_views(const struct truth *t, const struct renderer *a,
                                       const struct renderer *b, int n)
{
    struct comparison total = {0}, one;
    for (int i = 0; i < n; i++) {
        struct image left, right, mask;
        require(!render_view(a, &t->cameras.view[i], &left), "render");
        require(!render_view(b, &t->cameras.view[i], &right), "render");
        require(!image_new(&mask, left.width, left.height, 1, NULL), "image");
        for (int64_t k = 0; k < (int64_t)left.width * left.height; k++)
            mask.data[k] = left.data[4 * k + 3] > .999f;
        require(!compare_images(&one, &left, &right, &mask), "compare");
        if (i)
            compare_add(&total, &one);
        else
            total = one;
        image_free(&left), image_free(&right), image_free(&mask);
    }
    return total;
}

static void compare_directional(struct truth *t, int data_set)
{
    static const double paper_percent[] = {0, 1.8, 4.6, 11.6};
    struct renderer *near = renderer_of(t, &t->settings);
    for (int i = 0; i < t->lights.n; i++)
        t->lights.inverse_distance[i] = 0;
    struct renderer *far = renderer_of(t, &t->settings);
    const struct comparison c = compare_views(t, near, far, N_COMPARED);
    printf(
        "D%d  directional instead of near-field: RMSE %.2f %% over %lld object pixels (the paper, "
        "after a fit: %.1f %%)\n",
        data_set, c.rmse_percent, (long long)c.n_pixels, paper_percent[data_set]);
    renderer_free(near), renderer_free(far);
}

static void compare_samples(const struct truth *t, int data_set)
{
    struct render_settings settings = t->settings;
    struct renderer *once = renderer_of(t, &settings);
    settings.shade_every_sample = true;
    struct renderer *each = renderer_of(t, &settings);
    const double start_s = seconds(CLOCK_PROCESS_CPUTIME_ID);
    const struct comparison c = compare_views(t, once, each, 2);
    printf(
        "D%d  smooth pixels shaded once instead of four times: RMSE %.4f %%, largest %.4f (%.1f s "
        "CPU)\n",
        data_set, c.rmse_percent, c.max_abs, seconds(CLOCK_PROCESS_CPUTIME_ID) - start_s);
    renderer_free(once), renderer_free(each);
}

int main(void)
{
    static const int n_lights[] = {256, 4096, 65536};
    log_set_level(LOG_WARNING);
    printf("views of %d x %d px, 2 x 2 samples, kernel %s\n", WIDTH_PX, HEIGHT_PX,
           kernels_select(KERNELS_ALL)->name);
    for (int data_set = 1; data_set <= 3; data_set++) {
        for (int k = 0; k < 3; k++) {
            struct truth t;
            open_studio(&t, data_set, n_lights[k]);
            time_views(&t, data_set);
            if (n_lights[k] == 4096) {
                compare_samples(&t, data_set);
                compare_directional(&t, data_set);
            }
            truth_close(&t);
        }
    }
    return 0;
}
