// tests/bench/failing_disk.c - a disk that fails on demand, for rig.pl: preloaded, it makes writes to regular files and syncs end with
// EIO as long as the file named by DISK_FAILS exists. Every second write goes through by half, as a dying disk's does.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

static int fails(int fd)
{
    const char *flag = getenv("DISK_FAILS");
    struct stat s;
    return fd > 2 && flag && !access(flag, F_OK) && !fstat(fd, &s) && (S_ISREG(s.st_mode) || S_ISDIR(s.st_mode));
}

ssize_t write(int fd, const void *bytes, size_t n)
{
    static ssize_t (*next)(int, const void *, size_t);
    static int n_writes;
    if (!next)
        next = (ssize_t (*)(int, const void *, size_t))dlsym(RTLD_NEXT, "write");
    if (fails(fd)) {
        if (++n_writes % 2 && n > 1)
            return next(fd, bytes, n / 2);
        errno = EIO;
        return -1;
    }
    return next(fd, bytes, n);
}

int fsync(int fd)
{
    static int (*next)(int);
    if (!next)
        next = (int (*)(int))dlsym(RTLD_NEXT, "fsync");
    if (fails(fd)) {
        errno = EIO;
        return -1;
    }
    return next(fd);
}
