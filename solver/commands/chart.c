// solver/commands/chart.c - rigsolve chart: what speed costs in accuracy, on synthetic studios or on your own takes.
//
// Not every combination: from one base setting (joint, 256 lights, texture 32, the fastest kernel) one thing at a time is changed, and
// the presets are put beside. Each solve is a process of its own, so that CPU seconds and peak memory are its own. The judge is
// not the solver's own figure alone, which is taken at texel centres and so cannot see what a coarse texture loses: views that were
// held out are rendered again and compared with their photographs.
#include "solver/commands/arguments.h"
#include "solver/commands/chart_draw.h"
#include "solver/commands/commands.h"
#include "solver/commands/inputs.h"
#include "solver/commands/output.h"
#include "solver/commands/presets.h"
#include "solver/commands/solved.h"
#include "solver/csv.h"
#include "solver/kernels/kernels.h"
#include "solver/parallel.h"
#include "solver/picture_size.h"
#include "solver/render.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"

#include <argp.h>
#include <errno.h>
#include <fcntl.h>
#include <ftw.h>
#include <inttypes.h>
#include <math.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

extern char **environ;

enum { MAX_SETS = 12, MAX_VALUES = 16, MAX_POINTS = 5 * MAX_VALUES, MAX_ROWS = 100000, JUDGED_VIEWS = 3, JUDGED_WIDTH_PX = 480, WHOLE_PATH = 4096 };
static const char *const methods[] = { "joint", "alternating", "directional" }, *const kernel_names[] = { "reference", "portable", "avx2", "avx512" };

// ---- the command line ------------------------------------------------------------------------------------------------------

struct arguments {
    const char *out, *sets[MAX_SETS], *hold_out;
    int n_sets;
    int lights[MAX_VALUES], n_lights, textures[MAX_VALUES], n_textures, n_methods, n_kernels, n_presets; // values of each axis
    const char *methods[MAX_VALUES], *kernels[MAX_VALUES], *presets[MAX_VALUES];
    int base_lights, base_texture, n_views, width_px, height_px, n_threads, preset_scale;
    bool has_lights, has_textures, has_methods, has_kernels, has_presets, keep, no_solve, json;
    uint64_t seed;
};

enum {
    KEY_LIGHTS = 256, KEY_TEXTURE, KEY_METHODS, KEY_KERNELS, KEY_PRESETS, KEY_BASE_LIGHTS, KEY_BASE_TEXTURE, KEY_PRESET_SCALE, KEY_HOLD_OUT, KEY_SIZE, KEY_VIEWS, KEY_SEED,
    KEY_THREADS, KEY_KEEP, KEY_NO_SOLVE, KEY_JSON,
};

static const struct argp_option options[] = {
    { "output", 'o', "DIR", 0, "chart.csv, chart.svg, chart.png, chart.gp; what is in its chart.csv is not solved again (required)", 0 },
    { 0, 0, 0, 0, "What is varied, each from the base alone; values with commas, or none", 1 },
    { "lights", KEY_LIGHTS, "N,...", 0, "numbers of lights, powers of two (64,256,1024)", 1 },
    { "texture", KEY_TEXTURE, "N,...", 0, "texture sizes (16,32,64,128)", 1 },
    { "methods", KEY_METHODS, "NAME,...", 0, "the first is the base's (joint,alternating,directional)", 1 },
    { "kernels", KEY_KERNELS, "NAME,...", 0, "reference, portable, avx2, avx512 (all that this CPU has, but for the reference)", 1 },
    { "presets", KEY_PRESETS, "NAME,...", 0, "preview, standard, final (preview,standard)", 1 },
    { "base-lights", KEY_BASE_LIGHTS, "N", 0, "lights of the base (256)", 1 },
    { "base-texture", KEY_BASE_TEXTURE, "N", 0, "texture of the base (32)", 1 },
    { "preset-scale", KEY_PRESET_SCALE, "K", 0, "presets with 1/K of their texture (1; of views less than 1600 pixels wide 2, less than 800: 4)", 1 },
    { 0, 0, 0, 0, "How it is judged", 2 },
    { "hold-out", KEY_HOLD_OUT, "every:K|list:FILE", 0, "views that are never fitted (the take's unseen.txt where it has one, else every:6)", 2 },
    { "size", KEY_SIZE, "WxH", 0, "pixels of a synthetic studio's views (120x80)", 2 },
    { "views", KEY_VIEWS, "N", 0, "views of a synthetic studio (40)", 2 },
    { "seed", KEY_SEED, "N", 0, "of synthetic studios and solves (1)", 2 },
    { "threads", KEY_THREADS, "N", 0, "default: all cores; CPU seconds hardly depend on it", 2 },
    { 0, 0, 0, 0, "Output", 3 },
    { "keep", KEY_KEEP, 0, 0, "leave every solve's folder in DIR/solves", 3 },
    { "no-solve", KEY_NO_SOLVE, 0, 0, "draw what of it is in chart.csv already", 3 },
    { "json", KEY_JSON, 0, 0, "print the rows as JSON", 3 },
    { 0 },
};

static const char doc[] =
    "Speed against accuracy: which setting pays, on your own takes or on synthetic studios.\v"
    "TAKE is a folder as for `rigsolve solve`, or D3, D4 or D5 for a synthetic studio that is made here; without any: D3 D5, which takes about "
    "15 CPU minutes. Around one base setting one thing at a time is changed; the presets stand beside. Each solve is a process of its "
    "own and becomes one row of chart.csv: settings, CPU and wall seconds, peak memory, and three errors, RMSE in percent of white: "
    "of samples fitted, of samples of views held out (both at texel centres), and of pictures: up to three held-out views rendered again and compared with the "
    "photographs inside the object's outline. The last two are drawn over CPU seconds. A solve that fails is a row, too; take the row out of chart.csv to have it solved again. "
    "A chart that was interrupted goes on where it was; it shows the rows that were asked for, chart.csv keeps all. "
    "The pictures are drawn by gnuplot; without it there are chart.csv and chart.gp, and a warning.\n\n"
    "Exit status: 0 done, with solves that failed or are not to be trusted marked as such; 1 failed, 2 usage.";

// ---- lists

// The next word of a list with commas, or NULL at its end; an empty one is a usage error.
static char *next_value(const struct argp_state *state, const char *option, char **rest)
{
    char *word = strsep(rest, ",");
    if (word && !*word)
        argp_error(state, "%s: an empty value: expected values with commas between, or none", option);
    return word;
}

static void check_room(const struct argp_state *state, const char *option, int n)
{
    if (n >= MAX_VALUES)
        argp_error(state, "%s: more than %d values", option, MAX_VALUES);
}

static void parse_integers(const struct argp_state *state, const char *option, char *text, bool power_of_two, int most, int *out, int *n)
{
    *n = 0;
    if (!strcmp(text, "none"))
        return;
    for (char *word; (word = next_value(state, option, &text));) {
        const int value = power_of_two ? argument_power_of_two(state, option, word, most) : (int)argument_integer(state, option, word, 4, most);
        bool twice = false;
        for (int i = 0; i < *n; i++)
            twice = twice || out[i] == value;
        check_room(state, option, *n);
        if (!twice)
            out[(*n)++] = value;
    }
}

static void parse_names(const struct argp_state *state, const char *option, char *text, const char *const *names, int n_names, const char **out, int *n)
{
    *n = 0;
    if (!strcmp(text, "none"))
        return;
    for (char *word; (word = next_value(state, option, &text));) {
        const char *value = names[argument_choice(state, option, word, names, n_names)];
        bool twice = false;
        for (int i = 0; i < *n; i++)
            twice = twice || out[i] == value;
        check_room(state, option, *n);
        if (!twice)
            out[(*n)++] = value;
    }
}

static error_t parse(int key, char *text, struct argp_state *state)
{
    struct arguments *a = state->input;
    switch (key) {
    case 'o':
        a->out = text;
        return 0;
    case KEY_LIGHTS:
        parse_integers(state, "--lights", text, true, 1024, a->lights, &a->n_lights);
        a->has_lights = true;
        return 0;
    case KEY_TEXTURE:
        parse_integers(state, "--texture", text, false, 4096, a->textures, &a->n_textures);
        a->has_textures = true;
        return 0;
    case KEY_METHODS:
        parse_names(state, "--methods", text, methods, 3, a->methods, &a->n_methods);
        a->has_methods = true;
        return 0;
    case KEY_KERNELS:
        parse_names(state, "--kernels", text, kernel_names, 4, a->kernels, &a->n_kernels);
        for (int i = 0; i < a->n_kernels; i++)
            if (!kernels_by_name(a->kernels[i]))
                argp_error(state, "--kernels '%s': this CPU or this build lacks it", a->kernels[i]);
        a->has_kernels = true;
        return 0;
    case KEY_PRESETS:
        parse_names(state, "--presets", text, preset_names, N_PRESETS, a->presets, &a->n_presets);
        a->has_presets = true;
        return 0;
    case KEY_BASE_LIGHTS:
        a->base_lights = argument_power_of_two(state, "--base-lights", text, 1024);
        return 0;
    case KEY_BASE_TEXTURE:
        a->base_texture = (int)argument_integer(state, "--base-texture", text, 4, 4096);
        return 0;
    case KEY_PRESET_SCALE:
        a->preset_scale = argument_power_of_two(state, "--preset-scale", text, 32);
        return 0;
    case KEY_HOLD_OUT:
        if (strncmp(text, "every:", 6) && strncmp(text, "list:", 5))
            argp_error(state, "--hold-out '%s': expected every:K or list:FILE", text);
        if (!strncmp(text, "every:", 6))
            argument_integer(state, "--hold-out every:", text + 6, 2, 1000);
        a->hold_out = text;
        return 0;
    case KEY_SIZE:
        argument_size(state, "--size", text, 16, 8192, &a->width_px, &a->height_px);
        return 0;
    case KEY_VIEWS:
        a->n_views = (int)argument_integer(state, "--views", text, 3, 999);
        return 0;
    case KEY_SEED:
        a->seed = (uint64_t)argument_integer(state, "--seed", text, 0, INT32_MAX);
        return 0;
    case KEY_THREADS:
        a->n_threads = (int)argument_integer(state, "--threads", text, 1, 256);
        return 0;
    case KEY_KEEP:
        a->keep = true;
        return 0;
    case KEY_NO_SOLVE:
        a->no_solve = true;
        return 0;
    case KEY_JSON:
        a->json = true;
        return 0;
    case ARGP_KEY_ARG:
        if (a->n_sets == MAX_SETS)
            argp_error(state, "'%s': more than %d takes", text, MAX_SETS);
        a->sets[a->n_sets++] = text;
        return 0;
    case ARGP_KEY_END:
        if (!a->out)
            argp_error(state, "no -o DIR: where shall the chart go?");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static void put_defaults(struct arguments *a)
{
    static const int lights[] = { 64, 256, 1024 }, textures[] = { 16, 32, 64, 128 };
    for (int i = 0; !a->has_lights && i < 3; i++)
        a->lights[a->n_lights++] = lights[i];
    for (int i = 0; !a->has_textures && i < 4; i++)
        a->textures[a->n_textures++] = textures[i];
    for (int i = 0; !a->has_methods && i < 3; i++)
        a->methods[a->n_methods++] = methods[i];
    for (int i = 1; !a->has_kernels && i < 4; i++)
        if (kernels_by_name(kernel_names[i]))
            a->kernels[a->n_kernels++] = kernel_names[i];
    for (int i = 0; !a->has_presets && i < 2; i++)
        a->presets[a->n_presets++] = preset_names[i];
    if (!a->n_sets) {
        a->sets[a->n_sets++] = "D3";
        a->sets[a->n_sets++] = "D5";
    }
}

// ---- sets ------------------------------------------------------------------------------------------------------------------

struct set {
    char name[CHART_NAME_MAX], hold_out_name[CHART_NAME_MAX];
    char *take, *hold_out;
    int n_views, width_px, height_px;
};

static bool is_synthetic(const char *name)
{
    return !strcmp(name, "D3") || !strcmp(name, "D4") || !strcmp(name, "D5");
}

// What may stand in a CSV field, a file name and the drawing.
static void plain_name(char out[CHART_NAME_MAX], const char *text, size_t n)
{
    size_t i = 0;
    for (; i < n && i + 1 < CHART_NAME_MAX; i++)
        out[i] = (text[i] >= 'a' && text[i] <= 'z') || (text[i] >= 'A' && text[i] <= 'Z') || (text[i] >= '0' && text[i] <= '9') || strchr("-.:", text[i]) ? text[i] : '_';
    out[i] = 0;
}

// Starts this program again with argv (argv[0] included) and waits for it: its output goes to log_path. kernel NULL: none chosen. Sets its exit
// status (128 + signal) and what it used. 0 or -errno, logged.
static int run_self(int *status, struct rusage *use, const char *const *argv, const char *kernel, const char *log_path)
{
    posix_spawn_file_actions_t actions;
    pid_t child;
    char setting[64];
    int n = 0, n_kept = 0, state = 0;
    while (environ[n])
        n++;
    char **environment = calloc((size_t)n + 2, sizeof(*environment));
    if (!environment)
        return -ENOMEM;
    // The kernel is this run's choice; how far a child is says nothing about the whole.
    for (int i = 0; i < n; i++)
        if ((!kernel || strncmp(environ[i], "RIGSOLVE_KERNEL=", 16)) && strncmp(environ[i], "STUDIORIG_PROGRESS_FD=", 22))
            environment[n_kept++] = environ[i];
    if (kernel) {
        snprintf(setting, sizeof(setting), "RIGSOLVE_KERNEL=%s", kernel);
        environment[n_kept++] = setting;
    }
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_addopen(&actions, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
    posix_spawn_file_actions_addopen(&actions, STDOUT_FILENO, log_path, O_WRONLY | O_CREAT | O_TRUNC, 0666);
    posix_spawn_file_actions_adddup2(&actions, STDOUT_FILENO, STDERR_FILENO);
    const int err = posix_spawn(&child, "/proc/self/exe", &actions, NULL, (char *const *)argv, environment);
    posix_spawn_file_actions_destroy(&actions);
    free(environment);
    if (err) {
        log_error("chart: cannot start %s (its output goes to %s): %s", argv[1], log_path, strerror(err));
        return -err;
    }
    for (pid_t ended = 0; ended != child;) {
        ended = wait4(child, &state, WNOHANG, use);
        if (ended < 0 && errno != EINTR)
            return -errno;
        if (!ended) {
            nanosleep(&(struct timespec){ 0, 20000000 }, NULL);
            progress_add(0); // a sign of life
        }
    }
    *status = WIFEXITED(state) ? WEXITSTATUS(state) : 128 + WTERMSIG(state);
    return 0;
}

// What a program that failed gave as the cause: its last "error: ", else its last line.
static void read_cause(char out[CHART_REASON_MAX], const char *path)
{
    char *text, *save = NULL, *cause = NULL, *last = NULL;
    size_t n;
    snprintf(out, CHART_REASON_MAX, "no message");
    if (file_read(&text, &n, path, 1 << 26))
        return;
    for (char *line = strtok_r(text, "\r\n", &save); line; line = strtok_r(NULL, "\r\n", &save)) {
        last = line;
        if (strstr(line, "error: "))
            cause = strstr(line, "error: ") + strlen("error: ");
    }
    if (cause || last)
        snprintf(out, CHART_REASON_MAX, "%s", cause ? cause : last);
    free(text);
}

static void plain_text(char *text)
{
    for (; *text; text++)
        if (*text == ',' || *text == '"' || *text == '\'' || (unsigned char)*text < ' ')
            *text = ' ';
}

static int make_synthetic(struct set *s, const struct arguments *a)
{
    char size[32], views[16], seed[16], threads[16], *log_path = NULL, reason[CHART_REASON_MAX];
    int status;
    struct rusage use;
    if (asprintf(&s->take, "%s/takes/%s-%dx%d-%d-%" PRIu64, a->out, s->name, a->width_px, a->height_px, a->n_views, a->seed) < 0) {
        s->take = NULL;
        return -ENOMEM;
    }
    if (!access(s->take, F_OK))
        return 0;
    if (asprintf(&log_path, "%s.log", s->take) < 0)
        return -ENOMEM;
    snprintf(size, sizeof(size), "%dx%d", a->width_px, a->height_px);
    snprintf(views, sizeof(views), "%d", a->n_views);
    snprintf(seed, sizeof(seed), "%" PRIu64, a->seed);
    snprintf(threads, sizeof(threads), "%d", a->n_threads);
    const char *const argv[] = { "rigsolve", "synth", s->name, "-o", s->take, "--size", size, "--views", views, "--seed", seed, "--threads", threads,
                                 "--true-lights", "4096", "--texture", "256", "--panorama-width", "1024", NULL };
    log_info("chart: %s: %d views of %s pixels are made", s->name, a->n_views, size);
    int err = run_self(&status, &use, argv, NULL, log_path);
    if (!err && status != EXIT_DONE) {
        read_cause(reason, log_path);
        log_error("chart: %s: cannot be made: %s", s->name, reason);
        err = -EIO;
    }
    free(log_path);
    return err;
}

static int prepare_set(struct set *s, const char *asked, const struct arguments *a)
{
    struct take *take;
    const char *end = asked + strlen(asked);
    while (end > asked + 1 && end[-1] == '/')
        end--;
    const char *begin = end;
    while (begin > asked && begin[-1] != '/')
        begin--;
    plain_name(s->name, begin, (size_t)(end - begin));
    int err = is_synthetic(asked) ? make_synthetic(s, a) : 0;
    if (!err && !is_synthetic(asked))
        s->take = strdup(asked), err = s->take ? 0 : -ENOMEM;
    if (!err)
        err = take_open(&take, s->take);
    if (err)
        return err;
    err = take_require(take, TAKE_MESH | TAKE_CAMERAS | TAKE_PANORAMA | TAKE_VIEWS);
    s->n_views = take->n_views;
    if (!err && take->n_views > 0 && picture_size(&s->width_px, &s->height_px, take->view_paths[0])) {
        log_error("chart: %s: is no picture that can be read", take->view_paths[0]);
        err = -EINVAL;
    }
    take_close(take);
    char *unseen = NULL;
    if (!err && asprintf(&unseen, "list:%s/unseen.txt", s->take) < 0)
        return -ENOMEM;
    if (!err) {
        const bool has_unseen = !access(unseen + 5, R_OK);
        s->hold_out = strdup(a->hold_out ? a->hold_out : has_unseen ? unseen : "every:6");
        if (!s->hold_out)
            err = -ENOMEM;
        else if (!strncmp(s->hold_out, "list:", 5))
            plain_name(s->hold_out_name, a->hold_out ? a->hold_out : "list:unseen.txt", strlen(a->hold_out ? a->hold_out : "list:unseen.txt"));
        else
            plain_name(s->hold_out_name, s->hold_out, strlen(s->hold_out));
    }
    free(unseen);
    return err;
}

// ---- rows ------------------------------------------------------------------------------------------------------------------

struct table {
    struct chart_row *row;
    int n, capacity;
};

static int add_row(struct table *t, const struct chart_row *row)
{
    if (t->n == t->capacity) {
        const int capacity = t->capacity ? 2 * t->capacity : 64;
        struct chart_row *larger = reallocarray(t->row, (size_t)capacity, sizeof(*larger));
        if (!larger)
            return -ENOMEM;
        t->row = larger, t->capacity = capacity;
    }
    t->row[t->n++] = *row;
    return 0;
}

// The same solve, whatever it is called.
static bool same_solve(const struct chart_row *a, const struct chart_row *b)
{
    return !strcmp(a->set, b->set) && !strcmp(a->hold_out, b->hold_out) && a->seed == b->seed && a->n_views == b->n_views && a->width_px == b->width_px &&
           a->height_px == b->height_px && !strcmp(a->method, b->method) && !strcmp(a->kernel, b->kernel) && a->stage == b->stage &&
           a->n_lights == b->n_lights && a->texture == b->texture;
}

// Columns of chart.csv: names, numbers, figures; the order is the file's.
#define OFFSET(member) offsetof(struct chart_row, member)
static const struct column {
    const char *name;
    enum { TEXT, WHOLE, FIGURE, YES } kind;
    size_t offset, size;
} columns[] = {
    { "set", TEXT, OFFSET(set), CHART_NAME_MAX },
    { "axis", TEXT, OFFSET(axis), CHART_NAME_MAX },
    { "method", TEXT, OFFSET(method), CHART_NAME_MAX },
    { "preset", TEXT, OFFSET(preset), CHART_NAME_MAX },
    { "kernel", TEXT, OFFSET(kernel), CHART_NAME_MAX },
    { "stage", WHOLE, OFFSET(stage), 0 },
    { "n_lights", WHOLE, OFFSET(n_lights), 0 },
    { "texture", WHOLE, OFFSET(texture), 0 },
    { "seed", WHOLE, OFFSET(seed), 0 },
    { "threads", WHOLE, OFFSET(threads), 0 },
    { "n_views", WHOLE, OFFSET(n_views), 0 },
    { "hold_out", TEXT, OFFSET(hold_out), CHART_NAME_MAX },
    { "n_held_out", WHOLE, OFFSET(n_held_out), 0 },
    { "width_px", WHOLE, OFFSET(width_px), 0 },
    { "height_px", WHOLE, OFFSET(height_px), 0 },
    { "n_observations", WHOLE, OFFSET(n_observations), 0 },
    { "wall_s", FIGURE, OFFSET(wall_s), 0 },
    { "cpu_s", FIGURE, OFFSET(cpu_s), 0 },
    { "peak_rss_bytes", WHOLE, OFFSET(peak_rss_bytes), 0 },
    { "rmse_fit_percent", FIGURE, OFFSET(rmse_fit_percent), 0 },
    { "rmse_held_out_percent", FIGURE, OFFSET(rmse_held_out_percent), 0 },
    { "rmse_pictures_percent", FIGURE, OFFSET(rmse_pictures_percent), 0 },
    { "solved", YES, OFFSET(solved), 0 },
    { "trusted", YES, OFFSET(trusted), 0 },
    { "stop_reason", TEXT, OFFSET(stop_reason), CHART_REASON_MAX },
};
enum { N_COLUMNS = sizeof(columns) / sizeof(columns[0]) };

static int write_table(const struct table *t, const char *path)
{
    struct atomic_file f;
    const int err = atomic_file_open(&f, path);
    if (err)
        return err;
    for (int k = 0; k < N_COLUMNS; k++)
        fprintf(f.stream, "%s%s", columns[k].name, k + 1 < N_COLUMNS ? "," : "\n");
    for (int i = 0; i < t->n; i++)
        for (int k = 0; k < N_COLUMNS; k++) {
            const char *at = (const char *)&t->row[i] + columns[k].offset;
            switch (columns[k].kind) {
            case TEXT:
                fputs(at, f.stream);
                break;
            case WHOLE:
                fprintf(f.stream, "%" PRId64, *(const int64_t *)(const void *)at);
                break;
            case FIGURE:
                if (isfinite(*(const double *)(const void *)at))
                    fprintf(f.stream, "%.6g", *(const double *)(const void *)at);
                break;
            case YES:
                fputs(*(const bool *)(const void *)at ? "yes" : "no", f.stream);
                break;
            }
            fputc(k + 1 < N_COLUMNS ? ',' : '\n', f.stream);
        }
    return atomic_file_commit(&f);
}

static int read_field(struct chart_row *row, const struct csv *csv, int k)
{
    const char *text = csv->field[k];
    char *at = (char *)row + columns[k].offset;
    double number = NAN;
    int err = 0;
    switch (columns[k].kind) {
    case TEXT:
        if (columns[k].size == CHART_NAME_MAX)
            plain_name(at, text, strlen(text));
        else
            snprintf(at, columns[k].size, "%s", text), plain_text(at);
        return 0;
    case WHOLE:
        err = csv_number(csv, k, &number);
        if (!err && !(fabs(number) < 9e15))
            err = -EINVAL;
        *(int64_t *)(void *)at = err ? 0 : (int64_t)number;
        return err;
    case FIGURE:
        err = *text ? csv_number(csv, k, &number) : 0;
        *(double *)(void *)at = number;
        return err;
    case YES:
        *(bool *)(void *)at = !strcmp(text, "yes");
        return 0;
    }
    return 0;
}

// Rows of an earlier run; none where there is no file.
static int read_table(struct table *t, const char *path)
{
    struct csv csv;
    if (access(path, F_OK))
        return 0;
    int err = csv_open(&csv, path);
    if (err)
        return err;
    bool ours = csv.n_columns == N_COLUMNS;
    for (int k = 0; ours && k < N_COLUMNS; k++)
        ours = !strcmp(csv.column[k], columns[k].name);
    if (!ours) {
        log_error("chart: %s: is not a table of this version's charts: move it away, or name another folder", path);
        err = -EINVAL;
    }
    for (int more; !err && (more = csv_next_row(&csv)) != 0;) {
        struct chart_row row = { 0 };
        err = more < 0 ? more : 0;
        for (int k = 0; !err && k < N_COLUMNS; k++)
            err = read_field(&row, &csv, k);
        if (!err && t->n >= MAX_ROWS) {
            log_error("chart: %s: more than %d rows", path, MAX_ROWS);
            err = -EFBIG;
        }
        if (!err)
            err = add_row(t, &row);
    }
    csv_close(&csv);
    return err;
}

// ---- which solves ----------------------------------------------------------------------------------------------------------

// The base, what differs from it in one setting, the presets. How many.
static int list_points(struct chart_row *point, const struct set *s, const struct arguments *a)
{
    const char *fastest = kernels_select(KERNELS_ALL)->name;
    struct chart_row base = { .n_lights = a->base_lights, .texture = a->base_texture, .stage = 2, .seed = (int64_t)a->seed, .n_views = s->n_views,
                              .width_px = s->width_px, .height_px = s->height_px, .wall_s = NAN, .cpu_s = NAN, .rmse_fit_percent = NAN,
                              .rmse_held_out_percent = NAN, .rmse_pictures_percent = NAN };
    const int scale = a->preset_scale ? a->preset_scale : s->width_px >= 1600 ? 1 : s->width_px >= 800 ? 2 : 4;
    int n = 0;
    base.threads = a->n_threads;
    memcpy(base.set, s->name, sizeof(base.set));
    snprintf(base.axis, sizeof(base.axis), "base");
    snprintf(base.method, sizeof(base.method), "%s", a->n_methods ? a->methods[0] : "joint");
    snprintf(base.kernel, sizeof(base.kernel), "%s", fastest);
    memcpy(base.hold_out, s->hold_out_name, sizeof(base.hold_out));
    point[n++] = base;
    for (int i = 0; i < a->n_textures; i++)
        if (a->textures[i] != a->base_texture) {
            point[n] = base, point[n].texture = a->textures[i];
            snprintf(point[n++].axis, CHART_NAME_MAX, "texture");
        }
    for (int i = 0; i < a->n_lights; i++)
        if (a->lights[i] != a->base_lights) {
            point[n] = base, point[n].n_lights = a->lights[i];
            snprintf(point[n++].axis, CHART_NAME_MAX, "lights");
        }
    for (int i = 1; i < a->n_methods; i++) {
        point[n] = base;
        snprintf(point[n].method, CHART_NAME_MAX, "%s", a->methods[i]);
        snprintf(point[n++].axis, CHART_NAME_MAX, "method");
    }
    for (int i = 0; i < a->n_kernels; i++)
        if (strcmp(a->kernels[i], fastest)) {
            point[n] = base;
            snprintf(point[n].kernel, CHART_NAME_MAX, "%s", a->kernels[i]);
            snprintf(point[n++].axis, CHART_NAME_MAX, "kernel");
        }
    for (int i = 0; i < a->n_presets; i++) {
        point[n] = base;
        const struct preset *p = presets;
        while (strcmp(p->name, a->presets[i]))
            p++;
        point[n].n_lights = p->n_lights, point[n].stage = p->last_stage, point[n].texture = p->texture / scale;
        snprintf(point[n].method, CHART_NAME_MAX, "joint");
        snprintf(point[n].preset, CHART_NAME_MAX, "%s", a->presets[i]);
        snprintf(point[n++].axis, CHART_NAME_MAX, "preset");
    }
    return n;
}

// How much longer than others a solve will take, roughly: for the time that is left.
static double expected_cost(const struct chart_row *r)
{
    const double per_kernel = !strcmp(r->kernel, "reference") ? 40 : !strcmp(r->kernel, "portable") ? 3 : !strcmp(r->kernel, "avx2") ? 1.3 : 1;
    const double per_method = r->stage == 1 ? .4 : !strcmp(r->method, "directional") ? .2 : !strcmp(r->method, "alternating") ? .5 : 1;
    return per_kernel * per_method * (.3 + (double)r->n_lights / 256) * (.2 + pow((double)r->texture / 32, 1.2));
}

// ---- one solve -------------------------------------------------------------------------------------------------------------

static int remove_one(const char *path, const struct stat *st, int type, struct FTW *ftw)
{
    (void)st, (void)type, (void)ftw;
    return remove(path);
}

// Means of k x k pixels: a camera resized by exactly 1/k sees them.
static int shrink(struct image *out, const struct image *in, int k)
{
    const int err = image_new(out, in->width / k, in->height / k, 3, NULL);
    for (int y = 0; !err && y < out->height * k; y++)
        for (int x = 0; x < out->width * k; x++)
            for (int c = 0; c < 3; c++)
                out->data[3 * ((size_t)(y / k) * (size_t)out->width + (size_t)(x / k)) + (size_t)c] +=
                    in->data[(size_t)in->n_channels * ((size_t)y * (size_t)in->width + (size_t)x) + (size_t)c] / (float)(k * k);
    return err;
}

struct difference {
    double sum;
    int64_t n;
};

static int compare_view(struct difference *d, const struct renderer *renderer, const struct camera *camera, const char *path)
{
    struct image photograph = { 0 }, small = { 0 }, picture = { 0 };
    struct camera c = *camera;
    const int k = (camera->width_px + JUDGED_WIDTH_PX - 1) / JUDGED_WIDTH_PX;
    int err = image_read(&photograph, path);
    if (!err && (photograph.n_channels < 3 || photograph.width != camera->width_px || photograph.height != camera->height_px))
        err = -EINVAL;
    if (!err)
        err = shrink(&small, &photograph, k);
    c.width_px /= k, c.height_px /= k;
    c.fx /= k, c.fy /= k, c.cx /= k, c.cy /= k, c.skew /= k;
    if (!err)
        err = render_view(renderer, &c, &picture);
    for (int64_t i = 0; !err && i < (int64_t)picture.width * picture.height; i++) {
        const float *p = picture.data + 4 * i, *q = small.data + 3 * i;
        if (p[3] < .999f)
            continue;
        for (int channel = 0; channel < 3; channel++) {
            const double e = fmin(fmax((double)p[channel], 0), 1) - fmin(fmax((double)q[channel], 0), 1);
            d->sum += e * e / 3;
        }
        d->n++;
    }
    image_free(&photograph);
    image_free(&small);
    image_free(&picture);
    return err;
}

// Some of the held-out views, rendered from the solve and compared with their photographs inside the object's outline; NAN where that fails.
static double judge_pictures(const char *solve_dir, const struct set *s, const char *method, int n_threads)
{
    struct inputs in = { .take_dir = s->take, .needs = TAKE_MESH | TAKE_CAMERAS | TAKE_VIEWS, .texture = 64 };
    struct solved solved = { 0 };
    struct renderer *renderer = NULL;
    struct difference d = { 0 };
    int err = inputs_load(&in);
    if (!err)
        err = solved_read(&solved, "chart", solve_dir, NULL);
    if (!err)
        err = solved_read_lights(&solved, solve_dir);
    // The paper's methods know no shadows and no second bounce.
    const bool ours = !strcmp(method, "joint");
    const struct render_material material = { .model = solved.parameters.data ? REFLECT_DISNEY : REFLECT_LAMBERT, .variant = solved.variant,
                                              .albedo = &solved.albedo, .parameters = solved.parameters.data ? &solved.parameters : NULL };
    const struct render_settings settings = { .samples = 2, .shadows = ours, .shadow_rays = solved.lights.n <= 256 ? 0 : 1, .seed = 1, .n_threads = n_threads };
    if (!err)
        err = renderer_new(&renderer, &in.mesh, in.rays, &solved.lights, &material, &settings);
    const int n = err ? 0 : json_length(solved.report, "views_held_out");
    for (int i = 0; !err && i < JUDGED_VIEWS && i < n; i++) {
        char key[64];
        const char *name;
        snprintf(key, sizeof(key), "views_held_out.%d", n <= JUDGED_VIEWS ? i : (2 * i + 1) * n / (2 * JUDGED_VIEWS));
        err = json_require_string(solved.report, key, &name, "report.json");
        const struct camera *camera = err ? NULL : cameras_find(&in.cameras, name);
        if (camera && in.picture[camera - in.cameras.view])
            err = compare_view(&d, renderer, camera, in.picture[camera - in.cameras.view]);
    }
    if (renderer)
        renderer_free(renderer);
    solved_free(&solved);
    inputs_free(&in);
    return !err && d.n > 0 ? 100 * sqrt(d.sum / (double)d.n) : NAN;
}

// In a process of its own: this one must stay small, because a process that starts from it begins with its peak memory.
static double judge_apart(const char *solve_dir, const struct set *s, const char *method, int n_threads)
{
    int ends[2];
    double rmse = NAN;
    if (pipe2(ends, O_CLOEXEC))
        return NAN;
    fflush(stdout);
    const pid_t child = fork();
    if (child == 0) {
        log_set_level(LOG_ERROR);
        rmse = judge_pictures(solve_dir, s, method, n_threads);
        _exit(write(ends[1], &rmse, sizeof(rmse)) == sizeof(rmse) ? 0 : 1);
    }
    close(ends[1]);
    if (child < 0 || read(ends[0], &rmse, sizeof(rmse)) != sizeof(rmse))
        rmse = NAN;
    close(ends[0]);
    while (child > 0 && waitpid(child, NULL, 0) < 0 && errno == EINTR)
        ;
    return rmse;
}

static void read_report(struct chart_row *row, const char *path)
{
    struct json *report;
    const char *text;
    if (json_read(&report, path)) {
        snprintf(row->stop_reason, sizeof(row->stop_reason), "no report.json");
        return;
    }
    row->solved = true;
    if (json_get_bool(report, "trusted", &row->trusted))
        row->trusted = false;
    json_get_int(report, "n_lights", &row->n_lights);
    json_get_int(report, "texture", &row->texture);
    json_get_int(report, "threads", &row->threads);
    json_get_int(report, "n_observations", &row->n_observations);
    json_get_number(report, "rmse_fit_percent", &row->rmse_fit_percent);
    json_get_number(report, "rmse_held_out_percent", &row->rmse_held_out_percent);
    if (!json_get_string(report, "method", &text))
        plain_name(row->method, text, strlen(text));
    if (!json_get_string(report, "kernel", &text))
        plain_name(row->kernel, text, strlen(text));
    if (!json_get_string(report, "stop_reason", &text))
        snprintf(row->stop_reason, sizeof(row->stop_reason), "%s", text), plain_text(row->stop_reason);
    const int n = json_length(report, "views_held_out");
    row->n_held_out = n > 0 ? n : 0;
    json_free(report);
}

static int solve_one(struct chart_row *row, const struct set *s, const struct arguments *a)
{
    char lights[16], texture[16], seed[24], threads[16], label[CHART_NAME_MAX], name[2 * CHART_NAME_MAX + 2];
    char *dir = NULL, *log_path = NULL, *report = NULL;
    struct rusage use;
    int status = 0, n = 0;
    const char *argv[24];
    chart_label(label, sizeof(label), row);
    plain_name(label, label, strlen(label));
    snprintf(name, sizeof(name), "%s-%s", s->name, label);
    int err = asprintf(&dir, "%s/solves/%s", a->out, name) < 0 || asprintf(&log_path, "%s.log", dir) < 0 || asprintf(&report, "%s/report.json", dir) < 0 ? -ENOMEM : 0;
    if (err)
        goto done;
    snprintf(lights, sizeof(lights), "%" PRId64, row->n_lights);
    snprintf(texture, sizeof(texture), "%" PRId64, row->texture);
    snprintf(seed, sizeof(seed), "%" PRId64, row->seed);
    snprintf(threads, sizeof(threads), "%d", a->n_threads);
    const char *const always[] = { "rigsolve", "solve", s->take, "-o", dir, "--hold-out", s->hold_out, "--seed", seed, "--threads", threads, "--texture", texture };
    const char *const settings[] = { "--method", row->method, "--lights", lights, "--stage", row->stage == 1 ? "1" : "2" };
    for (size_t i = 0; i < sizeof(always) / sizeof(always[0]); i++)
        argv[n++] = always[i];
    for (size_t i = 0; !*row->preset && i < sizeof(settings) / sizeof(settings[0]); i++)
        argv[n++] = settings[i];
    if (*row->preset)
        argv[n++] = "--preset", argv[n++] = row->preset;
    argv[n] = NULL;
    nftw(dir, remove_one, 8, FTW_DEPTH | FTW_PHYS); // of a run that was killed
    const double begin_s = output_clock_s();
    err = run_self(&status, &use, argv, row->kernel, log_path);
    if (err)
        goto done;
    row->wall_s = output_clock_s() - begin_s;
    row->cpu_s = (double)(use.ru_utime.tv_sec + use.ru_stime.tv_sec) + 1e-6 * (double)(use.ru_utime.tv_usec + use.ru_stime.tv_usec);
    row->peak_rss_bytes = (int64_t)use.ru_maxrss * 1024;
    if (status == EXIT_DONE || status == EXIT_NOT_TRUSTED) {
        read_report(row, report);
    } else if (status >= 128) {
        snprintf(row->stop_reason, sizeof(row->stop_reason), "killed by signal %d (%s)", status - 128, strsignal(status - 128));
    } else {
        read_cause(row->stop_reason, log_path);
        plain_text(row->stop_reason);
    }
    if (row->solved)
        row->rmse_pictures_percent = judge_apart(dir, s, row->method, a->n_threads);
    if (!a->keep)
        nftw(dir, remove_one, 8, FTW_DEPTH | FTW_PHYS);
done:
    free(dir);
    free(log_path);
    free(report);
    return err;
}

// ---- all of them -----------------------------------------------------------------------------------------------------------

// The row of that name, or else one of the same solve.
static const struct chart_row *find_row(const struct table *t, const struct chart_row *point)
{
    const struct chart_row *found = NULL;
    for (int i = 0; i < t->n; i++) {
        if (!same_solve(&t->row[i], point))
            continue;
        if (!strcmp(t->row[i].axis, point->axis) && !strcmp(t->row[i].preset, point->preset))
            return &t->row[i];
        found = &t->row[i];
    }
    return found;
}

static void say_row(const struct chart_row *r, int done, int total, double left_s)
{
    char label[CHART_NAME_MAX], left[64] = "";
    chart_label(label, sizeof(label), r);
    if (left_s > 0)
        snprintf(left, sizeof(left), "; about %d min left", (int)ceil(left_s / 60));
    if (r->solved)
        log_info("chart: [%d/%d] %s, %s: %.1f CPU s, pictures held out %.3f %%%s%s", done, total, r->set, label, r->cpu_s, r->rmse_pictures_percent,
                 r->trusted ? "" : ", not to be trusted", left);
    else
        log_warning("chart: [%d/%d] %s, %s: failed: %s%s", done, total, r->set, label, r->stop_reason, left);
}

// What is asked for and not in the table is solved and added; chosen: the rows asked for, in order.
static int solve_all(struct table *t, struct table *chosen, const struct set *sets, const struct arguments *a, const char *csv_path)
{
    struct chart_row *point = calloc(MAX_SETS * MAX_POINTS, sizeof(*point));
    int set_of[MAX_SETS * MAX_POINTS], n = 0, err = point ? 0 : -ENOMEM, n_found = 0;
    for (int k = 0; !err && k < a->n_sets; k++) {
        const int more = list_points(point + n, &sets[k], a);
        for (int i = 0; i < more; i++)
            set_of[n + i] = k;
        n += more;
    }
    double cost_left = 0, cost_done = 0, wall_done_s = 0;
    for (int i = 0; i < n; i++) {
        if (find_row(t, &point[i]))
            n_found++;
        else
            cost_left += expected_cost(&point[i]);
    }
    if (!err && !n_found && a->no_solve) {
        log_error("chart: %s: has none of the rows asked for; run without --no-solve", csv_path);
        err = -ENOENT;
    }
    if (n_found)
        log_info("chart: %d of %d rows are in %s already", n_found, n, csv_path);
    const bool solves = n > n_found && !a->no_solve;
    if (solves)
        progress_begin("chart", n - n_found);
    for (int i = 0, done = n_found; !err && i < n; i++) {
        const struct chart_row *found = find_row(t, &point[i]);
        if (!found && a->no_solve)
            continue;
        const bool named = found && !strcmp(found->axis, point[i].axis) && !strcmp(found->preset, point[i].preset);
        struct chart_row row = found ? *found : point[i];
        if (!found) {
            const double cost = expected_cost(&row), begin_s = output_clock_s();
            err = solve_one(&row, &sets[set_of[i]], a);
            cost_left -= cost, cost_done += cost, wall_done_s += output_clock_s() - begin_s;
            progress_add(1);
        }
        memcpy(row.axis, point[i].axis, sizeof(row.axis));
        memcpy(row.preset, point[i].preset, sizeof(row.preset));
        if (!err && !named)
            err = add_row(t, &row);
        if (!err && !named)
            err = write_table(t, csv_path);
        if (!err && !found) {
            done++;
            say_row(&row, done, n, done == n ? 0 : cost_left * wall_done_s / cost_done);
        }
        if (!err)
            err = add_row(chosen, &row);
    }
    if (solves)
        progress_end();
    free(point);
    return err;
}

// The processor's name as the kernel tells it, of letters that the drawing's script may hold.
static void name_cpu(char *out, size_t size)
{
    char line[512];
    FILE *f = fopen("/proc/cpuinfo", "re");
    snprintf(out, size, "CPU of unknown name");
    while (f && fgets(line, sizeof(line), f)) {
        char *colon = strchr(line, ':');
        if (strncmp(line, "model name", 10) || !colon)
            continue;
        for (char *p = colon; *p; p++)
            *p = (*p >= '0' && *p <= '9') || (*p >= 'A' && *p <= 'Z') || (*p >= 'a' && *p <= 'z') || strchr(" ()@.-", *p) ? *p : ' ';
        snprintf(out, size, "%s", colon + 2);
        for (size_t n = strlen(out); n > 0 && out[n - 1] == ' '; n--)
            out[n - 1] = 0;
        break;
    }
    if (f)
        fclose(f);
}

static int print_rows(const struct table *t, bool as_json)
{
    struct json *rows = as_json ? json_array() : NULL;
    if (!as_json)
        printf("%-16s %-14s %10s %13s %13s %10s  (* nothing cheaper is as good, by 1 %%)\n", "set", "setting", "CPU s", "samples, %", "pictures, %", "peak MiB");
    for (int i = 0; i < t->n; i++) {
        const struct chart_row *r = &t->row[i];
        char label[CHART_NAME_MAX];
        chart_label(label, sizeof(label), r);
        if (!as_json && r->solved)
            printf("%-16s %-14s %10.1f %11.3f %s %11.3f %s %10.0f%s\n", r->set, label, r->cpu_s, r->rmse_held_out_percent,
                   chart_on_front(t->row, t->n, i, CHART_SAMPLES) ? "*" : " ", r->rmse_pictures_percent, chart_on_front(t->row, t->n, i, CHART_PICTURES) ? "*" : " ",
                   (double)r->peak_rss_bytes / 1048576, r->trusted ? "" : "  not to be trusted");
        else if (!as_json)
            printf("%-16s %-14s failed: %s\n", r->set, label, r->stop_reason);
        if (!as_json)
            continue;
        struct json *o = json_object();
        for (int k = 0; k < N_COLUMNS; k++) {
            const char *at = (const char *)r + columns[k].offset;
            switch (columns[k].kind) {
            case TEXT:
                json_set_string(o, columns[k].name, at);
                break;
            case WHOLE:
                json_set_int(o, columns[k].name, *(const int64_t *)(const void *)at);
                break;
            case FIGURE:
                json_set_number(o, columns[k].name, *(const double *)(const void *)at);
                break;
            case YES:
                json_set_bool(o, columns[k].name, *(const bool *)(const void *)at);
                break;
            }
        }
        json_set_bool(o, "on_front_of_pictures", chart_on_front(t->row, t->n, i, CHART_PICTURES));
        json_set_bool(o, "on_front_of_samples", chart_on_front(t->row, t->n, i, CHART_SAMPLES));
        json_append(rows, o);
    }
    return as_json ? output_json("chart", rows) : output_flush("chart");
}

static int prepare(struct set *sets, const struct arguments *a)
{
    char *takes = NULL, *solves = NULL;
    int err = asprintf(&takes, "%s/takes", a->out) < 0 || asprintf(&solves, "%s/solves", a->out) < 0 ? -ENOMEM : make_directories(solves);
    if (!err)
        err = make_directories(takes);
    for (int k = 0; !err && k < a->n_sets; k++) {
        err = prepare_set(&sets[k], a->sets[k], a);
        for (int j = 0; !err && j < k; j++)
            if (!strcmp(sets[j].name, sets[k].name)) {
                log_error("chart: %s and %s: two takes of one name; expected different names", a->sets[j], a->sets[k]);
                err = -EEXIST;
            }
    }
    free(takes);
    free(solves);
    return err;
}

int command_chart(int argc, char **argv)
{
    const struct argp argp = { options, parse, "[TAKE...] -o DIR", doc, NULL, NULL, NULL };
    struct arguments a = { .base_lights = 256, .base_texture = 32, .n_views = 40, .width_px = 120, .height_px = 80, .seed = 1 };
    struct set sets[MAX_SETS] = { 0 };
    struct table table = { 0 }, chosen = { 0 };
    char *csv_path = NULL, caption[512], cpu[128];
    argp_parse(&argp, argc, argv, 0, NULL, &a);
    put_defaults(&a);
    if (!a.n_threads)
        a.n_threads = parallel_n_cores();
    int err = prepare(sets, &a);
    if (!err && asprintf(&csv_path, "%s/chart.csv", a.out) < 0)
        err = -ENOMEM;
    if (!err)
        err = read_table(&table, csv_path);
    if (!err)
        err = solve_all(&table, &chosen, sets, &a, csv_path);
    if (!err) {
        name_cpu(cpu, sizeof(cpu));
        snprintf(caption, sizeof(caption), "Base: %s, %d lights, texture %d, %s kernels; seed %" PRIu64 "; %d threads of %s.", a.n_methods ? a.methods[0] : "joint",
                 a.base_lights, a.base_texture, kernels_select(KERNELS_ALL)->name, a.seed, a.n_threads, cpu);
        err = print_rows(&chosen, a.json);
        const int drawn = err ? err : chart_draw(chosen.row, chosen.n, a.out, caption);
        err = drawn == -ENOENT ? 0 : drawn;
    }
    if (err == -ENOMEM)
        log_error("chart: out of memory");
    for (int k = 0; k < a.n_sets; k++)
        free(sets[k].take), free(sets[k].hold_out);
    free(csv_path);
    free(table.row);
    free(chosen.row);
    return err ? EXIT_FAILED : EXIT_DONE;
}
