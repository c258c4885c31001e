/* The line's speeds, and plans, as far as the weights know the car.
 *
 * A line is made for what the car can do; a training drive has seen less. A plan looks ahead for a
 * fraction of a second, and where speed and lateral acceleration together were never trained, the
 * car slides before its pace has fallen. So whenever weights are loaded, by the thread that stages
 * them, the line's speeds are limited to what these know. At points a wheelbase apart the car is
 * taken to go on as the line does there: by the corrected model, with kappa the line's curvature
 * and a its acceleration,
 *
 *   vx' = vx + Ts a,   vy' = vy,   omega' = omega + Ts a kappa,   omega = vx kappa.
 *
 * Where errors as large as the residual's standard deviation there, without its noise, would take
 * it farther from the line than BR_CAUTION_SHARE of half the track's width before feedback notices
 * them, the speed is lower, down to BR_CAUTION_LEAST of the line's. (The tube of such a plan does
 * not tell: its feedback is that of a model which is not known there.) Then the speeds before and
 * after are made anew, within what brake and drive can do and the accelerations that the line has
 * itself (Lipp and Boyd, "Minimum-time speed optimisation over a fixed path", 2014).
 *
 * Plans are judged by the same distance (see br_step.c).
 */
#include <float.h>

#include "br_internal.h"

#if BR_HAS_PATH

#define SLOWER 0.93 /* speed of a trial over that of the one before */
#define STEPS 8     /* in which the state at the line's speed is approached from a slow one */
#define ROUNDS 2    /* by Gauss and Newton, for the state at a speed */

enum { OF_VY = 1, OF_OMEGA = 2 }; /* outputs of the residual */

enum {
    FREE = 3, /* what is sought of a state: lateral velocity, steering angle, drive command */
    PLACES = BR_N < BR_COLUMNS ? BR_N : BR_COLUMNS /* whose variances are made together */
};

static const int sought[FREE] = {BR_INDEX_VY, BR_INDEX_DELTA, BR_NX + BR_INDEX_DUTY};
static const int going[FREE] = {BR_INDEX_VX, BR_INDEX_VY, BR_INDEX_OMEGA};
/* As shares of the deviations that caution weighs equally: errors of a stage and distances from the
 * guess that weigh the same, and the longest step of a round. */
static const double error_share = 0.002, guess_share[FREE] = {0.5, 0.2, 1.0};
static const double longest_share[FREE] = {0.1, 0.05, 0.5};

/* A place of the line, and the car's state [x; u] there, of which position and heading do not
 * matter. */
typedef struct {
    double speed, acceleration, curvature; /* of the line */
    double room;                           /* that errors may take of half the track's width */
    double v[BR_NV];
    double off;   /* of the line, by the trial before; */
    double known; /* the speed of this one, */
    int decided;  /* which is the last */
} place_on_line;

/* Solves m x = b, m symmetric and positive definite; x in place of b. */
static void solve_small(double m[FREE][FREE], double b[FREE]) {
    for (int a = 0; a < FREE; ++a)
        for (int c = 0; c < FREE; ++c) {
            if (c == a) continue;
            const double factor = m[c][a] / m[a][a];
            for (int j = a; j < FREE; ++j) m[c][j] -= factor * m[a][j];
            b[c] -= factor * b[a];
        }
    for (int a = 0; a < FREE; ++a) b[a] /= m[a][a];
}

/* One round: the state nearer to going on as the line does, and near to the guess in what the model
 * leaves open, as the one without correction does with the steering angle. */
static void improve_state(const br_mpc *mpc, const br_gp *gp, place_on_line *at, double gained,
                          const double guess[FREE]) {
    const br_mpc_parameters *p = &mpc->parameters;
    br_stage stage;
    const double wanted[FREE] = {gained, 0, gained * at->curvature};
    const double unit[FREE] = {BR_STATE_DEVIATION[BR_INDEX_VY], BR_STATE_DEVIATION[BR_INDEX_DELTA],
                               BR_INPUT_EFFORT[BR_INDEX_DUTY]};
    double m[FREE][FREE] = {{0}}, b[FREE], row[FREE];
    br_stage_linearise(gp, at->v, at->v + BR_NX, &stage);
    for (int a = 0; a < FREE; ++a) {
        const double size = guess_share[a] * unit[a];
        m[a][a] = 1 / (size * size);
        b[a] = -m[a][a] * (at->v[sought[a]] - guess[a]);
    }
    for (int i = 0; i < FREE; ++i) {
        const double size = error_share * BR_STATE_DEVIATION[going[i]];
        const double error = (stage.f[going[i]] - at->v[going[i]] - wanted[i]) / size;
        for (int a = 0; a < FREE; ++a)
            row[a] = (stage.jacobian[going[i]][sought[a]] - (sought[a] == going[i])) / size;
        for (int a = 0; a < FREE; ++a) {
            b[a] -= row[a] * error;
            for (int c = 0; c < FREE; ++c) m[a][c] += row[a] * row[c];
        }
    }
    solve_small(m, b);
    const double most[FREE] = {at->v[BR_INDEX_VX], p->delta_max_rad, p->d_max};
    const double least[FREE] = {-at->v[BR_INDEX_VX], -p->delta_max_rad, p->d_min};
    for (int a = 0; a < FREE; ++a) {
        const double longest = longest_share[a] * unit[a];
        const double step = fmin(fmax(b[a], -longest), longest);
        at->v[sought[a]] = fmin(fmax(at->v[sought[a]] + step, least[a]), most[a]);
    }
}

/* The car's state at a speed, from that at one a little lower or higher. */
static void seek_state(const br_mpc *mpc, const br_gp *gp, place_on_line *at, double speed) {
    const double bend = at->curvature * speed * speed, share = speed / at->speed;
    const double guess[FREE] = {
        0, atan(BR_WHEELBASE_M * at->curvature) + BR_BRAKING_UNDERSTEER_S2PM * bend, 0};
    at->v[BR_INDEX_VX] = speed;
    at->v[BR_INDEX_OMEGA] = speed * at->curvature;
    for (int round = 0; round < ROUNDS; ++round)
        improve_state(mpc, gp, at, BR_TS * at->acceleration * share * share, guess);
}

/* The same at the line's speed: from that of a slow car, which rolls as its wheels point. */
static void begin_state(const br_mpc *mpc, const br_gp *gp, place_on_line *at) {
    memset(at->v, 0, sizeof at->v);
    at->v[BR_INDEX_DELTA] = atan(BR_WHEELBASE_M * at->curvature);
    for (int step = 0; step <= STEPS; ++step) {
        const double share = BR_CAUTION_LEAST + (1 - BR_CAUTION_LEAST) * step / STEPS;
        seek_state(mpc, gp, at, share * at->speed);
    }
}

/* How far a car gets from its line where each stage errs by these standard deviations until
 * feedback has noticed. Errors of the yaw rate and of the lateral velocity add up to accelerations
 * sigma / Ts. */
static double off_line(const br_mpc *mpc, double speed, const double sigma[BR_NE]) {
    const double t = BR_CAUTION_NOTICE_S, turned = speed * sigma[OF_OMEGA] * t / 3;
    return mpc->parameters.caution_sigmas * hypot(sigma[OF_VY], turned) * t * t / (2 * BR_TS);
}

/* Judges the speed of the trial by the variance there, and sets the next one. The last one is
 * interpolated: the distance grows by about a power of the speed. */
static void try_slower(const br_mpc *mpc, const br_gp *gp, const double variance[BR_NE],
                       place_on_line *at) {
    double sigma[BR_NE];
    for (int j = 0; j < BR_NE; ++j) sigma[j] = sqrt(br_latent(gp, j, variance[j]));
    const double off = off_line(mpc, at->known, sigma), before = at->off;
    at->off = off;
    at->decided = 1;
    if (off <= at->room) {
        if (at->known < at->speed)
            at->known *= pow(SLOWER, fmax(log(off / at->room) / log(before / off), -1));
    } else if (at->known * SLOWER > fmax(BR_CAUTION_LEAST * at->speed, DBL_MIN)) {
        at->known *= SLOWER;
        at->decided = 0;
    }
}

/* Speeds that are known well enough, of so many places. */
static void known_speeds(br_mpc *mpc, const br_gp *gp, int places, place_on_line at[PLACES]) {
    /* With one buffer nothing is staged beside the steps, whose memory this then may use. */
#if BR_WEIGHT_BUFFERS == 1
    double (*work)[BR_COLUMNS] = mpc->caution.correlations;
#else
    BR_ALIGNED double work[BR_GP_ROOT][BR_COLUMNS];
#endif
    double x[PLACES][BR_NX], u[PLACES][BR_NU], variance[PLACES][BR_NE];
    for (int i = 0; i < places; ++i) begin_state(mpc, gp, &at[i]);
    for (int left = places; left;) {
        for (int i = 0; i < places; ++i) {
            memcpy(x[i], at[i].v, sizeof x[i]);
            memcpy(u[i], at[i].v + BR_NX, sizeof u[i]);
        }
        br_stages_variances(gp, places, x, u, work, variance);
        for (int i = 0; i < places; ++i) {
            if (at[i].decided) continue;
            try_slower(mpc, gp, variance[i], &at[i]);
            if (at[i].decided)
                --left;
            else
                seek_state(mpc, gp, &at[i], at[i].known);
        }
    }
}

double br_straight_acceleration(const br_gp *gp, double speed, double duty) {
    double x[BR_NX] = {0}, u[BR_NU] = {0}, next[BR_NX];
    x[BR_INDEX_VX] = speed;
    u[BR_INDEX_DUTY] = duty;
    br_stage_advance(gp, x, u, BR_TS, next);
    return (next[BR_INDEX_VX] - speed) / BR_TS;
}

/* Half of what the squared speed of the line changes from a row to another, over their distance. */
static double line_acceleration(const br_path *path, int from, int rows) {
    const double v = path->table[from % path->n][BR_LINE_SPEED];
    const double next = path->table[(from + rows) % path->n][BR_LINE_SPEED];
    return (next * next - v * v) / (2 * rows * path->spacing);
}

/* The largest acceleration along the line, which stands for the car's grip. */
static double grip_of(const br_path *path) {
    double grip = 0;
    for (int i = 0; i < path->n; ++i) {
        const double v = path->table[i][BR_LINE_SPEED];
        const double across = br_path_curvature(path, i * path->spacing) * v * v;
        grip = fmax(grip, hypot(across, line_acceleration(path, i, 1)));
    }
    return grip;
}

/* Lowers speeds until the car gets from row to row: backwards by the brake, then forwards by the
 * drive; twice round, as the line is closed. */
static void connect(const br_mpc *mpc, const br_gp *gp, double *speed) {
    const br_path *path = &mpc->path;
    const int n = path->n;
    const double grip = grip_of(path);
    for (int way = -1; way <= 1; way += 2)
        for (int step = 0; step < 2 * n; ++step) {
            const int i = way > 0 ? step % n : (2 * n - step) % n, next = (i + way + n) % n;
            const double v = speed[i];
            if (speed[next] <= v) continue;
            const double across = br_path_curvature(path, i * path->spacing) * v * v;
            const double along = sqrt(fmax(grip * grip - across * across, 0));
            const double duty = way > 0 ? mpc->parameters.d_max : mpc->parameters.d_min;
            const double own = way * line_acceleration(path, way > 0 ? i : next, 1);
            const double able =
                fmax(fmin(way * br_straight_acceleration(gp, v, duty), along), fmax(own, 0));
            speed[next] = fmin(speed[next], sqrt(v * v + 2 * path->spacing * able));
        }
}

void br_limit_speeds(br_mpc *mpc, int buffer) {
    br_path *path = &mpc->path;
    const br_gp *gp = &mpc->gp[buffer];
    double *speed = path->speed[buffer];
    if (!path->ready) return;
    for (int i = 0; i < path->n; ++i) speed[i] = path->table[i][BR_LINE_SPEED];
    if (!gp->uncertain || !mpc->caution.wanted) return;
    const int every = (int)fmax(round(BR_WHEELBASE_M / path->spacing), 1);
    int limited = 0;
    for (int first = 0; first < path->n; first += PLACES * every) {
        place_on_line at[PLACES];
        int places = 0;
        for (int row = first; row < path->n && places < PLACES; row += every) {
            const double *here = path->table[row];
            const double norm = hypot(here[BR_LINE_NORMAL_X], here[BR_LINE_NORMAL_Y]);
            at[places++] = (place_on_line){
                .speed = here[BR_LINE_SPEED],
                .known = here[BR_LINE_SPEED],
                .acceleration = line_acceleration(path, row, every),
                .curvature = br_path_curvature(path, row * path->spacing),
                .room = BR_CAUTION_SHARE * 0.5 * (here[BR_LINE_UPPER] - here[BR_LINE_LOWER]) / norm,
            };
        }
        known_speeds(mpc, gp, places, at);
        for (int i = 0; i < places; ++i)
            for (int k = -every + 1; k < every && at[i].known < at[i].speed; ++k) {
                double *near = &speed[(first + i * every + k + path->n) % path->n];
                *near = fmin(*near, at[i].known);
                limited = 1;
            }
    }
    if (limited) connect(mpc, gp, speed);
}

double br_plan_unknown(br_mpc *mpc, const br_plan *plan) {
    const br_gp *gp = &mpc->gp[mpc->gp_in_use];
    double x[BR_N][BR_NX], u[BR_N][BR_NU], variance[BR_N][BR_NE], most = 0;
    if (!mpc->caution.active || !mpc->caution.wanted || mpc->turn) return 0;
    memcpy(x, plan->x, sizeof x);
    memcpy(u, plan->u, sizeof u);
    br_stages_variances(gp, BR_N, x, u, mpc->caution.correlations, variance);
    for (int k = 0; k < BR_N; ++k) {
        const double width = mpc->reference[k].upper - mpc->reference[k].lower;
        double phi[BR_NPHI], sigma[BR_NE];
        br_mismatch_terms(x[k], u[k], plan->x[k + 1], 1, phi);
        for (int j = 0; j < BR_NE; ++j)
            sigma[j] = sqrt(br_latent(gp, j, variance[k][j]) + br_mismatch_variance(mpc, phi, j));
        most = br_worse(most,
                        off_line(mpc, x[k][BR_INDEX_VX], sigma) / (BR_CAUTION_SHARE * 0.5 * width));
    }
    return most;
}

#endif
