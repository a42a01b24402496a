// rigd/panorama_main.c - build/bin/rigd-panorama: a take's bracketed stops, or a panorama that is stitched already, to panorama.exr and a
// report that hides nothing. A program of its own: LibRaw reads what comes from cards, and may die without harm to the daemon.
#include "rigd/bracket.h"
#include "rigd/colour.h"
#include "rigd/develop.h"
#include "rigd/panorama_plan.h"
#include "rigd/stitch.h"
#include "solver/take/image.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"

#include <argp.h>
#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <time.h>
#include <unistd.h>

enum { EXIT_DONE, EXIT_FAILED, EXIT_USAGE, EXIT_DOUBTFUL, OPTION_JSON };

static const double usual_gap_ev = 3; // steps are 2 EV; a frame left out makes 4

struct job {
    const char *input, *output;
    int width_px; // 0: by the lens
    bool json;
    // while it runs
    double start_s;
    char *report_path;
    char folder[PANORAMA_FILE_MAX]; // of the output: where frames and sums rest
    struct panorama_plan plan;
    struct json *report, *findings;
    struct sensor_noise noise;
    bool is_noise_measured;
    bool has_reference, has_time;
    struct raw_frame reference; // facts of the first stop's first good frame, without sites
    int64_t last_taken_ns;
    char last_file[PANORAMA_FILE_MAX];
    bool is_doubtful;
    int n_stops_used;
};

// ---- findings ---------------------------------------------------------------------------------------------------------------------

enum severity { NOTE, DOUBT }; // DOUBT: the result is not to be trusted

static void find(struct job *j, enum severity severity, const char *kind, const char *stop, const char *file, const char *format, ...)
    __attribute__((format(printf, 6, 7)));
static void find(struct job *j, enum severity severity, const char *kind, const char *stop, const char *file, const char *format, ...)
{
    char text[400];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof(text), format, arguments);
    va_end(arguments);
    struct json *v = json_object();
    json_set_string(v, "kind", kind);
    if (stop)
        json_set_string(v, "stop", stop);
    if (file)
        json_set_string(v, "file", file);
    json_set_string(v, "text", text);
    json_set_bool(v, "doubtful", severity == DOUBT);
    json_append(j->findings, v);
    j->is_doubtful = j->is_doubtful || severity == DOUBT;
    log_warning("panorama: %s%s%s%s%s", stop ? stop : "", stop ? ": " : "", file ? file : "", file ? ": " : "", text);
}

static const char *kind_of(enum bracket_fault f)
{
    static const char *const kinds[] = { [BRACKET_OTHER_SIZE] = "other_size", [BRACKET_OTHER_FILTERS] = "other_filters",
                                         [BRACKET_OTHER_CAMERA] = "other_camera", [BRACKET_OTHER_LEVELS] = "other_levels",
                                         [BRACKET_OTHER_ISO] = "other_iso", [BRACKET_OTHER_APERTURE] = "other_aperture",
                                         [BRACKET_NO_TIME] = "no_time", [BRACKET_OTHER_BRIGHTNESS] = "other_brightness" };
    return kinds[f];
}

// ---- one stop ---------------------------------------------------------------------------------------------------------------------

struct shot {
    const struct panorama_frame *frame;
    bool is_unreadable; // which is said where it was found
    double exposure_s;  // true time over the neutral-density filter
    double h;
    struct bracket_frame_report report;
};

static double filtered(const struct panorama_frame *p, const struct raw_frame *f)
{
    return (p->exposure_s > 0 ? p->exposure_s : f->exposure_s) * exp2(-p->neutral_density_ev);
}

static int compare_shots(const void *a, const void *b)
{
    const struct shot *p = a, *q = b;
    return (p->h < q->h) - (p->h > q->h);
}

// Heads of the stop's files: what is there, in order of exposure. Returns how many.
static int look_at_files(struct job *j, const struct panorama_stop *stop, struct shot *shot)
{
    int n = 0;
    for (int i = 0; i < stop->n_frames; i++) {
        const struct panorama_frame *p = stop->frame + i;
        struct raw_frame f;
        char why[160] = "";
        const int err = raw_read_head(&f, p->file, why, sizeof(why));
        if (err) {
            find(j, DOUBT, err == -ENOENT ? "missing_frame" : "unreadable_frame", stop->name, p->file, "left out: %s", why[0] ? why : strerror(-err));
            continue;
        }
        if (p->exposure_s > 0 && f.exposure_s > 0 && fabs(log2(p->exposure_s / f.exposure_s)) > .5)
            find(j, DOUBT, "wrong_order", stop->name, p->file, "the plan says %g s, the file %g s: are the frames in another order? The plan is followed",
                 p->exposure_s, f.exposure_s);
        if (f.has_time && j->has_time && f.taken_ns < j->last_taken_ns)
            find(j, DOUBT, "wrong_order", stop->name, p->file, "was taken %.3f s before %s, which the plan has before it",
                 (double)(j->last_taken_ns - f.taken_ns) * 1e-9, j->last_file);
        if (f.has_time) {
            j->has_time = true;
            j->last_taken_ns = f.taken_ns;
            snprintf(j->last_file, sizeof(j->last_file), "%s", p->file);
        }
        f.exposure_s = filtered(p, &f);
        shot[n++] = (struct shot){ .frame = p, .exposure_s = f.exposure_s, .h = bracket_exposure(&f) };
        raw_free(&f);
    }
    qsort(shot, (size_t)n, sizeof(*shot), compare_shots);
    return n;
}

// The camera's noise, once: from the plan, or from the two longest frames of a stop.
static int measure_noise(struct job *j, const struct panorama_stop *stop, const struct shot *shot, int n)
{
    static const struct sensor_noise careful = { .electrons_at_white = 20000, .read_noise_e = 8 };
    char why[160];
    if (j->noise.electrons_at_white > 0)
        return 0;
    for (int i = 0; i + 1 < n; i++) {
        struct raw_frame a = { 0 }, b = { 0 };
        int err = raw_read(&a, shot[i].frame->file, why, sizeof(why));
        if (!err)
            err = raw_read(&b, shot[i + 1].frame->file, why, sizeof(why));
        a.exposure_s = shot[i].exposure_s, b.exposure_s = shot[i + 1].exposure_s;
        if (!err)
            err = sensor_noise_measure(&j->noise, &a, &b);
        raw_free(&a);
        raw_free(&b);
        j->is_noise_measured = !err;
        if (!err || err == -ENOMEM)
            return err;
    }
    j->noise = careful;
    find(j, NOTE, "noise_assumed", stop->name, NULL, "the sensor's noise cannot be measured from these frames: %g electrons at white and %g of read noise are assumed; "
         "give \"sensor\" in the plan", careful.electrons_at_white, careful.read_noise_e);
    return 0;
}

// Merge in order, beginning with `first` and taking those before it last. *b: NULL if no frame could be read. A frame waits for the next.
static int merge_from(struct job *j, struct bracket **b, const struct panorama_stop *stop, struct shot *shot, int n, int first, struct raw_frame *facts)
{
    const struct bracket_options options = { .noise = j->noise };
    struct raw_frame waiting = { 0 };
    struct shot *whose = NULL;
    int err = 0;
    *b = NULL;
    for (int k = 0; !err && k < n; k++) {
        struct shot *s = shot + (first + k) % n;
        struct raw_frame f;
        char why[160] = "";
        err = raw_read(&f, s->frame->file, why, sizeof(why));
        progress_add(1);
        if (err && err != -ENOMEM) {
            if (!s->is_unreadable)
                find(j, DOUBT, "unreadable_frame", stop->name, s->frame->file, "left out: %s", why[0] ? why : strerror(-err));
            s->is_unreadable = true;
            s->report = (struct bracket_frame_report){ .fault = BRACKET_NO_TIME };
            err = 0;
            continue;
        }
        f.exposure_s = s->exposure_s;
        raw_rest(&f, j->folder);
        if (!err && whose)
            err = bracket_add(*b, &waiting, &f, &whose->report);
        if (!err && !*b) {
            *facts = f;
            facts->site = NULL;
            err = bracket_new(b, &f, &options);
        }
        raw_free(&waiting);
        waiting = f;
        whose = s;
    }
    if (!err && whose)
        err = bracket_add(*b, &waiting, NULL, &whose->report);
    raw_free(&waiting);
    return err;
}

// The frame that the others do not agree with may be the first: then begin with the next.
static int merge_stop(struct job *j, struct bracket **b, const struct panorama_stop *stop, struct shot *shot, int n, struct raw_frame *facts)
{
    int best = 0, fewest = n + 1, err;
    for (int first = 0;; first++) {
        const bool is_last = first >= n || first >= 4;
        err = merge_from(j, b, stop, shot, n, is_last ? best : first, facts);
        int left_out = 0;
        for (int i = 0; i < n; i++)
            left_out += shot[i].report.fault != BRACKET_FITS;
        if (err || is_last || 2 * left_out <= n)
            return err;
        if (left_out < fewest)
            fewest = left_out, best = first;
        bracket_free(*b);
        *b = NULL;
    }
}

static void say_direction(char *to, size_t room, const double d[3])
{
    const double lon = atan2(d[0], d[2]) * 180 / M_PI, lat = asin(fmin(fmax(d[1], -1), 1)) * 180 / M_PI;
    snprintf(to, room, "%.1f degrees %s, %.1f %s", fabs(lon), lon >= 0 ? "left" : "right", fabs(lat), lat >= 0 ? "up" : "down");
}

static void judge_frame(struct job *j, const struct panorama_stop *stop, const double R[9], const struct shot *shot, int n, int i)
{
    const struct bracket_frame_report *r = &shot[i].report;
    const char *file = shot[i].frame->file;
    if (shot[i].is_unreadable)
        return;
    if (r->fault == BRACKET_NO_TIME) {
        find(j, DOUBT, kind_of(r->fault), stop->name, file, "left out: it does not say its exposure time, or one that cannot be with its aperture and ISO (%g s); give \"exposure_s\" in the plan",
             shot[i].exposure_s);
        return;
    }
    if (r->fault == BRACKET_OTHER_BRIGHTNESS) {
        for (int k = 0; k < n; k++)
            if (k != i && fabs(log2(r->gain * r->exposure / shot[k].h)) < .2) {
                find(j, DOUBT, "wrong_order", stop->name, file, "left out: its brightness is that of %g s, which %s has, not of %g s: are they exchanged?",
                     shot[k].exposure_s, shot[k].frame->file, shot[i].exposure_s);
                return;
            }
        find(j, DOUBT, "other_brightness", stop->name, file, "left out: %.3g times as bright as the others and its exposure say (%.2f EV): aperture, ISO, filter or lamps were changed",
             r->gain, log2(r->gain));
        return;
    }
    if (r->fault != BRACKET_FITS) {
        find(j, DOUBT, kind_of(r->fault), stop->name, file, "left out: %s than the stop's other frames", bracket_fault_text(r->fault));
        return;
    }
    if (r->plateau_dn)
        find(j, NOTE, "plateau", stop->name, file, "the sensor clips at %d DN, below what the file calls white: the lower one is taken", r->plateau_dn);
    const double off = fabs(r->gain - 1);
    if (r->n_blocks >= 2 && off > .01 && off > 5 * r->gain_error)
        find(j, off > .03 ? DOUBT : NOTE, "flicker", stop->name, file, "%.1f %% %s than the others and its exposure say: a flickering lamp, or an inexact shutter",
             100 * off, r->gain > 1 ? "brighter" : "darker");
    if (r->is_repeat && r->n_blocks >= 4 && r->chi2 > 1.25)
        find(j, NOTE, "flicker", stop->name, file, "the same exposure again differs by %.1f times the variance of photons: a lamp flickers", r->chi2);
    if (r->largest_change >= 2) {
        char where[64] = "a direction that the lens does not see";
        double d[3], probe[3];
        if (lens_ray(&j->plan.lens, r->changed_at_px, d)) {
            for (int c = 0; c < 3; c++)
                probe[c] = R[3 * c] * d[0] + R[3 * c + 1] * d[1] + R[3 * c + 2] * d[2];
            say_direction(where, sizeof(where), probe);
        }
        find(j, r->n_changed > .01 * r->n_blocks ? DOUBT : NOTE, r->is_repeat ? "flicker" : "movement", stop->name, file,
             "%d of %d blocks differ from the other frames beyond noise; the largest patch (%d blocks, %+.0f %%) is %s",
             r->n_changed, r->n_blocks, r->largest_change, 100 * (r->change - 1), where);
    }
}

static struct json *describe_frame(const struct shot *s)
{
    const struct bracket_frame_report *r = &s->report;
    struct json *v = json_object();
    json_set_string(v, "file", s->frame->file);
    json_set_number(v, "exposure_s", s->exposure_s * exp2(s->frame->neutral_density_ev));
    json_set_number(v, "exposure", r->exposure);
    json_set_string(v, "verdict", s->is_unreadable ? "unreadable" : bracket_fault_text(r->fault));
    json_set_number(v, "gain", r->gain);
    json_set_number(v, "gain_error", r->gain_error);
    json_set_number(v, "chi2", r->chi2);
    json_set_bool(v, "is_repeat", r->is_repeat);
    json_set_int(v, "blocks", r->n_blocks);
    json_set_int(v, "blocks_changed", r->n_changed);
    json_set_int(v, "sites_good", r->n_good);
    json_set_int(v, "sites_poor", r->n_poor);
    json_set_int(v, "sites_clipped", r->n_clipped);
    return v;
}

static void judge_steps(struct job *j, const struct panorama_stop *stop, const struct shot *shot, int n)
{
    const struct shot *longer = NULL;
    for (int i = 0; i < n; i++)
        if (shot[i].report.fault != BRACKET_FITS)
            return; // which is named already
    for (int i = 0; i < n; i++) {
        if (longer && log2(longer->h / shot[i].h) > usual_gap_ev)
            find(j, DOUBT, "missing_frame", stop->name, shot[i].frame->file, "%.1f EV below the next longer frame: is one missing between them?",
                 log2(longer->h / shot[i].h));
        longer = shot + i;
    }
}

static void judge_seam(struct job *j, const struct panorama_stop *stop, const struct stitch_stop_report *r)
{
    if (r->n_cells < 20)
        return;
    if (r->seam_ev > .08 || fabs(log2(r->seam_gain)) > .15)
        find(j, DOUBT, "stop_does_not_fit", stop->name, NULL, "differs from the stops before it by %.2f EV (brightness %+.1f %%) where both see: "
             "stops in another order, other head angles than the plan's, or another lens", r->seam_ev, 100 * (r->seam_gain - 1));
    else if (fabs(r->seam_gain - 1) > .03)
        find(j, NOTE, "flicker", stop->name, NULL, "%+.1f %% of the brightness of the stops before it: lamps were not the same, or the shading of the lens is not calibrated",
             100 * (r->seam_gain - 1));
}

// The camera must be that of the first stop.
static bool is_same_camera(struct job *j, const struct panorama_stop *stop, const struct raw_frame *f)
{
    const struct raw_frame *a = &j->reference;
    if (!j->has_reference) {
        j->reference = *f;
        j->has_reference = true;
        return true;
    }
    if ((a->serial[0] && f->serial[0] && strcmp(a->serial, f->serial) != 0) || strcmp(a->model, f->model) != 0 || a->width != f->width || a->height != f->height) {
        find(j, DOUBT, "other_camera", stop->name, NULL, "left out: shot with %s %s (%dx%d), the first stop with %s %s (%dx%d)", f->model, f->serial, f->width,
             f->height, a->model, a->serial, a->width, a->height);
        return false;
    }
    if (fabs(f->f_number - a->f_number) > .01 * a->f_number)
        find(j, DOUBT, "other_aperture", stop->name, NULL, "shot at f/%g, the first stop at f/%g: brightness is corrected for that, sharpness and shading are not", f->f_number, a->f_number);
    return true;
}

static int do_stop(struct job *j, struct stitch *stitch, const struct panorama_stop *stop, struct json *to)
{
    struct shot shot[PANORAMA_FRAMES_MAX];
    struct merged merged = { 0 };
    struct bracket *b = NULL;
    struct raw_frame facts = { 0 };
    struct stitch_stop_report seam = { 0 };
    int64_t n_clipped = 0, n_defects = 0;
    double R[9];
    int n_used = 0;
    json_set_string(to, "name", stop->name);
    json_set_number(to, "yaw_deg", stop->yaw_deg);
    json_set_number(to, "pitch_deg", stop->pitch_deg);
    json_set_number(to, "roll_deg", stop->roll_deg);
    lens_head(R, stop->yaw_deg * M_PI / 180, stop->pitch_deg * M_PI / 180, stop->roll_deg * M_PI / 180);
    const int n = look_at_files(j, stop, shot);
    stitch_rest(stitch, j->folder);
    int err = n ? measure_noise(j, stop, shot, n) : 0;
    if (!err && n)
        err = merge_stop(j, &b, stop, shot, n, &facts);
    if (err) {
        bracket_free(b);
        return err;
    }
    struct json *frames = json_array();
    for (int i = 0; i < n; i++) {
        judge_frame(j, stop, R, shot, n, i);
        n_used += shot[i].report.fault == BRACKET_FITS;
        json_append(frames, describe_frame(shot + i));
    }
    json_set(to, "frames", frames);
    if (n == stop->n_frames)
        judge_steps(j, stop, shot, n);
    if (!b || !n_used || !is_same_camera(j, stop, &facts)) {
        if (!b || !n_used)
            find(j, DOUBT, "missing_stop", stop->name, NULL, "none of its %d frames can be used: what it would have seen stays uncovered", stop->n_frames);
        bracket_free(b);
        return 0;
    }
    err = bracket_finish(&merged, b, &n_clipped, &n_defects);
    if (!err && merged.width == j->plan.lens.width_px && merged.height == j->plan.lens.height_px)
        merged_unshade(&merged, &j->plan.lens);
    if (!err)
        err = stitch_add_last(stitch, &j->plan.lens, R, &merged, &seam);
    merged_free(&merged);
    if (err)
        return err;
    j->n_stops_used++;
    judge_seam(j, stop, &seam);
    json_set_int(to, "sites_clipped", n_clipped);
    json_set_int(to, "sites_stuck", n_defects);
    json_set_number(to, "solid_angle_sr", seam.solid_angle_sr);
    json_set_number(to, "clipped_sr", seam.clipped_sr);
    json_set_int(to, "seam_cells", seam.n_cells);
    json_set_number(to, "seam_gain", seam.seam_gain);
    json_set_number(to, "seam_ev", seam.seam_ev);
    return 0;
}

// ---- colour -----------------------------------------------------------------------------------------------------------------------

static int colour_matrix(struct job *j, double M[9])
{
    const struct panorama_plan *p = &j->plan;
    const double unit = DEVELOP_TIME_S * DEVELOP_ISO / 100 / (DEVELOP_F_NUMBER * DEVELOP_F_NUMBER); // h at which 1 is white
    double gains[3] = { p->gains[0], p->gains[1], p->gains[2] }, scale = p->scale;
    if (p->colour_file) {
        struct colour c;
        const int err = colour_read(&c, p->colour_file);
        if (err)
            return err;
        const struct body_colour *own = colour_of(&c, j->reference.serial);
        if (own) {
            memcpy(gains, own->gain, sizeof(gains));
            scale = own->scale;
        } else {
            find(j, DOUBT, "no_colour", NULL, p->colour_file, "has no entry for camera %s: its gains are taken as 1; `rigctl calibrate colour`", j->reference.serial);
        }
        colour_free(&c);
    } else if (!p->has_colour) {
        find(j, NOTE, "no_colour", NULL, NULL, "the plan has no colour calibration: this camera's gains are taken as 1");
    }
    if (!p->has_matrix && !j->reference.has_colour)
        find(j, DOUBT, "no_matrix", NULL, NULL, "no colour matrix is known for %s: R, G, B are the camera's own; give \"srgb_from_camera\" in the plan", j->reference.model);
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++)
            M[3 * i + k] = unit * scale * gains[k] * j->reference.daylight[k] * (p->has_matrix ? p->srgb_from_camera[3 * i + k] : j->reference.srgb_from_camera[i][k]);
    return 0;
}

// ---- the whole --------------------------------------------------------------------------------------------------------------------

static void report_whole(struct job *j, const struct panorama_report *r, bool is_guess)
{
    struct json *lights = json_array();
    char where[64];
    const double total = r->total[0] + r->total[1] + r->total[2];
    for (int i = 0; i < r->n_listed; i++) {
        const struct clipped_light *l = r->light + i;
        const double share = (l->irradiance_at_least[0] + l->irradiance_at_least[1] + l->irradiance_at_least[2]) / total;
        say_direction(where, sizeof(where), l->dir_probe);
        if (is_guess)
            find(j, NOTE, "clipped_light", NULL, NULL, "%.2g sr at %s are all as bright as the brightest (%.1f %% of the light): was this panorama clipped?",
                 l->solid_angle_sr, where, 100 * share);
        else
            find(j, share > .01 ? DOUBT : NOTE, "clipped_light", NULL, NULL, "a light at %s clips in every frame, over %.3g sr: it sends at least %.3g %.3g %.3g (%.1f %% of all that is recorded), "
                 "how much more is not known; shoot shorter or through a neutral-density filter", where, l->solid_angle_sr, l->irradiance_at_least[0],
                 l->irradiance_at_least[1], l->irradiance_at_least[2], 100 * share);
        struct json *v = json_object();
        json_set_numbers(v, "dir_probe", l->dir_probe, 3);
        json_set_number(v, "solid_angle_sr", l->solid_angle_sr);
        json_set_numbers(v, "irradiance_at_least", l->irradiance_at_least, 3);
        json_set_number(v, "share_of_recorded", share);
        json_append(lights, v);
    }
    if (r->uncovered_sr > .005 * 4 * M_PI)
        find(j, NOTE, "uncovered", NULL, NULL, "%.2f sr (%.1f %% of the sphere) were seen by no stop and are black; channel \"coverage\" marks them",
             r->uncovered_sr, 100 * r->uncovered_sr / (4 * M_PI));
    json_set(j->report, "clipped_lights", lights);
    json_set_int(j->report, "n_clipped_lights", r->n_lights);
    json_set_number(j->report, "clipped_sr", r->clipped_sr);
    json_set_number(j->report, "uncovered_sr", r->uncovered_sr);
    json_set_numbers(j->report, "total", r->total, 3);
    if (r->median_snr > 0) {
        json_set_number(j->report, "median_snr", r->median_snr);
        json_set_number(j->report, "dark_snr", r->dark_snr);
    }
}

static int row_of(void *arg, int y, float *row)
{
    const struct image *p = arg;
    const size_t n = (size_t)p->width * (size_t)p->n_channels;
    memcpy(row, p->data + (size_t)y * n, n * sizeof(*row));
    return 0;
}

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// What is known at the end, or just before it.
static void complete_report(struct job *j, bool is_done)
{
    struct rusage usage;
    if (j->findings)
        json_set(j->report, "findings", j->findings);
    j->findings = NULL;
    json_set_bool(j->report, "trusted", is_done && !j->is_doubtful);
    getrusage(RUSAGE_SELF, &usage);
    json_set_number(j->report, "wall_s", now_s() - j->start_s);
    json_set_number(j->report, "cpu_s", (double)usage.ru_utime.tv_sec + 1e-6 * (double)usage.ru_utime.tv_usec);
    json_set_int(j->report, "peak_rss_bytes", (int64_t)usage.ru_maxrss * 1024);
}

// Its report comes first: a panorama whose doubts were not written when this was killed would be taken for one that has none.
static int write_panorama(struct job *j, const struct image_rows *rows)
{
    const struct image_note notes[] = { { .name = "nodalOffsetM", .number = j->plan.nodal_offset_m },
                                        { .name = "radianceUnit", .text = "1 is white at 1/128 s, f/8, ISO 100, x gains x scale" } };
    complete_report(j, true);
    int err = json_write(j->report, j->report_path);
    if (err)
        return err;
    err = image_write_exr_rows(rows, notes, j->plan.n_stops ? 2 : 0, j->output, IMAGE_FLOAT, IMAGE_PIZ);
    if (err)
        unlink(j->report_path);
    return err;
}

static int default_width(const struct lens *l)
{
    int width = 256;
    while (width < 4096 && 2 * width <= M_PI * l->focal_px) // a texel is two pixels wide or more: every colour was seen in it
        width *= 2;
    return width;
}

static int merge_plan(struct job *j)
{
    struct stitch *stitch = NULL;
    struct stitch_rows rows = { 0 };
    struct panorama_report *whole = malloc(sizeof(*whole));
    int64_t n_frames = 0;
    int err = whole ? panorama_plan_read(&j->plan, j->input) : -ENOMEM;
    if (err)
        goto out;
    const char *slash = strrchr(j->output, '/');
    snprintf(j->folder, sizeof(j->folder), "%.*s", slash ? (int)(slash - j->output + 1) : 1, slash ? j->output : ".");
    j->noise = j->plan.sensor;
    for (int i = 0; i < j->plan.n_stops; i++)
        n_frames += j->plan.stop[i].n_frames;
    const int width = j->width_px ? j->width_px : default_width(&j->plan.lens);
    err = stitch_new(&stitch, width);
    if (err)
        goto out;
    progress_begin("panorama", n_frames);
    struct json *stops = json_array();
    for (int i = 0; !err && i < j->plan.n_stops; i++) {
        struct json *stop = json_object();
        err = do_stop(j, stitch, j->plan.stop + i, stop);
        json_append(stops, stop);
    }
    progress_end();
    json_set(j->report, "stops", stops);
    if (!err && !j->n_stops_used) {
        log_error("panorama: %s: no stop has a frame that can be used: see the findings above", j->input);
        err = -ENODATA;
    }
    if (!err)
        err = colour_matrix(j, rows.rgb_from_camera);
    rows.stitch = stitch;
    if (!err)
        err = stitch_examine(whole, &rows);
    if (err)
        goto out;
    report_whole(j, whole, false);
    json_set_int(j->report, "width_px", width);
    json_set_number(j->report, "nodal_offset_m", j->plan.nodal_offset_m);
    json_set_string(j->report, "lens", lens_model_name(j->plan.lens.model));
    json_set_int(j->report, "n_stops", j->plan.n_stops);
    json_set_int(j->report, "n_stops_used", j->n_stops_used);
    json_set_number(j->report, "electrons_at_white", j->noise.electrons_at_white);
    json_set_number(j->report, "read_noise_e", j->noise.read_noise_e);
    json_set_bool(j->report, "noise_measured", j->is_noise_measured);
    err = write_panorama(j, &(struct image_rows){ .width = width, .height = width / 2, .n_channels = STITCH_CHANNELS, .names = stitch_channels, .row = stitch_row, .arg = &rows });
out:
    if (err == -ENOMEM)
        log_error("panorama: %s: out of memory", j->input);
    free(whole);
    stitch_free(stitch);
    return err;
}

// A share is a number from 0 to 1, but for rounding.
static int require_share(const struct image *p, const char *channel, const char *path)
{
    const int c = image_channel(p, channel);
    const size_t n = (size_t)p->width * (size_t)p->height;
    for (size_t i = 0; c >= 0 && i < n; i++) {
        const float v = p->data[i * (size_t)p->n_channels + (size_t)c];
        if (!(v >= -.01f && v <= 1.01f)) {
            log_error("panorama: %s: channel %s, pixel %zu, %zu: found %g; expected a share, 0 .. 1: remove the channel if it means something else", path, channel,
                      i % (size_t)p->width, i / (size_t)p->width, (double)v);
            return -EINVAL;
        }
    }
    return 0;
}

// A panorama that is stitched already: checked, and written as ours.
static int pass_through(struct job *j)
{
    static const char *const looked_at[] = { "R", "G", "B", "variance.G", NULL };
    struct image p;
    struct panorama_report *whole = malloc(sizeof(*whole));
    int err = whole ? image_read(&p, j->input) : -ENOMEM;
    if (err) {
        free(whole);
        return err;
    }
    if (p.n_channels < 3 || strcmp(p.names[0], "R") != 0 || strcmp(p.names[1], "G") != 0 || strcmp(p.names[2], "B") != 0) {
        log_error("panorama: %s: found channels %s ...; expected R, G and B", j->input, p.names[0]);
        err = -EINVAL;
    } else if (p.width != 2 * p.height || p.width < 16) {
        log_error("panorama: %s: found %dx%d pixels; expected twice as wide as high (latitude and longitude)", j->input, p.width, p.height);
        err = -EINVAL;
    } else {
        err = image_require_finite(&p, looked_at, j->input);
        if (!err)
            err = require_share(&p, "coverage", j->input);
        if (!err)
            err = require_share(&p, "clip", j->input);
    }
    int64_t n_negative = 0;
    float highest = 0;
    const size_t n = (size_t)p.width * (size_t)p.height;
    for (size_t i = 0; !err && i < n; i++)
        for (int c = 0; c < 3; c++) {
            float *v = p.data + i * (size_t)p.n_channels + c;
            n_negative += *v < 0;
            *v = *v < 0 ? 0 : *v;
            highest = fmaxf(highest, *v);
        }
    if (!err && !(highest > 0)) {
        log_error("panorama: %s: all %dx%d pixels are black: was the right bracket merged?", j->input, p.width, p.height);
        err = -EINVAL;
    }
    if (!err)
        err = panorama_examine(whole, &p);
    if (!err) {
        if (n_negative)
            find(j, NOTE, "negative", NULL, NULL, "%lld values are negative (a resampling filter that rings) and are set to 0", (long long)n_negative);
        if (highest <= 1.001f)
            find(j, DOUBT, "not_radiance", NULL, NULL, "no value is above %g: a picture for the screen, or clipped at white? A panorama holds linear radiance", (double)highest);
        report_whole(j, whole, image_channel(&p, "clip") < 0);
        json_set_int(j->report, "width_px", p.width);
        const char *names[IMAGE_MAX_CHANNELS];
        for (int c = 0; c < p.n_channels; c++)
            names[c] = p.names[c];
        err = write_panorama(j, &(struct image_rows){ .width = p.width, .height = p.height, .n_channels = p.n_channels, .names = names, .row = row_of, .arg = &p });
    }
    image_free(&p);
    free(whole);
    return err;
}

static char *report_path(const char *output)
{
    const size_t n = strlen(output), stem = n > 4 && strcmp(output + n - 4, ".exr") == 0 ? n - 4 : n;
    char *path;
    return asprintf(&path, "%.*s-report.json", (int)stem, output) < 0 ? NULL : path;
}

// ---- command line -----------------------------------------------------------------------------------------------------------------

static const struct argp_option options[] = {
    { "output", 'o', "FILE.exr", 0, "Where the panorama goes; FILE-report.json is written beside it (required)", 0 },
    { "size", 's', "WIDTH", 0, "Width in pixels, even, 16 .. 16384; the height is half of it (by default as the lens resolves, at most 4096)", 0 },
    { "json", OPTION_JSON, NULL, 0, "Print the report on standard output", 0 },
    { 0 },
};

static error_t parse(int key, char *arg, struct argp_state *state)
{
    struct job *j = state->input;
    char *end;
    long width;
    switch (key) {
    case 'o':
        j->output = arg;
        return 0;
    case 's':
        errno = 0;
        width = strtol(arg, &end, 10);
        if (errno || *end || end == arg || width < 16 || width > 16384 || width % 2)
            argp_error(state, "--size %s: expected an even number, 16 .. 16384", arg);
        j->width_px = (int)width;
        return 0;
    case OPTION_JSON:
        j->json = true;
        return 0;
    case ARGP_KEY_ARG:
        if (j->input)
            argp_error(state, "one input only: found %s after %s", arg, j->input);
        j->input = arg;
        return 0;
    case ARGP_KEY_END:
        if (!j->input)
            argp_error(state, "no input: expected panorama.json of a take, or a panorama as .exr or .hdr");
        if (!j->output)
            argp_error(state, "no output: -o FILE.exr");
        if (strlen(j->output) < 5 || strcmp(j->output + strlen(j->output) - 4, ".exr") != 0)
            argp_error(state, "-o %s: expected a name that ends with .exr", j->output);
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

int main(int argc, char **argv)
{
    static const struct argp argp = {
        options, parse, "PLAN.json -o FILE.exr\nPANORAMA.exr|.hdr -o FILE.exr",
        "Merge the brackets of a panorama head's stops per photosite and stitch them by area into one 2:1 panorama of linear radiance; or check a "
        "panorama that is stitched already.\vThe report names clipped lights (solid angle, what they send at least), flicker, movement, frames and stops "
        "that are missing or do not belong, and directions that no stop saw. Exit status: 0 done, 1 failed, 2 usage, 3 done but the result is not to be "
        "trusted (the report says why).", NULL, NULL, NULL };
    struct job j = { .start_s = now_s() };
    argp_program_version = "rigd-panorama (studiorig) " STUDIORIG_VERSION;
    argp_err_exit_status = EXIT_USAGE;
    log_set_program("rigd-panorama");
    argp_parse(&argp, argc, argv, 0, NULL, &j);
    j.report_path = report_path(j.output);
    if (!j.report_path) {
        log_error("panorama: out of memory");
        return EXIT_FAILED;
    }
    j.report = json_object();
    j.findings = json_array();
    json_set_string(j.report, "input", j.input);
    json_set_string(j.report, "output", j.output);
    const size_t n = strlen(j.input);
    int err = n > 5 && strcmp(j.input + n - 5, ".json") == 0 ? merge_plan(&j) : pass_through(&j);
    complete_report(&j, !err);
    if (!err)
        err = json_write(j.report, j.report_path); // once more, with what the writing took
    char *text = j.json ? json_text(j.report) : NULL;
    if (j.json && !text)
        err = -ENOMEM;
    if (text)
        puts(text);
    free(text);
    free(j.report_path);
    json_free(j.report);
    panorama_plan_free(&j.plan);
    return err ? EXIT_FAILED : j.is_doubtful ? EXIT_DOUBTFUL : EXIT_DONE;
}
