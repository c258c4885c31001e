/* Mismatch: what the corrected model still errs by, estimated while driving.
 *
 * Weights are learned of drives that are over. A car has changed since when its tyres are damp, its
 * tank is full or its wheelbase is not that of its file. Its one-step errors y show it at once: for
 * each output of the residual,
 *
 *   y = w' phi + noise of variance r,   phi = [1; z; a],
 *
 * with z the Gaussian process's features and a what a stage changes of the states that the outputs
 * are added to, by the corrected model: a car of another mass, grip or motor has its accelerations
 * scaled. This is a Bayesian linear regression that forgets (Bishop, "Pattern Recognition and
 * Machine Learning", 2006, section 3.3): weights are N(0, s^2 I) before anything is seen, in units
 * of the deviations that the problem names, and s^2 follows the evidence (3.5), so that a model
 * that is right is left as it is. Of a bend to the left alone a term that is the same to the right
 * could not be told from one that is not; terms that do not behave in a mirror as the output does
 * have smaller weights therefore. What surprises several times in a row makes the rest be
 * forgotten.
 *
 * The plan's model becomes F + F_e w' phi, and the residual's variance there the posterior's
 * without noise, plus phi' P phi with P the covariance of w, plus what the regression does not
 * explain. Where phi is farther from what was seen than usual, the mismatch is no longer linear: a
 * share of it counts as unknown, the larger the farther. r is the variance of what is measured, the
 * residual's noise, and the posterior's variance, CORRELATED times: errors of a smooth function
 * resemble each other from one stage to the next, so that many say no more than one.
 *
 * A step uses what was observed before the step before it, so that it is the same with and without
 * a preparation.
 */
#include "br_internal.h"

#define REMEMBERED_S 8.0
#define CORRELATED 10.0
#define ACCELERATION 0.1  /* of a state's deviation: what a stage changes that weighs as much */
#define ASYMMETRIC 0.1    /* size of a weight that is not the same to both sides */
#define LEAST_PRIOR 1e-4  /* s^2 over r: what says as much as nothing, ... */
#define LARGEST_PRIOR 1e6 /* ... and as much as anything */
#define NONLINEAR 0.2     /* of the mismatch, where phi is as far as usual from what was seen */
#define RECENT 10.0       /* stages over whose mean square errors are surprising, if it is ... */
#define SURPRISING 2.0    /* ... above this */
#define LARGEST 20.0      /* errors over what is usual: no single wrong measurement counts more */
#define EXPLAINED 1.5     /* mean square of errors over r up to which noise explains them */

void br_find_changed(br_mpc *mpc) {
    const br_stage *stage = &mpc->stage[0];
    for (int j = 0; j < BR_NE; ++j) {
        mpc->changed[j] = 0;
        for (int i = 1; i < BR_NX; ++i)
            if (fabs(stage->in_e[i][j]) > fabs(stage->in_e[mpc->changed[j]][j]))
                mpc->changed[j] = i;
    }
}

static double feature_size(int a) {
    return BR_FEATURE[a] < BR_NX ? BR_STATE_DEVIATION[BR_FEATURE[a]]
                                 : BR_INPUT_EFFORT[BR_FEATURE[a] - BR_NX];
}

static double change_size(int state) { return ACCELERATION * BR_STATE_DEVIATION[state]; }

/* phi of a stage's end by the corrected model. */
static void terms_of(const br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                     const double end[BR_NX], double stages, double phi[BR_NM]) {
    double z[BR_NZ];
    br_stage_features(x, u, z);
    phi[0] = 1;
    for (int a = 0; a < BR_NZ; ++a) phi[1 + a] = z[a] / feature_size(a);
    for (int l = 0; l < BR_NE; ++l) {
        const int i = mpc->changed[l];
        phi[1 + BR_NZ + l] = (end[i] - x[i]) / (stages * change_size(i));
    }
}

/* --- the regression --- */

void br_mismatch_reset(br_mismatch *mismatch) { memset(mismatch, 0, sizeof *mismatch); }

void br_mismatch_advance(br_mismatch *mismatch) {
    if (mismatch->judged) {
        mismatch->any = 1;
        for (int j = 0; j < BR_NE; ++j)
            memcpy(mismatch->weight[j], mismatch->found[j].weight, sizeof mismatch->weight[j]);
    }
    mismatch->due = mismatch->newest;
    mismatch->newest.duration = mismatch->judged = 0;
}

int br_mismatch_due(const br_mismatch *mismatch) {
    return mismatch->due.duration > 0 && !mismatch->judged;
}

void br_mismatch_undo(br_mismatch *mismatch) {
    if (mismatch->judged) memcpy(mismatch->evidence, mismatch->before, sizeof mismatch->before);
    mismatch->judged = 0;
}

/* A single error that is far from what the weights say is taken for a smaller one; several of them
 * in a row, and what was before says little of the car any more: the share of it that is kept. */
static double surprise(br_evidence *e, const double weight[BR_NM], const double phi[BR_NM],
                       double r, double stages, double *y) {
    const double usual = sqrt(fmax(e->excess, 1) * r);
    double expected = 0;
    for (int a = 0; a < BR_NM; ++a) expected += weight[a] * phi[a];
    const double error = fmin(fmax((*y - expected) / usual, -LARGEST), LARGEST);
    *y = expected + error * usual;
    e->surprise += fmin(stages / RECENT, 1) * (error * error - e->surprise);
    const double rate = BR_TS / REMEMBERED_S * fmax(e->surprise / SURPRISING, 1);
    return exp(-stages * fmin(rate, 1 / RECENT));
}

static void remember(br_evidence *e, const double phi[BR_NM], double y, double r, double kept) {
    for (int a = 0; a < BR_NM; ++a) {
        for (int b = 0; b < BR_NM; ++b)
            e->information[a][b] = kept * e->information[a][b] + phi[a] * phi[b] / r;
        e->projection[a] = kept * e->projection[a] + phi[a] * y / r;
    }
    e->squares = kept * e->squares + y * y / r;
    e->precision = kept * e->precision + 1 / r;
    e->count = kept * e->count + 1;
    if (!isfinite(e->squares + e->precision)) memset(e, 0, sizeof *e);
}

/* Shares of s^2 that the weights of an output have: a term that does not behave in a mirror as the
 * output does, such as the constant lateral error of a wheel that is set wrongly, has a small one.
 */
static void prior_shares(const br_mpc *mpc, int output, double share[BR_NM]) {
    for (int a = 0; a < BR_NM; ++a) {
        int odd = 0;
        if (a > BR_NZ)
            odd = BR_STATE_ODD[mpc->changed[a - 1 - BR_NZ]];
        else if (a > 0)
            odd = BR_FEATURE[a - 1] < BR_NX ? BR_STATE_ODD[BR_FEATURE[a - 1]]
                                            : BR_INPUT_ODD[BR_FEATURE[a - 1] - BR_NX];
        share[a] = odd == BR_STATE_ODD[mpc->changed[output]] ? 1 : ASYMMETRIC * ASYMMETRIC;
    }
}

/* The weights by this prior, errors of variance `excess` times r; the logarithm of the evidence but
 * for what does not depend on the prior. */
static double regress(const br_evidence *e, double prior, const double share[BR_NM], double excess,
                      br_regression *out) {
    double (*l)[BR_NM] = out->factor, *w = out->weight;
    double squares = 0, volume = 1;
    for (int a = 0; a < BR_NM; ++a) {
        const double own = prior * share[a];
        for (int b = 0; b <= a; ++b) {
            double sum = e->information[a][b] / excess + (a == b ? 1 / own : 0);
            for (int k = 0; k < b; ++k) sum -= l[a][k] * l[b][k];
            l[a][b] = a == b ? 1 / sqrt(fmax(sum, 1e-3 / own)) : sum * l[b][b];
        }
        w[a] = e->projection[a] / excess;
        for (int k = 0; k < a; ++k) w[a] -= l[a][k] * w[k];
        w[a] *= l[a][a];
        squares += w[a] * w[a];
        volume *= l[a][a] / sqrt(own);
    }
    for (int a = BR_NM - 1; a >= 0; --a) {
        for (int k = a + 1; k < BR_NM; ++k) w[a] -= l[k][a] * w[k];
        w[a] *= l[a][a];
    }
    return 0.5 * squares + log(volume);
}

/* Mean square of what the weights leave, over r. */
static double left_over(const br_evidence *e, const double w[BR_NM]) {
    double sum = e->squares;
    for (int a = 0; a < BR_NM; ++a) {
        double row = -2 * e->projection[a];
        for (int b = 0; b < BR_NM; ++b) row += e->information[a][b] * w[b];
        sum += w[a] * row;
    }
    return sum / e->count;
}

/* The prior of the largest evidence is approached by a factor of four with each sample. */
static void conclude(const double share[BR_NM], br_evidence *e, br_regression *found) {
    if (!(e->count > 0)) return;
    const double r = e->count / e->precision;
    const double excess = fmax(e->excess, 1);
    const double middle = fmin(fmax(e->prior, LEAST_PRIOR * r), LARGEST_PRIOR * r);
    double best = -INFINITY;
    for (int step = -1; step <= 1; ++step) {
        br_regression one;
        const double prior = ldexp(middle, 2 * step);
        const double evidence = regress(e, prior, share, excess, &one);
        if (!(evidence > best)) continue;
        best = evidence;
        e->prior = prior;
        *found = one;
    }
    e->excess = left_over(e, found->weight);
    found->unexplained = r * fmax(e->excess - EXPLAINED, 0);
}

void br_mismatch_judge(br_mpc *mpc, const double variance[BR_NE]) {
    br_mismatch *m = &mpc->mismatch;
    const br_gp *gp = &mpc->gp[mpc->gp_in_use];
    const br_transition *due = &m->due;
    const double stages = due->duration / BR_TS;
    double end[BR_NX], phi[BR_NM];
    memcpy(m->before, m->evidence, sizeof m->before);
    if (br_predict_by(mpc, gp, due->x, due->u, due->duration, end)) return;
    m->judged = 1;
    terms_of(mpc, due->x, due->u, end, stages, phi);
    for (int j = 0; j < BR_NE; ++j) {
        const int i = mpc->changed[j];
        const double share = mpc->stage[0].in_e[i][j] * stages, noise = gp->variance[j].noise;
        const double measured = due->noise.corrected[i] / (share * share);
        const double r = CORRELATED * fmax(variance[j] - noise, 0) + noise + measured;
        if (share == 0 || !(r > 0)) continue; /* nothing is known of this output */
        double y = (due->x_next[i] - end[i]) / share, prior_share[BR_NM];
        const double kept = surprise(&m->evidence[j], m->weight[j], phi, r, stages, &y);
        remember(&m->evidence[j], phi, y, r, kept);
        prior_shares(mpc, j, prior_share);
        conclude(prior_share, &m->evidence[j], &m->found[j]);
    }
}

/* --- in the plan --- */

double br_mismatch_variance(const br_mpc *mpc, int stage, int output) {
    const br_mismatch *m = &mpc->mismatch;
    const br_evidence *e = &m->evidence[output];
    const br_regression *found = &m->found[output];
    if (!(e->count > 0 && e->prior > 0)) return 0;
    const double *phi = mpc->stage[stage].terms;
    double solved[BR_NM], sum = 0, mean = 0;
    for (int a = 0; a < BR_NM; ++a) {
        solved[a] = phi[a];
        for (int k = 0; k < a; ++k) solved[a] -= found->factor[a][k] * solved[k];
        solved[a] *= found->factor[a][a];
        sum += solved[a] * solved[a];
        mean += found->weight[a] * phi[a];
    }
    const double far = sum * e->precision / (fmax(e->excess, 1) * BR_NM);
    return sum + found->unexplained + NONLINEAR * NONLINEAR * far * mean * mean;
}

/* w' phi of each output. */
static void error_of(const br_mpc *mpc, const double phi[BR_NM], double error[BR_NE]) {
    for (int j = 0; j < BR_NE; ++j) {
        error[j] = 0;
        for (int a = 0; a < BR_NM; ++a) error[j] += mpc->mismatch.weight[j][a] * phi[a];
    }
}

void br_mismatch_mean(const br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                      const double end[BR_NX], double duration, double error[BR_NE]) {
    double phi[BR_NM];
    terms_of(mpc, x, u, end, duration / BR_TS, phi);
    error_of(mpc, phi, error);
}

void br_mismatch_add(const br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                     br_stage *stage) {
    double error[BR_NE], slope[BR_NE][BR_NV] = {{0}};
    terms_of(mpc, x, u, stage->f, 1, stage->terms);
    if (!mpc->mismatch.any) return;
    error_of(mpc, stage->terms, error);
    for (int j = 0; j < BR_NE; ++j) {
        const double *w = mpc->mismatch.weight[j];
        for (int a = 0; a < BR_NZ; ++a) slope[j][BR_FEATURE[a]] += w[1 + a] / feature_size(a);
        for (int l = 0; l < BR_NE; ++l) {
            const int i = mpc->changed[l];
            const double per_change = w[1 + BR_NZ + l] / change_size(i);
            slope[j][i] -= per_change;
            for (int c = 0; c < BR_NV; ++c) slope[j][c] += per_change * stage->jacobian[i][c];
        }
    }
    for (int i = 0; i < BR_NX; ++i)
        for (int j = 0; j < BR_NE; ++j) {
            stage->f[i] += stage->in_e[i][j] * error[j];
            for (int c = 0; c < BR_NV; ++c)
                stage->jacobian[i][c] += stage->in_e[i][j] * slope[j][c];
        }
}

void br_mismatch_price(const br_mpc *mpc, const br_stage *stage, double lambda[BR_NX]) {
    double added[BR_NX] = {0};
    for (int j = 0; j < BR_NE; ++j) {
        double price = 0;
        for (int i = 0; i < BR_NX; ++i) price += stage->in_e[i][j] * lambda[i];
        for (int l = 0; l < BR_NE; ++l) {
            const int i = mpc->changed[l];
            added[i] += price * mpc->mismatch.weight[j][1 + BR_NZ + l] / change_size(i);
        }
    }
    for (int i = 0; i < BR_NX; ++i) lambda[i] += added[i];
}
