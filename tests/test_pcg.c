// tests/test_pcg.c - conjugate gradients on Poisson grids whose solution is known, and on what is not positive definite.
#include "solver/parallel.h"
#include "solver/pcg.h"
#include "solver/random.h"

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
#if __has_include(<suitesparse/cholmod.h>)
#include <suitesparse/cholmod.h>
#define HAVE_CHOLMOD 1
#endif

// Five points (three where height is 1), the border held at 0: eigenvalues 4 sin^2(k pi / 2 (n+1)), summed over both sides.
struct grid {
    int width, height, n_threads;
    double shift; // added to the diagonal
    int n_applied;
};

static double diagonal(const struct grid *g)
{
    return (g->height > 1 ? 4 : 2) + g->shift;
}

static double row(const struct grid *g, const double *xd, const float *xf, int64_t i)
{
    const int64_t w = g->width, n = w * g->height, column = i % w, near[4] = { i - w, i - 1, i + 1, i + w };
    const bool there[4] = { i >= w, column > 0, column < w - 1, i + w < n };
    double sum = diagonal(g) * (xd ? xd[i] : (double)xf[i]);
    for (int k = 0; k < 4; k++)
        if (there[k])
            sum -= xd ? xd[near[k]] : (double)xf[near[k]];
    return sum;
}

struct product {
    const struct grid *grid;
    const float *x;
    float *y;
};

static void multiply(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    const struct product *p = arg;
    for (int64_t i = begin; i < end; i++)
        p->y[i] = (float)row(p->grid, NULL, p->x, i);
}

static void apply(void *arg, const float *x, float *y)
{
    struct grid *g = arg;
    struct product p = { g, x, y };
    g->n_applied++;
    parallel_for(g->n_threads, (int64_t)g->width * g->height, 4096, multiply, &p);
}

// Blocks of a row of the grid, each solved exactly (Thomas).
static void solve_rows(void *arg, const float *r, float *z)
{
    const struct grid *g = arg;
    const double a = diagonal(g);
    double up[g->width], rest[g->width];
    for (int y = 0; y < g->height; y++) {
        const size_t first = (size_t)y * (size_t)g->width;
        for (int i = 0; i < g->width; i++) {
            const double pivot = i ? a + up[i - 1] : a; // up < 0
            up[i] = -1 / pivot;
            rest[i] = ((double)r[first + (size_t)i] + (i ? rest[i - 1] : 0)) / pivot;
        }
        for (int i = g->width - 1; i >= 0; i--) {
            if (i < g->width - 1)
                rest[i] -= up[i] * rest[i + 1];
            z[first + (size_t)i] = (float)rest[i];
        }
    }
}

struct system {
    struct grid grid;
    struct pcg_problem problem;
    float *b, *x;
    double *truth;
};

static void system_open(struct system *s, int width, int height, double shift)
{
    const size_t n = (size_t)width * (size_t)height;
    *s = (struct system){ .grid = { .width = width, .height = height, .n_threads = 2, .shift = shift },
                          .b = calloc(n, sizeof(float)), .x = calloc(n, sizeof(float)), .truth = calloc(n, sizeof(double)) };
    s->problem = (struct pcg_problem){ .n = (int64_t)n, .apply = apply, .arg = &s->grid };
    assert_true(s->b && s->x && s->truth);
}

static void system_close(struct system *s)
{
    free(s->b);
    free(s->x);
    free(s->truth);
}

// b = A truth, rounded to float.
static void set_right_side(struct system *s)
{
    for (int64_t i = 0; i < s->problem.n; i++)
        s->b[i] = (float)row(&s->grid, s->truth, NULL, i);
}

static double true_residual(const struct system *s)
{
    double rr = 0, bb = 0;
    for (int64_t i = 0; i < s->problem.n; i++) {
        rr += pow((double)s->b[i] - row(&s->grid, NULL, s->x, i), 2);
        bb += pow((double)s->b[i], 2);
    }
    return sqrt(rr / bb);
}

static double relative_error(const struct system *s)
{
    double ee = 0, tt = 0;
    for (int64_t i = 0; i < s->problem.n; i++) {
        ee += pow((double)s->x[i] - s->truth[i], 2);
        tt += s->truth[i] * s->truth[i];
    }
    return sqrt(ee / tt);
}

static struct pcg_result solve(struct system *s, double tolerance, int max_iterations)
{
    struct pcg_result r;
    assert_int_equal(pcg_solve(&s->problem, s->b, s->x, tolerance, max_iterations, s->grid.n_threads, &r), 0);
    print_message("# %d x %d, shift %g%s: %d iterations, residual %.2g by recurrence, %.2g in truth, x off by %.2g\n", s->grid.width,
                  s->grid.height, s->grid.shift, s->problem.precondition ? ", rows" : "", r.iterations, r.relative_residual,
                  true_residual(s), relative_error(s));
    return r;
}

// Largest over smallest eigenvalue.
static double condition(const struct grid *g)
{
    const double a = M_PI / (2 * (g->width + 1)), b = M_PI / (2 * (g->height + 1)), two = g->height > 1;
    const double least = 4 * pow(sin(a), 2) + two * 4 * pow(sin(b), 2), most = 4 * pow(cos(a), 2) + two * 4 * pow(cos(b), 2);
    return (most + g->shift) / (least + g->shift);
}

static void set_truth(struct system *s)
{
    for (int64_t i = 0; i < s->problem.n; i++)
        s->truth[i] = random_normal(1, 2, (uint64_t)i) + 30 * sin(3 * M_PI * (double)(i + 1) / (double)(s->problem.n + 1));
    set_right_side(s);
}

static void stops_where_it_says(struct system *s)
{
    static const double tolerances[] = { .1, 1e-2, 1e-3, 1e-4 };
    for (int k = 0; k < 4; k++) {
        const double kappa = condition(&s->grid);
        memset(s->x, 0, (size_t)s->problem.n * sizeof(float));
        const struct pcg_result r = solve(s, tolerances[k], 5000);
        assert_true(r.converged && r.relative_residual <= tolerances[k]);
        assert_true(true_residual(s) <= 1.01 * tolerances[k]); // float vectors do not show yet
        assert_true(relative_error(s) <= kappa * true_residual(s));
        // Conjugate directions need sqrt(kappa)/2 log(2 sqrt(kappa) / tolerance) steps, steepest descent about sqrt(kappa) times as many.
        assert_true(s->problem.precondition || r.iterations <= .5 * sqrt(kappa) * log(2 * sqrt(kappa) / tolerances[k]) + 1);
    }
}

static void solves_a_chain_of_condition_4e7(void **state)
{
    (void)state;
    struct system s;
    system_open(&s, 10000, 1, 0);
    set_truth(&s);
    assert_true(condition(&s.grid) > 4e7);
    stops_where_it_says(&s);
    s.problem.precondition = solve_rows; // the whole of A: one step, and one for the rounding
    memset(s.x, 0, 10000 * sizeof(float));
    const struct pcg_result r = solve(&s, 1e-6, 10);
    assert_true(r.converged && r.iterations <= 2 && relative_error(&s) < 1e-3);
    system_close(&s);
}

static void solves_a_grid_and_faster_with_block_jacobi(void **state)
{
    (void)state;
    struct system s;
    system_open(&s, 300, 300, 0);
    set_truth(&s);
    stops_where_it_says(&s);
    memset(s.x, 0, 90000 * sizeof(float));
    const int n_plain = solve(&s, 1e-5, 5000).iterations;
    assert_true(relative_error(&s) < 1e-2);
    s.problem.precondition = solve_rows;
    stops_where_it_says(&s);
    memset(s.x, 0, 90000 * sizeof(float));
    const int n_blocks = solve(&s, 1e-5, 5000).iterations;
    assert_true(relative_error(&s) < 1e-2);
    assert_true(n_blocks < .8 * n_plain);
    system_close(&s);
}

static void starts_from_x_and_stops_at_the_limit(void **state)
{
    (void)state;
    struct system s;
    system_open(&s, 40, 30, .1);
    set_truth(&s);
    struct pcg_result r = solve(&s, 1e-6, 5);
    assert_true(r.iterations == 5 && !r.converged);
    const int n_cold = 5 + solve(&s, 1e-6, 1000).iterations; // goes on from there
    assert_true(relative_error(&s) < 1e-5 && n_cold > 10);
    r = solve(&s, 1e-5, 1000);
    assert_true(r.converged && r.iterations == 0);
    r = solve(&s, 0, 0);
    assert_true(!r.converged && r.iterations == 0 && r.relative_residual < 1e-5);
    system_close(&s);
}

static void no_right_side_is_no_work(void **state)
{
    (void)state;
    struct system s;
    struct pcg_result r;
    system_open(&s, 20, 20, 0);
    for (int i = 0; i < 400; i++)
        s.x[i] = (float)i;
    assert_int_equal(pcg_solve(&s.problem, s.b, s.x, 1e-3, 100, 1, &r), 0);
    for (int i = 0; i < 400; i++)
        assert_true(s.x[i] == 0);
    assert_true(r.converged && r.iterations == 0 && s.grid.n_applied == 0);
    system_close(&s);
}

static void negate(void *arg, const float *r, float *z)
{
    const struct grid *g = arg;
    for (int i = 0; i < g->width * g->height; i++)
        z[i] = -r[i];
}

// 1/2 x A x - b x: every good step lowers it.
static double energy(const struct system *s)
{
    double sum = 0;
    for (int64_t i = 0; i < s->problem.n; i++)
        sum += (double)s->x[i] * (.5 * row(&s->grid, NULL, s->x, i) - (double)s->b[i]);
    return sum;
}

static void what_is_not_positive_definite_is_refused(void **state)
{
    (void)state;
    static const double shifts[] = { -.5, -4, -8.5 }; // some, half, all eigenvalues below 0
    struct system s;
    struct pcg_result r;
    for (int k = 0; k < 3; k++) {
        system_open(&s, 30, 20, shifts[k]);
        for (int i = 0; i < 600; i++)
            s.b[i] = (float)random_normal(3, 4, (uint64_t)i);
        assert_int_equal(pcg_solve(&s.problem, s.b, s.x, 1e-6, 1000, 1, &r), -EDOM);
        assert_true(!r.converged && r.iterations < 600);
        assert_true(isfinite(energy(&s)) && energy(&s) <= 0 && (energy(&s) < 0) == (r.iterations > 0));
        system_close(&s);
    }
    system_open(&s, 30, 20, 0);
    set_truth(&s);
    s.problem.precondition = negate;
    assert_int_equal(pcg_solve(&s.problem, s.b, s.x, 1e-6, 1000, 1, &r), -EDOM);
    s.problem.precondition = NULL;
    s.b[7] = NAN;
    assert_int_equal(pcg_solve(&s.problem, s.b, s.x, 1e-6, 1000, 1, &r), -EDOM);
    system_close(&s);
}

static void thread_counts_give_the_same_bytes(void **state)
{
    (void)state;
    struct system s;
    float *first = malloc(90000 * sizeof(float));
    struct pcg_result r[3];
    assert_non_null(first);
    system_open(&s, 300, 300, .01);
    set_truth(&s);
    for (int k = 0; k < 3; k++) {
        s.grid.n_threads = k == 0 ? 1 : k == 1 ? 3 : 7;
        memset(s.x, 0, 90000 * sizeof(float));
        r[k] = solve(&s, 1e-5, 1000);
        if (k == 0)
            memcpy(first, s.x, 90000 * sizeof(float));
        assert_memory_equal(first, s.x, 90000 * sizeof(float));
        assert_true(r[k].iterations == r[0].iterations && r[k].relative_residual == r[0].relative_residual);
    }
    free(first);
    system_close(&s);
}

#ifdef HAVE_CHOLMOD
static void agrees_with_cholmod(void **state)
{
    (void)state;
    struct system s;
    system_open(&s, 61, 47, .02);
    const size_t n = (size_t)s.problem.n;
    cholmod_common c;
    cholmod_start(&c);
    cholmod_triplet *t = cholmod_allocate_triplet(n, n, 3 * n, -1, CHOLMOD_REAL, &c); // lower triangle
    cholmod_dense *b = cholmod_zeros(n, 1, CHOLMOD_REAL, &c);
    for (int64_t i = 0; i < s.problem.n; i++) {
        const int64_t w = s.grid.width, near[3] = { i, i - 1, i - w };
        const bool there[3] = { true, i % w > 0, i >= w };
        for (int k = 0; k < 3; k++) {
            if (!there[k])
                continue;
            ((int *)t->i)[t->nnz] = (int)i, ((int *)t->j)[t->nnz] = (int)near[k];
            ((double *)t->x)[t->nnz++] = k ? -1 : diagonal(&s.grid);
        }
        s.b[i] = (float)random_normal(5, 6, (uint64_t)i);
        ((double *)b->x)[i] = (double)s.b[i];
    }
    cholmod_sparse *A = cholmod_triplet_to_sparse(t, 0, &c);
    cholmod_factor *L = cholmod_analyze(A, &c);
    assert_true(cholmod_factorize(A, L, &c));
    cholmod_dense *x = cholmod_solve(CHOLMOD_A, L, b, &c);
    memcpy(s.truth, x->x, n * sizeof(double));
    assert_true(solve(&s, 1e-6, 1000).converged);
    assert_true(relative_error(&s) < 1e-5);
    cholmod_free_dense(&x, &c);
    cholmod_free_dense(&b, &c);
    cholmod_free_factor(&L, &c);
    cholmod_free_sparse(&A, &c);
    cholmod_free_triplet(&t, &c);
    cholmod_finish(&c);
    system_close(&s);
}
#endif

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(solves_a_chain_of_condition_4e7),
        cmocka_unit_test(solves_a_grid_and_faster_with_block_jacobi),
        cmocka_unit_test(starts_from_x_and_stops_at_the_limit),
        cmocka_unit_test(no_right_side_is_no_work),
        cmocka_unit_test(what_is_not_positive_definite_is_refused),
        cmocka_unit_test(thread_counts_give_the_same_bytes),
#ifdef HAVE_CHOLMOD
        cmocka_unit_test(agrees_with_cholmod),
#endif
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
