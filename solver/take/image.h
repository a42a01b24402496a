// solver/take/image.h - linear images: float pixels in memory; EXR, Radiance HDR, 16-bit TIFF and PNG on disk.
//
// Pixels are row-major, top row first, channels interleaved: data[(y * width + x) * n_channels + c].
// Values are linear light unless a function says otherwise. Names are EXR channel names without layer rules of ours:
// "R", "G", "B", "A", "clip", "roughness", ...
// Limits: 65,536 px a side, 2^28 pixels, 64 channels, 8 GiB of file, and no more samples, counted as the file stores them, than
// 1,200 x its size (ZIP's best ratio) plus 64 MiB (a cropped picture has a small file and a large display window): a small
// hostile file cannot ask for gigabytes.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { IMAGE_NAME_MAX = 64, IMAGE_MAX_CHANNELS = 64 };

struct image {
    int width, height, n_channels;
    char (*names)[IMAGE_NAME_MAX]; // [n_channels]
    float *data;                   // [height][width][n_channels]
};

// Zeroed pixels. names: n_channels strings, NULL for R, G, B(, A) or Y. 0, -ENOMEM, -EINVAL.
int image_new(struct image *out, int width, int height, int n_channels, const char *const *names);
void image_free(struct image *image); // NULL and zeroed allowed; leaves it zeroed

// Read by content, not by name: OpenEXR (single part, scanline or tiled, mip level 0, half/float/uint; the data window is
// placed in the display window, outside it is 0), Radiance .hdr (new and old RLE, flat), TIFF (8/16-bit integer -> value /
// 65535 or / 255, 32-bit float; 1, 3 or 4 samples, strips or tiles, linear), PNG (8/16-bit integer -> value / max, no
// curve: for masks). R, G, B, A come first in that order when present, the others in file order.
// Errors, logged with file, place, found, expected, remedy: -errno of the open, -EINVAL (broken or truncated), -ENOTSUP
// (DWAA/DWAB, B44, deep, multi-part ...: "re-save as ZIP"), -EFBIG (over the limits), -ENOMEM.
int image_read(struct image *out, const char *path);

// The same and JPEG, for what is painted on a surface: with is_colour, 8-bit formats' sRGB curve is undone (alpha too).
int image_read_texture(struct image *out, const char *path, bool is_colour);

int image_channel(const struct image *image, const char *name); // index, or -1

// -EDOM, logged with the first bad pixel and their count, if any value of the named channels (a list that ends with NULL; names that
// are not there are passed over; NULL itself: all channels) is NaN or infinite.
int image_require_finite(const struct image *image, const char *const *names, const char *path);

enum image_type { IMAGE_HALF, IMAGE_FLOAT };
enum image_compression { IMAGE_ZIP, IMAGE_PIZ, IMAGE_STORED };
// Atomic, and the same pixels always give the same bytes. Half rounds to nearest even and saturates at +-65504 (never makes
// infinities). 0 or -errno (logged): -EDOM for a NaN, -EINVAL for two channels of one name.
int image_write_exr(const struct image *image, const char *path, enum image_type type,
                    enum image_compression compression);
// The same with notes in its header, below.
struct image_note;
int image_write_exr_noted(const struct image *image, const struct image_note *notes, int n_notes, const char *path, enum image_type type,
                          enum image_compression compression);
// The same from rows that are made one after the other, from the top: pictures larger than memory should hold twice. row fills
// [width][n_channels] and returns 0 or -errno (which it has logged); notes become attributes of the header.
struct image_rows {
    int width, height, n_channels;
    const char *const *names; // [n_channels]
    int (*row)(void *arg, int y, float *row);
    void *arg;
};
struct image_note {
    const char *name, *text; // text NULL: number, kept as float
    double number;
};
int image_write_exr_rows(const struct image_rows *rows, const struct image_note *notes, int n_notes, const char *path,
                         enum image_type type, enum image_compression compression);
// 16-bit RGB TIFF, uncompressed, from rows made in the same way (row fills [width][3]), with the usual EXIF; NULL, "" and 0 are left
// out. Atomic. 0 or -errno (logged).
struct image_exif {
    const char *make, *model, *serial, *lens, *description;
    const char *date, *subseconds; // "2026:11:22 12:34:56", "123"
    double time_s, f_number, focal_mm, iso;
};
int image_write_tiff16(const char *path, int width, int height, const struct image_exif *exif,
                       int (*row)(void *arg, int y, uint16_t *rgb), void *arg);
// The text of a note of a scanline EXR whose last lines are there. 0, -errno of the open, -EINVAL (no EXR, or cut short), -ENODATA (no
// such note, or a number), -EFBIG (room is the size of text). Not logged.
#define IMAGE_SPREAD_NOTE "studiorig.spread_px" // of a developed or rendered picture: how many pixels around a pixel its value was made of, "0" to "16"
int image_read_note(const char *path, const char *name, char *text, size_t room);
// 8-bit PNG, n_channels 1 (grey), 3 or 4; pixels as they are (already encoded). Atomic. 0 or -errno (logged).
int image_write_png(const char *path, int width, int height, int n_channels, const uint8_t *pixels);
// The same as bytes in memory, malloc'd, for files that hold pictures. 0, -EINVAL, -ENOMEM (logged).
int image_encode_png(uint8_t **bytes, size_t *n_bytes, int width, int height, int n_channels, const uint8_t *pixels);
uint8_t image_srgb_byte(double linear); // the sRGB curve, rounded to 8 bits; NaN is 0
// Tone-mapped PNG of the first three (or the only) channel: value * 2^exposure_ev, clipped, sRGB curve.
int image_write_png_srgb(const struct image *image, const char *path, double exposure_ev);

// Bilinear sample of one channel set: out[n_channels] at continuous (x_px, y_px), first pixel centre at (.5, .5), clamped at
// the borders.
void image_bilinear(const struct image *image, double x_px, double y_px, float *out);
