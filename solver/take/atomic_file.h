// solver/take/atomic_file.h - a file that is whole or not there.
//
// Bytes go to a temporary name in the same folder; commit does fsync, rename, fsync of the folder.
// A process killed at any moment leaves the old file, or the new one, and at worst a stray
// ".NAME.XXXXXX.part" that nobody reads.
#pragma once
#include <stddef.h>
#include <stdio.h>

struct atomic_file {
    FILE *stream;    // write here; NULL when not open
    char *path;      // final name
    char *part_path; // the name until commit
};

// Returns 0 or -errno (logged). On failure *f is zeroed.
int atomic_file_open(struct atomic_file *f, const char *path);
// Flush, sync, rename. Returns 0 or -errno (logged, the partial file removed). *f is closed either way.
int atomic_file_commit(struct atomic_file *f);
// Give up: close and remove the partial file. Harmless after commit or on a zeroed struct.
void atomic_file_abandon(struct atomic_file *f);

// For libraries that insist on writing by name: allocates the partial name, then commits it (same promises).
// part_path comes from atomic_file_part_path(); the caller frees it. Returns 0 or -errno (logged).
char *atomic_file_part_path(const char *path);
int atomic_file_commit_path(const char *part_path, const char *path);

// Create dir and its parents. 0 or -errno (logged).
int make_directories(const char *dir);

// The other direction: a whole file of at most max_bytes into *bytes (malloc'd, a NUL after the last byte, never NULL on success).
// A regular file or a pipe; a folder is -EISDIR, a device -EINVAL. 0 or -errno (logged): -errno of the open or the read, -EFBIG,
// -ENOMEM. *bytes is NULL on failure.
int file_read(char **bytes, size_t *n_bytes, const char *path, size_t max_bytes);
