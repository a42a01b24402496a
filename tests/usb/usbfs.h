// tests/usb/usbfs.h - a USB device behind umockdev: sysfs, device node and usbfs requests; the real libusb of a program that runs
// under umockdev's preload finds it, opens it and moves bytes to and from whatever plays the device.
//
// What it stands in for is the kernel: one claim per interface, urbs of a program that ends are dropped, urbs time out by nobody (libusb
// discards them), after an unplug pending urbs come back with ESHUTDOWN and everything else is ENODEV. The device hangs on a
// port of the root hub of bus 2. umockdev's own thread answers the host, and calls the device from there; every call here may be made
// at any time from another one.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <umockdev.h>

// Each returns bytes moved, or -EAGAIN (not now: it is asked again), -EPIPE (stall), -EOVERFLOW (more than room). Called one at a time.
struct usbfs_ops {
    // A whole control transfer but for those of the kernel's own (descriptors, configuration).
    int (*control)(void *device, const uint8_t setup[8], uint8_t *data, size_t room);
    int (*out)(void *device, uint8_t endpoint, const uint8_t *bytes, size_t n);
    int (*in)(void *device, uint8_t endpoint, uint8_t *bytes, size_t room);
    void (*reset)(void *device); // by the bus: also when it is plugged in
    void (*unplugged)(void *device);
};

struct usbfs;

// Unplugged. 0, -ENOMEM.
int usbfs_new(struct usbfs **out, UMockdevTestbed *bed, const struct usbfs_ops *ops, void *device);
// Waits for programs that had it open and have ended.
void usbfs_free(struct usbfs *u);
// descriptors: device, then configuration, as the kernel shows them in sysfs. 0, -EINVAL (umockdev's words are logged).
int usbfs_plug(struct usbfs *u, int port, int device_number, const uint8_t *descriptors, size_t n, const char *serial);
void usbfs_unplug(struct usbfs *u);
int usbfs_clients(struct usbfs *u); // programs that have it open
