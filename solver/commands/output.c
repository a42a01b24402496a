// solver/commands/output.c - how a command hands over what it found.
#include "solver/commands/output.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

int output_flush(const char *command)
{
    if (!fflush(stdout) && !ferror(stdout))
        return 0;
    const int err = errno ? -errno : -EIO;
    log_error("%s: cannot print: %s", command, strerror(-err));
    return err;
}

int output_json(const char *command, struct json *doc)
{
    char *text = json_text(doc);
    json_free(doc);
    if (!text)
        return -ENOMEM;
    errno = 0;
    puts(text);
    free(text);
    return output_flush(command);
}

char *output_path(const char *dir, const char *view, const char *extension)
{
    char *path;
    if (asprintf(&path, "%s/%s.%s", dir, view, extension) < 0)
        return NULL;
    for (char *p = path + strlen(dir) + 1; *p; p++)
        if (*p == '/')
            *p = '_';
    return path;
}

double output_clock_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
