// firmware/board_sim.c - the board on the host.
//
// One event after the other: the earliest of beat, latch, work and head comes next, then the loop runs once.
#include "firmware/board_sim.h"
#include "firmware/board.h"
#include "firmware/head.h"
#include "firmware/sequencer.h"
#include "firmware/session.h"
#include "firmware/usb.h"

#include <assert.h>
#include <string.h>

enum { NEAR_TICKS = 120, SOON_TICKS = 64, WATCHDOG_MS = 120, QUEUE = 4096 };
#define NEVER UINT64_MAX

struct board_sim board_sim;

static struct {
    uint64_t now, beat, latch, work, head, fed; // when each is due; fed: the watchdog
    bool latch_risen, enabled, direction[PROTO_AXES], button_high, capture_rising, capture_high;
    int locks;
    uint8_t chain[PROTO_OUTPUTS_MAX / 8], latched[PROTO_OUTPUTS_MAX / 8];
    uint8_t queue[QUEUE];
    size_t first, n;
    uint8_t sent[PROTO_PACKET_BYTES], n_sent;
    uint8_t control[PROTO_PACKET_BYTES], n_control;
    uint8_t reset_cause;
} b;

static void show(void)
{
    static const uint8_t none[sizeof(b.latched)];
    const uint8_t *is = b.enabled ? b.latched : none;
    if (!memcmp(is, board_sim.outputs, sizeof(board_sim.outputs)))
        return;
    for (int i = 0; i < PROTO_OUTPUTS_MAX; i++) {
        const bool on = is[i / 8] >> i % 8 & 1;
        if (on && !board_sim.on_since[i])
            board_sim.on_since[i] = b.now + 1;
        if (!on && board_sim.on_since[i]) {
            const uint64_t was_on = b.now + 1 - board_sim.on_since[i];
            if (was_on > board_sim.longest_on[i])
                board_sim.longest_on[i] = was_on;
            board_sim.on_since[i] = 0;
        }
    }
    memcpy(board_sim.outputs, is, sizeof(board_sim.outputs));
    if (board_sim.on_outputs)
        board_sim.on_outputs(board_sim.arg, b.now, board_sim.outputs);
}

static void rise(void)
{
    board_sim.n_latches++;
    memcpy(b.latched, b.chain, sizeof(b.latched));
    show();
}

static void advance(uint64_t to) // the hardware goes on while the processor is busy
{
    if (b.latch <= to) {
        b.now = b.latch;
        b.latch = NEVER;
        b.latch_risen = true;
        rise();
    }
    b.now = to;
}

// ---- board.h ----------------------------------------------------------------------------------------------------------------------------
void board_start(void)
{
}

void board_run(void)
{
}

void board_poll(void)
{
    b.fed = b.now;
}

uint64_t board_now(void)
{
    return b.now;
}

uint32_t board_now_low(void)
{
    return (uint32_t)b.now;
}

uint8_t board_lock(void)
{
    return (uint8_t)b.locks++;
}

void board_unlock(uint8_t lock)
{
    b.locks--;
    assert(lock == (uint8_t)b.locks);
}

static void push(uint8_t byte)
{
    memmove(b.chain + 1, b.chain, sizeof(b.chain) - 1);
    b.chain[0] = byte;
}

void board_shift(const uint8_t *registers, uint8_t n)
{
    while (n-- > 0)
        push(registers[n]);
}

void board_latch(void)
{
    rise();
}

bool board_latch_at(uint32_t tick_low)
{
    const int32_t ahead = (int32_t)(tick_low - (uint32_t)b.now);
    if (ahead < NEAR_TICKS)
        return false;
    assert(b.work == NEVER);
    b.latch = b.now + (uint32_t)ahead;
    b.latch_risen = false;
    return true;
}

bool board_latch_cancel(void)
{
    if (b.latch == NEVER)
        return false;
    b.latch = NEVER;
    return true;
}

void board_work_soon(void)
{
    assert(b.latch == NEVER); // one compare register does both
    b.work = b.now + SOON_TICKS;
}

void board_enable(bool on)
{
    b.enabled = on;
    show();
}

void board_sample(uint8_t *inputs, uint8_t n_inputs, const uint8_t *outputs, uint8_t n_outputs)
{
    assert(n_inputs <= PROTO_INPUTS_MAX / 8 && n_outputs <= sizeof(b.chain));
    for (uint8_t r = 0; r < n_inputs; r++) {
        inputs[r] = 0xFF;
        for (int i = 0; i < 8; i++)
            if (board_sim.input[8 * r + i])
                inputs[r] &= (uint8_t)~(1 << i);
    }
    for (uint8_t n = n_outputs; n < n_inputs; n++)
        push(0);
    board_shift(outputs, n_outputs);
}

bool board_button_high(void)
{
    return b.button_high;
}

void board_capture_edge(bool rising)
{
    b.capture_rising = rising;
}

void board_head_run(bool on)
{
    b.head = on ? b.now + BOARD_TICKS_PER_S / BOARD_HEAD_HZ : NEVER;
}

void board_head_direction(uint8_t axis, bool positive)
{
    b.direction[axis] = positive;
}

void board_head_step(uint8_t axis)
{
    if (board_sim.on_step)
        board_sim.on_step(board_sim.arg, b.now, axis, b.direction[axis]);
}

bool board_home_high(uint8_t axis)
{
    return !board_sim.home[axis];
}

bool board_receive(uint8_t *byte)
{
    if (b.n == 0)
        return false;
    *byte = b.queue[b.first];
    b.first = (b.first + 1) % QUEUE;
    b.n--;
    return true;
}

bool board_can_send(void)
{
    return b.n_sent == 0;
}

void board_send(const uint8_t *frame, uint8_t n)
{
    assert(b.n_sent == 0 && n > 0 && n < PROTO_PACKET_BYTES);
    memcpy(b.sent, frame, n);
    b.n_sent = n;
}

void board_control_put(uint8_t byte)
{
    assert(b.n_control < PROTO_PACKET_BYTES - 1);
    b.control[b.n_control++] = byte;
}

uint8_t board_serial(uint8_t i)
{
    assert(i < 10);
    return (uint8_t)(0x51 + i);
}

void board_led(bool on)
{
    board_sim.led = on;
}

uint8_t board_reset_cause(void)
{
    return b.reset_cause;
}

uint16_t board_unused_ram(void)
{
    return UINT16_MAX;
}

// ---- board_sim.h --------------------------------------------------------------------------------------------------------------------------
static void boot(uint8_t cause)
{
    board_enable(false);
    b.latch = b.work = b.head = NEVER;
    b.latch_risen = false;
    b.reset_cause = cause;
    b.fed = b.now;
    b.beat = b.now + BOARD_TICKS_PER_BEAT;
    b.n_sent = 0;
    usb_reset();
    session_start();
}

void board_sim_start(uint64_t tick)
{
    memset(&board_sim, 0, sizeof(board_sim));
    memset(&b, 0, sizeof(b));
    board_sim.cost_work = 700;
    board_sim.cost_beat = 300;
    b.now = tick;
    b.button_high = b.capture_high = true;
    boot(PROTO_RESET_POWER);
}

static uint64_t earliest(void)
{
    uint64_t t = b.beat;
    if (b.latch_risen)
        return b.now;
    if (b.latch < t)
        t = b.latch;
    if (b.work < t)
        t = b.work;
    if (b.head < t)
        t = b.head;
    return t < b.now ? b.now : t;
}

static void interrupt(void)
{
    if (b.latch_risen) {
        b.latch_risen = false;
        sequencer_latched();
    } else if (b.work <= b.now) {
        b.work = NEVER;
        advance(b.now + board_sim.cost_work); // it asks for more when it has done its piece: others come in between
        sequencer_work();
    } else if (b.beat <= b.now) {
        b.beat += BOARD_TICKS_PER_BEAT;
        session_beat();
        advance(b.now + board_sim.cost_beat);
    } else if (b.head <= b.now) {
        b.head += BOARD_TICKS_PER_S / BOARD_HEAD_HZ;
        head_beat();
    }
    assert(b.locks == 0);
}

void board_sim_run(uint64_t ticks)
{
    const uint64_t end = b.now + ticks;
    for (uint64_t t; (t = earliest()) <= end;) {
        advance(t);
        interrupt();
        if (!board_sim.loop_hangs) {
            board_poll();
            session_run();
        } else if (b.now - b.fed > (uint64_t)WATCHDOG_MS * BOARD_TICKS_PER_MS) {
            board_sim.n_watchdog++;
            board_sim.loop_hangs = false;
            boot(PROTO_RESET_WATCHDOG);
        }
    }
    if (b.now < end)
        advance(end);
}

uint64_t board_sim_now(void)
{
    return b.now;
}

void board_sim_button(bool closed)
{
    if (b.button_high != closed)
        return;
    b.button_high = !closed;
    session_button_edge(b.now);
}

void board_sim_capture(bool closed)
{
    if (b.capture_high != closed)
        return;
    b.capture_high = !closed;
    if (b.capture_high == b.capture_rising)
        session_capture(b.now);
}

void board_sim_unplug(void)
{
    session_link_lost();
}

void board_sim_write(const uint8_t *bytes, size_t n)
{
    assert(n <= QUEUE - b.n);
    for (size_t i = 0; i < n; i++)
        b.queue[(b.first + b.n++) % QUEUE] = bytes[i];
}

size_t board_sim_waiting(void)
{
    return b.n;
}

uint8_t board_sim_read(uint8_t frame[PROTO_PACKET_BYTES])
{
    const uint8_t n = b.n_sent;
    if (board_sim.deaf)
        return 0;
    memcpy(frame, b.sent, n);
    b.n_sent = 0;
    return n;
}

int board_sim_control(const uint8_t setup[8], uint8_t answer[PROTO_PACKET_BYTES])
{
    b.n_control = 0;
    const enum usb_answer a = usb_setup(setup, b.now);
    memcpy(answer, b.control, b.n_control);
    return a == USB_STALL ? -1 : b.n_control;
}
