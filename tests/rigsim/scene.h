// tests/rigsim/scene.h - what the simulated cameras look at: linear pictures, sampled at the sites of an RGGB sensor.
//
// Without a folder: a built-in test picture (grey ramp, colour patches, a shaded ball, fine bars), shifted per camera. With one:
// <camera>.exr (then any EXR of the folder, in order of names, round and round) resampled bilinearly to the sensor, or taken as it is
// where the size agrees. One camera may look at a panorama instead (probe.h). Planes of a folder live in an unlinked spool file under $TMPDIR, mapped: the kernel may evict them.
#pragma once
#include <stdint.h>

struct scene;
struct probe;

struct scene_view {            // of an exposure
    double yaw_deg, pitch_deg; // where the head pointed: of the camera on it
    double lamps;              // how bright they happened to be; 1 without flicker
};

// folder: NULL or a folder of EXRs. Errors, logged: -ENOENT (no folder, or no EXR in it), -errno of the spool file, -ENOMEM.
int scene_open(struct scene **out, const char *folder, int width_px, int height_px, unsigned n_cameras,
               const char *(*camera_name)(unsigned camera));
void scene_close(struct scene *s); // NULL allowed
void scene_give(struct scene *s, unsigned camera, struct probe *probe); // what this camera sees, in its own size; takes probe
// Radiance at every site of row y (even rows R G R G ..., odd rows G B G B ...), 1 = diffuse white; site[width]. A picture that
// cannot be read is logged once and is black.
void scene_row(struct scene *s, unsigned camera, const struct scene_view *view, int y, float *site);
int scene_width(const struct scene *s, unsigned camera);
int scene_height(const struct scene *s, unsigned camera);
