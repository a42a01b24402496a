// firmware/session.h - what the host asks is done and answered, what happens is told, and without a host nothing stays on.
//
// The main loop calls session_run() again and again; the board calls the rest from its interrupts.
#pragma once
#include "firmware/protocol.h"

void session_start(void); // after the board's own start
void session_run(void);   // never waits
void session_status(uint8_t status[PROTO_STATUS_BYTES]);
void session_capabilities(uint8_t capabilities[PROTO_CAPABILITIES_BYTES]);
void session_release_everything(void); // PROTO_RELEASE_ALL, main loop
void session_identify(uint16_t ms);

// From interrupts.
void session_beat(void);                // each BOARD_TICKS_PER_BEAT
void session_button_edge(uint64_t now); // any edge of the button's pin
void session_capture(uint64_t at);      // the chosen edge of the capture pin
void session_link_lost(void);           // USB reset, suspend, unplugged
