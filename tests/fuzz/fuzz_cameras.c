// tests/fuzz/fuzz_cameras.c - hostile COLMAP files: an error, or cameras that keep their promises.
//
// Input: one byte (odd: binary), two bytes (length of the cameras file), the cameras file, the images file.
#include "solver/cameras_format.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    log_set_level(LOG_SILENT);
    if (n < 3)
        return 0;
    size_t n_cameras = bytes[1] | (size_t)bytes[2] << 8;
    n_cameras = n_cameras < n - 3 ? n_cameras : n - 3;
    const char *cameras = (const char *)bytes + 3, *images = cameras + n_cameras;
    const size_t n_images = n - 3 - n_cameras;
    struct cameras c;
    const int err = bytes[0] & 1 ? cameras_parse_colmap_binary(&c, cameras, n_cameras, "c", images, n_images, "i")
                                 : cameras_parse_colmap_text(&c, cameras, n_cameras, "c", images, n_images, "i");
    if (err) {
        if (c.n || c.view)
            abort();
        return 0;
    }
    if (c.n < 1)
        abort();
    for (int i = 0; i < c.n; i++) {
        const struct camera *v = &c.view[i];
        const double middle[2] = { .5 * v->width_px, .3 * v->height_px };
        double dir[3], point[3], uv[2], J[6];
        if (cameras_find(&c, v->name) != v || strchr(v->name, '/') || v->width_px < 1 || !(v->fx > 0 && v->fy > 0) ||
            !(fabs(mat3_det(v->cam_from_world) - 1) < 1e-9))
            abort();
        if (camera_ray(v, middle, dir)) {
            if (!(fabs(vec3_norm(dir) - 1) < 1e-9))
                abort();
            vec3_add_scaled(point, v->centre_m, 2, dir);
            camera_project_jacobian(v, point, uv, J);
        }
    }
    cameras_free(&c);
    return 0;
}
