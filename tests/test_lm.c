// tests/test_lm.c - the optimiser on textbook problems: valleys, a singular minimum, bounds, units that differ by 1e6, refusals.
#include "solver/lm.h"

#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { MAX_N = 40, MAX_M = 40 };

// A problem given as residuals and their Jacobian.
struct residuals {
    int n, m;
    void (*evaluate)(const double *x, double *r, double J[MAX_M][MAX_N]); // J comes zeroed
    const double *lower, *upper; // or NULL: what no point may cross
};

static void evaluate(const struct residuals *p, const double *x, double *r, double J[MAX_M][MAX_N])
{
    for (int i = 0; i < p->n; i++) {
        assert_true(!p->lower || x[i] >= p->lower[i]);
        assert_true(!p->upper || x[i] <= p->upper[i]);
    }
    memset(J, 0, sizeof(double) * MAX_M * MAX_N);
    p->evaluate(x, r, J);
}

static int cost(void *arg, const double *x, double *out)
{
    const struct residuals *p = arg;
    double r[MAX_M], J[MAX_M][MAX_N];
    evaluate(p, x, r, J);
    *out = 0;
    for (int i = 0; i < p->m; i++)
        *out += .5 * r[i] * r[i];
    return 0;
}

static int normal_equations(void *arg, const double *x, double *out, double *A, double *g)
{
    const struct residuals *p = arg;
    double r[MAX_M], J[MAX_M][MAX_N];
    evaluate(p, x, r, J);
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
    p->lower = lower, p->upper = upper;
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
    struct residuals p = { 2, 2, rosenbrock, NULL, NULL };
    double x[2] = { -1.2, 1 };
    minimise(&p, x, NULL, NULL);
    assert_true(fabs(x[0] - 1) < 1e-6 && fabs(x[1] - 1) < 1e-6);
}

static void powell(const double *x, double *r, double J[MAX_M][MAX_N])
{
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
    struct residuals p = { 4, 4, powell, NULL, NULL };
    double x[4] = { 3, -1, 0, 1 };
    const struct lm_result r = minimise(&p, x, NULL, NULL);
    assert_true(r.cost < 1e-12);
    for (int i = 0; i < 4; i++)
        assert_true(fabs(x[i]) < 1e-2);
}

static void stays_inside_bounds_and_finds_the_constrained_minimum(void **state)
{
    (void)state;
    struct residuals p = { 2, 2, rosenbrock, NULL, NULL };
    double x[2] = { -3, 9 };
    const double lower[2] = { -2, -2 }, upper[2] = { .5, 2 };
    minimise(&p, x, lower, upper);
    // On x0 = .5 the best x1 is x0^2 = .25.
    assert_true(fabs(x[0] - .5) < 1e-12 && fabs(x[1] - .25) < 1e-6);
}

// r = e^x - 1: where the search starts the slope is e^12, at the minimum 1.
static void cliff(const double *x, double *r, double J[MAX_M][MAX_N])
{
    r[0] = exp(x[0]) - 1;
    J[0][0] = exp(x[0]);
}

// Moré's scale remembers the cliff for good and holds back every later step; that of the current point does not.
static void a_fresh_scale_forgets_a_cliff(void **state)
{
    (void)state;
    struct residuals p = { 1, 1, cliff, NULL, NULL };
    const struct lm_problem problem = { 1, NULL, NULL, cost, normal_equations, &p };
    struct lm_settings s = lm_defaults();
    struct lm_result remembering, fresh;
    double x[2] = { 12, 12 };
    s.max_iterations = 500, s.relative_cost = 0, s.mu = 10;
    assert_int_equal(lm_minimise(&problem, &s, &x[0], &remembering), 0);
    s.fresh_scale = true;
    assert_int_equal(lm_minimise(&problem, &s, &x[1], &fresh), 0);
    print_message("# %d Jacobians to %g, %d to %g\n", remembering.n_jacobians, x[0], fresh.n_jacobians, x[1]);
    assert_true(fabs(x[0]) < 1e-6 && fabs(x[1]) < 1e-6);
    assert_true(fresh.n_jacobians + 5 < remembering.n_jacobians);
}

// A minimum inside, the start on a bound that is not active there: the bound must be left again.
static void leaves_a_bound_it_started_on(void **state)
{
    (void)state;
    struct residuals p = { 2, 2, rosenbrock, NULL, NULL };
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
    struct residuals p = { 4, MAX_M, decays, NULL, NULL };
    double x[4] = { 1e3, 1e-6, 2e3, 2e-6 };
    minimise(&p, x, NULL, NULL);
    assert_true(fabs(x[0] - 3e3) < 1e-2 && fabs(x[1] - .5e-6) < 1e-11);
    assert_true(fabs(x[2] - 1e3) < 1e-2 && fabs(x[3] - 4e-6) < 1e-11);
}

// x[2] is in no residual: its column of J is 0, the matrix singular.
static void a_variable_without_influence_stays(void **state)
{
    (void)state;
    struct residuals p = { 3, 2, rosenbrock, NULL, NULL };
    double x[3] = { -1.2, 1, 7 };
    minimise(&p, x, NULL, NULL);
    assert_true(x[2] == 7);
    assert_true(fabs(x[0] - 1) < 1e-6 && fabs(x[1] - 1) < 1e-6);
    const double lower[3] = { -9, -9, -9 }, upper[3] = { 9, 9, 6 };
    double y[3] = { -1.2, 1, 7 };
    minimise(&p, y, lower, upper);
    assert_true(y[2] == 6); // projected into its bounds
    assert_true(fabs(y[0] - 1) < 1e-6 && fabs(y[1] - 1) < 1e-6);
}

// ---- linear problems with bounds whose solution is known: J x - t, t such that at x* the gradient is a given lambda ----

static double known_lower[MAX_N], known_upper[MAX_N], known_x[MAX_N], known_t[MAX_M];
static int known_n;

// A chain of springs: r_k = (x_k - x_{k-1}) - t_k, x_{-1} = 0. The condition of J^T J is about (2 n / pi)^2 ^ 2 at equal units.
static void chain(const double *x, double *r, double J[MAX_M][MAX_N])
{
    for (int k = 0; k < known_n; k++) {
        r[k] = x[k] - (k ? x[k - 1] : 0) - known_t[k];
        J[k][k] = 1;
        if (k)
            J[k][k - 1] = -1;
    }
}

// Hilbert's matrix: condition 1.6e4 for 4, 2.4e8 for J^T J.
static void hilbert(const double *x, double *r, double J[MAX_M][MAX_N])
{
    for (int k = 0; k < known_n; k++) {
        r[k] = -known_t[k];
        for (int i = 0; i < known_n; i++)
            r[k] += (J[k][i] = 1. / (1 + i + k)) * x[i];
    }
}

static void reaches(struct residuals *p, const double *start, double within)
{
    double x[MAX_N], step = 0;
    memcpy(x, start, (size_t)p->n * sizeof(double));
    minimise(p, x, known_lower, known_upper);
    for (int i = 0; i < p->n; i++) {
        step = fmax(step, fabs(x[i] - known_x[i]));
        if (known_x[i] == known_lower[i] || known_x[i] == known_upper[i])
            assert_true(x[i] == known_x[i]);
    }
    print_message("# n %d: x off by %.2g\n", p->n, step);
    assert_true(step < within);
}

// Lambda_i: > 0 at the lower bound, < 0 at the upper one, 0 between.
static double known_multiplier(int i)
{
    static const int pattern[7] = { 0, 1, 0, 0, -1, 0, 0 };
    return pattern[i % 7] * (.1 + .3 * (i % 3));
}

static void pose_chain(int n)
{
    known_n = n;
    double pull = 0;
    for (int k = n - 1; k >= 0; k--) { // J^T r = lambda from the far end
        known_x[k] = sin(.7 * k) + .05 * k;
        const double lambda = known_multiplier(k);
        known_lower[k] = known_x[k] - (lambda > 0 ? 0 : .2 + .1 * (k % 4));
        known_upper[k] = known_x[k] + (lambda < 0 ? 0 : .3);
        pull += lambda;
        known_t[k] = -pull;
    }
    for (int k = 0; k < n; k++)
        known_t[k] += known_x[k] - (k ? known_x[k - 1] : 0);
}

static void solves_ill_conditioned_chains_inside_bounds(void **state)
{
    (void)state;
    static const int sizes[] = { 2, 3, 8, 23, 40 };
    for (int s = 0; s < 5; s++) {
        double low[MAX_N], high[MAX_N], middle[MAX_N];
        pose_chain(sizes[s]);
        for (int i = 0; i < known_n; i++)
            low[i] = known_lower[i] - 5, high[i] = known_upper[i], middle[i] = .3 * known_lower[i] + .7 * known_upper[i];
        struct residuals p = { known_n, known_n, chain, NULL, NULL };
        reaches(&p, low, 1e-6);
        reaches(&p, high, 1e-6);
        reaches(&p, middle, 1e-6);
    }
}

static void solves_hilberts_matrix_inside_bounds(void **state)
{
    (void)state;
    static const double inverse[4][4] = {
        { 16, -120, 240, -140 }, { -120, 1200, -2700, 1680 }, { 240, -2700, 6480, -4200 }, { -140, 1680, -4200, 2800 }
    };
    static const double x[4] = { .5, 1, -.25, 2 }, lambda[4] = { 0, 1e-3, 0, -2e-3 };
    known_n = 4;
    for (int k = 0; k < 4; k++) {
        known_x[k] = x[k], known_t[k] = 0;
        known_lower[k] = x[k] - (lambda[k] > 0 ? 0 : 1), known_upper[k] = x[k] + (lambda[k] < 0 ? 0 : 1);
        for (int i = 0; i < 4; i++)
            known_t[k] += x[i] / (1 + i + k) - inverse[k][i] * lambda[i];
    }
    struct residuals p = { 4, 4, hilbert, NULL, NULL };
    reaches(&p, known_lower, 1e-6);
    reaches(&p, known_upper, 1e-6);
    reaches(&p, (const double[4]){ 0, 1.5, 0, 1.2 }, 1e-6);
}

// ---- what a line through points must give -------------------------------------------------------------------------------

static void line(const double *x, double *r, double J[MAX_M][MAX_N])
{
    static const double y[4] = { 1, 3, 2, 6 }; // at 0, 1, 2, 3: slope 1.4, offset .9, squares 4.2
    for (int k = 0; k < 4; k++) {
        r[k] = x[0] + x[1] * k - y[k];
        J[k][0] = 1, J[k][1] = k;
    }
}

static void a_line_is_fitted(void **state)
{
    (void)state;
    struct residuals p = { 2, 4, line, NULL, NULL };
    double x[2] = { 100, -50 };
    const struct lm_result r = minimise(&p, x, NULL, NULL);
    assert_true(fabs(x[0] - .9) < 1e-9 && fabs(x[1] - 1.4) < 1e-9 && fabs(r.cost - 2.1) < 1e-12);
    const struct lm_result again = minimise(&p, x, NULL, NULL);
    assert_true(again.n_jacobians <= 2 && again.first_cost - again.cost < 1e-12);
    double y[2] = { 0, 0 };
    const double lower[2] = { -9, -9 }, upper[2] = { 9, 1 }; // at slope 1 the offset is the mean of y - t: 1.5
    minimise(&p, y, lower, upper);
    assert_true(y[1] == 1 && fabs(y[0] - 1.5) < 1e-9);
}

// ---- refusals -----------------------------------------------------------------------------------------------------------

struct picky {
    bool not_a_number;
    int fail_at, n_normal, n_refused;
};

// r = log x: from 10 the first step leads to -13.
static int picky_cost(void *arg, const double *x, double *out)
{
    struct picky *p = arg;
    *out = -1; // must not be looked at when the point is refused
    if (!(x[0] > 0)) {
        p->n_refused++;
        if (p->not_a_number)
            *out = NAN;
        return p->not_a_number ? 0 : 1;
    }
    *out = .5 * log(x[0]) * log(x[0]);
    return 0;
}

static int picky_normal(void *arg, const double *x, double *out, double *A, double *g)
{
    struct picky *p = arg;
    assert_true(A[0] == 0 && g[0] == 0);
    if (++p->n_normal == p->fail_at)
        return -77;
    *out = x[0] > 0 ? .5 * log(x[0]) * log(x[0]) : INFINITY;
    A[0] = 1 / (x[0] * x[0]), g[0] = log(x[0]) / x[0];
    return 0;
}

static void refused_points_shorten_the_step(void **state)
{
    (void)state;
    for (int k = 0; k < 2; k++) {
        struct picky p = { .not_a_number = k };
        const struct lm_problem problem = { 1, NULL, NULL, picky_cost, picky_normal, &p };
        const struct lm_settings settings = lm_defaults();
        struct lm_result r;
        double x = 10;
        assert_int_equal(lm_minimise(&problem, &settings, &x, &r), 0);
        assert_true(p.n_refused > 0 && fabs(x - 1) < 1e-3 && r.cost < 1e-6);
        assert_int_equal(r.n_jacobians, p.n_normal);
    }
}

static void failures_are_reported(void **state)
{
    (void)state;
    struct picky p = { .fail_at = 3 };
    const struct lm_problem problem = { 1, NULL, NULL, picky_cost, picky_normal, &p };
    struct lm_settings settings = lm_defaults();
    struct lm_result r;
    double x = 10;
    assert_int_equal(lm_minimise(&problem, &settings, &x, &r), -77);
    assert_int_equal(p.n_normal, 3);
    p = (struct picky){ 0 };
    x = -2;
    assert_int_equal(lm_minimise(&problem, &settings, &x, &r), -EINVAL);
    assert_true(x == -2);
    x = 10, settings.max_iterations = 0;
    assert_int_equal(lm_minimise(&problem, &settings, &x, &r), 0);
    assert_true(r.stop == LM_MAX_ITERATIONS && x == 10 && r.cost == r.first_cost && r.n_jacobians == 1 && r.n_costs == 0);
    assert_string_equal(lm_stop_name(r.stop), "max_iterations");
    settings.max_iterations = 4;
    assert_int_equal(lm_minimise(&problem, &settings, &x, &r), 0);
    assert_true(r.stop == LM_MAX_ITERATIONS && r.n_costs == 4);
    x = 1;
    assert_int_equal(lm_minimise(&problem, &settings, &x, &r), 0);
    assert_true(r.stop == LM_GRADIENT && r.n_costs == 0);
}

// [4 1 .5; 1 3 -1; .5 -1 5] + diag(1, 2, 0): its middle left out, and whole.
static void solves_the_free_part(void **state)
{
    (void)state;
    const double lower_triangle[9] = { 4, NAN, NAN, 1, 3, NAN, .5, -1, 5 }, d[3] = { 1, 2, 0 }, b[3] = { 6.5, 3, 10 };
    const unsigned char some[3] = { 1, 0, 1 };
    double A[9], x[3];
    memcpy(A, lower_triangle, sizeof(A));
    assert_int_equal(lm_solve(3, A, d, b, NULL, x), 0);
    assert_true(fabs(5 * x[0] + x[1] + .5 * x[2] - 6.5) < 1e-13 && fabs(x[0] + 5 * x[1] - x[2] - 3) < 1e-13 &&
                fabs(.5 * x[0] - x[1] + 5 * x[2] - 10) < 1e-13);
    memcpy(A, lower_triangle, sizeof(A));
    assert_int_equal(lm_solve(3, A, d, b, some, x), 0); // 5 x + .5 z = 6.5, .5 x + 5 z = 10
    assert_true(fabs(x[0] - 27.5 / 24.75) < 1e-14 && x[1] == 0 && fabs(x[2] - 46.75 / 24.75) < 1e-14);
    memcpy(A, lower_triangle, sizeof(A));
    const unsigned char none[3] = { 0 };
    assert_int_equal(lm_solve(3, A, d, b, none, x), 0);
    assert_true(x[0] == 0 && x[1] == 0 && x[2] == 0);
    double indefinite[4] = { 1, 0, 2, 1 };
    assert_int_equal(lm_solve(2, indefinite, NULL, b, NULL, x), -EDOM);
    double not_a_number[4] = { 1, 0, NAN, 1 };
    assert_int_equal(lm_solve(2, not_a_number, NULL, b, NULL, x), -EDOM);
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
        cmocka_unit_test(a_fresh_scale_forgets_a_cliff),
        cmocka_unit_test(leaves_a_bound_it_started_on),
        cmocka_unit_test(does_not_mind_units),
        cmocka_unit_test(a_variable_without_influence_stays),
        cmocka_unit_test(solves_ill_conditioned_chains_inside_bounds),
        cmocka_unit_test(solves_hilberts_matrix_inside_bounds),
        cmocka_unit_test(a_line_is_fitted),
        cmocka_unit_test(refused_points_shorten_the_step),
        cmocka_unit_test(failures_are_reported),
        cmocka_unit_test(solves_the_free_part),
        cmocka_unit_test(inverse_is_the_inverse),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
