// solver/commands/export.h - what `rigsolve export` does, for `rigsolve solve` to do at its end.
#pragma once
#include "solver/export.h"

// SOLVE_DIR in the files of other programs (export.h), written to out_dir, which may be SOLVE_DIR itself. mesh_path NULL: the mesh
// that report.json names. 0, or -errno, logged but for -ENOMEM.
int export_folder(struct export_summary *out, const char *solve_dir, const char *mesh_path, const char *out_dir, unsigned formats,
                  int n_threads);
