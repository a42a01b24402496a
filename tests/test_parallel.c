// tests/test_parallel.c - loops cover everything once, and sums do not depend on the thread count.
#include "solver/parallel.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { N = 100003 };

static void mark(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    unsigned char *seen = arg;
    for (int64_t i = begin; i < end; i++)
        seen[i]++;
}

static void visits_every_index_once(void **state)
{
    (void)state;
    static unsigned char seen[N];
    for (int threads = 0; threads <= 5; threads++) {
        memset(seen, 0, sizeof(seen));
        parallel_for(threads, N, 97, mark, seen);
        for (int i = 0; i < N; i++)
            assert_int_equal(seen[i], 1);
    }
    parallel_for(4, 0, 10, mark, NULL); // nothing to do: nothing touched
}

static void add_sines(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    (void)arg, (void)worker;
    for (int64_t i = begin; i < end; i++)
        partial[0] += sin((double)i) * 1e10, partial[1] += 1;
}

static void sums_are_the_same_bits_for_any_thread_count(void **state)
{
    (void)state;
    double one[2] = { 0 };
    assert_int_equal(parallel_sum(1, N, 64, add_sines, NULL, 2, one), 0);
    assert_true(one[1] == N);
    for (int threads = 2; threads <= 9; threads++) {
        double many[2] = { 0 };
        assert_int_equal(parallel_sum(threads, N, 64, add_sines, NULL, 2, many), 0);
        assert_memory_equal(one, many, sizeof(one));
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(visits_every_index_once),
        cmocka_unit_test(sums_are_the_same_bits_for_any_thread_count),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
