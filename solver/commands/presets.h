// solver/commands/presets.h - what `rigsolve solve --preset` stands for, said once.
#pragma once
#include <stdbool.h>

enum { N_PRESETS = 3, PRESET_STANDARD = 1 };

// Options given beside --preset change single values.
struct preset {
    const char *name;
    int last_stage, texture, texture_stage1;     // texture_stage1: with --stage 1
    int n_lights, coarse_samples, fine_samples; // of stage 1: see joint.h
    int page_views;                             // pictures on the page
    bool quick_page;                            // one ray per pixel of them
};

// preview, standard, final. A preview is for the eyes of those who could still shoot again: lights in 64 groups, shared material, few samples.
extern const struct preset presets[N_PRESETS];
extern const char *const preset_names[N_PRESETS];
