"""The optimal control problem of the paper, equation (8), as one CasADi NLP.

The definition that the native step is measured against: same objective, same constraints, any
prediction model. Solved by IPOPT it is the oracle of the tests, and, expanded to scalars and
started cold as the published code does, the peer of ``bayesrace bench``.

    min  sum_{k=1}^N q |p_k - p_ref,k|^2
       + sum_{k=0}^{N-1} r_d (d_k - d_{k-1})^2 + r_delta delta_rate_k^2 + s |eps_k|^2
    s.t. x_{k+1} = f(x_k, u_k),  x_0 given,  d_{-1} given
         n_k . p_k <= upper_k - margin + eps_k,1,   -n_k . p_k <= -lower_k - margin + eps_k,2
         eps >= 0,  bounds on d_k, delta_rate_k (k < N) and on delta_k (k >= 1)

The half-planes' normals have unit length. delta_0 is measured, so it is not constrained.
"""

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from bayesrace.vehicles import CarParameters

__all__ = ["OcpParameters", "OcpSolution", "RacingOcp"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class OcpParameters:
    """Run-time weights of the objective; symbols as in the module text."""

    q_position: float
    r_duty: float
    r_delta_rate: float
    s_slack: float
    margin_m: float


@dataclass(frozen=True, eq=False)
class OcpSolution:
    """A local solution: x (N + 1, 7), u (N, 2), objective, and how the solver ended."""

    x: Floats
    u: Floats
    cost: float
    success: bool
    status: str
    seconds: float


class RacingOcp:
    """Equation (8) for one prediction model, solved by IPOPT.

    ``f``: CasADi function (x, u) -> x_next. ``expand``: scalar expressions instead of matrices
    (as the published code; takes seconds and hundreds of MB with 400 training points).
    ``options``: IPOPT's own.
    """

    def __init__(
        self,
        f: ca.Function,
        car: CarParameters,
        horizon: int,
        expand: bool = False,
        options: dict[str, Any] | None = None,
    ) -> None:
        self.horizon, self._car = horizon, car
        self._nlp, self._split = self._formulate(f)
        settings: dict[str, Any] = {"print_time": False, "expand": expand, "error_on_fail": False}
        settings |= {"ipopt": {"print_level": 0, "sb": "yes"} | (options or {})}
        self._objective = ca.Function(
            "objective", [self._nlp["x"], self._nlp["p"]], [self._nlp["f"]]
        )
        self._solver = ca.nlpsol("racing_ocp", "ipopt", self._nlp, settings)
        self._bounds = self._variable_bounds()

    def _formulate(self, f: ca.Function) -> tuple[dict[str, Any], ca.Function]:
        n = self.horizon
        u, x, eps = ca.MX.sym("u", 2, n), ca.MX.sym("x", 7, n), ca.MX.sym("eps", 2, n)
        x0, d_before = ca.MX.sym("x0", 7), ca.MX.sym("d_before")
        ref, weight = ca.MX.sym("ref", 6, n), ca.MX.sym("weight", 5)
        q, r_d, r_delta, s, margin = ca.vertsplit(weight)
        cost, constraints = ca.MX(0), []
        previous = x0
        for k in range(n):
            constraints.append(x[:, k] - f(previous, u[:, k]))
            previous = x[:, k]
            along = ca.dot(ref[2:4, k], x[:2, k])
            constraints.append(along - ref[5, k] + margin - eps[0, k])
            constraints.append(ref[4, k] + margin - along - eps[1, k])
            change = u[0, k] - (u[0, k - 1] if k else d_before)
            cost += q * ca.sumsqr(x[:2, k] - ref[:2, k]) + r_d * change**2
            cost += r_delta * u[1, k] ** 2 + s * ca.sumsqr(eps[:, k])
        variables = ca.veccat(u, x, eps)
        nlp = {
            "x": variables,
            "p": ca.veccat(x0, d_before, ref, weight),
            "f": cost,
            "g": ca.vertcat(*constraints),
        }
        return nlp, ca.Function("split", [variables], [u, x, eps])

    def _variable_bounds(self) -> dict[str, Any]:
        n, car = self.horizon, self._car
        free = np.full((7, n), np.inf)
        free[6] = car.delta_max_rad
        low_u = np.tile([[car.d_min], [-car.delta_rate_max_radps]], (1, n))
        high_u = np.tile([[car.d_max], [car.delta_rate_max_radps]], (1, n))
        low_g = np.tile(np.r_[np.zeros(7), -np.inf, -np.inf], n)
        return {
            "lbx": ca.veccat(low_u, -free, np.zeros((2, n))),
            "ubx": ca.veccat(high_u, free, np.full((2, n), np.inf)),
            "lbg": low_g,
            "ubg": np.zeros(9 * n),
        }

    def solve(
        self,
        x0: Floats,
        d_previous: float,
        reference: Floats,
        parameters: OcpParameters,
        guess: tuple[Floats, Floats] | None = None,
    ) -> OcpSolution:
        """Local solution from ``guess`` (x (N + 1, 7), u (N, 2)); zeros, as published, without.

        ``reference`` (N, 6): x, y, unit normal (2), lower, upper.
        """
        n = self.horizon
        start: Any = 0
        if guess is not None:
            start = self._variables(guess[0], guess[1], reference, parameters)
        values = self._values(x0, d_previous, reference, parameters)
        started = perf_counter()
        out = self._solver(x0=start, p=values, **self._bounds)
        seconds = perf_counter() - started
        u, x, _ = (np.asarray(part, dtype=float) for part in self._split(out["x"]))
        stats = self._solver.stats()
        return OcpSolution(
            x=np.vstack([x0, x.T]),
            u=u.T.reshape(n, 2),
            cost=float(out["f"]),
            success=bool(stats["success"]),
            status=str(stats["return_status"]),
            seconds=seconds,
        )

    def cost(
        self, x: Floats, u: Floats, d_previous: float, reference: Floats, parameters: OcpParameters
    ) -> float:
        """Objective of a plan x (N + 1, 7), u (N, 2), with the slack that it needs."""
        variables = self._variables(x, u, reference, parameters)
        values = self._values(x[0], d_previous, reference, parameters)
        return float(self._objective(variables, values))

    @staticmethod
    def _values(
        x0: Floats, d_previous: float, reference: Floats, parameters: OcpParameters
    ) -> ca.DM:
        p = parameters
        weight = [p.q_position, p.r_duty, p.r_delta_rate, p.s_slack, p.margin_m]
        return ca.veccat(x0, d_previous, reference.T, weight)

    def _variables(
        self, x: Floats, u: Floats, reference: Floats, parameters: OcpParameters
    ) -> ca.DM:
        return ca.veccat(u.T, x[1:].T, self._slack(x, reference, parameters))

    def _slack(self, x: Floats, reference: Floats, parameters: OcpParameters) -> Floats:
        along = np.sum(reference[:, 2:4] * x[1:, :2], axis=1)
        over = along - reference[:, 5] + parameters.margin_m
        under = reference[:, 4] + parameters.margin_m - along
        return np.asarray(np.maximum(0.0, np.vstack([over, under])))
