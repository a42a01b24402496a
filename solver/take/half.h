// solver/take/half.h - 16-bit floats as OpenEXR stores them.
//
// In plain integers: the same bits on every machine, with or without hardware for it.
#pragma once
#include <stdint.h>

static inline float float_from_half(uint16_t h)
{
    const uint32_t sign = (uint32_t)(h & 0x8000) << 16, exponent = h >> 10 & 31,
                   mantissa = h & 0x3ff;
    union {
        uint32_t bits;
        float value;
    } f;
    if (exponent == 0) {
        const float magnitude = (float)mantissa * 0x1p-24f;
        return sign ? -magnitude : magnitude;
    }
    if (exponent == 31)
        f.bits = sign | 0x7f800000 | mantissa << 13;
    else
        f.bits = sign | (exponent + 112) << 23 | mantissa << 13;
    return f.value;
}

// Nearest even, saturating at +-65504 (never makes infinities). Not for NaN.
static inline uint16_t half_from_float(float value)
{
    union {
        float value;
        uint32_t bits;
    } f = { value };
    const uint32_t sign = f.bits >> 16 & 0x8000, magnitude = f.bits & 0x7fffffff;
    uint32_t h, rest, tie;
    if (magnitude >= 0x477ff000) // 65520 and more would round to infinity
        return (uint16_t)(sign | 0x7bff);
    if (magnitude < 0x33000000) // below 2^-25: rounds to 0
        return (uint16_t)sign;
    if (magnitude < 0x38800000) { // below 2^-14: a subnormal half
        const uint32_t mantissa = (magnitude & 0x7fffff) | 0x800000,
                       shift = 126 - (magnitude >> 23);
        h = mantissa >> shift;
        rest = mantissa & ((1u << shift) - 1);
        tie = 1u << (shift - 1);
    } else {
        h = (magnitude - 0x38000000) >> 13;
        rest = magnitude & 0x1fff;
        tie = 0x1000;
    }
    h += rest > tie || (rest == tie && (h & 1));
    return (uint16_t)(sign | h);
}
