/* Posterior mean of the three Gaussian processes with gradient and Hessian.
 *
 * Native counterpart of bayesrace/gp/expression.py (tested against it and its derivatives): one
 * pass over the training points of an output, in vectors. With t = (z - z_i) / l and r = |t|,
 *   mean     = offset + sum a_i k(r)
 *   gradient = 1/l  * sum a_i g1(r) t            g1 = k'(r) / r
 *   Hessian  = 1/l^2 * sum a_i (g2(r) t t' + g1(r) I)   g2 = g1'(r) / r
 * which stays finite at r = 0 for RBF, Matern 3/2 and 5/2. The Matern 1/2 mean has a kink at each
 * training point: there the gradient of that point is taken as 0, and its Hessian is left out
 * altogether (a Gauss-Newton step for that output).
 */
#include <math.h>

#include "br_internal.h"

#define SQRT3 1.7320508075688772
#define SQRT5 2.23606797749979

typedef struct {
    br_vec k, g1, g2;
} kernel_value;

static inline __attribute__((always_inline)) kernel_value kernel(const int kind, br_vec r2) {
    kernel_value v;
    if (kind == BR_KERNEL_RBF) {
        v.k = br_exp_negative(-0.5 * r2);
        v.g1 = -v.k;
        v.g2 = v.k;
        return v;
    }
    const br_vec r = br_sqrt(r2);
    if (kind == BR_KERNEL_MATERN05) {
        v.k = br_exp_negative(-r);
        v.g1 = br_select(r > 1e-12, -v.k / r, br_splat(0.0));
        v.g2 = br_splat(0.0);
    } else if (kind == BR_KERNEL_MATERN15) {
        const br_vec e = br_exp_negative(-SQRT3 * r);
        v.k = (1.0 + SQRT3 * r) * e;
        v.g1 = -3.0 * e;
        v.g2 = br_select(r > 1e-12, 3.0 * SQRT3 * e / r, br_splat(0.0));
    } else {
        const br_vec e = br_exp_negative(-SQRT5 * r);
        v.k = (1.0 + SQRT5 * r + (5.0 / 3.0) * r2) * e;
        v.g1 = (-5.0 / 3.0) * (1.0 + SQRT5 * r) * e;
        v.g2 = (25.0 / 3.0) * e;
    }
    return v;
}

/* Points are taken in blocks that stay in the first-level cache: what needs the exponential is
 * computed once and stored, then the sums run over it with few enough accumulators for registers. */
#define BLOCK 64

typedef struct {
    BR_ALIGNED double t[BR_NZ][BLOCK];
    BR_ALIGNED double w1[BLOCK], w2[BLOCK]; /* alpha g1, alpha g2 */
} block;

static inline __attribute__((always_inline)) br_vec
fill_block(const int kind, const br_gp_output *gp, const br_vec query[BR_NZ], int first, int count,
           block *out) {
    br_vec sum = {0};
#pragma GCC unroll 2
    for (int i = 0; i < count; i += BR_LANES) {
        br_vec r2 = {0};
#pragma GCC unroll 6
        for (int a = 0; a < BR_NZ; ++a) {
            const br_vec t = query[a] - br_load(&gp->inputs[a][first + i]);
            br_store(&out->t[a][i], t);
            r2 += t * t;
        }
        const br_vec alpha = br_load(&gp->alpha[first + i]);
        const kernel_value v = kernel(kind, r2);
        br_store(&out->w1[i], alpha * v.g1);
        br_store(&out->w2[i], alpha * v.g2);
        sum += alpha * v.k;
    }
    return sum;
}

/* sums[0] += sum w1, sums[1 + a] += sum w1 t_a */
static inline void add_first_moments(const block *in, int count, br_vec sums[1 + BR_NZ]) {
    br_vec total = sums[0], s0 = sums[1], s1 = sums[2], s2 = sums[3], s3 = sums[4], s4 = sums[5],
           s5 = sums[6];
    for (int i = 0; i < count; i += BR_LANES) {
        const br_vec w = br_load(&in->w1[i]);
        total += w;
        s0 += w * br_load(&in->t[0][i]);
        s1 += w * br_load(&in->t[1][i]);
        s2 += w * br_load(&in->t[2][i]);
        s3 += w * br_load(&in->t[3][i]);
        s4 += w * br_load(&in->t[4][i]);
        s5 += w * br_load(&in->t[5][i]);
    }
    sums[0] = total, sums[1] = s0, sums[2] = s1, sums[3] = s2, sums[4] = s3, sums[5] = s4, sums[6] = s5;
}

/* Second moments sum w2 t_a t_b for b <= a, packed by rows: a = 0..3 and a = 4, 5. */
static inline void add_second_moments(const block *in, int count, br_vec sums[21]) {
    br_vec s00 = sums[0], s10 = sums[1], s11 = sums[2], s20 = sums[3], s21 = sums[4], s22 = sums[5],
           s30 = sums[6], s31 = sums[7], s32 = sums[8], s33 = sums[9];
    for (int i = 0; i < count; i += BR_LANES) {
        const br_vec w = br_load(&in->w2[i]);
        const br_vec t0 = br_load(&in->t[0][i]), t1 = br_load(&in->t[1][i]);
        const br_vec t2 = br_load(&in->t[2][i]), t3 = br_load(&in->t[3][i]);
        const br_vec w0 = w * t0, w1 = w * t1, w2 = w * t2, w3 = w * t3;
        s00 += w0 * t0;
        s10 += w1 * t0, s11 += w1 * t1;
        s20 += w2 * t0, s21 += w2 * t1, s22 += w2 * t2;
        s30 += w3 * t0, s31 += w3 * t1, s32 += w3 * t2, s33 += w3 * t3;
    }
    sums[0] = s00, sums[1] = s10, sums[2] = s11, sums[3] = s20, sums[4] = s21, sums[5] = s22;
    sums[6] = s30, sums[7] = s31, sums[8] = s32, sums[9] = s33;
    br_vec s40 = sums[10], s41 = sums[11], s42 = sums[12], s43 = sums[13], s44 = sums[14];
    br_vec s50 = sums[15], s51 = sums[16], s52 = sums[17], s53 = sums[18], s54 = sums[19], s55 = sums[20];
    for (int i = 0; i < count; i += BR_LANES) {
        const br_vec t4 = br_load(&in->t[4][i]), t5 = br_load(&in->t[5][i]);
        const br_vec w = br_load(&in->w2[i]), w4 = w * t4, w5 = w * t5;
        br_vec t = br_load(&in->t[0][i]);
        s40 += w4 * t, s50 += w5 * t;
        t = br_load(&in->t[1][i]);
        s41 += w4 * t, s51 += w5 * t;
        t = br_load(&in->t[2][i]);
        s42 += w4 * t, s52 += w5 * t;
        t = br_load(&in->t[3][i]);
        s43 += w4 * t, s53 += w5 * t;
        s44 += w4 * t4, s54 += w5 * t4, s55 += w5 * t5;
    }
    sums[10] = s40, sums[11] = s41, sums[12] = s42, sums[13] = s43, sums[14] = s44;
    sums[15] = s50, sums[16] = s51, sums[17] = s52, sums[18] = s53, sums[19] = s54, sums[20] = s55;
}

static inline __attribute__((always_inline)) void
evaluate(const int kind, const br_gp_output *gp, const double z[BR_NZ], double *mean,
         double gradient[BR_NZ], double hessian[BR_NZ][BR_NZ]) {
    br_vec query[BR_NZ], sum = {0}, first[1 + BR_NZ] = {{0}}, second[21] = {{0}};
    block points;
    for (int a = 0; a < BR_NZ; ++a) query[a] = br_splat(z[a] * gp->inverse_scale[a]);
    for (int i = 0; i < gp->n_padded; i += BLOCK) {
        const int count = gp->n_padded - i < BLOCK ? gp->n_padded - i : BLOCK;
        sum += fill_block(kind, gp, query, i, count, &points);
        add_first_moments(&points, count, first);
        if (kind != BR_KERNEL_MATERN05) add_second_moments(&points, count, second);
    }
    /* Matern 1/2: see above */
    const double curvature = kind == BR_KERNEL_MATERN05 ? 0.0 : br_sum(first[0]);
    *mean = gp->offset + br_sum(sum);
    for (int a = 0, e = 0; a < BR_NZ; ++a) {
        gradient[a] = br_sum(first[1 + a]) * gp->inverse_scale[a];
        for (int b = 0; b <= a; ++b, ++e) {
            const double h = br_sum(second[e]) + (a == b ? curvature : 0.0);
            hessian[a][b] = hessian[b][a] = h * gp->inverse_scale[a] * gp->inverse_scale[b];
        }
    }
}

void br_gp_evaluate(const br_gp *gp, const double z[BR_NZ], double mean[BR_NE],
                    double gradient[BR_NE][BR_NZ], double hessian[BR_NE][BR_NZ][BR_NZ]) {
    for (int j = 0; j < BR_NE; ++j) {
        const br_gp_output *out = &gp->output[j];
        switch (out->kernel) {
        case BR_KERNEL_RBF:
            evaluate(BR_KERNEL_RBF, out, z, &mean[j], gradient[j], hessian[j]);
            break;
        case BR_KERNEL_MATERN05:
            evaluate(BR_KERNEL_MATERN05, out, z, &mean[j], gradient[j], hessian[j]);
            break;
        case BR_KERNEL_MATERN15:
            evaluate(BR_KERNEL_MATERN15, out, z, &mean[j], gradient[j], hessian[j]);
            break;
        default:
            evaluate(BR_KERNEL_MATERN25, out, z, &mean[j], gradient[j], hessian[j]);
        }
    }
}

static int valid(const br_mpc_gp *in) {
    if (in->kernel < BR_KERNEL_RBF || in->kernel > BR_KERNEL_MATERN25) return 0;
    if (in->n < 0 || in->n > BR_GP_CAPACITY) return 0;
    if (!isfinite(in->offset) || !isfinite(in->scale)) return 0;
    if (in->n == 0) return 1;
    if (!in->length_scales || !in->inputs || !in->alpha) return 0;
    for (int a = 0; a < BR_NZ; ++a)
        if (!isfinite(in->length_scales[a]) || in->length_scales[a] <= 0) return 0;
    return br_all_finite(in->inputs, in->n * BR_NZ) && br_all_finite(in->alpha, in->n);
}

br_mpc_error br_gp_load(br_gp *gp, const br_mpc_gp outputs[BR_NE]) {
    for (int j = 0; j < BR_NE; ++j)
        if (!valid(&outputs[j])) return BR_ERROR_WEIGHTS;
    gp->any = 0;
    for (int j = 0; j < BR_NE; ++j) {
        const br_mpc_gp *in = &outputs[j];
        br_gp_output *out = &gp->output[j];
        out->kernel = in->kernel;
        out->offset = in->offset;
        out->n_padded = (in->n + BR_LANES - 1) / BR_LANES * BR_LANES;
        for (int a = 0; a < BR_NZ; ++a) {
            out->inverse_scale[a] = in->n ? 1.0 / in->length_scales[a] : 0.0;
            for (int i = 0; i < out->n_padded; ++i)
                out->inputs[a][i] = i < in->n ? in->inputs[i * BR_NZ + a] * out->inverse_scale[a] : 0;
        }
        for (int i = 0; i < out->n_padded; ++i) out->alpha[i] = i < in->n ? in->scale * in->alpha[i] : 0;
        /* finite numbers may overflow once scaled: refused here, not found out while driving */
        int finite = br_all_finite(out->alpha, out->n_padded) && br_all_finite(out->inverse_scale, BR_NZ);
        for (int a = 0; a < BR_NZ; ++a) finite = finite && br_all_finite(out->inputs[a], out->n_padded);
        if (!finite) return BR_ERROR_WEIGHTS;
        if (in->n || in->offset != 0.0) gp->any = 1;
    }
    return BR_OK;
}
