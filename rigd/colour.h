// rigd/colour.h - one radiometric space: three gains and one scale per body, from a grey card or a chart that all of them saw.
//
// A card of matt paper sends the same radiance to every camera. What a body measures of it differs by its sensor, filters, lens, aperture and
// shutter; gains in the camera's own channels take that off, so that all bodies agree with the rig's median (or with one body, such as the
// panorama's). The colour of the light stays in the pictures.
#pragma once
#include "rigd/develop.h"
#include "rigd/linear.h"
#include <stdbool.h>
#include <stddef.h>

enum { COLOUR_CELLS_MAX = 24, COLOUR_BODIES_MAX = 1024, CHART_COLUMNS = 6, CHART_ROWS = 4, CARD_COLUMNS = 3, CARD_ROWS = 3 };

// ---- colour.json ----
struct body_colour {
    char serial[64], model[64];
    double gain[3], scale; // radiance of channel c is multiplied by gain[c] x scale; gain of green is 1
};
struct colour {
    int n;
    struct body_colour *body; // [n]
};
// 0; errors logged with file, key, found, expected: -errno of the open, -EINVAL (no JSON, not a colour.json, gains or scales outside
// 1/64 .. 64, no serial or the same twice, over COLOUR_BODIES_MAX), -ENOMEM. Zeroed on failure.
int colour_read(struct colour *out, const char *path);
int colour_parse(struct colour *out, const char *text, size_t n_bytes, const char *name_for_errors);
void colour_free(struct colour *c); // NULL and zeroed allowed
const struct body_colour *colour_of(const struct colour *c, const char *serial); // NULL: not there

// ---- measuring one frame ----
// A patch of the card or the chart, in the camera's channels: mean of flat x daylight[c] x (DN - black) / (white - black) x exposure_scale.
struct cell {
    double mean[3];
    double raw[3];   // mean of (DN - black) / (white - black): how well it is exposed
    int64_t n[3];    // photosites
    int64_t n_saturated;
};
// corner: upper left, upper right, lower right, lower left of what the cells divide, in pixels of the frame as it lies on the sensor (upper
// left is the card's, however the camera is turned). Of each cell the middle is measured: share of its width and height.
// 0; -EINVAL, and why: corners outside the frame or not convex, or cells of fewer than 16 sites per colour.
int colour_measure(struct cell *out, const struct raw_frame *f, const struct saturation *s, const struct flat *flat, double exposure_scale,
                   const double corner[4][2], int columns, int rows, double share, char *why, size_t room);

// ---- fitting a rig ----
struct colour_frame {
    char file[256], serial[64], model[64];
    double srgb_from_camera[3][3];
    int n_cells; // CARD_COLUMNS x CARD_ROWS, or of the chart
    struct cell cell[COLOUR_CELLS_MAX];
};
struct colour_fit {
    struct colour colour;
    double grey_spread;      // largest over channels (and grey patches): (largest - smallest) / mean over frames, of light that was not fitted to
    char spread_serial[64];  // the body furthest from the mean
    double chart_rms;        // over all patches and bodies, relative to white; NAN for a card
    double worst_rms;        // of one body
    char worst_serial[64];
};
// May this frame be used? -EDOM, and why: clipped, too dark, or uneven (a shadow, or the patch lies beside the card).
int colour_require_sound(const struct colour_frame *f, char *why, size_t room);
// Several frames of one body are averaged. reference: the serial of the body that is right; NULL: the median of all. fixed: instead of
// fitting, check these (colour is then left empty). 0; -ENOENT: no frame of the reference, or no entry in fixed (why names it); -EINVAL:
// cards and charts mixed, a frame without serial number, over COLOUR_BODIES_MAX; -ENOMEM.
int colour_fit(struct colour_fit *out, const struct colour_frame *frame, int n_frames, const char *reference, const struct colour *fixed, char *why, size_t room);

// Published colours of the 24 patches of a ColorChecker Classic, row by row from dark skin, in linear sRGB.
void colour_chart(double srgb[CHART_COLUMNS * CHART_ROWS][3]);
