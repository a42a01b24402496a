// rigd/develop.h - raw files through LibRaw.
//
// Raws come from cameras and cards, and the decoders of a hundred formats are large: what is here runs in processes of its own
// (build/bin/rigd-unpack, rigd-develop), which may die of a file without harm. One thread; LibRaw is told so.
//
// Errors of all: -ENOENT and other -errno of the open; -ENOTSUP: not a raw that LibRaw knows, or not a Bayer one (X-Trans, Foveon, already
// interpolated, float); -EBADMSG: damaged or cut short; -ENOMEM; -EFBIG: over 65,000 px a side. why (its size is room) then says what was
// found. Nothing is logged.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Can every photosite be unpacked?
int develop_check(const char *path, char *why, size_t room);

// The unit of radiance, of frames and panoramas alike: 1 brings the green photosites of a body with gains of 1 to the white level at 1/128 s,
// f/8, ISO 100.
#define DEVELOP_TIME_S (1. / 128)
#define DEVELOP_F_NUMBER 8.
#define DEVELOP_ISO 100.

enum { RAW_RED, RAW_GREEN, RAW_BLUE };

// One frame as the sensor gave it. Site (x, y) has filter cfa[y & 1][x & 1] and black level black[y & 1][x & 1]; everything that is
// indexed [2][2] is so. DN - black is linear in light; no white balance, curve or gain was applied.
struct raw_frame {
    int width, height; // the lit area, as it lies on the sensor (not turned by orientation)
    uint16_t *site;    // [height][width] DN
    bool is_resting;   // site lies in a file: see raw_rest()
    uint8_t cfa[2][2]; // RAW_*
    double black[2][2];
    double white;      // DN that developing maps to 1
    double saturation; // from this DN on a site may have lost light; <= white

    // The exposure. What the file does not say is 0 or "".
    double label_s;    // as written on the dial
    double exposure_s; // as the shutter does it: exif_true_time_s()
    double f_number, focal_mm, iso;
    bool has_time, has_subseconds;
    int64_t taken_ns; // since 1970 by the camera's own clock, taken as if it were UTC
    int orientation;  // EXIF's, 1 .. 8: how to turn it upright; 1 if unknown
    char make[64], model[64], serial[64], lens[128];

    // Colour, fixed per model (from the DNG's matrix for D65 or LibRaw's table), never by the picture:
    //   linear sRGB = srgb_from_camera (daylight[c] x (DN - black) / (white - black)).
    // daylight makes a neutral under D65 equal in all channels, its green is 1; each row of the matrix has the sum 1.
    bool has_colour; // false: LibRaw knows no matrix: identity, daylight 1 1 1
    double daylight[3], srgb_from_camera[3][3];
};

int raw_read(struct raw_frame *out, const char *path, char *why, size_t room);
void raw_free(struct raw_frame *f); // NULL and zeroed allowed; leaves it zeroed
// A frame that waits while others are read: its sites move to a file without a name in folder (rigd/resting.h), from where they come back
// when they are looked at. Where that cannot be, they stay.
void raw_rest(struct raw_frame *f, const char *folder);

// Without site: the head of the file alone, for what is decided before anything large is read. Levels may be those before decoding.
int raw_read_head(struct raw_frame *out, const char *path, char *why, size_t room);
const char *raw_library(void); // LibRaw's version

// The whole frame interpolated by LibRaw to 16-bit RGB, as it lies on the sensor: 10 bytes per pixel while it is open.
enum raw_quality { RAW_BILINEAR = 0, RAW_AHD = 3 }; // dcraw's -q
struct raw_rgb {
    int width, height;
    const uint16_t (*pixel)[4];  // [height][width]; the fourth is not ours
    double unit[3], pedestal[3]; // (DN - black) / (white - black) = unit[c] x pixel[c] - pedestal[c]
    void *decoder;
};
// like NULL: exactly what `dcraw -4 -o 0 -r 1 1 1 1 -t 0 -q <quality>` gives. Else a raw_read() of the same file: balanced by its
// daylight, so that AHD compares like with like, without clipping at the common white, and with noise below black kept.
int raw_interpolate(struct raw_rgb *out, const char *path, enum raw_quality quality, const struct raw_frame *like, char *why, size_t room);
void raw_rgb_free(struct raw_rgb *r); // NULL and zeroed allowed; leaves it zeroed
