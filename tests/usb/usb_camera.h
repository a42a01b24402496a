// tests/usb/usb_camera.h - a live USB camera behind umockdev: ptp_usb.h on usbfs.h's bus; the real libusb and libgphoto2 of a program
// that runs under umockdev's preload find it, open it and talk to it.
//
// It hangs on port 1-4.3 (a hub at 1-4) of bus 1. Every call here may be made at any time from any thread.
#pragma once
#include "tests/usb/ptp_usb.h"
#include "tests/usb/usbfs.h"

#define USB_CAMERA_SLOT "1-4.3"

struct usb_camera;
struct usb_camera_count {
    uint64_t bytes_in;      // bulk, since the beginning
    uint64_t urb_bytes_max; // see usbfs.h
    int n_resets, n_interrupts; // bus resets; events delivered
};

// Unplugged. personality and scene stay the caller's. 0, -ENOMEM.
int usb_camera_new(struct usb_camera **out, UMockdevTestbed *bed, const struct personality *personality, struct scene *scene);
// Waits for programs that had it open and have ended (usbfs.h).
void usb_camera_free(struct usb_camera *c);
// The root hub and the hub that it hangs on are there before the first camera and stay. 0, -EINVAL (umockdev's words are logged).
int usb_camera_plug(struct usb_camera *c, int device_number);
void usb_camera_unplug(struct usb_camera *c);

void usb_camera_hang(struct usb_camera *c);  // until the next bus reset
// Sends n bytes more on the bulk endpoint (at least; whole urbs) and then no more until resumed, unplugged or reset.
void usb_camera_pause_after(struct usb_camera *c, uint64_t n);
void usb_camera_resume(struct usb_camera *c);
bool usb_camera_wait_paused(struct usb_camera *c, int timeout_ms);
struct usb_camera_count usb_camera_counts(struct usb_camera *c);
// xxh128 and size of the file of that name on its card. 0, -ENOENT, -ENOMEM.
int usb_camera_digest(struct usb_camera *c, const char *name, char hex[33], int64_t *size_bytes);
