// rigd/rigctl.c - the daemon's command line client: one request, one answer, as a table or as JSON.
//
// CONTROL.md is the protocol. While a take runs, events of the stream are printed on a terminal, so that people see what happens.
#include "rigd/rigctl_develop.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <argp.h>
#include <errno.h>
#include <math.h>
#include <poll.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { EXIT_DONE = 0, EXIT_FAILED = 1, EXIT_USAGE = 2, LINE_MAX_BYTES = 64 << 20, PATIENCE_NS = 1900000000, OPTION_OPEN = 256, OPTION_MERGE, OPTION_ON_BUTTON };

struct arguments {
    const char *socket_path, *name, *again, *merge, *output, *word[3];
    int n_words, shots;
    bool json, watch, without_missing, on_button, cancel, open;
    int (*without_daemon)(int argc, char **argv, bool json); // with the words from rest on
    char **rest;
    int n_rest;
};

struct line_reader {
    int fd;
    char *bytes;
    size_t n, room;
};

// ---- the wire --------------------------------------------------------------------------------------------------------------------

static int connect_to(const char *path)
{
    struct sockaddr_un address = { .sun_family = AF_UNIX };
    if (strlen(path) >= sizeof(address.sun_path)) {
        log_error("--socket %s: longer than %zu bytes", path, sizeof(address.sun_path) - 1);
        return -1;
    }
    strcpy(address.sun_path, path);
    const int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd < 0 || connect(fd, (struct sockaddr *)&address, sizeof(address))) {
        log_error("cannot reach rigd at %s: %s; %s", path, strerror(errno),
                  errno == EACCES ? "become a member of rigd's group" : "is it running (systemctl status rigd)? --socket or RIGD_SOCKET names another");
        if (fd >= 0)
            close(fd);
        return -1;
    }
    return fd;
}

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

// What is under way is said again where nothing else is; "": nothing is, or a person was asked for something.
static struct {
    char text[200];
    int64_t since_ns, told_ns; // when people heard something last
    bool stands;               // on this line of the terminal
} under_way;

static __attribute__((format(printf, 1, 2))) void begins(const char *format, ...)
{
    char text[sizeof(under_way.text)];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof(text), format, args);
    va_end(args);
    if (!strcmp(text, under_way.text))
        return;
    memcpy(under_way.text, text, sizeof(text));
    under_way.since_ns = clock_ns();
}

static void wipe(void)
{
    if (under_way.stands)
        fputs("\r\033[K", stderr);
    under_way.stands = false;
}

static __attribute__((format(printf, 1, 2))) void tell(const char *format, ...)
{
    va_list args;
    wipe();
    va_start(args, format);
    vfprintf(stderr, format, args);
    va_end(args);
    fputc('\n', stderr);
    under_way.told_ns = clock_ns();
}

// Over the line before on a terminal.
static void tell_what_is_under_way(void)
{
    const int64_t now = clock_ns();
    wipe();
    fprintf(stderr, "  %s", under_way.text);
    if (under_way.since_ns <= under_way.told_ns)
        fprintf(stderr, ": for %.0f s", 1e-9 * (double)(now - under_way.since_ns));
    under_way.stands = isatty(2);
    if (!under_way.stands)
        fputc('\n', stderr);
    under_way.told_ns = now;
}

// Until the daemon says something. A word every two seconds; in a log of what takes hours, fewer.
static void wait_for_daemon(int fd)
{
    struct pollfd p = { .fd = fd, .events = POLLIN };
    while (under_way.text[0]) {
        const int64_t long_ns = isatty(2) ? 0 : (under_way.told_ns - under_way.since_ns) / 30;
        const int64_t wait_ns = under_way.told_ns + (long_ns > PATIENCE_NS ? long_ns : PATIENCE_NS) - clock_ns();
        if (wait_ns <= 0)
            tell_what_is_under_way();
        else if (poll(&p, 1, (int)(wait_ns / 1000000) + 1) > 0)
            return;
    }
}

// The next line as JSON; NULL: the daemon has left.
static struct json *next_message(struct line_reader *r)
{
    for (;;) {
        char *newline = r->n ? memchr(r->bytes, '\n', r->n) : NULL;
        if (newline) {
            struct json *doc = NULL;
            const size_t n = (size_t)(newline - r->bytes);
            const int err = json_parse(&doc, r->bytes, n, "rigd's answer");
            r->n -= n + 1;
            memmove(r->bytes, newline + 1, r->n);
            return err ? NULL : doc;
        }
        if (r->n == r->room) {
            r->room = r->room ? 2 * r->room : 65536;
            char *grown = r->room <= LINE_MAX_BYTES ? realloc(r->bytes, r->room) : NULL;
            if (!grown)
                return NULL;
            r->bytes = grown;
        }
        wait_for_daemon(r->fd);
        const ssize_t n = read(r->fd, r->bytes + r->n, r->room - r->n);
        if (n < 0 && errno == EINTR)
            continue;
        if (n <= 0) {
            log_error("rigd ended the conversation; journalctl -u rigd says why");
            return NULL;
        }
        r->n += (size_t)n;
    }
}

static bool send_request(int fd, struct json *request) // takes request
{
    char *text = json_text(request);
    json_free(request);
    if (!text)
        return false;
    const bool sent = dprintf(fd, "%s\n", text) > 0;
    free(text);
    return sent;
}

static struct json *request_of(const char *what)
{
    struct json *o = json_new_object();
    json_set_int(o, "v", 1);
    json_set_int(o, "id", 1);
    json_set_string(o, "do", what);
    return o;
}

static const char *text_of(const struct json *v, const char *path)
{
    const char *s = "";
    json_get_string(v, path, &s);
    return s;
}

static double number_of(const struct json *v, const char *path, double missing)
{
    double n = missing;
    json_get_number(v, path, &n);
    return n;
}

static bool flag_of(const struct json *v, const char *path)
{
    bool b = false;
    json_get_bool(v, path, &b);
    return b;
}

static void print_progress(const struct json *p)
{
    const char *step = text_of(p, "step"), *text = text_of(p, "text");
    const double stop = number_of(p, "stop", 0), n_stops = number_of(p, "n_stops", 0);
    if (!strcmp(step, "frame")) {
        tell("    %s", text);
    } else if (!strcmp(step, "stop_done")) {
        tell("  stop %.0f of %.0f is done: %s", stop, n_stops, text);
    } else {
        if (!strcmp(step, "turn"))
            begins("stop %.0f of %.0f: to yaw %g, pitch %g", stop, n_stops, number_of(p, "yaw_deg", 0), number_of(p, "pitch_deg", 0));
        else
            begins("stop %.0f of %.0f: exposure %.0f, %s s", stop, n_stops, number_of(p, "frame", 0), text_of(p, "exposure"));
        tell("  %s", under_way.text);
    }
}

// One line when a step changes, another when it is done.
static void print_step_event(const struct json *body)
{
    static char last[200];
    char line[200];
    const char *step = text_of(body, "step.step"), *state = text_of(body, "step.state");
    const double n = number_of(body, "step.n", 0);
    const bool runs = !strcmp(state, "running");
    if (runs && n > 1)
        snprintf(line, sizeof(line), "%s: %.0f of %.0f", step, number_of(body, "step.n_done", 0), n);
    else
        snprintf(line, sizeof(line), "%s: %s%s%.120s", step, state, text_of(body, "step.text")[0] ? ": " : "", text_of(body, "step.text"));
    if (runs)
        begins("%s", line);
    else if (!strncmp(under_way.text, step, strlen(step)))
        begins("%s", "");
    if (!strcmp(state, "looking") || !strcmp(state, "waiting") || !strcmp(state, "queued"))
        return;
    if (strcmp(line, last))
        tell("  %s", line);
    memcpy(last, line, sizeof(last));
}

// Of a program at work: at once on a terminal; in a file or a pipe when nothing was said for two seconds.
static void print_how_far(const struct json *p)
{
    const char *step = text_of(p, "step"), *stage = text_of(p, "stage");
    const double n_done = number_of(p, "done", 0), n = number_of(p, "total", 0);
    if (n_done < n)
        begins("%s: %s %.0f of %.0f", step, stage, n_done, n);
    else
        begins("%s: after %s", step, stage); // what follows has not said its name
    if (isatty(2))
        tell_what_is_under_way();
}

static void print_event(const struct json *message)
{
    const char *event = text_of(message, "event");
    const struct json *body = json_get(message, "body");
    if (!strcmp(event, "processing")) {
        print_step_event(body);
    } else if (!strcmp(event, "progress")) {
        print_how_far(body);
    } else if (!strcmp(event, "state")) {
        begins("%s", text_of(body, "state"));
        tell("  %s", text_of(body, "state"));
    } else if (!strcmp(event, "say")) {
        tell("  %s: %s", text_of(body, "severity"), text_of(body, "text"));
    } else if (!strcmp(event, "panorama")) {
        print_progress(body);
    } else if (!strcmp(event, "prompt") && flag_of(body, "on")) {
        begins("%s", "");
        tell("  ==> %s", text_of(body, "text"));
    }
}

// A person at this terminal was asked to do something: Enter says that it is done. Until then, or until the daemon says something.
static bool wait_for_enter(const struct line_reader *r)
{
    struct pollfd p[] = { { .fd = 0, .events = POLLIN }, { .fd = r->fd, .events = POLLIN } };
    char line[256];
    if (r->n && memchr(r->bytes, '\n', r->n))
        return false;
    while (poll(p, 2, -1) < 0 && errno == EINTR)
        ;
    if (p[1].revents || !fgets(line, sizeof(line), stdin))
        return false;
    struct json *done = request_of("continue");
    json_set_int(done, "id", 2);
    return send_request(r->fd, done);
}

// Ask and wait for the answer. events: show what happens meanwhile. NULL: said why.
static struct json *ask(const struct arguments *a, struct json *request, bool events)
{
    struct line_reader r = { .fd = connect_to(a->socket_path) };
    struct json *answer = NULL;
    if (r.fd < 0) {
        json_free(request);
        return NULL;
    }
    if (events) {
        struct json *subscribe = request_of("subscribe");
        json_set_int(subscribe, "id", 0);
        send_request(r.fd, subscribe);
        under_way.told_ns = clock_ns();
        if (!a->watch) // it may have to wait for hours
            begins("%s", a->word[0]);
    }
    send_request(r.fd, request);
    bool asked = false;
    for (struct json *m; !answer && (m = next_message(&r));) {
        int64_t id = -1;
        const char *about = text_of(m, "body.take"), *take = a->n_words > 1 ? a->word[1] : "";
        if (json_get(m, "event") && about[0] && take[0] && strcmp(about, take)) {
            ; // another take's
        } else if (json_get(m, "event")) {
            print_event(m);
            if (!strcmp(text_of(m, "event"), "prompt")) {
                asked = flag_of(m, "body.on") && isatty(0);
                if (asked) {
                    tcflush(0, TCIFLUSH); // what was typed before was no answer to this
                    fputs("      Enter when done: ", stderr);
                }
            }
            if (asked)
                asked = !wait_for_enter(&r);
        } else if (!json_get_int(m, "id", &id) && id == 2)
            ;
        else if (!json_get_int(m, "id", &id) && id == 1)
            answer = m;
        else if (json_get(m, "error"))
            answer = m;
        if (answer != m)
            json_free(m);
    }
    wipe();
    begins("%s", "");
    close(r.fd);
    free(r.bytes);
    if (answer && !flag_of(answer, "ok")) {
        log_error("%s", text_of(answer, "error.text"));
        char *text = a->json ? json_text(answer) : NULL;
        if (text)
            puts(text);
        free(text);
        json_free(answer);
        return NULL;
    }
    return answer;
}

// ---- what people see ---------------------------------------------------------------------------------------------------------------

static const struct json *element(const struct json *v, const char *list, int i)
{
    char key[60];
    snprintf(key, sizeof(key), "%s.%d", list, i);
    return json_get(v, key);
}

static void print_number(const char *format, double n, const char *unknown)
{
    if (isnan(n))
        fputs(unknown, stdout);
    else
        printf(format, n);
}

static void print_take(const struct json *t)
{
    printf("take %s: %s", text_of(t, "id"), text_of(t, "state"));
    if (json_get(t, "seconds"))
        printf(" after %.2f s", number_of(t, "seconds", 0));
    const bool panorama = !strcmp(text_of(t, "kind"), "panorama");
    if (panorama)
        printf("\n  panorama of %.0f stops", number_of(t, "n_stops", 0));
    printf("\n  %.0f of %.0f %s, %.0f frames, %.1f MB", number_of(t, "n_delivered", 0), number_of(t, "n_expected", 0), panorama ? "exposures" : "cameras", number_of(t, "n_frames", 0),
           1e-6 * number_of(t, "bytes", 0));
    if (!panorama && json_get(t, "seconds") && number_of(t, "seconds", 0) > 0)
        printf(", %.1f MB/s", 1e-6 * number_of(t, "bytes", 0) / number_of(t, "seconds", 1));
    putchar('\n');
    if (json_get(t, "spread_ms"))
        printf("  shutters: spread %.3f ms, sigma %.3f ms over %.0f bodies%s\n", number_of(t, "spread_ms", 0), number_of(t, "sigma_ms", 0), number_of(t, "n_measured", 0),
               flag_of(t, "synchronised") ? "" : " (pressed by drivers: not synchronised)");
    if (text_of(t, "reason")[0])
        printf("  reason: %s\n", text_of(t, "reason"));
    static const char *const lists[][2] = { { "missing", "missing" }, { "left_out", "left out" } };
    for (int k = 0; k < 2; k++)
        for (int i = 0; i < json_length(t, lists[k][0]); i++) {
            const struct json *c = element(t, lists[k][0], i);
            printf("  %s: %s (%s): %s\n", lists[k][1], text_of(c, "camera"), text_of(c, "port"), text_of(c, "note"));
        }
}

static void print_step(const struct json *e)
{
    printf("  %-12s %-10s", text_of(e, "step"), text_of(e, "state"));
    if (number_of(e, "n", 0) > 1)
        printf(" %3.0f of %-3.0f", number_of(e, "n_done", 0), number_of(e, "n", 0));
    else if (number_of(e, "total", 0) > 0)
        printf(" %s %.0f of %.0f", text_of(e, "stage"), number_of(e, "done", 0), number_of(e, "total", 0));
    else
        fputs("           ", stdout);
    if (json_get(e, "ended_s") && number_of(e, "ended_s", 0) > 0)
        printf(" %7.1f s .. %7.1f s", number_of(e, "began_s", 0), number_of(e, "ended_s", 0));
    printf("%s%s\n", text_of(e, "text")[0] ? "  " : "", text_of(e, "text"));
}

static void print_process(const struct json *t)
{
    if (!text_of(t, "take")[0])
        return;
    printf("take %s: %s\n", text_of(t, "take"), flag_of(t, "settled") ? "settled" : "under way");
    for (int i = 0; i < json_length(t, "steps"); i++)
        print_step(element(t, "steps", i));
}

static void print_status(const struct json *s)
{
    printf("%s: %s, %.0f of %.0f cameras ready, %.0f quarantined; trigger %s\n", text_of(s, "name"), text_of(s, "state"), number_of(s, "n_ready", 0),
           number_of(s, "n_cameras", 0), number_of(s, "n_quarantined", 0), text_of(s, "trigger"));
    if (text_of(s, "outcome")[0])
        printf("last: %s\n", text_of(s, "outcome"));
    if (text_of(s, "prompt")[0])
        printf("==> %s\n", text_of(s, "prompt"));
    if (text_of(s, "refusal")[0])
        printf("a take would be refused: %s\n", text_of(s, "refusal"));
    const char *button = text_of(s, "button");
    if (button[0])
        printf("button: %s\n", !strcmp(button, "fires") ? "armed, a press fires at once" : !strcmp(button, "takes") ? "a press begins a take: preflight, then the shot" : "a press is refused");
    if (text_of(s, "page")[0])
        printf("page: %s\n", text_of(s, "page"));
    printf("%-10s %-12s %-11s %-12s %-20s %5s %6s %8s  %s\n", "camera", "condition", "doing", "serial", "model", "batt", "free", "lag ms", "note");
    for (int i = 0; i < json_length(s, "cameras"); i++) {
        const struct json *c = element(s, "cameras", i);
        printf("%-10s %-12s %-11s %-12.12s %-20.20s ", text_of(c, "name"), text_of(c, "condition"), text_of(c, "doing"), text_of(c, "serial"), text_of(c, "model"));
        print_number("%4.0f%% ", number_of(c, "battery_percent", NAN), "    - ");
        print_number("%6.0f ", number_of(c, "free_images", NAN), "     - ");
        print_number("%8.2f", number_of(c, "lag_ms", NAN), "       -");
        printf("  %s\n", text_of(c, "note"));
    }
    for (int i = 0; i < json_length(s, "processing"); i++)
        if (!flag_of(element(s, "processing", i), "settled"))
            print_process(element(s, "processing", i));
}

static void print_findings(const struct json *f)
{
    for (int i = 0; i < json_length(f, "findings"); i++) {
        const struct json *e = element(f, "findings", i);
        const char *about = json_get(e, "about") ? text_of(e, "about") : text_of(e, "camera");
        printf("%-8s %s%s%s%s%s%s\n", text_of(e, "severity"), about, text_of(e, "port")[0] ? " (" : "", text_of(e, "port"), text_of(e, "port")[0] ? ")" : "", about[0] ? ": " : "",
               text_of(e, "text"));
    }
}

static void print_lag(const struct json *l)
{
    printf("%-10s %9s %8s %9s %5s %8s\n", "camera", "mean ms", "std ms", "+- ms", "n", "rejected");
    for (int i = 0; i < json_length(l, "lag"); i++) {
        const struct json *e = element(l, "lag", i);
        if (number_of(e, "n", 0) < 1)
            printf("%-10s not measured\n", text_of(e, "camera"));
        else
            printf("%-10s %9.3f %8.3f %9.3f %5.0f %8.0f%s\n", text_of(e, "camera"), number_of(e, "mean_ms", 0), number_of(e, "std_ms", 0), number_of(e, "error_ms", 0), number_of(e, "n", 0),
                   number_of(e, "rejected", 0), flag_of(e, "steady") ? "" : "  unsteady");
    }
}

// ---- commands ----------------------------------------------------------------------------------------------------------------------------

// What happens meanwhile is for people: calls that take longer than they expect show it in a pipe, too.
static bool is_watched(const struct arguments *a)
{
    return !a->json && isatty(2);
}

// Ask; with --json print the result as it is, else by print. 0 and *out (if wanted), or EXIT_FAILED.
static int ask_and_print(const struct arguments *a, struct json *request, bool events, void (*print)(const struct json *), struct json **out)
{
    struct json *answer = ask(a, request, events);
    if (!answer)
        return EXIT_FAILED;
    const struct json *result = json_get(answer, "result");
    if (a->json) {
        char *text = json_text(result);
        puts(text ? text : "null");
        free(text);
    } else if (print) {
        print(result);
    }
    if (out)
        *out = answer;
    else
        json_free(answer);
    return EXIT_DONE;
}

static int status(const struct arguments *a)
{
    if (!a->watch)
        return ask_and_print(a, request_of("status"), false, print_status, NULL);
    for (;;) { // until Ctrl-C
        if (isatty(1) && !a->json)
            fputs("\033[H\033[2J", stdout);
        const int err = ask_and_print(a, request_of("status"), false, print_status, NULL);
        if (err)
            return err;
        fflush(stdout);
        usleep(200000);
    }
}

static int healthy(const struct arguments *a, const char *what, const char *flag)
{
    struct json *answer = NULL;
    const int err = ask_and_print(a, request_of(what), is_watched(a), print_findings, &answer);
    if (err)
        return err;
    char path[40];
    snprintf(path, sizeof(path), "result.%s", flag);
    const bool good = flag_of(answer, path);
    if (!a->json && good && !json_length(answer, "result.findings"))
        puts("nothing to complain about");
    json_free(answer);
    return good ? EXIT_DONE : EXIT_FAILED;
}

static int doctor(const struct arguments *a)
{
    return healthy(a, "doctor", "healthy");
}

static int preflight(const struct arguments *a)
{
    return healthy(a, "preflight", "fit");
}

static int take_result(const struct arguments *a, struct json *request)
{
    struct json *answer = NULL;
    const int err = ask_and_print(a, request, is_watched(a), print_take, &answer);
    if (err)
        return err;
    const char *state = text_of(answer, "result.state"); // one that is resumed may have come further before
    const bool good = !strcmp(state, "verified") || !strcmp(state, "developed") || !strcmp(state, "solved");
    json_free(answer);
    return good ? EXIT_DONE : EXIT_FAILED;
}

static int capture(const struct arguments *a)
{
    struct json *r = request_of("capture");
    json_set_string(r, "name", a->name ? a->name : "take");
    json_set_bool(r, "without_missing", a->without_missing);
    json_set_bool(r, "on_button", a->on_button);
    return take_result(a, r);
}

// The plan of a panorama: that file, a take's folder, or a take that the daemon knows.
static bool find_plan(const struct arguments *a, char *out, size_t room)
{
    struct json *answer = NULL;
    snprintf(out, room, "%s/panorama/panorama.json", a->merge);
    if (!access(out, R_OK))
        return true;
    snprintf(out, room, "%s", a->merge);
    if (!access(out, R_OK))
        return true;
    if (!strchr(a->merge, '/')) {
        struct json *r = request_of("report");
        json_set_string(r, "take", a->merge);
        answer = ask(a, r, false);
        if (answer)
            snprintf(out, room, "%s/panorama/panorama.json", text_of(answer, "result.path"));
        json_free(answer);
        return answer && !access(out, R_OK);
    }
    return false;
}

// Offline: rigd-panorama, beside this program.
static int merge(const struct arguments *a)
{
    char program[600], plan[1400];
    if (!a->output) {
        fputs("rigctl panorama --merge: expected -o FILE.exr\n", stderr);
        return EXIT_USAGE;
    }
    if (!find_plan(a, plan, sizeof(plan))) {
        log_error("--merge %s: found neither a panorama.json nor a panorama take", a->merge);
        return EXIT_FAILED;
    }
    ssize_t n = readlink("/proc/self/exe", program, sizeof(program) - 20);
    while (n > 0 && program[n - 1] != '/')
        n--;
    strcpy(program + (n > 0 ? n : 0), "rigd-panorama");
    execl(program, "rigd-panorama", plan, "-o", a->output, a->json ? "--json" : NULL, NULL);
    log_error("cannot start %s: %s", program, strerror(errno));
    return EXIT_FAILED;
}

static int panorama(const struct arguments *a)
{
    struct json *r = request_of("panorama"), *answer;
    if (a->merge) {
        json_free(r);
        return merge(a);
    }
    if (a->name)
        json_set_string(r, "name", a->name);
    answer = ask(a, r, !a->json); // shown in any case: a person may be asked for something
    if (!answer)
        return EXIT_FAILED;
    const struct json *result = json_get(answer, "result");
    char *text = a->json ? json_text(result) : NULL;
    if (a->json)
        puts(text ? text : "null");
    else
        print_take(result);
    const bool good = !strcmp(text_of(result, "state"), "verified");
    free(text);
    json_free(answer);
    return good ? EXIT_DONE : EXIT_FAILED;
}

static int go_on(const struct arguments *a)
{
    return ask_and_print(a, request_of("continue"), false, NULL, NULL);
}

static struct json *about_take(const char *what, const char *take)
{
    struct json *r = request_of(what);
    json_set_string(r, "take", take);
    return r;
}

static int resume(const struct arguments *a)
{
    return take_result(a, about_take("resume", a->word[1]));
}

static void print_report(const struct json *t)
{
    print_take(t);
    for (int i = 0; i < json_length(t, "cameras"); i++) {
        const struct json *c = element(t, "cameras", i);
        printf("  %-10s %-12s", text_of(c, "camera"), text_of(c, "serial"));
        print_number(" lag %8.3f ms", number_of(c, "lag_ms", NAN), "");
        for (int k = 0; k < json_length(c, "files"); k++) {
            const struct json *f = element(c, "files", k);
            printf("  %s %.0f %s", text_of(f, "file"), number_of(f, "size", 0), text_of(f, "xxh128"));
        }
        if (json_get(c, "developed"))
            printf("  %s clipped %.2f %%", text_of(c, "developed"), 100 * number_of(c, "clipped_share", 0));
        printf("%s%s\n", text_of(c, "note")[0] ? "  " : "", text_of(c, "note"));
    }
    if (json_length(t, "time_line") > 0)
        printf("  time line, seconds after the button\n");
    for (int i = 0; i < json_length(t, "time_line"); i++) {
        const struct json *s = element(t, "time_line", i);
        printf("    %-11s %8.2f .. %8.2f   took %8.2f\n", text_of(s, "stage"), number_of(s, "began_s", 0), number_of(s, "ended_s", 0), number_of(s, "took_s", 0));
    }
    for (int i = 0; i < json_length(t, "processing.solves"); i++) {
        const struct json *v = element(t, "processing.solves", i);
        printf("  solve %-9s", text_of(v, "name"));
        print_number(" RMSE of views set aside %.3f %%", number_of(v, "rmse_held_out_percent", NAN), "");
        printf(" in %.1f s%s%s\n", number_of(v, "seconds", 0), flag_of(v, "trusted") ? "" : "; ", text_of(v, "why"));
    }
    for (int i = 0; i < json_length(t, "processing.notes"); i++) {
        char key[40];
        snprintf(key, sizeof(key), "processing.notes.%d", i);
        printf("  note: %s\n", text_of(t, key));
    }
    for (int i = 0; i < json_length(t, "pages"); i++) {
        char key[40];
        snprintf(key, sizeof(key), "pages.%d", i);
        printf("  page: %s\n", text_of(t, key));
    }
}

// The newest page in the desktop's browser.
static int open_page(const struct json *t)
{
    const int n = json_length(t, "pages");
    char key[40];
    snprintf(key, sizeof(key), "pages.%d", n - 1);
    if (n < 1) {
        log_error("there is no page yet: no solve of this take has ended; rigctl process %s --watch", text_of(t, "id"));
        return EXIT_FAILED;
    }
    const char *page = "";
    json_get_string(t, key, &page);
    execlp("xdg-open", "xdg-open", page, (char *)NULL);
    log_error("cannot run xdg-open: %s; open it by hand: %s", strerror(errno), page);
    return EXIT_FAILED;
}

static int report(const struct arguments *a)
{
    struct json *answer = NULL;
    int err = ask_and_print(a, about_take("report", a->word[1]), false, print_report, &answer);
    fflush(stdout);
    if (!err && a->open)
        err = open_page(json_get(answer, "result"));
    json_free(answer);
    return err;
}

// Exit status of what was made of a take: failed if a step is.
static int outcome_of(const struct json *t)
{
    for (int i = 0; i < json_length(t, "steps"); i++) {
        const char *state = text_of(element(t, "steps", i), "state");
        if (!strcmp(state, "failed") || !strcmp(state, "missing") || !strcmp(state, "cancelled"))
            return EXIT_FAILED;
    }
    return EXIT_DONE;
}

static int process(const struct arguments *a)
{
    struct json *r = about_take("process", a->word[1]), *answer = NULL;
    if (a->again)
        json_set_string(r, "again", a->again);
    json_set_bool(r, "cancel", a->cancel);
    json_set_bool(r, "wait", a->watch);
    if (a->watch && !a->json)
        fprintf(stderr, "take %s\n", a->word[1]);
    const int err = ask_and_print(a, r, a->watch && !a->json, print_process, &answer);
    const int code = err ? err : a->watch ? outcome_of(json_get(answer, "result")) : EXIT_DONE;
    json_free(answer);
    return code;
}

static bool print_path(const char *what, const char *take, const char *name)
{
    char path[1200];
    snprintf(path, sizeof(path), "%s/%s", take, name);
    if (access(path, R_OK))
        return false;
    printf("  %-10s %s\n", what, path);
    return true;
}

static void print_preview(const struct json *t)
{
    const char *take = text_of(t, "path");
    print_process(t);
    if (!print_path("sheet", take, "sheet/linear.png"))
        print_path("sheet", take, "sheet/thumbnails.png");
    print_path("model", take, "solve/preview/model.glb");
    print_path("page", take, "solve/preview/report.html");
}

static int preview(const struct arguments *a)
{
    struct json *r = about_take("preview", a->word[1]), *answer = NULL;
    json_set_bool(r, "wait", true);
    const int err = ask_and_print(a, r, is_watched(a), print_preview, &answer);
    const int code = err ? err : outcome_of(json_get(answer, "result"));
    json_free(answer);
    return code;
}

static void print_export(const struct json *e)
{
    printf("%s: %.0f files in its ascmhl manifest, %s\n", text_of(e, "path"), number_of(e, "n_files", 0), flag_of(e, "intact") ? "all intact" : "NOT all intact: see the journal");
}

static int export(const struct arguments *a)
{
    struct json *answer = NULL;
    const int err = ask_and_print(a, about_take("export", a->word[1]), false, print_export, &answer);
    const bool good = !err && flag_of(answer, "result.intact");
    json_free(answer);
    return good ? EXIT_DONE : EXIT_FAILED;
}

static int calibrate(const struct arguments *a)
{
    struct json *r = request_of("calibrate"), *answer = NULL;
    json_set_string(r, "what", a->word[1]);
    if (a->shots)
        json_set_int(r, "shots", a->shots);
    const int err = ask_and_print(a, r, !a->json, print_lag, &answer);
    if (err)
        return err;
    const bool good = !text_of(answer, "result.outcome")[0];
    if (!good)
        log_error("%s", text_of(answer, "result.outcome"));
    json_free(answer);
    return good ? EXIT_DONE : EXIT_FAILED;
}

static int about_camera(const struct arguments *a, const char *what)
{
    struct json *r = request_of(what);
    json_set_string(r, "camera", a->word[1]);
    return ask_and_print(a, r, false, NULL, NULL);
}

static int identify(const struct arguments *a)
{
    return about_camera(a, "identify");
}

static int reinstate(const struct arguments *a)
{
    return about_camera(a, "reinstate");
}

static int cancel(const struct arguments *a)
{
    return ask_and_print(a, request_of("cancel"), false, NULL, NULL);
}

static void print_takes(const struct json *t)
{
    if (!json_length(t, "takes"))
        puts("no takes yet");
    for (int i = 0; i < json_length(t, "takes"); i++) {
        const struct json *e = element(t, "takes", i);
        printf("%-44s %-10s %4.0f/%-4.0f %9.1f MB  %s\n", text_of(e, "id"), text_of(e, "state"), number_of(e, "n_delivered", 0), number_of(e, "n_expected", 0),
               1e-6 * number_of(e, "bytes", 0), text_of(e, "reason"));
    }
}

static int takes(const struct arguments *a)
{
    return ask_and_print(a, request_of("takes"), false, print_takes, NULL);
}

static void print_text(const struct json *m)
{
    fputs(text_of(m, "text"), stdout);
}

static int metrics(const struct arguments *a)
{
    return ask_and_print(a, request_of("metrics"), false, print_text, NULL);
}

// Every event as a line of JSON, until the daemon ends.
static int events(const struct arguments *a)
{
    struct line_reader r = { .fd = connect_to(a->socket_path) };
    if (r.fd < 0)
        return EXIT_FAILED;
    send_request(r.fd, request_of("subscribe"));
    for (struct json *m; (m = next_message(&r));) {
        char *text = json_get(m, "event") ? json_text(m) : NULL;
        if (text)
            puts(text);
        fflush(stdout);
        free(text);
        json_free(m);
    }
    close(r.fd);
    free(r.bytes);
    return EXIT_FAILED;
}

static const struct {
    const char *name, *operand;
    int (*run)(const struct arguments *a);
    const char *what;
} commands[] = {
    { "status", NULL, status, "the rig and each camera; --watch: live" },
    { "doctor", NULL, doctor, "what in this machine will fail before it fails" },
    { "preflight", NULL, preflight, "are all cameras fit for a take?" },
    { "capture", NULL, capture, "make a take; --name, --without-missing, --on-button" },
    { "panorama", NULL, panorama, "shoot the lights as an HDR panorama; --name; or --merge PLAN|TAKE -o FILE: without a daemon" },
    { "continue", NULL, go_on, "what the panorama asked you to do is done" },
    { "cancel", NULL, cancel, "stop a take; after the shot its frames are fetched all the same" },
    { "takes", NULL, takes, "list takes" },
    { "report", "TAKE", report, "one take, camera by camera, and its pages; --open: show the newest" },
    { "process", "TAKE", process, "develop, panorama, solve: what is missing; --again STEP, --cancel, --watch" },
    { "preview", "TAKE", preview, "contact sheet, then the quick solve; before all other work" },
    { "resume", "TAKE", resume, "fetch what a take still misses" },
    { "export", "TAKE", export, "write and check a take's ASC MHL manifest for hand-over" },
    { "calibrate", "lag", calibrate, "measure each body's shutter lag; --shots" },
    { "identify", "CAMERA", identify, "let a camera show itself; board: the trigger board blinks" },
    { "reinstate", "CAMERA", reinstate, "try a quarantined camera again, now" },
    { "metrics", NULL, metrics, "figures as Prometheus text" },
    { "events", NULL, events, "what happens, as JSON lines" },
};
enum { N_COMMANDS = sizeof(commands) / sizeof(commands[0]) };

static const struct argp_option option_list[] = {
    { "socket", 's', "PATH", 0, "rigd's socket (RIGD_SOCKET, else /run/rigd/rigd.sock)", 0 },
    { "json", 'j', NULL, 0, "print the answer as JSON", 0 },
    { "watch", 'w', NULL, 0, "status: live; process: until it is settled", 0 },
    { "again", 'a', "STEP", 0, "process: make it anew: sheet, develop, panorama, reconstruct, preview, focus, standard, final", 0 },
    { "cancel", 'c', NULL, 0, "process: stop", 0 },
    { "open", OPTION_OPEN, NULL, 0, "report: show the newest page", 0 },
    { "name", 'n', "NAME", 0, "capture, panorama: of the take", 0 },
    { "merge", OPTION_MERGE, "PLAN|TAKE", 0, "panorama: make FILE of one that was shot before", 0 },
    { "output", 'o', "FILE", 0, "panorama --merge: the EXR", 0 },
    { "without-missing", 'm', NULL, 0, "capture: leave cameras out that are not fit", 0 },
    { "on-button", OPTION_ON_BUTTON, NULL, 0, "capture: get ready, then let the trigger board fire by itself when its button is pressed; rigctl cancel disarms", 0 },
    { "shots", 'k', "N", 0, "calibrate: at least how many (rigd.conf's)", 0 },
    { 0 },
};

static error_t parse(int key, char *arg, struct argp_state *state)
{
    struct arguments *a = state->input;
    switch (key) {
    case 's':
        a->socket_path = arg;
        return 0;
    case 'j':
        a->json = true;
        return 0;
    case 'w':
        a->watch = true;
        return 0;
    case 'n':
        a->name = arg;
        return 0;
    case 'a':
        a->again = arg;
        return 0;
    case 'c':
        a->cancel = true;
        return 0;
    case OPTION_MERGE:
        a->merge = arg;
        return 0;
    case 'o':
        a->output = arg;
        return 0;
    case OPTION_OPEN:
        a->open = true;
        return 0;
    case 'm':
        a->without_missing = true;
        return 0;
    case OPTION_ON_BUTTON:
        a->on_button = true;
        return 0;
    case 'k':
        a->shots = atoi(arg);
        if (a->shots < 3 || a->shots > 1000)
            argp_error(state, "--shots: found '%s', expected 3 to 1000", arg);
        return 0;
    case ARGP_KEY_ARG:
        if (a->n_words == 0 && !strcmp(arg, "develop"))
            a->without_daemon = rigctl_develop;
        else if (a->n_words == 1 && !strcmp(a->word[0], "calibrate") && !strcmp(arg, "colour"))
            a->without_daemon = rigctl_calibrate_colour;
        if (a->without_daemon) { // options after these are their own
            a->rest = state->argv + state->next - 1;
            a->n_rest = state->argc - state->next + 1;
            state->next = state->argc;
            return 0;
        }
        if (a->n_words == 2)
            argp_error(state, "found '%s', expected nothing more", arg);
        a->word[a->n_words++] = arg;
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static char *help(int key, const char *text, void *input)
{
    (void)input;
    if (key != ARGP_KEY_HELP_POST_DOC)
        return (char *)(uintptr_t)text;
    char *out = NULL;
    size_t n;
    FILE *f = open_memstream(&out, &n);
    if (!f)
        return NULL;
    fputs("Commands:\n", f);
    for (int i = 0; i < N_COMMANDS; i++)
        fprintf(f, "  %-9s %-7s %s\n", commands[i].name, commands[i].operand ? commands[i].operand : "", commands[i].what);
    fputs("Without a daemon (--help after these tells more):\n"
          "  develop   RAW...  raw files become linear EXRs\n"
          "  calibrate colour  one radiometric space for all bodies, from frames of a grey card or chart\n", f);
    fputs("\nExit status: 0 done, 1 failed (a take: not verified), 2 usage.", f);
    fclose(f);
    return out;
}

int main(int argc, char **argv)
{
    static const struct argp argp = { option_list, parse, "COMMAND [TAKE|CAMERA|lag]", "Talks to rigd, the daemon of the rig.\v", NULL, help, NULL };
    struct arguments a = { 0 };
    argp_err_exit_status = EXIT_USAGE;
    argp_program_version = "rigctl (studiorig) " STUDIORIG_VERSION;
    log_set_program("rigctl");
    a.socket_path = getenv("RIGD_SOCKET") ? getenv("RIGD_SOCKET") : "/run/rigd/rigd.sock";
    argp_parse(&argp, argc, argv, ARGP_IN_ORDER, NULL, &a);
    if (a.without_daemon)
        return a.without_daemon(a.n_rest, a.rest, a.json);
    for (int i = 0; a.n_words && i < N_COMMANDS; i++) {
        if (strcmp(commands[i].name, a.word[0]))
            continue;
        if (!commands[i].operand != (a.n_words == 1)) {
            fprintf(stderr, "rigctl %s: found %d operands, expected %s\n", a.word[0], a.n_words - 1, commands[i].operand ? commands[i].operand : "none");
            return EXIT_USAGE;
        }
        return commands[i].run(&a);
    }
    fprintf(stderr, "rigctl: %s%s%s; rigctl --help lists the commands\n", a.n_words ? "unknown command '" : "expected a command", a.n_words ? a.word[0] : "", a.n_words ? "'" : "");
    return EXIT_USAGE;
}
