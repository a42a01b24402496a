// tests/fuzz/fuzz_container.c - hostile frames: the look at their container ends, and says why it did not like one.
#include "rigd/container.h"

#include <errno.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <unistd.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    static const char *const names[] = { "a.dng", "a.cr3", "a.raf", "a.jpg", "a" };
    static int fd = -1;
    char why[120];
    if (fd < 0)
        fd = memfd_create("frame", 0);
    if (fd < 0 || ftruncate(fd, 0) || pwrite(fd, bytes, n, 0) != (ssize_t)n)
        abort();
    for (int i = 0; i < 5; i++) {
        const int err = container_check(fd, (int64_t)n, names[i], why, sizeof(why));
        if ((err && err != -EBADMSG) || (err && !why[0]) || (i == 4 && err))
            abort();
    }
    return 0;
}
