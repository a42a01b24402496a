// solver/commands/presets.c - see presets.h. Chosen by make chart: seconds against error.
#include "solver/commands/presets.h"

const struct preset presets[N_PRESETS] = {
    { "preview", 1, 128, 128, 64, 12000, 60000, 2, true },
    { "standard", 2, 512, 256, 256, 30000, 200000, 4, false },
    { "final", 2, 2048, 512, 256, 30000, 200000, 4, false },
};
const char *const preset_names[N_PRESETS] = { "preview", "standard", "final" };
