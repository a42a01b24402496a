// tests/fuzz/fuzz_ptpip.c - hostile PTP/IP and PTP: the packet parser, data sets, and the responder behind them.
//
// Whatever bytes come are cut into packets; each that parses must survive being written and parsed again, and each command is
// answered by a camera of one of the three families, whose model moves on between them.
#include "tests/rigsim/ptp.h"
#include "tests/rigsim/ptpip.h"

#include <assert.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static uint64_t measure(void *arg, const struct body *b, const struct exposure *e, int file)
{
    (void)arg;
    (void)b;
    return 1000000u + e->shot + (unsigned)file;
}

static void write_again(const struct ptpip_packet *p)
{
    struct dataset d = { 0 };
    struct ptpip_packet again;
    size_t used;
    ptpip_write(&d, p);
    if (!d.failed) {
        assert(!ptpip_parse(d.data, d.n, &again, &used) && used == d.n);
        assert(again.type == p->type && again.code == p->code && again.transaction == p->transaction);
        assert(again.n_payload == p->n_payload && again.total == p->total && !strcmp(again.name, p->name));
    }
    dataset_free(&d);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static struct personality personality[3];
    static const char *const name[3] = { "generic", "nikon", "canon" };
    struct body body;
    struct ptp_session session;
    struct ptp_reply reply = { 0 };
    struct ptp_request request = { 0 };
    if (size < 1)
        return 0;
    const int which = data[0] % 3;
    if (!personality[which].n_properties && personality_load(&personality[which], name[which]))
        abort();
    if (body_init(&body, &personality[which], 0, 0, 1, 1))
        return 0;
    body.measure = measure;
    ptp_session_init(&session, &body);
    session.width_px = 64;
    session.height_px = 48;
    int64_t now = 1;
    for (size_t at = 1; at < size;) {
        struct ptpip_packet p;
        struct body_event e;
        struct ptp_event wire;
        size_t used;
        if (ptpip_parse(data + at, size - at, &p, &used))
            break;
        assert(used >= PTPIP_HEADER_BYTES && used <= size - at);
        write_again(&p);
        if (p.type == PTPIP_COMMAND) {
            request = (struct ptp_request){ .code = p.code, .transaction = p.transaction, .n_params = p.n_params };
            memcpy(request.param, p.param, sizeof(p.param));
        }
        if (p.type == PTPIP_COMMAND || p.type == PTPIP_END_DATA) {
            request.data = p.payload;
            request.n_data = p.n_payload;
            ptp_answer(&session, &request, &reply);
            assert(reply.code >= 0x2001 && reply.code <= 0x201e);
            assert(!reply.object || body_object(&body, reply.object));
            assert(!reply.object || reply.offset + reply.n <= body_object(&body, reply.object)->told);
            assert(reply.n_params <= 5);
        }
        now += 50000000;
        body_step(&body, now);
        while (body_take_event(&body, &e))
            ptp_notice(&session, &e, &wire);
        at += used;
    }
    dataset_free(&reply.data);
    body_free(&body);
    return 0;
}
