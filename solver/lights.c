// solver/lights.c - cutting a panorama into lights, their irradiance at a point with derivatives,
// and lights.json.
//
// Letters (paper, Eqs. 1-4): dh probe direction, C irradiance, c centre, R world_from_probe, and
// q = 1/r. All others: NOTATION.md.
#include "solver/lights.h"
#include "solver/orientation.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <assert.h>
#include <errno.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// ---- memory -------------------------------------------------------------------------------------

int lights_new(struct lights *out, int n)
{
    assert(n >= 1);
    struct lights l = {
        .n = n,
        .dir_probe = calloc((size_t)n, sizeof(*l.dir_probe)),
        .irradiance = calloc((size_t)n, sizeof(*l.irradiance)),
        .inverse_distance = calloc((size_t)n, sizeof(*l.inverse_distance)),
        .group = malloc((size_t)n * sizeof(*l.group)),
        .world_from_probe = {1, 0, 0, 0, 1, 0, 0, 0, 1},
    };
    memset(out, 0, sizeof(*out));
    if (!l.dir_probe || !l.irradiance || !l.inverse_distance || !l.group) {
        lights_free(&l);
        return -ENOMEM;
    }
    for (int i = 0; i < n; i++)
        l.group[i] = -1;
    *out = l;
    return 0;
}

void lights_free(struct lights *l)
{
    if (!l)
        return;
    free(l->dir_probe);
    free(l->irradiance);
    free(l->region);
    free(l->spread_rad);
    free(l->inverse_distance);
    free(l->group);
    memset(l, 0, sizeof(*l));
}

// ---- one light at one point (Eqs. 1-4) ----------------------------------------------------------
//
//   a = R dh,  u = a + q (c - p),  s = |u|,  l = u / s,  weight = max(<u, a>, 0) / s^3
//
// With r = 1/q this is l = (l_p - p)/|l_p - p| and weight = r^2/|l_p - p|^2 max(<l, l_d>, 0), for
// l_p - p = r u. A light emits into the half space in front of it: behind it the weight is 0. The
// point at the light itself (s below rounding) has no direction; it gets l = a and weight 0.

static const double s_min = 1e-12;

// Returns false where the weight, and with it every derivative, is 0.
static bool light_vector(const struct lights *l, int i, const double p[3], double a[3], double u[3],
                         double *s, struct light_at *at)
{
    const double q = l->inverse_distance[i];
    mat3_mul_vec(a, l->world_from_probe, l->dir_probe[i]);
    for (int k = 0; k < 3; k++)
        u[k] = a[k] + q * (l->centre_m[k] - p[k]);
    *s = vec3_norm(u);
    const double facing = vec3_dot(u, a);
    at->weight = 0;
    if (!(*s > s_min)) {
        memcpy(at->l, a, sizeof(at->l));
        return false;
    }
    for (int k = 0; k < 3; k++)
        at->l[k] = u[k] / *s;
    if (!(facing > 0))
        return false;
    at->weight = facing / (*s * *s * *s);
    return true;
}

void light_at_point(const struct lights *l, int i, const double point_m[3], struct light_at *out)
{
    double a[3], u[3], s;
    light_vector(l, i, point_m, a, u, &s, out);
}

// By the chain rule over u and a, with m = <u, a>:
//   dl/du = (I - l l^T)/s,  dweight/du = a/s^3 - 3 m u/s^5,  dweight/da = u/s^3
//   du/dc = q I,  du/dp = -q I,  du/dq = c - p
//   da/dw = du/dw = -[a]x, for R = exp([w]x) R0 moves a by w x a
void light_at_point_gradient(const struct lights *l, int i, const double point_m[3],
                             struct light_at_gradient *out)
{
    double a[3], u[3], s;
    memset(out, 0, sizeof(*out));
    if (!light_vector(l, i, point_m, a, u, &s, &out->at))
        return;
    const double q = l->inverse_distance[i], s3 = s * s * s, m = vec3_dot(u, a);
    const double minus_a_cross[9] = {0, a[2], -a[1], -a[2], 0, a[0], a[1], -a[0], 0};
    double l_u[9], weight_u[3], weight_ua[3], c_minus_p[3];
    vec3_sub(c_minus_p, l->centre_m, point_m);
    for (int j = 0; j < 3; j++) {
        weight_u[j] = a[j] / s3 - 3 * m * u[j] / (s3 * s * s);
        weight_ua[j] = weight_u[j] + u[j] / s3;
        for (int k = 0; k < 3; k++)
            l_u[3 * j + k] = ((j == k) - out->at.l[j] * out->at.l[k]) / s;
    }
    for (int j = 0; j < 9; j++) {
        out->l_centre[j] = q * l_u[j];
        out->l_point[j] = -q * l_u[j];
    }
    for (int j = 0; j < 3; j++) {
        out->weight_centre[j] = q * weight_u[j];
        out->weight_point[j] = -q * weight_u[j];
    }
    mat3_mul(out->l_rotation, l_u, minus_a_cross);
    mat3_tmul_vec(out->weight_rotation, minus_a_cross, weight_ua);
    mat3_mul_vec(out->l_inverse_distance, l_u, c_minus_p);
    out->weight_inverse_distance = vec3_dot(weight_u, c_minus_p);
}

// ---- median cut ---------------------------------------------------------------------------------

struct cutter {
    const struct panorama *p;
    int width, height;
    double *sin_lon, *cos_lon;         // [width] of pixel centres
    double *sin_lat, *cos_lat, *omega; // [height]; omega: solid angle of the row's pixels
    double *along;                     // [width] energy of each column or row of one region
    struct lights *out;
};

// What the cut halves: luminance by Rec. 709.
static double luminance(const float *rgb)
{
    return .2126 * rgb[0] + .7152 * rgb[1] + .0722 * rgb[2];
}

static const float *pixel_at(const struct cutter *k, int x, int y)
{
    return k->p->image.data + 3 * ((int64_t)y * k->width + x);
}

// Energy per column (by_columns) or row of the region into k->along. Summed from the pixels
// themselves, so that a region of no energy is exactly 0; differences of one table over the whole
// panorama would leave its rounding there.
static double sum_along(const struct cutter *k, const struct light_region *r, bool by_columns)
{
    double total = 0;
    memset(k->along, 0, (size_t)(by_columns ? r->x1 - r->x0 : r->y1 - r->y0) * sizeof(double));
    for (int y = r->y0; y < r->y1; y++) {
        double row = 0;
        for (int x = r->x0; x < r->x1; x++) {
            const double energy = luminance(pixel_at(k, x, y)) * k->omega[y];
            row += energy;
            if (by_columns)
                k->along[x - r->x0] += energy;
        }
        if (!by_columns)
            k->along[y - r->y0] = row;
        total += row;
    }
    return total;
}

// Where energies along[0..n) are best halved: in [1, n-1]. Of equally good places the one nearest
// the middle, so that lone bright pixels on black are found in log2 steps.
static int halving_place(const double *along, int n, double total)
{
    double before = 0, best = INFINITY;
    int place = 1;
    for (int i = 1; i < n; i++) {
        before += along[i - 1];
        const double miss = fabs(before - (total - before));
        if (miss < best || (miss == best && abs(2 * i - n) < abs(2 * place - n)))
            best = miss, place = i;
    }
    return place;
}

// False: one pixel, or no energy.
static bool split(const struct cutter *k, const struct light_region *r, struct light_region half[2])
{
    const int width = r->x1 - r->x0, height = r->y1 - r->y0;
    const double elevation = M_PI / 2 - M_PI * (r->y0 + r->y1) / (2. * k->height);
    const bool by_columns = height == 1 || (width > 1 && width * cos(elevation) >= height);
    const double total = sum_along(k, r, by_columns);
    if ((width == 1 && height == 1) || total <= 0)
        return false;
    const int place = halving_place(k->along, by_columns ? width : height, total);
    half[0] = half[1] = *r;
    if (by_columns)
        half[0].x1 = half[1].x0 = r->x0 + place;
    else
        half[0].y1 = half[1].y0 = r->y0 + place;
    return true;
}

// Of unit vectors; exact for small angles.
static double angle_between(const double a[3], const double b[3])
{
    const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    return 2 * asin(fmin(vec3_norm(d) / 2, 1));
}

// Fill light i from the pixels of its region.
static void measure(const struct cutter *k, int i, const struct light_region *r)
{
    double *irradiance = k->out->irradiance[i], *dir = k->out->dir_probe[i];
    double toward[3] = {0, 0, 0}, energy = 0; // sum of energy x direction, and of energy
    k->out->region[i] = *r;
    for (int y = r->y0; y < r->y1; y++) {
        double row_rgb[3] = {0, 0, 0}, row_x = 0, row_z = 0, row = 0;
        for (int x = r->x0; x < r->x1; x++) {
            const float *rgb = pixel_at(k, x, y);
            const double lum = luminance(rgb);
            for (int c = 0; c < 3; c++)
                row_rgb[c] += rgb[c];
            row += lum, row_x += lum * k->sin_lon[x], row_z += lum * k->cos_lon[x];
        }
        for (int c = 0; c < 3; c++)
            irradiance[c] += row_rgb[c] * k->omega[y];
        energy += row * k->omega[y];
        toward[0] += row_x * k->cos_lat[y] * k->omega[y];
        toward[1] += row * k->sin_lat[y] * k->omega[y];
        toward[2] += row_z * k->cos_lat[y] * k->omega[y];
    }
    panorama_direction(k->width, k->height, (r->x0 + r->x1) / 2., (r->y0 + r->y1) / 2., dir);
    if (vec3_norm(toward) > 1e-9 * energy) { // else: no energy, or evenly all around
        vec3_normalise(toward);
        memcpy(dir, toward, sizeof(toward));
    }
    double sum = 0;
    for (int y = r->y0; y < r->y1; y++) {
        double row = 0;
        for (int x = r->x0; x < r->x1; x++) {
            const double lum = luminance(pixel_at(k, x, y));
            if (lum <= 0)
                continue;
            const double d[3] = {k->sin_lon[x] * k->cos_lat[y], k->sin_lat[y],
                                 k->cos_lon[x] * k->cos_lat[y]};
            const double angle = angle_between(d, dir);
            row += lum * angle * angle;
        }
        sum += row * k->omega[y];
    }
    k->out->spread_rad[i] = energy > 0 ? sqrt(sum / energy) : 0;
}

// The region becomes lights first .. first + n - 1. Depth 16 at most.
static void cut(const struct cutter *k, const struct light_region *r, int first, int n)
{
    struct light_region half[2];
    if (n > 1 && split(k, r, half)) {
        cut(k, &half[0], first, n / 2);
        cut(k, &half[1], first + n / 2, n / 2);
        return;
    }
    measure(k, first, r);
    for (int i = first + 1; i < first + n; i++) { // could not be split: the others are empty
        k->out->region[i] = (struct light_region){r->x0, r->y0, r->x0, r->y0};
        memcpy(k->out->dir_probe[i], k->out->dir_probe[first], sizeof(k->out->dir_probe[i]));
    }
}

static void cutter_free(struct cutter *k)
{
    free(k->sin_lon);
}

// Tables and the lights to fill. 0 or -ENOMEM.
static int cutter_new(struct cutter *k, const struct panorama *p, struct lights *l, int n)
{
    const int width = p->image.width, height = p->image.height;
    double *tables = malloc(((size_t)width * 3 + (size_t)height * 3) * sizeof(double));
    *k = (struct cutter){
        .p = p,
        .width = width,
        .height = height,
        .out = l,
        .sin_lon = tables,
        .cos_lon = tables + width,
        .along = tables + 2 * (size_t)width,
        .sin_lat = tables + 3 * (size_t)width,
        .cos_lat = tables + 3 * (size_t)width + height,
        .omega = tables + 3 * (size_t)width + 2 * (size_t)height,
    };
    if (!tables || lights_new(l, n))
        return -ENOMEM;
    l->region = calloc((size_t)n, sizeof(*l->region));
    l->spread_rad = calloc((size_t)n, sizeof(*l->spread_rad));
    if (!l->region || !l->spread_rad)
        return -ENOMEM;
    l->panorama_width_px = width, l->panorama_height_px = height;
    for (int x = 0; x < width; x++) {
        const double lon = M_PI - 2 * M_PI * (x + .5) / width;
        k->sin_lon[x] = sin(lon), k->cos_lon[x] = cos(lon);
    }
    for (int y = 0; y < height; y++) {
        const double lat = M_PI / 2 - M_PI * (y + .5) / height;
        k->sin_lat[y] = sin(lat), k->cos_lat[y] = cos(lat);
        k->omega[y] = panorama_solid_angle(width, height, y);
    }
    return 0;
}

int lights_median_cut(struct lights *out, const struct panorama *p, int n)
{
    struct lights l = {0};
    struct cutter k;
    memset(out, 0, sizeof(*out));
    if (n < 1 || n > LIGHTS_MAX || (n & (n - 1))) {
        log_error("lights: cannot cut a panorama into %d lights: expected a power of two from 1 "
                  "to %d",
                  n, LIGHTS_MAX);
        return -EINVAL;
    }
    const int err = cutter_new(&k, p, &l, n);
    if (!err) {
        cut(&k, &(struct light_region){0, 0, k.width, k.height}, 0, n);
        *out = l;
    } else {
        lights_free(&l);
    }
    cutter_free(&k);
    return err;
}

// What one light for the whole region costs in accuracy: energy x (angle)^2.
static double coarseness(const struct lights *l, int i)
{
    const double angle = l->spread_rad[i];
    return (l->irradiance[i][0] + l->irradiance[i][1] + l->irradiance[i][2]) * angle * angle;
}

static void clear_light(struct lights *l, int i)
{
    memset(l->irradiance[i], 0, sizeof(l->irradiance[i]));
    memset(l->dir_probe[i], 0, sizeof(l->dir_probe[i]));
}

int lights_number_distances(const struct lights *l, int32_t *distance_of)
{
    int n = 0;
    for (int i = 0; i < l->n; i++) {
        int first = i > 0 && l->group[i] >= 0 && l->group[i] == l->group[i - 1] ? i - 1 : 0; // groups are mostly runs
        while (first < i && (l->group[i] < 0 || l->group[first] != l->group[i]))
            first++;
        distance_of[i] = first < i ? distance_of[first] : n++;
    }
    return n;
}

int lights_refine(struct lights *out, const struct lights *from, const struct panorama *p, int n)
{
    struct lights l = {0};
    struct cutter k;
    int *next = malloc((size_t)(n + 1) * sizeof(*next)), n_made = from->n;
    memset(out, 0, sizeof(*out));
    int err = next ? cutter_new(&k, p, &l, n) : -ENOMEM;
    if (!next)
        return err;
    for (int i = 0; !err && i < from->n; i++) {
        memcpy(l.dir_probe[i], from->dir_probe[i], sizeof(l.dir_probe[i]));
        memcpy(l.irradiance[i], from->irradiance[i], sizeof(l.irradiance[i]));
        l.region[i] = from->region[i], l.spread_rad[i] = from->spread_rad[i], l.group[i] = i;
        next[i] = i + 1 < from->n ? i + 1 : -1;
    }
    while (!err && n_made < n) {
        int worst = 0;
        struct light_region half[2];
        for (int i = 1; i < n_made; i++)
            if (coarseness(&l, i) > coarseness(&l, worst))
                worst = i;
        if (!(coarseness(&l, worst) > 0))
            break;
        if (!split(&k, &l.region[worst], half)) {
            l.spread_rad[worst] = 0;
            continue;
        }
        clear_light(&l, worst);
        clear_light(&l, n_made);
        measure(&k, worst, &half[0]);
        measure(&k, n_made, &half[1]);
        l.group[n_made] = l.group[worst];
        next[n_made] = next[worst], next[worst] = n_made++;
    }
    if (!err)
        err = lights_new(out, n_made);
    if (!err) {
        out->region = calloc((size_t)n_made, sizeof(*out->region));
        out->spread_rad = calloc((size_t)n_made, sizeof(*out->spread_rad));
        err = out->region && out->spread_rad ? 0 : -ENOMEM;
    }
    for (int i = 0, at = 0; !err && at >= 0; i++, at = next[at]) { // in the order of the groups
        memcpy(out->dir_probe[i], l.dir_probe[at], sizeof(out->dir_probe[i]));
        memcpy(out->irradiance[i], l.irradiance[at], sizeof(out->irradiance[i]));
        out->region[i] = l.region[at], out->spread_rad[i] = l.spread_rad[at];
        out->group[i] = l.group[at];
        out->inverse_distance[i] = from->inverse_distance[l.group[at]];
    }
    if (!err) {
        memcpy(out->centre_m, from->centre_m, sizeof(out->centre_m));
        memcpy(out->world_from_probe, from->world_from_probe, sizeof(out->world_from_probe));
        out->panorama_width_px = k.width, out->panorama_height_px = k.height;
    } else {
        lights_free(out);
    }
    lights_free(&l);
    cutter_free(&k);
    free(next);
    return err;
}

// ---- lights.json --------------------------------------------------------------------------------

// What a number in a file may be. From distance_max_m on a light is directional: q (c - p) is below
// rounding beside R dh.
static const double length_max_m = 1e9, distance_min_m = 1e-6, distance_max_m = 1e15,
                    irradiance_max = 1e30;
// By how much what a file says twice may differ: six decimals of metres and directions suffice.
static const double agree = 2e-6;

static bool is_directional(double inverse_distance)
{
    return inverse_distance * distance_max_m < 1;
}

// As lights_new() leaves it: nobody has said where these lights are in the world.
static bool has_set_up(const struct lights *l)
{
    static const double identity[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    for (int k = 0; k < 9; k++)
        if (l->world_from_probe[k] != identity[k])
            return true;
    for (int i = 0; i < l->n; i++)
        if (!is_directional(l->inverse_distance[i]))
            return true;
    return false;
}

static struct json *light_to_json(const struct lights *l, int i, bool with_world)
{
    struct json *v = json_object();
    const double q = l->inverse_distance[i];
    double dir_world[3], pos_m[3];
    mat3_mul_vec(dir_world, l->world_from_probe, l->dir_probe[i]);
    vec3_add_scaled(pos_m, l->centre_m, 1 / q, dir_world);
    json_set_numbers(v, "dir_probe", l->dir_probe[i], 3);
    if (with_world)
        json_set_numbers(v, "dir_world", dir_world, 3);
    json_set_numbers(v, "irradiance", l->irradiance[i], 3);
    if (is_directional(q)) {
        json_set_number(v, "distance_m", NAN); // not finite: null
        json_set_number(v, "pos_m", NAN);
    } else {
        json_set_number(v, "distance_m", 1 / q);
        json_set_numbers(v, "pos_m", pos_m, 3);
    }
    json_set_int(v, "group", l->group[i]);
    if (l->region) {
        const struct light_region *r = &l->region[i];
        json_set_numbers(v, "region_px", (double[]){r->x0, r->y0, r->x1, r->y1}, 4);
        json_set_numbers(v, "panorama_px", (double[]){l->panorama_width_px, l->panorama_height_px},
                         2);
    }
    if (l->spread_rad)
        json_set_number(v, "spread_rad", l->spread_rad[i]);
    return v;
}

int lights_write_json(const struct lights *l, const char *path)
{
    struct json *list = json_array();
    const bool with_world = has_set_up(l);
    for (int i = 0; i < l->n; i++)
        json_append(list, light_to_json(l, i, with_world));
    const int err = json_write(list, path);
    json_free(list);
    return err;
}

// The list of a file while it is read, and what struct lights has no place for.
struct reading {
    const struct json *list;
    const char *file;
    struct lights l;
    double (*dir_world)[3]; // [n]; (0,0,0): not said
    double (*pos_m)[3];     // [n]; of lights with a distance
};

// There, and not null, the one value that the readers of json.h cannot tell.
static bool is_said(const struct reading *f, const char *key)
{
    const struct json *v = json_get(f->list, key);
    char *text = v ? json_text(v) : NULL;
    const bool null = text && !strcmp(text, "null");
    free(text);
    return v && !null;
}

static int refuse(const struct reading *f, const char *key, const char *what)
{
    char *found = json_text(json_get(f->list, key));
    log_error("lights: %s: %s: found %.80s%s: %s", f->file, key, found ? found : "nothing",
              found && strlen(found) > 80 ? "..." : "", what);
    free(found);
    return -EINVAL;
}

enum { KEY_MAX = 64 };
static const char *light_key(char key[KEY_MAX], int i, const char *name)
{
    snprintf(key, KEY_MAX, "%d.%s", i, name);
    return key;
}

static int read_direction(struct reading *f, int i, const char *name, double dir[3])
{
    char key[KEY_MAX];
    const int err = json_require_numbers(f->list, light_key(key, i, name), dir, 3, f->file);
    if (err)
        return err;
    const double length = vec3_norm(dir);
    if (!(fabs(length - 1) <= 1e-6))
        return refuse(f, key, "not a unit vector (to 1e-6)");
    if (fabs(length - 1) > 1e-15) // else it is one to rounding: keep every bit
        vec3_normalise(dir);
    return 0;
}

static int read_place(struct reading *f, int i)
{
    char distance_key[KEY_MAX], key[KEY_MAX];
    double distance_m, *pos_m = f->pos_m[i];
    light_key(distance_key, i, "distance_m");
    light_key(key, i, "pos_m");
    if (json_get(f->list, distance_key) && !is_said(f, distance_key)) {
        if (is_said(f, key))
            return refuse(f, key, "a directional light (distance_m null) has none: expected null");
        return 0; // directional, as lights_new() left it
    }
    int err = json_require_numbers(f->list, distance_key, &distance_m, 1, f->file);
    if (err)
        return err;
    if (!(distance_m >= distance_min_m && distance_m <= distance_max_m))
        return refuse(f, distance_key,
                      "outside [1e-6, 1e15] m; expected metres, or null for a directional light");
    f->l.inverse_distance[i] = 1 / distance_m;
    err = json_require_numbers(f->list, key, pos_m, 3, f->file);
    if (err)
        return err;
    for (int k = 0; k < 3; k++)
        if (!(fabs(pos_m[k]) <= distance_m + length_max_m))
            return refuse(f, key, "more than 1e9 m further away than distance_m; expected metres");
    return 0;
}

static int read_region(struct reading *f, int i)
{
    char key[KEY_MAX];
    double size[2], edge[4]; // x0, y0, x1, y1
    struct lights *l = &f->l;
    light_key(key, i, "panorama_px");
    int err = json_require_numbers(f->list, key, size, 2, f->file);
    if (err)
        return err;
    if (!(size[0] >= 2 && size[0] <= 65536 && size[0] == 2 * size[1] && size[1] == floor(size[1])))
        return refuse(f, key, "expected [width, height], integers, width = 2 x height <= 65536");
    if (i > 0 && size[0] != l->panorama_width_px)
        return refuse(f, key, "is not that of the lights before: expected one panorama");
    l->panorama_width_px = (int)size[0], l->panorama_height_px = (int)size[1];
    err = json_require_numbers(f->list, light_key(key, i, "region_px"), edge, 4, f->file);
    if (err)
        return err;
    for (int k = 0; k < 4; k++)
        if (!(edge[k] >= 0 && edge[k] <= size[k % 2] && edge[k] == floor(edge[k])) ||
            edge[k] < edge[k % 2])
            return refuse(f, key,
                          "must be pixels x0, y0, x1, y1 inside the panorama, x0 <= x1, y0 <= y1");
    l->region[i] = (struct light_region){(int)edge[0], (int)edge[1], (int)edge[2], (int)edge[3]};
    return 0;
}

static int read_light(struct reading *f, int i)
{
    char key[KEY_MAX];
    struct lights *l = &f->l;
    int err = read_direction(f, i, "dir_probe", l->dir_probe[i]);
    if (!err && is_said(f, light_key(key, i, "dir_world")))
        err = read_direction(f, i, "dir_world", f->dir_world[i]);
    if (!err)
        err = json_require_numbers(f->list, light_key(key, i, "irradiance"), l->irradiance[i], 3,
                                   f->file);
    if (err)
        return err;
    for (int c = 0; c < 3; c++)
        if (!(l->irradiance[i][c] >= 0 && l->irradiance[i][c] <= irradiance_max))
            return refuse(f, key, "a channel is outside [0, 1e30]");
    err = read_place(f, i);
    if (err)
        return err;

    int64_t group = -1;
    if (is_said(f, light_key(key, i, "group")) &&
        (json_get_int(f->list, key, &group) || group < -1 || group >= l->n))
        return refuse(f, key, "must be the number of an emitter (0 .. lights - 1), or -1 for none");
    l->group[i] = (int32_t)group;

    if (l->region)
        err = read_region(f, i);
    if (err || !l->spread_rad)
        return err;
    err = json_require_numbers(f->list, light_key(key, i, "spread_rad"), &l->spread_rad[i], 1,
                               f->file);
    if (!err && !(l->spread_rad[i] >= 0 && l->spread_rad[i] <= M_PI))
        return refuse(f, key, "outside [0, pi]");
    return err;
}

// ---- the set-up, from lights in both frames -----------------------------------------------------

struct means { // over the lights with a distance, weighted: of r dh and of pos_m
    double probe_m[3], world_m[3];
};

// Places weigh 1/r^2, so that each counts as a direction does: a light a kilometre away must not
// blur where those beside it stand.
static struct means weighted_means(const struct reading *f)
{
    struct means m = {{0}, {0}};
    double sum = 0;
    for (int i = 0; i < f->l.n; i++) {
        const double q = f->l.inverse_distance[i];
        vec3_add_scaled(m.probe_m, m.probe_m, q, f->l.dir_probe[i]); // q^2 r
        vec3_add_scaled(m.world_m, m.world_m, q * q, f->pos_m[i]);
        sum += q * q;
    }
    for (int k = 0; k < 3 && sum > 0; k++)
        m.probe_m[k] /= sum, m.world_m[k] /= sum;
    return m;
}

static int fit_places(struct orientation *fit, const struct reading *f, const struct means *m)
{
    const int n = f->l.n;
    double(*a)[3] = calloc(2 * (size_t)n, sizeof(*a)), (*b)[3] = a ? a + n : NULL;
    double *weight = calloc((size_t)n, sizeof(*weight));
    if (!a || !weight) {
        free(a);
        free(weight);
        return -ENOMEM;
    }
    for (int i = 0; i < n; i++) {
        const double q = f->l.inverse_distance[i];
        if (q <= 0)
            continue;
        for (int k = 0; k < 3; k++)
            a[i][k] = f->l.dir_probe[i][k] / q - m->probe_m[k];
        vec3_sub(b[i], f->pos_m[i], m->world_m);
        weight[i] = q * q;
    }
    orientation_fit(fit, a, b, weight, n);
    free(a);
    free(weight);
    return 0;
}

static int find_rotation(struct reading *f, struct orientation *fit, const struct means *m)
{
    const int n = f->l.n;
    int n_turned = 0, n_placed = 0;
    for (int i = 0; i < n; i++) {
        n_turned += vec3_dot(f->dir_world[i], f->dir_world[i]) > 0;
        n_placed += f->l.inverse_distance[i] > 0;
    }
    memset(fit, 0, sizeof(*fit));
    memcpy(fit->rotation, f->l.world_from_probe, sizeof(fit->rotation));
    if (n_turned == n) {
        orientation_fit(fit, f->l.dir_probe, f->dir_world, NULL, n);
    } else if (n_turned || n_placed) {
        const int err = fit_places(fit, f, m);
        if (err)
            return err;
        if (!fit->determined) {
            log_error("lights: %s: what turns the probe's axes into the world's cannot be told: "
                      "dir_world is with %d of %d lights, and the places of the %d with distance_m "
                      "and pos_m lie on one line: give every light its dir_world, or place three "
                      "lights that do not",
                      f->file, n_turned, n, n_placed);
            return -EINVAL;
        }
    } else {
        log_info("lights: %s: no light has a dir_world, a distance_m and a pos_m: the probe's axes "
                 "are taken for the world's",
                 f->file);
    }
    return 0;
}

static int find_set_up(struct reading *f)
{
    struct lights *l = &f->l;
    struct orientation fit;
    const struct means m = weighted_means(f);
    int err = find_rotation(f, &fit, &m);
    if (err)
        return err;
    memcpy(l->world_from_probe, fit.rotation, sizeof(fit.rotation));
    mat3_mul_vec(l->centre_m, fit.rotation, m.probe_m);
    vec3_sub(l->centre_m, m.world_m, l->centre_m);

    // The light that fits least, of those that do not: least squares spread its error over others.
    const double from_origin_m = vec3_norm(l->centre_m);
    double most = agree;
    char key[KEY_MAX] = "";
    for (int i = 0; i < l->n; i++) {
        const double q = l->inverse_distance[i];
        double dir[3], off[3];
        mat3_mul_vec(dir, l->world_from_probe, l->dir_probe[i]);
        vec3_sub(off, f->dir_world[i], dir);
        if (vec3_dot(f->dir_world[i], f->dir_world[i]) > 0 && vec3_norm(off) > most) {
            most = vec3_norm(off);
            light_key(key, i, "dir_world");
        }
        if (q <= 0)
            continue;
        vec3_add_scaled(off, l->centre_m, 1 / q, dir);
        vec3_sub(off, off, f->pos_m[i]);
        const double relative = vec3_norm(off) / (1 + 1 / q + from_origin_m);
        if (relative > most) {
            most = relative;
            light_key(key, i, "pos_m");
        }
    }
    if (*key)
        return refuse(f, key,
                      fit.mirrored ? "the lights are mirrored: no rotation takes dir_probe to the "
                                     "world, a reflection fits better; is one axis the wrong way?"
                                   : "does not fit: one rotation and one centre must take every "
                                     "light's dir_probe to its dir_world, and distance_m along it "
                                     "to its pos_m");
    for (int k = 0; k < 3; k++)
        if (!(fabs(l->centre_m[k]) <= length_max_m)) {
            log_error("lights: %s: distance_m and pos_m put the probe at (%g, %g, %g), more than "
                      "1e9 m away; expected metres",
                      f->file, l->centre_m[0], l->centre_m[1], l->centre_m[2]);
            return -EINVAL;
        }
    return 0;
}

static int from_json(struct lights *out, const struct json *doc, const char *file)
{
    struct reading f = {.list = json_get(doc, "lights"), .file = file};
    f.list = f.list ? f.list : doc; // a wrapped list, or the list
    const int n = json_length(f.list, "");
    if (n < 1 || n > LIGHTS_MAX) {
        log_error("lights: %s: expected a list of 1 to %d lights, found %s", file, LIGHTS_MAX,
                  n > 0    ? "more"
                  : n == 0 ? "none"
                           : "no list");
        return -EINVAL;
    }
    const bool regions = json_get(f.list, "0.region_px"),
               spreads = json_get(f.list, "0.spread_rad");
    int err = lights_new(&f.l, n);
    if (err)
        return err;
    f.l.region = regions ? calloc((size_t)n, sizeof(*f.l.region)) : NULL;
    f.l.spread_rad = spreads ? calloc((size_t)n, sizeof(*f.l.spread_rad)) : NULL;
    f.dir_world = calloc((size_t)n, sizeof(*f.dir_world));
    f.pos_m = calloc((size_t)n, sizeof(*f.pos_m));
    if (!f.dir_world || !f.pos_m || (regions && !f.l.region) || (spreads && !f.l.spread_rad))
        err = -ENOMEM;
    for (int i = 0; i < n && !err; i++)
        err = read_light(&f, i);
    if (!err)
        err = find_set_up(&f);
    free(f.dir_world);
    free(f.pos_m);
    if (err)
        lights_free(&f.l);
    else
        *out = f.l;
    // A missing key is a broken file; -ENOENT would say that there is no file.
    return err == -ENOENT ? -EINVAL : err;
}

int lights_parse_json(struct lights *out, const char *text, size_t n_bytes,
                      const char *name_for_errors)
{
    struct json *doc;
    memset(out, 0, sizeof(*out));
    int err = json_parse(&doc, text, n_bytes, name_for_errors);
    if (err)
        return err;
    err = from_json(out, doc, name_for_errors);
    json_free(doc);
    return err;
}

int lights_read_json(struct lights *out, const char *path)
{
    struct json *doc;
    memset(out, 0, sizeof(*out));
    int err = json_read(&doc, path);
    if (err)
        return err;
    err = from_json(out, doc, path);
    json_free(doc);
    return err;
}

// ---- the pose of the probe ----------------------------------------------------------------------

// Where R is not a rotation to rounding, the nearest one. -EINVAL: not one even to 1e-4.
static int make_rotation(double R[9])
{
    double off = 0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            off = fmax(off, fabs(vec3_dot(R + 3 * i, R + 3 * j) - (i == j)));
    if (!(off <= 1e-4) || !(mat3_det(R) > 0))
        return -EINVAL;
    if (off <= 1e-14)
        return 0;
    static const double axes[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    double columns[3][3];
    struct orientation fit;
    for (int i = 0; i < 3; i++)
        mat3_mul_vec(columns[i], R, axes[i]);
    orientation_fit(&fit, axes, columns, NULL, 3);
    memcpy(R, fit.rotation, sizeof(fit.rotation));
    return 0;
}

int lights_read_pose(struct lights *l, bool *has_centre, const char *path)
{
    struct json *doc;
    double R[9], centre_m[3];
    int err = json_read(&doc, path);
    if (err)
        return err;
    const bool with_centre = !has_centre || json_get(doc, "centre_m");
    memcpy(centre_m, l->centre_m, sizeof(centre_m));
    err = json_require_numbers(doc, "world_from_probe", R, 9, path);
    if (!err && with_centre)
        err = json_require_numbers(doc, "centre_m", centre_m, 3, path);
    json_free(doc);
    if (err)
        return err == -ENOENT ? -EINVAL : err; // as in from_json()
    const double determinant = mat3_det(R);
    if (make_rotation(R)) {
        log_error("lights: %s: world_from_probe is not a rotation (determinant %g): expected three "
                  "orthonormal rows, right-handed",
                  path, determinant);
        return -EINVAL;
    }
    for (int k = 0; k < 3; k++)
        if (!(fabs(centre_m[k]) <= length_max_m)) {
            log_error("lights: %s: centre_m is (%g, %g, %g), more than 1e9 m away; expected metres",
                      path, centre_m[0], centre_m[1], centre_m[2]);
            return -EINVAL;
        }
    memcpy(l->world_from_probe, R, sizeof(R));
    memcpy(l->centre_m, centre_m, sizeof(centre_m));
    if (has_centre)
        *has_centre = with_centre;
    return 0;
}
