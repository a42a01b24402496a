// tests/test_progress.c - how far work has come, as a reader of the JSON lines sees it.
#include "solver/take/json.h"
#include "solver/take/progress.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

static int fd[2];

// What was said since the last time has all of this, in this order. On a slow machine more may be said between.
static void assert_said(const char *const *expected)
{
    char text[4096], *rest = text;
    progress_set_fd(-1);
    assert_int_equal(close(fd[1]), 0);
    size_t n = 0;
    for (ssize_t got; (got = read(fd[0], text + n, sizeof(text) - 1 - n)) > 0;)
        n += (size_t)got;
    text[n] = 0;
    close(fd[0]);
    for (const char *line; (line = strsep(&rest, "\n")) && *line;) {
        struct json *v;
        const char *stage;
        int64_t done, total;
        double seconds;
        char said[64];
        assert_int_equal(json_parse(&v, line, strlen(line), "line"), 0);
        assert_int_equal(json_get_string(v, "stage", &stage), 0);
        assert_int_equal(json_get_int(v, "done", &done), 0);
        assert_int_equal(json_get_int(v, "total", &total), 0);
        assert_int_equal(json_get_number(v, "seconds", &seconds), 0);
        snprintf(said, sizeof(said), "%s %d/%d", stage, (int)done, (int)total);
        expected += *expected && !strcmp(said, *expected);
        json_free(v);
    }
    if (*expected)
        fail_msg("\"%s\" was not said, or not then", *expected);
}

static void listen_again(void)
{
    assert_int_equal(pipe(fd), 0);
    progress_set_fd(fd[1]);
}

static void a_while(void)
{
    usleep(150000); // longer than between two lines
}

static void a_stage_says_where_it_begins_and_ends_and_how_far_it_is(void **state)
{
    (void)state;
    listen_again();
    progress_begin("render", 3);
    progress_add(1);
    a_while();
    progress_add(1);
    progress_add(1);
    progress_end();
    progress_add(1); // of nothing
    assert_said((const char *const[]){ "render 0/3", "render 2/3", "render 3/3", NULL });
}

// The lights are traced anew at each step of the solve: the solve must not fall silent after the first.
static void a_stage_goes_on_when_one_within_it_has_ended(void **state)
{
    (void)state;
    listen_again();
    progress_begin("solve", 5);
    progress_add(2);
    progress_begin("trace", 1000);
    progress_add(1000);
    progress_end();
    a_while();
    progress_add(1);
    progress_begin("trace", 1000);
    a_while();
    progress_add(400);
    progress_begin("light", 7);
    a_while();
    progress_add(7);
    progress_end();
    a_while();
    progress_add(600);
    progress_end();
    progress_add(1);
    progress_end();
    assert_said((const char *const[]){ "solve 0/5", "solve 3/5", "trace 400/1000", "light 7/7", "trace 400/1000", "trace 1000/1000", "solve 3/5", "solve 4/5", NULL });
}

static void a_reader_that_has_gone_is_survived(void **state)
{
    (void)state;
    listen_again();
    progress_begin("render", 3);
    close(fd[0]);
    a_while();
    progress_add(1); // EPIPE, no signal
    a_while();
    progress_add(1);
    progress_end();
    close(fd[1]);
    progress_set_fd(-1);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_stage_says_where_it_begins_and_ends_and_how_far_it_is),
        cmocka_unit_test(a_stage_goes_on_when_one_within_it_has_ended),
        cmocka_unit_test(a_reader_that_has_gone_is_survived),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
