/* The parts of the control cycle, without pointers but the controller's. */
#ifndef BR_CYCLE_H
#define BR_CYCLE_H

#include "bayesrace_cycle.h"

/* --- br_stream.c: which states count --- */

typedef struct {
    br_measured newest, other; /* other: the last one that did not continue the stream */
    int has_newest, has_other;
    int others;        /* states in a row that belong to the other */
    int ended, silent; /* the run is over; nothing has come for long */
} br_stream;

void br_stream_init(br_stream *stream);
br_reception br_stream_accept(br_stream *stream, const br_measured *state, br_counters *counters);
int br_stream_forget(br_stream *stream, br_counters *counters);

/* --- br_delay.c: the state at the moment from which the new input will act --- */

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
int br_delay_at_acting(br_delay *delay, const br_driving *settings, const br_controller *controller,
                       const br_measured *state, double decided_at_s, double delay_s,
                       double x[BR_NX], double u[BR_NU]);

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

#endif
