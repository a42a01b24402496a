// tests/board/boardsim.c - a rig whose trigger board is the real firmware in simavr: starts a program (rigd) that finds it on USB, and lays wires
// from its outputs to rigsim's cameras and from their flash-sync contacts back to its inputs.
//
//   rigsim --cameras 6 --trigger-socket /var/tmp/rigsim/wires &
//   boardsim --config rigd.conf --wires /var/tmp/rigsim/wires build/bin/rigd --config rigd.conf &
//   kill -USR1 %2        # a hand presses the button
//   kill -USR2 %2        # the USB cable falls out for a second
//
// The wires are WIRE_NS long, both ways: a camera's contact is heard of only when its exposure has ended, and the board must be told
// when it closed. So cameras expose that much before the board's edges, and all that is measured is exact nevertheless.
#include "rigd/config.h"
#include "rigd/shutter_line.h"
#include "solver/take/log.h"

#if !__has_include(<umockdev.h>) || !__has_include(<simavr/sim_avr.h>)
#include <stdio.h>

int main(void)
{
    fputs("boardsim: built without libumockdev-dev and libsimavr-dev: make deps\n", stderr);
    return 1;
}

#else
#include "tests/board/live_board.h"

#include <argp.h>
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define MS INT64_C(1000000)
#define WIRE_NS (100 * MS)
#define SLOT "2-3"
enum { PRESS_MS = 150, AWAY_MS = 1000 };

struct simulation {
    struct config config;
    const char *config_path, *wires, *image;
    double fast_ppm;
    char **program;
    int fd; // of rigsim
    struct live_board *board;
    struct usbfs *usb;
    uint8_t descriptors[82], outputs[SIMAVR_REGISTERS];
    size_t n_descriptors;
    char serial[40];
    int device_number;
};

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

// ---- wires -----------------------------------------------------------------------------------------------------------------------------

static int connect_to(const char *address)
{
    struct sockaddr_un a = { .sun_family = AF_UNIX };
    const size_t n = strlen(address);
    if (n >= sizeof(a.sun_path))
        return -1;
    memcpy(a.sun_path, address, n);
    if (address[0] == '@')
        a.sun_path[0] = 0;
    const int fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    return fd >= 0 && !connect(fd, (struct sockaddr *)&a, (socklen_t)(offsetof(struct sockaddr_un, sun_path) + n + (address[0] != '@'))) ? fd : -1;
}

static bool is_on(const uint8_t *outputs, int line)
{
    return line >= 0 && outputs[line / 8] >> line % 8 & 1;
}

// What hangs on the outputs that changed, in one packet: one edge is one instant.
static void on_outputs(void *arg, const struct live_edge *e)
{
    struct simulation *s = arg;
    struct shutter_line record[SHUTTER_LINE_PER_PACKET];
    int n = 0;
    for (int i = 0; i < s->config.n_cameras && n + 3 <= SHUTTER_LINE_PER_PACKET; i++) {
        const struct config_camera *c = &s->config.camera[i];
        const struct { int line; enum shutter_line_name name; } wires[] = {
            { c->half_line == CONFIG_NONE ? s->config.trigger.half_line : c->half_line, SHUTTER_LINE_HALF },
            { c->full_line == CONFIG_NONE ? s->config.trigger.full_line : c->full_line, SHUTTER_LINE_FULL },
            { c->relay_line, SHUTTER_LINE_POWER },
        };
        for (int k = 0; k < 3; k++)
            if (is_on(e->outputs, wires[k].line) != is_on(s->outputs, wires[k].line))
                record[n++] = (struct shutter_line){ .kind = SHUTTER_LINE_SET, .line = (uint8_t)wires[k].name, .level = is_on(e->outputs, wires[k].line), .channel = (uint32_t)i,
                    .at_ns = e->at_ns - WIRE_NS };
    }
    memcpy(s->outputs, e->outputs, sizeof(s->outputs));
    if (n && send(s->fd, record, (size_t)n * sizeof(record[0]), MSG_NOSIGNAL) < 0)
        log_error("boardsim: rigsim is gone: %s", strerror(errno));
}

static bool hear_cameras(struct simulation *s)
{
    struct shutter_line record[SHUTTER_LINE_PER_PACKET];
    const ssize_t size = recv(s->fd, record, sizeof(record), 0);
    for (ssize_t i = 0; i < size / (ssize_t)sizeof(record[0]); i++) {
        const struct shutter_line *r = &record[i];
        const int line = r->kind == SHUTTER_LINE_SYNC && r->channel < (uint32_t)s->config.n_cameras ? s->config.camera[r->channel].feedback_line : CONFIG_NONE;
        if (line == CONFIG_NONE)
            continue;
        const enum live_what what = line == CONFIG_CAPTURE ? LIVE_CAPTURE : LIVE_INPUT;
        if (r->at_ns + WIRE_NS < clock_ns())
            log_warning("boardsim: camera %u exposed for longer than the wires last: its contact closes late", r->channel);
        live_board_set(s->board, what, line, true, r->at_ns + WIRE_NS);
        live_board_set(s->board, what, line, false, r->end_ns + WIRE_NS);
    }
    return size > 0;
}

// ---- hands -----------------------------------------------------------------------------------------------------------------------------

static int plug_in(struct simulation *s)
{
    return usbfs_plug(s->usb, SLOT, ++s->device_number, s->descriptors, s->n_descriptors, s->serial);
}

static int serve(struct simulation *s, pid_t child, int signals)
{
    struct pollfd p[] = { { .fd = s->fd, .events = POLLIN }, { .fd = signals, .events = POLLIN } };
    int64_t plug_ns = INT64_MAX;
    int status;
    for (;;) {
        const int n = poll(p, 2, plug_ns == INT64_MAX ? -1 : 50);
        if (n < 0 && errno != EINTR)
            return 1;
        if (clock_ns() >= plug_ns) {
            plug_ns = INT64_MAX;
            if (plug_in(s))
                return 1;
        }
        if (p[0].revents && !hear_cameras(s)) {
            log_error("boardsim: rigsim is gone");
            kill(child, SIGTERM);
            p[0].fd = -1;
        }
        struct signalfd_siginfo si;
        if (!p[1].revents || read(signals, &si, sizeof(si)) != sizeof(si))
            continue;
        if (si.ssi_signo == SIGUSR1) {
            live_board_set(s->board, LIVE_BUTTON, 0, true, clock_ns());
            live_board_set(s->board, LIVE_BUTTON, 0, false, clock_ns() + PRESS_MS * MS);
        } else if (si.ssi_signo == SIGUSR2 && plug_ns == INT64_MAX) {
            usbfs_unplug(s->usb);
            plug_ns = clock_ns() + AWAY_MS * MS;
        } else if (si.ssi_signo == SIGCHLD && waitpid(child, &status, WNOHANG) == child) {
            return WIFEXITED(status) ? WEXITSTATUS(status) : 1;
        } else if (si.ssi_signo == SIGTERM || si.ssi_signo == SIGINT) {
            kill(child, SIGTERM); // and we end when it has
        }
    }
}

// ---- command line ------------------------------------------------------------------------------------------------------------------------

const char *argp_program_version = "boardsim (studiorig) " STUDIORIG_VERSION;
static const char doc[] = "Run PROGRAM (rigd) with the trigger board's real firmware, in simavr, on its USB, wired to rigsim's cameras as the configuration says.\v"
                          "SIGUSR1 presses the button; SIGUSR2 pulls the board's USB cable for a second. Ends with PROGRAM, with its exit status.";
static const struct argp_option options[] = {
    { "config", 'c', "FILE", 0, "rigd.conf with [trigger] kind = usb: which output presses which camera", 0 },
    { "wires", 'w', "PATH", 0, "rigsim's --trigger-socket", 0 },
    { "firmware", 'f', "ELF", 0, "image (default build/firmware/trigger.elf)", 0 },
    { "fast", 'p', "PPM", 0, "how much the board's crystal is fast (default 37)", 0 },
    { 0 },
};

static error_t option(int key, char *text, struct argp_state *state)
{
    struct simulation *s = state->input;
    switch (key) {
    case 'c':
        s->config_path = text;
        return 0;
    case 'w':
        s->wires = text;
        return 0;
    case 'f':
        s->image = text;
        return 0;
    case 'p':
        s->fast_ppm = atoi(text);
        return 0;
    case ARGP_KEY_ARG:
        s->program = &state->argv[state->next - 1];
        state->next = state->argc;
        return 0;
    case ARGP_KEY_END:
        if (!s->config_path || !s->wires || !s->program)
            argp_error(state, "expected --config FILE --wires PATH PROGRAM ...");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

// It finds a host that dies within a request worth a word.
static void ignore(const gchar *domain, GLogLevelFlags level, const gchar *text, gpointer arg)
{
    (void)domain, (void)level, (void)text, (void)arg;
}

int main(int argc, char **argv)
{
    static struct simulation s = { .image = "build/firmware/trigger.elf", .fast_ppm = 37, .fd = -1, .device_number = 4 };
    const struct argp parser = { options, option, "PROGRAM [ARGUMENTS...]", doc, NULL, NULL, NULL };
    sigset_t set;
    int status = 1;
    argp_err_exit_status = 2;
    log_set_program("boardsim");
    usbfs_preload(argv);
    argp_parse(&parser, argc, argv, ARGP_IN_ORDER, NULL, &s);
    if (config_read(&s.config, s.config_path))
        return 2;
    sigemptyset(&set);
    for (size_t i = 0; i < 5; i++)
        sigaddset(&set, (const int[]){ SIGUSR1, SIGUSR2, SIGCHLD, SIGTERM, SIGINT }[i]);
    sigprocmask(SIG_BLOCK, &set, NULL); // before umockdev's and our threads
    UMockdevTestbed *bed = umockdev_testbed_new();
    g_log_set_handler(NULL, G_LOG_LEVEL_CRITICAL, ignore, NULL);
    if (!umockdev_in_mock_environment()) {
        log_error("boardsim: libumockdev-preload.so.0 cannot be preloaded: install libumockdev-dev");
        return 1;
    }
    s.fd = connect_to(s.wires);
    if (s.fd < 0) {
        log_error("boardsim: no rigsim at %s (%s): start rigsim --trigger-socket %s", s.wires, strerror(errno), s.wires);
        return 1;
    }
    if (live_board_open(&s.board, s.image, s.fast_ppm, on_outputs, &s))
        return 1;
    s.n_descriptors = live_board_descriptors(s.board, s.descriptors, sizeof(s.descriptors), s.serial);
    if (s.n_descriptors && !usbfs_new(&s.usb, bed, &live_board_ops, s.board) && !plug_in(&s)) {
        const pid_t child = fork();
        if (!child) {
            prctl(PR_SET_PDEATHSIG, SIGTERM);
            sigprocmask(SIG_UNBLOCK, &set, NULL);
            execv(s.program[0], s.program);
            _exit(127);
        }
        status = child < 0 ? 1 : serve(&s, child, signalfd(-1, &set, SFD_CLOEXEC));
    }
    usbfs_free(s.usb);
    live_board_close(s.board);
    close(s.fd);
    config_free(&s.config);
    g_object_unref(bed);
    return status;
}
#endif
