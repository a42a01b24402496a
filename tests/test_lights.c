// tests/test_lights.c - the median cut keeps energy and halves it; Eqs. 1-4 and their derivatives;
// lights.json survives hostile text.
//
// The two path-traced studios in ../shared/data are judges from outside: they run where that folder
// is.
#include "solver/lights.h"
#include "solver/random.h"
#include "solver/take/log.h"
#include "solver/vec3.h"
#include "tests/scratch.h"

#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

enum { SEED = 7 };

// cmocka's assert_float_equal compares floats, whatever it is given.
#define assert_near(a, b, bound) assert_true(fabs((a) - (b)) <= (bound))

static char last_error[1024]; // what was logged

static void remember(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    if (level == LOG_ERROR)
        snprintf(last_error, sizeof(last_error), "%s", message);
}

static void random_unit(double out[3], uint64_t stream, uint64_t i)
{
    for (int k = 0; k < 3; k++)
        out[k] = random_normal(SEED, stream, 3 * i + (uint64_t)k);
    vec3_normalise(out);
}

// ---- Eqs. 1-4 -----------------------------------------------------------------------------------

// n lights about a centre off the origin, turned; every fourth directional.
static struct lights near_lights(int n)
{
    struct lights l;
    assert_int_equal(lights_new(&l, n), 0);
    const double w[3] = {.4, -1.1, .7};
    mat3_from_rotation_vector(l.world_from_probe, w);
    l.centre_m[0] = .3, l.centre_m[1] = -.2, l.centre_m[2] = 1.1;
    for (int i = 0; i < n; i++) {
        random_unit(l.dir_probe[i], 1, (uint64_t)i);
        for (int c = 0; c < 3; c++)
            l.irradiance[i][c] = random_uniform(SEED, 2, (uint64_t)(3 * i + c));
        l.inverse_distance[i] = i % 4 ? 1 / (.5 + 3 * random_uniform(SEED, 3, (uint64_t)i)) : 0;
    }
    return l;
}

static void random_point(double p[3], const struct lights *l, int i)
{
    for (int k = 0; k < 3; k++)
        p[k] = l->centre_m[k] + .6 * (random_uniform(SEED, 4, (uint64_t)(3 * i + k)) - .5);
}

// Every number of a light_at in one row: l, weight.
static void row_of(const struct light_at *at, double row[4])
{
    memcpy(row, at->l, sizeof(at->l));
    row[3] = at->weight;
}

// What is moved: 0-2 centre, 3-5 rotation, 6 q, 7-9 point.
static void at_moved(const struct lights *l, int i, const double p[3], int what, double step,
                     double row[4])
{
    struct lights moved = *l;
    double point[3] = {p[0], p[1], p[2]}, q[64];
    struct light_at at;
    memcpy(q, l->inverse_distance, (size_t)l->n * sizeof(double));
    moved.inverse_distance = q;
    if (what < 3) {
        moved.centre_m[what] += step;
    } else if (what < 6) {
        double w[3] = {0, 0, 0}, turn[9];
        w[what - 3] = step;
        mat3_from_rotation_vector(turn, w);
        mat3_mul(moved.world_from_probe, turn, l->world_from_probe);
    } else if (what == 6) {
        q[i] += step;
    } else {
        point[what - 7] += step;
    }
    light_at_point(&moved, i, point, &at);
    row_of(&at, row);
}

static void derivatives_agree_with_central_differences(void **state)
{
    (void)state;
    struct lights l = near_lights(64);
    const double h = 1e-5;
    double worst = 0;
    for (int i = 0; i < l.n; i++) {
        double p[3];
        struct light_at_gradient g;
        struct light_at at;
        random_point(p, &l, i);
        light_at_point_gradient(&l, i, p, &g);
        light_at_point(&l, i, p, &at);
        assert_memory_equal(&at, &g.at, sizeof(at));
        for (int what = 0; what < 10; what++) {
            double plus[4], minus[4], analytic[4];
            at_moved(&l, i, p, what, h, plus);
            at_moved(&l, i, p, what, -h, minus);
            for (int j = 0; j < 3; j++)
                analytic[j] = what < 3    ? g.l_centre[3 * j + what]
                              : what < 6  ? g.l_rotation[3 * j + what - 3]
                              : what == 6 ? g.l_inverse_distance[j]
                                          : g.l_point[3 * j + what - 7];
            analytic[3] = what < 3    ? g.weight_centre[what]
                          : what < 6  ? g.weight_rotation[what - 3]
                          : what == 6 ? g.weight_inverse_distance
                                      : g.weight_point[what - 7];
            for (int j = 0; j < 4; j++) {
                const double difference = (plus[j] - minus[j]) / (2 * h);
                worst = fmax(worst, fabs(analytic[j] - difference) / (1 + fabs(difference)));
            }
        }
    }
    lights_free(&l);
    print_message("# light derivatives: worst difference %.2g\n", worst);
    assert_true(worst < 1e-7); // central differences of step 1e-5 in double
}

static void near_light_is_the_papers_equations_with_r(void **state)
{
    (void)state;
    struct lights l = near_lights(64);
    for (int i = 0; i < l.n; i++) {
        if (l.inverse_distance[i] <= 0)
            continue;
        double p[3], l_d[3], l_p[3], to[3];
        struct light_at at;
        random_point(p, &l, i);
        light_at_point(&l, i, p, &at);
        const double r = 1 / l.inverse_distance[i];
        mat3_mul_vec(l_d, l.world_from_probe, l.dir_probe[i]);
        vec3_add_scaled(l_p, l.centre_m, r, l_d);
        vec3_sub(to, l_p, p);
        const double distance = vec3_normalise(to);
        const double weight = r * r / (distance * distance) * fmax(vec3_dot(to, l_d), 0);
        for (int k = 0; k < 3; k++)
            assert_near(at.l[k], to[k], 1e-13);
        assert_near(at.weight, weight, 1e-12 * (1 + weight));
    }
    lights_free(&l);
}

static void at_the_centre_a_light_gives_its_own_irradiance(void **state)
{
    (void)state;
    struct lights l = near_lights(64);
    for (int i = 0; i < l.n; i++) {
        struct light_at at;
        light_at_point(&l, i, l.centre_m, &at);
        assert_near(at.weight, 1, 1e-14);
    }
    lights_free(&l);
}

static void far_lights_become_directional(void **state)
{
    (void)state;
    struct lights l = near_lights(8);
    double p[3];
    random_point(p, &l, 3);
    for (int i = 0; i < l.n; i++) {
        struct light_at at, directional;
        l.inverse_distance[i] = 0;
        light_at_point(&l, i, p, &directional);
        assert_near(directional.weight, 1, 1e-14);
        l.inverse_distance[i] = 1e-9;
        light_at_point(&l, i, p, &at);
        assert_near(at.weight, 1, 3e-9);
        assert_true(at.weight != directional.weight); // and yet it is not ignored
        for (int k = 0; k < 3; k++)
            assert_near(at.l[k], directional.l[k], 1e-9);
    }
    lights_free(&l);
}

static void behind_and_at_a_light_there_is_no_light(void **state)
{
    (void)state;
    struct lights l = near_lights(64);
    const struct light_at_gradient zero = {0};
    for (int i = 0; i < l.n; i++) {
        if (l.inverse_distance[i] <= 0)
            continue;
        double l_d[3], p[3];
        mat3_mul_vec(l_d, l.world_from_probe, l.dir_probe[i]);
        for (int k = 0; k < 3; k++) { // at the light, just behind it, far behind it
            struct light_at_gradient g;
            vec3_add_scaled(p, l.centre_m, (1 + .5 * k) / l.inverse_distance[i], l_d);
            light_at_point_gradient(&l, i, p, &g);
            assert_near(vec3_norm(g.at.l), 1, 1e-12);
            assert_true(g.at.weight == 0 ||
                        k == 0); // at the light: to rounding, which may leave it just in front
            memset(&g.at, 0, sizeof(g.at));
            if (k)
                assert_memory_equal(&g, &zero, sizeof(g));
        }
    }
    // The very place, in numbers without rounding.
    struct light_at_gradient g;
    l.inverse_distance[0] = .5;
    memcpy(l.dir_probe[0], (double[]){0, 1, 0}, sizeof(l.dir_probe[0]));
    memcpy(l.world_from_probe, (double[]){1, 0, 0, 0, 1, 0, 0, 0, 1}, sizeof(l.world_from_probe));
    memset(l.centre_m, 0, sizeof(l.centre_m));
    light_at_point_gradient(&l, 0, (double[]){0, 2, 0}, &g);
    assert_true(g.at.weight == 0 && g.at.l[0] == 0 && g.at.l[1] == 1 && g.at.l[2] == 0);
    memset(&g.at, 0, sizeof(g.at));
    assert_memory_equal(&g, &zero, sizeof(g));
    lights_free(&l);
}

// ---- median cut ---------------------------------------------------------------------------------

static struct panorama black(int height)
{
    struct panorama p;
    assert_int_equal(image_new(&p.image, 2 * height, height, 3, NULL), 0);
    return p;
}

// A dim room with very bright lamps: 1e5 between them.
static struct panorama room(int height)
{
    struct panorama p = black(height);
    for (int i = 0; i < 2 * height * height; i++) {
        const double u = random_uniform(SEED, 5, (uint64_t)i);
        for (int c = 0; c < 3; c++)
            p.image.data[3 * i + c] =
                (float)((u < .01 ? 1e3 : 1e-2) * random_uniform(SEED, 6, (uint64_t)(3 * i + c)));
    }
    return p;
}

static void assert_partition(const struct lights *l)
{
    const int width = l->panorama_width_px, n = width * l->panorama_height_px;
    unsigned char *seen = calloc((size_t)n, 1);
    assert_non_null(seen);
    for (int i = 0; i < l->n; i++)
        for (int y = l->region[i].y0; y < l->region[i].y1; y++)
            for (int x = l->region[i].x0; x < l->region[i].x1; x++)
                seen[y * width + x]++;
    for (int i = 0; i < n; i++)
        assert_int_equal(seen[i], 1);
    free(seen);
}

static void assert_same_energy(const struct lights *l, const struct panorama *p, double bound)
{
    double total[3], sum[3] = {0, 0, 0};
    panorama_total(p, total);
    for (int i = 0; i < l->n; i++)
        for (int c = 0; c < 3; c++)
            sum[c] += l->irradiance[i][c];
    for (int c = 0; c < 3; c++)
        assert_true(fabs(sum[c] - total[c]) <= bound * total[c]);
}

static void regions_partition_the_panorama_and_keep_its_energy(void **state)
{
    (void)state;
    struct panorama p = room(96);
    for (int n = 1; n <= LIGHTS_MAX; n *= 4) {
        struct lights l, again;
        assert_int_equal(lights_median_cut(&l, &p, n), 0);
        assert_int_equal(l.n, n);
        assert_partition(&l);
        assert_same_energy(&l, &p, 1e-12);
        assert_int_equal(lights_median_cut(&again, &p, n), 0);
        assert_memory_equal(l.dir_probe, again.dir_probe, (size_t)n * sizeof(*l.dir_probe));
        assert_memory_equal(l.irradiance, again.irradiance, (size_t)n * sizeof(*l.irradiance));
        assert_memory_equal(l.region, again.region, (size_t)n * sizeof(*l.region));
        for (int i = 0; i < n; i++)
            assert_near(vec3_norm(l.dir_probe[i]), 1, 1e-14);
        lights_free(&l);
        lights_free(&again);
    }
    panorama_free(&p);
}

static void finer_lights_are_where_one_light_was_coarsest(void **state)
{
    (void)state;
    enum { N = 64, FINE = 300 };
    struct panorama p = room(96);
    struct lights coarse, fine, again;
    assert_int_equal(lights_median_cut(&coarse, &p, N), 0);
    coarse.centre_m[1] = 2;
    for (int i = 0; i < N; i++)
        coarse.inverse_distance[i] = 1 / (1. + i);
    assert_int_equal(lights_refine(&fine, &coarse, &p, FINE), 0);
    assert_int_equal(fine.n, FINE);
    assert_partition(&fine);
    assert_same_energy(&fine, &p, 1e-12);
    assert_true(fine.centre_m[1] == 2);
    double sum[N][3] = {{0}}, worst = 0, least_split = INFINITY;
    int parts[N] = {0};
    for (int i = 0; i < FINE; i++) {
        const int g = fine.group[i];
        const struct light_region r = fine.region[i], whole = coarse.region[g];
        assert_true(g >= (i ? fine.group[i - 1] : 0) && g < N);
        assert_true(fine.inverse_distance[i] == coarse.inverse_distance[g]);
        assert_true(r.x0 >= whole.x0 && r.x1 <= whole.x1 && r.y0 >= whole.y0 && r.y1 <= whole.y1);
        for (int c = 0; c < 3; c++)
            sum[g][c] += fine.irradiance[i][c];
        parts[g]++;
        if (r.x1 - r.x0 > 1 || r.y1 - r.y0 > 1)
            worst = fmax(worst, (fine.irradiance[i][0] + fine.irradiance[i][1] +
                                 fine.irradiance[i][2]) *
                                    pow(fine.spread_rad[i], 2));
    }
    for (int g = 0; g < N; g++) {
        assert_true(parts[g] > 0);
        for (int c = 0; c < 3; c++)
            assert_near(sum[g][c], coarse.irradiance[g][c], 1e-12 * (1 + coarse.irradiance[g][c]));
        if (parts[g] > 1) // it was split for a reason: it was coarser than what remained whole
            least_split =
                fmin(least_split, (coarse.irradiance[g][0] + coarse.irradiance[g][1] +
                                   coarse.irradiance[g][2]) *
                                      pow(coarse.spread_rad[g], 2));
    }
    assert_true(worst > 0 && least_split >= worst);
    assert_int_equal(lights_refine(&again, &coarse, &p, N), 0); // nothing to do
    assert_memory_equal(again.dir_probe, coarse.dir_probe, N * sizeof(*coarse.dir_probe));
    assert_memory_equal(again.irradiance, coarse.irradiance, N * sizeof(*coarse.irradiance));
    lights_free(&again);
    lights_free(&fine);
    lights_free(&coarse);
    panorama_free(&p);
}

static double energy_of(const struct panorama *p, int x0, int y0, int x1, int y1)
{
    double sum = 0;
    for (int y = y0; y < y1; y++)
        for (int x = x0; x < x1; x++) {
            const float *v = p->image.data + 3 * (y * p->image.width + x);
            sum += (.2126 * v[0] + .7152 * v[1] + .0722 * v[2]) *
                   panorama_solid_angle(p->image.width, p->image.height, y);
        }
    return sum;
}

static void every_region_is_halved_along_its_longer_side_at_the_best_place(void **state)
{
    (void)state;
    struct panorama p = room(64);
    for (int n = 1; n <= 256; n *= 2) {
        struct lights coarse, fine;
        assert_int_equal(lights_median_cut(&coarse, &p, n), 0);
        assert_int_equal(lights_median_cut(&fine, &p, 2 * n), 0);
        for (int i = 0; i < n; i++) {
            const struct light_region r = coarse.region[i], a = fine.region[2 * i],
                                      b = fine.region[2 * i + 1];
            const int width = r.x1 - r.x0, height = r.y1 - r.y0;
            if (width == 1 && height == 1) { // a lamp of one pixel: its other half is empty
                assert_true(a.x0 == r.x0 && a.y0 == r.y0 && a.x1 == r.x1 && a.y1 == r.y1 &&
                            b.x0 == b.x1);
                continue;
            }
            // Together they are the region, side by side along the axis that the rule asks for.
            const double elevation = M_PI * (.5 - (r.y0 + r.y1) / 128.);
            const bool by_columns = height == 1 || (width > 1 && width * cos(elevation) >= height);
            assert_true(a.x0 == r.x0 && a.y0 == r.y0 && b.x1 == r.x1 && b.y1 == r.y1);
            if (by_columns)
                assert_true(a.x1 == b.x0 && a.y1 == r.y1 && b.y0 == r.y0);
            else
                assert_true(a.y1 == b.y0 && a.x1 == r.x1 && b.x0 == r.x0);
            // No other place leaves the halves closer.
            const double total = energy_of(&p, r.x0, r.y0, r.x1, r.y1);
            const double miss = fabs(energy_of(&p, a.x0, a.y0, a.x1, a.y1) - total / 2);
            for (int k = 1; k < (by_columns ? width : height); k++) {
                const double other = by_columns ? energy_of(&p, r.x0, r.y0, r.x0 + k, r.y1)
                                                : energy_of(&p, r.x0, r.y0, r.x1, r.y0 + k);
                assert_true(miss <= fabs(other - total / 2) + 1e-13 * total);
            }
        }
        lights_free(&coarse);
        lights_free(&fine);
    }
    panorama_free(&p);
}

static void lone_bright_pixels_on_black_get_one_light_each(void **state)
{
    (void)state;
    enum { N = 16 };
    struct panorama p = black(64);
    struct lights l;
    for (int i = 0; i < N; i++) { // equally strong, no two in one row or column
        const int x = 3 + 8 * i, y = (5 * i) % 16 * 4 + 1;
        p.image.data[3 * (y * 128 + x) + 1] = (float)(1 / panorama_solid_angle(128, 64, y));
    }
    assert_int_equal(lights_median_cut(&l, &p, N), 0);
    for (int i = 0; i < N; i++) {
        double x, y, d[3];
        assert_near(l.irradiance[i][1], 1, 1e-6);
        assert_true(l.irradiance[i][0] == 0 && l.irradiance[i][2] == 0);
        panorama_pixel(128, 64, l.dir_probe[i], &x, &y);
        assert_true(p.image.data[3 * ((int)y * 128 + (int)x) + 1] > 0);
        panorama_direction(128, 64, (int)x + .5, (int)y + .5, d);
        for (int k = 0; k < 3; k++)
            assert_near(l.dir_probe[i][k], d[k], 1e-14);
        assert_near(l.spread_rad[i], 0, 1e-7);
    }
    lights_free(&l);
    panorama_free(&p);
}

static void a_lone_bright_pixel_is_found_in_log2_steps(void **state)
{
    (void)state;
    struct panorama p = black(64);
    struct lights l;
    p.image.data[3 * (128 * 41 + 77)] = 1;
    assert_int_equal(lights_median_cut(&l, &p, 128 * 64), 0);
    assert_partition(&l);
    int n_lit = 0;
    for (int i = 0; i < l.n; i++) {
        const struct light_region *r = &l.region[i];
        if (l.irradiance[i][0] <= 0)
            continue;
        n_lit++;
        assert_true(r->x0 == 77 && r->x1 == 78 && r->y0 == 41 && r->y1 == 42);
    }
    assert_int_equal(n_lit, 1);
    lights_free(&l);
    panorama_free(&p);
}

static void direction_and_spread_are_energy_weighted(void **state)
{
    (void)state;
    struct panorama p = black(64);
    struct lights l;
    // Two pixels of one row, the right one three times as strong.
    float *left = p.image.data + 3 * (20 * 128 + 50), *right = p.image.data + 3 * (20 * 128 + 60);
    for (int c = 0; c < 3; c++)
        left[c] = 1, right[c] = 3;
    assert_int_equal(lights_median_cut(&l, &p, 1), 0);
    double a[3], b[3], mean[3];
    panorama_direction(128, 64, 50.5, 20.5, a);
    panorama_direction(128, 64, 60.5, 20.5, b);
    for (int k = 0; k < 3; k++)
        mean[k] = a[k] + 3 * b[k];
    vec3_normalise(mean);
    for (int k = 0; k < 3; k++)
        assert_near(l.dir_probe[0][k], mean[k], 1e-14);
    const double to_a = acos(vec3_dot(a, mean)), to_b = acos(vec3_dot(b, mean));
    assert_near(l.spread_rad[0], sqrt((to_a * to_a + 3 * to_b * to_b) / 4), 1e-9);
    lights_free(&l);
    panorama_free(&p);
}

static void what_cannot_be_split_gives_empty_lights(void **state)
{
    (void)state;
    struct panorama p = black(2); // 8 pixels, one black
    struct lights l;
    for (int i = 0; i < 8; i++)
        p.image.data[3 * i] = (float)(i == 3 ? 0 : i + 1);
    assert_int_equal(lights_median_cut(&l, &p, 64), 0);
    int n_empty = 0;
    for (int i = 0; i < 64; i++) {
        const bool none = l.region[i].x0 == l.region[i].x1;
        n_empty += none;
        assert_near(vec3_norm(l.dir_probe[i]), 1, 1e-14);
        if (none)
            assert_true(l.irradiance[i][0] == 0 && l.spread_rad[i] == 0);
    }
    assert_int_equal(n_empty, 64 - 8);
    assert_partition(&l);
    assert_same_energy(&l, &p, 1e-12);
    lights_free(&l);

    log_set_hook(remember, NULL);
    const int bad[] = {0, -4, 3, 255, 131072};
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        assert_int_equal(lights_median_cut(&l, &p, bad[i]), -EINVAL);
        assert_non_null(strstr(last_error, "power of two"));
        assert_true(l.n == 0 && !l.dir_probe);
    }
    log_set_hook(NULL, NULL);
    panorama_free(&p);
}

static void photographed_studios_keep_their_energy(void **state)
{
    (void)state;
    static const char *const files[] = {"studio_small_03_1k.hdr", "brown_photostudio_02_1k.hdr",
                                        "OrientationLatLong.exr"};
    for (int f = 0; f < 3; f++) {
        char path[256];
        snprintf(path, sizeof(path), "../shared/data/hdri/%s", files[f]);
        if (access(path, R_OK)) {
            print_message("# %s is not there: not checked\n", path);
            continue;
        }
        struct panorama p;
        assert_int_equal(panorama_read(&p, path), 0);
        for (int n = 16; n <= 4096; n *= 16) {
            struct lights l;
            assert_int_equal(lights_median_cut(&l, &p, n), 0);
            assert_partition(&l);
            assert_same_energy(&l, &p, 1e-12);
            lights_free(&l);
        }
        panorama_free(&p);
    }
}

// ---- lights.json --------------------------------------------------------------------------------

static int make_folder(void **state)
{
    (void)state;
    return scratch_open();
}

static int remove_folder(void **state)
{
    (void)state;
    return scratch_close();
}

// A set-up anywhere in a hall. What of its lights: 0 all have distances, 1 every third, 2 none,
// 3 all in one direction or against it, all with distances.
enum { N_KINDS = 4, ON_A_LINE = 3 };
static struct lights random_set_up(int n, int kind, int trial)
{
    struct lights l;
    double w[3];
    assert_int_equal(lights_new(&l, n), 0);
    random_unit(w, 10, (uint64_t)trial);
    for (int k = 0; k < 3; k++) {
        w[k] *= 3 * random_uniform(SEED, 11, (uint64_t)trial);
        l.centre_m[k] = kind == 2 ? 0 : 10 * random_uniform(SEED, 12, (uint64_t)(3 * trial + k));
    }
    mat3_from_rotation_vector(l.world_from_probe, w);
    for (int i = 0; i < n; i++) {
        const uint64_t at = (uint64_t)trial * LIGHTS_MAX + (uint64_t)i;
        random_unit(l.dir_probe[i], 13, at);
        for (int k = 0; k < 3; k++) {
            l.irradiance[i][k] = exp(10 * random_normal(SEED, 14, 3 * at + (uint64_t)k));
            if (kind == ON_A_LINE)
                l.dir_probe[i][k] = (i % 2 ? -1 : 1) * l.dir_probe[0][k];
        }
        if (kind == 0 || kind == ON_A_LINE || (kind == 1 && i % 3 == 0))
            l.inverse_distance[i] = .1 + 2 * random_uniform(SEED, 15, at);
        l.group[i] = (int32_t)(random_u64(SEED, 16, at) % (uint64_t)(n + 1)) - 1;
    }
    return l;
}

static void assert_same_bits(const struct lights *a, const struct lights *b)
{
    const size_t n = (size_t)a->n;
    assert_int_equal(a->n, b->n);
    assert_memory_equal(a->dir_probe, b->dir_probe, n * sizeof(*a->dir_probe));
    assert_memory_equal(a->irradiance, b->irradiance, n * sizeof(*a->irradiance));
    assert_memory_equal(a->group, b->group, n * sizeof(*a->group));
    assert_int_equal(a->panorama_width_px, b->panorama_width_px);
    assert_int_equal(a->panorama_height_px, b->panorama_height_px);
    assert_true(!a->region == !b->region && !a->spread_rad == !b->spread_rad);
    if (a->region)
        assert_memory_equal(a->region, b->region, n * sizeof(*a->region));
    if (a->spread_rad)
        assert_memory_equal(a->spread_rad, b->spread_rad, n * sizeof(double));
}

struct worst {
    double centre_m, rotation, dir_world, inverse_distance;
};

static void compare_set_ups(struct worst *w, const struct lights *a, const struct lights *b)
{
    for (int k = 0; k < 3; k++)
        w->centre_m = fmax(w->centre_m, fabs(a->centre_m[k] - b->centre_m[k]));
    for (int k = 0; k < 9; k++)
        w->rotation = fmax(w->rotation, fabs(a->world_from_probe[k] - b->world_from_probe[k]));
    for (int i = 0; i < a->n; i++) {
        const double q = a->inverse_distance[i];
        double d[3], e[3];
        mat3_mul_vec(d, a->world_from_probe, a->dir_probe[i]);
        mat3_mul_vec(e, b->world_from_probe, b->dir_probe[i]);
        vec3_sub(d, d, e);
        w->dir_world = fmax(w->dir_world, vec3_norm(d));
        assert_int_equal(q > 0, b->inverse_distance[i] > 0);
        if (q > 0)
            w->inverse_distance = fmax(w->inverse_distance, fabs(b->inverse_distance[i] - q) / q);
    }
}

// Written, read, written and read again.
static void through_files(struct worst *w, const struct lights *l)
{
    struct lights back, third;
    const char *path = scratch_path("lights.json");
    assert_int_equal(lights_write_json(l, path), 0);
    assert_int_equal(lights_read_json(&back, path), 0);
    assert_int_equal(lights_write_json(&back, path), 0);
    assert_int_equal(lights_read_json(&third, path), 0);
    unlink(path);
    assert_same_bits(l, &back);
    assert_same_bits(l, &third);
    compare_set_ups(w, l, &back);
    compare_set_ups(w, l, &third);
    lights_free(&back);
    lights_free(&third);
}

static void set_ups_come_back_from_a_file_to_rounding(void **state)
{
    (void)state;
    struct worst w = {0}, any_turn = {0};
    log_set_level(LOG_ERROR);
    for (int trial = 0; trial < 200; trial++) {
        const int n = trial % 10 ? 4 + trial : 1 + trial / 10 % 3, kind = trial / 2 % N_KINDS;
        struct lights l = random_set_up(n, kind, trial);
        through_files(kind == ON_A_LINE || n < 4 ? &any_turn : &w, &l);
        lights_free(&l);
    }
    struct lights many = random_set_up(LIGHTS_MAX, 1, 1000);
    through_files(&w, &many);
    lights_free(&many);
    log_set_level(LOG_INFO);
    print_message(
        "# lights.json: centre %.2g m, rotation %.2g, 1/r %.2g; on a line: centre %.2g m, "
        "directions %.2g\n",
        w.centre_m, w.rotation, w.inverse_distance, any_turn.centre_m, any_turn.dir_world);
    assert_true(w.centre_m < 1e-12 && w.rotation < 1e-14 && w.dir_world < 1e-14);
    assert_true(any_turn.centre_m < 1e-12 && any_turn.dir_world < 1e-14);
    assert_true(w.inverse_distance < 1e-15 && any_turn.inverse_distance < 1e-15);
}

static void regions_and_spreads_come_back_from_a_file(void **state)
{
    (void)state;
    struct panorama p = room(16);
    struct lights cut, unknown, near = near_lights(64);
    struct worst w = {0};
    assert_int_equal(lights_median_cut(&unknown, &p, 64), 0);
    assert_int_equal(lights_median_cut(&cut, &p, 64), 0);
    memcpy(cut.world_from_probe, near.world_from_probe, sizeof(cut.world_from_probe));
    memcpy(cut.centre_m, near.centre_m, sizeof(cut.centre_m));
    memcpy(cut.inverse_distance, near.inverse_distance, 64 * sizeof(double));
    through_files(&w, &cut);
    assert_true(w.centre_m < 1e-12 && w.rotation < 1e-14);
    w = (struct worst){0};
    through_files(&w, &unknown); // without a set-up: exactly so
    assert_true(w.centre_m == 0 && w.rotation == 0);
    lights_free(&cut);
    lights_free(&unknown);
    lights_free(&near);
    panorama_free(&p);
}

// A far light is worth its direction, no more: its place is rounded to more than the hall is long.
static void lights_far_away_do_not_move_the_centre(void **state)
{
    (void)state;
    struct worst w = {0};
    struct lights l = random_set_up(64, 0, 2000), back;
    for (int i = 32; i < 64; i++)
        l.inverse_distance[i] = (const double[]){1e-6, 1e-14, 1e-17, 1e-300}[i % 4];
    const char *path = scratch_path("far.json");
    assert_int_equal(lights_write_json(&l, path), 0);
    assert_int_equal(lights_read_json(&back, path), 0);
    unlink(path);
    for (int i = 32; i < 64; i++)
        l.inverse_distance[i] = l.inverse_distance[i] < 1e-15 ? 0 : l.inverse_distance[i];
    compare_set_ups(&w, &l, &back);
    assert_true(w.centre_m < 1e-12 && w.rotation < 1e-14 && w.inverse_distance < 1e-15);
    lights_free(&l);
    lights_free(&back);
}

static void the_file_is_a_list_that_says_where_lights_are_in_the_world(void **state)
{
    (void)state;
    struct lights l = near_lights(8), plain;
    struct json *doc;
    const char *path = scratch_path("list.json");
    assert_int_equal(lights_write_json(&l, path), 0);
    assert_int_equal(json_read(&doc, path), 0);
    assert_int_equal(json_length(doc, ""), 8);
    for (int i = 0; i < 8; i++) {
        char key[64];
        double said[3], dir[3], pos[3], distance_m;
        mat3_mul_vec(dir, l.world_from_probe, l.dir_probe[i]);
        snprintf(key, sizeof(key), "%d.dir_world", i);
        assert_int_equal(json_get_numbers(doc, key, said, 3), 0);
        assert_memory_equal(said, dir, sizeof(dir));
        snprintf(key, sizeof(key), "%d.distance_m", i);
        const int directional = l.inverse_distance[i] > 0 ? 0 : -EINVAL;
        assert_int_equal(json_get_number(doc, key, &distance_m), directional);
        snprintf(key, sizeof(key), "%d.pos_m", i);
        assert_int_equal(json_get_numbers(doc, key, said, 3), directional);
        if (directional)
            continue;
        assert_near(distance_m, 1 / l.inverse_distance[i], 0);
        vec3_add_scaled(pos, l.centre_m, distance_m, dir);
        vec3_sub(pos, pos, said);
        assert_true(vec3_norm(pos) < 1e-14);
    }
    json_free(doc);
    // Nobody has said where these are: nor does the file.
    assert_int_equal(lights_new(&plain, 1), 0);
    plain.dir_probe[0][2] = 1;
    assert_int_equal(lights_write_json(&plain, path), 0);
    assert_int_equal(json_read(&doc, path), 0);
    assert_null(json_get(doc, "0.dir_world"));
    json_free(doc);
    unlink(path);
    lights_free(&plain);
    lights_free(&l);
}

// Only what the contract outside names; six decimals; wrapped or not.
static void foreign_files_are_read_by_the_places_of_their_lights(void **state)
{
    (void)state;
    static char text[1 << 16];
    for (int trial = 0; trial < 40; trial++) {
        const int digits = trial % 2 ? 6 : 17, kind = trial / 2 % 2;
        struct lights l = random_set_up(9 + trial, kind, trial), back;
        int used = snprintf(text, sizeof(text), trial % 4 < 2 ? "[" : "{\"by\":[],\"lights\":[");
        for (int i = 0; i < l.n; i++) {
            const double q = l.inverse_distance[i], *d = l.dir_probe[i];
            double at[3], dir[3];
            mat3_mul_vec(dir, l.world_from_probe, d);
            vec3_add_scaled(at, l.centre_m, q > 0 ? 1 / q : 0, dir);
            used += snprintf(text + used, sizeof(text) - (size_t)used,
                             "%s{\"dir_probe\":[%.*f,%.*f,%.*f],\"irradiance\":[1,2,3],",
                             i ? "," : "", digits, d[0], digits, d[1], digits, d[2]);
            used += q > 0 ? snprintf(text + used, sizeof(text) - (size_t)used,
                                     "\"distance_m\":%.*f,\"pos_m\":[%.*f,%.*f,%.*f]", digits,
                                     1 / q, digits, at[0], digits, at[1], digits, at[2])
                          : snprintf(text + used, sizeof(text) - (size_t)used,
                                     "\"distance_m\":null,\"pos_m\":null");
            used += snprintf(text + used, sizeof(text) - (size_t)used, "%s}",
                             i % 2 ? ",\"group\":null" : "");
        }
        used += snprintf(text + used, sizeof(text) - (size_t)used, trial % 4 < 2 ? "]" : "]}");
        assert_int_equal(lights_parse_json(&back, text, (size_t)used, "foreign.json"), 0);
        struct worst w = {0};
        compare_set_ups(&w, &l, &back);
        assert_true(digits == 6 || (w.centre_m < 1e-13 && w.rotation < 1e-14));
        assert_true(w.centre_m < 3e-6 && w.rotation < 3e-6);
        for (int i = 0; i < l.n; i++)
            assert_int_equal(back.group[i], -1);
        lights_free(&l);
        lights_free(&back);
    }
}

static int parse(struct lights *out, const char *light)
{
    static char text[4096];
    snprintf(text, sizeof(text), "[{%s}]", light);
    last_error[0] = 0;
    return lights_parse_json(out, text, strlen(text), "hostile.json");
}

#define SUN "\"dir_probe\":[0,0,1],\"irradiance\":[1,1,1],\"distance_m\":null"
#define LIGHT                                                                                      \
    "\"dir_probe\":[0,0,1],\"dir_world\":[1,0,0],\"irradiance\":[1,1,1],\"distance_m\":2,"         \
    "\"pos_m\":[2,0,0]"
#define PANORAMA "\"panorama_px\":[8,4]"
#define AT(dir, r, pos)                                                                            \
    "\"dir_probe\":" dir ",\"irradiance\":[1,1,1],\"distance_m\":" r ",\"pos_m\":" pos
#define TO(dir, world)                                                                             \
    "\"dir_probe\":" dir ",\"irradiance\":[1,1,1],\"distance_m\":null,\"dir_world\":" world
#define X_Y_Z                                                                                      \
    AT("[1,0,0]", "1", "[1,0,0]")                                                                  \
    "},{" AT("[0,1,0]", "1", "[0,1,0]") "},{" AT("[0,0,1]", "1", "[0,0,1]")

static void wrong_lights_are_refused_by_name(void **state)
{
    (void)state;
    static const struct {
        const char *light, *says; // in the error
    } bad[] = {
        {"\"irradiance\":[1,1,1],\"distance_m\":null", "0.dir_probe"},
        {"\"dir_probe\":[0,0,1],\"distance_m\":null", "0.irradiance"},
        {"\"dir_probe\":[0,0,1],\"irradiance\":[1,1,1]", "0.distance_m"},
        {"\"dir_probe\":[0,0,1,0],\"irradiance\":[1,1,1],\"distance_m\":null", "0.dir_probe"},
        {"\"dir_probe\":[0,0,1.001],\"irradiance\":[1,1,1],\"distance_m\":null", "unit"},
        {"\"dir_probe\":[0,0,0],\"irradiance\":[1,1,1],\"distance_m\":null", "unit"},
        {"\"dir_probe\":[0,0,1e308],\"irradiance\":[1,1,1],\"distance_m\":null", "unit"},
        {"\"dir_probe\":[0,0,1],\"irradiance\":[1,-1e-9,1],\"distance_m\":null", "0.irradiance"},
        {"\"dir_probe\":[0,0,1],\"irradiance\":[1,1e31,1],\"distance_m\":null", "0.irradiance"},
        {AT("[0,0,1]", "0", "[0,0,0]"), "0.distance_m"},
        {AT("[0,0,1]", "-2", "[0,0,-2]"), "0.distance_m"},
        {AT("[0,0,1]", "5e-324", "[0,0,0]"), "0.distance_m"},
        {AT("[0,0,1]", "2e15", "[0,0,2e15]"), "0.distance_m"},
        {AT("[0,0,1]", "{}", "[0,0,0]"), "0.distance_m"},
        {AT("[0,0,1]", "\"2\"", "[0,0,2]"), "0.distance_m"},
        {AT("[0,0,1]", "2", "null"), "0.pos_m"},
        {AT("[0,0,1]", "2", "[0,2]"), "0.pos_m"},
        {AT("[0,0,1]", "2", "[0,0,1e10]"), "0.pos_m"},
        {AT("[0,0,1]", "null", "[0,0,2]"), "0.pos_m"},
        {"\"dir_probe\":[0,0,1],\"irradiance\":[1,1,1],\"distance_m\":2", "0.pos_m"},
        {SUN ",\"dir_world\":[0,0]", "0.dir_world"},
        {SUN ",\"dir_world\":[0,0,0]", "unit"},
        {SUN ",\"dir_world\":[0,0,1.001]", "unit"},
        {LIGHT ",\"group\":1", "0.group"},
        {LIGHT ",\"group\":-2", "0.group"},
        {LIGHT ",\"group\":0.5", "0.group"},
        {LIGHT ",\"region_px\":[0,0,1,1]", "0.panorama_px"}, // no panorama to lie in
        {LIGHT ",\"region_px\":[0,0,1,1],\"panorama_px\":[8,8]", "0.panorama_px"},
        {LIGHT ",\"region_px\":[0,0,1,1],\"panorama_px\":[5,2.5]", "0.panorama_px"},
        {LIGHT ",\"region_px\":[0,0,0,0],\"panorama_px\":[0,0]", "0.panorama_px"},
        {LIGHT ",\"region_px\":[0,0,1,1],\"panorama_px\":[131072,65536]", "0.panorama_px"},
        {LIGHT "," PANORAMA ",\"region_px\":[0,0,9,1]", "0.region_px"},
        {LIGHT "," PANORAMA ",\"region_px\":[0,0,1,5]", "0.region_px"},
        {LIGHT "," PANORAMA ",\"region_px\":[4,0,3,1]", "0.region_px"},
        {LIGHT "," PANORAMA ",\"region_px\":[0,3,1,1]", "0.region_px"},
        {LIGHT "," PANORAMA ",\"region_px\":[-1,0,1,1]", "0.region_px"},
        {LIGHT "," PANORAMA ",\"region_px\":[0,0,1.5,1]", "0.region_px"},
        {LIGHT "," PANORAMA ",\"region_px\":[0,0,1]", "0.region_px"},
        {LIGHT "," PANORAMA ",\"region_px\":[0,0,1,1]},{" LIGHT
               ",\"region_px\":[0,0,1,1],\"panorama_px\":[4,2]",
         "1.panorama_px"},
        {LIGHT "," PANORAMA ",\"region_px\":[0,0,1,1]},{" LIGHT "," PANORAMA,
         "1.region_px"}, // of one, not of the other
        {LIGHT ",\"spread_rad\":-1", "0.spread_rad"},
        {LIGHT ",\"spread_rad\":4", "0.spread_rad"},
        {LIGHT ",\"spread_rad\":0},{" LIGHT, "1.spread_rad"},
        // Together they make no sense, or too little.
        {AT("[0,0,1]", "2", "[0,0,2]"), "dir_world is with 0 of 1"},
        {AT("[0,0,1]", "2", "[0,0,2]") "},{" AT("[0,1,0]", "2", "[0,2,0]"), "one line"},
        {AT("[0,0,1]", "2", "[0,0,2]") "},{" AT("[0,0,1]", "3", "[0,0,3]") "},{" AT("[0,0,-1]", "3",
                                                                                    "[0,0,-3]"),
         "one line"},
        {LIGHT "},{" SUN, "dir_world is with 1 of 2"},
        {SUN "},{" SUN ",\"dir_world\":[0,0,1]", "dir_world is with 1 of 2"},
        {X_Y_Z "},{" AT("[0,0,-1]", "3", "[0,0,-3.01]"), "pos_m"},
        {X_Y_Z "},{" AT("[0,0,-1]", "3", "[0,0,-4]"), "3.pos_m: found [0,0,-4]"},
        {X_Y_Z "},{" TO("[0,1,0]", "[1,0,0]"), "3.dir_world"},
        {TO("[1,0,0]", "[0,1,0]") "},{" TO("[0,1,0]", "[0.6,0.8,0]"), "dir_world"},
        {TO("[1,0,0]", "[1,0,0]") "},{" TO("[0,1,0]", "[0,1,0]") "},{" TO("[0,0,1]", "[0,0,-1]"),
         "mirrored"},
        {AT("[1,0,0]", "1", "[1,0,0]") "},{" AT("[0,1,0]", "1", "[0,1,0]") "},{" AT(
             "[0,0,1]", "1", "[0,0,-1]") "},{" AT("[0,0,-1]", "1", "[0,0,1]"),
         "mirrored"},
        {LIGHT "},{" LIGHT "},{\"dir_probe\":[0,0,1],\"dir_world\":[1,0,0],\"irradiance\":[1,1,1],"
               "\"distance_m\":2,\"pos_m\":[3,0,0]",
         "2.pos_m"},
        {"\"dir_probe\":[0,0,1],\"dir_world\":[0,0,1],\"irradiance\":[1,1,1],\"distance_m\":1e15,"
         "\"pos_m\":[1e14,0,0]",
         "1e9 m away"},
    };
    struct lights l;
    log_set_hook(remember, NULL);
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        const int err = parse(&l, bad[i].light);
        if (err != -EINVAL || !strstr(last_error, bad[i].says) ||
            !strstr(last_error, "hostile.json"))
            fail_msg("case %zu: %d, said \"%s\", expected the word %s", i, err, last_error,
                     bad[i].says);
        assert_true(l.n == 0 && !l.dir_probe);
    }
    static const char *const broken[] = {"",       "{",
                                         "[]",     "{}",
                                         "3",      "null",
                                         "[7]",    "[[]]",
                                         "[{}]",   "{\"lights\":{}}",
                                         "\"[]\"", "{\"lights\":[]}",
                                         "[null]", "{\"lights\":{\"lights\":[]}}"};
    for (size_t i = 0; i < sizeof(broken) / sizeof(broken[0]); i++) {
        last_error[0] = 0;
        assert_int_equal(lights_parse_json(&l, broken[i], strlen(broken[i]), "hostile.json"),
                         -EINVAL);
        if (!strstr(last_error, "hostile.json"))
            fail_msg("broken %zu: said \"%s\"", i, last_error);
    }
    log_set_hook(NULL, NULL);
    assert_int_equal(lights_read_json(&l, scratch_path("not-there.json")), -ENOENT);
}

static void more_lights_than_the_limit_are_refused(void **state)
{
    (void)state;
    const size_t n = LIGHTS_MAX + 1;
    char *text = malloc(3 * n + 2);
    assert_non_null(text);
    for (size_t i = 0; i < n; i++)
        memcpy(text + 3 * i, i ? ",{}" : "[{}", 3);
    text[3 * n] = ']';
    struct lights l;
    log_set_hook(remember, NULL);
    assert_int_equal(lights_parse_json(&l, text, 3 * n + 1, "big.json"), -EINVAL);
    assert_non_null(strstr(last_error, "65536"));
    log_set_hook(NULL, NULL);
    free(text);
}

static void what_a_hand_may_write_is_read(void **state)
{
    (void)state;
    struct lights l;
    assert_int_equal(parse(&l, LIGHT), 0);
    assert_true(l.inverse_distance[0] == .5 && l.group[0] == -1 && !l.region && !l.spread_rad);
    assert_true(vec3_norm(l.centre_m) < 1e-15);
    lights_free(&l);
    assert_int_equal(parse(&l, "\"dir_probe\":[0,0,1.0000005],\"irradiance\":[0,1,2],"
                               "\"distance_m\":null,\"group\":null,\"dir_world\":null"),
                     0);
    assert_true(l.inverse_distance[0] == 0 && l.dir_probe[0][2] == 1); // renormalised
    assert_true(l.world_from_probe[0] == 1 && l.centre_m[0] == 0);
    lights_free(&l);
    assert_int_equal(parse(&l, X_Y_Z "},{" AT("[0,0,-1]", "1e12", "[0,0,-1e12]")), 0); // a sun
    assert_true(fabs(l.world_from_probe[0] - 1) < 1e-15 && vec3_norm(l.centre_m) < 1e-15);
    lights_free(&l);
    assert_int_equal(parse(&l, X_Y_Z "},{" TO("[0,-1,0]", "[0,-1,0]")), 0); // not all say it
    assert_true(fabs(l.world_from_probe[0] - 1) < 1e-15 && vec3_norm(l.centre_m) < 1e-15);
    lights_free(&l);
}

// ---- the pose of the probe ----------------------------------------------------------------------

#define CENTRE ", \"centre_m\": [1, 2, 3]"

static int read_pose(struct lights *l, bool *has_centre, const char *rows, const char *rest)
{
    const char *path = scratch_path("pose.json");
    FILE *f = fopen(path, "w");
    assert_non_null(f);
    fprintf(f, "{\"note\": \"by hand\", \"world_from_probe\": %s%s}\n", rows, rest);
    assert_int_equal(fclose(f), 0);
    log_set_hook(remember, NULL);
    *last_error = '\0';
    const int err = lights_read_pose(l, has_centre, path);
    log_set_hook(NULL, NULL);
    unlink(path);
    return err;
}

static void a_pose_is_the_nearest_rotation_and_an_exact_one_keeps_its_bits(void **state)
{
    (void)state;
    const double w[3] = {.4, -1.1, .7};
    double exact[9];
    char rows[512];
    bool has_centre = false;
    struct lights l;
    assert_int_equal(lights_new(&l, 1), 0);
    mat3_from_rotation_vector(exact, w);
    for (int decimals = 5; decimals <= 17; decimals += 12) {
        int n = 0;
        for (int i = 0; i < 9; i++)
            n += snprintf(rows + n, sizeof(rows) - (size_t)n, "%s%.*f", i ? "," : "[", decimals,
                          exact[i]);
        snprintf(rows + n, sizeof(rows) - (size_t)n, "]");
        assert_int_equal(read_pose(&l, &has_centre, rows, CENTRE), 0);
        assert_true(has_centre && l.centre_m[0] == 1 && l.centre_m[2] == 3);
        for (int i = 0; i < 9; i++) {
            const double *R = l.world_from_probe;
            assert_near(R[i], exact[i], decimals == 5 ? 2e-5 : 0);
            assert_near(vec3_dot(R + 3 * (i / 3), R + 3 * (i % 3)), i % 4 == 0, 1e-15);
        }
    }
    lights_free(&l);
}

static void a_pose_without_a_centre_leaves_it_where_it_may(void **state)
{
    (void)state;
    struct lights l;
    bool has_centre = true;
    assert_int_equal(lights_new(&l, 1), 0);
    l.centre_m[1] = 7;
    assert_int_equal(read_pose(&l, &has_centre, "[[0,0,1],[1,0,0],[0,1,0]]", ""), 0);
    assert_true(!has_centre && l.centre_m[1] == 7 && l.world_from_probe[2] == 1);
    assert_int_equal(read_pose(&l, NULL, "[[1,0,0],[0,1,0],[0,0,1]]", ""), -EINVAL);
    assert_non_null(strstr(last_error, "centre_m"));
    assert_true(l.world_from_probe[2] == 1); // as it was
    lights_free(&l);
}

static void a_pose_that_is_no_rotation_is_refused_and_changes_nothing(void **state)
{
    (void)state;
    static const struct {
        const char *rows, *rest, *says;
    } cases[] = {
        {"[[1,0,0],[0,1,0],[0,0,-1]]", CENTRE, "determinant -1"},
        {"[[1,0,0],[0,1,0],[0,0,1.001]]", CENTRE, "not a rotation"},
        {"[[1,0,0],[0,1,0],[0,0.001,1]]", CENTRE, "not a rotation"},
        {"[[0,0,0],[0,0,0],[0,0,0]]", CENTRE, "not a rotation"},
        {"[[1e300,0,0],[0,1e300,0],[0,0,1e300]]", CENTRE, "not a rotation"},
        {"[[1,0,0],[0,1,0]]", CENTRE, "world_from_probe"},
        {"[[1,0,0],[0,1,0],[0,0,1]]", ", \"centre_m\": [0, 0]", "centre_m"},
        {"[[1,0,0],[0,1,0],[0,0,1]]", ", \"centre_m\": [0, 2e9, 0]", "1e9"},
    };
    for (int i = 0; i < (int)(sizeof(cases) / sizeof(cases[0])); i++) {
        struct lights l;
        bool has_centre;
        assert_int_equal(lights_new(&l, 1), 0);
        l.centre_m[2] = 5;
        assert_int_equal(read_pose(&l, &has_centre, cases[i].rows, cases[i].rest), -EINVAL);
        if (!strstr(last_error, cases[i].says) || !strstr(last_error, "pose.json"))
            fail_msg("case %d: '%s' does not name '%s'", i, last_error, cases[i].says);
        assert_true(l.centre_m[2] == 5 && l.world_from_probe[4] == 1 && l.centre_m[1] == 0);
        lights_free(&l);
    }
}

// ---- the path-traced studios --------------------------------------------------------------------

static const char *const studios[] = {"../shared/data/studio-pebble", "../shared/data/studio-vase"};
enum { N_STUDIOS = 2, MAX_PANELS = 16 };

static bool there_are_studios(void)
{
    if (access(studios[0], R_OK) == 0)
        return true;
    print_message("# ../shared/data is not there: the path-traced studios are not checked\n");
    return false;
}

static const char *in_studio(int s, const char *name)
{
    static char path[256];
    snprintf(path, sizeof(path), "%s/%s", studios[s], name);
    return path;
}

struct panel {
    double corner_m[4][3], radiance[3];
};

static int read_panels(struct panel panels[MAX_PANELS], int s)
{
    struct json *doc;
    assert_int_equal(json_read(&doc, in_studio(s, "truth/lights.json")), 0);
    const int n = json_length(doc, "panels");
    assert_in_range(n, 1, MAX_PANELS);
    for (int i = 0; i < n; i++) {
        char key[64];
        snprintf(key, sizeof(key), "panels.%d.corners", i);
        assert_int_equal(json_get_numbers(doc, key, panels[i].corner_m[0], 12), 0);
        snprintf(key, sizeof(key), "panels.%d.radiance_rgb", i);
        assert_int_equal(json_get_numbers(doc, key, panels[i].radiance, 3), 0);
    }
    json_free(doc);
    return n;
}

// Lambert's formula, half the sum over the edges of angle x edge normal: the integral of direction
// over the quad's solid angle. Its length times radiance is the irradiance of a patch that faces it
// best; its direction is the quad's mean direction.
static void panel_vector(const struct panel *panel, const double from_m[3], double vector[3])
{
    double d[4][3];
    memset(vector, 0, 3 * sizeof(double));
    for (int k = 0; k < 4; k++) {
        vec3_sub(d[k], panel->corner_m[k], from_m);
        vec3_normalise(d[k]);
    }
    for (int k = 0; k < 4; k++) {
        double normal[3];
        vec3_cross(normal, d[k], d[(k + 1) % 4]);
        const double sine = vec3_normalise(normal);
        vec3_add_scaled(vector, vector, atan2(sine, vec3_dot(d[k], d[(k + 1) % 4])) / 2, normal);
    }
    if (vec3_dot(vector, d[0]) < 0)
        for (int k = 0; k < 3; k++)
            vector[k] = -vector[k];
}

// Van Oosterom and Strackee, two triangles.
static double panel_solid_angle(const struct panel *panel, const double from_m[3])
{
    double d[4][3], sum = 0;
    for (int k = 0; k < 4; k++) {
        vec3_sub(d[k], panel->corner_m[k], from_m);
        vec3_normalise(d[k]);
    }
    for (int k = 1; k < 3; k++) {
        double cross[3];
        vec3_cross(cross, d[k], d[k + 1]);
        sum += 2 * atan2(fabs(vec3_dot(d[0], cross)), 1 + vec3_dot(d[0], d[k]) +
                                                          vec3_dot(d[k], d[k + 1]) +
                                                          vec3_dot(d[k + 1], d[0]));
    }
    return sum;
}

// Does the ray from_m + t dir (t > 0) pass through the quad?
static bool panel_is_hit(const struct panel *panel, const double from_m[3], const double dir[3])
{
    double u[3], v[3], normal[3], to[3], middle[3];
    vec3_sub(u, panel->corner_m[1], panel->corner_m[0]);
    vec3_sub(v, panel->corner_m[3], panel->corner_m[0]);
    vec3_cross(normal, u, v);
    for (int k = 0; k < 3; k++)
        middle[k] = (panel->corner_m[0][k] + panel->corner_m[2][k]) / 2;
    vec3_sub(to, middle, from_m);
    const double t = vec3_dot(to, normal) / vec3_dot(dir, normal);
    if (!(t > 0))
        return false;
    for (int k = 0; k < 3; k++)
        to[k] = from_m[k] + t * dir[k] - middle[k];
    return fabs(vec3_dot(to, u)) <= vec3_dot(u, u) / 2 &&
           fabs(vec3_dot(to, v)) <= vec3_dot(v, v) / 2;
}

struct group_sum { // of one panel: what is taken to come from it
    int n;
    double toward[3], irradiance[3], solid_angle;
};

static void add_light(struct group_sum *g, const struct lights *l, int i, const double dir[3])
{
    const struct light_region *r = &l->region[i];
    g->n++;
    for (int c = 0; c < 3; c++)
        g->irradiance[c] += l->irradiance[i][c];
    vec3_add_scaled(g->toward, g->toward, l->irradiance[i][1], dir);
    for (int y = r->y0; y < r->y1; y++)
        g->solid_angle +=
            (r->x1 - r->x0) * panorama_solid_angle(l->panorama_width_px, l->panorama_height_px, y);
}

static double degrees_between(const double a[3], const double b[3])
{
    double cross[3];
    vec3_cross(cross, a, b);
    return atan2(vec3_norm(cross), vec3_dot(a, b)) * 180 / M_PI;
}

// The channel that is furthest off, in percent.
static double percent_off(const double found[3], const double scale, const double expected[3])
{
    double worst = 0;
    for (int c = 0; c < 3; c++) {
        const double off = 100 * (found[c] / (scale * expected[c]) - 1);
        worst = fabs(off) > fabs(worst) ? off : worst;
    }
    return worst;
}

// The panel each pixel of the panorama sees, or -1.
static int8_t *panel_of_pixels(const struct panorama *p, const struct panel *panels, int n_panels,
                               const double centre_m[3], const double R[9])
{
    const int width = p->image.width, height = p->image.height;
    int8_t *of = malloc((size_t)width * (size_t)height);
    assert_non_null(of);
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
            double d[3];
            panorama_direction(width, height, x + .5, y + .5, d);
            mat3_mul_vec(d, R, d);
            of[y * width + x] = -1;
            for (int k = 0; k < n_panels; k++)
                if (panel_is_hit(&panels[k], centre_m, d))
                    of[y * width + x] = (int8_t)k;
        }
    return of;
}

// A region is a panel's when most of its energy is, and wholly so when all its pixels are.
static int panel_of_region(const struct panorama *p, const struct light_region *r, const int8_t *of,
                           bool *wholly)
{
    double share[MAX_PANELS + 1] = {0}, total = 0;
    int best = MAX_PANELS;
    *wholly = r->x1 > r->x0;
    for (int y = r->y0; y < r->y1; y++)
        for (int x = r->x0; x < r->x1; x++) {
            const int i = y * p->image.width + x, k = of[i] < 0 ? MAX_PANELS : of[i];
            const double energy =
                p->image.data[3 * i + 1] * panorama_solid_angle(p->image.width, p->image.height, y);
            share[k] += energy, total += energy;
            *wholly = *wholly && of[i] >= 0 && of[i] == of[r->y0 * p->image.width + r->x0];
        }
    for (int k = 0; k < MAX_PANELS; k++)
        if (share[k] > total / 2)
            best = k;
    return best == MAX_PANELS ? -1 : best;
}

// Three questions per panel, against its closed-form solid angle and mean direction from the probe:
// do the pixels say what the panel sends (geometry and convention); do regions that lie wholly on
// it have its radiance; and how well do the lights whose energy is mostly its own stand for it.
// Regions at its rim hold wall too, so the last is a property of the method: a few percent.
static void panels_of_the_studios_are_found_by_the_cut(void **state)
{
    (void)state;
    if (!there_are_studios())
        return;
    for (int s = 0; s < N_STUDIOS; s++) {
        struct panel panels[MAX_PANELS];
        const int n_panels = read_panels(panels, s);
        const char *name = strrchr(studios[s], '/') + 1;
        struct panorama p;
        struct json *probe;
        double centre_m[3], R[9];
        assert_int_equal(panorama_read(&p, in_studio(s, "panorama.exr")), 0);
        assert_int_equal(json_read(&probe, in_studio(s, "truth/probe.json")), 0);
        assert_int_equal(json_get_numbers(probe, "centre_m", centre_m, 3), 0);
        assert_int_equal(json_get_numbers(probe, "world_from_probe", R, 9), 0);
        json_free(probe);
        int8_t *of = panel_of_pixels(&p, panels, n_panels, centre_m, R);
        double toward[MAX_PANELS][3], solid_angle[MAX_PANELS];
        struct group_sum pixels[MAX_PANELS] = {{0}};
        for (int i = 0; i < p.image.width * p.image.height; i++) {
            const int x = i % p.image.width, y = i / p.image.width;
            if (of[i] < 0)
                continue;
            double d[3];
            panorama_direction(p.image.width, p.image.height, x + .5, y + .5, d);
            mat3_mul_vec(d, R, d);
            const double omega = panorama_solid_angle(p.image.width, p.image.height, y);
            for (int c = 0; c < 3; c++)
                pixels[of[i]].irradiance[c] += p.image.data[3 * i + c] * omega;
            vec3_add_scaled(pixels[of[i]].toward, pixels[of[i]].toward,
                            p.image.data[3 * i + 1] * omega, d);
        }
        for (int k = 0; k < n_panels; k++) {
            panel_vector(&panels[k], centre_m, toward[k]);
            solid_angle[k] = panel_solid_angle(&panels[k], centre_m);
            const double off =
                percent_off(pixels[k].irradiance, solid_angle[k], panels[k].radiance);
            const double direction_off = degrees_between(pixels[k].toward, toward[k]);
            print_message(
                "# %s panel %d: %.4f sr, its pixels: direction off %.4f degrees, energy %+.2f %%\n",
                name, k, solid_angle[k], direction_off, off);
            assert_true(direction_off < .05); // a pixel is .18 or .35 degrees wide
            assert_true(fabs(off) < 1.5);     // its rim is blurred over pixels of the wall
        }
        for (int n = 256; n <= 1024; n *= 4) {
            struct group_sum mostly[MAX_PANELS] = {{0}}, wholly[MAX_PANELS] = {{0}},
                             hit[MAX_PANELS] = {{0}};
            struct lights l;
            assert_int_equal(lights_median_cut(&l, &p, n), 0);
            memcpy(l.centre_m, centre_m, sizeof(centre_m));
            memcpy(l.world_from_probe, R, sizeof(R));
            for (int i = 0; i < n; i++) {
                struct light_at at;
                bool all;
                const int k = panel_of_region(&p, &l.region[i], of, &all);
                light_at_point(&l, i, centre_m, &at);
                if (k >= 0)
                    add_light(&mostly[k], &l, i, at.l);
                if (k >= 0 && all)
                    add_light(&wholly[k], &l, i, at.l);
                for (int j = 0; j < n_panels; j++)
                    if (panel_is_hit(&panels[j], centre_m, at.l))
                        add_light(&hit[j], &l, i, at.l);
            }
            for (int k = 0; k < n_panels; k++) {
                const double radiance_off =
                    percent_off(wholly[k].irradiance, wholly[k].solid_angle, panels[k].radiance);
                const double energy_off =
                    percent_off(mostly[k].irradiance, solid_angle[k], panels[k].radiance);
                const double direction_off = degrees_between(mostly[k].toward, toward[k]);
                print_message("# %s panel %d, n = %4d: %3d lights mostly its own: direction off "
                              "%.3f degrees, energy "
                              "%+.2f %%; %3d wholly: radiance %+.3f %%; (%3d that point at it: "
                              "%.3f degrees, %+.2f %%)\n",
                              name, k, n, mostly[k].n, direction_off, energy_off, wholly[k].n,
                              radiance_off, hit[k].n, degrees_between(hit[k].toward, toward[k]),
                              percent_off(hit[k].irradiance, solid_angle[k], panels[k].radiance));
                assert_true(fabs(radiance_off) < .2);
                assert_true(direction_off < (n == 256 ? 1.5 : .5));
                assert_true(fabs(energy_off) < (n == 256 ? 5 : 1.5));
            }
            lights_free(&l);
        }
        free(of);
        panorama_free(&p);
    }
}

// A white Lambertian patch (albedo .8) facing each panel, path-traced, and the panorama at its
// place: radiance = albedo/pi E.
static void the_white_patch_is_predicted_from_the_panorama_at_its_place(void **state)
{
    (void)state;
    if (!there_are_studios())
        return;
    for (int s = 0; s < N_STUDIOS; s++) {
        struct panorama p;
        struct lights l;
        struct json *patches, *probe;
        double R[9];
        assert_int_equal(panorama_read(&p, in_studio(s, "truth/patch/pano_at_patch.exr")), 0);
        assert_int_equal(lights_median_cut(&l, &p, 1024), 0);
        assert_int_equal(json_read(&patches, in_studio(s, "truth/patch/patches.json")), 0);
        assert_int_equal(json_read(&probe, in_studio(s, "start.json")),
                         0); // taken with the studio's upright pose
        assert_int_equal(json_get_numbers(probe, "world_from_probe", R, 9), 0);
        const int n = json_length(patches, "");
        assert_in_range(n, 1, MAX_PANELS);
        for (int k = 0; k < n; k++) {
            char key[64], name[64];
            const char *file;
            double normal[3], normal_probe[3], albedo, E[3], cut_E[3] = {0, 0, 0},
                                                             seen[3] = {0, 0, 0};
            struct image picture;
            snprintf(key, sizeof(key), "%d.normal", k);
            assert_int_equal(json_get_numbers(patches, key, normal, 3), 0);
            snprintf(key, sizeof(key), "%d.albedo", k);
            assert_int_equal(json_get_number(patches, key, &albedo), 0);
            snprintf(key, sizeof(key), "%d.file", k);
            assert_int_equal(json_get_string(patches, key, &file), 0);
            snprintf(name, sizeof(name), "truth/patch/%s", file);
            assert_int_equal(image_read(&picture, in_studio(s, name)), 0);
            for (int y = picture.height / 4; y < picture.height * 3 / 4; y++)
                for (int x = picture.width / 4; x < picture.width * 3 / 4; x++)
                    for (int c = 0; c < 3; c++)
                        seen[c] += picture.data[(y * picture.width + x) * picture.n_channels + c] /
                                   (double)((picture.height * 3 / 4 - picture.height / 4) *
                                            (picture.width * 3 / 4 - picture.width / 4));
            image_free(&picture);
            mat3_tmul_vec(normal_probe, R, normal);
            panorama_irradiance(&p, normal_probe, E);
            for (int i = 0; i < l.n; i++)
                for (int c = 0; c < 3; c++)
                    cut_E[c] +=
                        fmax(vec3_dot(normal_probe, l.dir_probe[i]), 0) * l.irradiance[i][c];
            for (int c = 0; c < 3; c++)
                E[c] *= albedo / M_PI, cut_E[c] *= albedo / M_PI;
            const double off = percent_off(E, 1, seen), cut_off = percent_off(cut_E, 1, seen);
            print_message("# %s patch %d: rendered %.5f %.5f %.5f, predicted %.5f %.5f %.5f: off "
                          "%+.3f %%, by 1024 "
                          "lights %+.3f %%\n",
                          strrchr(studios[s], '/') + 1, k, seen[0], seen[1], seen[2], E[0], E[1],
                          E[2], off, cut_off);
            assert_true(fabs(off) < 1);
            assert_true(fabs(cut_off) < 1);
        }
        json_free(patches);
        json_free(probe);
        lights_free(&l);
        panorama_free(&p);
    }
}

static void unknown_distances_are_numbered_as_groups_come(void **state)
{
    (void)state;
    static const int32_t group[] = {7, 7, -1, 2, 7, -1, 2, 2, 0}, expected[] = {0, 0, 1, 2, 0, 3, 2, 2, 4};
    enum { N = sizeof(group) / sizeof(group[0]) };
    struct lights l;
    int32_t found[N];
    assert_int_equal(lights_new(&l, N), 0);
    assert_int_equal(lights_number_distances(&l, found), N); // no group at all
    assert_int_equal(found[N - 1], N - 1);
    memcpy(l.group, group, sizeof(group));
    assert_int_equal(lights_number_distances(&l, found), 5);
    assert_memory_equal(found, expected, sizeof(expected));
    lights_free(&l);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(derivatives_agree_with_central_differences),
        cmocka_unit_test(near_light_is_the_papers_equations_with_r),
        cmocka_unit_test(at_the_centre_a_light_gives_its_own_irradiance),
        cmocka_unit_test(far_lights_become_directional),
        cmocka_unit_test(behind_and_at_a_light_there_is_no_light),
        cmocka_unit_test(regions_partition_the_panorama_and_keep_its_energy),
        cmocka_unit_test(finer_lights_are_where_one_light_was_coarsest),
        cmocka_unit_test(every_region_is_halved_along_its_longer_side_at_the_best_place),
        cmocka_unit_test(lone_bright_pixels_on_black_get_one_light_each),
        cmocka_unit_test(a_lone_bright_pixel_is_found_in_log2_steps),
        cmocka_unit_test(direction_and_spread_are_energy_weighted),
        cmocka_unit_test(what_cannot_be_split_gives_empty_lights),
        cmocka_unit_test(photographed_studios_keep_their_energy),
        cmocka_unit_test(set_ups_come_back_from_a_file_to_rounding),
        cmocka_unit_test(regions_and_spreads_come_back_from_a_file),
        cmocka_unit_test(lights_far_away_do_not_move_the_centre),
        cmocka_unit_test(the_file_is_a_list_that_says_where_lights_are_in_the_world),
        cmocka_unit_test(foreign_files_are_read_by_the_places_of_their_lights),
        cmocka_unit_test(wrong_lights_are_refused_by_name),
        cmocka_unit_test(more_lights_than_the_limit_are_refused),
        cmocka_unit_test(what_a_hand_may_write_is_read),
        cmocka_unit_test(a_pose_is_the_nearest_rotation_and_an_exact_one_keeps_its_bits),
        cmocka_unit_test(a_pose_without_a_centre_leaves_it_where_it_may),
        cmocka_unit_test(a_pose_that_is_no_rotation_is_refused_and_changes_nothing),
        cmocka_unit_test(panels_of_the_studios_are_found_by_the_cut),
        cmocka_unit_test(the_white_patch_is_predicted_from_the_panorama_at_its_place),
        cmocka_unit_test(unknown_distances_are_numbered_as_groups_come),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
