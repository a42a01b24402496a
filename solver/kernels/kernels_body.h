// solver/kernels/kernels_body.h - the float kernels, written once over a vector type; each instruction set's file defines
//   vf, LANES floats (LANES divides KERNEL_WIDTH), and vd, half as many doubles;
//   v_set1 v_load v_store v_max v_fma(a,b,c) = ab+c, v_fnma(a,b,c) = c-ab, v_rcp, v_rsqrt_sqrt (returns 1/sqrt, stores sqrt);
//   v_mask: v_positive(x, bits) v_count v_compress v_compress_index(p, first, mask); v_gather v_scatter v_keep v_bytes add_up;
//   d_set1 d_fma d_fnma d_wide(x, half) d_narrow(a, b)
// and includes this file.
//
// Light and view directions are in the surface's own frame (x, y, n), where the horizon is a sign and alpha is diagonal.
// With s = l + v (so h = s/|s|, lh = |s|/2) nothing needs normalising and nothing cancels:
//   Q = P/|s|^2,  P = (sx/ax)^2 + (sy/ay)^2 + sz^2;   D = (|s|^2/P)^2 / (pi ax ay)
//   1 + (a^2-1) nh^2 = (sx^2 + sy^2 + a^2 sz^2)/|s|^2
// d ln(GD)/dr = const + [sx^2 dx + sy^2 dy]/P - gl/root_l [lx^2 ex + ly^2 ey], and the same by anisotropic. The isotropic G of
// 2012 is the same expression with both of G's alphas equal, as |l| = 1; so one loop serves both variants.
//
// Sharp lobes: where l + v nearly cancels in x or y, float's rounding of l itself (6e-8) is not small beside alpha; the error of D
// grows like 1e-8 / alpha^3. So directions are gathered in double and kept as float + float, and when an alpha is below SHARP both
// parts are added; above, the first part is enough.
//
// 27 sums per sample carry everything (SOLVER.md 6): Fd, ss, FH, GD(1-FH), GD FH, coat, by roughness, by anisotropic, by gloss,
// each x RGB. Sums are taken per block of BLOCK lights, then over the blocks, so that thousands of lights cost no digits.
//
// By the set-up: with u = d + q e, e = c-p, |u| = <l,d> + q <l,e>, W_c the light's weight and F_c = nl f_c, two vectors per channel carry
// everything: the turn r_c = W_c/nl l x grad F_c, for which F need not be known off the sphere, and
//   dL_c/du = G_c = 1/|u| [W_c f_c (d/<l,d> - 3 l) + r_c x l],  dL_c/dq = <G_c,e>,  dL_c/dc = sum q G_c,
//   dL_c/dw = sum r_c - e x dL_c/dc: the set-up turns about p, and the centre goes back.
// |s|^2 has gradient 2s; sharp lobes are kept as vectors until the cross product, as their s and n parts cancel.
#include "solver/kernels/kernels.h"

#include <math.h>
#include <string.h>

enum { BLOCK = 1024 };
#define SHARP .07f
enum { FD, SS, FH, GDN, GDF, COAT, BY_ROUGHNESS, BY_ANISOTROPIC, BY_GLOSS, N_SUMS };
#define INLINE static inline __attribute__((always_inline))

typedef float v4 __attribute__((vector_size(16))); // three channels and one idle lane

static v4 all4(float x)
{
    return (v4){ x, x, x, x };
}

struct constants {
    float vx, vy, nv, sv;           // view in the surface's frame, S(nv)
    float vx_rest, vy_rest;         // what float left of vx, vy
    bool sharp;
    float r4;                       // roughness / 4: F = r lh^2 = r4 |s|^2
    float ix2, iy2, gx2, gy2;       // 1/alpha^2 of D, alpha^2 of G
    float rx, ry, r0, gr_x, gr_y;   // d ln(GD) by roughness
    float ax, ay, a0, ga_x, ga_y;   //           by anisotropic
    float a2;                       // clearcoat's alpha^2
    float gloss0, gloss1;           // d ln(Dc)/d gloss = gloss0 + gloss1 nh^2/(...)
    float by_fd, by_ss;             // roughness derivative of the base: |s|^2 (by_fd dFd + by_ss k dFss)
    float scale_gd, scale_coat;     // what D, G and coat have in common for all lights
    v4 f0, kd;                      // F0; (1-metallic) C / pi / scale_gd
    float subsurface;
    // From the material alone, for the above and for turning the sums into L and its derivatives:
    float r0_material, a0_material, scale_d, scale_dc;
    float lum;
    v4 albedo, tint, sheen_colour, f0_dielectric, specular_colour;
};

static float dot3(const float a[3], const float b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// <a,b> as float + float.
static float split(const float a[3], const float b[3], float *rest)
{
    const double exact = (double)a[0] * (double)b[0] + (double)a[1] * (double)b[1] + (double)a[2] * (double)b[2];
    const float first = (float)exact;
    *rest = (float)(exact - (double)first);
    return first;
}

static float pow5(float x)
{
    return x * x * (x * x) * x;
}

static void find_material(struct constants *k, const struct shade_material *m)
{
    const float *theta = m->theta;
    const float r = theta[DISNEY_ROUGHNESS], metallic = theta[DISNEY_METALLIC];
    const float subsurface = theta[DISNEY_SUBSURFACE];
    const float aspect2 = 1 - .9f * theta[DISNEY_ANISOTROPIC], aspect = sqrtf(aspect2);
    const float least = .001f;
    float ax = r * r / aspect, ax_r = 2 * r / aspect, ax_an = .45f * ax / aspect2;
    float ay = r * r * aspect, ay_r = 2 * r * aspect, ay_an = -.45f * ay / aspect2;
    if (ax <= least)
        ax = least, ax_r = 0, ax_an = 0;
    if (ay <= least)
        ay = least, ay_r = 0, ay_an = 0;
    k->sharp = ax < SHARP || ay < SHARP;
    const float iax = 1 / ax, iay = 1 / ay;
    k->ix2 = iax * iax, k->iy2 = iay * iay;
    k->rx = 4 * k->ix2 * iax * ax_r, k->ry = 4 * k->iy2 * iay * ay_r;
    k->ax = 4 * k->ix2 * iax * ax_an, k->ay = 4 * k->iy2 * iay * ay_an;
    const float ag = (.5f + .5f * r) * (.5f + .5f * r);
    if (m->variant == DISNEY_2012) {
        k->gx2 = k->gy2 = ag * ag;
        k->gr_x = k->gr_y = ag * (.5f + .5f * r);
        k->ga_x = k->ga_y = 0;
    } else {
        k->gx2 = ax * ax, k->gy2 = ay * ay;
        k->gr_x = ax * ax_r, k->gr_y = ay * ay_r;
        k->ga_x = ax * ax_an, k->ga_y = ay * ay_an;
    }
    k->r0_material = -(iax * ax_r + iay * ay_r), k->a0_material = -(iax * ax_an + iay * ay_an);
    k->scale_d = iax * iay * (float)M_1_PI;

    const float a = .001f + .099f * (1 - theta[DISNEY_CLEARCOAT_GLOSS]), a2 = a * a, log_a2 = logf(a2);
    k->a2 = a2;
    k->scale_dc = .25f * (a2 - 1) / ((float)M_PI * log_a2);
    k->gloss0 = -.099f * (2 * a / (a2 - 1) - 2 / (a * log_a2)), k->gloss1 = .198f * a;

    k->r4 = .25f * r;
    k->subsurface = subsurface;
    k->by_fd = (1 - subsurface) * .5f, k->by_ss = subsurface * 1.25f * .25f;
    k->lum = .3f * m->albedo[0] + .6f * m->albedo[1] + .1f * m->albedo[2];
    k->albedo = (v4){ m->albedo[0], m->albedo[1], m->albedo[2], 0 };
    k->tint = k->lum > 0 ? k->albedo / k->lum : all4(1);
    k->sheen_colour = 1 + theta[DISNEY_SHEEN_TINT] * (k->tint - 1);
    k->specular_colour = .08f * (1 + theta[DISNEY_SPECULAR_TINT] * (k->tint - 1));
    k->f0_dielectric = theta[DISNEY_SPECULAR] * k->specular_colour;
    k->f0 = k->f0_dielectric + metallic * (k->albedo - k->f0_dielectric);
}

// False below the horizon.
static bool find_view(struct constants *k, const struct surface_point *s, const float v[3], const struct shade_material *m)
{
    const float nv = dot3(s->normal, v);
    if (!(nv > 0))
        return false;
    k->nv = nv > 1e-10f ? nv : 1e-10f; // keeps |s|^2 and 1/(nl+nv) within float's range
    k->vx = split(s->tangent, v, &k->vx_rest), k->vy = split(s->bitangent, v, &k->vy_rest);
    k->sv = pow5(nv < 1 ? 1 - nv : 0);
    const float vx2 = k->vx * k->vx, vy2 = k->vy * k->vy;
    const float root = sqrtf(vx2 * k->gx2 + vy2 * k->gy2 + k->nv * k->nv), gv = 1 / (k->nv + root), gi = gv / root;
    k->r0 = k->r0_material - gi * (vx2 * k->gr_x + vy2 * k->gr_y);
    k->a0 = k->a0_material - gi * (vx2 * k->ga_x + vy2 * k->ga_y);
    k->scale_gd = gv * k->scale_d;
    k->scale_coat = k->scale_dc / (k->nv + sqrtf(.0625f + .9375f * k->nv * k->nv));
    k->kd = (1 - m->theta[DISNEY_METALLIC]) * (float)M_1_PI / k->scale_gd * k->albedo;
    return true;
}

// Lights that cannot be gathered any more: what depends on the light only.
struct light_vector {
    vf lx, ly, nl, sl, gc, w[3]; // sl = S(nl); gc = clearcoat's g1(nl, .25); w = V nl c per channel
    vf lx_rest, ly_rest;         // when sharp
    vf g, g_r, g_a;              // G's part of the light, - d ln g by roughness and by anisotropic
};

INLINE vf v_schlick(vf u)
{
    const vf m = v_set1(1) - u, m2 = m * m;
    return m2 * m2 * m;
}

INLINE vf v_coat_g(vf nl)
{
    vf root;
    v_rsqrt_sqrt(v_fma(nl * v_set1(.9375f), nl, v_set1(.0625f)), &root);
    return v_rcp(nl + root);
}

// s = l + v
INLINE void half_vector(vf *sx, vf *sy, vf *sz, const struct constants *k, const struct light_vector *l, bool sharp)
{
    *sx = l->lx + v_set1(k->vx), *sy = l->ly + v_set1(k->vy), *sz = l->nl + v_set1(k->nv);
    if (sharp)
        *sx += l->lx_rest + v_set1(k->vx_rest), *sy += l->ly_rest + v_set1(k->vy_rest);
}

// What f consists of, without the factors that differ between the channels.
struct lobes {
    vf diffuse, fh, gdn, rest; // mix(Fd, ss); FH; GD (1-FH), of which a channel takes F0; GD FH + coat
};

INLINE struct lobes lobes_of(const struct constants *k, const struct light_vector *l, bool sharp, bool subsurface, bool coat)
{
    const vf one = v_set1(1);
    vf sx, sy, sz;
    half_vector(&sx, &sy, &sz, k, l, sharp);
    const vf x2 = sx * sx, y2 = sy * sy, z2 = sz * sz, xy2 = x2 + y2, s2 = xy2 + z2;
    vf s;
    v_rsqrt_sqrt(s2, &s);
    const vf fh = v_schlick(s * v_set1(.5f));
    const vf f = s2 * v_set1(k->r4), sv = v_set1(k->sv);
    const vf e = v_fma(f, v_set1(2), v_set1(-.5f));
    vf diffuse = v_fma(e, l->sl, one) * v_fma(e, sv, one);
    if (subsurface) {
        const vf u = f - one;
        const vf fss = v_fma(u, l->sl, one) * v_fma(u, sv, one);
        const vf ss = v_fma(fss * v_set1(1.25f), v_rcp(sz) - v_set1(.5f), v_set1(.625f));
        diffuse = v_fma(v_set1(k->subsurface), ss - diffuse, diffuse);
    }
    const vf d = s2 * v_rcp(v_fma(x2, v_set1(k->ix2), v_fma(y2, v_set1(k->iy2), z2)));
    const vf root2 = v_fma(l->nl, l->nl, v_fma(l->lx * v_set1(k->gx2), l->lx, l->ly * v_set1(k->gy2) * l->ly));
    vf root;
    v_rsqrt_sqrt(root2, &root);
    const vf gd = d * d * v_rcp(l->nl + root) * v_set1(k->scale_gd);
    vf rest = gd * fh;
    const vf gdn = gd - rest;
    if (coat) {
        const vf dc = s2 * v_rcp(v_fma(z2, v_set1(k->a2), xy2));
        rest = v_fma(l->gc * dc, v_fma(fh, v_set1(.96f * k->scale_coat), v_set1(.04f * k->scale_coat)), rest);
    }
    return (struct lobes){ diffuse, fh, gdn, rest };
}

// The value alone: base[c] is what the diffuse lobe is multiplied by, sheen[c] what FH is.
INLINE void shade_light(vf sum[3], const struct constants *k, const struct light_vector *l, bool sharp,
                        const float base[3], const float sheen[3], bool subsurface, bool coat)
{
    const struct lobes f = lobes_of(k, l, sharp, subsurface, coat);
    for (int c = 0; c < 3; c++) {
        const vf value = v_fma(f.diffuse, v_set1(base[c]),
                               v_fma(f.fh, v_set1(sheen[c]), v_fma(f.gdn, v_set1(k->f0[c]), f.rest)));
        sum[c] = v_fma(l->w[c], value, sum[c]);
    }
}

// sum: constant, then own. base and metallic are the shares of own; of the constant, sheen[c] is FH's and specular[c] GD (1-FH)'s.
INLINE void affine_light(vf sum[6], const struct constants *k, const struct light_vector *l, bool sharp, float base,
                         float metallic, const float sheen[3], const float specular[3])
{
    const struct lobes f = lobes_of(k, l, sharp, true, true);
    const vf own = v_fma(f.diffuse, v_set1(base), f.gdn * v_set1(metallic));
    for (int c = 0; c < 3; c++) {
        const vf constant = v_fma(f.fh, v_set1(sheen[c]), v_fma(f.gdn, v_set1(specular[c]), f.rest));
        sum[c] = v_fma(l->w[c], constant, sum[c]), sum[3 + c] = v_fma(l->w[c], own, sum[3 + c]);
    }
}

INLINE void mask_light(struct light_vector *l, const struct constants *k)
{
    const vf lx2 = l->lx * l->lx, ly2 = l->ly * l->ly;
    vf root;
    const vf iroot = v_rsqrt_sqrt(v_fma(l->nl, l->nl, v_fma(lx2, v_set1(k->gx2), ly2 * v_set1(k->gy2))), &root);
    l->g = v_rcp(l->nl + root);
    const vf gi = l->g * iroot;
    l->g_r = gi * v_fma(lx2, v_set1(k->gr_x), ly2 * v_set1(k->gr_y));
    l->g_a = gi * v_fma(lx2, v_set1(k->ga_x), ly2 * v_set1(k->ga_y));
}

INLINE void jacobian_light(vf sum[N_SUMS][3], const struct constants *k, const struct light_vector *l, bool sharp)
{
    const vf one = v_set1(1);
    vf sx, sy, sz;
    half_vector(&sx, &sy, &sz, k, l, sharp);
    const vf x2 = sx * sx, y2 = sy * sy, z2 = sz * sz, xy2 = x2 + y2, s2 = xy2 + z2;
    vf s;
    v_rsqrt_sqrt(s2, &s);
    vf term[N_SUMS];
    term[FH] = v_schlick(s * v_set1(.5f));

    // Fd = A B with F90-1 = 2 r lh^2 - 1/2; ss = 1.25 [A' B' (1/(nl+nv) - 1/2) + 1/2] with F90-1 = r lh^2 - 1.
    const vf f = s2 * v_set1(k->r4), sv = v_set1(k->sv);
    const vf e = v_fma(f, v_set1(2), v_set1(-.5f)), u = f - one;
    const vf a = v_fma(e, l->sl, one), b = v_fma(e, sv, one);
    const vf a_ss = v_fma(u, l->sl, one), b_ss = v_fma(u, sv, one);
    const vf k_ss = v_rcp(sz) - v_set1(.5f);
    term[FD] = a * b;
    term[SS] = v_fma(a_ss * b_ss * v_set1(1.25f), k_ss, v_set1(.625f));
    const vf d_fd = v_fma(l->sl, b, sv * a), d_ss = v_fma(l->sl, b_ss, sv * a_ss);
    const vf base_r = s2 * v_fma(d_fd, v_set1(k->by_fd), d_ss * k_ss * v_set1(k->by_ss));

    const vf ip = v_rcp(v_fma(x2, v_set1(k->ix2), v_fma(y2, v_set1(k->iy2), z2))), d = s2 * ip;
    const vf gd = d * d * l->g;
    const vf dr = v_fma(x2, v_set1(k->rx), y2 * v_set1(k->ry)), da = v_fma(x2, v_set1(k->ax), y2 * v_set1(k->ay));
    const vf gd_r = gd * (v_fma(ip, dr, v_set1(k->r0)) - l->g_r);
    const vf gd_a = gd * (v_fma(ip, da, v_set1(k->a0)) - l->g_a);
    term[GDF] = gd * term[FH];
    term[GDN] = gd - term[GDF];

    const vf ic = v_rcp(v_fma(z2, v_set1(k->a2), xy2));
    term[COAT] = l->gc * s2 * ic * v_fma(term[FH], v_set1(.96f), v_set1(.04f));
    term[BY_GLOSS] = term[COAT] * v_fma(z2 * ic, v_set1(k->gloss1), v_set1(k->gloss0));

    const vf not_fh = one - term[FH];
    for (int c = 0; c < 3; c++) {
        const vf fresnel = v_fma(v_set1(k->f0[c]), not_fh, term[FH]);
        const vf by_r = v_fma(gd_r, fresnel, base_r * v_set1(k->kd[c])), by_a = gd_a * fresnel;
        for (int i = 0; i < N_SUMS; i++)
            sum[i][c] = v_fma(l->w[c], i == BY_ROUGHNESS ? by_r : i == BY_ANISOTROPIC ? by_a : term[i], sum[i][c]);
    }
}

// One more float than sums, as channels are read four at a time.
struct sums {
    float of[N_SUMS * 3 + 1];
};

static v4 channels(const struct sums *sums, int i)
{
    const float *of = sums->of + 3 * i;
    return (v4){ of[0], of[1], of[2], of[3] };
}

static void finish(struct shade_jacobian *out, const struct sums *sums, const struct constants *k,
                   const struct shade_material *m)
{
    const float *theta = m->theta, metallic = theta[DISNEY_METALLIC], dielectric = 1 - metallic;
    const float specular = theta[DISNEY_SPECULAR], specular_tint = theta[DISNEY_SPECULAR_TINT];
    const float sheen = theta[DISNEY_SHEEN], sheen_tint = theta[DISNEY_SHEEN_TINT];
    const float clearcoat = theta[DISNEY_CLEARCOAT], ilum = k->lum > 0 ? 1 / k->lum : 0;
    const v4 fd = channels(sums, FD) * (float)M_1_PI, ss = channels(sums, SS) * (float)M_1_PI, fh = channels(sums, FH);
    const v4 gdn = k->scale_gd * channels(sums, GDN), gdf = k->scale_gd * channels(sums, GDF);
    const v4 coat = k->scale_coat * channels(sums, COAT), gloss = k->scale_coat * channels(sums, BY_GLOSS);
    const v4 base = fd + theta[DISNEY_SUBSURFACE] * (ss - fd), diffuse = k->albedo * base + fh * sheen * k->sheen_colour;
    const v4 L = dielectric * diffuse + k->f0 * gdn + gdf + clearcoat * coat, off_grey = k->tint - 1;
    v4 d[DISNEY_N];
    d[DISNEY_METALLIC] = gdn * (k->albedo - k->f0_dielectric) - diffuse;
    d[DISNEY_SUBSURFACE] = dielectric * k->albedo * (ss - fd);
    d[DISNEY_SPECULAR] = dielectric * gdn * k->specular_colour;
    d[DISNEY_ROUGHNESS] = k->scale_gd * channels(sums, BY_ROUGHNESS);
    d[DISNEY_SPECULAR_TINT] = dielectric * .08f * specular * gdn * off_grey;
    d[DISNEY_ANISOTROPIC] = k->scale_gd * channels(sums, BY_ANISOTROPIC);
    d[DISNEY_SHEEN] = dielectric * fh * k->sheen_colour;
    d[DISNEY_SHEEN_TINT] = dielectric * sheen * fh * off_grey;
    d[DISNEY_CLEARCOAT] = coat;
    d[DISNEY_CLEARCOAT_GLOSS] = clearcoat * gloss;
    const v4 by_tint = dielectric * ilum * (sheen * sheen_tint * fh + .08f * specular * specular_tint * gdn);
    const v4 own = dielectric * base + metallic * gdn, by_self = own + by_tint, weight = { .3f, .6f, .1f, 0 };
    for (int c = 0; c < 3; c++) {
        out->L[c] = L[c];
        out->own[c] = own[c];
        for (int i = 0; i < DISNEY_N; i++)
            out->theta[c][i] = d[i][c];
        const v4 row = by_tint[c] * -k->tint[c] * weight;
        for (int j = 0; j < 3; j++)
            out->albedo[c][j] = row[j];
        out->albedo[c][c] += by_self[c];
    }
}

INLINE void clear_sums(vf sum[N_SUMS][3])
{
    for (int i = 0; i < N_SUMS; i++)
        sum[i][0] = sum[i][1] = sum[i][2] = v_set1(0);
}

INLINE void load_lit(struct light_vector *l, const struct lit *lit, int i, bool sharp)
{
    l->lx = v_load(lit->lx + i), l->ly = v_load(lit->ly + i), l->nl = v_load(lit->nl + i);
    l->sl = v_load(lit->sl + i), l->gc = v_load(lit->gc + i);
    l->w[0] = v_load(lit->wr + i), l->w[1] = v_load(lit->wg + i), l->w[2] = v_load(lit->wb + i);
    if (sharp)
        l->lx_rest = v_load(lit->lx_rest + i), l->ly_rest = v_load(lit->ly_rest + i);
}

// masked: mask_light's results lie in lit.
INLINE void jacobian_all(struct sums *sums, const struct lit *lit, const struct constants *k, bool sharp, bool masked)
{
    for (int begin = 0; begin < lit->n; begin += BLOCK) {
        const int end = lit->n - begin < BLOCK ? lit->n : begin + BLOCK;
        vf sum[N_SUMS][3];
        clear_sums(sum);
        for (int i = begin; i < end; i += LANES) {
            struct light_vector l;
            load_lit(&l, lit, i, sharp);
            if (masked)
                l.g = v_load(lit->g + i), l.g_r = v_load(lit->g_r + i), l.g_a = v_load(lit->g_a + i);
            else
                mask_light(&l, k);
            jacobian_light(sum, k, &l, sharp);
        }
        add_up(&sum[0][0], N_SUMS * 3, sums->of);
    }
}

// False, and all 0, when the view is below the horizon.
static bool find_jacobian(struct shade_jacobian *out, struct constants *k, const struct lit *lit, const struct surface_point *s,
                          const float v[3], const struct shade_material *m)
{
    struct sums sums = { 0 };
    *out = (struct shade_jacobian){ 0 };
    find_material(k, m);
    if (!find_view(k, s, v, m))
        return false;
    if (k->sharp)
        jacobian_all(&sums, lit, k, true, false);
    else
        jacobian_all(&sums, lit, k, false, false);
    finish(out, &sums, k, m);
    return true;
}

static void shade_jacobian(struct shade_jacobian *out, const struct lit *lit, const struct surface_point *s,
                           const float v[3], const struct shade_material *m)
{
    struct constants k;
    find_jacobian(out, &k, lit, s, v, m);
}

static void shade_jacobian_views(struct shade_jacobian *out, int n_views, struct lit *lit, const struct surface_point *s,
                                 const float (*v)[3], const struct shade_material *m)
{
    struct constants k;
    find_material(&k, m);
    for (int i = 0; i < lit->n; i += LANES) {
        struct light_vector l;
        load_lit(&l, lit, i, false);
        mask_light(&l, &k);
        v_store(lit->g + i, l.g), v_store(lit->g_r + i, l.g_r), v_store(lit->g_a + i, l.g_a);
    }
    for (int i = 0; i < n_views; i++) {
        struct sums sums = { 0 };
        if (!find_view(&k, s, v[i], m)) {
            out[i] = (struct shade_jacobian){ 0 };
            continue;
        }
        if (k.sharp)
            jacobian_all(&sums, lit, &k, true, true);
        else
            jacobian_all(&sums, lit, &k, false, true);
        finish(&out[i], &sums, &k, m);
    }
}

INLINE void shade_all(float L[3], const struct lit *lit, const struct constants *k, bool sharp, const float base[3],
                      const float sheen[3], bool subsurface, bool coat)
{
    for (int begin = 0; begin < lit->n; begin += BLOCK) {
        const int end = lit->n - begin < BLOCK ? lit->n : begin + BLOCK;
        vf sum[3] = { v_set1(0), v_set1(0), v_set1(0) };
        for (int i = begin; i < end; i += LANES) {
            struct light_vector l;
            load_lit(&l, lit, i, sharp);
            shade_light(sum, k, &l, sharp, base, sheen, subsurface, coat);
        }
        add_up(sum, 3, L);
    }
}

static void shade(float L[3], const struct lit *lit, const struct surface_point *s, const float v[3],
                  const struct shade_material *m)
{
    struct constants k;
    L[0] = L[1] = L[2] = 0;
    find_material(&k, m);
    if (!find_view(&k, s, v, m))
        return;
    const float dielectric = 1 - m->theta[DISNEY_METALLIC];
    float base[3], sheen[3];
    for (int c = 0; c < 3; c++) {
        base[c] = dielectric * m->albedo[c] * (float)M_1_PI;
        sheen[c] = dielectric * m->theta[DISNEY_SHEEN] * k.sheen_colour[c];
    }
    k.scale_coat *= m->theta[DISNEY_CLEARCOAT];
    const bool subsurface = m->theta[DISNEY_SUBSURFACE] > 0 && dielectric > 0, coat = m->theta[DISNEY_CLEARCOAT] > 0;
    float sums[3] = { 0 };
    if (k.sharp)
        shade_all(sums, lit, &k, true, base, sheen, true, true);
    else if (subsurface && coat)
        shade_all(sums, lit, &k, false, base, sheen, true, true);
    else if (subsurface)
        shade_all(sums, lit, &k, false, base, sheen, true, false);
    else if (coat)
        shade_all(sums, lit, &k, false, base, sheen, false, true);
    else
        shade_all(sums, lit, &k, false, base, sheen, false, false);
    for (int c = 0; c < 3; c++)
        L[c] = sums[c];
}

INLINE void affine_all(float sums[6], const struct lit *lit, const struct constants *k, bool sharp, float base, float metallic,
                       const float sheen[3], const float specular[3])
{
    for (int begin = 0; begin < lit->n; begin += BLOCK) {
        const int end = lit->n - begin < BLOCK ? lit->n : begin + BLOCK;
        vf sum[6];
        for (int i = 0; i < 6; i++)
            sum[i] = v_set1(0);
        for (int i = begin; i < end; i += LANES) {
            struct light_vector l;
            load_lit(&l, lit, i, sharp);
            affine_light(sum, k, &l, sharp, base, metallic, sheen, specular);
        }
        add_up(sum, 6, sums);
    }
}

static void shade_affine(float constant[3], float own[3], const struct lit *lit, const struct surface_point *s,
                         const float v[3], const struct shade_material *m)
{
    struct constants k;
    float sums[6] = { 0 };
    find_material(&k, m);
    if (find_view(&k, s, v, m)) {
        const float metallic = m->theta[DISNEY_METALLIC], dielectric = 1 - metallic;
        float sheen[3], specular[3];
        for (int c = 0; c < 3; c++) {
            sheen[c] = dielectric * m->theta[DISNEY_SHEEN] * k.sheen_colour[c];
            specular[c] = dielectric * k.f0_dielectric[c];
        }
        k.scale_coat *= m->theta[DISNEY_CLEARCOAT];
        if (k.sharp)
            affine_all(sums, lit, &k, true, dielectric * (float)M_1_PI, metallic, sheen, specular);
        else
            affine_all(sums, lit, &k, false, dielectric * (float)M_1_PI, metallic, sheen, specular);
    }
    for (int c = 0; c < 3; c++)
        constant[c] = sums[c], own[c] = sums[3 + c];
}

// What setup_light needs beside the constants: the shares of the diffuse lobe and of FH per channel, and e = centre - p.
struct moving {
    float base[3], sheen[3];
    float e[3], e_frame[3]; // in the world, in the surface's frame
};
enum { CENTRE = 0, TURN = 9, N_SETUP_SUMS = 18 };

static struct moving find_moving(const struct light_arrays *a, const struct surface_point *s)
{
    struct moving m;
    for (int c = 0; c < 3; c++)
        m.e[c] = a->centre_m[c] - s->position_m[c];
    m.e_frame[0] = dot3(s->tangent, m.e), m.e_frame[1] = dot3(s->bitangent, m.e), m.e_frame[2] = dot3(s->normal, m.e);
    return m;
}

INLINE void v_cross(vf out[3], const vf a[3], const vf b[3])
{
    out[0] = v_fnma(a[2], b[1], a[1] * b[2]);
    out[1] = v_fnma(a[0], b[2], a[2] * b[0]);
    out[2] = v_fnma(a[1], b[0], a[0] * b[1]);
}

INLINE vf v_dot(const vf u[3], const float a[3])
{
    return v_fma(u[0], v_set1(a[0]), v_fma(u[1], v_set1(a[1]), u[2] * v_set1(a[2])));
}

// by_q: dL/dq of these lights; sum: 3 channels x (q G) and x r.
INLINE void setup_light(vf by_q[3], vf sum[N_SETUP_SUMS], const struct constants *k, const struct moving *moving,
                        const struct light_vector *l, vf facing, vf q, bool sharp)
{
    const vf one = v_set1(1), to_light[3] = { l->lx, l->ly, l->nl };
    vf s[3];
    half_vector(&s[0], &s[1], &s[2], k, l, sharp);
    const vf x2 = s[0] * s[0], y2 = s[1] * s[1], z2 = s[2] * s[2], xy2 = x2 + y2, s2 = xy2 + z2;
    vf length;
    const vf is = v_rsqrt_sqrt(s2, &length), is2 = is * is;

    // x_s: the gradient of x has the part x_s s; x_n: the part x_n n.
    const vf m = v_fma(length, v_set1(-.5f), one), m4 = m * m * (m * m), fh = m4 * m, fh_s = m4 * is * v_set1(-2.5f);
    const vf ml = one - l->nl, sl_n = ml * ml * (ml * ml) * v_set1(-5), sv = v_set1(k->sv);
    const vf f = s2 * v_set1(k->r4), e = v_fma(f, v_set1(2), v_set1(-.5f)), u = f - one;
    const vf a = v_fma(e, l->sl, one), b = v_fma(e, sv, one);
    const vf a_ss = v_fma(u, l->sl, one), b_ss = v_fma(u, sv, one), fss = a_ss * b_ss;
    const vf isz = v_rcp(s[2]), k_ss = (isz - v_set1(.5f)) * v_set1(1.25f);
    const vf fd = a * b, fd_s = v_fma(l->sl, b, sv * a) * v_set1(2), fd_n = e * b * sl_n;
    const vf ss = v_fma(fss, k_ss, v_set1(.625f)), ss_s = k_ss * v_fma(l->sl, b_ss, sv * a_ss);
    const vf ss_n = v_fma(k_ss * sl_n, u * b_ss, fss * isz * isz * v_set1(-1.25f));
    const vf subsurface = v_set1(k->subsurface);
    const vf diffuse = v_fma(subsurface, ss - fd, fd), diffuse_n = v_fma(subsurface, ss_n - fd_n, fd_n);
    const vf diffuse_s = v_fma(subsurface, ss_s - fd_s, fd_s) * v_set1(2 * k->r4);

    // G D and the gradient of its logarithm.
    const vf ip = v_rcp(v_fma(x2, v_set1(k->ix2), v_fma(y2, v_set1(k->iy2), z2))), d = s2 * ip;
    const vf gx = l->lx * v_set1(k->gx2), gy = l->ly * v_set1(k->gy2);
    vf root;
    const vf iroot = v_rsqrt_sqrt(v_fma(l->nl, l->nl, v_fma(gx, l->lx, gy * l->ly)), &root);
    const vf g = v_rcp(l->nl + root), gi = g * iroot, gd = d * d * g * v_set1(k->scale_gd), four = v_set1(4);
    const vf ln_gd[3] = { v_fnma(gi, gx, s[0] * four * v_fnma(ip, v_set1(k->ix2), is2)),
                          v_fnma(gi, gy, s[1] * four * v_fnma(ip, v_set1(k->iy2), is2)),
                          v_fnma(gi, l->nl, v_fma(s[2] * four, is2 - ip, -g)) };

    // coat, and its gradient but for FH's.
    const vf ic = v_rcp(v_fma(z2, v_set1(k->a2), xy2)), two = v_set1(2);
    const vf coat_fresnel = l->gc * s2 * ic * v_set1(k->scale_coat), coat = coat_fresnel * v_fma(fh, v_set1(.96f), v_set1(.04f));
    const vf coat_s = coat_fresnel * v_set1(.96f) * fh_s;
    vf coat_root;
    const vf coat_iroot = v_rsqrt_sqrt(v_fma(l->nl * v_set1(.9375f), l->nl, v_set1(.0625f)), &coat_root);
    const vf across = coat * two * (is2 - ic);
    const vf ln_gc_n = l->gc * v_fma(l->nl * v_set1(.9375f), coat_iroot, one);
    const vf by_coat[3] = { s[0] * across, s[1] * across, coat * v_fnma(v_set1(k->a2) * ic, s[2] * two, v_fma(s[2] * two, is2, -ln_gc_n)) };

    const vf l_n[2] = { l->ly, -l->lx }; // l x n; its third is 0
    vf l_s[3], l_gd[3], l_coat[3];
    v_cross(l_s, to_light, s), v_cross(l_gd, to_light, ln_gd), v_cross(l_coat, to_light, by_coat);

    const vf q_e = q * v_dot(to_light, moving->e_frame), distance = v_max(facing + q_e, v_set1(1e-6f));
    const vf iu = v_rcp(distance), i_facing = v_rcp(facing), inl = v_rcp(l->nl);
    const vf along = v_fma(distance, i_facing, v_set1(-3)), back = q * i_facing, q_iu = q * iu;
    vf emission[3]; // d/<l,d> - 3 l
    for (int j = 0; j < 3; j++)
        emission[j] = v_fnma(back, v_set1(moving->e_frame[j]), along * to_light[j]);
    const vf not_fh = one - fh;
    for (int c = 0; c < 3; c++) {
        const vf base = v_set1(moving->base[c]), sheen = v_set1(moving->sheen[c]), f0 = v_set1(k->f0[c]);
        const vf gd_fresnel = gd * v_fma(f0, not_fh, fh);
        const vf value = v_fma(base, diffuse, v_fma(sheen, fh, gd_fresnel + coat));
        const vf by_n = v_fma(base, diffuse_n, value * inl);
        const vf by_s = v_fma(base, diffuse_s, v_fma(v_fnma(gd, f0, gd + sheen), fh_s, coat_s));
        const vf w = l->w[c], w_value = w * value;
        vf turn[3], across_l[3], by_u[3];
        for (int j = 0; j < 3; j++) {
            vf t = v_fma(by_s, l_s[j], v_fma(gd_fresnel, l_gd[j], l_coat[j]));
            if (j < 2)
                t = v_fma(by_n, l_n[j], t);
            turn[j] = w * t;
            sum[TURN + 3 * c + j] += turn[j];
        }
        v_cross(across_l, turn, to_light);
        for (int j = 0; j < 3; j++) {
            by_u[j] = v_fma(w_value, emission[j], across_l[j]);
            sum[CENTRE + 3 * c + j] = v_fma(q_iu, by_u[j], sum[CENTRE + 3 * c + j]);
        }
        by_q[c] = iu * v_dot(by_u, moving->e_frame);
    }
}

INLINE void setup_all(struct shade_setup *setup, float sums[N_SETUP_SUMS], const struct lit *lit, const struct light_arrays *a,
                      const struct constants *k, const struct moving *moving, bool sharp)
{
    for (int begin = 0; begin < lit->n; begin += BLOCK) {
        const int end = lit->n - begin < BLOCK ? lit->n : begin + BLOCK;
        vf sum[N_SETUP_SUMS];
        for (int i = 0; i < N_SETUP_SUMS; i++)
            sum[i] = v_set1(0);
        for (int i = begin; i < end; i += LANES) {
            struct light_vector l;
            vf by_q[3];
            load_lit(&l, lit, i, sharp);
            setup_light(by_q, sum, k, moving, &l, v_load(lit->facing + i), v_gather(a->q, lit->index + i), sharp);
            for (int c = 0; c < 3; c++)
                v_scatter(setup->inverse_distance[c], lit->index + i, by_q[c], lit->n - i);
        }
        add_up(sum, N_SETUP_SUMS, sums);
    }
}

static void cross3(float out[3], const float a[3], const float b[3])
{
    for (int c = 0; c < 3; c++)
        out[c] = a[(c + 1) % 3] * b[(c + 2) % 3] - a[(c + 2) % 3] * b[(c + 1) % 3];
}

// dL/dw from the turn about the point.
static void turn_about_centre(float rotation[3], const float turn[3], const float e[3], const float centre[3])
{
    float shift[3];
    cross3(shift, e, centre);
    for (int j = 0; j < 3; j++)
        rotation[j] = turn[j] - shift[j];
}

// From the surface's frame to the world, where a cross product has the frame's hand.
static void finish_setup(struct shade_setup *setup, const float sums[N_SETUP_SUMS], const struct moving *moving,
                         const struct surface_point *s)
{
    float third[3];
    cross3(third, s->tangent, s->bitangent);
    const float hand = dot3(third, s->normal) < 0 ? -1 : 1;
    for (int c = 0; c < 3; c++) {
        const float *q_g = sums + CENTRE + 3 * c, *r = sums + TURN + 3 * c;
        float turn[3];
        for (int j = 0; j < 3; j++) {
            setup->centre[c][j] = q_g[0] * s->tangent[j] + q_g[1] * s->bitangent[j] + q_g[2] * s->normal[j];
            turn[j] = hand * (r[0] * s->tangent[j] + r[1] * s->bitangent[j] + r[2] * s->normal[j]);
        }
        turn_about_centre(setup->rotation[c], turn, moving->e, setup->centre[c]);
    }
}

static void shade_setup(struct shade_jacobian *out, struct shade_setup *setup, const struct lit *lit,
                        const struct light_arrays *a, const struct surface_point *s, const float v[3],
                        const struct shade_material *m)
{
    struct constants k;
    struct moving moving = find_moving(a, s);
    float sums[N_SETUP_SUMS] = { 0 };
    for (int c = 0; c < 3; c++)
        memset(setup->inverse_distance[c], 0, (size_t)a->n_padded * sizeof(float));
    if (find_jacobian(out, &k, lit, s, v, m)) {
        const float dielectric = 1 - m->theta[DISNEY_METALLIC];
        for (int c = 0; c < 3; c++) {
            moving.base[c] = dielectric * m->albedo[c] * (float)M_1_PI;
            moving.sheen[c] = dielectric * m->theta[DISNEY_SHEEN] * k.sheen_colour[c];
        }
        k.scale_coat *= m->theta[DISNEY_CLEARCOAT];
        if (k.sharp)
            setup_all(setup, sums, lit, a, &k, &moving, true);
        else
            setup_all(setup, sums, lit, a, &k, &moving, false);
    }
    finish_setup(setup, sums, &moving, s);
}

// Eqs. 1-4 for LANES lights: direction in the surface's frame and nl max(<u,d>,0)/|u|^3, with u = d + q (centre - p).
struct incoming {
    vf lx, ly, nl, weight, lx_rest, ly_rest;
    vf u[3], d[3], q, iu /* 1/|u| */, facing /* <l,d> */;
};

INLINE vd d_dot(const vd u[3], const float a[3])
{
    return d_fma(u[0], d_set1((double)a[0]), d_fma(u[1], d_set1((double)a[1]), u[2] * d_set1((double)a[2])));
}

// exact: lx and ly in double, half a vector at a time, kept as float + float.
INLINE struct incoming light_at(const struct light_arrays *a, int i, const struct surface_point *s, bool exact)
{
    struct incoming in;
    const vf q = v_load(a->q + i), d[3] = { v_load(a->dx + i), v_load(a->dy + i), v_load(a->dz + i) };
    vf u[3], unused;
    for (int c = 0; c < 3; c++)
        u[c] = v_fma(q, v_set1(a->centre_m[c] - s->position_m[c]), d[c]);
    const vf u2 = v_max(v_fma(u[0], u[0], v_fma(u[1], u[1], u[2] * u[2])), v_set1(1e-12f));
    const vf ud = v_max(v_fma(u[0], d[0], v_fma(u[1], d[1], u[2] * d[2])), v_set1(0));
    const vf iu = v_rsqrt_sqrt(u2, &unused);
    if (exact) {
        vd lx[2], ly[2];
        for (int half = 0; half < 2; half++) {
            const vd q_half = d_wide(q, half), y = d_wide(iu, half);
            vd w[3];
            for (int c = 0; c < 3; c++)
                w[c] = d_fma(q_half, d_set1((double)a->centre_m[c] - (double)s->position_m[c]), d_wide(d[c], half));
            const vd w2 = d_fma(w[0], w[0], d_fma(w[1], w[1], w[2] * w[2]));
            // One Newton step takes 1e-7 to 1e-14.
            const vd iw = d_fma(y * d_set1(.5), d_fnma(w2 * y, y, d_set1(1)), y);
            lx[half] = iw * d_dot(w, s->tangent), ly[half] = iw * d_dot(w, s->bitangent);
        }
        in.lx = d_narrow(lx[0], lx[1]), in.ly = d_narrow(ly[0], ly[1]);
        in.lx_rest = d_narrow(lx[0] - d_wide(in.lx, 0), lx[1] - d_wide(in.lx, 1));
        in.ly_rest = d_narrow(ly[0] - d_wide(in.ly, 0), ly[1] - d_wide(in.ly, 1));
    } else {
        in.lx = iu * v_dot(u, s->tangent), in.ly = iu * v_dot(u, s->bitangent);
        in.lx_rest = in.ly_rest = v_set1(0);
    }
    const vf nl = iu * v_dot(u, s->normal);
    in.weight = v_max(nl, v_set1(0)) * ud * (iu * iu * iu);
    in.nl = v_max(nl, v_set1(1e-10f)); // so that nothing divides by 0, whatever the weight
    in.facing = v_max(ud * iu, v_set1(1e-10f));
    in.q = q, in.iu = iu;
    for (int c = 0; c < 3; c++)
        in.u[c] = u[c], in.d[c] = d[c];
    return in;
}

static unsigned visible_bits(const uint16_t *visible, int i)
{
    return visible ? (unsigned)visible[i / 16] >> i % 16 : ~0u;
}

static void gather(struct lit *out, const struct light_arrays *a, const struct surface_point *s,
                   const uint16_t *visible, const uint8_t *soft)
{
    int n = 0;
    for (int i = 0; i < a->n_padded; i += LANES) {
        struct incoming in = light_at(a, i, s, true);
        if (soft)
            in.weight = in.weight * v_bytes(soft + i, a->n - i) * v_set1(1 / 255.f);
        // weight > 0 holds for lights above the horizon that face the point, and for no padding.
        const v_mask keep = v_positive(in.weight, visible_bits(visible, i));
        v_compress(out->lx + n, in.lx, keep), v_compress(out->ly + n, in.ly, keep);
        v_compress(out->lx_rest + n, in.lx_rest, keep), v_compress(out->ly_rest + n, in.ly_rest, keep);
        v_compress(out->nl + n, in.nl, keep);
        v_compress(out->facing + n, in.facing, keep);
        v_compress(out->wr + n, in.weight * v_load(a->cr + i), keep);
        v_compress(out->wg + n, in.weight * v_load(a->cg + i), keep);
        v_compress(out->wb + n, in.weight * v_load(a->cb + i), keep);
        v_compress_index(out->index + n, i, keep);
        n += v_count(keep);
    }
    out->n = n;
    for (int i = n; i % KERNEL_WIDTH; i++) {
        out->lx[i] = out->ly[i] = out->lx_rest[i] = out->ly_rest[i] = 0;
        out->wr[i] = out->wg[i] = out->wb[i] = 0;
        out->nl[i] = out->facing[i] = 1;
        out->index[i] = 0;
    }
    for (int i = 0; i < n; i += LANES) {
        const vf nl = v_load(out->nl + i);
        v_store(out->sl + i, v_schlick(nl));
        v_store(out->gc + i, v_coat_g(nl));
    }
}

INLINE void brute_all(struct sums *sums, const struct light_arrays *a, const struct surface_point *s,
                      const struct constants *k, bool sharp)
{
    for (int begin = 0; begin < a->n_padded; begin += BLOCK) {
        const int end = a->n_padded - begin < BLOCK ? a->n_padded : begin + BLOCK;
        vf sum[N_SUMS][3];
        clear_sums(sum);
        for (int i = begin; i < end; i += LANES) {
            const struct incoming in = light_at(a, i, s, sharp);
            struct light_vector l = { .lx = in.lx, .ly = in.ly, .nl = in.nl, .lx_rest = in.lx_rest, .ly_rest = in.ly_rest };
            l.sl = v_schlick(l.nl), l.gc = v_coat_g(l.nl);
            l.w[0] = in.weight * v_load(a->cr + i), l.w[1] = in.weight * v_load(a->cg + i);
            l.w[2] = in.weight * v_load(a->cb + i);
            mask_light(&l, k);
            jacobian_light(sum, k, &l, sharp);
        }
        add_up(&sum[0][0], N_SUMS * 3, sums->of);
    }
}

static void brute_jacobian(struct shade_jacobian *out, const struct light_arrays *a, const struct surface_point *s,
                           const float v[3], const struct shade_material *m)
{
    struct constants k;
    struct sums sums = { 0 };
    *out = (struct shade_jacobian){ 0 };
    find_material(&k, m);
    if (!find_view(&k, s, v, m))
        return;
    if (k.sharp)
        brute_all(&sums, a, s, &k, true);
    else
        brute_all(&sums, a, s, &k, false);
    finish(out, &sums, &k, m);
}

static void irradiance(float E[3], const struct light_arrays *a, const struct surface_point *s,
                       const uint16_t *visible)
{
    float sums[3] = { 0 };
    for (int begin = 0; begin < a->n_padded; begin += BLOCK) {
        const int end = a->n_padded - begin < BLOCK ? a->n_padded : begin + BLOCK;
        vf sum[3] = { v_set1(0), v_set1(0), v_set1(0) };
        for (int i = begin; i < end; i += LANES) {
            const vf w = v_keep(light_at(a, i, s, false).weight, visible_bits(visible, i));
            sum[0] = v_fma(w, v_load(a->cr + i), sum[0]);
            sum[1] = v_fma(w, v_load(a->cg + i), sum[1]);
            sum[2] = v_fma(w, v_load(a->cb + i), sum[2]);
        }
        add_up(sum, 3, sums);
    }
    for (int c = 0; c < 3; c++)
        E[c] = sums[c];
}

// In the world's frame, as f = 1 needs none: with a = <l,d>, G = C V/|u|^3 [nl d + a n - 4 nl a l], and the turn is C V a/|u|^2 l x n.
static void irradiance_setup(float E[3], struct shade_setup *setup, const struct light_arrays *a, const struct surface_point *s,
                             const uint16_t *visible)
{
    enum { BY_C = 3, L_SUM = 12, N = 21 };
    const struct moving moving = find_moving(a, s);
    float sums[N] = { 0 };
    for (int begin = 0; begin < a->n_padded; begin += BLOCK) {
        const int end = a->n_padded - begin < BLOCK ? a->n_padded : begin + BLOCK;
        vf sum[N];
        for (int i = 0; i < N; i++)
            sum[i] = v_set1(0);
        for (int i = begin; i < end; i += LANES) {
            const struct incoming in = light_at(a, i, s, false);
            const unsigned keep = (unsigned)v_positive(in.weight, visible_bits(visible, i));
            const vf w = v_keep(in.weight, keep), g = v_keep(in.facing * in.iu * in.iu, keep), iu3 = v_keep(in.iu * in.iu * in.iu, keep);
            const vf to_l = in.nl * in.facing * in.iu * v_set1(-4);
            vf by_u[3], l[3];
            for (int j = 0; j < 3; j++) {
                by_u[j] = iu3 * v_fma(in.nl, in.d[j], v_fma(in.facing, v_set1(s->normal[j]), to_l * in.u[j]));
                l[j] = g * in.iu * in.u[j];
            }
            const vf by_q = v_dot(by_u, moving.e), colour[3] = { v_load(a->cr + i), v_load(a->cg + i), v_load(a->cb + i) };
            for (int c = 0; c < 3; c++) {
                sum[c] = v_fma(w, colour[c], sum[c]);
                v_store(setup->inverse_distance[c] + i, colour[c] * by_q);
                for (int j = 0; j < 3; j++) {
                    sum[BY_C + 3 * c + j] = v_fma(in.q * by_u[j], colour[c], sum[BY_C + 3 * c + j]);
                    sum[L_SUM + 3 * c + j] = v_fma(l[j], colour[c], sum[L_SUM + 3 * c + j]);
                }
            }
        }
        add_up(sum, N, sums);
    }
    for (int c = 0; c < 3; c++) {
        float turn[3];
        E[c] = sums[c];
        memcpy(setup->centre[c], sums + BY_C + 3 * c, sizeof(setup->centre[c]));
        cross3(turn, sums + L_SUM + 3 * c, s->normal);
        turn_about_centre(setup->rotation[c], turn, moving.e, setup->centre[c]);
    }
}
