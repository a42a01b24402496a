// tests/rigsim/ptp_nikon.c - Nikon's own operations: releases to card and to RAM, readiness, fetched events.
#include "tests/rigsim/ptp_vendor.h"

#include <string.h>

enum nikon_operation {
    CAPTURE_IN_RAM = 0x90c0, AF_DRIVE, CHANGE_CAMERA_MODE, DELETE_RAM_IMAGE, GET_LARGE_THUMB, GET_EVENT = 0x90c7, DEVICE_READY,
    GET_VENDOR_PROPERTIES = 0x90ca, AF_CAPTURE_IN_RAM, START_LIVE_VIEW = 0x9201, END_LIVE_VIEW, CAPTURE_IN_MEDIA = 0x9207
};

enum { LIVE_VIEW_STATUS = 0xd1a2 };

static uint16_t delete_ram(struct body *b, uint32_t handle)
{
    uint16_t code = handle ? PTP_INVALID_HANDLE : PTP_OK;
    for (int i = b->n_objects; i--;)
        if (b->object[i].in_ram && (!handle || b->object[i].handle == handle))
            code = body_delete(b, b->object[i].handle);
    return code;
}

// Mirror and display only: there are no pictures of it.
static void show_live_view(struct body *b, bool on)
{
    for (int i = 0; i < b->personality->n_properties; i++)
        if (b->personality->property[i].code == LIVE_VIEW_STATUS)
            b->value[i] = on;
}

bool ptp_nikon_answer(struct ptp_session *s, const struct ptp_request *q, struct ptp_reply *reply)
{
    struct body *b = s->body;
    const struct personality *p = b->personality;
    switch (q->code) {
    case CAPTURE_IN_RAM:
    case AF_CAPTURE_IN_RAM:
        reply->code = body_release(b, true);
        return true;
    case CAPTURE_IN_MEDIA:
        reply->code = body_release(b, q->n_params > 1 && q->param[1] == 1);
        return true;
    case AF_DRIVE:
    case CHANGE_CAMERA_MODE:
        return true;
    case START_LIVE_VIEW:
    case END_LIVE_VIEW:
        show_live_view(b, q->code == START_LIVE_VIEW);
        return true;
    case DELETE_RAM_IMAGE:
        reply->code = delete_ram(b, q->param[0]);
        return true;
    case GET_LARGE_THUMB:
        ptp_send_thumbnail(s, q->param[0], reply);
        return true;
    case DEVICE_READY: // not while a shutter is open
        reply->code = b->n_in_work && b->now_ns < b->ready_ns ? PTP_BUSY : PTP_OK;
        return true;
    case GET_EVENT:
        dataset_u16(&reply->data, (uint16_t)s->n_events);
        for (int i = 0; i < s->n_events; i++) {
            dataset_u16(&reply->data, s->event[i].code);
            dataset_u32(&reply->data, s->event[i].param);
        }
        s->n_events = 0;
        reply->has_data = true;
        return true;
    case GET_VENDOR_PROPERTIES: {
        uint16_t code[PERSONALITY_PROPERTIES_MAX];
        size_t n = 0;
        for (int i = 0; i < p->n_properties; i++)
            if (p->property[i].code >= 0xd000)
                code[n++] = p->property[i].code;
        dataset_array_u16(&reply->data, code, n);
        reply->has_data = true;
        return true;
    }
    default:
        return false;
    }
}
