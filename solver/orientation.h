// solver/orientation.h - the rotation that takes one set of vectors to another (absolute orientation).
//
// B. K. P. Horn, "Closed-form solution of absolute orientation using unit quaternions", J. Opt. Soc. Am. A 4 (1987) 629-642:
// the unit quaternion is the eigenvector of the largest eigenvalue of a symmetric 4x4 matrix.
#pragma once
#include <stdbool.h>

struct orientation {
    double rotation[9]; // b_from_a, row-major, always proper: orthonormal to rounding, determinant +1
    bool determined;    // false: the a lie on one line through the origin (to 1e-6 of their length): any turn about it fits
    bool mirrored;      // some reflection fits better than every rotation. A set that lies in a plane is never mirrored
};

// Minimises sum_i w_i |b_i - R a_i|^2 over rotations R. weight NULL: all 1; n >= 0; all numbers finite, weights >= 0, and the
// sum of their w |a| |b| must not overflow. For points that are moved as well, subtract the weighted means from both first.
// Pairs without noise give R to rounding (a few 1e-16, divided by the angle by which the a leave a line). Where turns are left
// free, it is the smallest rotation that fits: no pairs at all give the identity. Same input, same bits.
void orientation_fit(struct orientation *out, const double (*a)[3], const double (*b)[3], const double *weight, int n);
