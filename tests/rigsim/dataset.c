// tests/rigsim/dataset.c - see dataset.h. Bytes are put together one by one: no alignment, no byte order of the host.
#include "tests/rigsim/dataset.h"

#include <stdlib.h>
#include <string.h>

uint8_t *dataset_room(struct dataset *d, size_t n)
{
    if (d->failed)
        return NULL;
    if (n > d->capacity - d->n) {
        size_t capacity = d->capacity ? d->capacity : 256;
        while (capacity - d->n < n && capacity < SIZE_MAX / 4)
            capacity *= 2;
        uint8_t *data = capacity - d->n < n ? NULL : realloc(d->data, capacity);
        if (!data) {
            d->failed = true;
            return NULL;
        }
        d->data = data;
        d->capacity = capacity;
    }
    d->n += n;
    return d->data + d->n - n;
}

void dataset_bytes(struct dataset *d, const void *bytes, size_t n)
{
    uint8_t *to = n ? dataset_room(d, n) : NULL;
    if (to)
        memcpy(to, bytes, n);
}

static void put(struct dataset *d, uint64_t v, int n)
{
    uint8_t *to = dataset_room(d, (size_t)n);
    for (int i = 0; to && i < n; i++)
        to[i] = (uint8_t)(v >> 8 * i);
}

void dataset_u8(struct dataset *d, uint8_t v)
{
    put(d, v, 1);
}

void dataset_u16(struct dataset *d, uint16_t v)
{
    put(d, v, 2);
}

void dataset_u32(struct dataset *d, uint32_t v)
{
    put(d, v, 4);
}

void dataset_u64(struct dataset *d, uint64_t v)
{
    put(d, v, 8);
}

void dataset_set_u32(struct dataset *d, size_t at, uint32_t v)
{
    if (d->failed || at + 4 > d->n)
        return;
    for (int i = 0; i < 4; i++)
        d->data[at + (size_t)i] = (uint8_t)(v >> 8 * i);
}

// The next character of UTF-8 text, '?' for what is not UTF-8 or not in the basic plane; 0 at the end.
static uint16_t next_utf16(const unsigned char **text)
{
    const unsigned char *s = *text;
    const int n_more = *s < 0x80 ? 0 : (*s & 0xe0) == 0xc0 ? 1 : (*s & 0xf0) == 0xe0 ? 2 : (*s & 0xf8) == 0xf0 ? 3 : -1;
    uint32_t c = n_more <= 0 ? *s : *s & (0x3fu >> n_more);
    *text = s + (*s != 0);
    for (int i = 1; i <= n_more; i++) {
        if ((s[i] & 0xc0) != 0x80)
            return '?';
        c = c << 6 | (s[i] & 0x3f);
        *text = s + i + 1;
    }
    return n_more < 0 || c > 0xffff || (c >= 0xd800 && c < 0xe000) ? '?' : (uint16_t)c;
}

void dataset_string(struct dataset *d, const char *text)
{
    const size_t at = d->n;
    const unsigned char *s = (const unsigned char *)text;
    unsigned n = 0;
    dataset_u8(d, 0);
    while (*s && n < 254) {
        dataset_u16(d, next_utf16(&s));
        n++;
    }
    if (!n)
        return;
    dataset_u16(d, 0);
    if (!d->failed)
        d->data[at] = (uint8_t)(n + 1);
}

void dataset_array_u16(struct dataset *d, const uint16_t *v, size_t n)
{
    dataset_u32(d, (uint32_t)n);
    for (size_t i = 0; i < n; i++)
        dataset_u16(d, v[i]);
}

void dataset_array_u32(struct dataset *d, const uint32_t *v, size_t n)
{
    dataset_u32(d, (uint32_t)n);
    for (size_t i = 0; i < n; i++)
        dataset_u32(d, v[i]);
}

void dataset_clear(struct dataset *d)
{
    d->n = 0;
    d->failed = false;
}

void dataset_free(struct dataset *d)
{
    free(d->data);
    *d = (struct dataset){ 0 };
}

static uint64_t get(struct dataset_reader *r, size_t n)
{
    if (r->failed || r->n - r->at < n) {
        r->failed = true;
        return 0;
    }
    uint64_t v = 0;
    for (size_t i = 0; i < n; i++)
        v |= (uint64_t)r->data[r->at + i] << 8 * i;
    r->at += n;
    return v;
}

uint8_t dataset_read_u8(struct dataset_reader *r)
{
    return (uint8_t)get(r, 1);
}

uint16_t dataset_read_u16(struct dataset_reader *r)
{
    return (uint16_t)get(r, 2);
}

uint32_t dataset_read_u32(struct dataset_reader *r)
{
    return (uint32_t)get(r, 4);
}

uint64_t dataset_read_u64(struct dataset_reader *r)
{
    return get(r, 8);
}

void dataset_read_string(struct dataset_reader *r, char *text, size_t size)
{
    size_t n = 0;
    bool full = false, ended = false;
    for (unsigned i = dataset_read_u8(r); i; i--) {
        const uint16_t c = dataset_read_u16(r);
        const size_t wide = c < 0x80 ? 1 : c < 0x800 ? 2 : 3;
        ended = ended || !c;
        full = full || n + wide + 1 > size;
        if (ended || full)
            continue;
        if (wide == 1) {
            text[n++] = (char)c;
        } else {
            if (wide == 3)
                text[n++] = (char)(0xe0 | c >> 12);
            text[n++] = (char)(wide == 3 ? 0x80 | (c >> 6 & 0x3f) : 0xc0 | c >> 6);
            text[n++] = (char)(0x80 | (c & 0x3f));
        }
    }
    if (r->failed)
        n = 0;
    if (size)
        text[n] = 0;
}
