/* What a plan is worth, measured at the plan itself: KKT residuals, objective, merit, status. */
#include <math.h>

#include "br_internal.h"

int br_all_finite(const double *values, int n) {
    double sum = 0; /* 0 * inf and 0 * nan are nan */
    for (int i = 0; i < n; ++i) sum += 0.0 * values[i];
    return sum == 0.0;
}

/* How far a row is outside its bounds; negative within. */
static double violation(const br_stage_terms *terms, int r) {
    return br_worse(terms->lower[r] - terms->value[r], terms->value[r] - terms->upper[r]);
}

/* Objective of a stage with the slack of its soft rows; the largest one is noted. */
static double stage_cost(br_mpc *mpc, const br_stage_terms *terms) {
    double cost = terms->cost;
    for (int r = 0; r < BR_NR; ++r) {
        if (!(BR_ROW_SOFT[r] && mpc->qp.penalty[r] > 0)) continue;
        const double slack = br_worse(0, violation(terms, r));
        mpc->info.slack_max_m = br_worse(mpc->info.slack_max_m, slack);
        cost += mpc->qp.penalty[r] * slack * slack;
    }
    return cost;
}

static double bound_violation(const br_mpc *mpc, int k) {
    double worst = -INFINITY;
    const double *u = mpc->plan.u[k - 1];
    for (int c = 0; c < BR_NU; ++c)
        worst = br_worse(worst, fmax(mpc->u_lower[c] - u[c], u[c] - mpc->u_upper[c]));
    for (int r = 0; r < BR_NR; ++r)
        if (!BR_ROW_SOFT[r]) worst = br_worse(worst, violation(&mpc->qp.terms[k - 1], r));
    return worst;
}

/* Gradient of the Lagrangian in the blocks' inputs by the adjoint recursion, which makes it
 * stationary in the states; relative to the largest gradient that flows through the dynamics. */
static double stationarity(const br_mpc *mpc) {
    const double *multiplier = mpc->plan.multiplier;
    double p[BR_NX] = {0}, in_block[BR_NU], worst = 0, size = 1;
    for (int k = BR_N; k >= 1; --k) {
        const br_stage_terms *terms = &mpc->qp.terms[k - 1];
        const br_stage *stage = &mpc->stage[k - 1];
        if (k == BR_N || br_opens_block(k)) memset(in_block, 0, sizeof in_block);
        BR_UNROLL
        for (int i = 0; i < BR_NX; ++i) p[i] += terms->in_x[i];
        BR_UNROLL
        for (int r = 0; r < BR_NR; ++r) BR_UNROLL
        for (int n = BR_ROW_START[r]; n < BR_ROW_START[r + 1]; ++n)
            p[BR_ROW_INDEX[n]] += multiplier[BR_ROW(r, k - 1)] * terms->gradient[n];
        BR_UNROLL
        for (int c = 0; c < BR_NU; ++c) {
            const double later = k < BR_N ? mpc->qp.terms[k].in_u_before[c] : 0.0;
            double through = 0;
            for (int j = 0; j < BR_NX; ++j) through += stage->jacobian[j][BR_NX + c] * p[j];
            in_block[c] += terms->in_u[c] + later + through;
            const double bound = multiplier[BR_NU * BR_BLOCK_OF(k - 1) + c];
            if (br_opens_block(k - 1)) worst = br_worse(worst, fabs(in_block[c] + bound));
            size = br_worse(size, fabs(through));
        }
        double next[BR_NX] = {0};
        BR_UNROLL
        for (int i = 0; i < BR_NX; ++i) BR_UNROLL
        for (int n = BR_AT_START[i]; n < BR_AT_START[i + 1]; ++n)
            next[i] += stage->jacobian[BR_AT_INDEX[n]][i] * p[BR_AT_INDEX[n]];
        memcpy(p, next, sizeof p);
    }
    return worst / size;
}

/* Fills mpc->info, worth and merit for the plan, whose linearisation must be in store.
 * merit = objective + penalty * |defects|_1, the distance to the measured state included. */
void br_residuals(br_mpc *mpc) {
    br_mpc_info *info = &mpc->info;
    double sum = 0, bound = 0, priced = 0;
    br_evaluate_terms(mpc);
    info->defect = info->cost = info->slack_max_m = 0;
    for (int k = 0; k <= BR_N; ++k) {
        const double *model = k ? mpc->stage[k - 1].f : mpc->x0;
        BR_UNROLL
        for (int i = 0; i < BR_NX; ++i) {
            const double gap = fabs(model[i] - mpc->plan.x[k][i]);
            info->defect = br_worse(info->defect, gap / BR_STATE_SCALE[i]);
            sum += gap;
            if (k) priced += mpc->plan.costate[k][i] * (model[i] - mpc->plan.x[k][i]);
        }
        if (k == 0) continue;
        bound = br_worse(bound, bound_violation(mpc, k));
        info->cost += stage_cost(mpc, &mpc->qp.terms[k - 1]);
    }
    info->bound = bound;
    info->stationarity = stationarity(mpc);
    mpc->worth = info->cost + priced;
    mpc->merit = info->cost + mpc->penalty * sum;
}

/* One number for a plan, from info: how far it is from a solution. */
double br_residual(const br_mpc *mpc) {
    return br_worse(mpc->info.stationarity, 0.1 * mpc->info.defect);
}

br_mpc_status br_judge(const br_mpc *mpc) {
    const br_mpc_info *info = &mpc->info;
    const double tolerance = mpc->parameters.tolerance;
    if (!br_all_finite(&mpc->plan.x[0][0], (BR_N + 1) * BR_NX) ||
        !br_all_finite(&mpc->plan.u[0][0], BR_NU * BR_N) ||
        !isfinite(info->stationarity + mpc->merit + info->bound))
        return BR_NOT_FINITE;
    /* linear in the QP, as inputs and early rows are, they are violated by no more than round-off
     */
    if (info->defect > mpc->parameters.defect_max || info->bound > 1e-6) return BR_DEFECT;
    return info->stationarity <= tolerance && info->defect <= tolerance ? BR_CONVERGED
                                                                        : BR_ACCEPTABLE;
}
