// solver/commands/solve_materials.h - stage 2 of `rigsolve solve`: its options, its run, its files and its part of the report.
#pragma once
#include "solver/commands/inputs.h"
#include "solver/joint.h"
#include "solver/materials.h"

struct solve_materials {
    int last_stage;          // --stage: 1 stops after the lights
    const char *lights_from; // --lights-from: a solve's folder or a lights.json; NULL: stage 1 finds them
    double w_reg, w_parent;  // negative: the method's own
    int n_bounces, n_relocations, most_size, n_lights;
    bool no_seams, no_selection, no_visibility;
};
extern const struct argp solve_materials_argp; // child of solve's; its input is a struct solve_materials

// In place of stage 1: lights, theta (of a report.json beside them, else .5) and albedo (of the darkest samples) into a result that
// materials_stage() takes. lights: their directions and irradiances replace it. 0 or -errno, logged but for -ENOMEM.
int solve_read_lights(struct joint_result *out, struct lights *lights, const struct solve_materials *set, const struct inputs *in,
                      const struct samples *samples, const uint8_t *held_out, enum method method, int n_threads);

// Stage 2 from what stage 1 found; with n_relocations > 0 and n_groups of lights, the lights of stage1 once more under the materials, so often as that pays,
// and what is to be doubted about them. Where something is glossy, `lights` and those of stage1 become finer, each in its group.
int solve_find_materials(struct materials *out, const struct solve_materials *set, struct joint_result *stage1, struct lights *lights,
                         const struct joint_settings *joint, const struct inputs *in, const struct samples *samples, const uint8_t *held_out,
                         int n_threads);
// albedo.exr, brdf.exr, std.exr (ten parameters, then albedo_R, albedo_G, albedo_B; infinite: nothing depends on it) and validity.exr (Y: 1 measured, .5 weak, 0
// filled from neighbours; coverage: samples; region) into dir. 0 or -errno.
int solve_write_materials(const struct materials *m, const struct texels *t, const char *dir);
// What the report has to warn of. warnings: its array.
void solve_warn_of_materials(struct json *warnings, const struct materials *m);
// The report's "stages.materials", and its RMSE over stage 1's.
void solve_report_materials(struct json *report, struct json *stages, const struct materials *m, double wall_s);
void solve_print_materials(const struct materials *m);
