// rigd/describe.c - what clients get to see.
#include "rigd/describe.h"
#include "rigd/take_files.h"
#include "solver/take/log.h"

#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

static const char *const severities[] = { "info", "warning", "error" };

static void put(struct json *o, const char *key, const char *value)
{
    if (value[0])
        json_set_string(o, key, value);
}

static void put_known(struct json *o, const char *key, int64_t value)
{
    if (value >= 0)
        json_set_int(o, key, value);
}

struct json *describe_camera(const struct rig *rig, const struct config *config, int i)
{
    const struct rig_camera_view v = rig_camera(rig, i);
    const struct config_camera *c = &config->camera[i];
    struct json *o = json_new_object();
    json_set_string(o, "name", c->name);
    json_set_string(o, "port", c->port);
    json_set_string(o, "condition", rig_condition_name(v.condition));
    if (v.busy)
        json_set_string(o, "doing", camera_command_name(v.command));
    put(o, "note", v.note);
    put(o, "serial", v.facts->serial[0] ? v.facts->serial : c->serial);
    put(o, "model", v.facts->model);
    put(o, "firmware", v.facts->firmware);
    put(o, "lens", v.status->lens);
    put_known(o, "battery_percent", v.status->battery_percent);
    put_known(o, "free_images", v.status->free_images);
    put_known(o, "card_present", v.status->card_present);
    if (!isnan(v.status->clock_offset_s))
        json_set_number(o, "clock_offset_s", v.status->clock_offset_s);
    json_set_int(o, "recoveries", v.n_recoveries);
    if (v.bytes_now)
        json_set_int(o, "bytes_now", v.bytes_now);
    struct json *settings = json_new_object();
    for (int k = 0; k < v.n_settings; k++)
        json_set_string(settings, v.setting[k].name, v.setting[k].found);
    json_set(o, "settings", settings);
    if (v.lag.n)
        json_set_number(o, "lag_ms", v.lag.mean_ms);
    return o;
}

struct json *describe_rig(const struct rig *rig, const struct config *config, const char *trigger)
{
    struct json *o = json_new_object();
    const struct ledger *l = rig_ledger(rig);
    int n[RIG_QUARANTINED + 1] = { 0 };
    json_set_string(o, "name", config->name);
    json_set_string(o, "version", STUDIORIG_VERSION);
    json_set_string(o, "state", take_state_name(rig_state(rig)));
    json_set_bool(o, "busy", rig_is_busy(rig));
    put(o, "outcome", rig_outcome(rig));
    put(o, "prompt", rig_prompt(rig));
    json_set_string(o, "trigger", trigger);
    json_set_string(o, "takes_dir", config->takes_dir);
    if (config_panorama_camera(config) != CONFIG_NONE)
        json_set_string(o, "panorama_camera", config->panorama.camera_name);
    if (l)
        json_set(o, "take", describe_take(l, false));
    for (int i = 0; i < config->n_cameras; i++)
        n[rig_camera(rig, i).condition]++;
    json_set_int(o, "n_cameras", config->n_cameras);
    json_set_int(o, "n_ready", n[RIG_READY]);
    json_set_int(o, "n_quarantined", n[RIG_QUARANTINED]);
    return o;
}

struct json *describe_cameras(const struct rig *rig, const struct config *config)
{
    struct json *list = json_new_array();
    for (int i = 0; i < config->n_cameras; i++)
        json_append(list, describe_camera(rig, config, i));
    return list;
}

struct json *describe_findings(const struct rig *rig, const struct config *config)
{
    struct json *o = json_new_object(), *list = json_new_array();
    int n_errors = 0;
    for (int i = 0; i < rig_n_findings(rig); i++) {
        const struct rig_finding *f = rig_finding(rig, i);
        struct json *e = json_new_object();
        json_set_string(e, "severity", severities[f->severity]);
        if (f->camera != CONFIG_NONE) {
            json_set_string(e, "camera", config->camera[f->camera].name);
            json_set_string(e, "port", config->camera[f->camera].port);
        }
        json_set_string(e, "text", f->text);
        json_append(list, e);
        n_errors += f->severity == RIG_ERROR;
    }
    json_set_bool(o, "fit", n_errors == 0);
    json_set(o, "findings", list);
    return o;
}

struct json *describe_lag(const struct rig *rig, const struct config *config)
{
    struct json *o = json_new_object(), *list = json_new_array();
    put(o, "outcome", rig_outcome(rig));
    for (int i = 0; i < config->n_cameras; i++) {
        const struct lag lag = rig_camera(rig, i).lag;
        struct json *e = json_new_object();
        json_set_string(e, "camera", config->camera[i].name);
        json_set_int(e, "n", lag.n);
        if (lag.n) {
            json_set_number(e, "mean_ms", lag.mean_ms);
            json_set_number(e, "std_ms", lag.std_ms);
            json_set_number(e, "error_ms", lag.error_ms);
            json_set_int(e, "rejected", lag.n_rejected);
            json_set_bool(e, "steady", lag.std_ms <= config->lag_max_std_ms);
        }
        json_append(list, e);
    }
    json_set(o, "lag", list);
    return o;
}

static struct json *describe_processing(const struct ledger *l)
{
    static const char *const words[LEDGER_N_PROCESSING] = { "none", "owed", "settled", "cancelled" };
    struct json *o = json_new_object(), *notes = json_new_array(), *solves = json_new_array();
    int n_developed = 0;
    for (int i = 0; i < l->n_cameras; i++)
        n_developed += l->camera[i].developed[0] != 0;
    json_set_string(o, "state", words[l->processing]);
    json_set_int(o, "n_developed", n_developed);
    put(o, "panorama_from", l->panorama_from);
    for (int i = 0; i < l->n_notes; i++)
        json_append_string(notes, l->process_note[i]);
    for (int i = 0; i < l->n_solves; i++) {
        struct json *e = json_new_object();
        json_set_string(e, "name", l->solve[i].name);
        json_set_bool(e, "trusted", l->solve[i].trusted);
        if (!isnan(l->solve[i].rmse_held_out_percent))
            json_set_number(e, "rmse_held_out_percent", l->solve[i].rmse_held_out_percent);
        json_set_number(e, "seconds", l->solve[i].seconds);
        put(e, "why", l->solve[i].why);
        json_append(solves, e);
    }
    json_set(o, "notes", notes);
    json_set(o, "solves", solves);
    return o;
}

// Seconds after the button.
static struct json *describe_time_line(const struct ledger *l)
{
    struct json *list = json_new_array();
    for (int i = 0; i < l->n_stages; i++) {
        const struct ledger_stage *s = &l->stage[i];
        const int64_t button = !strcmp(l->stage[0].name, "button") ? l->stage[0].began_utc_ms : l->shot_utc_ms; // resumed: not noted
        struct json *e = json_new_object();
        json_set_string(e, "stage", s->name);
        json_set_number(e, "began_s", 1e-3 * (double)(s->began_utc_ms - button));
        json_set_number(e, "ended_s", 1e-3 * (double)(s->ended_utc_ms - button));
        json_set_number(e, "took_s", 1e-3 * (double)(s->ended_utc_ms - s->began_utc_ms));
        json_append(list, e);
    }
    return list;
}

struct json *describe_take(const struct ledger *l, bool with_cameras)
{
    struct json *o = json_new_object(), *list = json_new_array(), *missing = json_new_array(), *left_out = json_new_array();
    int n_expected = 0, n_paid = 0, n_frames = 0;
    int64_t bytes = 0;
    for (int i = 0; i < l->n_cameras; i++) {
        const struct ledger_camera *c = &l->camera[i];
        n_expected += c->expected;
        n_paid += c->expected && c->debt == DEBT_PAID;
        for (int k = 0; k < c->n_objects; k++)
            if (c->object[k].state == OBJECT_COPIED || c->object[k].state == OBJECT_DELETED) {
                n_frames++;
                bytes += c->object[k].object.size_bytes;
            }
        if (!c->expected ? c->note[0] : c->debt == DEBT_MISSED) { // without a note: no part of this take
            struct json *e = json_new_object();
            json_set_string(e, "camera", c->name);
            json_set_string(e, "port", c->port);
            json_set_string(e, "note", c->note);
            json_append(c->expected ? missing : left_out, e);
        }
        if (!with_cameras)
            continue;
        struct json *e = json_new_object(), *files = json_new_array();
        json_set_string(e, "camera", c->name);
        put(e, "serial", c->serial);
        put(e, "note", c->note);
        if (c->is_exposure) {
            json_set_int(e, "stop", c->exposure.stop + 1);
            json_set_string(e, "exposure", c->exposure.label);
        }
        json_set_int(e, "delay_us", c->delay_us);
        if (c->lag_ns != INT64_MIN)
            json_set_number(e, "lag_ms", 1e-6 * (double)c->lag_ns);
        for (int k = 0; k < c->n_objects; k++) {
            struct json *f = json_new_object();
            json_set_string(f, "file", c->object[k].file);
            json_set_int(f, "size", c->object[k].object.size_bytes);
            put(f, "xxh128", c->object[k].xxh128);
            put_known(f, "copied_ms", c->object[k].copied_ms);
            json_append(files, f);
        }
        json_set(e, "files", files);
        if (c->developed[0]) {
            json_set_string(e, "developed", c->developed);
            json_set_number(e, "clipped_share", c->clipped_share);
            json_set_number(e, "developed_s", c->developed_s);
        }
        json_append(list, e);
    }
    json_set_string(o, "id", l->id);
    json_set_string(o, "name", l->name);
    json_set_string(o, "created", l->created);
    json_set_string(o, "state", take_state_name(l->state));
    put(o, "reason", l->reason);
    json_set_string(o, "kind", l->kind == LEDGER_PANORAMA ? "panorama" : "capture");
    if (l->kind == LEDGER_PANORAMA)
        json_set_int(o, "n_stops", l->n_stops);
    put(o, "panorama_take", l->panorama_take);
    json_set_int(o, "n_expected", n_expected);
    json_set_int(o, "n_delivered", n_paid);
    json_set_int(o, "n_frames", n_frames);
    json_set_int(o, "bytes", bytes);
    json_set_bool(o, "synchronised", l->synchronised);
    if (l->spread_ns >= 0) {
        json_set_number(o, "spread_ms", 1e-6 * (double)l->spread_ns);
        json_set_number(o, "sigma_ms", 1e-6 * (double)l->sigma_ns);
        json_set_int(o, "n_measured", l->n_measured);
    }
    if (l->jitter_ns >= 0)
        json_set_number(o, "jitter_ms", 1e-6 * (double)l->jitter_ns);
    if (l->n_stages)
        json_set(o, "time_line", describe_time_line(l));
    json_set(o, "missing", missing);
    json_set(o, "left_out", left_out);
    if (l->processing)
        json_set(o, "processing", describe_processing(l));
    if (with_cameras)
        json_set(o, "cameras", list);
    else
        json_free(list);
    return o;
}

struct json *describe_plan(const struct ledger *l, const struct config *config)
{
    const struct panorama_config *p = &config->panorama;
    struct json *o = json_new_object(), *stops = json_new_array();
    json_set_string(o, "take", l->id);
    json_set_string(o, "state", take_state_name(l->state));
    put(o, "reason", l->reason);
    json_set(o, "lens", lens_json(&p->lens));
    json_set_number(o, "nodal_offset_m", p->nodal_offset_m);
    json_set_number(o, "neutral_density_ev", p->neutral_density_ev);
    for (int i = 0; i < l->n_stops; i++) {
        struct json *stop = json_new_object(), *frames = json_new_array();
        const char *note = "";
        char name[16];
        snprintf(name, sizeof(name), "%02d", i);
        json_set_string(stop, "name", name);
        json_set_number(stop, "yaw_deg", l->stop[i].yaw_deg);
        json_set_number(stop, "pitch_deg", l->stop[i].pitch_deg);
        for (int k = 0; k < l->n_cameras; k++) {
            const struct ledger_camera *c = &l->camera[k];
            const struct ledger_exposure *x = &c->exposure;
            if (x->stop != i || x->object < 0 || x->rejected || c->debt != DEBT_PAID)
                continue;
            struct json *frame = json_new_object();
            json_set_string(frame, "file", c->object[x->object].file + strlen("panorama/"));
            json_set_number(frame, "exposure_s", x->facts.light.exposure_s);
            json_append(frames, frame);
            note = c->note[0] ? c->note : note;
        }
        put(stop, "note", note);
        json_set(stop, "frames", frames);
        json_append(stops, stop);
    }
    json_set(o, "stops", stops);
    return o;
}

struct json *describe_progress(const struct ledger *l, const struct rig_progress *p)
{
    static const char *const steps[] = { "turn", "expose", "frame", "stop_done" };
    struct json *o = json_new_object();
    json_set_string(o, "take", l->id);
    json_set_string(o, "step", steps[p->step]);
    json_set_int(o, "stop", p->stop + 1);
    json_set_int(o, "n_stops", p->n_stops);
    json_set_number(o, "yaw_deg", p->yaw_deg);
    json_set_number(o, "pitch_deg", p->pitch_deg);
    if (p->step == RIG_STEP_EXPOSE || p->step == RIG_STEP_FRAME) {
        json_set_int(o, "frame", p->bracket + 1);
        json_set_string(o, "exposure", p->label);
    }
    put(o, "text", p->text);
    return o;
}

struct json *describe_takes(const char *takes_dir, int newest)
{
    struct dirent **entries = NULL;
    struct json **takes = NULL, *list = NULL;
    int n_takes = 0;
    const int n = scandir(takes_dir, &entries, NULL, alphasort);
    if (n < 0 && errno != ENOENT) {
        log_error("takes: cannot list %s: %s", takes_dir, strerror(errno));
        return NULL;
    }
    takes = calloc((size_t)(n > 0 ? n : 1), sizeof(*takes));
    for (int i = n - 1; takes && i >= 0 && n_takes < newest; i--) {
        char path[600];
        struct ledger l;
        snprintf(path, sizeof(path), "%s/%s", takes_dir, entries[i]->d_name);
        if (entries[i]->d_name[0] == '.' || ledger_read(&l, path))
            continue;
        takes[n_takes] = describe_take(&l, false);
        json_set(takes[n_takes++], "files", take_files_list(path));
        ledger_free(&l);
    }
    if (takes)
        list = json_new_array();
    for (int i = n_takes - 1; i >= 0; i--)
        json_append(list, takes[i]);
    for (int i = 0; i < n; i++)
        free(entries[i]);
    free(entries);
    free(takes);
    return list;
}

char *describe_metrics(const struct rig *rig, const struct config *config, const struct counters *c)
{
    char *text = NULL;
    size_t size = 0;
    FILE *out = open_memstream(&text, &size);
    if (!out)
        return NULL;
    fputs("# HELP rigd_cameras Cameras by condition.\n# TYPE rigd_cameras gauge\n", out);
    for (int k = RIG_OFF; k <= RIG_QUARANTINED; k++) {
        int n = 0;
        for (int i = 0; i < config->n_cameras; i++)
            n += rig_camera(rig, i).condition == (enum rig_condition)k;
        fprintf(out, "rigd_cameras{condition=\"%s\"} %d\n", rig_condition_name(k), n);
    }
    static const struct {
        const char *name, *help;
        size_t offset;
    } counts[] = {
        { "takes_total", "Takes since start.", offsetof(struct counters, n_takes) },
        { "takes_verified_total", "Takes with every frame here.", offsetof(struct counters, n_verified) },
        { "takes_failed_total", "Takes that failed.", offsetof(struct counters, n_failed) },
        { "frames_total", "Frames copied and verified.", offsetof(struct counters, n_frames) },
        { "bytes_total", "Bytes copied and verified.", offsetof(struct counters, n_bytes) },
        { "quarantines_total", "Cameras put into quarantine.", offsetof(struct counters, n_quarantines) },
    };
    for (size_t i = 0; i < sizeof(counts) / sizeof(counts[0]); i++)
        fprintf(out, "# HELP rigd_%s %s\n# TYPE rigd_%s counter\nrigd_%s %lld\n", counts[i].name, counts[i].help, counts[i].name, counts[i].name,
                (long long)*(const int64_t *)((const char *)c + counts[i].offset));
    fprintf(out, "# HELP rigd_busy A take, preflight or calibration is under way.\n# TYPE rigd_busy gauge\nrigd_busy %d\n", rig_is_busy(rig));
    fprintf(out, "# HELP rigd_take_seconds From request to end of the last take.\n# TYPE rigd_take_seconds gauge\nrigd_take_seconds %.3f\n", c->last_take_s);
    fputs("# HELP rigd_camera_battery_percent Battery.\n# TYPE rigd_camera_battery_percent gauge\n", out);
    for (int i = 0; i < config->n_cameras; i++)
        if (rig_camera(rig, i).status->battery_percent >= 0)
            fprintf(out, "rigd_camera_battery_percent{camera=\"%s\"} %d\n", config->camera[i].name, rig_camera(rig, i).status->battery_percent);
    fputs("# HELP rigd_camera_recoveries_total Times a camera was in trouble.\n# TYPE rigd_camera_recoveries_total counter\n", out);
    for (int i = 0; i < config->n_cameras; i++)
        fprintf(out, "rigd_camera_recoveries_total{camera=\"%s\"} %d\n", config->camera[i].name, rig_camera(rig, i).n_recoveries);
    if (fclose(out)) {
        free(text);
        return NULL;
    }
    return text;
}
