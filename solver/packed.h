// solver/packed.h - Cholesky for many small symmetric matrices: lower triangles packed row by row, element (i, j <= i) at
// i (i + 1) / 2 + j. Held in float, worked on in double.
#pragma once
#include <math.h>
#include <stdbool.h>

enum { PACKED_MOST = 16 };

static inline int packed_at(int i, int j)
{
    return i >= j ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i;
}

// A = L L^T in place. False: not positive definite (A is then spoilt).
static inline bool packed_factor(int n, double *A)
{
    for (int i = 0; i < n; i++) {
        double *row = A + i * (i + 1) / 2;
        for (int j = 0; j <= i; j++) {
            const double *other = A + j * (j + 1) / 2;
            double sum = row[j];
            for (int k = 0; k < j; k++)
                sum -= row[k] * other[k];
            if (j < i) {
                row[j] = sum * other[j]; // the diagonal holds its inverse
            } else {
                if (!(sum > 0))
                    return false;
                row[i] = 1 / sqrt(sum);
            }
        }
    }
    return true;
}

// x: b in, A^-1 b out. L from packed_factor (the diagonal holds its inverse).
static inline void packed_solve(int n, const double *L, double *x)
{
    for (int i = 0; i < n; i++) {
        const double *row = L + i * (i + 1) / 2;
        for (int k = 0; k < i; k++)
            x[i] -= row[k] * x[k];
        x[i] *= row[i];
    }
    for (int i = n - 1; i >= 0; i--) {
        const double *row = L + i * (i + 1) / 2;
        x[i] *= row[i];
        for (int k = 0; k < i; k++)
            x[k] -= row[k] * x[i];
    }
}
