// rigd/lines.h - wires as the trigger sees them: outputs that change together, inputs that tell when they changed.
//
// The seam below trigger_lines.c: libgpiod (trigger_gpio.c), rigsim's shutter lines (trigger_sim.c), and a chip made of memory in
// the tests. Levels are logical: true is pressed, cut, closed; active-low wiring is the implementation's business.
// Times are CLOCK_MONOTONIC nanoseconds.
#pragma once
#include "rigd/config.h"

enum { LINES_WORDS = (3 * CONFIG_CAMERAS_MAX + 2 + 63) / 64 };

struct lines_wire {
    int line;        // as the chip counts
    bool active_low;
    char what[48];   // "camera A01: full_line", for people
};

struct lines_wanted {
    int n_outputs, n_inputs;
    const struct lines_wire *output, *input;
};

struct lines_edge {
    int input;     // index in lines_wanted.input
    bool active;
    int64_t at_ns;
};

struct lines_ops {
    bool timed;   // set() obeys at_ns by itself; otherwise it acts when it is called
    bool guarded; // set() works in a forked child as well, and an output outlives its process: worth a guard (trigger_lines.c)
    // Take the lines, every output inactive from the first instant on. wanted is not kept. Logs.
    int (*open)(void **self, const struct config *config, const struct lines_wanted *wanted);
    // active, changed: bit per output. Outputs that are not in changed have their old level in active. What can change in one call to
    // the kernel does; after a failure the rest is tried all the same. 0 or -errno, not logged. Any thread, one at a time.
    int (*set)(void *self, const uint64_t *active, const uint64_t *changed, int64_t at_ns);
    int (*fd)(const void *self);                                // readable: read()
    int (*read)(void *self, struct lines_edge *edge, int max);  // without waiting: how many, or -errno (logged): the lines are lost
    int (*level)(void *self, int input);                        // 0, 1 or -errno
    int (*head)(void *self, int32_t yaw_mdeg, int32_t pitch_mdeg); // as trigger_head(); NULL: there is none
    bool (*arrived)(void *self, int *err);                      // after read(): the head stands still, once per accepted head()
    void (*close)(void *self);                                  // NULL allowed
};
