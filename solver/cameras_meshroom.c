// solver/cameras_meshroom.c - Meshroom's (AliceVision's) SfMData JSON, every version to 1.2.11.
//
// Numbers are strings of digits there (and numbers in hand-made files: both are read). The nine numbers of a rotation are
// column-major, world to camera. What a focal length means changed with the file's version four times.
#include "solver/cameras_format.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

enum { MAX_NAME = 32, MAX_DISTORTION = 5 };
static const size_t max_file_bytes = (size_t)256 << 20;

struct intrinsic {
    double id;
    const struct json *json;
    bool is_read;
    struct camera lens;
};
struct pose {
    double id;
    const struct json *json;
};

struct scene {
    const char *file;
    const struct json *root;
    int version; // 10000 a + 100 b + c
    struct intrinsic *intrinsic;
    struct pose *pose;
    int n_intrinsics, n_poses;
};

// A number, or a string that is one. 0, -ENOENT, -EINVAL; not logged.
static int get(const struct json *v, const char *path, double *out)
{
    const char *text;
    int err = json_get_number(v, path, out);
    if (err == -EINVAL)
        err = json_get_string(v, path, &text);
    else
        return err;
    return err ? err : cameras_numbers(text, out, 1);
}

static int get_or(const struct json *v, const char *path, double otherwise, double *out)
{
    const int err = get(v, path, out);
    if (err == -ENOENT)
        *out = otherwise;
    return err == -ENOENT ? 0 : err;
}

static int get_all(const struct json *v, const char *array, double *out, int n)
{
    for (int i = 0; i < n; i++) {
        char path[64];
        snprintf(path, sizeof(path), "%s.%d", array, i);
        const int err = get(v, path, &out[i]);
        if (err)
            return err;
    }
    return json_length(v, array) == n ? 0 : -EINVAL;
}

static const struct json *item(const struct json *v, const char *array, int i)
{
    char path[64];
    snprintf(path, sizeof(path), "%s.%d", array, i);
    return json_get(v, path);
}

// ---- lenses -------------------------------------------------------------------------------------------------------------

static int bad(const struct scene *s, double id, const char *what)
{
    log_error("cameras: %s: intrinsic %.0f: %s", s->file, id, what);
    return -EINVAL;
}

// fx and fy, px.
static int read_focal_lengths(const struct scene *s, const struct intrinsic *in, struct camera *lens)
{
    double f, rho, sensor_mm, two[2];
    if (s->version < 10202) {
        if (!get(in->json, "pxFocalLength", &f))
            lens->fx = lens->fy = f;
        else if (!get_all(in->json, "pxFocalLength", two, 2))
            lens->fx = two[0], lens->fy = two[1];
        else
            return bad(s, in->id, "there is no pxFocalLength; expected one or two numbers");
        return 0;
    }
    if (get(in->json, "focalLength", &f) || get_or(in->json, "sensorWidth", 36, &sensor_mm) ||
        get_or(in->json, "pixelRatio", 1, &rho) || !(sensor_mm > 0) || !(rho > 0))
        return bad(s, in->id, "expected focalLength, sensorWidth and pixelRatio, numbers above 0");
    const double px = f * lens->width_px / sensor_mm;
    if (s->version >= 10211)
        lens->fy = px, lens->fx = px / rho;
    else
        lens->fx = px, lens->fy = s->version >= 10205 ? px * rho : px / rho;
    return 0;
}

// The distortion's name in today's files; before 1.2.8 the camera's type says both.
static int read_types(const struct scene *s, const struct intrinsic *in, struct camera *lens, char distortion[MAX_NAME])
{
    static const struct {
        const char *type, *distortion;
        enum camera_model model;
    } types[] = {
        { "pinhole", "none", CAMERA_BROWN }, { "equidistant", "none", CAMERA_FISHEYE },
        { "radial1", "radialk1", CAMERA_BROWN }, { "radial3", "radialk3", CAMERA_BROWN }, { "brown", "brown", CAMERA_BROWN },
        { "fisheye", "fisheye", CAMERA_BROWN }, { "fisheye4", "fisheye", CAMERA_BROWN },
        { "equidistant_r3", "radialk3", CAMERA_FISHEYE },
    };
    const char *type = "pinhole", *named = NULL, *undistortion = NULL;
    int found = -1;
    (void)json_get_string(in->json, "type", &type);
    (void)json_get_string(in->json, "distortionType", &named);
    (void)json_get_string(in->json, "undistortionType", &undistortion);
    for (size_t i = 0; i < sizeof(types) / sizeof(types[0]) && (i < 2 || s->version < 10208); i++)
        if (!strcasecmp(type, types[i].type))
            found = (int)i;
    if (found < 0 || (undistortion && strcasecmp(undistortion, "none"))) {
        log_error("cameras: %s: intrinsic %.0f is of type '%.40s'%s%.40s, which is not read; calibrate with a pinhole camera and "
                  "radialk3 or brown distortion", s->file, in->id, type, found < 0 ? "" : " with undistortion ",
                  found < 0 ? "" : undistortion);
        return -ENOTSUP;
    }
    lens->model = types[found].model;
    snprintf(distortion, MAX_NAME, "%s", named && s->version >= 10208 ? named : types[found].distortion);
    return 0;
}

static int read_distortion(const struct scene *s, const struct intrinsic *in, const char *name, struct camera *lens)
{
    static const struct {
        const char *name;
        int n;
    } distortions[] = { { "none", 0 }, { "radialk1", 1 }, { "radialk3", 3 }, { "radialk3pt", 3 }, { "brown", 5 }, { "fisheye", 4 } };
    double d[MAX_DISTORTION] = { 0 };
    int n = -1;
    for (size_t i = 0; i < sizeof(distortions) / sizeof(distortions[0]); i++)
        if (!strcasecmp(name, distortions[i].name))
            n = distortions[i].n;
    const bool is_fisheye = !strcasecmp(name, "fisheye");
    if (n < 0 || (is_fisheye && lens->model == CAMERA_FISHEYE)) {
        log_error("cameras: %s: intrinsic %.0f: distortion '%.40s' is not read%s; calibrate with radialk1, radialk3, radialk3pt, brown or "
                  "fisheye", s->file, in->id, name, n < 0 ? "" : " together with an equidistant camera");
        return -ENOTSUP;
    }
    if (n > 0 && get_all(in->json, "distortionParams", d, n))
        return bad(s, in->id, "the numbers in distortionParams are not as many as its distortion has");
    if (is_fisheye)
        lens->model = CAMERA_FISHEYE;
    for (int i = 0; i < 4 && i < (n == 5 ? 3 : n); i++)
        lens->k[i] = d[i];
    if (n == 5)
        lens->p[0] = d[3], lens->p[1] = d[4];
    if (!strcasecmp(name, "radialk3pt")) { // the whole factor divided by its value at r = 1
        const double at_one = 1 + d[0] + d[1] + d[2];
        if (!(at_one > 1e-6))
            return bad(s, in->id, "1 + k1 + k2 + k3 is not above 0");
        lens->fx /= at_one, lens->fy /= at_one;
    }
    return 0;
}

// AliceVision's equidistant camera measures radii in units of half the shorter side's field of view, and multiplies them by the
// radius of the lens's image circle: to radians, and pixels per radian.
static int to_radians(const struct scene *s, const struct intrinsic *in, const char *distortion, double f_px, struct camera *lens)
{
    double width_mm, height_mm, circle_px;
    const double shorter = fmin(lens->width_px, lens->height_px), longer = fmax(lens->width_px, lens->height_px);
    if (get_or(in->json, "sensorWidth", 36, &width_mm) || get_or(in->json, "sensorHeight", 24, &height_mm) ||
        get_or(in->json, "fisheyeCircleRadius", .5 * shorter, &circle_px) || !(width_mm > 0 && height_mm > 0 && circle_px > 0))
        return bad(s, in->id, "expected sensorWidth, sensorHeight and fisheyeCircleRadius above 0");
    const double per_radian = 2 * f_px * (width_mm / longer) / fmin(width_mm, height_mm);
    double power = 1;
    for (int i = 0; i < 4; i++)
        lens->k[i] *= power *= per_radian * per_radian;
    for (int i = 0; i < 2; i++)
        lens->p[i] *= per_radian;
    const double factor = strcasecmp(distortion, "radialk3pt") ? 1 : lens->fx / f_px; // what its normalisation did
    lens->fx = lens->fy = circle_px * per_radian * factor;
    return 0;
}

static int read_intrinsic(const struct scene *s, struct intrinsic *in)
{
    double width, height, centre[2];
    char distortion[MAX_NAME];
    struct camera *lens = &in->lens;
    if (get(in->json, "width", &width) || get(in->json, "height", &height) || !(width >= 1 && width <= 65536) ||
        !(height >= 1 && height <= 65536))
        return bad(s, in->id, "expected width and height, 1 to 65536 px");
    lens->width_px = (int)width, lens->height_px = (int)height;
    int err = read_types(s, in, lens, distortion);
    if (!err)
        err = read_focal_lengths(s, in, lens);
    if (err)
        return err;
    const double f_px = lens->fx;
    const bool is_equidistant = lens->model == CAMERA_FISHEYE;
    if (get_all(in->json, "principalPoint", centre, 2))
        return bad(s, in->id, "principalPoint: expected two numbers");
    lens->cx = centre[0] + (s->version >= 10201 ? .5 * width : 0);
    lens->cy = centre[1] + (s->version >= 10201 ? .5 * height : 0);
    err = read_distortion(s, in, distortion, lens);
    if (!err && is_equidistant)
        err = to_radians(s, in, distortion, f_px, lens);
    in->is_read = !err;
    return err;
}

// ---- views --------------------------------------------------------------------------------------------------------------

static int compare_ids(const void *a, const void *b) // of intrinsics or poses: both begin with the id
{
    const double x = *(const double *)a, y = *(const double *)b;
    return x < y ? -1 : x > y;
}

// Array of {idKey, ...} into records of size bytes that begin with the id and a pointer. The records are zeroed else.
static int index_by_id(const struct scene *s, const char *array, const char *key, size_t size, void **out, int *n_out)
{
    const int n = json_length(s->root, array);
    const char *text;
    *n_out = 0;
    if (n == -ENOENT || (!json_get_string(s->root, array, &text) && !*text)) // the writer puts "" for an empty list
        return 0;
    char *records = n < 0 ? NULL : calloc((size_t)n + 1, size);
    *out = records;
    if (n < 0) {
        log_error("cameras: %s: '%s' is no list", s->file, array);
        return -EINVAL;
    }
    if (!records)
        return -ENOMEM;
    for (int i = 0; i < n; i++) {
        struct pose record = { .json = item(s->root, array, i) };
        if (get(record.json, key, &record.id)) {
            log_error("cameras: %s: %s %d has no number %s", s->file, array, i, key);
            return -EINVAL;
        }
        memcpy(records + (size_t)i * size, &record, sizeof(record));
    }
    qsort(records, (size_t)n, size, compare_ids);
    for (int i = 1; i < n; i++)
        if (!compare_ids(records + (size_t)(i - 1) * size, records + (size_t)i * size)) {
            log_error("cameras: %s: two of '%s' have the %s %.0f", s->file, array, key, *(double *)(records + (size_t)i * size));
            return -EINVAL;
        }
    *n_out = n;
    return 0;
}

static bool says_false(const struct json *v, const char *key)
{
    double number;
    bool is_true;
    const char *text;
    if (!json_get_bool(v, key, &is_true))
        return !is_true;
    if (!json_get_string(v, key, &text) && !strcasecmp(text, "false"))
        return true;
    return !get(v, key, &number) && number == 0;
}

static int place(const struct scene *s, const struct pose *pose, struct camera *view)
{
    double columns[9], centre[3], R[9];
    if (get_all(pose->json, "pose.transform.rotation", columns, 9) || get_all(pose->json, "pose.transform.center", centre, 3)) {
        log_error("cameras: %s: pose %.0f: expected transform with 9 numbers in rotation and 3 in center", s->file, pose->id);
        return -EINVAL;
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            R[3 * i + j] = columns[3 * j + i];
    return camera_set_pose(view, R, centre, s->file);
}

static int read_view(const struct scene *s, const struct json *v, int i, struct cameras *out)
{
    double pose_id, intrinsic_id, width, height;
    const char *path;
    if (get(v, "poseId", &pose_id) || get(v, "intrinsicId", &intrinsic_id)) // not registered
        return 0;
    const struct pose *pose = s->n_poses ? bsearch(&pose_id, s->pose, (size_t)s->n_poses, sizeof(*s->pose), compare_ids) : NULL;
    struct intrinsic *in = s->n_intrinsics ? bsearch(&intrinsic_id, s->intrinsic, (size_t)s->n_intrinsics, sizeof(*s->intrinsic),
                                                     compare_ids) : NULL;
    if (json_get(v, "rigId") && says_false(v, "isPoseIndependant")) {
        log_error("cameras: %s: view %d is part of a rig, whose poses are not read; export without rigs (SfMTransform, or "
                  "undistorted with one pose a view)", s->file, i);
        return -ENOTSUP;
    }
    if (!pose || !in)
        return 0;
    struct camera *view = cameras_add(out);
    if (!view)
        return -ENOMEM;
    int err = in->is_read ? 0 : read_intrinsic(s, in);
    if (err)
        return err;
    *view = in->lens;
    if (json_get_string(v, "path", &path) || camera_set_name(view, path, strlen(path))) {
        log_error("cameras: %s: view %d: path: expected a file name of up to %d characters", s->file, i, CAMERA_NAME_MAX - 1);
        return -EINVAL;
    }
    if (!get(v, "width", &width) && !get(v, "height", &height) && width > 0 && height > 0 &&
        (width != view->width_px || height != view->height_px)) {
        log_error("cameras: %s: view '%s' has %g x %g pixels, its intrinsic %d x %d", s->file, view->name, width, height,
                  view->width_px, view->height_px);
        return -EINVAL;
    }
    err = camera_check_lens(view, s->file);
    if (!err)
        err = place(s, pose, view);
    out->n += !err;
    return err;
}

static int read_scene(struct scene *s, struct cameras *out)
{
    double version[3];
    if (get_all(s->root, "version", version, 3) || !(version[0] >= 0 && version[0] < 100 && version[1] >= 0 && version[1] < 100 &&
                                                     version[2] >= 0 && version[2] < 100)) {
        log_error("cameras: %s: there is no version of three numbers; expected Meshroom's SfMData JSON", s->file);
        return -EINVAL;
    }
    s->version = 10000 * (int)version[0] + 100 * (int)version[1] + (int)version[2];
    if (version[0] > 1)
        log_warning("cameras: %s: file version %g.%g.%g; known up to 1.2.11: read as that", s->file, version[0], version[1],
                    version[2]);
    void *intrinsics = NULL, *poses = NULL;
    int err = index_by_id(s, "intrinsics", "intrinsicId", sizeof(*s->intrinsic), &intrinsics, &s->n_intrinsics);
    if (!err)
        err = index_by_id(s, "poses", "poseId", sizeof(*s->pose), &poses, &s->n_poses);
    s->intrinsic = intrinsics, s->pose = poses;
    const int n_views = json_length(s->root, "views");
    if (!err && n_views < 0) {
        log_error("cameras: %s: there is no list 'views'", s->file);
        err = -EINVAL;
    }
    for (int i = 0; i < n_views && !err; i++)
        err = read_view(s, item(s->root, "views", i), i, out);
    free(s->intrinsic);
    free(s->pose);
    return err;
}

int cameras_parse_meshroom(struct cameras *out, const char *text, size_t n_text, const char *name)
{
    struct json *root;
    struct cameras c = { 0 };
    memset(out, 0, sizeof(*out));
    int err = json_parse(&root, text, n_text, name);
    if (err)
        return err;
    struct scene s = { .file = name, .root = root };
    err = read_scene(&s, &c);
    json_free(root);
    if (!err)
        err = cameras_finish(&c, name);
    if (err) {
        cameras_free(&c);
        return err;
    }
    *out = c;
    return 0;
}

bool cameras_meshroom_probe(const struct cameras_source *s)
{
    return s->head[strspn(s->head, " \t\r\n\xef\xbb\xbf")] == '{' &&
           (strstr(s->head, "\"views\"") || strstr(s->head, "\"featuresFolders\"") || strstr(s->head, "\"intrinsics\""));
}

int cameras_meshroom_read(struct cameras *out, const struct cameras_source *s)
{
    char *text;
    size_t n;
    memset(out, 0, sizeof(*out));
    int err = file_read(&text, &n, s->path, max_file_bytes);
    if (err)
        return err;
    err = cameras_parse_meshroom(out, text, n, s->path);
    free(text);
    return err;
}
