// tests/test_normal_equations.c - J^T J and J^T r of rows that come one by one, against plain double loops.
#include "solver/normal_equations.h"
#include "solver/parallel.h"
#include "solver/random.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

// Entry i of row k; entry n is the residual. Columns differ in size by 1e4.
static float entry(int k, int i)
{
    return (float)((2 * random_uniform(5, (uint64_t)k, (uint64_t)i) - 1) * pow(10, i % 5 - 2));
}

static void fill(struct normal_rows *a, int n, int n_rows)
{
    for (int k = 0; k < n_rows; k++) {
        float *row = normal_rows_next(a, entry(k, n));
        for (int i = 0; i < n; i++)
            row[i] = entry(k, i);
    }
}

static double *numbers(size_t n, double value)
{
    double *x = malloc((n + 1) * sizeof(double));
    assert_non_null(x);
    for (size_t i = 0; i < n; i++)
        x[i] = value;
    return x;
}

// Products are float, blocks of 384 of them; the sum of the blocks is double: off by less than 384 roundings of the block's size.
static void check(int n, int n_rows)
{
    const size_t n2 = (size_t)n * (size_t)n;
    struct normal_rows a;
    assert_int_equal(normal_rows_new(&a, n), 0);
    a.A = numbers(n2, 7), a.g = numbers((size_t)n, -3);
    double *size = numbers((size_t)n + 1, 0);
    fill(&a, n, n_rows);
    normal_rows_flush(&a);
    normal_rows_flush(&a); // nothing waits any more: nothing is added
    for (int k = 0; k < n_rows; k++)
        for (int i = 0; i <= n; i++)
            size[i] += pow((double)entry(k, i), 2);
    for (int i = 0; i < n; i++) {
        double g = 0;
        for (int k = 0; k < n_rows; k++)
            g += (double)entry(k, i) * (double)entry(k, n);
        assert_true(fabs(a.g[i] - (g - 3)) <= 1e-13 * (3 + sqrt(size[i] * size[n]) * sqrt(n_rows)));
        for (int j = 0; j < n; j++) {
            double A = 0;
            for (int k = 0; k < n_rows && j <= i; k++)
                A += (double)entry(k, i) * (double)entry(k, j);
            if (j > i)
                assert_true(a.A[(size_t)i * (size_t)n + (size_t)j] == 7); // the upper triangle is not touched
            else
                assert_true(fabs(a.A[(size_t)i * (size_t)n + (size_t)j] - (A + 7)) <=
                            1e-13 + 2e-6 * sqrt(size[i] * size[j]));
        }
    }
    free(a.A);
    free(a.g);
    free(size);
    normal_rows_free(&a);
}

static void sums_are_those_of_plain_loops(void **state)
{
    (void)state;
    static const int sizes[] = { 1, 2, 15, 16, 17, 33, 61 };
    static const int rows[] = { 0, 1, 7, NORMAL_BLOCK - 1, NORMAL_BLOCK, NORMAL_BLOCK + 1, 3 * NORMAL_BLOCK + 5 };
    for (size_t i = 0; i < sizeof(sizes) / sizeof(sizes[0]); i++)
        for (size_t k = 0; k < sizeof(rows) / sizeof(rows[0]); k++)
            check(sizes[i], rows[k]);
}

static void no_unknowns_are_no_sums(void **state)
{
    (void)state;
    struct normal_rows a;
    assert_int_equal(normal_rows_new(&a, 0), 0);
    double untouched = 5;
    a.A = a.g = &untouched;
    for (int k = 0; k < 2 * NORMAL_BLOCK; k++)
        normal_rows_next(&a, 1);
    normal_rows_flush(&a);
    assert_true(untouched == 5);
    normal_rows_free(&a);
}

// A long sum of equal squares: float alone would stall at 2^24, or miss each block's digits.
static void long_sums_keep_their_digits(void **state)
{
    (void)state;
    enum { N_ROWS = 1 << 20 };
    struct normal_rows a;
    double A = 0, g = 0, expected = 0;
    assert_int_equal(normal_rows_new(&a, 1), 0);
    a.A = &A, a.g = &g;
    for (int k = 0; k < N_ROWS; k++) {
        const float x = entry(k, 2);
        *normal_rows_next(&a, x) = x;
        expected += (double)x * (double)x;
    }
    normal_rows_flush(&a);
    assert_true(fabs(A - expected) < 1e-7 * expected && fabs(g - expected) < 1e-12 * expected);
    normal_rows_free(&a);
}

enum { N_WIDE = 301, N_JOBS = 6 };

struct jobs {
    double *A, *g;
};

static void do_jobs(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    struct jobs *j = arg;
    for (int64_t job = begin; job < end; job++) {
        struct normal_rows a;
        if (normal_rows_new(&a, N_WIDE))
            continue; // the sums stay 0
        a.A = j->A + job * N_WIDE * N_WIDE, a.g = j->g + job * N_WIDE;
        fill(&a, N_WIDE, NORMAL_BLOCK + 100);
        normal_rows_flush(&a);
        normal_rows_free(&a);
    }
}

// One accumulator per thread, as many at once as there are: BLAS's own threads must not show.
static void threads_at_once_give_the_same_bytes(void **state)
{
    (void)state;
    struct jobs one = { numbers((size_t)N_WIDE * N_WIDE, 0), numbers(N_WIDE, 0) };
    struct jobs many = { numbers((size_t)N_JOBS * N_WIDE * N_WIDE, 0), numbers((size_t)N_JOBS * N_WIDE, 0) };
    parallel_for(1, 1, 1, do_jobs, &one);
    parallel_for(4, N_JOBS, 1, do_jobs, &many);
    assert_true(one.A[0] > 0);
    for (int job = 0; job < N_JOBS; job++) {
        assert_memory_equal(one.A, many.A + (size_t)job * N_WIDE * N_WIDE, (size_t)N_WIDE * N_WIDE * sizeof(double));
        assert_memory_equal(one.g, many.g + (size_t)job * N_WIDE, N_WIDE * sizeof(double));
    }
    free(one.A);
    free(one.g);
    free(many.A);
    free(many.g);
}

int openblas_get_num_threads(void) __attribute__((weak));

// With more, bytes would depend on the number of cores: LAPACK's factorisations do.
static void blas_takes_one_thread(void **state)
{
    (void)state;
    struct normal_rows a;
    assert_int_equal(normal_rows_new(&a, 1), 0); // the module is linked in
    normal_rows_free(&a);
    if (openblas_get_num_threads)
        assert_int_equal(openblas_get_num_threads(), 1);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(sums_are_those_of_plain_loops),
        cmocka_unit_test(no_unknowns_are_no_sums),
        cmocka_unit_test(long_sums_keep_their_digits),
        cmocka_unit_test(threads_at_once_give_the_same_bytes),
        cmocka_unit_test(blas_takes_one_thread),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
