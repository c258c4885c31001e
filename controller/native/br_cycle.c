/* The control cycle: stop and go, delay compensation, the step, the fallback. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "br_cycle.h"

#if BR_HAS_PATH

#define JUMP 2.0         /* a plan that costs more than so many times the one before, shifted, */
#define JUMP_BY 0.01     /* and so much more */
#define RECOVER_S 0.25   /* of contradiction; what lasts longer is no glitch */
#define LEAST_BUDGET 0.1 /* what a step gets however late its cycle began: share of the budget */

struct br_cycle {
    br_controller controller;
    br_mpc *mpc; /* the compiled controller's, and what its last step reported; NULL: another's */
    br_mpc_info info;
    br_driving settings;
    int has_settings;
    br_mpc_clock clock;
    void *context;
    br_stream stream;
    br_monitor monitor;
    br_estimator estimator;
    br_residual residual;      /* in the newest state, if that is known: */
    int has_residual, unknown; /* unknown: nothing has been estimated yet */
    br_shown shown;
    br_delay delay;
    br_fallback fallback;
    br_counters counters;
    br_solution solution;
    br_decision decision; /* of the newest cycle */
    br_fault doubt;       /* the newest state is not known well enough */
    int halted;           /* the phase of a car that is not to be driven; 0: drive */
    int stopping;         /* a stop has begun: since, from which speed */
    double stopping_s, stopping_mps;
    int repeats; /* the next decision takes no time: br_cycle_repeat */
    int stepped; /* a step has been made, for that moment */
    double stepped_s;
    double vx_mps; /* the newest that is known */
    int reckoned;  /* where the car may be, and when, without a state */
    double reckoned_s, reckoned_x[BR_NX];
    int acting; /* the newest input begins to act in state acting_x, as far as that is known */
    double acting_s, acting_x[BR_NX];
};

size_t br_cycle_memory_size(void) { return sizeof(br_cycle); }

br_mpc_error br_cycle_init(void *memory, size_t size, const br_controller *controller, int hold,
                           br_cycle **out) {
    if (!memory || !controller || !out) return BR_ERROR_NULL;
    if (!controller->step || !controller->prepare || !controller->rehearse ||
        !controller->predict || !controller->reset)
        return BR_ERROR_NULL;
    if (size < sizeof(br_cycle) || (uintptr_t)memory % 64) return BR_ERROR_MEMORY;
    br_cycle *cycle = memory;
    memset(cycle, 0, sizeof *cycle);
    cycle->controller = *controller;
    cycle->halted = hold ? BR_PHASE_READY : 0;
    cycle->stream.ended = cycle->stream.silent = 1;
    cycle->decision = (br_decision){.status = BR_HALTED, .level = BR_STOP};
    cycle->counters.instrument = -1;
    *out = cycle;
    return BR_OK;
}

/* --- the compiled controller --- */

static int mpc_step(void *self, const double x[BR_NX], const double u_before[BR_NU],
                    const br_environment *environment, double elapsed_s, double budget_s,
                    br_solution *solution) {
    br_cycle *cycle = self;
    br_mpc_status status;
    cycle->decision.error = br_mpc_step(cycle->mpc, x, u_before, environment, elapsed_s, budget_s,
                                        solution->u, &status, &cycle->info);
    if (cycle->decision.error) return BR_STEP_FAILED;
    solution->rows = BR_N;
    solution->plan_step_s = BR_TS;
    br_mpc_get_plan(cycle->mpc, NULL, solution->plan_u);
    solution->second_start = cycle->info.second_start;
    solution->cost = cycle->info.cost;
    solution->shifted_cost = cycle->info.shifts < 0 ? -1 : cycle->info.shifted_cost;
    return status <= BR_ACCEPTABLE ? 0 : (int)status;
}

static void mpc_prepare(void *self, double period_s, double budget_s) {
    br_mpc_prepare(((br_cycle *)self)->mpc, period_s, budget_s);
}

static void mpc_rehearse(void *self) { br_mpc_rehearse(((br_cycle *)self)->mpc); }

static int mpc_predict(void *self, const double x[BR_NX], const double u[BR_NU], double duration_s,
                       double x_next[BR_NX]) {
    return br_mpc_predict(((br_cycle *)self)->mpc, x, u, duration_s, x_next) ? -1 : 0;
}

static int mpc_steer(void *self, const double x[BR_NX], double *s_m, double *angle_rad,
                     double *outside_m) {
    return br_mpc_steer(((br_cycle *)self)->mpc, x, s_m, angle_rad, outside_m) ? -1 : 0;
}

static void mpc_reset(void *self) { br_mpc_reset(((br_cycle *)self)->mpc); }

br_mpc_error br_cycle_drive_mpc(void *memory, size_t size, br_mpc *mpc, int hold, br_cycle **out) {
    const br_controller compiled = {
        .self = memory,
        .step = mpc_step,
        .prepare = mpc_prepare,
        .rehearse = mpc_rehearse,
        .predict = mpc_predict,
        .steer = mpc_steer,
        .reset = mpc_reset,
    };
    if (!mpc) return BR_ERROR_NULL;
    const br_mpc_error error = br_cycle_init(memory, size, &compiled, hold, out);
    if (error) return error;
    (*out)->mpc = mpc;
    return BR_OK;
}

/* --- settings and counters --- */

const br_mpc_info *br_cycle_info(const br_cycle *cycle) { return cycle ? &cycle->info : NULL; }

const br_counters *br_cycle_counters(const br_cycle *cycle) {
    return cycle ? &cycle->counters : NULL;
}

br_mpc_error br_cycle_set_driving(br_cycle *cycle, const br_driving *s) {
    if (!cycle || !s) return BR_ERROR_NULL;
    const double positive[] = {s->brake_fade_mps, s->brake_d, s->stop_mps2, s->longest_s,
                               s->stale_s};
    const double others[] = {s->brake_slow,      s->standing_mps, s->shifted_s,
                             s->limit_tolerance, s->delay_s,      s->sensor_tolerance};
    int valid = s->recover_cycles >= 1 && s->compensation >= BR_COMPENSATION_OFF &&
                s->compensation <= BR_COMPENSATION_FIXED && s->longest_s <= BR_PREDICT_MAX_S;
    for (int i = 0; i < 5; ++i) valid &= isfinite(positive[i]) && positive[i] > 0;
    for (int i = 0; i < 6; ++i) valid &= isfinite(others[i]) && others[i] >= 0;
    for (int i = 0; i < BR_NU; ++i)
        valid &= isfinite(s->u_low[i]) && isfinite(s->u_high[i]) && s->u_low[i] < s->u_high[i];
    if (!valid) return BR_ERROR_PARAMETERS;
    if (s->compensation == BR_COMPENSATION_FIXED) cycle->counters.delay_s = s->delay_s;
    if (s->compensation == BR_COMPENSATION_OFF) cycle->counters.delay_s = 0;
    cycle->settings = *s;
    cycle->has_settings = 1;
    return BR_OK;
}

br_mpc_error br_cycle_set_estimation(br_cycle *cycle, const br_mpc *model,
                                     const br_estimation *settings) {
    if (!cycle) return BR_ERROR_NULL;
    br_estimator *estimator = &cycle->estimator;
    const br_mpc_error error =
        br_estimator_init(estimator, sizeof *estimator, model ? model : cycle->mpc, &estimator);
    cycle->unknown |= cycle->stream.newest.estimated;
    return error ? error : br_estimator_set(estimator, settings);
}

const br_estimator *br_cycle_estimator(const br_cycle *cycle) {
    return cycle ? &cycle->estimator : NULL;
}

br_mpc_error br_cycle_set_clock(br_cycle *cycle, br_mpc_clock clock, void *context) {
    if (!cycle) return BR_ERROR_NULL;
    cycle->clock = clock;
    cycle->context = context;
    return cycle->mpc ? br_mpc_set_clock(cycle->mpc, clock, context) : BR_OK;
}

/* --- states, runs, commands --- */

static void forget_delay(br_cycle *cycle) {
    const br_driving *settings = &cycle->settings;
    cycle->delay.delays = cycle->delay.next_delay = 0;
    cycle->counters.delay_s =
        settings->compensation == BR_COMPENSATION_FIXED ? settings->delay_s : 0;
}

/* What counts of the newest state: what was measured, or the prediction where that is doubtful. */
static void believe(br_cycle *cycle, double interval_s) {
    br_counters *counters = &cycle->counters;
    counters->fault = br_monitor_check(&cycle->monitor, &cycle->settings, &cycle->controller,
                                       interval_s, &cycle->stream.newest);
    counters->faults[counters->fault] += counters->fault != BR_FAULT_NONE;
    counters->instrument = -1;
    if (counters->fault) counters->interval_s = interval_s; /* its time may be wrong, too */
    cycle->doubt = counters->fault;
}

/* Why the car is not to be driven by what is estimated: nothing that is believed measures where it
 * is (errors of the model add up faster than their covariance says), or that is not known to the
 * bounds. What has been contradicted for so long is not believed again by itself. */
static br_fault doubtful(br_cycle *cycle, const br_estimate *now) {
    const double tolerance = fmax(cycle->settings.sensor_tolerance, 1);
    const double most_m = tolerance * BR_MONITOR_POSITION_M;
    const double spread = br_estimator_variance(&cycle->estimator, now, BR_INDEX_X) +
                          br_estimator_variance(&cycle->estimator, now, BR_INDEX_Y);
    int contradicted;
    const br_fault found = br_estimator_blind(&cycle->estimator, &contradicted);
    const int unknown = spread > most_m * most_m;
    const double since_s = cycle->stream.newest.time_s - cycle->monitor.trusted_s;
    cycle->estimator.latched |= contradicted && (unknown || since_s > RECOVER_S);
    return !found && unknown ? BR_FAULT_UNCERTAIN : found;
}

/* What speaks against the newest state, or against an instrument. */
static void report(br_cycle *cycle) {
    br_counters *counters = &cycle->counters;
    counters->fault = cycle->doubt;
    counters->instrument = br_estimator_faulty(&cycle->estimator);
    if (counters->instrument >= 0)
        counters->fault = cycle->estimator.instrument[counters->instrument].fault;
    counters->faults[counters->fault] += counters->fault != BR_FAULT_NONE;
}

/* The residual where the car is, for the next estimate. */
static void foresee(br_cycle *cycle) {
    if (!BR_HAS_ESTIMATOR || cycle->has_residual || cycle->unknown || !cycle->mpc ||
        !cycle->estimator.count)
        return;
    double v[BR_NV];
    br_residual *residual = &cycle->residual;
    br_mpc_mismatch mismatch;
    memcpy(v, br_estimator_now(&cycle->estimator)->x, BR_NX * sizeof(double));
    memcpy(v + BR_NX, cycle->decision.u, BR_NU * sizeof(double));
    cycle->has_residual =
        br_mpc_variance(cycle->mpc, v, residual->variance, residual->noise) == BR_OK &&
        br_mpc_get_mismatch(cycle->mpc, v, &mismatch) == BR_OK &&
        br_estimator_correct(&cycle->estimator, &mismatch) == BR_OK;
    if (!cycle->has_residual) return;
    memcpy(residual->phi, mismatch.phi, sizeof residual->phi);
    for (int j = 0; j < BR_NE; ++j) residual->variance[j] += mismatch.unexplained[j];
}

#define SHORTEST_S 5e-4 /* a period that is shorter is none: there would be no end of them */

/* Over the periods whose states were lost, by the inputs that had been sent. */
static void catch_up(br_cycle *cycle) {
    br_estimator *estimator = &cycle->estimator;
    const double newest_s = cycle->stream.newest.time_s, interval_s = cycle->counters.interval_s;
    if (cycle->unknown || !estimator->count || !(interval_s > SHORTEST_S)) return;
    double last_s = br_estimator_newest(estimator)->time_s;
    if (newest_s - last_s > BR_LONGEST_S) return;
    for (; newest_s - last_s > 1.5 * interval_s; last_s += interval_s) {
        const double *u =
            br_delay_acting(&cycle->delay, last_s + interval_s / 2, cycle->counters.delay_s);
        const br_residual *residual = cycle->has_residual ? &cycle->residual : NULL;
        if (!u || br_estimator_advance(estimator, last_s + interval_s, u, residual, NULL, 0))
            return;
    }
}

/* What counts of the newest state where it is estimated; whether there is an estimate. */
static int estimate(br_cycle *cycle, const br_measured *before, br_mpc_noise *noise) {
    br_measured *newest = &cycle->stream.newest;
    static const double none[BR_NX] = {0};
    const int begins = cycle->unknown, given = newest->measurements;
    const int most = given < BR_MEASUREMENTS ? given : BR_MEASUREMENTS;
    memcpy(newest->x, cycle->unknown ? none : before->x, sizeof newest->x);
    if (!BR_HAS_ESTIMATOR) {
        cycle->unknown = 1;
        cycle->doubt = BR_FAULT_NONE;
        cycle->counters.fault = BR_FAULT_NONE;
        return 0;
    }
    foresee(cycle);
    catch_up(cycle);
    br_estimator *estimator = &cycle->estimator;
    const br_mpc_error error =
        br_estimator_advance(estimator, newest->time_s, newest->u_applied,
                             cycle->has_residual ? &cycle->residual : NULL, newest->measured, most);
    cycle->unknown = error != BR_OK || estimator->astray;
    cycle->doubt = BR_FAULT_NONE;
    if (!error) {
        const br_estimate *now = br_estimator_now(estimator);
        br_estimator_noise(estimator, noise);
        memcpy(newest->x, now->x, sizeof newest->x);
        cycle->doubt = doubtful(cycle, now);
        if (!cycle->doubt || begins) cycle->monitor.trusted_s = newest->time_s;
        cycle->monitor.measured_s = newest->time_s;
    }
    cycle->has_residual = 0;
    report(cycle);
    return !error;
}

br_reception br_cycle_observe(br_cycle *cycle, const br_measured *state) {
    if (!cycle || !state) return BR_STATE_FOREIGN;
    if (!isfinite(state->time_s)) {
        cycle->counters.foreign += 1;
        return BR_STATE_FOREIGN;
    }
    const br_measured before = cycle->stream.newest;
    const double interval_s = cycle->counters.interval_s;
    const int begins =
        !cycle->stream.has_newest || before.epoch != state->epoch || before.run != state->run;
    const br_reception reception = br_stream_accept(&cycle->stream, state, &cycle->counters);
    if (reception != BR_STATE_NEW) return reception;
    if (begins) {
        memset(&cycle->fallback, 0, sizeof cycle->fallback); /* the plan is of another run */
        cycle->delay.count = 0; /* no input is on its way; the delay is still the best guess */
        if (state->lockstep)
            forget_delay(cycle); /* but for simulated time, which reports its own */
        cycle->controller.reset(cycle->controller.self);
        cycle->stepped = cycle->stopping = cycle->reckoned = 0;
        cycle->shown.duration_s = 0;
        br_monitor_restart(&cycle->monitor);
        br_estimator_reset(&cycle->estimator);
        cycle->has_residual = 0;
        cycle->unknown = state->estimated;
    }
    const br_fault doubted = cycle->doubt;
    const int unknown = cycle->unknown;
    br_mpc_noise noise;
    int estimated = 0;
    if (state->estimated) {
        estimated = estimate(cycle, &before, &noise);
    } else {
        cycle->unknown = 0;
        believe(cycle, interval_s);
    }
    cycle->counters.doubted = cycle->unknown || cycle->doubt;
    cycle->counters.time_s = cycle->stream.newest.time_s;
    const int begun = state->estimated && !cycle->estimator.agreed; /* here, perhaps elsewhere */
    if (doubted || unknown || cycle->unknown || cycle->doubt || begun)
        cycle->shown.duration_s = 0;
    else if (!begins)
        br_shown_observe(&cycle->shown, cycle->mpc, &cycle->settings, &before,
                         &cycle->stream.newest, estimated ? &noise : NULL);
    br_delay_observe(&cycle->delay, &cycle->settings, state, &cycle->counters.delay_s);
    return BR_STATE_NEW;
}

void br_cycle_end(br_cycle *cycle) {
    if (!cycle) return;
    cycle->counters.phase = BR_PHASE_WAITING;
    cycle->stream.ended = 1;
}

int br_cycle_forget(br_cycle *cycle) {
    if (!cycle) return 0;
    cycle->counters.phase = BR_PHASE_WAITING;
    return br_stream_forget(&cycle->stream, &cycle->counters);
}

void br_cycle_stop(br_cycle *cycle) {
    if (cycle) cycle->halted = BR_PHASE_STOPPED;
}

void br_cycle_go(br_cycle *cycle) {
    if (!cycle) return;
    cycle->halted = cycle->stopping = 0;
    br_monitor_restart(&cycle->monitor); /* whoever says go has looked at the sensors */
    if (!cycle->stream.newest.estimated) return;
    if (!cycle->doubt && !cycle->unknown && !cycle->estimator.latched) return;
    br_estimator_reset(&cycle->estimator);
    cycle->unknown = 1;
}

/* --- one cycle --- */

static double now(const br_cycle *cycle) { return cycle->clock ? cycle->clock(cycle->context) : 0; }

/* Whether a stop on command is not over yet; limits the speed to what it has got to. Driven to
 * standstill, the car stays on the line and points along it, fit to go on. */
static int slowing(br_cycle *cycle, double decided_at_s, br_environment *environment) {
    const br_driving *s = &cycle->settings;
    const double vx_mps = cycle->stream.newest.x[BR_INDEX_VX];
    const int rolling = fabs(vx_mps) > s->standing_mps;
    if (!cycle->stopping && !rolling) return 0;
    if (!cycle->stopping) { /* just commanded, or a rolling car taken over on hold */
        cycle->stopping = 1;
        cycle->stopping_s = decided_at_s;
        cycle->stopping_mps = fmax(vx_mps, 0);
    }
    const double since_s = decided_at_s - cycle->stopping_s;
    const double limit_mps = fmax(cycle->stopping_mps - s->stop_mps2 * since_s, 0);
    /* Both limits are kept by the lower one falling at the higher rate; NaN is passed on: the step
     * refuses it.
     */
    if (limit_mps < environment->speed_limit_mps) environment->speed_limit_mps = limit_mps;
    if (s->stop_mps2 > environment->speed_limit_rate_mps2)
        environment->speed_limit_rate_mps2 = s->stop_mps2;
    if (limit_mps > 0 || rolling) return 1;
    return cycle->stopping = 0;
}

/* Not to be driven: braked. The next step will be the first of a new drive. */
static void halt(br_cycle *cycle, double acting_s) {
    br_decision *decision = &cycle->decision;
    if (cycle->stepped) cycle->controller.reset(cycle->controller.self);
    cycle->stepped = cycle->acting = 0;
    br_fallback_brake(&cycle->fallback, &cycle->settings, cycle->stream.newest.x[BR_INDEX_VX],
                      acting_s, decision->u);
    decision->level = BR_STOP;
    decision->status = BR_HALTED;
    cycle->counters.phase = cycle->halted;
}

/* How fast the car may still be: by the model, braking since it was last seen. A drive command that
 * brakes a rolling car drives a standing one backwards. What the model cannot follow leaves the
 * speed as it was last known. */
static void reckon(br_cycle *cycle, double decided_at_s) {
    const br_measured *newest = &cycle->stream.newest;
    const br_controller *controller = &cycle->controller;
    double u[BR_NU], *x = cycle->reckoned_x;
    if (!cycle->reckoned) {
        cycle->reckoned_s = newest->time_s + cycle->settings.stale_s;
        if (br_delay_at_acting(&cycle->delay, &cycle->settings, controller, newest,
                               cycle->reckoned_s, cycle->counters.delay_s, x, u, NULL))
            return;
        cycle->reckoned = 1;
    }
    const double duration_s = fmin(fmax(decided_at_s - cycle->reckoned_s, 0), BR_PREDICT_MAX_S);
    if (controller->predict(controller->self, x, cycle->decision.u, duration_s, x)) return;
    cycle->reckoned_s = decided_at_s;
    cycle->vx_mps = x[BR_INDEX_VX];
    memcpy(cycle->acting_x, x, sizeof cycle->acting_x);
    cycle->acting = 1;
}

static void count(br_cycle *cycle, int status) {
    const br_solution *solution = &cycle->solution;
    cycle->counters.failed += status == BR_STEP_FAILED;
    const int creeps = solution->second_start == BR_CREEPS;
    cycle->counters.second_starts += solution->second_start > 0 && !creeps;
    cycle->counters.creeping += creeps;
    if (solution->shifted_cost >= 0)
        cycle->counters.cost_jumps += solution->cost > JUMP * solution->shifted_cost + JUMP_BY;
}

/* The state in which the new input begins to act, and what acts until then; -1: not known.
 * carried: the estimate, which goes along; NULL: there is none. */
static int at_acting(br_cycle *cycle, double u[BR_NU], br_carried *carried) {
    const br_measured *newest = &cycle->stream.newest;
    double *x = cycle->acting_x;
    if (newest->lockstep && cycle->counters.delay_s == 0 &&
        newest->time_s == cycle->decision.decided_at_s) { /* at once */
        memcpy(x, newest->x, sizeof newest->x);
        memcpy(u, newest->u_applied, sizeof newest->u_applied);
        return 0;
    }
    return br_delay_at_acting(&cycle->delay, &cycle->settings, &cycle->controller, newest,
                              cycle->decision.decided_at_s, cycle->counters.delay_s, x, u, carried);
}

/* The same for a step, which gets the covariance of an estimated state. */
static int begin_step(br_cycle *cycle, double u[BR_NU]) {
    if (!BR_HAS_ESTIMATOR || !cycle->mpc || !cycle->stream.newest.estimated)
        return at_acting(cycle, u, NULL);
    br_estimator *estimator = &cycle->estimator;
    br_carried carried = {.estimator = estimator,
                          .residual = &br_estimator_newest(estimator)->residual,
                          .at = *br_estimator_now(estimator)};
    double covariance[BR_NX * BR_NX];
    if (at_acting(cycle, u, &carried)) return -1;
    double p[BR_NA][BR_NA];
    br_estimator_covariance(estimator, &carried.at, p);
    for (int i = 0; i < BR_NX; ++i) memcpy(covariance + BR_NX * i, p[i], BR_NX * sizeof(double));
    return br_mpc_set_covariance(cycle->mpc, covariance) ? -1 : 0;
}

static int step(br_cycle *cycle, const br_environment *environment, double acting_s,
                double budget_s) {
    const br_controller *controller = &cycle->controller;
    double u[BR_NU];
    if (begin_step(cycle, u)) return BR_UNPREDICTABLE;
    cycle->acting = 1;
    /* Where the delay measured has fallen, the moment of acting may even go back. */
    const double elapsed_s = cycle->stepped ? fmax(acting_s - cycle->stepped_s, 0) : 0;
    cycle->stepped = 1;
    cycle->stepped_s = acting_s;
    br_solution *solution = &cycle->solution;
    solution->rows = solution->second_start = 0;
    solution->cost = solution->shifted_cost = -1;
    const double begin_s = now(cycle);
    const int status = controller->step(controller->self, cycle->acting_x, u, environment,
                                        elapsed_s, budget_s, solution);
    cycle->decision.step_us = (now(cycle) - begin_s) * 1e6;
    cycle->decision.stepped = status != BR_STEP_FAILED;
    count(cycle, status);
    return status;
}

/* Braking follows the line where the controller knows it and the model the state. */
static void brake_along_line(br_cycle *cycle, double u[BR_NU]) {
    const br_controller *controller = &cycle->controller;
    const double *x = cycle->acting_x;
    double s_m = -1, angle_rad, outside_m;
    if (!cycle->acting || !controller->steer || cycle->vx_mps <= cycle->settings.brake_fade_mps ||
        controller->steer(controller->self, x, &s_m, &angle_rad, &outside_m))
        return;
    br_fallback_brake_to(&cycle->settings, cycle->vx_mps, x[BR_INDEX_DELTA], angle_rad, BR_TS, u);
}

/* The input of a car that is to be driven: the solution's, or the fallback's. */
static void drive(br_cycle *cycle, const br_environment *environment, double acting_s,
                  double budget_s, double spent_s) {
    const double begin_s = now(cycle);
    br_decision *decision = &cycle->decision;
    const br_measured *newest = &cycle->stream.newest;
    /* Where states come seldom, the next one is no sooner to be had. */
    const double stale_s = fmax(cycle->settings.stale_s, 2 * cycle->counters.interval_s);
    const double doubted_s = newest->time_s - cycle->monitor.trusted_s;
    cycle->acting = 0;
    if (decision->decided_at_s - newest->time_s > stale_s) {
        decision->status = BR_NO_STATE;
        reckon(cycle, decision->decided_at_s);
    } else if (cycle->doubt && doubted_s > stale_s + STAGE_ROUNDING * BR_TS) {
        double u[BR_NU];
        decision->status = BR_DOUBTED;
        cycle->acting = !at_acting(cycle, u, NULL);
        cycle->vx_mps = newest->x[BR_INDEX_VX];
    } else {
        cycle->reckoned = 0;
        cycle->vx_mps = newest->x[BR_INDEX_VX];
        const double left_s = fmax(budget_s - spent_s, LEAST_BUDGET * budget_s);
        decision->status = step(cycle, environment, acting_s, budget_s > 0 ? left_s : 0);
    }
    const double took_s = cycle->repeats ? 0 : now(cycle) - begin_s;
    if (budget_s > 0) decision->late_s = spent_s + took_s - budget_s;
    decision->level = br_fallback_decide(&cycle->fallback, &cycle->settings,
                                         decision->status ? NULL : &cycle->solution, cycle->vx_mps,
                                         acting_s, fmax(decision->late_s, 0), decision->u);
    if (decision->level >= BR_BRAKE) brake_along_line(cycle, decision->u);
    cycle->counters.levels[decision->level] += 1;
    const int driving = decision->level == BR_SOLUTION ? BR_PHASE_DRIVING : BR_PHASE_FALLBACK;
    cycle->counters.phase = cycle->halted ? cycle->halted : driving;
}

br_mpc_error br_cycle_decide(br_cycle *cycle, const br_environment *environment,
                             double decided_at_s, double budget_s, double spent_s,
                             br_decision *out) {
    if (!cycle || !out) return BR_ERROR_NULL;
    if (!cycle->has_settings || !cycle->stream.has_newest) return BR_ERROR_NOT_READY;
    if (!isfinite(decided_at_s) || !isfinite(budget_s) || !isfinite(spent_s)) return BR_ERROR_TIME;
    br_decision *decision = &cycle->decision;
    const br_measured *newest = &cycle->stream.newest;
    decision->epoch = newest->epoch;
    decision->run = newest->run;
    decision->seq = newest->seq;
    decision->decided_at_s = decided_at_s;
    decision->delay_s = cycle->counters.delay_s;
    decision->stepped = decision->error = 0;
    decision->step_us = decision->late_s = 0;
    decision->fault = cycle->counters.fault;
    const double acting_s = cycle->acting_s = decided_at_s + decision->delay_s;
    br_environment around = {.speed_limit_mps = INFINITY};
    if (environment) around = *environment;
    if (cycle->unknown) {
        halt(cycle, acting_s);
        decision->status = BR_NO_STATE;
    } else if (cycle->halted && !slowing(cycle, decided_at_s, &around))
        halt(cycle, acting_s);
    else
        drive(cycle, &around, acting_s, budget_s, spent_s);
    br_delay_sent(&cycle->delay, decided_at_s, decision->u);
    cycle->repeats = 0;
    *out = *decision;
    return BR_OK;
}

void br_cycle_sent(br_cycle *cycle, double decided_at_s, const double u[BR_NU]) {
    if (!cycle || !u || !isfinite(decided_at_s)) return;
    br_delay_replace(&cycle->delay, decided_at_s, u);
    memcpy(cycle->decision.u, u, sizeof cycle->decision.u);
}

int br_cycle_get_refusals(const br_cycle *cycle, int refused[BR_REFUSALS]) {
    return cycle && cycle->mpc ? br_mpc_get_refusals(cycle->mpc, refused) : 0;
}

br_mpc_error br_cycle_repeat(br_cycle *cycle, const int *refused, int count) {
    if (!cycle) return BR_ERROR_NULL;
    const br_mpc_error error = cycle->mpc ? br_mpc_repeat(cycle->mpc, refused, count) : BR_OK;
    cycle->repeats = !error;
    return error;
}

br_mpc_error br_cycle_brake(const br_cycle *cycle, br_braking *braking) {
    if (!cycle || !braking) return BR_ERROR_NULL;
    if (!cycle->acting || !cycle->controller.steer) return BR_ERROR_NOT_READY;
    br_rollout from = {.controller = &cycle->controller,
                       .settings = &cycle->settings,
                       .fallback = &cycle->fallback,
                       .time_s = cycle->acting_s};
    memcpy(from.x, cycle->acting_x, sizeof from.x);
    memcpy(from.u, cycle->decision.u, sizeof from.u);
    br_braking_plan(&from, braking);
    return BR_OK;
}

/* A car is being driven: a step has been made, and no halt since. */
void br_cycle_prepare(br_cycle *cycle, double period_s, double budget_s) {
    if (!cycle) return;
    cycle->repeats = 0;
    if (!cycle->stepped) return;
    if (cycle->stream.newest.estimated) foresee(cycle); /* by the last step's mismatch */
    cycle->controller.prepare(cycle->controller.self, period_s, budget_s);
}

void br_cycle_rehearse(br_cycle *cycle) {
    if (!cycle || !cycle->stepped) return;
    double x[BR_NX], u[BR_NU];
    br_delay_at_acting(&cycle->delay, &cycle->settings, &cycle->controller, &cycle->stream.newest,
                       cycle->decision.decided_at_s, cycle->counters.delay_s, x, u, NULL);
    cycle->controller.rehearse(cycle->controller.self);
}

#endif
