/* Received states: which of them count, whether what they say can be believed, what the controller
 * is shown of them, and the state at the moment from which the new input will act. */
#include <math.h>
#include <string.h>

#include "br_cycle.h"

#if BR_HAS_PATH

/* --- which states count: those of the current plant and run, each newer than the one before --- */

/* A number that is farther ahead than this is not taken for the next one of the run at once: as
 * many states, or, where their interval allows more, as much time, and at most so many states. */
#define AHEAD 16
#define AHEAD_S 0.3
#define FARTHEST 256
#define CONFIRMED 4 /* states in a row that belong together are a stream of their own */

static int same_run(const br_measured *a, const br_measured *b) {
    return a->epoch == b->epoch && a->run == b->run;
}

static int follows(const br_measured *state, const br_measured *before, double interval_s) {
    const double in_time = interval_s > 0 ? AHEAD_S / interval_s : 0;
    const double most = fmin(fmax(in_time, AHEAD), FARTHEST);
    if (state->seq <= before->seq) return 0;
    return (double)((uint64_t)state->seq - (uint64_t)before->seq) <= most;
}

/* Whether it continues the stream, or nothing speaks against another one. */
static int continues(const br_stream *stream, const br_measured *state, double interval_s) {
    if (!stream->has_newest || stream->silent) return 1;
    if (!same_run(state, &stream->newest)) return stream->ended;
    return follows(state, &stream->newest, interval_s);
}

/* Whether it is the last of several in a row that are a stream of their own. */
static int confirmed(br_stream *stream, const br_measured *state, double interval_s) {
    const int belongs = stream->has_other && same_run(state, &stream->other) &&
                        follows(state, &stream->other, interval_s);
    stream->others = belongs ? stream->others + 1 : 1;
    stream->other = *state;
    stream->has_other = 1;
    return stream->others >= CONFIRMED;
}

br_reception br_stream_accept(br_stream *stream, const br_measured *state, br_counters *counters) {
    const br_measured *newest = &stream->newest;
    const int same = stream->has_newest && same_run(state, newest);
    const double interval_s = counters->interval_s;
    if (!continues(stream, state, interval_s) && !confirmed(stream, state, interval_s)) {
        const int stale = same && state->seq <= newest->seq;
        if (stale)
            counters->stale += 1;
        else
            counters->foreign += 1;
        return stale ? BR_STATE_STALE : BR_STATE_FOREIGN;
    }
    if (same && (uint64_t)state->seq == (uint64_t)newest->seq + 1)
        counters->interval_s = fmax(state->time_s - stream->dated_s, 0);
    else if (!same)
        counters->interval_s = 0;
    stream->newest = *state;
    stream->dated_s = state->time_s;
    stream->has_newest = 1;
    stream->has_other = stream->others = stream->ended = stream->silent = 0;
    return BR_STATE_NEW;
}

int br_stream_forget(br_stream *stream, br_counters *counters) {
    const int waits = stream->has_other && stream->other.lockstep;
    stream->ended = stream->silent = 1;
    stream->has_other = 0;
    counters->interval_s = 0;
    return waits;
}

/* --- whether a measured state can be believed ---
 *
 * What it says of position and velocity must fit, and both must follow from the state before.
 *
 * Position, heading and steering angle are compared with the way that the measured velocities, yaw
 * rate and applied steering rate have made since they last agreed; the comparison forgets over
 * BR_MONITOR_MEMORY_S, so noise averages and a lasting contradiction adds up. Velocity and yaw rate
 * may change no faster than tyres make them. That is kinematics and holds for any model, sliding or
 * not. A state that contradicts is replaced by the prediction of the corrected model from the last
 * state beyond doubt. States are believed again once several in a row agree with each other and
 * with the prediction. Where their clock has been set meanwhile, they are dated by that of before.
 * The bounds (BR_MONITOR_...) are the car's, from its file. */

#define AGREEING 3       /* states in a row that end the distrust */
#define BEYOND_DOUBT 0.1 /* share of the bounds */
#define OFTEN 0.75       /* of a stage */
#define GAP_S 0.5        /* after a longer one nothing can be compared */
#define IN_TIME 0.5      /* share of the interval by which a time may be wrong */
#define RECOVER_S 0.25   /* of doubt, from its beginning on; what lasts longer is no glitch */
#define CLOSE 0.4        /* share of the bound of velocity changes, between state and prediction */
#define QUIET_S 1.0      /* without doubt: the next one is another */

typedef struct {
    double x, y;
} vector;

static vector world_velocity(const double x[BR_NX]) {
    const double c = cos(x[BR_INDEX_PSI]), s = sin(x[BR_INDEX_PSI]);
    const double vx = x[BR_INDEX_VX], vy = x[BR_INDEX_VY];
    return (vector){c * vx - s * vy, s * vx + c * vy};
}

static double turned(double to, double from) { return remainder(to - from, 2 * M_PI); }

void br_monitor_restart(br_monitor *monitor) { memset(monitor, 0, sizeof *monitor); }

static void begin(br_monitor *monitor, const br_measured *state) {
    memcpy(monitor->before, state->x, sizeof state->x);
    memcpy(monitor->way, state->x, sizeof state->x);
    monitor->seq = state->seq;
    monitor->measured_s = state->time_s;
}

/* Contradictions between the state and those before, as shares of their bounds. */
typedef struct {
    double share;  /* the largest one of those: */
    br_fault kind; /* which */
    double ways;   /* the largest one between what is measured and the way there */
} br_contradiction;

static br_contradiction compare(br_monitor *monitor, const br_driving *settings,
                                const br_measured *state, double dt_s) {
    const double *x = state->x, *before = monitor->before;
    double *way = monitor->way;
    const vector v0 = world_velocity(before), v1 = world_velocity(x);
    const double turning = (before[BR_INDEX_OMEGA] + x[BR_INDEX_OMEGA]) / 2;
    way[BR_INDEX_X] += dt_s * (v0.x + v1.x) / 2;
    way[BR_INDEX_Y] += dt_s * (v0.y + v1.y) / 2;
    way[BR_INDEX_PSI] += dt_s * turning;
    way[BR_INDEX_DELTA] += dt_s * state->u_applied[BR_INDEX_DELTA_RATE];
    if (!state->averaged || state->seq != monitor->seq + 1) /* what acted is not known */
        way[BR_INDEX_DELTA] = x[BR_INDEX_DELTA];
    const double dx = x[BR_INDEX_X] - way[BR_INDEX_X], dy = x[BR_INDEX_Y] - way[BR_INDEX_Y];
    const double dpsi = turned(x[BR_INDEX_PSI], way[BR_INDEX_PSI]);
    const double ddelta = x[BR_INDEX_DELTA] - way[BR_INDEX_DELTA];
    const double within = dt_s * dt_s / 8; /* of the trapezoidal rule */
    const double shares[] = {
        [BR_FAULT_POSITION] =
            hypot(dx, dy) / (BR_MONITOR_POSITION_M + BR_MONITOR_ACCELERATION_MPS2 * within),
        [BR_FAULT_HEADING] =
            fabs(dpsi) / (BR_MONITOR_HEADING_RAD + BR_MONITOR_YAW_ACCELERATION_RADPS2 * within),
        [BR_FAULT_VELOCITY] = hypot(v1.x - v0.x, v1.y - v0.y) /
                              (BR_MONITOR_SPEED_MPS + BR_MONITOR_ACCELERATION_MPS2 * dt_s),
        [BR_FAULT_YAW_RATE] =
            fabs(x[BR_INDEX_OMEGA] - before[BR_INDEX_OMEGA]) /
            (BR_MONITOR_YAW_RATE_RADPS + BR_MONITOR_YAW_ACCELERATION_RADPS2 * dt_s),
        [BR_FAULT_STEERING] = fabs(ddelta) / BR_MONITOR_STEERING_RAD,
    };
    br_contradiction found = {.kind = BR_FAULT_POSITION};
    for (int i = BR_FAULT_POSITION; i <= BR_FAULT_STEERING; ++i) {
        const int of_change = i == BR_FAULT_VELOCITY || i == BR_FAULT_YAW_RATE;
        const double share = shares[i] / settings->sensor_tolerance;
        if (!of_change && share > found.ways) found.ways = share;
        if (share <= found.share || isnan(found.share)) continue;
        found.share = share;
        found.kind = (br_fault)i;
    }
    const double gain = 1 - exp(-dt_s / BR_MONITOR_MEMORY_S);
    way[BR_INDEX_X] += gain * dx;
    way[BR_INDEX_Y] += gain * dy;
    way[BR_INDEX_PSI] += gain * dpsi;
    way[BR_INDEX_DELTA] += gain * ddelta;
    return found;
}

/* Equal to the bit in everything that is measured, though the car moves. */
static int frozen(const br_monitor *monitor, const br_driving *settings, const double x[BR_NX]) {
    const double speed = hypot(x[BR_INDEX_VX], x[BR_INDEX_VY]);
    return speed > settings->standing_mps && !memcmp(x, monitor->before, sizeof monitor->before);
}

/* States that come more often than stages are taken together. */
static void remember(br_monitor *monitor, const br_measured *state, double dt_s, double ways) {
    br_believed *since = &monitor->since;
    since->dt_s += dt_s;
    since->ways = fmax(since->ways, ways);
    for (int i = 0; i < BR_NU && since->dt_s > 0; ++i)
        since->u[i] += (state->u_applied[i] - since->u[i]) * dt_s / since->dt_s;
    if (monitor->count && since->dt_s < OFTEN * BR_TS) return;
    memcpy(since->x, state->x, sizeof since->x);
    monitor->believed[monitor->next] = *since;
    monitor->next = (monitor->next + 1) % BR_BELIEVED;
    if (monitor->count < BR_BELIEVED) monitor->count += 1;
    memset(since, 0, sizeof *since);
}

static const br_believed *ago(const br_monitor *monitor, int n) {
    return &monitor->believed[(monitor->next + BR_BELIEVED - 1 - n) % BR_BELIEVED];
}

static void advance(br_monitor *monitor, const br_controller *controller, const double u[BR_NU],
                    double dt_s) {
    double *x = monitor->x;
    const int stage = fabs(dt_s - BR_TS) < STAGE_ROUNDING * BR_TS; /* times are differences */
    controller->predict(controller->self, x, u, stage ? BR_TS : fmin(dt_s, BR_PREDICT_MAX_S), x);
    monitor->gone_m += dt_s * hypot(x[BR_INDEX_VX], x[BR_INDEX_VY]);
}

/* The prediction begins at the newest state beyond doubt: a contradiction may have added up. */
static void distrust(br_monitor *monitor, const br_controller *controller) {
    int n = 0;
    while (n + 1 < monitor->count && ago(monitor, n)->ways > BEYOND_DOUBT) ++n;
    monitor->gone_m = 0;
    memcpy(monitor->x, ago(monitor, n)->x, sizeof monitor->x);
    while (n-- > 0) advance(monitor, controller, ago(monitor, n)->u, ago(monitor, n)->dt_s);
    advance(monitor, controller, monitor->since.u, monitor->since.dt_s);
}

/* Whether the state is where the prediction may be wrong by its drift alone. */
static int near(const br_monitor *monitor, const br_driving *settings, const double x[BR_NX]) {
    const double *expected = monitor->x, drift_m = BR_MONITOR_DRIFT * monitor->gone_m;
    const double off_m =
        hypot(x[BR_INDEX_X] - expected[BR_INDEX_X], x[BR_INDEX_Y] - expected[BR_INDEX_Y]);
    const double off_rad = fabs(turned(x[BR_INDEX_PSI], expected[BR_INDEX_PSI]));
    const vector v = world_velocity(x), w = world_velocity(expected);
    const double tolerance = settings->sensor_tolerance;
    return off_m <= tolerance * BR_MONITOR_POSITION_M + drift_m &&
           off_rad <= tolerance * BR_MONITOR_HEADING_RAD + drift_m / BR_WHEELBASE_M &&
           hypot(v.x - w.x, v.y - w.y) <= CLOSE * tolerance * BR_MONITOR_SPEED_MPS &&
           fabs(x[BR_INDEX_OMEGA] - expected[BR_INDEX_OMEGA]) <=
               tolerance * BR_MONITOR_YAW_RATE_RADPS &&
           fabs(x[BR_INDEX_DELTA] - expected[BR_INDEX_DELTA]) <=
               tolerance * BR_MONITOR_STEERING_RAD;
}

static void believe(br_monitor *monitor, const br_measured *state, double dt_s, double ways) {
    remember(monitor, state, dt_s, ways);
    monitor->distrusted = BR_FAULT_NONE;
    monitor->time_s = monitor->trusted_s = state->time_s;
}

/* Nothing is known of what was before. */
static void begin_anew(br_monitor *monitor, const br_measured *state) {
    monitor->count = monitor->agreeing = 0;
    memset(&monitor->since, 0, sizeof monitor->since);
    begin(monitor, state);
    believe(monitor, state, 0, 0);
}

/* What contradicts, and since when the state before was: due_s ago by its number. */
static br_fault examine(br_monitor *monitor, const br_driving *settings, const br_measured *state,
                        double due_s, double *dt_s, double *ways) {
    const int in_time = due_s <= 0 || fabs(*dt_s - due_s) <= IN_TIME * due_s;
    const br_contradiction found = compare(monitor, settings, state, fmax(*dt_s, 0));
    *ways = found.ways;
    if (frozen(monitor, settings, state->x)) return BR_FAULT_FROZEN;
    if (found.share <= 1 && *dt_s > 0) return BR_FAULT_NONE;
    if (in_time && *dt_s > 0) return found.kind;
    *dt_s = due_s;
    return BR_FAULT_TIME;
}

br_fault br_monitor_check(br_monitor *monitor, const br_driving *settings,
                          const br_controller *controller, double interval_s, br_measured *state) {
    if (settings->sensor_tolerance == 0) return BR_FAULT_NONE;
    state->time_s -= monitor->ahead_s;
    double dt_s = state->time_s - monitor->measured_s, ways;
    if (!monitor->count || (dt_s > GAP_S && !monitor->distrusted)) {
        begin_anew(monitor, state);
        return BR_FAULT_NONE;
    }
    const double due_s = interval_s * (double)(state->seq - monitor->seq);
    const br_fault fault = examine(monitor, settings, state, due_s, &dt_s, &ways);
    if (fault) begin(monitor, state); /* what follows is compared with this one, true or not */
    memcpy(monitor->before, state->x, sizeof state->x);
    monitor->seq = state->seq;
    monitor->measured_s = state->time_s;
    monitor->agreeing = fault ? 0 : monitor->agreeing + 1;
    monitor->time_s += dt_s;
    if (!fault && !monitor->distrusted) {
        believe(monitor, state, dt_s, ways);
        return BR_FAULT_NONE;
    }
    if (!monitor->distrusted) {
        distrust(monitor, controller);
        if (monitor->time_s - monitor->doubt_ended_s > QUIET_S || !monitor->doubts)
            monitor->doubted_s = monitor->time_s;
        monitor->doubts = 1;
    }
    if (fault) monitor->distrusted = fault;
    advance(monitor, controller, state->u_applied, dt_s);
    if (monitor->agreeing >= AGREEING) {
        const int glitch = monitor->time_s - monitor->doubted_s <= RECOVER_S;
        if (glitch && near(monitor, settings, state->x)) {
            const double ahead_s = state->time_s - monitor->time_s;
            if (due_s > 0 && fabs(ahead_s) > IN_TIME * due_s) { /* its clock was set */
                monitor->ahead_s += ahead_s;
                state->time_s = monitor->time_s;
            }
            begin_anew(monitor, state);
            monitor->doubt_ended_s = state->time_s;
            return BR_FAULT_NONE;
        }
        monitor->distrusted = BR_FAULT_ELSEWHERE;
    }
    memcpy(state->x, monitor->x, sizeof monitor->x);
    state->time_s = monitor->time_s;
    return monitor->distrusted;
}

const char *br_cycle_fault_text(br_fault fault) {
    static const char *const texts[] = {
        [BR_FAULT_NONE] = "the state is believed",
        [BR_FAULT_FROZEN] = "it is equal to the state before, though the car moves",
        [BR_FAULT_TIME] = "its time does not follow from its number",
        [BR_FAULT_POSITION] = "the position does not follow from the velocities",
        [BR_FAULT_HEADING] = "the heading does not follow from the yaw rate",
        [BR_FAULT_VELOCITY] = "the velocity changes faster than tyres can make it",
        [BR_FAULT_YAW_RATE] = "the yaw rate changes faster than tyres can make it",
        [BR_FAULT_STEERING] = "the steering angle does not follow from the steering rate",
        [BR_FAULT_ELSEWHERE] =
            "the states agree with each other again, but not with where the car must be",
        [BR_FAULT_UNCERTAIN] = "too little has been measured to know where the car is",
    };
    return (unsigned)fault < sizeof texts / sizeof texts[0] ? texts[fault] : "unknown fault";
}

/* --- what the compiled controller is shown of the car --- */

#define LEAST_STAGES 0.5 /* of a transition by which the model is judged; ... */
#define MOST_STAGES 2    /* ... and at most */

static void add(const br_mpc_noise *noise, br_mpc_noise *sum) {
    for (int i = 0; i < BR_NX; ++i) sum->step[i] += noise->step[i];
    sum->values += noise->values;
    for (int j = 0; j < BR_NE; ++j) {
        sum->squares[j] += noise->squares[j];
        for (int k = 0; k < BR_NPHI; ++k) {
            sum->projection[j][k] += noise->projection[j][k];
            for (int l = 0; l < BR_NPHI; ++l)
                sum->information[j][k][l] += noise->information[j][k][l];
        }
    }
}

/* Shows the compiled controller what the car does from stage to stage: states that come more often
 * are taken together, and where one is lost, or the mean input is not known, it begins anew. A
 * standing car shows nothing. */
void br_shown_observe(br_shown *shown, br_mpc *mpc, const br_driving *settings,
                      const br_measured *before, const br_measured *state,
                      const br_mpc_noise *noise) {
    const double step_s = state->time_s - before->time_s;
    const int next = (uint64_t)state->seq == (uint64_t)before->seq + 1;
    if (!mpc || !next || !state->averaged || !(step_s > 0)) {
        shown->duration_s = 0;
        return;
    }
    if (shown->duration_s == 0) {
        memcpy(shown->x, before->x, sizeof shown->x);
        memset(shown->u, 0, sizeof shown->u);
        memset(&shown->noise, 0, sizeof shown->noise);
    }
    const double duration_s = shown->duration_s + step_s;
    for (int i = 0; i < BR_NU; ++i)
        shown->u[i] += (state->u_applied[i] - shown->u[i]) * step_s / duration_s;
    if (noise) add(noise, &shown->noise);
    shown->duration_s = duration_s;
    if (duration_s < LEAST_STAGES * BR_TS) return;
    shown->duration_s = 0;
    if (duration_s <= MOST_STAGES * BR_TS && fabs(shown->x[BR_INDEX_VX]) > settings->standing_mps) {
        const int stage = fabs(duration_s - BR_TS) < STAGE_ROUNDING * BR_TS;
        br_mpc_observe(mpc, shown->x, shown->u, stage ? BR_TS : duration_s, state->x,
                       noise ? &shown->noise : NULL);
    }
}

/* --- delay compensation: the state at the moment from which the new input will act ---
 *
 * The plant reports, in its own time, how long after the decision on it each input began to act;
 * the median of the newest delays is the delay. The input decided at plant time t acts from t +
 * delay on. Until then the inputs that were sent before act, each from its own decision plus the
 * delay on; the corrected model carries the state through them. No clocks have to agree. */

/* The lower median. */
static double median(const double *values, int n) {
    double ordered[BR_MEDIAN_OF];
    for (int i = 0; i < n; ++i) {
        int k = i;
        for (; k > 0 && ordered[k - 1] > values[i]; --k) ordered[k] = ordered[k - 1];
        ordered[k] = values[i];
    }
    return ordered[(n - 1) / 2];
}

void br_delay_observe(br_delay *delay, const br_driving *settings, const br_measured *state,
                      double *delay_s) {
    if (settings->compensation != BR_COMPENSATION_MEASURED) return;
    int some = 0;
    for (int i = 0; i < state->delays && i < BR_DELAYS; ++i) {
        if (!(state->delays_s[i] >= 0)) continue; /* overtaken: it never acts */
        delay->delays_s[delay->next_delay] = state->delays_s[i];
        delay->next_delay = (delay->next_delay + 1) % BR_MEDIAN_OF;
        if (delay->delays < BR_MEDIAN_OF) delay->delays += 1;
        some = 1;
    }
    if (some) *delay_s = fmin(median(delay->delays_s, delay->delays), settings->longest_s);
}

static br_sent *sent(br_delay *delay, int i) { return &delay->sent[(delay->first + i) % BR_SENT]; }

static void drop_first(br_delay *delay) {
    delay->first = (delay->first + 1) % BR_SENT;
    delay->count -= 1;
}

void br_delay_sent(br_delay *delay, double decided_at_s, const double u[BR_NU]) {
    if (delay->count == BR_SENT) drop_first(delay);
    br_sent *one = sent(delay, delay->count++);
    one->decided_at_s = decided_at_s;
    memcpy(one->u, u, sizeof one->u);
}

/* In place of what was noted for that time, or for a later one. */
void br_delay_replace(br_delay *delay, double decided_at_s, const double u[BR_NU]) {
    while (delay->count && sent(delay, delay->count - 1)->decided_at_s >= decided_at_s)
        delay->count -= 1;
    br_delay_sent(delay, decided_at_s, u);
}

const double *br_delay_acting(br_delay *delay, double time_s, double delay_s) {
    for (int i = delay->count - 1; i >= 0; --i) {
        const br_sent *one = sent(delay, i);
        if (one->decided_at_s + delay_s <= time_s) return one->u;
    }
    return NULL;
}

static int carry(const br_controller *controller, double x[BR_NX], const double u[BR_NU],
                 double duration_s, br_carried *carried) {
    if (carried &&
        br_estimator_reach(carried->estimator, u, carried->residual, duration_s, &carried->at))
        return -1;
    return controller->predict(controller->self, x, u, duration_s, x) ? -1 : 0;
}

/* x and u when an input decided at that plant time begins to act; -1 if the model cannot follow. */
int br_delay_at_acting(br_delay *delay, const br_driving *settings, const br_controller *controller,
                       const br_measured *state, double decided_at_s, double delay_s,
                       double x[BR_NX], double u[BR_NU], br_carried *carried) {
    double now_s = state->time_s;
    const double end_s = fmin(decided_at_s + delay_s, now_s + settings->longest_s);
    memcpy(x, state->x, sizeof state->x);
    memcpy(u, state->u_applied, sizeof state->u_applied);
    if (settings->compensation == BR_COMPENSATION_OFF) return 0;
    while (delay->count > 1 && sent(delay, 1)->decided_at_s + delay_s <= now_s)
        drop_first(delay); /* has stopped acting */
    for (int i = 0; i < delay->count; ++i) {
        const br_sent *one = sent(delay, i);
        const double from_s = one->decided_at_s + delay_s;
        if (from_s >= end_s) break;
        if (from_s > now_s) {
            if (carry(controller, x, u, from_s - now_s, carried)) return -1;
            now_s = from_s;
        }
        memcpy(u, one->u, sizeof one->u);
    }
    if (end_s <= now_s) return 0;
    return carry(controller, x, u, end_s - now_s, carried);
}

#endif
