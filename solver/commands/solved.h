// solver/commands/solved.h - a solve's folder, loaded: what render, export and report begin with.
//
// SOLVE_DIR holds albedo.exr, brdf.exr (absent: Lambertian), lights.json and report.json, which names the mesh (inputs.mesh, relative
// to SOLVE_DIR or absolute). A synthetic studio's truth/ is such a folder too.
#pragma once
#include "solver/disney.h"
#include "solver/lights.h"
#include "solver/mesh.h"
#include "solver/take/image.h"
#include "solver/take/json.h"

struct solved {
    struct json *report; // NULL: none
    struct mesh mesh;
    struct image albedo, parameters; // parameters.data NULL: Lambertian
    enum disney_variant variant;
    struct lights lights; // n = 0 until solved_read_lights()
};

// mesh_path NULL: the report's. command: for messages. 0, or -errno, logged but for -ENOMEM; solved_free() in either case.
int solved_read(struct solved *out, const char *command, const char *dir, const char *mesh_path);
int solved_read_lights(struct solved *s, const char *dir); // dir/lights.json; -ENOENT (not logged) where there is none
void solved_free(struct solved *s);                        // leaves it zeroed

// dir/name, or name where it begins with '/', malloc'd; NULL without memory.
char *solved_path(const char *dir, const char *name);
