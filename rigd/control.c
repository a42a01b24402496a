// rigd/control.c - lines in, lines out, for many clients of whom none is trusted and none is waited for.
//
// A token names one open request: client and running number. Its reply goes out when somebody has it; if the client is gone by then,
// the token names nothing any more. Subscribing is done here; every other request is the handler's.
#include "rigd/control.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

enum { OPEN_MAX_PER_CLIENT = 32, ID_MAX_BYTES = 64, EVENTS_BACKLOG = 1 << 20, BUDGET = 64 };

struct request {
    uint64_t token; // 0: free
    char id[ID_MAX_BYTES + 16]; // as JSON
};

struct client {
    bool used, subscribed, ended; // ended: it will say no more
    bool dropped;                 // to be closed when nobody is looking at it
    int fd;                       // -1: virtual
    char *in;
    size_t n_in;
    char *out;
    size_t n_out, room_out;
    uint64_t n_lost; // events
    struct request request[OPEN_MAX_PER_CLIENT];
};

struct control {
    int epoll_fd, listen_fd;
    char *path;
    control_handler *handler;
    void *arg;
    uint64_t last_token, last_event;
    struct client client[CONTROL_CLIENTS_MAX];
};

// ---- clients ---------------------------------------------------------------------------------------------------------------------

static int add_client(struct control *c, int fd)
{
    for (int i = 0; i < CONTROL_CLIENTS_MAX; i++) {
        struct client *k = &c->client[i];
        if (k->used)
            continue;
        *k = (struct client){ .used = true, .fd = fd, .in = malloc(CONTROL_LINE_MAX) };
        if (!k->in) {
            k->used = false;
            return -ENOMEM;
        }
        return i;
    }
    return -EMFILE;
}

static void close_client(struct control *c, int i)
{
    struct client *k = &c->client[i];
    if (k->fd >= 0)
        close(k->fd); // leaves the epoll set by itself
    free(k->in);
    free(k->out);
    *k = (struct client){ .fd = -1 };
}

static void watch(struct control *c, int i)
{
    struct client *k = &c->client[i];
    if (k->fd < 0 || k->dropped)
        return;
    struct epoll_event e = { .events = (k->ended ? 0 : EPOLLIN) | (k->n_out ? EPOLLOUT : 0), .data.u32 = (uint32_t)i };
    epoll_ctl(c->epoll_fd, EPOLL_CTL_MOD, k->fd, &e);
}

static void write_out(struct client *k)
{
    size_t sent = 0;
    while (k->fd >= 0 && sent < k->n_out) {
        const ssize_t n = send(k->fd, k->out + sent, k->n_out - sent, MSG_NOSIGNAL | MSG_DONTWAIT);
        if (n < 0 && errno == EINTR)
            continue;
        if (n < 0 && errno != EAGAIN)
            k->dropped = true;
        if (n < 0)
            break;
        sent += (size_t)n;
    }
    if (sent)
        memmove(k->out, k->out + sent, k->n_out - sent);
    k->n_out -= sent;
}

// False: it does not fit.
static bool append(struct client *k, const char *text, size_t n, size_t most)
{
    if (k->n_out + n > most)
        return false;
    if (k->n_out + n > k->room_out) {
        const size_t room = (k->n_out + n) * 2;
        char *grown = realloc(k->out, room);
        if (!grown)
            return false;
        k->out = grown;
        k->room_out = room;
    }
    memcpy(k->out + k->n_out, text, n);
    k->n_out += n;
    return true;
}

static bool has_open_requests(const struct client *k)
{
    for (int i = 0; i < OPEN_MAX_PER_CLIENT; i++)
        if (k->request[i].token)
            return true;
    return false;
}

// ---- replies and events --------------------------------------------------------------------------------------------------------------

// A complete line to one client; one that lets its replies pile up has left.
static void send_line(struct control *c, int i, char *text)
{
    struct client *k = &c->client[i];
    if (!text || !append(k, text, strlen(text), CONTROL_BACKLOG_MAX) || !append(k, "\n", 1, CONTROL_BACKLOG_MAX + 1))
        k->dropped = true;
    free(text);
    write_out(k);
    watch(c, i);
}

static struct json *envelope(const char *id)
{
    struct json *doc = json_new_object(), *parsed = NULL;
    json_set_int(doc, "v", CONTROL_PROTOCOL);
    if (id[0] == '"' || id[0] == '-' || (id[0] >= '0' && id[0] <= '9')) { // it was one of ours: [id], so that a bare value parses
        char list[ID_MAX_BYTES + 32];
        snprintf(list, sizeof(list), "{\"id\":%s}", id);
        if (!json_parse(&parsed, list, strlen(list), NULL)) {
            const char *text;
            int64_t number;
            if (!json_get_string(parsed, "id", &text))
                json_set_string(doc, "id", text);
            else if (!json_get_int(parsed, "id", &number))
                json_set_int(doc, "id", number);
            json_free(parsed);
        }
    }
    return doc;
}

static void answer(struct control *c, uint64_t token, bool ok, const char *key, struct json *body)
{
    for (int i = 0; token && i < CONTROL_CLIENTS_MAX; i++)
        for (int r = 0; r < OPEN_MAX_PER_CLIENT; r++) {
            struct request *q = &c->client[i].request[r];
            if (!c->client[i].used || q->token != token)
                continue;
            struct json *doc = envelope(q->id);
            q->token = 0;
            json_set_bool(doc, "ok", ok);
            json_set(doc, key, body);
            send_line(c, i, json_text(doc));
            json_free(doc);
            return;
        }
    json_free(body);
}

void control_reply(struct control *c, uint64_t token, struct json *result)
{
    answer(c, token, true, "result", result);
}

static struct json *error_json(const char *code, const char *text)
{
    struct json *e = json_new_object();
    json_set_string(e, "code", code);
    json_set_string(e, "text", text);
    return e;
}

void control_refuse(struct control *c, uint64_t token, const char *code, const char *text)
{
    answer(c, token, false, "error", error_json(code, text));
}

// A refusal without a request: what came is not one.
static void refuse_line(struct control *c, int i, const char *code, const char *text)
{
    struct json *doc = envelope("");
    json_set_bool(doc, "ok", false);
    json_set(doc, "error", error_json(code, text));
    send_line(c, i, json_text(doc));
    json_free(doc);
}

bool control_has_subscribers(const struct control *c)
{
    for (int i = 0; i < CONTROL_CLIENTS_MAX; i++)
        if (c->client[i].used && c->client[i].subscribed)
            return true;
    return false;
}

void control_publish(struct control *c, const char *event, struct json *body)
{
    struct json *doc = json_new_object();
    json_set_int(doc, "v", CONTROL_PROTOCOL);
    json_set_string(doc, "event", event);
    json_set_int(doc, "n", (int64_t)++c->last_event);
    json_set(doc, "body", body);
    char *text = json_text(doc);
    json_free(doc);
    const size_t n = text ? strlen(text) : 0;
    for (int i = 0; text && i < CONTROL_CLIENTS_MAX; i++) {
        struct client *k = &c->client[i];
        char lost[80];
        if (!k->used || !k->subscribed || k->dropped)
            continue;
        const int n_lost = k->n_lost ? snprintf(lost, sizeof(lost), "{\"v\":%d,\"event\":\"lost\",\"body\":{\"n\":%llu}}\n", CONTROL_PROTOCOL, (unsigned long long)k->n_lost) : 0;
        if (k->n_out + n + 1 + (size_t)n_lost > EVENTS_BACKLOG) {
            k->n_lost++;
            continue;
        }
        if ((n_lost && !append(k, lost, (size_t)n_lost, EVENTS_BACKLOG)) || !append(k, text, n, EVENTS_BACKLOG) || !append(k, "\n", 1, EVENTS_BACKLOG))
            k->dropped = true;
        k->n_lost = 0;
        write_out(k);
        watch(c, i);
    }
    free(text);
}

// ---- requests --------------------------------------------------------------------------------------------------------------------------

static void take_line(struct control *c, int i, const char *line, size_t n)
{
    struct json *doc = NULL;
    const char *what = NULL, *id_text = NULL;
    int64_t id_number = 0, version = CONTROL_PROTOCOL;
    struct client *k = &c->client[i];
    struct request *q = NULL;
    if (json_parse(&doc, line, n, NULL) || json_get_string(doc, "do", &what)) {
        refuse_line(c, i, "not_a_request", "expected one JSON object per line, {\"v\":1,\"id\":1,\"do\":\"status\"}");
        json_free(doc);
        return;
    }
    for (int r = 0; r < OPEN_MAX_PER_CLIENT && !q; r++)
        if (!k->request[r].token)
            q = &k->request[r];
    if (!q) {
        refuse_line(c, i, "too_many_requests", "wait for answers before asking more");
        json_free(doc);
        return;
    }
    *q = (struct request){ .token = ++c->last_token };
    const uint64_t token = q->token;
    if (!json_get_string(doc, "id", &id_text) && strlen(id_text) <= ID_MAX_BYTES / 6) { // escaped: at most six bytes each
        struct json *only = json_new_object();
        json_set_string(only, "id", id_text);
        char *text = json_text(only); // {"id": "..."}
        const char *colon = text ? strchr(text, ':') : NULL;
        const char *value = colon ? colon + 1 + strspn(colon + 1, " ") : "";
        if (value[0] && strlen(value) - 1 < sizeof(q->id))
            snprintf(q->id, sizeof(q->id), "%.*s", (int)strlen(value) - 1, value);
        free(text);
        json_free(only);
    } else if (!json_get_int(doc, "id", &id_number)) {
        snprintf(q->id, sizeof(q->id), "%lld", (long long)id_number);
    }
    if (json_get(doc, "v") && (json_get_int(doc, "v", &version) || version != CONTROL_PROTOCOL)) {
        char text[100];
        snprintf(text, sizeof(text), "this rigd speaks version %d; install rigctl and rigd from one version", CONTROL_PROTOCOL);
        control_refuse(c, token, "version", text);
    } else if (!strcmp(what, "subscribe")) {
        k->subscribed = true;
        control_reply(c, token, json_new_object());
    } else {
        c->handler(c->arg, token, what, doc);
    }
    json_free(doc);
}

// Everything that came: whole lines are taken, the rest waits.
static void take_bytes(struct control *c, int i, const char *bytes, size_t n)
{
    struct client *k = &c->client[i];
    while (n && !k->dropped) {
        const char *newline = memchr(bytes, '\n', n);
        const size_t part = newline ? (size_t)(newline - bytes) : n;
        if (k->n_in + part > CONTROL_LINE_MAX) {
            refuse_line(c, i, "line_too_long", "a line holds at most 65536 bytes");
            k->dropped = true;
            return;
        }
        memcpy(k->in + k->n_in, bytes, part);
        k->n_in += part;
        bytes += part, n -= part;
        if (!newline)
            return;
        bytes++, n--;
        const size_t length = k->n_in;
        k->n_in = 0;
        if (length && !(length == 1 && k->in[0] == '\r'))
            take_line(c, i, k->in, length);
    }
}

static void read_in(struct control *c, int i)
{
    char bytes[16384];
    struct client *k = &c->client[i];
    for (int turn = 0; turn < 4 && !k->dropped && !k->ended; turn++) { // then somebody else's turn
        const ssize_t n = recv(k->fd, bytes, sizeof(bytes), MSG_DONTWAIT);
        if (n > 0) {
            take_bytes(c, i, bytes, (size_t)n);
        } else if (n == 0) {
            k->ended = true; // it may still wait for answers
            watch(c, i);
        } else if (errno == EAGAIN) {
            return;
        } else if (errno != EINTR) {
            k->dropped = true;
        }
    }
}

static void welcome(struct control *c)
{
    const int fd = accept4(c->listen_fd, NULL, NULL, SOCK_CLOEXEC | SOCK_NONBLOCK);
    if (fd < 0)
        return;
    const int i = add_client(c, fd);
    struct epoll_event e = { .events = EPOLLIN, .data.u32 = (uint32_t)i };
    if (i < 0) {
        static const char full[] = "{\"v\":1,\"ok\":false,\"error\":{\"code\":\"too_many_clients\",\"text\":\"close another rigctl first\"}}\n";
        send(fd, full, sizeof(full) - 1, MSG_NOSIGNAL | MSG_DONTWAIT);
        close(fd);
    } else if (epoll_ctl(c->epoll_fd, EPOLL_CTL_ADD, fd, &e)) {
        close_client(c, i);
    }
}

static void sweep(struct control *c)
{
    for (int i = 0; i < CONTROL_CLIENTS_MAX; i++) {
        struct client *k = &c->client[i];
        if (k->used && k->fd >= 0 && (k->dropped || (k->ended && !k->n_out && !has_open_requests(k))))
            close_client(c, i);
    }
}

void control_dispatch(struct control *c)
{
    struct epoll_event events[BUDGET];
    const int n = epoll_wait(c->epoll_fd, events, BUDGET, 0);
    for (int e = 0; e < n; e++) {
        const uint32_t i = events[e].data.u32;
        if (i == UINT32_MAX) {
            welcome(c);
            continue;
        }
        struct client *k = &c->client[i];
        if (!k->used || k->fd < 0)
            continue;
        if (events[e].events & EPOLLIN)
            read_in(c, (int)i);
        if (events[e].events & EPOLLOUT) {
            write_out(k);
            watch(c, (int)i);
        }
        if ((events[e].events & (EPOLLHUP | EPOLLERR)) && !(events[e].events & EPOLLIN))
            k->dropped = true;
    }
    sweep(c);
}

// ---- life ------------------------------------------------------------------------------------------------------------------------------

int control_open_virtual(struct control **out, control_handler *handler, void *arg)
{
    struct control *c = calloc(1, sizeof(*c));
    if (!c)
        return -ENOMEM;
    c->handler = handler;
    c->arg = arg;
    c->listen_fd = -1;
    c->epoll_fd = epoll_create1(EPOLL_CLOEXEC);
    if (c->epoll_fd < 0) {
        const int err = -errno;
        control_close(c);
        return err;
    }
    *out = c;
    return 0;
}

// Somebody behind that socket? A file that nobody listens on was left by a daemon that died.
static int make_room(const struct sockaddr_un *address)
{
    struct stat st;
    if (lstat(address->sun_path, &st))
        return errno == ENOENT ? 0 : -errno;
    if (!S_ISSOCK(st.st_mode))
        return -EEXIST;
    const int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    if (fd < 0)
        return -errno;
    const bool dead = connect(fd, (const struct sockaddr *)address, sizeof(*address)) && errno == ECONNREFUSED;
    close(fd);
    if (!dead)
        return -EADDRINUSE;
    return unlink(address->sun_path) ? -errno : 0;
}

int control_open(struct control **out, const char *path, control_handler *handler, void *arg)
{
    struct sockaddr_un address = { .sun_family = AF_UNIX };
    struct control *c = NULL;
    int err = -ENAMETOOLONG;
    if (strlen(path) >= sizeof(address.sun_path))
        goto fail;
    strcpy(address.sun_path, path);
    err = control_open_virtual(&c, handler, arg);
    if (err)
        goto fail;
    c->listen_fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    err = c->listen_fd < 0 ? -errno : make_room(&address);
    if (err)
        goto fail;
    const mode_t mask = umask(0117); // owner and group: 0660 from the first moment on
    err = bind(c->listen_fd, (const struct sockaddr *)&address, sizeof(address)) ? -errno : 0;
    umask(mask);
    if (err)
        goto fail;
    c->path = strdup(path);
    struct epoll_event e = { .events = EPOLLIN, .data.u32 = UINT32_MAX };
    if (!c->path || listen(c->listen_fd, 16) || epoll_ctl(c->epoll_fd, EPOLL_CTL_ADD, c->listen_fd, &e)) {
        err = c->path ? -errno : -ENOMEM;
        goto fail;
    }
    *out = c;
    return 0;
fail:
    log_error("control: cannot listen on %s: %s%s", path, strerror(-err), err == -EADDRINUSE ? "; another rigd is running: stop it, or choose another --socket" : "");
    control_close(c);
    return err;
}

void control_close(struct control *c)
{
    if (!c)
        return;
    for (int i = 0; i < CONTROL_CLIENTS_MAX; i++)
        if (c->client[i].used)
            close_client(c, i);
    if (c->listen_fd >= 0)
        close(c->listen_fd);
    if (c->path)
        unlink(c->path);
    if (c->epoll_fd >= 0)
        close(c->epoll_fd);
    free(c->path);
    free(c);
}

int control_fd(const struct control *c)
{
    return c->epoll_fd;
}

// ---- clients that are not sockets ----------------------------------------------------------------------------------------------------

int control_virtual_client(struct control *c)
{
    return add_client(c, -1);
}

void control_feed(struct control *c, int client, const char *bytes, size_t n_bytes)
{
    take_bytes(c, client, bytes, n_bytes);
}

char *control_take(struct control *c, int client)
{
    struct client *k = &c->client[client];
    char *text = strndup(k->out ? k->out : "", k->n_out);
    k->n_out = 0;
    return text;
}
