// firmware/frame.c - frames out of a stream of bytes.
//
// What looks like a frame and is none may hide the begin of a real one: it is searched again from its second byte on.
#include "firmware/frame.h"

#include <string.h>

enum verdict { MORE, WHOLE, WRONG };

static enum verdict judge(const struct frame_reader *r)
{
    if (r->n >= 1 && r->byte[0] != PROTO_SYNC_0)
        return WRONG;
    if (r->n >= 2 && r->byte[1] != PROTO_SYNC_1)
        return WRONG;
    if (r->n < 3)
        return MORE;
    const uint8_t n_payload = r->byte[2];
    if (n_payload > PROTO_PAYLOAD_MAX)
        return WRONG;
    const uint8_t n_checked = (uint8_t)(PROTO_HEADER_BYTES + n_payload);
    if (r->n < n_checked + PROTO_CRC_BYTES)
        return MORE;
    uint32_t crc = PROTO_CRC_START;
    for (uint8_t i = 2; i < n_checked; i++)
        crc = proto_crc_add(crc, r->byte[i]);
    return ~crc == proto_get_u32(r->byte + n_checked) ? WHOLE : WRONG;
}

// Forget the first i bytes, and all up to what may be a begin.
static void skip(struct frame_reader *r, uint8_t i)
{
    while (i < r->n && r->byte[i] != PROTO_SYNC_0)
        i++;
    r->n = (uint8_t)(r->n - i);
    memmove(r->byte, r->byte + i, r->n);
}

bool frame_next(struct frame_reader *r, uint16_t now_ms)
{
    if (r->n_given > 0) {
        skip(r, r->n_given);
        r->n_given = 0;
        r->begun_ms = now_ms;
    }
    while (r->n > 0) {
        switch (judge(r)) {
        case MORE:
            return false;
        case WHOLE:
            r->n_given = (uint8_t)(r->byte[2] + PROTO_HEADER_BYTES + PROTO_CRC_BYTES);
            return true;
        case WRONG:
            if (r->n > 1) // a lone 0xA5 is nothing yet
                r->n_bad++;
            skip(r, 1);
            r->begun_ms = now_ms;
            break;
        }
    }
    return false;
}

void frame_push(struct frame_reader *r, uint8_t byte, uint16_t now_ms)
{
    if (r->n == 0) {
        r->begun_ms = now_ms;
        if (byte != PROTO_SYNC_0)
            return;
    }
    r->byte[r->n++] = byte;
}

void frame_idle(struct frame_reader *r, uint16_t now_ms)
{
    if (r->n == 0 || r->n_given > 0 || (uint16_t)(now_ms - r->begun_ms) < PROTO_FRAME_GAP_MS || judge(r) != MORE)
        return;
    r->n_bad++;
    skip(r, 1); // what began within it may be whole
    r->begun_ms = now_ms;
}
