// solver/texels.h - the atlas as surface points: UV -> position, normal, tangent frame.
//
// A texture has size x size texels; row 0 of an *image* is its top, v runs upwards, so texel (column i, image row j) has its
// centre at u = (i + .5) / size, v = 1 - (j + .5) / size. A texel is covered when its centre lies in a triangle (a fixed rule
// decides shared edges, so none is covered twice by neighbours). Covered texels are stored compactly, in image order. What lies
// outside [0,1] is clipped, not wrapped; a triangle with a corner further out than 16 is left out.
#pragma once
#include "solver/mesh.h"
#include <stdint.h>

enum texel_flags {
    TEXEL_BOUNDARY = 1,   // fewer than four 4-neighbours covered by its own chart
    TEXEL_OVERLAP = 2,    // the centre lies in several triangles (the lowest index wins)
};

struct texels {
    int size;
    int n;                  // covered
    int32_t *index;         // [size*size] image order: compact index, or -1
    uint32_t *pixel;        // [n] row * size + column
    float (*position_m)[3]; // [n]
    float (*normal)[3];     // [n] unit, interpolated
    float (*tangent)[3];    // [n] unit, along +u (area-weighted per vertex, then interpolated; d position / d u also where the
                            // UVs are mirrored), orthogonal to normal; bitangent = normal x tangent
    float (*barycentric)[2]; // [n] weights of the triangle's second and third corner
    uint32_t *triangle;     // [n]
    int32_t *chart;         // [n]
    uint8_t *flags;         // [n]
    float texel_size_m;     // sqrt(textured surface area / texels it covers): a typical texel's side
};

// 1 <= size <= 16384. 0, -EINVAL (no texel covered: logged), -ENOMEM. The texels do not keep the mesh.
int texels_rasterise(struct texels *out, const struct mesh *mesh, int size);
void texels_free(struct texels *t); // leaves it zeroed

// How many triangles (at most 255) cover the centre of each texel: count[size*size], image order. 1 <= size <= 16384.
void texels_count_cover(uint8_t *count, const struct mesh *mesh, int size);

// Gutter: copy every covered texel's values outwards into the uncovered ones up to radius_px away (nearest covered texel; ties
// to the lower pixel index), so that bilinear look-ups at chart borders do not bleed. image: [size*size][n_channels].
int texels_fill_gutter(const struct texels *t, float *image, int n_channels, int radius_px);
