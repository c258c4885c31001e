"""The car as an FMU: the plant's own equations and guard, in C.

Co-Simulation does what :class:`plant.simulator.Simulator` does in a period, with the communication
step as the period; Model Exchange gives the bare equations of the dynamic model. Not imported by
the plant process, which needs no code generation.
"""

import re
import tempfile
from pathlib import Path
from typing import Any, Final, Literal

from annotated_types import Ge, Gt, Le, Lt

from bayesrace.errors import InputError
from bayesrace.integrators import SCHEMES
from bayesrace.vehicles.models import DYNAMIC_PARAMETERS, STATES, car_value
from bayesrace.vehicles.parameters import CarParameters, Pacejka
from codegen.fmu import FmuDefinition, Variable
from plant.simulator import PLANT, SUBSTEP_HZ

__all__ = ["LIMITS", "car_fmu", "car_values"]

_NATIVE: Final = Path(__file__).parent / "native"

LIMITS: Final = ("d_min", "d_max", "delta_max_rad", "delta_rate_max_radps")
"""Parameters of the guard, Co-Simulation only; the others are models.DYNAMIC_PARAMETERS."""

_STATES: Final = {
    "x": ("m", "position, x"),
    "y": ("m", "position, y"),
    "psi": ("rad", "heading from the x axis, positive to the left, not wrapped"),
    "vx": ("m/s", "forward velocity of the centre of gravity, in the car's frame"),
    "vy": ("m/s", "velocity to the left of the centre of gravity, in the car's frame"),
    "omega": ("rad/s", "yaw rate"),
    "delta": ("rad", "steering angle of the front wheels, positive to the left"),
}

_UNITS: Final = {
    "lf_m": "m",
    "lr_m": "m",
    "mass_kg": "kg",
    "inertia_kgm2": "kg.m2",
    "front_b": "1/rad",
    "front_c": "1",
    "front_d": "N",
    "rear_b": "1/rad",
    "rear_c": "1",
    "rear_d": "N",
    "cm1": "N",
    "cm2": "N.s/m",
    "cr0": "N",
    "cr2": "N.s2/m2",
    "d_min": "1",
    "d_max": "1",
    "delta_max_rad": "rad",
    "delta_rate_max_radps": "rad/s",
}

_PAGE: Final = """
<p>The dynamic bicycle model with Pacejka tyres and a DC motor by which BayesRace simulates the car
'{car}': state x = [x, y, psi, vx, vy, omega, delta], input u = [d, delta_rate], SI units. The start
state is the start value of the outputs; any parameter can be set before initialisation ends.</p>
<pre>
der(x)     = vx cos(psi) - vy sin(psi)
der(y)     = vx sin(psi) + vy cos(psi)
der(psi)   = omega
der(vx)    = (F_x - F_fy sin(delta)) / mass_kg + vy omega
der(vy)    = (F_ry + F_fy cos(delta)) / mass_kg - vx omega
der(omega) = (F_fy lf_m cos(delta) - F_ry lr_m) / inertia_kgm2
der(delta) = delta_rate

F_x  = (cm1 - cm2 vx) d - cr0 - cr2 vx^2
F_fy = front_d sin(front_c atan(front_b alpha_f))    alpha_f = delta - atan((omega lf_m + vy) / vx)
F_ry = rear_d sin(rear_c atan(rear_b alpha_r))       alpha_r = atan((omega lr_m - vy) / vx)
</pre>
<p>Below 0.1 m/s, slip angles and rolling resistance fade smoothly to none at standstill.</p>
{kind}
"""

_KIND_PAGE: Final = {
    "cs": """
<p>A communication step may have any length and is divided into equal Runge-Kutta steps of at most
1 ms. During it, the inputs are held. Whatever they are, the car does what its actuators can: duty
cycle within d_min to d_max, steering rate within &plusmn;delta_rate_max_radps and such that the
steering angle stays within &plusmn;delta_max_rad; an input that is not finite brakes the car, with
the steering held. d_applied and delta_rate_applied say what acted. The state can be saved, set and
serialised at any time.</p>""",
    "me": """
<p>The derivatives are those of the equations as they stand: no limit is applied to an input or to
the steering angle. Directional and adjoint derivatives are exact, with respect to states, inputs
and parameters.</p>""",
}


def car_values(car: CarParameters) -> dict[str, float]:
    """Every FMU parameter of a car by name; ``front_b`` is ``car.front.b``."""
    return {name: car_value(car, name) for name in (*DYNAMIC_PARAMETERS, *LIMITS)}


def _parameter(name: str, value: float) -> Variable:
    """With the bounds and the words of the car's own data model."""
    axle, _, coefficient = name.partition("_")
    if axle in ("front", "rear"):
        field = Pacejka.model_fields[coefficient]
        description = f"{axle} tyre: {field.description}"
    else:
        field = CarParameters.model_fields[name]
        description = field.description or name
    low = high = None
    exclusive = False
    for bound in field.metadata:
        low = bound.gt if isinstance(bound, Gt) else bound.ge if isinstance(bound, Ge) else low
        high = bound.lt if isinstance(bound, Lt) else bound.le if isinstance(bound, Le) else high
        exclusive |= isinstance(bound, Gt | Lt)
    return Variable(
        name,
        "parameter",
        re.sub(r" \[[^]]*\]$", "", description),  # the unit is stated apart
        unit=_UNITS[name],
        start=value,
        min=None if low is None else float(low),  # type: ignore[arg-type]
        max=None if high is None else float(high),  # type: ignore[arg-type]
        exclusive=exclusive,
    )


def _variables(car: CarParameters, kind: str) -> tuple[Variable, ...]:
    """In the order that car.c relies on: states, inputs, parameters, the rest."""
    values = car_values(car)
    held = " (held during a step)" if kind == "cs" else ""
    nominal = {"vx": 1.0, "vy": 0.1, "delta": 0.1}
    variables = [
        Variable(
            name,
            "output",
            text,
            unit=unit,
            start=0.0,
            nominal=nominal.get(name),
            dependencies=(name,) if kind == "me" else (),
        )
        for name, (unit, text) in _STATES.items()
    ]
    variables += [
        Variable(
            "d", "input", f"duty cycle of the motor{held}", unit="1", start=0.0, min=-1, max=1
        ),
        Variable("delta_rate", "input", f"steering rate{held}", unit="rad/s", start=0.0),
    ]
    names = (*DYNAMIC_PARAMETERS, *(LIMITS if kind == "cs" else ()))
    variables += [_parameter(name, values[name]) for name in names]
    if kind == "cs":
        variables += [
            Variable("d_applied", "output", "duty cycle that acted in the last step", unit="1"),
            Variable(
                "delta_rate_applied",
                "output",
                "steering rate that acted in the last step",
                unit="rad/s",
            ),
        ]
    else:
        variables += _derivatives()
    return tuple(variables)


def _derivatives() -> list[Variable]:
    """Their direct dependencies on states and inputs are those of the equations."""
    import casadi as ca

    from bayesrace.vehicles.models import INPUTS, dynamic_with_parameters

    ode = dynamic_with_parameters()
    jacobian = ca.horzcat(*(ode.sparsity_jac(i, 0) for i in range(3)))
    known = (*STATES, *INPUTS, *DYNAMIC_PARAMETERS)

    def dependencies(row: int, count: int) -> tuple[str, ...]:
        return tuple(known[column] for column in range(count) if jacobian.has_nz(row, column))

    rate_units = {"m": "m/s", "rad": "rad/s", "m/s": "m/s2", "rad/s": "rad/s2"}
    return [
        Variable(
            f"der_{name}",
            "local",
            f"time derivative of {name}",
            unit=rate_units[unit],
            derivative_of=name,
            dependencies=dependencies(row, len(STATES) + len(INPUTS)),
            initial_dependencies=dependencies(row, len(known)),
        )
        for row, (name, (unit, _)) in enumerate(_STATES.items())
    ]


def _functions(kind: str) -> list[Any]:
    import casadi as ca

    from bayesrace.vehicles.models import dynamic_with_parameters

    ode = dynamic_with_parameters()
    x, u, p = (ca.SX.sym(name, ode.size1_in(i)) for i, name in enumerate("xup"))
    if kind == "cs":
        h: Any = ca.SX.sym("h")  # the schemes take a symbol as well
        _, advance = SCHEMES[PLANT.scheme]
        x_next = advance(lambda state: ode(state, u, p), x, h)
        return [ca.Function("car_substep", [x, u, p, h], [x_next])]
    known = ca.vertcat(x, u, p)
    xdot = ode(x, u, p)
    seeds = [ca.SX.sym(f"s{v}", v.size1()) for v in (x, u, p)]
    weights = ca.SX.sym("w", xdot.size1())
    forward = ca.jtimes(xdot, known, ca.vertcat(*seeds))
    reverse = ca.jtimes(xdot, known, weights, True)
    parts = ca.vertsplit(reverse, [0, x.size1(), x.size1() + u.size1(), known.size1()])
    return [
        ca.Function("car_rates", [x, u, p], [xdot]),
        ca.Function("car_forward", [x, u, p, *seeds], [ca.densify(forward)]),
        ca.Function("car_reverse", [x, u, p, weights], [ca.densify(part) for part in parts]),
    ]


def _generated(kind: str) -> dict[str, str]:
    import casadi as ca

    options: dict[str, Any] = {"with_header": True, "casadi_int": "int", "with_export": False}
    generator = ca.CodeGenerator("car_model.c", options)
    for function in _functions(kind):
        generator.add(function)
    with tempfile.TemporaryDirectory() as folder:
        generator.generate(f"{folder}/")
        return {name: (Path(folder) / name).read_text() for name in ("car_model.c", "car_model.h")}


def car_fmu(
    car: CarParameters, version: Literal[2, 3] = 3, kind: Literal["cs", "me"] = "cs"
) -> FmuDefinition:
    """Definition of the car's FMU, for :func:`codegen.fmu.pack`.

    InputError for another version or kind, and for Model Exchange in FMI 2.0.
    """
    if kind not in ("cs", "me"):
        raise InputError(f"FMU kind '{kind}' is unknown; choose cs or me")
    constants = {"BRAKE_FADE_MPS": car.brake_fade_mps, "SUBSTEP_HZ": float(SUBSTEP_HZ)}
    return FmuDefinition(
        name=f"BayesRace {car.name}",
        identifier=re.sub(r"[^A-Za-z0-9_]", "_", f"bayesrace_{car.name}"),
        description=f"Race car '{car.name}': dynamic bicycle model with Pacejka tyres and DC motor",
        version=version,
        kind=kind,
        variables=_variables(car, kind),
        sources=(_NATIVE / "car.c",),
        texts=_generated(kind),
        constants=constants if kind == "cs" else {},
        documentation=_PAGE.format(car=car.name, kind=_KIND_PAGE[kind]),
        default_step_s=PLANT.step_s,
        derivatives=kind == "me",
    )
