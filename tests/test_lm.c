// tests/test_lm.c - the optimiser on textbook problems: valleys, a singular minimum, bounds, units that differ by 1e6.
#include "solver/lm.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { MAX_N = 8, MAX_M = 40 };

// A problem given as residuals and their Jacobian.
struct residuals {
    int n, m;
    void (*evaluate)(const double *x, double *r, double J[MAX_M][MAX_N]);
};

static int cost(void *arg, const double *x, double *out)
{
    const struct residuals *p = arg;
    double r[MAX_M], J[MAX_M][MAX_N];
    p->evaluate(x, r, J);
    *out = 0;
    for (int i = 0; i < p->m; i++)
        *out += .5 * r[i] * r[i];
    return 0;
}

static int normal_equations(void *arg, const double *x, double *out, double *A, double *g)
{
    const struct residuals *p = arg;
    double r[MAX_M], J[MAX_M][MAX_N];
    p->evaluate(x, r, J);
    *out = 0;
    for (int k = 0; k < p->m; k++) {
        *out += .5 * r[k] * r[k];
        for (int i = 0; i < p->n; i++) {
            g[i] += J[k][i] * r[k];
            for (int j = 0; j <= i; j++)
                A[i * p->n + j] += J[k][i] * J[k][j];
        }
    }
    return 0;
}

static struct lm_result minimise(struct residuals *p, double *x, const double *lower, const double *upper)
{
    const struct lm_problem problem = { p->n, lower, upper, cost, normal_equations, p };
    struct lm_settings s = lm_defaults();
    s.max_iterations = 500;
    s.relative_cost = 1e-16;
    struct lm_result result;
    assert_int_equal(lm_minimise(&problem, &s, x, &result), 0);
    print_message("# stop %s, %d Jacobians, cost %.3g -> %.3g\n", lm_stop_name(result.stop), result.n_jacobians,
                  result.first_cost, result.cost);
    return result;
}

static void rosenbrock(const double *x, double *r, double J[MAX_M][MAX_N])
{
    r[0] = 10 * (x[1] - x[0] * x[0]), r[1] = 1 - x[0];
    J[0][0] = -20 * x[0], J[0][1] = 10, J[1][0] = -1, J[1][1] = 0;
}

static void follows_rosenbrocks_valley(void **state)
{
    (void)state;
    struct residuals p = { 2, 2, rosenbrock };
    double x[2] = { -1.2, 1 };
    minimise(&p, x, NULL, NULL);
    assert_true(fabs(x[0] - 1) < 1e-6 && fabs(x[1] - 1) < 1e-6);
}

static void powell(const double *x, double *r, double J[MAX_M][MAX_N])
{
    memset(J, 0, sizeof(double) * 4 * MAX_N);
    r[0] = x[0] + 10 * x[1], J[0][0] = 1, J[0][1] = 10;
    r[1] = sqrt(5) * (x[2] - x[3]), J[1][2] = sqrt(5), J[1][3] = -sqrt(5);
    r[2] = (x[1] - 2 * x[2]) * (x[1] - 2 * x[2]);
    J[2][1] = 2 * (x[1] - 2 * x[2]), J[2][2] = -4 * (x[1] - 2 * x[2]);
    r[3] = sqrt(10) * (x[0] - x[3]) * (x[0] - x[3]);
    J[3][0] = 2 * sqrt(10) * (x[0] - x[3]), J[3][3] = -J[3][0];
}

static void reaches_powells_singular_minimum(void **state)
{
    (void)state;
    struct residuals p = { 4, 4, powell };
    double x[4] = { 3, -1, 0, 1 };
    const struct lm_result r = minimise(&p, x, NULL, NULL);
    assert_true(r.cost < 1e-12);
    for (int i = 0; i < 4; i++)
        assert_true(fabs(x[i]) < 1e-2);
}

static void stays_inside_bounds_and_finds_the_constrained_minimum(void **state)
{
    (void)state;
    struct residuals p = { 2, 2, rosenbrock };
    double x[2] = { -3, 9 };
    const double lower[2] = { -2, -2 }, upper[2] = { .5, 2 };
    minimise(&p, x, lower, upper);
    // On x0 = .5 the best x1 is x0^2 = .25.
    assert_true(fabs(x[0] - .5) < 1e-12 && fabs(x[1] - .25) < 1e-6);
}

// A minimum inside, the start on a bound that is not active there: the bound must be left again.
static void leaves_a_bound_it_started_on(void **state)
{
    (void)state;
    struct residuals p = { 2, 2, rosenbrock };
    double x[2] = { 0, 0 };
    const double lower[2] = { 0, 0 }, upper[2] = { 1.5, 1.5 };
    minimise(&p, x, lower, upper);
    assert_true(fabs(x[0] - 1) < 1e-6 && fabs(x[1] - 1) < 1e-6);
}

// Exponentials with amplitudes and rates whose units differ by 1e6.
static void decays(const double *x, double *r, double J[MAX_M][MAX_N])
{
    for (int k = 0; k < MAX_M; k++) {
        const double t = .05 * k, e1 = exp(-x[1] * 1e6 * t), e2 = exp(-x[3] * 1e6 * t);
        const double truth = 3e3 * exp(-.5 * t) + 1e3 * exp(-4 * t);
        r[k] = x[0] * e1 + x[2] * e2 - truth;
        J[k][0] = e1, J[k][1] = -x[0] * 1e6 * t * e1, J[k][2] = e2, J[k][3] = -x[2] * 1e6 * t * e2;
    }
}

static void does_not_mind_units(void **state)
{
    (void)state;
    struct residuals p = { 4, MAX_M, decays };
    double x[4] = { 1e3, 1e-6, 2e3, 2e-6 };
    minimise(&p, x, NULL, NULL);
    assert_true(fabs(x[0] - 3e3) < 1e-2 && fabs(x[1] - .5e-6) < 1e-11);
    assert_true(fabs(x[2] - 1e3) < 1e-2 && fabs(x[3] - 4e-6) < 1e-11);
}

static void a_variable_without_influence_stays(void **state)
{
    (void)state;
    struct residuals p = { 3, 2, rosenbrock };
    double x[3] = { -1.2, 1, 7 };
    // rosenbrock() leaves column 2 unset; give it zeros through bounds of no width instead
    const double lower[3] = { -9, -9, 7 }, upper[3] = { 9, 9, 7 };
    p.n = 2;
    minimise(&p, x, lower, upper);
    assert_true(x[2] == 7);
}

static void inverse_is_the_inverse(void **state)
{
    (void)state;
    const double A[9] = { 4, 0, 0, 1, 3, 0, .5, -1, 5 }; // lower triangle
    const unsigned char all[3] = { 1, 1, 1 }, some[3] = { 1, 0, 1 };
    double C[9];
    assert_int_equal(lm_inverse(3, A, all, C), 0);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double sum = 0;
            for (int k = 0; k < 3; k++)
                sum += (i >= k ? A[3 * i + k] : A[3 * k + i]) * C[3 * k + j];
            assert_true(fabs(sum - (i == j)) < 1e-14);
        }
    assert_int_equal(lm_inverse(3, A, some, C), 0);
    assert_true(fabs(C[0] - 5 / 19.75) < 1e-14 && fabs(C[2] + .5 / 19.75) < 1e-14 && C[4] == 0);
    const double indefinite[4] = { 1, 0, 2, 1 };
    assert_int_not_equal(lm_inverse(2, indefinite, NULL, C), 0);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(follows_rosenbrocks_valley),
        cmocka_unit_test(reaches_powells_singular_minimum),
        cmocka_unit_test(stays_inside_bounds_and_finds_the_constrained_minimum),
        cmocka_unit_test(leaves_a_bound_it_started_on),
        cmocka_unit_test(does_not_mind_units),
        cmocka_unit_test(a_variable_without_influence_stays),
        cmocka_unit_test(inverse_is_the_inverse),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
