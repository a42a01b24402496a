// solver/picture_size.c - sizes from headers.
//
// Some camera files (RealityCapture, Bundler) do not say how large the pictures are. Decoding a hundred of them to find out would
// take minutes; a header takes none. JPEG is here because sidecars lie beside them, though their pixels are of no use.
#include "solver/picture_size.h"

#include <errno.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_SIDE_PX = 65536, MAX_STEPS = 4096 }; // header entries looked at: no file makes us run on

// n bytes at offset.
static bool bytes_at(FILE *f, int64_t offset, uint8_t *out, size_t n)
{
    return offset >= 0 && !fseeko(f, offset, SEEK_SET) && fread(out, 1, n, f) == n;
}

static uint64_t number(const uint8_t *b, int n, bool big_endian)
{
    uint64_t value = 0;
    for (int i = 0; i < n; i++)
        value = value << 8 | b[big_endian ? i : n - 1 - i];
    return value;
}

static int checked(int *width_px, int *height_px, uint64_t width, uint64_t height)
{
    if (width < 1 || width > MAX_SIDE_PX || height < 1 || height > MAX_SIDE_PX)
        return -EINVAL;
    *width_px = (int)width, *height_px = (int)height;
    return 0;
}

static int size_of_png(int *width_px, int *height_px, FILE *f)
{
    uint8_t b[16];
    if (!bytes_at(f, 8, b, sizeof(b)) || memcmp(b + 4, "IHDR", 4))
        return -EINVAL;
    return checked(width_px, height_px, number(b + 8, 4, true), number(b + 12, 4, true));
}

static int size_of_jpeg(int *width_px, int *height_px, FILE *f)
{
    int64_t at = 2;
    for (int i = 0; i < MAX_STEPS; i++) {
        uint8_t b[9];
        if (!bytes_at(f, at, b, 4) || b[0] != 0xff)
            return -EINVAL;
        if (b[1] == 0xff) { // a fill byte
            at++;
            continue;
        }
        const bool is_frame = b[1] >= 0xc0 && b[1] <= 0xcf && b[1] != 0xc4 && b[1] != 0xc8 && b[1] != 0xcc;
        if (is_frame)
            return bytes_at(f, at, b, 9) ? checked(width_px, height_px, number(b + 7, 2, true), number(b + 5, 2, true))
                                         : -EINVAL;
        at += 2 + (int64_t)number(b + 2, 2, true);
    }
    return -EINVAL;
}

static int size_of_tiff(int *width_px, int *height_px, FILE *f)
{
    uint8_t b[20];
    uint64_t size[2] = { 0, 0 };
    if (!bytes_at(f, 0, b, 16))
        return -EINVAL;
    const bool big_endian = b[0] == 'M', is_big = number(b + 2, 2, big_endian) == 43;
    const int n_offset = is_big ? 8 : 4, n_count = is_big ? 8 : 2, n_entry = is_big ? 20 : 12;
    const uint64_t ifd = number(b + (is_big ? 8 : 4), n_offset, big_endian);
    if (ifd > INT64_MAX / 2 || !bytes_at(f, (int64_t)ifd, b, (size_t)n_count))
        return -EINVAL;
    const uint64_t n = number(b, n_count, big_endian);
    for (uint64_t i = 0; i < n && i < MAX_STEPS; i++) {
        if (!bytes_at(f, (int64_t)(ifd + (uint64_t)n_count + i * (uint64_t)n_entry), b, (size_t)n_entry))
            return -EINVAL;
        const uint64_t tag = number(b, 2, big_endian), type = number(b + 2, 2, big_endian);
        if ((tag == 256 || tag == 257) && (type == 3 || type == 4))
            size[tag - 256] = number(b + 4 + n_offset, type == 3 ? 2 : 4, big_endian);
    }
    return checked(width_px, height_px, size[0], size[1]);
}

// A string of at most n - 1 bytes up to its NUL.
static bool read_string(FILE *f, char *out, size_t n)
{
    for (size_t i = 0; i < n; i++) {
        const int c = getc(f);
        if (c == EOF)
            return false;
        out[i] = (char)c;
        if (c == 0)
            return true;
    }
    return false;
}

static int size_of_exr(int *width_px, int *height_px, FILE *f)
{
    if (fseeko(f, 8, SEEK_SET))
        return -EINVAL;
    for (int i = 0; i < MAX_STEPS; i++) {
        char name[256], type[256];
        uint8_t b[16];
        if (!read_string(f, name, sizeof(name)) || !name[0] || !read_string(f, type, sizeof(type)) || fread(b, 1, 4, f) != 4)
            return -EINVAL;
        const uint64_t n = number(b, 4, false);
        if (strcmp(name, "displayWindow") || strcmp(type, "box2i") || n != 16) {
            if (n > INT32_MAX || fseeko(f, (off_t)n, SEEK_CUR))
                return -EINVAL;
            continue;
        }
        if (fread(b, 1, 16, f) != 16)
            return -EINVAL;
        int64_t box[4];
        for (int k = 0; k < 4; k++)
            box[k] = (int32_t)(uint32_t)number(b + 4 * k, 4, false);
        return checked(width_px, height_px, (uint64_t)(box[2] - box[0] + 1), (uint64_t)(box[3] - box[1] + 1));
    }
    return -EINVAL;
}

static int size_of_hdr(int *width_px, int *height_px, FILE *f)
{
    char line[512];
    rewind(f);
    for (int i = 0; i < MAX_STEPS && fgets(line, sizeof(line), f); i++) {
        unsigned height, width;
        char y_sign, x_sign;
        if (sscanf(line, "%cY %5u %cX %5u", &y_sign, &height, &x_sign, &width) == 4)
            return checked(width_px, height_px, width, height);
    }
    return -EINVAL;
}

int picture_size_stream(int *width_px, int *height_px, FILE *f)
{
    static const struct {
        const char *magic;
        size_t n;
        int (*size)(int *width_px, int *height_px, FILE *f);
    } formats[] = {
        { "\x76\x2f\x31\x01", 4, size_of_exr }, { "#?", 2, size_of_hdr },       { "\x89PNG\r\n\x1a\n", 8, size_of_png },
        { "II*\0", 4, size_of_tiff },           { "MM\0*", 4, size_of_tiff },   { "II+\0", 4, size_of_tiff },
        { "MM\0+", 4, size_of_tiff },           { "\xff\xd8\xff", 3, size_of_jpeg },
    };
    uint8_t head[8];
    *width_px = *height_px = 0;
    if (!bytes_at(f, 0, head, sizeof(head)))
        return -EINVAL;
    for (size_t i = 0; i < sizeof(formats) / sizeof(formats[0]); i++)
        if (!memcmp(head, formats[i].magic, formats[i].n))
            return formats[i].size(width_px, height_px, f);
    return -EINVAL;
}

int picture_size(int *width_px, int *height_px, const char *path)
{
    FILE *f = fopen(path, "rbe");
    *width_px = *height_px = 0;
    if (!f)
        return -errno;
    const int err = picture_size_stream(width_px, height_px, f);
    fclose(f);
    return err;
}
