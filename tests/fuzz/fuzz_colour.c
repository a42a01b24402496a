// tests/fuzz/fuzz_colour.c - colour.json from anywhere: what is accepted must be gains that a picture survives.
#include "rigd/colour.h"
#include "solver/take/log.h"

#include <math.h>
#include <stdlib.h>

int LLVMFuzzerInitialize(int *argc, char ***argv)
{
    (void)argc, (void)argv;
    log_set_level(LOG_SILENT);
    return 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    struct colour c;
    if (colour_parse(&c, (const char *)data, n, "fuzz")) {
        if (c.n || c.body)
            abort(); // zeroed on failure
        return 0;
    }
    if (c.n < 1 || c.n > COLOUR_BODIES_MAX)
        abort();
    for (int i = 0; i < c.n; i++) {
        if (colour_of(&c, c.body[i].serial) != &c.body[i])
            abort(); // by serial, once
        for (int k = 0; k < 3; k++)
            if (!(c.body[i].gain[k] * c.body[i].scale > 1e-4 && c.body[i].gain[k] * c.body[i].scale < 1e4))
                abort();
    }
    colour_free(&c);
    return 0;
}
