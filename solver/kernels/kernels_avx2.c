// solver/kernels/kernels_avx2.c - 8 lights at a time; built with -mavx2 -mfma.
#include "solver/kernels/kernels_table.h"

#ifdef __AVX2__
#include <immintrin.h>

typedef __m256 vf;
typedef __m256d vd;
typedef unsigned v_mask; // one bit per lane
enum { LANES = 8 };
#define V static inline __attribute__((always_inline))

V vf v_set1(float x)
{
    return _mm256_set1_ps(x);
}
V vf v_load(const float *p)
{
    return _mm256_load_ps(p);
}
V void v_store(float *p, vf x)
{
    _mm256_store_ps(p, x);
}
V vf v_fma(vf a, vf b, vf c)
{
    return _mm256_fmadd_ps(a, b, c);
}
V vf v_fnma(vf a, vf b, vf c)
{
    return _mm256_fnmadd_ps(a, b, c);
}
V vf v_max(vf a, vf b)
{
    return _mm256_max_ps(a, b);
}
V vd d_set1(double x)
{
    return _mm256_set1_pd(x);
}
V vd d_fma(vd a, vd b, vd c)
{
    return _mm256_fmadd_pd(a, b, c);
}
V vd d_fnma(vd a, vd b, vd c)
{
    return _mm256_fnmadd_pd(a, b, c);
}
V vd d_wide(vf x, int half)
{
    return _mm256_cvtps_pd(half ? _mm256_extractf128_ps(x, 1) : _mm256_castps256_ps128(x));
}
V vf d_narrow(vd low, vd high)
{
    return _mm256_set_m128(_mm256_cvtpd_ps(high), _mm256_cvtpd_ps(low));
}
// 12 bits and one Newton step: 1e-7.
V vf v_rcp(vf x)
{
    const vf y = _mm256_rcp_ps(x);
    return v_fma(y, v_fnma(x, y, v_set1(1)), y);
}
V vf v_rsqrt_sqrt(vf x, vf *root)
{
    const vf y = _mm256_rsqrt_ps(x), z = x * y, e = v_fnma(z, y, v_set1(1)) * v_set1(.5f);
    *root = v_fma(z, e, z);
    return v_fma(y, e, y);
}
V v_mask v_positive(vf x, unsigned bits)
{
    return (v_mask)_mm256_movemask_ps(_mm256_cmp_ps(x, _mm256_setzero_ps(), _CMP_GT_OQ)) & bits;
}
V vf v_keep(vf x, unsigned bits)
{
    const __m256i bit = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
    const __m256i set = _mm256_cmpeq_epi32(_mm256_and_si256(_mm256_set1_epi32((int)bits), bit), bit);
    return _mm256_and_ps(x, _mm256_castsi256_ps(set));
}
V int v_count(v_mask m)
{
    return __builtin_popcount(m);
}
// The kept lanes of four move to the front; what lies behind them is overwritten by the next store.
static const int32_t front[16][4] = {
    { 0 },          { 0 },       { 1 },       { 0, 1 },    { 2 },    { 0, 2 },    { 1, 2 },    { 0, 1, 2 },
    { 3 },          { 0, 3 },    { 1, 3 },    { 0, 1, 3 }, { 2, 3 }, { 0, 2, 3 }, { 1, 2, 3 }, { 0, 1, 2, 3 },
};
V void v_compress(float *p, vf x, v_mask m)
{
    const unsigned low = m & 15, high = m >> 4 & 15;
    const __m128i low_i = _mm_loadu_si128((const __m128i *)front[low]);
    const __m128i high_i = _mm_loadu_si128((const __m128i *)front[high]);
    _mm_storeu_ps(p, _mm_permutevar_ps(_mm256_castps256_ps128(x), low_i));
    _mm_storeu_ps(p + __builtin_popcount(low), _mm_permutevar_ps(_mm256_extractf128_ps(x, 1), high_i));
}
V void v_compress_index(int32_t *p, int first, v_mask m)
{
    const unsigned low = m & 15, high = m >> 4 & 15;
    const __m128i low_i = _mm_loadu_si128((const __m128i *)front[low]);
    const __m128i high_i = _mm_loadu_si128((const __m128i *)front[high]);
    _mm_storeu_si128((__m128i *)p, _mm_add_epi32(low_i, _mm_set1_epi32(first)));
    _mm_storeu_si128((__m128i *)(p + __builtin_popcount(low)), _mm_add_epi32(high_i, _mm_set1_epi32(first + 4)));
}
V vf v_gather(const float *p, const int32_t *index)
{
    return _mm256_i32gather_ps(p, _mm256_load_si256((const __m256i *)index), 4);
}
// The first n lanes.
V void v_scatter(float *p, const int32_t *index, vf x, int n)
{
    for (int i = 0; i < LANES && i < n; i++)
        p[index[i]] = x[i];
}
V vf v_bytes(const uint8_t *p, int n)
{
    uint64_t bytes = 0;
    __builtin_memcpy(&bytes, p, n >= LANES ? LANES : n > 0 ? (unsigned)n : 0);
    return _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_cvtsi64_si128((long long)bytes)));
}

// sums[0..n) += the lanes of x[0..n), four vectors at a time.
V void add_up(const vf *x, int n, float *sums)
{
    for (int begin = 0; begin < n; begin += 4) {
        vf t[4];
        for (int i = 0; i < 4; i++)
            t[i] = begin + i < n ? x[begin + i] : v_set1(0);
        const vf halves = _mm256_hadd_ps(_mm256_hadd_ps(t[0], t[1]), _mm256_hadd_ps(t[2], t[3]));
        const __m128 four = _mm256_castps256_ps128(halves) + _mm256_extractf128_ps(halves, 1);
        if (n - begin >= 4)
            _mm_storeu_ps(sums + begin, _mm_loadu_ps(sums + begin) + four);
        else
            for (int i = 0; i < n - begin; i++)
                sums[begin + i] += four[i];
    }
}

#include "solver/kernels/kernels_body.h"

static const struct kernels table = {
    "avx2", gather, shade, shade_jacobian, brute_jacobian, irradiance, shade_jacobian_views,
    shade_affine, shade_setup, irradiance_setup,
};
const struct kernels *const kernels_avx2_table = &table;
#else
const struct kernels *const kernels_avx2_table = 0;
#endif
