"""The GP residual's posterior mean: the one place where it is written.

For each output (paper, section 4; Rasmussen and Williams, "Gaussian Processes for Machine
Learning", eq. 2.25 and section 4.2)

    mean(z) = offset + scale * sum_i alpha_i k(r_i),    r_i^2 = sum_j ((z_j - X_ij) / l_j)^2

    rbf       k(r) = exp(-r^2 / 2)
    matern05  k(r) = exp(-r)
    matern15  k(r) = (1 + a) exp(-a),            a = sqrt(3) r
    matern25  k(r) = (1 + a + a^2 / 3) exp(-a),  a = sqrt(5) r

with scale = y_scale * signal_variance and offset = y_mean of :class:`.weights.GpOutput`. The
corrected model f_corr is the nominal one with this mean added to vx, vy, omega (paper, eq. 7);
:meth:`bayesrace.integrators.Discretisation.corrected` derives the pose.
"""

import math
from typing import Any, Final

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import FEATURES, KERNELS, OUTPUTS, GpOutput, Weights
from bayesrace.integrators import Discretisation
from bayesrace.vehicles.models import Model

__all__ = [
    "corrected_function",
    "evaluate_mean",
    "kernel",
    "kernel_matrix",
    "kernel_slope",
    "mean_function",
]

# Added to r^2 under the root: keeps derivatives finite where z meets a training input (there the
# gradient is 0). The smooth kernels change by O(1e-20), matern05 by 1e-12 (it is linear in r).
_SOFT_SMOOTH: Final = 1e-20
_SOFT_ROUGH: Final = 1e-24


def kernel(kind: str, r2: Any) -> Any:
    """Correlation k of the scaled squared distance r^2, elementwise.

    ``r2``: a NumPy array, or SX, MX or DM of CasADi; the result has its type and shape.
    InputError for a kind that is not in :data:`~bayesrace.gp.weights.KERNELS`.
    """
    of: Any = np if isinstance(r2, np.ndarray) else ca
    if kind == "rbf":
        return of.exp(-r2 / 2)
    if kind == "matern05":
        return of.exp(-of.sqrt(r2 + _SOFT_ROUGH))
    if kind == "matern15":
        a = math.sqrt(3) * of.sqrt(r2 + _SOFT_SMOOTH)
        return (1 + a) * of.exp(-a)
    if kind == "matern25":
        a = math.sqrt(5) * of.sqrt(r2 + _SOFT_SMOOTH)
        return (1 + a + a * a / 3) * of.exp(-a)
    raise InputError(f"unknown kernel '{kind}'; known: {', '.join(KERNELS)}")


def kernel_slope(kind: str, r2: Floats, k: Floats) -> Floats:
    """dk/d(r^2), elementwise, where ``k`` is :func:`kernel` of ``r2``: takes no exponential."""
    slope: Floats = -k / 2
    if kind == "matern05":
        slope /= np.sqrt(r2 + _SOFT_ROUGH)
    if kind == "matern15":
        slope *= 3 / (1 + np.sqrt(3 * r2))
    if kind == "matern25":
        b = 1 + np.sqrt(5 * r2)
        slope *= 5 / 3 * b / (b + 5 / 3 * r2)
    return slope


def kernel_matrix(kind: str, a: Floats, b: Floats, length_scales: ArrayLike) -> Floats:
    """Correlations k between features ``a`` (n, 6) and ``b`` (m, 6), shape (n, m)."""
    scales = np.asarray(length_scales)
    matrix: Floats = kernel(kind, cdist(a / scales, b / scales, "sqeuclidean"))
    return matrix


def _posterior_mean(output: GpOutput, z: Any) -> Any:
    """Posterior mean of one output at the features ``z`` (6, 1), an MX expression."""
    if output.count == 0:
        return ca.MX(output.y_mean)
    # Column by column: differences stay small (no |x|^2 - 2xz + |z|^2 cancellation), and the
    # Jacobian is a handful of vector operations instead of a sparse n x 6 scatter.
    columns = zip(output.inputs.T, output.length_scales, strict=True)
    r2 = sum(((z[j] - ca.DM(x)) / scale) ** 2 for j, (x, scale) in enumerate(columns))
    amplitude = output.y_scale * output.signal_variance
    return output.y_mean + amplitude * ca.dot(ca.DM(output.alpha), kernel(output.kernel, r2))


def mean_function(weights: Weights) -> ca.Function:
    """Function z (6, 1) -> mean (3, 1) of these weights, SI units; z (6, m) gives (3, m)."""
    z = ca.MX.sym("z", len(FEATURES))
    means = [_posterior_mean(output, z) for output in weights.outputs]
    return ca.Function("gp_mean", [z], [ca.vertcat(*means)], ["z"], ["mean"])


def evaluate_mean(weights: Weights, z: ArrayLike) -> Floats:
    """Posterior mean (m, 3) at features ``z`` (m, 6), all in SI units."""
    points = np.asarray(z, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != len(FEATURES):
        raise InputError(f"GP mean: features have shape {points.shape}, expected (m, 6)")
    if len(points) == 0:
        return np.zeros((0, len(OUTPUTS)))
    return np.asarray(mean_function(weights)(points.T), dtype=np.float64).T


def corrected_function(
    model: Model,
    discretisation: Discretisation,
    weights: Weights | None,
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
