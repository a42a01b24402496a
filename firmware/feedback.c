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
    bool active_high, sampling;
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
    f.after_samples = (uint32_t)after_ms * BOARD_BEATS_PER_MS;
    f.sampling = false;
    board_unlock(lock);
}

void feedback_start(void)
{
    const uint8_t lock = board_lock();
    memset(&f, 0, sizeof(f));
    board_unlock(lock);
}

void feedback_beat(void)
{
    uint16_t run;
    const bool running = sequencer_sampling(&run);
    if (running && (!f.sampling || run != f.run)) {
        f.sampling = f.n_registers > 0;
        f.run = run;
        f.sample = 0;
        f.first = board_now();
        f.left = f.after_samples;
    }
    if (!f.sampling)
        return;
    if (f.sample == FEEDBACK_SAMPLES_MAX || (!running && f.left-- == 0)) {
        f.sampling = false;
        return;
    }
    uint8_t input[FEEDBACK_REGISTERS];
    if (sequencer_sample(input, f.n_registers))
        for (uint8_t r = 0; r < f.n_registers; r++) {
            const uint8_t closed = f.active_high ? input[r] : (uint8_t)~input[r];
            const uint8_t fresh = f.sample == 0 ? 0 : closed & (uint8_t)~f.seen[r];
            f.seen[r] = f.sample == 0 ? closed : f.seen[r] | closed;
            if (!fresh)
                continue;
            if (f.n == CLOSINGS) {
                f.n_lost++;
                continue;
            }
            uint8_t i = (uint8_t)(f.head + f.n);
            if (i >= CLOSINGS)
                i = (uint8_t)(i - CLOSINGS);
            f.closing[i] = (struct feedback_closing){ f.sample, r, fresh };
            f.n++;
        }
    else if (f.sample == 0)
        return; // the first sample must be one
    f.sample++;
}

bool feedback_peek(struct feedback_closing *out, uint64_t *at)
{
    const uint8_t lock = board_lock();
    const bool has = f.n > 0;
    *out = f.closing[f.head];
    *at = f.first + (uint32_t)out->sample * BOARD_TICKS_PER_BEAT;
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
