// tests/rigsim/dataset.h - PTP datasets (ISO 15740): little-endian numbers, counted arrays, counted UTF-16 strings.
//
// A writer grows as needed; running out of memory is remembered in `failed` and everything after it is dropped, so callers check
// once, at the end. A reader never reads past its bytes: whatever is missing reads as 0 or "" and sets `failed`.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct dataset {
    uint8_t *data;
    size_t n, capacity;
    bool failed;
};

void dataset_bytes(struct dataset *d, const void *bytes, size_t n);
uint8_t *dataset_room(struct dataset *d, size_t n); // n more bytes for the caller to fill; NULL without memory
void dataset_u8(struct dataset *d, uint8_t v);
void dataset_u16(struct dataset *d, uint16_t v);
void dataset_u32(struct dataset *d, uint32_t v);
void dataset_u64(struct dataset *d, uint64_t v);
void dataset_set_u32(struct dataset *d, size_t at, uint32_t v); // overwrite; at + 4 <= n
// UTF-8 in, count (with the ending 0) and UTF-16 out; characters outside the basic plane become '?', over 254 are cut; "" is a
// lone count of 0.
void dataset_string(struct dataset *d, const char *text);
void dataset_array_u16(struct dataset *d, const uint16_t *v, size_t n);
void dataset_array_u32(struct dataset *d, const uint32_t *v, size_t n);
void dataset_clear(struct dataset *d); // keeps the memory
void dataset_free(struct dataset *d);  // leaves it zeroed

struct dataset_reader {
    const uint8_t *data;
    size_t n, at;
    bool failed;
};
uint8_t dataset_read_u8(struct dataset_reader *r);
uint16_t dataset_read_u16(struct dataset_reader *r);
uint32_t dataset_read_u32(struct dataset_reader *r);
uint64_t dataset_read_u64(struct dataset_reader *r);
// Into text[size] as UTF-8, cut to fit at a character's border.
void dataset_read_string(struct dataset_reader *r, char *text, size_t size);
