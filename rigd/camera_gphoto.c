// rigd/camera_gphoto.c - the only file that knows libgphoto2: its codes become enum camera_trouble, its settings live in memory.
//
// What it works around in 2.5.30 (the driver's sources are the reference):
//  - Loading the list of 2600 bodies costs 9 to 170 ms and 6 MB. The driver needs none of it: a body's abilities are filled in
//    here, and ptp2 is named by its path.
//  - Settings of the driver ("capturetarget") would be written to ~/.gphoto/settings by all processes at once. gp_setting_get and
//    gp_setting_set are defined here, and the dynamic linker prefers them to the library's; 2.5.31's hooks are not needed.
//  - The driver lists each folder once and then believes its events. A listing that must be true is of a new session, unless
//    the free space on the cards is what it was when the session began.
//  - gp_camera_capture waits for an event that may be lost; a download that is not taken whole leaves the link out of step;
//    deleting a name that the driver has lost sight of deletes every picture on the card; a reply to a partial read may be
//    longer than its buffer. See gphoto_trigger, pour, gphoto_delete, chunk.
#include "rigd/camera_gphoto.h"
#include "rigd/digest.h"

#include <arpa/inet.h>
#include <ctype.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <gphoto2/gphoto2-port-info-list.h>
#include <gphoto2/gphoto2-setting.h>
#include <gphoto2/gphoto2-version.h>
#include <gphoto2/gphoto2.h>
#include <linux/usbdevice_fs.h>
#include <malloc.h>
#include <math.h>
#include <poll.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum {
    CHUNK = 1 << 20,          // of a download; what the driver itself asks for
    CHOICES_MAX = 1024,       // of a setting
    FOLDERS_MAX = 4096,       // of a card and kind: counted ones end at 999
    PREVIEW_MAX = 16 << 20,   // bytes
    STORES_MAX = 8,           // that a body may report
};

struct storage { // what the cards say of themselves
    int n;
    struct { uint64_t free_kb, free_images; char folder[32]; } store[STORES_MAX];
};

struct gphoto {
    Camera *camera; // NULL: closed
    GPContext *context;
    const struct personality *personality;
    CameraAbilities abilities;
    char port[64]; // the driver's
    bool usb;
    bool linked;   // the driver's session is open
    bool broken;   // the link: nothing more is said on it
    void (*gone)(void *arg);
    void *arg;
    int64_t deadline_ns;
    char said[160]; // the driver's last words
    int link[4];    // PTP/IP: its sockets
    int n_links;
    struct storage storage; // when the session began
    unsigned char *chunk;   // CHUNK bytes and then a page that traps
};

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void sleep_ms(int ms)
{
    nanosleep(&(struct timespec){ ms / 1000, ms % 1000 * 1000000L }, NULL);
}

// ---- the driver's settings, in memory --------------------------------------------------------------------------------------

// Values are short: ptp2 reads some of them into 20 bytes.
static struct { char id[16], key[32], value[64]; } settings[16] = {
    { "ptp2", "capturetarget", "card" }, // the driver's default is the body's RAM, where nothing is safe
    { "ptp2", "autofocus", "off" },      // a release releases; focusing is for people
    { "ptp2", "cachetime", "0" },        // a setting that is read back is read
};

int gp_setting_get(char *id, char *key, char *value)
{
    for (size_t i = 0; i < sizeof(settings) / sizeof(settings[0]); i++)
        if (!strcmp(settings[i].id, id) && !strcmp(settings[i].key, key)) {
            strcpy(value, settings[i].value);
            return GP_OK;
        }
    value[0] = 0;
    return GP_ERROR;
}

int gp_setting_set(char *id, char *key, char *value)
{
    for (size_t i = 0; i < sizeof(settings) / sizeof(settings[0]); i++)
        if (!settings[i].id[0] || (!strcmp(settings[i].id, id) && !strcmp(settings[i].key, key))) {
            snprintf(settings[i].id, sizeof(settings[i].id), "%s", id);
            snprintf(settings[i].key, sizeof(settings[i].key), "%s", key);
            snprintf(settings[i].value, sizeof(settings[i].value), "%s", value);
            return GP_OK;
        }
    return GP_ERROR_NO_MEMORY;
}

// Likewise the library's: it formats every packet as hexadecimal text, then finds that nobody wants it. 38 % of a download's time.
void gp_log_data(const char *domain, const char *data, unsigned size, const char *format, ...)
{
    (void)domain, (void)data, (void)size, (void)format;
}

// Bodies with PTP/IP are paired with a host by its GUID: all workers of this machine are one host, today and tomorrow.
static void set_guid(void)
{
    char id[64] = "", hex[DIGEST_HEX], guid[48];
    const int fd = open("/etc/machine-id", O_RDONLY | O_CLOEXEC);
    if (fd >= 0) {
        if (read(fd, id, sizeof(id) - 1) < 0)
            id[0] = 0;
        close(fd);
    }
    struct digest *d = digest_begin();
    if (!d)
        return;
    digest_add(d, "studiorig", 9);
    digest_add(d, id, strlen(id));
    digest_end(d, hex);
    for (int i = 0; i < 16; i++)
        snprintf(guid + 3 * i, sizeof(guid) - 3 * (size_t)i, "%.2s:", hex + 2 * i);
    gp_setting_set("ptp2_ip", "guid", guid);
}

// ---- trouble ---------------------------------------------------------------------------------------------------------------

static const int errno_of[CAMERA_N_TROUBLES] = {
    [CAMERA_BUSY] = -EBUSY,      [CAMERA_LOST] = -ENODEV,     [CAMERA_STALLED] = -ETIMEDOUT,
    [CAMERA_REFUSED] = -EOPNOTSUPP, [CAMERA_CARD] = -ENOMEDIUM, [CAMERA_WRONG] = -EPERM,
    [CAMERA_CORRUPT] = -EBADMSG, [CAMERA_DISK] = -EIO,        [CAMERA_BROKEN] = -EPROTO,
};

int gphoto_fail(struct camera_event *e, enum camera_trouble trouble, int err, const char *format, ...)
{
    va_list ap;
    e->trouble = trouble;
    e->err = err ? err : errno_of[trouble];
    va_start(ap, format);
    vsnprintf(e->text, sizeof(e->text), format, ap);
    va_end(ap);
    return -1;
}

// The driver gives one code for most answers of a camera; its words tell them apart (English: the locale is C).
static const struct { const char *words; enum camera_trouble trouble; } sayings[] = {
    { "Busy", CAMERA_BUSY },
    { "Store", CAMERA_CARD },
    { "Object Write Protected", CAMERA_CARD },
    { "Invalid Object Handle", CAMERA_CARD },
    { "Invalid Storage", CAMERA_CARD },
    { "No Thumbnail", CAMERA_CARD },
    { "Incomplete Transfer", CAMERA_CORRUPT },
    { "Session Not Open", CAMERA_LOST },
    { "Transaction", CAMERA_LOST },
    { "Not Supported", CAMERA_REFUSED },
    { "not supported", CAMERA_REFUSED },
    { "Access Denied", CAMERA_REFUSED },
    { "Invalid", CAMERA_REFUSED },
    { "Out of Focus", CAMERA_REFUSED },
    { "Mirror Up", CAMERA_BUSY },
    { "Battery Low", CAMERA_REFUSED },
};

static enum camera_trouble trouble_of(const struct gphoto *g, int code, int64_t began_ns)
{
    switch (code) {
    case GP_ERROR_CAMERA_BUSY: return CAMERA_BUSY;
    case GP_ERROR_TIMEOUT:
    case GP_ERROR_CANCEL: return CAMERA_STALLED;
    case GP_ERROR_CAMERA_ERROR:
    case GP_ERROR_NOT_SUPPORTED:
    case GP_ERROR_BAD_PARAMETERS: return CAMERA_REFUSED;
    case GP_ERROR_FILE_NOT_FOUND:
    case GP_ERROR_DIRECTORY_NOT_FOUND:
    case GP_ERROR_NO_SPACE: return CAMERA_CARD;
    case GP_ERROR_CORRUPTED_DATA: return CAMERA_CORRUPT;
    case GP_ERROR_LIBRARY:
    case GP_ERROR_NO_MEMORY:
    case GP_ERROR_FIXED_LIMIT_EXCEEDED: return CAMERA_BROKEN;
    case GP_ERROR:
        for (size_t i = 0; i < sizeof(sayings) / sizeof(sayings[0]); i++)
            if (strstr(g->said, sayings[i].words))
                return sayings[i].trouble;
        return CAMERA_LOST; // "General Error" is also what it calls a link that ended
    default: // the many codes of ports; over PTP/IP silence is one of them, after 2.5 s
        return now_ns() - began_ns > 2000000000 ? CAMERA_STALLED : CAMERA_LOST;
    }
}

static const char *remedy(const struct gphoto *g, enum camera_trouble trouble)
{
    switch (trouble) {
    case CAMERA_BUSY: return "it is asked again; if it stays busy: manual focus, no menu open, a faster card";
    case CAMERA_LOST: return g->usb ? "check its cable, hub and power" : "check its power and network";
    case CAMERA_STALLED: return "if it does not come back, switch it off and on";
    case CAMERA_REFUSED: return "check its mode dial and menus";
    case CAMERA_CARD: return "check its card: in, unlocked, formatted, not full";
    default: return "see rigctl doctor";
    }
}

static int read_storage(struct gphoto *g, struct storage *out);

// A code and words that do not tell a refusal from a link that ended: the cards are asked for.
static enum camera_trouble ask_what_it_was(struct gphoto *g)
{
    struct storage storage;
    char said[sizeof(g->said)];
    memcpy(said, g->said, sizeof(said));
    const int code = read_storage(g, &storage);
    memcpy(g->said, said, sizeof(said));
    if (code < 0)
        return code == GP_ERROR_CAMERA_BUSY ? CAMERA_BUSY : CAMERA_LOST;
    bool full = storage.n > 0;
    for (int i = 0; i < storage.n; i++)
        full &= storage.store[i].free_images == 0;
    if (full)
        snprintf(g->said, sizeof(g->said), "its card is full");
    return full ? CAMERA_CARD : said[0] ? CAMERA_BUSY : CAMERA_REFUSED; // General Error passes, a refusal without words does not
}

// Every call to the driver is checked by this: code < 0 becomes trouble, and doing says what was tried.
static int failed(struct gphoto *g, struct camera_event *e, int code, int64_t began_ns, const char *doing)
{
    enum camera_trouble trouble = trouble_of(g, code, began_ns);
    if (trouble == CAMERA_LOST && code == GP_ERROR && g->linked)
        trouble = ask_what_it_was(g);
    g->broken |= trouble == CAMERA_LOST || trouble == CAMERA_STALLED || trouble == CAMERA_BROKEN;
    const char *words = trouble == CAMERA_BUSY ? "it is busy" : trouble == CAMERA_STALLED ? "no answer"
                        : g->said[0] ? g->said : gp_result_as_string(code);
    return gphoto_fail(e, trouble, 0, "%s: %.90s: %s", doing, words, remedy(g, trouble));
}

static bool is_fatal(const struct gphoto *g, int code, int64_t began_ns)
{
    const enum camera_trouble t = trouble_of(g, code, began_ns);
    return t == CAMERA_LOST || t == CAMERA_STALLED || t == CAMERA_BROKEN || t == CAMERA_BUSY;
}

// What a body says goes into journals and onto terminals: one line, and nothing that moves a cursor.
static void make_plain(char *text)
{
    for (char *s = text; *s; s++)
        if ((unsigned char)*s < ' ' || *s == 127)
            *s = ' ';
}

static void on_words(GPContext *context, const char *text, void *arg)
{
    struct gphoto *g = arg;
    (void)context;
    snprintf(g->said, sizeof(g->said), "%s", text);
    make_plain(g->said);
}

static GPContextFeedback on_cancel(GPContext *context, void *arg)
{
    struct gphoto *g = arg;
    (void)context;
    g->gone(g->arg);
    return now_ns() > g->deadline_ns ? GP_CONTEXT_FEEDBACK_CANCEL : GP_CONTEXT_FEEDBACK_OK;
}

static int64_t begin(struct gphoto *g)
{
    g->said[0] = 0;
    g->gone(g->arg);
    return now_ns();
}

// ---- life ------------------------------------------------------------------------------------------------------------------

int gphoto_create(struct gphoto **out, void (*gone)(void *arg), void *arg)
{
    const size_t page = (size_t)sysconf(_SC_PAGESIZE);
    *out = NULL;
    struct gphoto *g = calloc(1, sizeof(*g));
    if (!g)
        return -ENOMEM;
    g->gone = gone;
    g->arg = arg;
    g->chunk = mmap(NULL, CHUNK + page, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    g->context = gp_context_new();
    if (g->chunk == MAP_FAILED || mprotect(g->chunk + CHUNK, page, PROT_NONE) || !g->context) {
        gphoto_free(g);
        return -ENOMEM;
    }
    gp_context_set_error_func(g->context, on_words, g);
    gp_context_set_cancel_func(g->context, on_cancel, g);
    set_guid();
    // 200 of these processes run side by side: one heap, which gives its blocks of a megabyte back after a command and not after
    // each of them; and a camera that announces gigabytes gets a failed allocation.
    mallopt(M_ARENA_MAX, 1);
    mallopt(M_MMAP_THRESHOLD, 8 << 20);
    mallopt(M_TRIM_THRESHOLD, 16 << 20);
#ifndef __SANITIZE_ADDRESS__
    setrlimit(RLIMIT_AS, &(struct rlimit){ (rlim_t)1 << 30, (rlim_t)1 << 30 });
#endif
    *out = g;
    return 0;
}

void gphoto_free(struct gphoto *g)
{
    if (!g)
        return;
    gphoto_close(g);
    if (g->context)
        gp_context_unref(g->context);
    if (g->chunk && g->chunk != MAP_FAILED)
        munmap(g->chunk, CHUNK + (size_t)sysconf(_SC_PAGESIZE));
    free(g);
}

bool gphoto_is_open(const struct gphoto *g)
{
    return g->linked && !g->broken;
}

void gphoto_rest(struct gphoto *g)
{
    madvise(g->chunk, CHUNK, MADV_DONTNEED);
    malloc_trim(0);
}

void gphoto_deadline(struct gphoto *g, int64_t at_ns)
{
    g->deadline_ns = at_ns;
    if (g->camera && g->usb) {
        const int64_t ms = (at_ns - now_ns()) / 1000000;
        gp_port_set_timeout(g->camera->port, ms < 200 ? 200 : ms > 20000 ? 20000 : (int)ms);
    }
}

// Nobody but the driver has sockets of the internet family in this process.
static void find_links(struct gphoto *g)
{
    g->n_links = 0;
    for (int fd = CAMERA_FD + 1; fd < 64 && g->n_links < 4; fd++) {
        struct sockaddr_in a;
        socklen_t n = sizeof(a);
        if (!getpeername(fd, (struct sockaddr *)&a, &n) && a.sin_family == AF_INET)
            g->link[g->n_links++] = fd;
    }
}

// 2.5.30 leaves the connections of a body open whose first answers it did not like; then the body takes no other.
static void close_leftover_links(struct gphoto *g)
{
    find_links(g);
    for (int i = 0; i < g->n_links; i++)
        close(g->link[i]);
    g->n_links = 0;
}

// Nor does it close the device of a claim that failed, or of a body that was pulled out. Its library's context is gone when this is called.
static void close_leftover_devices(void)
{
    for (int fd = CAMERA_FD + 1; fd < 256; fd++) {
        char link[32], path[256];
        snprintf(link, sizeof(link), "/proc/self/fd/%d", fd);
        const ssize_t n = readlink(link, path, sizeof(path) - 1);
        path[n > 0 ? n : 0] = 0;
        if (strstr(path, "/dev/bus/usb/"))
            close(fd);
    }
}

static void disconnect(struct gphoto *g)
{
    if (g->broken) { // saying goodbye would wait for every answer
        for (int i = 0; i < g->n_links; i++)
            shutdown(g->link[i], SHUT_RDWR);
        if (g->usb)
            gp_port_set_timeout(g->camera->port, 200);
    }
    gp_camera_exit(g->camera, g->context);
    g->n_links = 0;
    g->linked = false;
}

void gphoto_close(struct gphoto *g)
{
    if (!g->camera)
        return;
    if (g->linked)
        disconnect(g);
    gp_camera_unref(g->camera);
    close_leftover_links(g);
    close_leftover_devices();
    g->camera = NULL;
}

// A number from a file of sysfs; -1: not there.
static long sysfs_number(const char *slot, const char *file, int base)
{
    char path[192], text[16] = "";
    snprintf(path, sizeof(path), "/sys/bus/usb/devices/%.64s/%s", slot, file);
    const int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return -1;
    const ssize_t n = read(fd, text, sizeof(text) - 1);
    close(fd);
    return n > 0 ? strtol(text, NULL, base) : -1;
}

static bool find_usb(struct gphoto *g, const char *slot)
{
    const long vendor = sysfs_number(slot, "idVendor", 16), product = sysfs_number(slot, "idProduct", 16);
    const long bus = sysfs_number(slot, "busnum", 10), device = sysfs_number(slot, "devnum", 10);
    if (vendor <= 0 || product < 0 || bus <= 0 || bus > 999 || device <= 0 || device > 999)
        return false;
    snprintf(g->port, sizeof(g->port), "usb:%03ld,%03ld", bus, device);
    g->abilities.usb_vendor = (int)vendor;
    g->abilities.usb_product = (int)product;
    return true;
}

// The driver beside the library that runs, as the library itself would look for it.
static bool find_driver(char *out, size_t room)
{
    char file[1100];
    const char *folder = getenv("CAMLIBS");
    Dl_info info;
    if (folder && *folder) {
        snprintf(out, room, "%s/ptp2", folder);
    } else {
        if (!dladdr((void *)gp_camera_new, &info) || !info.dli_fname || !strchr(info.dli_fname, '/'))
            return false;
        snprintf(out, room, "%.*s/libgphoto2/%s/ptp2", (int)(strrchr(info.dli_fname, '/') - info.dli_fname), info.dli_fname,
                 gp_library_version(GP_VERSION_SHORT)[0]);
    }
    snprintf(file, sizeof(file), "%s.so", out);
    return !access(file, R_OK);
}

static int find_port(struct gphoto *g, const char *port, bool reset, struct camera_event *e)
{
    g->usb = !strncmp(port, "usb:", 4);
    memset(&g->abilities, 0, sizeof(g->abilities));
    g->abilities.port = g->usb ? GP_PORT_USB : GP_PORT_PTPIP;
    g->abilities.device_type = GP_DEVICE_STILL_CAMERA;
    g->abilities.usb_class = 6, g->abilities.usb_subclass = 1, g->abilities.usb_protocol = 1;
    if (!g->usb) {
        char host[40] = "";
        unsigned command = 0, event = 0;
        int n = 0;
        struct in_addr ignored;
        if (sscanf(port, "ptpip:%39[0-9.]:%5u:%5u%n", host, &command, &event, &n) != 3 || port[n] || !inet_aton(host, &ignored) ||
            !command || command > 65535 || !event || event > 65535)
            return gphoto_fail(e, CAMERA_REFUSED, -EINVAL, "port '%.80s': expected usb:SLOT or ptpip:IPV4:PORT:EVENTPORT", port);
        snprintf(g->port, sizeof(g->port), "%.63s", port);
        return 0;
    }
    const char *slot = port + 4;
    if (!*slot || strspn(slot, "0123456789-.") != strlen(slot) || strstr(slot, ".."))
        return gphoto_fail(e, CAMERA_REFUSED, -EINVAL, "port '%.80s': expected a slot as in /sys/bus/usb/devices: usb:1-4.3", port);
    if (!find_usb(g, slot))
        return gphoto_fail(e, CAMERA_LOST, 0, "nothing is plugged in at %.80s: check its cable, hub and power", port);
    if (!reset)
        return 0;
    char device[64];
    snprintf(device, sizeof(device), "/dev/bus/usb/%.3s/%.3s", g->port + 4, g->port + 8);
    const int fd = open(device, O_WRONLY | O_CLOEXEC);
    if (fd < 0 || ioctl(fd, USBDEVFS_RESET, NULL)) {
        const int err = -errno;
        if (fd >= 0)
            close(fd);
        return gphoto_fail(e, CAMERA_LOST, err, "cannot reset %s: %s: check the udev rule and its cable", device, strerror(-err));
    }
    close(fd);
    for (int i = 0; i < 40 && now_ns() < g->deadline_ns; i++) { // it may come back under another number
        sleep_ms(50);
        if (find_usb(g, slot))
            return 0;
    }
    return gphoto_fail(e, CAMERA_LOST, 0, "%.80s did not come back from a reset: switch it off and on", port);
}

// The driver's code. Of all questions it is the one whose answer is never guessed, cached or swallowed by the driver.
static int read_storage(struct gphoto *g, struct storage *out)
{
    CameraStorageInformation *info = NULL;
    int n = 0;
    memset(out, 0, sizeof(*out));
    const int code = gp_camera_get_storageinfo(g->camera, &info, &n, g->context);
    for (int i = 0; code >= 0 && i < n && out->n < STORES_MAX; i++) {
        if (strlen(info[i].basedir) >= sizeof(out->store[0].folder))
            continue;
        out->store[out->n].free_kb = info[i].fields & GP_STORAGEINFO_FREESPACEKBYTES ? info[i].freekbytes : UINT64_MAX;
        out->store[out->n].free_images = info[i].fields & GP_STORAGEINFO_FREESPACEIMAGES ? info[i].freeimages : UINT64_MAX;
        strcpy(out->store[out->n++].folder, info[i].basedir);
    }
    free(info);
    return code == GP_ERROR_NOT_SUPPORTED ? GP_OK : code; // then nothing is known of its cards
}

static int connect_camera(struct gphoto *g, struct camera_event *e)
{
    GPPortInfoList *ports = NULL;
    GPPortInfo port;
    int64_t began = begin(g);
    g->broken = false;
    int code = gp_port_info_list_new(&ports);
    if (code >= 0)
        code = gp_port_info_list_load(ports);
    if (code >= 0)
        code = gp_port_info_list_lookup_path(ports, g->port);
    if (code >= 0)
        code = gp_port_info_list_get_info(ports, code, &port);
    if (code >= 0)
        code = gp_camera_set_abilities(g->camera, g->abilities);
    if (code >= 0)
        code = gp_camera_set_port_info(g->camera, port);
    if (code >= 0) {
        began = begin(g);
        code = gp_camera_init(g->camera, g->context);
    }
    if (ports)
        gp_port_info_list_free(ports);
    if (code < 0) {
        if (code == GP_ERROR_IO_USB_CLAIM || code == GP_ERROR_IO_LOCK)
            return gphoto_fail(e, CAMERA_LOST, -EBUSY, "another program holds %s: rigctl doctor names it", g->port);
        return failed(g, e, code, began, "cannot open it");
    }
    g->linked = true;
    find_links(g);
    began = begin(g);
    code = read_storage(g, &g->storage);
    return code < 0 && is_fatal(g, code, began) ? failed(g, e, code, began, "cannot ask for its cards") : 0;
}

// ---- settings --------------------------------------------------------------------------------------------------------------

static void widget_text(CameraWidget *w, char *out, size_t room)
{
    CameraWidgetType type = GP_WIDGET_TEXT;
    char *text = NULL;
    int number = 0;
    float real = 0;
    out[0] = 0;
    gp_widget_get_type(w, &type);
    switch (type) {
    case GP_WIDGET_TEXT:
    case GP_WIDGET_RADIO:
    case GP_WIDGET_MENU:
        if (gp_widget_get_value(w, &text) >= 0 && text)
            snprintf(out, room, "%s", text);
        break;
    case GP_WIDGET_TOGGLE:
    case GP_WIDGET_DATE:
        if (gp_widget_get_value(w, &number) >= 0)
            snprintf(out, room, "%d", number);
        break;
    case GP_WIDGET_RANGE:
        if (gp_widget_get_value(w, &real) >= 0)
            snprintf(out, room, "%g", (double)real);
        break;
    default:
        break;
    }
    make_plain(out);
}

// One of the driver's settings by its name. 1 and *out (to be unreferenced), 0: the body does not have it now, < 0: trouble.
static int get_widget(struct gphoto *g, const char *name, CameraWidget **out, struct camera_event *e)
{
    const int64_t began = begin(g);
    *out = NULL;
    const int code = gp_camera_get_single_config(g->camera, name, out, g->context);
    if (code >= 0 && *out)
        return 1;
    *out = NULL;
    if (now_ns() - began > 2000000000) // the driver takes no answer for a name that is not there
        return failed(g, e, GP_ERROR_TIMEOUT, began, "cannot read its settings");
    return code != GP_ERROR_BAD_PARAMETERS && is_fatal(g, code, began) ? failed(g, e, code, began, "cannot read its settings") : 0;
}

static int get_setting(struct gphoto *g, const char *setting, char driver[PERSONALITY_NAME], CameraWidget **out, struct camera_event *e)
{
    int got = 0;
    for (int i = 0; !got && personality_setting_name(g->personality, setting, i, driver); i++)
        got = get_widget(g, driver, out, e);
    return got;
}

// What any body is asked, with names that most have where no personality says more.
static bool body_name(const struct gphoto *g, const char *what, int i, char out[PERSONALITY_NAME])
{
    static const char *const most[][2] = {
        { "serial", "serialnumber" }, { "model", "cameramodel" },     { "firmware", "deviceversion" },
        { "battery", "batterylevel" }, { "lens", "lensname" },        { "clock", "datetime" },
        { "free_images", "availableshots" },
    };
    if (personality_body_name(g->personality, what, i, out))
        return true;
    char ignored[PERSONALITY_NAME];
    if (i || personality_body_name(g->personality, what, 0, ignored))
        return false;
    for (size_t k = 0; k < sizeof(most) / sizeof(most[0]); k++)
        if (!strcmp(most[k][0], what)) {
            snprintf(out, PERSONALITY_NAME, "%s", most[k][1]);
            return true;
        }
    return false;
}

// The i-th of the body's answers to `what` that is not empty, from *i on. 1, 0: no more, < 0: trouble.
static int ask_body(struct gphoto *g, const char *what, int *i, char *out, size_t room, struct camera_event *e)
{
    char name[PERSONALITY_NAME];
    for (; body_name(g, what, *i, name); (*i)++) {
        CameraWidget *w;
        const int got = get_widget(g, name, &w, e);
        if (got < 0)
            return got;
        if (!got)
            continue;
        widget_text(w, out, room);
        gp_widget_unref(w);
        if (out[0]) {
            (*i)++;
            return 1;
        }
    }
    out[0] = 0;
    return 0;
}

static int ask_body_once(struct gphoto *g, const char *what, char *out, size_t room, struct camera_event *e)
{
    int i = 0;
    return ask_body(g, what, &i, out, room, e);
}

static bool is_serial(const char *wanted, const char *found)
{
    wanted += strspn(wanted, "0");
    found += strspn(found, "0");
    return !strcasecmp(wanted, found);
}

int gphoto_open(struct gphoto *g, const struct camera_command *c, const struct personality *personality, struct camera_event *e)
{
    char serial[sizeof(e->facts.serial)] = "";
    int i = 0, got;
    gphoto_close(g);
    g->personality = personality;
    if (find_port(g, c->port, c->reset, e))
        return -1;
    const char *model = c->model[0] ? c->model : g->usb ? "USB PTP Class Camera" : "PTP/IP Camera";
    snprintf(g->abilities.model, sizeof(g->abilities.model), "%s", model);
    if (!find_driver(g->abilities.library, sizeof(g->abilities.library)))
        return gphoto_fail(e, CAMERA_BROKEN, -ENOENT, "libgphoto2's driver ptp2 is not at %.80s: install libgphoto2-6, or set CAMLIBS",
                           g->abilities.library);
    if (gp_camera_new(&g->camera) < 0) {
        g->camera = NULL;
        return gphoto_fail(e, CAMERA_BROKEN, -ENOMEM, "no memory");
    }
    if (connect_camera(g, e)) {
        gphoto_close(g);
        return -1;
    }
    while ((got = ask_body(g, "serial", &i, serial, sizeof(serial), e)) > 0) {
        const bool same = c->serial[0] && is_serial(c->serial, serial);
        if (!e->facts.serial[0] || same)
            strcpy(e->facts.serial, serial);
        if (same)
            break;
    }
    if (got >= 0 && c->serial[0] && !is_serial(c->serial, e->facts.serial))
        got = gphoto_fail(e, CAMERA_WRONG, 0,
                          "the body at %.40s has serial number %s, expected %s",
                          c->port, e->facts.serial[0] ? e->facts.serial : "(none)", c->serial);
    if (got >= 0)
        got = ask_body_once(g, "model", e->facts.model, sizeof(e->facts.model), e);
    if (got >= 0)
        got = ask_body_once(g, "firmware", e->facts.firmware, sizeof(e->facts.firmware), e);
    snprintf(e->facts.driver_port, sizeof(e->facts.driver_port), "%s", g->port);
    if (got < 0) {
        gphoto_close(g);
        return -1;
    }
    return 0;
}

// Put `wanted` into the widget. false: the body does not offer it.
static bool set_widget(struct gphoto *g, CameraWidget *w, const char *setting, const char *wanted)
{
    const char *choice[CHOICES_MAX];
    char word[PERSONALITY_NAME];
    CameraWidgetType type = GP_WIDGET_TEXT;
    int number, read_only = 0;
    float real, least = 0, most = 0, step = 0;
    gp_widget_get_type(w, &type);
    if (gp_widget_get_readonly(w, &read_only) >= 0 && read_only)
        return false;
    personality_driver_value(g->personality, setting, wanted, word);
    switch (type) {
    case GP_WIDGET_RADIO:
    case GP_WIDGET_MENU: {
        int n = gp_widget_count_choices(w), n_good = 0;
        for (int i = 0; i < n && i < CHOICES_MAX; i++)
            if (gp_widget_get_choice(w, i, &choice[n_good]) >= 0 && choice[n_good])
                n_good++;
        number = personality_choose(g->personality, setting, wanted, choice, n_good);
        if (number < 0)
            return false;
        char *copy = strdup(choice[number]); // setting frees what choice points at in some versions
        const bool done = copy && gp_widget_set_value(w, copy) >= 0;
        free(copy);
        return done;
    }
    case GP_WIDGET_TEXT:
        return gp_widget_set_value(w, word) >= 0;
    case GP_WIDGET_TOGGLE:
        number = !strcasecmp(word, "on") || !strcmp(word, "1");
        if (!number && strcasecmp(word, "off") && strcmp(word, "0"))
            return false;
        return gp_widget_set_value(w, &number) >= 0;
    case GP_WIDGET_RANGE:
        if (sscanf(word, "%f", &real) != 1 || gp_widget_get_range(w, &least, &most, &step) < 0 || !(real >= least && real <= most))
            return false;
        return gp_widget_set_value(w, &real) >= 0;
    default:
        return false;
    }
}

static const char not_offered[] = "not offered";

// 1: the widget is the caller's; 0: the body has no such setting now; < 0: trouble.
static int read_found(struct gphoto *g, struct camera_setting_found *f, CameraWidget **w, char driver[PERSONALITY_NAME],
                      struct camera_event *e)
{
    char text[sizeof(f->found)];
    const int got = get_setting(g, f->name, driver, w, e);
    if (got < 0)
        return got;
    f->equal = false;
    strcpy(f->found, not_offered);
    if (got) {
        widget_text(*w, text, sizeof(text));
        f->equal = personality_means(g->personality, f->name, f->wanted, text);
        personality_neutral(g->personality, f->name, text, f->found, sizeof(f->found));
        if (f->equal && personality_means(g->personality, f->name, f->wanted, f->wanted))
            strcpy(f->found, f->wanted); // as people wrote it: 1/125, not 0.0080s
    }
    return got;
}

int gphoto_configure(struct gphoto *g, const struct camera_command *c, struct camera_event *e)
{
    bool any_written = false;
    int64_t began;
    int code;
    struct storage ignored;
    int order[CAMERA_SETTINGS_MAX], at[CAMERA_SETTINGS_MAX];
    char driver[PERSONALITY_NAME];
    CameraWidget *w;
    e->n_settings = c->n_settings;
    for (int i = 0; i < c->n_settings; i++) {
        strcpy(e->setting[i].name, c->setting[i].name);
        strcpy(e->setting[i].wanted, c->setting[i].value);
        const int mine = personality_order(g->personality, c->setting[i].name);
        int k = i;
        for (; k > 0 && order[k - 1] > mine; k--) {
            order[k] = order[k - 1];
            at[k] = at[k - 1];
        }
        order[k] = mine;
        at[k] = i;
    }
    for (int k = 0; k < c->n_settings; k++) {
        struct camera_setting_found *f = &e->setting[at[k]];
        const int got = read_found(g, f, &w, driver, e);
        if (got < 0)
            return got;
        if (!got)
            continue;
        if (!f->equal && set_widget(g, w, f->name, f->wanted)) {
            began = begin(g);
            code = gp_camera_set_single_config(g->camera, driver, w, g->context);
            if (code < 0 && is_fatal(g, code, began)) {
                gp_widget_unref(w);
                return failed(g, e, code, began, "cannot change its settings");
            }
            f->written = any_written = true;
        }
        gp_widget_unref(w);
    }
    // The driver does not tell a setting that is not there from one that a busy body did not speak of.
    began = begin(g);
    code = GP_OK;
    for (int i = 0; i < e->n_settings && code >= 0; i++)
        if (!strcmp(e->setting[i].found, not_offered))
            code = read_storage(g, &ignored);
    if (code < 0)
        return failed(g, e, code, began, "cannot read its settings");
    // Read all of them back: one may have moved another. Bodies take a moment to mean what they said.
    for (int k = 0; any_written && k < c->n_settings; k++) {
        struct camera_setting_found *f = &e->setting[k];
        for (int tries = f->written ? 6 : 1; tries > 0; tries--) {
            const int got = read_found(g, f, &w, driver, e);
            if (got < 0)
                return got;
            if (got)
                gp_widget_unref(w);
            if (f->equal || now_ns() > g->deadline_ns)
                break;
            if (tries > 1)
                sleep_ms(50);
        }
    }
    return 0;
}

// ---- status ----------------------------------------------------------------------------------------------------------------

static int ask_setting(struct gphoto *g, const char *setting, char *out, size_t room, struct camera_event *e)
{
    char driver[PERSONALITY_NAME];
    CameraWidget *w;
    const int got = get_setting(g, setting, driver, &w, e);
    out[0] = 0;
    if (got > 0) {
        widget_text(w, out, room);
        gp_widget_unref(w);
    }
    return got;
}

int gphoto_status(struct gphoto *g, struct camera_event *e)
{
    struct camera_status *s = &e->status;
    struct storage storage;
    char text[64];
    *s = (struct camera_status){ -1, -1, -1, -1, NAN, -1, -1, -1, "" };
    const int64_t began = begin(g);
    const int code = read_storage(g, &storage); // first: a body that is busy or gone says so here
    if (code < 0)
        return failed(g, e, code, began, "cannot ask for its cards");
    int got, i = 0;
    while ((got = ask_body(g, "battery", &i, text, sizeof(text), e)) > 0 && s->battery_percent < 0) {
        const long percent = isdigit((unsigned char)text[0]) ? strtol(text, NULL, 10) : -1;
        s->battery_percent = percent > 100 ? 100 : (int)percent;
        if (!strcasecmp(text, "Low"))
            s->battery_percent = 5; // the last step of a Canon EOS
    }
    if (got >= 0)
        got = ask_body_once(g, "lens", s->lens, sizeof(s->lens), e);
    if (got >= 0)
        got = ask_body_once(g, "clock", text, sizeof(text), e);
    if (got > 0) {
        struct timespec host;
        clock_gettime(CLOCK_REALTIME, &host);
        const long long camera = strtoll(text, NULL, 10); // whole seconds, cut
        if (camera > 0)
            s->clock_offset_s = (double)(camera - host.tv_sec) + 0.5 - (double)host.tv_nsec * 1e-9;
    }
    if (got >= 0)
        got = ask_setting(g, "focusmode", text, sizeof(text), e);
    if (got > 0)
        s->manual_focus = personality_means(g->personality, "focusmode", "manual", text);
    if (got >= 0)
        got = ask_setting(g, "exposuremode", text, sizeof(text), e);
    if (got > 0)
        s->manual_exposure = personality_means(g->personality, "exposuremode", "manual", text);
    if (got >= 0)
        got = ask_setting(g, "imageformat", text, sizeof(text), e);
    if (got > 0)
        s->objects_per_shot = personality_objects(g->personality, "imageformat", text);
    if (got < 0)
        return got;
    s->card_present = storage.n > 0;
    for (int k = 0; k < storage.n; k++) {
        const int64_t bytes = storage.store[k].free_kb == UINT64_MAX ? -1 : (int64_t)(storage.store[k].free_kb * 1024);
        const int64_t images = storage.store[k].free_images == UINT64_MAX ? -1 : (int64_t)storage.store[k].free_images;
        s->free_bytes = bytes > s->free_bytes ? bytes : s->free_bytes;
        s->free_images = images > s->free_images ? images : s->free_images;
    }
    got = ask_body_once(g, "free_images", text, sizeof(text), e); // the body's own word, where it has one
    if (got > 0 && isdigit((unsigned char)text[0]))
        s->free_images = strtoll(text, NULL, 10);
    return got < 0 ? got : 0;
}

// ---- release and events ------------------------------------------------------------------------------------------------------

int gphoto_trigger(struct gphoto *g, struct camera_event *e)
{
    const int64_t began = begin(g);
    const int code = gp_camera_trigger_capture(g->camera, g->context);
    if (code < 0)
        return failed(g, e, code, began, "cannot release its shutter");
    e->pressed_ns = began;
    return 0;
}

// Whether folder and name fit, and could be a frame's: nothing that climbs, hides or breaks lines.
static bool take_object(struct camera_object *out, const char *folder, const char *name, int64_t size)
{
    if (folder[0] != '/' || strlen(folder) >= sizeof(out->folder) || !name[0] || name[0] == '.' || strlen(name) >= sizeof(out->name))
        return false;
    for (const char *s = folder; *s; s++)
        if ((unsigned char)*s < ' ' || (unsigned char)*s > '~')
            return false;
    for (const char *s = name; *s; s++)
        if ((unsigned char)*s < ' ' || (unsigned char)*s > '~' || *s == '/')
            return false;
    memset(out, 0, sizeof(*out));
    strcpy(out->folder, folder);
    strcpy(out->name, name);
    out->size_bytes = size;
    return true;
}

static int64_t object_size(struct gphoto *g, const char *folder, const char *name)
{
    CameraFileInfo info;
    memset(&info, 0, sizeof(info));
    if (gp_camera_file_get_info(g->camera, folder, name, &info, g->context) < 0 || !(info.file.fields & GP_FILE_INFO_SIZE) ||
        info.file.size > INT64_MAX)
        return -1;
    return (int64_t)info.file.size;
}

int gphoto_wait(struct gphoto *g, int64_t until_ns, struct camera_event *e)
{
    enum { POLL_MS = 50 }; // some drivers ask the body in this rhythm, others return at once
    if (until_ns > g->deadline_ns)
        until_ns = g->deadline_ns;
    for (;;) {
        CameraEventType type = GP_EVENT_TIMEOUT;
        void *data = NULL;
        const int64_t began = begin(g), left_ms = (until_ns - began) / 1000000;
        const int ask_ms = left_ms < 1 ? 1 : left_ms < POLL_MS ? (int)left_ms : POLL_MS;
        const int code = gp_camera_wait_for_event(g->camera, ask_ms, &type, &data, g->context);
        if (code < 0) {
            free(data);
            if (is_fatal(g, code, began))
                return failed(g, e, code, began, "cannot read its events");
            return GPHOTO_OTHER; // about an object that is gone again
        }
        if (type == GP_EVENT_FILE_ADDED && data) {
            const CameraFilePath *path = data;
            const bool good = memchr(path->folder, 0, sizeof(path->folder)) && memchr(path->name, 0, sizeof(path->name)) &&
                              take_object(&e->object[0], path->folder, path->name, -1);
            free(data);
            if (!good)
                return GPHOTO_OTHER;
            e->at_ns = now_ns();
            e->object[0].size_bytes = object_size(g, e->object[0].folder, e->object[0].name);
            return GPHOTO_OBJECT;
        }
        free(data);
        if (type != GP_EVENT_TIMEOUT)
            return GPHOTO_OTHER;
        const int64_t now = now_ns();
        if (now >= until_ns)
            return GPHOTO_NOTHING;
        if (now - began < (int64_t)ask_ms * 500000) { // it did not wait: the link shall wake us
            struct pollfd p[4];
            for (int i = 0; i < g->n_links; i++)
                p[i] = (struct pollfd){ .fd = g->link[i], .events = POLLIN };
            const int64_t rest_ms = (until_ns - now) / 1000000;
            poll(p, (nfds_t)g->n_links, rest_ms < POLL_MS ? (int)rest_ms : POLL_MS);
            for (int i = 0; i < g->n_links; i++)
                if (p[i].revents && recv(p[i].fd, &(char){ 0 }, 1, MSG_PEEK | MSG_DONTWAIT) == 0) {
                    g->broken = true;
                    return gphoto_fail(e, CAMERA_LOST, -ECONNRESET, "it closed its connection: %s", remedy(g, CAMERA_LOST));
                }
        }
    }
}

// ---- the card ----------------------------------------------------------------------------------------------------------------

// Folders that cameras count: three digits and five characters.
static int dcf_number(const char *folder)
{
    const char *slash = strrchr(folder, '/'), *s = slash ? slash + 1 : folder;
    if (strlen(s) != 8 || !isdigit((unsigned char)s[0]) || !isdigit((unsigned char)s[1]) || !isdigit((unsigned char)s[2]))
        return -1;
    return (s[0] - '0') * 100 + (s[1] - '0') * 10 + s[2] - '0';
}

// A session whose view of the cards is true: this one, while they are as full as when it began.
static int true_view(struct gphoto *g, struct camera_event *e)
{
    struct storage now;
    const int64_t began = begin(g);
    const int code = read_storage(g, &now);
    if (code < 0 && is_fatal(g, code, began))
        return failed(g, e, code, began, "cannot ask for its cards");
    if (!now.n || memcmp(&now, &g->storage, sizeof(now))) {
        disconnect(g);
        close_leftover_links(g);
        if (connect_camera(g, e)) {
            g->broken = true;
            return -1;
        }
        gphoto_deadline(g, g->deadline_ns);
    }
    gp_filesystem_reset(g->camera->fs);
    return 0;
}

struct listing {
    const struct camera_command *c;
    struct camera_event *e;
    int room; // of what is kept
};

static const struct camera_object *after_of(const struct camera_command *c, const struct camera_object *o)
{
    for (int i = 0; i < c->n_after; i++)
        if (camera_same_store(&c->after[i], o))
            return &c->after[i];
    return NULL;
}

// Keep the newest of each store, or the first of those that are asked for, in order.
static void keep(struct listing *l, const struct camera_object *o)
{
    struct camera_event *e = l->e;
    e->n_objects++;
    if (!l->c->n_objects) {
        for (int i = 0; i < e->n_listed; i++)
            if (camera_same_store(&e->object[i], o)) {
                if (camera_object_order(&e->object[i], o) < 0)
                    e->object[i] = *o;
                return;
            }
        if (e->n_listed < CAMERA_STORES_MAX)
            e->object[e->n_listed++] = *o;
        return;
    }
    const struct camera_object *after = after_of(l->c, o);
    if (after && camera_object_order(o, after) <= 0)
        return;
    int k = e->n_listed;
    if (k == l->room) {
        e->more = true;
        if (camera_object_order(o, &e->object[k - 1]) >= 0)
            return;
        k--;
    } else {
        e->n_listed++;
    }
    for (; k > 0 && camera_object_order(o, &e->object[k - 1]) < 0; k--)
        e->object[k] = e->object[k - 1];
    e->object[k] = *o;
}

// Files of a folder. The number of files, or < 0: trouble.
static int list_files(struct gphoto *g, struct listing *l, const char *folder)
{
    CameraList *list;
    int n_files = 0;
    if (gp_list_new(&list) < 0)
        return gphoto_fail(l->e, CAMERA_BROKEN, -ENOMEM, "no memory for a listing");
    const int64_t began = begin(g);
    const int code = gp_camera_folder_list_files(g->camera, folder, list, g->context);
    if (code < 0)
        n_files = failed(g, l->e, code, began, "cannot list its card");
    const int n = code < 0 ? 0 : gp_list_count(list);
    for (int i = 0; i < n; i++) {
        const char *name = NULL;
        struct camera_object o;
        if (gp_list_get_name(list, i, &name) < 0 || !name || !take_object(&o, folder, name, -1))
            continue;
        n_files++;
        keep(l, &o);
    }
    gp_list_free(list);
    return n_files;
}

struct folders {
    char (*path)[96];
    int n, room;
};

// What would not be looked at is refused: a frame could lie in it. Hidden folders hold none.
static int add_folder(struct listing *l, struct folders *f, const char *parent, const char *name)
{
    if (name[0] == '.')
        return 0;
    if (f->n == FOLDERS_MAX)
        return gphoto_fail(l->e, CAMERA_CARD, -E2BIG, "its card has more than %d folders, and no listing of it is complete: save what is on it, then format it in the body",
                           FOLDERS_MAX);
    if (strlen(parent) + 1 + strlen(name) >= sizeof(f->path[0]))
        return gphoto_fail(l->e, CAMERA_CARD, -ENAMETOOLONG, "its card has a folder in %.60s whose name is too long to look into: remove it, or format the card in the body",
                           parent);
    if (f->n == f->room) {
        const int room = f->room ? 2 * f->room : 32;
        char (*path)[96] = realloc(f->path, (size_t)room * sizeof(*path));
        if (!path)
            return gphoto_fail(l->e, CAMERA_BROKEN, -ENOMEM, "no memory for a listing");
        f->path = path;
        f->room = room;
    }
    char *end = stpcpy(f->path[f->n++], parent);
    if (name[0])
        strcpy(stpcpy(end, "/"), name);
    return 0;
}

static int by_dcf_number(const void *a, const void *b)
{
    return dcf_number(b) - dcf_number(a); // newest first
}

// Breadth first through folders that are not counted by DCF; those that are, newest first and only as far back as needed.
static int list_store(struct gphoto *g, struct listing *l, const char *store)
{
    struct folders other = { 0 }, dcf = { 0 };
    struct camera_object any;
    int result = 0;
    if (!take_object(&any, store, "x", 0))
        goto done;
    result = add_folder(l, &other, store, "");
    for (int i = 0; i < other.n && result >= 0; i++) {
        CameraList *list;
        char folder[sizeof(other.path[0])];
        strcpy(folder, other.path[i]); // the list of them moves when it grows
        result = list_files(g, l, folder);
        if (result < 0)
            break;
        if (gp_list_new(&list) < 0) {
            result = gphoto_fail(l->e, CAMERA_BROKEN, -ENOMEM, "no memory for a listing");
            break;
        }
        const int64_t began = begin(g);
        const int code = gp_camera_folder_list_folders(g->camera, folder, list, g->context);
        if (code < 0)
            result = failed(g, l->e, code, began, "cannot list its card");
        const int n = code < 0 ? 0 : gp_list_count(list);
        for (int k = 0; k < n && result >= 0; k++) {
            const char *name = NULL;
            if (gp_list_get_name(list, k, &name) >= 0 && name && name[0])
                result = add_folder(l, dcf_number(name) >= 0 ? &dcf : &other, folder, name);
        }
        gp_list_free(list);
    }
    const struct camera_object *after = l->c->n_objects ? after_of(l->c, &any) : NULL;
    const int oldest = after ? dcf_number(after->folder) : -1;
    if (dcf.n)
        qsort(dcf.path, (size_t)dcf.n, sizeof(dcf.path[0]), by_dcf_number);
    for (int i = 0, n_files = 0; i < dcf.n && result >= 0; i++) {
        const int number = dcf_number(dcf.path[i]);
        if (number < oldest)
            break;
        result = list_files(g, l, dcf.path[i]);
        n_files += result > 0 ? result : 0;
        if (!l->c->n_objects && n_files && (i + 1 == dcf.n || dcf_number(dcf.path[i + 1]) != number))
            break;
    }
done:
    free(other.path);
    free(dcf.path);
    return result < 0 ? result : 0;
}

int gphoto_list(struct gphoto *g, const struct camera_command *c, struct camera_event *e)
{
    struct listing l = { c, e, c->n_objects < CAMERA_LISTING_MAX ? c->n_objects : CAMERA_LISTING_MAX };
    if (true_view(g, e))
        return -1;
    const struct storage stores = g->storage;
    for (int i = 0; i < stores.n; i++)
        if (list_store(g, &l, stores.store[i].folder))
            return -1;
    for (int i = 0; i < e->n_listed; i++)
        e->object[i].size_bytes = object_size(g, e->object[i].folder, e->object[i].name);
    return 0;
}

// The object's size as the camera announces it; a view that does not have it is renewed once. < 0: trouble.
static int64_t find_object(struct gphoto *g, const struct camera_object *o, struct camera_event *e)
{
    for (int tries = 0;; tries++) {
        CameraFileInfo info;
        memset(&info, 0, sizeof(info));
        const int64_t began = begin(g);
        const int code = gp_camera_file_get_info(g->camera, o->folder, o->name, &info, g->context);
        if (code >= 0 && info.file.fields & GP_FILE_INFO_SIZE && info.file.size <= INT64_MAX)
            return (int64_t)info.file.size;
        if (code < 0 && is_fatal(g, code, began) && code != GP_ERROR)
            return failed(g, e, code, began, "cannot find its frame");
        if (tries)
            return gphoto_fail(e, CAMERA_CARD, -ENOENT, "%.80s/%s is not on its card: was the card changed?", o->folder, o->name);
        if (true_view(g, e))
            return -1;
    }
}

struct pouring {
    gphoto_sink *sink;
    void *arg;
    int err;
    uint64_t size, most;
};

// Once something is wrong the rest is dropped, not refused: a driver that is stopped within an answer takes what is left of it
// for the next one.
static int pour(void *arg, unsigned char *bytes, uint64_t *n)
{
    struct pouring *p = arg;
    const bool fits = p->size <= p->most && *n <= p->most - p->size;
    p->size += *n;
    if (fits && !p->err)
        p->err = p->sink(p->arg, bytes, *n);
    return GP_OK;
}

// In one go, for bodies that cannot read parts.
static int read_whole(struct gphoto *g, const struct camera_object *o, struct pouring *p)
{
    CameraFileHandler handler = { .write = pour };
    CameraFile *file;
    int code = gp_file_new_from_handler(&file, &handler, p);
    if (code < 0)
        return code;
    code = gp_camera_file_get(g->camera, o->folder, o->name, GP_FILE_TYPE_NORMAL, file, g->context);
    gp_file_unref(file);
    return code;
}

static int read_preview(struct gphoto *g, const struct camera_object *o, struct pouring *p)
{
    CameraFile *file;
    const char *bytes;
    unsigned long n;
    int code = gp_file_new(&file);
    if (code < 0)
        return code;
    code = gp_camera_file_get(g->camera, o->folder, o->name, GP_FILE_TYPE_PREVIEW, file, g->context);
    if (code >= 0)
        code = gp_file_get_data_and_size(file, &bytes, &n);
    if (code >= 0 && n)
        pour(p, (unsigned char *)bytes, &(uint64_t){ n });
    gp_file_unref(file);
    return code;
}

int gphoto_read(struct gphoto *g, const struct camera_object *o, bool preview, gphoto_sink *sink, void *arg, struct camera_event *e)
{
    struct pouring p = { .sink = sink, .arg = arg };
    const int64_t size = find_object(g, o, e);
    int code = GP_OK;
    if (size < 0)
        return -1;
    if (!preview && o->size_bytes > 0 && o->size_bytes != size)
        return gphoto_fail(e, CAMERA_CORRUPT, 0, "%s was announced with %lld bytes, now it has %lld: it is fetched again", o->name,
                           (long long)o->size_bytes, (long long)size);
    if (!preview && size > UINT32_MAX)
        return gphoto_fail(e, CAMERA_REFUSED, -EFBIG, "%s has %lld bytes: frames have less than 4 GiB", o->name, (long long)size);
    if (!preview && !size)
        return gphoto_fail(e, CAMERA_CORRUPT, 0, "%s has no bytes: it is fetched again", o->name);
    p.most = preview ? PREVIEW_MAX : (uint64_t)size;
    e->size_bytes = preview ? 0 : size;
    int64_t began = begin(g);
    if (preview) {
        code = read_preview(g, o, &p);
    } else {
        while (code >= 0 && !p.err && p.size < p.most) {
            uint64_t n = p.most - p.size < CHUNK ? p.most - p.size : CHUNK;
            const uint64_t asked = n;
            began = begin(g);
            if (began > g->deadline_ns)
                return gphoto_fail(e, CAMERA_STALLED, 0, "%s: %llu of %lld bytes came in time: check its cable and hub", o->name,
                                   (unsigned long long)p.size, (long long)size);
            code = gp_camera_file_read(g->camera, o->folder, o->name, GP_FILE_TYPE_NORMAL, p.size, (char *)g->chunk, &n, g->context);
            if (code == GP_ERROR_NOT_SUPPORTED && !p.size) {
                code = read_whole(g, o, &p);
                break;
            }
            if (code >= 0 && (!n || n > asked))
                break; // too few or too many, below
            if (code >= 0)
                pour(&p, g->chunk, &n);
        }
    }
    if (p.err)
        return p.err; // the caller's own
    if (code == GP_ERROR_CORRUPTED_DATA || p.size > p.most || (code >= 0 && !preview && p.size != p.most))
        return gphoto_fail(e, CAMERA_CORRUPT, 0, "%s: %llu bytes came, %llu were announced: it is fetched again", o->name,
                           (unsigned long long)p.size, (unsigned long long)p.most);
    if (code < 0)
        return failed(g, e, code, began, preview ? "cannot fetch a preview" : "cannot fetch a frame");
    if (preview && !p.size)
        return gphoto_fail(e, CAMERA_CARD, -ENOENT, "%s has no preview", o->name);
    return 0;
}

// 2.5.30 asks the body to delete 0xffffffff - every picture on its cards - when its own view has lost the name between a caller's
// look and its own. So: no events are waiting that could change that view, and the name is in it, looked up this moment.
int gphoto_delete(struct gphoto *g, const struct camera_object *o, struct camera_event *e)
{
    for (;;) {
        const int got = gphoto_wait(g, now_ns() + 2000000, e);
        if (got < 0)
            return got;
        if (got == GPHOTO_NOTHING)
            break;
        if (now_ns() > g->deadline_ns)
            return gphoto_fail(e, CAMERA_BUSY, 0, "its events do not end: %s", remedy(g, CAMERA_BUSY));
    }
    gp_filesystem_reset(g->camera->fs);
    const int64_t size = find_object(g, o, e);
    if (size < 0)
        return -1;
    if (o->size_bytes > 0 && size != o->size_bytes)
        return gphoto_fail(e, CAMERA_CARD, -ESTALE, "%s on its card has %lld bytes, the copy %lld: it is left there", o->name,
                           (long long)size, (long long)o->size_bytes);
    const int64_t began = begin(g);
    const int code = gp_camera_file_delete(g->camera, o->folder, o->name, g->context);
    if (code < 0)
        return failed(g, e, code, began, "cannot delete a frame");
    // The driver does not say whether the body obeyed; its own view does.
    CameraFileInfo info;
    gp_filesystem_reset(g->camera->fs);
    if (gp_camera_file_get_info(g->camera, o->folder, o->name, &info, g->context) >= 0)
        return gphoto_fail(e, CAMERA_CARD, -EROFS, "%s is still on its card: is the frame or the card locked?", o->name);
    return 0;
}

// ---- here I am -----------------------------------------------------------------------------------------------------------------

int gphoto_identify(struct gphoto *g, struct camera_event *e)
{
    const int64_t until = now_ns() + 3000000000 < g->deadline_ns ? now_ns() + 3000000000 : g->deadline_ns - 300000000;
    char name[PERSONALITY_NAME];
    for (int i = 0; personality_body_name(g->personality, "identify", i, name); i++) {
        CameraWidget *w;
        const int got = get_widget(g, name, &w, e);
        if (got < 0)
            return got;
        if (!got)
            continue;
        const int64_t began = begin(g);
        int code = gp_widget_set_value(w, &(int){ 1 });
        if (code >= 0)
            code = gp_camera_set_single_config(g->camera, name, w, g->context);
        if (code >= 0) {
            while (now_ns() < until) {
                sleep_ms(20);
                g->gone(g->arg);
            }
            const int64_t ends = begin(g);
            gp_widget_set_value(w, &(int){ 0 });
            const int off = gp_camera_set_single_config(g->camera, name, w, g->context);
            gp_widget_unref(w);
            return off < 0 && is_fatal(g, off, ends) ? failed(g, e, off, ends, "it does not end its live view") : 0;
        }
        gp_widget_unref(w);
        if (is_fatal(g, code, began))
            return failed(g, e, code, began, "cannot make it show itself");
    }
    do { // live view: mirror up, display on
        CameraFile *file;
        const int64_t began = begin(g);
        int code = gp_file_new(&file);
        if (code >= 0) {
            code = gp_camera_capture_preview(g->camera, file, g->context);
            gp_file_unref(file);
        }
        if (code < 0)
            return failed(g, e, code, began, "it cannot show itself by live view");
        sleep_ms(100);
    } while (now_ns() < until);
    return 0;
}
