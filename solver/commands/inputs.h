// solver/commands/inputs.h - what traces and solves begin with: a TAKE, or its pieces named one by
// one, from the command line to what is loaded.
//
// A command gives its argp the child inputs_argp, sets state->child_inputs[0] to its struct inputs
// on ARGP_KEY_INIT, and returns ARGP_ERR_UNKNOWN for ARGP_KEY_ARG: the TAKE, --mesh, --cameras,
// --images, --panorama and --world-from-probe (of the help's group 1) are read here.
#pragma once
#include "solver/cameras.h"
#include "solver/lights.h"
#include "solver/mesh.h"
#include "solver/rays.h"
#include "solver/take/take.h"
#include "solver/texels.h"

#include <argp.h>

struct inputs {
    // What the command line named. inputs_load() puts the take's own in place of NULL (not of
    // images_dir and pose_path), and NULL stays where there is none.
    const char *take_dir, *mesh_path, *cameras_path, *images_dir, *panorama_path, *pose_path;
    // What the command asks for, before inputs_load(). needs: TAKE_MESH | TAKE_CAMERAS and perhaps
    // TAKE_PANORAMA, TAKE_VIEWS; what of it is neither named nor in the take is a usage error where
    // there is no take and -ENOENT where there is. Only what is needed then is looked for further.
    unsigned needs;
    int texture;  // N x N texels
    bool png_too; // pictures to be looked at, not measured
    // What is loaded; zeroed before.
    struct take *take; // NULL: none
    struct mesh mesh;
    struct rays *rays;
    struct texels texels;
    struct cameras cameras;
    char *
        *picture; // [cameras.n] where each view's picture lies, NULL: it has none; with TAKE_VIEWS
    int n_pictures;
    struct panorama panorama; // by inputs_lights(), where it cuts it; no pixels: not read
};

extern const struct argp inputs_argp;

// The take's paths, the mesh (checked; what is odd about it is logged), its texels and rays, the
// cameras, the pictures' paths. 0, or -errno, logged but for -ENOMEM. inputs_free() in either case.
int inputs_load(struct inputs *in);
void inputs_free(struct inputs *in); // leaves it zeroed

// Lights in the world, as well as is known before a solve, after inputs_load(): those of
// lights_path or, where that is NULL, n cut from the panorama. R: of --world-from-probe; else as
// lights_path says, or for cut lights of the take's start.json;
//    else the world's axes, with a warning.
// c: of the same file where it has one; else as the places in lights_path say; else the middle of
//    the mesh's bounding box.
// 0, or -errno, logged but for -ENOMEM; out is then zeroed.
int inputs_lights(struct lights *out, struct inputs *in, const char *lights_path, int n);
