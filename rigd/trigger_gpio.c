// rigd/trigger_gpio.c - shutters, relays, button and sync contacts on GPIO lines. The only file that knows libgpiod (API 1 and 2).
//
// What keeps a line from staying active, and where it ends:
//  - the plan and the limit of every line: the thread of trigger_lines.c;
//  - rigd killed, crashed, hung or stopped: its guard, which holds the same lines;
//  - both gone at once (power of the host, SIGKILL to the whole control group): the kernel frees the lines. What the pin does then is
//    its driver's: gpio-sim and most SoC drivers make it an input again; Raspberry Pi kernels keep the level
//    (pinctrl_bcm2835.persist_gpio_outputs=Y; dtparam=strict_gpiod or =n on the kernel command line changes that); expanders (PCA953x,
//    MCP23x17, 74x595) and USB bridges (FT232H, CP210x, MCP2221) keep it always. There, and for a host whose kernel stands still, only
//    hardware helps: pull-downs on every line (needed anyway: pins float at boot), and a monostable or the trigger board in between.
// "At once" is one request to the kernel per 64 lines of a chip; the driver decides whether the pins change in one register write.
#include "rigd/lines.h"
#include "rigd/trigger_lines.h"
#include "solver/take/log.h"

#include <dirent.h>
#include <errno.h>
#include <gpiod.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <time.h>
#include <unistd.h>

enum { PER_REQUEST = 64, REQUESTS_MAX = (EDGES_WIRES_MAX + PER_REQUEST - 1) / PER_REQUEST, EVENTS = 16 };

struct gpio_line { // as found on the chip, before it is taken
    bool used;
    char holder[64];
};

struct gpio {
    struct gpiod_chip *chip;
    char name[64]; // device
    int n_outputs, n_inputs, n_requests;
    int epoll_fd;
#ifdef GPIOD_LINE_BULK_MAX_LINES // API 1
    struct gpiod_line_bulk output[REQUESTS_MAX];
    struct gpiod_line *input[CONFIG_CAMERAS_MAX + 1];
#else
    struct gpiod_line_request *output[REQUESTS_MAX], *input[CONFIG_CAMERAS_MAX + 1]; // a request per input, too: settings differ
    unsigned offset[CONFIG_CAMERAS_MAX + 1];
    struct gpiod_edge_event_buffer *events;
#endif
};

#ifdef GPIOD_LINE_BULK_MAX_LINES
// ---- API 1 (Debian 12) ---------------------------------------------------------------------------------------------------------------

static bool chip_is(struct gpiod_chip *chip, const char *label)
{
    return strcmp(gpiod_chip_label(chip), label) == 0;
}

static int chip_n_lines(struct gpiod_chip *chip)
{
    return (int)gpiod_chip_num_lines(chip);
}

static int look_at(struct gpio *g, int line, struct gpio_line *out)
{
    struct gpiod_line *l = gpiod_chip_get_line(g->chip, line);
    if (!l)
        return -errno;
    const char *holder = gpiod_line_consumer(l);
    out->used = gpiod_line_is_used(l);
    snprintf(out->holder, sizeof(out->holder), "%s", holder ? holder : "the kernel");
    return 0;
}

static int take_outputs(struct gpio *g, int request, const struct lines_wire *wire, int n)
{
    const int inactive[PER_REQUEST] = { 0 };
    const struct gpiod_line_request_config config = { "rigd", GPIOD_LINE_REQUEST_DIRECTION_OUTPUT,
        wire->active_low ? GPIOD_LINE_REQUEST_FLAG_ACTIVE_LOW : 0 };
    gpiod_line_bulk_init(&g->output[request]);
    for (int i = 0; i < n; i++) {
        struct gpiod_line *l = gpiod_chip_get_line(g->chip, wire[i].line);
        if (!l)
            return -errno;
        gpiod_line_bulk_add(&g->output[request], l);
    }
    return gpiod_line_request_bulk(&g->output[request], &config, inactive) ? -errno : 0;
}

static int take_input(struct gpio *g, int input, const struct lines_wire *wire, int *fd)
{
    const struct gpiod_line_request_config config = { "rigd", GPIOD_LINE_REQUEST_EVENT_BOTH_EDGES,
        wire->active_low ? GPIOD_LINE_REQUEST_FLAG_ACTIVE_LOW | GPIOD_LINE_REQUEST_FLAG_BIAS_PULL_UP :
                           GPIOD_LINE_REQUEST_FLAG_BIAS_PULL_DOWN };
    struct gpiod_line *l = gpiod_chip_get_line(g->chip, wire->line);
    if (!l || gpiod_line_request(l, &config, 0))
        return -errno;
    g->input[input] = l;
    *fd = gpiod_line_event_get_fd(l);
    return 0;
}

static int set_outputs(struct gpio *g, int request, const int *value)
{
    return gpiod_line_set_value_bulk(&g->output[request], value) ? -errno : 0;
}

static int get_input(struct gpio *g, int input)
{
    const int value = gpiod_line_get_value(g->input[input]);
    return value < 0 ? -errno : value;
}

// Up to EVENTS edges of one input that has some.
static int read_input(struct gpio *g, int input, struct lines_edge *edge)
{
    struct gpiod_line_event event[EVENTS];
    const int n = gpiod_line_event_read_multiple(g->input[input], event, EVENTS);
    for (int i = 0; i < n; i++)
        edge[i] = (struct lines_edge){ input, event[i].event_type == GPIOD_LINE_EVENT_RISING_EDGE,
            event[i].ts.tv_sec * INT64_C(1000000000) + event[i].ts.tv_nsec };
    return n < 0 ? -errno : n;
}

static void let_go(struct gpio *g) // closing the chip frees all its lines
{
    (void)g;
}
#else
// ---- API 2 (Debian 13) ---------------------------------------------------------------------------------------------------------------

static bool chip_is(struct gpiod_chip *chip, const char *label)
{
    struct gpiod_chip_info *info = gpiod_chip_get_info(chip);
    const bool is = info && strcmp(gpiod_chip_info_get_label(info), label) == 0;
    if (info)
        gpiod_chip_info_free(info);
    return is;
}

static int chip_n_lines(struct gpiod_chip *chip)
{
    struct gpiod_chip_info *info = gpiod_chip_get_info(chip);
    const int n = info ? (int)gpiod_chip_info_get_num_lines(info) : 0;
    if (info)
        gpiod_chip_info_free(info);
    return n;
}

static int look_at(struct gpio *g, int line, struct gpio_line *out)
{
    struct gpiod_line_info *info = gpiod_chip_get_line_info(g->chip, line);
    if (!info)
        return -errno;
    const char *holder = gpiod_line_info_get_consumer(info);
    out->used = gpiod_line_info_is_used(info);
    snprintf(out->holder, sizeof(out->holder), "%s", holder ? holder : "the kernel");
    gpiod_line_info_free(info);
    return 0;
}

// Lines with the same settings, in one request.
static int request_lines(struct gpio *g, struct gpiod_line_request **out, const struct lines_wire *wire, int n, bool is_input)
{
    unsigned offset[PER_REQUEST];
    struct gpiod_line_settings *settings = gpiod_line_settings_new();
    struct gpiod_line_config *lines = gpiod_line_config_new();
    struct gpiod_request_config *request = gpiod_request_config_new();
    int err = -ENOMEM;
    if (!settings || !lines || !request)
        goto end;
    for (int i = 0; i < n; i++)
        offset[i] = (unsigned)wire[i].line;
    gpiod_request_config_set_consumer(request, "rigd");
    gpiod_line_settings_set_active_low(settings, wire->active_low);
    gpiod_line_settings_set_direction(settings, is_input ? GPIOD_LINE_DIRECTION_INPUT : GPIOD_LINE_DIRECTION_OUTPUT);
    if (is_input) {
        gpiod_line_settings_set_edge_detection(settings, GPIOD_LINE_EDGE_BOTH);
        gpiod_line_settings_set_bias(settings, wire->active_low ? GPIOD_LINE_BIAS_PULL_UP : GPIOD_LINE_BIAS_PULL_DOWN);
        gpiod_line_settings_set_event_clock(settings, GPIOD_LINE_CLOCK_MONOTONIC);
    } else {
        gpiod_line_settings_set_output_value(settings, GPIOD_LINE_VALUE_INACTIVE);
    }
    err = gpiod_line_config_add_line_settings(lines, offset, (size_t)n, settings) ? -errno : 0;
    if (!err) {
        *out = gpiod_chip_request_lines(g->chip, request, lines);
        err = *out ? 0 : -errno;
    }
end:
    if (settings)
        gpiod_line_settings_free(settings);
    if (lines)
        gpiod_line_config_free(lines);
    if (request)
        gpiod_request_config_free(request);
    return err;
}

static int take_outputs(struct gpio *g, int request, const struct lines_wire *wire, int n)
{
    return request_lines(g, &g->output[request], wire, n, false);
}

static int take_input(struct gpio *g, int input, const struct lines_wire *wire, int *fd)
{
    if (!g->events && !(g->events = gpiod_edge_event_buffer_new(EVENTS)))
        return -errno;
    const int err = request_lines(g, &g->input[input], wire, 1, true);
    if (err)
        return err;
    g->offset[input] = (unsigned)wire->line;
    *fd = gpiod_line_request_get_fd(g->input[input]);
    return 0;
}

static int set_outputs(struct gpio *g, int request, const int *value)
{
    enum gpiod_line_value v[PER_REQUEST];
    for (int i = 0; i < PER_REQUEST; i++)
        v[i] = value[i] ? GPIOD_LINE_VALUE_ACTIVE : GPIOD_LINE_VALUE_INACTIVE;
    return gpiod_line_request_set_values(g->output[request], v) ? -errno : 0;
}

static int get_input(struct gpio *g, int input)
{
    const enum gpiod_line_value value = gpiod_line_request_get_value(g->input[input], g->offset[input]);
    return value == GPIOD_LINE_VALUE_ERROR ? -errno : value == GPIOD_LINE_VALUE_ACTIVE;
}

static int read_input(struct gpio *g, int input, struct lines_edge *edge)
{
    const int n = gpiod_line_request_read_edge_events(g->input[input], g->events, EVENTS);
    for (int i = 0; i < n; i++) {
        struct gpiod_edge_event *event = gpiod_edge_event_buffer_get_event(g->events, (unsigned long)i);
        edge[i] = (struct lines_edge){ input, gpiod_edge_event_get_event_type(event) == GPIOD_EDGE_EVENT_RISING_EDGE,
            (int64_t)gpiod_edge_event_get_timestamp_ns(event) };
    }
    return n < 0 ? -errno : n;
}

static void let_go(struct gpio *g)
{
    for (int i = 0; i < REQUESTS_MAX; i++)
        if (g->output[i])
            gpiod_line_request_release(g->output[i]);
    for (int i = 0; i < g->n_inputs; i++)
        if (g->input[i])
            gpiod_line_request_release(g->input[i]);
    if (g->events)
        gpiod_edge_event_buffer_free(g->events);
}
#endif

// ---- both ----------------------------------------------------------------------------------------------------------------------------------

// Kernels before 5.7 stamp the edges of API 1 with the time of day. That is decades away from the time since boot.
static int64_t monotonic_of(int64_t stamp_ns)
{
    struct timespec m, r;
    clock_gettime(CLOCK_MONOTONIC, &m);
    clock_gettime(CLOCK_REALTIME, &r);
    const int64_t monotonic_ns = m.tv_sec * INT64_C(1000000000) + m.tv_nsec;
    const int64_t realtime_ns = r.tv_sec * INT64_C(1000000000) + r.tv_nsec;
    if (llabs(stamp_ns - realtime_ns) < llabs(stamp_ns - monotonic_ns))
        return stamp_ns - (realtime_ns - monotonic_ns);
    return stamp_ns;
}

static void gpio_close(void *self)
{
    struct gpio *g = self;
    if (!g)
        return;
    let_go(g);
    if (g->chip)
        gpiod_chip_close(g->chip);
    if (g->epoll_fd >= 0)
        close(g->epoll_fd);
    free(g);
}

static struct gpiod_chip *open_device(struct gpio *g, const char *file)
{
    char path[300];
    snprintf(path, sizeof(path), "%s%s", file[0] == '/' ? "" : "/dev/", file);
    snprintf(g->name, sizeof(g->name), "%.63s", path);
    return gpiod_chip_open(path);
}

// "gpiochip0", "/dev/gpiochip0", or the label a driver gave, which does not depend on the order of discovery.
static int open_chip(struct gpio *g, const char *wanted)
{
    char seen[256] = "";
    int err = -ENODEV, n = 0;
    if (wanted[0] == '/' || strncmp(wanted, "gpiochip", 8) == 0) {
        g->chip = open_device(g, wanted);
        err = g->chip ? 0 : -errno;
    } else {
        struct dirent **file = NULL;
        n = scandir("/dev", &file, NULL, alphasort);
        for (int i = 0; i < n; i++) {
            if (!g->chip && strncmp(file[i]->d_name, "gpiochip", 8) == 0) {
                struct gpiod_chip *chip = open_device(g, file[i]->d_name);
                if (!chip) {
                    err = errno == EACCES ? -EACCES : err;
                } else if (chip_is(chip, wanted)) {
                    g->chip = chip;
                    err = 0;
                } else {
                    gpiod_chip_close(chip);
                }
                const size_t end = strlen(seen);
                snprintf(seen + end, sizeof(seen) - end, " %.30s", file[i]->d_name);
            }
            free(file[i]);
        }
        free(file);
    }
    if (err == -ENOENT)
        err = -ENODEV;
    if (err == -EACCES)
        log_error("trigger: gpio chip %s: permission denied: let rigd's user into group gpio (config/systemd/71-rigd.rules)", wanted);
    else if (err)
        log_error("trigger: no gpio chip \"%s\" (%s); there are:%s: see gpiodetect and set chip in [trigger]", wanted, strerror(-err),
            seen[0] ? seen : " look in /dev");
    return err;
}

static int check_line(struct gpio *g, const struct lines_wire *wire, int n_lines)
{
    struct gpio_line found = { 0 };
    if (wire->line < 0 || wire->line >= n_lines) {
        log_error("trigger: %s = %d: %s has lines 0 to %d: see gpioinfo", wire->what, wire->line, g->name, n_lines - 1);
        return -EINVAL;
    }
    const int err = look_at(g, wire->line, &found);
    if (err) {
        log_error("trigger: %s = %d on %s: %s", wire->what, wire->line, g->name, strerror(-err));
        return err;
    }
    if (found.used)
        log_error("trigger: %s = %d on %s is held by \"%s\": stop that, or use another line", wire->what, wire->line, g->name, found.holder);
    return found.used ? -EBUSY : 0;
}

static int gpio_open(void **self, const struct config *config, const struct lines_wanted *wanted)
{
    struct gpio *g = calloc(1, sizeof(*g));
    int err;
    if (!g)
        return -ENOMEM;
    g->epoll_fd = epoll_create1(EPOLL_CLOEXEC);
    if (g->epoll_fd < 0) {
        err = -errno;
        log_error("trigger: epoll: %s", strerror(-err));
        goto fail;
    }
    err = open_chip(g, config->trigger.chip);
    if (err)
        goto fail;
    const int n_lines = chip_n_lines(g->chip);
    for (int i = 0; i < wanted->n_outputs + wanted->n_inputs; i++) {
        err = check_line(g, i < wanted->n_outputs ? &wanted->output[i] : &wanted->input[i - wanted->n_outputs], n_lines);
        if (err)
            goto fail;
    }
    g->n_outputs = wanted->n_outputs;
    g->n_inputs = wanted->n_inputs;
    for (; g->n_requests * PER_REQUEST < g->n_outputs; g->n_requests++) {
        const int first = g->n_requests * PER_REQUEST, rest = g->n_outputs - first;
        const int n = rest < PER_REQUEST ? rest : PER_REQUEST;
        err = take_outputs(g, g->n_requests, &wanted->output[first], n);
        if (err) {
            log_error("trigger: cannot take %s = %d and %d more lines on %s as outputs: %s", wanted->output[first].what,
                wanted->output[first].line, n - 1, g->name, strerror(-err));
            goto fail;
        }
    }
    for (int i = 0; i < g->n_inputs; i++) {
        struct epoll_event e = { .events = EPOLLIN, .data.u32 = (uint32_t)i };
        int fd = -1;
        err = take_input(g, i, &wanted->input[i], &fd);
        if (!err && epoll_ctl(g->epoll_fd, EPOLL_CTL_ADD, fd, &e))
            err = -errno;
        if (err) {
            log_error("trigger: cannot hear edges of %s = %d on %s: %s%s", wanted->input[i].what, wanted->input[i].line, g->name,
                strerror(-err), err == -ENXIO ? ": this chip has no interrupts" : "");
            goto fail;
        }
    }
    *self = g;
    return 0;
fail:
    gpio_close(g);
    return err;
}

static int gpio_set(void *self, const uint64_t *active, const uint64_t *changed, int64_t at_ns)
{
    struct gpio *g = self;
    int err = 0;
    (void)at_ns;
    _Static_assert(PER_REQUEST == 64, "a request is a word of the masks");
    for (int r = 0; r < g->n_requests; r++) {
        int value[PER_REQUEST];
        if (!changed[r])
            continue;
        for (int i = 0; i < PER_REQUEST; i++)
            value[i] = active[r] >> i & 1;
        const int failed = set_outputs(g, r, value);
        err = err ? err : failed;
    }
    return err;
}

static int gpio_fd(const void *self)
{
    return ((const struct gpio *)self)->epoll_fd;
}

static int gpio_read(void *self, struct lines_edge *edge, int max)
{
    struct gpio *g = self;
    struct epoll_event ready[32];
    const int room = max / EVENTS < 32 ? max / EVENTS : 32;
    int n = 0;
    const int n_ready = epoll_wait(g->epoll_fd, ready, room, 0);
    for (int i = 0; i < n_ready; i++) {
        const int got = read_input(g, (int)ready[i].data.u32, edge + n);
        if (got < 0) {
            log_error("trigger: %s: %s: is the chip still there?", g->name, strerror(-got));
            return got;
        }
        for (int k = 0; k < got; k++)
            edge[n + k].at_ns = monotonic_of(edge[n + k].at_ns);
        n += got;
    }
    return n;
}

static int gpio_level(void *self, int input)
{
    return get_input(self, input);
}

static const struct lines_ops gpio_lines = { .guarded = true, .open = gpio_open, .set = gpio_set, .fd = gpio_fd, .read = gpio_read,
    .level = gpio_level, .close = gpio_close };

static int trigger_gpio_open(void **self, const struct config *config, const struct trigger_host *host)
{
    return trigger_lines_open((struct trigger_lines **)self, config, host, &gpio_lines, false);
}

const struct trigger_ops trigger_gpio = { .open = trigger_gpio_open, .abilities = trigger_lines_abilities, .fire = trigger_lines_fire,
    .release = trigger_lines_release, .relay = trigger_lines_relay, .fd = trigger_lines_fd, .dispatch = trigger_lines_dispatch,
    .close = trigger_lines_close };
