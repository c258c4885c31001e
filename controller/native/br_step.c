/* The control step in its two phases: feedback, from what a call brings to its answer, and the
 * preparation between two steps. */
#include "br_internal.h"

/* With a budget, and in the preparation, time is the limit; this one is for slow convergence. */
static int iteration_limit(const br_mpc *mpc) {
    const br_mpc_parameters *p = &mpc->parameters;
    return p->iterations > p->iterations_cold ? p->iterations : p->iterations_cold;
}

static void start_timer(br_mpc *mpc, double budget) {
    br_timer *timer = &mpc->timer;
    timer->qp_steps = mpc->parameters.qp_steps;
    timer->limited = timer->clock && budget > 0;
    timer->deadline = timer->limited ? br_timer_now(timer) + budget : 0;
    timer->checks = timer->refusals = 0;
    timer->repeats = timer->limited && timer->repeat_next;
    timer->repeat_next &= !timer->limited;
}

/* --- the plan in step with time --- */

/* Whole stages that a plan behind by *lag, which is below the horizon, has to be shifted; *lag is
 * what remains, at most half a stage to either side. */
static int shifts_due(double *lag) {
    int shifts = 0;
    for (; *lag >= 0.5 * BR_TS; *lag -= BR_TS) ++shifts;
    return shifts;
}

static void undo_preparation(br_mpc *mpc) {
    if (mpc->ahead) {
        mpc->plan = mpc->kept;
        memcpy(mpc->qp.sense, mpc->kept_sense, sizeof mpc->kept_sense);
        br_invalidate(mpc, BR_LINEARISATION);
    }
    mpc->ahead = mpc->looked = 0;
    br_mismatch_undo(&mpc->mismatch);
}

/* Of other weights or code; the preparation's new last stage was predicted with those before. */
void br_forget_linearisation(br_mpc *mpc) {
    undo_preparation(mpc);
    br_invalidate(mpc, BR_LINEARISATION);
}

/* The plan, shifted that often since the step before and linearised. */
static void align(br_mpc *mpc, int shifts) {
    if (shifts < mpc->ahead) undo_preparation(mpc); /* the step comes sooner than expected */
    br_mismatch_renew(mpc);
    for (; mpc->ahead < shifts; mpc->ahead += 1) br_sqp_shift(mpc);
    if (!mpc->valid[BR_LINEARISATION]) br_linearise_plan(mpc);
}

/* The plan of a slow car that creeps, kept for when no other is found; made before the others, as a
 * budget may leave no time after them. */
static void keep_creeping(br_mpc *mpc) {
    mpc->begun.status = BR_NOT_FINITE;
#if BR_HAS_PATH
    if (!br_creep(mpc)) return;
    br_sqp_roll_out(mpc, NULL);
    br_path_follow(mpc);
    br_residuals(mpc);
    br_plan_keep(mpc, br_judge(mpc), &mpc->begun);
#endif
}

/* Whether the plan at hand is that of a car that has stood for too long. */
static int creeps(const br_mpc *mpc) {
    return !mpc->warm && mpc->stuck && br_usable(mpc->begun.status);
}

/* The plan at the time of the measured state. Without one, or with one that is older than the
 * horizon or has not become usable in as many iterations as a cold start may take, a new one. */
static void begin_plan(br_mpc *mpc) {
    if (mpc->lag >= BR_HORIZON_S || mpc->unfinished >= iteration_limit(mpc)) mpc->warm = 0;
    if (mpc->warm) {
        mpc->info.shifts = shifts_due(&mpc->lag);
        align(mpc, mpc->info.shifts);
    } else {
        undo_preparation(mpc); /* its plan is not gone on with */
        keep_creeping(mpc);
        if (!creeps(mpc)) br_sqp_cold_start(mpc);
        br_invalidate(mpc, BR_TUBE);
        mpc->lag = mpc->unfinished = 0;
        mpc->info.shifts = -1;
    }
    br_path_follow(mpc);
    mpc->info.prepared = mpc->prepared && mpc->valid[BR_FACTORS];
    mpc->ahead = mpc->prepared = 0;
    br_caution_update(mpc);
}

/* --- iterations, from one start or several --- */

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

/* Iterates until an early stop or out of time or QP steps. What is rough yet may take as many
 * iterations as a cold start. A QP that is cut off leaves the plan as it was. */
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
        const br_mpc_status before = status;
        status = br_sqp_iterate(mpc, i > 0 || warm, i == 0 && warm);
        if (status == BR_TIME_LIMIT) {
            mpc->info.time_limited = 1;
            status = before;
            break;
        }
        if (i == 0 && warm) br_plan_keep(mpc, status, &mpc->once);
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
 * maximises progress is always near that, which is no sign of anything. */
static int wanders(const br_mpc *mpc) {
    return (mpc->qp.regularised || mpc->info.shortened) && !mpc->follows;
}

/* Nor need another start be tried where the preparation has compared one. */
static int doubtful(const br_mpc *mpc, br_mpc_status status) {
    return (wanders(mpc) && !mpc->looked) || !br_usable(status);
}

/* Whether the plan may be driven: it goes no farther into what the weights do not know than caution
 * allows, or than the one before did. */
static int is_known(br_mpc *mpc, const br_plan *before) {
    const double unknown = br_plan_unknown(mpc, &mpc->plan);
    return unknown <= 1 || unknown <= br_plan_unknown(mpc, before);
}

/* Another local minimum may be there in the model alone: where nothing was learned, tyres that
 * slide may pull the car. A plan that leads there is put back to what it was after one iteration,
 * which is near the plan from before, or else to that, if it begins where the car is to within a
 * centimetre or so. */
static br_mpc_status stay_in_the_known(br_mpc *mpc, br_mpc_status status) {
    const br_incumbent *begun = &mpc->begun, *once = &mpc->once;
    if (!br_usable(status) || !br_usable(once->status)) return status;
    if (is_known(mpc, &begun->plan)) return status;
    br_plan_restore(mpc, once);
    if (!br_usable(begun->status) || begun->info.defect > BR_DEFECT_FINE) return once->status;
    if (is_known(mpc, &begun->plan)) return once->status;
    br_plan_restore(mpc, begun);
    return begun->status;
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
static br_mpc_status start_again(br_mpc *mpc, br_mpc_status status, unsigned turn) {
    static const double shares[] = {0, 0.5, 1, 0.25}, nothing[BR_NU] = {0};
    const int time_limited = mpc->info.time_limited;
    double u[BR_NU];
    int better;
    br_plan_keep(mpc, status, &mpc->first);
    br_first_guess(mpc, nothing, shares[turn % 4], u);
    br_sqp_roll_out(mpc, u);
    status = iterate(mpc, 0, BR_SECOND_START_ITERATIONS);
    if (br_usable(mpc->first.status) && br_usable(status) && !is_known(mpc, &mpc->first.plan))
        status = BR_DEFECT;
    status = br_first_plan_compare(mpc, status, &better);
    mpc->info.second_start = better ? BR_BETTER : BR_NO_BETTER;
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

/* Creeps if no start has led to a usable plan, and time to go on with one has not helped for some
 * steps. */
static br_mpc_status or_creep(br_mpc *mpc, br_mpc_status status) {
    const int waits = status == BR_TIME_LIMIT && mpc->attempts < 2 * BR_COLD_GUESSES;
    if (br_usable(status) || waits || !br_usable(mpc->begun.status)) return status;
    br_plan_restore(mpc, &mpc->begun);
    mpc->info.second_start = BR_CREEPS;
    return mpc->begun.status;
}

static br_mpc_status optimise(br_mpc *mpc) {
    br_timer *timer = &mpc->timer;
    begin_plan(mpc);
    timer->iteration = timer->trial = 0; /* a stall must not be remembered for ever */
    const int most = iteration_limit(mpc);
    if (creeps(mpc)) {
        mpc->info.second_start = BR_CREEPS;
        return mpc->begun.status;
    }
    if (!mpc->warm) {
        const int limit = timer->limited ? most : mpc->parameters.iterations_cold;
        return or_creep(mpc, start_cold(mpc, limit));
    }
    br_residuals(mpc);
    const double shifted_cost = mpc->info.cost;
    br_plan_keep(mpc, br_judge(mpc), &mpc->begun);
    br_mpc_status status = iterate(mpc, 1, most);
    const int doubted = doubtful(mpc, status);
    if (wanders(mpc) && !mpc->info.time_limited) status = stay_in_the_known(mpc, status);
    if (!doubted)
        mpc->futile = mpc->starts = 0;
    else if (!mpc->info.time_limited &&
             br_timer_allows(timer, br_timer_now(timer), 3 * timer->iteration) && worth_a_try(mpc))
        status = start_again(mpc, status, mpc->starts++);
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
    br_mismatch_advance(&mpc->mismatch);
    br_caution_advance(&mpc->caution);
    br_caution_pace(mpc, mpc->elapsed);
    if (info) *info = mpc->info;
}

/* --- the step --- */

/* What a call brings; *plausible: its state and input may be solved for. */
static br_mpc_error begin(br_mpc *mpc, const double *x, const double *u_before, double elapsed_s,
                          double budget_s, const double *u, br_mpc_status *status,
                          br_mpc_info *info, int *plausible) {
    if (!x || !u_before || !u || !status) return BR_ERROR_NULL;
    start_timer(mpc, budget_s);
    *status = BR_BAD_STATE; /* until there is something better to say */
    memset(&mpc->info, 0, sizeof mpc->info);
    mpc->info.status = BR_BAD_STATE;
    br_caution_report(mpc);
    if (info) *info = mpc->info;
    if (!mpc->has_parameters) return BR_ERROR_NOT_READY;
    if (!(elapsed_s >= 0 && isfinite(elapsed_s))) return BR_ERROR_TIME;
    mpc->elapsed = elapsed_s;
    mpc->lag += elapsed_s;
    mpc->path.age += elapsed_s;
    *plausible = br_plausible_state(x) && br_plausible(u_before, BR_INPUT_LIMIT, BR_NU);
    if (!*plausible) return BR_OK;
    memcpy(mpc->x0, x, sizeof mpc->x0);
    memcpy(mpc->u_before, u_before, sizeof mpc->u_before);
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

#if BR_FOLLOWS_PLAN
/* Whether the reference is the plan's own progress: not on the way to standstill, nor where the
 * line's speeds are too uncertain or not known. */
static int may_follow(const br_mpc *mpc) {
    return !isfinite(mpc->path.speed_limit) && mpc->caution.pace >= 1 &&
           br_path_known_ahead(&mpc->path);
}
#endif

#if BR_HAS_PATH
/* Points to track. Where the problem takes its reference from the plan instead, only a stop and a
 * turn need them, and a slow car, which a turn may begin with. */
static void plan_reference(br_mpc *mpc) {
    br_note_standing(mpc);
#if BR_FOLLOWS_PLAN
    const int before = mpc->follows, follows = mpc->follows = may_follow(mpc);
    if (follows && before && fabs(mpc->x0[BR_INDEX_VX]) >= BR_TURN_SLOW_MPS) return;
    br_invalidate(mpc, BR_FOLLOWED);
#endif
    br_path_plan(&mpc->path, mpc->caution.pace, mpc->reference);
    br_turnaround(mpc);
    if (mpc->turn) mpc->follows = 0;
    if (mpc->stuck) mpc->warm = 0; /* to go on with the plan from before would be to stay */
}
#endif

static br_mpc_error br_step(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                            const br_environment *environment, double elapsed_s, double budget_s,
                            double u[BR_NU], br_mpc_status *status, br_mpc_info *info) {
    int plausible;
    const br_mpc_error error =
        begin(mpc, x, u_before, elapsed_s, budget_s, u, status, info, &plausible);
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

static br_mpc_error br_solve(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                             double elapsed_s, double budget_s,
                             const br_mpc_reference reference[BR_N], double u[BR_NU],
                             br_mpc_status *status, br_mpc_info *info) {
    if (!reference) return BR_ERROR_NULL;
    int plausible;
    const br_mpc_error error =
        begin(mpc, x, u_before, elapsed_s, budget_s, u, status, info, &plausible);
    if (error || !plausible) return error;
    memcpy(mpc->reference, reference, sizeof mpc->reference);
    mpc->turn = mpc->follows = 0;
    mpc->stood = mpc->stuck = 0;
    mpc->own_reference = 1;
    solve(mpc, u, status, info);
    return BR_OK;
}

/* --- the preparation --- */

/* Time for an iteration, and what follows it: restoring the best plan, shift and factorisation,
 * which take another one's, and caution. */
static double iteration_and_rest(const br_timer *timer) {
    return 2 * timer->iteration + timer->caution;
}

/* Predicts the next problem: from the state that the plan predicts after so many
 * shifts, with the input before it and the line's reference there. Without a shift, the last one.
 */
static void foresee(br_mpc *mpc, double elapsed, int shifts) {
    memcpy(mpc->reference, mpc->answer_reference, sizeof mpc->reference);
    if (shifts) {
        memcpy(mpc->x0, mpc->plan.x[0], sizeof mpc->x0);
        memcpy(mpc->u_before, mpc->answer_u[shifts - 1], sizeof mpc->u_before);
#if BR_HAS_PATH
        double lateral;
        mpc->path.age += elapsed;
        br_path_project(&mpc->path, mpc->x0, &lateral);
#if BR_FOLLOWS_PLAN
        mpc->follows = may_follow(mpc);
#endif
        if (!mpc->follows) br_path_plan(&mpc->path, mpc->caution.pace, mpc->reference);
#endif
    }
    (void)elapsed; /* for a problem without a path */
    br_invalidate(mpc, BR_FOLLOWED);
    br_evaluate_bounds(mpc);
    br_path_follow(mpc);
}

/* Iterations at the problem at hand, towards tolerance. Returns whether there may be time left. */
static int improve(br_mpc *mpc, int shifts) {
    br_timer *timer = &mpc->timer;
    memset(&mpc->info, 0, sizeof mpc->info);
    mpc->penalty = 0;
    if (shifts) br_caution_update(mpc); /* else it is that of the last step */
    br_residuals(mpc);
    br_mpc_status status = br_judge(mpc);
    br_plan_keep(mpc, status, &mpc->begun);
    mpc->once.status = BR_NOT_FINITE;
    br_incumbent_reset(mpc);
    br_incumbent_keep(mpc, status, 1);
    const int limit = iteration_limit(mpc);
    int time = 1;
    while (mpc->info.iterations < limit && (status == BR_ACCEPTABLE || status == BR_DEFECT)) {
        time = br_timer_allows(timer, br_timer_now(timer), iteration_and_rest(timer));
        if (!time) break;
        status = br_sqp_iterate(mpc, 1, shifts && mpc->info.iterations == 0);
        if (mpc->once.status == BR_NOT_FINITE) br_plan_keep(mpc, status, &mpc->once);
        br_incumbent_keep(mpc, status, 1);
    }
    mpc->prepared_iterations += mpc->info.iterations;
    status = br_incumbent_restore(mpc, status);
    if (time && mpc->info.iterations && wanders(mpc)) stay_in_the_known(mpc, status);
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
    if (!mpc->valid[BR_LINEARISATION]) br_linearise_plan(mpc);
    memset(&mpc->info, 0, sizeof mpc->info);
    br_residuals(mpc);
    const br_mpc_status status = br_judge(mpc);
    if (br_usable(status)) start_again(mpc, status, mpc->looks++);
    mpc->looked = br_usable(status) && !mpc->own_reference;
    mpc->prepared_iterations += mpc->info.iterations;
}

/* Solves the problem that is foreseen, so that the step begins near its solution: the advanced-step
 * real-time iteration (Nurkanovic, Zanelli, Albrecht, Diehl, "The advanced step real time iteration
 * for NMPC", 2019). */
static void solve_ahead(br_mpc *mpc, double elapsed, int shifts) {
    br_timer *timer = &mpc->timer;
    if (mpc->turn) return; /* its reference is made from the measured state */
    double needed = iteration_and_rest(timer) + (shifts ? timer->caution : 0);
    if (!(timer->iteration > 0)) needed = INFINITY; /* no step has shown yet how long one takes */
    if (!br_timer_allows(timer, br_timer_now(timer), needed)) return;
    if (!mpc->valid[BR_LINEARISATION]) br_linearise_plan(mpc);
    double x0[BR_NX], u_before[BR_NU];
    const double s = mpc->path.s, age = mpc->path.age;
    const int known = mpc->path.known;
    memcpy(x0, mpc->x0, sizeof x0);
    memcpy(u_before, mpc->u_before, sizeof u_before);
    foresee(mpc, elapsed, shifts);
    if (improve(mpc, shifts)) look_elsewhere(mpc);
    br_invalidate(mpc, BR_TUBE);
    if (!mpc->valid[BR_LINEARISATION]) br_linearise_plan(mpc);
    memcpy(mpc->x0, x0, sizeof x0);
    memcpy(mpc->u_before, u_before, sizeof u_before);
    mpc->path.s = s;
    mpc->path.age = age;
    mpc->path.known = known;
}

static br_mpc_error br_prepare(br_mpc *mpc, double elapsed_s, double budget_s) {
    start_timer(mpc, budget_s);
    if (!mpc->has_parameters) return BR_ERROR_NOT_READY;
    if (!(elapsed_s >= 0 && isfinite(elapsed_s))) return BR_ERROR_TIME;
    br_watch_update(mpc);
    double lag = mpc->lag + elapsed_s;
    if (!mpc->warm || lag >= BR_HORIZON_S) return BR_OK;
    const int first = !mpc->ahead, shifts = shifts_due(&lag);
    const int ahead = first && mpc->timer.limited, known = !mpc->own_reference;
    if (ahead && !known) solve_ahead(mpc, elapsed_s, 0); /* the next reference is the caller's */
    if (first) {
        mpc->kept = mpc->plan;
        memcpy(mpc->kept_sense, mpc->qp.sense, sizeof mpc->kept_sense);
    }
    align(mpc, shifts);
    if (ahead && known) solve_ahead(mpc, elapsed_s, shifts);
    br_path_follow(mpc);
    br_caution_update(mpc);
    if (!mpc->valid[BR_FACTORS]) br_qp_factorise(mpc);
    mpc->prepared = mpc->valid[BR_FACTORS];
    return BR_OK;
}

static br_mpc_error br_rehearse(br_mpc *mpc) {
    if (!mpc->prepared || !mpc->valid[BR_FACTORS]) return BR_OK;
    br_linearise_plan(mpc);
    br_path_follow(mpc);
    br_qp_factorise(mpc);
    return BR_OK;
}

/* The functions of this code: see br_parts.h. */
const br_code BR_CODE = {.step = br_step,
                         .solve = br_solve,
                         .prepare = br_prepare,
                         .rehearse = br_rehearse,
                         .predict = br_predict,
                         .propagate = br_propagate,
#if BR_HAS_PATH
                         .steer = br_steer,
#endif
                         .variance = br_variance,
                         .mismatch = br_get_mismatch,
                         .evaluate = br_evaluate,
#if BR_HAS_PATH
                         .limit = br_limit_speeds,
#endif
                         .load = br_gp_load};
