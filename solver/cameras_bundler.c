// solver/cameras_bundler.c - Bundler's bundle.out, version 0.3.
//
// Bundler's cameras look along -z with +y up; names are in a list beside the file, sizes nowhere: the pictures tell.
#include "solver/cameras_format.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <errno.h>
#include <inttypes.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { MAX_LINE = 1024 };
static const size_t max_file_bytes = (size_t)4 << 30;

struct lines {
    const char *file, *at, *end;
    int64_t line;
};

// The next line, copied and terminated. A line without its end is refused: the file may have been cut short inside a number.
static int next_line(struct lines *l, char text[MAX_LINE])
{
    const char *newline = memchr(l->at, '\n', (size_t)(l->end - l->at));
    l->line++;
    if (!newline) {
        log_error("cameras: %s:%" PRId64 ": the file ends %s: it is cut short", l->file, l->line,
                  l->at == l->end ? "here; more lines were announced" : "within this line");
        return -EINVAL;
    }
    const size_t n = (size_t)(newline - l->at);
    if (n >= MAX_LINE || memchr(l->at, 0, n)) {
        log_error("cameras: %s:%" PRId64 ": expected a line of text of at most %d characters", l->file, l->line, MAX_LINE - 1);
        return -EINVAL;
    }
    memcpy(text, l->at, n);
    text[n] = 0;
    l->at = newline + 1;
    return 0;
}

static int next_numbers(struct lines *l, double *out, int n, const char *what)
{
    char text[MAX_LINE];
    const int err = next_line(l, text);
    if (!err && cameras_numbers(text, out, n)) {
        log_error("cameras: %s:%" PRId64 ": found '%.60s', expected %d numbers (%s)", l->file, l->line, text, n, what);
        return -EINVAL;
    }
    return err;
}

// The first word of the list's next line that has one.
static int next_name(struct lines *list, char text[MAX_LINE])
{
    int err;
    do
        err = next_line(list, text);
    while (!err && !text[strspn(text, " \t\r")]);
    if (err)
        return err;
    char *word = text + strspn(text, " \t\r");
    word[strcspn(word, " \t\r")] = 0;
    memmove(text, word, strlen(word) + 1);
    return 0;
}

// 1: *c is filled; 0: not registered.
static int read_camera(struct camera *c, struct lines *l, struct lines *list)
{
    double lens[3], P[9], t[3], R[9], centre[3];
    char name[MAX_LINE], where[4096 + 32];
    int err = next_name(list, name);
    if (!err)
        err = next_numbers(l, lens, 3, "f k1 k2");
    snprintf(where, sizeof(where), "%.4095s:%" PRId64, l->file, l->line);
    for (int i = 0; i < 3 && !err; i++)
        err = next_numbers(l, P + 3 * i, 3, "a row of the rotation");
    if (!err)
        err = next_numbers(l, t, 3, "the translation");
    if (err)
        return err;
    if (lens[0] == 0)
        return 0;
    if (camera_set_name(c, name, strlen(name))) {
        log_error("cameras: %s:%" PRId64 ": '%.60s' is no file name of up to %d characters", list->file, list->line, name,
                  CAMERA_NAME_MAX - 1);
        return -EINVAL;
    }
    for (int i = 0; i < 3; i++) { // diag(1, -1, -1): to our axes
        const double sign = i ? -1 : 1;
        for (int j = 0; j < 3; j++)
            R[3 * i + j] = sign * P[3 * i + j];
        t[i] *= sign;
    }
    mat3_tmul_vec(centre, R, t);
    for (int i = 0; i < 3; i++)
        centre[i] = -centre[i];
    c->fx = c->fy = lens[0];
    c->k[0] = lens[1], c->k[1] = lens[2];
    err = camera_set_pose(c, R, centre, where);
    return err ? err : 1;
}

int cameras_parse_bundler(struct cameras *out, const char *text, size_t n_text, const char *name, const char *list_text,
                          size_t n_list, const char *list_name, const struct cameras_source *s)
{
    struct lines l = { name, text, text + n_text, 0 }, list = { list_name, list_text, list_text + n_list, 0 };
    struct cameras c = { 0 };
    char line[MAX_LINE], first_left_out[CAMERA_NAME_MAX] = "";
    double counts[2];
    int n_left_out = 0;
    memset(out, 0, sizeof(*out));
    int err = next_line(&l, line);
    if (!err && (strncmp(line, "# Bundle file v0.3", 18) || line[18 + strspn(line + 18, " \r")])) {
        log_error("cameras: %s:1: found '%.40s', expected '# Bundle file v0.3': other versions are not read", name, line);
        err = -ENOTSUP;
    }
    if (!err)
        err = next_numbers(&l, counts, 2, "the counts of cameras and points");
    if (!err && !(counts[0] >= 0 && counts[0] <= (double)n_text / 10 && counts[0] == floor(counts[0]))) {
        log_error("cameras: %s:2: %g cameras announced, more than the file can hold", name, counts[0]);
        err = -EINVAL;
    }
    for (int64_t i = 0; !err && i < (int64_t)counts[0]; i++) {
        struct camera *view = cameras_add(&c);
        err = view ? read_camera(view, &l, &list) : -ENOMEM;
        if (err != 1)
            continue;
        err = 0;
        if (cameras_picture_size(s, view->name, &view->width_px, &view->height_px)) {
            if (n_left_out++ == 0)
                memcpy(first_left_out, view->name, sizeof(first_left_out));
            continue;
        }
        view->cx = .5 * view->width_px, view->cy = .5 * view->height_px;
        err = camera_check_lens(view, name);
        c.n += !err;
    }
    if (!err)
        err = cameras_log_left_out(name, n_left_out, first_left_out, c.n);
    if (!err)
        err = cameras_finish(&c, name);
    if (err) {
        cameras_free(&c);
        return err;
    }
    *out = c;
    return 0;
}

bool cameras_bundler_probe(const struct cameras_source *s)
{
    return !strncmp(s->head, "# Bundle file", 13);
}

// X.bundle.out has X.list.txt (COLMAP's way), X.out X.list.txt, and any its folder's list.txt. NULL: out of memory.
static char *list_of(const char *path)
{
    static const char *const endings[] = { ".bundle.out", "bundle.out", ".out" };
    const size_t n = strlen(path);
    char *list = NULL;
    for (size_t i = 0; i < 3; i++) {
        const size_t n_ending = strlen(endings[i]);
        if (n < n_ending || strcmp(path + n - n_ending, endings[i]))
            continue;
        if (asprintf(&list, "%.*s%slist.txt", (int)(n - n_ending), path, i == 1 ? "" : ".") < 0)
            return NULL;
        if (!access(list, F_OK))
            return list;
        free(list);
    }
    const char *slash = strrchr(path, '/');
    return asprintf(&list, "%.*slist.txt", slash ? (int)(slash + 1 - path) : 0, path) < 0 ? NULL : list;
}

int cameras_bundler_read(struct cameras *out, const struct cameras_source *s)
{
    char *text = NULL, *list = NULL, *list_path = list_of(s->path);
    size_t n_text, n_list;
    int err = list_path ? file_read(&text, &n_text, s->path, max_file_bytes) : -ENOMEM;
    if (!err && access(list_path, F_OK)) {
        log_error("cameras: %s: there is no %s beside it; Bundler's list of pictures, one name a line, says which camera is whose",
                  s->path, list_path);
        err = -ENOENT;
    }
    if (!err)
        err = file_read(&list, &n_list, list_path, max_file_bytes);
    if (!err)
        err = cameras_parse_bundler(out, text, n_text, s->path, list, n_list, list_path, s);
    free(text);
    free(list);
    free(list_path);
    return err;
}
