// solver/gltf_brdf.c - the glTF 2.0 reflectance, term by term as the specification's appendix B and its extensions say, and the fit.
//
// With C the base colour, m metallic, S the specular colour, w the specular factor, alpha = roughness^2:
//   fr_k = f0_k + (1 - f0_k) (1 - <v,h>)^5, f0_k = min(.04 S_k, 1)
//   dielectric_k = (1 - w max fr) C_k/pi + w fr_k V D;  metal_k = (C_k + (1 - C_k) (1 - <v,h>)^5) V D
//   base_k = (1-m) dielectric_k + m metal_k
//   under sheen: sheen_k D_s V_s + base_k min(1 - max(sheen) E(<n,v>), 1 - max(sheen) E(<n,l>))
//   under the coat: mix(that, coat V D, clearcoat Fc), Fc = .04 + .96 (1 - <n,v>)^5
// V is separable where alpha is isotropic (appendix B) and height-correlated where it is not (KHR_materials_anisotropy).
//
// Why so much of the fit is closed form: glTF's GGX with its separable V is Disney's G D with alpha = roughness^2 (variant 2017),
// and both mix F0 by metallic; .04 S = .08 specular mix(1, tint, specularTint) makes them equal. What differs: the diffuse lobe (no
// retro-reflection, 1 - max fr in its place), sheen's shape, the coat's GTR1 against GGX, and what coat and sheen take away below.
#include "solver/gltf_brdf.h"

#include "solver/vec3.h"

#include <errno.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum {
    N_SHEEN_COS = 33, N_SHEEN_ROUGHNESS = 17, // table of E: cosines 0..1, roughness 0..1
    N_GLOSS = 33,
    N_VIEWS = 4, N_PER_VIEW = GLTF_N_PAIRS / N_VIEWS,
};
static const double least_sheen_roughness = .07, largest_specular_color = 25; // f0 = 1

// What the directions enter with.
struct cosines {
    double nl, nv, nh, vh, lx, ly, vx, vy, hx, hy;
};

// What sheen of one roughness does there: its lobe, and the larger of E(<n,v>) and E(<n,l>).
struct sheen {
    double lobe, taken;
};

struct gltf_brdf {
    double sheen_e[N_SHEEN_ROUGHNESS][N_SHEEN_COS];
    double l[GLTF_N_PAIRS][3], v[GLTF_N_PAIRS][3]; // the fixed pairs, and what of them does not depend on a material
    struct cosines pair[GLTF_N_PAIRS];
    struct sheen pair_sheen[GLTF_N_PAIRS]; // of sheen_roughness
    double coat_roughness[N_GLOSS], coat_scale[N_GLOSS];
    double sheen_roughness, sheen_scale;
};

static const struct disney_frame axes = { { 0, 0, 1 }, { 1, 0, 0 }, { 0, 1, 0 } };

static double clamp(double x, double least, double most)
{
    return x < least ? least : x > most ? most : x;
}

static double mix(double a, double b, double t)
{
    return a + t * (b - a);
}

static double max3(const double v[3])
{
    return fmax(v[0], fmax(v[1], v[2]));
}

static double fifth_power_below(double u)
{
    const double x = clamp(1 - u, 0, 1);
    return x * x * x * x * x;
}

// ---- the model ------------------------------------------------------------------------------------------------------------

static bool find_cosines(struct cosines *c, const struct disney_frame *frame, const double l[3], const double v[3])
{
    double h[3];
    c->nl = vec3_dot(frame->n, l), c->nv = vec3_dot(frame->n, v);
    if (!(c->nl > 0 && c->nv > 0))
        return false;
    vec3_add_scaled(h, l, 1, v);
    vec3_normalise(h);
    c->nh = vec3_dot(frame->n, h), c->vh = vec3_dot(v, h);
    c->lx = vec3_dot(l, frame->x), c->ly = vec3_dot(l, frame->y);
    c->vx = vec3_dot(v, frame->x), c->vy = vec3_dot(v, frame->y);
    c->hx = vec3_dot(h, frame->x), c->hy = vec3_dot(h, frame->y);
    return true;
}

// V D of GGX.
static double ggx(const struct cosines *c, double alpha_x, double alpha_y)
{
    const double ax = fmax(alpha_x, 1e-4), ay = fmax(alpha_y, 1e-4);
    const double px = c->hx / ax, py = c->hy / ay, q = px * px + py * py + c->nh * c->nh;
    const double d = 1 / (M_PI * ax * ay * q * q);
    if (alpha_x == alpha_y) {
        const double a2 = ax * ax;
        return d / ((c->nl + sqrt(a2 + (1 - a2) * c->nl * c->nl)) * (c->nv + sqrt(a2 + (1 - a2) * c->nv * c->nv)));
    }
    const double to_v = sqrt(ax * c->vx * ax * c->vx + ay * c->vy * ay * c->vy + c->nv * c->nv),
                 to_l = sqrt(ax * c->lx * ax * c->lx + ay * c->ly * ay * c->ly + c->nl * c->nl);
    return d * .5 / (c->nl * to_v + c->nv * to_l);
}

// Conty and Kulla's fit of the shadowing of fibres.
static double sheen_curve(double x, double alpha)
{
    const double t = (1 - alpha) * (1 - alpha);
    return mix(21.5473, 25.3245, t) / (1 + mix(3.82987, 3.32435, t) * pow(x, mix(.19823, .16801, t))) +
           mix(-1.97760, -1.27393, t) * x + mix(-4.32054, -4.85967, t);
}

static double sheen_lambda(double cosine, double alpha)
{
    return exp(cosine < .5 ? sheen_curve(cosine, alpha) : 2 * sheen_curve(.5, alpha) - sheen_curve(1 - cosine, alpha));
}

static double sheen_lobe(const struct cosines *c, double roughness)
{
    const double alpha = fmax(roughness, least_sheen_roughness), alpha_g = alpha * alpha;
    const double sin2 = fmax(1 - c->nh * c->nh, 0);
    const double d = (2 + 1 / alpha_g) * pow(sin2, .5 / alpha_g) / (2 * M_PI);
    return d / ((1 + sheen_lambda(c->nv, alpha_g) + sheen_lambda(c->nl, alpha_g)) * 4 * c->nv * c->nl);
}

// Directional albedo of the sheen lobe, from the table.
static double sheen_albedo(const struct gltf_brdf *b, double cosine, double roughness)
{
    const double x = clamp(cosine, 0, 1) * (N_SHEEN_COS - 1), y = clamp(roughness, 0, 1) * (N_SHEEN_ROUGHNESS - 1);
    const int i = x < N_SHEEN_COS - 1 ? (int)x : N_SHEEN_COS - 2, j = y < N_SHEEN_ROUGHNESS - 1 ? (int)y : N_SHEEN_ROUGHNESS - 2;
    return mix(mix(b->sheen_e[j][i], b->sheen_e[j][i + 1], x - i), mix(b->sheen_e[j + 1][i], b->sheen_e[j + 1][i + 1], x - i),
               y - j);
}

static void find_sheen(struct sheen *out, const struct gltf_brdf *b, const struct cosines *c, double roughness)
{
    out->lobe = sheen_lobe(c, roughness);
    out->taken = fmax(sheen_albedo(b, c->nv, roughness), sheen_albedo(b, c->nl, roughness));
}

// f_k = constant_k + diffuse_k C_k + metal_k C_k: the base colour enters linearly.
struct split {
    double constant[3], diffuse, metal;
};

static void split_eval(const struct gltf_material *m, const struct cosines *c, const struct sheen *at, struct split *out)
{
    const double alpha = m->roughness * m->roughness, alpha_x = mix(alpha, 1, m->anisotropy * m->anisotropy);
    const double gd = ggx(c, alpha_x, alpha), rise = fifth_power_below(c->vh);
    double fr[3];
    for (int k = 0; k < 3; k++) {
        const double f0 = fmin(.04 * m->specular_color[k], 1);
        fr[k] = f0 + (1 - f0) * rise;
    }
    double below = 1, coat = 0;
    if (m->clearcoat > 0) {
        const double a = m->clearcoat_roughness * m->clearcoat_roughness;
        const double share = m->clearcoat * (.04 + .96 * fifth_power_below(c->nv));
        coat = share * ggx(c, a, a);
        below = 1 - share;
    }
    const double sheen_max = max3(m->sheen_color);
    double sheen = 0, scale = below;
    if (sheen_max > 0) {
        sheen = below * at->lobe;
        scale *= fmax(0, 1 - sheen_max * at->taken);
    }
    out->diffuse = scale * (1 - m->metallic) * (1 - m->specular * max3(fr)) / M_PI;
    out->metal = scale * m->metallic * (1 - rise) * gd;
    for (int k = 0; k < 3; k++)
        out->constant[k] = scale * gd * ((1 - m->metallic) * m->specular * fr[k] + m->metallic * rise) +
                           sheen * m->sheen_color[k] + coat;
}

void gltf_brdf_eval(const struct gltf_brdf *b, const struct gltf_material *m, const struct disney_frame *frame,
                    const double l[3], const double v[3], double f[3])
{
    struct cosines c;
    struct sheen at = { 0 };
    struct split s;
    f[0] = f[1] = f[2] = 0;
    if (!find_cosines(&c, frame, l, v))
        return;
    if (max3(m->sheen_color) > 0)
        find_sheen(&at, b, &c, m->sheen_roughness);
    split_eval(m, &c, &at, &s);
    for (int k = 0; k < 3; k++)
        f[k] = s.constant[k] + (s.diffuse + s.metal) * m->base_color[k];
}

// ---- the mappings ---------------------------------------------------------------------------------------------------------

static void find_tint(const double albedo[3], double tint[3])
{
    const double lum = .3 * albedo[0] + .6 * albedo[1] + .1 * albedo[2];
    for (int k = 0; k < 3; k++)
        tint[k] = lum > 0 ? albedo[k] / lum : 1;
}

void gltf_from_lambert(struct gltf_material *out, const double albedo[3])
{
    *out = (struct gltf_material){ .roughness = 1, .specular_color = { 1, 1, 1 } };
    for (int k = 0; k < 3; k++)
        out->base_color[k] = clamp(albedo[k], 0, 1);
}

void gltf_from_disney_by_name(struct gltf_material *out, const struct disney *m)
{
    const double *t = m->theta;
    double tint[3];
    find_tint(m->albedo, tint);
    *out = (struct gltf_material){
        .metallic = t[DISNEY_METALLIC], .roughness = t[DISNEY_ROUGHNESS], .specular = 1,
        .clearcoat = t[DISNEY_CLEARCOAT], .clearcoat_roughness = 1 - t[DISNEY_CLEARCOAT_GLOSS],
        .sheen_roughness = .5, .anisotropy = t[DISNEY_ANISOTROPIC],
    };
    for (int k = 0; k < 3; k++) {
        out->base_color[k] = clamp(m->albedo[k], 0, 1);
        out->specular_color[k] = 2 * t[DISNEY_SPECULAR] * mix(1, tint[k], t[DISNEY_SPECULAR_TINT]);
        out->sheen_color[k] = clamp(t[DISNEY_SHEEN] * mix(1, tint[k], t[DISNEY_SHEEN_TINT]), 0, 1);
    }
}

// Everything but base and specular colour.
static void fit_lobes(const struct gltf_brdf *b, struct gltf_material *out, const struct disney *m, const double tint[3])
{
    const double *t = m->theta;
    const double aspect = sqrt(1 - .9 * t[DISNEY_ANISOTROPIC]), r2 = t[DISNEY_ROUGHNESS] * t[DISNEY_ROUGHNESS];
    const double ax = fmax(.001, r2 / aspect), ay = fmax(.001, r2 * aspect);
    const double gloss = clamp(t[DISNEY_CLEARCOAT_GLOSS], 0, 1) * (N_GLOSS - 1);
    const int i = gloss < N_GLOSS - 1 ? (int)gloss : N_GLOSS - 2;
    *out = (struct gltf_material){
        .metallic = t[DISNEY_METALLIC], .roughness = sqrt(ay), .specular = 1,
        .clearcoat = clamp(t[DISNEY_CLEARCOAT] * mix(b->coat_scale[i], b->coat_scale[i + 1], gloss - i), 0, 1),
        .clearcoat_roughness = mix(b->coat_roughness[i], b->coat_roughness[i + 1], gloss - i),
        .sheen_roughness = b->sheen_roughness,
        .anisotropy = ay < 1 ? sqrt(clamp((ax - ay) / (1 - ay), 0, 1)) : 0,
    };
    for (int k = 0; k < 3; k++) {
        out->base_color[k] = clamp(m->albedo[k], 0, 1);
        out->specular_color[k] = 2 * t[DISNEY_SPECULAR] * mix(1, tint[k], t[DISNEY_SPECULAR_TINT]);
        out->sheen_color[k] = clamp(b->sheen_scale * (1 - t[DISNEY_METALLIC]) * t[DISNEY_SHEEN] *
                                        mix(1, tint[k], t[DISNEY_SHEEN_TINT]), 0, 1);
    }
}

// The base colour by least squares where neither picture clips; S keeps (1-m) .04 S + m C what it is.
static void fit_base_color(const struct gltf_brdf *b, struct gltf_material *out, const double f0[3],
                           const double target[GLTF_N_PAIRS][3])
{
    const double metallic = out->metallic, dielectric = 1 - metallic, *first = out->base_color;
    double sum[3] = { 0 }, square[3] = { 0 };
    if (dielectric < 1e-3)
        return; // no diffuse to speak of
    for (int i = 0; i < GLTF_N_PAIRS; i++) {
        const double nl = b->pair[i].nl;
        struct split s;
        split_eval(out, &b->pair[i], &b->pair_sheen[i], &s);
        for (int k = 0; k < 3; k++) {
            const double rest = s.constant[k] + s.metal * first[k]; // what F0 decides, whoever carries it
            if (M_PI * nl * fmax(target[i][k], rest + s.diffuse * first[k]) >= 1)
                continue;
            sum[k] += nl * nl * s.diffuse * (target[i][k] - rest);
            square[k] += nl * nl * s.diffuse * s.diffuse;
        }
    }
    for (int k = 0; k < 3; k++) {
        double c = square[k] > 0 ? sum[k] / square[k] : first[k];
        if (metallic > 0)
            c = clamp(c, (f0[k] - dielectric * .04 * largest_specular_color) / metallic, f0[k] / metallic);
        c = clamp(c, 0, 1);
        out->base_color[k] = c;
        out->specular_color[k] = clamp((f0[k] - metallic * c) / (dielectric * .04), 0, largest_specular_color);
    }
}

static double shown(double f, double nl)
{
    return clamp(M_PI * f * nl, 0, 1);
}

static double squared_error(const struct gltf_brdf *b, const struct gltf_material *m, const double target[GLTF_N_PAIRS][3])
{
    double sum = 0;
    for (int i = 0; i < GLTF_N_PAIRS; i++) {
        double f[3];
        gltf_brdf_eval(b, m, &axes, b->l[i], b->v[i], f);
        for (int k = 0; k < 3; k++) {
            const double d = shown(f[k], b->l[i][2]) - shown(target[i][k], b->l[i][2]);
            sum += d * d;
        }
    }
    return sum;
}

void gltf_from_disney(const struct gltf_brdf *b, struct gltf_material *out, const struct disney *m,
                      struct gltf_fit_error *error)
{
    double target[GLTF_N_PAIRS][3], tint[3], f0[3];
    struct gltf_material plain;
    for (int i = 0; i < GLTF_N_PAIRS; i++)
        disney_eval(m, &axes, b->l[i], b->v[i], target[i]);
    find_tint(m->albedo, tint);
    fit_lobes(b, out, m, tint);
    for (int k = 0; k < 3; k++)
        f0[k] = (1 - out->metallic) * .04 * out->specular_color[k] + out->metallic * out->base_color[k];
    fit_base_color(b, out, f0, (const double(*)[3])target); // once: S, which it changes, hardly moves the diffuse lobe
    if (!error)
        return;
    gltf_from_disney_by_name(&plain, m);
    error->fitted = squared_error(b, out, (const double(*)[3])target);
    error->by_name = squared_error(b, &plain, (const double(*)[3])target);
}

double gltf_rmse_percent(double sum, double n_materials)
{
    return n_materials > 0 ? 100 * sqrt(sum / (n_materials * GLTF_N_PAIRS * 3)) : 0;
}

// ---- tables ---------------------------------------------------------------------------------------------------------------

static void direction(double out[3], double cosine, double longitude)
{
    const double s = sqrt(fmax(0, 1 - cosine * cosine));
    out[0] = s * cos(longitude), out[1] = s * sin(longitude), out[2] = cosine;
}

// Half of a view's lights spread over the hemisphere by cosine, half about the mirror direction at angles that grow
// geometrically, so that narrow and wide lobes are both looked at.
static void make_pairs(struct gltf_brdf *b)
{
    static const double elevation_deg[N_VIEWS] = { 80, 55, 32, 14 };
    const double golden = M_PI * (3 - sqrt(5));
    int n = 0;
    for (int view = 0; view < N_VIEWS; view++) {
        double v[3];
        direction(v, sin(elevation_deg[view] * M_PI / 180), .4 + golden * view);
        for (int i = 0; n < (view + 1) * N_PER_VIEW; i++) {
            double l[3];
            if (i % 2 == 0) {
                direction(l, sqrt(1 - (i / 2 % (N_PER_VIEW / 2) + .5) / (N_PER_VIEW / 2)), golden * i + view);
            } else {
                double h[3];
                direction(h, cos(.004 * pow(1.28, i / 2 % 24)), golden * i);
                const double vh = vec3_dot(v, h);
                for (int k = 0; k < 3; k++)
                    l[k] = 2 * vh * h[k] - v[k];
                if (l[2] < .02)
                    continue; // below the horizon: the next one
            }
            if (!find_cosines(&b->pair[n], &axes, l, v))
                continue;
            memcpy(b->l[n], l, sizeof(l)), memcpy(b->v[n], v, sizeof(v));
            n++;
        }
    }
}

// E by the midpoint rule over the hemisphere.
static void tabulate_sheen(struct gltf_brdf *b)
{
    enum { RINGS = 24, STEPS = 16 };
    for (int j = 0; j < N_SHEEN_ROUGHNESS; j++)
        for (int i = 0; i < N_SHEEN_COS; i++) {
            double v[3], sum = 0;
            direction(v, fmax(i / (N_SHEEN_COS - 1.), 1e-3), 0);
            for (int ring = 0; ring < RINGS; ring++)
                for (int step = 0; step < STEPS; step++) {
                    double l[3];
                    struct cosines c;
                    direction(l, (ring + .5) / RINGS, M_PI * (step + .5) / STEPS); // both halves are equal
                    if (find_cosines(&c, &axes, l, v))
                        sum += sheen_lobe(&c, j / (N_SHEEN_ROUGHNESS - 1.)) * c.nl;
                }
            b->sheen_e[j][i] = fmin(1, sum * 2 * M_PI / (RINGS * STEPS));
        }
}

// Disney's sheen lobe FH as scale x Charlie + a constant (that the base colour will take over), over all directions: the best
// roughness and its scale. They have little in common: FH rises where light and view graze from opposite sides, Charlie's fibres
// where they graze from one; so little of it is left, and by name far too much would be.
static void fit_sheen(struct gltf_brdf *b)
{
    enum { STEPS = 20 };
    double best = INFINITY;
    for (int r = 1; r <= 10; r++) {
        double ss = 0, s1 = 0, n11 = 0, st = 0, t1 = 0, tt = 0;
        for (int i = 0; i < STEPS * STEPS * STEPS; i++) {
            double l[3], v[3];
            struct cosines c;
            direction(v, (i % STEPS + .5) / STEPS, 0);
            direction(l, (i / STEPS % STEPS + .5) / STEPS, M_PI * (i / STEPS / STEPS + .5) / STEPS);
            if (!find_cosines(&c, &axes, l, v))
                continue;
            const double s = sheen_lobe(&c, .1 * r) * c.nl, t = fifth_power_below(c.vh) * c.nl;
            ss += s * s, s1 += s * c.nl, n11 += c.nl * c.nl, st += s * t, t1 += t * c.nl, tt += t * t;
        }
        const double scale = fmax(0, (st * n11 - t1 * s1) / (ss * n11 - s1 * s1)), constant = (t1 - scale * s1) / n11;
        const double error = tt - scale * (2 * st - scale * ss) - constant * (2 * t1 - constant * n11) + 2 * scale * constant * s1;
        if (error < best)
            best = error, b->sheen_roughness = .1 * r, b->sheen_scale = scale;
    }
}

// A coat over a grey ground, in what is shown: for each gloss the roughness of glTF's lobe and its factor per clearcoat.
static void fit_coats(struct gltf_brdf *b)
{
    const double ground = .18;
    for (int g = 0; g < N_GLOSS; g++) {
        const struct disney with = { .theta = { [DISNEY_CLEARCOAT] = 1, [DISNEY_CLEARCOAT_GLOSS] = g / (N_GLOSS - 1.),
                                                [DISNEY_ROUGHNESS] = 1 } }; // black: the coat beside a Fresnel edge
        const struct disney without = { .theta = { [DISNEY_ROUGHNESS] = 1 } };
        double target[GLTF_N_PAIRS], best = INFINITY;
        for (int i = 0; i < GLTF_N_PAIRS; i++) {
            double f1[3], f0[3];
            disney_eval(&with, &axes, b->l[i], b->v[i], f1);
            disney_eval(&without, &axes, b->l[i], b->v[i], f0);
            target[i] = shown(ground / M_PI + f1[0] - f0[0], b->l[i][2]);
        }
        for (int r = 1; r <= 60; r++)
            for (int s = 1; s <= 60; s++) { // Disney's coat has a weight of .25
                const double roughness = r / 60., scale = .25 * s / 60., a = roughness * roughness;
                double error = 0;
                for (int i = 0; i < GLTF_N_PAIRS && error < best; i++) {
                    const struct cosines *c = &b->pair[i];
                    const double share = scale * (.04 + .96 * fifth_power_below(c->nv));
                    const double d = shown(ground / M_PI + share * ggx(c, a, a), c->nl) - target[i];
                    error += d * d;
                }
                if (error < best)
                    best = error, b->coat_roughness[g] = roughness, b->coat_scale[g] = scale;
            }
    }
}

int gltf_brdf_new(struct gltf_brdf **out)
{
    *out = calloc(1, sizeof(**out));
    if (!*out)
        return -ENOMEM;
    make_pairs(*out);
    tabulate_sheen(*out);
    fit_sheen(*out);
    for (int i = 0; i < GLTF_N_PAIRS; i++)
        find_sheen(&(*out)->pair_sheen[i], *out, &(*out)->pair[i], (*out)->sheen_roughness);
    fit_coats(*out);
    return 0;
}

void gltf_brdf_free(struct gltf_brdf *b)
{
    free(b);
}
