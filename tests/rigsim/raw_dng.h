// tests/rigsim/raw_dng.h - a camera's raw file as CFA DNG (Bayer, 16-bit words, uncompressed) whose pixels need not exist.
//
// The file is head, pixels, tail. libtiff makes head and tail from the camera's data; the pixels in between are made by whoever
// reads that range (tests/rigsim/frame.h), so a file of any size takes some kilobytes of memory.
#pragma once
#include <stddef.h>
#include <stdint.h>

struct raw_dng_info {
    int width_px, height_px;
    int black_level, white_level;
    int black_more[4]; // added to black_level at the sites (0,0), (1,0), (0,1), (1,1) of each cell
    uint8_t cfa[4];    // 0 red, 1 green, 2 blue, in the same order; all 0: RGGB
    int orientation;   // EXIF's; 0: 1
    double wb[3]; // response of R, G, B to a white of linear sRGB
    const char *make, *model, *lens, *serial, *firmware;
    double time_s, f_number, focal_mm;
    int iso;
    int64_t utc_ns; // of the exposure, with its sub-seconds
};

struct raw_dng {
    uint8_t *head, *tail;
    size_t n_head, n_tail;
    uint64_t n_pixel_bytes; // width x height x 2, little-endian words
};

// 0, -ENOMEM, -EINVAL (a size that is not 16 .. 20000). The same info always gives the same bytes.
int raw_dng_make(struct raw_dng *out, const struct raw_dng_info *info);
void raw_dng_free(struct raw_dng *d); // leaves it zeroed
