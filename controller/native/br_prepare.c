/* Time within a call, the plan in step with time, and the preparation phase between two steps. */
#include <math.h>

#include "br_internal.h"

/* --- the clock that the host gave --- */

/* 0 without a clock; its time is measured with and without a budget, so that br_mpc_prepare knows
 * what an iteration takes. */
double br_timer_now(const br_timer *timer) {
    return timer->clock ? timer->clock(timer->context) : 0;
}

void br_timer_start(br_timer *timer, double budget) {
    timer->limited = timer->clock && budget > 0;
    timer->deadline = timer->limited ? br_timer_now(timer) + budget : 0;
}

/* Whether what takes that long fits; a clock that gives NaN never lets anything begin. */
int br_timer_allows(const br_timer *timer, double now, double duration) {
    return !timer->limited || timer->deadline - now >= duration;
}

void br_timer_note(const br_timer *timer, double begin, double *longest) {
    *longest = fmax(*longest, br_timer_now(timer) - begin);
}

/* --- the plan and its preparation --- */

int br_plausible_state(const double x[BR_NX]) {
    for (int i = 0; i < BR_NX; ++i)
        if (!(fabs(x[i]) <= BR_STATE_LIMIT[i])) return 0;
    return 1;
}

int br_plausible_input(const double u[BR_NU]) {
    for (int c = 0; c < BR_NU; ++c)
        if (!(fabs(u[c]) <= BR_INPUT_LIMIT[c])) return 0;
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
    if (!mpc->valid[BR_LINEARISATION]) br_sqp_linearise(mpc);
}

void br_undo_preparation(br_mpc *mpc) {
    if (mpc->ahead) {
        mpc->plan = mpc->kept;
        memcpy(mpc->qp.sense, mpc->kept_sense, sizeof mpc->kept_sense);
        br_invalidate(mpc, BR_LINEARISATION);
    }
    mpc->ahead = mpc->looked = 0;
    br_innovation_undo(&mpc->innovation);
}

/* Of other weights or code; the preparation's new last stage was predicted with those before. */
void br_forget_linearisation(br_mpc *mpc) {
    br_undo_preparation(mpc);
    br_invalidate(mpc, BR_LINEARISATION);
}

/* Time for an iteration, and what follows it: restoring the best plan, shift and factorisation,
 * which take another one's, and caution. */
static double iteration_and_rest(const br_timer *timer) {
    return 2 * timer->iteration + timer->caution;
}

/* The next problem as far as it can be told: from the state that the plan predicts after so many
 * shifts, with the input before it and the line's reference there. Without a shift, the last one.
 */
static void foresee(br_mpc *mpc, double elapsed, int shifts) {
    memcpy(mpc->reference, mpc->answer_reference, sizeof mpc->reference);
    if (shifts) {
        memcpy(mpc->x0, mpc->plan.x[0], sizeof mpc->x0);
        memcpy(mpc->u_before, mpc->answer_u[shifts - 1], sizeof mpc->u_before);
    }
#if BR_HAS_PATH
    if (shifts && !mpc->follows) {
        double lateral;
        mpc->path.age += elapsed;
        br_path_project(&mpc->path, mpc->x0, &lateral);
        br_path_plan(&mpc->path, mpc->caution.pace, mpc->reference);
    }
#endif
    br_invalidate(mpc, BR_FOLLOWED);
    br_evaluate_bounds(mpc);
    br_path_follow(mpc);
}

/* Iterations at the problem at hand, towards tolerance. Returns whether there may be time left. */
static int improve(br_mpc *mpc, int shifts) {
    const br_timer *timer = &mpc->timer;
    memset(&mpc->info, 0, sizeof mpc->info);
    mpc->penalty = 0;
    if (shifts) br_caution_update(mpc); /* else it is that of the last step */
    br_residuals(mpc);
    br_mpc_status status = br_judge(mpc);
    br_incumbent_reset(mpc);
    br_incumbent_keep(mpc, status, 1);
    const int limit = br_iteration_limit(mpc);
    int time = 1;
    while (mpc->info.iterations < limit && (status == BR_ACCEPTABLE || status == BR_DEFECT)) {
        time = br_timer_allows(timer, br_timer_now(timer), iteration_and_rest(timer));
        if (!time) break;
        status = br_sqp_iterate(mpc, 1, shifts && mpc->info.iterations == 0);
        br_incumbent_keep(mpc, status, 1);
    }
    mpc->prepared_iterations += mpc->info.iterations;
    br_incumbent_restore(mpc, status);
    return time;
}

/* Looks for a better local minimum from another start, if there is time for that and for what
 * follows. */
static void look_elsewhere(br_mpc *mpc) {
    br_timer *timer = &mpc->timer;
    if (mpc->follows) return; /* costs from different feet on the line do not compare */
    timer->deadline -= iteration_and_rest(timer);
    if (!br_timer_allows(timer, br_timer_now(timer), BR_SECOND_START_ITERATIONS * timer->iteration))
        return;
    if (!mpc->valid[BR_LINEARISATION]) br_sqp_linearise(mpc);
    memset(&mpc->info, 0, sizeof mpc->info);
    br_residuals(mpc);
    const br_mpc_status status = br_judge(mpc);
    if (br_usable(status)) br_start_again(mpc, status, mpc->looks++);
    mpc->looked = br_usable(status) && !mpc->own_reference;
    mpc->prepared_iterations += mpc->info.iterations;
}

/* Solves the problem that is foreseen, so that the step begins near its solution: the advanced-step
 * real-time iteration (Nurkanovic, Zanelli, Albrecht, Diehl, "The advanced step real time iteration
 * for NMPC", 2019). */
static void solve_ahead(br_mpc *mpc, double elapsed, int shifts) {
    const br_timer *timer = &mpc->timer;
    if (mpc->turn) return;               /* its reference is made from the measured state */
    if (!(timer->iteration > 0)) return; /* no step has shown yet how long one takes */
    const double needed = iteration_and_rest(timer) + (shifts ? timer->caution : 0);
    if (!br_timer_allows(timer, br_timer_now(timer), needed)) return;
    if (!mpc->valid[BR_LINEARISATION]) br_sqp_linearise(mpc);
    double x0[BR_NX], u_before[BR_NU];
    const double s = mpc->path.s, age = mpc->path.age;
    const int known = mpc->path.known;
    memcpy(x0, mpc->x0, sizeof x0);
    memcpy(u_before, mpc->u_before, sizeof u_before);
    foresee(mpc, elapsed, shifts);
    if (improve(mpc, shifts)) look_elsewhere(mpc);
    br_invalidate(mpc, BR_TUBE);
    if (!mpc->valid[BR_LINEARISATION]) br_sqp_linearise(mpc);
    memcpy(mpc->x0, x0, sizeof x0);
    memcpy(mpc->u_before, u_before, sizeof u_before);
    mpc->path.s = s;
    mpc->path.age = age;
    mpc->path.known = known;
}

br_mpc_error br_prepare(br_mpc *mpc, double elapsed_s, double budget_s) {
    br_timer_start(&mpc->timer, budget_s);
    if (!mpc->has_parameters) return BR_ERROR_NOT_READY;
    if (!(elapsed_s >= 0 && isfinite(elapsed_s))) return BR_ERROR_TIME;
    br_watch_update(mpc);
    double lag = mpc->lag + elapsed_s;
    if (!mpc->warm || lag >= BR_HORIZON_S) return BR_OK;
    const int first = !mpc->ahead, shifts = br_shifts_due(&lag);
    const int ahead = first && mpc->timer.limited, known = !mpc->own_reference;
    if (ahead && !known) solve_ahead(mpc, elapsed_s, 0); /* the next reference is the caller's */
    if (first) {
        mpc->kept = mpc->plan;
        memcpy(mpc->kept_sense, mpc->qp.sense, sizeof mpc->kept_sense);
    }
    br_align(mpc, shifts);
    if (ahead && known) solve_ahead(mpc, elapsed_s, shifts);
    br_path_follow(mpc);
    br_caution_update(mpc);
    if (!mpc->valid[BR_FACTORS]) br_qp_factorise(mpc);
    mpc->prepared = mpc->valid[BR_FACTORS];
    return BR_OK;
}

br_mpc_error br_rehearse(br_mpc *mpc) {
    if (!mpc->prepared || !mpc->valid[BR_FACTORS]) return BR_OK;
    br_sqp_linearise(mpc);
    br_path_follow(mpc);
    br_qp_factorise(mpc);
    return BR_OK;
}
