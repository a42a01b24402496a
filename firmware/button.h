// firmware/button.h - the capture button without its bounce. Called in interrupts; pure.
//
// A change counts when the level has been stable for debounce_ms; its time is that of the first contact.
#pragma once
#include <stdbool.h>
#include <stdint.h>

struct button {
    bool pressed;
    bool has_first;
    uint16_t debounce_ms, stable_ms, back_ms; // at the other level; back again at the old one
    uint64_t first; // first contact of the change under way
};

void button_start(struct button *b, uint16_t debounce_ms, bool pressed);
void button_edge(struct button *b, uint64_t now);           // any edge of the pin
bool button_ms(struct button *b, bool level, uint64_t now); // each millisecond; true: `pressed` changed, at `first`
