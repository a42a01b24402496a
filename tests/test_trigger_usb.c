// tests/test_trigger_usb.c - the trigger board on USB, through the real libusb: boards that lie are refused by name, and hang nothing.
#if !__has_include(<umockdev.h>) || !__has_include(<simavr/sim_avr.h>) || defined(__SANITIZE_THREAD__)
#include <stdio.h>

int main(void)
{
    printf("1..0 # SKIP needs libumockdev-dev and libsimavr-dev, and not the thread sanitizer, which does not know GLib's locks\n");
    return 0;
}

#else
#include "tests/board/usb_rig.h"

// ---- a board that lies -----------------------------------------------------------------------------------------------------------------

static const struct {
    enum fake_wrong wrong;
    int err;           // of trigger_open(); 0: it opens, and breaks later
    bool fires;        // when a shot is under way
    const char *words; // in the log
} wrongs[] = {
    { FAKE_OTHER_MAKER, -ENODEV, false, "\"somebody trigger board\"" },
    { FAKE_DEAF, -ENODEV, false, "asked what it can do" },
    { FAKE_STALLS, -ENODEV, false, "asked what it can do" },
    { FAKE_SHORT_CAPABILITIES, -ENODEV, false, "capabilities is too short" },
    { FAKE_MAD_CAPABILITIES, -ENODEV, false, "capabilities cannot be" },
    { FAKE_NEWER, -ENODEV, false, "newer than this rigd: update rigd" },
    { FAKE_OLDER, -ENODEV, false, "older than this rigd: flash" },
    { FAKE_SHORT_TIME, -ENODEV, false, "sends 3 bytes" },
    { FAKE_HUGE_TIME, -ENODEV, false, "clock shows what cannot be" },
    { FAKE_RANDOM_TIME, -ENODEV, false, "clock cannot be made out" },
    { FAKE_NO_HELLO, -ENODEV, false, "does not answer" },
    { FAKE_NO_READER, -ENODEV, false, "answer" },
    { FAKE_REFUSES, -ENODEV, false, "an error that this rigd does not know" },
    { FAKE_REFUSES_PING, 0, false, "an error that this rigd does not know" },
    { FAKE_RANDOM_BYTES, 0, false, "is no frame" },
    { FAKE_WRONG_CRC, 0, false, "wrong checksum" },
    { FAKE_WRONG_LENGTH, 0, false, "wrong length" },
    { FAKE_CUT, 0, false, "is no frame" },
    { FAKE_EMPTY_PACKETS, 0, false, "does not answer" },
    { FAKE_UNASKED, 0, false, "answers what was not asked" },
    { FAKE_FLOOD, 0, false, "more than can be heard" },
    { FAKE_MAD_EVENTS, 0, false, "" },
    { FAKE_MAD_STAMPS, 0, false, "a stamp of its clock" },
    { FAKE_FALLS_SILENT, 0, true, "does not answer" },
    { FAKE_NEVER_FIRES, 0, true, "did not report the shot" },
};

static void whatever_a_board_says_is_refused_by_name_and_hangs_nothing(void **state)
{
    (void)state;
    for (size_t i = 0; i < sizeof(wrongs) / sizeof(wrongs[0]); i++) {
        static struct fake_board fake;
        fake = (struct fake_board){ .wrong = wrongs[i].wrong, .seed = 1 };
        rig_of(3);
        assert_int_equal(usbfs_new(&usb, bed, &fake_board_ops, &fake), 0);
        assert_int_equal(usbfs_plug(usb, SLOT, 7, fake_board_descriptors, sizeof(fake_board_descriptors), "FAKE0001"), 0);
        log_set_level(LOG_SILENT);
        log_set_hook(remember, NULL);
        int err = trigger_open(&trigger, &config, &host);
        if (err == -ENODEV && !wrongs[i].err && strstr(words, wrongs[i].words))
            err = 0; // it was quicker: seen while it was opened
        else if (!err && wrongs[i].fires) {
            struct trigger_shot shot = { .half_ms = 10, .hold_ms = 50 };
            fire(&shot);
            assert_int_equal(trigger_fire(trigger, &shot), -EBUSY);
            assert_true(serve(&heard.n_fired, 1, 60000));
            assert_int_equal(heard.err, -EIO);
        }
        for (int k = 0; trigger && wrongs[i].wrong == FAKE_FLOOD && k < 6000 && !strstr(words, wrongs[i].words); k++)
            usleep(10000); // the loop has other things to do
        if (trigger && !wrongs[i].err && !serve(&heard.n_broken, 1, 60000))
            fail_msg("wrong %d does not break it", wrongs[i].wrong);
        const struct trigger_shot after = { .at_ns = clock_ns() + 100 * MS, .hold_ms = 50 };
        if (trigger && heard.n_broken)
            assert_int_equal(trigger_fire(trigger, &after), -EIO);
        trigger_close(trigger);
        trigger = NULL;
        log_set_hook(NULL, NULL);
        log_set_level(LOG_INFO);
        if (err != wrongs[i].err || !strstr(words, wrongs[i].words))
            fail_msg("wrong %d: trigger_open %d, said:\n%s", wrongs[i].wrong, err, words);
        assert_int_equal(heard.n_fired, wrongs[i].fires);
        usbfs_free(usb);
        usb = NULL;
    }
}

// The same board without a fault: what is refused above is refused for its fault.
static void a_right_board_opens_fires_and_is_released_when_closed(void **state)
{
    (void)state;
    static struct fake_board fake;
    fake = (struct fake_board){ .wrong = FAKE_RIGHT };
    rig_of(3);
    assert_int_equal(usbfs_new(&usb, bed, &fake_board_ops, &fake), 0);
    assert_int_equal(usbfs_plug(usb, SLOT, 7, fake_board_descriptors, sizeof(fake_board_descriptors), "FAKE0001"), 0);
    assert_int_equal(trigger_open(&trigger, &config, &host), 0);
    assert_int_equal(trigger_abilities(trigger), TRIGGER_SYNCHRONISED | TRIGGER_HALF_PRESS | TRIGGER_DELAYS | TRIGGER_FEEDBACK | TRIGGER_BUTTON | TRIGGER_RELAYS | TRIGGER_WAITS);
    struct trigger_shot shot = { .half_ms = 10, .hold_ms = 50 };
    fire(&shot);
    assert_true(serve(&heard.n_fired, 1, 60000));
    assert_int_equal(heard.err, 0);
    trigger_close(trigger);
    trigger = NULL;
    assert_int_equal(fake.n_released, 1);
}

static void a_board_is_chosen_by_its_serial_number(void **state)
{
    (void)state;
    static struct fake_board fake;
    fake = (struct fake_board){ .wrong = FAKE_RIGHT };
    rig_of(3);
    log_set_level(LOG_SILENT);
    log_set_hook(remember, NULL);
    assert_int_equal(trigger_open(&trigger, &config, &host), -ENODEV);
    assert_non_null(strstr(words, "no trigger board is plugged in"));
    assert_int_equal(usbfs_new(&usb, bed, &fake_board_ops, &fake), 0);
    assert_int_equal(usbfs_plug(usb, SLOT, 7, fake_board_descriptors, sizeof(fake_board_descriptors), "FAKE0001"), 0);
    strcpy(config.trigger.serial, "4711");
    words[0] = 0;
    assert_int_equal(trigger_open(&trigger, &config, &host), -ENODEV);
    assert_non_null(strstr(words, "no board 4711"));
    assert_non_null(strstr(words, "FAKE0001"));
    log_set_hook(NULL, NULL);
    log_set_level(LOG_INFO);
    strcpy(config.trigger.serial, "FAKE0001");
    assert_int_equal(trigger_open(&trigger, &config, &host), 0);
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_teardown(a_right_board_opens_fires_and_is_released_when_closed, close_all),
        cmocka_unit_test_teardown(a_board_is_chosen_by_its_serial_number, close_all),
        cmocka_unit_test_teardown(whatever_a_board_says_is_refused_by_name_and_hangs_nothing, close_all),
    };
    usbfs_preload(argv);
    (void)argc;
    return run_under_umockdev("trigger_usb", tests, sizeof(tests) / sizeof(tests[0]));
}
#endif
