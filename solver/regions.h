// solver/regions.h - which texels share a material, and how many of its parameters each texel may have for itself.
//
// "Model no more than the scene needs": texels are dealt out to a few shared reflectances, each to the one that explains its samples
// best (albedo eliminated); regions that do as well under one reflectance become one. Then a parameter is set free per texel only where its
// posterior standard deviation is below .15 and views set aside are explained better; and what the region can do without (clearcoat, sheen,
// anisotropy, ...: views set aside are explained as well) is frozen at its plain value, 0.
#pragma once
#include "solver/levels.h"
#include "solver/texel_fit.h"

enum { REGIONS_MAX = 8 };
enum parameter_freedom { PARAMETER_FROZEN, PARAMETER_TIED, PARAMETER_FREE };
extern const char *const parameter_freedom_names[3]; // "frozen", "tied", "free"

struct region {
    float theta[DISNEY_N];        // of all its texels; of a free parameter: where texels begin
    float std[DISNEY_N];          // of theta as the region's: noise, and what the model lacks (regions.c); infinite: the pictures do not say, or frozen
    double covariance[THETA_PACKED]; // as if nothing were frozen
    enum parameter_freedom freedom[DISNEY_N];
    int n_texels;
    double aside_rmse_percent;    // of views set aside, by the region's own reflectance
};
struct regions {
    int n;                        // 0: not selected, every parameter is free
    struct region region[REGIONS_MAX];
};

// level: the one whose texels are dealt out, with theta[level n] and the albedo of its delegates (albedo[texels n], refined).
// region_of[level n] out. use_view of the scene: those that may be fitted. 0 or -ENOMEM.
int regions_find(struct regions *out, uint8_t *region_of, const struct texel_scene *scene, const struct level *level,
                 const float (*theta)[DISNEY_N], float (*albedo)[3], int n_threads);

// A finer level inherits; texels at borders choose again between their neighbours' regions.
int regions_refine(const struct regions *r, uint8_t *region_of, const uint8_t *parent_region_of, const struct texel_scene *scene,
                   const struct level *level, const float (*albedo)[3], int n_threads);
