// solver/kernels/kernels_portable.c - 4 lights at a time in the compiler's own vectors: SSE2, NEON, or plain scalars.
#include "solver/kernels/kernels_table.h"

#include <math.h>

typedef float vf __attribute__((vector_size(16), may_alias));
typedef double vd __attribute__((vector_size(16)));
typedef float vh __attribute__((vector_size(8)));
typedef int32_t vi __attribute__((vector_size(16)));
typedef unsigned v_mask; // one bit per lane
enum { LANES = 4 };
#define V static inline __attribute__((always_inline))

V vf v_set1(float x)
{
    return (vf){ x, x, x, x };
}
V vf v_load(const float *p)
{
    return *(const vf *)p;
}
V void v_store(float *p, vf x)
{
    *(vf *)p = x;
}
V vf v_fma(vf a, vf b, vf c)
{
    return a * b + c;
}
V vf v_fnma(vf a, vf b, vf c)
{
    return c - a * b;
}
V vf v_max(vf a, vf b)
{
    const vi more = a > b;
    return (vf)((more & (vi)a) | (~more & (vi)b));
}
V vf v_rcp(vf x)
{
    return 1 / x;
}
V vd d_set1(double x)
{
    return (vd){ x, x };
}
V vd d_fma(vd a, vd b, vd c)
{
    return a * b + c;
}
V vd d_fnma(vd a, vd b, vd c)
{
    return c - a * b;
}
// Written lane by lane, gcc 12 takes (double)(float)x for x and what float left over is lost.
V vd d_wide(vf x, int half)
{
    return __builtin_convertvector((half ? (vh){ x[2], x[3] } : (vh){ x[0], x[1] }), vd);
}
V vf d_narrow(vd low, vd high)
{
    const vh a = __builtin_convertvector(low, vh), b = __builtin_convertvector(high, vh);
    return (vf){ a[0], a[1], b[0], b[1] };
}
V vf v_rsqrt_sqrt(vf x, vf *root)
{
    for (int i = 0; i < LANES; i++)
        (*root)[i] = sqrtf(x[i]);
    return 1 / *root;
}
V v_mask v_positive(vf x, unsigned bits)
{
    v_mask m = 0;
    for (int i = 0; i < LANES; i++)
        m |= (unsigned)(x[i] > 0) << i;
    return m & bits;
}
V vf v_keep(vf x, unsigned bits)
{
    for (int i = 0; i < LANES; i++)
        x[i] = bits >> i & 1 ? x[i] : 0;
    return x;
}
V int v_count(v_mask m)
{
    return __builtin_popcount(m);
}
V void v_compress(float *p, vf x, v_mask m)
{
    for (int i = 0; i < LANES; i++) {
        *p = x[i]; // a lane that is not kept is overwritten by the next
        p += m >> i & 1;
    }
}
V void v_compress_index(int32_t *p, int first, v_mask m)
{
    for (int i = 0; i < LANES; i++) {
        *p = first + i;
        p += m >> i & 1;
    }
}
V vf v_gather(const float *p, const int32_t *index)
{
    return (vf){ p[index[0]], p[index[1]], p[index[2]], p[index[3]] };
}
// The first n lanes.
V void v_scatter(float *p, const int32_t *index, vf x, int n)
{
    for (int i = 0; i < LANES && i < n; i++)
        p[index[i]] = x[i];
}
V vf v_bytes(const uint8_t *p, int n)
{
    vf x = v_set1(0);
    for (int i = 0; i < LANES && i < n; i++)
        x[i] = p[i];
    return x;
}

// sums[0..n) += the lanes of x[0..n)
V void add_up(const vf *x, int n, float *sums)
{
    for (int i = 0; i < n; i++)
        sums[i] += (x[i][0] + x[i][1]) + (x[i][2] + x[i][3]);
}

#include "solver/kernels/kernels_body.h"

const struct kernels kernels_portable_table = {
    "portable", gather, shade, shade_jacobian, brute_jacobian, irradiance, shade_jacobian_views,
    shade_affine, shade_setup, irradiance_setup,
};
