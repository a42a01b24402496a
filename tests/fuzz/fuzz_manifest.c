// tests/fuzz/fuzz_manifest.c - hostile ASC MHL on disk: an error, or what it says holds of the files. First byte: where the chain ends.
#include "rigd/digest.h"
#include "rigd/manifest.h"
#include "solver/take/log.h"

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static char dir[80];

static void put(const char *name, const void *bytes, size_t n)
{
    char path[160];
    snprintf(path, sizeof(path), "%s/%s", dir, name);
    FILE *f = fopen(path, "w");
    if (!f)
        abort();
    fwrite(bytes, 1, n, f);
    fclose(f);
}

static void remove_dir(void)
{
    char command[120];
    snprintf(command, sizeof(command), "rm -rf %s", dir);
    if (system(command))
        abort();
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    static const char name[] = "0001_take_2026-11-22_090000Z.mhl";
    struct manifest_findings found;
    char chain[600], c4[DIGEST_C4];
    log_set_level(LOG_SILENT);
    if (!dir[0]) {
        char path[120];
        snprintf(dir, sizeof(dir), "%s/studiorig-test-%d", access("/dev/shm", W_OK) ? "/tmp" : "/dev/shm", (int)getpid());
        snprintf(path, sizeof(path), "%s/ascmhl", dir);
        mkdir(dir, 0700);
        mkdir(path, 0700);
        put("A01.nef", "a frame", 7);
        atexit(remove_dir);
    }
    if (!n)
        return 0;
    const bool own_chain = bytes[0] % 2; // the input is the chain; else it is a generation that the chain vouches for
    digest_c4(bytes + 1, n - 1, c4);
    const int length = snprintf(chain, sizeof(chain), "<ascmhldirectory><hashlist sequencenr=\"1\"><path>%s</path><c4>%s</c4></hashlist></ascmhldirectory>", name, c4);
    if (own_chain)
        put("ascmhl/ascmhl_chain.xml", bytes + 1, n - 1);
    else
        put("ascmhl/ascmhl_chain.xml", chain, (size_t)length);
    put("ascmhl/0001_take_2026-11-22_090000Z.mhl", bytes + 1, n - 1);
    const int err = manifest_verify(dir, &found);
    if (!err && (found.n_missing || found.n_changed || found.n_files + found.n_new < 1))
        abort(); // A01.nef is listed as it is, or it is new
    return 0;
}
