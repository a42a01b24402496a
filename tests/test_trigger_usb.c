// tests/test_trigger_usb.c - the trigger board on USB: the real libusb and trigger_usb.c against a board that lies (fake_board.h), and against the
// real firmware in simavr, both behind umockdev; then the real rigd.
#include "rigd/board_clock.h"
#include "rigd/trigger.h"
#include "solver/take/log.h"
#include "tests/scratch.h"

#if !__has_include(<umockdev.h>) || defined(__SANITIZE_THREAD__)

int main(void)
{
    printf("1..0 # SKIP needs libumockdev-dev, and not the thread sanitizer, which does not know GLib's locks\n");
    return 0;
}

#else
#include "tests/board/fake_board.h"

#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <time.h>

#define MS INT64_C(1000000)
enum { N_CAMERAS_MAX = 200, PORT = 3 };

static UMockdevTestbed *bed;
static struct usbfs *usb;

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

// ---- what the loop hears -----------------------------------------------------------------------------------------------------------

static struct heard {
    int n_fired, err, n_button, n_broken, n_feedback[N_CAMERAS_MAX], n_head, head_err;
    int64_t pressed_ns, late_ns, button_ns, feedback_ns[N_CAMERAS_MAX];
} heard;

static void on_fired(void *arg, int err, int64_t pressed_ns, int64_t late_ns)
{
    (void)arg;
    heard.n_fired++;
    heard.err = err;
    heard.pressed_ns = pressed_ns;
    heard.late_ns = late_ns;
}

static void on_feedback(void *arg, int camera, int64_t at_ns)
{
    (void)arg;
    heard.n_feedback[camera]++;
    heard.feedback_ns[camera] = at_ns;
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
    assert_int_equal(err, -EIO);
    heard.n_broken++;
}

static void on_head(void *arg, int err)
{
    (void)arg;
    heard.n_head++;
    heard.head_err = err;
}

static const struct trigger_host host = { .fired = on_fired, .feedback = on_feedback, .button = on_button, .broken = on_broken, .head_arrived = on_head };

static char words[4000]; // logged since the last look

static void remember(void *arg, enum log_level level, const char *message)
{
    const size_t at = strlen(words);
    (void)arg;
    if (level >= LOG_WARNING && at + strlen(message) + 2 < sizeof(words))
        sprintf(words + at, "%s\n", message);
}

// ---- the rig ---------------------------------------------------------------------------------------------------------------------------

static struct config_camera camera[N_CAMERAS_MAX];
static struct config config;
static struct trigger *trigger;

// Full-press on the first registers, then half-press, then 8 relays; a flash-sync contact each.
static void rig_of(int n)
{
    const int row = (n + 7) / 8 * 8;
    memset(&config, 0, sizeof(config));
    config.camera = camera;
    config.n_cameras = n;
    config.trigger = (struct trigger_config){ .kind = TRIGGER_USB, .full_line = CONFIG_NONE, .half_line = CONFIG_NONE, .button_line = CONFIG_NONE, .button_debounce_ms = 20, .max_hold_ms = 1000,
        .output_registers = 2 * row / 8 + 1, .button_active_low = true, .feedback_active_low = true };
    for (int i = 0; i < n; i++) {
        camera[i] = (struct config_camera){ .full_line = i, .half_line = row + i, .feedback_line = i, .relay_line = i < 8 ? 2 * row + i : CONFIG_NONE };
        snprintf(camera[i].name, sizeof(camera[i].name), "A%02d", i);
    }
    memset(&heard, 0, sizeof(heard));
    words[0] = 0;
}

static bool serve(const int *until, int least, int timeout_ms)
{
    const int64_t end_ns = clock_ns() + timeout_ms * MS;
    while (*until < least) {
        struct pollfd p = { .fd = trigger_fd(trigger), .events = POLLIN };
        const int64_t left_ns = end_ns - clock_ns();
        if (left_ns <= 0 || poll(&p, 1, (int)(left_ns / MS) + 1) < 0)
            return false;
        if (p.revents)
            trigger_dispatch(trigger);
    }
    return true;
}

static int close_all(void **state)
{
    (void)state;
    trigger_close(trigger);
    trigger = NULL;
    usbfs_free(usb);
    usb = NULL;
    return 0;
}

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
        assert_int_equal(usbfs_plug(usb, PORT, 7, fake_board_descriptors, sizeof(fake_board_descriptors), "FAKE0001"), 0);
        log_set_level(LOG_SILENT);
        log_set_hook(remember, NULL);
        int err = trigger_open(&trigger, &config, &host);
        if (err == -ENODEV && !wrongs[i].err && strstr(words, wrongs[i].words))
            err = 0; // it was quicker: seen while it was opened
        else if (!err && wrongs[i].fires) {
            const struct trigger_shot shot = { .at_ns = clock_ns() + 100 * MS, .half_ms = 10, .hold_ms = 50 };
            assert_int_equal(trigger_fire(trigger, &shot), 0);
            assert_int_equal(trigger_fire(trigger, &shot), -EBUSY);
            assert_true(serve(&heard.n_fired, 1, 4000));
            assert_int_equal(heard.err, -EIO);
        }
        if (trigger && wrongs[i].wrong == FAKE_FLOOD)
            usleep(1000000); // the loop has other things to do
        if (trigger && !wrongs[i].err && !serve(&heard.n_broken, 1, 4000))
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
    assert_int_equal(usbfs_plug(usb, PORT, 7, fake_board_descriptors, sizeof(fake_board_descriptors), "FAKE0001"), 0);
    assert_int_equal(trigger_open(&trigger, &config, &host), 0);
    assert_int_equal(trigger_abilities(trigger), TRIGGER_SYNCHRONISED | TRIGGER_HALF_PRESS | TRIGGER_DELAYS | TRIGGER_FEEDBACK | TRIGGER_BUTTON | TRIGGER_RELAYS | TRIGGER_WAITS);
    const struct trigger_shot shot = { .at_ns = clock_ns() + 100 * MS, .half_ms = 10, .hold_ms = 50 };
    assert_int_equal(trigger_fire(trigger, &shot), 0);
    assert_true(serve(&heard.n_fired, 1, 2000));
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
    assert_int_equal(usbfs_plug(usb, PORT, 7, fake_board_descriptors, sizeof(fake_board_descriptors), "FAKE0001"), 0);
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

// ---- under the preload -----------------------------------------------------------------------------------------------------------------

// umockdev redirects a program from within: this one begins anew with its library loaded first (second, after the sanitizer's).
static void begin_anew(char **argv)
{
    char list[700] = "";
    if (getenv("TRIGGER_USB_BEGUN"))
        return;
#ifdef __SANITIZE_ADDRESS__
    char line[500];
    FILE *maps = fopen("/proc/self/maps", "r");
    while (maps && !list[0] && fgets(line, sizeof(line), maps)) {
        const char *file = strchr(line, '/');
        if (file && strstr(file, "/libasan.so"))
            snprintf(list, sizeof(list), "%.*s:", (int)strcspn(file, "\n"), file);
    }
    if (maps)
        fclose(maps);
#endif
    strcat(list, "libumockdev-preload.so.0");
    setenv("LD_PRELOAD", list, 1);
    setenv("TRIGGER_USB_BEGUN", "1", 1);
    execv("/proc/self/exe", argv);
}

// It finds a host that dies within a request worth a word.
static void ignore(const gchar *domain, GLogLevelFlags level, const gchar *text, gpointer arg)
{
    (void)domain, (void)level, (void)text, (void)arg;
}

int main(int argc, char **argv)
{
    (void)argc;
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_teardown(a_right_board_opens_fires_and_is_released_when_closed, close_all),
        cmocka_unit_test_teardown(a_board_is_chosen_by_its_serial_number, close_all),
        cmocka_unit_test_teardown(whatever_a_board_says_is_refused_by_name_and_hangs_nothing, close_all),
    };
    begin_anew(argv);
    bed = umockdev_testbed_new();
    g_log_set_handler(NULL, G_LOG_LEVEL_CRITICAL, ignore, NULL);
    if (!umockdev_in_mock_environment()) {
        printf("1..0 # SKIP umockdev's library cannot be preloaded here (under a sanitizer that is linked statically?)\n");
        return 0;
    }
    const int failed = cmocka_run_group_tests_name("trigger_usb", tests, NULL, NULL);
    g_object_unref(bed);
    return failed;
}
#endif
