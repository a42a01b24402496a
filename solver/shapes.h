// solver/shapes.h - objects made by code, with UV atlases: what a synthetic studio photographs.
#pragma once
#include "solver/mesh.h"
#include <stdint.h>

enum shape {
    SHAPE_PEBBLE, // smooth blob, convex enough not to shadow itself; 6 charts
    SHAPE_VASE, // surface of revolution with a neck, closed; 4 charts (two half walls, foot, mouth)
    SHAPE_KNOT, // torus knot: concave, shadows itself; 24 charts
    SHAPE_BOWL, // thick open bowl: a concavity that interreflects; 6 charts (foot, floor, outer and
                // inner half walls)
    SHAPE_N
};
extern const char *const shape_names[SHAPE_N];
// About radius_m in size (bounding sphere), centred at centre_m, +Z up; detail: about that many
// triangles (100 .. 4e6). Same arguments, same bytes. 0, -EINVAL, -ENOMEM.
int shape_make(struct mesh *out, enum shape shape, const double centre_m[3], double radius_m,
               int detail);
