// solver/gltf_brdf.h - the reflectance that a glTF 2.0 viewer shades with, and the Disney material's nearest relative in it.
//
// Written from the public specification: appendix B's metallic-roughness model with KHR_materials_specular, _clearcoat, _sheen
// (Charlie, albedo scaling) and _anisotropy, index of refraction 1.5. As in disney.h, f has no cosine inside, directions are unit
// and point away from the surface, and f is 0 below the horizon.
#pragma once
#include "solver/disney.h"

struct gltf_material {
    double base_color[3], metallic, roughness; // linear
    double specular, specular_color[3];        // specular_color may exceed 1: f0 = .04 specular_color, at most 1
    double clearcoat, clearcoat_roughness;
    double sheen_color[3], sheen_roughness;
    double anisotropy; // strength, along frame->x
};

struct gltf_brdf; // tables; immutable after gltf_brdf_new(), every query may be called from any thread
int gltf_brdf_new(struct gltf_brdf **out); // 0 or -ENOMEM
void gltf_brdf_free(struct gltf_brdf *b);  // NULL allowed

void gltf_brdf_eval(const struct gltf_brdf *b, const struct gltf_material *m, const struct disney_frame *frame,
                    const double l[3], const double v[3], double f[3]);

// The obvious mapping, name by name: metallic, roughness, base colour as they are, clearcoat roughness 1 - gloss, and so on.
void gltf_from_disney_by_name(struct gltf_material *out, const struct disney *m);

// Re-fitted over GLTF_N_PAIRS fixed pairs of directions. F0 and both alphas are kept exactly where glTF can hold them; the coat comes
// from a table over gloss, sheen is scaled by its least squares, and the base colour is the least-squares answer that makes up for
// the different diffuse lobe while the specular colour keeps F0. error: 3 squared differences summed over pairs and channels of
// what a white light of irradiance pi shows, pi f <n,l>, clipped to [0,1] as pictures are: of the fit, and of the mapping by name;
// may be NULL.
enum { GLTF_N_PAIRS = 96 };
struct gltf_fit_error {
    double fitted, by_name; // sums of GLTF_N_PAIRS x 3 squares
};
void gltf_from_disney(const struct gltf_brdf *b, struct gltf_material *out, const struct disney *m,
                      struct gltf_fit_error *error);
// 100 sqrt(sum / (n materials x pairs x 3))
double gltf_rmse_percent(double sum, double n_materials);
// f = albedo / pi is exact in glTF: no specular at all.
void gltf_from_lambert(struct gltf_material *out, const double albedo[3]);
