// tests/board/board_time.h - CLOCK_MONOTONIC as far as the simulated board has come.
//
// The board's core has to be computed in real time; on a machine that is too busy for that, or stands still for a while, it falls behind, and the
// host seems dead to it, or it to the host. In programs linked with --wrap=clock_gettime and --wrap=pthread_cond_timedwait time does not go on
// meanwhile: for the code under test, for the test, and for other processes of the same program. Whoever sleeps by other means sleeps in real time.
#pragma once
#include <stdint.h>

// From here on, in this process and in those that it starts and that call this as well. Without it, time is what it always was. 0 or -errno.
int board_time_share(void);
int64_t board_time_ns(void);
// The core has come as far as that: by whoever moves it, one at a time. INT64_MAX: there is none.
void board_time_reached(int64_t ns);
