// solver/commands/report.h - what `rigsolve report` does, for `rigsolve solve` to do at its end.
#pragma once
#include <stdbool.h>

struct report_inputs {
    const char *solve_dir;
    const char *mesh;               // NULL: the one that report.json names
    const char *take_dir;           // NULL: report.json's inputs.take, if it is there
    const char *cameras, *images;   // beat the take's; NULL: report.json's inputs.cameras and inputs.images, else the take's
    const char *output;             // NULL: SOLVE_DIR/report.html
    int n_views, n_threads;
    bool quick;                 // pictures of one ray a pixel
};

// Writes the page. Without cameras or photographs it has no pictures, which is said. 0, or -errno, logged but for -ENOMEM.
int report_folder(const struct report_inputs *in);
