/* The functions of bayesrace_mpc.h. Those that take time, such as br_mpc_step, call the code for
 * the processor's instructions: br_step in br_step.c, see br_parts.h. */
#include "br_internal.h"

#if defined(__x86_64__)
#include <cpuid.h>
#endif

/* --- instruction sets --- */

#if defined(__x86_64__)
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
    if (!__get_cpuid(0x80000001u, &a, &b, &extended, &d)) return BR_BASELINE;
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

/* --- set-up, and what a step leaves --- */

size_t br_mpc_memory_size(void) { return sizeof(br_mpc); }

br_mpc_error br_mpc_init(void *memory, size_t size, br_mpc **out) {
    if (!memory || !out) return BR_ERROR_NULL;
    if (size < sizeof(br_mpc) || (uintptr_t)memory % 64) return BR_ERROR_MEMORY;
    br_mpc *mpc = memory;
    memset(mpc, 0, offsetof(br_mpc, gp));
    for (int i = 0; i < BR_WEIGHT_BUFFERS; ++i) br_gp_clear(&mpc->gp[i]);
    br_qp_init(&mpc->qp);
    atomic_init(&mpc->spare, BR_SPARE_FREE);
    mpc->gp_spare = BR_WEIGHT_BUFFERS > 1;
    br_caution_reset(&mpc->caution);
    br_mismatch_reset(&mpc->mismatch);
    mpc->code = codes[supported()];
    *out = mpc;
    return BR_OK;
}

static int valid(const br_mpc_parameters *p) {
    const double numbers[] = {p->tolerance, p->defect_max, p->early_stop_tol, p->caution_sigmas};
    return br_all_finite(numbers, sizeof numbers / sizeof numbers[0]) && p->tolerance > 0 &&
           p->defect_max > 0 && p->early_stop_tol >= 0 && p->caution_sigmas >= 0 &&
           p->iterations >= 1 && p->iterations_cold >= 1 && p->qp_steps >= BR_QP_STEPS &&
           br_valid_parameters(p);
}

static void limit_speeds(br_mpc *mpc);

br_mpc_error br_mpc_set_parameters(br_mpc *mpc, const br_mpc_parameters *parameters) {
    if (!mpc || !parameters) return BR_ERROR_NULL;
    if (!valid(parameters)) return BR_ERROR_PARAMETERS;
    const int others =
        !mpc->has_parameters || memcmp(&mpc->parameters, parameters, sizeof *parameters) != 0;
    mpc->parameters = *parameters;
    mpc->has_parameters = 1;
    br_invalidate(mpc, BR_TUBE);
    br_mismatch_undo(&mpc->mismatch);
    if (mpc->mismatch.any && !(parameters->caution_sigmas > 0)) {
        br_mismatch_reset(&mpc->mismatch);
        br_forget_linearisation(mpc);
    }
    br_evaluate_penalties(mpc);
    mpc->caution.wanted = 0;
    for (int r = 0; r < BR_NR && parameters->caution_sigmas > 0; ++r)
        if (BR_ROW_CAUTIOUS[r] && mpc->qp.penalty[r] > 0) mpc->caution.wanted = 1;
    if (others) limit_speeds(mpc);
    return BR_OK;
}

br_mpc_error br_mpc_set_path(br_mpc *mpc, const double *table, int n, double spacing_m) {
    if (!mpc || !table) return BR_ERROR_NULL;
#if BR_HAS_PATH
    br_invalidate(mpc, BR_FOLLOWED); /* what has been prepared is of the path before */
    const br_mpc_error error = br_path_load(&mpc->path, table, n, spacing_m);
    if (!error) limit_speeds(mpc);
    return error;
#else
    (void)n, (void)spacing_m;
    return BR_ERROR_PATH;
#endif
}

br_mpc_error br_mpc_set_clock(br_mpc *mpc, br_mpc_clock clock, void *context) {
    if (!mpc) return BR_ERROR_NULL;
    mpc->timer = (br_timer){.clock = clock, .context = context};
    return BR_OK;
}

int br_mpc_get_refusals(const br_mpc *mpc, int refused[BR_REFUSALS]) {
    if (!mpc || !refused) return 0;
    memcpy(refused, mpc->timer.refused, sizeof mpc->timer.refused);
    return mpc->timer.refusals;
}

br_mpc_error br_mpc_repeat(br_mpc *mpc, const int *refused, int count) {
    if (!mpc || (!refused && count)) return BR_ERROR_NULL;
    if (count < 0 || count > BR_REFUSALS) return BR_ERROR_PARAMETERS;
    mpc->timer.given = count;
    for (int i = 0; i < count; ++i) mpc->timer.refuse[i] = refused[i];
    mpc->timer.repeat_next = 1;
    return BR_OK;
}

void br_mpc_reset(br_mpc *mpc) {
    if (!mpc) return;
    mpc->warm = 0;
    br_invalidate(mpc, BR_LINEARISATION);
    mpc->ahead = mpc->prepared = mpc->prepared_iterations = 0;
    mpc->path.known = 0;
    br_caution_reset(&mpc->caution);
    br_mismatch_reset(&mpc->mismatch);
    mpc->turn = 0;
    mpc->stood = mpc->stuck = 0;
    mpc->attempts = mpc->starts = mpc->futile = mpc->looks = 0;
}

static int valid_noise(const br_mpc_noise *noise) {
    for (int i = 0; i < BR_NX; ++i)
        if (!(noise->step[i] >= 0 && isfinite(noise->step[i]))) return 0;
    return noise->values >= 0 && isfinite(noise->values) && br_all_finite(noise->squares, BR_NE) &&
           br_all_finite(noise->projection[0], BR_NE * BR_NPHI) &&
           br_all_finite(noise->information[0][0], BR_NE * BR_NPHI * BR_NPHI);
}

br_mpc_error br_mpc_observe(br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                            double duration_s, const double x_next[BR_NX],
                            const br_mpc_noise *noise) {
    if (!mpc || !x || !u || !x_next) return BR_ERROR_NULL;
    if (!(duration_s > 0 && duration_s <= BR_PREDICT_MAX_S)) return BR_ERROR_TIME;
    if (!br_plausible_state(x) || !br_plausible_state(x_next) ||
        !br_plausible(u, BR_INPUT_LIMIT, BR_NU))
        return BR_ERROR_STATE;
    if (noise && !valid_noise(noise)) return BR_ERROR_STATE;
    br_transition *newest = &mpc->mismatch.newest;
    newest->duration = duration_s;
    memcpy(newest->x, x, sizeof newest->x);
    memcpy(newest->u, u, sizeof newest->u);
    memcpy(newest->x_next, x_next, sizeof newest->x_next);
    newest->estimated = noise != NULL;
    newest->noise = noise ? *noise : (br_mpc_noise){.values = 0};
    mpc->watch.newest = *newest;
    return BR_OK;
}

br_mpc_error br_mpc_get_plan(const br_mpc *mpc, double *x, double *u) {
    if (!mpc) return BR_ERROR_NULL;
    if (x) memcpy(x, mpc->answer_x, sizeof mpc->answer_x);
    if (u) memcpy(u, mpc->answer_u, sizeof mpc->answer_u);
    return BR_OK;
}

br_mpc_error br_mpc_get_reference(const br_mpc *mpc, br_mpc_reference reference[BR_N]) {
    if (!mpc || !reference) return BR_ERROR_NULL;
    memcpy(reference, mpc->answer_reference, sizeof mpc->answer_reference);
    return BR_OK;
}

#if BR_HAS_PATH
br_mpc_error br_mpc_get_speeds(const br_mpc *mpc, double *speeds_mps, int n) {
    if (!mpc || !speeds_mps) return BR_ERROR_NULL;
    if (!mpc->path.ready) return BR_ERROR_NOT_READY;
    if (n != mpc->path.n) return BR_ERROR_PATH;
    memcpy(speeds_mps, mpc->path.speed[mpc->path.buffer], (size_t)n * sizeof *speeds_mps);
    return BR_OK;
}

br_mpc_error br_mpc_get_loss(const br_mpc *mpc, double *lost_s) {
    if (!mpc || !lost_s) return BR_ERROR_NULL;
    const br_path *path = &mpc->path;
    if (!path->ready) return BR_ERROR_NOT_READY;
    *lost_s = 0;
    for (int i = 0; i < path->n; ++i)
        *lost_s +=
            path->spacing * (1 / path->speed[path->buffer][i] - 1 / path->table[i][BR_LINE_SPEED]);
    return BR_OK;
}
#endif

br_mpc_error br_mpc_get_tube(const br_mpc *mpc, double tube[BR_N]) {
    if (!mpc || !tube) return BR_ERROR_NULL;
    memcpy(tube, mpc->answer_tube, sizeof mpc->answer_tube);
    return BR_OK;
}

/* --- functions of the step --- */

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

br_mpc_error br_mpc_set_covariance(br_mpc *mpc, const double covariance[BR_NX * BR_NX]) {
    if (!mpc || !covariance) return BR_ERROR_NULL;
    if (!br_all_finite(covariance, BR_NX * BR_NX)) return BR_ERROR_STATE;
    memcpy(mpc->caution.covariance, covariance, sizeof mpc->caution.covariance);
    mpc->caution.given = 1;
    return BR_OK;
}

br_mpc_error br_mpc_propagate(const br_mpc *mpc, const double x[BR_NX], const double begin[BR_NX],
                              const double u[BR_NU], double duration_s,
                              const double variance[BR_NE], const double disturbance[BR_NE],
                              double x_next[BR_NX], double jacobian[BR_NX * BR_NX],
                              double by_disturbance[BR_NX * BR_NE],
                              double covariance[BR_NX * BR_NX]) {
    if (!mpc) return BR_ERROR_NULL;
    return mpc->code->propagate(mpc, x, begin, u, duration_s, variance, disturbance, x_next,
                                jacobian, by_disturbance, covariance);
}

#if BR_HAS_PATH
br_mpc_error br_mpc_steer(const br_mpc *mpc, const double x[BR_NX], double *s_m, double *angle_rad,
                          double *outside_m) {
    return mpc ? mpc->code->steer(mpc, x, s_m, angle_rad, outside_m) : BR_ERROR_NULL;
}
#endif

br_mpc_error br_mpc_variance(br_mpc *mpc, const double v[BR_NV], double variance[BR_NE],
                             double noise[BR_NE]) {
    return mpc ? mpc->code->variance(mpc, v, variance, noise) : BR_ERROR_NULL;
}

br_mpc_error br_mpc_get_mismatch(const br_mpc *mpc, const double v[BR_NV],
                                 br_mpc_mismatch *mismatch) {
    return mpc ? mpc->code->mismatch(mpc, v, mismatch) : BR_ERROR_NULL;
}

br_mpc_error br_mpc_evaluate(const br_mpc *mpc, const double v[BR_NV], const double lambda[BR_NX],
                             double x_next[BR_NX], double jacobian[BR_NX * BR_NV],
                             double hessian[BR_NV * BR_NV]) {
    if (!mpc) return BR_ERROR_NULL;
    return mpc->code->evaluate(mpc, v, lambda, x_next, jacobian, hessian);
}

/* --- new weights between two steps: staged by any one thread, adopted by the control
 * thread, which goes back to the proven ones if they are worse.
 *
 * There are three buffers: in use, proven, and spare; the former two may be the same one. Or there
 * is one, which is all of them, so that nothing can be staged. mpc->spare is the state of the spare
 * buffer. A thread takes the buffer by setting BR_SPARE_TAKEN (acquire) and gives it back by
 * storing another state (release), so no staging writes a buffer that an earlier step may still be
 * reading. --- */

static int take_from(br_mpc *mpc, int owner) {
    return atomic_compare_exchange_strong_explicit(&mpc->spare, &owner, BR_SPARE_TAKEN,
                                                   memory_order_acquire, memory_order_relaxed);
}

static void hand_over(br_mpc *mpc, int owner) {
    atomic_store_explicit(&mpc->spare, owner, memory_order_release);
}

/* Speeds of the line anew, for other parameters or another line, by all weights that are loaded. */
static void limit_speeds(br_mpc *mpc) {
#if BR_HAS_PATH
    mpc->code->limit(mpc, mpc->gp_in_use);
    if (mpc->gp_proven != mpc->gp_in_use) mpc->code->limit(mpc, mpc->gp_proven);
    if (take_from(mpc, BR_SPARE_STAGED)) {
        mpc->code->limit(mpc, mpc->gp_spare);
        hand_over(mpc, BR_SPARE_STAGED);
    }
#else
    (void)mpc;
#endif
}

/* Other weights are in use from the next step on. */
static void use(br_mpc *mpc, int buffer) {
    const int same =
        buffer != mpc->gp_in_use && mpc->gp[buffer].identity == mpc->gp[mpc->gp_in_use].identity;
    mpc->gp_in_use = buffer;
#if BR_HAS_PATH
    /* a reference that knows more does not leap ahead */
    const double before = br_path_pace(&mpc->path, 1);
    mpc->path.buffer = buffer;
    mpc->caution.pace *= fmin(before / br_path_pace(&mpc->path, 1), 1);
#endif
    mpc->watch.since = mpc->watch.count;
    memset(mpc->watch.judged, 0, sizeof mpc->watch.judged);
    br_forget_linearisation(mpc);
    if (!same) br_mismatch_reset(&mpc->mismatch); /* it is that of the weights before */
}

/* The caller has taken the spare buffer and is the control thread. Weights that were in use without
 * being proven are given up. */
static void exchange(br_mpc *mpc) {
    const int before = mpc->gp_in_use, after = mpc->gp_spare;
    if (BR_WEIGHT_BUFFERS > 1)
        mpc->gp_spare = before == mpc->gp_proven ? 3 - before - after : before;
    use(mpc, after);
}

/* Into the spare buffer, which the caller has taken. */
static br_mpc_error load(br_mpc *mpc, const br_mpc_gp outputs[BR_NE]) {
    const br_mpc_error error = mpc->code->load(&mpc->gp[mpc->gp_spare], outputs);
    if (error) br_gp_clear(&mpc->gp[mpc->gp_spare]);
#if BR_HAS_PATH
    mpc->code->limit(mpc, mpc->gp_spare);
#endif
    return error;
}

br_mpc_error br_mpc_stage_weights(br_mpc *mpc, const br_mpc_gp outputs[BR_NE]) {
    if (!mpc || !outputs) return BR_ERROR_NULL;
    if (BR_WEIGHT_BUFFERS == 1) return BR_ERROR_LEFT_OUT;
    if (!take_from(mpc, BR_SPARE_STAGED) && !take_from(mpc, BR_SPARE_FREE)) return BR_ERROR_BUSY;
    const br_mpc_error error = load(mpc, outputs);
    hand_over(mpc, error ? BR_SPARE_FREE : BR_SPARE_STAGED);
    return error;
}

br_mpc_error br_mpc_adopt_weights(br_mpc *mpc) {
    if (!mpc) return BR_ERROR_NULL;
    if (BR_WEIGHT_BUFFERS == 1) return BR_ERROR_LEFT_OUT;
    if (!take_from(mpc, BR_SPARE_STAGED)) return BR_ERROR_NOT_STAGED;
    exchange(mpc);
    hand_over(mpc, BR_SPARE_FREE);
    return BR_OK;
}

br_mpc_error br_mpc_set_weights(br_mpc *mpc, const br_mpc_gp outputs[BR_NE]) {
    if (!mpc || !outputs) return BR_ERROR_NULL;
    if (!take_from(mpc, BR_SPARE_STAGED) && !take_from(mpc, BR_SPARE_FREE)) return BR_ERROR_BUSY;
    const br_mpc_error error = load(mpc, outputs);
    if (!error || BR_WEIGHT_BUFFERS == 1) exchange(mpc); /* else the weights in use stay */
    hand_over(mpc, BR_SPARE_FREE);
    return error ? error : br_mpc_prove_weights(mpc);
}

br_mpc_error br_mpc_prove_weights(br_mpc *mpc) {
    if (!mpc) return BR_ERROR_NULL;
    mpc->gp_proven = mpc->gp_in_use;
    return BR_OK;
}

br_mpc_error br_mpc_revert_weights(br_mpc *mpc) {
    if (!mpc) return BR_ERROR_NULL;
    if (BR_WEIGHT_BUFFERS == 1) return BR_ERROR_LEFT_OUT;
    if (mpc->gp_in_use != mpc->gp_proven) use(mpc, mpc->gp_proven);
    return BR_OK;
}

/* --- what the car has shown --- */

br_mpc_error br_mpc_get_watch(const br_mpc *mpc, const double resolution[BR_NE],
                              br_mpc_watch *out) {
    if (!mpc || !resolution || !out) return BR_ERROR_NULL;
    const br_watch *watch = &mpc->watch;
    double weights[BR_NE] = {};
    memset(out, 0, sizeof *out);
    out->fresh = (double)(watch->count - watch->since);
    for (int64_t k = watch->count - 1; k >= 0 && k >= watch->count - BR_WATCHED; --k) {
        const br_judged *judged = &watch->judged[k % BR_WATCHED];
        const br_sample *sample = &watch->sample[k % BR_SAMPLES];
        if (judged->number != k + 1) continue;
        out->samples += 1;
        for (int j = 0; j < BR_NE; ++j) {
            const double noise = sample->noise[j], in_use = judged->error[0][j];
            const double proven = judged->error[1][j], nominal = sample->residual[j];
            const double weight = 1 / (1 + noise / (resolution[j] * resolution[j]));
            weights[j] += weight;
            out->in_use[j] += weight * (in_use * in_use - noise);
            out->proven[j] += weight * (proven * proven - noise);
            out->nominal[j] += weight * (nominal * nominal - noise);
        }
    }
    for (int j = 0; j < BR_NE && out->samples; ++j) {
        out->in_use[j] = sqrt(fmax(out->in_use[j] / weights[j], 0));
        out->proven[j] = sqrt(fmax(out->proven[j] / weights[j], 0));
        out->nominal[j] = sqrt(fmax(out->nominal[j] / weights[j], 0));
    }
    return BR_OK;
}

br_mpc_error br_mpc_get_samples(const br_mpc *mpc, double features[BR_SAMPLES * BR_NZ],
                                double residuals[BR_SAMPLES * BR_NE],
                                double noise[BR_SAMPLES * BR_NE], int *count) {
    if (!mpc || !features || !residuals || !noise || !count) return BR_ERROR_NULL;
    const br_watch *watch = &mpc->watch;
    *count = (int)(watch->count < BR_SAMPLES ? watch->count : BR_SAMPLES);
    for (int i = 0; i < *count; ++i) {
        const br_sample *sample = &watch->sample[(watch->count - *count + i) % BR_SAMPLES];
        memcpy(features + i * BR_NZ, sample->z, sizeof sample->z);
        memcpy(residuals + i * BR_NE, sample->residual, sizeof sample->residual);
        memcpy(noise + i * BR_NE, sample->noise, sizeof sample->noise);
    }
    return BR_OK;
}

/* --- texts --- */

const char *br_mpc_error_text(br_mpc_error error) {
    static const char *const texts[] = {
        [BR_OK] = "no error",
        [BR_ERROR_NULL] = "a required pointer is NULL",
        [BR_ERROR_MEMORY] = "memory block too small or not aligned to 64 bytes",
        [BR_ERROR_PARAMETERS] = "a parameter is not finite or out of its range",
        [BR_ERROR_PATH] = "path table is unusable",
        [BR_ERROR_WEIGHTS] = "GP weights are unusable",
        [BR_ERROR_NOT_READY] = "parameters or path have not been set",
        [BR_ERROR_TIME] = "a time is negative, not finite or too long",
        [BR_ERROR_STATE] = "a state or input is not finite or absurd",
        [BR_ERROR_BUSY] = "another thread is staging weights",
        [BR_ERROR_NOT_STAGED] = "no weights are staged",
        [BR_ERROR_INSTRUCTIONS] = "this processor lacks these instructions",
        [BR_ERROR_LEFT_OUT] = "it needs what was left out of this build by --weight-buffers or "
                              "--no-estimator",
    };
    return (unsigned)error < sizeof texts / sizeof texts[0] ? texts[error] : "unknown error";
}

const char *br_mpc_status_text(br_mpc_status status) {
    static const char *const texts[] = {
        [BR_CONVERGED] = "converged",
        [BR_ACCEPTABLE] = "acceptable",
        [BR_DEFECT] = "dynamics defect too large",
        [BR_INFEASIBLE] = "QP infeasible",
        [BR_QP_LIMIT] = "QP iteration limit",
        [BR_NOT_FINITE] = "not finite",
        [BR_BAD_STATE] = "bad state",
        [BR_TIME_LIMIT] = "out of time or QP steps before the plan was usable",
    };
    return (unsigned)status < sizeof texts / sizeof texts[0] ? texts[status] : "unknown status";
}

int br_mpc_abi(void) { return BR_ABI; }
