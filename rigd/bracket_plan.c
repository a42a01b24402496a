// rigd/bracket_plan.c - what a frame tells of its exposure, and which exposure comes next.
//
// The dark end is judged by a percentile and the bright end by the single brightest light, because a lamp may be a dozen photosites of
// millions; only sites that are bright alone, without any neighbour, are taken for hot ones.
#include "rigd/bracket.h"
#include "rigd/plateau.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const double usable = .9;
enum { DN_COUNT = 65536, BLACK_SHIFT = 4096 }; // histogram[3] is of DN - black + BLACK_SHIFT

static double signal_of(const struct raw_frame *f, int x, int y)
{
    const double black = f->black[y & 1][x & 1];
    return (f->site[(size_t)y * (size_t)f->width + (size_t)x] - black) / (f->white - black);
}

static bool has_bright_neighbour(const struct raw_frame *f, int x, int y, double least)
{
    for (int v = y - 1; v <= y + 1; v++)
        for (int u = x - 1; u <= x + 1; u++)
            if ((u != x || v != y) && u >= 0 && v >= 0 && u < f->width && v < f->height && signal_of(f, u, v) >= least)
                return true;
    return false;
}

static double percentile(const uint32_t *h, int64_t n, double share, double scale)
{
    int64_t below = 0;
    for (int i = 0; i < DN_COUNT; i++) {
        below += h[i];
        if (below > share * (double)n)
            return (i - BLACK_SHIFT) * scale;
    }
    return 0;
}

int bracket_measure(struct bracket_statistics *out, const struct raw_frame *f, const struct lens *lens)
{
    struct bracket_statistics s = { .exposure_s = f->exposure_s };
    uint32_t *h = calloc(3 * DN_COUNT, sizeof(*h));
    memset(out, 0, sizeof(*out));
    if (!h)
        return -ENOMEM;
    struct plateau plateau;
    if (plateau_find(&plateau, f)) {
        free(h);
        return -ENOMEM;
    }
    s.plateau_dn = plateau.dn;
    const double saturation = s.plateau_dn ? s.plateau_dn : f->saturation;
    const double reach = lens ? lens_reach_px(lens) : INFINITY;
    for (int y = 0; y < f->height; y++)
        for (int x = 0; x < f->width; x++) {
            if (lens && hypot(x + .5 - lens->centre_px[0], y + .5 - lens->centre_px[1]) > reach)
                continue;
            const int c = f->cfa[y & 1][x & 1];
            const double black = f->black[y & 1][x & 1], v = signal_of(f, x, y);
            const double over = usable * (saturation - black) / (f->white - black);
            int bin = (int)lrint(f->site[(size_t)y * (size_t)f->width + (size_t)x] - black) + BLACK_SHIFT;
            bin = bin < 0 ? 0 : bin >= DN_COUNT ? DN_COUNT - 1 : bin;
            h[c * DN_COUNT + bin]++;
            s.n_sites[c]++;
            if ((v > over || v > s.brightest[c]) && has_bright_neighbour(f, x, y, .25 * v)) {
                s.n_over[c] += v > over;
                s.brightest[c] = fmax(s.brightest[c], v);
            }
        }
    for (int c = 0; c < 3; c++) {
        const double scale = 1 / (f->white - f->black[0][0]);
        s.first_percentile[c] = percentile(h + c * DN_COUNT, s.n_sites[c], .01, scale);
        s.median[c] = percentile(h + c * DN_COUNT, s.n_sites[c], .5, scale);
    }
    free(h);
    *out = s;
    return 0;
}

// ---- what comes next --------------------------------------------------------------------------------------------------------

static void say_time(char *to, size_t room, double s)
{
    if (s < .4)
        snprintf(to, room, "1/%.0f s", 1 / s);
    else
        snprintf(to, room, "%.3g s", s);
}

static int shoot(struct bracket_next *out, double s, const char *why)
{
    *out = (struct bracket_next){ .exposure_s = s };
    snprintf(out->why, sizeof(out->why), "%s", why);
    return 0;
}

static double dark_snr(const struct bracket_statistics *s, const struct sensor_noise *n)
{
    double worst = INFINITY;
    for (int c = 0; c < 3; c++)
        if (s->n_sites[c]) {
            const double e = fmax(s->first_percentile[c], 0) * n->electrons_at_white;
            worst = fmin(worst, e > 0 ? e / sqrt(e + n->read_noise_e * n->read_noise_e) : 0);
        }
    return worst;
}

int bracket_next(struct bracket_next *out, const struct bracket_plan *plan, const struct bracket_statistics *so_far, int n)
{
    static const char *const colour[] = { "red", "green", "blue" };
    const double step = exp2(plan->step_ev > 0 ? plan->step_ev : 2), snr = plan->snr > 0 ? plan->snr : 10;
    const int max_frames = plan->max_frames > 0 ? plan->max_frames : 15;
    const struct sensor_noise careful = { .electrons_at_white = 20000, .read_noise_e = 8 };
    const struct sensor_noise *noise = plan->noise.electrons_at_white > 0 ? &plan->noise : &careful;
    char why[160], time[32], most[32];
    *out = (struct bracket_next){ 0 };
    if (!(plan->shortest_s > 0 && plan->shortest_s <= plan->longest_s && plan->longest_s < 1e5 && plan->metered_s > 0) || n < 0)
        return -EINVAL;
    if (n == 0)
        return shoot(out, fmin(fmax(plan->metered_s, plan->shortest_s), plan->longest_s), "the metered exposure");
    const struct bracket_statistics *shortest = so_far, *longest = so_far;
    int n_shortest = 0, worst = 0;
    for (int i = 0; i < n; i++) {
        if (!(so_far[i].exposure_s > 0))
            return -EINVAL;
        if (so_far[i].exposure_s < shortest->exposure_s)
            shortest = so_far + i;
        if (so_far[i].exposure_s > longest->exposure_s)
            longest = so_far + i;
    }
    for (int i = 0; i < n; i++)
        n_shortest += so_far[i].exposure_s < 1.01 * shortest->exposure_s;
    for (int c = 1; c < 3; c++)
        if (shortest->n_over[c] > shortest->n_over[worst])
            worst = c;
    const bool clips = shortest->n_over[worst] > 0;
    say_time(time, sizeof(time), shortest->exposure_s);
    if (n < max_frames && clips && shortest->exposure_s > 1.01 * plan->shortest_s) {
        snprintf(why, sizeof(why), "at %s %lld %s sites of a light are above 90 %% of white", time, (long long)shortest->n_over[worst], colour[worst]);
        return shoot(out, fmax(shortest->exposure_s / step, plan->shortest_s), why);
    }
    const double snr_now = dark_snr(longest, noise);
    if (n < max_frames && snr_now < snr && longest->exposure_s * 1.01 < plan->longest_s) {
        say_time(most, sizeof(most), longest->exposure_s);
        snprintf(why, sizeof(why), "at %s the darkest percent has a signal-to-noise ratio of %.1f: %g is wanted", most, snr_now, snr);
        return shoot(out, fmin(longest->exposure_s * step, plan->longest_s), why);
    }
    if (n < max_frames && plan->repeat_shortest && n_shortest < 2)
        return shoot(out, shortest->exposure_s, "the shortest once more: does a lamp flicker?");
    out->is_done = true;
    out->needs_nd = clips;
    out->too_dark = snr_now < snr;
    if (clips) { // of a sensor that is full, no more can be told than that it is
        out->nd_ev_at_least = ceil(fmax(log2(shortest->brightest[worst] / usable), .01));
        snprintf(out->why, sizeof(out->why), "at %s, the shortest %s, %lld %s sites of a light still clip: a neutral-density filter of at least %g EV is needed",
                 time, n >= max_frames ? "so far" : "possible", (long long)shortest->n_over[worst], colour[worst], out->nd_ev_at_least);
    } else if (out->too_dark) {
        snprintf(out->why, sizeof(out->why), "no light clips; the darkest percent stays at a signal-to-noise ratio of %.1f", snr_now);
    } else {
        snprintf(out->why, sizeof(out->why), "no light clips at %s, and the darkest percent has a signal-to-noise ratio of %.1f", time, snr_now);
    }
    return 0;
}
