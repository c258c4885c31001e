"""Progress along a line in the least time, within the track.

    l_states = q_contour |p_k - p_foot,k|^2
    at the last stage besides:  - gain tau'_N t_N . (p_N - p_foot,N)

p_foot,k is the foot on the line, at arc length theta_k, of where the plan itself is; the planner
finds it anew before each QP. So the problem needs no virtual state for theta and no lag error, as
that of Liniger, Domahidi and Morari ("Optimization-based autonomous racing of 1:43 scale RC cars",
2015) does. t is the line's direction and tau' = 1 / ((1 - kappa n) v_line) the time that the line
takes for a metre of the car's way at distance n from it: what is maximised is the time on the line
that the car gets ahead by within the horizon. That cost is linear where it counts, so the QP has a
proximal term, as small as convexity allows. A stage with ``follows = 0``, for a stop or a turn,
tracks the point (x, y) as :mod:`bayesrace.codegen.problems.tracking` does;
:mod:`bayesrace.codegen.problems.driving` has the rest.
"""

import casadi as ca

from bayesrace.codegen.problems.driving import driving_problem
from bayesrace.codegen.problems.problem import Parameter, Problem
from bayesrace.integrators import Discretisation
from bayesrace.vehicles.models import Model

__all__ = ["progress"]

_FOLLOWS = (
    Parameter("follows", "1", "1: (x, y) is the foot on the line; 0: a point to track"),
    Parameter("pace_x", "s/m", "gradient of the time that the line takes up to the foot"),
    Parameter("pace_y", "s/m"),
)

_WEIGHTS = (
    Parameter("q_contour", "1/m2", "weight of the squared distance to the line", positive=True),
    Parameter("gain", "1/s", "reward of the time that the line takes for the progress", low=0),
)


def progress(model: Model, discretisation: Discretisation) -> Problem:
    """The problem with one prediction model (seven states, drive command and steering rate)."""
    tuning = model.car.tuning.progress
    return driving_problem(
        "progress",
        model,
        discretisation,
        _cost,
        follows=_FOLLOWS,
        cost_weights=_WEIGHTS,
        proximal=(tuning.proximal_duty, tuning.proximal_delta_rate),
    )


def _cost(x: ca.SX, p: dict[str, ca.SX], theta: dict[str, ca.SX], last: ca.SX) -> ca.SX:
    """What of the cost depends on the states."""
    dx, dy = x[0] - p["x"], x[1] - p["y"]
    q = p["follows"] * theta["q_contour"] + (1 - p["follows"]) * theta["q_position"]
    ahead = p["pace_x"] * dx + p["pace_y"] * dy
    return q * (dx**2 + dy**2) - last * p["follows"] * theta["gain"] * ahead
