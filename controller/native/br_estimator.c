/* Extended Kalman filter with a history of its events.
 *
 * An event is the end of a period, or a measurement within one. Each keeps what was believed after
 * it, so a measurement that comes late is put where it belongs, and what follows is done over. The
 * covariance is updated in Joseph's form, which keeps it positive in the presence of rounding
 * (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", section
 * 5.2.3 for the filter, 5.4 for the gate).
 */
#include "br_estimator.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#if BR_HAS_PATH

#define BEGINNING 0.25 /* share of the gate until a second pose has agreed with the first */
#define WIDEST 100.0   /* by how much one measurement may widen the covariance */
#define APART_S 0.2    /* between two poses whose difference is a velocity */
#define STEERED 4.0    /* so many times the steering angle's deviation has a car that moves */

/* Chi-squared that one of 1,000 exceeds, by degrees of freedom from 1 on. */
static const double EXCEEDED[] = {10.828, 13.816, 16.266, 18.467, 20.515, 22.458, 24.322};
_Static_assert(sizeof EXCEEDED / sizeof EXCEEDED[0] >= BR_NX, "a bound for each number of values");

size_t br_estimator_memory_size(void) { return sizeof(br_estimator); }

br_mpc_error br_estimator_init(void *memory, size_t size, const br_mpc *mpc, br_estimator **out) {
    if (!memory || !mpc || !out) return BR_ERROR_NULL;
    if (!BR_HAS_ESTIMATOR) return BR_ERROR_LEFT_OUT;
    if (size < sizeof(br_estimator) || (uintptr_t)memory % _Alignof(br_estimator))
        return BR_ERROR_MEMORY;
    br_estimator *estimator = memory;
    memset(estimator, 0, sizeof *estimator);
    for (int i = 0; i < BR_EVENTS; ++i) estimator->order[i] = i;
    estimator->mpc = mpc;
    *out = estimator;
    return BR_OK;
}

br_mpc_error br_estimator_set(br_estimator *estimator, const br_estimation *settings) {
    if (!estimator || !settings) return BR_ERROR_NULL;
    int valid = isfinite(settings->gate) && settings->gate >= 0;
    for (int i = 0; i < BR_NB; ++i)
        valid &= isfinite(settings->start[i]) && settings->start[i] >= 0 &&
                 isfinite(settings->drift[i]) && settings->drift[i] >= 0;
    int walks = 0;
    for (int j = 0; j < BR_NE; ++j) {
        valid &= isfinite(settings->acceleration[j]) && settings->acceleration[j] >= 0;
        walks |= settings->acceleration[j] > 0;
    }
    valid &= isfinite(settings->acceleration_s) && settings->acceleration_s > 0;
    if (walks)
        valid &= isfinite(settings->yaw_lag_s) && settings->yaw_lag_s > 0 &&
                 isfinite(settings->understeer) && settings->understeer >= 0;
    if (!valid) return BR_ERROR_PARAMETERS;
    estimator->settings = *settings;
    estimator->walks = walks;
    estimator->has_settings = 1;
    br_estimator_reset(estimator);
    return BR_OK;
}

void br_estimator_reset(br_estimator *estimator) {
    if (!estimator) return;
    estimator->count = estimator->latched = 0;
    for (int i = 0; i < BR_INSTRUMENTS; ++i) br_instrument_restart(&estimator->instrument[i]);
}

/* --- a measurement --- */

/* The offset that is in what is measured of a state; -1: none. */
static int offset_in(int state) {
    return state == BR_INDEX_OMEGA ? BR_NX : state == BR_INDEX_DELTA ? BR_NX + 1 : -1;
}

/* Column of P H', or row of H P. */
double br_estimate_observed(const double row[BR_NA], int state) {
    const int offset = offset_in(state);
    return row[state] + (offset < 0 ? 0 : row[offset]);
}

/* Lower Cholesky factor in place; 0 if there is none. */
static int factorise(int n, double s[BR_NX][BR_NX]) {
    for (int j = 0; j < n; ++j) {
        for (int i = j; i < n; ++i) {
            double sum = s[i][j];
            for (int l = 0; l < j; ++l) sum -= s[i][l] * s[j][l];
            if (i == j && !(sum > 0)) return 0;
            s[i][j] = i == j ? sqrt(sum) : sum / s[j][j];
        }
    }
    return 1;
}

/* v <- S^-1 v, by the factor. */
static void solve(int n, double s[BR_NX][BR_NX], double v[BR_NX]) {
    for (int i = 0; i < n; ++i) {
        for (int l = 0; l < i; ++l) v[i] -= s[i][l] * v[l];
        v[i] /= s[i][i];
    }
    for (int i = n - 1; i >= 0; --i) {
        for (int l = i + 1; l < n; ++l) v[i] -= s[l][i] * v[l];
        v[i] /= s[i][i];
    }
}

/* P <- (I - K H) P (I - K H)' + K R K' */
static void update(const br_measurement *m, double hp[BR_NX][BR_NA], double k[BR_NA][BR_NX],
                   br_estimate *b) {
    double left[BR_NA][BR_NA];
    for (int i = 0; i < BR_NA; ++i)
        for (int j = 0; j < BR_NA; ++j) {
            left[i][j] = b->p[i][j];
            for (int a = 0; a < m->count; ++a) left[i][j] -= k[i][a] * hp[a][j];
        }
    for (int i = 0; i < BR_NA; ++i)
        for (int j = i; j < BR_NA; ++j) {
            double sum = left[i][j];
            for (int a = 0; a < m->count; ++a)
                sum += k[j][a] * (m->deviation[a] * m->deviation[a] * k[i][a] -
                                  br_estimate_observed(left[i], m->of[a]));
            b->p[i][j] = b->p[j][i] = sum;
        }
}

/* Squared distance of what is new; -1: there is none. */
static double distance(int n, double s[BR_NX][BR_NX], const double fresh[BR_NX]) {
    double weighted[BR_NX], squared = 0;
    if (!factorise(n, s)) return -1;
    memcpy(weighted, fresh, sizeof weighted);
    solve(n, s, weighted);
    for (int a = 0; a < n; ++a) squared += fresh[a] * weighted[a];
    return squared;
}

/* P H' S^-1 and the inverse of S, of its factor. */
static void gains(int n, double s[BR_NX][BR_NX], double hp[BR_NX][BR_NA], double k[BR_NA][BR_NX],
                  double inverse[BR_NX][BR_NX]) {
    for (int i = 0; i < BR_NA; ++i) {
        for (int a = 0; a < n; ++a) k[i][a] = hp[a][i];
        solve(n, s, k[i]);
    }
    for (int a = 0; a < n; ++a) {
        for (int c = 0; c < n; ++c) inverse[a][c] = a == c;
        solve(n, s, inverse[a]);
    }
}

/* What the measurement says beyond what is believed; its squared distance by the covariance of
 * that. -1: refused, and nothing changes. shown: of the mismatch; NULL: not wanted. */
static double take(const br_estimator *estimator, double gate, const br_measurement *m,
                   br_estimate *b, br_mpc_noise *shown) {
    const int n = m->count;
    double hp[BR_NX][BR_NA], s[BR_NX][BR_NX], wide[BR_NX][BR_NX], k[BR_NA][BR_NX];
    double fresh[BR_NX] = {0}, inverse[BR_NX][BR_NX];
    for (int a = 0; a < n; ++a) {
        fresh[a] = m->value[a] - br_estimate_observed(b->x, m->of[a]);
        if (m->of[a] == BR_INDEX_PSI) fresh[a] = remainder(fresh[a], 2 * M_PI);
        for (int i = 0; i < BR_NA; ++i) hp[a][i] = br_estimate_observed(b->p[i], m->of[a]);
    }
    for (int a = 0; a < n; ++a) {
        for (int c = 0; c < n; ++c) s[a][c] = br_estimate_observed(hp[a], m->of[c]);
        s[a][a] += m->deviation[a] * m->deviation[a];
        memcpy(wide[a], s[a], (size_t)n * sizeof s[a][0]);
    }
    br_bias_widen(estimator, m, b, wide);
    const double squared = distance(n, wide, fresh);
    if (!(squared >= 0) || (gate > 0 && squared > gate * EXCEEDED[n - 1])) return -1;
    if (!factorise(n, s)) return -1;
    gains(n, s, hp, k, inverse);
    if (shown) br_bias_learn(estimator, m, b, inverse, fresh, shown);
    for (int i = 0; i < BR_NA; ++i)
        for (int a = 0; a < n; ++a) b->x[i] += k[i][a] * fresh[a];
    br_bias_take(m, k, b);
    update(m, hp, k, b);
    return squared;
}

/* --- events --- */

static int valid(const br_measurement *m) {
    if (!isfinite(m->time_s) || m->instrument < 0 || m->instrument >= BR_INSTRUMENTS ||
        m->count < 1 || m->count > BR_NX)
        return 0;
    unsigned seen = 0;
    for (int a = 0; a < m->count; ++a) {
        if (m->of[a] < 0 || m->of[a] >= BR_NX || (seen >> m->of[a] & 1)) return 0;
        seen |= 1u << m->of[a];
        if (!isfinite(m->value[a]) || !(isfinite(m->deviation[a]) && m->deviation[a] > 0)) return 0;
    }
    return 1;
}

/* Puts an event before the k-th; the oldest one makes room. Returns where it is now. */
static int insert(br_estimator *estimator, int k, const br_event *given) {
    if (estimator->count == BR_EVENTS) {
        const int oldest = estimator->order[0];
        memmove(estimator->order, estimator->order + 1, (BR_EVENTS - 1) * sizeof(int));
        estimator->order[BR_EVENTS - 1] = oldest;
        estimator->count -= 1;
        k -= 1;
    }
    const int free = estimator->order[estimator->count];
    memmove(estimator->order + k + 1, estimator->order + k,
            (size_t)(estimator->count - k) * sizeof(int));
    estimator->order[k] = free;
    estimator->events[free] = *given;
    estimator->count += 1;
    return k;
}

static int of_pose(const br_measurement *m) {
    const unsigned pose = 1u << BR_INDEX_X | 1u << BR_INDEX_Y | 1u << BR_INDEX_PSI;
    unsigned seen = 0;
    for (int a = 0; a < m->count; ++a) seen |= 1u << m->of[a];
    return (seen & pose) == pose;
}

/* The earliest of these that is of position and heading, and is new; NULL: none is. */
static const br_measurement *first_pose(const br_estimator *estimator,
                                        const br_measurement *measurements, int count,
                                        double latest_s) {
    const br_measurement *first = NULL;
    for (const br_measurement *m = measurements; m < measurements + count; ++m) {
        if (!valid(m) || m->time_s > latest_s || m->time_s < latest_s - BR_LONGEST_S) continue;
        if (!of_pose(m) || br_instrument_holds(&estimator->instrument[m->instrument], m)) continue;
        if (!first || m->time_s < first->time_s) first = m;
    }
    return first;
}

/* The number of a pose's state. */
static double value_of(const br_measurement *m, int state) {
    int a = 0;
    while (m->of[a] != state) ++a;
    return m->value[a];
}

/* Velocities, yaw rate and steering angle around what the difference of two poses says, in place of
 * around 0 (Bar-Shalom et al., section 5.5.3). */
static void begin_moving(const br_measurement *before, const br_measurement *m, br_estimate *b) {
    const double dt = m->time_s - before->time_s, *deviation = m->deviation;
    const double dx = value_of(m, BR_INDEX_X) - value_of(before, BR_INDEX_X);
    const double dy = value_of(m, BR_INDEX_Y) - value_of(before, BR_INDEX_Y);
    const double psi = value_of(m, BR_INDEX_PSI);
    const double dpsi = remainder(psi - value_of(before, BR_INDEX_PSI), 2 * M_PI);
    const double c = cos(psi - dpsi / 2), s = sin(psi - dpsi / 2);
    double noise = 0;
    for (int a = 0; a < m->count; ++a) noise = fmax(noise, 2 * deviation[a] * deviation[a]);
    b->x[BR_INDEX_VX] = (c * dx + s * dy) / dt;
    b->x[BR_INDEX_VY] = (c * dy - s * dx) / dt;
    b->x[BR_INDEX_OMEGA] = dpsi / dt;
    b->x[BR_INDEX_DELTA] =
        atan2(BR_WHEELBASE_M * b->x[BR_INDEX_OMEGA], fmax(b->x[BR_INDEX_VX], BR_WHEELBASE_M / dt));
    for (int j = 0; j < BR_NE; ++j) b->p[BR_RATE[j]][BR_RATE[j]] += noise / (dt * dt);
    b->p[BR_INDEX_DELTA][BR_INDEX_DELTA] *= STEERED * STEERED;
}

/* Where little relates it to what is measured, the steering angle is still what it was. */
static void keep_steering(const br_estimate *known, br_estimate *b) {
    const int of[] = {BR_INDEX_DELTA, BR_NX + 1}; /* with the offset of what measures it */
    for (int i = 0; i < 2; ++i) {
        b->x[of[i]] = known->x[of[i]];
        for (int j = 0; j < 2; ++j) b->p[of[i]][of[j]] = known->p[of[i]][of[j]];
    }
}

/* What was believed when this was measured; NULL: nothing. */
static const br_estimate *believed_at(br_estimator *estimator, double time_s) {
    int k = estimator->count - 1;
    while (k >= 0 && br_estimator_event(estimator, k)->time_s > time_s + BR_SAME_S) --k;
    return k < 0 ? NULL : &br_estimator_event(estimator, k)->after;
}

/* before: another pose, shortly before; NULL: none. */
static void begin(br_estimator *estimator, const br_measurement *m, const br_measurement *before) {
    br_event first = {.time_s = m->time_s};
    br_estimate *b = &first.after;
    const br_estimate *known = believed_at(estimator, m->time_s);
    const br_estimate kept = known ? *known : *b;
    br_estimator_reset(estimator); /* never of one that is latched */
    estimator->agreed = estimator->astray = 0;
    estimator->posed_s = m->time_s;
    for (int i = 0; i < BR_NA; ++i) {
        const br_estimation *s = &estimator->settings;
        const double deviation = i < BR_NB ? s->start[i] : s->acceleration[i - BR_NB];
        b->p[i][i] = deviation * deviation;
    }
    if (before) begin_moving(before, m, b);
    if (known && estimator->walks) keep_steering(&kept, b);
    for (int a = 0; a < m->count; ++a) {
        const int i = m->of[a];
        b->x[i] = m->value[a];
        b->p[i][i] = m->deviation[a] * m->deviation[a];
        if (offset_in(i) >= 0) { /* its offset is not told apart yet */
            const int offset = offset_in(i);
            b->p[i][i] += b->p[offset][offset];
            b->p[i][offset] = b->p[offset][i] = -b->p[offset][offset];
        }
    }
    estimator->instrument[m->instrument].used += 1;
    estimator->instrument[m->instrument].passed_s = m->time_s;
    insert(estimator, 0, &first);
}

/* Puts a measurement where it belongs; the place, or -1 where it is lost. */
static int place(br_estimator *estimator, const br_measurement *m) {
    const int last = estimator->count - 1;
    if (!valid(m)) return -1;
    if (m->time_s > br_estimator_event(estimator, last)->time_s + BR_SAME_S ||
        m->time_s < br_estimator_event(estimator, 0)->time_s - BR_SAME_S)
        return -1;
    int k = last;
    while (k > 1 && br_estimator_event(estimator, k - 1)->time_s > m->time_s) --k;
    if (k == 0) return -1;                                  /* nothing has been since the first, */
    if (k == 1 && estimator->count == BR_EVENTS) return -1; /* or that has to make room */
    br_event given = *br_estimator_event(estimator, k);     /* the input is that of its period */
    given.time_s =
        fmin(fmax(m->time_s, br_estimator_event(estimator, k - 1)->time_s), given.time_s);
    given.measured = *m;
    given.judged = given.left_out = 0;
    given.widening = 1;
    return insert(estimator, k, &given);
}

/* It is of no time that is kept, or no measurement at all; one from before the beginning may come
 * late. */
static void lose(br_estimator *estimator, const br_measurement *m, double time_s) {
    if (m->instrument < 0 || m->instrument >= BR_INSTRUMENTS) return;
    br_instrument *instrument = &estimator->instrument[m->instrument];
    const int early = estimator->count < BR_EVENTS && m->time_s >= time_s - BR_LONGEST_S;
    instrument->lost += 1;
    if (m->time_s <= time_s + BR_SAME_S && early && valid(m)) return;
    br_instrument_bad(instrument, BR_FAULT_TIME);
}

/* A measurement has been compared for the first time; whether it counts for the estimate. */
static int count(br_estimator *estimator, const br_event *one, double squared) {
    const br_measurement *m = &one->measured;
    br_instrument *instrument = &estimator->instrument[m->instrument];
    if (squared < 0) {
        instrument->refused += 1;
        if (!instrument->refused_in_row++) instrument->refused_s = m->time_s;
        if (estimator->agreed)
            br_instrument_bad(instrument, br_instrument_kind(m, &one->after));
        else
            estimator->astray += of_pose(m);
        return 0;
    }
    instrument->refused_in_row = 0;
    instrument->passed_s = fmax(m->time_s, instrument->passed_s);
    if (!br_instrument_good(instrument, estimator->latched)) {
        instrument->left_out += 1;
        return 0;
    }
    instrument->used += 1;
    instrument->squared += squared;
    instrument->expected += m->count;
    if (!of_pose(m)) return 1;
    estimator->agreed = 1;
    estimator->astray = 0;
    estimator->posed_s = fmax(m->time_s, estimator->posed_s);
    return 1;
}

/* Refused again, though no farther off than a model may err: that knows less than it says, and the
 * covariance grows (a fading memory, Bar-Shalom et al., section 5.5.4). */
static double widen(const br_estimator *estimator, const br_event *one) {
    const br_measurement *m = &one->measured;
    const double gate = estimator->settings.gate;
    const br_instrument *instrument = &estimator->instrument[m->instrument];
    int contradicted;
    if (!(gate > 0) || !estimator->agreed) return 1;
    if (!instrument->refused_in_row || br_instrument_contradicts(instrument->fault)) return 1;
    if (!br_instrument_near(instrument, m, &one->after)) return 1;
    if (br_estimator_blind(estimator, &contradicted) && contradicted) return 1;
    br_estimate alone = one->after;
    alone.biased = 0; /* by what grows */
    return fmin(fmax(take(estimator, INFINITY, m, &alone, NULL) / m->count, 1), WIDEST);
}

/* The covariance, but for the offsets: these belong to the sensors. */
static void grow(double by, br_estimate *b) {
    double factor[BR_NA];
    for (int i = 0; i < BR_NA; ++i) factor[i] = i < BR_NX || i >= BR_NB ? sqrt(by) : 1;
    for (int i = 0; i < BR_NA; ++i)
        for (int j = 0; j < BR_NA; ++j) b->p[i][j] *= factor[i] * factor[j];
}

/* The measurement in what is believed at its time. */
static void judge(br_estimator *estimator, br_event *one) {
    br_instrument *instrument = &estimator->instrument[one->measured.instrument];
    const int first = !one->judged;
    one->judged = 1;
    if (first && br_instrument_repeats(instrument, &one->measured, &one->after)) {
        br_instrument_bad(instrument, BR_FAULT_FROZEN);
        instrument->left_out += 1;
        one->left_out = 1;
    }
    if (one->left_out) return;
    const double gate = (estimator->agreed ? 1 : BEGINNING) * estimator->settings.gate;
    br_estimate with = one->after;
    /* No model is off by so much in a gap, though its covariance may allow an outlier then. */
    const int possible =
        !estimator->agreed || !(gate > 0) || br_instrument_possible(&one->measured, &one->after);
    br_mpc_noise shown = estimator->observed;
    double squared =
        possible ? take(estimator, gate, &one->measured, &with, first ? &shown : NULL) : -1;
    if (first && squared < 0) one->widening = widen(estimator, one);
    if (squared < 0 && one->widening > 1) {
        grow(one->widening, &one->after);
        with = one->after;
        shown = estimator->observed;
        squared = take(estimator, gate, &one->measured, &with, first ? &shown : NULL);
    }
    if (first && !count(estimator, one, squared)) one->left_out = squared >= 0 || instrument->fault;
    if (squared < 0 || one->left_out) return;
    one->after = with;
    if (first) estimator->observed = shown;
}

/* The events from the k-th to before the end are done over. */
static br_mpc_error redo(br_estimator *estimator, int k, int end) {
    for (; k < end; ++k) {
        br_event *one = br_estimator_event(estimator, k);
        const br_event *before = br_estimator_event(estimator, k - 1);
        one->after = before->after;
        const br_mpc_error error = br_estimator_reach(estimator, one->u, &one->residual,
                                                      one->time_s - before->time_s, &one->after);
        if (error) return error;
        if (one->measured.count)
            judge(estimator, one);
        else
            memset(one->after.way, 0, sizeof one->after.way);
    }
    return BR_OK;
}

/* Puts the measurements where they belong, and does everything over from the first of them on. */
static br_mpc_error take_all(br_estimator *estimator, double time_s,
                             const br_measurement *measurements, int count,
                             const br_measurement *begun_with) {
    int from = estimator->count - 1;
    for (const br_measurement *m = measurements; m < measurements + count; ++m) {
        if (m == begun_with) continue;
        if (from == 1 && estimator->count == BR_EVENTS) { /* done before it becomes the oldest */
            const br_mpc_error error = redo(estimator, 1, 2);
            if (error) return error;
        }
        const int size = estimator->count, k = place(estimator, m);
        if (k < 0) {
            lose(estimator, m, time_s);
            continue;
        }
        from -= from > 1 && estimator->count == size; /* the oldest has made room */
        from = k < from ? k : from;
        br_instrument_arrive(&estimator->instrument[m->instrument], m, time_s);
    }
    return redo(estimator, from, estimator->count);
}

/* The period, with what has been measured. */
static br_mpc_error period(br_estimator *estimator, const br_event *given,
                           const br_measurement *measurements, int count,
                           const br_measurement *begun_with) {
    const br_event *newest = br_estimator_newest(estimator);
    const double duration = estimator->period_s = given->time_s - newest->time_s;
    br_event end = *given;
    memset(&estimator->observed, 0, sizeof estimator->observed);
    end.after = newest->after;
    br_estimate predicted = newest->after;
    br_mpc_error error = br_estimator_reach(estimator, end.u, &end.residual, duration, &predicted);
    insert(estimator, estimator->count, &end);
    if (!error) error = take_all(estimator, end.time_s, measurements, count, begun_with);
    newest = br_estimator_newest(estimator);
    for (int i = 0; i < BR_NX; ++i)
        estimator->corrected[i] = fmax(predicted.p[i][i] - newest->after.p[i][i], 0);
    return error;
}

/* Whether the newest period is too long ago; or, where there is a pose, the newest pose is. */
static int outdated(br_estimator *estimator, double time_s, int pose) {
    const double newest_s = br_estimator_newest(estimator)->time_s;
    if (time_s - newest_s > BR_LONGEST_S) return 1;
    int contradicted;
    br_estimator_blind(estimator, &contradicted);
    return pose && time_s - estimator->posed_s > BR_LONGEST_S && !contradicted;
}

br_mpc_error br_estimator_advance(br_estimator *estimator, double time_s, const double u[BR_NU],
                                  const br_residual *residual, const br_measurement *measurements,
                                  int count) {
    if (!estimator || !u || (count > 0 && !measurements)) return BR_ERROR_NULL;
    if (!estimator->has_settings) return BR_ERROR_NOT_READY;
    if (!isfinite(time_s)) return BR_ERROR_TIME;
    const int begun = estimator->count;
    if (begun && time_s < br_estimator_event(estimator, begun - 1)->time_s - BR_SAME_S) {
        estimator->count = 0; /* one of the two dates is wrong */
        return BR_ERROR_TIME;
    }
    const br_measurement *pose = first_pose(estimator, measurements, count, time_s + BR_SAME_S);
    const int anew = !begun || outdated(estimator, time_s, pose != NULL);
    if (anew && (!pose || estimator->latched)) {
        estimator->count = 0;
        for (int i = 0; i < count; ++i) lose(estimator, &measurements[i], time_s);
        return BR_ERROR_NOT_READY;
    }
    if (anew) begin(estimator, pose, NULL);
    br_event end = {.time_s = time_s};
    memcpy(end.u, u, sizeof end.u);
    if (residual) end.residual = *residual;
    if (estimator->walks) memset(end.residual.phi, 0, sizeof end.residual.phi);
    br_mpc_error error = period(estimator, &end, measurements, count, anew ? pose : NULL);
    const br_measurement before = estimator->pose;
    const double apart_s = pose && !anew ? pose->time_s - before.time_s : 0;
    if (!error && estimator->astray > 1 &&
        apart_s > BR_SAME_S) { /* not at rest, nor where it began */
        begin(estimator, pose, apart_s < APART_S ? &before : NULL);
        error = period(estimator, &end, measurements, count, pose);
    }
    if (pose) estimator->pose = *pose;
    for (int i = 0; i < BR_INSTRUMENTS; ++i) br_instrument_wait(&estimator->instrument[i], time_s);
    if (error) estimator->count = 0;
    return error;
}

br_mpc_error br_estimator_read(const br_estimator *estimator, br_belief *out) {
    if (!estimator || !out) return BR_ERROR_NULL;
    if (!estimator->count) return BR_ERROR_NOT_READY;
    const br_event *last = br_estimator_newest(estimator);
    out->time_s = last->time_s;
    memcpy(out->x, last->after.x, sizeof out->x);
    double p[BR_NA][BR_NA];
    br_estimator_covariance(estimator, &last->after, p);
    for (int i = 0; i < BR_NB; ++i)
        memcpy(out->covariance + BR_NB * i, p[i], BR_NB * sizeof(double));
    br_estimator_noise(estimator, &out->noise);
    return BR_OK;
}

const br_instrument *br_estimator_instrument(const br_estimator *estimator, int number) {
    if (!estimator || number < 0 || number >= BR_INSTRUMENTS) return NULL;
    return &estimator->instrument[number];
}

#endif
