// solver/relocate.h - stage 1 once more, with materials that stage 2 found in place of one shared reflectance.
//
// An object of metal and clay under one theta pulls the lights to where they explain the difference. With every texel's own theta held (and its
// albedo eliminated, as ever) the lights are free to go where they are; then the materials are found again.
#pragma once
#include "solver/joint.h"

// state: lights and albedo, in and out (lights of one group move together, their distances in the ratio they have); its log_gain
// stays. theta[n_texels]; indirect[n_texels]: irradiance from the object itself (interreflection.h), or NULL. The weight of the
// similarity term falls by decades, 1e-3 to 1e-9 beside the mean of squares, until views aside gain nothing more; what they do not
// like better is not kept. error_before, error_after: RMSE of those views in percent. 0 or -ENOMEM.
int relocate_lights(struct photometric_state *state, const struct texels *texels, const struct samples *samples, const struct rays *rays,
                    const uint8_t *hold_out, const float (*theta)[DISNEY_N], const float (*indirect)[3],
                    const struct joint_settings *settings, double *error_before, double *error_after);

// Whether the lights are to be trusted, asked again under the materials: misfit, standard deviations (given the materials) and doubts of *result, whose
// state stays. The doubts that no material can lift (few views, no information, mirrored) stay too. 0 or -ENOMEM.
int relocate_doubt(struct joint_result *result, const struct texels *texels, const struct samples *samples, const struct rays *rays,
                   const uint8_t *hold_out, const float (*theta)[DISNEY_N], const float (*indirect)[3], const struct joint_settings *settings);
