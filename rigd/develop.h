// rigd/develop.h - raw files through LibRaw.
//
// Raws come from cameras and cards, and the decoders of a hundred formats are large: what is here runs in processes of its own
// (build/bin/rigd-unpack), which may die of a file without harm.
#pragma once
#include <stddef.h>

// Can every photosite be unpacked? 0. -EBADMSG: no, and why says what LibRaw found. -ENOTSUP: not a raw that it knows. -ENOMEM, -ENOENT.
int develop_check(const char *path, char *why, size_t room);
