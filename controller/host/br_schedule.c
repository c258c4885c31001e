/* See br_schedule.h. */
#include <math.h>

#include "br_schedule.h"

#define WINDOW_NS 1000000000
#define GAIN 0.1   /* of the phase lock */
#define SLEW 0.005 /* largest correction of a release, as a share of the period */
#define LOST 0.25  /* error of the phase from which the lock is taken anew, ... */
#define LOST_FOR 5 /* ... after so many states in a row */
#define GRACE 0.25 /* how long after its release a state is waited for */
#define WHOLE 0.02 /* how far the periods' ratio may be from a whole number */

void br_schedule_start(br_schedule *schedule, int64_t release_ns) {
    schedule->release_ns = release_ns;
    schedule->lost = schedule->count = 0;
}

int64_t br_schedule_advance(br_schedule *schedule, int64_t now_ns) {
    schedule->release_ns += schedule->period_ns;
    const int64_t late_ns = now_ns - schedule->release_ns - schedule->period_ns;
    const int64_t skipped = late_ns >= 0 ? late_ns / schedule->period_ns + 1 : 0;
    schedule->release_ns += skipped * schedule->period_ns;
    return skipped;
}

/* The smallest value of the window, with the new one. Of a flood the oldest candidate goes. */
static int64_t smallest(br_schedule *schedule, int64_t at_ns, int64_t value_ns) {
    while (schedule->count) {
        const int last = (schedule->first + schedule->count - 1) % BR_WINDOW;
        if (schedule->value_ns[last] < value_ns) break;
        schedule->count -= 1;
    }
    while (schedule->count &&
           (schedule->count == BR_WINDOW || schedule->at_ns[schedule->first] < at_ns - WINDOW_NS)) {
        schedule->first = (schedule->first + 1) % BR_WINDOW;
        schedule->count -= 1;
    }
    const int next = (schedule->first + schedule->count) % BR_WINDOW;
    schedule->at_ns[next] = at_ns;
    schedule->value_ns[next] = value_ns;
    schedule->count += 1;
    return schedule->value_ns[schedule->first];
}

/* Whether one period is a whole multiple of the other: else there is no phase to keep. */
static int lockable(const br_schedule *schedule, double interval_ns) {
    if (!(interval_ns > 0)) return 0;
    const double period_ns = (double)schedule->period_ns;
    const double ratio = fmax(interval_ns, period_ns) / fmin(interval_ns, period_ns);
    return fabs(ratio - rint(ratio)) <= WHOLE;
}

void br_schedule_observe(br_schedule *schedule, int64_t arrival_ns, double time_s,
                         double interval_s) {
    const int64_t time_ns = llrint(time_s * 1e9);
    schedule->offset_ns = smallest(schedule, arrival_ns, arrival_ns - time_ns);
    if (!lockable(schedule, interval_s * 1e9)) return;
    const double grid_ns = fmin((double)schedule->period_ns, interval_s * 1e9);
    const double earliest_ns = (double)(schedule->offset_ns + time_ns - schedule->release_ns);
    const double error_ns = remainder(earliest_ns, grid_ns);
    if (fabs(error_ns) > LOST * grid_ns) {
        if (++schedule->lost >= LOST_FOR) {
            schedule->release_ns += llrint(error_ns);
            schedule->lost = 0;
            return;
        }
    } else {
        schedule->lost = 0;
    }
    const double limit_ns = SLEW * grid_ns;
    schedule->release_ns += llrint(fmin(fmax(GAIN * error_ns, -limit_ns), limit_ns));
}

double br_schedule_plant_time_s(const br_schedule *schedule, int64_t at_ns) {
    return (double)(at_ns - schedule->offset_ns) * 1e-9;
}

int br_schedule_missing(const br_schedule *schedule, double time_s, double interval_s) {
    const double period_s = (double)schedule->period_ns * 1e-9;
    if (!(interval_s > 0)) interval_s = period_s;
    const double since_s = br_schedule_plant_time_s(schedule, schedule->release_ns) - time_s;
    if (fabs(remainder(since_s, interval_s)) >= period_s / 2) return 0; /* none at this release */
    const double due = (since_s + GRACE * period_s) / fmax(interval_s, period_s);
    return due > 0 ? (int)fmin(due, 1e6) : 0;
}

int64_t br_schedule_window_end_ns(const br_schedule *schedule) {
    return schedule->release_ns + llrint(GRACE * (double)schedule->period_ns);
}
