/* The QP of one SQP iteration: condensed to the inputs, turned into a least-distance problem,
 * solved by DAQP's dual active-set method, warm started.
 *
 *   min 1/2 dU' H dU + g' dU   s.t.  lower <= A dU <= upper
 *
 * rows: BR_M input bounds, BR_N steering angles (stages 1..N), BR_N track half-planes. The two
 * half-planes of a stage are parallel: one two-sided row. They are soft with the penalty s eps^2,
 * eps >= 0 per side; only one side can be violated, and with a purely quadratic penalty eps >= 0
 * never binds, so DAQP's dual regularisation (1 / 2s on a soft row's diagonal) is exact.
 *
 * DAQP gets M = A L^{-T} (H = L L') in caller-owned memory; only its core daqp_ldp is called,
 * which neither allocates nor reads a clock. docs/decisions/ says why DAQP and not HPIPM.
 */
#include <daqp/daqp.h>
#include <math.h>

#include "br_internal.h"

#define ROW_DELTA BR_M
#define ROW_TRACK (BR_M + BR_N)
#define POSITIVE_DEFINITE 1e-10 /* smallest pivot, relative to the largest diagonal entry */

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
        .iter_limit = 200,
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
    for (int i = 0; i < BR_ROWS; ++i) qp->sense[i] = i >= ROW_TRACK ? SOFT : 0;
}

/* What belongs to rows moves with the horizon: stage k takes what stage k + 1 had. */
void br_qp_shift_rows(void *rows, size_t size) {
    char *at = rows;
    memmove(at, at + BR_NU * size, (BR_M - BR_NU) * size);
    at += ROW_DELTA * size;
    memmove(at, at + size, (BR_N - 1) * size);
    at += (ROW_TRACK - ROW_DELTA) * size;
    memmove(at, at + size, (BR_N - 1) * size);
}

/* Whole vectors that cover columns 0..n-1 of a BR_MP-wide row; the rest of a row is zero. */
static inline int padded(int n) { return (n + 7) & ~7; }

/* G_{k+1} = [A_k G_k, B_k]; pose columns of A are unit vectors (translation invariance), so that
 * rows x and y add themselves and no other row sees them. */
static void propagate_sensitivity(double (*restrict next)[BR_MP], double (*restrict g)[BR_MP],
                                  const br_stage *stage, int k) {
    const int columns = padded(BR_NU * k);
    for (int i = 0; i < BR_NX; ++i) {
        for (int c = 0; c < columns; ++c) next[i][c] = i < 2 ? g[i][c] : 0.0;
        for (int j = 2; j < BR_NX; ++j) {
            const double a = stage->jacobian[i][j];
            for (int c = 0; c < columns; ++c) next[i][c] += a * g[j][c];
        }
        next[i][BR_NU * k] = stage->jacobian[i][BR_NX];
        next[i][BR_NU * k + 1] = stage->jacobian[i][BR_NX + 1];
    }
}

/* Change of the states under dU = 0: the measured state and the defects. */
static void propagate_state(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    for (int i = 0; i < BR_NX; ++i) qp->xbar[0][i] = mpc->x0[i] - mpc->plan.x[0][i];
    for (int k = 0; k < BR_N; ++k) {
        const br_stage *stage = &mpc->stage[k];
        for (int i = 0; i < BR_NX; ++i) {
            double sum = stage->f[i] - mpc->plan.x[k + 1][i];
            for (int j = 0; j < BR_NX; ++j) sum += stage->jacobian[i][j] * qp->xbar[k][j];
            qp->xbar[k + 1][i] = sum;
        }
    }
}

/* One step of the backward recursion for the Hessian's rows of stage k, columns of inputs <= k:
 * H_k = B' P + S G_k,  P <- A' P + W G_k, with curvature weight tau. */
static void hessian_rows(br_mpc *mpc, int k, double tau, double (*restrict p)[BR_MP],
                         double (*restrict p_next)[BR_MP]) {
    br_qp *qp = &mpc->qp;
    const br_stage *stage = &mpc->stage[k];
    const int columns = padded(BR_NU * (k + 1)), before = padded(BR_NU * k);
    double(*restrict g)[BR_MP] = qp->g[k];
    for (int r = 0; r < BR_NU; ++r) {
        double *restrict row = qp->h[BR_NU * k + r];
        for (int c = 0; c < columns; ++c) row[c] = 0;
        for (int j = 0; j < BR_NX; ++j) {
            const double b = stage->jacobian[j][BR_NX + r];
            for (int c = 0; c < columns; ++c) row[c] += b * p[j][c];
        }
        for (int j = 2; j < BR_NX; ++j) {
            const double s = tau * stage->hessian[BR_NX + r][j];
            for (int c = 0; c < before; ++c) row[c] += s * g[j][c];
        }
        for (int c = 0; c < BR_NU; ++c)
            row[BR_NU * k + c] += tau * stage->hessian[BR_NX + r][BR_NX + c];
    }
    if (k == 0) return;
    const double q = 2 * mpc->parameters.q_position;
    for (int i = 0; i < BR_NX; ++i) {
        for (int c = 0; c < before; ++c) p_next[i][c] = i < 2 ? p[i][c] + q * g[i][c] : 0.0;
        if (i < 2) continue; /* the pose columns of A are unit vectors, their curvature zero */
        for (int j = 0; j < BR_NX; ++j) {
            const double a = stage->jacobian[j][i];
            for (int c = 0; c < before; ++c) p_next[i][c] += a * p[j][c];
        }
        for (int j = 2; j < BR_NX; ++j) {
            const double w = tau * stage->hessian[i][j];
            for (int c = 0; c < before; ++c) p_next[i][c] += w * g[j][c];
        }
    }
}

static void condense_hessian(br_mpc *mpc, double tau) {
    br_qp *qp = &mpc->qp;
    const br_mpc_parameters *par = &mpc->parameters;
    for (int i = 0; i < BR_NX; ++i)
        for (int c = 0; c < BR_MP; ++c)
            qp->costate[0][i][c] = i < 2 ? 2 * par->q_position * qp->g[BR_N][i][c] : 0.0;
    for (int k = BR_N - 1, side = 0; k >= 0; --k, side = !side)
        hessian_rows(mpc, k, tau, qp->costate[side], qp->costate[!side]);
    for (int k = 0; k < BR_N; ++k) {
        const int i = BR_NU * k;
        qp->h[i][i] += 2 * par->r_duty * (k + 1 < BR_N ? 2 : 1);
        if (k) qp->h[i][i - BR_NU] -= 2 * par->r_duty;
        qp->h[i + 1][i + 1] += 2 * par->r_delta_rate;
    }
}

/* Gradient of the QP at dU = 0 by the adjoint recursion along xbar. */
static void condense_gradient(br_mpc *mpc, double tau) {
    br_qp *qp = &mpc->qp;
    const br_mpc_parameters *par = &mpc->parameters;
    double p[BR_NX] = {0};
    for (int k = BR_N; k >= 0; --k) {
        double next[BR_NX] = {0};
        if (k < BR_N) {
            const br_stage *stage = &mpc->stage[k];
            const double *u = mpc->plan.u[k], *dx = qp->xbar[k];
            const double before = k ? mpc->plan.u[k - 1][0] : mpc->d_previous;
            const double after = k + 1 < BR_N ? mpc->plan.u[k + 1][0] - u[0] : 0.0;
            double r[BR_NU] = {2 * par->r_duty * (u[0] - before - after), 2 * par->r_delta_rate * u[1]};
            for (int c = 0; c < BR_NU; ++c) {
                for (int j = 0; j < BR_NX; ++j)
                    r[c] += stage->jacobian[j][BR_NX + c] * p[j] + tau * stage->hessian[BR_NX + c][j] * dx[j];
                qp->gradient[BR_NU * k + c] = r[c];
            }
            for (int i = 0; i < BR_NX; ++i)
                for (int j = 0; j < BR_NX; ++j)
                    next[i] += stage->jacobian[j][i] * p[j] + tau * stage->hessian[i][j] * dx[j];
        }
        if (k) {
            const br_mpc_reference *ref = &mpc->reference[k - 1];
            next[0] += 2 * par->q_position * (mpc->plan.x[k][0] + qp->xbar[k][0] - ref->x);
            next[1] += 2 * par->q_position * (mpc->plan.x[k][1] + qp->xbar[k][1] - ref->y);
        }
        memcpy(p, next, sizeof p);
    }
}

/* In-place Cholesky of the lower triangle; 0 if a pivot is not safely positive. */
static int cholesky(br_qp *qp) {
    double largest = 0;
    for (int i = 0; i < BR_M; ++i) largest = fmax(largest, fabs(qp->h[i][i]));
    for (int j = 0; j < BR_M; ++j) {
        double *restrict row = qp->h[j];
        for (int k = 0; k < j; ++k) {
            const double *restrict other = qp->h[k];
            double sum = row[k];
            for (int c = 0; c < k; ++c) sum -= row[c] * other[c];
            row[k] = sum * qp->diagonal[k];
        }
        double pivot = row[j];
        for (int c = 0; c < j; ++c) pivot -= row[c] * row[c];
        if (!(pivot > POSITIVE_DEFINITE * largest)) return 0;
        row[j] = sqrt(pivot);
        qp->diagonal[j] = 1.0 / row[j];
    }
    return 1;
}

/* Y = L^{-1} [A' | g]; the columns before ROW_TRACK belong to the inputs and steering angles. */
static inline __attribute__((always_inline)) void substitute(br_qp *qp, const int first,
                                                             const int last) {
    for (int r = 0; r < BR_M; ++r) {
        double *restrict y = qp->y[r];
        for (int c = 0; c < r; ++c) {
            const double l = qp->h[r][c];
            const double *restrict solved = qp->y[c];
            for (int i = first; i < last; ++i) y[i] -= l * solved[i];
        }
        for (int i = first; i < last; ++i) y[i] *= qp->diagonal[r];
    }
}

/* Rows of DAQP's matrix. Hard ones are scaled to unit length; soft ones stay in metres because DAQP
 * has one weight for all soft rows. */
static inline __attribute__((always_inline)) void fill_rows(br_qp *qp, const int first,
                                                            const int last) {
    for (int i = first; i < last; ++i)
        for (int r = 0; r < BR_M; ++r) qp->m[i * BR_M + r] = qp->scale[i] * qp->y[r][i];
}

/* What of the least-distance problem depends on the linearisation alone. */
static void transform(br_qp *qp) {
    BR_ALIGNED double norm2[BR_COLS] = {0};
    for (int r = 0; r < BR_M; ++r) {
        double *y = qp->y[r];
        memset(y, 0, sizeof qp->y[r]);
        y[r] = 1.0;
        for (int k = r / BR_NU; k < BR_N; ++k) y[ROW_DELTA + k] = qp->g[k + 1][6][r];
    }
    substitute(qp, 0, ROW_TRACK);
    for (int r = 0; r < BR_M; ++r)
        for (int i = 0; i < ROW_TRACK; ++i) norm2[i] += qp->y[r][i] * qp->y[r][i];
    for (int i = 0; i < BR_ROWS; ++i) qp->scale[i] = i < ROW_TRACK ? 1.0 / sqrt(norm2[i]) : 1.0;
    fill_rows(qp, 0, ROW_TRACK);
}

/* All that needs neither the measured state nor the reference. With the exact Hessian if that is
 * positive definite in the inputs; else with less and less of its second-order part, down to
 * Gauss-Newton, which always is. */
void br_qp_factorise(br_mpc *mpc) {
    static const double curvature[] = {1.0, 0.5, 0.25, 0.0};
    br_qp *qp = &mpc->qp;
    qp->factorised = 0;
    for (int k = 0; k < BR_N; ++k) propagate_sensitivity(qp->g[k + 1], qp->g[k], &mpc->stage[k], k);
    for (int attempt = 0; attempt < 4; ++attempt) {
        condense_hessian(mpc, curvature[attempt]);
        if (!cholesky(qp)) continue;
        qp->curvature = curvature[attempt];
        qp->regularised = attempt > 0;
        transform(qp);
        qp->factorised = 1;
        return;
    }
}

br_mpc_status br_qp_condense(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    if (!qp->factorised) br_qp_factorise(mpc);
    if (!qp->factorised) return BR_NOT_FINITE; /* Gauss-Newton is positive definite by construction */
    propagate_state(mpc);
    condense_gradient(mpc, qp->curvature);
    mpc->info.regularised += qp->regularised;
    return BR_CONVERGED;
}

static void bounds(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    const br_mpc_parameters *par = &mpc->parameters;
    for (int k = 0; k < BR_N; ++k) {
        const double *x = mpc->plan.x[k + 1], *dx = qp->xbar[k + 1];
        const br_mpc_reference *ref = &mpc->reference[k];
        const int d = BR_NU * k, rate = d + 1, delta = ROW_DELTA + k, track = ROW_TRACK + k;
        qp->lower[d] = mpc->d_lowest - mpc->plan.u[k][0];
        qp->upper[d] = par->d_max - mpc->plan.u[k][0];
        qp->lower[rate] = -par->delta_rate_max_radps - mpc->plan.u[k][1];
        qp->upper[rate] = par->delta_rate_max_radps - mpc->plan.u[k][1];
        qp->lower[delta] = -par->delta_max_rad - x[6] - dx[6];
        qp->upper[delta] = par->delta_max_rad - x[6] - dx[6];
        const double along = ref->normal_x * (x[0] + dx[0]) + ref->normal_y * (x[1] + dx[1]);
        qp->lower[track] = ref->lower + par->margin_m - along;
        qp->upper[track] = ref->upper - par->margin_m - along;
    }
}

/* The rest of the least-distance problem: half-planes and right-hand sides. */
static void fill_least_distance(br_mpc *mpc, int rows) {
    br_qp *qp = &mpc->qp;
    BR_ALIGNED double shift[BR_COLS] = {0};
    for (int r = 0; r < BR_M; ++r) {
        double *y = qp->y[r];
        for (int i = ROW_TRACK; i < BR_COLS; ++i) y[i] = 0;
        for (int k = r / BR_NU; k < BR_N; ++k) {
            const br_mpc_reference *ref = &mpc->reference[k];
            y[ROW_TRACK + k] = ref->normal_x * qp->g[k + 1][0][r] + ref->normal_y * qp->g[k + 1][1][r];
        }
        y[BR_ROWS] = qp->gradient[r];
    }
    substitute(qp, ROW_TRACK, BR_COLS);
    for (int r = 0; r < BR_M; ++r) {
        const double *restrict y = qp->y[r], v = y[BR_ROWS];
        for (int i = 0; i < BR_COLS; ++i) shift[i] += y[i] * v;
    }
    for (int i = 0; i < rows; ++i) {
        qp->dupper[i] = qp->scale[i] * (qp->upper[i] + shift[i]);
        qp->dlower[i] = qp->scale[i] * (qp->lower[i] + shift[i]);
    }
    if (rows > ROW_TRACK) fill_rows(qp, ROW_TRACK, BR_ROWS);
}

static int run_daqp(br_qp *qp, int rows, double slack_weight) {
    DAQPWorkspace *work = &qp->daqp;
    work->m = rows;
    work->ms = 0;
    work->lam = qp->lam[0];
    work->lam_star = qp->lam[1];
    qp->settings.rho_soft = slack_weight > 0 ? 1.0 / (2 * slack_weight) : 0.0;
    reset_daqp_workspace(work);
    activate_constraints(work);
    return daqp_ldp(work);
}

/* dU = L^{-T} (u - v) and the multipliers in the QP's units. */
static void recover(br_qp *qp) {
    for (int r = BR_M - 1; r >= 0; --r) {
        double sum = qp->u[r] - qp->y[r][BR_ROWS];
        for (int c = r + 1; c < BR_M; ++c) sum -= qp->h[c][r] * qp->delta_u[c];
        qp->delta_u[r] = sum * qp->diagonal[r];
    }
    memset(qp->multiplier, 0, sizeof qp->multiplier);
    for (int i = 0; i < qp->daqp.n_active; ++i) {
        const int row = qp->working_set[i];
        qp->multiplier[row] = qp->daqp.lam_star[i] * qp->scale[row];
    }
}

br_mpc_status br_qp_solve(br_mpc *mpc, int warm) {
    br_qp *qp = &mpc->qp;
    const double slack_weight = mpc->parameters.s_slack;
    const int rows = slack_weight > 0 ? BR_ROWS : ROW_TRACK;
    bounds(mpc);
    fill_least_distance(mpc, rows);
    if (!br_all_finite(qp->dupper, rows) || !br_all_finite(qp->dlower, rows)) return BR_NOT_FINITE;
    if (!warm) br_qp_forget_working_set(qp);
    int flag = run_daqp(qp, rows, slack_weight);
    mpc->info.qp_iterations += qp->daqp.iterations;
    if (flag < 0 && warm) { /* once more without the old working set before giving up */
        br_qp_forget_working_set(qp);
        flag = run_daqp(qp, rows, slack_weight);
        mpc->info.qp_iterations += qp->daqp.iterations;
    }
    if (flag == EXIT_INFEASIBLE) return BR_INFEASIBLE;
    if (flag < 0) return BR_QP_LIMIT;
    recover(qp);
    return br_all_finite(qp->delta_u, BR_M) && br_all_finite(qp->multiplier, BR_ROWS)
               ? BR_CONVERGED
               : BR_NOT_FINITE;
}
