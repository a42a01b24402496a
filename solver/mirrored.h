// solver/mirrored.h - what each view sees of the object in the object: its own light in the gloss of its surface.
//
// interreflection.h knows irradiance, which is all that a matt surface shows of its surroundings. Metal and glaze show a picture of them.
// It depends on the view, so it is one radiance per sample; stage 2 takes it off what the cameras measured.
#pragma once
#include "solver/kernels/kernels.h"
#include "solver/rays.h"
#include "solver/samples.h"

struct mirrored {
    const struct texels *texels;
    const struct mesh *mesh;
    const struct rays *rays;
    const struct lights *lights;
    const struct samples *samples;
    const uint16_t *visible;         // [n_texels][words_per_texel], or NULL
    const uint8_t *soft;             // [n_texels][lights n], or NULL
    int words_per_texel;
    const float (*theta)[DISNEY_N];  // [n_texels]
    const float (*albedo)[3];        // [n_texels]
    const float (*indirect)[3];      // [n_texels] irradiance from the object itself, or NULL
    enum disney_variant variant;
    int n_rays;                      // per sample, drawn from the isotropic specular lobe
    int n_threads;
};
// radiance[samples n]: one bounce by the specular lobe, of light that left the other place by any. Same bytes for any thread count. 0 or -ENOMEM.
int mirrored_gather(const struct mirrored *m, float (*radiance)[3]);
// A copy of samples with `radiance` taken off. Everything else is the original's. Free what radiance points to. 0 or -ENOMEM.
int mirrored_take_off(struct samples *out, const struct samples *samples, const float (*radiance)[3]);
