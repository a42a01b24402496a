// tests/test_lens.c - lens models against themselves, the solver's cameras, the sphere's area, and hugin's nona (where it is installed).
#include "rigd/lens.h"
#include "solver/cameras.h"
#include "solver/panorama.h"
#include "solver/random.h"
#include "solver/take/image.h"
#include "solver/take/log.h"
#include "solver/vec3.h"
#include "tests/scratch.h"

#include <errno.h>
#include <math.h>
#include <string.h>

enum { SEED = 17 };
static const double deg = M_PI / 180;

static struct lens typical(enum lens_model m)
{
    struct lens l = { .model = m, .width_px = 900, .height_px = 600, .focal_px = m == LENS_RECTILINEAR ? 520 : 190,
                      .centre_px = { 455.5, 297.25 } };
    if (m == LENS_RECTILINEAR) {
        const double k[3] = { -.11, .03, -.004 }, p[2] = { 8e-4, -5e-4 };
        memcpy(l.k, k, sizeof(k));
        memcpy(l.p, p, sizeof(p));
    } else {
        l.k[0] = -.012, l.k[1] = .0015, l.k[2] = -1e-4;
        l.max_angle_rad = 95 * deg;
    }
    assert_int_equal(lens_init(&l, "typical"), 0);
    return l;
}

static void a_pixel_comes_back_from_its_direction(void **state)
{
    (void)state;
    for (int m = 0; m < LENS_MODELS; m++) {
        const struct lens l = typical((enum lens_model)m);
        int n = 0;
        for (uint64_t i = 0; i < 20000; i++) {
            const double px[2] = { 900 * random_uniform(SEED, 1, i), 600 * random_uniform(SEED, 2, i) };
            double dir[3], back[2];
            if (!lens_ray(&l, px, dir))
                continue;
            n++;
            assert_float_equal(vec3_norm(dir), 1, 1e-14);
            for (int c = 0; c < 3; c++)
                dir[c] *= 3.25; // length does not matter
            assert_true(lens_project(&l, dir, back));
            assert_float_equal(back[0], px[0], 1e-9);
            assert_float_equal(back[1], px[1], 1e-9);
        }
        if (getenv("VERBOSE"))
            fprintf(stderr, "%s: %d of 20000 pixels seen\n", lens_model_name(l.model), n);
        assert_true(n > 8000); // the image circle of 95 degrees
    }
}

// Another author's formulas: the solver's BROWN and fisheye cameras.
static void brown_and_equidistant_agree_with_the_solvers_cameras(void **state)
{
    (void)state;
    for (int m = LENS_RECTILINEAR; m <= LENS_EQUIDISTANT; m++) {
        struct lens l = typical((enum lens_model)m);
        l.p[0] = m ? 0 : l.p[0], l.p[1] = m ? 0 : l.p[1];
        struct camera c = { .model = m ? CAMERA_FISHEYE : CAMERA_BROWN, .width_px = 900, .height_px = 600, .fx = l.focal_px, .fy = l.focal_px,
                            .cx = l.centre_px[0], .cy = l.centre_px[1], .cam_from_world = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
        memcpy(c.k, l.k, sizeof(l.k));
        // The solver follows Metashape where p1 multiplies (s + 2 x^2): OpenCV's p2.
        c.p[0] = l.p[0], c.p[1] = l.p[1];
        for (uint64_t i = 0; i < 2000; i++) {
            const double a = 40 * deg * sqrt(random_uniform(SEED, 3, i)), b = 2 * M_PI * random_uniform(SEED, 4, i);
            const double d[3] = { 2 * sin(a) * cos(b), 2 * sin(a) * sin(b), 2 * cos(a) };
            double ours[2], theirs[2];
            assert_true(lens_project(&l, d, ours));
            assert_true(camera_project(&c, d, theirs, NULL));
            assert_float_equal(ours[0], theirs[0], 1e-9);
            assert_float_equal(ours[1], theirs[1], 1e-9);
        }
    }
}

static void pixels_of_the_circle_add_up_to_the_cap(void **state)
{
    (void)state;
    for (int m = 0; m < LENS_MODELS; m++) {
        struct lens l = typical((enum lens_model)m);
        // Against corners of the pixel, by the area of two spherical triangles: the density, everywhere.
        for (uint64_t i = 0; i < 500; i++) {
            const double px[2] = { 250 + 400 * random_uniform(SEED, 5, i), 100 + 400 * random_uniform(SEED, 6, i) };
            double d[4][3], area = 0;
            for (int k = 0; k < 4; k++) {
                const double corner[2] = { px[0] + (k == 1 || k == 2 ? .5 : -.5), px[1] + (k >= 2 ? .5 : -.5) };
                assert_true(lens_ray(&l, corner, d[k]));
            }
            for (int k = 1; k < 3; k++) {
                double n[3];
                vec3_cross(n, d[k], d[k + 1]);
                area += 2 * atan2(vec3_dot(d[0], n), 1 + vec3_dot(d[0], d[k]) + vec3_dot(d[k], d[k + 1]) + vec3_dot(d[k + 1], d[0]));
            }
            assert_float_equal(lens_solid_angle(&l, px) / area, 1, 2e-5);
        }
        // Without distortion the circle of an angle is the cap of that angle. The sum is over pixel centres: its rim is the error.
        l = (struct lens){ .model = (enum lens_model)m, .width_px = 800, .height_px = 800, .focal_px = m ? 250 : 450,
                           .centre_px = { 400, 400 }, .max_angle_rad = 40 * deg };
        assert_int_equal(lens_init(&l, "cap"), 0);
        double sum = 0;
        for (int y = 0; y < 800; y++)
            for (int x = 0; x < 800; x++)
                sum += lens_solid_angle(&l, (double[2]){ x + .5, y + .5 });
        assert_float_equal(sum / (2 * M_PI * (1 - cos(40 * deg))), 1, 1e-3);
    }
}

static void what_the_lens_cannot_see_has_no_pixel(void **state)
{
    (void)state;
    struct lens l = typical(LENS_EQUIDISTANT);
    const double behind[3] = { .01, 0, -1 }, beside[3] = { 1, 0, -.05 }; // 93 degrees
    double px[2], d[3];
    assert_false(lens_project(&l, behind, px));
    assert_true(lens_project(&l, beside, px));
    l.circle_px = 200;
    assert_int_equal(lens_init(&l, "circle"), 0);
    assert_false(lens_project(&l, beside, px));
    assert_false(lens_ray(&l, (double[2]){ 455.5 + 201, 297.25 }, d));
    assert_true(lens_solid_angle(&l, (double[2]){ 455.5 + 201, 297.25 }) == 0);
    assert_true(lens_ray(&l, (double[2]){ 455.5 + 199, 297.25 }, d));
    // A polynomial that folds back: only the part before the fold is used, so no direction has two pixels.
    struct lens fold = { .model = LENS_RECTILINEAR, .width_px = 800, .height_px = 800, .focal_px = 300, .centre_px = { 400, 400 }, .k = { -.2 } };
    assert_int_equal(lens_init(&fold, "fold"), 0);
    assert_true(fold.max_r < 1.3 && fold.max_r > 1.28); // 1 - .6 r^2 = 0 at 1.29
    assert_false(lens_project(&fold, (double[3]){ 1.4, 0, 1 }, px));
    assert_false(lens_ray(&fold, (double[2]){ 400 + 300 * .87, 400 }, d)); // beyond the highest radius, 300 x .861
    assert_true(lens_ray(&fold, (double[2]){ 400 + 300 * .85, 400 }, d));
    assert_true(lens_project(&fold, d, px));
    assert_float_equal(px[0], 400 + 300 * .85, 1e-9);
}

static void bad_lenses_are_refused(void **state)
{
    (void)state;
    static const char *const bad[] = {
        "{\"lens\": {\"model\": \"fisheye\", \"width_px\": 100, \"height_px\": 100, \"focal_px\": 50}}",
        "{\"lens\": {\"model\": \"equidistant\", \"width_px\": 100.5, \"height_px\": 100, \"focal_px\": 50}}",
        "{\"lens\": {\"model\": \"equidistant\", \"width_px\": 1e9, \"height_px\": 100, \"focal_px\": 50}}",
        "{\"lens\": {\"model\": \"equidistant\", \"width_px\": 100, \"height_px\": 100, \"focal_px\": 0}}",
        "{\"lens\": {\"model\": \"equidistant\", \"width_px\": 100, \"height_px\": 100}}",
        "{\"lens\": {\"model\": \"equidistant\", \"width_px\": 100, \"height_px\": 100, \"focal_px\": 50, \"centre_px\": [1]}}",
        "{\"lens\": {\"model\": \"rectilinear\", \"width_px\": 100, \"height_px\": 100, \"focal_px\": 50, \"max_angle_deg\": 95}}",
        "{\"lens\": {\"model\": \"equidistant\", \"width_px\": 100, \"height_px\": 100, \"focal_px\": 50, \"circle_px\": -1}}",
        "{\"lens\": {\"model\": \"rectilinear\", \"width_px\": 100, \"height_px\": 100, \"focal_px\": 50, \"shading\": [-1, 0, 0]}}",
        "{\"lens\": 3}", "{}",
    };
    log_set_level(LOG_SILENT);
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        struct json *v;
        struct lens l;
        assert_int_equal(json_parse(&v, bad[i], strlen(bad[i]), "test"), 0);
        assert_int_equal(lens_from_json(&l, v, "lens", "test"), -EINVAL);
        assert_int_equal(l.width_px, 0);
        json_free(v);
    }
    log_set_level(LOG_INFO);
    static const char good[] = "{\"model\": \"equisolid\", \"width_px\": 100, \"height_px\": 80, \"focal_px\": 30, \"distortion\": [0.01, 0, 0, 0, 0.002], "
                               "\"max_angle_deg\": 100, \"circle_px\": 45}";
    struct json *v;
    struct lens l;
    assert_int_equal(json_parse(&v, good, strlen(good), "test"), 0);
    assert_int_equal(lens_from_json(&l, v, "", "test"), 0);
    assert_true(l.model == LENS_EQUISOLID && l.centre_px[0] == 50 && l.centre_px[1] == 40 && l.k[0] == .01 && l.p[1] == .002 && l.circle_px == 45);
    json_free(v);
}

static void the_head_turns_left_up_and_clockwise(void **state)
{
    (void)state;
    double R[9], d[3];
    const double right[3] = { 1, 0, 0 }, forward[3] = { 0, 0, 1 };
    lens_head(R, 0, 0, 0);
    mat3_mul_vec(d, R, right);
    assert_true(d[0] == -1 && d[1] == 0 && d[2] == 0);
    lens_head(R, 30 * deg, 20 * deg, 10 * deg);
    assert_float_equal(mat3_det(R), 1, 1e-15);
    mat3_mul_vec(d, R, forward);
    double x, y;
    panorama_pixel(3600, 1800, d, &x, &y);
    assert_float_equal(x, 1800 - 300, 1e-9); // left of the middle
    assert_float_equal(y, 900 - 200, 1e-9);  // above it
    mat3_mul_vec(d, R, right);
    assert_float_equal(d[1], -sin(10 * deg) * cos(20 * deg), 1e-15); // the camera's right side sinks
}

// ---- nona: the input's pixels hold their own coordinates, so its output says which pixel it saw in each direction ------------

static bool run_nona(const char *f, double hfov_deg, double b, double dx, double dy, int width, int height, const double head_deg[3])
{
    char command[2048];
    FILE *pto = fopen(scratch_path("a.pto"), "w");
    assert_non_null(pto);
    fprintf(pto, "p f2 w720 h360 v360 E0 R1 n\"TIFF\"\n");
    fprintf(pto, "i w%d h%d f%s v%.15g Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 r%.15g p%.15g y%.15g a0 b%.15g c0 d%.15g e%.15g g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n\"in.exr\"\n",
            width, height, f, hfov_deg, head_deg[2], head_deg[1], -head_deg[0], b, dx, dy);
    fprintf(pto, "m i5\n");
    fclose(pto);
    snprintf(command, sizeof(command), "cd '%s' && nona -r ldr -m TIFF_m -o out a.pto >nona.log 2>&1", scratch_dir);
    return system(command) == 0;
}

static void nona_sees_the_same_pixels(void **state)
{
    (void)state;
    if (system("nona --help >/dev/null 2>&1") != 0) {
        fprintf(stderr, "test_lens: nona (hugin-tools) is not installed: the check against it did not run\n");
        return;
    }
    static const char *const hugin[LENS_MODELS] = { "0", "3", "21", "10" };
    // Coordinates modulo PERIOD: nona takes values through two tables of a film's response, which cost a ten-thousandth of the range.
    enum { W = 720, H = 480, PERIOD = 24 };
    static const double heads[][3] = { { 0, 0, 0 }, { 40, 0, 0 }, { 0, 25, 0 }, { 0, 0, 15 }, { -110, 35, -20 } };
    struct image in;
    assert_int_equal(image_new(&in, W, H, 3, NULL), 0);
    for (int y = 0; y < H; y++)
        for (int x = 0; x < W; x++) {
            float *p = in.data + 3 * (y * W + x);
            p[0] = ((float)(x % PERIOD) + .5f) / PERIOD, p[1] = ((float)(y % PERIOD) + .5f) / PERIOD, p[2] = 1;
        }
    assert_int_equal(image_write_exr(&in, scratch_path("in.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    image_free(&in);
    for (int m = 0; m < LENS_MODELS; m++)
        for (size_t h = 0; h < sizeof(heads) / sizeof(heads[0]); h++) {
            const double fov = (m ? 150 : 80) * deg, b = m == LENS_STEREOGRAPHIC ? 0 : -.05, dx = 6, dy = -9, n = H / 2;
            const double f = m == LENS_RECTILINEAR ? W / (2 * tan(.5 * fov)) : m == LENS_EQUIDISTANT ? W / fov :
                             m == LENS_EQUISOLID ? W / (4 * sin(.25 * fov)) : W / (4 * tan(.25 * fov));
            // Hugin: r' = r (b r^2 + 1 - b), r in half heights. Ours: k1 in focal lengths.
            struct lens l = { .model = (enum lens_model)m, .width_px = W, .height_px = H, .focal_px = f * (1 - b), .centre_px = { W / 2 + dx, H / 2 + dy },
                              .k = { b / (1 - b) * f * f / (n * n) } };
            assert_int_equal(lens_init(&l, "nona"), 0);
            assert_true(run_nona(hugin[m], fov / deg, b, dx, dy, W, H, heads[h]));
            struct image out;
            assert_int_equal(image_read(&out, scratch_path("out0000.tif")), 0);
            assert_true(out.n_channels >= 3);
            double R[9], worst = 0, sum = 0;
            int n_seen = 0;
            lens_head(R, heads[h][0] * deg, heads[h][1] * deg, heads[h][2] * deg);
            for (int y = 0; y < out.height; y++)
                for (int x = 0; x < out.width; x++) {
                    const float *p = out.data + (size_t)(y * out.width + x) * (size_t)out.n_channels;
                    double dir[3], cam[3], px[2];
                    if (p[2] < .99f)
                        continue; // not seen by nona
                    panorama_direction(out.width, out.height, x + .5, y + .5, dir);
                    mat3_tmul_vec(cam, R, dir);
                    if (!lens_project(&l, cam, px) || px[0] < 2 || px[0] > W - 2 || px[1] < 2 || px[1] > H - 2)
                        continue;
                    const double mx = fmod(px[0], PERIOD), my = fmod(px[1], PERIOD);
                    if (mx < 1 || mx > PERIOD - 1 || my < 1 || my > PERIOD - 1)
                        continue; // where the ramp starts anew
                    const double e = hypot((double)p[0] * PERIOD - mx, (double)p[1] * PERIOD - my);
                    worst = e > worst ? e : worst;
                    sum += e;
                    n_seen++;
                }
            image_free(&out);
            if (getenv("VERBOSE"))
                fprintf(stderr, "%s head %zu: %d pixels, mean %.4f worst %.4f px\n", lens_model_name(l.model), h, n_seen, sum / n_seen, worst);
            assert_true(n_seen > 5000);
            assert_true(worst < .02); // those tables
        }
    scratch_empty();
}

static int open_all(void **state)
{
    (void)state;
    return scratch_open();
}

static int close_all(void **state)
{
    (void)state;
    return scratch_close();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_pixel_comes_back_from_its_direction),
        cmocka_unit_test(brown_and_equidistant_agree_with_the_solvers_cameras),
        cmocka_unit_test(pixels_of_the_circle_add_up_to_the_cap),
        cmocka_unit_test(what_the_lens_cannot_see_has_no_pixel),
        cmocka_unit_test(bad_lenses_are_refused),
        cmocka_unit_test(the_head_turns_left_up_and_clockwise),
        cmocka_unit_test(nona_sees_the_same_pixels),
    };
    return cmocka_run_group_tests(tests, open_all, close_all);
}
