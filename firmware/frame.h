// firmware/frame.h - frames out of a stream of bytes that may be anything. See protocol.h for the format.
#pragma once
#include "firmware/protocol.h"

struct frame_reader {
    uint8_t n;
    uint8_t byte[PROTO_FRAME_MAX];
    uint32_t n_bad;   // times that bytes were skipped which might have been a frame
    uint16_t begun_ms; // by the caller's clock, when byte[0] came
};

// One byte more. True: byte[] holds a whole frame (payload at byte + PROTO_HEADER_BYTES, byte[2] long) until the next call.
bool frame_push(struct frame_reader *r, uint8_t byte, uint16_t now_ms);
// Gives up a frame that began PROTO_FRAME_GAP_MS ago.
void frame_idle(struct frame_reader *r, uint16_t now_ms);
