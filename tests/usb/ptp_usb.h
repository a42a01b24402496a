// tests/usb/ptp_usb.h - a still-image device's three endpoints (PIMA 15740 over USB): containers in, containers out, no USB.
//
// It bridges bytes to rigsim's responder: the same body, session and files. A command is answered when the host first reads: only
// then is it known, without a table of operations, that no data phase precedes. A new command ends what was being sent.
// Time comes from outside, as in body.h.
#pragma once
#include "tests/rigsim/frame.h"
#include "tests/rigsim/ptp.h"

enum { PTP_USB_PACKET = 512, PTP_USB_EVENTS_MAX = 64, PTP_USB_OUT_MAX = 1 << 20 };

struct ptp_usb {
    struct body body;
    struct ptp_session session;
    struct ptp_reply reply;
    struct scene *scene;
    bool hung; // the firmware is stuck: nothing is answered until a reset

    struct dataset from_host; // the container that is being collected
    struct ptp_request request;
    struct dataset request_data;
    bool asked; // request waits to be answered

    // What is being sent: header (or a whole small container), then bytes of a file; then the response.
    struct dataset to_host;
    size_t sent;
    struct frame *frame;
    uint64_t frame_at, frame_left;
    bool corrupt, zero_length_due;
    struct dataset response; // to follow

    struct ptp_event event[PTP_USB_EVENTS_MAX]; // for the interrupt endpoint; the oldest is lost when full
    int n_events;
};

// personality and scene stay the caller's. Exposures are stamped as with rigsim --clock fixed. 0 or -ENOMEM.
int ptp_usb_open(struct ptp_usb *p, const struct personality *personality, struct scene *scene, int64_t now_ns, int64_t utc_ns);
void ptp_usb_close(struct ptp_usb *p);
// Bus reset: the session and all transfers end, a stuck firmware begins anew. Files and settings stay.
void ptp_usb_reset(struct ptp_usb *p);
void ptp_usb_step(struct ptp_usb *p, int64_t now_ns);

// Bulk out: one transfer. 0; -EPROTO: not a container (the endpoint stalls).
int ptp_usb_write(struct ptp_usb *p, const uint8_t *bytes, size_t n);
// Bulk in: one transfer of at most room bytes. Bytes written, -EAGAIN: nothing to send (yet);
// -EOVERFLOW: room is no multiple of a packet and would be overrun.
int ptp_usb_read(struct ptp_usb *p, uint8_t *to, size_t room);
// Interrupt in: one event. Bytes written or -EAGAIN.
int ptp_usb_event(struct ptp_usb *p, uint8_t *to, size_t room);
// Control: a class request to the interface; wLength bytes of data go in *to. Bytes written, -EPIPE: not known (stall).
int ptp_usb_class_request(struct ptp_usb *p, uint8_t request, uint8_t *to, size_t room);
// Bytes of the container that is going out now; 0: none.
uint64_t ptp_usb_left(const struct ptp_usb *p);
