// rigd/stops.c - rows of stops, as photographers of panoramas plan them: by what the lens sees across and down through its middle.
#include "rigd/stops.h"

#include <math.h>

enum { STEPS = 256 };

// Half of what is seen, in degrees, from the middle towards an edge of the frame; axis 0 across, 1 down.
static double half_seen_deg(const struct lens *lens, int axis)
{
    const double size_px = axis ? lens->height_px : lens->width_px;
    double least = 180;
    for (int side = -1; side <= 1; side += 2) {
        double seen = 0;
        for (int i = 1; i <= STEPS; i++) {
            double px[2] = { lens->centre_px[0], lens->centre_px[1] }, dir[3];
            const double room_px = side < 0 ? px[axis] : size_px - px[axis];
            px[axis] += side * room_px * i / STEPS;
            if (!lens_ray(lens, px, dir))
                break;
            seen = acos(fmax(-1, fmin(1, dir[2]))) * (180 / M_PI);
        }
        least = fmin(least, seen);
    }
    return least;
}

int stops_plan(struct config_stop *out, int max, const struct lens *lens, double overlap)
{
    const double across = 2 * half_seen_deg(lens, 0), down = 2 * half_seen_deg(lens, 1);
    const double step_across = fmin(across * (1 - overlap), 180), step_down = down * (1 - overlap);
    int n_rows = 1, n = 0;
    double top = 0;
    if (!(across > 1) || !(down > 1))
        return 0;
    if (down < 170) { // the outermost rows look over the poles by half the overlap
        top = 90 - .5 * step_down;
        n_rows = (int)ceil(2 * top / step_down - 1e-9) + 1;
    }
    for (int row = 0; row < n_rows; row++) {
        const double pitch = n_rows > 1 ? -top + 2 * top * row / (n_rows - 1) : 0;
        const double nearest = fmax(0, fabs(pitch) - .5 * step_down); // of what this row has to cover: the widest circle
        int n_stops = (int)ceil(360 * cos(nearest * (M_PI / 180)) / step_across - 1e-9);
        n_stops = n_stops < 1 ? 1 : n_stops;
        if (n + n_stops > max)
            return 0;
        for (int i = 0; i < n_stops; i++)
            out[n++] = (struct config_stop){ 360. * i / n_stops, pitch };
    }
    return n;
}
