// solver/cameras_realitycapture.c - RealityCapture (RealityScan): one XMP sidecar beside each picture, or one CSV.
//
// Both give the focal length for 36 mm film and the principal point as shares of the longer side, and neither says how large the
// pictures are. t1, t2 are OpenCV's p2, p1. A field of a sidecar is an attribute or an element: both are read.
#include "solver/cameras_format.h"
#include "solver/csv.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/vec3.h"
#include "solver/xml.h"

#include <dirent.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#define RDF "http://www.w3.org/1999/02/22-rdf-syntax-ns# "
#define XCR "http://www.capturingreality.com/ns/xcr/1.1# "
static const size_t max_sidecar_bytes = (size_t)16 << 20, max_csv_bytes = (size_t)256 << 20;

// f: for a picture whose longer side is 36; u, v: shares of the longer side; d: k1 k2 k3 k4 t1 t2
static void set_lens(struct camera *c, double f, double u, double v, const double d[6])
{
    const double longer = c->width_px > c->height_px ? c->width_px : c->height_px;
    c->model = CAMERA_BROWN;
    c->fx = c->fy = f / 36 * longer;
    c->cx = .5 * c->width_px + u * longer, c->cy = .5 * c->height_px + v * longer;
    memcpy(c->k, d, 4 * sizeof(*d));
    c->p[0] = d[5], c->p[1] = d[4];
}

// ---- XMP ----------------------------------------------------------------------------------------------------------------

// The field's text; NULL: not there.
static const char *field(const struct xml_element *rdf, const char *name)
{
    for (const struct xml_element *e = xml_child(rdf, RDF "Description"); e; e = xml_next(e, RDF "Description")) {
        const char *attribute = xml_attribute(e, name);
        const struct xml_element *child = xml_child(e, name);
        if (attribute || child)
            return attribute ? attribute : child->text;
    }
    return NULL;
}

static int read_number(const struct xml_element *rdf, const char *key, double otherwise, double *out, const char *name)
{
    const char *text = field(rdf, key);
    *out = otherwise;
    if (!text || !cameras_numbers(text, out, 1))
        return 0;
    log_error("cameras: %s: %s is '%.40s', expected a number", name, strchr(key, ' ') + 1, text);
    return -EINVAL;
}

static int read_distortion(const struct xml_element *rdf, double d[6], const char *name)
{
    static const struct {
        const char *name;
        int n_radial;
        bool has_tangential;
    } models[] = {
        { "perspective", 0, false }, { "brown3", 3, false }, { "brown4", 4, false }, { "brown3t2", 3, true }, { "brown4t2", 4, true },
    };
    const char *model = field(rdf, XCR "DistortionModel"), *text = field(rdf, XCR "DistortionCoeficients"); // the vendor's spelling
    int found = -1;
    memset(d, 0, 6 * sizeof(*d));
    for (size_t i = 0; model && i < sizeof(models) / sizeof(models[0]); i++)
        if (!strcasecmp(model, models[i].name))
            found = (int)i;
    if (found < 0) {
        log_error("cameras: %s: the distortion model '%.40s' is not read; align again with Brown3 or Brown4 (perhaps with tangential2) "
                  "and export the sidecars anew", name, model ? model : "(none)");
        return -ENOTSUP;
    }
    if (!text && found == 0)
        return 0;
    if (!text || (cameras_numbers(text, d, 6) && cameras_numbers(text, d, 3))) {
        log_error("cameras: %s: DistortionCoeficients is '%.60s', expected 6 numbers (k1 k2 k3 k4 t1 t2), or 3", name,
                  text ? text : "(none)");
        return -EINVAL;
    }
    for (int i = cameras_numbers(text, d, 6) ? 3 : 6; i < 6; i++)
        d[i] = 0;
    for (int i = 0; i < 6; i++)
        if (d[i] != 0 && !(i < 4 ? i < models[found].n_radial : models[found].has_tangential)) {
            log_error("cameras: %s: coefficient %d is %g, which %s does not have; expected 0 there", name, i + 1, d[i],
                      models[found].name);
            return -EINVAL;
        }
    return 0;
}

static int read_sidecar(struct camera *c, const struct xml_element *rdf, const char *name)
{
    const char *rotation = field(rdf, XCR "Rotation"), *position = field(rdf, XCR "Position"),
               *coordinates = field(rdf, XCR "Coordinates");
    double R[9], centre[3], f, u, v, skew, aspect, d[6], texturing, meshing;
    if (!rotation || !position) // another program's sidecar, or not registered
        return 0;
    int err = read_number(rdf, XCR "InTexturing", 1, &texturing, name);
    if (!err)
        err = read_number(rdf, XCR "InMeshing", 1, &meshing, name);
    if (err)
        return err;
    if (texturing == 0 || meshing == 0) {
        log_info("cameras: %s: switched off for meshing or texturing in RealityCapture: left out", name);
        return 0;
    }
    if (coordinates && strcasecmp(coordinates, "absolute")) {
        log_error("cameras: %s: Coordinates is '%.40s', expected 'absolute': relative poses are not read; export absolute ones", name,
                  coordinates);
        return -ENOTSUP;
    }
    if (cameras_numbers(rotation, R, 9) || cameras_numbers(position, centre, 3)) {
        log_error("cameras: %s: Rotation is '%.40s', Position '%.40s'; expected 9 and 3 numbers", name, rotation, position);
        return -EINVAL;
    }
    if (!field(rdf, XCR "FocalLength35mm")) {
        log_error("cameras: %s: there is no FocalLength35mm; export the sidecars with their calibration", name);
        return -EINVAL;
    }
    err = read_number(rdf, XCR "FocalLength35mm", 0, &f, name);
    if (!err)
        err = read_number(rdf, XCR "PrincipalPointU", 0, &u, name);
    if (!err)
        err = read_number(rdf, XCR "PrincipalPointV", 0, &v, name);
    if (!err)
        err = read_number(rdf, XCR "Skew", 0, &skew, name);
    if (!err)
        err = read_number(rdf, XCR "AspectRatio", 1, &aspect, name);
    if (!err)
        err = read_distortion(rdf, d, name);
    if (err)
        return err;
    if (skew != 0 || aspect != 1) {
        log_error("cameras: %s: skew %g and aspect ratio %g, expected 0 and 1: models with K are not read; align again without", name,
                  skew, aspect);
        return -ENOTSUP;
    }
    set_lens(c, f, u, v, d);
    err = camera_check_lens(c, name);
    if (!err)
        err = camera_set_pose(c, R, centre, name);
    return err ? err : 1;
}

int camera_parse_xmp(struct camera *c, const char *text, size_t n_text, const char *name)
{
    struct xml_element *root;
    int err = xml_parse(&root, text, n_text, name);
    if (err)
        return err;
    const struct xml_element *rdf = !strcmp(root->name, RDF "RDF") ? root : xml_child(root, RDF "RDF");
    err = read_sidecar(c, rdf, name);
    xml_free(root);
    return err;
}

static bool is_sidecar(const char *name)
{
    const size_t n = strlen(name);
    return name[0] != '.' && n > 4 && !strcasecmp(name + n - 4, ".xmp");
}

struct left_out {
    int n;
    char first[CAMERA_NAME_MAX];
};

static int add_sidecar(struct cameras *c, const char *path, const struct cameras_source *s, struct left_out *left_out)
{
    const char *slash = strrchr(path, '/'), *file = slash ? slash + 1 : path;
    char *text = NULL, *stem = strndup(file, strlen(file) - (is_sidecar(file) ? 4 : 0));
    size_t n;
    struct camera *view = cameras_add(c);
    int err = stem && view ? 0 : -ENOMEM;
    if (!err && camera_set_label(view, stem)) {
        log_error("cameras: %s: the name is longer than %d characters, or has control characters", path, CAMERA_NAME_MAX - 1);
        err = -EINVAL;
    }
    if (!err)
        err = file_read(&text, &n, path, max_sidecar_bytes);
    if (!err) {
        const bool is_sized = !cameras_picture_size(s, view->name, &view->width_px, &view->height_px);
        if (!is_sized)
            view->width_px = view->height_px = 1; // what it says is checked all the same
        err = camera_parse_xmp(view, text, n, path);
        if (err == 1 && !is_sized) {
            if (left_out->n++ == 0)
                memcpy(left_out->first, view->name, sizeof(left_out->first));
            err = 0;
        }
        c->n += err == 1;
        err = err == 1 ? 0 : err;
    }
    free(text);
    free(stem);
    return err;
}

static int read_sidecars(struct cameras *out, const struct cameras_source *s)
{
    struct cameras c = { 0 };
    struct left_out left_out = { 0 };
    struct dirent **entries = NULL;
    const int n = s->is_folder ? scandir(s->path, &entries, NULL, cameras_by_name) : 0;
    int err = n < 0 ? -errno : 0;
    if (err)
        log_error("cameras: cannot list %s: %s", s->path, strerror(-err));
    if (!s->is_folder)
        err = add_sidecar(&c, s->path, s, &left_out);
    for (int i = 0; i < n; i++) {
        char *path = NULL;
        if (!err && is_sidecar(entries[i]->d_name)) {
            err = asprintf(&path, "%s/%s", s->path, entries[i]->d_name) < 0 ? -ENOMEM : 0;
            if (!err)
                err = add_sidecar(&c, path, s, &left_out);
            free(path);
        }
        free(entries[i]);
    }
    free(entries);
    if (!err)
        err = cameras_log_left_out(s->path, left_out.n, left_out.first, c.n);
    if (!err)
        err = cameras_finish(&c, s->path);
    if (err) {
        cameras_free(&c);
        return err;
    }
    *out = c;
    return 0;
}

// ---- CSV ----------------------------------------------------------------------------------------------------------------

enum column { NAME, X, Y, ALTITUDE, HEADING, PITCH, ROLL, FOCAL, U, V, K1, K2, K3, K4, T1, T2, N_COLUMNS };
static const char *const column_names[N_COLUMNS][2] = {
    [NAME] = { "#name", "name" }, [X] = { "x", "x" }, [Y] = { "y", "y" }, [ALTITUDE] = { "alt", "z" },
    [HEADING] = { "heading", "yaw" }, [PITCH] = { "pitch", "pitch" }, [ROLL] = { "roll", "roll" },
    [FOCAL] = { "f", "f_35mm" }, [U] = { "px", "px_norm" }, [V] = { "py", "py_norm" },
    [K1] = { "k1", "k1" }, [K2] = { "k2", "k2" }, [K3] = { "k3", "k3" }, [K4] = { "k4", "k4" },
    [T1] = { "t1", "t1" }, [T2] = { "t2", "t2" },
};

static int find_columns(const struct csv *table, int column[N_COLUMNS])
{
    for (int i = 0; i < N_COLUMNS; i++) {
        column[i] = csv_find(table, column_names[i][1]);
        if (column[i] < 0)
            column[i] = csv_require(table, column_names[i][0]);
        if (column[i] < 0)
            return column[i];
    }
    return 0;
}

// Degrees. The camera (x right, y up, looking along -z) in the world: Rz(-heading) Rx(pitch) Ry(roll).
static void rotation_of(double cam_from_world[9], double heading, double pitch, double roll)
{
    const double degree = M_PI / 180, h = -heading * degree, p = pitch * degree, r = roll * degree;
    const double z[9] = { cos(h), -sin(h), 0, sin(h), cos(h), 0, 0, 0, 1 };
    const double x[9] = { 1, 0, 0, 0, cos(p), -sin(p), 0, sin(p), cos(p) };
    const double y[9] = { cos(r), 0, sin(r), 0, 1, 0, -sin(r), 0, cos(r) };
    double R[9];
    mat3_mul(R, z, x);
    mat3_mul(R, R, y);
    for (int i = 0; i < 3; i++) // to x right, y down, z forward, and from world to camera
        for (int j = 0; j < 3; j++)
            cam_from_world[3 * i + j] = (i ? -1 : 1) * R[3 * j + i];
}

static int add_row(struct cameras *c, struct csv *table, const int column[N_COLUMNS], const struct cameras_source *s,
                   struct left_out *left_out)
{
    double value[N_COLUMNS], R[9];
    char where[4096 + 32];
    struct camera *view = cameras_add(c);
    if (!view)
        return -ENOMEM;
    snprintf(where, sizeof(where), "%.4095s:%d", s->path, table->line);
    if (camera_set_label(view, table->field[column[NAME]])) {
        log_error("cameras: %s: '%.60s' is no file name of up to %d characters", where, table->field[column[NAME]],
                  CAMERA_NAME_MAX - 1);
        return -EINVAL;
    }
    for (int i = X; i < N_COLUMNS; i++) {
        const int err = csv_number(table, column[i], &value[i]);
        if (err)
            return err;
    }
    const bool is_sized = !cameras_picture_size(s, view->name, &view->width_px, &view->height_px);
    if (!is_sized)
        view->width_px = view->height_px = 1;
    set_lens(view, value[FOCAL], value[U], value[V], &value[K1]);
    rotation_of(R, value[HEADING], value[PITCH], value[ROLL]);
    int err = camera_check_lens(view, where);
    if (!err)
        err = camera_set_pose(view, R, &value[X], where);
    if (!err && !is_sized && left_out->n++ == 0)
        memcpy(left_out->first, view->name, sizeof(left_out->first));
    c->n += !err && is_sized;
    return err;
}

int cameras_parse_realitycapture_csv(struct cameras *out, const char *text, size_t n_text, const struct cameras_source *s)
{
    struct cameras c = { 0 };
    struct left_out left_out = { 0 };
    struct csv table;
    int column[N_COLUMNS], more = 0;
    memset(out, 0, sizeof(*out));
    if (!n_text || text[n_text - 1] != '\n') {
        log_error("cameras: %s: the file lacks its last line end: it is cut short", s->path);
        return -EINVAL;
    }
    int err = csv_open_text(&table, text, n_text, s->path);
    if (err)
        return err;
    err = find_columns(&table, column);
    while (!err && (more = csv_next_row(&table)) == 1)
        err = add_row(&c, &table, column, s, &left_out);
    if (!err)
        err = more;
    csv_close(&table);
    if (!err)
        err = cameras_log_left_out(s->path, left_out.n, left_out.first, c.n);
    if (!err)
        err = cameras_finish(&c, s->path);
    if (err) {
        cameras_free(&c);
        return err;
    }
    *out = c;
    return 0;
}

// ---- which it is --------------------------------------------------------------------------------------------------------

static bool is_csv(const struct cameras_source *s)
{
    const char *head = s->head + strspn(s->head, "\xef\xbb\xbf");
    return !strncmp(head, "#name,x,y,", 10) || !strncmp(head, "name,x,y,", 9);
}

bool cameras_realitycapture_probe(const struct cameras_source *s)
{
    if (!s->is_folder)
        return is_csv(s) || is_sidecar(s->path) || strstr(s->head, "x:xmpmeta") || strstr(s->head, "capturingreality.com");
    bool found = false;
    DIR *dir = opendir(s->path);
    for (struct dirent *e = dir ? readdir(dir) : NULL; e && !found; e = readdir(dir))
        found = is_sidecar(e->d_name);
    if (dir)
        closedir(dir);
    return found;
}

int cameras_realitycapture_read(struct cameras *out, const struct cameras_source *s)
{
    char *text;
    size_t n;
    if (s->is_folder || !is_csv(s))
        return read_sidecars(out, s);
    int err = file_read(&text, &n, s->path, max_csv_bytes);
    if (err)
        return err;
    err = cameras_parse_realitycapture_csv(out, text, n, s);
    free(text);
    return err;
}
