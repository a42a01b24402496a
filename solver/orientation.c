// solver/orientation.c - Horn's quaternion, then Newton steps on the residuals.
//
// The 4x4 matrix holds squares: of vectors that span an angle e it sees e^2, and its eigenvector
// is good to rounding / e^2 only. The residuals are small differences of the numbers themselves,
// so a step on them leaves rounding / e.
#include "solver/orientation.h"
#include "solver/vec3.h"

#include <assert.h>
#include <float.h>

enum { MAX_N = 4, MAX_SWEEPS = 40, N_STEPS = 3 };

static const double on_a_line = 1e-6;       // width of a set, by its length
static const double rounding = 1e-14;       // of a sum of squares, with room
static const double clearly_better = 1e-12; // a reflection, by the squares it explains

// Cyclic Jacobi: m (n x n, symmetric, destroyed) = sum_k value[k] vector[k] vector[k]^T.
static void eigen(int n, double m[MAX_N][MAX_N], double value[MAX_N], double vector[MAX_N][MAX_N])
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            vector[i][j] = i == j;
    for (int sweep = 0; sweep < MAX_SWEEPS; sweep++) {
        bool turned = false;
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                // Against the smaller of the two: small eigenvalues are wanted as precisely.
                const double least = DBL_EPSILON / 8 * fmin(fabs(m[p][p]), fabs(m[q][q]));
                if (m[p][q] == 0 || fabs(m[p][q]) <= least)
                    continue;
                const double cot = (m[q][q] - m[p][p]) / (2 * m[p][q]);
                const double t = (cot < 0 ? -1 : 1) / (fabs(cot) + hypot(cot, 1)); // tangent
                const double c = 1 / sqrt(t * t + 1), s = t * c;
                turned = true;
                for (int k = 0; k < n; k++) {
                    const double u = m[k][p], v = m[k][q];
                    m[k][p] = c * u - s * v, m[k][q] = s * u + c * v;
                }
                for (int k = 0; k < n; k++) {
                    const double u = m[p][k], v = m[q][k], x = vector[p][k], y = vector[q][k];
                    m[p][k] = c * u - s * v, m[q][k] = s * u + c * v;
                    vector[p][k] = c * x - s * y, vector[q][k] = s * x + c * y;
                }
                m[p][q] = m[q][p] = 0;
            }
        if (!turned)
            break;
    }
    for (int i = 0; i < n; i++)
        value[i] = m[i][i];
}

static double normalise4(double q[4])
{
    const double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int k = 0; k < 4 && length > 0; k++)
        q[k] /= length;
    return length;
}

static void matrix_of(double R[9], const double q[4])
{
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    R[0] = w * w + x * x - y * y - z * z, R[1] = 2 * (x * y - w * z), R[2] = 2 * (x * z + w * y);
    R[3] = 2 * (x * y + w * z), R[4] = w * w - x * x + y * y - z * z, R[5] = 2 * (y * z - w * x);
    R[6] = 2 * (x * z - w * y), R[7] = 2 * (y * z + w * x), R[8] = w * w - x * x - y * y + z * z;
}

static void horn(double q[4], bool *mirrored, const double (*a)[3], const double (*b)[3],
                 const double *weight, int n)
{
    double S[3][3] = {{0}}, size = 0, value[MAX_N], vector[MAX_N][MAX_N];
    for (int i = 0; i < n; i++) {
        const double w = weight ? weight[i] : 1;
        for (int j = 0; j < 3; j++)
            for (int k = 0; k < 3; k++)
                S[j][k] += w * (a[i][j] * b[i][k]);
        size += w * vec3_norm(a[i]) * vec3_norm(b[i]);
    }
    double N[MAX_N][MAX_N] = {
        {S[0][0] + S[1][1] + S[2][2], S[1][2] - S[2][1], S[2][0] - S[0][2], S[0][1] - S[1][0]},
        {0, S[0][0] - S[1][1] - S[2][2], S[0][1] + S[1][0], S[2][0] + S[0][2]},
        {0, 0, -S[0][0] + S[1][1] - S[2][2], S[1][2] + S[2][1]},
        {0, 0, 0, -S[0][0] - S[1][1] + S[2][2]},
    };
    for (int i = 1; i < 4; i++)
        for (int j = 0; j < i; j++)
            N[i][j] = N[j][i];
    eigen(4, N, value, vector);
    int best = 0, worst = 0;
    for (int k = 1; k < 4; k++) {
        best = value[k] > value[best] ? k : best;
        worst = value[k] < value[worst] ? k : worst;
    }
    // -N is the matrix for -b, so the lowest eigenvalue is what the best reflection explains.
    *mirrored = -value[worst] - value[best] > clearly_better * size;

    // Of all that fit equally well, the one nearest the identity quaternion.
    for (int j = 0; j < 4; j++)
        q[j] = 0;
    for (int k = 0; k < 4; k++)
        for (int j = 0; j < 4 && value[k] >= value[best] - rounding * size; j++)
            q[j] += vector[k][0] * vector[k][j];
    if (normalise4(q) < 1e-8) // all of them half turns: any
        for (int j = 0; j < 4; j++)
            q[j] = vector[best][j];
}

static double smallest(const double value[3])
{
    return fmin(value[0], fmin(value[1], value[2]));
}

static double largest(const double value[3])
{
    return fmax(value[0], fmax(value[1], value[2]));
}

// The moment of inertia about a line that all vectors lie on is 0.
static bool is_determined(const double (*a)[3], const double *weight, int n)
{
    double I[MAX_N][MAX_N] = {{0}}, value[MAX_N], vector[MAX_N][MAX_N];
    for (int i = 0; i < n; i++)
        for (int j = 0; j < 3; j++)
            for (int k = 0; k < 3; k++)
                I[j][k] += (weight ? weight[i] : 1) *
                           ((j == k ? vec3_dot(a[i], a[i]) : 0) - a[i][j] * a[i][k]);
    eigen(3, I, value, vector);
    return smallest(value) > on_a_line * on_a_line * largest(value);
}

// One Newton step of q by w, R = exp([w]x) R0, p = R0 a, in the directions that the set determines:
// -1/2 gradient sum p x (b - p), 1/2 Hessian H = sum <p,b> - (p b^T + b p^T)/2.
static void step(double q[4], const double (*a)[3], const double (*b)[3], const double *weight,
                 int n)
{
    double H[MAX_N][MAX_N] = {{0}}, g[3] = {0}, R[9], value[MAX_N], vector[MAX_N][MAX_N];
    matrix_of(R, q);
    for (int i = 0; i < n; i++) {
        const double w = weight ? weight[i] : 1;
        double p[3], off[3], turn[3];
        mat3_mul_vec(p, R, a[i]);
        vec3_sub(off, b[i], p);
        vec3_cross(turn, p, off);
        vec3_add_scaled(g, g, w, turn);
        for (int j = 0; j < 3; j++)
            for (int k = 0; k < 3; k++)
                H[j][k] +=
                    w * ((j == k ? vec3_dot(p, b[i]) : 0) - (p[j] * b[i][k] + b[i][j] * p[k]) / 2);
    }
    eigen(3, H, value, vector);
    double turn[3] = {0};
    for (int k = 0; k < 3; k++)
        if (value[k] > rounding * largest(value))
            vec3_add_scaled(turn, turn, vec3_dot(g, vector[k]) / value[k], vector[k]);
    // (1, turn/2) q: exp to the second order
    const double x = turn[0] / 2, y = turn[1] / 2, z = turn[2] / 2;
    const double moved[4] = {
        q[0] - x * q[1] - y * q[2] - z * q[3], q[1] + x * q[0] + y * q[3] - z * q[2],
        q[2] + y * q[0] + z * q[1] - x * q[3], q[3] + z * q[0] + x * q[2] - y * q[1]};
    for (int k = 0; k < 4; k++)
        q[k] = moved[k];
    normalise4(q);
}

void orientation_fit(struct orientation *out, const double (*a)[3], const double (*b)[3],
                     const double *weight, int n)
{
    double q[4];
    assert(n >= 0);
    horn(q, &out->mirrored, a, b, weight, n);
    for (int k = 0; k < N_STEPS; k++)
        step(q, a, b, weight, n);
    matrix_of(out->rotation, q);
    out->determined = is_determined(a, weight, n);
}
