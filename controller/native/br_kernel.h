/* Correlations of the Gaussian processes and their slopes, for vectors of training points or of
 * queries: Rasmussen and Williams, "Gaussian Processes for Machine Learning", section 4.2. */
#ifndef BR_KERNEL_H
#define BR_KERNEL_H

#include "br_internal.h"

#define BR_SQRT3 1.7320508075688772
#define BR_SQRT5 2.23606797749979
#define BR_NEAR                                                                      \
    1e-8 /* distance in length scales below which 1 / r would lose more than it adds \
          */

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
