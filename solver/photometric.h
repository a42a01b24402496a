// solver/photometric.h - E_photo (Eq. 6) of a set-up, one shared reflectance and per-texel albedo; its normal equations, with the albedo
// eliminated where it is free.
//
// The unknowns, in this order (struct photometric_layout): theta[10], centre (3, metres), rotation (3, local: R = exp([w]x) R), albedo
// (3, shared by all texels), log gain per view, inverse distance per group of lights. Radiance is affine in a texel's albedo when the tint is
// held: o = constant + own * albedo; so each texel and channel has a closed form, and one rank-one projection removes it from the normal
// equations (variable projection, Kaufman 1975; SOLVER.md 4).
#pragma once
#include "solver/kernels/kernels.h"
#include "solver/samples.h"

enum albedo_mode {
    ALBEDO_FREE,   // one colour per texel, eliminated
    ALBEDO_GIVEN,  // one colour per texel, as it is in the state
    ALBEDO_SHARED, // one unknown colour for all
};

// Lights in the kernel may be finer than the unknown distances: light i's 1/r is that of its group times its ratio.
struct photometric_layout {
    int n;                 // unknowns in all
    int theta, centre, rotation, albedo, gain, inverse_distance; // where each begins
    int n_views, n_groups;
};
struct photometric_layout photometric_layout_of(int n_views, int n_groups);

struct photometric {
    const struct texels *texels;
    const struct samples *samples;
    enum reflectance model;
    enum disney_variant variant;
    enum albedo_mode albedo;
    const int32_t *group_of_light;  // [lights n]
    const float *ratio_of_light;    // [lights n] a light's 1/r over its group's (a tilted panel); NULL: 1
    int n_groups;
    const uint8_t *use_view;        // [n_views] 0: left out; NULL: all
    int texel_step;                 // only every so many texels (1: all): a coarse look costs less
    const uint8_t *use_texel;       // [n_texels] 0: left out; NULL: all
    const float *weight;            // [samples n], or NULL: 1
    const float (*theta_of_texel)[DISNEY_N]; // [n_texels] in place of the state's theta, which then must not be free; NULL: one for all
    const uint16_t *visible;        // [n_texels][words], or NULL: everything
    int words_per_texel;
    const float (*indirect)[3];     // [n_texels] irradiance that other surfaces send (interreflection.h), or NULL
    int n_threads;
};

struct photometric_state {
    struct lights lights;      // directions, irradiances and the set-up (owned)
    double theta[DISNEY_N];
    double shared_albedo[3];
    float (*albedo)[3];        // [n_texels] (owned): result of the last elimination, and the tint's colour in the next
    double *log_gain;          // [n_views] (owned)
};
// Copies lights. albedo .5, theta .5, gains 0. 0 or -ENOMEM.
int photometric_state_new(struct photometric_state *out, const struct photometric *p, const struct lights *lights);
void photometric_state_free(struct photometric_state *s);
void photometric_state_copy(const struct photometric *p, struct photometric_state *to,
                            const struct photometric_state *from); // both made for p

// Unknowns <-> state. Packing writes w = 0; unpacking multiplies R by exp([w]x).
void photometric_pack(const struct photometric *p, const struct photometric_state *s, double *x);
void photometric_unpack(const struct photometric *p, struct photometric_state *s, const double *x);

struct photometric_error {
    double cost;          // 1/2 sum of weight |L - o|^2 (three channels), one-sided where clipped
    double squares;       // sum of |clip(L) - clip(o)|^2, clip to [0,1], not weighted: for the RMSE of SOLVER.md 5
    int64_t n;            // samples
};
double photometric_rmse_percent(const struct photometric_error *e);

// Solves the free albedo at this state (into s->albedo, clamped to [0, 1.5]; texels without samples keep theirs) when fit is true, and measures.
// With fit false the albedo stays as it is: for views that were held out (a `photometric` with the other use_view). 0 or -ENOMEM.
int photometric_evaluate(const struct photometric *p, struct photometric_state *s, bool fit,
                         struct photometric_error *error);

// Adds to A (n x n, lower triangle) and g, at the state with its albedo (evaluate first). Columns of unknowns with free[i] = 0 are left 0. 0 or -ENOMEM.
int photometric_normal_equations(const struct photometric *p, const struct photometric_state *s,
                                 const unsigned char *is_free, double *A, double *g);

// L - o of every sample into residual[samples n], with the albedo as it is; NAN: not in use; 0: clipped, and the model is brighter still. 0 or -ENOMEM.
int photometric_residuals(const struct photometric *p, const struct photometric_state *s, float (*residual)[3]);

// The weighted residuals' own scale: median of |L - o| over channels and samples in use, times 1.4826. 0 or -ENOMEM.
int photometric_scale(const struct photometric *p, const struct photometric_state *s, double *sigma);
// Robust weights (Geman-McClure) for residuals r = max over channels |L - o| at scale `sigma`, times `base` (NULL: 1) into weight[samples n].
int photometric_robust_weights(const struct photometric *p, const struct photometric_state *s, double sigma,
                               const float *base, float *weight);
