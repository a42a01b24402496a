// solver/commands/arguments.c - values of options, checked, with one wording of what is wrong.
#include "solver/commands/arguments.h"

#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static bool read_integer(const char *text, int64_t *value)
{
    char *end;
    errno = 0;
    *value = strtoll(text, &end, 10);
    return end != text && !*end && !errno;
}

int64_t argument_integer(const struct argp_state *state, const char *option, const char *text,
                         int64_t least, int64_t most)
{
    int64_t value;
    if (!read_integer(text, &value) || value < least || value > most)
        argp_error(state, "%s '%s': expected a whole number from %" PRId64 " to %" PRId64, option,
                   text, least, most);
    return value;
}

int argument_power_of_two(const struct argp_state *state, const char *option, const char *text,
                          int most)
{
    int64_t n;
    if (!read_integer(text, &n) || n < 1 || n > most || (n & (n - 1)))
        argp_error(state, "%s '%s': expected a power of two from 1 to %d", option, text, most);
    return (int)n;
}

double argument_number(const struct argp_state *state, const char *option, const char *text,
                       const char *what, double least, double most)
{
    char *end;
    const double value = strtod(text, &end);
    if (end == text || *end || !(value >= least && value <= most))
        argp_error(state, "%s '%s': expected %s from %g to %g", option, text, what, least, most);
    return value;
}

void argument_size(const struct argp_state *state, const char *option, const char *text, int least,
                   int most, int *width_px, int *height_px)
{
    int n = 0;
    if (sscanf(text, "%5dx%5d%n", width_px, height_px, &n) != 2 || text[n] || *width_px < least ||
        *height_px < least || *width_px > most || *height_px > most)
        argp_error(state, "%s '%s': expected WxH, each from %d to %d, as 360x240", option, text,
                   least, most);
}

void argument_point(const struct argp_state *state, const char *option, const char *text,
                    double point_m[3])
{
    const char *at = text;
    for (int c = 0; c < 3; c++) {
        char *end;
        point_m[c] = strtod(at, &end);
        if (end == at || *end != (c < 2 ? ',' : '\0') || !(fabs(point_m[c]) <= 1e9))
            argp_error(state, "%s '%s': expected three numbers in metres, as 0,0.1,1.2", option,
                       text);
        at = end + 1;
    }
}

int argument_choice(const struct argp_state *state, const char *option, const char *text,
                    const char *const *names, int n)
{
    char list[256] = "";
    for (int i = 0; i < n; i++) {
        if (!strcmp(text, names[i]))
            return i;
        const size_t used = strlen(list);
        snprintf(list + used, sizeof(list) - used, "%s%s",
                 i == 0       ? ""
                 : i == n - 1 ? " or "
                              : ", ",
                 names[i]);
    }
    argp_error(state, "%s '%s': expected %s", option, text, list);
    return 0;
}
