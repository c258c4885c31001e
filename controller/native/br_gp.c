/* Posterior mean of the Gaussian processes with gradient and Hessian.
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
 * computed once and stored, then the sums run over it with few enough accumulators for registers.
 */
#define BLOCK 64

typedef struct {
    BR_ALIGNED double t[BR_NZ][BLOCK];
    BR_ALIGNED double w1[BLOCK], w2[BLOCK]; /* alpha g1, alpha g2 */
} block;

static inline __attribute__((always_inline)) br_vec fill_block(const int kind,
                                                               const br_gp_output *gp,
                                                               const br_vec query[BR_NZ], int first,
                                                               int count, block *out) {
    br_vec sum = {0};
#pragma GCC unroll 2
    for (int i = 0; i < count; i += BR_LANES) {
        br_vec r2 = {0};
#pragma GCC unroll 16
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

#define UNROLL _Pragma("GCC unroll 16")
#define INLINE static inline __attribute__((always_inline))
#define SECOND_MOMENTS (BR_NZ * (BR_NZ + 1) / 2)

/* sums[0] += sum w1, sums[1 + a] += sum w1 t_a */
INLINE void add_first_moments(const block *in, int count, br_vec sums[1 + BR_NZ]) {
    br_vec total = sums[0], s[BR_NZ];
    UNROLL for (int a = 0; a < BR_NZ; ++a) s[a] = sums[1 + a];
    for (int i = 0; i < count; i += BR_LANES) {
        const br_vec w = br_load(&in->w1[i]);
        total += w;
        UNROLL for (int a = 0; a < BR_NZ; ++a) s[a] += w * br_load(&in->t[a][i]);
    }
    sums[0] = total;
    UNROLL for (int a = 0; a < BR_NZ; ++a) sums[1 + a] = s[a];
}

/* Second moments sum w2 t_a t_b for b <= a, packed by rows; of the rows first <= a < end, whose
 * sums have room in the registers. */
INLINE void add_rows(const block *in, int count, const int first, const int end,
                     br_vec sums[SECOND_MOMENTS]) {
    br_vec s[SECOND_MOMENTS];
    UNROLL for (int e = first * (first + 1) / 2; e < end * (end + 1) / 2; ++e) s[e] = sums[e];
    for (int i = 0; i < count; i += BR_LANES) {
        const br_vec w = br_load(&in->w2[i]);
        br_vec t[BR_NZ], wt[BR_NZ];
        UNROLL for (int a = 0; a < end; ++a) t[a] = br_load(&in->t[a][i]);
        UNROLL for (int a = first; a < end; ++a) wt[a] = w * t[a];
        UNROLL for (int a = first; a < end; ++a) UNROLL for (int b = 0; b <= a; ++b)
            s[a * (a + 1) / 2 + b] += wt[a] * t[b];
    }
    UNROLL for (int e = first * (first + 1) / 2; e < end * (end + 1) / 2; ++e) sums[e] = s[e];
}

static inline void add_second_moments(const block *in, int count, br_vec sums[SECOND_MOMENTS]) {
#define GROUP(first, end) add_rows(in, count, first, end, sums);
    BR_MOMENT_GROUPS
#undef GROUP
}

static inline __attribute__((always_inline)) void evaluate(const int kind, const br_gp_output *gp,
                                                           const double z[BR_NZ], double *mean,
                                                           double gradient[BR_NZ],
                                                           double hessian[BR_NZ][BR_NZ]) {
    br_vec query[BR_NZ], sum = {0}, first[1 + BR_NZ] = {{0}}, second[SECOND_MOMENTS] = {{0}};
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
                out->inputs[a][i] =
                    i < in->n ? in->inputs[i * BR_NZ + a] * out->inverse_scale[a] : 0;
        }
        for (int i = 0; i < out->n_padded; ++i)
            out->alpha[i] = i < in->n ? in->scale * in->alpha[i] : 0;
        /* finite numbers may overflow once scaled: refused here, not found out while driving */
        int finite =
            br_all_finite(out->alpha, out->n_padded) && br_all_finite(out->inverse_scale, BR_NZ);
        for (int a = 0; a < BR_NZ; ++a)
            finite = finite && br_all_finite(out->inputs[a], out->n_padded);
        if (!finite) return BR_ERROR_WEIGHTS;
        if (in->n || in->offset != 0.0) gp->any = 1;
    }
    return BR_OK;
}
