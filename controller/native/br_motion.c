/* How an estimate moves between two events: by the corrected model and what that may err by, or,
 * where nothing corrects it, by accelerations in its place (bayesrace_estimator.h).
 */
#include "br_estimator.h"

#include <math.h>
#include <string.h>

#if BR_HAS_PATH

#define GUESSING 2.0 /* deviations of the residual by which a guess errs */

/* P <- F P F' + Q, where what is beside the states stays. */
static void spread(const double jacobian[BR_NX * BR_NX],
                   const double by_acceleration[BR_NX * BR_NE], const double q[BR_NX * BR_NX],
                   const double by_mismatch[BR_NX * BR_NE], const double phi[BR_NPHI],
                   br_estimate *b) {
    double f[BR_NX][BR_NA] = {{0}}, fp[BR_NX][BR_NA];
    for (int i = 0; i < BR_NX; ++i) {
        for (int l = 0; l < BR_NX; ++l) f[i][l] = jacobian[BR_NX * i + l];
        for (int j = 0; j < BR_NE; ++j) f[i][BR_NB + j] = by_acceleration[BR_NE * i + j];
        for (int j = 0; j < BR_NA; ++j) {
            fp[i][j] = 0;
            for (int l = 0; l < BR_NX; ++l) fp[i][j] += f[i][l] * b->p[l][j];
            for (int l = BR_NB; l < BR_NA; ++l) fp[i][j] += f[i][l] * b->p[l][j];
        }
    }
    for (int i = 0; i < BR_NX; ++i) {
        for (int j = i; j < BR_NX; ++j) {
            double sum = q[BR_NX * i + j];
            for (int l = 0; l < BR_NX; ++l) sum += fp[i][l] * f[j][l];
            for (int l = BR_NB; l < BR_NA; ++l) sum += fp[i][l] * f[j][l];
            b->p[i][j] = b->p[j][i] = sum;
        }
        for (int j = BR_NX; j < BR_NA; ++j) b->p[i][j] = b->p[j][i] = fp[i][j];
    }
    br_bias_move(f, by_mismatch, phi, b);
}

/* The yaw acceleration of a car that follows its steering angle, with a lag, as a car that
 * understeers does in the end; and how it changes with the state. */
static double steered(const br_estimation *s, const double x[BR_NX], double duration,
                      double slope[BR_NX]) {
    const double v = fmax(x[BR_INDEX_VX], 0), angle = x[BR_INDEX_DELTA];
    const double base = BR_WHEELBASE_M + s->understeer * v * v;
    const double share = (1 - exp(-duration / s->yaw_lag_s)) / duration;
    memset(slope, 0, BR_NX * sizeof(double));
    slope[BR_INDEX_VX] = share * angle * (BR_WHEELBASE_M - s->understeer * v * v) / (base * base);
    slope[BR_INDEX_DELTA] = share * v / base;
    slope[BR_INDEX_OMEGA] = -share;
    return share * (v * angle / base - x[BR_INDEX_OMEGA]);
}

/* As br_mpc_propagate, where accelerations move the car: along it beside the model, which knows the
 * motor, else in its place, because by the model a wheel that is turned moves the car at once. */
static br_mpc_error walk(const br_estimator *estimator, const br_estimate *b, const double u[BR_NU],
                         double duration, double next[BR_NX], double f[BR_NX * BR_NX],
                         double by[BR_NX * BR_NE], double q[BR_NX * BR_NX]) {
    double lacking[BR_NE], turning[BR_NX];
    const br_mpc *mpc = estimator->mpc;
    const double *x = b->x, *acceleration = b->x + BR_NB;
    br_mpc_error error = br_mpc_propagate(mpc, x, x, u, duration, NULL, NULL, next, f, by, q);
    if (error) return error;
    for (int j = 0; j < BR_NE; ++j) {
        lacking[j] = acceleration[j];
        if (BR_RATE[j] != BR_INDEX_VX) lacking[j] += (x[BR_RATE[j]] - next[BR_RATE[j]]) / duration;
        if (BR_RATE[j] == BR_INDEX_OMEGA)
            lacking[j] += steered(&estimator->settings, x, duration, turning);
    }
    error = br_mpc_propagate(mpc, x, x, u, duration, NULL, lacking, next, f, by, q);
    if (error) return error;
    double changed[BR_NE][BR_NX] = {{0}}; /* of what is lacking, with x */
    for (int j = 0; j < BR_NE; ++j)
        for (int l = 0; BR_RATE[j] != BR_INDEX_VX && l < BR_NX; ++l)
            changed[j][l] = ((l == BR_RATE[j]) - f[BR_NX * BR_RATE[j] + l]) / duration +
                            (BR_RATE[j] == BR_INDEX_OMEGA ? turning[l] : 0);
    for (int i = 0; i < BR_NX; ++i)
        for (int l = 0; l < BR_NX; ++l)
            for (int j = 0; j < BR_NE; ++j) f[BR_NX * i + l] += by[BR_NE * i + j] * changed[j][l];
    return BR_OK;
}

/* The car's largest acceleration (sensor monitor): no model errs by more. */
static double largest(int j) {
    return BR_RATE[j] == BR_INDEX_OMEGA ? BR_MONITOR_YAW_ACCELERATION_RADPS2
                                        : BR_MONITOR_ACCELERATION_MPS2;
}

/* What of the residual's variance is no noise, but a guess: where a Gaussian process has not been
 * trained, its error follows the car's state, and lasts for longer than a stage. */
static double guessed(const br_residual *residual, int j) {
    return fmax(residual->variance[j] - 2 * residual->noise[j], 0);
}

/* The variance of an acceleration: in place of the model, or of what this errs by. */
static double walking(const br_estimation *s, const br_residual *residual, int j) {
    const double deviation = s->acceleration[j], erring = GUESSING / BR_TS;
    return deviation * deviation +
           fmin(erring * erring * guessed(residual, j), largest(j) * largest(j));
}

/* Accelerations after a duration: less of what they were, and something new. */
static void fade(const br_estimation *s, const br_residual *residual, double duration,
                 br_estimate *b) {
    const double left = exp(-duration / s->acceleration_s);
    for (int j = 0; j < BR_NE; ++j) {
        const int i = BR_NB + j;
        b->x[i] *= left;
        for (int l = 0; l < BR_NA; ++l) b->p[i][l] = b->p[l][i] = left * b->p[i][l];
        b->p[i][i] = left * b->p[i][i] + (1 - left * left) * walking(s, residual, j);
        br_bias_fade(i, left, b);
    }
}

/* x and P after a duration of at most a stage, under u. The residual is that of where the period
 * began, by what is believed now: taken anew at each measurement it would run ahead of the car. */
static br_mpc_error propagate(const br_estimator *estimator, const double u[BR_NU],
                              const br_residual *residual, double duration, br_estimate *b) {
    double f[BR_NX * BR_NX], by[BR_NX * BR_NE], q[BR_NX * BR_NX], begin[BR_NX], next[BR_NX];
    double white[BR_NE], beside[BR_NE], by_mismatch[BR_NX * BR_NE];
    int limited[BR_NE];
    for (int i = 0; i < BR_NX; ++i) begin[i] = b->x[i] - b->way[i];
    for (int j = 0; j < BR_NE; ++j) {
        white[j] = residual->variance[j] - guessed(residual, j);
        const double most = largest(j), mean = br_bias_mean(estimator, j, residual->phi) / BR_TS;
        const double mismatch = fmin(fmax(mean, -most), most);
        limited[j] = mismatch != mean;
        beside[j] = mismatch + b->x[BR_NB + j];
    }
    const br_mpc_error error = estimator->walks
                                   ? walk(estimator, b, u, duration, next, f, by, q)
                                   : br_mpc_propagate(estimator->mpc, b->x, begin, u, duration,
                                                      white, beside, next, f, by, q);
    if (error) return error;
    for (int i = 0; i < BR_NX; ++i) {
        b->way[i] += next[i] - b->x[i];
        b->x[i] = next[i];
    }
    for (int i = 0; i < BR_NX * BR_NE; ++i) by_mismatch[i] = limited[i % BR_NE] ? 0 : by[i];
    spread(f, by, q, by_mismatch, residual->phi, b);
    const br_estimation *s = &estimator->settings;
    for (int i = 0; i < BR_NB; ++i)
        if (i < BR_NX || s->start[i] > 0) b->p[i][i] += duration * s->drift[i] * s->drift[i];
    fade(s, residual, duration, b);
    return BR_OK;
}

br_mpc_error br_estimator_reach(const br_estimator *estimator, const double u[BR_NU],
                                const br_residual *residual, double duration, br_estimate *b) {
    br_mpc_error error = BR_OK;
    for (; duration > BR_TS + BR_SAME_S && !error; duration -= BR_TS) {
        error = propagate(estimator, u, residual, BR_TS, b);
        memset(b->way, 0, sizeof b->way);
    }
    if (error || duration < BR_SAME_S) return error;
    return propagate(estimator, u, residual, fmin(duration, BR_TS), b);
}

/* The car's own step differs from the model's by something of variance q, of whose covariance c
 * with the prediction's error the correction shows the share corrected / predicted: with e the
 * error of an estimate,
 *
 *   var(e - f e_before) = corrected + q - 2 c corrected / predicted,
 *
 * each state taken by itself. Where measurements say little that is more than is corrected: what
 * they have not shown of the car's step is no error of whatever weights. c is q for what is
 * independent from one step to the next, and more for accelerations that last. */
void br_estimator_noise(const br_estimator *estimator, br_mpc_noise *noise) {
    const double duration_s = estimator->period_s;
    const br_estimation *s = &estimator->settings;
    const br_event *newest = br_estimator_newest(estimator);
    const br_estimate *now = &newest->after;
    double q[BR_NX], c[BR_NX];
    for (int i = 0; i < BR_NX; ++i) c[i] = q[i] = duration_s * s->drift[i] * s->drift[i];
    for (int j = 0; j < BR_NE; ++j) {
        const int i = BR_RATE[j], acceleration = BR_NB + j;
        const double left = now->p[i][i] / (now->p[i][i] + estimator->corrected[i]);
        const double white = newest->residual.variance[j] - guessed(&newest->residual, j);
        if (!estimator->walks) c[i] = q[i] += duration_s / BR_TS * white;
        q[i] += duration_s * duration_s * now->p[acceleration][acceleration];
        c[i] += duration_s * now->p[acceleration][i] / left; /* as it was predicted */
    }
    *noise = estimator->observed;
    for (int i = 0; i < BR_NX; ++i) {
        const double corrected = estimator->corrected[i], predicted = now->p[i][i] + corrected;
        const double shown = predicted > 0 ? corrected / predicted : 0;
        noise->step[i] = fmax(corrected + q[i] - 2 * c[i] * shown, 0);
    }
}

#endif
