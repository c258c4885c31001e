"""Continuous-time vehicle models, paper table 1, written once as CasADi expressions.

All share the interface ``xdot = ode(x, u)``. The e-kinematic and the dynamic model have the state
``x = [x, y, psi, vx, vy, omega, delta]`` and the input ``u = [d, delta_rate]``; the kinematic model
has ``x = [x, y, psi, v, delta]`` and ``u = [a, delta_rate]``.

The equations hold exactly as printed for vx above :data:`BLEND_SPEED_MPS`. Below it, slip angles
and rolling resistance go to zero with the speed through twice continuously differentiable
polynomials (drag, cr2 vx |vx|, once), so that a standing car stays where it is and no solver meets
a division by zero.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import casadi as ca

from bayesrace.vehicles.parameters import CarParameters, Pacejka

__all__ = [
    "BLEND_SPEED_MPS",
    "DYNAMIC_PARAMETERS",
    "INPUTS",
    "MODELS",
    "ROLL_SPEED_MPS",
    "STATES",
    "Model",
    "car_value",
    "dynamic",
    "dynamic_with_parameters",
    "e_kinematic",
    "kinematic",
    "longitudinal_force",
    "motor_force",
]

STATES: Final = ("x", "y", "psi", "vx", "vy", "omega", "delta")
INPUTS: Final = ("d", "delta_rate")

DYNAMIC_PARAMETERS: Final = (
    *("lf_m", "lr_m", "mass_kg", "inertia_kgm2"),
    *("front_b", "front_c", "front_d", "rear_b", "rear_c", "rear_d"),
    *("cm1", "cm2", "cr0", "cr2"),
)
"""What the dynamic model depends on; ``front_b`` is ``car.front.b``."""

BLEND_SPEED_MPS: Final = 0.1
"""Slip angles are those of the paper above this speed and fade with the speed below it."""

ROLL_SPEED_MPS: Final = 0.02
"""Rolling resistance has its full size above this speed."""


@dataclass(frozen=True)
class Model:
    """A vehicle model: ``ode`` maps (x, u) to xdot, both column vectors in SI units."""

    name: str
    car: CarParameters
    ode: ca.Function
    states: tuple[str, ...] = STATES
    inputs: tuple[str, ...] = INPUTS
    any_car: ca.Function | None = None
    """The same equations for any car, (x, u, p) -> xdot, where there are such."""
    parameters: tuple[float, ...] = ()
    """This car's p."""


def _smooth_abs(v: Any, corner: float) -> Any:
    """|v| for |v| >= corner, an even C2 polynomial with minimum 3/8 corner below."""
    z2 = ca.fmin((v / corner) ** 2, 1.0)
    inside = corner * (3 + 6 * z2 - z2**2) / 8
    return ca.if_else(ca.fabs(v) >= corner, ca.fabs(v), inside)


def _smooth_sign(v: Any, corner: float) -> Any:
    """sign(v) for |v| >= corner, an odd C2 polynomial through zero below."""
    z = ca.fmin(ca.fmax(v / corner, -1.0), 1.0)
    return z * (15 - 10 * z**2 + 3 * z**4) / 8


def motor_force(car: CarParameters, vx: Any, d: Any) -> Any:
    """Longitudinal force of the DC motor, (Cm1 - Cm2 vx) d [N]; section 3 of the paper."""
    return (car.cm1 - car.cm2 * vx) * d


def _rolling_resistance(car: CarParameters, vx: Any) -> Any:
    """Cr + Cd vx^2, opposed to the motion: it stops a car and cannot push it backwards [N]."""
    return car.cr0 * _smooth_sign(vx, ROLL_SPEED_MPS) + car.cr2 * vx * ca.fabs(vx)


def longitudinal_force(car: CarParameters, vx: Any, d: Any) -> Any:
    """F_r,x of the true car: motor less rolling and drag resistance [N]; section 3 of the paper."""
    return motor_force(car, vx, d) - _rolling_resistance(car, vx)


def _lateral_force(tyre: Pacejka, alpha: Any) -> Any:
    return tyre.d * ca.sin(tyre.c * ca.atan(tyre.b * alpha))


def _slip_angles(car: CarParameters, x: Any) -> tuple[Any, Any]:
    """Front and rear slip angle from the wheels' own velocities (equal to table 1 at speed).

    In the frame of the turned front wheel, alpha_f = -atan(v_lateral / |v_rolling|), which is
    delta - atan((omega lf + vy) / vx), but also right for a standing or backwards rolling wheel.
    """
    vx, vy, omega, delta = x[3], x[4], x[5], x[6]
    vy_front = vy + car.lf_m * omega
    lateral = vy_front * ca.cos(delta) - vx * ca.sin(delta)
    rolling = vx * ca.cos(delta) + vy_front * ca.sin(delta)
    alpha_f = -ca.atan(lateral / _smooth_abs(rolling, BLEND_SPEED_MPS))
    alpha_r = ca.atan((car.lr_m * omega - vy) / _smooth_abs(vx, BLEND_SPEED_MPS))
    return alpha_f, alpha_r


def _pose_rates(x: Any) -> tuple[Any, Any, Any]:
    psi, vx, vy = x[2], x[3], x[4]
    return (
        vx * ca.cos(psi) - vy * ca.sin(psi),
        vx * ca.sin(psi) + vy * ca.cos(psi),
        x[5],
    )


def _function(name: str, x: Any, u: Any, xdot: list[Any]) -> ca.Function:
    return ca.Function(name, [x, u], [ca.vertcat(*xdot)], ["x", "u"], ["xdot"])


def dynamic(car: CarParameters) -> Model:
    """Dynamic bicycle model with Pacejka tyres and DC motor (paper table 1, middle column)."""
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 2)
    ode = _function("dynamic", x, u, _dynamic_rates(car, x, u))
    parameters = tuple(car_value(car, name) for name in DYNAMIC_PARAMETERS)
    return Model("dynamic", car, ode, any_car=dynamic_with_parameters(), parameters=parameters)


def car_value(car: CarParameters, name: str) -> float:
    """A number of a car by its flat name, as in :data:`DYNAMIC_PARAMETERS`."""
    axle, _, coefficient = name.partition("_")
    if axle in ("front", "rear"):
        return float(getattr(getattr(car, axle), coefficient))
    return float(getattr(car, name))


def dynamic_with_parameters() -> ca.Function:
    """The dynamic model for any car: (x, u, p) -> xdot with p as :data:`DYNAMIC_PARAMETERS`.

    With the numbers of a car it is :func:`dynamic` but for the rounding of folded constants.
    """
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 2)
    p = ca.SX.sym("p", len(DYNAMIC_PARAMETERS))
    symbol: dict[str, Any] = dict(zip(DYNAMIC_PARAMETERS, ca.vertsplit(p), strict=True))
    tyres: dict[str, Any] = {
        axle: Pacejka.model_construct(**{c: symbol.pop(f"{axle}_{c}") for c in ("b", "c", "d")})
        for axle in ("front", "rear")
    }
    car = CarParameters.model_construct(name="any", **tyres, **symbol)
    xdot = ca.vertcat(*_dynamic_rates(car, x, u))
    return ca.Function("dynamic", [x, u, p], [xdot], ["x", "u", "p"], ["xdot"])


def _dynamic_rates(car: CarParameters, x: Any, u: Any) -> list[Any]:
    """The equations; the car's values may be numbers or symbols."""
    vx, vy, omega, delta = x[3], x[4], x[5], x[6]
    alpha_f, alpha_r = _slip_angles(car, x)
    f_front, f_rear = _lateral_force(car.front, alpha_f), _lateral_force(car.rear, alpha_r)
    f_drive = longitudinal_force(car, vx, u[0])
    m = car.mass_kg
    return [
        *_pose_rates(x),
        (f_drive - f_front * ca.sin(delta) + m * vy * omega) / m,
        (f_rear + f_front * ca.cos(delta) - m * vx * omega) / m,
        (f_front * car.lf_m * ca.cos(delta) - f_rear * car.lr_m) / car.inertia_kgm2,
        u[1],
    ]


def e_kinematic(car: CarParameters) -> Model:
    """Extended kinematic model (paper table 1, right column): lf, lr and mass only.

    The yaw acceleration divides by lf + lr as the paper prints it (its published code multiplies).
    Rolling and drag resistance are left out, as in the paper; the residual learns them.
    """
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 2)
    vx, delta = x[3], x[6]
    ax = motor_force(car, vx, u[0]) / car.mass_kg
    common = (u[1] * vx + delta * ax) / car.wheelbase_m
    xdot = [*_pose_rates(x), ax, car.lr_m * common, common, u[1]]
    return Model("e_kinematic", car, _function("e_kinematic", x, u, xdot))


def kinematic(car: CarParameters) -> Model:
    """Kinematic bicycle model (paper table 1, left column); u = [a m/s^2, delta_rate rad/s]."""
    x, u = ca.SX.sym("x", 5), ca.SX.sym("u", 2)
    psi, v, delta = x[2], x[3], x[4]
    beta = ca.atan(car.lr_m / car.wheelbase_m * ca.tan(delta))
    xdot = [
        v * ca.cos(psi + beta),
        v * ca.sin(psi + beta),
        v / car.lr_m * ca.sin(beta),
        u[0],
        u[1],
    ]
    ode = _function("kinematic", x, u, xdot)
    return Model("kinematic", car, ode, ("x", "y", "psi", "v", "delta"), ("a", "delta_rate"))


MODELS: Final[dict[str, Callable[[CarParameters], Model]]] = {
    "dynamic": dynamic,
    "e_kinematic": e_kinematic,
    "kinematic": kinematic,
}
