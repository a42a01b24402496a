// tests/board/live_board.c - see live_board.h.
#if __has_include(<umockdev.h>) && __has_include(<simavr/sim_avr.h>)
#include "tests/board/live_board.h"
#include "tests/board/board_time.h"

#include <errno.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { PACE_US = 250, CHUNK = SIMAVR_HZ / 4000, BURST = 40 * CHUNK, EDGES_MAX = 4096, CHANGES_MAX = 1024 };

struct change {
    enum live_what what;
    int input;
    bool closed;
    int64_t at_ns;
};

struct live_board {
    struct simavr_board *board;
    pthread_mutex_t lock;
    pthread_t thread;
    bool quit;
    int64_t start_ns;
    double hz;
    void (*outputs)(void *arg, const struct live_edge *edge);
    void *arg;
    struct live_edge *edge;
    int n_edges;
    struct change change[CHANGES_MAX];
    int n_changes;
};

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static int64_t ns_of(const struct live_board *l, uint64_t cycle)
{
    return l->start_ns + (int64_t)(1e9 * (double)cycle / l->hz);
}

static uint64_t cycle_of(const struct live_board *l, int64_t ns)
{
    return ns <= l->start_ns ? 0 : (uint64_t)(1e-9 * (double)(ns - l->start_ns) * l->hz);
}

static void on_outputs(void *arg, uint64_t cycle, const uint8_t outputs[SIMAVR_REGISTERS])
{
    struct live_board *l = arg;
    struct live_edge e = { .at_ns = ns_of(l, cycle) };
    memcpy(e.outputs, outputs, SIMAVR_REGISTERS);
    if (l->n_edges < EDGES_MAX)
        l->edge[l->n_edges++] = e;
    if (l->outputs)
        l->outputs(l->arg, &e);
}

// ---- pace: under the lock -----------------------------------------------------------------------------------------------------------

static void apply(struct live_board *l, const struct change *c)
{
    if (c->what == LIVE_BUTTON)
        simavr_board_button(l->board, c->closed);
    else if (c->what == LIVE_CAPTURE)
        simavr_board_capture(l->board, c->closed);
    else
        simavr_board_input(l->board, c->input, c->closed);
}

static void run_until(struct live_board *l, uint64_t cycle)
{
    for (;;) {
        const uint64_t now = simavr_board_cycle(l->board);
        int next = -1;
        for (int i = 0; i < l->n_changes; i++)
            if (next < 0 || l->change[i].at_ns < l->change[next].at_ns)
                next = i;
        const uint64_t due = next < 0 ? UINT64_MAX : cycle_of(l, l->change[next].at_ns);
        if (due <= now) {
            apply(l, &l->change[next]);
            memmove(&l->change[next], &l->change[next + 1], (size_t)(--l->n_changes - next) * sizeof(l->change[0]));
        } else if (now < cycle) {
            simavr_board_run(l->board, (due < cycle ? due : cycle) - now);
        } else {
            return;
        }
    }
}

// True: the core is where the clock is. It may be ahead: transfers take their time.
static bool keep_pace(struct live_board *l)
{
    const uint64_t now = simavr_board_cycle(l->board), due = cycle_of(l, clock_ns());
    if (now < due)
        run_until(l, due - now < BURST ? due : now + BURST);
    board_time_reached(ns_of(l, simavr_board_cycle(l->board)));
    return now < due ? due - now < BURST : now < due + CHUNK / 8;
}

static void *pace(void *arg)
{
    struct live_board *l = arg;
    pthread_mutex_lock(&l->lock);
    while (!l->quit) {
        keep_pace(l);
        pthread_mutex_unlock(&l->lock);
        usleep(PACE_US);
        pthread_mutex_lock(&l->lock);
    }
    pthread_mutex_unlock(&l->lock);
    return NULL;
}

// ---- a device on the bus ------------------------------------------------------------------------------------------------------------------

static int live_control(void *device, const uint8_t setup[8], uint8_t *data, size_t room)
{
    struct live_board *l = device;
    pthread_mutex_lock(&l->lock);
    const int n = keep_pace(l) ? simavr_board_control(l->board, setup, data, room) : -EAGAIN;
    pthread_mutex_unlock(&l->lock);
    return n;
}

static int live_out(void *device, uint8_t endpoint, const uint8_t *bytes, size_t n)
{
    struct live_board *l = device;
    if (n > 64)
        return -EOVERFLOW;
    pthread_mutex_lock(&l->lock);
    const int err = keep_pace(l) ? simavr_board_out(l->board, endpoint, bytes, n) : -EAGAIN;
    pthread_mutex_unlock(&l->lock);
    return err ? err : (int)n;
}

static int live_in(void *device, uint8_t endpoint, uint8_t *bytes, size_t room)
{
    struct live_board *l = device;
    uint8_t packet[64];
    pthread_mutex_lock(&l->lock);
    const int n = keep_pace(l) ? simavr_board_in(l->board, endpoint, packet) : -EAGAIN;
    pthread_mutex_unlock(&l->lock);
    if (n > (int)room)
        return -EOVERFLOW;
    if (n > 0)
        memcpy(bytes, packet, (size_t)n);
    return n;
}

static void live_reset(void *device)
{
    struct live_board *l = device;
    pthread_mutex_lock(&l->lock);
    if (simavr_board_enumerate(l->board) < 0)
        fprintf(stderr, "live_board: it does not enumerate\n");
    pthread_mutex_unlock(&l->lock);
}

static void live_unplugged(void *device) // powered by the studio's supply, not by the bus: it has to notice by itself
{
    struct live_board *l = device;
    pthread_mutex_lock(&l->lock);
    simavr_board_suspend(l->board);
    pthread_mutex_unlock(&l->lock);
}

const struct usbfs_ops live_board_ops = { .control = live_control, .out = live_out, .in = live_in, .reset = live_reset, .unplugged = live_unplugged, .speed_mbit = 12 };

size_t live_board_descriptors(struct live_board *l, uint8_t *to, size_t room, char serial[40])
{
    uint8_t text[64];
    pthread_mutex_lock(&l->lock);
    simavr_board_enumerate(l->board);
    const int n = room < 18 + 64 ? -1 : simavr_board_control(l->board, (const uint8_t[]){ 0x80, 6, 0, 1, 0, 0, 18, 0 }, to, 18);
    const int m = n < 18 ? -1 : simavr_board_control(l->board, (const uint8_t[]){ 0x80, 6, 0, 2, 0, 0, 64, 0 }, to + 18, 64);
    const int k = simavr_board_control(l->board, (const uint8_t[]){ 0x80, 6, n < 18 ? 0 : to[16], 3, 9, 4, 64, 0 }, text, 64);
    pthread_mutex_unlock(&l->lock);
    int length = 0;
    for (int i = 2; i + 1 < k && length < 39; i += 2)
        serial[length++] = (char)text[i];
    serial[length] = 0;
    return m < 0 ? 0 : (size_t)(n + m);
}

// ---- hands and eyes -------------------------------------------------------------------------------------------------------------------------

void live_board_set(struct live_board *l, enum live_what what, int input, bool closed, int64_t at_ns)
{
    pthread_mutex_lock(&l->lock);
    if (l->n_changes < CHANGES_MAX)
        l->change[l->n_changes++] = (struct change){ what, input, closed, at_ns };
    pthread_mutex_unlock(&l->lock);
}

int live_board_edges(struct live_board *l, struct live_edge *edge, int max)
{
    pthread_mutex_lock(&l->lock);
    const int n = l->n_edges < max ? l->n_edges : max;
    memcpy(edge, l->edge, (size_t)n * sizeof(*edge));
    l->n_edges -= n;
    memmove(l->edge, l->edge + n, (size_t)l->n_edges * sizeof(*edge));
    pthread_mutex_unlock(&l->lock);
    return n;
}

void live_board_outputs(struct live_board *l, uint8_t outputs[SIMAVR_REGISTERS])
{
    pthread_mutex_lock(&l->lock);
    memcpy(outputs, simavr_board_outputs(l->board), SIMAVR_REGISTERS);
    pthread_mutex_unlock(&l->lock);
}

bool live_board_led(struct live_board *l)
{
    pthread_mutex_lock(&l->lock);
    const bool led = simavr_board_led(l->board);
    pthread_mutex_unlock(&l->lock);
    return led;
}

bool live_board_is_dead(struct live_board *l)
{
    pthread_mutex_lock(&l->lock);
    const bool dead = simavr_board_is_dead(l->board);
    pthread_mutex_unlock(&l->lock);
    return dead;
}

int live_board_open(struct live_board **out, const char *image, double fast_ppm, void (*outputs)(void *arg, const struct live_edge *edge), void *arg)
{
    struct live_board *l = calloc(1, sizeof(*l));
    *out = NULL;
    if (!l || !(l->edge = calloc(EDGES_MAX, sizeof(*l->edge)))) {
        free(l);
        return -ENOMEM;
    }
    const struct simavr_board_watch watch = { .outputs = on_outputs, .arg = l };
    l->outputs = outputs;
    l->arg = arg;
    l->hz = SIMAVR_HZ * (1 + 1e-6 * fast_ppm);
    l->start_ns = clock_ns();
    board_time_reached(l->start_ns);
    l->board = simavr_board_open(image, &watch);
    if (!l->board) {
        board_time_reached(INT64_MAX);
        free(l->edge);
        free(l);
        return -ENOENT;
    }
    pthread_mutex_init(&l->lock, NULL);
    if (pthread_create(&l->thread, NULL, pace, l))
        abort();
    *out = l;
    return 0;
}

void live_board_close(struct live_board *l)
{
    if (!l)
        return;
    pthread_mutex_lock(&l->lock);
    l->quit = true;
    pthread_mutex_unlock(&l->lock);
    pthread_join(l->thread, NULL);
    board_time_reached(INT64_MAX);
    simavr_board_close(l->board);
    pthread_mutex_destroy(&l->lock);
    free(l->edge);
    free(l);
}
#endif
