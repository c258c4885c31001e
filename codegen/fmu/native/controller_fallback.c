/* See controller_fallback.h. */
#include <math.h>
#include <string.h>

#include "controller_fallback.h"

/* Unlike fmin and fmax, which drop a NaN, this passes it on: no caller has one. */
static double clipped(double value, double low, double high) {
    if (value < low) return low;
    return value > high ? high : value;
}

static void limited(const fallback_settings *s, const double u[BR_NU], double safe[BR_NU]) {
    safe[0] = clipped(u[0], s->d_min, s->d_max);
    safe[1] = clipped(u[1], -s->delta_rate_max_radps, s->delta_rate_max_radps);
}

static int usable(const fallback_settings *s, const double u[BR_NU]) {
    if (!isfinite(u[0]) || !isfinite(u[1])) return 0;
    double safe[BR_NU];
    limited(s, u, safe);
    return fabs(u[0] - safe[0]) <= s->tolerance && fabs(u[1] - safe[1]) <= s->tolerance;
}

static void keep(fallback *state, const double plan[BR_N][BR_NU], double time_s) {
    state->rows = BR_N;
    for (int k = 0; k < BR_N; ++k)
        if (!isfinite(plan[k][0]) || !isfinite(plan[k][1])) state->rows = 0;
    memcpy(state->plan, plan, sizeof state->plan);
    state->plan_s = time_s;
}

/* Row of the plan that is due; BR_N: none any more. */
static int row_due(const fallback *state, double time_s) {
    const double row = (time_s - state->plan_s) / BR_TS + 1e-6;
    return row < 0 ? 0 : row >= BR_N ? BR_N : (int)row;
}

static double brake(const fallback_settings *s, double vx_mps) {
    return isfinite(vx_mps) ? s->d_min * clipped(vx_mps / s->brake_fade_mps, 0, 1) : 0;
}

static int braking(const fallback *state, const fallback_settings *s, double vx_mps, double time_s,
                   double u[BR_NU]) {
    u[0] = brake(s, vx_mps);
    u[1] = 0;
    if (!(vx_mps > s->brake_fade_mps)) return LEVEL_STOP;
    const int row = row_due(state, time_s);
    if (row < state->rows)
        u[1] = clipped(state->plan[row][1], -s->delta_rate_max_radps, s->delta_rate_max_radps);
    return LEVEL_BRAKE;
}

static int step_down(const fallback *state, const fallback_settings *s, double vx_mps,
                     double time_s, double u[BR_NU]) {
    const int row = row_due(state, time_s);
    const int recent = time_s - state->plan_s <= s->shifted_s + 1e-6;
    if (!recent || row >= state->rows || state->to_recover)
        return braking(state, s, vx_mps, time_s, u);
    limited(s, state->plan[row], u);
    return LEVEL_SHIFTED_PLAN;
}

int fallback_decide(fallback *state, const fallback_settings *s, const double plan[BR_N][BR_NU],
                    double vx_mps, double time_s, double u[BR_NU]) {
    if (!plan || !usable(s, plan[0])) {
        const int level = step_down(state, s, vx_mps, time_s, u);
        if (level >= LEVEL_BRAKE) state->to_recover = s->recover_cycles;
        return level;
    }
    keep(state, plan, time_s); /* only what was fit to be driven is */
    if (state->to_recover > 1 && vx_mps > s->brake_fade_mps) { /* a standing car is not jerked */
        state->to_recover -= 1;
        return braking(state, s, vx_mps, time_s, u);
    }
    state->to_recover = 0;
    limited(s, plan[0], u);
    return LEVEL_SOLUTION;
}
