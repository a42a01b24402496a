// rigd/web.c - the only file that knows libmicrohttpd.
//
// Each connection has a thread of the library's. It may wait - for an answer, for the next event - but never without watching the
// browser's descriptor, too: a browser may leave, and to stop is to shut all of them down. So no connection is ever suspended.
#include "rigd/web.h"
#include "rigd/access.h"
#include "rigd/control.h"
#include "rigd/take_files.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <errno.h>
#include <microhttpd.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

enum {
    IDLE_S = 15,                  // a browser that neither sends nor takes a byte is left
    ALIVE_MS = 5000,              // an event stream says something at least that often
    FILE_MAX_MS = 600000,         // for a file to be fetched
    CROWDED = 96,                 // connections from which on idle ones are closed; the rest of WEB_CONNECTIONS_MAX are on their way out
    ANSWER_MAX_BYTES = 8 << 20,
    STACK_BYTES = 512 << 10,
    BLOCK_BYTES = 16 << 10,
};

// ---- the page's files are in the program -----------------------------------------------------------------------------------------

#define EMBED(name, path)                                                                                                              \
    __asm__(".section .rodata\n" #name "_begin:\n.incbin \"" path "\"\n" #name "_end:\n.previous\n");                                  \
    extern const char name##_begin[] __attribute__((visibility("hidden"))), name##_end[] __attribute__((visibility("hidden")))

EMBED(page_html, "rigd/web/page.html");
EMBED(page_js, "rigd/web/page.js");
EMBED(page_css, "rigd/web/page.css");

static const struct {
    const char *path, *type, *begin, *end;
} pages[] = {
    { "/", "text/html; charset=utf-8", page_html_begin, page_html_end },
    { "/page.js", "text/javascript; charset=utf-8", page_js_begin, page_js_end },
    { "/page.css", "text/css; charset=utf-8", page_css_begin, page_css_end },
};

// A report comes out of a take and is shown, no more: no script of it runs, and it is not of the page's origin.
static const char page_policy[] = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
static const char take_policy[] = "sandbox; default-src 'none'; img-src data:; style-src 'unsafe-inline'; frame-ancestors 'none'";

// ---- connections -----------------------------------------------------------------------------------------------------------------

enum doing { WAITING, SENDING, SERVING }; // for a request; a file; an answer or events, for as long as it takes

struct visitor {
    struct visitor *next;
    int fd;
    enum doing doing;
    bool leaves; // it was shut down; the library has not noticed yet
    int64_t since_ms;
};

struct web {
    struct MHD_Daemon *http;
    const struct config *config;
    bool needs_token;
    char token[ACCESS_TOKEN_LENGTH + 1], cookie[20], address[100];
    pthread_mutex_t lock; // of what follows
    struct visitor *visitors;
    int n_staying, n_streams, n_asking;
};

static int64_t now_ms(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000 + t.tv_nsec / 1000000;
}

static void set_doing(struct web *w, struct MHD_Connection *connection, enum doing doing)
{
    const union MHD_ConnectionInfo *info = MHD_get_connection_info(connection, MHD_CONNECTION_INFO_SOCKET_CONTEXT);
    struct visitor *v = info ? info->socket_context : NULL;
    if (!v)
        return;
    pthread_mutex_lock(&w->lock);
    v->doing = doing;
    v->since_ms = now_ms();
    pthread_mutex_unlock(&w->lock);
}

static void send_away(struct web *w, struct visitor *v)
{
    shutdown(v->fd, SHUT_RDWR);
    v->leaves = true;
    w->n_staying--;
}

// Somebody comes: those who have had their time leave, and in a crowd the one who has asked nothing for longest. The library closes
// a descriptor only after its visitor is forgotten, so what is shut down here is never another's.
static void make_room(struct web *w)
{
    const int64_t now = now_ms();
    struct visitor *idlest = NULL;
    for (struct visitor *v = w->visitors; v; v = v->next) {
        if (v->leaves)
            continue;
        const int64_t spent_ms = now - v->since_ms;
        if ((v->doing == WAITING && spent_ms > WEB_REQUEST_MAX_MS) || (v->doing == SENDING && spent_ms > FILE_MAX_MS))
            send_away(w, v);
        else if (v->doing == WAITING && (!idlest || v->since_ms <= idlest->since_ms)) // the list begins with the youngest
            idlest = v;
    }
    if (idlest && w->n_staying >= CROWDED)
        send_away(w, idlest);
}

static void on_connection(void *arg, struct MHD_Connection *connection, void **context, enum MHD_ConnectionNotificationCode code)
{
    struct web *w = arg;
    pthread_mutex_lock(&w->lock);
    if (code == MHD_CONNECTION_NOTIFY_STARTED) {
        struct visitor *v = calloc(1, sizeof(*v));
        make_room(w);
        if (v) {
            *v = (struct visitor){ w->visitors, MHD_get_connection_info(connection, MHD_CONNECTION_INFO_CONNECTION_FD)->connect_fd, WAITING, false, now_ms() };
            w->visitors = v;
            w->n_staying++;
        }
        *context = v;
    } else if (*context) {
        struct visitor **at = &w->visitors;
        w->n_staying -= !((struct visitor *)*context)->leaves;
        while (*at != *context)
            at = &(*at)->next;
        *at = (*at)->next;
        free(*context);
        *context = NULL;
    }
    pthread_mutex_unlock(&w->lock);
}

// ---- a client of the control module ------------------------------------------------------------------------------------------------

static int connect_to_rigd(const struct web *w)
{
    struct sockaddr_un address = { .sun_family = AF_UNIX };
    snprintf(address.sun_path, sizeof(address.sun_path), "%s", w->config->socket_path);
    const int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd >= 0 && connect(fd, (struct sockaddr *)&address, sizeof(address))) {
        close(fd);
        return -1;
    }
    return fd;
}

static bool send_all(int fd, const char *bytes, size_t n)
{
    while (n) {
        const ssize_t sent = send(fd, bytes, n, MSG_NOSIGNAL);
        if (sent < 0 && errno != EINTR)
            return false;
        bytes += sent > 0 ? sent : 0;
        n -= sent > 0 ? (size_t)sent : 0;
    }
    return true;
}

// Waits until rigd has said something. 1; 0: timeout_ms passed; -1: the browser has left, or was sent away.
static int wait_for(int rigd_fd, int browser_fd, int timeout_ms)
{
    struct pollfd p[2] = { { rigd_fd, POLLIN, 0 }, { browser_fd, POLLRDHUP, 0 } };
    int n;
    do
        n = poll(p, 2, timeout_ms);
    while (n < 0 && errno == EINTR);
    if (n < 0 || p[1].revents)
        return -1;
    return n > 0;
}

// Reads one line, without its end. NULL: there will be none.
static char *read_line(int rigd_fd, int browser_fd, size_t *n_bytes)
{
    char *text = NULL;
    size_t n = 0, room = 0;
    while (wait_for(rigd_fd, browser_fd, -1) > 0) {
        if (n == room) {
            room = room ? 2 * room : BLOCK_BYTES;
            char *grown = room <= ANSWER_MAX_BYTES ? realloc(text, room) : NULL;
            if (!grown)
                break;
            text = grown;
        }
        const ssize_t got = recv(rigd_fd, text + n, room - n, MSG_DONTWAIT);
        if (got < 0 && (errno == EAGAIN || errno == EINTR))
            continue;
        if (got <= 0)
            break;
        const char *newline = memchr(text + n, '\n', (size_t)got);
        n += (size_t)got;
        if (newline) {
            *n_bytes = (size_t)(newline - text);
            return text;
        }
    }
    free(text);
    return NULL;
}

// One of a bounded number; give it back with -1.
static bool count(struct web *w, int *n, int by, int most)
{
    pthread_mutex_lock(&w->lock);
    const bool fits = *n + by <= most;
    *n += fits ? by : 0;
    pthread_mutex_unlock(&w->lock);
    return fits;
}

// ---- answers -----------------------------------------------------------------------------------------------------------------------

static enum MHD_Result queue(struct MHD_Connection *connection, int status, struct MHD_Response *r, const char *type, const char *policy)
{
    static const char *const always[][2] = {
        { "X-Content-Type-Options", "nosniff" }, { "Referrer-Policy", "no-referrer" }, { "X-Frame-Options", "DENY" }, { "Cross-Origin-Resource-Policy", "same-origin" },
        { "Cross-Origin-Opener-Policy", "same-origin" }, { "Cache-Control", "no-store" },
    };
    if (!r)
        return MHD_NO;
    for (size_t i = 0; i < sizeof(always) / sizeof(always[0]); i++)
        MHD_add_response_header(r, always[i][0], always[i][1]);
    MHD_add_response_header(r, "Content-Security-Policy", policy);
    MHD_add_response_header(r, "Content-Type", type);
    const enum MHD_Result queued = MHD_queue_response(connection, (unsigned)status, r);
    MHD_destroy_response(r);
    return queued;
}

static enum MHD_Result say(struct MHD_Connection *connection, int status, const char *text)
{
    struct MHD_Response *r = MHD_create_response_from_buffer(strlen(text), (void *)(uintptr_t)text, MHD_RESPMEM_MUST_COPY);
    if (r && status == MHD_HTTP_METHOD_NOT_ALLOWED)
        MHD_add_response_header(r, "Allow", "GET, HEAD, POST");
    if (r && status == MHD_HTTP_SERVICE_UNAVAILABLE)
        MHD_add_response_header(r, "Retry-After", "1");
    return queue(connection, status, r, "text/plain; charset=utf-8", take_policy);
}

static enum MHD_Result answer_request(struct web *w, struct MHD_Connection *connection, char *body, size_t n)
{
    const int browser_fd = MHD_get_connection_info(connection, MHD_CONNECTION_INFO_CONNECTION_FD)->connect_fd;
    size_t n_answer = 0;
    char *answer = NULL;
    if (!count(w, &w->n_asking, 1, WEB_ASKING_MAX))
        return say(connection, MHD_HTTP_SERVICE_UNAVAILABLE, "too many requests are under way; try again\n");
    if (!n) { // to the protocol a blank line, which nobody answers
        count(w, &w->n_asking, -1, WEB_ASKING_MAX);
        return say(connection, MHD_HTTP_BAD_REQUEST, "expected one JSON object, {\"do\":\"status\"}\n");
    }
    for (size_t i = 0; i < n; i++)
        if (body[i] == '\n' || body[i] == '\r') // to JSON a blank like others; to the protocol the end of a request
            body[i] = ' ';
    set_doing(w, connection, SERVING);
    MHD_set_connection_option(connection, MHD_CONNECTION_OPTION_TIMEOUT, 0u); // a take lasts longer than the library waits
    const int rigd_fd = connect_to_rigd(w);
    const bool asked = rigd_fd >= 0; // whatever came of it: a request must not be made twice
    if (asked && send_all(rigd_fd, body, n) && send_all(rigd_fd, "\n", 1))
        answer = read_line(rigd_fd, browser_fd, &n_answer);
    if (asked)
        close(rigd_fd);
    MHD_set_connection_option(connection, MHD_CONNECTION_OPTION_TIMEOUT, (unsigned)IDLE_S); // counts from now
    count(w, &w->n_asking, -1, WEB_ASKING_MAX);
    set_doing(w, connection, SENDING);
    if (!answer && asked) // not 503: that one may be tried again, and this would press the shutters twice
        return say(connection, MHD_HTTP_BAD_GATEWAY, "rigd took the request and did not answer; it may be under way all the same: look at the takes; journalctl -u rigd says why\n");
    if (!answer)
        return say(connection, MHD_HTTP_SERVICE_UNAVAILABLE, "rigd does not answer; journalctl -u rigd says why\n");
    return queue(connection, MHD_HTTP_OK, MHD_create_response_from_buffer(n_answer, answer, MHD_RESPMEM_MUST_FREE), "application/json", take_policy);
}

// ---- events ------------------------------------------------------------------------------------------------------------------------

struct stream {
    struct web *web;
    int rigd_fd, browser_fd;
    bool within; // a line
};

// What rigd says, as server-sent events: "data: " before each line, an empty line after it.
static ssize_t next_events(void *arg, uint64_t position, char *out, size_t room)
{
    static const char alive[] = "data: {\"event\":\"alive\"}\n\n";
    struct stream *s = arg;
    char bytes[BLOCK_BYTES / 8];
    (void)position;
    for (;;) {
        const int said = wait_for(s->rigd_fd, s->browser_fd, ALIVE_MS);
        if (said < 0)
            return MHD_CONTENT_READER_END_OF_STREAM;
        if (!said && !s->within && room >= sizeof(alive)) {
            memcpy(out, alive, sizeof(alive) - 1);
            return sizeof(alive) - 1;
        }
        if (!said)
            continue;
        const size_t most = room / 8 < sizeof(bytes) ? room / 8 : sizeof(bytes); // a byte becomes eight at most
        const ssize_t n = most ? recv(s->rigd_fd, bytes, most, MSG_DONTWAIT) : 0;
        if (n < 0 && (errno == EINTR || errno == EAGAIN))
            continue;
        if (n <= 0)
            return MHD_CONTENT_READER_END_OF_STREAM;
        size_t k = 0;
        for (ssize_t i = 0; i < n; i++) {
            if (!s->within) {
                memcpy(out + k, "data: ", 6);
                k += 6;
            }
            out[k++] = bytes[i];
            s->within = bytes[i] != '\n';
            if (!s->within)
                out[k++] = '\n';
        }
        return (ssize_t)k;
    }
}

static void end_stream(void *arg)
{
    struct stream *s = arg;
    close(s->rigd_fd);
    count(s->web, &s->web->n_streams, -1, WEB_STREAMS_MAX);
    free(s);
}

static enum MHD_Result answer_events(struct web *w, struct MHD_Connection *connection)
{
    static const char ask[] = "{\"v\":1,\"do\":\"subscribe\"}\n{\"v\":1,\"id\":\"status\",\"do\":\"status\"}\n";
    struct stream *s = calloc(1, sizeof(*s));
    if (!s || !count(w, &w->n_streams, 1, WEB_STREAMS_MAX)) {
        free(s);
        return say(connection, MHD_HTTP_SERVICE_UNAVAILABLE, "too many pages are open; close another\n");
    }
    *s = (struct stream){ w, connect_to_rigd(w), MHD_get_connection_info(connection, MHD_CONNECTION_INFO_CONNECTION_FD)->connect_fd, false };
    if (s->rigd_fd < 0 || !send_all(s->rigd_fd, ask, sizeof(ask) - 1)) {
        end_stream(s);
        return say(connection, MHD_HTTP_SERVICE_UNAVAILABLE, "rigd does not answer; journalctl -u rigd says why\n");
    }
    struct MHD_Response *r = MHD_create_response_from_callback(MHD_SIZE_UNKNOWN, BLOCK_BYTES, next_events, s, end_stream);
    if (!r) {
        end_stream(s);
        return MHD_NO;
    }
    set_doing(w, connection, SERVING);
    MHD_add_response_header(r, "X-Accel-Buffering", "no");
    return queue(connection, MHD_HTTP_OK, r, "text/event-stream; charset=utf-8", take_policy);
}

// ---- files -------------------------------------------------------------------------------------------------------------------------

static enum MHD_Result answer_take_file(struct web *w, struct MHD_Connection *connection, const char *path)
{
    const char *slash = strchr(path, '/');
    char id[128];
    int64_t size = 0;
    int fd = -ENOENT;
    if (slash && (size_t)(slash - path) < sizeof(id)) {
        snprintf(id, sizeof(id), "%.*s", (int)(slash - path), path);
        fd = take_file_open(w->config->takes_dir, id, slash + 1, &size);
    }
    if (fd < 0)
        return say(connection, MHD_HTTP_NOT_FOUND, "there is no such file to be seen\n");
    struct MHD_Response *r = MHD_create_response_from_fd64((uint64_t)size, fd);
    if (!r)
        close(fd);
    set_doing(w, connection, SENDING);
    return queue(connection, MHD_HTTP_OK, r, take_file_type(slash + 1), take_policy);
}

static enum MHD_Result answer_get(struct web *w, struct MHD_Connection *connection, const char *url, bool head)
{
    const char *given = MHD_lookup_connection_value(connection, MHD_GET_ARGUMENT_KIND, "token");
    if (!strcmp(url, "/") && given && w->needs_token) { // from now on in a cookie, and out of the address and the history
        char cookie[160];
        struct MHD_Response *r = MHD_create_response_from_buffer(0, (void *)(uintptr_t)"", MHD_RESPMEM_PERSISTENT);
        snprintf(cookie, sizeof(cookie), "%s=%s; Path=/; HttpOnly; SameSite=Strict; Max-Age=31536000", w->cookie, w->token);
        if (r) {
            MHD_add_response_header(r, "Location", "/");
            MHD_add_response_header(r, "Set-Cookie", cookie);
        }
        return queue(connection, MHD_HTTP_SEE_OTHER, r, "text/plain; charset=utf-8", take_policy);
    }
    for (size_t i = 0; i < sizeof(pages) / sizeof(pages[0]); i++)
        if (!strcmp(url, pages[i].path)) {
            set_doing(w, connection, SENDING);
            return queue(connection, MHD_HTTP_OK,
                         MHD_create_response_from_buffer((size_t)(pages[i].end - pages[i].begin), (void *)(uintptr_t)pages[i].begin, MHD_RESPMEM_PERSISTENT), pages[i].type, page_policy);
        }
    if (!strcmp(url, "/events") && !head)
        return answer_events(w, connection);
    if (!strncmp(url, "/takes/", 7))
        return answer_take_file(w, connection, url + 7);
    return say(connection, MHD_HTTP_NOT_FOUND, "there is nothing here; the page is at /\n");
}

// ---- requests ----------------------------------------------------------------------------------------------------------------------

struct exchange { // a request while it comes
    bool is_post, too_long;
    size_t n;
    char *body; // of a POST
};

static const char *header(struct MHD_Connection *connection, const char *name)
{
    return MHD_lookup_connection_value(connection, MHD_HEADER_KIND, name);
}

// 0: granted; else what was answered is in *queued.
static bool is_refused(struct web *w, struct MHD_Connection *connection, const char *url, bool is_post, enum MHD_Result *queued)
{
    const struct access_request request = {
        .changes = is_post,
        .stays = !strcmp(url, "/events"),
        .host = header(connection, "Host"),
        .origin = header(connection, "Origin"),
        .fetch_site = header(connection, "Sec-Fetch-Site"),
        .content_type = header(connection, "Content-Type"),
        .authorization = header(connection, "Authorization"),
        .cookie = MHD_lookup_connection_value(connection, MHD_COOKIE_KIND, w->cookie),
    };
    const char *given = is_post || strcmp(url, "/") ? NULL : MHD_lookup_connection_value(connection, MHD_GET_ARGUMENT_KIND, "token");
    const enum access access = access_judge(&request, w->needs_token ? w->token : NULL, w->config->web.listen);
    switch (access) {
    case ACCESS_GRANTED:
        if (!given || !w->needs_token || access_is_token(w->token, given))
            return false;
        break;
    case ACCESS_NO_TOKEN:
        if (w->needs_token && access_is_token(w->token, given))
            return false;
        break;
    case ACCESS_WRONG_HOST:
        *queued = say(connection, MHD_HTTP_MISDIRECTED_REQUEST, "this page is for this machine: ask for localhost, 127.0.0.1 or [::1]\n");
        return true;
    case ACCESS_WRONG_ORIGIN:
        *queued = say(connection, MHD_HTTP_FORBIDDEN, "pages of other sites may not ask here\n");
        return true;
    case ACCESS_WRONG_TYPE:
        *queued = say(connection, MHD_HTTP_UNSUPPORTED_MEDIA_TYPE, "expected Content-Type: application/json\n");
        return true;
    }
    *queued = say(connection, MHD_HTTP_UNAUTHORIZED,
                  "This page wants the rig's token: open it once with /?token=TOKEN behind the address, or send Authorization: Bearer TOKEN.\n"
                  "The token lies in the file web-token in rigd's state folder (/var/lib/rigd) on the rig's machine; only rigd's user and root can read it.\n");
    return true;
}

static enum MHD_Result on_request(void *arg, struct MHD_Connection *connection, const char *url, const char *method, const char *version, const char *upload, size_t *n_upload, void **context)
{
    struct web *w = arg;
    struct exchange *x = *context;
    enum MHD_Result queued = MHD_NO;
    (void)version;
    if (!x) { // headers only: what is refused is refused before a body is read
        const bool is_post = !strcmp(method, MHD_HTTP_METHOD_POST);
        const char *length = header(connection, "Content-Length");
        if (!is_post && strcmp(method, MHD_HTTP_METHOD_GET) && strcmp(method, MHD_HTTP_METHOD_HEAD))
            return say(connection, MHD_HTTP_METHOD_NOT_ALLOWED, "expected GET, HEAD or POST\n");
        if (is_refused(w, connection, url, is_post, &queued))
            return queued;
        if (is_post && strcmp(url, "/api"))
            return say(connection, MHD_HTTP_NOT_FOUND, "requests go to /api\n");
        if (length && strtoull(length, NULL, 10) > CONTROL_LINE_MAX)
            return say(connection, MHD_HTTP_CONTENT_TOO_LARGE, "a request holds at most 65536 bytes\n");
        x = calloc(1, sizeof(*x));
        if (!x || (is_post && !(x->body = malloc(CONTROL_LINE_MAX)))) {
            free(x);
            return MHD_NO;
        }
        x->is_post = is_post;
        *context = x;
        return MHD_YES;
    }
    if (*n_upload) {
        x->too_long |= !x->is_post || x->n + *n_upload > CONTROL_LINE_MAX;
        if (!x->too_long) {
            memcpy(x->body + x->n, upload, *n_upload);
            x->n += *n_upload;
        }
        *n_upload = 0;
        return MHD_YES;
    }
    if (x->too_long)
        return say(connection, MHD_HTTP_CONTENT_TOO_LARGE, "a request holds at most 65536 bytes, and a GET none\n");
    return x->is_post ? answer_request(w, connection, x->body, x->n) : answer_get(w, connection, url, !strcmp(method, MHD_HTTP_METHOD_HEAD));
}

static void on_completed(void *arg, struct MHD_Connection *connection, void **context, enum MHD_RequestTerminationCode code)
{
    struct exchange *x = *context;
    (void)code;
    set_doing(arg, connection, WAITING);
    if (x)
        free(x->body);
    free(x);
    *context = NULL;
}

// ---- life --------------------------------------------------------------------------------------------------------------------------

__attribute__((format(printf, 2, 0))) static void on_library_message(void *arg, const char *format, va_list args)
{
    char text[300];
    (void)arg;
    vsnprintf(text, sizeof(text), format, args);
    text[strcspn(text, "\n")] = 0;
    log_debug("web: %s", text);
}

// A bound, listening socket; address->port becomes what it is. Or -errno.
static int listen_on(struct listen_address *address)
{
    const int one = 1;
    struct sockaddr_storage bound = { 0 };
    socklen_t n = sizeof(bound);
    const int fd = socket(address->address.ss_family, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    if (fd < 0)
        return -errno;
    setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &one, sizeof(one)); // a daemon that starts anew does not wait for the last one's connections
    if (address->address.ss_family == AF_INET6)
        setsockopt(fd, IPPROTO_IPV6, IPV6_V6ONLY, &one, sizeof(one)); // what is written is what is meant
    if (bind(fd, (struct sockaddr *)&address->address, address->length) || listen(fd, 64) || getsockname(fd, (struct sockaddr *)&bound, &n)) {
        const int err = -errno;
        close(fd);
        return err;
    }
    address->port = ntohs(bound.ss_family == AF_INET6 ? ((struct sockaddr_in6 *)&bound)->sin6_port : ((struct sockaddr_in *)&bound)->sin_port);
    return fd;
}

int web_open(struct web **out, const struct config *config)
{
    struct listen_address address;
    char path[400];
    int fd = -1, err = 0;
    *out = NULL;
    if (!config->web.listen[0])
        return 0;
    struct web *w = calloc(1, sizeof(*w));
    if (!w)
        return -ENOMEM;
    w->config = config;
    pthread_mutex_init(&w->lock, NULL);
    err = listen_parse(&address, config->web.listen);
    if (err)
        goto fail;
    w->needs_token = !address.is_loopback || config->web.token_always;
    snprintf(path, sizeof(path), "%s/web-token", config->state_dir);
    if (w->needs_token) {
        err = make_directories(config->state_dir);
        if (!err)
            err = access_token(w->token, path);
        if (err)
            goto fail;
    }
    fd = listen_on(&address);
    if (fd < 0) {
        err = fd;
        log_warning("web: cannot listen on %s: %s; %sthe rig works without its page", config->web.listen, strerror(-err),
                    err == -EADDRINUSE      ? "another program has that port: stop it, or choose another [web] listen; "
                    : err == -EACCES        ? "ports below 1024 are not for rigd: choose another; "
                    : err == -EADDRNOTAVAIL ? "this machine has no such address: choose another [web] listen; "
                                            : "");
        goto fail;
    }
    snprintf(w->cookie, sizeof(w->cookie), "rigd-%d", address.port); // cookies are of a host, whatever the port
    snprintf(w->address, sizeof(w->address), "http://%.*s:%d/", (int)(strrchr(config->web.listen, ':') - config->web.listen), config->web.listen, address.port);
    w->http = MHD_start_daemon(MHD_USE_THREAD_PER_CONNECTION | MHD_USE_INTERNAL_POLLING_THREAD | MHD_USE_POLL | MHD_USE_ITC | MHD_USE_ERROR_LOG, 0, NULL, NULL, on_request, w,
                               MHD_OPTION_EXTERNAL_LOGGER, on_library_message, NULL, // first: others complain through it
                               MHD_OPTION_LISTEN_SOCKET, fd, MHD_OPTION_CONNECTION_LIMIT, (unsigned)WEB_CONNECTIONS_MAX, MHD_OPTION_CONNECTION_TIMEOUT, (unsigned)IDLE_S,
                               MHD_OPTION_THREAD_STACK_SIZE, (size_t)STACK_BYTES, MHD_OPTION_NOTIFY_CONNECTION, on_connection, w, MHD_OPTION_NOTIFY_COMPLETED, on_completed, w,
                               MHD_OPTION_SIGPIPE_HANDLED_BY_APP, 1, MHD_OPTION_END);
    if (!w->http) {
        err = -EIO;
        log_warning("web: the HTTP server does not start; the rig works without its page");
        goto fail;
    }
    if (w->needs_token)
        log_info("web: the page is at %s, for those who have the token in %s: open it once with ?token=TOKEN", w->address, path);
    else
        log_info("web: the page is at %s, for everybody on this machine and nobody else", w->address);
    *out = w;
    return 0;
fail:
    if (fd >= 0)
        close(fd);
    web_close(w);
    return err;
}

void web_close(struct web *w)
{
    if (!w)
        return;
    if (w->http)
        MHD_stop_daemon(w->http); // shuts down every connection, which ends whatever waits, and joins its thread
    pthread_mutex_destroy(&w->lock);
    free(w);
}

const char *web_address(const struct web *w)
{
    return w->address;
}
