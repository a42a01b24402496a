// tests/fuzz/fuzz_personality.c - hostile config/cameras/*.conf: refused, or every look-up keeps its promises.
#include "rigd/personality.h"
#include "solver/take/log.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    static const char *const choices[] = { "RAW", "f/8", "1/125", "0.0080s", "2m", "", "65535/65535" };
    struct personality *p;
    char name[PERSONALITY_NAME], out[24];
    log_set_level(LOG_SILENT);
    if (personality_parse(&p, (const char *)bytes, n, "fuzz")) {
        if (p)
            abort();
        return 0;
    }
    for (int s = -1; s < personality_n_settings(p); s++) {
        const char *setting = s < 0 ? "iso" : personality_setting(p, s);
        for (int i = 0; personality_setting_name(p, setting, i, name); i++)
            if (!name[0] || strlen(name) >= sizeof(name))
                abort();
        for (int i = 0; i < 7; i++) {
            const int at = personality_choose(p, setting, choices[i], choices, 7);
            if (at >= 7 || (at >= 0 && !personality_means(p, setting, choices[i], choices[at])))
                abort();
            personality_driver_value(p, setting, choices[i], name);
            personality_neutral(p, setting, choices[i], out, sizeof(out));
            const int n_objects = personality_objects(p, setting, choices[i]);
            if (n_objects == 0 || n_objects > 9)
                abort();
        }
    }
    for (int i = 0; personality_body_name(p, "serial", i, name); i++)
        if (!name[0])
            abort();
    personality_free(p);
    return 0;
}
