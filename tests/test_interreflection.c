// tests/test_interreflection.c - light that a surface sends to itself, where it is known in closed form: inside a sphere, and between two
// plates that face each other.
#include "solver/interreflection.h"
#include "solver/parallel.h"
#include "tests/ray_meshes.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <cmocka.h>

struct scene {
    struct mesh mesh;
    struct rays *rays;
    struct texels texels;
    struct light_arrays lights;
    float (*diffuse)[3], (*indirect)[3];
};

static void turn_over(struct mesh *m, int first_vertex, int first_triangle)
{
    for (int i = first_vertex; i < m->n_vertices; i++)
        for (int c = 0; c < 3; c++)
            m->normal[i][c] = -m->normal[i][c];
    for (int i = first_triangle; i < m->n_triangles; i++) {
        const uint32_t swap = m->triangle[i][1];
        m->triangle[i][1] = m->triangle[i][2], m->triangle[i][2] = swap;
    }
}

// Directional lights: dir[n] from the surface, each with irradiance 1, 2, 3 in R, G, B.
static struct scene scene_of(struct mesh mesh, int size, const double (*dir)[3], int n)
{
    struct scene s = { .mesh = mesh };
    struct lights l;
    assert_int_equal(rays_new(&s.rays, &s.mesh), 0);
    assert_int_equal(texels_rasterise(&s.texels, &s.mesh, size), 0);
    assert_int_equal(lights_new(&l, n), 0);
    for (int i = 0; i < n; i++) {
        memcpy(l.dir_probe[i], dir[i], sizeof(l.dir_probe[i]));
        for (int c = 0; c < 3; c++)
            l.irradiance[i][c] = c + 1;
    }
    assert_int_equal(light_arrays_new(&s.lights, &l), 0);
    lights_free(&l);
    s.diffuse = calloc((size_t)s.texels.n, sizeof(*s.diffuse)), s.indirect = calloc((size_t)s.texels.n, sizeof(*s.indirect));
    return s;
}

static void scene_free(struct scene *s)
{
    free(s->diffuse), free(s->indirect);
    light_arrays_free(&s->lights), texels_free(&s->texels), rays_free(s->rays), mesh_free(&s->mesh);
}

static struct interreflection question(const struct scene *s)
{
    return (struct interreflection){ .texels = &s->texels, .mesh = &s->mesh, .rays = s->rays, .lights = &s->lights,
                                     .kernels = kernels_select(KERNELS_REFERENCE), .diffuse = (const float(*)[3])s->diffuse,
                                     .n_rays = 256, .n_threads = 2 };
}

// A sphere sends every part of itself the mean of what it sends, wherever that is: rho E, then rho^2 E more.
static void inside_a_sphere_every_bounce_adds_its_power_of_the_reflectance(void **state)
{
    (void)state;
    static const double up[1][3] = { { 0, 0, 1 } };
    for (int size = 0; size <= 24; size += 24) { // 24: texels take over from places 3 times coarser
        struct mesh mesh = ray_mesh_sphere(64, 32);
        turn_over(&mesh, 0, 0);
        struct scene s = scene_of(mesh, 72, up, 1);
        struct interreflection in = question(&s);
        in.size = size;
        for (int i = 0; i < s.texels.n; i++)
            for (int c = 0; c < 3; c++)
                s.diffuse[i][c] = .5f;
        const double mean = .25; // of a beam's cosine, over the sphere
        double expected = 0;
        for (int bounce = 0; bounce < 3; bounce++) {
            expected = .5 * (mean + expected);
            assert_int_equal(interreflection_gather(&in, s.indirect), 0);
            double off = 0;
            for (int i = 0; i < s.texels.n; i++)
                for (int c = 0; c < 3; c++)
                    off += pow((double)s.indirect[i][c] / (c + 1) / expected - 1, 2) / 3;
            assert_true(sqrt(off / s.texels.n) < .03);
        }
        scene_free(&s);
    }
}

// Of a disc, seen from a patch that faces its plane from a distance h, and lies a beside its axis.
static double form_factor(double a, double h, double r)
{
    const double z = a * a + h * h + r * r;
    return .5 * (1 - (a * a + h * h - r * r) / sqrt(z * z - 4 * a * a * r * r));
}

static void place_left(double u, double v, double p[3], double n[3])
{
    p[0] = u - 1, p[1] = 2 * v - 1, p[2] = 0, n[2] = 1;
}

static void place_right(double u, double v, double p[3], double n[3])
{
    p[0] = 1 - u, p[1] = 2 * v - 1, p[2] = 0, n[2] = 1;
}

// The floor in two charts; what is next to the floor's middle in the atlas lies at its rim.
static struct mesh disc_above_two_charts(void)
{
    struct ray_mesh_arrays a;
    struct mesh disc = ray_mesh_disc_above_floor(.5, .4, 90);
    const int n_vertices = disc.n_vertices - 4, n_triangles = disc.n_triangles - 2;
    ray_mesh_reserve(&a, 8 + n_vertices, 4 + n_triangles, true);
    ray_mesh_grid(&a, 1, 1, 0, .45, place_left);
    ray_mesh_grid(&a, 1, 1, .45, .9, place_right);
    memcpy(a.position + 8, disc.position_m + 4, (size_t)n_vertices * sizeof(*a.position));
    memcpy(a.normal + 8, disc.normal + 4, (size_t)n_vertices * sizeof(*a.normal));
    memcpy(a.uv + 8, disc.uv + 4, (size_t)n_vertices * sizeof(*a.uv));
    for (int i = 0; i < n_triangles; i++)
        for (int c = 0; c < 3; c++)
            a.triangle[4 + i][c] = disc.triangle[2 + i][c] + 4;
    a.n_vertices += n_vertices, a.n_triangles += n_triangles;
    mesh_free(&disc);
    return ray_mesh_finish(&a);
}

static struct scene lamp_above_floor(int size)
{
    static const double down[1][3] = { { 0, 0, -1 } }; // light from below, which the floor lets through
    struct mesh mesh = disc_above_two_charts();
    turn_over(&mesh, 8, 4);
    struct scene s = scene_of(mesh, size, down, 1);
    for (int i = 0; i < s.texels.n; i++)
        for (int c = 0; c < 3; c++)
            s.diffuse[i][c] = .6f;
    return s;
}

static void a_floor_under_a_lit_disc_gets_its_form_factor(void **state)
{
    (void)state;
    struct scene s = lamp_above_floor(160);
    float(*between)[3] = calloc((size_t)s.texels.n, sizeof(*between));
    struct interreflection in = question(&s);
    assert_int_equal(interreflection_gather(&in, s.indirect), 0);
    in.size = 40;
    assert_int_equal(interreflection_gather(&in, between), 0);
    int n_floor = 0, n_disc = 0;
    double noise = 0, noise_between = 0;
    for (int i = 0; i < s.texels.n; i++) {
        const float *p = s.texels.position_m[i];
        if (p[2] > .1f) { // the disc: no light falls on the floor, so nothing comes back
            n_disc++;
            assert_true(s.indirect[i][0] == 0 && between[i][0] == 0);
            continue;
        }
        const double expected = .6 * form_factor(hypot((double)p[0], (double)p[1]), .5, .4);
        for (int c = 0; c < 3; c++) {
            assert_true(fabs((double)s.indirect[i][c] / (c + 1) - expected) < .02);
            assert_true(fabs((double)between[i][c] / (c + 1) - expected) < .02);
        }
        noise += pow((double)s.indirect[i][0] - expected, 2), noise_between += pow((double)between[i][0] - expected, 2);
        n_floor++;
    }
    assert_true(n_floor > 10000 && n_disc > 20);
    assert_true(noise_between < .7 * noise); // four places' rays instead of one's
    free(between);
    scene_free(&s);
}

static void the_back_of_a_surface_sends_nothing(void **state)
{
    (void)state;
    static const double down[1][3] = { { 0, 0, -1 } }, up[1][3] = { { 0, 0, 1 } };
    for (int k = 0; k < 2; k++) { // the disc faces up, and is lit from below or above
        struct scene s = scene_of(ray_mesh_disc_above_floor(.5, .4, 24), 64, k ? up : down, 1);
        const struct interreflection in = question(&s);
        for (int i = 0; i < s.texels.n; i++) // a floor that sends nothing itself
            s.diffuse[i][0] = s.texels.position_m[i][2] > .1f;
        assert_int_equal(interreflection_gather(&in, s.indirect), 0);
        for (int i = 0; i < s.texels.n; i++)
            assert_true(s.indirect[i][0] == 0);
        scene_free(&s);
    }
}

static void what_is_in_shadow_sends_less(void **state)
{
    (void)state;
    struct scene s = lamp_above_floor(64);
    struct interreflection in = question(&s);
    float(*open)[3] = calloc((size_t)s.texels.n, sizeof(*open)), (*dim)[3] = calloc((size_t)s.texels.n, sizeof(*dim));
    uint8_t *soft = malloc((size_t)s.texels.n);
    uint16_t *none = calloc((size_t)s.texels.n, sizeof(*none));
    for (int i = 0; i < s.texels.n; i++)
        soft[i] = s.texels.position_m[i][2] > .1f ? 51 : 255; // a fifth reaches the disc
    assert_int_equal(interreflection_gather(&in, open), 0);
    in.soft = soft;
    assert_int_equal(interreflection_gather(&in, dim), 0);
    in.soft = NULL, in.visible = none, in.words_per_texel = 1;
    assert_int_equal(interreflection_gather(&in, s.indirect), 0);
    int n = 0;
    for (int i = 0; i < s.texels.n; i++)
        for (int c = 0; c < 3; c++) {
            assert_true(fabsf(dim[i][c] - .2f * open[i][c]) < 1e-5f);
            assert_true(s.indirect[i][c] == 0);
            n += open[i][c] > .01f;
        }
    assert_true(n > 1000);
    free(open), free(dim), free(soft), free(none);
    scene_free(&s);
}

static void thread_count_changes_no_byte(void **state)
{
    (void)state;
    static const double dir[2][3] = { { 0, .6, .8 }, { -.8, -.6, 0 } };
    struct scene s = scene_of(ray_mesh_bumpy(48, 24), 64, dir, 2);
    struct interreflection in = question(&s);
    const size_t n = (size_t)s.texels.n;
    float(*other)[3] = calloc(n, sizeof(*other));
    for (size_t i = 0; i < n; i++)
        for (int c = 0; c < 3; c++)
            s.diffuse[i][c] = (float)random_uniform(1, i, (uint64_t)c);
    in.size = 40;
    for (int bounce = 0; bounce < 2; bounce++) {
        in.n_threads = 1;
        assert_int_equal(interreflection_gather(&in, s.indirect), 0);
        in.n_threads = 3;
        assert_int_equal(interreflection_gather(&in, other), 0);
        assert_memory_equal(s.indirect, other, n * sizeof(*other));
    }
    free(other);
    scene_free(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(inside_a_sphere_every_bounce_adds_its_power_of_the_reflectance),
        cmocka_unit_test(a_floor_under_a_lit_disc_gets_its_form_factor),
        cmocka_unit_test(the_back_of_a_surface_sends_nothing),
        cmocka_unit_test(what_is_in_shadow_sends_less),
        cmocka_unit_test(thread_count_changes_no_byte),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
