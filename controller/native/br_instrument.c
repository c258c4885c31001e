/* Whether what an instrument reports can be believed.
 *
 * A measurement speaks against its instrument if the gate refuses it, if it is equal to the one
 * before to the bit though what it measures has changed, or if it is not of the time that is kept.
 * Five in a row make the instrument faulty, and so does silence. What a faulty one measures is left
 * out, and compared all the same: three in a row that agree end that. A single wrong measurement is
 * refused and changes nothing.
 */
#include "br_estimator.h"

#include <math.h>
#include <string.h>

#if BR_HAS_PATH

#define AGAINST 5      /* in a row */
#define AGREEING 3     /* in a row */
#define MOVED 4.0      /* standard deviations by which what is measured has changed for certain */
#define INTERVALS 5.0  /* of silence, ... */
#define SILENT_S 0.15  /* ... and at least so long: motion capture has gaps of 100 ms */
#define USUAL 2.0      /* intervals between two that are used, one of which may be lost or wrong */
#define NEAR 0.5       /* share of the bounds on contradictions of measured states (br_state.c) */
#define FARTHEST 3.0   /* of that on positions */
#define FORGETTING 0.1 /* of the mean interval, by each one */

void br_instrument_arrive(br_instrument *instrument, const br_measurement *m, double time_s) {
    const double since_s = m->time_s - instrument->measured_s;
    double *interval_s = &instrument->interval_s;
    if (instrument->seen && since_s > 0) {
        if (*interval_s == 0) *interval_s = since_s;
        *interval_s += FORGETTING * (fmin(since_s, INTERVALS * *interval_s) - *interval_s);
    }
    if (!instrument->seen || since_s > 0) instrument->measured_s = m->time_s;
    instrument->seen = 1;
    instrument->arrived_s = time_s;
}

int br_instrument_holds(const br_instrument *instrument, const br_measurement *m) {
    const br_measurement *held = &instrument->held;
    return held->count == m->count && !memcmp(held->of, m->of, (size_t)m->count * sizeof *m->of) &&
           !memcmp(held->value, m->value, (size_t)m->count * sizeof *m->value);
}

int br_instrument_repeats(br_instrument *instrument, const br_measurement *m,
                          const br_estimate *b) {
    const int n = m->count;
    if (br_instrument_holds(instrument, m)) {
        double *moved = &instrument->held_moved;
        for (int a = 0; a < n; ++a) {
            const double now = br_estimate_observed(b->x, m->of[a]);
            *moved = fmax(*moved, fabs(now - instrument->held_expected[a]) / m->deviation[a]);
        }
        instrument->repeated += *moved > 1;
        if (instrument->repeated < AGAINST + 2 * instrument->longest) return *moved > MOVED;
        instrument->bad_in_row = AGAINST - 1; /* never so often before: no rounding */
        return 1;
    }
    if (!instrument->fault && instrument->repeated > instrument->longest)
        instrument->longest = instrument->repeated;
    instrument->held_moved = instrument->repeated = 0;
    instrument->held = *m;
    for (int a = 0; a < n; ++a) instrument->held_expected[a] = br_estimate_observed(b->x, m->of[a]);
    return 0;
}

static double difference(const br_measurement *m, int a, const br_estimate *b) {
    const double off = m->value[a] - br_estimate_observed(b->x, m->of[a]);
    return m->of[a] == BR_INDEX_PSI ? remainder(off, 2 * M_PI) : off;
}

static br_fault kind_of(int state) {
    if (state == BR_INDEX_X || state == BR_INDEX_Y) return BR_FAULT_POSITION;
    if (state == BR_INDEX_PSI) return BR_FAULT_HEADING;
    if (state == BR_INDEX_OMEGA) return BR_FAULT_YAW_RATE;
    return state == BR_INDEX_DELTA ? BR_FAULT_STEERING : BR_FAULT_VELOCITY;
}

/* What a model may err in a state by while nothing is measured for so long: its accelerations are
 * wrong by the largest, as in a slide beyond what its weights have seen. */
static double erring(br_fault kind, double blind_s) {
    const int turns = kind == BR_FAULT_HEADING || kind == BR_FAULT_YAW_RATE;
    const double along = BR_MONITOR_ACCELERATION_MPS2, about = BR_MONITOR_YAW_ACCELERATION_RADPS2;
    const double velocity = (turns ? about : along) * blind_s;
    if (kind == BR_FAULT_STEERING) return 0;
    return kind == BR_FAULT_POSITION || kind == BR_FAULT_HEADING ? velocity * blind_s / 2
                                                                 : velocity;
}

int br_instrument_near(const br_instrument *instrument, const br_measurement *m,
                       const br_estimate *b) {
    static const double bounds[] = {[BR_FAULT_POSITION] = BR_MONITOR_POSITION_M,
                                    [BR_FAULT_HEADING] = BR_MONITOR_HEADING_RAD,
                                    [BR_FAULT_VELOCITY] = BR_MONITOR_SPEED_MPS,
                                    [BR_FAULT_YAW_RATE] = BR_MONITOR_YAW_RATE_RADPS,
                                    [BR_FAULT_STEERING] = BR_MONITOR_STEERING_RAD};
    const double since_s = instrument->refused_s - instrument->passed_s;
    const double blind_s = fmax(since_s - USUAL * instrument->interval_s, 0);
    for (int a = 0; a < m->count; ++a) {
        const br_fault kind = kind_of(m->of[a]);
        const double most = NEAR * bounds[kind] + erring(kind, blind_s) + 3 * m->deviation[a];
        if (!(fabs(difference(m, a, b)) <= most)) return 0;
    }
    return 1;
}

int br_instrument_possible(const br_measurement *m, const br_estimate *b) {
    for (int a = 0; a < m->count; ++a) {
        const double most_m = FARTHEST * BR_MONITOR_POSITION_M + 3 * m->deviation[a];
        if (kind_of(m->of[a]) == BR_FAULT_POSITION && !(fabs(difference(m, a, b)) <= most_m))
            return 0;
    }
    return 1;
}

br_fault br_instrument_kind(const br_measurement *m, const br_estimate *b) {
    double most = -1;
    int which = m->of[0];
    for (int a = 0; a < m->count; ++a) {
        const int i = m->of[a];
        const double off = difference(m, a, b);
        const double squared = off * off / (b->p[i][i] + m->deviation[a] * m->deviation[a]);
        if (!(squared > most)) continue;
        most = squared;
        which = i;
    }
    return kind_of(which);
}

int br_instrument_contradicts(int fault) {
    return fault != BR_FAULT_NONE && fault != BR_FAULT_FROZEN && fault != BR_FAULT_TIME;
}

void br_instrument_bad(br_instrument *instrument, br_fault kind) {
    if (instrument->fault &&
        br_instrument_contradicts(instrument->fault) != br_instrument_contradicts(kind) &&
        instrument->bad_in_row >= AGAINST)
        instrument->bad_in_row = 0; /* another fault than that which is known */
    instrument->good_in_row = 0;
    instrument->bad_in_row += instrument->bad_in_row < AGAINST;
    if (instrument->bad_in_row == AGAINST) instrument->fault = kind;
}

int br_instrument_good(br_instrument *instrument, int latched) {
    instrument->bad_in_row = 0;
    instrument->good_in_row += instrument->good_in_row < AGREEING;
    if (!latched && instrument->good_in_row == AGREEING) instrument->fault = BR_FAULT_NONE;
    return !instrument->fault;
}

void br_instrument_wait(br_instrument *instrument, double time_s) {
    const double longest_s = fmax(INTERVALS * instrument->interval_s, SILENT_S);
    if (!instrument->interval_s || instrument->fault) return;
    if (time_s - instrument->arrived_s <= longest_s) return;
    instrument->fault = BR_FAULT_TIME;
    instrument->good_in_row = 0;
}

void br_instrument_restart(br_instrument *instrument) {
    instrument->fault = BR_FAULT_NONE;
    instrument->refused_in_row = instrument->bad_in_row = instrument->good_in_row = 0;
    instrument->seen = instrument->held.count = 0;
    instrument->interval_s = 0;
}

int br_estimator_faulty(const br_estimator *estimator) {
    for (int i = 0; i < BR_INSTRUMENTS; ++i)
        if (estimator->instrument[i].fault) return i;
    return -1;
}

br_fault br_estimator_blind(const br_estimator *estimator, int *contradicted) {
    br_fault found = BR_FAULT_NONE;
    *contradicted = 0;
    for (int i = 0; i < BR_INSTRUMENTS; ++i) {
        const br_instrument *one = &estimator->instrument[i];
        int positions = 0;
        for (int a = 0; a < one->held.count; ++a)
            positions |= kind_of(one->held.of[a]) == BR_FAULT_POSITION;
        if (!positions) continue;
        if (!one->fault) {
            *contradicted = 0;
            return BR_FAULT_NONE;
        }
        found = (br_fault)one->fault;
        *contradicted |= br_instrument_contradicts(found);
    }
    return found;
}

const char *br_estimator_fault_text(br_fault fault) {
    static const char *const texts[] = {
        [BR_FAULT_NONE] = "what it measures is believed",
        [BR_FAULT_FROZEN] = "it repeats what it said before, though the car moves",
        [BR_FAULT_TIME] = "nothing comes from it, or what is of the future or long ago",
        [BR_FAULT_POSITION] = "the position that it measures contradicts the model and the others",
        [BR_FAULT_HEADING] = "the heading that it measures contradicts the model and the others",
        [BR_FAULT_VELOCITY] = "the velocity that it measures contradicts the model and the others",
        [BR_FAULT_YAW_RATE] = "the yaw rate that it measures contradicts the model and the others",
        [BR_FAULT_STEERING] =
            "the steering angle that it measures contradicts the model and the others",
    };
    const char *text = (unsigned)fault < sizeof texts / sizeof texts[0] ? texts[fault] : NULL;
    return text ? text : "unknown fault";
}

#endif
