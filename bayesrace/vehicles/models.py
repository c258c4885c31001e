"""Continuous-time vehicle models, paper table 1, written once as CasADi expressions.

All share the interface ``xdot = ode(x, u)``. The e-kinematic and the dynamic model have the state
``x = [x, y, psi, vx, vy, omega, delta]`` and the input ``u = [d, delta_rate]``; the kinematic model
has ``x = [x, y, psi, v, delta]`` and ``u = [a, delta_rate]``.

The equations hold exactly as printed for vx above :data:`BLEND_SPEED_MPS`. Below it, slip angles
and rolling resistance go to zero with the speed through twice continuously differentiable
polynomials (drag, cr2 vx |vx|, once), so that a standing car stays where it is and no solver meets
a division by zero. A car on linear tyres rolls without slip at low speed, as CommonRoad's does.
d is the command of the car's drive: duty cycle, or acceleration in m/s^2.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import casadi as ca

from bayesrace.vehicles.parameters import BODY, Car
from bayesrace.vehicles.parts import (
    GRAVITY_MPS2,
    AccelerationDrive,
    DcMotor,
    LinearTyres,
    Pacejka,
    PacejkaTyres,
    Part,
)

__all__ = [
    "BLEND_SPEED_MPS",
    "INPUTS",
    "MODELS",
    "ROLL_SPEED_MPS",
    "STATES",
    "Model",
    "command_limits",
    "dynamic",
    "dynamic_with_parameters",
    "e_kinematic",
    "kinematic",
    "longitudinal_force",
    "motor_force",
    "top_command",
]

STATES: Final = ("x", "y", "psi", "vx", "vy", "omega", "delta")
INPUTS: Final = ("d", "delta_rate")

BLEND_SPEED_MPS: Final = 0.1
"""Slip angles are those of the paper above this speed and fade with the speed below it."""

ROLL_SPEED_MPS: Final = 0.02
"""Rolling resistance has its full size above this speed."""


@dataclass(frozen=True)
class Model:
    """A vehicle model: ``ode`` maps (x, u) to xdot, both column vectors in SI units."""

    name: str
    car: Car
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


def _smooth_step(v: Any) -> Any:
    """0 for v <= 0, 1 for v >= 1, a C2 polynomial in between."""
    z = ca.fmin(ca.fmax(v, 0), 1)
    return z**3 * (10 - 15 * z + 6 * z**2)


def motor_force(car: Car, vx: Any, d: Any) -> Any:
    """Longitudinal force of the drive without resistances [N].

    Of the DC motor (Cm1 - Cm2 vx) d, section 3 of the paper; else mass times the acceleration d.
    """
    drive = car.drive
    return (drive.cm1 - drive.cm2 * vx) * d if isinstance(drive, DcMotor) else car.mass_kg * d


def longitudinal_force(car: Car, vx: Any, d: Any) -> Any:
    """F_r,x of the true car: drive less rolling and drag resistance [N]; section 3 of the paper.

    Rolling resistance Cr + Cd vx^2 is opposed to the motion: it stops a car and cannot push it
    backwards. An acceleration that is commanded has the resistances in it.
    """
    drive, force = car.drive, motor_force(car, vx, d)
    if not isinstance(drive, DcMotor):
        return force
    return force - (drive.cr0 * _smooth_sign(vx, ROLL_SPEED_MPS) + drive.cr2 * vx * ca.fabs(vx))


def top_command(car: Car, v: Any, d_max: Any) -> Any:
    """Highest drive command that acts at a speed v; the plant's guard has it in numbers."""
    drive = car.drive
    if not isinstance(drive, AccelerationDrive):
        return d_max
    fade = (drive.speed_max_mps - v) / (0.05 * drive.speed_max_mps)
    share = drive.power_speed_mps / ca.fmax(v, drive.power_speed_mps)
    return d_max * share * ca.fmin(ca.fmax(fade, 0), 1)


def command_limits(car: Car, v: Any, d: Any) -> list[Any]:
    """Smooth expressions, over d_max; none is above 0 where d is within :func:`top_command`.

    For optimisers, which end badly at the bends of a minimum: there is one for each of its parts.
    """
    drive = car.drive
    if not isinstance(drive, AccelerationDrive):
        return [d / car.d_max - 1]
    share, power = d / car.d_max, v / drive.power_speed_mps
    fade = (drive.speed_max_mps - v) / (0.05 * drive.speed_max_mps)
    return [share - 1, share - fade, share * power - 1, share * power - fade]


def _lateral_force(tyre: Pacejka, alpha: Any) -> Any:
    return tyre.d * ca.sin(tyre.c * ca.atan(tyre.b * alpha))


def _slip_angles(car: Car, x: Any) -> tuple[Any, Any]:
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


def dynamic(car: Car) -> Model:
    """Single-track model of the true car (paper table 1, middle column).

    Pacejka tyres are the paper's; linear ones are those of CommonRoad's single-track model.
    """
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 2)
    ode = _function("dynamic", x, u, _dynamic_rates(car, x, u))
    parameters = tuple(car.equation_numbers.values())
    return Model("dynamic", car, ode, any_car=dynamic_with_parameters(car), parameters=parameters)


def dynamic_with_parameters(like: Car) -> ca.Function:
    """The dynamic model for any car with such tyres and drive: (x, u, p) -> xdot.

    p is as :attr:`Car.equation_numbers`. With the numbers of a car it is :func:`dynamic`
    but for the rounding of folded constants.
    """
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 2)
    p = ca.SX.sym("p", len(like.equation_numbers))
    symbols = iter(ca.vertsplit(p))
    xdot = ca.vertcat(*_dynamic_rates(_symbolic(like, symbols), x, u))
    return ca.Function("dynamic", [x, u, p], [xdot], ["x", "u", "p"], ["xdot"])


def _symbolic(like: Car, symbols: Iterator[Any]) -> Car:
    """A car whose numbers are symbols, in the order of :attr:`Car.equation_numbers`."""

    def of(value: Any) -> Any:
        if isinstance(value, Part):
            return value.model_copy(update={n: of(v) for n, v in value if n != "model"})
        return next(symbols)

    values = {name: next(symbols) for name in BODY} | {"tyres": of(like.true_tyres)}
    drive = like.drive if like.drive.guarded else of(like.drive)
    return like.model_copy(update=values | {"drive": drive})


def _dynamic_rates(car: Car, x: Any, u: Any) -> list[Any]:
    """The equations; the car's values may be numbers or symbols."""
    tyres = car.true_tyres
    if isinstance(tyres, LinearTyres):
        return [*_pose_rates(x), *_linear_rates(car, tyres, x, u), u[1]]
    return [*_pose_rates(x), *_pacejka_rates(car, tyres, x, u), u[1]]


def _pacejka_rates(car: Car, tyres: PacejkaTyres, x: Any, u: Any) -> list[Any]:
    """Of vx, vy, omega."""
    vx, vy, omega, delta = x[3], x[4], x[5], x[6]
    alpha_f, alpha_r = _slip_angles(car, x)
    f_front, f_rear = _lateral_force(tyres.front, alpha_f), _lateral_force(tyres.rear, alpha_r)
    f_drive = longitudinal_force(car, vx, u[0])
    m = car.mass_kg
    return [
        (f_drive - f_front * ca.sin(delta) + m * vy * omega) / m,
        (f_rear + f_front * ca.cos(delta) - m * vx * omega) / m,
        (f_front * car.lf_m * ca.cos(delta) - f_rear * car.lr_m) / car.inertia_kgm2,
    ]


def _linear_rates(car: Car, tyres: LinearTyres, x: Any, u: Any) -> list[Any]:
    """Of vx, vy, omega: CommonRoad's single-track model, kinematic at low speed.

    Above ``switch_mps`` these are its equations for v = |(vx, vy)| and beta = atan2(vy, vx) by the
    chain rule, below half of it those of the kinematic model; in between the share of the former
    grows twice continuously differentiably.
    """
    a = longitudinal_force(car, x[3], u[0]) / car.mass_kg
    low = tyres.switch_mps / 2
    squared = x[3] ** 2 + x[4] ** 2
    share = _smooth_step((squared - low**2) / (3 * low**2))
    moving = squared > low**2
    fast = _single_track_rates(
        car, tyres, ca.if_else(moving, x[3], low), ca.if_else(moving, x[4], 0), x, a
    )
    slow = _rolling_rates(car, tyres, x, u[1], a)
    return [share * one + (1 - share) * other for one, other in zip(fast, slow, strict=True)]


def _single_track_rates(
    car: Car, tyres: LinearTyres, vx: Any, vy: Any, x: Any, a: Any
) -> list[Any]:
    """Of vx, vy, omega on linear tyres; ``a`` [m/s^2] is along the velocity.

    Beyond 60 degrees of slip, where CommonRoad's equations mean nothing, ``a`` turns round towards
    that of a car that slides backwards: throttle slows it.
    """
    omega, delta = x[5], x[6]
    lf, lr, wheelbase = car.lf_m, car.lr_m, car.wheelbase_m
    v, beta = ca.sqrt(vx**2 + vy**2), ca.atan2(vy, vx)
    along = a * (1 - 2 * _smooth_step((0.5 - vx / v) / 1.5))
    front = tyres.front_stiffness * (GRAVITY_MPS2 * lr - a * tyres.height_m)
    rear = tyres.rear_stiffness * (GRAVITY_MPS2 * lf + a * tyres.height_m)
    turn = lr * rear - lf * front
    beta_rate = (
        (tyres.mu / (v**2 * wheelbase) * turn - 1) * omega
        - tyres.mu / (v * wheelbase) * (rear + front) * beta
        + tyres.mu / (v * wheelbase) * front * delta
    )
    damping = (lf**2 * front + lr**2 * rear) / v
    inertia: Any = car.inertia_kgm2  # known, or a symbol
    stiffness = tyres.mu * car.mass_kg / (inertia * wheelbase)
    return [
        along * vx / v - vy * beta_rate,
        along * vy / v + vx * beta_rate,
        stiffness * (lf * front * delta + turn * beta - damping * omega),
    ]


def _rolling_rates(car: Car, tyres: LinearTyres, x: Any, delta_rate: Any, a: Any) -> list[Any]:
    """Of vx, vy, omega of a car that rolls without slip; ``a`` is along the velocity.

    What slip there is fades as fast as it does on the tyres at ``switch_mps``.
    """
    vx, vy, omega, delta = x[3], x[4], x[5], x[6]
    share, slope = car.lr_m / car.wheelbase_m, ca.tan(delta)
    slope_rate = (1 + slope**2) * delta_rate
    aside = share * slope  # tan(beta)
    beta_rate = share * slope_rate / (1 + aside**2)
    vx_rate = a / ca.sqrt(1 + aside**2) - vx * aside * beta_rate
    turn, turn_rate = vx * slope, vx_rate * slope + vx * slope_rate
    fading = (tyres.rear_stiffness * car.lf_m + tyres.front_stiffness * car.lr_m) * (
        tyres.mu * GRAVITY_MPS2 / (tyres.switch_mps * car.wheelbase_m)
    )
    return [
        vx_rate,
        share * turn_rate - fading * (vy - share * turn),
        (turn_rate / car.wheelbase_m) - fading * (omega - turn / car.wheelbase_m),
    ]


def e_kinematic(car: Car) -> Model:
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


def kinematic(car: Car) -> Model:
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


MODELS: Final[dict[str, Callable[[Car], Model]]] = {
    "dynamic": dynamic,
    "e_kinematic": e_kinematic,
    "kinematic": kinematic,
}
