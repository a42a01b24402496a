// tests/test_csv.c - tables are read by column name, and what is wrong is named with line and column.
#include "solver/csv.h"
#include "solver/take/log.h"

#include <errno.h>
#include <locale.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

static char message[512];

static void keep_message(void *arg, enum log_level level, const char *text)
{
    (void)arg, (void)level;
    snprintf(message, sizeof(message), "%s", text);
}

static int set_up(void **state)
{
    (void)state;
    log_set_hook(keep_message, NULL);
    return 0;
}

static int open_string(struct csv *c, const char *text)
{
    message[0] = 0;
    return csv_open_text(c, text, strlen(text), "t.csv");
}

static void assert_said(const char *what)
{
    if (!strstr(message, what))
        fail_msg("'%s' does not say '%s'", message, what);
}

static void columns_are_found_by_name(void **state)
{
    (void)state;
    struct csv c;
    double value;
    assert_int_equal(open_string(&c, "\xef\xbb\xbf" "b,tag,a\r\n2,x,-1.5e-3\r\n\r\n.5,,+7\n"), 0);
    assert_int_equal(csv_find(&c, "a"), 2);
    assert_int_equal(csv_find(&c, "b"), 0);
    assert_int_equal(csv_find(&c, "A"), -ENOENT);
    assert_int_equal(csv_next_row(&c), 1);
    assert_int_equal(csv_number(&c, 2, &value), 0);
    assert_true(value == -1.5e-3);
    assert_string_equal(c.field[1], "x");
    assert_int_equal(csv_next_row(&c), 1);
    assert_int_equal(c.line, 4); // the empty one counts
    assert_int_equal(csv_number(&c, 0, &value), 0);
    assert_true(value == .5);
    assert_string_equal(c.field[1], "");
    assert_int_equal(csv_next_row(&c), 0);
    csv_close(&c);
}

static void a_row_of_another_length_is_refused(void **state)
{
    (void)state;
    static const char *const tables[] = { "a,b\n1,2\n3\n", "a,b\n1,2\n3,4,5\n", "a,b\n1,2\n3,4," };
    for (size_t i = 0; i < sizeof(tables) / sizeof(tables[0]); i++) {
        struct csv c;
        assert_int_equal(open_string(&c, tables[i]), 0);
        assert_int_equal(csv_next_row(&c), 1);
        assert_int_equal(csv_next_row(&c), -EINVAL);
        assert_said("t.csv:3: found");
        assert_said("expected 2");
        csv_close(&c);
    }
}

static void what_is_no_number_is_refused(void **state)
{
    (void)state;
    static const char *const fields[] = { "", "x", "1x", "nan", "inf", "0x10", " 1", "1 ", "1e999", "--1", "1.2.3", "e5", "." };
    for (size_t i = 0; i < sizeof(fields) / sizeof(fields[0]); i++) {
        struct csv c;
        char text[64];
        double value = 42;
        snprintf(text, sizeof(text), "a,speed\n1,%s\n", fields[i]);
        assert_int_equal(open_string(&c, text), 0);
        assert_int_equal(csv_next_row(&c), 1);
        assert_int_equal(csv_number(&c, 1, &value), -EINVAL);
        assert_said("t.csv:2: column 'speed'");
        assert_true(value == 42);
        csv_close(&c);
    }
}

static void files_that_are_no_tables_are_refused(void **state)
{
    (void)state;
    struct csv c;
    assert_int_equal(open_string(&c, ""), -EINVAL);
    assert_said("empty");
    assert_int_equal(open_string(&c, "\n\r\n"), -EINVAL);
    assert_int_equal(open_string(&c, "a,\"b\"\n"), -EINVAL);
    assert_said("quotation");
    assert_int_equal(csv_open_text(&c, "a\0b\n", 4, "t.csv"), -EINVAL);
    assert_said("zero byte");
    assert_null(c.text);
    char *wide = malloc(5001);
    memset(wide, ',', 5000);
    wide[5000] = 0;
    assert_int_equal(open_string(&c, wide), -EINVAL);
    assert_said("at most 4096");
    free(wide);
    assert_int_equal(csv_open(&c, "no/such/file.csv"), -ENOENT);
    assert_said("no/such/file.csv");
    assert_int_equal(csv_open(&c, "tests"), -EIO); // a folder
}

static void commas_of_the_locale_change_nothing(void **state)
{
    (void)state;
    struct csv c;
    double value = 0;
    const char *const german = setlocale(LC_ALL, "de_DE.UTF-8"); // where it is installed, the decimal point is a comma
    assert_int_equal(open_string(&c, "a\n2.5\n"), 0);
    assert_int_equal(csv_next_row(&c), 1);
    assert_int_equal(csv_number(&c, 0, &value), 0);
    assert_true(value == 2.5);
    csv_close(&c);
    if (!german)
        fprintf(stderr, "# no German locale here: tried in C only\n");
    setlocale(LC_ALL, "C");
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(columns_are_found_by_name),
        cmocka_unit_test(a_row_of_another_length_is_refused),
        cmocka_unit_test(what_is_no_number_is_refused),
        cmocka_unit_test(files_that_are_no_tables_are_refused),
        cmocka_unit_test(commas_of_the_locale_change_nothing),
    };
    return cmocka_run_group_tests(tests, set_up, NULL);
}
