// solver/mesh_import.h - private to mesh.c, mesh_import.c and their fuzzer.
#pragma once
#include "solver/mesh.h"
#include <stddef.h>
#include <stdint.h>

// ids[i] = number of item i (n_words 32-bit words, compared bit by bit) among the distinct ones, in order of first appearance.
// n <= 2^31. Returns how many there are, or -ENOMEM.
int64_t mesh_number_distinct(uint32_t *ids, const void *items, size_t n_words, size_t n);

bool mesh_triangle_has_area(const struct mesh *mesh, int triangle); // in 3-D

// A mesh file in memory; bytes[n_bytes] is NUL.
struct mesh_file {
    const char *path, *bytes;
    size_t n_bytes;
    int64_t n_promised; // triangles by the file's own account; -1: not counted
    bool is_quantised;  // glTF: some attributes are whole numbers
};
// Finds the format by content and checks counts, ranges and lengths before a library sees the bytes. 0 and *format (a number for
// mesh_import.c) and n_promised, -EINVAL, -ENOTSUP, -ENOMEM; logged.
int mesh_check_file(struct mesh_file *f, int *format);

// A checked glTF or GLB that is_quantised, as the same kind of file with floats. 0 and malloc'd bytes (a NUL after them), -EINVAL,
// -EFBIG, -ENOMEM, -errno of a buffer's open (logged but for -ENOMEM).
int mesh_gltf_floats(char **out, size_t *n_out, const struct mesh_file *f);

// name in the folder of path, as it is or (where there is no such file) percent-decoded. NULL without memory.
char *mesh_path_beside(const char *path, const char *name);
