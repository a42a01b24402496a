// solver/emitters.h - which lights lie on one plane. Knows nothing of pictures.
//
// Seen from c, the plane m.x = 1 is at inverse distance q = d.m in direction d: linear in m, so a plane is found and fitted by
// linear least squares, and "these lights lie on a plane" is a quadratic form in their 1/r.
#pragma once
#include <stdint.h>

enum { EMITTER_LEAST = 6 }; // lights that make a plane: three more than any three would

struct emitters {
    int n;               // planes, largest first
    double (*plane)[3];  // [n] m, 1/m
    int32_t *of;         // [lights] which plane, -1: none
};

// Planes through most of the lights, one after the other. A light belongs to a plane when its inverse distance differs
// by less than `tolerance` (relative) from the plane's; to the one that fits best. dir: unit, q > 0: inverse distance (0: left out).
// Candidates: each light with its 8 nearest; so it is deterministic. 0 or -ENOMEM.
int emitters_find(struct emitters *out, int n_lights, const double (*dir)[3], const double *q, double tolerance);
void emitters_free(struct emitters *e); // leaves it zeroed

// Weighted least squares: m that minimises sum over the lights with of[i] == plane of ((dir.m - q) / q)^2. 0, or -EDOM where they do not
// determine a plane.
int emitters_fit(double m[3], int plane, int n_lights, const int32_t *of, const double (*dir)[3], const double *q);

// Adds 1/2 w sum of ((q_i - dir_i.m) / scale_i)^2 over the lights of all planes, each m at its best for q (so planes are not unknowns): returns
// the cost; with A (n x n, lower triangle) and g, at offset `first`, adds the derivatives by q.
double emitters_add_cost(const struct emitters *e, int n_lights, const double (*dir)[3], const double *q,
                         const double *scale, double w, int n, int first, double *A, double *g);
