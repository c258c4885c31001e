/* Mismatch: what the corrected model still errs by, estimated while driving.
 *
 * Gaussian processes are learned of drives that are over. A car has changed since when its tyres
 * are damp, its tank is full or its wheelbase is not that of its file. Its one-step errors y show
 * it at once: for each output of the residual,
 *
 *   y = w' phi + noise of variance r,   phi = [1; z; a],
 *
 * with z the Gaussian process's features and a what a stage changes of the states that the outputs
 * are added to, by the corrected model: a car of another mass, grip or motor has its accelerations
 * scaled. This is a Bayesian linear regression that forgets (Bishop, "Pattern Recognition and
 * Machine Learning", 2006, section 3.3): weights are N(0, s^2 I) before anything is seen, in units
 * of the deviations that the problem names, and s^2 follows the evidence (3.5), so that a model
 * that is right is left as it is. Bends to the left alone do not show which sign a term has in
 * bends to the right. So terms that change their sign in a mirror where the output does not, or the
 * other way round, have smaller weights. Several surprising errors in a row make older ones be
 * forgotten.
 *
 * The plan's model becomes F + F_e w' phi, and the residual's variance there the posterior's
 * without noise, plus phi' P phi with P the covariance of w, plus what the regression does not
 * explain. No mismatch is linear far from what was seen: a share of it counts as unknown, the
 * larger the farther phi is. r is the variance of what is measured, the residual's noise, and the
 * posterior's variance, CORRELATED times: errors of a smooth function resemble each other from one
 * stage to the next, so that many say no more than one.
 *
 * Where states are estimated, measurements say more than they do: br_bias.c. Their noise is known,
 * so that a regression always finds something; the mean is over models with weights and without.
 *
 * What is observed before a step counts in the tube of the step after it and in the model of the
 * one after that, so that steps are the same with and without a preparation, and so are
 * predictions.
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
#define TELLING 0.1       /* of the residual's deviation: what errors have to be known to */
#define EXPLAINED 1.5     /* mean square of errors over r up to which noise explains them */
#define CHANCE 2.0        /* standard deviations by which a mean square may exceed that */
#define ODDS 3.0          /* logarithm of those against a mismatch, before anything has been seen */
#define LEAST_SHARE 1e-3  /* of weights that may be noise */

static double feature_size(int a) {
    return BR_FEATURE[a] < BR_NX ? BR_STATE_DEVIATION[BR_FEATURE[a]]
                                 : BR_INPUT_EFFORT[BR_FEATURE[a] - BR_NX];
}

static double change_size(int state) { return ACCELERATION * BR_STATE_DEVIATION[state]; }

void br_mismatch_terms(const double x[BR_NX], const double u[BR_NU], const double end[BR_NX],
                       double stages, double phi[BR_NPHI]) {
    double z[BR_NZ];
    br_stage_features(x, u, z);
    phi[0] = 1;
    for (int a = 0; a < BR_NZ; ++a) phi[1 + a] = z[a] / feature_size(a);
    for (int l = 0; l < BR_NE; ++l) {
        const int i = BR_CHANGED[l];
        phi[1 + BR_NZ + l] = (end[i] - x[i]) / (stages * change_size(i));
    }
}

/* --- the regression --- */

void br_mismatch_reset(br_mismatch *mismatch) { memset(mismatch, 0, sizeof *mismatch); }

void br_mismatch_advance(br_mismatch *mismatch) {
    if (mismatch->judged) {
        mismatch->any = mismatch->renewed = 1;
        for (int j = 0; j < BR_NE; ++j)
            memcpy(mismatch->weight[j], mismatch->of[j].weight, sizeof mismatch->weight[j]);
    }
    mismatch->due = mismatch->newest;
    mismatch->newest.duration = mismatch->judged = 0;
}

int br_mismatch_due(const br_mismatch *mismatch) {
    return mismatch->due.duration > 0 && !mismatch->judged;
}

void br_mismatch_undo(br_mismatch *mismatch) {
    if (mismatch->judged) memcpy(mismatch->of, mismatch->before, sizeof mismatch->before);
    mismatch->judged = 0;
}

static double dot(const double a[BR_NPHI], const double b[BR_NPHI]) {
    double sum = 0;
    for (int k = 0; k < BR_NPHI; ++k) sum += a[k] * b[k];
    return sum;
}

/* Sufficient statistics of an output's weights from one transition: of one error y at phi, or of
 * the values of several measurements, which are whitened. */
typedef struct {
    double information[BR_NPHI][BR_NPHI], projection[BR_NPHI], squares, precision, values;
} statistics;

/* A single error that is far from what is usual is taken for a smaller one. usual: a variance. */
static double clipped(double error, double usual) {
    const double most = LARGEST * sqrt(usual);
    return fmin(fmax(error, -most), most);
}

/* Several in a row, and what was before says little of the car any more: the share that is kept of
 * it. square: of an error, over what is usual. */
static double kept_share(br_regression *of, double square, double stages) {
    of->surprise += fmin(stages / RECENT, 1) * (square - of->surprise);
    const double rate = BR_TS / REMEMBERED_S * fmax(of->surprise / SURPRISING, 1);
    return exp(-stages * fmin(rate, 1 / RECENT));
}

static void remember(br_regression *of, const statistics *new, double kept) {
    for (int a = 0; a < BR_NPHI; ++a) {
        for (int b = 0; b < BR_NPHI; ++b)
            of->information[a][b] = kept * of->information[a][b] + new->information[a][b];
        of->projection[a] = kept * of->projection[a] + new->projection[a];
    }
    of->squares = kept * of->squares + new->squares;
    of->precision = kept * of->precision + new->precision;
    of->samples = kept * of->samples + 1;
    of->values = kept * of->values + new->values;
    if (!isfinite(of->squares + of->precision)) memset(of, 0, sizeof *of);
}

/* Share of s^2 that a weight of an output has: little if in a mirror its term and the output do not
 * both change their sign or both keep it, as with the constant error of a wheel that is set
 * wrongly.
 */
static double prior_share(int output, int a) {
    int odd = 0;
    if (a > BR_NZ)
        odd = BR_STATE_ODD[BR_CHANGED[a - 1 - BR_NZ]];
    else if (a > 0)
        odd = BR_FEATURE[a - 1] < BR_NX ? BR_STATE_ODD[BR_FEATURE[a - 1]]
                                        : BR_INPUT_ODD[BR_FEATURE[a - 1] - BR_NX];
    return odd == BR_STATE_ODD[BR_CHANGED[output]] ? 1 : ASYMMETRIC * ASYMMETRIC;
}

/* The posterior of the weights by this prior; the logarithm of its evidence but for what does not
 * depend on the prior. */
static double regress(int output, double prior, br_regression *of) {
    double (*l)[BR_NPHI] = of->factor, *w = of->weight, squares = 0, volume = 1;
    for (int a = 0; a < BR_NPHI; ++a) {
        const double own = prior * prior_share(output, a);
        for (int b = 0; b <= a; ++b) {
            double sum = of->information[a][b] / of->scaled_by + (a == b ? 1 / own : 0);
            for (int k = 0; k < b; ++k) sum -= l[a][k] * l[b][k];
            l[a][b] = a == b ? 1 / sqrt(fmax(sum, 1e-3 / own)) : sum * l[b][b];
        }
        w[a] = of->projection[a] / of->scaled_by;
        for (int k = 0; k < a; ++k) w[a] -= l[a][k] * w[k];
        w[a] *= l[a][a];
        squares += w[a] * w[a];
        volume *= l[a][a] / sqrt(own);
    }
    for (int a = BR_NPHI - 1; a >= 0; --a) {
        for (int k = a + 1; k < BR_NPHI; ++k) w[a] -= l[k][a] * w[k];
        w[a] *= l[a][a];
    }
    return 0.5 * squares + log(volume);
}

/* Mean square of what the weights leave, over r. */
static double mean_square_left(const br_regression *of) {
    double sum = of->squares;
    for (int a = 0; a < BR_NPHI; ++a)
        sum += of->weight[a] * (dot(of->information[a], of->weight) - 2 * of->projection[a]);
    return sum / of->values;
}

/* The mean over a model with weights and one without any (Bishop, section 14.1): what may be noise
 * is no mismatch. For measurements, whose noise is known; the r of exact states is an upper bound.
 */
static void average(double evidence, br_regression *of) {
    const double share = fmax(1 / (1 + exp(ODDS - evidence)), LEAST_SHARE);
    of->doubt = (1 - share) / share;
    for (int a = 0; a < BR_NPHI; ++a) {
        of->weight[a] *= share;
        for (int b = 0; b < a; ++b) of->factor[a][b] /= sqrt(share);
        of->factor[a][a] *= sqrt(share);
    }
}

/* The prior of the largest evidence is approached by a factor of four with each sample. */
static void maximise_evidence(int output, int averaged, br_regression *of) {
    if (!(of->samples > 0)) return;
    const double r = of->samples / of->precision;
    const double middle = fmin(fmax(of->prior, LEAST_PRIOR * r), LARGEST_PRIOR * r);
    of->scaled_by = fmax(of->noise_scale, 1);
    const double less = regress(output, middle / 4, of), more = regress(output, middle * 4, of);
    const double same = regress(output, middle, of);
    double evidence = same;
    of->prior = same >= fmax(less, more) ? middle : less > more ? middle / 4 : middle * 4;
    if (of->prior != middle) evidence = regress(output, of->prior, of);
    of->noise_scale = mean_square_left(of);
    const double chance = CHANCE * sqrt(2 / of->values); /* chi-squared */
    of->unexplained = r * fmax(of->noise_scale - EXPLAINED - chance, 0);
    of->doubt = 0;
    if (averaged) average(evidence, of);
}

/* An error y of an output at phi, of variance r. */
static void learn_exact(br_mismatch *m, int output, const double phi[BR_NPHI], double y, double r,
                        double stages) {
    br_regression *of = &m->of[output];
    if (!(r > 0 && isfinite(r))) return;
    const double expected = dot(m->weight[output], phi), usual = fmax(of->noise_scale, 1) * r;
    const double error = clipped(y - expected, usual), taken = expected + error;
    statistics new = {.squares = taken * taken / r, .precision = 1 / r, .values = 1};
    for (int a = 0; a < BR_NPHI; ++a) {
        for (int b = 0; b < BR_NPHI; ++b) new.information[a][b] = phi[a] * phi[b] / r;
        new.projection[a] = phi[a] * taken / r;
    }
    remember(of, &new, kept_share(of, error * error / usual, stages));
    maximise_evidence(output, 0, of);
}

/* What measurements say, unless that is next to nothing: this would hide what others say, by its
 * part in the usual r, which is that of an error at the same terms. */
static void learn_estimated(br_mismatch *m, int output, const double phi[BR_NPHI],
                            const br_mpc_noise *shown, double signal, double stages) {
    br_regression *of = &m->of[output];
    const double *w = m->weight[output];
    statistics new = {.squares = shown->squares[output], .values = shown->values};
    memcpy(new.information, shown->information[output], sizeof new.information);
    memcpy(new.projection, shown->projection[output], sizeof new.projection);
    double trace = 0, left = new.squares;
    for (int a = 0; a < BR_NPHI; ++a) {
        trace += new.information[a][a];
        left += w[a] * (dot(new.information[a], w) - 2 * new.projection[a]);
    }
    new.precision = trace / dot(phi, phi);
    if (!(new.values > 0 && new.precision * TELLING * TELLING * signal > 1)) return;
    const double square = left / (new.values * fmax(of->noise_scale, 1));
    remember(of, &new, kept_share(of, square, stages));
    maximise_evidence(output, 1, of);
}

void br_mismatch_judge(br_mpc *mpc, const double variance[BR_NE]) {
    br_mismatch *m = &mpc->mismatch;
    const br_gp *gp = &mpc->gp[mpc->gp_in_use];
    const br_transition *due = &m->due;
    const double stages = due->duration / BR_TS;
    double end[BR_NX], phi[BR_NPHI];
    if (br_predict_by(mpc, gp, due->x, due->u, due->duration, end)) return;
    memcpy(m->before, m->of, sizeof m->before);
    m->judged = 1;
    br_mismatch_terms(due->x, due->u, end, stages, phi);
    for (int j = 0; j < BR_NE; ++j) {
        const int i = BR_CHANGED[j];
        const double share = mpc->stage[0].in_e[i][j] * stages, noise = gp->variance[j].noise;
        const double r = CORRELATED * fmax(variance[j] - noise, 0) + noise;
        if (due->estimated)
            learn_estimated(m, j, phi, &due->noise, gp->variance[j].signal, stages);
        else if (share != 0) /* else nothing is known of this output */
            learn_exact(m, j, phi, (due->x_next[i] - end[i]) / share, r, stages);
    }
}

/* --- in the plan --- */

void br_mismatch_mean(const br_mpc *mpc, const double phi[BR_NPHI], double error[BR_NE]) {
    for (int j = 0; j < BR_NE; ++j) error[j] = dot(mpc->mismatch.weight[j], phi);
}

/* phi' P phi */
static double uncertain(const br_regression *of, const double phi[BR_NPHI]) {
    double solved[BR_NPHI], sum = 0;
    for (int a = 0; a < BR_NPHI; ++a) {
        solved[a] = phi[a];
        for (int k = 0; k < a; ++k) solved[a] -= of->factor[a][k] * solved[k];
        solved[a] *= of->factor[a][a];
        sum += solved[a] * solved[a];
    }
    return sum;
}

/* Variance of what no weights explain, by phi' P phi. */
static double unexplained(const br_regression *of, const double phi[BR_NPHI], double of_weights) {
    const double mean = dot(of->weight, phi);
    const double leverage = of_weights * of->precision / (of->scaled_by * BR_NPHI);
    return of->unexplained + (of->doubt + NONLINEAR * NONLINEAR * leverage) * mean * mean;
}

double br_mismatch_unexplained(const br_regression *of, const double phi[BR_NPHI]) {
    return of->samples > 0 ? unexplained(of, phi, uncertain(of, phi)) : 0;
}

double br_mismatch_variance(const br_mpc *mpc, const double phi[BR_NPHI], int output) {
    const br_regression *of = &mpc->mismatch.of[output];
    if (!(of->samples > 0)) return 0;
    const double of_weights = uncertain(of, phi);
    return of_weights + unexplained(of, phi, of_weights);
}

void br_mismatch_add(const br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                     br_stage *stage) {
    double error[BR_NE], slope[BR_NE][BR_NV] = {};
    memcpy(stage->plain_f, stage->f, sizeof stage->f);
    memcpy(stage->plain_jacobian, stage->jacobian, sizeof stage->jacobian);
    br_mismatch_terms(x, u, stage->f, 1, stage->phi);
    if (!mpc->mismatch.any) return;
    br_mismatch_mean(mpc, stage->phi, error);
    for (int j = 0; j < BR_NE; ++j) {
        const double *w = mpc->mismatch.weight[j];
        for (int a = 0; a < BR_NZ; ++a) slope[j][BR_FEATURE[a]] += w[1 + a] / feature_size(a);
        for (int l = 0; l < BR_NE; ++l) {
            const int i = BR_CHANGED[l];
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

void br_mismatch_renew(br_mpc *mpc) {
    if (!mpc->mismatch.renewed || !mpc->valid[BR_LINEARISATION]) return;
    mpc->mismatch.renewed = 0;
    br_invalidate(mpc, BR_FACTORS);
    mpc->curved = 0;
    for (int k = 0; k < BR_N; ++k) {
        br_stage *stage = &mpc->stage[k];
        memcpy(stage->f, stage->plain_f, sizeof stage->f);
        memcpy(stage->jacobian, stage->plain_jacobian, sizeof stage->jacobian);
        br_mismatch_add(mpc, mpc->plan.x[k], mpc->plan.u[k], stage);
    }
}

void br_mismatch_costate(const br_mpc *mpc, const br_stage *stage, double lambda[BR_NX]) {
    double added[BR_NX] = {0};
    if (!mpc->mismatch.any) return;
    for (int j = 0; j < BR_NE; ++j) {
        double price = 0;
        for (int i = 0; i < BR_NX; ++i) price += stage->in_e[i][j] * lambda[i];
        for (int l = 0; l < BR_NE; ++l) {
            const int i = BR_CHANGED[l];
            added[i] += price * mpc->mismatch.weight[j][1 + BR_NZ + l] / change_size(i);
        }
    }
    for (int i = 0; i < BR_NX; ++i) lambda[i] += added[i];
}
