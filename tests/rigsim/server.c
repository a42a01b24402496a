// tests/rigsim/server.c - see server.h. Cameras, connections and the loop; faults and shutter lines are in their own files.
#include "tests/rigsim/server.h"
#include "solver/take/log.h"
#include "tests/rigsim/server_state.h"
#include "tests/rigsim/probe.h"

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

enum { READ_BYTES = 65536, IN_MAX_BYTES = PTPIP_PACKET_MAX + READ_BYTES, DATA_MAX_BYTES = 1 << 20, OBJECT_CHUNK = 256 * 1024,
       EVENT_BACKLOG_BYTES = 1 << 20, FAIL_BUSY = 2, VERSION_1_0 = 0x10000 };

int64_t server_now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

const char *server_camera_name(unsigned camera)
{
    static char name[SERVER_CAMERAS_MAX][4];
    if (camera >= SERVER_CAMERAS_MAX)
        return "";
    char *n = name[camera];
    n[0] = (char)('A' + camera / 20);
    n[1] = (char)('0' + (camera % 20 + 1) / 10);
    n[2] = (char)('0' + (camera % 20 + 1) % 10);
    return n;
}

uint64_t server_name(unsigned kind, unsigned camera, unsigned which)
{
    return (uint64_t)kind << 48 | (uint64_t)camera << 16 | which;
}

int server_watch(struct server *s, int fd, uint64_t name, bool wants_write, bool is_new)
{
    struct epoll_event e = { .events = EPOLLIN | (wants_write ? EPOLLOUT : 0), .data.u64 = name };
    if (epoll_ctl(s->epoll, is_new ? EPOLL_CTL_ADD : EPOLL_CTL_MOD, fd, &e)) {
        const int err = -errno;
        log_error("rigsim: cannot watch a descriptor: %s", strerror(-err));
        return err;
    }
    return 0;
}

// ---- links -----------------------------------------------------------------------------------------------------------------

static void close_link(struct camera *c, struct link *l)
{
    if (l->role == LINK_FREE)
        return;
    close(l->fd);
    frame_close(l->frame);
    dataset_free(&l->in);
    dataset_free(&l->out);
    dataset_free(&l->data);
    const bool was_command = l == c->command;
    if (l == c->event)
        c->event = NULL;
    if (was_command)
        c->command = NULL;
    *l = (struct link){ .fd = -1 };
    if (was_command) { // without it the event connection means nothing
        ptp_session_reset(&c->session);
        if (c->event)
            close_link(c, c->event);
    }
}

void server_drop_links(struct camera *c)
{
    for (int i = 0; i < LINKS_PER_CAMERA; i++)
        close_link(c, &c->link[i]);
}

// What may go out now, by the fault `slow`; at least a byte, or 0 until the bucket has run down.
static size_t allowance(struct camera *c, size_t n)
{
    if (c->bytes_per_s <= 0)
        return n;
    c->bytes_ahead -= (double)(c->server->now_ns - c->bucket_ns) * 1e-9 * c->bytes_per_s;
    c->bucket_ns = c->server->now_ns;
    if (c->bytes_ahead < 0)
        c->bytes_ahead = 0;
    const size_t burst = (size_t)(c->bytes_per_s / 50) + 1;
    return c->bytes_ahead > 0 ? 0 : n < burst ? n : burst;
}

// The next packet of the object that is being sent, into an empty out.
static void next_of_object(struct link *l)
{
    const uint64_t left = l->frame_end - l->frame_at;
    const size_t n = left < OBJECT_CHUNK ? (size_t)left : OBJECT_CHUNK;
    const struct ptpip_packet p = { .type = n == left ? PTPIP_END_DATA : PTPIP_DATA, .transaction = l->response.transaction,
                                    .n_payload = n };
    ptpip_write(&l->out, &p);
    uint8_t *to = n ? dataset_room(&l->out, n) : NULL;
    if (to) {
        frame_read(l->frame, l->frame_at, to, n);
        for (size_t i = 0; l->corrupt && i < n; i += 4099)
            to[i] ^= 0x5a;
    }
    l->frame_at += n;
    if (n == left) {
        frame_close(l->frame);
        l->frame = NULL;
        ptpip_write(&l->out, &l->response);
    }
}

// Sends what can be sent. The link may be closed afterwards.
static void push(struct camera *c, struct link *l)
{
    for (;;) {
        if (l->out_at == l->out.n) {
            dataset_clear(&l->out);
            l->out_at = 0;
            if (!l->frame)
                break;
            next_of_object(l);
        }
        if (l->out.failed) {
            close_link(c, l);
            return;
        }
        const size_t n = allowance(c, l->out.n - l->out_at);
        if (!n)
            return; // server_faults_next_ns() knows when to go on
        const ssize_t sent = send(l->fd, l->out.data + l->out_at, n, MSG_NOSIGNAL | MSG_DONTWAIT);
        if (sent < 0 && errno != EAGAIN && errno != EINTR) {
            close_link(c, l);
            return;
        }
        if (sent < 0)
            break;
        l->out_at += (size_t)sent;
        if (c->bytes_per_s > 0)
            c->bytes_ahead += (double)sent;
    }
    if (l->closing && l->out_at == l->out.n) {
        close_link(c, l);
        return;
    }
    const bool wants = l->out_at < l->out.n || l->frame;
    if (wants != l->wants_write) {
        l->wants_write = wants;
        server_watch(c->server, l->fd, server_name(NAME_LINK, c->index, (unsigned)(l - c->link)), wants, false);
    }
}

static void send_packet(struct camera *c, struct link *l, const struct ptpip_packet *p)
{
    ptpip_write(&l->out, p);
    push(c, l);
}

// ---- answering ---------------------------------------------------------------------------------------------------------------

static void begin_object(struct camera *c, struct link *l, const struct ptp_reply *r)
{
    const struct body_object *o = body_object(&c->body, r->object);
    if (!o || frame_open(&l->frame, c->server->scene, &c->body, &o->exposure, o->file)) {
        l->response.code = PTP_GENERAL_ERROR;
        l->response.n_params = 0;
        ptpip_write(&l->out, &l->response);
        return;
    }
    l->corrupt = o->corrupt;
    l->frame_at = r->offset;
    l->frame_end = r->offset + r->n;
    const struct ptpip_packet start = { .type = PTPIP_START_DATA, .transaction = l->response.transaction, .total = r->n };
    ptpip_write(&l->out, &start);
}

static void answer(struct camera *c, struct link *l)
{
    const struct ptp_request *q = &l->request;
    struct ptp_reply *r = &c->reply;
    server_fault_trigger(c, FAULT_ON_OPERATION, q->code);
    if (l->role == LINK_FREE)
        return; // that trigger broke the link
    ptp_answer(&c->session, q, r);
    const size_t from = l->out.n;
    l->response = (struct ptpip_packet){ .type = PTPIP_RESPONSE, .code = r->code, .transaction = q->transaction,
                                         .n_params = r->n_params };
    memcpy(l->response.param, r->param, sizeof(r->param));
    if (r->object) {
        begin_object(c, l, r);
    } else {
        if (r->has_data) {
            server_spoil_data(c, &r->data);
            const struct ptpip_packet start = { .type = PTPIP_START_DATA, .transaction = q->transaction, .total = r->data.n };
            const struct ptpip_packet all = { .type = PTPIP_END_DATA, .transaction = q->transaction, .payload = r->data.data,
                                              .n_payload = r->data.n };
            ptpip_write(&l->out, &start);
            ptpip_write(&l->out, &all);
        }
        ptpip_write(&l->out, &l->response);
    }
    server_spoil_packets(c, &l->out, from);
    push(c, l);
}

static void fail_init(struct camera *c, struct link *l)
{
    const struct ptpip_packet no = { .type = PTPIP_INIT_FAIL, .reason = FAIL_BUSY };
    l->closing = true;
    send_packet(c, l, &no);
}

// A client that was killed and is back at once may come before the loop has heard that it went: by an end or, with bytes unread, a reset.
static void close_dead(struct camera *c, struct link *l)
{
    struct pollfd p = { .fd = l->fd, .events = POLLRDHUP };
    if (poll(&p, 1, 0) > 0 && (p.revents & (POLLRDHUP | POLLHUP | POLLERR)))
        close_link(c, l);
}

static void init_command(struct camera *c, struct link *l)
{
    if (c->command)
        close_dead(c, c->command);
    if (c->command) {
        fail_init(c, l);
        return;
    }
    struct ptpip_packet ack = { .type = PTPIP_INIT_COMMAND_ACK, .connection = ++c->connection, .version = VERSION_1_0 };
    snprintf(ack.name, sizeof(ack.name), "%s", c->body.personality->model);
    memcpy(ack.guid, c->body.serial, sizeof(ack.guid));
    l->role = LINK_COMMAND;
    c->command = l;
    c->n_connects++;
    send_packet(c, l, &ack);
    if (l->role != LINK_FREE)
        server_fault_trigger(c, FAULT_ON_CONNECT, c->n_connects);
}

static void init_event(struct camera *c, struct link *l, uint32_t connection)
{
    const struct ptpip_packet ack = { .type = PTPIP_INIT_EVENT_ACK };
    if (!c->command || c->event || connection != c->connection) {
        fail_init(c, l);
        return;
    }
    l->role = LINK_EVENT;
    c->event = l;
    send_packet(c, l, &ack);
}

static void command_packet(struct camera *c, struct link *l, const struct ptpip_packet *p)
{
    switch (p->type) {
    case PTPIP_COMMAND:
        l->request = (struct ptp_request){ .code = p->code, .transaction = p->transaction, .n_params = p->n_params };
        memcpy(l->request.param, p->param, sizeof(p->param));
        dataset_clear(&l->data);
        l->collecting = p->data_phase == 2;
        if (!l->collecting)
            answer(c, l);
        return;
    case PTPIP_START_DATA:
        if (!l->collecting || p->total > DATA_MAX_BYTES)
            close_link(c, l);
        return;
    case PTPIP_DATA:
    case PTPIP_END_DATA:
        if (!l->collecting || l->data.n + p->n_payload > DATA_MAX_BYTES) {
            close_link(c, l);
            return;
        }
        dataset_bytes(&l->data, p->payload, p->n_payload);
        if (p->type == PTPIP_DATA)
            return;
        l->collecting = false;
        l->request.data = l->data.data;
        l->request.n_data = l->data.n;
        answer(c, l);
        return;
    case PTPIP_CANCEL:
        l->collecting = false;
        return;
    default:
        close_link(c, l);
        return;
    }
}

static void packet(struct camera *c, struct link *l, const struct ptpip_packet *p)
{
    if (p->type == PTPIP_PING && l->role != LINK_NEW) {
        const struct ptpip_packet pong = { .type = PTPIP_PONG };
        send_packet(c, l, &pong);
    } else if (l->role == LINK_NEW && p->type == PTPIP_INIT_COMMAND_REQUEST) {
        init_command(c, l);
    } else if (l->role == LINK_NEW && p->type == PTPIP_INIT_EVENT_REQUEST) {
        init_event(c, l, p->connection);
    } else if (l->role == LINK_COMMAND) {
        command_packet(c, l, p);
    } else if (l->role == LINK_NEW || (p->type != PTPIP_CANCEL && p->type != PTPIP_PONG)) {
        close_link(c, l);
    }
}

// Work through what has come. Not while an answer is still going out, nor while the body is silent.
static void work(struct camera *c, struct link *l)
{
    size_t at = 0;
    while (l->role != LINK_FREE && !l->closing) {
        struct ptpip_packet p;
        size_t used;
        if (body_is_silent(&c->body) || server_is_stalled(c) || (l->role == LINK_COMMAND && (l->frame || l->out_at < l->out.n)))
            break;
        const int err = ptpip_parse(l->in.data + at, l->in.n - at, &p, &used);
        if (err == -EAGAIN)
            break;
        if (err) {
            log_debug("rigsim: %s: the client sent no PTP/IP packet", server_camera_name(c->index));
            close_link(c, l);
            return;
        }
        at += used;
        packet(c, l, &p);
    }
    if (l->role == LINK_FREE || !at)
        return;
    memmove(l->in.data, l->in.data + at, l->in.n - at);
    l->in.n -= at;
}

static void read_link(struct camera *c, struct link *l)
{
    if (l->in.n >= IN_MAX_BYTES) { // it floods a silent camera
        close_link(c, l);
        return;
    }
    uint8_t *to = dataset_room(&l->in, READ_BYTES);
    const ssize_t n = to ? recv(l->fd, to, READ_BYTES, MSG_DONTWAIT) : -1;
    if (to)
        l->in.n -= READ_BYTES - (n > 0 ? (size_t)n : 0);
    if (!to || n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR)) {
        close_link(c, l);
        return;
    }
    work(c, l);
}

// ---- cameras ---------------------------------------------------------------------------------------------------------------

int server_listen(struct camera *c)
{
    const struct server_settings *s = c->server->settings;
    for (unsigned k = 0; k < 2; k++) {
        if (c->listener[k] >= 0)
            continue;
        const int port = s->port + 2 * (int)c->index + (int)k, on = 1;
        const struct sockaddr_in a = { .sin_family = AF_INET, .sin_port = htons((uint16_t)port),
                                       .sin_addr.s_addr = inet_addr(s->address) };
        const int fd = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
        if (fd < 0 || setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on)) ||
            bind(fd, (const struct sockaddr *)&a, sizeof(a)) || listen(fd, 64)) {
            const int err = -errno;
            log_error("rigsim: %s:%d for camera %s: %s; choose another --address or --port", s->address, port,
                      server_camera_name(c->index), strerror(-err));
            if (fd >= 0)
                close(fd);
            return err;
        }
        c->listener[k] = fd;
        const int err = server_watch(c->server, fd, server_name(NAME_LISTENER, c->index, k), false, true);
        if (err)
            return err;
    }
    return 0;
}

void server_refuse(struct camera *c)
{
    for (int k = 0; k < 2; k++) {
        if (c->listener[k] >= 0)
            close(c->listener[k]);
        c->listener[k] = -1;
    }
}

static void accept_link(struct camera *c, unsigned k)
{
    const int fd = accept4(c->listener[k], NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC), on = 1;
    struct link *l = NULL;
    if (fd < 0)
        return;
    for (int i = 0; i < LINKS_PER_CAMERA && !l; i++)
        if (c->link[i].role == LINK_FREE)
            l = &c->link[i];
    if (!l || setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on)) ||
        server_watch(c->server, fd, server_name(NAME_LINK, c->index, (unsigned)(l - c->link)), false, true)) {
        close(fd);
        return;
    }
    *l = (struct link){ .role = LINK_NEW, .fd = fd };
}

void server_step_camera(struct camera *c)
{
    struct body_event e;
    for (bool more = true; more;) { // one by one, however late: what the script does at an exposure's end comes before the file's event
        const int64_t next_ns = body_next_ns(&c->body);
        more = next_ns <= c->server->now_ns;
        body_step(&c->body, more ? next_ns : c->server->now_ns);
        while (body_take_event(&c->body, &e)) {
            struct ptp_event wire;
            if (e.kind == BODY_EXPOSED) {
                server_shutter_report(c->server, c->index, &e);
                server_fault_trigger(c, FAULT_ON_SHOT, ++c->n_exposures);
            }
            if (!ptp_notice(&c->session, &e, &wire) || !c->event || c->event->out.n > EVENT_BACKLOG_BYTES)
                continue;
            const struct ptpip_packet p = { .type = PTPIP_EVENT, .code = wire.code, .n_params = 1, .param = { wire.param } };
            send_packet(c, c->event, &p);
        }
    }
}

// Whatever waited for time: an answer, bytes of a slow link.
static void resume(struct camera *c)
{
    for (int i = 0; i < LINKS_PER_CAMERA; i++) {
        struct link *l = &c->link[i];
        if (l->role != LINK_FREE && (l->frame || l->out_at < l->out.n))
            push(c, l);
        if (l->role != LINK_FREE && l->in.n)
            work(c, l);
    }
}

static int open_cameras(struct server *s)
{
    const struct server_settings *t = s->settings;
    struct timespec utc;
    clock_gettime(CLOCK_REALTIME, &utc);
    s->camera = calloc(t->n_cameras, sizeof(*s->camera));
    if (!s->camera)
        return -ENOMEM;
    for (unsigned i = 0; i < t->n_cameras; i++) {
        struct camera *c = &s->camera[i];
        c->server = s;
        c->index = i;
        c->listener[0] = c->listener[1] = -1;
        for (int k = 0; k < LINKS_PER_CAMERA; k++)
            c->link[k].fd = -1;
    }
    for (unsigned i = 0; i < t->n_cameras; i++) {
        struct camera *c = &s->camera[i];
        int err = body_init(&c->body, t->personality, i, t->seed, s->now_ns, (int64_t)utc.tv_sec * 1000000000 + utc.tv_nsec);
        if (err)
            return err;
        c->body.fixed_clock = t->fixed_clock;
        c->body.measure = frame_measure;
        c->body.measure_arg = s->scene;
        if (t->panorama && i == t->panorama_camera) {
            c->body.aim = server_head_aim;
            c->body.aim_arg = s;
        }
        ptp_session_init(&c->session, &c->body);
        c->session.thumbnail = frame_thumbnail;
        c->session.arg = s->scene;
        c->session.width_px = (uint32_t)t->width_px;
        c->session.height_px = (uint32_t)t->height_px;
        c->fault_count = calloc(t->faults && t->faults->n ? (size_t)t->faults->n : 1, sizeof(c->fault_count[0]));
        if (!c->fault_count)
            return -ENOMEM;
        err = server_listen(c);
        if (err)
            return err;
    }
    return 0;
}

// ---- the loop ----------------------------------------------------------------------------------------------------------------

// A handler, not a signalfd: libraries' own threads do not block what this one blocks.
static int end_requested = -1;

static void request_end(int signal_number)
{
    const uint64_t one = 1;
    const int saved = errno;
    (void)signal_number;
    if (write(end_requested, &one, sizeof(one)) < 0)
        _exit(1);
    errno = saved;
}

static int open_server(struct server *s)
{
    const struct server_settings *t = s->settings;
    struct rlimit files;
    if (!getrlimit(RLIMIT_NOFILE, &files)) {
        files.rlim_cur = files.rlim_max;
        setrlimit(RLIMIT_NOFILE, &files);
    }
    s->epoll = epoll_create1(EPOLL_CLOEXEC);
    s->timer = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC | TFD_NONBLOCK);
    s->signals = end_requested = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    if (s->epoll < 0 || s->timer < 0 || s->signals < 0) {
        const int err = -errno;
        log_error("rigsim: cannot make the loop: %s", strerror(-err));
        return err;
    }
    const struct sigaction on_end = { .sa_handler = request_end };
    sigaction(SIGTERM, &on_end, NULL);
    sigaction(SIGINT, &on_end, NULL);
    int err = server_watch(s, s->timer, server_name(NAME_TIMER, 0, 0), false, true);
    err = err ? err : server_watch(s, s->signals, server_name(NAME_SIGNALS, 0, 0), false, true);
    err = err ? err : scene_open(&s->scene, t->scene, t->width_px, t->height_px, t->n_cameras, server_camera_name);
    if (!err && t->panorama) {
        struct probe *probe;
        err = probe_open(&probe, t->panorama, t->lens, t->panorama_gain, t->width_px, t->height_px);
        if (!err)
            scene_give(s->scene, t->panorama_camera, probe);
    }
    s->started_ns = s->now_ns = server_now_ns();
    err = err ? err : open_cameras(s);
    return err ? err : server_shutter_open(s);
}

static void close_server(struct server *s)
{
    server_shutter_close(s);
    for (unsigned i = 0; s->camera && i < s->settings->n_cameras; i++) {
        struct camera *c = &s->camera[i];
        server_drop_links(c);
        server_refuse(c);
        dataset_free(&c->reply.data);
        free(c->fault_count);
        body_free(&c->body);
    }
    free(s->camera);
    scene_close(s->scene);
    for (int i = 0; i < 3; i++)
        if ((int[]){ s->epoll, s->timer, s->signals }[i] >= 0)
            close((int[]){ s->epoll, s->timer, s->signals }[i]);
}

// Wake when the first body, fault or slow link has something to do.
static void set_timer(struct server *s)
{
    int64_t next = server_head_next_ns(s);
    for (unsigned i = 0; i < s->settings->n_cameras; i++) {
        const struct camera *c = &s->camera[i];
        const int64_t body = body_next_ns(&c->body), fault = server_faults_next_ns(c);
        next = body < next ? body : next;
        next = fault < next ? fault : next;
    }
    struct itimerspec t = { 0 };
    if (next != INT64_MAX) {
        next = next < 1 ? 1 : next;
        t.it_value.tv_sec = next / 1000000000;
        t.it_value.tv_nsec = next % 1000000000;
    }
    timerfd_settime(s->timer, TFD_TIMER_ABSTIME, &t, NULL);
}

static bool handle(struct server *s, const struct epoll_event *e)
{
    const unsigned kind = (unsigned)(e->data.u64 >> 48), which = e->data.u64 & 0xffff;
    struct camera *c = &s->camera[e->data.u64 >> 16 & 0xffff];
    uint64_t n;
    switch (kind) {
    case NAME_TIMER:
        return read(s->timer, &n, sizeof(n)) != 0; // what is due is done for every camera each time
    case NAME_SIGNALS:
        return false;
    case NAME_LISTENER:
        if (c->listener[which] >= 0)
            accept_link(c, which);
        return true;
    case NAME_LINK:
        if ((e->events & EPOLLOUT) && c->link[which].role != LINK_FREE)
            push(c, &c->link[which]);
        if ((e->events & (EPOLLIN | EPOLLERR | EPOLLHUP)) && c->link[which].role != LINK_FREE)
            read_link(c, &c->link[which]);
        if (c->link[which].role != LINK_FREE && c->link[which].in.n)
            work(c, &c->link[which]);
        return true;
    case NAME_SHUTTER_LISTENER:
        server_shutter_accept(s);
        return true;
    default:
        server_shutter_ready(s, which, e->events & (EPOLLIN | EPOLLERR | EPOLLHUP));
        return true;
    }
}

int server_run(const struct server_settings *settings)
{
    struct server s = { .settings = settings, .epoll = -1, .timer = -1, .signals = -1, .shutter_listener = -1 };
    for (int i = 0; i < SHUTTER_CLIENTS_MAX; i++)
        s.client[i].fd = -1;
    const int err = open_server(&s);
    if (!err)
        log_info("server: %u cameras (%s %s) on %s:%d..%d", settings->n_cameras, settings->personality->manufacturer,
                 settings->personality->model, settings->address, settings->port, settings->port + 2 * (int)settings->n_cameras - 1);
    for (bool go_on = !err; go_on;) {
        struct epoll_event event[64];
        set_timer(&s);
        const int n = epoll_wait(s.epoll, event, 64, -1);
        s.now_ns = server_now_ns();
        for (unsigned i = 0; i < settings->n_cameras; i++) {
            struct camera *c = &s.camera[i];
            server_faults_step(c);
            if (body_next_ns(&c->body) <= s.now_ns)
                server_step_camera(c);
            else
                body_step(&c->body, s.now_ns);
        }
        server_head_step(&s);
        for (int i = 0; i < n && go_on; i++)
            go_on = handle(&s, &event[i]);
        for (unsigned i = 0; i < settings->n_cameras; i++) {
            server_step_camera(&s.camera[i]);
            resume(&s.camera[i]);
        }
        server_shutter_flush(&s);
    }
    close_server(&s);
    return err;
}
