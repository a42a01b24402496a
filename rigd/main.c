// rigd/main.c - the daemon's command line.
#include "rigd/daemon.h"
#include "solver/take/log.h"

#include <argp.h>
#include <locale.h>
#include <signal.h>
#include <stdlib.h>

static const struct argp_option option_list[] = {
    { "config", 'c', "FILE", 0, "the rig: rigd.conf (/etc/rigd/rigd.conf)", 0 },
    { "takes", 't', "DIR", 0, "where takes go, instead of the configuration's", 0 },
    { "socket", 's', "PATH", 0, "where rigctl finds the daemon, instead of the configuration's", 0 },
    { "once", '1', NULL, 0, "open the cameras, finish what is unfinished, make one take, end", 0 },
    { 0 },
};

static error_t parse(int key, char *arg, struct argp_state *state)
{
    struct daemon_options *o = state->input;
    switch (key) {
    case 'c':
        o->config_path = arg;
        return 0;
    case 't':
        o->takes_dir = arg;
        return 0;
    case 's':
        o->socket_path = arg;
        return 0;
    case '1':
        o->once = true;
        return 0;
    case ARGP_KEY_ARG:
        argp_error(state, "found '%s', expected options only", arg);
        return EINVAL;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

int main(int argc, char **argv)
{
    static const struct argp argp = {
        option_list, parse, NULL,
        "Fires the cameras of a photogrammetry studio and keeps every frame.\v"
        "Talk to it with rigctl, or with a browser where the configuration has [web] listen = 127.0.0.1:8420. A take under way survives any end of this process: the next start finishes it. "
        "Exit status: 0 ended when asked to, 1 failed (--once: the take is not verified), 2 usage.",
        NULL, NULL, NULL,
    };
    struct daemon_options options = { .config_path = "/etc/rigd/rigd.conf" };
    argp_err_exit_status = 2;
    argp_program_version = "rigd (studiorig) " STUDIORIG_VERSION;
    log_set_program("rigd");
    setenv("LC_ALL", "C", 1); // drivers in the workers speak numbers
    signal(SIGPIPE, SIG_IGN);
    argp_parse(&argp, argc, argv, 0, NULL, &options);
    return daemon_run(&options) ? 1 : 0;
}
