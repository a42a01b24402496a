// solver/cameras_frame.h - do the cameras see this mesh? Photogrammetry tools export the two by themselves, each with axes, unit and
// local origin of its own.
//
// A trial turns, mirrors or scales the mesh and counts how many of its vertices (up to 1,000, of up to 100 views) then lie in the
// pictures, and how much of a picture they span. Cameras that look at a mesh from all around hit it mirrored or turned as well:
// these trials find frames that differ in where things are. cameras_check_pictures() finds the others.
#pragma once
#include "solver/cameras.h"
#include "solver/mesh.h"
#include "solver/rays.h"

enum { CAMERAS_N_TRIALS = 14 }; // [0] is the mesh as it is
struct cameras_trial {
    const char *name; // "as it is", "(x, z, -y)", ...
    double mesh[9];   // what is done to the mesh's points
    double hit_rate;  // share of (vertex, view) pairs in the picture
    double span;      // median over the views of the vertices' extent in the picture, as a share of its diagonal
};
void cameras_try_frames(struct cameras_trial trials[CAMERAS_N_TRIALS], const struct cameras *c, const struct mesh *mesh);

// Reads cameras for a mesh and brings them into its frame. Metashape's chunk transform is taken or left, whichever puts more of the
// mesh into the pictures; cameras whose axes are those of another tool (y up for z up) are turned to the mesh's; either choice
// is logged with its hit rates. A mesh that is mirrored, in another unit, or not what these cameras saw is refused with the hit
// rate of every trial. As cameras_read_with(); -EDOM (logged): they do not belong together.
int cameras_read_for_mesh(struct cameras *out, const char *path, const struct cameras_options *options,
                          const struct mesh *mesh, const char *mesh_path);

// What counting hits cannot tell: a mesh that is mirrored or turned within the same place. Looks at the same 500 points of the
// surface in up to 8 of the pictures: where cameras and mesh belong together, the pictures agree about the points' brightness.
// agreement[i] of trial i (as it is, turns, mirrors: the first 7): the share of the variance of log brightness that lies between
// points, not between the views of one; NAN where too little is seen to say. picture: path of each view's, or NULL.
// 0, or an error of image_read().
enum { CAMERAS_N_AGREEMENTS = 7 };
int cameras_measure_agreement(double agreement[CAMERAS_N_AGREEMENTS], const struct cameras *c, const struct mesh *mesh,
                              const struct rays *rays, char *const *picture);
// Measures it, and warns (with every figure) if another trial than the mesh as it is agrees clearly better. 0, or as above.
int cameras_check_pictures(const struct cameras *c, const struct mesh *mesh, const struct rays *rays, char *const *picture,
                           const char *path, const char *mesh_path);
