// rigd/plateau.c - the DN at which photosites pile up: histograms per colour, judged from their upper end.
#include "rigd/plateau.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>

enum { DN_COUNT = 65536, BINS = 1024, LEAST_SITES = 64 }; // bins of black .. white

static int64_t sum(const uint32_t *h, int from, int to)
{
    int64_t n = 0;
    for (int i = from < 0 ? 0 : from; i < to && i < DN_COUNT; i++)
        n += h[i];
    return n;
}

// One DN, above which there is none. Light that merely ends there thins out.
static int pile_of(const uint32_t *h, double saturation)
{
    int top = DN_COUNT - 1;
    for (; top > 0 && !h[top]; top--)
        ;
    const int64_t at_top = sum(h, top - 1, top + 1), below = sum(h, top - 65, top - 1);
    return top < saturation && top > .5 * saturation && at_top >= 32 && at_top > 8 * below / 32 ? top : 0;
}

struct hump {
    int64_t n;
    double centre, spread; // DN above black: median; standard deviation, of its lower or its upper part (which white may cut off)
};

// h: sites of one colour by DN above black; all: of the three. False: this colour has none.
static bool hump_of(struct hump *out, const uint32_t *h, const uint32_t all[3][DN_COUNT], double range)
{
    const double bin = range / BINS;
    int64_t count[BINS + 1] = { 0 };
    for (int i = 0; i < DN_COUNT && i <= range; i++)
        count[(int)(i / bin)] += h[i];
    int peak = BINS / 2;
    for (int k = peak; k <= BINS; k++)
        if (count[k] > count[peak])
            peak = k;
    // Within 1.5 % of white lies the hump; the 9 % of white below that are what light alone leaves there.
    const int half = (int)ceil(.015 * range), middle = (int)((peak + .5) * bin), width = 2 * half, far = (int)(.09 * range);
    const int64_t n = sum(h, middle - half, middle + half), below = sum(h, middle - half - far, middle - half);
    int64_t beyond = 0;
    for (int c = 0; c < 3; c++)
        beyond += sum(all[c], middle + half, DN_COUNT);
    if (n < LEAST_SITES || beyond > n / 100 || (double)n / width < 8 * (double)below / far)
        return false;
    const double reached[3] = { .25, .5, .84 };
    double at[3] = { 0 };
    int64_t so_far = 0;
    for (int k = 0, i = middle - half; k < 3 && i < DN_COUNT; i++) {
        so_far += sum(h, i, i + 1);
        for (; k < 3 && (double)so_far >= reached[k] * (double)n; k++)
            at[k] = i;
    }
    *out = (struct hump){ .n = n, .centre = at[1], .spread = fmax(at[2] - at[1], (at[1] - at[0]) / .674) };
    return true;
}

int plateau_find(struct plateau *out, const struct raw_frame *f)
{
    const size_t n = (size_t)f->width * (size_t)f->height;
    uint32_t *all = calloc(DN_COUNT, sizeof(*all)), (*above_black)[DN_COUNT] = calloc(3, sizeof(*above_black));
    struct plateau p = { 0 };
    int err = -ENOMEM, n_humps = 0;
    *out = p;
    if (!all || !above_black)
        goto end;
    for (size_t i = 0; i < n; i++) {
        const int x = (int)(i % (size_t)f->width) & 1, y = (int)(i / (size_t)f->width) & 1;
        const long v = lrint(f->site[i] - f->black[y][x]);
        all[f->site[i]]++;
        if (v > 0)
            above_black[f->cfa[y][x]][v]++;
    }
    err = 0;
    p.dn = p.top = pile_of(all, f->saturation);
    int64_t n_above = 0;
    for (p.reached = DN_COUNT - 1; p.reached > 0 && (n_above += all[p.reached]) < LEAST_SITES; p.reached--)
        ;
    const double black = f->black[0][0], range = f->white - black;
    struct hump hump[3];
    for (int c = 0; c < 3 && !p.dn; c++)
        n_humps += hump_of(&hump[n_humps], above_black[c], (const uint32_t(*)[DN_COUNT])above_black, range);
    for (int a = 0; a < n_humps && !p.dn; a++)
        for (int b = a + 1; b < n_humps && !p.dn; b++) {
            const double spread = fmax(hump[a].spread, hump[b].spread), foot = black + fmin(hump[a].centre, hump[b].centre) - 4 * spread;
            if (fabs(hump[a].centre - hump[b].centre) <= .003 * range && spread <= .006 * range && foot < f->saturation)
                p.dn = (int)foot, p.top = (int)(black + fmax(hump[a].centre, hump[b].centre) + 6 * spread);
        }
end:
    free(all);
    free(above_black);
    if (!err)
        *out = p;
    return err;
}
