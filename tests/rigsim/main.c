// tests/rigsim/main.c - rigsim's command line.
#include "solver/take/log.h"
#include "tests/rigsim/body.h"
#include "tests/rigsim/probe.h"
#include "tests/rigsim/server.h"

#include <argp.h>
#include <arpa/inet.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

const char *argp_program_version = "rigsim (studiorig) " STUDIORIG_VERSION;
static const char doc[] =
    "Simulated cameras of a studio over PTP/IP, for libgphoto2 and rigd, without hardware or root.\v"
    "Camera i listens on ADDRESS:PORT+2i (commands) and PORT+2i+1 (events); ADDRESS is 127.0.0.1 unless --address says otherwise. First steps:\n"
    "  rigsim --cameras 3 &\n"
    "  gphoto2 --port ptpip:127.0.0.1:15740:15741 --summary\n"
    "  gphoto2 --port ptpip:127.0.0.1:15740:15741 --capture-image-and-download\n"
    "tests/rigsim/README.md says what is simulated, and how to script faults.";

enum { OPTION_RAW_SIZE = 256, OPTION_SEED, OPTION_FAULTS, OPTION_LIST, OPTION_TRIGGER, OPTION_CLOCK, OPTION_SET, OPTION_PERSONALITY,
       OPTION_SCENE, OPTION_PANORAMA, OPTION_PANORAMA_CAMERA, OPTION_PANORAMA_GAIN, OPTION_LENS, OPTION_ADDRESS };
static const struct argp_option options[] = {
    { "cameras", 'n', "N", 0, "how many, 1 .. 500 (default 1)", 0 },
    { "address", OPTION_ADDRESS, "A", 0, "of this machine only: 127.x.y.z (default 127.0.0.1); rigs with an address each cannot get in each other's way", 0 },
    { "port", 'p', "P", 0, "first port (default 15740)", 0 },
    { "personality", OPTION_PERSONALITY, "NAME|FILE", 0, "generic (default), nikon, canon, or a file (tests/rigsim/personality.h)", 0 },
    { "set", OPTION_SET, "KEY=VALUE", 0, "change one statement of the personality, e.g. lag_jitter_ms=3", 0 },
    { "scene", OPTION_SCENE, "DIR", 0, "folder of linear EXRs, <camera>.exr (default: a built-in picture)", 0 },
    { "panorama", OPTION_PANORAMA, "FILE", 0, "latitude-longitude .hdr or .exr: one camera on a motorised head sees this through its lens", 0 },
    { "panorama-camera", OPTION_PANORAMA_CAMERA, "I", 0, "which camera that is, from 0 (default: the last)", 0 },
    { "panorama-gain", OPTION_PANORAMA_GAIN, "X", 0, "scene values per radiance of FILE (default 1); 2^-EV for a neutral-density filter", 0 },
    { "lens", OPTION_LENS, "JSON|FILE", 0, "of that camera (rigd/lens.h; default an equisolid fisheye of 180 degrees across the frame's height)", 0 },
    { "raw-size", OPTION_RAW_SIZE, "WxH", 0, "of the raws, even numbers (default 2448x1632: 8 MB)", 0 },
    { "seed", OPTION_SEED, "S", 0, "of lags and noise (default 0)", 0 },
    { "clock", OPTION_CLOCK, "real|fixed", 0, "fixed: exposures are stamped 10 s apart, so that the same seed gives the same bytes", 0 },
    { "faults", OPTION_FAULTS, "FILE", 0, "script of what goes wrong (tests/rigsim/faults.h)", 0 },
    { "trigger-socket", OPTION_TRIGGER, "PATH", 0, "shutter lines and flash-sync (rigd/shutter_line.h)", 0 },
    { "list", OPTION_LIST, NULL, 0, "print the cameras as sections of rigd.conf, and end", 0 },
    { 0 },
};

struct arguments {
    struct server_settings server;
    const char *personality, *faults;
    const char *set[32];
    int n_set, panorama_camera;
    bool list;
};

// A whole number min .. max, or a usage error that says so.
static long number(struct argp_state *state, const char *what, const char *text, long min, long max)
{
    char *end;
    errno = 0;
    const long v = strtol(text, &end, 10);
    if (!*text || *end || errno || v < min || v > max)
        argp_error(state, "%s: found '%s'; expected a whole number %ld .. %ld", what, text, min, max);
    return v;
}

static error_t option(int key, char *text, struct argp_state *state)
{
    struct arguments *a = state->input;
    char *x;
    switch (key) {
    case 'n':
        a->server.n_cameras = (unsigned)number(state, "--cameras", text, 1, SERVER_CAMERAS_MAX);
        return 0;
    case 'p':
        a->server.port = (int)number(state, "--port", text, 1, 65534);
        return 0;
    case OPTION_ADDRESS: {
        struct in_addr in;
        if (inet_pton(AF_INET, text, &in) != 1 || ntohl(in.s_addr) >> 24 != 127)
            argp_error(state, "--address: found '%s'; expected 127.x.y.z: nobody else is to reach simulated cameras", text);
        a->server.address = text;
        return 0;
    }
    case OPTION_PERSONALITY:
        a->personality = text;
        return 0;
    case OPTION_SET:
        if (a->n_set == 32)
            argp_error(state, "--set: at most 32 times; write a personality file");
        a->set[a->n_set++] = text;
        return 0;
    case OPTION_SCENE:
        a->server.scene = text;
        return 0;
    case OPTION_PANORAMA:
        a->server.panorama = text;
        return 0;
    case OPTION_PANORAMA_CAMERA:
        a->panorama_camera = (int)number(state, "--panorama-camera", text, 0, SERVER_CAMERAS_MAX - 1);
        return 0;
    case OPTION_PANORAMA_GAIN:
        a->server.panorama_gain = strtod(text, &x);
        if (!*text || *x || !(a->server.panorama_gain > 0) || !(a->server.panorama_gain < 1e9))
            argp_error(state, "--panorama-gain: found '%s'; expected a number above 0", text);
        return 0;
    case OPTION_LENS:
        a->server.lens = text;
        return 0;
    case OPTION_RAW_SIZE:
        x = strchr(text, 'x');
        if (!x)
            argp_error(state, "--raw-size: found '%s'; expected WxH such as 2448x1632", text);
        *x = 0;
        a->server.width_px = (int)number(state, "--raw-size's width", text, 16, 20000);
        a->server.height_px = (int)number(state, "--raw-size's height", x + 1, 16, 20000);
        if (a->server.width_px % 2 || a->server.height_px % 2)
            argp_error(state, "--raw-size: found %dx%d; expected even numbers (RGGB cells)", a->server.width_px, a->server.height_px);
        return 0;
    case OPTION_SEED: {
        errno = 0;
        a->server.seed = strtoull(text, &x, 10);
        if (!*text || *x || errno || *text == '-')
            argp_error(state, "--seed: found '%s'; expected a whole number", text);
        return 0;
    }
    case OPTION_CLOCK:
        if (strcmp(text, "real") && strcmp(text, "fixed"))
            argp_error(state, "--clock: found '%s'; expected real or fixed", text);
        a->server.fixed_clock = text[0] == 'f';
        return 0;
    case OPTION_FAULTS:
        a->faults = text;
        return 0;
    case OPTION_TRIGGER:
        a->server.trigger_socket = text;
        return 0;
    case OPTION_LIST:
        a->list = true;
        return 0;
    case ARGP_KEY_ARG:
        argp_error(state, "found '%s'; expected options only", text);
        return 0;
    case ARGP_KEY_END:
        if (a->server.port + 2 * (int)a->server.n_cameras - 1 > 65535)
            argp_error(state, "--port %d leaves no room for %u cameras below 65536", a->server.port, a->server.n_cameras);
        a->server.panorama_camera = a->panorama_camera < 0 ? a->server.n_cameras - 1 : (unsigned)a->panorama_camera;
        if (a->server.panorama_camera >= a->server.n_cameras)
            argp_error(state, "--panorama-camera %d: there are %u cameras, from 0", a->panorama_camera, a->server.n_cameras);
        if (!a->server.panorama && (a->server.lens || a->panorama_camera >= 0))
            argp_error(state, "--lens and --panorama-camera need --panorama FILE");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

// The lens as keys of rigd.conf.
static void print_panorama(const struct server_settings *s)
{
    struct lens l;
    if (probe_lens(&l, s->lens, s->width_px, s->height_px))
        return;
    printf("[panorama]\ncamera = %s\nhead = %s\nlens = %s\nwidth_px = %d\nheight_px = %d\nfocal_px = %.6f\ncentre_px = %.6f, %.6f\n", server_camera_name(s->panorama_camera),
           s->trigger_socket ? "board" : "manual", lens_model_name(l.model), l.width_px, l.height_px, l.focal_px, l.centre_px[0], l.centre_px[1]);
    printf("distortion = %.9f, %.9f, %.9f, %.9f, %.9f\ncircle_px = %.6f\nmax_angle_deg = %.6f\nshading = %.9f, %.9f, %.9f\n", l.k[0], l.k[1], l.k[2], l.p[0], l.p[1], l.circle_px,
           l.max_angle_rad * 180 / M_PI, l.v[0], l.v[1], l.v[2]);
}

// Sections of rigd.conf; personality: a file of config/cameras/.
static void print_list(const struct server_settings *s)
{
    static const char *const rigd_personality[] = { [VENDOR_GENERIC] = "generic", [VENDOR_NIKON] = "nikon", [VENDOR_CANON] = "canon-eos" };
    if (s->trigger_socket)
        printf("[trigger]\nkind = simulated\naddress = %s\n\n", s->trigger_socket);
    for (unsigned i = 0; i < s->n_cameras; i++) {
        struct body b;
        if (body_init(&b, s->personality, i, s->seed, 0, 0))
            return;
        printf("[camera \"%s\"]\nserial = %s\nport = ptpip:%s:%u:%u\npersonality = %s\n", server_camera_name(i), b.serial,
               s->address, (unsigned)s->port + 2 * i, (unsigned)s->port + 2 * i + 1, rigd_personality[s->personality->vendor]);
        if (s->trigger_socket)
            printf("full_line = %u\nhalf_line = %u\nfeedback_line = %u\nrelay_line = %u\n", i, i, i, i);
        printf("\n");
        body_free(&b);
    }
    if (s->panorama)
        print_panorama(s);
}

int main(int argc, char **argv)
{
    struct arguments a = { .server = { .n_cameras = 1, .address = "127.0.0.1", .port = 15740, .width_px = 2448, .height_px = 1632, .panorama_gain = 1 },
                           .personality = "generic", .panorama_camera = -1 };
    const struct argp parser = { options, option, NULL, doc, NULL, NULL, NULL };
    struct personality *p = malloc(sizeof(*p));
    struct faults faults = { 0 };
    argp_err_exit_status = 2;
    log_set_program("rigsim");
    argp_parse(&parser, argc, argv, 0, NULL, &a);
    int err = p ? personality_load(p, a.personality) : -ENOMEM;
    for (int i = 0; !err && i < a.n_set; i++)
        err = personality_statement(p, a.set[i], "--set", i + 1);
    if (!err && a.faults)
        err = faults_read(&faults, a.faults);
    if (err) {
        free(p);
        return 2;
    }
    char fisheye[160];
    if (!a.server.lens) { // 2 f sin(45 degrees) is the image circle's radius
        snprintf(fisheye, sizeof(fisheye), "{\"model\":\"equisolid\",\"focal_px\":%.3f,\"circle_px\":%.1f,\"max_angle_deg\":90}",
                 .5 * a.server.height_px / M_SQRT2, .5 * a.server.height_px);
        a.server.lens = fisheye;
    }
    a.server.personality = p;
    a.server.faults = &faults;
    if (a.list)
        print_list(&a.server);
    else
        err = server_run(&a.server);
    faults_free(&faults);
    free(p);
    return err ? 1 : 0;
}
