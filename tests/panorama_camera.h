// tests/panorama_camera.h - a camera on a panorama head, simulated: what each photosite sees of a known panorama, and the raws it gives.
//
// Independent of rigd/stitch.c: sites are integrated by samples (lens_ray, nearest texel), not by cutting polygons. The sensor: electrons
// Poisson, read noise normal, DN = black + gain x electrons, rounded, clipped at white.
#pragma once
#include "rigd/bracket.h"
#include "rigd/lens.h"
#include "solver/panorama.h"
#include "solver/parallel.h"
#include "solver/random.h"
#include "solver/vec3.h"
#include "tests/rigsim/raw_dng.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct sim_camera {
    struct lens lens;
    double yaw_deg, pitch_deg, roll_deg;
    double black, white, clip; // DN; clip: where it really clips (0: white)
    double clip_spread;        // DN; standard deviation of that over the sites: wells that are full before the converter ends
    double electrons_at_white, read_noise_e; // at ISO 100
    double response[3];        // of R, G, B to radiance 1: raw signal y = response x radiance x h
    double f_number;
    int iso;
    uint64_t seed;
};

static const struct sim_camera sim_usual = { .black = 512, .white = 16383, .electrons_at_white = 60000, .read_noise_e = 4,
                                             .response = { .5, 1, .625 }, .f_number = 8, .iso = 100, .seed = 1 };

struct sim_seeing {
    const struct image *panorama;
    const struct sim_camera *camera;
    int n; // samples a side
    double R[9];
    float *site;
};

static inline void sim_see_rows(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct sim_seeing *s = arg;
    const struct lens *l = &s->camera->lens;
    (void)worker;
    for (int64_t y = begin; y < end; y++)
        for (int x = 0; x < l->width_px; x++) {
            const int c = (y & 1) + (x & 1); // RGGB
            double sum = 0;
            for (int k = 0; k < s->n * s->n; k++) {
                const double px[2] = { x + (k % s->n + .5) / s->n, (double)y + (k / s->n + .5) / s->n };
                double d[3], probe[3], u, v;
                if (!lens_ray(l, px, d))
                    continue;
                mat3_mul_vec(probe, s->R, d);
                panorama_pixel(s->panorama->width, s->panorama->height, probe, &u, &v);
                const int row = v >= s->panorama->height ? s->panorama->height - 1 : (int)v;
                sum += (double)s->panorama->data[((size_t)row * (size_t)s->panorama->width + (size_t)u) * (size_t)s->panorama->n_channels + (size_t)c];
            }
            s->site[(size_t)y * (size_t)l->width_px + (size_t)x] = (float)(sum / (s->n * s->n) * s->camera->response[c] * lens_shading(l, (double[2]){ x + .5, (double)y + .5 }));
        }
}

// Raw radiance (response x radiance) of every site, malloc'd.
static inline float *sim_see(const struct image *panorama, const struct sim_camera *camera, int samples_a_side)
{
    struct sim_seeing s = { .panorama = panorama, .camera = camera, .n = samples_a_side };
    lens_head(s.R, camera->yaw_deg * M_PI / 180, camera->pitch_deg * M_PI / 180, camera->roll_deg * M_PI / 180);
    s.site = malloc((size_t)camera->lens.width_px * (size_t)camera->lens.height_px * sizeof(*s.site));
    if (s.site)
        parallel_for(0, camera->lens.height_px, 8, sim_see_rows, &s);
    return s.site;
}

// Photoelectrons of mean e: Poisson by inversion where few, normal (rounded) where many.
static inline double sim_electrons(double e, uint64_t seed, uint64_t shot, uint64_t site)
{
    if (e <= 0)
        return 0;
    if (e > 200)
        return fmax(floor(e + sqrt(e) * random_normal(seed, 2 * shot, site) + .5), 0);
    double u = random_uniform(seed, 2 * shot, 2 * site), p = exp(-e), n = 0;
    while (u > p && n < 1000) {
        u -= p;
        p *= e / ++n;
    }
    return n;
}

static inline double sim_exposure(const struct sim_camera *c, double time_s)
{
    return time_s * c->iso / 100. / (c->f_number * c->f_number);
}

struct sim_shot {
    struct raw_frame *frame;
    const float *seen;
    const struct sim_camera *camera;
    double h;
    uint64_t shot;
};

static inline void sim_expose_rows(void *arg, int64_t begin, int64_t end, int worker)
{
    const struct sim_shot *s = arg;
    const struct sim_camera *c = s->camera;
    const double at_iso = c->iso / 100., dn = (c->white - c->black) / c->electrons_at_white * at_iso, clip = c->clip > 0 ? c->clip : c->white;
    (void)worker;
    for (int64_t y = begin; y < end; y++)
        for (int x = 0; x < c->lens.width_px; x++) {
            const size_t i = (size_t)y * (size_t)c->lens.width_px + (size_t)x;
            const double e = sim_electrons((double)s->seen[i] * s->h / at_iso * c->electrons_at_white, c->seed, s->shot, i) +
                             c->read_noise_e * random_normal(c->seed, 2 * s->shot + 1, i);
            const double full = c->clip_spread > 0 ? clip + c->clip_spread * random_normal(c->seed, UINT64_MAX, i) : clip;
            s->frame->site[i] = (uint16_t)fmin(fmax(floor(fmin(c->black + dn * e, full) + .5), 0), c->white);
        }
}

// A frame as raw_read would give it; sites malloc'd (free(out->site)). shot names its noise. gain: light, or shutter, that is not as it says.
static inline int sim_expose(struct raw_frame *out, const float *seen, const struct sim_camera *c, double time_s, double gain, uint64_t shot)
{
    *out = (struct raw_frame){ .width = c->lens.width_px, .height = c->lens.height_px, .cfa = { { 0, 1 }, { 1, 2 } },
                               .black = { { c->black, c->black }, { c->black, c->black } }, .white = c->white, .saturation = c->white,
                               .label_s = time_s, .exposure_s = time_s, .f_number = c->f_number, .iso = c->iso, .orientation = 1,
                               .make = "Sim", .model = "Head", .serial = "1", .daylight = { 1 / c->response[0], 1 / c->response[1], 1 / c->response[2] },
                               .srgb_from_camera = { { 1, 0, 0 }, { 0, 1, 0 }, { 0, 0, 1 } } };
    out->site = malloc((size_t)out->width * (size_t)out->height * sizeof(*out->site));
    if (!out->site)
        return -1;
    struct sim_shot s = { .frame = out, .seen = seen, .camera = c, .h = sim_exposure(c, time_s) * gain, .shot = shot };
    parallel_for(0, out->height, 8, sim_expose_rows, &s);
    return 0;
}

// The frame as a DNG. label_s: what its EXIF says.
static inline int sim_write_dng(const struct raw_frame *f, const struct sim_camera *c, const char *path, double label_s, const char *serial, int64_t utc_ns)
{
    const struct raw_dng_info info = { .width_px = f->width, .height_px = f->height, .black_level = (int)c->black, .white_level = (int)c->white,
                                       .wb = { c->response[0], c->response[1], c->response[2] }, .make = "Studiorig", .model = "Head 1", .lens = "Fisheye",
                                       .serial = serial, .firmware = "1", .time_s = label_s, .f_number = c->f_number, .focal_mm = 8, .iso = c->iso, .utc_ns = utc_ns };
    struct raw_dng d;
    if (raw_dng_make(&d, &info))
        return -1;
    FILE *to = fopen(path, "wb");
    const bool ok = to && fwrite(d.head, 1, d.n_head, to) == d.n_head && fwrite(f->site, 1, d.n_pixel_bytes, to) == d.n_pixel_bytes &&
                    fwrite(d.tail, 1, d.n_tail, to) == d.n_tail;
    raw_dng_free(&d);
    return (to && fclose(to) != 0) || !ok ? -1 : 0;
}

// A panorama's mean over k x k texels: by solid angle.
static inline int sim_shrink(struct image *out, const struct image *p, int k)
{
    if (image_new(out, p->width / k, p->height / k, 3, NULL))
        return -1;
    for (int y = 0; y < out->height; y++)
        for (int x = 0; x < out->width; x++) {
            double sum[3] = { 0 }, area = 0;
            for (int v = 0; v < k; v++) {
                const double w = panorama_solid_angle(p->width, p->height, y * k + v);
                for (int u = 0; u < k; u++)
                    for (int c = 0; c < 3; c++)
                        sum[c] += w * (double)p->data[((size_t)(y * k + v) * (size_t)p->width + (size_t)(x * k + u)) * (size_t)p->n_channels + (size_t)c];
                area += k * w;
            }
            for (int c = 0; c < 3; c++)
                out->data[((size_t)y * (size_t)out->width + (size_t)x) * 3 + (size_t)c] = (float)(sum[c] / area);
        }
    return 0;
}

// A studio to test with: grey room with a gradient, a large and a small lamp, a coloured wall; a range of 1 : 20,000. W = 2H.
static inline int sim_studio(struct image *out, int width)
{
    if (image_new(out, width, width / 2, 3, NULL))
        return -1;
    for (int y = 0; y < out->height; y++)
        for (int x = 0; x < width; x++) {
            float *p = out->data + ((size_t)y * (size_t)width + (size_t)x) * 3;
            double d[3];
            panorama_direction(width, out->height, x + .5, y + .5, d);
            const double base = .05 + .03 * d[1] + .012 * sin(3 * d[0]) * cos(2 * d[2]);
            p[0] = (float)(base * (d[0] > .5 ? 1.6 : 1)), p[1] = (float)base, p[2] = (float)(base * (d[2] < -.5 ? 1.5 : 1));
            if (fabs(d[0] / d[2] + .3) < .25 && fabs(d[1] / d[2] - .6) < .2 && d[2] > 0)
                p[0] = 180, p[1] = 200, p[2] = 210; // a soft box
            const double lamp[3] = { .8, .5, -.3316625 };
            if (vec3_dot(d, lamp) > cos(.04))
                p[0] = 1100, p[1] = 900, p[2] = 600;
        }
    return 0;
}
