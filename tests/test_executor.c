// tests/test_executor.c - programs are heard in bounded pieces, obey pause and end, and leave nothing behind.
#include "rigd/executor.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <setjmp.h>
#include <signal.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>
#include <cmocka.h>

#include "tests/scratch.h"

static struct seen {
    int n_lines, n_ended, last_job;
    char line[EXECUTOR_LINE_MAX], said[EXECUTOR_LINE_MAX], complaint[EXECUTOR_LINE_MAX];
    bool signalled;
    int code;
} seen;

static void on_line(void *arg, int job, const char *line)
{
    (void)arg, (void)job;
    seen.n_lines++;
    snprintf(seen.line, sizeof(seen.line), "%s", line);
}

static void on_ended(void *arg, int job, const struct executor_end *end)
{
    (void)arg;
    seen.n_ended++;
    seen.last_job = job;
    seen.signalled = end->signalled;
    seen.code = end->code;
    snprintf(seen.said, sizeof(seen.said), "%s", end->said);
    snprintf(seen.complaint, sizeof(seen.complaint), "%s", end->complaint);
}

static struct executor *open_executor(void)
{
    struct executor *e;
    const struct executor_host host = { on_line, on_ended, NULL };
    memset(&seen, 0, sizeof(seen));
    assert_int_equal(executor_open(&e, &host), 0);
    return e;
}

static int start_shell(struct executor *e, const char *script, bool progress, const char *log)
{
    struct executor_command c = { .progress = progress };
    executor_add_words(&c, "/bin/sh  -c");
    executor_add_word(&c, script);
    snprintf(c.dir, sizeof(c.dir), "%s", scratch_dir);
    snprintf(c.log_path, sizeof(c.log_path), "%s", log);
    const int job = executor_start(e, &c);
    executor_command_free(&c);
    return job;
}

enum { PATIENCE_S = 60 }; // of a machine that is too busy

static bool wait_for(struct executor *e, const int *count, int n)
{
    const time_t end = time(NULL) + PATIENCE_S;
    while (*count < n && time(NULL) < end) {
        struct pollfd p = { executor_fd(e), POLLIN, 0 };
        poll(&p, 1, 20);
        executor_dispatch(e);
    }
    return *count >= n;
}

static char state_of(int pid)
{
    char path[40], line[200] = "";
    snprintf(path, sizeof(path), "/proc/%d/stat", pid);
    FILE *f = fopen(path, "r");
    const bool got = f && fgets(line, sizeof(line), f);
    if (f)
        fclose(f);
    const char *paren = got ? strrchr(line, ')') : NULL;
    return paren ? paren[2] : 0;
}

static bool becomes(int pid, const char *states) // 'X' stands for gone, reaped or not
{
    for (int turn = 0; turn < PATIENCE_S * 50; turn++) {
        const char s = state_of(pid);
        if (strchr(states, s && s != 'Z' ? s : 'X'))
            return true;
        nanosleep(&(struct timespec){ 0, 20000000 }, NULL);
    }
    return false;
}

static int number_in_time(const char *name) // 0: it did not come
{
    int n = 0;
    for (int turn = 0; turn < PATIENCE_S * 100 && n < 1; turn++) {
        FILE *f = fopen(scratch_path(name), "r");
        if (!f || fscanf(f, "%d", &n) != 1)
            n = 0;
        if (f)
            fclose(f);
        nanosleep(&(struct timespec){ 0, 10000000 }, NULL);
    }
    return n;
}

static int number_in(const char *name)
{
    const int n = number_in_time(name);
    assert_true(n > 1); // 0 would be all of us to kill()
    return n;
}

static void what_a_program_says_is_heard(void **state)
{
    (void)state;
    struct executor *e = open_executor();
    const int job = start_shell(e, "echo first; echo last; echo chatter >&2; echo 'x: error: no raw' >&2; echo more >&2; echo '{\"done\":1}' >&3; printf unfinished >&3; exit 7", true, "");
    assert_true(job >= 0);
    assert_true(wait_for(e, &seen.n_ended, 1));
    assert_int_equal(seen.last_job, job);
    assert_false(seen.signalled);
    assert_int_equal(seen.code, 7);
    assert_string_equal(seen.said, "last");
    assert_string_equal(seen.complaint, "x: error: no raw");
    assert_int_equal(seen.n_lines, 2);
    assert_string_equal(seen.line, "unfinished");
    executor_close(e);
}

static void a_flood_or_an_endless_line_harms_nobody(void **state)
{
    (void)state;
    struct executor *e = open_executor();
    assert_true(start_shell(e, "head -c 3000000 /dev/zero | tr '\\0' a; echo; echo end; head -c 100000 /dev/zero; head -c 200000 /dev/zero >&2", false, "") >= 0);
    assert_true(wait_for(e, &seen.n_ended, 1));
    assert_int_equal(seen.code, 0);
    assert_int_equal(strlen(seen.said), EXECUTOR_LINE_MAX - 1); // zeroes are blanks
    assert_int_equal(seen.said[0], ' ');
    executor_close(e);
}

static void a_log_takes_what_it_says(void **state)
{
    (void)state;
    struct executor *e = open_executor();
    char text[100] = "";
    scratch_write("log", "old and long", 12);
    assert_true(start_shell(e, "echo out; echo err >&2; exit 1", false, scratch_path("log")) >= 0);
    assert_true(wait_for(e, &seen.n_ended, 1));
    assert_string_equal(seen.said, "");
    FILE *f = fopen(scratch_path("log"), "r");
    assert_int_equal(fread(text, 1, sizeof(text) - 1, f), 8);
    fclose(f);
    assert_string_equal(text, "out\nerr\n");
    executor_close(e);
}

static void what_cannot_be_run_says_why(void **state)
{
    (void)state;
    struct executor *e = open_executor();
    struct executor_command c = { .log_path = "" }, many = { .log_path = "" };
    executor_add_word(&c, "/nowhere/rigsolve");
    assert_true(executor_start(e, &c) >= 0);
    assert_true(wait_for(e, &seen.n_ended, 1));
    assert_int_equal(seen.code, 127);
    assert_non_null(strstr(seen.complaint, "cannot run /nowhere/rigsolve: No such file"));
    for (int i = 0; i <= EXECUTOR_WORDS_MAX; i++)
        executor_add_word(&many, "word");
    assert_int_equal(executor_start(e, &many), -E2BIG);
    executor_command_free(&c);
    executor_command_free(&many);
    executor_close(e);
}

static void paused_is_stopped_and_a_stopped_one_still_ends(void **state)
{
    (void)state;
    struct executor *e = open_executor();
    const int job = start_shell(e, "echo $$ >pid; sleep 1000 & echo $! >child; wait", false, "");
    const int pid = number_in("pid"), child = number_in("child");
    executor_signal(e, job, EXECUTOR_PAUSE);
    assert_true(becomes(pid, "T"));
    assert_true(becomes(child, "T"));
    executor_signal(e, job, EXECUTOR_CONTINUE);
    assert_true(becomes(child, "S"));
    executor_signal(e, job, EXECUTOR_PAUSE);
    assert_true(becomes(pid, "T"));
    executor_signal(e, job, EXECUTOR_TERM);
    assert_true(wait_for(e, &seen.n_ended, 1));
    assert_true(seen.signalled);
    assert_int_equal(seen.code, SIGTERM);
    assert_true(becomes(child, "X"));
    executor_close(e);
    unlink(scratch_path("pid")), unlink(scratch_path("child"));
}

static pid_t parent_of(int pid)
{
    char path[40], text[400] = "";
    int parent = 0;
    snprintf(path, sizeof(path), "/proc/%d/stat", pid);
    FILE *f = fopen(path, "r");
    if (f && fgets(text, sizeof(text), f) && strrchr(text, ')'))
        sscanf(strrchr(text, ')') + 1, " %*c %d", &parent);
    if (f)
        fclose(f);
    assert_true(parent > 1);
    return parent;
}

// A keeper that gets no processor for a while finds all of them at once.
static void the_last_one_asked_for_holds(void **state)
{
    (void)state;
    struct executor *e = open_executor();
    const int job = start_shell(e, "echo $$ >pid; sleep 1000", false, "");
    const int pid = number_in("pid"), keeper = parent_of(pid);
    executor_signal(e, job, EXECUTOR_PAUSE);
    assert_true(becomes(pid, "T"));
    kill(keeper, SIGSTOP);
    assert_true(becomes(keeper, "T"));
    executor_signal(e, job, EXECUTOR_CONTINUE);
    executor_signal(e, job, EXECUTOR_PAUSE);
    executor_signal(e, job, EXECUTOR_CONTINUE);
    executor_signal(e, job, EXECUTOR_PAUSE);
    kill(keeper, SIGCONT);
    for (int turn = 0; turn < 10; turn++) {
        assert_true(becomes(keeper, "S"));
        assert_true(becomes(pid, "T"));
        nanosleep(&(struct timespec){ 0, 20000000 }, NULL);
    }
    assert_int_equal(state_of(pid), 'T');
    executor_close(e);
    unlink(scratch_path("pid"));
}

static void one_that_does_not_listen_is_killed_with_its_children(void **state)
{
    (void)state;
    struct executor *e = open_executor();
    const int job = start_shell(e, "trap '' TERM; sleep 1000 & echo $! >child; echo $$ >pid; while :; do sleep .05; done", false, "");
    const int pid = number_in("pid"), child = number_in("child");
    executor_signal(e, job, EXECUTOR_TERM);
    nanosleep(&(struct timespec){ 0, 200000000 }, NULL);
    executor_dispatch(e);
    assert_int_equal(seen.n_ended, 0);
    executor_signal(e, job, EXECUTOR_KILL);
    assert_true(wait_for(e, &seen.n_ended, 1));
    assert_int_equal(seen.code, SIGKILL);
    assert_true(becomes(pid, "X"));
    assert_true(becomes(child, "X"));
    executor_signal(e, job, EXECUTOR_KILL); // long gone
    executor_close(e);
    unlink(scratch_path("pid")), unlink(scratch_path("child"));
}

// However the daemon ends, even while the work is paused: killed with -9 by a parent that is killed with -9.
static void nothing_outlives_the_daemon(void **state)
{
    (void)state;
    for (int paused = 0; paused < 2; paused++) {
        const pid_t daemon = fork();
        if (daemon == 0) {
            prctl(PR_SET_PDEATHSIG, SIGKILL); // a test that fails leaves it alone
            struct executor *e = open_executor();
            const int job = start_shell(e, "sleep 1000 & echo $! >child; echo $$ >pid; wait", false, "");
            number_in_time("pid"); // no assertions: another process would go on with the tests
            if (paused)
                executor_signal(e, job, EXECUTOR_PAUSE);
            for (;;)
                pause();
        }
        const int pid = number_in("pid"), child = number_in("child");
        if (paused)
            assert_true(becomes(pid, "T"));
        kill(daemon, SIGKILL);
        waitpid(daemon, NULL, 0);
        assert_true(becomes(pid, "X"));
        assert_true(becomes(child, "X"));
        unlink(scratch_path("pid")), unlink(scratch_path("child"));
    }
}

// What a new daemon waits for before it touches anything.
static void a_shared_lock_is_held_as_long_as_the_work_of_a_killed_daemon(void **state)
{
    (void)state;
    // What the dead daemon leaves comes to us, not to init: init is in another session, which makes the keeper's group an orphaned
    // one, and the kernel wakes the stopped members of such a group (POSIX: SIGHUP, then SIGCONT).
    assert_int_equal(prctl(PR_SET_CHILD_SUBREAPER, 1), 0);
    const pid_t daemon = fork();
    if (daemon == 0) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        struct executor *e = open_executor();
        executor_lock(e, open(scratch_path("lock"), O_RDWR | O_CREAT | O_CLOEXEC, 0600));
        start_shell(e, "setsid sleep 1000 & echo $! >child; echo $$ >pid; exec sleep 1000", false, ""); // a child that gets away does not count
        for (;;)
            pause();
    }
    const int pid = number_in("pid"), child = number_in("child"), lock = open(scratch_path("lock"), O_RDWR | O_CLOEXEC);
    const pid_t keeper = parent_of(pid);
    assert_true(keeper > 1 && keeper != daemon);
    kill(keeper, SIGSTOP); // as good as a machine that is too busy
    assert_true(becomes(keeper, "T"));
    kill(daemon, SIGKILL);
    waitpid(daemon, NULL, 0);
    nanosleep(&(struct timespec){ 0, 100000000 }, NULL);
    assert_int_equal(executor_lock_file(lock, true), -EAGAIN);
    kill(keeper, SIGCONT);
    assert_true(becomes(keeper, "X"));
    int err = -EAGAIN;
    for (int turn = 0; turn < PATIENCE_S * 100 && err; turn++) {
        err = executor_lock_file(lock, true);
        assert_true(err || strchr("ZX", state_of(pid) ? state_of(pid) : 'X'));
        nanosleep(&(struct timespec){ 0, 10000000 }, NULL);
    }
    assert_int_equal(err, 0);
    kill(child, SIGKILL);
    while (waitpid(-1, NULL, 0) > 0)
        continue;
    prctl(PR_SET_CHILD_SUBREAPER, 0);
    close(lock);
    unlink(scratch_path("pid")), unlink(scratch_path("child")), unlink(scratch_path("lock"));
}

static void a_keeper_that_is_killed_leaves_nothing_behind(void **state)
{
    (void)state;
    struct executor *e = open_executor();
    assert_true(start_shell(e, "sleep 1000 & echo $! >child; echo $$ >pid; wait", false, "") >= 0);
    const int pid = number_in("pid"), child = number_in("child");
    kill(parent_of(pid), SIGKILL);
    assert_true(wait_for(e, &seen.n_ended, 1));
    assert_true(seen.signalled && seen.code == SIGKILL);
    assert_true(becomes(pid, "X"));
    assert_true(becomes(child, "X"));
    executor_close(e);
    unlink(scratch_path("pid")), unlink(scratch_path("child"));
}

static void programs_see_only_what_is_theirs_and_stand_back(void **state)
{
    (void)state;
    struct executor *e = open_executor();
    const int secret = open("/dev/null", O_RDONLY); // not close-on-exec: as a library might
    assert_true(secret >= 0);
    // by the shell itself: a pipeline or ls would have descriptors of their own open
    assert_true(start_shell(e, "n=0; while [ $n -lt 64 ]; do [ -e /proc/$$/fd/$n ] && printf \"$n \"; n=$((n + 1)); done; cut -d' ' -f19 /proc/$$/stat; echo >&3 x", true, "") >= 0);
    assert_true(wait_for(e, &seen.n_ended, 1));
    const int own = getpriority(PRIO_PROCESS, 0);
    char expected[32];
    snprintf(expected, sizeof(expected), "0 1 2 3 %d", own > 10 ? own : 10);
    assert_string_equal(seen.said, expected);
    close(secret);
    executor_close(e);
}

static int set_up(void **state)
{
    (void)state;
    return scratch_open();
}

static int no_leftovers(void **state) // a failed test's numbers are not the next one's
{
    (void)state;
    scratch_empty();
    return 0;
}

static int tear_down(void **state)
{
    (void)state;
    scratch_empty();
    return scratch_close();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup(what_a_program_says_is_heard, no_leftovers),
        cmocka_unit_test_setup(a_flood_or_an_endless_line_harms_nobody, no_leftovers),
        cmocka_unit_test_setup(a_log_takes_what_it_says, no_leftovers),
        cmocka_unit_test_setup(what_cannot_be_run_says_why, no_leftovers),
        cmocka_unit_test_setup(paused_is_stopped_and_a_stopped_one_still_ends, no_leftovers),
        cmocka_unit_test_setup(the_last_one_asked_for_holds, no_leftovers),
        cmocka_unit_test_setup(one_that_does_not_listen_is_killed_with_its_children, no_leftovers),
        cmocka_unit_test_setup(nothing_outlives_the_daemon, no_leftovers),
        cmocka_unit_test_setup(a_shared_lock_is_held_as_long_as_the_work_of_a_killed_daemon, no_leftovers),
        cmocka_unit_test_setup(a_keeper_that_is_killed_leaves_nothing_behind, no_leftovers),
        cmocka_unit_test_setup(programs_see_only_what_is_theirs_and_stand_back, no_leftovers),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
