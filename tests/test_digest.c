// tests/test_digest.c - hashes as other tools compute them.
#include "rigd/digest.h"

#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

static void c4_of_known_texts(void **state)
{
    (void)state;
    char c4[DIGEST_C4];
    digest_c4("foo", 3, c4); // from the reference implementation (Avalanche-io/c4)
    assert_string_equal(c4, "c45xZeXwMSpqXjpDumcHMA6mhoAmGHkUo7r9WmN2UgSEQzj9KjgseaQdkEJ11fGb5S1WEENcV3q8RFWwEeVpC7Fjk2");
    digest_c4("", 0, c4);
    assert_string_equal(c4, "c459dsjfscH38cYeXXYogktxf4Cd9ibshE3BHUo6a58hBXmRQdZrAkZzsWcbWtDg5oQstpDuni4Hirj75GEmTc1sFT");
}

static void xxh128_is_what_xxhsum_prints(void **state)
{
    (void)state;
    char hex[DIGEST_HEX];
    struct digest *d = digest_begin();
    digest_end(d, hex);
    assert_string_equal(hex, "99aa06d3014798d86001c324468d497f"); // xxhsum -H2 of nothing
    d = digest_begin();
    digest_add(d, "a", 1);
    digest_add(d, "bc", 2);
    digest_end(d, hex);
    assert_string_equal(hex, "06b05ab6733a618578af5f94892f3950"); // xxhsum -H2 of abc
}

static void a_file_has_the_hash_of_its_bytes_and_a_link_none(void **state)
{
    (void)state;
    char dir[] = "/tmp/studiorig-test-XXXXXX", path[64], link[64], hex[DIGEST_HEX], expected[DIGEST_HEX];
    assert_non_null(mkdtemp(dir));
    snprintf(path, sizeof(path), "%s/f", dir);
    snprintf(link, sizeof(link), "%s/l", dir);
    FILE *f = fopen(path, "w");
    struct digest *d = digest_begin();
    for (int i = 0; i < 300000; i++) { // more than one chunk
        const unsigned char b = (unsigned char)(i * 7 + i / 256);
        fputc(b, f);
        digest_add(d, &b, 1);
    }
    fclose(f);
    digest_end(d, expected);
    int64_t size = 0;
    assert_int_equal(digest_file(path, 1, hex, &size), 0);
    assert_string_equal(hex, expected);
    assert_int_equal(size, 300000);
    assert_int_equal(symlink(path, link), 0);
    assert_int_equal(digest_file(link, 0, hex, &size), -ELOOP);
    assert_int_equal(digest_file("/nowhere/at/all", 0, hex, &size), -ENOENT);
    unlink(link), unlink(path), rmdir(dir);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(c4_of_known_texts),
        cmocka_unit_test(xxh128_is_what_xxhsum_prints),
        cmocka_unit_test(a_file_has_the_hash_of_its_bytes_and_a_link_none),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
