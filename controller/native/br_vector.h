/* What the compilers' extensions (gcc, clang) give: short vectors without intrinsics, so that the
 * same source serves x86-64 and aarch64, and how functions and loops are compiled. */
#ifndef BR_VECTOR_H
#define BR_VECTOR_H

#include <stdint.h>
#include <string.h>

#define BR_ALIGNED __attribute__((aligned(64)))

/* Linkage of what the parts of the step know of each other. Each function is compiled by itself:
 * if they were inlined into each other, or copied for constant arguments, second derivatives would
 * take a quarter longer. */
#if defined(__clang__)
#define BR_APART __attribute__((noinline))
#else
#define BR_APART __attribute__((noinline, noclone))
#endif
#ifdef BR_CODE
#define BR_PART static BR_APART
#else
#define BR_PART BR_APART
#define BR_CODE br_code_baseline
#endif

/* Before loops over states, inputs, rows and their nonzeros, which have constant bounds: unrolled,
 * the problem's sparsity is in the code, and no table is read. */
#ifdef __clang__
#define BR_UNROLL _Pragma("unroll")
#else
#define BR_UNROLL _Pragma("GCC unroll 16")
#endif

/* Numbers of a vector. br_avx2.c and br_avx512.c define it before; else what every x86-64 and
 * aarch64 has. */
#ifndef BR_LANES
#define BR_LANES 2
#endif
#define BR_WIDEST 8 /* what is stored is padded for the widest, whichever is used */

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

/* 1 / sqrt(x) for 0 < x < 1e300, to a few units in the last place; for 0 a finite number. The
 * exponent halved is right to 3.5 %, and each of Newton's steps doubles the digits. gcc makes of
 * square roots, lane by lane, a detour by memory, which takes twice as long as all the rest of a
 * kernel. */
static inline br_vec br_inverse_root(br_vec x) {
    br_ivec bits;
    memcpy(&bits, &x, sizeof bits);
    bits = 0x5fe6eb50c7b537a9 - (bits >> 1);
    br_vec y;
    memcpy(&y, &bits, sizeof y);
    const br_vec half = 0.5 * x;
    for (int i = 0; i < 4; ++i) y *= 1.5 - half * y * y;
    return y;
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

#define BR_LOG2_E 1.4426950408889634

/* 2^x for -1000 <= x <= 0 with a relative error of 1e-15 at most.
 * 2^n 2^r with |r| <= 1/2; the polynomial of degree 10 is the one whose largest relative error is
 * the smallest (3e-16, by Remez' exchange). */
static inline br_vec br_exp2_near(br_vec x) {
    /* 1.5 * 2^52 rounds to integer; with 1023 more, the lowest bits are the exponent of 2^n */
    const br_vec magic = br_splat(6755399441055744.0 + 1023.0);
    const br_vec shifted = x + magic;
    const br_vec r = x - (shifted - magic);
    /* Estrin's scheme: the dependency chain, not the number of operations, sets the time. */
    const br_vec r2 = r * r, r4 = r2 * r2;
    const br_vec p01 = 1.0 + r * 0.6931471805599497;
    const br_vec p23 = 0.24022650695908768 + r * 0.05550410866445855;
    const br_vec p45 = 0.009618129108034914 + r * 0.0013333558228610482;
    const br_vec p67 = 0.00015403529960876947 + r * 1.5252658086425337e-05;
    const br_vec p89 = 1.3215662902191042e-06 + r * 1.0208543973079219e-07;
    const br_vec high = p89 + r2 * 7.037276005624955e-09;
    const br_vec p = (p01 + p23 * r2) + ((p45 + p67 * r2) + high * r4) * r4;
    br_ivec bits;
    memcpy(&bits, &shifted, sizeof bits);
    const br_ivec exponent = bits << 52;
    br_vec power;
    memcpy(&power, &exponent, sizeof power);
    return p * power;
}

/* The same for any x <= 0; arguments under -1000 give about 1e-301. */
static inline br_vec br_exp2_negative(br_vec x) {
    const br_vec floor_ = br_splat(-1000.0);
    return br_exp2_near(br_select(x < floor_, floor_, x));
}

/* out[c] (+)= sum_n weight_n rows[n][c] for whole vectors of columns. */
static inline __attribute__((always_inline)) void
br_combine(double *restrict out, const int columns, const int add, const int count,
           const double *restrict weight, const double *const *restrict rows) {
    for (int c = 0; c < columns; c += BR_LANES) {
        br_vec sum = add ? br_load(&out[c]) : br_splat(0.0);
        for (int n = 0; n < count; ++n) sum += weight[n] * br_load(&rows[n][c]);
        br_store(&out[c], sum);
    }
}

#endif
