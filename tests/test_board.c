// tests/test_board.c - what the board says is checked, and a shot is said to it as it was planned.
#include "rigd/board.h"
#include "solver/take/log.h"

#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#define MS INT64_C(1000000)
enum { TICKS_PER_US = 16 };

static uint8_t frame[PROTO_FRAME_MAX];

static size_t sealed(uint8_t type, const uint8_t *payload, uint8_t n)
{
    memcpy(frame + PROTO_HEADER_BYTES, payload, n);
    return proto_seal(frame, type, 7, n);
}

static void an_event_says_what_was_put_into_it(void **state)
{
    (void)state;
    struct board_said s;
    const char *why;
    uint8_t p[PROTO_PAYLOAD_MAX] = { 0 };
    proto_put_u16(p, 0x1234);
    p[2] = PROTO_FIRED_LATE;
    proto_put_u64(p + 4, 1000000000007);
    proto_put_u32(p + 12, 99);
    proto_put_u16(p + 16, 5);
    proto_put_u16(p + 18, 6);
    assert_int_equal(board_decode(&s, frame, sealed(PROTO_FIRED, p, PROTO_FIRED_BYTES), &why), 0);
    assert_int_equal(s.sequence, 7);
    assert_true(s.fired.shot == 0x1234 && s.fired.how == PROTO_FIRED_LATE && s.fired.first_ticks == 1000000000007 && s.fired.late_ticks == 99 && s.fired.n_edges == 5 && s.fired.n_lost == 6);
    memset(p, 0, sizeof(p));
    proto_put_u64(p, 77);
    p[8] = 2;
    p[9] = 0x81;
    p[10] = 24;
    p[11] = 0x10;
    assert_int_equal(board_decode(&s, frame, sealed(PROTO_INPUTS, p, 12), &why), 0);
    assert_true(s.inputs.ticks == 77 && s.inputs.n == 3 && s.inputs.input[0] == 16 && s.inputs.input[1] == 23 && s.inputs.input[2] == 196);
    assert_int_equal(board_decode(&s, frame, sealed(PROTO_INPUTS, p, 11), &why), -EPROTO);
    memset(p, 0, sizeof(p));
    p[0] = PROTO_HEAD_BLOCKED;
    proto_put_u32(p + 2, (uint32_t)-5);
    assert_int_equal(board_decode(&s, frame, sealed(PROTO_HEAD, p, PROTO_HEAD_BYTES), &why), 0);
    assert_true(s.head.how == PROTO_HEAD_BLOCKED && s.head.yaw == -5);
    memset(p, 0xff, sizeof(p)); // a clock that cannot be
    p[8] = p[9] = 1;
    assert_int_equal(board_decode(&s, frame, sealed(PROTO_BUTTON, p, PROTO_BUTTON_BYTES), &why), -EPROTO);
    assert_int_equal(board_decode(&s, frame, sealed(PROTO_EVENT + 60, p, 3), &why), 0); // of a newer board: skipped, not refused
}

static void one_flipped_bit_is_never_taken_for_the_truth(void **state)
{
    (void)state;
    struct board_said s;
    const char *why;
    uint8_t p[PROTO_FIRED_BYTES] = { 0 };
    const size_t n = sealed(PROTO_FIRED, p, sizeof(p));
    assert_int_equal(board_decode(&s, frame, n, &why), 0);
    for (size_t bit = 0; bit < 8 * n; bit++) {
        frame[bit / 8] ^= (uint8_t)(1 << bit % 8);
        assert_int_equal(board_decode(&s, frame, n, &why), -EPROTO);
        frame[bit / 8] ^= (uint8_t)(1 << bit % 8);
    }
    for (size_t cut = 0; cut < n; cut++)
        assert_int_equal(board_decode(&s, frame, cut, &why), -EPROTO);
}

// ---- shots -------------------------------------------------------------------------------------------------------------------------------

static struct config_camera camera[PROTO_CHANNELS_MAX + 1];
static struct config config;
static struct edges edges;
static _Atomic int64_t limit[EDGES_WIRES_MAX];
static const struct proto_capabilities board = { .ticks_per_s = 1000000 * TICKS_PER_US, .n_channels = PROTO_CHANNELS_MAX, .gap_base_ticks = 3000, .gap_register_ticks = 40, .gap_channel_ticks = 60 };

static int64_t ticks_of(const void *arg, int64_t ns)
{
    (void)arg;
    return ns / 1000 * TICKS_PER_US + ns % 1000 * TICKS_PER_US / 1000;
}

static int plan(struct board_shot *s, int n, const uint32_t *delay_us, uint32_t half_ms, int n_registers)
{
    memset(&config, 0, sizeof(config));
    config.camera = camera;
    config.n_cameras = n;
    config.trigger = (struct trigger_config){ .kind = TRIGGER_USB, .full_line = CONFIG_NONE, .half_line = CONFIG_NONE, .max_hold_ms = 3000 };
    for (int i = 0; i < n; i++) {
        camera[i] = (struct config_camera){ .full_line = i, .half_line = 208 + i, .feedback_line = CONFIG_NONE, .relay_line = CONFIG_NONE };
        snprintf(camera[i].name, sizeof(camera[i].name), "A%03d", i);
    }
    memset((void *)limit, 0, sizeof(limit));
    assert_int_equal(edges_init(&edges, &config, false, limit), 0);
    const struct trigger_shot shot = { .at_ns = 5000 * MS, .half_ms = half_ms, .hold_ms = 100, .delay_us = delay_us };
    assert_int_equal(edges_plan(&edges, &shot, 0), 0);
    return board_shot_plan(s, &edges, &board, n_registers, ticks_of, NULL);
}

// Whatever was asked: in order, either together or as far apart as the board needs, and none further from its time than half of that.
static void presses_are_spaced_as_the_board_needs_and_stay_near_their_times(void **state)
{
    (void)state;
    static struct board_shot s;
    for (unsigned round = 1; round <= 400; round++) {
        unsigned seed = round;
        uint32_t delay_us[PROTO_CHANNELS_MAX];
        const int n = 1 + rand_r(&seed) % PROTO_CHANNELS_MAX, n_registers = 1 + rand_r(&seed) % 52;
        const uint32_t range_us = 1u << rand_r(&seed) % 20, half_ms = rand_r(&seed) % 2 ? 50 : 0;
        uint32_t least_us = UINT32_MAX;
        for (int i = 0; i < n; i++) {
            delay_us[i] = (uint32_t)rand_r(&seed) % range_us;
            least_us = delay_us[i] < least_us ? delay_us[i] : least_us;
        }
        assert_int_equal(plan(&s, n, delay_us, half_ms, n_registers), 0);
        assert_int_equal(s.n_channels, n);
        const int64_t first_ticks = ticks_of(NULL, 5000 * MS + least_us * INT64_C(1000));
        assert_int_equal(s.at_ticks, half_ms ? ticks_of(NULL, 4950 * MS) : first_ticks);
        assert_int_equal(s.lead_ticks, first_ticks - s.at_ticks);
        assert_int_equal(s.hold_ticks, 100000 * TICKS_PER_US);
        int n_here = 0, n_most = 0;
        for (int i = 0; i < n; i++) {
            n_here = i && s.channel[i].delay_ticks == s.channel[i - 1].delay_ticks ? n_here + 1 : 1;
            n_most = n_here > n_most ? n_here : n_most;
        }
        bool seen[PROTO_CHANNELS_MAX] = { false };
        for (int i = 0; i < n; i++) {
            const int64_t gap = i ? (int64_t)s.channel[i].delay_ticks - s.channel[i - 1].delay_ticks : 0;
            int n_edge = 1; // channels that share this edge
            while (i + n_edge < n && s.channel[i + n_edge].delay_ticks == s.channel[i].delay_ticks)
                n_edge++;
            assert_true(gap == 0 || gap >= 3000 + 40 * n_registers + 60 * n_edge);
            const int output = s.channel[i].output;
            assert_true(output < n && !seen[output]);
            seen[output] = true;
            const int64_t asked = (delay_us[output] - least_us) * (int64_t)TICKS_PER_US;
            assert_true(2 * llabs((int64_t)s.channel[i].delay_ticks - asked) <= 3000 + 40 * n_registers + 60 * (n_most + 10));
        }
        for (int i = 0; i < n; i++)
            assert_int_equal(s.together[(208 + i) / 8] >> (208 + i) % 8 & 1, half_ms > 0);
    }
}

// What the frames say, put together again as the board does, is the plan.
static void the_frames_carry_the_whole_shot(void **state)
{
    (void)state;
    static struct board_shot s;
    uint32_t delay_us[PROTO_CHANNELS_MAX];
    for (int i = 0; i < PROTO_CHANNELS_MAX; i++)
        delay_us[i] = (uint32_t)(i * 7919 % 30000);
    assert_int_equal(plan(&s, PROTO_CHANNELS_MAX, delay_us, 50, 52), 0);
    uint8_t type, p[PROTO_PAYLOAD_MAX], together[PROTO_OUTPUTS_MAX / 8] = { 0 };
    int n_channels = 0, n, i = 0;
    for (; (n = board_shot_frame(&s, i, 0xabcd, true, &type, p)) >= 0; i++) {
        assert_true(n <= PROTO_PAYLOAD_MAX);
        if (type == PROTO_SHOT_BEGIN) {
            assert_true(i == 0 && n == PROTO_SHOT_BEGIN_BYTES && proto_get_u16(p) == 0xabcd && p[2] == PROTO_SHOT_ON_BUTTON && p[3] == PROTO_CHANNELS_MAX);
            assert_true(proto_get_u32(p + 4) == s.lead_ticks && proto_get_u32(p + 8) == s.hold_ticks);
        } else if (type == PROTO_SHOT_TOGETHER) {
            memcpy(together + p[0], p + 1, (size_t)n - 1);
        } else if (type == PROTO_SHOT_CHANNELS) {
            assert_int_equal(p[0], n_channels);
            for (int k = 1; k < n; k += PROTO_CHANNEL_BYTES, n_channels++) {
                assert_int_equal(proto_get_u24(p + k), s.channel[n_channels].delay_ticks);
                assert_int_equal(p[k + 3], s.channel[n_channels].output);
            }
        } else {
            assert_true(type == PROTO_SHOT_COMMIT && n == PROTO_SHOT_COMMIT_BYTES && proto_get_u16(p) == 0xabcd && proto_get_u64(p + 2) == (uint64_t)s.at_ticks);
            assert_int_equal(n_channels, PROTO_CHANNELS_MAX);
        }
    }
    assert_int_equal(type, PROTO_SHOT_COMMIT);
    assert_memory_equal(together, s.together, sizeof(together));
}

static void more_lines_than_the_board_has_channels_are_refused(void **state)
{
    (void)state;
    static struct board_shot s;
    log_set_level(LOG_SILENT);
    assert_int_equal(plan(&s, PROTO_CHANNELS_MAX + 1, NULL, 0, 52), -EINVAL);
    log_set_level(LOG_INFO);
    assert_false(edges.pending); // and nothing is left of it
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(an_event_says_what_was_put_into_it),
        cmocka_unit_test(one_flipped_bit_is_never_taken_for_the_truth),
        cmocka_unit_test(presses_are_spaced_as_the_board_needs_and_stay_near_their_times),
        cmocka_unit_test(the_frames_carry_the_whole_shot),
        cmocka_unit_test(more_lines_than_the_board_has_channels_are_refused),
    };
    return cmocka_run_group_tests_name("board", tests, NULL, NULL);
}
