// firmware/head.h - the panorama head: two axes of steps, each with limited speed and acceleration, homed at a switch.
//
// Positions are steps from home. head_beat() runs in an interrupt BOARD_HEAD_HZ times a second while something moves; the
// rest is the main loop's.
#pragma once
#include "firmware/protocol.h"

struct head_axis_config {
    uint8_t flags;            // PROTO_HEAD_...
    uint16_t speed, homing_speed; // steps/s
    uint32_t acceleration;    // steps/s^2
    int32_t lowest, highest;
};

void head_start(void); // nothing configured
uint8_t head_configure(uint8_t axis, const struct head_axis_config *config); // enum proto_error, as the rest
uint8_t head_move(const int32_t target[PROTO_AXES]);
uint8_t head_home(uint8_t axes, bool here);
void head_stop(void);           // decelerates
void head_forget(void);         // at once, and positions are not known any more
bool head_is_moving(void);
bool head_take_still(uint8_t *result); // true once after each movement
int32_t head_position(uint8_t axis);
uint8_t head_homed(void);       // bit per axis
uint8_t head_moving(void);
uint8_t head_switches(void);    // home switches met

void head_beat(void);
