// solver/compare.h - how far two pictures are apart (SOLVER.md 5).
#pragma once
#include "solver/take/image.h"
#include <stdint.h>

struct comparison {
    int64_t n_pixels;       // compared
    double rmse_percent;    // 100 sqrt(mean |a-b|^2 / 3), both clipped to [0,1]
    double rmse_unclipped;  // the same, not clipped, not percent
    double psnr_db;         // of the clipped RMSE; infinite when equal
    double max_abs;         // unclipped
    double clipped_percent; // pixels with a channel of either above 1
};
// R, G, B of two images of one size; mask (optional): pixels with first channel > .5 count. -EINVAL: sizes or channels differ
// (logged), -EDOM: nothing to compare or a value is not finite.
int compare_images(struct comparison *out, const struct image *a, const struct image *b,
                   const struct image *mask);
// Pool several: the RMSE over all their pixels.
void compare_add(struct comparison *total, const struct comparison *one);
