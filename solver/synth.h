// solver/synth.h - synthetic studios D1-D5 (SOLVER.md 5): takes with a known answer.
//
// The light comes from N^ point lights on the walls of a 3.6 x 2.4 x 1.2 m cuboid, one per cell of an area-uniform jittered grid: four bright
// panels on dim walls. They obey Eqs. 1-4 about the true centre, each in the centre of a panorama pixel, so that panorama and
// lights say exactly the same. 85 views on 5 rings of 17, radius 1.8 m.
// Writes a take (take.h) that a solver may read, and truth/ which it never may.
#pragma once
#include <stdbool.h>
#include <stdint.h>

struct synth_settings {
    int data_set;         // 1..5
    uint64_t seed;        // lights' jitter, noise, probe rotation error
    int n_true_lights;    // N^, 16 .. 65536
    double noise;         // standard deviation of Gaussian noise, in units of white (1.0); 0: none
    int width_px, height_px;
    int n_views;          // 85 by default: rings of n/5
    int samples;          // per pixel side
    int panorama_width_px;
    int texture_size;     // of the ground-truth textures
    bool directional;     // render with all lights at infinity
    bool uniform_cuboid;  // every wall equally bright
    bool one_panel_missing_from_panorama; // stability experiments
    const char *shape;    // NULL: the data set's own; else a name of shapes.h
    bool final_float;     // 32-bit views instead of half
    int n_threads;
};
struct synth_settings synth_defaults(int data_set);
int synth_write(const struct synth_settings *s, const char *dir); // 0 or -errno (logged)
