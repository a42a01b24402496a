// rigd/bracket.h - one radiance per photosite out of frames of different exposure, before demosaicing; and which exposure comes next.
//
// Pure. A frame's signal is y = (DN - black) / (white - black), 1 at the sensor's white; its exposure h = time x ISO / 100 / N^2 (true
// times: powers of two, not the labels); radiance is y / h; times DEVELOP_TIME_S / DEVELOP_F_NUMBER^2 it is in the unit of developed frames.
//
// Estimator. A site's electrons are Poisson; with radiance X and frames i, E y_i = X h_i, var y_i = X h_i / w + (s / w)^2, w electrons at
// white, s electrons of read noise. Without read noise the maximum of the likelihood is sum(y) / sum(h) (Hanji, Zhong, Mantiuk 2020);
// with it, frames count by u_i = e_i / (e_i + s^2), e_i = the electrons expected of it (from the frames before it): X = sum(u y) /
// sum(u h), var X = X / (w sum(u h)). That is the Poisson bound where e_i >> s^2 and the bound with read noise where not.
//
// A site of a frame is *good*: at most `usable` of saturation, and no site within bloom_px of it saturated by more than 1.8 times (by any,
// where the next shorter frame cannot tell: green saturates before red and blue, and only what overflows blooms; unless these neighbours,
// as a whole, agree with the next shorter frame: then this sensor does not bloom); *poor*: not saturated;
// *clipped*. Poor ones count only where there is no good one. Clipped in all frames: the radiance is a lower bound, y / h of the shortest.
#pragma once
#include "rigd/develop.h"
#include "rigd/lens.h"

struct sensor_noise {
    double electrons_at_white; // w, at the frames' ISO
    double read_noise_e;       // s; quantisation is added to it by whoever gives figures from a data sheet
};

// Measures both from two frames of one scene and different exposure (8 times or less), or the same: the same site in both differs by noise
// only, so the scene need not be flat. Robust against things that moved. 0; -ENODATA: too little light or too few sites that both see.
int sensor_noise_measure(struct sensor_noise *out, const struct raw_frame *a, const struct raw_frame *b);

double bracket_exposure(const struct raw_frame *f); // h; ISO and N count as 100 and 1 where the file does not say; 0 without a time, or one that cannot be

// ---- what comes next --------------------------------------------------------------------------------------------------------

struct bracket_statistics { // of one frame; [3]: red, green, blue
    double exposure_s;      // true time
    int64_t n_sites[3];
    int64_t n_over[3];  // above `usable` of saturation, with a neighbour above half of it: hot sites alone are no light
    double brightest[3]; // highest y of those with such a neighbour
    double first_percentile[3], median[3]; // of y
    int plateau_dn;     // plateau_find()
};
// lens: sites that it does not see (outside its circle) do not count; NULL: all count. 0 or -ENOMEM.
int bracket_measure(struct bracket_statistics *out, const struct raw_frame *f, const struct lens *lens);

struct bracket_plan {
    double metered_s;              // where to start
    double shortest_s, longest_s;  // what the camera can (true times)
    double step_ev;                // 0: 2
    double snr;                    // 0: 10
    int max_frames;                // 0: 15
    bool repeat_shortest;          // once more at the end: flicker
    struct sensor_noise noise;     // electrons_at_white 0: 20000 and 8 (a careful guess)
};
struct bracket_next {
    bool is_done;
    double exposure_s;      // to shoot now, if not done
    bool needs_nd;          // the shortest possible still clips
    double nd_ev_at_least;  // then: of a neutral-density filter to begin with, as far as can be told: the next frame tells
    bool too_dark;          // the longest possible still is below snr at the first percentile
    char why[160];          // in words
};
// Frames so far in any order, 0 of them at the start: shorter by step until no site is over, then longer until the first percentile of
// every colour has the snr, then the shortest once more. 0; -EINVAL: plan not usable (times not positive, shortest > longest).
int bracket_next(struct bracket_next *out, const struct bracket_plan *plan, const struct bracket_statistics *so_far, int n);

// ---- the merge ----------------------------------------------------------------------------------------------------------------

enum { BRACKET_CLIPPED, BRACKET_POOR, BRACKET_GOOD, BRACKET_DEFECT }; // DEFECT: a stuck site, filled in from its neighbours of its colour
enum { BRACKET_BLOCK_PX = 16 }; // frames are compared in blocks of this many sites a side

struct bracket_options {
    struct sensor_noise noise;
    double usable;        // 0: .9
    int bloom_px;         // < 0: 0; 0: 1; at most 8
    double gain_refused;  // 0: .15: a frame whose brightness contradicts its exposure by more is left out
};

struct merged { // all [height][width]
    int width, height;
    uint8_t cfa[2][2];
    float *radiance;  // may be negative in the dark: noise about 0
    float *variance;
    uint8_t *quality; // BRACKET_*
};

enum bracket_fault { // why a frame does not belong
    BRACKET_FITS, BRACKET_OTHER_SIZE, BRACKET_OTHER_FILTERS, BRACKET_OTHER_CAMERA, BRACKET_OTHER_LEVELS, BRACKET_OTHER_ISO,
    BRACKET_OTHER_APERTURE, BRACKET_NO_TIME, BRACKET_OTHER_BRIGHTNESS
};
const char *bracket_fault_text(enum bracket_fault f); // "other camera" ...

struct bracket_frame_report {
    enum bracket_fault fault; // not BRACKET_FITS: the frame was left out
    double exposure;          // h
    int64_t n_good, n_poor, n_clipped;
    // Against the frames before it, where both see: brightness over what its exposure says (1; median of blocks), its standard error; 0
    // blocks compared: 1 and infinite.
    double gain, gain_error;
    int n_blocks, n_changed;   // compared; changed beyond noise and gain, and by 2 % at least
    int largest_change;        // blocks in the largest patch of them: movement where frames differ in time, flicker where they are repeats
    double changed_at_px[2];   // its middle
    double change;             // brightness there over what was expected
    bool is_repeat;            // exposure as a frame before (within 1 %)
    double chi2;               // mean of squared differences over what noise explains, gain taken out; 1 if only noise
    int plateau_dn;
};

struct bracket;
// first: whose size, filters, camera, levels, ISO and aperture the others must have; pixels are not looked at. 0, -ENOMEM, -EINVAL.
int bracket_new(struct bracket **out, const struct raw_frame *first, const struct bracket_options *options);
// Longest first (comparisons need the better frame first; the estimate does not depend on it but for rounding and weights). exposure_s may be
// corrected by the caller. next: the next shorter frame, or NULL: only how far a site of f is beyond saturation is looked up in it. 0 or
// -ENOMEM; the verdict is in *report.
int bracket_add(struct bracket *b, const struct raw_frame *f, const struct raw_frame *next, struct bracket_frame_report *report);
// Ends b, whatever comes of it. 0; -ENOMEM; -ENODATA: no frame was taken in.
int bracket_finish(struct merged *out, struct bracket *b, int64_t *n_clipped, int64_t *n_defects);
void bracket_free(struct bracket *b); // NULL allowed
void merged_unshade(struct merged *m, const struct lens *lens); // what the lens' corners lost: of the same size
void merged_free(struct merged *m);
