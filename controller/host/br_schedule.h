/* Release times of a fixed-rate loop, locked in phase to the arrival of the states: the same rules
 * as controller/schedule.py, which says why. Times are those of the monotonic clock [ns]. */
#ifndef BR_SCHEDULE_H
#define BR_SCHEDULE_H

#include <stdint.h>

#define BR_WINDOW 512 /* smallest offsets of a second at the highest rate, 500 Hz */

typedef struct {
    int64_t period_ns;
    int64_t release_ns; /* the next one; its deadline is the one after it */
    int64_t offset_ns;  /* from plant time to arrival: the smallest of the last second */
    int lost;           /* states in a row that have come far from their release */
    int first, count;   /* candidates for the smallest, in order of time, each below the next */
    int64_t at_ns[BR_WINDOW], value_ns[BR_WINDOW];
} br_schedule;

void br_schedule_start(br_schedule *schedule, int64_t release_ns);

/* On to the next release whose deadline has not passed; how many were passed over. */
int64_t br_schedule_advance(br_schedule *schedule, int64_t now_ns);

/* A state of that plant time has arrived; two are interval_s apart (0: not known). */
void br_schedule_observe(br_schedule *schedule, int64_t arrival_ns, double time_s,
                         double interval_s);

/* Plant time whose state would have arrived by then, had nothing held it up. */
double br_schedule_plant_time_s(const br_schedule *schedule, int64_t at_ns);

/* How many states newer than that of time_s are due by the release. */
int br_schedule_missing(const br_schedule *schedule, double time_s, double interval_s);

/* Until when the state that is due at the release is waited for. */
int64_t br_schedule_window_end_ns(const br_schedule *schedule);

#endif
