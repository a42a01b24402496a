// tests/test_cameras_import.c - one rig through every photogrammetry tool's files: the same pixels; what is broken or not read is
// refused with its name; cameras and meshes of different frames are found out.
#include "solver/cameras.h"
#include "solver/cameras_format.h"
#include "solver/cameras_frame.h"
#include "solver/picture_size.h"
#include "solver/random.h"
#include "solver/shapes.h"
#include "solver/take/atomic_file.h"
#include "solver/take/image.h"
#include "solver/take/log.h"
#include "solver/vec3.h"
#include "tests/rig_files.h"
#include "tests/scratch.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

// ---- helpers ------------------------------------------------------------------------------------------------------------

static char logged[8192]; // the last error, then the last warning, then the last note
static char noted[4096], warned[4096];

static void keep(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    char *const kept[] = { [LOG_INFO] = noted, [LOG_WARNING] = warned, [LOG_ERROR] = logged };
    if (level >= LOG_INFO && level <= LOG_ERROR)
        snprintf(kept[level], sizeof(noted), "%s", message);
}

static int set_up(void **state)
{
    (void)state;
    log_set_hook(keep, NULL);
    log_set_level(LOG_SILENT); // thousands of refusals
    return scratch_open();
}

static int tear_down(void **state)
{
    (void)state;
    log_set_hook(NULL, NULL);
    scratch_empty();
    return scratch_close();
}

enum { WIDTH = 6000, HEIGHT = 4000 };
static int size_of_any(void *arg, const char *name, int *width_px, int *height_px)
{
    (void)arg, (void)name;
    *width_px = WIDTH, *height_px = HEIGHT;
    return 0;
}
static const struct cameras_options sized = { .picture_size = size_of_any };

// A view of the origin from 2 m, looking a little past it, without distortion.
static struct camera view_of_origin(uint64_t seed)
{
    struct camera c = { .width_px = WIDTH, .height_px = HEIGHT, .fx = 7213.25, .fy = 7213.25, .cx = 3011.125, .cy = 1984.5 };
    double centre[3], target[3], up[3];
    for (uint64_t i = 0; i < 3; i++) {
        centre[i] = random_normal(seed, 1, i);
        target[i] = .05 * random_normal(seed, 2, i);
        up[i] = random_normal(seed, 3, i);
    }
    vec3_normalise(centre);
    for (int i = 0; i < 3; i++)
        centre[i] *= 2;
    snprintf(c.name, sizeof(c.name), "IMG_%d.%d", (int)seed, (int)seed); // a dot is legal
    camera_look_at(&c, centre, target, up);
    return c;
}

// A lens of what the formats can hold between them.
struct lens {
    const char *meshroom; // its name there; NULL: Meshroom cannot hold it
    bool is_for_realitycapture, is_for_bundler;
    enum camera_model model;
    double aspect, skew, k[4], p[4];
    bool is_centred;
};
static const struct lens lenses[] = {
    { "none", true, true, CAMERA_BROWN, 1, 0, { 0 }, { 0 }, true },
    { "radialk1", true, true, CAMERA_BROWN, 1, 0, { -.12 }, { 0 }, true },
    { "radialk3", true, true, CAMERA_BROWN, 1, 0, { -.12, .03 }, { 0 }, true },
    { "none", false, false, CAMERA_BROWN, 1.01, 0, { 0 }, { 0 }, false },
    { "radialk3", true, false, CAMERA_BROWN, 1, 0, { .06, -.08, .03 }, { 0 }, false },
    { "radialk3pt", true, false, CAMERA_BROWN, 1, 0, { .06, -.08, .03 }, { 0 }, false },
    { "brown", true, false, CAMERA_BROWN, 1, 0, { .06, -.08, .03 }, { -.0002, .0009 }, false },
    { "brown", false, false, CAMERA_BROWN, .99, 0, { -.1, .02, .01 }, { .0012, -.0004 }, false },
    { NULL, true, false, CAMERA_BROWN, 1, 0, { -.1, .05, -.01, .003 }, { 0 }, false },
    { NULL, true, false, CAMERA_BROWN, 1, 0, { -.1, .05, -.01, .003 }, { .0007, -.0004 }, false },
    { NULL, false, false, CAMERA_BROWN, 1.002, 3.5, { -.1, .05, -.01, .003 }, { .0007, -.0004, .02, -.01 }, false },
    { "fisheye", false, false, CAMERA_FISHEYE, 1.003, 0, { -.03, .012, -.004, .001 }, { 0 }, false },
    { "none", false, false, CAMERA_FISHEYE, 1, 0, { 0 }, { 0 }, false },
    { "radialk3", false, false, CAMERA_FISHEYE, 1, 0, { -.03, .012, -.004 }, { 0 }, false },
    { "radialk3pt", false, false, CAMERA_FISHEYE, 1, 0, { -.03, .012, -.004 }, { 0 }, false },
    { "brown", false, false, CAMERA_FISHEYE, 1, 0, { -.03, .012, -.004 }, { .0008, -.0003 }, false },
    { NULL, false, false, CAMERA_FISHEYE, .998, -2, { -.03, .012, -.004, .001 }, { .0004, -.0006 }, false },
};
enum { N_LENSES = sizeof(lenses) / sizeof(lenses[0]) };

static struct camera view_with(int lens)
{
    struct camera c = view_of_origin((uint64_t)lens + 1);
    const struct lens *l = &lenses[lens];
    c.model = l->model, c.skew = l->skew;
    c.fx = c.fy * l->aspect;
    memcpy(c.k, l->k, sizeof(l->k));
    memcpy(c.p, l->p, sizeof(l->p));
    if (l->is_centred)
        c.cx = .5 * WIDTH, c.cy = .5 * HEIGHT;
    return c;
}

static double largest_difference_px(const struct camera *a, const struct camera *b)
{
    double most = 0;
    for (uint64_t i = 0; i < 1000; i++) {
        double p[3], u[2], v[2];
        for (uint64_t c = 0; c < 3; c++)
            p[c] = random_uniform(4, c, i) - .5;
        assert_true(camera_project(a, p, u, NULL));
        assert_true(camera_project(b, p, v, NULL));
        most = fmax(most, hypot(u[0] - v[0], u[1] - v[1]));
    }
    return most;
}

static void assert_same(const struct cameras *a, const struct cameras *b)
{
    assert_int_equal(a->n, b->n);
    for (int i = 0; i < a->n; i++) {
        const struct camera *v = cameras_find(b, a->view[i].name);
        assert_non_null(v);
        assert_int_equal(v->width_px, a->view[i].width_px);
        assert_int_equal(v->height_px, a->view[i].height_px);
        assert_true(largest_difference_px(&a->view[i], v) < 1e-6);
    }
}

// A file in memory as a writer would leave it on disk.
struct text {
    char *bytes;
    size_t n;
    FILE *f;
};
static FILE *text_open(struct text *t)
{
    t->f = open_memstream(&t->bytes, &t->n);
    assert_non_null(t->f);
    return t->f;
}
static void text_save(struct text *t, const char *name) // closes, writes, frees
{
    assert_int_equal(fclose(t->f), 0);
    scratch_write(name, t->bytes, t->n);
    free(t->bytes);
}

static const struct rig_transform tilted = { .scale = 12.35, .rotation = { .6, 0, .8, 0, 1, 0, -.8, 0, .6 },
                                             .translation = { 31, -17, 5.5 } };

// ---- round trips --------------------------------------------------------------------------------------------------------

static void metashape_keeps_every_lens(void **state)
{
    (void)state;
    struct camera views[N_LENSES];
    const struct cameras c = { N_LENSES, views };
    for (int i = 0; i < N_LENSES; i++)
        views[i] = view_with(i);
    for (int with = 0; with < 2; with++) {
        struct text t;
        struct cameras back;
        put_metashape(text_open(&t), &c, with ? &tilted : NULL);
        text_save(&t, "cameras.xml");
        assert_int_equal(cameras_read(&back, scratch_path("cameras.xml")), 0);
        assert_same(&c, &back);
        cameras_free(&back);
        // the chunk's own frame: the same cameras, where the world is turned, moved and scaled back
        bool has_transform = false;
        const struct cameras_options raw = { .without_transform = true, .has_transform = &has_transform };
        assert_int_equal(cameras_read_with(&back, scratch_dir, &raw), 0);
        assert_int_equal(has_transform, with);
        for (int i = 0; i < N_LENSES; i++)
            for (uint64_t k = 0; k < 20 && with; k++) {
                double p[3], q[3], u[2], v[2];
                for (uint64_t j = 0; j < 3; j++)
                    p[j] = random_uniform(5, j, k) - .5;
                vec3_sub(q, p, tilted.translation);
                mat3_tmul_vec(q, tilted.rotation, q);
                for (int j = 0; j < 3; j++)
                    q[j] /= tilted.scale;
                assert_true(camera_project(&views[i], p, u, NULL) && camera_project(&back.view[i], q, v, NULL));
                assert_true(hypot(u[0] - v[0], u[1] - v[1]) < 1e-6);
            }
        cameras_free(&back);
        scratch_empty();
    }
}

static void realitycapture_keeps_every_lens_it_has(void **state)
{
    (void)state;
    struct camera views[N_LENSES];
    struct cameras c = { 0, views }, back;
    struct text t;
    for (int i = 0; i < N_LENSES; i++)
        if (lenses[i].is_for_realitycapture)
            views[c.n++] = view_with(i);
    for (int i = 0; i < c.n; i++) {
        char name[CAMERA_NAME_MAX + 8];
        put_xmp(text_open(&t), &views[i], i & 1);
        snprintf(name, sizeof(name), "%.*s.xmp", CAMERA_NAME_MAX - 1, views[i].name);
        text_save(&t, name);
    }
    assert_int_equal(cameras_read_with(&back, scratch_dir, &sized), 0);
    assert_same(&c, &back);
    cameras_free(&back);
    scratch_empty();
    for (int newer = 0; newer < 2; newer++) {
        put_realitycapture_csv(text_open(&t), &c, newer);
        text_save(&t, "any.csv");
        assert_int_equal(cameras_read_with(&back, scratch_path("any.csv"), &sized), 0);
        assert_same(&c, &back);
        cameras_free(&back);
    }
    scratch_empty();
}

static void meshroom_keeps_every_lens_it_has_in_every_version(void **state)
{
    (void)state;
    static const int versions[] = { 10211, 10210, 10208, 10207, 10205, 10204, 10202, 10201, 10200, 10199, 10000 };
    for (size_t k = 0; k < sizeof(versions) / sizeof(versions[0]); k++) {
        struct camera views[N_LENSES];
        const char *names[N_LENSES];
        struct cameras c = { 0, views }, back;
        struct text t;
        for (int i = 0; i < N_LENSES; i++) {
            const char *name = lenses[i].meshroom;
            const bool is_new = name && (!strcmp(name, "radialk3pt") || (lenses[i].model == CAMERA_FISHEYE && strcmp(name, "fisheye")));
            if (!name || (is_new && versions[k] < 10208) || (lenses[i].aspect != 1 && versions[k] < 10200))
                continue;
            names[c.n] = name;
            views[c.n++] = view_with(i);
        }
        assert_true(c.n >= 5);
        put_meshroom(text_open(&t), &c, versions[k], names);
        text_save(&t, "cameras.sfm");
        assert_int_equal(cameras_read(&back, scratch_path("cameras.sfm")), 0);
        assert_same(&c, &back);
        cameras_free(&back);
    }
    scratch_empty();
}

static void bundler_keeps_every_lens_it_has(void **state)
{
    (void)state;
    struct camera views[N_LENSES];
    struct cameras c = { 0, views }, back;
    struct text t;
    for (int i = 0; i < N_LENSES; i++)
        if (lenses[i].is_for_bundler)
            views[c.n++] = view_with(i);
    static const char *const names[][2] = { { "bundle.out", "list.txt" }, { "a.bundle.out", "a.list.txt" }, { "b.out", "b.list.txt" } };
    for (size_t k = 0; k < 3; k++) {
        put_bundler(text_open(&t), &c);
        text_save(&t, names[k][0]);
        put_bundler_list(text_open(&t), &c);
        text_save(&t, names[k][1]);
        assert_int_equal(cameras_read_with(&back, scratch_path(names[k][0]), &sized), 0);
        assert_same(&c, &back);
        cameras_free(&back);
        scratch_empty();
    }
}

// One rig, all formats, from a folder as a take has it.
static void one_rig_through_all_formats_gives_the_same_pixels(void **state)
{
    (void)state;
    struct camera views[4];
    const struct cameras c = { 4, views };
    const char *const radialk3[4] = { "radialk3", "radialk3", "radialk3", "radialk3" };
    for (int i = 0; i < 4; i++) {
        views[i] = view_of_origin(40 + (uint64_t)i);
        views[i].k[0] = -.12, views[i].k[1] = .03;
        views[i].cx = .5 * WIDTH, views[i].cy = .5 * HEIGHT;
    }
    for (int format = 0; format < 7; format++) {
        struct cameras back;
        struct text t;
        if (format < 2) {
            assert_int_equal((format ? cameras_write_colmap_binary : cameras_write_colmap_text)(&c, scratch_dir), 0);
        } else if (format == 2) {
            put_metashape(text_open(&t), &c, &tilted);
            text_save(&t, "scan.xml");
        } else if (format == 3) {
            for (int i = 0; i < 4; i++) {
                char name[CAMERA_NAME_MAX + 8];
                put_xmp(text_open(&t), &views[i], i & 1);
                snprintf(name, sizeof(name), "%.*s.xmp", CAMERA_NAME_MAX - 1, views[i].name);
                text_save(&t, name);
            }
        } else if (format == 4) {
            put_realitycapture_csv(text_open(&t), &c, true);
            text_save(&t, "scan.csv");
        } else if (format == 5) {
            put_meshroom(text_open(&t), &c, 10211, radialk3);
            text_save(&t, "sfm.json");
        } else {
            put_bundler(text_open(&t), &c);
            text_save(&t, "bundle.out");
            put_bundler_list(text_open(&t), &c);
            text_save(&t, "list.txt");
        }
        assert_int_equal(cameras_read_with(&back, scratch_dir, &sized), 0);
        assert_same(&c, &back);
        cameras_free(&back);
        scratch_empty();
    }
}

// A white square on a plane in front of a camera that is written down in numbers here, sampled pixel by pixel: its centre of gravity
// is where every format's camera puts its middle. Half a pixel off, and this fails by .5.
static void a_rendered_square_lies_where_every_format_says(void **state)
{
    (void)state;
    enum { W = 64, H = 48, N = 64 };
    struct camera view = { .width_px = W, .height_px = H, .fx = 100, .fy = 100, .cx = 32, .cy = 24, .name = "square",
                           .cam_from_world = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
    const struct cameras c = { 1, &view };
    const double middle[3] = { .0437, -.0311, 1 }, half = .0713;
    double sum = 0, x_sum = 0, y_sum = 0;
    for (int y = 0; y < H; y++)
        for (int x = 0; x < W; x++)
            for (int k = 0; k < N * N; k++) { // u - 32 = 100 X, the first pixel from 0 to 1
                const double u = x + (k % N + .5) / N, v = y + (k / N + .5) / N;
                if (fabs((u - 32) / 100 - middle[0]) < half && fabs((v - 24) / 100 - middle[1]) < half)
                    sum += 1, x_sum += x + .5, y_sum += y + .5;
            }
    const char *const none = "none";
    for (int format = 0; format < 6; format++) {
        struct cameras back;
        struct text t;
        double uv[2];
        int err = 0;
        if (format == 0) {
            err = cameras_write_colmap_text(&c, scratch_dir);
        } else if (format == 1) {
            put_metashape(text_open(&t), &c, NULL);
            text_save(&t, "x.xml");
        } else if (format == 2) {
            put_xmp(text_open(&t), &view, false);
            text_save(&t, "square.xmp");
        } else if (format == 3) {
            put_realitycapture_csv(text_open(&t), &c, false);
            text_save(&t, "x.csv");
        } else if (format == 4) {
            put_meshroom(text_open(&t), &c, 10211, &none);
            text_save(&t, "x.sfm");
        } else {
            put_bundler(text_open(&t), &c);
            text_save(&t, "bundle.out");
            put_bundler_list(text_open(&t), &c);
            text_save(&t, "list.txt");
        }
        struct image picture; // the size comes from a picture beside the file
        err = err ? err : image_new(&picture, W, H, 3, NULL);
        err = err ? err : image_write_exr(&picture, scratch_path("square.exr"), IMAGE_HALF, IMAGE_ZIP);
        image_free(&picture);
        assert_int_equal(err, 0);
        assert_int_equal(cameras_read(&back, scratch_dir), 0);
        assert_true(camera_project(&back.view[0], middle, uv, NULL));
        assert_true(hypot(uv[0] - x_sum / sum, uv[1] - y_sum / sum) < .02);
        cameras_free(&back);
        scratch_empty();
    }
}

// The angles by hand: over the origin, looking down with north up in the picture; then turned and tilted.
static void realitycapture_angles_mean_what_a_compass_says(void **state)
{
    (void)state;
    const char *text = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
                       "down.jpg,0,0,10,0,0,0,36,0,0,0,0,0,0,0,0\n"
                       "east.jpg,0,0,10,90,0,0,36,0,0,0,0,0,0,0,0\n"
                       "horizon.jpg,0,0,10,0,90,0,36,0,0,0,0,0,0,0,0\n"
                       "rolled.jpg,0,0,10,0,0,10,36,0,0,0,0,0,0,0,0\n";
    const struct cameras_source s = { .path = "x", .options = &sized };
    struct cameras c;
    double uv[2];
    assert_int_equal(cameras_parse_realitycapture_csv(&c, text, strlen(text), &s), 0);
    const double north[3] = { 0, 1, 0 }, east[3] = { 1, 0, 0 }, far_north[3] = { 0, 100, 10 }, higher[3] = { 0, 100, 11 };
    assert_true(camera_project(&c.view[0], north, uv, NULL)); // 6000 px of focal length, 10 m below: 600 px a metre
    assert_true(fabs(uv[0] - 3000) < 1e-9 && fabs(uv[1] - 1400) < 1e-9);
    assert_true(camera_project(&c.view[0], east, uv, NULL));
    assert_true(fabs(uv[0] - 3600) < 1e-9 && fabs(uv[1] - 2000) < 1e-9);
    assert_true(camera_project(&c.view[1], east, uv, NULL)); // heading east: east is up
    assert_true(fabs(uv[0] - 3000) < 1e-9 && fabs(uv[1] - 1400) < 1e-9);
    assert_true(camera_project(&c.view[2], far_north, uv, NULL)); // pitched up to the horizon
    assert_true(fabs(uv[0] - 3000) < 1e-9 && fabs(uv[1] - 2000) < 1e-9);
    assert_true(camera_project(&c.view[2], higher, uv, NULL));
    assert_true(uv[1] < 2000);
    assert_true(camera_project(&c.view[3], (const double[3]){ -10 * tan(M_PI / 18), 0, 0 }, uv, NULL));
    assert_true(fabs(uv[0] - 3000) < 1e-6 && fabs(uv[1] - 2000) < 1e-6);
    cameras_free(&c);
}

// ---- refusals -----------------------------------------------------------------------------------------------------------

#define SENSOR "<sensor id='0' type='frame'><resolution width='40' height='20'/><calibration><f>30</f></calibration></sensor>"
#define POSE "<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>"
#define DOCUMENT(sensors, cameras) "<document><chunk><sensors>" sensors "</sensors><cameras>" cameras "</cameras></chunk></document>"
#define XMP(fields) "<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'><rdf:Description " \
    "xmlns:xcr='http://www.capturingreality.com/ns/xcr/1.1#' xcr:Position='0 0 0' " fields "/></rdf:RDF></x:xmpmeta>"
#define EYE "xcr:Rotation='1 0 0 0 1 0 0 0 1' "
#define SFM(version, intrinsic, view) "{\"version\": [" version "], \"views\": [{\"viewId\": 1, \"poseId\": 2, \"intrinsicId\": 3, " \
    "\"path\": \"a.jpg\"" view "}], \"intrinsics\": [{\"intrinsicId\": 3, \"width\": 40, \"height\": 20, \"principalPoint\": [0, 0], " \
    intrinsic "}], \"poses\": [{\"poseId\": 2, \"pose\": {\"transform\": {\"rotation\": [1,0,0,0,1,0,0,0,1], \"center\": [0,0,0]}}}]}"
#define CSV_HEAD "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"

static void what_is_not_read_is_refused_by_name(void **state)
{
    (void)state;
    static const struct {
        const char *file, *text;
        int err;
        const char *says;
    } cases[] = {
        { "a.xml", DOCUMENT("", "<camera id='0' sensor_id='0' label='a'>" POSE "</camera>"), -EINVAL, "sensor '0'" },
        { "a.xml", DOCUMENT(SENSOR, "<camera id='0' sensor_id='0' label='a'/>"), -EINVAL, "nothing was registered" },
        { "a.xml", DOCUMENT(SENSOR, "<camera id='0' sensor_id='0' label='a' enabled='false'>" POSE "</camera>"), -EINVAL, "nothing was" },
        { "a.xml", DOCUMENT(SENSOR, "<camera id='0' sensor_id='0' label='a' master_id='3'/>"), -ENOTSUP, "master" },
        { "a.xml", DOCUMENT(SENSOR, "<camera id='0' sensor_id='0' label='a'>" POSE "</camera>"
                                    "<camera id='1' sensor_id='0' label='b/a.JPG'>" POSE "</camera>"), -EINVAL, "called 'a'" },
        { "a.xml", DOCUMENT(SENSOR, "<camera id='0' sensor_id='0' label='a'><transform>1 2 3</transform></camera>"), -EINVAL, "16 numbers" },
        { "a.xml", DOCUMENT(SENSOR, "<camera id='0' sensor_id='0' label='a'><transform>1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1</transform>"
                                    "</camera>"), -EINVAL, "mirrored" },
        { "a.xml", DOCUMENT(SENSOR, "<camera id='0' sensor_id='0' label='a'><transform>2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>"
                                    "</camera>"), -EINVAL, "no rotation" },
        { "a.xml", DOCUMENT("<sensor id='0' type='spherical'/>", "<camera id='0' sensor_id='0' label='a'>" POSE "</camera>"), -ENOTSUP,
          "'spherical'" },
        { "a.xml", DOCUMENT("<sensor id='0'><resolution width='40' height='20'/></sensor>", "<camera sensor_id='0' label='a'>" POSE
                            "</camera>"), -EINVAL, "no calibration" },
        { "a.xml", DOCUMENT("<sensor id='0'><resolution width='40' height='x'/></sensor>", "<camera sensor_id='0' label='a'>" POSE
                            "</camera>"), -EINVAL, "'x'" },
        { "a.xml", DOCUMENT("<sensor id='0'><rolling_shutter>1</rolling_shutter></sensor>", "<camera sensor_id='0' label='a'>" POSE
                            "</camera>"), -ENOTSUP, "rolling shutter" },
        { "a.xml", DOCUMENT("<sensor id='0'><resolution width='40' height='20'/><calibration><fx>30</fx></calibration></sensor>",
                            "<camera sensor_id='0' label='a'>" POSE "</camera>"), -ENOTSUP, "PhotoScan" },
        { "a.xml", DOCUMENT("<sensor id='0'><resolution width='40' height='20'/><calibration><f>3,5</f></calibration></sensor>",
                            "<camera sensor_id='0' label='a'>" POSE "</camera>"), -EINVAL, "<f> is '3,5'" },
        { "a.xml", DOCUMENT("<sensor id='0'><resolution width='40' height='20'/><calibration><k1>1</k1></calibration></sensor>",
                            "<camera sensor_id='0' label='a'>" POSE "</camera>"), -EINVAL, "focal" },
        { "a.xml", "<calibration><projection>frame</projection><width>40</width><height>20</height><f>3</f></calibration>", -EINVAL,
          "calibration alone" },
        { "a.xml", "<!DOCTYPE document [<!ENTITY a 'b'>]><document>&a;</document>", -EINVAL, "document type" },
        { "a.xml", "<document><chunk></document>", -EINVAL, "a.xml:1" },
        { "a.xmp", XMP(EYE "xcr:FocalLength35mm='36' xcr:DistortionModel='division' xcr:DistortionCoeficients='0 0 0 0 0 0'"), -ENOTSUP,
          "'division'" },
        { "a.xmp", XMP(EYE "xcr:FocalLength35mm='36' xcr:DistortionModel='division' xcr:DistortionCoeficients='0 0 0 0 0 0'"), -ENOTSUP,
          "Brown3" },
        { "a.xmp", XMP(EYE "xcr:FocalLength35mm='36' xcr:DistortionModel='brown3' xcr:DistortionCoeficients='0 0 0 1 0 0'"), -EINVAL,
          "coefficient 4" },
        { "a.xmp", XMP(EYE "xcr:FocalLength35mm='36' xcr:DistortionModel='brown3' xcr:DistortionCoeficients='0 0'"), -EINVAL, "6 numbers" },
        { "a.xmp", XMP(EYE "xcr:FocalLength35mm='36' xcr:DistortionModel='perspective' xcr:Skew='.1'"), -ENOTSUP, "skew 0.1" },
        { "a.xmp", XMP(EYE "xcr:FocalLength35mm='36' xcr:DistortionModel='perspective' xcr:AspectRatio='1.1'"), -ENOTSUP, "1.1" },
        { "a.xmp", XMP(EYE "xcr:FocalLength35mm='36' xcr:DistortionModel='perspective' xcr:Coordinates='relative'"), -ENOTSUP, "relative" },
        { "a.xmp", XMP(EYE "xcr:DistortionModel='perspective'"), -EINVAL, "FocalLength35mm" },
        { "a.xmp", XMP("xcr:Rotation='1 0 0 0 1 0 0 0' "), -EINVAL, "9 and 3" },
        { "a.xmp", XMP(EYE "xcr:InTexturing='0'"), -EINVAL, "nothing was registered" },
        { "a.xmp", "<x:xmpmeta xmlns:x='adobe:ns:meta/'/>", -EINVAL, "nothing was registered" },
        { "a.csv", CSV_HEAD "a.jpg,0,0,0,0,0,0,36,0,0,0,0,0,0,0\n", -EINVAL, "a.csv:2" },
        { "a.csv", CSV_HEAD "a.jpg,0,0,0,0,0,0,36,0,0,0,0,0,0,0,0", -EINVAL, "cut short" },
        { "a.csv", CSV_HEAD "a.jpg,0,0,0,0,0,0,-36,0,0,0,0,0,0,0,0\n", -EINVAL, "focal" },
        { "a.csv", "#name,x,y,alt,heading\na.jpg,0,0,0,0\n", -EINVAL, "'pitch'" },
        { "a.sfm", SFM("1,2,11", "\"focalLength\": 30, \"distortionType\": \"3deanamorphic4\"", ""), -ENOTSUP, "3deanamorphic4" },
        { "a.sfm", SFM("1,2,11", "\"focalLength\": 30, \"distortionType\": \"fisheye1\"", ""), -ENOTSUP, "fisheye1" },
        { "a.sfm", SFM("1,2,11", "\"focalLength\": 30, \"undistortionType\": \"3deradial4\"", ""), -ENOTSUP, "3deradial4" },
        { "a.sfm", SFM("1,2,11", "\"focalLength\": 30, \"type\": \"equirectangular\"", ""), -ENOTSUP, "equirectangular" },
        { "a.sfm", SFM("1,2,11", "\"focalLength\": 30, \"distortionType\": \"brown\", \"distortionParams\": [1]", ""), -EINVAL,
          "distortionParams" },
        { "a.sfm", SFM("1,2,11", "\"focalLength\": -1", ""), -EINVAL, "focal" },
        { "a.sfm", SFM("1,2,11", "\"focalLength\": \"3O\"", ""), -EINVAL, "focalLength" },
        { "a.sfm", SFM("1,2,11", "\"focalLength\": 30", ", \"rigId\": 5, \"isPoseIndependant\": \"0\""), -ENOTSUP, "rig" },
        { "a.sfm", SFM("1,2,11", "\"focalLength\": 30", ", \"width\": 41, \"height\": 20"), -EINVAL, "41 x 20" },
        { "a.sfm", SFM("1,2", "\"focalLength\": 30", ""), -EINVAL, "version" },
        { "a.sfm", "{\"views\": []}", -EINVAL, "version" },
        { "a.sfm", "{\"version\": [1, 2, 11], \"views\": [], \"poses\": \"\"}", -EINVAL, "nothing was registered" },
        { "a.out", "# Bundle file v0.2\n0 0\n", -ENOTSUP, "v0.3" },
        { "a.out", "# Bundle file v0.3\n1 0\n30 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0\n", -EINVAL, "a.out:7: found '0 0'" },
        { "a.out", "# Bundle file v0.3\n1 0\n30 0 0\n1 0 0\n0 1 0\n0 0 -1\n0 0 0\n", -EINVAL, "mirrored" },
        { "a.out", "# Bundle file v0.3\n1000000000 0\n", -EINVAL, "1e+09" },
        { "a.out", "# Bundle file v0.3\n2 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n30 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n", -EINVAL, "list.txt:2" },
        { "a.txt", "hello\n", -EINVAL, "not a known camera file" },
    };
    scratch_write("list.txt", "a.jpg\n", 6);
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        struct cameras c;
        logged[0] = 0;
        scratch_write(cases[i].file, cases[i].text, strlen(cases[i].text));
        const int err = cameras_read_with(&c, scratch_path(cases[i].file), &sized);
        if (err != cases[i].err || !strstr(logged, cases[i].says) || !strstr(logged, "/a."))
            if (!strstr(cases[i].says, "list.txt") || err != cases[i].err || !strstr(logged, cases[i].says))
                fail_msg("case %zu: %d, says: %s", i, err, logged);
        assert_true(c.n == 0 && !c.view);
    }
    scratch_empty();
}

// What the refusals above are a step away from is read.
static void their_sound_neighbours_are_read(void **state)
{
    (void)state;
    static const struct {
        const char *file, *text;
        double fx, cx;
    } cases[] = {
        { "a.xml", DOCUMENT(SENSOR, "<camera id='0' sensor_id='0' label='a.b'>" POSE "</camera>"), 30, 20 },
        { "a.xml", DOCUMENT(SENSOR, "<camera id='0' sensor_id='0' label='C:\\new photos\\a.b.JPG'>" POSE "</camera>"), 30, 20 },
        { "a.xml", DOCUMENT(SENSOR, "<camera sensor_id='0' label='a.b' master_id='1'>" POSE "</camera>"), 30, 20 },
        { "a.xml", DOCUMENT("<sensor id='9' type='spherical'/>" SENSOR, "<group><group><camera sensor_id='0' label='/x/a.b.TIF'>" POSE
                            "</camera></group></group>"), 30, 20 },
        { "a.b.xmp", XMP(EYE "xcr:FocalLength35mm='36' xcr:DistortionModel='brown3' xcr:DistortionCoeficients='0 0 0'"), 6000, 3000 },
        { "a.csv", "name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2\r\na.b,0,0,0,0,0,0,36,0,0,0,0,0,0,0,0\r\n", 6000,
          3000 },
        { "a.b.sfm", SFM("1,2,11", "\"focalLength\": 36", ", \"rigId\": 5"), 40, 20 },
    };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        struct cameras c;
        scratch_write(cases[i].file, cases[i].text, strlen(cases[i].text));
        if (cameras_read_with(&c, scratch_path(cases[i].file), &sized))
            fail_msg("case %zu says: %s", i, logged);
        assert_int_equal(c.n, 1);
        assert_string_equal(c.view[0].name, i == 6 ? "a" : "a.b");
        assert_true(fabs(c.view[0].fx - cases[i].fx) < 1e-9 && fabs(c.view[0].cx - cases[i].cx) < 1e-9);
        cameras_free(&c);
        scratch_empty();
    }
    // a sensor without calibration, its calibration beside
    struct cameras c;
    const char *bare = DOCUMENT("<sensor id='0' type='frame'><resolution width='40' height='20'/></sensor>",
                                "<camera sensor_id='0' label='a'>" POSE "</camera>");
    const char *alone = "<calibration><projection>frame</projection><width>40</width><height>20</height><f>30</f><cx>1</cx>"
                        "</calibration>";
    scratch_write("scan.xml", bare, strlen(bare));
    scratch_write("calibration.xml", alone, strlen(alone));
    assert_int_equal(cameras_read(&c, scratch_dir), 0);
    assert_true(c.view[0].fx == 30 && c.view[0].cx == 21);
    cameras_free(&c);
    // two files of a known format: which?
    scratch_write("scan.csv", CSV_HEAD, strlen(CSV_HEAD));
    assert_int_equal(cameras_read(&c, scratch_dir), -EINVAL);
    assert_non_null(strstr(logged, "holds both"));
    scratch_empty();
}

static void views_without_a_picture_are_left_out_where_the_file_has_no_sizes(void **state)
{
    (void)state;
    struct cameras c;
    struct image picture;
    const char *text = CSV_HEAD "a.jpg,0,0,0,0,0,0,36,0,0,0,0,0,0,0,0\nb.jpg,0,0,0,0,0,0,36,0,0,0,0,0,0,0,0\n";
    scratch_write("a.csv", text, strlen(text));
    assert_int_equal(cameras_read(&c, scratch_dir), -EINVAL);
    assert_non_null(strstr(logged, "how large its pictures are"));
    assert_int_equal(image_new(&picture, 30, 20, 3, NULL), 0);
    assert_int_equal(image_write_exr(&picture, scratch_path("b.exr"), IMAGE_HALF, IMAGE_ZIP), 0);
    image_free(&picture);
    assert_int_equal(cameras_read(&c, scratch_dir), 0);
    assert_int_equal(c.n, 1);
    assert_true(c.view[0].width_px == 30 && c.view[0].height_px == 20 && c.view[0].fx == 30);
    assert_non_null(strstr(warned, "1 of 2 views are left out"));
    cameras_free(&c);
    scratch_empty();
}

// ---- hostile files ------------------------------------------------------------------------------------------------------

// Every format, cut after every byte: an error, or (where only an end tag's blank or line end went) the same cameras.
static void cut_files_never_give_other_cameras(void **state)
{
    (void)state;
    struct camera views[2] = { view_with(1), view_with(2) };
    const struct cameras c = { 2, views };
    const char *const radialk3[2] = { "radialk1", "radialk3" };
    const struct cameras_source s = { .path = "f", .options = &sized };
    for (int format = 0; format < 5; format++) {
        struct text t, list;
        text_open(&t), text_open(&list);
        put_bundler_list(list.f, &c);
        if (format == 0)
            put_metashape(t.f, &c, &tilted);
        else if (format == 1)
            put_xmp(t.f, &views[0], true);
        else if (format == 2)
            put_realitycapture_csv(t.f, &c, false);
        else if (format == 3)
            put_meshroom(t.f, &c, 10211, radialk3);
        else
            put_bundler(t.f, &c);
        fclose(t.f), fclose(list.f);
        int n_good = 0;
        for (size_t cut = 0; cut <= t.n; cut++) {
            char *exact = malloc(cut + !cut);
            struct cameras back = { 0 };
            struct camera one = { .width_px = WIDTH, .height_px = HEIGHT, .name = "one" };
            memcpy(exact, t.bytes, cut);
            const int err = format == 0   ? cameras_parse_metashape(&back, exact, cut, &s)
                            : format == 1 ? camera_parse_xmp(&one, exact, cut, "f")
                            : format == 2 ? cameras_parse_realitycapture_csv(&back, exact, cut, &s)
                            : format == 3 ? cameras_parse_meshroom(&back, exact, cut, "f")
                                          : cameras_parse_bundler(&back, exact, cut, "f", list.bytes, list.n, "l", &s);
            if (format == 1 && err == 1) {
                assert_true(largest_difference_px(&one, &views[0]) < 1e-6);
                n_good++;
            } else if (!err && format == 2 && back.n == 1) { // a table of whole lines is whole
                assert_true(largest_difference_px(&views[0], &back.view[0]) < 1e-6);
            } else if (!err) {
                assert_same(&c, &back);
                n_good++;
            } else {
                assert_true(err == -EINVAL || err == -ENOTSUP);
                assert_true(!back.view);
            }
            cameras_free(&back);
            free(exact);
        }
        assert_true(n_good >= 1 && n_good <= 2);
        free(t.bytes), free(list.bytes);
    }
}

static void xml_bombs_are_refused(void **state)
{
    (void)state;
    const struct cameras_source s = { .path = "f", .options = &sized };
    struct cameras c;
    struct text t;
    text_open(&t); // deeper than anything real
    for (int i = 0; i < 100000; i++)
        fprintf(t.f, "<group>");
    fclose(t.f);
    assert_int_equal(cameras_parse_metashape(&c, t.bytes, t.n, &s), -EFBIG);
    assert_non_null(strstr(logged, "64 levels"));
    free(t.bytes);
    const char *laughs = "<?xml version='1.0'?><!DOCTYPE l [<!ENTITY a 'ha'><!ENTITY b '&a;&a;&a;&a;'>]><document>&b;</document>";
    assert_int_equal(cameras_parse_metashape(&c, laughs, strlen(laughs), &s), -EINVAL);
    const char *outside = "<!DOCTYPE l SYSTEM 'file:///etc/passwd'><document/>";
    assert_int_equal(cameras_parse_metashape(&c, outside, strlen(outside), &s), -EINVAL);
    const char *unknown = "<document>&nbsp;</document>";
    assert_int_equal(cameras_parse_metashape(&c, unknown, strlen(unknown), &s), -EINVAL);
}

// ---- sizes of pictures --------------------------------------------------------------------------------------------------

static void headers_of_pictures_tell_their_size(void **state)
{
    (void)state;
    static const struct {
        const char *what, *bytes;
        size_t n;
        int width, height; // 0: refused
    } cases[] = {
        { "png", "\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\x01\x02\0\0\0\x03", 24, 258, 3 },
        { "png of no size", "\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\0\0\0\0\x03", 24, 0, 0 },
        { "jpeg", "\xff\xd8\xff\xe0\0\x04xx\xff\xff\xc4\0\x03x\xff\xc2\0\x0b\x08\0\x07\x01\x05", 24, 261, 7 },
        { "jpeg that loops", "\xff\xd8\xff\xe0\0\0\0\0\0\0\0\0", 12, 0, 0 },
        { "tiff", "II*\0\x08\0\0\0\x02\0\0\x01\x03\0\x01\0\0\0\x10\0\0\0\x01\x01\x04\0\x01\0\0\0\x20\0\0\0", 34, 16, 32 },
        { "big-endian tiff", "MM\0*\0\0\0\x08\0\x02\x01\0\0\x03\0\0\0\x01\0\x10\0\0\x01\x01\0\x04\0\0\0\x01\0\0\0\x20", 34, 16, 32 },
        { "tiff with its directory beyond the end", "II*\0\xff\xff\xff\x7f\x02\0\0\x01\x03\0\x01\0\0\0\x10\0", 20, 0, 0 },
        { "hdr", "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 12 +X 34\n", 47, 34, 12 },
        { "text", "hello, world", 12, 0, 0 },
        { "nothing", "", 0, 0, 0 },
    };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        int w, h;
        scratch_write("picture", cases[i].bytes, cases[i].n);
        const int err = picture_size(&w, &h, scratch_path("picture"));
        if (err != (cases[i].width ? 0 : -EINVAL) || w != cases[i].width || h != cases[i].height)
            fail_msg("%s: %d, %d x %d", cases[i].what, err, w, h);
    }
    int w, h;
    assert_int_equal(picture_size(&w, &h, scratch_path("none")), -ENOENT);
    struct image image; // and as our own writer puts it
    assert_int_equal(image_new(&image, 77, 5, 3, NULL), 0);
    assert_int_equal(image_write_exr(&image, scratch_path("x.exr"), IMAGE_HALF, IMAGE_PIZ), 0);
    image_free(&image);
    assert_int_equal(picture_size(&w, &h, scratch_path("x.exr")), 0);
    assert_true(w == 77 && h == 5);
    scratch_empty();
}

// ---- frames -------------------------------------------------------------------------------------------------------------

// A pebble beside the origin, 24 cameras on a ring around and above it that fill their pictures with it.
static void make_studio(struct mesh *mesh, struct cameras *c, struct camera views[24])
{
    const double middle[3] = { 1.2, 2.1, .7 }, up[3] = { 0, 0, 1 };
    assert_int_equal(shape_make(mesh, SHAPE_PEBBLE, middle, .4, 2000), 0);
    for (int i = 0; i < 24; i++) {
        const double a = 2 * M_PI * i / 24, centre[3] = { middle[0] + 2 * cos(a), middle[1] + 2 * sin(a), middle[2] + .5 + .3 * (i % 3) };
        views[i] = (struct camera){ .width_px = 600, .height_px = 400, .fx = 900, .fy = 900, .cx = 300, .cy = 200 };
        snprintf(views[i].name, sizeof(views[i].name), "view%d", i);
        camera_look_at(&views[i], centre, middle, up);
    }
    *c = (struct cameras){ 24, views };
}

static void change_mesh(struct mesh *mesh, const double by[9])
{
    for (int i = 0; i < mesh->n_vertices; i++) {
        double p[3] = { mesh->position_m[i][0], mesh->position_m[i][1], mesh->position_m[i][2] };
        mat3_mul_vec(p, by, p);
        for (int k = 0; k < 3; k++)
            mesh->position_m[i][k] = (float)p[k];
    }
}

static void frames_that_differ_are_found_out_and_named(void **state)
{
    (void)state;
    static const struct {
        double mesh[9]; // what was done to it
        int err;
        const char *says;
    } cases[] = {
        { { 1, 0, 0, 0, 1, 0, 0, 0, 1 }, 0, NULL },
        { { 1, 0, 0, 0, 0, 1, 0, -1, 0 }, 0, "as (x, -z, y)" }, // z up became y up: turned back
        { { 1, 0, 0, 0, 0, -1, 0, 1, 0 }, 0, "as (x, z, -y)" },
        { { -1, 0, 0, 0, 1, 0, 0, 0, 1 }, -EDOM, "the mesh is mirrored" },
        { { 1, 0, 0, 0, 1, 0, 0, 0, -1 }, -EDOM, "the mesh is mirrored" },
        { { 1000, 0, 0, 0, 1000, 0, 0, 0, 1000 }, -EDOM, "it should be 1000 x smaller" },
        { { .01, 0, 0, 0, .01, 0, 0, 0, .01 }, -EDOM, "it should be 100 x larger" },
        { { 1 / .0254, 0, 0, 0, 1 / .0254, 0, 0, 0, 1 / .0254 }, -EDOM, "inches" },
        { { 0, 0, -1, 0, -1, 0, -1, 0, 0 }, -EDOM, "different scenes" },
    };
    struct mesh mesh;
    struct camera views[24];
    struct cameras c, back;
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        make_studio(&mesh, &c, views);
        change_mesh(&mesh, cases[i].mesh);
        assert_int_equal(cameras_write_colmap_binary(&c, scratch_dir), 0);
        logged[0] = warned[0] = 0;
        const int err = cameras_read_for_mesh(&back, scratch_dir, NULL, &mesh, "mesh.obj");
        if (err != cases[i].err || (cases[i].says && !strstr(err ? logged : warned, cases[i].says)))
            fail_msg("case %zu: %d, says: %s%s", i, err, logged, warned);
        if (err) { // the hit rate of every hypothesis
            struct cameras_trial trials[CAMERAS_N_TRIALS];
            cameras_try_frames(trials, &c, &mesh);
            for (int k = 0; k < CAMERAS_N_TRIALS; k++) {
                char rate[96];
                snprintf(rate, sizeof(rate), "%s %.1f%%", trials[k].name, 100 * trials[k].hit_rate);
                assert_non_null(strstr(logged, rate));
            }
            assert_true(strstr(logged, "mesh.obj") && !back.view);
        } else { // where the camera sees a vertex of the mesh, it saw the unchanged one
            struct mesh unchanged;
            make_studio(&unchanged, &c, views);
            assert_int_equal(back.n, 24);
            for (int k = 0; k < 24; k++)
                for (int v = 0; v < mesh.n_vertices; v += 97) {
                    const double p[3] = { mesh.position_m[v][0], mesh.position_m[v][1], mesh.position_m[v][2] };
                    const double q[3] = { unchanged.position_m[v][0], unchanged.position_m[v][1], unchanged.position_m[v][2] };
                    double a[2], b[2], R[3];
                    assert_true(camera_project(&back.view[k], p, a, NULL) && camera_project(&views[k], q, b, NULL));
                    assert_true(hypot(a[0] - b[0], a[1] - b[1]) < 1e-3); // the mesh is in floats
                    mat3_mul_vec(R, back.view[k].cam_from_world, back.view[k].centre_m);
                    for (int j = 0; j < 3; j++)
                        assert_true(fabs(R[j] + back.view[k].t_m[j]) < 1e-12);
                }
            mesh_free(&unchanged);
            cameras_free(&back);
        }
        mesh_free(&mesh);
        scratch_empty();
    }
}

static void close_ups_are_no_mismatch(void **state)
{
    (void)state;
    struct mesh mesh;
    struct camera views[24];
    struct cameras c, back;
    make_studio(&mesh, &c, views);
    for (int i = 0; i < 24; i++)
        views[i].fx = views[i].fy = 5000; // a fifth of the object a picture
    struct cameras_trial trials[CAMERAS_N_TRIALS];
    cameras_try_frames(trials, &c, &mesh);
    assert_true(trials[0].hit_rate > .05 && trials[0].hit_rate < .4);
    assert_int_equal(cameras_write_colmap_binary(&c, scratch_dir), 0);
    assert_int_equal(cameras_read_for_mesh(&back, scratch_dir, NULL, &mesh, "mesh.obj"), 0);
    cameras_free(&back);
    mesh_free(&mesh);
    scratch_empty();
}

// Pictures of a painted knot around the origin: mirrored, it is hit just as well, but is another knot.
static void a_mirrored_mesh_in_the_same_place_is_found_by_its_pictures(void **state)
{
    (void)state;
    enum { N = 10 };
    const double middle[3] = { 0, 0, 0 }, up[3] = { 0, 0, 1 };
    struct camera views[N];
    const struct cameras c = { N, views };
    char *pictures[N];
    struct mesh mesh;
    struct rays *rays;
    assert_int_equal(shape_make(&mesh, SHAPE_KNOT, middle, .4, 6000), 0);
    assert_int_equal(rays_new(&rays, &mesh), 0);
    for (int i = 0; i < N; i++) {
        const double a = 2 * M_PI * i / N, centre[3] = { 1.5 * cos(a), 1.5 * sin(a), .9 * (i % 3 - 1) };
        struct image image;
        char name[32];
        views[i] = (struct camera){ .width_px = 120, .height_px = 90, .fx = 160, .fy = 160, .cx = 60, .cy = 45 };
        camera_look_at(&views[i], centre, middle, up);
        assert_int_equal(image_new(&image, 120, 90, 3, NULL), 0);
        for (int k = 0; k < 120 * 90; k++) {
            const double uv[2] = { k % 120 + .5, k / 120 + .5 };
            const float from[3] = { (float)centre[0], (float)centre[1], (float)centre[2] };
            double d[3];
            struct ray_hit hit;
            float value = .01f;
            assert_true(camera_ray(&views[i], uv, d));
            const float dir[3] = { (float)d[0], (float)d[1], (float)d[2] };
            if (rays_hit(rays, from, dir, 0, 10, &hit)) {
                double p[3];
                vec3_add_scaled(p, centre, hit.t, d);
                value = (float)(.5 + .4 * sin(9 * p[0] + 1) * sin(11 * p[1] + 2) * cos(7 * p[2] - 1));
            }
            for (int ch = 0; ch < 3; ch++)
                image.data[3 * k + ch] = value;
        }
        snprintf(name, sizeof(name), "p%d.exr", i);
        pictures[i] = strdup(scratch_path(name));
        assert_int_equal(image_write_exr(&image, pictures[i], IMAGE_FLOAT, IMAGE_ZIP), 0);
        image_free(&image);
    }
    for (int mirrored = 0; mirrored < 2; mirrored++) {
        double agreement[CAMERAS_N_AGREEMENTS];
        if (mirrored) {
            static const double flip[9] = { 1, 0, 0, 0, -1, 0, 0, 0, 1 };
            change_mesh(&mesh, flip);
            for (int i = 0; i < mesh.n_vertices; i++)
                mesh.normal[i][1] = -mesh.normal[i][1];
            for (int i = 0; i < mesh.n_triangles; i++) { // the outside stays outside
                const uint32_t swap = mesh.triangle[i][0];
                mesh.triangle[i][0] = mesh.triangle[i][1], mesh.triangle[i][1] = swap;
            }
            rays_free(rays);
            assert_int_equal(rays_new(&rays, &mesh), 0);
            struct cameras_trial trials[CAMERAS_N_TRIALS]; // hits alone do not tell
            cameras_try_frames(trials, &c, &mesh);
            assert_true(trials[0].hit_rate == 1 && trials[5].hit_rate == 1);
        }
        warned[0] = 0;
        assert_int_equal(cameras_check_pictures(&c, &mesh, rays, pictures, "cameras", "mesh.obj"), 0);
        assert_int_equal(!!strstr(warned, "if it is mirrored (x, -y, z): it was mirrored on export"), mirrored);
        assert_int_equal(!!warned[0], mirrored);
        assert_int_equal(cameras_measure_agreement(agreement, &c, &mesh, rays, pictures), 0);
        if (!(agreement[5 * mirrored] > .8) || (mirrored && !(agreement[0] < .5)))
            fail_msg("mirrored %d: %g as it is, %g mirrored", mirrored, agreement[0], agreement[5]);
    }
    for (int i = 0; i < N; i++)
        free(pictures[i]);
    rays_free(rays);
    mesh_free(&mesh);
    scratch_empty();
}

// Metashape exports the mesh in the world, or in the chunk's own frame: the cameras follow.
static void metashapes_transform_is_taken_or_left_by_test(void **state)
{
    (void)state;
    struct mesh mesh;
    struct camera views[24];
    struct cameras c, back;
    struct text t;
    make_studio(&mesh, &c, views);
    put_metashape(text_open(&t), &c, &tilted);
    text_save(&t, "scan.xml");
    noted[0] = 0;
    assert_int_equal(cameras_read_for_mesh(&back, scratch_dir, NULL, &mesh, "mesh.obj"), 0);
    assert_non_null(strstr(noted, "taken with the chunk's transform"));
    for (int i = 0; i < 24; i++)
        for (int k = 0; k < 3; k++)
            assert_true(fabs(cameras_find(&back, views[i].name)->centre_m[k] - views[i].centre_m[k]) < 1e-12);
    cameras_free(&back);
    for (int i = 0; i < mesh.n_vertices; i++) { // into the chunk
        double p[3];
        for (int k = 0; k < 3; k++)
            p[k] = mesh.position_m[i][k] - tilted.translation[k];
        mat3_tmul_vec(p, tilted.rotation, p);
        for (int k = 0; k < 3; k++)
            mesh.position_m[i][k] = (float)(p[k] / tilted.scale);
    }
    assert_int_equal(cameras_read_for_mesh(&back, scratch_dir, NULL, &mesh, "mesh.obj"), 0);
    assert_non_null(strstr(noted, "taken without the chunk's transform"));
    const struct camera *first = cameras_find(&back, "view0");
    double p[3];
    vec3_sub(p, views[0].centre_m, tilted.translation);
    mat3_tmul_vec(p, tilted.rotation, p);
    for (int k = 0; k < 3; k++)
        assert_true(fabs(first->centre_m[k] - p[k] / tilted.scale) < 1e-12);
    cameras_free(&back);
    mesh_free(&mesh);
    scratch_empty();
}

// ---- real files ---------------------------------------------------------------------------------------------------------

static int size_of_sceaux(void *arg, const char *name, int *width_px, int *height_px)
{
    const struct cameras *colmap = arg;
    const struct camera *same = cameras_find(colmap, name);
    if (!same)
        return -ENOENT;
    *width_px = same->width_px, *height_px = same->height_px;
    return 0;
}

// Bundler's own observations of its own points, as the file has them: from the picture's middle, y up.
static void check_residuals(const struct cameras *c, const char *bundle, const char *list)
{
    char *text, *names;
    size_t n, n_names;
    assert_int_equal(file_read(&text, &n, bundle, 1 << 24), 0);
    assert_int_equal(file_read(&names, &n_names, list, 1 << 16), 0);
    const struct camera *view[16];
    int n_views = 0;
    for (char *name = strtok(names, "\n"); name; name = strtok(NULL, "\n")) {
        struct camera stem;
        assert_int_equal(camera_set_name(&stem, name, strlen(name)), 0);
        view[n_views++] = cameras_find(c, stem.name);
    }
    char *at = text;
    for (int i = 0; i < 2 + 5 * n_views; i++)
        at = strchr(at, '\n') + 1;
    double sum[2] = { 0, 0 }, square = 0;
    int n_seen = 0;
    while (*at) {
        double p[3], rgb[3], key[2];
        int n_keys, used;
        if (sscanf(at, "%lf %lf %lf %lf %lf %lf %d%n", &p[0], &p[1], &p[2], &rgb[0], &rgb[1], &rgb[2], &n_keys, &used) != 7)
            break;
        for (at += used; n_keys > 0; n_keys--, at += used) {
            int camera, feature;
            double uv[2];
            assert_int_equal(sscanf(at, "%d %d %lf %lf%n", &camera, &feature, &key[0], &key[1], &used), 4);
            const struct camera *v = view[camera];
            assert_true(camera_project(v, p, uv, NULL));
            const double e[2] = { .5 * v->width_px + key[0] - uv[0], .5 * v->height_px - key[1] - uv[1] };
            sum[0] += e[0], sum[1] += e[1], square += e[0] * e[0] + e[1] * e[1];
            n_seen++;
        }
        at += strspn(at, " \r\n");
    }
    fprintf(stderr, "test_cameras_import: Bundler's %d observations: RMS %.3f px, mean (%.4f, %.4f) px\n", n_seen, sqrt(square / n_seen),
            sum[0] / n_seen, sum[1] / n_seen);
    assert_true(n_seen > 20000);
    assert_true(sqrt(square / n_seen) < 1.5);
    assert_true(fabs(sum[0] / n_seen) < .1 && fabs(sum[1] / n_seen) < .1); // half a pixel off would show
    free(text);
    free(names);
}

static void files_of_real_tools_are_read(void **state)
{
    (void)state;
    const char *const data = "../shared/data/cameras";
    char path[512], list[512];
    struct cameras colmap, bundler, metashape;
    if (access(data, F_OK)) {
        fprintf(stderr, "test_cameras_import: no %s here: real files are not tried\n", data);
        return;
    }
    snprintf(path, sizeof(path), "%s/colmap_bin", data);
    assert_int_equal(cameras_read(&colmap, path), 0);
    const struct cameras_options sizes = { .picture_size = size_of_sceaux, .arg = &colmap };
    snprintf(path, sizeof(path), "%s/bundler/sceaux.bundle.out", data);
    assert_int_equal(cameras_read_with(&bundler, path, &sizes), 0);
    assert_int_equal(bundler.n, 11);
    double scale = 0, worst = 0;
    for (int i = 0; i < 11; i++)
        for (int k = 0; k < i; k++) {
            double a[3], b[3];
            vec3_sub(a, colmap.view[i].centre_m, colmap.view[k].centre_m);
            vec3_sub(b, cameras_find(&bundler, colmap.view[i].name)->centre_m, cameras_find(&bundler, colmap.view[k].name)->centre_m);
            const double ratio = vec3_norm(b) / vec3_norm(a);
            scale = scale > 0 ? scale : ratio;
            worst = fmax(worst, fabs(ratio / scale - 1));
        }
    fprintf(stderr, "test_cameras_import: Bundler's camera distances against COLMAP's: %.2g\n", worst);
    assert_true(worst < 1e-12);
    snprintf(list, sizeof(list), "%s/bundler/sceaux.list.txt", data);
    check_residuals(&bundler, path, list);
    cameras_free(&bundler);
    cameras_free(&colmap);

    snprintf(path, sizeof(path), "%s/metashape", data); // the folder: its one camera file, whatever else lies there
    warned[0] = 0;
    assert_int_equal(cameras_read(&metashape, path), 0);
    assert_int_equal(metashape.n, 1);
    assert_non_null(strstr(warned, "Earth-centred"));
    const struct camera *v = &metashape.view[0];
    assert_string_equal(v->name, "000001-01_00001");
    assert_true(v->width_px == 5280 && v->height_px == 3956 && v->fy == 3705.4728792737214 && v->fx == 3705.4728792737214 + .5262024073);
    assert_true(v->skew == -.3058334293 && v->cx == 2640 + 11.6738523909 && v->k[3] == -.0761413904);
    assert_true(v->p[0] == .0001164035 && v->p[1] == -.0003134847);
    // scale x rotation x (7.04.., 7.05.., .43..) + translation, with the file's numbers
    const double centre[3] = { -2499366.429888 + 12.354192447331316 * (.8710699454 * 7.04224697 + .3070967021 * 7.05403071 - .3833128821 * .43561421),
                               -4256836.520906 + 12.354192447331316 * (-.4909742007 * 7.04224697 + .5658364395 * 7.05403071 - .6623997719 * .43561421),
                               4029217.965003 + 12.354192447331316 * (.0134716110 * 7.04224697 + .7651932691 * 7.05403071 + .6436596744 * .43561421) };
    for (int i = 0; i < 3; i++)
        assert_true(fabs(v->centre_m[i] - centre[i]) < 1e-5);
    // It looks down from a drone: the middle of its picture points away from the zenith, which here is away from the Earth's centre.
    const double middle[2] = { 2640, 1978 };
    double d[3];
    assert_true(camera_ray(v, middle, d));
    assert_true(-vec3_dot(d, v->centre_m) / vec3_norm(v->centre_m) > .99);
    cameras_free(&metashape);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(metashape_keeps_every_lens),
        cmocka_unit_test(realitycapture_keeps_every_lens_it_has),
        cmocka_unit_test(meshroom_keeps_every_lens_it_has_in_every_version),
        cmocka_unit_test(bundler_keeps_every_lens_it_has),
        cmocka_unit_test(one_rig_through_all_formats_gives_the_same_pixels),
        cmocka_unit_test(a_rendered_square_lies_where_every_format_says),
        cmocka_unit_test(realitycapture_angles_mean_what_a_compass_says),
        cmocka_unit_test(what_is_not_read_is_refused_by_name),
        cmocka_unit_test(their_sound_neighbours_are_read),
        cmocka_unit_test(views_without_a_picture_are_left_out_where_the_file_has_no_sizes),
        cmocka_unit_test(cut_files_never_give_other_cameras),
        cmocka_unit_test(xml_bombs_are_refused),
        cmocka_unit_test(headers_of_pictures_tell_their_size),
        cmocka_unit_test(frames_that_differ_are_found_out_and_named),
        cmocka_unit_test(close_ups_are_no_mismatch),
        cmocka_unit_test(a_mirrored_mesh_in_the_same_place_is_found_by_its_pictures),
        cmocka_unit_test(metashapes_transform_is_taken_or_left_by_test),
        cmocka_unit_test(files_of_real_tools_are_read),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
