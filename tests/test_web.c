// tests/test_web.c - the page's server as a hostile network sees it: by sockets, byte by byte.
#include "rigd/control.h"
#include "rigd/web.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "tests/scratch.h"

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>

// ---- a daemon of which there is nothing but its door -------------------------------------------------------------------------------

static struct control *control;
static struct config config;
static struct web *web;
static pthread_t loop;
static int loop_ends, port;
static atomic_int n_handled;
static char said[4000];

static void handle(void *arg, uint64_t token, const char *what, const struct json *request)
{
    (void)arg, (void)request;
    n_handled++;
    struct json *o = json_new_object();
    json_set_string(o, "what", what);
    if (!strcmp(what, "publish"))
        control_publish(control, "news", json_new_object());
    if (!strcmp(what, "never"))
        json_free(o);
    else
        control_reply(control, token, o);
}

static void *run_loop(void *arg)
{
    struct pollfd p[2] = { { control_fd(control), POLLIN, 0 }, { loop_ends, POLLIN, 0 } };
    (void)arg;
    while (poll(p, 2, -1) >= 0 && !p[1].revents)
        control_dispatch(control);
    return NULL;
}

static void listen_to_log(void *arg, enum log_level level, const char *message)
{
    const size_t n = strlen(said);
    (void)arg;
    if (level > LOG_DEBUG) // the library's are many
        snprintf(said + n, sizeof(said) - n, "%s\n", message);
}

static void open_web(const char *listen, bool token_always)
{
    snprintf(config.web.listen, sizeof(config.web.listen), "%s", listen);
    config.web.token_always = token_always;
    assert_int_equal(web_open(&web, &config), 0);
    port = atoi(strrchr(web_address(web), ':') + 1);
    assert_true(port > 0);
}

static int set_up(void **state)
{
    (void)state;
    signal(SIGPIPE, SIG_IGN);
    alarm(600); // whatever hangs, ends
    log_set_level(LOG_SILENT);
    log_set_hook(listen_to_log, NULL);
    if (scratch_open())
        return -1;
    snprintf(config.socket_path, sizeof(config.socket_path), "%.90s", scratch_path("s"));
    snprintf(config.takes_dir, sizeof(config.takes_dir), "%.200s", scratch_path("takes"));
    snprintf(config.state_dir, sizeof(config.state_dir), "%.200s", scratch_path("state"));
    loop_ends = eventfd(0, EFD_CLOEXEC);
    return control_open(&control, config.socket_path, handle, NULL) || pthread_create(&loop, NULL, run_loop, NULL);
}

static int tear_down(void **state)
{
    const uint64_t one = 1;
    char command[700];
    (void)state;
    if (write(loop_ends, &one, sizeof(one)) != sizeof(one))
        return -1;
    pthread_join(loop, NULL);
    control_close(control);
    close(loop_ends);
    log_set_hook(NULL, NULL);
    snprintf(command, sizeof(command), "rm -r '%s'", scratch_dir);
    return system(command);
}

static int open_plain(void **state)
{
    (void)state;
    open_web("127.0.0.1:0", false);
    return 0;
}

static int close_web(void **state)
{
    (void)state;
    web_close(web);
    web = NULL;
    return 0;
}

// ---- a browser by hand ---------------------------------------------------------------------------------------------------------------

// What the kernel calls interrupted was not: with a timeout, recv() returns when its process was stopped for a while.
static ssize_t hear(int fd, char *out, size_t room)
{
    ssize_t n;
    while ((n = recv(fd, out, room, 0)) < 0 && errno == EINTR)
        ;
    return n;
}

static int connect_to(int to_port)
{
    struct sockaddr_in a = { .sin_family = AF_INET, .sin_port = htons((uint16_t)to_port), .sin_addr.s_addr = htonl(INADDR_LOOPBACK) };
    const struct timeval patience = { .tv_sec = 120 };
    const int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    assert_true(fd >= 0);
    setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof(patience));
    assert_int_equal(connect(fd, (struct sockaddr *)&a, sizeof(a)), 0);
    return fd;
}

static void put(int fd, const char *text)
{
    send(fd, text, strlen(text), MSG_NOSIGNAL); // may be closed already: that is looked at by reading
}

// All that comes until the other side closes. The status; 0: none.
static int read_all(int fd, char *out, size_t room)
{
    size_t n = 0;
    for (ssize_t got; n < room - 1 && (got = hear(fd, out + n, room - 1 - n)) > 0;)
        n += (size_t)got;
    out[n] = 0;
    close(fd);
    return strncmp(out, "HTTP/1.", 7) ? 0 : atoi(out + 9);
}

static char answer[300000];

static int send_raw(const char *text)
{
    const int fd = connect_to(port);
    put(fd, text);
    return read_all(fd, answer, sizeof(answer));
}

// headers: whole lines, each with its \r\n; without a Host one is added.
static int get(const char *path, const char *headers)
{
    char text[4000];
    snprintf(text, sizeof(text), "GET %s HTTP/1.1\r\n%s%sConnection: close\r\n\r\n", path, strstr(headers, "Host:") ? "" : "Host: localhost\r\n", headers);
    return send_raw(text);
}

static int post(const char *headers, const char *body)
{
    char text[70000 + 2000];
    snprintf(text, sizeof(text), "POST /api HTTP/1.1\r\n%s%s%sContent-Length: %zu\r\nConnection: close\r\n\r\n%s", strstr(headers, "Host:") ? "" : "Host: localhost\r\n",
             strstr(headers, "Content-Type:") ? "" : "Content-Type: application/json\r\n", headers, strlen(body), body);
    return send_raw(text);
}

static const char *body_of(const char *whole)
{
    const char *body = strstr(whole, "\r\n\r\n");
    return body ? body + 4 : "";
}

// Reads until text is there. False: the other side closed, or nothing came for long.
static bool read_until(int fd, const char *text)
{
    size_t n = 0;
    answer[0] = 0;
    while (!strstr(answer, text)) {
        const ssize_t got = n < sizeof(answer) - 1 ? hear(fd, answer + n, sizeof(answer) - 1 - n) : 0;
        if (got <= 0)
            return false;
        n += (size_t)got;
        answer[n] = 0;
    }
    return true;
}

static int open_stream(void)
{
    const int fd = connect_to(port);
    put(fd, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n");
    return fd;
}

static void leave_rudely(int fd)
{
    const struct linger now = { 1, 0 };
    setsockopt(fd, SOL_SOCKET, SO_LINGER, &now, sizeof(now)); // RST
    close(fd);
}

// ---- promises ------------------------------------------------------------------------------------------------------------------------

static void the_page_is_served_and_nothing_foreign_runs_in_it(void **state)
{
    static const char *const paths[] = { "/", "/page.js", "/page.css" }, *const types[] = { "text/html", "text/javascript", "text/css" };
    (void)state;
    for (int i = 0; i < 3; i++) {
        char type[80], path[40], *text;
        size_t n;
        assert_int_equal(get(paths[i], ""), 200);
        snprintf(type, sizeof(type), "Content-Type: %s; charset=utf-8", types[i]);
        assert_non_null(strstr(answer, type));
        assert_non_null(strstr(answer, "Content-Security-Policy: default-src 'none'; script-src 'self';"));
        assert_non_null(strstr(answer, "frame-ancestors 'none'"));
        assert_non_null(strstr(answer, "X-Content-Type-Options: nosniff"));
        assert_null(strcasestr(answer, "Access-Control"));
        snprintf(path, sizeof(path), "rigd/web/page%s", i == 0 ? ".html" : paths[i] + 5);
        assert_int_equal(file_read(&text, &n, path, 1 << 20), 0);
        assert_string_equal(body_of(answer), text); // byte for byte
        assert_null(strstr(text, "://"));          // nothing from elsewhere
        free(text);
    }
    assert_int_equal(send_raw("HEAD / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"), 200);
    assert_string_equal(body_of(answer), "");
    assert_int_equal(get("/nothing", ""), 404);
    assert_int_equal(get("/page.html", ""), 404);
    assert_int_equal(get("/?token=x", ""), 200); // none is wanted
}

static void other_methods_are_refused(void **state)
{
    static const char *const methods[] = { "PUT", "DELETE", "OPTIONS", "TRACE", "CONNECT", "PATCH", "get", "X" };
    (void)state;
    const int before = n_handled;
    for (size_t i = 0; i < sizeof(methods) / sizeof(methods[0]); i++) {
        char text[200];
        snprintf(text, sizeof(text), "%s /api HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n", methods[i]);
        assert_int_equal(send_raw(text), 405);
    }
    assert_int_equal(get("/api", ""), 404);
    assert_int_equal(n_handled, before);
}

static void a_request_is_one_request_and_its_answer_comes_back(void **state)
{
    (void)state;
    assert_int_equal(post("", "{\"id\":5,\"do\":\"status\"}"), 200);
    assert_string_equal(body_of(answer), "{\"v\":1,\"id\":5,\"ok\":true,\"result\":{\"what\":\"status\"}}");
    assert_non_null(strstr(answer, "Content-Type: application/json"));
    const int before = n_handled;
    assert_int_equal(post("", "{\"do\":\n\"a\"}\r\n{\"do\":\"b\"}"), 200); // not two
    assert_non_null(strstr(body_of(answer), "not_a_request"));
    assert_int_equal(post("", "{\"do\":\r\n\"a\"\n}"), 200);
    assert_non_null(strstr(body_of(answer), "\"what\":\"a\""));
    assert_int_equal(n_handled, before + 1);
    assert_int_equal(post("", "no JSON"), 200);
    assert_non_null(strstr(body_of(answer), "not_a_request"));
    assert_int_equal(send_raw("POST / HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 2\r\nConnection: close\r\n\r\n{}"), 404);
}

static void a_body_is_bounded(void **state)
{
    (void)state;
    static char text[CONTROL_LINE_MAX + 4000];
    const int before = n_handled;
    memset(text, ' ', CONTROL_LINE_MAX);
    memcpy(text, "{\"do\":\"fits\"}", 13);
    text[CONTROL_LINE_MAX] = 0;
    assert_int_equal(post("", text), 200);
    assert_non_null(strstr(body_of(answer), "fits"));
    assert_int_equal(n_handled, before + 1);
    text[CONTROL_LINE_MAX] = ' ';
    text[CONTROL_LINE_MAX + 1] = 0;
    assert_int_equal(post("", text), 413);
    static const char *const lengths[] = { "99999999999", "18446744073709551615", "-1", "18446744073709551616", "0x10" };
    for (size_t i = 0; i < sizeof(lengths) / sizeof(lengths[0]); i++) {
        char head[300];
        snprintf(head, sizeof(head), "POST /api HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: %s\r\n\r\n", lengths[i]);
        const int status = send_raw(head);
        assert_true(status >= 400 && status < 500);
    }
    // Without a length: chunk after chunk.
    const int fd = connect_to(port);
    put(fd, "POST /api HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\nConnection: close\r\n\r\n");
    for (int i = 0; i < 70; i++) {
        char chunk[1100];
        snprintf(chunk, sizeof(chunk), "400\r\n%1024s\r\n", "");
        put(fd, chunk);
    }
    put(fd, "0\r\n\r\n");
    assert_int_equal(read_all(fd, answer, sizeof(answer)), 413);
    // A body behind a GET is none of ours either.
    assert_int_equal(send_raw("GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\nConnection: close\r\n\r\nabc"), 413);
    assert_int_equal(n_handled, before + 1);
    // Nor is a head without end.
    static char head[200000];
    memset(head, 'a', sizeof(head) - 1);
    memcpy(head, "GET / HTTP/1.1\r\nHost: localhost\r\nX: ", 36);
    const int status = send_raw(head);
    assert_true(status == 0 || (status >= 400 && status < 500));
    assert_int_equal(get("/", ""), 200);
}

static void a_name_that_suddenly_means_this_machine_is_not_ours(void **state)
{
    static const char *const wrong[] = { "rig.example", "rig.example:80", "localhost.example", "127.0.0.1.example", "127.0.0.1@rig.example", "[::1].example", "localhost:", "localhost:x", "localhost:80:80", "[::1", "" };
    static const char *const right[] = { "localhost", "LOCALHOST:9", "127.0.0.1:8420", "[::1]:8420", "[::1]" };
    char header[100];
    (void)state;
    const int before = n_handled;
    for (size_t i = 0; i < sizeof(wrong) / sizeof(wrong[0]); i++) {
        snprintf(header, sizeof(header), "Host: %s\r\n", wrong[i]);
        assert_int_equal(get("/", header), 421);
        assert_int_equal(get("/events", header), 421);
        assert_int_equal(post(header, "{\"do\":\"status\"}"), 421);
    }
    assert_int_equal(n_handled, before);
    assert_int_equal(send_raw("GET / HTTP/1.0\r\n\r\n"), 421); // none at all
    for (size_t i = 0; i < sizeof(right) / sizeof(right[0]); i++) {
        snprintf(header, sizeof(header), "Host: %s\r\n", right[i]);
        assert_int_equal(get("/", header), 200);
    }
}

static void pages_of_others_cannot_ask(void **state)
{
    static const char *const wrong[] = { "http://rig.example", "null", "http://localhost:1", "http://localhost.example", "ftp://localhost", "localhost", "", "http://" };
    char header[200];
    (void)state;
    const int before = n_handled;
    for (size_t i = 0; i < sizeof(wrong) / sizeof(wrong[0]); i++) {
        snprintf(header, sizeof(header), "Origin: %s\r\n", wrong[i]);
        assert_int_equal(post(header, "{\"do\":\"status\"}"), 403);
        assert_int_equal(get("/events", header), 403);
        assert_null(strcasestr(answer, "Access-Control"));
    }
    assert_int_equal(post("Sec-Fetch-Site: cross-site\r\n", "{\"do\":\"status\"}"), 403);
    assert_int_equal(post("Sec-Fetch-Site: same-site\r\n", "{\"do\":\"status\"}"), 403);
    assert_int_equal(get("/", "Sec-Fetch-Site: cross-site\r\n"), 200); // but it may link to the page
    // A form of another site needs no leave to send these.
    assert_int_equal(post("Content-Type: text/plain\r\n", "{\"do\":\"status\"}"), 415);
    assert_int_equal(post("Content-Type: application/x-www-form-urlencoded\r\n", "{\"do\":\"status\"}"), 415);
    assert_int_equal(post("Content-Type: application/jsonp\r\n", "{\"do\":\"status\"}"), 415);
    assert_int_equal(n_handled, before);
    assert_int_equal(post("Origin: http://localhost\r\nSec-Fetch-Site: same-origin\r\n", "{\"do\":\"status\"}"), 200);
    assert_int_equal(post("Host: localhost:8420\r\nOrigin: http://localhost:8420\r\nContent-Type: application/json; charset=utf-8\r\n", "{\"do\":\"status\"}"), 200);
}

// A picture, a frame, a window of another page's asks without an Origin, and an event stream would stay: enough of them, and nobody else gets one.
static void pages_of_others_hold_no_event_streams(void **state)
{
    static const char *const foreign[] = { "cross-site", "same-site", "Cross-Site", "something new" };
    int fd[WEB_STREAMS_MAX];
    (void)state;
    for (int i = 0; i < WEB_STREAMS_MAX; i++) {
        char text[300];
        fd[i] = connect_to(port);
        snprintf(text, sizeof(text), "GET /events HTTP/1.1\r\nHost: localhost\r\nSec-Fetch-Site: %s\r\nSec-Fetch-Mode: %s\r\n\r\n", foreign[i % 4], i % 8 < 4 ? "no-cors" : "navigate");
        put(fd[i], text);
        assert_true(read_until(fd[i], "\r\n\r\n"));
        assert_int_equal(strncmp(answer, "HTTP/1.1 403", 12), 0);
    }
    static const char *const own[] = { "", "Sec-Fetch-Site: same-origin\r\n", "Sec-Fetch-Site: none\r\n" }; // an old browser or a program; the page; a person
    for (int i = 0; i < 3; i++) {
        char text[200];
        const int mine = connect_to(port);
        snprintf(text, sizeof(text), "GET /events HTTP/1.1\r\nHost: localhost\r\n%s\r\n", own[i]);
        put(mine, text);
        assert_true(read_until(mine, "status"));
        leave_rudely(mine);
    }
    for (int i = 0; i < WEB_STREAMS_MAX; i++)
        close(fd[i]);
}

static void make(const char *name, const char *text)
{
    char path[900], *slash;
    snprintf(path, sizeof(path), "%s/%s", config.takes_dir, name);
    slash = strrchr(path, '/');
    *slash = 0;
    assert_int_equal(make_directories(path), 0);
    *slash = '/';
    FILE *f = fopen(path, "w");
    assert_non_null(f);
    fputs(text, f);
    fclose(f);
}

static void files_of_takes_are_shown_and_no_others(void **state)
{
    static const char *const shown[][2] = {
        { "T1/thumbnails/A01.jpg", "image/jpeg" }, { "T1/solve/preview/report.html", "text/html; charset=utf-8" },
        { "T1/solve/preview/model.glb", "model/gltf-binary" }, { "T1/sheet/linear.png", "image/png" },
    };
    static const char *const hidden[] = { "T1/take.json", "T1/raw/A01.nef", "T1/sheet/linear.json", "T1/report.html", "T1/solve/preview/lights.json", "T1/thumbnails/.A02.jpg", "secret.jpg", "T1/thumbnails/deep/A.jpg" };
    static const char *const tricks[] = {
        "/takes/T1/thumbnails/../../secret.jpg", "/takes/T1/thumbnails/%2e%2e/%2e%2e/secret.jpg", "/takes/T1/thumbnails/..%2f..%2fsecret.jpg", "/takes/../secret.jpg", "/takes/..",
        "/takes/T1/thumbnails/%00A01.jpg", "/takes/T1/take.json%00.jpg", "/takes/T1/thumbnails//A01.jpg", "/takes//T1/thumbnails/A01.jpg", "/takes/T1/./thumbnails/A01.jpg",
        "/takes/T1/thumbnails/..\\A01.jpg", "/takes/./T1/thumbnails/A01.jpg", "/takes/T1/thumbnails/", "/takes/T1/thumbnails", "/takes/T1", "/takes/", "/takes",
        "//takes/T1/thumbnails/A01.jpg", "/takes/T1/thumbnails/%252e%252e/A01.jpg", "/takes/T1/solve/../thumbnails/A01.jpg", "/takes/T1/thumbnails/link.jpg", "/takes/T1/solve/link/report.html",
        "/takes/link/thumbnails/A01.jpg", "/takes/T1/thumbnails/folder.jpg", "/takes/T1/thumbnails/pipe.jpg",
    };
    char path[900], target[900];
    (void)state;
    for (size_t i = 0; i < sizeof(shown) / sizeof(shown[0]); i++)
        make(shown[i][0], shown[i][0]);
    for (size_t i = 0; i < sizeof(hidden) / sizeof(hidden[0]); i++)
        make(hidden[i], "SECRET");
    make("elsewhere/report.html", "SECRET");
    make("elsewhere/thumbnails/A01.jpg", "SECRET");
    make("T1/thumbnails/folder.jpg/x", "SECRET");
    snprintf(path, sizeof(path), "%s/T1/thumbnails/pipe.jpg", config.takes_dir);
    assert_int_equal(mkfifo(path, 0600), 0); // who opens it for reading would wait
    static const char *const links[][2] = { { "elsewhere/report.html", "T1/thumbnails/link.jpg" }, { "elsewhere", "T1/solve/link" }, { "elsewhere", "link" } };
    for (int i = 0; i < 3; i++) {
        snprintf(target, sizeof(target), "%s/%s", config.takes_dir, links[i][0]);
        snprintf(path, sizeof(path), "%s/%s", config.takes_dir, links[i][1]);
        assert_int_equal(symlink(target, path), 0);
    }
    for (size_t i = 0; i < sizeof(shown) / sizeof(shown[0]); i++) {
        snprintf(path, sizeof(path), "/takes/%s", shown[i][0]);
        assert_int_equal(get(path, ""), 200);
        assert_string_equal(body_of(answer), shown[i][0]);
        snprintf(path, sizeof(path), "Content-Type: %s\r\n", shown[i][1]);
        assert_non_null(strstr(answer, path));
        assert_non_null(strstr(answer, "Content-Security-Policy: sandbox;")); // whatever it says, it is not the page
        assert_non_null(strstr(answer, "X-Content-Type-Options: nosniff"));
    }
    for (size_t i = 0; i < sizeof(hidden) / sizeof(hidden[0]); i++) {
        snprintf(path, sizeof(path), "/takes/%s", hidden[i]);
        assert_int_equal(get(path, ""), 404);
    }
    for (size_t i = 0; i < sizeof(tricks) / sizeof(tricks[0]); i++) {
        if (get(tricks[i], "") != 404)
            fail_msg("%s: %.12s", tricks[i], answer);
        assert_null(strstr(answer, "SECRET"));
    }
    snprintf(path, sizeof(path), "/takes/T1/thumbnails/%0300d.jpg", 1);
    assert_int_equal(get(path, ""), 404);
}

static void events_come_as_they_happen(void **state)
{
    (void)state;
    const int fd = open_stream();
    assert_true(read_until(fd, "\"id\":\"status\",\"ok\":true,\"result\":{\"what\":\"status\"}}\n\n"));
    assert_non_null(strstr(answer, "Content-Type: text/event-stream"));
    assert_non_null(strstr(answer, "data: {\"v\":1,\"ok\":true,\"result\":{}}\n\n"));
    assert_int_equal(post("", "{\"do\":\"publish\"}"), 200);
    assert_true(read_until(fd, "\n\n"));
    assert_non_null(strstr(answer, "data: {\"v\":1,\"event\":\"news\""));
    assert_true(read_until(fd, "data: {\"event\":\"alive\"}\n\n")); // and when nothing does, that too
    close(fd);
}

// As many as are allowed, held by us; then they leave, and others get in.
static void listeners_are_bounded_and_make_room_when_they_leave(void **state)
{
    int fd[WEB_STREAMS_MAX];
    (void)state;
    for (int round = 0; round < 2; round++) {
        for (int i = 0; i < WEB_STREAMS_MAX; i++) {
            bool in = false;
            for (int turn = 0; turn < 500 && !in; turn++) { // the last round's are noticed to have left a little later
                fd[i] = open_stream();
                in = read_until(fd[i], "status") && !strncmp(answer, "HTTP/1.1 200", 12);
                if (!in) {
                    close(fd[i]);
                    usleep(10000);
                }
            }
            assert_true(in);
        }
        assert_int_equal(get("/events", ""), 503);
        assert_int_equal(post("", "{\"do\":\"status\"}"), 200); // those who ask are not kept out
        for (int i = 0; i < WEB_STREAMS_MAX; i++)
            leave_rudely(fd[i]);
    }
}

static void requests_under_way_are_bounded_and_end_with_who_asked(void **state)
{
    static const char never[] = "POST /api HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 14\r\n\r\n{\"do\":\"never\"}";
    int fd[WEB_ASKING_MAX];
    (void)state;
    const int before = n_handled;
    for (int i = 0; i < WEB_ASKING_MAX; i++) {
        fd[i] = connect_to(port);
        put(fd[i], never);
    }
    for (int turn = 0; turn < 1000 && n_handled < before + WEB_ASKING_MAX; turn++)
        usleep(10000);
    assert_int_equal(n_handled, before + WEB_ASKING_MAX);
    assert_int_equal(post("", "{\"do\":\"status\"}"), 503);
    assert_non_null(strstr(answer, "Retry-After:"));
    assert_int_equal(get("/", ""), 200);
    for (int i = 0; i < WEB_ASKING_MAX; i++)
        leave_rudely(fd[i]);
    int status = 503;
    for (int turn = 0; turn < 1000 && status == 503; turn++) {
        status = post("", "{\"do\":\"status\"}");
        usleep(status == 503 ? 10000 : 0);
    }
    assert_int_equal(status, 200);
}

static void *ask_often(void *arg)
{
    static const char request[] = "POST /api HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 15\r\nConnection: close\r\n\r\n{\"do\":\"status\"}";
    int *n_served = arg;
    for (int i = 0; i < 10; i++) {
        char mine[4000];
        const int fd = connect_to(port);
        put(fd, request);
        const int status = read_all(fd, mine, sizeof(mine));
        if (status == 200 && strstr(mine, "\"what\":\"status\""))
            n_served[0]++;
        else if (status == 503)
            n_served[1]++;
    }
    return NULL;
}

static void sixty_four_at_once_are_all_answered(void **state)
{
    pthread_t thread[64];
    int n_served[64][2] = { 0 }, n = 0, n_busy = 0;
    (void)state;
    for (int i = 0; i < 64; i++)
        assert_int_equal(pthread_create(&thread[i], NULL, ask_often, n_served[i]), 0);
    for (int i = 0; i < 64; i++) {
        pthread_join(thread[i], NULL);
        n += n_served[i][0];
        n_busy += n_served[i][1];
    }
    assert_int_equal(n + n_busy, 640); // answered, or told to try again; none was dropped
    assert_true(n >= 64);
}

static void an_empty_request_is_answered_at_once(void **state)
{
    (void)state;
    for (int i = 0; i < 2 * WEB_ASKING_MAX; i++) // none of them takes a place for good
        assert_int_equal(post("", ""), 400);
    assert_int_equal(post("", "{\"do\":\"status\"}"), 200);
}

// Takes each request, and leaves.
static void *take_and_leave(void *arg)
{
    int *listener = arg;
    for (int fd; (fd = accept(listener[0], NULL, NULL)) >= 0; close(fd)) {
        char line[200];
        if (recv(fd, line, sizeof(line), 0) > 0)
            listener[1]++;
    }
    return NULL;
}

// 503 invites to try again: a rigd that dies of a capture would fire the next one's shutters without anybody's asking.
static void what_rigd_took_is_not_to_be_tried_again(void **state)
{
    struct sockaddr_un address = { .sun_family = AF_UNIX };
    char real[sizeof(config.socket_path)];
    int listener[2] = { socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0), 0 };
    pthread_t thread;
    (void)state;
    strcpy(real, config.socket_path);
    snprintf(address.sun_path, sizeof(address.sun_path), "%.90s", scratch_path("dying"));
    assert_int_equal(bind(listener[0], (struct sockaddr *)&address, sizeof(address)), 0);
    assert_int_equal(listen(listener[0], 4), 0);
    assert_int_equal(pthread_create(&thread, NULL, take_and_leave, listener), 0);
    strcpy(config.socket_path, address.sun_path);
    assert_int_equal(post("", "{\"do\":\"capture\"}"), 502);
    shutdown(listener[0], SHUT_RDWR);
    pthread_join(thread, NULL);
    close(listener[0]);
    assert_int_equal(listener[1], 1);
    assert_int_equal(post("", "{\"do\":\"capture\"}"), 503); // it did not take this one
    strcpy(config.socket_path, real);
}

static void connections_that_ask_nothing_keep_nobody_out(void **state)
{
    enum { N = 3 * WEB_CONNECTIONS_MAX };
    static const char *const beginnings[] = { "", "G", "GET / HTTP/1.1\r\nHost: localhost\r\n", "POST /api HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 100\r\n\r\n{" };
    static int fd[N];
    (void)state;
    for (int i = 0; i < N; i++) {
        fd[i] = connect_to(port);
        put(fd[i], beginnings[i % 4]);
        if (i % 32 == 31) { // and each goes on, a byte at a time
            for (int k = 0; k <= i; k++)
                put(fd[k], "a");
            assert_int_equal(get("/", ""), 200);
            assert_int_equal(post("", "{\"do\":\"status\"}"), 200);
        }
    }
    for (int i = 0; i < N; i++)
        close(fd[i]);
    assert_int_equal(get("/", ""), 200);
}

static void who_leaves_in_the_middle_harms_nobody(void **state)
{
    static const char *const parts[] = {
        "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n", "GET /page.js HTTP/1.1\r\nHost: localhost\r\n\r\nGET /page.js HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "POST /api HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 15\r\n\r\n{\"do\":\"status\"}",
        "POST /api HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 14\r\n\r\n{\"do\":\"never\"}",
        "\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", "GET", "\r\n\r\n\r\n", "GET / HTTP/9.9\r\n\r\n", "GET http://x/ HTTP/1.1\r\nHost:\r\n\r\n", "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    };
    enum { N_PARTS = sizeof(parts) / sizeof(parts[0]) };
    unsigned random = 1;
    (void)state;
    for (int i = 0; i < 400; i++) {
        const char *part = parts[i % N_PARTS];
        random = random * 1103515245 + 12345;
        const int fd = connect_to(port);
        send(fd, part, i < 2 * N_PARTS ? strlen(part) : (random >> 8) % (strlen(part) + 1), MSG_NOSIGNAL);
        if (random >> 30 & 1)
            usleep(1000);
        if (random >> 29 & 1)
            leave_rudely(fd);
        else
            close(fd);
    }
    int status = 503;
    for (int turn = 0; turn < 1000 && status != 200; turn++) {
        status = post("", "{\"do\":\"status\"}");
        usleep(status == 200 ? 0 : 10000);
    }
    assert_int_equal(status, 200);
}

static void nonsense_is_answered_or_left(void **state)
{
    unsigned random = 7;
    (void)state;
    for (int i = 0; i < 300; i++) {
        char text[600] = "GET /takes/T1/thumbnails/A01.jpg?a=b HTTP/1.1\r\nHost: localhost\r\nCookie: a=b; c=d\r\nContent-Length: 0\r\nRange: bytes=0-\r\nConnection: close\r\n\r\n";
        const size_t n = strlen(text);
        for (int k = 0; k < 1 + i % 12; k++) {
            random = random * 1103515245 + 12345;
            text[(random >> 8) % n] = (char)(random >> 20);
        }
        const int fd = connect_to(port);
        send(fd, text, n, MSG_NOSIGNAL);
        shutdown(fd, SHUT_WR);
        const int status = read_all(fd, answer, sizeof(answer));
        assert_true(status == 0 || status == 200 || (status >= 400 && status < 600));
    }
    assert_int_equal(get("/", ""), 200);
}

static void it_ends_at_once_whoever_is_there(void **state)
{
    static const char never[] = "POST /api HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 14\r\n\r\n{\"do\":\"never\"}";
    int fd[30];
    (void)state;
    open_web("127.0.0.1:0", false);
    const int before = n_handled;
    for (int i = 0; i < 30; i++) {
        fd[i] = i % 3 == 0 ? open_stream() : connect_to(port);
        if (i % 3 == 0)
            assert_true(read_until(fd[i], "status"));
        else
            put(fd[i], i % 3 == 1 ? never : "GET /");
    }
    for (int turn = 0; turn < 1000 && n_handled < before + 20; turn++)
        usleep(10000);
    struct timespec t0, t1;
    clock_gettime(CLOCK_MONOTONIC, &t0);
    close_web(NULL);
    clock_gettime(CLOCK_MONOTONIC, &t1);
    print_message("# closed with 10 listeners, 10 requests under way and 10 half ones in %.1f ms\n", 1e3 * (double)(t1.tv_sec - t0.tv_sec) + 1e-6 * (double)(t1.tv_nsec - t0.tv_nsec));
    for (int i = 0; i < 30; i++) {
        read_all(fd[i], answer, sizeof(answer)); // comes to its end
    }
    open_web("127.0.0.1:0", false); // and another can be opened
    assert_int_equal(get("/", ""), 200);
    close_web(NULL);
}

static void without_its_port_it_says_so_and_is_not_there(void **state)
{
    struct web *second = (struct web *)8;
    char listen[64];
    (void)state;
    open_web("127.0.0.1:0", false);
    snprintf(listen, sizeof(listen), "127.0.0.1:%d", port);
    snprintf(config.web.listen, sizeof(config.web.listen), "%s", listen);
    said[0] = 0;
    assert_int_equal(web_open(&second, &config), -EADDRINUSE);
    assert_null(second);
    assert_non_null(strstr(said, listen));
    assert_non_null(strstr(said, "the rig works without its page"));
    assert_int_equal(get("/", ""), 200); // the first is as it was
    close_web(NULL);
    config.web.listen[0] = 0; // off
    assert_int_equal(web_open(&second, &config), 0);
    assert_null(second);
}

static void without_the_token_nothing_is_to_be_had(void **state)
{
    char path[400], header[300], *token;
    struct stat st;
    size_t n;
    (void)state;
    said[0] = 0;
    open_web("127.0.0.1:0", true);
    snprintf(path, sizeof(path), "%s/web-token", config.state_dir);
    assert_int_equal(stat(path, &st), 0);
    assert_int_equal(st.st_mode & 0777, 0600);
    assert_int_equal(file_read(&token, &n, path, 1000), 0);
    token[strcspn(token, "\n")] = 0;
    assert_int_equal(strlen(token), 64);
    assert_non_null(strstr(said, path));
    assert_null(strstr(said, token)); // journals are read by many
    const int before = n_handled;
    static const char *const paths[] = { "/", "/page.js", "/events", "/takes/T1/thumbnails/A01.jpg", "/nothing", "/?token=", "/?token=00", "/page.js?token=TOKEN" };
    for (size_t i = 0; i < sizeof(paths) / sizeof(paths[0]); i++) {
        assert_int_equal(get(paths[i], ""), 401);
        assert_null(strstr(answer, token));
    }
    assert_int_equal(post("", "{\"do\":\"status\"}"), 401);
    for (int i = 0; i < 4; i++) { // cut, longer, one letter off, none
        char given[100];
        snprintf(given, sizeof(given), "%s%s", i == 3 ? "" : token, i == 1 ? "0" : "");
        if (i == 0)
            given[63] = 0;
        if (i == 2)
            given[63] = given[63] == '0' ? '1' : '0';
        snprintf(header, sizeof(header), "Authorization: Bearer %s\r\n", given);
        assert_int_equal(post(header, "{\"do\":\"status\"}"), 401);
        snprintf(header, sizeof(header), "Cookie: rigd-%d=%s\r\n", port, given);
        assert_int_equal(post(header, "{\"do\":\"status\"}"), 401);
        snprintf(header, sizeof(header), "/?token=%s", given);
        assert_int_equal(get(header, ""), 401);
    }
    assert_int_equal(n_handled, before);
    snprintf(header, sizeof(header), "Authorization: Bearer %s\r\n", token);
    assert_int_equal(post(header, "{\"do\":\"status\"}"), 200);
    snprintf(header, sizeof(header), "Host: rig.studio:8420\r\nCookie: x=y; rigd-%d=%s\r\n", port, token);
    assert_int_equal(post(header, "{\"do\":\"status\"}"), 200); // by any name: who has the token is no stranger
    snprintf(header, sizeof(header), "Cookie: rigd-%d=%s\r\nOrigin: http://rig.example\r\n", port, token);
    assert_int_equal(post(header, "{\"do\":\"status\"}"), 403); // but still no other page
    snprintf(header, sizeof(header), "/?token=%s", token);
    assert_int_equal(get(header, ""), 303);
    assert_non_null(strstr(answer, "Location: /\r\n"));
    snprintf(header, sizeof(header), "Set-Cookie: rigd-%d=%s; Path=/; HttpOnly; SameSite=Strict", port, token);
    assert_non_null(strstr(answer, header));
    close_web(NULL);
    // The next start has the same.
    open_web("127.0.0.1:0", true);
    snprintf(header, sizeof(header), "Authorization: Bearer %s\r\n", token);
    assert_int_equal(post(header, "{\"do\":\"status\"}"), 200);
    close_web(NULL);
    // One that others may read is none; nor is one that is cut.
    struct web *none;
    said[0] = 0;
    assert_int_equal(chmod(path, 0640), 0);
    assert_int_equal(web_open(&none, &config), -EACCES);
    assert_non_null(strstr(said, "chmod 600"));
    assert_int_equal(chmod(path, 0600), 0);
    assert_int_equal(truncate(path, 20), 0);
    assert_int_equal(web_open(&none, &config), -EINVAL);
    assert_non_null(strstr(said, "remove it"));
    assert_int_equal(unlink(path), 0);
    free(token);
    // Any address but loopback wants it unasked.
    open_web("0.0.0.0:0", false);
    assert_int_equal(get("/", ""), 401);
    assert_int_equal(access(path, F_OK), 0);
    close_web(NULL);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup_teardown(the_page_is_served_and_nothing_foreign_runs_in_it, open_plain, close_web),
        cmocka_unit_test_setup_teardown(other_methods_are_refused, open_plain, close_web),
        cmocka_unit_test_setup_teardown(a_request_is_one_request_and_its_answer_comes_back, open_plain, close_web),
        cmocka_unit_test_setup_teardown(a_body_is_bounded, open_plain, close_web),
        cmocka_unit_test_setup_teardown(a_name_that_suddenly_means_this_machine_is_not_ours, open_plain, close_web),
        cmocka_unit_test_setup_teardown(pages_of_others_cannot_ask, open_plain, close_web),
        cmocka_unit_test_setup_teardown(pages_of_others_hold_no_event_streams, open_plain, close_web),
        cmocka_unit_test_setup_teardown(files_of_takes_are_shown_and_no_others, open_plain, close_web),
        cmocka_unit_test_setup_teardown(events_come_as_they_happen, open_plain, close_web),
        cmocka_unit_test_setup_teardown(listeners_are_bounded_and_make_room_when_they_leave, open_plain, close_web),
        cmocka_unit_test_setup_teardown(requests_under_way_are_bounded_and_end_with_who_asked, open_plain, close_web),
        cmocka_unit_test_setup_teardown(sixty_four_at_once_are_all_answered, open_plain, close_web),
        cmocka_unit_test_setup_teardown(an_empty_request_is_answered_at_once, open_plain, close_web),
        cmocka_unit_test_setup_teardown(what_rigd_took_is_not_to_be_tried_again, open_plain, close_web),
        cmocka_unit_test_setup_teardown(connections_that_ask_nothing_keep_nobody_out, open_plain, close_web),
        cmocka_unit_test_setup_teardown(who_leaves_in_the_middle_harms_nobody, open_plain, close_web),
        cmocka_unit_test_setup_teardown(nonsense_is_answered_or_left, open_plain, close_web),
        cmocka_unit_test(it_ends_at_once_whoever_is_there),
        cmocka_unit_test(without_its_port_it_says_so_and_is_not_there),
        cmocka_unit_test(without_the_token_nothing_is_to_be_had),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
