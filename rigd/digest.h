// rigd/digest.h - the hashes of the hand-over: xxh128 of frames, C4 (SHA-512) of manifests.
#pragma once
#include <stddef.h>
#include <stdint.h>

enum { DIGEST_HEX = 33, DIGEST_C4 = 91 }; // with the NUL

struct digest; // a running xxh128

struct digest *digest_begin(void); // NULL without memory
void digest_add(struct digest *d, const void *bytes, size_t n);
void digest_end(struct digest *d, char hex[DIGEST_HEX]); // frees d; hex may be NULL. 32 lower-case digits, big-endian as xxhsum -H2

// Of what is on disk: from_disk drops the page cache first, so that a read-back reads back. 0 or -errno (not logged).
int digest_file(const char *path, int from_disk, char hex[DIGEST_HEX], int64_t *size_bytes);

// C4 identification (SMPTE ST 2114): "c4" and 88 characters of base 58 over SHA-512.
void digest_c4(const void *bytes, size_t n, char c4[DIGEST_C4]);
