/* The braking plan: what the car's guard does if nothing more comes from the controller.
 *
 * The corrected model is rolled out from the moment at which the newest input begins to act: along
 * the plan for as long as the fallback would drive on it, so that a message that is lost or late
 * costs nothing, then braking along the line to standstill. Where that leads off the track it
 * brakes sooner. */
#include <math.h>
#include <string.h>

#include "br_cycle.h"

#if BR_HAS_PATH

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
            br_fallback_plan(from->fallback, settings, from->time_s + row * BR_TS, u);
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
