/* New weights between two steps: staged by any one thread, adopted by the control thread.
 *
 * mpc->spare says whose the spare buffer is. Who changes it to BR_SPARE_TAKEN (acquire) may read
 * gp_in_use and write the buffer that is not in use, and hands it on with a store (release); so the
 * exchange, and the steps that read the buffer before it, happen before the next staging.
 */
#include "br_internal.h"

void br_weights_init(br_mpc *mpc) { atomic_init(&mpc->spare, BR_SPARE_FREE); }

static int take_from(br_mpc *mpc, int owner) {
    return atomic_compare_exchange_strong_explicit(&mpc->spare, &owner, BR_SPARE_TAKEN,
                                                   memory_order_acquire, memory_order_relaxed);
}

static void hand_over(br_mpc *mpc, int owner) {
    atomic_store_explicit(&mpc->spare, owner, memory_order_release);
}

/* The caller has taken the spare buffer and is the control thread. */
static void exchange(br_mpc *mpc) {
    mpc->gp_in_use = !mpc->gp_in_use;
    br_forget_linearisation(mpc);
    br_innovation_reset(&mpc->innovation);
}

br_mpc_error br_mpc_stage_weights(br_mpc *mpc, const br_mpc_gp outputs[BR_NE]) {
    if (!mpc || !outputs) return BR_ERROR_NULL;
    if (!take_from(mpc, BR_SPARE_STAGED) && !take_from(mpc, BR_SPARE_FREE)) return BR_ERROR_BUSY;
    const br_mpc_error error = mpc->code->load(&mpc->gp[!mpc->gp_in_use], outputs);
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
    const br_mpc_error error = mpc->code->load(&mpc->gp[!mpc->gp_in_use], outputs);
    if (!error) exchange(mpc); /* else the weights in use stay */
    hand_over(mpc, BR_SPARE_FREE);
    return error;
}
