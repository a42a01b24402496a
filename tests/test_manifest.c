// tests/test_manifest.c - a hand-over that says what it is, and notices when it is no longer.
#include "rigd/manifest.h"
#include "rigd/digest.h"
#include "solver/take/log.h"

#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>
#include <cmocka.h>

static char dir[64];

static void put(const char *name, const char *text)
{
    char path[200];
    snprintf(path, sizeof(path), "%s/%s", dir, name);
    FILE *f = fopen(path, "w");
    assert_non_null(f);
    fputs(text, f);
    fclose(f);
}

static void set_up(void)
{
    char path[200];
    strcpy(dir, "/tmp/studiorig-test-XXXXXX");
    assert_non_null(mkdtemp(dir));
    snprintf(path, sizeof(path), "%s/raw", dir);
    mkdir(path, 0777);
    put("take.json", "{}");
    put("raw/A01.nef", "one");
    put("raw/A02 & <b>.nef", "two");
    put("raw/.A03.nef.abc.part", "half");
    put("raw/A03.nef.part", "half");
}

static void tear_down(void)
{
    char command[100];
    snprintf(command, sizeof(command), "rm -rf %s", dir);
    assert_int_equal(system(command), 0);
}

static char *slurp(const char *pattern)
{
    static char text[20000];
    char command[200];
    snprintf(command, sizeof(command), "cat %s/%s", dir, pattern);
    FILE *f = popen(command, "r");
    text[fread(text, 1, sizeof(text) - 1, f)] = 0;
    pclose(f);
    return text;
}

static void what_was_written_verifies_and_what_changed_is_named(void **state)
{
    (void)state;
    struct manifest_findings found;
    set_up();
    assert_int_equal(manifest_write(dir, NULL, 0, 1795338000), 0);
    assert_int_equal(manifest_verify(dir, &found), 0);
    assert_int_equal(found.n_files, 2);
    const char *text = slurp("ascmhl/0001_*_2026-11-22_090000Z.mhl");
    assert_non_null(strstr(text, "<path size=\"3\""));
    assert_non_null(strstr(text, "raw/A02 &amp; &lt;b&gt;.nef</path>"));
    assert_null(strstr(text, "A03"));
    char hex[DIGEST_HEX];
    struct digest *d = digest_begin();
    digest_add(d, "one", 3);
    digest_end(d, hex);
    assert_non_null(strstr(text, hex));
    char c4[DIGEST_C4];
    digest_c4(text, strlen(text), c4);
    assert_non_null(strstr(slurp("ascmhl/ascmhl_chain.xml"), c4));

    log_set_level(LOG_SILENT);
    put("raw/A01.nef", "ONE");
    assert_int_equal(manifest_verify(dir, &found), -EBADMSG);
    assert_int_equal(found.n_changed, 1);
    put("raw/A01.nef", "one");
    put("raw/A04.nef", "new");
    assert_int_equal(manifest_verify(dir, &found), 0);
    assert_int_equal(found.n_new, 1);
    char path[100];
    snprintf(path, sizeof(path), "%s/raw/A02 & <b>.nef", dir);
    unlink(path);
    assert_int_equal(manifest_verify(dir, &found), -EBADMSG);
    assert_int_equal(found.n_missing, 1);
    log_set_level(LOG_INFO);
    tear_down();
}

static void a_take_without_files_has_nothing_to_hand_over(void **state)
{
    (void)state;
    char path[200];
    set_up();
    snprintf(path, sizeof(path), "rm %s/raw/*nef", dir);
    assert_int_equal(system(path), 0);
    assert_int_equal(manifest_write(dir, NULL, 0, 1795338000), 0);
    snprintf(path, sizeof(path), "%s/ascmhl", dir);
    assert_int_not_equal(access(path, F_OK), 0); // a list without a file is not in the schema
    tear_down();
}

static void generations_follow_each_other(void **state)
{
    (void)state;
    struct manifest_findings found;
    set_up();
    assert_int_equal(manifest_write(dir, NULL, 0, 1795338000), 0);
    put("raw/A05.nef", "five");
    put("ascmhl/0002_left_by_a_crash_2026-11-22_090001Z.mhl", "<hash");
    assert_int_equal(manifest_write(dir, NULL, 0, 1795338060), 0);
    assert_int_equal(manifest_verify(dir, &found), 0);
    assert_int_equal(found.n_files, 3);
    const char *text = slurp("ascmhl/0002_*");
    assert_non_null(strstr(text, "action=\"verified\""));
    assert_non_null(strstr(text, "action=\"original\""));
    assert_null(strstr(text, "<hash\n<?xml"));
    log_set_level(LOG_SILENT);
    put("raw/A05.nef", "FIVE");
    assert_int_equal(manifest_write(dir, NULL, 0, 1795338120), -EBADMSG);
    assert_non_null(strstr(slurp("ascmhl/0003_*"), "action=\"failed\""));
    // A generation edited afterwards breaks the chain.
    char command[200];
    snprintf(command, sizeof(command), "sed -i s/failed/verified/ %s/ascmhl/0003_*", dir);
    assert_int_equal(system(command), 0);
    assert_int_equal(manifest_verify(dir, &found), -EBADMSG);
    log_set_level(LOG_INFO);
    tear_down();
}

static void known_hashes_are_used_only_where_the_size_agrees(void **state)
{
    (void)state;
    set_up();
    const struct manifest_known known[] = {
        { "raw/A01.nef", "00112233445566778899aabbccddeeff", 3 },
        { "raw/A02 & <b>.nef", "ffeeddccbbaa99887766554433221100", 4 },
    };
    assert_int_equal(manifest_write(dir, known, 2, 1795338000), 0);
    const char *text = slurp("ascmhl/0001_*");
    assert_non_null(strstr(text, "00112233445566778899aabbccddeeff"));
    assert_null(strstr(text, "ffeeddccbbaa99887766554433221100"));
    tear_down();
}

static void hostile_manifests_are_errors(void **state)
{
    (void)state;
    static const char *const chains[] = {
        "", "<", "<path>", "<path></path>", "<path>0001_a.mhl</path><c4>x</c4>", "<path>../../../etc/passwd</path><c4>x</c4>", "<path>a</path>",
    };
    struct manifest_findings found;
    set_up();
    assert_int_equal(manifest_write(dir, NULL, 0, 1795338000), 0);
    log_set_level(LOG_SILENT);
    for (size_t i = 0; i < sizeof(chains) / sizeof(chains[0]); i++) {
        put("ascmhl/ascmhl_chain.xml", chains[i]);
        assert_true(manifest_verify(dir, &found) < 0);
    }
    log_set_level(LOG_INFO);
    tear_down();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(what_was_written_verifies_and_what_changed_is_named),
        cmocka_unit_test(a_take_without_files_has_nothing_to_hand_over),
        cmocka_unit_test(generations_follow_each_other),
        cmocka_unit_test(known_hashes_are_used_only_where_the_size_agrees),
        cmocka_unit_test(hostile_manifests_are_errors),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
