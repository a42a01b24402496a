// rigd/resting.h - large arrays in a file without a name: what is not looked at for a while takes no memory.
#pragma once
#include <stddef.h>

// n_bytes of zeros, mapped from a file in folder that is gone with its mapping, or with the process. Its space on the disk is taken at once: a disk
// that fills later does no harm. NULL: it cannot be made there (no space, or a file system that does not know such files).
void *resting_new(const char *folder, size_t n_bytes);
void resting_free(void *data, size_t n_bytes); // data NULL allowed

// The whole pages between the bytes begin and end of data, which is ours alone, take no memory from here on. A file keeps what was written and gives it
// back when it is looked at; memory that is no file's is forgotten, and must not be looked at again.
void resting_leave(void *data, size_t begin, size_t end);
