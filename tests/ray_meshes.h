// tests/ray_meshes.h - meshes for the tests and the bench of rays and visibility: sphere, quads,
// disc, bumpy knob.
#pragma once
#include "solver/mesh.h"
#include "solver/random.h"
#include "solver/vec3.h"

#include <stdlib.h>

struct ray_mesh_arrays {
    int n_vertices, n_triangles;
    float (*position)[3], (*normal)[3], (*uv)[2];
    uint32_t (*triangle)[3];
};

static void ray_mesh_reserve(struct ray_mesh_arrays *a, int n_vertices, int n_triangles,
                             bool normals)
{
    *a = (struct ray_mesh_arrays){
        .position = calloc((size_t)n_vertices, sizeof(a->position[0])),
        .normal = normals ? calloc((size_t)n_vertices, sizeof(a->normal[0])) : NULL,
        .uv = calloc((size_t)n_vertices, sizeof(a->uv[0])),
        .triangle = calloc((size_t)n_triangles, sizeof(a->triangle[0])),
    };
}

static struct mesh ray_mesh_finish(struct ray_mesh_arrays *a)
{
    struct mesh mesh;
    if (mesh_from_arrays(&mesh, a->n_vertices, a->position, a->normal, a->uv, a->n_triangles,
                         a->triangle))
        abort();
    return mesh;
}

// A grid of (columns + 1) x (rows + 1) vertices over the UV square [u0,u1] x [0,1]; place(u, v,
// position, normal) with u, v in [0,1]; counter-clockwise seen from where u runs right and v up.
typedef void ray_mesh_place(double u, double v, double position[3], double normal[3]);
static void ray_mesh_grid(struct ray_mesh_arrays *a, int columns, int rows, double u0, double u1,
                          ray_mesh_place *place)
{
    const int first = a->n_vertices;
    for (int j = 0; j <= rows; j++)
        for (int i = 0; i <= columns; i++) {
            const double u = (double)i / columns, v = (double)j / rows;
            double p[3], n[3] = { 0 };
            place(u, v, p, n);
            for (int c = 0; c < 3; c++) {
                a->position[a->n_vertices][c] = (float)p[c];
                if (a->normal)
                    a->normal[a->n_vertices][c] = (float)n[c];
            }
            a->uv[a->n_vertices][0] = (float)(u0 + (u1 - u0) * u);
            a->uv[a->n_vertices++][1] = (float)v;
        }
    for (int j = 0; j < rows; j++)
        for (int i = 0; i < columns; i++) {
            const uint32_t q = (uint32_t)(first + j * (columns + 1) + i),
                           up = (uint32_t)columns + 1;
            const uint32_t two[2][3] = { { q, q + 1, q + up + 1 }, { q, q + up + 1, q + up } };
            for (int k = 0; k < 2; k++, a->n_triangles++)
                for (int c = 0; c < 3; c++)
                    a->triangle[a->n_triangles][c] = two[k][c];
        }
}

static void ray_mesh_place_sphere(double u, double v, double p[3], double n[3])
{
    // The seam and the poles are exactly the same points, so that the sphere is closed.
    const double lon = u >= 1 ? 0 : 6.283185307179586 * u, z = -cos(3.141592653589793 * v);
    const double s = v <= 0 || v >= 1 ? 0 : sin(3.141592653589793 * v);
    n[0] = p[0] = s * cos(lon), n[1] = p[1] = s * sin(lon), n[2] = p[2] = z;
}

// A grid wrapped round a ball: closed, without the triangles at the poles that have no area.
static struct mesh ray_mesh_ball(int columns, int rows, ray_mesh_place *place, bool normals)
{
    struct ray_mesh_arrays a;
    ray_mesh_reserve(&a, (columns + 1) * (rows + 1), 2 * columns * rows, normals);
    ray_mesh_grid(&a, columns, rows, 0, 1, place);
    const uint32_t south = (uint32_t)columns, north = (uint32_t)((columns + 1) * rows);
    int n = 0;
    for (int i = 0; i < a.n_triangles; i++) {
        const uint32_t t[3] = { a.triangle[i][0], a.triangle[i][1], a.triangle[i][2] };
        if ((t[0] <= south && t[1] <= south) || (t[1] >= north && t[2] >= north))
            continue;
        for (int c = 0; c < 3; c++)
            a.triangle[n][c] = t[c];
        n++;
    }
    a.n_triangles = n;
    return ray_mesh_finish(&a);
}

// Unit sphere about the origin, with the sphere's own normals.
static inline struct mesh ray_mesh_sphere(int columns, int rows)
{
    return ray_mesh_ball(columns, rows, ray_mesh_place_sphere, true);
}

// A knob of .15 m with deep bumps that shadow each other; normals from its faces.
static void ray_mesh_place_bumpy(double u, double v, double p[3], double n[3])
{
    ray_mesh_place_sphere(u, v, p, n);
    const double radius = .15 * (1 + .35 * sin(9 * p[0]) * sin(11 * p[1]) * sin(10 * p[2] + 1) +
                                 .05 * sin(41 * p[0] + 1) * sin(37 * p[1]) * sin(43 * p[2]));
    for (int c = 0; c < 3; c++)
        p[c] *= radius;
}

static inline struct mesh ray_mesh_bumpy(int columns, int rows)
{
    return ray_mesh_ball(columns, rows, ray_mesh_place_bumpy, false);
}

static void ray_mesh_place_floor(double u, double v, double p[3], double n[3])
{
    p[0] = 2 * u - 1, p[1] = 2 * v - 1, p[2] = 0;
    n[2] = 1;
}

// The floor [-1,1]^2 at z = 0 facing up, its UVs u < .9; above it at z = height a horizontal disc
// of n_rim corners about the z axis, facing up, its UVs in a corner of the atlas.
static inline struct mesh ray_mesh_disc_above_floor(double height, double radius, int n_rim)
{
    struct ray_mesh_arrays a;
    ray_mesh_reserve(&a, 4 + n_rim + 1, 2 + n_rim, true);
    ray_mesh_grid(&a, 1, 1, 0, .9, ray_mesh_place_floor);
    const uint32_t centre = (uint32_t)a.n_vertices;
    for (int i = -1; i < n_rim; i++, a.n_vertices++) {
        const double c = i < 0 ? 0 : cos(6.283185307179586 * i / n_rim),
                     s = i < 0 ? 0 : sin(6.283185307179586 * i / n_rim);
        a.position[a.n_vertices][0] = (float)(radius * c);
        a.position[a.n_vertices][1] = (float)(radius * s);
        a.position[a.n_vertices][2] = (float)height;
        a.normal[a.n_vertices][2] = 1;
        a.uv[a.n_vertices][0] = (float)(.95 + .04 * c);
        a.uv[a.n_vertices][1] = (float)(.95 + .04 * s);
    }
    for (int i = 0; i < n_rim; i++, a.n_triangles++) {
        a.triangle[a.n_triangles][0] = centre;
        a.triangle[a.n_triangles][1] = centre + 1 + (uint32_t)i;
        a.triangle[a.n_triangles][2] = centre + 1 + (uint32_t)((i + 1) % n_rim);
    }
    return ray_mesh_finish(&a);
}
