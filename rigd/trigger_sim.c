// rigd/trigger_sim.c - the simulated rig's wires and its panorama head: rigsim's shutter lines (rigd/shutter_line.h) over its socket.
//
// rigsim counts lag from the time written into a change, so this trigger is exact however busy the host is; what a real host would
// have added is not simulated here.
#include "rigd/shutter_line.h"
#include "rigd/trigger_lines.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

struct simulated {
    int fd, n_outputs, n_inputs;
    int line[EDGES_WIRES_MAX]; // of each output: EDGES_LINE_OF(camera, role)
    uint64_t was_active[LINES_WORDS];
    bool head_moves, head_stands; // asked to | and has arrived, which nobody has been told
    int head_err;
    uint64_t head_tag;
    char address[108];
};

static void simulated_close(void *self)
{
    struct simulated *s = self;
    if (s && s->fd >= 0)
        close(s->fd); // the last client gone, rigsim releases everything
    free(s);
}

static int simulated_open(void **self, const struct config *config, const struct lines_wanted *wanted)
{
    const char *address = config->trigger.address;
    struct sockaddr_un a = { .sun_family = AF_UNIX };
    socklen_t length = offsetof(struct sockaddr_un, sun_path) + strlen(address);
    struct simulated *s = calloc(1, sizeof(*s));
    int err;
    if (!s)
        return -ENOMEM;
    s->n_outputs = wanted->n_outputs;
    s->n_inputs = wanted->n_inputs;
    for (int i = 0; i < wanted->n_outputs; i++)
        s->line[i] = wanted->output[i].line;
    strncpy(s->address, address, sizeof(s->address) - 1);
    memcpy(a.sun_path, s->address, sizeof(a.sun_path));
    if (address[0] == '@')
        a.sun_path[0] = '\0'; // a name without a file
    else
        length++;
    s->fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    if (s->fd < 0 || connect(s->fd, (struct sockaddr *)&a, length)) {
        err = errno == ENOENT || errno == ECONNREFUSED ? -ENODEV : -errno;
        log_error("trigger: no simulated rig at %s (%s): start rigsim --trigger-socket %s", address, strerror(errno), address);
        simulated_close(s);
        return err;
    }
    *self = s;
    return 0;
}

static int send_records(struct simulated *s, const struct shutter_line *record, int n)
{
    const ssize_t size = n * (ssize_t)sizeof(*record);
    if (n == 0 || send(s->fd, record, (size_t)size, MSG_NOSIGNAL) == size)
        return 0;
    return errno == EAGAIN ? -EIO : -errno; // a rigsim that does not read is as good as gone
}

static int simulated_set(void *self, const uint64_t *active, const uint64_t *changed, int64_t at_ns)
{
    static const uint8_t name_of[] = { [EDGES_FULL] = SHUTTER_LINE_FULL, [EDGES_HALF] = SHUTTER_LINE_HALF,
        [EDGES_RELAY] = SHUTTER_LINE_POWER };
    struct simulated *s = self;
    struct shutter_line record[SHUTTER_LINE_PER_PACKET];
    int n = 0, err = 0;
    for (int i = 0; i < s->n_outputs && !err; i++) {
        const uint64_t bit = UINT64_C(1) << i % 64;
        if (!(changed[i / 64] & (active[i / 64] ^ s->was_active[i / 64]) & bit))
            continue;
        record[n++] = (struct shutter_line){ .kind = SHUTTER_LINE_SET, .line = name_of[s->line[i] % EDGES_N_ROLES],
            .level = (active[i / 64] & bit) != 0, .channel = (uint32_t)s->line[i] / EDGES_N_ROLES, .at_ns = at_ns };
        s->was_active[i / 64] ^= bit;
        if (n == SHUTTER_LINE_PER_PACKET) {
            err = send_records(s, record, n);
            n = 0;
        }
    }
    return err ? err : send_records(s, record, n);
}

static int simulated_head(void *self, int32_t yaw_mdeg, int32_t pitch_mdeg)
{
    struct simulated *s = self;
    if (s->head_moves)
        return -EBUSY;
    const struct shutter_line record = { .kind = SHUTTER_LINE_HEAD, .tag = ++s->head_tag, .yaw_mdeg = yaw_mdeg, .pitch_mdeg = pitch_mdeg };
    const int err = send_records(s, &record, 1);
    s->head_moves = !err;
    s->head_stands = false;
    return err;
}

static bool simulated_arrived(void *self, int *err)
{
    struct simulated *s = self;
    const bool stands = s->head_stands;
    *err = s->head_err;
    s->head_stands = false;
    return stands;
}

static int simulated_fd(const void *self)
{
    return ((const struct simulated *)self)->fd;
}

static int simulated_read(void *self, struct lines_edge *edge, int max)
{
    struct simulated *s = self;
    struct shutter_line record[SHUTTER_LINE_PER_PACKET];
    // No more than fit: the rest of a packet would be lost, so it is looked at first.
    const ssize_t size = recv(s->fd, NULL, 0, MSG_PEEK | MSG_TRUNC);
    const int n_records = (int)(size / (ssize_t)sizeof(*record));
    int n = 0;
    if (size < 0 && (errno == EAGAIN || errno == EINTR))
        return 0;
    if (size <= 0 || size % (ssize_t)sizeof(*record) || n_records > max || recv(s->fd, record, sizeof(record), 0) != size) {
        const int err = size < 0 ? -errno : size == 0 ? -EPIPE : -EPROTO;
        log_error("trigger: the simulated rig at %s is gone: %s", s->address, strerror(-err));
        return err;
    }
    for (int i = 0; i < n_records; i++) {
        const struct shutter_line *r = &record[i];
        if (r->kind == SHUTTER_LINE_SYNC && r->channel < (uint32_t)s->n_inputs)
            edge[n++] = (struct lines_edge){ (int)r->channel, true, r->at_ns };
        else if (s->head_moves && r->tag == s->head_tag && (r->kind == SHUTTER_LINE_ARRIVED || (r->kind == SHUTTER_LINE_REFUSED && !r->line))) {
            s->head_moves = false;
            s->head_stands = true;
            s->head_err = -(int)r->error;
        } else if (r->kind == SHUTTER_LINE_REFUSED)
            log_warning("trigger: the simulated rig refused a change of camera %u: %s", r->channel, strerror((int)r->error));
    }
    return n;
}

static int simulated_level(void *self, int input)
{
    (void)self, (void)input;
    return -ENOTSUP;
}

static const struct lines_ops simulated_lines = { .timed = true, .open = simulated_open, .set = simulated_set, .fd = simulated_fd,
    .read = simulated_read, .level = simulated_level, .head = simulated_head, .arrived = simulated_arrived, .close = simulated_close };

static int trigger_simulated_open(void **self, const struct config *config, const struct trigger_host *host)
{
    return trigger_lines_open((struct trigger_lines **)self, config, host, &simulated_lines, true);
}

const struct trigger_ops trigger_simulated = { .open = trigger_simulated_open, .abilities = trigger_lines_abilities,
    .fire = trigger_lines_fire, .release = trigger_lines_release, .relay = trigger_lines_relay, .head = trigger_lines_head, .fd = trigger_lines_fd,
    .dispatch = trigger_lines_dispatch, .close = trigger_lines_close };
