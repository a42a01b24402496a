// tests/test_mirrored.c - what a surface shows of itself in its gloss, where it is known: inside a sphere that sends the same everywhere.
#include "solver/mirrored.h"
#include "solver/take/half.h"
#include "tests/ray_meshes.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <cmocka.h>

enum { SIZE = 24 };

struct scene {
    struct mesh mesh;
    struct rays *rays;
    struct texels texels;
    struct lights lights; // one, without light
    struct samples samples; // one of each texel, by view 0
    double centre_m[1][3];
    float (*theta)[DISNEY_N], (*albedo)[3], (*indirect)[3], (*radiance)[3];
};

// Inside or outside of a sphere that is white, matt, and everywhere lit by pi, 2 pi, 3 pi: it sends 1, 2, 3.
static void scene_new(struct scene *s, bool inside, const double from_m[3])
{
    memset(s, 0, sizeof(*s));
    s->mesh = ray_mesh_sphere(48, 24);
    for (int i = 0; inside && i < s->mesh.n_vertices; i++)
        for (int c = 0; c < 3; c++)
            s->mesh.normal[i][c] = -s->mesh.normal[i][c];
    for (int i = 0; inside && i < s->mesh.n_triangles; i++) {
        const uint32_t swap = s->mesh.triangle[i][1];
        s->mesh.triangle[i][1] = s->mesh.triangle[i][2], s->mesh.triangle[i][2] = swap;
    }
    assert_int_equal(rays_new(&s->rays, &s->mesh), 0);
    assert_int_equal(texels_rasterise(&s->texels, &s->mesh, SIZE), 0);
    assert_int_equal(lights_new(&s->lights, 1), 0);
    s->lights.dir_probe[0][2] = 1;
    const size_t n = (size_t)s->texels.n;
    s->theta = calloc(n, sizeof(*s->theta)), s->albedo = calloc(n, sizeof(*s->albedo)), s->indirect = calloc(n, sizeof(*s->indirect));
    s->radiance = calloc(n, sizeof(*s->radiance));
    s->samples = (struct samples){ .n_texels = s->texels.n, .n_views = 1, .n = s->texels.n, .first = calloc(n + 1, sizeof(int64_t)),
                                   .view = calloc(n, sizeof(uint16_t)), .radiance = calloc(n, sizeof(*s->samples.radiance)), .centre_m = s->centre_m };
    memcpy(s->centre_m[0], from_m, sizeof(s->centre_m[0]));
    for (int t = 0; t < s->texels.n; t++) {
        s->samples.first[t + 1] = t + 1;
        for (int c = 0; c < 3; c++) {
            s->albedo[t][c] = 1, s->indirect[t][c] = (float)(c + 1) * (float)M_PI;
            s->samples.radiance[t][c] = half_from_float((float)(c + 1));
        }
    }
}

static void scene_free(struct scene *s)
{
    free(s->theta), free(s->albedo), free(s->indirect), free(s->radiance);
    free(s->samples.first), free(s->samples.view), free(s->samples.radiance);
    lights_free(&s->lights), texels_free(&s->texels), rays_free(s->rays), mesh_free(&s->mesh);
}

static void gather(const struct scene *s, int n_rays, int n_threads, float (*radiance)[3])
{
    const struct mirrored m = { .texels = &s->texels, .mesh = &s->mesh, .rays = s->rays, .lights = &s->lights, .samples = &s->samples,
                                .theta = (const float(*)[DISNEY_N])s->theta, .albedo = (const float(*)[3])s->albedo,
                                .indirect = (const float(*)[3])s->indirect, .n_rays = n_rays, .n_threads = n_threads };
    assert_int_equal(mirrored_gather(&m, radiance), 0);
}

// Share of what comes from all around that the lobe sends to v: midpoint sums of F G D <n,l> over the hemisphere of half vectors.
static double lobe_share(double roughness, double F0, double nv)
{
    const double a2 = pow(fmax(roughness * roughness, .001), 2), v[3] = { sqrt(1 - nv * nv), 0, nv };
    double sum = 0;
    enum { RINGS = 2000, SECTORS = 64 };
    for (int i = 0; i < RINGS; i++)
        for (int k = 0; k < SECTORS; k++) {
            const double u = (i + .5) / RINGS, angle = u * u * M_PI / 2, phi = 2 * M_PI * (k + .5) / SECTORS; // dense at the peak
            const double h[3] = { sin(angle) * cos(phi), sin(angle) * sin(phi), cos(angle) }, vh = v[0] * h[0] + v[2] * h[2];
            const double nl = 2 * vh * h[2] - v[2], d = 1 + (a2 - 1) * h[2] * h[2];
            if (vh <= 0 || nl <= 0)
                continue;
            const double D = a2 / (M_PI * d * d), G = 1 / (nl + sqrt(a2 + nl * nl * (1 - a2))) / (nv + sqrt(a2 + nv * nv * (1 - a2)));
            const double F = F0 + (1 - F0) * pow(1 - vh, 5), solid_angle = sin(angle) * 2 * u * M_PI / 2 / RINGS * 2 * M_PI / SECTORS * 4 * vh;
            sum += F * G * D * nl * solid_angle;
        }
    return sum;
}

static void a_mirror_shows_the_lobe_s_share_of_its_surroundings(void **state)
{
    (void)state;
    static const double from_m[3] = { .3, -.2, .1 };
    static const struct { float roughness, metallic, specular; } of[] = { { .1f, 1, 0 }, { .4f, 1, 0 }, { .8f, 1, 0 }, { .2f, 0, .5f }, { .5f, 0, 1 } };
    struct scene s;
    scene_new(&s, true, from_m);
    for (int t = 0; t < s.texels.n; t++)
        s.theta[t][DISNEY_SPECULAR] = .5f; // the surroundings send 4 % more
    for (size_t k = 0; k < sizeof(of) / sizeof(*of); k++) {
        const int texel = (int)((k + 1) * (size_t)s.texels.n / 7); // alone; all it shows is lit by others only
        float *theta = s.theta[texel], v[3];
        theta[DISNEY_ROUGHNESS] = of[k].roughness, theta[DISNEY_METALLIC] = of[k].metallic, theta[DISNEY_SPECULAR] = of[k].specular;
        gather(&s, 4096, 2, s.radiance);
        samples_view_direction(&s.samples, &s.texels, texel, 0, v);
        const float *n = s.texels.normal[texel];
        const double nv = (double)(n[0] * v[0] + n[1] * v[1] + n[2] * v[2]);
        const double share = lobe_share((double)of[k].roughness, of[k].metallic > 0 ? 1 : .08 * (double)of[k].specular, nv);
        for (int c = 0; c < 3; c++)
            assert_true(fabs((double)s.radiance[texel][c] / (1.04 * (c + 1)) / share - 1) < .02);
        memset(theta, 0, sizeof(s.theta[texel]));
    }
    scene_free(&s);
}

static void what_sees_nothing_of_itself_mirrors_nothing_and_threads_do_not_matter(void **state)
{
    (void)state;
    static const double outside_m[3] = { 3, 2, 2 }, inside_m[3] = { .3, -.2, .1 };
    struct scene s;
    for (int inside = 0; inside < 2; inside++) {
        scene_new(&s, inside, inside ? inside_m : outside_m);
        float(*again)[3] = calloc((size_t)s.texels.n, sizeof(*again));
        for (int t = 0; t < s.texels.n; t++)
            s.theta[t][DISNEY_ROUGHNESS] = .3f, s.theta[t][DISNEY_METALLIC] = .5f;
        gather(&s, 16, 1, s.radiance);
        gather(&s, 16, 2, again);
        assert_memory_equal(s.radiance, again, (size_t)s.texels.n * sizeof(*again));
        for (int t = 0; t < s.texels.n; t++)
            for (int c = 0; c < 3; c++)
                assert_true(inside ? s.radiance[t][c] > 0 : s.radiance[t][c] == 0);
        free(again);
        scene_free(&s);
    }
}

static void what_is_mirrored_is_taken_off_a_copy(void **state)
{
    (void)state;
    static const double from_m[3] = { .3, -.2, .1 };
    struct scene s;
    struct samples without;
    scene_new(&s, true, from_m);
    for (int t = 0; t < s.texels.n; t++)
        s.radiance[t][0] = .5f, s.radiance[t][1] = 0, s.radiance[t][2] = 4;
    assert_int_equal(mirrored_take_off(&without, &s.samples, (const float(*)[3])s.radiance), 0);
    for (int t = 0; t < s.texels.n; t++) {
        float rgb[3];
        samples_radiance(&without, t, rgb);
        assert_true(rgb[0] == .5f && rgb[1] == 2 && rgb[2] == -1);
        samples_radiance(&s.samples, t, rgb);
        assert_true(rgb[0] == 1 && rgb[1] == 2 && rgb[2] == 3);
    }
    assert_ptr_equal(without.view, s.samples.view);
    free(without.radiance);
    scene_free(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_mirror_shows_the_lobe_s_share_of_its_surroundings),
        cmocka_unit_test(what_sees_nothing_of_itself_mirrors_nothing_and_threads_do_not_matter),
        cmocka_unit_test(what_is_mirrored_is_taken_off_a_copy),
    };
    return cmocka_run_group_tests_name("mirrored", tests, NULL, NULL);
}
