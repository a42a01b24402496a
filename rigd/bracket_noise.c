// rigd/bracket_noise.c - a sensor's gain and read noise from two frames of one scene (photon transfer without flat targets).
//
// Of two frames of exposures a h and h, the difference d = y_a - a y_b of one site has no picture in it, only noise:
//   var d = m (1 + a) / w + (s / w)^2 (1 + a^2),  m the signal in the longer frame.
// What moved, and lamps that flicker, shift d of neighbours alike: what is looked at is d minus the mean of d two sites to the left and
// right (of the same colour), whose variance is 1.5 times as large. Sites are sorted into classes of m; each class's variance is taken without what is further than four sigmas from its middle (edges of
// what moved), beginning with the median absolute deviation; the two unknowns from a weighted straight line through the classes.
#include "rigd/bracket.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { CLASSES = 24, CLASS_MOST = 8192, CLASS_LEAST = 200 };

static int compare(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

static double median(float *v, int n)
{
    qsort(v, (size_t)n, sizeof(*v), compare);
    return n & 1 ? (double)v[n / 2] : .5 * ((double)v[n / 2 - 1] + (double)v[n / 2]);
}

// Of the values within four sigmas, until that settles. v is sorted on return.
static double variance_of(float *v, int n)
{
    float *away = malloc((size_t)n * sizeof(*away));
    if (!away)
        return -1;
    double middle = median(v, n);
    for (int i = 0; i < n; i++)
        away[i] = fabsf(v[i] - (float)middle);
    double sigma = 1.482602 * median(away, n);
    free(away);
    for (int round = 0; round < 8; round++) {
        double sum = 0, squares = 0;
        int kept = 0;
        for (int i = 0; i < n; i++) {
            const double d = (double)v[i] - middle;
            if (fabs(d) <= 4 * sigma)
                kept++, sum += d, squares += d * d;
        }
        const double mean = sum / kept;
        middle += mean;
        sigma = sqrt(squares / kept - mean * mean);
    }
    return sigma * sigma;
}

// Rounding puts differences on a grid, which a median follows: one step of uniform noise, taken off the variance again, hides it.
static double dither(uint64_t i)
{
    i = (i ^ (i >> 30)) * 0xbf58476d1ce4e5b9u;
    i = (i ^ (i >> 27)) * 0x94d049bb133111ebu;
    return (double)((i ^ (i >> 31)) >> 11) * 0x1p-53 - .5;
}

struct noise_class {
    int n;
    double m;
    float d[CLASS_MOST];
};

struct pair {
    const struct raw_frame *a, *b;
    double ratio;
};

// d and m of one site; false where one of them is near saturation.
static bool difference(const struct pair *p, size_t i, double black_a, double black_b, double *d, double *m)
{
    const double full = p->a->white - black_a;
    if (p->a->site[i] > black_a + .9 * (p->a->saturation - black_a) || p->b->site[i] > black_b + .9 * (p->b->saturation - black_b))
        return false;
    const double ya = (p->a->site[i] - black_a + dither(2 * i)) / full, yb = (p->b->site[i] - black_b + dither(2 * i + 1)) / full;
    *d = ya - p->ratio * yb;
    *m = (ya + yb) * p->ratio / (1 + p->ratio);
    return true;
}

static void collect(struct noise_class *classes, const struct pair *p)
{
    const size_t width = (size_t)p->a->width, n = width * (size_t)p->a->height;
    const size_t stride = n > 4 << 20 ? (n / (4 << 20)) | 1 : 1; // odd: every colour, every column
    for (size_t i = 0; i < n; i += stride) {
        const size_t y = i / width, x = i % width;
        const double black_a = p->a->black[y & 1][x & 1], black_b = p->b->black[y & 1][x & 1];
        double d[3], m[3];
        if (x < 2 || x + 2 >= width || !difference(p, i - 2, black_a, black_b, d, m) || !difference(p, i, black_a, black_b, d + 1, m + 1) ||
            !difference(p, i + 2, black_a, black_b, d + 2, m + 2))
            continue;
        const double mean = .5 * m[1] + .25 * (m[0] + m[2]);
        const int k = mean > 0 ? CLASSES - 1 + (int)floor(2 * log2(mean)) : 0; // half stops below white
        struct noise_class *c = classes + (k < 0 ? 0 : k >= CLASSES ? CLASSES - 1 : k);
        if (c->n < CLASS_MOST) {
            c->d[c->n++] = (float)(d[1] - .5 * (d[0] + d[2]));
            c->m += (4 * m[1] + m[0] + m[2]) / 6; // as the variances add up
        }
    }
}

int sensor_noise_measure(struct sensor_noise *out, const struct raw_frame *a, const struct raw_frame *b)
{
    *out = (struct sensor_noise){ 0 };
    if (bracket_exposure(a) < bracket_exposure(b)) {
        const struct raw_frame *t = a;
        a = b;
        b = t;
    }
    const double ratio = bracket_exposure(a) / bracket_exposure(b);
    if (!(ratio >= 1 && ratio < 8.5) || a->width != b->width || a->height != b->height || memcmp(a->cfa, b->cfa, sizeof(a->cfa)) != 0)
        return -ENODATA;
    struct noise_class *classes = calloc(CLASSES, sizeof(*classes));
    if (!classes)
        return -ENOMEM;
    collect(classes, &(struct pair){ a, b, ratio });
    double m[CLASSES], v[CLASSES], weight[CLASSES];
    int n = 0;
    for (int k = 0; k < CLASSES; k++) {
        struct noise_class *c = classes + k;
        if (c->n < CLASS_LEAST)
            continue;
        m[n] = fmax(c->m / c->n, 0) * (1 + ratio);
        v[n] = variance_of(c->d, c->n) / 1.5;
        if (v[n] < 0) {
            free(classes);
            return -ENOMEM;
        }
        weight[n++] = c->n;
    }
    free(classes);
    if (n < 3 || !(m[n - 1] > 4 * m[0]))
        return -ENODATA;
    double gain = 0, floor_ = 0; // v = gain m + floor
    for (int round = 0; round < 12; round++) {
        double w = 0, wm = 0, wv = 0, wmm = 0, wmv = 0;
        for (int i = 0; i < n; i++) {
            const double expected = round ? gain * m[i] + floor_ : v[i], above = fmax(v[i] / fmax(expected, 1e-30) / 1.05, 1);
            const double k = weight[i] / fmax(expected * expected, 1e-30) / pow(above, 8); // a class with more than noise in it hardly counts
            w += k, wm += k * m[i], wv += k * v[i], wmm += k * m[i] * m[i], wmv += k * m[i] * v[i];
        }
        const double det = w * wmm - wm * wm;
        gain = det > 0 ? (w * wmv - wm * wv) / det : 0;
        floor_ = (wv - gain * wm) / w;
        if (floor_ < 0) {
            floor_ = 0;
            gain = wmv / wmm;
        }
    }
    if (!(gain > 1e-9 && gain < 1))
        return -ENODATA;
    const double full = a->white - a->black[0][0], dithered = 1 / (12 * full * full);
    const double read = fmax(floor_ / (1 + ratio * ratio) - dithered, 0);
    *out = (struct sensor_noise){ .electrons_at_white = 1 / gain, .read_noise_e = sqrt(read) / gain };
    return 0;
}
