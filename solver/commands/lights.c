// solver/commands/lights.c - rigsolve lights: cut a panorama into N lights, say what came of it,
// draw it.
#include "solver/commands/arguments.h"
#include "solver/commands/commands.h"
#include "solver/commands/output.h"
#include "solver/lights.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <argp.h>
#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct arguments {
    const char *panorama, *output, *overlay;
    int n;
    double exposure_ev;
    bool json;
};

enum { OPTION_OVERLAY = 256, OPTION_EXPOSURE, OPTION_JSON };

static const struct argp_option options[] = {
    {"lights", 'n', "N", 0, "How many: a power of two from 1 to 65536 (default 256)", 0},
    {"output", 'o', "FILE", 0, "Write the lights here (JSON); required", 0},
    {"overlay", OPTION_OVERLAY, "FILE.png", 0,
     "Draw the panorama with the regions' borders and a dot at every light's direction", 0},
    {"exposure", OPTION_EXPOSURE, "EV", 0,
     "Brighten (or darken) the overlay by so many stops (default 0: from the picture itself)", 0},
    {"json", OPTION_JSON, NULL, 0, "Print the summary as JSON", 0},
    {0},
};

static error_t parse(int key, char *text, struct argp_state *state)
{
    struct arguments *a = state->input;
    switch (key) {
    case 'n':
        a->n = argument_power_of_two(state, "-n", text, LIGHTS_MAX);
        return 0;
    case 'o':
        a->output = text;
        return 0;
    case OPTION_OVERLAY:
        a->overlay = text;
        return 0;
    case OPTION_EXPOSURE:
        a->exposure_ev = argument_number(state, "--exposure", text, "stops", -40, 40);
        return 0;
    case OPTION_JSON:
        a->json = true;
        return 0;
    case ARGP_KEY_ARG:
        if (state->arg_num > 0)
            argp_error(state, "one panorama at a time: '%s' is too many", text);
        a->panorama = text;
        return 0;
    case ARGP_KEY_END:
        if (!a->panorama)
            argp_error(state, "which PANORAMA?");
        if (!a->output)
            argp_error(state, "where to? give -o lights.json");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static const struct argp argp = {
    options,
    parse,
    "PANORAMA -n N -o lights.json",
    "Cut a latitude-longitude HDR panorama into N lights of about equal energy (median cut).\v"
    "PANORAMA is OpenEXR, Radiance HDR or linear TIFF, twice as wide as high, +Y up, its middle "
    "looking along +Z, its left edge at longitude +180 degrees. The output lists for every light "
    "its "
    "direction in the probe's frame, its irradiance (radiance times solid angle, RGB) and its "
    "rectangle of the panorama. All lights are directional, and where they are in the world is not "
    "said, until a solve has found it.",
    NULL,
    NULL,
    NULL,
};

// ---- the summary --------------------------------------------------------------------------------

enum { N_STRONGEST = 5, PLATEAU_PX = 16 };

struct summary {
    double before[3], after[3], relative_difference; // sum of radiance x solid angle
    int n_empty;
    double peak, mean; // luminance; mean over the sphere
    int plateau_px;    // longest run in a row of pixels with a channel at the very maximum
    int plateau_x, plateau_y;
    int n_strongest, strongest[N_STRONGEST];
};

static double luminance(double r, double g, double b)
{
    return .2126 * r + .7152 * g + .0722 * b;
}

static double light_luminance(const struct lights *l, int i)
{
    return luminance(l->irradiance[i][0], l->irradiance[i][1], l->irradiance[i][2]);
}

static double total_luminance(const struct summary *s)
{
    return luminance(s->after[0], s->after[1], s->after[2]);
}

static void look_at_pixels(struct summary *s, const struct image *image)
{
    float highest = 0;
    const int64_t n = 3 * (int64_t)image->width * image->height;
    for (int64_t i = 0; i < n; i++)
        highest = image->data[i] > highest ? image->data[i] : highest;
    for (int y = 0; y < image->height; y++) {
        int run = 0;
        for (int x = 0; x < image->width; x++) {
            const float *v = image->data + 3 * ((int64_t)y * image->width + x);
            s->peak = fmax(s->peak, luminance(v[0], v[1], v[2]));
            run = v[0] == highest || v[1] == highest || v[2] == highest ? run + 1 : 0;
            if (run > s->plateau_px)
                s->plateau_px = run, s->plateau_x = x - run + 1, s->plateau_y = y;
        }
    }
}

static void summarise(struct summary *s, const struct panorama *p, const struct lights *l)
{
    memset(s, 0, sizeof(*s));
    panorama_total(p, s->before);
    look_at_pixels(s, &p->image);
    for (int i = 0; i < l->n; i++) {
        for (int c = 0; c < 3; c++)
            s->after[c] += l->irradiance[i][c];
        const double energy = light_luminance(l, i);
        s->n_empty += energy <= 0;
        int at = s->n_strongest; // insertion: stronger first, equal ones in their order
        while (at > 0 && light_luminance(l, s->strongest[at - 1]) < energy)
            at--;
        if (at == N_STRONGEST || energy <= 0)
            continue;
        if (s->n_strongest < N_STRONGEST)
            s->n_strongest++;
        memmove(s->strongest + at + 1, s->strongest + at,
                (size_t)(s->n_strongest - 1 - at) * sizeof(s->strongest[0]));
        s->strongest[at] = i;
    }
    for (int c = 0; c < 3; c++)
        if (s->before[c] > 0)
            s->relative_difference =
                fmax(s->relative_difference, fabs(s->after[c] / s->before[c] - 1));
    s->mean = luminance(s->before[0], s->before[1], s->before[2]) / (4 * M_PI);
}

static int print_text(const struct summary *s, const struct arguments *a, const struct lights *l)
{
    printf("panorama   %s: %dx%d px, brightest pixel %.4g = %.3g x the mean\n", a->panorama,
           l->panorama_width_px, l->panorama_height_px, s->peak, s->peak / s->mean);
    printf("lights     %d (%d of them empty) -> %s\n", l->n, s->n_empty, a->output);
    printf("energy     R %.6g  G %.6g  B %.6g radiance x sr; changed by %.1e of itself\n",
           s->after[0], s->after[1], s->after[2], s->relative_difference);
    printf("strongest  light  share of energy  direction in the probe    spread\n");
    for (int k = 0; k < s->n_strongest; k++) {
        const int i = s->strongest[k];
        const double *d = l->dir_probe[i];
        printf("           %5d  %13.3f %%  %6.3f %6.3f %6.3f  %8.2f deg\n", i,
               100 * light_luminance(l, i) / total_luminance(s), d[0], d[1], d[2],
               l->spread_rad[i] * 180 / M_PI);
    }
    if (a->overlay)
        printf("overlay    %s\n", a->overlay);
    return output_flush("lights");
}

static int print_json(const struct summary *s, const struct arguments *a, const struct lights *l)
{
    struct json *doc = json_object(), *list = json_array();
    json_set_string(doc, "panorama", a->panorama);
    json_set_int(doc, "width_px", l->panorama_width_px);
    json_set_int(doc, "height_px", l->panorama_height_px);
    json_set_int(doc, "n_lights", l->n);
    json_set_int(doc, "n_empty", s->n_empty);
    json_set_numbers(doc, "energy_before", s->before, 3);
    json_set_numbers(doc, "energy_after", s->after, 3);
    json_set_number(doc, "relative_difference", s->relative_difference);
    json_set_number(doc, "peak_luminance", s->peak);
    json_set_number(doc, "mean_luminance", s->mean);
    json_set_int(doc, "longest_plateau_px", s->plateau_px);
    for (int k = 0; k < s->n_strongest; k++) {
        const int i = s->strongest[k];
        struct json *light = json_object();
        json_set_int(light, "light", i);
        json_set_number(light, "share", light_luminance(l, i) / total_luminance(s));
        json_set_numbers(light, "dir_probe", l->dir_probe[i], 3);
        json_set_numbers(light, "irradiance", l->irradiance[i], 3);
        json_set_number(light, "spread_rad", l->spread_rad[i]);
        json_append(list, light);
    }
    json_set(doc, "strongest", list);
    json_set_string(doc, "output", a->output);
    if (a->overlay)
        json_set_string(doc, "overlay", a->overlay);
    return output_json("lights", doc);
}

// ---- the overlay --------------------------------------------------------------------------------

enum { OVERLAY_MIN_WIDTH = 2048 };

static const double border_rgb[3] = {255, 140, 0}, dot_rgb[3] = {0, 230, 255},
                    rim_rgb[3] = {0, 0, 0};

struct canvas {
    int width, height, scale; // scale: canvas pixels per panorama pixel
    uint8_t *rgb;
};

static void blend(const struct canvas *v, int x, int y, const double rgb[3], double opacity)
{
    if (x < 0 || y < 0 || x >= v->width || y >= v->height || opacity <= 0)
        return;
    uint8_t *at = v->rgb + 3 * ((size_t)y * (size_t)v->width + (size_t)x);
    for (int c = 0; c < 3; c++)
        at[c] = (uint8_t)lround(at[c] + opacity * (rgb[c] - at[c]));
}

// Reinhard's global curve: the log-average goes to middle grey, the brightest pixel to white, so
// that walls and lamps are both seen. Colours that would pass white lose saturation.
static void paint_panorama(const struct canvas *v, const struct panorama *p,
                           const struct summary *s, double exposure_ev)
{
    const int width = p->image.width, height = p->image.height;
    double sum_log = 0, sphere = 0;
    for (int y = 0; y < height; y++) {
        double row = 0;
        for (int x = 0; x < width; x++) {
            const float *rgb = p->image.data + 3 * ((int64_t)y * width + x);
            row += log(luminance(rgb[0], rgb[1], rgb[2]) + 1e-4 * s->mean);
        }
        sum_log += row * panorama_solid_angle(width, height, y);
        sphere += width * panorama_solid_angle(width, height, y);
    }
    const double gain = .18 * exp2(exposure_ev) / exp(sum_log / sphere),
                 white = fmax(gain * s->peak, 1);
    for (int y = 0; y < height; y++) {
        for (int x = 0; x < width; x++) {
            const float *rgb = p->image.data + 3 * ((int64_t)y * width + x);
            const double lum = luminance(rgb[0], rgb[1], rgb[2]), bright = gain * lum;
            const double shown = bright * (1 + bright / (white * white)) / (1 + bright);
            const double ratio = lum > 0 ? shown / lum : 0;
            const double top = ratio * fmax(rgb[0], fmax(rgb[1], rgb[2]));
            const double grey = top > 1 ? (top - 1) / (top - fmin(shown, 1) + 1e-9) : 0;
            uint8_t byte[3];
            for (int c = 0; c < 3; c++)
                byte[c] = image_srgb_byte(ratio * rgb[c] + grey * (shown - ratio * rgb[c]));
            for (int j = 0; j < v->scale; j++)
                for (int i = 0; i < v->scale; i++)
                    memcpy(v->rgb +
                               3 * (((size_t)y * (size_t)v->scale + (size_t)j) * (size_t)v->width +
                                    (size_t)x * (size_t)v->scale + (size_t)i),
                           byte, 3);
        }
    }
}

static void paint_dot(const struct canvas *v, double x, double y, double radius)
{
    const int reach = (int)radius + 2;
    for (int j = (int)y - reach; j <= (int)y + reach; j++)
        for (int i = (int)x - reach; i <= (int)x + reach; i++) {
            const double distance = hypot(i + .5 - x, j + .5 - y);
            blend(v, i, j, rim_rgb, fmin(radius + 1.5 - distance, 1));
            blend(v, i, j, dot_rgb, fmin(radius + .5 - distance, 1));
        }
}

static void paint_lights(const struct canvas *v, const struct lights *l)
{
    for (int i = 0; i < l->n; i++) { // every region draws its left and upper border
        const struct light_region *r = &l->region[i];
        const int x0 = r->x0 * v->scale, y0 = r->y0 * v->scale, x1 = r->x1 * v->scale,
                  y1 = r->y1 * v->scale;
        for (int x = x0; x < x1; x++)
            blend(v, x, y0, border_rgb, .7);
        for (int y = y0 + 1; y < y1 && x0 < x1; y++)
            blend(v, x0, y, border_rgb, .7);
    }
    for (int i = 0; i < l->n; i++) {
        const struct light_region *r = &l->region[i];
        const int side = v->scale * (r->x1 - r->x0 < r->y1 - r->y0 ? r->x1 - r->x0 : r->y1 - r->y0);
        double x, y;
        if (light_luminance(l, i) <= 0)
            continue;
        panorama_pixel(l->panorama_width_px, l->panorama_height_px, l->dir_probe[i], &x, &y);
        paint_dot(v, x * v->scale, y * v->scale, fmin(fmax(side / 10., .7), 4));
    }
}

static int write_overlay(const struct arguments *a, const struct panorama *p,
                         const struct lights *l, const struct summary *s)
{
    const int scale = (OVERLAY_MIN_WIDTH + p->image.width - 1) / p->image.width;
    struct canvas v = {p->image.width * scale, p->image.height * scale, scale, NULL};
    v.rgb = malloc(3 * (size_t)v.width * (size_t)v.height);
    if (!v.rgb) {
        log_error("lights: no memory for an overlay of %dx%d", v.width, v.height);
        return -ENOMEM;
    }
    paint_panorama(&v, p, s, a->exposure_ev);
    paint_lights(&v, l);
    const int err = image_write_png(a->overlay, v.width, v.height, 3, v.rgb);
    free(v.rgb);
    return err;
}

int command_lights(int argc, char **argv)
{
    struct arguments a = {.n = 256};
    struct panorama p = {0};
    struct lights l = {0};
    struct summary s;
    argp_parse(&argp, argc, argv, 0, NULL, &a);

    int err = panorama_read(&p, a.panorama);
    if (!err)
        err = lights_median_cut(&l, &p, a.n);
    if (err)
        goto done;
    summarise(&s, &p, &l);
    if (s.plateau_px > PLATEAU_PX)
        log_warning("lights: %s: %d pixels in a row at exactly the highest value (from column %d, "
                    "row %d): if this "
                    "is a photograph, its lamps are clipped and too dark: add a shorter exposure",
                    a.panorama, s.plateau_px, s.plateau_x, s.plateau_y);
    err = lights_write_json(&l, a.output);
    if (!err && a.overlay)
        err = write_overlay(&a, &p, &l, &s);
    if (err)
        goto done;
    err = a.json ? print_json(&s, &a, &l) : print_text(&s, &a, &l);
done:
    lights_free(&l);
    panorama_free(&p);
    return err ? EXIT_FAILED : EXIT_DONE;
}
