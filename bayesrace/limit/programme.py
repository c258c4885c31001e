"""A nonlinear programme made of many equal pieces, with its derivatives piece by piece.

Objective and constraints are the sum and the stack of a few small functions at many places of the
variables. The derivatives of each function are made once, as scalar expressions, evaluated at all
places, and put where they belong in the Jacobian and in the Hessian.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import casadi as ca
import numpy as np
import numpy.typing as npt

from bayesrace.arrays import Floats
from bayesrace.interrupts import deferred_interrupt

__all__ = ["Piece", "Solution", "minimise"]

Indices = npt.NDArray[np.intp]

_TOLERANCE: Final = 1e-7


@dataclass(frozen=True, eq=False)
class Piece:
    """One function (w, p) -> (cost, g) at M places."""

    w: Any
    """Symbols (n, 1): the variables that the function depends on."""
    p: Any
    """Symbols (m, 1): the numbers that differ from place to place."""
    cost: Any
    """Scalar expression of w and p."""
    g: Any
    """Constraints, an expression (k, 1) of w and p."""
    g_min: Floats
    """Least g, shape (k,) or (M, k)."""
    g_max: Floats
    """Largest g, shape (k,) or (M, k)."""
    index: Indices
    """Which of the programme's variables w is at each place, shape (M, n)."""
    numbers: Floats
    """The p of each place, shape (M, m)."""

    @property
    def size(self) -> int:
        """Number of constraints at all places."""
        return len(self.index) * int(self.g.numel())


@dataclass(frozen=True, eq=False)
class Solution:
    """What IPOPT returned, whether it has converged or not."""

    x: Floats
    converged: bool
    status: str
    """In IPOPT's own words."""
    iterations: int


class _Entries:
    """Nonzeros of a matrix, collected with their places; those at the same place are summed."""

    def __init__(self, rows: int, columns: int) -> None:
        self._shape = rows, columns
        self._rows: list[Indices] = []
        self._columns: list[Indices] = []
        self._values: list[Any] = []

    def add(self, rows: Indices, columns: Indices, values: Any) -> None:
        """Blocks side by side, as a map returns them; places in the order of its nonzeros."""
        self._rows.append(rows.ravel())
        self._columns.append(columns.ravel())
        self._values.append(ca.vec(values.nz[:]))

    def matrix(self) -> Any:
        """The sparse matrix."""
        count = self._shape[0]
        key = np.concatenate(self._columns) * count + np.concatenate(self._rows)
        place, where = np.unique(key, return_inverse=True)  # in the order of compressed columns
        sparsity = ca.Sparsity.triplet(
            *self._shape, (place % count).tolist(), (place // count).tolist()
        )
        summed = ca.Sparsity.triplet(len(place), len(key), where.tolist(), list(range(len(key))))
        return ca.MX(sparsity, ca.DM(summed, 1.0) @ ca.vertcat(*self._values))


def minimise(
    pieces: Sequence[Piece], low: Floats, high: Floats, start: Floats, options: dict[str, Any]
) -> Solution:
    """Minimises the sum of all costs within the constraints and ``low <= x <= high`` by IPOPT.

    ``start``: first guess of x; ``options``: of IPOPT.
    """
    first = np.cumsum([0, *(piece.size for piece in pieces)])
    x, p = ca.MX.sym("x", len(start)), ca.MX.sym("p", 0)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", int(first[-1]))
    jacobian, hessian = _Entries(int(first[-1]), len(start)), _Entries(len(start), len(start))
    costs, constraints = [], []
    for piece, row, lam in zip(
        pieces, first[:-1], ca.vertsplit(lam_g, first.tolist()), strict=True
    ):
        cost, g = _add(piece, int(row), x, lam_f, lam, jacobian, hessian)
        costs.append(cost)
        constraints.append(g)
    f, g = sum(costs), ca.vertcat(*constraints)
    solver = ca.nlpsol("minimise", "ipopt", {"x": x, "p": p, "f": f, "g": g}, {
        "print_time": False,
        "error_on_fail": False,
        "jac_g": ca.Function(
            "nlp_jac_g", [x, p], [g, jacobian.matrix()], ["x", "p"], ["g", "jac_g_x"]
        ),
        "hess_lag": ca.Function(
            "nlp_hess_l", [x, p, lam_f, lam_g], [hessian.matrix()],
            ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"],
        ),
        "ipopt": {
            "print_level": 0, "sb": "yes", "tol": _TOLERANCE, "acceptable_iter": 0, **options,
        },
    })  # fmt: skip
    bounds = (
        np.concatenate([
            np.broadcast_to(one, (len(piece.index), piece.g.numel())).ravel()
            for one, piece in zip(side, pieces, strict=True)
        ])
        for side in ([piece.g_min for piece in pieces], [piece.g_max for piece in pieces])
    )  # fmt: skip
    with deferred_interrupt():
        result = solver(x0=start, lbx=low, ubx=high, lbg=next(bounds), ubg=next(bounds))
    stats = solver.stats()
    return Solution(
        x=np.asarray(result["x"]).ravel(),
        converged=bool(stats["success"]),
        status=str(stats["return_status"]),
        iterations=int(stats["iter_count"]),
    )


def _add(
    piece: Piece, row: int, x: Any, lam_f: Any, lam_g: Any, jacobian: _Entries, hessian: _Entries
) -> tuple[Any, Any]:
    """Cost and constraints (size, 1) of a piece, its derivatives added to the matrices.

    ``row``: of its first constraint.
    """
    places, n = piece.index.shape
    k = int(piece.g.numel())
    values = ca.reshape(x[piece.index.ravel().tolist()], n, places), ca.DM(piece.numbers.T)
    symbols = [piece.w, piece.p]
    cost, g = ca.Function("piece", symbols, [piece.cost, piece.g]).map(places)(*values)

    slopes = ca.jacobian(piece.g, piece.w)
    rows, columns = _triplet(slopes)
    begins = row + k * np.arange(places)[:, None]
    jacobian.add(
        begins + rows,
        piece.index[:, columns],
        ca.Function("slopes", symbols, [slopes]).map(places)(*values),
    )

    sigma, lam = ca.SX.sym("sigma"), ca.SX.sym("lam", k)
    bends: Any = ca.triu(ca.hessian(sigma * piece.cost + ca.dot(lam, piece.g), piece.w)[0])
    rows, columns = _triplet(bends)
    one, other = piece.index[:, rows], piece.index[:, columns]
    hessian.add(
        np.minimum(one, other),
        np.maximum(one, other),
        ca.Function("bends", [*symbols, sigma, lam], [bends]).map(places)(
            *values, ca.repmat(lam_f, 1, places), ca.reshape(lam_g, k, places)
        ),
    )
    return ca.sum2(cost), ca.vec(g)


def _triplet(matrix: Any) -> tuple[Indices, Indices]:
    """Rows and columns of its nonzeros, in their order."""
    rows, columns = matrix.sparsity().get_triplet()
    return np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp)
