// rigd/contact_main.c - build/bin/rigd-contact: one picture of all cameras of a take, with what to look at. A process of its own: it decodes
// JPEGs that cameras wrote. Beside OUT.png: OUT.json with each camera's figures; on standard output one line of JSON with the warnings.
#include "rigd/contact.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <argp.h>
#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

enum { CAMERAS_MAX = 512 };

struct arguments {
    const char *take, *out, *pictures;
    bool linear;
};

static const struct argp_option options[] = {
    { "thumbnails", 't', NULL, 0, "of TAKE/thumbnails/*.jpg (default)", 0 },
    { "linear", 'l', NULL, 0, "of TAKE/linear/*.exr", 0 },
    { "pictures", 'p', "DIR", 0, "also each camera in full size as DIR/<camera>.png, 8 bit sRGB, all exposed alike: for tools that read no EXR", 0 },
    { "output", 'o', "OUT.png", 0, "the sheet (required)", 0 },
    { 0 },
};

static error_t parse(int key, char *arg, struct argp_state *state)
{
    struct arguments *a = state->input;
    const size_t n = arg ? strlen(arg) : 0;
    switch (key) {
    case 't':
        a->linear = false;
        return 0;
    case 'l':
        a->linear = true;
        return 0;
    case 'o':
        if (n < 5 || strcmp(arg + n - 4, ".png"))
            argp_error(state, "-o %s: expected a name that ends in .png", arg);
        a->out = arg;
        return 0;
    case 'p':
        a->pictures = arg;
        return 0;
    case ARGP_KEY_ARG:
        if (a->take)
            argp_error(state, "a second take '%s': expected one", arg);
        a->take = arg;
        return 0;
    case ARGP_KEY_END:
        if (!a->take || !a->out)
            argp_error(state, "expected TAKE -o OUT.png");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static int only_pictures(const struct dirent *e)
{
    static const char *const extensions[] = { ".jpg", ".jpeg", ".exr", ".png", ".tif", ".tiff" };
    const char *dot = strrchr(e->d_name, '.');
    for (size_t i = 0; e->d_name[0] != '.' && dot && i < sizeof(extensions) / sizeof(extensions[0]); i++)
        if (!strcasecmp(dot, extensions[i]))
            return 1;
    return 0;
}

static int look_at(struct contact_entry *e, const char *dir, const char *file, bool linear)
{
    struct image image;
    char *path;
    if (asprintf(&path, "%s/%s", dir, file) < 0)
        return -ENOMEM;
    snprintf(e->name, sizeof(e->name), "%.*s", (int)(strrchr(file, '.') - file), file);
    int err = linear ? image_read(&image, path) : image_read_texture(&image, path, true);
    if (!err) {
        err = contact_measure(&e->figures, &image, !linear);
        if (!err)
            err = contact_cell(e, &image);
        image_free(&image);
    }
    free(path);
    return err;
}

// So that the median camera's lights are just below white.
static double exposure_of(const struct contact_entry *e, int n, bool linear)
{
    double sum = 0;
    int n_lit = 0;
    for (int i = 0; i < n && linear; i++)
        if (e[i].figures.p99 > 0)
            sum += log2(e[i].figures.p99), n_lit++;
    return n_lit ? log2(.8) - sum / n_lit : 0;
}

static int write_picture(const char *dir, const char *file, bool linear, double exposure_ev, const char *to)
{
    struct image image;
    char *path = NULL, *png = NULL;
    int err = asprintf(&path, "%s/%s", dir, file) < 0 || asprintf(&png, "%s/%.*s.png", to, (int)(strrchr(file, '.') - file), file) < 0 ? -ENOMEM : 0;
    if (!err)
        err = linear ? image_read(&image, path) : image_read_texture(&image, path, true);
    if (!err) {
        err = image_write_png_srgb(&image, png, exposure_ev);
        image_free(&image);
    }
    free(path);
    free(png);
    return err;
}

static int write_figures(const struct contact_entry *e, int n, const char *png)
{
    struct json *doc = json_new_object(), *list = json_new_array();
    char *path = NULL;
    for (int i = 0; i < n; i++) {
        struct json *o = json_new_object(), *doubts = json_new_array();
        json_set_string(o, "camera", e[i].name);
        json_set_number(o, "sharpness", e[i].figures.sharpness);
        json_set_number(o, "relative_sharpness", e[i].relative_sharpness);
        json_set_number(o, "clipped_share", e[i].figures.clipped_share);
        json_set_number(o, "middle_clipped_share", e[i].figures.middle_clipped_share);
        json_set_number(o, "headroom_ev", e[i].figures.headroom_ev);
        json_set_number(o, "median", e[i].figures.median);
        json_set_number(o, "relative_ev", e[i].relative_ev);
        if (e[i].doubts & CONTACT_SOFT)
            json_append_string(doubts, "soft");
        if (e[i].doubts & CONTACT_CLIPPED)
            json_append_string(doubts, "clipped");
        if (e[i].doubts & CONTACT_DARK)
            json_append_string(doubts, "dark");
        json_set(o, "doubts", doubts);
        json_append(list, o);
    }
    json_set_number(doc, "headroom_ev", contact_headroom(e, n));
    json_set(doc, "cameras", list);
    const int err = asprintf(&path, "%.*s.json", (int)strlen(png) - 4, png) < 0 ? -ENOMEM : json_write(doc, path);
    free(path);
    json_free(doc);
    return err;
}

int main(int argc, char **argv)
{
    static const struct argp argp = { options, parse, "TAKE -o OUT.png",
        "One picture of all cameras of a take: which are out of focus, clipped or dark beside the others.\v"
        "OUT.json has the figures. Its headroom_ev, of thumbnails, is how many stops longer four of five cameras could expose before more "
        "than glints (2 % of the middle third) clips: 0, expose less. Exit status: 0 done, 1 failed, 2 usage.", NULL, NULL, NULL };
    static struct contact_entry entry[CAMERAS_MAX];
    struct arguments a = { 0 };
    struct dirent **files = NULL;
    char *dir = NULL, sentence[600];
    argp_err_exit_status = 2;
    argp_program_version = "rigd-contact (studiorig) " STUDIORIG_VERSION;
    log_set_program("rigd-contact");
    argp_parse(&argp, argc, argv, 0, NULL, &a);
    if (asprintf(&dir, "%s/%s", a.take, a.linear ? "linear" : "thumbnails") < 0)
        return 1;
    const int n_files = scandir(dir, &files, only_pictures, alphasort);
    int n = 0, err = n_files < 0 ? -errno : n_files ? 0 : -ENOENT;
    if (err)
        log_error("contact: %s: %s; there is nothing to show", dir, strerror(-err));
    struct json *said = json_new_object(), *warnings = json_new_array();
    for (int i = 0; i < n_files; i++) {
        if (n < CAMERAS_MAX && !look_at(&entry[n], dir, files[i]->d_name, a.linear)) {
            n++;
        } else if (n < CAMERAS_MAX) { // said where it failed; the others are shown
            char text[400];
            snprintf(text, sizeof(text), "%s cannot be shown", files[i]->d_name);
            json_append_string(warnings, text);
        }
    }
    if (!err && !n)
        err = -EINVAL;
    if (!err) {
        contact_judge(entry, n, a.linear);
        contact_sentence(entry, n, sentence, sizeof(sentence));
        if (sentence[0])
            json_append_string(warnings, sentence);
        err = write_figures(entry, n, a.out);
    }
    if (!err)
        err = contact_write(entry, n, exposure_of(entry, n, a.linear), a.out);
    if (!err && a.pictures)
        err = make_directories(a.pictures);
    for (int i = 0; i < n_files && !err && a.pictures; i++)
        err = write_picture(dir, files[i]->d_name, a.linear, exposure_of(entry, n, a.linear), a.pictures);
    json_set_int(said, "n", n);
    json_set(said, "warnings", warnings);
    char *text = err ? NULL : json_text(said);
    if (text)
        puts(text);
    free(text);
    json_free(said);
    for (int i = 0; i < n; i++)
        free(entry[i].cell);
    for (int i = 0; i < n_files; i++)
        free(files[i]);
    free(files);
    free(dir);
    return err ? 1 : 0;
}
