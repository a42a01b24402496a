// solver/take/atomic_file.c - write beside, sync, rename; and read a whole file.
//
// Names are drawn here instead of by mkstemp: that one makes files only their owner may read.
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <unistd.h>

static const char *hint(int err)
{
    switch (-err) {
    case ENOSPC:
    case EDQUOT:
        return ": free some space and run again";
    case EACCES:
    case EPERM:
    case EROFS:
        return ": choose a folder you may write to";
    case ENOENT:
        return ": create its folder first";
    default:
        return "";
    }
}

static int failed(const char *what, const char *path, int err)
{
    log_error("file: cannot %s %s: %s%s", what, path, strerror(-err), hint(err));
    return err;
}

// The folder part of path, malloc'd: "a/b/c" -> "a/b", "c" -> ".", "/c" -> "/".
static char *folder_of(const char *path)
{
    const char *slash = strrchr(path, '/');
    if (!slash)
        return strdup(".");
    return strndup(path, slash == path ? 1 : (size_t)(slash - path));
}

char *atomic_file_part_path(const char *path)
{
    static const char letters[] = "abcdefghijklmnopqrstuvwxyz234567";
    uint32_t random = 0;
    char tag[7];
    char *part = NULL;
    if (getrandom(&random, sizeof(random), GRND_NONBLOCK) != (ssize_t)sizeof(random))
        random = (uint32_t)getpid(); // O_EXCL below finds a free name all the same
    for (int i = 0; i < 6; i++, random >>= 5)
        tag[i] = letters[random & 31];
    tag[6] = 0;
    const char *slash = strrchr(path, '/');
    const char *name = slash ? slash + 1 : path;
    if (asprintf(&part, "%.*s.%s.%s.part", (int)(name - path), path, name, tag) < 0)
        return NULL;
    return part;
}

// Renaming onto a device or a folder would destroy it or fail late.
static int check_target(const char *path)
{
    struct stat st;
    const size_t n = strlen(path);
    if (n == 0 || path[n - 1] == '/')
        return failed("write", n ? path : "a file without a name", -EISDIR);
    if (stat(path, &st) || S_ISREG(st.st_mode))
        return 0;
    if (S_ISDIR(st.st_mode))
        return failed("write", path, -EISDIR);
    log_error("file: cannot write %s: found a device, expected a regular file", path);
    return -EINVAL;
}

int atomic_file_open(struct atomic_file *f, const char *path)
{
    int fd = -1;
    *f = (struct atomic_file){ 0 };
    int err = check_target(path);
    if (err)
        return err;
    f->path = strdup(path);
    if (!f->path) {
        err = -ENOMEM;
        goto fail;
    }
    for (int attempt = 0; fd < 0 && attempt < 100; attempt++) {
        free(f->part_path);
        f->part_path = atomic_file_part_path(path);
        if (!f->part_path) {
            err = -ENOMEM;
            goto fail;
        }
        fd = open(f->part_path, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
        if (fd < 0 && errno != EEXIST)
            break;
    }
    if (fd < 0) {
        err = -errno;
        free(f->part_path);
        f->part_path = NULL; // not ours to remove
        goto fail;
    }
    f->stream = fdopen(fd, "w+");
    if (!f->stream) {
        err = -errno;
        close(fd);
        goto fail;
    }
    return 0;
fail:
    failed("create", path, err);
    atomic_file_abandon(f);
    return err;
}

void atomic_file_abandon(struct atomic_file *f)
{
    if (f->stream)
        fclose(f->stream);
    if (f->part_path)
        unlink(f->part_path);
    free(f->part_path);
    free(f->path);
    *f = (struct atomic_file){ 0 };
}

// Some file systems cannot sync a folder and say so with EINVAL; the rename has happened all the
// same.
static int sync_folder(const char *path)
{
    int err = 0;
    char *folder = folder_of(path);
    if (!folder)
        return -ENOMEM;
    const int fd = open(folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (fd < 0 || fsync(fd))
        err = errno == EINVAL || errno == EACCES || errno == ENOTSUP ? 0 : -errno;
    if (fd >= 0)
        close(fd);
    free(folder);
    return err;
}

static int rename_and_sync(const char *part_path, const char *path)
{
    if (rename(part_path, path))
        return -errno;
    return sync_folder(path);
}

int atomic_file_commit(struct atomic_file *f)
{
    int err = 0;
    errno = 0;
    if (ferror(f->stream))
        err = -EIO;
    if (fflush(f->stream) || fsync(fileno(f->stream)))
        err = errno ? -errno : -EIO;
    if (fclose(f->stream) && !err)
        err = errno ? -errno : -EIO;
    f->stream = NULL;
    if (!err)
        err = rename_and_sync(f->part_path, f->path);
    if (err)
        failed("write", f->path, err);
    atomic_file_abandon(f); // after a rename there is nothing left of that name
    return err;
}

int atomic_file_commit_path(const char *part_path, const char *path)
{
    int err = check_target(path);
    if (err) {
        unlink(part_path);
        return err;
    }
    const int fd = open(part_path, O_RDONLY | O_CLOEXEC);
    if (fd < 0 || fsync(fd))
        err = -errno;
    if (fd >= 0 && close(fd) && !err)
        err = -errno;
    if (!err)
        err = rename_and_sync(part_path, path);
    if (!err)
        return 0;
    unlink(part_path);
    return failed("write", path, err);
}

int make_directories(const char *dir)
{
    struct stat st;
    char *path = strdup(dir);
    if (!path)
        return failed("create folder", dir, -ENOMEM);
    int err = 0;
    const size_t n = strlen(path);
    for (size_t i = 1; i <= n && !err; i++) {
        if (path[i] != '/' && path[i] != 0)
            continue;
        const char kept = path[i];
        path[i] = 0;
        if (mkdir(path, 0777)) {
            err = -errno;
            if (stat(path, &st) == 0)
                err = S_ISDIR(st.st_mode) ? 0 : -ENOTDIR;
        }
        if (err)
            failed("create folder", path, err);
        path[i] = kept;
    }
    if (n == 0)
        err = failed("create folder", "without a name", -ENOENT);
    free(path);
    return err;
}

int file_read(char **bytes, size_t *n_bytes, const char *path, size_t max_bytes)
{
    struct stat st;
    char *data = NULL;
    size_t n = 0, room = 65536; // a first guess: pipes have no size, and files grow
    int err;
    *bytes = NULL;
    *n_bytes = 0;
    const int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0 || fstat(fd, &st)) {
        err = -errno;
        log_error("file: cannot open %s: %s", path, strerror(-err));
        goto fail;
    }
    if (!S_ISREG(st.st_mode) && !S_ISFIFO(st.st_mode)) {
        err = S_ISDIR(st.st_mode) ? -EISDIR : -EINVAL;
        log_error("file: cannot read %s: it is %s; expected a file", path,
                  S_ISDIR(st.st_mode) ? "a folder" : "a device or socket");
        goto fail;
    }
    if (S_ISREG(st.st_mode) && st.st_size > 0)
        room = (size_t)st.st_size;
    else if (room > max_bytes)
        room = max_bytes;
    for (size_t allocated = 0;;) {
        if (room > max_bytes) {
            err = -EFBIG;
            log_error("file: cannot read %s: larger than %zu bytes, the most that is read here",
                      path, max_bytes);
            goto fail;
        }
        if (allocated < room + 2) { // one byte to see the end, one for the NUL
            char *grown = realloc(data, room + 2);
            if (!grown) {
                err = failed("read", path, -ENOMEM);
                goto fail;
            }
            data = grown;
            allocated = room + 2;
        }
        const ssize_t got = read(fd, data + n, room + 1 - n);
        if (got == 0)
            break;
        if (got < 0 && errno != EINTR) {
            err = failed("read", path, -errno);
            goto fail;
        }
        n += got > 0 ? (size_t)got : 0;
        if (n > room) // there is more
            room = n <= max_bytes && n > max_bytes / 2 ? max_bytes : n * 2;
    }
    close(fd);
    data[n] = 0;
    *bytes = data;
    *n_bytes = n;
    return 0;
fail:
    if (fd >= 0)
        close(fd);
    free(data);
    return err;
}
