/* How an estimate errs with what its model errs by.
 *
 * The residual errs by w' phi, the mismatch (br_mismatch.c), whose weights w are estimated beside
 * the state, from what is new in the measurements (Friedland, "Treatment of bias in recursive
 * filtering", IEEE Trans. AC 14, 1969). The filter goes on as if they were known. Beside it, for
 * each weight, goes by how much the estimate errs if that is larger by one, a column of U:
 *
 *   U <- F U + G phi'           over a period, with G from an output's residual to the state,
 *   U <- U - K H U              with a measurement,
 *
 * and what is new in a measurement is H U (w - w_used), and white noise of covariance S. That is
 * what the regression learns from. Its weights, once others, move what was estimated by U times the
 * change, and their covariance M makes that of the estimate P + U M U'. All of it is exact for a
 * linear model, weights that stay the same, and measurements in order: one that comes late counts
 * as if those that came before it had not.
 */
#include "br_estimator.h"

#include <string.h>

#if BR_HAS_PATH

void br_bias_move(const double f[BR_NX][BR_NA], const double by_acceleration[BR_NX * BR_NE],
                  const double phi[BR_NPHI], br_estimate *b) {
    if (phi[0] != 0 && !b->biased) {
        memset(b->by_weight, 0, sizeof b->by_weight);
        b->biased = 1;
    }
    for (int j = 0; b->biased && j < BR_NE; ++j)
        for (int k = 0; k < BR_NPHI; ++k) {
            double *by = b->by_weight[j][k], after[BR_NX];
            for (int i = 0; i < BR_NX; ++i) {
                after[i] = by_acceleration[BR_NE * i + j] * phi[k] / BR_TS;
                for (int l = 0; l < BR_NX; ++l) after[i] += f[i][l] * by[l];
                for (int l = BR_NB; l < BR_NA; ++l) after[i] += f[i][l] * by[l];
            }
            memcpy(by, after, sizeof after);
        }
}

void br_bias_fade(int i, double left, br_estimate *b) {
    for (int j = 0; b->biased && j < BR_NE; ++j)
        for (int k = 0; k < BR_NPHI; ++k) b->by_weight[j][k][i] *= left;
}

double br_bias_mean(const br_estimator *estimator, int output, const double phi[BR_NPHI]) {
    double sum = 0;
    for (int k = 0; k < BR_NPHI; ++k) sum += estimator->weight[output][k] * phi[k];
    return sum;
}

/* H U of an output. */
static void observed(const br_estimate *b, const br_measurement *m, int output,
                     double by[BR_NX][BR_NPHI]) {
    for (int a = 0; a < m->count; ++a)
        for (int k = 0; k < BR_NPHI; ++k)
            by[a][k] = br_estimate_observed(b->by_weight[output][k], m->of[a]);
}

void br_bias_take(const br_measurement *m, double gain[BR_NA][BR_NX], br_estimate *b) {
    for (int j = 0; b->biased && j < BR_NE; ++j) {
        double by[BR_NX][BR_NPHI];
        observed(b, m, j, by);
        for (int k = 0; k < BR_NPHI; ++k)
            for (int i = 0; i < BR_NA; ++i)
                for (int a = 0; a < m->count; ++a) b->by_weight[j][k][i] -= gain[i][a] * by[a][k];
    }
}

/* L^-1 v */
static void whiten(const br_estimator *estimator, int output, const double v[BR_NPHI],
                   double white[BR_NPHI]) {
    for (int k = 0; k < BR_NPHI; ++k) {
        const double *row = estimator->factor[output][k];
        white[k] = v[k];
        for (int l = 0; l < k; ++l) white[k] -= row[l] * white[l];
        white[k] *= row[k];
    }
}

/* Adds to a covariance of n numbers, whose rows are so far apart, what the weights of an output add
 * to it: by M by', by how these numbers err with the weights. */
static void add_uncertain(const br_estimator *estimator, int output, int n, double by[][BR_NPHI],
                          double *covariance, int apart) {
    double white[BR_NA][BR_NPHI];
    for (int a = 0; a < n; ++a) whiten(estimator, output, by[a], white[a]);
    for (int a = 0; a < n; ++a)
        for (int c = 0; c < n; ++c)
            for (int k = 0; k < BR_NPHI; ++k)
                covariance[apart * a + c] += white[a][k] * white[c][k];
}

void br_bias_widen(const br_estimator *estimator, const br_measurement *m, const br_estimate *b,
                   double s[BR_NX][BR_NX]) {
    for (int j = 0; b->biased && j < BR_NE; ++j) {
        double by[BR_NA][BR_NPHI];
        if (!estimator->uncertain[j]) continue;
        observed(b, m, j, by);
        add_uncertain(estimator, j, m->count, by, s[0], BR_NX);
    }
}

void br_estimator_covariance(const br_estimator *estimator, const br_estimate *b,
                             double p[BR_NA][BR_NA]) {
    memcpy(p, b->p, sizeof b->p);
    for (int j = 0; b->biased && j < BR_NE; ++j) {
        double by[BR_NA][BR_NPHI];
        if (!estimator->uncertain[j]) continue;
        for (int i = 0; i < BR_NA; ++i)
            for (int k = 0; k < BR_NPHI; ++k) by[i][k] = b->by_weight[j][k][i];
        add_uncertain(estimator, j, BR_NA, by, p[0], BR_NA);
    }
}

double br_estimator_variance(const br_estimator *estimator, const br_estimate *b, int i) {
    double variance = b->p[i][i];
    for (int j = 0; b->biased && j < BR_NE; ++j) {
        double by[1][BR_NPHI];
        if (!estimator->uncertain[j]) continue;
        for (int k = 0; k < BR_NPHI; ++k) by[0][k] = b->by_weight[j][k][i];
        add_uncertain(estimator, j, 1, by, &variance, 1);
    }
    return variance;
}

void br_bias_learn(const br_estimator *estimator, const br_measurement *m, const br_estimate *b,
                   const double inverse[BR_NX][BR_NX], const double fresh[BR_NX],
                   br_mpc_noise *shown) {
    const int n = m->count;
    shown->values += b->biased ? n : 0;
    for (int j = 0; b->biased && j < BR_NE; ++j) {
        double by[BR_NX][BR_NPHI], target[BR_NX];
        observed(b, m, j, by);
        for (int a = 0; a < n; ++a) target[a] = fresh[a] + br_bias_mean(estimator, j, by[a]);
        for (int a = 0; a < n; ++a) {
            double scaled[BR_NPHI] = {0}, left = 0; /* S^-1 by, S^-1 target */
            for (int c = 0; c < n; ++c) {
                for (int k = 0; k < BR_NPHI; ++k) scaled[k] += inverse[a][c] * by[c][k];
                left += inverse[a][c] * target[c];
            }
            for (int k = 0; k < BR_NPHI; ++k) {
                for (int l = 0; l < BR_NPHI; ++l)
                    shown->information[j][k][l] += by[a][k] * scaled[l];
                shown->projection[j][k] += by[a][k] * left;
            }
            shown->squares[j] += target[a] * left;
        }
    }
}

static void shift(const br_estimator *estimator, const br_mpc_mismatch *mismatch, br_estimate *b) {
    for (int j = 0; j < BR_NE; ++j)
        for (int k = 0; k < BR_NPHI; ++k) {
            const double more = mismatch->weight[j][k] - estimator->weight[j][k];
            if (more == 0) continue;
            for (int i = 0; i < BR_NA; ++i) b->x[i] += more * b->by_weight[j][k][i];
        }
}

static int all_finite(const br_mpc_mismatch *mismatch) {
    double sum = 0; /* 0 * inf and 0 * nan are nan */
    for (int j = 0; j < BR_NE; ++j)
        for (int k = 0; k < BR_NPHI; ++k) {
            sum += 0 * mismatch->phi[k] + 0 * mismatch->weight[j][k];
            for (int l = 0; l < BR_NPHI; ++l) sum += 0 * mismatch->factor[j][k][l];
        }
    return sum == 0;
}

br_mpc_error br_estimator_correct(br_estimator *estimator, const br_mpc_mismatch *mismatch) {
    if (!estimator || !mismatch) return BR_ERROR_NULL;
    if (!all_finite(mismatch)) return BR_ERROR_PARAMETERS;
    const int same = mismatch->phi[0] != 0 && mismatch->identity == estimator->identity;
    for (int e = 0; e < estimator->count; ++e) {
        br_event *one = br_estimator_event(estimator, e);
        if (one->after.biased && same) shift(estimator, mismatch, &one->after);
        if (same) continue;
        one->after.biased = 0; /* what was estimated by other weights stays as it was */
        memset(one->residual.phi, 0, sizeof one->residual.phi);
    }
    estimator->identity = mismatch->identity;
    memcpy(estimator->weight, mismatch->weight, sizeof estimator->weight);
    memcpy(estimator->factor, mismatch->factor, sizeof estimator->factor);
    for (int j = 0; j < BR_NE; ++j) estimator->uncertain[j] = mismatch->factor[j][0][0] > 0;
    return BR_OK;
}

#endif
