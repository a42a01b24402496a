// solver/synth.c - synthetic studios: lights on a cuboid, an object, cameras, and the take they
// give.
//
// Ground truth first: lights, textures, mesh and cameras are made and written, then every view is
// rendered from exactly those, noise added, clipped and written. All randomness is named by (seed,
// stream, index).
#include "solver/synth.h"
#include "solver/cameras.h"
#include "solver/panorama.h"
#include "solver/parallel.h"
#include "solver/random.h"
#include "solver/rays.h"
#include "solver/render.h"
#include "solver/shapes.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/take/take.h"
#include "solver/texels.h"
#include "solver/vec3.h"

#include <dirent.h>
#include <errno.h>
#include <ftw.h>
#include <limits.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum {
    N_PANELS = 4,
    N_WALLS = 6,
    N_RELIT = 6,
    N_RINGS = 5,
    MAX_REGIONS = 4,
    SHADOW_RAYS = 2,
    BOUNCE_RAYS = 32
};
enum { BOUNCE_TEXTURE = 128, GUTTER_PX = 8, MIN_PIXELS_PER_LIGHT = 8 };
enum stream {
    STREAM_LIGHTS,
    STREAM_RELIT_LIGHTS,
    STREAM_ROTATION,
    STREAM_CAMERAS,
    STREAM_RELIT_CAMERAS,
    STREAM_PATTERN,
    STREAM_NOISE = 1000,
    STREAM_RELIT_NOISE = 100000
};

static const double half_size_m[3] = {1.8, 1.2, .6}, middle_m[3] = {0, 0, 1.2};
static const double off_centre_m[3] = {.35, .25, -.1};
static const double relit_probe_m[3] = {.04, -.06, 1.23};
static const double object_radius_m = .3, camera_radius_m = 1.8;
static const double panel_radiance = 60; // of the dim walls
static const double sphere_brightness = .25, sphere_albedo = .5;
// What a user knows of the probe: its up is the world's up.
static const double rough_world_from_probe[9] = {-1, 0, 0, 0, 0, 1, 0, 1, 0};

// ---- light --------------------------------------------------------------------------------------
//
// Walls are numbered 2 axis + (1 on the positive side); a place on one has the coordinates of the
// next two axes, in turn, from the cuboid's middle.
struct panel {
    int wall;
    double low[2], high[2]; // metres
    double tint[3];
};

static const struct panel studio_panels[N_PANELS] = {
    {5, {-.9, -.5}, {.1, .3}, {1.02, 1, .94}},   // ceiling
    {0, {-.6, -.25}, {.4, .45}, {.9, 1, 1.12}},  // x = -1.8
    {2, {-.3, .2}, {.4, 1.2}, {1, 1, 1}},        // y = -1.2
    {1, {-.1, -.4}, {.8, .2}, {1.12, .98, .84}}, // x = 1.8
};
static const struct panel relit_panels[N_PANELS] = {
    {5, {.3, -.2}, {1.3, .6}, {1, 1, 1}},
    {3, {-.2, -1.2}, {.4, 0}, {1.12, .98, .84}},
    {0, {-.9, -.45}, {-.1, .15}, {.95, 1, 1.06}},
    {2, {0, -1.4}, {.5, -.4}, {.88, 1, 1.15}},
};

struct studio {
    const struct panel *panels;
    bool uniform;         // no panels: the walls alone, or a photographed room
    double unit_radiance; // of the dim walls
    struct lights lights;
    struct image panorama;
};

static void studio_free(struct studio *s)
{
    lights_free(&s->lights);
    image_free(&s->panorama);
}

static double luminance(const double rgb[3])
{
    return .2126 * rgb[0] + .7152 * rgb[1] + .0722 * rgb[2];
}

static double wall_area_m2(int wall)
{
    return 4 * half_size_m[(wall / 2 + 1) % 3] * half_size_m[(wall / 2 + 2) % 3];
}

// Which panel, or -1; radiance in units of the dim walls.
static int radiance_at(const struct studio *s, int wall, const double at[2], double radiance[3])
{
    for (int k = 0; k < N_PANELS; k++) {
        const struct panel *p = &s->panels[k];
        if (s->uniform || p->wall != wall || at[0] < p->low[0] || at[0] > p->high[0] ||
            at[1] < p->low[1] || at[1] > p->high[1])
            continue;
        for (int c = 0; c < 3; c++)
            radiance[c] = panel_radiance * p->tint[c];
        return k;
    }
    radiance[0] = radiance[1] = radiance[2] = 1;
    return -1;
}

// From a point inside along a unit direction: the wall, the place on it, the distance.
static int meet_wall(const double from_m[3], const double dir[3], double at[2], double *distance_m)
{
    int axis = 0;
    *distance_m = INFINITY;
    for (int k = 0; k < 3; k++) {
        const double t = (copysign(half_size_m[k], dir[k]) - (from_m[k] - middle_m[k])) / dir[k];
        if (dir[k] != 0 && t < *distance_m)
            *distance_m = t, axis = k;
    }
    for (int i = 0; i < 2; i++) {
        const int k = (axis + 1 + i) % 3;
        at[i] = from_m[k] - middle_m[k] + *distance_m * dir[k];
    }
    return 2 * axis + (dir[axis] > 0);
}

// Cells per wall by area, exactly n in all: whole shares first, what is left to the largest
// remainders.
static void count_cells(int n, int n_cells[N_WALLS])
{
    double total = 0, rest[N_WALLS];
    int left = n;
    for (int w = 0; w < N_WALLS; w++)
        total += wall_area_m2(w);
    for (int w = 0; w < N_WALLS; w++) {
        const double share = n * wall_area_m2(w) / total;
        n_cells[w] = (int)share;
        rest[w] = share - n_cells[w];
        left -= n_cells[w];
    }
    for (; left > 0; left--) {
        int most = 0;
        for (int w = 1; w < N_WALLS; w++)
            if (rest[w] > rest[most])
                most = w;
        n_cells[most]++, rest[most]--;
    }
}

// A jittered place in cell i of n equal cells that tile [-1, 1]^2: row r has the cells [r n / R, (r
// + 1) n / R), and is as high as they are many.
static void place_in_cell(int i, int n, double aspect, double x, double y, double at[2])
{
    const int n_rows = (int)fmin(fmax(round(sqrt(n / aspect)), 1), n);
    const int64_t row = (((int64_t)i + 1) * n_rows - 1) / n;
    const int first = (int)(row * n / n_rows), next = (int)((row + 1) * n / n_rows);
    at[0] = -1 + 2 * (i - first + x) / (next - first);
    at[1] = -1 + 2 * (first + y * (next - first)) / n;
}

// The free pixel nearest to (x, y), by growing squares; marks it.
static int64_t take_pixel(uint8_t *taken, int width, int height, int x, int y)
{
    for (int reach = 0;; reach++) {
        for (int dy = -reach; dy <= reach; dy++) {
            const int step = abs(dy) == reach || reach == 0 ? 1 : 2 * reach;
            for (int dx = -reach; dx <= reach && y + dy >= 0 && y + dy < height; dx += step) {
                const int64_t i = (int64_t)(y + dy) * width + ((x + dx) % width + width) % width;
                if (taken[i])
                    continue;
                taken[i] = 1;
                return i;
            }
        }
    }
}

static int studio_new(struct studio *s, const struct synth_settings *settings,
                      const struct panel *panels, const double centre_m[3],
                      const double world_from_probe[9], enum stream stream)
{
    const int n = settings->n_true_lights, width = settings->panorama_width_px, height = width / 2;
    int n_cells[N_WALLS], i = 0;
    double sum = 0;
    int err = -ENOMEM;
    *s = (struct studio){.panels = panels, .uniform = settings->uniform_cuboid};
    uint8_t *taken = calloc((size_t)width * (size_t)height, 1);
    int64_t *pixel = malloc((size_t)n * sizeof(*pixel));
    if (!taken || !pixel || lights_new(&s->lights, n) ||
        image_new(&s->panorama, width, height, 3, NULL))
        goto done;
    memcpy(s->lights.centre_m, centre_m, 3 * sizeof(double));
    memcpy(s->lights.world_from_probe, world_from_probe, 9 * sizeof(double));
    s->lights.panorama_width_px = width, s->lights.panorama_height_px = height;
    count_cells(n, n_cells);
    for (int wall = 0; wall < N_WALLS; wall++) {
        const int a = wall / 2, b = (a + 1) % 3, c = (a + 2) % 3;
        const double area_m2 = wall_area_m2(wall) / n_cells[wall];
        for (int cell = 0; cell < n_cells[wall]; cell++, i++) {
            double unit[2], at[2], x[3], dir[3], dir_probe[3], x_px, y_px, r_m, radiance[3];
            place_in_cell(cell, n_cells[wall], half_size_m[b] / half_size_m[c],
                          random_uniform(settings->seed, stream, 2 * (uint64_t)i),
                          random_uniform(settings->seed, stream, 2 * (uint64_t)i + 1), unit);
            x[a] = middle_m[a] + (wall % 2 ? 1 : -1) * half_size_m[a];
            x[b] = middle_m[b] + unit[0] * half_size_m[b];
            x[c] = middle_m[c] + unit[1] * half_size_m[c];
            vec3_sub(dir, x, centre_m);
            vec3_normalise(dir);
            mat3_tmul_vec(dir_probe, world_from_probe, dir);
            panorama_pixel(width, height, dir_probe, &x_px, &y_px);
            pixel[i] = take_pixel(taken, width, height, (int)fmin(fmax(x_px, 0), width - 1),
                                  (int)fmin(fmax(y_px, 0), height - 1));
            // From here the light is where the pixel's centre looks.
            panorama_direction(width, height, (double)(pixel[i] % width) + .5,
                               (double)(pixel[i] / width) + .5, dir_probe);
            memcpy(s->lights.dir_probe[i], dir_probe, sizeof(dir_probe));
            mat3_mul_vec(dir, world_from_probe, dir_probe);
            const int met = meet_wall(centre_m, dir, at, &r_m);
            s->lights.group[i] = radiance_at(s, met, at, radiance);
            s->lights.inverse_distance[i] = settings->directional ? 0 : 1 / r_m;
            for (int k = 0; k < 3; k++)
                s->lights.irradiance[i][k] =
                    radiance[k] * area_m2 * fabs(dir[met / 2]) / (r_m * r_m);
            sum += luminance(s->lights.irradiance[i]);
        }
    }
    // A sphere at c gets sum / 4 on average.
    s->unit_radiance = sphere_brightness * M_PI / sphere_albedo / (sum / 4);
    for (i = 0; i < n; i++) {
        const double solid_angle = panorama_solid_angle(width, height, (int)(pixel[i] / width));
        const bool missing = settings->one_panel_missing_from_panorama && s->lights.group[i] == 1;
        for (int k = 0; k < 3; k++) { // through the panorama's float, so that both agree to the bit
            const float radiance =
                (float)(s->lights.irradiance[i][k] * s->unit_radiance / solid_angle);
            s->lights.irradiance[i][k] = (double)radiance * solid_angle;
            s->panorama.data[3 * pixel[i] + k] = missing ? 0 : radiance;
        }
    }
    err = 0;
done:
    free(taken), free(pixel);
    if (err)
        studio_free(s);
    return err;
}

// A photographed room on the cuboid's walls: cut into lights, each as far as the wall it is seen on.
static int studio_from_panorama(struct studio *s, const struct synth_settings *settings, const char *path, const double centre_m[3],
                                const double world_from_probe[9])
{
    struct panorama p;
    double sum = 0;
    *s = (struct studio){.uniform = true, .unit_radiance = 1};
    int err = panorama_read(&p, path);
    if (err)
        return err;
    err = lights_median_cut(&s->lights, &p, settings->n_true_lights);
    if (err) {
        panorama_free(&p);
        return err;
    }
    memcpy(s->lights.centre_m, centre_m, 3 * sizeof(double));
    memcpy(s->lights.world_from_probe, world_from_probe, 9 * sizeof(double));
    for (int i = 0; i < s->lights.n; i++) {
        double dir[3], at[2], r_m;
        mat3_mul_vec(dir, world_from_probe, s->lights.dir_probe[i]);
        meet_wall(centre_m, dir, at, &r_m);
        s->lights.inverse_distance[i] = settings->directional ? 0 : 1 / r_m;
        sum += luminance(s->lights.irradiance[i]);
    }
    const double scale = sphere_brightness * M_PI / sphere_albedo / (sum / 4);
    for (int i = 0; i < s->lights.n; i++)
        for (int c = 0; c < 3; c++)
            s->lights.irradiance[i][c] *= scale;
    const size_t n_values = (size_t)p.image.width * (size_t)p.image.height * (size_t)p.image.n_channels;
    for (size_t i = 0; i < n_values; i++)
        p.image.data[i] = (float)((double)p.image.data[i] * scale);
    s->panorama = p.image;
    return 0;
}

static void append_panel(struct json *list, int id, int wall, const double low[2],
                         const double high[2], const double radiance[3], double unit)
{
    // u x v is the inward normal; on the positive walls that swaps the wall's two coordinates.
    const int swap = wall % 2, a = wall / 2, u = (a + 1 + swap) % 3, v = (a + 2 - swap) % 3;
    const double rgb[3] = {unit * radiance[0], unit * radiance[1], unit * radiance[2]};
    double axis[3][3] = {{0}}, corner[4][3], centre[3] = {0};
    char text[512];
    size_t n = 0;
    axis[0][u] = axis[1][v] = 1;
    axis[2][a] = swap ? -1 : 1;
    for (int k = 0; k < 4; k++) {
        corner[k][a] = middle_m[a] + (swap ? 1 : -1) * half_size_m[a];
        corner[k][u] = middle_m[u] + (k == 1 || k == 2 ? high[swap] : low[swap]);
        corner[k][v] = middle_m[v] + (k >= 2 ? high[!swap] : low[!swap]);
        vec3_add_scaled(centre, centre, .25, corner[k]);
        n += (size_t)snprintf(text + n, sizeof(text) - n, "%c[%.17g,%.17g,%.17g]", k ? ',' : '[',
                              corner[k][0], corner[k][1], corner[k][2]);
    }
    n += (size_t)snprintf(text + n, sizeof(text) - n, "]");
    struct json *panel = json_object(), *corners = NULL;
    json_set_int(panel, "id", id);
    json_set_numbers(panel, "centre", centre, 3);
    json_set_numbers(panel, "normal", axis[2], 3);
    json_set_numbers(panel, "u_axis", axis[0], 3);
    json_set_numbers(panel, "v_axis", axis[1], 3);
    json_set_number(panel, "width", high[swap] - low[swap]);
    json_set_number(panel, "height", high[!swap] - low[!swap]);
    if (!json_parse(&corners, text, n, "panel corners"))
        json_set(panel, "corners", corners);
    json_set_numbers(panel, "radiance_rgb", rgb, 3);
    json_append(list, panel);
}

// The panels in front, then the dim walls behind them: together everything that shines.
static int write_panels(const struct studio *s, const char *path)
{
    static const double grey[3] = {1, 1, 1};
    struct json *doc = json_object(), *list = json_array();
    for (int k = 0; k < N_PANELS && !s->uniform; k++) {
        const struct panel *p = &s->panels[k];
        const double radiance[3] = {panel_radiance * p->tint[0], panel_radiance * p->tint[1],
                                    panel_radiance * p->tint[2]};
        append_panel(list, k, p->wall, p->low, p->high, radiance, s->unit_radiance);
    }
    for (int wall = 0; wall < N_WALLS; wall++) {
        const double high[2] = {half_size_m[(wall / 2 + 1) % 3], half_size_m[(wall / 2 + 2) % 3]};
        const double low[2] = {-high[0], -high[1]};
        append_panel(list, N_PANELS + wall, wall, low, high, grey, s->unit_radiance);
    }
    json_set_string(
        doc, "note",
        "0..3: bright panels; 4..9: the dim walls they hang on (x-, x+, y-, y+, z-, z+)");
    json_set(doc, "panels", list);
    const int err = json_write(doc, path);
    json_free(doc);
    return err;
}

static int write_probe(const double *centre_m, const double world_from_probe[9], const char *note,
                       const char *path)
{
    struct json *doc = json_object();
    if (centre_m)
        json_set_numbers(doc, "centre_m", centre_m, 3);
    json_set_matrix3(doc, "world_from_probe", world_from_probe);
    if (note)
        json_set_string(doc, "note", note);
    const int err = json_write(doc, path);
    json_free(doc);
    return err;
}

// 2 to 10 degrees about a random axis, before the rough rotation.
static void true_rotation(uint64_t seed, double world_from_probe[9])
{
    double axis[3], turn[9];
    for (int k = 0; k < 3; k++)
        axis[k] = random_normal(seed, STREAM_ROTATION, (uint64_t)k);
    const double length = vec3_norm(axis);
    const double angle_rad = (2 + 8 * random_uniform(seed, STREAM_ROTATION, 100)) * M_PI / 180;
    for (int k = 0; k < 3; k++)
        axis[k] *= angle_rad / length;
    mat3_from_rotation_vector(turn, axis);
    mat3_mul(world_from_probe, turn, rough_world_from_probe);
}

// ---- cameras ------------------------------------------------------------------------------------

// Like real ones, no two lenses are quite equal: focal length +-3%, principal point +-1%.
static void aim(struct camera *c, int index, const struct synth_settings *s, enum stream stream,
                const double target_m[3], double azimuth_rad, double elevation_rad)
{
    static const double up[3] = {0, 0, 1};
    const double centre_m[3] = {
        target_m[0] + camera_radius_m * cos(elevation_rad) * cos(azimuth_rad),
        target_m[1] + camera_radius_m * cos(elevation_rad) * sin(azimuth_rad),
        target_m[2] + camera_radius_m * sin(elevation_rad)};
    double vary[3];
    for (int k = 0; k < 3; k++)
        vary[k] = 2 * random_uniform(s->seed, stream, 3 * (uint64_t)index + (uint64_t)k) - 1;
    const double half_px = fmin(s->width_px, s->height_px) / 2.;
    snprintf(c->name, sizeof(c->name), "cam%03d", index);
    c->width_px = s->width_px, c->height_px = s->height_px;
    c->model = CAMERA_BROWN;
    // the bounding sphere fills 90% of the shorter side
    c->fx = c->fy =
        .9 * half_px / tan(asin(object_radius_m / camera_radius_m)) * (1 + .03 * vary[0]);
    c->cx = s->width_px / 2. + .01 * s->width_px * vary[1];
    c->cy = s->height_px / 2. + .01 * s->height_px * vary[2];
    camera_look_at(c, centre_m, target_m, up);
}

static int make_cameras(struct cameras *out, int n, const struct synth_settings *s,
                        const double target_m[3])
{
    static const double elevation_deg[N_RINGS] = {10, -15, 35, -40, 60};
    out->view = calloc((size_t)n, sizeof(*out->view));
    if (!out->view)
        return -ENOMEM;
    for (int ring = 0; ring < N_RINGS; ring++) {
        const int n_ring = n / N_RINGS + (ring < n % N_RINGS);
        for (int k = 0; k < n_ring; k++, out->n++)
            aim(&out->view[out->n], out->n, s, STREAM_CAMERAS, target_m,
                2 * M_PI * (k + .2 * ring) / n_ring, elevation_deg[ring] * M_PI / 180);
    }
    return 0;
}

static int make_relit_cameras(struct cameras *out, const struct synth_settings *s,
                              const double target_m[3])
{
    static const double elevation_deg[N_RELIT] = {25, -5, 45, 5, -25, 50};
    out->view = calloc(N_RELIT, sizeof(*out->view));
    if (!out->view)
        return -ENOMEM;
    for (; out->n < N_RELIT; out->n++)
        aim(&out->view[out->n], out->n, s, STREAM_RELIT_CAMERAS, target_m,
            2 * M_PI * (out->n + .22) / N_RELIT, elevation_deg[out->n] * M_PI / 180);
    return 0;
}

// ---- material -----------------------------------------------------------------------------------

struct region {
    const char *name;
    double theta[DISNEY_N]; // metallic subsurface specular roughness specularTint anisotropic sheen
                            // sheenTint clearcoat gloss
};

static const struct region paper_theta[] = {{"paper", {.2, .2, .5, .6, .9, 0, .3, .4, .2, .2}}};
static const struct region vase_regions[MAX_REGIONS] = {
    {"glaze", {0, 0, .5, .35, .2, 0, 0, 0, .6, .8}},
    {"brass", {1, 0, .5, .4, 0, .3, 0, 0, 0, 0}},
    {"felt", {0, .3, .2, .9, 0, 0, .8, .5, 0, 0}},
    {"satin", {0, 0, .45, .55, .6, 0, 0, 0, .15, .5}},
};

// Smooth noise in [0, 1] of a place: trilinear between random corners, three octaves.
static double noise_at(const double x[3], double cells, uint64_t stream)
{
    double sum = 0, weight = .5;
    for (int octave = 0; octave < 3; octave++, cells *= 2.1, weight /= 2) {
        int64_t cell[3];
        double f[3];
        for (int k = 0; k < 3; k++) {
            const double p = x[k] * cells + 100; // away from 0: no mirror images
            cell[k] = (int64_t)floor(p);
            f[k] = p - (double)cell[k];
            f[k] = f[k] * f[k] * (3 - 2 * f[k]);
        }
        for (int corner = 0; corner < 8; corner++) {
            double w = weight;
            uint64_t key = (uint64_t)octave;
            for (int k = 0; k < 3; k++) {
                const int side = corner >> k & 1;
                w *= side ? f[k] : 1 - f[k];
                key = key * 4096 + (uint64_t)(cell[k] + side);
            }
            sum += w * random_uniform(stream, STREAM_PATTERN, key);
        }
    }
    return sum / .875;
}

// Three clays that flow into each other. x: place in the bounding sphere's unit ball.
static void clay_albedo(const double x[3], double albedo[3])
{
    static const double colour[3][3] = {{.62, .2, .1}, {.07, .34, .4}, {.74, .6, .3}};
    const double bend = 1.3 * sin(1.9 * x[2] + .5);
    const double w[3] = {exp(2.2 * sin(3.1 * x[0] + bend + .3)),
                         exp(2.2 * sin(2.7 * x[1] - bend + 1.9)),
                         exp(2.2 * sin(2.9 * x[2] + 1.4 * x[0] + 4.1))};
    for (int c = 0; c < 3; c++)
        albedo[c] = (w[0] * colour[0][c] + w[1] * colour[1][c] + w[2] * colour[2][c]) /
                    (w[0] + w[1] + w[2]);
}

// Painted vase: glaze below and around, felt diamonds, brass bands, a satin neck. Borders are
// steps.
static int vase_region(const double x[3])
{
    const double angle = atan2(x[1], x[0]);
    if (x[2] > .36 + .05 * sin(5 * angle))
        return 3;
    if (fabs(x[2] - .02 - .04 * sin(3 * angle)) < .035 || fabs(x[2] + .62) < .05)
        return 1;
    return fabs(sin(4 * angle)) + fabs(sin(7 * x[2] + 1)) > 1.25 && x[2] > -.6 ? 2 : 0;
}

static void vase_albedo(const double x[3], int region, double albedo[3])
{
    static const double colour[MAX_REGIONS][2][3] = {
        {{.78, .76, .7}, {.05, .11, .35}}, // white with cobalt strokes
        {{.8, .57, .24}, {.62, .42, .15}},
        {{.42, .03, .04}, {.2, .015, .03}},
        {{.09, .24, .12}, {.2, .4, .2}},
    };
    const double n = noise_at(x, 6, 1), fine = noise_at(x, 40, 2);
    double mix = region == 0 ? fmin(fmax(14 * (fabs(n - .5) - .03), 0), 1) : n;
    mix = region == 0 ? 1 - mix : mix;
    for (int c = 0; c < 3; c++)
        albedo[c] = (colour[region][0][c] + mix * (colour[region][1][c] - colour[region][0][c])) *
                    (.8 + .4 * fine);
}

struct textures {
    int n_regions; // 0: Lambertian
    const struct region *region;
    struct region own_region;
    struct image albedo, parameters, region_id; // parameters: none for Lambert
};

static void textures_free(struct textures *t)
{
    image_free(&t->albedo), image_free(&t->parameters), image_free(&t->region_id);
}

struct own_pictures {
    struct image colour, material; // no data: not given
};

struct paint_job {
    int data_set;
    const struct own_pictures *own;
    struct textures *textures;
    const struct texels *texels;
    const double *centre_m;
};

// A picture at the texel's place in the atlas; 0 where there is no picture.
static void picture_at(const struct image *picture, const struct texels *t, uint32_t pixel, float value[IMAGE_MAX_CHANNELS])
{
    const double u = ((double)(pixel % (uint32_t)t->size) + .5) / t->size, v = ((double)(pixel / (uint32_t)t->size) + .5) / t->size;
    image_bilinear(picture, u * picture->width, v * picture->height, value);
}

static void paint_texels(void *arg, int64_t begin, int64_t end, int worker)
{
    (void)worker;
    const struct paint_job *job = arg;
    struct textures *out = job->textures;
    for (int64_t i = begin; i < end; i++) {
        const size_t pixel = job->texels->pixel[i];
        double x[3], albedo[3] = {.5, .5, .5};
        int region = 0;
        for (int k = 0; k < 3; k++)
            x[k] = (job->texels->position_m[i][k] - job->centre_m[k]) / object_radius_m;
        if (job->data_set == SYNTH_OWN && job->own->colour.data) {
            float rgb[IMAGE_MAX_CHANNELS];
            picture_at(&job->own->colour, job->texels, job->texels->pixel[i], rgb);
            for (int c = 0; c < 3; c++)
                albedo[c] = (double)rgb[job->own->colour.n_channels < 3 ? 0 : c];
        } else if (job->data_set == 5) {
            region = vase_region(x);
            vase_albedo(x, region, albedo);
        } else if (job->data_set == 3 || job->data_set == 4) {
            clay_albedo(x, albedo);
        }
        for (int c = 0; c < 3; c++)
            out->albedo.data[3 * pixel + (size_t)c] = (float)albedo[c];
        for (int k = 0; k < DISNEY_N && out->n_regions; k++)
            out->parameters.data[DISNEY_N * pixel + (size_t)k] =
                (float)out->region[region].theta[k];
        if (job->own->material.data) {
            float value[IMAGE_MAX_CHANNELS];
            float *theta = &out->parameters.data[DISNEY_N * pixel];
            picture_at(&job->own->material, job->texels, job->texels->pixel[i], value);
            theta[DISNEY_ROUGHNESS] = value[1], theta[DISNEY_METALLIC] = value[2];
        }
        out->region_id.data[pixel] = (float)region;
    }
}

static int make_textures(struct textures *out, const struct mesh *mesh,
                         const struct synth_settings *s, const double centre_m[3])
{
    static const char *const id_name[] = {"Y"};
    const int size = s->texture_size;
    struct texels texels = {0};
    struct own_pictures own = {0};
    *out = (struct textures){.own_region = {.name = "own"}, .n_regions = s->data_set < 3    ? 0
                                          : s->data_set == 5 ? MAX_REGIONS
                                                             : 1,
                             .region = s->data_set == SYNTH_OWN ? &out->own_region
                                       : s->data_set == 5       ? vase_regions
                                                                : paper_theta};
    for (int k = 0; k < DISNEY_N; k++)
        out->own_region.theta[k] = (double)s->own_theta[k];
    int err = texels_rasterise(&texels, mesh, size);
    if (!err && s->data_set == SYNTH_OWN && s->colour_path)
        err = image_read_texture(&own.colour, s->colour_path, true);
    if (!err && s->data_set == SYNTH_OWN && s->material_path)
        err = image_read_texture(&own.material, s->material_path, false);
    if (!err && own.material.data && own.material.n_channels < 3) {
        log_error("synth: %s has %d channel(s); expected three: G is roughness, B metallic", s->material_path, own.material.n_channels);
        err = -EINVAL;
    }
    if (!err)
        err = image_new(&out->albedo, size, size, 3, NULL);
    if (!err)
        err = image_new(&out->region_id, size, size, 1, id_name);
    if (!err && out->n_regions)
        err = image_new(&out->parameters, size, size, DISNEY_N, disney_parameter_names);
    if (err)
        goto done;
    struct paint_job job = {s->data_set, &own, out, &texels, centre_m};
    parallel_for(s->n_threads, texels.n, 4096, paint_texels, &job);
    err = texels_fill_gutter(&texels, out->albedo.data, 3, GUTTER_PX);
    if (!err)
        err = texels_fill_gutter(&texels, out->region_id.data, 1, GUTTER_PX);
    if (!err && out->n_regions)
        err = texels_fill_gutter(&texels, out->parameters.data, DISNEY_N, GUTTER_PX);
done:
    texels_free(&texels);
    image_free(&own.colour), image_free(&own.material);
    if (err)
        textures_free(out);
    return err;
}

static int write_material(const struct textures *t, int data_set, const char *path)
{
    struct json *doc = json_object(), *list = json_array();
    json_set_int(doc, "data_set", data_set);
    json_set_string(doc, "model", t->n_regions ? "disney" : "lambert");
    json_set_string(doc, "variant", disney_variant_name(DISNEY_2017));
    json_set_string(doc, "albedo",
                    data_set < 3            ? ".5"
                    : data_set == SYNTH_OWN ? "as given"
                    : data_set == 5 ? "detailed, by region"
                                    : "smooth, coloured");
    for (int i = 0; i < t->n_regions; i++) {
        struct json *region = json_object();
        json_set_int(region, "id", i);
        json_set_string(region, "name", t->region[i].name);
        for (int k = 0; k < DISNEY_N; k++)
            json_set_number(region, disney_parameter_names[k], t->region[i].theta[k]);
        json_append(list, region);
    }
    json_set(doc, "regions", list);
    const int err = json_write(doc, path);
    json_free(doc);
    return err;
}

// ---- the take -----------------------------------------------------------------------------------

static const char *const set_names[] = {"", "D1", "D2", "D3", "D4", "D5", "own"};

// Where everything goes while it is made, and what it is made of.
struct job {
    const struct synth_settings *settings;
    const char *dir;
    double centre_m[3], object_m[3], world_from_probe[9];
    struct mesh mesh;
    struct rays *rays;
    struct textures textures;
    struct cameras cameras, relit_cameras;
    struct studio studio, relit;
    struct render_settings render;
    int64_t n_object_pixels, n_clipped_pixels;
};

static int path_of(const struct job *job, char path[PATH_MAX], const char *name)
{
    if (snprintf(path, PATH_MAX, "%s/%s", job->dir, name) < PATH_MAX)
        return 0;
    log_error("synth: the path %s/%s is too long", job->dir, name);
    return -ENAMETOOLONG;
}

static int make_folder(const struct job *job, const char *name)
{
    char path[PATH_MAX];
    const int err = path_of(job, path, name);
    return err ? err : make_directories(path);
}

static int write_image(const struct job *job, const struct image *image, const char *name,
                       enum image_type type, enum image_compression compression)
{
    char path[PATH_MAX];
    const int err = path_of(job, path, name);
    return err ? err : image_write_exr(image, path, type, compression);
}

// Every second view fits, the others judge.
static int write_view_list(const struct job *job, const char *name, int first)
{
    char path[PATH_MAX];
    struct atomic_file f;
    int err = path_of(job, path, name);
    if (!err)
        err = atomic_file_open(&f, path);
    if (err)
        return err;
    for (int i = first; i < job->cameras.n; i += 2)
        fprintf(f.stream, "%s.exr\n", job->cameras.view[i].name);
    return atomic_file_commit(&f);
}

static int write_report(const struct job *job)
{
    const struct synth_settings *s = job->settings;
    char path[PATH_MAX];
    int err = path_of(job, path, "truth/report.json");
    if (err)
        return err;
    struct json *doc = json_object(), *inputs = json_object(), *render = json_object();
    json_set_string(doc, "method", "truth");
    json_set_string(doc, "data_set", set_names[s->data_set]);
    json_set_int(doc, "seed", (int64_t)s->seed);
    json_set_int(doc, "n_views", s->n_views);
    json_set_int(doc, "n_lights", s->n_true_lights);
    json_set_int(doc, "texture", s->texture_size);
    json_set_numbers(doc, "centre_m", job->centre_m, 3);
    json_set_matrix3(doc, "world_from_probe", job->world_from_probe);
    json_set_number(doc, "rmse_fit_percent", 0);
    json_set_number(doc, "rmse_held_out_percent", 0);
    json_set_string(doc, "stop_reason", "known");
    json_set_bool(doc, "trusted", true);
    json_set(doc, "warnings", json_array());
    json_set_number(doc, "noise", s->noise);
    json_set_bool(doc, "directional", s->directional);
    json_set_bool(doc, "uniform_cuboid", s->uniform_cuboid);
    json_set_bool(doc, "one_panel_missing_from_panorama", s->one_panel_missing_from_panorama);
    json_set_number(doc, "clipped_percent",
                    100. * (double)job->n_clipped_pixels /
                        (double)(job->n_object_pixels ? job->n_object_pixels : 1));
    json_set_string(doc, "variant", disney_variant_name(DISNEY_2017));
    json_set_string(inputs, "mesh", "../geometry/mesh.obj");
    json_set_string(inputs, "cameras", "../geometry/cameras");
    json_set_string(inputs, "panorama", "../panorama.exr");
    json_set_string(inputs, "images", "../linear");
    json_set(doc, "inputs", inputs);
    json_set_int(render, "samples", job->render.samples);
    json_set_bool(render, "shadows", job->render.shadows);
    json_set_int(render, "shadow_rays", job->render.shadow_rays);
    json_set_int(render, "bounce_rays", job->render.bounce_rays);
    json_set_int(render, "bounce_texture", job->render.bounce_texture);
    json_set_bool(render, "nearest", s->data_set == 5);
    json_set_int(render, "seed", (int64_t)job->render.seed);
    json_set(doc, "render", render);
    err = json_write(doc, path);
    json_free(doc);
    return err;
}

// Render, add noise, clip, write.
static int take_picture(struct job *job, const struct renderer *renderer,
                        const struct camera *camera, const char *folder, uint64_t noise_stream)
{
    static const char *const names[4] = {"R", "G", "B", "clip"};
    const struct synth_settings *s = job->settings;
    char name[CAMERA_NAME_MAX + 64], path[PATH_MAX];
    struct image image, stored = {0};
    int err = render_view(renderer, camera, &image);
    if (err)
        return err;
    err = image_new(&stored, image.width, image.height, 4, names);
    const int64_t n_pixels = (int64_t)image.width * image.height;
    for (int64_t i = 0; !err && i < n_pixels; i++) {
        float *to = stored.data + 4 * i;
        for (int c = 0; c < 3; c++) {
            const double noise = s->noise > 0 ? s->noise * random_normal(s->seed, noise_stream,
                                                                         (uint64_t)(3 * i + c))
                                              : 0;
            const double value = image.data[4 * i + c] + noise;
            to[c] = (float)fmin(value, 1);
            if (value >= 1)
                to[3] = 1;
        }
        job->n_object_pixels += image.data[4 * i + 3] > 0;
        job->n_clipped_pixels += image.data[4 * i + 3] > 0 && to[3] > 0;
    }
    if (!err) {
        snprintf(name, sizeof(name), "%s/%s.exr", folder, camera->name);
        err = path_of(job, path, name);
    }
    if (!err)
        err = image_write_exr_noted(&stored, &(struct image_note){ IMAGE_SPREAD_NOTE, "0", 0 }, 1, path, s->final_float ? IMAGE_FLOAT : IMAGE_HALF, IMAGE_ZIP);
    image_free(&image), image_free(&stored);
    return err;
}

static int take_pictures(struct job *job, const struct studio *studio,
                         const struct cameras *cameras, const char *folder, uint64_t noise_stream)
{
    const struct render_material material = {
        .model = job->textures.n_regions ? REFLECT_DISNEY : REFLECT_LAMBERT,
        .variant = DISNEY_2017,
        .albedo = &job->textures.albedo,
        .parameters = job->textures.n_regions ? &job->textures.parameters : NULL,
        .nearest = job->settings->data_set == 5,
    };
    struct renderer *renderer;
    int err =
        renderer_new(&renderer, &job->mesh, job->rays, &studio->lights, &material, &job->render);
    for (int i = 0; !err && i < cameras->n; i++)
        err = take_picture(job, renderer, &cameras->view[i], folder, noise_stream + (uint64_t)i);
    renderer_free(renderer);
    return err;
}

// Scaled to the size of the others, its longest way upright where it was: centred at object_m.
static int own_mesh(struct mesh *out, const char *path, bool flip_v, const double object_m[3])
{
    struct mesh_check check;
    int err = mesh_read(out, flip_v ? NULL : &check, path);
    if (err)
        return err;
    for (int i = 0; flip_v && i < out->n_vertices; i++)
        out->uv[i][1] = 1 - out->uv[i][1];
    if (flip_v)
        mesh_check_run(out, &check);
    mesh_check_log(&check, out, path);
    const char *dot = strrchr(path, '.');
    const bool y_up = dot && (!strcasecmp(dot, ".glb") || !strcasecmp(dot, ".gltf"));
    double middle[3], most = 0;
    for (int k = 0; k < 3; k++)
        middle[k] = (out->bounds_m[0][k] + out->bounds_m[1][k]) / 2;
    for (int i = 0; i < out->n_vertices; i++) {
        double d[3];
        for (int k = 0; k < 3; k++)
            d[k] = (double)out->position_m[i][k] - middle[k];
        most = fmax(most, vec3_norm(d));
    }
    for (int i = 0; i < out->n_vertices; i++) {
        double d[3], n[3];
        for (int k = 0; k < 3; k++)
            d[k] = ((double)out->position_m[i][k] - middle[k]) * object_radius_m / most, n[k] = (double)out->normal[i][k];
        for (int k = 0; k < 3; k++) { // x, y, z with y up is x, -z, y with z up
            const int from = y_up ? (k == 1 ? 2 : k == 2 ? 1 : 0) : k;
            const double sign = y_up && k == 1 ? -1 : 1;
            out->position_m[i][k] = (float)(object_m[k] + sign * d[from]), out->normal[i][k] = (float)(sign * n[from]);
        }
    }
    for (int k = 0; k < 3; k++)
        out->bounds_m[0][k] = INFINITY, out->bounds_m[1][k] = -INFINITY;
    for (int i = 0; i < out->n_vertices; i++)
        for (int k = 0; k < 3; k++) {
            out->bounds_m[0][k] = fmin(out->bounds_m[0][k], (double)out->position_m[i][k]);
            out->bounds_m[1][k] = fmax(out->bounds_m[1][k], (double)out->position_m[i][k]);
        }
    return 0;
}

static int prepare(struct job *job)
{
    static const char *const own_shape[] = {"", "pebble", "pebble", "pebble", "knot", "vase", "pebble"};
    const struct synth_settings *s = job->settings;
    const char *name = s->shape ? s->shape : own_shape[s->data_set];
    int shape = 0;
    while (shape < SHAPE_N && strcmp(shape_names[shape], name))
        shape++;
    memcpy(job->centre_m, middle_m, sizeof(job->centre_m));
    for (int k = 0; k < 3; k++)
        job->object_m[k] = middle_m[k] + (s->data_set == 1 ? 0 : off_centre_m[k]);
    true_rotation(s->seed, job->world_from_probe);
    job->render = (struct render_settings){
        .samples = s->samples,
        .shadows = s->data_set >= 4,
        .shadow_rays = SHADOW_RAYS,
        .bounce_rays = s->data_set == 4 || s->data_set == SYNTH_OWN ? BOUNCE_RAYS : 0,
        .bounce_texture = s->texture_size < BOUNCE_TEXTURE ? s->texture_size : BOUNCE_TEXTURE,
        .seed = s->seed,
        .n_threads = s->n_threads,
        .count_rows = true};
    int err = s->data_set == SYNTH_OWN ? own_mesh(&job->mesh, s->mesh_path, s->flip_v, job->object_m)
                                       : shape_make(&job->mesh, shape, job->object_m, object_radius_m,
                                                    shape == SHAPE_PEBBLE ? 40000 : 80000);
    if (!err)
        err = rays_new(&job->rays, &job->mesh);
    if (!err)
        err = make_textures(&job->textures, &job->mesh, s, job->object_m);
    if (!err)
        err = make_cameras(&job->cameras, s->n_views, s, job->object_m);
    if (!err)
        err = make_relit_cameras(&job->relit_cameras, s, job->object_m);
    if (!err)
        err = s->panorama_path
                  ? studio_from_panorama(&job->studio, s, s->panorama_path, job->centre_m, job->world_from_probe)
                  : studio_new(&job->studio, s, studio_panels, job->centre_m, job->world_from_probe, STREAM_LIGHTS);
    if (!err)
        err = s->relit_panorama_path
                  ? studio_from_panorama(&job->relit, s, s->relit_panorama_path, relit_probe_m, rough_world_from_probe)
                  : studio_new(&job->relit, s, relit_panels, relit_probe_m, rough_world_from_probe, STREAM_RELIT_LIGHTS);
    return err;
}

static int write_known(struct job *job)
{
    const struct synth_settings *s = job->settings;
    char name[64], path[PATH_MAX];
    snprintf(name, sizeof(name), "synthetic %s, seed %llu", set_names[s->data_set], (unsigned long long)s->seed);
    // A fixed date: equal settings give equal bytes.
    int err = take_create(job->dir, name, "2020-03-01T00:00:00Z", "ready");
    if (!err)
        err = make_folder(job, "truth");
    if (!err)
        err = make_folder(job, "relit/linear");
    if (!err)
        err = make_folder(job, "relit/cameras");
    if (!err && !(err = path_of(job, path, "geometry/mesh.obj")))
        err = mesh_write_obj(&job->mesh, path);
    if (!err && !(err = path_of(job, path, "geometry/cameras")))
        err = cameras_write_colmap_text(&job->cameras, path);
    if (!err && !(err = path_of(job, path, "relit/cameras")))
        err = cameras_write_colmap_text(&job->relit_cameras, path);
    if (!err && !(err = path_of(job, path, "start.json")))
        err = write_probe(NULL, rough_world_from_probe,
                          "rough: the true rotation is 2-10 degrees off; start the centre at the "
                          "mesh bounding-box centre",
                          path);
    if (!err)
        err = write_view_list(job, "fit.txt", 0);
    if (!err)
        err = write_view_list(job, "unseen.txt", 1);
    if (!err)
        err = write_image(job, &job->studio.panorama, "panorama.exr", IMAGE_FLOAT, IMAGE_PIZ);
    if (!err)
        err = write_image(job, &job->relit.panorama, "relit/panorama.exr", IMAGE_FLOAT, IMAGE_PIZ);
    if (!err && !(err = path_of(job, path, "truth/lights.json")))
        err = lights_write_json(&job->studio.lights, path);
    if (!err && !(err = path_of(job, path, "relit/lights.json")))
        err = lights_write_json(&job->relit.lights, path);
    if (!err && !(err = path_of(job, path, "truth/panels.json")))
        err = write_panels(&job->studio, path);
    if (!err && !(err = path_of(job, path, "relit/panels.json")))
        err = write_panels(&job->relit, path);
    if (!err && !(err = path_of(job, path, "truth/probe.json")))
        err = write_probe(job->centre_m, job->world_from_probe, NULL, path);
    if (!err && !(err = path_of(job, path, "relit/probe.json")))
        err = write_probe(relit_probe_m, rough_world_from_probe, NULL, path);
    if (!err && !(err = path_of(job, path, "truth/material.json")))
        err = write_material(&job->textures, s->data_set, path);
    if (!err)
        err = write_image(job, &job->textures.albedo, "truth/albedo.exr", IMAGE_FLOAT, IMAGE_ZIP);
    if (!err && job->textures.n_regions)
        err = write_image(job, &job->textures.parameters, "truth/brdf.exr", IMAGE_FLOAT, IMAGE_ZIP);
    if (!err)
        err = write_image(job, &job->textures.region_id, "truth/region_id.exr", IMAGE_HALF,
                          IMAGE_ZIP);
    return err;
}

static int write_all(const struct synth_settings *s, const char *dir)
{
    struct job *job = calloc(1, sizeof(*job));
    if (!job)
        return -ENOMEM;
    job->settings = s, job->dir = dir;
    int err = prepare(job);
    if (!err)
        err = write_known(job);
    if (!err) {
        progress_begin("synth", (int64_t)(s->n_views + N_RELIT) * s->height_px);
        err = take_pictures(job, &job->studio, &job->cameras, "linear", STREAM_NOISE);
        if (!err)
            err = write_report(job);
        if (!err)
            err = take_pictures(job, &job->relit, &job->relit_cameras, "relit/linear",
                                STREAM_RELIT_NOISE);
        progress_end();
    }
    studio_free(&job->studio), studio_free(&job->relit);
    cameras_free(&job->cameras), cameras_free(&job->relit_cameras);
    textures_free(&job->textures);
    rays_free(job->rays);
    mesh_free(&job->mesh);
    free(job);
    return err;
}

// ---- settings, and a folder that is whole or not there ------------------------------------------

struct synth_settings synth_defaults(int data_set)
{
    return (struct synth_settings){
        .data_set = data_set,
        .seed = 1,
        .n_true_lights = LIGHTS_MAX,
        .width_px = 360,
        .height_px = 240,
        .n_views = 85,
        .samples = 2,
        .panorama_width_px = 2048,
        .texture_size = data_set == 5   ? 2048
                        : data_set >= 3 ? 512
                                        : 64,
        .own_theta = {0, 0, .5f, .5f},
    };
}

static bool in_range(const char *what, double value, double low, double high)
{
    if (value >= low && value <= high)
        return true;
    log_error("synth: %s is %g; from %g to %g is possible", what, value, low, high);
    return false;
}

static int check(const struct synth_settings *s)
{
    bool known = !s->shape;
    for (int i = 0; i < SHAPE_N && !known; i++)
        known = !strcmp(s->shape, shape_names[i]);
    if (!known) {
        log_error("synth: no shape '%s'; there are pebble, vase, knot and bowl", s->shape);
        return -EINVAL;
    }
    if (s->data_set == SYNTH_OWN && !s->mesh_path) {
        log_error("synth: own needs a mesh");
        return -EINVAL;
    }
    for (int k = 0; k < DISNEY_N; k++)
        if (!in_range(disney_parameter_names[k], (double)s->own_theta[k], 0, 1))
            return -EINVAL;
    if (!in_range("the data set", s->data_set, 1, SYNTH_OWN) ||
        !in_range("the number of lights", s->n_true_lights, 16, LIGHTS_MAX) ||
        !in_range("the noise", s->noise, 0, 1) || !in_range("the width", s->width_px, 16, 8192) ||
        !in_range("the height", s->height_px, 16, 8192) ||
        !in_range("the number of views", s->n_views, 1, 999) ||
        !in_range("the samples per side", s->samples, 1, 16) ||
        !in_range("the texture's size", s->texture_size, 32, 8192) ||
        !in_range("the panorama's width", s->panorama_width_px, 32, 16384))
        return -EINVAL;
    const double n_pixels = (double)s->panorama_width_px * (s->panorama_width_px / 2);
    if ((!s->panorama_path || !s->relit_panorama_path) && (s->panorama_width_px % 2 || n_pixels < (double)MIN_PIXELS_PER_LIGHT * s->n_true_lights)) {
        log_error("synth: a panorama %d px wide cannot hold %d lights; it must be even and have %d "
                  "pixels per light",
                  s->panorama_width_px, s->n_true_lights, MIN_PIXELS_PER_LIGHT);
        return -EINVAL;
    }
    return 0;
}

static int remove_one(const char *path, const struct stat *st, int kind, struct FTW *at)
{
    (void)st, (void)kind, (void)at;
    remove(path);
    return 0;
}

static void remove_folder(const char *dir)
{
    nftw(dir, remove_one, 16, FTW_DEPTH | FTW_PHYS);
}

// 0: dir is not there, or is an empty folder.
static int require_free(const char *dir)
{
    DIR *stream = opendir(dir);
    if (!stream && errno == ENOENT)
        return 0;
    int err = stream ? 0 : -errno;
    for (const struct dirent *e; stream && !err && (e = readdir(stream));)
        if (strcmp(e->d_name, ".") && strcmp(e->d_name, ".."))
            err = -ENOTEMPTY;
    if (stream)
        closedir(stream);
    if (err)
        log_error("synth: %s: %s; give a folder that is new or empty", dir, strerror(-err));
    return err;
}

// The folder in which everything is made: beside the final one, so that a rename can move it.
static int make_part(const char *final, char part[PATH_MAX])
{
    if (snprintf(part, PATH_MAX, "%s", final) >= PATH_MAX) {
        log_error("synth: the folder's name is too long");
        return -ENAMETOOLONG;
    }
    char *slash = strrchr(part, '/');
    if (slash && slash != part) {
        *slash = 0;
        const int err = make_directories(part);
        if (err)
            return err;
    }
    if (snprintf(part, PATH_MAX, "%s.%ld.part", final, (long)getpid()) >= PATH_MAX) {
        log_error("synth: the folder's name is too long");
        return -ENAMETOOLONG;
    }
    if (!mkdir(part, 0777))
        return 0;
    const int err = -errno;
    log_error("synth: cannot make %s: %s", part, strerror(-err));
    return err;
}

int synth_write(const struct synth_settings *s, const char *dir)
{
    char final[PATH_MAX], part[PATH_MAX];
    int err = check(s);
    if (err)
        return err;
    size_t length = strlen(dir);
    while (length > 1 && dir[length - 1] == '/')
        length--;
    if (!length || length >= sizeof(final)) {
        log_error("synth: the folder's name is empty or too long");
        return -ENAMETOOLONG;
    }
    memcpy(final, dir, length);
    final[length] = 0;
    err = require_free(final);
    if (!err)
        err = make_part(final, part);
    if (err)
        return err;
    err = write_all(s, part);
    if (!err && rename(part, final)) {
        err = -errno;
        log_error("synth: cannot rename %s to %s: %s", part, final, strerror(-err));
    }
    if (err)
        remove_folder(part);
    return err;
}
