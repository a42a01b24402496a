// solver/normal_equations.h - A = J^T J and g = J^T r from rows that come one by one. Knows nothing of light.
//
// Rows are float and multiplied in blocks (BLAS ssyrk); blocks are added up in double. One accumulator per thread.
#pragma once

struct normal_rows {
    int n, n_padded;   // unknowns; a row's length in memory
    int n_rows;        // waiting in the block
    float *rows, *residuals, *product;
    double *A, *g;     // the caller's: n x n row-major (lower triangle), n; added to
};

enum { NORMAL_BLOCK = 384 }; // rows per block

int normal_rows_new(struct normal_rows *a, int n); // 0 or -ENOMEM; A and g are NULL
void normal_rows_free(struct normal_rows *a);
// The next row to fill (n floats, not cleared), already weighted, with its residual. Valid until the next call.
float *normal_rows_next(struct normal_rows *a, float residual);
void normal_rows_flush(struct normal_rows *a); // add what waits to A and g
