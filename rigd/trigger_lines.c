// rigd/trigger_lines.c - shutters on lines: the thread that moves them, the guard that lets go, the inputs.
//
// Who may change an output: the thread, or the loop in release and relay, one at a time under `lock`; the guard, by itself, only
// towards inactive. What is active stands in shared memory (limit_ns), so that all three agree.
#include "rigd/trigger_lines.h"
#include "solver/take/log.h"

#include <dirent.h>
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/timerfd.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum {
    PRIORITY = 50,             // of SCHED_FIFO, above interrupt threads' neighbours and below the kernel's watchdogs
    SPIN_NS = 100000,          // a sleeping thread wakes some 50 us late; the rest of the time is watched away
    GUARD_GRACE_NS = 10000000, // the guard leaves the thread that long to do it
    GUARD_LOOK_MS = 10,        // while a line is or may become active
    CONTACT_NS = 20000000,     // a sync contact that bounces is heard once
    EDGES_AT_ONCE = 512,       // a packet of the simulated rig
};

struct shared { // with the guard
    _Atomic int64_t limit_ns[EDGES_WIRES_MAX];
    atomic_bool active;   // a shot is pending or a supply is cut
};

struct trigger_lines {
    const struct config *config;
    const struct trigger_host *host;
    const struct lines_ops *ops;
    void *lines;
    struct shared *shared;
    struct edges edges;
    pthread_mutex_t lock;
    pthread_cond_t wake;
    pthread_t thread;
    bool locks, started, quit;
    bool broken, told_broken; // lines or guard are gone
    bool told_stuck;          // they could not be released
    bool has_fired;           // fired() is due
    int result;
    int64_t pressed_ns, late_ns;
    int epoll_fd, event_fd, timer_fd;
    int guard_fd;
    pid_t guard;
    // inputs: feedback of cameras in order, then the button
    int n_inputs, button;
    int camera_of[CONFIG_CAMERAS_MAX + 1];
    int64_t heard_ns[CONFIG_CAMERAS_MAX];
    bool button_down, button_moved;
    int64_t moved_ns; // first edge since the button was last at rest
};

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static struct timespec timespec_of(int64_t ns)
{
    return (struct timespec){ .tv_sec = ns / 1000000000, .tv_nsec = ns % 1000000000 };
}

static void prefer_realtime(void)
{
    const struct sched_param p = { .sched_priority = PRIORITY };
    prctl(PR_SET_TIMERSLACK, 1UL);
    if (pthread_setschedparam(pthread_self(), SCHED_FIFO, &p))
        log_info("trigger: no real-time priority: edges come as late as the host is busy (give rigd LimitRTPRIO=%d)", PRIORITY);
}

// ---- the guard ----------------------------------------------------------------------------------------------------------------

// A child keeps every descriptor of its parent; held by the guard, a socket that rigd closes would not end. Lines stay.
static void guard_close_others(int guard_fd)
{
    char path[40], target[64];
    DIR *dir = opendir("/proc/self/fd");
    struct dirent *d;
    while (dir && (d = readdir(dir))) {
        const int fd = atoi(d->d_name);
        if (d->d_name[0] == '.' || fd <= STDERR_FILENO || fd == guard_fd || fd == dirfd(dir))
            continue;
        snprintf(path, sizeof(path), "/proc/self/fd/%d", fd);
        const ssize_t n = readlink(path, target, sizeof(target) - 1);
        if (n < 0 || strncmp(target, "anon_inode:gpio", 15) != 0)
            close(fd);
    }
    if (dir)
        closedir(dir);
}

static void guard_run(struct trigger_lines *t, int guard_fd)
{
    uint64_t active[LINES_WORDS], all[LINES_WORDS];
    sigset_t every;
    sigfillset(&every);
    sigprocmask(SIG_SETMASK, &every, NULL); // Ctrl-C at a terminal, or systemd's SIGTERM to the whole group, are for rigd
    prctl(PR_SET_NAME, "rigd-guard"); // of ordinary priority: it is there for when others go wrong
    guard_close_others(guard_fd);
    memset(all, 0xff, sizeof(all));
    for (;;) {
        struct pollfd p = { .fd = guard_fd, .events = POLLIN };
        char bytes[64];
        const int n = poll(&p, 1, atomic_load(&t->shared->active) ? GUARD_LOOK_MS : -1);
        if (n > 0 && recv(guard_fd, bytes, sizeof(bytes), MSG_DONTWAIT) <= 0) // whatever it is: never one that spins
            break;
        const int64_t now_ns = clock_ns();
        bool over = false;
        memset(active, 0, sizeof(active));
        for (int w = 0; w < t->edges.n_wires; w++) {
            int64_t limit_ns = atomic_load(&t->shared->limit_ns[w]);
            if (limit_ns && limit_ns + GUARD_GRACE_NS <= now_ns)
                over |= atomic_compare_exchange_strong(&t->shared->limit_ns[w], &limit_ns, 0);
            else if (limit_ns)
                active[w / 64] |= UINT64_C(1) << w % 64;
        }
        if (over)
            t->ops->set(t->lines, active, all, now_ns);
    }
    memset(active, 0, sizeof(active)); // rigd is gone
    t->ops->set(t->lines, active, all, clock_ns());
    _exit(0);
}

static int guard_start(struct trigger_lines *t)
{
    int fd[2];
    if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0, fd)) {
        const int err = -errno;
        log_error("trigger: no socket for the guard of the lines: %s", strerror(-err));
        return err;
    }
    t->guard = fork();
    if (t->guard == 0) {
        guard_run(t, fd[1]);
        _exit(1);
    }
    const int err = t->guard < 0 ? -errno : 0;
    close(fd[1]);
    t->guard_fd = fd[0];
    if (err)
        log_error("trigger: cannot start the guard of the lines: %s", strerror(-err));
    return err;
}

static void guard_stop(struct trigger_lines *t)
{
    if (t->guard_fd >= 0)
        close(t->guard_fd);
    if (t->guard > 0) {
        kill(t->guard, SIGKILL);
        while (waitpid(t->guard, NULL, 0) < 0 && errno == EINTR)
            ;
    }
}

// Before anything becomes active.
static void guard_alert(struct trigger_lines *t)
{
    atomic_store(&t->shared->active, true);
    if (t->guard > 0)
        send(t->guard_fd, "", 1, MSG_DONTWAIT | MSG_NOSIGNAL);
}

// ---- outputs: under the lock ----------------------------------------------------------------------------------------------------

// When nothing is active or planned any more, it may sleep.
static void guard_may_sleep(struct trigger_lines *t)
{
    atomic_store(&t->shared->active, edges_next_ns(&t->edges) != EDGES_NEVER);
}

static void tell_loop(struct trigger_lines *t)
{
    const uint64_t one = 1;
    if (write(t->event_fd, &one, sizeof(one)) < 0)
        log_error("trigger: eventfd: %s", strerror(errno));
}

static void finish_shot(struct trigger_lines *t, int err)
{
    t->has_fired = true;
    t->result = err;
    tell_loop(t);
}

// Everything off, whatever was said before. 0, or -errno: something may still be pressed (logged).
static int all_off(struct trigger_lines *t, bool relays)
{
    struct edges_step s;
    edges_give_up(&t->edges, relays, &s);
    const int err = t->ops->set(t->lines, s.active, s.changed, clock_ns());
    if (err && !t->told_stuck)
        log_error("trigger: cannot release the lines: %s: shutters may still be pressed: unplug them, then look at the wiring", strerror(-err));
    t->told_stuck |= err != 0;
    t->broken |= err != 0;
    if (t->broken)
        tell_loop(t);
    guard_may_sleep(t);
    return err;
}

static void line_failed(struct trigger_lines *t, int err)
{
    t->broken = true;
    if (!all_off(t, true)) // before a word about it: a journal may take its time
        log_error("trigger: a line failed: %s: all are released, the trigger is opened anew", strerror(-err));
}

// Carry out one step of the plan. at_ns: when it counts as done.
static void carry_out(struct trigger_lines *t, int64_t at_ns)
{
    const int64_t due_ns = t->edges.due_ns;
    struct edges_step s;
    const bool pending = t->edges.pending;
    edges_step(&t->edges, at_ns, &s);
    int err = s.any ? t->ops->set(t->lines, s.active, s.changed, at_ns) : 0;
    const int64_t set_ns = t->ops->timed ? at_ns : clock_ns(); // a host that stood still in between shortens no pulse
    edges_set(&t->edges, &s, set_ns);
    if (s.first) {
        t->pressed_ns = set_ns;
        t->late_ns = t->pressed_ns - due_ns;
    }
    if (err)
        line_failed(t, err);
    if (pending && (err || s.done || s.cut)) {
        if (s.cut && !err)
            all_off(t, false);
        finish_shot(t, err || s.too_late || s.cut ? -EIO : 0);
    }
    if (s.too_late)
        log_error("trigger: this process did not run when the shutters were due; they are not pressed %lld ms late",
            (long long)(EDGES_LATE_MAX_NS / 1000000));
    if (s.cut)
        log_error("trigger: a line was held to its limit of %u ms and let go by the guard: this process did not run",
            t->config->trigger.max_hold_ms);
    guard_may_sleep(t);
}

static void *run(void *arg)
{
    struct trigger_lines *t = arg;
    prctl(PR_SET_NAME, "rigd-edges");
    prefer_realtime();
    pthread_mutex_lock(&t->lock);
    while (!t->quit) {
        const int64_t next_ns = edges_next_ns(&t->edges);
        if (next_ns == EDGES_NEVER) {
            pthread_cond_wait(&t->wake, &t->lock);
        } else if (next_ns - clock_ns() > SPIN_NS) {
            const struct timespec until = timespec_of(next_ns - SPIN_NS);
            pthread_cond_timedwait(&t->wake, &t->lock, &until);
        } else {
            int64_t now_ns;
            while ((now_ns = clock_ns()) < next_ns)
                ;
            carry_out(t, t->ops->timed && next_ns > 0 ? next_ns : now_ns);
        }
    }
    pthread_mutex_unlock(&t->lock);
    return NULL;
}

// ---- inputs: the loop -------------------------------------------------------------------------------------------------------------

// A button counts as moved when it has stayed there for the debounce time: neither bounces nor a flash pack's spike press it.
static void button_rests(struct trigger_lines *t)
{
    const int level = t->ops->level(t->lines, t->button);
    t->button_moved = false;
    if (level < 0 || level == t->button_down)
        return;
    t->button_down = level;
    if (level)
        t->host->button(t->host->arg, t->moved_ns);
}

static void button_edge(struct trigger_lines *t, int64_t at_ns)
{
    struct itimerspec timer = { .it_value = timespec_of(at_ns + t->config->trigger.button_debounce_ms * INT64_C(1000000) + 1) };
    if (!t->button_moved)
        t->moved_ns = at_ns;
    t->button_moved = true;
    timerfd_settime(t->timer_fd, TFD_TIMER_ABSTIME, &timer, NULL);
}

static int read_inputs(struct trigger_lines *t)
{
    struct lines_edge edge[EDGES_AT_ONCE];
    int n;
    do {
        n = t->ops->read(t->lines, edge, EDGES_AT_ONCE);
        for (int i = 0; i < n; i++) {
            if (edge[i].input == t->button) {
                button_edge(t, edge[i].at_ns);
                continue;
            }
            const int camera = t->camera_of[edge[i].input];
            if (!edge[i].active || edge[i].at_ns - t->heard_ns[camera] < CONTACT_NS)
                continue;
            t->heard_ns[camera] = edge[i].at_ns;
            t->host->feedback(t->host->arg, camera, edge[i].at_ns);
        }
    } while (n == EDGES_AT_ONCE);
    return n < 0 ? n : 0;
}

void trigger_lines_dispatch(void *self)
{
    struct trigger_lines *t = self;
    uint64_t count;
    struct pollfd guard = { .fd = t->guard_fd, .events = POLLIN };
    bool lost = !t->told_broken && poll(&guard, 1, 0) > 0;
    if (lost)
        log_error("trigger: the guard of the lines (process %d) is gone: without it nothing is pressed", (int)t->guard);
    if (read(t->timer_fd, &count, sizeof(count)) > 0)
        button_rests(t);
    if (read(t->event_fd, &count, sizeof(count)) < 0 && errno != EAGAIN)
        log_error("trigger: eventfd: %s", strerror(errno));
    lost |= t->ops->fd(t->lines) >= 0 && !t->told_broken && read_inputs(t) < 0;

    pthread_mutex_lock(&t->lock);
    if (lost && !t->broken) {
        const bool pending = t->edges.pending;
        t->broken = true;
        all_off(t, true);
        if (pending)
            finish_shot(t, -EIO);
    }
    const bool fired = t->has_fired, broken = t->broken && !t->told_broken;
    const int err = t->result;
    const int64_t pressed_ns = t->pressed_ns, late_ns = t->late_ns;
    t->has_fired = false;
    t->told_broken |= broken;
    pthread_mutex_unlock(&t->lock);
    if (broken) { // their ends would be readable for ever
        epoll_ctl(t->epoll_fd, EPOLL_CTL_DEL, t->guard_fd, NULL);
        epoll_ctl(t->epoll_fd, EPOLL_CTL_DEL, t->ops->fd(t->lines), NULL);
    }

    const struct trigger_host *host = t->host;
    if (fired)
        host->fired(host->arg, err, pressed_ns, late_ns);
    int head_err;
    if (!broken && t->ops->arrived && t->ops->arrived(t->lines, &head_err) && host->head_arrived)
        host->head_arrived(host->arg, head_err);
    if (broken)
        host->broken(host->arg, -EIO); // last: the host may close us
}

// ---- the rest of the table ----------------------------------------------------------------------------------------------------------

unsigned trigger_lines_abilities(const void *self)
{
    const struct trigger_lines *t = self;
    const bool button = t->button != CONFIG_NONE;
    return TRIGGER_SYNCHRONISED | (t->ops->head ? TRIGGER_HEAD : 0) | edges_abilities(&t->edges) | (button ? TRIGGER_BUTTON : 0) |
        (t->n_inputs > button ? TRIGGER_FEEDBACK : 0);
}

int trigger_lines_fire(void *self, const struct trigger_shot *shot)
{
    struct trigger_lines *t = self;
    pthread_mutex_lock(&t->lock);
    int err = t->broken ? -EIO : t->has_fired ? -EBUSY : edges_plan(&t->edges, shot, clock_ns());
    if (!err) {
        t->pressed_ns = t->late_ns = 0;
        guard_alert(t);
        pthread_cond_signal(&t->wake);
    }
    pthread_mutex_unlock(&t->lock);
    return err;
}

void trigger_lines_release(void *self)
{
    struct trigger_lines *t = self;
    pthread_mutex_lock(&t->lock);
    const bool pending = t->edges.pending;
    all_off(t, false);
    if (pending)
        finish_shot(t, t->broken ? -EIO : -ECANCELED);
    pthread_mutex_unlock(&t->lock);
}

int trigger_lines_relay(void *self, int camera, bool cut)
{
    struct trigger_lines *t = self;
    const int wire = t->edges.relay_of[camera];
    struct edges_step s;
    if (wire == CONFIG_NONE)
        return -ENOTSUP;
    pthread_mutex_lock(&t->lock);
    int err = t->broken ? -EIO : 0;
    if (!err) {
        guard_alert(t);
        edges_relay(&t->edges, wire, cut, clock_ns(), &s);
        err = s.any ? t->ops->set(t->lines, s.active, s.changed, clock_ns()) : 0;
        if (err) {
            const bool pending = t->edges.pending;
            line_failed(t, err);
            if (pending)
                finish_shot(t, -EIO);
            err = -EIO;
        }
        guard_may_sleep(t);
        pthread_cond_signal(&t->wake); // it may not stay cut for ever
    }
    pthread_mutex_unlock(&t->lock);
    return err;
}

int trigger_lines_head(void *self, int32_t yaw_mdeg, int32_t pitch_mdeg)
{
    struct trigger_lines *t = self;
    pthread_mutex_lock(&t->lock);
    const int err = t->broken ? -EIO : t->edges.pending ? -EBUSY : t->ops->head ? t->ops->head(t->lines, yaw_mdeg, pitch_mdeg) : -ENOTSUP;
    pthread_mutex_unlock(&t->lock);
    return err;
}

int trigger_lines_fd(const void *self)
{
    return ((const struct trigger_lines *)self)->epoll_fd;
}

static int watch(struct trigger_lines *t, int fd)
{
    struct epoll_event e = { .events = EPOLLIN };
    return fd < 0 || !epoll_ctl(t->epoll_fd, EPOLL_CTL_ADD, fd, &e) ? 0 : -errno;
}

static int want_inputs(struct trigger_lines *t, struct lines_wire *input, bool of_cameras)
{
    const struct config *c = t->config;
    int n = 0;
    for (int i = 0; i < c->n_cameras; i++) {
        const int line = of_cameras ? i : c->camera[i].feedback_line;
        if (line == CONFIG_NONE)
            continue;
        t->camera_of[n] = i;
        t->heard_ns[i] = INT64_MIN / 2;
        input[n] = (struct lines_wire){ .line = line, .active_low = c->trigger.feedback_active_low };
        snprintf(input[n++].what, sizeof(input->what), "camera %s: feedback_line", c->camera[i].name);
    }
    if (!of_cameras && c->trigger.button_line != CONFIG_NONE) {
        t->button = n;
        input[n] = (struct lines_wire){ .line = c->trigger.button_line, .active_low = c->trigger.button_active_low };
        snprintf(input[n++].what, sizeof(input->what), "trigger: button_line");
    }
    return n;
}

int trigger_lines_open(struct trigger_lines **out, const struct config *config, const struct trigger_host *host,
    const struct lines_ops *ops, bool of_cameras)
{
    struct lines_wire input[CONFIG_CAMERAS_MAX + 1];
    pthread_condattr_t monotonic;
    struct trigger_lines *t = calloc(1, sizeof(*t));
    int err;
    *out = NULL;
    if (!t)
        return -ENOMEM;
    *t = (struct trigger_lines){ .config = config, .host = host, .ops = ops, .epoll_fd = -1, .event_fd = -1, .timer_fd = -1,
        .guard_fd = -1, .button = CONFIG_NONE };
    pthread_condattr_init(&monotonic);
    pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
    pthread_cond_init(&t->wake, &monotonic);
    pthread_mutex_init(&t->lock, NULL);
    t->locks = true;
    t->shared = mmap(NULL, sizeof(*t->shared), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (t->shared == MAP_FAILED) {
        t->shared = NULL;
        err = -ENOMEM;
        goto fail;
    }
    err = edges_init(&t->edges, config, of_cameras, t->shared->limit_ns);
    if (err)
        goto fail;
    t->n_inputs = want_inputs(t, input, of_cameras);
    const struct lines_wanted wanted = { t->edges.n_wires, t->n_inputs, t->edges.line, input };
    err = ops->open(&t->lines, config, &wanted);
    if (err)
        goto fail;
    t->button_down = t->button != CONFIG_NONE && ops->level(t->lines, t->button) > 0;
    if (ops->guarded && (err = guard_start(t)))
        goto fail;
    t->epoll_fd = epoll_create1(EPOLL_CLOEXEC);
    t->event_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    t->timer_fd = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC | TFD_NONBLOCK);
    if (t->epoll_fd < 0 || t->event_fd < 0 || t->timer_fd < 0 || (err = watch(t, t->event_fd)) || (err = watch(t, t->timer_fd)) ||
        (err = watch(t, t->guard_fd)) || (err = watch(t, ops->fd(t->lines)))) {
        err = err ? err : -errno;
        log_error("trigger: cannot watch the lines: %s", strerror(-err));
        goto fail;
    }
    err = -pthread_create(&t->thread, NULL, run, t);
    if (err) {
        log_error("trigger: cannot start the thread of the lines: %s", strerror(-err));
        goto fail;
    }
    t->started = true;
    *out = t;
    return 0;
fail:
    trigger_lines_close(t);
    return err;
}

void trigger_lines_close(void *self)
{
    struct trigger_lines *t = self;
    if (!t)
        return;
    if (t->started) {
        pthread_mutex_lock(&t->lock);
        all_off(t, true);
        t->quit = true;
        pthread_cond_signal(&t->wake);
        pthread_mutex_unlock(&t->lock);
        pthread_join(t->thread, NULL);
    }
    guard_stop(t); // before the lines: they are free when nobody holds them
    if (t->lines)
        t->ops->close(t->lines);
    const int fd[] = { t->epoll_fd, t->event_fd, t->timer_fd };
    for (size_t i = 0; i < sizeof(fd) / sizeof(fd[0]); i++)
        if (fd[i] >= 0)
            close(fd[i]);
    if (t->shared)
        munmap(t->shared, sizeof(*t->shared));
    if (t->locks) {
        pthread_mutex_destroy(&t->lock);
        pthread_cond_destroy(&t->wake);
    }
    free(t);
}
