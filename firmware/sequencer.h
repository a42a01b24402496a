// firmware/sequencer.h - which output changes when: one shot of many edges, and single outputs, each bounded in time.
//
// There is one board, so there is one sequencer. Commands (sequencer_begin ... sequencer_release_all) come from the main loop,
// the rest from interrupts. Nothing here waits: a shot is prepared in pieces of a few dozen microseconds (sequencer_work), each
// followed by whatever else is due, and its edges are latched by the board's timer.
//
// Memory: a channel costs 4 bytes (its delay, its output), an output 1 byte (how long it has been on) and 3 bits (now, next,
// together): 200 channels on 416 outputs take 1,372 bytes.
#pragma once
#include "firmware/protocol.h"

enum {
    SEQUENCER_REGISTERS = PROTO_OUTPUTS_MAX / 8,
    SEQUENCER_LEAD_MIN_TICKS = 24000, // from COMMIT to T0: the time to prepare the largest first edge
    SEQUENCER_LATE_MAX_TICKS = 32000, // a press later than this is not done
};

struct sequencer_bank {
    uint16_t first, n, max_on_ms;
};

struct sequencer_fired { // the payload of PROTO_FIRED
    uint16_t shot;
    uint8_t result;      // enum proto_fired
    uint64_t tick;       // first channel's edge; 0: none came
    uint32_t late_ticks;
    uint16_t n_edges;
};

void sequencer_start(void); // after board_start(): everything released, outputs disabled, no bank

// All outputs off, then the outputs enabled. Refused while a shot is pending. enum proto_error.
uint8_t sequencer_configure(uint8_t n_registers, const struct sequencer_bank *bank, uint8_t n_banks);

uint8_t sequencer_begin(uint16_t shot, uint8_t flags, uint8_t n_channels, uint32_t lead, uint32_t hold);
uint8_t sequencer_together(uint8_t first_register, const uint8_t *bits, uint8_t n, uint16_t *wrong);
uint8_t sequencer_channels(uint8_t first_entry, const uint8_t *entries, uint8_t n, uint16_t *wrong);
// when: T0, or with PROTO_SHOT_ON_BUTTON the ticks from the press to T0.
uint8_t sequencer_commit(uint16_t shot, uint64_t when, uint16_t *wrong);
uint8_t sequencer_output(uint16_t output, bool on);

void sequencer_release_shot(void);
void sequencer_release_outputs(void); // those that sequencer_output() put on
// All outputs, at once; a shot ends PROTO_FIRED_RELEASED. enable: afterwards the outputs are enabled again (they are all off).
void sequencer_release_all(bool enable);

enum proto_shot_state sequencer_state(void);
uint16_t sequencer_shot(void);
bool sequencer_sampling(uint16_t *run); // inputs matter now; run changes with each shot
uint16_t sequencer_n_on(void);
uint16_t sequencer_n_guarded(void);
bool sequencer_is_enabled(void);
uint8_t sequencer_n_registers(void);
// True once per ended shot, and once per output that the guard cut: the event is the caller's now.
bool sequencer_take_fired(struct sequencer_fired *out);
bool sequencer_take_guarded(uint16_t *output, uint64_t *tick);
bool sequencer_has_fired(void);

// ---- from interrupts ----------------------------------------------------------------------------------------------------------
bool sequencer_button(uint64_t now); // a debounced press: true if it fires the committed shot
void sequencer_ms(uint8_t ms);       // each millisecond, counting: the guard
void sequencer_latched(void);        // the latch rose at its tick
void sequencer_work(void);
// Inputs by way of the output chain, when that cannot disturb an edge; false: not now.
bool sequencer_sample(uint8_t *inputs, uint8_t n);
