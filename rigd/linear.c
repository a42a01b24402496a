// rigd/linear.c - see linear.h.
#include "rigd/linear.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { AHD_REACH_PX = 3 };

// ---- saturation --------------------------------------------------------------------------------------------------------------

static size_t words_per_row(int width)
{
    return ((size_t)width + 63) / 64;
}

int saturation_of(struct saturation *out, const struct raw_frame *f, double level)
{
    const size_t n_words = words_per_row(f->width);
    *out = (struct saturation){ .width = f->width, .height = f->height };
    out->bits = calloc((size_t)f->height * n_words, sizeof(out->bits[0]));
    out->in_row = calloc((size_t)f->height, sizeof(out->in_row[0]));
    if (!out->bits || !out->in_row) {
        saturation_free(out);
        return -ENOMEM;
    }
    const int least = level > 65535 ? 65536 : (int)ceil(level);
    for (int y = 0; y < f->height; y++) {
        const uint16_t *row = f->site + (size_t)y * (size_t)f->width;
        for (int x = 0; x < f->width; x++)
            if (row[x] >= least) {
                out->bits[(size_t)y * n_words + (size_t)x / 64] |= (uint64_t)1 << x % 64;
                out->in_row[y]++;
            }
        out->n += out->in_row[y];
    }
    return 0;
}

void saturation_free(struct saturation *s)
{
    if (!s)
        return;
    free(s->bits);
    free(s->in_row);
    *s = (struct saturation){ 0 };
}

static bool is_saturated(const struct saturation *s, int x, int y)
{
    return x >= 0 && y >= 0 && x < s->width && y < s->height && (s->bits[(size_t)y * words_per_row(s->width) + (size_t)x / 64] >> x % 64 & 1);
}

// ---- flat field --------------------------------------------------------------------------------------------------------------

// Means become gains, relative to the middle tenth.
static int finish_flat(struct flat *f, double (*sum)[FLAT_COLUMNS][3], int64_t (*n)[FLAT_COLUMNS][3], double least, char *why, size_t room)
{
    double middle[3] = { 0 };
    int n_middle = 0;
    for (int y = 0; y < FLAT_ROWS; y++)
        for (int x = 0; x < FLAT_COLUMNS; x++) {
            const bool in_middle = abs(2 * y + 1 - FLAT_ROWS) * 10 <= FLAT_ROWS && abs(2 * x + 1 - FLAT_COLUMNS) * 10 <= FLAT_COLUMNS;
            for (int c = 0; c < 3; c++) {
                const double mean = n[y][x][c] ? sum[y][x][c] / (double)n[y][x][c] : 0;
                if (!(mean > least)) {
                    snprintf(why, room, "as a flat field it is too dark at %d %% of its width, %d %% of its height: expose it longer, to about half of white",
                             100 * x / FLAT_COLUMNS, 100 * y / FLAT_ROWS);
                    return -EDOM;
                }
                f->gain[y][x][c] = (float)mean;
                middle[c] += in_middle ? mean : 0;
            }
            n_middle += in_middle;
        }
    for (int y = 0; y < FLAT_ROWS; y++)
        for (int x = 0; x < FLAT_COLUMNS; x++)
            for (int c = 0; c < 3; c++)
                f->gain[y][x][c] = (float)(middle[c] / n_middle / (double)f->gain[y][x][c]);
    return 0;
}

int flat_from_frame(struct flat *out, const struct raw_frame *f, const struct saturation *s, char *why, size_t room)
{
    const double least = .01, most_clipped = 1e-3;
    if (f->width < 2 * FLAT_COLUMNS || f->height < 2 * FLAT_ROWS) {
        snprintf(why, room, "as a flat field it is too small: %d x %d photosites", f->width, f->height);
        return -EINVAL;
    }
    if ((double)s->n > most_clipped * f->width * f->height) {
        snprintf(why, room, "as a flat field it is useless: %.1f %% of its photosites are saturated; expose it to about half of white",
                 100. * (double)s->n / f->width / f->height);
        return -EDOM;
    }
    double (*sum)[FLAT_COLUMNS][3] = calloc(FLAT_ROWS, sizeof(*sum));
    int64_t (*n)[FLAT_COLUMNS][3] = calloc(FLAT_ROWS, sizeof(*n));
    int err = sum && n ? 0 : -ENOMEM;
    for (int y = 0; y < f->height && !err; y++)
        for (int x = 0; x < f->width; x++) {
            const int cy = (int)((int64_t)y * FLAT_ROWS / f->height), cx = (int)((int64_t)x * FLAT_COLUMNS / f->width), c = f->cfa[y & 1][x & 1];
            const double black = f->black[y & 1][x & 1];
            sum[cy][cx][c] += (f->site[(size_t)y * (size_t)f->width + (size_t)x] - black) / (f->white - black);
            n[cy][cx][c]++;
        }
    if (!err)
        err = finish_flat(out, sum, n, least, why, room);
    else
        snprintf(why, room, "out of memory");
    free(sum);
    free(n);
    return err;
}

static bool invert(const double m[3][3], double out[3][3])
{
    double det = 0;
    for (int i = 0; i < 3; i++)
        det += m[0][i] * (m[1][(i + 1) % 3] * m[2][(i + 2) % 3] - m[1][(i + 2) % 3] * m[2][(i + 1) % 3]);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[j][i] = (m[(i + 1) % 3][(j + 1) % 3] * m[(i + 2) % 3][(j + 2) % 3] - m[(i + 1) % 3][(j + 2) % 3] * m[(i + 2) % 3][(j + 1) % 3]) / det;
    return fabs(det) > 1e-9;
}

int flat_from_image(struct flat *out, const struct image *image, const double srgb_from_camera[3][3], char *why, size_t room)
{
    const int r = image_channel(image, "R"), g = image_channel(image, "G"), b = image_channel(image, "B"), grey = image_channel(image, "Y");
    const int channel[3] = { r >= 0 ? r : grey, g >= 0 ? g : grey, b >= 0 ? b : grey };
    double camera_from_srgb[3][3];
    if (channel[0] < 0 || channel[1] < 0 || channel[2] < 0 || image->width < FLAT_COLUMNS || image->height < FLAT_ROWS || !invert(srgb_from_camera, camera_from_srgb)) {
        snprintf(why, room, "as a flat field: found %d x %d pixels %s; expected R, G and B or Y, and at least %d x %d", image->width, image->height,
                 channel[0] < 0 ? "without R or Y" : "", FLAT_COLUMNS, FLAT_ROWS);
        return -EINVAL;
    }
    double (*sum)[FLAT_COLUMNS][3] = calloc(FLAT_ROWS, sizeof(*sum));
    int64_t (*n)[FLAT_COLUMNS][3] = calloc(FLAT_ROWS, sizeof(*n));
    int err = sum && n ? 0 : -ENOMEM;
    for (int y = 0; y < image->height && !err; y++)
        for (int x = 0; x < image->width; x++) {
            const float *p = image->data + ((size_t)y * (size_t)image->width + (size_t)x) * (size_t)image->n_channels;
            const int cy = (int)((int64_t)y * FLAT_ROWS / image->height), cx = (int)((int64_t)x * FLAT_COLUMNS / image->width);
            for (int c = 0; c < 3; c++) {
                for (int k = 0; k < 3; k++)
                    sum[cy][cx][c] += camera_from_srgb[c][k] * (double)p[channel[k]];
                n[cy][cx][c]++;
            }
        }
    if (!err)
        err = finish_flat(out, sum, n, 0, why, room);
    else
        snprintf(why, room, "out of memory");
    free(sum);
    free(n);
    return err;
}

// Where v (0 .. 1 across the frame) lies between the centres of n cells.
static int cell_before(double v, int n, float *weight)
{
    double t = v * n - .5;
    t = t < 0 ? 0 : t > n - 1 ? n - 1 : t;
    const int i = t < n - 1 ? (int)t : n - 2;
    *weight = (float)(t - i);
    return i;
}

double flat_at(const struct flat *flat, double u, double v, int c)
{
    float wx, wy;
    if (!flat)
        return 1;
    const int cx = cell_before(u, FLAT_COLUMNS, &wx), cy = cell_before(v, FLAT_ROWS, &wy);
    const float above = (1 - wx) * flat->gain[cy][cx][c] + wx * flat->gain[cy][cx + 1][c];
    const float below = (1 - wx) * flat->gain[cy + 1][cx][c] + wx * flat->gain[cy + 1][cx + 1][c];
    return (double)((1 - wy) * above + wy * below);
}

static void apply_flat(const struct linear *l, int y, float *row, int stride)
{
    float wy;
    const int cy = cell_before((y + .5) / l->height, FLAT_ROWS, &wy);
    for (int i = 0; i < FLAT_COLUMNS * 3; i++)
        l->flat_row[i] = (1 - wy) * l->flat->gain[cy][i / 3][i % 3] + wy * l->flat->gain[cy + 1][i / 3][i % 3];
    for (int x = 0; x < l->width; x++) {
        float wx;
        const int cx = cell_before((x + .5) / l->width, FLAT_COLUMNS, &wx);
        for (int c = 0; c < 3; c++)
            row[x * stride + c] *= (1 - wx) * l->flat_row[3 * cx + c] + wx * l->flat_row[3 * cx + 3 + c];
    }
}

// ---- rows --------------------------------------------------------------------------------------------------------------------

int linear_open(struct linear *out, enum demosaic demosaic, const struct raw_frame *frame, const struct raw_rgb *interpolated,
                const struct saturation *saturation, const struct flat *flat, const double gain[3])
{
    const int shrink = demosaic == DEMOSAIC_HALF ? 2 : 1;
    *out = (struct linear){ .width = frame->width / shrink, .height = frame->height / shrink, .frame = frame, .interpolated = interpolated,
                            .saturation = saturation, .flat = flat, .gain = { gain[0], gain[1], gain[2] }, .demosaic = demosaic,
                            .ring_y = { -2, -2, -2 } }; // -1 is a row: the one above the first
    bool ok = true;
    for (int i = 0; i < 3 && demosaic == DEMOSAIC_BILINEAR; i++) {
        out->ring[i] = malloc(((size_t)frame->width + 2) * sizeof(float));
        ok = ok && out->ring[i];
    }
    out->flat_row = malloc(FLAT_COLUMNS * 3 * sizeof(float));
    if (ok && out->flat_row)
        return 0;
    linear_close(out);
    return -ENOMEM;
}

void linear_close(struct linear *l)
{
    for (int i = 0; i < 3; i++)
        free(l->ring[i]);
    free(l->flat_row);
    *l = (struct linear){ 0 };
}

// What a site's DN above black is multiplied by.
static float site_scale(const struct raw_frame *f, int y, int x)
{
    return (float)(f->daylight[f->cfa[y & 1][x & 1]] / (f->white - f->black[y & 1][x & 1]));
}

static void half_row(const struct linear *l, int y, float *to)
{
    const struct raw_frame *f = l->frame;
    for (int x = 0; x < l->width; x++, to += 4) {
        to[0] = to[1] = to[2] = 0;
        for (int i = 0; i < 4; i++) {
            const int sy = 2 * y + i / 2, sx = 2 * x + i % 2, c = f->cfa[i / 2][i % 2];
            const float dn = (float)f->site[(size_t)sy * (size_t)f->width + (size_t)sx] - (float)f->black[i / 2][i % 2];
            to[c] += (c == RAW_GREEN ? .5f : 1) * dn * site_scale(f, i / 2, i % 2);
        }
    }
}

// Beyond the border a row or column repeats the one as far inside: its sites have the same colours.
static int mirrored(int i, int n)
{
    return i < 0 ? -i : i >= n ? 2 * n - 2 - i : i;
}

// Sites of row y (which may lie one outside), scaled, with one more on either side; [x + 1].
static const float *scaled_row(struct linear *l, int y)
{
    const struct raw_frame *f = l->frame;
    const int slot = (y + 3) % 3, from = mirrored(y, f->height);
    float *row = l->ring[slot];
    if (l->ring_y[slot] == y)
        return row + 1;
    const uint16_t *site = f->site + (size_t)from * (size_t)f->width;
    const float scale[2] = { site_scale(f, from, 0), site_scale(f, from, 1) };
    const float black[2] = { (float)f->black[from & 1][0], (float)f->black[from & 1][1] };
    for (int x = 0; x < f->width; x++)
        row[x + 1] = ((float)site[x] - black[x & 1]) * scale[x & 1];
    row[0] = row[2];
    row[f->width + 1] = row[f->width - 1];
    l->ring_y[slot] = y;
    return row + 1;
}

static void bilinear_row(struct linear *l, int y, float *to)
{
    const float *above = scaled_row(l, y - 1), *here = scaled_row(l, y), *below = scaled_row(l, y + 1);
    for (int x = 0; x < l->width; x++, to += 4) {
        const int c = l->frame->cfa[y & 1][x & 1];
        const float across = here[x - 1] + here[x + 1], down = above[x] + below[x];
        to[c] = here[x];
        if (c == RAW_GREEN) {
            const int beside = l->frame->cfa[y & 1][(x + 1) & 1];
            to[beside] = across / 2;
            to[RAW_BLUE - beside] = down / 2;
        } else {
            to[RAW_GREEN] = (across + down) / 4;
            to[RAW_BLUE - c] = (above[x - 1] + above[x + 1] + below[x - 1] + below[x + 1]) / 4;
        }
    }
}

static void interpolated_row(const struct linear *l, int y, float *to)
{
    const struct raw_rgb *r = l->interpolated;
    const uint16_t(*from)[4] = r->pixel + (size_t)y * (size_t)r->width;
    float scale[3], less[3];
    for (int c = 0; c < 3; c++) {
        scale[c] = (float)(r->unit[c] * l->frame->daylight[c]);
        less[c] = (float)(r->pedestal[c] * l->frame->daylight[c]);
    }
    for (int x = 0; x < l->width; x++, to += 4)
        for (int c = 0; c < 3; c++)
            to[c] = (float)from[x][c] * scale[c] - less[c];
}

static bool is_clipped(const struct linear *l, int x, int y)
{
    const struct saturation *s = l->saturation;
    if (l->demosaic == DEMOSAIC_HALF)
        return is_saturated(s, 2 * x, 2 * y) || is_saturated(s, 2 * x + 1, 2 * y) || is_saturated(s, 2 * x, 2 * y + 1) || is_saturated(s, 2 * x + 1, 2 * y + 1);
    const int reach = l->demosaic == DEMOSAIC_AHD ? AHD_REACH_PX : 1;
    const bool cross = l->demosaic == DEMOSAIC_BILINEAR && l->frame->cfa[y & 1][x & 1] == RAW_GREEN;
    for (int dy = -reach; dy <= reach; dy++)
        for (int dx = -reach; dx <= reach; dx++)
            if (!(cross && dx && dy) && is_saturated(s, x + dx, y + dy))
                return true;
    return false;
}

static void mark_clipped(const struct linear *l, int y, float *row)
{
    const int shrink = l->demosaic == DEMOSAIC_HALF ? 2 : 1, reach = l->demosaic == DEMOSAIC_AHD ? AHD_REACH_PX : 1;
    const int first = y * shrink - (shrink == 1 ? reach : 0), last = y * shrink + reach;
    bool any = false;
    for (int k = first < 0 ? 0 : first; k <= last && k < l->saturation->height; k++)
        any = any || l->saturation->in_row[k];
    for (int x = 0; x < l->width; x++)
        row[4 * x + 3] = any && is_clipped(l, x, y);
}

int linear_row(void *arg, int y, float *rgbc)
{
    struct linear *l = arg;
    float m[3][3];
    if (l->demosaic == DEMOSAIC_HALF)
        half_row(l, y, rgbc);
    else if (l->demosaic == DEMOSAIC_BILINEAR)
        bilinear_row(l, y, rgbc);
    else
        interpolated_row(l, y, rgbc);
    if (l->flat)
        apply_flat(l, y, rgbc, 4);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            m[i][j] = (float)(l->frame->srgb_from_camera[i][j] * l->gain[j]);
    for (int x = 0; x < l->width; x++) {
        float *p = rgbc + 4 * x;
        const float r = p[0], g = p[1], b = p[2];
        for (int i = 0; i < 3; i++)
            p[i] = m[i][0] * r + m[i][1] * g + m[i][2] * b;
    }
    mark_clipped(l, y, rgbc);
    return 0;
}
