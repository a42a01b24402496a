// solver/whole_file.h - a file as bytes in memory, for readers that check before they believe.
#pragma once
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>

// Reads all of path, and a NUL behind it. *bytes is malloc'd. 0, -errno of the open or the read, -EISDIR, -EFBIG (over
// max_bytes), -ENOMEM; nothing is logged.
static inline int whole_file_read(char **bytes, size_t *n_bytes, const char *path, size_t max_bytes)
{
    int err = 0;
    char *data = NULL;
    *bytes = NULL, *n_bytes = 0;
    struct stat st;
    FILE *f = fopen(path, "rbe");
    if (!f)
        return -errno;
    if (fstat(fileno(f), &st))
        err = -errno;
    else if (S_ISDIR(st.st_mode))
        err = -EISDIR;
    else if (!S_ISREG(st.st_mode))
        err = -EINVAL;
    else if ((unsigned long long)st.st_size > max_bytes)
        err = -EFBIG;
    if (err)
        goto done;
    const size_t n = (size_t)st.st_size;
    data = malloc(n + 1);
    if (!data) {
        err = -ENOMEM;
        goto done;
    }
    if (fread(data, 1, n, f) != n)
        err = -EIO; // it shrank, or the disk failed
done:
    fclose(f);
    if (err) {
        free(data);
        return err;
    }
    data[st.st_size] = 0;
    *bytes = data;
    *n_bytes = (size_t)st.st_size;
    return 0;
}
