"""The GP residual's posterior mean as a CasADi expression: the one place where it is written.

For each output (paper, section 4; Rasmussen and Williams, "Gaussian Processes for Machine
Learning", eq. 2.25 and section 4.2)

    mean(z) = offset + scale * sum_i alpha_i k(r_i),    r_i^2 = sum_j ((z_j - X_ij) / l_j)^2

    rbf       k(r) = exp(-r^2 / 2)
    matern05  k(r) = exp(-r)
    matern15  k(r) = (1 + a) exp(-a),            a = sqrt(3) r
    matern25  k(r) = (1 + a + a^2 / 3) exp(-a),  a = sqrt(5) r

with scale = y_scale * signal_variance and offset = y_mean of :class:`.weights.GpOutput`.
All that training produces enters as *parameter*, so one compiled function serves all weights.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesrace.errors import InputError
from bayesrace.gp.weights import FEATURES, KERNELS, OUTPUTS, GpOutput, GpWeights

__all__ = [
    "PARAMETERS",
    "bind",
    "evaluate_mean",
    "kernel",
    "kernel_matrix",
    "mean_function",
    "mean_parameters",
    "numeric_mean",
    "posterior_mean",
]

PARAMETERS: Final = ("inputs", "alpha", "length_scales", "scale", "offset")
"""Run-time parameters of one output, in this order; function inputs are named inputs_vx, …"""

# Added to r^2 under the root: keeps derivatives finite where z meets a training input (there the
# gradient is 0). The smooth kernels change by O(1e-20), matern05 by 1e-12 (it is linear in r).
_SOFT_SMOOTH: Final = 1e-20
_SOFT_ROUGH: Final = 1e-24


def _rbf(r2: Any) -> Any:
    return ca.exp(-r2 / 2)


def _matern05(r2: Any) -> Any:
    return ca.exp(-ca.sqrt(r2 + _SOFT_ROUGH))


def _matern15(r2: Any) -> Any:
    a = math.sqrt(3) * ca.sqrt(r2 + _SOFT_SMOOTH)
    return (1 + a) * ca.exp(-a)


def _matern25(r2: Any) -> Any:
    a = math.sqrt(5) * ca.sqrt(r2 + _SOFT_SMOOTH)
    return (1 + a + a * a / 3) * ca.exp(-a)


_KERNELS: Final[dict[str, Callable[[Any], Any]]] = dict(
    zip(KERNELS, (_rbf, _matern05, _matern15, _matern25), strict=True)
)


def kernel(kind: str, r2: Any) -> Any:
    """Correlation k as a function of the scaled squared distance r^2 (any shape, SX, MX or DM)."""
    try:
        return _KERNELS[kind](r2)
    except KeyError:
        raise InputError(f"unknown kernel '{kind}'; known: {', '.join(KERNELS)}") from None


def kernel_matrix(
    kind: str, a: NDArray[np.float64], b: NDArray[np.float64], length_scales: ArrayLike
) -> NDArray[np.float64]:
    """Correlations k between features ``a`` (n, 6) and ``b`` (m, 6), numbers, shape (n, m)."""
    scaled_a, scaled_b = a / np.asarray(length_scales), b / np.asarray(length_scales)
    r2 = np.zeros((len(a), len(b)))
    for j in range(scaled_a.shape[1]):
        r2 += (scaled_a[:, j, None] - scaled_b[None, :, j]) ** 2
    if r2.size == 0:
        return r2
    symbol = ca.MX.sym("r2", r2.size)
    function = ca.Function("k", [symbol], [kernel(kind, symbol)])
    result = np.empty_like(r2)
    bind(function, [r2], [result])()
    return result


def bind(
    function: ca.Function,
    arguments: Sequence[NDArray[np.float64]],
    results: Sequence[NDArray[np.float64]],
) -> Callable[[], None]:
    """A call that evaluates ``function`` from and into these contiguous float64 arrays.

    An ordinary call converts every number to and from CasADi's own matrices, which costs more than
    kernels do. Matrices are column by column, as CasADi has them.
    """
    untyped: Any = function
    buffer, evaluate = untyped.buffer()
    views: list[Any] = [np.reshape(array, -1, copy=False) for array in (*arguments, *results)]
    for number, view in enumerate(views):
        if number < len(arguments):
            buffer.set_arg(number, memoryview(view))
        else:
            buffer.set_res(number - len(arguments), memoryview(view))

    def call(_alive: tuple[Any, ...] = (function, buffer, views)) -> None:
        evaluate()

    return call


def posterior_mean(
    kind: str, z: Any, inputs: Any, alpha: Any, length_scales: Any, scale: Any, offset: Any
) -> Any:
    """Posterior mean of one output as an expression.

    ``z`` (6, 1), ``inputs`` (n, 6), ``alpha`` (n, 1), ``length_scales`` (6, 1), ``scale`` and
    ``offset`` scalars; SX, MX or DM. Features in their own units, result in the output's unit.
    """
    # Column by column: differences stay small (no |x|^2 - 2xz + |z|^2 cancellation), and the
    # Jacobian is a handful of vector operations instead of a sparse n x 6 scatter.
    r2 = sum(((z[j] - inputs[:, j]) / length_scales[j]) ** 2 for j in range(len(FEATURES)))
    return offset + scale * ca.dot(alpha, kernel(kind, r2))


def mean_function(kinds: Sequence[str], n: int | Sequence[int]) -> ca.Function:
    """Function (z, parameters of vx, vy, omega) -> mean (3, 1) with run-time weights.

    ``kinds``: kernel per output; ``n``: capacity in training points, for all or per output (at
    least 1; unused points have alpha 0). Each output has the inputs of :data:`PARAMETERS`, named
    ``inputs_vx`` (n, 6), ``alpha_vx`` (n, 1), ``length_scales_vx`` (6, 1), ``scale_vx``,
    ``offset_vx`` and so on; :func:`mean_parameters` makes them from weights.
    """
    counts = [n] * len(OUTPUTS) if isinstance(n, int) else list(n)
    if len(kinds) != len(OUTPUTS) or len(counts) != len(OUTPUTS) or min(counts) < 1:
        raise InputError("GP mean: need a kernel and a capacity of at least 1 for each output")
    z = ca.MX.sym("z", len(FEATURES))
    arguments, names, means = [z], ["z"], []
    for output, kind, count in zip(OUTPUTS, kinds, counts, strict=True):
        shapes = ((count, len(FEATURES)), (count, 1), (len(FEATURES), 1), (1, 1), (1, 1))
        parameters = [
            ca.MX.sym(f"{name}_{output}", *shape)
            for name, shape in zip(PARAMETERS, shapes, strict=True)
        ]
        means.append(posterior_mean(kind, z, *parameters))
        arguments += parameters
        names += [symbol.name() for symbol in parameters]
    return ca.Function("gp_mean", arguments, [ca.vertcat(*means)], names, ["mean"])


def _output_parameters(output: GpOutput, count: int) -> list[ca.DM]:
    if output.count > count:
        raise InputError(f"GP mean: {output.count} training points exceed the capacity {count}")
    inputs, alpha = np.zeros((count, len(FEATURES))), np.zeros(count)
    inputs[: output.count], alpha[: output.count] = output.inputs, output.alpha
    scale = output.y_scale * output.signal_variance
    return [ca.DM(p) for p in (inputs, alpha, output.length_scales, scale, output.y_mean)]


def mean_parameters(weights: GpWeights, n: int | Sequence[int]) -> list[ca.DM]:
    """Arguments after z for ``mean_function(weights.kernels, n)``, padded with alpha = 0."""
    counts = [n] * len(OUTPUTS) if isinstance(n, int) else list(n)
    return [
        parameter
        for output, count in zip(weights.outputs, counts, strict=True)
        for parameter in _output_parameters(output, count)
    ]


def numeric_mean(weights: GpWeights) -> ca.Function:
    """Function z (6, 1) -> mean (3, 1) for these weights; z (6, m) gives (3, m)."""
    counts = [max(1, count) for count in weights.counts]
    general = mean_function(weights.kernels, counts)
    z = ca.MX.sym("z", len(FEATURES))
    mean = general(z, *mean_parameters(weights, counts))
    return ca.Function("gp_mean_numeric", [z], [mean], ["z"], ["mean"])


def evaluate_mean(weights: GpWeights, z: ArrayLike) -> NDArray[np.float64]:
    """Posterior mean (m, 3) at features ``z`` (m, 6), all in SI units."""
    points = np.asarray(z, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != len(FEATURES):
        raise InputError(f"GP mean: features have shape {points.shape}, expected (m, 6)")
    if points.shape[0] == 0:
        return np.zeros((0, len(OUTPUTS)))
    return np.asarray(numeric_mean(weights)(points.T), dtype=np.float64).T
