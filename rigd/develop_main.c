// rigd/develop_main.c - build/bin/rigd-develop: one raw becomes one linear EXR, in a process of its own: a decoder that dies of a file costs
// one frame, all memory comes back, and a rig has as many as it has cores.
//
// It says what came of it as one line of JSON on standard output, whatever happens; people read standard error. DESIGN: exit status 0 done,
// 1 failed, 2 usage, 3 done but not to be trusted (warnings say why).
#include "rigd/colour.h"
#include "rigd/develop.h"
#include "rigd/develop_options.h"
#include "rigd/digest.h"
#include "rigd/linear.h"
#include "rigd/plateau.h"
#include "solver/take/image.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <argp.h>
#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum { EXIT_DONE = 0, EXIT_FAILED = 1, EXIT_USAGE = 2, EXIT_DOUBTFUL = 3, FLATS_MAX = 1024, WHY_BYTES = 300, MADE_BYTES = 2000, MOST_SECONDS = 600 };

struct exposure {
    double time_s, f_number, iso;
};

struct arguments {
    enum demosaic demosaic;
    bool tiff, if_changed;
    const char *flat[FLATS_MAX];
    int n_flats;
    const char *colour_path, *raw, *out;
    struct exposure reference, given; // given: 0 where the file is believed
    double saturation;
    bool measure;
    double corner[4][2];
    int columns, rows;
};

static const char *const demosaic_names[] = { [DEMOSAIC_HALF] = "half", [DEMOSAIC_BILINEAR] = "bilinear", [DEMOSAIC_AHD] = "ahd" };
static const char *const spread_px[] = { [DEMOSAIC_HALF] = "0", [DEMOSAIC_BILINEAR] = "1", [DEMOSAIC_AHD] = "3" };

// ---- command line ------------------------------------------------------------------------------------------------------------

enum { OPTION_HALF = 256, OPTION_BILINEAR, OPTION_AHD, OPTION_TIFF, OPTION_FLAT, OPTION_COLOUR, OPTION_REFERENCE, OPTION_EXPOSURE, OPTION_SATURATION, OPTION_IF_CHANGED, OPTION_PATCH, OPTION_CHART };

static const struct argp_option options[] = {
    { "half", OPTION_HALF, NULL, 0, "One pixel per cell of four photosites", 0 },
    { "bilinear", OPTION_BILINEAR, NULL, 0, "Full size, the mean of the nearest photosites", 0 },
    { "ahd", OPTION_AHD, NULL, 0, "Full size, adaptive homogeneity-directed (default)", 0 },
    { "tiff", OPTION_TIFF, NULL, 0, "Also OUT with .tif: 16-bit linear camera RGB, the pixels of dcraw -4 -o 0 -r 1 1 1 1 -t 0 -q 0", 0 },
    { "flat", OPTION_FLAT, "FILE", 0, "Divide by this frame of an even white: a raw of the same body, lens and aperture, or an EXR. May be given more than once: the first raw that fits is taken", 0 },
    { "colour", OPTION_COLOUR, "FILE", 0, "Gains and scale of this body, as `rigctl calibrate colour' writes them", 0 },
    { "reference-exposure", OPTION_REFERENCE, "T,N,ISO", 0, "Radiance 1 is what brings the green photosites to the white level at this exposure (default 1/128,8,100)", 0 },
    { "exposure", OPTION_EXPOSURE, "T,N,ISO", 0, "What the exposure was, in place of what the file says; 0 leaves a value to the file", 0 },
    { "saturation", OPTION_SATURATION, "DN", 0, "Photosites from this value on are clipped (default: the white level, or where they pile up below it)", 0 },
    { "if-changed", OPTION_IF_CHANGED, NULL, 0, "Do nothing if OUT is whole and was made from this raw in this way", 0 },
    { "patch", OPTION_PATCH, "X,Y,W,H", 0, "No OUT: measure a grey card there, in photosites from the upper left of the sensor", 0 },
    { "chart", OPTION_CHART, "X1,Y1,..,X4,Y4", 0, "No OUT: measure a ColorChecker whose corners (dark skin's, bluish green's, black's, white's) lie there", 0 },
    { 0 },
};

static void parse_exposure(struct argp_state *state, const char *option, const char *text, struct exposure *to, bool zero_allowed)
{
    double v[3];
    if (!option_exposure(text, v, zero_allowed))
        argp_error(state, "%s: found '%s'; expected seconds, f-number and ISO such as 1/128,8,100", option, text);
    *to = (struct exposure){ v[0], v[1], v[2] };
}

static error_t parse_option(int key, char *text, struct argp_state *state)
{
    struct arguments *a = state->input;
    switch (key) {
    case OPTION_HALF:
    case OPTION_BILINEAR:
    case OPTION_AHD:
        a->demosaic = (enum demosaic)(key - OPTION_HALF);
        return 0;
    case OPTION_TIFF:
        a->tiff = true;
        return 0;
    case OPTION_FLAT:
        if (a->n_flats == FLATS_MAX)
            argp_error(state, "--flat: more than %d", FLATS_MAX);
        a->flat[a->n_flats++] = text;
        return 0;
    case OPTION_COLOUR:
        a->colour_path = text;
        return 0;
    case OPTION_REFERENCE:
        parse_exposure(state, "--reference-exposure", text, &a->reference, false);
        return 0;
    case OPTION_EXPOSURE:
        parse_exposure(state, "--exposure", text, &a->given, true);
        return 0;
    case OPTION_SATURATION:
        if (!option_saturation(text, &a->saturation))
            argp_error(state, "--saturation: found '%s'; expected 1 to 65535", text);
        return 0;
    case OPTION_IF_CHANGED:
        a->if_changed = true;
        return 0;
    case OPTION_PATCH:
        if (!option_patch(text, a->corner))
            argp_error(state, "--patch: found '%s'; expected X,Y,W,H", text);
        a->measure = true, a->columns = CARD_COLUMNS, a->rows = CARD_ROWS;
        return 0;
    case OPTION_CHART:
        if (!option_chart(text, a->corner))
            argp_error(state, "--chart: found '%s'; expected the x,y of four corners", text);
        a->measure = true, a->columns = CHART_COLUMNS, a->rows = CHART_ROWS;
        return 0;
    case ARGP_KEY_ARG:
        if (state->arg_num == 0)
            a->raw = text;
        else if (state->arg_num == 1)
            a->out = text;
        else
            argp_error(state, "found '%s' after RAW and OUT", text);
        return 0;
    case ARGP_KEY_END:
        if (!a->raw || !a->out == !a->measure)
            argp_error(state, "expected RAW and OUT.exr, or RAW and --patch or --chart");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

// ---- what came of it ---------------------------------------------------------------------------------------------------------

struct job {
    struct arguments a;
    struct json *result, *warnings, *notes, *seconds;
    struct raw_frame frame;
    struct saturation saturation;
    struct raw_rgb rgb;
    struct flat *flat;
    const char *flat_path;
    double scale, gain[3], saturation_dn; // from that DN on sites are marked
    struct exposure exposure;
    char raw_xxh128[DIGEST_HEX], made[MADE_BYTES], tiff_path[4096], date[24], subseconds[12];
    bool doubtful;
    struct timespec began;
};

static __attribute__((format(printf, 2, 3))) void doubt(struct job *j, const char *format, ...)
{
    char text[500];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof(text), format, args);
    va_end(args);
    log_warning("develop: %s: %s", j->a.raw, text);
    json_append_string(j->warnings, text);
    j->doubtful = true;
}

// What was found and taken into account.
static __attribute__((format(printf, 2, 3))) void note(struct job *j, const char *format, ...)
{
    char text[500];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof(text), format, args);
    va_end(args);
    log_info("develop: %s: %s", j->a.raw, text);
    json_append_string(j->notes, text);
}

static __attribute__((format(printf, 3, 4))) int fail(struct job *j, int err, const char *format, ...)
{
    char text[500];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof(text), format, args);
    va_end(args);
    log_error("develop: %s: %s", j->a.raw, text);
    json_set_string(j->result, "error", text);
    return err;
}

static void lap(struct job *j, const char *step)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    json_set_number(j->seconds, step, (double)(now.tv_sec - j->began.tv_sec) + 1e-9 * (double)(now.tv_nsec - j->began.tv_nsec));
    j->began = now;
}

static void say_resources(struct json *o)
{
    struct rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    json_set_number(o, "cpu_s", (double)(usage.ru_utime.tv_sec + usage.ru_stime.tv_sec) + 1e-6 * (double)(usage.ru_utime.tv_usec + usage.ru_stime.tv_usec));
    json_set_number(o, "peak_rss_bytes", (double)usage.ru_maxrss * 1024);
}

// ---- before anything large is read ---------------------------------------------------------------------------------------------

// No more than two frames of 16-bit RGB beyond what programs and libraries take.
static void limit_memory(int width, int height)
{
#if !defined(__SANITIZE_ADDRESS__) // which maps terabytes
    enum { SLACK_BYTES = 64 << 20 };
    const rlim_t enough = (rlim_t)4 << 30; // for 300 megapixels; a header may lie
    long pages = 0;
    FILE *f = fopen("/proc/self/statm", "re");
    if (f && fscanf(f, "%ld", &pages) == 1) {
        rlim_t most = (rlim_t)pages * (rlim_t)sysconf(_SC_PAGESIZE) + 2 * (rlim_t)width * (rlim_t)height * 6 + SLACK_BYTES;
        most = most < enough ? most : enough;
        setrlimit(RLIMIT_AS, &(struct rlimit){ most, most });
    }
    if (f)
        fclose(f);
#else
    (void)width, (void)height;
#endif
}

static void describe(struct job *j)
{
    const struct raw_frame *f = &j->frame;
    if (f->has_time) {
        const time_t seconds = (time_t)(f->taken_ns / 1000000000);
        struct tm tm;
        gmtime_r(&seconds, &tm);
        strftime(j->date, sizeof(j->date), "%Y:%m:%d %H:%M:%S", &tm);
        if (f->has_subseconds)
            snprintf(j->subseconds, sizeof(j->subseconds), "%06d", (int)(f->taken_ns % 1000000000 / 1000));
    }
    json_set_string(j->result, "make", f->make);
    json_set_string(j->result, "model", f->model);
    json_set_string(j->result, "serial", f->serial);
    json_set_string(j->result, "lens", f->lens);
    json_set_string(j->result, "taken", j->date);
    json_set_string(j->result, "subseconds", j->subseconds);
    json_set_number(j->result, "label_s", f->label_s);
    json_set_number(j->result, "time_s", j->exposure.time_s);
    json_set_number(j->result, "f_number", j->exposure.f_number);
    json_set_number(j->result, "iso", j->exposure.iso);
    json_set_number(j->result, "scale", j->scale);
}

// What one unit of (DN - black) / (white - black) is worth in radiance.
static void normalise(struct job *j)
{
    const struct arguments *a = &j->a;
    const struct exposure *r = &a->reference;
    struct exposure *e = &j->exposure;
    *e = (struct exposure){ a->given.time_s ? a->given.time_s : j->frame.exposure_s, a->given.f_number ? a->given.f_number : j->frame.f_number,
                            a->given.iso ? a->given.iso : j->frame.iso };
    const double time = e->time_s ? r->time_s / e->time_s : 1, iso = e->iso ? r->iso / e->iso : 1, stop = e->f_number ? e->f_number / r->f_number : 1;
    j->scale = time * iso * stop * stop;
    if (!e->time_s || !e->iso || !e->f_number)
        doubt(j, "it does not say its %s: radiance is not normalised by it; --exposure tells", !e->time_s ? "exposure time" : !e->iso ? "ISO" : "f-number");
}

static int read_gains(struct job *j)
{
    struct colour colour;
    for (int c = 0; c < 3; c++)
        j->gain[c] = 1;
    if (!j->a.colour_path)
        return 0;
    const int err = colour_read(&colour, j->a.colour_path);
    if (err)
        return fail(j, err, "%s cannot be used", j->a.colour_path);
    const struct body_colour *own = colour_of(&colour, j->frame.serial);
    for (int c = 0; c < 3 && own; c++)
        j->gain[c] = own->gain[c] * own->scale;
    const bool found = own != NULL;
    colour_free(&colour);
    return found ? 0 : fail(j, -ENOENT, "body '%s' is not in %s: calibrate it, or develop without", j->frame.serial, j->a.colour_path);
}

// A picture of ours or of others, or a raw that fits.
static int choose_flat(struct job *j)
{
    char why[WHY_BYTES] = "", last[2 * WHY_BYTES] = "";
    for (int i = 0; i < j->a.n_flats && !j->flat_path; i++) {
        struct raw_frame head;
        int err = raw_read_head(&head, j->a.flat[i], why, sizeof(why));
        if (err && err != -ENOTSUP)
            return fail(j, err, "flat field %s: %s", j->a.flat[i], why);
        if (err || (!strcmp(head.serial, j->frame.serial) && !strcmp(head.lens, j->frame.lens) && fabs(head.f_number - j->exposure.f_number) < .05))
            j->flat_path = j->a.flat[i];
        else
            snprintf(last, sizeof(last), "%.100s is of body %s, %s, f/%g", j->a.flat[i], head.serial, head.lens, head.f_number);
    }
    if (j->a.n_flats && !j->flat_path)
        return fail(j, -ENOENT, "no flat field of body %s, %s, f/%g: %s", j->frame.serial, j->frame.lens, j->exposure.f_number, last);
    return 0;
}

static int read_flat(struct job *j)
{
    char why[WHY_BYTES] = "";
    struct raw_frame frame = { 0 };
    struct saturation saturation = { 0 };
    if (!j->flat_path)
        return 0;
    j->flat = calloc(1, sizeof(*j->flat));
    if (!j->flat)
        return fail(j, -ENOMEM, "out of memory");
    int err = raw_read(&frame, j->flat_path, why, sizeof(why));
    if (!err) {
        struct plateau plateau;
        err = plateau_find(&plateau, &frame);
        if (!err)
            err = saturation_of(&saturation, &frame, plateau.dn ? plateau.dn : frame.saturation);
        if (!err)
            err = flat_from_frame(j->flat, &frame, &saturation, why, sizeof(why));
    } else if (err == -ENOTSUP) {
        struct image image;
        err = image_read(&image, j->flat_path);
        snprintf(why, sizeof(why), "neither a raw nor a picture that is read here");
        if (!err)
            err = flat_from_image(j->flat, &image, j->frame.srgb_from_camera, why, sizeof(why));
        image_free(&image);
    }
    raw_free(&frame);
    saturation_free(&saturation);
    return err ? fail(j, err, "flat field %s: %s", j->flat_path, why) : 0;
}

static int hash_of(const char *path, char hex[DIGEST_HEX])
{
    static char buffer[1 << 18];
    size_t n;
    FILE *f = fopen(path, "re");
    struct digest *d = f ? digest_begin() : NULL;
    int err = f ? 0 : -errno;
    if (f && !d)
        err = -ENOMEM;
    while (!err && (n = fread(buffer, 1, sizeof(buffer), f)) > 0)
        digest_add(d, buffer, n);
    if (f && ferror(f))
        err = -EIO;
    if (d)
        digest_end(d, err ? NULL : hex);
    if (f)
        fclose(f);
    return err;
}

// Everything that the result depends on, in one line.
static int say_what_is_made(struct job *j)
{
    const struct arguments *a = &j->a;
    char flat_xxh128[DIGEST_HEX] = "-";
    int err = hash_of(a->raw, j->raw_xxh128);
    if (err)
        return fail(j, err, "%s", strerror(-err));
    err = j->flat_path ? hash_of(j->flat_path, flat_xxh128) : 0;
    if (err)
        return fail(j, err, "flat field %s: %s", j->flat_path, strerror(-err));
    snprintf(j->made, sizeof(j->made), "rigd-develop " STUDIORIG_VERSION " 3 LibRaw %s raw %s %s%s scale %.9g reference %.9g,%.9g,%.9g gain %.9g,%.9g,%.9g flat %s saturation %g",
             raw_library(), j->raw_xxh128, demosaic_names[a->demosaic], a->tiff ? " tiff" : "", j->scale, a->reference.time_s, a->reference.f_number, a->reference.iso, j->gain[0],
             j->gain[1], j->gain[2], flat_xxh128, a->saturation);
    json_set_string(j->result, "xxh128", j->raw_xxh128);
    return 0;
}

static bool is_made(const struct job *j)
{
    char made[MADE_BYTES];
    return j->a.if_changed && !image_read_note(j->a.out, "studiorig.made", made, sizeof(made)) && !strcmp(made, j->made) && (!j->a.tiff || !access(j->tiff_path, R_OK));
}

// What a killed run has left of this output: ".NAME.XXXXXX.part".
static void sweep(const char *path)
{
    char folder[4096];
    const char *slash = strrchr(path, '/'), *name = slash ? slash + 1 : path;
    const size_t n = strlen(name);
    snprintf(folder, sizeof(folder), "%.*s", slash ? (int)(slash - path + 1) : 1, slash ? path : ".");
    DIR *d = opendir(folder);
    for (struct dirent *e; d && (e = readdir(d));)
        if (strlen(e->d_name) == n + 13 && e->d_name[0] == '.' && !strncmp(e->d_name + 1, name, n) && e->d_name[n + 1] == '.' && !strcmp(e->d_name + n + 8, ".part"))
            unlinkat(dirfd(d), e->d_name, 0);
    if (d)
        closedir(d);
}

// ---- the files ---------------------------------------------------------------------------------------------------------------

static int tiff_row(void *arg, int y, uint16_t *rgb)
{
    const struct raw_rgb *r = arg;
    const uint16_t(*from)[4] = r->pixel + (size_t)y * (size_t)r->width;
    for (int x = 0; x < r->width; x++)
        for (int c = 0; c < 3; c++)
            rgb[3 * x + c] = from[x][c];
    return 0;
}

static int write_tiff(struct job *j)
{
    char why[WHY_BYTES] = "";
    int err = raw_interpolate(&j->rgb, j->a.raw, RAW_BILINEAR, NULL, why, sizeof(why));
    if (err)
        return fail(j, err, "%s", why);
    const struct raw_frame *f = &j->frame;
    const struct image_exif exif = { .make = f->make, .model = f->model, .serial = f->serial, .lens = f->lens, .description = j->made, .date = j->date, .subseconds = j->subseconds,
                                     .time_s = f->label_s, .f_number = f->f_number, .focal_mm = f->focal_mm, .iso = f->iso };
    sweep(j->tiff_path);
    err = image_write_tiff16(j->tiff_path, j->rgb.width, j->rgb.height, &exif, tiff_row, &j->rgb);
    raw_rgb_free(&j->rgb);
    lap(j, "tiff");
    return err ? fail(j, err, "%s was not written", j->tiff_path) : 0;
}

static int read_sites(struct job *j)
{
    char why[WHY_BYTES] = "";
    int err = raw_read(&j->frame, j->a.raw, why, sizeof(why));
    if (err)
        return fail(j, err, "%s", why);
    struct plateau plateau = { 0 };
    if (!j->a.saturation)
        err = plateau_find(&plateau, &j->frame);
    if (plateau.dn)
        note(j, "photosites pile up from %d on, below the white level of %g: its sensor saturates there, and they are marked as clipped", plateau.dn, j->frame.white);
    j->saturation_dn = j->a.saturation ? j->a.saturation : plateau.dn ? plateau.dn : j->frame.saturation;
    if (!err)
        err = saturation_of(&j->saturation, &j->frame, j->saturation_dn);
    if (err)
        return fail(j, err, "out of memory");
    if (!j->frame.has_colour)
        doubt(j, "LibRaw knows no colour matrix of a %s %s: the colours are the camera's own", j->frame.make, j->frame.model);
    json_set_number(j->result, "clipped_share", (double)j->saturation.n / j->frame.width / j->frame.height);
    lap(j, "decode");
    return 0;
}

static void set_matrix(struct json *o, const struct raw_frame *f)
{
    double rows[9];
    memcpy(rows, f->srgb_from_camera, sizeof(rows));
    json_set_matrix3(o, "srgb_from_camera", rows);
}

static char *note_of(const struct job *j)
{
    const struct raw_frame *f = &j->frame;
    struct json *o = json_new_object();
    json_set_string(o, "raw_xxh128", j->raw_xxh128);
    json_set_string(o, "demosaic", demosaic_names[j->a.demosaic]);
    json_set_number(o, "scale", j->scale);
    json_set_numbers(o, "reference_exposure", (const double[3]){ j->a.reference.time_s, j->a.reference.f_number, j->a.reference.iso }, 3);
    json_set_numbers(o, "exposure", (const double[3]){ j->exposure.time_s, j->exposure.f_number, j->exposure.iso }, 3);
    json_set_number(o, "white", f->white);
    json_set_number(o, "saturation", j->saturation_dn);
    json_set_numbers(o, "black", (const double[4]){ f->black[0][0], f->black[0][1], f->black[1][0], f->black[1][1] }, 4);
    json_set_numbers(o, "daylight", f->daylight, 3);
    set_matrix(o, f);
    json_set_numbers(o, "gain", j->gain, 3);
    json_set_bool(o, "flat", j->flat != NULL);
    json_set_number(o, "clipped_share", (double)j->saturation.n / f->width / f->height);
    json_set_int(o, "orientation", f->orientation);
    json_set_string(o, "subseconds", j->subseconds);
    char *text = json_text(o);
    json_free(o);
    return text;
}

static int write_exr(struct job *j)
{
    static const char *const names[] = { "R", "G", "B", "clip" };
    char why[WHY_BYTES] = "";
    struct linear linear = { 0 };
    const struct raw_frame *f = &j->frame;
    double gain[3];
    int err = 0;
    if (j->a.demosaic == DEMOSAIC_AHD) {
        free(j->frame.site); // LibRaw will hold its own
        j->frame.site = NULL;
        err = raw_interpolate(&j->rgb, j->a.raw, RAW_AHD, f, why, sizeof(why));
        if (err)
            return fail(j, err, "%s", why);
        lap(j, "demosaic");
    }
    for (int c = 0; c < 3; c++)
        gain[c] = j->gain[c] * j->scale;
    err = linear_open(&linear, j->a.demosaic, f, &j->rgb, &j->saturation, j->flat, gain);
    char *note = note_of(j);
    if (err || !note) {
        free(note);
        linear_close(&linear);
        return fail(j, -ENOMEM, "out of memory");
    }
    const struct image_note notes[] = {
        { "studiorig.made", j->made, 0 },
        { "studiorig.develop", note, 0 },
        { IMAGE_SPREAD_NOTE, spread_px[j->a.demosaic], 0 }, // what a solver keeps away from edges
        { "cameraMake", f->make, 0 },
        { "cameraModel", f->model, 0 },
        { "cameraSerialNumber", f->serial, 0 },
        { "lensModel", f->lens, 0 },
        { "capDate", j->date, 0 },
        { "expTime", NULL, j->exposure.time_s },
        { "aperture", NULL, j->exposure.f_number },
        { "isoSpeed", NULL, j->exposure.iso },
        { "nominalFocalLength", NULL, f->focal_mm },
    };
    sweep(j->a.out);
    err = image_write_exr_rows(&(struct image_rows){ linear.width, linear.height, 4, names, linear_row, &linear }, notes, (int)(sizeof(notes) / sizeof(notes[0])), j->a.out, IMAGE_HALF,
                               IMAGE_PIZ);
    json_set_int(j->result, "width", linear.width);
    json_set_int(j->result, "height", linear.height);
    linear_close(&linear);
    free(note);
    lap(j, "write");
    return err ? fail(j, err, "%s was not written", j->a.out) : 0;
}

static bool is_same_file(const char *a, const char *b)
{
    struct stat one, other;
    return !stat(a, &one) && !stat(b, &other) && one.st_dev == other.st_dev && one.st_ino == other.st_ino;
}

static int develop(struct job *j)
{
    struct stat st;
    if (is_same_file(j->a.raw, j->a.out) || (j->a.tiff && is_same_file(j->a.raw, j->tiff_path)))
        return fail(j, -EINVAL, "its picture would take its place: choose another OUT");
    json_set_string(j->result, "out", j->a.out);
    json_set_string(j->result, "demosaic", demosaic_names[j->a.demosaic]);
    if (j->a.tiff)
        json_set_string(j->result, "tiff", j->tiff_path);
    int err = choose_flat(j);
    if (!err)
        err = say_what_is_made(j);
    if (err)
        return err;
    const bool skipped = is_made(j);
    json_set_bool(j->result, "skipped", skipped);
    if (skipped)
        return 0;
    lap(j, "hash");
    if (j->a.tiff)
        err = write_tiff(j);
    if (!err)
        err = read_flat(j);
    if (!err)
        err = read_sites(j);
    if (!err)
        err = write_exr(j);
    if (!err && !stat(j->a.out, &st))
        json_set_int(j->result, "bytes", st.st_size);
    return err;
}

static int measure(struct job *j)
{
    char why[WHY_BYTES] = "";
    struct cell cell[COLOUR_CELLS_MAX];
    const double share = j->a.columns == CHART_COLUMNS ? .5 : 1; // a chart has borders
    int err = choose_flat(j);
    if (!err)
        err = read_flat(j);
    if (!err)
        err = read_sites(j);
    if (err)
        return err;
    err = colour_measure(cell, &j->frame, &j->saturation, j->flat, j->scale, j->a.corner, j->a.columns, j->a.rows, share, why, sizeof(why));
    if (err)
        return fail(j, err, "%s", why);
    struct json *list = json_new_array();
    for (int i = 0; i < j->a.columns * j->a.rows; i++) {
        struct json *o = json_new_object();
        json_set_numbers(o, "mean", cell[i].mean, 3);
        json_set_numbers(o, "raw", cell[i].raw, 3);
        json_set_int(o, "saturated", cell[i].n_saturated);
        json_append(list, o);
    }
    json_set(j->result, "cells", list);
    set_matrix(j->result, &j->frame);
    return 0;
}

// ---- --------------------------------------------------------------------------------------------------------------------------

static int run(struct job *j)
{
    char why[WHY_BYTES] = "";
    int err = raw_read_head(&j->frame, j->a.raw, why, sizeof(why));
    if (err)
        return fail(j, err, "%s", why);
    limit_memory(j->frame.width, j->frame.height);
    normalise(j);
    describe(j);
    err = read_gains(j);
    if (!err)
        err = j->a.measure ? measure(j) : develop(j);
    return err;
}

int main(int argc, char **argv)
{
    static const char doc[] = "One raw file becomes one linear picture: half-float EXR, R, G and B with the primaries of sRGB, exposure-normalised, white balance fixed (daylight), nothing "
                              "automatic; channel clip is 1 where a saturated photosite took part. What came of it is one line of JSON on standard output.\v"
                              "Exit status: 0 done, 1 failed, 2 usage, 3 done but not to be trusted (the warnings say why).";
    static const struct argp argp = { options, parse_option, "RAW OUT.exr\nRAW --patch X,Y,W,H\nRAW --chart X1,Y1,..,X4,Y4", doc, NULL, NULL, NULL };
    static struct job j;
    j.a = (struct arguments){ .demosaic = DEMOSAIC_AHD, .reference = { DEVELOP_TIME_S, DEVELOP_F_NUMBER, DEVELOP_ISO } };
    argp_program_version = "rigd-develop " STUDIORIG_VERSION;
    argp_err_exit_status = EXIT_USAGE;
    log_set_program("rigd-develop");
    argp_parse(&argp, argc, argv, 0, NULL, &j.a);
    prctl(PR_SET_PDEATHSIG, SIGKILL); // whoever asked is gone
    alarm(MOST_SECONDS);
    clock_gettime(CLOCK_MONOTONIC, &j.began);
    const struct timespec began = j.began;
    j.result = json_new_object();
    j.warnings = json_new_array();
    j.notes = json_new_array();
    j.seconds = json_new_object();
    json_set_string(j.result, "file", j.a.raw);
    if (j.a.out) {
        const size_t n = strlen(j.a.out);
        const bool exr = n > 4 && !strcmp(j.a.out + n - 4, ".exr");
        snprintf(j.tiff_path, sizeof(j.tiff_path), "%.*s.tif", (int)(exr ? n - 4 : n), j.a.out);
    }
    const int err = run(&j);
    j.began = began;
    lap(&j, "total");
    json_set_bool(j.result, "ok", !err);
    json_set_bool(j.result, "trusted", !err && !j.doubtful);
    json_set(j.result, "warnings", j.warnings);
    json_set(j.result, "notes", j.notes);
    json_set(j.result, "seconds", j.seconds);
    say_resources(j.result);
    char *text = json_text(j.result);
    puts(text ? text : "{\"ok\": false, \"error\": \"out of memory\"}");
    free(text);
    json_free(j.result);
    raw_free(&j.frame);
    raw_rgb_free(&j.rgb);
    saturation_free(&j.saturation);
    free(j.flat);
    return err ? EXIT_FAILED : j.doubtful ? EXIT_DOUBTFUL : EXIT_DONE;
}
