// solver/parallel.h - loops over all cores whose results do not depend on how many there are.
//
// Work is cut into chunks by size alone, never by thread count; sums are added chunk by chunk in order. So one thread and
// sixteen give the same bytes. Own pthreads (OpenMP's runtime blinds ThreadSanitizer). Not reentrant: body must not call
// parallel_for.
#pragma once
#include <stdint.h>

int parallel_n_cores(void); // cores this process may use, >= 1

// body(arg, begin, end, worker) for [0,n) in pieces of at most chunk; worker in [0, n_threads) names a private scratch slot.
// n_threads <= 0: parallel_n_cores(). Falls back to fewer threads where the system gives no more. Returns when all is done.
typedef void parallel_body(void *arg, int64_t begin, int64_t end, int worker);
void parallel_for(int n_threads, int64_t n, int64_t chunk, parallel_body *body, void *arg);

// sums[n_sums] += the sum of what body adds to its zeroed partial[n_sums], in chunk order. 0 or -ENOMEM.
typedef void parallel_sum_body(void *arg, int64_t begin, int64_t end, int worker, double *partial);
int parallel_sum(int n_threads, int64_t n, int64_t chunk, parallel_sum_body *body, void *arg, int n_sums,
                 double *sums);
