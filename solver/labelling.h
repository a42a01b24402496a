// solver/labelling.h - which material each texel is of, from what speaks for each and from the company the texel keeps.
//
// Most texels of a glaze never show a highlight: by their own samples a free albedo explains them as clay. But they have the colour of texels
// that do, and nothing divides them from those. So every node's evidence is shared in two ways, by mean field (Kraehenbuehl, Koltun 2011): with its
// neighbours on the surface, the less the more their colours differ, and with all nodes of its colour, wherever they lie. Colours that all
// materials have in like shares say nothing, and do nothing.
#pragma once
#include "solver/levels.h"

struct labelling {
    const struct level *level;
    int n_labels, stride;       // n_labels <= stride, 8
    const float *evidence;      // [level n][stride] nats against each label; infinite: out of the question; all equal: nothing known
    const float (*colour)[3];   // [level n] logarithms; a NAN first: not known
    const float *bandwidth;     // [3] of luminance and two tints: colours so far apart are unlike (labelling_bandwidth)
    bool votes;                 // nodes of a colour go together, wherever they are; false: neighbours only
};
// label[level n]. 0 or -ENOMEM.
int labelling_find(uint8_t *label, const struct labelling *job);

// How far apart colours may be and pass for one: what neighbours mostly differ by, or Silverman's width of a kernel over all. 0 or -ENOMEM.
int labelling_bandwidth(float bandwidth[3], const struct level *level, const float (*colour)[3]);
