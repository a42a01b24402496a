// tests/board/frames.h - the simplest host: commands, answers and events, over whatever carries bytes to a board.
#pragma once
#include "firmware/protocol.h"

struct frames_event {
    uint8_t type, n, sequence, payload[PROTO_PAYLOAD_MAX];
};

struct frames {
    // Given: packets to and from the board (out: false, not now; in: bytes, 0: none), and time.
    bool (*out)(void *arg, const uint8_t *bytes, size_t n);
    int (*in)(void *arg, uint8_t packet[PROTO_PACKET_BYTES]);
    void (*run)(void *arg, uint64_t ticks);
    void *arg;
    // Kept.
    uint8_t sequence;
    unsigned n_wrong; // frames from the board that are none: never, please
    int n_events;
    struct frames_event event[256]; // the oldest first; when full the oldest is lost
};

struct frames_shot {
    uint16_t shot;
    uint8_t flags;
    int n;                             // channels, any order
    uint32_t delay[PROTO_CHANNELS_MAX]; // ticks
    uint8_t output[PROTO_CHANNELS_MAX];
    uint32_t lead, hold;
    uint8_t together[PROTO_OUTPUTS_MAX / 8];
};

// enum proto_error, or -1: no answer within 200 ms. reply: what follows the error code; NULL allowed; else PROTO_PAYLOAD_MAX bytes.
int frames_command(struct frames *f, uint8_t type, const void *payload, size_t n, uint8_t *reply);
int frames_hello(struct frames *f);
struct frames_config {
    uint8_t n_registers, n_input_registers, flags;
    uint16_t debounce_ms, silence_ms, feedback_ms;
    int n_banks;
    struct {
        uint16_t first, n, max_on_ms;
    } bank[PROTO_BANKS_MAX];
};
int frames_configure(struct frames *f, const struct frames_config *c);
int frames_load(struct frames *f, const struct frames_shot *shot); // sorts; BEGIN, TOGETHER, CHANNELS: the first error
int frames_commit(struct frames *f, const struct frames_shot *shot, uint64_t when);
uint64_t frames_now(struct frames *f); // PING
bool frames_listen(struct frames *f, uint64_t ticks, uint8_t type, struct frames_event *out); // runs until such an event comes, at most ticks
bool frames_take(struct frames *f, uint8_t type, struct frames_event *out); // one that came already
void frames_run(struct frames *f, uint64_t ticks); // pinging every 50 ms, so that the session lives
