// tests/test_synth.c - a synthetic studio says one thing: lights, panorama, panels, mesh, cameras
// and pictures agree; it is whole or not there; and the same bytes come from any number of threads.
#include "solver/synth.h"
#include "solver/panorama.h"
#include "solver/shapes.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/take/take.h"
#include "solver/texels.h"
#include "solver/vec3.h"
#include "tests/truth.h"

#include <dirent.h>
#include <errno.h>
#include <ftw.h>
#include <math.h>
#include <setjmp.h>
#include <signal.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <cmocka.h>

static char dir[256]; // fresh for every test

static int remove_one(const char *path, const struct stat *st, int kind, struct FTW *at)
{
    (void)st, (void)kind, (void)at;
    return remove(path);
}

static int set_up(void **state)
{
    (void)state;
    const char *tmp = getenv("TMPDIR");
    snprintf(dir, sizeof(dir), "%s/studiorig-test-XXXXXX", tmp && *tmp ? tmp : "/tmp");
    return mkdtemp(dir) ? 0 : -1;
}

static int tear_down(void **state)
{
    (void)state;
    log_set_level(LOG_INFO);
    return nftw(dir, remove_one, 16, FTW_DEPTH | FTW_PHYS);
}

static struct synth_settings small(int data_set)
{
    struct synth_settings s = synth_defaults(data_set);
    s.n_true_lights = 300;
    s.width_px = 48, s.height_px = 32;
    s.n_views = 3;
    s.samples = 1;
    s.panorama_width_px = 256;
    s.texture_size = 48;
    s.final_float = true;
    return s;
}

static const char *in_dir(char path[PATH_MAX], const char *name)
{
    return truth_path(path, dir, name);
}

static void make(const struct synth_settings *s, const char *name)
{
    char path[PATH_MAX];
    assert_int_equal(synth_write(s, in_dir(path, name)), 0);
}

static void read_panorama(struct image *out, const char *name)
{
    char path[PATH_MAX];
    assert_int_equal(image_read(out, in_dir(path, name)), 0);
}

static void read_lights(struct lights *out, const char *name)
{
    char path[PATH_MAX];
    assert_int_equal(lights_read_json(out, in_dir(path, name)), 0);
}

// ---- light --------------------------------------------------------------------------------------

// Every light is one pixel of the panorama; every other pixel is black.
static void check_panorama(const struct image *panorama, const struct lights *lights)
{
    const int width = panorama->width, height = panorama->height;
    int n_bright = 0;
    for (int64_t i = 0; i < (int64_t)width * height; i++)
        n_bright += panorama->data[3 * i] > 0;
    assert_int_equal(n_bright, lights->n); // so no two share a pixel, as each finds its own below
    for (int i = 0; i < lights->n; i++) {
        double x, y, centre[3];
        panorama_pixel(width, height, lights->dir_probe[i], &x, &y);
        panorama_direction(width, height, floor(x) + .5, floor(y) + .5, centre);
        for (int k = 0; k < 3; k++)
            assert_true(fabs(lights->dir_probe[i][k] - centre[k]) < 1e-12);
        const float *pixel = panorama->data + 3 * ((int64_t)floor(y) * width + (int64_t)floor(x));
        for (int c = 0; c < 3; c++) {
            const double C = pixel[c] * panorama_solid_angle(width, height, (int)floor(y));
            assert_true(fabs(lights->irradiance[i][c] - C) <= 1e-12 * C);
        }
    }
}

static void lights_and_panorama_say_the_same(void **state)
{
    (void)state;
    struct image panorama;
    struct lights lights;
    struct synth_settings s = small(2);
    s.n_views = 1;
    s.n_true_lights = 2000; // crowded: 16 pixels a light, so neighbours must be found
    make(&s, "take");
    read_panorama(&panorama, "take/panorama.exr");
    read_lights(&lights, "take/truth/lights.json");
    assert_int_equal(lights.n, 2000);
    check_panorama(&panorama, &lights);
    image_free(&panorama), lights_free(&lights);
    read_panorama(&panorama, "take/relit/panorama.exr");
    read_lights(&lights, "take/relit/lights.json");
    check_panorama(&panorama, &lights);
    image_free(&panorama), lights_free(&lights);
}

// What panels.json says a place on the cuboid shines: the first panel it lies on.
static int panel_at(const struct json *panels, const double x[3], double radiance[3],
                    double normal[3])
{
    const int n = json_length(panels, "panels");
    for (int k = 0; k < n; k++) {
        char key[64];
        double corner[12], side[2][3], away[3], at[2];
        snprintf(key, sizeof(key), "panels.%d.corners", k);
        assert_int_equal(json_get_numbers(panels, key, corner, 12), 0);
        vec3_sub(side[0], corner + 3, corner);
        vec3_sub(side[1], corner + 9, corner);
        vec3_cross(normal, side[0], side[1]);
        vec3_normalise(normal);
        vec3_sub(away, x, corner);
        for (int i = 0; i < 2; i++)
            at[i] = vec3_dot(away, side[i]) / vec3_dot(side[i], side[i]);
        if (fabs(vec3_dot(away, normal)) > 1e-9 || fmin(at[0], at[1]) < -1e-9 ||
            fmax(at[0], at[1]) > 1 + 1e-9)
            continue;
        snprintf(key, sizeof(key), "panels.%d.radiance_rgb", k);
        assert_int_equal(json_get_numbers(panels, key, radiance, 3), 0);
        return k;
    }
    fail_msg("a light at %g %g %g lies on no wall", x[0], x[1], x[2]);
    return -1;
}

// C_i = radiance x cell area x cosine / r^2, the cells of a wall being equal: so on every wall the
// area that each light stands for is the same, and all areas add up to the cuboid's 31.68 m^2.
static void lights_stand_for_equal_areas_of_the_walls(void **state)
{
    (void)state;
    char path[PATH_MAX];
    struct lights lights;
    struct json *panels;
    struct synth_settings s = small(3);
    s.n_views = 1;
    s.n_true_lights = 2000;
    s.panorama_width_px = 512;
    make(&s, "take");
    read_lights(&lights, "take/truth/lights.json");
    assert_int_equal(json_read(&panels, in_dir(path, "take/truth/panels.json")), 0);
    double total_m2 = 0, panels_m2 = 0, brightness = 0;
    for (int i = 0; i < lights.n; i++) {
        double d[3], x[3], radiance[3] = {0}, normal[3] = {0};
        const double r = 1 / lights.inverse_distance[i];
        mat3_mul_vec(d, lights.world_from_probe, lights.dir_probe[i]);
        vec3_add_scaled(x, lights.centre_m, r, d);
        const int panel = panel_at(panels, x, radiance, normal);
        assert_int_equal(lights.group[i], panel < 4 ? panel : -1);
        const double cosine = -vec3_dot(d, normal);
        assert_true(cosine > 0); // the front looks inside
        const double area_m2 = lights.irradiance[i][0] * r * r / (cosine * radiance[0]);
        assert_float_equal(area_m2, 31.68 / lights.n, .03 * 31.68 / lights.n);
        for (int c = 1; c < 3; c++)
            assert_float_equal(lights.irradiance[i][c] / radiance[c],
                               lights.irradiance[i][0] / radiance[0],
                               1e-6 * lights.irradiance[i][0] / radiance[0]);
        total_m2 += area_m2;
        panels_m2 += panel < 4 ? area_m2 : 0;
        brightness += .2126 * lights.irradiance[i][0] + .7152 * lights.irradiance[i][1] +
                      .0722 * lights.irradiance[i][2];
    }
    // a light that snaps over an edge takes its cell along
    assert_float_equal(total_m2, 31.68, .1);
    // about 110 cells lie across the panels' borders, in or out by chance: 4 standard deviations
    assert_float_equal(panels_m2, 2.74, .3);
    assert_float_equal(brightness / 4 * .5 / M_PI, .25, 1e-6);
    json_free(panels);
    lights_free(&lights);
}

static void variants_of_the_light_are_what_they_are_called(void **state)
{
    (void)state;
    struct image panorama;
    struct lights lights;
    struct synth_settings s = small(1);
    s.n_views = 1;
    s.one_panel_missing_from_panorama = true;
    make(&s, "missing");
    read_panorama(&panorama, "missing/panorama.exr");
    read_lights(&lights, "missing/truth/lights.json");
    int n_missing = 0;
    for (int i = 0; i < lights.n; i++) {
        double x, y;
        panorama_pixel(256, 128, lights.dir_probe[i], &x, &y);
        const bool black = panorama.data[3 * ((int64_t)floor(y) * 256 + (int64_t)floor(x))] == 0;
        assert_true(black == (lights.group[i] == 1));
        assert_true(lights.irradiance[i][0] > 0); // it still shines
        n_missing += black;
    }
    assert_true(n_missing > 0);
    image_free(&panorama), lights_free(&lights);

    s = small(1);
    s.n_views = 1;
    s.directional = true;
    make(&s, "directional");
    read_lights(&lights, "directional/truth/lights.json");
    for (int i = 0; i < lights.n; i++)
        assert_true(lights.inverse_distance[i] == 0);
    lights_free(&lights);

    s = small(1);
    s.n_views = 1;
    s.uniform_cuboid = true;
    make(&s, "uniform");
    read_lights(&lights, "uniform/truth/lights.json");
    for (int i = 0; i < lights.n; i++) {
        assert_int_equal(lights.group[i], -1);
        assert_true(lights.irradiance[i][0] == lights.irradiance[i][1]);
    }
    lights_free(&lights);
}

// ---- the take -----------------------------------------------------------------------------------

static double turn_deg(const double a[9], const double b[9])
{
    double trace = 0;
    for (int i = 0; i < 9; i++)
        trace += a[i] * b[i];
    return acos(fmin((trace - 1) / 2, 1)) * 180 / M_PI;
}

static void every_data_set_is_a_take_with_a_start_and_a_truth(void **state)
{
    (void)state;
    for (int data_set = 1; data_set <= 5; data_set++) {
        char name[32], path[PATH_MAX];
        struct synth_settings s = small(data_set);
        struct take *take;
        struct json *start, *probe;
        struct truth truth;
        struct mesh_check check;
        double rough[9], exact[9], centre_m[3], away[3];
        s.n_views = 5, s.seed = (uint64_t)data_set;
        snprintf(name, sizeof(name), "D%d", data_set);
        make(&s, name);
        assert_int_equal(take_open(&take, in_dir(path, name)), 0);
        assert_int_equal(
            take_require(take, TAKE_MESH | TAKE_CAMERAS | TAKE_PANORAMA | TAKE_VIEWS | TAKE_START),
            0);
        assert_int_equal(take->n_views, 5);
        assert_int_equal(json_read(&start, take->start_path), 0);
        assert_int_equal(json_get_numbers(start, "world_from_probe", rough, 9), 0);
        assert_null(json_get(start, "centre_m")); // the solver must find it
        take_close(take);

        assert_int_equal(truth_open(&truth, in_dir(path, name)), 0);
        char file[PATH_MAX];
        snprintf(file, sizeof(file), "%s/D%d/truth/probe.json", dir, data_set);
        assert_int_equal(json_read(&probe, file), 0);
        assert_int_equal(json_get_numbers(probe, "world_from_probe", exact, 9), 0);
        assert_int_equal(json_get_numbers(probe, "centre_m", centre_m, 3), 0);
        assert_true(turn_deg(rough, exact) > 1.9 && turn_deg(rough, exact) < 10.1);
        for (int k = 0; k < 9; k++) // lights.json tells both by where the lights are
            assert_true(fabs(exact[k] - truth.lights.world_from_probe[k]) < 1e-14);
        for (int k = 0; k < 3; k++)
            assert_true(fabs(centre_m[k] - truth.lights.centre_m[k]) < 1e-12);
        for (int k = 0; k < 3; k++)
            away[k] = (truth.mesh.bounds_m[0][k] + truth.mesh.bounds_m[1][k]) / 2 - centre_m[k];
        assert_float_equal(vec3_norm(away), data_set == 1 ? 0 : sqrt(.35 * .35 + .25 * .25 + .01),
                           1e-5);
        assert_true(truth.mesh.bounds_m[0][2] > .6 && truth.mesh.bounds_m[1][2] < 1.8);
        mesh_check_run(&truth.mesh, &check);
        assert_int_equal(check.n_boundary_edges + check.n_mirrored_uv + check.n_zero_area_uv, 0);
        assert_true(check.overlap_fraction == 0);
        assert_true((truth.parameters.data != NULL) == (data_set >= 3));
        for (int i = 0; i < truth.cameras.n; i++) { // all look at the object from 1.8 m
            double uv[2], depth_m, middle[3];
            vec3_add_scaled(middle, centre_m, 1, away);
            assert_true(camera_project(&truth.cameras.view[i], middle, uv, &depth_m));
            assert_float_equal(depth_m, 1.8, 1e-4);
            assert_true(fabs(uv[0] - 24) < 1 && fabs(uv[1] - 16) < 1);
        }
        json_free(start), json_free(probe);
        truth_close(&truth);
    }
}

// Through files and back: OBJ, COLMAP, JSON, EXR.
static void rendering_the_truth_gives_the_views(void **state)
{
    (void)state;
    for (int data_set = 2; data_set <= 5; data_set++) {
        char name[32], path[PATH_MAX], file[PATH_MAX];
        struct synth_settings s = small(data_set);
        struct truth truth;
        struct renderer *renderer;
        s.samples = 2;
        snprintf(name, sizeof(name), "D%d", data_set);
        make(&s, name);
        assert_int_equal(truth_open(&truth, in_dir(path, name)), 0);
        assert_int_equal(renderer_new(&renderer, &truth.mesh, truth.rays, &truth.lights,
                                      &truth.material, &truth.settings),
                         0);
        double squares = 0, sum = 0;
        int n = 0, n_far = 0;
        for (int i = 0; i < truth.cameras.n; i++) {
            struct image again, written;
            snprintf(file, sizeof(file), "%s/D%d/linear/%s.exr", dir, data_set,
                     truth.cameras.view[i].name);
            assert_int_equal(image_read(&written, file), 0);
            assert_int_equal(render_view(renderer, &truth.cameras.view[i], &again), 0);
            assert_int_equal(image_channel(&written, "clip"), 3);
            for (int64_t k = 0; k < 48 * 32; k++) {
                for (int c = 0; c < 3; c++) {
                    const double difference =
                        fmin(again.data[4 * k + c], 1) - written.data[4 * k + c];
                    squares += difference * difference;
                    sum += written.data[4 * k + c];
                    n_far += fabs(difference) > 1e-3;
                    n += again.data[4 * k + 3] > 0;
                }
            }
            image_free(&again), image_free(&written);
        }
        // a ray at a silhouette or at a border of materials may end on the other side
        assert_true(n > 1000 && sum / n > .02);
        assert_true(sqrt(squares / n) < 2e-3 && n_far < n / 100);
        renderer_free(renderer);
        truth_close(&truth);
    }
}

// ---- pictures -----------------------------------------------------------------------------------

static void noise_has_its_size_and_the_camera_clips_at_one(void **state)
{
    (void)state;
    enum { N = 96 * 64 };
    char path[PATH_MAX];
    struct image clean, noisy, other;
    struct synth_settings s = small(3);
    s.width_px = 96, s.height_px = 64, s.n_views = 2;
    make(&s, "clean");
    s.noise = .05;
    make(&s, "noisy");
    s.final_float = false;
    make(&s, "half");
    assert_int_equal(image_read(&clean, in_dir(path, "clean/linear/cam000.exr")), 0);
    assert_int_equal(image_read(&noisy, in_dir(path, "noisy/linear/cam000.exr")), 0);
    assert_int_equal(image_read(&other, in_dir(path, "noisy/linear/cam001.exr")), 0);
    double sum = 0, squares = 0, between = 0;
    int n = 0, n_negative = 0;
    for (int i = 0; i < N; i++) {
        for (int c = 0; c < 3; c++) {
            const double d = noisy.data[4 * i + c] - clean.data[4 * i + c];
            assert_true(noisy.data[4 * i + c] <= 1 && clean.data[4 * i + c] >= 0);
            if (noisy.data[4 * i + 3] > 0)
                continue;
            sum += d, squares += d * d, n++;
            n_negative += noisy.data[4 * i + c] < 0;
            if (clean.data[4 * i + c] == 0 && other.data[4 * i + c] != 0)
                between += d * other.data[4 * i + c];
        }
        const float *p = noisy.data + 4 * i;
        assert_true((p[3] == 1) == (p[0] == 1 || p[1] == 1 || p[2] == 1));
    }
    assert_float_equal(sqrt(squares / n), .05, .002); // n = 18,000: 4 standard errors are .001
    assert_float_equal(sum / n, 0, .0016);
    assert_true(n_negative > n / 8);
    assert_float_equal(between / n, 0, 5 * .05 * .05 / sqrt(n)); // views do not share their noise
    image_free(&other);
    assert_int_equal(image_read(&other, in_dir(path, "half/linear/cam000.exr")), 0);
    for (int i = 0; i < 4 * N; i++)
        assert_float_equal(other.data[i], noisy.data[i], 1e-3 * fabs(noisy.data[i]) + 1e-6);
    image_free(&clean), image_free(&noisy), image_free(&other);
}

static void bright_studios_clip_and_say_where(void **state)
{
    (void)state;
    char path[PATH_MAX];
    struct image image;
    struct json *report;
    struct synth_settings s = small(1);
    double percent;
    int n_clipped = 0;
    s.n_views = 1;
    s.noise = .5;
    make(&s, "take");
    assert_int_equal(image_read(&image, in_dir(path, "take/linear/cam000.exr")), 0);
    for (int i = 0; i < 48 * 32; i++)
        n_clipped += image.data[4 * i + 3] == 1;
    assert_true(n_clipped > 50);
    assert_int_equal(json_read(&report, in_dir(path, "take/truth/report.json")), 0);
    assert_int_equal(json_get_number(report, "clipped_percent", &percent), 0);
    assert_true(percent > 5 && percent < 90);
    json_free(report);
    image_free(&image);
}

// ---- whole or not there -------------------------------------------------------------------------

static void compare_files(const char *a, const char *b)
{
    char *left, *right;
    size_t n_left, n_right;
    assert_int_equal(file_read(&left, &n_left, a, 1 << 30), 0);
    assert_int_equal(file_read(&right, &n_right, b, 1 << 30), 0);
    if (n_left != n_right || memcmp(left, right, n_left))
        fail_msg("%s and %s differ", a, b);
    free(left), free(right);
}

// Every file of a is in b with the same bytes; how many there are.
static int compare_folders(const char *a, const char *b)
{
    DIR *stream = opendir(a);
    int n = 0;
    assert_non_null(stream);
    for (const struct dirent *e; (e = readdir(stream));) {
        char left[PATH_MAX], right[PATH_MAX];
        struct stat st;
        if (!strcmp(e->d_name, ".") || !strcmp(e->d_name, ".."))
            continue;
        assert_int_equal(stat(truth_path(left, a, e->d_name), &st), 0);
        truth_path(right, b, e->d_name);
        if (S_ISDIR(st.st_mode)) {
            n += compare_folders(left, right);
        } else {
            compare_files(left, right);
            n++;
        }
    }
    closedir(stream);
    return n;
}

static void the_same_seed_gives_the_same_bytes_with_any_threads(void **state)
{
    (void)state;
    char one[PATH_MAX], three[PATH_MAX], path[PATH_MAX];
    struct lights a, b;
    for (int data_set = 4; data_set <= 5; data_set++) {
        struct synth_settings s = small(data_set);
        char name[32];
        s.noise = .01;
        s.n_threads = 1;
        snprintf(name, sizeof(name), "one%d", data_set);
        make(&s, name);
        in_dir(one, name);
        s.n_threads = 3;
        snprintf(name, sizeof(name), "three%d", data_set);
        make(&s, name);
        in_dir(three, name);
        assert_int_equal(compare_folders(one, three), compare_folders(three, one));
        assert_true(compare_folders(one, three) > 30);
    }
    struct synth_settings s = small(4);
    s.seed = 2;
    make(&s, "other");
    assert_int_equal(lights_read_json(&a, in_dir(path, "one4/truth/lights.json")), 0);
    assert_int_equal(lights_read_json(&b, in_dir(path, "other/truth/lights.json")), 0);
    int n_same = 0;
    for (int i = 0; i < a.n; i++)
        n_same += !memcmp(a.dir_probe[i], b.dir_probe[i], sizeof(a.dir_probe[i]));
    assert_true(n_same < a.n / 10);
    lights_free(&a), lights_free(&b);
}

static int count_entries(const char *path)
{
    DIR *stream = opendir(path);
    int n = -2;
    assert_non_null(stream);
    while (readdir(stream))
        n++;
    closedir(stream);
    return n;
}

static void a_folder_in_use_is_refused_and_kept(void **state)
{
    (void)state;
    char path[PATH_MAX], file[PATH_MAX];
    struct synth_settings s = small(1);
    s.n_views = 1;
    log_set_level(LOG_SILENT);
    assert_int_equal(mkdir(in_dir(path, "used"), 0777), 0);
    FILE *f = fopen(in_dir(file, "used/mine"), "w");
    assert_non_null(f);
    fclose(f);
    assert_int_equal(synth_write(&s, path), -ENOTEMPTY);
    assert_int_equal(count_entries(path), 1);
    assert_int_equal(synth_write(&s, file), -ENOTDIR);
    assert_int_equal(count_entries(dir), 1);
    assert_int_equal(mkdir(in_dir(path, "empty"), 0777), 0);
    assert_int_equal(synth_write(&s, path), 0); // an empty one is as good as none
    assert_int_equal(synth_write(&s, in_dir(path, "new/parents/take//")), 0);
    assert_int_equal(count_entries(in_dir(path, "new/parents")), 1);
}

static void a_studio_that_cannot_be_written_leaves_nothing(void **state)
{
    (void)state;
    char path[PATH_MAX];
    const struct synth_settings s = small(1);
    struct rlimit old, low;
    log_set_level(LOG_SILENT);
    assert_int_equal(getrlimit(RLIMIT_FSIZE, &old), 0);
    low = old;
    low.rlim_cur = 100000; // take.json fits, the mesh does not
    signal(SIGXFSZ, SIG_IGN);
    assert_int_equal(setrlimit(RLIMIT_FSIZE, &low), 0);
    const int err = synth_write(&s, in_dir(path, "take"));
    assert_int_equal(setrlimit(RLIMIT_FSIZE, &old), 0);
    signal(SIGXFSZ, SIG_DFL);
    assert_int_equal(err, -EFBIG);
    assert_int_equal(count_entries(dir), 0);
}

// An object of others' making, far away and of another size.
static void write_egg(const char *path)
{
    struct mesh mesh;
    static const double middle[3] = {0, 0, 0};
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, middle, 1, 2000), 0);
    for (int i = 0; i < mesh.n_vertices; i++) {
        mesh.position_m[i][0] = 5 + 2 * mesh.position_m[i][0];
        mesh.position_m[i][2] = .5f * mesh.position_m[i][2];
    }
    assert_int_equal(mesh_write_obj(&mesh, path), 0);
    mesh_free(&mesh);
}

static void own_objects_are_scaled_centred_and_painted(void **state)
{
    (void)state;
    char path[PATH_MAX], mesh_path[PATH_MAX], colour_path[PATH_MAX], material_path[PATH_MAX];
    struct synth_settings s = small(SYNTH_OWN);
    struct mesh mesh;
    struct image albedo, brdf;
    double most = 0, middle[3];
    static const uint8_t colour[2 * 3] = {255, 188, 0, 10, 0, 128}, material[2 * 3] = {0, 51, 255, 0, 204, 0};
    write_egg(in_dir(mesh_path, "egg.obj"));
    assert_int_equal(image_write_png(in_dir(colour_path, "colour.png"), 1, 2, 3, colour), 0);
    assert_int_equal(image_write_png(in_dir(material_path, "material.png"), 1, 2, 3, material), 0);
    log_set_level(LOG_ERROR);
    s.mesh_path = mesh_path, s.colour_path = colour_path, s.material_path = material_path;
    s.own_theta[DISNEY_SHEEN] = .25f;
    make(&s, "own");
    s.flip_v = true;
    make(&s, "flipped");
    assert_int_equal(mesh_read(&mesh, NULL, in_dir(path, "own/geometry/mesh.obj")), 0);
    for (int k = 0; k < 3; k++)
        middle[k] = (mesh.bounds_m[0][k] + mesh.bounds_m[1][k]) / 2;
    for (int i = 0; i < mesh.n_vertices; i++)
        most = fmax(most, hypot(hypot(mesh.position_m[i][0] - middle[0], mesh.position_m[i][1] - middle[1]),
                                mesh.position_m[i][2] - middle[2]));
    assert_true(fabs(most - .3) < 1e-5);
    assert_true(fabs(middle[0] - .35) < 1e-5 && fabs(middle[1] - .25) < 1e-5 && fabs(middle[2] - 1.1) < 1e-5);
    // its longest way is still along x, its shortest along z: OBJ is taken as it is
    assert_true(mesh.bounds_m[1][0] - mesh.bounds_m[0][0] > 1.5 * (mesh.bounds_m[1][1] - mesh.bounds_m[0][1]));
    assert_true(mesh.bounds_m[1][1] - mesh.bounds_m[0][1] > 1.5 * (mesh.bounds_m[1][2] - mesh.bounds_m[0][2]));
    mesh_free(&mesh);
    for (int flipped = 0; flipped < 2; flipped++) {
        struct texels texels;
        assert_int_equal(mesh_read(&mesh, NULL, in_dir(path, flipped ? "flipped/geometry/mesh.obj" : "own/geometry/mesh.obj")), 0);
        assert_int_equal(texels_rasterise(&texels, &mesh, s.texture_size), 0);
        assert_int_equal(image_read(&albedo, in_dir(path, flipped ? "flipped/truth/albedo.exr" : "own/truth/albedo.exr")), 0);
        assert_int_equal(image_read(&brdf, in_dir(path, flipped ? "flipped/truth/brdf.exr" : "own/truth/brdf.exr")), 0);
        int n[2] = {0};
        for (int i = 0; i < texels.n; i++) {
            const size_t at = texels.pixel[i];
            const int row = (int)at / s.texture_size;
            const int sure = s.texture_size / 4 - 2; // between the two pixels' centres they mix, and a texel on the rim may be its neighbour's copy
            const bool top = row < sure;
            if (!top && row < s.texture_size - sure)
                continue;
            n[top]++;
            const float *c = albedo.data + 3 * at;
            assert_true(fabs((double)c[0] - (top ? 1 : .0030353)) < 1e-5 && fabs((double)c[1] - (top ? .5028865 : 0)) < 1e-5);
            for (int k = 0; k < DISNEY_N; k++) { // the file has its channels in another order
                const double expected = k == DISNEY_ROUGHNESS  ? (top ? .2 : .8)
                                        : k == DISNEY_METALLIC ? (top ? 1 : 0)
                                                               : (double)s.own_theta[k];
                assert_true(fabs((double)brdf.data[DISNEY_N * at + (size_t)image_channel(&brdf, disney_parameter_names[k])] - expected) < 1e-5);
            }
        }
        assert_true(n[flipped] > 20 && n[!flipped] == 0); // the pebble's atlas leaves the top of its square empty
        image_free(&albedo), image_free(&brdf), texels_free(&texels), mesh_free(&mesh);
    }
    s.mesh_path = NULL;
    log_set_level(LOG_SILENT);
    assert_int_equal(synth_write(&s, in_dir(path, "none")), -EINVAL);
    s.mesh_path = mesh_path, s.own_theta[0] = 1.5f;
    assert_int_equal(synth_write(&s, in_dir(path, "none")), -EINVAL);
    s.own_theta[0] = 0, s.material_path = "no such picture";
    assert_int_equal(synth_write(&s, in_dir(path, "none")), -ENOENT);
}

// A photographed room: what the panorama shows is what shines, from the walls of the cuboid.
static void a_panorama_may_light_the_studio(void **state)
{
    (void)state;
    char path[PATH_MAX], room[PATH_MAX];
    struct image photo;
    struct panorama shown;
    struct lights lights;
    struct synth_settings s = small(3);
    double total[3], sum[3] = {0}, luminance = 0;
    assert_int_equal(image_new(&photo, 128, 64, 3, NULL), 0);
    for (int i = 0; i < 3 * 128 * 64; i++)
        photo.data[i] = 7.f + (float)(i % 3) + ((i / 3) % 128 > 100 && i < 3 * 128 * 20 ? 900.f : 0);
    assert_int_equal(image_write_exr(&photo, in_dir(room, "room.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    image_free(&photo);
    s.panorama_path = room, s.n_true_lights = 512;
    make(&s, "lit");
    read_lights(&lights, "lit/truth/lights.json");
    assert_int_equal(panorama_read(&shown, in_dir(path, "lit/panorama.exr")), 0);
    panorama_total(&shown, total);
    assert_int_equal(lights.n, 512);
    for (int i = 0; i < lights.n; i++) {
        double at[3];
        mat3_mul_vec(at, lights.world_from_probe, lights.dir_probe[i]);
        for (int c = 0; c < 3; c++) {
            at[c] = at[c] / lights.inverse_distance[i] / (c == 0 ? 1.8 : c == 1 ? 1.2 : .6);
            sum[c] += lights.irradiance[i][c];
        }
        assert_true(fabs(fmax(fmax(fabs(at[0]), fabs(at[1])), fabs(at[2])) - 1) < 1e-6); // on a wall, seen from c
        luminance += .2126 * lights.irradiance[i][0] + .7152 * lights.irradiance[i][1] + .0722 * lights.irradiance[i][2];
    }
    for (int c = 0; c < 3; c++)
        assert_true(fabs(sum[c] / total[c] - 1) < 1e-5);
    assert_true(fabs(luminance / 4 * .5 / M_PI - .25) < 1e-6); // a sphere of albedo .5 is .25 bright
    panorama_free(&shown), lights_free(&lights);
    log_set_level(LOG_SILENT);
    s.n_true_lights = 500;
    assert_int_equal(synth_write(&s, in_dir(path, "none")), -EINVAL);
}

static void settings_out_of_range_are_refused(void **state)
{
    (void)state;
    char path[PATH_MAX];
    in_dir(path, "take");
    log_set_level(LOG_SILENT);
    struct synth_settings s = small(1);
    s.data_set = 7;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.n_true_lights = 15;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.n_true_lights = 65537;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.panorama_width_px = 32; // 512 pixels for 300 lights
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.panorama_width_px = 255;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.noise = (double)NAN;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.noise = -.1;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.shape = "teapot";
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.n_views = 0;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.samples = 0;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.width_px = 8193;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    s = small(1), s.texture_size = 31;
    assert_int_equal(synth_write(&s, path), -EINVAL);
    assert_int_equal(count_entries(dir), 0);
}

#define TEST(f) cmocka_unit_test_setup_teardown(f, set_up, tear_down)

int main(void)
{
    const struct CMUnitTest tests[] = {
        TEST(lights_and_panorama_say_the_same),
        TEST(lights_stand_for_equal_areas_of_the_walls),
        TEST(variants_of_the_light_are_what_they_are_called),
        TEST(every_data_set_is_a_take_with_a_start_and_a_truth),
        TEST(rendering_the_truth_gives_the_views),
        TEST(noise_has_its_size_and_the_camera_clips_at_one),
        TEST(bright_studios_clip_and_say_where),
        TEST(the_same_seed_gives_the_same_bytes_with_any_threads),
        TEST(a_folder_in_use_is_refused_and_kept),
        TEST(a_studio_that_cannot_be_written_leaves_nothing),
        TEST(own_objects_are_scaled_centred_and_painted),
        TEST(a_panorama_may_light_the_studio),
        TEST(settings_out_of_range_are_refused),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
