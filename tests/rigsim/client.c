// tests/rigsim/client.c - see client.h.
#include "tests/rigsim/client.h"

#include <arpa/inet.h>
#include <errno.h>
#include <poll.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { CHUNK = 1 << 18 };

static int64_t now_ms(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000 + t.tv_nsec / 1000000;
}

static int connect_to(const char *address, int port)
{
    const struct sockaddr_in a = { .sin_family = AF_INET, .sin_port = htons((uint16_t)port),
                                   .sin_addr.s_addr = inet_addr(address) };
    const int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd < 0 || connect(fd, (const struct sockaddr *)&a, sizeof(a))) {
        const int err = -errno;
        if (fd >= 0)
            close(fd);
        return err;
    }
    return fd;
}

// The next packet of fd; its payload points into in, which is consumed at the next call with *used.
static int next_packet(int fd, struct dataset *in, int timeout_ms, struct ptpip_packet *p, size_t *used)
{
    const int64_t deadline = now_ms() + timeout_ms;
    for (;;) {
        const int err = ptpip_parse(in->data, in->n, p, used);
        if (err != -EAGAIN)
            return err;
        const int64_t left = deadline - now_ms();
        struct pollfd wait = { .fd = fd, .events = POLLIN };
        if (left <= 0 || poll(&wait, 1, (int)left) == 0)
            return -ETIMEDOUT;
        uint8_t *to = dataset_room(in, CHUNK);
        if (!to)
            return -ENOMEM;
        const ssize_t n = recv(fd, to, CHUNK, 0);
        in->n -= CHUNK - (n > 0 ? (size_t)n : 0);
        if (n <= 0)
            return -EPIPE;
    }
}

static void consume(struct dataset *in, size_t used)
{
    memmove(in->data, in->data + used, in->n - used);
    in->n -= used;
}

static int send_all(int fd, const struct dataset *d)
{
    size_t at = 0;
    while (at < d->n) {
        const ssize_t n = send(fd, d->data + at, d->n - at, MSG_NOSIGNAL);
        if (n <= 0)
            return -EPIPE;
        at += (size_t)n;
    }
    return 0;
}

static int exchange(struct client *c, int fd, struct dataset *in, const struct ptpip_packet *out, enum ptpip_type wanted,
                    struct ptpip_packet *got)
{
    struct dataset d = { 0 };
    size_t used = 0;
    ptpip_write(&d, out);
    int err = send_all(fd, &d);
    dataset_free(&d);
    err = err ? err : next_packet(fd, in, c->timeout_ms, got, &used);
    if (!err)
        consume(in, used);
    return err ? err : got->type == wanted ? 0 : -EPROTO;
}

int client_open(struct client *c, const char *address, int port, int timeout_ms)
{
    struct ptpip_packet got;
    *c = (struct client){ .command = -1, .event = -1, .timeout_ms = timeout_ms };
    int err = c->command = connect_to(address, port);
    if (err < 0)
        goto fail;
    const struct ptpip_packet hello = { .type = PTPIP_INIT_COMMAND_REQUEST, .name = "test", .version = 0x10000 };
    err = exchange(c, c->command, &c->in, &hello, PTPIP_INIT_COMMAND_ACK, &got);
    if (err)
        goto fail;
    err = c->event = connect_to(address, port + 1);
    if (err < 0)
        goto fail;
    const struct ptpip_packet events = { .type = PTPIP_INIT_EVENT_REQUEST, .connection = got.connection };
    err = exchange(c, c->event, &c->event_in, &events, PTPIP_INIT_EVENT_ACK, &got);
    if (err)
        goto fail;
    err = client_ask(c, 0x1002, 1, (uint32_t[]){ 1 }, NULL, 0);
    if (err == 0x2001)
        return 0;
    err = err < 0 ? err : -EPROTO;
fail:
    client_close(c);
    return err;
}

void client_close(struct client *c)
{
    if (c->command >= 0)
        close(c->command);
    if (c->event >= 0)
        close(c->event);
    dataset_free(&c->in);
    dataset_free(&c->event_in);
    dataset_free(&c->data);
    c->command = c->event = -1;
}

int client_ask(struct client *c, uint16_t code, int n_params, const uint32_t *param, const void *data, size_t n_data)
{
    struct ptpip_packet p = { .type = PTPIP_COMMAND, .data_phase = data ? 2 : 1, .code = code, .n_params = n_params,
                              .transaction = c->transaction++ };
    struct dataset out = { 0 };
    uint64_t announced = 0;
    memcpy(p.param, param, (size_t)n_params * sizeof(param[0]));
    ptpip_write(&out, &p);
    if (data) {
        const struct ptpip_packet start = { .type = PTPIP_START_DATA, .transaction = p.transaction, .total = n_data };
        const struct ptpip_packet all = { .type = PTPIP_END_DATA, .transaction = p.transaction, .payload = data, .n_payload = n_data };
        ptpip_write(&out, &start);
        ptpip_write(&out, &all);
    }
    int err = send_all(c->command, &out);
    dataset_free(&out);
    dataset_clear(&c->data);
    while (!err) {
        struct ptpip_packet got;
        size_t used = 0;
        err = next_packet(c->command, &c->in, c->timeout_ms, &got, &used);
        if (err)
            break;
        if (got.transaction != p.transaction)
            return -EPROTO;
        if (got.type == PTPIP_START_DATA)
            announced = got.total;
        else if (got.type == PTPIP_DATA || got.type == PTPIP_END_DATA)
            dataset_bytes(&c->data, got.payload, got.n_payload);
        else if (got.type != PTPIP_RESPONSE)
            return -EPROTO;
        consume(&c->in, used);
        if (got.type != PTPIP_RESPONSE)
            continue;
        c->code = got.code;
        c->n_params = got.n_params;
        memcpy(c->param, got.param, sizeof(c->param));
        return c->data.failed ? -ENOMEM : c->data.n != announced ? -EPROTO : got.code;
    }
    return err;
}

int client_event(struct client *c, uint16_t *code, uint32_t *param)
{
    struct ptpip_packet got;
    size_t used = 0;
    const int err = next_packet(c->event, &c->event_in, c->timeout_ms, &got, &used);
    if (err)
        return err;
    consume(&c->event_in, used);
    *code = got.code;
    *param = got.param[0];
    return got.type == PTPIP_EVENT ? 0 : -EPROTO;
}
