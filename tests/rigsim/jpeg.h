// tests/rigsim/jpeg.h - 8-bit RGB to JPEG.
#pragma once
#include "tests/rigsim/dataset.h"

// Appends a baseline JPEG of rgb[height][width][3], quality 85. 0 or -ENOMEM.
int jpeg_encode(struct dataset *out, const uint8_t *rgb, int width, int height);
