// rigd/unpack.c - build/bin/rigd-unpack FILE: can this raw be unpacked, every photosite of it? Exit status 0 yes, 1 no (the reason on
// standard output), 2 usage, 4 not a raw that LibRaw knows. A camera's worker starts it for each frame before the frame gets its name.
#include "rigd/develop.h"

#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <unistd.h>

enum { MOST_SECONDS = 30 };

int main(int argc, char **argv)
{
    char why[120] = "";
    if (argc != 2 || argv[1][0] == '-') {
        fprintf(stderr, "usage: rigd-unpack FILE: can this raw be unpacked? 0 yes, 1 no, 4 not a raw that is known\n");
        return 2;
    }
    prctl(PR_SET_PDEATHSIG, SIGKILL); // a worker that is gone needs no answer
    alarm(MOST_SECONDS);
#if !defined(__SANITIZE_ADDRESS__) // which maps terabytes
    setrlimit(RLIMIT_AS, &(struct rlimit){ (rlim_t)3 << 30, (rlim_t)3 << 30 });
#endif
    const int err = develop_check(argv[1], why, sizeof(why));
    if (err)
        printf("%s\n", why[0] ? why : "LibRaw ran out of memory");
    return err == -ENOTSUP ? 4 : err ? 1 : 0;
}
