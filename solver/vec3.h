// solver/vec3.h - three doubles, and rotations as row-major 3x3 (a_from_b[9]).
#pragma once
#include <math.h>

static inline double vec3_dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static inline void vec3_cross(double out[3], const double a[3], const double b[3])
{
    const double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2],
                 z = a[0] * b[1] - a[1] * b[0];
    out[0] = x, out[1] = y, out[2] = z;
}

static inline void vec3_sub(double out[3], const double a[3], const double b[3])
{
    out[0] = a[0] - b[0], out[1] = a[1] - b[1], out[2] = a[2] - b[2];
}

// out = a + s b
static inline void vec3_add_scaled(double out[3], const double a[3], double s, const double b[3])
{
    out[0] = a[0] + s * b[0], out[1] = a[1] + s * b[1], out[2] = a[2] + s * b[2];
}

static inline double vec3_norm(const double a[3])
{
    return sqrt(vec3_dot(a, a));
}

// Scales to length 1 and returns the length it had; a zero vector stays zero.
static inline double vec3_normalise(double a[3])
{
    const double length = vec3_norm(a);
    if (length > 0)
        a[0] /= length, a[1] /= length, a[2] /= length;
    return length;
}

static inline void mat3_mul_vec(double out[3], const double m[9], const double v[3])
{
    const double x = vec3_dot(m, v), y = vec3_dot(m + 3, v), z = vec3_dot(m + 6, v);
    out[0] = x, out[1] = y, out[2] = z;
}

// out = m^T v
static inline void mat3_tmul_vec(double out[3], const double m[9], const double v[3])
{
    const double x = m[0] * v[0] + m[3] * v[1] + m[6] * v[2],
                 y = m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
                 z = m[2] * v[0] + m[5] * v[1] + m[8] * v[2];
    out[0] = x, out[1] = y, out[2] = z;
}

static inline void mat3_mul(double out[9], const double a[9], const double b[9])
{
    double r[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            r[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
    for (int i = 0; i < 9; i++)
        out[i] = r[i];
}

static inline double mat3_det(const double m[9])
{
    return m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6]) +
           m[2] * (m[3] * m[7] - m[4] * m[6]);
}

// Rotation by the vector w (axis times angle, radians): Rodrigues, exact for tiny angles.
static inline void mat3_from_rotation_vector(double out[9], const double w[3])
{
    const double a2 = vec3_dot(w, w), a = sqrt(a2);
    const double s = a > 1e-4 ? sin(a) / a : 1 - a2 / 6 + a2 * a2 / 120;
    const double c = a > 1e-4 ? (1 - cos(a)) / a2 : .5 - a2 / 24 + a2 * a2 / 720;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[3 * i + j] = (i == j ? 1 - c * a2 : 0) + c * w[i] * w[j];
    out[1] -= s * w[2], out[2] += s * w[1], out[3] += s * w[2];
    out[5] -= s * w[0], out[6] -= s * w[1], out[7] += s * w[0];
}
