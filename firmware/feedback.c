// firmware/feedback.c - when the flash-sync contacts closed.
//
// A contact bounces and then stays closed for milliseconds: only its first closing in a shot counts. Inputs that are closed when
// sampling begins (a contact that sticks, a missing pull-up) say nothing and are left out.
#include "firmware/feedback.h"
#include "firmware/board.h"
#include "firmware/sequencer.h"

#include <string.h>

enum { CLOSINGS = 56, CAPTURES = 4 };

static struct {
    uint8_t n_registers;
    bool active_high, sampling, sampled;
    uint8_t input[FEEDBACK_REGISTERS]; // the last sample, where `sampled`
    uint32_t after_samples, left; // left: samples after the shot's end
    uint16_t run, sample, n_lost;
    uint64_t first;               // tick of sample 0
    uint8_t seen[FEEDBACK_REGISTERS];
    struct feedback_closing closing[CLOSINGS];
    uint8_t head, n;
    uint64_t capture[CAPTURES];
    uint8_t capture_head, n_captures;
    uint16_t n_captures_lost;
} f;

void feedback_configure(uint8_t n_registers, bool active_high, uint16_t after_ms)
{
    const uint8_t lock = board_lock();
    f.n_registers = n_registers;
    f.active_high = active_high;
    f.after_samples = (uint32_t)after_ms * BOARD_BEATS_PER_MS / 2;
    f.sampling = f.sampled = false;
    board_unlock(lock);
}

void feedback_start(void)
{
    const uint8_t lock = board_lock();
    memset(&f, 0, sizeof(f));
    board_unlock(lock);
}

static __attribute__((noinline)) void add(uint8_t input_register, uint8_t bits)
{
    if (f.n == CLOSINGS) {
        f.n_lost++;
        return;
    }
    uint8_t i = (uint8_t)(f.head + f.n);
    if (i >= CLOSINGS)
        i = (uint8_t)(i - CLOSINGS);
    f.closing[i] = (struct feedback_closing){ f.sample, input_register, bits };
    f.n++;
}

static void look(void)
{
    const uint8_t invert = f.active_high ? 0 : 0xFF, n = f.n_registers;
    if (f.sample == 0) {
        for (uint8_t r = 0; r < n; r++)
            f.seen[r] = f.input[r] ^ invert;
        return;
    }
    for (uint8_t r = 0; r < n; r++) {
        const uint8_t fresh = (f.input[r] ^ invert) & (uint8_t)~f.seen[r];
        if (!fresh)
            continue;
        f.seen[r] |= fresh;
        add(r, fresh);
    }
}

void feedback_beat(bool odd)
{
    uint16_t run;
    if (!odd) {
        if (f.sampled)
            look();
        f.sample += f.sampled || f.sample > 0; // the first must be one
        f.sampled = false;
        return;
    }
    const bool running = sequencer_sampling(&run);
    if (running && (!f.sampling || run != f.run)) {
        f.sampling = f.n_registers > 0;
        f.run = run;
        f.sample = 0;
        f.left = f.after_samples;
        f.n_lost = (uint16_t)(f.n_lost + f.n); // of the shot before: their samples counted from its begin
        f.n = 0;
    }
    if (!f.sampling)
        return;
    if (f.sample == FEEDBACK_SAMPLES_MAX || (!running && f.left-- == 0)) {
        f.sampling = false;
        return;
    }
    if (f.sample == 0)
        f.first = board_now();
    f.sampled = sequencer_sample(f.input, f.n_registers);
}

// A shot may begin at any time, and all that waits belong to it from then on.
bool feedback_peek(struct feedback_closing *out, uint64_t *tick)
{
    const uint8_t lock = board_lock();
    const bool has = f.n > 0;
    *out = f.closing[f.head];
    *tick = f.first + (uint32_t)out->sample * FEEDBACK_TICKS;
    board_unlock(lock);
    return has;
}

bool feedback_take(uint64_t tick, struct feedback_closing *out)
{
    const uint8_t lock = board_lock();
    *out = f.closing[f.head];
    const bool has = f.n > 0 && f.first + (uint32_t)out->sample * FEEDBACK_TICKS == tick;
    if (has) {
        f.n--;
        if (++f.head == CLOSINGS)
            f.head = 0;
    }
    board_unlock(lock);
    return has;
}

uint16_t feedback_take_lost(void)
{
    const uint8_t lock = board_lock();
    const uint16_t n = f.n_lost;
    f.n_lost = 0;
    board_unlock(lock);
    return n;
}

void feedback_capture(uint64_t at)
{
    if (f.n_captures == CAPTURES) {
        f.n_captures_lost++;
        return;
    }
    f.capture[(f.capture_head + f.n_captures) % CAPTURES] = at;
    f.n_captures++;
}

bool feedback_take_capture(uint64_t *at, uint16_t *n_lost)
{
    const uint8_t lock = board_lock();
    const bool has = f.n_captures > 0;
    if (has) {
        *at = f.capture[f.capture_head];
        f.capture_head = (uint8_t)((f.capture_head + 1) % CAPTURES);
        f.n_captures--;
        *n_lost = f.n_captures_lost;
        f.n_captures_lost = 0;
    }
    board_unlock(lock);
    return has;
}
