/* Where the car will be: the corrected model over any duration, also over part of a stage. */
#include <math.h>

#include "br_internal.h"

#define PART_MIN 1e-9 /* a remainder below this part of a stage is rounding */

/* The nearest rate within its limit that leaves the angle within its own at the end. */
static double steerable(const br_mpc_parameters *p, double rate, double delta, double duration) {
    const double lowest = (-p->delta_max_rad - delta) / duration;
    const double highest = (p->delta_max_rad - delta) / duration;
    rate = fmin(fmax(rate, lowest), highest);
    return fmin(fmax(rate, -p->delta_rate_max_radps), p->delta_rate_max_radps);
}

/* x <- the state after a duration of at most a stage. */
static void advance(const br_mpc *mpc, double x[BR_NX], const double u[BR_NU], double duration) {
    static const double none[BR_NX] = {0};
    const br_mpc_parameters *p = &mpc->parameters;
    const br_gp *gp = &mpc->gp[mpc->gp_in_use];
    const double acting[BR_NU] = {fmin(fmax(u[0], p->d_min), p->d_max),
                                  steerable(p, u[1], x[6], duration)};
    if (duration == BR_TS) {
        br_stage stage;
        br_stage_linearise(gp, x, acting, none, &stage);
        memcpy(x, stage.f, sizeof stage.f);
    } else {
        double x_next[BR_NX];
        br_stage_advance(gp, x, acting, duration, x_next);
        memcpy(x, x_next, sizeof x_next);
    }
    x[6] = fmin(fmax(x[6], -p->delta_max_rad), p->delta_max_rad);
}

br_mpc_error br_mpc_predict(const br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                            double duration_s, double x_next[BR_NX]) {
    if (!mpc || !x || !u || !x_next) return BR_ERROR_NULL;
    if (!mpc->has_parameters) return BR_ERROR_NOT_READY;
    if (!(duration_s >= 0 && duration_s <= BR_PREDICT_MAX_S)) return BR_ERROR_TIME;
    if (!br_plausible_state(x) || !br_all_finite(u, BR_NU)) return BR_ERROR_STATE;
    double state[BR_NX];
    memcpy(state, x, sizeof state);
    double left = duration_s;
    for (; left >= BR_TS * (1 - PART_MIN); left -= BR_TS) {
        advance(mpc, state, u, BR_TS);
        if (!br_plausible_state(state)) return BR_ERROR_STATE;
    }
    if (left > BR_TS * PART_MIN) advance(mpc, state, u, left);
    if (!br_plausible_state(state)) return BR_ERROR_STATE;
    memcpy(x_next, state, sizeof state);
    return BR_OK;
}
