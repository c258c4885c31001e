/* Predictions against what the car does from one measured state to the next: whether the residual's
 * standard deviations cover the errors (innovation), and how large the errors of several weights
 * are (watch). */
#include "br_internal.h"

/* The state that this output changes most. */
static int most_changed(const br_stage *stage, int output) {
    int most = 0;
    for (int i = 1; i < BR_NX; ++i)
        if (fabs(stage->in_e[i][output]) > fabs(stage->in_e[most][output])) most = i;
    return most;
}

/* --- innovation: the residual's standard deviations against what the car does: where errors from
 * one measured state to the next are larger than these say, they are widened.
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
        const int i = most_changed(&mpc->stage[0], j);
        const double share = fabs(mpc->stage[0].in_e[i][j]) * stages;
        if (!(share > 0 && variance[j] > 0)) continue; /* nothing is known of this output */
        const double error = fabs(due->x_next[i] - predicted[i]) / share;
        const double expected = fmax(variance[j], due->noise.corrected[i] / (share * share));
        const double sigmas = fmin(error / sqrt(expected), LARGEST);
        misfit->recent[j] += fmin(stages / RECENT, 1) * (sigmas - misfit->recent[j]);
        misfit->held[j] = fmax(misfit->recent[j], misfit->held[j] * fmax(1 - stages / HELD, 0));
    }
}

/* --- watch: the newest samples of what the car did, and the errors that the weights in use, the
 * proven ones, and the model without correction make on them.
 *
 * A sample is what a Gaussian process learns from: features, and the residual of the nominal model,
 * per stage. The preparation makes it of the newest transition given to br_mpc_observe, and
 * compares the weights on it: on the newest sample first, then on older ones, also from before the
 * weights came into use; on a few at a time, so that it takes some microseconds at most. Where
 * states are estimated, a residual has the variance by which the estimated step differs from the
 * car's; br_mpc_get_watch takes it off the square of the error, and a sample counts less the larger
 * it is beside the errors that do not count. */

#define AT_ONCE 4   /* samples that one preparation judges */
#define NEAR_BY 0.5 /* of a stage by which a sample's duration may differ from it */

/* Features and residual of the newest transition; 0 if it tells nothing of an output. */
static int sample_of(const br_mpc *mpc, const br_transition *seen, br_sample *sample) {
    const double stages = seen->duration / BR_TS;
    double nominal[BR_NX];
    if (fabs(stages - 1) > NEAR_BY) return 0;
    if (br_predict_by(mpc, NULL, seen->x, seen->u, seen->duration, nominal)) return 0;
    br_stage_features(seen->x, seen->u, sample->z);
    for (int j = 0; j < BR_NE; ++j) {
        const int i = most_changed(&mpc->stage[0], j);
        const double share = mpc->stage[0].in_e[i][j] * stages;
        if (share == 0) return 0; /* before the first linearisation */
        sample->residual[j] = (seen->x_next[i] - nominal[i]) / share;
        sample->noise[j] = seen->noise.step[i] / (share * share);
    }
    return br_all_finite(sample->residual, BR_NE);
}

static void judge(br_mpc *mpc, const br_sample *sample, br_judged *judged) {
    const int of[2] = {mpc->gp_in_use, mpc->gp_proven};
    for (int which = 0; which < 2; ++which) {
        const br_gp *gp = &mpc->gp[of[which]];
        double mean[BR_NE] = {0};
        if (gp->any) br_gp_mean(gp, sample->z, mean);
        for (int j = 0; j < BR_NE; ++j) judged->error[which][j] = sample->residual[j] - mean[j];
    }
}

void br_watch_update(br_mpc *mpc) {
    br_watch *watch = &mpc->watch;
    if (watch->newest.duration > 0) {
        br_sample *sample = &watch->sample[watch->count % BR_SAMPLES];
        watch->count += sample_of(mpc, &watch->newest, sample);
        watch->newest.duration = 0;
    }
    if (mpc->gp_in_use == mpc->gp_proven) return;
    const int64_t oldest = watch->count > BR_WATCHED ? watch->count - BR_WATCHED : 0;
    int left = AT_ONCE;
    for (int64_t k = watch->count - 1; k >= oldest && left; --k) {
        br_judged *judged = &watch->judged[k % BR_WATCHED];
        if (judged->number == k + 1) continue;
        judge(mpc, &watch->sample[k % BR_SAMPLES], judged);
        judged->number = k + 1;
        left -= 1;
    }
}
