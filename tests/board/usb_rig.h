// tests/board/usb_rig.h - what the tests of the trigger board on USB share: a rig whose board, a fake or the real firmware, hangs behind umockdev,
// the loop that serves it, and the edges that were latched. Included by one .c file per program.
#pragma once
#include "firmware/board.h"
#include "rigd/board_clock.h"
#include "rigd/trigger.h"
#include "solver/take/log.h"
#include "tests/board/board_time.h"
#include "tests/board/fake_board.h"
#include "tests/board/live_board.h"
#include "tests/scratch.h"

#include <errno.h>
#include <poll.h>
#include <string.h>
#include <time.h>

#define MS INT64_C(1000000)
enum { N_CAMERAS_MAX = 200 };
#define SLOT "2-3"

static UMockdevTestbed *bed;
static struct usbfs *usb;
static struct live_board *live;
static uint8_t descriptors[82];
static size_t n_descriptors;
static char serial[40];

static inline int64_t clock_ns(void)
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

static inline void on_fired(void *arg, int err, int64_t pressed_ns, int64_t late_ns)
{
    (void)arg;
    heard.n_fired++;
    heard.err = err;
    heard.pressed_ns = pressed_ns;
    heard.late_ns = late_ns;
}

static inline void on_feedback(void *arg, int camera, int64_t at_ns)
{
    (void)arg;
    heard.n_feedback[camera]++;
    heard.feedback_ns[camera] = at_ns;
}

static inline void on_button(void *arg, int64_t at_ns)
{
    (void)arg;
    heard.n_button++;
    heard.button_ns = at_ns;
}

static inline void on_broken(void *arg, int err)
{
    (void)arg;
    assert_int_equal(err, -EIO);
    heard.n_broken++;
}

static inline void on_head(void *arg, int err)
{
    (void)arg;
    heard.n_head++;
    heard.head_err = err;
}

static const struct trigger_host host = { .fired = on_fired, .feedback = on_feedback, .button = on_button, .broken = on_broken, .head_arrived = on_head };

static char words[4000]; // logged since the last look

static inline void remember(void *arg, enum log_level level, const char *message)
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
static inline void rig_of(int n)
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

static inline bool serve(const int *until, int least, int timeout_ms)
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

static inline int close_all(void **state)
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

// ---- the real firmware -----------------------------------------------------------------------------------------------------------------

static inline void plug(void)
{
    assert_int_equal(usbfs_plug(usb, SLOT, 9, descriptors, n_descriptors, serial), 0);
}

static inline void plug_in_the_real_one(double fast_ppm)
{
    assert_int_equal(live_board_open(&live, "build/firmware/trigger.elf", fast_ppm, NULL, NULL), 0);
    n_descriptors = live_board_descriptors(live, descriptors, sizeof(descriptors), serial);
    assert_true(n_descriptors > 18);
    assert_int_equal(strlen(serial), 20);
    assert_int_equal(usbfs_new(&usb, bed, &live_board_ops, live), 0);
    plug();
}

static inline void open_with(int n_cameras)
{
    rig_of(n_cameras);
    assert_int_equal(trigger_open(&trigger, &config, &host), 0);
}

static inline bool is_on(const uint8_t *outputs, int line)
{
    return outputs[line / 8] >> line % 8 & 1;
}

// Of those that are wired: simavr_board.h's chain goes on behind them, and holds what was shifted through.
static inline bool any_on(const uint8_t outputs[SIMAVR_REGISTERS])
{
    for (int i = 0; i < config.trigger.output_registers; i++)
        if (outputs[i])
            return true;
    return false;
}

// A busy machine needs longer to load it: then again, later.
static inline void fire(struct trigger_shot *shot)
{
    int err = -ETIME;
    for (int lead_ms = 300; err == -ETIME && lead_ms < 5000; lead_ms *= 2) {
        shot->at_ns = clock_ns() + lead_ms * MS;
        err = trigger_fire(trigger, shot);
    }
    assert_int_equal(err, 0);
}

static inline void wait_ms(int ms) // of the board's time
{
    for (const int64_t end_ns = clock_ns() + ms * MS; clock_ns() < end_ns;)
        usleep(1000);
}

static inline void wait_for_output(int line)
{
    uint8_t outputs[SIMAVR_REGISTERS] = { 0 };
    for (const int64_t end_ns = clock_ns() + 5000 * MS; !is_on(outputs, line) && clock_ns() < end_ns;) {
        wait_ms(10);
        live_board_outputs(live, outputs);
    }
    assert_true(is_on(outputs, line));
}

enum { EDGES_MAX = 1000 };
static struct live_edge edge[EDGES_MAX];
static int n_edges;

static inline void look_at_edges(void)
{
    n_edges = live_board_edges(live, edge, EDGES_MAX);
}

// When an output went on, and off again; it did so once. False: never on.
static inline bool pulse(int line, int64_t *on_ns, int64_t *off_ns)
{
    int n = 0;
    bool was = false;
    *on_ns = *off_ns = 0;
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

static inline int64_t gap_ns(int n_registers, int n_together)
{
    return (BOARD_GAP_BASE + BOARD_GAP_REGISTER * n_registers + BOARD_GAP_CHANNEL * n_together) * INT64_C(125) / 2;
}

// ---- under the preload -----------------------------------------------------------------------------------------------------------------

// It finds a host that dies within a request worth a word.
static inline void ignore(const gchar *domain, GLogLevelFlags level, const gchar *text, gpointer arg)
{
    (void)domain, (void)level, (void)text, (void)arg;
}

static inline int run_under_umockdev(const char *name, const struct CMUnitTest *tests, size_t n)
{
    if (board_time_share())
        return 1;
    bed = umockdev_testbed_new();
    g_log_set_handler(NULL, G_LOG_LEVEL_CRITICAL, ignore, NULL);
    if (!umockdev_in_mock_environment()) {
        printf("1..0 # SKIP umockdev's library cannot be preloaded here (under a sanitizer that is linked statically?)\n");
        return 0;
    }
    const int failed = _cmocka_run_group_tests(name, tests, n, NULL, NULL);
    g_object_unref(bed);
    return failed;
}
