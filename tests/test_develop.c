// tests/test_develop.c - rigd-unpack says of a raw whether its photosites can be unpacked, and survives any file.
#include "tests/rigsim/raw_dng.h"
#include "tests/scratch.h"

#include <math.h>
#include <string.h>
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

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_whole_frame_unpacks),
        cmocka_unit_test(photosites_that_are_not_there_are_found),
        cmocka_unit_test(what_is_no_raw_is_left_to_others),
        cmocka_unit_test(no_file_hangs_it),
    };
    return cmocka_run_group_tests(tests, make_frame, drop_frame);
}
