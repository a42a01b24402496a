// solver/kernels/kernels.h - shading in float32: many lights, one surface point, as fast as the machine goes.
//
// One table of functions per instruction set; kernels_select() picks the best the CPU has. All variants give the same answer
// to the bound in tests/check_kernels.c, relative to the light that could arrive (sum of V_i c_i), not to the result.
// Kernels do not allocate, do no I/O, keep no state; arrays are 64-byte aligned and padded to KERNEL_WIDTH with zero irradiance.
#pragma once
#include "solver/disney.h"
#include "solver/lights.h"
#include <stdbool.h>
#include <stdint.h>

enum { KERNEL_WIDTH = 16 };

// Lights as the kernels like them: l_d = R dh, q = 1/r, C; one array each, n_padded long (a multiple of KERNEL_WIDTH).
struct light_arrays {
    int n, n_padded;
    float centre_m[3];
    float *dx, *dy, *dz, *q, *cr, *cg, *cb;
};
int light_arrays_new(struct light_arrays *out, const struct lights *lights); // 0 or -ENOMEM
void light_arrays_update(struct light_arrays *a, const struct lights *lights); // same n; after c, R or r moved
void light_arrays_free(struct light_arrays *a);

struct surface_point {
    float position_m[3], normal[3], tangent[3], bitangent[3];
};

// What of the lights is left for one surface point: above the horizon, visible, compacted; shared by all its views. Directions are
// in the surface's frame (tangent, bitangent, normal). wr,wg,wb = V_i max(<n,l_i>,0) c_i(p) per channel. Entries from n up to
// the next multiple of KERNEL_WIDTH have weight 0. What one variant gathered another may shade.
struct lit {
    int n, capacity;
    float *lx, *ly, *nl, *sl /* S(nl) = (1-nl)^5 */, *gc /* clearcoat's g1(nl, .25) */, *wr, *wg, *wb;
    float *lx_rest, *ly_rest; // what float left of lx, ly: sharp lobes need it
    float *g, *g_r, *g_a;     // scratch of shade_jacobian_views
    float *facing;            // <l,d>: how much the light faces the point
    int32_t *index;           // which light
};
int lit_new(struct lit *out, int n_lights); // 0 or -ENOMEM
void lit_free(struct lit *l);

struct shade_material {
    float theta[DISNEY_N], albedo[3];
    enum disney_variant variant;
};
struct shade_jacobian {      // of outgoing radiance L (3 channels)
    float L[3];
    float theta[3][DISNEY_N];
    float albedo[3][3];      // [channel of L][channel of albedo]
    float own[3];            // dL / d albedo of the same channel at fixed tint: L is affine in it (SOLVER.md 4)
};

// How L changes when the set-up moves: l_i and c_i(p) by Eqs. 1-4, f and the cosine by l. A light at the horizon is a kink of L: what
// is given holds for the lights above it.
struct shade_setup {
    float *inverse_distance[3]; // [channel][lights->n_padded], the caller's arrays: dL / d(1/r_i); 0 where light i adds nothing
    float centre[3][3];         // [channel][x, y, z]: dL / dc
    float rotation[3][3];       // [channel][w]: dL / dw, R = exp([w]x) R0, at w = 0
};

struct kernels {
    const char *name; // "reference", "portable", "avx2", "avx512"
    // Gather: Eqs. 1-4 for every light, horizon, visibility. visible: one bit per light (NULL: all); soft: one byte per light
    // (x/255; NULL: 1).
    void (*gather)(struct lit *out, const struct light_arrays *lights, const struct surface_point *s,
                   const uint16_t *visible, const uint8_t *soft);
    // Eq. 5 from the gathered lights. v: unit, to the camera. L = 0 when <n,v> <= 0.
    void (*shade)(float L[3], const struct lit *lit, const struct surface_point *s, const float v[3],
                  const struct shade_material *m);
    void (*shade_jacobian)(struct shade_jacobian *out, const struct lit *lit, const struct surface_point *s,
                           const float v[3], const struct shade_material *m);
    // gather + shade_jacobian in one loop without sharing or compaction: the yardstick "brute force".
    void (*brute_jacobian)(struct shade_jacobian *out, const struct light_arrays *lights,
                           const struct surface_point *s, const float v[3], const struct shade_material *m);
    // Lambert: irradiance E = sum V_i <n,l_i> c_i, without albedo / pi, in one pass over the lights.
    void (*irradiance)(float E[3], const struct light_arrays *lights, const struct surface_point *s,
                       const uint16_t *visible);
    // shade_jacobian for all views of a texel, sharing what depends on light and material. Writes the scratch arrays of lit.
    void (*shade_jacobian_views)(struct shade_jacobian *out, int n_views, struct lit *lit, const struct surface_point *s,
                                 const float (*v)[3], const struct shade_material *m);
    // L = constant + own * albedo per channel, the tint T being held at m's albedo: what variable projection eliminates.
    void (*shade_affine)(float constant[3], float own[3], const struct lit *lit, const struct surface_point *s,
                         const float v[3], const struct shade_material *m);
    // shade_jacobian and the derivatives by the set-up. lit was gathered from these lights at s.
    void (*shade_setup)(struct shade_jacobian *out, struct shade_setup *setup, const struct lit *lit,
                        const struct light_arrays *lights, const struct surface_point *s, const float v[3],
                        const struct shade_material *m);
    // The same for Lambert: E as irradiance() gives it, and its derivatives.
    void (*irradiance_setup)(float E[3], struct shade_setup *setup, const struct light_arrays *lights,
                             const struct surface_point *s, const uint16_t *visible);
};

enum { KERNELS_REFERENCE = 1, KERNELS_PORTABLE = 2, KERNELS_AVX2 = 4, KERNELS_AVX512 = 8, KERNELS_ALL = 15 };
// The fastest of the allowed variants that this CPU and this build have; the reference if none.
// The environment's RIGSOLVE_KERNEL=reference|portable|avx2|avx512 narrows `allow` further (a name the CPU lacks: warned, ignored).
const struct kernels *kernels_select(unsigned allow);
const struct kernels *kernels_by_name(const char *name); // NULL: unknown, or not on this CPU
