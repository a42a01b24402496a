// tests/fuzz/fuzz_firmware.c - hostile hosts: whatever is written to the trigger board's logic, no output stays on beyond its time.
//
// Input: a list of actions. One byte each: 0 to 15 a frame made well around the bytes that follow (type, length, payload), 16 to 23 raw
// bytes, 24 to 27 a control request, 28 the button, 29 the capture pin, 30 unplugged, 31 the loop hangs; above: time passes.
#include "firmware/board_sim.h"

#include <stdlib.h>
#include <string.h>

enum { MS = 16000, MAX_ON_MS = 16000 };

static const uint8_t *next;
static size_t left;
static uint8_t sequence;

static uint8_t take(void)
{
    if (left == 0)
        return 0;
    left--;
    return *next++;
}

static void run(uint64_t ticks)
{
    uint8_t p[PROTO_PACKET_BYTES];
    board_sim_run(ticks);
    if (board_sim_read(p) && p[4] < PROTO_EVENT && p[5] == PROTO_ERR_SEQUENCE)
        sequence = p[6];
    for (int i = 0; i < PROTO_OUTPUTS_MAX; i++)
        if (board_sim.longest_on[i] > (uint64_t)MAX_ON_MS * MS ||
            (board_sim.on_since[i] && board_sim_now() + 1 - board_sim.on_since[i] > (uint64_t)MAX_ON_MS * MS))
            abort();
}

static void send_frame(uint8_t type, const uint8_t *payload, uint8_t n)
{
    uint8_t frame[PROTO_FRAME_MAX];
    memcpy(frame + PROTO_HEADER_BYTES, payload, n);
    if (board_sim_waiting() < 1000)
        board_sim_write(frame, proto_seal(frame, type, sequence++, n));
}

static void act(uint8_t action)
{
    static const uint8_t types[16] = { PROTO_HELLO, PROTO_PING, PROTO_CONFIGURE, PROTO_STATUS, PROTO_SHOT_BEGIN, PROTO_SHOT_TOGETHER, PROTO_SHOT_CHANNELS,
        PROTO_SHOT_COMMIT, PROTO_RELEASE, PROTO_OUTPUT, PROTO_IDENTIFY, PROTO_HEAD_CONFIGURE, PROTO_HEAD_MOVE, PROTO_HEAD_HOME, PROTO_HEAD_STOP, 0x3F };
    uint8_t bytes[PROTO_PACKET_BYTES];
    if (action < 16) {
        const uint8_t n = take() % (PROTO_PAYLOAD_MAX + 1);
        for (uint8_t i = 0; i < n; i++)
            bytes[i] = take();
        if (action == 7 && n == PROTO_SHOT_COMMIT_BYTES && !(bytes[9] & 1)) // else the right time is never guessed
            proto_put_u64(bytes + 2, board_sim_now() + 30000 + proto_get_u24(bytes + 2));
        send_frame(types[action], bytes, n);
    } else if (action < 24) {
        const uint8_t n = take() % PROTO_PACKET_BYTES;
        for (uint8_t i = 0; i < n; i++)
            bytes[i] = take();
        if (board_sim_waiting() < 1000)
            board_sim_write(bytes, n);
    } else if (action < 28) {
        for (int i = 0; i < 8; i++)
            bytes[i] = take();
        uint8_t setup[8];
        memcpy(setup, bytes, 8);
        board_sim_control(setup, bytes);
    } else if (action == 28) {
        board_sim_button(take() & 1);
    } else if (action == 29) {
        board_sim_capture(take() & 1);
    } else if (action == 30) {
        board_sim_unplug();
    } else if (action == 31) {
        board_sim.loop_hangs = true;
    }
}

static bool is_over(void) // nothing is on, no shot is to come
{
    uint8_t status[PROTO_PACKET_BYTES];
    for (size_t r = 0; r < sizeof(board_sim.outputs); r++)
        if (board_sim.outputs[r])
            return false;
    board_sim_control((const uint8_t[]){ 0xC0, PROTO_GET_STATUS, 0, 0, 0, 0, PROTO_STATUS_BYTES, 0 }, status);
    return status[0] < PROTO_SHOT_ARMED;
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    if (n > 4096)
        return 0;
    board_sim_start(n % 2 ? UINT32_MAX - 100000 : 0);
    sequence = 0;
    next = bytes;
    left = n;
    uint64_t budget = 1000 * (uint64_t)MS;
    while (left > 0) {
        const uint8_t action = take();
        act(action);
        const uint64_t ticks = action < 32 ? 2500 : (uint64_t)(action - 31) * (action - 31) * 320; // up to a second
        if (ticks > budget)
            break;
        budget -= ticks;
        run(ticks);
    }
    for (int i = 0; i < 110 && !is_over(); i++) // the longest silence
        run(100 * MS);
    if (!is_over())
        abort();
    return 0;
}
