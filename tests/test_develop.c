// tests/test_develop.c - rigd-unpack says of a raw whether its photosites can be unpacked, and survives any file; what raw_read() gives.
#include "rigd/develop.h"
#include "rigd/exif.h"
#include "tests/raw_files.h"

#include <errno.h>
#include <math.h>
#include <sys/stat.h>
#include <sys/wait.h>

enum { WIDTH = 320, HEIGHT = 200 };
static uint8_t *frame;
static size_t n_frame;

static int make_frame(void **state)
{
    (void)state;
    struct raw_dng d;
    const struct raw_dng_info info = { .width_px = WIDTH, .height_px = HEIGHT, .black_level = 512, .white_level = 16383, .make = "Nikon", .model = "D500",
                                       .lens = "50 mm", .serial = "1", .firmware = "1", .time_s = .01, .f_number = 8, .focal_mm = 50, .iso = 100,
                                       .wb = { .5, 1, .5 } };
    if (scratch_open() || raw_dng_make(&d, &info))
        return -1;
    n_frame = d.n_head + d.n_pixel_bytes + d.n_tail;
    frame = malloc(n_frame);
    if (!frame)
        return -1;
    memcpy(frame, d.head, d.n_head);
    for (size_t i = 0; i < d.n_pixel_bytes; i++)
        frame[d.n_head + i] = (uint8_t)(i % 2 ? i / 3 % 64 : i * 7);
    memcpy(frame + d.n_head + d.n_pixel_bytes, d.tail, d.n_tail);
    raw_dng_free(&d);
    return 0;
}

static int drop_frame(void **state)
{
    (void)state;
    free(frame);
    return scratch_close();
}

// Its exit status; < 0: it died of the file.
static int unpack(const void *bytes, size_t n)
{
    const char *folder = getenv("BIN");
    char command[1200];
    scratch_write("frame.dng", bytes, n);
    snprintf(command, sizeof(command), "%s/rigd-unpack %s >/dev/null 2>&1", folder ? folder : "build/bin", scratch_path("frame.dng"));
    const int status = system(command);
    unlink(scratch_path("frame.dng"));
    return WIFEXITED(status) && WEXITSTATUS(status) < 128 ? WEXITSTATUS(status) : -1;
}

static void a_whole_frame_unpacks(void **state)
{
    (void)state;
    assert_int_equal(unpack(frame, n_frame), 0);
}

// The tag of where they lie, 273, type 4: its table is beyond the end of the file.
static void photosites_that_are_not_there_are_found(void **state)
{
    (void)state;
    uint8_t *damaged = malloc(n_frame);
    int n_changed = 0;
    assert_non_null(damaged);
    memcpy(damaged, frame, n_frame);
    for (size_t i = 0; i + 12 <= n_frame; i++)
        if (!memcmp(frame + i, "\x11\x01\x04\x00", 4) && i > n_frame / 2)
            damaged[i + 10] = 0x7f, n_changed++;
    assert_int_equal(n_changed, 1);
    assert_int_equal(unpack(damaged, n_frame), 1);
    free(damaged);
}

static void what_is_no_raw_is_left_to_others(void **state)
{
    (void)state;
    static const uint8_t preview[4000] = { 0xff, 0xd8, 0xff, 0xe0 };
    assert_int_equal(unpack(preview, sizeof(preview)), 4);
}

static void no_file_hangs_it(void **state)
{
    (void)state;
    uint8_t *damaged = malloc(n_frame);
    assert_non_null(damaged);
    for (uint32_t k = 0; k < 40; k++) {
        memcpy(damaged, frame, n_frame);
        for (uint32_t i = 0; i < 8; i++)
            damaged[(k * 2654435761u + i * 40503u) % 600] ^= (uint8_t)(1u << (k + i) % 8);
        unpack(damaged, n_frame); // whatever it says, it ends; a hang would be the test's
    }
    free(damaged);
}

// ---- raw_read ----

static const uint8_t cfa_orders[4][4] = { { 0, 1, 1, 2 }, { 1, 0, 2, 1 }, { 2, 1, 1, 0 }, { 1, 2, 0, 1 } };

static void photosites_filters_and_levels_are_those_of_the_file(void **state)
{
    (void)state;
    for (int k = 0; k < 8; k++) {
        struct raw_frame f;
        char why[200] = "";
        uint32_t seed = 7u + (uint32_t)k;
        struct raw_dng_info info = raw_info(k & 1 ? 131 : 128, k & 2 ? 95 : 96);
        memcpy(info.cfa, cfa_orders[k % 4], 4);
        for (int i = 0; i < 4 && k >= 4; i++)
            info.black_more[i] = 3 * i + k;
        raw_write(scratch_path("a.dng"), &info, raw_scatter, &seed);
        assert_int_equal(raw_read(&f, scratch_path("a.dng"), why, sizeof(why)), 0);
        assert_int_equal(f.width, info.width_px);
        assert_int_equal(f.height, info.height_px);
        assert_int_equal((int)f.white, info.white_level);
        assert_int_equal((int)f.saturation, info.white_level);
        for (int i = 0; i < 4; i++) {
            assert_int_equal(f.cfa[i / 2][i % 2], cfa_orders[k % 4][i]);
            assert_int_equal((int)f.black[i / 2][i % 2], 512 + info.black_more[i]);
        }
        for (int y = 0; y < f.height; y++)
            for (int x = 0; x < f.width; x++)
                assert_int_equal(f.site[y * f.width + x], raw_scatter(&seed, x, y));
        raw_free(&f);
        unlink(scratch_path("a.dng"));
    }
}

static void the_exposure_is_read_to_the_microsecond_and_to_the_true_shutter(void **state)
{
    (void)state;
    struct raw_frame f;
    char why[200] = "";
    struct raw_dng_info info = raw_info(64, 64);
    info.time_s = 1. / 60;
    info.f_number = 5.6;
    info.iso = 400;
    info.orientation = 6;
    raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
    assert_int_equal(raw_read(&f, scratch_path("a.dng"), why, sizeof(why)), 0);
    assert_true(fabs(f.label_s - 1. / 60) < 1e-9);
    assert_true(f.exposure_s == 1. / 64);
    assert_true(fabs(f.f_number - 5.6) < 1e-6);
    assert_true(f.iso == 400);
    assert_true(f.focal_mm == 50);
    assert_true(f.has_time && f.has_subseconds);
    assert_true(f.taken_ns == info.utc_ns);
    assert_int_equal(f.orientation, 6);
    assert_int_equal(f.width, 64);
    assert_string_equal(f.make, "Studiorig");
    assert_string_equal(f.model, "Simulated camera");
    assert_string_equal(f.serial, "10001");
    assert_string_equal(f.lens, "SIM 50mm f/2.8");
    raw_free(&f);
    unlink(scratch_path("a.dng"));
}

// A matrix that makes a colour ten thousand times the others is no camera's: it is not used, which whoever reads the frame is told.
static void a_matrix_that_cannot_be_is_not_used(void **state)
{
    (void)state;
    struct raw_frame f;
    char why[200] = "";
    for (int c = 0; c < 3; c++) {
        struct raw_dng_info info = raw_info(64, 64);
        info.wb[0] = info.wb[1] = info.wb[2] = 1;
        info.wb[c] = 1e4;
        raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
        assert_int_equal(raw_read(&f, scratch_path("a.dng"), why, sizeof(why)), 0);
        assert_false(f.has_colour);
        for (int i = 0; i < 3; i++) {
            assert_true(f.daylight[i] == 1);
            for (int k = 0; k < 3; k++)
                assert_true(f.srgb_from_camera[i][k] == (i == k));
        }
        raw_free(&f);
    }
    unlink(scratch_path("a.dng"));
}

// The file's matrix is sRGB's own times wb, also where LibRaw's table has a camera of that name.
static void colour_is_the_files_own_matrix_and_its_daylight(void **state)
{
    (void)state;
    for (int k = 0; k < 2; k++) {
        struct raw_frame f;
        char why[200] = "";
        struct raw_dng_info info = raw_info(64, 64);
        if (k) {
            info.make = "Nikon";
            info.model = "D500";
        }
        raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
        assert_int_equal(raw_read(&f, scratch_path("a.dng"), why, sizeof(why)), 0);
        assert_true(f.has_colour);
        for (int i = 0; i < 3; i++) {
            assert_true(fabs(f.daylight[i] * info.wb[i] - 1) < 1e-5);
            for (int j = 0; j < 3; j++)
                assert_true(fabs(f.srgb_from_camera[i][j] - (i == j)) < 1e-5);
        }
        raw_free(&f);
        unlink(scratch_path("a.dng"));
    }
}

static void a_file_cut_short_is_never_read_as_whole(void **state)
{
    (void)state;
    struct stat st;
    const struct raw_dng_info info = raw_info(128, 96);
    raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
    assert_int_equal(stat(scratch_path("a.dng"), &st), 0);
    for (int k = 0; k < 64; k++) {
        struct raw_frame f;
        char why[200] = "";
        raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
        assert_int_equal(truncate(scratch_path("a.dng"), st.st_size * k / 64), 0);
        const int err = raw_read(&f, scratch_path("a.dng"), why, sizeof(why));
        assert_true(err == -EBADMSG || err == -ENOTSUP);
        assert_true(why[0]);
        assert_null(f.site);
        unlink(scratch_path("a.dng"));
    }
    struct raw_frame f;
    char why[200] = "";
    assert_int_equal(raw_read(&f, scratch_path("none.dng"), why, sizeof(why)), -ENOENT);
}

// Labels of real dials in thirds, with what the shutter does.
static void labels_of_dials_become_powers_of_two(void **state)
{
    (void)state;
    static const double thirds[] = { 1. / 8000, 1. / 6400, 1. / 5000, 1. / 4000, 1. / 3200, 1. / 2500, 1. / 2000, 1. / 1600, 1. / 1250, 1. / 1000, 1. / 800, 1. / 640, 1. / 500, 1. / 400,
                                     1. / 320, 1. / 250, 1. / 200, 1. / 160, 1. / 125, 1. / 100, 1. / 80, 1. / 60, 1. / 50, 1. / 40, 1. / 30, 1. / 25, 1. / 20, 1. / 15, 1. / 13, .1, 1. / 8,
                                     1. / 6, .2, .25, .3, .4, .5, .6, .8, 1, 1.3, 1.6, 2, 2.5, 3.2, 4, 5, 6, 8, 10, 13, 15, 20, 25, 30 };
    static const double halves[] = { 1. / 6000, 1. / 3000, 1. / 1500, 1. / 750, 1. / 350, 1. / 180, 1. / 90, 1. / 45, .7 };
    static const double stops[] = { -12.5, -11.5, -10.5, -9.5, -8.5, -7.5, -6.5, -5.5, -.5 };
    for (size_t i = 0; i < sizeof(thirds) / sizeof(thirds[0]); i++)
        assert_true(fabs(log2(exif_true_time_s(thirds[i], 0)) - ((double)i - 39) / 3) < 1e-12);
    for (size_t i = 0; i < sizeof(halves) / sizeof(halves[0]); i++)
        assert_true(fabs(log2(exif_true_time_s(halves[i], 0)) - stops[i]) < 1e-12);
    assert_true(exif_true_time_s(1. / 20, exp2(-4.5)) == exp2(-4.5)); // a label of both dials, and APEX says which
    assert_true(exif_true_time_s(1. / 20, exp2(-4.322)) == exp2(-13. / 3)); // APEX of the label itself says nothing
    assert_true(exif_true_time_s(47.3, 0) == 47.3);                         // bulb
    assert_true(exif_true_time_s(0, 0) == 0);
    assert_true(isnan(exif_true_time_s(NAN, 0)));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_whole_frame_unpacks),
        cmocka_unit_test(photosites_that_are_not_there_are_found),
        cmocka_unit_test(what_is_no_raw_is_left_to_others),
        cmocka_unit_test(no_file_hangs_it),
        cmocka_unit_test(photosites_filters_and_levels_are_those_of_the_file),
        cmocka_unit_test(the_exposure_is_read_to_the_microsecond_and_to_the_true_shutter),
        cmocka_unit_test(colour_is_the_files_own_matrix_and_its_daylight),
        cmocka_unit_test(a_file_cut_short_is_never_read_as_whole),
        cmocka_unit_test(labels_of_dials_become_powers_of_two),
        cmocka_unit_test(a_matrix_that_cannot_be_is_not_used),
    };
    return cmocka_run_group_tests(tests, make_frame, drop_frame);
}
