// rigd/linear.h - from photosites to radiance in linear sRGB, row by row.
//
// radiance = srgb_from_camera x (gain[c] x flat[c](x, y) x daylight[c] x (DN - black) / (white - black)). Nothing is cut off at 0 or at
// white: noise stays unbiased, and what clipped is marked instead. Pure; develop.h gives the frame.
#pragma once
#include "rigd/develop.h"
#include "solver/take/image.h"

// half: each cell of four sites makes one pixel (a last odd row or column is dropped). bilinear: the mean of the nearest sites of a
// colour. AHD: LibRaw's.
enum demosaic { DEMOSAIC_HALF, DEMOSAIC_BILINEAR, DEMOSAIC_AHD };

// ---- which sites are saturated ----
struct saturation {
    int width, height;
    uint64_t *bits;  // [height][(width + 63) / 64]
    int32_t *in_row; // [height] how many
    int64_t n;
};
// Sites at or above level DN. 0, -ENOMEM.
int saturation_of(struct saturation *out, const struct raw_frame *f, double level);
void saturation_free(struct saturation *s); // NULL and zeroed allowed

// ---- vignetting and flat field ----
enum { FLAT_COLUMNS = 64, FLAT_ROWS = 48 };
struct flat {
    float gain[FLAT_ROWS][FLAT_COLUMNS][3]; // per cell and camera channel; 1 is the mean of the middle tenth
};
// From a frame of an even, unclipped white. -EDOM, and why: too dark, or clipped, and where. -EINVAL: smaller than the grid.
int flat_from_frame(struct flat *out, const struct raw_frame *f, const struct saturation *s, char *why, size_t room);
// From a picture of it in linear sRGB, or grey. srgb_from_camera: of the frames that it will be used for.
int flat_from_image(struct flat *out, const struct image *image, const double srgb_from_camera[3][3], char *why, size_t room);
// The gain at u, v (0 .. 1 across the frame); flat NULL: 1.
double flat_at(const struct flat *flat, double u, double v, int c);

// ---- developing ----
struct linear {
    int width, height; // of the result
    const struct raw_frame *frame;      // its sites are not needed for AHD
    const struct raw_rgb *interpolated; // AHD only
    const struct saturation *saturation;
    const struct flat *flat; // NULL: none
    double gain[3];
    enum demosaic demosaic;
    // private
    float *ring[3]; // bilinear: scaled rows
    int ring_y[3];
    float *flat_row;
};
// frame, saturation, flat and interpolated are kept, not copied. 0, -ENOMEM.
int linear_open(struct linear *out, enum demosaic demosaic, const struct raw_frame *frame, const struct raw_rgb *interpolated,
                const struct saturation *saturation, const struct flat *flat, const double gain[3]);
void linear_close(struct linear *l); // zeroed allowed
// For image_write_exr_rows: R, G, B, clip of row y. clip is 1 where the result may have been made from a saturated site: half and bilinear
// exactly the sites that were averaged, AHD those it may have looked at (7 x 7). arg: struct linear.
int linear_row(void *arg, int y, float *rgbc);
