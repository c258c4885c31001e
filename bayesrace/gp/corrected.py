"""The corrected model f_corr: the nominal one with the posterior mean added to vx, vy, omega.

Paper, eq. 7; :meth:`bayesrace.integrators.Discretisation.corrected` derives the pose.
"""

import casadi as ca

from bayesrace.errors import InputError
from bayesrace.gp.expression import mean_function
from bayesrace.gp.weights import GpWeights
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
    unless ``check_identity`` is False.
    """
    identity = discretisation.identity(model.name, model.car)
    if weights is not None and check_identity and weights.discretisation != identity:
        raise InputError(
            f"weights '{weights.version}' were learned for {weights.discretisation}, not {identity}"
        )
    if weights is None or not any(output.count or output.y_mean for output in weights.outputs):
        return discretisation.discretise(model)
    x, u = ca.MX.sym("x", 7), ca.MX.sym("u", 2)
    mean = mean_function(weights)(ca.vertcat(x[3:7], u))
    x_next = discretisation.corrected(model)(x, u, mean)
    return ca.Function("f_corr", [x, u], [x_next], ["x", "u"], ["x_next"])
