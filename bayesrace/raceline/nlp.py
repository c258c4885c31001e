"""Nonlinear programmes by IPOPT: as the racing line and the limit have them solved."""

from dataclasses import dataclass
from typing import Any, Final

import casadi as ca
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.interrupts import deferred_interrupt

__all__ = ["Solution", "solve_nlp"]

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
