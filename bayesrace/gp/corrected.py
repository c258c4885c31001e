"""The corrected model f_corr = f_kin + [0, 0, 0, mu_vx, mu_vy, mu_omega, 0] (paper, eq. 7)."""

import casadi as ca

from bayesrace.gp.expression import mean_parameters, posterior_mean
from bayesrace.gp.weights import OUTPUTS, GpWeights
from bayesrace.integrators import Discretisation
from bayesrace.vehicles.models import Model

__all__ = ["corrected_function"]


def corrected_function(
    model: Model, discretisation: Discretisation, weights: GpWeights | None
) -> ca.Function:
    """``(x, u) -> x_next`` of the discretised model plus the posterior mean, as MX function.

    ``weights`` None: no correction.
    """
    nominal = discretisation.discretise(model)
    if weights is None or not any(output.count or output.y_mean for output in weights.outputs):
        return nominal
    x, u = ca.MX.sym("x", 7), ca.MX.sym("u", 2)
    features = ca.vertcat(x[3:7], u)
    counts = [max(1, count) for count in weights.counts]
    flat = mean_parameters(weights, counts)
    size = len(flat) // len(OUTPUTS)
    means = [
        posterior_mean(output.kernel, features, *flat[j * size : (j + 1) * size])
        for j, output in enumerate(weights.outputs)
    ]
    correction = ca.vertcat(ca.MX.zeros(3), *means, 0)
    return ca.Function("f_corr", [x, u], [nominal(x, u) + correction], ["x", "u"], ["x_next"])
