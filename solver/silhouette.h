// solver/silhouette.h - how far a picture mixes the object's light with that of what lies behind it.
//
// Demosaicing, resampling, an object out of focus or moving, a camera or a mesh that is slightly off: all put the background's light into
// pixels that should see the object alone, the same way in every view. How far, is measured where it can be told from shading: outside of
// the mesh's silhouette, where the object's light does not belong.
#pragma once
#include "solver/cameras.h"
#include "solver/rays.h"
#include "solver/take/image.h"

enum { SILHOUETTE_UNITS = 3, SILHOUETTE_BINS = 21, SILHOUETTE_SHARES = 101 };

// What the pictures of a take show together. Zeroed before the first.
struct silhouette {
    struct silhouette_profile { // at 1, 2 and 4 pixels a unit
        int n_points;           // of the silhouette, that had a plain background of another brightness
        int n[SILHOUETTE_BINS][SILHOUETTE_SHARES]; // pixels by their distance from it and by the object's share in their light
    } at[SILHOUETTE_UNITS];
};

// Look at one more picture: its camera, of its size; its channels R, G, B, which are finite. Its cost does not grow with the picture: 192 lines are followed, of at most 128 rays each, and a few hundred places looked at. Same in, same out.
void silhouette_add(struct silhouette *s, const struct rays *rays, const struct camera *camera, const struct image *image, const int rgb[3]);

// False where the pictures do not tell: no silhouette, no contrast, too much noise, or more than 20 px. Else
// reach_px: this far to either side of the mesh's silhouette pixels see both, by 2 % or more; .8 if a pixel is the mean over its own area and all is in its place;
// offset_px: how far inside of the mesh's silhouette the pictures' lies, on average around the object (outside: negative).
bool silhouette_reach(const struct silhouette *s, double *reach_px, double *offset_px);
