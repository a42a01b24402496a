// solver/disney.h - the Disney BRDF (Burley 2012; SOLVER.md 2) in double precision, with every derivative. This is the truth
// that the float kernels are measured against.
//
// f has no cosine inside and is per steradian. All directions are unit vectors pointing away from the surface; n, x, y are
// the surface's frame. Below the horizon (<n,l> <= 0 or <n,v> <= 0) f and all derivatives are 0.
#pragma once

enum disney_parameter {
    DISNEY_METALLIC, DISNEY_SUBSURFACE, DISNEY_SPECULAR, DISNEY_ROUGHNESS, DISNEY_SPECULAR_TINT,
    DISNEY_ANISOTROPIC, DISNEY_SHEEN, DISNEY_SHEEN_TINT, DISNEY_CLEARCOAT, DISNEY_CLEARCOAT_GLOSS,
    DISNEY_N
};
extern const char *const disney_parameter_names[DISNEY_N]; // "metallic", ... as in the reference file

enum reflectance { REFLECT_DISNEY, REFLECT_LAMBERT /* f = albedo / pi */ };

enum disney_variant {
    DISNEY_2017, // G with the anisotropic alphas of D (the reference file since 2017); the default
    DISNEY_2012, // G isotropic, alpha_g = (.5 + .5 roughness)^2
};
const char *disney_variant_name(enum disney_variant variant); // "2017", "2012"

struct disney {
    double theta[DISNEY_N]; // each in [0,1]
    double albedo[3];       // linear base colour, >= 0
    enum disney_variant variant;
};

struct disney_frame {
    double n[3], x[3], y[3]; // orthonormal
};

void disney_eval(const struct disney *m, const struct disney_frame *frame, const double l[3],
                 const double v[3], double f[3]);

// Derivatives by theta and albedo are at fixed directions (clamps and black albedo: see disney.c). Those by l and n are for unit
// vectors that turn: the gradient lies in the plane across the vector. h follows l; x and y follow n by the smallest rotation.
struct disney_gradient {
    double f[3];
    double theta[3][DISNEY_N];
    double albedo[3][3]; // [channel of f][channel of albedo]
    double light[3][3];  // [channel][component of l]
    double normal[3][3]; // [channel][component of n]
};
void disney_eval_gradient(const struct disney *m, const struct disney_frame *frame, const double l[3],
                          const double v[3], struct disney_gradient *out);
