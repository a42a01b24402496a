// rigd/lens.c - lens models. One path for all: ideal radius, Brown's polynomial, focal length; they differ in r(a) only.
//
// The solid angle follows from the same two steps: on the ideal plane a unit of area is sin a / (r r') steradians (1 for equisolid,
// hence its name), and the polynomial's determinant is the rest.
#include "rigd/lens.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <string.h>

static const char *const model_name[LENS_MODELS] = { "rectilinear", "equidistant", "equisolid", "stereographic" };
static const double widest_deg[LENS_MODELS] = { 85, 180, 180, 170 };

const char *lens_model_name(enum lens_model m)
{
    return model_name[m];
}

// ---- r(a) ---------------------------------------------------------------------------------------------------------------

static double radius_of(enum lens_model m, double a)
{
    return m == LENS_RECTILINEAR ? tan(a) : m == LENS_EQUIDISTANT ? a : m == LENS_EQUISOLID ? 2 * sin(.5 * a) : 2 * tan(.5 * a);
}

static double angle_of(enum lens_model m, double r)
{
    return m == LENS_RECTILINEAR ? atan(r) : m == LENS_EQUIDISTANT ? r : m == LENS_EQUISOLID ? 2 * asin(fmin(.5 * r, 1)) : 2 * atan(.5 * r);
}

// sin a / (r r'): steradians per unit of area of the ideal plane.
static double density(enum lens_model m, double a)
{
    const double c = cos(a), h = cos(.5 * a);
    switch (m) {
    case LENS_RECTILINEAR:
        return c * c * c;
    case LENS_EQUIDISTANT:
        return a > 1e-4 ? sin(a) / a : 1 - a * a / 6;
    case LENS_EQUISOLID:
        return 1;
    default:
        return h * h * h * h;
    }
}

// ---- Brown's polynomial ---------------------------------------------------------------------------------------------------

static double radial(const struct lens *l, double s)
{
    return 1 + s * (l->k[0] + s * (l->k[1] + s * l->k[2]));
}

// d(r radial(r^2)) / dr: positive where the distortion keeps the order of radii.
static double radial_slope(const struct lens *l, double s)
{
    return 1 + s * (3 * l->k[0] + s * (5 * l->k[1] + s * 7 * l->k[2]));
}

static void distort(const struct lens *l, const double u[2], double d[2], double J[4])
{
    const double x = u[0], y = u[1], s = x * x + y * y, f = radial(l, s);
    const double f_s = l->k[0] + s * (2 * l->k[1] + s * 3 * l->k[2]);
    d[0] = x * f + 2 * l->p[0] * x * y + l->p[1] * (s + 2 * x * x);
    d[1] = y * f + l->p[0] * (s + 2 * y * y) + 2 * l->p[1] * x * y;
    J[0] = f + 2 * x * x * f_s + 2 * l->p[0] * y + 6 * l->p[1] * x;
    J[1] = J[2] = 2 * x * y * f_s + 2 * l->p[0] * x + 2 * l->p[1] * y;
    J[3] = f + 2 * y * y * f_s + 6 * l->p[0] * y + 2 * l->p[1] * x;
}

// The ideal point that comes to d: Newton along the radius, kept between bounds, then in the plane where the lens is not centred.
static bool undistort(const struct lens *l, const double d[2], double u[2])
{
    const double rd = hypot(d[0], d[1]);
    u[0] = d[0], u[1] = d[1];
    if (l->k[0] == 0 && l->k[1] == 0 && l->k[2] == 0 && l->p[0] == 0 && l->p[1] == 0)
        return rd <= l->max_r;
    double lo = 0, hi = l->max_r, r = fmin(rd, hi);
    for (int i = 0; i < 100 && rd > 0; i++) {
        const double f = r * radial(l, r * r) - rd;
        *(f > 0 ? &hi : &lo) = r;
        double next = r - f / radial_slope(l, r * r);
        if (!(next >= lo && next <= hi))
            next = .5 * (lo + hi);
        const bool is_done = fabs(next - r) <= 1e-15 * r;
        r = next;
        if (is_done)
            break;
    }
    const double scale = rd > 0 ? r / rd : 0;
    u[0] *= scale, u[1] *= scale;
    double at[2], J[4];
    for (int i = 0; i < 30; i++) {
        distort(l, u, at, J);
        const double ex = d[0] - at[0], ey = d[1] - at[1], det = J[0] * J[3] - J[1] * J[2];
        if (fabs(ex) + fabs(ey) <= 1e-14 * (1 + rd))
            break;
        if (!(det > 0))
            return false;
        u[0] += (J[3] * ex - J[1] * ey) / det;
        u[1] += (J[0] * ey - J[2] * ex) / det;
    }
    distort(l, u, at, J);
    return fabs(d[0] - at[0]) + fabs(d[1] - at[1]) <= 1e-11 * (1 + rd) && hypot(u[0], u[1]) <= l->max_r * (1 + 1e-12);
}

// ---- checks ---------------------------------------------------------------------------------------------------------------

static int refuse(const char *name, const char *what, double found, const char *expected)
{
    log_error("lens: %s: %s is %g: expected %s", name, what, found, expected);
    return -EINVAL;
}

int lens_init(struct lens *l, const char *name)
{
    const double all[] = { l->focal_px, l->centre_px[0], l->centre_px[1], l->k[0], l->k[1], l->k[2], l->p[0], l->p[1],
                           l->circle_px, l->max_angle_rad, l->v[0], l->v[1], l->v[2] };
    for (size_t i = 0; i < sizeof(all) / sizeof(all[0]); i++)
        if (!(fabs(all[i]) <= 1e6))
            return refuse(name, "a number of the lens", all[i], "at most 1e6");
    if (l->width_px < 2 || l->width_px > 65536)
        return refuse(name, "width_px", l->width_px, "2 .. 65536");
    if (l->height_px < 2 || l->height_px > 65536)
        return refuse(name, "height_px", l->height_px, "2 .. 65536");
    if (!(l->focal_px >= 1))
        return refuse(name, "focal_px", l->focal_px, "1 or more (focal length in mm / size of a pixel in mm)");
    if (l->circle_px < 0)
        return refuse(name, "circle_px", l->circle_px, "the image circle's radius in pixels, or 0");
    const double widest = widest_deg[l->model] * M_PI / 180;
    if (l->max_angle_rad == 0)
        l->max_angle_rad = widest;
    if (!(l->max_angle_rad > 0 && l->max_angle_rad <= widest * (1 + 1e-12)))
        return refuse(name, "max_angle_deg", l->max_angle_rad * 180 / M_PI, "0 .. the widest of this model (rectilinear 85, stereographic 170, others 180)");
    // Up to where radii keep their order. 1,000 steps: a fold narrower than that does no harm to undistort, which stays between bounds.
    enum { STEPS = 1000 };
    const double most = radius_of(l->model, l->max_angle_rad);
    l->max_r = most;
    for (int i = 0; i <= STEPS; i++) {
        const double r = most * i / STEPS;
        if (!(radial_slope(l, r * r) > 0)) {
            l->max_r = most * (i - 1) / STEPS;
            break;
        }
    }
    for (int corner = 0; corner < 4; corner++) {
        const double px[2] = { corner & 1 ? l->width_px : 0, corner & 2 ? l->height_px : 0 };
        double reach = hypot(px[0] - l->centre_px[0], px[1] - l->centre_px[1]);
        if (l->circle_px > 0 && reach > l->circle_px)
            reach = l->circle_px;
        for (int i = 0; i <= 64; i++) {
            const double at[2] = { l->centre_px[0] + reach * i / 64, l->centre_px[1] };
            if (!(lens_shading(l, at) >= .01))
                return refuse(name, "shading within the frame", lens_shading(l, at), ".01 or more of the centre's light");
        }
    }
    return 0;
}

int lens_from_json(struct lens *out, const struct json *v, const char *path, const char *name)
{
    struct lens l = { 0 };
    const struct json *o = json_get(v, path);
    const char *model;
    double size[2], distortion[5] = { 0 }, degrees = 0;
    memset(out, 0, sizeof(*out));
    if (!o) {
        log_error("lens: %s: no \"%s\": expected an object with model, width_px, height_px, focal_px", name, path);
        return -EINVAL;
    }
    if (json_require_string(o, "model", &model, name) || json_require_numbers(o, "width_px", &size[0], 1, name) ||
        json_require_numbers(o, "height_px", &size[1], 1, name) || json_require_numbers(o, "focal_px", &l.focal_px, 1, name))
        return -EINVAL;
    while (l.model < LENS_MODELS && strcmp(model, model_name[l.model]) != 0)
        l.model++;
    if (l.model == LENS_MODELS) {
        log_error("lens: %s: model is \"%.40s\": expected rectilinear, equidistant, equisolid or stereographic", name, model);
        return -EINVAL;
    }
    for (int i = 0; i < 2; i++)
        if (!(size[i] >= 2 && size[i] <= 65536) || size[i] != floor(size[i]))
            return refuse(name, i ? "height_px" : "width_px", size[i], "a whole number, 2 .. 65536");
    l.width_px = (int)size[0], l.height_px = (int)size[1];
    l.centre_px[0] = .5 * size[0], l.centre_px[1] = .5 * size[1];
    const struct {
        const char *key;
        double *to;
        int n;
    } optional[] = { { "centre_px", l.centre_px, 2 }, { "distortion", distortion, 5 }, { "circle_px", &l.circle_px, 1 },
                     { "max_angle_deg", &degrees, 1 }, { "shading", l.v, 3 } };
    for (size_t i = 0; i < sizeof(optional) / sizeof(optional[0]); i++)
        if (json_get(o, optional[i].key) && json_require_numbers(o, optional[i].key, optional[i].to, optional[i].n, name))
            return -EINVAL;
    memcpy(l.k, distortion, sizeof(l.k));
    memcpy(l.p, distortion + 3, sizeof(l.p));
    l.max_angle_rad = degrees * M_PI / 180;
    const int err = lens_init(&l, name);
    if (!err)
        *out = l;
    return err;
}

// ---- pixels and directions ------------------------------------------------------------------------------------------------

static bool is_in_circle(const struct lens *l, const double px[2])
{
    return l->circle_px == 0 || hypot(px[0] - l->centre_px[0], px[1] - l->centre_px[1]) <= l->circle_px;
}

struct json *lens_json(const struct lens *l)
{
    struct json *o = json_new_object();
    const double distortion[5] = { l->k[0], l->k[1], l->k[2], l->p[0], l->p[1] };
    json_set_string(o, "model", lens_model_name(l->model));
    json_set_int(o, "width_px", l->width_px);
    json_set_int(o, "height_px", l->height_px);
    json_set_number(o, "focal_px", l->focal_px);
    json_set_numbers(o, "centre_px", l->centre_px, 2);
    json_set_numbers(o, "distortion", distortion, 5);
    json_set_number(o, "circle_px", l->circle_px);
    json_set_number(o, "max_angle_deg", l->max_angle_rad * 180 / M_PI);
    json_set_numbers(o, "shading", l->v, 3);
    return o;
}

bool lens_project(const struct lens *l, const double dir[3], double px[2])
{
    const double across = hypot(dir[0], dir[1]), a = atan2(across, dir[2]);
    if (!(a <= l->max_angle_rad))
        return false;
    const double r = l->model == LENS_RECTILINEAR ? across / dir[2] : radius_of(l->model, a);
    if (r > l->max_r)
        return false;
    const double u[2] = { across > 0 ? r * dir[0] / across : 0, across > 0 ? r * dir[1] / across : 0 };
    double d[2], J[4];
    distort(l, u, d, J);
    px[0] = l->centre_px[0] + l->focal_px * d[0];
    px[1] = l->centre_px[1] + l->focal_px * d[1];
    return is_in_circle(l, px);
}

static bool ideal_point(const struct lens *l, const double px[2], double u[2])
{
    const double d[2] = { (px[0] - l->centre_px[0]) / l->focal_px, (px[1] - l->centre_px[1]) / l->focal_px };
    return is_in_circle(l, px) && undistort(l, d, u);
}

bool lens_ray(const struct lens *l, const double px[2], double dir[3])
{
    double u[2];
    if (!ideal_point(l, px, u))
        return false;
    const double r = hypot(u[0], u[1]), a = angle_of(l->model, r), sine = sin(a);
    dir[0] = r > 0 ? sine * u[0] / r : 0;
    dir[1] = r > 0 ? sine * u[1] / r : 0;
    dir[2] = cos(a);
    return true;
}

double lens_solid_angle(const struct lens *l, const double px[2])
{
    double u[2], d[2], J[4];
    if (!ideal_point(l, px, u))
        return 0;
    distort(l, u, d, J);
    return density(l->model, angle_of(l->model, hypot(u[0], u[1]))) / (l->focal_px * l->focal_px * (J[0] * J[3] - J[1] * J[2]));
}

double lens_shading(const struct lens *l, const double px[2])
{
    const double x = (px[0] - l->centre_px[0]) / l->focal_px, y = (px[1] - l->centre_px[1]) / l->focal_px, t = x * x + y * y;
    return 1 + t * (l->v[0] + t * (l->v[1] + t * l->v[2]));
}

double lens_reach_px(const struct lens *l)
{
    double reach = 0;
    for (int i = 0; i < 64; i++) {
        const double b = 2 * M_PI * i / 64, u[2] = { l->max_r * cos(b), l->max_r * sin(b) };
        double d[2], J[4];
        distort(l, u, d, J);
        reach = fmax(reach, l->focal_px * hypot(d[0], d[1]));
    }
    return l->circle_px > 0 ? fmin(reach, l->circle_px) : reach;
}

void lens_head(double R[9], double yaw, double pitch, double roll)
{
    const double cy = cos(yaw), sy = sin(yaw), cp = cos(pitch), sp = sin(pitch), cr = cos(roll), sr = sin(roll);
    // Columns: where the camera's right, down and forward point before the roll.
    const double right[3] = { -cy, 0, sy }, down[3] = { sy * sp, -cp, cy * sp }, forward[3] = { sy * cp, sp, cy * cp };
    for (int i = 0; i < 3; i++) {
        R[3 * i] = cr * right[i] + sr * down[i];
        R[3 * i + 1] = cr * down[i] - sr * right[i];
        R[3 * i + 2] = forward[i];
    }
}
