// tests/bench/raws.c - raws N WIDTHxHEIGHT FOLDER: N frames of the simulated rig (bodies A01, A02, ...), for measuring what develops them.
#include "solver/take/log.h"
#include "tests/rigsim/frame.h"

#include <stdio.h>
#include <stdlib.h>

static const char *any_name(unsigned camera)
{
    (void)camera;
    return "any";
}

static int write_raw(struct scene *scene, const struct personality *p, unsigned camera, const char *folder)
{
    enum { PIECE = 1 << 20 };
    static uint8_t piece[PIECE];
    char path[4096];
    struct body b;
    struct frame *f = NULL;
    const struct exposure e = { .shot = 1, .utc_ns = 1700000000000000000, .time_s = p->t_ref_s, .f_number = p->n_ref, .iso = 100 };
    snprintf(path, sizeof(path), "%s/A%02u.dng", folder, camera + 1);
    FILE *out = fopen(path, "wb");
    int err = !out || body_init(&b, p, camera, 1, 0, 0);
    if (!err) {
        err = frame_open(&f, scene, &b, &e, FILES_RAW);
        for (uint64_t at = 0; !err && at < frame_size(f); at += PIECE) {
            const size_t n = frame_size(f) - at < PIECE ? (size_t)(frame_size(f) - at) : PIECE;
            frame_read(f, at, piece, n);
            err = fwrite(piece, 1, n, out) != n;
        }
        frame_close(f);
        body_free(&b);
    }
    if (out && fclose(out))
        err = 1;
    if (err)
        log_error("bench: cannot write %s", path);
    return err;
}

int main(int argc, char **argv)
{
    int n = 0, width = 0, height = 0;
    static struct personality p;
    struct scene *scene;
    if (argc != 4 || sscanf(argv[1], "%d", &n) != 1 || sscanf(argv[2], "%dx%d", &width, &height) != 2 || n < 1 || n > 1000) {
        fprintf(stderr, "usage: raws N WIDTHxHEIGHT FOLDER\n");
        return 2;
    }
    if (personality_load(&p, "generic") || scene_open(&scene, NULL, width, height, (unsigned)n, any_name))
        return 1;
    int err = 0;
    for (int i = 0; i < n && !err; i++)
        err = write_raw(scene, &p, (unsigned)i, argv[3]);
    scene_close(scene);
    return err;
}
