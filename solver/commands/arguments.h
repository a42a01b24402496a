// solver/commands/arguments.h - values of options, checked: the rest of a command's parse function
// is where they go.
//
// Every function takes the whole text, leaves nothing unread, and otherwise ends the program by
// argp_error() (exit code 2) with "OPTION 'TEXT': expected ...". option is as the user typed it:
// "--threads", "-n". Numbers are those of the C locale, which no command leaves.
#pragma once
#include <argp.h>
#include <stdint.h>

int64_t argument_integer(const struct argp_state *state, const char *option, const char *text,
                         int64_t least, int64_t most);
// From 1 to most.
int argument_power_of_two(const struct argp_state *state, const char *option, const char *text,
                          int most);
// what: the plural of the unit, for the message ("expected stops from -40 to 40"), or "a number".
double argument_number(const struct argp_state *state, const char *option, const char *text,
                       const char *what, double least, double most);
// WxH in pixels, each from least to most.
void argument_size(const struct argp_state *state, const char *option, const char *text, int least,
                   int most, int *width_px, int *height_px);
// X,Y,Z in metres, each at most 1e9 from 0.
void argument_point(const struct argp_state *state, const char *option, const char *text,
                    double point_m[3]);
// Which of n >= 2 names it is, from 0.
int argument_choice(const struct argp_state *state, const char *option, const char *text,
                    const char *const *names, int n);
