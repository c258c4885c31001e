"""What control problems are described with: see docs/extending.md, "Add a control problem".

A :class:`Problem` has states, inputs, parameters, a prediction model, cost and constraints as
CasADi expressions. :func:`driving_problem` makes one of a car from a cost of its states, with
inputs, limits and track as the built-in problems have them; :class:`bayesrace.Controller` takes it.
"""

from bayesrace.codegen.problems.driving import driving_problem
from bayesrace.codegen.problems.problem import (
    NO_BOUND,
    Input,
    Parameter,
    Problem,
    Row,
    State,
    Symbols,
    linearised,
)
from bayesrace.integrators import PERFECT, PREDICTION, Discretisation
from bayesrace.vehicles.models import Model, dynamic, e_kinematic

__all__ = [
    "NO_BOUND",
    "PERFECT",
    "PREDICTION",
    "Discretisation",
    "Input",
    "Model",
    "Parameter",
    "Problem",
    "Row",
    "State",
    "Symbols",
    "driving_problem",
    "dynamic",
    "e_kinematic",
    "linearised",
]
