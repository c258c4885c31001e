"""Tracking of a racing line, equation (8) of the paper: l_states = q |p_k - p_ref,k|^2.

The rest is in :mod:`bayesrace.codegen.problems.driving`.
"""

import casadi as ca

from bayesrace.codegen.problems.driving import driving_problem
from bayesrace.codegen.problems.problem import Problem
from bayesrace.integrators import Discretisation
from bayesrace.vehicles.models import Model

__all__ = ["tracking"]


def tracking(model: Model, discretisation: Discretisation) -> Problem:
    """The problem with one prediction model (seven states, drive command and steering rate)."""
    return driving_problem("tracking", model, discretisation, _position_error)


def _position_error(x: ca.SX, p: dict[str, ca.SX], theta: dict[str, ca.SX], _last: ca.SX) -> ca.SX:
    return theta["q_position"] * ((x[0] - p["x"]) ** 2 + (x[1] - p["y"]) ** 2)
