// tests/test_container.c - a frame that is short, or is none, is noticed; one that is whole never refused.
#include "rigd/container.h"
#include "tests/scratch.h"

#include <errno.h>
#include <fcntl.h>
#include <stdbool.h>
#include <string.h>

static unsigned char file[4096];
static size_t n_file;

static void put(size_t at, uint64_t value, int n, bool big_endian)
{
    for (int i = 0; i < n; i++)
        file[at + (size_t)(big_endian ? n - 1 - i : i)] = (unsigned char)(value >> (8 * i));
}

static void entry(size_t at, int tag, int type, uint32_t count, uint32_t value, bool big_endian)
{
    put(at, (uint64_t)tag, 2, big_endian);
    put(at + 2, (uint64_t)type, 2, big_endian);
    put(at + 4, count, 4, big_endian);
    if (type == 3 && count == 1)
        put(at + 8, value, 2, big_endian);
    else
        put(at + 8, value, 4, big_endian);
}

// IFD0 with a preview, a SubIFD with two strips: as NEF and DNG are built. 3000 bytes.
static void make_tiff(bool big_endian)
{
    memset(file, 0, sizeof(file));
    memcpy(file, big_endian ? "MM\0*" : "II*\0", 4);
    put(4, 8, 4, big_endian);
    put(8, 3, 2, big_endian);
    entry(10, 513, 4, 1, 400, big_endian);
    entry(22, 514, 4, 1, 100, big_endian);
    entry(34, 330, 4, 1, 200, big_endian);
    put(46, 0, 4, big_endian);
    put(200, 2, 2, big_endian);
    entry(202, 273, 4, 2, 300, big_endian);
    entry(214, 279, 3, 2, 0, big_endian);
    put(222, 1000, 2, big_endian); // two SHORTs fit into the entry itself
    put(224, 500, 2, big_endian);
    put(300, 1500, 4, big_endian);
    put(304, 2500, 4, big_endian);
    n_file = 3000;
}

static int check(const char *name, char why[120])
{
    scratch_write("frame", file, n_file);
    const int fd = open(scratch_path("frame"), O_RDONLY);
    assert_true(fd >= 0);
    const int err = container_check(fd, (int64_t)n_file, name, why, 120);
    close(fd);
    unlink(scratch_path("frame"));
    return err;
}

static void assert_short_is_noticed(const char *name, size_t n_needed)
{
    char why[120];
    const size_t whole = n_file;
    assert_int_equal(check(name, why), 0);
    for (n_file = whole - 1; n_file; n_file -= n_file > 700 ? 97 : 13) {
        const int err = check(name, why);
        if (n_file < n_needed) {
            if (err != -EBADMSG || !why[0])
                fail_msg("%s of %zu bytes passed", name, n_file);
        } else {
            assert_int_equal(err, 0);
        }
        if (n_file < 13)
            break;
    }
    n_file = whole;
}

static void short_tiff_raws_are_noticed_in_both_byte_orders(void **state)
{
    (void)state;
    char why[120];
    for (int big_endian = 0; big_endian < 2; big_endian++) {
        make_tiff(big_endian);
        assert_short_is_noticed("DSC_0001.NEF", 3000);
        assert_int_equal(check("x.dng", why), 0);
    }
}

static void short_cr3_raf_and_jpeg_are_noticed(void **state)
{
    (void)state;
    memset(file, 7, sizeof(file));
    memcpy(file, "\0\0\0\x18" "ftypcrx ", 12);
    put(24, 400, 4, true);
    memcpy(file + 28, "moov", 4);
    put(424, 1, 4, true); // a 64-bit size follows
    memcpy(file + 428, "mdat", 4);
    put(432, 1000, 8, true);
    n_file = 1424;
    assert_short_is_noticed("IMG_0001.CR3", 1424);

    memset(file, 0, sizeof(file));
    memcpy(file, "FUJIFILMCCD-RAW ", 16);
    put(84, 200, 4, true), put(88, 300, 4, true);
    put(92, 500, 4, true), put(96, 100, 4, true);
    put(100, 600, 4, true), put(104, 1400, 4, true);
    n_file = 2000;
    assert_short_is_noticed("DSCF0001.RAF", 2000);

    memset(file, 9, sizeof(file));
    memcpy(file, "\xff\xd8\xff\xe1", 4);
    memcpy(file + 998, "\xff\xd9", 2);
    n_file = 1000;
    assert_short_is_noticed("DSC_0001.JPG", 1000);
    memset(file + 1000, 0, 2000);
    n_file = 3000; // cameras pad with zeros
    char why[120];
    assert_int_equal(check("DSC_0001.JPG", why), 0);
}

static void strangers_are_noticed_and_unknown_kinds_pass(void **state)
{
    (void)state;
    char why[120];
    memset(file, 0x55, sizeof(file));
    n_file = 1000;
    const char *const known[] = { "a.nef", "a.CR2", "a.cr3", "a.RAF", "a.jpeg", "a.tif" };
    for (int i = 0; i < 6; i++)
        assert_int_equal(check(known[i], why), -EBADMSG);
    const char *const unknown[] = { "a.xyz", "a", "a.", "notes.txt", "a.ne" };
    for (int i = 0; i < 5; i++)
        assert_int_equal(check(unknown[i], why), 0);
}

static void directories_that_turn_in_circles_end(void **state)
{
    (void)state;
    char why[120];
    make_tiff(false);
    put(46, 8, 4, false); // the next directory is the first one
    assert_int_equal(check("a.dng", why), 0);
    entry(34, 330, 4, 60, 700, false); // 60 sub-directories: all the first one again
    for (size_t i = 0; i < 60; i++)
        put(700 + 4 * i, 8, 4, false);
    assert_int_equal(check("a.dng", why), 0);
    entry(34, 330, 4, 0xffffffff, 700, false);
    check("a.dng", why); // ends
    make_tiff(false);
    entry(202, 273, 4, 0x40000001, 300, false); // count times width wraps to 4
    assert_int_equal(check("a.dng", why), -EBADMSG);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(short_tiff_raws_are_noticed_in_both_byte_orders),
        cmocka_unit_test(short_cr3_raf_and_jpeg_are_noticed),
        cmocka_unit_test(strangers_are_noticed_and_unknown_kinds_pass),
        cmocka_unit_test(directories_that_turn_in_circles_end),
    };
    if (scratch_open())
        return 1;
    const int failed = cmocka_run_group_tests_name("container", tests, NULL, NULL);
    return scratch_close() ? 1 : failed;
}
