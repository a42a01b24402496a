// tests/test_stitch.c - flux is kept, the sphere is tiled, directions are right, seams vanish, clipped lights and holes are declared.
#include "rigd/stitch.h"
#include "tests/panorama_camera.h"
#include "solver/take/log.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <errno.h>
#include <cmocka.h>

static const double deg = M_PI / 180;
static const double identity[9] = { 1, 0, 0, 0, 1, 0, 0, 0, 1 };

static struct sim_camera fisheye(int size_px, double half_angle_deg)
{
    struct sim_camera c = sim_usual;
    c.lens = (struct lens){ .model = LENS_EQUISOLID, .width_px = size_px, .height_px = size_px, .centre_px = { size_px / 2. + 1.5, size_px / 2. - 2.25 },
                            .focal_px = .48 * size_px / (2 * sin(.5 * half_angle_deg * deg)), .max_angle_rad = half_angle_deg * deg };
    c.response[0] = c.response[1] = c.response[2] = 1;
    c.f_number = 1;
    assert_int_equal(lens_init(&c.lens, "fisheye"), 0);
    return c;
}

// What the camera sees, without noise.
static void look(struct merged *out, const struct image *truth, const struct sim_camera *c, int samples)
{
    const size_t n = (size_t)c->lens.width_px * (size_t)c->lens.height_px;
    *out = (struct merged){ .width = c->lens.width_px, .height = c->lens.height_px, .cfa = { { 0, 1 }, { 1, 2 } }, .radiance = sim_see(truth, c, samples),
                            .variance = malloc(n * sizeof(float)), .quality = malloc(n) };
    assert_true(out->radiance && out->variance && out->quality);
    for (size_t i = 0; i < n; i++)
        out->variance[i] = 1e-4f;
    memset(out->quality, BRACKET_GOOD, n);
}

static void add(struct stitch *s, const struct sim_camera *c, const struct merged *m, struct stitch_stop_report *r)
{
    double R[9];
    lens_head(R, c->yaw_deg * deg, c->pitch_deg * deg, c->roll_deg * deg);
    assert_int_equal(stitch_add(s, &c->lens, R, m, r), 0);
}

// radiance: of all; direction: where a spot of radiance 1000 is (NULL: none).
static void room(struct image *out, int width, float radiance, const double direction[3])
{
    assert_int_equal(image_new(out, width, width / 2, 3, NULL), 0);
    for (int y = 0; y < width / 2; y++)
        for (int x = 0; x < width; x++) {
            double d[3];
            panorama_direction(width, width / 2, x + .5, y + .5, d);
            for (int c = 0; c < 3; c++)
                out->data[(y * width + x) * 3 + c] = direction && vec3_dot(d, direction) > cos(.05) ? 1000 : radiance;
        }
}

static void a_constant_room_comes_back_constant_and_its_solid_angles_add_up(void **state)
{
    (void)state;
    struct image truth, out;
    room(&truth, 64, 3, NULL);
    // Up and down: both poles inside, where pixels span all longitudes. Odd sizes of texels against pixels.
    for (int k = 0; k < 3; k++) {
        struct stitch *s;
        struct stitch_stop_report r;
        struct panorama_report whole;
        struct merged m;
        struct sim_camera c = fisheye(240, 85);
        c.pitch_deg = k == 0 ? 90 : k == 1 ? -83 : 20;
        c.yaw_deg = k == 2 ? 175 : 10; // across the panorama's border
        c.roll_deg = 30;
        look(&m, &truth, &c, 1);
        assert_int_equal(stitch_new(&s, k == 1 ? 256 : 94), 0);
        add(s, &c, &m, &r);
        assert_int_equal(stitch_finish(&out, s, identity, &whole), 0);
        // The lens' own measure of its pixels, whose corners are all seen.
        double expected = 0;
        for (int y = 0; y < m.height; y++)
            for (int x = 0; x < m.width; x++) {
                double d[3];
                bool seen = hypot(x + .5 - c.lens.centre_px[0], y + .5 - c.lens.centre_px[1]) < lens_reach_px(&c.lens) - 2.2;
                for (int q = 0; q < 4; q++)
                    seen = seen && lens_ray(&c.lens, (double[2]){ x + (q & 1), y + (q >> 1) }, d);
                expected += seen ? lens_solid_angle(&c.lens, (double[2]){ x + .5, y + .5 }) : 0;
            }
        assert_float_equal(r.solid_angle_sr / expected, 1, 1e-4);
        assert_float_equal((4 * M_PI - whole.uncovered_sr) / expected, 1, 1e-4);
        assert_true(whole.clipped_sr == 0 && whole.n_lights == 0);
        for (int i = 0; i < out.width * out.height; i++) {
            const float *p = out.data + (size_t)i * (size_t)out.n_channels;
            if (p[6] > 0)
                assert_true(fabsf(p[0] - 3) < 1e-4f && fabsf(p[1] - 3) < 1e-4f && fabsf(p[2] - 3) < 1e-4f);
            else
                assert_true(p[0] == 0 && p[1] == 0 && p[2] == 0);
            // All of a texel inside is covered: no hairline gaps between patches, no overlaps.
            double d[3], cam[3], R[9], px[2];
            panorama_direction(out.width, out.height, i % out.width + .5, i / out.width + .5, d);
            lens_head(R, c.yaw_deg * deg, c.pitch_deg * deg, c.roll_deg * deg);
            mat3_tmul_vec(cam, R, d);
            if (acos(fmin(cam[2], 1)) < 78 * deg && lens_project(&c.lens, cam, px))
                // Edges are straight in (longitude, sin latitude): .3 % for these pixels of .7 degrees, by the square of their size; at a pole more.
                assert_true(p[6] > (i < 2 * out.width || i >= out.width * (out.height - 2) ? .95f : .995f));
        }
        image_free(&out);
        merged_free(&m);
        stitch_free(s);
    }
    image_free(&truth);
}

// The sum over texels of radiance x solid angle is the sum over photosites, colour by colour, wherever a lamp lies and however small it is.
static void flux_is_kept(void **state)
{
    (void)state;
    for (int k = 0; k < 6; k++) {
        struct image truth, out;
        struct stitch *s;
        struct stitch_stop_report r;
        struct panorama_report whole;
        struct merged m;
        struct sim_camera c = fisheye(k == 5 ? 900 : 200, 85);
        double d[3] = { .3 * (k - 2), k == 4 ? 2 : .4, 1 }; // on the pole side for 4
        c.pitch_deg = k == 4 ? 60 : 10;
        vec3_normalise(d);
        room(&truth, 512, 0, d);
        look(&m, &truth, &c, 3);
        assert_int_equal(stitch_new(&s, k == 3 ? 40 : 128), 0); // texels of 9 and of 3 degrees; the lamp is 6 wide
        add(s, &c, &m, &r);
        assert_int_equal(stitch_finish(&out, s, identity, &whole), 0);
        double sites[3] = { 0 };
        for (int y = 0; y < m.height; y++)
            for (int x = 0; x < m.width; x++) {
                const int colour = m.cfa[y & 1][x & 1];
                sites[colour] += (colour == 1 ? 2 : 4) * (double)m.radiance[y * m.width + x] * lens_solid_angle(&c.lens, (double[2]){ x + .5, y + .5 });
            }
        double truth_flux[3];
        panorama_total(&(struct panorama){ truth }, truth_flux);
        for (int q = 0; q < 3; q++) {
            assert_float_equal(whole.total[q] / sites[q], 1, 1e-4);
            assert_float_equal(whole.total[q] / truth_flux[q], 1, k == 5 ? .02 : .2); // but for 5, few photosites of a colour see so small a lamp

        }
        image_free(&out);
        image_free(&truth);
        merged_free(&m);
        stitch_free(s);
    }
}

static void a_lamp_lies_where_it_is(void **state)
{
    (void)state;
    for (int k = 0; k < 5; k++) {
        const double heads[5][3] = { { 0, 0, 0 }, { 40, 0, 0 }, { -30, 25, 0 }, { 0, -35, 40 }, { 170, 20, -60 } };
        struct image truth, out;
        struct stitch *s;
        struct stitch_stop_report r;
        struct panorama_report whole;
        struct merged m;
        struct sim_camera c = fisheye(240, 85);
        double R[9], d[3], sum[3] = { 0 };
        c.yaw_deg = heads[k][0], c.pitch_deg = heads[k][1], c.roll_deg = heads[k][2];
        lens_head(R, c.yaw_deg * deg, c.pitch_deg * deg, c.roll_deg * deg);
        mat3_mul_vec(d, R, (double[3]){ .48, -.36, .8 });
        room(&truth, 1024, 0, d);
        look(&m, &truth, &c, 3);
        assert_int_equal(stitch_new(&s, 256), 0);
        add(s, &c, &m, &r);
        assert_int_equal(stitch_finish(&out, s, identity, &whole), 0);
        for (int y = 0; y < out.height; y++)
            for (int x = 0; x < out.width; x++) {
                double at[3];
                panorama_direction(out.width, out.height, x + .5, y + .5, at);
                vec3_add_scaled(sum, sum, (double)out.data[(y * out.width + x) * out.n_channels + 1] * panorama_solid_angle(out.width, out.height, y), at);
            }
        vec3_normalise(sum);
        assert_true(acos(fmin(vec3_dot(sum, d), 1)) < .1 * deg); // a pixel is .75 degrees
        image_free(&out);
        image_free(&truth);
        merged_free(&m);
        stitch_free(s);
    }
}

static void stops_join_without_a_seam_and_a_stop_in_the_wrong_place_shows(void **state)
{
    (void)state;
    struct image truth, out;
    assert_int_equal(sim_studio(&truth, 512), 0);
    for (int wrong = 0; wrong < 2; wrong++) {
        struct stitch *s;
        struct stitch_stop_report r = { 0 };
        struct panorama_report whole;
        double worst_ev = 0;
        assert_int_equal(stitch_new(&s, 128), 0);
        for (int i = 0; i < 3; i++) {
            struct merged m;
            struct sim_camera c = fisheye(200, 92);
            c.yaw_deg = 120 * i;
            look(&m, &truth, &c, 3);
            for (int k = 0; k < m.width * m.height; k++)
                m.variance[k] = 1e-8f;
            if (wrong)
                c.yaw_deg = i == 1 ? 240 : i == 2 ? 120 : 0; // the plan has the last two in another order
            add(s, &c, &m, &r);
            assert_true(i == 0 ? r.n_cells == 0 : r.n_cells > 1000);
            if (i) {
                worst_ev = fmax(worst_ev, r.seam_ev);
                if (!wrong)
                    assert_float_equal(r.seam_gain, 1, .02);
            }
            merged_free(&m);
        }
        assert_int_equal(stitch_finish(&out, s, identity, &whole), 0);
        if (getenv("VERBOSE"))
            fprintf(stderr, "%s: seam %.3f EV, uncovered %.4f sr\n", wrong ? "exchanged" : "in order", worst_ev, whole.uncovered_sr);
        assert_true(wrong ? worst_ev > .1 : worst_ev < .02);
        if (!wrong) {
            assert_true(whole.uncovered_sr < .05);
            double error[128 * 64];
            int n = 0;
            struct image small;
            assert_int_equal(sim_shrink(&small, &truth, 4), 0);
            for (int i = 0; i < 128 * 64; i++) {
                const float *p = out.data + (size_t)i * (size_t)out.n_channels;
                if (p[6] > .99f)
                    error[n++] = fabs((double)p[1] / (double)small.data[3 * i + 1] - 1);
            }
            int n_off = 0;
            for (int i = 0; i < n; i++)
                n_off += error[i] > .02;
            assert_true(n > 8000 && n_off < n / 10); // those at the borders of lamps and walls
            image_free(&small);
        }
        image_free(&out);
        stitch_free(s);
    }
    image_free(&truth);
}

// Sums that rest in a file, and pictures that are forgotten as they are put, change nothing; nor does a folder that takes no file.
static void resting_in_a_file_changes_no_byte(void **state)
{
    (void)state;
    static const char *const folders[] = { NULL, ".", "/nowhere/at/all" };
    const double lamp[3] = { .6, .64, .48 };
    struct sim_camera c = fisheye(700, 95);
    struct image truth, out[3];
    room(&truth, 256, 1, lamp);
    for (int k = 0; k < 3; k++) {
        struct stitch *s;
        struct stitch_stop_report r;
        struct panorama_report whole;
        assert_int_equal(stitch_new(&s, 256), 0);
        for (int stop = 0; stop < 2; stop++) {
            struct merged m;
            double R[9];
            c.yaw_deg = 180 * stop;
            if (folders[k])
                stitch_rest(s, folders[k]);
            look(&m, &truth, &c, 1);
            m.quality[350 * 700 + 350] = BRACKET_CLIPPED;
            lens_head(R, c.yaw_deg * deg, 0, 0);
            assert_int_equal(folders[k] ? stitch_add_last(s, &c.lens, R, &m, &r) : stitch_add(s, &c.lens, R, &m, &r), 0);
            merged_free(&m);
        }
        assert_int_equal(stitch_finish(out + k, s, identity, &whole), 0);
        stitch_free(s);
        assert_memory_equal(out[k].data, out[0].data, 256 * 128 * (size_t)out[0].n_channels * sizeof(float));
    }
    for (int k = 0; k < 3; k++)
        image_free(out + k);
    image_free(&truth);
}

static void a_clipped_light_is_declared_unless_another_stop_saw_it(void **state)
{
    (void)state;
    struct image truth, out;
    double d[3] = { .2, .3, 1 };
    vec3_normalise(d);
    room(&truth, 512, 1, d);
    const double cap = 2 * M_PI * (1 - cos(.05));
    for (int k = 0; k < 2; k++) {
        struct stitch *s;
        struct stitch_stop_report r;
        struct panorama_report whole;
        struct merged m;
        struct sim_camera c = fisheye(300, 85);
        look(&m, &truth, &c, 3);
        for (int i = 0; i < m.width * m.height; i++)
            if (m.radiance[i] > 100) {
                m.radiance[i] = 100;
                m.quality[i] = BRACKET_CLIPPED;
            }
        assert_int_equal(stitch_new(&s, 256), 0);
        add(s, &c, &m, &r);
        assert_true(r.clipped_sr > cap && r.clipped_sr < 1.6 * cap); // and the pixels whose colours come from a clipped neighbour
        merged_free(&m);
        if (k == 1) { // turned, and shot shorter
            c.yaw_deg = 25;
            look(&m, &truth, &c, 3);
            add(s, &c, &m, &r);
            assert_true(r.clipped_sr == 0);
            merged_free(&m);
        }
        assert_int_equal(stitch_finish(&out, s, identity, &whole), 0);
        if (k == 0) {
            assert_int_equal(whole.n_lights, 1);
            assert_int_equal(whole.n_listed, 1);
            const struct clipped_light *l = whole.light;
            assert_true(l->solid_angle_sr > cap && l->solid_angle_sr < 2.5 * cap); // whole texels
            assert_true(l->irradiance_at_least[1] > .9 * 100 * cap && l->irradiance_at_least[1] < 1000 * cap); // no more than there is
            assert_true(vec3_dot(l->dir_probe, d) > cos(1.5 * deg));
        } else {
            assert_int_equal(whole.n_lights, 0);
            double sum = 0;
            for (int i = 0; i < 256 * 128; i++)
                sum += (double)out.data[(size_t)i * (size_t)out.n_channels + 1] * panorama_solid_angle(256, 128, i / 256) * (out.data[(size_t)i * (size_t)out.n_channels + 1] > 2);
            assert_float_equal(sum / (1000 * cap), 1, .03); // from the stop that saw it
        }
        image_free(&out);
        stitch_free(s);
    }
    image_free(&truth);
}

static void the_variance_is_that_of_the_texels(void **state)
{
    (void)state;
    enum { RUNS = 40 };
    struct image truth;
    struct sim_camera c = fisheye(240, 60);
    room(&truth, 64, 1, NULL);
    static double sum[3][64 * 32], square[3][64 * 32], said[3][64 * 32];
    for (int run = 0; run < RUNS; run++) {
        struct stitch *s;
        struct stitch_stop_report r;
        struct panorama_report whole;
        struct merged m;
        struct image out;
        look(&m, &truth, &c, 1);
        for (int i = 0; i < m.width * m.height; i++)
            m.radiance[i] += (float)(.01 * random_normal(9, (uint64_t)run, (uint64_t)i));
        assert_int_equal(stitch_new(&s, 64), 0);
        add(s, &c, &m, &r);
        assert_int_equal(stitch_finish(&out, s, identity, &whole), 0);
        for (int i = 0; i < 64 * 32; i++)
            for (int k = 0; k < 3; k++) {
                const float *p = out.data + (size_t)i * (size_t)out.n_channels;
                if (p[6] < .99f)
                    continue;
                const double e = (double)p[k] - 1;
                sum[k][i] += e, square[k][i] += e * e, said[k][i] += (double)p[3 + k];
            }
        image_free(&out);
        merged_free(&m);
        stitch_free(s);
    }
    for (int k = 0; k < 3; k++) {
        double ratio = 0;
        int n = 0;
        for (int i = 0; i < 64 * 32; i++)
            if (said[k][i] > 0)
                ratio += square[k][i] / said[k][i], n++;
        if (getenv("VERBOSE"))
            fprintf(stderr, "texels of ~8 pixels: found / said variance %.3f (%d texels)\n", ratio / n, n);
        assert_true(n > 300);
        assert_true(ratio / n > .8 && ratio / n < 1.05);
    }
    image_free(&truth);
}

static void shading_is_taken_off_and_the_matrix_applied(void **state)
{
    (void)state;
    struct image truth, out;
    struct stitch *s;
    struct stitch_stop_report r;
    struct panorama_report whole;
    struct merged m;
    struct sim_camera c = fisheye(160, 80);
    room(&truth, 64, 2, NULL);
    c.lens.v[0] = -.3, c.lens.v[1] = .05;
    assert_int_equal(lens_init(&c.lens, "shading"), 0);
    look(&m, &truth, &c, 1);
    merged_unshade(&m, &c.lens);
    assert_int_equal(stitch_new(&s, 64), 0);
    add(s, &c, &m, &r);
    const double M[9] = { 2, 0, 0, 0, 1, -.5, 0, -2, 1 };
    assert_int_equal(stitch_finish(&out, s, M, &whole), 0);
    for (int i = 0; i < 64 * 32; i++) {
        const float *p = out.data + (size_t)i * (size_t)out.n_channels;
        if (p[6] < 1)
            continue;
        assert_float_equal((double)p[0], 4, 1e-4);
        assert_float_equal((double)p[1], 1, 1e-4);
        assert_true(p[2] == 0); // -2: light is not negative
        assert_float_equal((double)(p[3] / p[4]), 16. / 3, .1); // red and blue have half as many sites as green
    }
    stitch_free(s);
    image_free(&out);
    image_free(&truth);
    merged_free(&m);
    log_set_level(LOG_SILENT);
    c.lens.width_px = 162;
    look(&m, &(struct image){ .width = 64, .height = 32, .n_channels = 3, .data = (float[64 * 32 * 3]){ 0 } }, &c, 1);
    assert_int_equal(stitch_new(&s, 64), 0);
    c.lens.width_px = 160;
    assert_int_equal(stitch_add(s, &c.lens, identity, &m, &r), -EINVAL);
    log_set_level(LOG_INFO);
    stitch_free(s);
    merged_free(&m);
    assert_int_equal(stitch_new(&s, 65), -EINVAL);
}

static void a_plateau_of_a_stitched_panorama_is_suspected(void **state)
{
    (void)state;
    struct image p;
    struct panorama_report r;
    const double up[3] = { 0, .6, .8 };
    room(&p, 256, .1f, up);
    assert_int_equal(panorama_examine(&r, &p), 0);
    assert_int_equal(r.n_lights, 1);
    assert_true(vec3_dot(r.light[0].dir_probe, up) > cos(.01));
    assert_float_equal(r.light[0].irradiance_at_least[1], 1000 * 2 * M_PI * (1 - cos(.05)), 1);
    for (int i = 0; i < 256 * 128 * 3; i++)
        p.data[i] *= 1 + 1e-2f * (float)random_normal(3, 1, (uint64_t)i); // a light that has any structure
    assert_int_equal(panorama_examine(&r, &p), 0);
    assert_int_equal(r.n_lights, 0);
    image_free(&p);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_constant_room_comes_back_constant_and_its_solid_angles_add_up),
        cmocka_unit_test(flux_is_kept),
        cmocka_unit_test(a_lamp_lies_where_it_is),
        cmocka_unit_test(stops_join_without_a_seam_and_a_stop_in_the_wrong_place_shows),
        cmocka_unit_test(resting_in_a_file_changes_no_byte),
        cmocka_unit_test(a_clipped_light_is_declared_unless_another_stop_saw_it),
        cmocka_unit_test(the_variance_is_that_of_the_texels),
        cmocka_unit_test(shading_is_taken_off_and_the_matrix_applied),
        cmocka_unit_test(a_plateau_of_a_stitched_panorama_is_suspected),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
