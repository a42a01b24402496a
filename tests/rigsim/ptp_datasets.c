// tests/rigsim/ptp_datasets.c - DeviceInfo, StorageInfo, ObjectInfo, DevicePropDesc of a body (ISO 15740, 5).
#include "tests/rigsim/ptp_datasets.h"

#include <string.h>
#include <time.h>

enum { STANDARD_VERSION = 100, FUNCTIONAL_MODE = 0, THUMB_FORMAT = 0x3808, THUMB_WIDTH = 160 };

void ptp_put_value(struct dataset *d, enum property_type type, int64_t value, const char *text)
{
    switch (type) {
    case TYPE_I8:
    case TYPE_U8:
        dataset_u8(d, (uint8_t)value);
        return;
    case TYPE_I16:
    case TYPE_U16:
        dataset_u16(d, (uint16_t)value);
        return;
    case TYPE_I32:
    case TYPE_U32:
        dataset_u32(d, (uint32_t)value);
        return;
    case TYPE_I64:
    case TYPE_U64:
        dataset_u64(d, (uint64_t)value);
        return;
    case TYPE_STR:
        dataset_string(d, text);
        return;
    }
}

bool ptp_get_value(struct dataset_reader *r, enum property_type type, int64_t *value, char text[BODY_TEXT_MAX])
{
    *value = 0;
    text[0] = 0;
    switch (type) {
    case TYPE_I8:
        *value = (int8_t)dataset_read_u8(r);
        break;
    case TYPE_U8:
        *value = dataset_read_u8(r);
        break;
    case TYPE_I16:
        *value = (int16_t)dataset_read_u16(r);
        break;
    case TYPE_U16:
        *value = dataset_read_u16(r);
        break;
    case TYPE_I32:
        *value = (int32_t)dataset_read_u32(r);
        break;
    case TYPE_U32:
        *value = dataset_read_u32(r);
        break;
    case TYPE_I64:
    case TYPE_U64:
        *value = (int64_t)dataset_read_u64(r);
        break;
    case TYPE_STR:
        dataset_read_string(r, text, BODY_TEXT_MAX);
        break;
    }
    return !r->failed && r->at == r->n;
}

// PTP's standard properties go into DeviceInfo; Nikon's own (0xd...) are asked for apart, Canon EOS's by events.
bool ptp_is_listed(const struct personality *p, uint16_t property)
{
    return p->vendor == VENDOR_GENERIC || property < 0xd000 || (p->vendor == VENDOR_CANON && property >= 0xd400);
}

void ptp_put_device_info(struct dataset *d, const struct body *b)
{
    const struct personality *p = b->personality;
    uint16_t property[PERSONALITY_PROPERTIES_MAX];
    size_t n = 0;
    for (int i = 0; i < p->n_properties; i++)
        if (ptp_is_listed(p, p->property[i].code))
            property[n++] = p->property[i].code;
    dataset_u16(d, STANDARD_VERSION);
    dataset_u32(d, p->extension);
    dataset_u16(d, p->extension_version);
    dataset_string(d, p->extension_text);
    dataset_u16(d, FUNCTIONAL_MODE);
    dataset_array_u16(d, p->operations.code, (size_t)p->operations.n);
    dataset_array_u16(d, p->events.code, (size_t)p->events.n);
    dataset_array_u16(d, property, n);
    dataset_array_u16(d, p->capture_formats.code, (size_t)p->capture_formats.n);
    dataset_array_u16(d, p->object_formats.code, (size_t)p->object_formats.n);
    dataset_string(d, p->manufacturer);
    dataset_string(d, p->model);
    dataset_string(d, p->firmware);
    dataset_string(d, b->serial);
}

void ptp_put_storage_info(struct dataset *d, const struct body *b)
{
    dataset_u16(d, 4); // removable RAM
    dataset_u16(d, 3); // DCF
    dataset_u16(d, 2); // read-only with deletion
    dataset_u64(d, (uint64_t)b->personality->card_bytes);
    dataset_u64(d, body_card_free(b));
    dataset_u32(d, body_free_images(b));
    dataset_string(d, "");
    dataset_string(d, "SIMCARD");
}

static void put_time(struct dataset *d, int64_t utc_ns)
{
    char text[32];
    const time_t t = (time_t)(utc_ns / 1000000000);
    struct tm tm;
    gmtime_r(&t, &tm);
    strftime(text, sizeof(text), "%Y%m%dT%H%M%S", &tm);
    dataset_string(d, text);
}

void ptp_put_object_info(struct dataset *d, const struct body *b, const struct body_object *o, uint32_t width_px,
                         uint32_t height_px)
{
    dataset_u32(d, o->in_ram ? 0 : b->personality->storage);
    dataset_u16(d, o->format);
    dataset_u16(d, 0); // no protection
    dataset_u32(d, (uint32_t)o->told);
    dataset_u16(d, o->file ? THUMB_FORMAT : 0);
    dataset_u32(d, o->thumbnail_bytes);
    dataset_u32(d, o->file ? THUMB_WIDTH : 0);
    dataset_u32(d, o->file ? THUMB_WIDTH * height_px / width_px : 0);
    dataset_u32(d, o->file ? width_px : 0);
    dataset_u32(d, o->file ? height_px : 0);
    dataset_u32(d, o->file == FILES_RAW ? 14 : o->file ? 24 : 0);
    dataset_u32(d, o->parent);
    dataset_u16(d, o->file ? 0 : 1); // folder: generic
    dataset_u32(d, 0);
    dataset_u32(d, o->exposure.shot);
    dataset_string(d, o->name);
    if (o->file) {
        put_time(d, o->exposure.utc_ns);
        put_time(d, o->exposure.utc_ns);
    } else {
        dataset_string(d, "");
        dataset_string(d, "");
    }
    dataset_string(d, "");
}

void ptp_put_property(struct dataset *d, const struct body *b, int property)
{
    const struct property *q = &b->personality->property[property];
    char text[BODY_TEXT_MAX];
    body_value_text(b, property, text);
    dataset_u16(d, q->code);
    dataset_u16(d, (uint16_t)q->type);
    dataset_u8(d, q->writable);
    ptp_put_value(d, q->type, q->initial, q->initial_text);
    ptp_put_value(d, q->type, body_value(b, property), text);
    dataset_u8(d, (uint8_t)q->form);
    if (q->form == FORM_RANGE) {
        ptp_put_value(d, q->type, q->min, "");
        ptp_put_value(d, q->type, q->max, "");
        ptp_put_value(d, q->type, q->step, "");
    } else if (q->form == FORM_ENUM) {
        dataset_u16(d, (uint16_t)q->n_choices);
        for (int i = 0; i < q->n_choices; i++)
            ptp_put_value(d, q->type, q->choice[i], q->type == TYPE_STR ? q->texts + q->choice[i] : "");
    }
}
