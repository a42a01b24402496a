// tests/test_emitters.c - planes through lights: found in a room with errors and strays, and held by the right quadratic form.
#include "solver/emitters.h"
#include "solver/random.h"
#include "solver/vec3.h"

#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { N = 240 };

static double uniform(uint64_t stream, uint64_t index)
{
    return random_uniform(7, stream, index);
}

// Lights on the six walls of a room of 3.6 x 2.4 x 1.2 m, seen from off its middle; wall: 0..5.
static void room(double dir[N][3], double q[N], int wall[N])
{
    static const double half_m[3] = { 1.8, 1.2, .6 }, from_m[3] = { .2, -.1, .15 };
    for (int i = 0; i < N; i++) {
        const double z = 1 - 2 * (i + .5) / N, a = i * M_PI * (3 - sqrt(5.)), s = sqrt(1 - z * z);
        dir[i][0] = s * cos(a), dir[i][1] = s * sin(a), dir[i][2] = z;
        q[i] = 0;
        for (int axis = 0; axis < 3; axis++) { // the nearest wall is the one with the largest 1 / r
            const double to_m = copysign(half_m[axis], dir[i][axis]) - from_m[axis], here = dir[i][axis] / to_m;
            if (here > q[i])
                q[i] = here, wall[i] = 2 * axis + (dir[i][axis] > 0);
        }
    }
}

static void walls_are_found_among_errors_and_strays(void **state)
{
    (void)state;
    double dir[N][3], truth[N], q[N];
    int wall[N], on[6] = { 0 }, right = 0, strays = 0, strays_out = 0;
    struct emitters e;
    room(dir, truth, wall);
    for (int i = 0; i < N; i++) {
        const bool stray = uniform(1, (uint64_t)i) < .06;
        q[i] = truth[i] * (stray ? 1.5 + uniform(2, (uint64_t)i) : 1 + .03 * (2 * uniform(3, (uint64_t)i) - 1));
        if (stray)
            wall[i] = -1, strays++;
    }
    assert_true(strays > 5);
    assert_int_equal(emitters_find(&e, N, (const double(*)[3])dir, q, .06), 0);
    assert_true(e.n >= 6);
    // A plane is the wall that most of its lights are on; all six walls are found, and tell distances better than the lights themselves do.
    for (int k = 0; k < e.n; k++) {
        int count[6] = { 0 }, most = 0;
        for (int i = 0; i < N; i++)
            if (e.of[i] == k && wall[i] >= 0)
                count[wall[i]]++;
        for (int w = 1; w < 6; w++)
            most = count[w] > count[most] ? w : most;
        on[most]++;
        for (int i = 0; i < N && count[most] > 15; i++)
            if (wall[i] == most) {
                assert_true(fabs(vec3_dot(dir[i], e.plane[k]) / truth[i] - 1) < .03);
                right += e.of[i] == k;
            }
    }
    for (int w = 0; w < 6; w++)
        assert_true(on[w]);
    for (int i = 0; i < N; i++)
        strays_out += wall[i] < 0 && e.of[i] < 0;
    assert_true(right > .9 * (N - strays));
    assert_true(strays_out > strays / 2);
    emitters_free(&e);
    assert_null(e.of);
}

static void a_light_without_a_distance_is_on_no_plane(void **state)
{
    (void)state;
    double dir[N][3], q[N];
    int wall[N];
    struct emitters e;
    room(dir, q, wall);
    for (int i = 0; i < N; i += 3)
        q[i] = 0;
    assert_int_equal(emitters_find(&e, N, (const double(*)[3])dir, q, .01), 0);
    for (int i = 0; i < N; i += 3)
        assert_int_equal(e.of[i], -1);
    emitters_free(&e);
    memset(q, 0, sizeof(q));
    assert_int_equal(emitters_find(&e, N, (const double(*)[3])dir, q, .01), 0);
    assert_int_equal(e.n, 0);
    emitters_free(&e);
}

static void a_plane_through_lights_in_one_plane_of_directions_is_refused(void **state)
{
    (void)state;
    double dir[8][3], q[8], m[3];
    int32_t of[8] = { 0 };
    for (int i = 0; i < 8; i++) {
        dir[i][0] = cos(.3 * i), dir[i][1] = sin(.3 * i), dir[i][2] = 0;
        q[i] = 1;
    }
    assert_int_equal(emitters_fit(m, 0, 8, of, (const double(*)[3])dir, q), -EDOM);
    dir[7][2] = .6, dir[7][0] = .8, dir[7][1] = 0;
    assert_int_equal(emitters_fit(m, 0, 8, of, (const double(*)[3])dir, q), 0);
}

// Two planes and strays: cost 0 on the planes, and derivatives that are those of the cost.
static void the_cost_is_that_of_leaving_the_planes(void **state)
{
    (void)state;
    enum { FIRST = 2, M = 40, SIZE = FIRST + M + 1 };
    double dir[N][3], truth[N], q[M], scale[M], A[SIZE * SIZE] = { 0 }, g[SIZE] = { 0 };
    int wall[N];
    int32_t of[M];
    room(dir, truth, wall);
    for (int i = 0; i < M; i++) {
        memcpy(dir[i], dir[5 * i], sizeof(dir[i]));
        q[i] = truth[5 * i], scale[i] = .8 * q[i];
        of[i] = wall[5 * i] == 5 ? 0 : wall[5 * i] == 1 ? 1 : -1;
    }
    const struct emitters e = { 2, NULL, of };
    assert_true(fabs(emitters_add_cost(&e, M, (const double(*)[3])dir, q, scale, 3, SIZE, FIRST, A, g)) < 1e-20);
    for (int i = 0; i < M; i++)
        q[i] *= 1 + .2 * (uniform(4, (uint64_t)i) - .5);
    memset(A, 0, sizeof(A));
    memset(g, 0, sizeof(g));
    const double cost = emitters_add_cost(&e, M, (const double(*)[3])dir, q, scale, 3, SIZE, FIRST, A, g);
    assert_true(cost > 1e-3);
    assert_true(fabs(emitters_add_cost(&e, M, (const double(*)[3])dir, q, scale, 3, SIZE, FIRST, NULL, NULL) - cost) < 1e-15);
    for (int i = 0; i < M; i++) {
        double there[2], step[SIZE] = { 0 };
        for (int k = 0; k < 2; k++) {
            const double h = k ? 1e-4 : -1e-4, kept = q[i];
            q[i] += h;
            double Ah[SIZE * SIZE] = { 0 }, gh[SIZE] = { 0 };
            there[k] = emitters_add_cost(&e, M, (const double(*)[3])dir, q, scale, 3, SIZE, FIRST, Ah, gh);
            for (int j = 0; j < SIZE; j++)
                step[j] += (k ? 1 : -1) * gh[j] / 2e-4;
            q[i] = kept;
        }
        assert_true(fabs((there[1] - there[0]) / 2e-4 - g[FIRST + i]) < 1e-7);
        for (int j = 0; j < M; j++) {
            const int a = FIRST + (i > j ? i : j), b = FIRST + (i > j ? j : i);
            assert_true(fabs(step[FIRST + j] - A[a * SIZE + b]) < 1e-6);
        }
        if (of[i] < 0)
            assert_true(g[FIRST + i] == 0);
    }
    for (int i = 0; i < SIZE; i++) // nothing outside its own rows, nothing above the diagonal
        for (int j = 0; j < SIZE; j++)
            if (i < FIRST || j < FIRST || i == SIZE - 1 || j == SIZE - 1 || j > i)
                assert_true(A[i * SIZE + j] == 0);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(walls_are_found_among_errors_and_strays),
        cmocka_unit_test(a_light_without_a_distance_is_on_no_plane),
        cmocka_unit_test(a_plane_through_lights_in_one_plane_of_directions_is_refused),
        cmocka_unit_test(the_cost_is_that_of_leaving_the_planes),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
