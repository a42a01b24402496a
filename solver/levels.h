// solver/levels.h - the atlas as a pyramid, N x N texels down to 1 x 1, and which texels are neighbours on the surface.
//
// A texel of a coarser level stands for the covered ones of a 2 x 2 block beneath it, so the tree is that of the atlas. Its
// neighbours are texels of its own chart beside it and, where fewer than four are, the nearest of others across the seam: boundary
// texels of other charts (or of the same, more than 8 texels away in the atlas: a chart that closes round a cylinder has a seam with
// itself), within 2.5 texels on the surface, normals within 60 degrees. Neighbourhood is mutual: a texel has more than four where
// others chose it.
//
// No coarse texel looks at all the samples beneath it: a few texels of the finest level are its delegates, chosen from its children's in
// turn, until they have `cap` samples. So a level costs what its texel count costs, not what the image count costs.
#pragma once
#include "solver/texels.h"
#include <stdbool.h>

struct level {
    int size, n;
    const int32_t *index;           // [size*size] image order: compact index, or -1
    const uint32_t *pixel;          // [n] row * size + column
    const float (*position_m)[3];   // [n] mean of the finest texels beneath, of its chart
    const float (*normal)[3];       // [n] unit
    const int32_t *chart;           // [n] that of most texels beneath
    int32_t *parent;                // [n] in the next coarser level; NULL at 1 x 1
    int32_t *first_neighbour;       // [n + 1] texel i has neighbour[first_neighbour[i]] .. ascending
    int32_t *neighbour;
    int32_t *first_delegate;        // [n + 1] ... delegate[]: finest texels, each of one texel of the level; NULL at the finest: itself
    int32_t *delegate;
    void *owned[5];                 // what of the above is not the texels'
};

struct levels {
    int n;                     // level[0] is 1 x 1, level[n - 1] the finest
    struct level level[16];
};

struct levels_settings {
    bool seams;        // neighbours across seams; false: of the own chart only
    int cap;           // samples of a coarse texel, about; 128
    int most_views;    // a delegate counts at most so many; 32
};

// n_samples[texels n]: a texel without is nobody's delegate. Keeps pointers into texels. 0 or -ENOMEM. Deterministic.
int levels_new(struct levels *out, const struct texels *texels, const int32_t *n_samples, const struct levels_settings *settings);
void levels_free(struct levels *l); // leaves it zeroed
