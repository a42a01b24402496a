// solver/take/progress.c - a bar for people, a line now and then for logs, JSON lines for rigd.
#include "solver/take/progress.h"

#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

enum { BAR_CELLS = 24, MOST_OUTER = 8 };
static const int64_t REDRAW_NS = 100000000, SILENCE_NS = 1800000000; // the next tick may be late

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int json_fd = -1;
static bool asked_environment;
static bool on_terminal;
static const char *stage; // NULL: none
static int64_t total, begin_ns, next_line_ns;
static _Atomic int64_t done, next_draw_ns;
static struct {
    const char *stage;
    int64_t total, begin_ns, done;
} outer[MOST_OUTER]; // stages that this one is within
static int n_outer;
static bool inner_shown;

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

void progress_set_fd(int fd)
{
    pthread_mutex_lock(&lock);
    asked_environment = true;
    json_fd = fd;
    pthread_mutex_unlock(&lock);
}

// A reader that went away must not end hours of work: EPIPE instead of SIGPIPE, and silence from
// then on.
static void write_json_line(const char *line, size_t n)
{
    sigset_t pipe_only, pending, old;
    sigemptyset(&pipe_only);
    sigaddset(&pipe_only, SIGPIPE);
    sigpending(&pending);
    pthread_sigmask(SIG_BLOCK, &pipe_only, &old);
    ssize_t written;
    do
        written = write(json_fd, line, n);
    while (written < 0 && errno == EINTR);
    if (written < 0 && errno != EAGAIN) {
        if (errno == EPIPE && !sigismember(&pending, SIGPIPE))
            sigtimedwait(&pipe_only, NULL, &(struct timespec){ 0 });
        json_fd = -1;
    }
    pthread_sigmask(SIG_SETMASK, &old, NULL);
}

static int format_time(char *text, size_t size, double seconds)
{
    const int64_t s = (int64_t)(seconds + .5);
    if (s >= 3600)
        return snprintf(text, size, "%lld:%02d:%02d", (long long)(s / 3600), (int)(s / 60 % 60),
                        (int)(s % 60));
    return snprintf(text, size, "%d:%02d", (int)(s / 60), (int)(s % 60));
}

// Called with the lock held.
static void draw(int64_t now)
{
    const int64_t n = atomic_load(&done);
    inner_shown = n_outer > 0;
    const double seconds = (double)(now - begin_ns) * 1e-9;
    char line[256];
    if (json_fd >= 0) {
        // Milliseconds as integers: %f would follow the locale.
        const int64_t ms = (now - begin_ns) / 1000000;
        const int length = snprintf(
            line, sizeof(line),
            "{\"stage\":\"%s\",\"done\":%lld,\"total\":%lld,\"seconds\":%lld.%03d}\n", stage,
            (long long)n, (long long)total, (long long)(ms / 1000), (int)(ms % 1000));
        if (length > 0 && (size_t)length < sizeof(line))
            write_json_line(line, (size_t)length);
    }
    if (!on_terminal && (json_fd >= 0 || now < next_line_ns))
        return;
    next_line_ns = now + SILENCE_NS;
    double share = total > 0 ? (double)n / (double)total : 0;
    share = share < 0 ? 0 : share > 1 ? 1 : share;
    char bar[BAR_CELLS + 1], elapsed[32], left[32] = "-:--";
    for (int i = 0; i < BAR_CELLS; i++)
        bar[i] = i < (int)(share * BAR_CELLS) ? '#' : '.';
    bar[BAR_CELLS] = 0;
    format_time(elapsed, sizeof(elapsed), seconds);
    if (share > 0)
        format_time(left, sizeof(left), seconds * (1 - share) / share);
    if (!on_terminal) {
        fprintf(stderr, "%s: %d %% after %s, %s left\n", stage, (int)(share * 100), elapsed, left);
        return;
    }
    fprintf(stderr, "\r\033[K%s [%s] %3d%%  %s elapsed, %s left", stage, bar, (int)(share * 100),
            elapsed, left);
    fflush(stderr);
}

// One digit: what rigd gives its programs.
static int fd_of_environment(void)
{
    const char *text = getenv("STUDIORIG_PROGRESS_FD");
    const bool named = text && text[0] >= '3' && text[0] <= '9' && !text[1];
    return named && fcntl(text[0] - '0', F_GETFD) >= 0 ? text[0] - '0' : -1;
}

void progress_begin(const char *name, int64_t n)
{
    pthread_mutex_lock(&lock);
    if (!asked_environment)
        json_fd = fd_of_environment();
    asked_environment = true;
    if (stage && n_outer < MOST_OUTER) { // deeper ones take the last one's place
        outer[n_outer].stage = stage, outer[n_outer].total = total, outer[n_outer].begin_ns = begin_ns;
        outer[n_outer++].done = atomic_load(&done);
    }
    stage = name;
    total = n;
    begin_ns = now_ns();
    next_line_ns = next_line_ns ? next_line_ns : begin_ns + SILENCE_NS; // over all stages
    on_terminal = isatty(STDERR_FILENO);
    atomic_store(&done, 0);
    if (!n_outer) { // one within another is not worth a line yet
        atomic_store(&next_draw_ns, begin_ns + REDRAW_NS);
        draw(begin_ns);
    }
    pthread_mutex_unlock(&lock);
}

void progress_add(int64_t n)
{
    atomic_fetch_add(&done, n);
    const int64_t now = now_ns();
    if (now < atomic_load(&next_draw_ns) || pthread_mutex_trylock(&lock))
        return;
    if (stage && now >= atomic_load(&next_draw_ns)) {
        atomic_store(&next_draw_ns, now + REDRAW_NS);
        draw(now);
    }
    pthread_mutex_unlock(&lock);
}

void progress_end(void)
{
    pthread_mutex_lock(&lock);
    if (n_outer) {
        n_outer--;
        stage = outer[n_outer].stage, total = outer[n_outer].total, begin_ns = outer[n_outer].begin_ns;
        atomic_store(&done, outer[n_outer].done);
        if (inner_shown && (on_terminal || json_fd >= 0)) // what was said last is over
            draw(now_ns());
    } else if (stage) {
        if (on_terminal || json_fd >= 0)
            draw(now_ns());
        if (on_terminal)
            fputs("\r\033[K", stderr);
        stage = NULL;
    }
    pthread_mutex_unlock(&lock);
}
