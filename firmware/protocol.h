// firmware/protocol.h - what the host and the trigger board say to each other: the whole contract.
//
// The host plans, the board executes. The host relates its clock to the board's (GET_TIME), loads a whole shot (BEGIN, TOGETHER,
// CHANNELS), and COMMITs it for a tick of the board's clock; the board checks it as a whole, refuses what is past, too close or too
// long, and then needs nobody: edges are latched by a timer, and everything goes down again however the host fares.
//
// All numbers are little-endian; offsets are written out below, one line per field. Times are ticks of the board's 64-bit clock,
// which starts at 0 when the board starts, and never wraps; capabilities say how many make a second (16,000,000 on the ATmega32U4:
// 62.5 ns). This file is plain C for both sides (an `int` has 16 bits on one of them) and includes nothing of ours.
//
// USB: full speed, vendor class, configuration 1, interface 0, endpoint 0 of 64 bytes, bulk OUT 0x01 and bulk IN 0x82 of 64 bytes.
// The identity is a placeholder in the manner of pid.codes: it MUST be registered there before boards are given away; until then
// the host also checks manufacturer and product.
//
// Frames, both ways, over the bulk endpoints, at most 61 bytes. The board sends each in one packet, never a full one (so there are no
// zero-length packets); it accepts a byte stream, cut anywhere.
//     0 u8 0xA5   1 u8 0x5A   2 u8 n   3 u8 sequence   4 u8 type   5.. n bytes of payload   5+n u32 CRC-32 of bytes 2 to 4+n
// What is not a frame is skipped to the next 0xA5 0x5A after where the last attempt began, and counted. A frame without an end
// within PROTO_FRAME_GAP_MS of its begin is such.
//
// Commands: HELLO opens a session (and ends any other: everything is released) and sets the sequence to its own; each further
// command carries the one before plus 1 (mod 256), else it is answered PROTO_ERR_SEQUENCE and not executed. Each intact command is
// answered once, in order: type | PROTO_REPLY, same sequence, first byte of payload an enum proto_error, then what is written below
// (only when that is PROTO_OK). One command at a time is enough; up to two may be under way.
// A session ends - everything released, outputs disabled, shot forgotten, head stopped - by silence (no command in sequence for
// silence_ms, refused or not; PING is for that), USB reset, suspend, unplugging, the watchdog, and the next HELLO.
// After opening the device the host may still read frames from before: skip to the answer of its HELLO.
// Events come in between, with a sequence of their own (counting from 0 after HELLO): a hole says how many were lost.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    PROTO_VENDOR_ID = 0x1209,
    PROTO_PRODUCT_ID = 0x5247, // placeholder, to be registered
    PROTO_ENDPOINT_OUT = 0x01,
    PROTO_ENDPOINT_IN = 0x82,
    PROTO_PACKET_BYTES = 64,
    PROTO_VERSION = 0x0100,    // major in the high byte: must be equal; minor: what is new there, the other side need not know
};
#define PROTO_MANUFACTURER "studiorig"
#define PROTO_PRODUCT "trigger board"
// The serial number string is the chip's own (20 hexadecimal digits), so that a host with several boards can name each.

// ---- control requests: vendor, recipient device; wIndex 0 -------------------------------------------------------------------
enum proto_request {
    // IN, 16 bytes. 0 u64 tick when this very SETUP packet raised its interrupt   8 u64 same of the request before (0: none).
    // The stamp is late by the board's interrupt latency only: the shortest of several round trips has the least of it.
    PROTO_GET_TIME = 1,
    PROTO_GET_CAPABILITIES = 2, // IN, PROTO_CAPABILITIES_BYTES: without a session
    PROTO_GET_STATUS = 3,       // IN, PROTO_STATUS_BYTES: without a session
    PROTO_RELEASE_ALL = 16,     // OUT, no data: as PROTO_RELEASE with PROTO_RELEASE_EVERYTHING, but at once and out of sequence
    PROTO_IDENTIFY_LED = 17,    // OUT, no data; wValue: milliseconds the LED blinks, 0: stop
};

// ---- limits -----------------------------------------------------------------------------------------------------------------
enum {
    PROTO_SYNC_0 = 0xA5,
    PROTO_SYNC_1 = 0x5A,
    PROTO_HEADER_BYTES = 5,
    PROTO_CRC_BYTES = 4,
    PROTO_PAYLOAD_MAX = 52,
    PROTO_FRAME_MAX = PROTO_HEADER_BYTES + PROTO_PAYLOAD_MAX + PROTO_CRC_BYTES, // 61
    PROTO_FRAME_GAP_MS = 100,
    PROTO_OUTPUTS_MAX = 416,       // 52 shift registers: 200 full-press, 200 half-press, 16 lamps and relays
    PROTO_CHANNELS_MAX = 200,      // outputs with a delay of their own, in one shot
    PROTO_CHANNEL_OUTPUTS = 256,   // they are among the outputs 0 to 255
    PROTO_INPUTS_MAX = 200,        // 25 shift registers of flash-sync contacts
    PROTO_BANKS_MAX = 4,
    PROTO_MAX_ON_FLOOR_MS = 200,
    PROTO_MAX_ON_CEILING_MS = 16000,
    PROTO_GUARD_MS = 64,           // how often an output's on-time is looked at
    // What may be asked of an output is this much less than its bank's max_on_ms, so that the guard never cuts what was granted
    // and yet no output is on for longer than max_on_ms.
    PROTO_ON_SLACK_MS = 2 * PROTO_GUARD_MS + 4,
    PROTO_SILENCE_MIN_MS = 100,
    PROTO_SILENCE_MAX_MS = 10000,
    PROTO_DEBOUNCE_MAX_MS = 1000,
    PROTO_AXES = 2,                // 0 yaw, 1 pitch
    PROTO_CHANNELS_PER_FRAME = 12,
    PROTO_TOGETHER_PER_FRAME = 51,
};
#define PROTO_DELAY_MAX_TICKS UINT32_C(0xFFFFFF)   // of a channel: 1.048 s at 16 MHz
#define PROTO_AHEAD_MAX_TICKS UINT32_C(0x40000000) // a shot may be committed this much ahead: 67 s at 16 MHz

enum proto_error {
    PROTO_OK = 0,
    PROTO_ERR_SEQUENCE = 1,   // then 1 u8 the sequence expected; not executed
    PROTO_ERR_SESSION = 2,    // no session: HELLO first. Silence ended it, if there was one
    PROTO_ERR_VERSION = 3,    // HELLO: then 1 u16 the board's version
    PROTO_ERR_TYPE = 4,       // no such command
    PROTO_ERR_LENGTH = 5,     // payload too short or too long for its type
    PROTO_ERR_VALUE = 6,      // a field is out of its range
    PROTO_ERR_BUSY = 7,       // a shot is pending, the head moves, or an output of the shot is on
    PROTO_ERR_PAST = 8,       // COMMIT: the first edge is less than lead_min_ticks from now, or past; then 1 u64 now
    PROTO_ERR_INCOMPLETE = 9, // COMMIT: not every channel was sent, or nothing would be pressed; or no shot was begun, or another
    PROTO_ERR_ORDER = 10,     // CHANNELS: delays must not fall; then 1 u8 the first wrong entry
    PROTO_ERR_GAP = 11,       // COMMIT: two edges are closer than the board can shift; then 1 u8 the entry that comes too early
    PROTO_ERR_ON_TIME = 12,   // COMMIT: outputs would be on for too long; then 1 u8 the bank whose limit it is
    PROTO_ERR_OUTPUT = 13,    // TOGETHER, CHANNELS, OUTPUT: in no bank, or in the shot twice; then 1 u16 the output
    PROTO_ERR_CONFIGURE = 14, // CONFIGURE first (or HEAD_CONFIGURE)
    PROTO_ERR_NOT_HOMED = 15, // HEAD_MOVE
    PROTO_ERR_LIMIT = 16,     // HEAD_MOVE: beyond the axis' limits
    PROTO_ERR_AHEAD = 17,     // COMMIT: more than PROTO_AHEAD_MAX_TICKS ahead
};

enum {
    PROTO_REPLY = 0x80,
    PROTO_EVENT = 0xC0, // types from here on are events
};

// ---- commands ---------------------------------------------------------------------------------------------------------------
enum proto_command {
    PROTO_HELLO = 0x01,           // 0 u16 PROTO_VERSION. Reply: 1.. capabilities
    PROTO_PING = 0x02,            // none. Reply: 1 u64 now (not for the clock: GET_TIME is)
    PROTO_CONFIGURE = 0x03,       // see below; not while a shot is pending. Releases everything, then enables the outputs
    PROTO_STATUS = 0x04,          // none. Reply: 1.. status
    PROTO_SHOT_BEGIN = 0x10,      // see below; forgets a shot that is loaded but not committed; BUSY while one is committed
    PROTO_SHOT_TOGETHER = 0x11,   // 0 u8 first register   1.. bits of this and following registers (output 8 r + b is bit b)
    PROTO_SHOT_CHANNELS = 0x12,   // 0 u8 first entry   then per entry: u24 delay in ticks, u8 output. In order, delays not falling
    PROTO_SHOT_COMMIT = 0x13,     // 0 u16 shot   2 u64 T0; with PROTO_SHOT_ON_BUTTON: ticks from the press (debounced) to T0
    PROTO_RELEASE = 0x14,         // 0 u8 bits of PROTO_RELEASE_...
    PROTO_OUTPUT = 0x20,          // 0 u16 output   2 u8 1 on, 0 off. BUSY if it is in a committed shot. Off by itself after at
                                  // least max_on_ms - PROTO_ON_SLACK_MS and at most max_on_ms of its bank; "on" again when on: not longer
    PROTO_IDENTIFY = 0x21,        // 0 u16 milliseconds; 0: stop
    PROTO_HEAD_CONFIGURE = 0x30,  // see below
    PROTO_HEAD_MOVE = 0x31,       // 0 i32 yaw steps   4 i32 pitch steps, from home. BUSY while it moves or a shot is committed
    PROTO_HEAD_HOME = 0x32,       // 0 u8 axes (bit 0 yaw, bit 1 pitch)   1 u8 1: here is home, do not move. BUSY as above
    PROTO_HEAD_STOP = 0x33,       // none. Decelerates; the event HEAD follows if it moved
};

// PROTO_CONFIGURE, 10 bytes and 6 per bank (0 to 4 banks, in any order, not overlapping):
//   0 u8 output registers (8 outputs each, 1 to 52; register 0 is next to the board)   1 u8 input registers (0 to 25)
//   2 u16 debounce in ms: the button must be stable for so long   4 u16 silence_ms   6 u8 flags   7 u8 0
//   8 u16 feedback_ms: for so long after the last release of a shot inputs are still sampled
//   10.. per bank: u16 first output   u16 outputs   u16 max_on_ms
// The reply comes when outputs are enabled.
enum {
    PROTO_CONFIGURE_BYTES = 10,
    PROTO_BANK_BYTES = 6,
    PROTO_BUTTON_ACTIVE_HIGH = 1,  // flags. Else it closes to ground
    PROTO_CAPTURE_RISING = 2,      // the capture input counts rising edges; else falling
    PROTO_INPUTS_ACTIVE_HIGH = 4,  // inputs of the shift registers; else they close to ground
};

// PROTO_SHOT_BEGIN, 12 bytes: 0 u16 shot (the host's number, given back)   2 u8 flags   3 u8 channels (entries to come, 0 to 200)
//   4 u32 lead   8 u32 hold (at least 1 ms worth)
// At T0 the outputs of TOGETHER (half-press) go on; at T0 + lead + delay each channel. A channel goes off hold later: never
// earlier, and later only where a press is due nearby (presses come first). TOGETHER goes off with the last channel; without
// channels, hold after T0 + lead.
// Outputs with the same delay change on one latch edge. The time from one press edge to the next with n channels is at least
// gap_base + gap_register * registers + gap_channel * n ticks, or 0 (the same edge); this also holds from T0 to the first channel.
// T0 must be lead_min_ticks from when the board has checked the shot, and checking 200 channels takes some milliseconds: the host does
// well to commit 10 ms ahead or more.
// Longest on-time: lead + last delay + hold for TOGETHER; last delay - first delay + hold for a channel: at most its bank's
// max_on_ms - PROTO_ON_SLACK_MS.
enum {
    PROTO_SHOT_BEGIN_BYTES = 12,
    PROTO_SHOT_ON_BUTTON = 1, // flags: committed, it waits for the button, for as long as the session lasts
    PROTO_CHANNEL_BYTES = 4,
    PROTO_SHOT_COMMIT_BYTES = 10,
};
enum { // PROTO_RELEASE
    PROTO_RELEASE_SHOT = 1,    // the shot: its outputs go off, FIRED comes with PROTO_FIRED_RELEASED
    PROTO_RELEASE_OUTPUTS = 2, // what PROTO_OUTPUT put on
    PROTO_RELEASE_HEAD = 4,    // as PROTO_HEAD_STOP
    PROTO_RELEASE_EVERYTHING = 7,
};

// PROTO_HEAD_CONFIGURE, 20 bytes: 0 u8 axis   1 u8 flags   2 u16 steps/s   4 u32 steps/s^2   8 u16 steps/s while homing
//   10 u16 0   12 i32 lowest   16 i32 highest position, in steps from home. A new configuration makes the axis not homed.
enum {
    PROTO_HEAD_CONFIGURE_BYTES = 20,
    PROTO_HEAD_REVERSED = 1,        // flags: positive is the other way
    PROTO_HEAD_HOME_POSITIVE = 2,   // home's switch lies on the positive side
    PROTO_HEAD_HOME_ACTIVE_HIGH = 4,
    PROTO_HEAD_HOME_IS_INDEX = 8,   // it is a mark to drive over, not an end stop. Else a move that meets it stops: PROTO_HEAD_BLOCKED
    PROTO_HEAD_SPEED_MAX = 4000,
    PROTO_HEAD_HOMING_STEPS_MAX = 1000000, // given up after: PROTO_HEAD_BLOCKED
};
#define PROTO_HEAD_ACCELERATION_MAX UINT32_C(1000000)
#define PROTO_HEAD_POSITION_MAX INT32_C(100000000)

// ---- events -----------------------------------------------------------------------------------------------------------------
enum proto_event {
    // Once per committed shot, after its last release.
    //   0 u16 shot   2 u8 enum proto_fired   3 u8 0   4 u64 tick of the first channel's edge (of TOGETHER's where there are no
    //   channels), 0: none came   12 u32 the most an edge was late, in ticks (0: the timer latched every edge on its tick)
    //   16 u16 latch edges   18 u16 input changes lost (the host did not read)
    PROTO_FIRED = PROTO_EVENT + 1,
    // 0 u64 tick of the first contact   8 u8 1 pressed, 0 let go   9 u8 1: it fired the committed shot
    PROTO_BUTTON = PROTO_EVENT + 2,
    // The capture input: 0 u64 tick of the edge, exact   8 u16 edges lost since the last
    PROTO_CAPTURE = PROTO_EVENT + 3,
    // Inputs that closed: 0 u64 tick of the sample (it closed within input_sample_ticks before)   then per register: u8 register,
    // u8 bits. Sampled from the first edge of a shot until feedback_ms after its last release, at most 8 s; first closings only.
    PROTO_INPUTS = PROTO_EVENT + 4,
    // 0 u8 enum proto_fault   1 u8 0   2 u16 output or frames   4 u64 tick
    PROTO_FAULT = PROTO_EVENT + 5,
    // The head stands still: 0 u8 enum proto_head   1 u8 axes homed   2 i32 yaw steps   6 i32 pitch steps
    PROTO_HEAD = PROTO_EVENT + 6,
};
enum { PROTO_FIRED_BYTES = 20, PROTO_BUTTON_BYTES = 10, PROTO_CAPTURE_BYTES = 10, PROTO_FAULT_BYTES = 12, PROTO_HEAD_BYTES = 10 };
enum proto_fired {
    PROTO_FIRED_DONE = 0,
    PROTO_FIRED_RELEASED = 1, // the host released it, or the session ended
    PROTO_FIRED_LATE = 2,     // an edge would have come more than late_max_ticks late: given up
    PROTO_FIRED_GUARDED = 3,  // the guard cut an output of it
};
enum proto_fault {
    PROTO_FAULT_ON_TIME = 1,   // the guard cut an output that reached max_on_ms (an OUTPUT left on, or our own bug)
    PROTO_FAULT_SILENCE = 2,   // the host was silent: everything released, no session
    PROTO_FAULT_BAD_FRAMES = 3, // bytes that are no frame arrived; how many times since the last
};
enum proto_head {
    PROTO_HEAD_ARRIVED = 0,
    PROTO_HEAD_STOPPED = 1,
    PROTO_HEAD_BLOCKED = 2, // the home switch was met, or never
};

// ---- capabilities: 40 bytes -------------------------------------------------------------------------------------------------
//   0 u16 version   2 u16 PROTO_CAN_...   4 u32 ticks/s   8 u16 outputs   10 u16 inputs   12 u8 channels   13 u8 banks
//   14 u16 largest max_on_ms   16 u16 gap_base   18 u8 gap_register   19 u8 gap_channel (ticks)   20 u32 lead_min_ticks
//   24 u32 late_max_ticks   28 u16 input_sample_ticks   30 u8 capture inputs   31 u8 axes   32 u16 largest steps/s
//   34 u8 why the board started last: bits of PROTO_RESET_...   35 u8 1: a session is open   36 u32 0
enum {
    PROTO_CAPABILITIES_BYTES = 40,
    PROTO_CAN_CHANNELS = 1,
    PROTO_CAN_TOGETHER = 2,
    PROTO_CAN_BUTTON = 4,
    PROTO_CAN_CAPTURE = 8,
    PROTO_CAN_INPUTS = 16,
    PROTO_CAN_HEAD = 32,
    PROTO_RESET_POWER = 1,
    PROTO_RESET_PIN = 2,
    PROTO_RESET_BROWN_OUT = 4,
    PROTO_RESET_WATCHDOG = 8,
};

// ---- status: 40 bytes -------------------------------------------------------------------------------------------------------
//   0 u8 enum proto_shot_state   1 u8 PROTO_IS_...   2 u16 shot   4 u64 now   12 u32 bad frames   16 u16 times the guard cut
//   18 u16 outputs on   20 i32 yaw steps   24 i32 pitch steps   28 u8 axes homed   29 u8 axes moving   30 u8 home switches met
//   31 u8 sequence expected   32 u16 events lost   34 u16 free RAM never used, bytes   36 u16 silence_ms   38 u16 0
enum {
    PROTO_STATUS_BYTES = 40,
    PROTO_IS_SESSION = 1,
    PROTO_IS_CONFIGURED = 2,
    PROTO_IS_ENABLED = 4, // the output enable line
    PROTO_IS_PRESSED = 8, // the button
};
enum proto_shot_state {
    PROTO_SHOT_IDLE = 0,
    PROTO_SHOT_LOADING = 1,
    PROTO_SHOT_ARMED = 2,   // committed, waits for the button
    PROTO_SHOT_WAITING = 3, // committed, waits for T0
    PROTO_SHOT_RUNNING = 4,
};

// ---- numbers in frames ------------------------------------------------------------------------------------------------------
static inline void proto_put_u16(uint8_t *p, uint16_t x)
{
    p[0] = (uint8_t)x;
    p[1] = (uint8_t)(x >> 8);
}

static inline void proto_put_u24(uint8_t *p, uint32_t x)
{
    proto_put_u16(p, (uint16_t)x);
    p[2] = (uint8_t)(x >> 16);
}

static inline void proto_put_u32(uint8_t *p, uint32_t x)
{
    proto_put_u16(p, (uint16_t)x);
    proto_put_u16(p + 2, (uint16_t)(x >> 16));
}

static inline void proto_put_u64(uint8_t *p, uint64_t x)
{
    proto_put_u32(p, (uint32_t)x);
    proto_put_u32(p + 4, (uint32_t)(x >> 32));
}

static inline uint16_t proto_get_u16(const uint8_t *p)
{
    return (uint16_t)(p[0] | (uint16_t)p[1] << 8);
}

static inline uint32_t proto_get_u24(const uint8_t *p)
{
    return proto_get_u16(p) | (uint32_t)p[2] << 16;
}

static inline uint32_t proto_get_u32(const uint8_t *p)
{
    return proto_get_u16(p) | (uint32_t)proto_get_u16(p + 2) << 16;
}

static inline uint64_t proto_get_u64(const uint8_t *p)
{
    return proto_get_u32(p) | (uint64_t)proto_get_u32(p + 4) << 32;
}

static inline int32_t proto_get_i32(const uint8_t *p)
{
    return (int32_t)proto_get_u32(p);
}

// CRC-32 as in Ethernet and zlib (reflected 0xEDB88320): start with PROTO_CRC_START, add each byte, take the complement.
#define PROTO_CRC_START UINT32_C(0xFFFFFFFF)
static inline uint32_t proto_crc_add(uint32_t crc, uint8_t byte)
{
    crc ^= byte;
    for (uint8_t bit = 0; bit < 8; bit++)
        crc = (crc >> 1) ^ ((crc & 1) ? UINT32_C(0xEDB88320) : 0);
    return crc;
}

// Write the frame around the payload that already lies at frame + PROTO_HEADER_BYTES. Returns its length.
static inline uint8_t proto_seal(uint8_t *frame, uint8_t type, uint8_t sequence, uint8_t n_payload)
{
    frame[0] = PROTO_SYNC_0;
    frame[1] = PROTO_SYNC_1;
    frame[2] = n_payload;
    frame[3] = sequence;
    frame[4] = type;
    const uint8_t n = (uint8_t)(PROTO_HEADER_BYTES + n_payload);
    uint32_t crc = PROTO_CRC_START;
    for (uint8_t i = 2; i < n; i++)
        crc = proto_crc_add(crc, frame[i]);
    proto_put_u32(frame + n, ~crc);
    return (uint8_t)(n + PROTO_CRC_BYTES);
}

// Capabilities, decoded (the host's side).
struct proto_capabilities {
    uint16_t version, can;
    uint32_t ticks_per_s;
    uint16_t n_outputs, n_inputs;
    uint8_t n_channels, n_banks;
    uint16_t max_on_ceiling_ms;
    uint16_t gap_base_ticks;
    uint8_t gap_register_ticks, gap_channel_ticks;
    uint32_t lead_min_ticks, late_max_ticks;
    uint16_t input_sample_ticks;
    uint8_t n_captures, n_axes;
    uint16_t steps_per_s_max;
    uint8_t reset_cause, session;
};

static inline void proto_put_capabilities(uint8_t *p, const struct proto_capabilities *c)
{
    proto_put_u16(p, c->version);
    proto_put_u16(p + 2, c->can);
    proto_put_u32(p + 4, c->ticks_per_s);
    proto_put_u16(p + 8, c->n_outputs);
    proto_put_u16(p + 10, c->n_inputs);
    p[12] = c->n_channels;
    p[13] = c->n_banks;
    proto_put_u16(p + 14, c->max_on_ceiling_ms);
    proto_put_u16(p + 16, c->gap_base_ticks);
    p[18] = c->gap_register_ticks;
    p[19] = c->gap_channel_ticks;
    proto_put_u32(p + 20, c->lead_min_ticks);
    proto_put_u32(p + 24, c->late_max_ticks);
    proto_put_u16(p + 28, c->input_sample_ticks);
    p[30] = c->n_captures;
    p[31] = c->n_axes;
    proto_put_u16(p + 32, c->steps_per_s_max);
    p[34] = c->reset_cause;
    p[35] = c->session;
    proto_put_u32(p + 36, 0);
}

static inline struct proto_capabilities proto_get_capabilities(const uint8_t *p)
{
    return (struct proto_capabilities){
        .version = proto_get_u16(p),
        .can = proto_get_u16(p + 2),
        .ticks_per_s = proto_get_u32(p + 4),
        .n_outputs = proto_get_u16(p + 8),
        .n_inputs = proto_get_u16(p + 10),
        .n_channels = p[12],
        .n_banks = p[13],
        .max_on_ceiling_ms = proto_get_u16(p + 14),
        .gap_base_ticks = proto_get_u16(p + 16),
        .gap_register_ticks = p[18],
        .gap_channel_ticks = p[19],
        .lead_min_ticks = proto_get_u32(p + 20),
        .late_max_ticks = proto_get_u32(p + 24),
        .input_sample_ticks = proto_get_u16(p + 28),
        .n_captures = p[30],
        .n_axes = p[31],
        .steps_per_s_max = proto_get_u16(p + 32),
        .reset_cause = p[34],
        .session = p[35],
    };
}
