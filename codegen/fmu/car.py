"""The car as an FMU: the plant's own equations and guard, in C (``native/car.c``).

Co-Simulation does what :class:`plant.simulator.Simulator` does in a period, with the communication
step as the period; Model Exchange gives the bare equations of the dynamic model.
"""

import re
import tempfile
from math import inf
from pathlib import Path
from typing import Any, Final, Literal

import casadi as ca

from bayesrace.errors import InputError
from bayesrace.integrators import PLANT_SCHEME, PLANT_SUBSTEP_HZ, SCHEMES
from bayesrace.vehicles import models
from bayesrace.vehicles.models import INPUTS, STATES
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.parts import LinearTyres, Pacejka, Part
from codegen.fmu.definition import FmuDefinition, Variable
from codegen.fmu.sources import NATIVE

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
<p>{title}, by which BayesRace simulates the car '{car}': state x = [x, y, psi, vx, vy, omega,
delta], input u = [d, delta_rate], SI units. The start state is the start value of the outputs; any
parameter can be set before initialisation ends.</p>
<pre>
der(x)     = vx cos(psi) - vy sin(psi)
der(y)     = vx sin(psi) + vy cos(psi)
der(psi)   = omega
{rates}
der(delta) = delta_rate

{forces}
</pre>
<p>{slow} {kind}</p>
"""

_PACEJKA: Final = """der(vx)    = (F_x - F_fy sin(delta)) / mass_kg + vy omega
der(vy)    = (F_ry + F_fy cos(delta)) / mass_kg - vx omega
der(omega) = (F_fy lf_m cos(delta) - F_ry lr_m) / inertia_kgm2"""

_PACEJKA_FORCES: Final = """
F_fy = front_d sin(front_c atan(front_b alpha_f))    alpha_f = delta - atan((omega lf_m + vy) / vx)
F_ry = rear_d sin(rear_c atan(rear_b alpha_r))       alpha_r = atan((omega lr_m - vy) / vx)"""

_LINEAR: Final = """der(v)     = F_x / mass_kg    v = sqrt(vx^2 + vy^2)
der(beta)  = (mu / (v^2 L) (lr_m C_r - lf_m C_f) - 1) omega - mu / (v L) (C_r + C_f) beta
             + mu / (v L) C_f delta    beta = atan2(vy, vx)
der(omega) = mu mass_kg / (inertia_kgm2 L) ((lr_m C_r - lf_m C_f) beta + lf_m C_f delta
             - (lf_m^2 C_f + lr_m^2 C_r) omega / v)"""

_LINEAR_FORCES: Final = """    L = lf_m + lr_m    a = der(v)
C_f  = front_stiffness (9.81 lr_m - height_m a)    C_r = rear_stiffness (9.81 lf_m + height_m a)"""

_KIND: Final = {
    "cs": "A communication step has any length and is divided into equal Runge-Kutta steps of at "
    "most 1 ms, with the inputs held. Drive command, steering rate and steering angle stay within "
    "the limits; an input that is not finite brakes the car with the steering held. d_applied and "
    "delta_rate_applied say what acted.",
    "me": "No limit is applied to an input or to the steering angle. Directional and adjoint "
    "derivatives are exact, with respect to states, inputs and parameters.",
}


def _tyres(car: CarParameters) -> str:
    return "linear" if isinstance(car.tyres, LinearTyres) else "Pacejka"


def _title(car: CarParameters) -> str:
    drive = "an acceleration as drive command" if car.drive.guarded else "DC motor"
    return f"dynamic bicycle model with {_tyres(car)} tyres and {drive}"


def _page(car: CarParameters, kind: str) -> str:
    linear = isinstance(car.tyres, LinearTyres)
    force = "mass_kg d" if car.drive.guarded else "(cm1 - cm2 vx) d - cr0 - cr2 vx^2"
    slow = "Below 0.1 m/s, slip angles and rolling resistance fade smoothly to none at standstill."
    if linear:
        slow = "Below switch_mps this passes smoothly into rolling without slip."
    return _PAGE.format(
        title=f"The {_title(car)}",
        car=car.name,
        rates=_LINEAR if linear else _PACEJKA,
        forces=f"F_x  = {force}{_LINEAR_FORCES if linear else _PACEJKA_FORCES}",
        slow=slow,
        kind=_KIND[kind],
    )


def _meanings(car: CarParameters) -> dict[str, tuple[str, dict[str, Any]]]:
    """Flat name of each number to the axle it is of, if any, and its field's schema."""
    found: dict[str, tuple[str, dict[str, Any]]] = {}
    for part in (car.tyres, car.drive):
        for name, value in part:
            form: type[Part] = type(value) if isinstance(value, Part) else type(part)
            fields = form.model_json_schema()["properties"]
            if isinstance(value, Pacejka):
                found |= {f"{name}_{inner}": (name, fields[inner]) for inner in fields}
            else:
                found[name] = "", fields[name]
    return {
        name: ("", field) for name, field in CarParameters.model_json_schema()["properties"].items()
    } | found


def _parameters(car: CarParameters, kind: str) -> list[Variable]:
    """With bounds, unit and description of the car's own data model; limits for the guard only."""
    values = car.equation_numbers | (car.guard_numbers if kind == "cs" else {})
    meanings = _meanings(car)
    return [_parameter(name, value, *meanings[name], car) for name, value in values.items()]


def _parameter(
    name: str, value: float, axle: str, field: dict[str, Any], car: CarParameters
) -> Variable:
    text, unit = re.fullmatch(r"(.*) \[([^]]*)\]", field["description"]).groups()  # type: ignore[union-attr]
    unit = car.drive.unit if unit == "command" else unit
    return Variable(
        name,
        "parameter",
        f"{axle} tyre: {text}" if axle else text,
        unit="1" if unit == "-" else unit.replace(" ", ".").replace("^", ""),
        start=value,
        min=field.get("minimum", field.get("exclusiveMinimum", -inf)),
        max=field.get("maximum", field.get("exclusiveMaximum", inf)),
        exclusive="exclusiveMinimum" in field or "exclusiveMaximum" in field,
    )


def _variables(car: CarParameters, kind: str) -> list[Variable]:
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


def _derivatives(car: CarParameters) -> list[Variable]:
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


def _rates(car: CarParameters) -> Any:
    """The equations as a function of states, inputs and parameters in one vector."""
    ode = models.dynamic_with_parameters(car)
    n, m, k = (ode.size1_in(i) for i in range(3))
    known = ca.SX.sym("known", n + m + k)
    return ca.Function("car_rates", [known], [ode(*ca.vertsplit(known, [0, n, n + m, n + m + k]))])


def _substep(car: CarParameters) -> Any:
    """One integration step of Co-Simulation: (x, u, p, h) -> x_next."""
    ode = models.dynamic_with_parameters(car)
    x, u, p = (ca.SX.sym(name, ode.size1_in(i)) for i, name in enumerate("xup"))
    h: Any = ca.SX.sym("h")  # the schemes take a symbol as well
    _, advance = SCHEMES[PLANT_SCHEME]
    return ca.Function("car_substep", [x, u, p, h], [advance(lambda s: ode(s, u, p), x, h)])


def _functions(car: CarParameters, kind: str) -> list[Any]:
    if kind == "cs":
        return [_substep(car)]
    rates = _rates(car)
    known, weights = ca.SX.sym("known", rates.size1_in(0)), ca.SX.sym("w", rates.size1_out(0))
    seed, xdot = ca.SX.sym("seed", known.size1()), rates(known)
    forward = ca.densify(ca.jtimes(xdot, known, seed))
    reverse = ca.densify(ca.jtimes(xdot, known, weights, True))
    return [
        rates,
        ca.Function("car_forward", [known, seed], [forward]),
        ca.Function("car_reverse", [known, weights], [reverse]),
    ]


def _sources(car: CarParameters, kind: str) -> dict[str, bytes]:
    options: dict[str, Any] = {"with_header": True, "casadi_int": "int", "with_export": False}
    generator = ca.CodeGenerator("car_model.c", options)
    for function in _functions(car, kind):
        generator.add(function)
    with tempfile.TemporaryDirectory() as folder:
        generator.generate(f"{folder}/")
        files = [NATIVE / "car.c", *(Path(folder) / f"car_model.{end}" for end in "ch")]
        return {path.name: path.read_bytes() for path in files}


def car_fmu(
    car: CarParameters, version: Literal[2, 3] = 3, kind: Literal["cs", "me"] = "cs"
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
        documentation=_page(car, kind),
    )
