// tests/rigsim/frame.h - the bytes of a camera's files, made again whenever they are asked for.
//
// A raw's site: DN = black + gain x (electrons + shot noise + read noise), rounded, clipped at white level and 0;
//   electrons at ISO 100's white level = full_well_e, and the scene's 1 reaches it at t_ref_s, n_ref (personality.h).
// ISO, aperture and time count as they are written into EXIF. Noise is named by (seed, camera, shot, site): same seed, same bytes, in
// whatever order and pieces they are read. JPEGs: the frame developed to sRGB, 640 pixels wide; thumbnails: 160.
#pragma once
#include "tests/rigsim/body.h"
#include "tests/rigsim/dataset.h"
#include "tests/rigsim/scene.h"

struct frame;
int frame_open(struct frame **out, struct scene *scene, const struct body *b, const struct exposure *e, int file);
uint64_t frame_size(const struct frame *f);
// Exactly n bytes from offset; offset + n <= size.
void frame_read(struct frame *f, uint64_t offset, uint8_t *to, size_t n);
void frame_close(struct frame *f); // NULL allowed
// struct body's measure; arg: the scene. 0 without memory.
uint64_t frame_measure(void *arg, const struct body *b, const struct exposure *e, int file);
// struct ptp_session's thumbnail; arg: the scene.
int frame_thumbnail(void *arg, const struct body *b, const struct body_object *o, struct dataset *out);
