// tests/rigsim/ptpip.h - the packets of PTP/IP (CIPA DC-005), both ways.
//
// A packet is length (u32, itself included), type (u32), body. Command and event connections carry the same packets. Parsing is a
// pure function of bytes: any input is answered with a packet, "more bytes" or "refused"; nothing is allocated.
#pragma once
#include "tests/rigsim/dataset.h"

enum ptpip_type {
    PTPIP_INIT_COMMAND_REQUEST = 1,
    PTPIP_INIT_COMMAND_ACK = 2,
    PTPIP_INIT_EVENT_REQUEST = 3,
    PTPIP_INIT_EVENT_ACK = 4,
    PTPIP_INIT_FAIL = 5,
    PTPIP_COMMAND = 6,
    PTPIP_RESPONSE = 7,
    PTPIP_EVENT = 8,
    PTPIP_START_DATA = 9,
    PTPIP_DATA = 10,
    PTPIP_CANCEL = 11,
    PTPIP_END_DATA = 12,
    PTPIP_PING = 13,
    PTPIP_PONG = 14
};
enum { PTPIP_HEADER_BYTES = 8, PTPIP_PACKET_MAX = 1 << 20, PTPIP_NAME_MAX = 80, PTPIP_PARAMS_MAX = 5 };

// Only the fields of its type are set; the others are 0.
struct ptpip_packet {
    enum ptpip_type type;
    uint32_t connection;       // INIT_COMMAND_ACK, INIT_EVENT_REQUEST
    uint32_t reason;           // INIT_FAIL
    uint8_t guid[16];          // INIT_COMMAND_REQUEST, INIT_COMMAND_ACK
    char name[PTPIP_NAME_MAX]; // the same, UTF-8
    uint32_t version;          // the same; 0x10000 is 1.0
    uint32_t data_phase;       // COMMAND: 1 none or to the initiator, 2 from it
    uint16_t code;             // COMMAND, RESPONSE, EVENT
    uint32_t transaction;      // those, START_DATA, DATA, END_DATA, CANCEL
    int n_params;
    uint32_t param[PTPIP_PARAMS_MAX];
    uint64_t total;         // START_DATA: bytes of the data phase
    const uint8_t *payload; // DATA, END_DATA: points into the parsed bytes
    size_t n_payload;
};

// The packet at the beginning of bytes; *used is its length. 0; -EAGAIN: bytes holds only a part of it; -EPROTO: it is none (a
// length under 8, over PTPIP_PACKET_MAX or not that of its type, a type unknown, a name without end).
int ptpip_parse(const uint8_t *bytes, size_t n, struct ptpip_packet *out, size_t *used);
// Append the packet. DATA and END_DATA with a NULL payload: only the 12 bytes before n_payload bytes that the caller appends.
void ptpip_write(struct dataset *out, const struct ptpip_packet *packet);
