/* Watch: the newest samples of what the car did, and the errors that the weights in use, the
 * proven ones, and the model without correction make on them.
 *
 * A sample is what a Gaussian process learns from: features, and the residual of the nominal model,
 * per stage. The preparation makes it of the newest transition given to br_mpc_observe, and
 * compares the weights on it: on the newest sample first, then on older ones, also from before the
 * weights came into use; on a few at a time, so that it takes some microseconds at most. Where
 * states are estimated, a residual has the variance by which the estimated step differs from the
 * car's; br_mpc_get_watch takes it off the square of the error, and a sample counts less the larger
 * it is beside the errors that do not count. */

#include "br_internal.h"

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
        const int i = BR_CHANGED[j];
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
        double mean[BR_NE] = {};
        if (gp->any) br_gp_mean(gp, sample->z, mean);
        for (int j = 0; j < BR_NE; ++j) judged->error[which][j] = sample->residual[j] - mean[j];
    }
}

void br_watch_update(br_mpc *mpc) {
    if (BR_WEIGHT_BUFFERS == 1) return; /* there is nothing to compare with, or to go back to */
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
