// solver/take/image_formats.h - what image*.c share: one decoder per format, each over a file that
// lies in memory.
//
// Private to image*.c, their tests and the fuzzers.
#pragma once
#include "solver/take/image.h"
#include <stddef.h>

// A file in memory; name is for messages.
struct image_file {
    const uint8_t *bytes;
    size_t n_bytes;
    const char *name;
};

// image_read over memory: knows the format by content.
int image_read_memory(struct image *out, const struct image_file *file);

int image_read_exr(struct image *out, const struct image_file *file);
int image_read_hdr(struct image *out, const struct image_file *file);
int image_read_jpeg(struct image *out, const struct image_file *file); // values / 255, no curve
int image_read_png(struct image *out, const struct image_file *file);
int image_read_tiff(struct image *out, const struct image_file *file);

// 0, or -EINVAL / -EFBIG (logged) if a header asks for more than image.h allows. stored_bytes: of
// one pixel, all channels, as the file stores it before compression. To be called before anything
// of that size is allocated.
int image_check_size(const struct image_file *file, int64_t width, int64_t height, int n_channels,
                     int stored_bytes);

// image_new for a reader that checked the size: -ENOMEM is logged.
int image_new_for(struct image *out, const struct image_file *file, int width, int height,
                  int n_channels, const char *const *names);
