// rigd/edges.h - which line changes when, in one shot.
//
// Pure: no thread, clock or wire. The owner asks when the next change is due, waits, steps, and sets what changed. However late
// a step comes, half-press never follows its full-press, no line is pressed for less than was asked, and none for longer than
// max_hold_ms.
#pragma once
#include "rigd/lines.h"
#include "rigd/trigger.h"

enum { EDGES_WIRES_MAX = 3 * CONFIG_CAMERAS_MAX + 2 };
#define EDGES_NEVER INT64_MAX
#define EDGES_LATE_MAX_NS INT64_C(250000000) // a press later than this is not done at all: the picture would be a surprise

enum edges_role { EDGES_FULL, EDGES_HALF, EDGES_RELAY, EDGES_N_ROLES };
#define EDGES_LINE_OF(camera, role) ((camera) * EDGES_N_ROLES + (int)(role)) // in the simulated rig

struct edges_wire {
    enum edges_role role;
    bool pressed;
    int64_t press_ns;   // when planned; EDGES_NEVER: not
    int64_t release_ns; // when pressed; EDGES_NEVER: with the last full-press that needs it
    int n_needed;       // half: full-presses that are not over
};

struct edges {
    const struct config *config;
    int n_wires;         // ordered: full (common first), half, relays
    struct edges_wire wire[EDGES_WIRES_MAX];
    struct lines_wire line[EDGES_WIRES_MAX];
    int full_of[CONFIG_CAMERAS_MAX], half_of[CONFIG_CAMERAS_MAX], relay_of[CONFIG_CAMERAS_MAX]; // wire; CONFIG_NONE
    // Per wire: the latest time it must be inactive again; 0: it is inactive. Shared with whoever else may cut it (the guard).
    _Atomic int64_t *limit_ns;
    bool pending;        // a shot is planned or under way
    bool in_shot[CONFIG_CAMERAS_MAX]; // half-pressed by it
    int64_t max_hold_ns, hold_ns;
    int64_t due_ns;      // of the first full-press
};

struct edges_step {
    uint64_t active[LINES_WORDS], changed[LINES_WORDS];
    bool any;          // something changed
    bool first;        // the first full-press of the shot is among it
    bool done;         // the shot is over
    bool cut;          // somebody else made a line inactive: it had reached its limit
    bool too_late;     // a press was due longer than EDGES_LATE_MAX_NS ago: the shot is given up, everything is inactive
};

// Lines of config; of_cameras: the simulated rig, where each camera has lines of its own (EDGES_LINE_OF). limit_ns: at least
// EDGES_WIRES_MAX, zeroed, kept. 0, or -EINVAL: a camera has no line to press (logged).
int edges_init(struct edges *e, const struct config *config, bool of_cameras, _Atomic int64_t *limit_ns);
unsigned edges_abilities(const struct edges *e); // of TRIGGER_...: half-press, delays, relays

// Bodies on a common line cannot be delayed one by one: that line gets the mean of their delays. As trigger_fire().
// -EINVAL also when half_ms, the longest delay and hold_ms together exceed max_hold_ms, or nobody is left to be pressed.
int edges_plan(struct edges *e, const struct trigger_shot *shot, int64_t now_ns);
int64_t edges_next_ns(const struct edges *e); // EDGES_NEVER: nothing to do
void edges_step(struct edges *e, int64_t now_ns, struct edges_step *out);
void edges_set(struct edges *e, const struct edges_step *step, int64_t now_ns); // the wires changed as late as that: presses of step count from now on
void edges_give_up(struct edges *e, bool relays, struct edges_step *out); // all shutters (and relays) inactive; no shot pending
void edges_relay(struct edges *e, int wire, bool cut, int64_t now_ns, struct edges_step *out);
