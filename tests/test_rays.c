// tests/test_rays.c - Embree's answers are those of a brute-force intersector, without leaks, and
// hostile rays do no harm.
#include "solver/parallel.h"
#include "solver/random.h"
#include "solver/rays.h"
#include "solver/take/log.h"
#include "tests/ray_margin.h"
#include "tests/ray_meshes.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

static struct rays *rays_of(const struct mesh *mesh)
{
    struct rays *rays;
    assert_int_equal(rays_new(&rays, mesh), 0);
    return rays;
}

// A ray somewhere near the mesh, exactly representable as float.
static void random_ray(const struct mesh *mesh, int i, float origin[3], float dir[3])
{
    for (int c = 0; c < 3; c++) {
        const double extent = mesh->bounds_m[1][c] - mesh->bounds_m[0][c];
        origin[c] = (float)(mesh->bounds_m[0][c] +
                            extent * (1.5 * random_uniform(1, (uint64_t)i, (uint64_t)c) - .25));
        dir[c] = (float)random_normal(2, (uint64_t)i, (uint64_t)c);
    }
}

static void blocked_as_brute_force_says_except_within_a_millionth_of_an_edge(void **state)
{
    (void)state;
    struct mesh meshes[] = { ray_mesh_bumpy(40, 20), ray_mesh_sphere(5, 3),
                             ray_mesh_disc_above_floor(.5, .4, 12) };
    int n_blocked = 0, n_grazing = 0, n_all = 0;
    for (int m = 0; m < 3; m++) {
        struct rays *rays = rays_of(&meshes[m]);
        double diagonal[3];
        vec3_sub(diagonal, meshes[m].bounds_m[1], meshes[m].bounds_m[0]);
        const double tolerance_m = 1e-6 * vec3_norm(diagonal);
        for (int i = 0; i < 3000; i++, n_all++) {
            float origin[3], dir[3];
            random_ray(&meshes[m], i, origin, dir);
            const double o[3] = { origin[0], origin[1], origin[2] },
                         d[3] = { dir[0], dir[1], dir[2] };
            const float t_max = i % 2 ? INFINITY : (float)vec3_norm(diagonal) / 3;
            const bool brute = rays_blocked_brute_force(&meshes[m], o, d, 0, t_max);
            const double margin_m = ray_margin_m(&meshes[m], o, d, 0, t_max);
            n_blocked += brute;
            if (fabs(margin_m) > 1e-12)
                assert_int_equal(brute, margin_m > 0);
            if (fabs(margin_m) < tolerance_m) {
                n_grazing++;
                continue;
            }
            assert_int_equal(rays_blocked(rays, origin, dir, 0, t_max), brute);
        }
        rays_free(rays);
        mesh_free(&meshes[m]);
    }
    assert_in_range(n_blocked, n_all / 10, n_all * 9 / 10); // both answers are tried
    assert_in_range(n_grazing, 0, n_all / 200);
}

static void many_rays_from_one_point_are_answered_as_each_is(void **state)
{
    (void)state;
    enum { MOST = 70 };
    const float hard[][3] = { { 0, 0, 0 }, { NAN, 0, 1 }, { INFINITY, 0, 1 }, { 1e-30f, 0, 0 }, { -0.f, 0, 1 } };
    struct mesh mesh = ray_mesh_bumpy(40, 20);
    struct rays *rays = rays_of(&mesh);
    int n_blocked = 0, n_all = 0;
    for (int i = 0; i < 500; i++) {
        const int n = i % (MOST + 1), first_hard = i % 7 ? MOST : i % 11;
        float origin[3], unused[3], dir[MOST][3], t_max[MOST];
        uint8_t blocked[MOST + 1];
        random_ray(&mesh, i, origin, unused);
        if (i == 300)
            origin[1] = NAN;
        for (int k = 0; k < n; k++) {
            random_ray(&mesh, 1000 * i + k, unused, dir[k]);
            if (k >= first_hard && k - first_hard < 5)
                memcpy(dir[k], hard[k - first_hard], sizeof(dir[k]));
            t_max[k] = k % 13 == 5 ? 0 : k % 13 == 6 ? NAN : k % 3 ? INFINITY : .2f;
        }
        blocked[n] = 77;
        rays_blocked_from(rays, origin, n, (const float(*)[3])dir, t_max, blocked);
        assert_int_equal(blocked[n], 77);
        for (int k = 0; k < n; k++, n_all++) {
            assert_int_equal(blocked[k], rays_blocked(rays, origin, dir[k], 0, t_max[k]));
            n_blocked += blocked[k];
        }
    }
    assert_in_range(n_blocked, n_all / 10, n_all * 9 / 10);
    rays_free(rays);
    mesh_free(&mesh);
}

static void first_hit_is_the_nearest_and_lies_on_its_triangle(void **state)
{
    (void)state;
    struct mesh mesh = ray_mesh_bumpy(40, 20);
    struct rays *rays = rays_of(&mesh);
    int n_hits = 0;
    for (int i = 0; i < 2000; i++) {
        float origin[3], dir[3];
        random_ray(&mesh, i, origin, dir);
        struct ray_hit hit;
        const bool any = rays_blocked(rays, origin, dir, 0, INFINITY);
        assert_int_equal(rays_hit(rays, origin, dir, 0, INFINITY, &hit), any);
        if (!any)
            continue;
        n_hits++;
        assert_in_range(hit.triangle, 0, mesh.n_triangles - 1);
        const double o[3] = { origin[0], origin[1], origin[2] }, d[3] = { dir[0], dir[1], dir[2] };
        const double step = 1e-5 / vec3_norm(d);
        assert_false(hit.t > step && rays_blocked_brute_force(&mesh, o, d, 0, hit.t - step));
        for (int c = 0; c < 3; c++) {
            const uint32_t *t = mesh.triangle[hit.triangle];
            const double on = (1 - hit.u - hit.v) * mesh.position_m[t[0]][c] +
                              hit.u * mesh.position_m[t[1]][c] + hit.v * mesh.position_m[t[2]][c];
            assert_float_equal(on, o[c] + hit.t * d[c], 2e-6);
        }
    }
    assert_in_range(n_hits, 300, 2000);
    rays_free(rays);
    mesh_free(&mesh);
}

static void nothing_leaks_through_shared_edges_and_corners(void **state)
{
    (void)state;
    struct mesh mesh = ray_mesh_sphere(24, 12);
    struct rays *rays = rays_of(&mesh);
    const float centre[3] = { 0 };
    for (int i = 0; i < mesh.n_triangles; i++)
        for (int k = 0; k < 3; k++) {
            const float *a = mesh.position_m[mesh.triangle[i][k]],
                        *b = mesh.position_m[mesh.triangle[i][(k + 1) % 3]];
            for (int step = 0; step < 16; step++) {
                float dir[3], far[3], back[3];
                for (int c = 0; c < 3; c++) {
                    dir[c] = a[c] + (b[c] - a[c]) * (float)step / 16;
                    far[c] = 3 * dir[c], back[c] = -dir[c];
                }
                assert_true(rays_blocked(rays, centre, dir, 0, INFINITY)); // from inside
                assert_true(rays_blocked(rays, far, back, 0, INFINITY));   // from outside
            }
        }
    rays_free(rays);
    mesh_free(&mesh);
}

static void interval_is_in_units_of_the_direction(void **state)
{
    (void)state;
    struct mesh mesh = ray_mesh_disc_above_floor(.5, .4, 12);
    struct rays *rays = rays_of(&mesh);
    const float origin[3] = { .1f, .05f, 2 },
                down[3] = { 0, 0, -.25f }; // disc at t = 6, floor at t = 8
    assert_true(rays_blocked(rays, origin, down, 0, 6.01f));
    assert_false(rays_blocked(rays, origin, down, 0, 5.99f));
    assert_false(rays_blocked(rays, origin, down, 6.01f, 7.99f));
    assert_true(rays_blocked(rays, origin, down, 6.01f, 8.01f));
    assert_false(rays_blocked(rays, origin, down, 8.01f, INFINITY));
    const float up[3] = { 0, 0, 1 };
    assert_false(rays_blocked(rays, origin, up, -10, INFINITY)); // what lies behind does not count
    struct ray_hit hit;
    assert_true(rays_hit(rays, origin, down, 6.01f, INFINITY, &hit));
    assert_float_equal(hit.t, 8, 1e-5);
    assert_in_range(hit.triangle, 0, 1); // the floor
    rays_free(rays);
    mesh_free(&mesh);
}

static void rays_that_ask_nothing_hit_nothing(void **state)
{
    (void)state;
    struct mesh mesh = ray_mesh_sphere(24, 12);
    struct rays *rays = rays_of(&mesh);
    const float bad[] = { NAN, INFINITY, -INFINITY };
    const float origin[3] = { 0 }, dir[3] = { 1, 0, 0 }, zero[3] = { 0 };
    struct ray_hit hit;
    assert_true(rays_blocked(rays, origin, dir, 0, INFINITY)); // a good ray is blocked
    for (int k = 0; k < 3; k++)
        for (int c = 0; c < 3; c++) {
            float o[3] = { 0 }, d[3] = { 1, 0, 0 };
            o[c] = bad[k];
            assert_false(rays_blocked(rays, o, dir, 0, INFINITY));
            assert_false(rays_hit(rays, o, dir, 0, INFINITY, &hit));
            d[c] = bad[k];
            assert_false(rays_blocked(rays, origin, d, 0, INFINITY));
            assert_false(rays_hit(rays, origin, d, 0, INFINITY, &hit));
        }
    assert_false(rays_blocked(rays, origin, zero, 0, INFINITY));
    assert_false(rays_blocked(rays, origin, dir, NAN, INFINITY));
    assert_false(rays_blocked(rays, origin, dir, 0, NAN));
    assert_false(rays_blocked(rays, origin, dir, 2, 1));
    assert_false(rays_blocked(rays, origin, dir, -5, -1));
    const float huge[3] = { 3e38f, 3e38f, 3e38f }, tiny[3] = { 1e-44f, 0, 0 };
    rays_blocked(rays, huge, huge, 0, INFINITY); // whatever they say: no crash, no endless loop
    rays_blocked(rays, origin, tiny, 0, INFINITY);
    rays_free(rays);
    mesh_free(&mesh);
}

struct concurrent {
    const struct mesh *mesh;
    const struct rays *rays;
    unsigned char *blocked;
};

static void ask(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    const struct concurrent *c = arg;
    for (int64_t i = begin; i < end; i++) {
        float origin[3], dir[3];
        random_ray(c->mesh, (int)i, origin, dir);
        c->blocked[i] = rays_blocked(c->rays, origin, dir, 0, INFINITY);
    }
}

static void many_threads_may_ask_at_once(void **state)
{
    (void)state;
    enum { N = 20000 };
    struct mesh mesh = ray_mesh_bumpy(60, 30);
    struct rays *rays = rays_of(&mesh);
    unsigned char *one = calloc(N, 1), *four = calloc(N, 1);
    parallel_for(1, N, 64, ask, &(struct concurrent){ &mesh, rays, one });
    parallel_for(4, N, 64, ask, &(struct concurrent){ &mesh, rays, four });
    assert_memory_equal(one, four, N);
    free(one);
    free(four);
    rays_free(rays);
    mesh_free(&mesh);
}

static void point_of(const struct mesh *mesh, int triangle, const float barycentric[2],
                     double point[3], double normal[3])
{
    const float w[3] = { 1 - barycentric[0] - barycentric[1], barycentric[0], barycentric[1] };
    for (int c = 0; c < 3; c++) {
        point[c] = normal[c] = 0;
        for (int k = 0; k < 3; k++) {
            point[c] += (double)w[k] * mesh->position_m[mesh->triangle[triangle][k]][c];
            normal[c] += (double)w[k] * mesh->normal[mesh->triangle[triangle][k]][c];
        }
    }
    vec3_normalise(normal);
}

static void coarse_sphere_does_not_shadow_itself_above_its_normals_horizon(void **state)
{
    (void)state;
    struct mesh mesh = ray_mesh_sphere(12, 6); // facets up to 30 degrees wide
    struct rays *rays = rays_of(&mesh);
    int n_flat_would_fail = 0;
    for (int i = 0; i < 20000; i++) {
        const int triangle = (int)(random_u64(3, (uint64_t)i, 0) % (uint64_t)mesh.n_triangles);
        double a = random_uniform(3, (uint64_t)i, 1), b = random_uniform(3, (uint64_t)i, 2);
        if (a + b > 1)
            a = 1 - a, b = 1 - b;
        const float barycentric[2] = { (float)a, (float)b };
        double point[3], normal[3], dir[3];
        point_of(&mesh, triangle, barycentric, point, normal);
        for (int c = 0; c < 3; c++)
            dir[c] = random_normal(4, (uint64_t)i, (uint64_t)c);
        vec3_normalise(dir);
        if (vec3_dot(dir, normal) < .001)
            continue;
        float start[3], flat[3];
        const float d[3] = { (float)dir[0], (float)dir[1], (float)dir[2] };
        rays_start(rays, (uint32_t)triangle, barycentric, start);
        assert_false(rays_blocked(rays, start, d, 0, INFINITY));
        for (int c = 0; c < 3; c++)
            flat[c] = (float)(point[c] + rays_offset_m(rays) * normal[c]);
        n_flat_would_fail += rays_blocked(rays, flat, d, 0, INFINITY);
    }
    assert_in_range(n_flat_would_fail, 100, 20000); // or the sphere is not coarse enough to try it
    rays_free(rays);
    mesh_free(&mesh);
}

static void rays_start_a_hair_above_a_flat_surface_and_never_inside_another(void **state)
{
    (void)state;
    struct mesh mesh = ray_mesh_disc_above_floor(.5, .4, 12);
    struct rays *rays = rays_of(&mesh);
    double diagonal[3];
    vec3_sub(diagonal, mesh.bounds_m[1], mesh.bounds_m[0]);
    assert_float_equal(rays_offset_m(rays), 1e-5 * vec3_norm(diagonal), 1e-9);
    float start[3];
    rays_start(rays, 0, (const float[2]){ .25f, .25f }, start);
    assert_float_equal(start[2], rays_offset_m(rays), 1e-9);
    rays_free(rays);

    // Bend the floor's normals outwards so that it stands for a dome far higher than the disc: the
    // start stays below the disc.
    for (int k = 0; k < 4; k++) {
        const float n[3] = { mesh.position_m[k][0] * .57735f, mesh.position_m[k][1] * .57735f,
                             .57735f };
        memcpy(mesh.normal[k], n, sizeof(n));
    }
    rays = rays_of(&mesh);
    rays_start(rays, 0, (const float[2]){ 0, .5f }, start); // the middle of the floor
    assert_float_equal(start[0], 0, 1e-6);
    assert_true(start[2] > 0 && start[2] < .5);
    rays_free(rays);

    // With the disc out of the way it is lifted further.
    for (int i = 2; i < mesh.n_triangles; i++)
        for (int c = 0; c < 3; c++)
            mesh.position_m[mesh.triangle[i][c]][2] = -.1f;
    rays = rays_of(&mesh);
    rays_start(rays, 0, (const float[2]){ 0, .5f }, start);
    assert_true(start[2] > .5);
    rays_free(rays);
    mesh_free(&mesh);
}

static void mesh_far_from_its_origin_does_not_hit_itself(void **state)
{
    (void)state;
    struct mesh mesh = ray_mesh_sphere(48, 24);
    for (int i = 0; i < mesh.n_vertices; i++)
        mesh.position_m[i][0] += 5000;
    mesh.bounds_m[0][0] += 5000, mesh.bounds_m[1][0] += 5000;
    struct rays *rays = rays_of(&mesh);
    for (int i = 0; i < mesh.n_triangles; i++) {
        const float middle[2] = { 1 / 3.f, 1 / 3.f };
        double point[3], normal[3];
        float start[3];
        point_of(&mesh, i, middle, point, normal);
        rays_start(rays, (uint32_t)i, middle, start);
        const float up[3] = { (float)normal[0], (float)normal[1], (float)normal[2] };
        assert_false(rays_blocked(rays, start, up, 0, INFINITY));
    }
    rays_free(rays);
    mesh_free(&mesh);
}

static void mesh_without_triangles_blocks_nothing(void **state)
{
    (void)state;
    struct mesh mesh = { 0 };
    struct rays *rays = rays_of(&mesh);
    struct ray_hit hit;
    assert_false(
        rays_blocked(rays, (const float[3]){ 0 }, (const float[3]){ 1, 0, 0 }, 0, INFINITY));
    assert_false(
        rays_hit(rays, (const float[3]){ 0 }, (const float[3]){ 1, 0, 0 }, 0, INFINITY, &hit));
    rays_free(rays);
    rays_free(NULL);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(blocked_as_brute_force_says_except_within_a_millionth_of_an_edge),
        cmocka_unit_test(many_rays_from_one_point_are_answered_as_each_is),
        cmocka_unit_test(first_hit_is_the_nearest_and_lies_on_its_triangle),
        cmocka_unit_test(nothing_leaks_through_shared_edges_and_corners),
        cmocka_unit_test(interval_is_in_units_of_the_direction),
        cmocka_unit_test(rays_that_ask_nothing_hit_nothing),
        cmocka_unit_test(many_threads_may_ask_at_once),
        cmocka_unit_test(coarse_sphere_does_not_shadow_itself_above_its_normals_horizon),
        cmocka_unit_test(rays_start_a_hair_above_a_flat_surface_and_never_inside_another),
        cmocka_unit_test(mesh_far_from_its_origin_does_not_hit_itself),
        cmocka_unit_test(mesh_without_triangles_blocks_nothing),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
