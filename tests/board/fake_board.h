// tests/board/fake_board.h - a trigger board made of a table of wrongs: it speaks the protocol just well enough to be opened and to fire, and
// at one chosen place it does what no board of ours would do. For usbfs.h; no AVR, no outputs.
#pragma once
#include "firmware/protocol.h"
#include "tests/usb/usbfs.h"

enum fake_wrong {
    FAKE_RIGHT,
    FAKE_OTHER_MAKER,        // another device that took the same number
    FAKE_DEAF,               // control requests are never answered
    FAKE_STALLS,             // all of them are refused
    FAKE_SHORT_CAPABILITIES, FAKE_MAD_CAPABILITIES, FAKE_NEWER, FAKE_OLDER,
    FAKE_SHORT_TIME, FAKE_HUGE_TIME, FAKE_RANDOM_TIME,
    FAKE_NO_HELLO,           // commands are swallowed
    FAKE_NO_READER,          // not even taken
    FAKE_REFUSES,            // every command, with an error that nobody knows
    FAKE_REFUSES_PING,
    FAKE_RANDOM_BYTES, FAKE_WRONG_CRC, FAKE_WRONG_LENGTH, FAKE_CUT, // instead of each answer once configured
    FAKE_EMPTY_PACKETS,
    FAKE_UNASKED,            // an answer to nothing
    FAKE_FLOOD,              // of events, all in order
    FAKE_MAD_EVENTS,         // intact frames of any type and any payload
    FAKE_MAD_STAMPS,         // a button pressed in another century
    FAKE_FALLS_SILENT,       // after the shot is committed
    FAKE_NEVER_FIRES,        // answers, and never reports the shot
    FAKE_N_WRONGS,
};

struct fake_board {
    enum fake_wrong wrong;
    unsigned seed;
    bool configured, committed;
    uint8_t sequence; // of its events
    uint16_t shot;
    uint64_t fired_at;
    uint8_t queue[64][64]; // packets to the host
    int size[64], n;
    int n_released; // control requests for it
};

extern const struct usbfs_ops fake_board_ops;
extern const uint8_t fake_board_descriptors[18 + 9 + 9 + 7 + 7];
