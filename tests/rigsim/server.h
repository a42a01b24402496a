// tests/rigsim/server.h - the simulated rig on the wire: all cameras' sockets, the shutter lines and the clock in one epoll loop.
//
// One thread. A body that must not answer (half-press closed, stalled by a fault) leaves what it is sent unread. Object data is made
// while it is sent, a packet ahead: memory does not grow with the size or number of files.
#pragma once
#include "tests/rigsim/faults.h"
#include "tests/rigsim/personality.h"

enum { SERVER_CAMERAS_MAX = 500 };

struct server_settings {
    unsigned n_cameras;
    const char *address;     // dotted, in 127.0.0.0/8
    int port;                // camera i: port + 2 i (command), port + 2 i + 1 (events)
    const char *scene;       // folder, or NULL
    int width_px, height_px; // of raws
    uint64_t seed;
    const char *panorama, *lens; // of the panorama camera (probe.h); NULL: none
    unsigned panorama_camera;
    double panorama_gain;
    const char *trigger_socket; // shutter_line.h; NULL: none
    bool fixed_clock;
    const struct personality *personality;
    const struct faults *faults; // NULL: none
};

// "A01" .. "A20", "B01" ...: rows of 20. Lives as long as the program.
const char *server_camera_name(unsigned camera);
// Serves until SIGTERM or SIGINT: 0. -errno (logged) if it cannot begin: -EADDRINUSE, -EMFILE, -ENOMEM, ...
int server_run(const struct server_settings *s);
