// tests/test_panorama.c - directions, solid angles and energy of a panorama, and what is refused.
#include "solver/panorama.h"
#include "solver/random.h"
#include "solver/take/log.h"
#include "solver/vec3.h"
#include "tests/scratch.h"

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

enum { SEED = 3 };

static char last_error[1024], last_warning[1024];

static void remember(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    if (level == LOG_ERROR)
        snprintf(last_error, sizeof(last_error), "%s", message);
    if (level == LOG_WARNING)
        snprintf(last_warning, sizeof(last_warning), "%s", message);
}

// ---- directions and solid angles ----------------------------------------------------------------

static void assert_direction(double x_px, double y_px, double x, double y, double z)
{
    double d[3];
    panorama_direction(2048, 1024, x_px, y_px, d);
    assert_float_equal(d[0], x, 1e-15);
    assert_float_equal(d[1], y, 1e-15);
    assert_float_equal(d[2], z, 1e-15);
}

static void the_axes_lie_where_openexr_puts_them(void **state)
{
    (void)state;
    assert_direction(1024, 512, 0, 0, 1); // middle
    assert_direction(512, 512, 1, 0, 0);
    assert_direction(1536, 512, -1, 0, 0);
    assert_direction(0, 512, 0, 0, -1); // left edge: longitude 180
    assert_direction(2048, 512, 0, 0, -1);
    assert_direction(300, 0, 0, 1, 0); // top row: up
    assert_direction(300, 1024, 0, -1, 0);
}

static void direction_and_pixel_are_inverse(void **state)
{
    (void)state;
    for (uint64_t i = 0; i < 10000; i++) {
        const double x = 512 * random_uniform(SEED, 1, i), y = 256 * random_uniform(SEED, 2, i);
        double d[3], x_back, y_back;
        panorama_direction(512, 256, x, y, d);
        assert_float_equal(vec3_norm(d), 1, 1e-15);
        for (int k = 0; k < 3; k++)
            d[k] *= 7.5; // length does not matter
        panorama_pixel(512, 256, d, &x_back, &y_back);
        assert_float_equal(y_back, y, 1e-12 * 256);
        assert_float_equal(x_back, x, 1e-12 * 512 / sin(M_PI * y / 256));
    }
    double x, y;
    const double edge[3] = {-0., 0, -1}, down[3] = {0, -2, 0};
    panorama_pixel(512, 256, edge, &x, &y);
    assert_true(x == 0 && y == 128); // never x = width
    panorama_pixel(512, 256, down, &x, &y);
    assert_true(x >= 0 && x < 512 && y == 256);
}

static void solid_angles_are_the_bands_of_the_sphere(void **state)
{
    (void)state;
    static const int heights[] = {1, 2, 7, 512, 32768};
    for (int i = 0; i < 5; i++) {
        const int h = heights[i], w = 2 * h;
        double sum = 0;
        for (int y = 0; y < h; y++) {
            const double omega = panorama_solid_angle(w, h, y);
            const double band = 2 * M_PI / w * (cos(M_PI * y / h) - cos(M_PI * (y + 1) / h));
            assert_float_equal(omega, band, 1e-15);
            sum += w * omega;
        }
        assert_float_equal(sum, 4 * M_PI, 1e-11);
    }
}

static struct panorama filled(int height, float value)
{
    struct panorama p;
    assert_int_equal(image_new(&p.image, 2 * height, height, 3, NULL), 0);
    for (int i = 0; i < 6 * height * height; i++)
        p.image.data[i] = value;
    return p;
}

static void a_constant_sky_sums_to_4_pi_and_lights_a_patch_with_pi(void **state)
{
    (void)state;
    struct panorama p = filled(256, 2);
    double total[3], irradiance[3];
    panorama_total(&p, total);
    for (int c = 0; c < 3; c++)
        assert_float_equal(total[c], 8 * M_PI, 1e-12);
    for (uint64_t i = 0; i < 8; i++) {
        double n[3] = {random_normal(SEED, 4, i), random_normal(SEED, 5, i),
                       random_normal(SEED, 6, i)};
        vec3_normalise(n);
        panorama_irradiance(&p, n, irradiance);
        for (int c = 0; c < 3; c++)
            assert_float_equal(irradiance[c], 2 * M_PI,
                               2e-4); // (pi/H)^2 / 6: the cosine at pixel centres
    }
    panorama_free(&p);
    assert_null(p.image.data);
}

static void a_lone_pixel_lights_by_its_cosine_and_not_from_behind(void **state)
{
    (void)state;
    struct panorama p = filled(64, 0);
    for (uint64_t i = 0; i < 50; i++) {
        const int x = (int)(128 * random_uniform(SEED, 7, i)),
                  y = (int)(64 * random_uniform(SEED, 8, i));
        float *pixel = p.image.data + 3 * (128 * y + x);
        double d[3], n[3], back[3], irradiance[3];
        pixel[0] = 5, pixel[1] = 1, pixel[2] = .5f;
        panorama_direction(128, 64, x + .5, y + .5, d);
        for (int k = 0; k < 3; k++)
            n[k] = d[k] + .3 * random_normal(SEED, 9, 3 * i + (uint64_t)k);
        vec3_normalise(n);
        for (int k = 0; k < 3; k++)
            back[k] = -n[k];
        const double flux = fmax(vec3_dot(n, d), 0) * panorama_solid_angle(128, 64, y);
        panorama_irradiance(&p, n, irradiance);
        for (int c = 0; c < 3; c++)
            assert_float_equal(irradiance[c], pixel[c] * flux, 1e-15);
        if (vec3_dot(n, d) > 0) {
            panorama_irradiance(&p, back, irradiance);
            assert_true(irradiance[0] == 0 && irradiance[1] == 0 && irradiance[2] == 0);
        }
        memset(pixel, 0, 3 * sizeof(float));
    }
    panorama_free(&p);
}

// ---- reading ------------------------------------------------------------------------------------

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

// Read the file as a panorama, then remove it.
static int read_and_remove(struct panorama *out)
{
    last_error[0] = last_warning[0] = 0;
    log_set_hook(remember, NULL);
    const int err = panorama_read(out, scratch_path("p.exr"));
    log_set_hook(NULL, NULL);
    unlink(scratch_path("p.exr"));
    if (err)
        assert_true(!out->image.data && strstr(last_error, "p.exr"));
    return err;
}

static int read_back(struct panorama *out, const struct image *image)
{
    assert_int_equal(image_write_exr(image, scratch_path("p.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    return read_and_remove(out);
}

// Our writer refuses NaN and infinities, so this is a TIFF by hand: little endian, one strip of
// 32-bit float RGB.
static int read_back_any_float(struct panorama *out, const struct image *image)
{
    enum {
        N_ENTRIES = 10,
        HEAD = 8,
        BITS_AT = HEAD + 2 + 12 * N_ENTRIES + 4,
        DATA_AT = BITS_AT + 12
    };
    const uint32_t bytes = 12 * (uint32_t)(image->width * image->height);
    const struct {
        uint16_t tag, type;
        uint32_t count, value;
    } entries[N_ENTRIES] = {
        {256, 4, 1, (uint32_t)image->width},
        {257, 4, 1, (uint32_t)image->height},
        {258, 3, 3, BITS_AT},
        {259, 3, 1, 1}, // not compressed
        {262, 3, 1, 2},
        {273, 4, 1, DATA_AT},
        {277, 3, 1, 3},
        {278, 4, 1, (uint32_t)image->height},
        {279, 4, 1, bytes},
        {339, 3, 3, BITS_AT + 6}, // sample format
    };
    const uint16_t n_entries = N_ENTRIES, bits_and_format[6] = {32, 32, 32, 3, 3, 3};
    const uint32_t end = 0;
    FILE *f = fopen(scratch_path("p.exr"), "wb");
    assert_non_null(f);
    fwrite("II*\0\10\0\0\0", 1, HEAD, f);
    fwrite(&n_entries, 2, 1, f);
    fwrite(entries, 12, N_ENTRIES, f);
    fwrite(&end, 4, 1, f);
    fwrite(bits_and_format, 2, 6, f);
    fwrite(image->data, 1, bytes, f);
    assert_int_equal(fclose(f), 0);
    return read_and_remove(out);
}

static void rgb_is_kept_and_the_rest_left_behind(void **state)
{
    (void)state;
    static const char *const names[] = {"R", "G", "B", "A", "clip"};
    struct image image;
    struct panorama p;
    assert_int_equal(image_new(&image, 8, 4, 5, names), 0);
    for (int i = 0; i < 32; i++)
        for (int c = 0; c < 5; c++)
            image.data[5 * i + c] = (float)(100 * c + i + 1);
    assert_int_equal(read_back(&p, &image), 0);
    assert_int_equal(p.image.n_channels, 3);
    for (int i = 0; i < 32; i++)
        for (int c = 0; c < 3; c++)
            assert_true(p.image.data[3 * i + c] == (float)(100 * c + i + 1));
    panorama_free(&p);
    image_free(&image);
}

static void negative_light_becomes_none_with_a_count(void **state)
{
    (void)state;
    struct panorama p = filled(8, 1), back;
    p.image.data[3 * 20 + 1] = -.25f;
    p.image.data[3 * 77 + 2] = -1e-3f;
    assert_int_equal(read_back(&back, &p.image), 0);
    assert_non_null(strstr(last_warning, "2 negative"));
    assert_non_null(strstr(last_warning, "-0.25")); // the lowest
    assert_non_null(strstr(last_warning, "column 4, row 1")); // pixel 20 of 16 columns
    assert_true(back.image.data[3 * 20 + 1] == 0 && back.image.data[3 * 77 + 2] == 0);
    assert_true(back.image.data[3 * 20] == 1);
    panorama_free(&back);
    panorama_free(&p);
}

static void what_is_no_panorama_is_refused_with_its_reason(void **state)
{
    (void)state;
    static const char *const no_blue[] = {"R", "G", "A"};
    struct panorama p = filled(8, 0), back;
    struct image image;
    assert_int_equal(read_back(&back, &p.image), -EINVAL);
    assert_non_null(strstr(last_error, "black"));
    for (int i = 0; i < 3 * 128; i++)
        p.image.data[i] = -1; // nothing left after negatives are cleared
    assert_int_equal(read_back(&back, &p.image), -EINVAL);
    p.image.data[3 * 37 + 1] = 1;
    assert_int_equal(read_back_any_float(&back, &p.image), 0);
    assert_true(back.image.data[3 * 37 + 1] == 1);
    panorama_free(&back);
    p.image.data[3 * 37 + 1] = NAN;
    assert_int_equal(read_back_any_float(&back, &p.image), -EDOM);
    assert_non_null(strstr(last_error, "column 5, row 2")); // the pixel, named
    p.image.data[3 * 37 + 1] = INFINITY;
    assert_int_equal(read_back_any_float(&back, &p.image), -EDOM);
    panorama_free(&p);

    assert_int_equal(image_new(&image, 9, 4, 3, NULL), 0);
    image.data[0] = 1;
    assert_int_equal(read_back(&back, &image), -EINVAL);
    assert_non_null(strstr(last_error, "2:1"));
    assert_non_null(strstr(last_error, "9x4"));
    image_free(&image);

    assert_int_equal(image_new(&image, 8, 4, 3, no_blue), 0);
    image.data[0] = 1;
    assert_int_equal(read_back(&back, &image), -EINVAL);
    assert_non_null(strstr(last_error, "channel B"));
    image_free(&image);

    assert_int_equal(panorama_read(&back, "nowhere/p.exr"), -ENOENT);
}

// ---- OpenEXR's own picture of the convention ----------------------------------------------------
//
// OrientationLatLong.exr shows the six faces of a cube. On each face two black lines leave the
// middle along the positive directions of the other two axes, to .35 of the half width; behind
// their ends stands the axis' letter, at .515.

static double brightness(const struct panorama *p, const double dir[3])
{
    double x, y;
    float v[3];
    panorama_pixel(p->image.width, p->image.height, dir, &x, &y);
    image_bilinear(&p->image, x, y, v);
    return (v[0] + v[1] + v[2]) / 3.;
}

// Darkest place within a pixel or so of face + t axis.
static double darkest_near(const struct panorama *p, const double face[3], const double axis[3],
                           double t)
{
    double across[3], darkest = INFINITY;
    vec3_cross(across, face, axis);
    for (int k = -2; k <= 2; k++) {
        double d[3];
        vec3_add_scaled(d, face, t, axis);
        vec3_add_scaled(d, d, .004 * k, across);
        darkest = fmin(darkest, brightness(p, d));
    }
    return darkest;
}

// Read one letter: 'X', 'Y', 'Z' or '?', from the ink on the diagonals of its bounding box. right:
// as seen from inside.
static char letter_at(const struct panorama *p, const double middle[3], const double right[3],
                      const double up[3])
{
    enum { N = 57, HALF = N / 2 };
    static bool ink[N][N]; // [from top][from left]
    int x0 = N, x1 = -1, y0 = N, y1 = -1;
    for (int j = 0; j < N; j++)
        for (int i = 0; i < N; i++) {
            double d[3];
            vec3_add_scaled(d, middle, .0025 * (i - HALF), right);
            vec3_add_scaled(d, d, .0025 * (HALF - j), up);
            ink[j][i] = brightness(p, d) < .3;
            if (!ink[j][i])
                continue;
            x0 = i < x0 ? i : x0, x1 = i > x1 ? i : x1, y0 = j < y0 ? j : y0, y1 = j > y1 ? j : y1;
        }
    if (x1 - x0 < 10 || y1 - y0 < 10)
        return '?';
    double rising = 0, falling = 0,
           stem = 0; // share of inked steps: / and \ of the whole box, | of its lower half
    for (int k = 3; k <= 17; k++) { // leave out the corners
        const double t = k / 20.;
        const int y = (int)lround(y0 + t * (y1 - y0));
        const int to_right = (int)lround(x0 + t * (x1 - x0)),
                  to_left = (int)lround(x1 - t * (x1 - x0));
        falling += (ink[y][to_right] || ink[y][to_right - 1] || ink[y][to_right + 1]) / 15.;
        rising += (ink[y][to_left] || ink[y][to_left - 1] || ink[y][to_left + 1]) / 15.;
        const int low = (int)lround(y1 - t / 2 * (y1 - y0)), mid = (x0 + x1) / 2;
        stem += (ink[low][mid] || ink[low][mid - 1] || ink[low][mid + 1]) / 15.;
    }
    if (rising > .9 && falling > .9)
        return 'X';
    if (rising > .9 && falling < .5)
        return 'Z'; // a mirrored Z has its stroke the other way
    if (stem > .9 && rising < .8 && falling < .8)
        return 'Y';
    return '?';
}

static void the_axis_labelled_panorama_agrees_with_our_directions(void **state)
{
    (void)state;
    const char *path = "../shared/data/hdri/OrientationLatLong.exr";
    struct panorama p;
    if (access(path, R_OK)) {
        print_message("# %s is not there: not checked\n", path);
        return;
    }
    assert_int_equal(panorama_read(&p, path), 0);
    for (int f = 0; f < 6; f++) {
        double face[3] = {0, 0, 0};
        face[f % 3] = f < 3 ? 1 : -1;
        for (int a = 0; a < 3; a++) {
            if (a == f % 3)
                continue;
            double positive[3] = {0, 0, 0}, negative[3] = {0, 0, 0};
            positive[a] = 1, negative[a] = -1;
            for (double t = .1; t < .34; t += .05) { // nearer: the floor's own label
                assert_true(darkest_near(&p, face, positive, t) < .2);
                assert_true(darkest_near(&p, face, negative, t) > .4);
            }
            if (f % 3 == 1)
                continue; // letters of the floor and the ceiling stand askew
            const double up[3] = {0, 1, 0};
            double right[3], middle[3];
            vec3_cross(right, face, up);
            vec3_add_scaled(middle, face, .515, positive);
            assert_int_equal(letter_at(&p, middle, right, up), "XYZ"[a]);
        }
    }
    panorama_free(&p);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(the_axes_lie_where_openexr_puts_them),
        cmocka_unit_test(direction_and_pixel_are_inverse),
        cmocka_unit_test(solid_angles_are_the_bands_of_the_sphere),
        cmocka_unit_test(a_constant_sky_sums_to_4_pi_and_lights_a_patch_with_pi),
        cmocka_unit_test(a_lone_pixel_lights_by_its_cosine_and_not_from_behind),
        cmocka_unit_test(rgb_is_kept_and_the_rest_left_behind),
        cmocka_unit_test(negative_light_becomes_none_with_a_count),
        cmocka_unit_test(what_is_no_panorama_is_refused_with_its_reason),
        cmocka_unit_test(the_axis_labelled_panorama_agrees_with_our_directions),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
