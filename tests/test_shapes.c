// tests/test_shapes.c - objects made by code are closed, outward, cleanly unwrapped; the pebble
// does not shadow itself.
#include "solver/rays.h"
#include "solver/shapes.h"
#include "solver/texels.h"
#include "solver/vec3.h"

#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

static const double centre_m[3] = {.4, -.2, 1.1};
static const int details[] = {100, 1500, 20000};
enum { N_DETAILS = sizeof(details) / sizeof(details[0]) };

static void make(struct mesh *mesh, enum shape shape, int detail)
{
    assert_int_equal(shape_make(mesh, shape, centre_m, .3, detail), 0);
}

static void get_corners(const struct mesh *mesh, int triangle, double corner[3][3])
{
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < 3; i++)
            corner[k][i] = mesh->position_m[mesh->triangle[triangle][k]][i];
}

static void cross_of(const struct mesh *mesh, int triangle, double cross[3])
{
    double corner[3][3], e1[3], e2[3];
    get_corners(mesh, triangle, corner);
    vec3_sub(e1, corner[1], corner[0]);
    vec3_sub(e2, corner[2], corner[0]);
    vec3_cross(cross, e1, e2);
}

static void every_shape_is_a_closed_manifold_with_a_clean_atlas(void **state)
{
    (void)state;
    static const int charts[SHAPE_N] = {6, 4, 24, 6};
    for (int shape = 0; shape < SHAPE_N; shape++) {
        for (int d = 0; d < N_DETAILS; d++) {
            struct mesh mesh;
            struct mesh_check check;
            make(&mesh, shape, details[d]);
            mesh_check_run(&mesh, &check);
            assert_int_equal(check.n_boundary_edges, 0);
            assert_int_equal(check.n_non_manifold_edges, 0);
            assert_int_equal(check.n_zero_area, 0);
            assert_int_equal(check.n_zero_area_uv, 0);
            assert_int_equal(check.n_mirrored_uv, 0);
            assert_int_equal(check.n_out_of_range_uv, 0);
            assert_true(check.overlap_fraction == 0);
            assert_int_equal(check.n_charts, charts[shape]);
            mesh_free(&mesh);
        }
    }
}

static void winding_is_outward_and_normals_follow_the_facets(void **state)
{
    (void)state;
    for (int shape = 0; shape < SHAPE_N; shape++) {
        struct mesh mesh;
        double volume = 0;
        make(&mesh, shape, 20000);
        for (int t = 0; t < mesh.n_triangles; t++) {
            double corner[3][3], cross[3], from_centre[3];
            get_corners(&mesh, t, corner);
            cross_of(&mesh, t, cross);
            vec3_sub(from_centre, corner[0], centre_m);
            volume += vec3_dot(from_centre, cross) / 6;
            vec3_normalise(cross);
            for (int k = 0; k < 3; k++) {
                const float *n = mesh.normal[mesh.triangle[t][k]];
                assert_float_equal(n[0] * n[0] + n[1] * n[1] + n[2] * n[2], 1, 1e-5);
                // lips are turned within a few rows of facets, so 24 degrees there; a wrong normal
                // is far off
                assert_true(cross[0] * n[0] + cross[1] * n[1] + cross[2] * n[2] > .9);
            }
        }
        assert_true(volume > .02 * 4 / 3 * M_PI * .3 * .3 * .3);
        mesh_free(&mesh);
    }
}

static void size_and_place_are_as_asked(void **state)
{
    (void)state;
    for (int shape = 0; shape < SHAPE_N; shape++) {
        struct mesh mesh;
        double farthest = 0;
        make(&mesh, shape, 5000);
        for (int i = 0; i < 3; i++)
            assert_float_equal((mesh.bounds_m[0][i] + mesh.bounds_m[1][i]) / 2, centre_m[i], 1e-6);
        for (int v = 0; v < mesh.n_vertices; v++) {
            const double d[3] = {mesh.position_m[v][0] - centre_m[0],
                                 mesh.position_m[v][1] - centre_m[1],
                                 mesh.position_m[v][2] - centre_m[2]};
            farthest = fmax(farthest, vec3_norm(d));
        }
        assert_float_equal(farthest, .3, 1e-6);
        assert_true(mesh.n_triangles > 3500 && mesh.n_triangles < 6500);
        mesh_free(&mesh);
    }
}

// Distances on the surface against distances in the atlas, along both directions of every
// triangle's map: texels of one size should cover about one size of surface.
static void atlas_distortion_stays_low(void **state)
{
    (void)state;
    for (int shape = 0; shape < SHAPE_N; shape++) {
        struct mesh mesh;
        double area = 0, area_uv = 0, bad = 0;
        make(&mesh, shape, 20000);
        for (int t = 0; t < mesh.n_triangles; t++) {
            double cross[3];
            const float *a = mesh.uv[mesh.triangle[t][0]], *b = mesh.uv[mesh.triangle[t][1]],
                        *c = mesh.uv[mesh.triangle[t][2]];
            cross_of(&mesh, t, cross);
            area += vec3_norm(cross);
            area_uv +=
                (b[0] - a[0]) * (double)(c[1] - a[1]) - (b[1] - a[1]) * (double)(c[0] - a[0]);
        }
        const double expected = area_uv / area;
        for (int t = 0; t < mesh.n_triangles; t++) {
            double cross[3];
            const float *a = mesh.uv[mesh.triangle[t][0]], *b = mesh.uv[mesh.triangle[t][1]],
                        *c = mesh.uv[mesh.triangle[t][2]];
            cross_of(&mesh, t, cross);
            const double ratio =
                ((b[0] - a[0]) * (double)(c[1] - a[1]) - (b[1] - a[1]) * (double)(c[0] - a[0])) /
                vec3_norm(cross) / expected;
            if (ratio < .3 || ratio > 3)
                bad += vec3_norm(cross);
        }
        fprintf(stderr,
                "# %s: atlas filled to %.0f%%, texel density off by more than 3x on %.2f%% of the "
                "surface\n",
                shape_names[shape], 50 * area_uv, 100 * bad / area);
        assert_true(bad / area < .05);
        assert_true(area_uv / 2 > .35);
        mesh_free(&mesh);
    }
}

// Charts keep at least 1/48 between each other and from the border: dilate every covered texel by
// just under that and no two charts may meet.
static void charts_keep_their_distance(void **state)
{
    (void)state;
    enum { SIZE = 480, REACH = SIZE / 48 };
    for (int shape = 0; shape < SHAPE_N; shape++) {
        struct mesh mesh;
        struct texels t;
        make(&mesh, shape, 5000);
        assert_int_equal(texels_rasterise(&t, &mesh, SIZE), 0);
        for (int i = 0; i < t.n; i++) {
            const int x = (int)(t.pixel[i] % SIZE), y = (int)(t.pixel[i] / SIZE);
            assert_true(x >= REACH - 1 && y >= REACH - 1 && x <= SIZE - REACH && y <= SIZE - REACH);
            for (int dy = 0; dy <= REACH - 1; dy++) {
                for (int dx = -REACH + 1; dx <= REACH - 1; dx++) {
                    if (x + dx < 0 || x + dx >= SIZE || y + dy >= SIZE)
                        continue;
                    const int j = t.index[(y + dy) * SIZE + x + dx];
                    if (j >= 0)
                        assert_int_equal(t.chart[j], t.chart[i]);
                }
            }
        }
        texels_free(&t);
        mesh_free(&mesh);
    }
}

static float read_bilinearly(const float *image, int size, double u, double v)
{
    const double x = u * size - .5, y = (1 - v) * size - .5;
    const int column = (int)floor(x), row = (int)floor(y);
    double sum = 0;
    for (int k = 0; k < 4; k++) {
        const int i = column + k % 2, j = row + k / 2;
        assert_true(i >= 0 && j >= 0 && i < size && j < size);
        sum += (1 - fabs(x - i)) * (1 - fabs(y - j)) * (double)image[j * size + i];
    }
    return (float)sum;
}

// From 128 texels on: every chart in a colour of its own, the gutter filled, read
// at corners, on edges and inside of all triangles.
static void what_is_painted_on_a_chart_is_read_back_all_over_it(void **state)
{
    (void)state;
    static const int sizes[] = {128, 192, 256};
    for (int i = 0; i < SHAPE_N * 3; i++) {
        enum { STEPS = 4 };
        const int size = sizes[i / SHAPE_N];
        struct mesh mesh;
        struct texels t;
        float *image = calloc((size_t)size * (size_t)size, sizeof(*image));
        make(&mesh, (enum shape)(i % SHAPE_N), 5000);
        assert_non_null(image);
        assert_int_equal(texels_rasterise(&t, &mesh, size), 0);
        for (int k = 0; k < t.n; k++)
            image[t.pixel[k]] = (float)(1 + t.chart[k]);
        assert_int_equal(texels_fill_gutter(&t, image, 1, 4), 0);
        for (int k = 0; k < mesh.n_triangles; k++) {
            for (int a = 0; a <= STEPS; a++) {
                for (int b = 0; a + b <= STEPS; b++) {
                    const double w[3] = {(double)a / STEPS, (double)b / STEPS,
                                         (double)(STEPS - a - b) / STEPS};
                    double uv[2] = {0, 0};
                    for (int c = 0; c < 3; c++)
                        for (int d = 0; d < 2; d++)
                            uv[d] += w[c] * (double)mesh.uv[mesh.triangle[k][c]][d];
                    assert_float_equal(read_bilinearly(image, size, uv[0], uv[1]),
                                       1 + mesh.chart[k], 1e-5);
                }
            }
        }
        free(image);
        texels_free(&t);
        mesh_free(&mesh);
    }
}

static void a_pebble_never_shadows_itself(void **state)
{
    (void)state;
    struct mesh mesh;
    struct rays *rays;
    struct texels t;
    int64_t n_rays = 0;
    make(&mesh, SHAPE_PEBBLE, 20000);
    assert_int_equal(rays_new(&rays, &mesh), 0);
    assert_int_equal(texels_rasterise(&t, &mesh, 96), 0);
    for (int i = 0; i < t.n; i++) {
        const float *n = t.normal[i];
        float start_m[3];
        rays_start(rays, t.triangle[i], t.barycentric[i], start_m);
        for (int k = 0; k < 200; k++) { // a spiral over the sphere
            const double z = 1 - (2 * k + 1) / 200., s = sqrt(1 - z * z),
                         angle = 2.399963 * k + .1 * i;
            const float l[3] = {(float)(s * cos(angle)), (float)(s * sin(angle)), (float)z};
            if (n[0] * l[0] + n[1] * l[1] + n[2] * l[2] <= .05f)
                continue;
            n_rays++;
            assert_false(rays_blocked(rays, start_m, l, 0, INFINITY));
        }
    }
    assert_true(n_rays > 100000);
    texels_free(&t);
    rays_free(rays);
    mesh_free(&mesh);
}

static void knot_and_bowl_do_shadow_themselves(void **state)
{
    (void)state;
    static const enum shape concave[] = {SHAPE_KNOT, SHAPE_BOWL};
    for (int s = 0; s < 2; s++) {
        struct mesh mesh;
        struct rays *rays;
        int n_blocked = 0;
        make(&mesh, concave[s], 5000);
        assert_int_equal(rays_new(&rays, &mesh), 0);
        for (int t = 0; t < mesh.n_triangles; t++) {
            double cross[3];
            float start_m[3], along[3];
            cross_of(&mesh, t, cross);
            vec3_normalise(cross);
            for (int i = 0; i < 3; i++)
                along[i] = (float)cross[i];
            rays_start(rays, (uint32_t)t, (const float[2]){.33f, .33f}, start_m);
            n_blocked += rays_blocked(rays, start_m, along, 0, INFINITY);
        }
        assert_true(n_blocked > mesh.n_triangles / 20);
        rays_free(rays);
        mesh_free(&mesh);
    }
}

static void the_same_arguments_give_the_same_bytes(void **state)
{
    (void)state;
    for (int shape = 0; shape < SHAPE_N; shape++) {
        struct mesh a, b;
        make(&a, shape, 3000);
        make(&b, shape, 3000);
        assert_int_equal(a.n_vertices, b.n_vertices);
        assert_memory_equal(a.position_m, b.position_m,
                            (size_t)a.n_vertices * sizeof(*a.position_m));
        assert_memory_equal(a.normal, b.normal, (size_t)a.n_vertices * sizeof(*a.normal));
        assert_memory_equal(a.uv, b.uv, (size_t)a.n_vertices * sizeof(*a.uv));
        assert_memory_equal(a.triangle, b.triangle, (size_t)a.n_triangles * sizeof(*a.triangle));
        mesh_free(&a), mesh_free(&b);
    }
}

static void impossible_arguments_are_refused(void **state)
{
    (void)state;
    struct mesh mesh;
    assert_int_equal(shape_make(&mesh, SHAPE_N, centre_m, .3, 1000), -EINVAL);
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, centre_m, 0, 1000), -EINVAL);
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, centre_m, (double)NAN, 1000), -EINVAL);
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, centre_m, .3, 99), -EINVAL);
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, centre_m, .3, 4000001), -EINVAL);
    assert_null(mesh.position_m);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(every_shape_is_a_closed_manifold_with_a_clean_atlas),
        cmocka_unit_test(winding_is_outward_and_normals_follow_the_facets),
        cmocka_unit_test(size_and_place_are_as_asked),
        cmocka_unit_test(atlas_distortion_stays_low),
        cmocka_unit_test(charts_keep_their_distance),
        cmocka_unit_test(what_is_painted_on_a_chart_is_read_back_all_over_it),
        cmocka_unit_test(a_pebble_never_shadows_itself),
        cmocka_unit_test(knot_and_bowl_do_shadow_themselves),
        cmocka_unit_test(the_same_arguments_give_the_same_bytes),
        cmocka_unit_test(impossible_arguments_are_refused),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
