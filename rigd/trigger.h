// rigd/trigger.h - press every shutter of the rig at one instant, and hear what happened.
//
// A trigger is the wiring to all cameras, whatever carries it: GPIO lines, the USB board, the cameras' own drivers (software,
// unsynchronised) or the simulated rig. Times are CLOCK_MONOTONIC nanoseconds. Call from the loop thread only; the callbacks come
// from within trigger_dispatch(). No shutter and no relay stays asserted longer than config's max_hold_ms: not after a refused
// call, a broken link, trigger_close(), or the end of the process by any signal (where the hardware can know; trigger_gpio.c
// says which).
#pragma once
#include "rigd/config.h"

struct trigger;

// Borrowed until trigger_close(). arg is the first argument of each.
struct trigger_host {
    // Once per accepted trigger_fire(), after the last release. err: 0, or -EIO (a line or the link failed; all are released).
    // pressed_ns: when the first full-press line really went down, late_ns: how much after its due time (the host's jitter).
    void (*fired)(void *arg, int err, int64_t pressed_ns, int64_t late_ns);
    void (*feedback)(void *arg, int camera, int64_t at_ns); // a body's flash-sync contact closed
    void (*button)(void *arg, int64_t at_ns);               // pressed, debounced
    void (*press_camera)(void *arg, int camera);            // software kind only: send CAMERA_TRIGGER now
    void (*broken)(void *arg, int err);                     // the trigger is gone; close it, open again later
    // Once per accepted trigger_head(), when the head stands still: 0, or -EIO, -ETIME (it did not get there), -ECANCELED. NULL: unheard.
    void (*head_arrived)(void *arg, int err);
    void *arg;
};

enum { // trigger_abilities()
    TRIGGER_SYNCHRONISED = 1, // one instant for all
    TRIGGER_HALF_PRESS = 2,
    TRIGGER_DELAYS = 4,       // a delay per camera
    TRIGGER_FEEDBACK = 8,
    TRIGGER_BUTTON = 16,
    TRIGGER_RELAYS = 32,
    TRIGGER_HEAD = 64,        // a motorised panorama head
    TRIGGER_WAITS = 128,      // a shot may wait for the button
};

struct trigger_shot {
    int64_t at_ns;           // full-press of a camera without delay; half-press comes half_ms earlier
    uint32_t half_ms, hold_ms; // half 0: none. hold: full-press, then both lines are released
    const uint32_t *delay_us; // per camera, n_cameras of them, or NULL; kept by the caller until fired(). < 1 s each
    const uint64_t *skip;     // bit per camera that must not be pressed (quarantined), or NULL; likewise kept
    // Half-press comes with the press of the button, full-press half_ms later, with no decision of this host in between; at_ns does not
    // count. button() is not called for this press. Waits until then, or for trigger_release(). Only with TRIGGER_WAITS.
    bool on_button;
};

// Take the lines named in config and leave every one released. config and host are kept.
// 0, -EINVAL (no such line), -EBUSY (line held elsewhere), -ENODEV, -EACCES: logged with chip, line, holder and remedy.
int trigger_open(struct trigger **out, const struct config *config, const struct trigger_host *host);
unsigned trigger_abilities(const struct trigger *t);

// 0, -ETIME (at_ns - half_ms has passed), -EBUSY (a shot is pending), -EINVAL (hold or a delay beyond its limit, half_ms, the longest
// delay and hold_ms together beyond max_hold_ms, nobody left to press), -EIO (broken),
// -ENOTSUP (on_button). Takes as long as it takes to load the shot into a board: up to .1 s for 200 cameras.
int trigger_fire(struct trigger *t, const struct trigger_shot *shot);
void trigger_release(struct trigger *t); // at once, also in the middle of a shot: fired() then comes with -ECANCELED

// Cut (true) or give (false) the supply of one camera; after max_hold_ms it is given back anyway. 0, -ENOTSUP, -EIO.
int trigger_relay(struct trigger *t, int camera, bool cut);

// Turn the panorama head, in thousandths of a degree from where it stood when it was last homed: yaw to the left seen from above,
// pitch up. 0 (head_arrived() will come), -EBUSY (it moves, or a shot is pending), -EINVAL (beyond its limits), -ENOTSUP, -EIO.
int trigger_head(struct trigger *t, int32_t yaw_mdeg, int32_t pitch_mdeg);

// Blink: which of the boards in the studio this one is. It stops by itself after ms (up to 65535). 0, -ENOTSUP (it has no light), -EIO.
int trigger_identify(struct trigger *t, int ms);

// For the loop: when fd is readable, call dispatch.
int trigger_fd(const struct trigger *t);
void trigger_dispatch(struct trigger *t);

// Release all lines and free t. NULL is allowed.
void trigger_close(struct trigger *t);

// One per way to press; trigger.c chooses by config->trigger.kind. `self` is the implementation's own.
struct trigger_ops {
    int (*open)(void **self, const struct config *config, const struct trigger_host *host);
    unsigned (*abilities)(const void *self);
    int (*fire)(void *self, const struct trigger_shot *shot);
    void (*release)(void *self);
    int (*relay)(void *self, int camera, bool cut); // NULL: none
    int (*head)(void *self, int32_t yaw_mdeg, int32_t pitch_mdeg); // NULL: none
    int (*identify)(void *self, int ms); // NULL: no light
    int (*fd)(const void *self);
    void (*dispatch)(void *self);
    void (*close)(void *self);
};
extern const struct trigger_ops trigger_software, trigger_gpio, trigger_usb, trigger_simulated;
