// solver/main.c - rigsolve: the solver's command line. Sub-commands live in commands/.
#include "solver/commands/commands.h"
#include "solver/take/log.h"

#include <argp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const struct {
    const char *name;
    int (*run)(int argc, char **argv);
    const char *what;
} commands[] = {
    { "synth", command_synth, "make a synthetic studio D1..D5 with a known answer" },
    { "solve", command_solve, "find the lights' places, the reflectance and every texel's albedo" },
    { "lights", command_lights, "cut a panorama into N lights" },
    { "visibility", command_visibility, "trace which cameras and lights see which texel" },
    { "render", command_render, "re-render views of a solved (or true) material" },
    { "export", command_export, "write a solved material as GLB, MaterialX, OBJ or for Blender" },
    { "report", command_report, "write a page for people about a solve" },
    { "compare", command_compare, "RMSE and PSNR of two pictures" },
    { "chart", command_chart, "speed against accuracy: settings, methods and presets, as CSV, SVG, PNG" },
    { "brdf", command_brdf, "evaluate the Disney BRDF and its derivatives for a table of cases" },
};
enum { N_COMMANDS = sizeof(commands) / sizeof(commands[0]) };

static void print_help(FILE *out)
{
    fprintf(out, "Usage: rigsolve COMMAND [OPTION...]\n"
                 "From photographs in a studio to relightable materials.\n\n");
    for (int i = 0; i < N_COMMANDS; i++)
        fprintf(out, "  %-12s %s\n", commands[i].name, commands[i].what);
    fprintf(out, "\n`rigsolve COMMAND --help` tells the rest. Also: --help, --version.\n"
                 "Exit status: 0 done, 1 failed, 2 usage, 3 done but not to be trusted.\n");
}

int main(int argc, char **argv)
{
    argp_err_exit_status = EXIT_USAGE;
    log_set_program("rigsolve");
    if (argc < 2) {
        print_help(stderr);
        return EXIT_USAGE;
    }
    if (!strcmp(argv[1], "--help") || !strcmp(argv[1], "help") || !strcmp(argv[1], "-?")) {
        print_help(stdout);
        return EXIT_DONE;
    }
    if (!strcmp(argv[1], "--version") || !strcmp(argv[1], "-V")) {
        puts("rigsolve (studiorig) " STUDIORIG_VERSION);
        return EXIT_DONE;
    }
    for (int i = 0; i < N_COMMANDS; i++) {
        if (strcmp(argv[1], commands[i].name))
            continue;
        char name[64];
        snprintf(name, sizeof(name), "rigsolve %s", commands[i].name);
        argv[1] = name;
        return commands[i].run(argc - 1, argv + 1);
    }
    fprintf(stderr, "rigsolve: unknown command '%s'\n", argv[1]);
    print_help(stderr);
    return EXIT_USAGE;
}
