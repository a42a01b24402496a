// rigd/ingest.h - copy a frame so that nothing under its final name is ever partial, unsynced or unlike what was hashed.
//
// PATH.part is written and hashed, synced, read back from the disk and compared, renamed without replacing anything, and the
// folder is synced. Whoever dies in between leaves PATH.part, which the next start removes. Nothing here is logged: the caller
// tells people, with the name of the camera.
#pragma once
#include "rigd/digest.h"
#include <stddef.h>
#include <stdint.h>

struct ingest;

// 0, -EEXIST (something has that name), -ENOENT (no such folder), -ENOSPC, -EACCES, ...
int ingest_begin(struct ingest **out, const char *path);
int ingest_write(struct ingest *s, const void *bytes, size_t n); // 0 or -errno
// The file as far as it is written, for a look inside before it gets its name. Stays the ingest's.
int ingest_fd(const struct ingest *s);
// Make it durable, prove it, name it. 0, -EBADMSG (read back differently: the disk lies), -EEXIST, other -errno. s is freed.
int ingest_finish(struct ingest *s, char xxh128[DIGEST_HEX], int64_t *size_bytes);
// A copy that has its name already, from a life before: make sure that it is durable, and hash it. 0 or -errno.
int ingest_adopt(const char *path, char xxh128[DIGEST_HEX], int64_t *size_bytes);
void ingest_abort(struct ingest *s); // frees s and removes the part. NULL allowed
