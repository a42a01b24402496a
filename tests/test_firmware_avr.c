// tests/test_firmware_avr.c - the trigger board's real image in simavr: edges by CPU cycle, interrupts' latency, and that nothing stays on.
#include "tests/board/frames.h"
#include "tests/board/simavr_board.h"

#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

enum { MS = 16000, N_OUTPUTS = PROTO_OUTPUTS_MAX, MAX_ON_MS = 1000, LATENCY_MAX = 2500 };
static const char image[] = "build/firmware/trigger.elf";

static struct {
    int n_on[N_OUTPUTS], n_off[N_OUTPUTS], n_changes;
    uint64_t on[N_OUTPUTS], off[N_OUTPUTS], longest;
    uint8_t before[N_OUTPUTS / 8];
    int64_t position[PROTO_AXES];
    uint64_t last_step, least_between;
} seen;

static void on_outputs(void *arg, uint64_t cycle, const uint8_t *outputs)
{
    (void)arg;
    seen.n_changes++;
    for (int i = 0; i < N_OUTPUTS; i++) {
        const bool was = seen.before[i / 8] >> i % 8 & 1, is = outputs[i / 8] >> i % 8 & 1;
        if (is && !was) {
            seen.n_on[i]++;
            seen.on[i] = cycle;
        }
        if (was && !is) {
            seen.n_off[i]++;
            seen.off[i] = cycle;
            if (cycle - seen.on[i] > seen.longest)
                seen.longest = cycle - seen.on[i];
        }
    }
    memcpy(seen.before, outputs, sizeof(seen.before));
}

static void on_step(void *arg, uint64_t cycle, int axis, bool positive)
{
    (void)arg;
    seen.position[axis] += positive ? 1 : -1;
    if (axis == 0 && seen.last_step && cycle - seen.last_step < seen.least_between)
        seen.least_between = cycle - seen.last_step;
    if (axis == 0)
        seen.last_step = cycle;
}

// ---- one board, and a host at it ----------------------------------------------------------------------------------------------------------
static struct simavr_board *board;
static struct frames host;

static bool usb_out(void *arg, const uint8_t *bytes, size_t n)
{
    (void)arg;
    return simavr_board_out(board, PROTO_ENDPOINT_OUT, bytes, n) == 0;
}

static int usb_in(void *arg, uint8_t *packet)
{
    (void)arg;
    const int n = simavr_board_in(board, PROTO_ENDPOINT_IN, packet);
    return n > 0 ? n : 0;
}

static void usb_run(void *arg, uint64_t ticks)
{
    (void)arg;
    simavr_board_run(board, ticks);
}

static const struct frames_config studio = {
    .n_registers = 52, .n_input_registers = 25, .debounce_ms = 5, .silence_ms = 300, .feedback_ms = 20, .n_banks = 2,
    .bank = { { 0, 400, MAX_ON_MS }, { 400, 16, 500 } },
};

static void connect(void)
{
    assert_int_equal(simavr_board_enumerate(board), 0);
    host = (struct frames){ .out = usb_out, .in = usb_in, .run = usb_run };
    assert_int_equal(frames_hello(&host), PROTO_OK);
    assert_int_equal(frames_configure(&host, &studio), PROTO_OK);
}

static int setup(void **state)
{
    (void)state;
    memset(&seen, 0, sizeof(seen));
    seen.least_between = UINT64_MAX;
    const struct simavr_board_watch watch = { .outputs = on_outputs, .step = on_step };
    board = simavr_board_open(image, &watch);
    if (!board)
        return -1;
    connect();
    simavr_board_clear_latency(board);
    return 0;
}

// Whatever a test did: the core did not crash, no interrupt waited too long, no packet was thrown away unsent.
static int teardown(void **state)
{
    (void)state;
    int err = simavr_board_is_dead(board);
    for (int v = 0; v < SIMAVR_VECTORS; v++)
        if (simavr_board_latency(board)[v] > LATENCY_MAX) {
            fprintf(stderr, "# vector %d, %s, waited %u cycles\n", v, simavr_board_vector_name(v), simavr_board_latency(board)[v]);
            err = -1;
        }
    if (simavr_board_killed(board)) {
        fprintf(stderr, "# %u times a packet to the host was killed\n", simavr_board_killed(board));
        err = -1;
    }
    simavr_board_close(board);
    return err;
}

static uint32_t seed;
static uint32_t any(uint32_t n)
{
    seed = seed * 1664525u + 1013904223u;
    return (uint32_t)(((uint64_t)seed * n) >> 32);
}

static bool is_on(int output)
{
    return simavr_board_outputs(board)[output / 8] >> output % 8 & 1;
}

static int n_on(void)
{
    int n = 0;
    for (int i = 0; i < N_OUTPUTS; i++)
        n += is_on(i);
    return n;
}

static int control(uint8_t type, uint8_t request, uint16_t value, uint8_t *data, uint16_t n)
{
    const uint8_t packet[8] = { type, request, (uint8_t)value, (uint8_t)(value >> 8), 0, 0, (uint8_t)n, (uint8_t)(n >> 8) };
    return simavr_board_control(board, packet, data, n);
}

static uint64_t board_time(void)
{
    uint8_t a[16];
    assert_int_equal(control(0xC0, PROTO_GET_TIME, 0, a, 16), 16);
    return proto_get_u64(a);
}

static struct proto_capabilities capabilities(void)
{
    uint8_t a[PROTO_CAPABILITIES_BYTES];
    assert_int_equal(control(0xC0, PROTO_GET_CAPABILITIES, 0, a, sizeof(a)), sizeof(a));
    return proto_get_capabilities(a);
}

// ---- USB --------------------------------------------------------------------------------------------------------------------------------
static void it_says_who_it_is_and_stalls_what_it_does_not_know(void **state)
{
    (void)state;
    uint8_t d[255];
    assert_int_equal(control(0x80, 6, 0x0100, d, 64), 18);
    assert_int_equal(proto_get_u16(d + 8), PROTO_VENDOR_ID);
    assert_int_equal(proto_get_u16(d + 10), PROTO_PRODUCT_ID);
    assert_int_equal(control(0x80, 6, 0x0100, d, 8), 8); // as much as is asked for
    assert_int_equal(control(0x80, 6, 0x0200, d, 255), 32);
    assert_int_equal(proto_get_u16(d + 2), 32);
    assert_int_equal(d[20], PROTO_ENDPOINT_OUT);
    assert_int_equal(d[27], PROTO_ENDPOINT_IN);
    assert_int_equal(control(0x80, 6, 0x0301, d, 255), 2 + 2 * 9);
    assert_int_equal(d[2], 's');
    assert_int_equal(control(0x80, 6, 0x0303, d, 255), 42); // serial number
    assert_int_equal(control(0x80, 8, 0, d, 1), 1);
    assert_int_equal(d[0], 1);
    assert_int_equal(control(0x80, 6, 0x0600, d, 10), -EPIPE); // no high speed
    assert_int_equal(control(0x80, 6, 0x0307, d, 255), -EPIPE);
    assert_int_equal(control(0xC0, 99, 0, d, 8), -EPIPE);
    assert_int_equal(control(0x80, 6, 0x0100, d, 64), 18); // a stall does not last
    assert_int_equal(capabilities().ticks_per_s, SIMAVR_HZ);
    assert_int_equal(capabilities().reset_cause, PROTO_RESET_POWER);
}

static void its_time_is_that_of_the_setup_packet_also_where_the_counter_turns(void **state)
{
    (void)state;
    seed = 1;
    uint64_t latest = 0, before = 0;
    for (int i = 0; i < 400; i++) {
        // Every other one comes within 200 cycles of the 16-bit counter's turn, where a careless reader is 4 ms off.
        uint64_t wait = any(5000);
        if (i % 2) {
            const uint64_t turn = simavr_board_cycle(board) - simavr_board_cycle_of(board, 0);
            wait = 65536 - turn % 65536 + 65536 - 100 + any(200);
        }
        simavr_board_run(board, wait);
        const uint64_t asked = simavr_board_cycle(board);
        uint8_t a[16];
        assert_int_equal(control(0xC0, PROTO_GET_TIME, 0, a, 16), 16);
        const uint64_t stamp = simavr_board_cycle_of(board, proto_get_u64(a));
        assert_true(stamp >= asked);
        if (stamp - asked > latest)
            latest = stamp - asked;
        assert_int_equal(proto_get_u64(a + 8), before);
        before = proto_get_u64(a);
    }
    assert_true(latest < 1200); // no more than what other interrupts take
}

// ---- edges ------------------------------------------------------------------------------------------------------------------------------
static void fire(const struct frames_shot *s, uint64_t t0, struct frames_event *fired)
{
    assert_int_equal(frames_commit(&host, s, t0), PROTO_OK);
    assert_true(frames_listen(&host, 3000 * MS, PROTO_FIRED, fired));
    assert_int_equal(fired->payload[2], PROTO_FIRED_DONE);
    assert_int_equal(proto_get_u32(fired->payload + 12), 0);
}

static void a_whole_shot_of_64_or_200_changes_on_one_latch_edge_on_its_cycle(void **state)
{
    (void)state;
    for (int n = 64; n <= 200; n += 136) {
        memset(&seen, 0, sizeof(seen));
        struct frames_shot s = { .shot = (uint16_t)n, .n = n, .lead = 10 * MS, .hold = 30 * MS };
        for (int i = 0; i < n; i++) {
            s.output[i] = (uint8_t)i;
            s.together[(200 + i) / 8] |= (uint8_t)(1 << (200 + i) % 8);
        }
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
        const uint64_t t0 = board_time() + 20 * MS, cycle = simavr_board_cycle_of(board, t0);
        struct frames_event fired;
        fire(&s, t0, &fired);
        for (int i = 0; i < n; i++) {
            assert_int_equal(seen.on[200 + i], cycle);
            assert_int_equal(seen.on[i], cycle + s.lead);
            assert_int_equal(seen.off[i], cycle + s.lead + s.hold);
            assert_int_equal(seen.off[200 + i], cycle + s.lead + s.hold);
        }
        assert_int_equal(seen.n_changes, 3);
        assert_int_equal(proto_get_u16(fired.payload + 16), 3);
        assert_int_equal(proto_get_u64(fired.payload + 4), t0 + s.lead);
    }
}

static void a_delay_counts_in_single_cycles(void **state)
{
    (void)state;
    for (uint32_t delay = 100000; delay < 100004; delay++) {
        struct frames_shot s = { .shot = 1, .n = 2, .delay = { 0, delay }, .output = { 0, 1 }, .hold = 20 * MS };
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
        struct frames_event fired;
        fire(&s, board_time() + 10 * MS, &fired);
        assert_int_equal(seen.on[1] - seen.on[0], delay);
    }
}

static void edges_as_close_as_it_allows_come_on_their_cycles(void **state)
{
    (void)state;
    seed = 2;
    const struct proto_capabilities c = capabilities();
    for (int round = 0; round < 12; round++) {
        memset(&seen, 0, sizeof(seen));
        struct frames_shot s = { .shot = (uint16_t)round, .hold = (5 + any(40)) * MS };
        uint32_t at = 0;
        while (s.n < 200) {
            int group = 1 + (int)(any(3) ? 0 : any(60));
            if (group > 200 - s.n)
                group = 200 - s.n;
            at += s.n ? c.gap_base_ticks + c.gap_register_ticks * 52u + c.gap_channel_ticks * (uint32_t)group + (any(2) ? 0 : any(5000)) : 0;
            for (int k = 0; k < group; k++, s.n++) {
                s.delay[s.n] = at;
                s.output[s.n] = (uint8_t)(s.n * 7 % 200);
            }
        }
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
        const uint64_t t0 = board_time() + 5 * MS, cycle = simavr_board_cycle_of(board, t0);
        struct frames_event fired;
        assert_int_equal(frames_commit(&host, &s, t0), PROTO_OK);
        // Meanwhile the host keeps the board busy, contacts close, a lamp goes on.
        bool over = false;
        for (int i = 0; !over; i++) {
            simavr_board_input(board, (int)any(200), any(2));
            if (i % 8 == 0)
                board_time();
            assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ 144, 1, i / 4 % 2 }, 3, NULL), PROTO_OK);
            over = frames_listen(&host, any(3 * MS), PROTO_FIRED, &fired);
        }
        assert_int_equal(fired.payload[2], PROTO_FIRED_DONE);
        assert_int_equal(proto_get_u32(fired.payload + 12), 0);
        for (int i = 0; i < s.n; i++) {
            assert_int_equal(seen.n_on[s.output[i]], 1);
            assert_int_equal(seen.on[s.output[i]], cycle + s.delay[i]);
            assert_true(seen.off[s.output[i]] >= cycle + s.delay[i] + s.hold);
        }
        for (int o = 200; o < 400; o++)
            assert_int_equal(seen.n_on[o], 0);
    }
    assert_true(simavr_board_margin(board) > 200); // of the time between edges: what is left when the next is armed
}

// ---- nothing stays on -------------------------------------------------------------------------------------------------------------------
enum situation { ARMED, WAITING, HALF_PRESSED, PRESSED, SWITCHED_ON, N_SITUATIONS };

static void bring_about(enum situation what)
{
    struct frames_shot s = { .shot = 9, .n = 100, .lead = 100 * MS, .hold = 500 * MS };
    for (int i = 0; i < s.n; i++) {
        s.output[i] = (uint8_t)i;
        s.delay[i] = (uint32_t)(i / 10) * 10000;
    }
    s.together[30] = 0xFF;
    s.flags = what == ARMED ? PROTO_SHOT_ON_BUTTON : 0;
    memset(&seen, 0, sizeof(seen));
    if (what == SWITCHED_ON) {
        assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ 150, 1, 1 }, 3, NULL), PROTO_OK);
        frames_run(&host, 5 * MS);
        assert_int_equal(n_on(), 1);
        return;
    }
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, what == ARMED ? 5 * MS : board_time() + (what == WAITING ? 2000 : 5) * MS), PROTO_OK);
    frames_run(&host, (what == PRESSED ? 200 : what == HALF_PRESSED ? 50 : 1) * MS);
    assert_int_equal(n_on(), what == PRESSED ? 108 : what == HALF_PRESSED ? 8 : 0);
}

static void check_that_nothing_comes_back(void)
{
    const int n = seen.n_changes;
    assert_int_equal(n_on(), 0);
    simavr_board_button(board, true);
    simavr_board_run(board, 100 * MS);
    simavr_board_button(board, false);
    simavr_board_run(board, 2500 * MS);
    assert_int_equal(seen.n_changes, n);
    assert_int_equal(n_on(), 0);
    assert_int_equal(frames_command(&host, PROTO_PING, NULL, 0, NULL), PROTO_ERR_SESSION);
}

static void a_killed_host_leaves_nothing_on_in_any_state(void **state)
{
    (void)state;
    for (int what = 0; what < N_SITUATIONS; what++) {
        bring_about(what);
        simavr_board_run(board, (300 + 3) * MS);
        check_that_nothing_comes_back();
        frames_run(&host, 10 * MS);
        struct frames_event e;
        assert_true(frames_take(&host, PROTO_FAULT, &e));
        assert_int_equal(e.payload[0], PROTO_FAULT_SILENCE);
        assert_int_equal(frames_hello(&host), PROTO_OK);
        assert_int_equal(frames_configure(&host, &studio), PROTO_OK);
    }
}

static void suspend_and_bus_reset_release_within_an_interrupt(void **state)
{
    (void)state;
    for (int what = 0; what < N_SITUATIONS; what++) {
        bring_about(what);
        if (what % 2) {
            simavr_board_suspend(board);
            simavr_board_run(board, LATENCY_MAX);
            assert_int_equal(n_on(), 0);
            simavr_board_run(board, 5 * MS);
            check_that_nothing_comes_back();
            assert_int_equal(frames_hello(&host), PROTO_OK);
            assert_int_equal(frames_configure(&host, &studio), PROTO_OK);
        } else {
            simavr_board_bus_reset(board);
            assert_int_equal(n_on(), 0);
            connect();
            assert_int_equal(n_on(), 0);
        }
    }
}

static void a_hanging_loop_is_reset_by_the_watchdog_and_releases(void **state)
{
    (void)state;
    bring_about(PRESSED);
    simavr_board_hang(board);
    simavr_board_run(board, 140 * MS); // 120 ms, and what is left of it when it began
    assert_true(simavr_board_resets(board) >= 1);
    assert_int_equal(n_on(), 0);
    assert_true(seen.longest <= MAX_ON_MS * (uint64_t)MS);
}

static void every_reset_releases_at_once_and_is_told(void **state)
{
    (void)state;
    static const uint8_t causes[] = { [SIMAVR_POWER] = PROTO_RESET_POWER, [SIMAVR_PIN] = PROTO_RESET_PIN, [SIMAVR_BROWN_OUT] = PROTO_RESET_BROWN_OUT };
    for (int cause = SIMAVR_POWER; cause <= SIMAVR_BROWN_OUT; cause++) {
        bring_about(PRESSED);
        simavr_board_reset(board, cause);
        assert_int_equal(n_on(), 0);
        const int n = seen.n_changes;
        simavr_board_run(board, 300 * MS);
        assert_int_equal(seen.n_changes, n); // what the registers hold is not seen
        connect();
        assert_int_equal(capabilities().reset_cause, causes[cause]);
        assert_int_equal(seen.n_changes, n);
    }
}

static void an_output_left_on_is_cut_in_time(void **state)
{
    (void)state;
    bring_about(SWITCHED_ON);
    struct frames_event e;
    assert_true(frames_listen(&host, 1000 * MS, PROTO_FAULT, &e));
    assert_int_equal(e.payload[0], PROTO_FAULT_ON_TIME);
    assert_int_equal(proto_get_u16(e.payload + 2), 406);
    assert_int_equal(n_on(), 0);
    assert_true(seen.longest <= 500 * MS);
    assert_true(seen.longest >= (500 - PROTO_ON_SLACK_MS) * MS);
}

static void release_all_by_control_request_ends_a_shot(void **state)
{
    (void)state;
    bring_about(PRESSED);
    assert_int_equal(control(0x40, PROTO_RELEASE_ALL, 0, NULL, 0), 0);
    assert_int_equal(n_on(), 0);
    struct frames_event e;
    assert_true(frames_listen(&host, 10 * MS, PROTO_FIRED, &e));
    assert_int_equal(e.payload[2], PROTO_FIRED_RELEASED);
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ 150, 1, 1 }, 3, NULL), PROTO_OK); // the session goes on
    frames_run(&host, MS);
    assert_int_equal(n_on(), 1);
}

static void random_bytes_change_nothing(void **state)
{
    (void)state;
    seed = 3;
    memset(&seen, 0, sizeof(seen));
    size_t n = 0;
    for (int wait = 0; n < 100000 && wait < 1000000; wait++) {
        uint8_t bytes[64], answer[64];
        for (size_t k = 0; k < sizeof(bytes); k++)
            bytes[k] = any(6) ? (uint8_t)any(256) : any(2) ? PROTO_SYNC_0 : PROTO_SYNC_1;
        if (usb_out(NULL, bytes, sizeof(bytes)))
            n += sizeof(bytes);
        simavr_board_run(board, 500);
        usb_in(NULL, answer);
    }
    assert_true(n >= 100000);
    assert_int_equal(seen.n_changes, 0);
    assert_int_equal(simavr_board_resets(board), 0);
    simavr_board_run(board, 200 * MS);
    assert_int_equal(frames_hello(&host), PROTO_OK);
}

// ---- inputs, head -----------------------------------------------------------------------------------------------------------------------
static void a_bouncing_button_fires_an_armed_shot_once_without_the_host(void **state)
{
    (void)state;
    struct frames_shot s = { .shot = 3, .flags = PROTO_SHOT_ON_BUTTON, .n = 64, .hold = 20 * MS };
    for (int i = 0; i < 64; i++)
        s.output[i] = (uint8_t)i;
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, 2 * MS), PROTO_OK);
    memset(&seen, 0, sizeof(seen));
    const uint64_t pressed = simavr_board_cycle(board);
    for (int i = 0; i < 6; i++) {
        simavr_board_button(board, true);
        simavr_board_run(board, 3000);
        simavr_board_button(board, false);
        simavr_board_run(board, 2000);
    }
    simavr_board_button(board, true);
    const uint64_t closed = simavr_board_cycle(board);
    simavr_board_run(board, 100 * MS); // nobody says anything
    struct frames_event e, fired;
    assert_true(frames_listen(&host, 10 * MS, PROTO_BUTTON, &e));
    assert_in_range(simavr_board_cycle_of(board, proto_get_u64(e.payload)), pressed, pressed + LATENCY_MAX);
    assert_int_equal(e.payload[9], 1);
    assert_true(frames_listen(&host, 10 * MS, PROTO_FIRED, &fired));
    for (int i = 0; i < 64; i++) {
        assert_int_equal(seen.n_on[i], 1);
        assert_int_equal(seen.on[i], simavr_board_cycle_of(board, proto_get_u64(fired.payload + 4)));
    }
    assert_in_range(seen.on[0], closed + 7 * MS, closed + 9 * MS); // 5 ms stable, 2 ms asked for
}

static void a_capture_is_stamped_with_its_cycle(void **state)
{
    (void)state;
    seed = 4;
    for (int i = 0; i < 60; i++) {
        const uint64_t turn = simavr_board_cycle(board) - simavr_board_cycle_of(board, 0);
        simavr_board_run(board, i % 2 ? any(20000) : 65536 - turn % 65536 + 65536 - 60 + any(120));
        const uint64_t at = simavr_board_cycle(board);
        simavr_board_capture(board, true);
        simavr_board_run(board, 1000);
        simavr_board_capture(board, false);
        struct frames_event e;
        assert_true(frames_listen(&host, 10 * MS, PROTO_CAPTURE, &e));
        assert_int_equal(simavr_board_cycle_of(board, proto_get_u64(e.payload)), at);
    }
}

static void contacts_that_close_are_told_with_their_sample(void **state)
{
    (void)state;
    struct frames_shot s = { .shot = 4, .n = 8, .hold = 100 * MS };
    for (int i = 0; i < 8; i++)
        s.output[i] = (uint8_t)i;
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, board_time() + 3 * MS), PROTO_OK);
    frames_run(&host, 8 * MS);
    uint64_t closed[200], told[200] = { 0 };
    for (int i = 0; i < 200; i += 10) {
        for (int k = i; k < i + 10; k++) {
            simavr_board_input(board, k * 37 % 200, true);
            closed[k * 37 % 200] = simavr_board_cycle(board);
        }
        frames_run(&host, 5000);
    }
    struct frames_event e;
    frames_run(&host, 30 * MS);
    while (frames_take(&host, PROTO_INPUTS, &e))
        for (int k = 8; k < e.n; k += 2)
            for (int i = 0; i < 8; i++)
                if (e.payload[k + 1] >> i & 1)
                    told[e.payload[k] * 8 + i] = simavr_board_cycle_of(board, proto_get_u64(e.payload));
    for (int i = 0; i < 200; i++)
        assert_in_range(told[i], closed[i] - LATENCY_MAX, closed[i] + 4000 + LATENCY_MAX);
}

static void the_head_steps_where_it_is_sent(void **state)
{
    (void)state;
    for (uint8_t axis = 0; axis < 2; axis++) {
        uint8_t p[PROTO_HEAD_CONFIGURE_BYTES] = { axis, 0 };
        proto_put_u16(p + 2, 2000);
        proto_put_u32(p + 4, 20000);
        proto_put_u16(p + 8, 100);
        proto_put_u32(p + 12, (uint32_t)-5000);
        proto_put_u32(p + 16, 5000);
        assert_int_equal(frames_command(&host, PROTO_HEAD_CONFIGURE, p, sizeof(p), NULL), PROTO_OK);
    }
    assert_int_equal(frames_command(&host, PROTO_HEAD_HOME, (uint8_t[]){ 3, 1 }, 2, NULL), PROTO_OK);
    struct frames_event e;
    assert_true(frames_listen(&host, 10 * MS, PROTO_HEAD, &e));
    uint8_t to[8];
    proto_put_u32(to, 700);
    proto_put_u32(to + 4, (uint32_t)-333);
    assert_int_equal(frames_command(&host, PROTO_HEAD_MOVE, to, sizeof(to), NULL), PROTO_OK);
    assert_true(frames_listen(&host, 2000 * MS, PROTO_HEAD, &e));
    assert_int_equal(e.payload[0], PROTO_HEAD_ARRIVED);
    assert_int_equal(seen.position[0], 700);
    assert_int_equal(seen.position[1], -333);
    assert_true(seen.least_between >= 8000 - 2000 - LATENCY_MAX); // 8000 cycles a step, in beats of 2000, each of which may wait
    // Home: the switch closes, and opens again on the way back.
    simavr_board_home(board, 0, true);
    assert_int_equal(frames_command(&host, PROTO_HEAD_HOME, (uint8_t[]){ 1, 0 }, 2, NULL), PROTO_OK);
    frames_run(&host, 30 * MS);
    simavr_board_home(board, 0, false);
    assert_true(frames_listen(&host, 2000 * MS, PROTO_HEAD, &e));
    assert_int_equal(e.payload[0], PROTO_HEAD_ARRIVED);
    assert_int_equal(e.payload[1], 3);
    assert_int_equal(proto_get_i32(e.payload + 2), 0);
}

static void at_the_heads_top_speed_the_host_is_still_heard(void **state)
{
    (void)state;
    for (uint8_t axis = 0; axis < 2; axis++) {
        uint8_t p[PROTO_HEAD_CONFIGURE_BYTES] = { axis, 0 };
        proto_put_u16(p + 2, PROTO_HEAD_SPEED_MAX);
        proto_put_u32(p + 4, 100000);
        proto_put_u16(p + 8, 100);
        proto_put_u32(p + 16, 2000);
        assert_int_equal(frames_command(&host, PROTO_HEAD_CONFIGURE, p, sizeof(p), NULL), PROTO_OK);
    }
    assert_int_equal(frames_command(&host, PROTO_HEAD_HOME, (uint8_t[]){ 3, 1 }, 2, NULL), PROTO_OK);
    uint8_t to[8];
    proto_put_u32(to, 2000);
    proto_put_u32(to + 4, 2000);
    assert_int_equal(frames_command(&host, PROTO_HEAD_MOVE, to, sizeof(to), NULL), PROTO_OK);
    struct frames_event e;
    frames_take(&host, PROTO_HEAD, &e);
    for (int i = 0; i < 20; i++) {
        const uint64_t asked = simavr_board_cycle(board);
        assert_int_equal(frames_command(&host, PROTO_PING, NULL, 0, NULL), PROTO_OK);
        assert_true(simavr_board_cycle(board) - asked < 10 * MS);
        simavr_board_run(board, 20 * MS);
    }
    assert_true(frames_listen(&host, 1000 * MS, PROTO_HEAD, &e));
    assert_int_equal(proto_get_i32(e.payload + 6), 2000);
    assert_int_equal(simavr_board_resets(board), 0);
}

static void the_stack_leaves_ram(void **state)
{
    (void)state;
    edges_as_close_as_it_allows_come_on_their_cycles(NULL);
    assert_int_equal(frames_command(&host, PROTO_RELEASE, (uint8_t[]){ PROTO_RELEASE_EVERYTHING }, 1, NULL), PROTO_OK);
    bring_about(HALF_PRESSED);
    assert_int_equal(frames_command(&host, PROTO_RELEASE, (uint8_t[]){ PROTO_RELEASE_EVERYTHING }, 1, NULL), PROTO_OK);
    uint8_t a[PROTO_PAYLOAD_MAX];
    assert_int_equal(frames_command(&host, PROTO_STATUS, NULL, 0, a), PROTO_OK);
    assert_true(proto_get_u16(a + 34) >= 64);
    assert_int_equal(host.n_wrong, 0);
}

int main(void)
{
    if (access(image, R_OK)) {
        printf("1..0 # SKIP no %s: make firmware (it needs gcc-avr and avr-libc)\n", image);
        return 0;
    }
#define IN_SIMAVR(name) cmocka_unit_test_setup_teardown(name, setup, teardown)
    const struct CMUnitTest tests[] = {
        IN_SIMAVR(it_says_who_it_is_and_stalls_what_it_does_not_know),
        IN_SIMAVR(its_time_is_that_of_the_setup_packet_also_where_the_counter_turns),
        IN_SIMAVR(a_whole_shot_of_64_or_200_changes_on_one_latch_edge_on_its_cycle),
        IN_SIMAVR(a_delay_counts_in_single_cycles),
        IN_SIMAVR(edges_as_close_as_it_allows_come_on_their_cycles),
        IN_SIMAVR(a_killed_host_leaves_nothing_on_in_any_state),
        IN_SIMAVR(suspend_and_bus_reset_release_within_an_interrupt),
        IN_SIMAVR(a_hanging_loop_is_reset_by_the_watchdog_and_releases),
        IN_SIMAVR(every_reset_releases_at_once_and_is_told),
        IN_SIMAVR(an_output_left_on_is_cut_in_time),
        IN_SIMAVR(release_all_by_control_request_ends_a_shot),
        IN_SIMAVR(random_bytes_change_nothing),
        IN_SIMAVR(a_bouncing_button_fires_an_armed_shot_once_without_the_host),
        IN_SIMAVR(a_capture_is_stamped_with_its_cycle),
        IN_SIMAVR(contacts_that_close_are_told_with_their_sample),
        IN_SIMAVR(the_head_steps_where_it_is_sent),
        IN_SIMAVR(at_the_heads_top_speed_the_host_is_still_heard),
        IN_SIMAVR(the_stack_leaves_ram),
    };
    return cmocka_run_group_tests_name("firmware_avr", tests, NULL, NULL);
}
