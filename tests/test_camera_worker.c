// tests/test_camera_worker.c - the real worker with the real libgphoto2 against simulated cameras: what it promises in camera.h.
#include "rigd/camera.h"
#include "rigd/digest.h"
#include "tests/loopback.h"
#include "tests/scratch.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdbool.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>

static const char *bin(const char *program)
{
    static char path[2][400];
    static int next;
    const char *folder = getenv("BIN");
    char *out = path[next++ & 1];
    snprintf(out, sizeof(path[0]), "%s/%s", folder ? folder : "build/bin", program);
    return out;
}

static void wait_ms(int ms)
{
    nanosleep(&(struct timespec){ ms / 1000, ms % 1000 * 1000000L }, NULL);
}

// ---- a simulated camera ----------------------------------------------------------------------------------------------------

struct sim {
    pid_t pid;
    int log; // what it says; open, lest it dies of a broken pipe
    int first_port;
    char port[96]; // of the first camera
};

static void sim_stop(struct sim *s)
{
    kill(s->pid, SIGKILL);
    waitpid(s->pid, NULL, 0);
    close(s->log);
}

// Up when it returns. faults: a script, or NULL.
static void sims_start(struct sim *s, int n_cameras, const char *personality, const char *faults)
{
    static int port = 15740; // rigs of one test have different ones
    int pipes[2];
    char address[32], number[16], cameras[16], kind[850], script[900], line[256];
    snprintf(address, sizeof(address), "--address=%s", loopback_address());
    snprintf(number, sizeof(number), "-p%d", port);
    snprintf(cameras, sizeof(cameras), "-n%d", n_cameras);
    snprintf(kind, sizeof(kind), "--personality=%s", personality);
    snprintf(script, sizeof(script), "--faults=%s", scratch_path("faults"));
    if (faults)
        scratch_write("faults", faults, strlen(faults));
    assert_int_equal(pipe2(pipes, O_CLOEXEC), 0);
    s->pid = fork();
    assert_true(s->pid >= 0);
    if (!s->pid) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        dup2(pipes[1], 2);
        execl(bin("rigsim"), "rigsim", address, cameras, number, kind, "--raw-size=1224x816", faults ? script : NULL, NULL);
        _exit(127);
    }
    close(pipes[1]);
    ssize_t n = 0, got;
    while (n < (ssize_t)sizeof(line) - 1 && !memchr(line, '\n', (size_t)n) &&
           (got = read(pipes[0], line + n, sizeof(line) - 1 - (size_t)n)) > 0)
        n += got;
    line[n] = 0;
    s->log = pipes[0];
    s->first_port = port;
    port += 2 * n_cameras;
    snprintf(s->port, sizeof(s->port), "ptpip:%s:%d:%d", loopback_address(), s->first_port, s->first_port + 1);
    if (faults)
        unlink(scratch_path("faults"));
    if (strstr(line, "info: server: "))
        return;
    sim_stop(s);
    fail_msg("rigsim does not start: %s", line);
}

static void sim_start(struct sim *s, const char *personality, const char *faults)
{
    sims_start(s, 1, personality, faults);
}

// ---- a worker --------------------------------------------------------------------------------------------------------------

struct worker {
    pid_t pid;
    int fd;
    uint32_t seq;
    struct camera_event answer; // DONE or FAILED
    int n_objects, n_progress;  // events before it
    struct camera_object object; // the last of them
};

static bool worker_hear(struct worker *w, struct camera_event *e)
{
    static char text[CAMERA_MESSAGE_MAX];
    struct pollfd p = { .fd = w->fd, .events = POLLIN };
    int n_ready;
    while ((n_ready = poll(&p, 1, 180000)) < 0 && errno == EINTR)
        ;
    if (n_ready != 1)
        fail_msg("the worker hangs");
    const ssize_t n = recv(w->fd, text, sizeof(text), 0);
    if (n <= 0)
        return false;
    assert_int_equal(camera_event_decode(e, text, (size_t)n), 0);
    return true;
}

static void worker_start(struct worker *w)
{
    int ends[2];
    memset(w, 0, sizeof(*w));
    assert_int_equal(socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, ends), 0);
    w->pid = fork();
    assert_true(w->pid >= 0);
    if (!w->pid) {
        if (ends[1] == CAMERA_FD)
            fcntl(CAMERA_FD, F_SETFD, 0);
        else
            dup2(ends[1], CAMERA_FD);
        const int null = open("/dev/null", O_WRONLY);
        dup2(null, 2); // the driver prints what it does not like
        setenv("ASAN_OPTIONS", "detect_leaks=0", 0); // and leaks a few bytes whenever it is closed
        execl(bin("rigd-camera"), "rigd-camera", NULL);
        _exit(127);
    }
    close(ends[1]);
    w->fd = ends[0];
    assert_true(worker_hear(w, &w->answer));
    assert_int_equal(w->answer.kind, CAMERA_HELLO);
    assert_int_equal(w->answer.protocol, CAMERA_PROTOCOL);
    assert_int_equal(w->answer.pid, w->pid);
}

// Ends it as a daemon that stops does; the exit status.
static int worker_stop(struct worker *w)
{
    int status = 0;
    close(w->fd);
    assert_int_equal(waitpid(w->pid, &status, 0), w->pid);
    return status;
}

static void worker_send(struct worker *w, struct camera_command *c)
{
    size_t n;
    c->seq = ++w->seq;
    if (!c->timeout_ms)
        c->timeout_ms = 10000;
    char *text = camera_command_encode(c, &n);
    assert_non_null(text);
    send(w->fd, text, n, MSG_NOSIGNAL);
    free(text);
}

// The answer to the last command is in w->answer. false: the worker died.
static bool answered(struct worker *w, const struct camera_command *c)
{
    w->n_objects = w->n_progress = 0;
    for (;;) {
        if (!worker_hear(w, &w->answer))
            return false;
        assert_int_equal(w->answer.seq, w->seq);
        if (w->answer.kind == CAMERA_DONE || w->answer.kind == CAMERA_FAILED)
            break;
        w->n_progress += w->answer.kind == CAMERA_PROGRESS;
        if (w->answer.kind == CAMERA_OBJECT) {
            w->n_objects++;
            w->object = w->answer.object[0];
            assert_true(w->answer.at_ns > 0);
        }
    }
    assert_int_equal(w->answer.command, c->kind);
    return true;
}

static bool worker_try(struct worker *w, struct camera_command c)
{
    worker_send(w, &c);
    return answered(w, &c);
}

static const struct camera_event *done(struct worker *w, struct camera_command c)
{
    assert_true(worker_try(w, c));
    if (w->answer.kind != CAMERA_DONE)
        fail_msg("%s: %s: %s", camera_command_name(c.kind), camera_trouble_name(w->answer.trouble), w->answer.text);
    return &w->answer;
}

static void failed(struct worker *w, enum camera_command_kind kind, enum camera_trouble trouble)
{
    if (w->answer.kind != CAMERA_FAILED || w->answer.trouble != trouble)
        fail_msg("%s: expected %s, got %s: %s", camera_command_name(kind), camera_trouble_name(trouble),
                 w->answer.kind == CAMERA_DONE ? "done" : camera_trouble_name(w->answer.trouble), w->answer.text);
    assert_true(w->answer.err < 0);
    assert_true(strlen(w->answer.text) > 10);
}

static void fails(struct worker *w, struct camera_command c, enum camera_trouble trouble)
{
    assert_true(worker_try(w, c));
    failed(w, c.kind, trouble);
}

static struct camera_command opening(const struct sim *s, const char *conf)
{
    struct camera_command c = { .kind = CAMERA_OPEN };
    snprintf(c.port, sizeof(c.port), "%s", s->port);
    snprintf(c.personality, sizeof(c.personality), "config/cameras/%s.conf", conf);
    return c;
}

static struct camera_command fetching(enum camera_command_kind kind, const struct camera_object *o, const char *name)
{
    struct camera_command c = { .kind = kind, .object = *o };
    snprintf(c.path, sizeof(c.path), "%s", scratch_path(name));
    return c;
}

static struct camera_command setting(struct camera_command c, const char *name, const char *value)
{
    c.kind = CAMERA_CONFIGURE;
    strcpy(c.setting[c.n_settings].name, name);
    strcpy(c.setting[c.n_settings++].value, value);
    return c;
}

static struct camera_command plain(enum camera_command_kind kind)
{
    return (struct camera_command){ .kind = kind };
}

// As often as a body says that it still writes the last frame.
static const struct camera_event *release_shutter(struct worker *w)
{
    for (int tries = 0; tries < 1200; tries++) {
        assert_true(worker_try(w, plain(CAMERA_TRIGGER)));
        if (w->answer.kind == CAMERA_DONE)
            return &w->answer;
        assert_int_equal(w->answer.trouble, CAMERA_BUSY);
        wait_ms(50);
    }
    fail_msg("busy for a minute");
    return NULL;
}

// Opens, releases and finds the object on the card.
static struct camera_object shoot(struct worker *w, const struct sim *s, const char *conf)
{
    done(w, opening(s, conf));
    release_shutter(w);
    done(w, (struct camera_command){ .kind = CAMERA_COLLECT, .n_objects = 1, .timeout_ms = 30000 });
    const struct camera_event *e = done(w, plain(CAMERA_LIST));
    assert_int_equal(e->n_listed, 1);
    return e->object[0];
}

static bool is_there(const char *name)
{
    return !access(scratch_path(name), F_OK);
}

// ---- promises ----------------------------------------------------------------------------------------------------------------

static const char *const kinds[][2] = { { "generic", "generic" }, { "nikon", "nikon" }, { "canon", "canon-eos" } };

static void a_frame_of_each_kind_comes_from_release_to_disk(void **state)
{
    (void)state;
    for (int k = 0; k < 3; k++) {
        struct sim s;
        struct worker w;
        char hash[DIGEST_HEX];
        int64_t size;
        sim_start(&s, kinds[k][0], NULL);
        worker_start(&w);
        const struct camera_event *e = done(&w, opening(&s, kinds[k][1]));
        assert_true(e->facts.serial[0] && e->facts.model[0] && e->facts.firmware[0]);
        assert_string_equal(e->facts.driver_port, s.port);
        e = done(&w, plain(CAMERA_STATUS));
        assert_int_equal(e->status.battery_percent, 100);
        assert_int_equal(e->status.card_present, 1);
        assert_true(e->status.free_images > 0 && e->status.free_bytes > 0);
        assert_true(e->status.clock_offset_s > -60 && e->status.clock_offset_s < 60);
        assert_int_equal(e->status.manual_focus, 1);
        assert_int_equal(e->status.manual_exposure, 1);
        assert_int_equal(e->status.objects_per_shot, 1);
        assert_int_equal(done(&w, plain(CAMERA_LIST))->n_listed, 0);

        struct camera_command c = setting(setting(plain(CAMERA_CONFIGURE), "shutter", "1/250"), "iso", "400");
        c = setting(setting(c, "aperture", "11"), "imageformat", "raw");
        e = done(&w, c);
        assert_int_equal(e->n_settings, 4);
        for (int i = 0; i < 4; i++) {
            assert_string_equal(e->setting[i].name, c.setting[i].name);
            assert_true(e->setting[i].equal);
            assert_true(e->setting[i].written == (i < 3)); // raw it was already
        }
        e = done(&w, c);
        for (int i = 0; i < 4; i++)
            assert_true(e->setting[i].equal && !e->setting[i].written);

        done(&w, (struct camera_command){ .kind = CAMERA_DRAIN, .quiet_ms = 100 });
        assert_true(release_shutter(&w)->pressed_ns > 0);
        e = done(&w, (struct camera_command){ .kind = CAMERA_COLLECT, .n_objects = 1 });
        assert_int_equal(e->n_objects, 1);
        assert_int_equal(w.n_objects, 1);
        const struct camera_object first = w.object;
        assert_true(first.size_bytes > 1 << 20);
        e = done(&w, plain(CAMERA_LIST));
        assert_int_equal(e->n_listed, 1);
        assert_int_equal(camera_object_order(&e->object[0], &first), 0);

        release_shutter(&w); // a second one: later than the first
        done(&w, (struct camera_command){ .kind = CAMERA_COLLECT, .n_objects = 1 });
        e = done(&w, (struct camera_command){ .kind = CAMERA_LIST, .n_objects = 8, .n_after = 1, .after = { first } });
        assert_int_equal(e->n_listed, 1);
        assert_false(e->more);
        assert_true(camera_object_order(&e->object[0], &first) > 0);
        e = done(&w, (struct camera_command){ .kind = CAMERA_LIST, .n_objects = 1 });
        assert_int_equal(e->n_listed, 1);
        assert_true(e->more);
        assert_int_equal(camera_object_order(&e->object[0], &first), 0);

        done(&w, fetching(CAMERA_THUMBNAIL, &first, "A01.jpg"));
        e = done(&w, fetching(CAMERA_FETCH, &first, "A01.dng"));
        assert_int_equal(e->size_bytes, first.size_bytes);
        assert_int_equal(digest_file(scratch_path("A01.dng"), 0, hash, &size), 0);
        assert_int_equal(size, first.size_bytes);
        assert_string_equal(e->xxh128, hash);
        e = done(&w, fetching(CAMERA_FETCH, &first, "A01.dng")); // it is there: taken over
        assert_string_equal(e->xxh128, hash);

        c = fetching(CAMERA_DELETE, &first, "A01.dng");
        fails(&w, c, CAMERA_REFUSED); // no hash
        memset(c.xxh128, '0', 32);
        fails(&w, c, CAMERA_CORRUPT); // another hash
        strcpy(c.xxh128, hash);
        strcpy(c.path, scratch_path("gone.dng"));
        fails(&w, c, CAMERA_DISK); // no copy
        assert_int_equal(done(&w, (struct camera_command){ .kind = CAMERA_LIST, .n_objects = 8 })->n_listed, 2);
        strcpy(c.path, scratch_path("A01.dng"));
        done(&w, c);
        e = done(&w, (struct camera_command){ .kind = CAMERA_LIST, .n_objects = 8 });
        assert_int_equal(e->n_listed, 1); // the other one is still there
        assert_true(camera_object_order(&e->object[0], &first) > 0);
        fails(&w, c, CAMERA_CARD); // once only, and nothing else in its place
        assert_int_equal(done(&w, (struct camera_command){ .kind = CAMERA_LIST, .n_objects = 8 })->n_listed, 1);
        done(&w, plain(CAMERA_CLOSE));
        fails(&w, plain(CAMERA_STATUS), CAMERA_LOST);
        assert_int_equal(worker_stop(&w), 0);
        sim_stop(&s);
        scratch_empty();
    }
}

static void a_lost_event_is_made_up_for_by_the_listing(void **state)
{
    (void)state;
    for (int k = 0; k < 3; k += 2) {
        struct sim s;
        struct worker w;
        sim_start(&s, kinds[k][0], "* on shot * lose_added 1\n* on shot * lose_complete 1\n");
        worker_start(&w);
        done(&w, opening(&s, kinds[k][1]));
        assert_int_equal(done(&w, plain(CAMERA_LIST))->n_listed, 0); // an empty card, listed before
        for (int shot = 1; shot <= 2; shot++) {
            release_shutter(&w);
            if (shot == 2) { // exposure, file and events fall due at once: a busy host must not bring the event back
                kill(s.pid, SIGSTOP);
                wait_ms(300);
                kill(s.pid, SIGCONT);
            }
            const struct camera_event *e = done(&w, (struct camera_command){ .kind = CAMERA_COLLECT, .n_objects = 1, .timeout_ms = 500 });
            assert_int_equal(e->n_objects, 0); // time is up, and that is no failure
            for (int tries = 0; tries < 1200; tries++) { // a busy machine may still be exposing
                e = done(&w, (struct camera_command){ .kind = CAMERA_LIST, .n_objects = 8 });
                if (e->n_listed >= shot)
                    break;
                wait_ms(50);
            }
            assert_int_equal(e->n_listed, shot);
            char name[24];
            snprintf(name, sizeof(name), "A%d.dng", shot);
            done(&w, fetching(CAMERA_FETCH, &w.answer.object[shot - 1], name));
        }
        worker_stop(&w);
        sim_stop(&s);
        scratch_empty();
    }
}

// Numbered folders are for the camera to count, but a card may come from anywhere.
static void a_frame_behind_many_folders_is_found_or_the_card_is_refused(void **state)
{
    (void)state;
    static const struct { const char *base, *conf; int n_folders; } cards[] = {
        { "nikon", "nikon", 600 }, { "generic", "generic", 5000 },
    };
    for (size_t k = 0; k < sizeof(cards) / sizeof(cards[0]); k++) {
        struct sim s;
        struct worker w;
        char text[80];
        const int n = snprintf(text, sizeof(text), "base = %s\nolder_folders = %d\n", cards[k].base, cards[k].n_folders);
        scratch_write("card", text, (size_t)n);
        sim_start(&s, scratch_path("card"), "A01 on shot 1 lose_added 1\n");
        worker_start(&w);
        done(&w, opening(&s, cards[k].conf));
        release_shutter(&w);
        wait_ms(500);
        const struct camera_command newest = { .kind = CAMERA_LIST, .timeout_ms = 30000 }, all = { .kind = CAMERA_LIST, .n_objects = 8, .timeout_ms = 30000 };
        if (cards[k].n_folders > 4096) { // a list that is not complete is none
            fails(&w, newest, CAMERA_CARD);
            assert_non_null(strstr(w.answer.text, "folders"));
            fails(&w, all, CAMERA_CARD);
        } else {
            assert_int_equal(done(&w, newest)->n_listed, 1);
            assert_int_equal(done(&w, all)->n_listed, 1);
        }
        worker_stop(&w);
        sim_stop(&s);
    }
    scratch_empty();
}

static void the_wrong_body_is_not_used(void **state)
{
    (void)state;
    struct sim s;
    struct worker w;
    char serial[40];
    sim_start(&s, "canon", NULL);
    worker_start(&w);
    struct camera_command c = opening(&s, "canon-eos");
    strcpy(serial, done(&w, c)->facts.serial);
    strcpy(c.serial, "4711");
    fails(&w, c, CAMERA_WRONG);
    assert_non_null(strstr(w.answer.text, serial));
    assert_non_null(strstr(w.answer.text, "4711"));
    fails(&w, plain(CAMERA_TRIGGER), CAMERA_LOST);
    strcpy(c.serial, serial);
    done(&w, c);
    strcpy(c.personality, "config/cameras/no-such.conf");
    fails(&w, c, CAMERA_REFUSED);
    c = opening(&s, "canon-eos");
    strcpy(c.port, "ptpip:localhost:1:2");
    fails(&w, c, CAMERA_REFUSED);
    strcpy(c.port, "usb:9-9.9.9");
    fails(&w, c, CAMERA_LOST);
    strcpy(c.port, "usb:../../../etc");
    fails(&w, c, CAMERA_REFUSED);
    worker_stop(&w);
    sim_stop(&s);
}

// What it says goes into journals and onto terminals.
static void what_a_body_says_is_text_and_moves_no_cursor(void **state)
{
    (void)state;
    static const char text[] = "base = generic\nmodel = Cam\033[2J\033[31mera\nfirmware = 1\b2\177\n";
    struct sim s;
    struct worker w;
    scratch_write("rude", text, sizeof(text) - 1);
    sim_start(&s, scratch_path("rude"), NULL);
    unlink(scratch_path("rude"));
    worker_start(&w);
    const struct camera_event *e = done(&w, opening(&s, "generic"));
    assert_non_null(strstr(e->facts.model, "era"));
    for (const char *c = e->facts.model; *c; c++)
        assert_true(*c >= ' ' && *c != 127);
    for (const char *c = e->facts.firmware; *c; c++)
        assert_true(*c >= ' ' && *c != 127);
    worker_stop(&w);
    sim_stop(&s);
}

static void what_a_body_does_not_take_is_told_not_hidden(void **state)
{
    (void)state;
    struct sim s;
    struct worker w;
    sim_start(&s, "generic", "* on connect 1 drift 0x5007 560\n");
    worker_start(&w);
    done(&w, opening(&s, "generic"));
    const struct camera_event *e =
        done(&w, setting(setting(setting(plain(CAMERA_CONFIGURE), "aperture", "11"), "iso", "123"), "no-such-setting", "1"));
    assert_true(e->setting[0].written && !e->setting[0].equal); // somebody turned a ring
    assert_string_equal(e->setting[0].found, "f/5.6");
    assert_false(e->setting[1].written || e->setting[1].equal);
    assert_string_equal(e->setting[1].found, "100");
    assert_false(e->setting[2].written || e->setting[2].equal);
    assert_string_equal(e->setting[2].found, "not offered");
    worker_stop(&w);
    sim_stop(&s);
}

static void a_body_shows_itself_and_works_on(void **state)
{
    (void)state;
    for (int k = 0; k < 3; k++) {
        struct sim s;
        struct worker w;
        const struct camera_command c = { .kind = CAMERA_IDENTIFY, .timeout_ms = 1000 };
        sim_start(&s, kinds[k][0], NULL);
        worker_start(&w);
        done(&w, opening(&s, kinds[k][1]));
        if (k)
            done(&w, c);
        else
            fails(&w, c, CAMERA_REFUSED); // it has nothing to show
        release_shutter(&w); // live view is off again
        assert_int_equal(done(&w, (struct camera_command){ .kind = CAMERA_COLLECT, .n_objects = 1 })->n_objects, 1);
        worker_stop(&w);
        sim_stop(&s);
    }
}

static void a_body_that_does_not_stop_showing_itself_is_told(void **state)
{
    (void)state;
    struct sim s;
    struct worker w;
    sim_start(&s, "nikon", "* on op 0x9202 busy 1s\n");
    worker_start(&w);
    done(&w, opening(&s, "nikon"));
    fails(&w, (struct camera_command){ .kind = CAMERA_IDENTIFY, .timeout_ms = 1000 }, CAMERA_BUSY);
    assert_non_null(strstr(w.answer.text, "live view"));
    worker_stop(&w);
    sim_stop(&s);
}

static void a_flood_of_events_is_named_and_ends(void **state)
{
    (void)state;
    struct sim s[3];
    struct worker w[3];
    struct camera_command drain = { .kind = CAMERA_DRAIN, .quiet_ms = 1500, .timeout_ms = 2000 }; // quiet: longer than a machine stands still
    for (int k = 0; k < 3; k++) {
        sim_start(&s[k], kinds[k][0], "* on connect 1 flood 200 60s\n");
        worker_start(&w[k]);
        done(&w[k], opening(&s[k], kinds[k][1]));
        worker_send(&w[k], &drain);
    }
    for (int k = 0; k < 3; k++) {
        answered(&w[k], &drain);
        failed(&w[k], CAMERA_DRAIN, CAMERA_BUSY);
        worker_stop(&w[k]);
        sim_stop(&s[k]);
    }
}

static void a_busy_body_is_busy_and_not_bare_of_settings(void **state)
{
    (void)state;
    struct sim s;
    struct worker w;
    sim_start(&s, "generic", "* on op 0x100e#1 busy 3s\n");
    worker_start(&w);
    done(&w, opening(&s, "generic"));
    fails(&w, plain(CAMERA_TRIGGER), CAMERA_BUSY);
    fails(&w, plain(CAMERA_STATUS), CAMERA_BUSY);
    fails(&w, setting(plain(CAMERA_CONFIGURE), "iso", "200"), CAMERA_BUSY);
    fails(&w, plain(CAMERA_LIST), CAMERA_BUSY);
    for (int tries = 0; tries < 1200 && worker_try(&w, plain(CAMERA_STATUS)) && w.answer.kind == CAMERA_FAILED; tries++) {
        assert_int_equal(w.answer.trouble, CAMERA_BUSY);
        wait_ms(50);
    }
    assert_int_equal(w.answer.kind, CAMERA_DONE); // the link is as good as before
    release_shutter(&w);
    worker_stop(&w);
    sim_stop(&s);
}

static void a_full_card_is_the_card(void **state)
{
    (void)state;
    for (int k = 0; k < 2; k++) { // a Canon only falls silent then
        struct sim s;
        struct worker w;
        sim_start(&s, kinds[k][0], "* on connect 1 card_full\n");
        worker_start(&w);
        done(&w, opening(&s, kinds[k][1]));
        fails(&w, plain(CAMERA_TRIGGER), CAMERA_CARD);
        assert_int_equal(done(&w, plain(CAMERA_STATUS))->status.free_images, 0);
        worker_stop(&w);
        sim_stop(&s);
    }
}

static void a_broken_link_leaves_nothing_and_heals_by_opening(void **state)
{
    (void)state;
    const struct { const char *fault; enum camera_trouble trouble; } cases[] = {
        { "* on op 0x101b#2 drop\n", CAMERA_LOST },
        { "* on op 0x101b#2 power_cut 300ms\n", CAMERA_LOST },
        { "* on op 0x101b#1 stall 7s\n", CAMERA_STALLED },
    };
    for (int i = 0; i < 3; i++) {
        struct sim s;
        struct worker w;
        sim_start(&s, "nikon", cases[i].fault);
        worker_start(&w);
        const struct camera_object o = shoot(&w, &s, "nikon");
        fails(&w, fetching(CAMERA_FETCH, &o, "A01.dng"), cases[i].trouble);
        assert_false(is_there("A01.dng"));
        assert_false(is_there("A01.dng.part"));
        fails(&w, plain(CAMERA_STATUS), CAMERA_LOST); // at once, until it is opened anew
        for (int tries = 0; tries < 1200; tries++) { // it comes back in its own time
            assert_true(worker_try(&w, opening(&s, "nikon")));
            if (w.answer.kind == CAMERA_DONE)
                break;
            wait_ms(50);
        }
        assert_int_equal(w.answer.kind, CAMERA_DONE);
        assert_int_equal(done(&w, fetching(CAMERA_FETCH, &o, "A01.dng"))->size_bytes, o.size_bytes);
        worker_stop(&w);
        sim_stop(&s);
        scratch_empty();
    }
}

// The worker asks the rigd-unpack beside it: here one that finds every frame damaged, and one that is not there.
static void frames_that_do_not_unpack_get_no_name(void **state)
{
    (void)state;
    static const char script[] = "#!/bin/sh\n[ -s \"$1\" ] && echo the seventh row is missing\nexit 1\n";
    char command[1600], *folder = getenv("BIN") ? strdup(getenv("BIN")) : NULL;
    struct sim s;
    struct worker w;
    sim_start(&s, "generic", "");
    snprintf(command, sizeof(command), "mkdir %s && cp %s/rigd-camera %s", scratch_path("bin"), folder ? folder : "build/bin", scratch_path("bin"));
    assert_int_equal(system(command), 0);
    scratch_write("bin/rigd-unpack", script, sizeof(script) - 1);
    assert_int_equal(chmod(scratch_path("bin/rigd-unpack"), 0755), 0);
    setenv("BIN", scratch_path("bin"), 1);
    worker_start(&w);
    const struct camera_object o = shoot(&w, &s, "generic");
    fails(&w, fetching(CAMERA_FETCH, &o, "A01.dng"), CAMERA_CORRUPT);
    assert_non_null(strstr(w.answer.text, "the seventh row is missing"));
    assert_false(is_there("A01.dng"));
    assert_false(is_there("A01.dng.part"));
    unlink(scratch_path("bin/rigd-unpack"));
    done(&w, fetching(CAMERA_FETCH, &o, "A01.dng"));
    assert_true(is_there("A01.dng"));
    worker_stop(&w);
    sim_stop(&s);
    unlink(scratch_path("bin/rigd-camera"));
    rmdir(scratch_path("bin"));
    unlink(scratch_path("A01.dng"));
    if (folder)
        setenv("BIN", folder, 1);
    else
        unsetenv("BIN");
    free(folder);
}

static void short_frames_get_no_name(void **state)
{
    (void)state;
    struct sim s;
    struct worker w;
    sim_start(&s, "generic", "* on shot 1 short 1\n");
    worker_start(&w);
    struct camera_object o = shoot(&w, &s, "generic");
    fails(&w, fetching(CAMERA_FETCH, &o, "A01.dng"), CAMERA_CORRUPT); // all that was announced came, and it is half a frame
    o.size_bytes *= 2;
    fails(&w, fetching(CAMERA_FETCH, &o, "A01.dng"), CAMERA_CORRUPT); // it was announced longer before
    assert_false(is_there("A01.dng"));
    assert_false(is_there("A01.dng.part"));
    worker_stop(&w);
    sim_stop(&s);
}

// A body that cannot read parts sends all in one go, and the driver does not hear that the disk was full for a moment in the middle of it.
static void a_disk_that_was_full_for_a_moment_is_told_as_the_disk(void **state)
{
    (void)state;
    enum { FULL_AT = 300000 }; // of 2 MB
    static const char text[] = "base = generic\noperations = 0x1001 0x1002 0x1003 0x1004 0x1005 0x1006 0x1007 0x1008 0x1009 0x100a 0x100b 0x100e 0x100f 0x1014 0x1015 0x1016\n";
    struct sim s;
    struct worker w;
    struct stat st;
    scratch_write("whole", text, sizeof(text) - 1);
    sim_start(&s, scratch_path("whole"), "* on shot 1 slow 1000000\n");
    unlink(scratch_path("whole"));
    signal(SIGXFSZ, SIG_IGN); // so it is inherited: the write fails instead
    worker_start(&w);
    signal(SIGXFSZ, SIG_DFL);
    const struct camera_object o = shoot(&w, &s, "generic");
    const struct rlimit small = { FULL_AT, RLIM_INFINITY }, all = { RLIM_INFINITY, RLIM_INFINITY };
    assert_int_equal(prlimit(w.pid, RLIMIT_FSIZE, &small, NULL), 0);
    const pid_t helper = fork();
    assert_true(helper >= 0);
    if (!helper) { // makes room when it was full for .8 s
        for (int i = 0; i < 24000 && (stat(scratch_path("A01.dng.part"), &st) || st.st_size < FULL_AT); i++)
            wait_ms(5);
        wait_ms(800);
        prlimit(w.pid, RLIMIT_FSIZE, &all, NULL);
        _exit(0);
    }
    fails(&w, fetching(CAMERA_FETCH, &o, "A01.dng"), CAMERA_DISK);
    waitpid(helper, NULL, 0);
    assert_false(is_there("A01.dng"));
    assert_false(is_there("A01.dng.part"));
    done(&w, fetching(CAMERA_FETCH, &o, "A01.dng"));
    assert_int_equal(w.answer.size_bytes, o.size_bytes);
    worker_stop(&w);
    sim_stop(&s);
    unlink(scratch_path("A01.dng"));
}

static void nothing_is_written_over_a_strangers_file(void **state)
{
    (void)state;
    struct sim s;
    struct worker w;
    struct stat st;
    sim_start(&s, "generic", NULL);
    worker_start(&w);
    const struct camera_object o = shoot(&w, &s, "generic");
    scratch_write("A01.dng", "mine", 4);
    fails(&w, fetching(CAMERA_FETCH, &o, "A01.dng"), CAMERA_DISK);
    assert_int_equal(w.answer.err, -EEXIST);
    assert_int_equal(stat(scratch_path("A01.dng"), &st), 0);
    assert_int_equal(st.st_size, 4);
    fails(&w, fetching(CAMERA_FETCH, &o, "no/folder/A01.dng"), CAMERA_DISK);
    struct camera_object gone = o;
    strcpy(gone.name, "SIM_9999.DNG");
    fails(&w, fetching(CAMERA_FETCH, &gone, "A02.dng"), CAMERA_CARD);
    assert_false(is_there("A02.dng.part"));
    worker_stop(&w);
    sim_stop(&s);
    scratch_empty();
}

// A worker that was killed while it started rigd-unpack leaves its links to that process for a moment, and the camera takes no second
// client: open again, as the daemon does.
static void open_after_a_kill(struct worker *w, const struct sim *s)
{
    for (int i = 0; i < 1200; i++) {
        assert_true(worker_try(w, opening(s, "generic")));
        if (w->answer.kind == CAMERA_DONE)
            return;
        assert_int_equal(w->answer.trouble, CAMERA_LOST);
        nanosleep(&(struct timespec){ 0, 50000000 }, NULL);
    }
    fail_msg("not to be opened in a minute: %s", w->answer.text);
}

static void killed_in_the_middle_a_frame_is_whole_or_not_there(void **state)
{
    (void)state;
    struct sim s;
    struct worker w;
    struct stat st;
    char hash[DIGEST_HEX] = "";
    uint32_t random = 12345;
    sim_start(&s, "generic", NULL);
    worker_start(&w);
    const struct camera_object o = shoot(&w, &s, "generic");
    strcpy(hash, done(&w, fetching(CAMERA_FETCH, &o, "whole.dng"))->xxh128);
    for (int i = 0; i < 40; i++) {
        open_after_a_kill(&w, &s);
        struct camera_command c = fetching(CAMERA_FETCH, &o, "A01.dng");
        worker_send(&w, &c);
        random = random * 1664525 + 1013904223;
        nanosleep(&(struct timespec){ 0, (long)(random >> 8) }, NULL); // up to 17 ms
        kill(w.pid, SIGKILL);
        worker_stop(&w);
        if (!stat(scratch_path("A01.dng"), &st))
            assert_int_equal(st.st_size, o.size_bytes);
        worker_start(&w);
        if (i % 4 == 3) {
            open_after_a_kill(&w, &s);
            assert_string_equal(done(&w, fetching(CAMERA_FETCH, &o, "A01.dng"))->xxh128, hash);
            assert_false(is_there("A01.dng.part"));
            unlink(scratch_path("A01.dng"));
        }
    }
    worker_stop(&w);
    sim_stop(&s);
    scratch_empty();
}

static void hostile_replies_are_survived_or_kill_only_the_worker(void **state)
{
    (void)state;
    static const char *const operations[] = { "0x1001", "0x1005", "0x1007", "0x1008", "0x1014", "0x101b", "0x100a" };
    static const char *const wrongs[] = { "count", "string", "transaction", "garbage", "type" }; // those that end in silence: see stall
    enum { N = 35 };
    struct sim s;
    struct worker w[N];
    bool alive[N];
    char script[N * 48] = "", name[24];
    int n_answers = 0;
    for (int i = 0; i < N; i++) {
        const size_t n = strlen(script);
        snprintf(script + n, sizeof(script) - n, "A%02d on op %s hostile %s 1\n", i + 1, operations[i / 5], wrongs[i % 5]);
    }
    sims_start(&s, N, "generic", script);
    for (int i = 0; i < N; i++) {
        worker_start(&w[i]);
        alive[i] = true;
    }
    for (int step = 0; step < 7; step++) { // all at once: they have waits in common
        for (int i = 0; i < N; i++) {
            struct camera_object object = { "/store_00010001/DCIM/100SIM", "SIM_0001.DNG", -1 };
            snprintf(name, sizeof(name), step == 5 ? "A%d.jpg" : "A%d.dng", i);
            struct camera_command c[] = {
                opening(&s, "generic"), plain(CAMERA_STATUS), plain(CAMERA_TRIGGER),
                { .kind = CAMERA_COLLECT, .n_objects = 1, .timeout_ms = 300 }, plain(CAMERA_LIST),
                fetching(CAMERA_THUMBNAIL, &object, name), fetching(CAMERA_FETCH, &object, name),
            };
            snprintf(c[0].port, sizeof(c[0].port), "ptpip:%s:%d:%d", loopback_address(), s.first_port + 2 * i, s.first_port + 2 * i + 1);
            if (alive[i])
                worker_send(&w[i], &c[step]);
        }
        for (int i = 0; i < N; i++) {
            while (alive[i] && (alive[i] = worker_hear(&w[i], &w[i].answer))) // answers, or dies; hangs fail the test
                if (w[i].answer.kind == CAMERA_DONE || w[i].answer.kind == CAMERA_FAILED)
                    break;
            n_answers += alive[i];
        }
    }
    assert_true(n_answers >= N * 4); // most live
    for (int i = 0; i < N; i++)
        worker_stop(&w[i]);
    sim_stop(&s);
    scratch_empty();
}

static void without_a_daemon_or_with_another_protocol_it_ends(void **state)
{
    (void)state;
    struct sim s;
    struct worker w;
    sim_start(&s, "generic", NULL);
    worker_start(&w);
    done(&w, opening(&s, "generic"));
    assert_int_equal(worker_stop(&w), 0);
    worker_start(&w);
    done(&w, opening(&s, "generic")); // the body was let go
    struct camera_command c = { .kind = CAMERA_COLLECT, .n_objects = 1, .timeout_ms = 60000 };
    worker_send(&w, &c);
    wait_ms(50);
    assert_int_equal(worker_stop(&w), 0); // in the middle of a long wait, too
    worker_start(&w);
    assert_true(send(w.fd, "{\"do\":\"dance\"}", 14, 0) == 14);
    const int status = worker_stop(&w);
    assert_true(WIFEXITED(status) && WEXITSTATUS(status) == 1);
    sim_stop(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_frame_of_each_kind_comes_from_release_to_disk),
        cmocka_unit_test(a_lost_event_is_made_up_for_by_the_listing),
        cmocka_unit_test(a_frame_behind_many_folders_is_found_or_the_card_is_refused),
        cmocka_unit_test(the_wrong_body_is_not_used),
        cmocka_unit_test(what_a_body_says_is_text_and_moves_no_cursor),
        cmocka_unit_test(what_a_body_does_not_take_is_told_not_hidden),
        cmocka_unit_test(a_body_shows_itself_and_works_on),
        cmocka_unit_test(a_body_that_does_not_stop_showing_itself_is_told),
        cmocka_unit_test(a_flood_of_events_is_named_and_ends),
        cmocka_unit_test(a_busy_body_is_busy_and_not_bare_of_settings),
        cmocka_unit_test(a_full_card_is_the_card),
        cmocka_unit_test(a_broken_link_leaves_nothing_and_heals_by_opening),
        cmocka_unit_test(frames_that_do_not_unpack_get_no_name),
        cmocka_unit_test(short_frames_get_no_name),
        cmocka_unit_test(a_disk_that_was_full_for_a_moment_is_told_as_the_disk),
        cmocka_unit_test(nothing_is_written_over_a_strangers_file),
        cmocka_unit_test(killed_in_the_middle_a_frame_is_whole_or_not_there),
        cmocka_unit_test(hostile_replies_are_survived_or_kill_only_the_worker),
        cmocka_unit_test(without_a_daemon_or_with_another_protocol_it_ends),
    };
    if (scratch_open())
        return 1;
    const int failed = cmocka_run_group_tests_name("camera_worker", tests, NULL, NULL);
    scratch_empty();
    return scratch_close() ? 1 : failed;
}
