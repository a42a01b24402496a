// rigd/exif.h - what a raw says of its exposure and LibRaw does not tell: sub-seconds, APEX time, orientation.
//
// TIFF and the raws built on it, CR3 and RAF. Input is hostile; nothing is logged.
#pragma once
#include <stdbool.h>
#include <stdint.h>

struct exif {
    bool has_time, has_subseconds;
    int64_t taken_ns;           // DateTimeOriginal and SubSecTimeOriginal since 1970, the camera's clock taken as if it were UTC
    double label_s, apex_s;     // ExposureTime; 2 ^ -ShutterSpeedValue; 0: not there
    double f_number, focal_mm;  // 0: not there
    int orientation;            // 1 .. 8; 0: not there
    char serial[64], lens[128]; // "": not there
};

// 0; -ENODATA: no EXIF there; -errno of reading. Zeroed on failure.
int exif_read(struct exif *out, int fd);

// How long the shutter was open, of what its dial says: 1/125 is 1/128, 1/60 is 1/64, 30 s is 32 s. Dials count in thirds or in halves of
// a stop; a label of both (1/6, 1/20) is a third unless apex_s says otherwise. What is on no dial (bulb) stays. 0 and NaN stay.
double exif_true_time_s(double label_s, double apex_s);
