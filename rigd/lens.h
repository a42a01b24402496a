// rigd/lens.h - which direction a pixel of a lens sees, and the solid angle it has; which way a panorama head holds the camera.
//
// Pure. Camera axes as in OpenCV: x right, y down, z forward. Pixel corner (0, 0), first pixel centre (.5, .5). A direction at angle a
// from z, at azimuth b in the image, lies at (x, y) = r(a) (cos b, sin b) with
//   rectilinear r = tan a;  equidistant r = a;  equisolid r = 2 sin(a / 2);  stereographic r = 2 tan(a / 2),
// is then moved by Brown's distortion (for every model; s = x^2 + y^2)
//   x' = x (1 + k1 s + k2 s^2 + k3 s^3) + 2 p1 x y + p2 (s + 2 x^2),  y' = y (1 + ...) + p1 (s + 2 y^2) + 2 p2 x y
// and seen at pixel centre_px + focal_px (x', y'). Equidistant with p = 0 is OpenCV's fisheye with k4 = 0.
#pragma once
#include "solver/take/json.h"
#include <stdbool.h>

enum lens_model { LENS_RECTILINEAR, LENS_EQUIDISTANT, LENS_EQUISOLID, LENS_STEREOGRAPHIC, LENS_MODELS };

struct lens {
    enum lens_model model;
    int width_px, height_px;
    double focal_px;
    double centre_px[2];
    double k[3], p[2];
    double circle_px;     // radius of the image circle about centre_px; 0: none
    double max_angle_rad; // from the axis; nothing further out is seen
    // Corner shading: light falls to 1 + v1 t + v2 t^2 + v3 t^3 of what it is at the centre, t = (distance to centre_px / focal_px)^2.
    double v[3];
    double max_r; // set by lens_init: r of max_angle_rad, or less where the distortion folds back
};

// Checks what is set and fills in: max_angle_rad 0 becomes the model's widest (85 degrees; 180; 180; 170). 0; -EINVAL, logged with what
// is wrong (name: of the file, for that): sizes 2 .. 65536, focal_px in [1, 1e6], finite, circle and shading not negative within the frame.
int lens_init(struct lens *lens, const char *name);

// {"model": "rectilinear|equidistant|equisolid|stereographic", "width_px", "height_px", "focal_px"} and, as far as they differ from none
// and the middle: "centre_px" [2], "distortion" [k1, k2, k3, p1, p2], "circle_px", "max_angle_deg", "shading" [v1, v2, v3].
// 0; -EINVAL, logged. Ends with lens_init.
int lens_from_json(struct lens *out, const struct json *v, const char *path, const char *name);
struct json *lens_json(const struct lens *lens); // what lens_from_json reads
const char *lens_model_name(enum lens_model m);

// False: not seen (too far from the axis, outside the circle). The pixel may be outside the frame. dir need not be unit.
bool lens_project(const struct lens *lens, const double dir[3], double px[2]);
// Unit direction. False: outside the circle, or no direction within max_angle_rad comes there.
bool lens_ray(const struct lens *lens, const double px[2], double dir[3]);
// Steradians per square pixel at px; 0 where lens_ray is false.
double lens_solid_angle(const struct lens *lens, const double px[2]);
double lens_shading(const struct lens *lens, const double px[2]);
// No pixel further than this from centre_px is seen.
double lens_reach_px(const struct lens *lens);

// The head holds the camera: yaw to the left seen from above, then pitch up, then roll: the camera turns clockwise seen from behind
// it. All 0: it looks along the probe's +Z (the panorama's middle) with +Y upwards, so that x (right in the image) is the probe's -X.
// Row-major; takes camera axes to the panorama's.
void lens_head(double probe_from_camera[9], double yaw_rad, double pitch_rad, double roll_rad);
