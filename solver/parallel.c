// solver/parallel.c - a loop over all cores: one atomic counter of chunks, threads made per call.
//
// Thread creation costs ~20 us; every loop here is milliseconds or more.
#include "solver/parallel.h"

#include <errno.h>
#include <pthread.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_THREADS = 256 };

int parallel_n_cores(void)
{
    cpu_set_t set;
    if (sched_getaffinity(0, sizeof(set), &set))
        return 1;
    const int n = CPU_COUNT(&set);
    return n < 1 ? 1 : n > MAX_THREADS ? MAX_THREADS : n;
}

struct loop {
    _Atomic int64_t next;
    int64_t n, chunk;
    parallel_body *body;
    void *arg;
};

struct worker {
    struct loop *loop;
    int id;
    pthread_t thread;
};

static void *work(void *p)
{
    const struct worker *w = p;
    struct loop *loop = w->loop;
    for (;;) {
        const int64_t begin = atomic_fetch_add(&loop->next, loop->chunk);
        if (begin >= loop->n)
            return NULL;
        const int64_t end = loop->n - begin < loop->chunk ? loop->n : begin + loop->chunk;
        loop->body(loop->arg, begin, end, w->id);
    }
}

void parallel_for(int n_threads, int64_t n, int64_t chunk, parallel_body *body, void *arg)
{
    if (n <= 0)
        return;
    if (chunk < 1)
        chunk = 1;
    if (n_threads <= 0)
        n_threads = parallel_n_cores();
    const int64_t n_chunks = (n - 1) / chunk + 1;
    if (n_threads > n_chunks)
        n_threads = (int)n_chunks;
    if (n_threads > MAX_THREADS)
        n_threads = MAX_THREADS;
    struct loop loop = { .n = n, .chunk = chunk, .body = body, .arg = arg };
    struct worker workers[MAX_THREADS];
    int n_started = 1;
    for (; n_started < n_threads; n_started++) {
        workers[n_started] = (struct worker){ .loop = &loop, .id = n_started };
        if (pthread_create(&workers[n_started].thread, NULL, work, &workers[n_started]))
            break;
    }
    workers[0] = (struct worker){ .loop = &loop };
    work(&workers[0]);
    for (int i = 1; i < n_started; i++)
        pthread_join(workers[i].thread, NULL);
}

struct sum {
    parallel_sum_body *body;
    void *arg;
    int64_t chunk;
    int n_sums;
    double *partials;
};

static void sum_chunk(void *arg, int64_t begin, int64_t end, int worker)
{
    struct sum *s = arg;
    s->body(s->arg, begin, end, worker, s->partials + begin / s->chunk * s->n_sums);
}

int parallel_sum(int n_threads, int64_t n, int64_t chunk, parallel_sum_body *body, void *arg, int n_sums,
                 double *sums)
{
    if (n <= 0)
        return 0;
    if (chunk < 1)
        chunk = 1;
    const int64_t n_chunks = (n - 1) / chunk + 1;
    struct sum s = { body, arg, chunk, n_sums, calloc((size_t)n_chunks * (size_t)n_sums, sizeof(double)) };
    if (!s.partials)
        return -ENOMEM;
    parallel_for(n_threads, n, chunk, sum_chunk, &s);
    for (int64_t c = 0; c < n_chunks; c++)
        for (int i = 0; i < n_sums; i++)
            sums[i] += s.partials[c * n_sums + i];
    free(s.partials);
    return 0;
}
