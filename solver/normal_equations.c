// solver/normal_equations.c - blocks of rows through ssyrk; the only file that knows BLAS.
#include "solver/normal_equations.h"

#include <cblas.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

// OpenBLAS's sums depend on how many threads it takes, which is as many as there are cores: results must not. (Other BLAS lack the call.)
void openblas_set_num_threads(int n) __attribute__((weak));
static void __attribute__((constructor)) one_blas_thread(void)
{
    if (openblas_set_num_threads)
        openblas_set_num_threads(1);
}

int normal_rows_new(struct normal_rows *a, int n)
{
    memset(a, 0, sizeof(*a));
    a->n = n;
    a->n_padded = (n + 15) / 16 * 16;
    const size_t width = (size_t)a->n_padded;
    a->rows = aligned_alloc(64, width * NORMAL_BLOCK * sizeof(float));
    a->residuals = malloc(NORMAL_BLOCK * sizeof(float));
    a->product = aligned_alloc(64, width * width * sizeof(float));
    if (!a->rows || !a->residuals || !a->product) {
        normal_rows_free(a);
        return -ENOMEM;
    }
    memset(a->rows, 0, width * NORMAL_BLOCK * sizeof(float));
    return 0;
}

void normal_rows_free(struct normal_rows *a)
{
    free(a->rows);
    free(a->residuals);
    free(a->product);
    memset(a, 0, sizeof(*a));
}

void normal_rows_flush(struct normal_rows *a)
{
    const int n = a->n, width = a->n_padded;
    if (!a->n_rows || !n) { // BLAS refuses a row length of 0
        a->n_rows = 0;
        return;
    }
    cblas_ssyrk(CblasRowMajor, CblasLower, CblasTrans, n, a->n_rows, 1, a->rows, width, 0, a->product, width);
    for (int i = 0; i < n; i++) {
        const float *product = a->product + (size_t)i * (size_t)width;
        double *A = a->A + (size_t)i * (size_t)n;
        for (int j = 0; j <= i; j++)
            A[j] += (double)product[j];
    }
    for (int k = 0; k < a->n_rows; k++) {
        const float *row = a->rows + (size_t)k * (size_t)width;
        const double r = (double)a->residuals[k];
        for (int i = 0; i < n; i++)
            a->g[i] += r * (double)row[i];
    }
    a->n_rows = 0;
}

float *normal_rows_next(struct normal_rows *a, float residual)
{
    if (a->n_rows == NORMAL_BLOCK)
        normal_rows_flush(a);
    a->residuals[a->n_rows] = residual;
    return a->rows + (size_t)a->n_rows++ * (size_t)a->n_padded;
}
