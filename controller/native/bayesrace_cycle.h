/* BayesRace control cycle: from received states to the input to send, whatever goes wrong.
 *
 * Everything between a message and the step: which states count, stop and go, delay compensation,
 * the step itself, and the fallback that answers where there is no solution to send. A host carries
 * the messages and keeps the time; controller/host is one without Python, controller/ the one of
 * the controller process.
 *
 *   br_cycle_observe(cycle, &state);                                      a state has arrived
 *   now = br_cycle_counters(cycle)->time_s;           its time, or the one that is believed
 *   br_cycle_decide(cycle, NULL, now, budget, 0, &decision);
 *   (send decision.u)
 *   br_cycle_prepare(cycle, period, budget);              while waiting for the next one
 *
 * Times are the plant's unless they say otherwise. As with br_mpc, a cycle lives in memory of the
 * caller's, allocates nothing, and is for one thread. It is for problems that follow a path, whose
 * roles (codegen/problems) name the drive command, the steering rate and the speed.
 */
#ifndef BAYESRACE_CYCLE_H
#define BAYESRACE_CYCLE_H

#include <stdint.h>

#include "bayesrace_estimator.h"
#include "bayesrace_mpc.h"

#ifdef __cplusplus
extern "C" {
#endif

#define BR_DELAYS 64        /* most measured delays that come with one state */
#define BR_BRAKING_ROWS 192 /* most rows of a braking plan */
#define BR_MEASUREMENTS 16  /* most measurements that come with one state */

/* Why a cycle has no result of a step: its status. The statuses of steps are smaller numbers. */
typedef enum {
    BR_DOUBTED = 251, /* the states contradict each other, for longer than they may be old */
    BR_UNPREDICTABLE, /* the state cannot be predicted to the moment of acting */
    BR_HALTED,        /* the car is not to be driven */
    BR_NO_STATE,      /* the newest state is too old */
    BR_STEP_FAILED    /* the step is broken: an exception, or a call that it refuses */
} br_no_step;

/* Levels of the fallback: where the input comes from. */
typedef enum {
    BR_SOLUTION = 0, /* the solution */
    BR_SHIFTED_PLAN, /* the plan before, shifted */
    BR_BRAKE,        /* braking along the plan's steering, held when the plan is over */
    BR_STOP          /* standing still */
} br_level;

/* Life cycle of a controller. */
typedef enum {
    BR_PHASE_WAITING = 0, /* no state has arrived */
    BR_PHASE_READY,       /* states arrive; it waits for br_cycle_go */
    BR_PHASE_DRIVING,     /* the input is the solution */
    BR_PHASE_FALLBACK,    /* the input is the fallback's */
    BR_PHASE_STOPPED      /* after br_cycle_stop: the car brakes to standstill, and stays */
} br_phase;

/* What became of a state that has arrived. */
typedef enum {
    BR_STATE_NEW = 0, /* it is now the newest one */
    BR_STATE_STALE,   /* older than one before */
    BR_STATE_FOREIGN  /* of another plant or run, or far ahead */
} br_reception;

/* Modes of the delay compensation. */
typedef enum {
    BR_COMPENSATION_OFF = 0,  /* the state is taken as it is */
    BR_COMPENSATION_MEASURED, /* over the delay that the plant measures */
    BR_COMPENSATION_FIXED     /* over the delay of the settings */
} br_compensation;

/* A state as a controller receives it. */
typedef struct {
    int64_t epoch;              /* random number of the plant's process */
    int64_t run;                /* number of the run */
    int64_t seq;                /* number of the state among those of its plant */
    double time_s;              /* plant time since the start of the run */
    double x[BR_NX];            /* as measured */
    double u_applied[BR_NU];    /* acted during the period before */
    int averaged;               /* 1: that is their mean; 0: what acts now, as far as is known */
    int lockstep;               /* 1: the plant waits for the answer */
    int delays;                 /* how many delays follow */
    double delays_s[BR_DELAYS]; /* from the decision on an input to its acting, since the last
                                 * state */
    int estimated;              /* 1: x is not known, and estimated of what has been measured: */
    int measurements;           /* how many follow */
    br_measurement measured[BR_MEASUREMENTS]; /* since the last state, or before, late */
} br_measured;

/* Settings of the control cycle. */
#define BR_DRIVING_FIELDS(REAL, WHOLE)                                                 \
    REAL(brake_fade_mps)   /* speed below which braking fades to none at standstill */ \
    REAL(brake_d)          /* drive command of braking, turned positive */             \
    REAL(brake_slow)       /* what is added to it, times the squared speed */          \
    REAL(standing_mps)     /* a car that is not faster stands */                       \
    REAL(stop_mps2)        /* deceleration of a stop on command */                     \
    REAL(shifted_s)        /* how long after its first input a plan may be driven */   \
    REAL(limit_tolerance)  /* excess over a limit that is clipped, not refused */      \
    WHOLE(recover_cycles)  /* usable solutions in a row that end braking */            \
    WHOLE(compensation)    /* br_compensation */                                       \
    REAL(delay_s)          /* the fixed one */                                         \
    REAL(longest_s)        /* no prediction goes farther */                            \
    REAL(stale_s)          /* age from which a state is fallen back from */            \
    REAL(sensor_tolerance) /* multiple of the bounds of br_state.c; 0: no monitor */

typedef struct {
    double u_low[BR_NU];  /* what no input is below */
    double u_high[BR_NU]; /* what no input is above */
    BR_DRIVING_FIELDS(BR_REAL_MEMBER, BR_WHOLE_MEMBER)
} br_driving;

/* What a controller's step hands out. */
typedef struct {
    double u[BR_NU];             /* first input of the plan */
    int rows;                    /* of the plan; 0: none */
    double plan_u[BR_N * BR_NU]; /* planned inputs */
    double plan_step_s;          /* time from one row of the plan to the next */
    int second_start;            /* as in br_mpc_info */
    double cost;                 /* of the plan; -1: not known */
    double shifted_cost;         /* of the plan before, shifted; -1: there was none */
} br_solution;

/* What one cycle decides. */
typedef struct {
    double u[BR_NU];     /* to be sent: finite, and within the limits */
    int status;          /* of the step, 0: usable; or why there was none */
    int level;           /* br_level */
    int stepped;         /* 1: a step has been made */
    int error;           /* br_mpc_error of a step that is broken */
    int64_t epoch;       /* of the state that this answers */
    int64_t run;         /* of that state */
    int64_t seq;         /* of that state */
    double decided_at_s; /* plant time when the cycle began */
    double delay_s;      /* prediction from there to the moment of acting */
    double step_us;      /* execution time of the step; 0 without a clock */
    double late_s;       /* how much later than its budget it was made; not above 0: in time */
    int fault;           /* br_fault of that state */
} br_decision;

/* What the car's guard does if nothing more comes. */
typedef struct {
    int rows;                          /* of the plan */
    double begins_s;                   /* plant time from which the first row acts */
    double step_s;                     /* time from one row to the next */
    double duty[BR_BRAKING_ROWS];      /* drive command of each row */
    double delta_rad[BR_BRAKING_ROWS]; /* steering angle at its end */
} br_braking;

/* What a control cycle has counted. */
typedef struct {
    int64_t levels[BR_STOP + 1]; /* cycles by level of the fallback; commanded ones left out */
    int64_t failed;              /* steps that refused the call or raised an exception */
    int64_t second_starts;       /* steps that looked for another plan */
    int64_t creeping;            /* steps of a slow car that creeps: see br_mpc_info.second_start */
    int64_t cost_jumps;          /* steps whose plan costs much more than to go on as before */
    int64_t stale;               /* states of the current run that were not newer than one before */
    int64_t foreign; /* states of another plant or run, or far ahead, that were not driven on */
    int64_t faults[BR_FAULT_UNCERTAIN + 1]; /* states by what speaks against them */
    int fault;                              /* br_fault of the newest state */
    int doubted;    /* 1: by it the car is not driven, as it is not known well enough where it is */
    int instrument; /* whose fault it is, where that is estimated; -1: none's, or nothing is known
                     */
    int phase;      /* br_phase, at this moment */
    double delay_s; /* delay that is compensated, at this moment */
    double interval_s; /* plant time between two states in a row; 0: not known */
    double time_s;     /* plant time of the newest state, as far as that is believed */
} br_counters;

/* What a cycle drives: the compiled controller (br_cycle_drive_mpc), or another with these
 * functions. None may block; self is their first argument. */
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

/* How states are estimated that are not measured as a whole, by this model, which must stay; NULL:
 * that of the compiled controller, with its variance. BR_ERROR_NULL without any; BR_ERROR_LEFT_OUT
 * with BR_HAS_ESTIMATOR 0, with which such a state counts as one that is not known; else as for
 * br_estimator_set. Begins anew. What it knows is read by br_estimator_read. */
BR_API br_mpc_error br_cycle_set_estimation(br_cycle *cycle, const br_mpc *model,
                                            const br_estimation *settings);
BR_API const br_estimator *br_cycle_estimator(const br_cycle *cycle);

/* A state has arrived. One that is to be estimated counts with what the estimator makes of it,
 * while faulty instruments are left out and named (counters.instrument). It is doubted while
 * the position is not known to the car's bound, or no instrument that is believed measures
 * a position; where that was contradicted until it was unknown, until br_cycle_go, with which the
 * estimator begins anew. The car is not driven before the estimator has begun. A measured one that
 * contradicts those before it (br_state.c) counts with what the model predicts in place of what it
 * says; after settings.stale_s the car brakes along the line, by that prediction, and drives on
 * once states agree with it again. A run is one stream of states: one plant (epoch), one run
 * number, rising numbers. Another stream is followed once the run has ended (br_cycle_end), once
 * nothing has come for long (br_cycle_forget), or once it has sent several states in a row while
 * the former one was silent: no single message locks out the plant.
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

/* What another controller has sent, which drives while this one only decides: it acts in place of
 * what this one has decided at that plant time, or beside it. */
BR_API void br_cycle_sent(br_cycle *cycle, double decided_at_s, const double u[BR_NU]);

/* br_mpc_prepare for a state that is expected a period after the last one, where one is. */
BR_API void br_cycle_prepare(br_cycle *cycle, double period_s, double budget_s);

/* For replaying what was driven in real time: br_mpc_get_refusals of the compiled controller, which
 * are none of another; and br_mpc_repeat for the next br_cycle_decide or br_cycle_prepare, which
 * is late by spent_s - budget_s alone, however long it takes. */
BR_API int br_cycle_get_refusals(const br_cycle *cycle, int refused[BR_REFUSALS]);
BR_API br_mpc_error br_cycle_repeat(br_cycle *cycle, const int *refused, int count);

/* What the car's guard shall do if no actuation comes any more: the newest input, then the plan for
 * as long as the fallback drives on it, then braking along the line to standstill. To be sent after
 * the decision. BR_ERROR_NOT_READY for a car that is halted, or a controller that knows no line. */
BR_API br_mpc_error br_cycle_brake(const br_cycle *cycle, br_braking *braking);

/* Runs through a cycle without any effect, so that its code and data are in the caches. */
BR_API void br_cycle_rehearse(br_cycle *cycle);

/* From the next cycle on slow down along the line to standstill, and stay; or drive, and believe
 * the next state. */
BR_API void br_cycle_stop(br_cycle *cycle);
BR_API void br_cycle_go(br_cycle *cycle);

/* The run is over, or its plant has gone: the states of another run may follow. */
BR_API void br_cycle_end(br_cycle *cycle);

/* No state has arrived for long: those of any run may follow. 1 if the last state that was refused
 * belongs to a lockstep run, whose plant may still wait for an answer: observe it again. */
BR_API int br_cycle_forget(br_cycle *cycle);

/* Counts and state, kept up to date there. */
BR_API const br_counters *br_cycle_counters(const br_cycle *cycle);

/* What speaks against a state, in words. */
BR_API const char *br_cycle_fault_text(br_fault fault);

#ifdef __cplusplus
}
#endif
#endif
