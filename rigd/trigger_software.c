// rigd/trigger_software.c - no wires: each camera is told by its driver, one after another. For a desk, not for a moving subject.
#include "rigd/trigger.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

struct software {
    const struct config *config;
    const struct trigger_host *host;
    const uint64_t *skip;
    int64_t at_ns;
    bool pending, cancelled;
    int timer_fd;
};

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static void software_close(void *self)
{
    struct software *s = self;
    if (s && s->timer_fd >= 0)
        close(s->timer_fd);
    free(s);
}

static int software_open(void **self, const struct config *config, const struct trigger_host *host)
{
    struct software *s = calloc(1, sizeof(*s));
    if (!s)
        return -ENOMEM;
    *s = (struct software){ .config = config, .host = host, .timer_fd = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC | TFD_NONBLOCK) };
    if (s->timer_fd < 0) {
        const int err = -errno;
        log_error("trigger: timerfd: %s", strerror(-err));
        software_close(s);
        return err;
    }
    *self = s;
    return 0;
}

static unsigned software_abilities(const void *self)
{
    (void)self;
    return 0;
}

static void set_timer(struct software *s, int64_t at_ns)
{
    const struct itimerspec timer = { .it_value = { at_ns / 1000000000, at_ns % 1000000000 } };
    timerfd_settime(s->timer_fd, TFD_TIMER_ABSTIME, &timer, NULL);
}

static int software_fire(void *self, const struct trigger_shot *shot)
{
    struct software *s = self;
    if (s->pending)
        return -EBUSY;
    if (shot->hold_ms > s->config->trigger.max_hold_ms)
        return -EINVAL;
    if (shot->at_ns < clock_ns())
        return -ETIME;
    s->pending = true;
    s->cancelled = false;
    s->at_ns = shot->at_ns;
    s->skip = shot->skip;
    set_timer(s, s->at_ns);
    return 0;
}

static void software_release(void *self)
{
    struct software *s = self;
    s->cancelled = s->pending;
    if (s->pending)
        set_timer(s, 1); // the loop hears of it from dispatch
}

static int software_fd(const void *self)
{
    return ((const struct software *)self)->timer_fd;
}

static void software_dispatch(void *self)
{
    struct software *s = self;
    uint64_t count;
    if (read(s->timer_fd, &count, sizeof(count)) < 0 || !s->pending)
        return;
    const int64_t now_ns = clock_ns();
    for (int i = 0; !s->cancelled && i < s->config->n_cameras; i++)
        if (!s->skip || !(s->skip[i / 64] >> i % 64 & 1))
            s->host->press_camera(s->host->arg, i);
    s->pending = false;
    s->host->fired(s->host->arg, s->cancelled ? -ECANCELED : 0, now_ns, now_ns - s->at_ns);
}

const struct trigger_ops trigger_software = { .open = software_open, .abilities = software_abilities, .fire = software_fire,
    .release = software_release, .fd = software_fd, .dispatch = software_dispatch, .close = software_close };
