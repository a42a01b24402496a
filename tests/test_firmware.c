// tests/test_firmware.c - the trigger board's logic on the host: every edge on its tick, nothing on for too long, whatever the host does.
#include "firmware/board_sim.h"
#include "firmware/frame.h"
#include "firmware/usb.h"
#include "tests/board/frames.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { MS = 16000, BOARD_HZ = 16000000, N_OUTPUTS = PROTO_OUTPUTS_MAX, MAX_ON_MS = 2000 };
#define GRANTED ((uint32_t)(MAX_ON_MS - PROTO_ON_SLACK_MS) * MS)

// ---- the board, and a host at it ------------------------------------------------------------------------------------------------------
static struct {
    int n_on[N_OUTPUTS], n_off[N_OUTPUTS], n_changes;
    uint64_t on[N_OUTPUTS], off[N_OUTPUTS]; // the last
    uint8_t before[N_OUTPUTS / 8];
} seen;
static struct {
    int n[PROTO_AXES];
    int64_t position[PROTO_AXES];
    uint64_t last[PROTO_AXES];
    double speed[PROTO_AXES], fastest[PROTO_AXES], hardest[PROTO_AXES]; // steps/s, steps/s^2
} steps;

static void on_outputs(void *arg, uint64_t tick, const uint8_t *outputs)
{
    (void)arg;
    seen.n_changes++;
    for (int i = 0; i < N_OUTPUTS; i++) {
        const bool was = seen.before[i / 8] >> i % 8 & 1, is = outputs[i / 8] >> i % 8 & 1;
        if (is && !was) {
            seen.n_on[i]++;
            seen.on[i] = tick;
        }
        if (was && !is) {
            seen.n_off[i]++;
            seen.off[i] = tick;
        }
    }
    memcpy(seen.before, outputs, sizeof(seen.before));
}

static void on_step(void *arg, uint64_t tick, uint8_t axis, bool positive)
{
    (void)arg;
    steps.n[axis]++;
    steps.position[axis] += positive ? 1 : -1;
    if (steps.last[axis]) {
        const double seconds = (double)(tick - steps.last[axis]) / BOARD_HZ;
        const double speed = 1 / seconds, change = (speed - steps.speed[axis]) / seconds;
        if (speed > steps.fastest[axis])
            steps.fastest[axis] = speed;
        if (steps.speed[axis] > 0 && change > steps.hardest[axis])
            steps.hardest[axis] = change;
        steps.speed[axis] = speed;
    }
    steps.last[axis] = tick;
}

static bool sim_out(void *arg, const uint8_t *bytes, size_t n)
{
    (void)arg;
    if (board_sim_waiting() > 1000)
        return false;
    board_sim_write(bytes, n);
    return true;
}

static int sim_in(void *arg, uint8_t *packet)
{
    (void)arg;
    return board_sim_read(packet);
}

static void sim_run(void *arg, uint64_t ticks)
{
    (void)arg;
    board_sim_run(ticks);
}

static struct frames host;
static const struct frames_config studio = {
    .n_registers = 52, .n_input_registers = 25, .debounce_ms = 5, .silence_ms = 500, .feedback_ms = 50, .n_banks = 3,
    .bank = { { 0, 200, MAX_ON_MS }, { 200, 200, MAX_ON_MS }, { 400, 16, 5000 } },
};

static void start_at(uint64_t tick)
{
    memset(&seen, 0, sizeof(seen));
    memset(&steps, 0, sizeof(steps));
    board_sim_start(tick);
    board_sim.on_outputs = on_outputs;
    board_sim.on_step = on_step;
    host = (struct frames){ .out = sim_out, .in = sim_in, .run = sim_run };
}

static void start(void)
{
    start_at(12345);
    assert_int_equal(frames_hello(&host), PROTO_OK);
    assert_int_equal(frames_configure(&host, &studio), PROTO_OK);
}

static uint32_t seed;
static uint32_t any(uint32_t n)
{
    seed = seed * 1664525u + 1013904223u;
    return (uint32_t)(((uint64_t)seed * n) >> 32);
}

static bool is_on(int output)
{
    return board_sim.outputs[output / 8] >> output % 8 & 1;
}

static int n_on(void)
{
    int n = 0;
    for (int i = 0; i < N_OUTPUTS; i++)
        n += is_on(i);
    return n;
}

// Nobody may have been on longer than its bank allows: neither before, nor now.
static void check_on_times(void)
{
    for (int i = 0; i < N_OUTPUTS; i++) {
        const uint64_t longest = (uint64_t)(i < 400 ? MAX_ON_MS : 5000) * MS;
        assert_true(board_sim.longest_on[i] <= longest);
        assert_true(!board_sim.on_since[i] || board_sim_now() + 1 - board_sim.on_since[i] <= longest);
    }
}

static uint32_t gap_of(int n)
{
    return 4400 + 50 * 52 + 72 * (uint32_t)n; // what the capabilities say; a test below compares
}

// ---- frames ---------------------------------------------------------------------------------------------------------------------------
static uint8_t make_frame(uint8_t *f, uint8_t n)
{
    for (uint8_t i = 0; i < n; i++)
        f[PROTO_HEADER_BYTES + i] = (uint8_t)any(256);
    return proto_seal(f, (uint8_t)any(256), (uint8_t)any(256), n);
}

// True: the byte made a frame whole.
static bool push(struct frame_reader *r, uint8_t byte, uint16_t now_ms)
{
    while (frame_next(r, now_ms))
        ;
    frame_push(r, byte, now_ms);
    return frame_next(r, now_ms);
}

static void a_frame_is_found_in_any_junk_that_does_not_hide_it(void **state)
{
    (void)state;
    seed = 1;
    for (int round = 0; round < 3000; round++) {
        struct frame_reader r = { 0 };
        uint8_t f[PROTO_FRAME_MAX];
        const uint8_t n = make_frame(f, (uint8_t)any(PROTO_PAYLOAD_MAX + 1));
        for (uint32_t junk = any(40); junk > 0; junk--)
            assert_false(push(&r, junk == 2 ? PROTO_SYNC_0 : junk == 1 ? PROTO_SYNC_1 : (uint8_t)any(PROTO_SYNC_0), 0));
        // The junk may look like the begin of a frame: then the real one is found when that has failed, at the latest with 61 bytes more.
        bool found = false;
        for (uint8_t i = 0; i < n + 61 && !found; i++)
            found = push(&r, i < n ? f[i] : 0, 0);
        assert_true(found);
        assert_memory_equal(r.byte, f, n);
    }
}

static void a_frame_with_any_bit_wrong_is_no_frame(void **state)
{
    (void)state;
    seed = 2;
    for (int round = 0; round < 40; round++) {
        uint8_t f[PROTO_FRAME_MAX];
        const uint8_t n = make_frame(f, (uint8_t)any(PROTO_PAYLOAD_MAX + 1));
        for (int bit = 0; bit < 8 * n; bit++) {
            struct frame_reader r = { 0 };
            f[bit / 8] ^= (uint8_t)(1 << bit % 8);
            for (uint8_t i = 0; i < n; i++)
                assert_false(push(&r, f[i], 0));
            f[bit / 8] ^= (uint8_t)(1 << bit % 8);
        }
    }
}

static void a_frame_that_does_not_end_is_given_up(void **state)
{
    (void)state;
    struct frame_reader r = { 0 };
    uint8_t f[PROTO_FRAME_MAX];
    const uint8_t n = make_frame(f, 20);
    for (uint8_t i = 0; i < n - 1; i++)
        push(&r, f[i], 65500);
    frame_idle(&r, (uint16_t)(65500 + PROTO_FRAME_GAP_MS - 1));
    assert_int_equal(r.n, n - 1);
    frame_idle(&r, (uint16_t)(65500 + PROTO_FRAME_GAP_MS)); // the clock wrapped
    assert_int_equal(r.n, 0);
    assert_int_equal(r.n_bad, 1);
    assert_false(push(&r, f[n - 1], 0));
    for (uint8_t i = 0; i < n; i++)
        assert_int_equal(push(&r, f[i], 1), i == n - 1);
}

// What begins like a long frame and is none may hold several short ones: each is given out once, in order, and none is written past the end.
static void frames_hidden_in_a_broken_one_are_given_out_once_each(void **state)
{
    (void)state;
    seed = 3;
    for (int round = 0; round < 2000; round++) {
        struct frame_reader r = { 0 };
        uint8_t bytes[400], sent[12];
        int n = 0, n_sent = 0, n_found = 0;
        for (int burst = 0; burst < 3; burst++) {
            const uint8_t begin[3] = { PROTO_SYNC_0, PROTO_SYNC_1, (uint8_t)any(PROTO_PAYLOAD_MAX + 1) };
            memcpy(bytes + n, begin, sizeof(begin));
            n += sizeof(begin);
            for (uint32_t k = 1 + any(4); k > 0; k--) {
                uint8_t f[PROTO_FRAME_MAX];
                const uint8_t n_frame = make_frame(f, (uint8_t)any(12));
                memcpy(bytes + n, f, n_frame);
                n += n_frame, sent[n_sent++] = f[3];
            }
        }
        memset(bytes + n, 0, PROTO_FRAME_MAX);
        n += PROTO_FRAME_MAX;
        for (int i = 0; i < n; i++) {
            frame_push(&r, bytes[i], 0);
            while (frame_next(&r, 0)) {
                assert_true(n_found < n_sent && r.byte[3] == sent[n_found]);
                n_found++;
            }
            assert_true(r.n < PROTO_FRAME_MAX);
        }
        assert_int_equal(n_found, n_sent);
    }
}

// A host that died amid a frame leaves its begin; the next one's HELLO comes at once and must not be lost with it.
static void a_hello_behind_half_a_frame_is_answered(void **state)
{
    (void)state;
    start_at(0);
    board_sim_write((const uint8_t[]){ PROTO_SYNC_0, PROTO_SYNC_1, PROTO_PAYLOAD_MAX, 1, PROTO_SHOT_TOGETHER, 7 }, 6);
    board_sim_run(MS);
    uint8_t hello[PROTO_FRAME_MAX], packet[PROTO_PACKET_BYTES];
    proto_put_u16(hello + PROTO_HEADER_BYTES, PROTO_VERSION);
    board_sim_write(hello, proto_seal(hello, PROTO_HELLO, 9, 2));
    board_sim_run((PROTO_FRAME_GAP_MS + 20) * MS);
    assert_int_equal(board_sim_read(packet), PROTO_HEADER_BYTES + 1 + PROTO_CAPABILITIES_BYTES + PROTO_CRC_BYTES);
    assert_int_equal(packet[4], PROTO_HELLO | PROTO_REPLY);
    assert_int_equal(packet[PROTO_HEADER_BYTES], PROTO_OK);
}

// ---- USB ------------------------------------------------------------------------------------------------------------------------------
static void endpoints_that_there_are_not_are_stalled(void **state)
{
    (void)state;
    start_at(0);
    usb_reset();
    uint8_t clear_halt[8] = { 2, 1, 0, 0, PROTO_ENDPOINT_IN, 0, 0, 0 };
    const uint8_t set_interface[8] = { 1, 11, 0, 0, 0, 0, 0, 0 }, set_configuration[8] = { 0, 9, 1, 0, 0, 0, 0, 0 };
    assert_int_equal(usb_setup(clear_halt, 0), USB_STALL); // not configured: there is none yet
    assert_int_equal(usb_setup(set_interface, 0), USB_STALL);
    assert_int_equal(usb_setup(set_configuration, 0), USB_CONFIGURED);
    assert_int_equal(usb_setup(set_interface, 0), USB_CONFIGURED);
    for (int endpoint = 0; endpoint < 256; endpoint++) {
        clear_halt[4] = (uint8_t)endpoint;
        const bool is_ours = endpoint == PROTO_ENDPOINT_OUT || endpoint == PROTO_ENDPOINT_IN;
        assert_int_equal(usb_setup(clear_halt, 0), is_ours ? USB_CLEAR_HALT : USB_STALL);
    }
}

// ---- sessions -------------------------------------------------------------------------------------------------------------------------
static void nothing_is_done_without_a_session_or_out_of_sequence(void **state)
{
    (void)state;
    start_at(0);
    const uint8_t on[3] = { 144, 1, 1 }; // output 400
    uint8_t reply[PROTO_PAYLOAD_MAX];
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, on, 3, NULL), PROTO_ERR_SESSION);
    assert_int_equal(frames_command(&host, PROTO_HELLO, (uint8_t[]){ 0, 2 }, 2, reply), PROTO_ERR_VERSION);
    assert_int_equal(proto_get_u16(reply), PROTO_VERSION);
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, on, 3, NULL), PROTO_ERR_SESSION);
    host.sequence = 77;
    assert_int_equal(frames_hello(&host), PROTO_OK);
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, on, 3, NULL), PROTO_ERR_CONFIGURE);
    assert_int_equal(frames_configure(&host, &studio), PROTO_OK);
    host.sequence--;
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, on, 3, reply), PROTO_ERR_SEQUENCE); // said twice
    assert_int_equal(reply[0], 80);
    host.sequence++;
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, on, 3, NULL), PROTO_ERR_SEQUENCE); // one is missing
    assert_int_equal(n_on(), 0);
    host.sequence = 80;
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, on, 3, NULL), PROTO_OK);
    board_sim_run(MS);
    assert_true(is_on(400));
    assert_int_equal(frames_hello(&host), PROTO_OK); // another host: nothing of the last one's stays
    assert_int_equal(n_on(), 0);
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, on, 3, NULL), PROTO_ERR_CONFIGURE);
    assert_int_equal(host.n_wrong, 0);
}

static void a_command_of_the_wrong_length_or_value_changes_nothing(void **state)
{
    (void)state;
    start();
    static const uint8_t commands[] = { PROTO_PING, PROTO_CONFIGURE, PROTO_STATUS, PROTO_SHOT_BEGIN, PROTO_SHOT_TOGETHER, PROTO_SHOT_CHANNELS,
        PROTO_SHOT_COMMIT, PROTO_RELEASE, PROTO_OUTPUT, PROTO_IDENTIFY, PROTO_HEAD_CONFIGURE, PROTO_HEAD_MOVE, PROTO_HEAD_HOME, PROTO_HEAD_STOP };
    static const uint8_t lengths[] = { 0, 0, 0, 12, 0, 0, 10, 1, 3, 2, 20, 8, 2, 0 }; // 0: several, or none
    uint8_t p[PROTO_PAYLOAD_MAX];
    memset(p, 0xEE, sizeof(p));
    for (size_t i = 0; i < sizeof(commands); i++)
        for (size_t n = 0; n <= PROTO_PAYLOAD_MAX; n++) {
            const int err = frames_command(&host, commands[i], p, n, NULL);
            if (lengths[i] && n != lengths[i])
                assert_int_equal(err, PROTO_ERR_LENGTH);
            else if (commands[i] != PROTO_PING && commands[i] != PROTO_STATUS && commands[i] != PROTO_IDENTIFY && commands[i] != PROTO_HEAD_STOP)
                assert_true(err > PROTO_OK);
        }
    assert_int_equal(frames_command(&host, 0x3F, p, 0, NULL), PROTO_ERR_TYPE);
    board_sim_run(100 * MS);
    assert_int_equal(seen.n_changes, 0);
    // It is as configured as before.
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ 144, 1, 1 }, 3, NULL), PROTO_OK);
}

static void capabilities_and_status_say_what_is(void **state)
{
    (void)state;
    start();
    uint8_t a[PROTO_PACKET_BYTES];
    const uint8_t ask[8] = { 0xC0, PROTO_GET_CAPABILITIES, 0, 0, 0, 0, 255, 0 };
    assert_int_equal(board_sim_control(ask, a), PROTO_CAPABILITIES_BYTES);
    const struct proto_capabilities c = proto_get_capabilities(a);
    assert_int_equal(c.version, PROTO_VERSION);
    assert_int_equal(c.ticks_per_s, BOARD_HZ);
    assert_int_equal(c.n_channels, 200);
    assert_int_equal(c.n_outputs, 416);
    assert_int_equal(c.reset_cause, PROTO_RESET_POWER);
    assert_int_equal(c.session, 1);
    for (int n = 1; n <= 200; n += 199)
        assert_int_equal(c.gap_base_ticks + c.gap_register_ticks * 52 + c.gap_channel_ticks * n, gap_of(n));
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ 144, 1, 1 }, 3, NULL), PROTO_OK);
    board_sim_run(MS);
    assert_int_equal(frames_command(&host, PROTO_STATUS, NULL, 0, a), PROTO_OK);
    assert_int_equal(a[0], PROTO_SHOT_IDLE);
    assert_int_equal(a[1], PROTO_IS_SESSION | PROTO_IS_CONFIGURED | PROTO_IS_ENABLED);
    assert_int_equal(proto_get_u16(a + 18), 1);
    assert_true(proto_get_u64(a + 4) <= board_sim_now() && proto_get_u64(a + 4) + 4000 > board_sim_now());
    assert_int_equal(a[31], host.sequence);
    assert_int_equal(proto_get_u16(a + 36), 500);
}

// ---- shots ----------------------------------------------------------------------------------------------------------------------------
static struct frames_shot plain_shot(int n)
{
    struct frames_shot s = { .shot = 5, .n = n, .lead = 20 * MS, .hold = 50 * MS };
    for (int i = 0; i < n; i++)
        s.output[i] = (uint8_t)i;
    return s;
}

static void check_shot(const struct frames_shot *s, uint64_t t0)
{
    uint64_t last_press = t0, last_off = 0;
    for (int i = 0; i < s->n; i++)
        if (t0 + s->lead + s->delay[i] > last_press)
            last_press = t0 + s->lead + s->delay[i];
    for (int i = 0; i < s->n; i++) {
        const int o = s->output[i];
        const uint64_t press = t0 + s->lead + s->delay[i], release = press + s->hold;
        assert_int_equal(seen.n_on[o], 1);
        assert_int_equal(seen.n_off[o], 1);
        assert_int_equal(seen.on[o], press); // to the tick
        assert_true(seen.off[o] >= release);
        assert_true(seen.off[o] <= (release > last_press ? release : last_press) + 2 * MS);
        if (seen.off[o] > last_off)
            last_off = seen.off[o];
    }
    for (int o = 0; o < N_OUTPUTS; o++) {
        bool channel = false;
        for (int i = 0; i < s->n; i++)
            channel |= s->output[i] == o;
        if (channel)
            continue;
        const bool together = s->together[o / 8] >> o % 8 & 1;
        assert_int_equal(seen.n_on[o], together);
        assert_int_equal(seen.n_off[o], together);
        if (together) {
            assert_int_equal(seen.on[o], t0);
            if (s->n)
                assert_int_equal(seen.off[o], last_off);
            else
                assert_true(seen.off[o] >= t0 + s->lead + s->hold && seen.off[o] <= t0 + s->lead + s->hold + MS);
        }
    }
}

static void all_channels_of_one_delay_change_on_one_latch_edge(void **state)
{
    (void)state;
    for (int n = 1; n <= 200; n += n < 64 ? 63 : 136) {
        start();
        const struct frames_shot s = plain_shot(n);
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
        const uint64_t t0 = board_sim_now() + 30 * MS;
        const unsigned latches = board_sim.n_latches;
        assert_int_equal(frames_commit(&host, &s, t0), PROTO_OK);
        struct frames_event e;
        assert_true(frames_listen(&host, 1000 * MS, PROTO_FIRED, &e));
        check_shot(&s, t0);
        assert_int_equal(seen.n_changes, 2);
        assert_int_equal(board_sim.n_latches - latches, 2);
        assert_int_equal(e.n, PROTO_FIRED_BYTES);
        assert_int_equal(proto_get_u16(e.payload), 5);
        assert_int_equal(e.payload[2], PROTO_FIRED_DONE);
        assert_int_equal(proto_get_u64(e.payload + 4), t0 + s.lead);
        assert_int_equal(proto_get_u32(e.payload + 12), 0); // late
        assert_int_equal(proto_get_u16(e.payload + 16), 2); // edges
    }
}

// Delays as far apart as the board wants them, in groups of any size.
static void make_any_shot(struct frames_shot *s)
{
    memset(s, 0, sizeof(*s));
    s->shot = (uint16_t)any(65536);
    s->n = (int)any(201);
    s->hold = (1 + any(300)) * MS + any(MS);
    uint8_t order[256];
    for (int i = 0; i < 200; i++)
        order[i] = (uint8_t)i;
    for (int i = 199; i > 0; i--) {
        const int k = (int)any((uint32_t)i + 1);
        const uint8_t t = order[i];
        order[i] = order[k];
        order[k] = t;
    }
    uint32_t at = 0;
    const uint32_t spread = any(3) == 0 ? 0 : any(2) ? 4 * MS : 300;
    for (int i = 0; i < s->n;) {
        int group = 1 + (int)(any(4) ? 0 : any(64));
        if (group > s->n - i)
            group = s->n - i;
        if (i > 0)
            at += gap_of(group) + any(spread + 1);
        for (int k = 0; k < group; k++, i++) {
            s->delay[i] = at;
            s->output[i] = order[i];
        }
    }
    const bool half = s->n == 0 || any(2);
    if (half) {
        for (int r = 25; r < 50; r++)
            s->together[r] = (uint8_t)any(256);
        s->together[25] |= 1;
        s->lead = any(3) ? gap_of(200) + any(300 * MS) : 0;
    }
}

static void every_edge_of_any_plan_comes_on_its_tick(void **state)
{
    (void)state;
    seed = 3;
    int n_fired = 0;
    for (int round = 0; round < 150; round++) {
        start_at(round % 3 == 0 ? UINT32_MAX - any(400 * MS) : any(UINT32_MAX)); // the low 32 bits wrap
        assert_int_equal(frames_hello(&host), PROTO_OK);
        assert_int_equal(frames_configure(&host, &studio), PROTO_OK);
        struct frames_shot s;
        make_any_shot(&s);
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
        const uint64_t t0 = board_sim_now() + 5 * MS + any(round % 10 == 0 ? 1000 * MS : 20 * MS);
        const int err = frames_commit(&host, &s, t0);
        const uint32_t last = s.n ? s.delay[s.n - 1] : 0;
        if (s.lead + last + s.hold > GRANTED && err == PROTO_ERR_ON_TIME)
            continue;
        assert_int_equal(err, PROTO_OK);
        struct frames_event e;
        assert_true(frames_listen(&host, 5000 * MS, PROTO_FIRED, &e));
        check_shot(&s, t0);
        check_on_times();
        assert_int_equal(e.payload[2], PROTO_FIRED_DONE);
        assert_int_equal(proto_get_u32(e.payload + 12), 0);
        assert_int_equal(proto_get_u64(e.payload + 4), s.n ? t0 + s.lead : t0);
        n_fired++;
    }
    assert_true(n_fired > 100);
}

static void lamps_and_relays_during_a_shot_do_not_move_its_edges(void **state)
{
    (void)state;
    seed = 4;
    for (int round = 0; round < 40; round++) {
        start();
        struct frames_shot s;
        do
            make_any_shot(&s);
        while (s.n == 0 || s.lead + s.delay[s.n - 1] + s.hold > GRANTED);
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
        const uint64_t t0 = board_sim_now() + 10 * MS;
        assert_int_equal(frames_commit(&host, &s, t0), PROTO_OK);
        const uint64_t over = t0 + s.lead + s.delay[s.n - 1] + s.hold;
        struct frames_event e;
        bool on[16] = { 0 };
        while (!frames_listen(&host, any(2 * MS), PROTO_FIRED, &e)) {
            const uint8_t lamp = (uint8_t)any(16);
            on[lamp] = !on[lamp];
            assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ (uint8_t)(144 + lamp), 1, on[lamp] }, 3, NULL), PROTO_OK);
            if (board_sim_now() + 5 * MS < over)
                assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ s.output[0], 0, 1 }, 3, NULL), PROTO_ERR_BUSY);
        }
        board_sim_run(5 * MS);
        for (int lamp = 0; lamp < 16; lamp++) {
            assert_int_equal(is_on(400 + lamp), on[lamp]);
            seen.n_on[400 + lamp] = seen.n_off[400 + lamp] = 0;
        }
        assert_int_equal(proto_get_u32(e.payload + 12), 0);
        check_shot(&s, t0);
    }
}

static void a_shot_that_cannot_be_done_is_refused_as_a_whole(void **state)
{
    (void)state;
    start();
    uint8_t reply[PROTO_PAYLOAD_MAX];
    struct frames_shot s = plain_shot(3);
    // The past, and what is too near to it.
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, 0), PROTO_ERR_PAST);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() - 1), PROTO_ERR_PAST);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 1000), PROTO_ERR_PAST);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 2 * PROTO_AHEAD_MAX_TICKS), PROTO_ERR_AHEAD);
    assert_int_equal(frames_commit(&host, &s, UINT64_MAX), PROTO_ERR_AHEAD);
    // Another shot; a shot that was not loaded.
    s.shot = 6;
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 100 * MS), PROTO_ERR_INCOMPLETE);
    uint8_t begin[PROTO_SHOT_BEGIN_BYTES] = { 6, 0, 0, 3 };
    proto_put_u32(begin + 8, 50 * MS);
    assert_int_equal(frames_command(&host, PROTO_SHOT_BEGIN, begin, sizeof(begin), NULL), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 100 * MS), PROTO_ERR_INCOMPLETE);
    // Delays that fall; an output twice; one in no bank; more than announced.
    assert_int_equal(frames_command(&host, PROTO_SHOT_CHANNELS, (uint8_t[]){ 0, 9, 0, 0, 1, 8, 0, 0, 2 }, 9, reply), PROTO_ERR_ORDER);
    assert_int_equal(reply[0], 1);
    assert_int_equal(frames_command(&host, PROTO_SHOT_CHANNELS, (uint8_t[]){ 1, 9, 0, 0, 1 }, 5, reply), PROTO_ERR_OUTPUT);
    assert_int_equal(proto_get_u16(reply), 1);
    assert_int_equal(frames_command(&host, PROTO_SHOT_CHANNELS, (uint8_t[]){ 0, 9, 0, 0, 1 }, 5, NULL), PROTO_ERR_VALUE);
    assert_int_equal(frames_command(&host, PROTO_SHOT_CHANNELS, (uint8_t[]){ 1, 9, 0, 0, 2, 9, 0, 0, 3, 9, 0, 0, 4 }, 13, NULL), PROTO_ERR_VALUE);
    // Edges too close: named by entry.
    s.delay[1] = gap_of(1) - 1;
    s.delay[2] = 100 * MS;
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    uint8_t commit[PROTO_SHOT_COMMIT_BYTES] = { 6 };
    proto_put_u64(commit + 2, board_sim_now() + 100 * MS);
    assert_int_equal(frames_command(&host, PROTO_SHOT_COMMIT, commit, sizeof(commit), reply), PROTO_ERR_GAP);
    assert_int_equal(reply[0], 1);
    s.delay[1]++;
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 100 * MS), PROTO_OK);
    assert_int_equal(frames_load(&host, &s), PROTO_ERR_BUSY);
    assert_int_equal(frames_configure(&host, &studio), PROTO_ERR_BUSY);
    assert_int_equal(frames_command(&host, PROTO_RELEASE, (uint8_t[]){ PROTO_RELEASE_SHOT }, 1, NULL), PROTO_OK);
    struct frames_event e;
    assert_true(frames_listen(&host, 100 * MS, PROTO_FIRED, &e));
    assert_int_equal(e.payload[2], PROTO_FIRED_RELEASED);
    // On for too long, by a tick: half-press from T0 to the last release, and a channel.
    s = plain_shot(2);
    s.together[30] = 1;
    s.hold = GRANTED - s.lead + 1;
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 100 * MS), PROTO_ERR_ON_TIME);
    s.together[30] = 0;
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 100 * MS), PROTO_OK);
    assert_int_equal(frames_command(&host, PROTO_RELEASE, (uint8_t[]){ PROTO_RELEASE_SHOT }, 1, NULL), PROTO_OK);
    assert_true(frames_listen(&host, 100 * MS, PROTO_FIRED, &e));
    // An output of it is on.
    assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ 1, 0, 1 }, 3, NULL), PROTO_OK);
    s = plain_shot(2);
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 100 * MS), PROTO_ERR_BUSY);
    for (int o = 0; o < N_OUTPUTS; o++)
        assert_int_equal(seen.n_on[o], o == 1);
}

static void a_release_in_the_middle_lets_go_at_once_and_says_so(void **state)
{
    (void)state;
    seed = 5;
    for (int round = 0; round < 120; round++) {
        start();
        struct frames_shot s;
        do
            make_any_shot(&s);
        while (s.n == 0 || s.lead + s.delay[s.n - 1] + s.hold > GRANTED);
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
        const uint64_t t0 = board_sim_now() + 5 * MS;
        assert_int_equal(frames_commit(&host, &s, t0), PROTO_OK);
        const uint64_t at = board_sim_now() + any(s.lead + s.delay[s.n - 1] + s.hold + 10 * MS);
        struct frames_event e;
        bool over = false;
        while (board_sim_now() < at && !over)
            over = frames_listen(&host, any(30 * MS), PROTO_FIRED, &e);
        const uint64_t asked = board_sim_now();
        if (!over) {
            if (round % 2)
                assert_int_equal(board_sim_control((uint8_t[]){ 0x40, PROTO_RELEASE_ALL, 0, 0, 0, 0, 0, 0 }, (uint8_t[64]){ 0 }), 0);
            else
                assert_int_equal(frames_command(&host, PROTO_RELEASE, (uint8_t[]){ PROTO_RELEASE_SHOT }, 1, NULL), PROTO_OK);
            board_sim_run(2 * MS);
            assert_int_equal(n_on(), 0);
            assert_true(frames_listen(&host, 10 * MS, PROTO_FIRED, &e));
            assert_true(e.payload[2] == PROTO_FIRED_RELEASED || proto_get_u16(e.payload + 16) > 1); // or it was over just then
        }
        for (int i = 0; i < s.n; i++) { // what was pressed was pressed on its tick, and nothing after
            assert_true(seen.n_on[s.output[i]] <= 1);
            if (seen.n_on[s.output[i]]) {
                assert_int_equal(seen.on[s.output[i]], t0 + s.lead + s.delay[i]);
                assert_true(seen.on[s.output[i]] <= asked + 2 * MS);
            }
        }
        board_sim_run(100 * MS);
        assert_int_equal(n_on(), 0);
        // The next shot goes as if nothing had been.
        if (round % 8 == 0) {
            memset(&seen, 0, sizeof(seen));
            const struct frames_shot next = plain_shot(64);
            assert_int_equal(frames_load(&host, &next), PROTO_OK);
            const uint64_t then = board_sim_now() + 30 * MS;
            assert_int_equal(frames_commit(&host, &next, then), PROTO_OK);
            assert_true(frames_listen(&host, 500 * MS, PROTO_FIRED, &e));
            check_shot(&next, then);
        }
    }
}

static void a_late_board_says_how_late_and_gives_up_what_is_too_late(void **state)
{
    (void)state;
    static const struct {
        uint16_t cost;
        bool late, given_up;
    } boards[] = { { 700, false, false }, { 1800, true, false }, { 40000, true, true } };
    for (int k = 0; k < 3; k++) {
        start();
        struct frames_shot s = plain_shot(8);
        for (int i = 0; i < 8; i++)
            s.delay[i] = (uint32_t)i * gap_of(1);
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
        const uint64_t t0 = board_sim_now() + 30 * MS;
        assert_int_equal(frames_commit(&host, &s, t0), PROTO_OK);
        board_sim_run(30 * MS);
        board_sim.cost_work = boards[k].cost;
        struct frames_event e;
        assert_true(frames_listen(&host, 3000 * MS, PROTO_FIRED, &e));
        uint64_t latest = 0;
        for (int i = 0; i < 8; i++)
            if (seen.n_on[i] && seen.on[i] - (t0 + s.lead + s.delay[i]) > latest)
                latest = seen.on[i] - (t0 + s.lead + s.delay[i]);
        assert_int_equal(e.payload[2], boards[k].given_up ? PROTO_FIRED_LATE : PROTO_FIRED_DONE);
        assert_int_equal(proto_get_u32(e.payload + 12), latest);
        if (!boards[k].given_up)
            assert_int_equal(latest > 0, boards[k].late);
        assert_true(latest <= 32000); // late_max_ticks
        assert_int_equal(n_on(), 0);
    }
}

// ---- nothing stays on -----------------------------------------------------------------------------------------------------------------
// The guard looks at each register every 64 ms: what went off and on again between two looks has not been on all the time.
static void what_is_pressed_again_at_once_is_granted_its_whole_time_again(void **state)
{
    (void)state;
    start();
    struct frames_shot s = plain_shot(200);
    struct frames_event e;
    s.lead = 0, s.hold = 1200 * MS;
    for (int round = 0; round < 4; round++) {
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
        assert_int_equal(frames_commit(&host, &s, frames_now(&host) + 10 * MS), PROTO_OK);
        assert_true(frames_listen(&host, 1500 * MS, PROTO_FIRED, &e));
        assert_int_equal(e.payload[2], PROTO_FIRED_DONE);
        for (int i = 0; i < 200; i++)
            assert_true(seen.off[i] - seen.on[i] >= s.hold);
    }
    const uint8_t on[3] = { 144, 1, 1 }, off[3] = { 144, 1, 0 }; // output 400, 5000 ms
    for (int round = 0; round < 4; round++) {
        assert_int_equal(frames_command(&host, PROTO_OUTPUT, on, 3, NULL), PROTO_OK);
        frames_run(&host, 4000 * MS);
        assert_true(is_on(400));
        assert_int_equal(frames_command(&host, PROTO_OUTPUT, off, 3, NULL), PROTO_OK);
        frames_run(&host, MS); // off indeed
    }
    check_on_times();
}

static void an_output_left_on_goes_off_by_itself_in_time(void **state)
{
    (void)state;
    for (int round = 0; round < 70; round++) {
        start();
        board_sim_run((uint64_t)round * MS + 77);
        assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ 149, 1, 1 }, 3, NULL), PROTO_OK); // 405
        assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ 7, 0, 1 }, 3, NULL), PROTO_OK);
        struct frames_event e;
        assert_true(frames_listen(&host, 3000 * MS, PROTO_FAULT, &e));
        assert_int_equal(e.payload[0], PROTO_FAULT_ON_TIME);
        assert_int_equal(proto_get_u16(e.payload + 2), 7);
        frames_run(&host, 4000 * MS);
        for (int o = 7; o <= 405; o += 398) {
            const uint64_t max_on = (uint64_t)(o == 7 ? MAX_ON_MS : 5000) * MS;
            assert_false(is_on(o));
            assert_int_equal(seen.n_on[o], 1);
            assert_true(board_sim.longest_on[o] <= max_on);
            assert_true(board_sim.longest_on[o] >= max_on - (uint64_t)PROTO_ON_SLACK_MS * MS);
        }
    }
}

enum situation { LOADED, ARMED, WAITING, HALF_PRESSED, PRESSED, SWITCHED_ON, HEAD_MOVES, N_SITUATIONS };

static void bring_about(enum situation what)
{
    struct frames_shot s = plain_shot(64);
    for (int i = 0; i < 64; i++)
        s.delay[i] = (uint32_t)(i / 8) * 10 * MS;
    s.together[26] = 0xFF;
    s.lead = 300 * MS;
    s.hold = 800 * MS;
    start();
    if (what <= PRESSED)
        assert_int_equal(frames_load(&host, &s), PROTO_OK);
    if (what == ARMED) {
        struct frames_shot armed = s;
        armed.flags = PROTO_SHOT_ON_BUTTON;
        assert_int_equal(frames_load(&host, &armed), PROTO_OK);
        assert_int_equal(frames_commit(&host, &armed, 10 * MS), PROTO_OK);
    }
    if (what == WAITING)
        assert_int_equal(frames_commit(&host, &s, board_sim_now() + 5000 * MS), PROTO_OK);
    if (what == HALF_PRESSED || what == PRESSED) {
        assert_int_equal(frames_commit(&host, &s, board_sim_now() + 10 * MS), PROTO_OK);
        frames_run(&host, (what == PRESSED ? 400 : 100) * MS);
        assert_int_equal(n_on(), what == PRESSED ? 72 : 8);
    }
    if (what == SWITCHED_ON) {
        assert_int_equal(frames_command(&host, PROTO_OUTPUT, (uint8_t[]){ 149, 1, 1 }, 3, NULL), PROTO_OK);
        board_sim_run(MS);
        assert_int_equal(n_on(), 1);
    }
    if (what == HEAD_MOVES) {
        uint8_t p[PROTO_HEAD_CONFIGURE_BYTES] = { 0 };
        proto_put_u16(p + 2, 1000);
        proto_put_u32(p + 4, 2000);
        proto_put_u16(p + 8, 100);
        proto_put_u32(p + 16, 100000);
        assert_int_equal(frames_command(&host, PROTO_HEAD_CONFIGURE, p, sizeof(p), NULL), PROTO_OK);
        assert_int_equal(frames_command(&host, PROTO_HEAD_HOME, (uint8_t[]){ 1, 1 }, 2, NULL), PROTO_OK);
        uint8_t to[8] = { 0 };
        proto_put_u32(to, 50000);
        assert_int_equal(frames_command(&host, PROTO_HEAD_MOVE, to, sizeof(to), NULL), PROTO_OK);
        frames_run(&host, 200 * MS);
        assert_true(steps.n[0] > 10);
    }
}

static void a_silent_host_leaves_nothing_on_in_any_state(void **state)
{
    (void)state;
    for (int what = 0; what < N_SITUATIONS; what++) {
        bring_about(what);
        board_sim_run(505 * MS); // silence_ms, and a few
        assert_int_equal(n_on(), 0);
        const int n_steps = steps.n[0], n_changes = seen.n_changes;
        board_sim_button(true); // nor does anything come back
        board_sim_run(6000 * MS);
        board_sim_button(false);
        assert_int_equal(seen.n_changes, n_changes);
        assert_int_equal(steps.n[0], n_steps);
        assert_int_equal(frames_command(&host, PROTO_PING, NULL, 0, NULL), PROTO_ERR_SESSION);
        frames_run(&host, 20 * MS);
        struct frames_event e;
        assert_true(frames_take(&host, PROTO_FAULT, &e));
        assert_int_equal(e.payload[0], PROTO_FAULT_SILENCE);
        if (what >= ARMED && what <= PRESSED) {
            assert_true(frames_take(&host, PROTO_FIRED, &e));
            assert_int_equal(e.payload[2], PROTO_FIRED_RELEASED);
        }
    }
}

static void a_host_that_does_not_read_is_silent_too(void **state)
{
    (void)state;
    bring_about(PRESSED);
    board_sim.deaf = true; // it writes, but its answers are not taken: the board cannot go on answering
    for (int ms = 0; ms < 600; ms += 20) {
        uint8_t frame[PROTO_FRAME_MAX];
        if (board_sim_waiting() < 1000)
            board_sim_write(frame, proto_seal(frame, PROTO_PING, host.sequence++, 0));
        board_sim_run(20 * MS);
    }
    assert_int_equal(n_on(), 0);
    check_on_times();
}

static void a_lost_link_releases_within_one_beat_in_any_state(void **state)
{
    (void)state;
    for (int what = 0; what < N_SITUATIONS; what++) {
        bring_about(what);
        board_sim_unplug();
        assert_int_equal(n_on(), 0); // at once, even
        board_sim_run(2000 + 800);
        const int n_steps = steps.n[0], n_changes = seen.n_changes;
        board_sim_run(6000 * MS);
        assert_int_equal(seen.n_changes, n_changes);
        assert_int_equal(steps.n[0], n_steps);
        assert_int_equal(frames_command(&host, PROTO_PING, NULL, 0, NULL), PROTO_ERR_SESSION);
    }
}

static void a_hanging_loop_is_reset_and_until_then_no_output_stays_on(void **state)
{
    (void)state;
    for (int what = 0; what < N_SITUATIONS; what++) {
        bring_about(what);
        board_sim.loop_hangs = true;
        board_sim_run(125 * MS);
        assert_int_equal(board_sim.n_watchdog, 1);
        assert_int_equal(n_on(), 0);
        board_sim_run(6000 * MS);
        assert_int_equal(n_on(), 0);
        check_on_times();
        uint8_t a[PROTO_PACKET_BYTES];
        board_sim_control((uint8_t[]){ 0xC0, PROTO_GET_CAPABILITIES, 0, 0, 0, 0, 255, 0 }, a);
        assert_int_equal(proto_get_capabilities(a).reset_cause, PROTO_RESET_WATCHDOG);
        assert_int_equal(proto_get_capabilities(a).session, 0);
    }
}

// ---- button, inputs -------------------------------------------------------------------------------------------------------------------
static void a_bouncing_button_is_pressed_once_at_its_first_contact(void **state)
{
    (void)state;
    seed = 6;
    for (int round = 0; round < 60; round++) {
        start();
        board_sim_run(any(3 * MS));
        const uint64_t first = board_sim_now();
        board_sim_button(true);
        for (uint32_t bounce = 2 * any(6); bounce > 0; bounce--) { // up to 4 ms of it
            board_sim_run(10 + any(5000));
            board_sim_button(bounce % 2);
        }
        const uint64_t closed = board_sim_now();
        struct frames_event e;
        assert_true(frames_listen(&host, 50 * MS, PROTO_BUTTON, &e));
        assert_int_equal(proto_get_u64(e.payload), first);
        assert_int_equal(e.payload[8], 1);
        assert_int_equal(e.payload[9], 0);
        assert_true(board_sim_now() >= closed + 5 * MS);
        assert_true(board_sim_now() <= closed + 8 * MS);
        frames_run(&host, 100 * MS);
        assert_int_equal(host.n_events, 0);
        board_sim_button(false);
        assert_true(frames_listen(&host, 50 * MS, PROTO_BUTTON, &e));
        assert_int_equal(e.payload[8], 0);
    }
}

static void a_spike_on_the_button_is_nothing_and_does_not_age_the_next_press(void **state)
{
    (void)state;
    start();
    struct frames_event e;
    for (int spike = 0; spike < 20; spike++) {
        board_sim_button(true);
        board_sim_run(spike % 2 ? 4 * MS : 30);
        board_sim_button(false);
        frames_run(&host, 30 * MS);
    }
    assert_false(frames_take(&host, PROTO_BUTTON, &e));
    const uint64_t first = board_sim_now();
    board_sim_button(true);
    assert_true(frames_listen(&host, 50 * MS, PROTO_BUTTON, &e));
    assert_int_equal(proto_get_u64(e.payload), first);
}

static void an_armed_shot_fires_on_the_button_without_the_host(void **state)
{
    (void)state;
    start();
    struct frames_shot s = plain_shot(64);
    s.flags = PROTO_SHOT_ON_BUTTON;
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, 10 * MS), PROTO_OK);
    frames_run(&host, 3000 * MS); // it waits as long as the session lives
    assert_int_equal(n_on(), 0);
    board_sim.deaf = true; // from here on nobody reads or says anything
    const uint64_t pressed = board_sim_now();
    board_sim_button(true);
    board_sim_run(200 * MS);
    board_sim.deaf = false;
    struct frames_event e, fired;
    assert_true(frames_listen(&host, 50 * MS, PROTO_BUTTON, &e));
    assert_int_equal(proto_get_u64(e.payload), pressed);
    assert_int_equal(e.payload[9], 1);
    assert_true(frames_listen(&host, 50 * MS, PROTO_FIRED, &fired));
    const uint64_t edge = proto_get_u64(fired.payload + 4);
    check_shot(&s, edge - s.lead);
    // Debounced after 5 to 6 ms, then 10 ms as asked, then the lead.
    assert_true(edge >= pressed + 15 * MS + s.lead && edge <= pressed + 17 * MS + s.lead);
    board_sim_button(false);
    frames_run(&host, 100 * MS);
    board_sim_button(true); // it fired once
    frames_run(&host, 500 * MS);
    for (int i = 0; i < 64; i++)
        assert_int_equal(seen.n_on[i], 1);
}

static void each_contact_that_closes_in_a_shot_is_told_once_with_its_sample(void **state)
{
    (void)state;
    start();
    struct frames_shot s = plain_shot(64);
    board_sim.input[199] = true; // sticks: says nothing
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    const uint64_t t0 = board_sim_now() + 10 * MS;
    assert_int_equal(frames_commit(&host, &s, t0), PROTO_OK);
    frames_run(&host, t0 + s.lead + 5 * MS - board_sim_now());
    uint64_t closed[200] = { 0 }, told[200] = { 0 };
    for (int step = 0; step < 60; step++) {
        for (int i = 0; i < 199; i++)
            if (i % 50 == step) {
                board_sim.input[i] = true;
                closed[i] = board_sim_now();
            } else if (closed[i] && step > i % 50 + 3) {
                board_sim.input[i] = step % 2; // bounces
            }
        frames_run(&host, 1234);
    }
    frames_run(&host, 200 * MS);
    struct frames_event e;
    while (frames_take(&host, PROTO_INPUTS, &e))
        for (int k = 8; k < e.n; k += 2)
            for (int i = 0; i < 8; i++)
                if (e.payload[k + 1] >> i & 1) {
                    const int input = e.payload[k] * 8 + i;
                    assert_int_equal(told[input], 0);
                    told[input] = proto_get_u64(e.payload);
                }
    for (int i = 0; i < 199; i++) // the next sample, and what the first one was late
        assert_true(told[i] >= closed[i] && told[i] <= closed[i] + 4000 + 800);
    assert_int_equal(told[199], 0);
    assert_true(frames_take(&host, PROTO_FIRED, &e));
    assert_int_equal(proto_get_u32(e.payload + 12), 0);
    assert_int_equal(proto_get_u16(e.payload + 18), 0);
    check_shot(&s, t0);
}

static void input_changes_that_nobody_reads_are_counted(void **state)
{
    (void)state;
    start();
    struct frames_shot s = plain_shot(8);
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 5 * MS), PROTO_OK);
    board_sim_run(30 * MS);
    board_sim.deaf = true;
    for (int i = 0; i < 200; i++) { // one register at a time, 8 samples each
        board_sim.input[i % 25 * 8 + i / 25] = true;
        board_sim_run(2000);
    }
    board_sim_run(100 * MS);
    board_sim.deaf = false;
    struct frames_event e;
    unsigned told = 0;
    frames_run(&host, 100 * MS);
    while (frames_take(&host, PROTO_INPUTS, &e))
        told += (e.n - 8) / 2;
    assert_true(frames_take(&host, PROTO_FIRED, &e));
    assert_true(told < 200);
    assert_int_equal(told + proto_get_u16(e.payload + 18), 200);
}

static void a_capture_is_stamped_exactly(void **state)
{
    (void)state;
    start();
    struct frames_event e;
    for (int i = 0; i < 6; i++) {
        board_sim_run(777);
        const uint64_t at = board_sim_now();
        board_sim_capture(true);
        board_sim_run(100);
        board_sim_capture(false); // the rising edge is not asked for
        assert_true(frames_listen(&host, 5 * MS, PROTO_CAPTURE, &e));
        assert_int_equal(proto_get_u64(e.payload), at);
        assert_int_equal(proto_get_u16(e.payload + 8), 0);
    }
    board_sim.deaf = true;
    for (int i = 0; i < 11; i++) {
        board_sim_run(4000);
        board_sim_capture(true);
        board_sim_capture(false);
    }
    board_sim.deaf = false;
    frames_run(&host, 20 * MS);
    int n = 0, lost = 0;
    for (; frames_take(&host, PROTO_CAPTURE, &e); n++)
        lost += proto_get_u16(e.payload + 8);
    assert_int_equal(n + lost, 11);
    assert_true(lost > 0);
}

// ---- head -----------------------------------------------------------------------------------------------------------------------------
static int configure_axis(uint8_t axis, uint8_t flags, uint16_t speed, uint32_t acceleration, uint16_t homing)
{
    uint8_t p[PROTO_HEAD_CONFIGURE_BYTES] = { axis, flags };
    proto_put_u16(p + 2, speed);
    proto_put_u32(p + 4, acceleration);
    proto_put_u16(p + 8, homing);
    proto_put_u32(p + 12, (uint32_t)-20000);
    proto_put_u32(p + 16, 20000);
    return frames_command(&host, PROTO_HEAD_CONFIGURE, p, sizeof(p), NULL);
}

static int move_to(int32_t yaw, int32_t pitch)
{
    uint8_t p[8];
    proto_put_u32(p, (uint32_t)yaw);
    proto_put_u32(p + 4, (uint32_t)pitch);
    return frames_command(&host, PROTO_HEAD_MOVE, p, sizeof(p), NULL);
}

static void forget_steps(void)
{
    const int64_t yaw = steps.position[0], pitch = steps.position[1];
    memset(&steps, 0, sizeof(steps));
    steps.position[0] = yaw;
    steps.position[1] = pitch;
}

static void the_head_arrives_exactly_and_within_its_limits(void **state)
{
    (void)state;
    static const struct {
        uint16_t speed;
        uint32_t acceleration;
        int32_t to;
    } moves[] = { { 1000, 2000, 5000 }, { 4000, 1000000, -20000 }, { 4000, 20000, 3 }, { 50, 10, -30 }, { 4000, 1, 40 }, { 1, 1000000, 2 },
        { 3000, 500, 1 }, { 4000, 8000, 20000 } };
    for (size_t i = 0; i < sizeof(moves) / sizeof(*moves); i++) {
        start();
        assert_int_equal(move_to(5, 5), PROTO_ERR_CONFIGURE);
        assert_int_equal(configure_axis(0, 0, moves[i].speed, moves[i].acceleration, 1), PROTO_OK);
        assert_int_equal(configure_axis(1, PROTO_HEAD_REVERSED, moves[i].speed, moves[i].acceleration, 1), PROTO_OK);
        assert_int_equal(move_to(5, 5), PROTO_ERR_NOT_HOMED);
        assert_int_equal(frames_command(&host, PROTO_HEAD_HOME, (uint8_t[]){ 3, 1 }, 2, NULL), PROTO_OK);
        struct frames_event e;
        assert_true(frames_listen(&host, 10 * MS, PROTO_HEAD, &e));
        assert_int_equal(e.payload[1], 3);
        assert_int_equal(move_to(20001, 0), PROTO_ERR_LIMIT);
        assert_int_equal(move_to(moves[i].to, moves[i].to / 2), PROTO_OK);
        const uint64_t began = board_sim_now();
        assert_int_equal(move_to(0, 0), PROTO_ERR_BUSY);
        assert_true(frames_listen(&host, 60000 * (uint64_t)MS, PROTO_HEAD, &e));
        assert_int_equal(e.payload[0], PROTO_HEAD_ARRIVED);
        assert_int_equal(proto_get_i32(e.payload + 2), moves[i].to);
        assert_int_equal(steps.position[0], moves[i].to);
        assert_int_equal(steps.position[1], -(moves[i].to / 2)); // reversed
        assert_int_equal(steps.n[0], abs(moves[i].to)); // no step there and back
        // One beat of 1/8000 s is the grain of a step's time; measured speeds are blurred by it.
        const double v = moves[i].speed, a = moves[i].acceleration, blur = v / 8000;
        assert_true(steps.fastest[0] <= v * (1 + 2 * blur) + 1);
        // The trapezoid's own time, from below and above.
        const double d = abs(moves[i].to), ideal = d * a > v * v ? d / v + v / a : 2 * sqrt(d / a);
        const double took = (double)(board_sim_now() - began) / BOARD_HZ;
        assert_true(took >= ideal * .7 - .01);
        assert_true(took <= ideal * 1.3 + 2 / v + .1);
    }
}

static void the_head_accelerates_no_harder_than_asked(void **state)
{
    (void)state;
    start();
    assert_int_equal(configure_axis(0, 0, 800, 1000, 1), PROTO_OK);
    assert_int_equal(frames_command(&host, PROTO_HEAD_HOME, (uint8_t[]){ 1, 1 }, 2, NULL), PROTO_OK);
    assert_int_equal(move_to(2000, 0), PROTO_OK);
    // Positions every 50 ms; second differences are accelerations.
    double before = 0, speed = 0, hardest = 0, fastest = 0;
    for (int i = 0; i < 80; i++) {
        frames_run(&host, 50 * MS);
        const double now = (double)steps.position[0], v = (now - before) / .05;
        if (fabs(v - speed) / .05 > hardest)
            hardest = fabs(v - speed) / .05;
        if (v > fastest)
            fastest = v;
        speed = v;
        before = now;
    }
    assert_int_equal(steps.position[0], 2000);
    assert_true(fastest >= 780 && fastest <= 820); // of one step in 50 ms
    assert_true(hardest <= 1000 + 2 * 20 / .05); // of two steps more or less in 50 ms
}

// The switch is closed where the position is at or below -300 (in steps from where the test began).
static void home_switch_at(int axis, int64_t at)
{
    board_sim.home[axis] = steps.position[axis] <= at;
}

static void homing_finds_the_switch_from_both_sides_and_zeroes_there(void **state)
{
    (void)state;
    for (int from = 0; from < 2; from++) {
        start();
        struct frames_event e;
        assert_int_equal(configure_axis(0, 0, 1000, 4000, 200), PROTO_OK);
        steps.position[0] = from ? -310 : 0;
        home_switch_at(0, -300);
        assert_int_equal(frames_command(&host, PROTO_HEAD_HOME, (uint8_t[]){ 1, 0 }, 2, NULL), PROTO_OK);
        bool still = false;
        for (int i = 0; i < 200000 && !still; i++) {
            board_sim_run(500);
            home_switch_at(0, -300);
            if (i % 100 == 0)
                still = frames_listen(&host, 1, PROTO_HEAD, &e);
        }
        assert_true(still);
        assert_int_equal(e.payload[0], PROTO_HEAD_ARRIVED);
        assert_int_equal(e.payload[1], 1);
        assert_int_equal(proto_get_i32(e.payload + 2), 0);
        assert_in_range(steps.position[0] + 300, 16, 18); // the same place from both sides, clear of the switch
        // To home and back again without meeting the switch; below it, it is met, and the position is not believed any more.
        assert_int_equal(move_to(100, 0), PROTO_OK);
        assert_true(frames_listen(&host, 2000 * MS, PROTO_HEAD, &e));
        assert_int_equal(move_to(0, 0), PROTO_OK);
        assert_true(frames_listen(&host, 2000 * MS, PROTO_HEAD, &e));
        assert_int_equal(e.payload[0], PROTO_HEAD_ARRIVED);
        assert_int_equal(move_to(-100, 0), PROTO_OK);
        for (int i = 0; i < 15000; i++) {
            board_sim_run(500);
            home_switch_at(0, -300);
        }
        assert_true(frames_listen(&host, 2000 * MS, PROTO_HEAD, &e));
        assert_int_equal(e.payload[0], PROTO_HEAD_BLOCKED);
        assert_int_equal(e.payload[1], 0);
        assert_int_equal(move_to(0, 0), PROTO_ERR_NOT_HOMED);
    }
}

static void the_head_and_a_shot_exclude_each_other_and_a_stop_brakes(void **state)
{
    (void)state;
    bring_about(HEAD_MOVES);
    struct frames_shot s = plain_shot(4);
    assert_int_equal(frames_load(&host, &s), PROTO_OK);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 100 * MS), PROTO_ERR_BUSY);
    forget_steps();
    frames_run(&host, 400 * MS);
    const double speed = steps.speed[0];
    assert_true(speed > 900);
    assert_int_equal(frames_command(&host, PROTO_HEAD_STOP, NULL, 0, NULL), PROTO_OK);
    const int64_t at = steps.position[0];
    struct frames_event e;
    assert_true(frames_listen(&host, 2000 * MS, PROTO_HEAD, &e));
    assert_int_equal(e.payload[0], PROTO_HEAD_STOPPED);
    assert_in_range(steps.position[0] - at, 230, 270); // v^2 / 2 a = 250
    assert_int_equal(proto_get_i32(e.payload + 2), steps.position[0]);
    assert_int_equal(frames_commit(&host, &s, board_sim_now() + 100 * MS), PROTO_OK);
    assert_int_equal(move_to(0, 0), PROTO_ERR_BUSY);
}

// ---- hostile bytes --------------------------------------------------------------------------------------------------------------------
static void random_bytes_do_nothing_whatever_the_state(void **state)
{
    (void)state;
    seed = 7;
    for (int what = 0; what < N_SITUATIONS; what++) {
        bring_about(what);
        board_sim_run(600 * MS); // silent: released
        memset(&seen, 0, sizeof(seen));
        for (int i = 0; i < 3000; i++) {
            uint8_t bytes[500];
            for (size_t k = 0; k < sizeof(bytes); k++)
                bytes[k] = any(8) ? (uint8_t)any(256) : any(2) ? PROTO_SYNC_0 : PROTO_SYNC_1;
            if (board_sim_waiting() < 3000)
                board_sim_write(bytes, sizeof(bytes));
            for (int quarter = 0; quarter < 4; quarter++) {
                board_sim_run(MS / 4);
                uint8_t p[PROTO_PACKET_BYTES];
                board_sim_read(p);
            }
        }
        assert_int_equal(seen.n_changes, 0);
    }
}

static void random_commands_keep_every_output_within_its_time(void **state)
{
    (void)state;
    seed = 8;
    start();
    uint64_t n_ok = 0;
    for (int i = 0; i < 60000; i++) {
        uint8_t frame[PROTO_FRAME_MAX], p[PROTO_PACKET_BYTES];
        static const uint8_t types[] = { PROTO_HELLO, PROTO_PING, PROTO_CONFIGURE, PROTO_STATUS, PROTO_SHOT_BEGIN, PROTO_SHOT_TOGETHER, PROTO_SHOT_CHANNELS,
            PROTO_SHOT_COMMIT, PROTO_RELEASE, PROTO_OUTPUT, PROTO_OUTPUT, PROTO_OUTPUT, PROTO_HEAD_CONFIGURE, PROTO_HEAD_MOVE, PROTO_HEAD_HOME, PROTO_HEAD_STOP };
        const uint8_t type = types[any(sizeof(types))];
        uint8_t n = (uint8_t)any(PROTO_PAYLOAD_MAX + 1), *q = frame + PROTO_HEADER_BYTES;
        for (uint8_t k = 0; k < n; k++)
            q[k] = any(2) ? (uint8_t)any(4) : (uint8_t)any(256);
        if (any(4)) // mostly plausible
            switch (type) {
            case PROTO_HELLO:
                if (any(20))
                    continue;
                n = 2;
                proto_put_u16(q, PROTO_VERSION);
                break;
            case PROTO_CONFIGURE:
                if (any(10))
                    continue;
                n = 16;
                q[0] = 52;
                q[1] = (uint8_t)any(26);
                proto_put_u16(q + 4, 500);
                q[6] = q[7] = 0;
                proto_put_u16(q + 10, 0);
                proto_put_u16(q + 12, 400);
                proto_put_u16(q + 14, (uint16_t)(200 + any(1800)));
                break;
            case PROTO_OUTPUT:
                n = 3;
                proto_put_u16(q, (uint16_t)any(420));
                q[2] = any(3) > 0;
                break;
            case PROTO_SHOT_BEGIN:
                n = 12;
                q[0] = q[1] = 0;
                q[2] = any(4) == 0;
                q[3] = (uint8_t)any(20);
                proto_put_u32(q + 4, any(100 * MS));
                proto_put_u32(q + 8, any(1000 * MS));
                break;
            case PROTO_SHOT_CHANNELS:
                n = 1 + 4;
                proto_put_u24(q + 1, q[0] * 10000u);
                break;
            case PROTO_SHOT_COMMIT:
                n = 10;
                q[0] = q[1] = 0;
                proto_put_u64(q + 2, any(2) ? board_sim_now() + any(200 * MS) : any(100 * MS));
                break;
            case PROTO_RELEASE:
                n = 1;
                if (any(10))
                    continue;
                break;
            default:
                break;
            }
        static uint8_t sequence;
        board_sim_write(frame, proto_seal(frame, type, any(50) ? sequence : (uint8_t)any(256), n));
        if (any(8) == 0)
            board_sim_button(any(2));
        if (any(3000) == 0)
            board_sim_unplug();
        board_sim_run(any(3) ? any(2 * MS) : any(30 * MS));
        for (int reads = 0; reads < 4; reads++)
            if (board_sim_read(p) && p[4] < PROTO_EVENT) {
                if (p[5] == PROTO_OK)
                    n_ok++;
                if (p[5] == PROTO_ERR_SEQUENCE)
                    sequence = p[6];
                else
                    sequence = (uint8_t)(p[3] + 1);
                board_sim_run(2000);
            }
        if (i % 64 == 0)
            for (int o = 0; o < N_OUTPUTS; o++)
                assert_true(board_sim.longest_on[o] <= 2000 * MS && (!board_sim.on_since[o] || board_sim_now() + 1 - board_sim.on_since[o] <= 2000 * MS));
    }
    assert_true(n_ok > 5000);
    assert_true(seen.n_changes > 500);
}

static void any_setup_packet_gets_an_answer_that_fits(void **state)
{
    (void)state;
    seed = 9;
    start();
    for (int i = 0; i < 200000; i++) {
        uint8_t setup[8], answer[PROTO_PACKET_BYTES];
        static const uint8_t kinds[] = { 0x00, 0x80, 0x01, 0x81, 0x02, 0x82, 0x40, 0xC0 };
        for (int k = 0; k < 8; k++)
            setup[k] = any(2) ? (uint8_t)any(12) : (uint8_t)any(256);
        if (any(4))
            setup[0] = kinds[any(sizeof(kinds))];
        if (any(2))
            setup[7] = 0;
        const int n = board_sim_control(setup, answer);
        assert_true(n < PROTO_PACKET_BYTES && n <= (setup[6] | setup[7] << 8));
        assert_true(setup[0] & 0x80 || n <= 0);
    }
    assert_int_equal(n_on(), 0);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_frame_is_found_in_any_junk_that_does_not_hide_it),
        cmocka_unit_test(a_frame_with_any_bit_wrong_is_no_frame),
        cmocka_unit_test(a_frame_that_does_not_end_is_given_up),
        cmocka_unit_test(frames_hidden_in_a_broken_one_are_given_out_once_each),
        cmocka_unit_test(a_hello_behind_half_a_frame_is_answered),
        cmocka_unit_test(endpoints_that_there_are_not_are_stalled),
        cmocka_unit_test(nothing_is_done_without_a_session_or_out_of_sequence),
        cmocka_unit_test(a_command_of_the_wrong_length_or_value_changes_nothing),
        cmocka_unit_test(capabilities_and_status_say_what_is),
        cmocka_unit_test(all_channels_of_one_delay_change_on_one_latch_edge),
        cmocka_unit_test(every_edge_of_any_plan_comes_on_its_tick),
        cmocka_unit_test(lamps_and_relays_during_a_shot_do_not_move_its_edges),
        cmocka_unit_test(a_shot_that_cannot_be_done_is_refused_as_a_whole),
        cmocka_unit_test(a_release_in_the_middle_lets_go_at_once_and_says_so),
        cmocka_unit_test(a_late_board_says_how_late_and_gives_up_what_is_too_late),
        cmocka_unit_test(what_is_pressed_again_at_once_is_granted_its_whole_time_again),
        cmocka_unit_test(an_output_left_on_goes_off_by_itself_in_time),
        cmocka_unit_test(a_silent_host_leaves_nothing_on_in_any_state),
        cmocka_unit_test(a_host_that_does_not_read_is_silent_too),
        cmocka_unit_test(a_lost_link_releases_within_one_beat_in_any_state),
        cmocka_unit_test(a_hanging_loop_is_reset_and_until_then_no_output_stays_on),
        cmocka_unit_test(a_bouncing_button_is_pressed_once_at_its_first_contact),
        cmocka_unit_test(a_spike_on_the_button_is_nothing_and_does_not_age_the_next_press),
        cmocka_unit_test(an_armed_shot_fires_on_the_button_without_the_host),
        cmocka_unit_test(each_contact_that_closes_in_a_shot_is_told_once_with_its_sample),
        cmocka_unit_test(input_changes_that_nobody_reads_are_counted),
        cmocka_unit_test(a_capture_is_stamped_exactly),
        cmocka_unit_test(the_head_arrives_exactly_and_within_its_limits),
        cmocka_unit_test(the_head_accelerates_no_harder_than_asked),
        cmocka_unit_test(homing_finds_the_switch_from_both_sides_and_zeroes_there),
        cmocka_unit_test(the_head_and_a_shot_exclude_each_other_and_a_stop_brakes),
        cmocka_unit_test(random_bytes_do_nothing_whatever_the_state),
        cmocka_unit_test(random_commands_keep_every_output_within_its_time),
        cmocka_unit_test(any_setup_packet_gets_an_answer_that_fits),
    };
    return cmocka_run_group_tests_name("firmware", tests, NULL, NULL);
}
