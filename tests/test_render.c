// tests/test_render.c - pictures against closed forms and against a double-precision sum written
// here, without the renderer's kernels, rays or interpolation.
#include "solver/render.h"
#include "solver/random.h"
#include "solver/shapes.h"
#include "solver/take/log.h"
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

static const double origin_m[3] = {0, 0, 0};
static const double z_up[3] = {0, 0, 1};

// ---- what the tests look at ---------------------------------------------------------------------

static struct camera camera_at(double x, double y, double z, const double target_m[3], int width_px,
                               int height_px, double focal_px)
{
    struct camera c = {.name = "test",
                       .width_px = width_px,
                       .height_px = height_px,
                       .model = CAMERA_BROWN,
                       .fx = focal_px,
                       .fy = focal_px,
                       .cx = width_px / 2.,
                       .cy = height_px / 2.};
    camera_look_at(&c, (const double[3]){x, y, z}, target_m, z_up);
    return c;
}

// A cube-sphere about the origin; its normals point to the centre if inward.
static void make_sphere(struct mesh *mesh, int n, double radius_m, bool inward)
{
    static const int faces[6][3][3] = {
        {{0, 1, 0}, {0, 0, 1}, {1, 0, 0}},  {{0, -1, 0}, {0, 0, 1}, {-1, 0, 0}},
        {{-1, 0, 0}, {0, 0, 1}, {0, 1, 0}}, {{1, 0, 0}, {0, 0, 1}, {0, -1, 0}},
        {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}},  {{1, 0, 0}, {0, -1, 0}, {0, 0, -1}},
    };
    const int n_vertices = 6 * (n + 1) * (n + 1), n_triangles = 12 * n * n;
    float(*position)[3] = malloc((size_t)n_vertices * sizeof(*position));
    float(*normal)[3] = malloc((size_t)n_vertices * sizeof(*normal));
    float(*uv)[2] = malloc((size_t)n_vertices * sizeof(*uv));
    uint32_t(*triangle)[3] = malloc((size_t)n_triangles * sizeof(*triangle));
    int v = 0, t = 0;
    for (int f = 0; f < 6; f++) {
        const uint32_t first = (uint32_t)v;
        for (int j = 0; j <= n; j++) {
            for (int i = 0; i <= n; i++, v++) {
                double d[3];
                const double a = tan(M_PI / 4 * (2. * i / n - 1)),
                             b = tan(M_PI / 4 * (2. * j / n - 1));
                for (int k = 0; k < 3; k++)
                    d[k] = faces[f][0][k] * a + faces[f][1][k] * b + faces[f][2][k];
                vec3_normalise(d);
                for (int k = 0; k < 3; k++) {
                    position[v][k] = (float)(radius_m * d[k]);
                    normal[v][k] = (float)(inward ? -d[k] : d[k]);
                }
                uv[v][0] = (float)((f % 3 + .04 + .92 * (inward ? n - i : i) / n) / 3);
                uv[v][1] = (float)((f / 3 + .04 + .92 * j / n) / 2);
            }
        }
        for (int j = 0; j < n; j++) {
            for (int i = 0; i < n; i++) {
                const uint32_t a = first + (uint32_t)(j * (n + 1) + i), b = a + 1,
                               c = b + (uint32_t)n + 1, d = c - 1;
                const uint32_t pair[2][3] = {{a, inward ? c : b, inward ? b : c},
                                             {a, inward ? d : c, inward ? c : d}};
                memcpy(triangle[t++], pair[0], sizeof(pair[0]));
                memcpy(triangle[t++], pair[1], sizeof(pair[1]));
            }
        }
    }
    assert_int_equal(
        mesh_from_arrays(mesh, n_vertices, position, normal, uv, n_triangles, triangle), 0);
}

// Directions on a golden spiral; all white and of equal irradiance.
static void make_lights(struct lights *l, int n, double irradiance, double inverse_distance)
{
    assert_int_equal(lights_new(l, n), 0);
    for (int i = 0; i < n; i++) {
        const double z = 1 - (2 * i + 1.) / n, s = sqrt(1 - z * z), angle = 2.399963229728653 * i;
        l->dir_probe[i][0] = s * cos(angle), l->dir_probe[i][1] = s * sin(angle);
        l->dir_probe[i][2] = z;
        for (int c = 0; c < 3; c++)
            l->irradiance[i][c] = irradiance;
        l->inverse_distance[i] = inverse_distance;
    }
}

// Coloured lights, a few strong ones, distances from 1 m to infinity, about a turned and moved
// probe.
static void make_varied_lights(struct lights *l, int n)
{
    make_lights(l, n, 0, 0);
    mat3_from_rotation_vector(l->world_from_probe, (const double[3]){.3, -.8, .4});
    l->centre_m[0] = .1, l->centre_m[1] = -.15, l->centre_m[2] = .05;
    for (int i = 0; i < n; i++) {
        for (int c = 0; c < 3; c++)
            l->irradiance[i][c] =
                (i % 37 ? .2 : 8.) * (.5 + random_uniform(5, 1, (uint64_t)(3 * i + c))) / n;
        l->inverse_distance[i] = i % 5 ? .3 + .7 * random_uniform(5, 2, (uint64_t)i) : 0;
    }
}

static void render(struct image *out, const struct mesh *mesh, const struct lights *lights,
                   const struct render_material *material, const struct render_settings *settings,
                   const struct camera *camera)
{
    struct rays *rays;
    struct renderer *renderer;
    assert_int_equal(rays_new(&rays, mesh), 0);
    assert_int_equal(renderer_new(&renderer, mesh, rays, lights, material, settings), 0);
    assert_int_equal(render_view(renderer, camera, out), 0);
    renderer_free(renderer);
    rays_free(rays);
}

static const float *pixel_of(const struct image *image, int x, int y)
{
    return image->data + 4 * ((size_t)y * (size_t)image->width + (size_t)x);
}

static struct render_material lambert(float albedo)
{
    return (struct render_material){.model = REFLECT_LAMBERT,
                                    .constant_albedo = {albedo, albedo, albedo}};
}

// ---- an independent path: all in double, every triangle asked -----------------------------------

struct found {
    double position[3], normal[3], tangent[3], uv[2];
};

static bool find_surface(const struct mesh *mesh, const double eye[3], const double dir[3],
                         struct found *out)
{
    double nearest = INFINITY;
    for (int i = 0; i < mesh->n_triangles; i++) {
        const uint32_t *t = mesh->triangle[i];
        double corner[3][3], e1[3], e2[3], p[3], s[3], q[3];
        for (int k = 0; k < 3; k++)
            for (int c = 0; c < 3; c++)
                corner[k][c] = mesh->position_m[t[k]][c];
        vec3_sub(e1, corner[1], corner[0]);
        vec3_sub(e2, corner[2], corner[0]);
        vec3_cross(p, dir, e2);
        const double det = vec3_dot(e1, p);
        vec3_sub(s, eye, corner[0]);
        vec3_cross(q, s, e1);
        const double u = vec3_dot(s, p) / det, v = vec3_dot(dir, q) / det,
                     distance = vec3_dot(e2, q) / det;
        if (det == 0 || u < 0 || v < 0 || u + v > 1 || distance <= 0 || distance >= nearest)
            continue;
        nearest = distance;
        const double weight[3] = {1 - u - v, u, v};
        memset(out, 0, sizeof(*out));
        for (int k = 0; k < 3; k++) {
            for (int c = 0; c < 3; c++) {
                out->position[c] += weight[k] * corner[k][c];
                out->normal[c] += weight[k] * mesh->normal[t[k]][c];
            }
            for (int c = 0; c < 2; c++)
                out->uv[c] += weight[k] * mesh->uv[t[k]][c];
        }
        vec3_normalise(out->normal);
        // dP/du where uv is linear: solve [e1 e2] = [Pu Pv] [du1 du2; dv1 dv2]
        const double u1 = mesh->uv[t[1]][0] - mesh->uv[t[0]][0],
                     u2 = mesh->uv[t[2]][0] - mesh->uv[t[0]][0],
                     v1 = mesh->uv[t[1]][1] - mesh->uv[t[0]][1],
                     v2 = mesh->uv[t[2]][1] - mesh->uv[t[0]][1], area = u1 * v2 - u2 * v1;
        for (int c = 0; c < 3; c++)
            out->tangent[c] = (e1[c] * v2 - e2[c] * v1) / area;
        vec3_add_scaled(out->tangent, out->tangent, -vec3_dot(out->tangent, out->normal),
                        out->normal);
        vec3_normalise(out->tangent);
    }
    return nearest < INFINITY;
}

static void reference_radiance(double L[3], const struct found *at, const struct lights *lights,
                               const double eye[3], const struct disney *material)
{
    struct disney_frame frame;
    double v[3];
    memcpy(frame.n, at->normal, sizeof(frame.n));
    memcpy(frame.x, at->tangent, sizeof(frame.x));
    vec3_cross(frame.y, frame.n, frame.x);
    vec3_sub(v, eye, at->position);
    vec3_normalise(v);
    L[0] = L[1] = L[2] = 0;
    for (int i = 0; i < lights->n; i++) {
        struct light_at light;
        double f[3];
        light_at_point(lights, i, at->position, &light);
        const double cosine = vec3_dot(light.l, at->normal);
        if (cosine <= 0)
            continue;
        disney_eval(material, &frame, light.l, v, f);
        for (int c = 0; c < 3; c++)
            L[c] += f[c] * cosine * light.weight * lights->irradiance[i][c];
    }
}

static void a_pixel_is_eq_5_at_what_its_centre_sees(void **state)
{
    (void)state;
    struct mesh mesh;
    struct lights lights;
    struct image image;
    const struct disney truth = {.theta = {.3, .4, .6, .35, .7, .8, .5, .6, .7, .3},
                                 .albedo = {.7, .3, .1}};
    struct render_material material = {.model = REFLECT_DISNEY, .constant_albedo = {.7f, .3f, .1f}};
    for (int k = 0; k < DISNEY_N; k++)
        material.constant_theta[k] = (float)truth.theta[k];
    assert_int_equal(shape_make(&mesh, SHAPE_VASE, origin_m, .5, 3000), 0);
    make_varied_lights(&lights, 2500); // more than one tile of the renderer
    const struct camera camera = camera_at(1.2, .9, .5, origin_m, 40, 30, 45);
    const struct render_settings settings = {.samples = 1};
    render(&image, &mesh, &lights, &material, &settings, &camera);
    int n_seen = 0, n_missed = 0;
    for (int k = 0; k < 200; k++) {
        const int x = (int)(40 * random_uniform(9, 0, (uint64_t)k)),
                  y = (int)(30 * random_uniform(9, 1, (uint64_t)k));
        const float *pixel = pixel_of(&image, x, y);
        double dir[3], L[3];
        struct found at;
        assert_true(camera_ray(&camera, (const double[2]){x + .5, y + .5}, dir));
        if (!find_surface(&mesh, camera.centre_m, dir, &at)) {
            n_missed++;
            assert_true(pixel[0] == 0 && pixel[3] == 0);
            continue;
        }
        n_seen++;
        reference_radiance(L, &at, &lights, camera.centre_m, &truth);
        assert_true(pixel[3] == 1);
        for (int c = 0; c < 3; c++)
            assert_float_equal(pixel[c], L[c], 2e-4 * (L[0] + L[1] + L[2]) + 1e-6);
    }
    assert_true(n_seen > 40 && n_missed > 20);
    image_free(&image), lights_free(&lights), mesh_free(&mesh);
}

static void a_lambertian_sphere_is_n_dot_l(void **state)
{
    (void)state;
    struct mesh mesh;
    struct lights lights;
    struct image image;
    make_sphere(&mesh, 48, .3, false);
    make_lights(&lights, 1, 0, 0);
    const double l[3] = {.48, .6, .64}, colour[3] = {2, 1, .5};
    memcpy(lights.dir_probe[0], l, sizeof(l));
    memcpy(lights.irradiance[0], colour, sizeof(colour));
    const struct render_material material = lambert(.6f);
    const struct render_settings settings = {.samples = 1};
    const struct camera camera = camera_at(1.5, 0, 0, origin_m, 64, 64, 140);
    render(&image, &mesh, &lights, &material, &settings, &camera);
    int n_lit = 0, n_dark = 0;
    for (int y = 0; y < 64; y++) {
        for (int x = 0; x < 64; x++) {
            double d[3];
            camera_ray(&camera, (const double[2]){x + .5, y + .5}, d);
            const double b = vec3_dot(d, camera.centre_m), discriminant = b * b - 1.5 * 1.5 + .09;
            if (discriminant < .01)
                continue;
            double n[3];
            vec3_add_scaled(n, camera.centre_m, -b - sqrt(discriminant), d);
            vec3_normalise(n);
            const double cosine = vec3_dot(n, l), brightness = fmax(cosine, 0) * .6 / M_PI;
            for (int c = 0; c < 3; c++)
                assert_float_equal(pixel_of(&image, x, y)[c], brightness * colour[c],
                                   1e-3 * colour[c]);
            n_lit += cosine > .1, n_dark += cosine < -.1;
        }
    }
    assert_true(n_lit > 400 && n_dark > 100);
    image_free(&image), lights_free(&lights), mesh_free(&mesh);
}

static void a_white_convex_body_in_uniform_light_is_uniform(void **state)
{
    (void)state;
    struct mesh mesh;
    struct lights lights;
    struct image image;
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, origin_m, .3, 8000), 0);
    make_lights(&lights, 2048, 4. / 2048, 0); // irradiance 1 on every surface
    const struct render_material material = lambert(1);
    const struct camera camera = camera_at(.4, -1, .8, origin_m, 48, 48, 80);
    for (int rays = 0; rays < 2; rays++) { // with every light traced, and by groups: all visible
        const struct render_settings settings = {
            .samples = 1, .shadows = true, .shadow_rays = rays};
        int n_seen = 0;
        render(&image, &mesh, &lights, &material, &settings, &camera);
        for (int i = 0; i < 48 * 48; i++) {
            if (image.data[4 * i + 3] == 0)
                continue;
            n_seen++;
            for (int c = 0; c < 3; c++)
                assert_float_equal(image.data[4 * i + c], M_1_PI, 2e-3);
        }
        assert_true(n_seen > 500);
        image_free(&image);
    }
    lights_free(&lights), mesh_free(&mesh);
}

// ---- shadows ------------------------------------------------------------------------------------

static void traced_shadows_are_those_of_every_triangle(void **state)
{
    (void)state;
    enum { N = 24, SIZE = 12 };
    struct mesh mesh;
    struct lights lights;
    struct image image;
    int n_blocked = 0;
    assert_int_equal(shape_make(&mesh, SHAPE_KNOT, origin_m, .3, 1000), 0);
    make_varied_lights(&lights, N);
    const struct render_material material = lambert(.5f);
    const struct render_settings settings = {.samples = 1, .shadows = true};
    const struct camera camera = camera_at(.3, -.9, .9, origin_m, SIZE, SIZE, 22);
    render(&image, &mesh, &lights, &material, &settings, &camera);
    struct rays *rays;
    assert_int_equal(rays_new(&rays, &mesh), 0);
    for (int y = 0; y < SIZE; y++) {
        for (int x = 0; x < SIZE; x++) {
            double dir[3], E[3] = {0}, start[3];
            struct ray_hit hit;
            struct found at;
            camera_ray(&camera, (const double[2]){x + .5, y + .5}, dir);
            if (!find_surface(&mesh, camera.centre_m, dir, &at))
                continue;
            const float eye[3] = {(float)camera.centre_m[0], (float)camera.centre_m[1],
                                  (float)camera.centre_m[2]};
            const float along[3] = {(float)dir[0], (float)dir[1], (float)dir[2]};
            float start_m[3];
            assert_true(rays_hit(rays, eye, along, 0, INFINITY, &hit));
            rays_start(rays, hit.triangle, (const float[2]){hit.u, hit.v}, start_m);
            for (int k = 0; k < 3; k++)
                start[k] = start_m[k];
            for (int i = 0; i < N; i++) {
                struct light_at light;
                double to[3];
                light_at_point(&lights, i, at.position, &light);
                mat3_mul_vec(to, lights.world_from_probe, lights.dir_probe[i]);
                double end = INFINITY;
                if (lights.inverse_distance[i] > 0) { // to the light's place, from the start
                    for (int k = 0; k < 3; k++)
                        to[k] = lights.centre_m[k] + to[k] / lights.inverse_distance[i] - start[k];
                    end = .9999;
                }
                const double cosine = vec3_dot(light.l, at.normal);
                if (cosine <= 0)
                    continue;
                if (rays_blocked_brute_force(&mesh, start, to, 0, end)) {
                    n_blocked++;
                    continue;
                }
                for (int c = 0; c < 3; c++)
                    E[c] += cosine * light.weight * lights.irradiance[i][c];
            }
            for (int c = 0; c < 3; c++)
                assert_float_equal(pixel_of(&image, x, y)[c], E[c] * .5 / M_PI, 1e-5);
        }
    }
    assert_true(n_blocked > 20);
    rays_free(rays);
    image_free(&image), lights_free(&lights), mesh_free(&mesh);
}

static void grouped_shadows_agree_with_traced_ones_on_average(void **state)
{
    (void)state;
    enum { N_SEEDS = 60, SIZE = 16 };
    struct mesh mesh;
    struct lights lights;
    struct image exact, open, one;
    static double sum[SIZE * SIZE], squares[SIZE * SIZE];
    assert_int_equal(shape_make(&mesh, SHAPE_KNOT, origin_m, .3, 3000), 0);
    make_varied_lights(&lights, 1500);
    const struct render_material material = lambert(.5f);
    const struct camera camera = camera_at(.2, -.6, 1.1, origin_m, SIZE, SIZE, 30);
    struct render_settings settings = {.samples = 1};
    render(&open, &mesh, &lights, &material, &settings, &camera);
    settings.shadows = true;
    render(&exact, &mesh, &lights, &material, &settings, &camera);
    settings.shadow_rays = 1;
    memset(sum, 0, sizeof(sum)), memset(squares, 0, sizeof(squares));
    for (int seed = 0; seed < N_SEEDS; seed++) {
        settings.seed = (uint64_t)seed;
        render(&one, &mesh, &lights, &material, &settings, &camera);
        for (int i = 0; i < SIZE * SIZE; i++)
            sum[i] += one.data[4 * i], squares[i] += one.data[4 * i] * one.data[4 * i];
        image_free(&one);
    }
    double total = 0, total_exact = 0, total_open = 0;
    for (int i = 0; i < SIZE * SIZE; i++) {
        const double mean = sum[i] / N_SEEDS,
                     error = sqrt(fmax(squares[i] / N_SEEDS - mean * mean, 0) / (N_SEEDS - 1));
        // five standard errors, and 1% for what one draw by energy says about its whole group
        assert_true(fabs(mean - exact.data[4 * i]) <= 5 * error + .01 * exact.data[4 * i] + 1e-6);
        total += mean, total_exact += exact.data[4 * i], total_open += open.data[4 * i];
    }
    assert_float_equal(total, total_exact, .003 * total_exact);
    assert_true(total_open > 1.1 * total_exact); // there were shadows to estimate
    image_free(&exact), image_free(&open), lights_free(&lights), mesh_free(&mesh);
}

// ---- the bounce ---------------------------------------------------------------------------------

// Inside a sphere, cosine-distributed rays from any point end uniformly over the area. So one
// bounce gives every point rho x the mean irradiance, whatever the lights. A light with Eq. 3's
// cosine inside, at distance r from c, sends out pi r^2 C: the mean over the area 4 pi R^2 is r^2 C
// / (4 R^2).
static void inside_a_sphere_one_bounce_is_rho_times_the_mean_irradiance(void **state)
{
    (void)state;
    enum { SIZE = 12 };
    const double rho = .7, R = 1;
    struct mesh mesh;
    struct lights lights;
    struct image direct, both;
    double mean_E = 0, sum = 0;
    make_sphere(&mesh, 24, R, true);
    make_lights(&lights, 20, 1, 0);
    for (int i = 0; i < lights.n; i++) {
        const double r = .25 + .02 * i;
        lights.inverse_distance[i] = 1 / r;
        mean_E += r * r * lights.irradiance[i][0] / (4 * R * R);
    }
    const struct render_material material = lambert((float)rho);
    const struct camera camera =
        camera_at(.3, .2, -.1, (const double[3]){-.5, -.4, .6}, SIZE, SIZE, 5);
    struct render_settings settings = {.samples = 1, .shadows = true};
    render(&direct, &mesh, &lights, &material, &settings, &camera);
    settings.bounce_rays = 1024, settings.bounce_texture = 128;
    render(&both, &mesh, &lights, &material, &settings, &camera);
    const double expected = rho / M_PI * rho * mean_E;
    for (int i = 0; i < SIZE * SIZE; i++) {
        const double indirect = both.data[4 * i] - direct.data[4 * i];
        assert_float_equal(indirect, expected, .04 * expected);
        sum += indirect;
    }
    // .5%: a sphere of 6,912 facets is .2% smaller than the round one
    assert_float_equal(sum / (SIZE * SIZE), expected, .005 * expected);
    image_free(&direct), image_free(&both), lights_free(&lights), mesh_free(&mesh);
}

static void a_bowl_brightens_inside_and_makes_no_energy(void **state)
{
    (void)state;
    enum { SIZE = 40 };
    struct mesh mesh;
    struct lights lights;
    struct image direct, both;
    double total = 0;
    assert_int_equal(shape_make(&mesh, SHAPE_BOWL, origin_m, .3, 4000), 0);
    make_lights(&lights, 200, .02, 0);
    for (int i = 0; i < lights.n; i++)
        total += lights.irradiance[i][0];
    const float albedo = .8f;
    const struct render_material material = lambert(albedo);
    const struct camera camera = camera_at(.5, -.3, 1.2, origin_m, SIZE, SIZE, 70);
    struct render_settings settings = {.samples = 1, .shadows = true};
    render(&direct, &mesh, &lights, &material, &settings, &camera);
    settings.bounce_rays = 64, settings.bounce_texture = 128;
    render(&both, &mesh, &lights, &material, &settings, &camera);
    int n_brighter = 0;
    for (int i = 0; i < SIZE * SIZE; i++) {
        const double before = direct.data[4 * i], after = both.data[4 * i];
        assert_true(after >= before);
        assert_true(after - before <= albedo * albedo * total / M_PI);
        n_brighter += before > 0 && after > 1.15 * before;
    }
    assert_true(n_brighter > 100);
    image_free(&direct), image_free(&both), lights_free(&lights), mesh_free(&mesh);
}

// ---- textures, samples, threads -----------------------------------------------------------------

static void make_square(struct mesh *mesh)
{
    float(*position)[3] = malloc(4 * sizeof(*position));
    float(*uv)[2] = malloc(4 * sizeof(*uv));
    uint32_t(*triangle)[3] = malloc(2 * sizeof(*triangle));
    for (int i = 0; i < 4; i++) { // in the plane x = 0, seen from +x: y to the right, z up
        uv[i][0] = i == 1 || i == 2, uv[i][1] = i >= 2;
        position[i][0] = 0, position[i][1] = uv[i][0] - .5f, position[i][2] = uv[i][1] - .5f;
    }
    memcpy(triangle[0], (const uint32_t[3]){0, 1, 2}, sizeof(triangle[0]));
    memcpy(triangle[1], (const uint32_t[3]){0, 2, 3}, sizeof(triangle[1]));
    assert_int_equal(mesh_from_arrays(mesh, 4, position, NULL, uv, 2, triangle), 0);
}

static void textures_lie_upright_and_nearest_keeps_borders_sharp(void **state)
{
    (void)state;
    struct mesh mesh;
    struct lights lights;
    struct image albedo, image;
    make_square(&mesh);
    make_lights(&lights, 1, M_PI, 0);
    lights.dir_probe[0][0] = 1, lights.dir_probe[0][1] = lights.dir_probe[0][2] = 0;
    assert_int_equal(image_new(&albedo, 2, 2, 3, NULL), 0);
    for (int i = 0; i < 4; i++) // top left red .2, top right .4, bottom left .6, bottom right .8
        albedo.data[3 * i] = .2f * (float)(i + 1);
    struct render_material material = {.model = REFLECT_LAMBERT, .albedo = &albedo};
    const struct render_settings settings = {.samples = 1};
    const struct camera camera = camera_at(2, 0, 0, origin_m, 40, 40, 80); // fills the picture
    for (int nearest = 0; nearest < 2; nearest++) {
        material.nearest = nearest;
        render(&image, &mesh, &lights, &material, &settings, &camera);
        for (int y = 0; y < 40; y++) {
            for (int x = 0; x < 40; x++) {
                const double s = fmin(fmax((x + .5) / 20 - .5, 0), 1),
                             t = fmin(fmax((y + .5) / 20 - .5, 0), 1);
                const double expected =
                    nearest ? .2 * (1 + (x >= 20) + 2 * (y >= 20)) : .2 * (1 + s + 2 * t);
                assert_float_equal(pixel_of(&image, x, y)[0], expected, 1e-4);
                assert_true(pixel_of(&image, x, y)[1] == 0);
            }
        }
        image_free(&image);
    }
    image_free(&albedo), lights_free(&lights), mesh_free(&mesh);
}

static void silhouettes_carry_the_share_they_cover(void **state)
{
    (void)state;
    struct mesh mesh;
    struct lights lights;
    struct image image;
    make_square(&mesh);
    make_lights(&lights, 1, M_PI, 0);
    lights.dir_probe[0][0] = 1, lights.dir_probe[0][1] = lights.dir_probe[0][2] = 0;
    const struct render_material material = lambert(.5f);
    const struct render_settings settings = {.samples = 4};
    // the square is 10 px wide, from 5.25 to 15.25 across and 5.5 to 15.5 down
    struct camera camera = camera_at(2, 0, 0, origin_m, 20, 20, 20);
    camera.cx = 10.25, camera.cy = 10.5;
    render(&image, &mesh, &lights, &material, &settings, &camera);
    assert_float_equal(pixel_of(&image, 5, 10)[3], .75, 1e-6);
    assert_float_equal(pixel_of(&image, 5, 10)[0], .375, 1e-5);
    assert_float_equal(pixel_of(&image, 15, 10)[3], .25, 1e-6);
    assert_float_equal(pixel_of(&image, 10, 5)[3], .5, 1e-6);
    assert_float_equal(pixel_of(&image, 5, 5)[3], .375, 1e-6);
    assert_float_equal(pixel_of(&image, 10, 10)[0], .5, 1e-5);
    image_free(&image), lights_free(&lights), mesh_free(&mesh);
}

// RMSE of one shading per smooth pixel against one per sample, on the object, relative to its
// brightest value. A view of `size` pixels.
static double shaded_once_error(const struct mesh *mesh, const struct lights *lights, int size)
{
    struct image once, each;
    double squares = 0, white = 0;
    int n = 0, n_different = 0;
    const struct render_material material = {
        .model = REFLECT_DISNEY,
        .constant_albedo = {.6f, .3f, .2f},
        .constant_theta = {.2f, .2f, .5f, .5f, .9f, 0, .3f, .4f, .2f, .2f}};
    const struct camera camera = camera_at(.4, -1, .8, origin_m, size, size, 2. * size);
    struct render_settings settings = {.samples = 2};
    render(&once, mesh, lights, &material, &settings, &camera);
    settings.shade_every_sample = true;
    render(&each, mesh, lights, &material, &settings, &camera);
    for (int i = 0; i < size * size; i++) {
        assert_true(once.data[4 * i + 3] == each.data[4 * i + 3]); // coverage is never skipped
        for (int c = 0; c < 3; c++) {
            squares += pow((double)once.data[4 * i + c] - each.data[4 * i + c], 2);
            white = fmax(white, each.data[4 * i + c]);
            n += each.data[4 * i + 3] > 0;
            n_different += once.data[4 * i + c] != each.data[4 * i + c];
        }
    }
    assert_true(n_different > n / 2); // the short way was taken
    image_free(&once), image_free(&each);
    return sqrt(squares / n) / white;
}

static void one_shading_per_smooth_pixel_costs_less_than_the_solver_aims_at(void **state)
{
    (void)state;
    struct mesh mesh;
    struct lights lights;
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, origin_m, .3, 40000), 0);
    make_varied_lights(&lights, 200);
    const double coarse = shaded_once_error(&mesh, &lights, 50),
                 fine = shaded_once_error(&mesh, &lights, 100);
    fprintf(stderr, "# shaded once: RMSE %.4f%% at 50 px, %.4f%% at 100 px\n", 100 * coarse,
            100 * fine);
    // SOLVER.md 5's tightest target is an RMSE of .08%; real views have 5 times the pixels.
    assert_true(coarse < .0008 && fine < .0008);
    lights_free(&lights), mesh_free(&mesh);
}

static void threads_do_not_change_a_bit_and_seeds_do(void **state)
{
    (void)state;
    struct mesh mesh;
    struct lights lights;
    struct image a, b, c;
    assert_int_equal(shape_make(&mesh, SHAPE_BOWL, origin_m, .3, 2000), 0);
    make_varied_lights(&lights, 1200);
    const struct render_material material = {
        .model = REFLECT_DISNEY,
        .constant_albedo = {.6f, .3f, .2f},
        .constant_theta = {.2f, .2f, .5f, .5f, .9f, 0, .3f, .4f, .2f, .2f}};
    const struct camera camera = camera_at(.5, -.3, 1.2, origin_m, 32, 24, 50);
    struct render_settings settings = {.samples = 2,
                                       .shadows = true,
                                       .shadow_rays = 2,
                                       .bounce_rays = 8,
                                       .bounce_texture = 64,
                                       .seed = 3,
                                       .n_threads = 1};
    render(&a, &mesh, &lights, &material, &settings, &camera);
    settings.n_threads = 3;
    render(&b, &mesh, &lights, &material, &settings, &camera);
    settings.seed = 4;
    render(&c, &mesh, &lights, &material, &settings, &camera);
    assert_memory_equal(a.data, b.data, 32 * 24 * 4 * sizeof(float));
    assert_true(memcmp(a.data, c.data, 32 * 24 * 4 * sizeof(float)));
    image_free(&a), image_free(&b), image_free(&c), lights_free(&lights), mesh_free(&mesh);
}

// ---- where things break -------------------------------------------------------------------------

static void extreme_materials_and_lights_give_finite_pixels(void **state)
{
    (void)state;
    struct mesh mesh;
    struct lights lights;
    struct image image;
    assert_int_equal(shape_make(&mesh, SHAPE_KNOT, origin_m, .3, 400), 0); // coarse: normals lie
    make_varied_lights(&lights, 64);
    for (int k = 0; k < 3; k++) { // lights on a vertex, inside the tube, at the eye
        lights.inverse_distance[k] = 3 + k;
        lights.irradiance[k][0] = 1e6;
    }
    for (int i = 0; i < 3; i++)
        lights.dir_probe[3][i] = mesh.position_m[0][i] - lights.centre_m[i];
    lights.inverse_distance[3] = 1 / vec3_normalise(lights.dir_probe[3]);
    const struct camera camera = camera_at(.2, -.6, .9, origin_m, 32, 32, 40);
    for (int corner = 0; corner < 12; corner++) {
        struct render_material material = {.model = REFLECT_DISNEY};
        struct render_settings settings = {.samples = 1,
                                           .shadows = true,
                                           .shadow_rays = corner % 2,
                                           .bounce_rays = 4,
                                           .bounce_texture = 32};
        for (int k = 0; k < DISNEY_N; k++)
            material.constant_theta[k] = random_u64(2, (uint64_t)corner, (uint64_t)k) & 1;
        for (int c = 0; c < 3; c++)
            material.constant_albedo[c] = corner % 3 == c;
        render(&image, &mesh, &lights, &material, &settings, &camera);
        for (int i = 0; i < 32 * 32 * 4; i++)
            assert_true(isfinite(image.data[i]) && image.data[i] >= 0);
        image_free(&image);
    }
    lights_free(&lights), mesh_free(&mesh);
}

static void a_mesh_without_area_in_uv_or_normals_still_renders(void **state)
{
    (void)state;
    struct mesh mesh;
    struct lights lights;
    struct image image;
    make_square(&mesh);
    for (int i = 0; i < 4; i++) {
        mesh.uv[i][0] = mesh.uv[i][1] = .5f;
        mesh.normal[i][0] = mesh.normal[i][1] = mesh.normal[i][2] = 0;
    }
    make_lights(&lights, 50, .1, .5);
    const struct render_material material = {
        .model = REFLECT_DISNEY,
        .constant_albedo = {.5f, .5f, .5f},
        .constant_theta = {0, 0, .5f, .5f, 0, .9f, 0, 0, 0, 0}};
    const struct render_settings settings = {.samples = 1};
    const struct camera camera = camera_at(2, 0, 0, origin_m, 16, 16, 20);
    render(&image, &mesh, &lights, &material, &settings, &camera);
    for (int i = 0; i < 16 * 16 * 4; i++)
        assert_true(isfinite(image.data[i]));
    assert_true(pixel_of(&image, 8, 8)[0] > 0);
    image_free(&image), lights_free(&lights), mesh_free(&mesh);
}

static void textures_without_their_channels_are_refused(void **state)
{
    (void)state;
    static const char *const wrong[] = {"Y"};
    struct mesh mesh;
    struct lights lights;
    struct rays *rays;
    struct renderer *renderer;
    struct image albedo;
    make_square(&mesh);
    make_lights(&lights, 1, 1, 0);
    assert_int_equal(rays_new(&rays, &mesh), 0);
    assert_int_equal(image_new(&albedo, 2, 2, 1, wrong), 0);
    const struct render_settings settings = {.samples = 1};
    const struct render_material grey = {.model = REFLECT_LAMBERT, .albedo = &albedo};
    const struct render_material bare = {.model = REFLECT_DISNEY, .parameters = &albedo};
    log_set_level(LOG_SILENT);
    assert_int_equal(renderer_new(&renderer, &mesh, rays, &lights, &grey, &settings), -EINVAL);
    assert_null(renderer);
    assert_int_equal(renderer_new(&renderer, &mesh, rays, &lights, &bare, &settings), -EINVAL);
    log_set_level(LOG_INFO);
    rays_free(rays);
    image_free(&albedo), lights_free(&lights), mesh_free(&mesh);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_pixel_is_eq_5_at_what_its_centre_sees),
        cmocka_unit_test(a_lambertian_sphere_is_n_dot_l),
        cmocka_unit_test(a_white_convex_body_in_uniform_light_is_uniform),
        cmocka_unit_test(traced_shadows_are_those_of_every_triangle),
        cmocka_unit_test(grouped_shadows_agree_with_traced_ones_on_average),
        cmocka_unit_test(inside_a_sphere_one_bounce_is_rho_times_the_mean_irradiance),
        cmocka_unit_test(a_bowl_brightens_inside_and_makes_no_energy),
        cmocka_unit_test(textures_lie_upright_and_nearest_keeps_borders_sharp),
        cmocka_unit_test(silhouettes_carry_the_share_they_cover),
        cmocka_unit_test(one_shading_per_smooth_pixel_costs_less_than_the_solver_aims_at),
        cmocka_unit_test(threads_do_not_change_a_bit_and_seeds_do),
        cmocka_unit_test(extreme_materials_and_lights_give_finite_pixels),
        cmocka_unit_test(a_mesh_without_area_in_uv_or_normals_still_renders),
        cmocka_unit_test(textures_without_their_channels_are_refused),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
