// solver/disney.c - the Disney BRDF and its derivatives, term by term as in SOLVER.md 2, in double precision.
//
// With m metallic, C the base colour, T = C / Lum(C) the tint and k a channel:
//   f_k = (1-m) [C_k/pi mix(Fd, ss, subsurface) + FH sheen mix(1, T_k, sheenTint)] + GD F_k + coat
//   F_k = F0_k (1-FH) + FH;  FH = S(lh);  F0_k = mix(.08 specular mix(1, T_k, specularTint), C_k, m)
//   GD = G D;  coat = .25 clearcoat Gc Fc Dc
//
// Conventions of the derivatives:
// - light: l stays a unit vector, so df/dl is projected on the plane across l, (I - l l^T) df/dl; h = (l+v)/|l+v| follows l. This
//   is what the columns df_*_dl_* of the reference cases hold (their scalar product with l is 0 to 1e-14).
// - normal: n turns and takes x and y along by the smallest rotation, so that the frame stays orthonormal: for dn across n,
//   dx = -<x,dn> n, dy = -<y,dn> n. The result lies across n.
// - a clamp has derivative 0 where it holds: alpha at .001 (its roughness and anisotropic), S(u) outside 0 <= u <= 1.
// - black albedo: T = 1 and dT/dC = 0 (the tint has no limit there; the one-sided derivatives do not exist).
#include "solver/disney.h"

#include "solver/vec3.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

const char *const disney_parameter_names[DISNEY_N] = {
    "metallic",    "subsurface", "specular",  "roughness", "specularTint",
    "anisotropic", "sheen",      "sheenTint", "clearcoat", "clearcoatGloss",
};

const char *disney_variant_name(enum disney_variant variant)
{
    return variant == DISNEY_2012 ? "2012" : "2017";
}

static const double luminance[3] = { .3, .6, .1 };

// A number with its derivatives by the quantities that the directions enter with.
enum { NL, NV, LH, NH, HX, HY, LX, LY, VX, VY, N_DOTS };
struct term {
    double value, d[N_DOTS];
};

struct terms {
    struct term base;  // mix(Fd, ss, subsurface) / pi
    struct term fh;    // FH
    struct term gd;    // G D
    struct term coat;  // coat / clearcoat
    double base_subsurface, base_roughness, gd_roughness, gd_anisotropic, coat_gloss;
    double h[3], length; // of l + v
};

static double mix(double a, double b, double t)
{
    return a + t * (b - a);
}

// S(u) = (1-u)^5 and its derivative, u clamped to [0,1].
static double schlick(double u, double *d)
{
    const double m = 1 - u;
    if (m <= 0 || m > 1) {
        *d = 0;
        return m <= 0 ? 0 : 1;
    }
    *d = -5 * m * m * m * m;
    return m * m * m * m * m;
}

// Smith's g1(c, a) = 1 / (c + sqrt(a^2 + c^2 - a^2 c^2)) and its derivatives by c and a.
static double smith(double c, double a, double *d_c, double *d_a)
{
    const double root = sqrt(a * a + c * c - a * a * c * c), g = 1 / (c + root);
    *d_c = -g * g * (1 + c * (1 - a * a) / root);
    *d_a = -g * g * a * (1 - c * c) / root;
    return g;
}

// Its anisotropic form 1 / (c + sqrt((x ax)^2 + (y ay)^2 + c^2)).
struct smith {
    double value, d_c, d_x, d_y, d_ax, d_ay;
};
static struct smith smith_anisotropic(double c, double x, double y, double ax, double ay)
{
    const double root = sqrt(x * ax * x * ax + y * ay * y * ay + c * c), g = 1 / (c + root);
    const double s = -g * g / root;
    return (struct smith){ .value = g, .d_c = -g * g + s * c, .d_x = s * x * ax * ax,
                           .d_y = s * y * ay * ay, .d_ax = s * x * x * ax, .d_ay = s * y * y * ay };
}

static void diffuse_terms(struct terms *t, const struct disney *m, double nl, double nv, double lh)
{
    const double r = m->theta[DISNEY_ROUGHNESS], subsurface = m->theta[DISNEY_SUBSURFACE];
    double dsl, dsv;
    const double sl = schlick(nl, &dsl), sv = schlick(nv, &dsv);

    const double e = 2 * r * lh * lh - .5; // F90 - 1
    const double fd = (1 + e * sl) * (1 + e * sv), fd_e = sl * (1 + e * sv) + sv * (1 + e * sl);
    const double u = r * lh * lh - 1;
    const double fss = (1 + u * sl) * (1 + u * sv), fss_u = sl * (1 + u * sv) + sv * (1 + u * sl);
    const double k = 1 / (nl + nv) - .5, dk = -1 / ((nl + nv) * (nl + nv));
    const double ss = 1.25 * (fss * k + .5);

    t->base.value = mix(fd, ss, subsurface) / M_PI;
    t->base_subsurface = (ss - fd) / M_PI;
    t->base_roughness = mix(fd_e * 2 * lh * lh, 1.25 * k * fss_u * lh * lh, subsurface) / M_PI;
    t->base.d[NL] = mix(e * dsl * (1 + e * sv),
                        1.25 * (u * dsl * (1 + u * sv) * k + fss * dk), subsurface) / M_PI;
    t->base.d[NV] = mix(e * dsv * (1 + e * sl),
                        1.25 * (u * dsv * (1 + u * sl) * k + fss * dk), subsurface) / M_PI;
    t->base.d[LH] = mix(fd_e * 4 * r * lh, 1.25 * k * fss_u * 2 * r * lh, subsurface) / M_PI;
    t->fh.value = schlick(lh, &t->fh.d[LH]);
}

static void specular_terms(struct terms *t, const struct disney *m, const struct disney_frame *frame,
                           const double l[3], const double v[3], double nl, double nv)
{
    const double r = m->theta[DISNEY_ROUGHNESS];
    const double aspect = sqrt(1 - .9 * m->theta[DISNEY_ANISOTROPIC]);
    const double least = .001;
    double ax = r * r / aspect, ax_r = 2 * r / aspect, ax_an = .45 * r * r / (aspect * aspect * aspect);
    double ay = r * r * aspect, ay_r = 2 * r * aspect, ay_an = -.45 * r * r / aspect;
    if (ax <= least)
        ax = least, ax_r = 0, ax_an = 0;
    if (ay <= least)
        ay = least, ay_r = 0, ay_an = 0;

    const double hx = vec3_dot(t->h, frame->x), hy = vec3_dot(t->h, frame->y),
                 nh = vec3_dot(t->h, frame->n);
    const double px = hx / ax, py = hy / ay, q = px * px + py * py + nh * nh;
    const double d = 1 / (M_PI * ax * ay * q * q);
    // Logarithmic derivatives of D, then of G.
    double by_ax = -1 / ax + 4 * px * px / (ax * q), by_ay = -1 / ay + 4 * py * py / (ay * q), by_r = 0;
    double by[N_DOTS] = { [HX] = -4 * px / (ax * q), [HY] = -4 * py / (ay * q), [NH] = -4 * nh / q };
    double g;
    if (m->variant == DISNEY_2012) {
        const double root = .5 + .5 * r;
        double gl_a, gv_a, gl_c, gv_c;
        const double gl = smith(nl, root * root, &gl_c, &gl_a), gv = smith(nv, root * root, &gv_c, &gv_a);
        g = gl * gv;
        by[NL] = gl_c / gl, by[NV] = gv_c / gv;
        by_r = (gl_a / gl + gv_a / gv) * root;
    } else {
        const struct smith gl = smith_anisotropic(nl, vec3_dot(l, frame->x), vec3_dot(l, frame->y), ax, ay);
        const struct smith gv = smith_anisotropic(nv, vec3_dot(v, frame->x), vec3_dot(v, frame->y), ax, ay);
        g = gl.value * gv.value;
        by[NL] = gl.d_c / gl.value, by[NV] = gv.d_c / gv.value;
        by[LX] = gl.d_x / gl.value, by[LY] = gl.d_y / gl.value;
        by[VX] = gv.d_x / gv.value, by[VY] = gv.d_y / gv.value;
        by_ax += gl.d_ax / gl.value + gv.d_ax / gv.value;
        by_ay += gl.d_ay / gl.value + gv.d_ay / gv.value;
    }
    t->gd.value = g * d;
    for (int i = 0; i < N_DOTS; i++)
        t->gd.d[i] = g * d * by[i];
    t->gd_roughness = g * d * (by_ax * ax_r + by_ay * ay_r + by_r);
    t->gd_anisotropic = g * d * (by_ax * ax_an + by_ay * ay_an);

    const double a = mix(.1, .001, m->theta[DISNEY_CLEARCOAT_GLOSS]), a_gloss = .001 - .1;
    const double b = hx * hx + hy * hy + a * a * nh * nh, log_a2 = log(a * a);
    const double dc = (a * a - 1) / (M_PI * log_a2 * b);
    const double dc_a = dc * (2 * a / (a * a - 1) - 2 / (a * log_a2) - 2 * a * nh * nh / b);
    double gl_c, gv_c, unused;
    const double gl = smith(nl, .25, &gl_c, &unused), gv = smith(nv, .25, &gv_c, &unused);
    const double fc = .04 + .96 * t->fh.value;
    t->coat.value = .25 * gl * gv * fc * dc;
    t->coat.d[NL] = .25 * gl_c * gv * fc * dc;
    t->coat.d[NV] = .25 * gl * gv_c * fc * dc;
    t->coat.d[LH] = .25 * gl * gv * .96 * t->fh.d[LH] * dc;
    t->coat.d[NH] = t->coat.value * -2 * (a * a - 1) * nh / b;
    t->coat_gloss = .25 * gl * gv * fc * dc_a * a_gloss;
}

// False below the horizon. Above it |l+v| >= nl + nv > 0, so h exists.
static bool find_terms(struct terms *t, const struct disney *m, const struct disney_frame *frame,
                       const double l[3], const double v[3])
{
    const double nl = vec3_dot(frame->n, l), nv = vec3_dot(frame->n, v);
    if (!(nl > 0 && nv > 0))
        return false;
    memset(t, 0, sizeof(*t));
    vec3_add_scaled(t->h, l, 1, v);
    t->length = vec3_normalise(t->h);
    diffuse_terms(t, m, nl, nv, vec3_dot(l, t->h));
    specular_terms(t, m, frame, l, v, nl, nv);
    return true;
}

static double find_tint(const double albedo[3], double tint[3])
{
    const double lum = vec3_dot(luminance, albedo);
    for (int k = 0; k < 3; k++)
        tint[k] = lum > 0 ? albedo[k] / lum : 1;
    return lum;
}

void disney_eval(const struct disney *m, const struct disney_frame *frame, const double l[3],
                 const double v[3], double f[3])
{
    struct terms t;
    f[0] = f[1] = f[2] = 0;
    if (!find_terms(&t, m, frame, l, v))
        return;
    const double *theta = m->theta;
    double tint[3];
    find_tint(m->albedo, tint);
    for (int k = 0; k < 3; k++) {
        const double f0 = mix(.08 * theta[DISNEY_SPECULAR] * mix(1, tint[k], theta[DISNEY_SPECULAR_TINT]),
                              m->albedo[k], theta[DISNEY_METALLIC]);
        const double sheen = theta[DISNEY_SHEEN] * mix(1, tint[k], theta[DISNEY_SHEEN_TINT]);
        f[k] = (1 - theta[DISNEY_METALLIC]) * (m->albedo[k] * t.base.value + t.fh.value * sheen) +
               t.gd.value * (f0 + (1 - f0) * t.fh.value) + theta[DISNEY_CLEARCOAT] * t.coat.value;
    }
}

void disney_eval_gradient(const struct disney *m, const struct disney_frame *frame, const double l[3],
                          const double v[3], struct disney_gradient *out)
{
    struct terms t;
    memset(out, 0, sizeof(*out));
    if (!find_terms(&t, m, frame, l, v))
        return;
    const double *theta = m->theta, *albedo = m->albedo;
    const double metallic = theta[DISNEY_METALLIC], dielectric = 1 - metallic;
    const double specular = .08 * theta[DISNEY_SPECULAR], specular_tint = theta[DISNEY_SPECULAR_TINT];
    const double sheen = theta[DISNEY_SHEEN], sheen_tint = theta[DISNEY_SHEEN_TINT];
    const double fh = t.fh.value, gd = t.gd.value;
    double tint[3];
    const double lum = find_tint(albedo, tint);
    const double *const h = t.h, *const n = frame->n;

    for (int k = 0; k < 3; k++) {
        const double f0_dielectric = specular * mix(1, tint[k], specular_tint);
        const double f0 = mix(f0_dielectric, albedo[k], metallic), f = f0 + (1 - f0) * fh;
        const double sheen_colour = mix(1, tint[k], sheen_tint);
        const double diffuse = albedo[k] * t.base.value + fh * sheen * sheen_colour;
        out->f[k] = dielectric * diffuse + gd * f + theta[DISNEY_CLEARCOAT] * t.coat.value;

        double *d = out->theta[k];
        d[DISNEY_METALLIC] = -diffuse + gd * (1 - fh) * (albedo[k] - f0_dielectric);
        d[DISNEY_SUBSURFACE] = dielectric * albedo[k] * t.base_subsurface;
        d[DISNEY_SPECULAR] = gd * (1 - fh) * dielectric * .08 * mix(1, tint[k], specular_tint);
        d[DISNEY_ROUGHNESS] = dielectric * albedo[k] * t.base_roughness + f * t.gd_roughness;
        d[DISNEY_SPECULAR_TINT] = gd * (1 - fh) * dielectric * specular * (tint[k] - 1);
        d[DISNEY_ANISOTROPIC] = f * t.gd_anisotropic;
        d[DISNEY_SHEEN] = dielectric * fh * sheen_colour;
        d[DISNEY_SHEEN_TINT] = dielectric * fh * sheen * (tint[k] - 1);
        d[DISNEY_CLEARCOAT] = t.coat.value;
        d[DISNEY_CLEARCOAT_GLOSS] = theta[DISNEY_CLEARCOAT] * t.coat_gloss;

        for (int j = 0; j < 3; j++) {
            const double same = j == k;
            const double tint_j = lum > 0 ? (same - tint[k] * luminance[j]) / lum : 0;
            out->albedo[k][j] =
                dielectric * (t.base.value * same + fh * sheen * sheen_tint * tint_j) +
                gd * (1 - fh) * (dielectric * specular * specular_tint * tint_j + metallic * same);
        }

        double by[N_DOTS];
        for (int i = 0; i < N_DOTS; i++)
            by[i] = dielectric * (albedo[k] * t.base.d[i] + sheen * sheen_colour * t.fh.d[i]) +
                    f * t.gd.d[i] + gd * (1 - f0) * t.fh.d[i] + theta[DISNEY_CLEARCOAT] * t.coat.d[i];
        // Through h: d<a,h>/dl = (a - h <a,h>)/|l+v|, and for lh also h itself.
        double through_h[3];
        for (int c = 0; c < 3; c++)
            through_h[c] = by[LH] * l[c] + by[NH] * n[c] + by[HX] * frame->x[c] + by[HY] * frame->y[c];
        const double along_h = vec3_dot(through_h, h);
        // The tangents follow n: d<a,x> = -<x,dn> <n,a>.
        const double nh = vec3_dot(n, h), nl = vec3_dot(n, l), nv = vec3_dot(n, v);
        const double by_x = by[HX] * nh + by[LX] * nl + by[VX] * nv,
                     by_y = by[HY] * nh + by[LY] * nl + by[VY] * nv;
        for (int c = 0; c < 3; c++) {
            out->light[k][c] = by[NL] * n[c] + by[LX] * frame->x[c] + by[LY] * frame->y[c] +
                               by[LH] * h[c] + (through_h[c] - along_h * h[c]) / t.length;
            out->normal[k][c] = by[NL] * l[c] + by[NV] * v[c] + by[NH] * h[c] - by_x * frame->x[c] -
                                by_y * frame->y[c];
        }
        vec3_add_scaled(out->light[k], out->light[k], -vec3_dot(out->light[k], l), l);
        vec3_add_scaled(out->normal[k], out->normal[k], -vec3_dot(out->normal[k], n), n);
    }
}
