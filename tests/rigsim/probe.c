// tests/rigsim/probe.c - see probe.h. Sites of the present view are kept: a bracket of exposures looks at the same ones.
#include "tests/rigsim/probe.h"
#include "solver/panorama.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { SAMPLES = 8, CELLS_MAX = 1024, CORNERS_MAX = 8 };
#define POLE_Z .999 // a site that comes so near to a pole is sampled: its outline may go around it
#define LAMP_LEVEL 4. // a lamp is what is so many times brighter than the mean

struct corner { // u: column of the picture, unwrapped by whoever compares; z: sine of the latitude
    double u, z;
    bool seen;
};

struct probe {
    struct panorama picture;
    struct lens lens;
    double gain, lamp_level;
    double *row_z; // [height + 1] z of the picture's rows' upper edges, falling
    double yaw_deg, pitch_deg, probe_from_camera[9];
    float *site;   // [height_px][width_px] of this view
    bool *made;    // [height_px]
    struct corner *corner[3]; // rows of corners, by (row + 1) % 3; corner x of row y lies at pixel (x - .5, y - .5)
    int corner_row[3];        // which rows these are; INT32_MIN: none
};

// ---- one site -------------------------------------------------------------------------------------------------------------------

static const float *pixel(const struct probe *p, int x, int y)
{
    const struct image *m = &p->picture.image;
    x = (x % m->width + m->width) % m->width;
    y = y < 0 ? 0 : y >= m->height ? m->height - 1 : y;
    return m->data + ((size_t)y * (size_t)m->width + (size_t)x) * (size_t)m->n_channels;
}

static int row_of(const struct probe *p, double z)
{
    const int height = p->picture.image.height;
    int j = (int)(height * acos(z) / M_PI);
    j = j < 0 ? 0 : j >= height ? height - 1 : j;
    while (j > 0 && z > p->row_z[j]) // what rounding did
        j--;
    while (j < height - 1 && z < p->row_z[j + 1])
        j++;
    return j;
}

// Keeps the part of a polygon where sign * (coordinate - bound) >= 0.
static int cut(double (*to)[2], double (*from)[2], int n, int axis, double bound, double sign)
{
    int n_to = 0;
    for (int i = 0; i < n; i++) {
        const double *a = from[i], *b = from[(i + 1) % n];
        const double da = sign * (a[axis] - bound), db = sign * (b[axis] - bound);
        if (da >= 0)
            memcpy(to[n_to++], a, sizeof(to[0]));
        if ((da < 0) != (db < 0)) {
            const double t = da / (da - db);
            to[n_to][axis] = bound;
            to[n_to][!axis] = a[!axis] + t * (b[!axis] - a[!axis]);
            n_to++;
        }
    }
    return n_to;
}

static double area_of(double (*at)[2], int n)
{
    double twice = 0;
    for (int i = 0; i < n; i++)
        twice += at[i][0] * at[(i + 1) % n][1] - at[(i + 1) % n][0] * at[i][1];
    return fabs(.5 * twice);
}

// The mean over a quadrilateral on the cylinder. False: it is too large or degenerate for that.
static bool cut_mean(const struct probe *p, double (*quad)[2], int channel, double *out)
{
    double u[2] = { quad[0][0], quad[0][0] }, z[2] = { quad[0][1], quad[0][1] };
    for (int i = 1; i < 4; i++) {
        u[0] = fmin(u[0], quad[i][0]), u[1] = fmax(u[1], quad[i][0]);
        z[0] = fmin(z[0], quad[i][1]), z[1] = fmax(z[1], quad[i][1]);
    }
    const int first_column = (int)floor(u[0]), last_column = (int)floor(u[1]);
    const int first_row = row_of(p, z[1]), last_row = row_of(p, z[0]);
    if (first_column == last_column && first_row == last_row) {
        *out = pixel(p, first_column, first_row)[channel];
        return true;
    }
    if ((double)(last_column - first_column + 1) * (last_row - first_row + 1) > CELLS_MAX)
        return false;
    double sum = 0, area = 0;
    for (int j = first_row; j <= last_row; j++) {
        double a[CORNERS_MAX + 4][2], b[CORNERS_MAX + 4][2];
        const int n = cut(b, a, cut(a, quad, 4, 1, p->row_z[j], -1), 1, p->row_z[j + 1], 1);
        for (int i = first_column; n > 2 && i <= last_column; i++) {
            double c[CORNERS_MAX + 4][2], d[CORNERS_MAX + 4][2];
            const int n_cell = cut(d, c, cut(c, b, n, 0, i, 1), 0, i + 1, -1);
            const double cell = n_cell > 2 ? area_of(d, n_cell) : 0;
            sum += cell * (double)pixel(p, i, j)[channel];
            area += cell;
        }
    }
    *out = area > 0 ? sum / area : 0;
    return area > 0;
}

static bool look(const struct probe *p, double x_px, double y_px, double dir[3])
{
    const double *R = p->probe_from_camera, px[2] = { x_px, y_px };
    double d[3];
    if (!lens_ray(&p->lens, px, d))
        return false;
    for (int k = 0; k < 3; k++)
        dir[k] = R[3 * k] * d[0] + R[3 * k + 1] * d[1] + R[3 * k + 2] * d[2];
    return true;
}

static double sampled_mean(const struct probe *p, int x, int y, int channel)
{
    const struct image *m = &p->picture.image;
    double sum = 0;
    for (int j = 0; j < SAMPLES; j++)
        for (int i = 0; i < SAMPLES; i++) {
            double dir[3], at[2];
            if (!look(p, x - .5 + 2 * (i + .5) / SAMPLES, y - .5 + 2 * (j + .5) / SAMPLES, dir))
                continue;
            panorama_pixel(m->width, m->height, dir, &at[0], &at[1]);
            sum += (double)pixel(p, (int)floor(at[0]), (int)floor(at[1]))[channel];
        }
    return sum / (SAMPLES * SAMPLES);
}

// ---- rows ----------------------------------------------------------------------------------------------------------------------

static const struct corner *corners(struct probe *p, int row)
{
    const struct image *m = &p->picture.image;
    const int slot = (row + 1) % 3;
    struct corner *c = p->corner[slot];
    if (p->corner_row[slot] == row)
        return c;
    for (int x = 0; x < p->lens.width_px + 2; x++) {
        double dir[3], v;
        c[x].seen = look(p, x - .5, row - .5, dir);
        if (!c[x].seen)
            continue;
        panorama_pixel(m->width, m->height, dir, &c[x].u, &v);
        c[x].z = dir[1];
    }
    p->corner_row[slot] = row;
    return c;
}

static void make_row(struct probe *p, int y)
{
    const int width = p->lens.width_px, columns = p->picture.image.width;
    const struct corner *above = corners(p, y), *below = corners(p, y + 2);
    for (int x = 0; x < width; x++) {
        const struct corner *at[4] = { &above[x], &above[x + 2], &below[x + 2], &below[x] };
        const int channel = (x & 1) + (y & 1);
        const double centre[2] = { x + .5, y + .5 };
        double quad[4][2], mean = 0;
        int n_seen = 0;
        bool whole = true;
        for (int i = 0; i < 4; i++) {
            n_seen += at[i]->seen;
            whole &= at[i]->seen && fabs(at[i]->z) < POLE_Z;
            const double turn = i && whole ? round((at[i]->u - at[0]->u) / columns) : 0;
            quad[i][0] = at[i]->u - turn * columns;
            quad[i][1] = at[i]->z;
        }
        if (n_seen && (!whole || !cut_mean(p, quad, channel, &mean)))
            mean = sampled_mean(p, x, y, channel);
        p->site[(size_t)y * (size_t)width + (size_t)x] = (float)(p->gain * mean * (n_seen ? lens_shading(&p->lens, centre) : 0));
    }
    p->made[y] = true;
}

static void turn_to(struct probe *p, const struct scene_view *view)
{
    p->yaw_deg = view->yaw_deg;
    p->pitch_deg = view->pitch_deg;
    lens_head(p->probe_from_camera, view->yaw_deg * (M_PI / 180), view->pitch_deg * (M_PI / 180), 0);
    memset(p->made, 0, (size_t)p->lens.height_px * sizeof(p->made[0]));
    for (int i = 0; i < 3; i++)
        p->corner_row[i] = INT32_MIN;
}

void probe_row(struct probe *p, const struct scene_view *view, int y, float *site)
{
    const size_t width = (size_t)p->lens.width_px;
    if (view->yaw_deg != p->yaw_deg || view->pitch_deg != p->pitch_deg)
        turn_to(p, view);
    if (!p->made[y])
        make_row(p, y);
    const float *from = p->site + (size_t)y * width, level = (float)p->lamp_level, more = (float)(view->lamps - 1);
    for (size_t x = 0; x < width; x++)
        site[x] = from[x] > level ? from[x] + more * (from[x] - level) : from[x];
}

// ---- life ----------------------------------------------------------------------------------------------------------------------

// Its size is the sensor's.
int probe_lens(struct lens *out, const char *lens, int width_px, int height_px)
{
    struct json *doc = NULL;
    char *text = NULL;
    size_t n = strlen(lens);
    const bool is_text = lens[0] == '{';
    int err = is_text ? 0 : file_read(&text, &n, lens, 1 << 16);
    if (!err)
        err = json_parse(&doc, is_text ? lens : text, n, is_text ? "--lens" : lens);
    if (!err) {
        struct json *whole = json_new_object();
        json_set_int(doc, "width_px", width_px);
        json_set_int(doc, "height_px", height_px);
        json_set(whole, "lens", doc);
        err = lens_from_json(out, whole, "lens", is_text ? "--lens" : lens);
        json_free(whole);
    }
    free(text);
    return err;
}

int probe_open(struct probe **out, const char *panorama, const char *lens, double gain, int width_px, int height_px)
{
    struct probe *p = calloc(1, sizeof(*p));
    double total[3];
    if (!p)
        return -ENOMEM;
    int err = panorama_read(&p->picture, panorama);
    if (!err)
        err = probe_lens(&p->lens, lens, width_px, height_px);
    if (err)
        goto fail;
    err = -ENOMEM;
    const int height = p->picture.image.height;
    p->gain = gain;
    p->row_z = malloc(((size_t)height + 1) * sizeof(*p->row_z));
    p->site = malloc((size_t)width_px * (size_t)height_px * sizeof(*p->site));
    p->made = malloc((size_t)height_px * sizeof(*p->made));
    for (int i = 0; i < 3; i++)
        p->corner[i] = malloc(((size_t)width_px + 2) * sizeof(*p->corner[i]));
    if (!p->row_z || !p->site || !p->made || !p->corner[0] || !p->corner[1] || !p->corner[2])
        goto fail;
    for (int j = 0; j <= height; j++)
        p->row_z[j] = cos(M_PI * j / height);
    panorama_total(&p->picture, total);
    p->lamp_level = LAMP_LEVEL * gain * (total[0] + total[1] + total[2]) / (3 * 4 * M_PI);
    turn_to(p, &(struct scene_view){ 0 });
    *out = p;
    return 0;
fail:
    probe_close(p);
    return err;
}

int probe_width(const struct probe *p)
{
    return p->lens.width_px;
}

int probe_height(const struct probe *p)
{
    return p->lens.height_px;
}

void probe_close(struct probe *p)
{
    if (!p)
        return;
    panorama_free(&p->picture);
    for (int i = 0; i < 3; i++)
        free(p->corner[i]);
    free(p->row_z);
    free(p->site);
    free(p->made);
    free(p);
}
