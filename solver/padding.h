// solver/padding.h - are the charts of an atlas far enough apart for a texture of this size?
//
// Who reads a texture bilinearly at a chart's border reads up to a texel beyond it, and so does the chart on the other side: less
// than two texels between them, and either shows the other's colour. Only neighbours in the atlas that are no neighbours on the
// surface count: the two sides of a cut may lie together, and so may what a texel or two lies apart on the surface as well. One chart may be too near to itself, too.
#pragma once
#include "solver/mesh.h"
#include "solver/texels.h"
#include <stddef.h>

struct padding {
    int size;        // the texture's
    double gap_px;   // texels between such charts where they are closest (a thousandth of the surface aside); 2 where none is closer
    double share;    // of the surface: may show another part's colour, the gutter filled with that of the nearest texel
    int enough_size; // a texture that keeps apart what this one does not, or 0: --texture takes none that does; charts touch
};

// Of the texture that t was rasterised for. Where charts lie on each other (mesh_check says so) nothing is measured, nor in an atlas
// with more than 2^22 edges of charts. 0 or -ENOMEM. Pure; linear in triangles and texels whatever the atlas looks like.
int padding_measure(struct padding *out, const struct mesh *mesh, const struct texels *t);

// Is it worth a word? More than a thousandth of the surface is. text: what is found, and what to do.
bool padding_is_short(const struct padding *p);
enum { PADDING_TEXT = 640 }; // enough for it
void padding_text(char *text, size_t n, const struct padding *p);
