// tests/rigsim/ptp_canon.c - Canon EOS's own operations: remote release, properties and files told by one stream of records.
//
// A client sets the event mode and then polls 0x9116. The first answer tells every property and its choices, later ones what has
// changed. A record is size (u32, itself included), type (u32), body; 8, 0 ends the list.
#include "tests/rigsim/ptp_datasets.h"
#include "tests/rigsim/ptp_vendor.h"

#include <string.h>

enum canon_operation {
    GET_STORAGE_IDS = 0x9101, GET_STORAGE_INFO, GET_OBJECT_INFO, GET_OBJECT, DELETE_OBJECT, GET_PARTIAL_OBJECT = 0x9107,
    GET_OBJECT_INFO_EX = 0x9109, GET_THUMB_EX, REMOTE_RELEASE = 0x910f, SET_PROPERTY_EX, SET_REMOTE_MODE = 0x9114, SET_EVENT_MODE,
    GET_EVENT, TRANSFER_COMPLETE, PC_CAPACITY = 0x911a, SET_UI_LOCK, RESET_UI_LOCK, KEEP_DEVICE_ON,
    REQUEST_PROPERTY = 0x9127, RELEASE_ON, RELEASE_OFF, START_VIEWFINDER = 0x9151, END_VIEWFINDER
};
enum canon_record {
    RECORD_OBJECT_ADDED = 0xc181, RECORD_OBJECT_REMOVED = 0xc182, RECORD_REQUEST_TRANSFER = 0xc186,
    RECORD_PROPERTY = 0xc189, RECORD_CHOICES = 0xc18a, RECORD_CAMERA_STATUS = 0xc18b
};
enum { FULL = 2, TARGET_HOST = 4, ENTRY_BYTES = 56, NAME_BYTES = 16 };

static size_t begin(struct dataset *d, uint32_t type)
{
    const size_t at = d->n;
    dataset_u32(d, 0);
    dataset_u32(d, type);
    return at;
}

static void end(struct dataset *d, size_t at)
{
    dataset_set_u32(d, at, (uint32_t)(d->n - at));
}

// A value of the format property has four nibbles: size and compression (8: raw) of the first file, then of the second. On the wire
// it is a list: files, and for each 16 bytes: kind (1 JPEG, 6 raw), size, compression.
static void put_format(struct dataset *d, int64_t v)
{
    const int n = v & 0xff ? 2 : 1;
    dataset_u32(d, (uint32_t)n);
    for (int i = 0; i < n; i++) {
        const uint32_t file = (uint32_t)(v >> (8 - 8 * i)) & 0xff;
        dataset_u32(d, 16);
        dataset_u32(d, file & 8 ? 6 : 1);
        dataset_u32(d, file >> 4);
        dataset_u32(d, file & 7);
    }
}

static int64_t get_format(struct dataset_reader *r)
{
    int64_t v = 0;
    const uint32_t n = dataset_read_u32(r);
    for (uint32_t i = 0; i < n && i < 2; i++) {
        dataset_read_u32(r);
        const uint32_t kind = dataset_read_u32(r), size = dataset_read_u32(r), compression = dataset_read_u32(r);
        v |= (int64_t)((size & 15) << 4 | (kind == 6 ? 8 : 0) | (compression & 7)) << (8 - 8 * i);
    }
    return v;
}

static int64_t current_target(const struct ptp_session *s)
{
    const struct personality *p = s->body->personality;
    for (int i = 0; i < p->n_properties; i++)
        if (p->property[i].role == ROLE_TARGET)
            return body_value(s->body, i);
    return 0;
}

static void put_property(const struct ptp_session *s, struct dataset *d, int i)
{
    const struct property *q = &s->body->personality->property[i];
    const size_t at = begin(d, RECORD_PROPERTY);
    dataset_u32(d, q->code);
    if (q->role == ROLE_FORMAT) {
        put_format(d, body_value(s->body, i));
    } else if (q->type == TYPE_STR) {
        char text[BODY_TEXT_MAX];
        body_value_text(s->body, i, text);
        dataset_bytes(d, text, strlen(text) + 1);
    } else if (q->role == ROLE_FREE_IMAGES && current_target(s) == TARGET_HOST) {
        dataset_u32(d, BODY_OBJECTS_MAX); // the host has said that it has room
    } else {
        dataset_u32(d, (uint32_t)body_value(s->body, i));
    }
    end(d, at);
}

static void put_choices(const struct ptp_session *s, struct dataset *d, int i)
{
    const struct property *q = &s->body->personality->property[i];
    if (q->form != FORM_ENUM || q->type == TYPE_STR)
        return;
    const size_t at = begin(d, RECORD_CHOICES);
    dataset_u32(d, q->code);
    dataset_u32(d, 3); // enumeration
    dataset_u32(d, (uint32_t)q->n_choices);
    for (int k = 0; k < q->n_choices; k++) {
        if (q->role == ROLE_FORMAT)
            put_format(d, q->choice[k]);
        else
            dataset_u32(d, (uint32_t)q->choice[k]);
    }
    end(d, at);
}

static void put_file(const struct ptp_session *s, struct dataset *d, uint32_t handle)
{
    const struct body_object *o = body_object(s->body, handle);
    if (!o)
        return;
    const size_t at = begin(d, o->in_ram ? RECORD_REQUEST_TRANSFER : RECORD_OBJECT_ADDED);
    dataset_u32(d, o->handle);
    if (!o->in_ram)
        dataset_u32(d, s->body->personality->storage);
    dataset_u32(d, o->format);
    dataset_u32(d, 0);
    if (!o->in_ram)
        dataset_u32(d, 0);
    dataset_u32(d, (uint32_t)o->told);
    dataset_u32(d, o->parent);
    if (!o->in_ram)
        dataset_u32(d, 0);
    dataset_bytes(d, o->name, strlen(o->name) + 1);
    end(d, at);
}

static void events(struct ptp_session *s, struct dataset *d)
{
    if (s->eos_event_mode && !s->eos_all_told) {
        for (int i = 0; i < s->body->personality->n_properties; i++)
            if (!ptp_is_listed(s->body->personality, s->body->personality->property[i].code)) {
                put_property(s, d, i);
                put_choices(s, d, i);
            }
        s->eos_all_told = true;
    }
    for (int i = 0; i < s->n_events; i++) {
        const struct ptp_event *e = &s->event[i];
        const int property = ptp_find_property(s, e->param);
        size_t at;
        switch (e->code) {
        case 0x4002:
            put_file(s, d, e->param);
            break;
        case 0x4003:
            at = begin(d, RECORD_OBJECT_REMOVED);
            dataset_u32(d, e->param);
            end(d, at);
            break;
        case 0x4006:
            if (property >= 0)
                put_property(s, d, property);
            break;
        case 0x400d:
        case RECORD_CAMERA_STATUS:
            at = begin(d, RECORD_CAMERA_STATUS);
            dataset_u32(d, e->code == RECORD_CAMERA_STATUS ? e->param : 0);
            end(d, at);
            break;
        }
    }
    s->n_events = 0;
    dataset_u32(d, 8);
    dataset_u32(d, 0);
}

static void list_folder(struct ptp_session *s, const struct ptp_request *q, struct ptp_reply *reply)
{
    const struct body *b = s->body;
    const uint32_t parent = q->param[1] == UINT32_MAX ? 0 : q->param[1];
    uint32_t n = 0;
    if (parent && !body_object(b, parent)) {
        reply->code = PTP_INVALID_HANDLE;
        return;
    }
    dataset_u32(&reply->data, 0);
    for (int i = 0; i < b->n_objects; i++) {
        const struct body_object *o = &b->object[i];
        char name[NAME_BYTES] = { 0 };
        if (o->in_ram || o->parent != parent)
            continue;
        memcpy(name, o->name, strnlen(o->name, NAME_BYTES - 1));
        dataset_u32(&reply->data, ENTRY_BYTES);
        dataset_u32(&reply->data, o->handle);
        dataset_u32(&reply->data, b->personality->storage);
        dataset_u32(&reply->data, o->format);
        dataset_u32(&reply->data, 0);
        dataset_u32(&reply->data, 0); // flags
        dataset_u32(&reply->data, (uint32_t)o->told);
        dataset_u32(&reply->data, 0);
        dataset_u32(&reply->data, o->parent);
        dataset_bytes(&reply->data, name, NAME_BYTES);
        dataset_u32(&reply->data, (uint32_t)(o->exposure.utc_ns / 1000000000));
        n++;
    }
    dataset_set_u32(&reply->data, 0, n);
    reply->has_data = true;
}

static uint16_t set_property(struct ptp_session *s, const struct ptp_request *q)
{
    struct dataset_reader r = { q->data, q->n_data, 0, false };
    char text[BODY_TEXT_MAX] = { 0 };
    const uint32_t size = dataset_read_u32(&r), code = dataset_read_u32(&r);
    const int i = ptp_find_property(s, code);
    int64_t value = 0;
    if (r.failed || size != q->n_data)
        return PTP_BAD_FORMAT;
    if (i < 0)
        return PTP_NO_SUCH_PROPERTY;
    const struct property *p = &s->body->personality->property[i];
    if (p->role == ROLE_FORMAT) {
        value = get_format(&r);
    } else if (p->type == TYPE_STR) {
        const size_t n = q->n_data - r.at;
        memcpy(text, q->data + r.at, n < sizeof(text) - 1 ? n : sizeof(text) - 1);
    } else {
        value = dataset_read_u32(&r);
    }
    if (r.failed)
        return PTP_BAD_FORMAT;
    const uint16_t done = body_set(s->body, i, value, text);
    if (done == PTP_OK)
        ptp_queue_event(s, 0x4006, code);
    return done;
}

static uint16_t release(struct ptp_session *s)
{
    const uint16_t done = body_release(s->body, current_target(s) == TARGET_HOST);
    if (done == PTP_OK)
        ptp_queue_event(s, RECORD_CAMERA_STATUS, 1);
    return done;
}

bool ptp_canon_answer(struct ptp_session *s, const struct ptp_request *q, struct ptp_reply *reply)
{
    struct body *b = s->body;
    switch (q->code) {
    case GET_STORAGE_IDS:
        dataset_array_u32(&reply->data, &b->personality->storage, 1);
        reply->has_data = true;
        return true;
    case GET_STORAGE_INFO:
        ptp_put_storage_info(&reply->data, b);
        reply->has_data = true;
        return true;
    case GET_OBJECT:
        ptp_send_object(s, q->param[0], 0, UINT64_MAX, reply);
        return true;
    case GET_PARTIAL_OBJECT:
        ptp_send_object(s, q->param[0], q->param[1], q->param[2], reply);
        return true;
    case GET_THUMB_EX:
        ptp_send_thumbnail(s, q->param[0], reply);
        return true;
    case GET_OBJECT_INFO:
        ptp_send_object_info(s, q->param[0], reply);
        return true;
    case DELETE_OBJECT:
        reply->code = body_delete(b, q->param[0]);
        return true;
    case GET_OBJECT_INFO_EX:
        list_folder(s, q, reply);
        return true;
    case SET_PROPERTY_EX:
        reply->code = set_property(s, q);
        return true;
    case SET_REMOTE_MODE:
        s->eos_remote = q->param[0];
        return true;
    case SET_EVENT_MODE:
        s->eos_event_mode = q->param[0];
        s->eos_all_told = false;
        return true;
    case GET_EVENT:
        events(s, &reply->data);
        reply->has_data = true;
        return true;
    case TRANSFER_COMPLETE: {
        const struct body_object *o = body_object(b, q->param[0]);
        reply->code = o ? PTP_OK : PTP_INVALID_HANDLE;
        if (o && o->in_ram)
            body_delete(b, q->param[0]);
        return true;
    }
    case PC_CAPACITY:
    case SET_UI_LOCK:
    case RESET_UI_LOCK:
    case KEEP_DEVICE_ON:
    case START_VIEWFINDER: // there are no pictures of it: 0x9153 is announced, and refused
    case END_VIEWFINDER:
        return true;
    case REQUEST_PROPERTY:
        if (ptp_find_property(s, q->param[0]) < 0)
            reply->code = PTP_GENERAL_ERROR;
        else
            ptp_queue_event(s, 0x4006, q->param[0]);
        return true;
    case REMOTE_RELEASE:
        reply->code = release(s);
        reply->n_params = 1;
        return true;
    case RELEASE_ON: // over the wire a half-press only wakes: nothing is silent then
        if (!s->eos_remote)
            reply->code = PTP_ACCESS_DENIED;
        else if (q->param[0] & FULL)
            reply->code = release(s);
        return true;
    case RELEASE_OFF:
        return true;
    default:
        return false;
    }
}
