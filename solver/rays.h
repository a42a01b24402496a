// solver/rays.h - a mesh that answers rays (Embree 3 or 4 lives in rays.c only).
//
// Immutable after rays_new(); every query may be called from any thread.
#pragma once
#include "solver/mesh.h"
#include <stdbool.h>
#include <stdint.h>

struct rays;

struct ray_hit {
    uint32_t triangle;
    float t;    // distance along dir
    float u, v; // barycentric weights of the triangle's second and third corner
};

// Keeps its own copy of the geometry. 0, -ENOMEM, -EIO (Embree's reason logged).
int rays_new(struct rays **out, const struct mesh *mesh);
void rays_free(struct rays *r); // NULL allowed

// Anything between t_min and t_max? dir need not be unit; t is in units of |dir|; t below 0 never counts. A ray that asks
// nothing (NaN, coordinates beyond 1.8e18, zero dir, t_max <= t_min) hits nothing.
bool rays_blocked(const struct rays *r, const float origin_m[3], const float dir[3], float t_min, float t_max);
// The same of n rays from one point, from t = 0 on: blocked[n] is 1 where rays_blocked() is true. Two to three times as fast as one by one
// where neighbours in the list point alike.
void rays_blocked_from(const struct rays *r, const float origin_m[3], int n, const float (*dir)[3], const float *t_max, uint8_t *blocked);
// The first hit; false: none.
bool rays_hit(const struct rays *r, const float origin_m[3], const float dir[3], float t_min, float t_max,
              struct ray_hit *hit);
// A safe start for rays that leave the surface: rays begin this far along the normal (metres): 1e-5 of the mesh's diagonal, and
// at least 8 steps of a float at its largest coordinate (a mesh far from its origin).
float rays_offset_m(const struct rays *r);
// Where rays that leave a surface point start. Normals are interpolated, facets are flat: a light above the normal's horizon can
// lie below its facet's plane, and coarse meshes would shadow themselves in triangles. So the point is lifted to the smooth surface the
// normals stand for (each corner's tangent plane, weighted; never sunk, not through other parts of the surface), then
// by rays_offset_m(). barycentric: weights of the second and third corner.
void rays_start(const struct rays *r, uint32_t triangle, const float barycentric[2], float start_m[3]);

// The same question asked of every triangle in double precision (Moeller-Trumbore): slow, for tests.
bool rays_blocked_brute_force(const struct mesh *mesh, const double origin_m[3], const double dir[3],
                              double t_min, double t_max);
