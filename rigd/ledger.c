// rigd/ledger.c - take.json, and the folder it speaks for.
//
// Order is everything here. A take's folder appears whole (built under a hidden name, synced, renamed without replacing); its ledger is
// replaced whole; a copy's bytes are synced before the copy is named (ingest.c). So each thing on disk is either complete or
// recognisable as a leftover, and reconciling is looking, not guessing.
#include "rigd/ledger.h"
#include "rigd/digest.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <ctype.h>
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define FORMAT "studiorig take 1"

enum { ENTRIES_MAX = 4 * CONFIG_CAMERAS_MAX };

static const char *const state_names[TAKE_N_STATES] = {
    "idle", "preflight", "armed", "exposing", "collecting", "verified", "developed", "solved", "failed",
};
static const char *const kind_names[LEDGER_N_KINDS] = { "capture", "panorama" };
static const char *const object_states[OBJECT_N_STATES] = { "found", "copied", "deleted", "gone" };
static const char *const debts[] = { "open", "paid", "missed" };
static const char *const processings[LEDGER_N_PROCESSING] = { "none", "owed", "settled", "cancelled" };

const char *take_state_name(enum take_state s)
{
    return (unsigned)s < TAKE_N_STATES ? state_names[s] : "?";
}

// ---- plain data ---------------------------------------------------------------------------------------------------------------

void ledger_init(struct ledger *l, const struct config *config)
{
    *l = (struct ledger){ .objects_per_shot = config->objects_per_shot, .spread_ns = -1, .sigma_ns = -1, .jitter_ns = -1,
                          .processing = config->process.develop ? LEDGER_OWED : LEDGER_UNPROCESSED };
    l->camera = calloc((size_t)config->n_cameras + 1, sizeof(*l->camera));
    if (!l->camera)
        return;
    l->n_cameras = config->n_cameras;
    for (int i = 0; i < l->n_cameras; i++) {
        struct ledger_camera *c = &l->camera[i];
        memcpy(c->name, config->camera[i].name, sizeof(c->name));
        memcpy(c->port, config->camera[i].port, sizeof(c->port));
        memcpy(c->serial, config->camera[i].serial, sizeof(c->serial));
        c->battery_percent = -1;
        c->expected = i != config_panorama_camera(config);
        c->lag_ns = INT64_MIN;
    }
}

void ledger_init_panorama(struct ledger *l, const struct config *config)
{
    *l = (struct ledger){ .kind = LEDGER_PANORAMA, .objects_per_shot = 1, .spread_ns = -1, .sigma_ns = -1, .jitter_ns = -1,
                          .processing = config->process.develop ? LEDGER_OWED : LEDGER_UNPROCESSED };
    l->n_stops = config->panorama.n_stops;
    memcpy(l->stop, config->panorama.stop, sizeof(l->stop));
}

double ledger_exposure_label(double seconds, char label[16])
{
    // As dials have them; the shutter's times are 2^(third / 3) s.
    static const char *const labels[] = { "1/8000", "1/6400", "1/5000", "1/4000", "1/3200", "1/2500", "1/2000", "1/1600", "1/1250", "1/1000", "1/800", "1/640",
        "1/500", "1/400", "1/320", "1/250", "1/200", "1/160", "1/125", "1/100", "1/80", "1/60", "1/50", "1/40", "1/30", "1/25", "1/20", "1/15", "1/13", "1/10", "1/8",
        "1/6", "1/5", "1/4", "0.3", "0.4", "0.5", "0.6", "0.8", "1", "1.3", "1.6", "2", "2.5", "3", "4", "5", "6", "8", "10", "13", "15", "20", "25", "30" };
    enum { N_LABELS = sizeof(labels) / sizeof(labels[0]), FIRST = -39 }; // 2^-13 s is called 1/8000
    double third = round(3 * log2(seconds));
    third = third < FIRST ? FIRST : third > FIRST + N_LABELS - 1 ? FIRST + N_LABELS - 1 : third;
    snprintf(label, 16, "%s", labels[(int)third - FIRST]);
    return exp2(third / 3);
}

int ledger_expose(struct ledger *l, const struct config *config, int stop, int bracket, double wanted_s)
{
    const struct config_camera *k = &config->camera[config->panorama.camera];
    if (l->n_cameras == ENTRIES_MAX)
        return -EFBIG;
    struct ledger_camera *grown = realloc(l->camera, ((size_t)l->n_cameras + 1) * sizeof(*grown));
    if (!grown)
        return -ENOMEM;
    l->camera = grown;
    struct ledger_camera *c = &l->camera[l->n_cameras];
    memset(c, 0, sizeof(*c));
    snprintf(c->name, sizeof(c->name), "%02d_%02d", stop, bracket);
    memcpy(c->port, k->port, sizeof(c->port));
    memcpy(c->serial, k->serial, sizeof(c->serial));
    c->battery_percent = -1;
    c->expected = c->is_exposure = true;
    c->lag_ns = INT64_MIN;
    c->exposure = (struct ledger_exposure){ .stop = stop, .bracket = bracket, .yaw_deg = l->stop[stop].yaw_deg, .pitch_deg = l->stop[stop].pitch_deg, .object = -1 };
    c->exposure.wanted_s = ledger_exposure_label(wanted_s, c->exposure.label);
    return l->n_cameras++;
}

void ledger_free(struct ledger *l)
{
    free(l->camera);
    *l = (struct ledger){ 0 };
}

struct ledger_object *ledger_find(struct ledger_camera *c, const struct camera_object *o)
{
    for (int i = 0; i < c->n_objects; i++)
        if (!strcmp(c->object[i].object.folder, o->folder) && !strcmp(c->object[i].object.name, o->name))
            return &c->object[i];
    return NULL;
}

bool ledger_owns(const struct ledger_camera *c, const struct camera_object *o)
{
    for (int i = 0; i < c->n_before; i++)
        if (camera_same_store(&c->before[i], o) && camera_object_order(o, &c->before[i]) <= 0)
            return false;
    if (!c->has_until)
        return true;
    for (int i = 0; i < c->n_until; i++)
        if (camera_same_store(&c->until[i], o))
            return camera_object_order(o, &c->until[i]) <= 0;
    return false;
}

struct ledger_object *ledger_add(struct ledger_camera *c, const struct camera_object *o)
{
    char extension[12] = "", name[24];
    memcpy(name, c->name, sizeof(name));
    if (c->n_objects == LEDGER_OBJECTS_MAX)
        return NULL;
    const char *dot = strrchr(o->name, '.');
    for (size_t i = 0; dot && dot[i] && i < sizeof(extension) - 1; i++) // card names are ASCII; anything else is not for our names
        extension[i] = i == 0 || isalnum((unsigned char)dot[i]) ? (char)tolower((unsigned char)dot[i]) : '_';
    struct ledger_object *added = &c->object[c->n_objects];
    *added = (struct ledger_object){ .object = *o, .state = OBJECT_FOUND, .copied_ms = -1 };
    for (int n = 1;; n++) {
        bool taken = false;
        const char *folder = c->is_exposure ? "panorama/raw" : "raw";
        if (n == 1)
            snprintf(added->file, sizeof(added->file), "%s/%.23s%s", folder, name, extension);
        else
            snprintf(added->file, sizeof(added->file), "%s/%.23s_%d%s", folder, name, n, extension);
        for (int i = 0; i < c->n_objects; i++)
            taken |= !strcmp(c->object[i].file, added->file);
        if (!taken)
            break;
    }
    c->n_objects++;
    return added;
}

bool ledger_is_whole(const struct ledger *l)
{
    for (int i = 0; i < l->n_cameras; i++) {
        const struct ledger_camera *c = &l->camera[i];
        int n_here = 0;
        for (int k = 0; k < c->n_objects; k++) {
            const enum object_state state = c->object[k].state;
            if (c->expected && (state == OBJECT_FOUND || state == OBJECT_GONE))
                return false;
            n_here += state == OBJECT_COPIED || state == OBJECT_DELETED;
        }
        if (c->expected && (c->debt != DEBT_PAID || n_here < l->objects_per_shot))
            return false;
    }
    return true;
}

// ---- to and from JSON --------------------------------------------------------------------------------------------------------------

static void put(struct json *o, const char *key, const char *value)
{
    if (value[0])
        json_set_string(o, key, value);
}

static struct json *object_json(const struct camera_object *o)
{
    struct json *v = json_new_object();
    json_set_string(v, "folder", o->folder);
    json_set_string(v, "name", o->name);
    json_set_int(v, "size", o->size_bytes);
    return v;
}

static struct json *exposure_json(const struct ledger_exposure *e)
{
    struct json *v = json_new_object();
    json_set_int(v, "stop", e->stop);
    json_set_int(v, "bracket", e->bracket);
    json_set_number(v, "yaw_deg", e->yaw_deg);
    json_set_number(v, "pitch_deg", e->pitch_deg);
    json_set_number(v, "wanted_s", e->wanted_s);
    json_set_string(v, "label", e->label);
    if (e->rejected)
        json_set_bool(v, "rejected", true);
    if (e->object >= 0) {
        json_set_int(v, "object", e->object);
        json_set(v, "facts", frame_facts_json(&e->facts));
    }
    return v;
}

static struct json *camera_json(const struct ledger_camera *c)
{
    struct json *v = json_new_object(), *list;
    json_set_string(v, "name", c->name);
    put(v, "serial", c->serial);
    put(v, "port", c->port);
    put(v, "model", c->model);
    put(v, "firmware", c->firmware);
    put(v, "lens", c->lens);
    if (c->battery_percent >= 0)
        json_set_int(v, "battery_percent", c->battery_percent);
    json_set_bool(v, "expected", c->expected);
    json_set_string(v, "debt", debts[c->debt]);
    put(v, "note", c->note);
    json_set_int(v, "delay_us", c->delay_us);
    if (c->lag_ns != INT64_MIN)
        json_set_int(v, "lag_ns", c->lag_ns);
    list = json_new_array();
    for (int i = 0; i < c->n_before; i++)
        json_append(list, object_json(&c->before[i]));
    json_set(v, "before", list);
    list = json_new_array();
    for (int i = 0; i < c->n_objects; i++) {
        const struct ledger_object *o = &c->object[i];
        struct json *e = object_json(&o->object);
        json_set_string(e, "state", object_states[o->state]);
        json_set_string(e, "file", o->file);
        put(e, "xxh128", o->xxh128);
        json_set_int(e, "retries", o->n_retries);
        if (o->copied_ms >= 0)
            json_set_int(e, "copied_ms", o->copied_ms);
        json_append(list, e);
    }
    json_set(v, "objects", list);
    list = json_new_array();
    for (int i = 0; i < c->n_settings; i++) {
        struct json *s = json_new_object();
        json_set_string(s, "name", c->setting[i].name);
        json_set_string(s, "wanted", c->setting[i].wanted);
        json_set_string(s, "found", c->setting[i].found);
        json_append(list, s);
    }
    json_set(v, "settings", list);
    if (c->is_exposure)
        json_set(v, "exposure", exposure_json(&c->exposure));
    if (c->developed[0]) {
        struct json *d = json_new_object();
        json_set_string(d, "file", c->developed);
        json_set_number(d, "clipped_share", c->clipped_share);
        json_set_number(d, "seconds", c->developed_s);
        json_set(v, "developed", d);
    }
    return v;
}

void ledger_note_stage(struct ledger *l, const char *name, int64_t began_utc_ms, int64_t ended_utc_ms)
{
    int i = 0;
    while (i < l->n_stages && strcmp(l->stage[i].name, name))
        i++;
    if (i == LEDGER_STAGES_MAX)
        return;
    l->n_stages += i == l->n_stages;
    l->stage[i] = (struct ledger_stage){ .began_utc_ms = began_utc_ms, .ended_utc_ms = ended_utc_ms };
    snprintf(l->stage[i].name, sizeof(l->stage[i].name), "%s", name);
}

static struct json *stages_json(const struct ledger *l)
{
    struct json *list = json_new_array();
    for (int i = 0; i < l->n_stages; i++) {
        struct json *o = json_new_object();
        json_set_string(o, "stage", l->stage[i].name);
        json_set_int(o, "began_utc_ms", l->stage[i].began_utc_ms);
        json_set_int(o, "ended_utc_ms", l->stage[i].ended_utc_ms);
        json_append(list, o);
    }
    return list;
}

static struct json *processing_json(const struct ledger *l)
{
    struct json *v = json_new_object(), *notes = json_new_array(), *solves = json_new_array();
    json_set_string(v, "state", processings[l->processing]);
    put(v, "panorama_from", l->panorama_from);
    for (int i = 0; i < l->n_notes; i++)
        json_append_string(notes, l->process_note[i]);
    for (int i = 0; i < l->n_solves; i++) {
        const struct ledger_solve *s = &l->solve[i];
        struct json *o = json_new_object();
        json_set_string(o, "name", s->name);
        json_set_bool(o, "trusted", s->trusted);
        json_set_number(o, "rmse_held_out_percent", s->rmse_held_out_percent); // not held out: null
        json_set_number(o, "seconds", s->seconds);
        put(o, "why", s->why);
        json_append(solves, o);
    }
    json_set(v, "notes", notes);
    json_set(v, "solves", solves);
    return v;
}

char *ledger_text(const struct ledger *l)
{
    struct json *doc = json_new_object(), *list = json_new_array(), *shot = json_new_object();
    json_set_string(doc, "format", FORMAT);
    json_set_string(doc, "name", l->name);
    json_set_string(doc, "created", l->created);
    json_set_string(doc, "state", take_state_name(l->state));
    json_set_string(doc, "id", l->id);
    json_set_string(doc, "kind", kind_names[l->kind]);
    put(doc, "panorama_take", l->panorama_take);
    if (l->kind == LEDGER_PANORAMA) {
        struct json *stops = json_new_array();
        for (int i = 0; i < l->n_stops; i++) {
            struct json *stop = json_new_object();
            json_set_number(stop, "yaw_deg", l->stop[i].yaw_deg);
            json_set_number(stop, "pitch_deg", l->stop[i].pitch_deg);
            json_append(stops, stop);
        }
        json_set(doc, "stops", stops);
    }
    put(doc, "reason", l->reason);
    json_set_string(doc, "rigd", STUDIORIG_VERSION);
    json_set_int(doc, "objects_per_shot", l->objects_per_shot);
    json_set_bool(shot, "synchronised", l->synchronised);
    json_set_int(shot, "utc_ms", l->shot_utc_ms);
    json_set_int(shot, "spread_ns", l->spread_ns);
    json_set_int(shot, "sigma_ns", l->sigma_ns);
    json_set_int(shot, "n_measured", l->n_measured);
    json_set_int(shot, "jitter_ns", l->jitter_ns);
    json_set(doc, "shot", shot);
    if (l->n_stages)
        json_set(doc, "time_line", stages_json(l));
    if (l->processing)
        json_set(doc, "processing", processing_json(l));
    for (int i = 0; i < l->n_cameras; i++)
        json_append(list, camera_json(&l->camera[i]));
    json_set(doc, "cameras", list);
    char *text = json_text(doc);
    json_free(doc);
    return text;
}

struct reader {
    const struct json *v;
    const char *file; // for errors
    char where[40];
    bool bad;
};

static void complain(struct reader *r, const char *key, const char *expected)
{
    if (!r->bad)
        log_error("ledger: %s: %s%s%s: expected %s; restore the file from a backup or fetch the take anew", r->file, r->where, r->where[0] ? "." : "", key, expected);
    r->bad = true;
}

static void get_string(struct reader *r, const char *key, char *out, size_t room)
{
    const char *text = "";
    const int err = json_get_string(r->v, key, &text);
    out[0] = 0;
    if (err == -ENOENT)
        return;
    if (err || strlen(text) >= room) {
        complain(r, key, "a short text");
        return;
    }
    memcpy(out, text, strlen(text) + 1);
}

static int64_t get_int(struct reader *r, const char *key, int64_t least, int64_t most, int64_t missing)
{
    int64_t n;
    const int err = json_get_int(r->v, key, &n);
    if (err == -ENOENT)
        return missing;
    if (err || n < least || n > most) {
        complain(r, key, "a whole number within its range");
        return missing;
    }
    return n;
}

static int get_word(struct reader *r, const char *key, const char *const *words, int n)
{
    const char *text;
    if (!json_get_string(r->v, key, &text))
        for (int i = 0; i < n; i++)
            if (!strcmp(text, words[i]))
                return i;
    complain(r, key, "one of its words");
    return 0;
}

static bool get_bool(struct reader *r, const char *key)
{
    bool b = false;
    if (json_get_bool(r->v, key, &b))
        complain(r, key, "true or false");
    return b;
}

static int get_length(struct reader *r, const char *key, int most)
{
    const int n = json_length(r->v, key);
    if (n < 0 || n > most) {
        complain(r, key, "a list of bounded length");
        return 0;
    }
    return n;
}

static double get_number(struct reader *r, const char *key, double missing)
{
    double n = missing;
    const int err = json_get_number(r->v, key, &n);
    if (err && err != -ENOENT && !(isnan(missing) && json_get(r->v, key))) // null is a number that is not there
        complain(r, key, "a number");
    return err ? missing : n;
}

static struct reader child(const struct reader *parent, const char *list, int i)
{
    char key[40];
    struct reader r = { .file = parent->file };
    snprintf(key, sizeof(key), "%.20s.%d", list, i);
    snprintf(r.where, sizeof(r.where), "%.20s%s%.18s", parent->where, parent->where[0] ? "." : "", key);
    r.v = json_get(parent->v, key);
    return r;
}

static bool is_plain(const char *s)
{
    return s[0] && strspn(s, "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_") == strlen(s);
}

static void get_object(struct reader *r, struct camera_object *o)
{
    get_string(r, "folder", o->folder, sizeof(o->folder));
    get_string(r, "name", o->name, sizeof(o->name));
    o->size_bytes = get_int(r, "size", -1, INT64_MAX, -1);
    if (o->folder[0] != '/' || !o->name[0] || strchr(o->name, '/') || o->name[0] == '.')
        complain(r, "name", "a file on a card");
}

static void get_developed(struct reader *r, struct ledger_camera *c)
{
    struct reader d = { .v = json_get(r->v, "developed"), .file = r->file };
    snprintf(d.where, sizeof(d.where), "%.25s.developed", r->where);
    if (!d.v)
        return;
    get_string(&d, "file", c->developed, sizeof(c->developed));
    c->clipped_share = get_number(&d, "clipped_share", 0);
    c->developed_s = get_number(&d, "seconds", 0);
    if (strncmp(c->developed, "linear/", 7) || c->developed[7] == '.' || strchr(c->developed + 7, '/'))
        complain(&d, "file", "a file of linear/");
    r->bad |= d.bad;
}

static void get_processing(struct reader *r, struct ledger *l)
{
    struct reader p = { .v = json_get(r->v, "processing"), .file = r->file, .where = "processing" };
    if (!p.v)
        return;
    l->processing = get_word(&p, "state", processings, LEDGER_N_PROCESSING);
    get_string(&p, "panorama_from", l->panorama_from, sizeof(l->panorama_from));
    l->n_notes = get_length(&p, "notes", LEDGER_NOTES_MAX);
    for (int i = 0; i < l->n_notes; i++) {
        char key[20];
        snprintf(key, sizeof(key), "notes.%d", i);
        get_string(&p, key, l->process_note[i], sizeof(l->process_note[i]));
    }
    l->n_solves = get_length(&p, "solves", LEDGER_SOLVES_MAX);
    for (int i = 0; i < l->n_solves; i++) {
        struct ledger_solve *s = &l->solve[i];
        struct reader e = child(&p, "solves", i);
        get_string(&e, "name", s->name, sizeof(s->name));
        if (!is_plain(s->name))
            complain(&e, "name", "letters, digits, - and _");
        s->trusted = get_bool(&e, "trusted");
        s->rmse_held_out_percent = get_number(&e, "rmse_held_out_percent", NAN);
        s->seconds = get_number(&e, "seconds", 0);
        get_string(&e, "why", s->why, sizeof(s->why));
        p.bad |= e.bad;
    }
    if (p.bad)
        r->bad = true;
}

static void get_stages(struct reader *r, struct ledger *l)
{
    if (!json_get(r->v, "time_line")) // of takes before there was one
        return;
    l->n_stages = get_length(r, "time_line", LEDGER_STAGES_MAX);
    for (int i = 0; i < l->n_stages; i++) {
        struct ledger_stage *s = &l->stage[i];
        struct reader e = child(r, "time_line", i);
        get_string(&e, "stage", s->name, sizeof(s->name));
        if (!is_plain(s->name))
            complain(&e, "stage", "letters, digits, - and _");
        s->began_utc_ms = get_int(&e, "began_utc_ms", 0, INT64_MAX, 0);
        s->ended_utc_ms = get_int(&e, "ended_utc_ms", 0, INT64_MAX, 0);
        r->bad |= e.bad;
    }
}

static void get_exposure(struct reader *r, struct ledger_camera *c)
{
    struct reader v = { .v = json_get(r->v, "exposure"), .file = r->file };
    struct ledger_exposure *e = &c->exposure;
    snprintf(v.where, sizeof(v.where), "%.25s.exposure", r->where);
    if (!v.v)
        return;
    c->is_exposure = true;
    e->stop = (int)get_int(&v, "stop", 0, CONFIG_STOPS_MAX - 1, 0);
    e->bracket = (int)get_int(&v, "bracket", 0, 99, 0);
    e->yaw_deg = get_number(&v, "yaw_deg", 0);
    e->pitch_deg = get_number(&v, "pitch_deg", 0);
    e->wanted_s = get_number(&v, "wanted_s", 0);
    get_string(&v, "label", e->label, sizeof(e->label));
    if (!(e->wanted_s > 0 && e->wanted_s < 3600))
        complain(&v, "wanted_s", "an exposure time");
    e->rejected = json_get(v.v, "rejected") && get_bool(&v, "rejected");
    e->object = (int)get_int(&v, "object", 0, LEDGER_OBJECTS_MAX - 1, -1);
    if (e->object >= 0 && frame_facts_from_json(&e->facts, json_get(v.v, "facts")))
        complain(&v, "facts", "a frame's exposure and light");
    r->bad |= v.bad;
}

static void get_stops(struct reader *r, struct ledger *l)
{
    if (json_get(r->v, "kind"))
        l->kind = get_word(r, "kind", kind_names, LEDGER_N_KINDS);
    get_string(r, "panorama_take", l->panorama_take, sizeof(l->panorama_take));
    if (l->panorama_take[0] && !is_plain(l->panorama_take)) // it becomes a path
        complain(r, "panorama_take", "the name of a take's folder");
    if (l->kind != LEDGER_PANORAMA)
        return;
    l->n_stops = get_length(r, "stops", CONFIG_STOPS_MAX);
    for (int i = 0; i < l->n_stops; i++) {
        struct reader stop = child(r, "stops", i);
        l->stop[i] = (struct config_stop){ get_number(&stop, "yaw_deg", 0), get_number(&stop, "pitch_deg", 0) };
        r->bad |= stop.bad;
    }
}

static void get_camera(struct reader *r, struct ledger_camera *c)
{
    get_string(r, "name", c->name, sizeof(c->name));
    if (!is_plain(c->name))
        complain(r, "name", "letters, digits, - and _");
    get_string(r, "serial", c->serial, sizeof(c->serial));
    get_string(r, "port", c->port, sizeof(c->port));
    get_string(r, "model", c->model, sizeof(c->model));
    get_string(r, "firmware", c->firmware, sizeof(c->firmware));
    get_string(r, "lens", c->lens, sizeof(c->lens));
    c->battery_percent = (int)get_int(r, "battery_percent", 0, 100, -1);
    c->expected = get_bool(r, "expected");
    c->debt = get_word(r, "debt", debts, 3);
    get_string(r, "note", c->note, sizeof(c->note));
    c->delay_us = get_int(r, "delay_us", 0, 1000000, 0);
    c->lag_ns = get_int(r, "lag_ns", INT64_MIN, INT64_MAX, INT64_MIN);
    c->n_before = get_length(r, "before", CAMERA_STORES_MAX);
    for (int i = 0; i < c->n_before; i++) {
        struct reader o = child(r, "before", i);
        get_object(&o, &c->before[i]);
        r->bad |= o.bad;
    }
    c->n_settings = get_length(r, "settings", CAMERA_SETTINGS_MAX);
    for (int i = 0; i < c->n_settings; i++) {
        struct camera_setting_found *f = &c->setting[i];
        struct reader e = child(r, "settings", i);
        get_string(&e, "name", f->name, sizeof(f->name));
        get_string(&e, "wanted", f->wanted, sizeof(f->wanted));
        get_string(&e, "found", f->found, sizeof(f->found));
        f->equal = !strcmp(f->wanted, f->found);
        r->bad |= e.bad;
    }
    get_developed(r, c);
    get_exposure(r, c);
    c->n_objects = get_length(r, "objects", LEDGER_OBJECTS_MAX);
    if (c->is_exposure && c->exposure.object >= c->n_objects)
        complain(r, "exposure.object", "one of its objects");
    for (int i = 0; i < c->n_objects; i++) {
        struct ledger_object *o = &c->object[i];
        struct reader e = child(r, "objects", i);
        get_object(&e, &o->object);
        o->state = get_word(&e, "state", object_states, OBJECT_N_STATES);
        get_string(&e, "file", o->file, sizeof(o->file));
        get_string(&e, "xxh128", o->xxh128, sizeof(o->xxh128));
        o->n_retries = (int)get_int(&e, "retries", 0, INT32_MAX, 0);
        o->copied_ms = get_int(&e, "copied_ms", 0, INT64_MAX, -1);
        const char *name = o->file + (c->is_exposure && !strncmp(o->file, "panorama/", 9) ? 9 : 0);
        if (strncmp(name, "raw/", 4) || !name[4] || name[4] == '.' || strchr(name + 4, '/') || (name == o->file) == c->is_exposure)
            complain(&e, "file", "a file of raw/, or of panorama/raw/");
        for (int k = 0; k < i; k++)
            if (!strcmp(c->object[k].file, o->file))
                complain(&e, "file", "a name of its own");
        const bool has_copy = o->state == OBJECT_COPIED || o->state == OBJECT_DELETED;
        if (o->xxh128[0] ? strlen(o->xxh128) != 32 || strspn(o->xxh128, "0123456789abcdef") != 32 : has_copy)
            complain(&e, "xxh128", "32 hexadecimal digits");
        r->bad |= e.bad;
    }
}

int ledger_parse(struct ledger *out, const char *text, size_t n_bytes, const char *name)
{
    struct json *doc = NULL;
    *out = (struct ledger){ 0 };
    const int err = json_parse(&doc, text, n_bytes, name);
    if (err)
        return err;
    struct reader r = { .v = doc, .file = name };
    char format[32];
    get_string(&r, "format", format, sizeof(format));
    if (strcmp(format, FORMAT))
        complain(&r, "format", "'" FORMAT "'");
    get_string(&r, "id", out->id, sizeof(out->id));
    if (!is_plain(out->id))
        complain(&r, "id", "the folder's name");
    get_string(&r, "name", out->name, sizeof(out->name));
    get_string(&r, "created", out->created, sizeof(out->created));
    out->state = get_word(&r, "state", state_names, TAKE_N_STATES);
    get_string(&r, "reason", out->reason, sizeof(out->reason));
    out->objects_per_shot = (int)get_int(&r, "objects_per_shot", 1, LEDGER_OBJECTS_MAX, 1);
    struct reader shot = { .v = json_get(doc, "shot"), .file = name, .where = "shot" };
    if (shot.v) {
        out->synchronised = get_bool(&shot, "synchronised");
        out->shot_utc_ms = get_int(&shot, "utc_ms", 0, INT64_MAX, 0);
        out->spread_ns = get_int(&shot, "spread_ns", -1, INT64_MAX, -1);
        out->sigma_ns = get_int(&shot, "sigma_ns", -1, INT64_MAX, -1);
        out->n_measured = (int)get_int(&shot, "n_measured", 0, CONFIG_CAMERAS_MAX, 0);
        out->jitter_ns = get_int(&shot, "jitter_ns", INT64_MIN, INT64_MAX, -1);
    }
    get_stages(&r, out);
    get_processing(&r, out);
    get_stops(&r, out);
    const int n = get_length(&r, "cameras", ENTRIES_MAX);
    out->camera = calloc((size_t)n + 1, sizeof(*out->camera));
    if (!out->camera) {
        json_free(doc);
        return -ENOMEM;
    }
    out->n_cameras = n;
    for (int i = 0; i < n && !r.bad; i++) {
        struct reader c = child(&r, "cameras", i);
        get_camera(&c, &out->camera[i]);
        r.bad |= c.bad;
        if (c.v && out->camera[i].is_exposure != (out->kind == LEDGER_PANORAMA) && !r.bad)
            complain(&c, "exposure", "one in a panorama, none in a capture"), r.bad = true;
        if (out->camera[i].is_exposure && out->camera[i].exposure.stop >= out->n_stops && !r.bad)
            complain(&c, "exposure.stop", "one of stops"), r.bad = true;
        for (int k = 0; k < i && !r.bad; k++)
            if (!strcmp(out->camera[k].name, out->camera[i].name))
                complain(&c, "name", "a name of its own"), r.bad = true;
    }
    json_free(doc);
    if (r.bad || shot.bad) {
        ledger_free(out);
        return -EINVAL;
    }
    return 0;
}

// ---- on disk -------------------------------------------------------------------------------------------------------------------------

static void join(char *out, size_t room, const char *dir, const char *name)
{
    snprintf(out, room, "%s/%s", dir, name);
}

int ledger_read(struct ledger *out, const char *take_dir)
{
    char path[1024], *text;
    size_t n;
    *out = (struct ledger){ 0 };
    join(path, sizeof(path), take_dir, "take.json");
    if (access(path, F_OK))
        return -errno;
    int err = file_read(&text, &n, path, 64 << 20);
    if (err)
        return err;
    err = ledger_parse(out, text, n, path);
    free(text);
    return err;
}

int ledger_commit(const char *text, const char *take_dir)
{
    struct atomic_file f;
    char path[1024];
    join(path, sizeof(path), take_dir, "take.json");
    int err = atomic_file_open(&f, path);
    if (err)
        return err;
    fputs(text, f.stream); // commit looks at ferror
    fputc('\n', f.stream);
    return atomic_file_commit(&f);
}

static int sync_folder(const char *dir)
{
    const int fd = open(dir, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (fd < 0)
        return -errno;
    const int err = fsync(fd) ? -errno : 0;
    close(fd);
    return err;
}

static const struct {
    const char *name;
    enum ledger_kind kind;
} folders[] = { { "raw", LEDGER_CAPTURE }, { "thumbnails", LEDGER_CAPTURE }, { "linear", LEDGER_CAPTURE }, { "geometry", LEDGER_CAPTURE },
                { "geometry/cameras", LEDGER_CAPTURE }, { "panorama", LEDGER_PANORAMA }, { "panorama/raw", LEDGER_PANORAMA } };
enum { N_FOLDERS = sizeof(folders) / sizeof(folders[0]) };

static bool is_part(const char *name) // .NAME.tag.part of atomic_file, NAME.part of ingest; no camera's name holds a dot
{
    const size_t n = strlen(name);
    return n > 5 && !strcmp(name + n - 5, ".part");
}

static int remove_parts_of(const char *prefix, const char *dir, int *n_removed)
{
    char path[1400];
    DIR *d = opendir(dir);
    if (!d)
        return errno == ENOENT ? 0 : -errno;
    int n = 0;
    for (const struct dirent *e; (e = readdir(d));)
        if (is_part(e->d_name) && !strncmp(e->d_name, prefix, strlen(prefix))) {
            join(path, sizeof(path), dir, e->d_name);
            n += unlink(path) == 0;
        }
    closedir(d);
    *n_removed += n;
    return n ? sync_folder(dir) : 0;
}

static int remove_parts(const char *dir, int *n_removed)
{
    return remove_parts_of("", dir, n_removed);
}

static void remove_new(const char *dir)
{
    char path[1024];
    int n = 0;
    remove_parts(dir, &n);
    join(path, sizeof(path), dir, "take.json");
    unlink(path);
    for (int i = N_FOLDERS - 1; i >= 0; i--) {
        join(path, sizeof(path), dir, folders[i].name);
        rmdir(path);
    }
    rmdir(dir);
}

int ledger_create(const char *text, enum ledger_kind kind, const char *id, const char *takes_dir)
{
    char dir[1024], final[1024], path[1200];
    join(final, sizeof(final), takes_dir, id);
    snprintf(dir, sizeof(dir), "%s/.%s.part", takes_dir, id);
    int err = make_directories(takes_dir);
    if (err)
        return err;
    remove_new(dir); // of an earlier life that ended here
    err = mkdir(dir, 0777) ? -errno : 0;
    for (int i = 0; i < N_FOLDERS && !err; i++)
        if (folders[i].kind == kind) {
            join(path, sizeof(path), dir, folders[i].name);
            err = mkdir(path, 0777) ? -errno : 0;
        }
    if (!err) {
        join(path, sizeof(path), dir, kind == LEDGER_PANORAMA ? "panorama" : "geometry");
        err = sync_folder(path);
    }
    if (!err)
        err = ledger_commit(text, dir); // syncs dir as well
    if (!err && renameat2(AT_FDCWD, dir, AT_FDCWD, final, RENAME_NOREPLACE))
        err = -errno;
    if (!err)
        err = sync_folder(takes_dir);
    if (err) {
        log_error("ledger: cannot create %s: %s", final, strerror(-err));
        remove_new(dir);
    }
    return err;
}

void ledger_remove_leftovers(const char *takes_dir)
{
    char path[1024];
    DIR *d = opendir(takes_dir);
    for (const struct dirent *e; d && (e = readdir(d));) {
        int n = 0;
        join(path, sizeof(path), takes_dir, e->d_name);
        if (e->d_name[0] == '.' && is_part(e->d_name))
            remove_new(path); // only what ledger_create makes; a folder with anything else in it stays
        else if (e->d_name[0] != '.')
            remove_parts_of(".take.json.", path, &n); // a take that is verified is not reconciled
    }
    if (d)
        closedir(d);
}

// ---- after a crash -------------------------------------------------------------------------------------------------------------------

// Never deleted: somebody may want to know what happened to it.
static int set_aside(const char *path)
{
    char aside[1400];
    for (int n = 0; n < 1000; n++) {
        snprintf(aside, sizeof(aside), n ? "%s.damaged%d" : "%s.damaged", path, n);
        if (!renameat2(AT_FDCWD, path, AT_FDCWD, aside, RENAME_NOREPLACE)) {
            log_warning("ledger: %s is not what was copied; it is now %s, and the frame is fetched again", path, aside);
            return 0;
        }
        if (errno != EEXIST)
            return -errno;
    }
    return -EEXIST;
}

static int reconcile_object(struct ledger_object *o, const char *take_dir, struct ledger_findings *found, bool *taken_back)
{
    char path[1200], hex[DIGEST_HEX];
    int64_t size = 0;
    join(path, sizeof(path), take_dir, o->file);
    const bool noted = o->state == OBJECT_COPIED || o->state == OBJECT_DELETED;
    int err = digest_file(path, 1, hex, &size);
    if (err && err != -ENOENT)
        return err; // unreadable is not missing: a person has to look
    bool good = !err && (noted ? !strcmp(hex, o->xxh128) : o->object.size_bytes < 0 || o->object.size_bytes == size);
    if (!err && !good) {
        err = set_aside(path);
        if (err)
            return err;
    }
    if (good && !noted) {
        o->state = OBJECT_COPIED;
        o->object.size_bytes = size;
        memcpy(o->xxh128, hex, sizeof(o->xxh128));
        found->n_adopted++;
    }
    if (!good && noted) {
        o->state = o->state == OBJECT_DELETED ? OBJECT_GONE : OBJECT_FOUND;
        o->xxh128[0] = 0;
        *taken_back = true;
        found->n_taken_back++;
        if (o->state == OBJECT_GONE)
            log_error("ledger: %s is lost: its copy is missing or damaged, and the card's frame was deleted after it was verified", path);
    }
    return 0;
}

int ledger_remove_parts(const char *take_dir, int *n_removed)
{
    char path[1100];
    int err = remove_parts(take_dir, n_removed);
    for (int i = 0; i < N_FOLDERS && !err; i++) {
        join(path, sizeof(path), take_dir, folders[i].name);
        err = remove_parts(path, n_removed);
    }
    return err;
}

int ledger_reconcile(struct ledger *l, const char *take_dir, struct ledger_findings *found)
{
    char path[1100];
    *found = (struct ledger_findings){ 0 };
    int err = ledger_remove_parts(take_dir, &found->n_parts_removed);
    for (int i = 0; i < l->n_cameras && !err; i++) {
        struct ledger_camera *c = &l->camera[i];
        bool taken_back = false;
        for (int k = 0; k < c->n_objects && !err; k++)
            err = reconcile_object(&c->object[k], take_dir, found, &taken_back);
        if (taken_back)
            c->debt = DEBT_OPEN;
    }
    const char *const folder = l->kind == LEDGER_PANORAMA ? "panorama/raw" : "raw";
    join(path, sizeof(path), take_dir, folder);
    DIR *d = err ? NULL : opendir(path);
    for (const struct dirent *e; d && (e = readdir(d));) {
        bool known = e->d_name[0] == '.' || is_part(e->d_name) || strstr(e->d_name, ".damaged");
        for (int i = 0; i < l->n_cameras && !known; i++)
            for (int k = 0; k < l->camera[i].n_objects && !known; k++)
                known = !strcmp(l->camera[i].object[k].file + strlen(folder) + 1, e->d_name);
        if (!known) {
            found->n_strangers++;
            log_warning("ledger: %s/%s is in no ledger; it is left alone", path, e->d_name);
        }
    }
    if (d)
        closedir(d);
    if (err)
        log_error("ledger: cannot reconcile %s: %s", take_dir, strerror(-err));
    return err;
}

static bool same_body(const struct ledger_camera *a, const struct ledger_camera *b)
{
    return a->serial[0] && b->serial[0] ? !strcmp(a->serial, b->serial) : !strcmp(a->name, b->name);
}

int ledger_bound(struct ledger *l, const char *takes_dir)
{
    struct dirent **entries = NULL;
    char path[1024];
    const int n = scandir(takes_dir, &entries, NULL, alphasort);
    if (n < 0) {
        const int err = -errno;
        log_error("ledger: cannot list %s: %s", takes_dir, strerror(-err));
        return err;
    }
    for (int i = 0; i < l->n_cameras; i++)
        l->camera[i].has_until = false;
    for (int e = 0; e < n; e++) {
        struct ledger later;
        const bool is_later = strcmp(entries[e]->d_name, l->id) > 0 && entries[e]->d_name[0] != '.';
        join(path, sizeof(path), takes_dir, entries[e]->d_name);
        free(entries[e]);
        if (!is_later || ledger_read(&later, path))
            continue;
        for (int i = 0; i < l->n_cameras; i++)
            for (int k = 0; !l->camera[i].has_until && k < later.n_cameras; k++)
                if (later.camera[k].expected && same_body(&l->camera[i], &later.camera[k])) {
                    l->camera[i].has_until = true;
                    l->camera[i].n_until = later.camera[k].n_before;
                    memcpy(l->camera[i].until, later.camera[k].before, sizeof(l->camera[i].until));
                }
        ledger_free(&later);
    }
    free(entries);
    return 0;
}
