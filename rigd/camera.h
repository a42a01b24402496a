// rigd/camera.h - what the daemon and a camera's worker process say to each other.
//
// One process per camera (build/bin/rigd-camera) holds libgphoto2; rigd holds none of it. They talk over a SOCK_SEQPACKET
// socketpair, the worker's end being descriptor 3: one message per packet, JSON in UTF-8, at most CAMERA_MESSAGE_MAX bytes.
// The rules, which make a hung or lying camera somebody else's problem:
//  - A worker touches its camera only while it carries out a command, so a rig that sends nothing is a quiet rig (half-press!).
//  - Commands are carried out one after another. Each is answered once, by DONE or FAILED with the command's seq. OBJECT and
//    PROGRESS may come before the answer, with the same seq; HELLO (seq 0) comes once, first.
//  - A command ends within its timeout_ms as far as the driver lets it; the daemon kills a worker that is 2 s late.
//  - End of file on descriptor 3 ends the worker (it also asks for PR_SET_PDEATHSIG): no daemon, no camera traffic.
//  - Nothing a camera says is trusted: strings are cut, lists bounded, sizes checked against what was read.
// Paths are absolute. Times are CLOCK_MONOTONIC nanoseconds unless the name says otherwise.
#pragma once
#include "rigd/frame_facts.h"
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    CAMERA_PROTOCOL = 1,
    CAMERA_MESSAGE_MAX = 65536,
    CAMERA_FD = 3,
    CAMERA_SETTINGS_MAX = 24, // per camera
    CAMERA_LISTING_MAX = 64,  // objects per answer
    CAMERA_STORES_MAX = 4,    // cards per body
    CAMERA_LENS_MAX = 640,
};

// Neutral names ("iso", "shutter", ...: config/cameras/*.conf translates them for a family of bodies).
struct camera_setting {
    char name[24];
    char value[48];
};

// A file on a card. Objects of one store are ordered as DCF numbers them: by folder number, then file number.
struct camera_object {
    char folder[96];    // "/store_00010001/DCIM/100NIKON"
    char name[40];      // "DSC_0123.NEF"
    int64_t size_bytes; // -1: not known yet
};

enum camera_command_kind {
    CAMERA_OPEN,      // connect to port; check the serial; -> facts. Once more on an open camera: close it first
    CAMERA_CONFIGURE, // write those settings that differ, read all of them back -> settings
    CAMERA_STATUS,    // battery, card, clock, lens -> status
    CAMERA_DRAIN,     // read events until quiet_ms passed without one -> n_objects; each object an OBJECT before. Not quiet in
                      // time: FAILED, busy
    CAMERA_TRIGGER,   // release the shutter through the driver (unsynchronised) -> pressed_ns
    CAMERA_COLLECT,   // wait until n_objects new objects were announced, each an OBJECT -> n_objects; fewer in time is DONE too
    CAMERA_LIST,      // refresh the card's listing. n_objects 0: -> the newest object of each store. Else -> up to n_objects
                      // (and CAMERA_LISTING_MAX) in DCF order that are later than after[] of their store, `more` if not all
    CAMERA_FETCH,     // copy object to path: written, hashed, synced, read back, then named -> size, xxh128. A file of the object's
                      // size that is there already is whole (nothing else gets that name): it is hashed instead. judge: -> frame, too
    CAMERA_THUMBNAIL, // likewise the object's preview (JPEG) -> size, xxh128
    CAMERA_DELETE,    // delete object from the card, after hashing the copy at path once more: it must equal xxh128
    CAMERA_IDENTIFY,  // make the body notice itself for some seconds (live view, beep): a person is looking for it
    CAMERA_CLOSE,     // let go of the camera; the worker stays
    CAMERA_N_COMMANDS
};

struct camera_command {
    enum camera_command_kind kind;
    uint32_t seq;       // > 0, ascending
    uint32_t timeout_ms;
    // OPEN
    char port[96];        // "usb:1-4.3" (the slot: bus and hub ports as in /sys/bus/usb/devices) or "ptpip:HOST:PORT:EVENTPORT"
    char model[64];       // driver's name for the body; "": by detection
    char personality[256]; // file of config/cameras; "": none
    char serial[40];      // must match; "": any
    bool reset;           // reset the USB port first (PTP/IP: nothing to reset)
    // CONFIGURE
    int n_settings;
    struct camera_setting setting[CAMERA_SETTINGS_MAX];
    // DRAIN, COLLECT, LIST
    uint32_t quiet_ms;
    int n_objects;
    int n_after;
    struct camera_object after[CAMERA_STORES_MAX];
    // FETCH, THUMBNAIL, DELETE
    struct camera_object object;
    char path[512];     // FETCH, THUMBNAIL: of the copy; nothing is replaced. DELETE: the copy
    char xxh128[33];    // DELETE
    char judge[CAMERA_LENS_MAX]; // FETCH: what does the frame show through this lens (lens.h's JSON)? "": nobody asks
};

// What kind of trouble, and with it who can help. Beside it an errno and a sentence for people.
enum camera_trouble {
    CAMERA_BUSY,    // 0x2019 and its kin: try again later
    CAMERA_LOST,    // gone from the bus, link broken, I/O error
    CAMERA_STALLED, // no answer in time
    CAMERA_REFUSED, // not supported, bad value, wrong mode
    CAMERA_CARD,    // no card, card full, card unreadable, object not there
    CAMERA_WRONG,   // another body than configured (serial)
    CAMERA_CORRUPT, // what arrived is not what was announced: short, long, or read back differently
    CAMERA_DISK,    // our side: ENOSPC, EIO, EEXIST...
    CAMERA_BROKEN,  // the driver or the worker itself misbehaved
    CAMERA_N_TROUBLES
};

struct camera_facts { // DONE of OPEN
    char serial[40], model[64], firmware[40];
    char driver_port[64]; // "usb:001,017"
};

struct camera_status { // DONE of STATUS; -1, "" or UNKNOWN: the body does not say
    int battery_percent;
    int card_present;         // 0, 1
    int64_t free_images, free_bytes;
    double clock_offset_s;    // camera minus host; NAN unknown
    int manual_focus;         // 0, 1
    int manual_exposure;      // 0, 1
    int objects_per_shot;     // from the image format: RAW+JPEG is 2
    char lens[64];
};

struct camera_setting_found { // DONE of CONFIGURE, one per setting of the command, in its order
    char name[24], wanted[48], found[48];
    bool equal, written;
};

enum camera_event_kind { CAMERA_HELLO, CAMERA_DONE, CAMERA_FAILED, CAMERA_OBJECT, CAMERA_PROGRESS, CAMERA_N_EVENTS };

struct camera_event {
    enum camera_event_kind kind;
    uint32_t seq;                      // of the command; 0: HELLO
    enum camera_command_kind command;  // DONE, FAILED: which
    // FAILED
    enum camera_trouble trouble;
    int err;                           // -errno
    char text[200];                    // what was found, expected, and what to do
    // HELLO
    int protocol;
    int64_t pid;
    // DONE
    struct camera_facts facts;
    struct camera_status status;
    int n_settings;
    struct camera_setting_found setting[CAMERA_SETTINGS_MAX];
    int n_objects;                     // DRAIN, COLLECT: announced; LIST: looked at
    int64_t pressed_ns;                // TRIGGER
    int n_listed;                      // LIST: in object[], in DCF order
    bool more;                         // LIST: there are newer ones than listed
    struct camera_object object[CAMERA_LISTING_MAX]; // LIST; OBJECT: [0]
    int64_t size_bytes;                // FETCH, THUMBNAIL; PROGRESS: so far
    char xxh128[33];                   // FETCH, THUMBNAIL: 32 lower-case hex digits
    bool judged;                       // FETCH: frame is known (a raw that LibRaw knows, with command.judge)
    struct frame_facts frame;
    int64_t at_ns;                     // OBJECT: when the camera announced it
};

// One message. encode: malloc'd text without NUL in *n_bytes, NULL without memory. decode: 0, or -EINVAL for anything that is
// not a message of this protocol (not logged: the caller knows which camera spoke); *out is zeroed then.
char *camera_command_encode(const struct camera_command *c, size_t *n_bytes);
char *camera_event_encode(const struct camera_event *e, size_t *n_bytes);
int camera_command_decode(struct camera_command *out, const char *text, size_t n_bytes);
int camera_event_decode(struct camera_event *out, const char *text, size_t n_bytes);

bool camera_same_store(const struct camera_object *a, const struct camera_object *b);
// < 0, 0, > 0 as a was written to the card before b, in DCF order. Stores are ordered by name.
int camera_object_order(const struct camera_object *a, const struct camera_object *b);

const char *camera_command_name(enum camera_command_kind kind); // "open" ...
const char *camera_trouble_name(enum camera_trouble trouble);   // "busy" ...
