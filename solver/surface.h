// solver/surface.h - a texel as the kernels see it: place and frame (bitangent = normal x tangent).
#pragma once
#include "solver/kernels/kernels.h"
#include "solver/texels.h"

#include <string.h>

static inline void surface_of_texel(struct surface_point *out, const struct texels *t, int texel)
{
    memcpy(out->position_m, t->position_m[texel], sizeof(out->position_m));
    memcpy(out->normal, t->normal[texel], sizeof(out->normal));
    memcpy(out->tangent, t->tangent[texel], sizeof(out->tangent));
    const float *n = out->normal, *x = out->tangent;
    out->bitangent[0] = n[1] * x[2] - n[2] * x[1];
    out->bitangent[1] = n[2] * x[0] - n[0] * x[2];
    out->bitangent[2] = n[0] * x[1] - n[1] * x[0];
}
