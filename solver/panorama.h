// solver/panorama.h - an HDR latitude-longitude picture of the lights, and its directions.
//
// W = 2H. Image centre looks along +Z, left edge is longitude +180 degrees, +Y is up:
// d = (sin(lon) cos(lat), sin(lat), cos(lon) cos(lat)); lon = pi - 2 pi x / W, lat = pi/2 - pi y / H at continuous pixel (x, y).
#pragma once
#include "solver/take/image.h"

struct panorama {
    struct image image; // R, G, B, linear radiance
};

// Errors, logged: those of image_read; -EINVAL: not 2:1, no R G B, all black; -EDOM: NaN or infinite pixels. Negative values are
// set to 0 with a warning that counts them.
int panorama_read(struct panorama *out, const char *path);
void panorama_free(struct panorama *p);

void panorama_direction(int width, int height, double x_px, double y_px, double dir[3]); // unit
// x in [0, width), y in [0, height]: straight down is y = height. dir need not be unit.
void panorama_pixel(int width, int height, const double dir[3], double *x_px, double *y_px);
// Exact solid angle of one pixel of row y: (2 pi / W)(cos(pi y/H) - cos(pi (y+1)/H)).
double panorama_solid_angle(int width, int height, int y);

// Irradiance at a patch with unit normal (probe frame): sum of radiance x solid angle x max(<n,d>, 0).
void panorama_irradiance(const struct panorama *p, const double normal_probe[3], double irradiance[3]);
// The same of the whole sphere without the cosine: sum of radiance x solid angle.
void panorama_total(const struct panorama *p, double total[3]);
