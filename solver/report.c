// solver/report.c - report.html: what a solve found, for people.
//
// The page is written front to back into a stream: verdict, warnings, pictures, maps, lights, tables. Everything that comes from a
// file is escaped.
#include "solver/report.h"
#include "solver/disney.h"
#include "solver/take/atomic_file.h"
#include "solver/vec3.h"

#include <errno.h>
#include <locale.h>
#include <stdlib.h>
#include <string.h>

enum { THUMBNAIL_PX = 256, MAX_REGIONS = 12, DRAWING_PX = 440 };

// ---- text -----------------------------------------------------------------------------------------------------------------

static void put_escaped(FILE *f, const char *text)
{
    for (; *text; text++)
        switch (*text) {
        case '&':
            fputs("&amp;", f);
            break;
        case '<':
            fputs("&lt;", f);
            break;
        case '>':
            fputs("&gt;", f);
            break;
        case '"':
            fputs("&quot;", f);
            break;
        default:
            fputc(*text, f);
        }
}

static void put_base64(FILE *f, const uint8_t *bytes, size_t n)
{
    static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    for (size_t i = 0; i < n; i += 3) {
        const uint32_t v = (uint32_t)bytes[i] << 16 | (i + 1 < n ? (uint32_t)bytes[i + 1] << 8 : 0) | (i + 2 < n ? bytes[i + 2] : 0);
        fputc(digits[v >> 18], f);
        fputc(digits[v >> 12 & 63], f);
        fputc(i + 1 < n ? digits[v >> 6 & 63] : '=', f);
        fputc(i + 2 < n ? digits[v & 63] : '=', f);
    }
}

static double number_of(const struct json *v, const char *path)
{
    double out;
    return v && !json_get_number(v, path, &out) ? out : NAN;
}

// ---- pictures -------------------------------------------------------------------------------------------------------------

// The same of the n channels that are named by their numbers.
static int shrink(struct image *out, const struct image *image, const int *channel, int n, int width, int height)
{
    const char *names[IMAGE_MAX_CHANNELS];
    for (int c = 0; c < n; c++)
        names[c] = image->names[channel[c]];
    const int err = image_new(out, width, height, n, names);
    if (err)
        return err;
    const double sx = (double)image->width / width, sy = (double)image->height / height;
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
            double sum[IMAGE_MAX_CHANNELS] = { 0 };
            for (int j = (int)(y * sy); j < image->height && j < (y + 1) * sy; j++)
                for (int i = (int)(x * sx); i < image->width && i < (x + 1) * sx; i++) {
                    const double w = (fmin(i + 1, (x + 1) * sx) - fmax(i, x * sx)) * (fmin(j + 1, (y + 1) * sy) - fmax(j, y * sy));
                    const float *p = image->data + ((size_t)j * (size_t)image->width + (size_t)i) * (size_t)image->n_channels;
                    for (int c = 0; c < n; c++)
                        sum[c] += w * (double)p[channel[c]];
                }
            for (int c = 0; c < n; c++)
                out->data[((size_t)y * (size_t)width + (size_t)x) * (size_t)n + (size_t)c] = (float)(sum[c] / (sx * sy));
        }
    return 0;
}

int report_shrink(struct image *out, const struct image *image, int width, int height)
{
    int all[IMAGE_MAX_CHANNELS];
    for (int c = 0; c < image->n_channels; c++)
        all[c] = c;
    return shrink(out, image, all, image->n_channels, width, height);
}

int report_photograph(struct image *out, struct camera *small, const struct image *picture, const struct camera *camera)
{
    static const char *const names[] = { "R", "G", "B" };
    const int width = picture->width < REPORT_PICTURE_PX ? picture->width : REPORT_PICTURE_PX;
    const int height = (int)((int64_t)picture->height * width / picture->width);
    int channel[3];
    bool usable = camera_has_aspect(camera, picture->width, picture->height);
    *out = (struct image){ 0 };
    for (int c = 0; c < 3; c++)
        usable &= (channel[c] = image_channel(picture, names[c])) >= 0;
    if (!usable)
        return -EINVAL;
    *small = *camera;
    camera_resize(small, width, height > 0 ? height : 1);
    return shrink(out, picture, channel, 3, small->width_px, small->height_px);
}

static uint8_t byte_of(double v)
{
    return (uint8_t)lround(255 * fmin(fmax(v, 0), 1));
}

// <figure> with n_channels of bytes as a PNG; the caption is HTML.
static int put_figure(FILE *f, const char *class, int width, int height, int n_channels, const uint8_t *pixels, const char *alt,
                      const char *caption)
{
    uint8_t *png;
    size_t n;
    const int err = image_encode_png(&png, &n, width, height, n_channels, pixels);
    if (err)
        return err;
    fprintf(f, "<figure class=\"%s\"><img alt=\"", class);
    put_escaped(f, alt);
    fprintf(f, "\" width=\"%d\" height=\"%d\" src=\"data:image/png;base64,", width, height);
    put_base64(f, png, n);
    fprintf(f, "\"><figcaption>%s</figcaption></figure>\n", caption);
    free(png);
    return 0;
}

static const float *pixel_of(const struct image *image, size_t i)
{
    return image->data + i * (size_t)image->n_channels;
}

static int by_value(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

// What the brightest percent of the object's pixels is multiplied with to be shown nearly white: one number for all views.
static double find_exposure(const struct report_source *s)
{
    size_t n = 0, most = 0;
    for (int v = 0; v < s->n_views; v++)
        most += (size_t)s->view[v].render.width * (size_t)s->view[v].render.height;
    float *value = malloc((most + 1) * sizeof(*value));
    if (!value)
        return 1;
    for (int v = 0; v < s->n_views; v++)
        for (size_t i = 0; i < (size_t)s->view[v].render.width * (size_t)s->view[v].render.height; i++) {
            const float *p = pixel_of(&s->view[v].render, i);
            if (p[3] > .5f)
                value[n++] = fmaxf(p[0], fmaxf(p[1], p[2]));
        }
    qsort(value, n, sizeof(*value), by_value);
    const double bright = n ? (double)value[n - 1 - n / 100] : 0;
    free(value);
    return bright > 0 ? .85 / bright : 1;
}

bool report_set_aside(const struct json *report, const char *view)
{
    const int n = report ? json_length(report, "views_held_out") : 0;
    for (int i = 0; i < n; i++) {
        char key[48];
        const char *name;
        snprintf(key, sizeof(key), "views_held_out.%d", i);
        if (!json_get_string(report, key, &name) && !strcmp(name, view))
            return true;
    }
    return false;
}

static int put_view(FILE *f, const struct report_view *v, bool set_aside, double exposure)
{
    const int width = v->input.width, height = v->input.height;
    const size_t n = (size_t)width * (size_t)height;
    uint8_t *bytes = malloc(3 * n * 3);
    double sum = 0;
    int64_t n_inside = 0;
    char caption[256];
    if (!bytes)
        return -ENOMEM;
    for (size_t i = 0; i < n; i++) {
        const float *input = pixel_of(&v->input, i), *render = pixel_of(&v->render, i);
        const bool inside = render[3] > .999f;
        for (int c = 0; c < 3; c++) {
            const double difference = (double)render[c] - (double)input[c];
            const double clipped = fmin(fmax((double)render[c], 0), 1) - fmin(fmax((double)input[c], 0), 1);
            bytes[3 * i + (size_t)c] = image_srgb_byte(exposure * (double)input[c]);
            bytes[3 * (n + i) + (size_t)c] = image_srgb_byte(exposure * (double)render[c]);
            bytes[3 * (2 * n + i) + (size_t)c] = byte_of(inside ? .5 + 4 * exposure * difference : .5);
            sum += inside ? clipped * clipped : 0;
        }
        n_inside += inside;
    }
    fputs("<h3>", f);
    put_escaped(f, v->name);
    fprintf(f, "%s</h3><div class=\"row\">\n", set_aside ? " <small>(set aside: not used for solving)</small>" : "");
    int err = put_figure(f, "third", width, height, 3, bytes, "the photograph", "the photograph");
    if (!err)
        err = put_figure(f, "third", width, height, 3, bytes + 3 * n, "the re-render", "what was solved, rendered");
    if (n_inside)
        snprintf(caption, sizeof(caption), "difference &times; 4; grey: none, lighter: the render is too bright. RMSE %.2f %% inside the outline",
                 100 * sqrt(sum / (3. * (double)n_inside)));
    else
        snprintf(caption, sizeof(caption), "difference: the object is not in this picture");
    if (!err)
        err = put_figure(f, "third", width, height, 3, bytes + 6 * n, "the difference", caption);
    fputs("</div>\n", f);
    free(bytes);
    return err;
}

static int put_views(FILE *f, const struct report_source *s)
{
    int err = 0;
    if (!s->n_views)
        return 0;
    const double exposure = find_exposure(s);
    fputs("<h2>Pictures</h2>\n", f);
    fprintf(f, "<p>%d of the views, all shown %.2g times as bright as measured. Small pictures; the RMSE is of these.</p>\n", s->n_views,
            exposure);
    for (int i = 0; !err && i < s->n_views; i++)
        err = put_view(f, &s->view[i], report_set_aside(s->report, s->view[i].name), exposure);
    return err;
}

// ---- maps -----------------------------------------------------------------------------------------------------------------

// One channel as a grey thumbnail, from least to most; colour: the first three, with the sRGB curve.
static int put_map(FILE *f, const struct image *map, int channel, bool colour, double most, const char *name, const char *note)
{
    struct image small = { 0 };
    const int side = map->width < THUMBNAIL_PX ? map->width : THUMBNAIL_PX;
    char caption[256];
    uint8_t *bytes = NULL;
    const int n = colour ? 3 : 1, shown[] = { channel, channel + 1, channel + 2 };
    int err = shrink(&small, map, shown, n, side, side);
    if (!err) {
        bytes = malloc((size_t)side * (size_t)side * (size_t)n);
        err = bytes ? 0 : -ENOMEM;
    }
    for (size_t i = 0; !err && i < (size_t)side * (size_t)side * (size_t)n; i++)
        bytes[i] = colour ? image_srgb_byte((double)small.data[i] / most) : byte_of((double)small.data[i] / most);
    snprintf(caption, sizeof(caption), "%s<br><small>%s</small>", name, note);
    if (!err)
        err = put_figure(f, "map", side, side, n, bytes, name, caption);
    free(bytes);
    image_free(&small);
    return err;
}

// Range over what is not empty: layers are 0 outside the atlas, where albedo is 0 too.
static void find_range(const struct report_source *s, const struct image *map, int channel, double *least, double *most)
{
    *least = INFINITY, *most = -INFINITY;
    const bool same = s->albedo->width == map->width && s->albedo->height == map->height;
    for (size_t i = 0; i < (size_t)map->width * (size_t)map->height; i++) {
        const float *a = same ? pixel_of(s->albedo, i) : NULL;
        const double v = (double)pixel_of(map, i)[channel];
        if ((a && !(a[0] > 0) && !(a[1] > 0) && !(a[2] > 0)) || !isfinite(v))
            continue;
        *least = fmin(*least, v), *most = fmax(*most, v);
    }
    if (!(*least <= *most))
        *least = *most = 0;
}

static int put_layers(FILE *f, const struct report_source *s, const struct image *map, bool uncertainty)
{
    int err = 0;
    for (int p = 0; !err && p < DISNEY_N; p++) {
        const int channel = image_channel(map, disney_parameter_names[p]);
        double least, most;
        char note[64];
        if (channel < 0)
            continue;
        find_range(s, map, channel, &least, &most);
        snprintf(note, sizeof(note), uncertainty ? "%.3f to %.3f; white: .3" : least < most ? "%.3f to %.3f" : "%.3f everywhere", least, most);
        if (uncertainty || least < most)
            err = put_map(f, map, channel, false, uncertainty ? .3 : 1, disney_parameter_names[p], note);
    }
    return err;
}

static int put_maps(FILE *f, const struct report_source *s)
{
    int err = 0;
    if (!s->albedo)
        return 0;
    fputs("<h2>Maps</h2>\n<p>Black is 0, white is 1. A parameter that is one number everywhere is in the table of materials below.</p>"
          "<div class=\"row\">\n", f);
    if (s->albedo->n_channels >= 3)
        err = put_map(f, s->albedo, 0, true, 1, "albedo", "sRGB");
    if (!err && s->parameters)
        err = put_layers(f, s, s->parameters, false);
    fputs("</div>\n", f);
    if (!err && (s->std || s->validity)) {
        fputs("<h3>How sure</h3><p>Standard deviations, and where texels were seen at all.</p><div class=\"row\">\n", f);
        if (s->validity)
            err = put_map(f, s->validity, 0, false, 1, "validity", "white: enough views; grey: few; black: filled from neighbours, or no surface");
        if (!err && s->std)
            err = put_layers(f, s, s->std, true);
        fputs("</div>\n", f);
    }
    return err;
}

// ---- the set-up of the lights ---------------------------------------------------------------------------------------------

// A drawing looks along one of the world's axes; right and up are where the other two go.
struct drawing {
    double right[3], up[3], centre_m[3], scale; // pixels per metre
};

static void place(const struct drawing *d, const double point_m[3], double out[2])
{
    double away[3];
    vec3_sub(away, point_m, d->centre_m);
    out[0] = DRAWING_PX / 2. + d->scale * vec3_dot(away, d->right);
    out[1] = DRAWING_PX / 2. - d->scale * vec3_dot(away, d->up);
}

static int by_place(const void *a, const void *b)
{
    const double *p = a, *q = b;
    return p[0] != q[0] ? (p[0] > q[0]) - (p[0] < q[0]) : (p[1] > q[1]) - (p[1] < q[1]);
}

static double turns(const double a[2], const double b[2], const double c[2])
{
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
}

// The outline of the object's convex hull (Andrew's monotone chain).
static int draw_object(FILE *f, const struct drawing *d, const struct mesh *m)
{
    const size_t n = (size_t)m->n_vertices;
    double(*p)[2] = malloc(n * sizeof(*p)), (*hull)[2] = malloc((2 * n + 1) * sizeof(*hull));
    size_t k = 0;
    if (!p || !hull) {
        free(p);
        free(hull);
        return -ENOMEM;
    }
    for (size_t i = 0; i < n; i++) {
        const double point_m[3] = { m->position_m[i][0], m->position_m[i][1], m->position_m[i][2] };
        place(d, point_m, p[i]);
    }
    qsort(p, n, sizeof(*p), by_place);
    for (size_t i = 0; i < n; i++) {
        while (k >= 2 && turns(hull[k - 2], hull[k - 1], p[i]) <= 0)
            k--;
        memcpy(hull[k++], p[i], sizeof(*p));
    }
    const size_t lower = k + 1;
    for (size_t i = n - 1; i-- > 0;) {
        while (k >= lower && turns(hull[k - 2], hull[k - 1], p[i]) <= 0)
            k--;
        memcpy(hull[k++], p[i], sizeof(*p));
    }
    fputs("<polygon class=\"object\" points=\"", f);
    for (size_t i = 0; i < k; i++)
        fprintf(f, "%.1f,%.1f ", hull[i][0], hull[i][1]);
    fputs("\"/>\n", f);
    free(p);
    free(hull);
    return 0;
}

static double energy(const struct lights *l, int i)
{
    return .2126 * l->irradiance[i][0] + .7152 * l->irradiance[i][1] + .0722 * l->irradiance[i][2];
}

static void light_place(const struct lights *l, int i, double far_m, double out[3])
{
    double dir[3];
    mat3_mul_vec(dir, l->world_from_probe, l->dir_probe[i]);
    for (int c = 0; c < 3; c++)
        out[c] = l->centre_m[c] + (l->inverse_distance[i] > 0 ? fmin(1 / l->inverse_distance[i], far_m) : far_m) * dir[c];
}

static void draw_lights(FILE *f, const struct drawing *d, const struct lights *l, double far_m)
{
    double total = 0;
    for (int i = 0; i < l->n; i++)
        total += energy(l, i);
    for (int i = 0; i < l->n; i++) {
        const double *c = l->irradiance[i], most = fmax(c[0], fmax(c[1], c[2]));
        double point_m[3], at[2];
        if (!(most > 0))
            continue;
        light_place(l, i, far_m, point_m);
        place(d, point_m, at);
        const bool far = !(l->inverse_distance[i] > 0) || 1 / l->inverse_distance[i] > far_m;
        fprintf(f, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"%.1f\" fill=\"#%02x%02x%02x\"%s/>\n", at[0], at[1],
                1.5 + 40 * sqrt(energy(l, i) / total / 16), image_srgb_byte(c[0] / most), image_srgb_byte(c[1] / most), image_srgb_byte(c[2] / most),
                far ? " class=\"far\"" : "");
    }
}

static int draw(FILE *f, const struct report_source *s, const struct drawing *d, double far_m, const char *caption)
{
    double at[2];
    fprintf(f, "<figure class=\"half\"><svg viewBox=\"0 0 %d %d\" role=\"img\" aria-label=\"%s\">\n<rect width=\"%d\" height=\"%d\"/>\n", DRAWING_PX,
            DRAWING_PX, caption, DRAWING_PX, DRAWING_PX);
    const int err = s->mesh ? draw_object(f, d, s->mesh) : 0;
    for (int i = 0; s->cameras && i < s->cameras->n; i++) {
        const struct camera *c = &s->cameras->view[i];
        double ahead[3], tip[2];
        for (int k = 0; k < 3; k++)
            ahead[k] = c->centre_m[k] + .06 * DRAWING_PX / d->scale * c->cam_from_world[6 + k];
        place(d, c->centre_m, at);
        place(d, ahead, tip);
        fprintf(f, "<path class=\"camera\" d=\"M%.1f %.1fL%.1f %.1f\"/><circle class=\"camera\" cx=\"%.1f\" cy=\"%.1f\" r=\"2\"/>\n", at[0], at[1],
                tip[0], tip[1], at[0], at[1]);
    }
    draw_lights(f, d, s->lights, far_m);
    place(d, s->lights->centre_m, at);
    fprintf(f, "<path class=\"probe\" d=\"M%.1f %.1fh16m-8 -8v16\"/>\n", at[0] - 8, at[1]);
    fprintf(f, "<path class=\"scale\" d=\"M14 %dh%.1f\"/><text x=\"14\" y=\"%d\">1 m</text>\n</svg><figcaption>%s</figcaption></figure>\n",
            DRAWING_PX - 12, d->scale, DRAWING_PX - 18, caption);
    return err;
}

static int compare_numbers(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static int put_lights(FILE *f, const struct report_source *s)
{
    const struct lights *l = s->lights;
    if (!l || !l->n)
        return 0;
    double *distance = malloc((size_t)l->n * sizeof(*distance));
    if (!distance)
        return -ENOMEM;
    int n_near = 0, n_lit = 0;
    for (int i = 0; i < l->n; i++) {
        n_lit += energy(l, i) > 0;
        if (energy(l, i) > 0 && l->inverse_distance[i] > 0)
            distance[n_near++] = 1 / l->inverse_distance[i];
    }
    qsort(distance, (size_t)n_near, sizeof(*distance), compare_numbers);
    const double median = n_near ? distance[n_near / 2] : 0, far_m = n_near ? 1.2 * distance[n_near * 9 / 10] : 3;
    double reach = 1.1 * far_m;
    for (int i = 0; s->cameras && i < s->cameras->n; i++) {
        double away[3];
        vec3_sub(away, s->cameras->view[i].centre_m, l->centre_m);
        reach = fmax(reach, fmin(1.1 * vec3_norm(away), 3 * far_m));
    }
    struct drawing above = { .scale = DRAWING_PX / 2. / reach }, side = above;
    const double *r = l->world_from_probe, probe_up[3] = { r[1], r[4], r[7] };
    int axis = 1;
    for (int c = 0; c < 3; c++)
        axis = fabs(probe_up[c]) > fabs(probe_up[axis]) ? c : axis;
    double up[3] = { 0 }, ahead[3] = { 0 }, right[3];
    up[axis] = probe_up[axis] < 0 ? -1 : 1;
    ahead[(axis + 2) % 3] = 1;
    vec3_cross(right, ahead, up);
    memcpy(above.centre_m, l->centre_m, sizeof(above.centre_m)), memcpy(side.centre_m, l->centre_m, sizeof(side.centre_m));
    memcpy(above.right, right, sizeof(right)), memcpy(above.up, ahead, sizeof(ahead));
    memcpy(side.right, right, sizeof(right)), memcpy(side.up, up, sizeof(up));
    fputs("<h2>Where the lights are</h2>\n<p>A dot is a light, its area its share of the energy, its colour the light's. ", f);
    fprintf(f, "%d lights send energy", n_lit);
    if (n_near)
        fprintf(f, "; the median distance from the panorama's place is %.2f m", median);
    if (n_near < n_lit)
        fprintf(f, "; %d are so far that only their direction counts", n_lit - n_near);
    fputs(". Blue: the cameras and where they look. Outlined: the object. Cross: where the panorama was taken. Hollow dots lie further out than "
          "drawn.</p>\n<div class=\"row\">\n", f);
    free(distance);
    int err = draw(f, s, &above, far_m, "from above");
    if (!err)
        err = draw(f, s, &side, far_m, "from the side");
    fputs("</div>\n", f);
    return err;
}

// ---- tables ---------------------------------------------------------------------------------------------------------------

static void put_row(FILE *f, const char *name, const char *format, double value)
{
    if (!isfinite(value))
        return;
    fprintf(f, "<tr><th>%s</th><td>", name);
    fprintf(f, format, value);
    fputs("</td></tr>\n", f);
}

static void put_text_row(FILE *f, const struct json *report, const char *name, const char *key)
{
    const char *text;
    if (!report || json_get_string(report, key, &text))
        return;
    fprintf(f, "<tr><th>%s</th><td>", name);
    put_escaped(f, text);
    fputs("</td></tr>\n", f);
}

static void put_verdict(FILE *f, const struct report_source *s)
{
    const struct json *r = s->report;
    bool trusted = false;
    const bool known = r && !json_get_bool(r, "trusted", &trusted);
    if (known)
        fprintf(f, "<p class=\"verdict %s\">%s</p>\n", trusted ? "good" : "bad",
                trusted ? "This result can be used." : "This result is not to be trusted: see below why.");
    fputs("<table class=\"figures\">\n", f);
    put_row(f, "error in views that were fitted", "%.2f %%", number_of(r, "rmse_fit_percent"));
    put_row(f, "error in views that were set aside", "%.2f %%", number_of(r, "rmse_held_out_percent"));
    put_row(f, "views", "%.0f", number_of(r, "n_views"));
    put_row(f, "lights", "%.0f", number_of(r, "n_lights"));
    put_row(f, "texture, texels a side", "%.0f", number_of(r, "texture"));
    put_row(f, "time", "%.0f s", number_of(r, "wall_s"));
    fputs("</table>\n", f);
}

static void put_warnings(FILE *f, const struct report_source *s)
{
    const struct json *r = s->report;
    const int n = r ? json_length(r, "warnings") : 0;
    const double fit = number_of(r, "rmse_fit_percent"), aside = number_of(r, "rmse_held_out_percent"),
                 clipped = number_of(r, "clipped_share"), unseen = number_of(r, "stages.materials.n_unobserved") / number_of(r, "stages.materials.n_texels");
    fputs("<h2>Warnings</h2>\n<ul class=\"warnings\">\n", f);
    int n_put = 0;
    for (int i = 0; i < n; i++, n_put++) {
        char key[32];
        const char *text = "";
        snprintf(key, sizeof(key), "warnings.%d", i);
        (void)json_get_string(r, key, &text);
        fputs("<li>", f);
        put_escaped(f, text);
        fputs("</li>\n", f);
    }
    if (aside > 1.2 * fit && ++n_put)
        fprintf(f, "<li>Views that were set aside fit %.1f times worse than the others: details of the maps are noise that was fitted. More views, or "
                   "a smaller texture, help.</li>\n", aside / fit);
    if (clipped > .01 && ++n_put)
        fprintf(f, "<li>%.1f %% of the measurements were clipped (too bright for the cameras) and not used: highlights are known less well. Expose "
                   "less.</li>\n", 100 * clipped);
    if (unseen > .05 && ++n_put)
        fprintf(f, "<li>%.0f %% of the surface was seen by no camera well enough: its values are its neighbours'.</li>\n", 100 * unseen);
    if (!n_put)
        fputs("<li class=\"none\">None.</li>\n", f);
    fputs("</ul>\n", f);
}

static void put_cell(FILE *f, const struct json *r, const char *prefix, const char *parameter)
{
    char key[96];
    const char *freedom;
    snprintf(key, sizeof(key), "%stheta.%s", prefix, parameter);
    const double value = number_of(r, key);
    snprintf(key, sizeof(key), "%stheta_std.%s", prefix, parameter);
    const double std = number_of(r, key);
    fputs("<td>", f);
    if (isfinite(value))
        fprintf(f, "%.3f", value);
    if (isfinite(std))
        fprintf(f, " &plusmn; %.3f", std);
    snprintf(key, sizeof(key), "%smodel.%s", prefix, parameter);
    if (!json_get_string(r, key, &freedom)) {
        fputs(" <small>", f);
        put_escaped(f, freedom);
        fputs("</small>", f);
    }
    fputs("</td>", f);
}

static void put_materials(FILE *f, const struct report_source *s)
{
    const struct json *r = s->report;
    const char *brdf = "";
    if (!r)
        return;
    (void)json_get_string(r, "brdf", &brdf);
    const int n = json_length(r, "stages.materials.regions"), n_columns = n > MAX_REGIONS ? MAX_REGIONS : n;
    fputs("<h2>Materials</h2>\n", f);
    if (!strcmp(brdf, "lambert")) {
        fputs("<p>The object was solved as diffuse (Lambert): the albedo is all there is.</p>\n", f);
        return;
    }
    if (n > 0) {
        fprintf(f, "<p>%d region%s of like material. <i>free</i>: varies from texel to texel; <i>tied</i>: one number for the region; <i>frozen</i>: the "
                   "pictures say nothing about it, it keeps the shared value.%s</p>\n", n, n == 1 ? "" : "s", n > n_columns ? " The first ones:" : "");
    } else if (json_get(r, "theta")) {
        fputs("<p>One material for the whole object.</p>\n", f);
    } else {
        fputs("<p>The report names no regions: the maps above say what varies.</p>\n", f);
        return;
    }
    fputs("<div class=\"scroll\"><table><tr><th></th>", f);
    if (n <= 0)
        fputs("<td>everywhere</td>", f);
    for (int k = 0; k < n_columns; k++) {
        char key[64];
        snprintf(key, sizeof(key), "stages.materials.regions.%d.n_texels", k);
        fprintf(f, "<td><b>region %d</b><br><small>%.0f texels</small></td>", k, number_of(r, key));
    }
    fputs("</tr>\n", f);
    for (int p = 0; p < DISNEY_N; p++) {
        fprintf(f, "<tr><th>%s</th>", disney_parameter_names[p]);
        if (n <= 0)
            put_cell(f, r, "", disney_parameter_names[p]);
        for (int k = 0; k < n_columns; k++) {
            char prefix[48];
            snprintf(prefix, sizeof(prefix), "stages.materials.regions.%d.", k);
            put_cell(f, r, prefix, disney_parameter_names[p]);
        }
        fputs("</tr>\n", f);
    }
    fputs("</table></div>\n", f);
}

static void put_tables(FILE *f, const struct report_source *s)
{
    static const char *const stages[] = { "load", "samples", "joint", "alternating", "directional", "materials", "export" };
    const struct json *r = s->report;
    double centre[3], std[3];
    fputs("<h2>Details</h2>\n<div class=\"scroll\"><table>\n", f);
    put_text_row(f, r, "method", "method");
    put_text_row(f, r, "preset", "preset");
    put_text_row(f, r, "reflectance", "brdf");
    put_text_row(f, r, "Disney variant", "disney_variant");
    put_text_row(f, r, "ended because of", "stop_reason");
    put_row(f, "seed", "%.0f", number_of(r, "seed"));
    put_row(f, "observations", "%.0f", number_of(r, "n_observations"));
    put_row(f, "mixed light beside the object's outline", "up to %.1f px", number_of(r, "edge_reach_px"));
    put_row(f, "distance kept from edges", "%.0f px", number_of(r, "edge_px"));
    put_row(f, "clipped", "%.3f %%", 100 * number_of(r, "clipped_share"));
    if (r && !json_get_numbers(r, "centre_m", centre, 3)) {
        fprintf(f, "<tr><th>the panorama's place, metres</th><td>%.4f, %.4f, %.4f", centre[0], centre[1], centre[2]);
        if (!json_get_numbers(r, "centre_std_m", std, 3))
            fprintf(f, " &plusmn; %.1f mm", 1000 * vec3_norm(std));
        fputs("</td></tr>\n", f);
    }
    for (size_t i = 0; i < sizeof(stages) / sizeof(stages[0]); i++) {
        char key[64], name[64];
        snprintf(key, sizeof(key), "stages.%s.wall_s", stages[i]);
        snprintf(name, sizeof(name), "time of stage <i>%s</i>", stages[i]);
        put_row(f, name, "%.1f s", number_of(r, key));
    }
    put_row(f, "time in all", "%.1f s", number_of(r, "wall_s"));
    put_row(f, "processor time", "%.1f s", number_of(r, "cpu_s"));
    put_row(f, "threads", "%.0f", number_of(r, "threads"));
    put_row(f, "memory at most", "%.0f MB", 1e-6 * number_of(r, "peak_rss_bytes"));
    put_row(f, "GLB: error of the fit to glTF's reflectance", "%.2f %%", number_of(s->exported, "refit.rmse_percent"));
    put_row(f, "the same, had the parameters been copied by name", "%.2f %%", number_of(s->exported, "refit.rmse_by_name_percent"));
    fputs("</table></div>\n", f);
}

// ---- the page -------------------------------------------------------------------------------------------------------------

static const char head[] =
    "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<style>\n"
    "body{font:17px/1.5 system-ui,sans-serif;max-width:72rem;margin:0 auto;padding:1rem;background:#fbfaf8;color:#222}\n"
    "h1{font-size:1.6rem;margin:.5rem 0}h2{font-size:1.25rem;margin:2rem 0 .5rem;border-bottom:1px solid #ccc}h3{font-size:1rem;margin:1rem 0 .3rem}\n"
    ".verdict{font-size:1.15rem;padding:.6rem 1rem;border-radius:6px}.good{background:#dcefdc}.bad{background:#f6d9d4}\n"
    ".row{display:flex;flex-wrap:wrap;gap:.8rem}figure{margin:0}img,svg{display:block;max-width:100%;height:auto;border-radius:4px}\n"
    "figcaption{font-size:.85rem;color:#555}.third{flex:1 1 15rem;max-width:30rem}.half{flex:1 1 20rem;max-width:34rem}.map{width:11rem}\n"
    ".map img{width:100%}.third img{width:100%}.row img{background:#000}\n"
    "table{border-collapse:collapse;font-size:.95rem}th,td{text-align:left;vertical-align:top;padding:.2rem .8rem .2rem 0;border-bottom:1px solid #ddd}\n"
    "th{font-weight:500;color:#555}td{font-variant-numeric:tabular-nums}.scroll{overflow-x:auto}small{color:#666}\n"
    "svg rect{fill:#1d2126}svg text{fill:#aaa;font-size:12px}.object{fill:#4a5560;stroke:#9fb0c0}.camera{stroke:#6fa8e8;fill:#6fa8e8}\n"
    ".probe{stroke:#fff;stroke-width:1.5;fill:none}.scale{stroke:#aaa;stroke-width:2}.far{fill:none;stroke:#bbb}\n"
    ".warnings li{margin:.3rem 0}.none{color:#555;list-style:none;margin-left:-1.3rem}\n"
    "</style>\n";

static int put_page(FILE *f, const struct report_source *s)
{
    fputs("<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>studiorig: ", f);
    put_escaped(f, s->title);
    fprintf(f, "</title>\n%s</head><body>\n<h1>", head);
    put_escaped(f, s->title);
    fputs("</h1>\n", f);
    put_verdict(f, s);
    put_warnings(f, s);
    int err = put_views(f, s);
    if (!err)
        err = put_maps(f, s);
    if (!err)
        err = put_lights(f, s);
    put_materials(f, s);
    put_tables(f, s);
    fputs("<p><small>rigsolve " STUDIORIG_VERSION "</small></p>\n</body></html>\n", f);
    return err;
}

int report_write(const struct report_source *source, const char *path)
{
    struct atomic_file f;
    int err = atomic_file_open(&f, path);
    if (err)
        return err;
    const locale_t c_locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    if (!c_locale) {
        atomic_file_abandon(&f);
        return -ENOMEM;
    }
    const locale_t before = uselocale(c_locale); // a decimal point, whatever the user's language
    err = put_page(f.stream, source);
    uselocale(before);
    freelocale(c_locale);
    if (err) {
        atomic_file_abandon(&f);
        return err;
    }
    return atomic_file_commit(&f);
}
