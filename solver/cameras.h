// solver/cameras.h - calibrated views, from any photogrammetry tool's file.
//
// Inside: OpenCV axes (+x right, +y down, +z forward), x_cam = R x_world + t; pixel corner (0,0), first pixel centre (.5,.5).
// (x, y) = (X/Z, Y/Z), r2 = x^2 + y^2:
//   BROWN    s = 1 + k1 r2 + k2 r4 + k3 r6 + k4 r8;  xd = x s + (2 p1 x y + p2 (r2 + 2 x^2)) (1 + p3 r2 + p4 r4), yd likewise
//            (OpenCV's p1, p2 order; no distortion: all zero)
//   RATIONAL s = (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6); tangential as BROWN
//   FISHEYE  (xa, ya) = (x, y) atan(r) / r, then BROWN on (xa, ya): a = atan r, ad = a (1 + k1 a^2 + ... + k4 a^8), tangential
//            terms in (xa, ya) (Metashape's; zero in OpenCV's)
// u = fx xd + skew yd + cx, v = fy yd + cy.
#pragma once
#include <stdbool.h>

enum { CAMERA_NAME_MAX = 128 };
enum camera_model { CAMERA_BROWN, CAMERA_RATIONAL, CAMERA_FISHEYE };

struct camera {
    char name[CAMERA_NAME_MAX]; // the image's file stem
    int width_px, height_px;
    enum camera_model model;
    double fx, fy, cx, cy, skew; // pixels
    double k[6], p[4];
    double cam_from_world[9]; // rotation, row-major
    double t_m[3];
    double centre_m[3]; // -R^T t
};

struct cameras {
    int n;
    struct camera *view; // [n], in the file's order
};

// What a reader cannot know from the file. NULL, or zeroed: nothing.
struct cameras_options {
    // How large the picture of a view is: RealityCapture and Bundler files do not say. Returns 0, or -ENOENT where it cannot know; then
    // (or if it is NULL) pictures of that name beside the camera file are looked at. Views whose size stays unknown are left
    // out, with a warning.
    int (*picture_size)(void *arg, const char *name, int *width_px, int *height_px);
    void *arg;
    bool without_transform; // Metashape: cameras in the chunk's own frame, without the component's or chunk's transform
    bool *has_transform;    // NULL, or set to true where the file has such a transform
};

// Read any supported format: `path` is a file, or a folder that holds one (COLMAP's text or binary, binary wins; XMP sidecars; or
// just one file of another format). Formats are known by content: COLMAP, Bundler 0.3 (with its list.txt), Agisoft Metashape
// XML, RealityCapture XMP and CSV, Meshroom (AliceVision) SfMData JSON. Errors, logged with file, line or offset, found,
// expected, remedy: -errno of the open, -EINVAL, -ENOTSUP (models and rigs that are not read, by name), -ENOMEM. Counts are
// checked against the file's size before anything is allocated. Points are ignored; cameras that the tool did not place, or that
// the user disabled, are left out. Two images of one stem are refused, and so is text without its last line end: a file cut
// short must not pass for a shorter one.
int cameras_read(struct cameras *out, const char *path);
int cameras_read_with(struct cameras *out, const char *path, const struct cameras_options *options);
void cameras_free(struct cameras *c); // leaves it zeroed

// Each view gets a camera of its own and the image name NAME.exr (a take's). dir is made if need be. 0, -ENOTSUP (skew, BROWN's
// k4, p3 or p4: COLMAP has no model for them; the view is named and nothing written), -EINVAL (a name that is no stem), -errno.
int cameras_write_colmap_text(const struct cameras *c, const char *dir);   // cameras.txt, images.txt, points3D.txt; atomic each
int cameras_write_colmap_binary(const struct cameras *c, const char *dir); // the same as .bin

// NULL if there is no view of that stem.
const struct camera *cameras_find(const struct cameras *c, const char *name);

// Set cam_from_world, t, centre so that the camera at centre_m looks at target_m with `up` upwards in the image.
void camera_look_at(struct camera *c, const double centre_m[3], const double target_m[3], const double up[3]);

// Is a picture of that size one of this camera's, larger or smaller, but for the rounding of one side to whole pixels?
bool camera_has_aspect(const struct camera *c, int width_px, int height_px);
// Scale intrinsics to an image of another size (same field of view).
void camera_resize(struct camera *c, int width_px, int height_px);

// World point to continuous pixel; false when it lies behind the camera (z <= 1e-9, or beyond the distortion model's
// monotonic range). The pixel may be outside the image. depth_m: z; may be NULL.
bool camera_project(const struct camera *c, const double point_m[3], double uv_px[2], double *depth_m);
// The same with the 2x3 derivative of the pixel by the world point.
bool camera_project_jacobian(const struct camera *c, const double point_m[3], double uv_px[2], double J[6]);
// Pixel to unit world direction through centre_m (Newton on the distortion, to 1e-10); false where it does not converge.
bool camera_ray(const struct camera *c, const double uv_px[2], double dir_world[3]);
