// rigd/board.h - the trigger board's language (firmware/protocol.h) as rigd speaks it: what it says, decoded; a shot, encoded.
//
// Pure: no USB, thread or clock. What the board says is checked like anything from outside: a board may be another device that
// answers to our numbers, or ours with another firmware.
#pragma once
#include "firmware/protocol.h"
#include "rigd/edges.h"

enum { BOARD_INPUTS_PER_FRAME = (PROTO_PAYLOAD_MAX - 8) / 2 * 8, BOARD_STOP_MS = 200 };

struct board_said {
    uint8_t type, sequence; // PROTO_REPLY | command, or an enum proto_event
    union {
        struct {
            uint8_t error; // enum proto_error
            uint8_t n, bytes[PROTO_PAYLOAD_MAX]; // what follows it
        } reply;
        struct {
            uint16_t shot, n_edges, n_lost;
            uint8_t how; // enum proto_fired
            int64_t first_ticks, late_ticks;
        } fired;
        struct { int64_t ticks; bool down, fires; } button;
        struct { int64_t ticks; uint16_t n_lost; } capture;
        struct { int64_t ticks; int n; uint16_t input[BOARD_INPUTS_PER_FRAME]; } inputs;
        struct { uint8_t fault; uint16_t what; } fault;
        struct { uint8_t how, homed; int32_t yaw, pitch; } head;
    };
};

// One packet. 0, or -EPROTO with what is wrong in why (a phrase that continues "the board's answer ...").
int board_decode(struct board_said *out, const uint8_t *bytes, size_t n, const char **why);
// Of GET_CAPABILITIES, or of HELLO's reply. -EPROTO (too short, or figures that cannot be), -ENOTSUP (another version; *why says who is the older).
int board_capabilities(struct proto_capabilities *out, const uint8_t *bytes, size_t n, const char **why);
const char *board_error_text(uint8_t proto_error); // "an output would be on for too long"

// A shot as the board takes it. Ticks of its clock.
struct board_shot {
    int64_t at_ticks;        // T0
    uint32_t lead_ticks, hold_ticks;
    int n_channels;
    struct { uint32_t delay_ticks; uint16_t output; } channel[PROTO_CHANNELS_MAX]; // delays never fall
    uint8_t together[PROTO_OUTPUTS_MAX / 8]; // half-press
    int n_together;          // registers up to the last that has one
    int64_t first_ns;        // when the first full-press is due, and the last release
    int64_t end_ns;
};

// The wires that edges_plan() has given times; ticks_of relates them to the board. Edges of different delays that are closer than the board can
// shift are moved by at most half of that: together, or apart. edges forgets the shot (the board keeps it). 0; -EINVAL (logged).
int board_shot_plan(struct board_shot *out, struct edges *edges, const struct proto_capabilities *board, int n_registers,
    int64_t (*ticks_of)(const void *arg, int64_t ns), const void *arg);
// Frame number i of its upload (SHOT_BEGIN, TOGETHER, CHANNELS ...; COMMIT last): type and payload. Length of the payload, -1: there are no more.
int board_shot_frame(const struct board_shot *s, int i, uint16_t shot, bool on_button, uint8_t *type, uint8_t *payload);
