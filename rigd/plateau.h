// rigd/plateau.h - from which DN on is this frame's sensor full, where that is less than its file calls white?
//
// A converter that ends before white piles sites up at one DN. A photosite that is full before the converter ends is a *hump*: each well
// holds a little more or less than the next (an EOS D30: 3817 +- 9 DN of a white of 4095, so no site is "white" in its pictures and every
// lamp would pass for measured). What tells a hump from an evenly lit surface: nothing lies beyond it, next to nothing just below, and it is at
// the same DN above black in two colours or more - wells are alike, light is not.
#pragma once
#include "rigd/develop.h"

struct plateau {
    int dn;      // from here on sites are full (a hump's lower foot), below the frame's saturation; 0: no such
    int top;     // where the plateau ends
    int reached; // 64 sites lie here or above: another frame of this body that reaches beyond top refutes its plateau
};
// A hump in one colour alone is not told from a surface; an even one that the sensor sees alike in two colours passes for a hump, unless
// another frame refutes it. 0 or -ENOMEM. Pure.
int plateau_find(struct plateau *out, const struct raw_frame *f);
