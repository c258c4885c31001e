/* Turning round: what the planner does where the car is slow and points away from its line.
 *
 * A horizon is too short for a turn to pay: whichever way the car sets off, it first gets farther
 * from the reference, and the optimal plan is to stand still for ever. So the reference runs
 * along the turn itself: where the corrected model goes when it steers to one side at a walking
 * pace until it faces the line again. The track's edges do not count on the way; the car may
 * have been across one already, and its turning circle can be wider than the track. All numbers
 * (BR_TURN_...) are the car's, from its file.
 */
#include <math.h>

#include "br_internal.h"

#if BR_HAS_PATH

/* A reward of progress along the line leads a car back that points aside, but not one that points
 * the other way. */
#define BEGIN_RAD (BR_FOLLOWS_PLAN ? BR_TURN_BEHIND_RAD : BR_TURN_AWAY_RAD)

/* Angle to the point, seen from the car; positive left. */
static double bearing(const double x[BR_NX], const double to[2]) {
    return remainder(atan2(to[1] - x[BR_INDEX_Y], to[0] - x[BR_INDEX_X]) - x[BR_INDEX_PSI],
                     2 * M_PI);
}

/* The side to turn to: the nearer one, or, with the line behind, the one with more room. */
static double side(const double x[BR_NX], double away, const br_mpc_reference *here) {
    if (fabs(away) < BR_TURN_BEHIND_RAD) return copysign(1, away);
    const double along = here->normal_x * x[BR_INDEX_X] + here->normal_y * x[BR_INDEX_Y];
    const double room_left = here->upper - along, room_right = along - here->lower;
    const double facing =
        here->normal_x * -sin(x[BR_INDEX_PSI]) + here->normal_y * cos(x[BR_INDEX_PSI]);
    return copysign(1, (room_left - room_right) * facing);
}

/* Angle still to be turned by; below zero where the car has turned too far, by a quarter at most.
 */
static double remaining(double turn, double away) {
    const double angle = turn * away;
    return angle < -M_PI / 2 ? angle + 2 * M_PI : angle;
}

/* The same angle for a car that follows the line: in a tight bend the point is far to one side, and
 * no turn is needed. */
static double bearing_on_line(const br_path *path, const double to[2]) {
    double here[BR_NX] = {0}, next[2];
    br_path_ahead(path, 0, here);
    br_path_ahead(path, BR_TURN_TANGENT_M, next);
    here[BR_INDEX_PSI] = atan2(next[1] - here[1], next[0] - here[0]);
    return bearing(here, to);
}

/* Begins, goes on with and ends a turn, of a slow or turning car. */
static void decide(br_mpc *mpc, const double target[2]) {
    const double *x = mpc->x0, away = bearing(x, target), speed = fabs(x[BR_INDEX_VX]);
    if (mpc->path.speed_limit < BR_TURN_STOP_MPS || speed > BR_TURN_TOO_FAST_MPS) {
        mpc->turn = 0;
    } else if (mpc->turn) {
        if (remaining(mpc->turn, away) < BR_TURN_FACED_RAD) mpc->turn = 0;
    } else if (fabs(away) > BEGIN_RAD &&
               fabs(remainder(away - bearing_on_line(&mpc->path, target), 2 * M_PI)) > BEGIN_RAD) {
        mpc->turn = side(x, away, &mpc->reference[0]);
        mpc->warm = 0;
    }
}

void br_turnaround(br_mpc *mpc) {
    double target[2], x[BR_NX], next[BR_NX];
    if (!mpc->turn && fabs(mpc->x0[BR_INDEX_VX]) >= BR_TURN_SLOW_MPS) return;
    br_path_ahead(&mpc->path, BR_TURN_AHEAD_M, target);
    decide(mpc, target);
    if (!mpc->turn) return;
    const br_mpc_parameters *p = &mpc->parameters;
    const double pace = fmin(BR_TURN_PACE_MPS, mpc->path.speed_limit);
    memcpy(x, mpc->x0, sizeof x);
    for (int k = 0; k < BR_N; ++k) {
        const double angle = remaining(mpc->turn, bearing(x, target));
        const double steering = mpc->turn * fmax(fmin(angle, p->delta_max_rad), -p->delta_max_rad);
        const double rate = (steering - x[BR_INDEX_DELTA]) / BR_TS;
        double *u = mpc->turn_u[k];
        u[BR_INDEX_DUTY] = fmin(fmax(BR_TURN_THROTTLE_SPM * (pace - x[BR_INDEX_VX]), 0), p->d_max);
        u[BR_INDEX_DELTA_RATE] =
            fmin(fmax(rate, -p->delta_rate_max_radps), p->delta_rate_max_radps);
        br_stage_advance(&mpc->gp[mpc->gp_in_use], x, u, BR_TS, next);
        memcpy(x, next, sizeof x);
        br_mpc_reference *reference = &mpc->reference[k];
        reference->x = x[BR_INDEX_X];
        reference->y = x[BR_INDEX_Y];
        reference->lower -= BR_TURN_WIDER_M;
        reference->upper += BR_TURN_WIDER_M;
    }
}

#endif
