// tests/rigsim/server_shutter.c - the shutter lines' socket (shutter_line.h).
#include "solver/take/log.h"
#include "tests/rigsim/server_state.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

enum { REPORTS_MAX = 16384, BOOT_NS = 1000000000 };

int server_shutter_open(struct server *s)
{
    const char *path = s->settings->trigger_socket;
    struct sockaddr_un a = { .sun_family = AF_UNIX };
    if (!path)
        return 0;
    const size_t n = strlen(path);
    if (!n || n >= sizeof(a.sun_path)) {
        log_error("rigsim: --trigger-socket %s: found %zu characters; expected 1 .. %zu", path, n, sizeof(a.sun_path) - 1);
        return -EINVAL;
    }
    memcpy(a.sun_path, path, n);
    if (path[0] == '@')
        a.sun_path[0] = 0;
    else
        unlink(path);
    s->shutter_listener = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    const socklen_t size = (socklen_t)(offsetof(struct sockaddr_un, sun_path) + n + (path[0] != '@'));
    if (s->shutter_listener < 0 || bind(s->shutter_listener, (const struct sockaddr *)&a, size) ||
        listen(s->shutter_listener, SHUTTER_CLIENTS_MAX)) {
        const int err = -errno;
        log_error("rigsim: --trigger-socket %s: %s", path, strerror(-err));
        return err;
    }
    return server_watch(s, s->shutter_listener, server_name(NAME_SHUTTER_LISTENER, 0, 0), false, true);
}

static void close_client(struct server *s, struct shutter_client *client)
{
    bool any = false;
    close(client->fd);
    free(client->out);
    *client = (struct shutter_client){ .fd = -1 };
    for (int i = 0; i < SHUTTER_CLIENTS_MAX; i++)
        any |= s->client[i].fd >= 0;
    for (unsigned i = 0; !any && i < s->settings->n_cameras; i++) {
        struct camera *c = &s->camera[i];
        body_open_lines(&c->body);
        if (c->body.faults.no_power && !c->boot && c->body.battery_percent > 0)
            server_power(c, false, s->now_ns + BOOT_NS);
    }
}

void server_shutter_close(struct server *s)
{
    const char *path = s->settings->trigger_socket;
    for (int i = 0; i < SHUTTER_CLIENTS_MAX; i++) {
        if (s->client[i].fd >= 0)
            close(s->client[i].fd);
        free(s->client[i].out);
    }
    if (s->shutter_listener >= 0) {
        close(s->shutter_listener);
        if (path[0] != '@')
            unlink(path);
    }
}

void server_shutter_accept(struct server *s)
{
    const int fd = accept4(s->shutter_listener, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC);
    for (unsigned i = 0; fd >= 0 && i < SHUTTER_CLIENTS_MAX; i++)
        if (s->client[i].fd < 0) {
            if (server_watch(s, fd, server_name(NAME_SHUTTER_CLIENT, 0, i), false, true))
                break;
            s->client[i] = (struct shutter_client){ .fd = fd };
            return;
        }
    if (fd >= 0)
        close(fd);
}

static void queue(struct shutter_client *client, const struct shutter_line *r)
{
    if (client->n_out == client->capacity) {
        const size_t capacity = client->capacity ? 2 * client->capacity : 256;
        struct shutter_line *out = capacity <= REPORTS_MAX ? realloc(client->out, capacity * sizeof(*out)) : NULL;
        if (!out)
            return; // nobody reads
        client->out = out;
        client->capacity = capacity;
    }
    client->out[client->n_out++] = *r;
}

void server_shutter_tell(struct server *s, int client, const struct shutter_line *record)
{
    if (s->client[client].fd >= 0)
        queue(&s->client[client], record);
}

static int press_one(struct server *s, unsigned camera, const struct shutter_line *r)
{
    struct camera *c = &s->camera[camera];
    if (r->line == SHUTTER_LINE_POWER) {
        if (r->level)
            server_power(c, false, INT64_MAX);
        else if (c->body.faults.no_power && c->body.battery_percent > 0)
            server_power(c, false, s->now_ns + BOOT_NS);
        return 0;
    }
    const int err = body_line(&c->body, r->line, r->level, r->at_ns, r->tag);
    if (body_next_ns(&c->body) <= s->now_ns)
        server_step_camera(c);
    return err;
}

static int obey(struct server *s, int client, const struct shutter_line *r)
{
    if (r->kind == SHUTTER_LINE_HEAD)
        return server_head_move(s, client, r);
    if (r->kind != SHUTTER_LINE_SET || r->line < SHUTTER_LINE_HALF || r->line > SHUTTER_LINE_POWER || r->level > 1 || r->at_ns < 0)
        return -EINVAL;
    if (r->at_ns > s->now_ns + SHUTTER_LINE_HORIZON_NS)
        return -ETIME;
    if (r->channel != SHUTTER_LINE_ALL)
        return r->channel < s->settings->n_cameras ? press_one(s, r->channel, r) : -ENODEV;
    int first = 0;
    for (unsigned i = 0; i < s->settings->n_cameras; i++) {
        const int err = press_one(s, i, r);
        first = first ? first : err;
    }
    return first;
}

static void refuse(struct shutter_client *client, struct shutter_line r, int err)
{
    r.kind = SHUTTER_LINE_REFUSED;
    r.error = (uint32_t)-err;
    r.end_ns = r.lag_ns = 0;
    queue(client, &r);
}

static void flush(struct server *s, unsigned index)
{
    struct shutter_client *client = &s->client[index];
    size_t done = 0;
    while (done < client->n_out) {
        const size_t n = client->n_out - done < SHUTTER_LINE_PER_PACKET ? client->n_out - done : SHUTTER_LINE_PER_PACKET;
        if (send(client->fd, client->out + done, n * sizeof(client->out[0]), MSG_NOSIGNAL | MSG_DONTWAIT) < 0) {
            if (errno == EAGAIN || errno == EINTR)
                break;
            close_client(s, client);
            return;
        }
        done += n;
    }
    if (done)
        memmove(client->out, client->out + done, (client->n_out - done) * sizeof(client->out[0]));
    client->n_out -= done;
    const bool wants = client->n_out;
    if (wants != client->wants_write) {
        client->wants_write = wants;
        server_watch(s, client->fd, server_name(NAME_SHUTTER_CLIENT, 0, index), wants, false);
    }
}

void server_shutter_ready(struct server *s, unsigned index, bool readable)
{
    static struct shutter_line r[SHUTTER_LINE_PER_PACKET + 1];
    struct shutter_client *client = &s->client[index];
    if (client->fd < 0 || !readable)
        return;
    const ssize_t n = recv(client->fd, r, sizeof(r), MSG_DONTWAIT);
    if (n < 0 && (errno == EAGAIN || errno == EINTR))
        return;
    if (n <= 0) {
        close_client(s, client);
        return;
    }
    const size_t n_records = (size_t)n / sizeof(r[0]);
    if ((size_t)n % sizeof(r[0]) || n_records > SHUTTER_LINE_PER_PACKET) {
        refuse(client, (struct shutter_line){ 0 }, -EINVAL);
        return;
    }
    for (size_t i = 0; i < n_records; i++) {
        const int err = obey(s, (int)index, &r[i]);
        if (err)
            refuse(client, r[i], err);
    }
}

void server_shutter_report(struct server *s, unsigned camera, const struct body_event *e)
{
    const struct shutter_line r = { .kind = SHUTTER_LINE_SYNC, .channel = camera, .tag = e->tag, .at_ns = e->at_ns,
                                    .end_ns = e->end_ns, .lag_ns = e->lag_ns };
    for (int i = 0; i < SHUTTER_CLIENTS_MAX; i++)
        if (s->client[i].fd >= 0)
            queue(&s->client[i], &r);
}

void server_shutter_flush(struct server *s)
{
    for (unsigned i = 0; i < SHUTTER_CLIENTS_MAX; i++)
        if (s->client[i].fd >= 0 && (s->client[i].n_out || s->client[i].wants_write))
            flush(s, i);
}
