// rigd/products.c - notes, keys, command lines; and the file work that is no program's: linking a panorama, copying a fixed rig's
// geometry, giving a solve its name.
#include "rigd/products.h"
#include "rigd/digest.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/take/take.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <unistd.h>

#define FORMAT "studiorig processing 1"
enum { NOTES_MAX = CONFIG_CAMERAS_MAX + PROCESSING_N_STEPS, PATH_BYTES = 1200, COPY_BYTES_MAX = 1 << 30, LOG_TAIL = 2048 };

enum note_state { NOTE_OWED, NOTE_BEGUN, NOTE_MADE };
static const char *const note_states[] = { "owed", "begun", "made" };

struct note {
    enum processing_step step;
    char item[24];           // the camera; "" of other steps
    enum note_state state;
    char key[DIGEST_HEX];    // of the inputs
    char file[64];           // the product, relative to the take
    int64_t size_bytes;
    double seconds, clipped_share, rmse_held_out_percent;
    bool trusted;
    char from[96];           // the panorama's take
    char text[200];
};

struct job { // an item of the last look, as it is to be made
    char name[24], raw[96], out[96];
    char key[DIGEST_HEX];
    char from[96];
};

struct products {
    const struct products_site *site;
    char dir[700], id[96];
    struct ledger ledger;
    bool is_panorama;
    struct note *note;
    int n_notes;
    struct job *job[PROCESSING_N_STEPS];
    int n_jobs[PROCESSING_N_STEPS];
};

// ---- small things -------------------------------------------------------------------------------------------------------------

static void in_take(const struct products *p, char *out, const char *name)
{
    snprintf(out, PATH_BYTES, "%s/%s", p->dir, name);
}

__attribute__((format(printf, 2, 3))) static void say(char text[PROCESSING_TEXT], const char *format, ...)
{
    va_list args;
    va_start(args, format);
    vsnprintf(text, PROCESSING_TEXT, format, args);
    va_end(args);
}

static const char *solve_name(enum processing_step step)
{
    return step == STEP_PREVIEW ? "preview" : step == STEP_STANDARD ? "standard" : "final";
}

static bool is_solve(enum processing_step step)
{
    return step == STEP_PREVIEW || step == STEP_STANDARD || step == STEP_FINAL;
}

static int64_t size_of(const char *path)
{
    struct stat st;
    return stat(path, &st) || !S_ISREG(st.st_mode) ? -1 : (int64_t)st.st_size;
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

// A folder of ours with everything in it; links are removed, not followed.
static void remove_tree(const char *dir, int depth)
{
    DIR *d = depth < 8 ? opendir(dir) : NULL;
    char path[PATH_BYTES + 300];
    for (const struct dirent *e; d && (e = readdir(d));) {
        struct stat st;
        if (!strcmp(e->d_name, ".") || !strcmp(e->d_name, ".."))
            continue;
        snprintf(path, sizeof(path), "%s/%s", dir, e->d_name);
        if (!lstat(path, &st) && S_ISDIR(st.st_mode))
            remove_tree(path, depth + 1);
        else
            unlink(path);
    }
    if (d)
        closedir(d);
    rmdir(dir);
}

// ---- keys ---------------------------------------------------------------------------------------------------------------------

struct key {
    struct digest *digest;
};

static struct key key_begin(const char *what)
{
    struct key k = { digest_begin() };
    if (!k.digest)
        abort();
    digest_add(k.digest, what, strlen(what) + 1);
    digest_add(k.digest, STUDIORIG_VERSION, sizeof(STUDIORIG_VERSION));
    return k;
}

static void key_text(struct key *k, const char *text)
{
    digest_add(k->digest, text, strlen(text) + 1);
}

// Size and time of change, not the content: pictures are large. Not there counts, too. name: which part it plays.
static void key_file(struct key *k, const char *name, const char *path)
{
    struct stat st;
    char text[200];
    if (path && path[0] && !stat(path, &st))
        snprintf(text, sizeof(text), "%.80s %lld %lld.%09ld", name, (long long)st.st_size, (long long)st.st_mtim.tv_sec, st.st_mtim.tv_nsec);
    else
        snprintf(text, sizeof(text), "%.80s none", name);
    key_text(k, text);
}

static void key_folder(struct key *k, const char *dir)
{
    struct dirent **entries = NULL;
    char path[PATH_BYTES + 300];
    const int n = scandir(dir, &entries, NULL, alphasort);
    for (int i = 0; i < n; i++) {
        struct stat st;
        snprintf(path, sizeof(path), "%s/%s", dir, entries[i]->d_name);
        if (entries[i]->d_name[0] != '.' && !stat(path, &st) && S_ISREG(st.st_mode))
            key_file(k, entries[i]->d_name, path);
        free(entries[i]);
    }
    free(entries);
}

static void key_end(struct key *k, char out[DIGEST_HEX])
{
    digest_end(k->digest, out);
}

// ---- notes --------------------------------------------------------------------------------------------------------------------

static struct note *find_note(const struct products *p, enum processing_step step, const char *item)
{
    for (int i = 0; i < p->n_notes; i++)
        if (p->note[i].step == step && !strcmp(p->note[i].item, item))
            return &p->note[i];
    return NULL;
}

static struct note *make_note(struct products *p, enum processing_step step, const char *item)
{
    struct note *n = find_note(p, step, item);
    if (!n && p->n_notes < NOTES_MAX)
        n = &p->note[p->n_notes++];
    if (!n)
        return NULL;
    *n = (struct note){ .step = step, .rmse_held_out_percent = NAN };
    snprintf(n->item, sizeof(n->item), "%s", item);
    return n;
}

static void drop_notes(struct products *p, enum processing_step step)
{
    int n = 0;
    for (int i = 0; i < p->n_notes; i++)
        if (p->note[i].step != step)
            p->note[n++] = p->note[i];
    p->n_notes = n;
}

static int write_notes(const struct products *p)
{
    char path[PATH_BYTES];
    struct json *doc = json_new_object(), *list = json_new_array();
    json_set_string(doc, "format", FORMAT);
    for (int i = 0; i < p->n_notes; i++) {
        const struct note *n = &p->note[i];
        struct json *o = json_new_object();
        json_set_string(o, "step", processing_step_name(n->step));
        if (n->item[0])
            json_set_string(o, "item", n->item);
        json_set_string(o, "state", note_states[n->state]);
        if (n->state == NOTE_MADE) {
            json_set_string(o, "key", n->key);
            json_set_string(o, "file", n->file);
            json_set_int(o, "size", n->size_bytes);
            json_set_number(o, "seconds", n->seconds);
        }
        if (n->step == STEP_DEVELOP)
            json_set_number(o, "clipped_share", n->clipped_share);
        if (n->from[0])
            json_set_string(o, "from", n->from);
        if (n->state == NOTE_MADE && is_solve(n->step)) {
            json_set_bool(o, "trusted", n->trusted);
            json_set_number(o, "rmse_held_out_percent", n->rmse_held_out_percent);
        }
        if (n->text[0])
            json_set_string(o, "text", n->text);
        json_append(list, o);
    }
    json_set(doc, "products", list);
    in_take(p, path, "processing.json");
    const int err = json_write(doc, path);
    json_free(doc);
    return err;
}

static bool get_text(const struct json *v, const char *key, char *out, size_t room)
{
    const char *text = "";
    const int err = json_get_string(v, key, &text);
    if ((err && err != -ENOENT) || strlen(text) >= room)
        return false;
    memcpy(out, text, strlen(text) + 1);
    return true;
}

static bool read_note(struct products *p, const struct json *v)
{
    const char *word = "";
    char item[24] = "";
    int64_t state = -1;
    json_get_string(v, "step", &word);
    const int step = processing_step_named(word);
    if (step < 0 || !get_text(v, "item", item, sizeof(item)) || json_get_string(v, "state", &word))
        return false;
    for (int i = 0; i < 3; i++)
        if (!strcmp(word, note_states[i]))
            state = i;
    struct note *n = state < 0 ? NULL : make_note(p, (enum processing_step)step, item);
    if (!n)
        return false;
    n->state = (enum note_state)state;
    n->size_bytes = -1;
    json_get_int(v, "size", &n->size_bytes);
    json_get_number(v, "seconds", &n->seconds);
    json_get_number(v, "clipped_share", &n->clipped_share);
    json_get_number(v, "rmse_held_out_percent", &n->rmse_held_out_percent);
    json_get_bool(v, "trusted", &n->trusted);
    return get_text(v, "key", n->key, sizeof(n->key)) && get_text(v, "file", n->file, sizeof(n->file)) && get_text(v, "from", n->from, sizeof(n->from)) &&
           get_text(v, "text", n->text, sizeof(n->text)) && n->file[0] != '/' && !strstr(n->file, "..");
}

static int read_notes(struct products *p)
{
    char path[PATH_BYTES], aside[PATH_BYTES + 10];
    struct json *doc = NULL;
    const char *format = "";
    in_take(p, path, "processing.json");
    if (access(path, F_OK))
        return 0;
    int err = json_read(&doc, path);
    if (!err && (json_get_string(doc, "format", &format) || strcmp(format, FORMAT)))
        err = -EINVAL;
    const int n = err ? 0 : json_length(doc, "products");
    if (n < 0 || n > NOTES_MAX)
        err = -EINVAL;
    for (int i = 0; i < n && !err; i++) {
        char key[32];
        snprintf(key, sizeof(key), "products.%d", i);
        if (!read_note(p, json_get(doc, key)))
            err = -EINVAL;
    }
    json_free(doc);
    if (err == -EINVAL) { // it only saves work
        snprintf(aside, sizeof(aside), "%s.damaged", path);
        log_warning("products: %s is not what rigd writes; it is now %s, and everything is looked at anew", path, aside);
        p->n_notes = 0;
        err = rename(path, aside) ? -errno : 0;
    }
    return err;
}

// Made from these inputs, and still there as it was.
static bool is_there(const struct products *p, const struct note *n, const char *key)
{
    char path[PATH_BYTES];
    if (!n || n->state != NOTE_MADE || strcmp(n->key, key))
        return false;
    in_take(p, path, n->file);
    return size_of(path) == n->size_bytes;
}

// What programs that were killed had begun: hidden .part files of ours. The ledger's own, and what the rig is copying, is not touched.
static void remove_parts(const struct products *p, const char *folder, const char *prefix)
{
    char dir[PATH_BYTES], path[PATH_BYTES + 300];
    in_take(p, dir, folder);
    DIR *d = opendir(dir);
    for (const struct dirent *e; d && (e = readdir(d));) {
        const size_t n = strlen(e->d_name);
        if (strncmp(e->d_name, prefix, strlen(prefix)) || n < 6 || strcmp(e->d_name + n - 5, ".part"))
            continue;
        snprintf(path, sizeof(path), "%s/%s", dir, e->d_name);
        unlink(path);
    }
    if (d)
        closedir(d);
}

// ---- life ---------------------------------------------------------------------------------------------------------------------

int products_open(struct products **out, const struct products_site *site, const char *id)
{
    struct products *p = calloc(1, sizeof(*p));
    int err = -ENOMEM;
    if (!p)
        return err;
    p->site = site;
    snprintf(p->id, sizeof(p->id), "%s", id);
    snprintf(p->dir, sizeof(p->dir), "%s/%s", site->takes_dir, id);
    p->note = calloc(NOTES_MAX, sizeof(*p->note));
    if (!p->note)
        goto fail;
    err = ledger_read(&p->ledger, p->dir);
    if (err)
        goto fail;
    p->is_panorama = p->ledger.kind == LEDGER_PANORAMA;
    static const char *const parts[][2] = { { ".", ".panorama" }, { ".", ".processing.json" }, { "linear", "." }, { "sheet", "." }, { "geometry", "." }, { "geometry/cameras", "." } };
    for (size_t i = 0; i < sizeof(parts) / sizeof(parts[0]); i++)
        remove_parts(p, parts[i][0], parts[i][1]);
    err = read_notes(p);
    if (err)
        goto fail;
    *out = p;
    return 0;
fail:
    products_close(p);
    return err;
}

void products_close(struct products *p)
{
    if (!p)
        return;
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        free(p->job[s]);
    ledger_free(&p->ledger);
    free(p->note);
    free(p);
}

void products_facts(const struct products *p, struct products_facts *out)
{
    *out = (struct products_facts){ .is_panorama = p->is_panorama, .state = p->ledger.state, .processing = p->ledger.processing };
    for (int i = 0; i < p->n_notes; i++)
        out->noted |= 1u << p->note[i].step;
}

// ---- looking ------------------------------------------------------------------------------------------------------------------

struct look {
    struct products *p;
    enum processing_step step;
    struct processing_item *item;
    int n, room;
};

static struct job *add_item(struct look *l, const char *name, enum processing_verdict verdict)
{
    struct products *p = l->p;
    if (l->n == l->room) {
        l->room = l->room ? 2 * l->room : 4;
        l->item = realloc(l->item, (size_t)l->room * sizeof(*l->item));
        p->job[l->step] = realloc(p->job[l->step], (size_t)l->room * sizeof(**p->job));
        if (!l->item || !p->job[l->step])
            abort();
    }
    struct processing_item *i = &l->item[l->n];
    struct job *j = &p->job[l->step][l->n];
    *i = (struct processing_item){ .verdict = verdict };
    *j = (struct job){ 0 };
    snprintf(i->name, sizeof(i->name), "%s", name);
    snprintf(j->name, sizeof(j->name), "%.23s", name);
    p->n_jobs[l->step] = ++l->n;
    return j;
}

static bool is_picture(const char *file) // of a RAW+JPEG pair
{
    static const char *const extensions[] = { ".jpg", ".jpeg", ".heic", ".hif", ".mov", ".mp4" };
    const char *dot = strrchr(file, '.');
    for (size_t i = 0; dot && i < sizeof(extensions) / sizeof(extensions[0]); i++)
        if (!strcasecmp(dot, extensions[i]))
            return true;
    return false;
}

// dir/<camera><extension>, if setting names a folder; the file itself if it is one. "": none.
static void find_calibration(char *out, const char *setting, const char *camera, const char *extension)
{
    struct stat st;
    out[0] = 0;
    if (!setting[0])
        return;
    if (!stat(setting, &st) && S_ISDIR(st.st_mode))
        snprintf(out, PATH_BYTES, "%s/%s%s", setting, camera, extension);
    else
        snprintf(out, PATH_BYTES, "%s", setting);
}

static const char *const demosaics[] = { "--ahd", "--bilinear", "--half" };

static void look_at_develop(struct look *l)
{
    struct products *p = l->p;
    const struct process_config *c = &p->site->config->process;
    char path[PATH_BYTES];
    for (int i = 0; i < p->ledger.n_cameras; i++) {
        const struct ledger_camera *k = &p->ledger.camera[i];
        const struct ledger_object *raw = NULL;
        for (int o = 0; o < k->n_objects && !raw; o++)
            if ((k->object[o].state == OBJECT_COPIED || k->object[o].state == OBJECT_DELETED) && !is_picture(k->object[o].file))
                raw = &k->object[o];
        if (!raw && !(k->expected && k->debt == DEBT_PAID))
            continue; // it delivered nothing: the take says so already
        struct job *j = add_item(l, k->name, PRODUCT_OWED);
        struct processing_item *item = &l->item[l->n - 1];
        snprintf(item->slot, sizeof(item->slot), "%s", k->port);
        if (!raw) {
            item->verdict = PRODUCT_MISSING;
            say(item->text, "it delivered no raw file; set imageformat = raw in [settings]");
            continue;
        }
        const int64_t raw_bytes = raw->object.size_bytes < INT64_C(1) << 40 ? raw->object.size_bytes : INT64_C(1) << 40; // take.json may say anything
        item->memory_bytes = 16 * raw_bytes + (64 << 20); // two frames of floats and the file
        snprintf(j->raw, sizeof(j->raw), "%s", raw->file);
        snprintf(j->out, sizeof(j->out), "linear/%s.exr", k->name);
        struct key key = key_begin("develop");
        key_text(&key, raw->xxh128);
        key_text(&key, demosaics[c->demosaic]);
        find_calibration(path, c->flat, k->name, ".exr");
        key_file(&key, "flat", path);
        find_calibration(path, c->colour, k->name, ".json");
        key_file(&key, "colour", path);
        key_end(&key, j->key);
        const struct note *note = find_note(p, STEP_DEVELOP, k->name);
        if (is_there(p, note, j->key)) {
            item->verdict = PRODUCT_THERE;
            say(item->text, "%s", note->text);
        }
        in_take(p, path, raw->file);
        if (item->verdict == PRODUCT_OWED && access(path, R_OK)) {
            item->verdict = PRODUCT_MISSING;
            say(item->text, "cannot read %.63s: %s; rigctl resume fetches it again while it is on its card", raw->file, strerror(errno));
        }
    }
}

static void look_at_sheet(struct look *l, const char *folder)
{
    struct products *p = l->p;
    char path[PATH_BYTES];
    in_take(p, path, folder);
    DIR *d = opendir(path);
    bool any = false;
    for (const struct dirent *e; d && (e = readdir(d));)
        any |= e->d_name[0] != '.';
    if (d)
        closedir(d);
    if (!any)
        return; // nothing to show
    struct job *j = add_item(l, "", PRODUCT_OWED);
    snprintf(j->out, sizeof(j->out), "sheet/%s.png", folder);
    struct key key = key_begin(folder);
    key_folder(&key, path);
    key_end(&key, j->key);
    if (is_there(p, find_note(p, l->step, ""), j->key))
        l->item[0].verdict = PRODUCT_THERE;
}

static void look_at_merge(struct look *l)
{
    struct products *p = l->p;
    char path[PATH_BYTES], *text = NULL;
    size_t n = 0;
    struct job *j = add_item(l, "", PRODUCT_OWED);
    snprintf(j->out, sizeof(j->out), "panorama.exr");
    struct key key = key_begin("merge");
    in_take(p, path, "panorama/panorama.json");
    if (!file_read(&text, &n, path, 16 << 20))
        key_text(&key, text);
    free(text);
    in_take(p, path, "panorama/raw");
    key_folder(&key, path);
    key_end(&key, j->key);
    const struct note *note = find_note(p, STEP_PANORAMA, "");
    if (is_there(p, note, j->key)) {
        l->item[0].verdict = PRODUCT_THERE;
        say(l->item[0].text, "%s", note->text);
    }
}

// The newest panorama take before this one. False: none.
static bool find_panorama_take(const struct products *p, char out[96])
{
    struct dirent **entries = NULL;
    char path[PATH_BYTES + 300];
    bool found = false;
    const int n = scandir(p->site->takes_dir, &entries, NULL, alphasort);
    for (int i = n - 1; i >= 0; i--) {
        struct ledger ledger;
        const char *name = entries[i]->d_name;
        snprintf(path, sizeof(path), "%s/%s", p->site->takes_dir, name);
        if (!found && name[0] != '.' && strlen(name) < 96 && strcmp(name, p->id) < 0 && !ledger_read(&ledger, path)) {
            found = ledger.kind == LEDGER_PANORAMA && (ledger.state == TAKE_VERIFIED || ledger.state == TAKE_DEVELOPED || ledger.state == TAKE_SOLVED);
            ledger_free(&ledger);
            if (found)
                snprintf(out, 96, "%.95s", name);
        }
        free(entries[i]);
    }
    free(entries);
    return found;
}

static void look_at_panorama(struct look *l, char text[PROCESSING_TEXT])
{
    struct products *p = l->p;
    const struct note *note = find_note(p, STEP_PANORAMA, "");
    char here[PATH_BYTES], radiance[PATH_BYTES], there[PATH_BYTES + 120], from[96] = "";
    in_take(p, here, "panorama.exr");
    in_take(p, radiance, "panorama.hdr");
    if (!note && (!access(here, F_OK) || !access(radiance, F_OK))) { // somebody's own
        add_item(l, "", PRODUCT_THERE);
        return;
    }
    snprintf(from, sizeof(from), "%s", p->ledger.panorama_take);
    if (!from[0] && !find_panorama_take(p, from)) {
        say(text, "no panorama take comes before this one; shoot one (rigctl panorama) for the next takes, or put panorama.exr into this one; then rigctl process %.95s", p->id);
        return;
    }
    snprintf(there, sizeof(there), "%s/%s/panorama.exr", p->site->takes_dir, from);
    if (access(there, R_OK)) {
        add_item(l, from, PRODUCT_WAITS);
        return;
    }
    struct job *j = add_item(l, "", PRODUCT_OWED);
    snprintf(j->out, sizeof(j->out), "panorama.exr");
    memcpy(j->from, from, sizeof(j->from));
    struct key key = key_begin("panorama");
    key_text(&key, from);
    key_file(&key, "panorama.exr", there);
    key_end(&key, j->key);
    if (is_there(p, note, j->key)) {
        l->item[0].verdict = PRODUCT_THERE;
        say(l->item[0].text, "%s", note->text);
    }
}

static int look_at_reconstruct(struct look *l, char text[PROCESSING_TEXT])
{
    struct products *p = l->p;
    const struct process_config *c = &p->site->config->process;
    const struct note *note = find_note(p, STEP_RECONSTRUCT, "");
    const bool configured = c->command[0] || c->calibrated[0];
    char path[PATH_BYTES];
    struct take *take = NULL;
    const int err = take_open(&take, p->dir);
    if (err)
        return err;
    const bool has_mesh = take->mesh_path, has_cameras = take->cameras_path, complete = has_mesh && has_cameras;
    take_close(take);
    if (!complete && !configured)
        say(text, "geometry/ has no %s; name a [reconstruct] command or calibrated folder in rigd.conf, or put %s there; then rigctl process %.95s",
            has_mesh ? "cameras" : has_cameras ? "mesh" : "mesh and no cameras", has_mesh || has_cameras ? "it" : "them", p->id);
    if (text[0])
        return 0;
    struct job *j = add_item(l, "", PRODUCT_OWED);
    struct key key = key_begin("reconstruct");
    key_text(&key, c->command);
    key_text(&key, c->calibrated);
    if (c->calibrated[0]) {
        key_folder(&key, c->calibrated);
        snprintf(path, sizeof(path), "%s/cameras", c->calibrated);
        key_folder(&key, path);
    }
    if (c->command[0]) {
        in_take(p, path, "linear");
        key_folder(&key, path);
    }
    key_end(&key, j->key);
    // Without a note it is somebody's own, unless an earlier life may have died while the hook wrote.
    if (complete && (!note || !configured || (note->state == NOTE_MADE && !strcmp(note->key, j->key))))
        l->item[0].verdict = PRODUCT_THERE;
    return 0;
}

static int look_at_solve(struct look *l, char text[PROCESSING_TEXT])
{
    struct products *p = l->p;
    char linear[PATH_BYTES];
    struct take *take = NULL;
    const int err = take_open(&take, p->dir);
    if (err)
        return err;
    if (!take->mesh_path || !take->cameras_path || !take->panorama_path || !take->n_views) {
        say(text, "not started: missing are%s%s%s%s", take->mesh_path ? "" : " geometry/mesh.*", take->cameras_path ? "" : " geometry/cameras",
            take->panorama_path ? "" : " panorama.exr", take->n_views ? "" : " linear/*.exr");
        take_close(take);
        return 0;
    }
    struct job *j = add_item(l, "", PRODUCT_OWED);
    snprintf(j->out, sizeof(j->out), "solve/%s/report.json", solve_name(l->step));
    struct key key = key_begin(solve_name(l->step));
    key_text(&key, p->site->config->process.options);
    key_file(&key, "mesh", take->mesh_path);
    key_file(&key, "cameras", take->cameras_path);
    key_folder(&key, take->cameras_path);
    key_file(&key, "panorama", take->panorama_path);
    key_file(&key, "start", take->start_path);
    take_close(take);
    in_take(p, linear, "linear");
    key_folder(&key, linear);
    key_end(&key, j->key);
    const struct note *note = find_note(p, l->step, "");
    if (is_there(p, note, j->key)) {
        l->item[0].verdict = PRODUCT_THERE;
        say(l->item[0].text, "%s", note->text);
    }
    return 0;
}

int products_look(struct products *p, enum processing_step step, struct processing_item **items, int *n, char text[PROCESSING_TEXT])
{
    struct look l = { .p = p, .step = step };
    int err = 0;
    text[0] = 0;
    free(p->job[step]);
    p->job[step] = NULL;
    p->n_jobs[step] = 0;
    switch (step) {
    case STEP_DEVELOP:
        ledger_free(&p->ledger); // it may have been fetched anew meanwhile
        err = ledger_read(&p->ledger, p->dir);
        if (!err)
            look_at_develop(&l);
        break;
    case STEP_SHEET:
        look_at_sheet(&l, "thumbnails");
        break;
    case STEP_FOCUS:
        look_at_sheet(&l, "linear");
        break;
    case STEP_PANORAMA:
        if (p->is_panorama)
            look_at_merge(&l);
        else
            look_at_panorama(&l, text);
        break;
    case STEP_RECONSTRUCT:
        err = look_at_reconstruct(&l, text);
        break;
    default:
        err = look_at_solve(&l, text);
        break;
    }
    *items = l.item;
    *n = l.n;
    return err;
}

// ---- file work ----------------------------------------------------------------------------------------------------------------

static int copy_file(const char *from, const char *to)
{
    struct atomic_file f;
    char *bytes;
    size_t n;
    int err = file_read(&bytes, &n, from, COPY_BYTES_MAX);
    if (err)
        return err;
    err = atomic_file_open(&f, to);
    if (!err) {
        fwrite(bytes, 1, n, f.stream); // commit looks at ferror
        err = atomic_file_commit(&f);
    }
    free(bytes);
    return err;
}

// One file, two names, where that is possible: neither is ever written into, both are only replaced.
static int link_file(const char *from, const char *to)
{
    char *part = atomic_file_part_path(to);
    if (!part)
        return -ENOMEM;
    int err = link(from, part) ? -errno : 0;
    if (!err)
        err = atomic_file_commit_path(part, to);
    if (!err)
        unlink(part); // rename leaves both names of one file
    free(part);
    return err ? copy_file(from, to) : 0;
}

static int copy_folder(const char *from, const char *to)
{
    struct dirent **entries = NULL;
    char a[PATH_BYTES + 300], b[PATH_BYTES + 300];
    const int n = scandir(from, &entries, NULL, alphasort);
    int err = n < 0 ? -errno : make_directories(to);
    for (int i = 0; i < n; i++) {
        struct stat st;
        snprintf(a, sizeof(a), "%s/%s", from, entries[i]->d_name);
        snprintf(b, sizeof(b), "%s/%s", to, entries[i]->d_name);
        if (!err && entries[i]->d_name[0] != '.' && !stat(a, &st) && S_ISREG(st.st_mode))
            err = copy_file(a, b);
        free(entries[i]);
    }
    free(entries);
    return err;
}

// mesh.*, cameras* and what a tool exported go to geometry/, start.json beside it.
static int copy_calibrated(const struct products *p, char text[PROCESSING_TEXT])
{
    const char *from = p->site->config->process.calibrated;
    char a[PATH_BYTES], b[PATH_BYTES];
    in_take(p, b, "geometry");
    int err = copy_folder(from, b);
    snprintf(a, sizeof(a), "%s/cameras", from);
    in_take(p, b, "geometry/cameras");
    if (!err && !access(a, F_OK) && size_of(a) < 0)
        err = copy_folder(a, b);
    snprintf(a, sizeof(a), "%s/start.json", from);
    if (!err && !access(a, F_OK)) {
        in_take(p, b, "start.json");
        err = copy_file(a, b);
        in_take(p, b, "geometry/start.json"); // copied with the rest; it would be taken for a camera file
        unlink(b);
    }
    if (err)
        say(text, "cannot copy [reconstruct] calibrated = %.120s: %s", from, strerror(-err));
    return err;
}

// What is missing in geometry/, as words; "": nothing.
static int look_for_geometry(const struct products *p, const char **missing)
{
    struct take *take = NULL;
    const int err = take_open(&take, p->dir);
    *missing = "";
    if (err)
        return err;
    *missing = take->mesh_path ? (take->cameras_path ? "" : "cameras") : take->cameras_path ? "mesh.*" : "mesh.* and cameras";
    take_close(take);
    return 0;
}

// ---- making -------------------------------------------------------------------------------------------------------------------

static void add_program(const struct products *p, struct executor_command *c, const char *name)
{
    char path[PATH_BYTES];
    snprintf(path, sizeof(path), "%s/%s", p->site->programs_dir, name);
    executor_add_word(c, path);
}

static void add_file(const struct products *p, struct executor_command *c, const char *name)
{
    char path[PATH_BYTES];
    in_take(p, path, name);
    executor_add_word(c, path);
}

static void develop_command(const struct products *p, const struct job *j, struct executor_command *c)
{
    const struct process_config *config = &p->site->config->process;
    char path[PATH_BYTES];
    add_program(p, c, "rigd-develop");
    executor_add_word(c, demosaics[config->demosaic]);
    find_calibration(path, config->flat, j->name, ".exr");
    if (path[0]) {
        executor_add_word(c, "--flat");
        executor_add_word(c, path);
    }
    find_calibration(path, config->colour, j->name, ".json");
    if (path[0]) {
        executor_add_word(c, "--colour");
        executor_add_word(c, path);
    }
    add_file(p, c, j->raw);
    add_file(p, c, j->out);
}

static int begin_reconstruct(struct products *p, struct executor_command *c, char text[PROCESSING_TEXT])
{
    const struct process_config *config = &p->site->config->process;
    const char *missing;
    struct note *note = make_note(p, STEP_RECONSTRUCT, "");
    if (!note)
        return -ENOMEM;
    note->state = NOTE_BEGUN; // from here on what lies in geometry/ may be half of it
    int err = write_notes(p);
    if (!err && config->calibrated[0])
        err = copy_calibrated(p, text);
    if (!err && config->calibrated[0])
        err = look_for_geometry(p, &missing);
    if (!err && config->command[0] && (!config->calibrated[0] || missing[0])) {
        executor_add_words(c, config->command);
        executor_add_word(c, p->dir);
        snprintf(c->log_path, sizeof(c->log_path), "%.750s/log/reconstruct.log", p->dir);
        c->progress = true;
    }
    return err;
}

static int begin_solve(struct products *p, enum processing_step step, struct executor_command *c)
{
    const struct process_config *config = &p->site->config->process;
    char part[PATH_BYTES], number[20];
    snprintf(part, sizeof(part), "%s/solve", p->dir);
    const int err = make_directories(part);
    if (err)
        return err;
    snprintf(part, sizeof(part), "%s/solve/.%s.part", p->dir, solve_name(step));
    remove_tree(part, 0); // of an earlier life
    if (config->solve_program[0])
        executor_add_word(c, config->solve_program);
    else
        add_program(p, c, "rigsolve");
    executor_add_word(c, "solve");
    executor_add_word(c, p->dir);
    executor_add_word(c, "-o");
    executor_add_word(c, part);
    executor_add_word(c, "--preset");
    executor_add_word(c, solve_name(step));
    snprintf(number, sizeof(number), "%d", p->site->n_threads);
    executor_add_word(c, "--threads");
    executor_add_word(c, number);
    executor_add_words(c, config->options);
    snprintf(c->log_path, sizeof(c->log_path), "%.750s/log/%s.log", p->dir, solve_name(step));
    c->progress = true;
    return 0;
}

int products_begin(struct products *p, enum processing_step step, int item, struct executor_command *out, char text[PROCESSING_TEXT])
{
    char path[PATH_BYTES];
    int err = 0;
    text[0] = 0;
    *out = (struct executor_command){ 0 };
    if (item < 0 || item >= p->n_jobs[step])
        return -EINVAL;
    const struct job *j = &p->job[step][item];
    snprintf(out->dir, sizeof(out->dir), "%s", p->dir);
    if (step == STEP_RECONSTRUCT || is_solve(step)) {
        in_take(p, path, "log");
        err = make_directories(path);
    }
    if (err)
        goto done;
    switch (step) {
    case STEP_DEVELOP:
        develop_command(p, j, out);
        break;
    case STEP_SHEET:
    case STEP_FOCUS:
        in_take(p, path, "sheet");
        err = make_directories(path);
        add_program(p, out, "rigd-contact");
        executor_add_word(out, step == STEP_FOCUS ? "--linear" : "--thumbnails");
        executor_add_word(out, p->dir);
        executor_add_word(out, "-o");
        add_file(p, out, j->out);
        break;
    case STEP_PANORAMA:
        if (j->from[0]) {
            snprintf(path, sizeof(path), "%.700s/%s/panorama.exr", p->site->takes_dir, j->from);
            char to[PATH_BYTES];
            in_take(p, to, j->out);
            err = link_file(path, to);
            snprintf(path, sizeof(path), "%.700s/%s/panorama-report.json", p->site->takes_dir, j->from);
            in_take(p, to, "panorama-report.json");
            if (!err && !access(path, F_OK))
                err = link_file(path, to);
            break;
        }
        add_program(p, out, "rigd-panorama");
        add_file(p, out, "panorama/panorama.json");
        executor_add_word(out, "-o");
        add_file(p, out, j->out);
        executor_add_word(out, "--json");
        out->progress = true;
        break;
    case STEP_RECONSTRUCT:
        err = begin_reconstruct(p, out, text);
        break;
    default:
        err = begin_solve(p, step, out);
        break;
    }
done:
    if (err && !text[0])
        say(text, "cannot write into the take: %s", strerror(-err));
    if (err)
        executor_command_free(out);
    return err;
}

// solve/.preview.part becomes solve/preview; the one before goes.
static int name_solve(const struct products *p, enum processing_step step)
{
    char part[PATH_BYTES], final[PATH_BYTES], dir[PATH_BYTES];
    snprintf(dir, sizeof(dir), "%s/solve", p->dir);
    snprintf(part, sizeof(part), "%s/solve/.%s.part", p->dir, solve_name(step));
    snprintf(final, sizeof(final), "%s/solve/%s", p->dir, solve_name(step));
    int err = sync_folder(part);
    if (!err && renameat2(AT_FDCWD, part, AT_FDCWD, final, RENAME_NOREPLACE))
        err = -errno;
    if (err == -EEXIST) {
        err = renameat2(AT_FDCWD, part, AT_FDCWD, final, RENAME_EXCHANGE) ? -errno : 0;
        if (!err)
            remove_tree(part, 0);
    }
    return err ? err : sync_folder(dir);
}

static int keep_solve(const struct products *p, enum processing_step step, struct note *note, char text[PROCESSING_TEXT])
{
    char path[PATH_BYTES];
    struct json *report = NULL;
    const char *why = "the report does not say why";
    snprintf(path, sizeof(path), "%s/solve/.%s.part/report.json", p->dir, solve_name(step));
    int err = json_read(&report, path);
    if (!err && json_get_bool(report, "trusted", &note->trusted))
        err = -EINVAL;
    if (err) {
        json_free(report);
        say(text, "it left no report.json that can be read; see log/%s.log", solve_name(step));
        return err;
    }
    json_get_number(report, "rmse_held_out_percent", &note->rmse_held_out_percent);
    if (!note->trusted) {
        json_get_string(report, "warnings.0", &why);
        snprintf(note->text, sizeof(note->text), "not to be trusted: %.170s", why);
        say(text, "%s", note->text);
    }
    json_free(report);
    err = name_solve(p, step);
    if (err)
        say(text, "cannot name solve/%s: %s", solve_name(step), strerror(-err));
    return err;
}

// What a program says of its product: one object in one line.
static void take_saying(struct note *note, const char *said, char text[PROCESSING_TEXT])
{
    struct json *v = NULL;
    const char *warning = "";
    if (json_parse(&v, said, strlen(said), NULL))
        return;
    json_get_number(v, "clipped_share", &note->clipped_share);
    if (!json_get_string(v, "warnings.0", &warning)) {
        snprintf(note->text, sizeof(note->text), "%.190s", warning);
        say(text, "%s", note->text);
    }
    json_free(v);
}

// What is doubtful about a panorama, from the report beside it: a clipped light, a missing stop.
static void take_findings(const struct products *p, struct note *note, char text[PROCESSING_TEXT])
{
    char path[PATH_BYTES], key[40];
    struct json *report = NULL;
    in_take(p, path, "panorama-report.json");
    if (access(path, F_OK) || json_read(&report, path))
        return;
    for (int i = 0; i < json_length(report, "findings") && !note->text[0]; i++) {
        bool doubtful = false;
        const char *stop = "", *what = "";
        snprintf(key, sizeof(key), "findings.%d", i);
        const struct json *f = json_get(report, key);
        json_get_bool(f, "doubtful", &doubtful);
        json_get_string(f, "stop", &stop);
        if (!doubtful || json_get_string(f, "text", &what))
            continue;
        snprintf(note->text, sizeof(note->text), "not to be trusted: %.24s%s%.140s", stop, stop[0] ? ": " : "", what);
        say(text, "%s", note->text);
    }
    json_free(report);
}

int products_keep(struct products *p, enum processing_step step, int item, const char *said, double seconds, char text[PROCESSING_TEXT])
{
    char path[PATH_BYTES];
    const char *missing = "";
    text[0] = 0;
    if (item < 0 || item >= p->n_jobs[step])
        return -EINVAL;
    const struct job *j = &p->job[step][item];
    struct note made = { .step = step, .state = NOTE_MADE, .seconds = seconds, .rmse_held_out_percent = NAN };
    if (step == STEP_DEVELOP)
        memcpy(made.item, j->name, sizeof(made.item));
    memcpy(made.key, j->key, sizeof(made.key));
    memcpy(made.from, j->from, sizeof(made.from));
    snprintf(made.file, sizeof(made.file), "%.63s", j->out);
    int err = 0;
    if (is_solve(step)) {
        err = keep_solve(p, step, &made, text);
    } else if (step == STEP_RECONSTRUCT) {
        err = look_for_geometry(p, &missing);
        if (!err && missing[0]) {
            say(text, "the hook ended well, but left no %s in geometry/; see log/reconstruct.log", missing);
            err = -ENOENT;
        }
        if (!err) { // something of known size: the mesh
            struct take *take = NULL;
            err = take_open(&take, p->dir);
            if (!err && take->mesh_path)
                snprintf(made.file, sizeof(made.file), "geometry/%.50s", strrchr(take->mesh_path, '/') + 1);
            take_close(take);
        }
    } else if (step == STEP_PANORAMA) {
        take_findings(p, &made, text);
    } else {
        take_saying(&made, said, text);
    }
    in_take(p, path, made.file);
    made.size_bytes = size_of(path);
    if (!err && made.size_bytes <= 0) {
        say(text, "its program ended well, but left no %.63s", made.file);
        err = -ENOENT;
    }
    if (err)
        return err;
    struct note *note = make_note(p, step, made.item);
    if (!note)
        return -ENOMEM;
    *note = made;
    err = write_notes(p);
    if (err)
        say(text, "cannot write processing.json: %s", strerror(-err));
    return err;
}

void products_complaint(const struct products *p, enum processing_step step, const char *heard, int code, char text[PROCESSING_TEXT])
{
    char path[PATH_BYTES], tail[LOG_TAIL + 1], *line = NULL, *save = NULL;
    const char *log = step == STEP_RECONSTRUCT ? "reconstruct" : is_solve(step) ? solve_name(step) : NULL;
    if (!log) {
        const char *cause = strstr(heard, "error: ");
        if (heard[0])
            say(text, "%.200s", cause ? cause + 7 : heard);
        else
            say(text, "its program failed without a word (exit %d)", code);
        return;
    }
    snprintf(path, sizeof(path), "%s/log/%s.log", p->dir, log);
    FILE *f = fopen(path, "re");
    if (f && !fseek(f, 0, SEEK_END) && ftell(f) > LOG_TAIL)
        fseek(f, -LOG_TAIL, SEEK_END);
    else if (f)
        rewind(f);
    const size_t n = f ? fread(tail, 1, LOG_TAIL, f) : 0;
    tail[n] = 0;
    if (f)
        fclose(f);
    for (char *l = strtok_r(tail, "\r\n", &save); l; l = strtok_r(NULL, "\r\n", &save))
        if (!line || strstr(l, "error") || !strstr(line, "error"))
            line = l;
    say(text, "exit %d: %.140s (log/%s.log)", code, line ? line : "without a word", log);
}

int products_forget(struct products *p, unsigned steps)
{
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        if (steps >> s & 1) {
            drop_notes(p, s);
            struct note *n = make_note(p, s, "");
            if (n)
                n->state = NOTE_OWED;
        }
    return write_notes(p);
}

// ---- take.json ----------------------------------------------------------------------------------------------------------------

static void record_products(struct ledger *l, const struct products *p)
{
    for (int i = 0; i < l->n_cameras; i++) {
        struct ledger_camera *c = &l->camera[i];
        const struct note *n = find_note(p, STEP_DEVELOP, c->name);
        c->developed[0] = 0;
        if (!n || n->state != NOTE_MADE)
            continue;
        memcpy(c->developed, n->file, sizeof(c->developed));
        c->clipped_share = n->clipped_share;
        c->developed_s = n->seconds;
    }
    const struct note *panorama = find_note(p, STEP_PANORAMA, "");
    snprintf(l->panorama_from, sizeof(l->panorama_from), "%s", panorama ? panorama->from : "");
    l->n_solves = 0;
    for (int s = 0; s < PROCESSING_N_STEPS; s++) {
        const struct note *n = is_solve(s) ? find_note(p, s, "") : NULL;
        if (!n || n->state != NOTE_MADE)
            continue;
        struct ledger_solve *solve = &l->solve[l->n_solves++];
        *solve = (struct ledger_solve){ .trusted = n->trusted, .rmse_held_out_percent = n->rmse_held_out_percent, .seconds = n->seconds };
        snprintf(solve->name, sizeof(solve->name), "%s", solve_name(s));
        snprintf(solve->why, sizeof(solve->why), "%s", n->text);
    }
}

int products_record(const char *take_dir, const struct processing_record *record)
{
    struct products p = { .note = calloc(NOTES_MAX, sizeof(struct note)) };
    char *text = NULL;
    if (!p.note)
        return -ENOMEM;
    snprintf(p.dir, sizeof(p.dir), "%s", take_dir);
    int err = ledger_read(&p.ledger, take_dir);
    if (!err)
        err = read_notes(&p);
    if (err)
        goto done;
    struct ledger *l = &p.ledger;
    if (l->state == TAKE_VERIFIED || l->state == TAKE_DEVELOPED || l->state == TAKE_SOLVED)
        l->state = record->state; // a take that failed stays failed, whatever was made of its frames
    l->processing = record->processing;
    l->n_notes = record->n_notes;
    memcpy(l->process_note, record->note, sizeof(l->process_note));
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        if (record->began_ns[s] != INT64_MIN)
            ledger_note_stage(l, processing_step_name(s), record->utc_offset_ms + record->began_ns[s] / 1000000, record->utc_offset_ms + record->ended_ns[s] / 1000000);
    record_products(l, &p);
    text = ledger_text(l);
    err = text ? ledger_commit(text, take_dir) : -ENOMEM;
done:
    free(text);
    ledger_free(&p.ledger);
    free(p.note);
    return err;
}
