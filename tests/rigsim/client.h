// tests/rigsim/client.h - a small PTP/IP client for tests: what a careful host sees, without libgphoto2.
//
// Blocking, one thread per client. Every wait has the client's deadline; a broken or late peer is a negative code, never a hang.
#pragma once
#include "tests/rigsim/ptpip.h"

struct client {
    int command, event; // -1: closed
    int timeout_ms;
    uint32_t transaction;
    struct dataset in, event_in; // bytes not yet parsed
    struct dataset data;         // of the last reply
    uint16_t code;               // its response
    int n_params;
    uint32_t param[PTPIP_PARAMS_MAX];
};

// Both connections to address (dotted), port and port + 1, and a session. 0, -ECONNREFUSED, -ETIMEDOUT, -EPROTO, -EPIPE.
int client_open(struct client *c, const char *address, int port, int timeout_ms);
void client_close(struct client *c);
// One transaction; data: what the camera is sent, or NULL. The response code; negative: -ETIMEDOUT (no answer in time), -EPIPE (link
// broken), -EPROTO (no PTP/IP, another transaction's answer, or another length than announced).
int client_ask(struct client *c, uint16_t code, int n_params, const uint32_t *param, const void *data, size_t n_data);
// The next event within the deadline: 0, -ETIMEDOUT, -EPIPE, -EPROTO.
int client_event(struct client *c, uint16_t *code, uint32_t *param);
