// rigd/contact.c - measures, compares and draws.
#include "rigd/contact.h"
#include "solver/take/log.h"

#include <ctype.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { BLOCK_PX = 16, STRONGEST_OF = 8, FLATTEST_OF = 4, BLOCKS_MIN = 24, HISTOGRAM = 4096, GLYPH_PX = 3, LABEL_PX = 24, GAP_PX = 6, EXCEPT_ONE_OF = 5 };
static const double soft_below = .5, dark_below_ev = -1.5, dark_p99 = .02;
static const double full_white = .985; // 253 of 255, the curve undone
static const double glints = .02;

// ---- figures ------------------------------------------------------------------------------------------------------------------

static double luminance(const struct image *m, const float *p)
{
    return m->n_channels < 3 ? p[0] : .2126 * p[0] + .7152 * p[1] + .0722 * p[2];
}

static int compare_doubles(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

struct block {
    double fine, coarse; // mean squares of second differences at 1 px and at 2 px
};

static int by_coarse(const void *a, const void *b)
{
    const double x = ((const struct block *)a)->coarse, y = ((const struct block *)b)->coarse;
    return (x < y) - (x > y);
}

// The pictures' square roots, so that noise is about the same in light and shadow.
static int measure_sharpness(double *out, const struct image *m)
{
    const int nx = (m->width - 4) / BLOCK_PX, ny = (m->height - 4) / BLOCK_PX;
    *out = NAN;
    if (nx < 1 || ny < 1 || nx * ny < BLOCKS_MIN)
        return 0;
    float *rows = malloc((size_t)m->width * (BLOCK_PX + 4) * sizeof(*rows));
    struct block *block = calloc((size_t)nx * (size_t)ny, sizeof(*block));
    if (!rows || !block) {
        free(rows);
        free(block);
        return -ENOMEM;
    }
    for (int by = 0; by < ny; by++) {
        for (int y = 0; y < BLOCK_PX + 4; y++)
            for (int x = 0; x < m->width; x++) {
                const double l = luminance(m, m->data + ((size_t)(by * BLOCK_PX + y) * (size_t)m->width + (size_t)x) * (size_t)m->n_channels);
                rows[(size_t)y * (size_t)m->width + (size_t)x] = l > 0 ? (float)sqrt(l) : 0;
            }
        for (int bx = 0; bx < nx; bx++) {
            struct block *b = &block[by * nx + bx];
            for (int y = 2; y < BLOCK_PX + 2; y++)
                for (int x = bx * BLOCK_PX + 2; x < (bx + 1) * BLOCK_PX + 2; x++) {
                    const float *p = rows + (size_t)y * (size_t)m->width + (size_t)x;
                    const size_t w = (size_t)m->width;
                    const double fx = p[-1] + p[1] - 2 * p[0], fy = *(p - w) + p[w] - 2 * p[0];
                    const double cx = p[-2] + p[2] - 2 * p[0], cy = *(p - 2 * w) + p[2 * w] - 2 * p[0];
                    b->fine += fx * fx + fy * fy;
                    b->coarse += cx * cx + cy * cy;
                }
        }
    }
    const int n = nx * ny, n_strong = n / STRONGEST_OF, n_flat = n / FLATTEST_OF;
    double fine = 0, coarse = 0, floor_fine = 0, floor_coarse = 0;
    qsort(block, (size_t)n, sizeof(*block), by_coarse);
    for (int i = 0; i < n_strong; i++)
        fine += block[i].fine / n_strong, coarse += block[i].coarse / n_strong;
    for (int i = n - n_flat; i < n; i++)
        floor_fine += block[i].fine / n_flat, floor_coarse += block[i].coarse / n_flat;
    if (coarse > 2 * floor_coarse && coarse > 0)
        *out = fmax(0, fine - floor_fine) / (coarse - floor_coarse);
    free(rows);
    free(block);
    return 0;
}

static int step_of(double value)
{
    const double at = 128 * (log2(value) + 16);
    return at < 0 ? 0 : at >= HISTOGRAM ? HISTOGRAM - 1 : (int)at;
}

int contact_measure(struct contact_figures *out, const struct image *m, bool full_is_one)
{
    const int clip = image_channel(m, "clip");
    const size_t n = (size_t)m->width * (size_t)m->height;
    size_t n_clipped = 0, n_middle = 0, n_middle_clipped = 0, n_lit = 0, seen = 0, *histogram, *brightest;
    const bool knows_full = full_is_one && clip < 0;
    *out = (struct contact_figures){ .sharpness = NAN, .headroom_ev = NAN };
    if (m->n_channels < 1 || !n)
        return -EINVAL;
    histogram = calloc(2 * HISTOGRAM, sizeof(*histogram)); // 2^-16 .. 2^16, 128 steps per EV; then of the middle's brightest channel
    if (!histogram)
        return -ENOMEM;
    brightest = histogram + HISTOGRAM;
    for (size_t i = 0; i < n; i++) {
        const float *p = m->data + i * (size_t)m->n_channels;
        const double l = luminance(m, p);
        const int x = (int)(i % (size_t)m->width), y = (int)(i / (size_t)m->width);
        const bool is_middle = 3 * x >= m->width && 3 * x < 2 * m->width && 3 * y >= m->height && 3 * y < 2 * m->height;
        double most = 0;
        for (int c = 0; c < (m->n_channels < 3 ? 1 : 3); c++)
            most = fmax(most, (double)p[c]);
        const bool is_clipped = clip >= 0 ? p[clip] > .5f : knows_full && most >= full_white;
        n_clipped += is_clipped;
        n_middle += is_middle, n_middle_clipped += is_middle && is_clipped;
        if (is_middle && most > 0)
            brightest[step_of(most)]++;
        if (!(l > 0))
            continue;
        histogram[step_of(l)]++;
        n_lit++;
    }
    for (int i = 0; i < HISTOGRAM; i++) {
        const double value = exp2((i + .5) / 128 - 16);
        if (seen < n_lit - n_lit / 2 && seen + histogram[i] >= n_lit - n_lit / 2)
            out->median = value;
        if (seen < n_lit - n_lit / 100 && seen + histogram[i] >= n_lit - n_lit / 100)
            out->p99 = value;
        seen += histogram[i];
    }
    out->clipped_share = (double)n_clipped / (double)n;
    out->middle_clipped_share = n_middle ? (double)n_middle_clipped / (double)n_middle : 0;
    if (knows_full && n_middle) {
        int at = HISTOGRAM - 1;
        for (size_t above = brightest[at]; at > 0 && (double)above <= glints * (double)n_middle; above += brightest[--at])
            ;
        out->headroom_ev = out->middle_clipped_share > glints ? 0 : fmax(0, log2(full_white) - ((at + .5) / 128 - 16));
    }
    free(histogram);
    return measure_sharpness(&out->sharpness, m);
}

// ---- comparing ----------------------------------------------------------------------------------------------------------------

static double median_of(double *v, int n)
{
    qsort(v, (size_t)n, sizeof(*v), compare_doubles);
    return n ? n % 2 ? v[n / 2] : .5 * (v[n / 2 - 1] + v[n / 2]) : NAN;
}

void contact_judge(struct contact_entry *e, int n, bool developed)
{
    double *sharpness = calloc((size_t)n + 1, sizeof(double)), *light = calloc((size_t)n + 1, sizeof(double));
    int n_sharp = 0, n_light = 0;
    if (!sharpness || !light)
        abort();
    for (int i = 0; i < n; i++) {
        if (!isnan(e[i].figures.sharpness))
            sharpness[n_sharp++] = e[i].figures.sharpness;
        if (e[i].figures.p99 > 0)
            light[n_light++] = e[i].figures.p99;
    }
    const double usual_sharpness = median_of(sharpness, n_sharp), usual_light = median_of(light, n_light);
    for (int i = 0; i < n; i++) {
        const struct contact_figures *f = &e[i].figures;
        e[i].relative_sharpness = n_sharp >= 3 && usual_sharpness > 0 ? f->sharpness / usual_sharpness : NAN;
        e[i].relative_ev = n_light >= 3 && usual_light > 0 && f->p99 > 0 ? log2(f->p99 / usual_light) : NAN;
        e[i].doubts = (e[i].relative_sharpness < soft_below ? CONTACT_SOFT : 0) | (f->middle_clipped_share > glints ? CONTACT_CLIPPED : 0) |
                      (e[i].relative_ev < dark_below_ev || (!developed && f->p99 < dark_p99) ? CONTACT_DARK : 0);
    }
    free(sharpness);
    free(light);
}

double contact_headroom(const struct contact_entry *e, int n)
{
    double *v = calloc((size_t)n + 1, sizeof(*v));
    int n_known = 0;
    if (!v)
        abort();
    for (int i = 0; i < n; i++)
        if (!isnan(e[i].figures.headroom_ev))
            v[n_known++] = e[i].figures.headroom_ev;
    qsort(v, (size_t)n_known, sizeof(*v), compare_doubles);
    const double headroom = n_known ? v[n_known / EXCEPT_ONE_OF] : NAN;
    free(v);
    return headroom;
}

static void tell(const struct contact_entry *e, char *out, size_t room)
{
    size_t used = 0;
    out[0] = 0;
    if (e->doubts & CONTACT_SOFT)
        used += (size_t)snprintf(out + used, room - used, " soft (%.2f of the others)", e->relative_sharpness);
    if ((e->doubts & CONTACT_CLIPPED) && used < room)
        used += (size_t)snprintf(out + used, room - used, " clipped (%.1f %%)", 100 * e->figures.middle_clipped_share);
    if ((e->doubts & CONTACT_DARK) && used < room && isnan(e->relative_ev))
        snprintf(out + used, room - used, " dark");
    else if ((e->doubts & CONTACT_DARK) && used < room)
        snprintf(out + used, room - used, " dark (%+.1f EV)", e->relative_ev);
}

void contact_sentence(const struct contact_entry *e, int n, char *out, size_t room)
{
    int n_doubtful = 0, n_told = 0;
    for (int i = 0; i < n; i++)
        n_doubtful += e[i].doubts != 0;
    out[0] = 0;
    if (!n_doubtful)
        return;
    size_t used = (size_t)snprintf(out, room, "%d of %d cameras to look at:", n_doubtful, n);
    for (int i = 0; i < n && used < room; i++) {
        char what[120];
        if (!e[i].doubts)
            continue;
        tell(&e[i], what, sizeof(what));
        if (used + strlen(what) + CONTACT_NAME + 12 > room) {
            snprintf(out + used, room - used, ", ...");
            return;
        }
        used += (size_t)snprintf(out + used, room - used, "%s %s%s", n_told++ ? "," : "", e[i].name, what);
    }
}

// ---- drawing ------------------------------------------------------------------------------------------------------------------

int contact_cell(struct contact_entry *e, const struct image *m)
{
    const double scale = fmax((double)m->width / CONTACT_CELL_PX, (double)m->height / CONTACT_CELL_HEIGHT_PX);
    int w = (int)(m->width / scale), h = (int)(m->height / scale);
    w = w < 1 ? 1 : w > CONTACT_CELL_PX ? CONTACT_CELL_PX : w;
    h = h < 1 ? 1 : h > CONTACT_CELL_HEIGHT_PX ? CONTACT_CELL_HEIGHT_PX : h;
    e->cell = calloc((size_t)CONTACT_CELL_PX * CONTACT_CELL_HEIGHT_PX, sizeof(*e->cell));
    if (!e->cell)
        return -ENOMEM;
    for (int y = 0; y < h; y++)
        for (int x = 0; x < w; x++) {
            const int x0 = (int)((int64_t)x * m->width / w), y0 = (int)((int64_t)y * m->height / h);
            int x1 = (int)((int64_t)(x + 1) * m->width / w), y1 = (int)((int64_t)(y + 1) * m->height / h);
            float *out = e->cell[(y + (CONTACT_CELL_HEIGHT_PX - h) / 2) * CONTACT_CELL_PX + x + (CONTACT_CELL_PX - w) / 2];
            double sum[3] = { 0 };
            x1 += x1 == x0, y1 += y1 == y0;
            for (int v = y0; v < y1; v++)
                for (int u = x0; u < x1; u++) {
                    const float *p = m->data + ((size_t)v * (size_t)m->width + (size_t)u) * (size_t)m->n_channels;
                    for (int c = 0; c < 3; c++)
                        sum[c] += p[m->n_channels < 3 ? 0 : c];
                }
            for (int c = 0; c < 3; c++)
                out[c] = (float)(sum[c] / ((double)(x1 - x0) * (y1 - y0)));
        }
    return 0;
}

// Rows of three dots, top first, in octal.
static const struct {
    char c;
    unsigned rows;
} glyphs[] = {
    { '0', 075557 }, { '1', 026227 }, { '2', 071747 }, { '3', 071717 }, { '4', 055711 }, { '5', 074717 }, { '6', 074757 }, { '7', 071111 }, { '8', 075757 }, { '9', 075717 },
    { 'A', 025755 }, { 'B', 065656 }, { 'C', 034443 }, { 'D', 065556 }, { 'E', 074647 }, { 'F', 074644 }, { 'G', 034553 }, { 'H', 055755 }, { 'I', 072227 }, { 'J', 011152 },
    { 'K', 055655 }, { 'L', 044447 }, { 'M', 057755 }, { 'N', 065555 }, { 'O', 025552 }, { 'P', 065644 }, { 'Q', 025573 }, { 'R', 065655 }, { 'S', 034216 }, { 'T', 072222 },
    { 'U', 055557 }, { 'V', 055552 }, { 'W', 055775 }, { 'X', 055255 }, { 'Y', 055222 }, { 'Z', 071247 }, { '-', 000700 }, { '_', 000007 }, { '.', 000002 }, { '%', 051245 },
    { '+', 002720 }, { '(', 024442 }, { ')', 021112 }, { ',', 000024 },
};

struct canvas {
    uint8_t *pixel;
    int width, height;
};

static void fill(struct canvas *k, int x, int y, int w, int h, const uint8_t colour[3])
{
    for (int v = y < 0 ? 0 : y; v < y + h && v < k->height; v++)
        for (int u = x < 0 ? 0 : x; u < x + w && u < k->width; u++)
            memcpy(k->pixel + 3 * ((size_t)v * (size_t)k->width + (size_t)u), colour, 3);
}

// At most width pixels of it.
static void write_text(struct canvas *k, int x, int y, int width, const char *text, const uint8_t colour[3])
{
    const int end = x + width;
    for (; *text && x + 3 * GLYPH_PX <= end; text++, x += 4 * GLYPH_PX)
        for (size_t g = 0; g < sizeof(glyphs) / sizeof(glyphs[0]); g++)
            for (int row = 0; glyphs[g].c == toupper((unsigned char)*text) && row < 5; row++)
                for (int dot = 0; dot < 3; dot++)
                    if (glyphs[g].rows >> (3 * (4 - row) + 2 - dot) & 1)
                        fill(k, x + dot * GLYPH_PX, y + row * GLYPH_PX, GLYPH_PX, GLYPH_PX, colour);
}

int contact_write(const struct contact_entry *e, int n, double exposure_ev, const char *path)
{
    static const uint8_t ground[3] = { 24, 26, 30 }, plain[3] = { 200, 200, 200 }, alarm[3] = { 255, 96, 64 };
    const int pitch_x = CONTACT_CELL_PX + 2 * GAP_PX, pitch_y = CONTACT_CELL_HEIGHT_PX + 2 * LABEL_PX + 2 * GAP_PX;
    int n_columns = (int)ceil(sqrt(n * 1.4));
    n_columns = n_columns < 1 ? 1 : n_columns > n ? (n ? n : 1) : n_columns;
    struct canvas k = { .width = n_columns * pitch_x, .height = ((n + n_columns - 1) / n_columns) * pitch_y };
    const double scale = exp2(exposure_ev);
    if (n < 1)
        return -EINVAL;
    k.pixel = malloc(3 * (size_t)k.width * (size_t)k.height);
    if (!k.pixel)
        return -ENOMEM;
    fill(&k, 0, 0, k.width, k.height, ground);
    for (int i = 0; i < n; i++) {
        const int x = i % n_columns * pitch_x + GAP_PX, y = i / n_columns * pitch_y + GAP_PX;
        char what[120];
        if (e[i].doubts)
            fill(&k, x - 3, y - 3, CONTACT_CELL_PX + 6, CONTACT_CELL_HEIGHT_PX + 6, alarm);
        for (int v = 0; v < CONTACT_CELL_HEIGHT_PX; v++)
            for (int u = 0; u < CONTACT_CELL_PX; u++) {
                const float *from = e[i].cell[v * CONTACT_CELL_PX + u];
                const uint8_t to[3] = { image_srgb_byte(from[0] * scale), image_srgb_byte(from[1] * scale), image_srgb_byte(from[2] * scale) };
                fill(&k, x + u, y + v, 1, 1, to);
            }
        write_text(&k, x, y + CONTACT_CELL_HEIGHT_PX + 5, CONTACT_CELL_PX, e[i].name, e[i].doubts ? alarm : plain);
        tell(&e[i], what, sizeof(what));
        write_text(&k, x - 4 * GLYPH_PX, y + CONTACT_CELL_HEIGHT_PX + LABEL_PX + 2, CONTACT_CELL_PX + 4 * GLYPH_PX, what, alarm);
    }
    const int err = image_write_png(path, k.width, k.height, 3, k.pixel);
    free(k.pixel);
    return err;
}
