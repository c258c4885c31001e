/* The step for x86-64 with AVX-512. */
#if defined(__x86_64__)
#define BR_LANES 8
#define BR_CODE br_code_avx512

#if defined(__clang__)
#pragma clang attribute push(                                                                     \
    __attribute__((target("avx512f,avx512dq,avx512vl,avx512bw,avx2,fma,bmi,bmi2,lzcnt,popcnt"))), \
    apply_to = function)
#include "br_parts.h"
#pragma clang attribute pop
#else
#pragma GCC target( \
    "avx512f,avx512dq,avx512vl,avx512bw,avx2,fma,bmi,bmi2,lzcnt,popcnt,prefer-vector-width=512")
#include "br_parts.h"
#endif
#endif
