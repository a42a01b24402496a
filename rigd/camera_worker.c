// rigd/camera_worker.c - build/bin/rigd-camera: one camera's process. Commands come in on descriptor 3, one at a time, and are
// answered there; between two commands it sleeps in one recv and its camera hears nothing.
#include "rigd/camera_gphoto.h"
#include "rigd/container.h"
#include "rigd/ingest.h"
#include "solver/take/log.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

struct worker {
    struct gphoto *camera;
    struct personality *personality;
    char personality_path[256];
    struct camera_command command;
    struct camera_event answer; // large: one of each is enough
};

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

// The daemon is gone: so is this process, at once and without a word to the camera. Its next life opens it anew.
static void end_if_alone(void *arg)
{
    struct pollfd p = { .fd = CAMERA_FD, .events = POLLIN };
    (void)arg;
    if (poll(&p, 1, 0) == 1 && p.revents & (POLLHUP | POLLERR | POLLNVAL))
        _exit(0);
}

static void say(const struct camera_event *e)
{
    size_t n = 0;
    char *text = camera_event_encode(e, &n);
    if (!text || n > CAMERA_MESSAGE_MAX) {
        log_error("rigd-camera: an answer of %zu bytes cannot be sent", n);
        _exit(1);
    }
    while (send(CAMERA_FD, text, n, MSG_NOSIGNAL) < 0)
        if (errno != EINTR)
            _exit(0); // nobody listens any more
    free(text);
}

// Something before the answer: the same message, dressed for the way.
static void say_meanwhile(struct camera_event *e, enum camera_event_kind kind)
{
    const enum camera_event_kind was = e->kind;
    e->kind = kind;
    say(e);
    e->kind = was;
}

// ---- events of the camera ----------------------------------------------------------------------------------------------------

static bool was_announced(const struct camera_object *o, const struct camera_object *seen, int n)
{
    for (int i = 0; i < n; i++)
        if (!strcmp(seen[i].folder, o->folder) && !strcmp(seen[i].name, o->name))
            return true;
    return false;
}

static int announce(struct camera_event *e, struct camera_object *seen, int *n_seen)
{
    if (was_announced(&e->object[0], seen, *n_seen))
        return 0;
    seen[(*n_seen)++ % CAMERA_LISTING_MAX] = e->object[0];
    if (*n_seen > CAMERA_LISTING_MAX)
        *n_seen = CAMERA_LISTING_MAX;
    struct camera_event note;
    memset(&note, 0, sizeof(note));
    note.seq = e->seq;
    note.object[0] = e->object[0];
    note.at_ns = e->at_ns;
    say_meanwhile(&note, CAMERA_OBJECT);
    e->n_objects++;
    return 1;
}

// DRAIN: until nothing came for quiet_ms. COLLECT: until n_objects were announced. Both: or until the deadline.
static int read_events(struct worker *w, int64_t deadline_ns)
{
    struct camera_event *e = &w->answer;
    const struct camera_command *c = &w->command;
    struct camera_object seen[CAMERA_LISTING_MAX];
    int n_seen = 0, n_events = 0;
    int64_t heard_ns = now_ns();
    for (;;) {
        const int64_t quiet_ns = heard_ns + (int64_t)c->quiet_ms * 1000000;
        if (c->kind == CAMERA_COLLECT && e->n_objects >= c->n_objects)
            return 0;
        const int got = gphoto_wait(w->camera, c->kind == CAMERA_DRAIN && quiet_ns < deadline_ns ? quiet_ns : deadline_ns, e);
        if (got < 0)
            return got;
        const int64_t now = now_ns();
        if (got == GPHOTO_OBJECT)
            announce(e, seen, &n_seen);
        if (got != GPHOTO_NOTHING) {
            heard_ns = now;
            n_events++;
        } else if (c->kind == CAMERA_DRAIN && now >= quiet_ns) {
            return 0;
        }
        if (now >= deadline_ns && c->kind == CAMERA_COLLECT)
            return 0;
        if (now >= deadline_ns)
            return gphoto_fail(e, CAMERA_BUSY, 0, "it is not quiet: %d events in %u ms, and more: close its menus, set manual focus",
                               n_events, c->timeout_ms);
    }
}

// ---- copies --------------------------------------------------------------------------------------------------------------------

struct copy {
    struct worker *w;
    struct ingest *ingest;
    int64_t size, told_ns;
};

static int add_to_copy(void *arg, const void *bytes, size_t n)
{
    struct copy *copy = arg;
    struct camera_event *e = &copy->w->answer;
    const int err = ingest_write(copy->ingest, bytes, n);
    copy->size += err ? 0 : (int64_t)n;
    if (!err && now_ns() - copy->told_ns > 500000000) {
        struct camera_event note;
        memset(&note, 0, sizeof(note));
        note.seq = e->seq;
        note.size_bytes = copy->size;
        say_meanwhile(&note, CAMERA_PROGRESS);
        copy->told_ns = now_ns();
    }
    return err;
}

static int disk_trouble(struct camera_event *e, int err, const char *path)
{
    const char *what = err == -ENOSPC || err == -EDQUOT ? "make room there"
                       : err == -EIO ? "check that disk: rigctl doctor"
                       : err == -EEXIST ? "something else has that name: move it away"
                       : err == -EROFS || err == -EACCES || err == -EPERM ? "let rigd write there" : "see rigctl doctor";
    return gphoto_fail(e, CAMERA_DISK, err, "cannot write %.60s: %s: %s", strrchr(path, '/') ? strrchr(path, '/') + 1 : path, strerror(-err), what);
}

// Unpacks the frame in a process of its own (rigd-unpack, beside this program). 0: whole, or nothing that can be told. -EBADMSG: damaged,
// and why says what was found. With the command's judge, and where it can be told: what the frame shows, in the answer.
static int check_pixels(struct worker *w, int fd, char *why, size_t room)
{
    const struct camera_command *c = &w->command;
    const char *dot = strrchr(c->object.name, '.');
    char program[512], said[4096], lens[CAMERA_LENS_MAX];
    char *arguments[] = { program, "--judge", lens, "/proc/self/fd/4", NULL }, *plain[] = { program, "/proc/self/fd/4", NULL };
    struct json *doc = NULL;
    size_t n_said = 0;
    int ends[2], status = 0;
    pid_t child;
    if (dot && (!strcasecmp(dot, ".jpg") || !strcasecmp(dot, ".jpeg")))
        return 0;
    ssize_t n = readlink("/proc/self/exe", program, sizeof(program) - 32);
    while (n > 0 && program[n - 1] != '/')
        n--;
    if (n <= 0 || pipe2(ends, O_CLOEXEC))
        return 0;
    strcpy(program + n, "rigd-unpack");
    memcpy(lens, c->judge, sizeof(lens));
    const int high = fcntl(fd, F_DUPFD_CLOEXEC, 10), out = fcntl(ends[1], F_DUPFD_CLOEXEC, 10);
    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_adddup2(&actions, out, STDOUT_FILENO);
    posix_spawn_file_actions_adddup2(&actions, high, 4);
    posix_spawn_file_actions_addclose(&actions, CAMERA_FD);
    posix_spawn_file_actions_addclosefrom_np(&actions, 5); // the driver's links to the camera above all
    const int err = high < 0 || out < 0 ? errno : posix_spawn(&child, program, &actions, NULL, lens[0] ? arguments : plain, environ);
    posix_spawn_file_actions_destroy(&actions);
    close(ends[1]);
    if (high >= 0)
        close(high);
    if (out >= 0)
        close(out);
    if (err) {
        log_warning("rigd-camera: cannot start %s: %s: frames are not unpacked", program, strerror(err));
    } else {
        while (n_said < sizeof(said) - 1 && ((n = read(ends[0], said + n_said, sizeof(said) - 1 - n_said)) > 0 || (n < 0 && errno == EINTR)))
            n_said += n > 0 ? (size_t)n : 0;
        said[n_said] = 0;
        said[strcspn(said, "\n")] = 0;
        snprintf(why, room, "%.*s", (int)room - 1, said);
        while (waitpid(child, &status, 0) < 0 && errno == EINTR)
            ;
    }
    close(ends[0]);
    if (!err && lens[0] && WIFEXITED(status) && !WEXITSTATUS(status) && !json_parse(&doc, said, strlen(said), "rigd-unpack"))
        w->answer.judged = !frame_facts_from_json(&w->answer.frame, doc);
    json_free(doc);
    if (err || (WIFEXITED(status) && WEXITSTATUS(status) != 1))
        return 0;
    if (WIFSIGNALED(status))
        snprintf(why, room, "unpacking it ended with %s", strsignal(WTERMSIG(status)));
    return -EBADMSG;
}

// A copy that a life before made and named, but did not speak of. 1: it is taken over, 0: there is none, < 0: trouble.
static int adopt(struct worker *w)
{
    const struct camera_command *c = &w->command;
    struct camera_event *e = &w->answer;
    struct stat st;
    if (lstat(c->path, &st))
        return errno == ENOENT ? 0 : disk_trouble(e, -errno, c->path);
    if (!S_ISREG(st.st_mode) || (c->kind == CAMERA_FETCH && c->object.size_bytes > 0 && st.st_size != c->object.size_bytes))
        return disk_trouble(e, -EEXIST, c->path);
    const int err = ingest_adopt(c->path, e->xxh128, &e->size_bytes);
    const int fd = !err && c->judge[0] ? open(c->path, O_RDONLY | O_CLOEXEC) : -1;
    if (fd >= 0) {
        char why[120];
        check_pixels(w, fd, why, sizeof(why)); // it was whole when it got its name
        close(fd);
    }
    return err ? disk_trouble(e, err, c->path) : 1;
}

static int copy_object(struct worker *w)
{
    const struct camera_command *c = &w->command;
    struct camera_event *e = &w->answer;
    const bool preview = c->kind == CAMERA_THUMBNAIL;
    struct copy copy = { .w = w, .told_ns = now_ns() };
    char why[120];
    int err = adopt(w);
    if (err)
        return err < 0 ? err : 0;
    err = ingest_begin(&copy.ingest, c->path);
    if (err)
        return disk_trouble(e, err, c->path);
    err = gphoto_read(w->camera, &c->object, preview, add_to_copy, &copy, e);
    if (err) {
        ingest_abort(copy.ingest);
        return err == -1 && e->text[0] ? err : disk_trouble(e, err, c->path);
    }
    err = container_check(ingest_fd(copy.ingest), copy.size, preview ? "preview.jpg" : c->object.name, why, sizeof(why));
    if (!err && !preview)
        err = check_pixels(w, ingest_fd(copy.ingest), why, sizeof(why));
    if (err) {
        ingest_abort(copy.ingest);
        if (err != -EBADMSG)
            return disk_trouble(e, err, c->path);
        return gphoto_fail(e, CAMERA_CORRUPT, 0, "%s is damaged: %s: it stays on the card and is fetched again", c->object.name, why);
    }
    err = ingest_finish(copy.ingest, e->xxh128, &e->size_bytes);
    if (err == -EBADMSG)
        return gphoto_fail(e, CAMERA_CORRUPT, 0, "%.100s read back differently than it was written: check that disk and the memory",
                           c->path);
    return err ? disk_trouble(e, err, c->path) : 0;
}

static int delete_object(struct worker *w)
{
    const struct camera_command *c = &w->command;
    struct camera_event *e = &w->answer;
    char hex[DIGEST_HEX];
    int64_t size = 0;
    if (!c->xxh128[0])
        return gphoto_fail(e, CAMERA_REFUSED, -EINVAL, "%s: without the hash of its copy nothing is deleted", c->object.name);
    const int err = digest_file(c->path, 1, hex, &size);
    if (err)
        return gphoto_fail(e, CAMERA_DISK, err, "%s stays on the card: its copy %.80s cannot be read: %s", c->object.name, c->path,
                           strerror(-err));
    if (strcmp(hex, c->xxh128))
        return gphoto_fail(e, CAMERA_CORRUPT, 0, "%s stays on the card: its copy %.80s is not what it was", c->object.name, c->path);
    struct camera_object o = c->object;
    o.size_bytes = size;
    return gphoto_delete(w->camera, &o, e);
}

// ---- commands ------------------------------------------------------------------------------------------------------------------

static int open_camera(struct worker *w)
{
    const struct camera_command *c = &w->command;
    if (strcmp(c->personality, w->personality_path)) {
        gphoto_close(w->camera); // it holds the old one
        personality_free(w->personality);
        w->personality = NULL;
        w->personality_path[0] = 0;
        const int err = c->personality[0] ? personality_read(&w->personality, c->personality) : 0;
        if (err)
            return gphoto_fail(&w->answer, CAMERA_REFUSED, err, "cannot use the personality %.120s: the journal says which line",
                               c->personality);
        strcpy(w->personality_path, c->personality);
    }
    return gphoto_open(w->camera, c, w->personality, &w->answer);
}

static int carry_out(struct worker *w, int64_t deadline_ns)
{
    const struct camera_command *c = &w->command;
    struct camera_event *e = &w->answer;
    gphoto_deadline(w->camera, deadline_ns);
    if (c->kind == CAMERA_OPEN)
        return open_camera(w);
    if (c->kind == CAMERA_CLOSE) {
        gphoto_close(w->camera);
        return 0;
    }
    if (!gphoto_is_open(w->camera))
        return gphoto_fail(e, CAMERA_LOST, -ENOTCONN, "it is not connected: it is opened anew");
    switch (c->kind) {
    case CAMERA_CONFIGURE: return gphoto_configure(w->camera, c, e);
    case CAMERA_STATUS: return gphoto_status(w->camera, e);
    case CAMERA_DRAIN:
    case CAMERA_COLLECT: return read_events(w, deadline_ns);
    case CAMERA_TRIGGER: return gphoto_trigger(w->camera, e);
    case CAMERA_LIST: return gphoto_list(w->camera, c, e);
    case CAMERA_FETCH:
    case CAMERA_THUMBNAIL: return copy_object(w);
    case CAMERA_DELETE: return delete_object(w);
    case CAMERA_IDENTIFY: return gphoto_identify(w->camera, e);
    default: return gphoto_fail(e, CAMERA_BROKEN, -EINVAL, "no such command");
    }
}

// What the answer promises, and nothing left over from on the way.
static void tidy(struct camera_event *e)
{
    const enum camera_command_kind kind = e->command;
    if (e->kind == CAMERA_FAILED || kind != CAMERA_LIST)
        e->n_listed = 0, e->more = false;
    if (e->kind == CAMERA_FAILED || kind != CAMERA_CONFIGURE)
        e->n_settings = 0;
    if (e->kind == CAMERA_FAILED || (kind != CAMERA_FETCH && kind != CAMERA_THUMBNAIL))
        e->size_bytes = 0, e->xxh128[0] = 0, e->judged = false;
    e->at_ns = 0;
}

int main(int argc, char **argv)
{
    static struct worker w;
    static char text[CAMERA_MESSAGE_MAX + 1];
    log_set_program("rigd-camera");
    if (argc > 1) {
        fprintf(stderr, "%s is started by rigd, with its end of a socket as descriptor 3; it takes no arguments\n", argv[0]);
        return 2;
    }
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    signal(SIGPIPE, SIG_IGN);
    int type = 0;
    socklen_t n_type = sizeof(type);
    if (getsockopt(CAMERA_FD, SOL_SOCKET, SO_TYPE, &type, &n_type) || type != SOCK_SEQPACKET) {
        log_error("rigd-camera: descriptor 3 is no packet socket; start it by rigd");
        return 2;
    }
    end_if_alone(NULL); // rigd died before PR_SET_PDEATHSIG: its commands hold no longer
    if (gphoto_create(&w.camera, end_if_alone, NULL)) {
        log_error("rigd-camera: no memory");
        return 1;
    }
    w.answer = (struct camera_event){ .kind = CAMERA_HELLO, .protocol = CAMERA_PROTOCOL, .pid = getpid() };
    say(&w.answer);
    for (;;) {
        const ssize_t n = recv(CAMERA_FD, text, sizeof(text), 0);
        if (n < 0 && errno == EINTR)
            continue;
        if (n <= 0)
            break;
        if (camera_command_decode(&w.command, text, (size_t)n)) {
            log_error("rigd-camera: a command of %zd bytes is none of protocol %d: rigd and rigd-camera are of different versions", n,
                      CAMERA_PROTOCOL);
            return 1;
        }
        memset(&w.answer, 0, sizeof(w.answer));
        w.answer.seq = w.command.seq;
        w.answer.command = w.command.kind;
        const int err = carry_out(&w, now_ns() + (int64_t)w.command.timeout_ms * 1000000);
        w.answer.kind = err < 0 ? CAMERA_FAILED : CAMERA_DONE;
        tidy(&w.answer);
        say(&w.answer);
        gphoto_rest(w.camera);
    }
    gphoto_free(w.camera); // a farewell, as the daemon closed its end in peace
    personality_free(w.personality);
    return 0;
}
