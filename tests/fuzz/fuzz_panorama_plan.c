// tests/fuzz/fuzz_panorama_plan.c - hostile panorama.json: an error, or a plan that keeps its promises.
#include "rigd/panorama_plan.h"
#include "solver/take/log.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    struct panorama_plan p;
    log_set_level(LOG_SILENT);
    if (panorama_plan_parse(&p, (const char *)bytes, n, "f", "take")) {
        if (p.stop || p.n_stops || p.colour_file)
            abort();
        return 0;
    }
    if (p.n_stops < 1 || p.n_stops > PANORAMA_STOPS_MAX || p.lens.width_px < 2 || !(p.lens.focal_px >= 1) || !isfinite(p.lens.max_r))
        abort();
    for (int i = 0; i < p.n_stops; i++) {
        if (!p.stop[i].name[0] || p.stop[i].n_frames > PANORAMA_FRAMES_MAX || !isfinite(p.stop[i].yaw_deg + p.stop[i].pitch_deg + p.stop[i].roll_deg))
            abort();
        for (int k = 0; k < p.stop[i].n_frames; k++)
            if (!p.stop[i].frame[k].file || !(p.stop[i].frame[k].exposure_s >= 0))
                abort();
    }
    // What the lens says, it must mean: a pixel it sees comes back.
    for (int i = 0; i < 16; i++) {
        const double px[2] = { p.lens.width_px * (i % 4 + .5) / 4, p.lens.height_px * (i / 4 + .5) / 4 };
        double d[3], back[2];
        if (lens_ray(&p.lens, px, d) && !(fabs(d[0] * d[0] + d[1] * d[1] + d[2] * d[2] - 1) < 1e-9))
            abort();
        if (lens_ray(&p.lens, px, d) && lens_project(&p.lens, d, back) && !isfinite(back[0] + back[1]))
            abort();
    }
    panorama_plan_free(&p);
    return 0;
}
