// tests/fuzz/fuzz_camera.c - hostile messages between daemon and worker: refused, or bounded and the same after a round trip.
#include "rigd/camera.h"
#include "solver/take/log.h"

#include <stdlib.h>
#include <string.h>

// A text that came through a decoder comes through again.
static void again(char *text, size_t n, bool command)
{
    static struct camera_command c;
    static struct camera_event e;
    size_t n_again = 0;
    if (!text || n > 2 * CAMERA_MESSAGE_MAX)
        abort();
    if (n <= CAMERA_MESSAGE_MAX) { // \u escapes may make it too long; then its sender notices
        if (command ? camera_command_decode(&c, text, n) : camera_event_decode(&e, text, n))
            abort();
        char *same = command ? camera_command_encode(&c, &n_again) : camera_event_encode(&e, &n_again);
        if (!same || n_again != n || memcmp(same, text, n))
            abort();
        free(same);
    }
    free(text);
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    static struct camera_command c;
    static struct camera_event e;
    size_t n_text = 0;
    log_set_level(LOG_SILENT);
    if (!camera_command_decode(&c, (const char *)bytes, n)) {
        if ((unsigned)c.kind >= CAMERA_N_COMMANDS || !c.seq || c.n_settings < 0 || c.n_settings > CAMERA_SETTINGS_MAX || c.n_after < 0 ||
            c.n_after > CAMERA_STORES_MAX || (c.path[0] && c.path[0] != '/') || strchr(c.object.name, '/'))
            abort();
        char *text = camera_command_encode(&c, &n_text);
        again(text, n_text, true);
    }
    if (!camera_event_decode(&e, (const char *)bytes, n)) {
        if ((unsigned)e.kind >= CAMERA_N_EVENTS || e.n_settings < 0 || e.n_settings > CAMERA_SETTINGS_MAX || e.n_listed < 0 ||
            e.n_listed > CAMERA_LISTING_MAX)
            abort();
        for (int i = 0; i < e.n_listed; i++) {
            if (strchr(e.object[i].name, '/') || e.object[i].name[0] == '.' || e.object[i].folder[0] != '/')
                abort();
            const int order = camera_object_order(&e.object[i], &e.object[0]), back = camera_object_order(&e.object[0], &e.object[i]);
            if ((order > 0) != (back < 0) || (order < 0) != (back > 0))
                abort();
        }
        char *text = camera_event_encode(&e, &n_text);
        again(text, n_text, false);
    }
    return 0;
}
