// solver/cameras_metashape.c - Agisoft Metashape's (PhotoScan's) camera file.
//
// document > chunk > { sensors > sensor > calibration, components > component > transform, cameras > (group >)* camera > transform }.
// A camera's transform M takes it to the chunk; the component's (or the chunk's) transform S, which has a scale, takes that to the
// world. Which of the two frames the mesh is in is the user's choice on export: options->without_transform reads the other one.
// A missing coefficient is 0. Metashape's p1 and p2 are OpenCV's p2 and p1.
#include "solver/cameras_format.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/vec3.h"
#include "solver/xml.h"

#include <errno.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <unistd.h>

enum { FAR_AWAY_M = 1000000 }; // nothing local is 1,000 km from its origin: coordinates from the Earth's centre are
static const size_t max_file_bytes = (size_t)256 << 20;

struct similarity { // world = scale rotation x + translation
    double scale, rotation[9], translation[3];
};

static const struct similarity no_transform = { .scale = 1, .rotation = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };

struct sensor {
    const char *id;
    const struct xml_element *element;
    bool is_read;
    struct camera lens;
};
struct component {
    const char *id;
    const struct xml_element *element;
    struct similarity world_from_chunk;
};

struct chunk {
    const struct cameras_source *source;
    const struct xml_element *element;
    struct sensor *sensor;
    struct component *component;
    int n_sensors, n_components;
    struct similarity world_from_chunk; // of the chunk itself
    bool has_transform;
    int n_disabled;
    bool is_far_away;
};

__attribute__((format(printf, 4, 5))) static int refuse(const struct cameras_source *s, const struct xml_element *e, int err,
                                                       const char *format, ...)
{
    char what[512];
    va_list args;
    va_start(args, format);
    vsnprintf(what, sizeof(what), format, args);
    va_end(args);
    log_error("cameras: %s:%d: %s", s->path, e->line, what);
    return err;
}

static const char *or_nothing(const char *text)
{
    return text ? text : "";
}

static bool is_false(const char *text)
{
    return text && (!strcmp(text, "0") || !strcasecmp(text, "false") || !strcasecmp(text, "disabled"));
}

// ---- lenses -------------------------------------------------------------------------------------------------------------

static int read_size(const struct cameras_source *s, const struct xml_element *e, const char *width, const char *height,
                     int *width_px, int *height_px)
{
    double side[2];
    const char *const text[2] = { or_nothing(width), or_nothing(height) };
    for (int i = 0; i < 2; i++)
        if (cameras_numbers(text[i], &side[i], 1) || !(side[i] >= 1 && side[i] <= 65536) || side[i] != floor(side[i]))
            return refuse(s, e, -EINVAL, "found a size of '%.20s' x '%.20s' pixels, expected 1 to 65536 a side", text[0], text[1]);
    *width_px = (int)side[0], *height_px = (int)side[1];
    return 0;
}

// <resolution width height>, or (stand-alone) <width> and <height>. Leaves what is there where there is neither.
static int read_resolution(const struct cameras_source *s, const struct xml_element *of, struct camera *lens)
{
    const struct xml_element *e = xml_child(of, "resolution"), *w = xml_child(of, "width"), *h = xml_child(of, "height");
    int width, height;
    if (!e && !(w && h))
        return 0;
    const int err = e ? read_size(s, e, xml_attribute(e, "width"), xml_attribute(e, "height"), &width, &height)
                      : read_size(s, w, w->text, h->text, &width, &height);
    if (err)
        return err;
    if (lens->width_px && (lens->width_px != width || lens->height_px != height))
        return refuse(s, of, -EINVAL, "the calibration is for %d x %d pixels, its sensor has %d x %d", width, height,
                      lens->width_px, lens->height_px);
    lens->width_px = width, lens->height_px = height;
    return 0;
}

static int read_calibration(const struct cameras_source *s, const struct xml_element *e, struct camera *lens)
{
    double f = 0, cx = 0, cy = 0, b1 = 0, b2 = 0, p1 = 0, p2 = 0;
    const struct {
        const char *tag;
        double *out;
    } tags[] = {
        { "f", &f }, { "cx", &cx }, { "cy", &cy }, { "b1", &b1 }, { "b2", &b2 },
        { "k1", &lens->k[0] }, { "k2", &lens->k[1] }, { "k3", &lens->k[2] }, { "k4", &lens->k[3] },
        { "p1", &p1 }, { "p2", &p2 }, { "p3", &lens->p[2] }, { "p4", &lens->p[3] },
    };
    const struct xml_element *projection = xml_child(e, "projection");
    const char *type = projection ? projection->text : xml_attribute(e, "type");
    if (type && !strcmp(type, "fisheye"))
        lens->model = CAMERA_FISHEYE;
    else if (type && strcmp(type, "frame"))
        return refuse(s, e, -ENOTSUP, "the camera type '%.40s' is not read, only frame and fisheye are; undistort the pictures (File > "
                      "Export > Convert Images) and export the cameras again", type);
    if (xml_child(e, "fx"))
        return refuse(s, e, -ENOTSUP, "found fx, expected f: PhotoScan before 1.3 wrote this; open the project in Metashape and "
                      "export the cameras again");
    for (size_t i = 0; i < sizeof(tags) / sizeof(tags[0]); i++) {
        const struct xml_element *value = xml_child(e, tags[i].tag);
        if (value && cameras_numbers(value->text, tags[i].out, 1))
            return refuse(s, value, -EINVAL, "<%s> is '%.40s', expected a number", tags[i].tag, value->text);
    }
    const int err = read_resolution(s, e, lens);
    if (err)
        return err;
    lens->fx = f + b1, lens->fy = f, lens->skew = b2;
    lens->cx = .5 * lens->width_px + cx, lens->cy = .5 * lens->height_px + cy;
    lens->p[0] = p2, lens->p[1] = p1;
    return 0;
}

// A sensor exported without calibration: from <folder>/<sensor's label>.xml or <folder>/calibration.xml (File > Export >
// Calibration) where there is one. 1: read; 0: there is none.
static int read_calibration_beside(const struct cameras_source *s, const char *label, struct camera *lens)
{
    const char *slash = strrchr(s->path, '/');
    const int n_folder = slash ? (int)(slash + 1 - s->path) : 0;
    const char *const names[2] = { label, "calibration" };
    for (int i = 0; i < 2; i++) {
        char *path, *text;
        size_t n;
        struct xml_element *root;
        if (!names[i][0] || strchr(names[i], '/') || strchr(names[i], '%'))
            continue;
        if (asprintf(&path, "%.*s%s.xml", n_folder, s->path, names[i]) < 0)
            return -ENOMEM;
        int err = access(path, F_OK) ? -ENOENT : file_read(&text, &n, path, max_file_bytes);
        if (!err) {
            err = xml_parse(&root, text, n, path);
            free(text);
            if (!err) {
                const struct cameras_source beside = { .path = path, .options = s->options };
                err = strcmp(root->name, "calibration") ? 0 : read_calibration(&beside, root, lens);
                err = err ? err : !strcmp(root->name, "calibration");
                xml_free(root);
            }
        }
        free(path);
        if (err && err != -ENOENT)
            return err;
    }
    return 0;
}

static int read_sensor(const struct cameras_source *s, struct sensor *sensor)
{
    const struct xml_element *e = sensor->element, *best = NULL;
    const char *type = xml_attribute(e, "type"), *label = or_nothing(xml_attribute(e, "label"));
    struct camera *lens = &sensor->lens;
    if (type && strcmp(type, "frame") && strcmp(type, "fisheye"))
        return refuse(s, e, -ENOTSUP, "sensor '%.60s' is of type '%.40s'; only frame and fisheye are read", label, type);
    lens->model = type && !strcmp(type, "fisheye") ? CAMERA_FISHEYE : CAMERA_BROWN;
    const struct xml_element *shutter = xml_child(e, "rolling_shutter");
    if (shutter && !is_false(shutter->text))
        return refuse(s, e, -ENOTSUP, "sensor '%.60s' has rolling shutter compensation, which is not read; switch it off (Tools > "
                      "Camera Calibration) and align again", label);
    int err = read_resolution(s, e, lens);
    if (err)
        return err;
    for (const struct xml_element *c = xml_child(e, "calibration"); c; c = xml_next(c, "calibration"))
        if (!best || !strcmp(or_nothing(xml_attribute(c, "class")), "adjusted"))
            best = c;
    err = best ? read_calibration(s, best, lens) : read_calibration_beside(s, label, lens);
    if (!best && err == 0)
        return refuse(s, e, -EINVAL, "sensor '%.60s' has no calibration; export it too (File > Export > Calibration, Agisoft "
                      "format) as calibration.xml beside this file", label);
    sensor->is_read = err >= 0;
    return err < 0 ? err : 0;
}

// ---- transforms ---------------------------------------------------------------------------------------------------------

// Splits 3x3 into scale and rotation.
static int split(const struct cameras_source *s, const struct xml_element *e, struct similarity *t)
{
    const double det = mat3_det(t->rotation), scale = cbrt(fabs(det)) * t->scale;
    for (int i = 0; i < 9; i++)
        t->rotation[i] /= cbrt(fabs(det));
    const int err = cameras_make_rotation(t->rotation);
    if (err)
        return refuse(s, e, -EINVAL, "the transform's rotation is %s", err == -EDOM ? "mirrored (determinant below 0)" : "none");
    t->scale = scale;
    if (!(scale > 0 && isfinite(scale)))
        return refuse(s, e, -EINVAL, "the transform's scale is %g, expected a positive one", scale);
    return 0;
}

static int read_similarity(const struct cameras_source *s, const struct xml_element *e, struct similarity *out)
{
    static const double identity[9] = { 1, 0, 0, 0, 1, 0, 0, 0, 1 };
    const struct xml_element *rotation = xml_child(e, "rotation"), *translation = xml_child(e, "translation"),
                             *scale = xml_child(e, "scale");
    *out = (struct similarity){ .scale = 1 };
    memcpy(out->rotation, identity, sizeof(identity));
    if (!rotation && !translation && !scale) { // 16 numbers, as a camera's
        double m[16];
        if (cameras_numbers(e->text, m, 16) || m[12] != 0 || m[13] != 0 || m[14] != 0 || m[15] != 1)
            return refuse(s, e, -EINVAL, "the transform is '%.40s...', expected rotation, translation and scale, or 16 numbers that end "
                          "with 0 0 0 1", e->text);
        for (int i = 0; i < 3; i++) {
            memcpy(out->rotation + 3 * i, m + 4 * i, 3 * sizeof(*m));
            out->translation[i] = m[4 * i + 3];
        }
        return split(s, e, out);
    }
    if ((rotation && cameras_numbers(rotation->text, out->rotation, 9)) ||
        (translation && cameras_numbers(translation->text, out->translation, 3)) ||
        (scale && cameras_numbers(scale->text, &out->scale, 1)))
        return refuse(s, e, -EINVAL, "expected 9 numbers in the transform's rotation, 3 in its translation, 1 in its scale");
    return split(s, e, out);
}

// ---- cameras ------------------------------------------------------------------------------------------------------------

static int compare_ids(const void *a, const void *b) // of sensors or components: both begin with the id
{
    return strcmp(*(const char *const *)a, *(const char *const *)b);
}

// The transform that takes a camera to the world: its component's; the chunk's own (older files); or none.
static int world_of(const struct chunk *c, const struct xml_element *camera, const struct similarity **out)
{
    const char *id = xml_attribute(camera, "component_id");
    const struct component *found = c->n_components == 1 && !id ? c->component : NULL;
    *out = c->has_transform ? &c->world_from_chunk : &no_transform;
    if (id && c->n_components) {
        found = bsearch(&id, c->component, (size_t)c->n_components, sizeof(*c->component), compare_ids);
        if (!found)
            return refuse(c->source, camera, -EINVAL, "the camera is in component '%.40s', which is not in the file", id);
    }
    if (!id && c->n_components > 1 && !c->has_transform)
        return refuse(c->source, camera, -EINVAL, "the camera names no component, and there are %d", c->n_components);
    if (found && xml_child(found->element, "transform"))
        *out = &found->world_from_chunk;
    return 0;
}

static int place(struct chunk *c, const struct xml_element *e, const struct xml_element *transform, struct camera *view)
{
    double m[16], R[9], centre[3], moved[3], cam_from_world[9];
    char where[4096 + 32];
    const struct similarity *world;
    snprintf(where, sizeof(where), "%.4095s:%d", c->source->path, transform->line);
    if (cameras_numbers(transform->text, m, 16) || m[12] != 0 || m[13] != 0 || m[14] != 0 || m[15] != 1)
        return refuse(c->source, transform, -EINVAL, "camera '%s': the transform is '%.40s...', expected 16 numbers that end with 0 0 0 1",
                      view->name, transform->text);
    int err = world_of(c, e, &world);
    if (err)
        return err;
    for (int i = 0; i < 3; i++) {
        memcpy(R + 3 * i, m + 4 * i, 3 * sizeof(*m));
        centre[i] = m[4 * i + 3];
    }
    if (world != &no_transform && c->source->options->has_transform)
        *c->source->options->has_transform = true;
    if (!c->source->options->without_transform) {
        mat3_mul(R, world->rotation, R);
        mat3_mul_vec(moved, world->rotation, centre);
        for (int i = 0; i < 3; i++)
            centre[i] = world->scale * moved[i] + world->translation[i];
    }
    c->is_far_away = c->is_far_away || vec3_norm(centre) > FAR_AWAY_M;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            cam_from_world[3 * i + j] = R[3 * j + i];
    return camera_set_pose(view, cam_from_world, centre, where);
}

static int read_camera(struct chunk *c, const struct xml_element *e, struct cameras *out)
{
    const char *label = xml_attribute(e, "label"), *sensor_id = xml_attribute(e, "sensor_id");
    const struct xml_element *transform = xml_child(e, "transform");
    if (is_false(xml_attribute(e, "enabled"))) {
        c->n_disabled++;
        return 0;
    }
    if (!transform && xml_attribute(e, "master_id"))
        return refuse(c->source, e, -ENOTSUP, "camera '%.60s' hangs on a master camera (a rig), without a place of its own; rigs are not "
                      "read", or_nothing(label));
    if (!transform) // not aligned
        return 0;
    struct sensor *sensor = sensor_id && c->n_sensors ? bsearch(&sensor_id, c->sensor, (size_t)c->n_sensors, sizeof(*c->sensor),
                                                                compare_ids) : NULL;
    if (!sensor)
        return refuse(c->source, e, -EINVAL, "camera '%.60s' uses sensor '%.40s', which is not in the file", or_nothing(label),
                      or_nothing(sensor_id));
    int err = sensor->is_read ? 0 : read_sensor(c->source, sensor);
    if (err)
        return err;
    struct camera *view = cameras_add(out);
    if (!view)
        return -ENOMEM;
    *view = sensor->lens;
    if (!label || camera_set_label(view, label))
        return refuse(c->source, e, -EINVAL, "the label '%.60s' is no file name of up to %d characters", or_nothing(label),
                      CAMERA_NAME_MAX - 1);
    char where[4096 + 32];
    snprintf(where, sizeof(where), "%.4095s:%d", c->source->path, sensor->element->line);
    err = camera_check_lens(view, where);
    if (!err)
        err = place(c, e, transform, view);
    out->n += !err;
    return err;
}

// Groups lie in groups: xml.c bounds the depth.
static int read_cameras(struct chunk *c, const struct xml_element *in, struct cameras *out)
{
    int err = 0;
    for (const struct xml_element *e = xml_child(in, NULL); e && !err; e = xml_next(e, NULL)) {
        if (!strcmp(e->name, "group"))
            err = read_cameras(c, e, out);
        else if (!strcmp(e->name, "camera"))
            err = read_camera(c, e, out);
    }
    return err;
}

static int count(const struct xml_element *in, const char *name)
{
    int n = 0;
    for (const struct xml_element *e = xml_child(in, name); e; e = xml_next(e, name))
        n++;
    return n;
}

static int read_chunk(struct chunk *c, struct cameras *out)
{
    const struct xml_element *sensors = xml_child(c->element, "sensors"), *components = xml_child(c->element, "components"),
                             *transform = xml_child(c->element, "transform");
    const int n_sensors = count(sensors, "sensor"), n_components = count(components, "component");
    c->sensor = calloc((size_t)n_sensors + 1, sizeof(*c->sensor));
    c->component = calloc((size_t)n_components + 1, sizeof(*c->component));
    if (!c->sensor || !c->component)
        return -ENOMEM;
    for (const struct xml_element *e = xml_child(sensors, "sensor"); e; e = xml_next(e, "sensor"))
        c->sensor[c->n_sensors++] = (struct sensor){ .id = or_nothing(xml_attribute(e, "id")), .element = e };
    qsort(c->sensor, (size_t)n_sensors, sizeof(*c->sensor), compare_ids);
    for (int i = 1; i < n_sensors; i++)
        if (!strcmp(c->sensor[i - 1].id, c->sensor[i].id))
            return refuse(c->source, c->sensor[i].element, -EINVAL, "two sensors have the id '%.40s'", c->sensor[i].id);
    c->has_transform = transform;
    int err = transform ? read_similarity(c->source, transform, &c->world_from_chunk) : 0;
    for (const struct xml_element *e = xml_child(components, "component"); e && !err; e = xml_next(e, "component")) {
        struct component *k = &c->component[c->n_components++];
        const struct xml_element *of = xml_child(e, "transform");
        *k = (struct component){ .id = or_nothing(xml_attribute(e, "id")), .element = e };
        err = of ? read_similarity(c->source, of, &k->world_from_chunk) : 0;
    }
    if (err)
        return err;
    qsort(c->component, (size_t)n_components, sizeof(*c->component), compare_ids);
    for (int i = 1; i < n_components; i++)
        if (!strcmp(c->component[i - 1].id, c->component[i].id))
            return refuse(c->source, c->component[i].element, -EINVAL, "two components have the id '%.40s'", c->component[i].id);
    return read_cameras(c, xml_child(c->element, "cameras"), out);
}

static int read_document(const struct xml_element *root, struct cameras *out, const struct cameras_source *s)
{
    if (!strcmp(root->name, "calibration"))
        return refuse(s, root, -EINVAL, "this is a calibration alone: it says nothing about where cameras stand; export the cameras "
                      "(File > Export > Export Cameras, Agisoft XML)");
    if (strcmp(root->name, "document"))
        return refuse(s, root, -EINVAL, "found <%.40s>, expected Metashape's <document>", root->name);
    const struct xml_element *with_cameras = NULL;
    for (const struct xml_element *e = xml_child(root, "chunk"); e; e = xml_next(e, "chunk")) {
        struct chunk c = { .source = s, .element = e };
        const int n_before = out->n;
        const int err = read_chunk(&c, out);
        free(c.sensor);
        free(c.component);
        if (err)
            return err;
        if (out->n > n_before && with_cameras)
            return refuse(s, e, -EINVAL, "two chunks have aligned cameras (the other begins in line %d): export the one the mesh comes "
                          "from", with_cameras->line);
        if (out->n > n_before)
            with_cameras = e;
        if (c.n_disabled)
            log_info("cameras: %s: %d cameras are switched off in Metashape and left out", s->path, c.n_disabled);
        if (c.is_far_away)
            log_warning("cameras: %s: the cameras stand in Earth-centred coordinates (the chunk is georeferenced); the mesh "
                        "must be in the same: export it in the chunk's local coordinates", s->path);
    }
    return 0;
}

int cameras_parse_metashape(struct cameras *out, const char *text, size_t n_text, const struct cameras_source *s)
{
    struct xml_element *root;
    struct cameras c = { 0 };
    memset(out, 0, sizeof(*out));
    int err = xml_parse(&root, text, n_text, s->path);
    if (err)
        return err;
    err = read_document(root, &c, s);
    xml_free(root);
    if (!err)
        err = cameras_finish(&c, s->path);
    if (err) {
        cameras_free(&c);
        return err;
    }
    *out = c;
    return 0;
}

bool cameras_metashape_probe(const struct cameras_source *s)
{
    if (s->head[strspn(s->head, " \t\r\n\xef\xbb\xbf")] != '<' || strstr(s->head, "xmpmeta"))
        return false;
    // a calibration beside the camera file is no second camera file of the folder; one that the user names is refused in words
    return strstr(s->head, "<document") || (!s->is_listed && strstr(s->head, "<calibration"));
}

int cameras_metashape_read(struct cameras *out, const struct cameras_source *s)
{
    char *text;
    size_t n;
    memset(out, 0, sizeof(*out));
    int err = file_read(&text, &n, s->path, max_file_bytes);
    if (err)
        return err;
    err = cameras_parse_metashape(out, text, n, s);
    free(text);
    return err;
}
