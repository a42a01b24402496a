// tests/bench/raws.c - raws N WIDTHxHEIGHT FOLDER: N frames of the simulated rig (bodies A01, A02, ...), for measuring what develops them.
// raws WIDTHxHEIGHT FOLDER SCENE [KEY=VALUE...]: of each linear EXR of the folder SCENE one frame of its name, as rigsim's Nikons make it at
// their reference exposure; KEY=VALUE changes their personality.
#include "solver/take/log.h"
#include "tests/rigsim/frame.h"

#include <dirent.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { BODIES_MAX = 1000 };

static struct dirent **pictures;

static const char *any_name(unsigned camera)
{
    (void)camera;
    return "any";
}

static int is_exr(const struct dirent *e)
{
    const size_t n = strlen(e->d_name);
    return n > 4 && !strcmp(e->d_name + n - 4, ".exr");
}

static int write_raw(struct scene *scene, const struct personality *p, unsigned camera, const char *folder)
{
    enum { PIECE = 1 << 20 };
    static uint8_t piece[PIECE];
    char path[4096];
    struct body b;
    struct frame *f = NULL;
    const struct exposure e = { .shot = 1, .utc_ns = 1700000000000000000, .time_s = p->t_ref_s, .f_number = p->n_ref, .iso = 100 };
    if (pictures)
        snprintf(path, sizeof(path), "%s/%.*s.dng", folder, (int)strlen(pictures[camera]->d_name) - 4, pictures[camera]->d_name);
    else
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
    const char *views = NULL;
    if (argc == 4 && !strchr(argv[1], 'x')) { // N first
        sscanf(argv[1], "%d", &n);
        argv++;
    } else if (argc >= 4) {
        views = argv[3];
        n = scandir(views, &pictures, is_exr, alphasort);
    }
    if (argc < 4 || sscanf(argv[1], "%dx%d", &width, &height) != 2 || n < 1 || n > BODIES_MAX) {
        fprintf(stderr, "usage: raws N WIDTHxHEIGHT FOLDER\n       raws WIDTHxHEIGHT FOLDER SCENE [KEY=VALUE...]\n");
        return 2;
    }
    int err = personality_load(&p, views ? "nikon" : "generic");
    for (int i = 4; views && i < argc && !err; i++)
        err = personality_statement(&p, argv[i], "command line", i);
    if (err || scene_open(&scene, views, width, height, (unsigned)n, any_name))
        return 1;
    for (int i = 0; i < n && !err; i++)
        err = write_raw(scene, &p, (unsigned)i, argv[2]);
    scene_close(scene);
    for (int i = 0; pictures && i < n; i++)
        free(pictures[i]);
    free(pictures);
    return err;
}
