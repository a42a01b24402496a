// firmware/board.h - the board as the logic sees it. One board_*.c per target implements it, chosen when linking.
//
// The clock counts BOARD_TICKS_PER_S from 0 at the start and never wraps in 64 bits; its low 32 bits wrap every 268 s, and times
// less than 134 s apart are ordered by board_is_before(). "Interrupt" below: in interrupt context, never nested.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    BOARD_TICKS_PER_MS = 16000,
    BOARD_TICKS_PER_BEAT = 2000, // session_beat() is called so often: 125 us
    BOARD_BEATS_PER_MS = 8,
    BOARD_HEAD_HZ = 8000,        // head_beat(): two axes in one beat take up to 1,200 ticks
    // The least time between two latch edges, found by measuring what lies between (tests/test_firmware_avr.c holds them to it).
    BOARD_GAP_BASE = 4400,
    BOARD_GAP_REGISTER = 50,
    BOARD_GAP_CHANNEL = 72,
};
#define BOARD_TICKS_PER_S UINT32_C(16000000)

static inline bool board_is_before(uint32_t a, uint32_t b)
{
    return (int32_t)(a - b) < 0;
}

// ---- the loop: board_start(), session_start(), board_run(), then for ever board_poll(), session_run() ----------------------------
void board_start(void); // pins safe, clock running, no interrupt yet
void board_run(void);   // interrupts on, on the bus
void board_poll(void);  // sleeps until something happens, answers control requests, tells the watchdog that the loop goes on

// ---- clock, interrupts ------------------------------------------------------------------------------------------------------
uint64_t board_now(void); // anywhere
uint32_t board_now_low(void);
uint8_t board_lock(void); // no interrupt until board_unlock() with what this returned; may nest
void board_unlock(uint8_t lock);

// ---- the output chain: shift registers with one common latch, and an enable line that is off unless driven ---------------------
// All with interrupts locked or in an interrupt. What is shifted is not seen until the latch.
void board_shift(const uint8_t *registers, uint8_t n); // the last first: registers[n - 1] goes out first, and ends up farthest
void board_latch(void);                                // now
// The latch rises at that tick by itself, then sequencer_latched() is called. False: too near or past; nothing will happen.
bool board_latch_at(uint32_t tick_low);
bool board_latch_cancel(void); // false: it has risen already, sequencer_latched() will come (or nothing was planned)
void board_work_soon(void);    // sequencer_work() is called in an interrupt of its own, as soon as others have had their turn
void board_enable(bool on);    // off: all outputs are released whatever the registers hold; at once

// ---- inputs -------------------------------------------------------------------------------------------------------------------
// Load the input chain and shift it in: inputs[0] is next to the board. What is in the output chain's registers (not its latches)
// is replaced by outputs on the way. Locked or in an interrupt.
void board_sample(uint8_t *inputs, uint8_t n_inputs, const uint8_t *outputs, uint8_t n_outputs);
bool board_button_high(void);
void board_capture_edge(bool rising); // which edge session_capture() is told of

// ---- panorama head ------------------------------------------------------------------------------------------------------------
void board_head_run(bool on);               // call head_beat() BOARD_HEAD_HZ times a second; off: and let the motors go on holding
void board_head_direction(uint8_t axis, bool positive);
void board_head_step(uint8_t axis);         // one pulse
bool board_home_high(uint8_t axis);

// ---- the link: bytes of the bulk endpoints; main loop only ----------------------------------------------------------------------
bool board_receive(uint8_t *byte);                    // false: none now
bool board_can_send(void);
void board_send(const uint8_t *frame, uint8_t n);     // only after board_can_send(); one packet
void board_control_put(uint8_t byte);                 // usb_setup()'s answer, at most 63 bytes
uint8_t board_serial(uint8_t i);                      // of 10

// ---- rest -----------------------------------------------------------------------------------------------------------------------
void board_led(bool on);
uint8_t board_reset_cause(void);    // PROTO_RESET_...
uint16_t board_unused_ram(void);    // bytes never written by the stack

// Constant data that must not cost RAM.
#ifdef __AVR__
#include <avr/pgmspace.h>
#define BOARD_ROM PROGMEM
#define board_rom(p) pgm_read_byte(p)
#else
#define BOARD_ROM
#define board_rom(p) (*(p))
#endif
