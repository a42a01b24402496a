// rigd/colour.c - see colour.h.
#include "rigd/colour.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { N_PATCHES = CHART_COLUMNS * CHART_ROWS, FIRST_GREY = 18, N_GREYS = 6, MOST_JSON_BYTES = 4 << 20 };
static const double LARGEST_GAIN = 64;

// ---- colour.json -------------------------------------------------------------------------------------------------------------

static int refuse(const char *file, int i, const char *what)
{
    log_error("colour: %s: bodies.%d: %s", file, i, what);
    return -EINVAL;
}

static int parse_body(struct colour *c, const struct json *doc, int i, const char *file)
{
    char path[40];
    const char *serial = "", *model = "";
    double gain[4];
    struct body_colour *b = &c->body[i];
    snprintf(path, sizeof(path), "bodies.%d", i);
    const struct json *v = json_get(doc, path);
    if (json_get_string(v, "serial", &serial) || !serial[0] || strlen(serial) >= sizeof(b->serial))
        return refuse(file, i, "no serial; expected the body's serial number, at most 63 characters");
    if (json_get_numbers(v, "gain", gain, 3) || json_get_number(v, "scale", &gain[3]))
        return refuse(file, i, "expected gain (3 numbers) and scale (1)");
    for (int k = 0; k < 4; k++)
        if (!(gain[k] >= 1 / LARGEST_GAIN && gain[k] <= LARGEST_GAIN))
            return refuse(file, i, "a gain or scale is outside 1/64 .. 64");
    json_get_string(v, "model", &model);
    if (colour_of(c, serial))
        return refuse(file, i, "its serial is there twice");
    snprintf(b->serial, sizeof(b->serial), "%s", serial);
    snprintf(b->model, sizeof(b->model), "%.63s", model);
    memcpy(b->gain, gain, sizeof(b->gain));
    b->scale = gain[3];
    c->n = i + 1;
    return 0;
}

int colour_parse(struct colour *out, const char *text, size_t n_bytes, const char *name)
{
    struct json *doc = NULL;
    struct colour c = { 0 };
    int64_t version = 0;
    *out = c;
    int err = json_parse(&doc, text, n_bytes, name);
    if (err)
        return err;
    const int n = json_length(doc, "bodies");
    if (json_get_int(doc, "version", &version) || version != 1 || n < 1 || n > COLOUR_BODIES_MAX) {
        log_error("colour: %s: expected \"version\": 1 and 1 to %d \"bodies\"; rigctl calibrate colour writes such a file", name, COLOUR_BODIES_MAX);
        err = -EINVAL;
    }
    if (!err && !(c.body = calloc((size_t)n, sizeof(c.body[0]))))
        err = -ENOMEM;
    for (int i = 0; i < n && !err; i++)
        err = parse_body(&c, doc, i, name);
    json_free(doc);
    if (err)
        colour_free(&c);
    *out = c;
    return err;
}

int colour_read(struct colour *out, const char *path)
{
    char *text;
    size_t n;
    *out = (struct colour){ 0 };
    int err = file_read(&text, &n, path, MOST_JSON_BYTES);
    if (!err)
        err = colour_parse(out, text, n, path);
    free(text);
    return err;
}

void colour_free(struct colour *c)
{
    if (!c)
        return;
    free(c->body);
    *c = (struct colour){ 0 };
}

const struct body_colour *colour_of(const struct colour *c, const char *serial)
{
    for (int i = 0; i < c->n; i++)
        if (!strcmp(c->body[i].serial, serial))
            return &c->body[i];
    return NULL;
}

// ---- fitting -----------------------------------------------------------------------------------------------------------------

static bool is_chart(const struct colour_frame *f)
{
    return f->n_cells == N_PATCHES;
}

int colour_require_sound(const struct colour_frame *f, char *why, size_t room)
{
    const double darkest_card = .02, most_uneven = .1;
    const int first = is_chart(f) ? FIRST_GREY : 0, last = is_chart(f) ? FIRST_GREY : f->n_cells - 1; // of a chart its white
    double smallest = INFINITY, largest = 0;
    for (int i = is_chart(f) ? 0 : first; i < f->n_cells; i++)
        if (f->cell[i].n_saturated) {
            snprintf(why, room, "patch %d is clipped: %lld of its photosites are saturated; expose less", i + 1, (long long)f->cell[i].n_saturated);
            return -EDOM;
        }
    for (int i = first; i <= last; i++) {
        for (int c = 0; c < 3; c++)
            if (f->cell[i].raw[c] < darkest_card) {
                snprintf(why, room, "patch %d is too dark: %.2f %% of white in %s; expose longer (a tenth to a half of white)", i + 1, 100 * f->cell[i].raw[c],
                         c == 0   ? "red"
                         : c == 1 ? "green"
                                  : "blue");
                return -EDOM;
            }
        smallest = fmin(smallest, f->cell[i].mean[RAW_GREEN]);
        largest = fmax(largest, f->cell[i].mean[RAW_GREEN]);
    }
    if (largest - smallest > most_uneven * largest) {
        snprintf(why, room, "the card is uneven by %.0f %%: a shadow lies on it, or the patch is not all card", 100 * (largest - smallest) / largest);
        return -EDOM;
    }
    return 0;
}

// What is fitted to: of a card the cells of one colour of a checkerboard, the others check; of a chart its greys.
enum part { FITTED, CHECKED, BOTH };

static bool in_part(const struct colour_frame *f, int cell, enum part part)
{
    if (is_chart(f))
        return cell >= FIRST_GREY;
    return part == BOTH || (cell % 2 == 0) == (part == FITTED);
}

// A body as all of its frames say: mean per cell.
struct fitted_body {
    const struct colour_frame *first;
    int n_frames;
    double mean[COLOUR_CELLS_MAX][3];
};

static int gather_bodies(struct fitted_body *body, int *n, const struct colour_frame *frame, int n_frames, char *why, size_t room)
{
    *n = 0;
    for (int i = 0; i < n_frames; i++) {
        int b = 0;
        if (!frame[i].serial[0] || frame[i].n_cells != frame[0].n_cells) {
            snprintf(why, room, "%s %s", frame[i].file, frame[i].serial[0] ? "and others: cards and charts are mixed" : "does not say its body's serial number");
            return -EINVAL;
        }
        while (b < *n && strcmp(body[b].first->serial, frame[i].serial))
            b++;
        if (b == *n && *n == COLOUR_BODIES_MAX) {
            snprintf(why, room, "more than %d bodies", COLOUR_BODIES_MAX);
            return -EINVAL;
        }
        if (b == *n)
            body[(*n)++].first = &frame[i];
        body[b].n_frames++;
        for (int k = 0; k < frame[i].n_cells; k++)
            for (int c = 0; c < 3; c++)
                body[b].mean[k][c] += frame[i].cell[k].mean[c];
    }
    for (int b = 0; b < *n; b++)
        for (int k = 0; k < body[b].first->n_cells; k++)
            for (int c = 0; c < 3; c++)
                body[b].mean[k][c] /= body[b].n_frames;
    return 0;
}

static int by_value(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// The target of cell k, channel c: the reference's, or the median of all.
static double target_of(const struct fitted_body *body, int n, int reference, int k, int c, double *room_for_n)
{
    if (reference >= 0)
        return body[reference].mean[k][c];
    for (int b = 0; b < n; b++)
        room_for_n[b] = body[b].mean[k][c];
    qsort(room_for_n, (size_t)n, sizeof(double), by_value);
    return .5 * (room_for_n[(n - 1) / 2] + room_for_n[n / 2]);
}

// The factor that brings a body closest to the targets, by least squares.
static void fit_body(const struct fitted_body *body, double (*target)[3], enum part part, double total[3])
{
    for (int c = 0; c < 3; c++) {
        double above = 0, below = 0;
        for (int k = 0; k < body->first->n_cells; k++)
            if (in_part(body->first, k, part)) {
                above += target[k][c] * body->mean[k][c];
                below += body->mean[k][c] * body->mean[k][c];
            }
        total[c] = above / below;
    }
}

static double corrected(const struct colour_frame *f, double (*total)[3], int frame, enum part part, int patch, int c)
{
    if (patch >= 0)
        return f->cell[patch].mean[c] * total[frame][c];
    double sum = 0;
    int n = 0;
    for (int k = 0; k < f->n_cells; k++)
        if (in_part(f, k, part)) {
            sum += f->cell[k].mean[c];
            n++;
        }
    return sum / n * total[frame][c];
}

// Of all frames after correction: how far do they lie apart? A chart's black is left out: 3 % of light say little.
static void measure_spread(struct colour_fit *out, const struct colour_frame *frame, int n_frames, double (*total)[3], enum part part)
{
    const bool chart = is_chart(frame);
    for (int patch = chart ? FIRST_GREY : -1; patch < (chart ? N_PATCHES - 1 : 0); patch++)
        for (int c = 0; c < 3; c++) {
            double smallest = INFINITY, largest = 0, sum = 0, furthest = -1;
            int who = 0;
            for (int i = 0; i < n_frames; i++) {
                const double v = corrected(&frame[i], total, i, part, patch, c);
                smallest = fmin(smallest, v);
                largest = fmax(largest, v);
                sum += v;
            }
            for (int i = 0; i < n_frames; i++) {
                const double off = fabs(corrected(&frame[i], total, i, part, patch, c) - sum / n_frames);
                if (off > furthest)
                    furthest = off, who = i;
            }
            const double spread = (largest - smallest) / (sum / n_frames);
            if (spread > out->grey_spread) {
                out->grey_spread = spread;
                snprintf(out->spread_serial, sizeof(out->spread_serial), "%s", frame[who].serial);
            }
        }
}

static void patch_colour(const struct colour_frame *f, const double total[3], int patch, double srgb[3])
{
    for (int i = 0; i < 3; i++) {
        srgb[i] = 0;
        for (int c = 0; c < 3; c++)
            srgb[i] += f->srgb_from_camera[i][c] * total[c] * f->cell[patch].mean[c];
    }
}

// Against the published colours, after the colour and strength of the light, one factor per channel for all bodies, was taken off by the greys.
static void measure_chart(struct colour_fit *out, const struct colour_frame *frame, int n_frames, double (*total)[3])
{
    double published[N_PATCHES][3], light[3], above[3] = { 0 }, below[3] = { 0 }, sum = 0;
    colour_chart(published);
    for (int i = 0; i < n_frames; i++)
        for (int p = FIRST_GREY; p < FIRST_GREY + N_GREYS; p++) {
            double rgb[3];
            patch_colour(&frame[i], total[i], p, rgb);
            for (int c = 0; c < 3; c++) {
                above[c] += published[p][c] * rgb[c];
                below[c] += rgb[c] * rgb[c];
            }
        }
    for (int c = 0; c < 3; c++)
        light[c] = above[c] / below[c];
    for (int i = 0; i < n_frames; i++) {
        double own = 0;
        for (int p = 0; p < N_PATCHES; p++) {
            double rgb[3];
            patch_colour(&frame[i], total[i], p, rgb);
            for (int c = 0; c < 3; c++) {
                const double off = (light[c] * rgb[c] - published[p][c]) / published[FIRST_GREY][1];
                own += off * off;
            }
        }
        sum += own;
        const double rms = sqrt(own / (3 * N_PATCHES));
        if (!(rms <= out->worst_rms)) {
            out->worst_rms = rms;
            snprintf(out->worst_serial, sizeof(out->worst_serial), "%s", frame[i].serial);
        }
    }
    out->chart_rms = sqrt(sum / (3. * N_PATCHES * n_frames));
}

static int find_reference(const struct fitted_body *body, int n, const char *reference, char *why, size_t room)
{
    for (int b = 0; b < n; b++)
        if (!strcmp(body[b].first->serial, reference))
            return b;
    snprintf(why, room, "the reference %s has no frame here", reference);
    return -ENOENT;
}

// Factors per body into those per frame.
static void to_frames(double (*of_frame)[3], const struct colour_frame *frame, int n_frames, const struct fitted_body *body, int n, double (*of_body)[3])
{
    for (int i = 0; i < n_frames; i++)
        for (int b = 0; b < n; b++)
            if (!strcmp(body[b].first->serial, frame[i].serial))
                memcpy(of_frame[i], of_body[b], sizeof(of_frame[i]));
}

static int take_fixed(double (*total)[3], const struct fitted_body *body, int n, const struct colour *fixed, char *why, size_t room)
{
    for (int b = 0; b < n; b++) {
        const struct body_colour *own = colour_of(fixed, body[b].first->serial);
        if (!own) {
            snprintf(why, room, "body %s (%s) is not in the calibration", body[b].first->serial, body[b].first->file);
            return -ENOENT;
        }
        for (int c = 0; c < 3; c++)
            total[b][c] = own->gain[c] * own->scale;
    }
    return 0;
}

int colour_fit(struct colour_fit *out, const struct colour_frame *frame, int n_frames, const char *reference, const struct colour *fixed, char *why, size_t room)
{
    double target[COLOUR_CELLS_MAX][3];
    int n = 0, chosen = -1;
    struct colour_fit fit = { .chart_rms = NAN, .worst_rms = NAN };
    struct fitted_body *body = calloc((size_t)(n_frames < COLOUR_BODIES_MAX ? n_frames : COLOUR_BODIES_MAX) + 1, sizeof(*body));
    double (*of_body)[3] = calloc((size_t)n_frames + 1, sizeof(*of_body)), (*of_frame)[3] = calloc((size_t)n_frames + 1, sizeof(*of_frame));
    double *sorted = calloc((size_t)n_frames + 1, sizeof(*sorted));
    *out = (struct colour_fit){ 0 };
    int err = body && of_body && of_frame && sorted ? 0 : -ENOMEM;
    if (err)
        snprintf(why, room, "out of memory");
    if (!err)
        err = gather_bodies(body, &n, frame, n_frames, why, room);
    if (!err && reference)
        chosen = find_reference(body, n, reference, why, room), err = chosen < 0 ? chosen : 0;
    if (err)
        goto done;
    for (int k = 0; k < frame[0].n_cells; k++)
        for (int c = 0; c < 3; c++)
            target[k][c] = target_of(body, n, chosen, k, c, sorted);
    if (fixed) {
        err = take_fixed(of_body, body, n, fixed, why, room);
        if (err)
            goto done;
    } else {
        for (int b = 0; b < n; b++)
            fit_body(&body[b], target, FITTED, of_body[b]);
    }
    to_frames(of_frame, frame, n_frames, body, n, of_body);
    measure_spread(&fit, frame, n_frames, of_frame, fixed ? BOTH : CHECKED);
    if (!fixed) {
        fit.colour.body = calloc((size_t)n, sizeof(fit.colour.body[0]));
        if (!fit.colour.body) {
            err = -ENOMEM;
            snprintf(why, room, "out of memory");
            goto done;
        }
        for (int b = 0; b < n; b++) {
            struct body_colour *to = &fit.colour.body[fit.colour.n++];
            fit_body(&body[b], target, BOTH, of_body[b]);
            snprintf(to->serial, sizeof(to->serial), "%s", body[b].first->serial);
            snprintf(to->model, sizeof(to->model), "%s", body[b].first->model);
            to->scale = of_body[b][RAW_GREEN];
            for (int c = 0; c < 3; c++)
                to->gain[c] = of_body[b][c] / to->scale;
        }
        to_frames(of_frame, frame, n_frames, body, n, of_body);
    }
    if (is_chart(frame))
        measure_chart(&fit, frame, n_frames, of_frame);
    *out = fit;
done:
    free(body);
    free(of_body);
    free(of_frame);
    free(sorted);
    return err;
}

// ---- published colours -------------------------------------------------------------------------------------------------------

// L*a*b* under D50, as X-Rite publishes them for charts made before November 2014; by Bradford's adaptation to D65.
void colour_chart(double srgb[N_PATCHES][3])
{
    static const double lab[N_PATCHES][3] = {
        { 37.986, 13.555, 14.059 },   { 65.711, 18.130, 17.810 },   { 49.927, -4.880, -21.925 }, { 43.139, -13.095, 21.905 },
        { 55.112, 8.844, -25.399 },   { 70.719, -33.397, -.199 },   { 62.661, 36.067, 57.096 },  { 40.020, 10.410, -45.964 },
        { 51.124, 48.239, 16.248 },   { 30.325, 22.976, -21.587 },  { 72.532, -23.709, 57.255 }, { 71.941, 19.363, 67.857 },
        { 28.778, 14.179, -50.297 },  { 55.261, -38.342, 31.370 },  { 42.101, 53.378, 28.190 },  { 81.733, 4.039, 79.819 },
        { 51.935, 49.986, -14.574 },  { 51.038, -28.631, -28.638 }, { 96.539, -.425, 1.186 },    { 81.257, -.638, -.335 },
        { 66.766, -.734, -.504 },     { 50.867, -.153, -.270 },     { 35.656, -.421, -1.231 },   { 20.461, -.079, -.973 },
    };
    static const double d50[3] = { .96422, 1, .82521 };
    // linear sRGB (D65) from XYZ (D50)
    static const double m[3][3] = { { 3.1338561, -1.6168667, -.4906146 }, { -.9787684, 1.9161415, .0334540 }, { .0719453, -.2289914, 1.4052427 } };
    for (int p = 0; p < N_PATCHES; p++) {
        const double fy = (lab[p][0] + 16) / 116, f[3] = { fy + lab[p][1] / 500, fy, fy - lab[p][2] / 200 };
        double xyz[3];
        for (int c = 0; c < 3; c++)
            xyz[c] = d50[c] * (f[c] > 6. / 29 ? f[c] * f[c] * f[c] : 3 * (6. / 29) * (6. / 29) * (f[c] - 4. / 29));
        for (int c = 0; c < 3; c++)
            srgb[p][c] = m[c][0] * xyz[0] + m[c][1] * xyz[1] + m[c][2] * xyz[2];
    }
}
