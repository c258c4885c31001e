/* Trial of weights on probation: whether they are worse than the proven ones, by what the watch
 * (br_watch.c) has found on the newest samples of what the car did. */

#include "br_internal.h"

#define MOST_FALLEN_BACK 0.8 /* share of cycles without a solution; no car drives by so few */
#define LARGEST 1e12         /* errors that are larger count as this large */

void br_mpc_observe_trial(br_mpc_trial *trial, double vx_mps, int fallen_back) {
    if (!trial) return;
    trial->fastest_mps = fmax(trial->fastest_mps, vx_mps);
    if (fallen_back < 0) return;
    trial->cycles += 1;
    trial->fallen_back += fallen_back;
}

/* Whether one set of weights predicts any output worse than another does. The excess over a whole
 * window is what counts: fewer samples must be worse by as much in all. */
static int worse(const br_mpc_probation *of, const br_mpc_watch *found, const double *one,
                 const double *other) {
    const double few = fmax((double)BR_WATCHED / fmax(found->samples, 1), 1);
    for (int j = 0; j < BR_NE; ++j) {
        const double error = fmin(one[j], LARGEST);
        const double allowed = of->worse_factor * fmin(other[j], LARGEST) +
                               of->worse_share * fmin(found->nominal[j], LARGEST);
        if (!(error <= allowed + few * of->resolution[j] && error < LARGEST)) return 1;
    }
    return 0;
}

/* The car goes back only to weights that predict no output worse over the same samples. */
br_mpc_ruling br_mpc_judge_trial(const br_mpc *mpc, const br_mpc_probation *probation,
                                 br_mpc_trial *trial) {
    if (!mpc || !probation || !trial) return BR_WATCH_ON;
    br_mpc_watch *found = &trial->found;
    const int slowed = trial->limit_mps > 0;
    br_mpc_get_watch(mpc, probation->resolution, found);
    if (trial->cycles >= probation->watch_cycles &&
        (double)trial->fallen_back > MOST_FALLEN_BACK * (double)trial->cycles)
        return BR_HOPELESS;
    const double judged = found->fresh + found->samples; /* rises with each sample judged */
    if (judged == trial->judged || found->samples < probation->watch_least) return BR_WATCH_ON;
    trial->judged = judged;
    if (slowed && found->fresh - trial->slowed_after < BR_WATCHED) return BR_WATCH_ON;
    if (!worse(probation, found, found->in_use, found->proven))
        return found->fresh >= probation->watch_samples && !slowed ? BR_PROVEN : BR_WATCH_ON;
    if (!worse(probation, found, found->proven, found->in_use)) return BR_BACK;
    if (slowed) return BR_WATCH_ON;
    trial->slowed_after = found->fresh;
    trial->limit_mps = fmax(probation->slow_share * trial->fastest_mps, probation->slow_least_mps);
    return BR_SLOW;
}
