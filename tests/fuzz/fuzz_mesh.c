// tests/fuzz/fuzz_mesh.c - our own part of reading meshes: files before assimp sees them, and arrays of any numbers.
//
// Input: a mesh file; or 0xff, a byte (vertices), then vertices of five floats, then triangles of three bytes.
#include "solver/mesh.h"
#include "solver/mesh_import.h"
#include "solver/take/log.h"
#include "solver/texels.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static void check_file(const uint8_t *bytes, size_t n)
{
    char *copy = malloc(n + 1); // as file_read() leaves it
    int format;
    memcpy(copy, bytes, n);
    copy[n] = 0;
    struct mesh_file f = { .path = "fuzz", .bytes = copy, .n_bytes = n };
    char *floats;
    size_t n_floats;
    if (!mesh_check_file(&f, &format) && f.is_quantised && !mesh_gltf_floats(&floats, &n_floats, &f)) {
        struct mesh_file again = { .path = "again", .bytes = floats, .n_bytes = n_floats };
        if (mesh_check_file(&again, &format) || again.is_quantised)
            abort();
        free(floats);
    }
    free(copy);
}

static void check_arrays(const uint8_t *bytes, size_t n)
{
    const int n_vertices = bytes[0] < (n - 1) / 20 ? bytes[0] : (int)((n - 1) / 20);
    const size_t n_left = n - 1 - (size_t)n_vertices * 20;
    const int n_triangles = n_left / 3 < 12 ? (int)(n_left / 3) : 12;
    float(*position)[3] = calloc((size_t)n_vertices + 1, sizeof(*position)), (*uv)[2] = calloc((size_t)n_vertices + 1, sizeof(*uv));
    uint32_t(*triangle)[3] = calloc((size_t)n_triangles + 1, sizeof(*triangle));
    struct mesh m;
    struct mesh_check check;
    struct texels t;
    for (int i = 0; i < n_vertices; i++) {
        memcpy(position[i], bytes + 1 + 20 * i, 12);
        memcpy(uv[i], bytes + 13 + 20 * i, 8);
    }
    for (int i = 0; i < 3 * n_triangles; i++)
        triangle[i / 3][i % 3] = bytes[1 + 20 * n_vertices + i];
    if (mesh_from_arrays(&m, n_vertices, position, NULL, uv, n_triangles, triangle)) {
        if (m.position_m || m.n_triangles)
            abort();
        return;
    }
    for (int i = 0; i < m.n_vertices; i++) {
        const float *v = m.normal[i];
        if (m.point[i] >= (uint32_t)m.n_points || !(fabsf(v[0] * v[0] + v[1] * v[1] + v[2] * v[2] - 1) < 1e-5f))
            abort();
    }
    for (int i = 0; i < m.n_triangles; i++)
        if (m.chart[i] < 0 || m.chart[i] >= m.n_charts)
            abort();
    mesh_check_run(&m, &check);
    if (!(check.overlap_fraction >= 0 && check.overlap_fraction <= 1) || check.n_zero_area > m.n_triangles)
        abort();
    if (texels_rasterise(&t, &m, 37) == 0) {
        for (int i = 0; i < t.n; i++)
            if (t.index[t.pixel[i]] != i || t.triangle[i] >= (uint32_t)m.n_triangles)
                abort();
        texels_free(&t);
    }
    mesh_free(&m);
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    log_set_level(LOG_SILENT);
    if (n > 2 && bytes[0] == 0xff)
        check_arrays(bytes + 1, n - 1);
    else
        check_file(bytes, n);
    return 0;
}
