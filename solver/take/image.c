// solver/take/image.c - images in memory, and which decoder a file belongs to.
#include "solver/take/image.h"
#include "solver/take/atomic_file.h"
#include "solver/take/image_formats.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_SIDE_PX = 65536, MAX_PIXELS = 1 << 28, MAX_RATIO = 1200 };
static const size_t MAX_FILE_BYTES = (size_t)8 << 30, FREE_BYTES = (size_t)64 << 20;

int image_new(struct image *out, int width, int height, int n_channels, const char *const *names)
{
    static const char *const grey[] = { "Y" }, *const rgba[] = { "R", "G", "B", "A" };
    *out = (struct image){ 0 };
    if (width < 1 || height < 1 || width > MAX_SIDE_PX || height > MAX_SIDE_PX ||
        (int64_t)width * height > MAX_PIXELS || n_channels < 1 || n_channels > IMAGE_MAX_CHANNELS)
        return -EINVAL;
    if (!names && n_channels == 2)
        return -EINVAL;
    if (!names && n_channels > 4)
        return -EINVAL;
    if (!names)
        names = n_channels == 1 ? grey : rgba;
    for (int c = 0; c < n_channels; c++)
        if (strlen(names[c]) >= IMAGE_NAME_MAX)
            return -EINVAL;
    out->names = calloc((size_t)n_channels, sizeof(*out->names));
    out->data = calloc((size_t)width * (size_t)height * (size_t)n_channels, sizeof(float));
    if (!out->names || !out->data) {
        image_free(out);
        return -ENOMEM;
    }
    out->width = width, out->height = height, out->n_channels = n_channels;
    for (int c = 0; c < n_channels; c++)
        strcpy(out->names[c], names[c]);
    return 0;
}

void image_free(struct image *image)
{
    if (!image)
        return;
    free(image->names);
    free(image->data);
    *image = (struct image){ 0 };
}

int image_check_size(const struct image_file *file, int64_t width, int64_t height, int n_channels,
                     int stored_bytes)
{
    if (width < 1 || height < 1 || n_channels < 1) {
        log_error(
            "image: %s: found %lld x %lld pixels of %d channels, expected at least one of each",
            file->name, (long long)width, (long long)height, n_channels);
        return -EINVAL;
    }
    if (width > MAX_SIDE_PX || height > MAX_SIDE_PX || width * height > MAX_PIXELS ||
        n_channels > IMAGE_MAX_CHANNELS) {
        log_error("image: %s: %lld x %lld pixels of %d channels; at most %d a side, %d pixels and "
                  "%d channels "
                  "are read",
                  file->name, (long long)width, (long long)height, n_channels, MAX_SIDE_PX,
                  MAX_PIXELS, IMAGE_MAX_CHANNELS);
        return -EFBIG;
    }
    const uint64_t asked = (uint64_t)(width * height) * (uint64_t)stored_bytes;
    if (asked > file->n_bytes * MAX_RATIO + FREE_BYTES) {
        log_error("image: %s: the header asks for %lld x %lld pixels (%llu bytes), which a file of "
                  "%zu bytes cannot hold",
                  file->name, (long long)width, (long long)height, (unsigned long long)asked,
                  file->n_bytes);
        return -EFBIG;
    }
    return 0;
}

int image_new_for(struct image *out, const struct image_file *file, int width, int height,
                  int n_channels, const char *const *names)
{
    const int err = image_new(out, width, height, n_channels, names);
    if (err)
        log_error("image: %s: no memory for %d x %d pixels of %d channels", file->name, width,
                  height, n_channels);
    return err;
}

static bool begins_with(const struct image_file *file, const char *magic, size_t n)
{
    return file->n_bytes >= n && !memcmp(file->bytes, magic, n);
}

int image_read_memory(struct image *out, const struct image_file *file)
{
    *out = (struct image){ 0 };
    if (begins_with(file, "\x76\x2f\x31\x01", 4))
        return image_read_exr(out, file);
    if (begins_with(file, "#?", 2))
        return image_read_hdr(out, file);
    if (begins_with(file, "\x89PNG\r\n\x1a\n", 8))
        return image_read_png(out, file);
    if (begins_with(file, "II*\0", 4) || begins_with(file, "MM\0*", 4) ||
        begins_with(file, "II+\0", 4) || begins_with(file, "MM\0+", 4))
        return image_read_tiff(out, file);
    if (file->n_bytes == 0) {
        log_error("image: %s: the file is empty", file->name);
        return -EINVAL;
    }
    log_error("image: %s: found neither OpenEXR, Radiance .hdr, TIFF nor PNG: %s", file->name,
              begins_with(file, "\xff\xd8\xff", 3)
                  ? "a JPEG is not linear; develop the raw file to EXR or TIFF"
                  : "export it as one of these");
    return -EINVAL;
}

int image_read(struct image *out, const char *path)
{
    char *bytes;
    size_t n;
    *out = (struct image){ 0 };
    int err = file_read(&bytes, &n, path, MAX_FILE_BYTES);
    if (err)
        return err;
    err = image_read_memory(out, &(struct image_file){ (const uint8_t *)bytes, n, path });
    free(bytes);
    return err;
}

int image_read_texture(struct image *out, const char *path, bool is_colour)
{
    char *bytes;
    size_t n;
    *out = (struct image){ 0 };
    int err = file_read(&bytes, &n, path, MAX_FILE_BYTES);
    if (err)
        return err;
    const struct image_file file = { (const uint8_t *)bytes, n, path };
    const bool jpeg = begins_with(&file, "\xff\xd8\xff", 3), curved = jpeg || begins_with(&file, "\x89PNG\r\n\x1a\n", 8);
    err = jpeg ? image_read_jpeg(out, &file) : image_read_memory(out, &file);
    free(bytes);
    const size_t n_values = err || !curved || !is_colour ? 0 : (size_t)out->width * (size_t)out->height * (size_t)out->n_channels;
    for (size_t i = 0; i < n_values; i++) {
        const double v = (double)out->data[i];
        out->data[i] = (float)(v <= .04045 ? v / 12.92 : pow((v + .055) / 1.055, 2.4));
    }
    return err;
}

int image_channel(const struct image *image, const char *name)
{
    for (int c = 0; c < image->n_channels; c++)
        if (!strcmp(image->names[c], name))
            return c;
    return -1;
}

int image_require_finite(const struct image *image, const char *const *names, const char *path)
{
    bool wanted[IMAGE_MAX_CHANNELS] = { false };
    for (int c = 0; c < image->n_channels; c++)
        wanted[c] = !names;
    for (; names && *names; names++) {
        const int c = image_channel(image, *names);
        if (c >= 0)
            wanted[c] = true;
    }
    const int64_t n_pixels = (int64_t)image->width * image->height;
    int64_t n_bad = 0, first = 0;
    int first_channel = 0;
    for (int64_t i = 0; i < n_pixels; i++)
        for (int c = 0; c < image->n_channels; c++)
            if (wanted[c] && !isfinite(image->data[i * image->n_channels + c]) && n_bad++ == 0)
                first = i, first_channel = c;
    if (!n_bad)
        return 0;
    log_error("image: %s: %lld values are NaN or infinite, the first in channel %s at column %d, "
              "row %d; repair "
              "the picture or leave it out",
              path, (long long)n_bad, image->names[first_channel], (int)(first % image->width),
              (int)(first / image->width));
    return -EDOM;
}

uint8_t image_srgb_byte(double linear)
{
    if (!(linear > 0)) // NaN too
        return 0;
    if (linear >= 1)
        return 255;
    const double v = linear <= .0031308 ? 12.92 * linear : 1.055 * pow(linear, 1 / 2.4) - .055;
    return (uint8_t)(v * 255 + .5);
}

int image_write_png_srgb(const struct image *image, const char *path, double exposure_ev)
{
    const int n = image->n_channels >= 3 ? 3 : 1;
    const size_t n_pixels = (size_t)image->width * (size_t)image->height;
    const double gain = exp2(exposure_ev);
    uint8_t *pixels = malloc(n_pixels * (size_t)n);
    if (!pixels) {
        log_error("image: cannot write %s: out of memory", path);
        return -ENOMEM;
    }
    for (size_t i = 0; i < n_pixels; i++)
        for (int c = 0; c < n; c++)
            pixels[i * (size_t)n + (size_t)c] =
                image_srgb_byte(gain * (double)image->data[i * (size_t)image->n_channels + (size_t)c]);
    const int err = image_write_png(path, image->width, image->height, n, pixels);
    free(pixels);
    return err;
}

// Two neighbouring indices around continuous x and the weight of the second, clamped to [0, n).
static void neighbours(double x, int n, int *i0, int *i1, double *weight)
{
    double t = x - .5;
    t = t > 0 ? (t < n - 1 ? t : n - 1) : 0; // NaN becomes 0
    *i0 = (int)t;
    *i1 = *i0 + 1 < n ? *i0 + 1 : *i0;
    *weight = t - *i0;
}

void image_bilinear(const struct image *image, double x_px, double y_px, float *out)
{
    int x0, x1, y0, y1;
    double wx, wy;
    const int n = image->n_channels;
    neighbours(x_px, image->width, &x0, &x1, &wx);
    neighbours(y_px, image->height, &y0, &y1, &wy);
    const float *row0 = image->data + (int64_t)y0 * image->width * n;
    const float *row1 = image->data + (int64_t)y1 * image->width * n;
    for (int c = 0; c < n; c++) {
        const double top =
            (1 - wx) * (double)row0[(int64_t)x0 * n + c] + wx * (double)row0[(int64_t)x1 * n + c];
        const double bottom =
            (1 - wx) * (double)row1[(int64_t)x0 * n + c] + wx * (double)row1[(int64_t)x1 * n + c];
        out[c] = (float)((1 - wy) * top + wy * bottom);
    }
}
