// rigd/board_clock.h - what the trigger board's counter shows at a given CLOCK_MONOTONIC time, and how sure that is.
//
// Pure. Each round trip (sent, stamped by the board, received) says two things for certain: the stamp is not before the host sent and
// not after it received. Delays of USB are never negative, long ones prove little, and short ones bind: so the relation is not a mean
// of round trips but the set of all straight lines that none of them contradicts (in offset and drift a convex polygon), its centroid the
// estimate and its corners the uncertainty. The shortest delay out and the shortest delay back need not fall into the same round trip,
// and a late answer is no outlier to be recognised: it just does not bind. What no round trip can tell, which part of the shortest one
// was spent on the way out, stays in the polygon and so in the uncertainty.
#pragma once
#include <stdbool.h>
#include <stdint.h>

enum {
    BOARD_CLOCK_ROUNDS = 512,        // the latest so many count
    BOARD_CLOCK_CORNERS_MAX = 2 * BOARD_CLOCK_ROUNDS + 4,
    BOARD_CLOCK_DRIFT_MAX_PPM = 2500, // USB allows a full-speed device no more; crystals stay below 100
    BOARD_CLOCK_WANDER_NS = 50,    // drift changes by at most so many nanoseconds per second, each second (warming up)
    BOARD_CLOCK_LIES_MAX = 4,      // so many round trips in a row that contradict: the counter was set anew, all before is forgotten
};

struct board_clock {
    double ticks_per_s; // nominal
    struct {
        int64_t sent_ns, received_ns, ticks;
    } round[BOARD_CLOCK_ROUNDS];
    int n, next, n_lies;
    // Lines since the newest round trip: offset in ns, drift in ns per nominal second.
    int64_t ticks, ns;
    double offset_ns, drift;
    struct { double offset_ns, drift; } corner[BOARD_CLOCK_CORNERS_MAX];
    int n_corners; // 0: nothing is known yet
};

void board_clock_init(struct board_clock *c, double ticks_per_s);
// One round trip; ticks: the board's counter, not wrapping (board_clock_unwrap). False: it contradicts the others and does not count, or
// is impossible in itself; after BOARD_CLOCK_LIES_MAX in a row the clock begins anew.
bool board_clock_add(struct board_clock *c, int64_t sent_ns, int64_t received_ns, int64_t ticks);
bool board_clock_is_known(const struct board_clock *c);
// Only of a clock that is known, and not more than a day from its newest round trip. Rounded to the nearest.
int64_t board_clock_ns(const struct board_clock *c, int64_t ticks);
int64_t board_clock_ticks(const struct board_clock *c, int64_t ns);
// How far board_clock_ns() of that instant may be off, either way; while drift wanders no faster than assumed above, it is not further.
int64_t board_clock_uncertainty_ns(const struct board_clock *c, int64_t at_ns);
// Parts per million by which the board's counter is fast, and how far that may be off.
double board_clock_fast_ppm(const struct board_clock *c, double *uncertainty_ppm);

// The full count whose low 32 bits are these, next to one that is near in time (less than half a turn away).
int64_t board_clock_unwrap(int64_t near_ticks, uint32_t low);
