// tests/test_json.c - JSON in and out: values come back, wrong ones are named, broken text is
// refused by line.
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "tests/scratch.h"

#include <errno.h>
#include <locale.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

static char path[600];
static struct {
    int n_errors;
    char last[1024];
} logged;

static void keep_line(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    if (level != LOG_ERROR)
        return;
    logged.n_errors++;
    snprintf(logged.last, sizeof(logged.last), "%s", message);
}

static void assert_logged(const char *words)
{
    const int n_errors = logged.n_errors;
    logged.n_errors = 0;
    if (n_errors != 1 || !strstr(logged.last, words))
        fail_msg("%d error lines, expected one with \"%s\"; the last: %s", n_errors, words,
                 logged.last);
}

static struct json *parse(const char *text)
{
    struct json *doc;
    assert_int_equal(json_parse(&doc, text, strlen(text), "text"), 0);
    return doc;
}

static const char document[] =
    "{\"stage\": {\"joint\": {\"wall_s\": 2.5, \"rounds\": 12, \"ok\": true}},\n"
    " \"lights\": [{\"dir\": [1, 0.5, -2e3]}, {\"dir\": [0,0,1], \"name\": \"l\\u00e4mp\"}],\n"
    " \"matrix\": [[1,2,3],[4,5,6],[7,8,9]], \"whole\": 3.0, \"fraction\": 3.5, \"huge\": 1e300, "
    "\"null\": null,\n"
    " \"long\": 9007199254740993, \"off\": false}";

static void paths_reach_nested_values_and_array_elements(void **state)
{
    (void)state;
    struct json *doc = parse(document);
    double x = 0, nine[9];
    int64_t i = 0;
    bool truth = false;
    const char *string = NULL;
    assert_int_equal(json_get_number(doc, "stage.joint.wall_s", &x), 0);
    assert_true(x == 2.5);
    assert_int_equal(json_get_int(doc, "stage.joint.rounds", &i), 0);
    assert_true(i == 12);
    assert_int_equal(json_get_number(doc, "stage.joint.rounds", &x), 0);
    assert_true(x == 12);
    assert_int_equal(json_get_bool(doc, "stage.joint.ok", &truth), 0);
    assert_true(truth);
    assert_int_equal(json_get_bool(doc, "off", &truth), 0);
    assert_false(truth);
    assert_int_equal(json_get_string(doc, "lights.1.name", &string), 0);
    assert_string_equal(string, "l\xc3\xa4mp");
    assert_int_equal(json_get_number(doc, "lights.0.dir.2", &x), 0);
    assert_true(x == -2000);
    assert_int_equal(json_length(doc, "lights"), 2);
    assert_int_equal(json_get_numbers(doc, "matrix", nine, 9), 0);
    for (int k = 0; k < 9; k++)
        assert_true(nine[k] == k + 1);
    assert_int_equal(json_get_int(doc, "whole", &i), 0);
    assert_true(i == 3);
    assert_int_equal(json_get_int(doc, "long", &i), 0);
    assert_true(i == 9007199254740993); // more than a double holds
    assert_int_equal(json_get_numbers(doc, "fraction", &x, 1), 0);
    assert_true(x == 3.5);

    const struct json *inner = json_get(doc, "stage.joint");
    assert_non_null(inner);
    assert_int_equal(json_get_number(inner, "wall_s", &x), 0);
    assert_ptr_equal(json_get(doc, ""), doc);
    json_free(doc);
}

static void missing_is_enoent_and_mistyped_is_einval_and_out_is_kept(void **state)
{
    (void)state;
    struct json *doc = parse(document);
    static const char *const missing[] = { "none",
                                           "stage.none",
                                           "lights.2",
                                           "lights.-1",
                                           "lights.x",
                                           "lights.0x0",
                                           "stage.joint.wall_s.more",
                                           "lights..0",
                                           ".",
                                           "lights.4294967296",
                                           "lights.18446744073709551616" };
    static const char *const not_numbers[] = { "stage", "lights", "null", "lights.1.name", "off" };
    double x = 42, three[3] = { 1, 2, 3 };
    int64_t i = 42;
    bool truth = true;
    const char *string = "kept";
    for (size_t k = 0; k < sizeof(missing) / sizeof(missing[0]); k++) {
        assert_null(json_get(doc, missing[k]));
        assert_int_equal(json_get_number(doc, missing[k], &x), -ENOENT);
        assert_int_equal(json_get_int(doc, missing[k], &i), -ENOENT);
        assert_int_equal(json_get_bool(doc, missing[k], &truth), -ENOENT);
        assert_int_equal(json_get_string(doc, missing[k], &string), -ENOENT);
        assert_int_equal(json_get_numbers(doc, missing[k], three, 3), -ENOENT);
        assert_int_equal(json_length(doc, missing[k]), -ENOENT);
    }
    for (size_t k = 0; k < sizeof(not_numbers) / sizeof(not_numbers[0]); k++) {
        assert_int_equal(json_get_number(doc, not_numbers[k], &x), -EINVAL);
        assert_int_equal(json_get_int(doc, not_numbers[k], &i), -EINVAL);
        assert_int_equal(json_get_numbers(doc, not_numbers[k], three, 3), -EINVAL);
    }
    assert_int_equal(json_get_int(doc, "fraction", &i), -EINVAL);
    assert_int_equal(json_get_int(doc, "huge", &i), -EINVAL);
    assert_int_equal(json_get_bool(doc, "whole", &truth), -EINVAL);
    assert_int_equal(json_get_string(doc, "whole", &string), -EINVAL);
    assert_int_equal(json_length(doc, "stage"), -EINVAL);
    assert_int_equal(json_get_numbers(doc, "lights.0.dir", three, 2), -EINVAL);
    assert_int_equal(json_get_numbers(doc, "matrix", three, 3), -EINVAL);
    assert_int_equal(json_get_numbers(doc, "lights", three, 3), -EINVAL);
    assert_true(x == 42 && i == 42 && truth && three[0] == 1 && three[2] == 3);
    assert_string_equal(string, "kept");
    assert_int_equal(logged.n_errors, 0); // the caller knows whether it was needed
    json_free(doc);
}

static void what_was_required_is_named_with_what_was_found(void **state)
{
    (void)state;
    struct json *doc = parse(document);
    double three[3];
    const char *string;
    assert_int_equal(json_require_numbers(doc, "lights.0.dir", three, 3, "lights.json"), 0);
    assert_int_equal(json_require_numbers(doc, "centre_m", three, 3, "lights.json"), -ENOENT);
    assert_logged("lights.json: \"centre_m\": found nothing, expected 3 numbers");
    assert_int_equal(json_require_numbers(doc, "lights.1.name", three, 1, "lights.json"), -EINVAL);
    assert_logged("lights.json: \"lights.1.name\": found \"l\xc3\xa4mp\", expected a number");
    assert_int_equal(json_require_numbers(doc, "matrix", three, 3, "lights.json"), -EINVAL);
    assert_logged("found [[1,2,3],[4,5,6],[7,8,9]], expected 3 numbers");
    assert_int_equal(json_require_string(doc, "null", &string, "take.json"), -EINVAL);
    assert_logged("take.json: \"null\": found null, expected a string");
    json_free(doc);
}

static void broken_text_is_refused_with_its_line(void **state)
{
    (void)state;
    static const struct {
        const char *text, *place;
    } cases[] = {
        { "", "x.json:1:" },
        { "{\n\"a\": 1,\n\"b\" 2}", "x.json:3:" },
        { "{\"a\": NaN}", "x.json:1:" },
        { "{\"a\":\n1e999}", "x.json:2:" },
        { "{\"a\": 123456789012345678901234567890}", "x.json:1:" },
        { "{\"a\": 1}\n{", "x.json:2:" },
        { "{\"a\": 1, \"a\": 2}", "duplicate" },
        { "{\"a\": \"\xff\"}", "byte 0xff" },
        { "[1, 2", "x.json:1:" },
        { "3", "x.json:1:" },
    };
    struct json *doc;
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        assert_int_equal(json_parse(&doc, cases[i].text, strlen(cases[i].text), "x.json"), -EINVAL);
        assert_null(doc);
        assert_logged(cases[i].place);
    }
    static const char with_nul[] = "{\"a\": 1}\0{";
    assert_int_equal(json_parse(&doc, with_nul, sizeof(with_nul) - 1, "x.json"), -EINVAL);
    assert_logged("x.json:1:");
}

static void nesting_without_end_is_refused(void **state)
{
    (void)state;
    struct json *doc;
    enum { DEPTH = 100000 };
    char *text = malloc(2 * DEPTH);
    memset(text, '[', DEPTH);
    memset(text + DEPTH, ']', DEPTH);
    assert_int_equal(json_parse(&doc, text, 2 * DEPTH, "deep.json"), -EINVAL);
    assert_logged("depth");
    memset(text, '[', 1000);
    memset(text + 1000, ']', 1000);
    assert_int_equal(json_parse(&doc, text, 2000, "deep.json"), 0);
    json_free(doc);
    free(text);
}

static void every_truncation_is_refused(void **state)
{
    (void)state;
    struct json *doc;
    for (size_t n = 0; n + 1 < sizeof(document); n++) {
        char *exact = malloc(n ? n : 1);
        memcpy(exact, document, n);
        assert_int_equal(json_parse(&doc, exact, n, "cut.json"), -EINVAL);
        assert_logged("cut.json:");
        free(exact);
    }
}

static void a_written_document_reads_back_the_same(void **state)
{
    (void)state;
    static const double hard[] = {
        .1, 1 / 3., 1e-300, 1.7976931348623157e308, -0., 123456789.123456789, 5e-324
    };
    static const double rows[9] = { 1, 2, 3, 4, 5, 6, 7, 8, 9.5 };
    struct json *doc = json_object(), *list = json_array(), *back;
    double x, nine[9];
    int64_t i;
    bool truth;
    const char *string;
    json_set_numbers(doc, "z first", hard, 7);
    json_set_matrix3(doc, "a then", rows);
    json_set_int(doc, "int", INT64_MIN);
    json_set_bool(doc, "yes", true);
    json_set_string(doc, "text", "quote \" slash \\ line\nend \xe2\x82\xac");
    json_set_number(doc, "nan", NAN);
    json_set_number(doc, "inf", -INFINITY);
    json_set_string(doc, "bytes", "caf\xe9.exr"); // a file name in Latin-1
    json_append_string(list, "one");
    json_append(list, json_array());
    json_set(doc, "list", list);
    json_set_number(doc, "list2", 1);
    json_set_number(doc, "list2", 2); // the last word counts
    assert_int_equal(json_write(doc, path), 0);
    json_free(doc);

    assert_int_equal(json_read(&back, path), 0);
    for (int k = 0; k < 7; k++) {
        char key[32];
        snprintf(key, sizeof(key), "z first.%d", k);
        assert_int_equal(json_get_number(back, key, &x), 0);
        assert_memory_equal(&x, &hard[k], sizeof(x)); // 17 digits: bit for bit
    }
    assert_int_equal(json_get_numbers(back, "a then", nine, 9), 0);
    assert_memory_equal(nine, rows, sizeof(rows));
    assert_int_equal(json_get_int(back, "int", &i), 0);
    assert_true(i == INT64_MIN);
    assert_int_equal(json_get_bool(back, "yes", &truth), 0);
    assert_int_equal(json_get_string(back, "text", &string), 0);
    assert_string_equal(string, "quote \" slash \\ line\nend \xe2\x82\xac");
    assert_int_equal(json_get_number(back, "nan", &x), -EINVAL); // null
    assert_int_equal(json_get_number(back, "inf", &x), -EINVAL);
    assert_int_equal(json_get_string(back, "bytes", &string), 0);
    assert_string_equal(string, "caf?.exr");
    assert_int_equal(json_get_string(back, "list.0", &string), 0);
    assert_int_equal(json_length(back, "list.1"), 0);
    assert_int_equal(json_get_number(back, "list2", &x), 0);
    assert_true(x == 2);
    json_free(back);
}

static void the_text_keeps_the_order_of_insertion(void **state)
{
    (void)state;
    static const double two[] = { 1, .5 };
    struct json *doc = json_object();
    json_set_int(doc, "z", 1);
    json_set_numbers(doc, "a", two, 2);
    json_set_bool(doc, "m", false);
    char *text = json_text(doc);
    assert_string_equal(text, "{\"z\":1,\"a\":[1.0,0.5],\"m\":false}");
    free(text);
    assert_int_equal(json_write(doc, path), 0);
    char file[256] = { 0 };
    FILE *f = fopen(path, "r");
    assert_true(fread(file, 1, sizeof(file) - 1, f) > 0);
    fclose(f);
    assert_string_equal(file, "{\n \"z\": 1,\n \"a\": [\n  1.0,\n  0.5\n ],\n \"m\": false\n}\n");
    json_free(doc);
}

// What a client or a program sent is JSON, but not what was expected: that costs nothing else in this process.
static void adding_to_what_cannot_hold_it_is_refused_and_spoils_nothing(void **state)
{
    (void)state;
    static const double two[] = { 1, 2 };
    static const double rows[9] = { 0 };
    struct json *list = parse("[1]"), *doc = json_object(), *back;
    assert_int_equal(json_set(list, "key", json_object()), -EINVAL);
    assert_int_equal(json_set_string(list, "key", "text"), -EINVAL);
    assert_int_equal(json_set_number(list, "key", .5), -EINVAL);
    assert_int_equal(json_set_int(list, "key", 1), -EINVAL);
    assert_int_equal(json_set_bool(list, "key", true), -EINVAL);
    assert_int_equal(json_set_numbers(list, "key", two, 2), -EINVAL);
    assert_int_equal(json_set_matrix3(list, "key", rows), -EINVAL);
    assert_int_equal(json_append(doc, json_object()), -EINVAL);
    assert_int_equal(json_append_string(doc, "text"), -EINVAL);
    char *left[] = { json_text(list), json_text(doc) };
    assert_string_equal(left[0], "[1]");
    assert_string_equal(left[1], "{}");
    assert_int_equal(json_set(doc, "list", list), 0);
    assert_int_equal(json_write(doc, path), 0); // this process still writes
    assert_int_equal(json_read(&back, path), 0);
    assert_int_equal(json_length(back, "list"), 1);
    free(left[0]), free(left[1]);
    json_free(doc), json_free(back);
}

static void numbers_have_a_point_in_any_language(void **state)
{
    (void)state;
    static const char *const comma_locales[] = { "de_DE.UTF-8", "de_DE.utf8", "fr_FR.UTF-8",
                                                 "de_DE", NULL };
    const char *const *name = comma_locales;
    while (*name && !setlocale(LC_ALL, *name))
        name++;
    if (!*name) {
        fprintf(stderr, "test_json: no locale with a decimal comma here: not tried\n");
        return;
    }
    struct json *doc = parse("{\"x\": 2.5}");
    double x;
    assert_int_equal(json_get_number(doc, "x", &x), 0);
    assert_true(x == 2.5);
    char *text = json_text(doc);
    assert_string_equal(text, "{\"x\":2.5}");
    free(text);
    json_free(doc);
    setlocale(LC_ALL, "C");
}

static void files_that_cannot_be_read_or_written_are_named(void **state)
{
    (void)state;
    struct json *doc;
    char other[700];
    snprintf(other, sizeof(other), "%s/missing.json", scratch_dir);
    assert_int_equal(json_read(&doc, other), -ENOENT);
    assert_logged("missing.json");
    assert_int_equal(json_read(&doc, scratch_dir), -EISDIR);
    assert_logged(scratch_dir);
    snprintf(other, sizeof(other), "%s/huge.json", scratch_dir);
    FILE *f = fopen(other, "w");
    fclose(f);
    assert_int_equal(truncate(other, ((off_t)256 << 20) + 1), 0); // sparse
    assert_int_equal(json_read(&doc, other), -EFBIG);
    assert_logged("huge.json");
    remove(other);
    doc = json_object();
    snprintf(other, sizeof(other), "%s/no/such.json", scratch_dir);
    assert_int_equal(json_write(doc, other), -ENOENT);
    assert_logged("no/such.json");
    assert_int_equal(json_write(NULL, path), -ENOMEM); // a tree that could not even begin
    assert_logged(path);
    json_free(doc);
    json_free(NULL);
}

static int make_folder(void **state)
{
    (void)state;
    log_set_hook(keep_line, NULL);
    log_set_level(LOG_SILENT);
    if (scratch_open())
        return -1;
    snprintf(path, sizeof(path), "%s/doc.json", scratch_dir);
    return 0;
}

static int remove_folder(void **state)
{
    (void)state;
    remove(path);
    return scratch_close();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(paths_reach_nested_values_and_array_elements),
        cmocka_unit_test(missing_is_enoent_and_mistyped_is_einval_and_out_is_kept),
        cmocka_unit_test(what_was_required_is_named_with_what_was_found),
        cmocka_unit_test(broken_text_is_refused_with_its_line),
        cmocka_unit_test(nesting_without_end_is_refused),
        cmocka_unit_test(every_truncation_is_refused),
        cmocka_unit_test(a_written_document_reads_back_the_same),
        cmocka_unit_test(the_text_keeps_the_order_of_insertion),
        cmocka_unit_test(adding_to_what_cannot_hold_it_is_refused_and_spoils_nothing),
        cmocka_unit_test(numbers_have_a_point_in_any_language),
        cmocka_unit_test(files_that_cannot_be_read_or_written_are_named),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
