// solver/kernels/kernels_avx512.c - 16 lights at a time; built with -mavx512f -mavx512dq -mavx512bw -mavx512vl -mfma.
#include "solver/kernels/kernels_table.h"

#ifdef __AVX512F__
#include <immintrin.h>

typedef __m512 vf;
typedef __m512d vd;
typedef __mmask16 v_mask;
enum { LANES = 16 };
#define V static inline __attribute__((always_inline))

V vf v_set1(float x)
{
    return _mm512_set1_ps(x);
}
V vf v_load(const float *p)
{
    return _mm512_load_ps(p);
}
V void v_store(float *p, vf x)
{
    _mm512_store_ps(p, x);
}
V vf v_fma(vf a, vf b, vf c)
{
    return _mm512_fmadd_ps(a, b, c);
}
V vf v_fnma(vf a, vf b, vf c)
{
    return _mm512_fnmadd_ps(a, b, c);
}
V vf v_max(vf a, vf b)
{
    return _mm512_max_ps(a, b);
}
V vd d_set1(double x)
{
    return _mm512_set1_pd(x);
}
V vd d_fma(vd a, vd b, vd c)
{
    return _mm512_fmadd_pd(a, b, c);
}
V vd d_fnma(vd a, vd b, vd c)
{
    return _mm512_fnmadd_pd(a, b, c);
}
V vd d_wide(vf x, int half)
{
    return _mm512_cvtps_pd(half ? _mm512_extractf32x8_ps(x, 1) : _mm512_castps512_ps256(x));
}
V vf d_narrow(vd low, vd high)
{
    return _mm512_insertf32x8(_mm512_castps256_ps512(_mm512_cvtpd_ps(low)), _mm512_cvtpd_ps(high), 1);
}
// 14 bits and one Newton step: 1e-7.
V vf v_rcp(vf x)
{
    const vf y = _mm512_rcp14_ps(x);
    return v_fma(y, v_fnma(x, y, v_set1(1)), y);
}
V vf v_rsqrt_sqrt(vf x, vf *root)
{
    const vf y = _mm512_rsqrt14_ps(x), z = x * y, e = v_fnma(z, y, v_set1(1)) * v_set1(.5f);
    *root = v_fma(z, e, z);
    return v_fma(y, e, y);
}
V v_mask v_positive(vf x, unsigned bits)
{
    return _mm512_mask_cmp_ps_mask((v_mask)bits, x, _mm512_setzero_ps(), _CMP_GT_OQ);
}
V vf v_keep(vf x, unsigned bits)
{
    return _mm512_maskz_mov_ps((v_mask)bits, x);
}
V int v_count(v_mask m)
{
    return __builtin_popcount(m);
}
// In a register, then stored whole: what lies behind the kept lanes is overwritten by the next store.
V void v_compress(float *p, vf x, v_mask m)
{
    _mm512_storeu_ps(p, _mm512_maskz_compress_ps(m, x));
}
V void v_compress_index(int32_t *p, int first, v_mask m)
{
    const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    _mm512_storeu_si512(p, _mm512_maskz_compress_epi32(m, _mm512_add_epi32(_mm512_set1_epi32(first), lane)));
}
V vf v_gather(const float *p, const int32_t *index)
{
    return _mm512_i32gather_ps(_mm512_load_si512(index), p, 4);
}
// The first n lanes.
V void v_scatter(float *p, const int32_t *index, vf x, int n)
{
    const v_mask there = (v_mask)(n >= LANES ? 0xffff : (1u << n) - 1);
    _mm512_mask_i32scatter_ps(p, there, _mm512_load_si512(index), x, 4);
}
V vf v_bytes(const uint8_t *p, int n)
{
    const v_mask there = (v_mask)(n >= LANES ? 0xffff : (1u << n) - 1);
    return _mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_maskz_loadu_epi8(there, p)));
}

// sums[0..n) += the lanes of x[0..n), 16 vectors at a time: four rounds of "add halves" leave one sum per lane;
// what stands at 4 (i mod 4) + i/4 ends in lane i.
V vf pair(vf a, vf b, int round)
{
    switch (round) {
    case 0:
        return _mm512_shuffle_f32x4(a, b, 0x44) + _mm512_shuffle_f32x4(a, b, 0xee);
    case 1:
        return _mm512_shuffle_f32x4(a, b, 0x88) + _mm512_shuffle_f32x4(a, b, 0xdd);
    case 2:
        return _mm512_shuffle_ps(a, b, 0x44) + _mm512_shuffle_ps(a, b, 0xee);
    default:
        return _mm512_shuffle_ps(a, b, 0x88) + _mm512_shuffle_ps(a, b, 0xdd);
    }
}
V void add_up(const vf *x, int n, float *sums)
{
    for (int begin = 0; begin < n; begin += 16) {
        vf t[16];
        for (int i = 0; i < 16; i++)
            t[i % 4 * 4 + i / 4] = begin + i < n ? x[begin + i] : v_set1(0);
        for (int round = 0, left = 8; round < 4; round++, left /= 2)
            for (int i = 0; i < left; i++)
                t[i] = pair(t[2 * i], t[2 * i + 1], round);
        const v_mask there = (v_mask)(n - begin >= 16 ? 0xffff : (1u << (n - begin)) - 1);
        _mm512_mask_storeu_ps(sums + begin, there, _mm512_maskz_loadu_ps(there, sums + begin) + t[0]);
    }
}

#include "solver/kernels/kernels_body.h"

static const struct kernels table = {
    "avx512", gather, shade, shade_jacobian, brute_jacobian, irradiance, shade_jacobian_views,
    shade_affine, shade_setup, irradiance_setup,
};
const struct kernels *const kernels_avx512_table = &table;
#else
const struct kernels *const kernels_avx512_table = 0;
#endif
