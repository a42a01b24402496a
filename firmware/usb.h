// firmware/usb.h - what the device says of itself, and the control requests; the controller itself is the board's.
#pragma once
#include <stdint.h>

enum usb_answer {
    USB_STALL,       // not understood
    USB_DATA,        // what was put by board_control_put() is the answer
    USB_ACK,         // done, no data
    USB_ADDRESS,     // acknowledge, then take address setup[2]
    USB_CONFIGURED,  // acknowledge; set up the bulk endpoints
    USB_UNCONFIGURED, // acknowledge; they are no more
    USB_CLEAR_HALT,  // acknowledge; endpoint setup[4] begins anew with DATA0
};

void usb_reset(void);
// tick: when the SETUP packet came. Every answer fits into one packet of 64 bytes, and never fills it.
enum usb_answer usb_setup(const uint8_t setup[8], uint64_t tick);
