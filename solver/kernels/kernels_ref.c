// solver/kernels/kernels_ref.c - Eqs. 1-5 as they stand, in double and through disney.c; slow, and the yardstick.
#include "solver/kernels/kernels_table.h"
#include "solver/vec3.h"

#include <string.h>

// Eqs. 1-4 for light i: unit direction and max(<u,d>,0)/|u|^3 with u = d + q (centre - p). False: nothing arrives.
static bool light_at(const struct light_arrays *a, int i, const struct surface_point *s, double l[3], double *weight)
{
    const double d[3] = { (double)a->dx[i], (double)a->dy[i], (double)a->dz[i] };
    for (int c = 0; c < 3; c++)
        l[c] = d[c] + (double)a->q[i] * ((double)a->centre_m[c] - (double)s->position_m[c]);
    const double facing = vec3_dot(l, d), length = vec3_normalise(l);
    if (!(facing > 0))
        return false;
    *weight = facing / (length * length * length);
    return true;
}

static double visibility(const uint16_t *visible, const uint8_t *soft, int i)
{
    if (visible && !(visible[i / 16] >> i % 16 & 1))
        return 0;
    return soft ? soft[i] / 255. : 1;
}

static void to_double(double out[3], const float in[3])
{
    for (int c = 0; c < 3; c++)
        out[c] = (double)in[c];
}

static struct disney_frame frame_of(const struct surface_point *s)
{
    struct disney_frame frame;
    to_double(frame.n, s->normal), to_double(frame.x, s->tangent), to_double(frame.y, s->bitangent);
    return frame;
}

static struct disney material_of(const struct shade_material *m)
{
    struct disney out = { .variant = m->variant };
    for (int i = 0; i < DISNEY_N; i++)
        out.theta[i] = (double)m->theta[i];
    to_double(out.albedo, m->albedo);
    return out;
}

static void gather(struct lit *out, const struct light_arrays *a, const struct surface_point *s,
                   const uint16_t *visible, const uint8_t *soft)
{
    const struct disney_frame frame = frame_of(s);
    int n = 0;
    for (int i = 0; i < a->n; i++) {
        double l[3], w;
        if (!light_at(a, i, s, l, &w))
            continue;
        const double d[3] = { (double)a->dx[i], (double)a->dy[i], (double)a->dz[i] };
        const double nl = vec3_dot(frame.n, l);
        w *= nl * visibility(visible, soft, i);
        if (!(w > 0))
            continue;
        out->facing[n] = (float)fmax(vec3_dot(l, d), 1e-10);
        const double lx = vec3_dot(frame.x, l), ly = vec3_dot(frame.y, l);
        out->lx[n] = (float)lx, out->lx_rest[n] = (float)(lx - (double)out->lx[n]);
        out->ly[n] = (float)ly, out->ly_rest[n] = (float)(ly - (double)out->ly[n]);
        out->nl[n] = (float)fmax(nl, 1e-10);
        out->sl[n] = (float)pow(nl < 1 ? 1 - nl : 0, 5);
        out->gc[n] = (float)(1 / (nl + sqrt(.0625 + .9375 * nl * nl)));
        out->wr[n] = (float)(w * (double)a->cr[i]);
        out->wg[n] = (float)(w * (double)a->cg[i]);
        out->wb[n] = (float)(w * (double)a->cb[i]);
        out->index[n] = i;
        n++;
    }
    out->n = n;
    for (; n % KERNEL_WIDTH; n++) {
        out->lx[n] = out->ly[n] = out->lx_rest[n] = out->ly_rest[n] = out->sl[n] = out->wr[n] = out->wg[n] = out->wb[n] = 0;
        out->nl[n] = out->gc[n] = out->facing[n] = 1;
        out->index[n] = 0;
    }
}

static const struct disney_frame own_frame = { .n = { 0, 0, 1 }, .x = { 1, 0, 0 }, .y = { 0, 1, 0 } };

static void to_own_frame(double out[3], const struct surface_point *s, const float v[3])
{
    const struct disney_frame frame = frame_of(s);
    double d[3];
    to_double(d, v);
    out[0] = vec3_dot(frame.x, d), out[1] = vec3_dot(frame.y, d), out[2] = vec3_dot(frame.n, d);
}

static void lit_direction(double l[3], const struct lit *lit, int i)
{
    l[0] = (double)lit->lx[i] + (double)lit->lx_rest[i];
    l[1] = (double)lit->ly[i] + (double)lit->ly_rest[i];
    l[2] = (double)lit->nl[i];
}

static void shade(float L[3], const struct lit *lit, const struct surface_point *s, const float v[3],
                  const struct shade_material *m)
{
    const struct disney material = material_of(m);
    double view[3], sum[3] = { 0 };
    to_own_frame(view, s, v);
    for (int i = 0; i < lit->n; i++) {
        double l[3];
        lit_direction(l, lit, i);
        double f[3];
        disney_eval(&material, &own_frame, l, view, f);
        sum[0] += f[0] * (double)lit->wr[i], sum[1] += f[1] * (double)lit->wg[i], sum[2] += f[2] * (double)lit->wb[i];
    }
    for (int c = 0; c < 3; c++)
        L[c] = (float)sum[c];
}

struct sums {
    double L[3], theta[3][DISNEY_N], albedo[3][3], own[3];
};

// f's derivative by albedo of the same channel at fixed tint T: f's own where nothing has the tint's colour.
static void own_albedo(double own[3], const struct disney *material, const struct disney_frame *frame, const double l[3],
                       const double v[3])
{
    struct disney untinted = *material;
    struct disney_gradient g;
    untinted.theta[DISNEY_SPECULAR_TINT] = untinted.theta[DISNEY_SHEEN_TINT] = 0;
    disney_eval_gradient(&untinted, frame, l, v, &g);
    for (int c = 0; c < 3; c++)
        own[c] = g.albedo[c][c];
}

static void add_light(struct sums *sum, const struct disney *material, const struct disney_frame *frame,
                      const double l[3], const double v[3], const double w[3])
{
    struct disney_gradient g;
    double own[3];
    disney_eval_gradient(material, frame, l, v, &g);
    own_albedo(own, material, frame, l, v);
    for (int c = 0; c < 3; c++) {
        sum->L[c] += g.f[c] * w[c];
        sum->own[c] += own[c] * w[c];
        for (int i = 0; i < DISNEY_N; i++)
            sum->theta[c][i] += g.theta[c][i] * w[c];
        for (int i = 0; i < 3; i++)
            sum->albedo[c][i] += g.albedo[c][i] * w[c];
    }
}

static void round_sums(struct shade_jacobian *out, const struct sums *sum)
{
    for (int c = 0; c < 3; c++) {
        out->L[c] = (float)sum->L[c];
        out->own[c] = (float)sum->own[c];
        for (int i = 0; i < DISNEY_N; i++)
            out->theta[c][i] = (float)sum->theta[c][i];
        for (int i = 0; i < 3; i++)
            out->albedo[c][i] = (float)sum->albedo[c][i];
    }
}

static void shade_jacobian(struct shade_jacobian *out, const struct lit *lit, const struct surface_point *s,
                           const float v[3], const struct shade_material *m)
{
    const struct disney material = material_of(m);
    double view[3];
    struct sums sum = { 0 };
    to_own_frame(view, s, v);
    for (int i = 0; i < lit->n; i++) {
        double l[3];
        lit_direction(l, lit, i);
        const double w[3] = { (double)lit->wr[i], (double)lit->wg[i], (double)lit->wb[i] };
        add_light(&sum, &material, &own_frame, l, view, w);
    }
    round_sums(out, &sum);
}

static void shade_jacobian_views(struct shade_jacobian *out, int n_views, struct lit *lit, const struct surface_point *s,
                                 const float (*v)[3], const struct shade_material *m)
{
    for (int i = 0; i < n_views; i++)
        shade_jacobian(&out[i], lit, s, v[i], m);
}

static void shade_affine(float constant[3], float own[3], const struct lit *lit, const struct surface_point *s,
                         const float v[3], const struct shade_material *m)
{
    const struct disney material = material_of(m);
    double view[3], sum_constant[3] = { 0 }, sum_own[3] = { 0 };
    to_own_frame(view, s, v);
    for (int i = 0; i < lit->n; i++) {
        const double w[3] = { (double)lit->wr[i], (double)lit->wg[i], (double)lit->wb[i] };
        double l[3], f[3], f_own[3];
        lit_direction(l, lit, i);
        disney_eval(&material, &own_frame, l, view, f);
        own_albedo(f_own, &material, &own_frame, l, view);
        for (int c = 0; c < 3; c++) {
            sum_constant[c] += (f[c] - f_own[c] * material.albedo[c]) * w[c];
            sum_own[c] += f_own[c] * w[c];
        }
    }
    for (int c = 0; c < 3; c++)
        constant[c] = (float)sum_constant[c], own[c] = (float)sum_own[c];
}

static void brute_jacobian(struct shade_jacobian *out, const struct light_arrays *a, const struct surface_point *s,
                           const float v[3], const struct shade_material *m)
{
    const struct disney material = material_of(m);
    const struct disney_frame frame = frame_of(s);
    double view[3];
    struct sums sum = { 0 };
    to_double(view, v);
    for (int i = 0; i < a->n; i++) {
        double l[3], w;
        if (!light_at(a, i, s, l, &w))
            continue;
        w *= fmax(vec3_dot(frame.n, l), 0);
        const double weights[3] = { w * (double)a->cr[i], w * (double)a->cg[i], w * (double)a->cb[i] };
        add_light(&sum, &material, &frame, l, view, weights);
    }
    round_sums(out, &sum);
}

static void irradiance(float E[3], const struct light_arrays *a, const struct surface_point *s,
                       const uint16_t *visible)
{
    const struct disney_frame frame = frame_of(s);
    double sum[3] = { 0 };
    for (int i = 0; i < a->n; i++) {
        double l[3], w;
        if (!light_at(a, i, s, l, &w))
            continue;
        w *= fmax(vec3_dot(frame.n, l), 0) * visibility(visible, 0, i);
        sum[0] += w * (double)a->cr[i], sum[1] += w * (double)a->cg[i], sum[2] += w * (double)a->cb[i];
    }
    for (int c = 0; c < 3; c++)
        E[c] = (float)sum[c];
}

// d(cosine f V C g) by the set-up for one light: VC[c] per channel, F[c] = cosine x f and F_l[c] its gradient by l.
static void add_setup(struct shade_setup *setup, double centre[3][3], double rotation[3][3], int i,
                      const struct light_at_gradient *g, const double VC[3], const double F[3], const double F_l[3][3])
{
    for (int c = 0; c < 3; c++) {
        double by_centre[3], by_rotation[3];
        mat3_tmul_vec(by_centre, g->l_centre, F_l[c]), mat3_tmul_vec(by_rotation, g->l_rotation, F_l[c]);
        for (int j = 0; j < 3; j++) {
            centre[c][j] += VC[c] * (g->at.weight * by_centre[j] + g->weight_centre[j] * F[c]);
            rotation[c][j] += VC[c] * (g->at.weight * by_rotation[j] + g->weight_rotation[j] * F[c]);
        }
        setup->inverse_distance[c][i] = (float)(VC[c] * (g->at.weight * vec3_dot(F_l[c], g->l_inverse_distance) +
                                                         g->weight_inverse_distance * F[c]));
    }
}

static void clear_setup(struct shade_setup *setup, const struct light_arrays *a)
{
    for (int c = 0; c < 3; c++)
        memset(setup->inverse_distance[c], 0, (size_t)a->n_padded * sizeof(float));
}

static void round_setup(struct shade_setup *setup, double centre[3][3], double rotation[3][3])
{
    for (int c = 0; c < 3; c++)
        for (int j = 0; j < 3; j++)
            setup->centre[c][j] = (float)centre[c][j], setup->rotation[c][j] = (float)rotation[c][j];
}

// Light i as lights.c takes it: d is R dh already.
static void light_gradient(struct light_at_gradient *g, const struct light_arrays *a, int i, const struct surface_point *s)
{
    double d[1][3] = { { (double)a->dx[i], (double)a->dy[i], (double)a->dz[i] } }, q = (double)a->q[i], position[3];
    struct lights one = { .n = 1, .dir_probe = d, .inverse_distance = &q, .world_from_probe = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
    to_double(one.centre_m, a->centre_m), to_double(position, s->position_m);
    light_at_point_gradient(&one, 0, position, g);
}

static void shade_setup(struct shade_jacobian *out, struct shade_setup *setup, const struct lit *lit,
                        const struct light_arrays *a, const struct surface_point *s, const float v[3],
                        const struct shade_material *m)
{
    const struct disney material = material_of(m);
    const struct disney_frame frame = frame_of(s);
    double view[3], centre[3][3] = { { 0 } }, rotation[3][3] = { { 0 } };
    to_double(view, v);
    shade_jacobian(out, lit, s, v, m);
    clear_setup(setup, a);
    for (int i = 0; i < lit->n; i++) {
        struct light_at_gradient g;
        struct disney_gradient f;
        light_gradient(&g, a, lit->index[i], s);
        if (!(g.at.weight > 0))
            continue;
        disney_eval_gradient(&material, &frame, g.at.l, view, &f);
        const double nl = vec3_dot(frame.n, g.at.l), gathered = (double)lit->nl[i] * g.at.weight;
        const double VC[3] = { (double)lit->wr[i] / gathered, (double)lit->wg[i] / gathered, (double)lit->wb[i] / gathered };
        double F[3], F_l[3][3];
        for (int c = 0; c < 3; c++) {
            F[c] = nl * f.f[c];
            for (int j = 0; j < 3; j++)
                F_l[c][j] = nl * f.light[c][j] + f.f[c] * frame.n[j];
        }
        add_setup(setup, centre, rotation, lit->index[i], &g, VC, F, F_l);
    }
    round_setup(setup, centre, rotation);
}

static void irradiance_setup(float E[3], struct shade_setup *setup, const struct light_arrays *a, const struct surface_point *s,
                             const uint16_t *visible)
{
    const struct disney_frame frame = frame_of(s);
    double centre[3][3] = { { 0 } }, rotation[3][3] = { { 0 } };
    irradiance(E, a, s, visible);
    clear_setup(setup, a);
    for (int i = 0; i < a->n; i++) {
        struct light_at_gradient g;
        light_gradient(&g, a, i, s);
        const double nl = vec3_dot(frame.n, g.at.l);
        if (!(g.at.weight > 0 && nl > 0 && visibility(visible, NULL, i) > 0))
            continue;
        const double C[3] = { (double)a->cr[i], (double)a->cg[i], (double)a->cb[i] }, F[3] = { nl, nl, nl };
        double F_l[3][3];
        for (int c = 0; c < 3; c++)
            memcpy(F_l[c], frame.n, sizeof(F_l[c]));
        add_setup(setup, centre, rotation, i, &g, C, F, F_l);
    }
    round_setup(setup, centre, rotation);
}

const struct kernels kernels_reference_table = {
    "reference", gather, shade, shade_jacobian, brute_jacobian, irradiance, shade_jacobian_views,
    shade_affine, shade_setup, irradiance_setup,
};
