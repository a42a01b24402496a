// solver/misfit.h - is what is left of the pictures noise, or something that the model lacks?
//
// Noise differs from texel to texel; what a model lacks - a light, a shadow, an object that moved - is
// shared by neighbours. So residuals of one view are compared some texels apart (far enough that
// the two read no common pixel): their covariance is the structure's mean square, and what is left of
// the variance is noise. That needs no knowledge of the cameras' noise. Two more means of the
// residuals say where to look: over equal directions to the mirrored viewer (a light that is not in
// the panorama leaves a bright spot there), and over the surface normal.
#pragma once
#include "solver/photometric.h"
#include <stdbool.h>

struct misfit {
    int64_t n_samples, n_pairs;
    double level;          // RMS of the pictures (1: white) over the samples looked at, all channels
    double residual;       // RMS of the residuals
    double noise;          // that part of it which neighbours do not share
    double structure;      // that which they do, beyond what chance gives; 0 where they share nothing
    double by_view;        // RMS of the views' means, noise taken off: exposures, a camera that moved
    double by_normal;      // of the means over like normals: light of a broad lobe
    double by_mirror;      // of the means over like mirrored view directions: highlights
    double brighter[3];    // unit, world: from where the pictures have most light that the model has not (mirrored views)
};

// At the state with its albedo, over the views and texels in use and what did not clip. 0 or -ENOMEM. Pure: same in, same out.
int misfit_measure(struct misfit *out, const struct photometric *p, const struct photometric_state *s);

// Is the structure more than MISFIT_POOR of the light? Clean synthetic studios leave .002 to .005, cameras half a pixel off or
// millimetres of wrong geometry .015, a missing panel .02 to .06 (`make stability`, axis "missing").
static const double MISFIT_POOR = .015;
static inline bool misfit_is_poor(const struct misfit *m)
{
    return m->structure > MISFIT_POOR * m->level;
}

// Standard deviations of the unknowns (photometric_layout; [n]) that know of structure. sigma^2 A^-1 takes every sample for an
// independent draw. Here the texture is cut into patches, and each patch's pull on the unknowns is one draw: what neighbours share
// does not average out inside it. Patches of a sixth of the side and of a third: the larger variance counts. How much larger the distances' variances come out so (the median, at least 1) is *inflation, which is
// theirs; the other unknowns have their own, or this where theirs is less;
// C = (A / (inflation sigma^2) + prior)^-1. prior [n][n], or NULL: what is known beside the pictures, as a precision (E_sim: 1
// beside 1 / |dh_i - dh_j|^2 is a wall seen at 45 degrees; not the weight of a regularisation, that is chosen for the estimate).
// Infinite where nothing depends on an unknown; NAN where the matrix is singular. 0 or -ENOMEM.
int misfit_deviations(double *deviation, double *inflation, const struct photometric *p, const struct photometric_state *s,
                      const unsigned char *is_free, const double *prior);
