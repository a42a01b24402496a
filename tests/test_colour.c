// tests/test_colour.c - gains of bodies from cards and charts, and the file that keeps them.
#include "rigd/colour.h"
#include "solver/take/image.h"
#include "solver/take/log.h"
#include "tests/scratch.h"

#include <errno.h>
#include <math.h>
#include <string.h>

enum { W = 600, H = 400, N = CHART_COLUMNS * CHART_ROWS };

// GretagMacbeth's 8-bit sRGB of the 24 patches: an older and rougher account than the L*a*b* that colour.c begins with.
static const uint8_t published_srgb[N][3] = {
    { 115, 82, 68 },   { 194, 150, 130 }, { 98, 122, 157 },  { 87, 108, 67 },   { 133, 128, 177 }, { 103, 189, 170 }, { 214, 126, 44 },  { 80, 91, 166 },
    { 193, 90, 99 },   { 94, 60, 108 },   { 157, 188, 64 },  { 224, 163, 46 },  { 56, 61, 150 },   { 70, 148, 73 },   { 175, 54, 60 },   { 231, 199, 31 },
    { 187, 86, 149 },  { 8, 133, 161 },   { 243, 243, 242 }, { 200, 200, 200 }, { 160, 160, 160 }, { 122, 122, 121 }, { 85, 85, 85 },    { 52, 52, 52 },
};

static double linear_of(uint8_t v)
{
    const double x = v / 255.;
    return x <= .04045 ? x / 12.92 : pow((x + .055) / 1.055, 2.4);
}

static void the_charts_colours_are_the_published_ones(void **state)
{
    (void)state;
    double srgb[N][3], sum = 0;
    colour_chart(srgb);
    for (int p = 0; p < N; p++)
        for (int c = 0; c < 3; c++) {
            const double off = srgb[p][c] - linear_of(published_srgb[p][c]);
            assert_true(fabs(off) < .08);
            sum += off * off;
        }
    assert_true(sqrt(sum / (3 * N)) < .02);
    for (int p = 18; p < N; p++) // greys are grey, and lighter before darker
        for (int c = 0; c < 3; c++)
            assert_true(fabs(srgb[p][c] / srgb[p][1] - 1) < .1 && (p == 18 || srgb[p][c] < srgb[p - 1][c]));
}

// A body: what it makes of linear sRGB.
static const double srgb_from_camera[3][3] = { { 1.62, -.51, -.11 }, { -.17, 1.45, -.28 }, { .04, -.56, 1.52 } };

static void solve3(const double m[3][3], const double b[3], double x[3]) // Cramer
{
    double a[3][3], det[4];
    for (int k = -1; k < 3; k++) {
        memcpy(a, m, sizeof(a));
        for (int i = 0; i < 3 && k >= 0; i++)
            a[i][k] = b[i];
        det[k + 1] = a[0][0] * (a[1][1] * a[2][2] - a[1][2] * a[2][1]) - a[0][1] * (a[1][0] * a[2][2] - a[1][2] * a[2][0]) + a[0][2] * (a[1][0] * a[2][1] - a[1][1] * a[2][0]);
    }
    for (int i = 0; i < 3; i++)
        x[i] = det[i + 1] / det[0];
}

// The chart under a warm light, in perspective; its borders are black. body: gains of the channels.
static const double corners[4][2] = { { 60, 50 }, { 560, 30 }, { 520, 370 }, { 90, 330 } };

static void chart_place(double u, double v, double *x, double *y) // of the unit square, by bilinear rails: only corners must agree with perspective
{
    // a true projective map through the four corners
    const double(*q)[2] = corners;
    const double sx = q[0][0] - q[1][0] + q[2][0] - q[3][0], sy = q[0][1] - q[1][1] + q[2][1] - q[3][1];
    const double ax = q[1][0] - q[2][0], ay = q[1][1] - q[2][1], bx = q[3][0] - q[2][0], by = q[3][1] - q[2][1], d = ax * by - bx * ay;
    const double g = (sx * by - bx * sy) / d, h = (ax * sy - sx * ay) / d, w = g * u + h * v + 1;
    *x = ((q[1][0] - q[0][0] + g * q[1][0]) * u + (q[3][0] - q[0][0] + h * q[3][0]) * v + q[0][0]) / w;
    *y = ((q[1][1] - q[0][1] + g * q[1][1]) * u + (q[3][1] - q[0][1] + h * q[3][1]) * v + q[0][1]) / w;
}

static struct raw_frame photograph(const double gain[3], double brightness)
{
    static const uint8_t cfa[4] = { 0, 1, 1, 2 };
    static const double light[3] = { 1.3, 1, .6 };
    double published[N][3];
    struct raw_frame f = { .width = W, .height = H, .white = 16383, .saturation = 16383, .daylight = { 1.8, 1, 1.4 }, .has_colour = true };
    f.site = malloc(sizeof(f.site[0]) * W * H);
    assert_non_null(f.site);
    memcpy(f.cfa, cfa, 4);
    memcpy(f.srgb_from_camera, srgb_from_camera, sizeof(srgb_from_camera));
    for (int i = 0; i < W * H; i++) {
        f.black[0][0] = f.black[0][1] = f.black[1][0] = f.black[1][1] = 512;
        f.site[i] = 530;
    }
    colour_chart(published);
    for (int v = 0; v < 2000; v++) // splat: fine enough that no site is missed
        for (int u = 0; u < 3000; u++) {
            double x, y, camera[3], rgb[3];
            const int patch = v / 500 * CHART_COLUMNS + u / 500;
            if (abs(u % 500 - 250) > 220 || abs(v % 500 - 250) > 220)
                continue;
            chart_place((u + .5) / 3000, (v + .5) / 2000, &x, &y);
            for (int c = 0; c < 3; c++)
                rgb[c] = brightness * light[c] * published[patch][c];
            solve3(srgb_from_camera, rgb, camera);
            const int c = f.cfa[(int)y & 1][(int)x & 1];
            f.site[(int)y * W + (int)x] = (uint16_t)fmax(0, lround(fmin(16383, 512 + (16383 - 512) * gain[c] * camera[c] / f.daylight[c])));
        }
    return f;
}

void raw_free(struct raw_frame *f) // develop.c's would bring LibRaw
{
    free(f->site);
    f->site = NULL;
}

static struct colour_frame measured(const char *serial, const double gain[3], double brightness)
{
    struct colour_frame out = { .n_cells = N };
    struct raw_frame f = photograph(gain, brightness);
    struct saturation s;
    char why[200] = "";
    assert_int_equal(saturation_of(&s, &f, f.saturation), 0);
    assert_int_equal(colour_measure(out.cell, &f, &s, NULL, 1, corners, CHART_COLUMNS, CHART_ROWS, .5, why, sizeof(why)), 0);
    snprintf(out.serial, sizeof(out.serial), "%s", serial);
    memcpy(out.srgb_from_camera, srgb_from_camera, sizeof(srgb_from_camera));
    saturation_free(&s);
    raw_free(&f);
    return out;
}

static void a_chart_in_perspective_gives_the_gains_and_its_own_colours(void **state)
{
    (void)state;
    static const double gain[3][3] = { { 1, 1, 1 }, { 1.07, .95, 1.02 }, { .93, 1.04, .9 } };
    struct colour_frame frame[3];
    struct colour_fit fit;
    char why[200] = "";
    for (int b = 0; b < 3; b++) {
        const char serial[2] = { (char)('1' + b), 0 };
        frame[b] = measured(serial, gain[b], .5);
        assert_int_equal(colour_require_sound(&frame[b], why, sizeof(why)), 0);
    }
    assert_int_equal(colour_fit(&fit, frame, 3, "1", NULL, why, sizeof(why)), 0);
    assert_int_equal(fit.colour.n, 3);
    for (int b = 0; b < 3; b++) {
        const struct body_colour *own = colour_of(&fit.colour, frame[b].serial);
        assert_true(fabs(own->gain[1] - 1) < 1e-12);
        for (int c = 0; c < 3; c++)
            assert_true(fabs(own->gain[c] * own->scale * gain[b][c] - 1) < 1e-3);
    }
    assert_true(fit.grey_spread < .005);
    assert_true(fit.chart_rms < .003); // rounding to DN, and the light that the greys give
    // A body whose matrix is wrong shows in the patches, not in the greys.
    struct colour_frame twisted[3];
    memcpy(twisted, frame, sizeof(frame));
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            twisted[2].srgb_from_camera[i][j] = i == j;
    colour_free(&fit.colour);
    assert_int_equal(colour_fit(&fit, twisted, 3, NULL, NULL, why, sizeof(why)), 0);
    assert_true(fit.worst_rms > .03);
    assert_string_equal(fit.worst_serial, "3");
    // By the file of others: a spread that is there is said.
    const struct colour right = fit.colour;
    struct colour_fit check;
    assert_int_equal(colour_fit(&check, frame, 3, NULL, &right, why, sizeof(why)), 0);
    assert_true(check.grey_spread < .005);
    right.body[1].scale *= 1.05;
    assert_int_equal(colour_fit(&check, frame, 3, NULL, &right, why, sizeof(why)), 0);
    assert_true(check.grey_spread > .04);
    assert_string_equal(check.spread_serial, "2");
    snprintf(right.body[1].serial, sizeof(right.body[1].serial), "x");
    assert_int_equal(colour_fit(&check, frame, 3, NULL, &right, why, sizeof(why)), -ENOENT);
    assert_int_equal(colour_fit(&check, frame, 3, "9", NULL, why, sizeof(why)), -ENOENT);
    assert_non_null(strstr(why, "9"));
    frame[1].n_cells = CARD_COLUMNS * CARD_ROWS;
    assert_int_equal(colour_fit(&check, frame, 3, NULL, NULL, why, sizeof(why)), -EINVAL);
    frame[1].n_cells = N;
    frame[1].serial[0] = 0;
    assert_int_equal(colour_fit(&check, frame, 3, NULL, NULL, why, sizeof(why)), -EINVAL);
    colour_free(&fit.colour);
}

// The spread is measured where it was not fitted: with one frame per body a fit to everything would always say 0.
static void a_card_that_two_bodies_see_differently_shows_in_the_spread(void **state)
{
    (void)state;
    struct colour_frame frame[2] = { { .n_cells = 9, .serial = "1" }, { .n_cells = 9, .serial = "2" } };
    struct colour_fit fit;
    char why[200] = "";
    for (int b = 0; b < 2; b++)
        for (int k = 0; k < 9; k++)
            for (int c = 0; c < 3; c++)
                frame[b].cell[k].mean[c] = frame[b].cell[k].raw[c] = .3 * (b ? 1.1 : 1);
    assert_int_equal(colour_fit(&fit, frame, 2, NULL, NULL, why, sizeof(why)), 0);
    assert_true(fit.grey_spread < 1e-12);
    assert_true(isnan(fit.chart_rms));
    colour_free(&fit.colour);
    for (int k = 1; k < 9; k += 2)
        frame[1].cell[k].mean[RAW_BLUE] *= 1.03;
    assert_int_equal(colour_fit(&fit, frame, 2, NULL, NULL, why, sizeof(why)), 0);
    assert_true(fit.grey_spread > .029 && fit.grey_spread < .031);
    colour_free(&fit.colour);
}

static void a_chart_that_is_clipped_or_dark_is_refused(void **state)
{
    (void)state;
    static const double even[3] = { 1, 1, 1 };
    char why[200] = "";
    struct colour_frame f = measured("1", even, 2);
    assert_int_equal(colour_require_sound(&f, why, sizeof(why)), -EDOM);
    assert_non_null(strstr(why, "clipped"));
    f = measured("1", even, .005);
    assert_int_equal(colour_require_sound(&f, why, sizeof(why)), -EDOM);
    assert_non_null(strstr(why, "dark"));
}

static void corners_that_make_no_chart_are_refused(void **state)
{
    (void)state;
    static const double even[3] = { 1, 1, 1 };
    struct raw_frame f = photograph(even, .5);
    struct saturation s;
    struct cell cell[N];
    char why[200] = "";
    const double outside[4][2] = { { -1, 0 }, { 100, 0 }, { 100, 100 }, { 0, 100 } }, crossed[4][2] = { { 0, 0 }, { 100, 100 }, { 100, 0 }, { 0, 100 } },
                 mirrored[4][2] = { { 100, 0 }, { 0, 0 }, { 0, 100 }, { 100, 100 } }, tiny[4][2] = { { 10, 10 }, { 30, 10 }, { 30, 25 }, { 10, 25 } }, nan[4][2] = { { NAN, 0 }, { 1, 0 }, { 1, 1 }, { 0, 1 } };
    assert_int_equal(saturation_of(&s, &f, f.saturation), 0);
    assert_int_equal(colour_measure(cell, &f, &s, NULL, 1, outside, 6, 4, .5, why, sizeof(why)), -EINVAL);
    assert_int_equal(colour_measure(cell, &f, &s, NULL, 1, crossed, 6, 4, .5, why, sizeof(why)), -EINVAL);
    assert_int_equal(colour_measure(cell, &f, &s, NULL, 1, mirrored, 6, 4, .5, why, sizeof(why)), -EINVAL);
    assert_int_equal(colour_measure(cell, &f, &s, NULL, 1, tiny, 6, 4, .5, why, sizeof(why)), -EINVAL);
    assert_int_equal(colour_measure(cell, &f, &s, NULL, 1, nan, 6, 4, .5, why, sizeof(why)), -EINVAL);
    saturation_free(&s);
    raw_free(&f);
}

static void the_file_is_read_or_refused_by_what_is_wrong(void **state)
{
    (void)state;
    static const char good[] = "{\"version\": 1, \"bodies\": [{\"serial\": \"a\", \"model\": \"m\", \"gain\": [1.1, 1, 0.9], \"scale\": 2}, {\"serial\": \"b\", \"gain\": [1, 1, 1], \"scale\": 1}]}";
    static const char *const bad[] = {
        "", "[]", "{\"version\": 2, \"bodies\": []}", "{\"version\": 1}", "{\"version\": 1, \"bodies\": []}",
        "{\"version\": 1, \"bodies\": [{\"gain\": [1, 1, 1], \"scale\": 1}]}",
        "{\"version\": 1, \"bodies\": [{\"serial\": \"a\", \"gain\": [1, 1], \"scale\": 1}]}",
        "{\"version\": 1, \"bodies\": [{\"serial\": \"a\", \"gain\": [1, 1, 1]}]}",
        "{\"version\": 1, \"bodies\": [{\"serial\": \"a\", \"gain\": [1, 0, 1], \"scale\": 1}]}",
        "{\"version\": 1, \"bodies\": [{\"serial\": \"a\", \"gain\": [1, 1, 1], \"scale\": -1}]}",
        "{\"version\": 1, \"bodies\": [{\"serial\": \"a\", \"gain\": [1, 1, 1], \"scale\": 1}, {\"serial\": \"a\", \"gain\": [1, 1, 1], \"scale\": 1}]}",
        "{\"version\": 1, \"bodies\": [{\"serial\": \"0123456789012345678901234567890123456789012345678901234567890123\", \"gain\": [1, 1, 1], \"scale\": 1}]}",
    };
    struct colour c;
    log_set_level(LOG_SILENT);
    assert_int_equal(colour_parse(&c, good, strlen(good), "good"), 0);
    assert_int_equal(c.n, 2);
    assert_true(colour_of(&c, "a")->scale == 2 && colour_of(&c, "a")->gain[2] == .9);
    assert_null(colour_of(&c, "c"));
    colour_free(&c);
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        assert_int_equal(colour_parse(&c, bad[i], strlen(bad[i]), "bad"), -EINVAL);
        assert_null(c.body);
    }
    assert_int_equal(colour_read(&c, "/nonexistent/colour.json"), -ENOENT);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(the_charts_colours_are_the_published_ones),
        cmocka_unit_test(a_chart_in_perspective_gives_the_gains_and_its_own_colours),
        cmocka_unit_test(a_card_that_two_bodies_see_differently_shows_in_the_spread),
        cmocka_unit_test(a_chart_that_is_clipped_or_dark_is_refused),
        cmocka_unit_test(corners_that_make_no_chart_are_refused),
        cmocka_unit_test(the_file_is_read_or_refused_by_what_is_wrong),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
