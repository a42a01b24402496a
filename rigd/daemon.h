// rigd/daemon.h - everything that rig.h leaves outside: loop, workers, disk, trigger, clients.
#pragma once
#include <stdbool.h>

struct daemon_options {
    const char *config_path;
    const char *takes_dir, *socket_path; // NULL: as configured
    bool once;                           // open the cameras, finish what is unfinished, make one take, end
};

// Until SIGTERM or SIGINT. 0; 1: --once and its take is not verified; -errno (logged).
int daemon_run(const struct daemon_options *options);
