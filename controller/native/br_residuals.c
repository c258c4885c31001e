/* What a plan is worth, measured at the plan itself: KKT residuals, objective, merit, status. */
#include <math.h>

#include "br_internal.h"

/* Sizes of the states for the defect's norm: m, m, rad, m/s, m/s, rad/s, rad. */
static const double STATE_SCALE[BR_NX] = {1, 1, 1, 1, 1, 10, 1};

int br_all_finite(const double *values, int n) {
    double sum = 0; /* 0 * inf and 0 * nan are nan */
    for (int i = 0; i < n; ++i) sum += 0.0 * values[i];
    return sum == 0.0;
}

/* Objective of stage k (1..N) with its slack; the largest slack is noted. */
static double stage_cost(br_mpc *mpc, int k) {
    const br_mpc_parameters *par = &mpc->parameters;
    const br_mpc_reference *ref = &mpc->reference[k - 1];
    const double *x = mpc->plan.x[k], *u = mpc->plan.u[k - 1];
    const double ex = x[0] - ref->x, ey = x[1] - ref->y;
    const double change = u[0] - (k > 1 ? mpc->plan.u[k - 2][0] : mpc->d_previous);
    double slack = 0;
    if (par->s_slack > 0) {
        const double along = ref->normal_x * x[0] + ref->normal_y * x[1];
        slack = fmax(0, fmax(ref->lower + par->margin_m - along, along - ref->upper + par->margin_m));
        mpc->info.slack_max_m = br_worse(mpc->info.slack_max_m, slack);
    }
    return par->q_position * (ex * ex + ey * ey) + par->r_duty * change * change +
           par->r_delta_rate * u[1] * u[1] + par->s_slack * slack * slack;
}

static double bound_violation(const br_mpc *mpc, int k) {
    const br_mpc_parameters *par = &mpc->parameters;
    const double *u = mpc->plan.u[k - 1];
    const double duty = fmax(mpc->d_lowest - u[0], u[0] - par->d_max);
    const double steering = fmax(fabs(u[1]) - par->delta_rate_max_radps,
                                 fabs(mpc->plan.x[k][6]) - par->delta_max_rad);
    return br_worse(duty, steering);
}

/* Gradient of the Lagrangian in the inputs by the adjoint recursion, which makes it stationary in
 * the states; relative to the largest gradient that flows through the dynamics. */
static double stationarity(const br_mpc *mpc) {
    const br_mpc_parameters *par = &mpc->parameters;
    const double *multiplier = mpc->plan.multiplier;
    double p[BR_NX] = {0}, worst = 0, size = 1;
    for (int k = BR_N; k >= 1; --k) {
        const br_mpc_reference *ref = &mpc->reference[k - 1];
        const double *x = mpc->plan.x[k], *u = mpc->plan.u[k - 1];
        const br_stage *stage = &mpc->stage[k - 1];
        const double track = multiplier[BR_M + BR_N + k - 1];
        p[0] += 2 * par->q_position * (x[0] - ref->x) + track * ref->normal_x;
        p[1] += 2 * par->q_position * (x[1] - ref->y) + track * ref->normal_y;
        p[6] += multiplier[BR_M + k - 1];
        const double change = u[0] - (k > 1 ? mpc->plan.u[k - 2][0] : mpc->d_previous);
        const double after = k < BR_N ? mpc->plan.u[k][0] - u[0] : 0.0;
        const double own[BR_NU] = {2 * par->r_duty * (change - after), 2 * par->r_delta_rate * u[1]};
        for (int c = 0; c < BR_NU; ++c) {
            double through = 0;
            for (int j = 0; j < BR_NX; ++j) through += stage->jacobian[j][BR_NX + c] * p[j];
            worst = br_worse(worst, fabs(own[c] + through + multiplier[BR_NU * (k - 1) + c]));
            size = br_worse(size, fabs(through));
        }
        double next[BR_NX] = {0};
        for (int i = 0; i < BR_NX; ++i)
            for (int j = 0; j < BR_NX; ++j) next[i] += stage->jacobian[j][i] * p[j];
        memcpy(p, next, sizeof p);
    }
    return worst / size;
}

/* Fills mpc->info, worth and merit for the plan, whose linearisation must be in store.
 * merit = objective + penalty * |defects|_1, the distance to the measured state included. */
void br_residuals(br_mpc *mpc) {
    br_mpc_info *info = &mpc->info;
    double sum = 0, bound = 0, priced = 0;
    info->defect = info->cost = info->slack_max_m = 0;
    for (int k = 0; k <= BR_N; ++k) {
        const double *model = k ? mpc->stage[k - 1].f : mpc->x0;
        for (int i = 0; i < BR_NX; ++i) {
            const double gap = fabs(model[i] - mpc->plan.x[k][i]);
            info->defect = br_worse(info->defect, gap / STATE_SCALE[i]);
            sum += gap;
            if (k) priced += mpc->plan.costate[k][i] * (model[i] - mpc->plan.x[k][i]);
        }
        if (k == 0) continue;
        bound = br_worse(bound, bound_violation(mpc, k));
        info->cost += stage_cost(mpc, k);
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
        !br_all_finite(&mpc->plan.u[0][0], BR_M) || !isfinite(info->stationarity + mpc->merit))
        return BR_NOT_FINITE;
    /* inputs and steering angle are linear in the QP: beyond round-off they cannot be violated */
    if (info->defect > mpc->parameters.defect_max || info->bound > 1e-6) return BR_DEFECT;
    return info->stationarity <= tolerance && info->defect <= tolerance ? BR_CONVERGED : BR_ACCEPTABLE;
}
