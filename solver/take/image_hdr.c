// solver/take/image_hdr.c - Radiance .hdr: a text header, then rows of R, G, B mantissas with one
// exponent.
//
// As Radiance's own reader decodes: (mantissa + .5) * 2^(exponent - 136), exponent 0 is black;
// EXPOSURE and COLORCORR tell what the values were multiplied by, so they are divided out.
#include "solver/take/image_formats.h"
#include "solver/take/log.h"

#include <errno.h>
#include <locale.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MIN_RLE_WIDTH = 8, MAX_RLE_WIDTH = 32767, MAX_LINE = 512 };

struct hdr {
    const struct image_file *file;
    size_t offset;
    int line; // of the header, from 1
    int width, height;
    double divide_by[3];
    locale_t c_locale; // numbers in files have a point whatever the user's language
};

static int broken(const struct hdr *h, int row, const char *found)
{
    log_error("image: %s: row %d, byte %zu: %s: the file is broken or cut short", h->file->name,
              row, h->offset, found);
    return -EINVAL;
}

// The next header line without its end; false when there is none or it is too long.
static bool next_line(struct hdr *h, char line[MAX_LINE])
{
    const uint8_t *begin = h->file->bytes + h->offset;
    const uint8_t *end = memchr(begin, '\n', h->file->n_bytes - h->offset);
    if (!end || end - begin >= MAX_LINE)
        return false;
    size_t n = (size_t)(end - begin);
    h->offset += n + 1;
    h->line++;
    if (n && begin[n - 1] == '\r')
        n--;
    memcpy(line, begin, n);
    line[n] = 0;
    return true;
}

// n positive numbers after the '=' of a header line, multiplied into factors.
static int multiply(const struct hdr *h, const char *line, double *factors, int n)
{
    const char *s = strchr(line, '=') + 1;
    for (int i = 0; i < n; i++) {
        char *end;
        const double value = strtod_l(s, &end, h->c_locale);
        if (end == s || !isfinite(value) || value <= 0) {
            log_error("image: %s:%d: found \"%s\", expected %d positive number%s", h->file->name,
                      h->line, line, n, n > 1 ? "s" : "");
            return -EINVAL;
        }
        factors[i] *= value;
        s = end;
    }
    return 0;
}

static int read_header(struct hdr *h)
{
    char line[MAX_LINE];
    double exposure = 1;
    int err = 0;
    for (;;) {
        if (!next_line(h, line)) {
            log_error("image: %s:%d: the Radiance header does not end: expected lines below %d "
                      "bytes, then an empty one",
                      h->file->name, h->line + 1, MAX_LINE);
            return -EINVAL;
        }
        if (!line[0])
            break;
        if (!strncmp(line, "FORMAT=", 7) && strcmp(line + 7, "32-bit_rle_rgbe")) {
            log_error("image: %s:%d: found %s, expected FORMAT=32-bit_rle_rgbe; convert the "
                      "picture to RGB "
                      "(Radiance: ra_xyze -r)",
                      h->file->name, h->line, line);
            return -ENOTSUP;
        }
        if (!strncmp(line, "EXPOSURE=", 9))
            err = multiply(h, line, &exposure, 1);
        else if (!strncmp(line, "COLORCORR=", 10))
            err = multiply(h, line, h->divide_by, 3);
        if (err)
            return err;
    }
    for (int c = 0; c < 3; c++)
        h->divide_by[c] *= exposure;
    return 0;
}

static int read_resolution(struct hdr *h)
{
    char line[MAX_LINE], axis[2];
    int size[2], used = 0;
    if (!next_line(h, line)) {
        log_error(
            "image: %s:%d: the file ends before the line with its size (\"-Y height +X width\")",
            h->file->name, h->line + 1);
        return -EINVAL;
    }
    char sign[2];
    const int n = sscanf(line, "%c%c %9d %c%c %9d%n", &sign[0], &axis[0], &size[0], &sign[1],
                         &axis[1], &size[1], &used);
    const bool is_size = n == 6 && line[used] == 0 && (sign[0] == '-' || sign[0] == '+') &&
                         (sign[1] == '-' || sign[1] == '+') &&
                         ((axis[0] == 'Y' && axis[1] == 'X') || (axis[0] == 'X' && axis[1] == 'Y'));
    if (!is_size) {
        log_error("image: %s:%d: found \"%s\", expected \"-Y height +X width\"", h->file->name,
                  h->line, line);
        return -EINVAL;
    }
    if (sign[0] != '-' || axis[0] != 'Y' || sign[1] != '+') {
        log_error("image: %s:%d: orientation \"%c%c %c%c\" is not read, expected \"-Y +X\" (top "
                  "row first); turn the "
                  "picture upright and save it again",
                  h->file->name, h->line, sign[0], axis[0], sign[1], axis[1]);
        return -ENOTSUP;
    }
    h->height = size[0], h->width = size[1];
    return image_check_size(h->file, h->width, h->height, 3, 4);
}

// One row, each of the four components run-length coded by itself.
static int read_rle_row(struct hdr *h, int row, uint8_t (*rgbe)[4])
{
    const uint8_t *bytes = h->file->bytes;
    const size_t end = h->file->n_bytes;
    h->offset += 4;
    for (int c = 0; c < 4; c++)
        for (int x = 0; x < h->width;) {
            if (end - h->offset < 2)
                return broken(h, row, "the file ends");
            int n = bytes[h->offset++];
            const bool run = n > 128;
            n = run ? n - 128 : n;
            if (n == 0 || n > h->width - x)
                return broken(h, row, "a run leaves its row");
            if (end - h->offset < (run ? 1 : (size_t)n))
                return broken(h, row, "the file ends");
            for (int i = 0; i < n; i++)
                rgbe[x++][c] = bytes[h->offset + (run ? 0 : (size_t)i)];
            h->offset += run ? 1 : (size_t)n;
        }
    return 0;
}

// One row of plain pixels; 1 1 1 n repeats the last pixel n times, the next such group counts n *
// 256, and so on.
static int read_plain_row(struct hdr *h, int row, uint8_t (*rgbe)[4])
{
    int shift = 0;
    for (int x = 0; x < h->width;) {
        if (h->file->n_bytes - h->offset < 4)
            return broken(h, row, "the file ends");
        const uint8_t *p = h->file->bytes + h->offset;
        if (p[0] != 1 || p[1] != 1 || p[2] != 1) {
            memcpy(rgbe[x++], p, 4);
            shift = 0;
        } else {
            const int64_t n = shift <= 16 ? (int64_t)p[3] << shift : INT64_MAX;
            if (x == 0 || n > h->width - x)
                return broken(h, row,
                              x ? "a repeat leaves its row" : "a repeat without a pixel before it");
            for (int64_t i = 0; i < n; i++, x++)
                memcpy(rgbe[x], rgbe[x - 1], 4);
            shift += 8;
        }
        h->offset += 4;
    }
    return 0;
}

static int read_row(struct hdr *h, int row, uint8_t (*rgbe)[4])
{
    const uint8_t *p = h->file->bytes + h->offset;
    const bool may_be_rle = h->width >= MIN_RLE_WIDTH && h->width <= MAX_RLE_WIDTH;
    if (!may_be_rle || h->file->n_bytes - h->offset < 4 || p[0] != 2 || p[1] != 2 || p[2] & 0x80)
        return read_plain_row(h, row, rgbe);
    if ((p[2] << 8 | p[3]) != h->width)
        return broken(h, row, "a row of another width than the header says");
    return read_rle_row(h, row, rgbe);
}

int image_read_hdr(struct image *out, const struct image_file *file)
{
    struct hdr h = { .file = file, .divide_by = { 1, 1, 1 } };
    struct image image = { 0 };
    uint8_t(*rgbe)[4] = NULL;
    int err = -ENOMEM;
    *out = image;
    h.c_locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    if (!h.c_locale)
        goto fail;
    err = read_header(&h);
    if (!err)
        err = read_resolution(&h);
    if (!err)
        err = image_new_for(&image, file, h.width, h.height, 3, NULL);
    if (err)
        goto fail;
    rgbe = malloc((size_t)h.width * sizeof(*rgbe));
    if (!rgbe) {
        err = -ENOMEM;
        goto fail;
    }
    for (int y = 0; y < h.height; y++) {
        err = read_row(&h, y, rgbe);
        if (err)
            goto fail;
        float *to = image.data + (size_t)y * (size_t)h.width * 3;
        for (int x = 0; x < h.width; x++)
            for (int c = 0; c < 3; c++) {
                const double value = rgbe[x][3] ? ldexp(rgbe[x][c] + .5, rgbe[x][3] - 136) : 0;
                to[3 * x + c] = (float)(value / h.divide_by[c]);
            }
    }
    free(rgbe);
    freelocale(h.c_locale);
    *out = image;
    return 0;
fail:
    if (err == -ENOMEM)
        log_error("image: %s: out of memory", file->name);
    free(rgbe);
    if (h.c_locale)
        freelocale(h.c_locale);
    image_free(&image);
    return err;
}
