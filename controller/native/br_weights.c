/* New weights between two steps: staged by any one thread, adopted by the control thread, which
 * goes back to the proven ones if they are worse.
 *
 * There are three buffers: in use, proven, and spare; the former two may be the same one.
 * mpc->spare is the state of the spare buffer. A thread takes the buffer by setting BR_SPARE_TAKEN
 * (acquire) and gives it back by storing another state (release), so no staging writes a buffer
 * that an earlier step may still be reading.
 */
#include <math.h>

#include "br_internal.h"

void br_weights_init(br_mpc *mpc) {
    atomic_init(&mpc->spare, BR_SPARE_FREE);
    mpc->gp_in_use = mpc->gp_proven = 0;
    mpc->gp_spare = 1;
}

static int take_from(br_mpc *mpc, int owner) {
    return atomic_compare_exchange_strong_explicit(&mpc->spare, &owner, BR_SPARE_TAKEN,
                                                   memory_order_acquire, memory_order_relaxed);
}

static void hand_over(br_mpc *mpc, int owner) {
    atomic_store_explicit(&mpc->spare, owner, memory_order_release);
}

/* Other weights are in use from the next step on. */
static void use(br_mpc *mpc, int buffer) {
    mpc->gp_in_use = buffer;
    mpc->watch.since = mpc->watch.count;
    memset(mpc->watch.judged, 0, sizeof mpc->watch.judged);
    br_forget_linearisation(mpc);
    br_innovation_reset(&mpc->innovation);
}

/* The caller has taken the spare buffer and is the control thread. Weights that were in use without
 * being proven are given up. */
static void exchange(br_mpc *mpc) {
    const int before = mpc->gp_in_use, after = mpc->gp_spare;
    mpc->gp_spare = before == mpc->gp_proven ? 3 - before - after : before;
    use(mpc, after);
}

br_mpc_error br_mpc_stage_weights(br_mpc *mpc, const br_mpc_gp outputs[BR_NE]) {
    if (!mpc || !outputs) return BR_ERROR_NULL;
    if (!take_from(mpc, BR_SPARE_STAGED) && !take_from(mpc, BR_SPARE_FREE)) return BR_ERROR_BUSY;
    const br_mpc_error error = mpc->code->load(&mpc->gp[mpc->gp_spare], outputs);
    hand_over(mpc, error ? BR_SPARE_FREE : BR_SPARE_STAGED);
    return error;
}

br_mpc_error br_mpc_adopt_weights(br_mpc *mpc) {
    if (!mpc) return BR_ERROR_NULL;
    if (!take_from(mpc, BR_SPARE_STAGED)) return BR_ERROR_NOT_STAGED;
    exchange(mpc);
    hand_over(mpc, BR_SPARE_FREE);
    return BR_OK;
}

br_mpc_error br_mpc_set_weights(br_mpc *mpc, const br_mpc_gp outputs[BR_NE]) {
    if (!mpc || !outputs) return BR_ERROR_NULL;
    if (!take_from(mpc, BR_SPARE_STAGED) && !take_from(mpc, BR_SPARE_FREE)) return BR_ERROR_BUSY;
    const br_mpc_error error = mpc->code->load(&mpc->gp[mpc->gp_spare], outputs);
    if (!error) exchange(mpc); /* else the weights in use stay */
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
    if (mpc->gp_in_use != mpc->gp_proven) use(mpc, mpc->gp_proven);
    return BR_OK;
}

/* --- what the car has shown --- */

br_mpc_error br_mpc_get_watch(const br_mpc *mpc, br_mpc_watch *out) {
    if (!mpc || !out) return BR_ERROR_NULL;
    const br_watch *watch = &mpc->watch;
    memset(out, 0, sizeof *out);
    out->fresh = (double)(watch->count - watch->since);
    for (int64_t k = watch->count - 1; k >= 0 && k >= watch->count - BR_WATCHED; --k) {
        const br_judged *judged = &watch->judged[k % BR_WATCHED];
        const br_sample *sample = &watch->sample[k % BR_SAMPLES];
        if (judged->number != k + 1) continue;
        out->samples += 1;
        for (int j = 0; j < BR_NE; ++j) {
            out->in_use[j] += judged->error[0][j] * judged->error[0][j];
            out->proven[j] += judged->error[1][j] * judged->error[1][j];
            out->nominal[j] += sample->residual[j] * sample->residual[j];
        }
    }
    for (int j = 0; j < BR_NE && out->samples; ++j) {
        out->in_use[j] = sqrt(out->in_use[j] / out->samples);
        out->proven[j] = sqrt(out->proven[j] / out->samples);
        out->nominal[j] = sqrt(out->nominal[j] / out->samples);
    }
    return BR_OK;
}

br_mpc_error br_mpc_get_samples(const br_mpc *mpc, double features[BR_SAMPLES * BR_NZ],
                                double residuals[BR_SAMPLES * BR_NE], int *count) {
    if (!mpc || !features || !residuals || !count) return BR_ERROR_NULL;
    const br_watch *watch = &mpc->watch;
    *count = (int)(watch->count < BR_SAMPLES ? watch->count : BR_SAMPLES);
    for (int i = 0; i < *count; ++i) {
        const br_sample *sample = &watch->sample[(watch->count - *count + i) % BR_SAMPLES];
        memcpy(features + i * BR_NZ, sample->z, sizeof sample->z);
        memcpy(residuals + i * BR_NE, sample->residual, sizeof sample->residual);
    }
    return BR_OK;
}
