// firmware/feedback.h - when the flash-sync contacts closed: first closings of sampled inputs, and the stamps of one captured pin.
//
// Written in interrupts, read in the main loop. What the host does not read in time is counted, not kept.
#pragma once
#include "firmware/protocol.h"

enum {
    FEEDBACK_REGISTERS = PROTO_INPUTS_MAX / 8,
    FEEDBACK_TICKS = 4000,        // two beats: one shifts a sample in, the next looks at it, so that neither interrupt is long
    FEEDBACK_SAMPLES_MAX = 32000, // 8 s
};

struct feedback_closing {
    uint16_t sample; // since the first
    uint8_t input_register, bits;
};

void feedback_configure(uint8_t n_registers, bool active_high, uint16_t after_ms);
void feedback_start(void); // forget everything
// Main loop. False: none.
bool feedback_peek(struct feedback_closing *out, uint64_t *tick);
bool feedback_take(uint64_t tick, struct feedback_closing *out); // the next, if it is of that tick
uint16_t feedback_take_lost(void);
bool feedback_take_capture(uint64_t *at, uint16_t *n_lost);

// From interrupts.
void feedback_beat(bool odd); // each 125 us: samples in the odd ones, looks at the sample in the others
void feedback_capture(uint64_t at);
