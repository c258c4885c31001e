/* Braking along the line: how a car that slows down to standstill is steered, whatever went wrong.
 *
 * Pure pursuit in the frame of the line (Coulter, "Implementation of the pure pursuit path tracking
 * algorithm", 1992), as the training drive has it (controller/pure_pursuit.py): the car steers as
 * the line bends, and on the circle through a point ahead that takes it back. A car that is slower
 * than the line has room to spare, so it is drawn to the middle of the track. All numbers
 * (BR_BRAKING_...) are the car's, from its file. */
#include <math.h>

#include "br_internal.h"

#if BR_HAS_PATH

br_mpc_error br_steer(const br_mpc *mpc, const double x[BR_NX], double *s_m, double *angle_rad,
                      double *outside_m) {
    if (!x || !s_m || !angle_rad || !outside_m) return BR_ERROR_NULL;
    if (!mpc->has_parameters || !mpc->path.ready) return BR_ERROR_NOT_READY;
    if (!br_plausible_state(x)) return BR_ERROR_STATE;
    const br_mpc_parameters *p = &mpc->parameters;
    const double vx = fmax(x[BR_INDEX_VX], 0), vy = x[BR_INDEX_VY];
    br_beside here;
    br_path_beside(&mpc->path, x, s_m, &here);
    *outside_m = here.outside_m;

    const double share = vx / here.speed_mps;
    const double middle = BR_BRAKING_CENTRE * fmax(1 - share * share, 0) * here.middle_m;
    const double reach = BR_BRAKING_LOOKAHEAD_M + BR_BRAKING_LOOKAHEAD_S * vx;
    const double sideways = asin(fmin(fmax((here.left_m - middle) / reach, -1), 1));
    const double heading = br_path_heading(&mpc->path, *s_m);
    const double course = x[BR_INDEX_PSI] + atan2(vy, fmax(vx, BR_BRAKING_SLOW_MPS)) - heading;
    const double back = 2 * sin(remainder(-sideways - course, 2 * M_PI)) / reach;
    const double kappa = br_path_curvature(&mpc->path, *s_m + vx * BR_BRAKING_PREVIEW_S) + back;
    const double excess = x[BR_INDEX_OMEGA] - vx * br_path_curvature(&mpc->path, *s_m);
    const double angle = atan(BR_WHEELBASE_M * kappa) +
                         BR_BRAKING_UNDERSTEER_S2PM * kappa * vx * vx -
                         BR_BRAKING_DAMPING_S * excess;
    *angle_rad = fmin(fmax(angle, -p->delta_max_rad), p->delta_max_rad);
    return BR_OK;
}

#endif
