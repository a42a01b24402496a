// tests/board/simavr_board.h - the trigger board, simulated: the real image in simavr, shift registers, switches, and a USB host.
//
// Virtual time moves only in simavr_board_run() and while a transfer waits for the board; a cycle is 62.5 ns. Same calls, same cycles.
// What simavr 1.6 gets wrong and this repairs is listed in simavr_board.c. One thread at a time per board.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { SIMAVR_REGISTERS = 52, SIMAVR_INPUT_REGISTERS = 25, SIMAVR_HZ = 16000000 };

struct simavr_board;

struct simavr_board_watch { // NULL: not interested
    // What drives the optocouplers changed: outputs[8 r + b / 8] as protocol.h counts. cycle: of the latch edge (or the enable line).
    void (*outputs)(void *arg, uint64_t cycle, const uint8_t outputs[SIMAVR_REGISTERS]);
    void (*step)(void *arg, uint64_t cycle, int axis, bool positive);
    void *arg;
};

// NULL: the image cannot be read (said on stderr). watch is copied.
struct simavr_board *simavr_board_open(const char *elf, const struct simavr_board_watch *watch);
void simavr_board_close(struct simavr_board *b);
void simavr_board_fit(struct simavr_board *b, int n_registers); // output registers there are; 52 unless said otherwise

void simavr_board_run(struct simavr_board *b, uint64_t n_cycles);
uint64_t simavr_board_cycle(const struct simavr_board *b);
uint64_t simavr_board_cycle_of(const struct simavr_board *b, uint64_t tick); // of the board's clock
bool simavr_board_is_dead(const struct simavr_board *b);                     // the core crashed: never, please
bool simavr_board_is_attached(const struct simavr_board *b);                 // its pull-up is on: the host may enumerate
const uint8_t *simavr_board_outputs(const struct simavr_board *b);           // SIMAVR_REGISTERS bytes
bool simavr_board_led(const struct simavr_board *b);

// ---- what a hand does ----------------------------------------------------------------------------------------------------------------
void simavr_board_button(struct simavr_board *b, bool pressed);  // closes to ground
void simavr_board_capture(struct simavr_board *b, bool closed);  // likewise
void simavr_board_input(struct simavr_board *b, int input, bool closed);
void simavr_board_home(struct simavr_board *b, int axis, bool closed);
enum simavr_cause { SIMAVR_POWER, SIMAVR_PIN, SIMAVR_BROWN_OUT };
void simavr_board_reset(struct simavr_board *b, enum simavr_cause cause); // held for no time; the host sees it leave the bus
void simavr_board_hang(struct simavr_board *b);                           // the main loop stands still, where it is now
unsigned simavr_board_killed(const struct simavr_board *b);               // packets that the chip would have thrown away unsent
unsigned simavr_board_resets(const struct simavr_board *b);               // also by the watchdog

// ---- the USB host --------------------------------------------------------------------------------------------------------------------
void simavr_board_bus_reset(struct simavr_board *b);
void simavr_board_suspend(struct simavr_board *b); // also what unplugging looks like from the board's side
// A control transfer, data stage into or out of data (n = wLength). Bytes moved, -EPIPE (stalled), -ETIMEDOUT (50 ms).
int simavr_board_control(struct simavr_board *b, const uint8_t setup[8], uint8_t *data, size_t n);
int simavr_board_out(struct simavr_board *b, int endpoint, const uint8_t *data, size_t n); // n <= 64; 0, -EAGAIN (NAK), -EPIPE
int simavr_board_in(struct simavr_board *b, int endpoint, uint8_t data[64]);               // bytes, -EAGAIN (NAK), -EPIPE
// Reset, address, configuration 1. 0, or as simavr_board_control().
int simavr_board_enumerate(struct simavr_board *b);

// ---- measurement ----------------------------------------------------------------------------------------------------------------------
// The longest time from an interrupt's request to its begin, by vector number, since the start or the last clearing. 0: never ran.
enum { SIMAVR_VECTORS = 43 };
const uint32_t *simavr_board_duration(const struct simavr_board *b); // likewise, of the interrupt itself
void simavr_board_clear_latency(struct simavr_board *b);
const uint32_t *simavr_board_latency(const struct simavr_board *b);
// The least time that an edge that presses was armed before it came, since the start or the last clearing: what the firmware has left.
uint32_t simavr_board_margin(const struct simavr_board *b);
const char *simavr_board_vector_name(int vector);
