// tests/fuzz/fuzz_exif.c - any bytes as a raw's EXIF: no read outside, no number that developing could not use.
#include "rigd/exif.h"

#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <unistd.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    static int fd = -1;
    struct exif e;
    if (fd < 0)
        fd = memfd_create("raw", 0);
    if (ftruncate(fd, 0) || pwrite(fd, data, n, 0) != (ssize_t)n)
        return 0;
    if (exif_read(&e, fd)) {
        if (e.has_time || e.label_s != 0 || e.orientation || e.serial[0])
            abort(); // zeroed on failure
        return 0;
    }
    const double t = exif_true_time_s(e.label_s, e.apex_s);
    if (!(t >= 0 && t < 1e6) || !(e.f_number >= 0 && e.f_number < 1e3) || !(e.focal_mm >= 0 && e.focal_mm < 1e5) || e.orientation < 0 || e.orientation > 8 || (e.has_subseconds && !e.has_time))
        abort();
    return 0;
}
