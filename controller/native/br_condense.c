/* Condensing: the QP's states are functions of its inputs, dx_k = xbar_k + G_k dU. Sensitivities
 * G_k, Hessian and gradient of the QP in the inputs alone, by recursions along the horizon. What is
 * zero by the problem's sparsity is left out. dU has one entry for each input of a block: a column
 * of G_k is the sum of those of the block's stages before k.
 */
#include "br_internal.h"

/* G_{k+1} = [A_k G_k, B_k], or, within a block, B_k added to its columns. */
static void propagate_sensitivity(double (*restrict next)[BR_MP], double (*restrict g)[BR_MP],
                                  const br_stage *stage, int k) {
    const int opens = br_opens_block(k), own = BR_NU * BR_BLOCK_OF(k);
    const int columns = br_padded(opens ? own : own + BR_NU);
    BR_UNROLL
    for (int i = 0; i < BR_NX; ++i) {
        double weight[BR_NX];
        const double *rows[BR_NX];
        int count = 0;
        BR_UNROLL
        for (int n = BR_A_START[i]; n < BR_A_START[i + 1]; ++n, ++count) {
            weight[count] = stage->jacobian[i][BR_A_INDEX[n]];
            rows[count] = g[BR_A_INDEX[n]];
        }
        br_combine(next[i], columns, 0, count, weight, rows);
        BR_UNROLL
        for (int c = 0; c < BR_NU; ++c)
            next[i][own + c] = (opens ? 0 : next[i][own + c]) + stage->jacobian[i][BR_NX + c];
    }
}

void br_condense_states(br_mpc *mpc) {
    br_qp *qp = &mpc->qp;
    for (int k = 0; k < BR_N; ++k) propagate_sensitivity(qp->g[k + 1], qp->g[k], &mpc->stage[k], k);
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

/* One step of the backward recursion for the Hessian's rows of stage k, columns of its block and of
 * those before: H_k = B' P + S [G_k, I],  P <- A' P + (W + second derivatives of cost and rows)
 * G_k, the second-order part of dynamics and rows with the weight tau. Rows of a block add up; so
 * that its earlier stages meet the later ones, P has the columns of the block's inputs, S', too. */
static void hessian_rows(br_mpc *mpc, int k, double tau, double (*restrict p)[BR_MP],
                         double (*restrict p_next)[BR_MP]) {
    br_qp *qp = &mpc->qp;
    const br_stage *stage = &mpc->stage[k];
    const int own = BR_NU * BR_BLOCK_OF(k), opens = br_opens_block(k);
    const int columns = br_padded(own + BR_NU), before = opens ? br_padded(own) : columns;
    const int adds = k + 1 < BR_N && !br_opens_block(k + 1);
    double (*restrict g)[BR_MP] = qp->g[k];
    double weight[2 * BR_NX];
    const double *rows[2 * BR_NX];
    BR_UNROLL
    for (int r = 0; r < BR_NU; ++r) {
        double *restrict row = qp->h[own + r];
        int count = 0;
        BR_UNROLL
        for (int n = BR_BT_START[r]; n < BR_BT_START[r + 1]; ++n, ++count) {
            weight[count] = stage->jacobian[BR_BT_INDEX[n]][BR_NX + r];
            rows[count] = p[BR_BT_INDEX[n]];
        }
        br_combine(row, columns, adds, count, weight, rows);
        count = 0;
        BR_UNROLL
        for (int n = BR_WUX_START[r]; n < BR_WUX_START[r + 1]; ++n, ++count) {
            weight[count] = tau * stage->hessian[BR_NX + r][BR_WUX_INDEX[n]];
            rows[count] = g[BR_WUX_INDEX[n]];
        }
        br_combine(row, before, 1, count, weight, rows);
        BR_UNROLL
        for (int c = 0; c < BR_NU; ++c) row[own + c] += tau * stage->hessian[BR_NX + r][BR_NX + c];
    }
    if (k == 0) return;
    BR_UNROLL
    for (int i = 0; i < BR_NX; ++i) {
        int count = 0;
        BR_UNROLL
        for (int n = BR_AT_START[i]; n < BR_AT_START[i + 1]; ++n, ++count) {
            weight[count] = stage->jacobian[BR_AT_INDEX[n]][i];
            rows[count] = p[BR_AT_INDEX[n]];
        }
        BR_UNROLL
        for (int n = BR_WXX_START[i]; n < BR_WXX_START[i + 1]; ++n, ++count) {
            weight[count] = tau * stage->hessian[i][BR_WXX_INDEX[n]];
            rows[count] = g[BR_WXX_INDEX[n]];
        }
        br_combine(p_next[i], before, 0, count, weight, rows);
        if (opens) continue;
        BR_UNROLL
        for (int c = 0; c < BR_NU; ++c) p_next[i][own + c] += tau * stage->hessian[i][BR_NX + c];
    }
    br_stage_curvature *second = &qp->second[k - 1];
    BR_UNROLL
    for (int n = 0; n < BR_CXX_NNZ; ++n) {
        rows[0] = g[BR_CXX_COLUMN[n]];
        br_combine(p_next[BR_CXX_ROW[n]], before, 1, 1, &second->cost_xx[n], rows);
    }
    BR_UNROLL
    for (int n = 0; n < BR_RXX_NNZ; ++n) {
        weight[0] = tau * second->rows_xx[n];
        rows[0] = g[BR_RXX_COLUMN[n]];
        br_combine(p_next[BR_RXX_ROW[n]], before, 1, 1, weight, rows);
    }
}

/* What of the cost couples the inputs of stage k with each other and with those before. */
static void add_input_curvature(br_qp *qp, int k) {
    const int i = BR_NU * BR_BLOCK_OF(k), before = i - BR_NU, opens = br_opens_block(k);
    double (*uu)[2 * BR_NU] = qp->second[k].uu;
    for (int a = 0; a < BR_NU; ++a)
        for (int b = 0; b < BR_NU; ++b) {
            const double later = k + 1 < BR_N ? qp->second[k + 1].uu[BR_NU + a][BR_NU + b] : 0.0;
            qp->h[i + a][i + b] += uu[a][b] + later;
            if (!opens)
                qp->h[i + a][i + b] += uu[a][BR_NU + b] + uu[BR_NU + a][b];
            else if (k)
                qp->h[i + a][before + b] += uu[a][BR_NU + b];
        }
}

void br_condense_hessian(br_mpc *mpc, double tau) {
    br_qp *qp = &mpc->qp;
    const br_stage_curvature *final = &qp->second[BR_N - 1];
    memset(qp->costate[0], 0, sizeof qp->costate[0]);
    for (int n = 0; n < BR_CXX_NNZ; ++n)
        for (int c = 0; c < BR_MP; ++c)
            qp->costate[0][BR_CXX_ROW[n]][c] +=
                final->cost_xx[n] * qp->g[BR_N][BR_CXX_COLUMN[n]][c];
    for (int n = 0; n < BR_RXX_NNZ; ++n)
        for (int c = 0; c < BR_MP; ++c)
            qp->costate[0][BR_RXX_ROW[n]][c] +=
                tau * final->rows_xx[n] * qp->g[BR_N][BR_RXX_COLUMN[n]][c];
    for (int k = BR_N - 1, side = 0; k >= 0; --k, side = !side)
        hessian_rows(mpc, k, tau, qp->costate[side], qp->costate[!side]);
    for (int k = 0; k < BR_N; ++k) add_input_curvature(qp, k);
}

/* By the adjoint recursion along xbar. */
void br_condense_gradient(br_mpc *mpc, double tau) {
    br_qp *qp = &mpc->qp;
    propagate_state(mpc);
    double p[BR_NX] = {0};
    for (int k = BR_N; k >= 0; --k) {
        double next[BR_NX] = {0};
        if (k < BR_N) {
            const br_stage *stage = &mpc->stage[k];
            const double *dx = qp->xbar[k];
            const int adds = k + 1 < BR_N && !br_opens_block(k + 1);
            BR_UNROLL
            for (int c = 0; c < BR_NU; ++c) {
                double sum =
                    qp->terms[k].in_u[c] + (k + 1 < BR_N ? qp->terms[k + 1].in_u_before[c] : 0.0);
                for (int j = 0; j < BR_NX; ++j) sum += stage->jacobian[j][BR_NX + c] * p[j];
                BR_UNROLL
                for (int n = BR_WUX_START[c]; n < BR_WUX_START[c + 1]; ++n)
                    sum += tau * stage->hessian[BR_NX + c][BR_WUX_INDEX[n]] * dx[BR_WUX_INDEX[n]];
                double *entry = &qp->gradient[BR_NU * BR_BLOCK_OF(k) + c];
                *entry = (adds ? *entry : 0) + sum;
            }
            BR_UNROLL
            for (int i = 0; i < BR_NX; ++i) {
                BR_UNROLL
                for (int n = BR_AT_START[i]; n < BR_AT_START[i + 1]; ++n)
                    next[i] += stage->jacobian[BR_AT_INDEX[n]][i] * p[BR_AT_INDEX[n]];
                BR_UNROLL
                for (int n = BR_WXX_START[i]; n < BR_WXX_START[i + 1]; ++n)
                    next[i] += tau * stage->hessian[i][BR_WXX_INDEX[n]] * dx[BR_WXX_INDEX[n]];
            }
        }
        if (k) {
            BR_UNROLL
            for (int i = 0; i < BR_NX; ++i) next[i] += qp->terms[k - 1].in_x[i];
            br_add_curvature(&qp->second[k - 1], tau, qp->xbar[k], next);
        }
        memcpy(p, next, sizeof p);
    }
}
