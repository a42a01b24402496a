// solver/silhouette.c - how far a picture mixes the object's light with that of what lies behind it: the edge's profile.
//
// Rows and columns of pixels are followed until they cross the mesh's silhouette. There the picture's own pixels (nothing is interpolated: that
// would spread light) say which share of the step from background to object they have, at their distance from the line through the silhouette,
// which falls anywhere between pixels: many crossings together sample the profile finely, as with a slanted edge that tests a lens.
// Shading changes fast inside of a silhouette, so the reach is read off outside, and taken to be the same to both sides of the picture's edge.
#include "solver/silhouette.h"

#include <math.h>

// Distances are counted in units: 1 px, or 2 or 4 where light reaches further than PROFILE_END of them. Inside is positive.
enum { LINES = 96, STEPS = 128, BINS_PER_UNIT = 2, PROFILE_END = 5, N_BINS = SILHOUETTE_BINS, FAR_END = 10, FEWEST_POINTS = 24 };
_Static_assert(N_BINS == 2 * PROFILE_END * BINS_PER_UNIT + 1, "from -PROFILE_END to PROFILE_END");
static const double FAR_BEGIN = 6, INSIDE_BEGIN = 5, INSIDE_END = 9, WELL_INSIDE = 3.5; // where either side is by itself
static const double TANGENT = 3, STRAIGHT = .3; // the silhouette's direction is looked for this far to either side, and it must be this straight
static const double PLAIN = .1, ODD = .3, UNEVEN = .6; // how much a background may vary, of the step; how far beyond either side it may be; how much the object may vary
static const double LEAST_SHARE = -.5, MOST_SHARE = 1.5, SHARE_STEP = 2. / (SILHOUETTE_SHARES - 1);
static const double MIXED = .02, UNCERTAIN = .015; // a share of foreign light that counts; the deviation of a mean share beyond which it says nothing

struct look {
    const struct rays *rays;
    const struct camera *camera;
    const struct image *image;
    const int *rgb;
    struct silhouette *sums;
};

// axis 0: at (along, across) of the picture; 1: at (across, along).
static bool sees(const struct look *l, int axis, double along_px, double across_px)
{
    const double uv_px[2] = { axis ? across_px : along_px, axis ? along_px : across_px };
    const double *centre_m = l->camera->centre_m;
    double ray[3];
    struct ray_hit hit;
    if (!camera_ray(l->camera, uv_px, ray))
        return false;
    const float from[3] = { (float)centre_m[0], (float)centre_m[1], (float)centre_m[2] }, dir[3] = { (float)ray[0], (float)ray[1], (float)ray[2] };
    return rays_hit(l->rays, from, dir, 0, INFINITY, &hit);
}

static double luminance(const struct look *l, int axis, int along, int across)
{
    const int x = axis ? across : along, y = axis ? along : across;
    const float *pixel = l->image->data + ((size_t)y * (size_t)l->image->width + (size_t)x) * (size_t)l->image->n_channels;
    return .2126 * (double)pixel[l->rgb[0]] + .7152 * (double)pixel[l->rgb[1]] + .0722 * (double)pixel[l->rgb[2]];
}

// Between a, where the object is seen or not as is_seen says, and b, where it is not so.
static double crossing_px(const struct look *l, int axis, double across_px, double a_px, double b_px, bool is_seen)
{
    while (fabs(b_px - a_px) > 1. / 128) {
        const double middle_px = (a_px + b_px) / 2;
        if (sees(l, axis, middle_px, across_px) == is_seen)
            a_px = middle_px;
        else
            b_px = middle_px;
    }
    return (a_px + b_px) / 2;
}

// Where the same silhouette crosses another line, nearby.
static bool crosses_too(const struct look *l, int axis, double across_px, double near_px, double within_px, bool is_seen_before, double *at_px)
{
    const double a_px = near_px - within_px, b_px = near_px + within_px;
    if (sees(l, axis, a_px, across_px) != is_seen_before || sees(l, axis, b_px, across_px) == is_seen_before)
        return false;
    *at_px = crossing_px(l, axis, across_px, a_px, b_px, is_seen_before);
    return true;
}

// The line `across` crosses the silhouette at at_px. Its pixels' shares are added where the silhouette is straight and crosses at more
// than 45 degrees, nothing else crosses nearby, and the background is plain, without a lamp that just looks out from behind the object, and no edge
// of the object itself makes the step.
static void add_crossing(const struct look *l, int k_unit, int axis, int across, double at_px, bool is_seen_before)
{
    struct silhouette_profile *profile = &l->sums->at[k_unit];
    const int unit_px = 1 << k_unit;
    const int n_along = axis ? l->image->height : l->image->width;
    const double line_px = across + .5, apart_px = TANGENT * unit_px, within_px = apart_px + unit_px;
    double before_px, after_px, far_sum = 0, far_squares = 0, inside_sum = 0;
    if (!crosses_too(l, axis, line_px - apart_px, at_px, within_px, is_seen_before, &before_px) ||
        !crosses_too(l, axis, line_px + apart_px, at_px, within_px, is_seen_before, &after_px))
        return;
    const double slope = (after_px - before_px) / (2 * apart_px);
    if (fabs(slope) > 1 || fabs((before_px + after_px) / 2 - at_px) > STRAIGHT * unit_px)
        return;
    const double per_px = (is_seen_before ? -1 : 1) / (sqrt(1 + slope * slope) * unit_px), end_px = FAR_END / fabs(per_px);
    if (at_px - end_px < 0 || at_px + end_px > n_along - 1)
        return;
    enum { MOST = 4 * FAR_END }; // pixels: at 45 degrees 2 x 10 x 1.42
    double value[MOST], place[MOST];
    int n = 0, n_far = 0, n_inside = 0;
    for (int k = (int)ceil(at_px - end_px); k + .5 < at_px + end_px && n < MOST; k += unit_px) {
        const double d = (k + .5 - at_px) * per_px, y = luminance(l, axis, k, across);
        if (fabs(d) > STRAIGHT && sees(l, axis, k + .5, line_px) != (d > 0))
            return;
        if (d < -FAR_BEGIN)
            far_sum += y, far_squares += y * y, n_far++;
        if (d >= INSIDE_BEGIN && d < INSIDE_END)
            inside_sum += y, n_inside++;
        value[n] = y, place[n++] = d;
    }
    if (n_far < 2 || n_inside < 2)
        return;
    const double background = far_sum / n_far, step = inside_sum / n_inside - background, variance = far_squares / n_far - background * background;
    if (!(fmax(variance, 0) < PLAIN * PLAIN * step * step))
        return;
    for (int i = 0; i < n; i++) {
        const double share = (value[i] - background) / step;
        if ((place[i] < 0 && (share < -ODD || share > 1 + ODD)) || (place[i] > WELL_INSIDE && fabs(share - 1) > UNEVEN))
            return;
    }
    profile->n_points++;
    for (int i = 0; i < n; i++) {
        const int bin = (int)floor((place[i] + PROFILE_END) * BINS_PER_UNIT + .5);
        if (bin < 0 || bin >= N_BINS)
            continue;
        const double share = fmin(fmax((value[i] - background) / step, LEAST_SHARE), MOST_SHARE);
        profile->n[bin][(int)((share - LEAST_SHARE) / SHARE_STEP + .5)]++;
    }
}

static void follow_line(const struct look *l, int axis, int across)
{
    const int n_along = axis ? l->image->height : l->image->width;
    const double step_px = fmax(2, n_along / (double)STEPS);
    bool was_seen = sees(l, axis, .5, across + .5);
    for (double at_px = .5 + step_px; at_px < n_along; at_px += step_px) {
        const bool is_seen = sees(l, axis, at_px, across + .5);
        if (is_seen != was_seen) {
            const double crossed_px = crossing_px(l, axis, across + .5, at_px - step_px, at_px, was_seen);
            for (int k = 0; k < SILHOUETTE_UNITS; k++)
                add_crossing(l, k, axis, across, crossed_px, was_seen);
        }
        was_seen = is_seen;
    }
}

static double place_of(double bin)
{
    return bin / BINS_PER_UNIT - PROFILE_END;
}

// Where the mean share grows past `level` between bin and the next.
static double level_at(const double mean[N_BINS], int bin, double level)
{
    return place_of(bin + (level - mean[bin]) / (mean[bin + 1] - mean[bin]));
}

// The mean share of a bin's pixels but for the tenth with the least and the tenth with the most, and that mean's deviation: a lamp that looks
// out from behind the object here and there does not decide, an outline that is off to one side does.
static double trimmed_mean(const int n[SILHOUETTE_SHARES], double *deviation)
{
    int total = 0, before = 0;
    double sum = 0, squares = 0;
    for (int i = 0; i < SILHOUETTE_SHARES; i++)
        total += n[i];
    const int cut = total / 10, kept = total - 2 * cut;
    for (int i = 0; i < SILHOUETTE_SHARES; before += n[i++]) {
        const int from = before > cut ? before : cut, to = before + n[i] < total - cut ? before + n[i] : total - cut;
        const double share = LEAST_SHARE + i * SHARE_STEP;
        if (to > from)
            sum += (to - from) * share, squares += (to - from) * share * share;
    }
    *deviation = sqrt(fmax(squares / kept - sum / kept * (sum / kept), 0) / kept); // NaN of no pixels
    return sum / kept;
}

// The middle of the steepest rise, of three.
static double steepest_at(const double mean[N_BINS])
{
    int top = 1;
    double sum = 0, moment = 0;
    for (int b = 1; b < N_BINS - 2; b++)
        if (mean[b + 1] - mean[b] > mean[top + 1] - mean[top])
            top = b;
    for (int b = top - 1; b <= top + 1; b++) {
        const double rise = fmax(mean[b + 1] - mean[b], 0);
        sum += rise, moment += rise * place_of(b + .5);
    }
    return moment / sum;
}

enum verdict { IS_KNOWN, IS_UNKNOWN, REACHES_FURTHER };

// In the profile's own unit: the middle of the pictures' silhouette, and where it begins outside.
static enum verdict read_profile(const struct silhouette_profile *p, double *middle, double *begin)
{
    double mean[N_BINS], deviation[N_BINS];
    if (p->n_points < FEWEST_POINTS)
        return IS_UNKNOWN;
    for (int b = 0; b < N_BINS; b++) {
        mean[b] = trimmed_mean(p->n[b], &deviation[b]);
        if (isnan(mean[b]))
            return IS_UNKNOWN;
    }
    int half = N_BINS / 2; // from the mesh's silhouette to the pictures', outwards or inwards
    while (half > 0 && mean[half] >= .5)
        half--;
    while (half < N_BINS - 2 && mean[half + 1] < .5)
        half++;
    if (mean[half] >= .5 || mean[half + 1] < .5)
        return REACHES_FURTHER;
    int foot = half;
    while (foot > 0 && mean[foot] > MIXED)
        foot--;
    if (mean[foot] > MIXED)
        return REACHES_FURTHER;
    for (int b = 0; b <= foot; b++)
        if (deviation[b] > UNCERTAIN)
            return IS_UNKNOWN;
    // Half the step is passed too far inside where the object's rim shines like what is behind it; the steepest place is by chance to one side
    // where cameras are off, for then the outline is off to both. A mesh that is too large or small moves both.
    const double passed = level_at(mean, half, .5), steepest = steepest_at(mean);
    *middle = passed * steepest <= 0 ? 0 : fabs(passed) < fabs(steepest) ? passed : steepest;
    *begin = level_at(mean, foot, MIXED);
    return IS_KNOWN;
}

void silhouette_add(struct silhouette *s, const struct rays *rays, const struct camera *camera, const struct image *image, const int rgb[3])
{
    const struct look l = { .rays = rays, .camera = camera, .image = image, .rgb = rgb, .sums = s };
    for (int axis = 0; axis < 2; axis++) {
        const int n_across = axis ? image->width : image->height, n_lines = n_across < LINES ? n_across : LINES;
        for (int i = 0; i < n_lines; i++)
            follow_line(&l, axis, (int)((i + .5) * n_across / n_lines));
    }
}

bool silhouette_reach(const struct silhouette *s, double *reach_px, double *offset_px)
{
    double middle, begin;
    for (int k = 0; k < SILHOUETTE_UNITS; k++) {
        const enum verdict v = read_profile(&s->at[k], &middle, &begin);
        if (v == REACHES_FURTHER)
            continue;
        if (v == IS_UNKNOWN)
            return false;
        *offset_px = middle * (1 << k), *reach_px = (fabs(middle) + middle - begin) * (1 << k);
        return true;
    }
    return false;
}
