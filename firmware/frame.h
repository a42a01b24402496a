// firmware/frame.h - frames out of a stream of bytes that may be anything. See protocol.h for the format.
#pragma once
#include "firmware/protocol.h"

struct frame_reader {
    uint8_t n, n_given; // n_given: of the frame at byte[0] that was given out last; 0: none
    uint8_t byte[PROTO_FRAME_MAX];
    uint32_t n_bad;   // times that bytes were skipped which might have been a frame
    uint16_t begun_ms; // by the caller's clock, when byte[0] came
};

// True: byte[] holds a whole frame (payload at byte + PROTO_HEADER_BYTES, byte[2] long) until the next call.
bool frame_next(struct frame_reader *r, uint16_t now_ms);
// One byte more. Only after frame_next() was false: what failed may have hidden more than one frame.
void frame_push(struct frame_reader *r, uint8_t byte, uint16_t now_ms);
// Gives up a frame that began PROTO_FRAME_GAP_MS ago, and what cannot be the begin of another; frame_next() tells if one was in it.
void frame_idle(struct frame_reader *r, uint16_t now_ms);
