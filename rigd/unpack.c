// rigd/unpack.c - build/bin/rigd-unpack [--judge LENS] FILE: can this raw be unpacked, every photosite of it? Exit status 0 yes, 1 no (the
// reason on standard output), 2 usage, 4 not a raw that LibRaw knows. A camera's worker starts it for each frame before the frame gets its
// name. --judge: and what light is in it, as frame_facts.h's JSON on standard output; LENS is lens.h's JSON.
#include "rigd/develop.h"
#include "rigd/frame_facts.h"

#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <unistd.h>

enum { MOST_SECONDS = 30 };

static int read_lens(struct lens *out, const char *text)
{
    struct json *doc = NULL;
    int err = json_parse(&doc, text, strlen(text), "--judge");
    if (!err)
        err = lens_from_json(out, doc, "", "--judge");
    json_free(doc);
    return err;
}

// Prints what the frame shows.
static int judge(const char *path, const struct lens *lens, char *why, size_t room)
{
    struct raw_frame raw;
    struct frame_facts facts = { 0 };
    int err = raw_read(&raw, path, why, room);
    if (err)
        return err;
    err = bracket_measure(&facts.light, &raw, raw.width == lens->width_px && raw.height == lens->height_px ? lens : NULL);
    facts.f_number = raw.f_number;
    facts.iso = raw.iso;
    memcpy(facts.serial, raw.serial, sizeof(facts.serial));
    raw_free(&raw);
    struct json *o = err ? NULL : frame_facts_json(&facts);
    char *text = o ? json_text(o) : NULL;
    if (text)
        puts(text);
    json_free(o);
    free(text);
    return err ? err : text ? 0 : -ENOMEM;
}

int main(int argc, char **argv)
{
    char why[120] = "";
    struct lens lens;
    const bool judges = argc == 4 && !strcmp(argv[1], "--judge");
    if ((argc != 2 && !judges) || argv[argc - 1][0] == '-' || (judges && read_lens(&lens, argv[2]))) {
        fprintf(stderr, "usage: rigd-unpack [--judge LENS] FILE: can this raw be unpacked? 0 yes, 1 no, 4 not a raw that is known\n");
        return 2;
    }
    prctl(PR_SET_PDEATHSIG, SIGKILL); // a worker that is gone needs no answer
    alarm(MOST_SECONDS);
#if !defined(__SANITIZE_ADDRESS__) // which maps terabytes
    setrlimit(RLIMIT_AS, &(struct rlimit){ (rlim_t)3 << 30, (rlim_t)3 << 30 });
#endif
    const int err = judges ? judge(argv[3], &lens, why, sizeof(why)) : develop_check(argv[1], why, sizeof(why));
    if (err)
        printf("%s\n", why[0] ? why : "LibRaw ran out of memory");
    return err == -ENOTSUP ? 4 : err ? 1 : 0;
}
