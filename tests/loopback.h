// tests/loopback.h - an address of this machine that belongs to this process: programs that run at the same time can use the same ports.
//
// All of 127.0.0.0/8 is this machine. Connections of others come from 127.0.0.1, so that theirs cannot be in the way either.
#pragma once
#include <stdio.h>
#include <unistd.h>

// "127.x.y.z"; x is not 0. The same in children.
static inline const char *loopback_address(void)
{
    static char text[16];
    const unsigned pid = (unsigned)getpid(); // of 22 bits at most
    if (!text[0])
        snprintf(text, sizeof(text), "127.%u.%u.%u", 1 + (pid >> 16 & 127), pid >> 8 & 255, pid & 255);
    return text;
}
