// rigd/take_files.c - a path is taken apart, each part is looked at, and each folder is entered by itself: no link is followed.
#include "rigd/take_files.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum { PARTS_MAX = 3, PART_MAX_BYTES = 100 };

// '*': any plain name. what NULL: served, but not listed.
static const struct {
    const char *path, *what, *type;
} known[] = {
    { "sheet/linear.png", "contact sheet", "image/png" },
    { "sheet/thumbnails.png", "contact sheet (thumbnails)", "image/png" },
    { "solve/*/report.html", "report", "text/html; charset=utf-8" },
    { "solve/*/model.glb", "model", "model/gltf-binary" },
    { "thumbnails/*.jpg", NULL, "image/jpeg" },
};
enum { N_KNOWN = sizeof(known) / sizeof(known[0]) };

// Letters, digits, - and _, and dots but not in front: never "." or "..", never hidden.
static bool is_plain(const char *part, size_t n)
{
    static const char plain[] = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_.";
    return n && n < PART_MAX_BYTES && part[0] != '.' && strspn(part, plain) >= n;
}

// One part of a path against one of a pattern: equal, "*", or "*.jpg".
static bool part_matches(const char *pattern, size_t n_pattern, const char *part, size_t n)
{
    if (pattern[0] != '*')
        return n == n_pattern && !memcmp(pattern, part, n);
    return n > n_pattern - 1 && !memcmp(pattern + 1, part + n - (n_pattern - 1), n_pattern - 1);
}

static bool path_matches(const char *pattern, const char *path)
{
    for (;;) {
        const size_t n_pattern = strcspn(pattern, "/"), n = strcspn(path, "/");
        if (!is_plain(path, n) || !part_matches(pattern, n_pattern, path, n) || !pattern[n_pattern] != !path[n])
            return false;
        if (!path[n])
            return true;
        pattern += n_pattern + 1;
        path += n + 1;
    }
}

const char *take_file_type(const char *path)
{
    for (int i = 0; i < N_KNOWN; i++)
        if (path_matches(known[i].path, path))
            return known[i].type;
    return NULL;
}

// Enters folder `part` (n bytes) below fd, which is closed. -ENOENT for what is no folder, and for a link.
static int enter(int fd, const char *part, size_t n)
{
    char name[PART_MAX_BYTES];
    int next = -1;
    if (fd >= 0 && is_plain(part, n)) {
        memcpy(name, part, n);
        name[n] = 0;
        next = openat(fd, name, O_PATH | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC);
    }
    if (fd >= 0)
        close(fd);
    return next;
}

int take_file_open(const char *takes_dir, const char *id, const char *path, int64_t *size)
{
    struct stat st;
    *size = 0;
    if (!take_file_type(path))
        return -ENOENT;
    int fd = open(takes_dir, O_PATH | O_DIRECTORY | O_CLOEXEC);
    fd = enter(fd, id, strlen(id));
    for (const char *slash; (slash = strchr(path, '/')); path = slash + 1)
        fd = enter(fd, path, (size_t)(slash - path));
    if (fd < 0)
        return -ENOENT;
    const int file = openat(fd, path, O_RDONLY | O_NOFOLLOW | O_CLOEXEC | O_NONBLOCK);
    const int err = file < 0 ? (errno == ELOOP ? -ENOENT : -errno) : fstat(file, &st) ? -errno : S_ISREG(st.st_mode) ? 0 : -ENOENT;
    close(fd);
    if (err) {
        if (file >= 0)
            close(file);
        return err;
    }
    *size = st.st_size;
    return file;
}

static void add(struct json *list, const char *take_dir, const char *what, const char *path)
{
    char full[900];
    struct stat st;
    if (snprintf(full, sizeof(full), "%s/%s", take_dir, path) >= (int)sizeof(full) || lstat(full, &st) || !S_ISREG(st.st_mode))
        return;
    struct json *o = json_new_object();
    json_set_string(o, "what", what);
    json_set_string(o, "path", path);
    json_append(list, o);
}

struct json *take_files_list(const char *take_dir)
{
    struct json *list = json_new_array();
    struct dirent **solves = NULL;
    char dir[700];
    snprintf(dir, sizeof(dir), "%s/solve", take_dir);
    const int n = scandir(dir, &solves, NULL, alphasort);
    for (int i = 0; i < N_KNOWN; i++) {
        const char *star = known[i].what ? strchr(known[i].path, '*') : NULL;
        if (known[i].what && !star)
            add(list, take_dir, known[i].what, known[i].path);
        for (int k = 0; star && k < n; k++) {
            char path[PART_MAX_BYTES + 40];
            const char *name = solves[k]->d_name;
            if (!is_plain(name, strlen(name)))
                continue;
            if (snprintf(path, sizeof(path), "%.*s%s%s", (int)(star - known[i].path), known[i].path, name, star + 1) < (int)sizeof(path))
                add(list, take_dir, known[i].what, path);
        }
    }
    for (int i = 0; i < n; i++)
        free(solves[i]);
    free(solves);
    return list;
}
