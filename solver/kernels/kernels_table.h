// solver/kernels/kernels_table.h - the tables of all instruction sets, for kernels.c; NULL where this build lacks one.
#pragma once
#include "solver/kernels/kernels.h"

extern const struct kernels kernels_reference_table, kernels_portable_table;
extern const struct kernels *const kernels_avx2_table, *const kernels_avx512_table;
