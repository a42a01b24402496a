// firmware/board_sim.h - the board on the host: a clock that the test turns by hand, and what is wired to it.
//
// Time passes in board_sim_run() only. An interrupt takes its time too (cost_...), so that what comes while another is at work comes
// late here as there; the latch does not: it is hardware. One board per process, like the firmware it carries.
#pragma once
#include "firmware/protocol.h"

struct board_sim {
    // Set by the test at any time.
    bool input[PROTO_INPUTS_MAX], home[PROTO_AXES]; // closed
    bool loop_hangs;
    bool deaf;                                      // the host does not read
    uint16_t cost_work, cost_beat;                  // ticks; board_sim_start() sets what the real board takes
    void (*on_outputs)(void *arg, uint64_t tick, const uint8_t outputs[PROTO_OUTPUTS_MAX / 8]); // what the wires show changed
    void (*on_step)(void *arg, uint64_t tick, uint8_t axis, bool positive);
    void *arg;
    // Seen.
    uint8_t outputs[PROTO_OUTPUTS_MAX / 8];
    uint64_t on_since[PROTO_OUTPUTS_MAX], longest_on[PROTO_OUTPUTS_MAX]; // on_since: tick + 1, 0: off. longest_on: of those that went off
    unsigned n_latches, n_watchdog;
    bool led;
};
extern struct board_sim board_sim;

void board_sim_start(uint64_t tick); // all of it anew, the clock at tick
void board_sim_run(uint64_t ticks);
uint64_t board_sim_now(void);
void board_sim_button(bool closed);
void board_sim_capture(bool closed);
void board_sim_unplug(void);
void board_sim_write(const uint8_t *bytes, size_t n);  // up to 4096 wait for the board; the oldest first
size_t board_sim_waiting(void);
uint8_t board_sim_read(uint8_t frame[PROTO_PACKET_BYTES]); // 0: nothing was sent
// A control request: bytes of the answer, or -1: stalled.
int board_sim_control(const uint8_t setup[8], uint8_t answer[PROTO_PACKET_BYTES]);
