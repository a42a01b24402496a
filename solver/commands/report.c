// solver/commands/report.c - rigsolve report: a solve's folder as one page for people.
#include "solver/commands/report.h"
#include "solver/report.h"
#include "solver/commands/arguments.h"
#include "solver/commands/commands.h"
#include "solver/commands/solved.h"
#include "solver/rays.h"
#include "solver/render.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "solver/take/take.h"

#include <argp.h>
#include <errno.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { KEY_TAKE = 256, KEY_MESH, KEY_CAMERAS, KEY_IMAGES, KEY_VIEWS, KEY_THREADS };
enum { DEFAULT_VIEWS = 4, MAX_VIEWS = 64, SHADOW_RAYS = 2 };

static const struct argp_option options[] = {
    { "output", 'o', "FILE", 0, "The page (SOLVE_DIR/report.html)", 0 },
    { "take", KEY_TAKE, "TAKE", 0, "Where the photographs are; default: what report.json names", 0 },
    { "cameras", KEY_CAMERAS, "PATH", 0, "Instead of the take's", 0 },
    { "images", KEY_IMAGES, "DIR", 0, "Instead of the take's", 0 },
    { "mesh", KEY_MESH, "FILE", 0, "Instead of the mesh that report.json names", 0 },
    { "views", KEY_VIEWS, "N", 0, "How many views are shown (4)", 0 },
    { "threads", KEY_THREADS, "N", 0, "Default: all cores. The result does not depend on it", 0 },
    { 0 },
};

static error_t parse(int key, char *text, struct argp_state *state)
{
    struct report_inputs *in = state->input;
    switch (key) {
    case 'o':
        in->output = text;
        return 0;
    case KEY_TAKE:
        in->take_dir = text;
        return 0;
    case KEY_CAMERAS:
        in->cameras = text;
        return 0;
    case KEY_IMAGES:
        in->images = text;
        return 0;
    case KEY_MESH:
        in->mesh = text;
        return 0;
    case KEY_VIEWS:
        in->n_views = (int)argument_integer(state, "--views", text, 0, MAX_VIEWS);
        return 0;
    case KEY_THREADS:
        in->n_threads = (int)argument_integer(state, "--threads", text, 1, 256);
        return 0;
    case ARGP_KEY_ARG:
        if (in->solve_dir)
            argp_error(state, "one SOLVE_DIR at a time: '%s' is too many", text);
        in->solve_dir = text;
        return 0;
    case ARGP_KEY_END:
        if (!in->solve_dir)
            argp_error(state, "which SOLVE_DIR?");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static const struct argp argp = {
    options,
    parse,
    "SOLVE_DIR [--take TAKE]",
    "Write report.html: what a solve found and how far to believe it.\v"
    "One self-contained page: photographs beside re-renders and their difference, the maps, the lights drawn from above and from the side, "
    "materials by region, warnings, timing. It needs no network and no script to be read.",
    0,
    0,
    0,
};

// ---- what the page shows --------------------------------------------------------------------------------------------------

struct page {
    struct solved solved;
    struct image std, validity;
    struct json *exported;
    struct take *take;       // NULL: none
    char *images;            // NULL: the take's
    struct cameras cameras;  // n = 0: none
    struct report_view view[MAX_VIEWS];
    int n_views;
};

static void page_free(struct page *p)
{
    for (int i = 0; i < p->n_views; i++)
        image_free(&p->view[i].input), image_free(&p->view[i].render);
    cameras_free(&p->cameras);
    free(p->images);
    take_close(p->take);
    json_free(p->exported);
    image_free(&p->std), image_free(&p->validity);
    solved_free(&p->solved);
}

static int read_if_there(struct image *out, const char *dir, const char *name)
{
    char *path = solved_path(dir, name);
    const int err = !path ? -ENOMEM : access(path, F_OK) ? 0 : image_read(out, path);
    free(path);
    return err;
}

// What the command line, else report.json's inputs, names; NULL where neither does.
static int find_named(char **out, const struct page *p, const char *given, const char *solve_dir, const char *key)
{
    const char *name = NULL;
    *out = NULL;
    if (given)
        *out = strdup(given);
    else if (p->solved.report && !json_get_string(p->solved.report, key, &name))
        *out = solved_path(solve_dir, name);
    return (given || name) && !*out ? -ENOMEM : 0;
}

static int find_photographs(struct page *p, const struct report_inputs *in)
{
    char *take = NULL, *cameras = NULL;
    int err = find_named(&take, p, in->take_dir, in->solve_dir, "inputs.take");
    if (!err)
        err = find_named(&cameras, p, in->cameras, in->solve_dir, "inputs.cameras");
    if (!err)
        err = find_named(&p->images, p, in->images, in->solve_dir, "inputs.images");
    if (!err && take && (in->take_dir || !access(take, F_OK)))
        err = take_open(&p->take, take);
    if (!err && in->take_dir && !in->cameras) { // a take that was named beats what the report remembers
        free(cameras);
        cameras = p->take->cameras_path ? strdup(p->take->cameras_path) : NULL;
    }
    if (!err && in->take_dir && !in->images) {
        free(p->images);
        p->images = NULL;
    }
    const char *path = cameras ? cameras : p->take ? p->take->cameras_path : NULL;
    if (!err && path && (in->cameras || in->take_dir || !access(path, F_OK)))
        err = cameras_read(&p->cameras, path);
    free(take);
    free(cameras);
    return err;
}

// *out NULL: it has none.
static int find_photograph(char **out, const struct page *p, const char *view)
{
    static const char *const extensions[] = { "exr", "tif", "tiff", "hdr" };
    *out = NULL;
    for (int i = 0; p->images && i < 4; i++) {
        char *path;
        if (asprintf(&path, "%s/%s.%s", p->images, view, extensions[i]) < 0)
            return -ENOMEM;
        if (!access(path, F_OK)) {
            *out = path;
            return 0;
        }
        free(path);
    }
    for (int i = 0; !p->images && p->take && i < p->take->n_views; i++)
        if (!strcmp(p->take->view_names[i], view)) {
            *out = strdup(p->take->view_paths[i]);
            return *out ? 0 : -ENOMEM;
        }
    return 0;
}

static int show_view(struct page *p, const struct renderer *renderer, const struct camera *camera, const char *photograph)
{
    struct report_view *v = &p->view[p->n_views];
    struct camera small;
    struct image whole;
    int err = image_read(&whole, photograph);
    if (err)
        return err;
    v->name = camera->name;
    err = report_photograph(&v->input, &small, &whole, camera);
    if (err == -EINVAL)
        log_warning("report: %s has %d x %d pixels and %d channels, its camera %d x %d: R, G and B in the same aspect are needed; it is not shown", photograph,
                    whole.width, whole.height, whole.n_channels, camera->width_px, camera->height_px);
    image_free(&whole);
    if (err == -EINVAL)
        return 0;
    if (!err)
        err = render_view(renderer, &small, &v->render);
    if (err)
        image_free(&v->input);
    else
        p->n_views++;
    return err;
}

// n of the n_with cameras, spread over their order; the last is one that was set aside, if there is any and it is not among them.
static void choose_views(const struct page *p, const int *with, int n_with, int *out, int n)
{
    bool has_aside = false;
    for (int i = 0; i < n; i++) {
        out[i] = with[(int)((int64_t)(2 * i + 1) * n_with / (2 * n))];
        has_aside = has_aside || report_set_aside(p->solved.report, p->cameras.view[out[i]].name);
    }
    for (int i = n_with - 1; n && i >= 0 && !has_aside; i--)
        if (report_set_aside(p->solved.report, p->cameras.view[with[i]].name))
            out[n - 1] = with[i], has_aside = true;
}

static int show_views(struct page *p, const struct report_inputs *in)
{
    bool nearest;
    if (!p->solved.report || json_get_bool(p->solved.report, "render.nearest", &nearest))
        nearest = false;
    const struct render_material material = {
        .nearest = nearest,
        .model = p->solved.parameters.data ? REFLECT_DISNEY : REFLECT_LAMBERT,
        .variant = p->solved.variant,
        .albedo = &p->solved.albedo,
        .parameters = p->solved.parameters.data ? &p->solved.parameters : NULL,
    };
    const struct render_settings settings = { .samples = in->quick ? 1 : 2, .shadows = true, .shadow_rays = in->quick ? 1 : SHADOW_RAYS, .n_threads = in->n_threads };
    struct renderer *renderer = NULL;
    struct rays *rays = NULL;
    int n_with = 0, err = 0;
    char **photograph = calloc((size_t)p->cameras.n + 1, sizeof(*photograph));
    if (!photograph)
        return -ENOMEM;
    int *with = calloc((size_t)p->cameras.n + 1, sizeof(*with));
    if (!with)
        err = -ENOMEM;
    for (int i = 0; !err && i < p->cameras.n; i++) {
        err = find_photograph(&photograph[i], p, p->cameras.view[i].name);
        if (photograph[i])
            with[n_with++] = i;
    }
    if (!err && !n_with)
        log_info("report: no photographs are named: the page shows none; give --take TAKE");
    const int n = in->n_views < n_with ? in->n_views : n_with;
    if (!err && n)
        err = rays_new(&rays, &p->solved.mesh);
    if (!err && n)
        err = renderer_new(&renderer, &p->solved.mesh, rays, &p->solved.lights, &material, &settings);
    progress_begin("report", n);
    int chosen[MAX_VIEWS];
    choose_views(p, with, err ? 0 : n_with, chosen, err ? 0 : n);
    for (int i = 0; !err && i < n; i++, progress_add(1))
        err = show_view(p, renderer, &p->cameras.view[chosen[i]], photograph[chosen[i]]);
    progress_end();
    renderer_free(renderer);
    rays_free(rays);
    for (int i = 0; i < p->cameras.n; i++)
        free(photograph[i]);
    free(photograph);
    free(with);
    return err;
}

// The take and what was asked for; of pictures without a take, the folder.
static char *title_of(const struct page *p, const struct report_inputs *in)
{
    char *title = NULL, *real = realpath(in->solve_dir, NULL);
    const char *take, *preset, *folder = real ? strrchr(real, '/') + 1 : in->solve_dir;
    if (json_get_string(p->solved.report, "inputs.take", &take) || !strrchr(take, '/') || !strrchr(take, '/')[1] || json_get_string(p->solved.report, "preset", &preset))
        title = strdup(*folder ? folder : in->solve_dir);
    else if (asprintf(&title, "%s, %s", strrchr(take, '/') + 1, preset) < 0)
        title = NULL;
    free(real);
    return title;
}

static int write_page(const struct page *p, const struct report_inputs *in)
{
    char *path = in->output ? strdup(in->output) : solved_path(in->solve_dir, "report.html"), *title = title_of(p, in);
    const struct report_source source = {
        .title = title,
        .report = p->solved.report,
        .exported = p->exported,
        .mesh = &p->solved.mesh,
        .albedo = &p->solved.albedo,
        .parameters = p->solved.parameters.data ? &p->solved.parameters : NULL,
        .std = p->std.data ? &p->std : NULL,
        .validity = p->validity.data ? &p->validity : NULL,
        .lights = p->solved.lights.n ? &p->solved.lights : NULL,
        .cameras = p->cameras.n ? &p->cameras : NULL,
        .view = p->view,
        .n_views = p->n_views,
    };
    const int err = path && title ? report_write(&source, path) : -ENOMEM;
    free(path);
    free(title);
    return err;
}

int report_folder(const struct report_inputs *in)
{
    struct page p = { 0 };
    int err = solved_read(&p.solved, "report", in->solve_dir, in->mesh);
    if (!err) {
        err = solved_read_lights(&p.solved, in->solve_dir);
        err = err == -ENOENT ? 0 : err;
    }
    if (!err)
        err = read_if_there(&p.std, in->solve_dir, "std.exr");
    if (!err)
        err = read_if_there(&p.validity, in->solve_dir, "validity.exr");
    if (!err) {
        char *exported = solved_path(in->solve_dir, "export.json");
        err = !exported ? -ENOMEM : access(exported, F_OK) ? 0 : json_read(&p.exported, exported);
        free(exported);
    }
    if (!err)
        err = find_photographs(&p, in);
    if (!err && p.solved.lights.n)
        err = show_views(&p, in);
    if (!err)
        err = write_page(&p, in);
    page_free(&p);
    return err;
}

int command_report(int argc, char **argv)
{
    struct report_inputs in = { .n_views = DEFAULT_VIEWS };
    argp_parse(&argp, argc, argv, 0, 0, &in);
    const int err = report_folder(&in);
    if (err == -ENOMEM)
        log_error("report: out of memory");
    return err ? EXIT_FAILED : EXIT_DONE;
}
