// tests/fuzz/fuzz_lights.c - lights.json from anywhere: what is accepted must be lights that
// everything else can use.
#include "solver/lights.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <stdlib.h>

int LLVMFuzzerInitialize(int *argc, char ***argv)
{
    (void)argc, (void)argv;
    log_set_level(LOG_ERROR + 1); // thousands of refusals
    return 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    struct lights l;
    const int err = lights_parse_json(&l, (const char *)data, n, "fuzz");
    if (err) {
        if (l.n || l.dir_probe)
            abort(); // zeroed on failure
        return 0;
    }
    if (l.n < 1 || l.n > LIGHTS_MAX || mat3_det(l.world_from_probe) < .99)
        abort();
    for (int i = 0; i < l.n; i++) {
        struct light_at_gradient g;
        const double p[3] = {.1, -.2, .3};
        light_at_point_gradient(&l, i, p, &g);
        if (!(fabs(vec3_norm(g.at.l) - 1) < 1e-5) || !(g.at.weight >= 0) || !isfinite(g.at.weight))
            abort();
        if (l.region && (l.region[i].x0 < 0 || l.region[i].x1 > l.panorama_width_px ||
                         l.region[i].y0 < 0 || l.region[i].y1 > l.panorama_height_px))
            abort();
    }
    lights_free(&l);
    return 0;
}
