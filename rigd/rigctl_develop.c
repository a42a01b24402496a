// rigd/rigctl_develop.c - see rigctl_develop.h.
#include "rigd/rigctl_develop.h"
#include "rigd/colour.h"
#include "rigd/develop_options.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"

#include <argp.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum { EXIT_DONE = 0, EXIT_FAILED = 1, EXIT_USAGE = 2, EXIT_DOUBTFUL = 3 };
enum { JOBS_MAX = 256, RAWS_MAX = 100000, PASSED_MAX = 2200, ANSWER_MAX = 1 << 20 };

// ---- one process per frame -----------------------------------------------------------------------------------------------------

struct worker {
    pid_t pid; // 0: none
    int fd, frame;
    char *text;
    size_t n;
};

struct crew {
    char program[4096];
    int n_frames, n_jobs;
    char **(*arguments)(void *arg, int frame); // malloc'd list that ends with NULL; [0] is replaced
    void *arg;
    struct json **answer; // [n_frames] what each said; never NULL afterwards
};

static int find_program(struct crew *c)
{
    const ssize_t n = readlink("/proc/self/exe", c->program, sizeof(c->program) - 16);
    if (n < 0 || n == sizeof(c->program) - 16) {
        const int err = n < 0 ? -errno : -ENAMETOOLONG;
        log_error("develop: cannot tell where rigctl is (/proc/self/exe): %s; rigd-develop belongs beside it", strerror(-err));
        return err;
    }
    c->program[n] = 0;
    char *slash = strrchr(c->program, '/');
    strcpy(slash ? slash + 1 : c->program, "rigd-develop");
    if (access(c->program, X_OK)) {
        const int err = -errno;
        log_error("develop: cannot run %s: %s; it belongs beside rigctl", c->program, strerror(-err));
        return err;
    }
    return 0;
}

static struct json *failure(const char *text)
{
    struct json *o = json_new_object();
    json_set_bool(o, "ok", false);
    json_set_string(o, "error", text);
    return o;
}

static int start(struct crew *c, struct worker *w, int frame)
{
    int fd[2];
    char **argv = c->arguments(c->arg, frame);
    if (!argv)
        return -ENOMEM;
    if (pipe2(fd, O_CLOEXEC)) {
        const int err = -errno;
        free(argv);
        return err;
    }
    argv[0] = c->program;
    const pid_t pid = fork();
    if (pid == 0) {
        if (dup2(fd[1], 1) >= 0)
            execv(c->program, argv);
        _exit(127);
    }
    const int err = pid < 0 ? -errno : 0;
    free(argv);
    close(fd[1]);
    if (err) {
        close(fd[0]);
        return err;
    }
    *w = (struct worker){ .pid = pid, .fd = fd[0], .frame = frame };
    return 0;
}

// It has closed its end: what did it say, how did it end?
static void finish(struct crew *c, struct worker *w)
{
    char text[200];
    int status = 0;
    struct json *answer = NULL;
    close(w->fd);
    while (waitpid(w->pid, &status, 0) < 0 && errno == EINTR)
        ;
    if (WIFSIGNALED(status)) {
        snprintf(text, sizeof(text), "its decoder died: %s", strsignal(WTERMSIG(status)));
        answer = failure(text);
    } else if (!w->n || json_parse(&answer, w->text, w->n, NULL)) {
        snprintf(text, sizeof(text), "its decoder ended with status %d and said nothing", WEXITSTATUS(status));
        answer = failure(text);
    }
    c->answer[w->frame] = answer;
    free(w->text);
    *w = (struct worker){ 0 };
    progress_add(1);
}

static void listen_to(struct crew *c, struct worker *w)
{
    char *grown = w->n + 65536 <= ANSWER_MAX ? realloc(w->text, w->n + 65536) : NULL;
    if (!grown) {
        kill(w->pid, SIGKILL);
        finish(c, w);
        return;
    }
    w->text = grown;
    const ssize_t n = read(w->fd, w->text + w->n, 65536);
    if (n > 0)
        w->n += (size_t)n;
    else if (n == 0 || errno != EINTR)
        finish(c, w);
}

// All frames, n_jobs at once. 0, -ENOMEM, -errno of fork.
static int run_crew(struct crew *c, const char *stage)
{
    struct worker worker[JOBS_MAX] = { 0 };
    struct pollfd at[JOBS_MAX];
    int next = 0, busy = 0;
    int err = 0;
    c->answer = calloc((size_t)c->n_frames, sizeof(c->answer[0]));
    if (!err && !c->answer)
        err = -ENOMEM;
    progress_begin(stage, c->n_frames);
    while (!err && (next < c->n_frames || busy)) {
        int n = 0, of[JOBS_MAX];
        for (int i = 0; i < c->n_jobs && !err && next < c->n_frames; i++)
            if (!worker[i].pid)
                err = start(c, &worker[i], next++);
        for (int i = 0; i < c->n_jobs; i++)
            if (worker[i].pid) {
                of[n] = i;
                at[n++] = (struct pollfd){ .fd = worker[i].fd, .events = POLLIN };
            }
        if (!err && poll(at, (nfds_t)n, -1) < 0 && errno != EINTR)
            err = -errno;
        for (int k = 0; k < n && !err; k++)
            if (at[k].revents)
                listen_to(c, &worker[of[k]]);
        busy = 0;
        for (int i = 0; i < c->n_jobs; i++)
            busy += worker[i].pid != 0;
    }
    for (int i = 0; i < c->n_jobs; i++)
        if (worker[i].pid) {
            kill(worker[i].pid, SIGKILL);
            finish(c, &worker[i]);
        }
    progress_end();
    if (err)
        log_error("develop: %s", strerror(-err));
    return err;
}

static void free_answers(struct crew *c)
{
    for (int i = 0; c->answer && i < c->n_frames; i++)
        json_free(c->answer[i]);
    free(c->answer);
}

static int count_cores(void)
{
    const long n = sysconf(_SC_NPROCESSORS_ONLN);
    return n < 1 ? 1 : n > JOBS_MAX ? JOBS_MAX : (int)n;
}

static const char *text_of(const struct json *v, const char *path)
{
    const char *s = "";
    json_get_string(v, path, &s);
    return s;
}

static double number_of(const struct json *v, const char *path)
{
    double n = 0;
    json_get_number(v, path, &n);
    return n;
}

static bool flag_of(const struct json *v, const char *path)
{
    bool b = false;
    json_get_bool(v, path, &b);
    return b;
}

static int parse_count(struct argp_state *state, const char *option, const char *text, int most)
{
    char *end;
    const long n = strtol(text, &end, 10);
    if (end == text || *end || n < 1 || n > most)
        argp_error(state, "%s: found '%s'; expected 1 to %d", option, text, most);
    return (int)n;
}

static void require_exposure(struct argp_state *state, const char *option, const char *text, bool zero_allowed)
{
    double v[3];
    if (!option_exposure(text, v, zero_allowed))
        argp_error(state, "%s: found '%s'; expected seconds, f-number and ISO such as 1/128,8,100", option, text);
}

static const char *base_name(const char *path)
{
    const char *slash = strrchr(path, '/');
    return slash ? slash + 1 : path;
}

// ---- develop -------------------------------------------------------------------------------------------------------------------

struct develop_arguments {
    char **raw;
    char **out; // [n]
    int n, n_jobs;
    const char *folder, *model;
    char *passed[PASSED_MAX]; // to rigd-develop
    int n_passed;
    bool json, force;
};

enum { OPTION_TIFF = 256, OPTION_HALF, OPTION_BILINEAR, OPTION_AHD, OPTION_FLAT, OPTION_COLOUR, OPTION_REFERENCE, OPTION_EXPOSURE, OPTION_SATURATION, OPTION_JOBS, OPTION_FORCE, OPTION_MODEL, OPTION_PATCH,
       OPTION_CHART, OPTION_PLACES, OPTION_BODY, OPTION_CHECK };

static const struct argp_option develop_options[] = {
    { "output", 'o', "DIR", 0, "Where RAW's picture goes, as DIR/<name of RAW>.exr (made if it is not there)", 0 },
    { "half", OPTION_HALF, NULL, 0, "One pixel per cell of four photosites: for previews", 0 },
    { "bilinear", OPTION_BILINEAR, NULL, 0, "Full size, the mean of the nearest photosites", 0 },
    { "ahd", OPTION_AHD, NULL, 0, "Full size, adaptive homogeneity-directed (default)", 0 },
    { "tiff", OPTION_TIFF, NULL, 0, "Also a 16-bit linear TIFF, camera RGB: the pixels of dcraw -4 -o 0 -r 1 1 1 1 -t 0 -q 0", 0 },
    { "flat", OPTION_FLAT, "FILE", 0, "Divide by this frame of an even white; may be given once per body, lens and aperture: each RAW takes the one that fits", 0 },
    { "colour", OPTION_COLOUR, "FILE", 0, "Gains and scale of each body, as `rigctl calibrate colour' writes them", 0 },
    { "reference-exposure", OPTION_REFERENCE, "T,N,ISO", 0, "Radiance 1 is what brings the green photosites to the white level at this exposure (default 1/128,8,100)", 0 },
    { "exposure", OPTION_EXPOSURE, "T,N,ISO", 0, "What the exposures were, in place of what the files say; 0 leaves a value to them", 0 },
    { "saturation", OPTION_SATURATION, "DN", 0, "Photosites from this value on are clipped (default: the white level)", 0 },
    { "model", OPTION_MODEL, "NAME", 0, "All raws must be of this camera model", 0 },
    { "jobs", OPTION_JOBS, "N", 0, "Frames at once (default: one per core); each takes less memory than two frames of 16-bit RGB", 0 },
    { "force", OPTION_FORCE, NULL, 0, "Also what is there already, made from the same raw in the same way", 0 },
    { "json", 'j', NULL, 0, "Print the result as JSON", 0 },
    { 0 },
};

static void pass(struct argp_state *state, char *passed[PASSED_MAX], int *n_passed, const char *option, char *value)
{
    if (*n_passed + 2 > PASSED_MAX)
        argp_error(state, "%s: too many options", option);
    passed[(*n_passed)++] = (char *)(uintptr_t)option;
    if (value)
        passed[(*n_passed)++] = value;
}

static error_t parse_develop(int key, char *text, struct argp_state *state)
{
    struct develop_arguments *a = state->input;
    double dn;
    switch (key) {
    case 'o':
        a->folder = text;
        return 0;
    case 'j':
        a->json = true;
        return 0;
    case OPTION_TIFF:
        pass(state, a->passed, &a->n_passed, "--tiff", NULL);
        return 0;
    case OPTION_HALF:
        pass(state, a->passed, &a->n_passed, "--half", NULL);
        return 0;
    case OPTION_BILINEAR:
        pass(state, a->passed, &a->n_passed, "--bilinear", NULL);
        return 0;
    case OPTION_AHD:
        pass(state, a->passed, &a->n_passed, "--ahd", NULL);
        return 0;
    case OPTION_FLAT:
        pass(state, a->passed, &a->n_passed, "--flat", text);
        return 0;
    case OPTION_COLOUR:
        pass(state, a->passed, &a->n_passed, "--colour", text);
        return 0;
    case OPTION_REFERENCE:
        require_exposure(state, "--reference-exposure", text, false);
        pass(state, a->passed, &a->n_passed, "--reference-exposure", text);
        return 0;
    case OPTION_EXPOSURE:
        require_exposure(state, "--exposure", text, true);
        pass(state, a->passed, &a->n_passed, "--exposure", text);
        return 0;
    case OPTION_SATURATION:
        if (!option_saturation(text, &dn))
            argp_error(state, "--saturation: found '%s'; expected 1 to 65535", text);
        pass(state, a->passed, &a->n_passed, "--saturation", text);
        return 0;
    case OPTION_MODEL:
        a->model = text;
        return 0;
    case OPTION_JOBS:
        a->n_jobs = parse_count(state, "--jobs", text, JOBS_MAX);
        return 0;
    case OPTION_FORCE:
        a->force = true;
        return 0;
    case ARGP_KEY_ARG:
        if (a->n == RAWS_MAX)
            argp_error(state, "more than %d raws", RAWS_MAX);
        a->raw[a->n++] = text;
        return 0;
    case ARGP_KEY_END:
        if (!a->n || !a->folder)
            argp_error(state, "expected RAW... -o DIR");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static char **develop_command(void *arg, int frame)
{
    const struct develop_arguments *a = arg;
    char **argv = calloc((size_t)a->n_passed + 6, sizeof(argv[0]));
    int n = 1;
    if (!argv)
        return NULL;
    for (int i = 0; i < a->n_passed; i++)
        argv[n++] = a->passed[i];
    if (!a->force)
        argv[n++] = "--if-changed";
    argv[n++] = "--"; // a raw's name may begin with a dash
    argv[n++] = a->raw[frame];
    argv[n] = a->out[frame];
    return argv;
}

static int by_text(const void *a, const void *b)
{
    return strcmp(*(char *const *)a, *(char *const *)b);
}

// DIR/<name>.exr of each; two of one name are an error of the caller.
static int name_outputs(struct develop_arguments *a)
{
    char **sorted = calloc((size_t)a->n, sizeof(*sorted));
    int err = sorted ? 0 : EXIT_FAILED;
    for (int i = 0; i < a->n && !err; i++) {
        const char *name = base_name(a->raw[i]), *dot = strrchr(name, '.');
        if (asprintf(&a->out[i], "%s/%.*s.exr", a->folder, (int)(dot && dot != name ? dot - name : (ptrdiff_t)strlen(name)), name) < 0) {
            a->out[i] = NULL;
            err = EXIT_FAILED;
        }
        sorted[i] = a->out[i];
    }
    if (!err)
        qsort(sorted, (size_t)a->n, sizeof(*sorted), by_text);
    for (int i = 1; i < a->n && !err; i++)
        if (!strcmp(sorted[i - 1], sorted[i])) {
            log_error("develop: two of the raws would become %s; develop them into folders of their own", sorted[i]);
            err = EXIT_USAGE;
        }
    free(sorted);
    return err;
}

// What all bodies of a rig have in common unless something is wrong. Numbers are compared as they are printed.
static void value_text(const struct json *answer, const char *key, char text[80])
{
    double v;
    if (!json_get_number(answer, key, &v))
        snprintf(text, 80, "%.4g", v);
    else
        snprintf(text, 80, "%.79s", text_of(answer, key));
}

static int by_value(const void *a, const void *b)
{
    return strcmp(a, b);
}

static void name_odd_ones(const struct develop_arguments *a, const struct crew *c, const char *key, const char *what, struct json *warnings)
{
    char (*value)[80] = calloc((size_t)a->n, sizeof(*value)), common[80] = "", one[80], line[600] = "", text[800];
    int most = 0, n_ok = 0, n_odd = 0, run = 0;
    size_t n = 0;
    for (int i = 0; value && i < a->n; i++)
        if (flag_of(c->answer[i], "ok"))
            value_text(c->answer[i], key, value[n_ok++]);
    if (value)
        qsort(value, (size_t)n_ok, sizeof(*value), by_value);
    for (int i = 0; i < n_ok; i++) {
        run = i && !strcmp(value[i], value[i - 1]) ? run + 1 : 1;
        if (run > most) {
            most = run;
            strcpy(common, value[i]);
        }
    }
    free(value);
    for (int i = 0; i < a->n && most < n_ok; i++) {
        value_text(c->answer[i], key, one);
        if (!flag_of(c->answer[i], "ok") || !strcmp(one, common))
            continue;
        if (n_odd++ < 8 && n < sizeof(line))
            n += (size_t)snprintf(line + n, sizeof(line) - n, "%s%s has %s", n_odd > 1 ? ", " : "", base_name(a->raw[i]), one[0] ? one : "none");
    }
    if (!n_odd)
        return;
    snprintf(text, sizeof(text), "%s differs: %d of %d have %s, but %s%s", what, most, n_ok, common[0] ? common : "none", line, n_odd > 8 ? ", ..." : "");
    log_warning("develop: %s", text);
    json_append_string(warnings, text);
}

struct develop_sum {
    int n_made, n_skipped, n_failed, n_doubtful;
    double seconds, most_rss_bytes;
};

static void print_frames(const struct develop_arguments *a, const struct crew *c, const struct develop_sum *s)
{
    for (int i = 0; i < a->n; i++) {
        const struct json *o = c->answer[i];
        if (!flag_of(o, "ok"))
            printf("%s: FAILED: %s\n", a->raw[i], text_of(o, "error"));
        else if (flag_of(o, "skipped"))
            printf("%s: there already\n", a->out[i]);
        else
            printf("%s: %.0f x %.0f, %.3f %% clipped, %.1f MB, %.2f s%s\n", a->out[i], number_of(o, "width"), number_of(o, "height"), 100 * number_of(o, "clipped_share"), 1e-6 * number_of(o, "bytes"),
                   number_of(o, "seconds.total"), flag_of(o, "trusted") ? "" : "  NOT TO BE TRUSTED: see its warnings");
    }
    printf("%d developed, %d there already, %d failed in %.1f s", s->n_made, s->n_skipped, s->n_failed, s->seconds);
    if (s->n_made)
        printf(": %.2f frames/s, at most %.0f MB per worker", s->n_made / s->seconds, 1e-6 * s->most_rss_bytes);
    putchar('\n');
}

static void print_json(struct crew *c, const struct develop_sum *s, struct json *warnings)
{
    struct json *o = json_new_object(), *frames = json_new_array();
    for (int i = 0; i < c->n_frames; i++) {
        json_append(frames, c->answer[i]);
        c->answer[i] = NULL;
    }
    json_set_int(o, "n_developed", s->n_made);
    json_set_int(o, "n_skipped", s->n_skipped);
    json_set_int(o, "n_failed", s->n_failed);
    json_set_number(o, "seconds", s->seconds);
    json_set_number(o, "peak_rss_bytes", s->most_rss_bytes);
    json_set(o, "warnings", warnings);
    json_set(o, "frames", frames);
    char *text = json_text(o);
    puts(text ? text : "{}");
    free(text);
    json_free(o);
}

static void require_model(const struct develop_arguments *a, const struct crew *c, struct develop_sum *s, struct json *warnings)
{
    for (int i = 0; i < a->n && a->model; i++)
        if (flag_of(c->answer[i], "ok") && strcmp(text_of(c->answer[i], "model"), a->model)) {
            char text[500];
            snprintf(text, sizeof(text), "%.200s is of a %s %s, expected %s", a->raw[i], text_of(c->answer[i], "make"), text_of(c->answer[i], "model"), a->model);
            log_warning("develop: %s", text);
            json_append_string(warnings, text);
            s->n_doubtful++;
        }
}

static double seconds_since(const struct timespec *began)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)(now.tv_sec - began->tv_sec) + 1e-9 * (double)(now.tv_nsec - began->tv_nsec);
}

static int report_frames(const struct develop_arguments *a, struct crew *c, double seconds)
{
    static const char *const common[][2] = { { "model", "camera model" }, { "lens", "lens" }, { "iso", "ISO" }, { "f_number", "f-number" }, { "time_s", "exposure time" } };
    struct develop_sum s = { .seconds = seconds };
    struct json *warnings = json_new_array();
    for (int i = 0; i < a->n; i++) {
        const struct json *o = c->answer[i];
        const bool ok = flag_of(o, "ok"), skipped = flag_of(o, "skipped");
        s.n_failed += !ok;
        s.n_skipped += ok && skipped;
        s.n_made += ok && !skipped;
        s.n_doubtful += ok && !flag_of(o, "trusted");
        s.most_rss_bytes = fmax(s.most_rss_bytes, number_of(o, "peak_rss_bytes"));
        if (!ok && !json_get(o, "file")) // it died before it could say
            log_error("develop: %s: %s", a->raw[i], text_of(o, "error"));
    }
    for (size_t k = 0; k < sizeof(common) / sizeof(common[0]); k++)
        name_odd_ones(a, c, common[k][0], common[k][1], warnings);
    require_model(a, c, &s, warnings);
    if (a->json) {
        print_json(c, &s, warnings);
    } else {
        print_frames(a, c, &s);
        json_free(warnings);
    }
    return s.n_failed ? EXIT_FAILED : s.n_doubtful ? EXIT_DOUBTFUL : EXIT_DONE;
}

int rigctl_develop(int argc, char **argv, bool json)
{
    static const char doc[] = "Raw files become linear pictures: half-float EXR, R, G and B with the primaries of sRGB, exposure-normalised, fixed white balance, nothing automatic; channel clip "
                              "marks what is saturated. Needs no daemon. What a killed run has finished is not done again.\v"
                              "Exit status: 0 done, 1 at least one failed, 2 usage, 3 done but not to be trusted (the warnings say why).";
    static const struct argp argp = { develop_options, parse_develop, "RAW... -o DIR", doc, NULL, NULL, NULL };
    struct develop_arguments a = { .n_jobs = count_cores(), .json = json };
    struct timespec began;
    int status = EXIT_FAILED;
    char name[] = "rigctl develop";
    argv[0] = name;
    a.raw = calloc((size_t)argc, sizeof(a.raw[0]));
    a.out = calloc((size_t)argc, sizeof(a.out[0]));
    if (!a.raw || !a.out)
        goto done;
    argp_parse(&argp, argc, argv, 0, NULL, &a);
    clock_gettime(CLOCK_MONOTONIC, &began);
    status = name_outputs(&a);
    if (!status && make_directories(a.folder))
        status = EXIT_FAILED;
    if (status)
        goto done;
    struct crew crew = { .n_frames = a.n, .n_jobs = a.n_jobs, .arguments = develop_command, .arg = &a };
    status = find_program(&crew) || run_crew(&crew, "develop") ? EXIT_FAILED : report_frames(&a, &crew, seconds_since(&began));
    free_answers(&crew);
done:
    for (int i = 0; a.out && i < a.n; i++)
        free(a.out[i]);
    free(a.raw);
    free(a.out);
    return status;
}

// ---- calibrate colour ------------------------------------------------------------------------------------------------------------

struct colour_arguments {
    char **raw, **place; // [n]; place: --patch=... or --chart=...
    int n, n_jobs;
    char *everywhere; // for raws that places does not name
    const char *places_path, *out, *reference, *check;
    char *passed[PASSED_MAX]; // to rigd-develop
    int n_passed;
    bool json;
};

static const struct argp_option colour_options[] = {
    { "output", 'o', "FILE", 0, "The calibration to write (colour.json)", 0 },
    { "patch", OPTION_PATCH, "X,Y,W,H", 0, "Where the grey card lies in all frames, in photosites from the upper left of the sensor", 0 },
    { "chart", OPTION_CHART, "X1,Y1,..,X4,Y4", 0, "Where the corners of a ColorChecker lie: dark skin's, bluish green's, black's, white's", 0 },
    { "places", OPTION_PLACES, "FILE", 0, "The same frame by frame: {\"places\": [{\"file\": \"A01.dng\", \"patch\": [X,Y,W,H]}, {\"file\": ..., \"chart\": [X1,...,Y4]}]}", 0 },
    { "reference", OPTION_BODY, "SERIAL", 0, "The body that is right, such as the panorama's (default: the median of all)", 0 },
    { "check", OPTION_CHECK, "FILE", 0, "Write nothing: how well does this calibration bring these frames together?", 0 },
    { "flat", OPTION_FLAT, "FILE", 0, "Divide by this frame of an even white, as rigctl develop will: the card lies elsewhere in each frame", 0 },
    { "exposure", OPTION_EXPOSURE, "T,N,ISO", 0, "What the exposures were, in place of what the files say; 0 leaves a value to them", 0 },
    { "jobs", OPTION_JOBS, "N", 0, "Frames at once (default: one per core)", 0 },
    { "json", 'j', NULL, 0, "Print the result as JSON", 0 },
    { 0 },
};

static void set_everywhere(struct argp_state *state, struct colour_arguments *a, const char *option, const char *text)
{
    free(a->everywhere);
    if (asprintf(&a->everywhere, "%s=%s", option, text) < 0)
        argp_failure(state, EXIT_FAILED, ENOMEM, "%s", option);
}

static error_t parse_colour(int key, char *text, struct argp_state *state)
{
    struct colour_arguments *a = state->input;
    double corner[4][2];
    switch (key) {
    case 'o':
        a->out = text;
        return 0;
    case 'j':
        a->json = true;
        return 0;
    case OPTION_PATCH:
        if (!option_patch(text, corner))
            argp_error(state, "--patch: found '%s'; expected X,Y,W,H", text);
        set_everywhere(state, a, "--patch", text);
        return 0;
    case OPTION_CHART:
        if (!option_chart(text, corner))
            argp_error(state, "--chart: found '%s'; expected the x,y of four corners", text);
        set_everywhere(state, a, "--chart", text);
        return 0;
    case OPTION_PLACES:
        a->places_path = text;
        return 0;
    case OPTION_BODY:
        a->reference = text;
        return 0;
    case OPTION_CHECK:
        a->check = text;
        return 0;
    case OPTION_FLAT:
        pass(state, a->passed, &a->n_passed, "--flat", text);
        return 0;
    case OPTION_EXPOSURE:
        require_exposure(state, "--exposure", text, true);
        pass(state, a->passed, &a->n_passed, "--exposure", text);
        return 0;
    case OPTION_JOBS:
        a->n_jobs = parse_count(state, "--jobs", text, JOBS_MAX);
        return 0;
    case ARGP_KEY_ARG:
        a->raw[a->n++] = text;
        return 0;
    case ARGP_KEY_END:
        if (!a->n || !a->out == !a->check || (!a->everywhere && !a->places_path))
            argp_error(state, "expected RAW... (one or more per body), --patch, --chart or --places, and -o FILE or --check FILE");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static char *place_text(const struct json *v)
{
    char text[400];
    double n[8];
    char *out = NULL;
    if (!json_get_numbers(v, "patch", n, 4))
        snprintf(text, sizeof(text), "--patch=%.9g,%.9g,%.9g,%.9g", n[0], n[1], n[2], n[3]);
    else if (!json_get_numbers(v, "chart", n, 8))
        snprintf(text, sizeof(text), "--chart=%.9g,%.9g,%.9g,%.9g,%.9g,%.9g,%.9g,%.9g", n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7]);
    else
        return NULL;
    out = strdup(text);
    return out;
}

// A place for a frame that is not here may be of a rig of which only some bodies are measured; but where others take the place that is for
// all, it is more likely a name with an error in it, whose frame would be measured elsewhere.
static int find_places(struct colour_arguments *a)
{
    struct json *doc = NULL;
    char strangers[200] = "";
    int n_strangers = 0, n_given = 0;
    int err = a->places_path ? json_read(&doc, a->places_path) : 0;
    const int n = doc ? json_length(doc, "places") : 0;
    if (!err && n < 0) {
        log_error("calibrate: %s: expected \"places\": a list", a->places_path);
        err = -EINVAL;
    }
    for (int k = 0; k < n && !err; k++) {
        char path[40];
        snprintf(path, sizeof(path), "places.%d", k);
        const struct json *v = json_get(doc, path);
        char *text = place_text(v);
        if (!text || !text_of(v, "file")[0]) {
            log_error("calibrate: %s: %s: expected file, and patch (4 numbers) or chart (8)", a->places_path, path);
            err = -EINVAL;
        }
        int n_meant = 0;
        for (int i = 0; i < a->n && !err; i++)
            if (!strcmp(text_of(v, "file"), a->raw[i]) || !strcmp(text_of(v, "file"), base_name(a->raw[i]))) {
                free(a->place[i]);
                a->place[i] = strdup(text);
                n_meant++;
            }
        if (!err && !n_meant) {
            const size_t used = strlen(strangers);
            if (n_strangers++ < 4)
                snprintf(strangers + used, sizeof(strangers) - used, "%s%s", used ? ", " : "", text_of(v, "file"));
        }
        free(text);
    }
    for (int i = 0; i < a->n && !err; i++)
        n_given += a->place[i] != NULL;
    if (!err && n_strangers && n_given < a->n && a->everywhere) {
        log_error("calibrate: %s: %d of %d places are for no frame that was given (%s%s), while %d frames would take %s: mend the names, or take them out", a->places_path, n_strangers, n, strangers,
                  n_strangers > 4 ? ", ..." : "", a->n - n_given, a->everywhere);
        err = -EINVAL;
    } else if (!err && n_strangers) {
        log_warning("calibrate: %s: %d of %d places are for no frame that was given: %s%s", a->places_path, n_strangers, n, strangers, n_strangers > 4 ? ", ..." : "");
    }
    for (int i = 0; i < a->n && !err; i++) {
        if (!a->place[i] && a->everywhere)
            a->place[i] = strdup(a->everywhere);
        if (!a->place[i]) {
            log_error("calibrate: %s: no place is given for it", a->raw[i]);
            err = -EINVAL;
        }
    }
    json_free(doc);
    return err;
}

static char **measure_command(void *arg, int frame)
{
    const struct colour_arguments *a = arg;
    char **argv = calloc((size_t)a->n_passed + 5, sizeof(argv[0]));
    int n = 1;
    if (!argv)
        return NULL;
    argv[n++] = a->place[frame];
    for (int i = 0; i < a->n_passed; i++)
        argv[n++] = a->passed[i];
    argv[n++] = "--";
    argv[n] = a->raw[frame];
    return argv;
}

static bool frame_of(struct colour_frame *f, const struct json *o, const char *file)
{
    const int n = json_length(o, "cells");
    *f = (struct colour_frame){ .n_cells = n };
    snprintf(f->file, sizeof(f->file), "%s", file);
    snprintf(f->serial, sizeof(f->serial), "%s", text_of(o, "serial"));
    snprintf(f->model, sizeof(f->model), "%s", text_of(o, "model"));
    bool ok = n > 0 && n <= COLOUR_CELLS_MAX && !json_get_numbers(o, "srgb_from_camera", f->srgb_from_camera[0], 9);
    for (int k = 0; k < n && ok; k++) {
        char path[40];
        snprintf(path, sizeof(path), "cells.%d", k);
        const struct json *v = json_get(o, path);
        ok = !json_get_numbers(v, "mean", f->cell[k].mean, 3) && !json_get_numbers(v, "raw", f->cell[k].raw, 3) && !json_get_int(v, "saturated", &f->cell[k].n_saturated);
    }
    return ok;
}

// Every frame must be sound: a calibration of half a rig is none. All that are not are named.
static struct colour_frame *take_frames(const struct colour_arguments *a, const struct crew *c)
{
    struct colour_frame *frame = calloc((size_t)a->n, sizeof(*frame));
    int n_bad = 0;
    for (int i = 0; frame && i < a->n; i++) {
        char why[300] = "";
        const bool ok = flag_of(c->answer[i], "ok");
        if (ok && !frame_of(&frame[i], c->answer[i], a->raw[i]))
            snprintf(why, sizeof(why), "rigd-develop's answer is of another version");
        else if (ok)
            colour_require_sound(&frame[i], why, sizeof(why));
        if (why[0])
            log_error("calibrate: %s (body %s): %s", a->raw[i], text_of(c->answer[i], "serial"), why);
        else if (!ok && !json_get(c->answer[i], "file"))
            log_error("calibrate: %s: %s", a->raw[i], text_of(c->answer[i], "error"));
        n_bad += !ok || why[0];
    }
    if (!n_bad)
        return frame;
    log_error("calibrate: %d of %d frames cannot be used; nothing is written", n_bad, a->n);
    free(frame);
    return NULL;
}

static struct json *fit_as_json(const struct colour_fit *fit, const struct colour_arguments *a, int n_cells)
{
    struct json *o = json_new_object(), *bodies = json_new_array(), *check = json_new_object();
    json_set_int(o, "version", 1);
    json_set_string(o, "target", n_cells == CHART_COLUMNS * CHART_ROWS ? "ColorChecker" : "grey card");
    json_set_string(o, "reference", a->reference ? a->reference : "median");
    for (int b = 0; b < fit->colour.n; b++) {
        const struct body_colour *body = &fit->colour.body[b];
        struct json *v = json_new_object();
        json_set_string(v, "serial", body->serial);
        json_set_string(v, "model", body->model);
        json_set_numbers(v, "gain", body->gain, 3);
        json_set_number(v, "scale", body->scale);
        json_append(bodies, v);
    }
    json_set(o, "bodies", bodies);
    json_set_number(check, "grey_spread", fit->grey_spread);
    json_set_string(check, "furthest", fit->spread_serial);
    json_set_number(check, "chart_rms", fit->chart_rms);
    json_set_number(check, "chart_rms_worst", fit->worst_rms);
    json_set_string(check, "chart_worst", fit->worst_serial);
    json_set(o, "check", check);
    return o;
}

// RIG.md's bounds: greys within 1 %, patches within 3 % RMS of white.
static bool judge_fit(const struct colour_fit *fit)
{
    const double most_spread = .01, most_rms = .03;
    bool good = true;
    if (!(fit->grey_spread <= most_spread)) {
        log_warning("calibrate: greys lie %.2f %% apart, more than %g %%: body %s is furthest off; is its aperture steady, its card lit like the others'?", 100 * fit->grey_spread, 100 * most_spread,
                    fit->spread_serial);
        good = false;
    }
    if (fit->chart_rms > most_rms) {
        log_warning("calibrate: patches lie %.2f %% (RMS, of white) off their published colours, more than %g %%: body %s is the worst with %.2f %%", 100 * fit->chart_rms, 100 * most_rms, fit->worst_serial,
                    100 * fit->worst_rms);
        good = false;
    }
    return good;
}

static void print_fit(const struct colour_fit *fit)
{
    for (int b = 0; b < fit->colour.n; b++) {
        const struct body_colour *body = &fit->colour.body[b];
        printf("%-16s %-20s gain %.4f %.4f %.4f scale %.4f\n", body->serial, body->model, body->gain[0], body->gain[1], body->gain[2], body->scale);
    }
    printf("grey spread %.3f %% (body %s furthest)\n", 100 * fit->grey_spread, fit->spread_serial);
    if (isfinite(fit->chart_rms))
        printf("chart %.2f %% RMS of white off its published colours (body %s worst: %.2f %%)\n", 100 * fit->chart_rms, fit->worst_serial, 100 * fit->worst_rms);
}

static int fit_frames(const struct colour_arguments *a, const struct crew *c)
{
    char why[300] = "";
    struct colour fixed = { 0 };
    struct colour_fit fit = { 0 };
    struct colour_frame *frame = take_frames(a, c);
    int err = frame ? 0 : -EINVAL, status = EXIT_FAILED;
    if (!err && a->check)
        err = colour_read(&fixed, a->check);
    if (!err) {
        err = colour_fit(&fit, frame, a->n, a->reference, a->check ? &fixed : NULL, why, sizeof(why));
        if (err)
            log_error("calibrate: %s", why);
    }
    if (!err) {
        struct json *o = fit_as_json(&fit, a, frame[0].n_cells);
        err = a->check ? 0 : json_write(o, a->out);
        char *text = a->json && !err ? json_text(o) : NULL;
        if (text)
            puts(text);
        else if (!err)
            print_fit(&fit);
        free(text);
        json_free(o);
        status = err ? EXIT_FAILED : judge_fit(&fit) ? EXIT_DONE : EXIT_DOUBTFUL;
    }
    colour_free(&fit.colour);
    colour_free(&fixed);
    free(frame);
    return status;
}

int rigctl_calibrate_colour(int argc, char **argv, bool json)
{
    static const char doc[] = "One radiometric space: frames of one grey card or ColorChecker, one or more per body and of the panorama's camera, give three gains and a scale per body, so that all agree "
                              "with their median. rigctl develop --colour applies them. Needs no daemon.\v"
                              "Exit status: 0 done, 1 failed (clipped, dark or shadowed cards are named), 2 usage, 3 done but greys lie more than 1 % apart or patches more than 3 % off.";
    static const struct argp argp = { colour_options, parse_colour, "RAW... -o FILE", doc, NULL, NULL, NULL };
    struct colour_arguments a = { .n_jobs = count_cores(), .json = json };
    int status = EXIT_FAILED;
    char name[] = "rigctl calibrate colour";
    argv[0] = name;
    a.raw = calloc((size_t)argc, sizeof(a.raw[0]));
    a.place = calloc((size_t)argc, sizeof(a.place[0]));
    if (!a.raw || !a.place)
        goto done;
    argp_parse(&argp, argc, argv, 0, NULL, &a);
    if (find_places(&a))
        goto done;
    struct crew crew = { .n_frames = a.n, .n_jobs = a.n_jobs, .arguments = measure_command, .arg = &a };
    if (!find_program(&crew) && !run_crew(&crew, "measure"))
        status = fit_frames(&a, &crew);
    free_answers(&crew);
done:
    for (int i = 0; a.place && i < a.n; i++)
        free(a.place[i]);
    free(a.everywhere);
    free(a.raw);
    free(a.place);
    return status;
}
