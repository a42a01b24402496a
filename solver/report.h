// solver/report.h - report.html: one page that says what a solve found and how far to believe it.
//
// Self-contained: pictures are PNGs in it, drawings SVG; no script, nothing fetched. What is NULL or empty is left out.
#pragma once
#include "solver/cameras.h"
#include "solver/lights.h"
#include "solver/mesh.h"
#include "solver/take/image.h"
#include "solver/take/json.h"
#include <stdbool.h>

enum { REPORT_PICTURE_PX = 480 }; // pictures are shown at most this wide

struct report_view {
    const char *name;
    struct image input, render; // of one size; render: R, G, B, A
};

struct report_source {
    const char *title;
    const struct json *report;   // report.json; its views_held_out[] names the views that were set aside
    const struct json *exported; // export.json
    const struct mesh *mesh;
    const struct image *albedo, *parameters, *std, *validity;
    const struct lights *lights;
    const struct cameras *cameras;
    const struct report_view *view; // [n_views]
    int n_views;
};

// Atomic. 0, -errno (logged), -ENOMEM.
int report_write(const struct report_source *source, const char *path);

bool report_set_aside(const struct json *report, const char *view); // report NULL: false

// Area mean of an image at another size, no larger. 0 or -ENOMEM.
int report_shrink(struct image *out, const struct image *image, int width, int height);

// R, G, B of a picture, by name, no wider than the page shows; and the camera at that size, whatever size it was calibrated for.
// 0, -ENOMEM, -EINVAL (not logged): a channel is missing, or the aspect is not the camera's, but for rounding: the solver takes no such picture.
int report_photograph(struct image *out, struct camera *small, const struct image *picture, const struct camera *camera);
