// rigd/manifest.h - ASC MHL v2: a hand-over manifest that other people's tools can check.
//
// DIR/ascmhl/NNNN_<folder>_<date>_<time>Z.mhl lists every file with size and xxh128; ascmhl_chain.xml lists the generations with
// their C4 hashes. take.json, processing.json, log/, temporary files and ascmhl itself are not listed (they are named in <ignore>).
#pragma once
#include <stdbool.h>
#include <stdint.h>

// A hash that is already known (computed and read back at ingest), so that a file need not be read again. path is relative.
struct manifest_known {
    const char *path;
    const char *xxh128;
    int64_t size_bytes;
};

// Add a generation over all files in dir (known hashes are used where path and size agree; the rest is read). utc_s: now.
// Files of the last generation whose hash changed or that are gone are reported and the generation says "failed" for them.
// Nothing is written when there is no file: the schema wants one. 0; -EBADMSG: something differs from the last generation
// (logged), and a new one says so; other -errno: nothing written (logged).
int manifest_write(const char *dir, const struct manifest_known *known, int n_known, int64_t utc_s);

struct manifest_findings { int n_files, n_changed, n_missing, n_new; };
// Check dir against its last generation, and the generations against the chain. 0, -EBADMSG (logged, file by file), -ENOENT, -EINVAL.
int manifest_verify(const char *dir, struct manifest_findings *found);
