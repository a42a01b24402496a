// solver/stage1.h - stage 1 as a least-squares problem: E_photo + w_sim E_sim (Eqs. 6, 11, 12) over theta, c, R and the
// distances, minimised by lm.h. Shared by the methods of joint.h and by relocate.h. They differ in what they
// make free, in the samples they weigh (p.weight, p.use_view, p.texel_step may be changed between two calls) and in the order of calls.
#pragma once
#include "solver/emitters.h"
#include "solver/joint.h"
#include "solver/visibility.h"

struct stage1 {
    const struct joint_settings *set;
    struct photometric p;
    struct photometric_layout layout;
    struct photometric_state base, trial; // where the search stands, and what it tries
    struct neighbour_pair *pairs;         // of E_sim
    int n_pairs;
    double (*group_dir)[3];               // [groups] energy-weighted, in the probe frame
    struct emitters emitters;             // planes that hold groups together, with w_plane beside the mean of squares
    double w_plane, *plane_scale;         // [groups] 1/r that deviations are relative to
    float *ratio;                         // [lights] of p.ratio_of_light
    bool in_distance;         // the unknown is r, not 1/r, and E_sim is Eq. 11 to the letter (paper)
    double w_sim;             // beside the mean of squares
    double w_sim_sum;         // alternating: the same beside the sum, of the samples that are fitted
    double first_centre_m[3]; // joint: the centre is held near its first guess with the same weight, which ends at (nearly) 0
    double n_residuals;       // samples x 3 in use
    unsigned char *is_free;   // [layout.n]
    double *x, *lower, *upper;
    struct light_visibility visibility;
    const struct rays *rays;
    int n_jacobians, n_sweep_jacobians, n_evaluations;
    const char *stop;         // why the last minimise stopped
};

// s is zeroed first; free it even when this fails. 0 or -ENOMEM.
int stage1_new(struct stage1 *s, const struct photometric *p, const struct lights *lights, const struct rays *rays,
               const struct joint_settings *set);
void stage1_free(struct stage1 *s);

void stage1_set_distances(struct stage1 *s, double distance_m); // of all lights; 0: infinite
// Holds the lights of each plane on it (tilt and all: finer lights of one group follow the plane) by w_plane; takes over e (zeroed after).
// Planes of an earlier call are forgotten; e->n = 0: none.
void stage1_set_planes(struct stage1 *s, struct emitters *e, double w_plane);
// Lights of one group keep the ratio of their distances that they have now (a group with a light at infinity: all alike).
void stage1_keep_ratios(struct stage1 *s);
// Traces shadows when settings ask for them; later calls only the lights that have moved by more than .5 degrees.
int stage1_trace_visibility(struct stage1 *s);
// From base to base. cost may be NULL. 0 or -errno.
int stage1_minimise(struct stage1 *s, int max_iterations, double relative_cost, double *cost);
// What is known of the unknowns before any picture, as a precision added to P [n][n] (lower triangle): rooms (E_sim of log 1/r where a wall
// seen at 45 degrees has a deviation of 1), planes where set, the centre's first guess, the cameras' gains.
void stage1_add_prior(const struct stage1 *s, double *P);
// The error of `use_view` under `state`, over the texels that the views in s->p saw: others have no albedo to be judged.
int stage1_measure(const struct stage1 *s, const struct photometric_state *state, const uint8_t *use_view,
                   struct photometric_error *e);
// The texel step that leaves about n_samples; odd, so as not to fall in step with the texture's rows.
int stage1_step_for(const struct stage1 *s, int64_t n_samples);

// Of what is found (joint.c): standard deviations, misfit and objective at base over the views in s->p, albedo solved; inverse_distance_std has room for
// s->p.n_groups. Then why that is to be doubted, but for what only the search knows: bits are added.
int stage1_uncertainty(struct stage1 *s, struct joint_result *out);
void stage1_doubt(const struct stage1 *s, struct joint_result *out, int n_fit_views);

// The paper's alternation (alternating.c). fit[n_views]: 1 = fitted.
int stage1_alternate(struct stage1 *s, const uint8_t *fit);
