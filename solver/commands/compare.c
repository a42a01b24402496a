// solver/commands/compare.c - rigsolve compare: how far two pictures, or two folders of pictures,
// are apart.
#include "solver/commands/commands.h"
#include "solver/commands/output.h"
#include "solver/compare.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <argp.h>
#include <dirent.h>
#include <errno.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

struct arguments {
    const char *a, *b, *mask;
    bool json;
};

enum { OPTION_MASK = 256, OPTION_JSON };

static const struct argp_option options[] = {
    {"mask", OPTION_MASK, "M", 0,
     "Compare only pixels whose first channel in this picture is above .5; for folders: one "
     "picture "
     "for all, or a folder of them",
     0},
    {"json", OPTION_JSON, NULL, 0, "Print the result as JSON", 0},
    {0},
};

static error_t parse(int key, char *text, struct argp_state *state)
{
    struct arguments *a = state->input;
    switch (key) {
    case OPTION_MASK:
        a->mask = text;
        return 0;
    case OPTION_JSON:
        a->json = true;
        return 0;
    case ARGP_KEY_ARG:
        if (state->arg_num > 1)
            argp_error(state, "two pictures or two folders, no more: '%s'", text);
        if (state->arg_num == 0)
            a->a = text;
        else
            a->b = text;
        return 0;
    case ARGP_KEY_END:
        if (!a->b)
            argp_error(state, "which two pictures, or folders of pictures?");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static const struct argp argp = {
    options,
    parse,
    "A B",
    "Compare two linear pictures of one size, or all pictures of equal name in two folders.\v"
    "RMSE is sqrt(mean over pixels of |a - b|^2 / 3) of linear R, G, B, both clipped to [0, 1] as "
    "a "
    "camera clips, in percent; PSNR belongs to it. RMSE unclipped and the largest difference are "
    "not "
    "clipped. \"Clipped\" is the share of pixels with a channel above 1. In folders, pictures are "
    ".exr, .hdr, .tif and .tiff (PNG files there are views for people, not linear); masks may be "
    "PNG. "
    "Names without a counterpart are listed and do not count.",
    NULL,
    NULL,
    NULL,
};

// ---- pictures of a folder -----------------------------------------------------------------------

struct picture {
    char *stem, *path;
};

struct folder {
    const char *name;
    int n;
    struct picture *picture; // [n] by stem, bytewise
};

static bool is_folder(const char *path)
{
    struct stat s;
    return stat(path, &s) == 0 && S_ISDIR(s.st_mode);
}

static bool is_picture(const char *extension, bool masks)
{
    static const char *const known[] = {".exr", ".hdr", ".tif", ".tiff", ".png"};
    for (int i = 0; i < (masks ? 5 : 4); i++)
        if (!strcasecmp(extension, known[i]))
            return true;
    return false;
}

static void folder_free(struct folder *f)
{
    for (int i = 0; i < f->n; i++) {
        free(f->picture[i].stem);
        free(f->picture[i].path);
    }
    free(f->picture);
    memset(f, 0, sizeof(*f));
}

static int by_stem(const void *a, const void *b)
{
    return strcmp(((const struct picture *)a)->stem, ((const struct picture *)b)->stem);
}

static int folder_add(struct folder *f, const char *file, const char *extension)
{
    struct picture *more = realloc(f->picture, ((size_t)f->n + 1) * sizeof(*more));
    if (!more)
        return -ENOMEM;
    f->picture = more;
    struct picture *p = &f->picture[f->n];
    p->stem = strndup(file, (size_t)(extension - file));
    if (asprintf(&p->path, "%s/%s", f->name, file) < 0)
        p->path = NULL;
    f->n++;
    return p->stem && p->path ? 0 : -ENOMEM;
}

static int folder_read(struct folder *f, const char *name, bool masks)
{
    int err = 0;
    *f = (struct folder){.name = name};
    DIR *dir = opendir(name);
    if (!dir) {
        err = -errno;
        log_error("compare: cannot open the folder %s: %s", name, strerror(-err));
        return err;
    }
    for (const struct dirent *e; !err && (e = readdir(dir));) {
        const char *extension = strrchr(e->d_name, '.');
        if (extension && extension != e->d_name && is_picture(extension, masks))
            err = folder_add(f, e->d_name, extension);
    }
    closedir(dir);
    if (err) {
        folder_free(f);
        return err;
    }
    if (f->n)
        qsort(f->picture, (size_t)f->n, sizeof(*f->picture), by_stem);
    for (int i = 1; i < f->n; i++) {
        if (strcmp(f->picture[i - 1].stem, f->picture[i].stem))
            continue;
        log_error("compare: %s and %s are one name: which is meant? Move one away",
                  f->picture[i - 1].path, f->picture[i].path);
        folder_free(f);
        return -EINVAL;
    }
    return 0;
}

static const char *folder_find(const struct folder *f, const char *stem)
{
    const struct picture key = {.stem = (char *)(uintptr_t)stem};
    const struct picture *found =
        f->n ? bsearch(&key, f->picture, (size_t)f->n, sizeof(key), by_stem) : NULL;
    return found ? found->path : NULL;
}

// ---- comparing ----------------------------------------------------------------------------------

static int compare_files(struct comparison *out, const char *a, const char *b, const char *mask)
{
    struct image image_a = {0}, image_b = {0}, image_mask = {0};
    int err = image_read(&image_a, a);
    if (!err)
        err = image_read(&image_b, b);
    if (!err && mask)
        err = image_read(&image_mask, mask);
    if (!err) {
        err = compare_images(out, &image_a, &image_b, mask ? &image_mask : NULL);
        if (err)
            log_error("compare: %s against %s%s%s: not compared", a, b, mask ? ", mask " : "",
                      mask ? mask : "");
    }
    image_free(&image_a);
    image_free(&image_b);
    image_free(&image_mask);
    return err;
}

static void json_set_comparison(struct json *v, const struct comparison *c)
{
    json_set_int(v, "n_pixels", c->n_pixels);
    json_set_number(v, "rmse_percent", c->rmse_percent);
    json_set_number(v, "rmse_unclipped", c->rmse_unclipped);
    json_set_number(v, "psnr_db", c->psnr_db); // null: infinite
    json_set_number(v, "max_abs", c->max_abs);
    json_set_number(v, "clipped_percent", c->clipped_percent);
}

static void print_comparison(const char *name, const struct comparison *c)
{
    printf("%-24s  RMSE %9.5f %%  PSNR %6.2f dB  RMSE unclipped %9.3g  max %9.3g  clipped %6.2f %% "
           " %" PRId64 " pixels\n",
           name, c->rmse_percent, c->psnr_db, c->rmse_unclipped, c->max_abs, c->clipped_percent,
           c->n_pixels);
}

// What of `one` the other has not.
static int report_missing(const struct folder *one, const struct folder *other, struct json *list)
{
    int n = 0;
    for (int i = 0; i < one->n; i++) {
        if (folder_find(other, one->picture[i].stem))
            continue;
        log_warning("compare: %s has no counterpart in %s", one->picture[i].path, other->name);
        json_append_string(list, one->picture[i].path);
        n++;
    }
    return n;
}

static int compare_folders(const struct arguments *args, struct json *doc)
{
    struct folder a = {0}, b = {0}, masks = {0};
    struct comparison total = {0};
    struct json *files = json_array(), *missing = json_array();
    const bool many_masks = args->mask && is_folder(args->mask);
    int n = 0;
    int err = folder_read(&a, args->a, false);
    if (!err)
        err = folder_read(&b, args->b, false);
    if (!err && many_masks)
        err = folder_read(&masks, args->mask, true);
    int n_missing = err ? 0 : report_missing(&a, &b, missing) + report_missing(&b, &a, missing);
    for (int i = 0; i < a.n && !err; i++) {
        const char *stem = a.picture[i].stem, *path_b = folder_find(&b, stem), *mask = args->mask;
        struct comparison one;
        if (!path_b)
            continue;
        if (many_masks) {
            mask = folder_find(&masks, stem);
            if (!mask) {
                log_warning("compare: %s has no mask in %s: not compared", a.picture[i].path,
                            args->mask);
                json_append_string(missing, a.picture[i].path);
                n_missing++;
                continue;
            }
        }
        err = compare_files(&one, a.picture[i].path, path_b, mask);
        if (err)
            break;
        compare_add(&total, &one);
        n++;
        struct json *entry = json_object();
        json_set_string(entry, "name", stem);
        json_set_comparison(entry, &one);
        json_append(files, entry);
        if (!args->json)
            print_comparison(stem, &one);
    }
    if (!err && !n) {
        log_error("compare: %s and %s have no picture of one name (.exr, .hdr, .tif, .tiff)",
                  args->a, args->b);
        err = -ENOENT;
    }
    if (!err && !args->json) {
        char name[64];
        snprintf(name, sizeof(name), "all %d%s", n, n_missing ? " (some missing)" : "");
        print_comparison(name, &total);
    }
    json_set_int(doc, "n_pictures", n);
    json_set_comparison(doc, &total);
    json_set(doc, "pictures", files);
    json_set(doc, "missing", missing);
    folder_free(&a);
    folder_free(&b);
    folder_free(&masks);
    return err;
}

int command_compare(int argc, char **argv)
{
    struct arguments args = {0};
    argp_parse(&argp, argc, argv, 0, NULL, &args);

    struct json *doc = json_object();
    int err;
    json_set_string(doc, "a", args.a);
    json_set_string(doc, "b", args.b);
    if (is_folder(args.a) != is_folder(args.b)) {
        log_error("compare: %s is a folder and %s is not: give two pictures or two folders",
                  is_folder(args.a) ? args.a : args.b, is_folder(args.a) ? args.b : args.a);
        err = -EINVAL;
    } else if (is_folder(args.a)) {
        err = compare_folders(&args, doc);
    } else {
        struct comparison c;
        err = compare_files(&c, args.a, args.b, args.mask);
        if (!err)
            json_set_comparison(doc, &c);
        if (!err && !args.json)
            print_comparison("picture", &c);
    }
    if (err || !args.json)
        json_free(doc);
    if (!err)
        err = args.json ? output_json("compare", doc) : output_flush("compare");
    return err ? EXIT_FAILED : EXIT_DONE;
}
