// solver/interreflection.h - light that the object sends to itself, as if it were diffuse: what stage 2 adds to the lights' own.
#pragma once
#include "solver/kernels/kernels.h"
#include "solver/rays.h"
#include "solver/texels.h"

#include <math.h>

// What a texel sends on of indirect light, as radiance: own x albedo + constant. As of light from all around: metal and diffuse base send back their
// colour, the dielectric's surface what it reflects head-on.
static inline float indirect_own(float irradiance)
{
    return irradiance * (float)M_1_PI;
}

static inline float indirect_constant(float irradiance, const float theta[DISNEY_N])
{
    return indirect_own(irradiance) * .08f * theta[DISNEY_SPECULAR] * (1 - theta[DISNEY_METALLIC]);
}

static inline void indirect_constant_gradient(float irradiance, const float theta[DISNEY_N], float *by_specular, float *by_metallic)
{
    *by_specular = indirect_own(irradiance) * .08f * (1 - theta[DISNEY_METALLIC]);
    *by_metallic = -indirect_own(irradiance) * .08f * theta[DISNEY_SPECULAR];
}

struct interreflection {
    const struct texels *texels;
    const struct mesh *mesh;
    const struct rays *rays;
    const struct light_arrays *lights;
    const struct kernels *kernels;
    const uint16_t *visible;     // [n_texels][words_per_texel], or NULL
    int words_per_texel;
    const uint8_t *soft;         // [n_texels][lights->n] visible share x 255; or NULL: visible says all
    const float (*diffuse)[3];   // [n_texels] reflectance
    int n_rays;                  // per place where light is gathered, over the hemisphere by cosine
    int size;                    // finer textures than size x size gather at places so far apart, and texels between them interpolate; 0: every texel
    int n_threads;
};
// indirect[n_texels]: irradiance from other parts of the surface. In: that of an earlier call (or 0), which then is reflected too, so that each call adds a bounce. Same bytes
// for any thread count. 0, -EINVAL (no place for light at this size: logged), -ENOMEM; indirect is then as it was.
int interreflection_gather(const struct interreflection *s, float (*indirect)[3]);
