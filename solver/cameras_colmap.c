// solver/cameras_colmap.c - COLMAP's cameras and images, text and binary.
//
// Points are skipped, rigs and frames (newer versions) ignored: the pose in `images` is always whole. COLMAP's pixel convention
// is ours. Every model COLMAP knows is in the table, so that a file may hold cameras that no image uses.
#include "solver/cameras_format.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <errno.h>
#include <inttypes.h>
#include <locale.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { MAX_PARAMS = 16, MAX_SIZE_PX = 65536, MAX_VIEWS = 1 << 20, NAME_LIMIT = 4096 };
static const size_t max_file_bytes = (size_t)4 << 30;

// Where each parameter goes: f = fx and fy, F = fx, G = fy, c = cx, d = cy, 1..6 = k, p q = p1 p2; NULL: not read.
static const struct {
    const char *name;
    int n_params;
    enum camera_model model;
    const char *places;
} models[] = {
    { "SIMPLE_PINHOLE", 3, CAMERA_BROWN, "fcd" },
    { "PINHOLE", 4, CAMERA_BROWN, "FGcd" },
    { "SIMPLE_RADIAL", 4, CAMERA_BROWN, "fcd1" },
    { "RADIAL", 5, CAMERA_BROWN, "fcd12" },
    { "OPENCV", 8, CAMERA_BROWN, "FGcd12pq" },
    { "OPENCV_FISHEYE", 8, CAMERA_FISHEYE, "FGcd1234" },
    { "FULL_OPENCV", 12, CAMERA_RATIONAL, "FGcd12pq3456" },
    { "FOV", 5, 0, NULL },
    { "SIMPLE_RADIAL_FISHEYE", 4, CAMERA_FISHEYE, "fcd1" },
    { "RADIAL_FISHEYE", 5, CAMERA_FISHEYE, "fcd12" },
    { "THIN_PRISM_FISHEYE", 12, 0, NULL },
    { "RAD_TAN_THIN_PRISM_FISHEYE", 16, 0, NULL },
    { "SIMPLE_DIVISION", 4, 0, NULL },
    { "DIVISION", 5, 0, NULL },
    { "SIMPLE_FISHEYE", 3, 0, NULL },
    { "FISHEYE", 4, 0, NULL },
    { "EUCM", 6, 0, NULL },
    { "EQUIRECTANGULAR", 2, 0, NULL },
};
enum { PINHOLE = 1, OPENCV = 4, OPENCV_FISHEYE = 5, FULL_OPENCV = 6, N_MODELS = sizeof(models) / sizeof(models[0]) };

static double *place_of(struct camera *c, char place)
{
    switch (place) {
    case 'f':
    case 'F':
        return &c->fx;
    case 'G':
        return &c->fy;
    case 'c':
        return &c->cx;
    case 'd':
        return &c->cy;
    case 'p':
        return &c->p[0];
    case 'q':
        return &c->p[1];
    default:
        return &c->k[place - '1'];
    }
}

// A row of `cameras`, and a row of `images`, whichever file they came from.
struct intrinsics {
    uint32_t id;
    int model;
    uint64_t width_px, height_px;
    double params[MAX_PARAMS];
};
struct pose {
    double q[4], t_m[3]; // w, x, y, z; world to camera
    uint32_t camera_id;
    const char *name; // not terminated
    size_t n_name;
};

// A file being read: text by lines, binary by bytes. Errors name the place that `at` was at when the row began.
struct reader {
    const char *file;
    const char *begin, *at, *end;
    int64_t line; // 0: binary, places are offsets
    const char *row;
    locale_t c_locale;
};

__attribute__((format(printf, 2, 3))) static int invalid(const struct reader *r, const char *format, ...)
{
    char what[512];
    va_list args;
    va_start(args, format);
    vsnprintf(what, sizeof(what), format, args);
    va_end(args);
    if (r->line)
        log_error("cameras: %s:%" PRId64 ": %s", r->file, r->line, what);
    else
        log_error("cameras: %s: offset %td: %s", r->file, r->row - r->begin, what);
    return -EINVAL;
}

static int check_intrinsics(const struct reader *r, const struct intrinsics *in)
{
    if (in->width_px < 1 || in->width_px > MAX_SIZE_PX || in->height_px < 1 || in->height_px > MAX_SIZE_PX)
        return invalid(r, "camera %" PRIu32 ": %" PRIu64 " x %" PRIu64 " pixels; expected 1 to %d a side", in->id,
                       in->width_px, in->height_px, MAX_SIZE_PX);
    for (int i = 0; i < models[in->model].n_params; i++)
        if (!isfinite(in->params[i]))
            return invalid(r, "camera %" PRIu32 ": parameter %d is not a finite number", in->id, i + 1);
    return 0;
}

static int compare_intrinsics(const void *a, const void *b)
{
    const struct intrinsics *x = a, *y = b;
    return x->id < y->id ? -1 : x->id > y->id;
}

static int sort_intrinsics(struct intrinsics *all, int n, const char *file)
{
    if (n > 0)
        qsort(all, (size_t)n, sizeof(*all), compare_intrinsics);
    for (int i = 1; i < n; i++)
        if (all[i - 1].id == all[i].id) {
            log_error("cameras: %s: two cameras have the id %" PRIu32 "; ids must differ", file, all[i].id);
            return -EINVAL;
        }
    return 0;
}

static int make_camera(struct camera *c, const struct reader *r, const struct pose *pose,
                       const struct intrinsics *all, int n_all)
{
    *c = (struct camera){ 0 };
    const int n_shown = pose->n_name < 200 ? (int)pose->n_name : 200;
    if (camera_set_name(c, pose->name, pose->n_name))
        return invalid(r, "image name '%.*s': expected 1 to %d characters apart from folder and extension, none of them "
                       "control characters", n_shown, pose->name, CAMERA_NAME_MAX - 1);
    double norm2 = 0;
    for (int i = 0; i < 4; i++)
        norm2 += pose->q[i] * pose->q[i];
    if (!(norm2 > 1e-12 && norm2 < 1e12))
        return invalid(r, "image '%s': quaternion (%g, %g, %g, %g): expected a rotation", c->name, pose->q[0],
                       pose->q[1], pose->q[2], pose->q[3]);
    for (int i = 0; i < 3; i++)
        if (!(fabs(pose->t_m[i]) < 1e15))
            return invalid(r, "image '%s': translation (%g, %g, %g): expected finite numbers", c->name, pose->t_m[0],
                           pose->t_m[1], pose->t_m[2]);
    const struct intrinsics *in = n_all ? bsearch(&(struct intrinsics){ .id = pose->camera_id }, all, (size_t)n_all,
                                                  sizeof(*all), compare_intrinsics) : NULL;
    if (!in)
        return invalid(r, "image '%s' uses camera %" PRIu32 ", which is not in the cameras file", c->name,
                       pose->camera_id);
    if (!models[in->model].places) {
        (void)invalid(r, "image '%s' uses camera model %s, which is not read; undistort the images (colmap "
                      "image_undistorter), or calibrate with OPENCV, FULL_OPENCV or OPENCV_FISHEYE", c->name,
                      models[in->model].name);
        return -ENOTSUP;
    }
    c->width_px = (int)in->width_px, c->height_px = (int)in->height_px;
    c->model = models[in->model].model;
    const char *places = models[in->model].places;
    for (int i = 0; places[i]; i++)
        *place_of(c, places[i]) = in->params[i];
    if (places[0] == 'f')
        c->fy = c->fx;
    if (!(c->fx > 0 && c->fy > 0))
        return invalid(r, "image '%s': camera %" PRIu32 " has focal lengths %g and %g; expected positive ones",
                       c->name, in->id, c->fx, c->fy);
    const double s = 1 / sqrt(norm2);
    const double w = pose->q[0] * s, x = pose->q[1] * s, y = pose->q[2] * s, z = pose->q[3] * s;
    const double R[9] = {
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
        2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y),
    };
    memcpy(c->cam_from_world, R, sizeof(R));
    memcpy(c->t_m, pose->t_m, sizeof(c->t_m));
    mat3_tmul_vec(c->centre_m, R, c->t_m);
    for (int i = 0; i < 3; i++)
        c->centre_m[i] = -c->centre_m[i];
    return 0;
}

// ---- text ---------------------------------------------------------------------------------------------------------------

// The next line as [*text, *end), without its line end. False at the end of the file; *whole: it had a line end.
static bool next_line(struct reader *r, const char **text, const char **end, bool *whole)
{
    if (r->at == r->end)
        return false;
    const char *newline = memchr(r->at, '\n', (size_t)(r->end - r->at));
    *text = r->at;
    *end = newline ? newline : r->end;
    *whole = newline;
    r->at = newline ? newline + 1 : r->end;
    r->line++;
    if (*end > *text && (*end)[-1] == '\r')
        --*end;
    return true;
}

static bool is_blank(char c)
{
    return c == ' ' || c == '\t' || c == '\r' || c == '\v' || c == '\f';
}

// The next word of a line; its length, 0 at the end.
static size_t next_word(const char **at, const char *end, const char **word)
{
    while (*at < end && is_blank(**at))
        ++*at;
    *word = *at;
    while (*at < end && !is_blank(**at))
        ++*at;
    return (size_t)(*at - *word);
}

static int take_number(struct reader *r, const char **at, const char *end, const char *what, double *out)
{
    char text[64], *rest;
    const char *word;
    const size_t n = next_word(at, end, &word);
    if (n == 0)
        return invalid(r, "%s is missing", what);
    if (n < sizeof(text)) {
        memcpy(text, word, n);
        text[n] = 0;
        *out = strtod_l(text, &rest, r->c_locale);
        if (rest == text + n && isfinite(*out))
            return 0;
    }
    return invalid(r, "%s is '%.*s'; expected a finite number", what, n < 60 ? (int)n : 60, word);
}

static int take_integer(struct reader *r, const char **at, const char *end, const char *what, uint64_t max,
                        uint64_t *out)
{
    const char *word;
    const size_t n = next_word(at, end, &word);
    uint64_t value = 0;
    bool good = n > 0 && n < 20;
    for (size_t i = 0; good && i < n; i++) {
        good = word[i] >= '0' && word[i] <= '9';
        value = 10 * value + (uint64_t)(word[i] - '0');
    }
    if (!good || value > max)
        return invalid(r, "%s is '%.*s'; expected a whole number up to %" PRIu64, what, n < 60 ? (int)n : 60, word, max);
    *out = value;
    return 0;
}

// "# Number of images: 85, ..." tells a truncated file from a whole one. -1: the line says nothing of the kind.
static int64_t announced(const char *text, const char *end, const char *key)
{
    const char *found = memmem(text, (size_t)(end - text), key, strlen(key));
    if (!found)
        return -1;
    int64_t n = 0;
    for (const char *c = found + strlen(key); c < end && *c >= '0' && *c <= '9' && n < MAX_VIEWS; c++)
        n = 10 * n + (*c - '0');
    return n;
}

static int check_announced(const struct reader *r, int64_t n_announced, int n, const char *what)
{
    if (n >= n_announced)
        return 0;
    return invalid(r, "the file ends after %d %s; its heading announces %" PRId64 ": it is cut short (or edited: then "
                   "correct the heading)", n, what, n_announced);
}

static int grow(void **array, int n, int *capacity, size_t size)
{
    if (n < *capacity)
        return 0;
    const int wanted = *capacity ? 2 * *capacity : 64;
    void *bigger = realloc(*array, (size_t)wanted * size);
    if (!bigger)
        return -ENOMEM;
    *array = bigger, *capacity = wanted;
    return 0;
}

static int parse_camera_line(struct reader *r, const char *at, const char *end, struct intrinsics *in)
{
    uint64_t id;
    const char *word;
    *in = (struct intrinsics){ .model = -1 };
    int err = take_integer(r, &at, end, "the camera id", UINT32_MAX, &id);
    if (err)
        return err;
    in->id = (uint32_t)id;
    const size_t n = next_word(&at, end, &word);
    for (int i = 0; i < N_MODELS; i++)
        if (n == strlen(models[i].name) && !memcmp(models[i].name, word, n))
            in->model = i;
    if (in->model < 0)
        return invalid(r, "camera model '%.*s' is not one of COLMAP's", n < 60 ? (int)n : 60, word);
    err = take_integer(r, &at, end, "the image width", MAX_SIZE_PX, &in->width_px);
    if (!err)
        err = take_integer(r, &at, end, "the image height", MAX_SIZE_PX, &in->height_px);
    for (int i = 0; i < models[in->model].n_params && !err; i++)
        err = take_number(r, &at, end, "a camera parameter", &in->params[i]);
    if (!err && next_word(&at, end, &word))
        err = invalid(r, "more numbers than the %d parameters of %s", models[in->model].n_params, models[in->model].name);
    return err ? err : check_intrinsics(r, in);
}

static int read_cameras_text(struct intrinsics **out, int *n_out, struct reader *r)
{
    int err = 0, n = 0, capacity = 0;
    int64_t n_announced = 0;
    struct intrinsics *all = NULL;
    const char *text, *end;
    bool whole;
    while (!err && next_line(r, &text, &end, &whole)) {
        while (text < end && is_blank(*text))
            text++;
        if (text == end)
            continue;
        if (*text == '#') {
            const int64_t said = announced(text, end, "Number of cameras: ");
            n_announced = said > n_announced ? said : n_announced;
            continue;
        }
        err = !whole ? invalid(r, "the file ends within this line: it is cut short (or lacks its last line end)")
              : n >= MAX_VIEWS ? invalid(r, "more than %d cameras", MAX_VIEWS)
                               : grow((void **)&all, n, &capacity, sizeof(*all));
        if (!err)
            err = parse_camera_line(r, text, end, &all[n]);
        n += !err;
    }
    if (!err)
        err = check_announced(r, n_announced, n, "cameras");
    if (!err)
        err = sort_intrinsics(all, n, r->file);
    if (err) {
        free(all);
        return err;
    }
    *out = all, *n_out = n;
    return 0;
}

static int parse_image_line(struct reader *r, const char *at, const char *end, struct pose *pose)
{
    static const char *const names[7] = { "QW", "QX", "QY", "QZ", "TX", "TY", "TZ" };
    uint64_t id;
    int err = take_integer(r, &at, end, "the image id", UINT32_MAX, &id);
    for (int i = 0; i < 7 && !err; i++)
        err = take_number(r, &at, end, names[i], i < 4 ? &pose->q[i] : &pose->t_m[i - 4]);
    if (!err)
        err = take_integer(r, &at, end, "the camera id", UINT32_MAX, &id);
    if (err)
        return err;
    pose->camera_id = (uint32_t)id;
    while (at < end && is_blank(*at))
        at++;
    while (end > at && is_blank(end[-1]))
        end--;
    pose->name = at, pose->n_name = (size_t)(end - at); // may hold blanks
    return 0;
}

// The line of points: triples of numbers, or nothing. Catches files that lack these lines altogether.
static int check_points_line(struct reader *r, const char *at, const char *end)
{
    const char *word;
    int64_t n_words = 0;
    for (size_t n; (n = next_word(&at, end, &word)); n_words++)
        for (size_t i = 0; i < n; i++)
            if (!strchr("0123456789+-.eEnaif", word[i]) || !word[i])
                return invalid(r, "'%.*s' in the line of 2-D points that follows each image; expected X Y POINT3D_ID "
                               "triples, or an empty line", n < 60 ? (int)n : 60, word);
    if (n_words % 3)
        return invalid(r, "%" PRId64 " words in the line of 2-D points that follows each image; expected X Y POINT3D_ID "
                       "triples, or an empty line", n_words);
    return 0;
}

static int read_images_text(struct cameras *out, struct reader *r, const struct intrinsics *all, int n_all)
{
    int err = 0, capacity = 0;
    int64_t n_announced = 0;
    const char *text, *end;
    bool whole;
    while (!err && next_line(r, &text, &end, &whole)) {
        while (text < end && is_blank(*text))
            text++;
        if (text == end)
            continue;
        if (*text == '#') {
            const int64_t said = announced(text, end, "Number of images: ");
            n_announced = said > n_announced ? said : n_announced;
            continue;
        }
        struct pose pose;
        err = !whole ? invalid(r, "the file ends within this line: it is cut short (or lacks its last line end)")
              : out->n >= MAX_VIEWS ? invalid(r, "more than %d images", MAX_VIEWS)
                                    : grow((void **)&out->view, out->n, &capacity, sizeof(*out->view));
        if (!err)
            err = parse_image_line(r, text, end, &pose);
        if (!err)
            err = make_camera(&out->view[out->n], r, &pose, all, n_all);
        if (err)
            break;
        out->n++;
        if (next_line(r, &text, &end, &whole)) // the points: this line even if it is empty
            err = check_points_line(r, text, end);
    }
    return err ? err : check_announced(r, n_announced, out->n, "images");
}

// ---- binary, little endian ----------------------------------------------------------------------------------------------

static size_t n_left(const struct reader *r)
{
    return (size_t)(r->end - r->at);
}

static int take_bits(struct reader *r, int n_bytes, uint64_t *out)
{
    *out = 0;
    if (n_left(r) < (size_t)n_bytes)
        return invalid(r, "the file ends at offset %td, inside what begins here: it is cut short", r->end - r->begin);
    uint64_t value = 0;
    for (int i = 0; i < n_bytes; i++)
        value |= (uint64_t)(unsigned char)r->at[i] << 8 * i;
    r->at += n_bytes;
    *out = value;
    return 0;
}

static int take_u32(struct reader *r, uint32_t *out)
{
    uint64_t bits;
    const int err = take_bits(r, 4, &bits);
    *out = (uint32_t)bits;
    return err;
}

static int take_f64(struct reader *r, double *out)
{
    uint64_t bits;
    const int err = take_bits(r, 8, &bits);
    memcpy(out, &bits, sizeof(bits));
    return err;
}

// A count of things of at least min_bytes each, believed only if the file is long enough for them.
static int take_count(struct reader *r, size_t min_bytes, const char *what, uint64_t *out)
{
    const int err = take_bits(r, 8, out);
    if (err)
        return err;
    if (*out > n_left(r) / min_bytes)
        return invalid(r, "%" PRIu64 " %s announced, but only %zu bytes follow: the file is cut short or broken", *out, what,
                       n_left(r));
    return 0;
}

static int check_end(struct reader *r)
{
    r->row = r->at;
    return n_left(r) ? invalid(r, "%zu bytes after the last record: the file is broken", n_left(r)) : 0;
}

static int read_cameras_binary(struct intrinsics **out, int *n_out, struct reader *r)
{
    uint64_t n;
    struct intrinsics *all = NULL;
    int err = take_count(r, 4 + 4 + 8 + 8 + 2 * 8, "cameras", &n);
    if (err)
        return err;
    if (n > MAX_VIEWS)
        return invalid(r, "more than %d cameras", MAX_VIEWS);
    all = calloc(n + 1, sizeof(*all));
    if (!all)
        return -ENOMEM;
    for (uint64_t i = 0; i < n && !err; i++) {
        struct intrinsics *in = &all[i];
        uint32_t model = 0;
        r->row = r->at;
        err = take_u32(r, &in->id);
        if (!err)
            err = take_u32(r, &model);
        if (!err && model >= N_MODELS)
            err = invalid(r, "camera %" PRIu32 " has model number %" PRIu32 "; COLMAP's go from 0 to %d", in->id, model,
                          N_MODELS - 1);
        if (!err)
            err = take_bits(r, 8, &in->width_px);
        if (!err)
            err = take_bits(r, 8, &in->height_px);
        in->model = (int)model;
        for (int k = 0; !err && k < models[in->model].n_params; k++)
            err = take_f64(r, &in->params[k]);
        if (!err)
            err = check_intrinsics(r, in);
    }
    if (!err)
        err = check_end(r);
    if (!err)
        err = sort_intrinsics(all, (int)n, r->file);
    if (err) {
        free(all);
        return err;
    }
    *out = all, *n_out = (int)n;
    return 0;
}

static int read_images_binary(struct cameras *out, struct reader *r, const struct intrinsics *all, int n_all)
{
    uint64_t n;
    int err = take_count(r, 4 + 7 * 8 + 4 + 2 + 8, "images", &n);
    if (err)
        return err;
    if (n > MAX_VIEWS)
        return invalid(r, "more than %d images", MAX_VIEWS);
    out->view = calloc(n + 1, sizeof(*out->view));
    if (!out->view)
        return -ENOMEM;
    for (uint64_t i = 0; i < n && !err; i++) {
        struct pose pose;
        uint32_t id;
        uint64_t n_points = 0;
        r->row = r->at;
        err = take_u32(r, &id);
        for (int k = 0; k < 7 && !err; k++)
            err = take_f64(r, k < 4 ? &pose.q[k] : &pose.t_m[k - 4]);
        if (!err)
            err = take_u32(r, &pose.camera_id);
        if (err)
            break;
        const char *nul = memchr(r->at, 0, n_left(r) < NAME_LIMIT ? n_left(r) : NAME_LIMIT);
        if (!nul)
            return invalid(r, "the image's name does not end within %d bytes: the file is cut short or broken", NAME_LIMIT);
        pose.name = r->at, pose.n_name = (size_t)(nul - r->at);
        r->at = nul + 1;
        err = take_count(r, 8 + 8 + 8, "2-D points", &n_points);
        if (err)
            break;
        r->at += n_points * 24;
        err = make_camera(&out->view[out->n], r, &pose, all, n_all);
        out->n += !err;
    }
    return err ? err : check_end(r);
}

// ---- reading ------------------------------------------------------------------------------------------------------------

typedef int read_cameras_function(struct intrinsics **out, int *n_out, struct reader *r);
typedef int read_images_function(struct cameras *out, struct reader *r, const struct intrinsics *all, int n_all);

static int parse(struct cameras *out, struct reader *of_cameras, read_cameras_function *read_cameras,
                 struct reader *of_images, read_images_function *read_images)
{
    struct intrinsics *all = NULL;
    int n_all = 0;
    struct cameras c = { 0 };
    memset(out, 0, sizeof(*out));
    int err = read_cameras(&all, &n_all, of_cameras);
    if (!err)
        err = read_images(&c, of_images, all, n_all);
    if (!err && c.n == 0) {
        log_error("cameras: %s: no images: nothing was registered", of_images->file);
        err = -EINVAL;
    }
    if (!err)
        err = cameras_check_names(&c, of_images->file);
    if (err == -ENOMEM)
        log_error("cameras: %s: %s", of_images->file, strerror(ENOMEM));
    free(all);
    if (err) {
        cameras_free(&c);
        return err;
    }
    *out = c;
    return 0;
}

int cameras_parse_colmap_text(struct cameras *out, const char *cameras_text, size_t n_cameras_text, const char *cameras_name,
                              const char *images_text, size_t n_images_text, const char *images_name)
{
    const locale_t c_locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    memset(out, 0, sizeof(*out));
    if (!c_locale)
        return -ENOMEM;
    struct reader a = { cameras_name, cameras_text, cameras_text, cameras_text + n_cameras_text, 0, NULL, c_locale };
    struct reader b = { images_name, images_text, images_text, images_text + n_images_text, 0, NULL, c_locale };
    const int err = parse(out, &a, read_cameras_text, &b, read_images_text);
    freelocale(c_locale);
    return err;
}

int cameras_parse_colmap_binary(struct cameras *out, const void *cameras_bin, size_t n_cameras_bin, const char *cameras_name,
                                const void *images_bin, size_t n_images_bin, const char *images_name)
{
    const char *p = cameras_bin, *q = images_bin;
    struct reader a = { cameras_name, p, p, p + n_cameras_bin, 0, p, (locale_t)0 };
    struct reader b = { images_name, q, q, q + n_images_bin, 0, q, (locale_t)0 };
    return parse(out, &a, read_cameras_binary, &b, read_images_binary);
}

// The folder that holds the model: path itself, or that of the one file the user named.
static char *folder_of(const struct cameras_source *s)
{
    char *folder = strdup(s->path);
    if (!folder || s->is_folder)
        return folder;
    char *slash = strrchr(folder, '/');
    if (slash && slash > folder)
        *slash = 0;
    else
        memcpy(folder, slash ? "/" : ".", 2); // the path has a file's name: there is room
    return folder;
}

static bool has_pair(const char *folder, const char *extension)
{
    static const char *const names[2] = { "cameras", "images" };
    for (int i = 0; i < 2; i++) {
        char *path;
        if (asprintf(&path, "%s/%s.%s", folder, names[i], extension) < 0)
            return false;
        const bool there = !access(path, F_OK);
        free(path);
        if (!there)
            return false;
    }
    return true;
}

bool cameras_colmap_probe(const struct cameras_source *s)
{
    if (!s->is_folder) {
        const char *slash = strrchr(s->path, '/'), *name = slash ? slash + 1 : s->path;
        if (strcmp(name, "cameras.txt") && strcmp(name, "images.txt") && strcmp(name, "points3D.txt") &&
            strcmp(name, "cameras.bin") && strcmp(name, "images.bin") && strcmp(name, "points3D.bin"))
            return false;
    }
    char *folder = folder_of(s);
    const bool found = folder && (has_pair(folder, "bin") || has_pair(folder, "txt"));
    free(folder);
    return found;
}

int cameras_colmap_read(struct cameras *out, const struct cameras_source *s)
{
    int err = -ENOMEM;
    char *path[2] = { NULL, NULL }, *data[2] = { NULL, NULL };
    size_t n[2] = { 0, 0 };
    char *folder = folder_of(s);
    if (!folder)
        goto fail;
    const bool binary = has_pair(folder, "bin");
    for (int i = 0; i < 2; i++) {
        err = -ENOMEM;
        if (asprintf(&path[i], "%s/%s.%s", folder, i ? "images" : "cameras", binary ? "bin" : "txt") < 0) {
            path[i] = NULL;
            goto fail;
        }
        err = file_read(&data[i], &n[i], path[i], max_file_bytes);
        if (err)
            goto fail;
    }
    err = binary ? cameras_parse_colmap_binary(out, data[0], n[0], path[0], data[1], n[1], path[1])
                 : cameras_parse_colmap_text(out, data[0], n[0], path[0], data[1], n[1], path[1]);
fail:
    free(folder);
    for (int i = 0; i < 2; i++) {
        free(path[i]);
        free(data[i]);
    }
    return err;
}

// ---- writing ------------------------------------------------------------------------------------------------------------

// The simplest model that says the same. -ENOTSUP (logged): COLMAP has none.
static int colmap_model_of(const struct camera *c)
{
    const double *k = c->k, *p = c->p;
    const char *what = NULL;
    if (c->skew != 0)
        what = "skew";
    else if (c->model == CAMERA_BROWN && k[3] != 0)
        what = "k4 (r^8)";
    else if (c->model == CAMERA_FISHEYE && (p[0] != 0 || p[1] != 0))
        what = "p1 or p2 in a fisheye";
    else if (c->model != CAMERA_FISHEYE && (p[2] != 0 || p[3] != 0) && (p[0] != 0 || p[1] != 0))
        what = "p3 or p4";
    if (what) {
        log_error("cameras: view '%s' has %s, which no camera model of COLMAP can hold: undistort the images first", c->name,
                  what);
        return -ENOTSUP;
    }
    if (c->model == CAMERA_FISHEYE)
        return OPENCV_FISHEYE;
    if (c->model == CAMERA_RATIONAL || k[2] != 0)
        return FULL_OPENCV;
    return k[0] != 0 || k[1] != 0 || p[0] != 0 || p[1] != 0 ? OPENCV : PINHOLE;
}

// Shepperd: divides by the largest of the four. w >= 0.
static void quaternion_of(double q[4], const double R[9])
{
    const double trace = R[0] + R[4] + R[8];
    const double square[4] = { 1 + trace, 1 + 2 * R[0] - trace, 1 + 2 * R[4] - trace, 1 + 2 * R[8] - trace };
    int big = 0;
    for (int i = 1; i < 4; i++)
        if (square[i] > square[big])
            big = i;
    // 4 q_i q_j for each pair
    const double wx = R[7] - R[5], wy = R[2] - R[6], wz = R[3] - R[1];
    const double xy = R[1] + R[3], xz = R[2] + R[6], yz = R[5] + R[7];
    const double rows[4][4] = {
        { square[0], wx, wy, wz }, { wx, square[1], xy, xz }, { wy, xy, square[2], yz }, { wz, xz, yz, square[3] },
    };
    double norm = 0;
    for (int i = 0; i < 4; i++)
        norm += rows[big][i] * rows[big][i];
    norm = copysign(sqrt(norm), rows[big][0] < 0 ? -1 : 1);
    for (int i = 0; i < 4; i++)
        q[i] = rows[big][i] / norm;
}

static void put_bits(FILE *f, uint64_t value, int n_bytes)
{
    for (int i = 0; i < n_bytes; i++)
        putc((int)(value >> 8 * i & 0xff), f);
}

static void put_f64(FILE *f, double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof(bits));
    put_bits(f, bits, 8);
}

static void put_cameras(FILE *f, const struct cameras *c, bool binary)
{
    if (binary)
        put_bits(f, (uint64_t)c->n, 8);
    else
        fprintf(f, "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
                   "# Number of cameras: %d\n", c->n);
    for (int i = 0; i < c->n; i++) {
        struct camera view = c->view[i];
        const int model = colmap_model_of(&view);
        if (binary) {
            put_bits(f, (uint64_t)i + 1, 4);
            put_bits(f, (uint64_t)model, 4);
            put_bits(f, (uint64_t)view.width_px, 8);
            put_bits(f, (uint64_t)view.height_px, 8);
        } else {
            fprintf(f, "%d %s %d %d", i + 1, models[model].name, view.width_px, view.height_px);
        }
        for (const char *place = models[model].places; *place; place++) {
            const double value = *place_of(&view, *place);
            if (binary)
                put_f64(f, value);
            else
                fprintf(f, " %.17g", value);
        }
        if (!binary)
            putc('\n', f);
    }
}

static void put_images(FILE *f, const struct cameras *c, bool binary)
{
    if (binary)
        put_bits(f, (uint64_t)c->n, 8);
    else
        fprintf(f, "# Image list with two lines of data per image:\n"
                   "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
                   "#   POINTS2D[] as (X, Y, POINT3D_ID)\n# Number of images: %d, mean observations per image: 0\n", c->n);
    for (int i = 0; i < c->n; i++) {
        const struct camera *view = &c->view[i];
        double pose[7];
        quaternion_of(pose, view->cam_from_world);
        memcpy(pose + 4, view->t_m, sizeof(view->t_m));
        if (binary) {
            put_bits(f, (uint64_t)i + 1, 4);
            for (int k = 0; k < 7; k++)
                put_f64(f, pose[k]);
            put_bits(f, (uint64_t)i + 1, 4);
            fprintf(f, "%s.exr", view->name);
            putc(0, f);
            put_bits(f, 0, 8);
        } else {
            fprintf(f, "%d", i + 1);
            for (int k = 0; k < 7; k++)
                fprintf(f, " %.17g", pose[k]);
            fprintf(f, " %d %s.exr\n\n", i + 1, view->name);
        }
    }
}

static void put_no_points(FILE *f, const struct cameras *c, bool binary)
{
    (void)c;
    if (binary)
        put_bits(f, 0, 8);
    else
        fprintf(f, "# 3D point list with one line of data per point:\n"
                   "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
                   "# Number of points: 0, mean track length: 0\n");
}

static int write_colmap(const struct cameras *c, const char *dir, bool binary)
{
    static const struct {
        const char *name;
        void (*put)(FILE *f, const struct cameras *c, bool binary);
    } files[] = { { "cameras", put_cameras }, { "images", put_images }, { "points3D", put_no_points } };
    for (int i = 0; i < c->n; i++) {
        const int model = colmap_model_of(&c->view[i]);
        if (model < 0)
            return model;
        if (!c->view[i].name[0] || strpbrk(c->view[i].name, "/\n\r")) {
            log_error("cameras: view %d is called '%s': a name must be a file's stem", i, c->view[i].name);
            return -EINVAL;
        }
    }
    int err = make_directories(dir);
    const locale_t c_locale = err ? (locale_t)0 : newlocale(LC_ALL_MASK, "C", (locale_t)0);
    if (!err && !c_locale)
        err = -ENOMEM;
    for (size_t i = 0; i < sizeof(files) / sizeof(files[0]) && !err; i++) {
        struct atomic_file f;
        char *path;
        if (asprintf(&path, "%s/%s.%s", dir, files[i].name, binary ? "bin" : "txt") < 0) {
            err = -ENOMEM;
            break;
        }
        err = atomic_file_open(&f, path);
        if (!err) {
            const locale_t before = uselocale(c_locale); // a decimal point, whatever the user's language
            files[i].put(f.stream, c, binary);
            uselocale(before);
            err = atomic_file_commit(&f);
        }
        free(path);
    }
    if (c_locale)
        freelocale(c_locale);
    return err;
}

int cameras_write_colmap_text(const struct cameras *c, const char *dir)
{
    return write_colmap(c, dir, false);
}

int cameras_write_colmap_binary(const struct cameras *c, const char *dir)
{
    return write_colmap(c, dir, true);
}
