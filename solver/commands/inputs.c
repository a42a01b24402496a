// solver/commands/inputs.c - a TAKE, or its pieces named one by one: found, checked, loaded.
#include "solver/commands/inputs.h"
#include "solver/cameras_frame.h"
#include "solver/picture_size.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

// ---- the command line ---------------------------------------------------------------------------

// Keys far from those of the commands, which count from 256.
enum { KEY_MESH = 0x10000, KEY_CAMERAS, KEY_IMAGES, KEY_PANORAMA, KEY_POSE };

static const struct argp_option options[] = {
    {0, 0, 0, 0, "Input (with TAKE: in place of the take's own)", 1},
    {"mesh", KEY_MESH, "FILE", 0, "OBJ, PLY, glTF or GLB with a UV atlas", 1},
    {"cameras", KEY_CAMERAS, "PATH", 0, "calibrated views: a COLMAP folder, or Metashape's, RealityCapture's, Meshroom's or Bundler's file", 1},
    {"images", KEY_IMAGES, "DIR", 0, "the views' pictures, each of its view's name", 1},
    {"panorama", KEY_PANORAMA, "FILE", 0, "HDR panorama the lights are cut from", 1},
    {"world-from-probe", KEY_POSE, "FILE", 0,
     "JSON with world_from_probe (3x3) and perhaps centre_m; default: the take's start.json", 1},
    {0},
};

// What of in->needs is not named.
static unsigned not_named(const struct inputs *in)
{
    return in->needs &
           ((in->mesh_path ? 0 : TAKE_MESH) | (in->cameras_path ? 0 : TAKE_CAMERAS) |
            (in->images_dir ? 0 : TAKE_VIEWS) | (in->panorama_path ? 0 : TAKE_PANORAMA));
}

// "expected a TAKE, or --mesh, --cameras and --panorama"
static void demand_pieces(const struct argp_state *state, unsigned needs)
{
    static const struct {
        unsigned piece;
        const char *option;
    } pieces[] = {{TAKE_MESH, "--mesh"},
                  {TAKE_CAMERAS, "--cameras"},
                  {TAKE_VIEWS, "--images"},
                  {TAKE_PANORAMA, "--panorama"}};
    char list[128] = "";
    for (int i = 0; i < 4; i++) {
        if (!(needs & pieces[i].piece))
            continue;
        needs &= ~pieces[i].piece;
        const size_t used = strlen(list);
        snprintf(list + used, sizeof(list) - used, "%s%s",
                 !used   ? ""
                 : needs ? ", "
                         : " and ",
                 pieces[i].option);
    }
    argp_error(state, "expected a TAKE, or %s", list);
}

static error_t parse(int key, char *text, struct argp_state *state)
{
    struct inputs *in = state->input;
    switch (key) {
    case KEY_MESH:
        in->mesh_path = text;
        return 0;
    case KEY_CAMERAS:
        in->cameras_path = text;
        return 0;
    case KEY_IMAGES:
        in->images_dir = text;
        return 0;
    case KEY_PANORAMA:
        in->panorama_path = text;
        return 0;
    case KEY_POSE:
        in->pose_path = text;
        return 0;
    case ARGP_KEY_ARG:
        if (in->take_dir)
            argp_error(state, "a second take '%s': expected one", text);
        in->take_dir = text;
        return 0;
    case ARGP_KEY_END:
        if (!in->take_dir && not_named(in))
            demand_pieces(state, in->needs);
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

const struct argp inputs_argp = {options, parse, NULL, NULL, NULL, NULL, NULL};

// ---- loading ------------------------------------------------------------------------------------

static int open_take(struct inputs *in)
{
    if (!in->take_dir)
        return 0;
    int err = take_open(&in->take, in->take_dir);
    if (!err)
        err = take_require(in->take, not_named(in));
    if (err)
        return err;
    if (!in->mesh_path)
        in->mesh_path = in->take->mesh_path;
    if (!in->cameras_path)
        in->cameras_path = in->take->cameras_path;
    if (!in->panorama_path)
        in->panorama_path = in->take->panorama_path;
    return 0;
}

// *out NULL: there is none.
static int find_picture(const struct inputs *in, const char *view, char **out)
{
    static const char *const extensions[] = {"exr", "tif", "tiff", "hdr", "png"};
    *out = NULL;
    for (int i = 0; in->images_dir && i < (in->png_too ? 5 : 4); i++) {
        char *path;
        if (asprintf(&path, "%s/%s.%s", in->images_dir, view, extensions[i]) < 0)
            return -ENOMEM;
        if (!access(path, F_OK)) {
            *out = path;
            return 0;
        }
        free(path);
    }
    for (int i = 0; !in->images_dir && in->take && i < in->take->n_views; i++)
        if (!strcmp(in->take->view_names[i], view)) {
            *out = strdup(in->take->view_paths[i]);
            return *out ? 0 : -ENOMEM;
        }
    return 0;
}

// For camera files that do not say it.
static int size_of_picture(void *arg, const char *name, int *width_px, int *height_px)
{
    const struct inputs *in = arg;
    char *path;
    int err = find_picture(in, name, &path);
    if (!err)
        err = path ? picture_size(width_px, height_px, path) : -ENOENT;
    free(path);
    return err;
}

static int find_pictures(struct inputs *in)
{
    int err = 0;
    if (!(in->needs & TAKE_VIEWS))
        return 0;
    in->picture = calloc((size_t)in->cameras.n + 1, sizeof(*in->picture));
    if (!in->picture)
        return -ENOMEM;
    for (int i = 0; !err && i < in->cameras.n; i++) {
        err = find_picture(in, in->cameras.view[i].name, &in->picture[i]);
        in->n_pictures += in->picture[i] != NULL;
    }
    return err;
}

int inputs_load(struct inputs *in)
{
    struct mesh_check check;
    int err = open_take(in);
    if (!err)
        err = mesh_read(&in->mesh, &check, in->mesh_path);
    if (err)
        return err;
    mesh_check_log(&check, &in->mesh, in->mesh_path);
    err = texels_rasterise(&in->texels, &in->mesh, in->texture);
    if (!err)
        err = rays_new(&in->rays, &in->mesh);
    const struct cameras_options sizes = {.picture_size = size_of_picture, .arg = in};
    if (!err)
        err = cameras_read_for_mesh(&in->cameras, in->cameras_path, &sizes, &in->mesh,
                                    in->mesh_path);
    if (!err)
        err = find_pictures(in);
    if (!err && in->picture)
        err = cameras_check_pictures(&in->cameras, &in->mesh, in->rays, in->picture,
                                     in->cameras_path, in->mesh_path);
    return err;
}

void inputs_free(struct inputs *in)
{
    for (int i = 0; in->picture && i < in->cameras.n; i++)
        free(in->picture[i]);
    free(in->picture);
    panorama_free(&in->panorama);
    cameras_free(&in->cameras);
    texels_free(&in->texels);
    rays_free(in->rays);
    mesh_free(&in->mesh);
    take_close(in->take);
    memset(in, 0, sizeof(*in));
}

// ---- lights -------------------------------------------------------------------------------------

static int place_lights(struct lights *l, const struct inputs *in, bool cut)
{
    const char *pose = in->pose_path;
    bool has_centre = false;
    int err = 0;
    for (int i = 0; i < l->n; i++)
        has_centre = has_centre || l->inverse_distance[i] > 0;
    if (!pose && cut && in->take)
        pose = in->take->start_path;
    if (pose) {
        bool says_centre;
        err = lights_read_pose(l, &says_centre, pose);
        has_centre = has_centre || says_centre;
    } else if (cut) {
        log_warning(
            "inputs: no --world-from-probe: the panorama is taken to have the world's axes");
    }
    for (int c = 0; !has_centre && c < 3; c++)
        l->centre_m[c] = (in->mesh.bounds_m[0][c] + in->mesh.bounds_m[1][c]) / 2;
    return err;
}

int inputs_lights(struct lights *out, struct inputs *in, const char *lights_path, int n)
{
    int err;
    memset(out, 0, sizeof(*out));
    if (lights_path) {
        err = lights_read_json(out, lights_path);
    } else {
        err = panorama_read(&in->panorama, in->panorama_path);
        if (!err)
            err = lights_median_cut(out, &in->panorama, n);
    }
    if (!err)
        err = place_lights(out, in, !lights_path);
    if (err)
        lights_free(out);
    return err;
}
