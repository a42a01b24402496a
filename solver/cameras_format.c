// solver/cameras_format.c - what the readers of camera files have in common: names, numbers, rotations, sizes of pictures.
#include "solver/cameras_format.h"
#include "solver/picture_size.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <errno.h>
#include <locale.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

enum { MAX_VIEWS = 1 << 20, MAX_SIZE_PX = 65536 };

// ---- views --------------------------------------------------------------------------------------------------------------

struct camera *cameras_add(struct cameras *c)
{
    const int n = c->n; // room for 64, then for the next power of two
    if (n >= MAX_VIEWS)
        return NULL;
    if (n == 0 || (n >= 64 && !(n & (n - 1)))) {
        struct camera *larger = realloc(c->view, (size_t)(n ? 2 * n : 64) * sizeof(*larger));
        if (!larger)
            return NULL;
        c->view = larger;
    }
    c->view[n] = (struct camera){ 0 };
    return &c->view[n];
}

int cameras_finish(struct cameras *c, const char *path)
{
    if (c->n == 0) {
        log_error("cameras: %s: no camera in it has a place: nothing was registered (aligned)", path);
        return -EINVAL;
    }
    return cameras_check_names(c, path);
}

int camera_set_name(struct camera *c, const char *file, size_t n_file)
{
    static const char separators[2] = { '/', '\\' }; // Windows tools write the other one
    for (int i = 0; i < 2; i++) {
        const char *slash = memrchr(file, separators[i], n_file);
        if (slash)
            n_file -= (size_t)(slash + 1 - file), file = slash + 1;
    }
    const char *dot = memrchr(file, '.', n_file);
    if (dot && dot > file)
        n_file = (size_t)(dot - file);
    if (n_file == 0 || n_file >= sizeof(c->name))
        return -EINVAL;
    for (size_t i = 0; i < n_file; i++)
        if ((unsigned char)file[i] < ' ' || file[i] == 0x7f)
            return -EINVAL;
    memcpy(c->name, file, n_file);
    c->name[n_file] = 0;
    return 0;
}

static int compare_names(const void *a, const void *b)
{
    const struct camera *const *x = a, *const *y = b;
    return strcmp((*x)->name, (*y)->name);
}

int cameras_check_names(const struct cameras *c, const char *path)
{
    int err = 0;
    const struct camera **sorted = malloc((size_t)c->n * sizeof(*sorted));
    if (!sorted)
        return -ENOMEM;
    for (int i = 0; i < c->n; i++)
        sorted[i] = &c->view[i];
    qsort(sorted, (size_t)c->n, sizeof(*sorted), compare_names);
    for (int i = 1; i < c->n && !err; i++)
        if (!strcmp(sorted[i - 1]->name, sorted[i]->name)) {
            log_error("cameras: %s: two images are called '%s' (folder and extension apart); rename one: views are known "
                      "by that name", path, sorted[i]->name);
            err = -EINVAL;
        }
    free(sorted);
    return err;
}


// A label is a name with or without an extension: only those of pictures are taken off.
int camera_set_label(struct camera *c, const char *label)
{
    static const char *const extensions[] = { "jpg", "jpeg", "tif", "tiff", "png", "exr", "hdr", "dng", "cr2", "cr3", "nef",
                                              "arw", "raf", "rw2", "orf",  "pef", "iiq", "3fr", "bmp", "jp2", "heic", "webp" };
    const char *dot = strrchr(label, '.');
    for (size_t i = 0; dot && i < sizeof(extensions) / sizeof(extensions[0]); i++)
        if (!strcasecmp(dot + 1, extensions[i]))
            return camera_set_name(c, label, strlen(label));
    char *with_extension = NULL;
    if (asprintf(&with_extension, "%s.x", label) < 0)
        return -ENOMEM;
    const int err = camera_set_name(c, with_extension, strlen(with_extension));
    free(with_extension);
    return err;
}

int cameras_by_name(const struct dirent **a, const struct dirent **b)
{
    return strcmp((*a)->d_name, (*b)->d_name);
}

// ---- numbers ------------------------------------------------------------------------------------------------------------

int cameras_numbers(const char *text, double *out, int n)
{
    const locale_t c_locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    int found = 0;
    bool good = c_locale != (locale_t)0;
    while (good) {
        text += strspn(text, " \t\r\n");
        if (!*text)
            break;
        const size_t length = strcspn(text, " \t\r\n");
        char *end;
        good = found < n && strspn(text, "+-.0123456789eE") == length; // strtod would also take hexadecimal, "inf" and "nan"
        if (good) {
            out[found] = strtod_l(text, &end, c_locale);
            good = end == text + length && isfinite(out[found]);
            found++;
        }
        text += length;
    }
    if (c_locale != (locale_t)0)
        freelocale(c_locale);
    return good && found == n ? 0 : -EINVAL;
}

// ---- geometry -----------------------------------------------------------------------------------------------------------

// The nearest rotation, by Newton's iteration for the polar decomposition: R <- (R + R^-T) / 2.
int cameras_make_rotation(double R[9])
{
    double off = 0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            off = fmax(off, fabs(vec3_dot(R + 3 * i, R + 3 * j) - (i == j)));
    if (!(off < .01))
        return -EINVAL;
    if (mat3_det(R) < 0)
        return -EDOM;
    for (int step = 0; step < 6; step++) {
        double cofactor[9];
        const double det = mat3_det(R);
        for (int i = 0; i < 3; i++)
            vec3_cross(cofactor + 3 * i, R + 3 * ((i + 1) % 3), R + 3 * ((i + 2) % 3));
        for (int i = 0; i < 9; i++)
            R[i] = .5 * (R[i] + cofactor[i] / det);
    }
    return 0;
}

int camera_set_pose(struct camera *c, const double cam_from_world[9], const double centre_m[3], const char *where)
{
    memcpy(c->cam_from_world, cam_from_world, sizeof(c->cam_from_world));
    const int err = cameras_make_rotation(c->cam_from_world);
    if (err) {
        log_error("cameras: %s: camera '%s': its nine numbers are %s; expected a rotation", where, c->name,
                  err == -EDOM ? "a mirrored rotation (determinant -1): the scene was mirrored on export" : "no rotation");
        return -EINVAL;
    }
    for (int i = 0; i < 3; i++) {
        if (!(fabs(centre_m[i]) < 1e15)) {
            log_error("cameras: %s: camera '%s' stands at (%g, %g, %g); expected finite numbers", where, c->name, centre_m[0],
                      centre_m[1], centre_m[2]);
            return -EINVAL;
        }
        c->centre_m[i] = centre_m[i];
    }
    mat3_mul_vec(c->t_m, c->cam_from_world, centre_m);
    for (int i = 0; i < 3; i++)
        c->t_m[i] = -c->t_m[i];
    return 0;
}

int camera_check_lens(const struct camera *c, const char *where)
{
    double sum = c->cx + c->cy + c->skew;
    for (int i = 0; i < 6; i++)
        sum += c->k[i];
    for (int i = 0; i < 4; i++)
        sum += c->p[i];
    if (c->width_px < 1 || c->width_px > MAX_SIZE_PX || c->height_px < 1 || c->height_px > MAX_SIZE_PX)
        log_error("cameras: %s: camera '%s': %d x %d pixels; expected 1 to %d a side", where, c->name, c->width_px, c->height_px,
                  MAX_SIZE_PX);
    else if (!(c->fx > 0 && c->fy > 0 && c->fx < 1e12 && c->fy < 1e12))
        log_error("cameras: %s: camera '%s' has focal lengths %g and %g px; expected positive ones", where, c->name, c->fx, c->fy);
    else if (!isfinite(sum))
        log_error("cameras: %s: camera '%s': its distortion or principal point is no finite number", where, c->name);
    else
        return 0;
    return -EINVAL;
}

// ---- sizes of pictures --------------------------------------------------------------------------------------------------

static int size_beside(const char *folder, size_t n_folder, const char *name, int *width_px, int *height_px)
{
    static const char *const extensions[] = { "exr", "tif",  "tiff", "png",  "hdr", "jpg",
                                              "jpeg", "EXR", "TIF",  "TIFF", "PNG", "JPG", "JPEG" };
    int err = -ENOENT;
    for (size_t i = 0; i < sizeof(extensions) / sizeof(extensions[0]) && err; i++) {
        char *path;
        if (asprintf(&path, "%.*s/%s.%s", (int)n_folder, folder, name, extensions[i]) < 0)
            return -ENOMEM;
        err = picture_size(width_px, height_px, path);
        free(path);
    }
    return err;
}

int cameras_picture_size(const struct cameras_source *s, const char *name, int *width_px, int *height_px)
{
    if (s->options->picture_size && !s->options->picture_size(s->options->arg, name, width_px, height_px))
        return 0;
    const char *slash = strrchr(s->path, '/');
    if (s->is_folder)
        return size_beside(s->path, strlen(s->path), name, width_px, height_px);
    return slash ? size_beside(s->path, (size_t)(slash - s->path), name, width_px, height_px)
                 : size_beside(".", 1, name, width_px, height_px);
}

int cameras_log_left_out(const char *path, int n_left_out, const char *first, int n_read)
{
    if (n_left_out == 0)
        return 0;
    if (n_read == 0) {
        log_error("cameras: %s does not say how large its pictures are, and no picture of its %d views was found ('%s' is the "
                  "first); expected NAME.exr (.tif, .png, .jpg) among the take's pictures or beside the file", path, n_left_out,
                  first);
        return -EINVAL;
    }
    log_warning("cameras: %s: %d of %d views are left out: there is no picture of theirs to tell its size ('%s' is the first)",
                path, n_left_out, n_left_out + n_read, first);
    return 0;
}
