/* Real-time SQP: the plan's start, its shift, and one iteration.
 *
 * An iteration solves the QP at the linearisation in store, takes a step (the full one unless the
 * plan gets worse) and linearises at the new plan. That linearisation gives the residuals from
 * which the status is derived, and, shifted by a stage, it is what the next control step starts
 * from: only its last stage is new. Residuals need no second derivatives. These are made when a QP
 * does: after the last iteration of a step, by br_mpc_prepare.
 */
#include "br_internal.h"

/* Without a plan from before: the problem's guess, see where that leads; or turn. Where that has
 * led to no plan, Newton's steps may go round in circles: then, but for a turn, another guess is
 * the next. */
void br_sqp_cold_start(br_mpc *mpc) {
    static const double shares[BR_COLD_GUESSES] = {0.5, 1.0, 0.25, 0.0};
    double u[BR_NU];
    br_first_guess(mpc, mpc->u_before, shares[mpc->attempts % BR_COLD_GUESSES], u);
    br_sqp_roll_out(mpc, u);
}

void br_sqp_roll_out(br_mpc *mpc, const double u[BR_NU]) {
    memcpy(mpc->plan.x[0], mpc->x0, sizeof mpc->x0);
    memset(mpc->plan.costate, 0, sizeof mpc->plan.costate);
    memset(mpc->plan.multiplier, 0, sizeof mpc->plan.multiplier);
    for (int k = 0; k < BR_N; ++k) {
        memcpy(mpc->plan.u[k], mpc->turn || !u ? mpc->led_u[k] : u, sizeof mpc->plan.u[k]);
        br_linearise_stages(mpc, k, 1, k);
        memcpy(mpc->plan.x[k + 1], mpc->stage[k].f, sizeof mpc->plan.x[k + 1]);
    }
    br_qp_forget_working_set(&mpc->qp);
}

/* By one stage. */
void br_sqp_shift(br_mpc *mpc) {
    const int last = BR_N - 1, free_slot = mpc->stage[0].slot;
    br_invalidate(mpc, BR_TUBE);
    memmove(mpc->plan.x, mpc->plan.x + 1, BR_N * sizeof mpc->plan.x[0]);
    memmove(mpc->plan.u, mpc->plan.u + 1, (size_t)last * sizeof mpc->plan.u[0]);
    memmove(mpc->plan.costate, mpc->plan.costate + 1, BR_N * sizeof mpc->plan.costate[0]);
    memmove(mpc->stage, mpc->stage + 1, (size_t)last * sizeof mpc->stage[0]);
    br_qp_shift_rows(mpc->plan.multiplier, sizeof mpc->plan.multiplier[0]);
    br_qp_shift_rows(mpc->qp.sense, sizeof mpc->qp.sense[0]);
    for (int c = 0; c < BR_NU; ++c)
        if (!BR_INPUT_HELD[c]) mpc->plan.u[last][c] = 0;
    if (mpc->valid[BR_LINEARISATION])
        br_linearise_stages(mpc, last, 1, free_slot);
    else
        br_linearise_plan(mpc);
    memcpy(mpc->plan.x[BR_N], mpc->stage[last].f, sizeof mpc->plan.x[BR_N]);
}

/* Changes of the states under the QP's inputs, and the costates from the QP's optimality:
 * lambda_k = grad_x cost + W (dx, du) + A' lambda_{k+1} + (gradients of the rows)' multipliers. */
static void direction(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    memcpy(qp->delta_x[0], qp->xbar[0], sizeof qp->xbar[0]);
    for (int k = 0; k < BR_N; ++k) {
        const double *dx = qp->delta_x[k], *du = &qp->delta_u[BR_NU * k];
        BR_UNROLL
        for (int i = 0; i < BR_NX; ++i) {
            const double *row = mpc->stage[k].jacobian[i];
            double sum = mpc->stage[k].f[i] - mpc->plan.x[k + 1][i];
            for (int j = 0; j < BR_NX; ++j) sum += row[j] * dx[j];
            BR_UNROLL
            for (int c = 0; c < BR_NU; ++c) sum += row[BR_NX + c] * du[c];
            qp->delta_x[k + 1][i] = sum;
        }
    }
    for (int k = BR_N; k >= 1; --k) {
        const br_stage_terms *terms = &qp->terms[k - 1];
        const double *dx = qp->delta_x[k];
        double *lambda = qp->costate_next[k];
        memcpy(lambda, terms->in_x, sizeof qp->costate_next[k]);
        br_add_curvature(&qp->second[k - 1], 1.0, dx, lambda);
        BR_UNROLL
        for (int r = 0; r < BR_NR; ++r) BR_UNROLL
        for (int n = BR_ROW_START[r]; n < BR_ROW_START[r + 1]; ++n)
            lambda[BR_ROW_INDEX[n]] += qp->multiplier[BR_ROW(r, k - 1)] * terms->gradient[n];
        if (k == BR_N) continue;
        const br_stage *stage = &mpc->stage[k];
        const double *after = qp->costate_next[k + 1], *du = &qp->delta_u[BR_NU * k];
        BR_UNROLL
        for (int i = 0; i < BR_NX; ++i) {
            BR_UNROLL
            for (int n = BR_AT_START[i]; n < BR_AT_START[i + 1]; ++n)
                lambda[i] += stage->jacobian[BR_AT_INDEX[n]][i] * after[BR_AT_INDEX[n]];
            BR_UNROLL
            for (int n = BR_WXX_START[i]; n < BR_WXX_START[i + 1]; ++n)
                lambda[i] += stage->hessian[i][BR_WXX_INDEX[n]] * dx[BR_WXX_INDEX[n]];
        }
        BR_UNROLL
        for (int c = 0; c < BR_NU; ++c) BR_UNROLL
        for (int n = BR_WUX_START[c]; n < BR_WUX_START[c + 1]; ++n)
            lambda[BR_WUX_INDEX[n]] += stage->hessian[BR_WUX_INDEX[n]][BR_NX + c] * du[c];
    }
}

static void blend(double *out, const double *from, const double *to, double t, int n) {
    for (int i = 0; i < n; ++i) out[i] = from[i] + t * (to[i] - from[i]);
}

/* The plan at a fraction t of the step from mpc->before, linearised (all but the Hessians). */
static void move(br_mpc *mpc, double t) {
    const br_plan *from = &mpc->before;
    const br_qp *qp = &mpc->qp;
    double *x = mpc->plan.x[0], *u = mpc->plan.u[0];
    const double *x_from = from->x[0], *u_from = from->u[0], *dx = qp->delta_x[0];
    for (int i = 0; i < (BR_N + 1) * BR_NX; ++i) x[i] = x_from[i] + t * dx[i];
    for (int i = 0; i < BR_NU * BR_N; ++i) u[i] = u_from[i] + t * qp->delta_u[i];
    blend(mpc->plan.costate[1], from->costate[1], qp->costate_next[1], t, BR_N * BR_NX);
    blend(mpc->plan.multiplier, from->multiplier, qp->multiplier, t, BR_ROWS);
    br_linearise_plan(mpc);
}

/* Exact penalty: above every costate that prices a defect. */
static double penalty(const br_qp *qp) {
    const double *costate = qp->costate_next[1];
    double largest = 0;
    for (int i = 0; i < BR_N * BR_NX; ++i) largest = fmax(largest, fabs(costate[i]));
    return 1.5 * largest;
}

/* Full step; halved while neither the merit nor the KKT residuals improve (Newton's own steps may
 * raise the merit near a solution, where the residuals are exact). The first iteration of a
 * warm step takes any usable full step: the reference has moved on since the plan was made, so
 * that what the plan is worth now is no measure (measured: half the time at the 99th percentile,
 * and a tenth of the first input's error). Out of time, it leaves the plan at the trial done. */
static void line_search(br_mpc *mpc, int first_of_warm) {
    br_timer *timer = &mpc->timer;
    direction(mpc);
    mpc->penalty = penalty(&mpc->qp);
    br_residuals(mpc);
    const double merit = mpc->merit, residual = br_worse(mpc->info.stationarity, mpc->info.defect);
    mpc->before = mpc->plan;
    double t = 1.0;
    for (int trial = 0; trial < BR_LINE_SEARCH_TRIALS; ++trial, t *= 0.5) {
        const double begin = br_timer_now(timer);
        if (trial && !br_timer_allows(timer, begin, timer->trial)) return;
        move(mpc, t);
        br_residuals(mpc);
        br_timer_note(timer, begin, &timer->trial);
        if (first_of_warm && br_judge(mpc) <= BR_ACCEPTABLE) return;
        if (mpc->merit <= merit ||
            br_worse(mpc->info.stationarity, mpc->info.defect) <= 0.9 * residual)
            return;
        mpc->info.shortened += 1;
    }
}

/* One iteration from the plan and its linearisation. warm: the QP starts from the working set
 * before. first_of_warm: see line_search. The time it took is noted. */
br_mpc_status br_sqp_iterate(br_mpc *mpc, int warm, int first_of_warm) {
    br_timer *timer = &mpc->timer;
    const double begin = br_timer_now(timer);
    br_path_follow(mpc);
    br_mpc_status status = br_qp_condense(mpc);
    if (status == BR_CONVERGED) status = br_qp_solve(mpc, warm);
    if (status == BR_CONVERGED) {
        line_search(mpc, first_of_warm);
        mpc->info.iterations += 1;
        status = br_judge(mpc);
    }
    br_timer_note(timer, begin, &timer->iteration);
    return status;
}

/* --- plans that are kept: the incumbent, the best one of several iterations, which is returned
 * although a later one fails; those of two starts, which are compared; those from before --- */

/* Keeps the plan at hand, whose residuals are in info. */
void br_plan_keep(const br_mpc *mpc, br_mpc_status status, br_incumbent *kept) {
    kept->plan = mpc->plan;
    kept->info = mpc->info;
    kept->status = status;
    kept->residual = br_residual(mpc);
    kept->worth = mpc->worth;
}

static void put_back(br_mpc *mpc, const br_incumbent *incumbent) {
    mpc->plan = incumbent->plan;
    br_invalidate(mpc, BR_LINEARISATION);
    mpc->info.stationarity = incumbent->info.stationarity;
    mpc->info.defect = incumbent->info.defect;
    mpc->info.bound = incumbent->info.bound;
    mpc->info.cost = incumbent->info.cost;
    mpc->info.slack_max_m = incumbent->info.slack_max_m;
    mpc->worth = incumbent->worth;
}

void br_incumbent_reset(br_mpc *mpc) { mpc->incumbent.status = BR_NOT_FINITE; }

/* Keeps the plan, whose residuals are in info. lowest: only if it is better than the one kept. Else
 * the latest usable one, which is how iterations without a budget have always ended. */
void br_incumbent_keep(br_mpc *mpc, br_mpc_status status, int lowest) {
    br_incumbent *incumbent = &mpc->incumbent;
    if (lowest ? status > BR_DEFECT : !br_usable(status)) return;
    const double residual = br_residual(mpc);
    const int better = status < incumbent->status ||
                       (status == incumbent->status && residual < incumbent->residual);
    if (lowest && !better) return;
    br_plan_keep(mpc, status, incumbent);
}

/* Puts the best plan and its residuals back. Returns its status, or the given one if it is not
 * usable either. */
br_mpc_status br_incumbent_restore(br_mpc *mpc, br_mpc_status status) {
    const br_incumbent *incumbent = &mpc->incumbent;
    if (incumbent->status > BR_DEFECT) return status;
    if (incumbent->info.iterations != mpc->info.iterations) put_back(mpc, incumbent);
    return br_usable(incumbent->status) ? incumbent->status : status;
}

/* Puts back a plan from before the iterations at hand. */
void br_plan_restore(br_mpc *mpc, const br_incumbent *kept) {
    put_back(mpc, kept);
    br_qp_forget_working_set(&mpc->qp); /* that of the plan that was left */
}

/* Leaves the better one of the first plan and the one at hand: the usable one, or the one of less
 * cost. Returns its status; *second: whether it is the one at hand. */
br_mpc_status br_first_plan_compare(br_mpc *mpc, br_mpc_status status, int *second) {
    const br_incumbent *first = &mpc->first;
    *second = br_usable(status) && (!br_usable(first->status) || mpc->worth < first->worth);
    if (*second) return status;
    put_back(mpc, first);
    return first->status;
}
