// tests/test_vec3.c - small linear algebra that everything else stands on.
#include "solver/vec3.h"
#include "solver/random.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

static void random_vector(double out[3], uint64_t stream, uint64_t i, double scale)
{
    for (uint64_t c = 0; c < 3; c++)
        out[c] = scale * random_normal(1, stream, 3 * i + c);
}

static void assert_close(const double *a, const double *b, int n, double bound)
{
    for (int i = 0; i < n; i++)
        assert_true(fabs(a[i] - b[i]) <= bound);
}

static void cross_product_is_right_handed_and_may_overwrite_its_input(void **state)
{
    (void)state;
    double x[3] = { 1, 0, 0 };
    const double y[3] = { 0, 1, 0 }, z[3] = { 0, 0, 1 };
    vec3_cross(x, x, y);
    assert_close(x, z, 3, 0);
}

static void normalise_tells_the_length_and_leaves_zero_alone(void **state)
{
    (void)state;
    double v[3] = { 2, 3, 6 }, zero[3] = { 0, 0, 0 };
    assert_true(vec3_normalise(v) == 7);
    assert_true(fabs(vec3_norm(v) - 1) < 1e-15);
    assert_true(vec3_normalise(zero) == 0);
    assert_true(zero[0] == 0 && zero[1] == 0 && zero[2] == 0);
}

static void rotation_vectors_give_rotations_that_match_the_series(void **state)
{
    (void)state;
    const double identity[9] = { 1, 0, 0, 0, 1, 0, 0, 0, 1 };
    for (uint64_t i = 0; i < 200; i++) {
        double w[3], R[9], T[9], product[9], series[9], power[9], K[9], v[3], a[3], b[3];
        random_vector(w, 2, i, i % 2 ? 1 : pow(10, -(double)(i % 14))); // around the switch to the series, too
        mat3_from_rotation_vector(R, w);
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++)
                T[3 * r + c] = R[3 * c + r];
        mat3_mul(product, R, T);
        assert_close(product, identity, 9, 1e-14);
        assert_true(fabs(mat3_det(R) - 1) < 1e-14);
        // exp([w]x) term by term
        const double cross[9] = { 0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0 };
        memcpy(K, cross, sizeof(K));
        memcpy(series, identity, sizeof(series));
        memcpy(power, identity, sizeof(power));
        for (int k = 1; k < 60; k++) {
            mat3_mul(power, power, K); // in place on purpose
            for (int j = 0; j < 9; j++)
                power[j] /= k, series[j] += power[j];
        }
        assert_close(R, series, 9, 1e-12);
        random_vector(v, 3, i, 1);
        mat3_mul_vec(a, R, v);
        mat3_tmul_vec(b, T, v);
        assert_close(a, b, 3, 1e-15);
        mat3_tmul_vec(a, R, a); // back again, in place
        assert_close(a, v, 3, 1e-14);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(cross_product_is_right_handed_and_may_overwrite_its_input),
        cmocka_unit_test(normalise_tells_the_length_and_leaves_zero_alone),
        cmocka_unit_test(rotation_vectors_give_rotations_that_match_the_series),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
