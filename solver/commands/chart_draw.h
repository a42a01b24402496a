// solver/commands/chart_draw.h - the rows of `rigsolve chart` and their drawing: error against CPU seconds, a panel for each set.
#pragma once
#include <stdbool.h>
#include <stdint.h>

enum { CHART_NAME_MAX = 64, CHART_REASON_MAX = 200 };

// One solve. Names hold letters, digits and "-_.:" only: they go into CSV, file names and the drawing as they are.
struct chart_row {
    char set[CHART_NAME_MAX];                           // "D3", or a take's folder
    char axis[CHART_NAME_MAX];                          // what differs from the base: "base", "lights", "texture", "method", "kernel", "preset"
    char method[CHART_NAME_MAX], preset[CHART_NAME_MAX]; // preset "": none, the settings are those of the row
    char kernel[CHART_NAME_MAX], hold_out[CHART_NAME_MAX];
    int64_t stage, n_lights, texture, seed, threads, n_views, n_held_out, width_px, height_px, n_observations, peak_rss_bytes;
    bool solved, trusted; // not solved: stop_reason says why, what follows is NAN
    char stop_reason[CHART_REASON_MAX];
    double wall_s, cpu_s, rmse_fit_percent, rmse_held_out_percent;
    double rmse_pictures_percent; // views held out, rendered again, against their photographs; NAN: not known
};

// Two errors are drawn, a panel each: of pictures, and of samples at texel centres (rmse_held_out_percent).
enum chart_measure { CHART_PICTURES, CHART_SAMPLES };
double chart_error_percent(const struct chart_row *row, enum chart_measure measure); // NAN: not solved, or not known
// No solved row of the same set is cheaper and at most 1 % (of it) worse. n rows, of any set.
bool chart_on_front(const struct chart_row *rows, int n, int i, enum chart_measure measure);
// "N=64", "texture 32", "avx2", "standard": what the row is called on the chart.
void chart_label(char *out, int size, const struct chart_row *row);

// dir/chart.gp, and dir/chart.svg and dir/chart.png by gnuplot where it is installed (else a warning says what to install). caption: one
// line of text. 0; -ENOENT: no gnuplot; another -errno (logged).
int chart_draw(const struct chart_row *rows, int n, const char *dir, const char *caption);
