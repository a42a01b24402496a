// tests/fuzz/fuzz_cameras_import.c - hostile files of photogrammetry tools: an error, or cameras that keep their promises.
//
// Input: one byte (m: Metashape, x: XMP, c: RealityCapture CSV, s: Meshroom, b: Bundler, p: a picture's header), then the file.
#include "solver/cameras_format.h"
#include "solver/picture_size.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int size_of_any(void *arg, const char *name, int *width_px, int *height_px)
{
    (void)arg;
    if (name[0] == 'z')
        return -1;
    *width_px = 60, *height_px = 40;
    return 0;
}

static void check_camera(const struct camera *v)
{
    const double middle[2] = { .5 * v->width_px, .3 * v->height_px };
    double dir[3], point[3], uv[2], J[6];
    if (!v->name[0] || strpbrk(v->name, "/\\") || v->width_px < 1 || v->height_px < 1 || !(v->fx > 0 && v->fy > 0) ||
        !(fabs(mat3_det(v->cam_from_world) - 1) < 1e-9) || !isfinite(v->cx + v->cy + v->skew + vec3_norm(v->t_m)))
        abort();
    if (camera_ray(v, middle, dir)) {
        if (!(fabs(vec3_norm(dir) - 1) < 1e-9))
            abort();
        vec3_add_scaled(point, v->centre_m, 2, dir);
        camera_project_jacobian(v, point, uv, J);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    static const char list[] = "a.jpg\nb.jpg\nc.jpg\nd.jpg\nz.jpg\n";
    const struct cameras_options options = { .picture_size = size_of_any };
    const struct cameras_source s = { .path = "f", .options = &options };
    struct cameras c = { 0 };
    int err = -1;
    log_set_level(LOG_SILENT);
    if (n < 2)
        return 0;
    const char *text = (const char *)bytes + 1;
    n--;
    switch (bytes[0]) {
    case 'm':
        err = cameras_parse_metashape(&c, text, n, &s);
        break;
    case 'c':
        err = cameras_parse_realitycapture_csv(&c, text, n, &s);
        break;
    case 's':
        err = cameras_parse_meshroom(&c, text, n, "f");
        break;
    case 'b':
        err = cameras_parse_bundler(&c, text, n, "f", list, sizeof(list) - 1, "l", &s);
        break;
    case 'x': {
        struct camera one = { .name = "one", .width_px = 60, .height_px = 40 };
        if (camera_parse_xmp(&one, text, n, "f") == 1)
            check_camera(&one);
        return 0;
    }
    case 'p': {
        int width, height;
        FILE *f = fmemopen((void *)(uintptr_t)text, n, "rb");
        if (f && !picture_size_stream(&width, &height, f) && (width < 1 || width > 65536 || height < 1 || height > 65536))
            abort();
        if (f)
            fclose(f);
        return 0;
    }
    default:
        return 0;
    }
    if ((err && (c.n || c.view)) || (!err && c.n < 1))
        abort();
    for (int i = 0; i < c.n; i++)
        check_camera(&c.view[i]);
    for (int i = 0; i < c.n; i++)
        if (cameras_find(&c, c.view[i].name) != &c.view[i])
            abort();
    cameras_free(&c);
    return 0;
}
