// tests/raw_files.h - simulated raws for tests: a DNG whose photosites a function makes.
#pragma once
#include "tests/rigsim/raw_dng.h"
#include "tests/scratch.h"

#include <string.h>

static inline struct raw_dng_info raw_info(int width_px, int height_px)
{
    return (struct raw_dng_info){ .width_px = width_px, .height_px = height_px, .black_level = 512, .white_level = 16383, .make = "Studiorig", .model = "Simulated camera",
                                  .lens = "SIM 50mm f/2.8", .serial = "10001", .firmware = "1.0", .time_s = 1. / 128, .f_number = 8, .focal_mm = 50, .iso = 100,
                                  .utc_ns = 1700000000123456000, .wb = { .55, 1, .7 } };
}

static inline void raw_write(const char *path, const struct raw_dng_info *info, uint16_t (*site)(void *arg, int x, int y), void *arg)
{
    struct raw_dng d;
    FILE *f = fopen(path, "wb");
    uint16_t *row = malloc((size_t)info->width_px * sizeof(*row));
    assert_non_null(f);
    assert_non_null(row);
    assert_int_equal(raw_dng_make(&d, info), 0);
    assert_int_equal(fwrite(d.head, 1, d.n_head, f), d.n_head);
    for (int y = 0; y < info->height_px; y++) {
        for (int x = 0; x < info->width_px; x++)
            row[x] = site(arg, x, y);
        assert_int_equal(fwrite(row, sizeof(*row), (size_t)info->width_px, f), info->width_px);
    }
    assert_int_equal(fwrite(d.tail, 1, d.n_tail, f), d.n_tail);
    assert_int_equal(fclose(f), 0);
    free(row);
    raw_dng_free(&d);
}

// Any value from 400 (below black) to white, named by its site: what a decoder must not lose.
static inline uint16_t raw_scatter(void *arg, int x, int y)
{
    const uint32_t seed = arg ? *(const uint32_t *)arg : 1, mixed = (seed + 7919u * (uint32_t)y + (uint32_t)x) * 2654435761u;
    const uint32_t v = 400 + (mixed >> 16) % 16384;
    return (uint16_t)(v > 16383 ? 16383 : v);
}
