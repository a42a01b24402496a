// solver/interreflection.h - light that the object sends to itself, as if it were diffuse: what stage 2 adds to the lights' own.
#pragma once
#include "solver/kernels/kernels.h"
#include "solver/rays.h"
#include "solver/texels.h"

struct interreflection {
    const struct texels *texels;
    const struct mesh *mesh;
    const struct rays *rays;
    const struct light_arrays *lights;
    const struct kernels *kernels;
    const uint16_t *visible;     // [n_texels][words_per_texel], or NULL
    int words_per_texel;
    const float (*diffuse)[3];   // [n_texels] reflectance
    int n_rays;                  // per texel, over the hemisphere by cosine
    int n_threads;
};
// indirect[n_texels]: irradiance from other parts of the surface. In: that of an earlier call (or 0), which then is reflected too, so that each call adds a bounce. Same bytes
// for any thread count. 0 or -ENOMEM.
int interreflection_gather(const struct interreflection *s, float (*indirect)[3]);
