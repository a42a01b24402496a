// tests/board/live_board.h - the board in simavr, paced by this machine's clock, as a device for usbfs.h: what a program under umockdev's preload
// finds is the real image behind its real USB controller.
//
// Its cycles are CLOCK_MONOTONIC's, times (1 + fast_ppm), from the start on: a transfer begins when the core has come as far as the
// clock has, neither before nor, while this machine is busy, after. simavr runs several times faster than the chip, so that it catches
// up; in tests time waits for it (board_time.h). So the true relation of both clocks is known, to the cycle, and what rigd believes can be compared with it.
#pragma once
#include "tests/board/simavr_board.h"
#include "tests/usb/usbfs.h"

struct live_board;

struct live_edge {
    int64_t at_ns;
    uint8_t outputs[SIMAVR_REGISTERS];
};

// image: build/firmware/... outputs, if not NULL, is called with each change, from the thread that moves the core. 0, -ENOENT (said), -ENOMEM.
int live_board_open(struct live_board **out, const char *image, double fast_ppm, void (*outputs)(void *arg, const struct live_edge *edge), void *arg);
void live_board_close(struct live_board *l);
// Behind umockdev: usbfs_new(..., &live_board_ops, live_board).
extern const struct usbfs_ops live_board_ops;
// As the kernel shows them: read from the image by control transfers, device and configuration. Length.
size_t live_board_descriptors(struct live_board *l, uint8_t *to, size_t room, char serial[40]);

// A hand, or a flash-sync contact: now, or at at_ns, at most 1024 waiting.
enum live_what { LIVE_BUTTON, LIVE_CAPTURE, LIVE_INPUT };
void live_board_set(struct live_board *l, enum live_what what, int input, bool closed, int64_t at_ns);
// What was latched since the last call: at most max, the oldest first.
int live_board_edges(struct live_board *l, struct live_edge *edge, int max);
void live_board_outputs(struct live_board *l, uint8_t outputs[SIMAVR_REGISTERS]);
bool live_board_led(struct live_board *l);
bool live_board_is_dead(struct live_board *l);
