// rigd/develop.c - LibRaw, and nothing else knows it.
#include "rigd/develop.h"

#include <errno.h>
#include <libraw/libraw.h>
#include <stdbool.h>
#include <stdio.h>

#if LIBRAW_COMPILE_CHECK_VERSION_NOTLESS(0, 21)
typedef INT64 file_offset;
#else
typedef int file_offset;
#endif

static void note_damage(void *arg, const char *file, const file_offset offset)
{
    long long *first = arg;
    (void)file;
    if (*first == -2)
        *first = offset;
}

int develop_check(const char *path, char *why, size_t room)
{
    long long damaged_at = -2; // -1: LibRaw cannot say where
    libraw_data_t *raw = libraw_init(0);
    if (!raw)
        return -ENOMEM;
    libraw_set_dataerror_handler(raw, note_damage, &damaged_at);
    int code = libraw_open_file(raw, path);
    const bool unknown = code == LIBRAW_FILE_UNSUPPORTED;
    if (!code)
        code = libraw_unpack(raw);
    if (!code && damaged_at != -2)
        snprintf(why, room, "LibRaw found damaged data at byte %lld", damaged_at);
    else if (code)
        snprintf(why, room, "LibRaw: %s", code > 0 ? "cannot read it" : libraw_strerror(code));
    libraw_close(raw);
    if (unknown)
        return -ENOTSUP;
    if (code == LIBRAW_UNSUFFICIENT_MEMORY)
        return -ENOMEM;
    return code || damaged_at != -2 ? -EBADMSG : 0;
}
