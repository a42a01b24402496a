// solver/cameras.c - the camera itself (projection, its derivative, its inverse), and which reader takes a file.
#include "solver/cameras.h"
#include "solver/cameras_format.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <dirent.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

static const double min_depth = 1e-9;

// ---- distortion ---------------------------------------------------------------------------------------------------------

// Is c[0] + c[1] s + ... + c[degree] s^degree > 0 all over [0, s_max]? Bernstein coefficients bound a polynomial from both sides;
// halve the interval until they decide.
enum { MAX_DEGREE = 6 };

static bool bernstein_is_positive(const double *b, int degree, int depth)
{
    bool all = true;
    for (int i = 0; i <= degree; i++)
        all = all && b[i] > 0;
    if (all)
        return true;
    if (!(b[0] > 0 && b[degree] > 0) || depth == 0) // the outer two are values of the polynomial
        return false;
    double left[MAX_DEGREE + 1], right[MAX_DEGREE + 1];
    memcpy(right, b, (size_t)(degree + 1) * sizeof(*b));
    for (int i = 0; i <= degree; i++) { // de Casteljau: what the passes leave behind in right[] is the right half
        left[i] = right[0];
        for (int j = 0; j < degree - i; j++)
            right[j] = .5 * (right[j] + right[j + 1]);
    }
    return bernstein_is_positive(left, degree, depth - 1) && bernstein_is_positive(right, degree, depth - 1);
}

static bool polynomial_is_positive(const double *c, int degree, double s_max)
{
    static const double choose[MAX_DEGREE + 1][MAX_DEGREE + 1] = {
        { 1 }, { 1, 1 }, { 1, 2, 1 }, { 1, 3, 3, 1 }, { 1, 4, 6, 4, 1 }, { 1, 5, 10, 10, 5, 1 }, { 1, 6, 15, 20, 15, 6, 1 },
    };
    double b[MAX_DEGREE + 1] = { 0 }, power = 1;
    for (int j = 0; j <= degree; j++, power *= s_max)
        for (int i = j; i <= degree; i++)
            b[i] += choose[i][j] / choose[degree][j] * c[j] * power;
    return bernstein_is_positive(b, degree, 24);
}

// Does the radius still grow with the angle, everywhere between the axis and here? (Behind the fold, a pixel has two rays.)
static bool is_monotonic(const struct camera *c, double s) // s: r^2, fisheye: angle^2
{
    const double *k = c->k;
    if (c->model != CAMERA_RATIONAL) {
        const double d[5] = { 1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3] };
        if (k[0] >= 0 && k[1] >= 0 && k[2] >= 0 && k[3] >= 0)
            return true;
        return polynomial_is_positive(d, 4, s);
    }
    const double n[4] = { 1, k[0], k[1], k[2] }, d[4] = { 1, k[3], k[4], k[5] };
    double slope[MAX_DEGREE + 1] = { 0 }; // (N + 2 s N') D - 2 s N D'
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++)
            slope[i + j] += (1 + 2 * i - 2 * j) * n[i] * d[j];
    return polynomial_is_positive(d, 3, s) && polynomial_is_positive(slope, MAX_DEGREE, s);
}

static bool has_tangential(const struct camera *c)
{
    return c->p[0] != 0 || c->p[1] != 0;
}

static bool is_undistorted(const struct camera *c)
{
    for (int i = 0; i < 6; i++)
        if (c->k[i] != 0)
            return false;
    return c->model != CAMERA_FISHEYE && !has_tangential(c);
}

// From (X/Z, Y/Z) to the same direction with the angle, not its tangent, as radius; A: the (symmetric) 2x2 derivative.
static void to_angles(double x, double y, double a[2], double A[4])
{
    const double s = x * x + y * y, r = sqrt(s);
    double f = 1 - s / 3, f_s = -1. / 3; // series: atan r = r - r^3 / 3
    if (r >= 1e-4)
        f = atan(r) / r, f_s = (1 / (1 + s) - f) / (2 * s);
    a[0] = x * f, a[1] = y * f;
    A[0] = f + 2 * x * x * f_s, A[1] = A[2] = 2 * x * y * f_s, A[3] = f + 2 * y * y * f_s;
}

// The polynomial part, in tangents (fisheye: in angles). d[2] = distorted (x, y), D = its 2x2 derivative. False beyond the
// monotonic range.
static bool distort_plane(const struct camera *c, double x, double y, double d[2], double D[4])
{
    const double *k = c->k, *p = c->p;
    const double s = x * x + y * y;
    double f, f_s; // radial factor, and its derivative by s = r^2
    if (!is_monotonic(c, s))
        return false;
    if (c->model == CAMERA_RATIONAL) {
        const double n = 1 + s * (k[0] + s * (k[1] + s * k[2])), m = 1 + s * (k[3] + s * (k[4] + s * k[5]));
        const double n_s = k[0] + s * (2 * k[1] + s * 3 * k[2]), m_s = k[3] + s * (2 * k[4] + s * 3 * k[5]);
        f = n / m, f_s = (n_s - f * m_s) / m;
    } else {
        f = 1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])));
        f_s = k[0] + s * (2 * k[1] + s * (3 * k[2] + s * 4 * k[3]));
    }
    d[0] = x * f, d[1] = y * f;
    D[0] = f + 2 * x * x * f_s, D[1] = D[2] = 2 * x * y * f_s, D[3] = f + 2 * y * y * f_s;
    if (has_tangential(c)) {
        const double tx = 2 * p[0] * x * y + p[1] * (s + 2 * x * x), ty = 2 * p[1] * x * y + p[0] * (s + 2 * y * y);
        const double g = 1 + s * (p[2] + s * p[3]), g_s = p[2] + 2 * s * p[3];
        d[0] += tx * g, d[1] += ty * g;
        D[0] += (2 * p[0] * y + 6 * p[1] * x) * g + tx * g_s * 2 * x;
        D[1] += (2 * p[0] * x + 2 * p[1] * y) * g + tx * g_s * 2 * y;
        D[2] += (2 * p[1] * y + 2 * p[0] * x) * g + ty * g_s * 2 * x;
        D[3] += (2 * p[1] * x + 6 * p[0] * y) * g + ty * g_s * 2 * y;
    }
    return isfinite(d[0]) && isfinite(d[1]);
}

static bool distort(const struct camera *c, double x, double y, double d[2], double D[4])
{
    double a[2], A[4], B[4];
    if (is_undistorted(c)) {
        d[0] = x, d[1] = y;
        D[0] = D[3] = 1, D[1] = D[2] = 0;
        return true;
    }
    if (c->model != CAMERA_FISHEYE)
        return distort_plane(c, x, y, d, D);
    to_angles(x, y, a, A);
    if (!distort_plane(c, a[0], a[1], d, B))
        return false;
    D[0] = B[0] * A[0] + B[1] * A[2], D[1] = B[0] * A[1] + B[1] * A[3];
    D[2] = B[2] * A[0] + B[3] * A[2], D[3] = B[2] * A[1] + B[3] * A[3];
    return true;
}

// The inverse of distort_plane: Newton, with halved steps where a full one does not help. False: no solution near.
static bool undistort_newton(const struct camera *c, const double d[2], double xy[2])
{
    double x = d[0], y = d[1], e[2], D[4];
    while (!distort_plane(c, x, y, e, D)) { // start inside the model's range
        x *= .5, y *= .5;
        if (fabs(x) + fabs(y) < 1e-12)
            return false;
    }
    double r0 = e[0] - d[0], r1 = e[1] - d[1];
    for (int i = 0; i < 50; i++) {
        const double det = D[0] * D[3] - D[1] * D[2];
        if (!(fabs(det) > 1e-12))
            return false;
        const double sx = -(D[3] * r0 - D[1] * r1) / det, sy = -(D[0] * r1 - D[2] * r0) / det;
        const double before = hypot(r0, r1);
        if (before < 1e-16 * (1 + hypot(d[0], d[1])))
            break;
        double step = 1;
        for (;; step *= .5) {
            if (step < 1e-6) // as good as it gets
                goto done;
            if (!distort_plane(c, x + step * sx, y + step * sy, e, D))
                continue;
            if (hypot(e[0] - d[0], e[1] - d[1]) < before)
                break;
        }
        x += step * sx, y += step * sy;
        r0 = e[0] - d[0], r1 = e[1] - d[1];
    }
done:
    xy[0] = x, xy[1] = y;
    return hypot(r0, r1) < 1e-10;
}

// The angle whose distorted angle is ad: the slope is positive over the whole range, so bisection guards Newton.
static bool fisheye_angle(const struct camera *c, double ad, double *angle)
{
    const double *k = c->k;
    double lo = 0, hi = 1.5707963267948966;
    if (!is_monotonic(c, hi * hi)) { // shrink to the monotonic range
        double bad = hi;
        hi = 0;
        for (int i = 0; i < 50; i++) {
            const double middle = .5 * (hi + bad);
            if (is_monotonic(c, middle * middle))
                hi = middle;
            else
                bad = middle;
        }
    }
    double a = ad < hi ? ad : .5 * hi, f = 1;
    for (int i = 0; i < 100; i++) {
        const double a2 = a * a;
        f = a * (1 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3])))) - ad;
        const double slope = 1 + a2 * (3 * k[0] + a2 * (5 * k[1] + a2 * (7 * k[2] + a2 * 9 * k[3])));
        if (f > 0)
            hi = a;
        else
            lo = a;
        double next = a - f / slope;
        if (!(next >= lo && next <= hi))
            next = .5 * (lo + hi);
        const bool is_done = fabs(next - a) < 1e-16 + 2e-16 * a;
        a = next;
        if (is_done)
            break;
    }
    *angle = a;
    return fabs(f) < 1e-10;
}

// ---- the camera ---------------------------------------------------------------------------------------------------------

static bool project(const struct camera *c, const double point_m[3], double uv_px[2], double *depth_m, double *J)
{
    double q[3], d[2], D[4];
    mat3_mul_vec(q, c->cam_from_world, point_m);
    for (int i = 0; i < 3; i++)
        q[i] += c->t_m[i];
    if (!(q[2] > min_depth))
        return false;
    const double x = q[0] / q[2], y = q[1] / q[2];
    if (!distort(c, x, y, d, D))
        return false;
    uv_px[0] = c->fx * d[0] + c->skew * d[1] + c->cx;
    uv_px[1] = c->fy * d[1] + c->cy;
    if (depth_m)
        *depth_m = q[2];
    if (!J)
        return true;
    const double by_xy[4] = {
        c->fx * D[0] + c->skew * D[2], c->fx * D[1] + c->skew * D[3],
        c->fy * D[2], c->fy * D[3],
    };
    for (int row = 0; row < 2; row++) {
        const double a = by_xy[2 * row], b = by_xy[2 * row + 1];
        const double by_q[3] = { a / q[2], b / q[2], -(a * x + b * y) / q[2] };
        mat3_tmul_vec(J + 3 * row, c->cam_from_world, by_q);
    }
    return true;
}

bool camera_project(const struct camera *c, const double point_m[3], double uv_px[2], double *depth_m)
{
    return project(c, point_m, uv_px, depth_m, NULL);
}

bool camera_project_jacobian(const struct camera *c, const double point_m[3], double uv_px[2], double J[6])
{
    return project(c, point_m, uv_px, NULL, J);
}

bool camera_ray(const struct camera *c, const double uv_px[2], double dir_world[3])
{
    double d[2], q[3];
    d[1] = (uv_px[1] - c->cy) / c->fy;
    d[0] = (uv_px[0] - c->cx - c->skew * d[1]) / c->fx;
    if (!isfinite(d[0]) || !isfinite(d[1]))
        return false;
    if (c->model == CAMERA_FISHEYE) {
        double a;
        if (has_tangential(c)) {
            if (!undistort_newton(c, d, d))
                return false;
            a = hypot(d[0], d[1]);
        } else if (!fisheye_angle(c, hypot(d[0], d[1]), &a)) {
            return false;
        }
        const double length = hypot(d[0], d[1]), sine = length > 1e-12 ? sin(a) / length : 1;
        q[0] = d[0] * sine, q[1] = d[1] * sine, q[2] = cos(a);
        if (!(a < M_PI_2 && q[2] > 0))
            return false;
    } else if (is_undistorted(c)) {
        q[0] = d[0], q[1] = d[1], q[2] = 1;
    } else {
        if (!undistort_newton(c, d, q))
            return false;
        q[2] = 1;
    }
    mat3_tmul_vec(dir_world, c->cam_from_world, q);
    return isfinite(vec3_normalise(dir_world)); // an absurd focal length leads beyond what a square can hold
}

void camera_look_at(struct camera *c, const double centre_m[3], const double target_m[3], const double up[3])
{
    double forward[3], right[3], down[3];
    vec3_sub(forward, target_m, centre_m);
    if (vec3_normalise(forward) == 0)
        forward[2] = 1;
    vec3_cross(right, forward, up);
    if (vec3_normalise(right) <= 1e-12 * vec3_norm(up)) { // looking along up: any right will do
        const double other[3] = { fabs(forward[0]) < .6, fabs(forward[0]) >= .6, 0 };
        vec3_cross(right, forward, other);
        vec3_normalise(right);
    }
    vec3_cross(down, forward, right);
    for (int i = 0; i < 3; i++) {
        c->cam_from_world[i] = right[i];
        c->cam_from_world[3 + i] = down[i];
        c->cam_from_world[6 + i] = forward[i];
        c->centre_m[i] = centre_m[i];
    }
    mat3_mul_vec(c->t_m, c->cam_from_world, centre_m);
    for (int i = 0; i < 3; i++)
        c->t_m[i] = -c->t_m[i];
}

bool camera_has_aspect(const struct camera *c, int width_px, int height_px)
{
    const int64_t across = (int64_t)height_px * c->width_px - (int64_t)width_px * c->height_px;
    const int sides[] = {width_px, height_px, c->width_px, c->height_px};
    bool is_rounding = false;
    for (int i = 0; i < 4; i++)
        is_rounding = is_rounding || 2 * llabs(across) <= sides[i];
    return is_rounding;
}

void camera_resize(struct camera *c, int width_px, int height_px)
{
    const double sx = (double)width_px / c->width_px, sy = (double)height_px / c->height_px;
    c->fx *= sx, c->skew *= sx, c->cx *= sx;
    c->fy *= sy, c->cy *= sy;
    c->width_px = width_px, c->height_px = height_px;
}

// ---- the set ------------------------------------------------------------------------------------------------------------

const struct camera *cameras_find(const struct cameras *c, const char *name)
{
    for (int i = 0; i < c->n; i++)
        if (!strcmp(c->view[i].name, name))
            return &c->view[i];
    return NULL;
}

void cameras_free(struct cameras *c)
{
    if (!c)
        return;
    free(c->view);
    memset(c, 0, sizeof(*c));
}

// ---- which reader -------------------------------------------------------------------------------------------------------

// COLMAP comes first: in a folder, its files win over sidecars lying beside them.
static const struct cameras_format {
    const char *name;
    bool (*probe)(const struct cameras_source *s);
    int (*read)(struct cameras *out, const struct cameras_source *s);
} formats[] = {
    { "COLMAP", cameras_colmap_probe, cameras_colmap_read },
    { "Bundler", cameras_bundler_probe, cameras_bundler_read },
    { "Agisoft Metashape XML", cameras_metashape_probe, cameras_metashape_read },
    { "RealityCapture", cameras_realitycapture_probe, cameras_realitycapture_read },
    { "Meshroom (AliceVision SfMData JSON)", cameras_meshroom_probe, cameras_meshroom_read },
};

static const struct cameras_format *format_of(const struct cameras_source *s)
{
    for (size_t i = 0; i < sizeof(formats) / sizeof(formats[0]); i++)
        if (formats[i].probe(s))
            return &formats[i];
    return NULL;
}

// A file's first bytes. 0 or -errno (not logged).
static int look_at(struct cameras_source *s, char *head, size_t n_head)
{
    struct stat st;
    head[0] = 0;
    s->head = head, s->n_head = 0;
    if (stat(s->path, &st))
        return -errno;
    s->is_folder = S_ISDIR(st.st_mode);
    if (s->is_folder)
        return 0;
    FILE *f = S_ISREG(st.st_mode) ? fopen(s->path, "rbe") : NULL;
    if (!f)
        return S_ISREG(st.st_mode) ? -errno : -EINVAL;
    s->n_head = fread(head, 1, n_head - 1, f);
    head[s->n_head] = 0;
    fclose(f);
    return 0;
}

static const char expected[] = "COLMAP's cameras and images (.bin or .txt), a Bundler bundle.out, a Metashape XML, RealityCapture "
                               "XMP sidecars or CSV, or Meshroom's sfm JSON";

// The one file in a folder that is of a known format.
static int read_from_folder(struct cameras *out, const struct cameras_source *folder)
{
    struct dirent **entries = NULL;
    char *found = NULL;
    const struct cameras_format *format = NULL;
    int n = scandir(folder->path, &entries, NULL, cameras_by_name), err = n < 0 ? -errno : 0;
    if (err)
        log_error("cameras: cannot list %s: %s", folder->path, strerror(-err));
    for (int i = 0; i < n; i++) {
        char *path = NULL, head[4096];
        struct cameras_source s = *folder;
        const struct cameras_format *is = NULL;
        if (!err && entries[i]->d_name[0] != '.' && asprintf(&path, "%s/%s", folder->path, entries[i]->d_name) >= 0) {
            s.path = path, s.is_listed = true;
            if (!look_at(&s, head, sizeof(head)) && !s.is_folder)
                is = format_of(&s);
        }
        free(entries[i]);
        if (is && found) {
            log_error("cameras: %s holds both %s (%s) and %s (%s); leave one of them, or name it", folder->path, found, format->name,
                      path, is->name);
            err = -EINVAL;
        }
        if (is && !found)
            found = path, format = is;
        else
            free(path);
    }
    free(entries);
    if (!err && !found) {
        log_error("cameras: %s: no cameras in this folder; expected %s", folder->path, expected);
        err = -EINVAL;
    }
    if (!err) {
        char head[4096];
        struct cameras_source s = *folder;
        s.path = found;
        err = look_at(&s, head, sizeof(head));
        if (!err)
            err = format->read(out, &s);
    }
    free(found);
    return err;
}

int cameras_read_with(struct cameras *out, const char *path, const struct cameras_options *options)
{
    char head[4096];
    static const struct cameras_options nothing;
    struct cameras_source s = { .path = path, .options = options ? options : &nothing };
    memset(out, 0, sizeof(*out));
    const int err = look_at(&s, head, sizeof(head));
    if (err) {
        log_error("cameras: cannot open %s: %s", path, strerror(-err));
        return err;
    }
    const struct cameras_format *format = format_of(&s);
    if (format)
        return format->read(out, &s);
    if (s.is_folder)
        return read_from_folder(out, &s);
    log_error("cameras: %s: not a known camera file; expected %s", path, expected);
    return -EINVAL;
}

int cameras_read(struct cameras *out, const char *path)
{
    return cameras_read_with(out, path, NULL);
}
