// tests/rigsim/ptpip.c - see ptpip.h.
#include "tests/rigsim/ptpip.h"

#include <errno.h>
#include <string.h>

// A name: UTF-16 up to a 0, without a count.
static int read_name(struct dataset_reader *r, char name[PTPIP_NAME_MAX])
{
    size_t n = 0;
    for (;;) {
        const uint16_t c = dataset_read_u16(r);
        if (r->failed)
            return -EPROTO;
        if (!c)
            break;
        if (n + 1 < PTPIP_NAME_MAX)
            name[n++] = c < 0x80 ? (char)c : '?';
    }
    name[n] = 0;
    return 0;
}

static void read_params(struct dataset_reader *r, struct ptpip_packet *p)
{
    while (r->at < r->n && !r->failed && p->n_params < PTPIP_PARAMS_MAX)
        p->param[p->n_params++] = dataset_read_u32(r);
}

int ptpip_parse(const uint8_t *bytes, size_t n, struct ptpip_packet *out, size_t *used)
{
    if (n < PTPIP_HEADER_BYTES)
        return -EAGAIN;
    struct dataset_reader r = { bytes, n, 0, false };
    const uint32_t length = dataset_read_u32(&r), type = dataset_read_u32(&r);
    if (length < PTPIP_HEADER_BYTES || length > PTPIP_PACKET_MAX || type < 1 || type > PTPIP_PONG)
        return -EPROTO;
    if (n < length)
        return -EAGAIN;
    struct ptpip_packet p = { .type = (enum ptpip_type)type };
    int err = 0;
    r.n = length;
    switch (p.type) {
    case PTPIP_INIT_COMMAND_ACK:
        p.connection = dataset_read_u32(&r);
        // fall through
    case PTPIP_INIT_COMMAND_REQUEST:
        for (int i = 0; i < 16; i++)
            p.guid[i] = dataset_read_u8(&r);
        err = read_name(&r, p.name);
        p.version = dataset_read_u32(&r);
        break;
    case PTPIP_INIT_EVENT_REQUEST:
        p.connection = dataset_read_u32(&r);
        break;
    case PTPIP_INIT_FAIL:
        p.reason = dataset_read_u32(&r);
        break;
    case PTPIP_COMMAND:
        p.data_phase = dataset_read_u32(&r);
        // fall through
    case PTPIP_RESPONSE:
    case PTPIP_EVENT:
        p.code = dataset_read_u16(&r);
        p.transaction = dataset_read_u32(&r);
        read_params(&r, &p);
        break;
    case PTPIP_START_DATA:
        p.transaction = dataset_read_u32(&r);
        p.total = dataset_read_u64(&r);
        break;
    case PTPIP_DATA:
    case PTPIP_END_DATA:
        p.transaction = dataset_read_u32(&r);
        p.payload = bytes + r.at;
        p.n_payload = length - r.at;
        r.at = length;
        break;
    case PTPIP_CANCEL:
        p.transaction = dataset_read_u32(&r);
        break;
    case PTPIP_INIT_EVENT_ACK:
    case PTPIP_PING:
    case PTPIP_PONG:
        break;
    }
    if (err || r.failed || r.at != length)
        return -EPROTO;
    *out = p;
    *used = length;
    return 0;
}

void ptpip_write(struct dataset *out, const struct ptpip_packet *p)
{
    const size_t at = out->n;
    dataset_u32(out, 0);
    dataset_u32(out, p->type);
    switch (p->type) {
    case PTPIP_INIT_COMMAND_ACK:
        dataset_u32(out, p->connection);
        // fall through
    case PTPIP_INIT_COMMAND_REQUEST:
        dataset_bytes(out, p->guid, sizeof(p->guid));
        for (const char *c = p->name; *c; c++)
            dataset_u16(out, (unsigned char)*c);
        dataset_u16(out, 0);
        dataset_u32(out, p->version);
        break;
    case PTPIP_INIT_EVENT_REQUEST:
        dataset_u32(out, p->connection);
        break;
    case PTPIP_INIT_FAIL:
        dataset_u32(out, p->reason);
        break;
    case PTPIP_COMMAND:
        dataset_u32(out, p->data_phase);
        // fall through
    case PTPIP_RESPONSE:
    case PTPIP_EVENT:
        dataset_u16(out, p->code);
        dataset_u32(out, p->transaction);
        for (int i = 0; i < p->n_params; i++)
            dataset_u32(out, p->param[i]);
        break;
    case PTPIP_START_DATA:
        dataset_u32(out, p->transaction);
        dataset_u64(out, p->total);
        break;
    case PTPIP_DATA:
    case PTPIP_END_DATA:
        dataset_u32(out, p->transaction);
        if (p->payload)
            dataset_bytes(out, p->payload, p->n_payload);
        break;
    case PTPIP_CANCEL:
        dataset_u32(out, p->transaction);
        break;
    case PTPIP_INIT_EVENT_ACK:
    case PTPIP_PING:
    case PTPIP_PONG:
        break;
    }
    const bool apart = (p->type == PTPIP_DATA || p->type == PTPIP_END_DATA) && !p->payload;
    dataset_set_u32(out, at, (uint32_t)(out->n - at + (apart ? p->n_payload : 0)));
}
