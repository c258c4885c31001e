/* A bad solution never reaches the actuators: what is sent instead, step by step down.
 *
 * Level 0 the solution; 1 the previous plan, shifted, for a bounded time; 2 braking along the
 * plan's steering, held when the plan is over; 3 standing still. From level 1 the next usable
 * solution leads back; from 2 several in a row, so that a controller that works every other cycle
 * does not jerk the car. A standing car is not jerked: it drives the next one. Where only the first
 * step after a cold start is usable it would stand for ever. */
#include <math.h>
#include <string.h>

#include "br_cycle.h"

#if BR_HAS_PATH

#define ROUNDING 1e-6 /* of a time, or of a row */
#define SLOWEST 1e-6  /* squared speed by which is divided */

static void limited(const br_driving *s, const double u[BR_NU], double safe[BR_NU]) {
    for (int i = 0; i < BR_NU; ++i) {
        const double low = s->u_low[i], high = s->u_high[i];
        safe[i] = u[i] < low ? low : u[i] > high ? high : u[i];
    }
}

static int usable(const br_driving *s, const double u[BR_NU]) {
    double safe[BR_NU];
    limited(s, u, safe);
    for (int i = 0; i < BR_NU; ++i)
        if (!isfinite(u[i]) || fabs(u[i] - safe[i]) > s->limit_tolerance) return 0;
    return 1;
}

/* Keeps the plan of a solution that may be driven, if all of its numbers are finite. */
static void keep(br_fallback *fallback, const br_solution *solution, double time_s) {
    const int rows = solution->rows < BR_N ? solution->rows : BR_N;
    fallback->rows = rows;
    fallback->plan_s = time_s;
    fallback->row_s = solution->plan_step_s;
    for (int i = 0; i < rows * BR_NU; ++i)
        if (!isfinite(solution->plan_u[i])) fallback->rows = 0;
    memcpy(fallback->plan, solution->plan_u, sizeof fallback->plan);
}

/* Row of the plan that is due; BR_N: none any more. */
static int row_due(const br_fallback *fallback, double time_s) {
    if (!fallback->rows) return 0;
    const double row = (time_s - fallback->plan_s) / fallback->row_s + ROUNDING;
    return !(row > 0) ? 0 : row >= BR_N ? BR_N : (int)row;
}

/* Drive command that brakes: what the car can hold without a controller, fading to none. */
static double braking(const br_driving *s, double vx_mps) {
    const double share = fmin(fmax(vx_mps / s->brake_fade_mps, 0), 1);
    const double held = s->brake_d + s->brake_slow / fmax(vx_mps * vx_mps, SLOWEST);
    return isfinite(vx_mps) ? fmax(s->u_low[BR_INDEX_DUTY], -held) * share : 0;
}

/* Brakes, and steers to an angle within that time. */
void br_fallback_brake_to(const br_driving *s, double vx_mps, double delta_rad, double angle_rad,
                          double duration_s, double u[BR_NU]) {
    u[BR_INDEX_DUTY] = braking(s, vx_mps);
    u[BR_INDEX_DELTA_RATE] = (angle_rad - delta_rad) / duration_s;
    limited(s, u, u);
}

/* The plan's input that is due. */
static void follow_plan(const br_fallback *fallback, const br_driving *s, double time_s,
                        double u[BR_NU]) {
    const int row = row_due(fallback, time_s);
    limited(s, fallback->plan[row < fallback->rows ? row : fallback->rows - 1], u);
}

br_level br_fallback_brake(const br_fallback *fallback, const br_driving *s, double vx_mps,
                           double time_s, double u[BR_NU]) {
    const int row = row_due(fallback, time_s), rolling = vx_mps > s->brake_fade_mps;
    const double nothing[BR_NU] = {0};
    limited(s, rolling && row < fallback->rows ? fallback->plan[row] : nothing, u);
    u[BR_INDEX_DUTY] = braking(s, vx_mps);
    return rolling ? BR_BRAKE : BR_STOP;
}

static br_level step_down(const br_fallback *fallback, const br_driving *s, double vx_mps,
                          double time_s, double u[BR_NU]) {
    const int row = row_due(fallback, time_s);
    const int recent = time_s - fallback->plan_s <= s->shifted_s + ROUNDING;
    if (!recent || row >= fallback->rows || fallback->to_recover)
        return br_fallback_brake(fallback, s, vx_mps, time_s, u);
    limited(s, fallback->plan[row], u);
    return BR_SHIFTED_PLAN;
}

/* The input u that acts late_s after time_s, always finite and within the limits. solution: for one
 * that acts at time_s; NULL: there is none. */
br_level br_fallback_decide(br_fallback *fallback, const br_driving *s, const br_solution *solution,
                            double vx_mps, double time_s, double late_s, double u[BR_NU]) {
    const double acting_s = time_s + late_s;
    if (!solution || !usable(s, solution->u)) {
        const br_level level = step_down(fallback, s, vx_mps, acting_s, u);
        if (level >= BR_BRAKE) fallback->to_recover = s->recover_cycles;
        return level;
    }
    keep(fallback, solution, time_s);
    if (fallback->to_recover > 1 && vx_mps > s->brake_fade_mps) {
        fallback->to_recover -= 1;
        return br_fallback_brake(fallback, s, vx_mps, acting_s, u);
    }
    fallback->to_recover = 0;
    if (row_due(fallback, acting_s) > 0) return step_down(fallback, s, vx_mps, acting_s, u);
    limited(s, solution->u, u);
    return BR_SOLUTION;
}

/* The braking plan: what the car's guard does if nothing more comes from the controller.
 *
 * The corrected model is rolled out from the moment at which the newest input begins to act: along
 * the plan for as long as the fallback would drive on it, so that a message that is lost or late
 * costs nothing, then braking along the line to standstill. Where that leads off the track it
 * brakes sooner. */
/* One roll-out whose first rows are the plan's; how far outside of the track it gets. */
static double roll_out(const br_rollout *from, int first, br_braking *braking) {
    const br_controller *controller = from->controller;
    const br_driving *settings = from->settings;
    double x[BR_NX], s_m = -1, angle = 0, outside_m, worst_m = -INFINITY;
    memcpy(x, from->x, sizeof x);
    braking->rows = 0;
    while (braking->rows < BR_BRAKING_ROWS) {
        const int row = braking->rows;
        const double vx = x[BR_INDEX_VX];
        double u[BR_NU];
        if (row > 0 && row >= first && vx <= settings->brake_fade_mps) break;
        if (row == 0)
            memcpy(u, from->u, sizeof u);
        else if (row < first)
            follow_plan(from->fallback, settings, from->time_s + row * BR_TS, u);
        else
            br_fallback_brake_to(settings, vx, x[BR_INDEX_DELTA], angle, BR_TS, u);
        if (controller->predict(controller->self, x, u, BR_TS, x) ||
            controller->steer(controller->self, x, &s_m, &angle, &outside_m))
            break;
        worst_m = fmax(worst_m, outside_m);
        braking->duty[row] = u[BR_INDEX_DUTY];
        braking->delta_rad[row] = x[BR_INDEX_DELTA];
        braking->rows += 1;
    }
    return worst_m;
}

void br_braking_plan(const br_rollout *from, br_braking *braking) {
    const br_fallback *fallback = from->fallback;
    const double left_s = fallback->plan_s + from->settings->shifted_s - from->time_s;
    int first =
        fallback->rows && !fallback->to_recover ? (int)(left_s / BR_TS + STAGE_ROUNDING) : 0;
    braking->begins_s = from->time_s;
    braking->step_s = BR_TS;
    double outside_m = roll_out(from, first, braking);
    while (outside_m > 0 && first > 1) {
        br_braking sooner = {.begins_s = from->time_s, .step_s = BR_TS};
        const double sooner_m = roll_out(from, first /= 2, &sooner);
        if (sooner_m >= outside_m) continue;
        outside_m = sooner_m;
        *braking = sooner;
    }
}

#endif
