// rigd/develop_options.h - values that rigctl and rigd-develop are both given: rigctl refuses what is wrong before it starts a hundred frames.
#pragma once
#include <stdbool.h>

// n numbers with commas between; "1/128" is one. Not finite, too few, too many: false. Programs run in the C locale.
bool option_numbers(const char *text, double *to, int n);
// T,N,ISO: all above 0; zero_allowed: or 0.
bool option_exposure(const char *text, double to[3], bool zero_allowed);
bool option_saturation(const char *text, double *dn); // 1 .. 65535
// Corners: upper left, upper right, lower right, lower left.
bool option_patch(const char *text, double corner[4][2]); // X,Y,W,H
bool option_chart(const char *text, double corner[4][2]); // X1,Y1, ... X4,Y4
