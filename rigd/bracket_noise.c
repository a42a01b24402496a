// rigd/bracket_noise.c - a sensor's gain and read noise from two frames of one scene (photon transfer without flat targets).
//
// Of two frames of exposures a h and h, the difference d = y_a - a y_b of one site has no picture in it, only noise:
//   var d = m (1 + a) / w + (s / w)^2 (1 + a^2),  m the signal in the longer frame.
// Sites are sorted into classes of m; each class's variance is taken from its median absolute deviation, which what moved between the
// frames hardly touches, and the two unknowns from a weighted straight line through the classes.
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

static void collect(struct noise_class *classes, const struct raw_frame *a, const struct raw_frame *b, double ratio)
{
    const size_t n = (size_t)a->width * (size_t)a->height;
    const size_t stride = n > 4 << 20 ? (n / (4 << 20)) | 1 : 1; // odd: every colour, every column
    for (size_t i = 0; i < n; i += stride) {
        const size_t y = i / (size_t)a->width, x = i % (size_t)a->width;
        const double black_a = a->black[y & 1][x & 1], black_b = b->black[y & 1][x & 1], full = a->white - black_a;
        if (a->site[i] > black_a + .9 * (a->saturation - black_a) || b->site[i] > black_b + .9 * (b->saturation - black_b))
            continue;
        const double ya = (a->site[i] - black_a + dither(2 * i)) / full, yb = (b->site[i] - black_b + dither(2 * i + 1)) / full;
        const double m = (ya + yb) * ratio / (1 + ratio);
        const int k = m > 0 ? CLASSES - 1 + (int)floor(2 * log2(m)) : 0; // half stops below white
        struct noise_class *c = classes + (k < 0 ? 0 : k >= CLASSES ? CLASSES - 1 : k);
        if (c->n < CLASS_MOST) {
            c->d[c->n++] = (float)(ya - ratio * yb);
            c->m += m;
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
    collect(classes, a, b, ratio);
    double m[CLASSES], v[CLASSES], weight[CLASSES];
    int n = 0;
    for (int k = 0; k < CLASSES; k++) {
        struct noise_class *c = classes + k;
        if (c->n < CLASS_LEAST)
            continue;
        const double middle = median(c->d, c->n);
        for (int i = 0; i < c->n; i++)
            c->d[i] = fabsf(c->d[i] - (float)middle);
        const double sigma = 1.482602 * median(c->d, c->n);
        m[n] = fmax(c->m / c->n, 0) * (1 + ratio);
        v[n] = sigma * sigma;
        weight[n++] = c->n;
    }
    free(classes);
    if (n < 3 || !(m[n - 1] > 4 * m[0]))
        return -ENODATA;
    double gain = 0, floor_ = 0; // v = gain m + floor
    for (int round = 0; round < 4; round++) {
        double w = 0, wm = 0, wv = 0, wmm = 0, wmv = 0;
        for (int i = 0; i < n; i++) {
            const double expected = round ? gain * m[i] + floor_ : v[i], k = weight[i] / fmax(expected * expected, 1e-30);
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
