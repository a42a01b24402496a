// rigd/shutter_line.h - the wires of the simulated rig: shutter cables in, flash-sync contacts out.
//
// rigsim --trigger-socket PATH listens on a Unix socket of type SOCK_SEQPACKET (a message is a packet; an abstract name is
// written "@name"). Whoever drives shutters (rigd's simulated trigger, the simulated board) connects to it; any number of
// clients may. A packet holds 1 .. SHUTTER_LINE_PER_PACKET records of struct shutter_line, all in the machine's own byte order:
// both ends are on one machine. Times are CLOCK_MONOTONIC nanoseconds.
//
// To rigsim - a change of a line:
//   kind = SHUTTER_LINE_SET, line = half press, full press or power, level = 1 (contact closed: pressed) or 0, channel = camera's index
//   (0 = first, as --list prints them) or SHUTTER_LINE_ALL, at_ns = when the contact changes. at_ns may lie in the past (0:
//   now; the change then happens at once, but shutter lag counts from at_ns, so that a late process does not shift the
//   exposure) and up to 60 s in the future. Changes of one line must come in the order of their times. tag: any number; it
//   comes back in what this change causes.
//   kind = SHUTTER_LINE_HEAD: turn the panorama head to yaw_mdeg (to the left seen from above; -720,000 .. 720,000) and pitch_mdeg (up;
//   -90,000 .. 90,000), thousandths of a degree; the other fields but tag are 0.
// From rigsim - to every connected client:
//   kind = SHUTTER_LINE_SYNC: the flash-sync contact of camera `channel`: closed at at_ns (the first instant at which the whole
//   frame is exposed: this is the measured exposure time), open again at end_ns (the exposure's end); lag_ns = at_ns minus the
//   instant at which full-press closed. Sent when the exposure has ended, as a real contact is seen only when it moves; a body
//   that did not fire sends nothing. tag is that of the press; 0 for a release over the wire (PTP).
//   kind = SHUTTER_LINE_ARRIVED: to the sender of SHUTTER_LINE_HEAD only, with its tag: the head stands still since at_ns, at yaw_mdeg and
//   pitch_mdeg; error: 0, or ETIME if it did not get where it should.
//   kind = SHUTTER_LINE_REFUSED: to the sender only: that record was not done; `error` is an errno value: EINVAL (kind, line
//   or level unknown, or a packet of another size), ENODEV (no such channel), ETIME (more than 60 s ahead), ENOSPC (over 64
//   changes waiting on one channel), ENXIO (the body has no power), EBUSY (the head moves).
// The relay of a camera's supply is a line, too: SHUTTER_LINE_POWER, level 1 = cut (the body is off, its links break; its card
// survives), 0 = given (it boots for a second, settings as before).
// When the last client leaves, every line opens and every supply is given: a dead host never leaves a shutter pressed.
//
// Half-press: with a body whose personality says half_press_blocks_usb = yes (most do) its PTP connection does not answer
// while half-press or full-press is closed. Full-press alone works, too, with the same lag; a body that slept (2 s without
// traffic or half-press) takes 200 ms longer unless half-press was closed that long before.
#pragma once
#include <stdint.h>

enum { SHUTTER_LINE_PER_PACKET = 512, SHUTTER_LINE_PENDING_MAX = 64 };
#define SHUTTER_LINE_ALL UINT32_MAX
#define SHUTTER_LINE_HORIZON_NS INT64_C(60000000000)

enum shutter_line_kind { SHUTTER_LINE_SET = 1, SHUTTER_LINE_SYNC = 2, SHUTTER_LINE_REFUSED = 3, SHUTTER_LINE_HEAD = 4, SHUTTER_LINE_ARRIVED = 5 };
enum shutter_line_name { SHUTTER_LINE_HALF = 1, SHUTTER_LINE_FULL = 2, SHUTTER_LINE_POWER = 3 };

struct shutter_line {
    uint16_t kind;    // enum shutter_line_kind
    uint8_t line;     // enum shutter_line_name; SYNC: 0
    uint8_t level;    // SET: 0 or 1; else 0
    uint32_t channel; // index of the camera, or SHUTTER_LINE_ALL (SET only)
    uint64_t tag;
    int64_t at_ns;
    union {
        int64_t end_ns;   // SYNC only, else 0
        int64_t yaw_mdeg; // HEAD and ARRIVED
    };
    union {
        int64_t lag_ns; // SYNC only, else 0
        int64_t pitch_mdeg; // HEAD and ARRIVED
    };
    uint32_t error; // REFUSED and ARRIVED, else 0
    uint32_t reserved; // 0
};
_Static_assert(sizeof(struct shutter_line) == 48, "the layout is the protocol");
