"""The corrected model f_corr: the nominal one with the posterior mean added to vx, vy, omega.

Paper, eq. 7; how the correction reaches the pose is the discretisation's matter
(:meth:`bayesrace.integrators.Discretisation.corrected`).
"""

import casadi as ca

from bayesrace.errors import InputError
from bayesrace.gp.expression import mean_parameters, posterior_mean
from bayesrace.gp.weights import OUTPUTS, GpWeights
from bayesrace.integrators import Discretisation
from bayesrace.vehicles.models import Model

__all__ = ["corrected_function"]


def corrected_function(
    model: Model,
    discretisation: Discretisation,
    weights: GpWeights | None,
    check_identity: bool = True,
) -> ca.Function:
    """``(x, u) -> x_next`` of the discretised model plus the posterior mean, as MX function.

    ``weights`` None: no correction. InputError if they were learned for another discretised model,
    unless the caller knows why (``check_identity``).
    """
    identity = discretisation.identity(model.name, model.car)
    if weights is not None and check_identity and weights.discretisation != identity:
        raise InputError(
            f"weights '{weights.version}' were learned for {weights.discretisation}, not {identity}"
        )
    if weights is None or not any(output.count or output.y_mean for output in weights.outputs):
        return discretisation.discretise(model)
    f = discretisation.corrected(model)
    x, u = ca.MX.sym("x", 7), ca.MX.sym("u", 2)
    features = ca.vertcat(x[3:7], u)
    counts = [max(1, count) for count in weights.counts]
    flat = mean_parameters(weights, counts)
    size = len(flat) // len(OUTPUTS)
    means = [
        posterior_mean(output.kernel, features, *flat[j * size : (j + 1) * size])
        for j, output in enumerate(weights.outputs)
    ]
    return ca.Function("f_corr", [x, u], [f(x, u, ca.vertcat(*means))], ["x", "u"], ["x_next"])
