// rigd/rigctl_develop.h - rigctl's commands that need no daemon: develop, calibrate colour. Each frame in a process of its own
// (rigd-develop, beside this program), as many at once as there are cores. argv[0] is the command's last word; json: it was asked for
// before the command. Returns the exit status: 0 done, 1 failed, 2 usage, 3 done but not to be trusted.
#pragma once
#include <stdbool.h>

int rigctl_develop(int argc, char **argv, bool json);
int rigctl_calibrate_colour(int argc, char **argv, bool json);
