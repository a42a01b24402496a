// tests/test_rigsim_wire.c - the whole simulated rig over its sockets: many cameras at once, shutter lines, every fault.
//
// Starts build/bin/rigsim ($BIN/rigsim) on a loopback address of its own.
#include "tests/rigsim/client.h"
#include "rigd/shutter_line.h"
#include "tests/loopback.h"
#include "tests/scratch.h"

#include <arpa/inet.h>
#include <errno.h>
#include <pthread.h>
#include <signal.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define MS INT64_C(1000000)
#define ASK(c, code, ...) \
    client_ask(c, code, (int)(sizeof((uint32_t[]){ __VA_ARGS__ }) / 4), (uint32_t[]){ __VA_ARGS__ }, NULL, 0)
enum { OK = 0x2001, BUSY = 0x2019, GET_OBJECT = 0x1009, GET_HANDLES = 0x1007, CAPTURE = 0x100e, GET_PROPERTY = 0x1015,
       FOLDER = 0x00010002, PATIENCE_MS = 120000, PORT = 15740 };

static pid_t rigsim;

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void sleep_ms(int ms)
{
    nanosleep(&(struct timespec){ ms / 1000, ms % 1000 * 1000000L }, NULL);
}

// options: up to 16 words after "--cameras N --address A"; faults: a script's text, or NULL.
static void start(int n_cameras, const char *faults, const char *const *options)
{
    char bin[512], cameras[16], script[600], log[600];
    const char *argv[32] = { bin, "--cameras", cameras, "--address", loopback_address() };
    int n = 5;
    snprintf(bin, sizeof(bin), "%s/rigsim", getenv("BIN") ? getenv("BIN") : "build/bin");
    snprintf(cameras, sizeof(cameras), "%d", n_cameras);
    snprintf(log, sizeof(log), "%s/rigsim.log", scratch_dir);
    if (faults) {
        scratch_write("faults", faults, strlen(faults));
        snprintf(script, sizeof(script), "%s/faults", scratch_dir);
        argv[n++] = "--faults";
        argv[n++] = script;
    }
    for (int i = 0; options && options[i]; i++)
        argv[n++] = options[i];
    argv[n] = NULL;
    if (rigsim > 0) // a test failed before its stop()
        kill(rigsim, SIGKILL), waitpid(rigsim, NULL, 0);
    rigsim = fork();
    if (rigsim == 0) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        if (!getenv("RIGSIM_VERBOSE"))
            freopen(log, "w", stderr);
        execv(bin, (char *const *)(uintptr_t)argv);
        _exit(127);
    }
    for (int i = 0; i < PATIENCE_MS / 10; i++) { // until the last camera listens
        struct client c;
        if (!client_open(&c, loopback_address(), PORT + 2 * (n_cameras - 1), PATIENCE_MS)) {
            client_close(&c);
            return;
        }
        if (waitpid(rigsim, NULL, WNOHANG)) {
            rigsim = 0;
            break;
        }
        sleep_ms(10);
    }
    char line[300] = "nothing";
    FILE *f = fopen(log, "r");
    if (f && fgets(line, sizeof(line), f))
        fclose(f);
    fail_msg("rigsim does not listen; it says: %s", line);
}

// It must end by itself when told to, with success: under ASan this finds leaks.
static void stop(void)
{
    int status;
    kill(rigsim, SIGTERM);
    assert_int_equal(waitpid(rigsim, &status, 0), rigsim);
    rigsim = 0;
    assert_true(WIFEXITED(status) && WEXITSTATUS(status) == 0);
    scratch_empty();
}

// The n-th file (from 0) once it is there; 0 never.
static uint32_t file(struct client *c, uint32_t n)
{
    for (int64_t end = now_ns() + PATIENCE_MS * MS; now_ns() < end; sleep_ms(5)) {
        if (ASK(c, GET_HANDLES, UINT32_MAX, 0, FOLDER) != OK || c->data.n < 4 + 4 * (n + 1))
            continue;
        const uint8_t *p = c->data.data + 4 + 4 * n;
        return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
    }
    return 0;
}

static uint64_t hash(const struct dataset *d)
{
    uint64_t h = 14695981039346656037u; // FNV-1a, eight bytes at a time
    for (size_t i = 0; i < d->n; i += 8) {
        uint64_t word = 0;
        memcpy(&word, d->data + i, d->n - i < 8 ? d->n - i : 8);
        h = (h ^ word) * 1099511628211u;
    }
    return h;
}

// ---- many ------------------------------------------------------------------------------------------------------------------

struct download {
    int camera, err;
    size_t n;
    uint64_t hash;
};

static void *download_one(void *arg)
{
    struct download *d = arg;
    struct client c;
    d->err = client_open(&c, loopback_address(), PORT + 2 * d->camera, PATIENCE_MS);
    if (d->err)
        return NULL;
    d->err = ASK(&c, CAPTURE, 0, 0);
    const uint32_t handle = d->err == OK ? file(&c, 0) : 0;
    d->err = handle ? ASK(&c, GET_OBJECT, handle) : -ENOENT;
    d->n = c.data.n;
    d->hash = hash(&c.data);
    client_close(&c);
    return NULL;
}

static void eighty_five_cameras_deliver_8_mb_each_at_once_and_the_same_again(void **state)
{
    (void)state;
    enum { N = 85, AGAIN = 15 };
    static struct download d[2][N];
    for (int run = 0; run < 2; run++) {
        pthread_t thread[N];
        const int n = run ? AGAIN : N;
        start(N, NULL, (const char *[]){ "--clock", "fixed", "--seed", "11", NULL });
        for (int i = 0; i < n; i++) {
            d[run][i] = (struct download){ .camera = i };
            assert_int_equal(pthread_create(&thread[i], NULL, download_one, &d[run][i]), 0);
        }
        for (int i = 0; i < n; i++)
            pthread_join(thread[i], NULL);
        char path[64], line[128];
        long peak_kb = 0;
        snprintf(path, sizeof(path), "/proc/%d/status", rigsim);
        FILE *f = fopen(path, "r");
        while (f && fgets(line, sizeof(line), f))
            sscanf(line, "VmHWM: %ld", &peak_kb);
        if (f)
            fclose(f);
        stop();
        for (int i = 0; i < n; i++) {
            assert_int_equal(d[run][i].err, OK);
            assert_true(d[run][i].n > 7900000);
            assert_true(d[run][i].hash == d[0][i].hash);
            assert_true(i == 0 || d[run][i].hash != d[run][i - 1].hash);
        }
        if (!getenv("ASAN_OPTIONS") && !getenv("RIGSIM_NO_MEMORY_CHECK"))
            assert_true(peak_kb < 200000); // 680 MB went out
    }
}

// Of rigsim, once they are at most wanted, or after so long.
static int open_files(int wanted, int patience_ms)
{
    char path[64];
    int n = 0;
    snprintf(path, sizeof(path), "/proc/%d/fd", rigsim);
    for (int tries = 0; tries < patience_ms / 5; tries++, sleep_ms(5)) {
        DIR *dir = opendir(path);
        assert_non_null(dir);
        for (n = 0; readdir(dir); n++)
            ;
        closedir(dir);
        if (n <= wanted)
            break;
    }
    return n;
}

static void many_clients_one_after_another_leave_nothing_behind(void **state)
{
    (void)state;
    start(1, NULL, (const char *[]){ "--raw-size", "64x48", NULL });
    const int before = open_files(0, 1000); // start()'s own client has left, too
    for (int i = 0; i < 300; i++) {
        struct client c;
        assert_int_equal(client_open(&c, loopback_address(), PORT, PATIENCE_MS), 0);
        assert_int_equal(ASK(&c, GET_PROPERTY, 0x5001), OK);
        client_close(&c);
    }
    assert_true(open_files(before, PATIENCE_MS) <= before);
    stop();
}

static void a_second_client_is_refused_while_the_first_is_there(void **state)
{
    (void)state;
    struct client a, b;
    start(1, NULL, NULL);
    assert_int_equal(client_open(&a, loopback_address(), PORT, PATIENCE_MS), 0);
    assert_int_equal(client_open(&b, loopback_address(), PORT, PATIENCE_MS), -EPROTO); // INIT_FAIL
    assert_int_equal(ASK(&a, GET_PROPERTY, 0x5001), OK);
    client_close(&a);
    assert_int_equal(client_open(&b, loopback_address(), PORT, PATIENCE_MS), 0); // and at once afterwards
    client_close(&b);
    stop();
}

static void noise_on_a_socket_ends_that_socket_only(void **state)
{
    (void)state;
    struct client c;
    start(2, NULL, NULL);
    assert_int_equal(client_open(&c, loopback_address(), PORT + 2, PATIENCE_MS), 0);
    for (unsigned k = 0; k < 200; k++) {
        const struct sockaddr_in a = { .sin_family = AF_INET, .sin_port = htons((uint16_t)(PORT + (int)(k % 4))),
                                       .sin_addr.s_addr = inet_addr(loopback_address()) };
        uint8_t bytes[512];
        uint32_t x = k * 2654435761u + 1;
        for (size_t i = 0; i < sizeof(bytes); i++) {
            x = x * 1664525 + 1013904223;
            bytes[i] = (uint8_t)(x >> 24);
        }
        if (k % 3) { // a plausible head
            memset(bytes, 0, 8);
            bytes[0] = (uint8_t)(k % 90);
            bytes[4] = (uint8_t)(k % 16);
        }
        const int fd = socket(AF_INET, SOCK_STREAM, 0);
        assert_int_equal(connect(fd, (const struct sockaddr *)&a, sizeof(a)), 0);
        assert_true(send(fd, bytes, sizeof(bytes), MSG_NOSIGNAL) > 0);
        close(fd);
    }
    assert_int_equal(ASK(&c, GET_PROPERTY, 0x5001), OK);
    client_close(&c);
    stop();
}

// ---- shutter lines -----------------------------------------------------------------------------------------------------------

static int lines_open(const char *path)
{
    struct sockaddr_un a = { .sun_family = AF_UNIX };
    const struct timeval patience = { .tv_sec = PATIENCE_MS / 1000 };
    const int fd = socket(AF_UNIX, SOCK_SEQPACKET, 0);
    assert_true(strlen(path) < sizeof(a.sun_path));
    memcpy(a.sun_path, path, strlen(path) + 1);
    assert_int_equal(connect(fd, (const struct sockaddr *)&a, sizeof(a)), 0);
    setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof(patience));
    return fd;
}

static void set_line(int fd, int line, int level, uint32_t channel, int64_t at_ns, uint64_t tag)
{
    const struct shutter_line r = { .kind = SHUTTER_LINE_SET, .line = (uint8_t)line, .level = (uint8_t)level, .channel = channel,
                                    .at_ns = at_ns, .tag = tag };
    assert_int_equal(send(fd, &r, sizeof(r), MSG_NOSIGNAL), sizeof(r));
}

// n reports, by channel.
static void reports(int fd, int n, struct shutter_line *by_channel)
{
    struct shutter_line r[SHUTTER_LINE_PER_PACKET];
    while (n > 0) {
        const ssize_t bytes = recv(fd, r, sizeof(r), 0);
        if (bytes < 0 && errno == EINTR) // with a timeout: this process was stopped for a while
            continue;
        assert_true(bytes > 0);
        for (size_t i = 0; i < (size_t)bytes / sizeof(r[0]); i++, n--)
            by_channel[r[i].channel] = r[i];
    }
}

static void all_bodies_fire_on_one_edge_and_report_their_lag(void **state)
{
    (void)state;
    enum { N = 200 };
    static struct shutter_line r[N];
    char path[600];
    double mean = 0;
    snprintf(path, sizeof(path), "%s/lines", scratch_dir);
    start(N, NULL, (const char *[]){ "--raw-size", "64x48", "--trigger-socket", path, "--personality", "canon", NULL });
    const int fd = lines_open(path);
    const int64_t at = now_ns() + 300 * MS;
    set_line(fd, SHUTTER_LINE_HALF, 1, SHUTTER_LINE_ALL, at - 250 * MS, 0);
    set_line(fd, SHUTTER_LINE_FULL, 1, SHUTTER_LINE_ALL, at, 42);
    set_line(fd, SHUTTER_LINE_FULL, 0, SHUTTER_LINE_ALL, at + 50 * MS, 0);
    set_line(fd, SHUTTER_LINE_HALF, 0, SHUTTER_LINE_ALL, at + 50 * MS, 0);
    reports(fd, N, r);
    for (unsigned i = 0; i < N; i++) {
        assert_int_equal(r[i].kind, SHUTTER_LINE_SYNC);
        assert_int_equal(r[i].channel, i);
        assert_int_equal(r[i].tag, 42);
        assert_int_equal(r[i].at_ns, at + r[i].lag_ns); // to the nanosecond, whatever the load here
        mean += (double)r[i].lag_ns / N;
    }
    assert_true(mean > 94e6 && mean < 100e6);
    sleep_ms(400); // until the shutters are ready again
    // A press that is told late counts from when it was.
    const int64_t past = now_ns() - 20 * MS;
    set_line(fd, SHUTTER_LINE_FULL, 1, 7, past, 43);
    reports(fd, 1, r);
    assert_int_equal(r[7].at_ns, past + r[7].lag_ns);
    set_line(fd, SHUTTER_LINE_FULL, 0, 7, 0, 0);
    set_line(fd, SHUTTER_LINE_FULL, 1, N, 0, 44); // no such channel
    reports(fd, 1, &(struct shutter_line[N + 1]){ 0 }[0]);
    close(fd);
    stop();
}

static void what_is_wrong_on_the_lines_is_refused_by_name(void **state)
{
    (void)state;
    char path[600];
    struct shutter_line got;
    snprintf(path, sizeof(path), "%s/lines", scratch_dir);
    start(1, NULL, (const char *[]){ "--raw-size", "64x48", "--trigger-socket", path, NULL });
    const int fd = lines_open(path);
    const struct {
        struct shutter_line r;
        int error;
    } bad[] = {
        { { .kind = SHUTTER_LINE_SYNC, .line = 1 }, EINVAL },
        { { .kind = SHUTTER_LINE_SET, .line = 9 }, EINVAL },
        { { .kind = SHUTTER_LINE_SET, .line = 1, .level = 2 }, EINVAL },
        { { .kind = SHUTTER_LINE_SET, .line = 1, .channel = 1 }, ENODEV },
        { { .kind = SHUTTER_LINE_SET, .line = 1, .at_ns = INT64_MAX }, ETIME },
    };
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        struct shutter_line r = bad[i].r;
        r.tag = i;
        assert_int_equal(send(fd, &r, sizeof(r), 0), sizeof(r));
        assert_int_equal(recv(fd, &got, sizeof(got), 0), sizeof(got));
        assert_int_equal(got.kind, SHUTTER_LINE_REFUSED);
        assert_int_equal(got.error, bad[i].error);
        assert_int_equal(got.tag, i);
    }
    assert_int_equal(send(fd, &got, sizeof(got) - 1, 0), sizeof(got) - 1);
    assert_int_equal(recv(fd, &got, sizeof(got), 0), sizeof(got));
    assert_int_equal(got.error, EINVAL);
    close(fd);
    stop();
}

static void a_pressed_body_is_silent_until_its_host_dies(void **state)
{
    (void)state;
    char path[600];
    struct client c;
    snprintf(path, sizeof(path), "%s/lines", scratch_dir);
    start(1, NULL, (const char *[]){ "--raw-size", "64x48", "--trigger-socket", path, NULL });
    assert_int_equal(client_open(&c, loopback_address(), PORT, PATIENCE_MS), 0);
    const int fd = lines_open(path);
    set_line(fd, SHUTTER_LINE_HALF, 1, 0, 0, 0);
    c.timeout_ms = 300;
    int got = OK;
    for (const int64_t end = now_ns() + PATIENCE_MS * MS; got == OK && now_ns() < end;) // until it has noticed
        got = ASK(&c, GET_PROPERTY, 0x5001);
    assert_int_equal(got, -ETIMEDOUT);
    close(fd);
    c.timeout_ms = PATIENCE_MS; // now it answers that question, and the next
    c.transaction--;
    assert_int_equal(ASK(&c, GET_PROPERTY, 0x5001), OK);
    client_close(&c);
    stop();
}

static void a_cut_supply_breaks_the_link_and_spares_the_card(void **state)
{
    (void)state;
    char path[600];
    struct client c;
    snprintf(path, sizeof(path), "%s/lines", scratch_dir);
    start(1, NULL, (const char *[]){ "--raw-size", "64x48", "--trigger-socket", path, NULL });
    assert_int_equal(client_open(&c, loopback_address(), PORT, PATIENCE_MS), 0);
    assert_int_equal(ASK(&c, CAPTURE, 0, 0), OK);
    const uint32_t handle = file(&c, 0);
    const int fd = lines_open(path);
    set_line(fd, SHUTTER_LINE_POWER, 1, 0, 0, 0);
    int err = OK;
    for (int64_t end = now_ns() + PATIENCE_MS * MS; err == OK && now_ns() < end;)
        err = ASK(&c, GET_PROPERTY, 0x5001);
    assert_int_equal(err, -EPIPE);
    client_close(&c);
    assert_int_equal(client_open(&c, loopback_address(), PORT, PATIENCE_MS), -ECONNREFUSED);
    set_line(fd, SHUTTER_LINE_POWER, 0, 0, 0, 0);
    for (int64_t end = now_ns() + PATIENCE_MS * MS; err && now_ns() < end; sleep_ms(20))
        err = client_open(&c, loopback_address(), PORT, PATIENCE_MS);
    assert_int_equal(err, 0);
    assert_int_equal(file(&c, 0), handle);
    client_close(&c);
    close(fd);
    stop();
}

// ---- faults ------------------------------------------------------------------------------------------------------------------

static void faults_strike_their_camera_and_no_other(void **state)
{
    (void)state;
    static const char script[] = "A01 on op 0x100e#1 busy 400ms\n"
                                 "A02 on op 0x1015#2 stall 500ms\n"
                                 "A03 on op 0x1015#1 refuse 2s\n"
                                 "A04 on connect * lose_added 1\n"
                                 "A05 on connect * corrupt 1\n"
                                 "A06 on connect * short 1\n"
                                 "A07 on connect * slow 40000\n"
                                 "A08 on connect * card_full\n";
    struct client c[9];
    uint16_t code;
    uint32_t value;
    start(9, script, (const char *[]){ "--raw-size", "128x96", "--clock", "fixed", NULL });
    for (int i = 0; i < 9; i++)
        assert_int_equal(client_open(&c[i], loopback_address(), PORT + 2 * i, PATIENCE_MS), 0);
    // busy, for its time
    int64_t from = now_ns();
    assert_int_equal(ASK(&c[0], CAPTURE, 0, 0), BUSY);
    while (ASK(&c[0], CAPTURE, 0, 0) == BUSY && now_ns() < from + PATIENCE_MS * MS)
        sleep_ms(5);
    assert_true(now_ns() - from >= 400 * MS);
    assert_true(file(&c[0], 0) != 0);
    // stalled: the answer comes, late
    assert_int_equal(ASK(&c[1], GET_PROPERTY, 0x5001), OK);
    from = now_ns();
    assert_int_equal(ASK(&c[1], GET_PROPERTY, 0x5001), OK); // when it begins
    assert_int_equal(ASK(&c[1], GET_PROPERTY, 0x5001), OK);
    assert_true(now_ns() - from >= 500 * MS);
    // refused, then back
    assert_int_equal(ASK(&c[2], GET_PROPERTY, 0x5001), -EPIPE);
    client_close(&c[2]);
    assert_int_equal(client_open(&c[2], loopback_address(), PORT + 4, PATIENCE_MS), -ECONNREFUSED);
    int err = -ECONNREFUSED;
    for (const int64_t end = now_ns() + PATIENCE_MS * MS; err == -ECONNREFUSED && now_ns() < end; sleep_ms(20))
        err = client_open(&c[2], loopback_address(), PORT + 4, PATIENCE_MS);
    assert_int_equal(err, 0);
    // the event is lost, the file is not
    assert_int_equal(ASK(&c[3], CAPTURE, 0, 0), OK);
    assert_int_equal(client_event(&c[3], &code, &value), 0);
    assert_int_equal(code, 0x400d); // CaptureComplete alone
    assert_true(file(&c[3], 0) != 0);
    // corrupt, short, and whole
    for (int i = 4; i < 9; i++)
        if (i != 7)
            assert_int_equal(ASK(&c[i], CAPTURE, 0, 0), OK);
    assert_int_equal(ASK(&c[8], GET_OBJECT, file(&c[8], 0)), OK);
    const size_t whole = c[8].data.n;
    assert_int_equal(ASK(&c[5], GET_OBJECT, file(&c[5], 0)), OK);
    assert_int_equal(c[5].data.n, whole / 2);
    assert_int_equal(ASK(&c[4], GET_OBJECT, file(&c[4], 0)), OK);
    assert_int_equal(c[4].data.n, whole);
    assert_int_equal(c[4].data.data[0], 'I' ^ 0x5a); // the first byte of a little-endian TIFF
    // 40 kB/s
    const uint32_t handle = file(&c[6], 0);
    from = now_ns();
    assert_int_equal(ASK(&c[6], GET_OBJECT, handle), OK);
    assert_true((double)(now_ns() - from) * 1e-9 > .8 * (double)whole / 40000);
    assert_int_equal(ASK(&c[7], CAPTURE, 0, 0), 0x200c);
    for (int i = 0; i < 9; i++)
        client_close(&c[i]);
    stop();
}

static void hostile_replies_never_hang_a_careful_client(void **state)
{
    (void)state;
    static const char *const kinds[] = { "length", "huge", "tiny", "count", "string", "transaction", "type", "total", "garbage", "cut" };
    char script[1024];
    size_t n = 0;
    for (unsigned i = 0; i < 10; i++)
        n += (size_t)snprintf(script + n, sizeof(script) - n, "A%02u on op 0x1005#1 hostile %s 1\n", i + 1, kinds[i]);
    start(10, script, NULL);
    for (int i = 0; i < 10; i++) {
        struct client c;
        const bool is_sound = i == 3 || i == 4 || i == 8; // a packet with wrong content
        assert_int_equal(client_open(&c, loopback_address(), PORT + 2 * i, PATIENCE_MS), 0);
        c.timeout_ms = is_sound ? PATIENCE_MS : 500;
        const int got = ASK(&c, 0x1005, 0x00010001);
        if (is_sound)
            assert_int_equal(got, OK);
        else
            assert_true(got == -EPROTO || got == -ETIMEDOUT || got == -EPIPE);
        client_close(&c);
        assert_int_equal(client_open(&c, loopback_address(), PORT + 2 * i, PATIENCE_MS), 0); // and the camera is well again
        assert_int_equal(ASK(&c, 0x1005, 0x00010001), OK);
        assert_int_equal(c.data.n, 26 + 1 + 1 + 2 * 8); // no description, volume SIMCARD
        client_close(&c);
    }
    stop();
}

static void a_flood_of_events_drowns_no_answer(void **state)
{
    (void)state;
    struct client c;
    uint16_t code;
    uint32_t value;
    int n = 0;
    start(1, "A01 on op 0x100e#1 flood 2000 500ms\n", (const char *[]){ "--raw-size", "64x48", NULL });
    assert_int_equal(client_open(&c, loopback_address(), PORT, PATIENCE_MS), 0);
    assert_int_equal(ASK(&c, CAPTURE, 0, 0), OK);
    assert_true(file(&c, 0) != 0);
    while (n < 1000 + 2 && !client_event(&c, &code, &value)) // and the two of the shot
        n++;
    assert_int_equal(n, 1000 + 2);
    c.timeout_ms = 300;
    assert_int_equal(client_event(&c, &code, &value), -ETIMEDOUT);
    client_close(&c);
    stop();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(eighty_five_cameras_deliver_8_mb_each_at_once_and_the_same_again),
        cmocka_unit_test(many_clients_one_after_another_leave_nothing_behind),
        cmocka_unit_test(a_second_client_is_refused_while_the_first_is_there),
        cmocka_unit_test(noise_on_a_socket_ends_that_socket_only),
        cmocka_unit_test(all_bodies_fire_on_one_edge_and_report_their_lag),
        cmocka_unit_test(what_is_wrong_on_the_lines_is_refused_by_name),
        cmocka_unit_test(a_pressed_body_is_silent_until_its_host_dies),
        cmocka_unit_test(a_cut_supply_breaks_the_link_and_spares_the_card),
        cmocka_unit_test(faults_strike_their_camera_and_no_other),
        cmocka_unit_test(hostile_replies_never_hang_a_careful_client),
        cmocka_unit_test(a_flood_of_events_drowns_no_answer),
    };
    if (scratch_open())
        return 1;
    signal(SIGPIPE, SIG_IGN);
    const int failed = cmocka_run_group_tests(tests, NULL, NULL);
    if (rigsim > 0)
        kill(rigsim, SIGKILL);
    scratch_empty();
    return failed || scratch_close();
}
