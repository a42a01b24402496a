// rigd/panorama_plan.c - see panorama_plan.h. Input is hostile: numbers are bounded before they are used, counts before anything is allocated.
#include "rigd/panorama_plan.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int refuse(const char *name, const char *key, const char *what)
{
    log_error("panorama: %s: %s: %s", name, key, what);
    return -EINVAL;
}

// An optional number of v within bounds; to stays as it is where there is none.
static int read_number(const struct json *v, const char *key, double least, double most, double *to, const char *name, const char *where)
{
    double x;
    if (!json_get(v, key))
        return 0;
    if (json_get_number(v, key, &x) || !(x >= least && x <= most)) {
        log_error("panorama: %s: %s%s%s: expected a number, %g .. %g", name, where, where[0] ? "." : "", key, least, most);
        return -EINVAL;
    }
    *to = x;
    return 0;
}

static char *in_folder(const char *folder, const char *file)
{
    char *path = NULL;
    if (file[0] == '/' || !folder[0])
        return strdup(file);
    return asprintf(&path, "%s/%s", folder, file) < 0 ? NULL : path;
}

static int read_frame(struct panorama_frame *out, const struct json *v, double nd_ev, const char *name, const char *where, const char *folder)
{
    const char *file;
    if (json_get_string(v, "file", &file) || !file[0] || strlen(file) >= PANORAMA_FILE_MAX)
        return refuse(name, where, "no \"file\": expected the path of a raw file, relative to the plan");
    out->neutral_density_ev = nd_ev;
    int err = read_number(v, "exposure_s", 1e-7, 1e5, &out->exposure_s, name, where);
    if (!err)
        err = read_number(v, "neutral_density_ev", 0, 30, &out->neutral_density_ev, name, where);
    if (!err && !(out->file = in_folder(folder, file)))
        err = -ENOMEM;
    return err;
}

static int read_stop(struct panorama_stop *out, const struct json *v, int index, double nd_ev, const char *name, const char *folder)
{
    char where[96];
    const char *text;
    snprintf(where, sizeof(where), "stops.%d", index);
    if (!json_get(v, "name"))
        snprintf(out->name, sizeof(out->name), "stop %d", index + 1);
    else if (json_get_string(v, "name", &text) || !text[0] || strlen(text) >= sizeof(out->name))
        return refuse(name, where, "expected a \"name\" of at most 63 characters");
    else
        snprintf(out->name, sizeof(out->name), "%s", text);
    int err = read_number(v, "yaw_deg", -3600, 3600, &out->yaw_deg, name, where);
    if (!err)
        err = read_number(v, "pitch_deg", -180, 180, &out->pitch_deg, name, where);
    if (!err)
        err = read_number(v, "roll_deg", -360, 360, &out->roll_deg, name, where);
    if (err)
        return err;
    const int n = json_length(v, "frames");
    if (n < 0 || n > PANORAMA_FRAMES_MAX)
        return refuse(name, where, "expected \"frames\": a list of at most 64");
    out->frame = calloc((size_t)n + 1, sizeof(*out->frame));
    if (!out->frame)
        return -ENOMEM;
    for (int i = 0; !err && i < n; i++) {
        char key[32];
        snprintf(key, sizeof(key), "frames.%d", i);
        snprintf(where, sizeof(where), "stops.%d.frames.%d", index, i);
        out->n_frames++;
        err = read_frame(out->frame + i, json_get(v, key), nd_ev, name, where, folder);
    }
    return err;
}

static int read_colour(struct panorama_plan *p, const struct json *doc, const char *name, const char *folder)
{
    const char *file;
    p->scale = p->gains[0] = p->gains[1] = p->gains[2] = 1;
    if (json_get(doc, "srgb_from_camera")) {
        if (json_require_numbers(doc, "srgb_from_camera", p->srgb_from_camera, 9, name))
            return -EINVAL;
        for (int i = 0; i < 9; i++)
            if (!(fabs(p->srgb_from_camera[i]) <= 1e3))
                return refuse(name, "srgb_from_camera", "expected 9 numbers of at most 1000");
        p->has_matrix = true;
    }
    if (!json_get(doc, "colour"))
        return 0;
    p->has_colour = true;
    if (!json_get_string(doc, "colour", &file)) {
        if (!file[0] || strlen(file) >= PANORAMA_FILE_MAX)
            return refuse(name, "colour", "expected the path of a colour.json, or gains and scale");
        p->colour_file = in_folder(folder, file);
        return p->colour_file ? 0 : -ENOMEM;
    }
    if (json_require_numbers(doc, "colour.gains", p->gains, 3, name))
        return -EINVAL;
    for (int c = 0; c < 3; c++)
        if (!(p->gains[c] >= 1. / 64 && p->gains[c] <= 64))
            return refuse(name, "colour.gains", "expected three gains of 1/64 .. 64");
    return read_number(json_get(doc, "colour"), "scale", 1e-12, 1e12, &p->scale, name, "colour");
}

static int read_plan(struct panorama_plan *p, const struct json *doc, const char *name, const char *folder)
{
    double nd_ev = 0;
    int err = lens_from_json(&p->lens, doc, "lens", name);
    if (!err)
        err = read_number(doc, "nodal_offset_m", -10, 10, &p->nodal_offset_m, name, "");
    if (!err)
        err = read_number(doc, "neutral_density_ev", 0, 30, &nd_ev, name, "");
    if (!err)
        err = read_colour(p, doc, name, folder);
    if (err)
        return err;
    if (json_get(doc, "sensor")) {
        const struct json *v = json_get(doc, "sensor");
        err = read_number(v, "electrons_at_white", 10, 1e8, &p->sensor.electrons_at_white, name, "sensor");
        if (!err)
            err = read_number(v, "read_noise_e", 0, 1e4, &p->sensor.read_noise_e, name, "sensor");
        if (err)
            return err;
        if (!(p->sensor.electrons_at_white > 0))
            return refuse(name, "sensor", "no electrons_at_white: expected the full well in electrons at the frames' ISO, or no \"sensor\" at all");
    }
    const int n = json_length(doc, "stops");
    if (n < 1 || n > PANORAMA_STOPS_MAX)
        return refuse(name, "stops", "expected a list of 1 .. 256 stops");
    p->stop = calloc((size_t)n, sizeof(*p->stop));
    if (!p->stop)
        return -ENOMEM;
    for (int i = 0; !err && i < n; i++) {
        char key[32];
        snprintf(key, sizeof(key), "stops.%d", i);
        p->n_stops++;
        err = read_stop(p->stop + i, json_get(doc, key), i, nd_ev, name, folder);
        for (int k = 0; !err && k < i; k++)
            if (strcmp(p->stop[k].name, p->stop[i].name) == 0)
                err = refuse(name, key, "another stop has the same name");
    }
    return err;
}

int panorama_plan_parse(struct panorama_plan *out, const char *text, size_t n_bytes, const char *name, const char *folder)
{
    struct json *doc;
    *out = (struct panorama_plan){ 0 };
    int err = json_parse(&doc, text, n_bytes, name);
    if (err)
        return err;
    err = read_plan(out, doc, name, folder);
    json_free(doc);
    if (err == -ENOMEM)
        log_error("panorama: %s: out of memory", name);
    if (err)
        panorama_plan_free(out);
    return err;
}

int panorama_plan_read(struct panorama_plan *out, const char *path)
{
    enum { MOST_BYTES = 16 << 20 };
    char *text, *folder;
    size_t n;
    *out = (struct panorama_plan){ 0 };
    int err = file_read(&text, &n, path, MOST_BYTES);
    if (err)
        return err;
    const char *slash = strrchr(path, '/');
    folder = slash ? strndup(path, (size_t)(slash - path) + (slash == path)) : strdup("");
    err = folder ? panorama_plan_parse(out, text, n, path, folder) : -ENOMEM;
    free(folder);
    free(text);
    return err;
}

void panorama_plan_free(struct panorama_plan *p)
{
    for (int i = 0; i < p->n_stops; i++) {
        for (int k = 0; k < p->stop[i].n_frames; k++)
            free(p->stop[i].frame[k].file);
        free(p->stop[i].frame);
    }
    free(p->stop);
    free(p->colour_file);
    *p = (struct panorama_plan){ 0 };
}
