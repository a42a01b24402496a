// tests/usb/ptp_usb.c - see ptp_usb.h.
#include "tests/usb/ptp_usb.h"

#include <errno.h>
#include <string.h>

enum container { CONTAINER_COMMAND = 1, CONTAINER_DATA, CONTAINER_RESPONSE, CONTAINER_EVENT };
enum class_request { REQUEST_CANCEL = 0x64, REQUEST_RESET = 0x66, REQUEST_STATUS = 0x67 };
enum { HEADER_BYTES = 12 };

static void put_header(struct dataset *d, uint64_t n_bytes, enum container type, uint16_t code, uint32_t transaction)
{
    const uint64_t all = HEADER_BYTES + n_bytes;
    dataset_u32(d, all > UINT32_MAX ? UINT32_MAX : (uint32_t)all);
    dataset_u16(d, (uint16_t)type);
    dataset_u16(d, code);
    dataset_u32(d, transaction);
}

static void forget_transfers(struct ptp_usb *p)
{
    dataset_clear(&p->from_host);
    dataset_clear(&p->request_data);
    dataset_clear(&p->to_host);
    dataset_clear(&p->response);
    frame_close(p->frame);
    p->frame = NULL;
    p->frame_left = p->sent = 0;
    p->asked = p->zero_length_due = false;
}

int ptp_usb_open(struct ptp_usb *p, const struct personality *personality, struct scene *scene, int64_t now_ns, int64_t utc_ns)
{
    *p = (struct ptp_usb){ .scene = scene };
    const int err = body_init(&p->body, personality, 0, 1, now_ns, utc_ns);
    if (err)
        return err;
    p->body.fixed_clock = true;
    p->body.measure = frame_measure;
    p->body.measure_arg = scene;
    ptp_session_init(&p->session, &p->body);
    p->session.thumbnail = frame_thumbnail;
    p->session.arg = scene;
    p->session.width_px = (uint32_t)scene_width(scene, p->body.index);
    p->session.height_px = (uint32_t)scene_height(scene, p->body.index);
    return 0;
}

void ptp_usb_close(struct ptp_usb *p)
{
    forget_transfers(p);
    dataset_free(&p->from_host);
    dataset_free(&p->request_data);
    dataset_free(&p->to_host);
    dataset_free(&p->response);
    dataset_free(&p->reply.data);
    body_free(&p->body);
}

void ptp_usb_reset(struct ptp_usb *p)
{
    forget_transfers(p);
    ptp_session_reset(&p->session);
    p->n_events = 0;
    p->hung = false;
}

void ptp_usb_step(struct ptp_usb *p, int64_t now_ns)
{
    struct body_event e;
    struct ptp_event wire;
    body_step(&p->body, now_ns);
    while (body_take_event(&p->body, &e)) {
        if (!ptp_notice(&p->session, &e, &wire))
            continue;
        if (p->n_events == PTP_USB_EVENTS_MAX)
            memmove(p->event, p->event + 1, (size_t)--p->n_events * sizeof(p->event[0]));
        p->event[p->n_events++] = wire;
    }
}

// ---- from the host -------------------------------------------------------------------------------------------------------------

static int take_container(struct ptp_usb *p)
{
    struct dataset_reader r = { .data = p->from_host.data, .n = p->from_host.n };
    const uint32_t length = dataset_read_u32(&r);
    const uint16_t type = dataset_read_u16(&r), code = dataset_read_u16(&r);
    const uint32_t transaction = dataset_read_u32(&r);
    if (r.failed || length < HEADER_BYTES || length > PTP_USB_OUT_MAX || length < p->from_host.n)
        return -EPROTO;
    if (length > p->from_host.n)
        return 0; // more is to come
    if (type == CONTAINER_COMMAND) {
        const size_t n = (length - HEADER_BYTES) / 4;
        if ((length - HEADER_BYTES) % 4 || n > 5)
            return -EPROTO;
        p->request = (struct ptp_request){ .code = code, .transaction = transaction, .n_params = (int)n };
        for (size_t i = 0; i < n; i++)
            p->request.param[i] = dataset_read_u32(&r);
        struct dataset container = p->from_host;
        p->from_host = (struct dataset){ 0 };
        forget_transfers(p);
        p->from_host = container;
        p->asked = true;
    } else if (type == CONTAINER_DATA && p->asked && code == p->request.code && transaction == p->request.transaction) {
        dataset_clear(&p->request_data);
        dataset_bytes(&p->request_data, r.data + r.at, r.n - r.at);
        p->request.data = p->request_data.data;
        p->request.n_data = p->request_data.n;
    } else {
        return -EPROTO;
    }
    dataset_clear(&p->from_host);
    return p->from_host.failed || p->request_data.failed ? -ENOMEM : 0;
}

int ptp_usb_write(struct ptp_usb *p, const uint8_t *bytes, size_t n)
{
    dataset_bytes(&p->from_host, bytes, n);
    const int err = take_container(p);
    if (err)
        forget_transfers(p);
    return err;
}

// ---- to the host -----------------------------------------------------------------------------------------------------------------

static void answer(struct ptp_usb *p)
{
    struct ptp_reply *r = &p->reply;
    const struct ptp_request *q = &p->request;
    p->asked = false;
    ptp_answer(&p->session, q, r);
    if (r->object) {
        const struct body_object *o = body_object(&p->body, r->object);
        if (o && !frame_open(&p->frame, p->scene, &p->body, &o->exposure, o->file)) {
            p->corrupt = o->corrupt;
            p->frame_at = r->offset;
            p->frame_left = r->n;
            put_header(&p->to_host, r->n, CONTAINER_DATA, q->code, q->transaction);
        } else {
            r->code = PTP_GENERAL_ERROR;
            r->n_params = 0;
        }
    } else if (r->has_data) {
        put_header(&p->to_host, r->data.n, CONTAINER_DATA, q->code, q->transaction);
        dataset_bytes(&p->to_host, r->data.data, r->data.n);
    }
    struct dataset *response = p->to_host.n ? &p->response : &p->to_host;
    put_header(response, 4 * (uint64_t)r->n_params, CONTAINER_RESPONSE, r->code, q->transaction);
    for (int i = 0; i < r->n_params; i++)
        dataset_u32(response, r->param[i]);
}

uint64_t ptp_usb_left(const struct ptp_usb *p)
{
    return p->to_host.n - p->sent + p->frame_left;
}

static void next_container(struct ptp_usb *p)
{
    frame_close(p->frame);
    p->frame = NULL;
    dataset_clear(&p->to_host);
    dataset_bytes(&p->to_host, p->response.data, p->response.n);
    dataset_clear(&p->response);
    p->sent = 0;
    p->zero_length_due = false;
}

int ptp_usb_read(struct ptp_usb *p, uint8_t *to, size_t room)
{
    if (p->hung || body_is_silent(&p->body))
        return -EAGAIN;
    if (p->asked)
        answer(p);
    if (p->zero_length_due) {
        next_container(p);
        return 0;
    }
    const uint64_t left = ptp_usb_left(p);
    if (!left)
        return -EAGAIN;
    if (room % PTP_USB_PACKET && left > room)
        return -EOVERFLOW;
    const size_t n = left < room ? (size_t)left : room;
    const size_t n_small = p->to_host.n - p->sent < n ? p->to_host.n - p->sent : n;
    if (n_small)
        memcpy(to, p->to_host.data + p->sent, n_small);
    p->sent += n_small;
    if (n > n_small) {
        frame_read(p->frame, p->frame_at, to + n_small, n - n_small);
        for (size_t i = n_small; p->corrupt && i < n; i += 4099)
            to[i] ^= 0x5a;
        p->frame_at += n - n_small;
        p->frame_left -= n - n_small;
    }
    // A transfer ends with a short packet: after whole ones that filled the host's buffer, an empty one is due.
    if (n == left && (n < room || n % PTP_USB_PACKET))
        next_container(p);
    else if (n == left)
        p->zero_length_due = true;
    return (int)n;
}

int ptp_usb_event(struct ptp_usb *p, uint8_t *to, size_t room)
{
    struct dataset d = { 0 };
    int n = -EAGAIN;
    if (!p->n_events || p->hung || body_is_silent(&p->body))
        return n;
    put_header(&d, 4, CONTAINER_EVENT, p->event[0].code, p->request.transaction);
    dataset_u32(&d, p->event[0].param);
    if (!d.failed && d.n <= room) {
        memcpy(to, d.data, d.n);
        n = (int)d.n;
        memmove(p->event, p->event + 1, (size_t)--p->n_events * sizeof(p->event[0]));
    }
    dataset_free(&d);
    return n;
}

int ptp_usb_class_request(struct ptp_usb *p, uint8_t request, uint8_t *to, size_t room)
{
    switch (request) {
    case REQUEST_CANCEL:
        forget_transfers(p);
        return 0;
    case REQUEST_RESET:
        ptp_usb_reset(p);
        return 0;
    case REQUEST_STATUS: {
        const uint8_t ok[4] = { 4, 0, PTP_OK & 0xff, PTP_OK >> 8 };
        const size_t n = room < sizeof(ok) ? room : sizeof(ok);
        memcpy(to, ok, n);
        return (int)n;
    }
    default:
        return -EPIPE;
    }
}
