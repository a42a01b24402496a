// tests/fuzz/fuzz_ledger.c - hostile take.json: an error, or a ledger that reads back as it is written and touches nothing outside its take.
#include "rigd/ledger.h"
#include "solver/take/log.h"

#include <dirent.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static char take_dir[80], outside[120];

static void make_take(void)
{
    static const char *const folders[] = { "", "/raw", "/thumbnails", "/linear", "/geometry", "/geometry/cameras" };
    snprintf(take_dir, sizeof(take_dir), "%s/studiorig-test-%d", access("/dev/shm", W_OK) ? "/tmp" : "/dev/shm", (int)getpid());
    snprintf(outside, sizeof(outside), "%s.outside", take_dir);
    for (size_t i = 0; i < sizeof(folders) / sizeof(folders[0]); i++) {
        char path[120];
        snprintf(path, sizeof(path), "%s%s", take_dir, folders[i]);
        mkdir(path, 0700);
    }
}

static void put(const char *path, const char *text)
{
    FILE *f = fopen(path, "w");
    if (!f)
        abort();
    fputs(text, f);
    fclose(f);
}

static void remove_take(void)
{
    char command[200];
    snprintf(command, sizeof(command), "rm -rf %s %s", take_dir, outside);
    if (system(command))
        abort();
}

static void empty_raw(void)
{
    char path[400];
    snprintf(path, sizeof(path), "%s/raw", take_dir);
    DIR *d = opendir(path);
    for (const struct dirent *e; d && (e = readdir(d));) {
        snprintf(path, sizeof(path), "%s/raw/%s", take_dir, e->d_name);
        if (e->d_name[0] != '.')
            unlink(path);
    }
    if (d)
        closedir(d);
}

// Two copies lie there: one is what a seed says, one is not.
static void reconcile(struct ledger *l)
{
    char path[160];
    struct ledger_findings found;
    snprintf(path, sizeof(path), "%s/raw/A01.nef", take_dir);
    put(path, "a frame");
    snprintf(path, sizeof(path), "%s/raw/A02.nef.part", take_dir);
    put(path, "half");
    if (ledger_reconcile(l, take_dir, &found))
        return; // a name that no file can have
    if (!access(path, F_OK))
        abort(); // leftovers go
    for (int i = 0; i < l->n_cameras; i++)
        for (int k = 0; k < l->camera[i].n_objects; k++) {
            const struct ledger_object *o = &l->camera[i].object[k];
            if ((o->state == OBJECT_COPIED || o->state == OBJECT_DELETED) && (strcmp(o->file, "raw/A01.nef") || strcmp(o->xxh128, "56667d32e6b7600610d9b27935f66aab")))
                abort(); // there is no other copy, and it is "a frame"
        }
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    struct ledger l, back;
    struct stat st;
    log_set_level(LOG_SILENT);
    if (!take_dir[0]) {
        make_take();
        put(outside, "mine");
        atexit(remove_take);
    }
    if (ledger_parse(&l, (const char *)bytes, n, "f")) {
        if (l.camera || l.n_cameras)
            abort();
        return 0;
    }
    ledger_is_whole(&l);
    char *text = ledger_text(&l);
    if (text) { // else a string in it is no UTF-8
        if (ledger_parse(&back, text, strlen(text), "f"))
            abort();
        char *again = ledger_text(&back);
        if (!again || strcmp(text, again))
            abort();
        free(again);
        ledger_free(&back);
    }
    free(text);
    for (int i = 0; i < l.n_cameras; i++) {
        struct camera_object o = { "/store_00010001/DCIM/100NIKON", "DSC_0002.NEF", 7 };
        struct ledger_object *added = ledger_owns(&l.camera[i], &o) && !ledger_find(&l.camera[i], &o) ? ledger_add(&l.camera[i], &o) : NULL;
        for (int k = 0; added && k + 1 < l.camera[i].n_objects; k++)
            if (!strcmp(l.camera[i].object[k].file, added->file))
                abort(); // one name, one frame
    }
    reconcile(&l);
    empty_raw();
    if (stat(outside, &st) || st.st_size != 4)
        abort();
    ledger_free(&l);
    return 0;
}
