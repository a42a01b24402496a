// solver/kernels/kernels.c - memory for the kernels, and the choice of one at run time.
#include "solver/kernels/kernels.h"

#include "solver/kernels/kernels_table.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <assert.h>
#include <errno.h>
#include <limits.h>
#include <stdlib.h>
#include <string.h>

static int padded(int n)
{
    return (n + KERNEL_WIDTH - 1) / KERNEL_WIDTH * KERNEL_WIDTH;
}

// n_arrays arrays of n floats in one zeroed block that begins at the first; each 64-byte aligned.
static int new_arrays(float **const arrays[], int n_arrays, int n)
{
    float *block = aligned_alloc(64, (size_t)n * (size_t)n_arrays * sizeof(float));
    if (!block)
        return -ENOMEM;
    memset(block, 0, (size_t)n * (size_t)n_arrays * sizeof(float));
    for (int i = 0; i < n_arrays; i++)
        *arrays[i] = block + (size_t)i * (size_t)n;
    return 0;
}

int light_arrays_new(struct light_arrays *out, const struct lights *lights)
{
    *out = (struct light_arrays){ 0 };
    if (lights->n < 0 || lights->n > INT_MAX - KERNEL_WIDTH)
        return -ENOMEM;
    struct light_arrays a = { .n = lights->n, .n_padded = padded(lights->n) };
    float **const arrays[] = { &a.dx, &a.dy, &a.dz, &a.q, &a.cr, &a.cg, &a.cb };
    const int err = new_arrays(arrays, 7, a.n_padded > 0 ? a.n_padded : KERNEL_WIDTH);
    if (err)
        return err;
    light_arrays_update(&a, lights);
    *out = a;
    return 0;
}

void light_arrays_update(struct light_arrays *a, const struct lights *lights)
{
    for (int c = 0; c < 3; c++)
        a->centre_m[c] = (float)lights->centre_m[c];
    for (int i = 0; i < a->n; i++) {
        double d[3];
        mat3_mul_vec(d, lights->world_from_probe, lights->dir_probe[i]);
        a->dx[i] = (float)d[0], a->dy[i] = (float)d[1], a->dz[i] = (float)d[2];
        a->q[i] = (float)lights->inverse_distance[i];
        a->cr[i] = (float)lights->irradiance[i][0];
        a->cg[i] = (float)lights->irradiance[i][1];
        a->cb[i] = (float)lights->irradiance[i][2];
    }
}

void light_arrays_free(struct light_arrays *a)
{
    free(a->dx);
    *a = (struct light_arrays){ 0 };
}

int lit_new(struct lit *out, int n_lights)
{
    *out = (struct lit){ 0 };
    if (n_lights < 0 || n_lights > INT_MAX - 2 * KERNEL_WIDTH)
        return -ENOMEM;
    // One vector more than the lights: compaction stores whole vectors.
    struct lit l = { .capacity = padded(n_lights) + KERNEL_WIDTH };
    float *index;
    float **const arrays[] = { &l.lx, &l.ly, &l.nl, &l.sl, &l.gc, &l.wr, &l.wg, &l.wb,
                               &l.lx_rest, &l.ly_rest, &l.g, &l.g_r, &l.g_a, &l.facing, &index };
    static_assert(sizeof(*l.index) == sizeof(*index), "index lies in the same block");
    const int err = new_arrays(arrays, 15, l.capacity);
    if (err)
        return err;
    l.index = (int32_t *)index;
    *out = l;
    return 0;
}

void lit_free(struct lit *l)
{
    free(l->lx);
    *l = (struct lit){ 0 };
}

static const struct kernels *table_of(unsigned one)
{
    switch (one) {
    case KERNELS_REFERENCE:
        return &kernels_reference_table;
    case KERNELS_PORTABLE:
        return &kernels_portable_table;
#ifdef __x86_64__
    case KERNELS_AVX2:
        return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? kernels_avx2_table : NULL;
    case KERNELS_AVX512:
        return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                       __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") &&
                       __builtin_cpu_supports("fma")
                   ? kernels_avx512_table
                   : NULL;
#endif
    default:
        return NULL;
    }
}

static const char *const names[] = { "reference", "portable", "avx2", "avx512" }; // bit i of KERNELS_*
enum { N_KERNELS = sizeof(names) / sizeof(names[0]) };

static int index_of(const char *name)
{
    for (int i = 0; i < N_KERNELS; i++)
        if (!strcmp(names[i], name))
            return i;
    return -1;
}

const struct kernels *kernels_by_name(const char *name)
{
    const int i = index_of(name);
    return i < 0 ? NULL : table_of(1u << i);
}

const struct kernels *kernels_select(unsigned allow)
{
    const char *wish = getenv("RIGSOLVE_KERNEL");
    if (wish && *wish) {
        const int i = index_of(wish);
        if (i < 0)
            log_warning("kernels: RIGSOLVE_KERNEL=%s is ignored: expected reference, portable, avx2 or avx512", wish);
        else if (!table_of(1u << i))
            log_warning("kernels: RIGSOLVE_KERNEL=%s is ignored: this CPU or this build lacks it", wish);
        else
            allow &= 1u << i;
    }
    for (int i = N_KERNELS - 1; i > 0; i--)
        if (allow & 1u << i && table_of(1u << i))
            return table_of(1u << i);
    return &kernels_reference_table;
}
