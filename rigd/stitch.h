// rigd/stitch.h - stops of a panorama head into one 2:1 panorama of radiance, by area.
//
// Pure. Every site of a stop is a patch of the sphere: its corners go through the lens (rigd/lens.h) and the head, and the patch is cut
// along the borders of the panorama's texels, in the coordinates longitude and sin(latitude), where area is solid angle. So patches tile
// what the lens sees without gap or overlap and flux = radiance x solid angle is kept whatever the sizes. Stops are blended with weights
// that fall smoothly to 0 at the border of their frame; clipped sites weigh next to nothing where another stop saw the same unclipped.
//
// Convention of the panorama: solver/panorama.h (+Z in the middle, left edge longitude +180, +Y up).
// Head angles are taken as they are: nothing is refined from the pictures; seams tell how well they fit.
#pragma once
#include "rigd/bracket.h"
#include "rigd/lens.h"
#include "solver/take/image.h"

struct stitch_stop_report {
    double solid_angle_sr;  // that this stop sees
    double clipped_sr;      // of it clipped
    // Against the stops before it, in cells of 1/256 of the panorama's width that both see well (evenly lit, signal-to-noise ratio above 30): brightness (median ratio; 1), and the median
    // of |log2 ratio| after it. n_cells 0: none in common.
    int n_cells;
    double seam_gain, seam_ev;
};

struct clipped_light { // texels that touch each other
    double dir_probe[3];
    double solid_angle_sr;
    double irradiance_at_least[3]; // sum of recorded radiance x solid angle: what comes from there is at least this
};

struct panorama_report {
    double uncovered_sr;         // seen by no stop
    double clipped_sr;           // clipped in every stop that saw it
    double total[3];             // sum of radiance x solid angle
    double median_snr, dark_snr; // of green's texels; of the darkest percent of them
    int n_lights, n_listed;
    struct clipped_light light[32]; // brightest first
};

struct stitch;
int stitch_new(struct stitch **out, int width_px); // 0, -ENOMEM, -EINVAL (not even, not 16 .. 16384)
// Mosaic -> colours by bilinear interpolation (never below or above its neighbours: no ringing at a lamp), then to texels. m: after
// merged_unshade(). 0, -ENOMEM,
// -EINVAL (the lens is of another size than the picture; logged).
int stitch_add(struct stitch *s, const struct lens *lens, const double probe_from_camera[9], const struct merged *m, struct stitch_stop_report *report);
// The same, but m's pixels are forgotten as they are put, so that its memory goes back while the panorama's comes: only merged_free(m) may follow.
int stitch_add_last(struct stitch *s, const struct lens *lens, const double probe_from_camera[9], struct merged *m, struct stitch_stop_report *report);
// Before a while in which s is not used, and for the first time before anything is added: its sums, 36 bytes a texel, move to a file without a name in
// folder and take no memory until stitch_add. Where that cannot be, they stay.
void stitch_rest(struct stitch *s, const char *folder);
// rgb_from_camera: row-major, applied at the end. Channels R, G, B, "variance.R" "variance.G" "variance.B" (of the texel's mean, camera
// noise only: never too small; 15 % too large for texels of 10 pixels, more for smaller ones, because interpolated pixels share sites), "coverage" (1: all of the texel was seen), "clip" (share of the weight that was clipped).
int stitch_finish(struct image *out, struct stitch *s, const double rgb_from_camera[9], struct panorama_report *report);
// The same without a picture in memory: its report, and its row y, of STITCH_CHANNELS a texel (for image_write_exr_rows; 0).
enum { STITCH_CHANNELS = 8 };
extern const char *const stitch_channels[STITCH_CHANNELS];
struct stitch_rows {
    struct stitch *stitch;
    double rgb_from_camera[9];
};
int stitch_examine(struct panorama_report *report, const struct stitch_rows *rows);
int stitch_row(void *arg, int y, float *row); // arg: struct stitch_rows
void stitch_free(struct stitch *s); // NULL allowed

// The clipped lights, uncovered directions and sums of a panorama with such channels, or of one without: then a plateau (at least 8 touching
// texels within 1e-3 of the picture's highest value, where the picture is not flat) counts as clipped. 0 or -ENOMEM.
int panorama_examine(struct panorama_report *report, const struct image *panorama);
