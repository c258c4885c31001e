/* The model and its uncertainty at one stage, for tests and tools. */
#include "br_internal.h"

br_mpc_error br_variance(br_mpc *mpc, const double v[BR_NV], double variance[BR_NE]) {
    if (!v || !variance) return BR_ERROR_NULL;
    double x[1][BR_NX], u[1][BR_NU], found[1][BR_NE];
    memcpy(x, v, sizeof x);
    memcpy(u, v + BR_NX, sizeof u);
    br_stages_variances(&mpc->gp[mpc->gp_in_use], 1, x, u, mpc->caution.correlations, found);
    memcpy(variance, found, sizeof found);
    return BR_OK;
}

br_mpc_error br_evaluate(const br_mpc *mpc, const double v[BR_NV], const double lambda[BR_NX],
                         double x_next[BR_NX], double jacobian[BR_NX * BR_NV],
                         double hessian[BR_NV * BR_NV]) {
    if (!v || !lambda || !x_next || !jacobian || !hessian) return BR_ERROR_NULL;
    BR_ALIGNED br_gp_row kernels[BR_NE * BR_GP_BLOCKS];
    const br_gp *gp = &mpc->gp[mpc->gp_in_use];
    double x[1][BR_NX], u[1][BR_NU], costate[1][BR_NX];
    memcpy(x, v, sizeof x);
    memcpy(u, v + BR_NX, sizeof u);
    memcpy(costate, lambda, sizeof costate);
    br_stage stage;
    br_stages_linearise(gp, 1, x, u, kernels, 1, 0, &stage);
    br_stages_curve(gp, 1, x, u, costate, kernels, &stage);
    memcpy(x_next, stage.f, sizeof stage.f);
    memcpy(jacobian, stage.jacobian, sizeof stage.jacobian);
    memcpy(hessian, stage.hessian, sizeof stage.hessian);
    return BR_OK;
}
