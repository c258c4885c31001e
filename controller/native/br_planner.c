/* Motion planner: projection on the racing line, then the recursion in the line's speed
 * (paper section 4.3): theta_k = theta_{k-1} + Ts v_r(theta_{k-1}). A problem that maximises
 * progress has, in place of the recursion, the feet of the plan's own positions.
 *
 * The path is a table over the closed line's arc length; between rows everything is linear, which
 * at the default 5 mm costs less than .02 mm. The search starts where the car was a step ago and
 * looks no farther than a window, so that it never jumps to a neighbouring piece of the track. All
 * lengths and speeds (BR_PATH_...) are the car's, from its file. Below: braking along the line, and
 * turning round.
 */
#include "br_internal.h"

#if BR_HAS_PATH

/* Share of the line's speed. A plan that maximises progress does not drive the line, and its own
 * tube slows it down: what little is not known of that speed does not make it follow the line. */
#define NEARLY_KNOWN 0.95

typedef struct {
    double left_m;    /* of the line */
    double middle_m;  /* of the track, to the left of the line */
    double outside_m; /* of the track less its margin; negative inside */
    double speed_mps; /* of the line */
} place;

br_mpc_error br_path_load(br_path *path, const double *table, int n, double spacing) {
    if (n < 8 || n > BR_PATH_CAPACITY) return BR_ERROR_PATH;
    if (!(spacing >= BR_PATH_SPACING_MIN_M && spacing <= BR_PATH_SPACING_MAX_M))
        return BR_ERROR_PATH;
    if (!br_all_finite(table, n * BR_PATH_COLUMNS)) return BR_ERROR_PATH;
    for (int i = 0; i < n; ++i) {
        const double *row = &table[i * BR_PATH_COLUMNS];
        const double norm = hypot(row[BR_LINE_NORMAL_X], row[BR_LINE_NORMAL_Y]);
        const double *next = &table[(i + 1) % n * BR_PATH_COLUMNS];
        if (fabs(row[BR_LINE_X]) > BR_PATH_FAR_M || fabs(row[BR_LINE_Y]) > BR_PATH_FAR_M)
            return BR_ERROR_PATH;
        if (row[BR_LINE_SPEED] <= 0 || row[BR_LINE_SPEED] > BR_PATH_SPEED_MAX_MPS)
            return BR_ERROR_PATH;
        if (row[BR_LINE_UPPER] <= row[BR_LINE_LOWER] || fabs(norm - 1) > 1e-6) return BR_ERROR_PATH;
        if (next[BR_LINE_X] == row[BR_LINE_X] && next[BR_LINE_Y] == row[BR_LINE_Y])
            return BR_ERROR_PATH; /* no direction there */
    }
    memcpy(path->table, table, (size_t)n * sizeof path->table[0]);
    path->n = n;
    path->spacing = spacing;
    path->length = n * spacing;
    path->known = 0;
    path->ready = 1;
    return BR_OK;
}

static int wrap_index(int i, int n) {
    i %= n;
    return i < 0 ? i + n : i;
}

static double wrap_length(double s, double length) {
    s = fmod(s, length);
    return s < 0 ? s + length : s;
}

/* The row of the table before arc length s, and how far s is on the way to the next one. */
static int row_before(const br_path *path, double s, double *share) {
    const double position = wrap_length(s, path->length) / path->spacing;
    int i = (int)position;
    if (i >= path->n) i = path->n - 1;
    *share = position - i;
    return i;
}

/* Row of the table at arc length s, interpolated. */
static void path_at(const br_path *path, double s, double row[BR_PATH_COLUMNS]) {
    double w;
    const int i = row_before(path, s, &w);
    const double *a = path->table[i], *b = path->table[wrap_index(i + 1, path->n)];
    for (int c = 0; c < BR_PATH_COLUMNS; ++c) row[c] = a[c] + w * (b[c] - a[c]);
}

static double squared_distance(const double *row, const double x[BR_NX]) {
    const double dx = row[BR_LINE_X] - x[BR_INDEX_X], dy = row[BR_LINE_Y] - x[BR_INDEX_Y];
    return dx * dx + dy * dy;
}

static int same_direction(const br_path *path, int i, double psi) {
    const double *a = path->table[i], *b = path->table[wrap_index(i + 1, path->n)];
    return (b[BR_LINE_X] - a[BR_LINE_X]) * cos(psi) + (b[BR_LINE_Y] - a[BR_LINE_Y]) * sin(psi) > 0;
}

/* Nearest row anywhere; one that leads another way than the car points counts as a track's width
 * farther, so that a car is not taken for one on the piece of track beside its own. */
static int nearest_anywhere(const br_path *path, const double x[BR_NX]) {
    int best = 0;
    double best_distance = INFINITY;
    for (int i = 0; i < path->n; ++i) {
        const double *row = path->table[i];
        double distance = sqrt(squared_distance(row, x));
        if (!same_direction(path, i, x[BR_INDEX_PSI]))
            distance += row[BR_LINE_UPPER] - row[BR_LINE_LOWER];
        if (distance < best_distance) {
            best = i;
            best_distance = distance;
        }
    }
    return best;
}

/* The same near arc length s. */
static int nearest_near(const br_path *path, double s, const double x[BR_NX]) {
    const int start = (int)((s - BR_PATH_WINDOW_BACK_M) / path->spacing);
    int count = (int)((BR_PATH_WINDOW_BACK_M + BR_PATH_WINDOW_AHEAD_M) / path->spacing) + 1,
        best = start;
    if (count > path->n) count = path->n;
    double best_d2 = INFINITY;
    for (int i = start; i < start + count; ++i) {
        const double d2 = squared_distance(path->table[wrap_index(i, path->n)], x);
        if (d2 < best_d2) {
            best = i;
            best_d2 = d2;
        }
    }
    return wrap_index(best, path->n);
}

/* Foot of the perpendicular on the two segments that meet at row i. */
static void project(const br_path *path, int i, const double x[BR_NX], double *s, double *lateral) {
    double best_d2 = INFINITY;
    for (int k = -1; k <= 0; ++k) {
        const int j = wrap_index(i + k, path->n);
        const double *a = path->table[j], *b = path->table[wrap_index(j + 1, path->n)];
        const double tx = b[BR_LINE_X] - a[BR_LINE_X], ty = b[BR_LINE_Y] - a[BR_LINE_Y];
        const double px = x[BR_INDEX_X] - a[BR_LINE_X], py = x[BR_INDEX_Y] - a[BR_LINE_Y];
        double w = (px * tx + py * ty) / (tx * tx + ty * ty);
        w = w < 0 ? 0 : (w > 1 ? 1 : w);
        const double ex = px - w * tx, ey = py - w * ty, d2 = ex * ex + ey * ey;
        if (d2 < best_d2) {
            best_d2 = d2;
            *s = wrap_length((j + w) * path->spacing, path->length);
            *lateral = copysign(sqrt(d2), tx * py - ty * px);
        }
    }
}

/* Where the line is, this far ahead of the car's last projection. */
static void path_ahead(const br_path *path, double distance, double point[2]) {
    double row[BR_PATH_COLUMNS];
    path_at(path, path->s + distance, row);
    point[0] = row[BR_LINE_X];
    point[1] = row[BR_LINE_Y];
}

/* Direction of the line, by a chord. */
static double path_heading(const br_path *path, double s) {
    double a[BR_PATH_COLUMNS], b[BR_PATH_COLUMNS];
    path_at(path, s - BR_BRAKING_CHORD_M / 2, a);
    path_at(path, s + BR_BRAKING_CHORD_M / 2, b);
    return atan2(b[BR_LINE_Y] - a[BR_LINE_Y], b[BR_LINE_X] - a[BR_LINE_X]);
}

/* Its curvature, by two of them. */
double br_path_curvature(const br_path *path, double s) {
    const double h = BR_BRAKING_CHORD_M / 2;
    const double turned = path_heading(path, s + h) - path_heading(path, s - h);
    return remainder(turned, 2 * M_PI) / (2 * h);
}

/* Where a state is beside the line, sought near *s_m, which follows; below 0: anywhere. */
static void path_beside(const br_path *path, const double x[BR_NX], double *s_m, place *beside) {
    double row[BR_PATH_COLUMNS];
    const int nearest = *s_m < 0 ? nearest_anywhere(path, x) : nearest_near(path, *s_m, x);
    project(path, nearest, x, s_m, &beside->left_m);
    path_at(path, *s_m, row);
    const double norm = hypot(row[BR_LINE_NORMAL_X], row[BR_LINE_NORMAL_Y]);
    const double heading = path_heading(path, *s_m);
    const double leftwards =
        row[BR_LINE_NORMAL_Y] * cos(heading) - row[BR_LINE_NORMAL_X] * sin(heading);
    const double line =
        row[BR_LINE_NORMAL_X] * row[BR_LINE_X] + row[BR_LINE_NORMAL_Y] * row[BR_LINE_Y];
    const double car =
        row[BR_LINE_NORMAL_X] * x[BR_INDEX_X] + row[BR_LINE_NORMAL_Y] * x[BR_INDEX_Y];
    const double middle = (row[BR_LINE_LOWER] + row[BR_LINE_UPPER]) / 2 - line;
    beside->middle_m = copysign(1, leftwards) * middle / norm;
    beside->outside_m = fmax(row[BR_LINE_LOWER] - car, car - row[BR_LINE_UPPER]) / norm;
    beside->speed_mps = row[BR_LINE_SPEED];
}

/* Where the car is on the line: path->s, and its distance to the left. */
void br_path_project(br_path *path, const double x[BR_NX], double *lateral) {
    double s, row[BR_PATH_COLUMNS];
    const double moved = path->age * hypot(x[BR_INDEX_VX], x[BR_INDEX_VY]);
    if (moved > 0.8 * BR_PATH_WINDOW_AHEAD_M) path->known = 0; /* may have left the window */
    path->age = 0;
    project(path, path->known ? nearest_near(path, path->s, x) : nearest_anywhere(path, x), x, &s,
            lateral);
    path_at(path, s, row);
    if (path->known &&
        fabs(*lateral) > row[BR_LINE_UPPER] - row[BR_LINE_LOWER]) /* lost: off by a track's width */
        project(path, nearest_anywhere(path, x), x, &s, lateral);
    path->s = s;
    path->known = 1;
}

static br_mpc_reference stage_at(const double row[BR_PATH_COLUMNS]) {
    const double norm = hypot(row[BR_LINE_NORMAL_X], row[BR_LINE_NORMAL_Y]);
    return (br_mpc_reference){
        .x = row[BR_LINE_X],
        .y = row[BR_LINE_Y],
        .normal_x = row[BR_LINE_NORMAL_X] / norm,
        .normal_y = row[BR_LINE_NORMAL_Y] / norm,
        .lower = row[BR_LINE_LOWER] / norm,
        .upper = row[BR_LINE_UPPER] / norm,
    };
}

/* What of the line's speed at arc length s the weights in use know. */
static double known_speed(const br_path *path, double s) {
    const double *speed = path->speed[path->buffer];
    double w;
    const int i = row_before(path, s, &w);
    return speed[i] + w * (speed[wrap_index(i + 1, path->n)] - speed[i]);
}

/* The same at this pace, but no slower than a car that knows nothing. */
static double reference_speed(const br_path *path, double pace, double s) {
    double row[BR_PATH_COLUMNS];
    path_at(path, s, row);
    return fmax(pace * known_speed(path, s), fmin(pace, BR_CAUTION_LEAST) * row[BR_LINE_SPEED]);
}

double br_path_pace(const br_path *path, double pace) {
    double row[BR_PATH_COLUMNS];
    if (!path->ready) return pace;
    path_at(path, path->s, row);
    return fmin(reference_speed(path, pace, path->s) / row[BR_LINE_SPEED], 1);
}

#if BR_FOLLOWS_PLAN
int br_path_known_ahead(const br_path *path) {
    double s = path->s, row[BR_PATH_COLUMNS];
    for (int k = 0; k < BR_N; ++k) {
        path_at(path, s, row);
        if (known_speed(path, s) < NEARLY_KNOWN * row[BR_LINE_SPEED]) return 0;
        s += BR_TS * row[BR_LINE_SPEED];
    }
    return 1;
}
#endif

/* Points to track: the recursion in the line's speed, of which pace is a share, from the car's
 * projection on. */
void br_path_plan(const br_path *path, double pace, br_mpc_reference reference[BR_N]) {
    double s = path->s, row[BR_PATH_COLUMNS];
    for (int k = 0; k < BR_N; ++k) {
        const double limit = path->speed_limit - k * BR_TS * path->speed_limit_rate;
        s += BR_TS * fmax(fmin(reference_speed(path, pace, s), limit), 0);
        path_at(path, s, row);
        reference[k] = stage_at(row);
    }
}

#if BR_FOLLOWS_PLAN

/* Row nearest to the state, downhill from row i. */
static int nearest_from(const br_path *path, int i, const double x[BR_NX]) {
    double here = squared_distance(path->table[i], x);
    for (int way = 1; way >= -1; way -= 2)
        for (int moved = 0; moved < path->n; ++moved) {
            const int j = wrap_index(i + way, path->n);
            const double there = squared_distance(path->table[j], x);
            if (!(there < here)) break;
            here = there;
            i = j;
        }
    return i;
}

/* Direction of the line at arc length s, and its curvature. */
static double direction_at(const br_path *path, double s, double tangent[2]) {
    double a[BR_PATH_COLUMNS], b[BR_PATH_COLUMNS], c[BR_PATH_COLUMNS];
    const double h = path->spacing;
    path_at(path, s - h, a);
    path_at(path, s, b);
    path_at(path, s + h, c);
    const double dx = c[BR_LINE_X] - a[BR_LINE_X], dy = c[BR_LINE_Y] - a[BR_LINE_Y],
                 length = hypot(dx, dy);
    tangent[0] = dx / length;
    tangent[1] = dy / length;
    const double ddx = c[BR_LINE_X] - 2 * b[BR_LINE_X] + a[BR_LINE_X],
                 ddy = c[BR_LINE_Y] - 2 * b[BR_LINE_Y] + a[BR_LINE_Y];
    return (tangent[0] * ddy - tangent[1] * ddx) / (h * h);
}

/* Bounds hold at the stages alone. Between two of them the way is nearly straight, and the edge
 * inside a bend comes nearer to it than at either, by an eighth of the way times the angle by which
 * the edge turns. So the bound inside is that much nearer, by a quarter of the room at most. */
static void stay_inside_between(const br_plan *plan, br_mpc_reference reference[BR_N]) {
    double nearer[BR_N];
    for (int k = 0; k < BR_N; ++k) {
        const br_mpc_reference *a = &reference[k > 0 ? k - 1 : k];
        const br_mpc_reference *b = &reference[k < BR_N - 1 ? k + 1 : k];
        const int stages = (int)(b - a);
        const double turn = (a->normal_x * b->normal_y - a->normal_y * b->normal_x) / stages;
        const double way = hypot(plan->x[k + 1][BR_INDEX_X] - plan->x[k][BR_INDEX_X],
                                 plan->x[k + 1][BR_INDEX_Y] - plan->x[k][BR_INDEX_Y]);
        const double most = 0.25 * (reference[k].upper - reference[k].lower);
        nearer[k] = fmax(fmin(way * turn / 8, most), -most);
    }
    /* Above 0: a bend to the left, whose inside is the upper bound. */
    for (int k = 0; k < BR_N; ++k)
        if (nearer[k] > 0)
            reference[k].upper -= nearer[k];
        else
            reference[k].lower -= nearer[k];
}

/* The stages where the plan itself is on the line. Each is sought from the one before, the first
 * from the car: where another measurement leads to another first one, all are sought again. */
void br_path_follow(br_mpc *mpc) {
    const br_path *path = &mpc->path;
    if (!mpc->follows) return;
    const int car = (int)(wrap_length(path->s, path->length) / path->spacing) % path->n;
    int i = nearest_from(path, car, mpc->plan.x[1]);
    if (mpc->valid[BR_FOLLOWED] && i == mpc->first_row) return;
    br_invalidate(mpc, BR_FACTORS);
    mpc->valid[BR_FOLLOWED] = 1;
    mpc->first_row = i;
    for (int k = 0; k < BR_N; ++k) {
        const double *x = mpc->plan.x[k + 1];
        double s, lateral, row[BR_PATH_COLUMNS], tangent[2];
        i = nearest_from(path, i, x);
        project(path, i, x, &s, &lateral);
        path_at(path, s, row);
        const double curvature = direction_at(path, s, tangent);
        br_mpc_reference *stage = &mpc->reference[k];
        *stage = stage_at(row);
        stage->follows = 1;
        const double pace = 1 / (fmax(1 - curvature * lateral, 0.2) * row[BR_LINE_SPEED]);
        stage->pace_x = pace * tangent[0];
        stage->pace_y = pace * tangent[1];
    }
    stay_inside_between(&mpc->plan, mpc->reference);
}

#endif

/* Braking along the line: how a car that slows down to standstill is steered, whatever went wrong.
 *
 * Pure pursuit in the frame of the line (Coulter, "Implementation of the pure pursuit path tracking
 * algorithm", 1992), as the training drive has it (controller/pure_pursuit.py): the car steers as
 * the line bends, and on the circle through a point ahead that takes it back. A car that is slower
 * than the line has room to spare, so it is drawn to the middle of the track. All numbers
 * (BR_BRAKING_...) are the car's, from its file. */
br_mpc_error br_steer(const br_mpc *mpc, const double x[BR_NX], double *s_m, double *angle_rad,
                      double *outside_m) {
    if (!x || !s_m || !angle_rad || !outside_m) return BR_ERROR_NULL;
    if (!mpc->has_parameters || !mpc->path.ready) return BR_ERROR_NOT_READY;
    if (!br_plausible_state(x)) return BR_ERROR_STATE;
    const br_mpc_parameters *p = &mpc->parameters;
    const double vx = fmax(x[BR_INDEX_VX], 0), vy = x[BR_INDEX_VY];
    place here;
    path_beside(&mpc->path, x, s_m, &here);
    *outside_m = here.outside_m;

    const double share = vx / here.speed_mps;
    const double middle = BR_BRAKING_CENTRE * fmax(1 - share * share, 0) * here.middle_m;
    const double reach = BR_BRAKING_LOOKAHEAD_M + BR_BRAKING_LOOKAHEAD_S * vx;
    const double sideways = asin(fmin(fmax((here.left_m - middle) / reach, -1), 1));
    const double heading = path_heading(&mpc->path, *s_m);
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

/* Turning round: what the planner does where the car is slow and points away from its line.
 *
 * A horizon is too short for a turn to pay: whichever way the car sets off, it first gets farther
 * from the reference, and the optimal plan is to stand still for ever. So the reference runs
 * along the turn itself: where the corrected model goes when it steers to one side at a walking
 * pace until it faces the line again. The track's edges do not count on the way; the car may
 * have been across one already, and its turning circle can be wider than the track. All numbers
 * (BR_TURN_...) are the car's, from its file.
 */

/* A reward of progress along the line leads a car back that points aside, but not one that points
 * the other way. */
#define BEGIN_RAD (BR_FOLLOWS_PLAN ? BR_TURN_BEHIND_RAD : BR_TURN_AWAY_RAD)

/* No car that may drive stands for so long on purpose; slower than this share of a walking pace it
 * counts as standing, and it has begun to roll at that one. */
#define STUCK_S 0.5
#define STANDING 0.25
#define ROLLING 0.5

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
    path_ahead(path, 0, here);
    path_ahead(path, BR_TURN_TANGENT_M, next);
    here[BR_INDEX_PSI] = atan2(next[1] - here[1], next[0] - here[0]);
    return bearing(here, to);
}

/* Whether the target is far to one side, farther than for a car on the line. One that has stood for
 * too long need not be so far off. */
static int to_one_side(const br_mpc *mpc, double away, const double target[2]) {
    const double begin = mpc->stood > STUCK_S ? BR_TURN_FACED_RAD : BEGIN_RAD;
    if (fabs(away) <= begin) return 0;
    return fabs(remainder(away - bearing_on_line(&mpc->path, target), 2 * M_PI)) > begin;
}

/* Begins, goes on with and ends a turn, of a slow or turning car. */
static void decide(br_mpc *mpc, const double target[2]) {
    const double *x = mpc->x0, away = bearing(x, target), speed = fabs(x[BR_INDEX_VX]);
    if (mpc->path.speed_limit < BR_TURN_STOP_MPS || speed > BR_TURN_TOO_FAST_MPS) {
        mpc->turn = 0;
    } else if (mpc->turn) {
        if (remaining(mpc->turn, away) < BR_TURN_FACED_RAD) mpc->turn = 0;
    } else if (to_one_side(mpc, away, target)) {
        mpc->turn = side(x, away, &mpc->reference[0]);
        mpc->warm = 0;
    }
}

static double walking_pace(const br_mpc *mpc) {
    return fmin(BR_TURN_PACE_MPS, mpc->path.speed_limit);
}

/* The input of a stage that steers to an angle at a walking pace, and where it leads. */
static void lead(br_mpc *mpc, int k, double angle, double x[BR_NX]) {
    const br_mpc_parameters *p = &mpc->parameters;
    const double steering = fmax(fmin(angle, p->delta_max_rad), -p->delta_max_rad);
    const double rate = (steering - x[BR_INDEX_DELTA]) / BR_TS;
    const double throttle = BR_TURN_THROTTLE_SPM * (walking_pace(mpc) - x[BR_INDEX_VX]);
    double *u = mpc->led_u[k], next[BR_NX];
    u[BR_INDEX_DUTY] = fmin(fmax(throttle, 0), p->d_max);
    u[BR_INDEX_DELTA_RATE] = fmin(fmax(rate, -p->delta_rate_max_radps), p->delta_rate_max_radps);
    br_stage_advance(&mpc->gp[mpc->gp_in_use], x, u, BR_TS, next);
    memcpy(x, next, sizeof next);
}

/* A standing car has the same problem in each cycle. If no optimisation finds a plan, or the best
 * one is to stay, to drive off later, or backwards, it would stand for ever: so it creeps, steered
 * as the braking plan is, or round. */
int br_creep(br_mpc *mpc) {
    double x[BR_NX], s_m = -1, angle = 0, outside_m;
    if (mpc->own_reference) return 0;
    if (mpc->turn) return 1;
    if (mpc->x0[BR_INDEX_VX] >= walking_pace(mpc)) return 0;
    memcpy(x, mpc->x0, sizeof x);
    for (int k = 0; k < BR_N; ++k) {
        if (br_steer(mpc, x, &s_m, &angle, &outside_m)) return 0;
        lead(mpc, k, angle, x);
    }
    return 1;
}

void br_note_standing(br_mpc *mpc) {
    const double share = mpc->x0[BR_INDEX_VX] / fmax(walking_pace(mpc), BR_TURN_STOP_MPS);
    const int may_drive = mpc->path.speed_limit >= BR_TURN_STOP_MPS;
    const int stands = may_drive && share < STANDING;                 /* or rolls backwards */
    mpc->stood = stands ? mpc->stood + fmin(mpc->elapsed, BR_TS) : 0; /* a gap says nothing */
    mpc->stuck = mpc->stood > STUCK_S || (mpc->stuck && may_drive && share < ROLLING);
}

void br_turnaround(br_mpc *mpc) {
    double target[2], x[BR_NX];
    if (!mpc->turn && fabs(mpc->x0[BR_INDEX_VX]) >= BR_TURN_SLOW_MPS) return;
    path_ahead(&mpc->path, BR_TURN_AHEAD_M, target);
    decide(mpc, target);
    if (!mpc->turn) return;
    memcpy(x, mpc->x0, sizeof x);
    for (int k = 0; k < BR_N; ++k) {
        lead(mpc, k, mpc->turn * remaining(mpc->turn, bearing(x, target)), x);
        br_mpc_reference *reference = &mpc->reference[k];
        reference->x = x[BR_INDEX_X];
        reference->y = x[BR_INDEX_Y];
        reference->lower -= BR_TURN_WIDER_M;
        reference->upper += BR_TURN_WIDER_M;
    }
}

#endif
