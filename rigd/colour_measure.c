// rigd/colour_measure.c - see colour.h: a card or a chart in a frame. Apart from colour.c, so that rigctl, which only fits, links no picture
// formats.
#include "rigd/colour.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

enum { LEAST_SITES = 16 };

// The plane's map from the quadrilateral to the unit square, corner 0 to (0, 0), 1 to (1, 0), 2 to (1, 1), 3 to (0, 1): first the other way
// round in closed form, then inverted up to a factor.
static bool unit_from_quad(const double q[4][2], double inverse[3][3])
{
    for (int i = 0; i < 4; i++) { // convex, and turning clockwise as it is seen (y down)
        const double *a = q[i], *b = q[(i + 1) % 4], *c = q[(i + 2) % 4];
        if (!((b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]) > 0))
            return false;
    }
    const double sx = q[0][0] - q[1][0] + q[2][0] - q[3][0], sy = q[0][1] - q[1][1] + q[2][1] - q[3][1];
    const double dx1 = q[1][0] - q[2][0], dy1 = q[1][1] - q[2][1], dx2 = q[3][0] - q[2][0], dy2 = q[3][1] - q[2][1];
    const double det = dx1 * dy2 - dx2 * dy1, g = (sx * dy2 - dx2 * sy) / det, h = (dx1 * sy - sx * dy1) / det;
    const double m[3][3] = { { q[1][0] - q[0][0] + g * q[1][0], q[3][0] - q[0][0] + h * q[3][0], q[0][0] },
                             { q[1][1] - q[0][1] + g * q[1][1], q[3][1] - q[0][1] + h * q[3][1], q[0][1] },
                             { g, h, 1 } };
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            inverse[j][i] = m[(i + 1) % 3][(j + 1) % 3] * m[(i + 2) % 3][(j + 2) % 3] - m[(i + 1) % 3][(j + 2) % 3] * m[(i + 2) % 3][(j + 1) % 3];
    return true;
}

static void measure_site(struct cell *cell, const struct raw_frame *f, const struct saturation *s, const struct flat *flat, int x, int y)
{
    const int c = f->cfa[y & 1][x & 1];
    const double black = f->black[y & 1][x & 1];
    const double v = (f->site[(size_t)y * (size_t)f->width + (size_t)x] - black) / (f->white - black);
    cell->raw[c] += v;
    cell->mean[c] += v * flat_at(flat, (x + .5) / f->width, (y + .5) / f->height, c);
    cell->n[c]++;
    cell->n_saturated += s->bits[(size_t)y * (((size_t)s->width + 63) / 64) + (size_t)x / 64] >> x % 64 & 1;
}

int colour_measure(struct cell *out, const struct raw_frame *f, const struct saturation *s, const struct flat *flat, double exposure_scale,
                   const double corner[4][2], int columns, int rows, double share, char *why, size_t room)
{
    double m[3][3], x0 = f->width, y0 = f->height, x1 = 0, y1 = 0;
    for (int i = 0; i < 4; i++) {
        const double x = corner[i][0], y = corner[i][1];
        if (!(x >= 0 && y >= 0 && x <= f->width && y <= f->height)) {
            snprintf(why, room, "corner %g,%g lies outside of the frame's %d x %d photosites", x, y, f->width, f->height);
            return -EINVAL;
        }
        x0 = fmin(x0, x), y0 = fmin(y0, y), x1 = fmax(x1, x), y1 = fmax(y1, y);
    }
    if (!unit_from_quad(corner, m)) {
        snprintf(why, room, "the corners make no convex figure; expected upper left, upper right, lower right, lower left");
        return -EINVAL;
    }
    memset(out, 0, (size_t)(columns * rows) * sizeof(out[0]));
    for (int y = (int)y0; y < f->height && y < y1; y++)
        for (int x = (int)x0; x < f->width && x < x1; x++) {
            double p[3];
            for (int i = 0; i < 3; i++)
                p[i] = m[i][0] * (x + .5) + m[i][1] * (y + .5) + m[i][2];
            const double u = p[0] / p[2] * columns, v = p[1] / p[2] * rows;
            if (!(u >= 0 && v >= 0 && u < columns && v < rows) || 2 * fabs(u - floor(u) - .5) > share || 2 * fabs(v - floor(v) - .5) > share)
                continue;
            measure_site(&out[(int)v * columns + (int)u], f, s, flat, x, y);
        }
    for (int i = 0; i < columns * rows; i++)
        for (int c = 0; c < 3; c++) {
            if (out[i].n[c] < LEAST_SITES) {
                snprintf(why, room, "patch %d has %lld photosites of a colour; expected %d or more: move closer or name a larger patch", i + 1, (long long)out[i].n[c], LEAST_SITES);
                return -EINVAL;
            }
            out[i].raw[c] /= (double)out[i].n[c];
            out[i].mean[c] *= f->daylight[c] * exposure_scale / (double)out[i].n[c];
        }
    return 0;
}
