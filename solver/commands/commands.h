// solver/commands/commands.h - one function per sub-command of rigsolve; argv[0] is "rigsolve NAME".
//
// Each parses its own arguments with argp, logs its errors and returns the program's exit code (DESIGN.md 5).
#pragma once

enum { EXIT_DONE = 0, EXIT_FAILED = 1, EXIT_USAGE = 2, EXIT_NOT_TRUSTED = 3 };

int command_brdf(int argc, char **argv);
int command_lights(int argc, char **argv);
int command_visibility(int argc, char **argv);
int command_solve(int argc, char **argv);
int command_synth(int argc, char **argv);
int command_render(int argc, char **argv);
int command_compare(int argc, char **argv);
int command_export(int argc, char **argv);
int command_report(int argc, char **argv);
int command_chart(int argc, char **argv);
