"""Any control problem as one CasADi NLP, solved by IPOPT.

Made from the same description as the native step (:mod:`bayesrace.codegen.problems`), by another
formulation: multiple shooting with slack variables, all of them in one vector. It is the oracle of
the tests, and, expanded to scalars and started cold as the published code does, the peer of
``bayesrace bench``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from bayesrace.arrays import Floats
from bayesrace.codegen.problems.problem import Problem

__all__ = ["OcpNlp", "OcpSolution"]


@dataclass(frozen=True, eq=False)
class OcpSolution:
    """A local solution: x (N + 1, nx), u (N, nu), objective, and how the solver ended."""

    x: Floats
    u: Floats
    cost: float
    success: bool
    status: str
    seconds: float


class OcpNlp:
    """A problem with one prediction model over ``horizon`` stages.

    ``f``: CasADi function (x, u) -> x_next. ``expand``: scalar expressions instead of matrices
    (as the published code; takes seconds and hundreds of MB with 400 training points).
    ``options``: IPOPT's own. ``blocks``: of each stage, the number of its block, whose stages have
    one input; without, each stage has its own. Parameters are given by name; settings of the native
    solver among them are not looked at.
    """

    def __init__(
        self,
        problem: Problem,
        f: ca.Function,
        horizon: int,
        expand: bool = False,
        options: dict[str, Any] | None = None,
        blocks: Sequence[int] | None = None,
    ) -> None:
        self.horizon, self._problem = horizon, problem
        self._blocks = list(range(horizon) if blocks is None else blocks)
        self._nx, self._nu = len(problem.states), len(problem.inputs)
        self._soft = [row for row in problem.rows if row.soft]
        self._hard = [row for row in problem.rows if not row.soft]
        self._stage = self._stage_function()
        self._nlp, self._split = self._formulate(f)
        settings: dict[str, Any] = {"print_time": False, "expand": expand, "error_on_fail": False}
        settings |= {"ipopt": {"print_level": 0, "sb": "yes"} | (options or {})}
        self._objective = ca.Function(
            "objective", [self._nlp["x"], self._nlp["p"]], [self._nlp["f"]]
        )
        self._solver = ca.nlpsol("ocp", "ipopt", self._nlp, settings)
        s = problem.symbols
        self._input_bounds = ca.Function(
            "bounds", [s.x, s.theta], [problem.u_lower, problem.u_upper]
        )

    def _stage_function(self) -> ca.Function:
        """(x, u, u_before, last, p, theta) -> cost, penalties, and the rows less their bounds:
        soft ones above and below, hard ones above and below; all of them <= 0 but for slack."""
        s = self._problem.symbols

        def outside(rows: list[Any]) -> ca.SX:
            pairs = ((r.value - r.upper, r.lower - r.value) for r in rows)
            return ca.vertcat(ca.SX(0, 1), *(e for pair in pairs for e in pair))

        penalties = ca.vertcat(
            ca.SX(0, 1), *(w for r in self._soft for w in [r.penalty] * 2 if w is not None)
        )
        return ca.Function(
            "stage",
            [s.x, s.u, s.u_before, s.last, s.p, s.theta],
            [self._problem.cost, penalties, outside(self._soft), outside(self._hard)],
        )

    def _formulate(self, f: ca.Function) -> tuple[dict[str, Any], ca.Function]:
        n, nx, nu, soft = self.horizon, self._nx, self._nu, 2 * len(self._soft)
        held = ca.MX.sym("u", nu, self._blocks[-1] + 1)
        u, x, eps = held[:, self._blocks], ca.MX.sym("x", nx, n), ca.MX.sym("eps", soft, n)
        x0, u_before = ca.MX.sym("x0", nx), ca.MX.sym("u_before", nu)
        p = ca.MX.sym("p", len(self._problem.stage_parameters), n)
        theta = ca.MX.sym("theta", len(self._problem.parameters))
        cost, constraints = ca.MX(0), []
        state, acting = x0, u_before
        for k in range(n):
            constraints.append(x[:, k] - f(state, u[:, k]))
            state = x[:, k]
            last = float(k == n - 1)
            stage, weights, over, hard = self._stage(state, u[:, k], acting, last, p[:, k], theta)
            acting = u[:, k]
            cost += stage + ca.dot(weights, eps[:, k] ** 2)
            constraints += [over - eps[:, k], hard]
        variables = ca.veccat(held, x, eps)
        nlp = {
            "x": variables,
            "p": ca.veccat(x0, u_before, p, theta),
            "f": cost,
            "g": ca.vertcat(*constraints),
        }
        return nlp, ca.Function("split", [variables], [u, x, eps])

    def _variable_bounds(self, x0: Floats, theta: list[float]) -> dict[str, Any]:
        n, rows = self.horizon, 2 * (len(self._soft) + len(self._hard))
        blocks = self._blocks[-1] + 1
        low_u, high_u = (ca.repmat(one, 1, blocks) for one in self._input_bounds(x0, theta))
        free = np.full((self._nx, n), np.inf)
        soft = 2 * len(self._soft)
        return {
            "lbx": ca.veccat(low_u, -free, np.zeros((soft, n))),
            "ubx": ca.veccat(high_u, free, np.full((soft, n), np.inf)),
            "lbg": np.tile(np.r_[np.zeros(self._nx), np.full(rows, -np.inf)], n),
            "ubg": np.zeros((self._nx + rows) * n),
        }

    def solve(
        self,
        x0: Floats,
        u_before: ArrayLike,
        reference: Floats,
        parameters: Mapping[str, float],
        guess: tuple[Floats, Floats] | None = None,
    ) -> OcpSolution:
        """Local solution from ``guess`` (x (N + 1, nx), u (N, nu)); zeros, as published, without.

        ``u_before`` (nu,), or a number for all components; ``reference`` (N, np): the parameters
        of the stages 1..N.
        """
        n = self.horizon
        values = self._values(x0, u_before, reference, parameters)
        start: Any = 0
        if guess is not None:
            start = self._variables(guess[0], guess[1], u_before, reference, parameters)
        started = perf_counter()
        bounds = self._variable_bounds(x0, self._theta(parameters))
        out = self._solver(x0=start, p=values, **bounds)
        seconds = perf_counter() - started
        u, x, _ = (np.asarray(part, dtype=float) for part in self._split(out["x"]))
        stats = self._solver.stats()
        return OcpSolution(
            x=np.vstack([x0, x.T]),
            u=u.T.reshape(n, self._nu),
            cost=float(out["f"]),
            success=bool(stats["success"]),
            status=str(stats["return_status"]),
            seconds=seconds,
        )

    def cost(
        self,
        x: Floats,
        u: Floats,
        u_before: ArrayLike,
        reference: Floats,
        parameters: Mapping[str, float],
    ) -> float:
        """Objective of a plan x (N + 1, nx), u (N, nu), with the slack that it needs."""
        variables = self._variables(x, u, u_before, reference, parameters)
        values = self._values(x[0], u_before, reference, parameters)
        return float(self._objective(variables, values))

    def _theta(self, parameters: Mapping[str, float]) -> list[float]:
        return [float(parameters[one.name]) for one in self._problem.parameters]

    def _values(
        self, x0: Floats, u_before: ArrayLike, reference: Floats, parameters: Mapping[str, float]
    ) -> ca.DM:
        acting = np.broadcast_to(u_before, self._nu)
        return _dm(x0, acting, np.asarray(reference).T, self._theta(parameters))

    def _variables(
        self,
        x: Floats,
        u: Floats,
        u_before: ArrayLike,
        reference: Floats,
        parameters: Mapping[str, float],
    ) -> ca.DM:
        theta, acting = self._theta(parameters), np.broadcast_to(u_before, self._nu)
        slack = []
        for k in range(self.horizon):
            _, _, over, _ = self._stage(x[k + 1], u[k], acting, 0.0, reference[k], theta)
            slack.append(ca.fmax(0, over))
            acting = u[k]
        first = [self._blocks.index(block) for block in range(self._blocks[-1] + 1)]
        return _dm(u[first].T, x[1:].T, ca.horzcat(*slack))


def _dm(*parts: Any) -> ca.DM:
    return ca.DM(ca.veccat(*parts))
