"""The car as an FMU: the plant's own equations and guard, in C (``native/car.c``).

Co-Simulation does what :class:`bayesrace.plant.simulator.Simulator` does in a period, with the
communication step as the period; Model Exchange gives the bare equations of the dynamic model.
"""

import re
import tempfile
from html import escape
from math import inf
from pathlib import Path
from typing import Any, Final, Literal

import casadi as ca

from bayesrace.codegen.fmu.build import NATIVE, FmuDefinition, Variable
from bayesrace.errors import InputError
from bayesrace.integrators import PLANT_SCHEME, PLANT_SUBSTEP_HZ, SCHEMES
from bayesrace.vehicles import models
from bayesrace.vehicles.models import INPUTS, STATES
from bayesrace.vehicles.parameters import Car
from bayesrace.vehicles.parts import LinearTyres, Pacejka

__all__ = ["STATE", "car_fmu"]

STATE: Final = {
    "x": ("m", "position, x"),
    "y": ("m", "position, y"),
    "psi": ("rad", "heading from the x axis, positive to the left, not wrapped"),
    "vx": ("m/s", "forward velocity of the centre of gravity, in the car's frame"),
    "vy": ("m/s", "velocity to the left of the centre of gravity, in the car's frame"),
    "omega": ("rad/s", "yaw rate"),
    "delta": ("rad", "steering angle of the front wheels, positive to the left"),
}
"""Unit and meaning of each state."""

_PAGE: Final = """
<p>The {title}, by which BayesRace simulates the car '{car}' (its docs/equations.md): state x = [x,
y, psi, vx, vy, omega, delta], input u = [d, delta_rate], SI units. The start state is the start
value of the outputs; any parameter can be set before initialisation ends.</p>
<p>{kind}</p>
"""

_KIND: Final = {
    "cs": "A communication step has any length and is divided into equal Runge-Kutta steps of at "
    "most 1 ms, with the inputs held. Drive command, steering rate and steering angle stay within "
    "the limits; an input that is not finite brakes the car with the steering held. d_applied and "
    "delta_rate_applied say what acted.",
    "me": "No limit is applied to an input or to the steering angle. Directional derivatives are "
    "exact, with respect to states, inputs and parameters.",
}


def _title(car: Car) -> str:
    tyres = "linear" if isinstance(car.tyres, LinearTyres) else "Pacejka"
    drive = "an acceleration as drive command" if car.drive.guarded else "DC motor"
    return f"dynamic bicycle model with {tyres} tyres and {drive}"


def _parameters(car: Car, kind: str) -> list[Variable]:
    """With bounds, unit and description of the car's own data model; limits for the guard only."""
    fields: dict[str, tuple[str, dict[str, Any]]] = {}  # axle, if it is of one, and schema
    for part in (car, car.true_tyres, car.drive):
        schema = type(part).model_json_schema()["properties"]
        for name, value in part:
            if isinstance(value, Pacejka):
                inner = Pacejka.model_json_schema()["properties"]
                fields |= {f"{name}_{one}": (f"{name} tyre: ", inner[one]) for one in inner}
            else:
                fields[name] = "", schema[name]
    values = car.equation_numbers | (car.guard_numbers if kind == "cs" else {})
    return [_parameter(name, value, *fields[name], car) for name, value in values.items()]


def _parameter(name: str, value: float, axle: str, field: dict[str, Any], car: Car) -> Variable:
    text, unit = re.fullmatch(r"(.*) \[([^]]*)\]", field["description"]).groups()  # type: ignore[union-attr]
    unit = {"command": car.drive.unit, "-": "1"}.get(unit, unit)
    return Variable(
        name,
        "parameter",
        f"{axle}{text}",
        unit=unit.replace(" ", ".").replace("^", ""),
        start=value,
        min=field.get("minimum", field.get("exclusiveMinimum", -inf)),
        max=field.get("maximum", field.get("exclusiveMaximum", inf)),
        exclusive="exclusiveMinimum" in field or "exclusiveMaximum" in field,
    )


def _variables(car: Car, kind: str) -> list[Variable]:
    """In the order that car.c relies on: states, inputs, parameters, the rest."""
    sampled = kind == "cs"
    held = " (held during a step)" if sampled else ""
    nominal = {"vx": 1.0, "vy": 0.1, "delta": 0.1}
    variables = [
        Variable(
            name, "output", text, unit=unit, start=0.0, nominal=nominal.get(name),
            dependencies=() if sampled else (name,),
        )
        for name, (unit, text) in STATE.items()
    ]  # fmt: skip
    command, unit = car.drive.command, car.drive.unit
    end = 1.0 if unit == "1" else inf
    variables += [
        Variable(
            "d", "input", f"{command} of the drive{held}", unit=unit, start=0.0, min=-end, max=end
        ),
        Variable("delta_rate", "input", f"steering rate{held}", unit="rad/s", start=0.0),
        *_parameters(car, kind),
    ]
    if not sampled:
        return variables + _derivatives(car)
    acted = "that acted in the last step"
    return [
        *variables,
        Variable("d_applied", "output", f"{command} {acted}", unit=unit),
        Variable("delta_rate_applied", "output", f"steering rate {acted}", unit="rad/s"),
    ]


def _derivatives(car: Car) -> list[Variable]:
    """Their direct dependencies on states and inputs are those of the equations."""
    sparsity = _rates(car).sparsity_jac(0, 0)
    names = (*STATES, *INPUTS)
    return [
        Variable(
            f"der_{name}",
            "local",
            f"time derivative of {name}",
            unit=f"{unit}2" if unit.endswith("/s") else f"{unit}/s",
            derivative_of=name,
            dependencies=tuple(n for column, n in enumerate(names) if sparsity.has_nz(row, column)),
        )
        for row, (name, (unit, _)) in enumerate(STATE.items())
    ]


def _rates(car: Car) -> Any:
    """The equations as a function of states, inputs and parameters in one vector."""
    ode = models.dynamic_with_parameters(car)
    n, m, k = (ode.size1_in(i) for i in range(3))
    known = ca.SX.sym("known", n + m + k)
    return ca.Function("car_rates", [known], [ode(*ca.vertsplit(known, [0, n, n + m, n + m + k]))])


def _substep(car: Car) -> Any:
    """One integration step of Co-Simulation: (x, u, p, h) -> x_next."""
    ode = models.dynamic_with_parameters(car)
    x, u, p = (ca.SX.sym(name, ode.size1_in(i)) for i, name in enumerate("xup"))
    h: Any = ca.SX.sym("h")  # the schemes take a symbol as well
    _, advance = SCHEMES[PLANT_SCHEME]
    return ca.Function("car_substep", [x, u, p, h], [advance(lambda s: ode(s, u, p), x, h)])


def _functions(car: Car, kind: str) -> list[Any]:
    if kind == "cs":
        return [_substep(car)]
    rates = _rates(car)
    known, seed = (ca.SX.sym(name, rates.size1_in(0)) for name in ("known", "seed"))
    forward = ca.densify(ca.jtimes(rates(known), known, seed))
    return [rates, ca.Function("car_forward", [known, seed], [forward])]


def _sources(car: Car, kind: str) -> dict[str, bytes]:
    options: dict[str, Any] = {"with_header": True, "casadi_int": "int", "with_export": False}
    generator = ca.CodeGenerator("car_model.c", options)
    for function in _functions(car, kind):
        generator.add(function)
    with tempfile.TemporaryDirectory() as folder:
        generator.generate(f"{folder}/")
        files = [NATIVE / "car.c", *(Path(folder) / f"car_model.{end}" for end in "ch")]
        return {path.name: path.read_bytes() for path in files}


def car_fmu(
    car: Car, version: Literal[2, 3] = 3, kind: Literal["cs", "me"] = "cs"
) -> FmuDefinition:
    """Definition of the car's FMU: Co-Simulation, or Model Exchange, which is FMI 3.0 only.

    InputError for Model Exchange in FMI 2.0.
    """
    if version == 2 and kind == "me":
        raise InputError("Model Exchange is exported for FMI 3.0 only: use --version 3")
    constants = {"ACCELERATION_DRIVE": 1.0} if car.drive.guarded else {}
    constants |= {name.upper(): number for name, number in car.brake_numbers.items()}
    constants |= {"SUBSTEP_HZ": float(PLANT_SUBSTEP_HZ)}
    return FmuDefinition(
        name=f"BayesRace {car.name}",
        identifier=re.sub(r"[^A-Za-z0-9_]", "_", f"bayesrace_{car.name}"),
        description=f"Race car '{car.name}': {_title(car)}",
        version=version,
        variables=tuple(_variables(car, kind)),
        sources=_sources(car, kind),
        constants=constants if kind == "cs" else {},
        documentation=_PAGE.format(title=_title(car), car=escape(car.name), kind=_KIND[kind]),
    )
