// firmware/feedback.c - when the flash-sync contacts closed.
//
// A contact bounces and then stays closed for milliseconds: only its first closing in a shot counts. Inputs that are closed when
// sampling begins (a contact that sticks, a missing pull-up) say nothing and are left out.
#include "firmware/feedback.h"
#include "firmware/board.h"
#include "firmware/sequencer.h"

#include <string.h>

enum { CLOSINGS = 48, CAPTURES = 4 }; // powers of two are not needed: indices wrap by hand

static struct {
    uint8_t n_registers;
    bool active_high, sampling, sampled, odd;
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

static void add(uint8_t input_register, uint8_t bits)
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
    const uint8_t invert = f.active_high ? 0 : 0xFF, old = f.sample == 0 ? 0xFF : 0;
    uint8_t *seen = f.seen;
    const uint8_t *input = f.input;
    for (uint8_t r = 0; r < f.n_registers; r++) {
        const uint8_t closed = *input++ ^ invert, fresh = closed & (uint8_t)~(*seen | old);
        if (old)
            *seen = 0;
        *seen++ |= closed;
        if (fresh)
            add(r, fresh);
    }
}

void feedback_beat(void)
{
    uint16_t run;
    if (f.sampled) { // in the beat between two samples
        f.sampled = false;
        look();
        f.sample++;
        return;
    }
    const bool running = sequencer_sampling(&run);
    if (running && (!f.sampling || run != f.run)) {
        f.sampling = f.n_registers > 0;
        f.run = run;
        f.sample = 0;
        f.left = f.after_samples;
        f.odd = false;
    }
    if (!f.sampling)
        return;
    f.odd = !f.odd;
    if (!f.odd) { // a sample was due in the beat before, but there was no room for it
        f.sample += f.sample > 0;
        return;
    }
    if (f.sample == FEEDBACK_SAMPLES_MAX || (!running && f.left-- == 0)) {
        f.sampling = false;
        return;
    }
    if (f.sample == 0)
        f.first = board_now();
    f.sampled = sequencer_sample(f.input, f.n_registers);
    if (f.sampled)
        f.odd = false;
}

bool feedback_peek(struct feedback_closing *out, uint64_t *at)
{
    const uint8_t lock = board_lock();
    const bool has = f.n > 0;
    *out = f.closing[f.head];
    *at = f.first + (uint32_t)out->sample * FEEDBACK_TICKS;
    board_unlock(lock);
    return has;
}

void feedback_drop(void)
{
    const uint8_t lock = board_lock();
    if (f.n > 0) {
        f.n--;
        if (++f.head == CLOSINGS)
            f.head = 0;
    }
    board_unlock(lock);
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
