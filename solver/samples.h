// solver/samples.h - what the cameras measured of every texel.
//
// One sample: texel t seen by view k, linear radiance at the projected texel centre. Samples are stored texel by texel, views
// ascending; radiance as half floats. A view is decoded once, and only one is in memory at a time. 11 bytes a sample;
// while gathering 20, and a bit per texel and view.
#pragma once
#include "solver/cameras.h"
#include "solver/rays.h"
#include "solver/texels.h"
#include <stdbool.h>
#include <stdint.h>

enum sample_flags {
    SAMPLE_CLIPPED = 1, // a pixel under it was at or above white: the radiance is a lower bound
};

enum { ERODE_BY_PICTURE = -1 };

struct samples {
    int n_texels, n_views;
    int64_t n;
    int64_t *first;          // [n_texels + 1]: texel t has samples first[t] .. first[t+1]-1
    uint16_t *view;          // [n]
    uint16_t (*radiance)[3]; // [n] half floats, R G B; samples_radiance() widens
    uint16_t *gradient;      // [n] half float: |d luminance / d pixel| at the sample, per pixel (for registration error): by the
                             // differences of what would be read half a pixel to either side
    uint8_t *flags;          // [n]
    double (*centre_m)[3];   // [n_views] camera centres
    char (*name)[CAMERA_NAME_MAX]; // [n_views]
    double clipped_share;    // of all samples
    int edge_px;             // the largest distance that was kept in a view, as erode_px
    double edge_reach_px, edge_offset_px; // ERODE_BY_PICTURE: what silhouette_reach() said; NaN: nothing, or not asked
};

struct samples_settings {
    double grazing_cos; // samples below are left out; .15 (SOLVER.md 2)
    int erode_px;       // samples this near (in pixels) to a silhouette or depth edge are left out. Counted from the pixels a
                        // sample reads: 1 makes sure that no pixel that is read lies on the edge itself; 0 looks at their centres only.
                        // ERODE_BY_PICTURE (the default): 1 and as far as light has been spread from pixel to pixel: what the object's outline
                        // shows in the pictures together (silhouette.h), or the picture's own note IMAGE_SPREAD_NOTE where that is more;
                        // where neither says anything, as far as AHD spreads it: 3
    bool at_centre;     // take off what slope and curvature of the picture add to the mean over a footprint, as from a pixel around it
                        // (which erode_px other than 0 makes sure is the same surface): the radiance at the texel's centre, to second order; true
    double white;       // clip level where an image has no "clip" channel; 1.0; 0: never
    int n_threads;
};
struct samples_settings samples_defaults(void);

// Project every texel into every view (image_paths[k] belongs to cameras->view[k]; NULL: the view is skipped), test visibility with
// rays, and read the radiance: the mean over a box as wide and high as the projected texel is spread along x and y, each side
// 1 to 8 px (1: bilinear interpolation). Left out: what visibility_camera_mask() does not call visible; boxes within half a
// pixel (at_centre: one) of the picture's border; and those that read, or have within erode_px around what they read, a pixel whose ray (through its centre)
// misses the mesh or meets it further off the texel's tangent plane than 4 texels plus a quarter of the distance along it.
// With ERODE_BY_PICTURE up to eight pictures, evenly spread over the views, are read twice. Warns where they do not tell how far light has spread, and no
// note does; and where it has spread further than the notes say.
// Images of another size than the camera says are accepted when the aspect matches (the camera is resized), else refused; so
// are views without R, G or B, and those with a pixel (R, G, B, clip) that is not finite: by name. At most 65,536 views.
// 0, -errno of reading, -EINVAL, -EDOM (not finite), -ENOMEM. Same bytes for any thread count.
int samples_gather(struct samples *out, const struct texels *t, const struct rays *r, const struct cameras *cameras,
                   const char *const *image_paths, const struct samples_settings *settings);
void samples_free(struct samples *s); // leaves it zeroed

void samples_radiance(const struct samples *s, int64_t i, float rgb[3]);
float samples_gradient(const struct samples *s, int64_t i);
// Unit direction from the texel to view k's centre.
void samples_view_direction(const struct samples *s, const struct texels *t, int texel, int view, float v[3]);
