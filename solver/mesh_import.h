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
};
// Finds the format by content and checks counts, ranges and lengths before a library sees the bytes. 0 and *format (a number for
// mesh_import.c) and n_promised, -EINVAL, -ENOTSUP, -ENOMEM; logged.
int mesh_check_file(struct mesh_file *f, int *format);
