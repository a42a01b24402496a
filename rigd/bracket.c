// rigd/bracket.c - the merge of a bracket, site by site, and what its frames say about each other.
//
// Two sums per site, and frames come one at a time, so that 24 megapixels times any number of frames take eight bytes per site. A frame is
// compared with what the frames before it predict, block by block, before it is taken in: the ratio of brightness is the test of its
// exposure, what remains in a block is movement or flicker.
#include "rigd/bracket.h"
#include "rigd/plateau.h"
#include "rigd/resting.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

static const double clip_level = .98; // of saturation: sensors do not clip at one DN exactly
static const double bloom_level = 1.8;
enum { SATURATED = 1, OVERFLOWING = 2 }; // marks

struct block { // of a frame against its prediction m: sums over sites that are good in both
    int n;
    double y, m, v;          // v: variance of y - m
    double yy_v, ym_v, mm_v; // for chi^2 at any gain
};

struct bracket {
    struct raw_frame like; // the first frame's facts, without its sites
    struct sensor_noise noise;
    double usable, gain_refused;
    int bloom_px;
    int n_taken, blocks_x, blocks_y;
    double saturation;   // lowest plateau so far, else the file's
    int reached;         // plateau.h: the most of the frames so far
    double longest;      // exposure
    double *taken;       // [n_taken] exposures
    float *num, *den;    // sum u y, sum u h; den < 0: the same of poor frames, as there was no good one; den 0: clipped in all, num is the highest lower bound
    uint8_t *row_quality, *saturated; // [width]; [2 bloom + 1][width]
    struct block *block;
};

static const char *const fault_text[] = {
    [BRACKET_FITS] = "fits", [BRACKET_OTHER_SIZE] = "other size", [BRACKET_OTHER_FILTERS] = "other colour filter array",
    [BRACKET_OTHER_CAMERA] = "other camera", [BRACKET_OTHER_LEVELS] = "other black or white level", [BRACKET_OTHER_ISO] = "other ISO",
    [BRACKET_OTHER_APERTURE] = "other aperture", [BRACKET_NO_TIME] = "no exposure time, or one that cannot be",
    [BRACKET_OTHER_BRIGHTNESS] = "its brightness contradicts its exposure",
};

const char *bracket_fault_text(enum bracket_fault f)
{
    return fault_text[f];
}

double bracket_exposure(const struct raw_frame *f)
{
    static const double least = 1e-18, most = 1e18; // further than any shutter, filter, lens and sensor; squares of 1 / h still are floats
    const double n = f->f_number > 0 ? f->f_number : 1, iso = f->iso > 0 ? f->iso : 100;
    const double h = f->exposure_s > 0 ? f->exposure_s * iso / 100 / (n * n) : 0;
    return h >= least && h <= most ? h : 0;
}

int bracket_new(struct bracket **out, const struct raw_frame *first, const struct bracket_options *o)
{
    *out = NULL;
    if (first->width < 4 || first->height < 4 || !(o->noise.electrons_at_white > 0) || !(o->noise.read_noise_e >= 0))
        return -EINVAL;
    struct bracket *b = calloc(1, sizeof(*b));
    if (!b)
        return -ENOMEM;
    const size_t width = (size_t)first->width, n = width * (size_t)first->height;
    b->like = *first;
    b->like.site = NULL;
    b->noise = o->noise;
    b->usable = o->usable > 0 ? fmin(o->usable, clip_level) : .9;
    b->gain_refused = o->gain_refused > 0 ? o->gain_refused : .15;
    b->bloom_px = o->bloom_px < 0 ? 0 : o->bloom_px == 0 ? 1 : o->bloom_px > 8 ? 8 : o->bloom_px;
    b->saturation = first->saturation;
    b->blocks_x = (first->width + BRACKET_BLOCK_PX - 1) / BRACKET_BLOCK_PX;
    b->blocks_y = (first->height + BRACKET_BLOCK_PX - 1) / BRACKET_BLOCK_PX;
    b->num = calloc(n, sizeof(*b->num));
    b->den = calloc(n, sizeof(*b->den));
    b->row_quality = malloc(width);
    b->saturated = malloc((size_t)(2 * b->bloom_px + 1) * width);
    b->block = malloc((size_t)b->blocks_x * (size_t)b->blocks_y * sizeof(*b->block));
    if (!b->num || !b->den || !b->row_quality || !b->saturated || !b->block) {
        bracket_free(b);
        return -ENOMEM;
    }
    *out = b;
    return 0;
}

void bracket_free(struct bracket *b)
{
    if (!b)
        return;
    free(b->taken);
    free(b->num);
    free(b->den);
    free(b->row_quality);
    free(b->saturated);
    free(b->block);
    free(b);
}

void merged_free(struct merged *m)
{
    if (m) {
        free(m->radiance);
        free(m->variance);
        free(m->quality);
        *m = (struct merged){ 0 };
    }
}

void merged_unshade(struct merged *m, const struct lens *lens)
{
    if (lens->v[0] == 0 && lens->v[1] == 0 && lens->v[2] == 0)
        return;
    for (int y = 0; y < m->height; y++)
        for (int x = 0; x < m->width; x++) {
            const size_t i = (size_t)y * (size_t)m->width + (size_t)x;
            const float k = (float)(1 / fmax(lens_shading(lens, (double[2]){ x + .5, y + .5 }), .01)); // beyond the circle there is nothing
            m->radiance[i] *= k;
            m->variance[i] *= k * k;
        }
}

// ---- does the frame belong? ---------------------------------------------------------------------------------------------------

static bool differs(const char *a, const char *b)
{
    return a[0] && b[0] && strcmp(a, b) != 0;
}

static enum bracket_fault check_facts(const struct raw_frame *a, const struct raw_frame *f, double exposure)
{
    if (differs(a->serial, f->serial) || differs(a->make, f->make) || differs(a->model, f->model))
        return BRACKET_OTHER_CAMERA;
    if (a->width != f->width || a->height != f->height)
        return BRACKET_OTHER_SIZE;
    if (memcmp(a->cfa, f->cfa, sizeof(a->cfa)) != 0)
        return BRACKET_OTHER_FILTERS;
    if (a->white != f->white || memcmp(a->black, f->black, sizeof(a->black)) != 0)
        return BRACKET_OTHER_LEVELS;
    if (a->iso != f->iso)
        return BRACKET_OTHER_ISO;
    if (fabs(a->f_number - f->f_number) > .01 * a->f_number)
        return BRACKET_OTHER_APERTURE;
    return exposure > 0 ? BRACKET_FITS : BRACKET_NO_TIME;
}

// What is darker cannot be told from it.
static double floor_radiance(const struct bracket *b, double longest)
{
    return b->noise.read_noise_e / (b->noise.electrons_at_white * longest);
}

// ---- rows: which sites of a frame are good ------------------------------------------------------------------------------------

struct rows {
    const struct bracket *b;
    const struct raw_frame *f, *shorter; // shorter: or NULL
    double ratio; // of f's exposure to it
    bool is_dry;  // what overflows was found not to reach its neighbours
    int next; // row whose saturation is marked next
};

static void mark_saturated(struct rows *r, int y)
{
    const struct bracket *b = r->b;
    const int n = 2 * b->bloom_px + 1, width = r->f->width;
    for (; r->next <= y + b->bloom_px && r->next < r->f->height; r->next++) {
        const uint16_t *site = r->f->site + (size_t)r->next * (size_t)width;
        uint8_t *mark = b->saturated + (size_t)(r->next % n) * (size_t)width;
        for (int x = 0; x < width; x++) {
            const double black = b->like.black[r->next & 1][x & 1];
            mark[x] = 0;
            if (site[x] < black + clip_level * (b->saturation - black))
                continue;
            const double beyond = r->shorter ? (r->shorter->site[(size_t)r->next * (size_t)width + (size_t)x] - black) * r->ratio : INFINITY;
            mark[x] = beyond >= bloom_level * (b->saturation - black) ? OVERFLOWING : SATURATED;
        }
    }
}

// Of a frame that rests: the rows above y, which this sweep does not look at again.
static void leave_rows(const struct raw_frame *f, int y)
{
    if (f && f->is_resting && y % 64 == 0)
        resting_leave(f->site, 0, (size_t)y * (size_t)f->width * sizeof(*f->site));
}

// Quality of every site of row y into b->row_quality. To be called for y = 0, 1, 2, ...
static void judge_row(struct rows *r, int y)
{
    const struct bracket *b = r->b;
    leave_rows(r->f, y);
    leave_rows(r->shorter, y);
    const int n = 2 * b->bloom_px + 1, width = r->f->width, reach = b->bloom_px;
    const uint16_t *site = r->f->site + (size_t)y * (size_t)width;
    mark_saturated(r, y);
    for (int x = 0; x < width; x++) {
        const double black = b->like.black[y & 1][x & 1];
        b->row_quality[x] = site[x] <= black + b->usable * (b->saturation - black) ? BRACKET_GOOD : BRACKET_POOR;
    }
    for (int v = y - reach < 0 ? 0 : y - reach; v <= y + reach && v < r->f->height && !r->is_dry; v++) {
        const uint8_t *mark = b->saturated + (size_t)(v % n) * (size_t)width;
        if (!memchr(mark, OVERFLOWING, (size_t)width))
            continue;
        for (int x = 0; x < width; x++)
            for (int u = x - reach < 0 ? 0 : x - reach; mark[x] == OVERFLOWING && u <= x + reach && u < width; u++)
                if (b->row_quality[u] == BRACKET_GOOD)
                    b->row_quality[u] = BRACKET_POOR;
    }
    const uint8_t *mark = b->saturated + (size_t)(y % n) * (size_t)width;
    for (int x = 0; x < width; x++)
        if (mark[x])
            b->row_quality[x] = BRACKET_CLIPPED;
}

// Most sensors of today do not bloom. The sites that the margin around overflowing ones takes out are in the next shorter frame, too, where
// less overflows or nothing: as long as they agree there, in the mean and each within its noise, they are as good as any.
static bool is_dry(struct rows rows, double h)
{
    enum { LEAST_SITES = 100 };
    static const double most_excess = .005, most_chi2 = 1.3;
    const struct bracket *b = rows.b;
    const double w = b->noise.electrons_at_white, read = b->noise.read_noise_e / w, ratio = rows.ratio;
    double excess = 0, total = 0, chi2 = 0;
    int64_t n = 0;
    for (int y = 0; rows.shorter && y < rows.f->height; y++) {
        const size_t row = (size_t)y * (size_t)rows.f->width;
        judge_row(&rows, y);
        for (int x = 0; x < rows.f->width; x++) {
            const double black = b->like.black[y & 1][x & 1], site = rows.f->site[row + (size_t)x];
            if (b->row_quality[x] != BRACKET_POOR || site > black + b->usable * (b->saturation - black))
                continue;
            const double range = b->like.white - black, s = (site - black) / range, p = ratio * (rows.shorter->site[row + (size_t)x] - black) / range;
            const double m = fmax((ratio * s + p) / (1 + ratio), floor_radiance(b, h) * h); // as both say, by their exposures
            const double d = s - p;
            excess += d, total += m;
            chi2 += d * d / (m / w * (1 + ratio) + read * read * (1 + ratio * ratio));
            n++;
        }
    }
    return n >= LEAST_SITES && fabs(excess) <= most_excess * total && chi2 <= most_chi2 * (double)n;
}

// ---- comparing ------------------------------------------------------------------------------------------------------------------

static void compare_blocks(struct bracket *b, struct rows rows, double h)
{
    const double w = b->noise.electrons_at_white, read = b->noise.read_noise_e / w, least = floor_radiance(b, b->longest);
    const struct raw_frame *f = rows.f;
    memset(b->block, 0, (size_t)b->blocks_x * (size_t)b->blocks_y * sizeof(*b->block));
    for (int y = 0; y < f->height; y++) {
        const size_t row = (size_t)y * (size_t)f->width;
        struct block *blocks = b->block + (size_t)(y / BRACKET_BLOCK_PX) * (size_t)b->blocks_x;
        judge_row(&rows, y);
        for (int x = 0; x < f->width; x++) {
            const size_t i = row + (size_t)x;
            if (b->row_quality[x] != BRACKET_GOOD || !(b->den[i] > 0))
                continue;
            const double black = b->like.black[y & 1][x & 1], s = (f->site[i] - black) / (b->like.white - black);
            const double radiance = (double)b->num[i] / (double)b->den[i], m = radiance * h;
            const double v = fmax(radiance, least) * h / w * (1 + h / (double)b->den[i]) + read * read;
            struct block *k = blocks + x / BRACKET_BLOCK_PX;
            k->n++;
            k->y += s, k->m += m, k->v += v;
            k->yy_v += s * s / v, k->ym_v += s * m / v, k->mm_v += m * m / v;
        }
    }
}

static int compare_doubles(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double median(double *v, int n)
{
    qsort(v, (size_t)n, sizeof(*v), compare_doubles);
    return n & 1 ? v[n / 2] : .5 * (v[n / 2 - 1] + v[n / 2]);
}

static bool is_compared(const struct block *k)
{
    return k->n >= BRACKET_BLOCK_PX * BRACKET_BLOCK_PX / 4 && k->m > 20 * sqrt(k->v);
}

static double chi2_of(const struct block *k, double gain)
{
    return (k->yy_v - 2 * gain * k->ym_v + gain * gain * k->mm_v) / k->n;
}

// Its mean, or its pattern, differs by more than noise (usual: chi^2 of a usual block) and by enough to matter.
static bool is_changed(const struct block *k, double gain, double usual)
{
    const double mean = (k->y - gain * k->m) / sqrt(k->v * fmax(usual, 1)), chi2 = chi2_of(k, gain) / fmax(usual, 1);
    const double pattern = sqrt(fmax(chi2 - 1, 0) * fmax(usual, 1) * k->v * k->n) / k->m; // RMS over mean
    return (fabs(mean) > 7 && fabs(k->y / (gain * k->m) - 1) > .02) || (chi2 > 1 + 10 * sqrt(2. / k->n) && pattern > .05);
}

// The largest patch of changed blocks (8 neighbours). mark: 1 changed; becomes 2 when visited. stack: room for all blocks.
static void find_patch(const struct bracket *b, uint8_t *mark, int *stack, double gain, struct bracket_frame_report *r)
{
    const int nx = b->blocks_x, n_blocks = nx * b->blocks_y;
    for (int seed = 0; seed < n_blocks; seed++) {
        if (mark[seed] != 1)
            continue;
        int n = 0, count = 0;
        double x = 0, y = 0, sum_y = 0, sum_m = 0;
        stack[n++] = seed;
        mark[seed] = 2;
        while (n) {
            const int at = stack[--n], bx = at % nx, by = at / nx;
            count++;
            x += bx + .5, y += by + .5;
            sum_y += b->block[at].y, sum_m += b->block[at].m;
            for (int v = by - 1; v <= by + 1; v++)
                for (int u = bx - 1; u <= bx + 1; u++)
                    if (u >= 0 && v >= 0 && u < nx && v < b->blocks_y && mark[v * nx + u] == 1) {
                        mark[v * nx + u] = 2;
                        stack[n++] = v * nx + u;
                    }
        }
        if (count > r->largest_change) {
            r->largest_change = count;
            r->changed_at_px[0] = BRACKET_BLOCK_PX * x / count, r->changed_at_px[1] = BRACKET_BLOCK_PX * y / count;
            r->change = sum_y / (gain * sum_m);
        }
    }
}

static int compare_frame(struct bracket *b, struct rows rows, double h, struct bracket_frame_report *r)
{
    const int n_blocks = b->blocks_x * b->blocks_y;
    double *v = malloc((size_t)n_blocks * sizeof(*v));
    int *stack = malloc((size_t)n_blocks * sizeof(*stack));
    uint8_t *mark = calloc((size_t)n_blocks, 1);
    int err = -ENOMEM, n = 0;
    if (!v || !stack || !mark)
        goto out;
    err = 0;
    compare_blocks(b, rows, h);
    for (int i = 0; i < n_blocks; i++)
        if (is_compared(b->block + i))
            v[n++] = b->block[i].y / b->block[i].m;
    r->n_blocks = n;
    if (!n)
        goto out;
    r->gain = median(v, n);
    for (int i = 0; i < n; i++)
        v[i] = fabs(v[i] - r->gain);
    r->gain_error = 1.2533 * 1.4826 * median(v, n) / sqrt(n);
    double chi2 = 0, count = 0, sum_m = 0, sum_v = 0;
    for (int i = 0; i < n_blocks; i++)
        if (is_compared(b->block + i))
            sum_m += b->block[i].m, sum_v += b->block[i].v;
    r->gain_error = fmax(r->gain_error, 1.2533 * sqrt(sum_v) / sum_m); // few blocks may agree by chance
    n = 0;
    for (int i = 0; i < n_blocks; i++)
        if (is_compared(b->block + i)) {
            v[n] = chi2_of(b->block + i, r->gain);
            chi2 += v[n++] * b->block[i].n;
            count += b->block[i].n;
        }
    r->chi2 = chi2 / count;
    const double usual = median(v, n);
    for (int i = 0; i < n_blocks; i++)
        if (is_compared(b->block + i) && is_changed(b->block + i, r->gain, usual))
            mark[i] = 1, r->n_changed++;
    find_patch(b, mark, stack, r->gain, r);
out:
    free(v);
    free(stack);
    free(mark);
    return err;
}

// ---- taking in ------------------------------------------------------------------------------------------------------------------

static void take_in(struct bracket *b, struct rows rows, double h, struct bracket_frame_report *r)
{
    const double w = b->noise.electrons_at_white, s = b->noise.read_noise_e;
    const struct raw_frame *f = rows.f;
    for (int y = 0; y < f->height; y++) {
        const size_t row = (size_t)y * (size_t)f->width;
        judge_row(&rows, y);
        for (int x = 0; x < f->width; x++) {
            const size_t i = row + (size_t)x;
            const uint8_t quality = b->row_quality[x];
            const double black = b->like.black[y & 1][x & 1], signal = (f->site[i] - black) / (b->like.white - black);
            if (quality == BRACKET_CLIPPED) {
                r->n_clipped++;
                if (b->den[i] == 0)
                    b->num[i] = fmaxf(b->num[i], (float)(signal / h));
                continue;
            }
            *(quality == BRACKET_GOOD ? &r->n_good : &r->n_poor) += 1;
            if (quality == BRACKET_POOR && b->den[i] > 0)
                continue;
            const bool is_first = quality == BRACKET_GOOD ? !(b->den[i] > 0) : b->den[i] == 0;
            const float num = is_first ? 0 : b->num[i], den = is_first ? 0 : fabsf(b->den[i]);
            const double expected = fmax(is_first ? signal * w : (double)num / (double)den * h * w, s);
            const double u = s > 0 ? expected / (expected + s * s) : 1;
            b->num[i] = num + (float)(u * signal);
            b->den[i] = copysignf(den + (float)(u * h), quality == BRACKET_GOOD ? 1 : -1);
        }
    }
}

int bracket_add(struct bracket *b, const struct raw_frame *f, const struct raw_frame *next, struct bracket_frame_report *r)
{
    const double h = bracket_exposure(f), h_next = next ? bracket_exposure(next) : 0;
    struct rows rows = { .b = b, .f = f };
    if (h_next > 0 && h_next < h && check_facts(&b->like, next, h_next) == BRACKET_FITS)
        rows.shorter = next, rows.ratio = h / h_next;
    *r = (struct bracket_frame_report){ .exposure = h, .gain = 1, .gain_error = INFINITY, .change = 1, .chi2 = 1 };
    r->fault = check_facts(&b->like, f, h);
    if (r->fault != BRACKET_FITS)
        return 0;
    double *taken = realloc(b->taken, (size_t)(b->n_taken + 1) * sizeof(*taken));
    if (!taken)
        return -ENOMEM;
    b->taken = taken;
    struct plateau plateau;
    const int err_plateau = plateau_find(&plateau, f);
    if (err_plateau)
        return err_plateau;
    if (plateau.dn && b->reached <= plateau.top) {
        r->plateau_dn = plateau.dn;
        b->saturation = fmin(b->saturation, plateau.dn);
    }
    b->reached = plateau.reached > b->reached ? plateau.reached : b->reached;
    rows.is_dry = is_dry(rows, h);
    for (int i = 0; i < b->n_taken; i++)
        r->is_repeat = r->is_repeat || fabs(h / b->taken[i] - 1) < .01;
    if (b->n_taken) {
        const int err = compare_frame(b, rows, h, r);
        if (err)
            return err;
        if (r->n_blocks >= 4 && fabs(r->gain - 1) > b->gain_refused) {
            r->fault = BRACKET_OTHER_BRIGHTNESS;
            return 0;
        }
    }
    b->longest = fmax(b->longest, h);
    b->taken[b->n_taken++] = h;
    take_in(b, rows, h, r);
    return 0;
}

// ---- the result -----------------------------------------------------------------------------------------------------------------

// A clipped site among neighbours that are all far darker is stuck, not lit: no lens draws a light that small.
static bool is_stuck(const struct merged *m, int x, int y)
{
    const size_t width = (size_t)m->width, i = (size_t)y * width + (size_t)x;
    for (int v = y - 1; v <= y + 1; v++)
        for (int u = x - 1; u <= x + 1; u++) {
            if (u < 0 || v < 0 || u >= m->width || v >= m->height || (u == x && v == y))
                continue;
            const size_t k = (size_t)v * width + (size_t)u;
            if (m->quality[k] == BRACKET_CLIPPED || m->radiance[k] > m->radiance[i] / 8)
                return false;
        }
    return true;
}

static void fill_in(struct merged *m, int x, int y)
{
    const size_t width = (size_t)m->width, i = (size_t)y * width + (size_t)x;
    const bool is_green = m->cfa[y & 1][x & 1] == RAW_GREEN;
    double sum = 0, variance = 0;
    int n = 0;
    for (int k = 0; k < 4; k++) { // greens touch at corners, others are two sites apart
        const int sign_x = k & 1 ? 1 : -1, sign_y = k & 2 ? 1 : -1;
        const int u = x + (is_green ? sign_x : k & 2 ? 2 * sign_x : 0), v = y + (is_green ? sign_y : k & 2 ? 0 : 2 * sign_x);
        if (u < 0 || v < 0 || u >= m->width || v >= m->height || m->quality[(size_t)v * width + (size_t)u] == BRACKET_CLIPPED)
            continue;
        sum += (double)m->radiance[(size_t)v * width + (size_t)u];
        variance += (double)m->variance[(size_t)v * width + (size_t)u];
        n++;
    }
    if (n) {
        m->radiance[i] = (float)(sum / n);
        m->variance[i] = (float)(variance / n);
        m->quality[i] = BRACKET_DEFECT;
    }
}

int bracket_finish(struct merged *out, struct bracket *b, int64_t *n_clipped, int64_t *n_defects)
{
    const size_t width = (size_t)b->like.width, n = width * (size_t)b->like.height;
    struct merged m = { .width = b->like.width, .height = b->like.height, .radiance = b->num, .variance = b->den };
    *out = (struct merged){ 0 };
    *n_clipped = *n_defects = 0;
    if (b->n_taken)
        m.quality = malloc(n);
    if (!m.quality) {
        const int err = b->n_taken ? -ENOMEM : -ENODATA;
        bracket_free(b);
        return err;
    }
    memcpy(m.cfa, b->like.cfa, sizeof(m.cfa));
    const double least = floor_radiance(b, b->longest), w = b->noise.electrons_at_white;
    for (size_t i = 0; i < n; i++) {
        m.quality[i] = b->den[i] > 0 ? BRACKET_GOOD : b->den[i] < 0 ? BRACKET_POOR : BRACKET_CLIPPED;
        if (m.quality[i] != BRACKET_CLIPPED) {
            const double den = fabs((double)b->den[i]), radiance = (double)b->num[i] / den;
            m.variance[i] = (float)(fmax(radiance, least) / (w * den));
            m.radiance[i] = (float)radiance;
        } else {
            m.variance[i] = m.radiance[i] * m.radiance[i]; // unknown
        }
    }
    for (int y = 0; y < m.height; y++)
        for (int x = 0; x < m.width; x++)
            if (m.quality[(size_t)y * width + (size_t)x] == BRACKET_CLIPPED) {
                if (is_stuck(&m, x, y))
                    fill_in(&m, x, y);
                *(m.quality[(size_t)y * width + (size_t)x] == BRACKET_CLIPPED ? n_clipped : n_defects) += 1;
            }
    b->num = b->den = NULL;
    bracket_free(b);
    *out = m;
    return 0;
}
