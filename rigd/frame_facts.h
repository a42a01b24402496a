// rigd/frame_facts.h - what a raw says about itself and its light: how rigd-unpack tells rigd-camera, that one rigd, and rigd take.json.
//
// Numbers that come from outside are checked: finite, within what a camera can be.
#pragma once
#include "rigd/bracket.h"

struct frame_facts {
    double f_number, iso; // 0: the file does not say
    char serial[64];      // of the body; "" likewise
    struct bracket_statistics light;
};

struct json *frame_facts_json(const struct frame_facts *f);
int frame_facts_from_json(struct frame_facts *out, const struct json *v); // 0, or -EINVAL (not logged); *out is zeroed then
