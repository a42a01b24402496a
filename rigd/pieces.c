// rigd/pieces.c - what take_open finds.
#include "rigd/pieces.h"
#include "solver/take/take.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>

static int keep(char out[800], const char *path)
{
    return path && snprintf(out, 800, "%s", path) >= 800 ? -ENAMETOOLONG : 0;
}

int pieces_find(struct pieces *out, const char *take_dir)
{
    struct take *take = NULL;
    memset(out, 0, sizeof(*out));
    int err = take_open(&take, take_dir);
    if (err)
        return err;
    out->n_views = take->n_views;
    if (keep(out->mesh, take->mesh_path) || keep(out->cameras, take->cameras_path) || keep(out->panorama, take->panorama_path) || keep(out->start, take->start_path))
        err = -ENAMETOOLONG;
    take_close(take);
    return err;
}
