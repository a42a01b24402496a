// solver/joint.h - stage 1: from what the cameras measured and one roughly aligned panorama to the set-up of the lights (c, R, every
// distance), one shared reflectance and per-texel albedo. Three methods behind one interface:
//
//   METHOD_DIRECTIONAL  all lights at infinity; the baseline
//   METHOD_ALTERNATING  the paper: albedo from dark samples and (theta, c, R, r_i) from bright ones in turn, fixed w_sim (Eqs. 8-12)
//   METHOD_JOINT        ours: albedo eliminated, 1/r, a coarse sweep for the start, continuation in w_sim stopped by views set aside
//                       (SOLVER.md 4)
#pragma once
#include "solver/misfit.h"
#include "solver/photometric.h"
#include "solver/rays.h"

enum method { METHOD_JOINT, METHOD_ALTERNATING, METHOD_DIRECTIONAL };
extern const char *const method_names[3]; // "joint", "alternating", "directional"

struct joint_settings {
    enum method method;
    enum reflectance model;
    enum disney_variant variant;
    enum albedo_mode albedo;
    double given_albedo[3];  // ALBEDO_GIVEN
    double start_distance_m; // of every light; 0: swept over .7 .. 4 m (joint); each light's own, 2 m where it has none (alternating)
    double w_sim;            // weight of Eq. 11 beside the *mean* of squared residuals. alternating: 3e-9 (default), held. joint: the last
                             // weight of the continuation; negative: stopped by the views set aside (default)
    bool visibility;         // trace shadows, and again when lights have moved
    bool continuation;       // joint: w_sim falls by decades; without, the search begins at w_sim itself
    bool planes;             // joint: lights that lie on one plane, if the views set aside accept it, stay on it
    bool robust;             // down-weight outliers in the last stage
    bool gain;               // one unknown exposure factor per camera (prior 2 %)
    int coarse_samples;      // joint: about so many in the sweep and the continuation (30,000): few are enough to follow the valley
    int fine_samples;        // about so many to tell one weight from the next, and for the last word (200,000)
    int n_threads;
};
struct joint_settings joint_defaults(enum method method);

enum joint_doubt { // why an answer is not to be trusted; bits
    DOUBT_NO_INFORMATION = 1, // diffuse with free albedo: nothing says how far the lights are; solved as directional
    DOUBT_FEW_VIEWS = 2,      // fewer than 3 views see the object
    DOUBT_MIRRORED = 4,       // the mirrored panorama explains the pictures better
    DOUBT_UNCERTAIN = 8,      // the standard deviation of the centre is above 10 cm, or the distances' mean above 15 %
    DOUBT_POOR_FIT = 16,      // what is left of the pictures has structure (misfit.h): a light is missing, or something moved
};
const char *joint_doubt_text(unsigned one_bit);

struct joint_result {
    struct photometric_state state; // owned
    double rmse_fit_percent, rmse_held_out_percent; // samples; -1: no view held out
    int64_t n_fit, n_held_out;
    int n_jacobians, n_evaluations;
    int n_sweep_jacobians;           // of n_jacobians: of the sweep's 17 unknowns, at few texels
    double w_sim;                    // the last one, our normalisation (mean); w_sim_sum: beside the sum
    double w_sim_sum;
    const char *stop_reason;
    // Standard deviations (misfit_deviations); infinite where nothing depends on an unknown.
    double theta_std[DISNEY_N], centre_std_m[3], rotation_std_rad[3];
    int n_distances;
    double *inverse_distance_std;    // [n_distances] 1/m; owned
    double distance_std_relative;    // mean over the lights
    double inflation;                // of the distances' variances over independent samples
    struct misfit misfit;            // what is left of the pictures
    double objective;                // mean squared residual of the fit
    unsigned doubts;                 // 0: trusted
};

// lights: from the panorama, with the rough set-up (centre, rotation) in it; lights->group says which share a distance
// (lights_number_distances). hold_out[n_views]: 1 = never fitted, only reported. rays may be NULL (no visibility). Progress through progress.h. 0, -EINVAL (logged), -ENOMEM.
int joint_solve(struct joint_result *out, const struct texels *texels, const struct samples *samples,
                const struct rays *rays, const struct lights *lights, const uint8_t *hold_out,
                const struct joint_settings *settings);
void joint_result_free(struct joint_result *r);
