// tests/test_samples.c - samples are what an analytic picture says, where brute force says there
// are any.
#include "solver/random.h"
#include "solver/samples.h"
#include "solver/shapes.h"
#include "solver/take/half.h"
#include "solver/take/image.h"
#include "solver/take/log.h"
#include "solver/take/take.h"
#include "solver/visibility.h"
#include "tests/ray_margin.h"
#include "tests/ray_meshes.h"

#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

static const double HALF_ROUNDING = 0x1p-11; // of a half float, relative
enum { MAX_TEST_VIEWS = 4, PATH_BYTES = 256 };

// ---- scenes, cameras, pictures ----

static char test_dir[PATH_BYTES];

static int make_dir(void **state)
{
    (void)state;
    const char *tmp = getenv("TMPDIR");
    snprintf(test_dir, sizeof(test_dir), "%s/studiorig-test-XXXXXX", tmp ? tmp : "/tmp");
    return mkdtemp(test_dir) ? 0 : -1;
}

static int remove_dir(void **state)
{
    (void)state;
    return rmdir(test_dir); // every test removes its files
}

struct scene {
    struct mesh mesh;
    struct rays *rays;
    struct texels texels;
    struct camera view[MAX_TEST_VIEWS];
    struct cameras cameras;
    char path[MAX_TEST_VIEWS][PATH_BYTES + 16];
    const char *paths[MAX_TEST_VIEWS];
    struct samples_settings settings;
};

static void scene_open(struct scene *s, struct mesh mesh, int texture)
{
    *s = (struct scene){.mesh = mesh, .settings = samples_defaults()};
    s->settings.n_threads = 2;
    s->settings.at_centre = false; // most tests are about the mean that is read
    s->settings.erode_px = 1;      // of sharp pictures
    s->cameras.view = s->view;
    assert_int_equal(rays_new(&s->rays, &s->mesh), 0);
    assert_int_equal(texels_rasterise(&s->texels, &s->mesh, texture), 0);
}

static void scene_close(struct scene *s)
{
    for (int v = 0; v < s->cameras.n; v++)
        unlink(s->path[v]);
    texels_free(&s->texels);
    rays_free(s->rays);
    mesh_free(&s->mesh);
}

// The floor [-1,1]^2 alone.
static struct mesh floor_mesh(void)
{
    struct ray_mesh_arrays a;
    ray_mesh_reserve(&a, 4, 2, true);
    ray_mesh_grid(&a, 1, 1, 0, 1, ray_mesh_place_floor);
    return ray_mesh_finish(&a);
}

static int add_view(struct scene *s, int width, int height, double focal_px, const double centre[3],
                    const double target[3])
{
    const int v = s->cameras.n++;
    struct camera *c = &s->view[v];
    *c = (struct camera){.width_px = width,
                         .height_px = height,
                         .model = CAMERA_BROWN,
                         .fx = focal_px,
                         .fy = focal_px * 1.01,
                         .cx = width / 2. + 1.3,
                         .cy = height / 2. - .7};
    snprintf(c->name, sizeof(c->name), "cam%02d", v);
    snprintf(s->path[v], sizeof(s->path[v]), "%s/cam%02d.exr", test_dir, v);
    s->paths[v] = s->path[v];
    camera_look_at(c, centre, target, (const double[3]){.1, .7, .6});
    return v;
}

typedef void paint_pixel(const struct scene *s, const struct camera *camera, int x, int y,
                         float *channels);

// Write view v's picture in float; returns it for the test to look at.
static struct image paint(const struct scene *s, int v, int width, int height, bool has_clip,
                          paint_pixel *pixel)
{
    static const char *const names[] = {"R", "G", "B", "clip"};
    struct image image;
    struct camera camera = s->view[v];
    camera_resize(&camera, width, height);
    assert_int_equal(image_new(&image, width, height, has_clip ? 4 : 3, names), 0);
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++)
            pixel(s, &camera, x, y,
                  image.data + ((size_t)y * (size_t)width + (size_t)x) * (size_t)image.n_channels);
    assert_int_equal(image_write_exr(&image, s->path[v], IMAGE_FLOAT, IMAGE_ZIP), 0);
    return image;
}

static void paint_view(const struct scene *s, int v, paint_pixel *pixel)
{
    struct image image = paint(s, v, s->view[v].width_px, s->view[v].height_px, false, pixel);
    image_free(&image);
}

static int gather(struct samples *out, const struct scene *s)
{
    memset(out, 77, sizeof(*out));
    return samples_gather(out, &s->texels, s->rays, &s->cameras, s->paths, &s->settings);
}

static void texel_point(const struct scene *s, int t, double point[3], double normal[3])
{
    for (int c = 0; c < 3; c++) {
        point[c] = (double)s->texels.position_m[t][c];
        normal[c] = (double)s->texels.normal[t][c];
    }
}

static void project_texel(const struct scene *s, const struct camera *camera, int t,
                          double uv_px[2])
{
    double point[3], normal[3];
    texel_point(s, t, point, normal);
    assert_true(camera_project(camera, point, uv_px, NULL));
}

// Where a continuous pixel's ray meets the plane z = height.
static void on_plane(const struct camera *camera, double u_px, double v_px, double height,
                     double at[3])
{
    double dir[3];
    assert_true(camera_ray(camera, (const double[2]){u_px, v_px}, dir));
    vec3_add_scaled(at, camera->centre_m, (height - camera->centre_m[2]) / dir[2], dir);
}

// ---- radiance ----

static double wave(const double p[3])
{
    return .6 + .3 * sin(14 * p[0] + 1) * cos(11 * p[1]) + .1 * sin(5 * p[2] + p[0]);
}

static void paint_wave_on_floor(const struct scene *s, const struct camera *camera, int x, int y,
                                float *out)
{
    (void)s;
    double at[3];
    on_plane(camera, x + .5, y + .5, 0, at);
    out[0] = (float)wave(at), out[1] = .5f * out[0], out[2] = -out[0];
}

static double floor_seen_at(const struct camera *camera, double u_px, double v_px)
{
    double at[3];
    on_plane(camera, u_px, v_px, 0, at);
    return wave(at);
}

// Over the whole picture: the largest |g_uu| + |g_vv| of what it shows, and the largest gradient.
static void largest_derivatives(const struct camera *camera, double *second, double *first)
{
    const double h = .25;
    *second = *first = 0;
    for (double v = 0; v <= camera->height_px; v++)
        for (double u = 0; u <= camera->width_px; u++) {
            const double g = floor_seen_at(camera, u, v);
            const double left = floor_seen_at(camera, u - h, v),
                         right = floor_seen_at(camera, u + h, v),
                         above = floor_seen_at(camera, u, v - h),
                         below = floor_seen_at(camera, u, v + h);
            *second =
                fmax(*second, (fabs(left + right - 2 * g) + fabs(above + below - 2 * g)) / (h * h));
            *first = fmax(*first, hypot(right - left, below - above) / (2 * h));
        }
}

static void a_smooth_surface_is_read_to_the_accuracy_of_bilinear_interpolation(void **state)
{
    (void)state;
    double rms_before = 0, slope_before = 0;
    for (int scale = 1; scale <= 4; scale *= 2) {
        struct scene s;
        scene_open(&s, floor_mesh(), 320);
        const int v = add_view(&s, 60, 40, 55, (const double[3]){.4, -.9, 1.6},
                               (const double[3]){.05, -.02, 0});
        s.view[v].k[0] = -.05, s.view[v].k[1] = .01, s.view[v].p[0] = .002;
        camera_resize(&s.view[v], 60 * scale, 40 * scale);
        paint_view(&s, v, paint_wave_on_floor);
        double second, first;
        largest_derivatives(&s.view[v], &second, &first);
        struct samples got;
        assert_int_equal(gather(&got, &s), 0);
        assert_true(got.n > 20000);
        double sum = 0, slope_sum[2] = {0};
        for (int t = 0; t < got.n_texels; t++)
            for (int64_t i = got.first[t]; i < got.first[t + 1]; i++) {
                double point[3], normal[3], uv_px[2];
                float rgb[3];
                texel_point(&s, t, point, normal);
                project_texel(&s, &s.view[v], t, uv_px);
                samples_radiance(&got, i, rgb);
                const double truth = wave(point), error = (double)rgb[0] - truth;
                assert_true(fabs(error) <= second / 8 + HALF_ROUNDING);
                assert_true(fabs((double)rgb[1] - .5 * (double)rgb[0]) <= HALF_ROUNDING);
                assert_true(rgb[2] == -rgb[0]);
                const double slope = hypot(floor_seen_at(&s.view[v], uv_px[0] + .1, uv_px[1]) -
                                               floor_seen_at(&s.view[v], uv_px[0] - .1, uv_px[1]),
                                           floor_seen_at(&s.view[v], uv_px[0], uv_px[1] + .1) -
                                               floor_seen_at(&s.view[v], uv_px[0], uv_px[1] - .1)) /
                                     .2;
                const double luminance = .2126 + .7152 * .5 - .0722;
                const double wrong = (double)samples_gradient(&got, i) - luminance * slope;
                slope_sum[0] += wrong * wrong;
                slope_sum[1] += luminance * luminance * slope * slope;
                sum += error * error;
            }
        const double rms = sqrt(sum / (double)got.n);
        fprintf(stderr, "# %3d px wide: rms error %.2e, bound %.2e, largest slope %.3f\n",
                60 * scale, rms, second / 8, first);
        const double slope_error = sqrt(slope_sum[0] / slope_sum[1]);
        fprintf(stderr, "# gradient: %.2f %% off\n", 100 * slope_error);
        if (scale > 1)
            assert_true(slope_before / slope_error > 3);
        slope_before = slope_error;
        if (scale > 1)
            assert_true(rms_before / rms > 3.6 && rms_before / rms < 4.4);
        rms_before = rms;
        samples_free(&got);
        scene_close(&s);
    }
}

// What a pixel of a real camera sees: the mean over its area.
static void paint_mean_wave_on_floor(const struct scene *s, const struct camera *camera, int x, int y,
                                     float *out)
{
    enum { N = 6 };
    (void)s;
    double sum = 0;
    for (int k = 0; k < N * N; k++)
        sum += floor_seen_at(camera, x + (k % N + .5) / N, y + (k / N + .5) / N);
    out[0] = out[1] = out[2] = (float)(sum / (N * N));
}

static double rms_off_wave(struct scene *s)
{
    struct samples got;
    double sum = 0;
    assert_int_equal(gather(&got, s), 0);
    assert_true(got.n > 1000);
    for (int t = 0; t < got.n_texels; t++)
        for (int64_t i = got.first[t]; i < got.first[t + 1]; i++) {
            double point[3], normal[3];
            float rgb[3];
            texel_point(s, t, point, normal);
            samples_radiance(&got, i, rgb);
            sum += pow((double)rgb[0] - wave(point), 2);
        }
    const double rms = sqrt(sum / (double)got.n);
    samples_free(&got);
    return rms;
}

static void the_radiance_at_the_centre_is_exact_to_second_order(void **state)
{
    (void)state;
    static const int textures[] = {320, 120}; // footprints of a pixel, and of up to two
    for (int k = 0; k < 2; k++) {
        struct scene s;
        scene_open(&s, floor_mesh(), textures[k]);
        const int v = add_view(&s, 240, 160, 220, (const double[3]){.4, -.9, 1.6},
                               (const double[3]){.05, -.02, 0});
        paint_view(&s, v, paint_mean_wave_on_floor);
        const double mean = rms_off_wave(&s);
        s.settings.at_centre = true;
        const double centre = rms_off_wave(&s);
        fprintf(stderr, "# texture %d: mean %.2e off, at the centre %.2e\n", textures[k], mean, centre);
        assert_true(centre < mean / 5);
        scene_close(&s);
    }
}

static void paint_seen_wave(const struct scene *s, const struct camera *camera, int x, int y,
                            float *out)
{
    double dir[3], at[3] = {0};
    struct ray_hit hit = {0};
    assert_true(camera_ray(camera, (const double[2]){x + .5, y + .5}, dir));
    const float from[3] = {(float)camera->centre_m[0], (float)camera->centre_m[1],
                           (float)camera->centre_m[2]},
                to[3] = {(float)dir[0], (float)dir[1], (float)dir[2]};
    const bool hits = rays_hit(s->rays, from, to, 0, INFINITY, &hit);
    vec3_add_scaled(at, camera->centre_m, (double)hit.t, dir);
    out[0] = out[1] = out[2] = hits ? (float)wave(at) : -100;
}

static void a_curved_surface_is_read_better_the_larger_the_picture(void **state)
{
    (void)state;
    double rms_before = 0;
    bool *compared = NULL; // the texels that the small picture has samples of
    for (int scale = 1; scale <= 2; scale *= 2) {
        struct scene s;
        struct mesh mesh;
        assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, (const double[3]){0}, 1, 20000), 0);
        scene_open(&s, mesh, 512);
        const int v =
            add_view(&s, 75, 60, 70, (const double[3]){1.4, -1.9, 1.6}, (const double[3]){0});
        camera_resize(&s.view[v], 75 * scale, 60 * scale);
        paint_view(&s, v, paint_seen_wave);
        struct samples got;
        assert_int_equal(gather(&got, &s), 0);
        double sum = 0, worst = 0;
        int n = 0;
        for (int t = 0; t < got.n_texels && scale == 1; t++) {
            if (!compared)
                compared = calloc((size_t)got.n_texels, sizeof(*compared));
            compared[t] = got.first[t + 1] > got.first[t];
        }
        for (int t = 0; t < got.n_texels; t++)
            for (int64_t i = got.first[t]; compared[t] && i < got.first[t + 1]; i++, n++) {
                double point[3], normal[3];
                float rgb[3];
                texel_point(&s, t, point, normal);
                samples_radiance(&got, i, rgb);
                const double error = (double)rgb[0] - wave(point);
                sum += error * error;
                worst = fmax(worst, fabs(error));
            }
        const double rms = sqrt(sum / n);
        fprintf(stderr, "# pebble, %3d px wide: %d of %lld samples, rms error %.2e, worst %.2e\n",
                75 * scale, n, (long long)got.n, rms, worst);
        assert_true(n > 20000 && worst < .3); // the background, -100, is in none
        if (scale > 1)
            assert_true(rms_before / rms > 3);
        rms_before = rms;
        samples_free(&got);
        scene_close(&s);
    }
    free(compared);
}

static void paint_own_place(const struct scene *s, const struct camera *camera, int x, int y,
                            float *out)
{
    (void)s;
    out[0] = (float)(x + .5 - camera->width_px / 2.);
    out[1] = (float)(y + .5 - camera->height_px / 2.);
}

static void no_part_of_a_pixel_is_lost_between_projection_and_picture(void **state)
{
    (void)state;
    struct scene s;
    scene_open(&s, floor_mesh(), 300);
    add_view(&s, 60, 40, 55, (const double[3]){.4, -.9, 1.6}, (const double[3]){0});
    paint_view(&s, 0, paint_own_place);
    struct samples got;
    assert_int_equal(gather(&got, &s), 0);
    assert_true(got.n > 10000);
    for (int t = 0; t < got.n_texels; t++)
        for (int64_t i = got.first[t]; i < got.first[t + 1]; i++) {
            double uv_px[2];
            float rgb[3];
            project_texel(&s, &s.view[0], t, uv_px);
            samples_radiance(&got, i, rgb);
            assert_true(fabs((double)rgb[0] + 30 - uv_px[0]) < .01);
            assert_true(fabs((double)rgb[1] + 20 - uv_px[1]) < .01);
        }
    samples_free(&got);
    scene_close(&s);
}

enum { SPOT_EVERY_PX = 7, SPOT_AT_PX = 3 };

static void paint_spots(const struct scene *s, const struct camera *camera, int x, int y,
                        float *out)
{
    (void)s, (void)camera;
    out[0] = x % SPOT_EVERY_PX == SPOT_AT_PX && y % SPOT_EVERY_PX == SPOT_AT_PX;
}

static void a_bright_pixel_is_found_where_it_is(void **state)
{
    (void)state;
    struct scene s;
    scene_open(&s, floor_mesh(), 1024);
    add_view(&s, 63, 42, 63, (const double[3]){.1, -.1, 1.6}, (const double[3]){.1, -.05, 0});
    paint_view(&s, 0, paint_spots);
    struct samples got;
    assert_int_equal(gather(&got, &s), 0);
    double sum[6][9][3] = {0};
    for (int t = 0; t < got.n_texels; t++)
        for (int64_t i = got.first[t]; i < got.first[t + 1]; i++) {
            double uv_px[2];
            float rgb[3];
            project_texel(&s, &s.view[0], t, uv_px);
            samples_radiance(&got, i, rgb);
            double *spot = sum[(int)uv_px[1] / SPOT_EVERY_PX][(int)uv_px[0] / SPOT_EVERY_PX];
            spot[0] += (double)rgb[0] * uv_px[0], spot[1] += (double)rgb[0] * uv_px[1];
            spot[2] += (double)rgb[0];
        }
    int n = 0;
    for (int j = 1; j < 5; j++)
        for (int i = 1; i < 8; i++) {
            if (sum[j][i][2] < 100) // not on the floor
                continue;
            assert_true(fabs(sum[j][i][0] / sum[j][i][2] - (i * SPOT_EVERY_PX + SPOT_AT_PX + .5)) <
                        .02);
            assert_true(fabs(sum[j][i][1] / sum[j][i][2] - (j * SPOT_EVERY_PX + SPOT_AT_PX + .5)) <
                        .02);
            n++;
        }
    assert_true(n >= 20);
    samples_free(&got);
    scene_close(&s);
}

static void paint_noise(const struct scene *s, const struct camera *camera, int x, int y,
                        float *out)
{
    (void)s;
    for (int c = 0; c < 3; c++)
        out[c] = (float)random_uniform(1, (uint64_t)c, (uint64_t)(y * camera->width_px + x));
}

// The integral of channel 0 over [0,x] x [0,y], from sums over whole pixels.
static double integral(const double *sums, int width, double x, double y)
{
    const int i = (int)x, j = (int)y, stride = width + 2;
    const double a = x - i, b = y - j;
    const double *at = sums + j * stride + i;
    return (1 - b) * ((1 - a) * at[0] + a * at[1]) +
           b * ((1 - a) * at[stride] + a * at[stride + 1]);
}

static void a_texel_larger_than_a_pixel_is_the_mean_over_its_projection(void **state)
{
    (void)state;
    struct scene s;
    scene_open(&s, floor_mesh(), 40);
    add_view(&s, 240, 160, 190, (const double[3]){.3, -1.1, .9}, (const double[3]){0, .2, 0});
    struct image image = paint(&s, 0, 240, 160, false, paint_noise);
    double *sums = calloc(242 * 162, sizeof(*sums));
    for (int y = 0; y < 160; y++)
        for (int x = 0; x < 240; x++)
            sums[(y + 1) * 242 + x + 1] = sums[y * 242 + x + 1] + sums[(y + 1) * 242 + x] -
                                          sums[y * 242 + x] + (double)image.data[(y * 240 + x) * 3];
    struct samples got;
    assert_int_equal(gather(&got, &s), 0);
    int n_between = 0, n_capped = 0;
    for (int t = 0; t < got.n_texels; t++)
        for (int64_t i = got.first[t]; i < got.first[t + 1]; i++) {
            double point[3], normal[3], uv_px[2], half[2] = {0};
            texel_point(&s, t, point, normal);
            project_texel(&s, &s.view[0], t, uv_px);
            for (int axis = 0; axis < 2; axis++) { // the floor's tangents are x and y
                double from[3] = {point[0], point[1], 0}, to[3] = {point[0], point[1], 0};
                double a_px[2], b_px[2];
                from[axis] -= 1e-6, to[axis] += 1e-6;
                assert_true(camera_project(&s.view[0], from, a_px, NULL) &&
                            camera_project(&s.view[0], to, b_px, NULL));
                for (int c = 0; c < 2; c++)
                    half[c] = hypot(half[c], .5 * (b_px[c] - a_px[c]) / 2e-6 * 2 / 40);
            }
            for (int c = 0; c < 2; c++) {
                n_between += half[c] > .6 && half[c] < 4;
                n_capped += half[c] > 4;
                half[c] = fmin(fmax(half[c], .5), 4);
            }
            const double x0 = uv_px[0] - half[0], x1 = uv_px[0] + half[0], y0 = uv_px[1] - half[1],
                         y1 = uv_px[1] + half[1];
            const double expected = (integral(sums, 240, x1, y1) - integral(sums, 240, x0, y1) -
                                     integral(sums, 240, x1, y0) + integral(sums, 240, x0, y0)) /
                                    ((x1 - x0) * (y1 - y0));
            float rgb[3];
            samples_radiance(&got, i, rgb);
            assert_true(fabs((double)rgb[0] - expected) < HALF_ROUNDING);
        }
    fprintf(stderr, "# %lld samples, %d sides of 1.2 to 8 px, %d cut to 8\n", (long long)got.n,
            n_between, n_capped);
    assert_true(got.n > 500 && n_between > 500 && n_capped > 50);
    free(sums);
    image_free(&image);
    samples_free(&got);
    scene_close(&s);
}

// ---- edges ----

enum { SUB = 8 }; // rays along a pixel's side

// Area-averaged, as a camera does: floor 1, disc 2, background 0.
static void paint_disc_and_floor(const struct scene *s, const struct camera *camera, int x, int y,
                                 float *out)
{
    (void)s;
    for (int j = 0; j < SUB; j++)
        for (int i = 0; i < SUB; i++) {
            const double u_px = x + (i + .5) / SUB, v_px = y + (j + .5) / SUB;
            double at[3];
            on_plane(camera, u_px, v_px, .4, at);
            if (hypot(at[0], at[1]) < .5) {
                out[0] += 2.f / (SUB * SUB);
                continue;
            }
            on_plane(camera, u_px, v_px, 0, at);
            out[0] += (fabs(at[0]) < 1 && fabs(at[1]) < 1) / (float)(SUB * SUB);
        }
}

static void samples_near_edges_of_what_the_camera_sees_are_left_out_and_no_others(void **state)
{
    (void)state;
    for (int erode_px = 0; erode_px <= 2; erode_px++) {
        struct scene s;
        scene_open(&s, ray_mesh_disc_above_floor(.4, .5, 400), 256);
        add_view(&s, 120, 80, 90, (const double[3]){.5, -.9, 2}, (const double[3]){0});
        paint_view(&s, 0, paint_disc_and_floor);
        s.settings.erode_px = erode_px;
        struct samples got;
        assert_int_equal(gather(&got, &s), 0);
        uint8_t *mask = malloc((size_t)s.texels.n);
        visibility_camera_mask(mask, s.rays, &s.texels, &s.view[0], .15, 1);
        int n_mixed = 0, n_left_out = 0, n_occluded = 0, n_disc = 0;
        for (int t = 0; t < got.n_texels; t++) {
            const int64_t n = got.first[t + 1] - got.first[t];
            assert_in_range(n, 0, 1);
            if (mask[t] != MASK_VISIBLE) {
                assert_int_equal(n, 0);
                n_occluded += mask[t] == MASK_OCCLUDED;
                continue;
            }
            const bool on_disc = s.texels.position_m[t][2] > .2f;
            double uv_px[2];
            project_texel(&s, &s.view[0], t, uv_px);
            if (n) { // unmixed
                float rgb[3];
                samples_radiance(&got, got.first[t], rgb);
                n_mixed += fabs((double)rgb[0] - (on_disc ? 2 : 1)) > 1e-3;
                n_disc += on_disc;
                continue;
            }
            // Left out: then within reach of the pixels read, at most 1 + erode_px along x and y,
            // something else is seen, or the picture ends.
            bool has_reason = uv_px[0] < 1 || uv_px[0] > 119 || uv_px[1] < 1 || uv_px[1] > 79;
            for (double dv = -1 - erode_px; dv <= 1 + erode_px; dv += .25)
                for (double du = -1 - erode_px; du <= 1 + erode_px; du += .25) {
                    double at[3];
                    on_plane(&s.view[0], uv_px[0] + du, uv_px[1] + dv, .4, at);
                    const bool sees_disc = hypot(at[0], at[1]) < .5;
                    on_plane(&s.view[0], uv_px[0] + du, uv_px[1] + dv, 0, at);
                    const bool sees_floor = fabs(at[0]) < 1 && fabs(at[1]) < 1;
                    has_reason = has_reason || sees_disc != on_disc || (!sees_disc && !sees_floor);
                }
            assert_true(has_reason);
            n_left_out++;
        }
        fprintf(stderr, "# erode %d px: %lld samples, %d left out, %d mixed\n", erode_px,
                (long long)got.n, n_left_out, n_mixed);
        assert_true(got.n > 10000 && n_left_out > 100 && n_occluded > 1000 && n_disc > 100);
        if (erode_px == 0)
            assert_true(n_mixed > 10); // what it is for
        else
            assert_int_equal(n_mixed, 0);
        free(mask);
        samples_free(&got);
        scene_close(&s);
    }
}

// A developed picture: every pixel is the mean of all within spread_px, and says so, or not.
struct developed {
    const struct image *from;
    int spread_px;
};

static int developed_row(void *arg, int y, float *row)
{
    const struct developed *d = arg;
    for (int x = 0; x < d->from->width; x++)
        for (int c = 0; c < 3; c++) {
            int n = 0;
            row[3 * x + c] = 0;
            for (int j = y - d->spread_px; j <= y + d->spread_px; j++)
                for (int i = x - d->spread_px; i <= x + d->spread_px; i++)
                    if (i >= 0 && j >= 0 && i < d->from->width && j < d->from->height) {
                        row[3 * x + c] += d->from->data[(j * d->from->width + i) * 3 + c];
                        n++;
                    }
            row[3 * x + c] /= (float)n;
        }
    return 0;
}

static int64_t count_mixed(const struct samples *got, const struct scene *s)
{
    int64_t n = 0;
    for (int t = 0; t < got->n_texels; t++)
        for (int64_t i = got->first[t]; i < got->first[t + 1]; i++) {
            float rgb[3];
            samples_radiance(got, i, rgb);
            n += fabs((double)rgb[0] - (s->texels.position_m[t][2] > .2f ? 2 : 1)) > 1e-3;
        }
    return n;
}

// The floor goes on behind its end: the outline has no contrast.
static void paint_disc_and_endless_floor(const struct scene *s, const struct camera *camera, int x, int y, float *out)
{
    float disc[3] = {0};
    paint_disc_and_floor(s, camera, x, y, disc);
    out[0] = fmaxf(disc[0], 1);
}

static void what_developing_spread_over_an_edge_is_left_out(void **state)
{
    (void)state;
    static const char *const names[] = {"R", "G", "B"};
    const struct { const char *note; int spread_px; int edge_px; } cases[] = {
        {"3", 3, 4}, {"0", 0, 1}, {"1", 1, 2}, {NULL, 3, 4}, {NULL, 0, 4}, {"many", 0, 4}, {"-5", 3, 4}, {"99", 3, 17},
    };
    int64_t n_of_edge[18] = {0};
    for (size_t k = 0; k < sizeof(cases) / sizeof(cases[0]); k++) {
        struct scene s;
        struct samples got;
        scene_open(&s, ray_mesh_disc_above_floor(.4, .5, 400), 128);
        s.settings.erode_px = ERODE_BY_PICTURE;
        add_view(&s, 120, 80, 90, (const double[3]){.5, -.9, 2}, (const double[3]){0});
        struct image sharp = paint(&s, 0, 120, 80, false, paint_disc_and_endless_floor);
        struct developed d = {&sharp, cases[k].spread_px};
        const struct image_note note = {IMAGE_SPREAD_NOTE, cases[k].note, 0};
        const struct image_rows rows = {120, 80, 3, names, developed_row, &d};
        assert_int_equal(image_write_exr_rows(&rows, &note, cases[k].note != NULL, s.path[0], IMAGE_FLOAT, IMAGE_ZIP), 0);
        assert_int_equal(gather(&got, &s), 0);
        const int64_t n_mixed = count_mixed(&got, &s);
        fprintf(stderr, "# spread %d px, note %s: %d px away, %lld samples, %lld mixed\n", cases[k].spread_px, cases[k].note ? cases[k].note : "-",
                got.edge_px, (long long)got.n, (long long)n_mixed);
        assert_int_equal(n_mixed, 0);
        assert_true(isnan(got.edge_reach_px));
        assert_int_equal(got.edge_px, cases[k].edge_px);
        assert_true(!n_of_edge[got.edge_px] || got.n == n_of_edge[got.edge_px]);
        n_of_edge[got.edge_px] = got.n;
        image_free(&sharp);
        samples_free(&got);
        scene_close(&s);
    }
    assert_true(n_of_edge[4] < n_of_edge[2] && n_of_edge[2] < n_of_edge[1] && n_of_edge[4] > n_of_edge[1] / 2 && n_of_edge[17]);
}

// An object of radiance 2 before a background of .5, area-averaged.
static void paint_outline(const struct scene *s, const struct camera *camera, int x, int y, float *out)
{
    enum { N = 5 };
    int n = 0;
    const float from[3] = {(float)camera->centre_m[0], (float)camera->centre_m[1], (float)camera->centre_m[2]};
    for (int k = 0; k < N * N; k++) {
        double dir[3];
        struct ray_hit hit;
        assert_true(camera_ray(camera, (const double[2]){x + (k % N + .5) / N, y + (k / N + .5) / N}, dir));
        n += rays_hit(s->rays, from, (const float[3]){(float)dir[0], (float)dir[1], (float)dir[2]}, 0, INFINITY, &hit);
    }
    out[0] = out[1] = out[2] = .5f + 1.5f * (float)n / (N * N);
}

// Another program has developed the pictures: they say nothing. Or they say too little.
static void light_that_came_over_the_outline_by_any_way_is_left_out(void **state)
{
    (void)state;
    static const char *const names[] = {"R", "G", "B"};
    const struct { const char *note; int spread_px, least_px, most_px; } cases[] = {
        {NULL, 0, 1, 1}, {NULL, 1, 2, 3}, {NULL, 3, 4, 5}, {NULL, 6, 7, 9}, {"0", 0, 1, 1}, {"0", 3, 4, 5}, {"3", 0, 4, 4}, {"2", 3, 4, 5},
    };
    enum { W = 180, H = 120, N_VIEWS = 3 };
    for (size_t k = 0; k < sizeof(cases) / sizeof(cases[0]); k++) {
        struct scene s;
        struct mesh mesh;
        struct samples got, sharp_got;
        assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, (const double[3]){0}, 1, 5000), 0);
        scene_open(&s, mesh, 128);
        for (int v = 0; v < N_VIEWS; v++) {
            add_view(&s, W, H, 170, (const double[3]){2.4 * cos(v), 2.4 * sin(v), 1.1}, (const double[3]){0});
            struct image sharp = paint(&s, v, W, H, false, paint_outline);
            struct developed d = {&sharp, cases[k].spread_px};
            const struct image_note note = {IMAGE_SPREAD_NOTE, cases[k].note, 0};
            const struct image_rows rows = {W, H, 3, names, developed_row, &d};
            assert_int_equal(image_write_exr_rows(&rows, &note, cases[k].note != NULL, s.path[v], IMAGE_FLOAT, IMAGE_ZIP), 0);
            image_free(&sharp);
        }
        assert_int_equal(gather(&sharp_got, &s), 0);
        s.settings.erode_px = ERODE_BY_PICTURE;
        assert_int_equal(gather(&got, &s), 0);
        int64_t n_mixed = 0, n_mixed_sharp = 0;
        for (int64_t i = 0; i < got.n; i++)
            n_mixed += float_from_half(got.radiance[i][0]) < 2 - .03f;
        for (int64_t i = 0; i < sharp_got.n; i++)
            n_mixed_sharp += float_from_half(sharp_got.radiance[i][0]) < 2 - .03f;
        fprintf(stderr, "# spread %d px, note %s: seen %.2f px far, %d px away: %lld samples, %lld mixed; 1 px away: %lld, %lld\n", cases[k].spread_px,
                cases[k].note ? cases[k].note : "-", got.edge_reach_px, got.edge_px, (long long)got.n, (long long)n_mixed, (long long)sharp_got.n,
                (long long)n_mixed_sharp);
        assert_in_range(got.edge_px, cases[k].least_px, cases[k].most_px);
        assert_true(got.n > 1000 && fabs(got.edge_offset_px) < .3);
        assert_int_equal(n_mixed, 0);
        if (cases[k].spread_px)
            assert_true(n_mixed_sharp > 10); // the fault is there, which at 1 px few texels show
        samples_free(&got);
        samples_free(&sharp_got);
        scene_close(&s);
    }
}

// ---- who has samples ----

struct brute {
    const struct scene *scene;
    const struct camera *camera;
    double (*seen_m)[3]; // per pixel; NaN: nothing
    bool *is_close;      // per pixel: the ray passes so near an edge that rounding may decide
};

static const double CLOSE_M = 5e-7;

static void look_through_all_pixels(struct brute *b)
{
    const struct mesh *mesh = &b->scene->mesh;
    for (int y = 0; y < b->camera->height_px; y++)
        for (int x = 0; x < b->camera->width_px; x++) {
            const int k = y * b->camera->width_px + x;
            double dir[3], nearest = INFINITY;
            int n_close = 0; // front faces at `nearest` that it may miss; of two, it meets one
            bool is_sure = true;
            assert_true(camera_ray(b->camera, (const double[2]){ x + .5, y + .5 }, dir));
            for (int i = 0; i < mesh->n_triangles; i++) {
                const double margin =
                    ray_margin_of_triangle_m(mesh, i, b->camera->centre_m, dir, 0, INFINITY);
                if (!(margin > -CLOSE_M))
                    continue;
                double p[3][3], e1[3], e2[3], normal[3], to[3];
                for (int j = 0; j < 3; j++)
                    for (int c = 0; c < 3; c++)
                        p[j][c] = (double)mesh->position_m[mesh->triangle[i][j]][c];
                vec3_sub(e1, p[1], p[0]);
                vec3_sub(e2, p[2], p[0]);
                vec3_cross(normal, e1, e2);
                vec3_sub(to, p[0], b->camera->centre_m);
                const double facing = vec3_dot(normal, dir), t = vec3_dot(normal, to) / facing;
                if (t < nearest - 1e-5)
                    n_close = 0, is_sure = false;
                if (t < nearest + 1e-5) {
                    n_close += facing < 0;
                    is_sure = is_sure || margin > CLOSE_M || n_close > 1;
                }
                nearest = fmin(nearest, t);
            }
            b->is_close[k] = !is_sure;
            for (int c = 0; c < 3; c++)
                b->seen_m[k][c] =
                    nearest < INFINITY ? b->camera->centre_m[c] + nearest * dir[c] : NAN;
        }
}

// 1: has a sample; 0: none; -1: too close to say. The rule of samples.h, in double, by brute force.
static int has_sample(const struct brute *b, int t, int erode_px)
{
    const struct scene *s = b->scene;
    const struct camera *camera = b->camera;
    double point[3], normal[3], view[3], uv_px[2], tangent[3], bitangent[3];
    texel_point(s, t, point, normal);
    if (!camera_project(camera, point, uv_px, NULL))
        return 0;
    vec3_sub(view, camera->centre_m, point);
    vec3_normalise(view);
    const double cosine = vec3_dot(view, normal);
    if (fabs(cosine - .15) < 1e-6)
        return -1;
    float start[3];
    rays_start(s->rays, s->texels.triangle[t], s->texels.barycentric[t], start);
    const double from[3] = {(double)start[0], (double)start[1], (double)start[2]};
    double dir[3];
    vec3_sub(dir, camera->centre_m, from);
    const double margin = ray_margin_m(&s->mesh, from, dir, 0, 1);
    // The square that is the texel, by differences.
    for (int c = 0; c < 3; c++)
        tangent[c] = (double)s->texels.tangent[t][c];
    vec3_cross(bitangent, normal, tangent);
    const double size_m = (double)s->texels.texel_size_m, h = 1e-4;
    double M[2][2], half[2];
    for (int k = 0; k < 2; k++) {
        double a[3], z[3], a_px[2], z_px[2];
        vec3_add_scaled(a, point, h * size_m, k ? bitangent : tangent);
        vec3_add_scaled(z, point, -h * size_m, k ? bitangent : tangent);
        assert_true(camera_project(camera, a, a_px, NULL) && camera_project(camera, z, z_px, NULL));
        for (int c = 0; c < 2; c++)
            M[c][k] = (a_px[c] - z_px[c]) / (2 * h);
    }
    const double end_px[2] = {camera->width_px, camera->height_px};
    int first[2], end[2];
    bool too_close = fabs(margin) < CLOSE_M;
    if (cosine < .15 || margin > CLOSE_M)
        return 0;
    for (int c = 0; c < 2; c++) {
        half[c] = .5 * fmin(fmax(hypot(M[c][0], M[c][1]), 1), 8);
        const double low = uv_px[c] - half[c], high = uv_px[c] + half[c];
        if (low < .5 - 1e-6 || high > end_px[c] - .5 + 1e-6)
            return 0;
        too_close = too_close || low < .5 + 1e-6 || high > end_px[c] - .5 - 1e-6 ||
                    fabs(low - nearbyint(low)) < 1e-6 || fabs(high - nearbyint(high)) < 1e-6;
        first[c] = (int)fmax(0, floor(low) - erode_px);
        end[c] = (int)fmin(end_px[c], ceil(high) + erode_px);
    }
    const double det = M[0][0] * M[1][1] - M[0][1] * M[1][0];
    bool is_alone = true;
    for (int y = first[1]; y < end[1]; y++)
        for (int x = first[0]; x < end[0]; x++) {
            const int k = y * camera->width_px + x;
            const double dx = x + .5 - uv_px[0], dy = y + .5 - uv_px[1];
            const double along = hypot(M[1][1] * dx - M[0][1] * dy, M[0][0] * dy - M[1][0] * dx) /
                                 fabs(det) * size_m;
            double off[3];
            vec3_sub(off, b->seen_m[k], point);
            const double excess = fabs(vec3_dot(off, normal)) - 4 * size_m - along / 4;
            too_close = too_close || b->is_close[k] || fabs(excess) < 2e-6;
            is_alone = is_alone && excess < 0; // false for NaN
        }
    return too_close ? -1 : is_alone;
}

static void every_texel_has_the_samples_that_brute_force_finds_in_order_of_views(void **state)
{
    (void)state;
    struct scene s;
    scene_open(&s, ray_mesh_bumpy(40, 20), 72);
    add_view(&s, 90, 60, 150, (const double[3]){.5, -.2, .1}, (const double[3]){0});
    add_view(&s, 60, 90, 190, (const double[3]){-.3, -.4, .2}, (const double[3]){0, .02, .03});
    add_view(&s, 60, 40, 100, (const double[3]){0, .3, .5}, (const double[3]){0});
    add_view(&s, 200, 150, 500, (const double[3]){.3, .4, -.4}, (const double[3]){.04, 0, 0});
    struct samples got;
    s.view[0].k[0] = .1;
    for (int v = 0; v < 4; v++)
        paint_view(&s, v, paint_noise);
    s.paths[2] = NULL;
    assert_int_equal(gather(&got, &s), 0);
    assert_int_equal(got.n_views, 4);
    assert_int_equal(got.n_texels, s.texels.n);
    assert_int_equal(got.first[0], 0);
    assert_int_equal(got.first[got.n_texels], got.n);
    bool *has = calloc((size_t)got.n_texels * 4, sizeof(*has));
    for (int t = 0; t < got.n_texels; t++)
        for (int64_t i = got.first[t]; i < got.first[t + 1]; i++) {
            assert_true(got.view[i] < 4 && (i == got.first[t] || got.view[i] > got.view[i - 1]));
            has[t * 4 + got.view[i]] = true;
        }
    int64_t n_yes = 0, n_no_though_visible = 0, n_unsaid = 0;
    for (int v = 0; v < 4; v++) {
        assert_string_equal(got.name[v], s.view[v].name);
        assert_memory_equal(got.centre_m[v], s.view[v].centre_m, sizeof(got.centre_m[v]));
        const size_t n_pixels = (size_t)(s.view[v].width_px * s.view[v].height_px);
        struct brute b = {&s, &s.view[v], malloc(n_pixels * sizeof(b.seen_m[0])),
                          calloc(n_pixels, sizeof(b.is_close[0]))};
        uint8_t *mask = malloc((size_t)s.texels.n);
        visibility_camera_mask(mask, s.rays, &s.texels, &s.view[v], .15, 1);
        if (v != 2)
            look_through_all_pixels(&b);
        for (int t = 0; t < got.n_texels; t++) {
            const int expected = v == 2 ? 0 : has_sample(&b, t, 1);
            if (expected >= 0)
                assert_int_equal(has[t * 4 + v], expected);
            n_yes += expected == 1, n_unsaid += expected < 0;
            n_no_though_visible += expected == 0 && v != 2 && mask[t] == MASK_VISIBLE;
        }
        free(mask);
        free(b.seen_m);
        free(b.is_close);
    }
    fprintf(stderr,
            "# brute force: %lld samples (%lld gathered), %lld visible but near an edge, %lld "
            "too close to say\n",
            (long long)n_yes, (long long)got.n, (long long)n_no_though_visible,
            (long long)n_unsaid);
    assert_true(n_yes > 1000 && n_no_though_visible > 200 && n_unsaid * 50 < n_yes);
    free(has);
    samples_free(&got);
    scene_close(&s);
}

static void a_view_direction_points_from_texel_to_camera(void **state)
{
    (void)state;
    struct scene s;
    scene_open(&s, floor_mesh(), 16);
    add_view(&s, 60, 40, 55, (const double[3]){.4, -.9, 1.6}, (const double[3]){0});
    paint_view(&s, 0, paint_noise);
    struct samples got;
    assert_int_equal(gather(&got, &s), 0);
    for (int t = 0; t < s.texels.n; t++) {
        float d[3];
        double point[3], normal[3], to[3];
        texel_point(&s, t, point, normal);
        samples_view_direction(&got, &s.texels, t, 0, d);
        vec3_sub(to, s.view[0].centre_m, point);
        const double distance = vec3_norm(to);
        for (int c = 0; c < 3; c++)
            assert_true(fabs(point[c] + distance * (double)d[c] - s.view[0].centre_m[c]) < 1e-6);
    }
    samples_free(&got);
    scene_close(&s);
}

static void any_number_of_threads_gathers_the_same_bytes(void **state)
{
    (void)state;
    struct scene s;
    scene_open(&s, ray_mesh_bumpy(40, 20), 160);
    add_view(&s, 90, 60, 150, (const double[3]){.5, -.2, .1}, (const double[3]){0});
    add_view(&s, 60, 90, 190, (const double[3]){-.3, -.4, .2}, (const double[3]){0});
    paint_view(&s, 0, paint_noise);
    paint_view(&s, 1, paint_noise);
    struct samples one, three;
    s.settings.n_threads = 1;
    assert_int_equal(gather(&one, &s), 0);
    s.settings.n_threads = 3;
    assert_int_equal(gather(&three, &s), 0);
    assert_true(one.n == three.n && one.n > 3000);
    assert_memory_equal(one.first, three.first, (size_t)(one.n_texels + 1) * sizeof(*one.first));
    assert_memory_equal(one.view, three.view, (size_t)one.n * sizeof(*one.view));
    assert_memory_equal(one.radiance, three.radiance, (size_t)one.n * sizeof(*one.radiance));
    assert_memory_equal(one.gradient, three.gradient, (size_t)one.n * sizeof(*one.gradient));
    assert_memory_equal(one.flags, three.flags, (size_t)one.n);
    samples_free(&one);
    samples_free(&three);
    scene_close(&s);
}

// ---- clipping ----

enum { SPOT_X = 21, SPOT_Y = 13 };

// One pixel is marked in the clip channel; another is beyond white in G.
static void paint_two_marks(const struct scene *s, const struct camera *camera, int x, int y,
                            float *out)
{
    (void)s, (void)camera;
    out[0] = out[1] = out[2] = .25f;
    if (x == 2 * SPOT_X && y == SPOT_Y)
        out[1] = 2;
    if (camera->fy > camera->fx * 1.005) // the view with a clip channel
        out[3] = x == SPOT_X && y == SPOT_Y;
}

static void paint_bright_green(const struct scene *s, const struct camera *camera, int x, int y,
                               float *out)
{
    (void)s, (void)camera;
    out[0] = out[2] = .25f, out[1] = x == 2 * SPOT_X && y == SPOT_Y ? 2 : .25f;
}

static void a_sample_is_clipped_where_a_pixel_under_it_is(void **state)
{
    (void)state;
    struct scene s;
    scene_open(&s, floor_mesh(), 128);
    add_view(&s, 60, 40, 55, (const double[3]){.4, -.9, 1.6}, (const double[3]){0});
    add_view(&s, 60, 40, 55, (const double[3]){.4, -.9, 1.6}, (const double[3]){0});
    struct image with_clip = paint(&s, 0, 60, 40, true, paint_two_marks);
    image_free(&with_clip);
    paint_view(&s, 1, paint_bright_green);
    for (int white = 0; white <= 1; white++) {
        s.settings.white = white;
        struct samples got;
        assert_int_equal(gather(&got, &s), 0);
        int n[2] = {0};
        for (int t = 0; t < got.n_texels; t++)
            for (int64_t i = got.first[t]; i < got.first[t + 1]; i++) {
                const int v = got.view[i];
                double uv_px[2];
                project_texel(&s, &s.view[v], t, uv_px);
                const bool is_under = fabs(uv_px[0] - (v ? 2 * SPOT_X : SPOT_X) - .5) < 1 &&
                                      fabs(uv_px[1] - SPOT_Y - .5) < 1;
                assert_int_equal(got.flags[i], is_under && (v == 0 || white) ? SAMPLE_CLIPPED : 0);
                n[v] += got.flags[i];
            }
        assert_true(n[0] > 5 && (n[1] > 5) == (white == 1));
        assert_true(fabs(got.clipped_share - (double)(n[0] + n[1]) / (double)got.n) < 1e-12);
        samples_free(&got);
    }
    scene_close(&s);
}

// ---- other pictures ----

static void paint_own_place_of_60(const struct scene *s, const struct camera *camera, int x, int y,
                                  float *out)
{
    (void)s;
    out[0] = (float)((x + .5) * 60 / camera->width_px - 30);
    out[1] = (float)((y + .5) * 40 / camera->height_px - 20);
}

static void a_picture_of_another_size_gives_the_same_radiance(void **state)
{
    (void)state;
    static const int size[][2] = {{120, 80}, {100, 67}, {45, 30}};
    for (int k = 0; k < 3; k++) {
        struct scene s;
        scene_open(&s, floor_mesh(), 300);
        add_view(&s, 60, 40, 55, (const double[3]){.4, -.9, 1.6}, (const double[3]){0});
        struct image image = paint(&s, 0, size[k][0], size[k][1], false, paint_own_place_of_60);
        image_free(&image);
        struct samples got;
        assert_int_equal(gather(&got, &s), 0);
        assert_true(got.n > 10000);
        for (int t = 0; t < got.n_texels; t++)
            for (int64_t i = got.first[t]; i < got.first[t + 1]; i++) {
                double uv_px[2];
                float rgb[3];
                project_texel(&s, &s.view[0], t, uv_px);
                samples_radiance(&got, i, rgb);
                assert_true(fabs((double)rgb[0] + 30 - uv_px[0]) < .01);
                assert_true(fabs((double)rgb[1] + 20 - uv_px[1]) < .01);
            }
        samples_free(&got);
        scene_close(&s);
    }
}

static void keep_message(void *arg, enum log_level level, const char *message)
{
    char *kept = arg;
    if (level == LOG_ERROR)
        snprintf(kept + strlen(kept), 1000 - strlen(kept), "%s\n", message);
}

// Gathers; the one error logged must hold each of the words.
static void assert_refused(const struct scene *s, int expected, const char *const *words)
{
    static const struct samples none;
    char message[1000] = "";
    struct samples got;
    log_set_level(LOG_SILENT);
    log_set_hook(keep_message, message);
    const int err = gather(&got, s);
    log_set_hook(NULL, NULL);
    log_set_level(LOG_INFO);
    assert_int_equal(err, expected);
    assert_memory_equal(&got, &none, sizeof(got));
    for (; *words; words++)
        assert_non_null(strstr(message, *words));
    assert_true(*message && strchr(message, '\n')[1] == 0); // one line
}

static void a_picture_that_does_not_belong_is_refused_by_name(void **state)
{
    (void)state;
    struct scene s;
    scene_open(&s, floor_mesh(), 32);
    add_view(&s, 60, 40, 55, (const double[3]){.4, -.9, 1.6}, (const double[3]){0});
    add_view(&s, 60, 40, 55, (const double[3]){.4, -.9, 1.6}, (const double[3]){0});
    paint_view(&s, 0, paint_noise);
    static const int wrong[][2] = {{60, 41}, {61, 40}, {40, 60}, {120, 82}, {20, 20}};
    for (int k = 0; k < 5; k++) {
        struct image image = paint(&s, 1, wrong[k][0], wrong[k][1], false, paint_noise);
        image_free(&image);
        char size[40];
        snprintf(size, sizeof(size), "%d x %d", wrong[k][0], wrong[k][1]);
        assert_refused(&s, -EINVAL,
                       (const char *const[]){"cam01", s.path[1], size, "60 x 40", NULL});
    }
    static const char *const names[] = {"R", "G", "Z"};
    struct image image;
    assert_int_equal(image_new(&image, 60, 40, 3, names), 0);
    assert_int_equal(image_write_exr(&image, s.path[1], IMAGE_HALF, IMAGE_ZIP), 0);
    image_free(&image);
    assert_refused(&s, -EINVAL, (const char *const[]){"cam01", s.path[1], "channel B", NULL});
    unlink(s.path[1]);
    assert_refused(&s, -ENOENT, (const char *const[]){s.path[1], NULL});
    scene_close(&s);
}

static void write_tiff_with_nan(const char *path, int width, int height, int n_channels, int bad)
{
    // A little-endian TIFF of 32-bit floats in one strip, after its only directory.
    const uint32_t n_bytes = (uint32_t)(width * height * n_channels) * 4;
    const uint16_t tags[][2] = {{256, 3}, {257, 3}, {258, 3}, {259, 3}, {262, 3},
                                {273, 4}, {277, 3}, {278, 3}, {279, 4}, {339, 3}};
    const uint32_t bits_at = 8 + 2 + 10 * 12 + 4, kinds_at = bits_at + 8, data_at = kinds_at + 8;
    const uint32_t value[10] = {
        (uint32_t)width, (uint32_t)height,     bits_at,          1,       2,
        data_at,         (uint32_t)n_channels, (uint32_t)height, n_bytes, kinds_at};
    FILE *f = fopen(path, "wb");
    assert_non_null(f);
    fwrite("II*\0\10\0\0\0\12\0", 1, 10, f);
    for (int i = 0; i < 10; i++) {
        const uint32_t count = i == 2 || i == 9 ? (uint32_t)n_channels : 1;
        fwrite(tags[i], 1, 4, f);
        fwrite(&count, 1, 4, f);
        fwrite(&value[i], 1, 4, f);
    }
    const uint32_t none = 0;
    const uint16_t bits[4] = {32, 32, 32, 32}, kinds[4] = {3, 3, 3, 3};
    fwrite(&none, 1, 4, f);
    fwrite(bits, 1, 8, f);
    fwrite(kinds, 1, 8, f);
    for (int i = 0; i < width * height * n_channels; i++) {
        const float pixel = i == bad ? NAN : .5f;
        fwrite(&pixel, 1, 4, f);
    }
    assert_int_equal(fclose(f), 0);
}

static void a_pixel_that_is_no_number_refuses_the_view_by_name(void **state)
{
    (void)state;
    struct scene s;
    scene_open(&s, floor_mesh(), 32);
    add_view(&s, 60, 40, 55, (const double[3]){.4, -.9, 1.6}, (const double[3]){0});
    struct samples got;
    write_tiff_with_nan(s.path[0], 60, 40, 3, -1);
    assert_int_equal(gather(&got, &s), 0);
    assert_true(got.n > 100);
    samples_free(&got);
    write_tiff_with_nan(s.path[0], 60, 40, 3, (7 * 60 + 11) * 3 + 2);
    assert_refused(&s, -EDOM,
                   (const char *const[]){"cam00", "channel B", "column 11", "row 7", NULL});
    scene_close(&s);
}

// ---- a path-traced studio ----

static double area_per_texel_m2(const struct mesh *mesh, int triangle, int texture)
{
    const uint32_t *corner = mesh->triangle[triangle];
    double side[2][3], uv[2][2], across[3];
    for (int k = 0; k < 2; k++) {
        for (int c = 0; c < 3; c++)
            side[k][c] = (double)mesh->position_m[corner[k + 1]][c] -
                         (double)mesh->position_m[corner[0]][c];
        for (int c = 0; c < 2; c++)
            uv[k][c] = (double)mesh->uv[corner[k + 1]][c] - (double)mesh->uv[corner[0]][c];
    }
    vec3_cross(across, side[0], side[1]);
    return vec3_norm(across) / fabs(uv[0][0] * uv[1][1] - uv[0][1] * uv[1][0]) / texture / texture;
}

// Between the pixel's ray and the normal where it hits; NaN: it does not.
static double cosine_seen(const struct scene *s, const struct camera *camera, int x, int y)
{
    double dir[3], normal[3];
    struct ray_hit hit;
    assert_true(camera_ray(camera, (const double[2]){ x + .5, y + .5 }, dir));
    const float from[3] = { (float)camera->centre_m[0], (float)camera->centre_m[1],
                            (float)camera->centre_m[2] },
                to[3] = { (float)dir[0], (float)dir[1], (float)dir[2] };
    if (!rays_hit(s->rays, from, to, 0, INFINITY, &hit))
        return NAN;
    const uint32_t *corner = s->mesh.triangle[hit.triangle];
    for (int c = 0; c < 3; c++)
        normal[c] = (double)((1 - hit.u - hit.v) * s->mesh.normal[corner[0]][c] +
                             hit.u * s->mesh.normal[corner[1]][c] +
                             hit.v * s->mesh.normal[corner[2]][c]);
    vec3_normalise(normal);
    return -vec3_dot(normal, dir);
}

static void the_pebble_studio_is_gathered(void **state)
{
    (void)state;
    static const char dir[] = "../shared/data/studio-pebble";
    if (access("../shared/data/studio-pebble/geometry/mesh.obj", R_OK)) {
        fprintf(stderr, "# %s is not here: not checked\n", dir);
        return;
    }
    struct mesh mesh;
    struct scene s;
    struct take *take;
    struct cameras cameras;
    assert_int_equal(take_open(&take, dir), 0);
    assert_int_equal(mesh_read(&mesh, NULL, take->mesh_path), 0);
    assert_int_equal(cameras_read(&cameras, take->cameras_path), 0);
    scene_open(&s, mesh, 256);
    const char *paths[85] = {NULL};
    assert_int_equal(cameras.n, 85);
    for (int v = 0; v < 85; v++)
        for (int k = 0; k < take->n_views; k++)
            if (!strcmp(take->view_names[k], cameras.view[v].name))
                paths[v] = take->view_paths[k];
    struct samples got;
    assert_int_equal(samples_gather(&got, &s.texels, s.rays, &cameras, paths, &s.settings), 0);
    // Per view, where the surface faces the camera: samples weighted by the pixels their texels
    // cover, against the picture's own pixels.
    double *texel_area_m2 = malloc((size_t)s.mesh.n_triangles * sizeof(*texel_area_m2));
    for (int i = 0; i < s.mesh.n_triangles; i++)
        texel_area_m2[i] = area_per_texel_m2(&s.mesh, i, 256);
    double(*sum)[2] = calloc(85, sizeof(*sum)), worst = 0, all[2] = { 0 }, whole[2] = { 0 };
    for (int t = 0; t < got.n_texels; t++)
        for (int64_t i = got.first[t]; i < got.first[t + 1]; i++) {
            const int v = got.view[i];
            double point[3], normal[3], view[3];
            float rgb[3];
            texel_point(&s, t, point, normal);
            vec3_sub(view, got.centre_m[v], point);
            const double distance_m = vec3_normalise(view), cosine = vec3_dot(view, normal);
            const double px = cameras.view[v].fx / distance_m;
            if (cosine < .4)
                continue;
            samples_radiance(&got, i, rgb);
            const double area = texel_area_m2[s.texels.triangle[t]] * cosine * px * px;
            sum[v][0] += area * (double)rgb[1], sum[v][1] += area;
        }
    for (int v = 0; v < 85; v++) {
        struct image image;
        double pixels[2] = { 0 };
        assert_int_equal(image_read(&image, paths[v]), 0);
        for (int y = 0; y < image.height; y += 3)
            for (int x = 0; x < image.width; x += 3) {
                if (!(cosine_seen(&s, &cameras.view[v], x, y) >= .4))
                    continue;
                pixels[0] += (double)image.data[(y * image.width + x) * image.n_channels + 1];
                pixels[1]++;
            }
        worst = fmax(worst, fabs(sum[v][0] / sum[v][1] / (pixels[0] / pixels[1]) - 1));
        for (int c = 0; c < 2; c++)
            all[c] += sum[v][c], whole[c] += pixels[c];
        image_free(&image);
    }
    const double ratio = all[0] / all[1] / (whole[0] / whole[1]);
    fprintf(stderr,
            "# pebble: %d texels, %lld samples, %.1f a texel, %.2f %% clipped; mean green %.4f "
            "of the picture's, one view's %.1f %% off at most\n",
            got.n_texels, (long long)got.n, (double)got.n / got.n_texels, 100 * got.clipped_share,
            ratio, 100 * worst);
    assert_true(fabs(ratio - 1) < .03 && worst < .1);
    assert_true(got.n > 10 * got.n_texels && got.n < 45 * got.n_texels);
    free(sum);
    free(texel_area_m2);
    samples_free(&got);
    cameras_free(&cameras);
    take_close(take);
    scene_close(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_smooth_surface_is_read_to_the_accuracy_of_bilinear_interpolation),
        cmocka_unit_test(the_radiance_at_the_centre_is_exact_to_second_order),
        cmocka_unit_test(a_curved_surface_is_read_better_the_larger_the_picture),
        cmocka_unit_test(no_part_of_a_pixel_is_lost_between_projection_and_picture),
        cmocka_unit_test(a_bright_pixel_is_found_where_it_is),
        cmocka_unit_test(a_texel_larger_than_a_pixel_is_the_mean_over_its_projection),
        cmocka_unit_test(samples_near_edges_of_what_the_camera_sees_are_left_out_and_no_others),
        cmocka_unit_test(what_developing_spread_over_an_edge_is_left_out),
        cmocka_unit_test(light_that_came_over_the_outline_by_any_way_is_left_out),
        cmocka_unit_test(every_texel_has_the_samples_that_brute_force_finds_in_order_of_views),
        cmocka_unit_test(a_view_direction_points_from_texel_to_camera),
        cmocka_unit_test(any_number_of_threads_gathers_the_same_bytes),
        cmocka_unit_test(a_sample_is_clipped_where_a_pixel_under_it_is),
        cmocka_unit_test(a_picture_of_another_size_gives_the_same_radiance),
        cmocka_unit_test(a_picture_that_does_not_belong_is_refused_by_name),
        cmocka_unit_test(a_pixel_that_is_no_number_refuses_the_view_by_name),
        cmocka_unit_test(the_pebble_studio_is_gathered),
    };
    return cmocka_run_group_tests(tests, make_dir, remove_dir);
}
