// tests/test_texels.c - every texel of an atlas once, with the right place, frame and neighbours.
#include "solver/random.h"
#include "solver/take/log.h"
#include "solver/texels.h"
#include "solver/vec3.h"

#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

static char logged[1024];

static void keep_error(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    if (level == LOG_ERROR)
        snprintf(logged, sizeof(logged), "%s", message);
}

// A mesh of n_v vertices with UVs and positions as given; copies.
static struct mesh make_mesh(int n_v, const float (*position)[3], const float (*uv)[2], int n_t,
                             const uint32_t (*triangle)[3])
{
    struct mesh m;
    float(*p)[3] = malloc((size_t)n_v * sizeof(*p)), (*t)[2] = malloc((size_t)n_v * sizeof(*t));
    uint32_t(*f)[3] = malloc((size_t)n_t * sizeof(*f));
    memcpy(p, position, (size_t)n_v * sizeof(*p));
    memcpy(t, uv, (size_t)n_v * sizeof(*t));
    memcpy(f, triangle, (size_t)n_t * sizeof(*f));
    assert_int_equal(mesh_from_arrays(&m, n_v, p, NULL, t, n_t, f), 0);
    return m;
}

enum { CELLS = 24, SIDE = CELLS + 1 };

// The unit square cut into triangles with corners shaken (so little that every cell stays convex), random diagonals and random
// winding. snap > 0: corners on multiples of 1 / snap, so that centres of texels lie exactly on corners and edges.
static struct mesh random_atlas(uint64_t seed, int snap)
{
    float uv[SIDE * SIDE][2], position[SIDE * SIDE][3];
    uint32_t triangle[2 * CELLS * CELLS][3];
    for (int i = 0; i < SIDE * SIDE; i++)
        for (int c = 0; c < 2; c++) {
            const int k = c ? i / SIDE : i % SIDE;
            double x = (double)k / CELLS;
            if (k > 0 && k < CELLS) {
                x += .15 / CELLS * (2 * random_uniform(seed, (uint64_t)c, (uint64_t)i) - 1);
                x = snap ? floor(x * snap + .5) / snap : x;
            }
            uv[i][c] = (float)x;
            position[i][c] = (float)random_uniform(seed, 2 + (uint64_t)c, (uint64_t)i);
            position[i][2] = (float)random_uniform(seed, 9, (uint64_t)i);
        }
    for (int i = 0; i < CELLS * CELLS; i++) {
        const uint32_t a = (uint32_t)(i / CELLS * SIDE + i % CELLS), b = a + 1, c = a + SIDE, d = c + 1;
        const uint64_t dice = random_u64(seed, 8, (uint64_t)i);
        const uint32_t both[2][2][3] = { { { a, b, d }, { a, d, c } }, { { a, b, c }, { b, d, c } } };
        for (int k = 0; k < 2; k++)
            for (int j = 0; j < 3; j++)
                triangle[2 * i + k][dice & (2u << k) ? 2 - j : j] = both[dice & 1][k][j];
    }
    return make_mesh(SIDE * SIDE, (const float(*)[3])position, (const float(*)[2])uv, 2 * CELLS * CELLS,
                     (const uint32_t(*)[3])triangle);
}

static void neighbours_leave_no_gap_and_share_no_texel(void **state)
{
    (void)state;
    static const int sizes[] = { 1, 2, 37, 64, 256, 1000, 1024 };
    for (uint64_t seed = 0; seed < 12; seed++) {
        struct mesh m = random_atlas(seed, seed % 3 == 0 ? 0 : seed % 3 == 1 ? 128 : 512);
        for (size_t s = 0; s < sizeof(sizes) / sizeof(sizes[0]); s++) {
            const size_t n = (size_t)sizes[s] * (size_t)sizes[s];
            uint8_t *count = malloc(n);
            texels_count_cover(count, &m, sizes[s]);
            for (size_t i = 0; i < n; i++)
                assert_int_equal(count[i], 1);
            free(count);
        }
        mesh_free(&m);
    }
}

static void covered_means_the_centre_lies_in_the_triangle(void **state)
{
    (void)state;
    enum { SIZE = 61 };
    for (uint64_t seed = 0; seed < 300; seed++) {
        float uv[3][2];
        const float position[3][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } };
        const uint32_t triangle[1][3] = { { 0, 1, 2 } };
        for (int i = 0; i < 6; i++) // some corners outside [0,1]: clipped, not wrapped
            uv[i / 2][i % 2] = (float)(3 * random_uniform(seed, 5, (uint64_t)i) - 1);
        struct mesh m = make_mesh(3, position, (const float(*)[2])uv, 1, triangle);
        uint8_t count[SIZE * SIZE];
        texels_count_cover(count, &m, SIZE);
        for (int i = 0; i < SIZE * SIZE; i++) {
            const double u = (i % SIZE + .5) / SIZE, v = 1 - (i / SIZE + .5) / SIZE;
            double least = 1e9, area2 = 0;
            double e[3];
            for (int k = 0; k < 3; k++) {
                const float *p = uv[(k + 1) % 3], *q = uv[(k + 2) % 3];
                e[k] = ((double)q[0] - p[0]) * (v - p[1]) - ((double)q[1] - p[1]) * (u - p[0]);
                area2 += e[k];
            }
            for (int k = 0; k < 3; k++)
                least = fmin(least, e[k] / fabs(area2) * (area2 < 0 ? -1 : 1));
            if (fabs(least) * fabs(area2) > 1e-6) // the snapping may decide nearer than that
                assert_int_equal(count[i], least > 0);
        }
        mesh_free(&m);
    }
}

static void largest_texture_and_furthest_corners_do_not_overflow(void **state)
{
    (void)state;
    const int size = 16384;
    const float position[4][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 1, 1, 0 }, { 0, 1, 0 } };
    const float uv[4][2] = { { -16, -16 }, { 16, -15.9f }, { 15.7f, 16 }, { -15.8f, 15.9f } };
    const uint32_t triangle[2][3] = { { 0, 1, 2 }, { 0, 2, 3 } };
    struct mesh m = make_mesh(4, position, uv, 2, triangle);
    const size_t n = (size_t)size * (size_t)size;
    uint8_t *count = malloc(n);
    if (count) {
        texels_count_cover(count, &m, size);
        assert_int_equal(count[0], 1);
        assert_memory_equal(count, count + 1, n - 1); // all are as the first
    }
    free(count);
    mesh_free(&m);
}

// Flat quad: u along (0,2,0), v along (0,0,3) from (1,0,0); the normal points to +x. mirrored: u runs the other way.
static struct mesh flat_quad(bool mirrored)
{
    const float position[4][3] = { { 1, 0, 0 }, { 1, 2, 0 }, { 1, 2, 3 }, { 1, 0, 3 } };
    const float plain[4][2] = { { 0, 0 }, { 1, 0 }, { 1, 1 }, { 0, 1 } };
    const float flipped[4][2] = { { 1, 0 }, { 0, 0 }, { 0, 1 }, { 1, 1 } };
    const uint32_t triangle[2][3] = { { 0, 1, 2 }, { 0, 2, 3 } };
    return make_mesh(4, position, mirrored ? flipped : plain, 2, triangle);
}

static void texels_know_their_place_and_frame(void **state)
{
    (void)state;
    for (int mirrored = 0; mirrored < 2; mirrored++) {
        struct mesh m = flat_quad(mirrored);
        struct texels t;
        assert_int_equal(texels_rasterise(&t, &m, 50), 0);
        assert_int_equal(t.n, 50 * 50);
        assert_true(fabs(t.texel_size_m - sqrt(6. / 2500)) < 1e-6);
        for (int i = 0; i < t.n; i++) {
            const int row = (int)t.pixel[i] / 50, column = (int)t.pixel[i] % 50;
            const double u = (column + .5) / 50, v = 1 - (row + .5) / 50;
            assert_int_equal(t.index[t.pixel[i]], i);
            assert_true(fabs(t.position_m[i][0] - 1.) < 1e-6);
            assert_true(fabs(t.position_m[i][1] - 2 * (mirrored ? 1 - u : u)) < 1e-6);
            assert_true(fabs(t.position_m[i][2] - 3 * v) < 1e-6);
            assert_true(fabs(t.normal[i][0] - 1.) < 1e-6);
            assert_true(fabs(t.tangent[i][1] - (mirrored ? -1. : 1.)) < 1e-6);
            const float *b = t.barycentric[i];
            const uint32_t *corners = m.triangle[t.triangle[i]];
            for (int c = 0; c < 3; c++) {
                const double x = (1. - b[0] - b[1]) * m.position_m[corners[0]][c] +
                                 b[0] * (double)m.position_m[corners[1]][c] + b[1] * (double)m.position_m[corners[2]][c];
                assert_true(fabs(x - t.position_m[i][c]) < 1e-6);
            }
            const bool rim = row == 0 || column == 0 || row == 49 || column == 49;
            assert_int_equal(t.flags[i], rim ? TEXEL_BOUNDARY : 0); // the diagonal is no border
        }
        texels_free(&t);
        mesh_free(&m);
    }
}

static void frames_are_orthonormal_on_a_crumpled_surface(void **state)
{
    (void)state;
    struct mesh m = random_atlas(77, 0); // positions are noise, windings too
    struct texels t;
    assert_int_equal(texels_rasterise(&t, &m, 200), 0);
    for (int i = 0; i < t.n; i++) {
        double n[3], d[3];
        for (int c = 0; c < 3; c++)
            n[c] = t.normal[i][c], d[c] = t.tangent[i][c];
        assert_true(fabs(vec3_norm(n) - 1) < 1e-6);
        assert_true(fabs(vec3_norm(d) - 1) < 1e-6);
        assert_true(fabs(vec3_dot(n, d)) < 1e-6);
        assert_true(t.barycentric[i][0] >= 0 && t.barycentric[i][1] >= 0);
        assert_true(t.barycentric[i][0] + t.barycentric[i][1] <= 1.000001f);
    }
    texels_free(&t);
    mesh_free(&m);
}

static void overlaps_go_to_the_lowest_triangle_and_charts_meet_at_boundaries(void **state)
{
    (void)state;
    // Two pieces apart in 3-D: the first fills the left half of the atlas, the second the middle half on top of it.
    const float position[8][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 1, 1, 0 }, { 0, 1, 0 },
                                   { 5, 0, 0 }, { 6, 0, 0 }, { 6, 1, 0 }, { 5, 1, 0 } };
    const float uv[8][2] = { { 0, 0 }, { .5f, 0 }, { .5f, 1 }, { 0, 1 }, { .25f, 0 }, { .75f, 0 }, { .75f, 1 }, { .25f, 1 } };
    const uint32_t triangle[4][3] = { { 0, 1, 2 }, { 0, 2, 3 }, { 4, 5, 6 }, { 4, 6, 7 } };
    struct mesh m = make_mesh(8, position, uv, 4, triangle);
    struct texels t;
    assert_int_equal(texels_rasterise(&t, &m, 16), 0);
    assert_int_equal(t.n, 12 * 16);
    for (int row = 0; row < 16; row++)
        for (int column = 0; column < 16; column++) {
            const int i = t.index[16 * row + column];
            assert_int_equal(i >= 0, column < 12);
            if (i < 0)
                continue;
            assert_int_equal(t.chart[i], column < 8 ? 0 : 1);
            assert_int_equal(t.triangle[i] < 2, column < 8);
            assert_int_equal(!!(t.flags[i] & TEXEL_OVERLAP), column >= 4 && column < 8);
            const bool rim = row == 0 || row == 15 || column == 0 || column == 7 || column == 8 || column == 11;
            assert_int_equal(!!(t.flags[i] & TEXEL_BOUNDARY), rim);
        }
    assert_true(fabs(t.texel_size_m - sqrt(2. / 256)) < 1e-6); // two square metres over 2 x 128 texels
    texels_free(&t);
    mesh_free(&m);
}

static void gutter_takes_the_nearest_texel_ties_to_the_lower_index(void **state)
{
    (void)state;
    enum { SIZE = 40, N = SIZE * SIZE };
    int32_t index[N];
    float image[2 * N];
    for (uint64_t seed = 0; seed < 40; seed++) {
        const int radius = (int)(seed % 10), share = seed % 4 == 0 ? 300 : seed % 4 == 1 ? 30 : 4;
        const struct texels t = { .size = SIZE, .index = index };
        for (int i = 0; i < N; i++) {
            index[i] = random_u64(seed, 6, (uint64_t)i) % (uint64_t)share == 0 ? i : -1;
            image[2 * i] = index[i] < 0 ? -1 : (float)i;
            image[2 * i + 1] = index[i] < 0 ? -2 : (float)-i;
        }
        assert_int_equal(texels_fill_gutter(&t, image, 2, radius), 0);
        for (int i = 0; i < N; i++) {
            int best = index[i] >= 0 ? i : -1, best2 = radius * radius;
            for (int j = 0; j < N && index[i] < 0; j++) {
                const int dx = j % SIZE - i % SIZE, dy = j / SIZE - i / SIZE, d2 = dx * dx + dy * dy;
                if (index[j] >= 0 && (d2 < best2 || (d2 == best2 && best < 0)))
                    best2 = d2, best = j;
            }
            assert_true(image[2 * i] == (float)best);
            assert_true(image[2 * i + 1] == (float)(best < 0 ? -2 : -best));
        }
    }
}

static void atlas_that_covers_no_texel_is_an_error(void **state)
{
    (void)state;
    const float position[3][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } };
    const float outside[3][2] = { { 2, 2 }, { 3, 2 }, { 2, 3 } }, point[3][2] = { { .5f, .5f }, { .5f, .5f }, { .5f, .5f } };
    const float far[3][2] = { { -1e30f, 0 }, { 1e30f, 0 }, { 0, 1e30f } };
    const uint32_t triangle[1][3] = { { 0, 1, 2 } };
    const float(*const uvs[3])[2] = { outside, point, far };
    log_set_hook(keep_error, NULL);
    for (int i = 0; i < 3; i++) {
        struct mesh m = make_mesh(3, position, uvs[i], 1, triangle);
        struct texels t;
        assert_int_equal(texels_rasterise(&t, &m, 64), -EINVAL);
        assert_non_null(strstr(logged, "unwrap the mesh"));
        assert_null(t.index);
        assert_int_equal(texels_rasterise(&t, &m, 16385), -EINVAL);
        assert_non_null(strstr(logged, "16385"));
        assert_int_equal(texels_rasterise(&t, &m, 0), -EINVAL);
        mesh_free(&m);
    }
    log_set_hook(NULL, NULL);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(neighbours_leave_no_gap_and_share_no_texel),
        cmocka_unit_test(covered_means_the_centre_lies_in_the_triangle),
        cmocka_unit_test(largest_texture_and_furthest_corners_do_not_overflow),
        cmocka_unit_test(texels_know_their_place_and_frame),
        cmocka_unit_test(frames_are_orthonormal_on_a_crumpled_surface),
        cmocka_unit_test(overlaps_go_to_the_lowest_triangle_and_charts_meet_at_boundaries),
        cmocka_unit_test(gutter_takes_the_nearest_texel_ties_to_the_lower_index),
        cmocka_unit_test(atlas_that_covers_no_texel_is_an_error),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
