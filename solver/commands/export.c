// solver/commands/export.c - rigsolve export: a solve's folder in the files of other programs.
#include "solver/commands/export.h"
#include "solver/commands/arguments.h"
#include "solver/commands/commands.h"
#include "solver/commands/output.h"
#include "solver/commands/solved.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <argp.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { KEY_MESH = 256, KEY_FORMATS, KEY_THREADS, KEY_JSON };

static const struct argp_option options[] = {
    { "output", 'o', "DIR", 0, "Where the files go (SOLVE_DIR)", 0 },
    { "formats", KEY_FORMATS, "LIST", 0, "Of glb, mtlx, obj, blender, with commas between (all)", 0 },
    { "mesh", KEY_MESH, "FILE", 0, "Instead of the mesh that report.json names", 0 },
    { "threads", KEY_THREADS, "N", 0, "Default: all cores. The result does not depend on it", 0 },
    { "json", KEY_JSON, 0, 0, "Print a summary as JSON", 0 },
    { 0 },
};

struct arguments {
    const char *solve_dir, *output, *mesh;
    unsigned formats;
    int n_threads;
    bool json;
};

static const char *const format_names[] = { "glb", "mtlx", "obj", "blender" };

static unsigned parse_formats(const struct argp_state *state, const char *list)
{
    unsigned formats = 0;
    for (const char *p = list;; p++) {
        const size_t n = strcspn(p, ",");
        int found = -1;
        for (int i = 0; i < 4; i++)
            if (strlen(format_names[i]) == n && !strncmp(p, format_names[i], n))
                found = i;
        if (found < 0)
            argp_error(state, "--formats '%s': '%.*s' is not among glb, mtlx, obj, blender", list, (int)n, p);
        formats |= 1u << found;
        p += n;
        if (!*p)
            return formats;
    }
}

static error_t parse(int key, char *text, struct argp_state *state)
{
    struct arguments *a = state->input;
    switch (key) {
    case 'o':
        a->output = text;
        return 0;
    case KEY_FORMATS:
        a->formats = parse_formats(state, text);
        return 0;
    case KEY_MESH:
        a->mesh = text;
        return 0;
    case KEY_THREADS:
        a->n_threads = (int)argument_integer(state, "--threads", text, 1, 256);
        return 0;
    case KEY_JSON:
        a->json = true;
        return 0;
    case ARGP_KEY_ARG:
        if (a->solve_dir)
            argp_error(state, "one SOLVE_DIR at a time: '%s' is too many", text);
        a->solve_dir = text;
        return 0;
    case ARGP_KEY_END:
        if (!a->solve_dir)
            argp_error(state, "which SOLVE_DIR?");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static const struct argp argp = {
    options,
    parse,
    "SOLVE_DIR [-o DIR]",
    "Write a solved material in the files of other programs.\v"
    "glb: model.glb, glTF 2.0 (metallic-roughness, KHR_materials_specular, _clearcoat, _sheen, _anisotropy). mtlx: model.mtlx, MaterialX "
    "1.38 disney_principled over EXR layers. obj: model.obj, model.mtl with PBR keys. blender: what config/blender/import_studiorig.py "
    "reads. glTF's reflectance is not Disney's: every texel is fitted to it anew, and the "
    "RMSE of that is printed and kept in export.json.",
    0,
    0,
    0,
};

static bool same_folder(const char *a, const char *b)
{
    char *real_a = realpath(a, NULL), *real_b = realpath(b, NULL);
    const bool same = real_a && real_b && !strcmp(real_a, real_b);
    free(real_a);
    free(real_b);
    return same;
}

int export_folder(struct export_summary *out, const char *solve_dir, const char *mesh_path, const char *out_dir, unsigned formats,
                  int n_threads)
{
    struct solved s;
    memset(out, 0, sizeof(*out));
    int err = solved_read(&s, "export", solve_dir, mesh_path);
    if (!err) {
        err = solved_read_lights(&s, solve_dir);
        err = err == -ENOENT ? 0 : err;
    }
    if (!err) {
        const struct export_source source = {
            .mesh = &s.mesh,
            .albedo = &s.albedo,
            .parameters = s.parameters.data ? &s.parameters : NULL,
            .variant = s.variant,
            .lights = s.lights.n ? &s.lights : NULL,
            .in_place = same_folder(solve_dir, out_dir),
            .n_threads = n_threads,
        };
        err = export_write(out, &source, formats, out_dir);
    }
    solved_free(&s);
    return err;
}

static int print_summary(const struct export_summary *s, const struct arguments *a)
{
    const bool fitted = s->formats & (EXPORT_GLB | EXPORT_OBJ);
    if (a->json) {
        struct json *doc = json_object();
        json_set_string(doc, "output", a->output);
        json_set_int(doc, "n_texels", s->n_texels);
        json_set_int(doc, "bytes", s->bytes);
        if (fitted) {
            json_set_number(doc, "rmse_percent", s->rmse_percent);
            json_set_number(doc, "rmse_by_name_percent", s->rmse_by_name_percent);
            json_set_number(doc, "worst_texel_percent", s->worst_percent);
        }
        return output_json("export", doc);
    }
    printf("%s: %d texels, %.1f MB\n", a->output, s->n_texels, 1e-6 * (double)s->bytes);
    if (fitted)
        printf("fitted to glTF's reflectance: RMSE %.3f %% (worst texel %.3f %%); parameters copied by name would give %.3f %%\n",
               s->rmse_percent, s->worst_percent, s->rmse_by_name_percent);
    return output_flush("export");
}

int command_export(int argc, char **argv)
{
    struct arguments a = { .formats = EXPORT_ALL };
    struct export_summary summary;
    argp_parse(&argp, argc, argv, 0, 0, &a);
    if (!a.output)
        a.output = a.solve_dir;
    int err = export_folder(&summary, a.solve_dir, a.mesh, a.output, a.formats, a.n_threads);
    if (!err)
        err = print_summary(&summary, &a);
    if (err == -ENOMEM)
        log_error("export: out of memory");
    return err ? EXIT_FAILED : EXIT_DONE;
}
