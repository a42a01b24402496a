// rigd/ingest.c - temporary name, hash while writing, sync, read back, rename without replacing, sync the folder: in this order,
// so that a power cut at any point leaves either a whole frame under its name or none.
#include "rigd/ingest.h"

#include <errno.h>
#include <fcntl.h>
#include <libgen.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

struct ingest {
    char path[PATH_MAX], part[PATH_MAX];
    int fd;
    struct digest *digest;
    int64_t size;
};

static void drop(struct ingest *s)
{
    if (s->fd >= 0)
        close(s->fd);
    if (s->digest)
        digest_end(s->digest, NULL);
    free(s);
}

int ingest_begin(struct ingest **out, const char *path)
{
    int err;
    *out = NULL;
    if (strlen(path) + sizeof(".part") > PATH_MAX)
        return -ENAMETOOLONG;
    struct ingest *s = calloc(1, sizeof(*s));
    if (!s)
        return -ENOMEM;
    s->fd = -1;
    snprintf(s->path, sizeof(s->path), "%s", path);
    snprintf(s->part, sizeof(s->part), "%.*s.part", (int)(PATH_MAX - sizeof(".part")), path);
    if (!faccessat(AT_FDCWD, path, F_OK, AT_SYMLINK_NOFOLLOW)) {
        err = -EEXIST; // early, before a long download; the rename says so for certain
        goto fail;
    }
    // A part is of a process that died; should it still be writing, it writes to a file without a name.
    if (unlink(s->part) && errno != ENOENT) {
        err = -errno;
        goto fail;
    }
    s->fd = open(s->part, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC | O_NOFOLLOW, 0644);
    if (s->fd < 0) {
        err = -errno;
        goto fail;
    }
    s->digest = digest_begin();
    if (!s->digest) {
        unlink(s->part);
        err = -ENOMEM;
        goto fail;
    }
    *out = s;
    return 0;
fail:
    drop(s);
    return err;
}

int ingest_write(struct ingest *s, const void *bytes, size_t n)
{
    const char *from = bytes;
    for (size_t done = 0; done < n;) {
        const ssize_t wrote = write(s->fd, from + done, n - done);
        if (wrote < 0 && errno == EINTR)
            continue;
        if (wrote <= 0)
            return wrote ? -errno : -EIO;
        done += (size_t)wrote;
    }
    digest_add(s->digest, bytes, n);
    // Writing back starts now, so that the sync at the end has little left to wait for. Only a hint: its result says nothing.
    sync_file_range(s->fd, s->size, (off_t)n, SYNC_FILE_RANGE_WRITE);
    s->size += (int64_t)n;
    return 0;
}

int ingest_fd(const struct ingest *s)
{
    return s->fd;
}

static int sync_folder(const char *path)
{
    char copy[PATH_MAX];
    snprintf(copy, sizeof(copy), "%s", path);
    const int fd = open(dirname(copy), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (fd < 0)
        return -errno;
    const int err = fsync(fd) ? -errno : 0;
    close(fd);
    return err;
}

// Some file systems cannot rename without replacing; there a second link does, which fails when the name is taken.
static int name_it(const char *part, const char *path)
{
    if (!renameat2(AT_FDCWD, part, AT_FDCWD, path, RENAME_NOREPLACE))
        return 0;
    if (errno != EINVAL && errno != ENOSYS)
        return -errno;
    if (link(part, path))
        return -errno;
    return unlink(part) ? -errno : 0;
}

int ingest_finish(struct ingest *s, char xxh128[DIGEST_HEX], int64_t *size_bytes)
{
    char written[DIGEST_HEX], read_back[DIGEST_HEX];
    int64_t size = 0;
    digest_end(s->digest, written);
    s->digest = NULL;
    int err = fsync(s->fd) ? -errno : 0;
    const int fd = s->fd;
    s->fd = -1;
    if (close(fd) && !err)
        err = -errno; // some file systems report a failed write only here
    if (!err)
        err = digest_file(s->part, 1, read_back, &size);
    if (!err && (size != s->size || strcmp(written, read_back)))
        err = -EBADMSG;
    if (!err)
        err = name_it(s->part, s->path);
    if (err)
        unlink(s->part);
    if (!err)
        err = sync_folder(s->path); // the name is there, but not promised: the caller's next try finds a whole file
    if (!err) {
        memcpy(xxh128, written, DIGEST_HEX);
        *size_bytes = s->size;
    }
    drop(s);
    return err;
}

int ingest_adopt(const char *path, char xxh128[DIGEST_HEX], int64_t *size_bytes)
{
    const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW);
    if (fd < 0)
        return -errno;
    int err = fsync(fd) ? -errno : 0;
    close(fd);
    if (!err)
        err = digest_file(path, 1, xxh128, size_bytes);
    return err ? err : sync_folder(path);
}

void ingest_abort(struct ingest *s)
{
    if (!s)
        return;
    unlink(s->part);
    drop(s);
}
