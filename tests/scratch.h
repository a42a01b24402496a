// tests/scratch.h - one fresh folder for the files of a test program, under $TMPDIR or /tmp.
#pragma once
#include <dirent.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>
#include <cmocka.h>

static char scratch_dir[512];

static inline int scratch_open(void)
{
    const char *tmp = getenv("TMPDIR");
    snprintf(scratch_dir, sizeof(scratch_dir), "%s/studiorig-test-XXXXXX", tmp ? tmp : "/tmp");
    return mkdtemp(scratch_dir) ? 0 : -1;
}

// Good until the fourth call from here.
static inline const char *scratch_path(const char *name)
{
    static char paths[4][800];
    static int next;
    char *path = paths[next++ & 3];
    snprintf(path, sizeof(paths[0]), "%s/%s", scratch_dir, name);
    return path;
}

static inline void scratch_write(const char *name, const void *bytes, size_t n)
{
    FILE *f = fopen(scratch_path(name), "wb");
    assert_non_null(f);
    assert_int_equal(fwrite(bytes, 1, n, f), n);
    assert_int_equal(fclose(f), 0);
}

// Removes every file but hidden ones: those are what a writer left behind.
static inline void scratch_empty(void)
{
    DIR *d = opendir(scratch_dir);
    assert_non_null(d);
    for (struct dirent *e; (e = readdir(d));)
        if (e->d_name[0] != '.')
            unlink(scratch_path(e->d_name));
    closedir(d);
}

// Fails if a test or a writer left something behind.
static inline int scratch_close(void)
{
    return rmdir(scratch_dir);
}
