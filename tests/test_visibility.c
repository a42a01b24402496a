// tests/test_visibility.c - masks and light bits are those of geometry one can work out by hand,
// and of brute force.
#include "solver/random.h"
#include "solver/take/log.h"
#include "solver/visibility.h"
#include "tests/ray_margin.h"
#include "tests/ray_meshes.h"

#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

static const double PI = 3.141592653589793;

struct scene {
    struct mesh mesh;
    struct rays *rays;
    struct texels texels;
};

static struct scene scene_of(struct mesh mesh, int texture)
{
    struct scene s = { .mesh = mesh };
    assert_int_equal(rays_new(&s.rays, &s.mesh), 0);
    assert_int_equal(texels_rasterise(&s.texels, &s.mesh, texture), 0);
    return s;
}

static void scene_free(struct scene *s)
{
    texels_free(&s->texels);
    rays_free(s->rays);
    mesh_free(&s->mesh);
}

static void texel_point(const struct scene *s, int i, double point[3], double normal[3])
{
    for (int c = 0; c < 3; c++) {
        point[c] = s->texels.position_m[i][c];
        normal[c] = s->texels.normal[i][c];
    }
}

static struct camera camera_at(const double centre_m[3], const double target_m[3], double focal_px)
{
    struct camera c = { .name = "view",
                        .width_px = 300,
                        .height_px = 200,
                        .model = CAMERA_BROWN,
                        .fx = focal_px,
                        .fy = focal_px,
                        .cx = 150,
                        .cy = 100 };
    camera_look_at(&c, centre_m, target_m, (const double[3]){ 0, .6, .8 });
    return c;
}

static uint8_t *mask_of(const struct scene *s, const struct camera *camera, int n_threads)
{
    uint8_t *mask = malloc((size_t)s->texels.n);
    memset(mask, 77, (size_t)s->texels.n);
    visibility_camera_mask(mask, s->rays, &s->texels, camera, .15, n_threads);
    return mask;
}

// ---- cameras ----

static void every_texel_of_a_coarse_sphere_is_judged_by_its_own_normal(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_sphere(12, 6), 128);
    const struct camera camera =
        camera_at((const double[3]){ 3, 1, 2 }, (const double[3]){ 0 }, 200);
    uint8_t *mask = mask_of(&s, &camera, 1);
    int n[256] = { 0 };
    for (int i = 0; i < s.texels.n; i++) {
        double point[3], normal[3], view[3];
        texel_point(&s, i, point, normal);
        vec3_sub(view, camera.centre_m, point);
        vec3_normalise(view);
        const double cosine = vec3_dot(view, normal);
        assert_int_equal(mask[i], cosine <= 0    ? MASK_OCCLUDED
                                  : cosine < .15 ? MASK_GRAZING
                                                 : MASK_VISIBLE);
        n[mask[i]]++;
    }
    assert_true(n[MASK_VISIBLE] > 100 && n[MASK_GRAZING] > 100 && n[MASK_OCCLUDED] > 100);
    free(mask);
    scene_free(&s);
}

static void texels_outside_the_image_or_behind_the_camera_are_outside(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_sphere(48, 24), 64);
    const struct camera camera = camera_at((const double[3]){ 3, 1, 2 }, (const double[3]){ 0 },
                                           600); // beyond all four borders
    uint8_t *mask = mask_of(&s, &camera, 1);
    int n_outside = 0;
    for (int i = 0; i < s.texels.n; i++) {
        double point[3], normal[3], uv_px[2];
        texel_point(&s, i, point, normal);
        const bool outside = !camera_project(&camera, point, uv_px, NULL) || uv_px[0] < 0 ||
                             uv_px[0] >= 300 || uv_px[1] < 0 || uv_px[1] >= 200;
        assert_int_equal(mask[i] == MASK_OUTSIDE, outside);
        n_outside += outside;
    }
    assert_in_range(n_outside, s.texels.n / 10, s.texels.n * 9 / 10);
    free(mask);
    const struct camera away =
        camera_at((const double[3]){ 3, 0, 0 }, (const double[3]){ 6, 0, 0 }, 600);
    mask = mask_of(&s, &away, 1);
    for (int i = 0; i < s.texels.n; i++)
        assert_int_equal(mask[i], MASK_OUTSIDE);
    free(mask);
    scene_free(&s);
}

// Floor texels inside a circle are hidden, outside it seen; only within one texel of its line
// either may be.
static void check_circle(const struct scene *s, const bool *seen, double x, double y, double radius)
{
    int n_inside = 0, n_outside = 0;
    for (int i = 0; i < s->texels.n; i++) {
        double point[3], normal[3];
        texel_point(s, i, point, normal);
        if (point[2] > 0)
            continue; // the disc itself
        const double beyond = hypot(point[0] - x, point[1] - y) - radius;
        if (fabs(beyond) < s->texels.texel_size_m)
            continue;
        assert_int_equal(seen[i], beyond > 0);
        if (beyond < 0)
            n_inside++;
        else
            n_outside++;
    }
    assert_true(n_inside > 50 && n_outside > 50);
}

enum { RIM = 256 }; // a disc's corners: its chords stay within 1e-4 of the circle

static void disc_hides_the_floor_from_a_camera_within_a_texel_of_its_outline(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_disc_above_floor(.5, .3, RIM), 128);
    const struct camera camera =
        camera_at((const double[3]){ .4, .2, 2 }, (const double[3]){ .1, 0, 0 }, 60);
    uint8_t *mask = mask_of(&s, &camera, 1);
    bool *seen = calloc((size_t)s.texels.n, sizeof(bool));
    for (int i = 0; i < s.texels.n; i++) {
        assert_true(mask[i] == MASK_VISIBLE || mask[i] == MASK_OCCLUDED);
        seen[i] = mask[i] == MASK_VISIBLE;
        if (s.texels.position_m[i][2] > 0)
            assert_true(seen[i]); // the disc's upper side
    }
    // From (x, y, H) the disc at height h falls on the floor as a circle, stretched by H / (H - h)
    // about the foot of the camera.
    const double stretch = 2 / (2 - .5);
    check_circle(&s, seen, .4 - .4 * stretch, .2 - .2 * stretch, .3 * stretch);
    free(seen);
    free(mask);
    scene_free(&s);
}

// ---- lights ----

// n lights in random directions, all but every third at 1 .. 3 m, under a rotation and about a
// centre of no special kind.
static struct lights random_lights(int n, uint64_t seed)
{
    struct lights l;
    assert_int_equal(lights_new(&l, n), 0);
    mat3_from_rotation_vector(l.world_from_probe, (const double[3]){ .3, -1, .5 });
    l.centre_m[0] = .02, l.centre_m[1] = -.01, l.centre_m[2] = .03;
    for (int i = 0; i < n; i++) {
        for (int c = 0; c < 3; c++) {
            l.dir_probe[i][c] = random_normal(seed, (uint64_t)i, (uint64_t)c);
            l.irradiance[i][c] = 1;
        }
        vec3_normalise(l.dir_probe[i]);
        l.inverse_distance[i] = i % 3 ? 1 / (1 + 2 * random_uniform(seed, (uint64_t)i, 9)) : 0;
    }
    return l;
}

static bool bit_of(const struct light_visibility *v, int texel, int light)
{
    return v->bits[(int64_t)texel * v->words_per_texel + light / 16] >> light % 16 & 1;
}

static struct light_visibility trace(const struct scene *s, const struct lights *l,
                                     const struct panorama *p, int n_sub, int n_threads)
{
    struct light_visibility v;
    assert_int_equal(light_visibility_trace(&v, s->rays, &s->texels, l, p, n_sub, 5, n_threads), 0);
    return v;
}

static void bits_are_those_of_brute_force(void **state)
{
    (void)state;
    enum { N_LIGHTS = 37, N_ASKED = 3000 };
    struct scene s = scene_of(ray_mesh_bumpy(48, 24), 64);
    struct lights l = random_lights(N_LIGHTS, 1);
    struct light_visibility v = trace(&s, &l, NULL, 1, 2);
    assert_int_equal(v.words_per_texel, 3);
    double diagonal[3];
    vec3_sub(diagonal, s.mesh.bounds_m[1], s.mesh.bounds_m[0]);
    const double tolerance_m = 2e-6 * vec3_norm(diagonal);
    int n_grazing = 0, n_shadowed = 0, n_visible = 0, n_below = 0;
    for (int k = 0; k < N_ASKED; k++) {
        const int texel = (int)(random_u64(7, (uint64_t)k, 0) % (uint64_t)s.texels.n);
        const int light = (int)(random_u64(7, (uint64_t)k, 1) % N_LIGHTS);
        double point[3], normal[3];
        texel_point(&s, texel, point, normal);
        struct light_at at;
        light_at_point(&l, light, point, &at);
        if (vec3_dot(at.l, normal) <= 0) {
            assert_false(bit_of(&v, texel, light));
            n_below++;
            continue;
        }
        float start_m[3];
        rays_start(s.rays, s.texels.triangle[texel], s.texels.barycentric[texel], start_m);
        const double start[3] = { start_m[0], start_m[1], start_m[2] };
        light_at_point(&l, light, start, &at);
        double t_max = INFINITY;
        if (l.inverse_distance[light] > 0) {
            double towards[3];
            mat3_mul_vec(towards, l.world_from_probe, l.dir_probe[light]);
            vec3_add_scaled(towards, l.centre_m, 1 / l.inverse_distance[light], towards);
            vec3_sub(towards, towards, start);
            t_max = vec3_norm(towards);
        }
        if (fabs(ray_margin_m(&s.mesh, start, at.l, 0, t_max)) < tolerance_m) {
            n_grazing++;
            continue;
        }
        const bool blocked = rays_blocked_brute_force(&s.mesh, start, at.l, 0, t_max);
        assert_int_equal(bit_of(&v, texel, light), !blocked);
        n_shadowed += blocked, n_visible += !blocked;
    }
    assert_in_range(n_grazing, 0, N_ASKED / 100);
    assert_true(n_below > N_ASKED / 5 && n_shadowed > N_ASKED / 20 && n_visible > N_ASKED / 5);
    light_visibility_free(&v);
    lights_free(&l);
    scene_free(&s);
}

static void set_light(struct lights *l, int i, double x, double y, double z, double distance_m)
{
    l->dir_probe[i][0] = x, l->dir_probe[i][1] = y, l->dir_probe[i][2] = z;
    vec3_normalise(l->dir_probe[i]);
    l->inverse_distance[i] = isinf(distance_m) ? 0 : 1 / distance_m;
}

static void disc_shades_the_floor_within_a_texel_of_its_outline(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_disc_above_floor(.5, .3, RIM), 128);
    struct lights l;
    assert_int_equal(lights_new(&l, 3), 0);
    l.centre_m[2] = .1;
    set_light(&l, 0, .3, -.2, 1, INFINITY);
    set_light(&l, 1, .2, .1, .97, 1.5);
    set_light(&l, 2, .05, 0, 1, .3); // between the disc and the floor: its rays end below the disc
    struct light_visibility v = trace(&s, &l, NULL, 1, 1);
    bool *seen = calloc((size_t)s.texels.n, sizeof(bool));
    for (int i = 0; i < s.texels.n; i++)
        seen[i] = bit_of(&v, i, 0);
    check_circle(&s, seen, -.3 * .5, .2 * .5, .3);
    double at_m[3];
    for (int c = 0; c < 3; c++)
        at_m[c] = l.centre_m[c] + 1.5 * l.dir_probe[1][c];
    const double stretch = at_m[2] / (at_m[2] - .5);
    for (int i = 0; i < s.texels.n; i++)
        seen[i] = bit_of(&v, i, 1);
    check_circle(&s, seen, at_m[0] * (1 - stretch), at_m[1] * (1 - stretch), .3 * stretch);
    for (int i = 0; i < s.texels.n; i++)
        assert_int_equal(bit_of(&v, i, 2), s.texels.position_m[i][2] == 0);
    free(seen);
    light_visibility_free(&v);
    lights_free(&l);
    scene_free(&s);
}

static void lights_below_the_horizon_cost_no_ray(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_sphere(48, 24), 64);
    struct lights l = random_lights(20, 3);
    struct light_visibility v = trace(&s, &l, NULL, 1, 1);
    int64_t n_above = 0;
    for (int i = 0; i < s.texels.n; i++)
        for (int k = 0; k < l.n; k++) {
            double point[3], normal[3];
            texel_point(&s, i, point, normal);
            struct light_at at;
            light_at_point(&l, k, point, &at);
            const double cosine = vec3_dot(at.l, normal);
            n_above += cosine > 0;
            if (fabs(cosine) > 1e-9) // a sphere shades itself exactly where its normal turns away
                assert_int_equal(bit_of(&v, i, k), cosine > 0);
        }
    assert_int_equal(v.n_rays, n_above);
    light_visibility_free(&v);
    lights_free(&l);
    scene_free(&s);
}

static void assert_light_equal(const struct light_visibility *a, const struct light_visibility *b,
                               int light)
{
    for (int i = 0; i < a->n_texels; i++) {
        assert_int_equal(bit_of(a, i, light), bit_of(b, i, light));
        if (a->soft)
            assert_int_equal(a->soft[(int64_t)i * a->n_lights + light],
                             b->soft[(int64_t)i * b->n_lights + light]);
    }
}

static bool light_differs(const struct light_visibility *a, const struct light_visibility *b,
                          int light)
{
    for (int i = 0; i < a->n_texels; i++)
        if (bit_of(a, i, light) != bit_of(b, i, light))
            return true;
    return false;
}

// Turns light i by an angle about an axis across it.
static void turn(struct lights *l, int i, double angle_rad)
{
    double across[3], turned[9];
    vec3_cross(across, l->dir_probe[i],
               fabs(l->dir_probe[i][2]) < .9 ? (const double[3]){ 0, 0, 1 }
                                             : (const double[3]){ 1, 0, 0 });
    vec3_normalise(across);
    for (int c = 0; c < 3; c++)
        across[c] *= angle_rad;
    mat3_from_rotation_vector(turned, across);
    mat3_mul_vec(l->dir_probe[i], turned, l->dir_probe[i]);
}

static void refresh_retraces_the_lights_that_moved_and_no_other(void **state)
{
    (void)state;
    const double degree = PI / 180;
    struct scene s = scene_of(ray_mesh_bumpy(48, 24), 64);
    struct lights l = random_lights(20, 1);
    struct light_visibility v = trace(&s, &l, NULL, 1, 1), before = trace(&s, &l, NULL, 1, 1);
    const int64_t n_rays = v.n_rays;
    assert_int_equal(light_visibility_refresh(&v, s.rays, &s.texels, &l, NULL, .5 * degree, 5, 1),
                     0);
    assert_int_equal(v.n_rays, n_rays);

    turn(&l, 3, .3 * degree); // directional, too little
    turn(&l, 5, .3 * degree); // near, too little
    turn(&l, 6, 2 * degree);  // directional
    turn(&l, 7, 2 * degree);  // near
    l.inverse_distance[8] *= 2; // nearer along its own line: moves only as seen from the corners
    l.inverse_distance[9] = 1; // was directional
    struct light_visibility fresh = trace(&s, &l, NULL, 1, 1);
    assert_int_equal(light_visibility_refresh(&v, s.rays, &s.texels, &l, NULL, .5 * degree, 5, 1),
                     4);
    assert_true(v.n_rays > n_rays && v.n_rays < n_rays + n_rays / 3);
    for (int i = 0; i < l.n; i++)
        assert_light_equal(&v, i >= 6 && i <= 9 ? &fresh : &before, i);
    for (int i = 5; i <= 9; i++) // what was left alone, and what was not, makes a difference
        assert_true(light_differs(&fresh, &before, i));

    turn(&l, 3, .3 * degree); // small steps add up
    assert_int_equal(light_visibility_refresh(&v, s.rays, &s.texels, &l, NULL, .5 * degree, 5, 1),
                     1);
    light_visibility_free(&fresh);
    fresh = trace(&s, &l, NULL, 1, 1);
    assert_light_equal(&v, &fresh, 3);
    assert_int_equal(light_visibility_refresh(&v, s.rays, &s.texels, &l, NULL, .5 * degree, 5, 1),
                     0);
    light_visibility_free(&fresh);
    light_visibility_free(&before);
    light_visibility_free(&v);
    lights_free(&l);
    scene_free(&s);
}

// ---- soft ----

// A black panorama with one rectangle of light, [x0,x1) x [y0,y1).
static struct panorama panorama_with(int width, int x0, int y0, int x1, int y1)
{
    struct panorama p;
    assert_int_equal(image_new(&p.image, width, width / 2, 3, NULL), 0);
    for (int y = y0; y < y1; y++)
        for (int x = x0; x < x1; x++)
            for (int c = 0; c < 3; c++)
                p.image.data[(y * width + x) * 3 + c] = 10;
    return p;
}

// One light for the whole panorama; its +Y is the world's +Z.
static struct lights whole_sky(const struct panorama *p)
{
    struct lights l;
    assert_int_equal(lights_median_cut(&l, p, 1), 0);
    const double z_up[9] = { 1, 0, 0, 0, 0, -1, 0, 1, 0 };
    memcpy(l.world_from_probe, z_up, sizeof(z_up));
    return l;
}

static int by_x(const void *a, const void *b)
{
    const double *p = a, *q = b;
    return (p[0] > q[0]) - (p[0] < q[0]);
}

static void soft_shadow_grows_from_none_to_all_through_the_penumbra(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_disc_above_floor(.5, .4, RIM), 128);
    // About the zenith: all longitudes, 12 degrees across, so a round lamp over the disc.
    struct panorama p = panorama_with(128, 0, 0, 128, 4);
    struct lights l = whole_sky(&p);
    set_light(&l, 0, 0, 1, 0, INFINITY);
    const double half_width = .5 * tan(4 * PI / 64); // of the penumbra on the floor, each way
    struct light_visibility v = trace(&s, &l, &p, 16, 1);
    int n_row = 0, n_levels = 0, last = 0;
    double(*row)[2] = calloc((size_t)s.texels.n, sizeof(row[0]));
    for (int i = 0; i < s.texels.n; i++) {
        double point[3], normal[3];
        texel_point(&s, i, point, normal);
        const int soft = v.soft[i];
        assert_int_equal(bit_of(&v, i, 0), soft > 0);
        const double radius = hypot(point[0], point[1]);
        if (point[2] > 0 || radius > .4 + half_width + .001)
            assert_int_equal(soft, 255);
        else if (radius < .4 - half_width - .001)
            assert_int_equal(soft, 0);
        // The first row of texels beyond y = 0.
        const bool in_row = point[1] > 0 && point[1] < 2. / 128;
        if (point[2] == 0 && point[0] > 0 && in_row) {
            row[n_row][0] = point[0];
            row[n_row++][1] = soft;
        }
    }
    qsort(row, (size_t)n_row, sizeof(row[0]), by_x);
    for (int i = 0; i < n_row; i++) {
        assert_true(row[i][1] >= last);
        n_levels += row[i][1] > last;
        last = (int)row[i][1];
    }
    assert_int_equal(last, 255);
    assert_in_range(n_levels, 4, 16);
    free(row);
    light_visibility_free(&v);
    lights_free(&l);
    panorama_free(&p);
    scene_free(&s);
}

static void soft_share_is_by_energy(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_disc_above_floor(.5, .2, RIM), 64);
    for (int same_row = 0; same_row < 2; same_row++) {
        // Two lamps of one pixel; their energies are 3 : 1.
        const int a[2] = { 40, 8 }, b[2] = { 88, same_row ? 8 : 6 };
        struct panorama p = panorama_with(128, a[0], a[1], a[0] + 1, a[1] + 1);
        const double ratio =
            panorama_solid_angle(128, 64, a[1]) / panorama_solid_angle(128, 64, b[1]) / 3;
        for (int c = 0; c < 3; c++)
            p.image.data[(b[1] * 128 + b[0]) * 3 + c] = (float)(10 * ratio);
        struct lights l = whole_sky(&p);
        struct light_visibility v = trace(&s, &l, &p, 16, 1);
        int n_only[2] = { 0 };
        for (int i = 0; i < s.texels.n; i++) {
            double point[3], normal[3];
            texel_point(&s, i, point, normal);
            if (point[2] > 0)
                continue;
            double inside[2]; // how deep in the shadow of either lamp
            for (int k = 0; k < 2; k++) {
                const int *lamp = k ? b : a;
                double dir[3];
                panorama_direction(128, 64, lamp[0] + .5, lamp[1] + .5, dir);
                mat3_mul_vec(dir, l.world_from_probe, dir);
                inside[k] =
                    .2 - hypot(point[0] + .5 * dir[0] / dir[2], point[1] + .5 * dir[1] / dir[2]);
            }
            const double pixel = .5 * 2 * PI / 128 * 2; // a lamp's own penumbra, generously
            if (inside[0] > pixel && inside[1] < -pixel) {
                assert_in_range(v.soft[i], 255 / 4 - 2 * 255 / 16, 255 / 4 + 2 * 255 / 16);
                n_only[0]++;
            }
            if (inside[1] > pixel && inside[0] < -pixel) {
                assert_in_range(v.soft[i], 255 * 3 / 4 - 2 * 255 / 16, 255 * 3 / 4 + 2 * 255 / 16);
                n_only[1]++;
            }
        }
        assert_true(n_only[0] > 5 && n_only[1] > 5);
        light_visibility_free(&v);
        lights_free(&l);
        panorama_free(&p);
    }
    scene_free(&s);
}

// A panorama with light everywhere, cut into 16.
static struct panorama noisy_panorama(void)
{
    struct panorama p = panorama_with(64, 0, 0, 64, 32);
    for (int i = 0; i < 64 * 32 * 3; i++)
        p.image.data[i] = (float)pow(random_uniform(11, 0, (uint64_t)i), 8);
    return p;
}

static void soft_refresh_equals_a_new_trace(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_bumpy(48, 24), 32);
    struct panorama p = noisy_panorama();
    struct lights l;
    assert_int_equal(lights_median_cut(&l, &p, 16), 0);
    struct light_visibility v = trace(&s, &l, &p, 6, 1), before = trace(&s, &l, &p, 6, 1);
    for (int i = 0; i < l.n; i += 2)
        l.inverse_distance[i] = .8;
    struct light_visibility fresh = trace(&s, &l, &p, 6, 1);
    assert_int_equal(light_visibility_refresh(&v, s.rays, &s.texels, &l, &p, .01, 5, 3), 8);
    for (int i = 0; i < l.n; i++)
        assert_light_equal(&v, i % 2 ? &before : &fresh, i);
    // Turning the probe moves every light, whatever its distance.
    mat3_from_rotation_vector(l.world_from_probe, (const double[3]){ .1, .2, .1 });
    light_visibility_free(&fresh);
    fresh = trace(&s, &l, &p, 6, 1);
    assert_int_equal(light_visibility_refresh(&v, s.rays, &s.texels, &l, &p, .01, 5, 3), 16);
    assert_memory_equal(v.soft, fresh.soft, (size_t)v.n_texels * 16);
    assert_memory_equal(v.bits, fresh.bits, (size_t)v.n_texels * 2);
    light_visibility_free(&fresh);
    light_visibility_free(&before);
    light_visibility_free(&v);
    lights_free(&l);
    panorama_free(&p);
    scene_free(&s);
}

static void thread_count_changes_no_byte_and_the_seed_decides(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_bumpy(48, 24), 48);
    struct panorama p = noisy_panorama();
    struct lights l;
    assert_int_equal(lights_median_cut(&l, &p, 32), 0);
    struct light_visibility one = trace(&s, &l, &p, 5, 1), three = trace(&s, &l, &p, 5, 3), other;
    const size_t n_bits = (size_t)one.n_texels * 2 * 2, n_soft = (size_t)one.n_texels * 32;
    assert_int_equal(one.words_per_texel, 2);
    assert_memory_equal(one.bits, three.bits, n_bits);
    assert_memory_equal(one.soft, three.soft, n_soft);
    assert_int_equal(one.n_rays, three.n_rays);
    assert_int_equal(light_visibility_trace(&other, s.rays, &s.texels, &l, &p, 5, 6, 1), 0);
    assert_memory_not_equal(one.soft, other.soft, n_soft);
    const struct camera camera =
        camera_at((const double[3]){ .4, .1, .2 }, (const double[3]){ 0 }, 250);
    uint8_t *mask_one = mask_of(&s, &camera, 1), *mask_three = mask_of(&s, &camera, 3);
    assert_memory_equal(mask_one, mask_three, (size_t)s.texels.n);
    free(mask_one);
    free(mask_three);
    light_visibility_free(&one);
    light_visibility_free(&three);
    light_visibility_free(&other);
    lights_free(&l);
    panorama_free(&p);
    scene_free(&s);
}

// ---- files and refusals ----

static void files_hold_what_was_traced(void **state)
{
    (void)state;
    char dir[] = "/tmp/studiorig-test-XXXXXX", path[64];
    assert_non_null(mkdtemp(dir));
    struct scene s = scene_of(ray_mesh_bumpy(24, 12), 32);
    struct panorama p = noisy_panorama();
    struct lights l;
    assert_int_equal(lights_median_cut(&l, &p, 32), 0);
    struct light_visibility v = trace(&s, &l, &p, 4, 1);
    snprintf(path, sizeof(path), "%s/lights.bin", dir);
    assert_int_equal(light_visibility_write(&v, 32, path), 0);
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    const size_t n_bits = (size_t)v.n_texels * 4, n_soft = (size_t)v.n_texels * 32;
    uint8_t *bytes = malloc(32 + n_bits + n_soft + 1);
    assert_int_equal(fread(bytes, 1, 32 + n_bits + n_soft + 1, f), 32 + n_bits + n_soft);
    fclose(f);
    assert_memory_equal(bytes, "RIGVIS01", 8);
    const uint32_t header[6] = { (uint32_t)v.n_texels, 32, 2, 4, 32, 0 };
    assert_memory_equal(bytes + 8, header, sizeof(header));
    assert_memory_equal(bytes + 32, v.bits, n_bits);
    assert_memory_equal(bytes + 32 + n_bits, v.soft, n_soft);
    free(bytes);
    unlink(path);

    const struct camera camera =
        camera_at((const double[3]){ .4, .1, .2 }, (const double[3]){ 0 }, 250);
    uint8_t *mask = mask_of(&s, &camera, 1);
    snprintf(path, sizeof(path), "%s/mask.png", dir);
    assert_int_equal(visibility_write_mask_png(mask, &s.texels, path), 0);
    struct image image;
    assert_int_equal(image_read(&image, path), 0);
    assert_true(image.width == 32 && image.height == 32);
    for (int i = 0; i < 32 * 32; i++) {
        const int texel = s.texels.index[i];
        assert_int_equal(lround(255 * image.data[i * image.n_channels]),
                         texel < 0 ? MASK_OUTSIDE : mask[texel]);
    }
    image_free(&image);
    unlink(path);
    free(mask);
    rmdir(dir);
    light_visibility_free(&v);
    lights_free(&l);
    panorama_free(&p);
    scene_free(&s);
}

static void count_line(void *arg, enum log_level level, const char *message)
{
    (void)message;
    if (level == LOG_ERROR)
        ++*(int *)arg;
}

static void soft_without_what_it_needs_is_refused_with_one_line(void **state)
{
    (void)state;
    struct scene s = scene_of(ray_mesh_sphere(12, 6), 16);
    struct panorama p = noisy_panorama(), small = panorama_with(32, 0, 0, 32, 16),
                    large = panorama_with(128, 0, 0, 128, 64);
    struct lights l, torn, loose = random_lights(4, 1);
    assert_int_equal(lights_median_cut(&l, &p, 16), 0);
    assert_int_equal(lights_median_cut(&torn, &p, 16), 0);
    torn.region[5].x1 = 65; // one pixel beyond the panorama
    const struct {
        const struct lights *lights;
        const struct panorama *panorama;
        int n_sub;
    } bad[] = { { &l, &p, 0 },     { &l, &p, 2 },     { &l, &p, 17 },    { &l, NULL, 4 },
                { &loose, &p, 4 }, { &l, &small, 4 }, { &l, &large, 4 }, { &torn, &p, 4 } };
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        int n_lines = 0;
        struct light_visibility v;
        memset(&v, 1, sizeof(v));
        log_set_hook(count_line, &n_lines);
        assert_int_equal(light_visibility_trace(&v, s.rays, &s.texels, bad[i].lights,
                                                bad[i].panorama, bad[i].n_sub, 1, 1),
                         -EINVAL);
        log_set_hook(NULL, NULL);
        assert_int_equal(n_lines, 1);
        assert_null(v.bits);
        light_visibility_free(&v);
    }
    lights_free(&loose);
    lights_free(&torn);
    lights_free(&l);
    panorama_free(&large);
    panorama_free(&small);
    panorama_free(&p);
    scene_free(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(every_texel_of_a_coarse_sphere_is_judged_by_its_own_normal),
        cmocka_unit_test(texels_outside_the_image_or_behind_the_camera_are_outside),
        cmocka_unit_test(disc_hides_the_floor_from_a_camera_within_a_texel_of_its_outline),
        cmocka_unit_test(bits_are_those_of_brute_force),
        cmocka_unit_test(disc_shades_the_floor_within_a_texel_of_its_outline),
        cmocka_unit_test(lights_below_the_horizon_cost_no_ray),
        cmocka_unit_test(refresh_retraces_the_lights_that_moved_and_no_other),
        cmocka_unit_test(soft_shadow_grows_from_none_to_all_through_the_penumbra),
        cmocka_unit_test(soft_share_is_by_energy),
        cmocka_unit_test(soft_refresh_equals_a_new_trace),
        cmocka_unit_test(thread_count_changes_no_byte_and_the_seed_decides),
        cmocka_unit_test(files_hold_what_was_traced),
        cmocka_unit_test(soft_without_what_it_needs_is_refused_with_one_line),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
