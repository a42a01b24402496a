// solver/lights.c - cutting a panorama into lights, their irradiance at a point with derivatives, and lights.json.
//
// Letters (paper, Eqs. 1-4): dh probe direction, C irradiance, c centre, R world_from_probe, q = 1/r.
#include "solver/lights.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

// ---- memory -------------------------------------------------------------------------------------------------------------

int lights_new(struct lights *out, int n)
{
    assert(n >= 1);
    struct lights l = {
        .n = n,
        .dir_probe = calloc((size_t)n, sizeof(*l.dir_probe)),
        .irradiance = calloc((size_t)n, sizeof(*l.irradiance)),
        .inverse_distance = calloc((size_t)n, sizeof(*l.inverse_distance)),
        .group = malloc((size_t)n * sizeof(*l.group)),
        .world_from_probe = { 1, 0, 0, 0, 1, 0, 0, 0, 1 },
    };
    memset(out, 0, sizeof(*out));
    if (!l.dir_probe || !l.irradiance || !l.inverse_distance || !l.group) {
        lights_free(&l);
        return -ENOMEM;
    }
    for (int i = 0; i < n; i++)
        l.group[i] = -1;
    *out = l;
    return 0;
}

void lights_free(struct lights *l)
{
    if (!l)
        return;
    free(l->dir_probe);
    free(l->irradiance);
    free(l->region);
    free(l->spread_rad);
    free(l->inverse_distance);
    free(l->group);
    memset(l, 0, sizeof(*l));
}

// ---- one light at one point (Eqs. 1-4) ----------------------------------------------------------------------------------
//
//   a = R dh,  u = a + q (c - p),  s = |u|,  l = u / s,  weight = max(<u, a>, 0) / s^3
//
// With r = 1/q this is l = (l_p - p)/|l_p - p| and weight = r^2/|l_p - p|^2 max(<l, l_d>, 0), for l_p - p = r u.
// A light emits into the half space in front of it: behind it the weight is 0. The point at the light itself (s below
// rounding) has no direction; it gets l = a and weight 0.

static const double s_min = 1e-12;

// Returns false where the weight, and with it every derivative, is 0.
static bool light_vector(const struct lights *l, int i, const double p[3], double a[3], double u[3], double *s,
                         struct light_at *at)
{
    const double q = l->inverse_distance[i];
    mat3_mul_vec(a, l->world_from_probe, l->dir_probe[i]);
    for (int k = 0; k < 3; k++)
        u[k] = a[k] + q * (l->centre_m[k] - p[k]);
    *s = vec3_norm(u);
    const double facing = vec3_dot(u, a);
    at->weight = 0;
    if (!(*s > s_min)) {
        memcpy(at->l, a, sizeof(at->l));
        return false;
    }
    for (int k = 0; k < 3; k++)
        at->l[k] = u[k] / *s;
    if (!(facing > 0))
        return false;
    at->weight = facing / (*s * *s * *s);
    return true;
}

void light_at_point(const struct lights *l, int i, const double point_m[3], struct light_at *out)
{
    double a[3], u[3], s;
    light_vector(l, i, point_m, a, u, &s, out);
}

// By the chain rule over u and a, with m = <u, a>:
//   dl/du = (I - l l^T)/s,  dweight/du = a/s^3 - 3 m u/s^5,  dweight/da = u/s^3
//   du/dc = q I,  du/dp = -q I,  du/dq = c - p,  da/dw = du/dw = -[a]x  (R = exp([w]x) R0, so a moves by w x a)
void light_at_point_gradient(const struct lights *l, int i, const double point_m[3],
                             struct light_at_gradient *out)
{
    double a[3], u[3], s;
    memset(out, 0, sizeof(*out));
    if (!light_vector(l, i, point_m, a, u, &s, &out->at))
        return;
    const double q = l->inverse_distance[i], s3 = s * s * s, m = vec3_dot(u, a);
    const double minus_a_cross[9] = { 0, a[2], -a[1], -a[2], 0, a[0], a[1], -a[0], 0 };
    double l_u[9], weight_u[3], weight_ua[3], c_minus_p[3];
    vec3_sub(c_minus_p, l->centre_m, point_m);
    for (int j = 0; j < 3; j++) {
        weight_u[j] = a[j] / s3 - 3 * m * u[j] / (s3 * s * s);
        weight_ua[j] = weight_u[j] + u[j] / s3;
        for (int k = 0; k < 3; k++)
            l_u[3 * j + k] = ((j == k) - out->at.l[j] * out->at.l[k]) / s;
    }
    for (int j = 0; j < 9; j++) {
        out->l_centre[j] = q * l_u[j];
        out->l_point[j] = -q * l_u[j];
    }
    for (int j = 0; j < 3; j++) {
        out->weight_centre[j] = q * weight_u[j];
        out->weight_point[j] = -q * weight_u[j];
    }
    mat3_mul(out->l_rotation, l_u, minus_a_cross);
    mat3_tmul_vec(out->weight_rotation, minus_a_cross, weight_ua);
    mat3_mul_vec(out->l_inverse_distance, l_u, c_minus_p);
    out->weight_inverse_distance = vec3_dot(weight_u, c_minus_p);
}
