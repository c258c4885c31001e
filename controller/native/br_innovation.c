/* The residual's standard deviations against what the car does: where errors from one measured
 * state to the next are larger than these say, they are widened.
 *
 * The posterior variance grows with the distance of the plan from the samples. It stays small near
 * the samples when the car has changed since, on a damp track for instance, although the mean is
 * wrong there. The innovation shows it, the difference between the state measured and the one
 * predicted from the state before (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to
 * Tracking and Navigation", 2001, section 5.4, the test of consistency). For each output the mean
 * of |error| / sigma over RECENT stages is compared with what it comes to at most where sigma is
 * right. The largest mean counts and is forgotten over HELD stages, some laps' worth of bends,
 * because on a straight nothing is wrong.
 *
 * A step uses what was observed before the step before it, so that it is the same with and without
 * a preparation.
 */
#include <math.h>

#include "br_internal.h"

/* In stages, as the plan counts time. */
#define RECENT 10.0
#define HELD 500.0
/* Errors in a row resemble each other: where sigma was right, largest means were 0.7 to 2.3. */
#define USUAL 3.0
#define SIGMA_PER_MEAN 1.25 /* of normally distributed errors: standard deviation / mean size */
#define LARGEST 200.0       /* standard deviations: no single wrong measurement counts more */

void br_innovation_reset(br_innovation *innovation) {
    innovation->due.duration = innovation->judged = 0;
    for (int j = 0; j < BR_NE; ++j) innovation->misfit.recent[j] = innovation->misfit.held[j] = 1;
}

void br_innovation_advance(br_innovation *innovation) {
    innovation->due = innovation->newest;
    innovation->newest.duration = innovation->judged = 0;
}

int br_innovation_due(const br_innovation *innovation) {
    return innovation->due.duration > 0 && !innovation->judged;
}

void br_innovation_undo(br_innovation *innovation) {
    if (innovation->judged) innovation->misfit = innovation->before;
    innovation->judged = 0;
}

double br_innovation_widening(const br_innovation *innovation, int output) {
    return 1 + SIGMA_PER_MEAN * fmax(innovation->misfit.held[output] - USUAL, 0);
}

/* The state that this output changes most. */
int br_most_changed(const br_stage *stage, int output) {
    int most = 0;
    for (int i = 1; i < BR_NX; ++i)
        if (fabs(stage->in_e[i][output]) > fabs(stage->in_e[most][output])) most = i;
    return most;
}

void br_innovation_judge(br_mpc *mpc, const double variance[BR_NE]) {
    br_innovation *innovation = &mpc->innovation;
    br_misfit *misfit = &innovation->misfit;
    const br_transition *due = &innovation->due;
    const double stages = due->duration / BR_TS;
    double predicted[BR_NX];
    innovation->judged = 1;
    innovation->before = *misfit;
    if (br_predict(mpc, due->x, due->u, due->duration, predicted)) return;
    for (int j = 0; j < BR_NE; ++j) {
        const int i = br_most_changed(&mpc->stage[0], j);
        const double share = fabs(mpc->stage[0].in_e[i][j]) * stages;
        if (!(share > 0 && variance[j] > 0)) continue; /* nothing is known of this output */
        const double error = fabs(due->x_next[i] - predicted[i]) / share;
        const double sigmas = fmin(error / sqrt(variance[j]), LARGEST);
        misfit->recent[j] += fmin(stages / RECENT, 1) * (sigmas - misfit->recent[j]);
        misfit->held[j] = fmax(misfit->recent[j], misfit->held[j] * fmax(1 - stages / HELD, 0));
    }
}
