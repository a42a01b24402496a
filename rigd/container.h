// rigd/container.h - does a copied frame look whole from outside?
//
// A light look at the container, by the name's extension: TIFF and the raws built on it (directories and the data they point
// at lie within the file), CR3 (boxes tile the file), RAF, JPEG (begins and ends as one). It finds short files and strangers
// that a camera announced with the size it sent; pixels are unpacked by rigd-unpack. Input is hostile.
#pragma once
#include <stddef.h>
#include <stdint.h>

// 0: whole as far as this can tell, or of a kind that is not known here. -EBADMSG: not, and why says what is (found, expected).
// Other -errno: fd cannot be read. name: of the object, its extension decides.
int container_check(int fd, int64_t size_bytes, const char *name, char *why, size_t room);
