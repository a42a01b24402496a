// tests/board/fake_board.c - see fake_board.h.
#if __has_include(<umockdev.h>)
#include "tests/board/fake_board.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { TICKS_PER_US = 16, FIRE_AFTER_MS = 20 };

const uint8_t fake_board_descriptors[] = {
    18, 1, 0x00, 0x02, 0xff, 0, 0, 64, PROTO_VENDOR_ID & 255, PROTO_VENDOR_ID >> 8, PROTO_PRODUCT_ID & 255, PROTO_PRODUCT_ID >> 8, 0x00, 0x01, 1, 2, 3, 1,
    9, 2, 32, 0, 1, 1, 0, 0x80, 50,
    9, 4, 0, 0, 2, 0xff, 0, 0, 0,
    7, 5, PROTO_ENDPOINT_OUT, 2, PROTO_PACKET_BYTES, 0, 0,
    7, 5, PROTO_ENDPOINT_IN, 2, PROTO_PACKET_BYTES, 0, 0,
};

static uint64_t now_ticks(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)(t.tv_sec % 100000) * 1000000 * TICKS_PER_US + (uint64_t)t.tv_nsec * TICKS_PER_US / 1000;
}

static void put_capabilities(const struct fake_board *f, uint8_t *p)
{
    struct proto_capabilities c = { .version = PROTO_VERSION, .can = 63, .ticks_per_s = 1000000 * TICKS_PER_US, .n_outputs = 416, .n_inputs = 200, .n_channels = 200, .n_banks = 4,
        .max_on_ceiling_ms = PROTO_MAX_ON_CEILING_MS, .gap_base_ticks = 3000, .gap_register_ticks = 40, .gap_channel_ticks = 60, .lead_min_ticks = 16000, .late_max_ticks = 16000,
        .input_sample_ticks = 2000, .n_captures = 1, .n_axes = 2, .steps_per_s_max = 8000 };
    if (f->wrong == FAKE_MAD_CAPABILITIES)
        c.ticks_per_s = 0;
    if (f->wrong == FAKE_NEWER)
        c.version = 0x0203;
    if (f->wrong == FAKE_OLDER)
        c.version = 0x0001;
    proto_put_capabilities(p, &c);
}

static int put_string(const struct fake_board *f, int index, uint8_t *to, size_t room)
{
    const char *const texts[] = { "", f->wrong == FAKE_OTHER_MAKER ? "somebody" : PROTO_MANUFACTURER, PROTO_PRODUCT, "FAKE0001" };
    uint8_t d[64] = { 4, 3, 0x09, 0x04 };
    if (index > 3)
        return -EPIPE;
    if (index) {
        d[0] = (uint8_t)(2 + 2 * strlen(texts[index]));
        for (size_t i = 0; texts[index][i]; i++) {
            d[2 + 2 * i] = (uint8_t)texts[index][i];
            d[3 + 2 * i] = 0;
        }
    }
    const size_t n = d[0] < room ? d[0] : room;
    memcpy(to, d, n);
    return (int)n;
}

static int fake_control(void *device, const uint8_t setup[8], uint8_t *data, size_t room)
{
    struct fake_board *f = device;
    if (setup[0] == 0x80 && setup[1] == 6 && setup[3] == 3)
        return put_string(f, setup[2], data, room);
    if (f->wrong == FAKE_DEAF)
        return -EAGAIN;
    if (f->wrong == FAKE_STALLS)
        return -EPIPE;
    if (setup[0] == 0xc0 && setup[1] == PROTO_GET_CAPABILITIES && room >= PROTO_CAPABILITIES_BYTES) {
        put_capabilities(f, data);
        return f->wrong == FAKE_SHORT_CAPABILITIES ? 7 : PROTO_CAPABILITIES_BYTES;
    }
    if (setup[0] == 0xc0 && setup[1] == PROTO_GET_TIME && room >= 16) {
        uint64_t ticks = now_ticks();
        if (f->wrong == FAKE_HUGE_TIME)
            ticks = UINT64_MAX;
        if (f->wrong == FAKE_RANDOM_TIME)
            ticks = (uint64_t)rand_r(&f->seed) * (uint64_t)rand_r(&f->seed);
        proto_put_u64(data, ticks);
        proto_put_u64(data + 8, 0);
        return f->wrong == FAKE_SHORT_TIME ? 3 : 16;
    }
    f->n_released += setup[0] == 0x40 && setup[1] == PROTO_RELEASE_ALL;
    return setup[0] & 0x80 ? -EPIPE : 0;
}

static void push(struct fake_board *f, const uint8_t *bytes, int n)
{
    if (f->n == 64)
        return;
    memcpy(f->queue[f->n], bytes, (size_t)n);
    f->size[f->n++] = n;
}

static void say(struct fake_board *f, uint8_t type, uint8_t sequence, const uint8_t *payload, uint8_t n)
{
    uint8_t frame[PROTO_PACKET_BYTES] = { 0 };
    memcpy(frame + PROTO_HEADER_BYTES, payload, n);
    int size = proto_seal(frame, type, sequence, n);
    const bool spoils = f->configured && f->wrong >= FAKE_RANDOM_BYTES && f->wrong <= FAKE_CUT;
    if (spoils && f->wrong == FAKE_RANDOM_BYTES)
        for (int i = 0; i < PROTO_PACKET_BYTES; i++)
            frame[i] = (uint8_t)rand_r(&f->seed);
    if (spoils && f->wrong == FAKE_WRONG_CRC)
        frame[size - 1] ^= 1;
    if (spoils && f->wrong == FAKE_WRONG_LENGTH)
        frame[2] = 200;
    if (spoils && f->wrong == FAKE_CUT)
        size = 4;
    push(f, frame, spoils && f->wrong == FAKE_RANDOM_BYTES ? PROTO_PACKET_BYTES : size);
}

static int fake_out(void *device, uint8_t endpoint, const uint8_t *bytes, size_t n)
{
    struct fake_board *f = device;
    uint8_t reply[PROTO_PAYLOAD_MAX] = { PROTO_OK }, n_reply = 1;
    if (endpoint != PROTO_ENDPOINT_OUT || f->wrong == FAKE_NO_READER)
        return -EAGAIN;
    if (n < PROTO_HEADER_BYTES + PROTO_CRC_BYTES || f->wrong == FAKE_NO_HELLO || (f->wrong == FAKE_FALLS_SILENT && f->committed))
        return (int)n;
    const uint8_t sequence = bytes[3], type = bytes[4], *payload = bytes + PROTO_HEADER_BYTES;
    if (f->wrong == FAKE_REFUSES || (f->wrong == FAKE_REFUSES_PING && type == PROTO_PING))
        reply[0] = 0xee;
    if (type == PROTO_HELLO) {
        f->sequence = 0;
        put_capabilities(f, reply + 1);
        n_reply = 1 + PROTO_CAPABILITIES_BYTES;
    }
    say(f, type | PROTO_REPLY, sequence, reply, n_reply);
    f->configured |= type == PROTO_CONFIGURE;
    if (type == PROTO_SHOT_COMMIT) {
        f->committed = true;
        f->shot = proto_get_u16(payload);
        f->fired_at = now_ticks() + FIRE_AFTER_MS * 1000 * TICKS_PER_US;
    }
    return (int)n;
}

static void misbehave(struct fake_board *f)
{
    uint8_t payload[PROTO_PAYLOAD_MAX] = { 0 };
    switch (f->wrong) {
    case FAKE_UNASKED:
        say(f, PROTO_REPLY | PROTO_OUTPUT, (uint8_t)rand_r(&f->seed), payload, 1);
        return;
    case FAKE_FLOOD:
        proto_put_u64(payload, now_ticks());
        payload[8] = 1;
        while (f->n < 64)
            say(f, PROTO_BUTTON, f->sequence++, payload, PROTO_BUTTON_BYTES);
        return;
    case FAKE_MAD_EVENTS:
        for (int i = 0; i < PROTO_PAYLOAD_MAX; i++)
            payload[i] = (uint8_t)rand_r(&f->seed);
        say(f, (uint8_t)(PROTO_EVENT + rand_r(&f->seed) % 9), f->sequence++, payload, (uint8_t)(rand_r(&f->seed) % (PROTO_PAYLOAD_MAX + 1)));
        return;
    case FAKE_MAD_STAMPS:
        proto_put_u64(payload, now_ticks() + UINT64_C(1000000000000000));
        payload[8] = 1;
        say(f, PROTO_BUTTON, f->sequence++, payload, PROTO_BUTTON_BYTES);
        return;
    default:
        return;
    }
}

static int fake_in(void *device, uint8_t endpoint, uint8_t *bytes, size_t room)
{
    struct fake_board *f = device;
    if (endpoint != PROTO_ENDPOINT_IN)
        return -EAGAIN;
    if (f->configured && f->wrong == FAKE_EMPTY_PACKETS)
        return 0;
    if (f->configured && !f->n)
        misbehave(f);
    if (f->committed && now_ticks() >= f->fired_at && f->wrong != FAKE_NEVER_FIRES && f->wrong != FAKE_FALLS_SILENT) {
        uint8_t payload[PROTO_FIRED_BYTES] = { 0 };
        f->committed = false;
        proto_put_u16(payload, f->shot);
        proto_put_u64(payload + 4, f->fired_at);
        say(f, PROTO_FIRED, f->sequence++, payload, sizeof(payload));
    }
    if (!f->n)
        return -EAGAIN;
    const int n = f->size[0];
    if ((size_t)n > room)
        return -EOVERFLOW;
    memcpy(bytes, f->queue[0], (size_t)n);
    f->n--;
    memmove(f->queue[0], f->queue[1], sizeof(f->queue[0]) * (size_t)f->n);
    memmove(f->size, f->size + 1, sizeof(f->size[0]) * (size_t)f->n);
    return n;
}

static void fake_reset(void *device)
{
    struct fake_board *f = device;
    f->configured = f->committed = false;
    f->n = 0;
}

const struct usbfs_ops fake_board_ops = { .control = fake_control, .out = fake_out, .in = fake_in, .reset = fake_reset, .unplugged = fake_reset, .speed_mbit = 12 };
#endif
