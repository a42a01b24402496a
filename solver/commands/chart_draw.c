// solver/commands/chart_draw.c - error against CPU seconds, drawn by gnuplot.
//
// Where everything goes is decided here, in pixels: gnuplot does not keep labels from covering one another. The script holds
// its data and stands alone, so that it can be changed and run again by hand.
#include "solver/commands/chart_draw.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>

extern char **environ;

enum {
    PANEL_WIDTH = 560, PANEL_HEIGHT = 440, LEFT = 72, RIGHT = 16, TOP = 44, BOTTOM = 56, HEAD = 40, FOOT = 108, // pixels
    CHARACTER_WIDTH = 7, LINE_HEIGHT = 15, GAP = 10,
    MAX_BOXES = 4096, N_MEASURES = 2,
};

static const struct style {
    const char *axis, *colour, *text;
    int filled, hollow; // gnuplot's point types
} styles[] = {
    { "base", "#222222", "base", 7, 6 },
    { "lights", "#0072b2", "lights (N)", 7, 6 },
    { "texture", "#d55e00", "texture size", 5, 4 },
    { "method", "#009e73", "method", 9, 8 },
    { "kernel", "#cc79a7", "kernel", 13, 12 },
    { "preset", "#222222", "preset", 15, 14 },
};
enum { N_STYLES = sizeof(styles) / sizeof(styles[0]) };

static const struct style *style_of(const struct chart_row *r)
{
    for (int i = 0; i < N_STYLES; i++)
        if (!strcmp(styles[i].axis, r->axis))
            return &styles[i];
    return &styles[0];
}

double chart_error_percent(const struct chart_row *row, enum chart_measure measure)
{
    return !row->solved ? NAN : measure == CHART_PICTURES ? row->rmse_pictures_percent : row->rmse_held_out_percent;
}

static bool drawn(const struct chart_row *r, enum chart_measure measure)
{
    return chart_error_percent(r, measure) > 0 && r->cpu_s > 0;
}

bool chart_on_front(const struct chart_row *rows, int n, int i, enum chart_measure measure)
{
    if (!drawn(&rows[i], measure))
        return false;
    for (int k = 0; k < n; k++)
        if (k != i && drawn(&rows[k], measure) && !strcmp(rows[k].set, rows[i].set) && rows[k].cpu_s < rows[i].cpu_s &&
            chart_error_percent(&rows[k], measure) <= 1.01 * chart_error_percent(&rows[i], measure))
            return false;
    return true;
}

void chart_label(char *out, int size, const struct chart_row *r)
{
    if (!strcmp(r->axis, "lights"))
        snprintf(out, (size_t)size, "N=%lld", (long long)r->n_lights);
    else if (!strcmp(r->axis, "texture"))
        snprintf(out, (size_t)size, "texture %lld", (long long)r->texture);
    else if (!strcmp(r->axis, "preset"))
        snprintf(out, (size_t)size, "%s (%lld)", r->preset, (long long)r->texture);
    else
        snprintf(out, (size_t)size, "%s", !strcmp(r->axis, "method")   ? r->method
                                          : !strcmp(r->axis, "kernel") ? r->kernel
                                                                       : r->axis);
}

// ---- one panel -------------------------------------------------------------------------------------------------------------

struct box {
    double x0, y0, x1, y1; // pixels of the whole picture, y upwards
    double weight;         // how bad it is to cover it
};
struct panel {
    const struct chart_row *rows;
    int n;
    const char *set;
    enum chart_measure measure;
    struct box area;
    double low[2], high[2]; // of CPU seconds and error
    struct box taken[MAX_BOXES];
    int n_taken;
};

static bool in_panel(const struct panel *p, int i)
{
    return !strcmp(p->rows[i].set, p->set);
}

static void place_px(const struct panel *p, const struct chart_row *r, double *x, double *y)
{
    *x = p->area.x0 + (p->area.x1 - p->area.x0) * log(r->cpu_s / p->low[0]) / log(p->high[0] / p->low[0]);
    *y = p->area.y0 + (p->area.y1 - p->area.y0) * log(chart_error_percent(r, p->measure) / p->low[1]) / log(p->high[1] / p->low[1]);
}

// The range in which all points lie, with room for labels around them.
static void choose_ranges(struct panel *p)
{
    for (int k = 0; k < 2; k++)
        p->low[k] = INFINITY, p->high[k] = 0;
    for (int i = 0; i < p->n; i++)
        if (in_panel(p, i) && drawn(&p->rows[i], p->measure)) {
            const double at[2] = { p->rows[i].cpu_s, chart_error_percent(&p->rows[i], p->measure) };
            for (int k = 0; k < 2; k++)
                p->low[k] = fmin(p->low[k], at[k]), p->high[k] = fmax(p->high[k], at[k]);
        }
    for (int k = 0; k < 2; k++) {
        if (!(p->high[k] > 0))
            p->low[k] = .1, p->high[k] = 10;
        const double room = fmax(pow(p->high[k] / p->low[k], .14), 1.15);
        p->low[k] /= room, p->high[k] *= room;
    }
}

// Ticks at 1, 2, 5 of each decade, or closer where the range is short.
static void write_tics(FILE *f, const char *axis, double low, double high)
{
    static const double wide[] = { 1, 2, 5 }, narrow[] = { 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8 };
    const bool short_range = high / low < 8;
    const double *step = short_range ? narrow : wide;
    const int n = short_range ? (int)(sizeof(narrow) / sizeof(narrow[0])) : 3;
    const char *comma = "";
    fprintf(f, "set %stics (", axis);
    for (int decade = (int)floor(log10(low)); decade <= (int)ceil(log10(high)); decade++)
        for (int k = 0; k < n; k++) {
            const double at = step[k] * pow(10, decade);
            if (at < low || at > high)
                continue;
            fprintf(f, "%s'%g' %g", comma, at, at);
            comma = ", ";
        }
    fprintf(f, ")\n");
}

static bool overlap(const struct box *a, const struct box *b)
{
    return a->x0 < b->x1 && b->x0 < a->x1 && a->y0 < b->y1 && b->y0 < a->y1;
}

// How much of the box is covered by others or outside the panel; 0 is best.
static double crowding(const struct panel *p, const struct box *b)
{
    double sum = 0;
    if (b->x0 < p->area.x0 || b->x1 > p->area.x1 || b->y0 < p->area.y0 || b->y1 > p->area.y1)
        sum += 1e6;
    for (int k = 0; k < p->n_taken; k++)
        if (overlap(b, &p->taken[k]))
            sum += p->taken[k].weight * (fmin(b->x1, p->taken[k].x1) - fmax(b->x0, p->taken[k].x0)) * (fmin(b->y1, p->taken[k].y1) - fmax(b->y0, p->taken[k].y0));
    return sum;
}

static void take_box(struct panel *p, struct box b)
{
    if (p->n_taken < MAX_BOXES)
        p->taken[p->n_taken++] = b;
}

// A line of the drawing, as small boxes.
static void take_line(struct panel *p, double x0, double y0, double x1, double y1)
{
    const int n = (int)ceil(hypot(x1 - x0, y1 - y0) / 5);
    for (int i = 0; i <= n; i++) {
        const double x = x0 + (x1 - x0) * i / fmax(n, 1), y = y0 + (y1 - y0) * i / fmax(n, 1);
        take_box(p, (struct box){ x - 2.5, y - 2.5, x + 2.5, y + 2.5, .3 });
    }
}

// Beside its point, where the least is in the way; further off with a thin line to the point.
static void write_label(FILE *f, struct panel *p, const struct chart_row *r, double width, double height)
{
    static const double direction[][2] = { { 1, 0 }, { -1, 0 }, { 0, 1 }, { 0, -1 }, { 1, 1 }, { 1, -1 }, { -1, 1 }, { -1, -1 } };
    char text[CHART_NAME_MAX];
    chart_label(text, sizeof(text), r);
    double x, y, best = INFINITY, best_distance = 0;
    struct box found = { 0 };
    const bool large = !strcmp(r->axis, "preset");
    const double w = (large ? 1.25 : 1) * CHARACTER_WIDTH * (double)strlen(text), h = (large ? 1.25 : 1) * LINE_HEIGHT;
    place_px(p, r, &x, &y);
    for (int ring = 0; ring < 6 && best > 0; ring++)
        for (int k = 0; k < 8 && best > 0; k++) {
            const double gap = GAP + (large ? 3 : 0) + 14 * ring, cx = x + direction[k][0] * (gap + w / 2), cy = y + direction[k][1] * (gap + (direction[k][0] != 0 ? 0 : h / 2));
            const struct box b = { cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2, 1 };
            const double c = crowding(p, &b);
            if (c < .8 * best) // further off only where that is worth it
                best = c, found = b, best_distance = ring;
        }
    take_box(p, found);
    const double tx = (found.x0 + found.x1) / 2, ty = (found.y0 + found.y1) / 2;
    if (best_distance > 0)
        fprintf(f, "set arrow from screen %.5f,%.5f to screen %.5f,%.5f nohead lw .5 lc rgb '#999999'\n", x / width, y / height,
                fmin(fmax(x, found.x0), found.x1) / width, fmin(fmax(y, found.y0), found.y1) / height);
    fprintf(f, "set label '%s' at screen %.5f,%.5f center tc rgb '%s'%s\n", text, tx / width, ty / height, style_of(r)->colour,
            large ? " font ',11'" : "");
}

static int by_cost(const void *a, const void *b)
{
    const struct chart_row *x = *(const struct chart_row *const *)a, *y = *(const struct chart_row *const *)b;
    return (x->cpu_s > y->cpu_s) - (x->cpu_s < y->cpu_s);
}

static int by_value(const void *a, const void *b)
{
    const struct chart_row *x = *(const struct chart_row *const *)a, *y = *(const struct chart_row *const *)b;
    const int64_t u = !strcmp(x->axis, "texture") || !strcmp(y->axis, "texture") ? x->texture - y->texture : x->n_lights - y->n_lights;
    return (u > 0) - (u < 0);
}

// The rows of an axis ("front": those on it) and the base, in the order of a line through them. How many.
static int line_of(const struct panel *p, const char *axis, const struct chart_row **line)
{
    int n = 0;
    for (int i = 0; i < p->n; i++) {
        const struct chart_row *r = &p->rows[i];
        if (in_panel(p, i) && drawn(r, p->measure) && (!strcmp(axis, "front") ? chart_on_front(p->rows, p->n, i, p->measure) : !strcmp(r->axis, axis) || !strcmp(r->axis, "base")))
            line[n++] = r;
    }
    qsort(line, (size_t)n, sizeof(*line), !strcmp(axis, "lights") || !strcmp(axis, "texture") ? by_value : by_cost);
    return n;
}

static void write_panel(FILE *f, struct panel *p, int index, const struct chart_row **line, double width, double height)
{
    static const char *const lines[] = { "front", "lights", "texture", "method", "kernel" };
    char failed[512] = "";
    const struct chart_row *any = NULL;
    choose_ranges(p);
    fprintf(f, "\n# ---- %s\nunset label; unset arrow\n", p->set);
    for (int i = 0; i < p->n; i++) {
        const struct chart_row *r = &p->rows[i];
        if (!in_panel(p, i))
            continue;
        any = any && !r->solved ? any : r; // a failed one does not know how many were held out
        if (drawn(r, p->measure)) {
            double x, y;
            place_px(p, r, &x, &y);
            take_box(p, (struct box){ x - 6, y - 6, x + 6, y + 6, 1 });
        } else {
            char label[CHART_NAME_MAX];
            chart_label(label, sizeof(label), r);
            const size_t used = strlen(failed);
            snprintf(failed + used, sizeof(failed) - used, "%s%s", used ? ", " : "no figure: ", label);
        }
    }
    if (*failed)
        take_box(p, (struct box){ p->area.x0, p->area.y1 - 12 - LINE_HEIGHT, p->area.x0 + 8 + CHARACTER_WIDTH * (double)strlen(failed), p->area.y1, 1 });
    for (int k = 0; k < 5; k++) {
        const int n = line_of(p, lines[k], line);
        fprintf(f, "$line%d_%d << EOD\n", index, k);
        // Methods and kernels have no order: spokes from the base.
        const struct chart_row *base = NULL;
        for (int i = 0; i < n; i++)
            base = k >= 3 && !strcmp(line[i]->axis, "base") ? line[i] : base;
        for (int i = 0; i < n; i++) {
            const struct chart_row *from = base ? base : i > 0 ? line[i - 1] : line[i];
            double x0, y0, x1, y1;
            place_px(p, from, &x0, &y0);
            place_px(p, line[i], &x1, &y1);
            if (k == 0) { // a front is a stair
                take_line(p, x0, y0, x1, y0);
                take_line(p, x1, y0, x1, y1);
                fprintf(f, "%.6g %.6g\n", line[i]->cpu_s, chart_error_percent(from, p->measure));
            } else {
                take_line(p, x0, y0, x1, y1);
            }
            if (base)
                fprintf(f, "%.6g %.6g\n", base->cpu_s, chart_error_percent(base, p->measure));
            fprintf(f, "%.6g %.6g\n%s", line[i]->cpu_s, chart_error_percent(line[i], p->measure), base ? "\n" : "");
        }
        if (n == 0)
            fprintf(f, "NaN NaN\n");
        fprintf(f, "EOD\n");
    }
    for (int s = 0; s < N_STYLES; s++) {
        int n = 0;
        fprintf(f, "$points%d_%d << EOD\n", index, s);
        for (int i = 0; i < p->n; i++) {
            const struct chart_row *r = &p->rows[i];
            if (!in_panel(p, i) || !drawn(r, p->measure) || style_of(r) != &styles[s])
                continue;
            fprintf(f, "%.6g %.6g %d\n", r->cpu_s, chart_error_percent(r, p->measure), r->trusted ? styles[s].filled : styles[s].hollow);
            n++;
        }
        fprintf(f, "%sEOD\n", n ? "" : "NaN NaN 1\n");
    }
    // Presets first: they have the best places.
    for (int pass = 0; pass < 2; pass++)
        for (int i = 0; i < p->n; i++)
            if (in_panel(p, i) && drawn(&p->rows[i], p->measure) && (pass == 0) == !strcmp(p->rows[i].axis, "preset"))
                write_label(f, p, &p->rows[i], width, height);
    if (*failed)
        fprintf(f, "set label '%s' at screen %.5f,%.5f left tc rgb '#c00000'\n", failed, (p->area.x0 + 8) / width, (p->area.y1 - 12) / height);
    fprintf(f, "set lmargin at screen %.5f; set rmargin at screen %.5f; set bmargin at screen %.5f; set tmargin at screen %.5f\n",
            p->area.x0 / width, p->area.x1 / width, p->area.y0 / height, p->area.y1 / height);
    if (p->measure == CHART_SAMPLES)
        fprintf(f, "set title '%s: at texel centres'\n", p->set);
    else if (any)
        fprintf(f, "set title '%s: %lld views of %lldx%lld pixels, %lld held out'\n", p->set, (long long)any->n_views, (long long)any->width_px,
                (long long)any->height_px, (long long)any->n_held_out);
    fprintf(f, "set xrange [%.6g:%.6g]; set yrange [%.6g:%.6g]\n", p->low[0], p->high[0], p->low[1], p->high[1]);
    write_tics(f, "x", p->low[0], p->high[0]);
    write_tics(f, "y", p->low[1], p->high[1]);
    fprintf(f, "plot $line%d_0 using 1:2 with lines lc rgb '#bbbbbb' lw 4", index);
    for (int k = 1; k < 5; k++)
        fprintf(f, ", \\\n  $line%d_%d using 1:2 with lines lc rgb '%s' lw 1.2%s", index, k, styles[k].colour, k >= 3 ? " dt 3" : "");
    for (int s = 0; s < N_STYLES; s++)
        fprintf(f, ", \\\n  $points%d_%d using 1:2:3 with points pt variable ps %s lw 1.5 lc rgb '%s'", index, s, s == N_STYLES - 1 ? "large" : "small",
                styles[s].colour);
    fprintf(f, "\n");
}

// ---- the whole -------------------------------------------------------------------------------------------------------------

// What the marks mean, below all panels.
static void write_key(FILE *f, double width, double height, const char *caption)
{
    static const int order[] = { 5, 1, 2, 3, 4, 0 };
    double x = LEFT;
    fprintf(f, "\n# ---- key\nunset label; unset arrow\n");
    for (int k = 0; k < N_STYLES; k++) {
        const struct style *s = &styles[order[k]];
        fprintf(f, "set label '%s' at screen %.5f,%.5f left offset 1.2,0 point pt %d ps %s lc rgb '%s' tc rgb '%s'\n", s->text, x / width, 66 / height, s->filled,
                order[k] == 5 ? "large" : "small", s->colour, s->colour);
        x += 36 + CHARACTER_WIDTH * (double)strlen(s->text) + 10;
    }
    fprintf(f, "set label 'hollow: the solve says itself that it is not to be trusted. Grey: nothing cheaper is as good. Each line leaves the base in one setting.' "
               "at screen %.5f,%.5f left tc rgb '#444444'\n", (LEFT - 6) / width, 44 / height);
    fprintf(f, "set label '%s' at screen %.5f,%.5f left tc rgb '#444444'\n", caption, (LEFT - 6) / width, 22 / height);
}

// The sets in the order of their first rows; how many.
static int list_sets(const char **sets, const struct chart_row *rows, int n)
{
    int n_sets = 0;
    for (int i = 0; i < n; i++) {
        int k = 0;
        while (k < n_sets && strcmp(sets[k], rows[i].set))
            k++;
        if (k == n_sets)
            sets[n_sets++] = rows[i].set;
    }
    return n_sets;
}

static void write_script(FILE *f, const struct chart_row *rows, int n, const char **sets, int n_sets, const struct chart_row **line, struct panel *p,
                         const char *caption)
{
    const int columns = n_sets < 3 ? n_sets : n_sets == 4 ? 2 : 3, n_rows = N_MEASURES * ((n_sets + columns - 1) / columns);
    const double width = fmax(columns, 2) * PANEL_WIDTH, height = HEAD + FOOT + n_rows * PANEL_HEIGHT;
    // Data blocks cannot stand in a loop, so the script runs itself a second time.
    fprintf(f, "# drawn by rigsolve chart; to draw it again, here: gnuplot chart.gp\nset encoding utf8\nif (!exists('again')) { again = 0 }\n"
               "if (again) { set terminal pngcairo size %.0f,%.0f noenhanced font 'sans,9'; set output 'chart.png' }\n"
               "if (!again) { set terminal svg size %.0f,%.0f noenhanced font 'sans,11' background 'white'; set output 'chart.svg' }\n"
               "small = again ? 1.3 : .8; large = again ? 2 : 1.2 # marks\n", width, height, width, height);
    fprintf(f, "set multiplot\nset logscale xy\nset grid lt 1 lw .5 lc rgb '#dddddd'\nunset key\n");
    for (int k = 0; k < N_MEASURES * n_sets; k++) {
        const int set = k / N_MEASURES, measure = k % N_MEASURES, column = set % columns, row = N_MEASURES * (set / columns) + measure;
        const double x0 = column * PANEL_WIDTH, y1 = height - HEAD - row * PANEL_HEIGHT;
        *p = (struct panel){ .rows = rows, .n = n, .set = sets[set], .measure = measure,
                             .area = { x0 + LEFT, y1 - PANEL_HEIGHT + BOTTOM, x0 + PANEL_WIDTH - RIGHT, y1 - TOP, 0 } };
        fprintf(f, "set xlabel 'CPU seconds of the solve'\nset ylabel '%s'\n", column                       ? ""
                                                                                : measure == CHART_PICTURES ? "held-out views, rendered again: RMSE, % of white"
                                                                                                            : "held-out samples of texels: RMSE, % of white");
        write_panel(f, p, k, line, width, height);
    }
    write_key(f, width, height, caption);
    fprintf(f, "set label 'Speed against accuracy' at screen .5,%.5f center font ',14'\n"
               "unset border; unset tics; unset xlabel; unset ylabel; unset title; unset grid; unset logscale\nset xrange [0:1]; set yrange [0:1]\nplot -1\nunset multiplot\nset output\n"
               "if (!again) { again = 1; reset; load 'chart.gp' }\n", 1 - 20 / height);
}

static int run_gnuplot(const char *dir)
{
    char *argv[] = { "gnuplot", "chart.gp", NULL };
    posix_spawn_file_actions_t actions;
    pid_t child;
    int status = 0;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_addchdir_np(&actions, dir);
    posix_spawn_file_actions_addopen(&actions, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
    posix_spawn_file_actions_addopen(&actions, STDOUT_FILENO, "/dev/null", O_WRONLY, 0);
    const int err = posix_spawnp(&child, argv[0], &actions, NULL, argv, environ);
    posix_spawn_file_actions_destroy(&actions);
    if (err) {
        log_warning("chart: no picture: gnuplot cannot be started (%s); install it (Debian: apt-get install gnuplot-nox) and run this again, nothing is "
                    "solved twice; or elsewhere: gnuplot chart.gp in %s", strerror(err), dir);
        return -ENOENT;
    }
    while (waitpid(child, &status, 0) < 0 && errno == EINTR)
        ;
    if (!WIFEXITED(status) || WEXITSTATUS(status)) {
        log_error("chart: gnuplot could not draw %s/chart.gp (status %d); what it said stands above", dir, status);
        return -EIO;
    }
    return 0;
}

int chart_draw(const struct chart_row *rows, int n, const char *dir, const char *caption)
{
    struct atomic_file script;
    char *path = NULL;
    struct panel *panel = malloc(sizeof(*panel));
    const char **sets = calloc((size_t)n + 1, sizeof(*sets));
    const struct chart_row **line = calloc((size_t)n + 1, sizeof(*line));
    int err = panel && sets && line && asprintf(&path, "%s/chart.gp", dir) >= 0 ? 0 : -ENOMEM;
    if (!err)
        err = atomic_file_open(&script, path);
    if (!err) {
        write_script(script.stream, rows, n, sets, list_sets(sets, rows, n), line, panel, caption);
        err = atomic_file_commit(&script);
    }
    if (!err)
        err = run_gnuplot(dir);
    free(path);
    free(panel);
    free(sets);
    free(line);
    return err;
}
