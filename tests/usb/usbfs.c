// tests/usb/usbfs.c - see usbfs.h.
#if __has_include(<umockdev.h>) // else the tests skip
#include "tests/usb/usbfs.h"
#include "solver/take/log.h"

#include <errno.h>
#include <linux/usbdevice_fs.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

enum { URBS_MAX = 64, LOOK_US = 50, LOOKS = 4, // a reap looks so often before it says that there is nothing: a node of umockdev is always ready for poll()
       SETUP_BYTES = 8, IN = 0x80 };

struct urb {
    UMockdevIoctlClient *client;
    UMockdevIoctlData *data;
    uint8_t *bytes; // setup and data to the device, copied when it was submitted; room for data to the host
    bool done;
};

struct usbfs {
    UMockdevTestbed *bed;
    UMockdevIoctlBase *handler;
    const struct usbfs_ops *ops;
    void *device;
    pthread_mutex_t lock;
    pthread_cond_t changed; // n_clients
    int n_clients;
    struct urb urb[URBS_MAX]; // in the order of submission
    int n_urbs;
    uint64_t urb_bytes_max;
    UMockdevIoctlClient *claimed_by;
    char *path, *node; // while it is plugged in
    bool gone;
};

static struct usbdevfs_urb *raw(const struct urb *u)
{
    return (struct usbdevfs_urb *)u->data->data;
}

static void finish(struct urb *u, int result)
{
    raw(u)->status = result < 0 ? result : 0;
    raw(u)->actual_length = result < 0 ? 0 : result;
    u->done = true;
}

static void finish_all(struct usbfs *u, int result)
{
    for (int i = 0; i < u->n_urbs; i++)
        if (!u->urb[i].done)
            finish(&u->urb[i], result);
}

static void drop_urb(struct usbfs *u, int i)
{
    g_object_unref(u->urb[i].data);
    free(u->urb[i].bytes);
    memmove(&u->urb[i], &u->urb[i + 1], (size_t)(--u->n_urbs - i) * sizeof(u->urb[0]));
}

static bool is_in(const struct urb *u)
{
    return (raw(u)->type == USBDEVFS_URB_TYPE_CONTROL ? u->bytes[0] : raw(u)->endpoint) & IN;
}

// Only while that host waits in a request may its memory be looked at.
static UMockdevIoctlData *buffer_of(const struct urb *u, size_t n)
{
    return n ? umockdev_ioctl_data_resolve(u->data, offsetof(struct usbdevfs_urb, buffer), n, NULL) : NULL;
}

static int move(struct usbfs *u, struct urb *urb)
{
    const struct usbdevfs_urb *r = raw(urb);
    const size_t room = (size_t)r->buffer_length, at = r->type == USBDEVFS_URB_TYPE_CONTROL ? SETUP_BYTES : 0;
    const size_t length = at ? urb->bytes[6] | (size_t)urb->bytes[7] << 8 : room;
    int n;
    if (at)
        n = length > room - at ? -EINVAL : u->ops->control(u->device, urb->bytes, urb->bytes + at, length);
    else if (is_in(urb))
        n = u->ops->in(u->device, r->endpoint, urb->bytes, length);
    else
        n = u->ops->out(u->device, r->endpoint, urb->bytes, length);
    if (n > 0 && is_in(urb)) {
        UMockdevIoctlData *b = buffer_of(urb, at + (size_t)n);
        if (!b)
            return -EFAULT;
        memcpy(b->data + at, urb->bytes + at, (size_t)n);
        g_object_unref(b);
    }
    return n;
}

// One urb at a time per endpoint, in order.
static void transfer(struct usbfs *u, UMockdevIoctlClient *client)
{
    uint8_t waits[256] = { 0 };
    for (int i = 0; i < u->n_urbs; i++) {
        struct urb *urb = &u->urb[i];
        if (urb->done || urb->client != client || waits[raw(urb)->endpoint])
            continue;
        const int result = move(u, urb);
        waits[raw(urb)->endpoint] = result == -EAGAIN;
        if (result != -EAGAIN)
            finish(urb, result);
    }
}

static int submit(struct usbfs *u, UMockdevIoctlClient *client, UMockdevIoctlData *data)
{
    struct urb urb = { .client = client, .data = data };
    const struct usbdevfs_urb *r = raw(&urb);
    if (u->n_urbs == URBS_MAX)
        return -ENOMEM;
    if (r->buffer_length < (r->type == USBDEVFS_URB_TYPE_CONTROL ? SETUP_BYTES : 0) || r->buffer_length > 1 << 20)
        return -EINVAL;
    if (r->type != USBDEVFS_URB_TYPE_CONTROL && r->type != USBDEVFS_URB_TYPE_BULK && r->type != USBDEVFS_URB_TYPE_INTERRUPT)
        return -EINVAL;
    const bool brings = r->buffer_length && (r->type == USBDEVFS_URB_TYPE_CONTROL || !(r->endpoint & IN));
    UMockdevIoctlData *b = brings ? buffer_of(&urb, (size_t)r->buffer_length) : NULL;
    urb.bytes = malloc((size_t)r->buffer_length + 1);
    if (!urb.bytes || (brings && !b)) {
        g_clear_object(&b);
        free(urb.bytes);
        return -ENOMEM;
    }
    if (b) {
        memcpy(urb.bytes, b->data, (size_t)r->buffer_length);
        g_object_unref(b);
    }
    g_object_ref(data);
    u->urb[u->n_urbs++] = urb;
    uint64_t in_flight = 0;
    for (int i = 0; i < u->n_urbs; i++)
        in_flight += (uint64_t)raw(&u->urb[i])->buffer_length;
    if (in_flight > u->urb_bytes_max)
        u->urb_bytes_max = in_flight;
    return 0;
}

static int discard(struct usbfs *u, UMockdevIoctlClient *client, gulong address)
{
    for (int i = 0; i < u->n_urbs; i++)
        if (u->urb[i].client == client && u->urb[i].data->client_addr == address && !u->urb[i].done) {
            finish(&u->urb[i], -ENOENT);
            return 0;
        }
    return -EINVAL;
}

// The first urb of this host that is done goes back to it. 0, -EAGAIN, -ENODEV.
static int reap(struct usbfs *u, UMockdevIoctlClient *client)
{
    if (!u->gone)
        transfer(u, client);
    for (int i = 0; i < u->n_urbs; i++)
        if (u->urb[i].client == client && u->urb[i].done) {
            UMockdevIoctlData *cell = umockdev_ioctl_data_resolve(umockdev_ioctl_client_get_arg(client), 0, sizeof(void *), NULL);
            if (!cell)
                return -EFAULT;
            umockdev_ioctl_data_set_ptr(cell, 0, u->urb[i].data);
            g_object_unref(cell);
            drop_urb(u, i);
            return 0;
        }
    return u->gone ? -ENODEV : -EAGAIN;
}

static int handle(struct usbfs *u, UMockdevIoctlClient *client, UMockdevIoctlData *arg)
{
    const gulong request = umockdev_ioctl_client_get_request(client);
    const size_t size = request >> _IOC_SIZESHIFT & ((1 << _IOC_SIZEBITS) - 1);
    int result = 0;
    if (u->gone)
        return -ENODEV;
    if (request == USBDEVFS_DISCARDURB)
        return discard(u, client, *(gulong *)arg->data);
    if (request == USBDEVFS_GETDRIVER)
        return -ENODATA; // no driver of the kernel's has it
    if (request == USBDEVFS_RESET) {
        finish_all(u, -EPROTO);
        u->ops->reset(u->device);
        return 0;
    }
    UMockdevIoctlData *data = size ? umockdev_ioctl_data_resolve(arg, 0, size, NULL) : NULL;
    if (!data)
        return -ENOTTY;
    switch (request) {
    case USBDEVFS_GET_CAPABILITIES:
        *(uint32_t *)data->data = USBDEVFS_CAP_ZERO_PACKET | USBDEVFS_CAP_NO_PACKET_SIZE_LIM | USBDEVFS_CAP_BULK_SCATTER_GATHER | USBDEVFS_CAP_REAP_AFTER_DISCONNECT;
        break;
    case USBDEVFS_CLAIMINTERFACE:
        result = *(unsigned *)data->data ? -ENOENT : u->claimed_by && u->claimed_by != client ? -EBUSY : 0;
        if (!result)
            u->claimed_by = client;
        break;
    case USBDEVFS_RELEASEINTERFACE:
        result = u->claimed_by == client ? 0 : -EINVAL;
        if (!result)
            u->claimed_by = NULL;
        break;
    case USBDEVFS_CLEAR_HALT:
    case USBDEVFS_RESETEP:
        if (u->ops->clear_halt)
            u->ops->clear_halt(u->device, (uint8_t)*(unsigned *)data->data);
        break;
    case USBDEVFS_SETCONFIGURATION:
    case USBDEVFS_SETINTERFACE:
        break;
    case USBDEVFS_SUBMITURB:
        result = submit(u, client, data);
        break;
    default:
        result = -ENOTTY;
    }
    g_object_unref(data);
    return result;
}

static gboolean on_request(UMockdevIoctlBase *handler, UMockdevIoctlClient *client, gpointer arg)
{
    struct usbfs *u = arg;
    const gulong request = umockdev_ioctl_client_get_request(client);
    const bool reaps = request == USBDEVFS_REAPURB || request == USBDEVFS_REAPURBNDELAY;
    int result;
    (void)handler;
    pthread_mutex_lock(&u->lock);
    if (!reaps)
        result = handle(u, client, umockdev_ioctl_client_get_arg(client));
    for (int look = 0; reaps && (result = reap(u, client)) == -EAGAIN && look < LOOKS; look++) {
        pthread_mutex_unlock(&u->lock);
        usleep(LOOK_US);
        pthread_mutex_lock(&u->lock);
    }
    pthread_mutex_unlock(&u->lock);
    umockdev_ioctl_client_complete(client, result < 0 ? -1 : result, result < 0 ? -result : 0);
    return TRUE;
}

// usbfs drops what a program leaves behind. A client ends when its program closes the node or dies, in whatever request.
static void on_gone(gpointer arg, GObject *client)
{
    struct usbfs *u = arg;
    pthread_mutex_lock(&u->lock);
    for (int i = u->n_urbs - 1; i >= 0; i--)
        if ((GObject *)u->urb[i].client == client)
            drop_urb(u, i);
    if ((GObject *)u->claimed_by == client)
        u->claimed_by = NULL;
    u->n_clients--;
    pthread_cond_broadcast(&u->changed);
    pthread_mutex_unlock(&u->lock);
}

static void on_connected(UMockdevIoctlBase *handler, UMockdevIoctlClient *client, gpointer arg)
{
    struct usbfs *u = arg;
    (void)handler;
    pthread_mutex_lock(&u->lock);
    u->n_clients++;
    pthread_mutex_unlock(&u->lock);
    g_object_weak_ref(G_OBJECT(client), on_gone, u);
}

void usbfs_preload(char **argv)
{
    char list[700] = "";
    if (getenv("USBFS_BEGUN"))
        return;
#ifdef __SANITIZE_ADDRESS__
    char line[500];
    FILE *maps = fopen("/proc/self/maps", "r");
    while (maps && !list[0] && fgets(line, sizeof(line), maps)) {
        const char *file = strchr(line, '/');
        if (file && strstr(file, "/libasan.so"))
            snprintf(list, sizeof(list), "%.*s:", (int)strcspn(file, "\n"), file);
    }
    if (maps)
        fclose(maps);
#endif
    strcat(list, "libumockdev-preload.so.0");
    setenv("LD_PRELOAD", list, 1);
    setenv("USBFS_BEGUN", "1", 1);
    execv("/proc/self/exe", argv);
}

// ---- life --------------------------------------------------------------------------------------------------------------------------

int usbfs_new(struct usbfs **out, UMockdevTestbed *bed, const struct usbfs_ops *ops, void *device)
{
    struct usbfs *u = calloc(1, sizeof(*u));
    *out = u;
    if (!u)
        return -ENOMEM;
    pthread_mutex_init(&u->lock, NULL);
    pthread_condattr_t attributes;
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_cond_init(&u->changed, &attributes);
    pthread_condattr_destroy(&attributes);
    u->bed = bed;
    u->ops = ops;
    u->device = device;
    u->handler = umockdev_ioctl_base_new();
    g_signal_connect(u->handler, "handle-ioctl", G_CALLBACK(on_request), u);
    g_signal_connect(u->handler, "client-connected", G_CALLBACK(on_connected), u);
    return 0;
}

int usbfs_clients(struct usbfs *u)
{
    pthread_mutex_lock(&u->lock);
    const int n = u->n_clients;
    pthread_mutex_unlock(&u->lock);
    return n;
}

uint64_t usbfs_urb_bytes_max(struct usbfs *u)
{
    pthread_mutex_lock(&u->lock);
    const uint64_t n = u->urb_bytes_max;
    pthread_mutex_unlock(&u->lock);
    return n;
}

int usbfs_free(struct usbfs *u)
{
    struct timespec until;
    if (!u)
        return 0;
    if (u->path)
        usbfs_unplug(u);
    clock_gettime(CLOCK_MONOTONIC, &until);
    until.tv_sec += 60;
    pthread_mutex_lock(&u->lock);
    while (u->n_clients && !pthread_cond_timedwait(&u->changed, &u->lock, &until))
        continue;
    const bool is_held = u->n_clients;
    pthread_mutex_unlock(&u->lock);
    if (is_held) {
        log_error("usbfs: a program still has it open: it is left as it is");
        return -EBUSY;
    }
    g_object_unref(u->handler);
    while (u->n_urbs)
        drop_urb(u, u->n_urbs - 1);
    free(u);
    return 0;
}

static int add(UMockdevTestbed *bed, const char *text)
{
    GError *e = NULL;
    if (umockdev_testbed_add_from_string(bed, text, &e))
        return 0;
    log_error("usbfs: umockdev does not take a device: %s", e->message);
    g_error_free(e);
    return -EINVAL;
}

static int add_hub(UMockdevTestbed *bed, const char *path, int bus, int number)
{
    char text[1200], *sys = umockdev_testbed_get_sys_dir(bed), *there = g_strdup_printf("%s%s", sys, path);
    const bool is_there = g_file_test(there, G_FILE_TEST_IS_DIR);
    const int minor = 128 * (bus - 1) + number - 1;
    g_free(sys);
    g_free(there);
    if (is_there)
        return 0;
    snprintf(text, sizeof(text),
             "P: %s\nN: bus/usb/%03d/%03d\nE: SUBSYSTEM=usb\nE: DEVTYPE=usb_device\nE: DEVNAME=/dev/bus/usb/%03d/%03d\nE: BUSNUM=%03d\nE: DEVNUM=%03d\nE: MAJOR=189\nE: MINOR=%d\n"
             "A: busnum=%d\\n\nA: devnum=%d\\n\nA: idVendor=1d6b\\n\nA: idProduct=0002\\n\nA: speed=480\\n\nA: bConfigurationValue=1\\n\nA: bDeviceClass=09\\n\nA: dev=189:%d\\n\nA: maxchild=16\\n\n"
             "H: descriptors=12010002090001406B1D020000010000000109021900010100E0000904000001090000000705810304000C\n",
             path, bus, number, bus, number, bus, number, minor, bus, number, minor);
    return add(bed, text);
}

int usbfs_plug(struct usbfs *u, const char *slot, int number, const uint8_t *descriptors, size_t n, const char *serial)
{
    const int bus = atoi(slot), minor = 128 * (bus - 1) + number - 1;
    const char *const ports = strchr(slot, '-') + 1;
    char text[2400], hex[1024], path[400];
    if (n < 18 || 2 * n >= sizeof(hex))
        return -EINVAL;
    int at = snprintf(path, sizeof(path), "/devices/pci0000:00/0000:00:%02d.0/usb%d", 13 + bus, bus), n_hubs = 1;
    int err = add_hub(u->bed, path, bus, n_hubs);
    for (const char *dot = ports; !err && (dot = strchr(dot, '.')); dot++) {
        at += snprintf(path + at, sizeof(path) - (size_t)at, "/%.*s", (int)(dot - slot), slot);
        err = add_hub(u->bed, path, bus, ++n_hubs);
    }
    if (err)
        return err;
    snprintf(path + at, sizeof(path) - (size_t)at, "/%s", slot);
    for (size_t i = 0; i < n; i++)
        snprintf(hex + 2 * i, 3, "%02X", descriptors[i]);
    pthread_mutex_lock(&u->lock);
    u->gone = false;
    u->claimed_by = NULL;
    u->ops->reset(u->device);
    pthread_mutex_unlock(&u->lock);
    u->path = g_strdup_printf("/sys%s", path);
    u->node = g_strdup_printf("/dev/bus/usb/%03d/%03d", bus, number);
    if (!umockdev_testbed_attach_ioctl(u->bed, u->node, u->handler, NULL))
        return -EINVAL;
    const unsigned vendor = descriptors[8] | descriptors[9] << 8, product = descriptors[10] | descriptors[11] << 8;
    snprintf(text, sizeof(text),
             "P: %s\nN: bus/usb/%03d/%03d\nE: SUBSYSTEM=usb\nE: DEVTYPE=usb_device\nE: DEVNAME=%s\nE: BUSNUM=%03d\nE: DEVNUM=%03d\nE: MAJOR=189\nE: MINOR=%d\n"
             "E: PRODUCT=%x/%x/%x\nE: TYPE=%d/%d/%d\n%sA: busnum=%d\\n\nA: devnum=%d\\n\nA: devpath=%s\\n\nA: idVendor=%04x\\n\nA: idProduct=%04x\\n\nA: bcdDevice=%02x%02x\\n\nA: serial=%s\\n\n"
             "A: speed=%d\\n\nA: bConfigurationValue=1\\n\nA: bDeviceClass=%02x\\n\nA: dev=189:%d\\n\nH: descriptors=%s\n",
             path, bus, number, u->node, bus, number, minor, vendor, product, descriptors[12] | descriptors[13] << 8, descriptors[4], descriptors[5], descriptors[6],
             u->ops->properties ? u->ops->properties : "", bus, number, ports, vendor, product, descriptors[13], descriptors[12], serial, u->ops->speed_mbit, descriptors[4], minor, hex);
    return add(u->bed, text);
}

void usbfs_unplug(struct usbfs *u)
{
    pthread_mutex_lock(&u->lock);
    u->gone = true;
    finish_all(u, -ESHUTDOWN);
    u->ops->unplugged(u->device);
    pthread_mutex_unlock(&u->lock);
    umockdev_testbed_detach_ioctl(u->bed, u->node, NULL);
    umockdev_testbed_uevent(u->bed, u->path, "remove");
    umockdev_testbed_remove_device(u->bed, u->path);
    g_free(u->path);
    g_free(u->node);
    u->path = u->node = NULL;
}
#endif
