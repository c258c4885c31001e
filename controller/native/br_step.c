/* The control step: what a call brings, the plan in step with it, iterations, the answer. */
#include <math.h>

#include "br_internal.h"

/* With a budget, and in the preparation, time is the limit; this one is for slow convergence. */
int br_iteration_limit(const br_mpc *mpc) {
    const br_mpc_parameters *p = &mpc->parameters;
    return p->iterations > p->iterations_cold ? p->iterations : p->iterations_cold;
}

/* The plan at the time of the measured state. Without one, or with one that is older than the
 * horizon or has not become usable in as many iterations as a cold start may take, a new one. */
static void begin_plan(br_mpc *mpc) {
    if (mpc->lag >= BR_HORIZON_S || mpc->unfinished >= br_iteration_limit(mpc)) mpc->warm = 0;
    if (mpc->warm) {
        mpc->info.shifts = br_shifts_due(&mpc->lag);
        br_align(mpc, mpc->info.shifts);
    } else {
        br_sqp_cold_start(mpc);
        br_invalidate(mpc, BR_TUBE);
        mpc->lag = mpc->unfinished = 0;
        mpc->info.shifts = -1;
    }
    br_path_follow(mpc);
    mpc->info.prepared = mpc->prepared && mpc->valid[BR_FACTORS];
    mpc->ahead = mpc->prepared = 0;
    br_caution_update(mpc);
}

/* Another iteration would change little that matters until the next step, or, where the Hessian is
 * indefinite and convergence slow, cost more than it gives, which only a budget shows: with one
 * it goes on. early_stop_tol = 0 means to go on regardless. */
static int stops_early(const br_mpc *mpc, double *residual) {
    const double before = *residual, early_stop_tol = mpc->parameters.early_stop_tol;
    *residual = br_residual(mpc);
    if (early_stop_tol == 0) return 0;
    if (*residual <= early_stop_tol) return 1;
    if (mpc->timer.limited || !mpc->warm || mpc->info.defect > BR_DEFECT_FINE) return 0;
    return *residual > 0.5 * before;
}

/* Whether the plan is not what the model does, to within a centimetre or so. */
static int rough(const br_mpc *mpc, br_mpc_status status) {
    return status == BR_DEFECT || mpc->info.defect > BR_DEFECT_FINE;
}

/* Iterates until an early stop or out of time. What is rough yet may take as many iterations as a
 * cold start. */
static br_mpc_status iterate(br_mpc *mpc, int warm, int most) {
    br_timer *timer = &mpc->timer;
    const int limit = timer->limited || !warm ? most : mpc->parameters.iterations;
    br_mpc_status status = BR_DEFECT;
    double residual = INFINITY;
    br_incumbent_reset(mpc);
    for (int i = 0; i < (rough(mpc, status) ? most : limit); ++i) {
        if (i && !br_timer_allows(timer, br_timer_now(timer), timer->iteration)) {
            mpc->info.time_limited = 1;
            break;
        }
        status = br_sqp_iterate(mpc, i > 0 || warm, i == 0 && warm);
        br_incumbent_keep(mpc, status, timer->limited);
        if (status != BR_ACCEPTABLE && status != BR_DEFECT) break;
        if (status == BR_ACCEPTABLE && stops_early(mpc, &residual)) break;
    }
    status = br_incumbent_restore(mpc, status);
    return status == BR_DEFECT && mpc->info.time_limited ? BR_TIME_LIMIT : status;
}

/* Signs that the plan from before is on its way to another local minimum, often a bad one: the
 * exact Hessian is indefinite, or Newton's steps had to be shortened. Typically the horizon has
 * reached a bend for which the plan is too fast: the tyres slide, and neither more nor less
 * steering helps. Such a plan satisfies every residual and costs more with each step. A plan that
 * maximises progress is always near that, and no sign of anything; nor is one that the preparation
 * has compared with that of another start. */
static int doubtful(const br_mpc *mpc, br_mpc_status status) {
    const int sign = (mpc->qp.regularised || mpc->info.shortened) && !mpc->follows && !mpc->looked;
    return sign || !br_usable(status);
}

/* Whether to try: where nothing has been better for long, as with a model that is wrong all over,
 * only now and then. */
static int worth_a_try(br_mpc *mpc) {
    const unsigned futile = mpc->futile++;
    return futile < BR_FUTILE || futile % BR_FUTILE == 0;
}

/* Iterates from another start, with another guess each time in a row; leaves the better plan of
 * that and the one at hand. To coast from the measured state most often leads to the good minimum
 * in a few iterations (docs/decisions/2026-11-22-second-start.md). */
br_mpc_status br_start_again(br_mpc *mpc, br_mpc_status status, unsigned turn) {
    static const double shares[] = {0, 0.5, 1, 0.25}, nothing[BR_NU] = {0};
    const int time_limited = mpc->info.time_limited;
    double u[BR_NU];
    int better;
    br_first_plan_keep(mpc, status);
    br_first_guess(mpc, nothing, shares[turn % 4], u);
    br_sqp_roll_out(mpc, u);
    status = br_first_plan_compare(mpc, iterate(mpc, 0, BR_SECOND_START_ITERATIONS), &better);
    mpc->info.second_start = better ? 2 : 1;
    if (better)
        mpc->futile = mpc->starts = 0;
    else
        mpc->info.time_limited = time_limited;
    return status;
}

/* From the usual guess without soft rows, then from where that leads with them: a track that turns
 * at once may send Newton's steps round in circles from every guess. */
static br_mpc_status start_without_soft_rows(br_mpc *mpc, int most) {
    double u[BR_NU];
    br_first_guess(mpc, mpc->u_before, 0.5, u);
    br_sqp_roll_out(mpc, u);
    br_path_follow(mpc);
    memset(mpc->qp.penalty, 0, sizeof mpc->qp.penalty);
    br_invalidate(mpc, BR_FACTORS);
    const br_mpc_status status = iterate(mpc, 0, most);
    br_evaluate_penalties(mpc);
    br_invalidate(mpc, BR_FACTORS);
    return br_usable(status) ? iterate(mpc, 1, most) : status;
}

/* Without a plan from before: from the problem's guesses in turn until one leads to a usable plan;
 * all but the first get no more iterations than a second start. From rest, half throttle straight
 * ahead may be a bad guess for a line that turns at once. */
static br_mpc_status start_cold(br_mpc *mpc, int most) {
    br_timer *timer = &mpc->timer;
    br_mpc_status status = iterate(mpc, 0, most);
    if (most > BR_SECOND_START_ITERATIONS) most = BR_SECOND_START_ITERATIONS;
    for (int guess = 1; guess < BR_COLD_GUESSES && !br_usable(status); ++guess) {
        if (mpc->turn || mpc->info.time_limited) break; /* there is one way to turn */
        if (!br_timer_allows(timer, br_timer_now(timer), 3 * timer->iteration)) break;
        mpc->attempts += 1;
        br_sqp_cold_start(mpc);
        br_path_follow(mpc);
        status = iterate(mpc, 0, most);
    }
    if (br_usable(status) || mpc->turn || mpc->info.time_limited) return status;
    if (!br_timer_allows(timer, br_timer_now(timer), 3 * timer->iteration)) return status;
    return start_without_soft_rows(mpc, most);
}

static br_mpc_status optimise(br_mpc *mpc) {
    br_timer *timer = &mpc->timer;
    begin_plan(mpc);
    timer->iteration = timer->trial = 0; /* a stall must not be remembered for ever */
    const int most = br_iteration_limit(mpc);
    if (!mpc->warm) return start_cold(mpc, timer->limited ? most : mpc->parameters.iterations_cold);
    br_residuals(mpc);
    const double shifted_cost = mpc->info.cost;
    br_mpc_status status = iterate(mpc, 1, most);
    if (!doubtful(mpc, status))
        mpc->futile = mpc->starts = 0;
    else if (!mpc->info.time_limited &&
             br_timer_allows(timer, br_timer_now(timer), 3 * timer->iteration) && worth_a_try(mpc))
        status = br_start_again(mpc, status, mpc->starts++);
    mpc->info.shifted_cost = shifted_cost;
    return status;
}

static void solve(br_mpc *mpc, double u[BR_NU], br_mpc_status *status, br_mpc_info *info) {
    *status = optimise(mpc);
    const int good = br_usable(*status), unfinished = *status == BR_TIME_LIMIT;
    if (good) memcpy(u, mpc->plan.u[0], sizeof mpc->plan.u[0]);
    if (!good)
        mpc->attempts += 1;
    else if (mpc->warm)
        mpc->attempts = 0;
    mpc->looked = 0;
    mpc->warm = good || unfinished; /* another bad plan is no start for the next step */
    mpc->unfinished = unfinished ? mpc->unfinished + mpc->info.iterations : 0;
    memcpy(mpc->answer_x, mpc->plan.x, sizeof mpc->answer_x);
    memcpy(mpc->answer_u, mpc->plan.u, sizeof mpc->answer_u);
    memcpy(mpc->answer_reference, mpc->reference, sizeof mpc->answer_reference);
    mpc->info.status = *status;
    br_invalidate(mpc, BR_TUBE); /* the next step starts with another plan */
    br_innovation_advance(&mpc->innovation);
    br_caution_pace(mpc, mpc->elapsed);
    if (info) *info = mpc->info;
}

typedef struct {
    const double *x, *u_before;
    double elapsed_s, budget_s;
    const double *u;
    br_mpc_status *status;
    br_mpc_info *info;
} request;

static br_mpc_error begin(br_mpc *mpc, const request *r, int *plausible) {
    if (!r->x || !r->u_before || !r->u || !r->status) return BR_ERROR_NULL;
    br_timer_start(&mpc->timer, r->budget_s);
    *r->status = BR_BAD_STATE; /* until there is something better to say */
    memset(&mpc->info, 0, sizeof mpc->info);
    mpc->info.status = BR_BAD_STATE;
    br_caution_report(mpc);
    if (r->info) *r->info = mpc->info;
    if (!mpc->has_parameters) return BR_ERROR_NOT_READY;
    if (!(r->elapsed_s >= 0 && isfinite(r->elapsed_s))) return BR_ERROR_TIME;
    mpc->elapsed = r->elapsed_s;
    mpc->lag += r->elapsed_s;
    mpc->path.age += r->elapsed_s;
    *plausible = br_plausible_state(r->x) && br_plausible_input(r->u_before);
    if (!*plausible) return BR_OK;
    memcpy(mpc->x0, r->x, sizeof mpc->x0);
    memcpy(mpc->u_before, r->u_before, sizeof mpc->u_before);
    br_evaluate_bounds(mpc);
    br_invalidate(mpc, BR_TERMS);
    mpc->info.prepared_iterations = mpc->prepared_iterations;
    mpc->prepared_iterations = 0;
    return BR_OK;
}

/* The speed limits of the environment; -1 if they are none. */
static int take_environment(br_mpc *mpc, const br_environment *environment) {
    static const br_environment open = {.speed_limit_mps = INFINITY};
    const br_environment *e = environment ? environment : &open;
    const double limit = e->speed_limit_mps, rate = e->speed_limit_rate_mps2;
    if (!(limit >= 0) || !(rate >= 0) || !isfinite(rate)) return -1;
    mpc->path.speed_limit = limit;
    mpc->path.speed_limit_rate = rate;
    return 0;
}

#if BR_HAS_PATH
/* Points to track. Where the problem takes its reference from the plan instead, only a stop and a
 * turn need them, and a slow car, which a turn may begin with. */
static void plan_reference(br_mpc *mpc) {
#if BR_FOLLOWS_PLAN
    const int follows = !isfinite(mpc->path.speed_limit) && mpc->caution.pace >= 1;
    const int before = mpc->follows;
    mpc->follows = follows;
    if (follows && before && fabs(mpc->x0[BR_INDEX_VX]) >= BR_TURN_SLOW_MPS) return;
    br_invalidate(mpc, BR_FOLLOWED);
#endif
    br_path_plan(&mpc->path, mpc->caution.pace, mpc->reference);
    br_turnaround(mpc);
    if (mpc->turn) mpc->follows = 0;
}
#endif

br_mpc_error br_step(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                     const br_environment *environment, double elapsed_s, double budget_s,
                     double u[BR_NU], br_mpc_status *status, br_mpc_info *info) {
    int plausible;
    const request r = {x, u_before, elapsed_s, budget_s, u, status, info};
    const br_mpc_error error = begin(mpc, &r, &plausible);
    if (error) return error;
    if (!mpc->path.ready) return BR_ERROR_NOT_READY; /* as always without a path */
    if (take_environment(mpc, environment)) return BR_ERROR_PARAMETERS;
    if (!plausible) return BR_OK;
#if BR_HAS_PATH
    br_path_project(&mpc->path, x, &mpc->info.lateral_m);
    plan_reference(mpc);
    mpc->own_reference = 0;
    mpc->info.s_ref_m = mpc->path.s;
#endif
    solve(mpc, u, status, info);
    return BR_OK;
}

br_mpc_error br_solve(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                      double elapsed_s, double budget_s, const br_mpc_reference reference[BR_N],
                      double u[BR_NU], br_mpc_status *status, br_mpc_info *info) {
    if (!reference) return BR_ERROR_NULL;
    int plausible;
    const request r = {x, u_before, elapsed_s, budget_s, u, status, info};
    const br_mpc_error error = begin(mpc, &r, &plausible);
    if (error || !plausible) return error;
    memcpy(mpc->reference, reference, sizeof mpc->reference);
    mpc->turn = mpc->follows = 0;
    mpc->own_reference = 1;
    solve(mpc, u, status, info);
    return BR_OK;
}

/* The table of this code's functions: see br_code.h. */
#ifndef BR_CODE
#define BR_CODE br_code_baseline
#endif

const br_code BR_CODE = {.step = br_step,
                         .solve = br_solve,
                         .prepare = br_prepare,
                         .rehearse = br_rehearse,
                         .predict = br_predict,
#if BR_HAS_PATH
                         .steer = br_steer,
#endif
                         .variance = br_variance,
                         .evaluate = br_evaluate,
                         .load = br_gp_load};
