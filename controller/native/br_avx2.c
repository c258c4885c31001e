/* The step for x86-64 with AVX2 and fused multiply-add. */
#if defined(__x86_64__)
#define BR_LANES 4
#define BR_CODE br_code_avx2

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma,bmi,bmi2,lzcnt,popcnt"))), \
                             apply_to = function)
#include "br_parts.h"
#pragma clang attribute pop
#else
#pragma GCC target("avx2,fma,bmi,bmi2,lzcnt,popcnt")
#include "br_parts.h"
#endif
#endif
