// tests/test_contact.c - the camera that is out of focus, clipped or dark is the one that is named.
#include "rigd/contact.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

#include "tests/scratch.h"

enum { W = 240, H = 160, N = 8 };

static uint32_t dice = 1;

static double uniform(void)
{
    dice = dice * 1664525u + 1013904223u;
    return (double)(dice >> 8) / (1 << 24);
}

// Tiles of random brightness that cover a part of the picture, seen by a lens that blurs with sigma_px, with the noise of few photons.
static void see(struct image *m, int tile_px, double covered, double sigma_px, double noise, double gain)
{
    double *sharp = calloc(W * H, sizeof(double)), *rows = calloc(W * H, sizeof(double)), tile[W * H];
    const int reach = (int)(4 * sigma_px) + 1;
    assert_int_equal(image_new(m, W, H, 3, NULL), 0);
    for (int i = 0; i < W * H; i++)
        tile[i] = .05 + .5 * uniform();
    for (int y = 0; y < H; y++)
        for (int x = 0; x < W; x++)
            sharp[y * W + x] = x < covered * W ? tile[(y / tile_px) * W + x / tile_px] : .1;
    for (int pass = 0; pass < 2; pass++)
        for (int y = 0; y < H; y++)
            for (int x = 0; x < W; x++) {
                double sum = 0, weight = 0;
                for (int k = -reach; k <= reach; k++) {
                    const int u = pass ? x : x + k, v = pass ? y + k : y;
                    const double g = exp(-.5 * k * k / (sigma_px * sigma_px));
                    if (u < 0 || v < 0 || u >= W || v >= H)
                        continue;
                    sum += g * (pass ? rows : sharp)[v * W + u], weight += g;
                }
                if (!pass)
                    rows[y * W + x] = sum / weight;
                else
                    for (int c = 0; c < 3; c++)
                        m->data[(y * W + x) * 3 + c] = (float)(gain * (sum / weight + noise * sqrt(sum / weight) * (uniform() + uniform() + uniform() - 1.5)));
            }
    free(sharp);
    free(rows);
}

static void sharpness_is_of_the_lens_not_of_the_scene(void **state)
{
    (void)state;
    static const struct {
        int tile_px;
        double covered, noise, gain;
    } scenes[] = { { 9, 1, 0, 1 }, { 14, 1, 0, 1 }, { 23, 1, .01, 1 }, { 14, .4, .01, 1 }, { 14, 1, .005, .2 }, { 11, .6, .005, 2 } };
    double least = 1e9, most = 0;
    for (size_t i = 0; i < sizeof(scenes) / sizeof(scenes[0]); i++)
        for (int soft = 0; soft < 2; soft++) {
            struct image m;
            struct contact_figures f;
            see(&m, scenes[i].tile_px, scenes[i].covered, soft ? 2.2 : .6, scenes[i].noise, scenes[i].gain);
            assert_int_equal(contact_measure(&f, &m, false), 0);
            if (soft)
                most = fmax(most, f.sharpness);
            else
                least = fmin(least, f.sharpness);
            image_free(&m);
        }
    assert_true(most < .5 * least); // whatever the scene: the soft ones are named beside the sharp ones
}

static void the_soft_the_clipped_and_the_dark_are_named(void **state)
{
    (void)state;
    struct contact_entry e[N];
    struct image m;
    char said[300];
    memset(e, 0, sizeof(e));
    for (int i = 0; i < N; i++) {
        see(&m, 10 + i, .5 + .05 * i, i == 2 ? 2.5 : .7, .004, i == 5 ? .2 : 1);
        for (int p = 0; p < W * H; p++) {
            const bool is_top = p < W * H / 4, is_middle = p / W >= H / 3 && p / W < 2 * H / 3 && p % W > W / 2 && p % W < W / 2 + W / 15;
            if ((i == 3 && is_top) || (i == 6 && is_middle))
                m.data[3 * p] = 1.2f; // A04: a lamp behind the subject; A07: the subject
        }
        snprintf(e[i].name, sizeof(e[i].name), "A%02d", i + 1);
        assert_int_equal(contact_measure(&e[i].figures, &m, true), 0);
        assert_int_equal(contact_cell(&e[i], &m), 0);
        image_free(&m);
    }
    contact_judge(e, N, true);
    for (int i = 0; i < N; i++)
        assert_int_equal(e[i].doubts, i == 2 ? CONTACT_SOFT : i == 5 ? CONTACT_DARK : i == 6 ? CONTACT_CLIPPED : 0);
    assert_true(fabs(e[5].relative_ev - log2(.2)) < .6);
    assert_true(fabs(e[3].figures.clipped_share - .25) < .01 && e[3].figures.middle_clipped_share == 0);
    assert_true(fabs(e[6].figures.middle_clipped_share - .2) < .02);
    contact_sentence(e, N, said, sizeof(said));
    assert_int_equal(strncmp(said, "3 of 8 cameras to look at: A03 soft", 35), 0);
    assert_non_null(strstr(said, "A06 dark") && strstr(said, "A07 clipped (") ? said : NULL);
    contact_sentence(e, N, said, 40); // no room: cut between cameras
    assert_true(strlen(said) < 40);
    assert_int_equal(contact_write(e, N, 0, scratch_path("sheet.png")), 0);
    struct image sheet;
    assert_int_equal(image_read(&sheet, scratch_path("sheet.png")), 0);
    assert_true(sheet.width >= CONTACT_CELL_PX && sheet.height >= CONTACT_CELL_HEIGHT_PX);
    image_free(&sheet);
    unlink(scratch_path("sheet.png"));
    for (int i = 0; i < N; i++)
        free(e[i].cell);
}

// Whoever exposes so many stops longer has all but glints below white, in four of five cameras.
static void headroom_is_what_the_subject_has_to_white(void **state)
{
    (void)state;
    struct contact_entry e[5];
    struct image m;
    memset(e, 0, sizeof(e));
    for (int i = 0; i < 5; i++) {
        assert_int_equal(image_new(&m, W, H, 3, NULL), 0);
        for (int p = 0; p < W * H; p++) {
            const bool is_lamp = p / W < H / 4, is_glint = p / W == H / 2 && p % W < W / 2; // of the middle less than 2 %
            for (int c = 0; c < 3; c++)
                m.data[3 * p + c] = is_lamp || is_glint ? 1 : c == 2 ? .25f : .05f;
        }
        for (int p = 0; i == 4 && p < W * H; p++)
            m.data[3 * p] = 1; // one camera sees nothing but a lamp
        assert_int_equal(contact_measure(&e[i].figures, &m, true), 0);
        image_free(&m);
    }
    assert_true(fabs(e[0].figures.headroom_ev - 2) < .05); // of the channel that is first at white
    assert_true(e[4].figures.headroom_ev == 0);
    assert_true(fabs(contact_headroom(e, 5) - 2) < .05);
    assert_true(contact_headroom(e + 2, 3) == 0); // one of three is more than one of five
    assert_int_equal(image_new(&m, W, H, 3, NULL), 0);
    assert_int_equal(contact_measure(&e[0].figures, &m, false), 0);
    assert_true(isnan(contact_headroom(e, 1))); // radiance has no white
    image_free(&m);
}

static void two_cameras_are_not_compared_and_tiny_or_flat_pictures_are_not_judged(void **state)
{
    (void)state;
    struct contact_entry e[2];
    struct image m;
    char said[100] = "x";
    memset(e, 0, sizeof(e));
    for (int i = 0; i < 2; i++) {
        see(&m, 12, 1, i ? 3 : .6, 0, i ? .1 : 1);
        assert_int_equal(contact_measure(&e[i].figures, &m, true), 0);
        image_free(&m);
    }
    contact_judge(e, 2, true);
    contact_sentence(e, 2, said, sizeof(said));
    assert_string_equal(said, "");
    static const char *const clip[] = { "R", "G", "B", "clip" };
    assert_int_equal(image_new(&m, 20, 20, 4, clip), 0);
    for (int i = 0; i < 400; i++)
        m.data[4 * i] = m.data[4 * i + 1] = m.data[4 * i + 2] = NAN, m.data[4 * i + 3] = i < 100;
    struct contact_figures f;
    assert_int_equal(contact_measure(&f, &m, false), 0);
    assert_true(isnan(f.sharpness) && f.clipped_share == .25);
    image_free(&m);
    assert_int_equal(image_new(&m, W, H, 1, NULL), 0);
    assert_int_equal(contact_measure(&f, &m, false), 0);
    assert_true(isnan(f.sharpness));
    image_free(&m);
}

static int set_up(void **state)
{
    (void)state;
    return scratch_open();
}

// Black cloth behind, and the object large in some pictures, small in others: only the one that got a fifth of the light is dark.
static void a_small_object_before_black_is_not_dark(void **state)
{
    (void)state;
    static const double covered[N] = { .9, .8, .15, .9, .85, .3, .8, .08 };
    struct contact_entry e[N];
    struct image m;
    memset(e, 0, sizeof(e));
    for (int i = 0; i < N; i++) {
        see(&m, 10, covered[i], .7, .004, i == 4 ? .2 : 1);
        for (int p = 0; p < W * H; p++)
            for (int c = 0; p % W >= covered[i] * W && c < 3; c++)
                m.data[3 * p + c] *= .005f;
        assert_int_equal(contact_measure(&e[i].figures, &m, true), 0);
        image_free(&m);
    }
    contact_judge(e, N, true);
    for (int i = 0; i < N; i++)
        assert_int_equal(e[i].doubts & CONTACT_DARK, i == 4 ? CONTACT_DARK : 0);
}

static int tear_down(void **state)
{
    (void)state;
    return scratch_close();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(sharpness_is_of_the_lens_not_of_the_scene),
        cmocka_unit_test(the_soft_the_clipped_and_the_dark_are_named),
        cmocka_unit_test(a_small_object_before_black_is_not_dark),
        cmocka_unit_test(headroom_is_what_the_subject_has_to_white),
        cmocka_unit_test(two_cameras_are_not_compared_and_tiny_or_flat_pictures_are_not_judged),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
