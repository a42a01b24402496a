// solver/take/image_tiff.c - TIFF in: linear 8/16-bit and float pictures from raw developers; out: 16-bit with EXIF
// (libtiff appears only here).
#include "solver/take/atomic_file.h"
#include "solver/take/image_formats.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <tiffio.h>
#include <unistd.h>

enum { MAX_TILE_SIDE_PX = 65536 };

struct tiff {
    const struct image_file *file;
    uint64_t offset;
    char message[200]; // libtiff's first complaint
    TIFF *handle;
    uint32_t width, height;
    uint16_t n_samples, bits, format;
    bool separate; // one plane per sample
};

// ---- a file in memory -----------------------------------------------------------------------

static tmsize_t read_bytes(thandle_t user, void *buffer, tmsize_t n)
{
    struct tiff *t = user;
    const uint64_t left = t->offset < t->file->n_bytes ? t->file->n_bytes - t->offset : 0;
    const uint64_t got = (uint64_t)n < left ? (uint64_t)n : left;
    if (got)
        memcpy(buffer, t->file->bytes + t->offset, got);
    t->offset += got;
    return (tmsize_t)got;
}

static tmsize_t write_nothing(thandle_t user, void *buffer, tmsize_t n)
{
    (void)user, (void)buffer, (void)n;
    return -1;
}

static toff_t seek(thandle_t user, toff_t offset, int whence)
{
    struct tiff *t = user;
    t->offset = offset + (whence == SEEK_CUR   ? t->offset
                          : whence == SEEK_END ? t->file->n_bytes
                                               : 0);
    return t->offset;
}

static int close_nothing(thandle_t user)
{
    (void)user;
    return 0;
}

static toff_t count_bytes(thandle_t user)
{
    return ((struct tiff *)user)->file->n_bytes;
}

static int map_nothing(thandle_t user, void **base, toff_t *size)
{
    (void)user, (void)base, (void)size;
    return 0;
}

static void unmap_nothing(thandle_t user, void *base, toff_t size)
{
    (void)user, (void)base, (void)size;
}

static int keep_error(TIFF *handle, void *user, const char *module, const char *format,
                      va_list args)
{
    struct tiff *t = user;
    (void)handle, (void)module;
    if (!t->message[0])
        vsnprintf(t->message, sizeof(t->message), format, args);
    return 1;
}

static int pass_warning(TIFF *handle, void *user, const char *module, const char *format,
                        va_list args)
{
    const struct tiff *t = user;
    char message[200];
    (void)handle, (void)module;
    vsnprintf(message, sizeof(message), format, args);
    log_debug("image: %s: TIFF: %s", t->file->name, message);
    return 1;
}

static TIFF *open_memory(struct tiff *t)
{
    TIFFOpenOptions *options = TIFFOpenOptionsAlloc();
    if (!options)
        return NULL;
    TIFFOpenOptionsSetErrorHandlerExtR(options, keep_error, t);
    TIFFOpenOptionsSetWarningHandlerExtR(options, pass_warning, t);
    // No tag of a sound file is larger than the file; strips and tiles are checked by us.
    TIFFOpenOptionsSetMaxSingleMemAlloc(options,
                                        (tmsize_t)(t->file->n_bytes * 1200 + ((uint64_t)64 << 20)));
    TIFF *handle =
        TIFFClientOpenExt(t->file->name, "rm", t, read_bytes, write_nothing, seek, close_nothing,
                          count_bytes, map_nothing, unmap_nothing, options);
    TIFFOpenOptionsFree(options);
    return handle;
}

// ---- what is in it --------------------------------------------------------------------------

static int broken(const struct tiff *t, const char *what)
{
    log_error("image: %s: %s: %s: the file is broken or cut short", t->file->name, what,
              t->message[0] ? t->message : "unreadable TIFF");
    return -EINVAL;
}

static int refuse(const struct tiff *t, const char *what, int found, const char *expected)
{
    log_error("image: %s: TIFF with %s %d, expected %s; export it as 16-bit linear RGB or as EXR",
              t->file->name, what, found, expected);
    return -ENOTSUP;
}

static bool is_readable_compression(uint16_t compression)
{
    switch (compression) {
    case COMPRESSION_NONE:
    case COMPRESSION_LZW:
    case COMPRESSION_ADOBE_DEFLATE:
    case COMPRESSION_DEFLATE:
    case COMPRESSION_PACKBITS:
    case COMPRESSION_ZSTD:
    case COMPRESSION_LZMA:
        return TIFFIsCODECConfigured(compression);
    default: // JPEG and WebP lose; fax codes are not pictures
        return false;
    }
}

static int read_header(struct tiff *t)
{
    uint16_t photometric = PHOTOMETRIC_MINISBLACK, planes = PLANARCONFIG_CONTIG,
             compression = COMPRESSION_NONE;
    uint16_t orientation = ORIENTATION_TOPLEFT;
    if (!TIFFGetField(t->handle, TIFFTAG_IMAGEWIDTH, &t->width) ||
        !TIFFGetField(t->handle, TIFFTAG_IMAGELENGTH, &t->height))
        return broken(t, "width or height is missing");
    TIFFGetFieldDefaulted(t->handle, TIFFTAG_SAMPLESPERPIXEL, &t->n_samples);
    TIFFGetFieldDefaulted(t->handle, TIFFTAG_BITSPERSAMPLE, &t->bits);
    TIFFGetFieldDefaulted(t->handle, TIFFTAG_SAMPLEFORMAT, &t->format);
    TIFFGetFieldDefaulted(t->handle, TIFFTAG_PLANARCONFIG, &planes);
    TIFFGetFieldDefaulted(t->handle, TIFFTAG_COMPRESSION, &compression);
    TIFFGetFieldDefaulted(t->handle, TIFFTAG_ORIENTATION, &orientation);
    if (!TIFFGetField(t->handle, TIFFTAG_PHOTOMETRIC, &photometric))
        return broken(t, "the photometric interpretation is missing");
    t->separate = planes == PLANARCONFIG_SEPARATE;

    if (photometric != PHOTOMETRIC_MINISBLACK && photometric != PHOTOMETRIC_RGB)
        return refuse(t, "photometric interpretation", photometric,
                      "1 (grey, black is 0) or 2 (RGB)");
    if (photometric == PHOTOMETRIC_RGB ? t->n_samples != 3 && t->n_samples != 4 : t->n_samples != 1)
        return refuse(t, "samples per pixel", t->n_samples, "1 (grey), 3 (RGB) or 4 (RGBA)");
    const bool integer = t->format == SAMPLEFORMAT_UINT && (t->bits == 8 || t->bits == 16);
    const bool real = t->format == SAMPLEFORMAT_IEEEFP && t->bits == 32;
    if (!integer && !real)
        return refuse(
            t, t->format == SAMPLEFORMAT_IEEEFP ? "float bits per sample" : "bits per sample",
            t->bits, "8 or 16 (unsigned integer) or 32 (float)");
    if (!is_readable_compression(compression))
        return refuse(t, "compression", compression,
                      "none, LZW, deflate, PackBits, Zstandard or LZMA");
    if (orientation != ORIENTATION_TOPLEFT)
        log_warning(
            "image: %s: orientation tag %d is ignored: pixels are taken as they lie in the file",
            t->file->name, orientation);
    return image_check_size(t->file, t->width, t->height, t->n_samples, t->n_samples * t->bits / 8);
}

// n samples to floats. to: first sample's place, stride floats apart.
static void convert(const struct tiff *t, const uint8_t *from, float *to, size_t n, size_t stride)
{
    for (size_t i = 0; i < n; i++) {
        if (t->bits == 8) {
            to[i * stride] = (float)from[i] / 255;
        } else if (t->bits == 16) {
            uint16_t value;
            memcpy(&value, from + 2 * i, 2); // libtiff has put it in the machine's byte order
            to[i * stride] = (float)value / 65535;
        } else {
            memcpy(&to[i * stride], from + 4 * i, 4);
        }
    }
}

static int read_strips(const struct tiff *t, struct image *image)
{
    char place[64];
    const size_t n_samples = t->n_samples, n_planes = t->separate ? n_samples : 1;
    const size_t n_row = (size_t)t->width * (t->separate ? 1 : n_samples),
                 row_bytes = n_row * t->bits / 8;
    if (TIFFScanlineSize64(t->handle) != row_bytes)
        return broken(t, "rows of another size than the header says");
    uint8_t *row = calloc(1, row_bytes);
    if (!row) {
        log_error("image: %s: out of memory", t->file->name);
        return -ENOMEM;
    }
    for (size_t plane = 0; plane < n_planes; plane++)
        for (uint32_t y = 0; y < t->height; y++) {
            if (TIFFReadScanline(t->handle, row, y, (uint16_t)plane) != 1) {
                free(row);
                snprintf(place, sizeof(place), "row %u", y);
                return broken(t, place);
            }
            float *to = image->data + (size_t)y * t->width * n_samples + plane;
            convert(t, row, to, n_row, t->separate ? n_samples : 1);
        }
    free(row);
    return 0;
}

static int read_tiles(const struct tiff *t, struct image *image)
{
    char place[64];
    uint32_t tile_width = 0, tile_height = 0;
    const size_t n_samples = t->n_samples, n_planes = t->separate ? n_samples : 1;
    const size_t n_in_tile = t->separate ? 1 : n_samples, sample_bytes = t->bits / 8;
    TIFFGetField(t->handle, TIFFTAG_TILEWIDTH, &tile_width);
    TIFFGetField(t->handle, TIFFTAG_TILELENGTH, &tile_height);
    if (tile_width < 1 || tile_height < 1 || tile_width > MAX_TILE_SIDE_PX ||
        tile_height > MAX_TILE_SIDE_PX)
        return broken(t, "tile size out of range");
    int err = image_check_size(t->file, tile_width, tile_height, t->n_samples,
                               (int)(n_in_tile * sample_bytes));
    if (err)
        return err;
    const size_t row_bytes = tile_width * n_in_tile * sample_bytes;
    if (TIFFTileSize64(t->handle) != row_bytes * tile_height)
        return broken(t, "tiles of another size than the header says");
    uint8_t *tile = calloc(tile_height, row_bytes);
    if (!tile) {
        log_error("image: %s: out of memory", t->file->name);
        return -ENOMEM;
    }
    for (size_t plane = 0; plane < n_planes; plane++)
        for (uint32_t y0 = 0; y0 < t->height; y0 += tile_height)
            for (uint32_t x0 = 0; x0 < t->width; x0 += tile_width) {
                if (TIFFReadTile(t->handle, tile, x0, y0, 0, (uint16_t)plane) < 0) {
                    free(tile);
                    snprintf(place, sizeof(place), "tile at column %u, row %u", x0, y0);
                    return broken(t, place);
                }
                const uint32_t n_columns = t->width - x0 < tile_width ? t->width - x0 : tile_width;
                const uint32_t n_rows = t->height - y0 < tile_height ? t->height - y0 : tile_height;
                for (uint32_t y = 0; y < n_rows; y++)
                    convert(t, tile + y * row_bytes,
                            image->data + ((size_t)(y0 + y) * t->width + x0) * n_samples + plane,
                            n_columns * n_in_tile, t->separate ? n_samples : 1);
            }
    free(tile);
    return 0;
}

int image_read_tiff(struct image *out, const struct image_file *file)
{
    struct tiff t = { .file = file };
    struct image image = { 0 };
    int err;
    *out = image;
    t.handle = open_memory(&t);
    if (!t.handle)
        return broken(&t, "header");
    err = read_header(&t);
    if (!err)
        err = image_new_for(&image, file, (int)t.width, (int)t.height, t.n_samples, NULL);
    if (!err)
        err = TIFFIsTiled(t.handle) ? read_tiles(&t, &image) : read_strips(&t, &image);
    TIFFClose(t.handle);
    if (err)
        image_free(&image);
    else
        *out = image;
    return err;
}

// ---- writing --------------------------------------------------------------------------------

struct tiff_out {
    int fd, err; // -errno of the first write that failed
    char message[200];
    off_t at;
};

static tmsize_t out_write(thandle_t user, void *buffer, tmsize_t n)
{
    struct tiff_out *t = user;
    for (tmsize_t done = 0; done < n;) {
        const ssize_t got = pwrite(t->fd, (const char *)buffer + done, (size_t)(n - done), t->at);
        if (got < 0 && errno == EINTR)
            continue;
        if (got <= 0) {
            t->err = got < 0 ? -errno : -EIO;
            return -1;
        }
        done += got;
        t->at += got;
    }
    return n;
}

static tmsize_t out_read(thandle_t user, void *buffer, tmsize_t n)
{
    struct tiff_out *t = user;
    const ssize_t got = pread(t->fd, buffer, (size_t)n, t->at);
    t->at += got > 0 ? got : 0;
    return got;
}

static toff_t out_size(thandle_t user)
{
    const off_t end = lseek(((struct tiff_out *)user)->fd, 0, SEEK_END);
    return end < 0 ? 0 : (toff_t)end;
}

static toff_t out_seek(thandle_t user, toff_t offset, int whence)
{
    struct tiff_out *t = user;
    t->at = (off_t)offset + (whence == SEEK_CUR ? t->at : whence == SEEK_END ? (off_t)out_size(t) : 0);
    return (toff_t)t->at;
}

static int keep_out_error(TIFF *handle, void *user, const char *module, const char *format, va_list args)
{
    struct tiff_out *t = user;
    (void)handle, (void)module;
    if (!t->message[0])
        vsnprintf(t->message, sizeof(t->message), format, args);
    return 1;
}

static int pass_out_warning(TIFF *handle, void *user, const char *module, const char *format, va_list args)
{
    (void)handle, (void)user, (void)module, (void)format, (void)args;
    return 1;
}

static bool set_text(TIFF *t, uint32_t tag, const char *text)
{
    return !text || !text[0] || TIFFSetField(t, tag, text);
}

static bool set_number(TIFF *t, uint32_t tag, double v)
{
    return !(v > 0) || TIFFSetField(t, tag, v);
}

// An EXIF directory of its own; *at is where it lies.
static bool write_exif(TIFF *t, const struct image_exif *e, uint64_t *at)
{
    const uint16_t iso = (uint16_t)(e->iso < 65535 ? e->iso + .5 : 65535);
    bool ok = TIFFCreateEXIFDirectory(t) == 0 && TIFFSetField(t, EXIFTAG_EXIFVERSION, "0231");
    ok = ok && set_number(t, EXIFTAG_EXPOSURETIME, e->time_s) && set_number(t, EXIFTAG_FNUMBER, e->f_number);
    ok = ok && (!iso || TIFFSetField(t, EXIFTAG_ISOSPEEDRATINGS, 1, &iso));
    ok = ok && set_text(t, EXIFTAG_DATETIMEORIGINAL, e->date) && set_text(t, EXIFTAG_SUBSECTIMEORIGINAL, e->subseconds);
    ok = ok && set_number(t, EXIFTAG_FOCALLENGTH, e->focal_mm) && set_text(t, EXIFTAG_BODYSERIALNUMBER, e->serial) &&
         set_text(t, EXIFTAG_LENSMODEL, e->lens) && TIFFWriteCustomDirectory(t, at);
    if (ok) { // libtiff would drop the EXIF directory's texts
        TIFFFreeDirectory(t);
        ok = TIFFCreateDirectory(t) == 0;
    }
    return ok;
}

static bool write_main(TIFF *t, int width, int height, const struct image_exif *e, uint64_t exif_at)
{
    bool ok = TIFFSetField(t, TIFFTAG_IMAGEWIDTH, width) && TIFFSetField(t, TIFFTAG_IMAGELENGTH, height);
    ok = ok && TIFFSetField(t, TIFFTAG_BITSPERSAMPLE, 16) && TIFFSetField(t, TIFFTAG_SAMPLESPERPIXEL, 3);
    ok = ok && TIFFSetField(t, TIFFTAG_COMPRESSION, COMPRESSION_NONE) && TIFFSetField(t, TIFFTAG_PHOTOMETRIC, PHOTOMETRIC_RGB);
    ok = ok && TIFFSetField(t, TIFFTAG_PLANARCONFIG, PLANARCONFIG_CONTIG) && TIFFSetField(t, TIFFTAG_ORIENTATION, ORIENTATION_TOPLEFT);
    ok = ok && TIFFSetField(t, TIFFTAG_ROWSPERSTRIP, 16) && set_text(t, TIFFTAG_MAKE, e->make) && set_text(t, TIFFTAG_MODEL, e->model);
    ok = ok && set_text(t, TIFFTAG_IMAGEDESCRIPTION, e->description) && set_text(t, TIFFTAG_DATETIME, e->date);
    return ok && TIFFSetField(t, TIFFTAG_EXIFIFD, exif_at);
}

int image_write_tiff16(const char *path, int width, int height, const struct image_exif *exif,
                       int (*row)(void *arg, int y, uint16_t *rgb), void *arg)
{
    struct atomic_file f;
    uint64_t exif_at = 0;
    int err = atomic_file_open(&f, path), row_err = 0;
    if (err)
        return err;
    struct tiff_out out = { .fd = fileno(f.stream) };
    TIFFOpenOptions *options = TIFFOpenOptionsAlloc();
    uint16_t *rgb = malloc((size_t)width * 3 * sizeof(*rgb));
    if (options) {
        TIFFOpenOptionsSetErrorHandlerExtR(options, keep_out_error, &out);
        TIFFOpenOptionsSetWarningHandlerExtR(options, pass_out_warning, &out);
    }
    TIFF *t = options && rgb ? TIFFClientOpenExt(path, "w", &out, out_read, out_write, out_seek, close_nothing, out_size, map_nothing, unmap_nothing, options)
                             : NULL;
    bool ok = t && write_exif(t, exif, &exif_at) && write_main(t, width, height, exif, exif_at);
    for (int y = 0; ok && y < height; y++) {
        row_err = row(arg, y, rgb);
        ok = !row_err && TIFFWriteScanline(t, rgb, (uint32_t)y, 0) == 1;
    }
    ok = ok && TIFFWriteDirectory(t);
    if (t)
        TIFFClose(t);
    if (options)
        TIFFOpenOptionsFree(options);
    free(rgb);
    if (ok && !out.err)
        return atomic_file_commit(&f);
    err = row_err ? row_err : out.err ? out.err : rgb && options ? -EINVAL : -ENOMEM;
    if (!row_err)
        log_error("image: cannot write %s: %s", path, out.err ? strerror(-out.err) : out.message[0] ? out.message : "out of memory");
    atomic_file_abandon(&f);
    return err;
}
