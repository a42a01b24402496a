// tests/test_silhouette.c - a known blur, shift or growth is found at an object's outline, whatever its shading and its background do;
// and where a picture cannot tell, it is not made to.
#include "solver/random.h"
#include "solver/shapes.h"
#include "solver/silhouette.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { W = 260, H = 190, N_VIEWS = 3, SUB = 4 };
static const int RGB[3] = { 0, 1, 2 };
// A Gaussian has 2 % left this many deviations away.
static const double FOOT = 2.054;

enum surroundings { EVEN, RAMP, LAMPS, SAME, MIRRORED, WILD };

struct scene {
    struct mesh mesh;
    struct rays *rays;
    struct camera camera[N_VIEWS];
    struct image image[N_VIEWS];
};

// The object is brighter towards its outline, as surfaces are, and has stripes.
static double object_at(enum surroundings around, const double point[3], double facing)
{
    const double rim = pow(1 - facing, 5);
    const double diffuse = .3 + .05 * sin(20 * point[0]) + .03 * cos(31 * point[2]);
    return around == SAME ? .3 : around == MIRRORED ? diffuse + rim * (.9 - diffuse) : diffuse * (1 + .4 * rim);
}

static double background_at(enum surroundings around, int v, double u_px, double v_px)
{
    switch (around) {
    case RAMP:
        return .05 + .3 * u_px / W;
    case LAMPS: // 50 px wide, every 130
        return fmod(u_px + 37 * v, 130) < 50 && fmod(v_px, 130) < 50 ? 20 : .02;
    case WILD: // cells of 5 px
        return 1.2 * random_uniform(1, (uint64_t)v, (uint64_t)(u_px / 5) + 1000 * (uint64_t)(v_px / 5));
    default:
        return .9;
    }
}

static void paint(struct scene *s, int v, enum surroundings around, double gain)
{
    const struct camera *camera = &s->camera[v];
    const float from[3] = { (float)camera->centre_m[0], (float)camera->centre_m[1], (float)camera->centre_m[2] };
    for (int i = 0; i < W * H; i++) {
        double sum = 0;
        for (int k = 0; k < SUB * SUB; k++) {
            const double uv_px[2] = { i % W + (k % SUB + .5) / SUB, i / W + (k / SUB + .5) / SUB };
            double dir[3], point[3], facing = 0;
            struct ray_hit hit;
            assert_true(camera_ray(camera, uv_px, dir));
            if (!rays_hit(s->rays, from, (const float[3]){ (float)dir[0], (float)dir[1], (float)dir[2] }, 0, INFINITY, &hit)) {
                sum += around == SAME ? .3 : background_at(around, v, uv_px[0], uv_px[1]);
                continue;
            }
            for (int c = 0; c < 3; c++) {
                point[c] = camera->centre_m[c] + (double)hit.t * dir[c];
                facing -= dir[c] * (double)s->mesh.normal[s->mesh.triangle[hit.triangle][0]][c];
            }
            sum += object_at(around, point, fmax(facing, 0));
        }
        for (int c = 0; c < 3; c++)
            s->image[v].data[3 * i + c] = (float)(gain * sum / (SUB * SUB));
    }
}

static void blur(struct image *image, double sigma_px)
{
    const int reach = (int)ceil(4 * sigma_px);
    float *line = malloc(sizeof(*line) * (size_t)(W > H ? W : H));
    for (int axis = 0; axis < 2; axis++)
        for (int across = 0; across < (axis ? W : H); across++)
            for (int c = 0; c < 3; c++) {
                const int n = axis ? H : W;
                float *first = image->data + (axis ? across * 3 : across * W * 3) + c;
                const int stride = axis ? W * 3 : 3;
                for (int i = 0; i < n; i++) {
                    double sum = 0, weights = 0;
                    for (int j = i - reach; j <= i + reach; j++) {
                        const double w = sigma_px > 0 ? exp(-.5 * (i - j) * (i - j) / (sigma_px * sigma_px)) : 1;
                        if (j >= 0 && j < n)
                            sum += w * (double)first[j * stride], weights += w;
                    }
                    line[i] = (float)(sum / weights);
                }
                for (int i = 0; i < n; i++)
                    first[i * stride] = line[i];
            }
    free(line);
}

static void scene_open(struct scene *s, enum surroundings around, double gain)
{
    memset(s, 0, sizeof(*s));
    assert_int_equal(shape_make(&s->mesh, SHAPE_PEBBLE, (const double[3]){ 0 }, 1, 20000), 0);
    assert_int_equal(rays_new(&s->rays, &s->mesh), 0);
    for (int v = 0; v < N_VIEWS; v++) {
        struct camera *c = &s->camera[v];
        *c = (struct camera){ .width_px = W, .height_px = H, .model = CAMERA_BROWN, .fx = 235, .fy = 235, .cx = W / 2. + .3, .cy = H / 2. };
        camera_look_at(c, (const double[3]){ 3 * cos(1.5 * v), 3 * sin(1.5 * v), 1.2 }, (const double[3]){ 0 }, (const double[3]){ 0, 0, 1 });
        assert_int_equal(image_new(&s->image[v], W, H, 3, NULL), 0);
        paint(s, v, around, gain);
    }
}

static void scene_close(struct scene *s)
{
    for (int v = 0; v < N_VIEWS; v++)
        image_free(&s->image[v]);
    rays_free(s->rays);
    mesh_free(&s->mesh);
}

static bool measure(const struct scene *s, double *reach_px, double *offset_px)
{
    struct silhouette all = { 0 };
    *reach_px = *offset_px = NAN;
    for (int v = 0; v < N_VIEWS; v++)
        silhouette_add(&all, s->rays, &s->camera[v], &s->image[v], RGB);
    return silhouette_reach(&all, reach_px, offset_px);
}

static void a_known_blur_is_found(void **state)
{
    (void)state;
    static const double sigmas[] = { 0, .5, 1, 2, 4, 7 };
    static const enum surroundings all[] = { EVEN, RAMP, LAMPS };
    for (size_t a = 0; a < sizeof(all) / sizeof(all[0]); a++)
        for (size_t k = 0; k < sizeof(sigmas) / sizeof(sigmas[0]); k++) {
            struct scene s;
            double reach, offset;
            if (all[a] != EVEN && sigmas[k] > 2)
                continue; // what is behind is not plain within its reach
            scene_open(&s, all[a], 1);
            for (int v = 0; v < N_VIEWS; v++)
                blur(&s.image[v], sigmas[k]);
            assert_true(measure(&s, &reach, &offset));
            const double expected = FOOT * sqrt(sigmas[k] * sigmas[k] + 1. / 12);
            fprintf(stderr, "# background %d, sigma %.1f px: reach %.2f (%.2f), offset %.2f\n", (int)all[a], sigmas[k], reach, expected, offset);
            assert_true(fabs(reach - expected) < .35 + .1 * expected);
            assert_true(fabs(offset) < .25 + .35 * sigmas[k]);
            scene_close(&s);
        }
}

// A polished object before a white wall: by its rim alone it cannot be told from an outline that lies further inside.
static void a_rim_that_mirrors_what_is_behind_errs_to_the_safe_side(void **state)
{
    (void)state;
    for (int sigma_px = 0; sigma_px <= 2; sigma_px++) {
        struct scene s;
        double reach, offset;
        scene_open(&s, MIRRORED, 1);
        for (int v = 0; v < N_VIEWS; v++)
            blur(&s.image[v], sigma_px);
        assert_true(measure(&s, &reach, &offset));
        const double expected = FOOT * sqrt(sigma_px * sigma_px + 1. / 12);
        fprintf(stderr, "# mirrored, sigma %d px: reach %.2f (%.2f), offset %.2f\n", sigma_px, reach, expected, offset);
        assert_true(reach > expected - .35 && reach < expected + 2);
        scene_close(&s);
    }
}

static void noise_changes_little(void **state)
{
    (void)state;
    for (int blurred = 0; blurred < 2; blurred++) {
        struct scene s;
        double reach[2], offset;
        scene_open(&s, EVEN, 1);
        for (int v = 0; blurred && v < N_VIEWS; v++)
            blur(&s.image[v], 1);
        assert_true(measure(&s, &reach[0], &offset));
        for (int v = 0; v < N_VIEWS; v++)
            for (int i = 0; i < W * H * 3; i++)
                s.image[v].data[i] += .02f * (float)random_normal(1, (uint64_t)v, (uint64_t)i);
        assert_true(measure(&s, &reach[1], &offset));
        fprintf(stderr, "# reach %.2f, with noise %.2f\n", reach[0], reach[1]);
        assert_true(fabs(reach[1] - reach[0]) < .25);
        scene_close(&s);
    }
}

static void cameras_that_are_off_widen_the_outline(void **state)
{
    (void)state;
    struct scene s;
    double sharp, reach, offset;
    scene_open(&s, EVEN, 1);
    assert_true(measure(&s, &sharp, &offset));
    for (int v = 0; v < N_VIEWS; v++)
        s.camera[v].cx += 1.5;
    assert_true(measure(&s, &reach, &offset));
    fprintf(stderr, "# reach %.2f, cameras 1.5 px off: %.2f\n", sharp, reach);
    assert_true(reach > sharp + .8 && reach < 3);
    scene_close(&s);
}

static void a_mesh_that_is_too_large_or_small_is_told_by_how_much(void **state)
{
    (void)state;
    static const double off_px[] = { -3, -1, 1, 3 };
    for (size_t k = 0; k < sizeof(off_px) / sizeof(off_px[0]); k++) {
        struct scene s;
        double reach, offset, radius_px = 0;
        scene_open(&s, EVEN, 1);
        for (int i = 0; i < W; i++) { // half of what is seen of it in its middle row
            const double uv_px[2] = { i + .5, H / 2. };
            const double *at = s.camera[0].centre_m;
            double dir[3];
            struct ray_hit hit;
            assert_true(camera_ray(&s.camera[0], uv_px, dir));
            radius_px += .5 * rays_hit(s.rays, (const float[3]){ (float)at[0], (float)at[1], (float)at[2] },
                                       (const float[3]){ (float)dir[0], (float)dir[1], (float)dir[2] }, 0, INFINITY, &hit);
        }
        for (int v = 0; v < N_VIEWS; v++) // as if the mesh were larger
            s.camera[v].fx *= 1 + off_px[k] / radius_px, s.camera[v].fy *= 1 + off_px[k] / radius_px;
        assert_true(measure(&s, &reach, &offset));
        fprintf(stderr, "# mesh %+.0f px: offset %.2f, reach %.2f\n", off_px[k], offset, reach);
        assert_true(fabs(offset - off_px[k]) < .3 + .1 * fabs(off_px[k]));
        assert_true(reach > fabs(off_px[k]) && reach < fabs(off_px[k]) + 2);
        scene_close(&s);
    }
}

static void pictures_that_do_not_tell_say_so(void **state)
{
    (void)state;
    struct scene s;
    double reach, offset;
    scene_open(&s, SAME, 1); // no contrast
    assert_false(measure(&s, &reach, &offset));
    scene_close(&s);
    scene_open(&s, WILD, 1); // not plain anywhere
    assert_false(measure(&s, &reach, &offset));
    scene_close(&s);
    scene_open(&s, EVEN, 0); // black
    assert_false(measure(&s, &reach, &offset));
    for (int v = 0; v < N_VIEWS; v++)
        for (int i = 0; i < W * H * 3; i++)
            s.image[v].data[i] = (float)random_normal(1, (uint64_t)v, (uint64_t)i); // noise alone
    assert_false(measure(&s, &reach, &offset));
    scene_close(&s);
    scene_open(&s, EVEN, 1);
    for (int v = 0; v < N_VIEWS; v++)
        s.camera[v].fx = s.camera[v].fy = 3000; // the object is everywhere
    assert_false(measure(&s, &reach, &offset));
    for (int v = 0; v < N_VIEWS; v++) // looks away
        camera_look_at(&s.camera[v], (const double[3]){ 3, 0, 0 }, (const double[3]){ 9, 0, 0 }, (const double[3]){ 0, 0, 1 });
    assert_false(measure(&s, &reach, &offset));
    assert_true(isnan(reach) && isnan(offset));
    scene_close(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_known_blur_is_found),
        cmocka_unit_test(a_rim_that_mirrors_what_is_behind_errs_to_the_safe_side),
        cmocka_unit_test(noise_changes_little),
        cmocka_unit_test(cameras_that_are_off_widen_the_outline),
        cmocka_unit_test(a_mesh_that_is_too_large_or_small_is_told_by_how_much),
        cmocka_unit_test(pictures_that_do_not_tell_say_so),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
