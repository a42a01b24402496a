// solver/materials.h - stage 2: the lights are known; per texel ten Disney parameters and the albedo (SOLVER.md 3.3, 4).
//
// E = E_photo + w_reg E_reg (Eqs. 13, 14) over a pyramid of textures, 1 x 1 first: Levenberg-Marquardt with a damping per texel, steps by
// conjugate gradients (pcg.h) with inverse 10 x 10 blocks, tile by tile so that memory does not grow with the texture; albedo
// eliminated (texel_fit.h). Two ways:
//
//   paper  plain ten-parameter fit: given albedo, every light reaches every texel, a coarse texel weighs as all its samples
//   ours   (default) albedo eliminated, shadows, every level also drawn towards its parent, Charbonnier weights, and one model per region
//          (regions.h): no more parameters free per texel than the pictures can tell
#pragma once
#include "solver/levels.h"
#include "solver/lights.h"
#include "solver/rays.h"
#include "solver/regions.h"
#include "solver/samples.h"

struct materials_settings {
    enum disney_variant variant;
    bool free_albedo;    // eliminate the albedo; false: it stays as it is given
    double w_reg;        // Eq. 13 beside the sum of squares: each ordered pair of neighbours once
    double w_parent;     // draws a texel towards its parent, beside the sum of squares; 0: not
    bool seams;          // neighbours across seams
    bool whole_weight;   // a coarse texel weighs as all the samples beneath it, not as those it looks at
    bool weigh_grazing, robust;
    bool selection;      // model selection per region
    int cap;             // samples a coarse texel looks at, about
    int n_bounces;       // of diffuse interreflection, gathered anew under each of three estimates of the albedo; 0: none
    int most_size;       // levels finer than this are left out: texels inherit theta (0: none is); the albedo is every texel's own
    bool look;           // a look on the way: nothing is judged, std, validity and coverage stay NULL
    int n_threads;
};
struct materials_settings materials_defaults(void); // ours
struct materials_settings materials_paper(void);

struct materials_input {
    const struct texels *texels;
    const struct samples *samples;
    const struct lights *lights;
    const uint16_t *visible;        // [n_texels][words_per_texel], or NULL
    int words_per_texel;
    const uint8_t *soft;            // [n_texels][lights->n] visible share x 255, in place of visible; or NULL
    const double *log_gain;         // [n_views], or NULL
    const double *inverse_distance_std; // [distances of the lights: lights_number_distances] 1/m, and of the centre: what stage 1 does not
    double centre_std_m[3];         // know of the lights is not known of the albedo either; or NULL, 0: they are known
    const uint8_t *hold_out;        // [n_views] 1: never fitted, only reported; or NULL
    const struct rays *rays;        // for n_bounces; else NULL
    const struct mesh *mesh;
    double start_theta[DISNEY_N];
    const float (*start_albedo)[3]; // [n_texels], or NULL: .5
};

enum materials_validity {
    MATERIAL_UNOBSERVED = 0, // no view saw it, or no light reached it: filled from its neighbours
    MATERIAL_WEAK = 1,       // fewer than 8 samples: mostly its neighbourhood's
    MATERIAL_VALID = 2,
};

struct materials_level {
    int size, n_texels, n_iterations, n_pcg;
    int64_t n_shaded;       // kernel calls x views
    double objective;       // per sample
};

struct materials {
    int n_texels;
    float (*albedo)[3];         // [n_texels]
    float (*theta)[DISNEY_N];   // [n_texels]
    float (*std)[DISNEY_N + 3]; // [n_texels] theta, then albedo; infinite: nothing depends on it
    uint8_t *validity;          // [n_texels] enum materials_validity
    uint16_t *coverage;         // [n_texels] samples that were fitted
    uint8_t *region;            // [n_texels]
    float (*indirect)[3];       // [n_texels] irradiance from the object itself; NULL without bounces
    struct regions regions;
    int n_levels;
    struct materials_level level[20];
    double rmse_fit_percent, rmse_held_out_percent; // -1: no view held out
    int64_t n_fit, n_held_out;
    double most_directional_albedo; // largest found among the materials; above 1 they make light
};

// 0, -EINVAL (no sample in use: logged), -ENOMEM. Same bytes for any thread count.
int materials_solve(struct materials *out, const struct materials_input *input, const struct materials_settings *settings);
void materials_free(struct materials *m); // leaves it zeroed

// Whether some material sends back more light than it gets, by more than this look at it is wrong by.
static inline bool materials_make_light(const struct materials *m)
{
    return m->most_directional_albedo > 1.02;
}

// Directional albedo (share of the light from one direction that leaves again) of a material, its largest over views and channels.
double materials_directional_albedo(const float theta[DISNEY_N], const float albedo[3], enum disney_variant variant);
