// tests/test_rigd_panorama.c - build/bin/rigd-panorama on simulated raws: right radiance, and every mishap named.
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "tests/panorama_camera.h"
#include "tests/raw_files.h"

#include <errno.h>
#include <fcntl.h>
#include <sys/inotify.h>
#include <sys/stat.h>
#include <sys/wait.h>

enum { STOPS = 3, FRAMES = 9, SIZE = 240, WIDTH = 128 };
static const double label_s[FRAMES] = { 8, 2, .5, 1. / 8, 1. / 30, 1. / 125, 1. / 500, 1. / 2000, 1. / 2000 };
static const double true_s[FRAMES] = { 8, 2, .5, 1. / 8, 1. / 32, 1. / 128, 1. / 512, 1. / 2048, 1. / 2048 };
enum { START = 1700000000 };

// What is simulated has the unit y / h of bracket.h; files have that of developed frames.
static const double unit = DEVELOP_TIME_S * DEVELOP_ISO / 100 / (DEVELOP_F_NUMBER * DEVELOP_F_NUMBER);
static struct sim_camera camera;
static struct image truth;
static float *seen[STOPS];
static struct json *report;

// What is different from a plan without fault.
struct mishap {
    int stop, frame; // of the frame that is shot anew; -1: none
    double light;    // times this
    const char *serial;
    double f_number;
    int64_t late_s;
    int first_frame, n_frames, left_out; // of each stop's; n_frames 0: all; left_out -1: none
    int missing_stop;             // its files are gone; -1: none
    int exchanged_a, exchanged_b; // exposure_s of these two frames of stop 1 are exchanged in the plan; -1: none
    bool exchanged_stops;         // stop 1 names the files of stop 2, and the other way round
    double exposure_s;            // of that frame in the plan
    double clip;
};
static const struct mishap none = { .stop = -1, .frame = -1, .light = 1, .serial = "1", .left_out = -1, .missing_stop = -1, .exchanged_a = -1, .exchanged_b = -1 };

static void shoot(int stop, int frame, const struct mishap *m)
{
    char name[64];
    struct raw_frame f;
    struct sim_camera c = camera;
    const bool is_it = stop == m->stop && frame == m->frame;
    if (is_it && m->f_number > 0)
        c.f_number = m->f_number;
    c.clip = m->clip;
    assert_int_equal(sim_expose(&f, seen[stop], &c, true_s[frame], is_it ? m->light : 1, (uint64_t)(stop * FRAMES + frame)), 0);
    snprintf(name, sizeof(name), "s%d_%d.dng", stop, frame);
    assert_int_equal(sim_write_dng(&f, &c, scratch_path(name), label_s[frame], is_it ? m->serial : "1",
                                   (START + (int64_t)(stop * 100 + frame * 10) + (is_it ? m->late_s : 0)) * 1000000000), 0);
    free(f.site);
}

static void write_plan(const struct mishap *m)
{
    FILE *f = fopen(scratch_path("plan.json"), "w");
    assert_non_null(f);
    fprintf(f, "{\"lens\": {\"model\": \"equisolid\", \"width_px\": %d, \"height_px\": %d, \"focal_px\": %.17g, \"max_angle_deg\": 92, \"centre_px\": [%.17g, %.17g]},\n",
            SIZE, SIZE, camera.lens.focal_px, camera.lens.centre_px[0], camera.lens.centre_px[1]);
    fprintf(f, " \"nodal_offset_m\": 0.003, \"colour\": {\"gains\": [1, 1, 1], \"scale\": 1}, \"srgb_from_camera\": [1, 0, 0, 0, 1, 0, 0, 0, 1],\n \"stops\": [");
    for (int s = 0; s < STOPS; s++) {
        bool is_first = true;
        fprintf(f, "%s\n  {\"name\": \"s%d\", \"yaw_deg\": %d, \"frames\": [", s ? "," : "", s, 120 * s);
        const int from = m->exchanged_stops && s ? 3 - s : s;
        for (int k = m->first_frame; k < (m->n_frames ? m->n_frames : FRAMES); k++) {
            if (k == m->left_out)
                continue;
            fprintf(f, "%s{\"file\": \"s%d_%d.dng\"", is_first ? "" : ", ", from, k);
            if (s == 1 && (k == m->exchanged_a || k == m->exchanged_b))
                fprintf(f, ", \"exposure_s\": %.17g", true_s[k == m->exchanged_a ? m->exchanged_b : m->exchanged_a]);
            if (s == m->stop && k == m->frame && m->exposure_s > 0)
                fprintf(f, ", \"exposure_s\": %.17g", m->exposure_s);
            fprintf(f, "}");
            is_first = false;
        }
        fprintf(f, "]}");
    }
    fprintf(f, "\n]}\n");
    fclose(f);
}

static int run(const char *input, const char *options)
{
    char command[3000];
    const char *bin = getenv("BIN");
    snprintf(command, sizeof(command), "%s/rigd-panorama '%s' -o '%s' %s >'%s' 2>&1", bin ? bin : "build/bin", scratch_path(input), scratch_path("panorama.exr"), options,
             scratch_path("log"));
    unlink(scratch_path("panorama.exr"));
    unlink(scratch_path("panorama-report.json"));
    const int status = system(command);
    assert_true(WIFEXITED(status));
    json_free(report);
    report = NULL;
    if (access(scratch_path("panorama-report.json"), R_OK) == 0)
        assert_int_equal(json_read(&report, scratch_path("panorama-report.json")), 0);
    return WEXITSTATUS(status);
}

static int run_with(const struct mishap *m)
{
    if (m->stop >= 0)
        shoot(m->stop, m->frame, m);
    write_plan(m);
    for (int k = 0; m->missing_stop >= 0 && k < FRAMES; k++) {
        char from[64], to[64];
        snprintf(from, sizeof(from), "s%d_%d.dng", m->missing_stop, k);
        snprintf(to, sizeof(to), "gone%d", k);
        assert_int_equal(rename(scratch_path(from), scratch_path(to)), 0);
    }
    const int code = run("plan.json", "--size 128");
    for (int k = 0; m->missing_stop >= 0 && k < FRAMES; k++) {
        char from[64], to[64];
        snprintf(from, sizeof(from), "s%d_%d.dng", m->missing_stop, k);
        snprintf(to, sizeof(to), "gone%d", k);
        assert_int_equal(rename(scratch_path(to), scratch_path(from)), 0);
    }
    if (m->stop >= 0)
        shoot(m->stop, m->frame, &none);
    return code;
}

// How many findings of a kind (of a stop and file, as far as given).
// NULL: any.
static int found(const char *kind, const char *stop, const char *file)
{
    int n = 0;
    for (int i = 0; i < json_length(report, "findings"); i++) {
        char key[64];
        const char *k = "", *s = "", *f = "";
        snprintf(key, sizeof(key), "findings.%d", i);
        const struct json *v = json_get(report, key);
        json_get_string(v, "kind", &k);
        json_get_string(v, "stop", &s);
        json_get_string(v, "file", &f);
        n += (!kind || !strcmp(k, kind)) && (!stop || !strcmp(s, stop)) && (!file || strstr(f, file));
    }
    return n;
}

static void show(const char *what)
{
    if (!getenv("VERBOSE"))
        return;
    fprintf(stderr, "%s:\n", what);
    for (int i = 0; i < json_length(report, "findings"); i++) {
        char key[64];
        const char *k = "", *t = "", *f = "";
        snprintf(key, sizeof(key), "findings.%d", i);
        json_get_string(json_get(report, key), "kind", &k);
        json_get_string(json_get(report, key), "text", &t);
        json_get_string(json_get(report, key), "file", &f);
        fprintf(stderr, "  %s (%s): %s\n", k, strrchr(f, '/') ? strrchr(f, '/') + 1 : f, t);
    }
}

static int compare(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// Median relative error of green over texels of SNR > 10.
static double median_error(const struct image *p)
{
    static double error[WIDTH * WIDTH / 2];
    struct image small;
    int n = 0;
    const int coverage = image_channel(p, "coverage"), variance = image_channel(p, "variance.G");
    assert_true(coverage >= 0 && variance >= 0);
    assert_int_equal(sim_shrink(&small, &truth, truth.width / WIDTH), 0);
    for (int i = 0; i < WIDTH * WIDTH / 2; i++) {
        const float *v = p->data + (size_t)i * (size_t)p->n_channels;
        if (v[coverage] > .99f && v[1] > 10 * sqrtf(v[variance]))
            error[n++] = fabs((double)v[1] / (unit * (double)small.data[3 * i + 1]) - 1);
    }
    image_free(&small);
    assert_true(n > WIDTH * WIDTH / 2 * 9 / 10);
    qsort(error, (size_t)n, sizeof(*error), compare);
    return error[n / 2];
}

static double total_error(const struct image *p)
{
    double ours = 0, real[3];
    panorama_total(&(struct panorama){ truth }, real);
    for (int i = 0; i < WIDTH * WIDTH / 2; i++)
        ours += (double)p->data[(size_t)i * (size_t)p->n_channels + 1] * panorama_solid_angle(WIDTH, WIDTH / 2, i / WIDTH);
    return ours / (unit * real[1]) - 1;
}

static void a_plan_without_fault_gives_the_radiance_and_no_doubt(void **state)
{
    (void)state;
    struct image p;
    double x;
    bool trusted = false;
    assert_int_equal(run_with(&none), 0);
    show("none");
    assert_int_equal(image_read(&p, scratch_path("panorama.exr")), 0);
    assert_true(p.width == WIDTH && p.height == WIDTH / 2 && p.n_channels == 8);
    if (getenv("VERBOSE"))
        fprintf(stderr, "median error %.4f, total %+.4f\n", median_error(&p), total_error(&p));
    assert_true(median_error(&p) < .005);
    assert_true(fabs(total_error(&p)) < .02); // lamps of a few photosites a colour
    image_free(&p);
    assert_int_equal(json_get_bool(report, "trusted", &trusted), 0);
    assert_true(trusted);
    assert_int_equal(json_length(report, "findings"), 0);
    assert_int_equal(json_get_number(report, "electrons_at_white", &x), 0);
    assert_float_equal(x / camera.electrons_at_white, 1, .1);
    assert_int_equal(json_get_number(report, "nodal_offset_m", &x), 0);
    assert_true(x == .003);
}

// Developed alone, a frame of the first stop shows what the panorama shows there.
static void a_frame_and_the_panorama_share_a_unit(void **state)
{
    (void)state;
    struct image p, frame;
    char command[3000];
    const char *bin = getenv("BIN");
    static double ratio[SIZE * SIZE];
    int n = 0;
    assert_int_equal(run_with(&none), 0);
    // 8 s: white is 1e-3, and half floats have steps of 6e-8
    snprintf(command, sizeof(command), "%s/rigd-develop --bilinear '%s' '%s' >'%s' 2>&1", bin ? bin : "build/bin", scratch_path("s0_0.dng"), scratch_path("frame.exr"), scratch_path("log"));
    assert_int_equal(system(command), 0);
    assert_int_equal(image_read(&p, scratch_path("panorama.exr")), 0);
    assert_int_equal(image_read(&frame, scratch_path("frame.exr")), 0);
    assert_true(frame.width == SIZE && frame.height == SIZE);
    for (int y = 0; y < SIZE; y++)
        for (int x = 0; x < SIZE; x++) {
            const float *v = frame.data + ((size_t)y * SIZE + (size_t)x) * (size_t)frame.n_channels;
            const double px[2] = { x + .5, y + .5 };
            double d[3], R[9], probe[3], u, w;
            if (!lens_ray(&camera.lens, px, d) || v[1] < 1e-5f || v[1] > 8e-4f)
                continue;
            lens_head(R, 0, 0, 0);
            mat3_mul_vec(probe, R, d);
            panorama_pixel(p.width, p.height, probe, &u, &w);
            ratio[n++] = (double)p.data[((size_t)fmin(w, p.height - 1) * (size_t)p.width + (size_t)u) * (size_t)p.n_channels + 1] / (double)v[1];
        }
    assert_true(n > 1000);
    qsort(ratio, (size_t)n, sizeof(*ratio), compare);
    if (getenv("VERBOSE"))
        fprintf(stderr, "panorama over frame: median %.4f of %d pixels\n", ratio[n / 2], n);
    assert_float_equal(ratio[n / 2], 1, .05);
    image_free(&p);
    image_free(&frame);
}

static void a_clipped_light_is_declared(void **state)
{
    (void)state;
    struct mishap m = none;
    double at_least[3], direction[3];
    m.n_frames = 6; // shortest 1/128 s
    assert_int_equal(run_with(&m), 3);
    show("clipped");
    assert_true(found("clipped_light", NULL, NULL) >= 1);
    assert_int_equal(json_get_numbers(report, "clipped_lights.0.irradiance_at_least", at_least, 3), 0);
    assert_int_equal(json_get_numbers(report, "clipped_lights.0.dir_probe", direction, 3), 0);
    assert_true(at_least[1] > 0);
}

static void missing_stops_and_frames_are_named(void **state)
{
    (void)state;
    struct mishap m = none;
    double uncovered;
    m.missing_stop = 2;
    assert_int_equal(run_with(&m), 3);
    show("missing stop");
    assert_int_equal(found("missing_stop", "s2", NULL), 1);
    assert_int_equal(found("missing_frame", "s2", NULL), FRAMES);
    assert_int_equal(found("uncovered", NULL, NULL), 1);
    assert_int_equal(json_get_number(report, "uncovered_sr", &uncovered), 0);
    assert_true(uncovered > 2 && uncovered < 5);
    m = none;
    m.left_out = 4;
    assert_int_equal(run_with(&m), 3);
    show("frame left out of the plan");
    assert_int_equal(found("missing_frame", "s1", "s1_5.dng"), 1);
    scratch_write("s0_3.dng", "not a raw", 9);
    assert_int_equal(run_with(&none), 3);
    show("not a raw");
    assert_int_equal(found("unreadable_frame", "s0", "s0_3.dng"), 1);
    shoot(0, 3, &none);
    struct raw_frame f; // its head can be read, its photosites make no sense: said once, and as what it is
    struct sim_camera c = camera;
    c.black = c.white;
    assert_int_equal(sim_expose(&f, seen[0], &c, true_s[3], 1, 3), 0);
    assert_int_equal(sim_write_dng(&f, &c, scratch_path("s0_3.dng"), label_s[3], "1", (START + (int64_t)30) * 1000000000), 0);
    free(f.site);
    assert_int_equal(run_with(&none), 3);
    show("no photosites");
    assert_int_equal(found("unreadable_frame", "s0", "s0_3.dng"), 1);
    assert_int_equal(found(NULL, "s0", "s0_3.dng"), 1);
    shoot(0, 3, &none);
}

static void a_wrong_order_is_named(void **state)
{
    (void)state;
    struct mishap m = none;
    struct image p;
    m.exchanged_a = 2, m.exchanged_b = 3;
    assert_int_equal(run_with(&m), 3);
    show("exchanged exposures");
    assert_true(found("wrong_order", "s1", "s1_2.dng") >= 1 && found("wrong_order", "s1", "s1_3.dng") >= 1);
    assert_int_equal(image_read(&p, scratch_path("panorama.exr")), 0);
    assert_true(median_error(&p) < .005); // without them
    image_free(&p);
    m = none;
    m.exchanged_a = 0, m.exchanged_b = 1; // the longest, with which all others are compared
    assert_int_equal(run_with(&m), 3);
    show("exchanged longest");
    assert_true(found("wrong_order", "s1", "s1_0.dng") >= 1 && found("wrong_order", "s1", "s1_1.dng") >= 1);
    assert_int_equal(found("other_brightness", NULL, NULL), 0);
    m = none;
    m.stop = 1, m.frame = 4, m.late_s = -15; // before the two that the plan has before it
    assert_int_equal(run_with(&m), 3);
    show("times out of order");
    assert_int_equal(found("wrong_order", "s1", "s1_4.dng"), 1);
    m = none;
    m.exchanged_stops = true;
    assert_int_equal(run_with(&m), 3);
    show("exchanged stops");
    assert_true(found("stop_does_not_fit", NULL, NULL) >= 1);
    assert_true(found("wrong_order", NULL, NULL) >= 1);
}

static void a_changed_aperture_is_named_by_the_file_and_by_the_light(void **state)
{
    (void)state;
    struct mishap m = none;
    struct image p;
    m.stop = 1, m.frame = 3, m.f_number = 1.4;
    assert_int_equal(run_with(&m), 3);
    show("aperture in the file");
    assert_int_equal(found("other_aperture", "s1", "s1_3.dng"), 1);
    for (int frame = 0; frame < 4; frame += 3) { // a lens that does not tell; the frame is the longest, or another
        m = none;
        m.stop = 1, m.frame = frame, m.light = .5;
        assert_int_equal(run_with(&m), 3);
        show("aperture by the light");
        assert_int_equal(found("other_brightness", "s1", frame ? "s1_3.dng" : "s1_0.dng"), 1);
        assert_int_equal(found("other_brightness", NULL, NULL), 1);
        assert_int_equal(image_read(&p, scratch_path("panorama.exr")), 0);
        assert_true(median_error(&p) < .005);
        image_free(&p);
    }
}

static void a_flickering_lamp_and_another_camera_are_named(void **state)
{
    (void)state;
    struct mishap m = none;
    m.stop = 0, m.frame = 8, m.light = .93; // the shortest, repeated: only lamps are seen in it
    run_with(&m);
    show("flicker of the shortest");
    assert_int_equal(found("flicker", "s0", "s0_8.dng") >= 1, 1);
    m = none;
    m.stop = 2, m.frame = 2, m.light = 1.02;
    run_with(&m);
    show("flicker of the room");
    assert_int_equal(found("flicker", "s2", "s2_2.dng"), 1);
    m = none;
    m.stop = 1, m.frame = 2, m.serial = "2";
    assert_int_equal(run_with(&m), 3);
    show("another camera");
    assert_int_equal(found("other_camera", "s1", "s1_2.dng"), 1);
}

static void a_stitched_panorama_is_checked_and_passed_on(void **state)
{
    (void)state;
    struct image p, back;
    assert_int_equal(image_write_exr(&truth, scratch_path("in.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    assert_int_equal(run("in.exr", ""), 0);
    show("stitched");
    assert_int_equal(image_read(&back, scratch_path("panorama.exr")), 0);
    assert_true(back.width == truth.width && back.n_channels == 3);
    assert_memory_equal(back.data, truth.data, (size_t)truth.width * (size_t)truth.height * 3 * sizeof(float));
    image_free(&back);
    assert_int_equal(image_new(&p, 64, 40, 3, NULL), 0);
    for (int i = 0; i < 64 * 40 * 3; i++)
        p.data[i] = 5 + (float)(i % 7);
    assert_int_equal(image_write_exr(&p, scratch_path("in.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    assert_int_equal(run("in.exr", ""), 1); // not 2:1
    assert_true(access(scratch_path("panorama.exr"), F_OK) != 0 && !report);
    image_free(&p);
    assert_int_equal(image_new(&p, 64, 32, 3, NULL), 0);
    assert_int_equal(image_write_exr(&p, scratch_path("in.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    assert_int_equal(run("in.exr", ""), 1); // black
    for (int i = 0; i < 64 * 32 * 3; i++)
        p.data[i] = fminf((float)i / (64 * 32), 1); // a third of it white
    assert_int_equal(image_write_exr(&p, scratch_path("in.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    assert_int_equal(run("in.exr", "--json"), 3);
    assert_int_equal(found("not_radiance", NULL, NULL), 1);
    assert_int_equal(found("clipped_light", NULL, NULL), 1);
    p.data[100] = INFINITY;
    assert_int_equal(image_write_exr(&p, scratch_path("in.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    assert_int_equal(run("in.exr", ""), 1);
    image_free(&p);
    // Channels that are looked at, too, are numbers of their kind.
    static const char *const names[] = { "R", "G", "B", "coverage", "clip", "variance.G", "Z" };
    static const struct { int channel; float value; int code; } wrong[] = {
        { 3, NAN, 1 }, { 3, INFINITY, 1 }, { 3, -5, 1 }, { 3, 1e30f, 1 }, { 4, NAN, 1 }, { 4, 7, 1 }, { 5, INFINITY, 1 }, { 6, INFINITY, 0 }, { 6, 1, 0 },
    };
    for (size_t k = 0; k < sizeof(wrong) / sizeof(wrong[0]); k++) {
        assert_int_equal(image_new(&p, 64, 32, 7, names), 0);
        for (int i = 0; i < 64 * 32; i++)
            for (int c = 0; c < 7; c++)
                p.data[7 * i + c] = c == 3 ? 1 : c == 4 ? 0 : 5 + (float)(i % 7);
        p.data[7 * 1000 + wrong[k].channel] = wrong[k].value;
        const float first = p.data[7 * 1000 + wrong[k].channel];
        if (isnan(first)) // which our own writer refuses: put into the bytes of a picture that is not compressed
            p.data[7 * 1000 + wrong[k].channel] = 12345.678f;
        assert_int_equal(image_write_exr(&p, scratch_path("in.exr"), IMAGE_FLOAT, IMAGE_STORED), 0);
        if (isnan(first)) {
            const float mark = 12345.678f, nan = NAN;
            char bytes[200000];
            FILE *f = fopen(scratch_path("in.exr"), "r+b");
            const size_t n = fread(bytes, 1, sizeof(bytes), f);
            char *at = memmem(bytes, n, &mark, sizeof(mark));
            assert_non_null(at);
            memcpy(at, &nan, sizeof(nan));
            rewind(f);
            assert_int_equal(fwrite(bytes, 1, n, f), n);
            fclose(f);
        }
        if (run("in.exr", "") != wrong[k].code || (access(scratch_path("panorama.exr"), F_OK) == 0) != !wrong[k].code)
            fail_msg("%s %g", names[wrong[k].channel], (double)wrong[k].value);
        image_free(&p);
    }
    assert_int_equal(run("nowhere.exr", ""), 1);
    assert_int_equal(run("plan.json", "--size 7"), 2);
    assert_int_equal(run("plan.json", "--colour"), 2);
}

static int open_all(void **state)
{
    (void)state;
    if (scratch_open() || sim_studio(&truth, 512))
        return -1;
    camera = sim_usual;
    camera.f_number = 1;
    camera.lens = (struct lens){ .model = LENS_EQUISOLID, .width_px = SIZE, .height_px = SIZE, .centre_px = { SIZE / 2. + .5, SIZE / 2. - .75 },
                                 .focal_px = .48 * SIZE / (2 * sin(46 * M_PI / 180)), .max_angle_rad = 92 * M_PI / 180 };
    if (lens_init(&camera.lens, "test"))
        return -1;
    for (int s = 0; s < STOPS; s++) {
        camera.yaw_deg = 120 * s;
        seen[s] = sim_see(&truth, &camera, 3);
        for (int k = 0; k < FRAMES; k++)
            shoot(s, k, &none);
    }
    return 0;
}

static int close_all(void **state)
{
    (void)state;
    for (int s = 0; s < STOPS; s++)
        free(seen[s]);
    json_free(report);
    image_free(&truth);
    scratch_empty();
    return scratch_close();
}

// A kill at any time: whoever finds a panorama finds its doubts beside it.
static void no_panorama_is_ever_there_without_its_report(void **state)
{
    (void)state;
    char events[8192] __attribute__((aligned(8)));
    static const char *const inputs[] = { "plan.json", "in.exr" };
    write_plan(&none);
    assert_int_equal(image_write_exr(&truth, scratch_path("in.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    for (int k = 0; k < 2; k++) {
        bool has_report = false, has_panorama = false;
        unlink(scratch_path("panorama.exr"));
        unlink(scratch_path("panorama-report.json"));
        const int fd = inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
        assert_true(fd >= 0 && inotify_add_watch(fd, scratch_path(""), IN_MOVED_TO | IN_CREATE) >= 0);
        assert_int_equal(run(inputs[k], ""), 0);
        for (ssize_t n; (n = read(fd, events, sizeof(events))) > 0;)
            for (const char *at = events; at < events + n;) {
                const struct inotify_event *e = (const struct inotify_event *)at;
                has_report = has_report || (e->len && !strcmp(e->name, "panorama-report.json"));
                has_panorama = has_panorama || (e->len && !strcmp(e->name, "panorama.exr"));
                assert_true(has_report || !has_panorama);
                at += sizeof(*e) + e->len;
            }
        assert_true(has_panorama);
        close(fd);
    }
    // One that cannot be written leaves no report, either.
    unlink(scratch_path("panorama.exr"));
    assert_int_equal(mkdir(scratch_path("panorama.exr"), 0777), 0);
    unlink(scratch_path("panorama-report.json"));
    char command[3000];
    snprintf(command, sizeof(command), "%s/rigd-panorama '%s' -o '%s' >/dev/null 2>&1", getenv("BIN") ? getenv("BIN") : "build/bin", scratch_path("in.exr"), scratch_path("panorama.exr"));
    assert_int_equal(WEXITSTATUS(system(command)), 1);
    assert_true(access(scratch_path("panorama-report.json"), F_OK) != 0);
    assert_int_equal(rmdir(scratch_path("panorama.exr")), 0);
}

// An even grey, with the noise of photons so that frames do not look like a plateau. arg: its exposure.
static uint16_t dim(void *arg, int x, int y)
{
    return (uint16_t)(512 + *(const double *)arg * (4000 + (x * 31 + y * 17) % 64));
}

static void a_merge_takes_less_memory_than_two_frames(void **state)
{
    (void)state;
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
    return; // which take their own
#endif
    enum { W = 4000, H = 3000, N = 3 };
    const int fd = open(scratch_path(""), O_TMPFILE | O_RDWR, 0600); // without such files frames stay in memory
    if (fd < 0) {
        fprintf(stderr, "# memory of a merge not looked at: no file without a name in %s\n", scratch_path(""));
        return;
    }
    close(fd);
    char name[32], plan[700] = "";
    size_t n = (size_t)snprintf(plan, sizeof(plan), "{\"lens\": {\"model\": \"equisolid\", \"width_px\": %d, \"height_px\": %d, \"focal_px\": 300, \"max_angle_deg\": 92},\n"
                                                    " \"sensor\": {\"electrons_at_white\": 20000, \"read_noise_e\": 4}, \"stops\": [", W, H);
    for (int s = 0; s < 2; s++) {
        n += (size_t)snprintf(plan + n, sizeof(plan) - n, "%s{\"name\": \"s%d\", \"yaw_deg\": %d, \"frames\": [", s ? "," : "", s, 180 * s);
        for (int k = 0; k < N; k++)
            n += (size_t)snprintf(plan + n, sizeof(plan) - n, "%s{\"file\": \"large%d.dng\"}", k ? "," : "", k);
        n += (size_t)snprintf(plan + n, sizeof(plan) - n, "]}");
    }
    n += (size_t)snprintf(plan + n, sizeof(plan) - n, "]}");
    scratch_write("large.json", plan, n);
    for (int k = 0; k < N; k++) {
        struct raw_dng_info info = raw_info(W, H);
        double exposure = exp2(-2 * k);
        info.time_s *= exposure;
        snprintf(name, sizeof(name), "large%d.dng", k);
        raw_write(scratch_path(name), &info, dim, &exposure);
    }
    const int code = run("large.json", "--size 256");
    double bytes = NAN;
    int64_t n_used = 0;
    assert_true(code == 0 || code == 3); // the frames of both stops are of one time
    assert_int_equal(json_get_number(report, "peak_rss_bytes", &bytes), 0);
    for (int s = 0; s < 2; s++)
        for (int k = 0; k < N; k++) {
            char key[40];
            const char *verdict = "";
            snprintf(key, sizeof(key), "stops.%d.frames.%d.verdict", s, k);
            json_get_string(report, key, &verdict);
            n_used += !strcmp(verdict, "fits");
        }
    assert_int_equal(n_used, 2 * N);
    if (getenv("VERBOSE"))
        fprintf(stderr, "%.1f MB\n", bytes * 1e-6);
    assert_true(bytes < 2. * W * H * 6);
    for (int k = 0; k < N; k++) {
        snprintf(name, sizeof(name), "large%d.dng", k);
        unlink(scratch_path(name));
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_plan_without_fault_gives_the_radiance_and_no_doubt),
        cmocka_unit_test(a_frame_and_the_panorama_share_a_unit),
        cmocka_unit_test(a_clipped_light_is_declared),
        cmocka_unit_test(missing_stops_and_frames_are_named),
        cmocka_unit_test(a_wrong_order_is_named),
        cmocka_unit_test(a_changed_aperture_is_named_by_the_file_and_by_the_light),
        cmocka_unit_test(a_flickering_lamp_and_another_camera_are_named),
        cmocka_unit_test(a_stitched_panorama_is_checked_and_passed_on),
        cmocka_unit_test(no_panorama_is_ever_there_without_its_report),
        cmocka_unit_test(a_merge_takes_less_memory_than_two_frames),
    };
    return cmocka_run_group_tests(tests, open_all, close_all);
}
