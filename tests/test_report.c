// tests/test_report.c - the page about a solve: whole, self-contained, escaped, and its pictures are those it was given.
#include "solver/report.h"
#include "solver/disney.h"
#include "solver/shapes.h"
#include "solver/take/atomic_file.h"
#include "solver/take/image_formats.h"
#include "solver/take/log.h"
#include "tests/scratch.h"

#include <errno.h>
#include <math.h>
#include <string.h>

static struct json *parse(const char *text)
{
    struct json *doc;
    assert_int_equal(json_parse(&doc, text, strlen(text), "test"), 0);
    return doc;
}

static char *page_of(const struct report_source *source)
{
    char *text;
    size_t n;
    assert_int_equal(report_write(source, scratch_path("page.html")), 0);
    assert_int_equal(file_read(&text, &n, scratch_path("page.html"), 1 << 26), 0);
    assert_int_equal(strlen(text), n);
    scratch_empty();
    return text;
}

static int count(const char *text, const char *what)
{
    int n = 0;
    for (const char *p = text; (p = strstr(p, what)); p++)
        n++;
    return n;
}

static void fill(struct image *image, int width, int height, int n_channels, float value)
{
    assert_int_equal(image_new(image, width, height, n_channels, NULL), 0);
    for (int i = 0; i < width * height * n_channels; i++)
        image->data[i] = value;
}

// Everything at once, with names that try to be markup.
static void the_page_needs_nothing_but_itself_and_escapes_what_it_is_told(void **unused)
{
    static const double centre_m[3] = { 0, 0, 0 };
    (void)unused;
    struct json *report = parse("{\"trusted\": false, \"warnings\": [\"the <b>mirrored</b> & odd\"], \"rmse_fit_percent\": 1.5,"
                                "\"rmse_held_out_percent\": 3, \"brdf\": \"disney\", \"method\": \"<script>alert(1)</script>\","
                                "\"theta\": {\"metallic\": 0.25}, \"theta_std\": {\"metallic\": 0.125},"
                                "\"stages\": {\"joint\": {\"wall_s\": 12.5}}}");
    struct mesh mesh;
    struct image albedo, theta;
    struct lights lights;
    struct camera camera = { .name = "a\"><i>", .width_px = 32, .height_px = 24, .fx = 30, .fy = 30, .cx = 16, .cy = 12 };
    const double from_m[3] = { 2, 0, 1 }, up[3] = { 0, 0, 1 };
    camera_look_at(&camera, from_m, centre_m, up);
    const struct cameras cameras = { .n = 1, .view = &camera };
    struct report_view view = { .name = camera.name };
    fill(&view.input, 32, 24, 3, .25f), fill(&view.render, 32, 24, 4, 1);
    fill(&albedo, 16, 16, 3, .5f);
    assert_int_equal(image_new(&theta, 16, 16, DISNEY_N, disney_parameter_names), 0);
    theta.data[DISNEY_ROUGHNESS] = .5f;
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, centre_m, .4, 200), 0);
    assert_int_equal(lights_new(&lights, 3), 0);
    for (int i = 0; i < 3; i++)
        lights.dir_probe[i][i] = lights.irradiance[i][i] = 1;
    lights.inverse_distance[0] = .5;
    const struct report_source source = { .title = "a & <b>", .report = report, .mesh = &mesh, .albedo = &albedo, .parameters = &theta,
                                          .lights = &lights, .cameras = &cameras, .view = &view, .n_views = 1 };
    char *page = page_of(&source);
    assert_null(strstr(page, "<script"));
    assert_null(strstr(page, "<b>mirrored"));
    assert_null(strstr(page, "<i>\""));
    assert_null(strstr(page, "http"));
    assert_null(strstr(page, "@import"));
    assert_null(strstr(page, "url("));
    assert_int_equal(count(page, "src="), count(page, "src=\"data:image/png;base64,"));
    assert_non_null(strstr(page, "the &lt;b&gt;mirrored&lt;/b&gt; &amp; odd"));
    assert_non_null(strstr(page, "&lt;script&gt;"));
    assert_non_null(strstr(page, "a&quot;&gt;&lt;i&gt;"));
    assert_non_null(strstr(page, "not to be trusted"));
    assert_non_null(strstr(page, "2.0 times worse")); // set aside against fitted
    assert_non_null(strstr(page, "0.250 &plusmn; 0.125"));
    assert_non_null(strstr(page, "12.5 s"));
    assert_int_equal(count(page, "<svg"), 2);
    assert_int_equal(count(page, "fill=\"#ff0000\""), 2); // the red light, in both drawings
    assert_int_equal(count(page, "class=\"object\" points"), 2);
    assert_int_equal(count(page, "<img"), 3 + 2); // photograph, render, difference; albedo, roughness
    static const char *const pairs[] = { "figure", "table", "svg", "div", "ul", "tr", "td", "figcaption", "h2", "p" };
    for (size_t i = 0; i < sizeof(pairs) / sizeof(pairs[0]); i++) {
        char open[16], open_class[16], close[16];
        snprintf(open, sizeof(open), "<%s>", pairs[i]), snprintf(open_class, sizeof(open_class), "<%s ", pairs[i]);
        snprintf(close, sizeof(close), "</%s>", pairs[i]);
        assert_int_equal(count(page, open) + count(page, open_class), count(page, close));
    }
    free(page);
    image_free(&view.input), image_free(&view.render), image_free(&albedo), image_free(&theta);
    lights_free(&lights);
    mesh_free(&mesh);
    json_free(report);
}

static int digit(char c)
{
    static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    return (int)(strchr(digits, c) - digits);
}

// The n-th picture of the page, decoded here.
static void picture_of(struct image *out, const char *page, int nth)
{
    static const char begin[] = "base64,";
    const char *p = page;
    for (int i = 0; i <= nth; i++) {
        p = strstr(p, begin);
        assert_non_null(p);
        p += strlen(begin);
    }
    const size_t n = (size_t)(strchr(p, '"') - p);
    assert_int_equal(n % 4, 0);
    uint8_t *bytes = malloc(n / 4 * 3);
    size_t k = 0;
    assert_non_null(bytes);
    for (size_t i = 0; i < n; i += 4) {
        uint32_t v = 0;
        int padding = 0;
        for (int j = 0; j < 4; j++) {
            padding += p[i + (size_t)j] == '=';
            v = v << 6 | (p[i + (size_t)j] == '=' ? 0 : (uint32_t)digit(p[i + (size_t)j]));
        }
        for (int j = 0; j < 3 - padding; j++)
            bytes[k++] = v >> (16 - 8 * j) & 255;
    }
    const struct image_file file = { bytes, k, "page" };
    assert_int_equal(image_read_memory(out, &file), 0);
    free(bytes);
}

// A render that is too bright on the left, and no object on the right: lighter than grey, and grey.
static void the_difference_is_shown_where_the_object_is(void **unused)
{
    (void)unused;
    struct report_view view = { .name = "v" };
    struct image photograph, difference;
    fill(&view.input, 7, 5, 3, .5f), fill(&view.render, 7, 5, 4, .55f);
    for (int i = 0; i < 35; i++)
        view.render.data[4 * i + 3] = i % 7 < 3;
    const struct report_source source = { .title = "t", .view = &view, .n_views = 1 };
    char *page = page_of(&source);
    picture_of(&photograph, page, 0);
    picture_of(&difference, page, 2);
    assert_int_equal(photograph.width, 7);
    assert_int_equal(photograph.height, 5);
    // Shown .85 / .55 as bright: .5 -> .7727 linear -> sRGB
    assert_true(fabsf(photograph.data[0] - (1.055f * powf(.5f * .85f / .55f, 1 / 2.4f) - .055f)) < 1.f / 255);
    assert_true(fabsf(difference.data[0] - (.5f + 4 * .85f / .55f * .05f)) < 1.f / 255);
    assert_true(fabsf(difference.data[3 * 6] - .5f) < 1.f / 255);
    assert_non_null(strstr(page, "RMSE 5.00 %"));
    free(page);
    image_free(&photograph), image_free(&difference), image_free(&view.input), image_free(&view.render);
}

static void a_view_that_was_set_aside_is_named_so(void **unused)
{
    (void)unused;
    struct json *report = parse("{\"views_held_out\": [\"cam1\"]}");
    struct report_view view[2] = { { .name = "cam0" }, { .name = "cam1" } };
    for (int i = 0; i < 2; i++)
        fill(&view[i].input, 4, 3, 3, .5f), fill(&view[i].render, 4, 3, 4, 1);
    const struct report_source source = { .title = "t", .report = report, .view = view, .n_views = 2 };
    char *page = page_of(&source);
    assert_non_null(strstr(page, "<h3>cam0</h3>"));
    assert_non_null(strstr(page, "<h3>cam1 <small>(set aside"));
    free(page);
    for (int i = 0; i < 2; i++)
        image_free(&view[i].input), image_free(&view[i].render);
    json_free(report);
}

static void every_region_says_which_parameters_are_free(void **unused)
{
    (void)unused;
    struct json *report = parse("{\"brdf\": \"disney\", \"trusted\": true, \"stages\": {\"materials\": {\"n_texels\": 100, \"n_unobserved\": 20, \"regions\": ["
                                "{\"id\": 0, \"n_texels\": 60, \"theta\": {\"roughness\": 0.5}, \"theta_std\": {\"roughness\": 0.01}, \"model\": {\"roughness\": \"free\"}},"
                                "{\"id\": 1, \"n_texels\": 40, \"theta\": {\"roughness\": 0.25}, \"theta_std\": {\"roughness\": 0.2}, \"model\": {\"roughness\": \"frozen\"}}]}}}");
    const struct report_source source = { .title = "t", .report = report };
    char *page = page_of(&source);
    assert_non_null(strstr(page, "0.500 &plusmn; 0.010 <small>free</small>"));
    assert_non_null(strstr(page, "0.250 &plusmn; 0.200 <small>frozen</small>"));
    assert_non_null(strstr(page, "2 regions"));
    assert_non_null(strstr(page, "20 % of the surface was seen by no camera"));
    assert_non_null(strstr(page, "can be used"));
    free(page);
    json_free(report);
}

static void a_page_with_nothing_to_say_is_still_a_page(void **unused)
{
    (void)unused;
    const struct report_source source = { .title = "empty" };
    char *page = page_of(&source);
    assert_non_null(strstr(page, "</html>"));
    assert_null(strstr(page, "nan"));
    assert_null(strstr(page, "<img"));
    free(page);
}

static void shrinking_keeps_the_mean_whatever_the_factor(void **unused)
{
    (void)unused;
    struct image from, to;
    assert_int_equal(image_new(&from, 13, 11, 2, (const char *const[]){ "a", "b" }), 0);
    double mean[2] = { 0 };
    for (int i = 0; i < 13 * 11; i++)
        for (int c = 0; c < 2; c++) {
            from.data[2 * i + c] = (float)((i * (7 + c)) % 23);
            mean[c] += (double)from.data[2 * i + c] / (13 * 11);
        }
    static const int sizes[][2] = { { 5, 3 }, { 13, 11 }, { 1, 1 }, { 12, 10 } };
    for (int s = 0; s < 4; s++) {
        const int width = sizes[s][0], height = sizes[s][1];
        double sum[2] = { 0 };
        assert_int_equal(report_shrink(&to, &from, width, height), 0);
        for (int i = 0; i < width * height; i++)
            for (int c = 0; c < 2; c++)
                sum[c] += (double)to.data[2 * i + c] / (width * height);
        for (int c = 0; c < 2; c++)
            assert_true(fabs(sum[c] - mean[c]) < 1e-4);
        assert_string_equal(to.names[1], "b");
        image_free(&to);
    }
    image_free(&from);
}

// The whole chain's pictures: finer than what the cameras were calibrated with, and with a channel that says what clipped.
static void a_picture_of_another_size_than_its_camera_is_shown_by_the_names_of_its_channels(void **unused)
{
    (void)unused;
    static const double centre_m[3] = { 0, 0, 3 }, origin[3] = { 0 }, up[3] = { 0, 1, 0 }, off_axis_m[3] = { .4, -.2, 0 };
    const struct { int width, height, camera_width, camera_height; } sizes[] = { { 720, 480, 360, 240 }, { 1201, 801, 360, 240 }, { 90, 60, 360, 240 }, { 360, 240, 360, 240 } };
    struct camera camera = { .model = CAMERA_BROWN, .name = "cam0" }, small;
    struct image picture, shown;
    for (size_t s = 0; s < sizeof(sizes) / sizeof(sizes[0]); s++) {
        const int width = sizes[s].width, height = sizes[s].height;
        camera.width_px = sizes[s].camera_width, camera.height_px = sizes[s].camera_height;
        camera.fx = camera.fy = 1.2 * camera.width_px, camera.cx = camera.width_px / 2., camera.cy = camera.height_px / 2.;
        camera_look_at(&camera, centre_m, origin, up);
        assert_int_equal(image_new(&picture, width, height, 4, (const char *const[]){ "B", "clip", "R", "G" }), 0);
        for (int i = 0; i < width * height; i++) {
            const double x = (i % width + .5) / width, y = (i / width + .5) / height;
            picture.data[4 * i] = .25f, picture.data[4 * i + 1] = 1, picture.data[4 * i + 2] = (float)x, picture.data[4 * i + 3] = (float)y;
        }
        assert_int_equal(report_photograph(&shown, &small, &picture, &camera), 0);
        assert_true(shown.n_channels == 3 && shown.width == small.width_px && shown.height == small.height_px);
        assert_int_equal(shown.width, width < REPORT_PICTURE_PX ? width : REPORT_PICTURE_PX);
        double at[2], there[2], depth_m;
        assert_true(camera_project(&camera, off_axis_m, at, &depth_m));
        assert_true(camera_project(&small, off_axis_m, there, &depth_m));
        for (int i = 0; i < shown.width * shown.height; i++) {
            const float *p = shown.data + 3 * i;
            assert_true(fabs((double)p[0] - (i % shown.width + .5) / shown.width) < 1e-3 && fabs((double)p[1] - (i / shown.width + .5) / shown.height) < 1e-3 && p[2] == .25f);
        }
        assert_true(fabs(at[0] / camera.width_px - there[0] / small.width_px) < 1e-9 && fabs(at[1] / camera.height_px - there[1] / small.height_px) < 1e-9);
        image_free(&picture), image_free(&shown);
    }
    fill(&picture, 240, 360, 3, 1); // turned
    assert_int_equal(report_photograph(&shown, &small, &picture, &camera), -EINVAL);
    image_free(&picture);
    assert_int_equal(image_new(&picture, 360, 240, 3, (const char *const[]){ "R", "G", "clip" }), 0);
    assert_int_equal(report_photograph(&shown, &small, &picture, &camera), -EINVAL);
    assert_null(shown.data);
    image_free(&picture);
}

static int set_up(void **unused)
{
    (void)unused;
    log_set_level(LOG_SILENT);
    return scratch_open();
}

static int tear_down(void **unused)
{
    (void)unused;
    return scratch_close();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(the_page_needs_nothing_but_itself_and_escapes_what_it_is_told),
        cmocka_unit_test(the_difference_is_shown_where_the_object_is),
        cmocka_unit_test(a_view_that_was_set_aside_is_named_so),
        cmocka_unit_test(every_region_says_which_parameters_are_free),
        cmocka_unit_test(a_page_with_nothing_to_say_is_still_a_page),
        cmocka_unit_test(shrinking_keeps_the_mean_whatever_the_factor),
        cmocka_unit_test(a_picture_of_another_size_than_its_camera_is_shown_by_the_names_of_its_channels),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
