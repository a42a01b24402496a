// tests/test_cameras.c - pixels where they belong, from every file that says where cameras stand.
#include "solver/cameras.h"
#include "solver/cameras_format.h"
#include "solver/random.h"
#include "solver/take/log.h"
#include "solver/vec3.h"
#include "solver/take/atomic_file.h"
#include "tests/scratch.h"

#include <dirent.h>
#include <errno.h>
#include <locale.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

// ---- helpers ------------------------------------------------------------------------------------------------------------

static char logged[2048];

static void keep_error(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    if (level == LOG_ERROR)
        snprintf(logged, sizeof(logged), "%s", message);
}

static int set_up(void **state)
{
    (void)state;
    log_set_hook(keep_error, NULL);
    return scratch_open();
}

static int tear_down(void **state)
{
    (void)state;
    log_set_hook(NULL, NULL);
    scratch_empty();
    return scratch_close();
}

static void random_point(double out[3], uint64_t i)
{
    for (uint64_t c = 0; c < 3; c++)
        out[c] = random_uniform(4, c, i) - .5;
}

// A view of the origin from about 2 m, looking a little past it. kind: which distortion.
enum { N_KINDS = 10 };
static struct camera make_view(int kind, uint64_t seed)
{
    struct camera c = { .width_px = 6000, .height_px = 4000, .fx = 7213.25, .fy = 7201.5, .cx = 3011.125, .cy = 1984.5 };
    double centre[3], target[3], up[3];
    for (uint64_t i = 0; i < 3; i++) {
        centre[i] = random_normal(seed, 1, i);
        target[i] = .05 * random_normal(seed, 2, i);
        up[i] = random_normal(seed, 3, i);
    }
    vec3_normalise(centre);
    for (int i = 0; i < 3; i++)
        centre[i] *= 2;
    static const struct {
        enum camera_model model;
        double k[6], p[4], skew;
    } kinds[N_KINDS] = {
        { CAMERA_BROWN, { 0 }, { 0 }, 0 },
        { CAMERA_BROWN, { -.12 }, { 0 }, 0 },
        { CAMERA_BROWN, { -.1, .04 }, { .0007, -.0004 }, 0 },
        { CAMERA_BROWN, { .06, -.08, .03 }, { -.0002, .0009 }, 0 },
        { CAMERA_RATIONAL, { .31, -.12, .05, .28, -.06, .02 }, { .0005, .0002 }, 0 },
        { CAMERA_FISHEYE, { 0 }, { 0 }, 0 },
        { CAMERA_FISHEYE, { -.03, .012, -.004, .001 }, { 0 }, 0 },
        { CAMERA_BROWN, { -.1, .05, -.01, .003 }, { .0007, -.0004, .02, -.01 }, 3.5 }, // from here on, COLMAP has no model
        { CAMERA_RATIONAL, { .31, -.12, .05, .28, -.06, .02 }, { .0005, .0002, .03, .01 }, 1 },
        { CAMERA_FISHEYE, { -.03, .012, -.004, .001 }, { .0004, -.0006, .02, -.03 }, 2 },
    };
    c.model = kinds[kind].model, c.skew = kinds[kind].skew;
    memcpy(c.k, kinds[kind].k, sizeof(c.k));
    memcpy(c.p, kinds[kind].p, sizeof(c.p));
    snprintf(c.name, sizeof(c.name), "view %d.%d", kind, (int)seed); // a blank and a dot: both are legal
    camera_look_at(&c, centre, target, up);
    return c;
}

static double largest_difference_px(const struct camera *a, const struct camera *b, int n_points)
{
    double most = 0;
    int n_seen = 0;
    for (int i = 0; i < n_points; i++) {
        double p[3], u[2], v[2];
        random_point(p, (uint64_t)i);
        const bool sees = camera_project(a, p, u, NULL);
        assert_int_equal(sees, camera_project(b, p, v, NULL));
        n_seen += sees;
        if (sees)
            most = fmax(most, hypot(u[0] - v[0], u[1] - v[1]));
    }
    assert_int_equal(n_seen, n_points);
    return most;
}

// ---- the camera ---------------------------------------------------------------------------------------------------------

static void first_pixel_centre_is_at_one_half(void **state)
{
    (void)state;
    // 4 x 2 pixels of 1 mm, 10 mm behind the pinhole: the corner of the image is at (-2, -1) mm.
    struct camera c = { .width_px = 4, .height_px = 2, .fx = 10, .fy = 10, .cx = 2, .cy = 1,
                        .cam_from_world = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
    const double corner[3] = { -.2, -.1, 1 }, first_centre[3] = { -.15, -.05, 1 };
    double uv[2], depth;
    assert_true(camera_project(&c, corner, uv, &depth));
    assert_true(fabs(uv[0]) < 1e-15 && fabs(uv[1]) < 1e-15 && depth == 1);
    assert_true(camera_project(&c, first_centre, uv, NULL));
    assert_true(fabs(uv[0] - .5) < 1e-15 && fabs(uv[1] - .5) < 1e-15);
    camera_resize(&c, 8, 6); // the corner stays the corner
    assert_true(camera_project(&c, corner, uv, NULL));
    assert_true(fabs(uv[0]) < 1e-14 && fabs(uv[1]) < 1e-14);
    assert_true(camera_project(&c, first_centre, uv, NULL));
    assert_true(fabs(uv[0] - 1) < 1e-14 && fabs(uv[1] - 1.5) < 1e-14);
}

static void look_at_puts_the_target_ahead_and_up_upwards(void **state)
{
    (void)state;
    for (uint64_t seed = 0; seed < 50; seed++) {
        struct camera c = make_view(0, seed);
        double target[3], above[3], uv[2], higher[2], back[3];
        const double up[3] = { 0, 0, 1 }, centre[3] = { 1, 2, .5 };
        random_point(target, seed);
        if (seed == 0) // looking along up
            target[0] = centre[0], target[1] = centre[1];
        camera_look_at(&c, centre, target, up);
        assert_true(fabs(mat3_det(c.cam_from_world) - 1) < 1e-12);
        assert_true(camera_project(&c, target, uv, NULL));
        assert_true(fabs(uv[0] - c.cx) < 1e-8 && fabs(uv[1] - c.cy) < 1e-8);
        vec3_add_scaled(above, target, .01, up);
        assert_true(camera_project(&c, above, higher, NULL));
        if (seed > 0)
            assert_true(higher[1] < uv[1] && fabs(higher[0] - uv[0]) < 1e-8);
        mat3_tmul_vec(back, c.cam_from_world, c.t_m);
        for (int i = 0; i < 3; i++)
            assert_true(fabs(back[i] + centre[i]) < 1e-12 && c.centre_m[i] == centre[i]);
    }
}

// x^2 and the like spelled out from the header, independent of the code's Horner forms.
static void distortion_is_what_the_header_says(void **state)
{
    (void)state;
    for (int kind = 0; kind < N_KINDS; kind++) {
        const struct camera c = make_view(kind, 11);
        for (uint64_t i = 0; i < 100; i++) {
            double p[3], q[3], uv[2];
            random_point(p, i);
            mat3_mul_vec(q, c.cam_from_world, p);
            const double x = (q[0] + c.t_m[0]) / (q[2] + c.t_m[2]), y = (q[1] + c.t_m[1]) / (q[2] + c.t_m[2]);
            const double r = hypot(x, y), *k = c.k, *t = c.p;
            double xd, yd;
            if (c.model == CAMERA_FISHEYE) {
                const double a = atan2(r, 1);
                const double ad = a * (1 + k[0] * pow(a, 2) + k[1] * pow(a, 4) + k[2] * pow(a, 6) + k[3] * pow(a, 8));
                const double xa = x * a / r, ya = y * a / r, g = 1 + t[2] * pow(a, 2) + t[3] * pow(a, 4);
                xd = x * ad / r + (2 * t[0] * xa * ya + t[1] * (a * a + 2 * xa * xa)) * g;
                yd = y * ad / r + (2 * t[1] * xa * ya + t[0] * (a * a + 2 * ya * ya)) * g;
            } else {
                const double above = 1 + k[0] * pow(r, 2) + k[1] * pow(r, 4) + k[2] * pow(r, 6);
                const double s = c.model == CAMERA_BROWN ? above + k[3] * pow(r, 8)
                                 : above / (1 + k[3] * pow(r, 2) + k[4] * pow(r, 4) + k[5] * pow(r, 6));
                const double g = 1 + t[2] * pow(r, 2) + t[3] * pow(r, 4);
                xd = x * s + (2 * t[0] * x * y + t[1] * (r * r + 2 * x * x)) * g;
                yd = y * s + (2 * t[1] * x * y + t[0] * (r * r + 2 * y * y)) * g;
            }
            assert_true(camera_project(&c, p, uv, NULL));
            assert_true(fabs(uv[0] - (c.fx * xd + c.skew * yd + c.cx)) < 1e-8);
            assert_true(fabs(uv[1] - (c.fy * yd + c.cy)) < 1e-8);
        }
    }
}

static void ray_is_the_inverse_of_projection(void **state)
{
    (void)state;
    for (int kind = 0; kind < N_KINDS; kind++)
        for (uint64_t i = 0; i < 1000; i++) {
            const struct camera c = make_view(kind, i % 20);
            double p[3], uv[2], again[2], d[3], far[3];
            random_point(p, i);
            assert_true(camera_project(&c, p, uv, NULL));
            assert_true(camera_ray(&c, uv, d));
            assert_true(fabs(vec3_norm(d) - 1) < 1e-14);
            vec3_add_scaled(far, c.centre_m, 3.7, d);
            assert_true(camera_project(&c, far, again, NULL));
            assert_true(hypot(uv[0] - again[0], uv[1] - again[1]) < 1e-9);
            vec3_sub(far, p, c.centre_m); // the ray goes through the point itself
            vec3_normalise(far);
            assert_true(fabs(far[0] - d[0]) + fabs(far[1] - d[1]) + fabs(far[2] - d[2]) < 1e-12);
        }
}

static void jacobian_matches_differences(void **state)
{
    (void)state;
    for (int kind = 0; kind < N_KINDS; kind++)
        for (uint64_t i = 0; i < 200; i++) {
            const struct camera c = make_view(kind, i % 7);
            double p[3], uv[2], plain[2], J[6], a[2], b[2];
            random_point(p, i);
            if (i < 20) { // on the axis, and so near that series take over
                const double axis[3] = { c.cam_from_world[6], c.cam_from_world[7], c.cam_from_world[8] };
                vec3_add_scaled(p, c.centre_m, 2, axis);
                p[0] += i ? pow(10, -(double)i / 2) : 0;
            }
            assert_true(camera_project_jacobian(&c, p, uv, J));
            assert_true(camera_project(&c, p, plain, NULL));
            assert_memory_equal(uv, plain, sizeof(uv));
            for (int k = 0; k < 3; k++) {
                const double h = 1e-5;
                double q[3] = { p[0], p[1], p[2] };
                q[k] = p[k] + h;
                assert_true(camera_project(&c, q, a, NULL));
                q[k] = p[k] - h;
                assert_true(camera_project(&c, q, b, NULL));
                for (int row = 0; row < 2; row++) // px per m, of the order of 3600
                    assert_true(fabs((a[row] - b[row]) / (2 * h) - J[3 * row + k]) < 2e-5 * c.fx);
            }
        }
}

static void points_behind_or_beyond_the_fold_are_not_seen(void **state)
{
    (void)state;
    struct camera c = { .width_px = 100, .height_px = 100, .fx = 50, .fy = 50, .cx = 50, .cy = 50,
                        .cam_from_world = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
    double uv[2], d[3];
    const double behind[3] = { 0, 0, -1 }, in_plane[3] = { 1, 0, 0 };
    assert_false(camera_project(&c, behind, uv, NULL));
    assert_false(camera_project(&c, in_plane, uv, NULL));
    // s r = r - .25 r^3 grows up to r = sqrt(4/3), then folds back
    c.k[0] = -.25;
    const double fold = sqrt(4. / 3), inside[3] = { .999 * fold, 0, 1 }, outside[3] = { 0, 1.001 * fold, 1 },
                 far[3] = { 5, 0, 1 };
    assert_true(camera_project(&c, inside, uv, NULL));
    assert_true(camera_ray(&c, uv, d));
    assert_true(fabs(d[0] / d[2] - inside[0]) < 1e-9);
    assert_false(camera_project(&c, outside, uv, NULL));
    assert_false(camera_project(&c, far, uv, NULL));
    const double beyond_image[2] = { 50 + 50 * 1.01 * fold * 2 / 3, 50 };
    assert_false(camera_ray(&c, beyond_image, d));
    // k2 > 0 makes it grow again further out: still beyond the fold
    c.k[1] = .02;
    assert_true(1 + 3 * c.k[0] * 16 + 5 * c.k[1] * 256 > 0);
    const double grown[3] = { 4, 0, 1 };
    assert_false(camera_project(&c, grown, uv, NULL));
    // a denominator with a zero at r = 2
    c = (struct camera){ .model = CAMERA_RATIONAL, .fx = 50, .fy = 50, .cam_from_world = { 1, 0, 0, 0, 1, 0, 0, 0, 1 },
                         .k = { 0, 0, 0, -.25 } };
    const double before[3] = { 1.9, 0, 1 }, after[3] = { 2.1, 0, 1 };
    assert_true(camera_project(&c, before, uv, NULL));
    assert_false(camera_project(&c, after, uv, NULL));
    // r / (1 + .25 r^2) folds at r = 2
    c.k[3] = .25;
    assert_true(camera_project(&c, before, uv, NULL));
    assert_false(camera_project(&c, after, uv, NULL));
    // a focal length that no lens has: no ray, rather than one of no length
    c = (struct camera){ .fx = 1e-250, .fy = 1, .cam_from_world = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
    assert_false(camera_ray(&c, beyond_image, d));
    // fisheye: 89 degrees off axis is fine, folds are not
    c = (struct camera){ .model = CAMERA_FISHEYE, .fx = 50, .fy = 50, .cam_from_world = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
    const double wide[3] = { 0, sin(1.5533), cos(1.5533) };
    assert_true(camera_project(&c, wide, uv, NULL));
    assert_true(fabs(uv[1] - 50 * 1.5533) < 1e-9);
    assert_true(camera_ray(&c, uv, d));
    assert_true(fabs(d[1] - wide[1]) < 1e-12 && fabs(d[2] - wide[2]) < 1e-12);
    c.k[0] = -.4; // 1 - 1.2 a^2: folds at a = .913
    assert_false(camera_project(&c, wide, uv, NULL));
    const double near_fold[3] = { sin(.9128), 0, cos(.9128) };
    assert_true(camera_project(&c, near_fold, uv, NULL));
    assert_true(camera_ray(&c, uv, d));
    assert_true(fabs(d[0] - near_fold[0]) < 1e-9);
}

// ---- COLMAP -------------------------------------------------------------------------------------------------------------

static void colmap_round_trip_keeps_every_distortion_model(void **state)
{
    (void)state;
    struct camera views[7];
    const struct cameras c = { 7, views };
    for (int i = 0; i < 7; i++)
        views[i] = make_view(i, (uint64_t)i);
    // a rotation by pi about each axis: w = 0 in the quaternion
    const double half_turn[9] = { -1, 0, 0, 0, 1, 0, 0, 0, -1 };
    memcpy(views[0].cam_from_world, half_turn, sizeof(half_turn));
    views[0].t_m[0] = 0, views[0].t_m[1] = .5, views[0].t_m[2] = 2;
    for (int binary = 0; binary < 2; binary++) {
        struct cameras back;
        assert_int_equal(
            (binary ? cameras_write_colmap_binary : cameras_write_colmap_text)(&c, scratch_dir), 0);
        assert_int_equal(cameras_read(&back, scratch_dir), 0);
        assert_int_equal(back.n, c.n);
        for (int i = 0; i < c.n; i++) {
            assert_string_equal(back.view[i].name, views[i].name);
            assert_int_equal(back.view[i].width_px, views[i].width_px);
            assert_int_equal(back.view[i].height_px, views[i].height_px);
            assert_true(largest_difference_px(&views[i], &back.view[i], 1000) < 1e-6);
            assert_ptr_equal(cameras_find(&back, views[i].name), &back.view[i]);
        }
        assert_null(cameras_find(&back, "view"));
        cameras_free(&back);
        scratch_empty();
    }
}

static void what_colmap_cannot_hold_is_refused_by_view(void **state)
{
    (void)state;
    for (int kind = 7; kind < N_KINDS; kind++) {
        struct camera views[2] = { make_view(2, 1), make_view(kind, 2) };
        const struct cameras c = { 2, views };
        assert_int_equal(cameras_write_colmap_text(&c, scratch_dir), -ENOTSUP);
        assert_non_null(strstr(logged, views[1].name));
        views[1].skew = 0;
        assert_int_equal(cameras_write_colmap_binary(&c, scratch_dir), -ENOTSUP);
        assert_non_null(strstr(logged, kind == 7 ? "k4" : kind == 8 ? "p3" : "p1"));
    }
    struct dirent **entries;
    const int n = scandir(scratch_dir, &entries, NULL, NULL); // nothing was written
    assert_int_equal(n, 2);
    for (int i = 0; i < n; i++)
        free(entries[i]);
    free(entries);
}

#define HEAD_C "# Number of cameras: 2\n"
#define CAM "7 PINHOLE 40 20 30 31 20 10\n3 SIMPLE_RADIAL 40 20 30 20 10 -.1\n"
#define IMG "9 2 0 0 0 1 2 3 3 folder one/a b.c.jpg\n\n1 1 1 1 1 0 0 1 7 x.png\n1 2 -1 3.5 4e1 12\n"

static void colmap_text_is_read_to_the_letter(void **state)
{
    (void)state;
    static const char *const locales[] = { "de_DE.UTF-8", "de_DE", "fr_FR.UTF-8" };
    bool has_comma = false;
    for (int i = 0; i < 3 && !has_comma; i++)
        has_comma = setlocale(LC_ALL, locales[i]);
    if (!has_comma)
        fprintf(stderr, "test_cameras: no locale with decimal commas here: read in the C locale only\n");
    const char *cameras = HEAD_C CAM "# comment\n\n", *images = "# Number of images: 2, mean\n" IMG;
    struct cameras c;
    assert_int_equal(cameras_parse_colmap_text(&c, cameras, strlen(cameras), "c", images, strlen(images), "i"), 0);
    setlocale(LC_ALL, "C");
    assert_int_equal(c.n, 2);
    assert_string_equal(c.view[0].name, "a b.c");
    assert_string_equal(c.view[1].name, "x");
    const double R0[9] = { 1, 0, 0, 0, 1, 0, 0, 0, 1 };
    const double R1[9] = { 0, 0, 1, 1, 0, 0, 0, 1, 0 }; // Hamilton, world to camera, normalised
    assert_memory_equal(c.view[0].cam_from_world, R0, sizeof(R0));
    for (int i = 0; i < 9; i++)
        assert_true(fabs(c.view[1].cam_from_world[i] - R1[i]) < 1e-15);
    assert_true(c.view[0].k[0] == -.1 && c.view[0].fx == 30 && c.view[0].fy == 30 && c.view[0].cy == 10);
    assert_true(c.view[1].fy == 31 && c.view[1].cx == 20 && c.view[1].k[0] == 0);
    assert_true(c.view[0].centre_m[0] == -1 && c.view[0].centre_m[1] == -2 && c.view[0].centre_m[2] == -3);
    assert_true(fabs(c.view[1].centre_m[0]) < 1e-15 && fabs(c.view[1].centre_m[1] + 1) < 1e-15); // -R^T (0, 0, 1)
    cameras_free(&c);
}

// Which number is which, written out once more from COLMAP's documentation.
static void each_parameter_goes_to_its_place(void **state)
{
    (void)state;
    static const struct {
        const char *line;
        struct camera expected;
    } cases[] = {
        { "1 SIMPLE_PINHOLE 40 20 30 21 11\n", { .fx = 30, .fy = 30, .cx = 21, .cy = 11 } },
        { "1 PINHOLE 40 20 30 31 21 11\n", { .fx = 30, .fy = 31, .cx = 21, .cy = 11 } },
        { "1 SIMPLE_RADIAL 40 20 30 21 11 1\n", { .fx = 30, .fy = 30, .cx = 21, .cy = 11, .k = { 1 } } },
        { "1 RADIAL 40 20 30 21 11 1 2\n", { .fx = 30, .fy = 30, .cx = 21, .cy = 11, .k = { 1, 2 } } },
        { "1 OPENCV 40 20 30 31 21 11 1 2 3 4\n", { .fx = 30, .fy = 31, .cx = 21, .cy = 11, .k = { 1, 2 }, .p = { 3, 4 } } },
        { "1 OPENCV_FISHEYE 40 20 30 31 21 11 1 2 3 4\n",
          { .model = CAMERA_FISHEYE, .fx = 30, .fy = 31, .cx = 21, .cy = 11, .k = { 1, 2, 3, 4 } } },
        { "1 FULL_OPENCV 40 20 30 31 21 11 1 2 3 4 5 6 7 8\n",
          { .model = CAMERA_RATIONAL, .fx = 30, .fy = 31, .cx = 21, .cy = 11, .k = { 1, 2, 5, 6, 7, 8 }, .p = { 3, 4 } } },
        { "1 SIMPLE_RADIAL_FISHEYE 40 20 30 21 11 1\n",
          { .model = CAMERA_FISHEYE, .fx = 30, .fy = 30, .cx = 21, .cy = 11, .k = { 1 } } },
        { "1 RADIAL_FISHEYE 40 20 30 21 11 1 2\n",
          { .model = CAMERA_FISHEYE, .fx = 30, .fy = 30, .cx = 21, .cy = 11, .k = { 1, 2 } } },
    };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        const char *images = "1 1 0 0 0 0 0 0 1 a.jpg\n\n";
        const struct camera *e = &cases[i].expected;
        struct cameras c;
        assert_int_equal(cameras_parse_colmap_text(&c, cases[i].line, strlen(cases[i].line), "c", images, strlen(images), "i"), 0);
        const struct camera *v = c.view;
        assert_int_equal(v->model, e->model);
        assert_true(v->fx == e->fx && v->fy == e->fy && v->cx == e->cx && v->cy == e->cy && v->skew == 0);
        assert_memory_equal(v->k, e->k, sizeof(v->k));
        assert_memory_equal(v->p, e->p, sizeof(v->p));
        assert_true(v->width_px == 40 && v->height_px == 20);
        cameras_free(&c);
    }
}

static void broken_text_is_refused_with_its_line(void **state)
{
    (void)state;
    static const struct {
        const char *cameras, *images;
        int err;
        const char *says;
    } cases[] = {
        { "", IMG, -EINVAL, "camera 3" },
        { CAM, "", -EINVAL, "no images" },
        { CAM, "# nothing\n\n", -EINVAL, "no images" },
        { "1 PINHOLE 40 20 30 31 20\n", IMG, -EINVAL, "c:1: a camera parameter is missing" },
        { "1 PINHOLE 40 20 30 31 20 10 5\n", IMG, -EINVAL, "more numbers" },
        { "1 PINHOLE 40 20 30 31 20 1O\n", IMG, -EINVAL, "'1O'" },
        { "1 PINHOLE 40 20 30 31 20 nan\n", IMG, -EINVAL, "'nan'" },
        { "1 PINHOLE 40 20 30 31 20 10", IMG, -EINVAL, "cut short" },
        { "1 BOX 40 20 30 31 20 10\n", IMG, -EINVAL, "'BOX'" },
        { "1 PINHOLE 40 0 30 31 20 10\n", IMG, -EINVAL, "40 x 0" },
        { "1 PINHOLE 40 99999999999999999999 30 31 20 10\n", IMG, -EINVAL, "image height" },
        { "\n\n-1 PINHOLE 40 20 30 31 20 10\n", IMG, -EINVAL, "c:3: the camera id is '-1'" },
        { CAM "3 PINHOLE 40 20 30 31 20 10\n", IMG, -EINVAL, "two cameras have the id 3" },
        { "# Number of cameras: 3\n" CAM, IMG, -EINVAL, "announces 3" },
        { "7 PINHOLE 40 20 -30 31 20 10\n3 PINHOLE 4 2 3 3 2 1\n", IMG, -EINVAL, "focal" },
        { CAM, "# Number of images: 3\n" IMG, -EINVAL, "announces 3" },
        { CAM, IMG "2 1 0 0 0 0 0 1 7 z/x.jpg\n\n", -EINVAL, "'x'" },
        { CAM, "1 1 0 0 0 0 0 0 7 a.jpg\n2 1 0 0 0 0 0 0 7 b.jpg\n", -EINVAL, "i:2: 'b.jpg'" },
        { CAM, "1 1 0 0 0 0 0 0 7 a.jpg\n1 2\n", -EINVAL, "2 words" },
        { CAM, "1 0 0 0 0 0 0 0 7 a.jpg\n\n", -EINVAL, "quaternion" },
        { CAM, "1 1 0 0 0 1e300 0 0 7 a.jpg\n\n", -EINVAL, "translation" },
        { CAM, "1 1 0 0 0 0 0 0 8 a.jpg\n\n", -EINVAL, "camera 8" },
        { CAM, "1 1 0 0 0 0 0 0 7\n\n", -EINVAL, "image name ''" },
        { CAM, "1 1 0 0 0 0 0 0 7 a.jpg", -EINVAL, "cut short" },
        { CAM, "1 1 0 0 0 0 0 0 7 a\tb.jpg\n\n", -EINVAL, "control" },
        { "7 FOV 40 20 30 31 20 10 .9\n", "1 1 0 0 0 0 0 0 7 a.jpg\n\n", -ENOTSUP, "FOV" },
        { "7 THIN_PRISM_FISHEYE 40 20 30 31 20 10 0 0 0 0 0 0 0 0\n", "1 1 0 0 0 0 0 0 7 a.jpg\n\n", -ENOTSUP, "THIN_PRISM" },
    };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        struct cameras c;
        logged[0] = 0;
        assert_int_equal(cameras_parse_colmap_text(&c, cases[i].cameras, strlen(cases[i].cameras), "c", cases[i].images,
                                                   strlen(cases[i].images), "i"), cases[i].err);
        if (!strstr(logged, cases[i].says))
            fail_msg("case %zu says: %s", i, logged);
        assert_true(c.n == 0 && !c.view);
    }
    // a model we do not read hurts nobody while no image uses it; a missing last empty line neither
    const char *cameras = CAM "4 FOV 40 20 30 31 20 10 .9\n5 EQUIRECTANGULAR 40 20 40 20\n", *images = "1 1 0 0 0 0 0 0 7 a\n";
    struct cameras c;
    assert_int_equal(cameras_parse_colmap_text(&c, cameras, strlen(cameras), "c", images, strlen(images), "i"), 0);
    cameras_free(&c);
}

// Both files of a small model, cut after every length: an error, or (where the cut took only points) the same cameras.
static void cut_files_never_give_other_cameras(void **state)
{
    (void)state;
    struct camera views[4] = { make_view(0, 0), make_view(2, 1), make_view(4, 2), make_view(6, 3) };
    const struct cameras c = { 4, views };
    static const char *const names[2][2] = { { "cameras.txt", "images.txt" }, { "cameras.bin", "images.bin" } };
    for (int binary = 0; binary < 2; binary++) {
        char *bytes[2] = { NULL, NULL };
        size_t n[2] = { 0, 0 };
        struct cameras whole;
        assert_int_equal(
            (binary ? cameras_write_colmap_binary : cameras_write_colmap_text)(&c, scratch_dir), 0);
        for (int k = 0; k < 2; k++)
            assert_int_equal(file_read(&bytes[k], &n[k], scratch_path(names[binary][k]), 1 << 20),
                             0);
        assert_int_equal(cameras_read(&whole, scratch_dir), 0);
        for (int k = 0; k < 2; k++)
            for (size_t cut = 0; cut < n[k]; cut++) {
                char *exact = malloc(cut + !cut); // of this very length, so that a read beyond is seen
                memcpy(exact, bytes[k], cut);
                const char *a = k == 0 ? exact : bytes[0], *b = k == 1 ? exact : bytes[1];
                const size_t n_a = k == 0 ? cut : n[0], n_b = k == 1 ? cut : n[1];
                struct cameras back;
                logged[0] = 0;
                const int err = binary ? cameras_parse_colmap_binary(&back, a, n_a, "c", b, n_b, "i")
                                       : cameras_parse_colmap_text(&back, a, n_a, "c", b, n_b, "i");
                if (err) {
                    assert_int_equal(err, -EINVAL);
                    assert_true(logged[0] && !back.view);
                } else {
                    assert_true(!binary && k == 1 && cut == n[k] - 1); // only the very last, empty line may go
                    assert_int_equal(back.n, whole.n);
                    assert_memory_equal(back.view, whole.view, (size_t)whole.n * sizeof(*whole.view));
                    cameras_free(&back);
                }
                free(exact);
            }
        cameras_free(&whole);
        free(bytes[0]);
        free(bytes[1]);
        scratch_empty();
    }
}

static void absurd_counts_are_refused_before_memory_is_asked_for(void **state)
{
    (void)state;
    static const uint64_t counts[] = { 1, 2, 1000, UINT64_C(1) << 31, UINT64_C(1) << 32, UINT64_C(1) << 60, UINT64_C(1) << 63,
                                       UINT64_MAX };
    struct camera view = make_view(0, 0);
    const struct cameras c = { 1, &view };
    char *bytes[2] = { NULL, NULL };
    size_t n[2] = { 0, 0 };
    assert_int_equal(cameras_write_colmap_binary(&c, scratch_dir), 0);
    assert_int_equal(file_read(&bytes[0], &n[0], scratch_path("cameras.bin"), 1 << 20), 0);
    assert_int_equal(file_read(&bytes[1], &n[1], scratch_path("images.bin"), 1 << 20), 0);
    for (size_t i = 0; i < sizeof(counts) / sizeof(counts[0]); i++)
        for (int place = 0; place < 3; place++) { // cameras, images, points of the image
            char *copy[2] = { malloc(n[0]), malloc(n[1]) };
            struct cameras back;
            memcpy(copy[0], bytes[0], n[0]);
            memcpy(copy[1], bytes[1], n[1]);
            char *at = place == 0 ? copy[0] : place == 1 ? copy[1] : copy[1] + n[1] - 8;
            for (int k = 0; k < 8; k++)
                at[k] = (char)(counts[i] >> 8 * k);
            const bool is_right = counts[i] == 1 && place < 2;
            assert_int_equal(cameras_parse_colmap_binary(&back, copy[0], n[0], "c", copy[1], n[1], "i"), is_right ? 0 : -EINVAL);
            cameras_free(&back);
            free(copy[0]);
            free(copy[1]);
        }
    free(bytes[0]);
    free(bytes[1]);
    scratch_empty();
}

static void what_is_no_camera_file_is_refused(void **state)
{
    (void)state;
    struct cameras c;
    static const char *const texts[] = { "hello\n", "" };
    for (int i = 0; i < 2; i++) {
        scratch_write("file", texts[i], strlen(texts[i]));
        assert_int_equal(cameras_read(&c, scratch_path("file")), -EINVAL);
        assert_non_null(strstr(logged, "not a known camera file"));
        assert_non_null(strstr(logged, "COLMAP"));
    }
    scratch_empty();
    assert_int_equal(cameras_read(&c, scratch_dir), -EINVAL);
    assert_non_null(strstr(logged, "no cameras in this folder"));
    assert_int_equal(cameras_read(&c, scratch_path("nothing")), -ENOENT);
    assert_int_equal(cameras_read(&c, "/dev/zero"), -EINVAL);
    scratch_write("IMG_1.xmp", "", 0);
    // COLMAP beside them wins; binary wins over text; one file stands for its folder
    const char *images = "1 1 0 0 0 0 0 0 7 text.jpg\n\n";
    scratch_write("cameras.txt", CAM, strlen(CAM));
    scratch_write("images.txt", images, strlen(images));
    assert_int_equal(cameras_read(&c, scratch_path("images.txt")), 0);
    assert_string_equal(c.view[0].name, "text");
    cameras_free(&c);
    struct camera view = make_view(0, 0);
    assert_int_equal(cameras_write_colmap_binary(&(struct cameras){ 1, &view }, scratch_dir), 0);
    assert_int_equal(cameras_read(&c, scratch_dir), 0);
    assert_string_equal(c.view[0].name, view.name);
    cameras_free(&c);
    scratch_empty();
}

static void files_of_colmap_and_blender_are_read(void **state)
{
    (void)state;
    const char *const data = "../shared/data";
    char path[512];
    struct cameras text, binary, again;
    if (access(data, F_OK)) {
        fprintf(stderr, "test_cameras: no ../shared/data here: real files are not tried\n");
        return;
    }
    snprintf(path, sizeof(path), "%s/cameras/colmap_bin", data);
    assert_int_equal(cameras_read(&binary, path), 0);
    snprintf(path, sizeof(path), "%s/cameras/colmap_txt", data);
    assert_int_equal(cameras_read(&text, path), 0);
    assert_int_equal(binary.n, 11);
    assert_int_equal(text.n, 11);
    // The text says 6 digits only (f = 2971.71): it agrees with the binary as far as that goes, and to 1e-6 px once it is written
    // out again from the same numbers.
    assert_int_equal(cameras_write_colmap_text(&binary, scratch_dir), 0);
    assert_int_equal(cameras_read(&again, scratch_dir), 0);
    double by_hand = 0, most = 0;
    int n_seen = 0;
    for (int i = 0; i < 11; i++) {
        const struct camera *b = &binary.view[i], *t = cameras_find(&text, b->name), *a = cameras_find(&again, b->name);
        assert_non_null(t);
        assert_non_null(a);
        for (uint64_t k = 0; k < 1000; k++) { // points seen by the binary's view, 2 to 6 units away
            const double at[2] = { b->width_px * random_uniform(1, 1, k), b->height_px * random_uniform(1, 2, k) };
            double d[3], p[3], u[2], v[2], w[2];
            if (!camera_ray(b, at, d))
                continue;
            vec3_add_scaled(p, b->centre_m, 2 + 4 * random_uniform(1, 3, k), d);
            assert_true(camera_project(b, p, u, NULL) && camera_project(t, p, v, NULL) && camera_project(a, p, w, NULL));
            by_hand = fmax(by_hand, hypot(u[0] - v[0], u[1] - v[1]));
            most = fmax(most, hypot(u[0] - w[0], u[1] - w[1]));
            n_seen++;
        }
    }
    fprintf(stderr, "test_cameras: COLMAP text against binary: %.3g px with 17 digits, %.3g px as shipped with 6 digits, "
            "%d points\n", most, by_hand, n_seen);
    assert_int_equal(n_seen, 11000);
    assert_true(most < 1e-6);
    assert_true(by_hand < .1); // half a unit in the 6th digit of every number
    cameras_free(&binary);
    cameras_free(&text);
    cameras_free(&again);
    static const char *const studios[2] = { "pebble", "vase" };
    for (int i = 0; i < 2; i++) {
        snprintf(path, sizeof(path), "%s/studio-%s/geometry/cameras", data, studios[i]);
        assert_int_equal(cameras_read(&text, path), 0);
        assert_int_equal(text.n, 85);
        assert_non_null(cameras_find(&text, "cam084"));
        cameras_free(&text);
    }
    scratch_empty();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(first_pixel_centre_is_at_one_half),
        cmocka_unit_test(look_at_puts_the_target_ahead_and_up_upwards),
        cmocka_unit_test(distortion_is_what_the_header_says),
        cmocka_unit_test(ray_is_the_inverse_of_projection),
        cmocka_unit_test(jacobian_matches_differences),
        cmocka_unit_test(points_behind_or_beyond_the_fold_are_not_seen),
        cmocka_unit_test(colmap_round_trip_keeps_every_distortion_model),
        cmocka_unit_test(what_colmap_cannot_hold_is_refused_by_view),
        cmocka_unit_test(colmap_text_is_read_to_the_letter),
        cmocka_unit_test(each_parameter_goes_to_its_place),
        cmocka_unit_test(broken_text_is_refused_with_its_line),
        cmocka_unit_test(cut_files_never_give_other_cameras),
        cmocka_unit_test(absurd_counts_are_refused_before_memory_is_asked_for),
        cmocka_unit_test(what_is_no_camera_file_is_refused),
        cmocka_unit_test(files_of_colmap_and_blender_are_read),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
