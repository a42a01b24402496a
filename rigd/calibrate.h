// rigd/calibrate.h - how late each body's shutter opens, from its flash-sync contact, and what to do about it.
//
// Pure. Lag is flash-sync closing minus full-press, in milliseconds; bodies differ by tens, one body scatters by a few, and one
// that dozed off adds 200 (RIG.md 1.6). The estimator must survive those.
#pragma once
#include "rigd/config.h"

struct lag {
    double mean_ms, std_ms;
    double error_ms;  // standard error of the mean, 95 %
    int n, n_rejected; // used; further than 5 robust sigmas from the median
};

// n measurements in order of time. 0; -ENODATA for fewer than 3.
int lag_estimate(struct lag *out, const double *lag_ms, int n);

// How many shots more until the means of all bodies lie within within_ms of the truth, 99 times in 100 for the worst of them; 0: they
// do. A body that scatters so much that it would take more than `most` is not waited for: its error_ms says what it is.
int lag_more_shots(const struct lag *lag, int n_cameras, double within_ms, int most);

// Delays that make all shutters open together: the slowest waits 0. Bodies with n == 0 are given the mean of the others.
// delay_us[i] is at most max_us; returns how many would have needed more (0: all compensated).
int lag_delays(const struct lag *lag, int n_cameras, uint32_t max_us, uint32_t *delay_us);

// One shot, measured: press of each body at_ns (INT64_MIN: no feedback). late: further than late_ns from the median.
struct shot_timing {
    int n_measured, n_late;
    int64_t spread_ns; // last minus first
    int64_t sigma_ns;
    uint64_t late[CONFIG_CAMERAS_MAX / 64];
};
void shot_timing(struct shot_timing *out, const int64_t *at_ns, int n_cameras, int64_t late_ns);

// state_dir/lag.json, by serial number so that a swapped body does not inherit. 0 or -errno (logged; -ENOENT silent).
int lag_write(const char *path, const struct config *config, const char *const *serial, const struct lag *lag, const char *measured);
int lag_read(const char *path, const struct config *config, struct lag *lag); // bodies without an entry: n = 0
