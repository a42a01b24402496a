// solver/panorama.c - reading a panorama, and what each of its pixels means: direction, solid
// angle, energy.
//
// Everything that follows is a sum of radiance x solid angle, so the solid angle is the exact one
// of the pixel's latitude band: a constant panorama sums to 4 pi whatever its size.
#include "solver/panorama.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <errno.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

static const char *const rgb[] = {"R", "G", "B", NULL};

// Keep R, G, B of a picture that may have more (A, depth, layers).
static int keep_rgb(struct image *image, const char *path)
{
    int from[3];
    for (int c = 0; c < 3; c++) {
        from[c] = image_channel(image, rgb[c]);
        if (from[c] >= 0)
            continue;
        log_error("panorama: %s: no channel %s (its first is %s): a panorama needs R, G and B; "
                  "save it as RGB",
                  path, rgb[c], image->names[0]);
        return -EINVAL;
    }
    if (image->n_channels == 3 && from[0] == 0 && from[1] == 1 && from[2] == 2)
        return 0;
    struct image kept;
    const int err = image_new(&kept, image->width, image->height, 3, NULL);
    if (err)
        return err;
    const int64_t n = (int64_t)image->width * image->height;
    for (int64_t i = 0; i < n; i++)
        for (int c = 0; c < 3; c++)
            kept.data[3 * i + c] = image->data[i * image->n_channels + from[c]];
    image_free(image);
    *image = kept;
    return 0;
}

// Light is never negative: resampling filters make such pixels. Returns -EINVAL if nothing is left.
static int clear_negatives(struct image *image, const char *path)
{
    const int64_t n = 3 * (int64_t)image->width * image->height;
    int64_t n_negative = 0, first = 0;
    float lowest = 0, highest = 0;
    for (int64_t i = 0; i < n; i++) {
        const float v = image->data[i];
        if (v > highest)
            highest = v;
        if (v >= 0)
            continue;
        if (!n_negative++)
            first = i;
        if (v < lowest)
            lowest = v;
        image->data[i] = 0;
    }
    const int x = (int)(first / 3 % image->width), y = (int)(first / 3 / image->width);
    if (n_negative)
        log_warning("panorama: %s: %" PRId64
                    " negative values set to 0 (first at column %d, row %d; lowest %g)",
                    path, n_negative, x, y, (double)lowest);
    if (highest > 0)
        return 0;
    log_error("panorama: %s: all %dx%d pixels are black: there is no light to cut; was the right "
              "bracket merged?",
              path, image->width, image->height);
    return -EINVAL;
}

int panorama_read(struct panorama *out, const char *path)
{
    struct image image = {0};
    memset(out, 0, sizeof(*out));
    int err = image_read(&image, path);
    if (err)
        return err;
    if (image.width != 2 * image.height) {
        log_error(
            "panorama: %s: %dx%d is not 2:1: a latitude-longitude picture of the whole sphere is "
            "twice as wide as high (%dx%d): pad or crop it",
            path, image.width, image.height, 2 * image.height, image.height);
        err = -EINVAL;
        goto fail;
    }
    err = keep_rgb(&image, path);
    if (err)
        goto fail;
    err = image_require_finite(&image, rgb, path);
    if (err)
        goto fail;
    err = clear_negatives(&image, path);
    if (err)
        goto fail;
    out->image = image;
    return 0;
fail:
    image_free(&image);
    return err;
}

void panorama_free(struct panorama *p)
{
    if (p)
        image_free(&p->image);
}

void panorama_direction(int width, int height, double x_px, double y_px, double dir[3])
{
    const double lon = M_PI - 2 * M_PI * x_px / width, lat = M_PI / 2 - M_PI * y_px / height;
    dir[0] = sin(lon) * cos(lat), dir[1] = sin(lat), dir[2] = cos(lon) * cos(lat);
}

void panorama_pixel(int width, int height, const double dir[3], double *x_px, double *y_px)
{
    const double lon = atan2(dir[0], dir[2]), lat = atan2(dir[1], hypot(dir[0], dir[2]));
    const double x = (M_PI - lon) * width / (2 * M_PI);
    *x_px = x < width ? x : 0; // longitude -180 is +180, the left edge
    *y_px = (M_PI / 2 - lat) * height / M_PI;
}

// cos a - cos b = 2 sin((a+b)/2) sin((b-a)/2): no cancellation near the poles.
double panorama_solid_angle(int width, int height, int y)
{
    return 4 * M_PI / width * sin(M_PI * (y + .5) / height) * sin(M_PI / (2 * height));
}

void panorama_irradiance(const struct panorama *p, const double normal_probe[3],
                         double irradiance[3])
{
    enum { BLOCK = 256 }; // columns whose longitude is worked out once
    const int width = p->image.width, height = p->image.height;
    double sum[3] = {0, 0, 0};
    for (int x0 = 0; x0 < width; x0 += BLOCK) {
        const int n = width - x0 < BLOCK ? width - x0 : BLOCK;
        double across[BLOCK]; // the horizontal part of <n, d>, before cos(lat)
        for (int i = 0; i < n; i++) {
            const double lon = M_PI - 2 * M_PI * (x0 + i + .5) / width;
            across[i] = normal_probe[0] * sin(lon) + normal_probe[2] * cos(lon);
        }
        for (int y = 0; y < height; y++) {
            const float *pixel = p->image.data + 3 * ((int64_t)y * width + x0);
            const double lat = M_PI / 2 - M_PI * (y + .5) / height;
            const double up = normal_probe[1] * sin(lat), level = cos(lat);
            double row[3] = {0, 0, 0};
            for (int i = 0; i < n; i++) {
                const double cosine = up + level * across[i];
                if (cosine > 0)
                    for (int c = 0; c < 3; c++)
                        row[c] += cosine * pixel[3 * i + c];
            }
            for (int c = 0; c < 3; c++)
                sum[c] += row[c] * panorama_solid_angle(width, height, y);
        }
    }
    for (int c = 0; c < 3; c++)
        irradiance[c] = sum[c];
}

void panorama_total(const struct panorama *p, double total[3])
{
    const int width = p->image.width, height = p->image.height;
    double sum[3] = {0, 0, 0};
    for (int y = 0; y < height; y++) {
        const float *pixel = p->image.data + 3 * (int64_t)y * width;
        double row[3] = {0, 0, 0};
        for (int x = 0; x < width; x++)
            for (int c = 0; c < 3; c++)
                row[c] += pixel[3 * x + c];
        for (int c = 0; c < 3; c++)
            sum[c] += row[c] * panorama_solid_angle(width, height, y);
    }
    for (int c = 0; c < 3; c++)
        total[c] = sum[c];
}
