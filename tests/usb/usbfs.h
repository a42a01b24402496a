// tests/usb/usbfs.h - a USB device behind umockdev: sysfs, device node and usbfs requests; the real libusb of a program that runs
// under umockdev's preload finds it, opens it and moves bytes to and from whatever plays the device.
//
// What it stands in for is the kernel: one claim per interface, urbs of a program that ends are dropped, urbs time out by nobody (libusb
// discards them), a bus reset ends the transfers, after an unplug pending urbs come back with ESHUTDOWN and everything else is ENODEV.
// umockdev's own thread answers the host, and calls the device from there; every call here may be made at any time from another one.
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
    void (*clear_halt)(void *device, uint8_t endpoint); // NULL: none of its endpoints stays halted
    int speed_mbit;
    const char *properties; // more for udev, as umockdev's lines ("E: KEY=value\n"), or NULL
};

struct usbfs;

// Unplugged. 0, -ENOMEM.
int usbfs_new(struct usbfs **out, UMockdevTestbed *bed, const struct usbfs_ops *ops, void *device);
// Waits for programs that had it open and have ended. 0; -EBUSY: one still has it, it and its device must be left as they are (logged).
int usbfs_free(struct usbfs *u);
// slot: as the kernel names it, "1-4.3" for bus 1, a hub at port 4, its port 3; the hubs come with the first device and stay, and have the
// device numbers from 1 on. descriptors: device, then configuration, as the kernel shows them in sysfs. 0, -EINVAL (logged).
int usbfs_plug(struct usbfs *u, const char *slot, int device_number, const uint8_t *descriptors, size_t n, const char *serial);
void usbfs_unplug(struct usbfs *u);
int usbfs_clients(struct usbfs *u); // programs that have it open
uint64_t usbfs_urb_bytes_max(struct usbfs *u); // of all urbs in flight at one time: what usbfs_memory_mb must hold

// umockdev redirects a program from within, and what that starts: the program begins anew with its library loaded first (second, after
// the sanitizer's). Returns in the program that has begun anew, or where that is impossible: umockdev_in_mock_environment() tells.
void usbfs_preload(char **argv);
