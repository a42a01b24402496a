// solver/pcg.c - preconditioned conjugate gradients (Hestenes, Stiefel 1952), float vectors and double sums.
#include "solver/pcg.h"

#include "solver/parallel.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { CHUNK = 1 << 16 };

struct pair {
    const float *a, *b;
};

static void dot_chunk(void *arg, int64_t begin, int64_t end, int worker, double *partial)
{
    (void)worker;
    const struct pair *p = arg;
    double sum = 0;
    for (int64_t i = begin; i < end; i++)
        sum += (double)p->a[i] * (double)p->b[i];
    *partial += sum;
}

static int dot(const float *a, const float *b, int64_t n, int n_threads, double *out)
{
    struct pair p = { a, b };
    *out = 0;
    return parallel_sum(n_threads, n, CHUNK, dot_chunk, &p, 1, out);
}

int pcg_solve(const struct pcg_problem *p, const float *b, float *x, double tolerance, int max_iterations,
              int n_threads, struct pcg_result *result)
{
    const size_t bytes = (size_t)p->n * sizeof(float);
    float *r = malloc(bytes), *z = malloc(bytes), *d = malloc(bytes), *q = malloc(bytes);
    struct pcg_result out = { 0 };
    double bb, rz, rr;
    int err = r && z && d && q ? 0 : -ENOMEM;
    if (err || (err = dot(b, b, p->n, n_threads, &bb)))
        goto end;
    if (bb == 0) {
        memset(x, 0, bytes);
        out.converged = 1;
        goto end;
    }
    p->apply(p->arg, x, q);
    for (int64_t i = 0; i < p->n; i++)
        r[i] = b[i] - q[i];
    for (double rz_before = 0;; out.iterations++) {
        if ((err = dot(r, r, p->n, n_threads, &rr)))
            goto end;
        out.relative_residual = sqrt(rr / bb);
        out.converged = out.relative_residual <= tolerance;
        if (out.converged || out.iterations >= max_iterations)
            break;
        if (p->precondition)
            p->precondition(p->arg, r, z);
        else
            memcpy(z, r, bytes);
        if ((err = dot(r, z, p->n, n_threads, &rz)))
            goto end;
        const double beta = out.iterations ? rz / rz_before : 0;
        for (int64_t i = 0; i < p->n; i++)
            d[i] = z[i] + (out.iterations ? (float)(beta * (double)d[i]) : 0);
        p->apply(p->arg, d, q);
        double dq;
        if ((err = dot(d, q, p->n, n_threads, &dq)))
            goto end;
        if (!(dq > 0) || !(rz > 0)) {
            err = -EDOM;
            break;
        }
        const double alpha = rz / dq;
        for (int64_t i = 0; i < p->n; i++) {
            x[i] += (float)(alpha * (double)d[i]);
            r[i] -= (float)(alpha * (double)q[i]);
        }
        rz_before = rz;
    }
end:
    *result = out;
    free(r);
    free(z);
    free(d);
    free(q);
    return err;
}
