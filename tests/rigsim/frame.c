// tests/rigsim/frame.c - see frame.h. A raw is made row by row as it is read; nothing of it is kept but the last row.
#include "tests/rigsim/frame.h"
#include "solver/random.h"
#include "tests/rigsim/jpeg.h"
#include "tests/rigsim/raw_dng.h"

#include <errno.h>
#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

enum { STREAM_NOISE = 0x6e6f69, STREAM_GAIN = 0x6761696e, NORMALS = 4096, JPEG_WIDTH = 640, THUMB_WIDTH = 160, FOCAL_MM = 50 };

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "rows go into the file as they lie in memory");

struct frame {
    struct scene *scene;
    unsigned camera;
    struct raw_dng dng;      // raw
    struct dataset jpeg;     // JPEG
    uint64_t noise_seed;     // of this shot
    struct scene_view view;
    float electrons[3];      // per scene value 1: R, G, B
    float dn_per_electron, read_variance;
    float black, white;
    int row_y; // of which row is; -1: none
    float *site;
    uint16_t *row;
};

// The quantiles of the standard normal in the middle of NORMALS equal parts: 12 random bits make a normal number with one load.
static float normals[NORMALS];
static pthread_once_t normals_once = PTHREAD_ONCE_INIT;

static void make_normals(void)
{
    for (int i = 0; i < NORMALS; i++) {
        const double p = (i + .5) / NORMALS;
        double lo = -6, hi = 6;
        for (int k = 0; k < 60; k++) {
            const double middle = .5 * (lo + hi);
            if (.5 * erfc(-middle * M_SQRT1_2) < p)
                lo = middle;
            else
                hi = middle;
        }
        normals[i] = (float)lo;
    }
}

static void make_row(struct frame *f, int y)
{
    const int width = scene_width(f->scene, f->camera);
    const float k[2] = { f->electrons[y & 1], f->electrons[1 + (y & 1)] };
    const uint64_t row_seed = random_u64(f->noise_seed, STREAM_NOISE, (uint64_t)y);
    scene_row(f->scene, f->camera, &f->view, y, f->site);
    for (int x = 0; x < width; x += 4) {
        const uint64_t bits = random_mix(row_seed + (uint64_t)x);
        for (int i = 0; i < 4 && x + i < width; i++) {
            float e = f->site[x + i] * k[i & 1];
            e = e > 0 ? e : 0;
            const float z = normals[bits >> (12 * i) & (NORMALS - 1)];
            float dn = f->black + f->dn_per_electron * (e + sqrtf(e + f->read_variance) * z) + .5f;
            dn = dn < 0 ? 0 : dn > f->white ? f->white : dn;
            f->row[x + i] = (uint16_t)dn;
        }
    }
    f->row_y = y;
}

static struct raw_dng_info describe(const struct scene *scene, const struct body *b, const struct exposure *e)
{
    const struct personality *p = b->personality;
    struct raw_dng_info i = { .width_px = scene_width(scene, b->index), .height_px = scene_height(scene, b->index),
                              .black_level = p->black_level, .white_level = p->white_level, .make = p->manufacturer,
                              .model = p->model, .lens = p->lens, .serial = b->serial, .firmware = p->firmware,
                              .time_s = e->time_s, .f_number = e->f_number, .focal_mm = FOCAL_MM, .iso = e->iso,
                              .utc_ns = e->utc_ns };
    memcpy(i.wb, p->wb, sizeof(i.wb));
    return i;
}

// How much light an exposure gathers, 1 at the personality's reference, without ISO.
static double relative_exposure(const struct personality *p, const struct exposure *e)
{
    return e->time_s / p->t_ref_s * (p->n_ref / e->f_number) * (p->n_ref / e->f_number);
}

// Of this body, channel c: lens, filter and sensor are never quite the same twice.
static double body_gain(const struct body *b, int c)
{
    return exp(b->personality->gain_spread * random_normal(b->seed, STREAM_GAIN, 3 * (uint64_t)b->index + (uint64_t)c));
}

static uint8_t srgb8(double v)
{
    v = v <= 0 ? 0 : v >= 1 ? 1 : v <= .0031308 ? 12.92 * v : 1.055 * pow(v, 1 / 2.4) - .055;
    return (uint8_t)(v * 255 + .5);
}

// The frame at a fraction of its size: one cell of four sites per pixel.
static int develop(struct dataset *out, struct scene *scene, const struct body *b, const struct exposure *e, int width)
{
    const int sensor_width = scene_width(scene, b->index), sensor_height = scene_height(scene, b->index);
    if (width > sensor_width / 2)
        width = sensor_width / 2;
    const int height = (int)((int64_t)width * sensor_height / sensor_width) > 0 ? (int)((int64_t)width * sensor_height / sensor_width) : 1;
    const double k = relative_exposure(b->personality, e) * e->iso / 100;
    uint8_t *rgb = malloc((size_t)width * (size_t)height * 3);
    float *site = malloc(2 * (size_t)sensor_width * sizeof(float));
    int err = -ENOMEM;
    for (int y = 0; rgb && site && y < height; y++) {
        const int sy = (int)((int64_t)y * sensor_height / height) & ~1;
        scene_row(scene, b->index, &e->view, sy, site);
        scene_row(scene, b->index, &e->view, sy + 1, site + sensor_width);
        for (int x = 0; x < width; x++) {
            const int sx = (int)((int64_t)x * sensor_width / width) & ~1;
            uint8_t *to = rgb + ((size_t)y * (size_t)width + (size_t)x) * 3;
            to[0] = srgb8(k * (double)site[sx]);
            to[1] = srgb8(k * .5 * ((double)site[sx + 1] + (double)site[sensor_width + sx]));
            to[2] = srgb8(k * (double)site[sensor_width + sx + 1]);
        }
    }
    if (rgb && site)
        err = jpeg_encode(out, rgb, width, height);
    free(rgb);
    free(site);
    return err;
}

int frame_open(struct frame **out, struct scene *scene, const struct body *b, const struct exposure *e, int file)
{
    const struct personality *p = b->personality;
    struct frame *f = calloc(1, sizeof(*f));
    int err = -ENOMEM;
    if (!f)
        return -ENOMEM;
    pthread_once(&normals_once, make_normals);
    *f = (struct frame){ .scene = scene, .camera = b->index, .view = e->view, .row_y = -1, .black = (float)p->black_level,
                         .white = (float)p->white_level, .noise_seed = random_u64(b->seed, b->index, e->shot),
                         .read_variance = (float)(p->read_noise_e * p->read_noise_e) };
    f->dn_per_electron = (float)((p->white_level - p->black_level) / p->full_well_e * e->iso / 100);
    for (int c = 0; c < 3; c++)
        f->electrons[c] = (float)(p->full_well_e * p->wb[c] * relative_exposure(p, e) * body_gain(b, c));
    if (file == FILES_JPEG) {
        err = develop(&f->jpeg, scene, b, e, JPEG_WIDTH);
    } else {
        const struct raw_dng_info info = describe(scene, b, e);
        f->site = malloc((size_t)scene_width(scene, b->index) * sizeof(float));
        f->row = malloc((size_t)scene_width(scene, b->index) * sizeof(uint16_t));
        err = f->site && f->row ? raw_dng_make(&f->dng, &info) : -ENOMEM;
    }
    if (err) {
        frame_close(f);
        return err;
    }
    *out = f;
    return 0;
}

uint64_t frame_size(const struct frame *f)
{
    return f->jpeg.n ? f->jpeg.n : f->dng.n_head + f->dng.n_pixel_bytes + f->dng.n_tail;
}

void frame_read(struct frame *f, uint64_t offset, uint8_t *to, size_t n)
{
    if (f->jpeg.n) {
        memcpy(to, f->jpeg.data + offset, n);
        return;
    }
    const uint64_t row_bytes = (uint64_t)scene_width(f->scene, f->camera) * 2, pixels_at = f->dng.n_head,
                   tail_at = pixels_at + f->dng.n_pixel_bytes;
    while (n) {
        size_t part;
        if (offset < pixels_at) {
            part = pixels_at - offset < n ? (size_t)(pixels_at - offset) : n;
            memcpy(to, f->dng.head + offset, part);
        } else if (offset >= tail_at) {
            part = n;
            memcpy(to, f->dng.tail + (offset - tail_at), part);
        } else {
            const uint64_t in = offset - pixels_at, at = in % row_bytes;
            const int y = (int)(in / row_bytes);
            if (y != f->row_y)
                make_row(f, y);
            part = row_bytes - at < n ? (size_t)(row_bytes - at) : n;
            memcpy(to, (const uint8_t *)f->row + at, part);
        }
        to += part;
        offset += part;
        n -= part;
    }
}

void frame_close(struct frame *f)
{
    if (!f)
        return;
    raw_dng_free(&f->dng);
    dataset_free(&f->jpeg);
    free(f->site);
    free(f->row);
    free(f);
}

uint64_t frame_measure(void *arg, const struct body *b, const struct exposure *e, int file)
{
    struct frame *f;
    if (frame_open(&f, arg, b, e, file))
        return 0;
    const uint64_t n = frame_size(f);
    frame_close(f);
    return n;
}

int frame_thumbnail(void *arg, const struct body *b, const struct body_object *o, struct dataset *out)
{
    return develop(out, arg, b, &o->exposure, THUMB_WIDTH);
}
