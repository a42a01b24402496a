// solver/emitters.c - planes through lights: greedy consensus, each plane refitted to those that agree.
#include "solver/emitters.h"

#include "solver/vec3.h"

#include <errno.h>
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { N_NEAREST = 8, N_REFITS = 4 };

// Solve the symmetric 3x3 system M x = b by its adjugate. False where it is singular.
static bool solve3(double x[3], const double M[6], const double b[3])
{
    const double a = M[0], d = M[1], e = M[2], f = M[3], h = M[4], i = M[5]; // a d e; d f h; e h i
    const double c0 = f * i - h * h, c1 = e * h - d * i, c2 = d * h - e * f;
    const double det = a * c0 + d * c1 + e * c2;
    if (!(det > 1e-9 * a * f * i))
        return false;
    x[0] = (c0 * b[0] + c1 * b[1] + c2 * b[2]) / det;
    x[1] = (c1 * b[0] + (a * i - e * e) * b[1] + (d * e - a * h) * b[2]) / det;
    x[2] = (c2 * b[0] + (d * e - a * h) * b[1] + (a * f - d * d) * b[2]) / det;
    return true;
}

static void add_row(double M[6], double b[3], const double row[3], double value)
{
    for (int k = 0, i = 0; i < 3; i++) {
        for (int j = i; j < 3; j++)
            M[k++] += row[i] * row[j];
        b[i] += row[i] * value;
    }
}

int emitters_fit(double m[3], int plane, int n_lights, const int32_t *of, const double (*dir)[3], const double *q)
{
    double M[6] = { 0 }, b[3] = { 0 };
    for (int i = 0; i < n_lights; i++) {
        if (of[i] != plane || !(q[i] > 0))
            continue;
        const double row[3] = { dir[i][0] / q[i], dir[i][1] / q[i], dir[i][2] / q[i] };
        add_row(M, b, row, 1);
    }
    return solve3(m, M, b) ? 0 : -EDOM;
}

static double misfit(const double m[3], const double dir[3], double q)
{
    return q > 0 ? fabs(vec3_dot(dir, m) / q - 1) : INFINITY;
}

static int mark(int32_t *of, const int32_t *taken, int n, const double m[3], const double (*dir)[3], const double *q, double tolerance)
{
    int count = 0;
    for (int i = 0; i < n; i++) {
        of[i] = taken[i] < 0 && misfit(m, dir[i], q[i]) < tolerance ? 0 : -1;
        count += of[i] == 0;
    }
    return count;
}

// The plane that starts from light `seed` and its nearest, refitted to whom it explains. Returns how many those are.
static int grow(double m[3], int32_t *of, const int32_t *taken, int seed, int n, const double (*dir)[3], const double *q, double tolerance)
{
    int nearest[N_NEAREST + 1], k = 0, count = 0;
    double closeness[N_NEAREST + 1];
    for (int i = 0; i < n; i++) {
        const double c = vec3_dot(dir[seed], dir[i]);
        if (taken[i] >= 0 || !(q[i] > 0) || (k == N_NEAREST + 1 && c <= closeness[N_NEAREST]))
            continue;
        int at = k < N_NEAREST + 1 ? k++ : N_NEAREST;
        for (; at > 0 && closeness[at - 1] < c; at--)
            closeness[at] = closeness[at - 1], nearest[at] = nearest[at - 1];
        closeness[at] = c, nearest[at] = i;
    }
    for (int i = 0; i < n; i++)
        of[i] = -1;
    for (int i = 0; i < k; i++)
        of[nearest[i]] = 0;
    for (int step = 0; step < N_REFITS; step++) {
        if (emitters_fit(m, 0, n, of, dir, q))
            return 0;
        count = mark(of, taken, n, m, dir, q, tolerance);
    }
    return count;
}

int emitters_find(struct emitters *out, int n, const double (*dir)[3], const double *q, double tolerance)
{
    int32_t *of = malloc((size_t)n * sizeof(*of)), *trial = malloc((size_t)n * sizeof(*trial));
    memset(out, 0, sizeof(*out));
    out->of = malloc((size_t)n * sizeof(*out->of));
    out->plane = malloc(((size_t)n / EMITTER_LEAST + 1) * sizeof(*out->plane));
    if (!of || !trial || !out->of || !out->plane) {
        free(of);
        free(trial);
        emitters_free(out);
        return -ENOMEM;
    }
    for (int i = 0; i < n; i++)
        out->of[i] = -1;
    for (;;) {
        int best = 0;
        double m[3], best_m[3] = { 0 };
        for (int seed = 0; seed < n; seed++) {
            if (out->of[seed] >= 0 || !(q[seed] > 0))
                continue;
            const int count = grow(m, trial, out->of, seed, n, dir, q, tolerance);
            if (count > best) {
                best = count;
                memcpy(of, trial, (size_t)n * sizeof(*of));
                memcpy(best_m, m, sizeof(best_m));
            }
        }
        if (best < EMITTER_LEAST)
            break;
        for (int i = 0; i < n; i++)
            if (of[i] == 0)
                out->of[i] = out->n;
        memcpy(out->plane[out->n++], best_m, sizeof(best_m));
    }
    // Each light to the plane that fits it best; then the planes once more.
    for (int i = 0; i < n; i++) {
        double least = tolerance;
        out->of[i] = -1;
        for (int k = 0; k < out->n; k++)
            if (misfit(out->plane[k], dir[i], q[i]) < least)
                least = misfit(out->plane[k], dir[i], q[i]), out->of[i] = k;
    }
    for (int k = 0; k < out->n; k++) {
        int count = 0;
        for (int i = 0; i < n; i++)
            count += out->of[i] == k;
        if (count >= EMITTER_LEAST && !emitters_fit(out->plane[k], k, n, out->of, dir, q))
            continue;
        out->n--;
        memmove(out->plane[k], out->plane[k + 1], (size_t)(out->n - k) * sizeof(*out->plane));
        for (int i = 0; i < n; i++)
            out->of[i] = out->of[i] == k ? -1 : out->of[i] - (out->of[i] > k);
        k--;
    }
    free(of);
    free(trial);
    return 0;
}

void emitters_free(struct emitters *e)
{
    free(e->plane);
    free(e->of);
    memset(e, 0, sizeof(*e));
}

double emitters_add_cost(const struct emitters *e, int n_lights, const double (*dir)[3], const double *q,
                         const double *scale, double w, int n, int first, double *A, double *g)
{
    double cost = 0;
    for (int k = 0; k < e->n; k++) {
        // u = q / scale, B = dir / scale: cost 1/2 w u^T P u with P = 1 - B (B^T B)^-1 B^T
        double M[6] = { 0 }, b[3] = { 0 }, m[3];
        for (int i = 0; i < n_lights; i++) {
            const double row[3] = { dir[i][0] / scale[i], dir[i][1] / scale[i], dir[i][2] / scale[i] };
            if (e->of[i] == k)
                add_row(M, b, row, q[i] / scale[i]);
        }
        if (!solve3(m, M, b))
            continue;
        for (int i = 0; i < n_lights; i++) {
            if (e->of[i] != k)
                continue;
            const double off = (q[i] - vec3_dot(dir[i], m)) / scale[i];
            cost += .5 * w * off * off;
            if (!A)
                continue;
            double y[3]; // (B^T B)^-1 B_i
            const double row[3] = { dir[i][0] / scale[i], dir[i][1] / scale[i], dir[i][2] / scale[i] };
            solve3(y, M, row);
            g[first + i] += w * off / scale[i];
            for (int j = 0; j <= i; j++)
                if (e->of[j] == k)
                    A[(size_t)(first + i) * n + first + j] += w * ((i == j) - vec3_dot(dir[j], y) / scale[j]) / (scale[i] * scale[j]);
        }
    }
    return cost;
}
