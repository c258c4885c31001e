/* Posterior mean of the Gaussian processes with gradient and Hessian, of many stages at a time.
 *
 * Native counterpart of bayesrace/gp/expression.py (tested against it and its derivatives). With
 * t = (z - z_i) / l and r = |t|,
 *   mean     = offset + sum a_i k(r)
 *   gradient = 1/l  * sum a_i g1(r) t            g1 = k'(r) / r
 *   Hessian  = 1/l^2 * sum a_i (g2(r) t t' + g1(r) I)   g2 = g1'(r) / r
 * which stays finite at r = 0 for RBF, Matern 3/2 and 5/2. The Matern 1/2 mean has a kink at each
 * training point: there the gradient of that point is taken as 0, and its Hessian is left out
 * altogether (a Gauss-Newton step for that output).
 *
 * What costs time are the kernels and the sums. The kernels are vectors of training points. The
 * sums are products of two matrices, as fast as the processor multiplies: the weights a_i g of all
 * stages, and the inputs p_i = z_i / l with their products, which are the same for all stages. With
 * q = z / l and the sums S of w_i, S_a of w_i p_ia, S_ab of w_i p_ia p_ib,
 *   sum w_i t_a     = q_a S - S_a
 *   sum w_i t_a t_b = q_a q_b S - q_a S_b - q_b S_a + S_ab
 * where p and q count from the middle of the training inputs, so that little is lost to rounding.
 *
 * br_gp_evaluate keeps the weights of the second derivatives, br_gp_curvature makes their sums when
 * and if they are needed.
 */
#include "br_internal.h"

#define INLINE static inline __attribute__((always_inline))

#define NEAR_RBF 37 /* length scales: exp(-r^2 / 2) is above 2^-1000 */

/* Weights of one block of training points for one stage: slope = a g1 and bend = a g2. Returns what
 * the points add to the mean. */
INLINE br_vec weigh_by(const int kind, const br_gp_output *gp, const double q[BR_NZ], int first,
                       int points, double *restrict slope, double *restrict bend) {
    br_vec query[BR_NZ], sum = {0};
    BR_UNROLL
    for (int a = 0; a < BR_NZ; ++a) query[a] = br_splat(q[a]);
    for (int i = first; i < first + points; i += BR_LANES) {
        br_vec r2 = {0};
        BR_UNROLL
        for (int a = 0; a < BR_NZ; ++a) {
            const br_vec t = query[a] - br_load(&gp->inputs[a][i]);
            r2 += t * t;
        }
        const br_vec alpha = br_load(&gp->alpha[i]);
        const br_kernel_value v = br_kernel(kind, r2);
        br_store(&slope[i - first], alpha * v.g1);
        br_store(&bend[i - first], alpha * v.g2);
        sum += alpha * v.k;
    }
    return sum;
}

/* The same for RBF, where k = -g1 = g2: without slope. -r^2 / 2 = q.p - |q|^2 / 2 - |p|^2 / 2,
 * which a kernel that is smooth at r = 0 allows. near: no point is far from q, as always but for
 * states out of range. */
INLINE br_vec weigh_rbf(const int near, const br_gp_output *gp, const double q[BR_NZ],
                        double square, int first, int points, double *restrict bend) {
    br_vec query[BR_NZ], sum = {0};
    BR_UNROLL
    for (int a = 0; a < BR_NZ; ++a) query[a] = br_splat(BR_LOG2_E * q[a]);
    const br_vec own = br_splat(-0.5 * BR_LOG2_E * square);
    for (int i = first; i < first + points; i += BR_LANES) {
        br_vec exponent = own + br_load(&gp->squares[i]);
        BR_UNROLL
        for (int a = 0; a < BR_NZ; ++a) exponent += query[a] * br_load(&gp->inputs[a][i]);
        const br_vec k = near ? br_exp2_near(exponent) : br_exp2_negative(exponent);
        const br_vec weight = br_load(&gp->alpha[i]) * k;
        br_store(&bend[i - first], weight);
        sum += weight;
    }
    return sum;
}

static int points_left(const br_gp_output *gp, int first) {
    const int left = gp->n_padded - first;
    return left < BR_GP_BLOCK ? left : BR_GP_BLOCK;
}

static br_vec weigh(const br_gp_output *gp, const double q[BR_NZ], int first, double *slope,
                    double *bend) {
    const int points = points_left(gp, first);
    switch (gp->kernel) {
    case BR_KERNEL_RBF: {
        double square = 0;
        for (int a = 0; a < BR_NZ; ++a) square += q[a] * q[a];
        if (sqrt(square) + gp->reach < NEAR_RBF)
            return weigh_rbf(1, gp, q, square, first, points, bend);
        return weigh_rbf(0, gp, q, square, first, points, bend);
    }
    case BR_KERNEL_MATERN05:
        return weigh_by(BR_KERNEL_MATERN05, gp, q, first, points, slope, bend);
    case BR_KERNEL_MATERN15:
        return weigh_by(BR_KERNEL_MATERN15, gp, q, first, points, slope, bend);
    default:
        return weigh_by(BR_KERNEL_MATERN25, gp, q, first, points, slope, bend);
    }
}

/* Stages whose sums over eight columns have room in the registers. */
#define PARTS (8 / BR_LANES)
#define TILE (10 / PARTS)

/* sums[s] += sum_i weights[s][i] columns[i], of so many stages; the sums of a stage are `stride`
 * after those of the one before. In the same order for one stage as for a tile of them: a stage has
 * the same bits in any company. */
INLINE void add_tile(const int stages, int points, const double (*restrict columns)[8],
                     br_gp_row *restrict weights, double *restrict sums, const int stride) {
    br_vec total[TILE][PARTS];
    BR_UNROLL
    for (int s = 0; s < stages; ++s) BR_UNROLL
    for (int p = 0; p < PARTS; ++p) total[s][p] = br_load(&sums[stride * s + BR_LANES * p]);
    for (int i = 0; i < points; ++i) {
        br_vec row[PARTS];
        BR_UNROLL
        for (int p = 0; p < PARTS; ++p) row[p] = br_load(&columns[i][BR_LANES * p]);
        BR_UNROLL
        for (int s = 0; s < stages; ++s) BR_UNROLL
        for (int p = 0; p < PARTS; ++p) total[s][p] += weights[s][i] * row[p];
    }
    BR_UNROLL
    for (int s = 0; s < stages; ++s) BR_UNROLL
    for (int p = 0; p < PARTS; ++p) br_store(&sums[stride * s + BR_LANES * p], total[s][p]);
}

/* The same for any number of stages, of one block of points, in so many groups of columns. */
static void add_sums(const br_gp_output *gp, int first, int group, const int groups, int stages,
                     br_gp_row *weights, double *sums) {
    const int points = points_left(gp, first), stride = 8 * groups;
    for (int g = 0; g < groups; ++g) {
        const double (*columns)[8] = &gp->columns[group + g][first];
        int s = 0;
        for (; s + TILE <= stages; s += TILE)
            add_tile(TILE, points, columns, weights + s, &sums[stride * s + 8 * g], stride);
        for (; s < stages; ++s)
            add_tile(1, points, columns, weights + s, &sums[stride * s + 8 * g], stride);
    }
}

static void scaled(const br_gp_output *gp, const double z[BR_NZ], double q[BR_NZ]) {
    for (int a = 0; a < BR_NZ; ++a) q[a] = z[a] * gp->inverse_scale[a] - gp->middle[a];
}

void br_gp_evaluate(const br_gp *gp, int stages, double (*z)[BR_NZ], br_gp_row *kept, int room,
                    br_correction *const out[]) {
    for (int j = 0; j < BR_NE; ++j) {
        const br_gp_output *output = &gp->output[j];
        const int rbf = output->kernel == BR_KERNEL_RBF;
        BR_ALIGNED br_gp_row slope[BR_N];
        BR_ALIGNED double sums[BR_N][8 * BR_GP_FIRST];
        br_vec mean[BR_N];
        double q[BR_N][BR_NZ];
        memset(sums, 0, (size_t)stages * sizeof sums[0]);
        for (int s = 0; s < stages; ++s) {
            scaled(output, z[s], q[s]);
            mean[s] = br_splat(0.0);
        }
        br_gp_row *bend = kept + BR_GP_BLOCKS * room * j;
        for (int first = 0; first < output->n_padded; first += BR_GP_BLOCK, bend += room) {
            for (int s = 0; s < stages; ++s)
                mean[s] += weigh(output, q[s], first, slope[s], bend[s]);
            add_sums(output, first, 0, BR_GP_FIRST, stages, rbf ? bend : slope, sums[0]);
        }
        for (int s = 0; s < stages; ++s) {
            double *slopes = out[s]->sums[j];
            out[s]->mean[j] = output->offset + br_sum(mean[s]);
            for (int c = 0; c < 8 * BR_GP_FIRST; ++c) slopes[c] = rbf ? -sums[s][c] : sums[s][c];
            for (int a = 0; a < BR_NZ; ++a)
                out[s]->gradient[j][a] =
                    (q[s][a] * slopes[0] - slopes[1 + a]) * output->inverse_scale[a];
        }
    }
}

void br_gp_mean(const br_gp *gp, const double z[BR_NZ], double mean[BR_NE]) {
    for (int j = 0; j < BR_NE; ++j) {
        const br_gp_output *output = &gp->output[j];
        BR_ALIGNED br_gp_row unused[2];
        br_vec sum = {0};
        double q[BR_NZ];
        scaled(output, z, q);
        for (int first = 0; first < output->n_padded; first += BR_GP_BLOCK)
            sum += weigh(output, q, first, unused[0], unused[1]);
        mean[j] = output->offset + br_sum(sum);
    }
}

/* out += weight * d2 mu / d z2 of one output, from the sums of a g1 (that over all points) and
 * of a g2. */
static void add_hessian(const br_gp_output *gp, const double q[BR_NZ], double weight, double trace,
                        const double *first, const double *second, double out[BR_NZ][BR_NZ]) {
    for (int a = 0, e = 0; a < BR_NZ; ++a)
        for (int b = 0; b <= a; ++b, ++e) {
            const double h = q[a] * q[b] * first[0] - q[a] * first[1 + b] - q[b] * first[1 + a] +
                             second[e] + (a == b ? trace : 0.0);
            out[a][b] += weight * h * gp->inverse_scale[a] * gp->inverse_scale[b];
        }
}

void br_gp_curvature(const br_gp *gp, int stages, double (*z)[BR_NZ], br_gp_row *kept,
                     const br_correction *const values[], double (*weight)[BR_NE],
                     double (*out)[BR_NZ][BR_NZ]) {
    memset(out, 0, (size_t)stages * sizeof out[0]);
    for (int j = 0; j < BR_NE; ++j) {
        const br_gp_output *output = &gp->output[j];
        if (output->kernel == BR_KERNEL_MATERN05) continue; /* see above */
        BR_ALIGNED double first[BR_N][8 * BR_GP_FIRST], second[BR_N][8 * BR_GP_SECOND];
        memset(first, 0, (size_t)stages * sizeof first[0]);
        memset(second, 0, (size_t)stages * sizeof second[0]);
        br_gp_row *bend = kept + BR_GP_BLOCKS * stages * j;
        for (int i = 0; i < output->n_padded; i += BR_GP_BLOCK, bend += stages) {
            add_sums(output, i, BR_GP_FIRST, BR_GP_SECOND, stages, bend, second[0]);
            if (output->kernel != BR_KERNEL_RBF)
                add_sums(output, i, 0, BR_GP_FIRST, stages, bend, first[0]);
        }
        for (int s = 0; s < stages; ++s) {
            const double *slopes = values[s]->sums[j];
            double q[BR_NZ];
            scaled(output, z[s], q);
            if (output->kernel == BR_KERNEL_RBF)
                for (int c = 0; c < 1 + BR_NZ; ++c) first[s][c] = -slopes[c];
            add_hessian(output, q, weight[s][j], slopes[0], first[s], second[s], out[s]);
        }
    }
    for (int s = 0; s < stages; ++s)
        for (int a = 0; a < BR_NZ; ++a)
            for (int b = 0; b < a; ++b) out[s][b][a] = out[s][a][b];
}

static int valid(const br_mpc_gp *in) {
    if (in->kernel < BR_KERNEL_RBF || in->kernel > BR_KERNEL_MATERN25) return 0;
    if (in->n < 0 || in->n > BR_GP_CAPACITY) return 0;
    if (!isfinite(in->offset) || !isfinite(in->scale)) return 0;
    if (!(isfinite(in->signal) && in->signal >= 0 && isfinite(in->noise) && in->noise >= 0))
        return 0;
    if (in->n == 0) return 1;
    if (!in->length_scales || !in->inputs || !in->alpha) return 0;
    for (int a = 0; a < BR_NZ; ++a)
        if (!isfinite(in->length_scales[a]) || in->length_scales[a] <= 0) return 0;
    return br_all_finite(in->inputs, in->n * BR_NZ) && br_all_finite(in->alpha, in->n);
}

/* A training point, whose scaled inputs are in store, among the columns of the sums. The square of
 * the longest is left in reach. */
static void fill_columns(br_gp_output *out, int i) {
    double row[8 * (BR_GP_FIRST + BR_GP_SECOND)] = {1.0}, square = 0;
    for (int a = 0, e = 8 * BR_GP_FIRST; a < BR_NZ; ++a) {
        row[1 + a] = out->inputs[a][i];
        square += row[1 + a] * row[1 + a];
        for (int b = 0; b <= a; ++b, ++e) row[e] = row[1 + a] * row[1 + b];
    }
    for (int g = 0; g < BR_GP_FIRST + BR_GP_SECOND; ++g)
        memcpy(out->columns[g][i], &row[8 * g], sizeof out->columns[g][i]);
    out->squares[i] = -0.5 * BR_LOG2_E * square;
    if (square > out->reach) out->reach = square;
}

/* Inputs and weights of one output as the kernel wants them; 0 if they are not finite there. What
 * fills the last vectors is the middle of the inputs, without weight. */
static int load(br_gp_output *out, const br_mpc_gp *in) {
    out->kernel = in->kernel;
    out->offset = in->offset;
    out->reach = 0;
    out->n_padded = (in->n + BR_WIDEST - 1) / BR_WIDEST * BR_WIDEST;
    for (int i = 0; i < out->n_padded; ++i)
        out->alpha[i] = i < in->n ? in->scale * in->alpha[i] : 0;
    for (int a = 0; a < BR_NZ; ++a) {
        const double inverse_scale = in->n ? 1.0 / in->length_scales[a] : 0.0;
        double middle = 0;
        for (int i = 0; i < in->n; ++i) middle += in->inputs[i * BR_NZ + a];
        if (in->n) middle *= inverse_scale / in->n;
        for (int i = 0; i < out->n_padded; ++i)
            out->inputs[a][i] = i < in->n ? in->inputs[i * BR_NZ + a] * inverse_scale - middle : 0;
        out->inverse_scale[a] = inverse_scale;
        out->middle[a] = middle;
    }
    for (int i = 0; i < out->n_padded; ++i) fill_columns(out, i);
    out->reach = sqrt(out->reach);
    /* where the squares are finite, inputs and products are */
    return br_all_finite(out->alpha, out->n_padded) && br_all_finite(out->squares, out->n_padded) &&
           br_all_finite(out->inverse_scale, BR_NZ);
}

/* FNV-1a, by words. */
static uint64_t hash(uint64_t so_far, const double *numbers, int count) {
    for (int i = 0; i < count; ++i) {
        uint64_t word;
        memcpy(&word, &numbers[i], sizeof word);
        so_far = (so_far ^ word) * 1099511628211u;
    }
    return so_far;
}

static uint64_t identity(const br_mpc_gp outputs[BR_NE]) {
    uint64_t so_far = 14695981039346656037u;
    for (int j = 0; j < BR_NE; ++j) {
        const br_mpc_gp *in = &outputs[j];
        const double numbers[] = {in->kernel, in->n, in->offset, in->scale, in->signal, in->noise};
        so_far = hash(so_far, numbers, sizeof numbers / sizeof numbers[0]);
        if (in->n == 0) continue;
        so_far = hash(so_far, in->length_scales, BR_NZ);
        so_far = hash(so_far, in->inputs, in->n * BR_NZ);
        so_far = hash(so_far, in->alpha, in->n);
    }
    return so_far;
}

/* No residual, and an unknown uncertainty. The arrays are written when they are filled, so that
 * memory for points that never come is not taken from the system. */
void br_gp_clear(br_gp *gp) {
    gp->any = gp->uncertain = 0;
    gp->identity = 0;
    for (int j = 0; j < BR_NE; ++j) {
        memset(&gp->output[j], 0, offsetof(br_gp_output, inputs));
        memset(&gp->variance[j], 0, offsetof(br_gp_variance, inputs));
    }
}

br_mpc_error br_gp_load(br_gp *gp, const br_mpc_gp outputs[BR_NE]) {
    for (int j = 0; j < BR_NE; ++j)
        if (!valid(&outputs[j])) return BR_ERROR_WEIGHTS;
    gp->any = gp->uncertain = 0;
    gp->identity = identity(outputs);
    for (int j = 0; j < BR_NE; ++j) {
        /* finite numbers may overflow once scaled: refused here, not found out while driving */
        if (!load(&gp->output[j], &outputs[j])) return BR_ERROR_WEIGHTS;
        br_variance_load(&gp->output[j], &outputs[j], &gp->variance[j]);
        if (outputs[j].n || outputs[j].offset != 0.0) gp->any = 1;
        if (outputs[j].signal > 0) gp->uncertain = 1;
    }
    return BR_OK;
}
