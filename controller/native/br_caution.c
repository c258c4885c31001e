/* Caution: the car is slowed down by what the residual's posterior does not know.
 *
 * The residual is one unknown function, and a posterior of smooth functions errs in the same
 * direction for as long as the plan stays where it is uncertain. So the errors of a plan's stages
 * are taken as fully correlated: with sigma_j(z_k) the standard deviation of output j at stage k, a
 * deviation D_j of the states, which feedback works against, adds up along the plan,
 *
 *   D_j,k+1 = (A_k - B_k K_k) D_j,k + F_k,j sigma_j(z_k),   D_j,0 = 0
 *
 * F_k,j is what the residual's output does to the states. An estimated state adds deviations of its
 * own that begin with the columns of L, L L' = P its covariance, and add nothing on their way. The
 * tube of a row h <= upper is n |D_k' grad h| wide to either side, with n standard deviations.
 * (Independent errors would add up to the root of the number of stages only, which is far too
 * little: docs/decisions/2026-11-23-caution.md has the laps.) K is the gain of a linear quadratic
 * regulator about the plan; the problem names the sizes of the deviations that it weighs equally.
 * sigma counts what the mean may err by, without noise, which averages out, and with what is not
 * known of the mismatch (br_mismatch.c).
 *
 * Where the tube takes too much of the room between the bounds, the reference slows down. The
 * bounds themselves stay where they are: a plan that is pushed by them does what is known even
 * less, and its tube is wider (docs/decisions/2026-11-27-caution-slows.md).
 *
 * As in zero-order robust MPC (Zanelli, Frey, Messerer, Diehl, "Zero-order robust nonlinear model
 * predictive control with ellipsoidal uncertainty sets", 2021) the deviations belong to the plan
 * that the step starts with and are constant in it: they are made in the preparation.
 */
#include "br_internal.h"

#define WIDEST 1e6 /* what is reported at most */

/* Weight of a deviation or effort of this size as 1. */
static double weight_of(double size) { return 1.0 / (size * size); }

/* S becomes Q + A' S (A - B K), with the gain K of one stage. */
static void riccati(const br_stage *stage, double s[BR_NX][BR_NX], double gain[BR_NU][BR_NX]) {
    double sa[BR_NX][BR_NV] = {{0}}, r[BR_NU][BR_NU];
    for (int i = 0; i < BR_NX; ++i)
        for (int l = 0; l < BR_NX; ++l)
            for (int j = 0; j < BR_NV; ++j) sa[i][j] += s[i][l] * stage->jacobian[l][j];
    for (int a = 0; a < BR_NU; ++a) { /* B' S [A B] */
        double row[BR_NV] = {0};
        for (int l = 0; l < BR_NX; ++l)
            for (int j = 0; j < BR_NV; ++j) row[j] += stage->jacobian[l][BR_NX + a] * sa[l][j];
        memcpy(gain[a], row, sizeof gain[a]);
        memcpy(r[a], row + BR_NX, sizeof r[a]);
        r[a][a] += weight_of(BR_INPUT_EFFORT[a]);
    }
    for (int a = 0; a < BR_NU; ++a) /* Gauss-Jordan: positive definite, no pivoting */
        for (int b = 0; b < BR_NU; ++b) {
            if (b == a) continue;
            const double factor = r[b][a] / r[a][a];
            for (int c = a; c < BR_NU; ++c) r[b][c] -= factor * r[a][c];
            for (int j = 0; j < BR_NX; ++j) gain[b][j] -= factor * gain[a][j];
        }
    for (int a = 0; a < BR_NU; ++a)
        for (int j = 0; j < BR_NX; ++j) gain[a][j] /= r[a][a];
    for (int i = 0; i < BR_NX; ++i) { /* S (A - B K), then A' of that */
        for (int j = 0; j < BR_NX; ++j)
            for (int a = 0; a < BR_NU; ++a) sa[i][j] -= sa[i][BR_NX + a] * gain[a][j];
    }
    for (int i = 0; i < BR_NX; ++i)
        for (int j = 0; j < BR_NX; ++j) {
            double sum = i == j ? weight_of(BR_STATE_DEVIATION[i]) : 0.0;
            for (int l = 0; l < BR_NX; ++l) sum += stage->jacobian[l][i] * sa[l][j];
            s[i][j] = sum;
        }
}

/* Feedback about the plan, backwards from its end. */
static void feedback(const br_mpc *mpc, double gain[BR_N][BR_NU][BR_NX]) {
    double s[BR_NX][BR_NX] = {{0}};
    for (int i = 0; i < BR_NX; ++i) s[i][i] = weight_of(BR_STATE_DEVIATION[i]);
    for (int k = BR_N - 1; k >= 0; --k) riccati(&mpc->stage[k], s, gain[k]);
}

/* One stage on: D of the output's error with this standard deviation. */
static void propagate(const br_stage *stage, double gain[BR_NU][BR_NX], int output, double sigma,
                      const double before[BR_NX], double after[BR_NX]) {
    double u[BR_NU] = {0};
    for (int a = 0; a < BR_NU; ++a)
        for (int i = 0; i < BR_NX; ++i) u[a] -= gain[a][i] * before[i];
    for (int i = 0; i < BR_NX; ++i) {
        double sum = stage->in_e[i][output] * sigma;
        for (int l = 0; l < BR_NX; ++l) sum += stage->jacobian[i][l] * before[l];
        for (int a = 0; a < BR_NU; ++a) sum += stage->jacobian[i][BR_NX + a] * u[a];
        after[i] = sum;
    }
}

/* Of the residual at the plan's stages: of evenly spread ones, between which they are interpolated,
 * so that a long horizon takes no longer. With the state observed last there are BR_COLUMNS. */
static void standard_deviations(br_mpc *mpc, double sigma[BR_N][BR_NE]) {
    enum { COUNT = BR_N < BR_COLUMNS ? BR_N : BR_COLUMNS - 1 };
    double x[COUNT + 1][BR_NX], u[COUNT + 1][BR_NU], variance[COUNT + 1][BR_NE];
    const br_transition *due = &mpc->mismatch.due;
    const int observed = br_mismatch_due(&mpc->mismatch);
    int stage[COUNT];
    for (int i = 0; i < COUNT; ++i) {
        stage[i] = COUNT > 1 ? i * (BR_N - 1) / (COUNT - 1) : 0;
        memcpy(x[i], mpc->plan.x[stage[i]], sizeof x[i]);
        memcpy(u[i], mpc->plan.u[stage[i]], sizeof u[i]);
    }
    memcpy(x[COUNT], due->x, sizeof x[COUNT]);
    memcpy(u[COUNT], due->u, sizeof u[COUNT]);
    const br_gp *gp = &mpc->gp[mpc->gp_in_use];
    br_stages_variances(gp, COUNT + observed, x, u, mpc->caution.correlations, variance);
    if (observed) br_mismatch_judge(mpc, variance[COUNT]);
    double ratio = 0;
    for (int j = 0; j < BR_NE; ++j)
        for (int i = 0; i < COUNT; ++i) {
            const double latent = br_latent(gp, j, variance[i][j]);
            const double mismatch = br_mismatch_variance(mpc, mpc->stage[stage[i]].phi, j);
            sigma[stage[i]][j] = sqrt(latent + mismatch);
            if (variance[i][j] > 0) ratio = br_worse(ratio, mismatch / variance[i][j]);
        }
    mpc->caution.widening = fmin(sqrt(1 + ratio), WIDEST);
    for (int i = 1; i < COUNT; ++i)
        for (int k = stage[i - 1] + 1; k < stage[i]; ++k) {
            const double share = (k - stage[i - 1]) / (double)(stage[i] - stage[i - 1]);
            for (int j = 0; j < BR_NE; ++j)
                sigma[k][j] =
                    sigma[stage[i - 1]][j] + share * (sigma[stage[i]][j] - sigma[stage[i - 1]][j]);
        }
}

void br_caution_reset(br_caution *caution) {
    caution->active = caution->given = caution->begins = 0;
    caution->pace = caution->widening = 1;
}

/* The covariance that was given, by columns of its lower Cholesky factor; a state that is known, or
 * follows of those before, has none. */
void br_caution_advance(br_caution *caution) {
    double (*p)[BR_NX] = caution->covariance;
    caution->begins = caution->given ? BR_NX : 0;
    memset(caution->begin, 0, sizeof caution->begin);
    for (int j = 0; j < caution->begins; ++j) {
        double *column = caution->begin[j];
        for (int i = j; i < BR_NX; ++i) {
            column[i] = p[i][j];
            for (int l = 0; l < j; ++l) column[i] -= caution->begin[l][i] * caution->begin[l][j];
        }
        const double scale = column[j] > 0 ? 1 / sqrt(column[j]) : 0;
        for (int i = j; i < BR_NX; ++i) column[i] *= scale;
    }
    caution->given = 0;
}

void br_caution_update(br_mpc *mpc) {
    const br_gp *gp = &mpc->gp[mpc->gp_in_use];
    br_caution *caution = &mpc->caution;
    if (mpc->valid[BR_TUBE]) return;
    mpc->valid[BR_TUBE] = 1;
    caution->active = mpc->parameters.caution_sigmas > 0 && gp->uncertain;
    mpc->timer.caution = 0;
    caution->widening = 1;
    if (!caution->active) return;
    const double begin = br_timer_now(&mpc->timer);
    double sigma[BR_N][BR_NE], gain[BR_N][BR_NU][BR_NX];
    standard_deviations(mpc, sigma);
    feedback(mpc, gain);
    static const double none[BR_NX] = {0};
    for (int k = 0; k < BR_N; ++k)
        for (int j = 0; j < BR_NE + caution->begins; ++j) {
            const double *first = j < BR_NE ? none : caution->begin[j - BR_NE];
            propagate(&mpc->stage[k], gain[k], j < BR_NE ? j : 0, j < BR_NE ? sigma[k][j] : 0,
                      k ? caution->deviation[k - 1][j] : first, caution->deviation[k][j]);
        }
    br_timer_note(&mpc->timer, begin, &mpc->timer.caution);
}

/* n standard deviations of the row with this gradient at the end of stage k; infinite where they
 * are not a number, as with weights whose slopes overflow on their way. */
static double half_tube(const br_mpc *mpc, int k, int r, const double *gradient) {
    double squares = 0;
    for (int j = 0; j < BR_NE + mpc->caution.begins; ++j) {
        double along = 0;
        for (int n = BR_ROW_START[r]; n < BR_ROW_START[r + 1]; ++n)
            along += gradient[n] * mpc->caution.deviation[k][j][BR_ROW_INDEX[n]];
        squares += along * along;
    }
    return squares >= 0 ? mpc->parameters.caution_sigmas * sqrt(squares) : (double)INFINITY;
}

/* The widest of the rows by stage, of the plan that the step began with. Returns the largest share
 * that one takes of the room between its bounds. A row that its penalty switches off leaves nothing
 * to be cautious about. */
static double measure_tube(const br_mpc *mpc, double tube[BR_N]) {
    double largest = 0;
    memset(tube, 0, BR_N * sizeof *tube);
    if (!mpc->caution.active || mpc->turn) return 0;
    for (int k = 0; k < BR_N; ++k)
        for (int r = 0; r < BR_NR; ++r) {
            const br_stage_terms *terms = &mpc->qp.terms[k];
            const double room = 0.5 * (terms->upper[r] - terms->lower[r]);
            if (!BR_ROW_CAUTIOUS[r] || !(mpc->qp.penalty[r] > 0) || !(room > 0)) continue;
            const double half = half_tube(mpc, k, r, terms->gradient);
            tube[k] = br_worse(tube[k], half);
            largest = br_worse(largest, half / room);
        }
    return largest;
}

void br_caution_report(br_mpc *mpc) {
#if BR_HAS_PATH
    mpc->info.pace = br_path_pace(&mpc->path, mpc->caution.pace);
#else
    mpc->info.pace = mpc->caution.pace;
#endif
    mpc->info.widening = mpc->caution.widening;
}

#if BR_HAS_PATH
/* Rate at which a car on the brake slows down, as a share of its speed [1/s]; not a number where
 * the model says none. */
static double braking_rate(const br_mpc *mpc) {
    const br_gp *gp = &mpc->gp[mpc->gp_in_use];
    const double speed = fmax(mpc->x0[BR_INDEX_VX], 1e-3);
    return -br_straight_acceleration(gp, speed, mpc->parameters.d_min) / speed;
}
#endif

/* After a step: the speed of the next reference as a share of the line's. It falls where
 * uncertainty takes more than BR_CAUTION_SHARE of the room at a stage, or is not finite, by at most
 * BR_CAUTION_SLOWER per second, and rises elsewhere by at most BR_CAUTION_FASTER, also when nothing
 * is uncertain any more: a reference that leaps ahead spoils the plan. Nor does it fall faster than
 * a car on the brake, beside what the line itself brakes: where a plan has to be slower than its
 * brakes allow, it slides. */
void br_caution_pace(br_mpc *mpc, double elapsed) {
    const double worst = measure_tube(mpc, mpc->answer_tube);
    mpc->info.tube_m = 0;
    for (int k = 0; k < BR_N; ++k)
        mpc->info.tube_m = br_worse(mpc->info.tube_m, mpc->answer_tube[k]);
#if BR_HAS_PATH
    const double excess = worst / BR_CAUTION_SHARE - 1;
    const double rate =
        excess <= 0 ? BR_CAUTION_FASTER * fmin(-2 * excess, 1)
                    : -fmin(BR_CAUTION_SLOWER * fmin(excess, 1), fmax(braking_rate(mpc), 0));
    const double pace = mpc->caution.pace * (1 + rate * fmin(elapsed, BR_TS));
    mpc->caution.pace = fmin(fmax(pace, BR_CAUTION_LEAST), 1);
#else
    (void)worst;
    (void)elapsed;
#endif
    br_caution_report(mpc);
}
