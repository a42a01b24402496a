// solver/pcg.h - preconditioned conjugate gradients for large sparse symmetric positive definite systems A x = b.
//
// Knows nothing of light: the caller applies A and the preconditioner. Vectors are float (tens of millions of unknowns), dot
// products double and summed in fixed order, so the result does not depend on the thread count. Stops when |b - A x| falls below
// tolerance |b| (an inexact stop of 1e-2 .. 1e-1 is what a Gauss-Newton step needs).
#pragma once
#include <stdint.h>

struct pcg_problem {
    int64_t n;
    void (*apply)(void *arg, const float *x, float *y);        // y = A x
    void (*precondition)(void *arg, const float *r, float *z); // z = M^-1 r; NULL: none
    void *arg;
};

struct pcg_result {
    int iterations;
    double relative_residual; // |b - A x| / |b| by recurrence
    int converged;
};

// x: start in, solution out. 0, -ENOMEM, or -EDOM when A proves not positive definite along a direction (x then holds the last good
// iterate).
int pcg_solve(const struct pcg_problem *problem, const float *b, float *x, double tolerance, int max_iterations,
              int n_threads, struct pcg_result *result);
