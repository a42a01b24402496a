// solver/lights.h - from a panorama to N lights, and from lights to irradiance anywhere (paper,
// Eqs. 1-4).
//
// A light is what one region of the panorama sends: probe direction dh_i, irradiance C_i on a
// surface facing it at the probe's place. Where it is in the world is the set-up: centre c,
// rotation R (world_from_probe) and 1/r_i.
#pragma once
#include "solver/panorama.h"
#include "solver/take/json.h"
#include <stdbool.h>

struct light_region { // panorama pixels [x0,x1) x [y0,y1)
    int x0, y0, x1, y1;
};

struct lights {
    int n;
    double (*dir_probe)[3];      // [n] unit
    double (*irradiance)[3];     // [n] C_i, RGB
    struct light_region *region; // [n], or NULL (lights that did not come from a panorama)
    double *spread_rad; // [n] energy-weighted RMS angle of the region about dir_probe; or NULL
    int panorama_width_px, panorama_height_px; // 0 without a panorama
    // The set-up:
    double centre_m[3];         // c
    double world_from_probe[9]; // R
    double *inverse_distance;   // [n] 1/r_i in 1/m; 0 = directional
    int32_t *group;             // [n] emitter, -1: none
};

enum { LIGHTS_MAX = 65536 };

// Zeroed set-up: c = 0, R = identity, all directional, no group. 0 or -ENOMEM.
int lights_new(struct lights *out, int n);
void lights_free(struct lights *l); // leaves it zeroed
// Which unknown distance each light has, into distance_of[n]: lights of one group share one, of group -1 each has its own. Numbered
// from 0 as they come. How many.
int lights_number_distances(const struct lights *l, int32_t *distance_of);

// Median cut (Debevec 2005): n = 2^k regions, 1 <= n <= LIGHTS_MAX, that partition the panorama;
// each is split along its longer side (width x cos(elevation of its centre)) where the luminance
// (Rec. 709) x solid angle halves. Total energy is kept.
// A region that cannot be split (one pixel, or no energy) gives one light, and empty ones in place
// of its parts: irradiance 0, no pixels (x0 = x1), the *same* direction. Lights are in the order of
// the cut: any aligned run of 2^j of them is one region of the cut into n / 2^j, so neighbours in
// the list are neighbours in the sky. 0, -EINVAL (n; logged), -ENOMEM.
int lights_median_cut(struct lights *out, const struct panorama *p, int n);

// Finer lights: of all regions, that whose one light is the coarsest (energy x spread^2) is split, until there are n (any number >=
// from->n; fewer where nothing is left to split). group: which light of `from` each is a part of, ascending; the set-up
// is from's, and every part has its light's distance. from: of lights_median_cut, of the same panorama. 0 or -ENOMEM.
int lights_refine(struct lights *out, const struct lights *from, const struct panorama *p, int n);

// lights.json (DESIGN.md 6): a list of {dir_probe[3], dir_world[3] (= R dh), irradiance[3],
// distance_m and pos_m[3] (both null: directional), group (-1: none), and from a panorama
// region_px[4] (x0, y0, x1, y1), panorama_px[2] (width, height) and spread_rad}. Lights without a
// set-up (lights_new: R identity, all directional) are written without dir_world.
//
// The set-up is not in the file; it is what takes dir_probe to dir_world and pos_m:
// - R from dir_world where every light has one; else from the lights with a distance, of which
//   three must not lie on one line; else R = identity, which is logged. Of lights in one direction,
//   or none: the smallest rotation that fits.
// - c = mean of pos_m - r R dh, each weighted by 1/r^2; 0 where all are directional.
// What was written comes back: dir_probe, irradiance, group, region and spread to the bit, 1/r to
// its last one, R and c to rounding (c: of the distances) where the lights determine them, R dh in
// any case. Beyond 1e15 m a light is directional.
// Reading accepts a missing group, and the list wrapped as {"lights": list, ...}; other keys are
// not looked at; region_px and spread_rad are of all lights or none. It checks: directions unit to
// 1e-6, irradiance in [0, 1e30], that all lights agree with R and c (2e-6: six decimals suffice)
// and are not mirrored. Errors are logged and name light (from 0) and key: -EINVAL, -ENOMEM, those
// of json_read.
int lights_write_json(const struct lights *l, const char *path);
int lights_read_json(struct lights *out, const char *path);
int lights_parse_json(struct lights *out, const char *text, size_t n_bytes,
                      const char *name_for_errors);

// A pose of the probe (start.json, a studio's probe.json): an object with world_from_probe (3x3)
// and perhaps centre_m[3], which become l's R and c. R's rows must be orthonormal to 1e-4 (five
// decimals suffice), right-handed; the nearest rotation is taken, and one that is exact to rounding
// comes back to the bit. c is within 1e9 m. Without centre_m: c stays and *has_centre is false;
// where has_centre is NULL, that is an error. 0; logged, with l as it was: -EINVAL, those of
// json_read.
int lights_read_pose(struct lights *l, bool *has_centre, const char *path);

// Irradiance that light i gives a surface at p facing it, and where it comes from (Eqs. 1-4),
// written so that q = 1/r = 0 is an ordinary value:
//   u = R dh + q (c - p);  l = u/|u|;  c_i(p) = max(<u, R dh>, 0) / |u|^3 C_i
// Behind the light (<u, R dh> <= 0) and at its very place the weight and all derivatives are 0; l
// stays a unit vector.
struct light_at {
    double l[3];   // unit direction to the light
    double weight; // c_i(p) = weight * C_i
};
struct light_at_gradient {
    struct light_at at;
    double l_centre[9], weight_centre[3];     // d l / d c (3x3), d weight / d c
    double l_rotation[9], weight_rotation[3]; // by w, R = exp([w]x) R0, at w = 0
    double l_inverse_distance[3], weight_inverse_distance;
    double l_point[9], weight_point[3]; // by p
};
void light_at_point(const struct lights *l, int i, const double point_m[3], struct light_at *out);
void light_at_point_gradient(const struct lights *l, int i, const double point_m[3],
                             struct light_at_gradient *out);
