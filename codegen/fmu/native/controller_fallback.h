/* What is sent when there is no solution to send: controller/fallback.py in C, tested against it.
 *
 * Level 0 the solution; 1 the previous plan, shifted, for a bounded time; 2 braking along the
 * plan's steering; 3 standing still. From level 1 the next usable solution leads back, from 2
 * several in a row; a standing car drives the next.
 */
#ifndef CONTROLLER_FALLBACK_H
#define CONTROLLER_FALLBACK_H

#include "bayesrace_mpc.h"

enum { LEVEL_SOLUTION = 0, LEVEL_SHIFTED_PLAN = 1, LEVEL_BRAKE = 2, LEVEL_STOP = 3 };

typedef struct {
    double d_min, d_max, delta_rate_max_radps;
    double shifted_s;      /* how long after its first input a plan may be driven */
    double tolerance;      /* excess over a limit that is clipped, not refused */
    double brake_fade_mps; /* speed below which braking fades to none at standstill */
    int recover_cycles;    /* usable solutions in a row that end braking */
} fallback_settings;

/* Zeroed memory is a fallback without a plan. */
typedef struct {
    int rows; /* of the plan; 0: none */
    int to_recover;
    double plan_s; /* when its first row began to act */
    double plan[BR_N][BR_NU];
} fallback;

/* The input u that acts from time_s on, and its level. plan: of a step with a usable status, whose
 * first row is the solution, else NULL. u is always finite and within the limits. */
int fallback_decide(fallback *state, const fallback_settings *settings,
                    const double plan[BR_N][BR_NU], double vx_mps, double time_s,
                    double u[BR_NU]);

#endif
