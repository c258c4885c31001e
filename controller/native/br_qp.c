/* The QP of one SQP iteration, condensed to the inputs by br_condense.c: turned into a
 * least-distance problem, solved by DAQP's dual active-set method, warm started.
 *
 *   min 1/2 dU' H dU + g' dU   s.t.  lower <= A dU <= upper
 *
 * rows: BR_M bounds of the blocks' inputs, then BR_N for each row of the problem (stages 1..N),
 * two-sided, those with constant gradients first. Soft ones have the penalty w eps^2, eps >= 0 per
 * side; only one side can be violated, and with a purely quadratic penalty eps >= 0 never binds, so
 * DAQP's dual regularisation (1 / 2w on a soft row's diagonal) is exact.
 *
 * DAQP gets M = A L^{-T} (H = L L') in caller-owned memory; only its core daqp_ldp is called,
 * which neither allocates nor reads a clock. docs/decisions/ says why DAQP and not HPIPM.
 */
#include <daqp/daqp.h>
#include "br_internal.h"

#define POSITIVE_DEFINITE 1e-10 /* smallest pivot, relative to the largest diagonal entry */

#define HELD 16.0 /* share of the proximal term of what a bound or a hard row holds anyway */

void br_qp_init(br_qp *qp) {
    DAQPWorkspace *work = &qp->daqp;
    memset(work, 0, sizeof *work);
    qp->settings = (DAQPSettings){
        .primal_tol = 1e-9,
        .dual_tol = DEFAULT_DUAL_TOL,
        .zero_tol = DEFAULT_ZERO_TOL,
        .pivot_tol = DEFAULT_PIVOT_TOL,
        .progress_tol = DEFAULT_PROG_TOL,
        .cycle_tol = DEFAULT_CYCLE_TOL,
        .fval_bound = DAQP_INF,
        .rho_soft = DEFAULT_RHO_SOFT,
    };
    for (int i = 0; i < BR_ROWS; ++i) qp->unit[i] = 1.0;
    work->n = BR_M;
    work->M = qp->m;
    work->dupper = qp->dupper;
    work->dlower = qp->dlower;
    work->scaling = qp->unit;
    work->sense = qp->sense;
    work->L = qp->l;
    work->D = qp->d;
    work->xldl = qp->xldl;
    work->zldl = qp->zldl;
    work->u = qp->u;
    work->WS = qp->working_set;
    work->settings = &qp->settings;
    br_qp_forget_working_set(qp);
}

void br_qp_forget_working_set(br_qp *qp) {
    for (int i = 0; i < BR_M; ++i) qp->sense[i] = 0;
    for (int r = 0; r < BR_NR; ++r)
        for (int k = 0; k < BR_N; ++k) qp->sense[BR_ROW(r, k)] = BR_ROW_SOFT[r] ? SOFT : 0;
}

/* What belongs to rows moves with the horizon: stage k takes what stage k + 1 had. A block keeps
 * what it had, because all its stages but one were in it before. */
void br_qp_shift_rows(void *rows, size_t size) {
    enum { MOVED = BR_FREE < BR_BLOCKS ? BR_FREE : BR_BLOCKS - 1 };
    char *at = rows;
    memmove(at, at + BR_NU * size, BR_NU * MOVED * size);
    at += BR_M * size;
    for (int r = 0; r < BR_NR; ++r, at += BR_N * size) memmove(at, at + size, (BR_N - 1) * size);
}

/* Cholesky factor L' of the lower triangle, into the upper one: there, rows are eliminated in whole
 * vectors, and the lower triangle is overwritten as far as vectors reach. 0 if a pivot is not
 * safely positive. */
static int cholesky(br_qp *qp) {
    double largest = 0;
    for (int i = 0; i < BR_M; ++i) {
        largest = fmax(largest, fabs(qp->h[i][i]));
        for (int j = 0; j < i; ++j) qp->h[j][i] = qp->h[i][j];
    }
    for (int j = 0; j < BR_M; ++j) {
        double *restrict row = qp->h[j];
        if (!(row[j] > POSITIVE_DEFINITE * largest)) return 0;
        qp->diagonal[j] = 1.0 / sqrt(row[j]);
        for (int c = j / BR_LANES * BR_LANES; c < BR_MP; c += BR_LANES)
            br_store(&row[c], qp->diagonal[j] * br_load(&row[c]));
        for (int i = j + 1; i < BR_M; ++i) {
            double *restrict below = qp->h[i];
            const double factor = row[i];
            for (int c = i / BR_LANES * BR_LANES; c < BR_MP; c += BR_LANES)
                br_store(&below[c], br_load(&below[c]) - factor * br_load(&row[c]));
        }
    }
    return 1;
}

/* Y = L^{-1} [A' | g]; the columns before BR_ROW_LATE do not need the measured state. */
static inline __attribute__((always_inline)) void substitute(br_qp *qp, const int first,
                                                             const int last) {
    for (int r = 0; r < BR_M; ++r) {
        double *restrict y = qp->y[r];
        for (int c = 0; c < r; ++c) {
            const double l = qp->h[c][r];
            const double *restrict solved = qp->y[c];
            for (int i = first; i < last; ++i) y[i] -= l * solved[i];
        }
        for (int i = first; i < last; ++i) y[i] *= qp->diagonal[r];
    }
}

/* Rows of DAQP's matrix. Hard ones are scaled to unit length, soft ones by the root of their
 * penalty, because DAQP has one weight for all soft rows: see set_scales. */
static inline __attribute__((always_inline)) void fill_rows(br_qp *qp, const int first,
                                                            const int last) {
    for (int i = first; i < last; ++i)
        for (int r = 0; r < BR_M; ++r) qp->m[i * BR_M + r] = qp->scale[i] * qp->y[r][i];
}

/* Columns of y for these rows of the problem: their sensitivities h_x G to all inputs. */
static void fill_sensitivities(br_qp *qp, const int first, const int last) {
    BR_UNROLL
    for (int r = first; r < last; ++r)
        for (int k = 0; k < BR_N; ++k) {
            BR_ALIGNED double row[BR_MP];
            double weight[BR_NX];
            const double *sensitivity[BR_NX];
            int count = 0;
            BR_UNROLL
            for (int n = BR_ROW_START[r]; n < BR_ROW_START[r + 1]; ++n, ++count) {
                const int i = BR_ROW_INDEX[n];
                weight[count] =
                    r < BR_NR_EARLY ? BR_ROW_CONSTANT[BR_NX * r + i] : qp->terms[k].gradient[n];
                sensitivity[count] = qp->g[k + 1][i];
            }
            const int columns = BR_NU * (BR_BLOCK_OF(k) + 1);
            br_combine(row, br_padded(columns), 0, count, weight, sensitivity);
            for (int c = 0; c < columns; ++c) qp->y[c][BR_ROW(r, k)] = row[c];
        }
}

/* Of soft rows with several penalties, each is scaled so that the first one's penalty serves all.
 */
static double slack_weight(const br_qp *qp) {
    for (int r = 0; r < BR_NR; ++r)
        if (BR_ROW_SOFT[r] && qp->penalty[r] > 0) return qp->penalty[r];
    return 0;
}

static void set_scales(br_qp *qp, int first, int last, const double *norm2) {
    const double weight = slack_weight(qp);
    for (int i = first; i < last; ++i) {
        const int r = i < BR_M ? -1 : (i - BR_M) / BR_N;
        if (r >= 0 && BR_ROW_SOFT[r])
            qp->scale[i] = qp->penalty[r] > 0 ? sqrt(qp->penalty[r] / weight) : 1.0;
        else
            qp->scale[i] = norm2[i] > 0 ? 1.0 / sqrt(norm2[i]) : 1.0;
    }
}

/* What of the least-distance problem depends on the linearisation alone. */
static void transform(br_qp *qp) {
    BR_ALIGNED double norm2[BR_COLS] = {0};
    for (int r = 0; r < BR_M; ++r) {
        double *y = qp->y[r];
        memset(y, 0, sizeof qp->y[r]);
        y[r] = 1.0;
    }
    fill_sensitivities(qp, 0, BR_NR_EARLY);
    substitute(qp, 0, BR_ROW_LATE);
    for (int r = 0; r < BR_M; ++r)
        for (int i = 0; i < BR_ROW_LATE; ++i) norm2[i] += qp->y[r][i] * qp->y[r][i];
    set_scales(qp, 0, BR_ROW_LATE, norm2);
    fill_rows(qp, 0, BR_ROW_LATE);
}

/* The proximal term of what the plan's active bounds and hard rows hold, which changes a step only
 * where it leaves them: it makes the Hessian convex in the directions that are not free. That of a
 * row a dU is as large, in the norm of the inputs' terms, as that of a bound. */
static void add_proximal_held(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    const double *multiplier = mpc->plan.multiplier;
    for (int k = 0; k < BR_N; ++k)
        for (int c = 0; c < BR_NU; ++c) {
            const int i = BR_NU * BR_BLOCK_OF(k) + c;
            if (multiplier[i] != 0) qp->h[i][i] += HELD * BR_INPUT_PROXIMAL[c];
        }
    fill_sensitivities(qp, 0, BR_NR_EARLY);
    for (int r = 0; r < BR_NR_EARLY; ++r)
        for (int k = 0; k < BR_N; ++k) {
            if (BR_ROW_SOFT[r] || multiplier[BR_ROW(r, k)] == 0) continue;
            const int columns = BR_NU * (BR_BLOCK_OF(k) + 1);
            double a[BR_M], norm2 = 0;
            for (int i = 0; i < columns; ++i) {
                a[i] = qp->y[i][BR_ROW(r, k)];
                if (a[i] != 0) norm2 += a[i] * a[i] / BR_INPUT_PROXIMAL[i % BR_NU];
            }
            for (int i = 0; norm2 > 0 && i < columns; ++i)
                for (int j = 0; j <= i; ++j) qp->h[i][j] += HELD / norm2 * a[i] * a[j];
        }
}

/* That of all other inputs. */
static void add_proximal(br_mpc *mpc, double damping) {
    br_qp *qp = &mpc->qp;
    for (int k = 0; k < BR_N; ++k)
        for (int c = 0; c < BR_NU; ++c) {
            const int i = BR_NU * BR_BLOCK_OF(k) + c;
            if (mpc->plan.multiplier[i] == 0) qp->h[i][i] += damping * BR_INPUT_PROXIMAL[c];
        }
}

/* The factor of the Hessian with this share of the dynamics' and the rows' part. Of the proximal
 * term it has as little as makes it positive definite: a Newton step, where the whole one would be
 * a small part of the way. Returns the share of that term, 1 where the problem has none; 0 if there
 * is no factor. */
static double damped_factor(br_mpc *mpc, double curvature) {
    static const double dampings[] = {0.001, 0.004, 0.016, 0.064, 0.256, 1.024, 4.096};
    br_qp *qp = &mpc->qp;
    br_condense_hessian(mpc, curvature);
    if (!BR_PROXIMAL) return cholesky(qp);
    add_proximal_held(mpc);
    memcpy(qp->undamped, qp->h, sizeof qp->undamped);
    for (int attempt = 0; attempt < 7; ++attempt) {
        memcpy(qp->h, qp->undamped, sizeof qp->undamped);
        add_proximal(mpc, dampings[attempt]);
        if (cholesky(qp)) return dampings[attempt];
    }
    return 0;
}

/* All that needs neither the measured state nor the reference. With the exact Hessian if that is
 * positive definite in the inputs; else with less and less of the dynamics' and the rows' part,
 * down to that of the cost alone, which always is. */
void br_qp_factorise(br_mpc *mpc) {
    static const double curvature[] = {1.0, 0.5, 0.25, 0.0};
    br_qp *qp = &mpc->qp;
    mpc->valid[BR_FACTORS] = 0;
    br_curve_plan(mpc);
    br_evaluate_curvature(mpc);
    br_condense_states(mpc);
    for (int attempt = 0; attempt < 4; ++attempt) {
        const double damping = damped_factor(mpc, curvature[attempt]);
        if (damping == 0) continue;
        qp->curvature = curvature[attempt];
        qp->regularised = attempt > 0 || damping > 1;
        transform(qp);
        mpc->valid[BR_FACTORS] = 1;
        return;
    }
}

br_mpc_status br_qp_condense(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    br_evaluate_terms(mpc);
    if (!mpc->valid[BR_FACTORS] || (BR_CURVATURE_LATE && !mpc->follows)) br_qp_factorise(mpc);
    if (!mpc->valid[BR_FACTORS])
        return BR_NOT_FINITE; /* a convex cost alone is positive definite */
    br_condense_gradient(mpc, qp->curvature);
    mpc->info.regularised += qp->regularised;
    return BR_CONVERGED;
}

/* Of a block: what all its stages leave. That may be nothing where limits have come nearer since
 * the plan was made: then the block stays, and spread puts each stage within its own limits. */
static void block_bounds(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    for (int k = 0; k < BR_N; ++k)
        for (int c = 0; c < BR_NU; ++c) {
            const int i = BR_NU * BR_BLOCK_OF(k) + c, opens = br_opens_block(k);
            const double lower = mpc->u_lower[c] - mpc->plan.u[k][c];
            const double upper = mpc->u_upper[c] - mpc->plan.u[k][c];
            qp->lower[i] = opens ? lower : fmax(lower, qp->lower[i]);
            qp->upper[i] = opens ? upper : fmin(upper, qp->upper[i]);
        }
    for (int i = BR_NU * BR_FREE; i < BR_M; ++i)
        if (qp->lower[i] > qp->upper[i]) qp->lower[i] = qp->upper[i] = 0;
}

static void bounds(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    block_bounds(mpc);
    for (int k = 0; k < BR_N; ++k) {
        const br_stage_terms *terms = &qp->terms[k];
        for (int r = 0; r < BR_NR; ++r) {
            double value = terms->value[r];
            for (int n = BR_ROW_START[r]; n < BR_ROW_START[r + 1]; ++n)
                value += terms->gradient[n] * qp->xbar[k + 1][BR_ROW_INDEX[n]];
            const int off = BR_ROW_SOFT[r] && !(qp->penalty[r] > 0);
            qp->lower[BR_ROW(r, k)] = off ? -DAQP_INF : terms->lower[r] - value;
            qp->upper[BR_ROW(r, k)] = off ? DAQP_INF : terms->upper[r] - value;
        }
    }
}

/* The rest of the least-distance problem: late rows and right-hand sides. */
static void fill_least_distance(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    BR_ALIGNED double shift[BR_COLS] = {0}, norm2[BR_COLS] = {0};
    for (int r = 0; r < BR_M; ++r) {
        double *y = qp->y[r];
        for (int i = BR_ROW_LATE; i < BR_COLS; ++i) y[i] = 0;
        y[BR_ROWS] = qp->gradient[r];
    }
    fill_sensitivities(qp, BR_NR_EARLY, BR_NR);
    substitute(qp, BR_ROW_LATE, BR_COLS);
    for (int r = 0; r < BR_M; ++r) {
        const double *restrict y = qp->y[r], v = y[BR_ROWS];
        for (int i = 0; i < BR_COLS; ++i) shift[i] += y[i] * v;
        for (int i = BR_ROW_LATE; i < BR_ROWS; ++i) norm2[i] += y[i] * y[i];
    }
    set_scales(qp, BR_ROW_LATE, BR_ROWS, norm2);
    for (int i = 0; i < BR_ROWS; ++i) {
        qp->dupper[i] = qp->scale[i] * (qp->upper[i] + shift[i]);
        qp->dlower[i] = qp->scale[i] * (qp->lower[i] + shift[i]);
    }
    fill_rows(qp, BR_ROW_LATE, BR_ROWS);
}

/* With the steps that are left to this QP. */
static int run_daqp(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    br_timer *timer = &mpc->timer;
    const double weight = slack_weight(qp);
    DAQPWorkspace *work = &qp->daqp;
    work->m = BR_ROWS;
    work->ms = 0;
    work->lam = qp->lam[0];
    work->lam_star = qp->lam[1];
    qp->settings.rho_soft = weight > 0 ? 1.0 / (2 * weight) : 0.0;
    reset_daqp_workspace(work);
    activate_constraints(work);
    const int most = timer->qp_steps < BR_QP_STEPS ? timer->qp_steps : BR_QP_STEPS;
    qp->settings.iter_limit = most;
    const int flag = daqp_ldp(work);
    const int steps = work->iterations < most ? work->iterations : most; /* it counts one more */
    timer->qp_steps -= steps;
    mpc->info.qp_iterations += steps;
    return flag;
}

/* dU = L^{-T} (u - v) and the multipliers in the QP's units. */
static void recover(br_qp *qp) {
    for (int r = BR_M - 1; r >= 0; --r) {
        double sum = qp->u[r] - qp->y[r][BR_ROWS];
        for (int c = r + 1; c < BR_M; ++c) sum -= qp->h[r][c] * qp->delta_u[c];
        qp->delta_u[r] = sum * qp->diagonal[r];
    }
    memset(qp->multiplier, 0, sizeof qp->multiplier);
    for (int i = 0; i < qp->daqp.n_active; ++i) {
        const int row = qp->working_set[i];
        qp->multiplier[row] = qp->daqp.lam_star[i] * qp->scale[row];
    }
}

/* The change of each block as that of its stages. */
static void spread(br_mpc *mpc) {
    double *change = mpc->qp.delta_u;
    for (int k = BR_N - 1; k >= BR_FREE; --k)
        for (int c = 0; c < BR_NU; ++c) {
            const double u = mpc->plan.u[k][c], wanted = change[BR_NU * BR_BLOCK_OF(k) + c];
            change[BR_NU * k + c] = fmin(fmax(wanted, mpc->u_lower[c] - u), mpc->u_upper[c] - u);
        }
}

br_mpc_status br_qp_solve(br_mpc *mpc, int warm) {
    br_qp *qp = &mpc->qp;
    bounds(mpc);
    fill_least_distance(mpc);
    if (!br_all_finite(qp->dupper, BR_ROWS) || !br_all_finite(qp->dlower, BR_ROWS))
        return BR_NOT_FINITE;
    if (!warm) br_qp_forget_working_set(qp);
    int flag = run_daqp(mpc);
    if (flag < 0 && warm) { /* once more without the old working set before giving up */
        br_qp_forget_working_set(qp);
        flag = run_daqp(mpc);
    }
    if (flag == EXIT_INFEASIBLE) return BR_INFEASIBLE;
    if (flag == EXIT_ITERLIMIT && qp->settings.iter_limit < BR_QP_STEPS) return BR_TIME_LIMIT;
    if (flag < 0) return BR_QP_LIMIT;
    recover(qp);
    if (!br_all_finite(qp->delta_u, BR_M) || !br_all_finite(qp->multiplier, BR_ROWS))
        return BR_NOT_FINITE;
    spread(mpc);
    return BR_CONVERGED;
}
