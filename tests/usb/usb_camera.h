// tests/usb/usb_camera.h - a live USB camera behind umockdev: sysfs, device node and usbfs requests; the real libusb and libgphoto2
// of a program that runs under umockdev's preload find it, open it and talk to ptp_usb.h.
//
// It hangs on port 1-4.3 (a hub at 1-4) of bus 1. umockdev's own thread answers the host; every call here may be made at any time
// from another one. What it stands in for is the kernel: one claim per interface, urbs of a program that ends are dropped, a bus
// reset ends the transfers, after an unplug pending urbs come back with ESHUTDOWN and everything else is ENODEV.
#pragma once
#include "tests/usb/ptp_usb.h"

#include <umockdev.h>

#define USB_CAMERA_SLOT "1-4.3"

struct usb_camera;
struct usb_camera_count {
    uint64_t bytes_in;      // bulk, since the beginning
    uint64_t urb_bytes_max; // of all urbs in flight at one time: what usbfs_memory_mb must hold
    int n_resets, n_interrupts; // bus resets; events delivered
};

// Unplugged. personality and scene stay the caller's. 0, -ENOMEM.
int usb_camera_new(struct usb_camera **out, UMockdevTestbed *bed, const struct personality *personality, struct scene *scene);
// Waits for programs that had it open and have ended.
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
