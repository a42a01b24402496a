// tests/rigsim/faults.h - what goes wrong, when and with which camera: a script.
//
// One fault per line; '#' at its beginning or after a space begins a comment:
//   CAMERAS WHEN FAULT [ARGUMENTS]
// CAMERAS  A03 | A01,A07,B12 | A* | *
// WHEN     at 2.5s            once, that long after the start
//          on shot 3 | on shot *      at the 3rd exposure's end, or at each
//          on op 0x100e | on op 0x100e#2   before each such operation is answered, or only before the 2nd
//          on connect 2 | on connect *     when a client has opened the 2nd connection, or any
// FAULT    busy 10s           every operation answers 0x2019 DeviceBusy for that long
//          stall 5s           no answers for that long; the links stay up
//          drop               both links break now
//          refuse 5s          links break and new ones are refused for that long
//          lose_added N | lose_complete N     the next N ObjectAdded or CaptureComplete events never come
//          late 3s N          the next N of those events come that much later
//          flood 200 10s      that many events per second for that long
//          card_full | card_empty_again       the card takes nothing more; all is well again
//          battery 5          percent left; 0: the body is off
//          power_cut 10s      off for that long (a pulled cable), then it boots
//          drift 0x5007 560   the next time that property is set it takes this value instead
//          dial 0x5007 560    somebody turns the dial now (an event tells)
//          corrupt N | short N  the next N files have flipped bytes, or only half their bytes
//          slow 2000000       bytes per second from now on; 0: no limit
//          flicker 3          the lamps' brightness differs by that many percent from one exposure of this camera to the next
//          no_shot N          the next N releases expose nothing
//          head_stuck N       the next N moves of the panorama head end on the way, and say so (whatever the camera)
//          hostile KIND N     the next N replies are wrong: length huge tiny count string transaction type total garbage cut
#pragma once
#include <stdbool.h>
#include <stdint.h>

enum fault_when { FAULT_AT, FAULT_ON_SHOT, FAULT_ON_OPERATION, FAULT_ON_CONNECT };
enum fault_kind {
    FAULT_BUSY, FAULT_STALL, FAULT_DROP, FAULT_REFUSE, FAULT_LOSE_ADDED, FAULT_LOSE_COMPLETE, FAULT_LATE, FAULT_FLOOD,
    FAULT_CARD_FULL, FAULT_CARD_EMPTY_AGAIN, FAULT_BATTERY, FAULT_POWER_CUT, FAULT_DRIFT, FAULT_DIAL, FAULT_CORRUPT,
    FAULT_SHORT, FAULT_SLOW, FAULT_FLICKER, FAULT_NO_SHOT, FAULT_HEAD_STUCK, FAULT_HOSTILE
};
enum hostile_kind { // what is wrong with a reply
    HOSTILE_NONE,
    HOSTILE_LENGTH,      // the packet says it is 12 bytes longer than it is
    HOSTILE_HUGE,        // ... 2 GiB
    HOSTILE_TINY,        // ... 3 bytes
    HOSTILE_COUNT,       // the data set's first count is 0xfffffff0
    HOSTILE_STRING,      // strings claim 255 characters
    HOSTILE_TRANSACTION, // of another transaction
    HOSTILE_TYPE,        // packet type 99
    HOSTILE_TOTAL,       // more data announced than sent
    HOSTILE_GARBAGE,     // random bytes in place of the data
    HOSTILE_CUT          // half of the packet, then silence
};

struct fault {
    char cameras[64];
    enum fault_when when;
    uint32_t value; // shot, operation or connection; UINT32_MAX: any
    uint32_t nth;   // operation: 0 each
    int64_t at_ns;  // FAULT_AT
    enum fault_kind kind;
    int64_t ns;  // durations
    int64_t n;   // counts, rates, codes, percent, enum hostile_kind
    int64_t n2;  // value, count
    int line;
};

struct faults {
    int n;
    struct fault *fault;
};

// Errors, logged with file, line, found and expected: -errno of the open, -EINVAL, -EFBIG.
int faults_read(struct faults *out, const char *path);
int faults_parse(struct faults *out, const char *text, const char *name_for_errors);
void faults_free(struct faults *f); // leaves it zeroed
bool fault_is_for(const struct fault *f, const char *camera);
