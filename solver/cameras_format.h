// solver/cameras_format.h - private to cameras*.c: a file format of cameras is one row of a table and one file of code.
#pragma once
#include "solver/cameras.h"
#include <dirent.h>
#include <stddef.h>

// What the user named, looked at once.
struct cameras_source {
    const char *path;
    bool is_folder;
    bool is_listed; // found in the folder that the user named
    const char *head; // the file's first bytes ("" for a folder), NUL-terminated
    size_t n_head;
    const struct cameras_options *options; // never NULL
};

bool cameras_colmap_probe(const struct cameras_source *s);
int cameras_colmap_read(struct cameras *out, const struct cameras_source *s);
bool cameras_bundler_probe(const struct cameras_source *s);
int cameras_bundler_read(struct cameras *out, const struct cameras_source *s);
bool cameras_metashape_probe(const struct cameras_source *s);
int cameras_metashape_read(struct cameras *out, const struct cameras_source *s);
bool cameras_realitycapture_probe(const struct cameras_source *s);
int cameras_realitycapture_read(struct cameras *out, const struct cameras_source *s);
bool cameras_meshroom_probe(const struct cameras_source *s);
int cameras_meshroom_read(struct cameras *out, const struct cameras_source *s);

// The same from memory; the names are for errors. s tells the sizes of pictures where the text does not.
int cameras_parse_colmap_text(struct cameras *out, const char *cameras_text, size_t n_cameras_text, const char *cameras_name,
                              const char *images_text, size_t n_images_text, const char *images_name);
int cameras_parse_colmap_binary(struct cameras *out, const void *cameras_bin, size_t n_cameras_bin, const char *cameras_name,
                                const void *images_bin, size_t n_images_bin, const char *images_name);
int cameras_parse_bundler(struct cameras *out, const char *text, size_t n_text, const char *name, const char *list,
                          size_t n_list, const char *list_name, const struct cameras_source *s);
int cameras_parse_metashape(struct cameras *out, const char *text, size_t n_text, const struct cameras_source *s);
int cameras_parse_meshroom(struct cameras *out, const char *text, size_t n_text, const char *name);
int cameras_parse_realitycapture_csv(struct cameras *out, const char *text, size_t n_text, const struct cameras_source *s);
// One sidecar: 1 and *c (whose name, width and height are set before) if it places a camera, 0 if it does not (not registered,
// disabled, another program's sidecar).
int camera_parse_xmp(struct camera *c, const char *text, size_t n_text, const char *name);

// Readers append by filling what cameras_add() returns (zeroed; NULL: out of memory, or over 2^20 views) and counting n up.
struct camera *cameras_add(struct cameras *c);
int cameras_finish(struct cameras *c, const char *path); // -EINVAL (logged): none, or two of one name

// Copies the stem of file (last path component, / or \\, without its extension). 0, or -EINVAL (empty, too long, control
// characters; not logged).
int camera_set_name(struct camera *c, const char *file, size_t n_file);
int camera_set_label(struct camera *c, const char *label); // the same; what follows a dot stays unless a picture's extension
// 0, or -EINVAL (logged): two views of one stem.
int cameras_check_names(const struct cameras *c, const char *path);

int cameras_by_name(const struct dirent **a, const struct dirent **b); // for scandir: bytewise, in every locale

// Exactly n finite decimal numbers, separated by blanks. -EINVAL (not logged) otherwise.
int cameras_numbers(const char *text, double *out, int n);

// What is a rotation but for rounding becomes one to the last bit. -EINVAL: it is none; -EDOM: mirrored. Not logged.
int cameras_make_rotation(double R[9]);
int camera_set_pose(struct camera *c, const double cam_from_world[9], const double centre_m[3], const char *where);
int camera_check_lens(const struct camera *c, const char *where); // sizes, focal lengths, distortion. 0 or -EINVAL (logged)

// 0, or an error that is not logged: nobody knows.
int cameras_picture_size(const struct cameras_source *s, const char *name, int *width_px, int *height_px);
// After reading: a warning for views that were left out for want of a size; -EINVAL (logged) if that was all of them.
int cameras_log_left_out(const char *path, int n_left_out, const char *first, int n_read);
