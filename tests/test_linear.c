// tests/test_linear.c - photosites become radiance: demosaicing, clip masks, flat fields.
#include "rigd/linear.h"
#include "tests/scratch.h"

#include <errno.h>
#include <math.h>
#include <string.h>

static const uint8_t orders[4][4] = { { 0, 1, 1, 2 }, { 1, 0, 2, 1 }, { 2, 1, 1, 0 }, { 1, 2, 0, 1 } };

// A frame of which site(x, y) is (value(x, y, filter) x (white - black) / daylight + black), exactly: black 100, 110, 120, 130, white 1124.
static struct raw_frame make_frame(int width, int height, int order, double (*value)(int x, int y, int c))
{
    struct raw_frame f = { .width = width, .height = height, .white = 16130, .saturation = 16130, .daylight = { 2, 1, 1.5 }, .has_colour = true };
    f.site = malloc((size_t)width * (size_t)height * sizeof(f.site[0]));
    assert_non_null(f.site);
    memcpy(f.cfa, orders[order], 4);
    for (int i = 0; i < 4; i++)
        f.black[i / 2][i % 2] = 100 + 10 * i;
    for (int i = 0; i < 3; i++)
        f.srgb_from_camera[i][i] = 1;
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
            const int c = f.cfa[y & 1][x & 1];
            const double black = f.black[y & 1][x & 1];
            f.site[y * width + x] = (uint16_t)fmin(lround(value(x, y, c) / f.daylight[c] * (f.white - black) + black), f.white);
        }
    return f;
}

static double plane(int x, int y, int c) // linear in x and y: what bilinear interpolation must keep
{
    return .1 + .002 * x + .003 * y + .05 * c;
}

static const double ones[3] = { 1, 1, 1 };

static void a_plane_of_light_stays_one(void **state)
{
    (void)state;
    for (int order = 0; order < 4; order++) {
        struct raw_frame f = make_frame(40, 30, order, plane);
        struct saturation s;
        struct linear l;
        float row[4 * 40];
        assert_int_equal(saturation_of(&s, &f, f.saturation), 0);
        assert_int_equal(linear_open(&l, DEMOSAIC_BILINEAR, &f, NULL, &s, NULL, ones), 0);
        for (int y = 0; y < 30; y++) {
            assert_int_equal(linear_row(&l, y, row), 0);
            for (int x = 0; x < 40; x++)
                for (int c = 0; c < 3; c++) {
                    const bool inside = x > 0 && y > 0 && x < 39 && y < 29;
                    assert_true(fabs((double)row[4 * x + c] - plane(x, y, c)) < (inside ? 2e-4 : 5.2e-3)); // at borders one step of the plane
                }
        }
        linear_close(&l);
        assert_int_equal(linear_open(&l, DEMOSAIC_HALF, &f, NULL, &s, NULL, ones), 0);
        assert_int_equal(l.width, 20);
        assert_int_equal(l.height, 15);
        for (int y = 0; y < 15; y++) {
            linear_row(&l, y, row);
            for (int x = 0; x < 20; x++)
                for (int c = 0; c < 3; c++) {
                    double sum = 0;
                    int n = 0;
                    for (int i = 0; i < 4; i++)
                        if (orders[order][i] == c)
                            sum += plane(2 * x + i % 2, 2 * y + i / 2, c), n++;
                    assert_true(fabs((double)row[4 * x + c] - sum / n) < 2e-4);
                }
        }
        linear_close(&l);
        saturation_free(&s);
        raw_free(&f);
    }
}

static void noise_below_black_is_kept(void **state)
{
    (void)state;
    struct raw_frame f = make_frame(16, 16, 0, plane);
    struct saturation s;
    struct linear l;
    float row[4 * 16];
    for (int i = 0; i < 256; i++)
        f.site[i] = 50; // all blacks lie above
    assert_int_equal(saturation_of(&s, &f, f.saturation), 0);
    for (int d = DEMOSAIC_HALF; d <= DEMOSAIC_BILINEAR; d++) {
        assert_int_equal(linear_open(&l, (enum demosaic)d, &f, NULL, &s, NULL, ones), 0);
        linear_row(&l, 3, row);
        assert_true(row[8] < -1e-3f && row[9] < -1e-3f && row[10] < -1e-3f);
        linear_close(&l);
    }
    saturation_free(&s);
    raw_free(&f);
}

// One site is lifted at a time: what changes is what was made from it. The mask must say the same.
static void the_mask_marks_exactly_what_a_saturated_site_took_part_in(void **state)
{
    (void)state;
    enum { W = 14, H = 11 };
    for (int order = 0; order < 4; order++)
        for (int d = DEMOSAIC_HALF; d <= DEMOSAIC_BILINEAR; d++)
            for (int at = 0; at < W * H; at++) {
                struct raw_frame f = make_frame(W, H, order, plane);
                struct saturation s;
                struct linear before, after;
                float a[4 * W], b[4 * W];
                uint16_t *lifted = malloc(W * H * sizeof(*lifted));
                assert_non_null(lifted);
                struct raw_frame g = f;
                memcpy(lifted, f.site, W * H * sizeof(*lifted));
                g.site = lifted;
                lifted[at] = 16130;
                assert_int_equal(saturation_of(&s, &g, g.saturation), 0);
                assert_int_equal(s.n, 1);
                assert_int_equal(linear_open(&before, (enum demosaic)d, &f, NULL, &s, NULL, ones), 0);
                assert_int_equal(linear_open(&after, (enum demosaic)d, &g, NULL, &s, NULL, ones), 0);
                for (int y = 0; y < after.height; y++) {
                    linear_row(&before, y, a);
                    linear_row(&after, y, b);
                    for (int x = 0; x < after.width; x++)
                        assert_int_equal(b[4 * x + 3] == 1, memcmp(a + 4 * x, b + 4 * x, 3 * sizeof(float)) != 0);
                }
                linear_close(&before);
                linear_close(&after);
                saturation_free(&s);
                free(lifted);
                raw_free(&f);
            }
}

static double vignetted(int x, int y, int c)
{
    const double dx = (x + .5) / 640 - .5, dy = (y + .5) / 480 - .5;
    return (.5 + .1 * c) * (1 - .9 * (dx * dx + dy * dy)); // 55 % in the corners
}

static void a_flat_field_takes_vignetting_off(void **state)
{
    (void)state;
    struct raw_frame f = make_frame(640, 480, 0, vignetted);
    struct saturation s;
    struct linear l;
    struct flat *flat = malloc(sizeof(*flat));
    static float row[4 * 640];
    char why[200] = "";
    assert_non_null(flat);
    assert_int_equal(saturation_of(&s, &f, f.saturation), 0);
    assert_int_equal(flat_from_frame(flat, &f, &s, why, sizeof(why)), 0);
    assert_int_equal(linear_open(&l, DEMOSAIC_BILINEAR, &f, NULL, &s, flat, ones), 0);
    double worst = 0;
    for (int y = 4; y < 476; y++) {
        linear_row(&l, y, row);
        for (int x = 4; x < 636; x++)
            for (int c = 0; c < 3; c++)
                worst = fmax(worst, fabs((double)row[4 * x + c] / (.5 + .1 * c) - 1));
    }
    assert_true(worst < .012); // half a cell at the border is held constant: .9 x 2 x .5 x (.5 / 64)
    linear_close(&l);

    struct image picture; // the same from a developed picture
    assert_int_equal(image_new(&picture, 320, 240, 3, NULL), 0);
    assert_int_equal(linear_open(&l, DEMOSAIC_HALF, &f, NULL, &s, NULL, ones), 0);
    for (int y = 0; y < 240; y++) {
        linear_row(&l, y, row);
        for (int x = 0; x < 320; x++)
            memcpy(picture.data + (y * 320 + x) * 3, row + 4 * x, 3 * sizeof(float));
    }
    struct flat *second = malloc(sizeof(*second));
    assert_non_null(second);
    assert_int_equal(flat_from_image(second, &picture, (const double (*)[3])f.srgb_from_camera, why, sizeof(why)), 0);
    for (int y = 0; y < FLAT_ROWS; y++)
        for (int x = 0; x < FLAT_COLUMNS; x++)
            for (int c = 0; c < 3; c++)
                assert_true(fabsf(second->gain[y][x][c] / flat->gain[y][x][c] - 1) < 1e-3f);
    image_free(&picture);
    linear_close(&l);

    for (int i = 0; i < 640 * 480 / 100; i++) // clipped
        f.site[i * 100] = 16130;
    saturation_free(&s);
    assert_int_equal(saturation_of(&s, &f, f.saturation), 0);
    assert_int_equal(flat_from_frame(flat, &f, &s, why, sizeof(why)), -EDOM);
    assert_non_null(strstr(why, "saturated"));
    saturation_free(&s);
    for (int i = 0; i < 640 * 480; i++) // a lens cap
        f.site[i] = 140;
    assert_int_equal(saturation_of(&s, &f, f.saturation), 0);
    assert_int_equal(flat_from_frame(flat, &f, &s, why, sizeof(why)), -EDOM);
    assert_non_null(strstr(why, "dark"));
    saturation_free(&s);
    raw_free(&f);
    free(flat);
    free(second);
}

static void gains_and_matrix_act_in_that_order(void **state)
{
    (void)state;
    struct raw_frame f = make_frame(16, 16, 0, plane);
    struct saturation s;
    struct linear plain, l;
    float a[64], b[64];
    const double gain[3] = { 1.5, .5, 2 }, m[3][3] = { { 1.6, -.5, -.1 }, { -.2, 1.4, -.2 }, { .1, -.6, 1.5 } };
    assert_int_equal(saturation_of(&s, &f, f.saturation), 0);
    assert_int_equal(linear_open(&plain, DEMOSAIC_HALF, &f, NULL, &s, NULL, ones), 0);
    linear_row(&plain, 3, a);
    memcpy(f.srgb_from_camera, m, sizeof(m));
    assert_int_equal(linear_open(&l, DEMOSAIC_HALF, &f, NULL, &s, NULL, gain), 0);
    linear_row(&l, 3, b);
    for (int i = 0; i < 3; i++) {
        double v = 0;
        for (int k = 0; k < 3; k++)
            v += m[i][k] * gain[k] * (double)a[12 + k];
        assert_true(fabs(v - (double)b[12 + i]) < 1e-5);
    }
    linear_close(&plain);
    linear_close(&l);
    saturation_free(&s);
    raw_free(&f);
}

// raw_free is develop.c's, which would bring LibRaw.
void raw_free(struct raw_frame *f)
{
    free(f->site);
    f->site = NULL;
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_plane_of_light_stays_one),
        cmocka_unit_test(noise_below_black_is_kept),
        cmocka_unit_test(the_mask_marks_exactly_what_a_saturated_site_took_part_in),
        cmocka_unit_test(a_flat_field_takes_vignetting_off),
        cmocka_unit_test(gains_and_matrix_act_in_that_order),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
