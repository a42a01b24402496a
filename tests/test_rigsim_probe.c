// tests/test_rigsim_probe.c - what the simulated panorama camera sees is the panorama: every light where it is, with all its irradiance.
#include "tests/rigsim/probe.h"
#include "solver/panorama.h"
#include "solver/take/log.h"
#include "tests/rigsim/frame.h"
#include "tests/scratch.h"

#include <math.h>
#include <string.h>

enum { WIDTH = 256, HEIGHT = 128 };

static const char *const lenses[] = {
    "{\"model\": \"equisolid\", \"focal_px\": 106, \"circle_px\": 150, \"max_angle_deg\": 90}",
    "{\"model\": \"equidistant\", \"focal_px\": 96, \"circle_px\": 150, \"distortion\": [0.01, -0.003, 0, 0.0005, -0.0007]}",
    "{\"model\": \"stereographic\", \"focal_px\": 75, \"circle_px\": 150, \"max_angle_deg\": 90}",
    "{\"model\": \"rectilinear\", \"focal_px\": 300, \"distortion\": [-0.05, 0.01, 0, 0.001, 0.002], \"shading\": [-0.1, 0.01, 0]}",
};
enum { N_LENSES = sizeof(lenses) / sizeof(lenses[0]), SENSOR_W = 400, SENSOR_H = 300 };

// A dim sphere of its own colour in each half, and one texel that shines.
static void write_panorama(const char *name, int lamp_x, int lamp_y, const float lamp[3])
{
    struct image im;
    assert_int_equal(image_new(&im, WIDTH, HEIGHT, 3, NULL), 0);
    for (int y = 0; y < HEIGHT; y++)
        for (int x = 0; x < WIDTH; x++)
            for (int c = 0; c < 3; c++)
                im.data[((size_t)y * WIDTH + (size_t)x) * 3 + (size_t)c] = x == lamp_x && y == lamp_y ? lamp[c] : y < HEIGHT / 2 ? .01f : .02f;
    assert_int_equal(image_write_exr(&im, scratch_path(name), IMAGE_FLOAT, IMAGE_ZIP), 0);
    image_free(&im);
}

// Sum over the sites of each colour of (what they see - background) x the solid angle that they stand for.
static void sum_lamp(struct probe *p, const struct lens *lens, const struct scene_view *view, double sum[3], double centre_px[2])
{
    float row[SENSOR_W];
    double weight = 0;
    memset(sum, 0, 3 * sizeof(*sum));
    centre_px[0] = centre_px[1] = 0;
    for (int y = 0; y < lens->height_px; y++) {
        probe_row(p, view, y, row);
        for (int x = 0; x < lens->width_px; x++) {
            const double px[2] = { x + .5, y + .5 };
            const int c = (x & 1) + (y & 1);
            const double shading = lens_shading(lens, px), light = row[x] / fmax(shading, .01);
            if (!(light > .05))
                continue;
            sum[c] += light * lens_solid_angle(lens, px) * (c == 1 ? 2 : 4); // of four sites two are green
            centre_px[0] += light * px[0], centre_px[1] += light * px[1];
            weight += light;
        }
    }
    centre_px[0] /= weight, centre_px[1] /= weight;
}

static void a_lamp_keeps_its_irradiance_and_its_place_however_small(void **state)
{
    (void)state;
    static const float lamp[3] = { 3000, 2000, 1000 };
    static const struct scene_view views[] = { { 0, 0, 1 }, { 117.5, -12, 1 }, { -75, 35, 1 } };
    static const int offsets[][2] = { { 0, 0 }, { 13, 5 }, { -20, -9 }, { 1, 14 } };
    for (int l = 0; l < N_LENSES; l++)
        for (int v = 0; v < 3; v++)
            for (int o = 0; o < 4; o++) {
                struct lens lens;
                struct probe *p;
                double R[9], sum[3], at[2], dir[3], in_camera[3], expected_px[2], x, y;
                assert_int_equal(probe_lens(&lens, lenses[l], SENSOR_W, SENSOR_H), 0);
                lens_head(R, views[v].yaw_deg * M_PI / 180, views[v].pitch_deg * M_PI / 180, 0);
                panorama_pixel(WIDTH, HEIGHT, (const double[3]){ R[2], R[5], R[8] }, &x, &y); // where it looks
                const int column = ((int)x + offsets[o][0] / (l == 3 ? 2 : 1) + WIDTH) % WIDTH, line = (int)y + offsets[o][1] / (l == 3 ? 2 : 1);
                write_panorama("p.exr", column, line, lamp);
                assert_int_equal(probe_open(&p, scratch_path("p.exr"), lenses[l], 1, SENSOR_W, SENSOR_H), 0);
                sum_lamp(p, &lens, &views[v], sum, at);
                const double sr = panorama_solid_angle(WIDTH, HEIGHT, line);
                for (int c = 0; c < 3; c++)
                    if (fabs(sum[c] / (sr * (double)lamp[c]) - 1) > .002)
                        fail_msg("lens %d view %d lamp %d colour %d: %.5f of its irradiance", l, v, o, c, sum[c] / (sr * (double)lamp[c]));
                panorama_direction(WIDTH, HEIGHT, column + .5, line + .5, dir);
                for (int k = 0; k < 3; k++)
                    in_camera[k] = R[k] * dir[0] + R[3 + k] * dir[1] + R[6 + k] * dir[2];
                assert_true(lens_project(&lens, in_camera, expected_px));
                assert_true(hypot(at[0] - expected_px[0], at[1] - expected_px[1]) < .3);
                probe_close(p);
            }
}

static void the_head_turns_left_and_up(void **state)
{
    (void)state;
    static const float lamp[3] = { 1000, 1000, 1000 };
    struct probe *p;
    struct lens lens;
    double sum[3], at[2];
    assert_int_equal(probe_lens(&lens, lenses[0], SENSOR_W, SENSOR_H), 0);
    write_panorama("p.exr", WIDTH / 2 - WIDTH / 4, HEIGHT / 2 - HEIGHT / 8, lamp); // 90 degrees to the left, 22.5 up
    assert_int_equal(probe_open(&p, scratch_path("p.exr"), lenses[0], 1, SENSOR_W, SENSOR_H), 0);
    sum_lamp(p, &lens, &(struct scene_view){ 90, 22.5, 1 }, sum, at);
    assert_true(hypot(at[0] - SENSOR_W / 2, at[1] - SENSOR_H / 2) < 3);
    sum_lamp(p, &lens, &(struct scene_view){ 60, 0, 1 }, sum, at); // now it is left of the middle and above it
    assert_true(at[0] < SENSOR_W / 2 - 30 && at[1] < SENSOR_H / 2 - 20);
    probe_close(p);
}

static void rows_do_not_depend_on_the_order_in_which_they_are_read(void **state)
{
    (void)state;
    static const float lamp[3] = { 100, 100, 100 };
    float a[SENSOR_W], b[SENSOR_W];
    struct probe *p, *q;
    const struct scene_view view = { 33, 5, 1 }, other = { 34, 5, 1 };
    write_panorama("p.exr", 100, 60, lamp);
    assert_int_equal(probe_open(&p, scratch_path("p.exr"), lenses[1], 1, SENSOR_W, SENSOR_H), 0);
    assert_int_equal(probe_open(&q, scratch_path("p.exr"), lenses[1], 1, SENSOR_W, SENSOR_H), 0);
    for (int y = 0; y < SENSOR_H; y++) {
        const int back = SENSOR_H - 1 - y;
        probe_row(p, &view, back, a);
        for (int k = 0; k <= back; k += back ? back : 1) // and something else in between
            probe_row(q, &other, k, b);
        probe_row(q, &view, back, b);
        assert_memory_equal(a, b, sizeof(a));
    }
    probe_close(p);
    probe_close(q);
}

// Only what is bright flickers, and by as much as it is told to.
static void lamps_flicker(void **state)
{
    (void)state;
    static const float lamp[3] = { 500, 500, 500 };
    struct probe *p;
    struct lens lens;
    double steady[3], bright[3], at[2];
    float dark_a[SENSOR_W], dark_b[SENSOR_W];
    assert_int_equal(probe_lens(&lens, lenses[0], SENSOR_W, SENSOR_H), 0);
    write_panorama("p.exr", WIDTH / 2, HEIGHT / 2 - 3, lamp);
    assert_int_equal(probe_open(&p, scratch_path("p.exr"), lenses[0], 1, SENSOR_W, SENSOR_H), 0);
    sum_lamp(p, &lens, &(struct scene_view){ 0, 0, 1 }, steady, at);
    sum_lamp(p, &lens, &(struct scene_view){ 0, 0, 1.1 }, bright, at);
    for (int c = 0; c < 3; c++)
        assert_true(fabs(bright[c] / steady[c] - 1.1) < .005);
    probe_row(p, &(struct scene_view){ 0, 0, 1 }, 280, dark_a);
    probe_row(p, &(struct scene_view){ 0, 0, 1.1 }, 280, dark_b);
    assert_memory_equal(dark_a, dark_b, sizeof(dark_a));
    probe_close(p);
}

static const char *any_name(unsigned camera)
{
    return camera ? "B" : "A";
}

static void a_panorama_camera_has_a_sensor_of_its_own_size(void **state)
{
    (void)state;
    static const float lamp[3] = { 100, 100, 100 };
    static struct personality personality;
    enum { W = 64, H = 48 };
    struct scene *scene;
    struct probe *p;
    uint64_t bytes[2];
    write_panorama("p.exr", 100, 60, lamp);
    assert_int_equal(personality_load(&personality, "nikon"), 0);
    assert_int_equal(scene_open(&scene, NULL, W, H, 2, any_name), 0);
    assert_int_equal(probe_open(&p, scratch_path("p.exr"), lenses[0], 1, SENSOR_W, SENSOR_H), 0);
    scene_give(scene, 1, p);
    for (unsigned i = 0; i < 2; i++) {
        const struct exposure e = { .shot = 1, .time_s = personality.t_ref_s, .f_number = personality.n_ref, .iso = 100, .view = { 0, 0, 1 } };
        const uint64_t sites = i ? SENSOR_W * SENSOR_H : W * H;
        struct body b;
        struct frame *f;
        uint8_t row[SENSOR_W * 2];
        assert_int_equal(body_init(&b, &personality, i, 1, 0, 0), 0);
        assert_int_equal(frame_open(&f, scene, &b, &e, FILES_RAW), 0);
        bytes[i] = frame_size(f);
        assert_true(bytes[i] > 2 * sites && bytes[i] < 2 * sites + 20000);
        for (uint64_t at = 0; at < bytes[i]; at += sizeof(row))
            frame_read(f, at, row, bytes[i] - at < sizeof(row) ? (size_t)(bytes[i] - at) : sizeof(row));
        frame_close(f);
        body_free(&b);
    }
    scene_close(scene);
}

int main(void)
{
    log_set_level(LOG_WARNING);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_lamp_keeps_its_irradiance_and_its_place_however_small),
        cmocka_unit_test(the_head_turns_left_and_up),
        cmocka_unit_test(rows_do_not_depend_on_the_order_in_which_they_are_read),
        cmocka_unit_test(lamps_flicker),
        cmocka_unit_test(a_panorama_camera_has_a_sensor_of_its_own_size),
    };
    if (scratch_open())
        return 1;
    const int failed = cmocka_run_group_tests(tests, NULL, NULL);
    scratch_close();
    return failed;
}
