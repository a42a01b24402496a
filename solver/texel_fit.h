// solver/texel_fit.h - one texel's samples against a reflectance: how wrong it is, which albedo is best, and the normal equations
// of theta with the albedo eliminated (SOLVER.md 4).
//
// What stage 2 is made of: levels, regions and single texels all sum these. One call of a kernel per texel for all its views. Radiance is
// affine in the albedo at a given tint, and the tint is that of the albedo that came in: so the albedo has a closed form, and one
// rank-one projection per channel takes it out of J^T W J (variable projection, Kaufman 1975).
#pragma once
#include "solver/kernels/kernels.h"
#include "solver/samples.h"

enum { THETA_PACKED = DISNEY_N * (DISNEY_N + 1) / 2, TEXEL_VIEWS_MAX = 1024 };

struct texel_scene {
    const struct texels *texels;
    const struct samples *samples;
    struct light_arrays lights;   // owned by who made it
    const struct kernels *kernels;
    enum disney_variant variant;
    const uint16_t *visible;      // [n_texels][words_per_texel], or NULL: every light reaches every texel above its horizon
    int words_per_texel;
    const uint8_t *soft;          // [n_texels][lights.n] visible share x 255, in place of visible; or NULL
    const float *gain;            // [n_views] exposure factors, or NULL: 1
    const float (*indirect)[3];   // [n_texels] irradiance that other surfaces send, or NULL
    const uint8_t *use_view;      // [n_views] 0: left out
    bool free_albedo;             // false: it stays as it is
    bool weigh_grazing;           // samples count less where the view grazes: min(1, 2 <n,v>)
    double robust_scale;          // |L - o| beyond which a sample pulls no harder (Charbonnier); 0: least squares
};

struct texel_worker; // scratch of one thread
int texel_worker_new(struct texel_worker **out, const struct texel_scene *s); // 0 or -ENOMEM
void texel_worker_free(struct texel_worker *w);                               // NULL allowed

// 1/2 sum of weight |L - o|^2 over the samples in use, its gradient and Gauss-Newton matrix by theta.
struct texel_sums {
    double cost;
    double left_out_cost;      // the same of every sample under the albedo that the others would have
    double distance;           // sum of |L - o|
    int n;                     // samples
    double H[THETA_PACKED], g[DISNEY_N];
    double own2[3];            // sum of weight (dL/d albedo)^2 per channel: what is known of the albedo
};
// most_views: of more, so many are taken, evenly spread; 0: all. albedo: in, and out (where free; where nothing says, it stays). A texel without samples, or
// without light, gives zeros. Adds `scale` times the sums.
void texel_fit(const struct texel_scene *s, struct texel_worker *w, int texel, int most_views, const float theta[DISNEY_N],
               float albedo[3], double scale, struct texel_sums *out);
// The same where theta stays as it is: only the albedo, the costs, distance and n.
void texel_fit_albedo(const struct texel_scene *s, struct texel_worker *w, int texel, int most_views, const float theta[DISNEY_N],
                      float albedo[3], double scale, struct texel_sums *out);
// The same cost at a fixed albedo, without derivatives; and for the RMSE of SOLVER.md 5 the sum of |clip(L) - clip(o)|^2, clip to [0,1].
struct texel_error {
    double cost, squares;
    int64_t n;
};
void texel_measure(const struct texel_scene *s, struct texel_worker *w, int texel, const float theta[DISNEY_N],
                   const float albedo[3], struct texel_error *out); // adds
// Rows of the full problem (theta, then albedo with its tint): J (13 per row) and residuals of up to 3 x TEXEL_VIEWS_MAX rows, weighted, with the
// view of each. Returns how many rows. The arrays are the worker's, valid until its next use.
struct texel_row {
    float J[DISNEY_N + 3], residual;
    int view;
};
int texel_rows(const struct texel_scene *s, struct texel_worker *w, int texel, const float theta[DISNEY_N],
               const float albedo[3], const struct texel_row **rows);
