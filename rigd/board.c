// rigd/board.c - see board.h.
#include "rigd/board.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

// ---- what the board says ---------------------------------------------------------------------------------------------------------

static bool ticks_at(const uint8_t *p, int64_t *out) // of a board that has not run for 10,000 years
{
    const uint64_t ticks = proto_get_u64(p);
    *out = (int64_t)(ticks & INT64_MAX);
    return ticks < UINT64_C(1) << 62;
}

static int decode_inputs(struct board_said *s, const uint8_t *p, size_t n)
{
    s->inputs.n = 0;
    if (n < 8 || n % 2 || !ticks_at(p, &s->inputs.ticks))
        return -EPROTO;
    for (size_t i = 8; i < n; i += 2)
        for (int bit = 0; bit < 8; bit++)
            if (p[i + 1] >> bit & 1)
                s->inputs.input[s->inputs.n++] = (uint16_t)(8 * p[i] + bit);
    return 0;
}

static int decode_event(struct board_said *s, const uint8_t *p, size_t n)
{
    switch (s->type) {
    case PROTO_FIRED:
        if (n != PROTO_FIRED_BYTES || p[2] > PROTO_FIRED_GUARDED || !ticks_at(p + 4, &s->fired.first_ticks))
            return -EPROTO;
        s->fired.shot = proto_get_u16(p);
        s->fired.how = p[2];
        s->fired.late_ticks = proto_get_u32(p + 12);
        s->fired.n_edges = proto_get_u16(p + 16);
        s->fired.n_lost = proto_get_u16(p + 18);
        return 0;
    case PROTO_BUTTON:
        if (n != PROTO_BUTTON_BYTES || p[8] > 1 || p[9] > 1 || !ticks_at(p, &s->button.ticks))
            return -EPROTO;
        s->button.down = p[8];
        s->button.fires = p[9];
        return 0;
    case PROTO_CAPTURE:
        s->capture.n_lost = n == PROTO_CAPTURE_BYTES ? proto_get_u16(p + 8) : 0;
        return n == PROTO_CAPTURE_BYTES && ticks_at(p, &s->capture.ticks) ? 0 : -EPROTO;
    case PROTO_INPUTS:
        return decode_inputs(s, p, n);
    case PROTO_FAULT:
        if (n != PROTO_FAULT_BYTES)
            return -EPROTO;
        s->fault.fault = p[0];
        s->fault.what = proto_get_u16(p + 2);
        return 0;
    case PROTO_HEAD:
        if (n != PROTO_HEAD_BYTES || p[0] > PROTO_HEAD_BLOCKED)
            return -EPROTO;
        s->head.how = p[0];
        s->head.homed = p[1];
        s->head.yaw = proto_get_i32(p + 2);
        s->head.pitch = proto_get_i32(p + 6);
        return 0;
    default: // a newer board's: it may say more than we understand
        return 0;
    }
}

int board_decode(struct board_said *out, const uint8_t *bytes, size_t n, const char **why)
{
    struct board_said s;
    memset(&s, 0, sizeof(s));
    memset(out, 0, sizeof(*out));
    *why = "is no frame of the trigger board's protocol";
    if (n < PROTO_HEADER_BYTES + PROTO_CRC_BYTES || bytes[0] != PROTO_SYNC_0 || bytes[1] != PROTO_SYNC_1)
        return -EPROTO;
    *why = "has a wrong length";
    if (bytes[2] > PROTO_PAYLOAD_MAX || n != (size_t)bytes[2] + PROTO_HEADER_BYTES + PROTO_CRC_BYTES)
        return -EPROTO;
    uint32_t crc = PROTO_CRC_START;
    for (size_t i = 2; i < n - PROTO_CRC_BYTES; i++)
        crc = proto_crc_add(crc, bytes[i]);
    *why = "has a wrong checksum";
    if (proto_get_u32(bytes + n - PROTO_CRC_BYTES) != (uint32_t)~crc)
        return -EPROTO;
    const uint8_t *payload = bytes + PROTO_HEADER_BYTES;
    s.sequence = bytes[3];
    s.type = bytes[4];
    *why = "has fields that cannot be";
    if (s.type < PROTO_REPLY)
        return -EPROTO;
    if (s.type > PROTO_EVENT) {
        const int err = decode_event(&s, payload, bytes[2]);
        if (err)
            return err;
    } else {
        if (bytes[2] < 1)
            return -EPROTO;
        s.reply.error = payload[0];
        s.reply.n = (uint8_t)(bytes[2] - 1);
        memcpy(s.reply.bytes, payload + 1, s.reply.n);
    }
    *out = s;
    return 0;
}

int board_capabilities(struct proto_capabilities *out, const uint8_t *bytes, size_t n, const char **why)
{
    memset(out, 0, sizeof(*out));
    *why = "its list of capabilities is too short";
    if (n < PROTO_CAPABILITIES_BYTES)
        return -EPROTO;
    const struct proto_capabilities c = proto_get_capabilities(bytes);
    *why = c.version >> 8 > PROTO_VERSION >> 8 ? "its firmware is newer than this rigd: update rigd, or flash the firmware that came with it"
                                               : "its firmware is older than this rigd: flash the one that came with it (firmware/README.md)";
    if (c.version >> 8 != PROTO_VERSION >> 8)
        return -ENOTSUP;
    *why = "its capabilities cannot be";
    if (c.ticks_per_s < 10000 || c.ticks_per_s > 1000000000 || c.n_outputs < 1 || c.n_outputs > PROTO_OUTPUTS_MAX || c.n_inputs > PROTO_INPUTS_MAX ||
        c.n_channels < 1 || c.n_channels > PROTO_CHANNELS_MAX || c.n_banks < 1 || c.max_on_ceiling_ms > PROTO_MAX_ON_CEILING_MS ||
        c.max_on_ceiling_ms <= PROTO_ON_SLACK_MS || c.lead_min_ticks > c.ticks_per_s || c.n_axes > PROTO_AXES ||
        (c.can & (PROTO_CAN_CHANNELS | PROTO_CAN_TOGETHER)) != (PROTO_CAN_CHANNELS | PROTO_CAN_TOGETHER))
        return -EPROTO;
    *out = c;
    return 0;
}

const char *board_error_text(uint8_t error)
{
    static const char *const texts[] = {
        [PROTO_OK] = "nothing is wrong", [PROTO_ERR_SEQUENCE] = "a command got lost", [PROTO_ERR_SESSION] = "the session had ended: this host was silent for too long",
        [PROTO_ERR_VERSION] = "another version of the protocol", [PROTO_ERR_TYPE] = "it does not know this command", [PROTO_ERR_LENGTH] = "a command of a wrong length",
        [PROTO_ERR_VALUE] = "a value out of its range", [PROTO_ERR_BUSY] = "it is busy", [PROTO_ERR_PAST] = "too late", [PROTO_ERR_INCOMPLETE] = "the shot is not complete",
        [PROTO_ERR_ORDER] = "delays out of order", [PROTO_ERR_GAP] = "edges closer than it can shift", [PROTO_ERR_ON_TIME] = "an output would be on for too long",
        [PROTO_ERR_OUTPUT] = "no such output: is output_registers too small?", [PROTO_ERR_CONFIGURE] = "it is not configured", [PROTO_ERR_NOT_HOMED] = "the head is not homed",
        [PROTO_ERR_LIMIT] = "beyond the head's limits", [PROTO_ERR_AHEAD] = "too far ahead",
    };
    return error < sizeof(texts) / sizeof(texts[0]) ? texts[error] : "an error that this rigd does not know";
}

// ---- a shot ----------------------------------------------------------------------------------------------------------------------

struct press {
    int64_t ticks; // from T0 + lead
    int output;
};

static int by_time(const void *a, const void *b)
{
    const struct press *x = a, *y = b;
    return x->ticks != y->ticks ? (x->ticks < y->ticks ? -1 : 1) : x->output - y->output;
}

// Presses that are neither together nor gap apart are moved to the nearer: none by more than half a gap, however many follow each other.
// Returns the most that now share an edge.
static int space_out(struct press *to, const struct press *from, int n, int64_t gap_ticks)
{
    int n_most = 0, n_here = 0;
    for (int i = 0; i < n; i++) {
        to[i] = from[i];
        const int64_t before = i ? to[i - 1].ticks : INT64_MIN / 2;
        if (from[i].ticks - before < gap_ticks)
            to[i].ticks = 2 * (from[i].ticks - before) < gap_ticks ? before : before + gap_ticks;
        n_here = to[i].ticks == before ? n_here + 1 : 1;
        n_most = n_here > n_most ? n_here : n_most;
    }
    return n_most;
}

int board_shot_plan(struct board_shot *out, struct edges *e, const struct proto_capabilities *board, int n_registers,
    int64_t (*ticks_of)(const void *arg, int64_t ns), const void *arg)
{
    struct press asked[EDGES_WIRES_MAX], press[EDGES_WIRES_MAX];
    struct edges_step ignored;
    int64_t half_ns = EDGES_NEVER, first_ns = EDGES_NEVER, last_ns = 0;
    int n = 0;
    memset(out, 0, sizeof(*out));
    for (int w = 0; w < e->n_wires; w++) {
        const int64_t ns = e->wire[w].press_ns;
        if (ns == EDGES_NEVER)
            continue;
        if (e->wire[w].role == EDGES_HALF) {
            const int line = e->line[w].line;
            out->together[line / 8] |= (uint8_t)(1 << line % 8);
            out->n_together = line / 8 + 1 > out->n_together ? line / 8 + 1 : out->n_together;
            half_ns = ns;
        } else {
            asked[n++] = (struct press){ .output = e->line[w].line };
            asked[n - 1].ticks = ticks_of(arg, ns);
            first_ns = ns < first_ns ? ns : first_ns;
            last_ns = ns > last_ns ? ns : last_ns;
        }
    }
    out->first_ns = first_ns;
    out->end_ns = last_ns + e->hold_ns;
    edges_give_up(e, false, &ignored);
    if (n > board->n_channels) {
        log_error("trigger: a shot of %d lines, the board has %d channels: let cameras share lines, or use a second board", n, board->n_channels);
        return -EINVAL;
    }
    const int64_t first_ticks = ticks_of(arg, first_ns);
    out->at_ticks = half_ns == EDGES_NEVER ? first_ticks : ticks_of(arg, half_ns);
    out->lead_ticks = (uint32_t)(first_ticks - out->at_ticks); // edges_plan() has bounded it
    out->hold_ticks = (uint32_t)(ticks_of(arg, first_ns + e->hold_ns) - first_ticks);
    for (int i = 0; i < n; i++)
        asked[i].ticks -= first_ticks;
    qsort(asked, (size_t)n, sizeof(asked[0]), by_time);
    const int64_t least_gap_ticks = board->gap_base_ticks + (int64_t)board->gap_register_ticks * n_registers;
    for (int n_together = 1; n_together <= n; n_together++) // the more share an edge, the more time is needed before it
        if (space_out(press, asked, n, least_gap_ticks + (int64_t)board->gap_channel_ticks * n_together) <= n_together)
            break;
    for (int i = 0; i < n; i++) {
        if (press[i].ticks > PROTO_DELAY_MAX_TICKS) {
            log_error("trigger: a delay of %.0f ms is longer than the board counts", 1e3 * (double)press[i].ticks / board->ticks_per_s);
            return -EINVAL;
        }
        out->channel[i].delay_ticks = (uint32_t)press[i].ticks;
        out->channel[i].output = (uint16_t)press[i].output;
    }
    out->n_channels = n;
    return 0;
}

int board_shot_frame(const struct board_shot *s, int i, uint16_t shot, bool on_button, uint8_t *type, uint8_t *p)
{
    const int n_together = (s->n_together + PROTO_TOGETHER_PER_FRAME - 1) / PROTO_TOGETHER_PER_FRAME;
    const int n_channels = (s->n_channels + PROTO_CHANNELS_PER_FRAME - 1) / PROTO_CHANNELS_PER_FRAME;
    if (i == 0) {
        *type = PROTO_SHOT_BEGIN;
        proto_put_u16(p, shot);
        p[2] = on_button ? PROTO_SHOT_ON_BUTTON : 0;
        p[3] = (uint8_t)s->n_channels;
        proto_put_u32(p + 4, s->lead_ticks);
        proto_put_u32(p + 8, s->hold_ticks);
        return PROTO_SHOT_BEGIN_BYTES;
    }
    if (i <= n_together) {
        const int first = (i - 1) * PROTO_TOGETHER_PER_FRAME, left = s->n_together - first;
        const int n = left < PROTO_TOGETHER_PER_FRAME ? left : PROTO_TOGETHER_PER_FRAME;
        *type = PROTO_SHOT_TOGETHER;
        p[0] = (uint8_t)first;
        memcpy(p + 1, s->together + first, (size_t)n);
        return 1 + n;
    }
    i -= 1 + n_together;
    if (i < n_channels) {
        const int first = i * PROTO_CHANNELS_PER_FRAME;
        int n = 0;
        *type = PROTO_SHOT_CHANNELS;
        p[0] = (uint8_t)first;
        for (; n < PROTO_CHANNELS_PER_FRAME && first + n < s->n_channels; n++) {
            proto_put_u24(p + 1 + PROTO_CHANNEL_BYTES * n, s->channel[first + n].delay_ticks);
            p[4 + PROTO_CHANNEL_BYTES * n] = (uint8_t)s->channel[first + n].output;
        }
        return 1 + PROTO_CHANNEL_BYTES * n;
    }
    if (i > n_channels)
        return -1;
    *type = PROTO_SHOT_COMMIT;
    proto_put_u16(p, shot);
    proto_put_u64(p + 2, (uint64_t)s->at_ticks);
    return PROTO_SHOT_COMMIT_BYTES;
}
