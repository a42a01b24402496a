// rigd/stops.h - where a panorama head has to stop so that a lens sees the whole sphere.
//
// Pure.
#pragma once
#include "rigd/config.h"

// Rows of constant pitch from the lowest to the highest; neighbours share the part `overlap` of what the lens sees across and down.
// How many; 0: more than max.
int stops_plan(struct config_stop *out, int max, const struct lens *lens, double overlap);
