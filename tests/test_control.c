// tests/test_control.c - the daemon's door: asked once, answered once; nobody can jam it.
#include "rigd/control.h"
#include "solver/take/log.h"

#include <errno.h>
#include <fcntl.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>
#include <cmocka.h>

static uint64_t held;
static int n_handled;

static void handle(void *arg, uint64_t token, const char *what, const struct json *request)
{
    struct control *c = *(struct control **)arg;
    (void)request;
    n_handled++;
    if (!strcmp(what, "later"))
        held = token;
    else if (!strcmp(what, "no"))
        control_refuse(c, token, "busy", "a \"take\" is under way");
    else {
        struct json *o = json_new_object();
        json_set_string(o, "what", what);
        control_reply(c, token, o);
    }
}

static void say(struct control *c, int client, const char *text)
{
    control_feed(c, client, text, strlen(text));
}

static void expect(struct control *c, int client, const char *text)
{
    char *out = control_take(c, client);
    assert_string_equal(out, text);
    free(out);
}

static void a_request_is_answered_under_its_own_id(void **state)
{
    (void)state;
    struct control *c;
    assert_int_equal(control_open_virtual(&c, handle, &c), 0);
    const int a = control_virtual_client(c), b = control_virtual_client(c);
    say(c, a, "{\"v\":1,\"id\":7,\"do\":\"st");
    expect(c, a, "");
    say(c, a, "atus\"}\r\n\n{\"id\":\"x\\\"y\",\"do\":\"later\"}\n{\"do\":\"no\",\"id\":-2}\n");
    expect(c, a, "{\"v\":1,\"id\":7,\"ok\":true,\"result\":{\"what\":\"status\"}}\n"
                 "{\"v\":1,\"id\":-2,\"ok\":false,\"error\":{\"code\":\"busy\",\"text\":\"a \\\"take\\\" is under way\"}}\n");
    control_reply(c, held, json_new_object());
    control_reply(c, held, json_new_object()); // once
    expect(c, a, "{\"v\":1,\"id\":\"x\\\"y\",\"ok\":true,\"result\":{}}\n");
    expect(c, b, "");
    control_close(c);
}

static void what_is_no_request_is_refused(void **state)
{
    (void)state;
    static const char *const lines[] = { "hello\n", "[]\n", "{}\n", "{\"do\":3}\n", "{\"do\":\"a\"} {\"do\":\"b\"}\n", "\xff\xfe\n", "{\"v\":2,\"do\":\"status\"}\n" };
    struct control *c;
    assert_int_equal(control_open_virtual(&c, handle, &c), 0);
    const int a = control_virtual_client(c);
    n_handled = 0;
    for (size_t i = 0; i < sizeof(lines) / sizeof(lines[0]); i++) {
        say(c, a, lines[i]);
        char *out = control_take(c, a);
        assert_non_null(strstr(out, "\"ok\":false"));
        free(out);
    }
    assert_int_equal(n_handled, 0);
    char *flood = malloc(CONTROL_LINE_MAX + 2);
    memset(flood, ' ', CONTROL_LINE_MAX + 1);
    control_feed(c, a, flood, CONTROL_LINE_MAX + 1);
    control_feed(c, a, "{\"do\":\"status\"}\n", 16); // it was dropped: not heard any more
    assert_int_equal(n_handled, 0);
    free(flood);
    for (int i = 0; i < 40; i++)
        say(c, control_virtual_client(c) % 2 ? 1 : 1, "{\"do\":\"later\"}\n");
    char *out = control_take(c, 1);
    assert_non_null(strstr(out, "too_many_requests"));
    free(out);
    control_close(c);
}

static void subscribers_get_events_and_are_told_what_they_missed(void **state)
{
    (void)state;
    struct control *c;
    assert_int_equal(control_open_virtual(&c, handle, &c), 0);
    const int a = control_virtual_client(c), b = control_virtual_client(c);
    say(c, a, "{\"do\":\"subscribe\"}\n");
    free(control_take(c, a));
    control_publish(c, "state", json_new_object());
    expect(c, a, "{\"v\":1,\"event\":\"state\",\"n\":1,\"body\":{}}\n");
    expect(c, b, "");
    char big[1000];
    memset(big, 'x', sizeof(big) - 1);
    big[sizeof(big) - 1] = 0;
    for (int i = 0; i < 3000; i++) { // three times what is kept
        struct json *o = json_new_object();
        json_set_string(o, "text", big);
        control_publish(c, "say", o);
    }
    char *out = control_take(c, a);
    assert_true(strlen(out) <= 1 << 20);
    free(out);
    control_publish(c, "state", json_new_object());
    out = control_take(c, a);
    assert_non_null(strstr(out, "\"event\":\"lost\""));
    assert_non_null(strstr(out, "\"n\":3002"));
    free(out);
    control_close(c);
}

static int connect_to(const char *path)
{
    struct sockaddr_un address = { .sun_family = AF_UNIX };
    strcpy(address.sun_path, path);
    const int fd = socket(AF_UNIX, SOCK_STREAM, 0);
    if (connect(fd, (struct sockaddr *)&address, sizeof(address))) {
        close(fd);
        return -1;
    }
    return fd;
}

static void a_dead_daemons_socket_is_replaced_a_live_ones_is_not(void **state)
{
    (void)state;
    char dir[] = "/tmp/studiorig-test-XXXXXX", path[64];
    struct control *c, *second;
    struct stat st;
    assert_non_null(mkdtemp(dir));
    snprintf(path, sizeof(path), "%s/s", dir);
    struct sockaddr_un address = { .sun_family = AF_UNIX };
    strcpy(address.sun_path, path);
    const int left = socket(AF_UNIX, SOCK_STREAM, 0); // bound, never unlinked, nobody listens
    assert_int_equal(bind(left, (struct sockaddr *)&address, sizeof(address)), 0);
    close(left);
    assert_int_equal(control_open(&c, path, handle, &c), 0);
    assert_int_equal(stat(path, &st), 0);
    assert_int_equal(st.st_mode & 0777, 0660);
    log_set_level(LOG_SILENT);
    assert_int_equal(control_open(&second, path, handle, &second), -EADDRINUSE);
    log_set_level(LOG_INFO);
    // A client that says its request and shuts its side still gets the answer.
    const int fd = connect_to(path);
    assert_true(fd >= 0);
    assert_int_equal(write(fd, "{\"do\":\"later\",\"id\":1}\n", 22), 22);
    shutdown(fd, SHUT_WR);
    for (int i = 0; i < 5; i++)
        control_dispatch(c);
    control_reply(c, held, json_new_object());
    control_dispatch(c);
    char line[200] = "";
    assert_true(read(fd, line, sizeof(line) - 1) > 0);
    assert_non_null(strstr(line, "\"id\":1"));
    close(fd);
    // One that leaves with a request open: its token names nothing.
    const int gone = connect_to(path);
    assert_int_equal(write(gone, "{\"do\":\"later\"}\n", 15), 15);
    for (int i = 0; i < 3; i++)
        control_dispatch(c);
    close(gone);
    for (int i = 0; i < 3; i++)
        control_dispatch(c);
    control_reply(c, held, json_new_object());
    // Many at once: those beyond the limit are told so.
    int fds[CONTROL_CLIENTS_MAX + 4];
    for (int i = 0; i < CONTROL_CLIENTS_MAX + 4; i++) {
        fds[i] = connect_to(path);
        assert_true(fds[i] >= 0);
        control_dispatch(c);
    }
    assert_true(read(fds[CONTROL_CLIENTS_MAX + 3], line, sizeof(line) - 1) > 0);
    assert_non_null(strstr(line, "too_many_clients"));
    for (int i = 0; i < CONTROL_CLIENTS_MAX + 4; i++)
        close(fds[i]);
    control_close(c);
    assert_int_equal(access(path, F_OK), -1);
    rmdir(dir);
}

static void a_client_that_never_reads_harms_nobody(void **state)
{
    (void)state;
    char dir[] = "/tmp/studiorig-test-XXXXXX", path[64];
    struct control *c;
    assert_non_null(mkdtemp(dir));
    snprintf(path, sizeof(path), "%s/s", dir);
    assert_int_equal(control_open(&c, path, handle, &c), 0);
    const int deaf = connect_to(path), good = connect_to(path);
    for (int i = 0; i < 200000; i++) {
        if (send(deaf, "{\"do\":\"status\"}\n", 16, MSG_DONTWAIT | MSG_NOSIGNAL) < 0 && errno == EPIPE)
            break; // dropped
        control_dispatch(c);
    }
    assert_int_equal(write(good, "{\"do\":\"status\"}\n", 16), 16);
    for (int i = 0; i < 5; i++)
        control_dispatch(c);
    char line[200];
    assert_true(recv(good, line, sizeof(line), MSG_DONTWAIT) > 0);
    close(deaf), close(good);
    control_close(c);
    rmdir(dir);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_request_is_answered_under_its_own_id),
        cmocka_unit_test(what_is_no_request_is_refused),
        cmocka_unit_test(subscribers_get_events_and_are_told_what_they_missed),
        cmocka_unit_test(a_dead_daemons_socket_is_replaced_a_live_ones_is_not),
        cmocka_unit_test(a_client_that_never_reads_harms_nobody),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
