/* Gaussian processes: their weights as the step wants them, kernels, mean and variance. */
#ifndef BR_KERNEL_H
#define BR_KERNEL_H

#include "bayesrace_mpc.h"
#include "br_vector.h"

/* Training points that are taken at a time: in the first-level cache. */
#define BR_GP_BLOCK (BR_GP_CAPACITY < 128 ? (BR_GP_CAPACITY + 7) / 8 * 8 : 128)
#define BR_GP_BLOCKS ((BR_GP_CAPACITY + BR_GP_BLOCK - 1) / BR_GP_BLOCK)
#define BR_GP_PADDED (BR_GP_BLOCKS * BR_GP_BLOCK)
/* Training points that the posterior variance is exact with: the memory for it grows with the
 * square. */
#define BR_GP_ROOT (BR_GP_CAPACITY < 512 ? (BR_GP_CAPACITY + 7) / 8 * 8 : 512)
#define BR_ROOT_TILE 8 /* rows of a triangular matrix that are stored together */
#define BR_ROOT_SIZE(n) \
    ((n) * ((n) + BR_ROOT_TILE) / 2)      /* numbers of n rows, whole tiles of them */
#define BR_COLUMNS 8                      /* stages whose correlations are at hand at a time */
#define BR_GP_FIRST ((1 + BR_NZ + 7) / 8) /* groups of eight columns for 1 and the inputs ... */
#define BR_GP_SECOND ((BR_NZ * (BR_NZ + 1) / 2 + 7) / 8) /* ... and for their products */

/* One output of the residual as the kernel wants it: scaled features, structure of arrays. */
typedef struct {
    int kernel, n_padded;
    double offset;
    double inverse_scale[BR_NZ], middle[BR_NZ]; /* z * inverse_scale - middle is what is in ... */
    double reach;                               /* length of the longest input */
    BR_ALIGNED double inputs[BR_NZ][BR_GP_PADDED];
    BR_ALIGNED double alpha[BR_GP_PADDED];   /* signal scale folded in */
    BR_ALIGNED double squares[BR_GP_PADDED]; /* of the length of the inputs, times -log2(e) / 2 */
    BR_ALIGNED double columns[BR_GP_FIRST + BR_GP_SECOND][BR_GP_PADDED][8];
} br_gp_output;

/* What the posterior variance of one output is made from: see br_variance.c. */
typedef struct {
    int kernel, count;    /* training points that count */
    double signal, noise; /* variances; signal 0: not known */
    double inputs[BR_NZ][BR_GP_ROOT];
    BR_ALIGNED double root[BR_ROOT_SIZE(BR_GP_ROOT)];
} br_gp_variance;

typedef struct {
    int any; /* 0 while every output is constant zero: WorstCase and BestCase skip the kernels */
    int uncertain;     /* the variance of an output is known */
    uint64_t identity; /* of the weights that are loaded: equal if these are */
    br_gp_output output[BR_NE];
    br_gp_variance variance[BR_NE];
} br_gp;

/* Weights of one block of training points. */
typedef double br_gp_row[BR_GP_BLOCK];

/* The residual at one stage. */
typedef struct {
    double mean[BR_NE], gradient[BR_NE][BR_NZ];
    double sums[BR_NE][8 * BR_GP_FIRST]; /* for br_gp_curvature */
} br_correction;

/* --- br_gp.c --- */

/* Mean and gradient of several stages, at most BR_N, into out[s]. Their weights for br_gp_curvature
 * go into kept, which has room for those of so many stages: (output, block, stage), row by row. */
BR_PART void br_gp_evaluate(const br_gp *gp, int stages, double (*z)[BR_NZ], br_gp_row *kept,
                            int room, br_correction *const out[]);
/* Of all stages that kept has room for, out[s] = sum_j weight[s][j] d^2 mu_j / d z^2. */
BR_PART void br_gp_curvature(const br_gp *gp, int stages, double (*z)[BR_NZ], br_gp_row *kept,
                             const br_correction *const values[], double (*weight)[BR_NE],
                             double (*out)[BR_NZ][BR_NZ]);
BR_PART void br_gp_clear(br_gp *gp);
BR_PART void br_gp_mean(const br_gp *gp, const double z[BR_NZ], double mean[BR_NE]);
BR_PART br_mpc_error br_gp_load(br_gp *gp, const br_mpc_gp outputs[BR_NE]);

/* --- br_variance.c --- */

/* Of one output whose weights are loaded. */
BR_PART void br_variance_load(const br_gp_output *gp, const br_mpc_gp *in, br_gp_variance *v);
/* Noise included, of several stages; 0 where it is not known. */
BR_PART void br_gp_variances(const br_gp *gp, int stages, double (*z)[BR_NZ],
                             double (*work)[BR_COLUMNS], double (*variance)[BR_NE]);

/* --- correlations and their slopes, for vectors of training points or of queries: Rasmussen and
 * Williams, "Gaussian Processes for Machine Learning", section 4.2 --- */

#define BR_SQRT3 1.7320508075688772
#define BR_SQRT5 2.23606797749979
#define BR_NEAR 1e-8 /* length scales: nearer, 1 / r would lose more than it adds */

typedef struct {
    br_vec k, g1, g2;
} br_kernel_value;

/* k(r), g1 = k'(r) / r and g2 = g1'(r) / r at the squared distance r2 in length scales. What is not
 * used costs nothing. */
static inline __attribute__((always_inline)) br_kernel_value br_kernel(const int kind, br_vec r2) {
    br_kernel_value v;
    if (kind == BR_KERNEL_RBF) {
        v.k = v.g2 = br_exp2_negative((-0.5 * BR_LOG2_E) * r2);
        v.g1 = -v.k;
        return v;
    }
    const br_vec inverse = br_inverse_root(r2), r = r2 * inverse;
    if (kind == BR_KERNEL_MATERN05) {
        v.k = br_exp2_negative(-BR_LOG2_E * r);
        v.g1 = br_select(r > BR_NEAR, -v.k * inverse, br_splat(0.0));
        v.g2 = br_splat(0.0);
    } else if (kind == BR_KERNEL_MATERN15) {
        const br_vec e = br_exp2_negative(-BR_SQRT3 * BR_LOG2_E * r);
        v.k = (1.0 + BR_SQRT3 * r) * e;
        v.g1 = -3.0 * e;
        v.g2 = br_select(r > BR_NEAR, 3.0 * BR_SQRT3 * e * inverse, br_splat(0.0));
    } else {
        const br_vec e = br_exp2_negative(-BR_SQRT5 * BR_LOG2_E * r);
        v.k = (1.0 + BR_SQRT5 * r + (5.0 / 3.0) * r2) * e;
        v.g1 = (-5.0 / 3.0) * (1.0 + BR_SQRT5 * r) * e;
        v.g2 = (25.0 / 3.0) * e;
    }
    return v;
}

#endif
