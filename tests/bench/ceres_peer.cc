// tests/bench/ceres_peer.cc - the same residual differentiated by Ceres: automatic derivatives of a straight C++ transcription of
// SOLVER.md 2 with ceres::Jet<double, 13> (ten parameters and the albedo), lights gathered per sample as Eqs. 1-5 say.
//
// Built only where libceres-dev is; bench_kernels.c calls it and compares. Three forms, by how much a user of Ceres thinks:
//   plain    one templated function f(frame, v, l; theta, albedo) serves every problem, also those where lights move, so directions are
//            of its scalar type too (with derivatives that are all zero here)
//   fixed    the lights' geometry is plain double, as it does not depend on the thirteen unknowns
//   careful  and what depends on the sample only (tint, F0, alphas, the logarithm, the view's masking) is found once
// In all three, lights below the horizon give 0 at once.
#include <ceres/jet.h>

#include <cmath>

namespace
{
using Jet = ceres::Jet<double, 13>;

// G is the type of everything geometric, T that of the material.
template <class G> struct Vec {
    G x, y, z;
};
template <class G> G dot(const Vec<G> &a, const Vec<G> &b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class G> Vec<G> scaled(const Vec<G> &a, const G &s)
{
    return {a.x * s, a.y * s, a.z * s};
}
template <class G> G schlick(const G &u)
{
    const G m = 1. - u, m2 = m * m;
    return m > 0. ? G(m2 * m2 * m) : G(0.);
}
template <class T> T mix(const T &a, const T &b, const T &t)
{
    return a + t * (b - a);
}

// What depends on the material only.
template <class T> struct Material {
    T metallic, subsurface, roughness, sheen, clearcoat, ax, ay, dc_scale, a2;
    T albedo[3], f0[3], sheen_colour[3];
};

template <class T> Material<T> prepare(const T theta[10], const T albedo[3])
{
    using std::log;
    using std::sqrt;
    Material<T> m;
    m.metallic = theta[0], m.subsurface = theta[1], m.roughness = theta[3], m.sheen = theta[6], m.clearcoat = theta[8];
    const T lum = .3 * albedo[0] + .6 * albedo[1] + .1 * albedo[2];
    for (int c = 0; c < 3; c++) {
        const T tint = lum > 0. ? albedo[c] / lum : T(1.);
        m.albedo[c] = albedo[c];
        m.f0[c] = mix(T(.08 * theta[2] * mix(T(1.), tint, theta[4])), albedo[c], theta[0]);
        m.sheen_colour[c] = mix(T(1.), tint, theta[7]);
    }
    const T aspect = sqrt(1. - .9 * theta[5]), r2 = theta[3] * theta[3];
    const T ax = r2 / aspect, ay = r2 * aspect;
    m.ax = ax > .001 ? ax : T(.001), m.ay = ay > .001 ? ay : T(.001);
    const T a = .1 - .099 * theta[9];
    m.a2 = a * a;
    m.dc_scale = (m.a2 - 1.) / (M_PI * log(m.a2));
    return m;
}

template <class T, class G> T smith(const G &n, const G &x, const G &y, const T &ax, const T &ay)
{
    using std::sqrt;
    const T wx = x * ax, wy = y * ay;
    return 1. / (n + sqrt(wx * wx + wy * wy + n * n));
}
template <class G> G smith_coat(const G &n)
{
    using std::sqrt;
    return 1. / (n + sqrt(.0625 + .9375 * n * n));
}

template <class T, class G>
void add_light(T L[3], const Material<T> &m, const T &gv, const G &gv_coat, const Vec<G> frame[3], const Vec<G> &l, const Vec<G> &v,
               const G &nl, const G &nv, const G w[3])
{
    using std::sqrt;
    const Vec<G> s = {l.x + v.x, l.y + v.y, l.z + v.z}, h = scaled(s, G(1. / sqrt(dot(s, s))));
    const G hx = dot(frame[0], h), hy = dot(frame[1], h), nh = dot(frame[2], h), lh = dot(l, h);
    const G fh = schlick(lh), sl = schlick(nl), sv = schlick(nv);
    const T e = 2. * lh * lh * m.roughness - .5, u = lh * lh * m.roughness - 1.;
    const T fd = (1. + e * sl) * (1. + e * sv);
    const T ss = 1.25 * ((1. + u * sl) * (1. + u * sv) * (1. / (nl + nv) - .5) + .5);
    const T px = hx / m.ax, py = hy / m.ay, q = px * px + py * py + nh * nh;
    const T gd = gv * smith(nl, dot(frame[0], l), dot(frame[1], l), m.ax, m.ay) / (M_PI * m.ax * m.ay * q * q);
    const T dc = m.dc_scale / (1. + (m.a2 - 1.) * nh * nh);
    const T coat = .25 * smith_coat(nl) * gv_coat * (.04 + .96 * fh) * m.clearcoat * dc;
    const T base = mix(fd, ss, m.subsurface) / M_PI;
    for (int c = 0; c < 3; c++) {
        const T fresnel = m.f0[c] + (1. - m.f0[c]) * fh;
        const T f = (base * m.albedo[c] + fh * m.sheen * m.sheen_colour[c]) * (1. - m.metallic) + gd * fresnel + coat;
        L[c] += f * w[c];
    }
}
template <class G>
void sample(Jet L[3], bool careful, const double (*lights)[7], int n, const double centre[3], const double position[3],
            const double frame_rows[9], const double view[3], const Jet theta[10], const Jet albedo[3])
{
    using std::sqrt;
    Vec<G> frame[3];
    for (int i = 0; i < 3; i++)
        frame[i] = {G(frame_rows[3 * i]), G(frame_rows[3 * i + 1]), G(frame_rows[3 * i + 2])};
    const Vec<G> v = {G(view[0]), G(view[1]), G(view[2])};
    const G nv = dot(frame[2], v);
    if (!(nv > 0.))
        return;
    Material<Jet> m;
    Jet gv;
    G gv_coat;
    const auto prepare_sample = [&]() {
        m = prepare(theta, albedo);
        gv = smith(nv, dot(frame[0], v), dot(frame[1], v), m.ax, m.ay);
        gv_coat = smith_coat(nv);
    };
    if (careful)
        prepare_sample();
    for (int i = 0; i < n; i++) {
        const double *row = lights[i];
        const Vec<G> d = {G(row[0]), G(row[1]), G(row[2])};
        const Vec<G> u = {d.x + row[3] * (centre[0] - position[0]), d.y + row[3] * (centre[1] - position[1]),
                          d.z + row[3] * (centre[2] - position[2])};
        if (!(dot(frame[2], u) > 0. && dot(u, d) > 0.))
            continue;
        const G length = sqrt(dot(u, u)), facing = dot(u, d);
        const Vec<G> l = scaled(u, G(1. / length));
        const G nl = dot(frame[2], l), weight = facing / (length * length * length) * nl;
        if (!careful)
            prepare_sample();
        const G w[3] = {weight * row[4], weight * row[5], weight * row[6]};
        add_light(L, m, gv, gv_coat, frame, l, v, nl, nv, w);
    }
}
} // namespace

// One sample: L[3] and its Jacobian [3][13] (theta, albedo). form: 0 plain, 1 fixed, 2 careful. lights: n rows of dx dy dz q cr cg cb;
// frame: x, y, n rows.
extern "C" void ceres_peer_jacobian(double L_out[3], double jacobian[3][13], int form, const double (*lights)[7], int n,
                                    const double centre[3], const double position[3], const double frame_rows[9],
                                    const double view[3], const double theta[10], const double albedo[3])
{
    Jet theta_jet[10], albedo_jet[3], L[3];
    for (int i = 0; i < 10; i++)
        theta_jet[i] = Jet(theta[i], i);
    for (int c = 0; c < 3; c++)
        albedo_jet[c] = Jet(albedo[c], 10 + c), L[c] = Jet(0.);
    if (form == 0)
        sample<Jet>(L, false, lights, n, centre, position, frame_rows, view, theta_jet, albedo_jet);
    else
        sample<double>(L, form == 2, lights, n, centre, position, frame_rows, view, theta_jet, albedo_jet);
    for (int c = 0; c < 3; c++) {
        L_out[c] = L[c].a;
        for (int i = 0; i < 13; i++)
            jacobian[c][i] = L[c].v[i];
    }
}
