// rigd/resting.c - see resting.h.
#include "rigd/resting.h"

#include <fcntl.h>
#include <stdint.h>
#include <sys/mman.h>
#include <unistd.h>

void *resting_new(const char *folder, size_t n_bytes)
{
    const int fd = open(folder, O_TMPFILE | O_RDWR | O_CLOEXEC, 0600);
    if (fd < 0)
        return NULL;
    void *at = n_bytes && !posix_fallocate(fd, 0, (off_t)n_bytes) ? mmap(NULL, n_bytes, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0) : MAP_FAILED;
    close(fd);
    return at == MAP_FAILED ? NULL : at;
}

void resting_free(void *data, size_t n_bytes)
{
    if (data)
        munmap(data, n_bytes);
}

void resting_leave(void *data, size_t begin, size_t end)
{
    const uintptr_t page = (uintptr_t)sysconf(_SC_PAGESIZE), at = (uintptr_t)data;
    const uintptr_t from = (at + begin + page - 1) / page * page, to = (at + end) / page * page;
    if (from < to)
        madvise((void *)from, to - from, MADV_DONTNEED);
}
