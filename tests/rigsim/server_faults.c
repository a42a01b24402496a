// tests/rigsim/server_faults.c - what the fault script does to a camera and to the bytes it sends.
#include "solver/random.h"
#include "solver/take/log.h"
#include "tests/rigsim/ptp_vendor.h"
#include "tests/rigsim/server_state.h"

#include <string.h>

enum { GARBAGE_STREAM = 0x676172, FLOOD_PER_STEP = BODY_EVENTS_MAX / 2 };

void server_power(struct camera *c, bool on, int64_t back_ns)
{
    c->body.faults.no_power = !on;
    c->boot = !on && back_ns != INT64_MAX;
    c->power_until_ns = back_ns;
    if (on)
        return;
    server_refuse(c); // first, so that no client slips in between
    server_drop_links(c);
    body_open_lines(&c->body);
}

static void turn_dial(struct camera *c, uint16_t code, int64_t value)
{
    const int i = ptp_find_property(&c->session, code);
    if (i < 0 || body_set(&c->body, i, value, NULL) != PTP_OK) {
        log_warning("rigsim: %s: the script turns 0x%04x to %lld, which this camera has not", server_camera_name(c->index), code,
                    (long long)value);
        return;
    }
    body_push_event(&c->body, (struct body_event){ .kind = BODY_PROPERTY_CHANGED, .value = code, .at_ns = c->body.now_ns });
}

static void begin(struct camera *c, const struct fault *f)
{
    const int64_t now = c->server->now_ns;
    struct body_faults *b = &c->body.faults;
    switch (f->kind) {
    case FAULT_BUSY:
        b->busy_until_ns = now + f->ns;
        return;
    case FAULT_STALL:
        c->stall_until_ns = now + f->ns;
        return;
    case FAULT_DROP:
        server_drop_links(c);
        return;
    case FAULT_REFUSE:
        c->refuse_until_ns = now + f->ns;
        server_refuse(c);
        server_drop_links(c);
        return;
    case FAULT_LOSE_ADDED:
        b->lose_object_added += (int)f->n;
        return;
    case FAULT_LOSE_COMPLETE:
        b->lose_complete += (int)f->n;
        return;
    case FAULT_LATE:
        b->late_event_ns = f->ns;
        b->late_events = (int)f->n;
        return;
    case FAULT_FLOOD:
        c->flood_rate = f->n < 1 ? 1 : f->n > 100000 ? 100000 : f->n;
        c->flood_next_ns = now;
        c->flood_until_ns = now + f->ns;
        return;
    case FAULT_CARD_FULL:
        b->card_full = true;
        return;
    case FAULT_CARD_EMPTY_AGAIN:
        b->card_full = false;
        return;
    case FAULT_BATTERY:
        c->body.battery_percent = (double)(f->n < 100 ? f->n : 100);
        if (!f->n)
            server_power(c, false, INT64_MAX);
        return;
    case FAULT_POWER_CUT:
        server_power(c, false, now + f->ns);
        return;
    case FAULT_DRIFT:
        b->drift_code = (uint16_t)f->n;
        b->drift_value = f->n2;
        b->drifts = 1;
        return;
    case FAULT_DIAL:
        turn_dial(c, (uint16_t)f->n, f->n2);
        return;
    case FAULT_CORRUPT:
        b->corrupt_objects += (int)f->n;
        return;
    case FAULT_SHORT:
        b->short_objects += (int)f->n;
        return;
    case FAULT_SLOW:
        c->bytes_per_s = (double)f->n;
        c->bytes_ahead = 0;
        c->bucket_ns = now;
        return;
    case FAULT_FLICKER:
        b->flicker = .01 * (double)(f->n < 100 ? f->n : 100);
        return;
    case FAULT_NO_SHOT:
        b->closed_shutters = (int)f->n;
        return;
    case FAULT_HEAD_STUCK:
        c->server->head.stuck = (int)f->n;
        return;
    case FAULT_HOSTILE:
        c->hostile = (int)f->n;
        c->n_hostile = (int)f->n2;
        return;
    }
}

void server_fault_trigger(struct camera *c, enum fault_when when, uint32_t value)
{
    const struct faults *script = c->server->settings->faults;
    for (int i = 0; script && i < script->n; i++) {
        const struct fault *f = &script->fault[i];
        if (f->when != when || (f->value != UINT32_MAX && f->value != value) ||
            !fault_is_for(f, server_camera_name(c->index)))
            continue;
        if (!f->nth || ++c->fault_count[i] == f->nth)
            begin(c, f);
    }
}

void server_faults_step(struct camera *c)
{
    const int64_t now = c->server->now_ns;
    const struct faults *script = c->server->settings->faults;
    for (int i = 0; script && i < script->n; i++) {
        const struct fault *f = &script->fault[i];
        if (f->when == FAULT_AT && !c->fault_count[i] && c->server->started_ns + f->at_ns <= now &&
            fault_is_for(f, server_camera_name(c->index))) {
            c->fault_count[i] = 1;
            begin(c, f);
        }
    }
    if (c->boot && c->power_until_ns <= now) {
        server_power(c, true, INT64_MAX);
        server_listen(c);
    }
    if (c->refuse_until_ns && c->refuse_until_ns <= now) {
        c->refuse_until_ns = 0;
        if (!c->body.faults.no_power)
            server_listen(c);
    }
    for (int n = 0; c->flood_next_ns < c->flood_until_ns && c->flood_next_ns <= now && n < FLOOD_PER_STEP; n++) {
        const struct personality *p = c->body.personality;
        const struct body_event e = { .kind = BODY_PROPERTY_CHANGED, .value = p->property[n % p->n_properties].code };
        body_push_event(&c->body, e);
        c->flood_next_ns += 1000000000 / c->flood_rate;
    }
}

int64_t server_faults_next_ns(const struct camera *c)
{
    const int64_t now = c->server->now_ns;
    const struct faults *script = c->server->settings->faults;
    int64_t next = INT64_MAX;
    for (int i = 0; script && i < script->n; i++) {
        const int64_t at = c->server->started_ns + script->fault[i].at_ns;
        if (script->fault[i].when == FAULT_AT && at > now && at < next)
            next = at;
    }
    const int64_t ends[] = { c->stall_until_ns, c->boot ? c->power_until_ns : 0, c->refuse_until_ns,
                             c->flood_next_ns < c->flood_until_ns ? c->flood_next_ns : 0,
                             c->bytes_ahead > 0 ? c->bucket_ns + (int64_t)(c->bytes_ahead / c->bytes_per_s * 1e9) + 1 : 0 };
    for (size_t i = 0; i < sizeof(ends) / sizeof(ends[0]); i++)
        if (ends[i] && ends[i] < next && (ends[i] > now || i == 3)) // a flood may be behind
            next = ends[i];
    return next;
}

bool server_is_stalled(const struct camera *c)
{
    return c->stall_until_ns > c->server->now_ns;
}

// ---- hostile bytes -----------------------------------------------------------------------------------------------------------

void server_spoil_data(struct camera *c, struct dataset *data)
{
    if (!c->n_hostile || !data->n)
        return;
    switch (c->hostile) {
    case HOSTILE_COUNT: // DeviceInfo's first list; elsewhere the first number
        dataset_set_u32(data, 0, 0xfffffff0);
        break;
    case HOSTILE_STRING:
        for (size_t i = 0; i < data->n; i++)
            if (data->data[i] > 1 && data->data[i] < 64)
                data->data[i] = 255;
        break;
    case HOSTILE_GARBAGE:
        for (size_t i = 0; i < data->n; i++)
            data->data[i] = (uint8_t)random_u64(c->body.seed ^ GARBAGE_STREAM, c->index, (uint64_t)c->n_hostile << 32 | i);
        break;
    default:
        return;
    }
    c->n_hostile--;
}

void server_spoil_packets(struct camera *c, struct dataset *out, size_t from)
{
    if (!c->n_hostile || c->hostile == HOSTILE_COUNT || c->hostile == HOSTILE_STRING || c->hostile == HOSTILE_GARBAGE ||
        out->n < from + PTPIP_HEADER_BYTES)
        return;
    uint8_t *p = out->data + from;
    const uint32_t length = (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
    const bool data = p[4] == PTPIP_START_DATA;
    switch (c->hostile) {
    case HOSTILE_LENGTH:
        dataset_set_u32(out, from, length + 12);
        break;
    case HOSTILE_HUGE:
        dataset_set_u32(out, from, 0x7fffffff);
        break;
    case HOSTILE_TINY:
        dataset_set_u32(out, from, 3);
        break;
    case HOSTILE_TRANSACTION: // bytes 8.. of data packets, 10.. of responses
        p[data ? 8 : 10] ^= 0x55;
        break;
    case HOSTILE_TYPE:
        dataset_set_u32(out, from + 4, 99);
        break;
    case HOSTILE_TOTAL:
        if (!data)
            return; // wait for one with data
        dataset_set_u32(out, from + 12, 0x7ffffff0);
        break;
    case HOSTILE_CUT:
        out->n = from + length / 2;
        break;
    }
    c->n_hostile--;
}
