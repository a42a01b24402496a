// solver/rays.h - a mesh that answers rays (Embree 3 or 4 lives in rays.c only).
//
// Immutable after rays_new(); every query may be called from any thread.
#pragma once
#include "solver/mesh.h"
#include <stdbool.h>

struct rays;

struct ray_hit {
    uint32_t triangle;
    float t;    // distance along dir
    float u, v; // barycentric weights of the triangle's second and third corner
};

// Keeps its own copy of the geometry. 0, -ENOMEM, -EIO (Embree's reason logged).
int rays_new(struct rays **out, const struct mesh *mesh);
void rays_free(struct rays *r); // NULL allowed

// Anything between t_min and t_max? dir need not be unit; t is in units of |dir|.
bool rays_blocked(const struct rays *r, const float origin_m[3], const float dir[3], float t_min, float t_max);
// The first hit; false: none.
bool rays_hit(const struct rays *r, const float origin_m[3], const float dir[3], float t_min, float t_max,
              struct ray_hit *hit);
// A safe start for rays that leave the surface: rays begin this far along the normal (metres): 1e-5 of the mesh's diagonal.
float rays_offset_m(const struct rays *r);

// The same question asked of every triangle in double precision (Moeller-Trumbore): slow, for tests.
bool rays_blocked_brute_force(const struct mesh *mesh, const double origin_m[3], const double dir[3],
                              double t_min, double t_max);
