/* The band against what the car does: where one-step errors are larger than the residual's standard
 * deviations say, these are widened.
 *
 * A posterior knows how far the plan is from its samples, and nothing of a car that has become
 * another one since, on a damp track for instance: there it is wrong and sure of itself. What tells
 * is the innovation, the difference between the state measured and the one predicted from the state
 * before (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation",
 * 2001, section 5.4, the test of consistency). For each output, the mean of |error| / sigma over
 * WIDEN stages says by how much the band is too narrow. The largest of these means counts, and is
 * forgotten over NARROW stages, some laps' worth of bends: on a straight nothing is wrong. A band
 * that is wide enough stays what it is.
 *
 * A step uses what has been observed until the step before it began, so that it is the same with
 * and without a preparation.
 */
#include <math.h>

#include "br_internal.h"

#define WIDEN 10.0          /* time constants, in stages */
#define NARROW 500.0        /* ten seconds of the 1:43 car */
#define SIGMA_PER_MEAN 1.25 /* of normally distributed errors: standard deviation / mean size */
#define LARGEST 1e3         /* standard deviations: of a band that says nothing */

void br_innovation_reset(br_innovation *innovation) {
    innovation->due.duration = innovation->judged = 0;
    for (int j = 0; j < BR_NE; ++j)
        innovation->misfit.recent[j] = innovation->misfit.held[j] = 1 / SIGMA_PER_MEAN;
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
    return fmax(SIGMA_PER_MEAN * innovation->misfit.held[output], 1);
}

/* The state that shows most of this output. */
static int shown_by(const br_stage *stage, int output) {
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
        if (!(variance[j] > 0)) continue; /* nothing is known of this output */
        const int i = shown_by(&mpc->stage[0], j);
        const double share = mpc->stage[0].in_e[i][j] * stages;
        const double error = fabs((due->x_next[i] - predicted[i]) / share);
        const double sigmas = fmin(error / sqrt(variance[j]), LARGEST);
        misfit->recent[j] += fmin(stages / WIDEN, 1) * (sigmas - misfit->recent[j]);
        misfit->held[j] = fmax(misfit->recent[j], misfit->held[j] * fmax(1 - stages / NARROW, 0));
    }
}
