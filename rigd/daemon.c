// rigd/daemon.c - the loop around the rig: workers, timers, the disk's threads, the trigger, clients, systemd.
//
// One thread does everything but touch the disk; a second one does that, job after job, so that a slow fsync holds up no camera; a third
// answers what clients ask of takes that are over, so that hashing one of gigabytes (export) holds up no take. After
// each event the rig's actions are carried out and its next deadline is set (look_at_rig). Decisions are the rig's, not made here.
#include <systemd/sd-daemon.h>
#include <systemd/sd-event.h>
#include <systemd/sd-journal.h>
#undef LOG_DEBUG // syslog.h's macros would hide log.h's levels
#undef LOG_INFO
#undef LOG_WARNING

#include "rigd/daemon.h"
#include "rigd/changes.h"
#include "rigd/control.h"
#include "rigd/describe.h"
#include "rigd/doctor.h"
#include "rigd/manifest.h"
#include "rigd/products.h"
#include "rigd/rig.h"
#include "rigd/web.h"
#include "rigd/workshop.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <ctype.h>
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/statvfs.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define S INT64_C(1000000000)
enum { TRIGGER_RETRY_S = 5, WORKERS_END_MS = 1500, BLINK_MS = 5000, WAITERS_MAX = 64 };

struct daemon;

struct worker {
    struct daemon *daemon;
    int camera, fd;
    pid_t pid; // 0: none
    sd_event_source *io, *child;
};

struct job;

// A thread that touches the disk, and what it is to do.
struct lane {
    struct daemon *daemon;
    struct job *todo;
    pthread_t thread;
    pthread_cond_t wake;
    bool runs, ends;
};

// Work for one of them. work runs there and touches nothing but its job; done runs in the loop.
struct job {
    void (*work)(struct job *job);
    void (*done)(struct daemon *d, struct job *job);
    struct job *next;
    int err;
    int64_t value;
    char dir[600], id[96]; // of the take, or of all takes
    char *text;
    const struct config *config; // does not change
    enum ledger_kind kind;
    struct ledger ledger;
    struct processing_record *record;
    struct manifest_known *known;
    int n_known;
    char (*paths)[64];
    char (*hashes)[33];
    uint64_t token;
    int newest; // so many takes
};

// Somebody waits for what becomes of a take.
struct waiter {
    uint64_t token; // 0: free
    char take[96];
    bool added, preview; // preview: until that is there, not for all
};

struct daemon {
    struct config config;
    char takes_dir[300], worker_path[PATH_MAX];
    char panorama_take[96]; // the newest there is; ""
    bool once, once_started, to_journal, stopping;
    int exit_code;
    struct rig *rig;
    struct control *control;
    struct trigger *trigger;
    struct trigger_host host; // borrowed by the trigger
    const char *trigger_word;
    struct worker *worker;
    sd_event *event;
    sd_event_source *timer, *trigger_io, *trigger_timer, *changes_timer;
    struct changes *changes;
    int64_t changes_ns; // when they were last told
    struct web *web;    // NULL: no page
    struct counters counters;
    int64_t take_began_ns;
    // requests that are answered later
    uint64_t take_token, preflight_token, lag_token, identify_token[CONFIG_CAMERAS_MAX];
    // takes to be finished
    char (*unfinished)[96];
    int n_unfinished;
    uint64_t resume_token; // of the first
    bool resuming;
    // what is made of takes
    struct workshop *workshop;
    struct waiter waiter[WAITERS_MAX];
    char once_take[96];
    // disk
    struct lane takes, answers; // what the rig waits for | what clients do
    pthread_mutex_t lock;       // of the lanes and what is finished
    struct job *finished;
    int finished_fd;
    int n_exports;              // under way
};

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * S + t.tv_nsec;
}

static int64_t utc_ms(void)
{
    struct timespec t;
    clock_gettime(CLOCK_REALTIME, &t);
    return (int64_t)t.tv_sec * 1000 + t.tv_nsec / 1000000;
}

// ---- the disk's threads ----------------------------------------------------------------------------------------------------------

static void job_free(struct job *j)
{
    free(j->text);
    free(j->known);
    free(j->paths);
    free(j->hashes);
    free(j->record);
    ledger_free(&j->ledger);
    free(j);
}

static struct job *take_job(struct lane *l)
{
    struct job *j;
    pthread_mutex_lock(&l->daemon->lock);
    while (!l->todo && !l->ends)
        pthread_cond_wait(&l->wake, &l->daemon->lock);
    j = l->todo;
    if (j)
        l->todo = j->next;
    pthread_mutex_unlock(&l->daemon->lock);
    return j;
}

static void *disk_thread(void *arg)
{
    struct lane *l = arg;
    struct daemon *d = l->daemon;
    for (struct job *j; (j = take_job(l));) {
        const uint64_t one = 1;
        j->next = NULL;
        j->work(j);
        pthread_mutex_lock(&d->lock);
        struct job **end = &d->finished;
        while (*end)
            end = &(*end)->next;
        *end = j;
        pthread_mutex_unlock(&d->lock);
        if (write(d->finished_fd, &one, sizeof(one)) < 0)
            break; // the loop is gone
    }
    return NULL;
}

static struct job *new_job(void (*work)(struct job *), void (*done)(struct daemon *, struct job *))
{
    struct job *j = calloc(1, sizeof(*j));
    if (!j)
        abort(); // systemd starts us again, and the takes are resumed
    j->work = work;
    j->done = done;
    return j;
}

static void give_to(struct lane *l, struct job *j)
{
    pthread_mutex_lock(&l->daemon->lock);
    struct job **end = &l->todo;
    while (*end)
        end = &(*end)->next;
    *end = j;
    pthread_cond_signal(&l->wake);
    pthread_mutex_unlock(&l->daemon->lock);
}

static void give(struct daemon *d, struct job *j)
{
    give_to(&d->takes, j);
}

static int begin_lane(struct daemon *d, struct lane *l)
{
    l->daemon = d;
    pthread_cond_init(&l->wake, NULL);
    const int err = -pthread_create(&l->thread, NULL, disk_thread, l);
    l->runs = !err;
    return err;
}

static void end_lane(struct daemon *d, struct lane *l)
{
    if (!l->runs)
        return;
    pthread_mutex_lock(&d->lock);
    l->ends = true; // after what it has to do
    pthread_cond_signal(&l->wake);
    pthread_mutex_unlock(&d->lock);
    pthread_join(l->thread, NULL);
}

static int on_finished(sd_event_source *source, int fd, uint32_t events, void *arg)
{
    struct daemon *d = arg;
    uint64_t n;
    (void)source, (void)events;
    if (read(fd, &n, sizeof(n)) < 0)
        return 0;
    pthread_mutex_lock(&d->lock);
    struct job *list = d->finished;
    d->finished = NULL;
    pthread_mutex_unlock(&d->lock);
    while (list) {
        struct job *next = list->next;
        list->done(d, list);
        job_free(list);
        list = next;
    }
    return 0;
}

static void work_space(struct job *j)
{
    struct statvfs s;
    j->err = make_directories(j->dir);
    if (!j->err && statvfs(j->dir, &s))
        j->err = -errno;
    j->value = j->err ? j->err : s.f_bavail > (uint64_t)INT64_MAX / s.f_frsize ? INT64_MAX : (int64_t)(s.f_bavail * s.f_frsize);
}

static void done_space(struct daemon *d, struct job *j)
{
    rig_space(d->rig, now_ns(), j->value);
}

static void work_create(struct job *j)
{
    j->err = j->text ? ledger_create(j->text, j->kind, j->id, j->dir) : -ENOMEM;
}

static void work_commit(struct job *j)
{
    j->err = j->text ? ledger_commit(j->text, j->dir) : -ENOMEM;
}

static void done_commit(struct daemon *d, struct job *j)
{
    rig_committed(d->rig, now_ns(), j->err);
}

static int write_plan(const char *dir, const char *text)
{
    struct atomic_file f;
    char path[700];
    snprintf(path, sizeof(path), "%s/panorama/panorama.json", dir);
    const int err = atomic_file_open(&f, path);
    if (err)
        return err;
    fprintf(f.stream, "%s\n", text); // commit looks at ferror
    return atomic_file_commit(&f);
}

static void work_manifest(struct job *j)
{
    int n_removed = 0;
    ledger_remove_parts(j->dir, &n_removed); // of workers that died: all copying is over
    if (j->text)
        j->err = write_plan(j->dir, j->text);
    if (!j->err)
        j->err = manifest_write(j->dir, j->known, j->n_known, j->value);
}

static void done_manifest(struct daemon *d, struct job *j)
{
    rig_manifest_written(d->rig, now_ns(), j->err);
}

static void take_dir(const struct daemon *d, const char *id, char *out, size_t room)
{
    snprintf(out, room, "%s/%s", d->takes_dir, id);
}

static void know_copies(struct job *j, const struct ledger *l)
{
    int n = 0;
    for (int i = 0; i < l->n_cameras; i++)
        n += l->camera[i].n_objects;
    j->known = calloc((size_t)n + 1, sizeof(*j->known));
    j->paths = calloc((size_t)n + 1, sizeof(*j->paths));
    j->hashes = calloc((size_t)n + 1, sizeof(*j->hashes));
    for (int i = 0; j->known && j->paths && j->hashes && i < l->n_cameras; i++)
        for (int k = 0; k < l->camera[i].n_objects; k++) {
            const struct ledger_object *o = &l->camera[i].object[k];
            if (o->state != OBJECT_COPIED && o->state != OBJECT_DELETED)
                continue;
            memcpy(j->paths[j->n_known], o->file, sizeof(o->file));
            memcpy(j->hashes[j->n_known], o->xxh128, sizeof(o->xxh128));
            j->known[j->n_known] = (struct manifest_known){ j->paths[j->n_known], j->hashes[j->n_known], o->object.size_bytes };
            j->n_known++;
        }
}

// ---- telling people -----------------------------------------------------------------------------------------------------------------

static void to_journal(void *arg, enum log_level level, const char *message)
{
    static const int priorities[] = { 7, 6, 4, 3 };
    (void)arg;
    if (level >= LOG_INFO && level < LOG_SILENT)
        sd_journal_send("MESSAGE=%s", message, "PRIORITY=%d", priorities[level], "SYSLOG_IDENTIFIER=rigd", NULL);
}

static void tell(struct daemon *d, const struct rig_action *a)
{
    static const char *const words[] = { "info", "warning", "error" };
    static const enum log_level levels[] = { LOG_INFO, LOG_WARNING, LOG_ERROR };
    static const int priorities[] = { 6, 4, 3 };
    const struct config_camera *c = a->camera == CONFIG_NONE ? NULL : &d->config.camera[a->camera];
    const struct ledger *l = rig_ledger(d->rig);
    if (d->to_journal)
        sd_journal_send("MESSAGE=%s", a->text, "PRIORITY=%d", priorities[a->severity], "SYSLOG_IDENTIFIER=rigd", "RIGD_CAMERA=%s", c ? c->name : "", "RIGD_SLOT=%s", c ? c->port : "",
                        "RIGD_TAKE=%s", l && rig_is_busy(d->rig) ? l->id : "", NULL);
    else
        log_line(levels[a->severity], "rig: %s", a->text);
    struct json *o = json_new_object();
    json_set_string(o, "severity", words[a->severity]);
    if (c) {
        json_set_string(o, "camera", c->name);
        json_set_string(o, "port", c->port);
    }
    json_set_string(o, "text", a->text);
    control_publish(d->control, "say", o);
    if (a->severity == RIG_ERROR && c && strstr(a->text, "quarantined"))
        d->counters.n_quarantines++;
}

// ---- workers ----------------------------------------------------------------------------------------------------------------------------

static void forget_worker(struct worker *w)
{
    w->io = sd_event_source_disable_unref(w->io);
    w->child = sd_event_source_disable_unref(w->child);
    if (w->fd >= 0)
        close(w->fd);
    w->fd = -1;
    w->pid = 0;
}

// What a worker has said and nobody has read yet. A worker that talks nonsense is killed.
static void hear(struct worker *w)
{
    static char packet[CAMERA_MESSAGE_MAX + 1];
    struct daemon *d = w->daemon;
    while (w->fd >= 0) {
        const ssize_t n = recv(w->fd, packet, sizeof(packet), MSG_DONTWAIT | MSG_TRUNC);
        struct camera_event e;
        if (n <= 0) {
            if (n == 0) // its end is closed: its exit follows
                w->io = sd_event_source_disable_unref(w->io);
            return;
        }
        if (n > CAMERA_MESSAGE_MAX || camera_event_decode(&e, packet, (size_t)n)) {
            log_error("camera %s: its worker sent %zd bytes that are no message; killed", d->config.camera[w->camera].name, n);
            kill(w->pid, SIGKILL);
            w->io = sd_event_source_disable_unref(w->io);
            return;
        }
        rig_camera_event(d->rig, now_ns(), w->camera, &e);
    }
}

static int on_worker(sd_event_source *source, int fd, uint32_t events, void *arg)
{
    (void)source, (void)fd, (void)events;
    hear(arg);
    return 0;
}

static int on_worker_end(sd_event_source *source, const siginfo_t *si, void *arg)
{
    struct worker *w = arg;
    char how[80];
    (void)source;
    hear(w); // a copy that was finished with its last breath
    if (si->si_code == CLD_EXITED)
        snprintf(how, sizeof(how), "exit %d", si->si_status);
    else
        snprintf(how, sizeof(how), "%s", strsignal(si->si_status));
    forget_worker(w);
    rig_worker_gone(w->daemon->rig, now_ns(), w->camera, how);
    return 0;
}

static int spawn_worker(struct daemon *d, struct worker *w)
{
    int fd[2], err;
    posix_spawn_file_actions_t files;
    posix_spawnattr_t attributes;
    sigset_t none, all;
    char title[60]; // what ps shows
    char *argv[] = { title, NULL };
    if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, fd))
        return -errno;
    snprintf(title, sizeof(title), "rigd-camera %s", d->config.camera[w->camera].name);
    const int room = 2 * CAMERA_MESSAGE_MAX;
    setsockopt(fd[0], SOL_SOCKET, SO_SNDBUF, &room, sizeof(room));
    setsockopt(fd[1], SOL_SOCKET, SO_SNDBUF, &room, sizeof(room));
    sigemptyset(&none);
    sigfillset(&all);
    posix_spawn_file_actions_init(&files);
    posix_spawnattr_init(&attributes);
    posix_spawn_file_actions_adddup2(&files, fd[1], CAMERA_FD);
    posix_spawn_file_actions_addclosefrom_np(&files, CAMERA_FD + 1);
    posix_spawnattr_setsigmask(&attributes, &none);
    posix_spawnattr_setsigdefault(&attributes, &all);
    posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETSIGMASK | POSIX_SPAWN_SETSIGDEF);
    err = -posix_spawn(&w->pid, d->worker_path, &files, &attributes, argv, environ);
    posix_spawnattr_destroy(&attributes);
    posix_spawn_file_actions_destroy(&files);
    close(fd[1]);
    if (err) {
        w->pid = 0;
        close(fd[0]);
        return err;
    }
    w->fd = fd[0];
    err = sd_event_add_io(d->event, &w->io, w->fd, EPOLLIN, on_worker, w);
    if (err >= 0)
        err = sd_event_add_child(d->event, &w->child, w->pid, WEXITED, on_worker_end, w);
    if (err < 0) {
        kill(w->pid, SIGKILL);
        waitpid(w->pid, NULL, 0);
        forget_worker(w);
        return err;
    }
    return 0;
}

static void start_worker(struct daemon *d, int camera)
{
    char how[80];
    const int err = spawn_worker(d, &d->worker[camera]);
    if (!err)
        return;
    log_error("cannot start %s: %s", d->worker_path, strerror(-err));
    snprintf(how, sizeof(how), "cannot start: %.60s", strerror(-err));
    rig_worker_gone(d->rig, now_ns(), camera, how);
}

static void send_command(struct daemon *d, int camera, const struct camera_command *c)
{
    struct worker *w = &d->worker[camera];
    size_t n;
    char *text = camera_command_encode(c, &n);
    if (w->fd < 0 || !text || send(w->fd, text, n, MSG_DONTWAIT | MSG_NOSIGNAL) != (ssize_t)n) {
        log_warning("camera %s: its worker does not take commands; killed", d->config.camera[camera].name);
        if (w->pid > 0)
            kill(w->pid, SIGKILL);
    }
    free(text);
}

// The kernel's own switch of a hub's port (Linux 6.0 and later), where the hub has one.
static void switch_power(struct daemon *d, int camera, bool on)
{
    const char *power = d->config.camera[camera].power, *colon = strchr(power, ':');
    char path[300];
    if (!colon)
        return;
    const int n = (int)(colon - power);
    snprintf(path, sizeof(path), "/sys/bus/usb/devices/%.*s:1.0/%.*s-port%s/disable", n, power, n, power, colon + 1);
    const int fd = open(path, O_WRONLY | O_CLOEXEC);
    if (fd < 0 || write(fd, on ? "0" : "1", 1) != 1)
        log_warning("cannot switch %s: %s; this hub or kernel cannot, or rigd may not", path, strerror(errno));
    if (fd >= 0)
        close(fd);
}

// ---- trigger -------------------------------------------------------------------------------------------------------------------------------

static void on_fired(void *arg, int err, int64_t pressed_ns, int64_t late_ns)
{
    struct daemon *d = arg;
    rig_fired(d->rig, now_ns(), err, pressed_ns, late_ns);
}

static void on_feedback(void *arg, int camera, int64_t at_ns)
{
    struct daemon *d = arg;
    rig_feedback(d->rig, now_ns(), camera, at_ns);
}

static void on_press_camera(void *arg, int camera)
{
    struct daemon *d = arg;
    rig_press_camera(d->rig, now_ns(), camera);
}

static int capture(struct daemon *d, const char *name, bool without_missing, char *why);

static void on_button(void *arg, int64_t at_ns)
{
    struct daemon *d = arg;
    char why[200];
    (void)at_ns;
    if (capture(d, "button", false, why))
        log_warning("the button was pressed: %s", why);
}

static void on_trigger_broken(void *arg, int err)
{
    struct daemon *d = arg;
    log_error("the trigger is gone: %s; it is opened again every %d s", strerror(-err), TRIGGER_RETRY_S);
    rig_trigger_is(d->rig, now_ns(), -1);
    d->trigger_word = "broken";
    sd_event_source_set_time_relative(d->trigger_timer, 100000); // not from within its own dispatch
    sd_event_source_set_enabled(d->trigger_timer, SD_EVENT_ONESHOT);
}

static void on_head_arrived(void *arg, int err)
{
    struct daemon *d = arg;
    rig_head_arrived(d->rig, now_ns(), err);
}

static int on_trigger(sd_event_source *source, int fd, uint32_t events, void *arg)
{
    struct daemon *d = arg;
    (void)source, (void)fd, (void)events;
    trigger_dispatch(d->trigger);
    return 0;
}

static int open_the_trigger(sd_event_source *source, uint64_t usec, void *arg)
{
    struct daemon *d = arg;
    static const char *const kinds[] = { "software (unsynchronised)", "gpio", "usb", "simulated" };
    (void)usec;
    d->host = (struct trigger_host){ .fired = on_fired, .feedback = on_feedback, .button = on_button, .press_camera = on_press_camera,
                                      .broken = on_trigger_broken, .head_arrived = on_head_arrived, .arg = d };
    d->trigger_io = sd_event_source_disable_unref(d->trigger_io);
    trigger_close(d->trigger);
    d->trigger = NULL;
    int err = trigger_open(&d->trigger, &d->config, &d->host);
    if (!err)
        err = sd_event_add_io(d->event, &d->trigger_io, trigger_fd(d->trigger), EPOLLIN, on_trigger, d);
    d->trigger_word = err < 0 ? "not there" : kinds[d->config.trigger.kind];
    rig_trigger_is(d->rig, now_ns(), err < 0 ? -1 : (int)trigger_abilities(d->trigger));
    if (err < 0) {
        sd_event_source_set_time_relative(source, TRIGGER_RETRY_S * 1000000);
        sd_event_source_set_enabled(source, SD_EVENT_ONESHOT);
    }
    return 0;
}

static void fire(struct daemon *d, const struct trigger_shot *shot)
{
    int err = d->trigger ? trigger_fire(d->trigger, shot) : -ENODEV;
    if (err == -EIO)
        err = -ENODEV; // refused: nothing was pressed
    if (err)
        rig_fired(d->rig, now_ns(), err, 0, 0);
}

// ---- takes ---------------------------------------------------------------------------------------------------------------------------------

static int begin_take(struct daemon *d, enum ledger_kind kind, const char *name, bool without_missing, bool on_button, char *why)
{
    char plain[41], id[96], created[40], stamp[40];
    const int64_t utc = utc_ms();
    const time_t t = (time_t)(utc / 1000);
    struct tm tm;
    size_t n = 0;
    if (d->n_unfinished) { // whoever asks, the button too: its ledger is being read, and the next take done is that one
        snprintf(why, 200, "an unfinished take is being collected; wait for it");
        return -EBUSY;
    }
    for (; name[n] && n < sizeof(plain) - 1; n++)
        plain[n] = isalnum((unsigned char)name[n]) && (unsigned char)name[n] < 0x80 ? name[n] : '-';
    plain[n] = 0;
    gmtime_r(&t, &tm);
    strftime(created, sizeof(created), "%Y-%m-%dT%H:%M:%SZ", &tm);
    strftime(stamp, sizeof(stamp), "%Y%m%dT%H%M%S", &tm);
    snprintf(id, sizeof(id), "%s%03d_%s", stamp, (int)(utc % 1000), plain);
    const struct rig_take take = { .id = id, .name = plain, .created = created, .utc_ms = utc, .takes_dir = d->takes_dir,
                                   .panorama_take = kind == LEDGER_CAPTURE ? d->panorama_take : NULL, .on_button = on_button };
    const int err = kind == LEDGER_PANORAMA ? rig_panorama(d->rig, now_ns(), &take, why) : rig_capture(d->rig, now_ns(), &take, without_missing, why);
    if (!err)
        d->take_began_ns = now_ns();
    return err;
}

static int capture(struct daemon *d, const char *name, bool without_missing, char *why)
{
    return begin_take(d, LEDGER_CAPTURE, name, without_missing, false, why);
}

// Ids begin with their time.
static void know_panorama(struct daemon *d, const struct ledger *l)
{
    if (l->kind == LEDGER_PANORAMA && (l->state == TAKE_VERIFIED || l->state == TAKE_DEVELOPED || l->state == TAKE_SOLVED) && strcmp(l->id, d->panorama_take) > 0)
        snprintf(d->panorama_take, sizeof(d->panorama_take), "%s", l->id);
}

static void count_take(struct daemon *d, const struct ledger *l)
{
    d->counters.n_takes++;
    d->counters.n_verified += l->state == TAKE_VERIFIED;
    d->counters.n_failed += l->state == TAKE_FAILED;
    d->counters.last_take_s = 1e-9 * (double)(now_ns() - d->take_began_ns);
    for (int i = 0; i < l->n_cameras; i++)
        for (int k = 0; k < l->camera[i].n_objects; k++)
            if (l->camera[i].object[k].state == OBJECT_COPIED || l->camera[i].object[k].state == OBJECT_DELETED) {
                d->counters.n_frames++;
                d->counters.n_bytes += l->camera[i].object[k].object.size_bytes;
            }
}

static void next_unfinished(struct daemon *d)
{
    memmove(d->unfinished, d->unfinished + 1, (size_t)--d->n_unfinished * sizeof(*d->unfinished));
    d->resuming = false;
    d->resume_token = 0;
}

static void take_is_done(struct daemon *d)
{
    const struct ledger *l = rig_ledger(d->rig);
    struct json *report = describe_take(l, false);
    const double seconds = 1e-9 * (double)(now_ns() - d->take_began_ns);
    count_take(d, l);
    know_panorama(d, l);
    json_set_number(report, "seconds", seconds);
    log_info("take %s: %s after %.2f s%s%s", l->id, take_state_name(l->state), seconds, l->reason[0] ? ": " : "", l->reason);
    control_reply(d->control, d->resuming ? d->resume_token : d->take_token, report);
    struct json *ended = describe_take(l, false);
    json_set_number(ended, "seconds", seconds);
    control_publish(d->control, "take", ended);
    const bool goes_on = l->state == TAKE_VERIFIED && d->config.process.develop;
    if (goes_on)
        workshop_add(d->workshop, l->id, &(struct workshop_request){ .again = -1 });
    if (d->resuming) {
        next_unfinished(d);
        return;
    }
    d->take_token = 0;
    if (d->once && goes_on) {
        snprintf(d->once_take, sizeof(d->once_take), "%s", l->id); // ends when that is settled
    } else if (d->once) {
        d->exit_code = l->state == TAKE_VERIFIED ? 0 : 1;
        sd_event_exit(d->event, 0);
    }
}

static void work_reconcile(struct job *j)
{
    struct ledger_findings found;
    char path[700];
    snprintf(path, sizeof(path), "%s/%s", j->dir, j->id);
    j->err = ledger_read(&j->ledger, path);
    if (!j->err)
        j->err = ledger_reconcile(&j->ledger, path, &found);
    if (!j->err)
        j->err = ledger_bound(&j->ledger, j->dir);
    if (!j->err && (found.n_adopted || found.n_taken_back || found.n_parts_removed))
        log_info("take %s: %d copies adopted, %d taken back, %d leftovers removed", j->id, found.n_adopted, found.n_taken_back, found.n_parts_removed);
}

static void done_reconcile(struct daemon *d, struct job *j)
{
    char why[200] = "";
    int err = j->err;
    const bool is_final = j->ledger.state == TAKE_VERIFIED || j->ledger.state == TAKE_DEVELOPED || j->ledger.state == TAKE_SOLVED;
    if (!err && is_final && ledger_is_whole(&j->ledger)) { // nothing is missing: its state stays what it is
        control_reply(d->control, d->resume_token, describe_take(&j->ledger, false));
        next_unfinished(d);
        return;
    }
    if (err)
        snprintf(why, sizeof(why), "its ledger or its frames cannot be read: %s; see the journal", strerror(-err));
    else
        err = rig_resume(d->rig, now_ns(), &j->ledger, d->takes_dir, d->resume_token != 0, why);
    if (err == -EBUSY) {
        d->resuming = false; // a take came between: later
        return;
    }
    if (!err)
        return;
    log_error("take %s cannot be resumed: %s", j->id, why);
    control_refuse(d->control, d->resume_token, "cannot_resume", why);
    next_unfinished(d);
}

static bool cameras_settle(const struct daemon *d)
{
    for (int i = 0; i < d->config.n_cameras; i++) {
        const enum rig_condition c = rig_camera(d->rig, i).condition;
        if (c != RIG_READY && c != RIG_QUARANTINED)
            return false;
    }
    return true;
}

// With nothing else to do: finish what an earlier life left, one take after the other; then --once takes its picture.
static void look_for_work(struct daemon *d)
{
    if (d->resuming || d->stopping || rig_is_busy(d->rig) || !cameras_settle(d))
        return;
    if (d->n_unfinished) {
        struct job *j = new_job(work_reconcile, done_reconcile);
        d->resuming = true;
        d->take_began_ns = now_ns();
        snprintf(j->dir, sizeof(j->dir), "%s", d->takes_dir);
        snprintf(j->id, sizeof(j->id), "%s", d->unfinished[0]);
        log_info("take %s: looking for frames that are not here yet", j->id);
        give(d, j);
    } else if (d->once && !d->once_started) {
        char why[200];
        d->once_started = true;
        if (capture(d, "once", false, why)) {
            log_error("%s", why);
            d->exit_code = 1;
            sd_event_exit(d->event, 0);
        }
    }
}

static bool add_unfinished(struct daemon *d, const char *id)
{
    void *grown = realloc(d->unfinished, ((size_t)d->n_unfinished + 1) * sizeof(*d->unfinished));
    if (!grown)
        return false;
    d->unfinished = grown;
    snprintf(d->unfinished[d->n_unfinished++], sizeof(*d->unfinished), "%s", id);
    return true;
}

// Takes of an earlier life: whose frames are not all here, and whose processing is owed.
static void find_unfinished(struct daemon *d)
{
    struct dirent **entries = NULL;
    const int n = scandir(d->takes_dir, &entries, NULL, alphasort);
    for (int i = 0; i < n; i++) {
        char path[700];
        struct ledger l;
        take_dir(d, entries[i]->d_name, path, sizeof(path));
        if (entries[i]->d_name[0] != '.' && !ledger_read(&l, path)) {
            know_panorama(d, &l);
            if (l.state != TAKE_VERIFIED && l.state != TAKE_DEVELOPED && l.state != TAKE_SOLVED && l.state != TAKE_FAILED && !strcmp(l.id, entries[i]->d_name))
                add_unfinished(d, l.id);
            else if (l.processing == LEDGER_OWED && l.state != TAKE_FAILED && !strcmp(l.id, entries[i]->d_name))
                workshop_add(d->workshop, l.id, &(struct workshop_request){ .again = -1 });
            ledger_free(&l);
        }
        free(entries[i]);
    }
    free(entries);
}

// ---- lag ---------------------------------------------------------------------------------------------------------------------------------

static void lag_path(const struct daemon *d, char *out, size_t room)
{
    snprintf(out, room, "%s/lag.json", d->config.state_dir);
}

static void keep_lag(struct daemon *d)
{
    char path[400], when[40];
    const time_t t = time(NULL);
    struct tm tm;
    const char *serial[CONFIG_CAMERAS_MAX];
    struct lag lag[CONFIG_CAMERAS_MAX];
    for (int i = 0; i < d->config.n_cameras; i++) {
        const struct rig_camera_view v = rig_camera(d->rig, i);
        serial[i] = v.facts->serial;
        lag[i] = v.lag;
    }
    gmtime_r(&t, &tm);
    strftime(when, sizeof(when), "%Y-%m-%dT%H:%M:%SZ", &tm);
    lag_path(d, path, sizeof(path));
    if (!rig_outcome(d->rig)[0] && !make_directories(d->config.state_dir))
        lag_write(path, &d->config, serial, lag, when); // says what is wrong itself
    control_reply(d->control, d->lag_token, describe_lag(d->rig, &d->config));
    d->lag_token = 0;
}

// ---- what is made of takes --------------------------------------------------------------------------------------------------------------

static void work_record(struct job *j)
{
    char path[700];
    snprintf(path, sizeof(path), "%s/%s", j->dir, j->id);
    j->err = products_record(path, j->record);
    if (!j->err)
        j->err = ledger_read(&j->ledger, path);
}

static void done_record(struct daemon *d, struct job *j)
{
    if (!j->err)
        control_publish(d->control, "take", describe_take(&j->ledger, false));
    workshop_recorded(d->workshop, j->id, j->err);
}

static void on_record(void *arg, const char *take, const struct processing_record *record)
{
    struct daemon *d = arg;
    struct job *j = new_job(work_record, done_record);
    j->record = malloc(sizeof(*j->record));
    if (!j->record)
        abort();
    *j->record = *record;
    snprintf(j->dir, sizeof(j->dir), "%s", d->takes_dir);
    snprintf(j->id, sizeof(j->id), "%s", take);
    give(d, j);
}

static bool preview_is_there(struct daemon *d, const char *take)
{
    struct json *o = workshop_describe(d->workshop, take);
    bool there = false;
    for (int i = 0; i < json_length(o, "steps"); i++) {
        char key[40];
        const char *step = "", *state = "";
        snprintf(key, sizeof(key), "steps.%d.step", i);
        json_get_string(o, key, &step);
        snprintf(key, sizeof(key), "steps.%d.state", i);
        json_get_string(o, key, &state);
        if (!strcmp(step, "preview"))
            there = !strcmp(state, "done") || !strcmp(state, "failed") || !strcmp(state, "missing") || !strcmp(state, "cancelled");
    }
    json_free(o);
    return there;
}

static struct json *describe_made(struct daemon *d, const char *take)
{
    char path[700];
    struct json *o = workshop_describe(d->workshop, take);
    if (!o)
        o = json_new_object();
    take_dir(d, take, path, sizeof(path));
    json_set_string(o, "path", path);
    return o;
}

static void answer_waiters(struct daemon *d)
{
    for (int i = 0; i < WAITERS_MAX; i++) {
        struct waiter *w = &d->waiter[i];
        if (!w->token || !w->added || !(workshop_is_settled(d->workshop, w->take) || (w->preview && preview_is_there(d, w->take))))
            continue;
        control_reply(d->control, w->token, describe_made(d, w->take));
        w->token = 0;
    }
}

static void on_changed(void *arg, const char *take, enum processing_step step)
{
    struct daemon *d = arg;
    struct json *o = workshop_describe(d->workshop, take), *body = json_new_object();
    for (int i = 0; i < json_length(o, "steps"); i++) {
        char key[40];
        const char *name = "";
        struct json *copy = NULL;
        snprintf(key, sizeof(key), "steps.%d", i);
        const struct json *s = json_get(o, key);
        json_get_string(s, "step", &name);
        char *text = strcmp(name, processing_step_name(step)) ? NULL : json_text(s);
        if (text && !json_parse(&copy, text, strlen(text), NULL))
            json_set(body, "step", copy);
        free(text);
    }
    json_set_string(body, "take", take);
    control_publish(d->control, "processing", body);
    json_free(o);
}

static void on_progress(void *arg, const char *take, enum processing_step step, const char *line)
{
    struct daemon *d = arg;
    struct json *body = NULL;
    if (json_parse(&body, line, strlen(line), NULL))
        return;
    json_set_string(body, "take", take);
    json_set_string(body, "step", processing_step_name(step));
    control_publish(d->control, "progress", body);
}

static void on_settled(void *arg, const char *take)
{
    struct daemon *d = arg;
    struct json *o = describe_made(d, take);
    log_info("take %s: settled", take);
    for (int i = 0; i < json_length(o, "steps"); i++) {
        char key[40];
        const char *step = "", *state = "", *text = "";
        snprintf(key, sizeof(key), "steps.%d", i);
        const struct json *s = json_get(o, key);
        json_get_string(s, "step", &step);
        json_get_string(s, "state", &state);
        json_get_string(s, "text", &text);
        if (!strcmp(state, "failed") || !strcmp(state, "missing"))
            log_warning("take %s: %s %s: %s", take, step, state, text);
    }
    control_publish(d->control, "settled", o);
    if (d->once && !strcmp(d->once_take, take))
        sd_event_exit(d->event, 0);
}

static void on_added(void *arg, uint64_t token, const char *take, int err, const char *why)
{
    struct daemon *d = arg;
    bool waits = false;
    for (int i = 0; token && i < WAITERS_MAX; i++)
        if (d->waiter[i].token == token) {
            waits = d->waiter[i].added = !err;
            if (err)
                d->waiter[i].token = 0;
        }
    if (err && d->once && !strcmp(d->once_take, take)) { // nothing else will end it
        d->exit_code = 1;
        sd_event_exit(d->event, 0);
    }
    if (err && !token)
        log_error("take %s: cannot be processed: %s", take, why[0] ? why : strerror(-err));
    else if (err)
        control_refuse(d->control, token, err == -EBUSY ? "busy" : "failed", why[0] ? why : strerror(-err));
    else if (token && !waits)
        control_reply(d->control, token, describe_made(d, take));
}

static int on_workshop(sd_event_source *source, int fd, uint32_t events, void *arg)
{
    struct daemon *d = arg;
    (void)source, (void)fd, (void)events;
    workshop_dispatch(d->workshop);
    return 0;
}

// ---- requests ----------------------------------------------------------------------------------------------------------------------------

static void refuse(struct daemon *d, uint64_t token, int err, const char *why)
{
    control_refuse(d->control, token, err == -EBUSY ? "busy" : err == -ENOTCONN ? "no_trigger" : "refused", why);
}

static void ask_capture(struct daemon *d, uint64_t token, const struct json *request)
{
    const char *name = "take";
    bool without_missing = false, on_button = false;
    char why[200];
    json_get_string(request, "name", &name);
    json_get_bool(request, "without_missing", &without_missing);
    json_get_bool(request, "on_button", &on_button);
    const int err = begin_take(d, LEDGER_CAPTURE, name, without_missing, on_button, why);
    if (err)
        refuse(d, token, err, why);
    else
        d->take_token = token;
}

static void ask_panorama(struct daemon *d, uint64_t token, const struct json *request)
{
    const char *name = "panorama";
    char why[200];
    json_get_string(request, "name", &name);
    const int err = begin_take(d, LEDGER_PANORAMA, name, false, false, why);
    if (err)
        refuse(d, token, err, why);
    else
        d->take_token = token;
}

static void ask_continue(struct daemon *d, uint64_t token, const struct json *request)
{
    char why[200];
    (void)request;
    const int err = rig_continue(d->rig, now_ns(), why);
    if (err)
        refuse(d, token, err, why);
    else
        control_reply(d->control, token, json_new_object());
}

static void ask_preflight(struct daemon *d, uint64_t token, const struct json *request)
{
    char why[200];
    (void)request;
    const int err = rig_preflight(d->rig, now_ns(), why);
    if (err)
        refuse(d, token, err, why);
    else
        d->preflight_token = token;
}

static void ask_calibrate(struct daemon *d, uint64_t token, const struct json *request)
{
    const char *what = "";
    int64_t shots = d->config.calibration_shots;
    char why[200];
    json_get_string(request, "what", &what);
    json_get_int(request, "shots", &shots);
    int err = -EINVAL;
    if (strcmp(what, "lag"))
        snprintf(why, sizeof(why), "found calibrate '%.40s', expected lag", what);
    else
        err = rig_calibrate(d->rig, now_ns(), shots > 0 && shots <= 1000 ? (int)shots : 0, why);
    if (err)
        refuse(d, token, err, why);
    else
        d->lag_token = token;
}

// What exists, for somebody who asked for something else: "a, b, c" or "a, b, ... (n in all)".
static void list_names(char *out, size_t room, const char *const *names, int n)
{
    size_t used = 0;
    out[0] = 0;
    for (int i = 0; i < n && used < room; i++) {
        if (i == 8 && n > 10) {
            snprintf(out + used, room - used, ", ... (%d in all)", n);
            return;
        }
        used += (size_t)snprintf(out + used, room - used, "%s%s", i ? ", " : "", names[i]);
    }
}

// The camera that is asked for, or -1: the request is refused then.
static int camera_named(struct daemon *d, uint64_t token, const struct json *request)
{
    const char *name = "", *names[CONFIG_CAMERAS_MAX];
    char list[400], why[600];
    json_get_string(request, "camera", &name);
    for (int i = 0; i < d->config.n_cameras; i++) {
        names[i] = d->config.camera[i].name;
        if (!strcasecmp(names[i], name))
            return i;
    }
    list_names(list, sizeof(list), names, d->config.n_cameras);
    snprintf(why, sizeof(why), "no camera '%.40s'; there are %s", name, list);
    control_refuse(d->control, token, "no_such_camera", why);
    return -1;
}

static bool is_board(const struct daemon *d, const char *name)
{
    for (int i = 0; i < d->config.n_cameras; i++)
        if (!strcasecmp(d->config.camera[i].name, name))
            return false;
    return !strcasecmp(name, "board");
}

static void identify_board(struct daemon *d, uint64_t token)
{
    const int err = d->trigger ? trigger_identify(d->trigger, BLINK_MS) : -ENOTCONN;
    if (err)
        refuse(d, token, err, err == -ENOTCONN ? "there is no trigger" : err == -ENOTSUP ? "this kind of trigger has no light; a trigger board ([trigger] kind = usb) has" : "the trigger board does not answer");
    else
        control_reply(d->control, token, json_new_object());
}

static void ask_identify(struct daemon *d, uint64_t token, const struct json *request)
{
    const char *name = "";
    char why[200];
    json_get_string(request, "camera", &name);
    if (is_board(d, name)) {
        identify_board(d, token);
        return;
    }
    const int i = camera_named(d, token, request);
    if (i < 0)
        return;
    const int err = d->identify_token[i] ? -EBUSY : rig_identify(d->rig, now_ns(), i, why);
    if (d->identify_token[i])
        snprintf(why, sizeof(why), "it is showing itself already");
    if (err)
        refuse(d, token, err, why);
    else
        d->identify_token[i] = token;
}

static void ask_reinstate(struct daemon *d, uint64_t token, const struct json *request)
{
    char why[200];
    const int i = camera_named(d, token, request);
    if (i < 0)
        return;
    const int err = rig_reinstate(d->rig, now_ns(), i, why);
    if (err)
        refuse(d, token, err, why);
    else
        control_reply(d->control, token, json_new_object());
}

static void ask_cancel(struct daemon *d, uint64_t token, const struct json *request)
{
    char why[200];
    (void)request;
    const int err = rig_cancel(d->rig, now_ns(), why);
    if (err)
        refuse(d, token, err, why);
    else
        control_reply(d->control, token, json_new_object());
}

static struct json *describe_all_but_cameras(struct daemon *d)
{
    struct json *o = describe_rig(d->rig, &d->config, d->trigger_word);
    char refusal[160] = "";
    if (d->n_unfinished)
        snprintf(refusal, sizeof(refusal), "an unfinished take is being collected; wait for it");
    else if (rig_waits_for_button(d->rig))
        snprintf(refusal, sizeof(refusal), "armed: the trigger's button fires; cancel (rigctl cancel) disarms");
    else if (rig_is_busy(d->rig))
        snprintf(refusal, sizeof(refusal), "the rig is busy (%s); wait for it", take_state_name(rig_state(d->rig)));
    else if (!d->trigger)
        snprintf(refusal, sizeof(refusal), "the trigger is %s: check its cable and power; rigctl doctor says more", d->trigger_word);
    if (refusal[0])
        json_set_string(o, "refusal", refusal);
    if (d->trigger && (trigger_abilities(d->trigger) & TRIGGER_BUTTON)) // what pressing it would do now
        json_set_string(o, "button", rig_waits_for_button(d->rig) ? "fires" : refusal[0] ? "refused" : "takes");
    json_set_bool(o, "can_arm", d->trigger && (trigger_abilities(d->trigger) & TRIGGER_WAITS));
    json_set(o, "processing", workshop_describe_all(d->workshop));
    if (d->web)
        json_set_string(o, "page", web_address(d->web));
    return o;
}

static void ask_status(struct daemon *d, uint64_t token, const struct json *request)
{
    struct json *o = describe_all_but_cameras(d);
    (void)request;
    json_set(o, "cameras", describe_cameras(d->rig, &d->config));
    control_reply(d->control, token, o);
}

static void ask_metrics(struct daemon *d, uint64_t token, const struct json *request)
{
    struct json *o = json_new_object();
    char *text = describe_metrics(d->rig, &d->config, &d->counters);
    (void)request;
    json_set_string(o, "text", text ? text : "");
    free(text);
    control_reply(d->control, token, o);
}

// Names the newest takes there are. (Folders are listed by a thread of the disk.)
static void work_no_such_take(struct job *j)
{
    struct dirent **entries = NULL;
    const char *names[3] = { "" };
    char list[900];
    int n_listed = 0, n_all = 0;
    const int n = scandir(j->dir, &entries, NULL, alphasort);
    for (int i = n - 1; i >= 0; i--) {
        n_all += entries[i]->d_name[0] != '.';
        if (entries[i]->d_name[0] != '.' && n_listed < 3)
            names[n_listed++] = entries[i]->d_name;
    }
    list_names(list, sizeof(list), names, n_listed);
    if (asprintf(&j->text, "no take '%.60s' among %d; %s%s%s", j->id, n_all, n_all ? "the newest: " : "there is none yet in ", n_all ? list : j->dir, n_all > 3 ? "; rigctl takes lists all" : "") < 0)
        j->text = NULL;
    for (int i = 0; i < n; i++)
        free(entries[i]);
    free(entries);
}

static void done_no_such_take(struct daemon *d, struct job *j)
{
    control_refuse(d->control, j->token, "no_such_take", j->text ? j->text : "no such take; rigctl takes lists them");
}

// A take's folder in the request, checked: it becomes a path.
static bool take_named(struct daemon *d, uint64_t token, const struct json *request, char id[96])
{
    const char *text = "";
    char path[700];
    json_get_string(request, "take", &text);
    const size_t n = strlen(text);
    if (n && n < 96 && strspn(text, "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_") == n) {
        take_dir(d, text, path, sizeof(path));
        if (!access(path, F_OK)) {
            memcpy(id, text, n + 1);
            return true;
        }
    }
    struct job *j = new_job(work_no_such_take, done_no_such_take);
    j->token = token;
    snprintf(j->dir, sizeof(j->dir), "%s", d->takes_dir);
    snprintf(j->id, sizeof(j->id), "%s", text);
    give_to(&d->answers, j);
    return false;
}

static void ask_resume(struct daemon *d, uint64_t token, const struct json *request)
{
    char id[96];
    if (!take_named(d, token, request, id))
        return;
    if (d->n_unfinished || rig_is_busy(d->rig))
        control_refuse(d->control, token, "busy", "a take is under way; wait for it");
    else if (d->n_exports) // two writers of one manifest
        control_refuse(d->control, token, "busy", "a take is being exported; wait for it");
    else if (add_unfinished(d, id))
        d->resume_token = token;
    else
        control_refuse(d->control, token, "refused", "out of memory");
}

// What only reads the disk is done by its thread, the answer is ready-made.
static void work_takes(struct job *j)
{
    struct json *list = describe_takes(j->dir, j->newest), *o = json_new_object();
    json_set(o, "takes", list ? list : json_new_array());
    j->text = json_text(o);
    json_free(o);
}

static void work_report(struct job *j)
{
    char path[700];
    snprintf(path, sizeof(path), "%s/%s", j->dir, j->id);
    j->err = ledger_read(&j->ledger, path);
    if (j->err)
        return;
    struct json *o = describe_take(&j->ledger, true), *pages = json_new_array();
    json_set_string(o, "path", path);
    for (int i = 0; i < j->ledger.n_solves; i++) {
        char page[900];
        snprintf(page, sizeof(page), "%s/solve/%s/report.html", path, j->ledger.solve[i].name);
        if (!access(page, R_OK))
            json_append_string(pages, page);
    }
    json_set(o, "pages", pages);
    j->text = json_text(o);
    json_free(o);
}

static void work_export(struct job *j)
{
    struct manifest_findings found;
    char path[700];
    snprintf(path, sizeof(path), "%s/%s", j->dir, j->id);
    j->err = manifest_write(path, NULL, 0, j->value);
    const int verified = j->err ? 0 : manifest_verify(path, &found);
    struct json *o = json_new_object();
    json_set_string(o, "path", path);
    json_set_bool(o, "intact", !j->err && !verified);
    json_set_int(o, "n_files", j->err ? 0 : found.n_files);
    if (j->err == -EBADMSG)
        j->err = 0; // written, with "failed" where something differs: that is an answer
    j->text = json_text(o);
    json_free(o);
}

static void work_doctor(struct job *j)
{
    struct json *o = doctor_examine(j->config, "", j->dir);
    j->text = json_text(o);
    json_free(o);
}

static void done_answer(struct daemon *d, struct job *j)
{
    struct json *o = NULL;
    d->n_exports -= j->work == work_export;
    if (j->err || !j->text || json_parse(&o, j->text, strlen(j->text), NULL))
        control_refuse(d->control, j->token, "failed", j->err ? strerror(-j->err) : "out of memory");
    else
        control_reply(d->control, j->token, o);
}

static struct job *answer_job(struct daemon *d, uint64_t token, void (*work)(struct job *))
{
    struct job *j = new_job(work, done_answer);
    j->token = token;
    j->value = utc_ms() / 1000;
    snprintf(j->dir, sizeof(j->dir), "%s", d->takes_dir);
    return j;
}

static void ask_takes(struct daemon *d, uint64_t token, const struct json *request)
{
    struct job *j = answer_job(d, token, work_takes);
    int64_t newest = INT_MAX;
    json_get_int(request, "newest", &newest);
    j->newest = newest > 0 && newest < INT_MAX ? (int)newest : INT_MAX;
    give_to(&d->answers, j);
}

static void ask_take(struct daemon *d, uint64_t token, const struct json *request, void (*work)(struct job *))
{
    char id[96];
    if (!take_named(d, token, request, id))
        return;
    struct job *j = answer_job(d, token, work);
    memcpy(j->id, id, sizeof(id));
    d->n_exports += work == work_export;
    give_to(&d->answers, j);
}

static void ask_report(struct daemon *d, uint64_t token, const struct json *request)
{
    ask_take(d, token, request, work_report);
}

static void ask_export(struct daemon *d, uint64_t token, const struct json *request)
{
    char id[96];
    if (!take_named(d, token, request, id))
        return;
    bool is_under_way = rig_is_busy(d->rig) && !strcmp(rig_ledger(d->rig) ? rig_ledger(d->rig)->id : "", id);
    for (int i = 0; i < d->n_unfinished; i++)
        is_under_way |= !strcmp(d->unfinished[i], id);
    if (is_under_way)
        control_refuse(d->control, token, "busy", "this take is under way; wait for it");
    else
        ask_take(d, token, request, work_export);
}

static void add_for(struct daemon *d, uint64_t token, const char *id, const struct json *request, struct workshop_request r, bool preview)
{
    bool wait = false;
    json_get_bool(request, "wait", &wait);
    r.token = token;
    for (int i = 0; wait && i < WAITERS_MAX; i++)
        if (!d->waiter[i].token) {
            d->waiter[i] = (struct waiter){ .token = token, .preview = preview };
            snprintf(d->waiter[i].take, sizeof(d->waiter[i].take), "%s", id);
            break;
        }
    workshop_add(d->workshop, id, &r); // without room for another waiter: answered at once
}

static void ask_process(struct daemon *d, uint64_t token, const struct json *request)
{
    struct workshop_request r = { .again = -1 };
    const char *again = "";
    bool cancel = false;
    char id[96], why[200];
    json_get_string(request, "again", &again);
    json_get_bool(request, "cancel", &cancel);
    if (!take_named(d, token, request, id))
        return;
    if (again[0]) {
        r.again = processing_step_named(again);
        if (r.again < 0) {
            snprintf(why, sizeof(why), "no step '%.40s'; there are sheet, develop, panorama, reconstruct, preview, focus, standard, final", again);
            control_refuse(d->control, token, "refused", why);
            return;
        }
        r.more = 1u << r.again;
    }
    if (cancel) {
        if (workshop_cancel(d->workshop, id))
            control_refuse(d->control, token, "refused", "nothing of this take is under way");
        else
            control_reply(d->control, token, describe_made(d, id));
        return;
    }
    if (!workshop_wanted(d->workshop)) // nothing is configured: what needs no configuration
        r.more |= 1u << STEP_SHEET | 1u << STEP_DEVELOP | 1u << STEP_PANORAMA | 1u << STEP_FOCUS;
    add_for(d, token, id, request, r, false);
}

static void ask_preview(struct daemon *d, uint64_t token, const struct json *request)
{
    char id[96];
    if (take_named(d, token, request, id))
        add_for(d, token, id, request, (struct workshop_request){ .again = -1, .urgent = true,
            .more = 1u << STEP_SHEET | 1u << STEP_DEVELOP | 1u << STEP_PANORAMA | 1u << STEP_RECONSTRUCT | 1u << STEP_PREVIEW }, true);
}

static void ask_doctor(struct daemon *d, uint64_t token, const struct json *request)
{
    (void)request;
    struct job *j = answer_job(d, token, work_doctor); // it walks through /proc, and asks the disk
    j->config = &d->config;
    give_to(&d->answers, j);
}

static void on_request(void *arg, uint64_t token, const char *what, const struct json *request)
{
    static const struct {
        const char *what;
        void (*ask)(struct daemon *d, uint64_t token, const struct json *request);
    } requests[] = {
        { "status", ask_status }, { "capture", ask_capture }, { "panorama", ask_panorama }, { "continue", ask_continue }, { "preflight", ask_preflight }, { "calibrate", ask_calibrate }, { "identify", ask_identify },
        { "reinstate", ask_reinstate }, { "cancel", ask_cancel }, { "takes", ask_takes }, { "report", ask_report }, { "resume", ask_resume }, { "export", ask_export },
        { "doctor", ask_doctor }, { "metrics", ask_metrics }, { "process", ask_process }, { "preview", ask_preview },
    };
    for (size_t i = 0; i < sizeof(requests) / sizeof(requests[0]); i++)
        if (!strcmp(what, requests[i].what)) {
            requests[i].ask(arg, token, request);
            return;
        }
    struct daemon *d = arg;
    control_refuse(d->control, token, "unknown", "expected status, capture, panorama, continue, preflight, calibrate, identify, reinstate, cancel, takes, report, resume, process, preview, export, doctor, metrics or subscribe");
}

static int on_control(sd_event_source *source, int fd, uint32_t events, void *arg)
{
    struct daemon *d = arg;
    (void)source, (void)fd, (void)events;
    control_dispatch(d->control);
    return 0;
}

// ---- the rig's actions ----------------------------------------------------------------------------------------------------------------------

static void preflight_is_done(struct daemon *d)
{
    control_reply(d->control, d->preflight_token, describe_findings(d->rig, &d->config));
    d->preflight_token = 0;
}

static void obey(struct daemon *d, const struct rig_action *a)
{
    const struct ledger *l = rig_ledger(d->rig);
    struct job *j;
    switch (a->kind) {
    case RIG_SPAWN:
        start_worker(d, a->camera);
        return;
    case RIG_KILL:
        if (d->worker[a->camera].pid > 0)
            kill(d->worker[a->camera].pid, SIGKILL);
        return;
    case RIG_SEND:
        send_command(d, a->camera, &a->command);
        return;
    case RIG_POWER:
        switch_power(d, a->camera, a->on);
        return;
    case RIG_RELAY:
        if (!d->trigger || trigger_relay(d->trigger, a->camera, !a->on))
            log_warning("camera %s: its relay could not be switched", d->config.camera[a->camera].name);
        return;
    case RIG_SPACE:
        j = new_job(work_space, done_space);
        snprintf(j->dir, sizeof(j->dir), "%s", d->takes_dir);
        give(d, j);
        return;
    case RIG_CREATE:
        j = new_job(work_create, done_commit);
        j->kind = l->kind;
        j->text = ledger_text(l);
        snprintf(j->dir, sizeof(j->dir), "%s", d->takes_dir);
        snprintf(j->id, sizeof(j->id), "%s", l->id);
        give(d, j);
        return;
    case RIG_COMMIT:
        j = new_job(work_commit, done_commit);
        j->text = ledger_text(l);
        take_dir(d, l->id, j->dir, sizeof(j->dir));
        give(d, j);
        return;
    case RIG_FIRE:
        fire(d, &a->shot);
        return;
    case RIG_RELEASE:
        if (d->trigger)
            trigger_release(d->trigger);
        return;
    case RIG_MANIFEST:
        j = new_job(work_manifest, done_manifest);
        know_copies(j, l);
        if (l->kind == LEDGER_PANORAMA) {
            struct json *plan = describe_plan(l, &d->config);
            j->text = json_text(plan);
            json_free(plan);
        }
        j->value = utc_ms() / 1000;
        take_dir(d, l->id, j->dir, sizeof(j->dir));
        give(d, j);
        return;
    case RIG_STATE: {
        struct json *o = json_new_object();
        json_set_string(o, "state", take_state_name(l->state));
        json_set_string(o, "take", l->id);
        control_publish(d->control, "state", o);
        return;
    }
    case RIG_SAY:
        tell(d, a);
        return;
    case RIG_PREFLIGHT_DONE:
        preflight_is_done(d);
        return;
    case RIG_TAKE_DONE:
        take_is_done(d);
        return;
    case RIG_LAG_DONE:
        keep_lag(d);
        return;
    case RIG_IDENTIFIED:
        if (a->text[0])
            control_refuse(d->control, d->identify_token[a->camera], "failed", a->text);
        else
            control_reply(d->control, d->identify_token[a->camera], json_new_object());
        d->identify_token[a->camera] = 0;
        return;
    case RIG_HEAD: {
        const int err = d->trigger ? trigger_head(d->trigger, a->head.yaw_mdeg, a->head.pitch_mdeg) : -ENODEV;
        if (err)
            rig_head_arrived(d->rig, now_ns(), err);
        return;
    }
    case RIG_PROMPT: {
        struct json *o = json_new_object();
        json_set_string(o, "take", l->id);
        json_set_bool(o, "on", a->on);
        json_set_string(o, "text", a->text);
        control_publish(d->control, "prompt", o);
        if (a->on)
            log_info("rig: %s", a->text);
        return;
    }
    case RIG_PROGRESS:
        control_publish(d->control, "panorama", describe_progress(l, &a->progress));
        return;
    }
}

// Those who watch are told what changed, at once or when the last time is CHANGES_EVERY_MS ago.
static void tell_changes(struct daemon *d)
{
    if (!control_has_subscribers(d->control))
        return;
    const int64_t now = now_ns(), due = d->changes_ns + CHANGES_EVERY_MS * S / 1000;
    if (now >= due) {
        changes_publish(d->changes, d->control, describe_all_but_cameras(d), d->rig, &d->config);
        d->changes_ns = now;
    } else {
        sd_event_source_set_time(d->changes_timer, (uint64_t)(due / 1000 + 1));
        sd_event_source_set_enabled(d->changes_timer, SD_EVENT_ONESHOT);
    }
}

static int on_changes_due(sd_event_source *source, uint64_t usec, void *arg)
{
    (void)source, (void)usec, (void)arg; // look_at_rig comes after every event
    return 0;
}

// After each event: what the rig wants now, and when it wants to be woken.
static int look_at_rig(sd_event_source *source, void *arg)
{
    static struct rig_action a;
    struct daemon *d = arg;
    (void)source;
    for (bool more = true; more;) {
        more = false;
        while (rig_next(d->rig, &a)) {
            obey(d, &a);
            more = true;
        }
        look_for_work(d);
    }
    workshop_hold(d->workshop, rig_is_busy(d->rig) || d->resuming);
    answer_waiters(d);
    const int64_t due = rig_deadline_ns(d->rig);
    sd_event_source_set_time(d->timer, due == INT64_MAX ? UINT64_MAX : (uint64_t)(due / 1000 + 1));
    sd_event_source_set_enabled(d->timer, due == INT64_MAX ? SD_EVENT_OFF : SD_EVENT_ONESHOT);
    tell_changes(d);
    return 0;
}

static int on_time(sd_event_source *source, uint64_t usec, void *arg)
{
    struct daemon *d = arg;
    (void)source, (void)usec;
    rig_time(d->rig, now_ns());
    return 0;
}

static int on_signal(sd_event_source *source, const struct signalfd_siginfo *si, void *arg)
{
    struct daemon *d = arg;
    (void)source;
    log_info("%s: ending; a take under way is resumed at the next start", strsignal((int)si->ssi_signo));
    d->stopping = true;
    rig_stop(d->rig, now_ns());
    look_at_rig(NULL, d);
    sd_event_exit(d->event, 0);
    return 0;
}

// ---- life ---------------------------------------------------------------------------------------------------------------------------------------

static int find_worker_program(struct daemon *d)
{
    const char *named = getenv("RIGD_CAMERA");
    const ssize_t n = named ? (ssize_t)strlen(named) : readlink("/proc/self/exe", d->worker_path, sizeof(d->worker_path) - 20);
    if (named && n < (ssize_t)sizeof(d->worker_path)) {
        strcpy(d->worker_path, named);
    } else if (n > 0) {
        d->worker_path[n] = 0;
        strcpy(strrchr(d->worker_path, '/') + 1, "rigd-camera");
    }
    if (!access(d->worker_path, X_OK))
        return 0;
    const int err = -errno;
    log_error("cannot run %s: %s; install it beside rigd, or name it in RIGD_CAMERA", d->worker_path, strerror(-err));
    return err;
}

static int set_up_loop(struct daemon *d)
{
    sigset_t set;
    sd_event_source *post = NULL;
    sigemptyset(&set);
    sigaddset(&set, SIGTERM);
    sigaddset(&set, SIGINT);
    sigaddset(&set, SIGCHLD);
    sigprocmask(SIG_BLOCK, &set, NULL);
    int err = sd_event_default(&d->event);
    if (err >= 0)
        err = sd_event_add_signal(d->event, NULL, SIGTERM, on_signal, d);
    if (err >= 0)
        err = sd_event_add_signal(d->event, NULL, SIGINT, on_signal, d);
    if (err >= 0)
        err = sd_event_add_time(d->event, &d->timer, CLOCK_MONOTONIC, 0, 1, on_time, d);
    if (err >= 0)
        err = sd_event_add_time_relative(d->event, &d->trigger_timer, CLOCK_MONOTONIC, 0, 1, open_the_trigger, d);
    if (err >= 0)
        err = sd_event_add_time(d->event, &d->changes_timer, CLOCK_MONOTONIC, UINT64_MAX, 1, on_changes_due, d);
    if (err >= 0)
        err = sd_event_add_io(d->event, NULL, control_fd(d->control), EPOLLIN, on_control, d);
    if (err >= 0)
        err = sd_event_add_io(d->event, NULL, d->finished_fd, EPOLLIN, on_finished, d);
    if (err >= 0)
        err = sd_event_add_io(d->event, NULL, workshop_fd(d->workshop), EPOLLIN, on_workshop, d);
    if (err >= 0)
        err = sd_event_add_post(d->event, &post, look_at_rig, d);
    if (post) {
        sd_event_source_set_enabled(post, SD_EVENT_ON);
        sd_event_source_set_floating(post, true);
        sd_event_source_unref(post);
    }
    if (err >= 0)
        err = sd_event_set_watchdog(d->event, true);
    if (err < 0)
        log_error("cannot set up the event loop: %s", strerror(-err));
    return err < 0 ? err : 0;
}

// End of file lets a worker close its camera; one whose driver hangs does not hear and is killed. What it copies is not named yet.
static void end_workers(struct daemon *d)
{
    pid_t pid[CONFIG_CAMERAS_MAX];
    int n_left = 0;
    for (int i = 0; d->worker && i < d->config.n_cameras; i++) {
        pid[i] = d->worker[i].pid;
        n_left += pid[i] > 0;
        forget_worker(&d->worker[i]);
    }
    for (int turn = 0; n_left && turn < 2 * WORKERS_END_MS / 10; turn++) {
        for (int i = 0; i < d->config.n_cameras; i++) {
            if (pid[i] > 0 && turn == WORKERS_END_MS / 10)
                kill(pid[i], SIGKILL);
            if (pid[i] > 0 && waitpid(pid[i], NULL, WNOHANG) == pid[i]) {
                pid[i] = 0;
                n_left--;
            }
        }
        if (n_left)
            usleep(10000);
    }
}

static void tear_down(struct daemon *d)
{
    web_close(d->web);
    end_workers(d);
    sd_event_source_disable_unref(d->trigger_io);
    trigger_close(d->trigger);
    end_lane(d, &d->takes);
    end_lane(d, &d->answers);
    workshop_close(d->workshop); // what it makes is owed
    for (struct job *j = d->finished; j;) {
        struct job *next = j->next;
        job_free(j);
        j = next;
    }
    control_close(d->control);
    sd_event_source_disable_unref(d->timer);
    sd_event_source_disable_unref(d->trigger_timer);
    sd_event_source_disable_unref(d->changes_timer);
    changes_free(d->changes);
    sd_event_unref(d->event);
    if (d->finished_fd >= 0)
        close(d->finished_fd);
    rig_free(d->rig);
    config_free(&d->config);
    free(d->worker);
    free(d->unfinished);
    if (d->to_journal)
        log_set_hook(NULL, NULL);
    free(d);
}

static int run(struct daemon *d)
{
    struct rlimit files;
    struct lag lag[CONFIG_CAMERAS_MAX];
    char path[400];
    if (!getrlimit(RLIMIT_NOFILE, &files)) { // a worker's socket and pidfd each; workers stay below 1024 themselves
        files.rlim_cur = files.rlim_max < 8192 ? files.rlim_max : 8192;
        setrlimit(RLIMIT_NOFILE, &files);
    }
    int err = rig_create(&d->rig, &d->config);
    if (!err)
        err = changes_create(&d->changes, d->config.n_cameras);
    if (err)
        return err;
    lag_path(d, path, sizeof(path));
    if (!lag_read(path, &d->config, lag))
        rig_set_lag(d->rig, lag);
    d->worker = calloc((size_t)d->config.n_cameras, sizeof(*d->worker));
    d->finished_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    if (!d->worker || d->finished_fd < 0)
        return -ENOMEM;
    for (int i = 0; i < d->config.n_cameras; i++)
        d->worker[i] = (struct worker){ .daemon = d, .camera = i, .fd = -1 };
    err = find_worker_program(d);
    if (!err)
        err = make_directories(d->takes_dir);
    if (!err)
        err = control_open(&d->control, d->config.socket_path, on_request, d);
    const struct workshop_host host = { on_record, on_changed, on_progress, on_settled, on_added, d };
    if (!err)
        err = workshop_open(&d->workshop, &d->config, d->takes_dir, &host);
    if (!err)
        err = set_up_loop(d);
    if (!err)
        err = begin_lane(d, &d->takes);
    if (!err)
        err = begin_lane(d, &d->answers);
    if (err)
        return err;
    web_open(&d->web, &d->config); // without it the rig works all the same
    ledger_remove_leftovers(d->takes_dir);
    find_unfinished(d);
    rig_start(d->rig, now_ns());
    sd_notifyf(0, "READY=1\nSTATUS=%d cameras", d->config.n_cameras);
    look_at_rig(NULL, d);
    err = sd_event_loop(d->event);
    sd_notify(0, "STOPPING=1");
    return err < 0 ? err : d->exit_code;
}

int daemon_run(const struct daemon_options *options)
{
    struct daemon *d = calloc(1, sizeof(*d));
    if (!d)
        return -ENOMEM;
    pthread_mutex_init(&d->lock, NULL);
    d->finished_fd = -1;
    d->trigger_word = "not open yet";
    d->once = options->once;
    d->to_journal = getenv("JOURNAL_STREAM") != NULL;
    if (d->to_journal) {
        log_set_level(LOG_SILENT);
        log_set_hook(to_journal, NULL);
    }
    int err = config_read(&d->config, options->config_path);
    if (!err && options->takes_dir) {
        char *whole = make_directories(options->takes_dir) ? NULL : realpath(options->takes_dir, NULL);
        if (!whole || strlen(whole) >= sizeof(d->config.takes_dir)) {
            log_error("--takes %s: expected a folder whose path has less than %zu bytes", options->takes_dir, sizeof(d->config.takes_dir));
            err = -EINVAL;
        } else {
            strcpy(d->config.takes_dir, whole);
        }
        free(whole);
    }
    if (!err && options->socket_path) {
        if (strlen(options->socket_path) >= sizeof(d->config.socket_path)) {
            log_error("--socket %s: longer than %zu bytes", options->socket_path, sizeof(d->config.socket_path) - 1);
            err = -EINVAL;
        } else {
            strcpy(d->config.socket_path, options->socket_path);
        }
    }
    if (!err) {
        strcpy(d->takes_dir, d->config.takes_dir);
        err = run(d);
    }
    tear_down(d);
    return err;
}
