/* Keeping the plan in step with time, and the preparation phase between two steps. */
#include <math.h>

#include "br_internal.h"

int br_plausible_state(const double x[BR_NX]) {
    for (int i = 0; i < BR_NX; ++i)
        if (!(fabs(x[i]) <= BR_STATE_LIMIT[i])) return 0;
    return 1;
}

/* Whole stages that a plan behind by *lag, which is below the horizon, has to be shifted; *lag is
 * what remains, at most half a stage to either side. */
int br_shifts_due(double *lag) {
    int shifts = 0;
    for (; *lag >= 0.5 * BR_TS; *lag -= BR_TS) ++shifts;
    return shifts;
}

/* The plan, shifted that often since the step before and linearised. */
void br_align(br_mpc *mpc, int shifts) {
    if (shifts < mpc->ahead) br_undo_preparation(mpc); /* the step comes sooner than expected */
    for (; mpc->ahead < shifts; mpc->ahead += 1) br_sqp_shift(mpc);
    if (!mpc->linearised) br_sqp_linearise(mpc);
}

void br_undo_preparation(br_mpc *mpc) {
    if (mpc->ahead) {
        mpc->plan = mpc->kept;
        memcpy(mpc->qp.sense, mpc->kept_sense, sizeof mpc->kept_sense);
        mpc->linearised = mpc->qp.factorised = mpc->qp.evaluated = mpc->followed = 0;
        mpc->caution.known = 0;
    }
    mpc->ahead = 0;
}

/* Of other weights or code; the preparation's new last stage was predicted with those before. */
void br_forget_linearisation(br_mpc *mpc) {
    br_undo_preparation(mpc);
    mpc->linearised = mpc->qp.factorised = mpc->caution.known = 0;
}

/* Time for an iteration, and what follows it: restoring the best plan, shift and factorisation,
 * which take another one's, and caution. */
static double iteration_and_rest(const br_timer *timer) {
    return 2 * timer->iteration + timer->caution;
}

/* Further iterations at the last problem, towards tolerance. Returns whether there may be time
 * left. */
static int improve(br_mpc *mpc) {
    const br_timer *timer = &mpc->timer;
    if (!(timer->iteration > 0)) return 0; /* no step has shown yet how long that takes */
    if (!br_timer_allows(timer, br_timer_now(timer), iteration_and_rest(timer))) return 0;
    if (!mpc->linearised) br_sqp_linearise(mpc);
    memset(&mpc->info, 0, sizeof mpc->info);
    mpc->penalty = 0;
    br_residuals(mpc);
    br_mpc_status status = br_judge(mpc);
    br_incumbent_reset(mpc);
    br_incumbent_keep(mpc, status, 1);
    const int limit = br_iteration_limit(mpc);
    int time = 1;
    while (mpc->info.iterations < limit && (status == BR_ACCEPTABLE || status == BR_DEFECT)) {
        time = br_timer_allows(timer, br_timer_now(timer), iteration_and_rest(timer));
        if (!time) break;
        status = br_sqp_iterate(mpc, 1, 0);
        br_incumbent_keep(mpc, status, 1);
    }
    mpc->prepared_iterations += mpc->info.iterations;
    br_incumbent_restore(mpc, status);
    return time;
}

/* Looks for a better local minimum of the last problem from another start, if there is time for
 * that and for what follows. */
static void look_elsewhere(br_mpc *mpc) {
    br_timer *timer = &mpc->timer;
    if (mpc->turn) return;    /* there is one way to turn */
    if (mpc->follows) return; /* costs from different feet on the line do not compare */
    timer->deadline -= iteration_and_rest(timer);
    if (!br_timer_allows(timer, br_timer_now(timer), BR_SECOND_START_ITERATIONS * timer->iteration))
        return;
    if (!mpc->linearised) br_sqp_linearise(mpc);
    memset(&mpc->info, 0, sizeof mpc->info);
    br_residuals(mpc);
    const br_mpc_status status = br_judge(mpc);
    if (br_usable(status)) br_start_again(mpc, status, mpc->looks++);
    mpc->prepared_iterations += mpc->info.iterations;
}

br_mpc_error br_prepare(br_mpc *mpc, double elapsed_s, double budget_s) {
    br_timer_start(&mpc->timer, budget_s);
    if (!mpc->has_parameters) return BR_ERROR_NOT_READY;
    if (!(elapsed_s >= 0 && isfinite(elapsed_s))) return BR_ERROR_TIME;
    double lag = mpc->lag + elapsed_s;
    if (!mpc->warm || lag >= BR_HORIZON_S) return BR_OK;
    if (!mpc->ahead && mpc->timer.limited && improve(mpc)) look_elsewhere(mpc);
    if (!mpc->ahead) {
        mpc->kept = mpc->plan;
        memcpy(mpc->kept_sense, mpc->qp.sense, sizeof mpc->kept_sense);
    }
    br_align(mpc, br_shifts_due(&lag));
    br_path_follow(mpc);
    br_caution_update(mpc);
    if (!mpc->qp.factorised) br_qp_factorise(mpc);
    mpc->prepared = mpc->qp.factorised;
    return BR_OK;
}

br_mpc_error br_rehearse(br_mpc *mpc) {
    if (!mpc->prepared || !mpc->qp.factorised) return BR_OK;
    br_sqp_linearise(mpc);
    br_path_follow(mpc);
    br_qp_factorise(mpc);
    return BR_OK;
}
