// tests/board/frames.c - the simplest host.
#include "tests/board/frames.h"

#include <stdlib.h>
#include <string.h>

enum { POLL_TICKS = 800, ANSWER_TICKS = 200 * 16000, PING_TICKS = 50 * 16000 };

// One packet, if there is one: true if it is the answer to `type` with `sequence`.
static bool take_packet(struct frames *f, uint8_t type, uint8_t sequence, uint8_t *err, uint8_t *reply)
{
    uint8_t p[PROTO_PACKET_BYTES], again[PROTO_FRAME_MAX];
    const int n = f->in(f->arg, p);
    if (n == 0)
        return false;
    if (n < PROTO_HEADER_BYTES + PROTO_CRC_BYTES || n != p[2] + PROTO_HEADER_BYTES + PROTO_CRC_BYTES) {
        f->n_wrong++;
        return false;
    }
    memcpy(again, p, (size_t)n);
    proto_seal(again, p[4], p[3], p[2]);
    if (memcmp(again, p, (size_t)n)) {
        f->n_wrong++;
        return false;
    }
    if (p[4] >= PROTO_EVENT) {
        if (f->n_events == sizeof(f->event) / sizeof(*f->event))
            memmove(f->event, f->event + 1, (size_t)--f->n_events * sizeof(*f->event));
        struct frames_event *e = &f->event[f->n_events++];
        *e = (struct frames_event){ .type = p[4], .n = p[2], .sequence = p[3] };
        memcpy(e->payload, p + PROTO_HEADER_BYTES, p[2]);
        return false;
    }
    if (p[4] != (type | PROTO_REPLY) || p[3] != sequence || p[2] < 1)
        return false;
    *err = p[PROTO_HEADER_BYTES];
    if (reply)
        memcpy(reply, p + PROTO_HEADER_BYTES + 1, p[2] - 1u);
    return true;
}

int frames_command(struct frames *f, uint8_t type, const void *payload, size_t n, uint8_t *reply)
{
    uint8_t frame[PROTO_FRAME_MAX], err, none;
    if (n > PROTO_PAYLOAD_MAX)
        abort();
    if (n > 0)
        memcpy(frame + PROTO_HEADER_BYTES, payload, n);
    const uint8_t sequence = f->sequence++, length = proto_seal(frame, type, sequence, (uint8_t)n);
    uint64_t left = ANSWER_TICKS;
    for (; !f->out(f->arg, frame, length); left -= POLL_TICKS) {
        if (left < POLL_TICKS)
            return -1;
        take_packet(f, 0, 0, &none, NULL);
        f->run(f->arg, POLL_TICKS);
    }
    for (; left >= POLL_TICKS; left -= POLL_TICKS) {
        f->run(f->arg, POLL_TICKS);
        if (take_packet(f, type, sequence, &err, reply))
            return err;
    }
    return -1;
}

int frames_hello(struct frames *f)
{
    uint8_t version[2];
    proto_put_u16(version, PROTO_VERSION);
    const int err = frames_command(f, PROTO_HELLO, version, sizeof(version), NULL);
    f->n_events = 0;
    return err;
}

int frames_configure(struct frames *f, const struct frames_config *c)
{
    uint8_t p[PROTO_CONFIGURE_BYTES + PROTO_BANKS_MAX * PROTO_BANK_BYTES] = { c->n_registers, c->n_input_registers };
    proto_put_u16(p + 2, c->debounce_ms);
    proto_put_u16(p + 4, c->silence_ms);
    p[6] = c->flags;
    proto_put_u16(p + 8, c->feedback_ms);
    for (int b = 0; b < c->n_banks; b++) {
        uint8_t *q = p + PROTO_CONFIGURE_BYTES + b * PROTO_BANK_BYTES;
        proto_put_u16(q, c->bank[b].first);
        proto_put_u16(q + 2, c->bank[b].n);
        proto_put_u16(q + 4, c->bank[b].max_on_ms);
    }
    return frames_command(f, PROTO_CONFIGURE, p, PROTO_CONFIGURE_BYTES + (size_t)c->n_banks * PROTO_BANK_BYTES, NULL);
}

static int by_delay(const void *a, const void *b)
{
    const uint32_t x = proto_get_u24(a), y = proto_get_u24(b);
    return x < y ? -1 : x > y;
}

int frames_load(struct frames *f, const struct frames_shot *s)
{
    uint8_t p[PROTO_PAYLOAD_MAX], entry[PROTO_CHANNELS_MAX][PROTO_CHANNEL_BYTES];
    proto_put_u16(p, s->shot);
    p[2] = s->flags;
    p[3] = (uint8_t)s->n;
    proto_put_u32(p + 4, s->lead);
    proto_put_u32(p + 8, s->hold);
    int err = frames_command(f, PROTO_SHOT_BEGIN, p, PROTO_SHOT_BEGIN_BYTES, NULL);
    for (int r = 0; !err && r < PROTO_OUTPUTS_MAX / 8; r++)
        if (s->together[r]) {
            const int n = PROTO_OUTPUTS_MAX / 8 - r < PROTO_TOGETHER_PER_FRAME ? PROTO_OUTPUTS_MAX / 8 - r : PROTO_TOGETHER_PER_FRAME;
            p[0] = (uint8_t)r;
            memcpy(p + 1, s->together + r, (size_t)n);
            err = frames_command(f, PROTO_SHOT_TOGETHER, p, 1 + (size_t)n, NULL);
            r += n - 1;
        }
    for (int i = 0; i < s->n; i++) {
        proto_put_u24(entry[i], s->delay[i]);
        entry[i][3] = s->output[i];
    }
    qsort(entry, (size_t)s->n, sizeof(*entry), by_delay);
    for (int i = 0; !err && i < s->n; i += PROTO_CHANNELS_PER_FRAME) {
        const int n = s->n - i < PROTO_CHANNELS_PER_FRAME ? s->n - i : PROTO_CHANNELS_PER_FRAME;
        p[0] = (uint8_t)i;
        memcpy(p + 1, entry[i], (size_t)n * PROTO_CHANNEL_BYTES);
        err = frames_command(f, PROTO_SHOT_CHANNELS, p, 1 + (size_t)n * PROTO_CHANNEL_BYTES, NULL);
    }
    return err;
}

int frames_commit(struct frames *f, const struct frames_shot *s, uint64_t when)
{
    uint8_t p[PROTO_SHOT_COMMIT_BYTES];
    proto_put_u16(p, s->shot);
    proto_put_u64(p + 2, when);
    return frames_command(f, PROTO_SHOT_COMMIT, p, sizeof(p), NULL);
}

uint64_t frames_now(struct frames *f)
{
    uint8_t reply[PROTO_PAYLOAD_MAX] = { 0 };
    frames_command(f, PROTO_PING, NULL, 0, reply);
    return proto_get_u64(reply);
}

bool frames_take(struct frames *f, uint8_t type, struct frames_event *out)
{
    for (int i = 0; i < f->n_events; i++)
        if (f->event[i].type == type) {
            *out = f->event[i];
            memmove(f->event + i, f->event + i + 1, (size_t)(--f->n_events - i) * sizeof(*f->event));
            return true;
        }
    return false;
}

bool frames_listen(struct frames *f, uint64_t ticks, uint8_t type, struct frames_event *out)
{
    uint8_t err;
    for (uint64_t passed = 0; !frames_take(f, type, out); passed += POLL_TICKS) {
        if (passed >= ticks)
            return false;
        if (passed % PING_TICKS == 0)
            frames_command(f, PROTO_PING, NULL, 0, NULL);
        f->run(f->arg, POLL_TICKS);
        take_packet(f, 0, 0, &err, NULL);
    }
    return true;
}

void frames_run(struct frames *f, uint64_t ticks)
{
    struct frames_event none;
    frames_listen(f, ticks, 0, &none);
}
