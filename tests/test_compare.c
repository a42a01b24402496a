// tests/test_compare.c - RMSE, PSNR and pooling against values worked out by hand.
#include "solver/compare.h"
#include "solver/random.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <cmocka.h>

static char last_error[512];

static void remember(void *arg, enum log_level level, const char *message)
{
    (void)arg, (void)level;
    snprintf(last_error, sizeof(last_error), "%s", message);
}

static struct image filled(int width, int height, int n_channels, const char *const *names,
                           float value)
{
    struct image image;
    assert_int_equal(image_new(&image, width, height, n_channels, names), 0);
    for (int i = 0; i < width * height * n_channels; i++)
        image.data[i] = value;
    return image;
}

static void known_differences_give_known_figures(void **state)
{
    (void)state;
    struct image a = filled(5, 4, 3, NULL, .5f), b = filled(5, 4, 3, NULL, .25f);
    struct comparison c;
    assert_int_equal(compare_images(&c, &a, &b, NULL), 0);
    assert_int_equal(c.n_pixels, 20);
    assert_float_equal(c.rmse_percent, 25, 1e-12); // every channel off by .25
    assert_float_equal(c.rmse_unclipped, .25, 1e-14);
    assert_float_equal(c.psnr_db, 12.041199826559248, 1e-12); // 20 log10 4
    assert_true(c.max_abs == .25 && c.clipped_percent == 0);

    memcpy(a.data, b.data, 60 * sizeof(float));
    a.data[7] = 1.25f; // one channel of one pixel, off by 1, clipped to .75
    assert_int_equal(compare_images(&c, &a, &b, NULL), 0);
    assert_float_equal(c.rmse_percent, 100 * sqrt(.75 * .75 / 60), 1e-12);
    assert_float_equal(c.rmse_unclipped, sqrt(1. / 60), 1e-14);
    assert_true(c.max_abs == 1);
    assert_float_equal(c.clipped_percent, 5, 1e-12);

    a.data[7] = -.5f; // below 0 is clipped too
    assert_int_equal(compare_images(&c, &a, &b, NULL), 0);
    assert_float_equal(c.rmse_percent, 100 * sqrt(.25 * .25 / 60), 1e-12);
    assert_float_equal(c.clipped_percent, 0, 0);
    image_free(&a);
    image_free(&b);
}

static void equal_pictures_differ_by_nothing(void **state)
{
    (void)state;
    struct image a = filled(3, 3, 3, NULL, 7);
    struct comparison c;
    assert_int_equal(compare_images(&c, &a, &a, NULL), 0);
    assert_true(c.rmse_percent == 0 && c.rmse_unclipped == 0 && c.max_abs == 0);
    assert_true(isinf(c.psnr_db) && c.psnr_db > 0);
    assert_float_equal(c.clipped_percent, 100, 0);
    image_free(&a);
}

static void channels_are_found_by_name(void **state)
{
    (void)state;
    static const char *const shuffled[] = {"B", "A", "R", "G"};
    struct image a = filled(2, 2, 4, shuffled, 0), b = filled(2, 2, 3, NULL, 0);
    struct comparison c;
    for (int i = 0; i < 4; i++) {
        a.data[4 * i] = .3f, a.data[4 * i + 1] = .9f, a.data[4 * i + 2] = .1f,
                   a.data[4 * i + 3] = .2f;
        b.data[3 * i] = .1f, b.data[3 * i + 1] = .2f, b.data[3 * i + 2] = .3f;
    }
    assert_int_equal(compare_images(&c, &a, &b, NULL), 0);
    assert_true(c.rmse_percent == 0 && c.max_abs == 0);
    image_free(&a);
    image_free(&b);
}

static void a_mask_leaves_out_what_it_hides_even_nan(void **state)
{
    (void)state;
    static const char *const grey[] = {"Y"};
    struct image a = filled(4, 1, 3, NULL, .5f), b = filled(4, 1, 3, NULL, .5f);
    struct image mask = filled(4, 1, 1, grey, 1);
    struct comparison c;
    mask.data[2] = .5f; // not above .5: hidden
    a.data[3 * 2 + 1] = NAN;
    b.data[3 * 3] = 1;
    assert_int_equal(compare_images(&c, &a, &b, &mask), 0);
    assert_int_equal(c.n_pixels, 3);
    assert_float_equal(c.rmse_percent, 100 * sqrt(.25 / 9), 1e-12);

    log_set_hook(remember, NULL);
    assert_int_equal(compare_images(&c, &a, &b, NULL),
                     -EDOM); // in the open it is an error, with its place
    assert_non_null(strstr(last_error, "column 2, row 0"));
    assert_true(c.n_pixels == 0);
    memset(mask.data, 0, 4 * sizeof(float));
    assert_int_equal(compare_images(&c, &a, &b, &mask), -EDOM);
    assert_non_null(strstr(last_error, "mask"));
    log_set_hook(NULL, NULL);
    image_free(&a);
    image_free(&b);
    image_free(&mask);
}

static void what_cannot_be_compared_is_refused(void **state)
{
    (void)state;
    static const char *const grey[] = {"Y"}, *const no_green[] = {"R", "B", "A"};
    struct image a = filled(4, 2, 3, NULL, 0), b = filled(2, 4, 3, NULL, 0);
    struct image y = filled(4, 2, 1, grey, 0), g = filled(4, 2, 3, no_green, 0);
    struct comparison c;
    log_set_hook(remember, NULL);
    assert_int_equal(compare_images(&c, &a, &b, NULL), -EINVAL);
    assert_true(strstr(last_error, "2x4") && strstr(last_error, "4x2"));
    assert_int_equal(compare_images(&c, &a, &a, &b), -EINVAL);
    assert_non_null(strstr(last_error, "mask"));
    assert_int_equal(compare_images(&c, &a, &y, NULL), -EINVAL);
    assert_int_equal(compare_images(&c, &g, &a, NULL), -EINVAL);
    assert_non_null(strstr(last_error, "channel G"));
    log_set_hook(NULL, NULL);
    image_free(&a);
    image_free(&b);
    image_free(&y);
    image_free(&g);
}

// Cut a picture in two unequal pieces: pooled, they are the whole.
static void pooling_two_pieces_gives_the_whole(void **state)
{
    (void)state;
    enum { W = 10, H = 7, CUT = 2 };
    struct image a = filled(W, H, 3, NULL, 0), b = filled(W, H, 3, NULL, 0);
    for (int i = 0; i < 3 * W * H; i++) {
        a.data[i] = (float)(1.5 * random_uniform(1, 1, (uint64_t)i) - .1);
        b.data[i] = (float)(1.5 * random_uniform(1, 2, (uint64_t)i) - .1);
    }
    struct comparison whole, part, total = {0};
    assert_int_equal(compare_images(&whole, &a, &b, NULL), 0);
    struct image upper_a = a, upper_b = b, lower_a = a, lower_b = b; // views into the same pixels
    upper_a.height = upper_b.height = CUT;
    lower_a.height = lower_b.height = H - CUT;
    lower_a.data += 3 * W * CUT, lower_b.data += 3 * W * CUT;
    assert_int_equal(compare_images(&part, &upper_a, &upper_b, NULL), 0);
    compare_add(&total, &part);
    assert_int_equal(compare_images(&part, &lower_a, &lower_b, NULL), 0);
    compare_add(&total, &part);
    assert_int_equal(total.n_pixels, whole.n_pixels);
    assert_float_equal(total.rmse_percent, whole.rmse_percent, 1e-12);
    assert_float_equal(total.rmse_unclipped, whole.rmse_unclipped, 1e-14);
    assert_float_equal(total.psnr_db, whole.psnr_db, 1e-12);
    assert_float_equal(total.clipped_percent, whole.clipped_percent, 1e-12);
    assert_true(total.max_abs == whole.max_abs && whole.clipped_percent > 10);
    const struct comparison none = {0};
    const struct comparison before = total;
    compare_add(&total, &none);
    assert_memory_equal(&total, &before, sizeof(total));
    image_free(&a);
    image_free(&b);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(known_differences_give_known_figures),
        cmocka_unit_test(equal_pictures_differ_by_nothing),
        cmocka_unit_test(channels_are_found_by_name),
        cmocka_unit_test(a_mask_leaves_out_what_it_hides_even_nan),
        cmocka_unit_test(what_cannot_be_compared_is_refused),
        cmocka_unit_test(pooling_two_pieces_gives_the_whole),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
