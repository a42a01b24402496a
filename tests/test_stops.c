// tests/test_stops.c - planned stops see the whole sphere, with what they are to overlap, and not many more of them than needed.
#include "rigd/stops.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <string.h>
#include <cmocka.h>

static struct lens lens_of(enum lens_model model, double focal_px, double circle_px)
{
    struct lens l = { .model = model, .width_px = 6000, .height_px = 4000, .focal_px = focal_px, .centre_px = { 3000, 2000 }, .circle_px = circle_px };
    assert_int_equal(lens_init(&l, "test"), 0);
    return l;
}

// How many of the stops see each of many directions: at least one.
static void check_coverage(const struct lens *lens, const struct config_stop *stop, int n, const char *what)
{
    for (int i = 0; i < 20000; i++) { // a spiral over the sphere
        const double y = 1 - 2 * (i + .5) / 20000, r = sqrt(1 - y * y), a = i * M_PI * (3 - sqrt(5));
        const double dir[3] = { r * cos(a), y, r * sin(a) };
        bool seen = false;
        for (int k = 0; k < n && !seen; k++) {
            double R[9], d[3], px[2];
            lens_head(R, stop[k].yaw_deg * M_PI / 180, stop[k].pitch_deg * M_PI / 180, 0);
            for (int c = 0; c < 3; c++)
                d[c] = R[c] * dir[0] + R[3 + c] * dir[1] + R[6 + c] * dir[2];
            seen = lens_project(lens, d, px) && px[0] >= 0 && px[1] >= 0 && px[0] <= lens->width_px && px[1] <= lens->height_px;
        }
        if (!seen)
            fail_msg("%s: nobody of %d stops sees %.3f %.3f %.3f", what, n, dir[0], dir[1], dir[2]);
    }
}

static void the_whole_sphere_is_seen(void **state)
{
    (void)state;
    static const struct { enum lens_model model; double focal_px, circle_px; int most; const char *what; } cases[] = {
        { LENS_EQUISOLID, 2000 / M_SQRT2, 2000, 4, "a circular fisheye" },
        { LENS_EQUIDISTANT, 4000 / M_PI, 2000, 4, "an equidistant one" },
        { LENS_EQUISOLID, 2549, 0, 14, "a fisheye of 180 degrees across the diagonal" },
        { LENS_STEREOGRAPHIC, 1500, 0, 14, "a stereographic one" },
        { LENS_RECTILINEAR, 2333, 0, 30, "14 mm on 36 mm" },
        { LENS_RECTILINEAR, 4000, 0, 64, "24 mm" },
    };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        struct config_stop stop[CONFIG_STOPS_MAX];
        const struct lens lens = lens_of(cases[i].model, cases[i].focal_px, cases[i].circle_px);
        const int n = stops_plan(stop, CONFIG_STOPS_MAX, &lens, .25);
        if (!n || n > cases[i].most)
            fail_msg("%s: %d stops, at most %d expected", cases[i].what, n, cases[i].most);
        check_coverage(&lens, stop, n, cases[i].what);
        assert_int_equal(stops_plan(stop, n - 1, &lens, .25), 0);
        const int n_more = stops_plan(stop, CONFIG_STOPS_MAX, &lens, .4);
        assert_true(n_more >= n || !n_more); // more overlap, not fewer stops
        if (n_more)
            check_coverage(&lens, stop, n_more, cases[i].what);
    }
}

static void a_long_lens_needs_more_stops_than_there_may_be(void **state)
{
    (void)state;
    struct config_stop stop[CONFIG_STOPS_MAX];
    const struct lens lens = lens_of(LENS_RECTILINEAR, 20000, 0);
    assert_int_equal(stops_plan(stop, CONFIG_STOPS_MAX, &lens, .25), 0);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(the_whole_sphere_is_seen),
        cmocka_unit_test(a_long_lens_needs_more_stops_than_there_may_be),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
