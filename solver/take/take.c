// solver/take/take.c - what a take's folder holds.
#include "solver/take/take.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <dirent.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>

static char *joined(const char *dir, const char *name)
{
    char *path = NULL;
    const size_t n = strlen(dir);
    if (asprintf(&path, "%s%s%s", dir, n && dir[n - 1] == '/' ? "" : "/", name) < 0)
        return NULL;
    return path;
}

static bool is_file(const char *path)
{
    struct stat st;
    return stat(path, &st) == 0 && S_ISREG(st.st_mode);
}

static bool is_folder(const char *path)
{
    struct stat st;
    return stat(path, &st) == 0 && S_ISDIR(st.st_mode);
}

static bool is_hidden(const char *name) // ".", "..", and the .part files of interrupted writers
{
    return name[0] == '.';
}

// dir/name into *out if it is a regular file. 0 or -ENOMEM.
static int find_file(char **out, const char *dir, const char *name)
{
    char *path = joined(dir, name);
    if (!path)
        return -ENOMEM;
    if (is_file(path))
        *out = path;
    else
        free(path);
    return 0;
}

// Of strings, or of arrays that begin with one: strcmp, whatever the locale.
static int compare_names(const void *a, const void *b)
{
    return strcmp(*(char *const *)a, *(char *const *)b);
}

// The names in dir, sorted bytewise so that nothing depends on the file system's order. 0 or -errno
// (logged).
static int list_folder(const char *dir, char ***names, int *n_names)
{
    struct dirent **entries = NULL;
    *names = NULL;
    *n_names = 0;
    int n = scandir(dir, &entries, NULL, NULL);
    if (n < 0) {
        const int err = -errno;
        log_error("take: cannot list %s: %s", dir, strerror(-err));
        return err;
    }
    char **list = calloc((size_t)n + 1, sizeof(*list));
    bool no_memory = !list;
    int n_kept = 0;
    for (int i = 0; i < n; i++) {
        if (list && !is_hidden(entries[i]->d_name)) {
            list[n_kept] = strdup(entries[i]->d_name);
            no_memory |= !list[n_kept++];
        }
        free(entries[i]);
    }
    free(entries);
    if (no_memory) {
        for (int i = 0; i < n_kept; i++)
            free(list[i]);
        free(list);
        return -ENOMEM;
    }
    qsort(list, (size_t)n_kept, sizeof(*list), compare_names);
    *names = list;
    *n_names = n_kept;
    return 0;
}

static void free_names(char **names, int n)
{
    for (int i = 0; names && i < n; i++)
        free(names[i]);
    free(names);
}

static bool ends_in(const char *name, const char *const *extensions)
{
    const char *dot = strrchr(name, '.');
    if (!dot || dot == name)
        return false;
    for (; *extensions; extensions++)
        if (!strcasecmp(dot + 1, *extensions))
            return true;
    return false;
}

static bool has_stem(const char *name, const char *stem)
{
    const char *dot = strrchr(name, '.');
    return dot && (size_t)(dot - name) == strlen(stem) && !strncmp(name, stem, strlen(stem));
}

// geometry/<stem>.<extension> (NULL: any); the first in bytewise order, with a warning for every
// other.
static int find_geometry(char **out, const char *dir, char *const *names, int n, const char *stem,
                         const char *const *extensions)
{
    for (int i = 0; i < n; i++) {
        char *path = NULL;
        if (!has_stem(names[i], stem) || (extensions && !ends_in(names[i], extensions)))
            continue;
        const int err = find_file(&path, dir, names[i]);
        if (err)
            return err;
        if (path && *out)
            log_warning("take: %s is used, %s is not; remove one of them", *out, path);
        if (*out)
            free(path);
        else
            *out = path;
    }
    return 0;
}

static int look_at_geometry(struct take *take)
{
    static const char *const mesh_extensions[] = { "glb", "gltf", "obj", "ply", NULL };
    static const char *const camera_extensions[] = { "csv", "json", "out", "sfm", "xml", "xmp", NULL };
    char **names = NULL, **inside = NULL;
    int n = 0, n_inside = 0, err = -ENOMEM;
    char *dir = joined(take->dir, "geometry"), *cameras = dir ? joined(dir, "cameras") : NULL;
    if (!cameras)
        goto done;
    err = is_folder(dir) ? list_folder(dir, &names, &n) : 0;
    if (!err)
        err = find_geometry(&take->mesh_path, dir, names, n, "mesh", mesh_extensions);
    if (err)
        goto done;
    if (is_folder(cameras)) { // take_create leaves it empty: then the tool has not written yet
        err = list_folder(cameras, &inside, &n_inside);
        if (err)
            goto done;
        if (n_inside) {
            take->cameras_path = cameras;
            cameras = NULL;
        }
    }
    if (!take->cameras_path)
        err = find_geometry(&take->cameras_path, dir, names, n, "cameras", NULL);
    for (int i = 0; i < n && !err && !take->cameras_path; i++) // what a tool exported, under its own name
        if (ends_in(names[i], camera_extensions)) {
            take->cameras_path = dir;
            dir = NULL;
        }
done:
    free_names(names, n);
    free_names(inside, n_inside);
    free(cameras);
    free(dir);
    return err;
}

// linear/: pairs of (stem, path), sorted by stem.
static int look_at_views(struct take *take)
{
    static const char *const extensions[] = { "exr", "tif", "tiff", "hdr", NULL };
    char **names = NULL, *(*views)[2] = NULL;
    int n = 0, n_views = 0, err = -ENOMEM;
    char *dir = joined(take->dir, "linear");
    if (!dir)
        goto done;
    if (!is_folder(dir)) {
        err = 0;
        goto done;
    }
    take->linear_dir = strdup(dir);
    err = take->linear_dir ? list_folder(dir, &names, &n) : -ENOMEM;
    if (err)
        goto done;
    views = calloc((size_t)n + 1, sizeof(*views));
    take->view_names = calloc((size_t)n + 1, sizeof(char *));
    take->view_paths = calloc((size_t)n + 1, sizeof(char *));
    if (!views || !take->view_names || !take->view_paths) {
        err = -ENOMEM;
        goto done;
    }
    for (int i = 0; i < n; i++) {
        char *path = NULL;
        if (!ends_in(names[i], extensions))
            continue;
        err = find_file(&path, dir, names[i]);
        if (err)
            goto done;
        if (!path)
            continue;
        views[n_views][1] = path;
        views[n_views++][0] = strndup(names[i], (size_t)(strrchr(names[i], '.') - names[i]));
        if (!views[n_views - 1][0]) {
            err = -ENOMEM;
            goto done;
        }
    }
    qsort(views, (size_t)n_views, sizeof(*views), compare_names);
    for (int i = 1; i < n_views; i++)
        if (!strcmp(views[i - 1][0], views[i][0])) {
            log_error("take: %s and %s have one name; a camera has one picture: remove one of them",
                      views[i - 1][1], views[i][1]);
            err = -EINVAL;
            goto done;
        }
    for (int i = 0; i < n_views; i++) {
        take->view_names[i] = views[i][0];
        take->view_paths[i] = views[i][1];
    }
    take->n_views = n_views;
    n_views = 0; // moved
done:
    for (int i = 0; i < n_views; i++) {
        free(views[i][0]);
        free(views[i][1]);
    }
    free(views);
    free_names(names, n);
    free(dir);
    return err;
}

static int look_at_manifest(struct take *take)
{
    char *path = NULL;
    int err = find_file(&path, take->dir, "take.json");
    if (!err && path)
        err = json_read(&take->manifest, path);
    free(path);
    return err;
}

int take_open(struct take **out, const char *dir)
{
    struct stat st;
    int err;
    *out = NULL;
    struct take *take = calloc(1, sizeof(*take));
    if (!take)
        return -ENOMEM;
    err = stat(dir, &st) ? -errno : S_ISDIR(st.st_mode) ? 0 : -ENOTDIR;
    if (err) {
        log_error("take: cannot open %s: %s; expected the folder of a take", dir, strerror(-err));
        goto fail;
    }
    take->dir = strdup(dir);
    err = take->dir ? look_at_manifest(take) : -ENOMEM;
    if (!err)
        err = look_at_geometry(take);
    if (!err)
        err = find_file(&take->panorama_path, dir, "panorama.exr");
    if (!err && !take->panorama_path)
        err = find_file(&take->panorama_path, dir, "panorama.hdr");
    if (!err)
        err = find_file(&take->start_path, dir, "start.json");
    if (!err)
        err = look_at_views(take);
    if (err) {
        if (err == -ENOMEM)
            log_error("take: cannot open %s: out of memory", dir);
        goto fail;
    }
    *out = take;
    return 0;
fail:
    take_close(take);
    return err;
}

void take_close(struct take *take)
{
    if (!take)
        return;
    free_names(take->view_names, take->n_views);
    free_names(take->view_paths, take->n_views);
    json_free(take->manifest);
    free(take->mesh_path);
    free(take->cameras_path);
    free(take->panorama_path);
    free(take->linear_dir);
    free(take->start_path);
    free(take->dir);
    free(take);
}

int take_require(const struct take *take, unsigned needs)
{
    const struct {
        unsigned need;
        bool is_there;
        const char *what;
    } pieces[] = {
        { TAKE_MESH, take->mesh_path,
          "geometry/mesh.obj (or .ply, .glb, .gltf), which the photogrammetry tool exports" },
        { TAKE_CAMERAS, take->cameras_path,
          "geometry/cameras (a COLMAP folder, or the camera file or sidecars of another tool), which "
          "the photogrammetry tool exports" },
        { TAKE_PANORAMA, take->panorama_path,
          "panorama.exr, which `rigctl panorama` takes and develops" },
        { TAKE_VIEWS, take->n_views > 0,
          "linear/<camera>.exr, which `rigctl develop` makes from the raw files" },
        { TAKE_START, take->start_path,
          "start.json with a rough world_from_probe, which the operator gives "
          "(--world-from-probe)" },
    };
    int err = 0;
    for (size_t i = 0; i < sizeof(pieces) / sizeof(pieces[0]); i++)
        if ((needs & pieces[i].need) && !pieces[i].is_there) {
            log_error("take: %s lacks %s", take->dir, pieces[i].what);
            err = -ENOENT;
        }
    return err;
}

static int write_manifest(const char *dir, const char *name, const char *created, const char *state)
{
    int err = -ENOMEM;
    char *path = joined(dir, "take.json");
    struct json *manifest = json_object();
    json_set_string(manifest, "format", "studiorig take 1");
    json_set_string(manifest, "name", name);
    json_set_string(manifest, "created", created);
    json_set_string(manifest, "state", state);
    if (path)
        err = json_write(manifest, path);
    json_free(manifest);
    free(path);
    return err;
}

int take_create(const char *dir, const char *name, const char *created, const char *state)
{
    char **names = NULL;
    int n = 0;
    int err = make_directories(dir);
    if (!err)
        err = list_folder(dir, &names, &n);
    if (!err && n) {
        err = -EEXIST;
        log_error("take: cannot create %s: the folder holds %s%s; choose a new one", dir, names[0],
                  n > 1 ? " and more" : "");
    }
    free_names(names, n);
    if (err)
        return err;
    char *linear = joined(dir, "linear"), *cameras = joined(dir, "geometry/cameras");
    err = linear && cameras ? make_directories(linear) : -ENOMEM;
    if (!err)
        err = make_directories(cameras);
    if (!err)
        err = write_manifest(dir, name, created, state);
    free(linear);
    free(cameras);
    return err;
}
