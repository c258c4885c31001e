/* Time within one call, by the clock that the host gave. */
#include <math.h>

#include "br_internal.h"

/* 0 without a clock; its time is measured with and without a budget, so that br_mpc_prepare knows
 * what an iteration takes. */
double br_timer_now(const br_timer *timer) {
    return timer->clock ? timer->clock(timer->context) : 0;
}

void br_timer_start(br_timer *timer, double budget) {
    timer->limited = timer->clock && budget > 0;
    timer->deadline = timer->limited ? br_timer_now(timer) + budget : 0;
}

/* Whether what takes that long fits; a clock that gives NaN never lets anything begin. */
int br_timer_allows(const br_timer *timer, double now, double duration) {
    return !timer->limited || timer->deadline - now >= duration;
}

void br_timer_note(const br_timer *timer, double begin, double *longest) {
    *longest = fmax(*longest, br_timer_now(timer) - begin);
}
