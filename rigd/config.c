// rigd/config.c - rigd.conf through inih, checked line by line.
//
// inih cuts long lines and section names without a word and does not tell line numbers to its handler; the reader below feeds it
// line by line from memory, so that both are known here.
#include "rigd/config.h"
#include "rigd/access.h"
#include "rigd/stops.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <errno.h>
#include <ini.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { LINE_MAX_BYTES = 196, SECTION_MAX_BYTES = 48, FINDINGS_MAX = 20, LINES_MAX = 4096,
       OUTPUTS_MAX = 416, PRESSES_MAX = 256, INPUTS_MAX = 200, STEPS_MAX = 1000000 }; // of the trigger board (firmware/protocol.h)

enum type { TEXT, PATH, INTEGER, UNSIGNED, NUMBER, BOOL, LINE, PORT, POWER, KIND, NAME, HEAD, MODEL, SECONDS, NUMBERS, STOPS, ON_OFF, DEMOSAIC, THEN, LISTEN };

struct key {
    const char *name;
    enum type type;
    size_t offset, room; // of the field in its struct; room of texts
    double least, most;  // of numbers
    bool required;
};

#define FIELD(structure, field) offsetof(struct structure, field), sizeof(((struct structure *)0)->field)

static const struct key rig_keys[] = {
    { "name", TEXT, FIELD(config, name), 0, 0, false },
    { "takes", PATH, FIELD(config, takes_dir), 0, 0, true },
    { "socket", PATH, FIELD(config, socket_path), 0, 0, false },
    { "state", PATH, FIELD(config, state_dir), 0, 0, false },
    { "personality_dir", PATH, FIELD(config, personality_dir), 0, 0, false },
    { "objects_per_shot", INTEGER, FIELD(config, objects_per_shot), 1, 4, false },
    { "raw_mb", UNSIGNED, FIELD(config, raw_mb), 1, 4096, false },
    { "free_space_mb", UNSIGNED, FIELD(config, free_space_mb), 0, 1e9, false },
    { "delete_after_verify", BOOL, FIELD(config, delete_after_verify), 0, 0, false },
    { "thumbnails", BOOL, FIELD(config, thumbnails), 0, 0, false },
    { "fetch_limit", INTEGER, FIELD(config, fetch_limit), 1, 256, false },
    { "heartbeat_s", UNSIGNED, FIELD(config, heartbeat_s), 5, 3600, false },
    { "battery_min_percent", INTEGER, FIELD(config, battery_min_percent), 0, 100, false },
    { "clock_max_s", NUMBER, FIELD(config, clock_max_s), 0, 1e6, false },
    { "collect_timeout_ms", UNSIGNED, FIELD(config, collect_timeout_ms), 100, 600000, false },
    { "fetch_timeout_ms", UNSIGNED, FIELD(config, fetch_timeout_ms), 1000, 3600000, false },
    { "may_miss", INTEGER, FIELD(config, may_miss), 0, CONFIG_CAMERAS_MAX, false },
};
static const struct key calibration_keys[] = {
    { "shots", INTEGER, FIELD(config, calibration_shots), 3, 1000, false },
    { "within_ms", NUMBER, FIELD(config, lag_within_ms), 0, 1000, false },
    { "max_std_ms", NUMBER, FIELD(config, lag_max_std_ms), 0, 1000, false },
};
static const struct key trigger_keys[] = {
    { "kind", KIND, FIELD(trigger_config, kind), 0, 0, true },
    { "chip", TEXT, FIELD(trigger_config, chip), 0, 0, false },
    { "address", PATH, FIELD(trigger_config, address), 0, 0, false },
    { "full_line", LINE, FIELD(trigger_config, full_line), 0, 0, false },
    { "half_line", LINE, FIELD(trigger_config, half_line), 0, 0, false },
    { "active_low", BOOL, FIELD(trigger_config, active_low), 0, 0, false },
    { "button_line", LINE, FIELD(trigger_config, button_line), 0, 0, false },
    { "button_active_low", BOOL, FIELD(trigger_config, button_active_low), 0, 0, false },
    { "feedback_active_low", BOOL, FIELD(trigger_config, feedback_active_low), 0, 0, false },
    { "button_debounce_ms", UNSIGNED, FIELD(trigger_config, button_debounce_ms), 0, 1000, false },
    { "half_press_ms", UNSIGNED, FIELD(trigger_config, half_press_ms), 0, 5000, false },
    { "hold_ms", UNSIGNED, FIELD(trigger_config, hold_ms), 1, 10000, false },
    { "max_hold_ms", UNSIGNED, FIELD(trigger_config, max_hold_ms), 1, 10000, false },
    { "serial", NAME, FIELD(trigger_config, serial), 0, 0, false },
    { "output_registers", INTEGER, FIELD(trigger_config, output_registers), 1, OUTPUTS_MAX / 8, false },
    { "head_yaw_steps_per_turn", INTEGER, FIELD(trigger_config, head_steps_per_turn[0]), -STEPS_MAX, STEPS_MAX, false },
    { "head_pitch_steps_per_turn", INTEGER, FIELD(trigger_config, head_steps_per_turn[1]), -STEPS_MAX, STEPS_MAX, false },
    { "head_deg_per_s", NUMBER, FIELD(trigger_config, head_deg_per_s), .1, 360, false },
    { "head_deg_per_s2", NUMBER, FIELD(trigger_config, head_deg_per_s2), .1, 3600, false },
    { "head_yaw_limit_deg", NUMBER, FIELD(trigger_config, head_limit_deg[0]), 0, 720, false },
    { "head_pitch_limit_deg", NUMBER, FIELD(trigger_config, head_limit_deg[1]), 0, 180, false },
    { "head_home_switch", BOOL, FIELD(trigger_config, head_home_switch), 0, 0, false },
};
static const struct key web_keys[] = {
    { "listen", LISTEN, FIELD(config, web.listen), 0, 0, true },
    { "token_always", BOOL, FIELD(config, web.token_always), 0, 0, false },
};
static const struct key develop_keys[] = {
    { "after", ON_OFF, FIELD(process_config, develop), 0, 0, false },
    { "demosaic", DEMOSAIC, FIELD(process_config, demosaic), 0, 0, false },
    { "flat", PATH, FIELD(process_config, flat), 0, 0, false },
    { "colour", PATH, FIELD(process_config, colour), 0, 0, false },
    { "jobs", INTEGER, FIELD(process_config, develop_jobs), 0, 256, false },
    { "memory_mb", UNSIGNED, FIELD(process_config, memory_mb), 0, 1e7, false },
    { "timeout_s", UNSIGNED, FIELD(process_config, develop_timeout_s), 1, 86400, false },
    { "panorama_timeout_s", UNSIGNED, FIELD(process_config, panorama_timeout_s), 1, 86400, false },
};
static const struct key reconstruct_keys[] = {
    { "command", TEXT, FIELD(process_config, command), 0, 0, false },
    { "calibrated", PATH, FIELD(process_config, calibrated), 0, 0, false },
    { "timeout_s", UNSIGNED, FIELD(process_config, reconstruct_timeout_s), 1, 604800, false },
};
static const struct key solve_keys[] = {
    { "preview", ON_OFF, FIELD(process_config, preview), 0, 0, false },
    { "then", THEN, FIELD(process_config, then), 0, 0, false },
    { "options", TEXT, FIELD(process_config, options), 0, 0, false },
    { "threads", INTEGER, FIELD(process_config, solve_threads), 0, 256, false },
    { "program", PATH, FIELD(process_config, solve_program), 0, 0, false },
    { "timeout_s", UNSIGNED, FIELD(process_config, solve_timeout_s), 1, 604800, false },
};
static const struct key camera_keys[] = {
    { "serial", NAME, FIELD(config_camera, serial), 0, 0, false },
    { "port", PORT, FIELD(config_camera, port), 0, 0, true },
    { "model", TEXT, FIELD(config_camera, model), 0, 0, false },
    { "personality", NAME, FIELD(config_camera, personality), 0, 0, false },
    { "lens", TEXT, FIELD(config_camera, lens), 0, 0, false },
    { "full_line", LINE, FIELD(config_camera, full_line), 0, 0, false },
    { "half_line", LINE, FIELD(config_camera, half_line), 0, 0, false },
    { "feedback_line", LINE, FIELD(config_camera, feedback_line), 0, 0, false },
    { "relay_line", LINE, FIELD(config_camera, relay_line), 0, 0, false },
    { "power", POWER, FIELD(config_camera, power), 0, 0, false },
};
static const struct key panorama_keys[] = {
    { "camera", NAME, FIELD(config, panorama.camera_name), 0, 0, true },
    { "head", HEAD, FIELD(config, panorama.head), 0, 0, false },
    { "lens", MODEL, FIELD(config, panorama.lens.model), 0, 0, true },
    { "width_px", INTEGER, FIELD(config, panorama.lens.width_px), 2, 65536, true },
    { "height_px", INTEGER, FIELD(config, panorama.lens.height_px), 2, 65536, true },
    { "focal_px", NUMBER, FIELD(config, panorama.lens.focal_px), 1, 1e6, true },
    { "centre_px", NUMBERS, FIELD(config, panorama.lens.centre_px), 0, 65536, false },
    { "distortion", NUMBERS, FIELD(config, panorama.lens.k), -100, 100, false }, // and p, right behind it
    { "circle_px", NUMBER, FIELD(config, panorama.lens.circle_px), 0, 65536, false },
    { "max_angle_deg", NUMBER, FIELD(config, panorama.max_angle_deg), 1, 180, false },
    { "shading", NUMBERS, FIELD(config, panorama.lens.v), -100, 100, false },
    { "nodal_offset_m", NUMBER, FIELD(config, panorama.nodal_offset_m), -1, 1, false },
    { "overlap", NUMBER, FIELD(config, panorama.overlap), 0, .9, false },
    { "stops", STOPS, FIELD(config, panorama.stop), 0, 0, false },
    { "meter", SECONDS, FIELD(config, panorama.meter_s), 1e-5, 60, false },
    { "shortest", SECONDS, FIELD(config, panorama.shortest_s), 1e-5, 60, false },
    { "longest", SECONDS, FIELD(config, panorama.longest_s), 1e-5, 60, false },
    { "frames_max", INTEGER, FIELD(config, panorama.frames_max), 2, CONFIG_FRAMES_MAX, false },
    { "settle_ms", UNSIGNED, FIELD(config, panorama.settle_ms), 0, 60000, false },
    { "neutral_density_ev", NUMBER, FIELD(config, panorama.neutral_density_ev), 0, 30, false },
};
_Static_assert(offsetof(struct lens, p) == offsetof(struct lens, k) + sizeof(((struct lens *)0)->k), "distortion is read as one list");
#define COUNT(keys) ((int)(sizeof(keys) / sizeof((keys)[0])))

enum section { NO_SECTION, RIG, SETTINGS, CALIBRATION, TRIGGER, PANORAMA, WEB, DEVELOP, RECONSTRUCT, SOLVE, CAMERA, BAD_SECTION };
static const struct {
    const char *name;
    const struct key *keys;
    int n_keys;
} sections[] = {
    [NO_SECTION] = { "", NULL, 0 },
    [RIG] = { "rig", rig_keys, COUNT(rig_keys) },
    [SETTINGS] = { "settings", NULL, 0 },
    [CALIBRATION] = { "calibration", calibration_keys, COUNT(calibration_keys) },
    [TRIGGER] = { "trigger", trigger_keys, COUNT(trigger_keys) },
    [DEVELOP] = { "develop", develop_keys, COUNT(develop_keys) },
    [RECONSTRUCT] = { "reconstruct", reconstruct_keys, COUNT(reconstruct_keys) },
    [SOLVE] = { "solve", solve_keys, COUNT(solve_keys) },
    [PANORAMA] = { "panorama", panorama_keys, COUNT(panorama_keys) },
    [WEB] = { "web", web_keys, COUNT(web_keys) },
    [CAMERA] = { "camera", camera_keys, COUNT(camera_keys) },
};

struct own_setting {
    int camera; // CONFIG_NONE: of all
    struct camera_setting setting;
};

struct reader {
    const char *file, *text, *end;
    int line;
    struct config *config;
    int n_findings;
    bool no_memory;
    enum section section;
    int section_line;
    uint32_t seen;          // keys of the present section
    uint32_t seen_sections; // except cameras
    uint32_t trigger_seen;  // keys of [trigger]
    int camera_line[CONFIG_CAMERAS_MAX];
    int panorama_line;
    int trigger_line, hold_line; // of [trigger]; of the last of half_press_ms, hold_ms and max_hold_ms, else of [trigger]
    struct own_setting *own;
    int n_own;
};

__attribute__((format(printf, 3, 4))) static void complain(struct reader *r, int line, const char *format, ...)
{
    char text[500];
    va_list args;
    if (r->n_findings++ >= FINDINGS_MAX)
        return;
    va_start(args, format);
    vsnprintf(text, sizeof(text), format, args);
    va_end(args);
    if (line)
        log_error("config: %s:%d: %s", r->file, line, text);
    else
        log_error("config: %s: %s", r->file, text);
}

// ---- sections and lines --------------------------------------------------------------------------------------------------------

static void check_section_end(struct reader *r)
{
    if (r->section == NO_SECTION || r->section == BAD_SECTION)
        return;
    r->trigger_seen |= r->section == TRIGGER ? r->seen : 0;
    for (int k = 0; k < sections[r->section].n_keys; k++)
        if (sections[r->section].keys[k].required && !(r->seen >> k & 1))
            complain(r, r->section_line, "[%s] has no '%s'; add a line '%s = ...'", sections[r->section].name, sections[r->section].keys[k].name, sections[r->section].keys[k].name);
}

static bool is_plain(const char *s)
{
    return s[0] && strspn(s, "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_") == strlen(s);
}

static void begin_camera(struct reader *r, const char *name)
{
    struct config *c = r->config;
    r->section = BAD_SECTION;
    if (!is_plain(name) || strlen(name) >= sizeof(c->camera[0].name)) {
        complain(r, r->line, "camera \"%s\": expected 1 to %zu letters, digits, - or _: the name becomes file names", name, sizeof(c->camera[0].name) - 1);
        return;
    }
    for (int i = 0; i < c->n_cameras; i++)
        if (!strcasecmp(c->camera[i].name, name)) { // some file systems do not tell them apart
            complain(r, r->line, "camera \"%s\" is there already, on line %d; give each camera a name of its own", name, r->camera_line[i]);
            return;
        }
    if (c->n_cameras == CONFIG_CAMERAS_MAX) {
        complain(r, r->line, "more than %d cameras; use a second rigd", CONFIG_CAMERAS_MAX);
        return;
    }
    r->section = CAMERA;
    r->camera_line[c->n_cameras] = r->line;
    struct config_camera *k = &c->camera[c->n_cameras++];
    snprintf(k->name, sizeof(k->name), "%.23s", name);
    k->full_line = k->half_line = k->feedback_line = k->relay_line = CONFIG_NONE;
}

static void begin_section(struct reader *r, const char *name)
{
    check_section_end(r);
    r->seen = 0;
    r->section_line = r->line;
    if (!strncmp(name, "camera ", 7)) {
        char inner[SECTION_MAX_BYTES + 1];
        const char *quote = name + 6 + strspn(name + 6, " \t");
        const size_t n = strlen(quote);
        if (n < 3 || quote[0] != '"' || quote[n - 1] != '"' || memchr(quote + 1, '"', n - 2)) {
            complain(r, r->line, "found [%s], expected [camera \"NAME\"]", name);
            r->section = BAD_SECTION;
            return;
        }
        memcpy(inner, quote + 1, n - 2);
        inner[n - 2] = 0;
        begin_camera(r, inner);
        return;
    }
    for (int s = RIG; s < CAMERA; s++)
        if (!strcmp(name, sections[s].name)) {
            r->section = s;
            if (s == TRIGGER)
                r->trigger_line = r->hold_line = r->line;
            if (s == DEVELOP) // naming it is asking for it
                r->config->process.develop = true;
            if (s == SOLVE) {
                r->config->process.preview = true;
                r->config->process.then = SOLVE_THEN_STANDARD;
            }
            if (s == PANORAMA)
                r->panorama_line = r->line;
            if (r->seen_sections >> s & 1)
                complain(r, r->line, "section [%s] is there twice; join them", name);
            r->seen_sections |= 1u << s;
            return;
        }
    complain(r, r->line, "found section [%s], expected [rig], [settings], [trigger], [calibration], [panorama], [develop], [reconstruct], [solve], [web] or [camera \"NAME\"]", name);
    r->section = BAD_SECTION;
}

// In a list of stops a semicolon is a separator; inih takes one after a blank for the beginning of a comment, and would cut it there.
static void join_stops(char *line)
{
    char *to = line;
    if (strncmp(line, "stops", 5) || !strchr(" \t=:", line[5]))
        return;
    for (const char *from = line; *from; from++)
        if (from[strspn(from, " \t")] != ';' || *from == ';')
            *to++ = *from;
    *to = 0;
}

// inih asks for the next line here.
static char *next_line(char *out, int room, void *arg)
{
    struct reader *r = arg;
    if (r->text == r->end || r->n_findings > FINDINGS_MAX)
        return NULL;
    const char *newline = memchr(r->text, '\n', (size_t)(r->end - r->text));
    const char *stop = newline ? newline : r->end;
    size_t n = (size_t)(stop - r->text);
    const char *line = r->text;
    r->text = newline ? newline + 1 : r->end;
    r->line++;
    if (n && line[n - 1] == '\r')
        n--;
    if (memchr(line, 0, n)) {
        complain(r, r->line, "found a zero byte; this is not a text file");
        n = 0;
    }
    if (n > LINE_MAX_BYTES || n + 2 > (size_t)room) {
        complain(r, r->line, "%zu bytes long, at most %d are read; shorten it", n, LINE_MAX_BYTES);
        n = 0;
    }
    memcpy(out, line, n);
    out[n] = '\n';
    out[n + 1] = 0;
    const char *begin = out + strspn(out, " \t");
    if (begin[0] == '[') {
        const char *close = strrchr(begin, ']');
        if (!close) {
            complain(r, r->line, "found '[' without ']'");
            strcpy(out, "\n");
        } else if (close - begin - 1 > SECTION_MAX_BYTES) {
            complain(r, r->line, "section name of %d bytes, at most %d are read; shorten it", (int)(close - begin - 1), SECTION_MAX_BYTES);
            r->section = BAD_SECTION;
            strcpy(out, "\n");
        } else {
            char name[SECTION_MAX_BYTES + 1];
            memcpy(name, begin + 1, (size_t)(close - begin - 1));
            name[close - begin - 1] = 0;
            begin_section(r, name);
        }
    } else if (begin != out && begin[0] != '\n' && begin[0] != ';' && begin[0] != '#') {
        complain(r, r->line, "begins with a blank; begin each 'key = value' in the first column");
        strcpy(out, "\n");
    } else if (begin[0] != '\n' && begin[0] != ';' && begin[0] != '#' && !strpbrk(begin, "=:")) {
        complain(r, r->line, "found neither 'key = value', [section] nor ; comment");
        strcpy(out, "\n");
    }
    join_stops(out);
    return out;
}

// ---- values ----------------------------------------------------------------------------------------------------------------------

// A plain decimal number, whatever the locale.
static bool to_number(const char *text, double *out)
{
    double n = 0, place = 0;
    const char *s = text + (*text == '-');
    bool digits = false;
    for (; *s; s++) {
        if (*s >= '0' && *s <= '9') {
            n = place > 0 ? n + (*s - '0') * place : n * 10 + (*s - '0');
            place /= 10;
            digits = true;
        } else if (*s == '.' && !(place > 0)) {
            place = .1;
        } else {
            return false;
        }
        if (s - text > 20)
            return false;
    }
    *out = *text == '-' ? -n : n;
    return digits;
}

static size_t digits(const char *s)
{
    const size_t n = strspn(s, "0123456789");
    return n <= 5 ? n : 0;
}

// "1-4", "1-4.3.2": bus and ports, as /sys/bus/usb/devices names them. Returns what follows, NULL if it is none.
static const char *skip_slot(const char *s)
{
    size_t n = digits(s);
    if (!n || s[n] != '-')
        return NULL;
    s += n + 1;
    if (!(n = digits(s)))
        return NULL;
    for (s += n; *s == '.'; s += n)
        if (!(n = digits(++s)))
            return NULL;
    return s;
}

static bool is_port_number(const char *s, size_t n)
{
    return n && n <= 5 && digits(s) >= n && atoi(s) >= 1 && atoi(s) <= 65535;
}

static bool is_port(const char *s)
{
    if (!strncmp(s, "usb:", 4)) {
        const char *end = skip_slot(s + 4);
        return end && !*end;
    }
    if (strncmp(s, "ptpip:", 6))
        return false;
    s += 6;
    for (int i = 0; i < 4; i++) { // libgphoto2 takes IPv4 addresses only
        const size_t n = digits(s);
        if (!n || n > 3 || atoi(s) > 255 || s[n] != (i < 3 ? '.' : ':'))
            return false;
        s += n + 1;
    }
    const size_t n = digits(s);
    if (!is_port_number(s, n) || s[n] != ':')
        return false;
    s += n + 1;
    return is_port_number(s, digits(s)) && !s[digits(s)];
}

// "1/8000" or "2.5".
static bool to_seconds(const char *text, double *out)
{
    double below = 1;
    char above[40];
    const size_t n = strcspn(text, "/");
    if (n >= sizeof(above))
        return false;
    memcpy(above, text, n);
    above[n] = 0;
    if (!to_number(above, out) || (text[n] && !to_number(text + n + 1, &below)) || !(below > 0))
        return false;
    *out /= below;
    return true;
}

// "1.5, 2, -3": exactly n numbers.
static bool to_numbers(const char *text, double *out, int n)
{
    char word[40];
    for (int i = 0; i < n; i++) {
        text += strspn(text, " \t");
        const size_t length = strcspn(text, ", \t");
        if (length >= sizeof(word))
            return false;
        memcpy(word, text, length);
        word[length] = 0;
        text += length + strspn(text + length, " \t");
        if (!to_number(word, &out[i]) || *text != (i < n - 1 ? ',' : 0))
            return false;
        text += *text == ',';
    }
    return true;
}

// "0,0; 90,0; 180,-30". How many, 0: they are none, or too many.
static int to_stops(const char *text, struct config_stop *out)
{
    char word[80];
    for (int n = 0; n < CONFIG_STOPS_MAX; n++) {
        double angle[2];
        const size_t length = strcspn(text, ";");
        if (length >= sizeof(word))
            return 0;
        memcpy(word, text, length);
        word[length] = 0;
        if (!to_numbers(word, angle, 2) || angle[0] < -360 || angle[0] > 360 || angle[1] < -90 || angle[1] > 90)
            return 0;
        out[n] = (struct config_stop){ angle[0], angle[1] };
        if (!text[length])
            return n + 1;
        text += length + 1;
    }
    return 0;
}

static const char *set_value(const struct key *key, void *target, const char *value) // NULL, or what was expected
{
    static const char *const kinds[] = { "software", "gpio", "usb", "simulated" };
    static const char *const demosaics[] = { "ahd", "bilinear", "half" }, *const thens[] = { "off", "standard", "final" };
    static const char *const heads[] = { "none", "manual", "board" };
    static _Thread_local char range[80];
    char *field = (char *)target + key->offset;
    double n;
    switch (key->type) {
    case TEXT:
    case PATH:
    case NAME:
        if (!value[0])
            return "a value";
        if (strlen(value) >= key->room) {
            snprintf(range, sizeof(range), "at most %zu bytes", key->room - 1);
            return range;
        }
        if (key->type == NAME && !is_plain(value))
            return "letters, digits, - and _";
        if (key->type == PATH && value[0] != '/' && !(value[0] == '@' && value[1] && !strcmp(key->name, "address"))) // abstract sockets
            return "a path that begins with /";
        memcpy(field, value, strlen(value) + 1);
        return NULL;
    case PORT:
        if (!is_port(value) || strlen(value) >= key->room)
            return "usb:BUS-PORT.PORT (as in /sys/bus/usb/devices) or ptpip:IPV4:PORT:EVENTPORT";
        memcpy(field, value, strlen(value) + 1);
        return NULL;
    case POWER: {
        const char *end = skip_slot(value);
        if (!end || *end != ':' || !digits(end + 1) || end[1 + digits(end + 1)] || strlen(value) >= key->room)
            return "HUB:PORT, for example 1-4:3";
        memcpy(field, value, strlen(value) + 1);
        return NULL;
    }
    case KIND:
        for (int i = 0; i < 4; i++)
            if (!strcmp(value, kinds[i])) {
                const enum trigger_kind kind = i;
                memcpy(field, &kind, sizeof(kind));
                return NULL;
            }
        return "software, gpio, usb or simulated";
    case LISTEN: {
        struct listen_address address;
        if (!strcmp(value, "off"))
            field[0] = 0;
        else if (strlen(value) < key->room && !listen_parse(&address, value))
            memcpy(field, value, strlen(value) + 1);
        else
            return "ADDRESS:PORT (127.0.0.1:8420, [::1]:8420; 0.0.0.0:8420 for all addresses), or off";
        return NULL;
    }
    case BOOL: {
        const bool yes = !strcmp(value, "yes") || !strcmp(value, "true");
        if (!yes && strcmp(value, "no") && strcmp(value, "false"))
            return "yes or no";
        memcpy(field, &yes, sizeof(yes));
        return NULL;
    }
    case ON_OFF: {
        const bool on = !strcmp(value, "on");
        if (!on && strcmp(value, "off"))
            return "on or off";
        memcpy(field, &on, sizeof(on));
        return NULL;
    }
    case DEMOSAIC:
    case THEN:
        for (int i = 0; i < 3; i++)
            if (!strcmp(value, key->type == THEN ? thens[i] : demosaics[i])) {
                memcpy(field, &(int){ i }, sizeof(int)); // an enum's size
                return NULL;
            }
        return key->type == THEN ? "off, standard or final" : "ahd, bilinear or half";
    case LINE:
        if (!strcmp(value, "none")) {
            const int none = CONFIG_NONE;
            memcpy(field, &none, sizeof(none));
            return NULL;
        }
        if (!strcmp(value, "capture") && !strcmp(key->name, "feedback_line")) {
            const int capture = CONFIG_CAPTURE;
            memcpy(field, &capture, sizeof(capture));
            return NULL;
        }
        if (!to_number(value, &n) || n < 0 || n >= LINES_MAX || n != (int)n)
            return "a line's number, or none";
        const int line = (int)n;
        memcpy(field, &line, sizeof(line));
        return NULL;
    case HEAD:
        for (int i = 0; i < 3; i++)
            if (!strcmp(value, heads[i])) {
                const enum head_kind head = i;
                memcpy(field, &head, sizeof(head));
                return NULL;
            }
        return "none, manual or board";
    case MODEL:
        for (int i = 0; i < LENS_MODELS; i++)
            if (!strcmp(value, lens_model_name(i))) {
                const enum lens_model model = i;
                memcpy(field, &model, sizeof(model));
                return NULL;
            }
        return "rectilinear, equidistant, equisolid or stereographic";
    case SECONDS:
        if (!to_seconds(value, &n) || n < key->least || n > key->most)
            return "an exposure time such as 1/125 or 2.5, up to 60 s";
        memcpy(field, &n, sizeof(n));
        return NULL;
    case NUMBERS: {
        double list[5];
        const int n_list = !strcmp(key->name, "distortion") ? 5 : (int)(key->room / sizeof(double));
        bool good = to_numbers(value, list, n_list);
        for (int i = 0; good && i < n_list; i++)
            good = list[i] >= key->least && list[i] <= key->most;
        if (!good) {
            snprintf(range, sizeof(range), "%d numbers from %.0f to %.0f with commas between them", n_list, key->least, key->most);
            return range;
        }
        memcpy(field, list, (size_t)n_list * sizeof(double));
        return NULL;
    }
    case STOPS: {
        struct panorama_config *panorama = (struct panorama_config *)(field - offsetof(struct panorama_config, stop));
        panorama->n_stops = to_stops(value, panorama->stop);
        return panorama->n_stops ? NULL : "up to 64 pairs yaw,pitch in degrees with semicolons between them: 0,0; 120,0; 240,0";
    }
    case INTEGER:
    case UNSIGNED:
    case NUMBER:
        if (!to_number(value, &n) || n < key->least || n > key->most || (key->type != NUMBER && n != (double)(int64_t)n)) {
            snprintf(range, sizeof(range), "a %snumber from %.0f to %.0f", key->type == NUMBER ? "" : "whole ", key->least, key->most);
            return range;
        }
        if (key->type == NUMBER)
            memcpy(field, &n, sizeof(n));
        else if (key->type == INTEGER)
            memcpy(field, &(int){ (int)n }, sizeof(int));
        else
            memcpy(field, &(uint32_t){ (uint32_t)n }, sizeof(uint32_t));
        return NULL;
    }
    return "nothing";
}

static void add_setting(struct reader *r, int camera, const char *name, const char *value)
{
    if (!name[0] || strlen(name) >= sizeof(r->own->setting.name) || strspn(name, "abcdefghijklmnopqrstuvwxyz0123456789_") != strlen(name)) {
        complain(r, r->line, "found setting '%s', expected a neutral name of config/cameras (iso, shutter, aperture, ...)", name);
        return;
    }
    if (!value[0] || strlen(value) >= sizeof(r->own->setting.value)) {
        complain(r, r->line, "setting %s: found %zu bytes, expected 1 to %zu", name, strlen(value), sizeof(r->own->setting.value) - 1);
        return;
    }
    for (int i = 0; i < r->n_own; i++)
        if (r->own[i].camera == camera && !strcmp(r->own[i].setting.name, name)) {
            complain(r, r->line, "setting '%s' is there twice; remove one", name);
            return;
        }
    struct own_setting *grown = realloc(r->own, ((size_t)r->n_own + 1) * sizeof(*grown));
    if (!grown) {
        r->no_memory = true;
        return;
    }
    r->own = grown;
    struct own_setting *s = &r->own[r->n_own++];
    memset(s, 0, sizeof(*s));
    s->camera = camera;
    snprintf(s->setting.name, sizeof(s->setting.name), "%s", name);
    snprintf(s->setting.value, sizeof(s->setting.value), "%s", value);
}

static int take_line(void *arg, const char *section, const char *name, const char *value)
{
    struct reader *r = arg;
    struct config *c = r->config;
    (void)section; // known from next_line, uncut
    if (r->section == BAD_SECTION)
        return 1;
    if (r->section == NO_SECTION) {
        complain(r, r->line, "'%s' is in no section; put it below [rig] or another", name);
        return 1;
    }
    if (r->section == SETTINGS) {
        add_setting(r, CONFIG_NONE, name, value);
        return 1;
    }
    if (r->section == CAMERA && !strncmp(name, "setting.", 8)) {
        add_setting(r, c->n_cameras - 1, name + 8, value);
        return 1;
    }
    for (int k = 0; k < sections[r->section].n_keys; k++) {
        const struct key *key = &sections[r->section].keys[k];
        if (strcmp(key->name, name))
            continue;
        void *target = r->section == CAMERA ? (void *)&c->camera[c->n_cameras - 1] : r->section == TRIGGER ? (void *)&c->trigger
                       : r->section >= DEVELOP ? (void *)&c->process : (void *)c;
        if (r->seen >> k & 1)
            complain(r, r->line, "'%s' is there twice in this section; remove one", name);
        r->seen |= 1u << k;
        if (r->section == TRIGGER && (!strcmp(name, "half_press_ms") || !strcmp(name, "hold_ms") || !strcmp(name, "max_hold_ms")))
            r->hold_line = r->line;
        const char *expected = set_value(key, target, value);
        if (expected)
            complain(r, r->line, "%s: found '%s', expected %s", name, value, expected);
        return 1;
    }
    char known[400] = "";
    for (int k = 0, n = 0; k < sections[r->section].n_keys && n < (int)sizeof(known) - 30; k++)
        n += snprintf(known + n, sizeof(known) - (size_t)n, "%s%s", k ? ", " : "", sections[r->section].keys[k].name);
    complain(r, r->line, "[%s] knows no '%s'; it knows %s", sections[r->section].name, name, known);
    return 1;
}

// ---- the whole -------------------------------------------------------------------------------------------------------------------

static void merge_settings(struct reader *r)
{
    struct config *c = r->config;
    for (int i = 0; i < c->n_cameras; i++)
        for (int pass = 0; pass < 2; pass++) // of all, then its own on top
            for (int s = 0; s < r->n_own; s++) {
                struct config_camera *k = &c->camera[i];
                int at = 0;
                if (r->own[s].camera != (pass ? i : CONFIG_NONE))
                    continue;
                while (at < k->n_settings && strcmp(k->setting[at].name, r->own[s].setting.name))
                    at++;
                if (at == CAMERA_SETTINGS_MAX) {
                    complain(r, r->camera_line[i], "camera \"%s\" has more than %d settings", k->name, CAMERA_SETTINGS_MAX);
                    return;
                }
                k->setting[at] = r->own[s].setting;
                k->n_settings += at == k->n_settings;
            }
}

// GPIO lines are one row of numbers; a board has outputs and inputs, and the simulated rig a row for each purpose.
struct use {
    int line;
    const char *purpose;
    char what[48];
};

static void use_line(struct reader *r, struct use *uses, int *n, int line, const char *camera, const char *what, int at)
{
    if (line == CONFIG_NONE)
        return;
    const enum trigger_kind kind = r->config->trigger.kind;
    const bool is_input = !strcmp(what, "feedback_line");
    struct use u = { .line = line, .purpose = kind == TRIGGER_GPIO ? "any" : kind == TRIGGER_USB ? (is_input ? "input" : "output") : what };
    snprintf(u.what, sizeof(u.what), "%s%.23s%s%s", camera[0] ? "camera " : "", camera, camera[0] ? "'s " : "[trigger] ", what);
    for (int i = 0; i < *n; i++)
        if (uses[i].line == line && !strcmp(uses[i].purpose, u.purpose)) {
            if (line == CONFIG_CAPTURE)
                complain(r, at, "the capture input is %s already, it cannot be %s too", uses[i].what, u.what);
            else
                complain(r, at, "line %d is %s already, it cannot be %s too", line, uses[i].what, u.what);
            return;
        }
    uses[(*n)++] = u;
    if (line == CONFIG_CAPTURE && kind != TRIGGER_USB)
        complain(r, at, "%s = capture: only kind = usb has that input", u.what);
    if (kind != TRIGGER_USB || !r->config->trigger.output_registers)
        return;
    const int n_outputs = 8 * r->config->trigger.output_registers;
    if (is_input && line >= INPUTS_MAX)
        complain(r, at, "%s: found %d, expected 0 to %d or capture: the board has no more inputs", u.what, line, INPUTS_MAX - 1);
    else if (!is_input && line >= n_outputs)
        complain(r, at, "%s: found %d, expected 0 to %d: output_registers = %d is %d outputs", u.what, line, n_outputs - 1, n_outputs / 8, n_outputs);
    else if (!strcmp(what, "full_line") && line >= PRESSES_MAX)
        complain(r, at, "%s: found %d, expected 0 to %d: outputs behind these cannot be pressed at a time of their own; half_line and relay_line may", u.what, line, PRESSES_MAX - 1);
}

static bool is_said(const struct reader *r, const char *trigger_key)
{
    for (int k = 0; k < COUNT(trigger_keys); k++)
        if (!strcmp(trigger_keys[k].name, trigger_key))
            return r->trigger_seen >> k & 1;
    return false;
}

static void check_board(struct reader *r)
{
    struct trigger_config *t = &r->config->trigger;
    if (!t->output_registers)
        complain(r, r->trigger_line, "[trigger] kind = usb needs 'output_registers = ' with the number of shift registers in the board's chain (8 outputs each)");
    if (t->button_line != CONFIG_NONE)
        complain(r, r->trigger_line, "[trigger] kind = usb has a button input of its own; remove button_line");
    if (t->active_low)
        complain(r, r->trigger_line, "[trigger] kind = usb presses with a 1 in its registers; remove active_low, and invert behind them if you must");
    // Its inputs are pulled up: contacts to ground are the rule.
    t->button_active_low = t->button_active_low || !is_said(r, "button_active_low");
    t->feedback_active_low = t->feedback_active_low || !is_said(r, "feedback_active_low");
}

static void check_lines(struct reader *r)
{
    const struct config *c = r->config;
    const struct trigger_config *t = &c->trigger;
    struct use *uses = calloc((size_t)c->n_cameras * 4 + 3, sizeof(*uses));
    int n = 0;
    bool half = t->kind == TRIGGER_SIMULATED || (t->kind != TRIGGER_SOFTWARE && t->half_line != CONFIG_NONE);
    if (!uses) {
        r->no_memory = true;
        return;
    }
    use_line(r, uses, &n, t->full_line, "", "full_line", r->trigger_line);
    use_line(r, uses, &n, t->half_line, "", "half_line", r->trigger_line);
    use_line(r, uses, &n, t->button_line, "", "button_line", r->trigger_line);
    for (int i = 0; i < c->n_cameras; i++) {
        const struct config_camera *k = &c->camera[i];
        use_line(r, uses, &n, k->full_line, k->name, "full_line", r->camera_line[i]);
        use_line(r, uses, &n, k->half_line, k->name, "half_line", r->camera_line[i]);
        use_line(r, uses, &n, k->feedback_line, k->name, "feedback_line", r->camera_line[i]);
        use_line(r, uses, &n, k->relay_line, k->name, "relay_line", r->camera_line[i]);
        half |= t->kind != TRIGGER_SOFTWARE && k->half_line != CONFIG_NONE;
        if ((t->kind == TRIGGER_GPIO || t->kind == TRIGGER_USB) && k->full_line == CONFIG_NONE && t->full_line == CONFIG_NONE && i != config_panorama_camera(c))
            complain(r, r->camera_line[i], "camera \"%s\" has no full_line and [trigger] has none for all; nothing would press it", k->name);
    }
    free(uses);
    if (t->kind == TRIGGER_USB)
        check_board(r);
    if (t->kind == TRIGGER_GPIO && !t->chip[0])
        complain(r, r->trigger_line, "[trigger] kind = gpio needs 'chip = gpiochip0' or another (gpiodetect lists them)");
    if (t->kind == TRIGGER_SIMULATED && !t->address[0])
        complain(r, r->trigger_line, "[trigger] kind = simulated needs 'address = ' with rigsim's trigger socket");
    const uint32_t held_ms = t->hold_ms + (half ? t->half_press_ms : 0);
    if (held_ms > t->max_hold_ms)
        complain(r, r->hold_line, "%s hold a line for %u ms, longer than max_hold_ms = %u; raise that to %u or more (lag compensation comes on top), or shorten %s",
                 half ? "half_press_ms and hold_ms" : "hold_ms would", held_ms, t->max_hold_ms, held_ms, half ? "them" : "it");
}

static void check_cameras(struct reader *r)
{
    struct config *c = r->config;
    if (!c->n_cameras && !r->n_findings)
        complain(r, 0, "no [camera \"NAME\"]; name at least one camera");
    for (int i = 0; i < c->n_cameras; i++) {
        struct config_camera *k = &c->camera[i];
        for (int j = 0; j < i; j++) {
            if (k->serial[0] && !strcmp(k->serial, c->camera[j].serial))
                complain(r, r->camera_line[i], "serial %s is camera \"%s\"'s already (line %d); read it off the body with rigctl status", k->serial, c->camera[j].name, r->camera_line[j]);
            if (k->port[0] && !strcmp(k->port, c->camera[j].port))
                complain(r, r->camera_line[i], "port %s is camera \"%s\"'s already (line %d); each camera hangs on a port of its own", k->port, c->camera[j].name, r->camera_line[j]);
        }
        k->controller = !strncmp(k->port, "usb:", 4) ? atoi(k->port + 4) % 255 + 1 : 0;
    }
}

// Its camera, its lens, and where it stops.
static void check_panorama(struct reader *r)
{
    struct config *c = r->config;
    struct panorama_config *p = &c->panorama;
    p->camera = CONFIG_NONE;
    for (int i = 0; i < c->n_cameras; i++)
        if (!strcmp(c->camera[i].name, p->camera_name))
            p->camera = i;
    if (!(r->seen_sections >> PANORAMA & 1) || r->n_findings)
        return;
    if (p->camera == CONFIG_NONE)
        complain(r, r->panorama_line, "[panorama] camera = %s, but there is no [camera \"%s\"]; add it, or name another", p->camera_name, p->camera_name);
    else if (c->n_cameras == 1)
        complain(r, r->panorama_line, "[panorama] takes the only camera; ordinary takes need one, too");
    p->lens.max_angle_rad = p->max_angle_deg * (3.14159265358979323846 / 180);
    if (!(p->lens.centre_px[0] > 0) && !(p->lens.centre_px[1] > 0))
        p->lens.centre_px[0] = .5 * p->lens.width_px, p->lens.centre_px[1] = .5 * p->lens.height_px;
    if (lens_init(&p->lens, r->file)) // says itself what is wrong
        r->n_findings++;
    else if (!p->n_stops && p->head == HEAD_NONE)
        p->n_stops = 1; // straight ahead: it cannot turn
    else if (!p->n_stops && !(p->n_stops = stops_plan(p->stop, CONFIG_STOPS_MAX, &p->lens, p->overlap)))
        complain(r, r->panorama_line, "[panorama] would need more than %d stops for the whole sphere; list those you want: stops = YAW,PITCH; ...", CONFIG_STOPS_MAX);
    if (p->head == HEAD_NONE && p->n_stops > 1)
        complain(r, r->panorama_line, "[panorama] has %d stops, but head = none cannot turn; head = manual asks a person to", p->n_stops);
    if (!(p->shortest_s < p->longest_s) || p->meter_s < p->shortest_s || p->meter_s > p->longest_s)
        complain(r, r->panorama_line, "[panorama] expected shortest <= meter <= longest, and not all the same");
    if (p->head == HEAD_BOARD && c->trigger.kind != TRIGGER_USB && c->trigger.kind != TRIGGER_SIMULATED)
        complain(r, r->panorama_line, "[panorama] head = board needs [trigger] kind = usb (or simulated); head = manual works with any");
}

static void set_defaults(struct config *c)
{
    strcpy(c->name, "studio");
    strcpy(c->socket_path, "/run/rigd/rigd.sock");
    strcpy(c->state_dir, "/var/lib/rigd");
    c->objects_per_shot = 1;
    c->raw_mb = 60;
    c->free_space_mb = 10000;
    c->thumbnails = true;
    c->fetch_limit = 8;
    c->heartbeat_s = 25;
    c->battery_min_percent = 20;
    c->clock_max_s = 5;
    c->collect_timeout_ms = 8000;
    c->fetch_timeout_ms = 120000;
    c->calibration_shots = 30;
    c->lag_within_ms = .1;
    c->lag_max_std_ms = 15;
    struct panorama_config *p = &c->panorama;
    p->camera = CONFIG_NONE;
    p->overlap = .25;
    p->meter_s = 1. / 60;
    p->shortest_s = 1. / 8000;
    p->longest_s = 4;
    p->frames_max = 12;
    p->settle_ms = 800;
    struct trigger_config *t = &c->trigger;
    t->full_line = t->half_line = t->button_line = CONFIG_NONE;
    t->button_debounce_ms = 30;
    t->half_press_ms = 500;
    t->hold_ms = 150;
    t->max_hold_ms = 2000;
    t->head_deg_per_s = 30;
    t->head_deg_per_s2 = 60;
    t->head_limit_deg[0] = 180;
    t->head_limit_deg[1] = 90;
    struct process_config *made = &c->process;
    made->develop_timeout_s = 300;
    made->panorama_timeout_s = 1800;
    made->reconstruct_timeout_s = 24 * 3600;
    made->solve_timeout_s = 12 * 3600;
}

int config_parse(struct config *out, const char *text, size_t n_bytes, const char *name)
{
    int err = -ENOMEM;
    struct config c;
    memset(&c, 0, sizeof(c));
    set_defaults(&c);
    c.camera = calloc(CONFIG_CAMERAS_MAX, sizeof(*c.camera));
    struct reader r = { .file = name, .text = text, .end = text + n_bytes, .config = &c };
    memset(out, 0, sizeof(*out));
    if (!c.camera)
        goto fail;
    const int bad_line = ini_parse_stream(next_line, &r, take_line, &r);
    if (bad_line < 0)
        goto fail;
    if (bad_line > 0 && !r.n_findings)
        complain(&r, bad_line, "found neither 'key = value', [section] nor ; comment");
    check_section_end(&r);
    for (int s = RIG; s < CAMERA; s++)
        if ((s == RIG || s == TRIGGER) && !(r.seen_sections >> s & 1))
            complain(&r, 0, "section [%s] is missing", sections[s].name);
    check_cameras(&r);
    merge_settings(&r);
    check_panorama(&r);
    check_lines(&r);
    if (r.no_memory)
        goto fail;
    if (r.n_findings > FINDINGS_MAX)
        log_error("config: %s: and more; mend these first", name);
    if (r.n_findings) {
        err = -EINVAL;
        goto fail;
    }
    free(r.own);
    *out = c;
    return 0;
fail:
    free(r.own);
    config_free(&c);
    return err;
}

// cameras/ beside rigd.conf; without one, what was installed with this program (PREFIX/bin/rigd, PREFIX/share/...).
static void find_personality_dir(struct config *c, const char *path)
{
    char program[200];
    const char *slash = strrchr(path, '/');
    snprintf(c->personality_dir, sizeof(c->personality_dir), "%.*scameras", slash ? (int)(slash - path) + 1 : 0, path);
    const ssize_t n = access(c->personality_dir, R_OK) ? readlink("/proc/self/exe", program, sizeof(program) - 1) : -1;
    if (n <= 0)
        return;
    program[n] = 0;
    *strrchr(program, '/') = 0;
    char installed[sizeof(program) + 40];
    snprintf(installed, sizeof(installed), "%s/../share/studiorig/config/cameras", program);
    if (!access(installed, R_OK) && strlen(installed) < sizeof(c->personality_dir))
        strcpy(c->personality_dir, installed);
}

// personality = nikon  ->  <personality_dir>/nikon.conf, which must be there.
static int find_personalities(struct config *c, const char *path)
{
    int err = 0;
    if (!c->personality_dir[0])
        find_personality_dir(c, path);
    for (int i = 0; i < c->n_cameras; i++) {
        struct config_camera *k = &c->camera[i];
        char file[sizeof(k->personality)];
        if (!k->personality[0])
            continue;
        if (snprintf(file, sizeof(file), "%s/%s.conf", c->personality_dir, k->personality) >= (int)sizeof(file) || access(file, R_OK)) {
            log_error("config: %s: camera \"%s\": no personality '%s' in %s; take one of the files there, or set personality_dir", path, k->name, k->personality, c->personality_dir);
            err = -EINVAL;
            continue;
        }
        char *whole = realpath(file, NULL); // workers get absolute paths
        if (!whole || strlen(whole) >= sizeof(k->personality)) {
            log_error("config: %s: the path of %s is too long", path, file);
            err = -EINVAL;
        } else {
            strcpy(k->personality, whole);
        }
        free(whole);
    }
    return err;
}

int config_read(struct config *out, const char *path)
{
    char *text;
    size_t n;
    memset(out, 0, sizeof(*out));
    int err = file_read(&text, &n, path, 4 << 20);
    if (err)
        return err;
    err = config_parse(out, text, n, path);
    free(text);
    if (!err)
        err = find_personalities(out, path);
    if (err)
        config_free(out);
    return err;
}

void config_free(struct config *config)
{
    free(config->camera);
    memset(config, 0, sizeof(*config));
}
