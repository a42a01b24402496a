// tests/test_board_loss.c - the real firmware in simavr behind the real libusb, and what it does when cable or host are gone: release everything.
#if !__has_include(<umockdev.h>) || !__has_include(<simavr/sim_avr.h>) || defined(__SANITIZE_THREAD__)
#include <stdio.h>

int main(void)
{
    printf("1..0 # SKIP needs libumockdev-dev and libsimavr-dev, and not the thread sanitizer, which does not know GLib's locks\n");
    return 0;
}

#else
#include "tests/board/usb_rig.h"

#include <signal.h>
#include <sys/prctl.h>
#include <sys/wait.h>

// Before the shot, and with shutters pressed.
static void unplugged_while_armed_is_safe_and_reported_and_heals_when_replugged(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    for (int pressed = 0; pressed < 2; pressed++) {
        uint8_t outputs[SIMAVR_REGISTERS];
        open_with(8);
        look_at_edges();
        struct trigger_shot shot = { .half_ms = 50, .hold_ms = 800 };
        fire(&shot);
        if (pressed)
            wait_for_output(0);
        log_set_level(LOG_SILENT);
        log_set_hook(remember, NULL);
        usbfs_unplug(usb);
        assert_true(serve(&heard.n_broken, 1, 3000));
        log_set_hook(NULL, NULL);
        log_set_level(LOG_INFO);
        assert_non_null(strstr(words, "unplugged"));
        assert_int_equal(heard.n_fired, 1);
        assert_int_equal(heard.err, -EIO);
        wait_ms(400); // longer than it was to wait
        live_board_outputs(live, outputs);
        assert_false(any_on(outputs));
        look_at_edges();
        for (int i = 0; i < n_edges; i++)
            assert_int_equal(pressed, 1); // the other one never moved
        trigger_close(trigger);
        plug();
        open_with(8);
        struct trigger_shot next = { .hold_ms = 50 };
        fire(&next);
        assert_true(serve(&heard.n_fired, 1, 3000));
        assert_int_equal(heard.err, 0);
        trigger_close(trigger);
        trigger = NULL;
    }
}

// ---- a host that dies ------------------------------------------------------------------------------------------------------------------

enum host_state { HOST_CUTS, HOST_IS_ARMED, HOST_WAITS, HOST_HALF, HOST_FULL };
enum { LIMIT_MS = 600 }; // trigger_usb.c's SILENCE_MS, and what was on its way

// A busy machine needs longer to load it: then again, later.
static int fire_in(struct trigger_shot *shot, int lead_ms)
{
    int err = -ETIME;
    for (; err == -ETIME && lead_ms < 5000; lead_ms *= 2) {
        shot->at_ns = clock_ns() + lead_ms * MS;
        err = trigger_fire(trigger, shot);
    }
    return err;
}

static void wait_for_any(void)
{
    uint8_t outputs[SIMAVR_REGISTERS] = { 0 };
    for (const int64_t end_ns = clock_ns() + 5000 * MS; !any_on(outputs) && clock_ns() < end_ns; wait_ms(1))
        live_board_outputs(live, outputs);
    assert_true(any_on(outputs));
}

// Another process under the same preload: fork() alone would share umockdev's locks.
static int be_a_host(enum host_state state)
{
    rig_of(8);
    if (board_time_share() || trigger_open(&trigger, &config, &host))
        return 1;
    const int lead_ms = state == HOST_HALF ? 600 : state == HOST_IS_ARMED ? 800 : 60;
    struct trigger_shot shot = { .half_ms = state == HOST_HALF ? 550 : 0,
        .hold_ms = state == HOST_HALF ? 100 : 900, .on_button = state == HOST_WAITS };
    if (state == HOST_CUTS ? trigger_relay(trigger, 1, true) : state == HOST_WAITS ? trigger_fire(trigger, &shot) : fire_in(&shot, lead_ms))
        return 1;
    puts("ready");
    fflush(stdout);
    serve(&heard.n_broken, 1, 20000);
    return 1;
}

// A shot that was armed for later must not come, nor one that waits for the button; what is pressed or cut must be let go.
static void when_the_host_dies_everything_is_released_within_the_limit(void **state)
{
    (void)state;
    static const struct { enum host_state state; int signal; } ends[] = { { HOST_CUTS, SIGKILL }, { HOST_IS_ARMED, SIGKILL }, { HOST_WAITS, SIGKILL }, { HOST_HALF, SIGKILL }, { HOST_FULL, SIGKILL },
        { HOST_FULL, SIGSTOP } }; // dead, or as good as
    rig_of(8); // the other process' rig
    plug_in_the_real_one(0);
    double worst_ms = 0;
    for (size_t k = 0; k < sizeof(ends) / sizeof(ends[0]); k++) {
        const bool later = ends[k].state == HOST_IS_ARMED || ends[k].state == HOST_WAITS;
        uint8_t outputs[SIMAVR_REGISTERS];
        char number[8], line[64];
        int status, end[2];
        snprintf(number, sizeof(number), "%d", ends[k].state);
        assert_int_equal(pipe(end), 0);
        const pid_t pid = fork();
        assert_true(pid >= 0);
        if (!pid) {
            prctl(PR_SET_PDEATHSIG, SIGKILL);
            dup2(end[1], 1);
            close(end[0]);
            close(end[1]);
            execl("/proc/self/exe", "host", number, NULL);
            _exit(127);
        }
        close(end[1]);
        const ssize_t n = read(end[0], line, sizeof(line));
        close(end[0]);
        assert_true(n > 0);
        if (!later) // loaded, and soon to come
            wait_for_any();
        look_at_edges();
        const int64_t killed_ns = clock_ns();
        kill(pid, ends[k].signal);
        if (ends[k].state == HOST_WAITS)
            live_board_set(live, LIVE_BUTTON, 0, true, killed_ns + LIMIT_MS * MS);
        do {
            wait_ms(20);
            live_board_outputs(live, outputs);
        } while (later ? clock_ns() < killed_ns + 850 * MS : any_on(outputs) && clock_ns() < killed_ns + 2000 * MS);
        assert_false(any_on(outputs));
        look_at_edges();
        for (int i = 0; i < n_edges; i++) {
            const double ms = 1e-6 * (double)(edge[i].at_ns - killed_ns); // of the board's time
            worst_ms = ms > worst_ms ? ms : worst_ms;
            assert_true(ms < LIMIT_MS);
        }
        live_board_set(live, LIVE_BUTTON, 0, false, clock_ns());
        kill(pid, SIGKILL);
        assert_int_equal(waitpid(pid, &status, 0), pid);
    }
    print_message("last edge at most %.0f ms after the host died or stood still\n", worst_ms);
    open_with(8); // and the next host finds it well
    struct trigger_shot shot = { .hold_ms = 50 };
    fire(&shot);
    assert_true(serve(&heard.n_fired, 1, 3000));
    assert_int_equal(heard.err, 0);
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_teardown(unplugged_while_armed_is_safe_and_reported_and_heals_when_replugged, close_all),
        cmocka_unit_test_teardown(when_the_host_dies_everything_is_released_within_the_limit, close_all),
    };
    usbfs_preload(argv);
    if (argc == 2)
        return be_a_host((enum host_state)atoi(argv[1]));
    return run_under_umockdev("board_loss", tests, sizeof(tests) / sizeof(tests[0]));
}
#endif
