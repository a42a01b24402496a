// solver/cameras_format.h - private to cameras*.c: a file format of cameras is one row of a table and one file of code.
#pragma once
#include "solver/cameras.h"
#include <stddef.h>

// What the user named, looked at once.
struct cameras_source {
    const char *path;
    bool is_folder;
    const char *head; // the file's first bytes ("" for a folder), NUL-terminated
    size_t n_head;
};

struct cameras_format {
    const char *name;
    bool (*probe)(const struct cameras_source *s);
    int (*read)(struct cameras *out, const struct cameras_source *s); // NULL: recognised, not read
};

bool cameras_colmap_probe(const struct cameras_source *s);
int cameras_colmap_read(struct cameras *out, const struct cameras_source *s);

// The same from memory; the names are for errors.
int cameras_parse_colmap_text(struct cameras *out, const char *cameras_text, size_t n_cameras_text, const char *cameras_name,
                              const char *images_text, size_t n_images_text, const char *images_name);
int cameras_parse_colmap_binary(struct cameras *out, const void *cameras_bin, size_t n_cameras_bin, const char *cameras_name,
                                const void *images_bin, size_t n_images_bin, const char *images_name);

// Copies the stem of file (last path component without its extension). 0, or -EINVAL (empty, too long, control characters).
int camera_set_name(struct camera *c, const char *file, size_t n_file);
// 0, or -EINVAL (logged): two views of one stem.
int cameras_check_names(const struct cameras *c, const char *path);
