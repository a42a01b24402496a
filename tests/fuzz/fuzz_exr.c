// tests/fuzz/fuzz_exr.c - hostile OpenEXR files: an error or a picture within the limits, never
// more.
#include "solver/take/image_formats.h"
#include "solver/take/log.h"

#include <stdlib.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    struct image image;
    log_set_level(LOG_SILENT);
    if (image_read_exr(&image, &(struct image_file){ bytes, n, "fuzz" }) == 0) {
        if (image.width < 1 || image.height < 1 || image.n_channels < 1 || !image.data ||
            !image.names)
            abort();
        image_free(&image);
    } else if (image.data || image.names) {
        abort();
    }
    return 0;
}
