// tests/fuzz/fuzz_config.c - hostile rigd.conf: an error, or a configuration that keeps its promises.
#include "rigd/config.h"
#include "solver/take/log.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    struct config c;
    log_set_level(LOG_SILENT);
    if (config_parse(&c, (const char *)bytes, n, "f")) {
        if (c.camera || c.n_cameras)
            abort();
        return 0;
    }
    if (c.n_cameras < 1 || c.n_cameras > CONFIG_CAMERAS_MAX || c.takes_dir[0] != '/' || c.trigger.hold_ms > c.trigger.max_hold_ms || c.trigger.max_hold_ms > 10000)
        abort();
    for (int i = 0; i < c.n_cameras; i++) {
        const struct config_camera *k = &c.camera[i];
        if (!k->name[0] || strpbrk(k->name, "/.\\") || !k->port[0] || k->n_settings > CAMERA_SETTINGS_MAX || k->controller < 0 || k->controller > 255)
            abort();
        for (int j = 0; j < i; j++)
            if (!strcmp(k->name, c.camera[j].name) || !strcmp(k->port, c.camera[j].port) || (k->serial[0] && !strcmp(k->serial, c.camera[j].serial)))
                abort();
    }
    config_free(&c);
    return 0;
}
