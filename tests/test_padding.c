// tests/test_padding.c - which charts are too near for a texture, and which only look it.
#include "solver/padding.h"
#include "solver/shapes.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { MOST = 64 };
static struct {
    int n;
    float place[4 * MOST][3], uv[4 * MOST][2];
} quads; // four corners each

static int forget(void **state)
{
    (void)state;
    quads.n = 0;
    return 0;
}

// A metre of wall is a unit of the atlas: u0..u1 x v0..v1 at (x, 0, z), or across.
static void add_quad(double x, double z, double u0, double v0, double u1, double v1)
{
    const double corner[4][2] = { { u0, v0 }, { u1, v0 }, { u1, v1 }, { u0, v1 } };
    for (int k = 0; k < 4; k++) {
        const int i = 4 * quads.n + k;
        quads.uv[i][0] = (float)corner[k][0], quads.uv[i][1] = (float)corner[k][1];
        quads.place[i][0] = (float)(x + corner[k][0] - u0), quads.place[i][1] = 0, quads.place[i][2] = (float)(z + corner[k][1] - v0);
    }
    quads.n++;
}

static struct padding measure_mesh(const struct mesh *mesh, int size)
{
    struct padding p;
    struct texels t;
    assert_int_equal(texels_rasterise(&t, mesh, size), 0);
    assert_int_equal(padding_measure(&p, mesh, &t), 0);
    assert_int_equal(p.size, size);
    texels_free(&t);
    return p;
}

static struct padding measure(int size)
{
    struct mesh mesh;
    float(*place)[3] = malloc(sizeof(quads.place)), (*uv)[2] = malloc(sizeof(quads.uv));
    uint32_t(*triangle)[3] = malloc(2 * MOST * sizeof(*triangle));
    memcpy(place, quads.place, sizeof(quads.place)), memcpy(uv, quads.uv, sizeof(quads.uv));
    for (int i = 0; i < quads.n; i++)
        for (int k = 0; k < 2; k++) {
            uint32_t *t = triangle[2 * i + k];
            t[0] = (uint32_t)(4 * i), t[1] = (uint32_t)(4 * i + 1 + k), t[2] = (uint32_t)(4 * i + 2 + k);
        }
    assert_int_equal(mesh_from_arrays(&mesh, 4 * quads.n, place, NULL, uv, 2 * quads.n, triangle), 0);
    const struct padding p = measure_mesh(&mesh, size);
    mesh_free(&mesh);
    return p;
}

static void near(double found, double expected, double bound)
{
    if (!(fabs(found - expected) <= bound))
        fail_msg("%.6g, expected %.6g", found, expected);
}

// Two squares a hundredth of the atlas apart and metres apart on the surface.
static void the_gap_is_measured_in_texels_of_the_texture(void **state)
{
    (void)state;
    add_quad(0, 0, .1, .3, .45, .7);
    add_quad(5, 0, .46, .3, .81, .7);
    for (int size = 32; size <= 512; size *= 2) {
        const struct padding p = measure(size);
        const bool is_short = .01 * size < 2;
        assert_int_equal(padding_is_short(&p), is_short);
        near(p.gap_px, is_short ? .01 * size : 2, .01);
        // both sides' borders of .4, a strip of half what is missing to two texels; a little more around the corners
        near(p.share, is_short ? 2 * .4 * (1 - .01 * size / 2) / size / (2 * .35 * .4) : 0, .15 * p.share);
        near(p.enough_size, is_short ? 200 : size, 2);
    }
    assert_false(padding_is_short(&(struct padding){ 0 }));
}

static void what_a_larger_texture_needs_is_enough_and_no_more(void **state)
{
    (void)state;
    add_quad(0, 0, .1, .1, .4, .4);
    add_quad(5, 0, .407, .1, .7, .4);
    add_quad(0, 5, .1, .413, .4, .8); // a little further above
    const struct padding p = measure(64);
    assert_true(padding_is_short(&p));
    const struct padding enough = measure(p.enough_size);
    assert_false(padding_is_short(&enough));
    const struct padding less = measure(p.enough_size * 2 / 3);
    assert_true(padding_is_short(&less));
}

static void charts_that_touch_are_kept_apart_by_no_texture(void **state)
{
    (void)state;
    char text[PADDING_TEXT];
    add_quad(0, 0, .1, .3, .45, .7);
    add_quad(5, 0, .45, .3, .8, .7);
    for (int size = 64; size <= 1024; size *= 4) {
        const struct padding p = measure(size);
        near(p.gap_px, 0, 1e-3);
        assert_true(padding_is_short(&p));
        assert_int_equal(p.enough_size, 0);
        padding_text(text, sizeof(text), &p);
        assert_null(strstr(text, "--texture"));
        assert_non_null(strstr(text, "more padding"));
    }
}

// Both sides of a cut are one place: as near as they like. Each has an atlas of its own place, scale and turn.
static void the_two_sides_of_a_cut_may_lie_together(void **state)
{
    (void)state;
    add_quad(0, 0, .1, .3, .45, .7);
    add_quad(.35, 0, .455, .3, .8, .7); // goes on where the other ends
    for (int size = 64; size <= 1024; size *= 4) {
        const struct padding p = measure(size);
        assert_false(padding_is_short(&p));
        near(p.share, 0, 1e-9);
    }
    // .. but not where they are shifted along it: half way up one meets the other's foot
    forget(state);
    add_quad(0, 0, .1, .3, .45, .7);
    add_quad(.35, .2, .455, .3, .8, .7);
    const struct padding p = measure(128);
    assert_true(padding_is_short(&p));
}

static void one_chart_of_many_triangles_has_borders_only_outside(void **state)
{
    (void)state;
    for (int i = 0; i < 8; i++)
        for (int k = 0; k < 8; k++) // each quad has vertices of its own: equal places and UVs make one chart
            add_quad(.1 * i, .1 * k, .1 + .1 * i, .1 + .1 * k, .1 + .1 * (i + 1), .1 + .1 * (k + 1));
    for (int k = 0; k < 4 * quads.n; k++) { // the same float wherever it comes from
        quads.uv[k][0] = roundf(quads.uv[k][0] * 1024) / 1024, quads.uv[k][1] = roundf(quads.uv[k][1] * 1024) / 1024;
        quads.place[k][0] = quads.uv[k][0], quads.place[k][2] = quads.uv[k][1];
    }
    for (int size = 8; size <= 512; size *= 8) {
        const struct padding p = measure(size);
        near(p.share, 0, 0);
    }
}

// A band whose ends meet in the atlas alone, as of a tube that was flattened too tightly: one chart, bent like a C.
static void a_chart_may_be_too_near_to_itself(void **state)
{
    (void)state;
    add_quad(0, 0, .1, .1, .3, .3);     // foot
    add_quad(0, .2, .1, .3, .3, .32);   // goes up
    add_quad(0, .22, .1, .32, .3, .52); // and lies above the foot's right neighbour, .02 away
    add_quad(.2, 0, .3, .1, .6, .3);
    add_quad(.2, .22, .3, .32, .6, .52);
    for (int k = 0; k < 4 * quads.n; k++)
        if (quads.uv[k][0] > .31f) // the two arms bend away from each other
            quads.place[k][1] = quads.uv[k][1] > .31f ? .5f : -.5f;
    const struct padding p = measure(64);
    assert_true(padding_is_short(&p));
    near(p.gap_px, .02 * 64, .1);
    const struct padding fine = measure(128);
    assert_false(padding_is_short(&fine));
}

// Halves of a symmetric object share one place in the atlas: another matter, and another warning.
static void charts_on_each_other_are_not_too_near(void **state)
{
    (void)state;
    add_quad(0, 0, .1, .3, .45, .7);
    add_quad(5, 0, .1, .3, .45, .7);
    const struct padding p = measure(128);
    assert_false(padding_is_short(&p));
}

static void atlases_of_nonsense_do_no_harm(void **state)
{
    (void)state;
    add_quad(0, 0, .1, .3, .45, .7);
    add_quad(5, 0, -15, -15, 15, 15);
    add_quad(5, 0, -1e30, .2, 1e30, .2);
    add_quad(5, 0, .2, -1e18, .21, 1e18);
    add_quad(5, 0, .5, .5, .5, .5);
    add_quad(1e20, 0, .6, .5, .7, .6);
    for (int size = 1; size <= 64; size *= 8)
        measure(size);
    forget(state);
    add_quad(0, 0, 0, 0, 1, 1);
    const struct padding p = measure(16); // to the rim of the atlas
    near(p.share, 0, 0);
}

// Thousands of splinters in one texel: the answer is found by looking at some of them.
static void splinters_are_not_all_looked_at(void **state)
{
    (void)state;
    enum { N = 60000 };
    struct mesh mesh;
    float(*place)[3] = calloc(3 * N, sizeof(*place)), (*uv)[2] = calloc(3 * N, sizeof(*uv));
    uint32_t(*triangle)[3] = calloc(N, sizeof(*triangle));
    for (int i = 0; i < 3 * N; i++) {
        place[i][0] = (float)(i / 3), place[i][1] = i % 3 == 1, place[i][2] = i % 3 == 2;
        uv[i][0] = .4995f + 1e-3f * (float)(i % 3 == 1) + 1e-6f * (float)(i / 3 % 100), uv[i][1] = .4995f + 1e-3f * (float)(i % 3 == 2) + 1e-6f * (float)(i / 300);
        triangle[i / 3][i % 3] = (uint32_t)i;
    }
    assert_int_equal(mesh_from_arrays(&mesh, 3 * N, place, NULL, uv, N, triangle), 0);
    measure_mesh(&mesh, 63);
    mesh_free(&mesh);
}

// The shapes' charts are 1/48 apart.
static void shapes_are_told_from_96_texels(void **state)
{
    (void)state;
    for (int shape = 0; shape < SHAPE_N; shape++) {
        struct mesh mesh;
        char text[PADDING_TEXT];
        assert_int_equal(shape_make(&mesh, (enum shape)shape, (const double[3]){ 0, 0, 0 }, .3, 5000), 0);
        const struct padding few = measure_mesh(&mesh, 48), enough = measure_mesh(&mesh, 97);
        assert_true(padding_is_short(&few));
        near(few.gap_px, 1, .05);
        near(few.enough_size, 96, 4);
        padding_text(text, sizeof(text), &few);
        assert_non_null(strstr(text, "1.0 texels apart"));
        assert_non_null(strstr(text, "48 x 48"));
        assert_true(strlen(text) < PADDING_TEXT - 64);
        assert_false(padding_is_short(&enough));
        near(enough.share, 0, 0);
        mesh_free(&mesh);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup(the_gap_is_measured_in_texels_of_the_texture, forget),
        cmocka_unit_test_setup(what_a_larger_texture_needs_is_enough_and_no_more, forget),
        cmocka_unit_test_setup(charts_that_touch_are_kept_apart_by_no_texture, forget),
        cmocka_unit_test_setup(the_two_sides_of_a_cut_may_lie_together, forget),
        cmocka_unit_test_setup(one_chart_of_many_triangles_has_borders_only_outside, forget),
        cmocka_unit_test_setup(a_chart_may_be_too_near_to_itself, forget),
        cmocka_unit_test_setup(charts_on_each_other_are_not_too_near, forget),
        cmocka_unit_test_setup(atlases_of_nonsense_do_no_harm, forget),
        cmocka_unit_test_setup(splinters_are_not_all_looked_at, forget),
        cmocka_unit_test_setup(shapes_are_told_from_96_texels, forget),
    };
    return cmocka_run_group_tests_name("padding", tests, NULL, NULL);
}
