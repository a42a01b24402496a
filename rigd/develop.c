// rigd/develop.c - LibRaw, and nothing else knows it.
#include "rigd/develop.h"
#include "rigd/exif.h"
#include "rigd/resting.h"

#include <errno.h>
#include <fcntl.h>
#include <libraw/libraw.h>
#include <math.h>
#include <omp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#if LIBRAW_COMPILE_CHECK_VERSION_NOTLESS(0, 21)
typedef INT64 file_offset;
#else
typedef int file_offset;
#endif

// ---- opening -----------------------------------------------------------------------------------------------------------------

enum { LEAVE_ROWS = 64 }; // memory goes back in bands of so many rows

struct decoder {
    libraw_data_t *raw;
    long long damaged_at; // UNDAMAGED; -1: LibRaw cannot say where
};
enum { UNDAMAGED = -2 };

static void note_damage(void *arg, const char *file, const file_offset offset)
{
    struct decoder *d = arg;
    (void)file;
    if (d->damaged_at == UNDAMAGED)
        d->damaged_at = offset;
}

static int errno_of(int code)
{
    switch (code) {
    case LIBRAW_SUCCESS:
        return 0;
    case LIBRAW_FILE_UNSUPPORTED:
        return -ENOTSUP;
    case LIBRAW_UNSUFFICIENT_MEMORY:
        return -ENOMEM;
    default:
        return code > 0 ? -code : -EBADMSG; // > 0: errno
    }
}

// A step of LibRaw has ended with code: 0, or -errno and why.
static int outcome(const struct decoder *d, int code, char *why, size_t room)
{
    if (!code && d->damaged_at == UNDAMAGED)
        return 0;
    if (!code) {
        snprintf(why, room, "LibRaw found damaged data at byte %lld", d->damaged_at);
        return -EBADMSG;
    }
    snprintf(why, room, "LibRaw: %s", code > 0 ? "cannot read it" : libraw_strerror(code));
    return errno_of(code);
}

static int decoder_open(struct decoder *d, const char *path, char *why, size_t room)
{
    *d = (struct decoder){ .raw = libraw_init(0), .damaged_at = UNDAMAGED };
    if (!d->raw) {
        snprintf(why, room, "out of memory");
        return -ENOMEM;
    }
    omp_set_num_threads(1); // a rig has one process per core
    libraw_set_dataerror_handler(d->raw, note_damage, d);
    const int fd = open(path, O_RDONLY | O_CLOEXEC); // LibRaw does not say why
    if (fd < 0) {
        const int err = -errno;
        snprintf(why, room, "%s", strerror(-err));
        return err;
    }
    close(fd);
    const int code = libraw_open_file(d->raw, path);
    return code ? outcome(d, code, why, room) : 0;
}

static void decoder_close(struct decoder *d)
{
    if (d->raw)
        libraw_close(d->raw);
    d->raw = NULL;
}

int develop_check(const char *path, char *why, size_t room)
{
    struct decoder d;
    int err = decoder_open(&d, path, why, room);
    if (!err)
        err = outcome(&d, libraw_unpack(d.raw), why, room);
    decoder_close(&d);
    return err;
}

// ---- one frame ---------------------------------------------------------------------------------------------------------------

// libraw_COLOR counts the two greens as 1 and 3.
static int filter_at(libraw_data_t *raw, int y, int x)
{
    const int c = libraw_COLOR(raw, y, x);
    return c == 3 ? RAW_GREEN : c;
}

static int require_bayer(libraw_data_t *raw, char *why, size_t room)
{
    const unsigned filters = raw->idata.filters;
    const char *found = raw->rawdata.float_image                                                           ? "photosites in floating point"
                        : !raw->rawdata.raw_image                                                          ? "pixels that are interpolated already"
                        : filters == 9                                                                     ? "an X-Trans sensor"
                        : filters < 1000 || raw->idata.colors != 3                                         ? "another colour filter array"
                        : (filters & 0xff) * 0x01010101u != filters                                        ? "a colour filter array that does not repeat after 2 rows"
                        : raw->color.cblack[4] > 2 || raw->color.cblack[5] > 2                             ? "black levels that do not repeat after 2 sites"
                        : raw->sizes.width < 4 || raw->sizes.height < 4 ? "no picture"
                                                                                                           : NULL;
    if (!found)
        return 0;
    snprintf(why, room, "found %s; expected the photosites of a Bayer sensor (red, green, blue)", found);
    return -ENOTSUP;
}

// Black is a common level, one per colour, and a pattern; all add up.
static int read_levels(struct raw_frame *f, libraw_data_t *raw, char *why, size_t room)
{
    const libraw_colordata_t *color = &raw->color;
    const unsigned rows = color->cblack[4], columns = color->cblack[5];
    for (unsigned y = 0; y < 2; y++)
        for (unsigned x = 0; x < 2; x++) {
            f->cfa[y][x] = (uint8_t)filter_at(raw, (int)y, (int)x);
            f->black[y][x] = color->black + color->cblack[libraw_COLOR(raw, (int)y, (int)x)];
            if (rows && columns)
                f->black[y][x] += color->cblack[6 + y % rows * columns + x % columns];
        }
    f->white = color->maximum;
    f->saturation = f->white;
    for (int c = 0; c < 4 && !raw->idata.dng_version; c++) // the maker's own figure; a DNG's is its white level
        if (color->linear_max[c] > 0 && (double)color->linear_max[c] < f->saturation)
            f->saturation = (double)color->linear_max[c];
    for (int i = 0; i < 4; i++)
        if (!(f->black[i / 2][i % 2] < f->saturation)) {
            snprintf(why, room, "found a black level of %g and a white level of %g; expected black below white", f->black[i / 2][i % 2], f->saturation);
            return -EBADMSG;
        }
    return 0;
}

static bool invert(const double m[3][3], double out[3][3])
{
    double det = 0;
    for (int i = 0; i < 3; i++)
        det += m[0][i] * (m[1][(i + 1) % 3] * m[2][(i + 2) % 3] - m[1][(i + 2) % 3] * m[2][(i + 1) % 3]);
    if (!(fabs(det) > 1e-6))
        return false;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[j][i] = (m[(i + 1) % 3][(j + 1) % 3] * m[(i + 2) % 3][(j + 2) % 3] - m[(i + 1) % 3][(j + 2) % 3] * m[(i + 2) % 3][(j + 1) % 3]) / det;
    return true;
}

// camera_from_xyz: a DNG's own for D65, or the last it has; else LibRaw's table, which would otherwise prevail over what the file says.
static void read_matrix(const libraw_data_t *raw, double m[3][3])
{
    enum { D65 = 21 };
    const libraw_dng_color_t *own = NULL;
    for (int k = 0; k < 2 && raw->idata.dng_version; k++) {
        const libraw_dng_color_t *c = &raw->color.dng_color[k];
        if (c->colormatrix[0][0] != 0 && !(own && own->illuminant == D65))
            own = c;
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const double balance = own && raw->color.dng_levels.analogbalance[i] > 0 ? (double)raw->color.dng_levels.analogbalance[i] : 1;
            m[i][j] = own ? balance * (double)own->colormatrix[i][j] : (double)raw->color.cam_xyz[i][j];
        }
}

// camera_from_srgb = camera_from_xyz x xyz_from_srgb. Its rows' sums are the camera's answer to a white of D65: daylight takes it off.
static void read_colour(struct raw_frame *f, const libraw_data_t *raw)
{
    static const double most_apart = 100;
    static const double xyz_from_srgb[3][3] = { { .4124564, .3575761, .1804375 }, { .2126729, .7151522, .0721750 }, { .0193339, .1191920, .9503041 } };
    double camera_from_xyz[3][3], camera_from_srgb[3][3] = { { 0 } }, answer[3] = { 0 };
    read_matrix(raw, camera_from_xyz);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            for (int k = 0; k < 3; k++)
                camera_from_srgb[i][j] += camera_from_xyz[i][k] * xyz_from_srgb[k][j];
            answer[i] += camera_from_srgb[i][j];
        }
    f->has_colour = answer[0] > 1e-3 && answer[1] > 1e-3 && answer[2] > 1e-3;
    for (int i = 0; i < 3 && f->has_colour; i++)
        for (int j = 0; j < 3; j++)
            camera_from_srgb[i][j] /= answer[i];
    for (int i = 0; i < 3; i++) // NaN and infinities, too: no camera has colours so far apart
        f->has_colour = f->has_colour && answer[1] < most_apart * answer[i] && answer[i] < most_apart * answer[1];
    f->has_colour = f->has_colour && invert(camera_from_srgb, f->srgb_from_camera);
    for (int i = 0; i < 3; i++) {
        f->daylight[i] = f->has_colour ? answer[1] / answer[i] : 1;
        for (int j = 0; j < 3 && !f->has_colour; j++)
            f->srgb_from_camera[i][j] = i == j;
    }
}

static void copy_text(char *to, size_t room, const char *from)
{
    size_t n = 0;
    for (; *from && n + 1 < room; from++)
        to[n++] = (unsigned char)*from < ' ' || (unsigned char)*from > '~' ? '?' : *from;
    for (; n && to[n - 1] == ' '; n--)
        ;
    to[n] = 0;
}

static double plausible(double v, double most)
{
    return v > 0 && v <= most ? v : 0;
}

static void read_exposure(struct raw_frame *f, const libraw_data_t *raw, const char *path)
{
    static const uint8_t orientation_of_flip[8] = { 1, 2, 4, 3, 5, 8, 6, 7 }; // dcraw's bits: 1 mirror, 2 upside down, 4 transpose
    struct exif exif = { 0 };
    const int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd >= 0) {
        exif_read(&exif, fd);
        close(fd);
    }
    f->label_s = exif.label_s ? exif.label_s : plausible((double)raw->other.shutter, 1e5);
    f->exposure_s = exif_true_time_s(f->label_s, exif.apex_s);
    f->f_number = exif.f_number ? exif.f_number : plausible((double)raw->other.aperture, 1e3);
    f->focal_mm = exif.focal_mm ? exif.focal_mm : plausible((double)raw->other.focal_len, 1e5);
    f->iso = plausible((double)raw->other.iso_speed, 1e8);
    f->has_time = exif.has_time;
    f->has_subseconds = exif.has_subseconds;
    f->taken_ns = exif.taken_ns;
    struct tm tm;
    if (!f->has_time && raw->other.timestamp > 0 && raw->other.timestamp < 7000000000 && localtime_r(&raw->other.timestamp, &tm)) { // mktime's, of this host's zone
        f->has_time = true;
        f->taken_ns = (int64_t)timegm(&tm) * 1000000000;
    }
    f->orientation = exif.orientation ? exif.orientation : orientation_of_flip[raw->sizes.flip & 7];
    copy_text(f->make, sizeof(f->make), raw->idata.make);
    copy_text(f->model, sizeof(f->model), raw->idata.model);
    copy_text(f->serial, sizeof(f->serial), raw->shootinginfo.BodySerial[0] ? raw->shootinginfo.BodySerial : exif.serial);
    copy_text(f->lens, sizeof(f->lens), exif.lens[0] ? exif.lens : raw->lens.Lens);
}

// LibRaw's photosites are gone afterwards.
static int copy_sites(struct raw_frame *f, const libraw_data_t *raw, char *why, size_t room)
{
    const libraw_image_sizes_t *s = &raw->sizes;
    const size_t pitch = s->raw_pitch ? s->raw_pitch / 2 : s->raw_width;
    if (s->left_margin + s->width > (int)pitch || s->top_margin + s->height > s->raw_height) {
        snprintf(why, room, "found a picture of %d x %d in a sensor of %d x %d", s->width, s->height, s->raw_width, s->raw_height);
        return -EBADMSG;
    }
    f->site = malloc((size_t)s->width * s->height * sizeof(f->site[0]));
    if (!f->site) {
        snprintf(why, room, "no memory for %d x %d photosites", s->width, s->height);
        return -ENOMEM;
    }
    f->width = s->width, f->height = s->height;
    for (int y = 0; y < f->height; y++) {
        const size_t row = (size_t)(y + s->top_margin) * pitch;
        if (y % LEAVE_ROWS == 0) // so that both together take the memory of one
            resting_leave(raw->rawdata.raw_image, 0, row * sizeof(f->site[0]));
        memcpy(f->site + (size_t)y * (size_t)f->width, raw->rawdata.raw_image + row + s->left_margin, (size_t)f->width * sizeof(f->site[0]));
    }
    return 0;
}

int raw_read(struct raw_frame *out, const char *path, char *why, size_t room)
{
    struct decoder d;
    struct raw_frame f = { 0 };
    *out = f;
    int err = decoder_open(&d, path, why, room);
    if (!err)
        err = outcome(&d, libraw_unpack(d.raw), why, room);
    if (!err)
        err = require_bayer(d.raw, why, room);
    if (!err) {
        err = read_levels(&f, d.raw, why, room);
        read_colour(&f, d.raw);
        read_exposure(&f, d.raw, path);
    }
    if (!err)
        err = copy_sites(&f, d.raw, why, room);
    decoder_close(&d);
    if (!err)
        *out = f;
    return err;
}

void raw_free(struct raw_frame *f)
{
    if (f) {
        if (f->is_resting)
            resting_free(f->site, (size_t)f->width * (size_t)f->height * sizeof(f->site[0]));
        else
            free(f->site);
        *f = (struct raw_frame){ 0 };
    }
}

void raw_rest(struct raw_frame *f, const char *folder)
{
    const size_t row = (size_t)f->width * sizeof(f->site[0]), n_bytes = row * (size_t)f->height;
    uint16_t *to = f->site && !f->is_resting ? resting_new(folder, n_bytes) : NULL;
    for (size_t at = 0; to && at < n_bytes; at += LEAVE_ROWS * row) {
        const size_t end = n_bytes - at < LEAVE_ROWS * row ? n_bytes : at + LEAVE_ROWS * row;
        memcpy((char *)to + at, (char *)f->site + at, end - at);
        resting_leave(f->site, 0, end);
        resting_leave(to, 0, end);
    }
    if (to) {
        free(f->site);
        f->site = to;
        f->is_resting = true;
    }
}

int raw_read_head(struct raw_frame *out, const char *path, char *why, size_t room)
{
    struct decoder d;
    *out = (struct raw_frame){ 0 };
    const int err = decoder_open(&d, path, why, room);
    if (!err) {
        out->width = d.raw->sizes.width;
        out->height = d.raw->sizes.height;
        read_colour(out, d.raw);
        read_exposure(out, d.raw, path);
    }
    decoder_close(&d);
    return err;
}

const char *raw_library(void)
{
    return libraw_version();
}

// ---- interpolated ------------------------------------------------------------------------------------------------------------

// What dcraw is told by -4 -o 0 -r 1 1 1 1 -t 0. adjust_maximum_thr: LibRaw's own idea, which lowers the white level to the picture's.
static void as_dcraw(libraw_output_params_t *p, enum raw_quality quality)
{
    p->output_bps = 16;
    p->gamm[0] = p->gamm[1] = 1;
    p->no_auto_bright = 1;
    p->adjust_maximum_thr = 0;
    p->use_camera_wb = p->use_auto_wb = 0;
    for (int i = 0; i < 4; i++)
        p->user_mul[i] = 1;
    p->output_color = 0;
    p->user_flip = 0;
    p->user_qual = quality;
}

int raw_interpolate(struct raw_rgb *out, const char *path, enum raw_quality quality, const struct raw_frame *like, char *why, size_t room)
{
    enum { PEDESTAL_DN = 64 };
    struct decoder *d = calloc(1, sizeof(*d));
    double black[3] = { 0 }, pedestal = PEDESTAL_DN;
    *out = (struct raw_rgb){ 0 };
    if (!d) {
        snprintf(why, room, "out of memory");
        return -ENOMEM;
    }
    int err = decoder_open(d, path, why, room);
    if (!err)
        err = outcome(d, libraw_unpack(d->raw), why, room);
    if (!err)
        err = require_bayer(d->raw, why, room);
    if (err)
        goto fail;
    libraw_output_params_t *p = &d->raw->params;
    as_dcraw(p, quality);
    for (int i = 0; i < 4 && like; i++)
        pedestal = fmin(pedestal, like->black[i / 2][i % 2]);
    for (int i = 0; i < 4 && like; i++) {
        const int y = i / 2, x = i % 2, filter = like->cfa[y][x];
        p->user_cblack[libraw_COLOR(d->raw, y, x)] = (int)(like->black[y][x] - pedestal);
        black[filter] += like->black[y][x] / (filter == RAW_GREEN ? 2 : 1);
        p->user_mul[libraw_COLOR(d->raw, y, x)] = (float)like->daylight[filter];
    }
    if (like) {
        p->user_black = 0;
        p->highlight = 1; // the largest multiplier becomes 1: nothing is cut off
    }
    err = outcome(d, libraw_dcraw_process(d->raw), why, room);
    if (err)
        goto fail;
    out->width = d->raw->sizes.iwidth;
    out->height = d->raw->sizes.iheight;
    out->pixel = (const uint16_t(*)[4])d->raw->image;
    out->decoder = d;
    if (!d->raw->image || (like && (out->width != like->width || out->height != like->height))) {
        snprintf(why, room, "LibRaw gave %d x %d pixels", out->width, out->height);
        err = -EBADMSG;
        goto fail;
    }
    for (int c = 0; c < 3 && like; c++) { // what LibRaw multiplied by
        const double most = fmax(like->daylight[0], fmax(like->daylight[1], like->daylight[2]));
        const double scale = like->daylight[c] / most * 65535 / d->raw->color.maximum, range = like->white - black[c];
        out->unit[c] = 1 / (scale * range);
        out->pedestal[c] = pedestal / range;
    }
    return 0;
fail:
    decoder_close(d);
    free(d);
    *out = (struct raw_rgb){ 0 };
    return err;
}

void raw_rgb_free(struct raw_rgb *r)
{
    if (r && r->decoder) {
        decoder_close(r->decoder);
        free(r->decoder);
    }
    if (r)
        *r = (struct raw_rgb){ 0 };
}
