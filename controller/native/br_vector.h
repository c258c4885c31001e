/* Short vectors through the compilers' vector extension (gcc, clang): no intrinsics, so that the
 * same source serves x86-64 and aarch64. */
#ifndef BR_VECTOR_H
#define BR_VECTOR_H

#include <stdint.h>
#include <string.h>

#define BR_ALIGNED __attribute__((aligned(64)))

#if defined(__AVX512F__)
#define BR_LANES 8
#elif defined(__AVX__)
#define BR_LANES 4
#else
#define BR_LANES 2
#endif

typedef double br_vec __attribute__((vector_size(BR_LANES * 8)));
typedef int64_t br_ivec __attribute__((vector_size(BR_LANES * 8)));

static inline br_vec br_load(const double *p) { return *(const br_vec *)p; }
static inline void br_store(double *p, br_vec v) { *(br_vec *)p = v; }
static inline br_vec br_splat(double value) { return value - (br_vec){0}; }

static inline double br_sum(br_vec v) {
    double sum = 0;
    for (int i = 0; i < BR_LANES; ++i) sum += v[i];
    return sum;
}

static inline br_vec br_sqrt(br_vec v) {
    br_vec root = {0};
    for (int i = 0; i < BR_LANES; ++i) root[i] = __builtin_sqrt(v[i]);
    return root;
}

/* a where the mask (a comparison's result) is set, else b; C has no ternary on vectors before gcc
 * 14 */
static inline br_vec br_select(br_ivec mask, br_vec a, br_vec b) {
    br_ivec ia, ib;
    memcpy(&ia, &a, sizeof ia);
    memcpy(&ib, &b, sizeof ib);
    ia = (ia & mask) | (ib & ~mask);
    memcpy(&a, &ia, sizeof a);
    return a;
}

/* exp(x) for x <= 0, below 1 ulp + 2e-16 relative; arguments under -700 give about 1e-304.
 * 2^n * e^r with |r| <= ln(2)/2; degree 12 leaves r^13/13! < 2e-16. */
static inline br_vec br_exp_negative(br_vec x) {
    const br_vec magic = br_splat(6755399441055744.0); /* 1.5 * 2^52: rounds to integer */
    const br_vec floor_ = br_splat(-700.0);
    x = br_select(x < floor_, floor_, x);
    const br_vec shifted = x * 1.4426950408889634 + magic;
    const br_vec n = shifted - magic;
    br_vec r = x - n * 6.93147180369123816490e-01;
    r = r - n * 1.90821492927058770002e-10;
    /* Estrin's scheme: the dependency chain, not the number of operations, sets the time. */
    const br_vec r2 = r * r, r4 = r2 * r2, r8 = r4 * r4;
    const br_vec p01 = 1.0 + r, p23 = 0.5 + r * (1.0 / 6);
    const br_vec p45 = 1.0 / 24 + r * (1.0 / 120), p67 = 1.0 / 720 + r * (1.0 / 5040);
    const br_vec p89 = 1.0 / 40320 + r * (1.0 / 362880);
    const br_vec p1011 = 1.0 / 3628800 + r * (1.0 / 39916800);
    const br_vec low = (p01 + p23 * r2) + (p45 + p67 * r2) * r4;
    const br_vec p = low + ((p89 + p1011 * r2) + r4 * (1.0 / 479001600)) * r8;
    br_ivec bits;
    memcpy(&bits, &shifted, sizeof bits);
    const br_ivec exponent = (bits << 52) + ((int64_t)1023 << 52);
    br_vec power;
    memcpy(&power, &exponent, sizeof power);
    return p * power;
}

#endif
