// rigd/develop_options.c - see develop_options.h.
#include "rigd/develop_options.h"

#include <math.h>
#include <stdlib.h>

bool option_numbers(const char *text, double *to, int n)
{
    for (int i = 0; i < n; i++) {
        char *end;
        to[i] = strtod(text, &end);
        if (end == text || !isfinite(to[i]))
            return false;
        if (*end == '/') {
            text = end + 1;
            const double below = strtod(text, &end);
            if (end == text || !(below > 0) || !isfinite(to[i] / below))
                return false;
            to[i] /= below;
        }
        if (*end != (i + 1 < n ? ',' : 0))
            return false;
        text = end + 1;
    }
    return true;
}

bool option_exposure(const char *text, double to[3], bool zero_allowed)
{
    bool ok = option_numbers(text, to, 3);
    for (int i = 0; i < 3 && ok; i++)
        ok = to[i] > 0 || (to[i] == 0 && zero_allowed);
    return ok;
}

bool option_saturation(const char *text, double *dn)
{
    return option_numbers(text, dn, 1) && *dn >= 1 && *dn <= 65535;
}

bool option_patch(const char *text, double corner[4][2])
{
    double v[4];
    if (!option_numbers(text, v, 4) || !(v[2] > 0 && v[3] > 0))
        return false;
    for (int i = 0; i < 4; i++) {
        corner[i][0] = v[0] + (i == 1 || i == 2 ? v[2] : 0);
        corner[i][1] = v[1] + (i >= 2 ? v[3] : 0);
    }
    return true;
}

bool option_chart(const char *text, double corner[4][2])
{
    double v[8];
    if (!option_numbers(text, v, 8))
        return false;
    for (int i = 0; i < 8; i++)
        corner[i / 2][i % 2] = v[i];
    return true;
}
