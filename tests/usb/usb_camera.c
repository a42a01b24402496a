// tests/usb/usb_camera.c - see usb_camera.h.
#if __has_include(<umockdev.h>) // else the test skips
#include "tests/usb/usb_camera.h"
#include "rigd/digest.h"

#include <errno.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { BULK_IN = 0x81, BULK_OUT = 0x02, INTERRUPT_IN = 0x83, INTERFACE = 0, VENDOR = 0x04b0, PRODUCT = 0x043c }; // D500

struct usb_camera {
    struct usbfs *usb;
    pthread_mutex_t lock;   // of what follows; never held while usb is called
    pthread_cond_t changed; // paused
    struct ptp_usb ptp;
    bool plugged, paused, out_stalled;
    uint64_t pause_at; // of count.bytes_in; UINT64_MAX: never
    struct usb_camera_count count;
};

static int64_t clock_ns(clockid_t id)
{
    struct timespec t;
    clock_gettime(id, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

// ---- descriptors ---------------------------------------------------------------------------------------------------------------

static const uint8_t descriptors[] = {
    18, 1, 0x00, 0x02, 0, 0, 0, 64, VENDOR & 255, VENDOR >> 8, PRODUCT & 255, PRODUCT >> 8, 0x00, 0x01, 1, 2, 3, 1,
    9, 2, 39, 0, 1, 1, 0, 0xc0, 1,
    9, 4, INTERFACE, 0, 3, 6, 1, 1, 0, // still image, PTP
    7, 5, BULK_IN, 2, PTP_USB_PACKET & 255, PTP_USB_PACKET >> 8, 0,
    7, 5, BULK_OUT, 2, PTP_USB_PACKET & 255, PTP_USB_PACKET >> 8, 0,
    7, 5, INTERRUPT_IN, 3, 32, 0, 8,
};
enum { DEVICE_BYTES = 18 };

static int put_string(const struct usb_camera *c, int index, uint8_t *to, size_t room)
{
    const struct personality *p = c->ptp.body.personality;
    const char *text = index == 1 ? p->manufacturer : index == 2 ? p->model : index == 3 ? c->ptp.body.serial : NULL;
    uint8_t d[2 + 2 * 48] = { 4, 3, 0x09, 0x04 }; // 0: the languages, one of them: US English
    if (index && !text)
        return -EPIPE;
    if (text) {
        const size_t n = strlen(text); // < 48
        d[0] = (uint8_t)(2 + 2 * n);
        for (size_t i = 0; i < n; i++) {
            d[2 + 2 * i] = (uint8_t)text[i];
            d[3 + 2 * i] = 0;
        }
    }
    const size_t n = d[0] < room ? d[0] : room;
    memcpy(to, d, n);
    return (int)n;
}

static int answer(struct usb_camera *c, const uint8_t setup[8], uint8_t *data, size_t room)
{
    const uint8_t type = setup[0], request = setup[1], kind = setup[3], index = setup[2];
    if ((type & 0x60) == 0x20)
        return ptp_usb_class_request(&c->ptp, request, data, room);
    if (type == 0x80 && request == 6 && (kind == 1 || kind == 2)) {
        const size_t all = kind == 1 ? DEVICE_BYTES : sizeof(descriptors) - DEVICE_BYTES, n = all < room ? all : room;
        memcpy(data, descriptors + (kind == 1 ? 0 : DEVICE_BYTES), n);
        return (int)n;
    }
    if (type == 0x80 && request == 6 && kind == 3)
        return put_string(c, index, data, room);
    if ((type & 0xe0) == 0x80 && request == 0 && room >= 2) { // GET_STATUS: nothing is halted
        data[0] = data[1] = 0;
        return 2;
    }
    if (type == 0x80 && request == 8 && room >= 1) { // GET_CONFIGURATION
        data[0] = 1;
        return 1;
    }
    if (!(type & 0xe0) && (request == 1 || request == 9 || request == 11)) // CLEAR_FEATURE, SET_CONFIGURATION, SET_INTERFACE
        return 0;
    return -EPIPE;
}

// ---- a device on the bus ---------------------------------------------------------------------------------------------------------

static struct usb_camera *lock(void *device)
{
    struct usb_camera *c = device;
    pthread_mutex_lock(&c->lock);
    ptp_usb_step(&c->ptp, clock_ns(CLOCK_MONOTONIC));
    return c;
}

static int control(void *device, const uint8_t setup[8], uint8_t *data, size_t room)
{
    struct usb_camera *c = lock(device);
    const int n = answer(c, setup, data, room);
    pthread_mutex_unlock(&c->lock);
    return n;
}

static int out(void *device, uint8_t endpoint, const uint8_t *bytes, size_t n)
{
    struct usb_camera *c = lock(device);
    if (endpoint == BULK_OUT && n)
        c->out_stalled |= ptp_usb_write(&c->ptp, bytes, n) != 0;
    const bool stalls = endpoint != BULK_OUT || c->out_stalled;
    pthread_mutex_unlock(&c->lock);
    return stalls ? -EPIPE : (int)n;
}

static int bulk_in(struct usb_camera *c, uint8_t *bytes, size_t room)
{
    if (c->count.bytes_in >= c->pause_at && ptp_usb_left(&c->ptp) && !c->paused) {
        c->paused = true;
        pthread_cond_broadcast(&c->changed);
    }
    const int n = c->paused ? -EAGAIN : ptp_usb_read(&c->ptp, bytes, room);
    c->count.bytes_in += n > 0 ? (uint64_t)n : 0;
    return n;
}

static int in(void *device, uint8_t endpoint, uint8_t *bytes, size_t room)
{
    struct usb_camera *c = lock(device);
    const int n = endpoint == BULK_IN ? bulk_in(c, bytes, room) : endpoint == INTERRUPT_IN ? ptp_usb_event(&c->ptp, bytes, room) : -EPIPE;
    c->count.n_interrupts += endpoint == INTERRUPT_IN && n != -EAGAIN;
    pthread_mutex_unlock(&c->lock);
    return n;
}

static void reset(void *device)
{
    struct usb_camera *c = lock(device);
    ptp_usb_reset(&c->ptp);
    c->count.n_resets += c->plugged;
    c->plugged = true;
    c->paused = c->out_stalled = false;
    c->pause_at = UINT64_MAX;
    pthread_mutex_unlock(&c->lock);
}

static void unplugged(void *device)
{
    struct usb_camera *c = lock(device);
    c->plugged = false;
    pthread_mutex_unlock(&c->lock);
}

static void clear_halt(void *device, uint8_t endpoint)
{
    struct usb_camera *c = lock(device);
    if (endpoint == BULK_OUT)
        c->out_stalled = false;
    pthread_mutex_unlock(&c->lock);
}

static const struct usbfs_ops camera_ops = { .control = control, .out = out, .in = in, .reset = reset, .unplugged = unplugged, .clear_halt = clear_halt,
                                             .speed_mbit = 480, .properties = "E: ID_GPHOTO2=1\nE: GPHOTO2_DRIVER=PTP\n" };

// ---- life --------------------------------------------------------------------------------------------------------------------------

int usb_camera_new(struct usb_camera **camera, UMockdevTestbed *bed, const struct personality *personality, struct scene *scene)
{
    *camera = NULL;
    struct usb_camera *c = calloc(1, sizeof(*c));
    if (!c)
        return -ENOMEM;
    int err = ptp_usb_open(&c->ptp, personality, scene, clock_ns(CLOCK_MONOTONIC), clock_ns(CLOCK_REALTIME));
    if (!err && (err = usbfs_new(&c->usb, bed, &camera_ops, c)))
        ptp_usb_close(&c->ptp);
    if (err) {
        free(c);
        return err;
    }
    pthread_mutex_init(&c->lock, NULL);
    pthread_cond_init(&c->changed, NULL);
    c->pause_at = UINT64_MAX;
    *camera = c;
    return 0;
}

void usb_camera_free(struct usb_camera *c)
{
    if (!c || usbfs_free(c->usb))
        return;
    ptp_usb_close(&c->ptp);
    free(c);
}

int usb_camera_plug(struct usb_camera *c, int number)
{
    return usbfs_plug(c->usb, USB_CAMERA_SLOT, number, descriptors, sizeof(descriptors), c->ptp.body.serial);
}

void usb_camera_unplug(struct usb_camera *c)
{
    usbfs_unplug(c->usb);
}

void usb_camera_hang(struct usb_camera *c)
{
    pthread_mutex_lock(&c->lock);
    c->ptp.hung = true;
    pthread_mutex_unlock(&c->lock);
}

void usb_camera_pause_after(struct usb_camera *c, uint64_t n)
{
    pthread_mutex_lock(&c->lock);
    c->pause_at = c->count.bytes_in + n;
    pthread_mutex_unlock(&c->lock);
}

void usb_camera_resume(struct usb_camera *c)
{
    pthread_mutex_lock(&c->lock);
    c->paused = false;
    c->pause_at = UINT64_MAX;
    pthread_mutex_unlock(&c->lock);
}

bool usb_camera_wait_paused(struct usb_camera *c, int timeout_ms)
{
    const int64_t until = clock_ns(CLOCK_REALTIME) + (int64_t)timeout_ms * 1000000;
    const struct timespec t = { until / 1000000000, until % 1000000000 };
    pthread_mutex_lock(&c->lock);
    while (!c->paused && !pthread_cond_timedwait(&c->changed, &c->lock, &t))
        continue;
    const bool paused = c->paused;
    pthread_mutex_unlock(&c->lock);
    return paused;
}

struct usb_camera_count usb_camera_counts(struct usb_camera *c)
{
    pthread_mutex_lock(&c->lock);
    struct usb_camera_count count = c->count;
    pthread_mutex_unlock(&c->lock);
    count.urb_bytes_max = usbfs_urb_bytes_max(c->usb);
    return count;
}

int usb_camera_digest(struct usb_camera *c, const char *name, char hex[33], int64_t *size_bytes)
{
    struct frame *f = NULL;
    struct digest *d = NULL;
    uint8_t bytes[4096];
    int err = -ENOENT;
    pthread_mutex_lock(&c->lock);
    for (int i = 0; i < c->ptp.body.n_objects; i++) {
        const struct body_object *o = &c->ptp.body.object[i];
        if (!strcmp(o->name, name) && o->file)
            err = frame_open(&f, c->ptp.scene, &c->ptp.body, &o->exposure, o->file);
    }
    if (!err && !(d = digest_begin()))
        err = -ENOMEM;
    if (!err) {
        const uint64_t size = frame_size(f);
        for (uint64_t at = 0; at < size;) {
            const size_t n = size - at < sizeof(bytes) ? (size_t)(size - at) : sizeof(bytes);
            frame_read(f, at, bytes, n);
            digest_add(d, bytes, n);
            at += n;
        }
        digest_end(d, hex);
        *size_bytes = (int64_t)size;
    }
    frame_close(f);
    pthread_mutex_unlock(&c->lock);
    return err;
}
#endif
