// solver/random.h - random numbers named by (seed, stream, index), so that any thread gets the same ones.
//
// Not a sequence but a hash (splitmix64's finaliser, twice): no state, no order, bit-identical everywhere.
#pragma once
#include <math.h>
#include <stdint.h>

static inline uint64_t random_mix(uint64_t z)
{
    z += 0x9e3779b97f4a7c15u;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

static inline uint64_t random_u64(uint64_t seed, uint64_t stream, uint64_t index)
{
    return random_mix(random_mix(random_mix(seed) + stream) + index);
}

// Uniform in [0, 1), 53 bits.
static inline double random_uniform(uint64_t seed, uint64_t stream, uint64_t index)
{
    return (double)(random_u64(seed, stream, index) >> 11) * 0x1p-53;
}

// Standard normal (Box-Muller, one of the pair).
static inline double random_normal(uint64_t seed, uint64_t stream, uint64_t index)
{
    const double u = ((double)(random_u64(seed, stream, 2 * index) >> 11) + 1) * 0x1p-53;
    const double v = random_uniform(seed, stream, 2 * index + 1);
    return sqrt(-2 * log(u)) * cos(6.283185307179586 * v);
}
