"""What the problems of driving a car on a track share: its inputs and limits, and the track.

    l = l_states(x_k, p_k) + r_d (d_{k-1} - d_{k-2})^2 + r_delta delta_rate_{k-1}^2
    hard: |delta_k| <= delta_max;  soft: lower + margin <= n_k . p_k <= upper - margin
    d_min <= d <= d_max,  |delta_rate| <= delta_rate_max

The normals n_k have unit length. delta_0 is measured, so it is not constrained. Below
the car's ``brake_fade_mps`` d_min fades to 0: brakes do not drive a car backwards. Above the speed
of its power limit d_max falls; both by the measured speed.
"""

from collections.abc import Callable

import casadi as ca

from bayesrace.codegen.problems.problem import (
    Input,
    Parameter,
    Problem,
    Row,
    State,
    Symbols,
    derivatives,
    linearised,
    with_arguments,
)
from bayesrace.integrators import Discretisation
from bayesrace.vehicles.models import STATES, Model, top_command
from bayesrace.vehicles.parameters import Car

__all__ = ["REFERENCE", "StateCost", "advance_function", "driving_problem", "linearise_function"]

_NX, _NV, _NE = 7, 9, 3
_NW = _NV + _NE

StateCost = Callable[[ca.SX, dict[str, ca.SX], dict[str, ca.SX], ca.SX], ca.SX]
"""Of the state, the stage's and the run-time parameters by name, and :attr:`Symbols.last`."""

REFERENCE = (
    Parameter("x", "m"),
    Parameter("y", "m"),
    Parameter("normal_x", "1", "left normal of the centreline, unit length"),
    Parameter("normal_y", "1"),
    Parameter("lower", "m", "the track is lower <= normal . p <= upper"),
    Parameter("upper", "m"),
)


def _inputs(car: Car, proximal: tuple[float, float]) -> tuple[Input, ...]:
    effort = car.tuning.caution
    return (
        Input("d", car.drive.unit, limit=1e3, proximal=proximal[0], effort=effort.command),
        Input(
            "delta_rate",
            "rad/s",
            held=False,
            limit=1e3,
            proximal=proximal[1],
            effort=effort.steering_rate_radps,
            odd=car.mirrored_samples,
        ),
    )


def _parameters(car: Car) -> tuple[Parameter, ...]:
    command, unit = car.drive.command, car.drive.unit
    per_square = car.drive.unit_per_square
    return (
        Parameter("q_position", "1/m2", "weight of the squared position error", positive=True),
        Parameter(
            "r_duty", per_square, f"weight of the squared change of the {command}", positive=True
        ),
        Parameter("r_delta_rate", "s2/rad2", "weight of the squared steering rate", positive=True),
        Parameter("s_slack", "1/m2", "weight of the squared track violation; 0: no track", low=0),
        Parameter("margin_m", "m", "distance kept from the track edges", low=0),
        Parameter("d_min", unit, f"lowest {command} (full brake)", high=0),
        Parameter("d_max", unit, f"highest {command}", low=0),
        Parameter("delta_max_rad", "rad", "limit of the steering angle", positive=True),
        Parameter("delta_rate_max_radps", "rad/s", "limit of the steering rate", positive=True),
    )


def _states(car: Car) -> tuple[State, ...]:
    """With the sizes by which defects are measured, and the largest plausible values."""
    size, most, off = car.tuning.scale, car.tuning.plausible, car.tuning.caution
    odd = car.mirrored_samples
    return (
        State("x", "m", size.position_m, most.position_m, off.position_m),
        State("y", "m", size.position_m, most.position_m, off.position_m, odd),
        State("psi", "rad", size.heading_rad, most.heading_rad, off.heading_rad, odd),
        State("vx", "m/s", size.speed_mps, most.speed_mps, off.speed_mps),
        State("vy", "m/s", size.speed_mps, most.speed_mps, off.speed_mps, odd),
        State("omega", "rad/s", size.yaw_rate_radps, most.yaw_rate_radps, off.yaw_rate_radps, odd),
        State("delta", "rad", size.steering_rad, most.steering_rad, off.steering_rad, odd),
    )


def _constants(car: Car) -> dict[str, float]:
    """What C is compiled with: sections of the car's tuning, and its wheelbase."""
    tuning = car.tuning
    sections = {
        "path": tuning.path, "turn": tuning.turn, "braking": tuning.braking,
        "monitor": tuning.monitor,
    }  # fmt: skip
    numbers = {f"{n}_{key}": value for n, one in sections.items() for key, value in one}
    numbers["wheelbase_m"] = car.wheelbase_m
    return numbers | {f"caution_{key}": value for key, value in tuning.caution.pace}


def _composed(model: Model, discretisation: Discretisation) -> tuple[ca.Function, ca.Function]:
    """``w -> (F, J)`` and ``(w, lambda) -> H`` for many sub-steps.

    By the chain rule, so that code grows by calls. With S_i = d [x_i; u] / d [x; u] and lambda_i
    the costate of sub-step i:

        J = d x_n / d v,    H = sum_i S_i' H_i(lambda_i) S_i,    lambda_i = A_i' lambda_{i+1}

    e enters at the end of the step: its columns of J are unit vectors, those of H zero.
    """
    n = discretisation.substeps
    one = discretisation.model_copy(update={"step_s": discretisation.step_s / n, "substeps": 1})
    v = ca.SX.sym("v", _NV)
    forward, second = derivatives(v, one.discretise(model)(v[:_NX], v[_NX:]), "_substep")
    w, lam = ca.MX.sym("w", _NW), ca.MX.sym("lambda", _NX)
    u = w[_NX:_NV]
    states, jacobians = [w[:_NX]], []
    for _ in range(n):
        x_next, jacobian = forward(ca.vertcat(states[-1], u))
        states.append(x_next)
        jacobians.append(jacobian)
    hold_u = ca.horzcat(ca.MX.zeros(2, _NX), ca.MX.eye(2))
    sensitivities = [ca.MX.eye(_NV)]
    for jacobian in jacobians:
        sensitivities.append(ca.vertcat(jacobian @ sensitivities[-1], hold_u))
    costate = lam
    hessian = ca.MX(_NV, _NV)
    for i in reversed(range(n)):
        curvature = second(ca.vertcat(states[i], u), costate)
        hessian += sensitivities[i].T @ curvature @ sensitivities[i]
        costate = jacobians[i][:, :_NX].T @ costate
    enters = ca.vertcat(ca.DM.zeros(3, _NE), ca.DM.eye(_NE), ca.DM.zeros(1, _NE))
    jacobian = ca.horzcat(sensitivities[n][:_NX, :], enters)
    hessian = ca.diagcat(hessian, ca.DM.zeros(_NE, _NE))
    x_next = states[-1] + enters @ w[_NV:]
    options = {"cse": True}
    return (
        ca.Function("br_composed", [w], [x_next, ca.densify(jacobian)], options),
        ca.Function("br_composed_second", [w, lam], [ca.densify(hessian)], options),
    )


def linearise_function(model: Model, discretisation: Discretisation) -> ca.Function:
    """:func:`linearised` of the discretised model.

    e (3) is the residual's mean, added to vx, vy, omega at the end of the step.
    """
    if discretisation.substeps > 1 and discretisation.pose == "integrated":
        return with_arguments(*_composed(model, discretisation), _NX, _NV - _NX, _NE)
    return linearised(discretisation.corrected(model))


def advance_function(model: Model, discretisation: Discretisation) -> ca.Function:
    """``(x, u, e, h) -> x_next``: the model over h [s], e what the residual adds within it."""
    over = discretisation.over(model)
    x, u, e, h = (ca.SX.sym(name, n) for name, n in (("x", _NX), ("u", 2), ("e", _NE), ("h", 1)))
    x_next = ca.densify(over(x, u, e, h))
    names = ["x", "u", "e", "h"]
    return ca.Function("br_advance", [x, u, e, h], [x_next], names, ["x_next"], {"cse": True})


def driving_problem(
    name: str,
    model: Model,
    discretisation: Discretisation,
    state_cost: StateCost,
    *,
    follows: tuple[Parameter, ...] = (),
    cost_weights: tuple[Parameter, ...] = (),
    proximal: tuple[float, float] = (0.0, 0.0),
) -> Problem:
    """The problem with one prediction model (seven states, drive command and steering rate).

    ``follows``: further parameters of a stage, which the planner takes from where the plan is on
    the line; none: it gives points to track. ``cost_weights``: further run-time parameters.
    ``proximal``: see :class:`Input`.
    """
    car = model.car
    inputs, parameters = _inputs(car, proximal), (*_parameters(car), *cost_weights)
    stage = (*REFERENCE, *follows)
    s = Symbols.of(len(STATES), len(inputs), len(stage), len(parameters))
    p = {one.name: s.p[i] for i, one in enumerate(stage)}
    theta = {one.name: s.theta[i] for i, one in enumerate(parameters)}
    limits = ("d_min", "d_max", "delta_max_rad", "delta_rate_max_radps")
    d_min, d_max, delta_max, rate_max = (theta[one] for one in limits)
    x, y, _, vx, vy, _, delta = ca.vertsplit(s.x)
    d, rate = ca.vertsplit(s.u)
    cost = state_cost(s.x, p, theta, s.last)
    cost += theta["r_duty"] * (d - s.u_before[0]) ** 2 + theta["r_delta_rate"] * rate**2
    along = p["normal_x"] * x + p["normal_y"] * y
    margin = theta["margin_m"]
    fade = ca.fmin(ca.fmax(vx / car.brake_fade_mps, 0), 1)
    brake = ca.if_else(d_min < 0, d_min * fade, d_min)
    # The nearest rate within its limit that leaves the angle within its own after h.
    within = ca.fmin(ca.fmax(rate, (-delta_max - delta) / s.h), (delta_max - delta) / s.h)
    reached = ca.vertcat(s.x[:6], ca.fmin(ca.fmax(delta, -delta_max), delta_max))
    return Problem(
        name=name,
        states=_states(car),
        inputs=inputs,
        stage_parameters=stage,
        parameters=parameters,
        features=("vx", "vy", "omega", "delta", "d", "delta_rate"),
        outputs=3,
        symbols=s,
        f=discretisation.corrected(model),
        linearise=linearise_function(model, discretisation),
        advance=advance_function(model, discretisation),
        cost=cost,
        rows=(
            Row("steering angle", delta, -delta_max, delta_max),
            Row(
                "track", along, p["lower"] + margin, p["upper"] - margin,
                penalty=theta["s_slack"], cautious=True,
            ),
        ),
        u_lower=ca.vertcat(brake, -rate_max),
        u_upper=ca.vertcat(top_command(car, ca.sqrt(vx**2 + vy**2), d_max), rate_max),
        guess=ca.vertcat(ca.fmin(ca.fmax(s.u_before[0], s.share * d_max), d_max), 0),
        acting=ca.vertcat(
            ca.fmin(ca.fmax(d, d_min), d_max), ca.fmin(ca.fmax(within, -rate_max), rate_max)
        ),
        reached=reached,
        valid=d_max - d_min,
        path={
            "x": "x", "y": "y", "psi": "psi", "vx": "vx", "vy": "vy", "omega": "omega",
            "delta": "delta", "duty": "d", "delta_rate": "delta_rate",
        },
        constants=_constants(car),
        follows_plan=bool(follows),
    )  # fmt: skip
