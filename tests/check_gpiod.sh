#!/bin/sh
# tests/check_gpiod.sh - trigger_gpio.c compiles against libgpiod's API 1 and API 2, whichever is installed. Prints TAP.
set -u
n=0 failed=0
compiles() { # name, compiler's options
    n=$((n + 1))
    # shellcheck disable=SC2086
    if said=$(${CC:-gcc} -std=gnu11 -D_GNU_SOURCE -Wall -Wextra -Wshadow -Wstrict-prototypes -Werror -I. $2 -fsyntax-only rigd/trigger_gpio.c 2>&1); then
        echo "ok $n - $1"
    else
        failed=1
        echo "not ok $n - $1"
        printf '%s\n' "$said" | sed 's/^/#   /'
    fi
}
compiles "trigger_gpio.c with the installed libgpiod $(pkg-config --modversion libgpiod 2>/dev/null)" ""
compiles "trigger_gpio.c with API 2" "-isystem tests/gpiod2"
echo "1..$n"
exit $failed
