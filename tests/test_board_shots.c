// tests/test_board_shots.c - the real firmware in simavr behind the real libusb: edges, delays, contacts, button, relays, head.
#if !__has_include(<umockdev.h>) || !__has_include(<simavr/sim_avr.h>) || defined(__SANITIZE_THREAD__)
#include <stdio.h>

int main(void)
{
    printf("1..0 # SKIP needs libumockdev-dev and libsimavr-dev, and not the thread sanitizer, which does not know GLib's locks\n");
    return 0;
}

#else
#include "tests/board/usb_rig.h"

static void a_shot_is_one_edge_where_nothing_is_delayed(void **state)
{
    (void)state;
    plug_in_the_real_one(80);
    for (int round = 0; round < 2; round++) {
        const int n = round ? 200 : 64, row = (n + 7) / 8 * 8;
        open_with(n);
        serve(&heard.n_fired, 1, 300); // the clocks get to know each other
        look_at_edges();
        struct trigger_shot shot = { .half_ms = 50, .hold_ms = 60 };
        const int64_t begin_ns = clock_ns();
        fire(&shot);
        const int64_t loaded_ns = clock_ns();
        assert_int_equal(trigger_fire(trigger, &shot), -EBUSY);
        assert_true(serve(&heard.n_fired, 1, 3000));
        assert_int_equal(heard.err, 0);
        look_at_edges();
        int64_t on_ns, off_ns, first_ns = 0, half_on_ns, half_off_ns, first_half_ns = 0;
        for (int i = 0; i < n; i++) {
            assert_true(pulse(i, &on_ns, &off_ns));
            assert_true(pulse(row + i, &half_on_ns, &half_off_ns));
            first_ns = i ? first_ns : on_ns;
            first_half_ns = i ? first_half_ns : half_on_ns;
            assert_int_equal(on_ns, first_ns); // one latch edge: the same cycle
            assert_int_equal(half_on_ns, first_half_ns);
            assert_true(off_ns - on_ns > 59 * MS && off_ns - on_ns < 62 * MS);
            assert_true(half_off_ns >= off_ns);
            assert_true(on_ns - half_on_ns > 49 * MS && on_ns - half_on_ns < 51 * MS);
        }
        print_message("%d channels: loaded and committed in %.1f ms; the edge %.1f us from its time, reported %.1f us off, late_ns %.1f us\n", n, 1e-6 * (double)(loaded_ns - begin_ns),
                      1e-3 * (double)(first_ns - shot.at_ns), 1e-3 * (double)(heard.pressed_ns - first_ns), 1e-3 * (double)heard.late_ns);
        assert_true(llabs(first_ns - shot.at_ns) < 5 * MS && llabs(heard.pressed_ns - first_ns) < 5 * MS);
        trigger_close(trigger);
        trigger = NULL;
    }
}

static void each_channel_keeps_its_delay(void **state)
{
    (void)state;
    plug_in_the_real_one(-100);
    for (int round = 0; round < 2; round++) {
        const int n = round ? 200 : 64, row = (n + 7) / 8 * 8;
        uint32_t delay_us[N_CAMERAS_MAX];
        uint64_t skip[4] = { UINT64_C(1) << 5 };
        unsigned seed = 3;
        int64_t on_ns, off_ns, first_ns = 0;
        double worst_us = 0;
        for (int i = 0; i < n; i++)
            delay_us[i] = i % 7 ? (uint32_t)rand_r(&seed) % 40000 : 12345;
        delay_us[0] = 0;
        open_with(n);
        serve(&heard.n_fired, 1, 300);
        look_at_edges();
        struct trigger_shot shot = { .half_ms = 20, .hold_ms = 60, .delay_us = delay_us, .skip = skip };
        fire(&shot);
        assert_true(serve(&heard.n_fired, 1, 3000));
        assert_int_equal(heard.err, 0);
        look_at_edges();
        for (int i = 0; i < n; i++) {
            const bool pressed = pulse(i, &on_ns, &off_ns);
            assert_int_equal(pressed, i != 5);
            assert_int_equal(pulse(row + i, &on_ns, &off_ns), i != 5);
            if (!pressed)
                continue;
            pulse(i, &on_ns, &off_ns);
            first_ns = i ? first_ns : on_ns;
            const int64_t error_ns = on_ns - first_ns - delay_us[i] * INT64_C(1000);
            // Half of what the board needs between edges, and drift that is not known yet.
            if (llabs(error_ns) > gap_ns(2 * row / 8 + 1, n / 7 + 10) / 2 + 40 * MS * BOARD_CLOCK_DRIFT_MAX_PPM / 1000000)
                fail_msg("camera %d: %.1f us off", i, 1e-3 * (double)error_ns);
            worst_us = 1e-3 * (double)llabs(error_ns) > worst_us ? 1e-3 * (double)llabs(error_ns) : worst_us;
            assert_true(off_ns - on_ns >= 599 * MS / 10);
        }
        print_message("%d channels, delays up to 40 ms: at most %.1f us from what was asked\n", n, worst_us);
        trigger_close(trigger);
        trigger = NULL;
    }
}

static void what_is_past_is_refused_and_presses_nothing(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    open_with(200);
    look_at_edges();
    const struct trigger_shot past = { .at_ns = clock_ns() - MS, .hold_ms = 50 };
    assert_int_equal(trigger_fire(trigger, &past), -ETIME);
    for (int i = 0; i < 3; i++) { // future when it is planned, past when it is loaded
        const struct trigger_shot soon = { .at_ns = clock_ns() + MS / 2, .hold_ms = 50 };
        assert_int_equal(trigger_fire(trigger, &soon), -ETIME);
    }
    assert_false(serve(&heard.n_fired, 1, 200));
    look_at_edges();
    assert_int_equal(n_edges, 0);
    struct trigger_shot next = { .hold_ms = 50 };
    fire(&next);
    assert_true(serve(&heard.n_fired, 1, 3000));
    assert_int_equal(heard.err, 0);
}

static void released_in_the_middle_of_a_shot(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    open_with(8);
    struct trigger_shot shot = { .half_ms = 50, .hold_ms = 800 };
    uint8_t outputs[SIMAVR_REGISTERS];
    fire(&shot);
    wait_for_output(0);
    live_board_outputs(live, outputs);
    assert_true(is_on(outputs, 8));
    trigger_release(trigger);
    assert_true(serve(&heard.n_fired, 1, 1000));
    assert_int_equal(heard.err, -ECANCELED);
    live_board_outputs(live, outputs);
    assert_false(any_on(outputs));
}

static void the_button_and_the_contacts_are_heard_when_they_closed(void **state)
{
    (void)state;
    plug_in_the_real_one(50);
    rig_of(16);
    camera[15].feedback_line = CONFIG_CAPTURE;
    assert_int_equal(trigger_open(&trigger, &config, &host), 0);
    serve(&heard.n_fired, 1, 300);
    const int64_t press_ns = clock_ns() + 50 * MS;
    for (int bounce = 0; bounce < 5; bounce++) // opens and closes for 4 ms
        live_board_set(live, LIVE_BUTTON, 0, bounce % 2 == 0, press_ns + bounce * MS);
    live_board_set(live, LIVE_BUTTON, 0, false, press_ns + 150 * MS);
    assert_true(serve(&heard.n_button, 1, 1000));
    assert_true(llabs(heard.button_ns - press_ns) < 5 * MS);
    // Two seconds ahead: on a machine that is too busy for half a one, contacts that are planned after loading would close late.
    const struct trigger_shot shot = { .half_ms = 50, .hold_ms = 100, .at_ns = clock_ns() + 2000 * MS };
    double worst_us = 0;
    for (int i = 0; i < 16; i++) {
        live_board_set(live, i == 15 ? LIVE_CAPTURE : LIVE_INPUT, i, true, shot.at_ns + (30 + i) * MS);
        live_board_set(live, i == 15 ? LIVE_CAPTURE : LIVE_INPUT, i, false, shot.at_ns + (40 + i) * MS);
    }
    assert_int_equal(trigger_fire(trigger, &shot), 0);
    for (int i = 0; i < 16; i++) {
        assert_true(serve(&heard.n_feedback[i], 1, 4000));
        const double error_us = 1e-3 * (double)llabs(heard.feedback_ns[i] - shot.at_ns - (30 + i) * MS);
        worst_us = error_us > worst_us ? error_us : worst_us;
        assert_true(llabs(heard.feedback_ns[i] - heard.feedback_ns[0] - i * MS) < MS / 2); // each other's, by the board's clock alone
    }
    print_message("button %.1f us, flash-sync contacts at most %.1f us, the capture input %.1f us from when they closed\n", 1e-3 * (double)(heard.button_ns - press_ns), worst_us,
                  1e-3 * (double)(heard.feedback_ns[15] - shot.at_ns - 45 * MS));
    assert_true(worst_us < 5000);
    assert_true(serve(&heard.n_fired, 1, 1000));
    assert_int_equal(heard.n_button, 1); // letting go and bouncing are no presses
    for (int i = 0; i < 16; i++)
        assert_int_equal(heard.n_feedback[i], 1);
}

static void an_armed_shot_follows_the_button_without_the_host(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    open_with(8);
    const struct trigger_shot shot = { .half_ms = 30, .hold_ms = 50, .on_button = true };
    assert_int_equal(trigger_fire(trigger, &shot), 0);
    assert_int_equal(trigger_fire(trigger, &shot), -EBUSY);
    assert_false(serve(&heard.n_fired, 1, 700)); // it waits, for longer than any silence
    look_at_edges();
    assert_int_equal(n_edges, 0);
    const int64_t press_ns = clock_ns() + 20 * MS;
    live_board_set(live, LIVE_BUTTON, 0, true, press_ns);
    live_board_set(live, LIVE_BUTTON, 0, false, press_ns + 200 * MS);
    assert_true(serve(&heard.n_fired, 1, 2000));
    assert_int_equal(heard.err, 0);
    assert_int_equal(heard.n_button, 0);
    look_at_edges();
    int64_t on_ns, off_ns;
    assert_true(pulse(8, &on_ns, &off_ns));
    print_message("half-press %.3f ms after the contact, of which 20 ms are its debounce\n", 1e-6 * (double)(on_ns - press_ns));
    assert_true(on_ns - press_ns >= 20 * MS && on_ns - press_ns < 26 * MS); // of the board's time: no host in it
    assert_true(pulse(0, &on_ns, &off_ns));
    assert_int_equal(trigger_fire(trigger, &shot), 0);
    trigger_release(trigger);
    assert_true(serve(&heard.n_fired, 2, 1000));
    assert_int_equal(heard.err, -ECANCELED);
}

static void a_supply_comes_back_by_itself(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    open_with(8);
    look_at_edges();
    assert_int_equal(trigger_relay(trigger, 2, true), 0);
    assert_int_equal(trigger_relay(trigger, 3, true), 0);
    wait_ms(50);
    assert_int_equal(trigger_relay(trigger, 3, false), 0);
    wait_ms(1150);
    look_at_edges();
    int64_t on_ns, off_ns;
    assert_true(pulse(16 + 2, &on_ns, &off_ns));
    assert_true(off_ns - on_ns >= 1000 * MS && off_ns - on_ns <= (1000 + PROTO_ON_SLACK_MS) * MS);
    assert_true(pulse(16 + 3, &on_ns, &off_ns));
    assert_true(off_ns - on_ns < 1000 * MS);
}

static void the_head_turns_and_knows_its_limits(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    rig_of(2);
    assert_int_equal(trigger_open(&trigger, &config, &host), 0);
    assert_int_equal(trigger_head(trigger, 1000, 0), -ENOTSUP);
    trigger_close(trigger);
    config.trigger.head_steps_per_turn[0] = 3200;
    config.trigger.head_steps_per_turn[1] = -1600;
    config.trigger.head_deg_per_s = 90;
    config.trigger.head_deg_per_s2 = 360;
    config.trigger.head_limit_deg[0] = 180;
    config.trigger.head_limit_deg[1] = 90;
    assert_int_equal(trigger_open(&trigger, &config, &host), 0);
    assert_true(trigger_abilities(trigger) & TRIGGER_HEAD);
    assert_int_equal(trigger_head(trigger, 180001, 0), -EINVAL);
    assert_int_equal(trigger_head(trigger, 0, -90001), -EINVAL);
    assert_int_equal(trigger_head(trigger, 20000, -10000), 0);
    assert_int_equal(trigger_head(trigger, 0, 0), -EBUSY);
    assert_true(serve(&heard.n_head, 1, 3000));
    assert_int_equal(heard.head_err, 0);
    assert_int_equal(trigger_head(trigger, 0, 0), 0);
    assert_true(serve(&heard.n_head, 2, 3000));
    assert_int_equal(heard.head_err, 0);
}

static int led_changes(int ms)
{
    int n = 0;
    bool was = live_board_led(live);
    for (const int64_t end_ns = clock_ns() + ms * MS; clock_ns() < end_ns; wait_ms(5)) {
        const bool is = live_board_led(live);
        n += is != was;
        was = is;
    }
    return n;
}

static void asked_which_it_is_it_blinks_for_so_long(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    open_with(3);
    assert_int_equal(led_changes(600), 0); // steady: a session is open
    assert_int_equal(trigger_identify(trigger, 1000), 0);
    assert_true(led_changes(1500) >= 4);
    assert_int_equal(led_changes(600), 0);
    assert_true(live_board_led(live));
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_teardown(a_shot_is_one_edge_where_nothing_is_delayed, close_all),
        cmocka_unit_test_teardown(each_channel_keeps_its_delay, close_all),
        cmocka_unit_test_teardown(what_is_past_is_refused_and_presses_nothing, close_all),
        cmocka_unit_test_teardown(released_in_the_middle_of_a_shot, close_all),
        cmocka_unit_test_teardown(the_button_and_the_contacts_are_heard_when_they_closed, close_all),
        cmocka_unit_test_teardown(an_armed_shot_follows_the_button_without_the_host, close_all),
        cmocka_unit_test_teardown(a_supply_comes_back_by_itself, close_all),
        cmocka_unit_test_teardown(asked_which_it_is_it_blinks_for_so_long, close_all),
        cmocka_unit_test_teardown(the_head_turns_and_knows_its_limits, close_all),
    };
    usbfs_preload(argv);
    (void)argc;
    return run_under_umockdev("board_shots", tests, sizeof(tests) / sizeof(tests[0]));
}
#endif
