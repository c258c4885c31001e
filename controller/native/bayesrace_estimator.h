/* BayesRace state estimator: from what sensors say to the state of the car.
 *
 * An extended Kalman filter over the controller's own corrected model (br_mpc_propagate), with the
 * weights in use. Instruments measure some of the states at a time, whenever they do, and may say
 * so late: what came after is then done over. Two offsets are estimated beside the states: of the
 * measured yaw rate (a gyro's) and of the measured steering angle; and accelerations that the model
 * lacks, as first-order Markov processes (Singer, "Estimating optimal tracking filter performance
 * for manned maneuvering targets", IEEE Trans. AES 6, 1970): where its weights guess, as large as
 * their variance, and where there are none, beside the model's acceleration along the car, in place
 * of its lateral motion, and beside a lag of the yaw rate in place of its yaw.
 *
 *   br_estimator_correct(estimator, &mismatch);                                  each period
 *   br_estimator_advance(estimator, time_s, u, residual, measurements, count);
 *   br_estimator_read(estimator, &belief);
 *
 * As with br_mpc, an estimator lives in memory of the caller's, allocates nothing, and is for one
 * thread: that of the controller's steps. Times are the plant's, units SI.
 */
#ifndef BAYESRACE_ESTIMATOR_H
#define BAYESRACE_ESTIMATOR_H

#include <stdint.h>

#include "bayesrace_mpc.h"

#ifdef __cplusplus
extern "C" {
#endif

#define BR_OFFSETS 2               /* of yaw rate and steering angle, in this order */
#define BR_NB (BR_NX + BR_OFFSETS) /* what is estimated, beside accelerations */
#define BR_INSTRUMENTS 8
#if BR_HAS_ESTIMATOR
#define BR_EVENTS 64 /* of the newest periods and measurements that are kept to be done over */
#else
#define BR_EVENTS 1
#endif

/* Why a measured state, or an instrument, is not believed: see br_state.c, br_instrument.c and
 * br_cycle_fault_text. */
typedef enum {
    BR_FAULT_NONE = 0,
    BR_FAULT_FROZEN,
    BR_FAULT_TIME,
    BR_FAULT_POSITION,
    BR_FAULT_HEADING,
    BR_FAULT_VELOCITY,
    BR_FAULT_YAW_RATE,
    BR_FAULT_STEERING,
    BR_FAULT_ELSEWHERE,
    BR_FAULT_UNCERTAIN
} br_fault;

/* What one instrument has measured at one moment. */
typedef struct {
    double time_s;
    int instrument;          /* its number, below BR_INSTRUMENTS */
    int count;               /* values that belong together, 1 to BR_NX: */
    int of[BR_NX];           /* the states that they are of, each once */
    double value[BR_NX];     /* a heading may be off by whole turns */
    double deviation[BR_NX]; /* standard deviations; errors of one moment are independent */
} br_measurement;

/* What is assumed. */
typedef struct {
    double start[BR_NB]; /* standard deviations of what has not been measured yet, around 0; an
                          * offset with 0 is none */
    double drift[BR_NB]; /* random walk beyond the model's own uncertainty [unit/sqrt(s)] */
    double acceleration[BR_NE]; /* standard deviations of accelerations in place of the model,
                                 * around 0; all 0: the model moves the car, and what it lacks */
    double acceleration_s;      /* the time constant of either, above 0 */
    double yaw_lag_s;  /* with which the yaw rate then follows the steering angle, above 0; ... */
    double understeer; /* ... what of the angle a lateral acceleration takes up [rad s^2/m] */
    double gate; /* a measurement is refused beyond so many times the squared distance that one of
                  * 1,000 exceeds (chi-squared); 0: none is */
} br_estimation;

/* The residual at the beginning of a period, per stage: how uncertain it is, where noise is that
 * part of the variance which was not explained in training, and the terms of its mismatch
 * (br_mpc_mismatch). */
typedef struct {
    double variance[BR_NE], noise[BR_NE], phi[BR_NPHI];
} br_residual;

/* State with its covariance. */
typedef struct {
    double time_s;
    double x[BR_NB];
    double covariance[BR_NB * BR_NB];
    br_mpc_noise noise; /* of the last period: for br_mpc_observe */
} br_belief;

/* What has become of one instrument's measurements. */
typedef struct {
    int64_t used, refused; /* refused: by the gate */
    int64_t lost;          /* from the future, or from before what is kept */
    int64_t left_out;      /* equal to the bit though the car moved; agreeing, of a faulty one */
    int refused_in_row;    /* of the newest */
    double passed_s, refused_s; /* times of the newest that was not, and of the first in that row */
    double squared, expected;   /* of those used, at first: sums of the squared distances by the
                                 * covariance of what is new in them, and of how many values they
                                 * had; equal where all covariances are true */
    int fault; /* br_fault: it is left out; 0: it is believed. What that follows of: */
    int bad_in_row, good_in_row;  /* of the newest */
    int seen;                     /* it has measured since the estimator began */
    double interval_s;            /* between two measurements; 0: not known yet */
    double measured_s, arrived_s; /* of the newest; arrived: the end of its period */
    br_measurement held;          /* the first of those that are equal to the bit, ... */
    double held_expected[BR_NX];  /* ... and what was expected of it; */
    double held_moved;            /* by how many deviations that has changed since, at most */
    int repeated, longest;        /* how often it was repeated since, and others before it */
} br_instrument;

typedef struct br_estimator br_estimator;

BR_API size_t br_estimator_memory_size(void);
BR_API br_mpc_error br_estimator_init(void *memory, size_t size, const br_mpc *mpc,
                                      br_estimator **out);

/* BR_ERROR_PARAMETERS, and nothing changes, for numbers that are negative or not finite. Begins
 * anew. */
BR_API br_mpc_error br_estimator_set(br_estimator *estimator, const br_estimation *settings);

/* Knows nothing any more, and believes all instruments; counts stay. */
BR_API void br_estimator_reset(br_estimator *estimator);

/* The mismatch, from now on: br_mpc_get_mismatch, before a period, whose residual has its phi, and
 * its unexplained added to the variance. What was estimated is what it would be if these weights
 * had been known before, to first order, unless the mismatch before was of other Gaussian
 * processes. BR_ERROR_PARAMETERS for numbers that are not finite. */
BR_API br_mpc_error br_estimator_correct(br_estimator *estimator, const br_mpc_mismatch *mismatch);

/* The period that ends at time_s is over: u acted in it, and so much has been measured, in it or
 * before. residual: NULL: 0. It begins with a position and heading that are measured together, and
 * anew after a second without unless they are contradicted. Where what follows does not fit to a
 * car around standstill, it begins with the difference of two poses. What contradicts, repeats
 * itself or is of another time five times in a row, or does not come for five intervals and 0.15 s,
 * is left out until three in a row agree (br_instrument.c). BR_ERROR_NOT_READY while it has not
 * begun; BR_ERROR_TIME if time_s is not after the period before, BR_ERROR_STATE if the model cannot
 * follow: it then begins anew. */
BR_API br_mpc_error br_estimator_advance(br_estimator *estimator, double time_s,
                                         const double u[BR_NU], const br_residual *residual,
                                         const br_measurement *measurements, int count);

/* At the end of the last period. */
BR_API br_mpc_error br_estimator_read(const br_estimator *estimator, br_belief *belief);

BR_API const br_instrument *br_estimator_instrument(const br_estimator *estimator, int number);

/* What speaks against an instrument, in words. */
BR_API const char *br_estimator_fault_text(br_fault fault);

#ifdef __cplusplus
}
#endif
#endif
