// firmware/button.c - the capture button without its bounce.
#include "firmware/button.h"

void button_start(struct button *b, uint16_t debounce_ms, bool pressed)
{
    *b = (struct button){ .pressed = pressed, .debounce_ms = debounce_ms };
}

void button_edge(struct button *b, uint64_t now)
{
    b->back_ms = b->stable_ms = 0; // also a bounce between two looks
    if (b->has_first)
        return;
    b->has_first = true;
    b->first = now;
}

bool button_ms(struct button *b, bool level, uint64_t now)
{
    if (level == b->pressed) {
        b->stable_ms = 0;
        // A bounce that takes longer than the debouncing was something else: noise.
        if (b->has_first && b->back_ms++ >= b->debounce_ms)
            b->has_first = false;
        return false;
    }
    b->back_ms = 0;
    if (!b->has_first) { // an edge too short for the interrupt
        b->has_first = true;
        b->first = now;
    }
    if (b->stable_ms++ < b->debounce_ms)
        return false;
    b->pressed = level;
    b->stable_ms = 0;
    b->has_first = false;
    return true;
}
