// tests/usb/usb_camera.c - see usb_camera.h.
#if __has_include(<umockdev.h>) // else the test skips
#include "tests/usb/usb_camera.h"
#include "rigd/digest.h"
#include "solver/take/log.h"

#include <errno.h>
#include <linux/usbdevice_fs.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>

enum { BULK_IN = 0x81, BULK_OUT = 0x02, INTERRUPT_IN = 0x83, INTERFACE = 0, VENDOR = 0x04b0, PRODUCT = 0x043c, // D500
       WAIT_MS = 3, // a node of umockdev is always ready for poll(): reaping waits instead, so that the host does not spin
       URBS_MAX = 64 };

struct urb {
    UMockdevIoctlClient *client;
    UMockdevIoctlData *data;
    bool done;
};

struct usb_camera {
    UMockdevTestbed *bed;
    UMockdevIoctlBase *handler;
    pthread_mutex_t lock;
    pthread_cond_t changed; // paused, n_clients
    int n_clients; // that have it open
    struct ptp_usb ptp;
    struct urb urb[URBS_MAX]; // in the order of submission
    int n_urbs;
    UMockdevIoctlClient *claimed_by;
    char *path, *node; // while it is plugged in
    bool gone, paused, out_stalled;
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

// A control transfer; data of wLength bytes goes to or comes from *data. Bytes moved, -EPIPE: it stalls.
static int control(struct usb_camera *c, const uint8_t setup[8], uint8_t *data, size_t room)
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

// ---- urbs ------------------------------------------------------------------------------------------------------------------------

static struct usbdevfs_urb *raw(const struct urb *u)
{
    return (struct usbdevfs_urb *)u->data->data;
}

static void finish(struct urb *u, int n)
{
    raw(u)->status = n < 0 ? n : 0;
    raw(u)->actual_length = n < 0 ? 0 : n;
    u->done = true;
}

static void finish_all(struct usb_camera *c, int status)
{
    for (int i = 0; i < c->n_urbs; i++)
        if (!c->urb[i].done)
            finish(&c->urb[i], status);
}

static void drop_urb(struct usb_camera *c, int i)
{
    g_object_unref(c->urb[i].data);
    memmove(&c->urb[i], &c->urb[i + 1], (size_t)(--c->n_urbs - i) * sizeof(c->urb[0]));
}

// Into the host's buffer. Only while that host waits in a request may its memory be looked at.
static int fill(struct urb *u, const uint8_t *bytes, int n)
{
    if (n <= 0)
        return n;
    UMockdevIoctlData *buffer = umockdev_ioctl_data_resolve(u->data, offsetof(struct usbdevfs_urb, buffer), (size_t)n, NULL);
    if (!buffer)
        return -EFAULT;
    memcpy(buffer->data, bytes, (size_t)n);
    g_object_unref(buffer);
    return n;
}

// Moves data for the urbs of this host, which waits in a request: one at a time per endpoint, in order.
static void transfer(struct usb_camera *c, UMockdevIoctlClient *client)
{
    bool bulk_waits = false, interrupt_waits = false;
    ptp_usb_step(&c->ptp, clock_ns(CLOCK_MONOTONIC));
    for (int i = 0; i < c->n_urbs; i++) {
        struct urb *u = &c->urb[i];
        uint8_t event[64];
        if (u->done || u->client != client)
            continue;
        if (raw(u)->endpoint == INTERRUPT_IN && !interrupt_waits) {
            const size_t room = (size_t)raw(u)->buffer_length < sizeof(event) ? (size_t)raw(u)->buffer_length : sizeof(event);
            const int n = ptp_usb_event(&c->ptp, event, room);
            interrupt_waits = n == -EAGAIN;
            if (!interrupt_waits) {
                finish(u, fill(u, event, n));
                c->count.n_interrupts++;
            }
        } else if (raw(u)->endpoint == BULK_IN && !bulk_waits) {
            if (c->count.bytes_in >= c->pause_at && ptp_usb_left(&c->ptp) && !c->paused) {
                c->paused = true;
                pthread_cond_broadcast(&c->changed);
            }
            uint8_t *bytes = c->paused ? NULL : malloc((size_t)raw(u)->buffer_length + 1);
            const int n = bytes ? ptp_usb_read(&c->ptp, bytes, (size_t)raw(u)->buffer_length) : -EAGAIN;
            bulk_waits = n == -EAGAIN;
            if (!bulk_waits) {
                finish(u, fill(u, bytes, n));
                c->count.bytes_in += n > 0 ? (uint64_t)n : 0;
            }
            free(bytes);
        }
    }
}

static int submit(struct usb_camera *c, UMockdevIoctlClient *client, UMockdevIoctlData *data)
{
    if (c->n_urbs == URBS_MAX)
        return -ENOMEM;
    struct urb u = { .client = client, .data = data };
    struct usbdevfs_urb *r = raw(&u);
    const size_t at = offsetof(struct usbdevfs_urb, buffer);
    if (r->buffer_length < 0 || r->buffer_length > 64 << 20)
        return -EINVAL;
    if (r->type == USBDEVFS_URB_TYPE_CONTROL) {
        UMockdevIoctlData *b = r->buffer_length >= 8 ? umockdev_ioctl_data_resolve(data, at, (size_t)r->buffer_length, NULL) : NULL;
        if (!b)
            return -EINVAL;
        const size_t length = b->data[6] | (size_t)b->data[7] << 8, room = (size_t)r->buffer_length - 8;
        finish(&u, control(c, b->data, b->data + 8, length < room ? length : room));
        g_object_unref(b);
    } else if (r->type == USBDEVFS_URB_TYPE_BULK && r->endpoint == BULK_OUT) {
        UMockdevIoctlData *b = r->buffer_length ? umockdev_ioctl_data_resolve(data, at, (size_t)r->buffer_length, NULL) : NULL;
        const int err = b ? ptp_usb_write(&c->ptp, b->data, (size_t)r->buffer_length) : 0;
        c->out_stalled |= err != 0;
        finish(&u, c->out_stalled ? -EPIPE : r->buffer_length);
        if (b)
            g_object_unref(b);
    } else if (!(r->type == USBDEVFS_URB_TYPE_BULK && r->endpoint == BULK_IN) && !(r->endpoint == INTERRUPT_IN && r->type != USBDEVFS_URB_TYPE_ISO)) {
        return -ENOENT;
    }
    g_object_ref(data);
    c->urb[c->n_urbs++] = u;
    uint64_t in_flight = 0;
    for (int i = 0; i < c->n_urbs; i++)
        in_flight += (uint64_t)raw(&c->urb[i])->buffer_length;
    if (in_flight > c->count.urb_bytes_max)
        c->count.urb_bytes_max = in_flight;
    return 0;
}

static int discard(struct usb_camera *c, UMockdevIoctlClient *client, gulong address)
{
    for (int i = 0; i < c->n_urbs; i++)
        if (c->urb[i].client == client && c->urb[i].data->client_addr == address && !c->urb[i].done) {
            finish(&c->urb[i], -ENOENT);
            return 0;
        }
    return -EINVAL;
}

// The first urb of this host that is done goes back to it. 0, -EAGAIN, -ENODEV.
static int reap(struct usb_camera *c, UMockdevIoctlClient *client)
{
    if (!c->gone)
        transfer(c, client);
    for (int i = 0; i < c->n_urbs; i++)
        if (c->urb[i].client == client && c->urb[i].done) {
            UMockdevIoctlData *cell = umockdev_ioctl_data_resolve(umockdev_ioctl_client_get_arg(client), 0, sizeof(void *), NULL);
            if (!cell)
                return -EFAULT;
            umockdev_ioctl_data_set_ptr(cell, 0, c->urb[i].data);
            g_object_unref(cell);
            drop_urb(c, i);
            return 0;
        }
    return c->gone ? -ENODEV : -EAGAIN;
}

// ---- requests --------------------------------------------------------------------------------------------------------------------

struct reaping {
    struct usb_camera *c;
    UMockdevIoctlClient *client;
    bool blocks;
};

static void complete(UMockdevIoctlClient *client, int result)
{
    umockdev_ioctl_client_complete(client, result < 0 ? -1 : result, result < 0 ? -result : 0);
}

static gboolean reap_again(gpointer arg)
{
    struct reaping *r = arg;
    pthread_mutex_lock(&r->c->lock);
    const int result = reap(r->c, r->client);
    pthread_mutex_unlock(&r->c->lock);
    if (result == -EAGAIN && r->blocks && umockdev_ioctl_client_get_connected(r->client))
        return G_SOURCE_CONTINUE;
    g_object_set_data(G_OBJECT(r->client), "reaped", result ? NULL : r->client);
    complete(r->client, result);
    return G_SOURCE_REMOVE;
}

static void free_reaping(gpointer arg)
{
    struct reaping *r = arg;
    g_object_unref(r->client);
    free(r);
}

static bool reap_later(struct usb_camera *c, UMockdevIoctlClient *client, bool blocks)
{
    struct reaping *r = malloc(sizeof(*r));
    if (!r)
        return false;
    *r = (struct reaping){ c, g_object_ref(client), blocks };
    GSource *timer = g_timeout_source_new(WAIT_MS);
    g_source_set_callback(timer, reap_again, r, free_reaping);
    g_source_attach(timer, g_main_context_get_thread_default());
    g_source_unref(timer);
    return true;
}

// usbfs drops what a program leaves behind. A client ends when its program closes the node or dies, in whatever request.
static void on_gone(gpointer arg, GObject *client)
{
    struct usb_camera *c = arg;
    pthread_mutex_lock(&c->lock);
    for (int i = c->n_urbs - 1; i >= 0; i--)
        if ((GObject *)c->urb[i].client == client)
            drop_urb(c, i);
    if ((GObject *)c->claimed_by == client)
        c->claimed_by = NULL;
    c->n_clients--;
    pthread_cond_broadcast(&c->changed);
    pthread_mutex_unlock(&c->lock);
}

static void on_connected(UMockdevIoctlBase *handler, UMockdevIoctlClient *client, gpointer arg)
{
    struct usb_camera *c = arg;
    (void)handler;
    pthread_mutex_lock(&c->lock);
    c->n_clients++;
    pthread_mutex_unlock(&c->lock);
    g_object_weak_ref(G_OBJECT(client), on_gone, c);
}

static void bus_reset(struct usb_camera *c)
{
    finish_all(c, -EPROTO);
    ptp_usb_reset(&c->ptp);
    c->paused = c->out_stalled = false;
    c->pause_at = UINT64_MAX;
    c->count.n_resets++;
}

static int handle(struct usb_camera *c, UMockdevIoctlClient *client, UMockdevIoctlData *arg)
{
    const gulong request = umockdev_ioctl_client_get_request(client), value = *(gulong *)arg->data;
    const size_t size = request >> _IOC_SIZESHIFT & ((1 << _IOC_SIZEBITS) - 1);
    int result = 0;
    if (c->gone)
        return -ENODEV;
    if (request == USBDEVFS_DISCARDURB)
        return discard(c, client, value);
    if (request == USBDEVFS_RESET) {
        bus_reset(c);
        return 0;
    }
    if (request == USBDEVFS_GETDRIVER)
        return -ENODATA; // no driver of the kernel's has it
    UMockdevIoctlData *data = size ? umockdev_ioctl_data_resolve(arg, 0, size, NULL) : NULL;
    if (!data)
        return -ENOTTY;
    switch (request) {
    case USBDEVFS_GET_CAPABILITIES:
        *(uint32_t *)data->data = USBDEVFS_CAP_ZERO_PACKET | USBDEVFS_CAP_NO_PACKET_SIZE_LIM | USBDEVFS_CAP_BULK_SCATTER_GATHER |
                                  USBDEVFS_CAP_REAP_AFTER_DISCONNECT;
        break;
    case USBDEVFS_CLAIMINTERFACE:
        result = *(unsigned *)data->data != INTERFACE ? -ENOENT : c->claimed_by && c->claimed_by != client ? -EBUSY : 0;
        if (!result)
            c->claimed_by = client;
        break;
    case USBDEVFS_RELEASEINTERFACE:
        result = c->claimed_by == client ? 0 : -EINVAL;
        if (!result)
            c->claimed_by = NULL;
        break;
    case USBDEVFS_CLEAR_HALT:
    case USBDEVFS_RESETEP:
        if (*(unsigned *)data->data == BULK_OUT)
            c->out_stalled = false;
        break;
    case USBDEVFS_SETCONFIGURATION:
    case USBDEVFS_SETINTERFACE:
        break;
    case USBDEVFS_SUBMITURB:
        result = submit(c, client, data);
        break;
    default:
        result = -ENOTTY;
    }
    g_object_unref(data);
    return result;
}

static gboolean on_request(UMockdevIoctlBase *handler, UMockdevIoctlClient *client, gpointer arg)
{
    struct usb_camera *c = arg;
    const gulong request = umockdev_ioctl_client_get_request(client);
    const bool reaps = request == USBDEVFS_REAPURB || request == USBDEVFS_REAPURBNDELAY;
    (void)handler;
    pthread_mutex_lock(&c->lock);
    const int result = reaps ? reap(c, client) : handle(c, client, umockdev_ioctl_client_get_arg(client));
    pthread_mutex_unlock(&c->lock);
    // libusb reaps until there is nothing more, then polls: only what follows a poll() waits.
    const bool has_polled = !g_object_get_data(G_OBJECT(client), "reaped");
    if (reaps)
        g_object_set_data(G_OBJECT(client), "reaped", result ? NULL : client);
    if (!reaps || result != -EAGAIN || !(has_polled || request == USBDEVFS_REAPURB) || !reap_later(c, client, request == USBDEVFS_REAPURB))
        complete(client, result);
    return TRUE;
}

// ---- life --------------------------------------------------------------------------------------------------------------------------

int usb_camera_new(struct usb_camera **out, UMockdevTestbed *bed, const struct personality *personality, struct scene *scene)
{
    *out = NULL;
    struct usb_camera *c = calloc(1, sizeof(*c));
    if (!c)
        return -ENOMEM;
    const int err = ptp_usb_open(&c->ptp, personality, scene, clock_ns(CLOCK_MONOTONIC), clock_ns(CLOCK_REALTIME));
    if (err) {
        free(c);
        return err;
    }
    pthread_mutex_init(&c->lock, NULL);
    pthread_cond_init(&c->changed, NULL);
    c->pause_at = UINT64_MAX;
    c->bed = bed;
    c->handler = umockdev_ioctl_base_new();
    g_signal_connect(c->handler, "handle-ioctl", G_CALLBACK(on_request), c);
    g_signal_connect(c->handler, "client-connected", G_CALLBACK(on_connected), c);
    *out = c;
    return 0;
}

void usb_camera_free(struct usb_camera *c)
{
    if (!c)
        return;
    if (c->path)
        usb_camera_unplug(c);
    const struct timespec until = { clock_ns(CLOCK_REALTIME) / 1000000000 + 5, 0 };
    pthread_mutex_lock(&c->lock);
    while (c->n_clients && !pthread_cond_timedwait(&c->changed, &c->lock, &until))
        continue;
    const bool is_held = c->n_clients;
    pthread_mutex_unlock(&c->lock);
    if (is_held) {
        log_error("usb_camera: a program still has it open: it is left as it is");
        return;
    }
    g_object_unref(c->handler);
    while (c->n_urbs)
        drop_urb(c, c->n_urbs - 1);
    ptp_usb_close(&c->ptp);
    free(c);
}

static int add(UMockdevTestbed *bed, const char *text)
{
    GError *e = NULL;
    if (umockdev_testbed_add_from_string(bed, text, &e))
        return 0;
    log_error("usb_camera: umockdev does not take a device: %s", e->message);
    g_error_free(e);
    return -EINVAL;
}

static int add_hub(UMockdevTestbed *bed, const char *path, int number, const char *below)
{
    char text[1200], at[300], *sys = umockdev_testbed_get_sys_dir(bed);
    snprintf(at, sizeof(at), "%s%s", sys, path);
    g_free(sys);
    if (g_file_test(at, G_FILE_TEST_IS_DIR))
        return 0;
    snprintf(text, sizeof(text),
             "P: %s\nN: bus/usb/001/%03d\nE: SUBSYSTEM=usb\nE: DEVTYPE=usb_device\nE: DEVNAME=/dev/bus/usb/001/%03d\n"
             "E: BUSNUM=001\nE: DEVNUM=%03d\nE: MAJOR=189\nE: MINOR=%d\nA: busnum=1\\n\nA: devnum=%d\\n\nA: idVendor=1d6b\\n\nA: idProduct=0002\\n\n"
             "A: speed=480\\n\nA: bConfigurationValue=1\\n\nA: bDeviceClass=09\\n\nA: dev=189:%d\\n\nA: maxchild=%s\\n\n"
             "H: descriptors=12010002090001406B1D020000010000000109021900010100E0000904000001090000000705810304000C\n",
             path, number, number, number, number - 1, number, number - 1, below);
    return add(bed, text);
}

int usb_camera_plug(struct usb_camera *c, int number)
{
    static const char root[] = "/devices/pci0000:00/0000:00:14.0/usb1", hub[] = "/devices/pci0000:00/0000:00:14.0/usb1/1-4";
    char text[2000], hex[2 * sizeof(descriptors) + 1], path[200];
    for (size_t i = 0; i < sizeof(descriptors); i++)
        snprintf(hex + 2 * i, 3, "%02X", descriptors[i]);
    snprintf(path, sizeof(path), "%s/%s", hub, USB_CAMERA_SLOT);
    int err = add_hub(c->bed, root, 1, "16");
    err = err ? err : add_hub(c->bed, hub, 2, "4");
    if (err)
        return err;
    pthread_mutex_lock(&c->lock);
    ptp_usb_reset(&c->ptp);
    c->gone = c->paused = c->out_stalled = false;
    c->pause_at = UINT64_MAX;
    c->claimed_by = NULL;
    pthread_mutex_unlock(&c->lock);
    c->path = g_strdup_printf("/sys%s", path);
    c->node = g_strdup_printf("/dev/bus/usb/001/%03d", number);
    if (!umockdev_testbed_attach_ioctl(c->bed, c->node, c->handler, NULL))
        return -EINVAL;
    snprintf(text, sizeof(text),
             "P: %s\nN: bus/usb/001/%03d\nE: SUBSYSTEM=usb\nE: DEVTYPE=usb_device\nE: DEVNAME=/dev/bus/usb/001/%03d\nE: BUSNUM=001\nE: DEVNUM=%03d\n"
             "E: MAJOR=189\nE: MINOR=%d\nE: ID_GPHOTO2=1\nE: GPHOTO2_DRIVER=PTP\nE: PRODUCT=%x/%x/100\nE: TYPE=0/0/0\n"
             "A: busnum=1\\n\nA: devnum=%d\\n\nA: devpath=4.3\\n\nA: idVendor=%04x\\n\nA: idProduct=%04x\\n\nA: serial=%s\\n\n"
             "A: speed=480\\n\nA: bConfigurationValue=1\\n\nA: bDeviceClass=00\\n\nA: dev=189:%d\\n\nH: descriptors=%s\n",
             path, number, number, number, number - 1, VENDOR, PRODUCT, number, VENDOR, PRODUCT, c->ptp.body.serial, number - 1, hex);
    return add(c->bed, text);
}

void usb_camera_unplug(struct usb_camera *c)
{
    pthread_mutex_lock(&c->lock);
    c->gone = true;
    finish_all(c, -ESHUTDOWN);
    pthread_mutex_unlock(&c->lock);
    umockdev_testbed_detach_ioctl(c->bed, c->node, NULL);
    umockdev_testbed_uevent(c->bed, c->path, "remove");
    umockdev_testbed_remove_device(c->bed, c->path);
    g_free(c->path);
    g_free(c->node);
    c->path = c->node = NULL;
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
    const struct usb_camera_count count = c->count;
    pthread_mutex_unlock(&c->lock);
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
