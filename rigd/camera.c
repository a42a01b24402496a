// rigd/camera.c - messages between daemon and worker: JSON, bounded, believed in nothing.
//
// Fields that a kind of message does not use are left out and read as zero. A string that does not fit its field makes the
// message invalid: it was cut by its sender, or the sender is not ours.
#include "rigd/camera.h"
#include "solver/take/json.h"

#include <ctype.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const char *const command_names[CAMERA_N_COMMANDS] = {
    "open", "configure", "status", "drain", "trigger", "collect", "list", "fetch", "thumbnail", "delete", "identify", "close",
};
static const char *const trouble_names[CAMERA_N_TROUBLES] = {
    "busy", "lost", "stalled", "refused", "card", "wrong_body", "corrupt", "disk", "broken",
};
static const char *const event_names[CAMERA_N_EVENTS] = { "hello", "done", "failed", "object", "progress" };

const char *camera_command_name(enum camera_command_kind kind)
{
    return (unsigned)kind < CAMERA_N_COMMANDS ? command_names[kind] : "?";
}

const char *camera_trouble_name(enum camera_trouble trouble)
{
    return (unsigned)trouble < CAMERA_N_TROUBLES ? trouble_names[trouble] : "?";
}

// ---- writing ---------------------------------------------------------------------------------------------------------------

static void put_string(struct json *o, const char *key, const char *value)
{
    if (value[0])
        json_set_string(o, key, value);
}

static void put_int(struct json *o, const char *key, int64_t value)
{
    if (value)
        json_set_int(o, key, value);
}

static void put_object(struct json *o, const char *key, const struct camera_object *object)
{
    if (!object->folder[0] && !object->name[0])
        return;
    struct json *v = json_new_object();
    json_set_string(v, "folder", object->folder);
    json_set_string(v, "name", object->name);
    json_set_int(v, "size", object->size_bytes);
    if (key)
        json_set(o, key, v);
    else
        json_append(o, v);
}

static char *finish(struct json *doc, size_t *n_bytes)
{
    char *text = json_text(doc);
    json_free(doc);
    *n_bytes = text ? strlen(text) : 0;
    return text;
}

char *camera_command_encode(const struct camera_command *c, size_t *n_bytes)
{
    struct json *doc = json_new_object();
    json_set_string(doc, "do", camera_command_name(c->kind));
    json_set_int(doc, "seq", c->seq);
    json_set_int(doc, "timeout_ms", c->timeout_ms);
    put_string(doc, "port", c->port);
    put_string(doc, "model", c->model);
    put_string(doc, "personality", c->personality);
    put_string(doc, "serial", c->serial);
    if (c->reset)
        json_set_bool(doc, "reset", true);
    if (c->n_settings) {
        struct json *list = json_new_array();
        for (int i = 0; i < c->n_settings; i++) {
            struct json *s = json_new_object();
            json_set_string(s, "name", c->setting[i].name);
            json_set_string(s, "value", c->setting[i].value);
            json_append(list, s);
        }
        json_set(doc, "settings", list);
    }
    put_int(doc, "quiet_ms", c->quiet_ms);
    put_int(doc, "n_objects", c->n_objects);
    if (c->n_after) {
        struct json *list = json_new_array();
        for (int i = 0; i < c->n_after; i++)
            put_object(list, NULL, &c->after[i]);
        json_set(doc, "after", list);
    }
    put_object(doc, "object", &c->object);
    put_string(doc, "path", c->path);
    put_string(doc, "xxh128", c->xxh128);
    put_string(doc, "judge", c->judge);
    return finish(doc, n_bytes);
}

static void put_facts(struct json *doc, const struct camera_facts *f)
{
    put_string(doc, "serial", f->serial);
    put_string(doc, "model", f->model);
    put_string(doc, "firmware", f->firmware);
    put_string(doc, "driver_port", f->driver_port);
}

static void put_status(struct json *doc, const struct camera_status *s)
{
    struct json *o = json_new_object();
    json_set_int(o, "battery_percent", s->battery_percent);
    json_set_int(o, "card_present", s->card_present);
    json_set_int(o, "free_images", s->free_images);
    json_set_int(o, "free_bytes", s->free_bytes);
    json_set_number(o, "clock_offset_s", s->clock_offset_s); // unknown: null
    json_set_int(o, "manual_focus", s->manual_focus);
    json_set_int(o, "manual_exposure", s->manual_exposure);
    json_set_int(o, "objects_per_shot", s->objects_per_shot);
    put_string(o, "lens", s->lens);
    json_set(doc, "status", o);
}

char *camera_event_encode(const struct camera_event *e, size_t *n_bytes)
{
    struct json *doc = json_new_object();
    json_set_string(doc, "event", (unsigned)e->kind < CAMERA_N_EVENTS ? event_names[e->kind] : "?");
    json_set_int(doc, "seq", e->seq);
    if (e->kind == CAMERA_DONE || e->kind == CAMERA_FAILED)
        json_set_string(doc, "command", camera_command_name(e->command));
    if (e->kind == CAMERA_FAILED) {
        json_set_string(doc, "trouble", camera_trouble_name(e->trouble));
        json_set_int(doc, "err", e->err);
        json_set_string(doc, "text", e->text);
    }
    if (e->kind == CAMERA_HELLO) {
        json_set_int(doc, "protocol", e->protocol);
        json_set_int(doc, "pid", e->pid);
    }
    if (e->kind == CAMERA_DONE && e->command == CAMERA_OPEN)
        put_facts(doc, &e->facts);
    if (e->kind == CAMERA_DONE && e->command == CAMERA_STATUS)
        put_status(doc, &e->status);
    if (e->n_settings) {
        struct json *list = json_new_array();
        for (int i = 0; i < e->n_settings; i++) {
            struct json *s = json_new_object();
            json_set_string(s, "name", e->setting[i].name);
            json_set_string(s, "wanted", e->setting[i].wanted);
            json_set_string(s, "found", e->setting[i].found);
            json_set_bool(s, "equal", e->setting[i].equal);
            json_set_bool(s, "written", e->setting[i].written);
            json_append(list, s);
        }
        json_set(doc, "settings", list);
    }
    put_int(doc, "n_objects", e->n_objects);
    put_int(doc, "pressed_ns", e->pressed_ns);
    put_int(doc, "size", e->size_bytes);
    put_string(doc, "xxh128", e->xxh128);
    if (e->judged)
        json_set(doc, "frame", frame_facts_json(&e->frame));
    put_int(doc, "at_ns", e->at_ns);
    if (e->more)
        json_set_bool(doc, "more", true);
    const int n = e->kind == CAMERA_OBJECT ? 1 : e->n_listed;
    if (n) {
        struct json *list = json_new_array();
        for (int i = 0; i < n; i++)
            put_object(list, NULL, &e->object[i]);
        json_set(doc, "objects", list);
    }
    return finish(doc, n_bytes);
}

// ---- reading ---------------------------------------------------------------------------------------------------------------

struct reader {
    const struct json *v;
    bool bad;
};

static void take_string(struct reader *r, const char *key, char *out, size_t room)
{
    const char *text = "";
    const int err = json_get_string(r->v, key, &text);
    if (err && err != -ENOENT)
        r->bad = true;
    else if (!err && strlen(text) < room)
        memcpy(out, text, strlen(text) + 1);
    else if (!err)
        r->bad = true;
}

static int64_t take_int(struct reader *r, const char *key, int64_t least, int64_t most)
{
    int64_t n = 0;
    const int err = json_get_int(r->v, key, &n);
    if (err == -ENOENT)
        return 0;
    if (err || n < least || n > most) {
        r->bad = true;
        return 0;
    }
    return n;
}

static bool take_bool(struct reader *r, const char *key)
{
    bool b = false;
    const int err = json_get_bool(r->v, key, &b);
    r->bad |= err && err != -ENOENT;
    return b;
}

static int take_word(struct reader *r, const char *key, const char *const *words, int n)
{
    const char *text;
    if (!json_get_string(r->v, key, &text))
        for (int i = 0; i < n; i++)
            if (!strcmp(text, words[i]))
                return i;
    r->bad = true;
    return 0;
}

static void take_object(struct reader *parent, const char *key, struct camera_object *out)
{
    struct reader r = { json_get(parent->v, key), false };
    if (!r.v)
        return;
    take_string(&r, "folder", out->folder, sizeof(out->folder));
    take_string(&r, "name", out->name, sizeof(out->name));
    out->size_bytes = take_int(&r, "size", -1, INT64_MAX);
    // These become file names and paths on a card: nothing that climbs or hides.
    if (!out->name[0] || strchr(out->name, '/') || out->name[0] == '.' || out->folder[0] != '/')
        r.bad = true;
    parent->bad |= r.bad;
}

static void take_hex(struct reader *r, char out[33])
{
    take_string(r, "xxh128", out, 33);
    const size_t n = strlen(out);
    if (n && (n != 32 || strspn(out, "0123456789abcdef") != 32))
        r->bad = true;
}

static const char *element(char key[40], const char *list, int i)
{
    snprintf(key, 40, "%s.%d", list, i);
    return key;
}

static int take_length(struct reader *r, const char *key, int most)
{
    const int n = json_length(r->v, key);
    if (n == -ENOENT)
        return 0;
    if (n < 0 || n > most) {
        r->bad = true;
        return 0;
    }
    return n;
}

int camera_command_decode(struct camera_command *out, const char *text, size_t n_bytes)
{
    struct json *doc = NULL;
    char key[40];
    memset(out, 0, sizeof(*out));
    if (n_bytes > CAMERA_MESSAGE_MAX || json_parse(&doc, text, n_bytes, NULL))
        return -EINVAL;
    struct reader r = { doc, false };
    out->kind = take_word(&r, "do", command_names, CAMERA_N_COMMANDS);
    out->seq = (uint32_t)take_int(&r, "seq", 1, UINT32_MAX);
    r.bad |= !out->seq;
    out->timeout_ms = (uint32_t)take_int(&r, "timeout_ms", 0, UINT32_MAX);
    take_string(&r, "port", out->port, sizeof(out->port));
    take_string(&r, "model", out->model, sizeof(out->model));
    take_string(&r, "personality", out->personality, sizeof(out->personality));
    take_string(&r, "serial", out->serial, sizeof(out->serial));
    out->reset = take_bool(&r, "reset");
    out->n_settings = take_length(&r, "settings", CAMERA_SETTINGS_MAX);
    for (int i = 0; i < out->n_settings; i++) {
        struct reader s = { json_get(doc, element(key, "settings", i)), false };
        take_string(&s, "name", out->setting[i].name, sizeof(out->setting[i].name));
        take_string(&s, "value", out->setting[i].value, sizeof(out->setting[i].value));
        r.bad |= s.bad;
    }
    out->quiet_ms = (uint32_t)take_int(&r, "quiet_ms", 0, UINT32_MAX);
    out->n_objects = (int)take_int(&r, "n_objects", 0, 1000);
    out->n_after = take_length(&r, "after", CAMERA_STORES_MAX);
    for (int i = 0; i < out->n_after; i++)
        take_object(&r, element(key, "after", i), &out->after[i]);
    take_object(&r, "object", &out->object);
    take_string(&r, "path", out->path, sizeof(out->path));
    r.bad |= out->path[0] && out->path[0] != '/';
    take_hex(&r, out->xxh128);
    take_string(&r, "judge", out->judge, sizeof(out->judge));
    json_free(doc);
    if (r.bad)
        memset(out, 0, sizeof(*out));
    return r.bad ? -EINVAL : 0;
}

static void take_status(struct reader *parent, struct camera_status *s)
{
    struct reader r = { json_get(parent->v, "status"), false };
    if (!r.v) {
        parent->bad = true;
        return;
    }
    s->battery_percent = (int)take_int(&r, "battery_percent", -1, 100);
    s->card_present = (int)take_int(&r, "card_present", -1, 1);
    s->free_images = take_int(&r, "free_images", -1, INT64_MAX);
    s->free_bytes = take_int(&r, "free_bytes", -1, INT64_MAX);
    if (json_get_number(r.v, "clock_offset_s", &s->clock_offset_s))
        s->clock_offset_s = NAN;
    s->manual_focus = (int)take_int(&r, "manual_focus", -1, 1);
    s->manual_exposure = (int)take_int(&r, "manual_exposure", -1, 1);
    s->objects_per_shot = (int)take_int(&r, "objects_per_shot", -1, 1000);
    take_string(&r, "lens", s->lens, sizeof(s->lens));
    parent->bad |= r.bad;
}

int camera_event_decode(struct camera_event *out, const char *text, size_t n_bytes)
{
    struct json *doc = NULL;
    char key[40];
    memset(out, 0, sizeof(*out));
    if (n_bytes > CAMERA_MESSAGE_MAX || json_parse(&doc, text, n_bytes, NULL))
        return -EINVAL;
    struct reader r = { doc, false };
    out->kind = take_word(&r, "event", event_names, CAMERA_N_EVENTS);
    out->seq = (uint32_t)take_int(&r, "seq", 0, UINT32_MAX);
    r.bad |= !out->seq != (out->kind == CAMERA_HELLO);
    if (out->kind == CAMERA_DONE || out->kind == CAMERA_FAILED)
        out->command = take_word(&r, "command", command_names, CAMERA_N_COMMANDS);
    if (out->kind == CAMERA_FAILED) {
        out->trouble = take_word(&r, "trouble", trouble_names, CAMERA_N_TROUBLES);
        out->err = (int)take_int(&r, "err", -4095, 0);
        take_string(&r, "text", out->text, sizeof(out->text));
    }
    out->protocol = (int)take_int(&r, "protocol", 0, INT32_MAX);
    out->pid = take_int(&r, "pid", 0, INT32_MAX);
    take_string(&r, "serial", out->facts.serial, sizeof(out->facts.serial));
    take_string(&r, "model", out->facts.model, sizeof(out->facts.model));
    take_string(&r, "firmware", out->facts.firmware, sizeof(out->facts.firmware));
    take_string(&r, "driver_port", out->facts.driver_port, sizeof(out->facts.driver_port));
    if (out->kind == CAMERA_DONE && out->command == CAMERA_STATUS)
        take_status(&r, &out->status);
    out->n_settings = take_length(&r, "settings", CAMERA_SETTINGS_MAX);
    for (int i = 0; i < out->n_settings; i++) {
        struct camera_setting_found *f = &out->setting[i];
        struct reader s = { json_get(doc, element(key, "settings", i)), false };
        take_string(&s, "name", f->name, sizeof(f->name));
        take_string(&s, "wanted", f->wanted, sizeof(f->wanted));
        take_string(&s, "found", f->found, sizeof(f->found));
        f->equal = take_bool(&s, "equal");
        f->written = take_bool(&s, "written");
        r.bad |= s.bad;
    }
    out->n_objects = (int)take_int(&r, "n_objects", 0, INT32_MAX);
    out->pressed_ns = take_int(&r, "pressed_ns", 0, INT64_MAX);
    out->size_bytes = take_int(&r, "size", 0, INT64_MAX);
    take_hex(&r, out->xxh128);
    out->judged = json_get(doc, "frame") != NULL;
    r.bad |= out->judged && frame_facts_from_json(&out->frame, json_get(doc, "frame"));
    out->at_ns = take_int(&r, "at_ns", 0, INT64_MAX);
    out->more = take_bool(&r, "more");
    out->n_listed = take_length(&r, "objects", CAMERA_LISTING_MAX);
    for (int i = 0; i < out->n_listed; i++)
        take_object(&r, element(key, "objects", i), &out->object[i]);
    if (out->kind == CAMERA_OBJECT)
        r.bad |= out->n_listed != 1;
    if (out->kind == CAMERA_DONE && (out->command == CAMERA_FETCH || out->command == CAMERA_THUMBNAIL))
        r.bad |= !out->xxh128[0];
    json_free(doc);
    if (r.bad)
        memset(out, 0, sizeof(*out));
    return r.bad ? -EINVAL : 0;
}

// ---- order on a card ---------------------------------------------------------------------------------------------------------

// The digits that DCF counts with: three at the start of the last folder's name, the last four or more of the file's stem.
static int64_t folder_number(const char *folder)
{
    const char *slash = strrchr(folder, '/');
    const char *last = slash ? slash + 1 : folder;
    return isdigit((unsigned char)last[0]) && isdigit((unsigned char)last[1]) && isdigit((unsigned char)last[2])
               ? strtol((char[4]){ last[0], last[1], last[2], 0 }, NULL, 10)
               : -1;
}

static int64_t file_number(const char *name)
{
    const char *dot = strrchr(name, '.');
    const char *end = dot ? dot : name + strlen(name), *begin = end;
    while (begin > name && end - begin < 15 && isdigit((unsigned char)begin[-1]))
        begin--;
    int64_t n = begin < end ? 0 : -1;
    for (; begin < end; begin++)
        n = n * 10 + (*begin - '0');
    return n;
}

static int compare(int64_t a, int64_t b)
{
    return (a > b) - (a < b);
}

static size_t store_length(const char *folder)
{
    const size_t slash = folder[0] == '/';
    return slash + strcspn(folder + slash, "/");
}

bool camera_same_store(const struct camera_object *a, const struct camera_object *b)
{
    const size_t n = store_length(a->folder);
    return n == store_length(b->folder) && !strncmp(a->folder, b->folder, n);
}

int camera_object_order(const struct camera_object *a, const struct camera_object *b)
{
    const size_t n_a = store_length(a->folder), n_b = store_length(b->folder);
    int order = strncmp(a->folder, b->folder, n_a < n_b ? n_a : n_b);
    if (!order)
        order = compare((int64_t)n_a, (int64_t)n_b);
    if (!order)
        order = compare(folder_number(a->folder), folder_number(b->folder));
    if (!order)
        order = compare(file_number(a->name), file_number(b->name));
    if (!order)
        order = strcmp(a->folder, b->folder);
    return order ? order : strcmp(a->name, b->name);
}
