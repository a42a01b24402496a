// solver/lm.h - Levenberg-Marquardt for dense problems with bounds. Knows nothing of light.
//
// Minimises F(x) = 1/2 sum of squares, given as normal equations: the caller adds up A = J^T W J and g = J^T W r itself, so that
// residuals need never be held. Damping by gain ratio (Madsen, Nielsen, Tingleff 2004): a step is taken when it gains more
// than 1e-3 of what the model promised; a refused step multiplies mu by 2, 4, 8, ... Bounds: a variable at its bound whose
// gradient points outwards is frozen for the step, and steps are projected (a change of variables would stall at the bounds).
// Scaling is by the diagonal of A, the largest seen (Moré) unless settings say otherwise, so units of the variables do not matter.
// Deterministic; not thread-safe per problem.
#pragma once
#include <stdbool.h>

struct lm_problem {
    int n;
    const double *lower, *upper; // [n], or NULL: none
    // Cost at x. Return 0, or anything else to refuse the point (treated as infinite cost).
    int (*cost)(void *arg, const double *x, double *cost);
    // Cost, A (n x n, row-major, the lower triangle is read) and g at x; both are zeroed before the call. A return other than 0 ends
    // the search with that value.
    int (*normal_equations)(void *arg, const double *x, double *cost, double *A, double *g);
    void *arg;
};

struct lm_settings {
    int max_iterations;      // accepted and refused steps together; default 60
    double relative_cost;    // stop when an accepted step gains less than this share of F; 1e-6
    double relative_step;    // stop when |step| < this (|x| + this), scaled; 1e-9
    double gradient;         // stop when every free, scaled gradient entry is below this share of sqrt(2F); 1e-10
    double mu;               // first damping, a share of the scaled diagonal; 1e-3
    bool fresh_scale;        // scale by the diagonal of A where x is (Marquardt), not by the largest seen (Moré); for problems with
                             // places of enormous slope that one visit should not be remembered by
};
struct lm_settings lm_defaults(void);

enum lm_stop { LM_COST, LM_STEP, LM_GRADIENT, LM_MAX_ITERATIONS, LM_NO_DESCENT /* mu overflowed: rounding */ };
const char *lm_stop_name(enum lm_stop stop);

struct lm_result {
    enum lm_stop stop;
    int n_jacobians, n_costs; // how often each callback ran
    double first_cost, cost;
    double mu;                // to continue with
};

// x: start in (projected into the bounds), best point out. 0, -ENOMEM, -EINVAL (first point refused), or what
// normal_equations returned.
int lm_minimise(const struct lm_problem *problem, const struct lm_settings *settings, double *x,
                struct lm_result *result);

// Solve (A + diag(d)) x = b for symmetric positive definite A (lower triangle of n x n, row-major, destroyed). free (NULL: all): 0
// keeps x_i = 0. Returns 0, or -EDOM when the matrix is not positive definite.
int lm_solve(int n, double *A, const double *d, const double *b, const unsigned char *free_variable, double *x);
// Inverse of the free part of A (rows and columns of the others are 0): lower and upper triangle of out. 0 or -EDOM, -ENOMEM.
int lm_inverse(int n, const double *A, const unsigned char *free_variable, double *out);
