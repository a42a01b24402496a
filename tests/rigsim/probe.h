// tests/rigsim/probe.h - what a panorama camera sees: a latitude-longitude picture through its lens, at the head's present angles.
//
// The picture's pixels are areas of one radiance. A site gathers what falls on 2 x 2 sites around its centre, as behind the optical
// low-pass of a real sensor, exactly: its outline is cut against the picture's pixels on the cylinder of equal areas. So the sites of
// one colour cover the frame once, and no light is between them, however small.
#pragma once
#include "rigd/lens.h"
#include "tests/rigsim/scene.h"

struct probe;

// lens: rigd/lens.h's JSON, or a file of it; the frame's size is width_px x height_px, which it need not repeat. gain: scene values per
// radiance (2^-EV of a neutral-density filter). Errors, logged: those of panorama_read and lens_from_json; -ENOMEM.
int probe_open(struct probe **out, const char *panorama, const char *lens, double gain, int width_px, int height_px);
int probe_lens(struct lens *out, const char *lens, int width_px, int height_px); // the lens alone
void probe_close(struct probe *p); // NULL allowed
int probe_width(const struct probe *p);
int probe_height(const struct probe *p);
// As scene_row().
void probe_row(struct probe *p, const struct scene_view *view, int y, float *site);
