// tests/vm/test_gpio_vm.c - inside the virtual machine of run.sh: the GPIO trigger against the kernel's simulated chip.
//
// The chip's wires are seen and pulled through gpio-sim's files in /sys, past libgpiod. Runs as the only user of the machine.
#include "rigd/trigger.h"
#include "solver/take/log.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <setjmp.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>
#include <cmocka.h>

#define MS INT64_C(1000000)

enum { CAMERAS = 85, FULL = 0, HALF = 90, FEEDBACK = 180, RELAY = 270, BUTTON = 360, LINES = 400 };

static struct { char label[16], sys[160]; } chip[2]; // 0: frees a line to its rest, 1: keeps its level

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static void write_file(const char *path, const char *text)
{
    const int fd = open(path, O_WRONLY);
    if (fd < 0 || write(fd, text, strlen(text)) < 0)
        fail_msg("%s: %s", path, strerror(errno));
    close(fd);
}

static void read_file(const char *path, char *text, size_t size)
{
    const int fd = open(path, O_RDONLY);
    const ssize_t n = fd < 0 ? -1 : read(fd, text, size - 1);
    if (n < 0)
        fail_msg("%s: %s", path, strerror(errno));
    text[n] = '\0';
    text[strcspn(text, "\n")] = '\0';
    close(fd);
}

static const char *in_configfs(int c, const char *name)
{
    static char path[120];
    snprintf(path, sizeof(path), "/sys/kernel/config/gpio-sim/%.15s/%.40s", chip[c].label, name);
    return path;
}

static int make_chips(void **state)
{
    (void)state;
    for (int i = 0; i < 2; i++) {
        char lines[16], device[64], name[64];
        snprintf(chip[i].label, sizeof(chip[i].label), i ? "keeps" : "rests");
        write_file("/sys/module/gpio_simulated/parameters/keep", i ? "Y" : "N");
        mkdir(in_configfs(i, ""), 0755);
        mkdir(in_configfs(i, "bank"), 0755);
        snprintf(lines, sizeof(lines), "%d", LINES);
        write_file(in_configfs(i, "bank/num_lines"), lines);
        write_file(in_configfs(i, "bank/label"), chip[i].label);
        write_file(in_configfs(i, "live"), "1");
        read_file(in_configfs(i, "dev_name"), device, sizeof(device));
        read_file(in_configfs(i, "bank/chip_name"), name, sizeof(name));
        snprintf(chip[i].sys, sizeof(chip[i].sys), "/sys/devices/platform/%s/%s", device, name);
    }
    return 0;
}

static int value(int c, int line)
{
    char path[240], text[8];
    snprintf(path, sizeof(path), "%s/sim_gpio%d/value", chip[c].sys, line);
    read_file(path, text, sizeof(text));
    return atoi(text);
}

static void pull(int c, int line, bool up)
{
    char path[240];
    snprintf(path, sizeof(path), "%s/sim_gpio%d/pull", chip[c].sys, line);
    write_file(path, up ? "pull-up" : "pull-down");
}

static int n_high(int c)
{
    int n = 0;
    for (int i = 0; i < CAMERAS; i++)
        n += value(c, FULL + i) + value(c, HALF + i) + value(c, RELAY + i);
    return n;
}

static struct config_camera camera[CAMERAS];
static struct config config;

static void wire(int c, bool active_low)
{
    memset(&config, 0, sizeof(config));
    config.n_cameras = CAMERAS;
    config.camera = camera;
    config.trigger = (struct trigger_config){ .kind = TRIGGER_GPIO, .full_line = CONFIG_NONE, .half_line = CONFIG_NONE,
        .active_low = active_low, .button_line = BUTTON, .button_active_low = true, .button_debounce_ms = 15, .max_hold_ms = 3000 };
    snprintf(config.trigger.chip, sizeof(config.trigger.chip), "%s", chip[c].label);
    for (int i = 0; i < CAMERAS; i++) {
        camera[i] = (struct config_camera){ .full_line = FULL + i, .half_line = HALF + i, .feedback_line = FEEDBACK + i, .relay_line = RELAY + i };
        snprintf(camera[i].name, sizeof(camera[i].name), "A%02d", i);
    }
}

static struct { int n_fired, err, n_feedback, camera, n_button; int64_t pressed_ns, late_ns, feedback_ns, button_ns; } heard;

static void on_fired(void *arg, int err, int64_t pressed_ns, int64_t late_ns)
{
    (void)arg;
    heard.n_fired++;
    heard.err = err;
    heard.pressed_ns = pressed_ns;
    heard.late_ns = late_ns;
}

static void on_feedback(void *arg, int cam, int64_t at_ns)
{
    (void)arg;
    heard.n_feedback++;
    heard.camera = cam;
    heard.feedback_ns = at_ns;
}

static void on_button(void *arg, int64_t at_ns)
{
    (void)arg;
    heard.n_button++;
    heard.button_ns = at_ns;
}

static void on_broken(void *arg, int err)
{
    (void)arg;
    fail_msg("broken: %s", strerror(-err));
}

static const struct trigger_host host = { .fired = on_fired, .feedback = on_feedback, .button = on_button, .broken = on_broken };

static void serve(struct trigger *t, const int *count, int n)
{
    const int64_t end_ns = clock_ns() + 20000 * MS;
    while (*count < n) {
        struct pollfd p = { trigger_fd(t), POLLIN, 0 };
        assert_true(clock_ns() < end_ns);
        poll(&p, 1, 100);
        trigger_dispatch(t);
    }
}

// ---- what the wires do, seen by polling -------------------------------------------------------------------------------------------------

struct watcher {
    int c, line[4];
    atomic_bool stop;
    int n;
    struct { int64_t at_ns; uint8_t bits; } change[64];
    int64_t gap_ns; // longest time between two looks
    uint8_t rest;
};

static void *watch(void *arg)
{
    struct watcher *w = arg;
    int fd[4];
    uint8_t last = w->rest;
    int64_t before_ns = clock_ns();
    for (int i = 0; i < 4; i++) {
        char path[240];
        snprintf(path, sizeof(path), "%s/sim_gpio%d/value", chip[w->c].sys, w->line[i]);
        fd[i] = open(path, O_RDONLY);
    }
    while (!w->stop) {
        uint8_t bits = 0;
        for (int i = 0; i < 4; i++) {
            char text[4];
            bits |= (uint8_t)(pread(fd[i], text, sizeof(text), 0) > 0 && text[0] == '1') << i;
        }
        const int64_t now_ns = clock_ns();
        w->gap_ns = now_ns - before_ns > w->gap_ns ? now_ns - before_ns : w->gap_ns;
        before_ns = now_ns;
        if (bits != last && w->n < 64) {
            w->change[w->n].at_ns = now_ns;
            w->change[w->n++].bits = bits;
        }
        last = bits;
    }
    for (int i = 0; i < 4; i++)
        close(fd[i]);
    return NULL;
}

static int64_t when(const struct watcher *w, int line, bool rises)
{
    for (int i = 0; i < w->n; i++) {
        const uint8_t before = i ? w->change[i - 1].bits : w->rest;
        if ((w->change[i].bits >> line & 1) == rises && (before >> line & 1) != rises)
            return w->change[i].at_ns;
    }
    fail_msg("line %d never %s", w->line[line], rises ? "rose" : "fell");
    return 0;
}

// One shot, watched. false: this machine stood still too long to see a line for its 120 ms, or to press it in time.
static bool watched_shot(struct trigger *t, struct watcher *w, const struct trigger_shot *shot)
{
    pthread_t thread;
    memset(&heard, 0, sizeof(heard));
    pthread_create(&thread, NULL, watch, w);
    const int err = trigger_fire(t, shot);
    if (!err)
        serve(t, &heard.n_fired, 1);
    usleep(100000);
    w->stop = true;
    pthread_join(thread, NULL);
    return !err && heard.err == 0 && w->gap_ns < 50 * MS;
}

static void half_then_full_then_both_released_on_the_wire(void **state)
{
    (void)state;
    uint32_t delay_us[CAMERAS] = { 0 };
    delay_us[CAMERAS - 1] = 60000;
    for (int low = 0; low < 2; low++) {
        struct trigger *t;
        struct trigger_shot shot;
        struct watcher w;
        bool seen = false;
        wire(0, low);
        assert_int_equal(trigger_open(&t, &config, &host), 0);
        assert_int_equal(n_high(0), low ? 3 * CAMERAS : 0); // released from the first instant
        for (int i = 0; i < 10 && !seen; i++) {
            w = (struct watcher){ .c = 0, .line = { HALF, FULL, FULL + CAMERAS - 1, RELAY }, .rest = low ? 15 : 0 };
            shot = (struct trigger_shot){ .at_ns = clock_ns() + 400 * MS, .half_ms = 200, .hold_ms = 120, .delay_us = delay_us };
            seen = watched_shot(t, &w, &shot);
        }
        assert_int_equal(n_high(0), low ? 3 * CAMERAS : 0);
        trigger_close(t);
        if (!seen) {
            fprintf(stdout, "# the host is too busy: ten shots, and none could be watched\n");
            continue;
        }
        const int64_t half_ns = when(&w, 0, !low), full_ns = when(&w, 1, !low), last_ns = when(&w, 2, !low);
        assert_true(half_ns >= shot.at_ns - 200 * MS && full_ns >= shot.at_ns && last_ns >= shot.at_ns + 60 * MS);
        assert_true(half_ns < full_ns && full_ns < last_ns);
        assert_true(when(&w, 1, low) - full_ns >= 120 * MS - w.gap_ns);
        assert_true(when(&w, 2, low) - last_ns >= 120 * MS - w.gap_ns);
        assert_true(when(&w, 0, low) >= when(&w, 1, low));
        for (int i = 0; i < w.n; i++)
            assert_int_equal(w.change[i].bits >> 3 & 1, low); // the supply's relay rests
        fprintf(stdout, "# on the wire%s: half -%.2f ms, full +%.2f ms, delayed body +%.2f ms, widths %.2f and %.2f ms (looked at every %.2f ms)\n",
            low ? ", active low" : "", (double)(shot.at_ns - half_ns) / 1e6, (double)(full_ns - shot.at_ns) / 1e6,
            (double)(last_ns - shot.at_ns) / 1e6, (double)(when(&w, 1, low) - full_ns) / 1e6, (double)(when(&w, 2, low) - last_ns) / 1e6,
            (double)w.gap_ns / 1e6);
    }
}

static int by_value(const void *a, const void *b)
{
    return *(const int64_t *)a < *(const int64_t *)b ? -1 : *(const int64_t *)a > *(const int64_t *)b;
}

static void fifty_shots_are_fired_once_each(void **state)
{
    (void)state;
    enum { N = 50 };
    int64_t late_ns[N];
    struct trigger *t;
    memset(&heard, 0, sizeof(heard));
    wire(0, false);
    assert_int_equal(trigger_open(&t, &config, &host), 0);
    for (int i = 0; i < N; i++) {
        const struct trigger_shot shot = { .at_ns = clock_ns() + 30 * MS, .hold_ms = 10 };
        assert_int_equal(trigger_fire(t, &shot), 0);
        serve(t, &heard.n_fired, i + 1);
        assert_true(heard.err == 0 || heard.err == -EIO); // a machine that stood still for 250 ms does not press at all
        assert_true(heard.err || heard.pressed_ns >= shot.at_ns);
        late_ns[i] = heard.err ? INT64_MAX : heard.late_ns;
    }
    assert_int_equal(n_high(0), 0);
    trigger_close(t);
    qsort(late_ns, N, sizeof(late_ns[0]), by_value);
    fprintf(stdout, "# press after its due time, in this emulated machine: median %.3f ms, 90%% %.3f ms, worst %.3f ms (85 lines)\n",
        (double)late_ns[N / 2] / 1e6, (double)late_ns[N * 9 / 10] / 1e6, (double)late_ns[N - 1] / 1e6);
}

// A process that presses everything; it is killed with its lines high.
static pid_t process_that_presses(int c, uint32_t hold_ms)
{
    const pid_t pid = fork();
    if (pid == 0) {
        struct trigger *t;
        setpgid(0, 0);
        wire(c, false);
        config.trigger.max_hold_ms = hold_ms;
        if (trigger_open(&t, &config, &host))
            _exit(1);
        memset(&heard, 0, sizeof(heard));
        for (heard.err = -EIO;;) { // until it is pressed in time
            const struct trigger_shot shot = { .at_ns = clock_ns() + 100 * MS, .hold_ms = hold_ms };
            if (heard.err == -EIO && (trigger_fire(t, &shot) || trigger_relay(t, 3, true)))
                _exit(2);
            heard.err = 0;
            serve(t, &heard.n_fired, heard.n_fired + 1);
        }
    }
    const int64_t end_ns = clock_ns() + 20000 * MS;
    while (n_high(c) < CAMERAS + 1)
        assert_true(clock_ns() < end_ns);
    return pid;
}

static int64_t until_low_ns(int c, int64_t limit_ns)
{
    const int64_t start_ns = clock_ns();
    while (n_high(c) > 0 && clock_ns() - start_ns < limit_ns)
        ;
    return n_high(c) ? -1 : clock_ns() - start_ns;
}

static void killed_minus_9_no_line_stays_high(void **state)
{
    (void)state;
    for (int c = 0; c < 2; c++) {
        const pid_t pid = process_that_presses(c, 10000);
        kill(pid, SIGKILL);
        waitpid(pid, NULL, 0);
        const int64_t took_ns = until_low_ns(c, 5000 * MS);
        fprintf(stdout, "# kill -9 on a chip that %s: all low after %.1f ms\n", chip[c].label, (double)took_ns / 1e6);
        assert_true(took_ns >= 0);
        struct trigger *t; // and nobody holds the lines any more
        wire(c, false);
        log_set_level(LOG_SILENT);
        for (int i = 0; i < 100 && trigger_open(&t, &config, &host); i++)
            usleep(50000);
        log_set_level(LOG_INFO);
        trigger_close(t);
    }
}

static void stopped_no_line_stays_high_beyond_its_limit(void **state)
{
    (void)state;
    const pid_t pid = process_that_presses(1, 2000);
    kill(pid, SIGSTOP);
    const int64_t took_ns = until_low_ns(1, 6000 * MS);
    fprintf(stdout, "# SIGSTOP with a limit of 2000 ms: all low after %.0f ms\n", (double)took_ns / 1e6);
    assert_true(took_ns >= 0);
    kill(pid, SIGKILL);
    waitpid(pid, NULL, 0);
    usleep(300000);
}

// Everything of rigd at one blow, as when systemd kills its control group: now it is the kernel's and the chip's affair.
static void killed_with_its_guard_a_chip_that_rests_is_low(void **state)
{
    (void)state;
    for (int c = 0; c < 2; c++) {
        const pid_t pid = process_that_presses(c, 10000);
        kill(-pid, SIGSTOP);
        kill(-pid, SIGKILL);
        waitpid(pid, NULL, 0);
        const int64_t took_ns = until_low_ns(c, 500 * MS);
        fprintf(stdout, "# rigd and guard killed on a chip that %s: %s\n", chip[c].label, took_ns >= 0 ? "all low" :
            "lines stay high: here only hardware helps");
        if (c == 0)
            assert_true(took_ns >= 0);
    }
    struct trigger *t; // the next start releases them
    wire(1, false);
    assert_int_equal(trigger_open(&t, &config, &host), 0);
    assert_int_equal(n_high(1), 0);
    trigger_close(t);
}

static void button_and_contacts_are_heard_with_kernel_time(void **state)
{
    (void)state;
    struct trigger *t;
    memset(&heard, 0, sizeof(heard));
    wire(0, false);
    assert_int_equal(trigger_open(&t, &config, &host), 0);
    for (int i = 0; i < CAMERAS; i += 28) {
        const int64_t before_ns = clock_ns();
        pull(0, FEEDBACK + i, true);
        const int64_t after_ns = clock_ns();
        usleep(50000); // read late, stamped early
        serve(t, &heard.n_feedback, i / 28 + 1);
        assert_int_equal(heard.camera, i);
        assert_true(heard.feedback_ns >= before_ns && heard.feedback_ns <= after_ns + 20 * MS);
        pull(0, FEEDBACK + i, false);
    }
    const int64_t before_ns = clock_ns();
    for (int i = 0; i < 5; i++) // active low, with the pull-up that was asked for; ends pressed
        pull(0, BUTTON, i % 2);
    serve(t, &heard.n_button, 1);
    assert_true(heard.button_ns >= before_ns);
    pull(0, BUTTON, true);
    trigger_close(t);
    assert_int_equal(heard.n_button, 1);
}

static void keep_message(void *arg, enum log_level level, const char *message)
{
    (void)level;
    snprintf(arg, 400, "%s", message);
}

static void what_cannot_be_opened_is_named(void **state)
{
    (void)state;
    struct trigger *t, *second;
    char message[400] = "";
    wire(0, false);
    assert_int_equal(trigger_open(&t, &config, &host), 0);
    log_set_level(LOG_SILENT);
    log_set_hook(keep_message, message);
    assert_int_equal(trigger_open(&second, &config, &host), -EBUSY);
    assert_non_null(strstr(message, "camera A00: full_line = 0"));
    assert_non_null(strstr(message, "held by \"rigd\""));
    trigger_close(t);
    camera[7].half_line = LINES;
    assert_int_equal(trigger_open(&t, &config, &host), -EINVAL);
    assert_non_null(strstr(message, "camera A07: half_line = 400"));
    snprintf(config.trigger.chip, sizeof(config.trigger.chip), "absent");
    assert_int_equal(trigger_open(&t, &config, &host), -ENODEV);
    assert_non_null(strstr(message, "gpiochip0"));
    log_set_hook(NULL, NULL);
    log_set_level(LOG_INFO);
}

static void opens_and_closes_without_leaking_descriptors(void **state)
{
    (void)state;
    int n[2] = { 0 };
    for (int round = 0; round < 2; round++) {
        for (int i = 0; i < 5; i++) {
            struct trigger *t;
            wire(0, false);
            assert_int_equal(trigger_open(&t, &config, &host), 0);
            trigger_close(t);
        }
        DIR *d = opendir("/proc/self/fd");
        while (readdir(d))
            n[round]++;
        closedir(d);
    }
    assert_int_equal(n[0], n[1]);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(half_then_full_then_both_released_on_the_wire),
        cmocka_unit_test(fifty_shots_are_fired_once_each),
        cmocka_unit_test(killed_minus_9_no_line_stays_high),
        cmocka_unit_test(stopped_no_line_stays_high_beyond_its_limit),
        cmocka_unit_test(killed_with_its_guard_a_chip_that_rests_is_low),
        cmocka_unit_test(button_and_contacts_are_heard_with_kernel_time),
        cmocka_unit_test(what_cannot_be_opened_is_named),
        cmocka_unit_test(opens_and_closes_without_leaking_descriptors),
    };
    setvbuf(stdout, NULL, _IONBF, 0);
    return cmocka_run_group_tests(tests, make_chips, NULL);
}
