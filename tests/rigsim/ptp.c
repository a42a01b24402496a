// tests/rigsim/ptp.c - see ptp.h. The standard operations; the vendors' are in ptp_nikon.c and ptp_canon.c.
#include "tests/rigsim/ptp.h"
#include "tests/rigsim/ptp_datasets.h"
#include "tests/rigsim/ptp_vendor.h"

#include <string.h>

enum operation {
    GET_DEVICE_INFO = 0x1001, OPEN_SESSION, CLOSE_SESSION, GET_STORAGE_IDS, GET_STORAGE_INFO, GET_NUM_OBJECTS, GET_OBJECT_HANDLES,
    GET_OBJECT_INFO, GET_OBJECT, GET_THUMB, DELETE_OBJECT, INITIATE_CAPTURE = 0x100e, FORMAT_STORE,
    GET_PROPERTY_DESC = 0x1014, GET_PROPERTY, SET_PROPERTY, GET_PARTIAL_OBJECT = 0x101b
};
enum { EVENT_OBJECT_ADDED = 0x4002, EVENT_OBJECT_REMOVED = 0x4003, EVENT_PROPERTY_CHANGED = 0x4006, EVENT_STORE_FULL = 0x400a,
       EVENT_CAPTURE_COMPLETE = 0x400d };
#define ALL UINT32_MAX

void ptp_session_init(struct ptp_session *s, struct body *body)
{
    *s = (struct ptp_session){ .body = body };
}

void ptp_session_reset(struct ptp_session *s)
{
    s->open = false;
    s->n_events = 0;
    s->eos_remote = s->eos_event_mode = 0;
    s->eos_all_told = false;
}

void ptp_queue_event(struct ptp_session *s, uint16_t code, uint32_t param)
{
    if (s->n_events == PTP_EVENT_QUEUE_MAX)
        memmove(s->event, s->event + 1, (size_t)--s->n_events * sizeof(s->event[0]));
    s->event[s->n_events++] = (struct ptp_event){ code, param };
}

int ptp_find_property(const struct ptp_session *s, uint32_t code)
{
    for (int i = 0; i < s->body->personality->n_properties; i++)
        if (s->body->personality->property[i].code == code)
            return i;
    return -1;
}

void ptp_send_object(struct ptp_session *s, uint32_t handle, uint64_t offset, uint64_t n, struct ptp_reply *reply)
{
    const struct body_object *o = body_object(s->body, handle);
    if (!o || !o->file || offset > o->told) {
        reply->code = !o || !o->file ? PTP_INVALID_HANDLE : PTP_INVALID_PARAMETER;
        return;
    }
    reply->object = handle;
    reply->offset = offset;
    reply->n = n < o->told - offset ? n : o->told - offset;
    reply->has_data = true;
    reply->n_params = 1;
    reply->param[0] = (uint32_t)reply->n;
}

void ptp_send_thumbnail(struct ptp_session *s, uint32_t handle, struct ptp_reply *reply)
{
    const struct body_object *o = body_object(s->body, handle);
    if (!o || !o->file)
        reply->code = PTP_INVALID_HANDLE;
    else if (!s->thumbnail || s->thumbnail(s->arg, s->body, o, &reply->data))
        reply->code = PTP_NO_THUMBNAIL;
    else
        reply->has_data = true;
}

// Clients take a thumbnail of 0 bytes for none: its size must be known here.
void ptp_send_object_info(struct ptp_session *s, uint32_t handle, struct ptp_reply *reply)
{
    struct body_object *o = body_object(s->body, handle);
    if (!o) {
        reply->code = PTP_INVALID_HANDLE;
        return;
    }
    if (o->file && !o->thumbnail_bytes && s->thumbnail && !s->thumbnail(s->arg, s->body, o, &reply->data))
        o->thumbnail_bytes = (uint32_t)reply->data.n;
    dataset_clear(&reply->data);
    ptp_put_object_info(&reply->data, s->body, o, s->width_px, s->height_px);
    reply->has_data = true;
}

static bool is_in(const struct body_object *o, uint32_t format, uint32_t parent)
{
    if (o->in_ram || (format && format != ALL && format != o->format))
        return false;
    return !parent || (parent == ALL ? !o->parent : o->parent == parent);
}

static void list_objects(struct ptp_session *s, const struct ptp_request *q, struct ptp_reply *reply)
{
    const struct body *b = s->body;
    const uint32_t storage = q->param[0], format = q->param[1], parent = q->param[2];
    if (storage && storage != ALL && storage != b->personality->storage) {
        reply->code = PTP_INVALID_STORAGE;
        return;
    }
    if (parent && parent != ALL && !body_object(b, parent)) {
        reply->code = PTP_INVALID_HANDLE;
        return;
    }
    uint32_t n = 0;
    for (int i = 0; i < b->n_objects; i++)
        n += is_in(&b->object[i], format, parent);
    if (q->code == GET_NUM_OBJECTS) {
        reply->n_params = 1;
        reply->param[0] = n;
        return;
    }
    dataset_u32(&reply->data, n);
    for (int i = 0; i < b->n_objects; i++)
        if (is_in(&b->object[i], format, parent))
            dataset_u32(&reply->data, b->object[i].handle);
    reply->has_data = true;
}

static uint16_t delete_objects(struct ptp_session *s, uint32_t handle)
{
    struct body *b = s->body;
    if (handle != ALL)
        return body_delete(b, handle);
    for (int i = b->n_objects; i--;)
        if (b->object[i].file)
            body_delete(b, b->object[i].handle);
    return PTP_OK;
}

static void property(struct ptp_session *s, const struct ptp_request *q, struct ptp_reply *reply)
{
    const int i = ptp_find_property(s, q->param[0]);
    if (i < 0) {
        reply->code = PTP_NO_SUCH_PROPERTY;
        return;
    }
    const struct property *p = &s->body->personality->property[i];
    char text[BODY_TEXT_MAX];
    if (q->code == SET_PROPERTY) {
        struct dataset_reader r = { q->data, q->n_data, 0, false };
        int64_t value;
        reply->code = ptp_get_value(&r, p->type, &value, text) ? body_set(s->body, i, value, text) : PTP_BAD_FORMAT;
        return;
    }
    if (q->code == GET_PROPERTY_DESC) {
        ptp_put_property(&reply->data, s->body, i);
    } else {
        body_value_text(s->body, i, text);
        ptp_put_value(&reply->data, p->type, body_value(s->body, i), text);
    }
    reply->has_data = true;
}

static void standard(struct ptp_session *s, const struct ptp_request *q, struct ptp_reply *reply)
{
    struct body *b = s->body;
    const struct personality *p = b->personality;
    switch (q->code) {
    case GET_DEVICE_INFO:
        ptp_put_device_info(&reply->data, b);
        reply->has_data = true;
        return;
    case OPEN_SESSION:
        if (!q->param[0])
            reply->code = PTP_INVALID_PARAMETER;
        else if (s->open)
            reply->code = PTP_SESSION_ALREADY_OPEN;
        s->open = s->open || q->param[0];
        return;
    case CLOSE_SESSION:
        ptp_session_reset(s);
        return;
    case GET_STORAGE_IDS:
        dataset_array_u32(&reply->data, &p->storage, 1);
        reply->has_data = true;
        return;
    case GET_STORAGE_INFO:
        if (q->param[0] != p->storage) {
            reply->code = PTP_INVALID_STORAGE;
            return;
        }
        ptp_put_storage_info(&reply->data, b);
        reply->has_data = true;
        return;
    case GET_NUM_OBJECTS:
    case GET_OBJECT_HANDLES:
        list_objects(s, q, reply);
        return;
    case GET_OBJECT_INFO:
        ptp_send_object_info(s, q->param[0], reply);
        return;
    case GET_OBJECT:
        ptp_send_object(s, q->param[0], 0, UINT64_MAX, reply);
        reply->n_params = 0;
        return;
    case GET_PARTIAL_OBJECT:
        ptp_send_object(s, q->param[0], q->param[1], q->param[2], reply);
        return;
    case GET_THUMB:
        ptp_send_thumbnail(s, q->param[0], reply);
        return;
    case DELETE_OBJECT:
        reply->code = delete_objects(s, q->param[0]);
        return;
    case FORMAT_STORE:
        reply->code = q->param[0] == p->storage ? delete_objects(s, ALL) : PTP_INVALID_STORAGE;
        return;
    case INITIATE_CAPTURE:
        reply->code = body_release(b, false);
        return;
    case GET_PROPERTY_DESC:
    case GET_PROPERTY:
    case SET_PROPERTY:
        property(s, q, reply);
        return;
    default:
        reply->code = PTP_NOT_SUPPORTED;
        return;
    }
}

static bool is_listed(const struct code_list *list, uint16_t code)
{
    for (int i = 0; i < list->n; i++)
        if (list->code[i] == code)
            return true;
    return false;
}

void ptp_answer(struct ptp_session *s, const struct ptp_request *q, struct ptp_reply *reply)
{
    struct body *b = s->body;
    const struct personality *p = b->personality;
    const bool any_time = q->code == GET_DEVICE_INFO || q->code == OPEN_SESSION || q->code == CLOSE_SESSION;
    struct dataset kept = reply->data;
    dataset_clear(&kept);
    *reply = (struct ptp_reply){ .code = PTP_OK, .data = kept };
    body_touch(b);
    if (!is_listed(&p->operations, q->code))
        reply->code = PTP_NOT_SUPPORTED;
    else if (!s->open && q->code != GET_DEVICE_INFO && q->code != OPEN_SESSION)
        reply->code = PTP_SESSION_NOT_OPEN;
    else if (!any_time && b->faults.busy_until_ns > b->now_ns)
        reply->code = PTP_BUSY;
    else if (!(p->vendor == VENDOR_NIKON && ptp_nikon_answer(s, q, reply)) &&
             !(p->vendor == VENDOR_CANON && ptp_canon_answer(s, q, reply)))
        standard(s, q, reply);
    if (reply->data.failed)
        reply->code = PTP_GENERAL_ERROR;
    if (reply->code != PTP_OK) {
        reply->has_data = false;
        reply->object = 0;
        reply->n_params = 0;
    }
}

bool ptp_notice(struct ptp_session *s, const struct body_event *event, struct ptp_event *out)
{
    static const uint16_t standard_code[] = {
        [BODY_OBJECT_ADDED] = EVENT_OBJECT_ADDED,
        [BODY_OBJECT_REMOVED] = EVENT_OBJECT_REMOVED,
        [BODY_CAPTURE_COMPLETE] = EVENT_CAPTURE_COMPLETE,
        [BODY_STORE_FULL] = EVENT_STORE_FULL,
        [BODY_PROPERTY_CHANGED] = EVENT_PROPERTY_CHANGED,
    };
    if (event->kind == BODY_EXPOSED || !s->open)
        return false;
    *out = (struct ptp_event){ standard_code[event->kind], event->value };
    if (s->body->personality->vendor == VENDOR_GENERIC)
        return true;
    if (s->body->personality->vendor == VENDOR_NIKON) {
        const struct body_object *o = body_object(s->body, event->value);
        if (event->kind == BODY_OBJECT_ADDED && o && o->in_ram)
            out->code = 0xc101; // ObjectAddedInSDRAM
        else if (event->kind == BODY_CAPTURE_COMPLETE && event->value)
            out->code = 0xc102; // CaptureCompleteRecInSdram
    }
    // Canon's queue holds standard codes too; they become its records when they are fetched.
    ptp_queue_event(s, out->code, out->param);
    return false;
}
