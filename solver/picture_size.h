// solver/picture_size.h - how many pixels a picture has, from its header alone.
#pragma once
#include <stdio.h>

// OpenEXR (display window), TIFF and BigTIFF, PNG, JPEG, Radiance .hdr, by content. 0; -errno of the open; -EINVAL (none of
// these, cut short, or no sane size: 1 to 65,536 a side). Not logged: the caller knows whether it matters.
int picture_size(int *width_px, int *height_px, const char *path);
int picture_size_stream(int *width_px, int *height_px, FILE *f); // the same; f is left open, anywhere
