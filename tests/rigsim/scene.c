// tests/rigsim/scene.c - see scene.h.
#include "tests/rigsim/scene.h"
#include "tests/rigsim/probe.h"
#include "solver/take/half.h"
#include "solver/take/image.h"
#include "solver/take/log.h"

#include <dirent.h>
#include <fcntl.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

enum { PATH_BYTES = 1024, NAME_BYTES = 256 };

struct scene {
    int width, height;
    unsigned n_cameras;
    const char *(*camera_name)(unsigned camera);
    float *built_in; // [height][width]; NULL with a folder
    char folder[PATH_BYTES];
    char (*file)[NAME_BYTES]; // the folder's EXRs by name
    unsigned n_files;
    int spool_fd;
    uint16_t *plane; // mapped, half: [n_cameras][height][width]
    size_t map_bytes;
    bool *made; // [n_cameras]
    struct probe *probe;
    unsigned probe_camera;
};

// ---- the built-in picture --------------------------------------------------------------------------------------------------

static double channel_of(int x, int y, const double rgb[3])
{
    return rgb[(x & 1) + (y & 1)]; // R G / G B
}

// x, y in 0 .. 1.
static void built_in_colour(double x, double y, double rgb[3])
{
    static const double patch[6][3] = { { .40, .10, .08 }, { .12, .35, .10 }, { .06, .10, .40 },
                                        { .60, .50, .08 }, { .45, .12, .35 }, { .90, .90, .90 } };
    const double dx = (x - .5) * 1.5, dy = y - .55, r2 = (dx * dx + dy * dy) / (.28 * .28);
    if (r2 < 1) { // a ball under one light from the upper left
        const double nz = sqrt(1 - r2), nx = dx / .28, ny = dy / .28;
        const double lambert = fmax(0, -.5 * nx - .6 * ny + .62 * nz);
        const double check = ((int)floor(8 * atan2(nx, nz) + 100) + (int)floor(8 * ny + 100)) % 2 ? .75 : .45;
        for (int c = 0; c < 3; c++)
            rgb[c] = check * (lambert * (c == 2 ? .85 : 1) + .04);
        return;
    }
    if (y < .12) { // grey ramp
        rgb[0] = rgb[1] = rgb[2] = floor(x * 16) / 16;
        return;
    }
    if (y > .88) { // patches, and bars of one pixel and more
        if (x < .6)
            memcpy(rgb, patch[(int)(x * 10)], 3 * sizeof(rgb[0]));
        else
            rgb[0] = rgb[1] = rgb[2] = sin(x * x * 900) > 0 ? .7 : .05;
        return;
    }
    for (int c = 0; c < 3; c++)
        rgb[c] = .18 * (1.2 - .4 * y);
}

static int make_built_in(struct scene *s)
{
    s->built_in = malloc((size_t)s->width * (size_t)s->height * sizeof(float));
    if (!s->built_in)
        return -ENOMEM;
    for (int y = 0; y < s->height; y++)
        for (int x = 0; x < s->width; x++) {
            double rgb[3];
            built_in_colour((x + .5) / s->width, (y + .5) / s->height, rgb);
            s->built_in[(size_t)y * (size_t)s->width + (size_t)x] = (float)channel_of(x, y, rgb);
        }
    return 0;
}

// ---- a folder --------------------------------------------------------------------------------------------------------------

static int is_exr(const struct dirent *e)
{
    const size_t n = strlen(e->d_name);
    return n > 4 && n < NAME_BYTES && !strcmp(e->d_name + n - 4, ".exr");
}

static int open_folder(struct scene *s, const char *folder)
{
    struct dirent **entry = NULL;
    const int n = scandir(folder, &entry, is_exr, alphasort);
    int err = n < 0 ? -errno : n == 0 ? -ENOENT : 0;
    if (err) {
        log_error("rigsim: scene %s: found %s; expected a folder of linear EXRs, best named <camera>.exr", folder,
                  n < 0 ? strerror(errno) : "no .exr");
        goto fail;
    }
    snprintf(s->folder, sizeof(s->folder), "%s", folder);
    s->n_files = (unsigned)n;
    s->file = calloc(s->n_files, sizeof(s->file[0]));
    s->made = calloc(s->n_cameras, sizeof(bool));
    if (!s->file || !s->made) {
        err = -ENOMEM;
        goto fail;
    }
    for (int i = 0; i < n; i++)
        memcpy(s->file[i], entry[i]->d_name, strlen(entry[i]->d_name));
    char path[PATH_BYTES];
    const char *tmp = getenv("TMPDIR");
    snprintf(path, sizeof(path), "%s/rigsim-scene-XXXXXX", tmp ? tmp : "/tmp");
    s->spool_fd = mkostemp(path, O_CLOEXEC);
    if (s->spool_fd >= 0)
        unlink(path);
    s->map_bytes = (size_t)s->n_cameras * (size_t)s->width * (size_t)s->height * sizeof(uint16_t);
    void *map = MAP_FAILED;
    if (s->spool_fd >= 0 && !ftruncate(s->spool_fd, (off_t)s->map_bytes))
        map = mmap(NULL, s->map_bytes, PROT_READ | PROT_WRITE, MAP_SHARED, s->spool_fd, 0);
    if (map == MAP_FAILED) {
        err = -errno;
        log_error("rigsim: scene: cannot make a spool file of %zu MB at %s: %s; free space there or set TMPDIR", s->map_bytes >> 20,
                  path, strerror(errno));
        goto fail;
    }
    s->plane = map;
fail:
    for (int i = 0; i < n; i++)
        free(entry[i]);
    free(entry);
    return err;
}

static void make_plane(struct scene *s, unsigned camera, uint16_t *plane)
{
    char path[PATH_BYTES + NAME_BYTES];
    struct image im = { 0 };
    snprintf(path, sizeof(path), "%s/%s.exr", s->folder, s->camera_name(camera));
    if (access(path, R_OK))
        snprintf(path, sizeof(path), "%s/%s", s->folder, s->file[camera % s->n_files]);
    if (image_read(&im, path) || image_require_finite(&im, (const char *const[]){ "R", "G", "B", "Y", NULL }, path)) {
        image_free(&im);
        return;
    }
    int channel[3] = { image_channel(&im, "R"), image_channel(&im, "G"), image_channel(&im, "B") };
    for (int c = 0; c < 3; c++)
        if (channel[c] < 0)
            channel[c] = 0; // a grey picture
    const bool same = im.width == s->width && im.height == s->height;
    for (int y = 0; y < s->height; y++)
        for (int x = 0; x < s->width; x++) {
            const int c = channel[(x & 1) + (y & 1)];
            float pixel[IMAGE_MAX_CHANNELS];
            const float *p = pixel;
            if (same)
                p = im.data + ((size_t)y * (size_t)im.width + (size_t)x) * (size_t)im.n_channels;
            else
                image_bilinear(&im, (x + .5) * im.width / s->width, (y + .5) * im.height / s->height, pixel);
            plane[(size_t)y * (size_t)s->width + (size_t)x] = half_from_float(p[c]);
        }
    image_free(&im);
}

// ---- --------------------------------------------------------------------------------------------------------------------

int scene_open(struct scene **out, const char *folder, int width_px, int height_px, unsigned n_cameras,
               const char *(*camera_name)(unsigned camera))
{
    struct scene *s = calloc(1, sizeof(*s));
    if (!s)
        return -ENOMEM;
    s->width = width_px;
    s->height = height_px;
    s->n_cameras = n_cameras;
    s->camera_name = camera_name;
    s->spool_fd = -1;
    const int err = folder ? open_folder(s, folder) : make_built_in(s);
    if (err) {
        scene_close(s);
        return err;
    }
    *out = s;
    return 0;
}

void scene_close(struct scene *s)
{
    if (!s)
        return;
    probe_close(s->probe);
    if (s->plane)
        munmap(s->plane, s->map_bytes);
    if (s->spool_fd >= 0)
        close(s->spool_fd);
    free(s->built_in);
    free(s->file);
    free(s->made);
    free(s);
}

void scene_give(struct scene *s, unsigned camera, struct probe *probe)
{
    s->probe = probe;
    s->probe_camera = camera;
}

void scene_row(struct scene *s, unsigned camera, const struct scene_view *view, int y, float *site)
{
    if (s->probe && camera == s->probe_camera) {
        probe_row(s->probe, view, y, site);
        return;
    }
    const size_t width = (size_t)s->width;
    if (s->built_in) {
        const size_t shift = (size_t)(camera * 62u) % width & ~(size_t)1; // even: colours stay on their sites
        const float *row = s->built_in + (size_t)y * width;
        memcpy(site, row + shift, (width - shift) * sizeof(float));
        memcpy(site + width - shift, row, shift * sizeof(float));
        return;
    }
    uint16_t *plane = s->plane + (size_t)(camera % s->n_cameras) * width * (size_t)s->height;
    if (!s->made[camera % s->n_cameras]) {
        make_plane(s, camera % s->n_cameras, plane);
        s->made[camera % s->n_cameras] = true;
    }
    for (size_t x = 0; x < width; x++)
        site[x] = float_from_half(plane[(size_t)y * width + x]);
}

int scene_width(const struct scene *s, unsigned camera)
{
    return s->probe && camera == s->probe_camera ? probe_width(s->probe) : s->width;
}

int scene_height(const struct scene *s, unsigned camera)
{
    return s->probe && camera == s->probe_camera ? probe_height(s->probe) : s->height;
}
