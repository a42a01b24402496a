// tests/ray_margin.h - how far a ray is from changing its answer: by which "grazes an edge" is
// decided, in double.
#pragma once
#include "solver/mesh.h"
#include "solver/vec3.h"

// Distance (metres) by which the ray segment passes inside triangle i (positive) or misses it
// (negative): the least of the distances to its three edges, seen along the ray, and of the
// segment's two ends to its plane.
static double ray_margin_of_triangle_m(const struct mesh *mesh, int i, const double origin_m[3],
                                       const double dir[3], double t_min, double t_max)
{
    double p[3][3], unit[3] = { dir[0], dir[1], dir[2] };
    const double length = vec3_normalise(unit);
    for (int k = 0; k < 3; k++)
        for (int c = 0; c < 3; c++)
            p[k][c] = (double)mesh->position_m[mesh->triangle[i][k]][c] - origin_m[c];
    double e1[3], e2[3], normal[3];
    vec3_sub(e1, p[1], p[0]);
    vec3_sub(e2, p[2], p[0]);
    vec3_cross(normal, e1, e2);
    vec3_normalise(normal);
    const double facing = vec3_dot(normal, unit), to_plane = vec3_dot(normal, p[0]);
    if (facing == 0)
        return -INFINITY; // edge-on: never hit
    double margin = fabs(facing) * (to_plane / facing - t_min * length);
    if (isfinite(t_max))
        margin = fmin(margin, fabs(facing) * (t_max * length - to_plane / facing));
    for (int k = 0; k < 3; k++) { // the edge's line against the ray's line: their signed distance
        double edge[3], across[3];
        vec3_sub(edge, p[(k + 1) % 3], p[k]);
        vec3_cross(across, edge, unit);
        vec3_normalise(across);
        margin = fmin(margin, vec3_dot(across, p[k]) * (facing > 0 ? 1 : -1));
    }
    return margin;
}

// Positive: blocked, and still so if everything moves by less than that; negative: free by that
// much.
static inline double ray_margin_m(const struct mesh *mesh, const double origin_m[3],
                                  const double dir[3], double t_min, double t_max)
{
    double margin = -INFINITY;
    for (int i = 0; i < mesh->n_triangles; i++)
        margin = fmax(margin, ray_margin_of_triangle_m(mesh, i, origin_m, dir, t_min, t_max));
    return margin;
}
