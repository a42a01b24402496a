// tests/rigsim/ptp.h - the responder: one PTP session with one body; a request in, a reply out, no I/O.
//
// Operations that the personality does not list are refused with 0x2005. Object data is not in the reply: it names the object and
// the range, and who answers the wire streams it.
#pragma once
#include "tests/rigsim/body.h"
#include "tests/rigsim/dataset.h"

enum { PTP_EVENT_QUEUE_MAX = 256 };

struct ptp_request {
    uint16_t code;
    uint32_t transaction;
    int n_params;
    uint32_t param[5];
    const uint8_t *data; // data phase from the initiator
    size_t n_data;
};

struct ptp_reply {
    uint16_t code;
    int n_params;
    uint32_t param[5];
    bool has_data;       // a data phase goes out: data, or of object
    struct dataset data; // kept from reply to reply; dataset_free() at the end
    uint32_t object;     // 0: none; else bytes [offset, offset + n) of this object
    uint64_t offset, n;
};

struct ptp_event {
    uint16_t code;
    uint32_t param;
};

struct ptp_session {
    struct body *body;
    // The small JPEG of an object, appended to out. 0 or -errno.
    int (*thumbnail)(void *arg, const struct body *b, const struct body_object *o, struct dataset *out);
    void *arg;
    uint32_t width_px, height_px; // of frames, for ObjectInfo
    bool open;
    // Events for clients that fetch them (Nikon 0x90c7, Canon 0x9116); the oldest is lost when full.
    struct ptp_event event[PTP_EVENT_QUEUE_MAX];
    int n_events;
    uint32_t eos_remote, eos_event_mode;
    bool eos_all_told; // every property was sent since the event mode was set
};

void ptp_session_init(struct ptp_session *s, struct body *body);
// The client has gone: the next one begins anew.
void ptp_session_reset(struct ptp_session *s);
// Never fails: what is wrong is in reply->code. Of reply only data is kept from before.
void ptp_answer(struct ptp_session *s, const struct ptp_request *request, struct ptp_reply *reply);
// Something happened to the body. True: send *out on the event connection; else it was queued, or is not for clients.
bool ptp_notice(struct ptp_session *s, const struct body_event *event, struct ptp_event *out);
