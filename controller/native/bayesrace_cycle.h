/* BayesRace control cycle: from received states to the input to send, whatever goes wrong.
 *
 * Everything between a message and the step: which states count, stop and go, delay compensation,
 * the step itself, and the fallback that answers where there is no solution to send. A host carries
 * the messages and keeps the time; examples/c_host is one without Python, controller/ the one of
 * the controller process.
 *
 *   br_cycle_answer(cycle, &state, NULL, state.time_s, budget, 0, &decision);   a state has arrived
 *   (send decision.u)
 *   br_cycle_prepare(cycle, period, budget);              while waiting for the next one
 *
 * Times are the plant's unless they say otherwise. As with br_mpc, a cycle lives in memory of the
 * caller's, allocates nothing, and is for one thread. It is for problems that follow a path, whose
 * roles (codegen/problems) name the drive command, the steering rate and the speed.
 */
#ifndef BAYESRACE_CYCLE_H
#define BAYESRACE_CYCLE_H

#include "bayesrace_mpc.h"

#ifdef __cplusplus
extern "C" {
#endif

/* What a cycle drives: the compiled controller (br_cycle_drive_mpc), or another with these
 * functions. None may block; self comes back as it was given. */
typedef struct {
    void *self;
    /* 0, or a status of its own (1 to 250, or BR_STEP_FAILED) that says why solution is not usable.
     * Arguments as of br_mpc_step. */
    int (*step)(void *self, const double x[BR_NX], const double u_before[BR_NU],
                const br_environment *environment, double elapsed_s, double budget_s,
                br_solution *solution);
    void (*prepare)(void *self, double period_s, double budget_s);
    void (*rehearse)(void *self);
    /* 0, or -1: the model cannot follow. x_next may be x. As br_mpc_predict. */
    int (*predict)(void *self, const double x[BR_NX], const double u[BR_NU], double duration_s,
                   double x_next[BR_NX]);
    void (*reset)(void *self);
    /* How to steer while braking along the line, as br_mpc_steer; NULL: it knows no line, and the
     * steering is held. */
    int (*steer)(void *self, const double x[BR_NX], double *s_m, double *angle_rad,
                 double *outside_m);
} br_controller;

typedef struct br_cycle br_cycle;

BR_API size_t br_cycle_memory_size(void);

/* hold: wait for br_cycle_go. The memory is aligned to 64 bytes. BR_ERROR_NULL, too, if a function
 * of the controller is missing. */
BR_API br_mpc_error br_cycle_init(void *memory, size_t size, const br_controller *controller,
                                  int hold, br_cycle **out);

/* The same for the compiled controller, whose last result is then at br_cycle_info. Such a cycle
 * must stay where it is in memory. */
BR_API br_mpc_error br_cycle_drive_mpc(void *memory, size_t size, br_mpc *mpc, int hold,
                                       br_cycle **out);
BR_API const br_mpc_info *br_cycle_info(const br_cycle *cycle);

/* Effective from the next cycle on. BR_ERROR_PARAMETERS, and nothing changes, if one of them is not
 * finite or out of its range. */
BR_API br_mpc_error br_cycle_set_driving(br_cycle *cycle, const br_driving *settings);

/* The clock that budgets and execution times are measured with, also that of br_cycle_drive_mpc's
 * controller; NULL for none. */
BR_API br_mpc_error br_cycle_set_clock(br_cycle *cycle, br_mpc_clock clock, void *context);

/* A state has arrived. One that contradicts those before it (br_monitor.c) counts with what the
 * model predicts in place of what it says; after settings.stale_s the car brakes along the line, by
 * that prediction, and drives on once states agree with it again. A run is one stream of states:
 * one plant (epoch), one run number, rising numbers. Another stream is followed once the run has
 * ended (br_cycle_end), once nothing has come for long (br_cycle_forget), or once it has sent
 * several states in a row while the former one was silent: no single message locks out the plant.
 */
BR_API br_reception br_cycle_observe(br_cycle *cycle, const br_measured *state);

/* The input by the newest state, decided at plant time decided_at_s. environment: as of
 * br_mpc_step; a stop on command limits the speed as well. budget_s: how long after its release the
 * cycle should be done, spent_s: how long that is ago; the step has what is left, and a tenth of
 * the budget at least. No budget, no limit: 0. A decision that comes after its budget is one for an
 * input that acts so much later. BR_ERROR_NOT_READY without settings or state. */
BR_API br_mpc_error br_cycle_decide(br_cycle *cycle, const br_environment *environment,
                                    double decided_at_s, double budget_s, double spent_s,
                                    br_decision *decision);

/* Both in one. BR_ERROR_STATE for a state that is not to be answered; after another error the state
 * has been taken, and br_cycle_decide decides on it. */
BR_API br_mpc_error br_cycle_answer(br_cycle *cycle, const br_measured *state,
                                    const br_environment *environment, double decided_at_s,
                                    double budget_s, double spent_s, br_decision *decision);

/* br_mpc_prepare for a state that is expected a period after the last one, where one is. */
BR_API void br_cycle_prepare(br_cycle *cycle, double period_s, double budget_s);

/* What the car's guard shall do if nothing more comes: the newest input, then the plan for as long
 * as the fallback drives on it, then braking along the line to standstill. To be sent after the
 * decision. BR_ERROR_NOT_READY for a car that is halted, or a controller that knows no line. */
BR_API br_mpc_error br_cycle_brake(const br_cycle *cycle, br_braking *braking);

/* The way of a cycle without effect, so that its code and data are in the caches. */
BR_API void br_cycle_rehearse(br_cycle *cycle);

/* From the next cycle on slow down along the line to standstill, and stay; or drive, and believe
 * the next state. */
BR_API void br_cycle_stop(br_cycle *cycle);
BR_API void br_cycle_go(br_cycle *cycle);

/* The run is over, or its plant has gone: another may follow. */
BR_API void br_cycle_end(br_cycle *cycle);

/* Nothing has come for long: anything may follow. 1 if the last state that was not driven on is one
 * of a lockstep run, whose plant may still want an answer: observe it again. */
BR_API int br_cycle_forget(br_cycle *cycle);

/* Counts and state, kept up to date there. */
BR_API const br_counters *br_cycle_counters(const br_cycle *cycle);

#ifdef __cplusplus
}
#endif
#endif
