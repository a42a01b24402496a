// solver/lm.c - dense Levenberg-Marquardt on normal equations; the factorisation is LAPACK's.
#include "solver/lm.h"

#include <errno.h>
#include <lapacke.h>
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

// OpenBLAS's sums depend on how many threads it takes, which is as many as there are cores: results must not. (Other BLAS lack the call.)
void openblas_set_num_threads(int n) __attribute__((weak));
static void __attribute__((constructor)) one_lapack_thread(void)
{
    if (openblas_set_num_threads)
        openblas_set_num_threads(1);
}

struct lm_settings lm_defaults(void)
{
    return (struct lm_settings){
        .max_iterations = 60, .relative_cost = 1e-6, .relative_step = 1e-9, .gradient = 1e-10, .mu = 1e-3
    };
}

const char *lm_stop_name(enum lm_stop stop)
{
    static const char *const names[] = { "cost", "step", "gradient", "max_iterations", "no_descent" };
    return names[stop];
}

// Gather the free rows and columns of A into the packed-together square B (lower triangle). Returns their number.
static int gather(int n, const double *A, const double *d, const unsigned char *is_free, double *B, int *place)
{
    int m = 0;
    for (int i = 0; i < n; i++)
        if (!is_free || is_free[i])
            place[m++] = i;
    for (int i = 0; i < m; i++) {
        for (int j = 0; j <= i; j++)
            B[(size_t)i * m + j] = A[(size_t)place[i] * n + place[j]];
        if (d)
            B[(size_t)i * m + i] += d[place[i]];
    }
    return m;
}

int lm_solve(int n, double *A, const double *d, const double *b, const unsigned char *free_variable, double *x)
{
    // In place: row i of the gathered matrix never overtakes what is still to be read (m <= n).
    int *place = malloc((size_t)n * sizeof(int));
    double *y = malloc((size_t)n * sizeof(double));
    int err = place && y ? 0 : -ENOMEM;
    if (!err) {
        const int m = gather(n, A, d, free_variable, A, place);
        for (int i = 0; i < m; i++)
            y[i] = b[place[i]];
        memset(x, 0, (size_t)n * sizeof(double));
        if (m > 0 && LAPACKE_dposv_work(LAPACK_COL_MAJOR, 'U', m, 1, A, m, y, m))
            err = -EDOM; // row-major lower is column-major upper
        for (int i = 0; !err && i < m; i++) {
            x[place[i]] = y[i];
            if (!isfinite(y[i]))
                err = -EDOM;
        }
    }
    free(place);
    free(y);
    return err;
}

int lm_inverse(int n, const double *A, const unsigned char *free_variable, double *out)
{
    int *place = malloc((size_t)n * sizeof(int));
    double *B = malloc((size_t)n * (size_t)n * sizeof(double));
    int err = place && B ? 0 : -ENOMEM;
    if (!err) {
        const int m = gather(n, A, NULL, free_variable, B, place);
        memset(out, 0, (size_t)n * (size_t)n * sizeof(double));
        if (m > 0 && (LAPACKE_dpotrf_work(LAPACK_COL_MAJOR, 'U', m, B, m) ||
                      LAPACKE_dpotri_work(LAPACK_COL_MAJOR, 'U', m, B, m)))
            err = -EDOM;
        for (int i = 0; !err && i < m; i++)
            for (int j = 0; j <= i; j++)
                out[(size_t)place[i] * n + place[j]] = out[(size_t)place[j] * n + place[i]] =
                    B[(size_t)i * m + j];
    }
    free(place);
    free(B);
    return err;
}

static void project(const struct lm_problem *p, double *x)
{
    for (int i = 0; i < p->n; i++) {
        if (p->lower && x[i] < p->lower[i])
            x[i] = p->lower[i];
        if (p->upper && x[i] > p->upper[i])
            x[i] = p->upper[i];
    }
}

// Which variables may move against the gradient.
static void find_free(const struct lm_problem *p, const double *x, const double *g, unsigned char *is_free)
{
    for (int i = 0; i < p->n; i++)
        is_free[i] = !(p->lower && x[i] <= p->lower[i] && g[i] > 0) && !(p->upper && x[i] >= p->upper[i] && g[i] < 0);
}

struct scratch {
    double *A, *B, *g, *d, *step, *trial, *minus_g;
    unsigned char *is_free;
};

static void free_scratch(struct scratch *s)
{
    free(s->A);
    free(s->B);
    free(s->g);
    free(s->d);
    free(s->step);
    free(s->trial);
    free(s->minus_g);
    free(s->is_free);
}

static bool new_scratch(struct scratch *s, size_t n)
{
    s->A = malloc(n * n * sizeof(double));
    s->B = malloc(n * n * sizeof(double));
    s->g = malloc(n * sizeof(double));
    s->d = calloc(n, sizeof(double));
    s->step = malloc(n * sizeof(double));
    s->trial = malloc(n * sizeof(double));
    s->minus_g = malloc(n * sizeof(double));
    s->is_free = malloc(n);
    return s->A && s->B && s->g && s->d && s->step && s->trial && s->minus_g && s->is_free;
}

static int evaluate(const struct lm_problem *p, struct scratch *s, const double *x, bool fresh_scale, double *scale,
                    struct lm_result *r)
{
    const size_t n = (size_t)p->n;
    memset(s->A, 0, n * n * sizeof(double));
    memset(s->g, 0, n * sizeof(double));
    r->n_jacobians++;
    const int err = p->normal_equations(p->arg, x, &r->cost, s->A, s->g);
    for (size_t i = 0; !err && i < n; i++)
        scale[i] = fmax(fresh_scale ? 0 : scale[i], s->A[i * n + i]);
    return err;
}

// A step with the damping mu, cut off at the bounds: variables on a bound that the step would carry over it stay there, and the others
// are solved for again, at most a few times. False: not positive definite.
static bool find_step(const struct lm_problem *p, struct scratch *s, const double *x, const double *scale,
                      double mu)
{
    const int n = p->n;
    find_free(p, x, s->g, s->is_free);
    for (int round = 0;; round++) {
        for (int i = 0; i < n; i++) {
            s->d[i] = mu * scale[i];
            if (scale[i] <= 0)
                s->is_free[i] = 0; // nothing depends on it
            s->minus_g[i] = -s->g[i];
        }
        memcpy(s->B, s->A, (size_t)n * (size_t)n * sizeof(double));
        if (lm_solve(n, s->B, s->d, s->minus_g, s->is_free, s->step))
            return false;
        memcpy(s->trial, x, (size_t)n * sizeof(double));
        int n_stopped = 0;
        for (int i = 0; i < n; i++) {
            const double to = x[i] + s->step[i];
            if (s->is_free[i] && ((p->lower && to < p->lower[i] && x[i] <= p->lower[i]) ||
                                  (p->upper && to > p->upper[i] && x[i] >= p->upper[i]))) {
                s->is_free[i] = 0;
                n_stopped++;
            }
            s->trial[i] = to;
        }
        if (n_stopped == 0 || round == 5)
            break;
    }
    project(p, s->trial);
    for (int i = 0; i < n; i++)
        s->step[i] = s->trial[i] - x[i];
    return true;
}

// F(x) - model(x + step) = -g.step - 1/2 step^T A step
static double promised(int n, const struct scratch *s)
{
    double gain = 0;
    for (int i = 0; i < n; i++) {
        double row = .5 * s->A[(size_t)i * n + i] * s->step[i];
        for (int j = 0; j < i; j++)
            row += s->A[(size_t)i * n + j] * s->step[j];
        gain -= s->step[i] * (s->g[i] + row);
    }
    return gain;
}

int lm_minimise(const struct lm_problem *p, const struct lm_settings *settings, double *x,
                struct lm_result *result)
{
    const int n = p->n;
    struct lm_result r = { .stop = LM_MAX_ITERATIONS, .mu = settings->mu };
    struct scratch s = { 0 };
    double *scale = calloc((size_t)n, sizeof(double)), nu = 2;
    int err = scale && new_scratch(&s, (size_t)n) ? 0 : -ENOMEM;
    if (err)
        goto end;
    project(p, x);
    err = evaluate(p, &s, x, settings->fresh_scale, scale, &r);
    if (err)
        goto end;
    if (!isfinite(r.cost)) {
        err = -EINVAL;
        goto end;
    }
    r.first_cost = r.cost;
    for (int iteration = 0; iteration < settings->max_iterations; iteration++) {
        find_free(p, x, s.g, s.is_free);
        double steepest = 0, step2 = 0, x2 = 0, cost = INFINITY;
        for (int i = 0; i < n; i++)
            if (s.is_free[i] && scale[i] > 0)
                steepest = fmax(steepest, fabs(s.g[i]) / sqrt(scale[i]));
        if (steepest <= settings->gradient * sqrt(2 * r.cost)) {
            r.stop = LM_GRADIENT;
            break;
        }
        double gain = 0, model_gain = 0;
        if (find_step(p, &s, x, scale, r.mu)) {
            for (int i = 0; i < n; i++) {
                step2 += scale[i] * s.step[i] * s.step[i];
                x2 += scale[i] * x[i] * x[i];
            }
            if (sqrt(step2) <= settings->relative_step * (sqrt(x2) + settings->relative_step)) {
                r.stop = LM_STEP;
                break;
            }
            model_gain = promised(n, &s);
            r.n_costs++;
            if (p->cost(p->arg, s.trial, &cost))
                cost = INFINITY;
            gain = isfinite(cost) ? r.cost - cost : -INFINITY;
        }
        if (model_gain > 0 && gain > 1e-3 * model_gain) {
            const double before = r.cost, rho = 2 * gain / model_gain - 1;
            memcpy(x, s.trial, (size_t)n * sizeof(double));
            r.mu *= fmax(1. / 3, 1 - rho * rho * rho);
            r.mu = fmax(r.mu, 1e-15);
            nu = 2;
            err = evaluate(p, &s, x, settings->fresh_scale, scale, &r);
            if (err)
                goto end;
            if (gain <= settings->relative_cost * before) {
                r.stop = LM_COST;
                break;
            }
        } else {
            r.mu *= nu;
            nu *= 2;
            if (r.mu > 1e15) {
                r.stop = LM_NO_DESCENT;
                break;
            }
        }
    }
    *result = r;
end:
    free(scale);
    free_scratch(&s);
    return err;
}
