// tests/test_trigger_usb.c - the trigger board on USB: the real libusb and trigger_usb.c against a board that lies (fake_board.h), and against the
// real firmware in simavr, both behind umockdev; then the real rigd.
#include "firmware/board.h"
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
#include "tests/board/live_board.h"

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
static struct live_board *live;
static uint8_t descriptors[82];
static size_t n_descriptors;
static char serial[40];

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
    live_board_close(live);
    live = NULL;
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

// ---- the real firmware -----------------------------------------------------------------------------------------------------------------

static void plug(void)
{
    assert_int_equal(usbfs_plug(usb, PORT, 9, descriptors, n_descriptors, serial), 0);
}

static void plug_in_the_real_one(double fast_ppm)
{
    assert_int_equal(live_board_open(&live, "build/firmware/trigger.elf", fast_ppm, NULL, NULL), 0);
    n_descriptors = live_board_descriptors(live, descriptors, sizeof(descriptors), serial);
    assert_true(n_descriptors > 18);
    assert_int_equal(strlen(serial), 20);
    assert_int_equal(usbfs_new(&usb, bed, &live_board_ops, live), 0);
    plug();
}

static void open_with(int n_cameras)
{
    rig_of(n_cameras);
    assert_int_equal(trigger_open(&trigger, &config, &host), 0);
}

static bool is_on(const uint8_t *outputs, int line)
{
    return outputs[line / 8] >> line % 8 & 1;
}

static bool any_on(const uint8_t outputs[SIMAVR_REGISTERS])
{
    for (int i = 0; i < SIMAVR_REGISTERS; i++)
        if (outputs[i])
            return true;
    return false;
}

enum { EDGES_MAX = 1000 };
static struct live_edge edge[EDGES_MAX];
static int n_edges;

static void look_at_edges(void)
{
    n_edges = live_board_edges(live, edge, EDGES_MAX);
}

// When an output went on, and off again; it did so once. False: never on.
static bool pulse(int line, int64_t *on_ns, int64_t *off_ns)
{
    int n = 0;
    bool was = false;
    for (int i = 0; i < n_edges; i++) {
        const bool is = is_on(edge[i].outputs, line);
        if (is && !was) {
            *on_ns = edge[i].at_ns;
            n++;
        }
        if (!is && was)
            *off_ns = edge[i].at_ns;
        was = is;
    }
    assert_true(n <= 1 && !was);
    return n;
}

static int64_t gap_ns(int n_registers, int n_together)
{
    return (BOARD_GAP_BASE + BOARD_GAP_REGISTER * n_registers + BOARD_GAP_CHANNEL * n_together) * INT64_C(125) / 2;
}

static void a_shot_is_one_edge_where_nothing_is_delayed(void **state)
{
    (void)state;
    plug_in_the_real_one(80);
    for (int round = 0; round < 2; round++) {
        const int n = round ? 200 : 64, row = (n + 7) / 8 * 8;
        open_with(n);
        serve(&heard.n_fired, 1, 700); // the clocks get to know each other
        look_at_edges();
        const struct trigger_shot shot = { .at_ns = clock_ns() + 400 * MS, .half_ms = 50, .hold_ms = 60 };
        const int64_t begin_ns = clock_ns();
        assert_int_equal(trigger_fire(trigger, &shot), 0);
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
        serve(&heard.n_fired, 1, 700);
        look_at_edges();
        const struct trigger_shot shot = { .at_ns = clock_ns() + 400 * MS, .half_ms = 20, .hold_ms = 60, .delay_us = delay_us, .skip = skip };
        assert_int_equal(trigger_fire(trigger, &shot), 0);
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
    const struct trigger_shot next = { .at_ns = clock_ns() + 300 * MS, .hold_ms = 50 };
    assert_int_equal(trigger_fire(trigger, &next), 0);
    assert_true(serve(&heard.n_fired, 1, 3000));
    assert_int_equal(heard.err, 0);
}

static void released_in_the_middle_of_a_shot(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    open_with(8);
    const struct trigger_shot shot = { .at_ns = clock_ns() + 150 * MS, .half_ms = 50, .hold_ms = 800 };
    assert_int_equal(trigger_fire(trigger, &shot), 0);
    usleep(300000);
    uint8_t outputs[SIMAVR_REGISTERS];
    live_board_outputs(live, outputs);
    assert_true(is_on(outputs, 0) && is_on(outputs, 8));
    trigger_release(trigger);
    assert_true(serve(&heard.n_fired, 1, 1000));
    assert_int_equal(heard.err, -ECANCELED);
    live_board_outputs(live, outputs);
    assert_false(any_on(outputs));
}

// Before the shot, and with shutters pressed.
static void unplugged_while_armed_is_safe_and_reported_and_heals_when_replugged(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    for (int pressed = 0; pressed < 2; pressed++) {
        uint8_t outputs[SIMAVR_REGISTERS];
        open_with(8);
        look_at_edges();
        const struct trigger_shot shot = { .at_ns = clock_ns() + 200 * MS, .half_ms = 50, .hold_ms = 800 };
        assert_int_equal(trigger_fire(trigger, &shot), 0);
        usleep(pressed ? 400000 : 20000);
        live_board_outputs(live, outputs);
        assert_int_equal(any_on(outputs), pressed);
        log_set_level(LOG_SILENT);
        log_set_hook(remember, NULL);
        usbfs_unplug(usb);
        assert_true(serve(&heard.n_broken, 1, 3000));
        log_set_hook(NULL, NULL);
        log_set_level(LOG_INFO);
        assert_non_null(strstr(words, "unplugged"));
        assert_int_equal(heard.n_fired, 1);
        assert_int_equal(heard.err, -EIO);
        usleep(400000);
        live_board_outputs(live, outputs);
        assert_false(any_on(outputs));
        look_at_edges();
        for (int i = 0; i < n_edges; i++)
            assert_int_equal(pressed, 1); // the other one never moved
        trigger_close(trigger);
        plug();
        open_with(8);
        const struct trigger_shot next = { .at_ns = clock_ns() + 200 * MS, .hold_ms = 50 };
        assert_int_equal(trigger_fire(trigger, &next), 0);
        assert_true(serve(&heard.n_fired, 1, 3000));
        assert_int_equal(heard.err, 0);
        trigger_close(trigger);
        trigger = NULL;
    }
}

static void the_button_and_the_contacts_are_heard_when_they_closed(void **state)
{
    (void)state;
    plug_in_the_real_one(50);
    rig_of(16);
    camera[15].feedback_line = CONFIG_CAPTURE;
    assert_int_equal(trigger_open(&trigger, &config, &host), 0);
    serve(&heard.n_fired, 1, 500);
    const int64_t press_ns = clock_ns() + 50 * MS;
    for (int bounce = 0; bounce < 5; bounce++) // opens and closes for 4 ms
        live_board_set(live, LIVE_BUTTON, 0, bounce % 2 == 0, press_ns + bounce * MS);
    live_board_set(live, LIVE_BUTTON, 0, false, press_ns + 150 * MS);
    assert_true(serve(&heard.n_button, 1, 1000));
    assert_true(llabs(heard.button_ns - press_ns) < 5 * MS);
    const struct trigger_shot shot = { .at_ns = clock_ns() + 300 * MS, .half_ms = 50, .hold_ms = 100 };
    assert_int_equal(trigger_fire(trigger, &shot), 0);
    double worst_us = 0;
    for (int i = 0; i < 16; i++) {
        live_board_set(live, i == 15 ? LIVE_CAPTURE : LIVE_INPUT, i, true, shot.at_ns + (30 + i) * MS);
        live_board_set(live, i == 15 ? LIVE_CAPTURE : LIVE_INPUT, i, false, shot.at_ns + (40 + i) * MS);
    }
    for (int i = 0; i < 16; i++) {
        assert_true(serve(&heard.n_feedback[i], 1, 2000));
        const double error_us = 1e-3 * (double)llabs(heard.feedback_ns[i] - shot.at_ns - (30 + i) * MS);
        worst_us = error_us > worst_us ? error_us : worst_us;
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
    assert_false(serve(&heard.n_fired, 1, 1500)); // it waits, for longer than any silence
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
    usleep(50000);
    assert_int_equal(trigger_relay(trigger, 3, false), 0);
    usleep(1400000);
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

// ---- a host that dies ------------------------------------------------------------------------------------------------------------------

enum host_state { HOST_CUTS, HOST_IS_ARMED, HOST_WAITS, HOST_HALF, HOST_FULL, HOST_N_STATES };

// Another process under the same preload: fork() alone would share umockdev's locks.
static int be_a_host(enum host_state state)
{
    rig_of(8);
    if (trigger_open(&trigger, &config, &host))
        return 1;
    const struct trigger_shot shot = { .at_ns = clock_ns() + (state == HOST_HALF ? 600 : state == HOST_IS_ARMED ? 900 : 60) * MS, .half_ms = state == HOST_HALF ? 550 : 0,
        .hold_ms = state == HOST_HALF ? 100 : 900, .on_button = state == HOST_WAITS };
    if (state == HOST_CUTS ? trigger_relay(trigger, 1, true) : trigger_fire(trigger, &shot))
        return 1;
    usleep(150000);
    puts("ready");
    fflush(stdout);
    serve(&heard.n_broken, 1, 20000);
    return 1;
}

static void when_the_host_dies_everything_is_released_within_the_limit(void **state)
{
    (void)state;
    plug_in_the_real_one(0);
    double worst_ms = 0;
    for (int s = 0; s < 2 * HOST_N_STATES; s++) {
        uint8_t outputs[SIMAVR_REGISTERS];
        char number[8], line[64];
        int status, ends[2];
        snprintf(number, sizeof(number), "%d", s % HOST_N_STATES);
        assert_int_equal(pipe(ends), 0);
        const pid_t pid = fork();
        assert_true(pid >= 0);
        if (!pid) {
            prctl(PR_SET_PDEATHSIG, SIGKILL);
            dup2(ends[1], 1);
            close(ends[0]);
            close(ends[1]);
            execl("/proc/self/exe", "host", number, NULL);
            _exit(127);
        }
        close(ends[1]);
        const ssize_t n = read(ends[0], line, sizeof(line));
        close(ends[0]);
        assert_true(n > 0);
        live_board_outputs(live, outputs);
        assert_int_equal(any_on(outputs), s % HOST_N_STATES != HOST_IS_ARMED && s % HOST_N_STATES != HOST_WAITS);
        look_at_edges();
        const int64_t killed_ns = clock_ns();
        kill(pid, s < HOST_N_STATES ? SIGKILL : SIGSTOP); // dead, or as good as
        if (s == HOST_WAITS)
            live_board_set(live, LIVE_BUTTON, 0, true, killed_ns + 650 * MS);
        usleep(900000);
        look_at_edges();
        live_board_outputs(live, outputs);
        assert_false(any_on(outputs));
        for (int i = 0; i < n_edges; i++) {
            const double ms = 1e-6 * (double)(edge[i].at_ns - killed_ns);
            worst_ms = ms > worst_ms ? ms : worst_ms;
            assert_true(ms < 600); // SILENCE_MS, and a beat of the board
        }
        live_board_set(live, LIVE_BUTTON, 0, false, clock_ns());
        kill(pid, SIGKILL);
        assert_int_equal(waitpid(pid, &status, 0), pid);
    }
    print_message("last edge at most %.0f ms after the host died or stood still\n", worst_ms);
    open_with(8); // and the next host finds it well
    const struct trigger_shot shot = { .at_ns = clock_ns() + 200 * MS, .hold_ms = 50 };
    assert_int_equal(trigger_fire(trigger, &shot), 0);
    assert_true(serve(&heard.n_fired, 1, 3000));
    assert_int_equal(heard.err, 0);
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
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_teardown(a_right_board_opens_fires_and_is_released_when_closed, close_all),
        cmocka_unit_test_teardown(a_board_is_chosen_by_its_serial_number, close_all),
        cmocka_unit_test_teardown(a_shot_is_one_edge_where_nothing_is_delayed, close_all),
        cmocka_unit_test_teardown(each_channel_keeps_its_delay, close_all),
        cmocka_unit_test_teardown(what_is_past_is_refused_and_presses_nothing, close_all),
        cmocka_unit_test_teardown(released_in_the_middle_of_a_shot, close_all),
        cmocka_unit_test_teardown(unplugged_while_armed_is_safe_and_reported_and_heals_when_replugged, close_all),
        cmocka_unit_test_teardown(the_button_and_the_contacts_are_heard_when_they_closed, close_all),
        cmocka_unit_test_teardown(an_armed_shot_follows_the_button_without_the_host, close_all),
        cmocka_unit_test_teardown(a_supply_comes_back_by_itself, close_all),
        cmocka_unit_test_teardown(the_head_turns_and_knows_its_limits, close_all),
        cmocka_unit_test_teardown(when_the_host_dies_everything_is_released_within_the_limit, close_all),
        cmocka_unit_test_teardown(whatever_a_board_says_is_refused_by_name_and_hangs_nothing, close_all),
    };
    begin_anew(argv);
    if (argc == 2)
        return be_a_host((enum host_state)atoi(argv[1]));
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
