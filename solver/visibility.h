// solver/visibility.h - who sees which texel: cameras, and lights.
#pragma once
#include "solver/cameras.h"
#include "solver/lights.h"
#include "solver/rays.h"
#include "solver/texels.h"
#include <stdint.h>

// Camera masks. Values are those of the PNG.
enum camera_mask { MASK_OUTSIDE = 0, MASK_OCCLUDED = 85, MASK_GRAZING = 170, MASK_VISIBLE = 255 };
// mask[t->n]: outside the image or behind the camera; facing away or blocked; cosine to the view direction below grazing_cos
// (default .15, SOLVER.md 2); else visible. The first that holds, in this order. n_threads as in parallel.h.
enum { MASK_GRAZING_COS_PERCENT = 15 };
void visibility_camera_mask(uint8_t *mask, const struct rays *r, const struct texels *t,
                            const struct camera *camera, double grazing_cos, int n_threads);
// Write it as the texture it belongs to (size x size, grey PNG; uncovered texels are MASK_OUTSIDE). 0 or -errno.
int visibility_write_mask_png(const uint8_t *mask, const struct texels *t, const char *path);

// Light visibility: one bit per texel and light, 16 lights a word, words_per_texel = ceil(n_lights / 16): 32 bytes for 256 lights.
struct light_visibility {
    int n_texels, n_lights, words_per_texel;
    uint16_t *bits;          // [n_texels][words_per_texel]; light i is bit i % 16 of word i / 16; 1 = visible
    uint8_t *soft;           // [n_texels][n_lights] visible share x 255; NULL unless asked for
    int n_sub;               // sub-directions per light for soft (4..16), else 1
    double (*traced_from_m)[3]; // [n_lights] position (or direction, if directional) the bits were traced for
    uint8_t *traced_directional; // [n_lights]
    double reference_m[3];   // where the movement of lights is judged from: the middle of the texels' bounding box ...
    double half_size_m[3];   // ... and its corners, this far away: a light that comes nearer moves only as seen from there
    int64_t n_rays;          // traced so far
};

// Trace all. Lights below a texel's horizon are set invisible without a ray. n_sub = 1: hard bits. n_sub in 4..16: sub-directions
// drawn from each light's own panorama pixels (energy-weighted, fixed by seed); bits then say "any sub-direction visible", soft
// the visible share of those above the horizon (the cosine of Eq. 5 already takes the rest). Rays start at rays_start().
// 0, -EINVAL (n_sub > 1 needs regions and the panorama), -ENOMEM.
int light_visibility_trace(struct light_visibility *out, const struct rays *r, const struct texels *t,
                           const struct lights *l, const struct panorama *p, int n_sub, uint64_t seed,
                           int n_threads);
// Retrace only lights whose direction seen from reference_m or a corner has moved by more than min_move_rad (SOLVER.md 4: .5
// degrees) since they were traced. Returns how many were retraced, or -errno. Same texels, same number of lights, same seed.
int light_visibility_refresh(struct light_visibility *v, const struct rays *r, const struct texels *t,
                             const struct lights *l, const struct panorama *p, double min_move_rad,
                             uint64_t seed, int n_threads);
void light_visibility_free(struct light_visibility *v);
// Raw file: 32-byte header "RIGVIS01", u32 n_texels, n_lights, words_per_texel, n_sub, texture size, 0; then bits, then soft. Little endian.
int light_visibility_write(const struct light_visibility *v, int texture_size, const char *path);
