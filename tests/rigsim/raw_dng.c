// tests/rigsim/raw_dng.c - see raw_dng.h. The one file here that knows libtiff.
//
// libtiff writes to a "file" in memory that drops the strips and keeps everything before and after them.
#include "tests/rigsim/raw_dng.h"

#include "solver/take/log.h"

#include <tiffio.h>

#include <errno.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { ROWS_PER_STRIP = 64, ILLUMINANT_D65 = 21, CFA = 32803 };

// XYZ (D65) to linear sRGB.
static const double rgb_from_xyz[9] = { 3.2404542, -1.5371385, -0.4985314, -0.9692660, 1.8760108,
                                        0.0415560, 0.0556434,  -0.2040259, 1.0572252 };

struct part {
    uint8_t *data;
    size_t n, capacity;
};

struct memory_file {
    struct part head, tail;
    uint64_t at, pixels_at, n_pixels; // n_pixels 0: none yet
    int in_strips, failed;
};

static int put(struct part *p, uint64_t at, const void *bytes, size_t n)
{
    if (at + n > p->capacity) {
        const size_t capacity = (size_t)(at + n) * 2;
        uint8_t *data = realloc(p->data, capacity);
        if (!data)
            return -ENOMEM;
        memset(data + p->capacity, 0, capacity - p->capacity);
        p->data = data;
        p->capacity = capacity;
    }
    memcpy(p->data + at, bytes, n);
    if (at + n > p->n)
        p->n = (size_t)(at + n);
    return 0;
}

static tmsize_t file_write(thandle_t handle, void *bytes, tmsize_t n)
{
    struct memory_file *f = handle;
    const uint64_t end_of_pixels = f->pixels_at + f->n_pixels;
    if (f->in_strips) {
        if (!f->n_pixels)
            f->pixels_at = f->at;
        f->n_pixels += (uint64_t)n;
    } else if (f->n_pixels && f->at >= end_of_pixels) {
        f->failed |= put(&f->tail, f->at - end_of_pixels, bytes, (size_t)n) != 0;
    } else if (!f->n_pixels || f->at + (uint64_t)n <= f->pixels_at) {
        f->failed |= put(&f->head, f->at, bytes, (size_t)n) != 0;
    } else {
        f->failed = 1;
    }
    f->at += (uint64_t)n;
    return f->failed ? 0 : n;
}

static uint64_t file_size(thandle_t handle)
{
    const struct memory_file *f = handle;
    return f->n_pixels ? f->pixels_at + f->n_pixels + f->tail.n : f->head.n;
}

static tmsize_t file_read(thandle_t handle, void *bytes, tmsize_t n)
{
    struct memory_file *f = handle;
    if (f->at + (uint64_t)n > f->head.n)
        return 0;
    memcpy(bytes, f->head.data + f->at, (size_t)n);
    f->at += (uint64_t)n;
    return n;
}

static uint64_t file_seek(thandle_t handle, uint64_t offset, int whence)
{
    struct memory_file *f = handle;
    f->at = offset + (whence == SEEK_CUR ? f->at : whence == SEEK_END ? file_size(handle) : 0);
    return f->at;
}

static int file_close(thandle_t handle)
{
    (void)handle;
    return 0;
}

static int write_exif(TIFF *t, const struct raw_dng_info *i, const char *date, const char *subsec, uint64_t *at)
{
    const uint16_t iso = (uint16_t)(i->iso < 65535 ? i->iso : 65535);
    int ok = TIFFCreateEXIFDirectory(t) == 0;
    ok = ok && TIFFSetField(t, EXIFTAG_EXPOSURETIME, i->time_s);
    ok = ok && TIFFSetField(t, EXIFTAG_FNUMBER, i->f_number);
    ok = ok && TIFFSetField(t, EXIFTAG_EXPOSUREPROGRAM, 1); // manual
    ok = ok && TIFFSetField(t, EXIFTAG_ISOSPEEDRATINGS, 1, &iso);
    ok = ok && TIFFSetField(t, EXIFTAG_EXIFVERSION, "0231");
    ok = ok && TIFFSetField(t, EXIFTAG_DATETIMEORIGINAL, date);
    ok = ok && TIFFSetField(t, EXIFTAG_SUBSECTIMEORIGINAL, subsec);
    ok = ok && TIFFSetField(t, EXIFTAG_FOCALLENGTH, i->focal_mm);
    ok = ok && TIFFSetField(t, EXIFTAG_BODYSERIALNUMBER, i->serial);
    ok = ok && TIFFSetField(t, EXIFTAG_LENSMODEL, i->lens);
    return ok && TIFFWriteCustomDirectory(t, at);
}

static int write_main(TIFF *t, const struct raw_dng_info *i, const char *date, uint64_t exif_at)
{
    static const uint16_t two_by_two[2] = { 2, 2 };
    static const uint8_t rggb[4] = { 0, 1, 1, 2 }, none[4] = { 0 }, version[4] = { 1, 4, 0, 0 }, backward[4] = { 1, 1, 0, 0 };
    const uint8_t *cfa = memcmp(i->cfa, none, 4) ? i->cfa : rggb;
    const float black[4] = { (float)(i->black_level + i->black_more[0]), (float)(i->black_level + i->black_more[1]),
                             (float)(i->black_level + i->black_more[2]), (float)(i->black_level + i->black_more[3]) };
    const float neutral[3] = { (float)i->wb[0], (float)i->wb[1], (float)i->wb[2] };
    const uint32_t white = (uint32_t)i->white_level;
    float matrix[9];
    for (int k = 0; k < 9; k++)
        matrix[k] = (float)(rgb_from_xyz[k] * i->wb[k / 3]);
    int ok = TIFFSetField(t, TIFFTAG_SUBFILETYPE, 0);
    ok = ok && TIFFSetField(t, TIFFTAG_IMAGEWIDTH, i->width_px) && TIFFSetField(t, TIFFTAG_IMAGELENGTH, i->height_px);
    ok = ok && TIFFSetField(t, TIFFTAG_BITSPERSAMPLE, 16) && TIFFSetField(t, TIFFTAG_SAMPLESPERPIXEL, 1);
    ok = ok && TIFFSetField(t, TIFFTAG_COMPRESSION, COMPRESSION_NONE) && TIFFSetField(t, TIFFTAG_PHOTOMETRIC, CFA);
    ok = ok && TIFFSetField(t, TIFFTAG_PLANARCONFIG, PLANARCONFIG_CONTIG);
    ok = ok && TIFFSetField(t, TIFFTAG_ORIENTATION, i->orientation ? i->orientation : ORIENTATION_TOPLEFT);
    ok = ok && TIFFSetField(t, TIFFTAG_ROWSPERSTRIP, ROWS_PER_STRIP);
    ok = ok && TIFFSetField(t, TIFFTAG_MAKE, i->make) && TIFFSetField(t, TIFFTAG_MODEL, i->model);
    ok = ok && TIFFSetField(t, TIFFTAG_SOFTWARE, i->firmware) && TIFFSetField(t, TIFFTAG_DATETIME, date);
    ok = ok && TIFFSetField(t, TIFFTAG_CFAREPEATPATTERNDIM, two_by_two) && TIFFSetField(t, TIFFTAG_CFAPATTERN, 4, cfa);
    ok = ok && TIFFSetField(t, TIFFTAG_DNGVERSION, version) && TIFFSetField(t, TIFFTAG_DNGBACKWARDVERSION, backward);
    ok = ok && TIFFSetField(t, TIFFTAG_UNIQUECAMERAMODEL, i->model);
    ok = ok && TIFFSetField(t, TIFFTAG_CAMERASERIALNUMBER, i->serial);
    const bool one_black = !i->black_more[0] && !i->black_more[1] && !i->black_more[2] && !i->black_more[3];
    ok = ok && (one_black || TIFFSetField(t, TIFFTAG_BLACKLEVELREPEATDIM, two_by_two));
    ok = ok && TIFFSetField(t, TIFFTAG_BLACKLEVEL, one_black ? 1 : 4, black) && TIFFSetField(t, TIFFTAG_WHITELEVEL, 1, &white);
    ok = ok && TIFFSetField(t, TIFFTAG_COLORMATRIX1, 9, matrix);
    ok = ok && TIFFSetField(t, TIFFTAG_CALIBRATIONILLUMINANT1, ILLUMINANT_D65);
    ok = ok && TIFFSetField(t, TIFFTAG_ASSHOTNEUTRAL, 3, neutral);
    return ok && TIFFSetField(t, TIFFTAG_EXIFIFD, exif_at);
}

int raw_dng_make(struct raw_dng *out, const struct raw_dng_info *i)
{
    *out = (struct raw_dng){ 0 };
    if (i->width_px < 16 || i->width_px > 20000 || i->height_px < 16 || i->height_px > 20000)
        return -EINVAL;
    const size_t row_bytes = (size_t)i->width_px * 2;
    struct memory_file f = { 0 };
    char date[32], subsec[8];
    const time_t seconds = (time_t)(i->utc_ns / 1000000000);
    struct tm tm;
    gmtime_r(&seconds, &tm);
    strftime(date, sizeof(date), "%Y:%m:%d %H:%M:%S", &tm);
    snprintf(subsec, sizeof(subsec), "%06d", (int)(i->utc_ns % 1000000000 / 1000));
    void *strip = calloc(ROWS_PER_STRIP, row_bytes);
    TIFF *t = strip ? TIFFClientOpen("simulated raw", "wl", &f, file_read, file_write, file_seek, file_close, file_size, NULL, NULL)
                    : NULL;
    uint64_t exif_at = 0;
    int ok = t && write_exif(t, i, date, subsec, &exif_at);
    if (ok) { // libtiff drops the EXIF directory's texts unless they are freed here
        TIFFFreeDirectory(t);
        TIFFCreateDirectory(t);
    }
    ok = ok && write_main(t, i, date, exif_at);
    for (int y = 0, s = 0; ok && y < i->height_px; y += ROWS_PER_STRIP, s++) {
        const int rows = i->height_px - y < ROWS_PER_STRIP ? i->height_px - y : ROWS_PER_STRIP;
        f.in_strips = 1;
        ok = TIFFWriteRawStrip(t, (uint32_t)s, strip, (tmsize_t)(row_bytes * (size_t)rows)) > 0;
        f.in_strips = 0;
    }
    ok = ok && TIFFWriteDirectory(t);
    if (t)
        TIFFClose(t);
    free(strip);
    if (!ok || f.failed || f.n_pixels != row_bytes * (size_t)i->height_px) {
        log_error("rigsim: cannot lay out a raw of %d x %d: out of memory", i->width_px, i->height_px);
        free(f.head.data);
        free(f.tail.data);
        return -ENOMEM;
    }
    *out = (struct raw_dng){ f.head.data, f.tail.data, f.head.n, f.tail.n, f.n_pixels };
    return 0;
}

void raw_dng_free(struct raw_dng *d)
{
    free(d->head);
    free(d->tail);
    *d = (struct raw_dng){ 0 };
}
