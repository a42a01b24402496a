// solver/synth.h - synthetic studios D1-D5 (SOLVER.md 5): takes with a known answer.
//
// Light comes from N^ point lights on the walls of a 3.6 x 2.4 x 1.2 m cuboid (middle at
// (0, 0, 1.2), Z up), one per cell of an area-uniform jittered grid: four bright panels (9% of the
// area, 60 x the radiance of the dim walls, slightly tinted). A light's direction from the true
// centre c is that of a panorama pixel's centre, so panorama and lights say exactly the same;
//   C_i = radiance x cell area x cosine at the wall / r^2,
// scaled so that a sphere of albedo .5 at c is .25 bright on average. c is the cuboid's middle; the
// object's bounding box is centred at c in D1, at c + (.35, .25, -.1) m in the others. The true
// world_from_probe is 2 to 10 degrees away from the one in start.json. 85 views on 5 rings of 17,
// radius 1.8 m.
//   D1 pebble at c, Lambertian, albedo .5         D2 the same, off centre
//   D3 as D2, Disney, theta = (.2 .2 .5 .6 .9 0 .3 .4 .2 .2), smooth coloured albedo
//   D4 D3's material on the knot, with shadows and one bounce
//   D5 vase of four materials with sharp borders and detailed albedo, with shadows
//   own  a mesh and its textures, by others, scaled to the same size; with shadows and one bounce
// Noise is Gaussian, added to every pixel before the camera clips at 1; negative values are kept.
// "clip" is 1 where it clipped.
//
// Writes a take (take.h) that a solver may read; truth/ which it never may; and relit/: 6 more
// views under other panels with their panorama, probe, lights and panels, for judging. truth/ has
// the layout of a solve, so `rigsolve render` takes it.
#pragma once
#include <stdbool.h>
#include <stdint.h>

enum { SYNTH_OWN = 6 };

struct synth_settings {
    int data_set;      // 1..5, or SYNTH_OWN
    uint64_t seed;     // lights' jitter, noise, probe rotation error
    int n_true_lights; // N^, 16 .. 65536
    double noise;      // standard deviation of Gaussian noise, in units of white (1.0); 0: none
    int width_px, height_px;
    int n_views; // 85 by default: rings of n/5
    int samples; // per pixel side
    int panorama_width_px;
    int texture_size;                     // of the ground-truth textures
    bool directional;                     // render with all lights at infinity
    bool uniform_cuboid;                  // every wall equally bright
    bool one_panel_missing_from_panorama; // stability experiments
    const char *shape;                    // NULL: the data set's own; else a name of shapes.h
    const char *mesh_path;     // SYNTH_OWN: OBJ, PLY, glTF, GLB; Y is up in glTF and GLB, else Z
    bool flip_v;               // the mesh's v runs the other way than its format says (mesh_check_log: "upside down")
    const char *colour_path;   // its base colour (image_read_texture); NULL: grey .5
    const char *material_path; // glTF's channels: G roughness, B metallic; NULL: of own_theta
    float own_theta[10];       // in the order of disney.h
    const char *panorama_path, *relit_panorama_path; // what shines from the cuboid's walls, seen from c, in place of its panels; then
                                                     // n_true_lights is a power of two, and panorama_width_px the file's. NULL: panels
    bool final_float;                     // 32-bit views instead of half
    int n_threads;
};
struct synth_settings synth_defaults(int data_set);
// Made in a folder beside dir and renamed when complete; dir must not exist, or be empty. Same
// seed, same bytes, any thread count. 0 or -errno (logged): -EINVAL (a setting out of range),
// -ENOTEMPTY, -ENOMEM, those of writing.
int synth_write(const struct synth_settings *s, const char *dir);
