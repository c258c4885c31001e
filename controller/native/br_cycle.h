/* The parts of the control cycle, without pointers but the controller's. */
#ifndef BR_CYCLE_H
#define BR_CYCLE_H

#include "bayesrace_cycle.h"
#include "br_estimator.h"

#define STAGE_ROUNDING 1e-6 /* share of a stage: times that are added up differ by so much */

/* --- br_state.c: which states count --- */

typedef struct {
    br_measured newest, other; /* other: the last one that did not continue the stream */
    int has_newest, has_other;
    int others;        /* states in a row that belong to the other */
    int ended, silent; /* the run is over; nothing has come for long */
    double dated_s;    /* the newest one, as it came */
} br_stream;

br_reception br_stream_accept(br_stream *stream, const br_measured *state, br_counters *counters);
int br_stream_forget(br_stream *stream, br_counters *counters);

/* --- br_state.c: what the compiled controller is shown, for br_mpc_observe --- */

typedef struct {
    double duration_s, x[BR_NX], u[BR_NU]; /* since a measured state; 0: nothing yet; mean input */
    br_mpc_noise noise;                    /* of estimated states */
} br_shown;

/* mpc NULL: another controller, which is shown nothing. noise: of the step between the two states;
 * NULL: they are exact. */
void br_shown_observe(br_shown *shown, br_mpc *mpc, const br_driving *settings,
                      const br_measured *before, const br_measured *state,
                      const br_mpc_noise *noise);

/* --- br_state.c: the state at the moment from which the new input will act --- */

#define BR_SENT 1024    /* inputs remembered: two seconds at 500 Hz */
#define BR_MEDIAN_OF 15 /* delays */

typedef struct {
    double decided_at_s, u[BR_NU];
} br_sent;

typedef struct {
    int first, count; /* of the inputs sent */
    br_sent sent[BR_SENT];
    int next_delay, delays; /* the newest of those measured */
    double delays_s[BR_MEDIAN_OF];
} br_delay;

void br_delay_observe(br_delay *delay, const br_driving *settings, const br_measured *state,
                      double *delay_s);
void br_delay_sent(br_delay *delay, double decided_at_s, const double u[BR_NU]);
void br_delay_replace(br_delay *delay, double decided_at_s, const double u[BR_NU]);

/* What acts at a plant time; NULL: not known. */
const double *br_delay_acting(br_delay *delay, double time_s, double delay_s);

/* An estimate that is predicted beside the state. */
typedef struct {
    const br_estimator *estimator;
    const br_residual *residual;
    br_estimate at;
} br_carried;

int br_delay_at_acting(br_delay *delay, const br_driving *settings, const br_controller *controller,
                       const br_measured *state, double decided_at_s, double delay_s,
                       double x[BR_NX], double u[BR_NU], br_carried *carried);

/* --- br_fallback.c: what is sent where there is no solution to send --- */

typedef struct {
    int rows; /* of the plan; 0: none */
    int to_recover;
    double plan_s, row_s; /* when its first row began to act; from one to the next */
    double plan[BR_N][BR_NU];
} br_fallback;

br_level br_fallback_decide(br_fallback *fallback, const br_driving *settings,
                            const br_solution *solution, double vx_mps, double time_s,
                            double late_s, double u[BR_NU]);
br_level br_fallback_brake(const br_fallback *fallback, const br_driving *settings, double vx_mps,
                           double time_s, double u[BR_NU]);
void br_fallback_brake_to(const br_driving *settings, double vx_mps, double delta_rad,
                          double angle_rad, double duration_s, double u[BR_NU]);

/* --- br_state.c: whether a measured state can be believed --- */

#define BR_BELIEVED 16

typedef struct {
    double x[BR_NX], u[BR_NU], dt_s; /* u acted for dt_s before */
    double ways;                     /* share of the bounds */
} br_believed;

typedef struct {
    int count, next;                          /* of the newest states believed */
    br_believed believed[BR_BELIEVED], since; /* since: what has been believed after them */
    int64_t seq;                              /* of the newest state, believed or not, */
    double measured_s, before[BR_NX];         /* its time, and what it says */
    double way[BR_NX];                  /* position, heading and steering that should follow */
    int agreeing;                       /* states in a row without contradiction */
    br_fault distrusted;                /* since when on the prediction counts: */
    double time_s, trusted_s, x[BR_NX]; /* its time, that of the last state believed, */
    int doubts;                         /* there have been some: */
    double doubted_s, doubt_ended_s;    /* when the last ones began and ended */
    double ahead_s;                     /* by which times are of another clock than before */
    double gone_m;                      /* and how far it has gone */
} br_monitor;

void br_monitor_restart(br_monitor *monitor);
br_fault br_monitor_check(br_monitor *monitor, const br_driving *settings,
                          const br_controller *controller, double interval_s, br_measured *state);

/* --- br_fallback.c, too: what the car's guard does if nothing more comes --- */

typedef struct {
    const br_controller *controller;
    const br_driving *settings;
    const br_fallback *fallback;
    double time_s; /* when u begins to act, in state x */
    double x[BR_NX], u[BR_NU];
} br_rollout;

void br_braking_plan(const br_rollout *from, br_braking *braking);

#endif
