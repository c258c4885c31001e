"""Nonlinear programmes by IPOPT, as the racing line and the limit have them solved.

A programme of many equal pieces (:func:`minimise`) is the sum and the stack of a few small
functions at many places of the variables. The derivatives of each function are made once, as scalar
expressions, and evaluated at all places: several times faster than those of the whole programme.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import casadi as ca
import numpy as np
import numpy.typing as npt

from bayesrace.arrays import Floats
from bayesrace.processes import deferred_interrupt

__all__ = ["Indices", "Piece", "Solution", "minimise", "solve_nlp"]

Indices = npt.NDArray[np.intp]

_QUIET: Final = {"print_level": 0, "sb": "yes", "acceptable_iter": 0}


@dataclass(frozen=True, eq=False)
class Solution:
    """What IPOPT returned, whether it has converged or not."""

    x: Floats
    converged: bool
    how: str
    """How it ended, in IPOPT's own words."""


def solve_nlp(
    nlp: dict[str, Any],
    start: Floats,
    bounds: tuple[Any, Any],
    g_bounds: tuple[Any, Any],
    ipopt: dict[str, Any],
    **functions: Any,
) -> Solution:
    """Minimises f(x) within ``bounds`` of x and ``g_bounds`` of g(x), from a first guess of x.

    ``ipopt``: its options; ``functions``: derivatives, in place of those that CasADi would make.
    """
    options = {"print_time": False, "error_on_fail": False, "ipopt": _QUIET | ipopt, **functions}
    solver = ca.nlpsol("minimum_time", "ipopt", nlp, options)
    with deferred_interrupt():
        result = solver(x0=start, lbx=bounds[0], ubx=bounds[1], lbg=g_bounds[0], ubg=g_bounds[1])
    stats = solver.stats()
    return Solution(
        x=np.asarray(result["x"]).ravel(),
        converged=bool(stats["success"]),
        how=f"IPOPT ended with {stats['return_status']} after {stats['iter_count']} iterations",
    )


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

    def derived(self, x: Any, lam_f: Any, lam_g: Any) -> tuple[Any, Any, Any, Any]:
        """Cost and constraints (size, 1) of the programme's ``x``, the constraints' Jacobian and
        the Hessian of cost and constraints times their multipliers ``lam_f`` and ``lam_g``."""
        places, n = self.index.shape
        sigma, lam = ca.SX.sym("sigma"), ca.SX.sym("lam", self.g.numel())
        jacobian = ca.jacobian(self.g, self.w)
        hessian, _ = ca.hessian(sigma * self.cost + ca.dot(lam, self.g), self.w)

        # w of all places is chosen @ x: with it, blocks on the diagonal become derivatives by x.
        rows, columns = list(range(places * n)), self.index.ravel().tolist()
        chosen = ca.DM(ca.Sparsity.triplet(places * n, x.numel(), rows, columns), 1.0)
        symbols = [self.w, self.p, sigma, lam]
        values = [ca.reshape(chosen @ x, n, places), ca.DM(self.numbers.T)]
        values += [ca.repmat(lam_f, 1, places), ca.reshape(lam_g, -1, places)]

        def everywhere(count: int, *expressions: Any) -> Any:
            """The expressions, of the first ``count`` symbols, at all places."""
            function = ca.Function("piece", symbols[:count], expressions)
            return function.map(places)(*values[:count])

        def blocks(count: int, matrix: Any) -> Any:
            """The matrices of all places on the diagonal of one."""
            entries = ca.vec(everywhere(count, matrix).nz[:])
            return ca.MX(ca.diagcat(*[matrix.sparsity()] * places), entries)

        cost, g = everywhere(2, self.cost, self.g)
        slopes, bends = blocks(2, jacobian), blocks(4, hessian)
        return ca.sum2(cost), ca.vec(g), slopes @ chosen, chosen.T @ bends @ chosen


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
    parts = [piece.derived(x, lam_f, lam) for piece, lam in zip(pieces, lams, strict=True)]
    costs, constraints, jacobians, hessians = zip(*parts, strict=True)
    f, g, slopes = sum(costs), ca.vertcat(*constraints), ca.vertcat(*jacobians)

    def stacked(sides: list[Floats | float]) -> Floats:
        """A bound of every piece as that of g."""
        shapes = [(len(piece.index), piece.g.numel()) for piece in pieces]
        return np.concatenate([
            np.broadcast_to(*one).ravel() for one in zip(sides, shapes, strict=True)
        ])  # fmt: skip

    return solve_nlp(
        {"x": x, "p": p, "f": f, "g": g},
        start,
        bounds,
        (stacked([piece.g_min for piece in pieces]), stacked([piece.g_max for piece in pieces])),
        options,
        jac_g=ca.Function("nlp_jac_g", [x, p], [g, slopes], ["x", "p"], ["g", "jac_g_x"]),
        hess_lag=ca.Function(
            "nlp_hess_l", [x, p, lam_f, lam_g], [ca.triu(sum(hessians))],
            ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"],
        ),
    )  # fmt: skip
