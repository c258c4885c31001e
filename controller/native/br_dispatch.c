/* Which code makes the steps: the functions of the interface call the one that was chosen. */
#include "br_internal.h"

#if defined(__x86_64__)
#include <cpuid.h>

/* Bits of the processor's feature words (Intel SDM, volume 2, CPUID) and of XCR0, in which the
 * system says which registers it keeps. The compiler's __builtin_cpu_supports would do, but zig
 * does not link what it needs. */
#define FMA_OSXSAVE_AVX (1u << 12 | 1u << 27 | 1u << 28) /* leaf 1, ecx */
#define BMI_AVX2_BMI2 (1u << 3 | 1u << 5 | 1u << 8)      /* leaf 7, ebx */
#define AVX512_F_DQ_BW_VL (1u << 16 | 1u << 17 | 1u << 30 | 1u << 31)
#define LZCNT (1u << 5) /* leaf 0x80000001, ecx */
#define KEEPS_YMM 0x06u
#define KEEPS_ZMM 0xe6u

static int has(unsigned word, unsigned bits) { return (word & bits) == bits; }

static br_instructions supported(void) {
    unsigned a, b, c, d, features, extended, kept, unused;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !has(c, FMA_OSXSAVE_AVX)) return BR_BASELINE;
    if (!__get_cpuid_count(7, 0, &a, &features, &c, &d)) return BR_BASELINE;
    if (!__get_cpuid(0x80000001, &a, &b, &extended, &d)) return BR_BASELINE;
    __asm__("xgetbv" : "=a"(kept), "=d"(unused) : "c"(0));
    if (!has(features, BMI_AVX2_BMI2) || !has(extended, LZCNT) || !has(kept, KEEPS_YMM))
        return BR_BASELINE;
    return has(features, AVX512_F_DQ_BW_VL) && has(kept, KEEPS_ZMM) ? BR_AVX512 : BR_AVX2;
}

static const br_code *const codes[] = {&br_code_baseline, &br_code_avx2, &br_code_avx512};
#else
static br_instructions supported(void) { return BR_BASELINE; }

static const br_code *const codes[] = {&br_code_baseline};
#endif

const br_code *br_fastest_code(void) { return codes[supported()]; }

br_mpc_error br_mpc_set_instructions(br_mpc *mpc, br_instructions instructions) {
    if (!mpc) return BR_ERROR_NULL;
    if ((unsigned)instructions > (unsigned)supported()) return BR_ERROR_INSTRUCTIONS;
    mpc->code = codes[instructions];
    br_forget_linearisation(mpc);
    return BR_OK;
}

br_instructions br_mpc_get_instructions(const br_mpc *mpc) {
    int known = 0;
    while (codes[known] != mpc->code) ++known;
    return known;
}

br_mpc_error br_mpc_step(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                         const br_environment *environment, double elapsed_s, double budget_s,
                         double u[BR_NU], br_mpc_status *status, br_mpc_info *info) {
    if (!mpc) return BR_ERROR_NULL;
    return mpc->code->step(mpc, x, u_before, environment, elapsed_s, budget_s, u, status, info);
}

br_mpc_error br_mpc_solve(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                          double elapsed_s, double budget_s, const br_mpc_reference reference[BR_N],
                          double u[BR_NU], br_mpc_status *status, br_mpc_info *info) {
    if (!mpc) return BR_ERROR_NULL;
    return mpc->code->solve(mpc, x, u_before, elapsed_s, budget_s, reference, u, status, info);
}

br_mpc_error br_mpc_prepare(br_mpc *mpc, double elapsed_s, double budget_s) {
    return mpc ? mpc->code->prepare(mpc, elapsed_s, budget_s) : BR_ERROR_NULL;
}

br_mpc_error br_mpc_rehearse(br_mpc *mpc) { return mpc ? mpc->code->rehearse(mpc) : BR_ERROR_NULL; }

br_mpc_error br_mpc_predict(const br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                            double duration_s, double x_next[BR_NX]) {
    return mpc ? mpc->code->predict(mpc, x, u, duration_s, x_next) : BR_ERROR_NULL;
}

#if BR_HAS_PATH
br_mpc_error br_mpc_steer(const br_mpc *mpc, const double x[BR_NX], double *s_m, double *angle_rad,
                          double *outside_m) {
    return mpc ? mpc->code->steer(mpc, x, s_m, angle_rad, outside_m) : BR_ERROR_NULL;
}
#endif

br_mpc_error br_mpc_variance(br_mpc *mpc, const double v[BR_NV], double variance[BR_NE]) {
    return mpc ? mpc->code->variance(mpc, v, variance) : BR_ERROR_NULL;
}

br_mpc_error br_mpc_evaluate(const br_mpc *mpc, const double v[BR_NV], const double lambda[BR_NX],
                             double x_next[BR_NX], double jacobian[BR_NX * BR_NV],
                             double hessian[BR_NV * BR_NV]) {
    if (!mpc) return BR_ERROR_NULL;
    return mpc->code->evaluate(mpc, v, lambda, x_next, jacobian, hessian);
}
