// solver/take/take.h - one capture on disk, as rigd leaves it and rigsolve finds it (DESIGN.md 4).
//
//   take.json  linear/<camera>.exr  panorama.exr  geometry/{mesh.obj|ply|glb|gltf, cameras/ or a camera file}  start.json
//
// Only paths and the manifest: pixels stay on disk until someone asks.
#pragma once
#include "solver/take/json.h"

struct take {
    char *dir;
    struct json *manifest;  // take.json, or NULL where there is none (a plain folder with the same pieces)
    char *mesh_path;        // geometry/mesh.*; NULL: none yet; of several the first bytewise, with a warning
    char *cameras_path;     // geometry/cameras (folder, not empty) or geometry/cameras.*; geometry itself where another
                            // *.{xml,xmp,csv,sfm,json,out} lies in it; NULL: none yet
    char *panorama_path;    // panorama.exr, else panorama.hdr; NULL: none yet
    char *linear_dir;       // NULL: none yet
    char *start_path;       // start.json: rough world_from_probe; NULL: none
    int n_views;
    char **view_names;      // stems of linear/*.{exr,tif,tiff,hdr}, sorted bytewise
    char **view_paths;
};

// Look at what is there. A missing piece is NULL, not an error: the caller says which it needs (take_require).
// 0; -ENOENT / -ENOTDIR (logged), -EINVAL (take.json broken, two views of one stem), -ENOMEM.
int take_open(struct take **out, const char *dir);
void take_close(struct take *take); // NULL allowed

// 0, or -ENOENT after logging each piece that is missing and who makes it. needs: TAKE_MESH | ...
enum { TAKE_MESH = 1, TAKE_CAMERAS = 2, TAKE_PANORAMA = 4, TAKE_VIEWS = 8, TAKE_START = 16 };
int take_require(const struct take *take, unsigned needs);

// Create dir with linear/, geometry/cameras/ and a take.json {format, name, created (UTC, ISO 8601), state}. -EEXIST if dir is
// there and not empty. created is taken from the caller so that equal input gives equal bytes.
int take_create(const char *dir, const char *name, const char *created, const char *state);
