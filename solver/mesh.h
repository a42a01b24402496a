// solver/mesh.h - triangles with a UV atlas, from OBJ, PLY, glTF or GLB (assimp lives in mesh_import.c only).
//
// Vertices are split where UV or normal differ; vertices at one place share a `point`. UV origin is bottom-left (OBJ); glTF's
// top-left is converted on import. Node transforms are applied; several meshes are merged; positions are kept in the
// file's units and axes (metres are the caller's promise). A triangle without UVs in a mesh that has some: all its corners are
// at UV (0, 0).
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct mesh {
    int n_vertices, n_triangles;
    float (*position_m)[3]; // [n_vertices]
    float (*normal)[3];     // [n_vertices] unit: the file's, else angle-weighted over all faces at the point
    float (*uv)[2];         // [n_vertices]
    uint32_t (*triangle)[3]; // [n_triangles] vertex indices, counter-clockwise seen from outside
    uint32_t *point;        // [n_vertices] id of the place: equal for vertices at exactly one position
    int n_points;
    int32_t *chart;         // [n_triangles] connected piece of the atlas (triangles that share an edge in 3-D *and* in UV)
    int n_charts;
    double bounds_m[2][3];  // min, max
};

// What is wrong or unusual about the geometry and its atlas: outcomes, not errors. mesh_check_text() puts it in words.
struct mesh_check {
    int n_zero_area;         // triangles without area in 3-D: dropped on import, counted here
    int n_missing_uv;        // triangles without UVs (import refuses when that is all of them)
    int n_zero_area_uv;      // area in 3-D, none in UV: never textured
    int n_out_of_range_uv;   // some corner outside [0,1] by more than 1e-5
    int n_mirrored_uv;       // clockwise in UV
    int n_charts;
    double overlap_fraction; // share of covered texels (1024^2) that lie inside more than one triangle
    int n_non_manifold_edges, n_boundary_edges; // over points
};

// Read a mesh and check it. check may be NULL. Errors, each logged with file, place, found, expected, remedy:
// -errno of the open, -EINVAL (broken, truncated, no triangles, no UVs, NaN positions, an index out of range),
// -ENOTSUP (format; a glTF extension such as Draco), -EFBIG (> 2^26
// triangles), -ENOMEM.
int mesh_read(struct mesh *out, struct mesh_check *check, const char *path);

// Take over arrays made by code: fills normals where normal is NULL, point, chart, bounds. The mesh owns the arrays
// (malloc'd) afterwards, also on failure. 0, -EINVAL, -ENOMEM.
int mesh_from_arrays(struct mesh *out, int n_vertices, float (*position_m)[3], float (*normal)[3],
                     float (*uv)[2], int n_triangles, uint32_t (*triangle)[3]);
void mesh_check_run(const struct mesh *mesh, struct mesh_check *check); // the geometric part of mesh_read's check
// One warning per finding ("mesh: vase.obj: 120 of 5,200 triangles have mirrored UVs: ..."), nothing for a clean mesh.
void mesh_check_log(const struct mesh_check *check, const struct mesh *mesh, const char *path);

int mesh_write_obj(const struct mesh *mesh, const char *path); // v, vt, vn; atomic; 0 or -errno (logged)
void mesh_free(struct mesh *mesh);                             // NULL and zeroed allowed; leaves it zeroed
