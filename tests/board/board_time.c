// tests/board/board_time.c - see board_time.h.
#include "tests/board/board_time.h"

#include <errno.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

enum { AHEAD_NS = 2000000 }; // of the core

static struct board_time {
    _Atomic int64_t lag_ns, reached_ns;
} own = { 0, INT64_MAX }, *shared;

int __real_clock_gettime(clockid_t clock, struct timespec *t);
int __wrap_clock_gettime(clockid_t clock, struct timespec *t);
int __real_pthread_cond_timedwait(pthread_cond_t *c, pthread_mutex_t *m, const struct timespec *until);
int __wrap_pthread_cond_timedwait(pthread_cond_t *c, pthread_mutex_t *m, const struct timespec *until);

static int64_t real_ns(void)
{
    struct timespec t;
    __real_clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static struct timespec timespec_of(int64_t ns)
{
    return (struct timespec){ .tv_sec = ns / 1000000000, .tv_nsec = ns % 1000000000 };
}

int board_time_share(void)
{
    const char *given = getenv("BOARD_TIME_FD");
    char number[16];
    const int fd = given ? atoi(given) : memfd_create("board time", 0); // survives exec
    if (fd < 0 || (!given && ftruncate(fd, sizeof(*shared))))
        return -errno;
    struct board_time *t = mmap(NULL, sizeof(*t), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (t == MAP_FAILED)
        return -errno;
    if (!given) {
        t->reached_ns = INT64_MAX;
        snprintf(number, sizeof(number), "%d", fd);
        setenv("BOARD_TIME_FD", number, 1);
    }
    shared = t;
    return 0;
}

// reached_ns before lag_ns, and written after it: so it never runs back.
int64_t board_time_ns(void)
{
    struct board_time *t = shared ? shared : &own;
    const int64_t reached_ns = t->reached_ns, now_ns = real_ns() - t->lag_ns;
    return reached_ns != INT64_MAX && now_ns > reached_ns + AHEAD_NS ? reached_ns + AHEAD_NS : now_ns;
}

void board_time_reached(int64_t ns)
{
    if (!shared)
        return;
    const int64_t reached_ns = shared->reached_ns, real = real_ns();
    if (reached_ns != INT64_MAX && real - shared->lag_ns > reached_ns + AHEAD_NS)
        shared->lag_ns = real - reached_ns - AHEAD_NS; // it stood still
    shared->reached_ns = ns;
}

int __wrap_clock_gettime(clockid_t clock, struct timespec *t)
{
    if (clock != CLOCK_MONOTONIC)
        return __real_clock_gettime(clock, t);
    *t = timespec_of(board_time_ns());
    return 0;
}

// until: of CLOCK_MONOTONIC.
int __wrap_pthread_cond_timedwait(pthread_cond_t *c, pthread_mutex_t *m, const struct timespec *until)
{
    const int64_t end_ns = until->tv_sec * INT64_C(1000000000) + until->tv_nsec;
    for (;;) {
        const int64_t left_ns = end_ns - board_time_ns();
        const struct timespec t = timespec_of(real_ns() + (left_ns > 0 ? left_ns : 0));
        const int err = __real_pthread_cond_timedwait(c, m, &t);
        if (err != ETIMEDOUT || board_time_ns() >= end_ns)
            return err;
    }
}
