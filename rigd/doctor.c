// rigd/doctor.c - looks at /sys and /proc, touches no camera.
//
// Figures from RIG.md 1: a PTP camera takes 4 endpoints of the 96 that common controllers have; usbfs gives 16 MB to all devices
// together unless told otherwise, and libgphoto2 reads 512 KiB blocks.
#include "rigd/doctor.h"
#include "firmware/protocol.h"
#include "rigd/access.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <sys/timex.h>
#include <unistd.h>

enum { ENDPOINTS_PER_CAMERA = 4, ENDPOINTS_PER_CONTROLLER = 96, BLOCK_KB = 512 };

struct examination {
    const struct config *config;
    const char *root;
    struct json *list;
    bool healthy;
};

__attribute__((format(printf, 4, 5))) static void find(struct examination *x, const char *severity, const char *about, const char *format, ...)
{
    char text[500];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof(text), format, args);
    va_end(args);
    struct json *o = json_new_object();
    json_set_string(o, "severity", severity);
    json_set_string(o, "about", about);
    json_set_string(o, "text", text);
    json_append(x->list, o);
    if (!strcmp(severity, "error"))
        x->healthy = false;
}

// First line of root/path. False: not there.
static bool read_line(const struct examination *x, const char *path, char *out, size_t room)
{
    char full[600];
    snprintf(full, sizeof(full), "%s%s", x->root, path);
    FILE *f = fopen(full, "re");
    const bool got = f && fgets(out, (int)room, f);
    if (f)
        fclose(f);
    if (got)
        out[strcspn(out, "\n")] = 0;
    return got;
}

static int read_number(const struct examination *x, const char *path, int missing)
{
    char text[40];
    return read_line(x, path, text, sizeof(text)) ? atoi(text) : missing;
}

static void check_endpoints(struct examination *x)
{
    int n[256] = { 0 };
    for (int i = 0; i < x->config->n_cameras; i++)
        n[x->config->camera[i].controller]++;
    for (int c = 1; c < 256; c++) {
        const int endpoints = n[c] * ENDPOINTS_PER_CAMERA, bus = c - 1; // config.c: 0 is no USB
        if (endpoints > ENDPOINTS_PER_CONTROLLER)
            find(x, "error", "endpoints", "USB bus %d: %d cameras take %d endpoints, common controllers have %d (about %d cameras): move %d cameras to another controller card", bus, n[c],
                 endpoints, ENDPOINTS_PER_CONTROLLER, ENDPOINTS_PER_CONTROLLER / ENDPOINTS_PER_CAMERA, n[c] - ENDPOINTS_PER_CONTROLLER / ENDPOINTS_PER_CAMERA);
        else if (n[c])
            find(x, "info", "endpoints", "USB bus %d: %d cameras, %d of about %d endpoints", bus, n[c], endpoints, ENDPOINTS_PER_CONTROLLER);
    }
}

static void check_usbfs(struct examination *x)
{
    bool on[256] = { false };
    int n_usb = 0, n_controllers = 0;
    for (int i = 0; i < x->config->n_cameras; i++)
        if (x->config->camera[i].controller) {
            n_usb++;
            n_controllers += !on[x->config->camera[i].controller];
            on[x->config->camera[i].controller] = true;
        }
    if (!n_usb)
        return;
    const int parallel = x->config->fetch_limit * n_controllers < n_usb ? x->config->fetch_limit * n_controllers : n_usb;
    const int needed_mb = (parallel * BLOCK_KB + 1023) / 1024 + n_usb * 16 / 1024 + 1;
    const int have_mb = read_number(x, "/sys/module/usbcore/parameters/usbfs_memory_mb", -1);
    if (have_mb < 0)
        find(x, "warning", "usbfs", "cannot read usbfs_memory_mb; %d MB are needed for %d parallel copies", needed_mb, parallel);
    else if (have_mb && have_mb < needed_mb)
        find(x, "error", "usbfs", "usbfs_memory_mb is %d, %d parallel copies need %d: echo %d > /sys/module/usbcore/parameters/usbfs_memory_mb, and usbcore.usbfs_memory_mb=%d on the kernel's command line", have_mb,
             parallel, needed_mb, 4 * needed_mb, 4 * needed_mb);
    else
        find(x, "info", "usbfs", "usbfs_memory_mb %d, %d needed", have_mb, needed_mb);
}

enum { BOARD_SLOT = CONFIG_CAMERAS_MAX, N_SLOTS }; // after the cameras'

struct slot { // what hangs in a camera's port, or is the trigger board
    char device[40]; // "/dev/bus/usb/001/017"; "": nothing, or no USB camera
    int holder;      // process that has it open; 0: none, or none that we may look at
};

static void look_at_descriptors(const struct examination *x, int pid, struct slot *slots)
{
    char path[700], target[300];
    snprintf(path, sizeof(path), "%s/proc/%d/fd", x->root, pid);
    DIR *d = opendir(path);
    for (const struct dirent *e; d && (e = readdir(d));) {
        const ssize_t n = readlinkat(dirfd(d), e->d_name, target, sizeof(target) - 1);
        if (n < 0)
            continue;
        target[n] = 0;
        for (int i = 0; i < N_SLOTS && !strncmp(target, "/dev/bus/usb/", 13); i++)
            if (!strcmp(target, slots[i].device))
                slots[i].holder = pid;
    }
    if (d)
        closedir(d);
}

// One pass for all cameras: a host has many processes.
static void find_holders(const struct examination *x, struct slot *slots)
{
    char proc[600];
    snprintf(proc, sizeof(proc), "%s/proc", x->root);
    DIR *d = opendir(proc);
    for (const struct dirent *e; d && (e = readdir(d));) {
        const int pid = atoi(e->d_name);
        if (pid > 0)
            look_at_descriptors(x, pid, slots);
    }
    if (d)
        closedir(d);
}

static void check_port(struct examination *x, const struct config_camera *c, struct slot *slot)
{
    char about[40], path[200], full[700], serial[80];
    snprintf(about, sizeof(about), "camera %s", c->name);
    snprintf(path, sizeof(path), "/sys/bus/usb/devices/%.80s/busnum", c->port + 4);
    const int bus = read_number(x, path, -1);
    snprintf(path, sizeof(path), "/sys/bus/usb/devices/%.80s/devnum", c->port + 4);
    const int number = read_number(x, path, -1);
    if (bus < 0 || number < 0) {
        find(x, "error", about, "nothing is plugged into its port %s: check cable, hub and power", c->port);
        return;
    }
    snprintf(path, sizeof(path), "/sys/bus/usb/devices/%.80s/serial", c->port + 4);
    if (c->serial[0] && read_line(x, path, serial, sizeof(serial))) {
        const size_t n = strlen(serial), m = strlen(c->serial); // USB pads with zeros
        if (m > n ? strcmp(c->serial, serial) : strcmp(serial + n - m, c->serial))
            find(x, "error", about, "in its port %s hangs serial %s, rigd.conf says %s: plug the right body, or correct rigd.conf", c->port, serial, c->serial);
    }
    snprintf(slot->device, sizeof(slot->device), "/dev/bus/usb/%03d/%03d", bus, number);
    snprintf(full, sizeof(full), "%s%.39s", x->root, slot->device);
    if (access(full, R_OK | W_OK))
        find(x, "error", about, "%s: %s: install rigd's udev rules, and let rigd's user be in group plugdev", slot->device, strerror(errno));
}

static bool read_attribute(const struct examination *x, const char *device, const char *name, char *out, size_t room)
{
    char path[200];
    snprintf(path, sizeof(path), "/sys/bus/usb/devices/%.60s/%s", device, name);
    out[0] = 0;
    return read_line(x, path, out, room);
}

static unsigned hexadecimal(const struct examination *x, const char *device, const char *name)
{
    char text[20];
    return read_attribute(x, device, name, text, sizeof(text)) ? (unsigned)strtoul(text, NULL, 16) : 0;
}

static void check_this_board(struct examination *x, const char *device, const char *serial, struct slot *slot)
{
    char number[20], full[700];
    const unsigned version = hexadecimal(x, device, "bcdDevice");
    read_attribute(x, device, "busnum", number, sizeof(number));
    const int bus = atoi(number);
    read_attribute(x, device, "devnum", number, sizeof(number));
    snprintf(slot->device, sizeof(slot->device), "/dev/bus/usb/%03d/%03d", bus, atoi(number));
    snprintf(full, sizeof(full), "%s%.39s", x->root, slot->device);
    if (access(full, R_OK | W_OK))
        find(x, "error", "trigger board", "%s: %s: install rigd's udev rules, let rigd's user be in group plugdev, and plug the board in again", slot->device, strerror(errno));
    else if (version >> 8 != PROTO_VERSION >> 8)
        find(x, "error", "trigger board", "board %s at USB %s speaks protocol %x.%x, this rigd %x.%x: flash the firmware that came with it (firmware/README.md)", serial, device, version >> 8, version & 255,
             PROTO_VERSION >> 8, PROTO_VERSION & 255);
    else
        find(x, "info", "trigger board", "board %s at USB %s, firmware's protocol %x.%x", serial, device, version >> 8, version & 255);
}

static void check_board(struct examination *x, struct slot *slot)
{
    char path[600], serial[80], maker[60], product[60], others[200] = "";
    const char *wanted = x->config->trigger.serial;
    int n_found = 0;
    snprintf(path, sizeof(path), "%s/sys/bus/usb/devices", x->root);
    DIR *d = opendir(path);
    for (const struct dirent *e; d && (e = readdir(d));) {
        if (hexadecimal(x, e->d_name, "idVendor") != PROTO_VENDOR_ID || hexadecimal(x, e->d_name, "idProduct") != PROTO_PRODUCT_ID)
            continue;
        read_attribute(x, e->d_name, "serial", serial, sizeof(serial));
        read_attribute(x, e->d_name, "manufacturer", maker, sizeof(maker));
        read_attribute(x, e->d_name, "product", product, sizeof(product));
        if (strcmp(maker, PROTO_MANUFACTURER) || strcmp(product, PROTO_PRODUCT) || (wanted[0] && strcmp(serial, wanted))) {
            const size_t at = strlen(others);
            snprintf(others + at, sizeof(others) - at, "%s%.40s (%.40s %.40s) at %.20s", at ? ", " : "", serial, maker, product, e->d_name);
            continue;
        }
        n_found++;
        check_this_board(x, e->d_name, serial, slot);
    }
    if (d)
        closedir(d);
    if (!n_found && others[0])
        find(x, "error", "trigger board", "no board %s; plugged in: %s: correct [trigger] serial", wanted, others);
    else if (!n_found)
        find(x, "error", "trigger board", "none is plugged in (USB %04x:%04x): look at its cable and its LED", PROTO_VENDOR_ID, PROTO_PRODUCT_ID);
    else if (n_found > 1)
        find(x, "error", "trigger board", "%d are plugged in: name one by [trigger] serial", n_found);
}

static void check_ports(struct examination *x)
{
    struct slot slots[N_SLOTS] = { 0 };
    if (x->config->trigger.kind == TRIGGER_USB)
        check_board(x, &slots[BOARD_SLOT]);
    for (int i = 0; i < x->config->n_cameras; i++)
        if (!strncmp(x->config->camera[i].port, "usb:", 4))
            check_port(x, &x->config->camera[i], &slots[i]);
    find_holders(x, slots);
    for (int i = 0; i < N_SLOTS; i++) {
        char about[40], path[60], name[60] = "?";
        snprintf(path, sizeof(path), "/proc/%d/comm", slots[i].holder);
        if (!slots[i].holder || (read_line(x, path, name, sizeof(name)) && !strncmp(name, "rigd", 4)))
            continue;
        snprintf(about, sizeof(about), "%s%s", i == BOARD_SLOT ? "trigger board" : "camera ", i == BOARD_SLOT ? "" : x->config->camera[i].name);
        find(x, "error", about, "%s is held by %s (process %d): stop it; rigd's udev rules keep the desktop away", slots[i].device, name, slots[i].holder);
    }
}

static void check_clock(struct examination *x)
{
    struct timex t = { 0 };
    if (x->root[0])
        return;
    if (adjtimex(&t) == TIME_ERROR || (t.status & STA_UNSYNC))
        find(x, "warning", "clock", "this machine's clock is not synchronised: install chrony or systemd-timesyncd; takes are named by UTC");
    else
        find(x, "info", "clock", "synchronised");
}

static void check_disk(struct examination *x, const char *takes_dir)
{
    struct statvfs s;
    const struct config *c = x->config;
    const int64_t take_mb = (int64_t)c->raw_mb * c->objects_per_shot * c->n_cameras;
    if (statvfs(takes_dir, &s)) {
        find(x, "error", "disk", "%.200s: %s: create it, and let rigd's user own it", takes_dir, strerror(errno));
        return;
    }
    const int64_t free_mb = (int64_t)((double)s.f_bavail * (double)s.f_frsize / 1048576);
    const int64_t n_takes = take_mb ? (free_mb - (int64_t)c->free_space_mb) / take_mb : 0;
    if (access(takes_dir, W_OK))
        find(x, "error", "disk", "%.200s: %s: let rigd's user own it", takes_dir, strerror(errno));
    else if (free_mb < take_mb + (int64_t)c->free_space_mb)
        find(x, "error", "disk", "%.200s: %lld MB free, a take needs %lld and %u stay free: remove old takes", takes_dir, (long long)free_mb, (long long)take_mb, c->free_space_mb);
    else
        find(x, n_takes < 10 ? "warning" : "info", "disk", "%.200s: room for %lld takes of at most %lld MB", takes_dir, (long long)n_takes, (long long)take_mb);
    if (s.f_favail && s.f_favail < 10000)
        find(x, "warning", "disk", "%.200s: only %llu inodes free", takes_dir, (unsigned long long)s.f_favail);
}

static void check_descriptors(struct examination *x)
{
    const long most = sysconf(_SC_OPEN_MAX);
    const long needed = 4L * x->config->n_cameras + 100;
    if (!x->root[0] && most >= 0 && most < needed)
        find(x, "error", "descriptors", "at most %ld open files, %ld needed: LimitNOFILE=%ld in the unit", most, needed, 4 * needed);
}

// Who can press the button in a browser?
static void check_page(struct examination *x)
{
    const struct config *c = x->config;
    struct listen_address address;
    if (!c->web.listen[0])
        return;
    if (listen_parse(&address, c->web.listen))
        return; // config.c has looked at it
    if (!address.is_loopback)
        find(x, "warning", "page", "%s can be reached from other machines, by those who have the token in %.200s/web-token; nothing is encrypted: keep it in a network of the studio's own, or listen on 127.0.0.1 and use ssh -L",
             c->web.listen, c->state_dir);
    else
        find(x, "info", "page", "%s, for %s on this machine and for nobody outside", c->web.listen, c->web.token_always ? "those who have the token" : "everybody");
}

struct json *doctor_examine(const struct config *config, const char *root, const char *takes_dir)
{
    struct examination x = { .config = config, .root = root, .list = json_new_array(), .healthy = true };
    check_endpoints(&x);
    check_usbfs(&x);
    check_ports(&x);
    check_clock(&x);
    check_disk(&x, takes_dir);
    check_descriptors(&x);
    check_page(&x);
    struct json *o = json_new_object();
    json_set_bool(o, "healthy", x.healthy);
    json_set(o, "findings", x.list);
    return o;
}
