/* What an estimator consists of: a control cycle has one in its memory. */
#ifndef BR_ESTIMATOR_H
#define BR_ESTIMATOR_H

#include "bayesrace_estimator.h"

typedef struct {
    double x[BR_NB], p[BR_NB][BR_NB];
    double way[BR_NX]; /* how far x has moved since the beginning of its period */
} br_estimate;

typedef struct {
    double time_s, u[BR_NU], variance[BR_NE]; /* u acted since the event before */
    br_measurement measured;                  /* count 0: the end of a period */
    int judged;                               /* it is in the counts of its instrument */
    br_estimate after;
} br_event;

struct br_estimator {
    const br_mpc *mpc;
    br_estimation settings;
    int has_settings;
    int count; /* of events, the oldest first; 0: it has not begun */
    int order[BR_EVENTS];
    br_event events[BR_EVENTS];
    double corrected[BR_NX]; /* see br_belief */
    br_instrument instrument[BR_INSTRUMENTS];
};

/* The k-th of its events. */
static inline br_event *br_estimator_event(br_estimator *estimator, int k) {
    return &estimator->events[estimator->order[k]];
}

#endif
