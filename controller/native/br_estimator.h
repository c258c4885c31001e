/* What an estimator consists of: a control cycle has one in its memory. */
#ifndef BR_ESTIMATOR_H
#define BR_ESTIMATOR_H

#include "bayesrace_estimator.h"

#define BR_SAME_S 1e-9        /* times closer than that are one */
#define BR_NA (BR_NB + BR_NE) /* with accelerations */
#define BR_LONGEST_S 1.0      /* without position, or between two periods: then it begins anew */

#if BR_HAS_PATH
/* The states that the residuals correct. */
static const int BR_RATE[] = {BR_INDEX_VX, BR_INDEX_VY, BR_INDEX_OMEGA};
_Static_assert(sizeof BR_RATE / sizeof BR_RATE[0] == BR_NE, "a state for each residual");
#endif

typedef struct {
    double x[BR_NA], p[BR_NA][BR_NA];
    double way[BR_NX]; /* how far x has moved since the beginning of its period */
    int biased;        /* x errs with the mismatch's weights, of which p has nothing: br_bias.c */
    double by_weight[BR_NE][BR_NPHI][BR_NA];
} br_estimate;

typedef struct {
    double time_s, u[BR_NU]; /* u acted since the event before */
    br_residual residual;
    br_measurement measured; /* count 0: the end of a period */
    int judged;              /* it is in the counts of its instrument */
    int left_out;
    double widening; /* of the covariance before it is compared */
    br_estimate after;
} br_event;

struct br_estimator {
    const br_mpc *mpc;
    br_estimation settings;
    int has_settings, walks; /* walks: by accelerations in place of the model */
    int count;               /* of events, the oldest first; 0: it has not begun */
    int order[BR_EVENTS];
    br_event events[BR_EVENTS];
    double period_s;         /* how long the newest period was; ... */
    double corrected[BR_NX]; /* ... variances by which its measurements corrected what was
                              * predicted from the one before */
    br_instrument instrument[BR_INSTRUMENTS];
    int agreed, astray;  /* since it began a pose has been used; so many were refused before */
    double posed_s;      /* of the newest pose that has been used; */
    br_measurement pose; /* the newest, used or not */
    int latched;         /* no instrument is believed again */
    uint64_t identity;   /* as in br_mpc_mismatch: */
    double weight[BR_NE][BR_NPHI], factor[BR_NE][BR_NPHI][BR_NPHI]; /* as in br_mpc_mismatch */
    int uncertain[BR_NE];                                           /* there is such a factor */
    br_mpc_noise observed; /* of the mismatch, in the newest period */
};

/* The k-th of its events. */
static inline br_event *br_estimator_event(br_estimator *estimator, int k) {
    return &estimator->events[estimator->order[k]];
}

static inline const br_event *br_estimator_newest(const br_estimator *estimator) {
    return &estimator->events[estimator->order[estimator->count - 1]];
}

static inline const br_estimate *br_estimator_now(const br_estimator *estimator) {
    return &br_estimator_newest(estimator)->after;
}

/* What is expected of a measured state, its offset included. */
double br_estimate_observed(const double x[BR_NA], int state);

/* --- br_motion.c: x and P after a duration, under u; and, for a duration up to the newest period's
 * end, how far the estimated step may differ from the car's --- */

br_mpc_error br_estimator_reach(const br_estimator *estimator, const double u[BR_NU],
                                const br_residual *residual, double duration, br_estimate *b);
void br_estimator_noise(const br_estimator *estimator, br_mpc_noise *noise);

/* --- br_bias.c: how an estimate errs with the mismatch's weights --- */

/* Over a period: f, with accelerations, and by_acceleration are its derivatives, phi the terms of
 * its mismatch, all 0 where that is not estimated. The i-th state has faded. */
void br_bias_move(const double f[BR_NX][BR_NA], const double by_acceleration[BR_NX * BR_NE],
                  const double phi[BR_NPHI], br_estimate *b);
void br_bias_fade(int i, double left, br_estimate *b);

/* With a measurement, which is taken by this gain. */
void br_bias_take(const br_measurement *m, double gain[BR_NA][BR_NX], br_estimate *b);

/* Adds to the covariance of what is new in a measurement what the weights' adds to it. */
void br_bias_widen(const br_estimator *estimator, const br_measurement *m, const br_estimate *b,
                   double s[BR_NX][BR_NX]);

/* Adds what a measurement shows of the weights: by what is new in it, and the inverse of its
 * covariance where they are known. */
void br_bias_learn(const br_estimator *estimator, const br_measurement *m, const br_estimate *b,
                   const double inverse[BR_NX][BR_NX], const double fresh[BR_NX],
                   br_mpc_noise *shown);

/* w' phi of an output. */
double br_bias_mean(const br_estimator *estimator, int output, const double phi[BR_NPHI]);

/* The covariance of an estimate, all included; the variance of its i-th state. */
double br_estimator_variance(const br_estimator *estimator, const br_estimate *b, int i);
void br_estimator_covariance(const br_estimator *estimator, const br_estimate *b,
                             double p[BR_NA][BR_NA]);

/* --- br_instrument.c: whether what an instrument reports can be believed --- */

/* A measurement has come by time_s. */
void br_instrument_arrive(br_instrument *instrument, const br_measurement *m, double time_s);

/* Whether it says the same as before to the bit; though by these estimates that has changed. */
int br_instrument_holds(const br_instrument *instrument, const br_measurement *m);
int br_instrument_repeats(br_instrument *instrument, const br_measurement *m, const br_estimate *b);

/* Whether it differs from what is expected by so little that the model may be wrong, which has had
 * no measurement of the instrument's until these were refused; or by less than any model errs in
 * position, whatever it says of itself. */
int br_instrument_near(const br_instrument *instrument, const br_measurement *m,
                       const br_estimate *b);
int br_instrument_possible(const br_measurement *m, const br_estimate *b);

/* Whether such an instrument says something that cannot be, rather than nothing. */
int br_instrument_contradicts(int fault);

/* What in the measurement is farthest from what is expected. */
br_fault br_instrument_kind(const br_measurement *m, const br_estimate *b);

/* A measurement speaks against the instrument; or for it: whether that is believed again. */
void br_instrument_bad(br_instrument *instrument, br_fault kind);
int br_instrument_good(br_instrument *instrument, int latched);

/* Nothing may have come for too long. */
void br_instrument_wait(br_instrument *instrument, double time_s);

/* Believes it; counts stay. */
void br_instrument_restart(br_instrument *instrument);

/* The first instrument that is not believed; -1: all are. */
int br_estimator_faulty(const br_estimator *estimator);

/* The fault of those that measure position, if none of them is believed; *contradicted: they say
 * something else, rather than nothing. */
br_fault br_estimator_blind(const br_estimator *estimator, int *contradicted);

#endif
