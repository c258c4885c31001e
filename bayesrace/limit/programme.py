"""A nonlinear programme made of many equal pieces, with its derivatives piece by piece.

Objective and constraints are the sum and the stack of a few small functions at many places of the
variables. The derivatives of each function are made once, as scalar expressions, evaluated at all
places, and put where they belong in the Jacobian and in the Hessian.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import casadi as ca
import numpy as np
import numpy.typing as npt

from bayesrace.arrays import Floats
from bayesrace.raceline.nlp import Solution, solve_nlp

__all__ = ["Indices", "Piece", "minimise"]

Indices = npt.NDArray[np.intp]

_Entries = tuple[Indices, Indices, Any]
"""Rows, columns and values of nonzeros, block by block, as a map returns them."""

_TOLERANCE: Final = 1e-7


@dataclass(frozen=True, eq=False)
class Piece:
    """One function (w, p) -> (cost, g) at M places."""

    w: Any
    """Symbols (n, 1): the variables that the function depends on."""
    g: Any
    """Constraints, an expression (k, 1) of w and p."""
    g_min: Floats | float
    """Least g, shape (), (k,) or (M, k)."""
    g_max: Floats | float
    """Largest g, of such a shape, too."""
    index: Indices
    """Which of the programme's variables w is at each place, shape (M, n)."""
    numbers: Floats
    """The p of each place, shape (M, m)."""
    p: Any = field(default_factory=lambda: ca.SX.sym("p", 0))
    """Symbols (m, 1): the numbers that differ from place to place."""
    cost: Any = field(default_factory=lambda: ca.SX(0))
    """Scalar expression of w and p."""

    @property
    def size(self) -> int:
        """Number of constraints at all places."""
        return len(self.index) * int(self.g.numel())


def minimise(
    pieces: Sequence[Piece], bounds: tuple[Floats, Floats], start: Floats, options: dict[str, Any]
) -> Solution:
    """Minimises the sum of all costs within the constraints and the bounds of x by IPOPT.

    ``start``: first guess of x; ``options``: of IPOPT.
    """
    first = np.cumsum([0, *(piece.size for piece in pieces)])
    x, p = ca.MX.sym("x", len(start)), ca.MX.sym("p", 0)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", int(first[-1]))
    lams = ca.vertsplit(lam_g, first.tolist())
    parts = [
        _derived(piece, int(row), x, lam_f, lam)
        for piece, row, lam in zip(pieces, first[:-1], lams, strict=True)
    ]
    costs, constraints, slopes, bends = zip(*parts, strict=True)
    f, g = sum(costs), ca.vertcat(*constraints)
    jacobian = _matrix(g.numel(), len(start), slopes)
    hessian = _matrix(len(start), len(start), bends)
    g_bounds = (
        np.concatenate([
            np.broadcast_to(one, (len(piece.index), piece.g.numel())).ravel()
            for one, piece in zip(side, pieces, strict=True)
        ])
        for side in ([piece.g_min for piece in pieces], [piece.g_max for piece in pieces])
    )  # fmt: skip
    return solve_nlp(
        {"x": x, "p": p, "f": f, "g": g},
        start,
        bounds,
        (next(g_bounds), next(g_bounds)),
        {"tol": _TOLERANCE, **options},
        jac_g=ca.Function("nlp_jac_g", [x, p], [g, jacobian], ["x", "p"], ["g", "jac_g_x"]),
        hess_lag=ca.Function(
            "nlp_hess_l", [x, p, lam_f, lam_g], [hessian],
            ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"],
        ),
    )  # fmt: skip


def _derived(
    piece: Piece, row: int, x: Any, lam_f: Any, lam_g: Any
) -> tuple[Any, Any, _Entries, _Entries]:
    """Cost and constraints (size, 1) of a piece, entries of the Jacobian and of the Hessian.

    ``row``: of its first constraint.
    """
    places, n = piece.index.shape
    k, symbols = int(piece.g.numel()), [piece.w, piece.p]
    values = ca.reshape(x[piece.index.ravel().tolist()], n, places), ca.DM(piece.numbers.T)
    cost, g = ca.Function("piece", symbols, [piece.cost, piece.g]).map(places)(*values)

    slopes = ca.jacobian(piece.g, piece.w)
    rows, columns = _triplet(slopes)
    jacobian = (
        row + k * np.arange(places)[:, None] + rows,
        piece.index[:, columns],
        ca.Function("slopes", symbols, [slopes]).map(places)(*values),
    )
    sigma, lam = ca.SX.sym("sigma"), ca.SX.sym("lam", k)
    bends: Any = ca.triu(ca.hessian(sigma * piece.cost + ca.dot(lam, piece.g), piece.w)[0])
    one, other = (piece.index[:, places_of] for places_of in _triplet(bends))
    multipliers = ca.repmat(lam_f, 1, places), ca.reshape(lam_g, k, places)
    hessian = (
        np.minimum(one, other),
        np.maximum(one, other),
        ca.Function("bends", [*symbols, sigma, lam], [bends]).map(places)(*values, *multipliers),
    )
    return ca.sum2(cost), ca.vec(g), jacobian, hessian


def _matrix(rows: int, columns: int, entries: Sequence[_Entries]) -> Any:
    """The sparse matrix; entries at the same place are summed."""
    key = np.concatenate([column.ravel() * rows + row.ravel() for row, column, _ in entries])
    place, where = np.unique(key, return_inverse=True)  # in the order of compressed columns
    sparsity = ca.Sparsity.triplet(rows, columns, (place % rows).tolist(), (place // rows).tolist())
    summed = ca.Sparsity.triplet(len(place), len(key), where.tolist(), list(range(len(key))))
    values = ca.vertcat(*(ca.vec(block.nz[:]) for _, _, block in entries))
    return ca.MX(sparsity, ca.DM(summed, 1.0) @ values)


def _triplet(matrix: Any) -> tuple[Indices, Indices]:
    """Rows and columns of its nonzeros, in their order."""
    rows, columns = matrix.sparsity().get_triplet()
    return np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp)
