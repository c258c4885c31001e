"""The tyres and the drives that a car can have; a car's file says which by their ``model``.

A drive turns the first input, the drive command d, into a force along the car. What the command
is (its name and its unit), and how much of it there is at a speed, are the drive's.
"""

import math
from typing import Annotated, ClassVar, Final, Literal

from pydantic import Field

from bayesrace.strict import StrictModel

__all__ = [
    "GRAVITY_MPS2",
    "AccelerationDrive",
    "DcMotor",
    "Drive",
    "LinearTyres",
    "Pacejka",
    "PacejkaTyres",
    "Part",
    "Tyres",
]

GRAVITY_MPS2: Final = 9.81

_SHAPE: Final = 1.9
_PEAK: Final = 1.0489
"""Pacejka's C, and the friction, of tyres that saturate in place of linear ones: the friction of
f1tenth_gym. The mu of linear tyres is a factor of their stiffness alone."""

_ANY_MPS2: Final = 1e3
"""Braking beyond that of any car."""


class Part(StrictModel):
    """Part of a car: immutable, without unknown values."""

    def numbers(self) -> dict[str, float]:
        """All its numbers by flat name: ``front_b`` is ``front.b``."""
        flat: dict[str, float] = {}
        for name, value in self:
            if isinstance(value, Part):
                flat |= {f"{name}_{inner}": one for inner, one in value.numbers().items()}
            elif name != "model":
                flat[name] = float(value)
        return flat


class Pacejka(Part):
    """Lateral tyre force F = D sin(C atan(B alpha)), paper table 1."""

    b: float = Field(gt=0, description="stiffness factor B [1/rad]")
    c: float = Field(gt=0, description="shape factor C [-]")
    d: float = Field(gt=0, description="peak force D [N]")


class PacejkaTyres(Part):
    """Tyres that saturate."""

    model: Literal["pacejka"]
    front: Pacejka = Field(description="lateral force of the front tyres together")
    rear: Pacejka = Field(description="lateral force of the rear tyres together")

    def with_grip(self, multiple: float) -> "PacejkaTyres":
        """The same tyres with so many times the force."""
        front, rear = (
            tyre.model_copy(update={"d": multiple * tyre.d}) for tyre in (self.front, self.rear)
        )
        return self.model_copy(update={"front": front, "rear": rear})

    def steady_braking(self, lf_m: float, lr_m: float, hardest_mps2: float) -> tuple[float, float]:
        """Any: braking moves no load; see :meth:`LinearTyres.steady_braking`."""
        return _ANY_MPS2, 0.0


class LinearTyres(Part):
    """Tyres of CommonRoad's single-track model: F = mu C_S F_z alpha, with load transfer.

    They never saturate. Althoff and Würsching, "CommonRoad: Vehicle Models", 2020, equation (9).
    """

    model: Literal["linear"]
    front_stiffness: float = Field(gt=0, description="cornering stiffness C_S, front [1/rad]")
    rear_stiffness: float = Field(gt=0, description="cornering stiffness C_S, rear [1/rad]")
    mu: float = Field(gt=0, le=5, description="friction coefficient of the tyres [-]")
    height_m: float = Field(
        ge=0, description="height of the centre of gravity: accelerating moves load rearwards [m]"
    )
    switch_mps: float = Field(
        gt=0,
        description="the tyres' forces act above this speed; below half of it the car rolls "
        "without slip, in between the two pass into one another [m/s]",
    )

    def with_grip(self, multiple: float) -> "LinearTyres":
        """The same tyres with so many times the force."""
        return self.model_copy(update={"mu": multiple * self.mu})

    def steady_braking(self, lf_m: float, lr_m: float, hardest_mps2: float) -> tuple[float, float]:
        """Braking that leaves a car stable with its steering held.

        (b, c): up to b + c / v^2 [m/s^2] at a speed v. Beyond b, so much load is on the front axle
        that the car oversteers; it is still stable below its critical speed,
        v^2 < mu L C_f C_r / (lf C_f - lr C_r) with the stiffness C = C_S F_z / m of the axles. Of
        all braking up to ``hardest_mps2`` the least product C_f C_r gives c. Any, where the height
        is zero, or where the car oversteers at rest, which no braking mends.
        """
        front, rear = self.front_stiffness, self.rear_stiffness
        balance = GRAVITY_MPS2 * lf_m * lr_m * (rear - front)  # lr C_r - lf C_f at rest
        moved = self.height_m * (lr_m * rear + lf_m * front)  # what braking takes off it
        if moved <= 0 or balance <= 0:
            return _ANY_MPS2, 0.0

        def product(braking: float) -> float:
            load = self.height_m * braking
            unloaded = max(GRAVITY_MPS2 * lf_m - load, 0.0)
            return front * (GRAVITY_MPS2 * lr_m + load) * rear * unloaded

        neutral = balance / moved
        least = min(product(neutral), product(max(hardest_mps2, neutral)))
        return neutral, self.mu * (lf_m + lr_m) * least / moved

    def saturating(self, lf_m: float, lr_m: float, mass_kg: float) -> PacejkaTyres:
        """Pacejka tyres of the same cornering stiffness at rest, with a peak."""
        load_n = mass_kg * GRAVITY_MPS2 / (lf_m + lr_m)

        def axle(stiffness: float, share_m: float) -> Pacejka:
            return Pacejka(
                b=self.mu * stiffness / (_SHAPE * _PEAK), c=_SHAPE, d=_PEAK * load_n * share_m
            )

        front, rear = axle(self.front_stiffness, lr_m), axle(self.rear_stiffness, lf_m)
        return PacejkaTyres(model="pacejka", front=front, rear=rear)


class DcMotor(Part):
    """Motor driven by a duty cycle, with rolling resistance and drag; section 3 of the paper."""

    command: ClassVar[str] = "duty cycle"
    unit: ClassVar[str] = "1"
    unit_per_square: ClassVar[str] = "1"
    guarded: ClassVar[bool] = False
    """Whether its numbers are limits of the plant's guard, and not in the equations."""

    model: Literal["dc_motor"]
    cm1: float = Field(gt=0, description="motor force per duty cycle at standstill [N]")
    cm2: float = Field(ge=0, description="motor back-EMF coefficient [N s/m]")
    cr0: float = Field(ge=0, description="rolling resistance [N]")
    cr2: float = Field(ge=0, description="drag coefficient Cd [N s^2/m^2]")

    def command_size(self, acceleration_mps2: float) -> float:
        """Commands of this car as multiples of the reference car's: both are duty cycles."""
        return 1.0

    def command_for(self, acceleration_mps2: float, mass_kg: float) -> float:
        """Command that accelerates by so much at standstill; at speed it does less."""
        return mass_kg * acceleration_mps2 / self.cm1

    def available(self, vx_mps: float, vy_mps: float) -> float:
        """Share of the highest command that the drive gives at a velocity: all of it."""
        return 1.0

    def braking(self, vx_mps: float, d_min: float, duration_s: float) -> float:
        """Lowest command that acts: its rolling resistance keeps a braking car from reversing."""
        return d_min

    def command_at(self, vx_mps: float, acceleration_mps2: float, mass_kg: float) -> float:
        """Duty cycle that about gives an acceleration at a speed, resistances included."""
        force = mass_kg * acceleration_mps2 + self.cr0 + self.cr2 * vx_mps * vx_mps
        return force / max(self.cm1 - self.cm2 * vx_mps, 0.1 * self.cm1)

    def top_speed_mps(self, d_max: float) -> float:
        """Where drive and resistance are equal: (cm1 - cm2 v) d_max = cr0 + cr2 v^2."""
        import numpy as np  # takes longer than to read a car

        a, b, c = self.cr2, self.cm2 * d_max, self.cr0 - self.cm1 * d_max
        roots = np.roots([a, b, c]) if a else np.array([-c / b])
        return max((float(v.real) for v in roots if abs(v.imag) < 1e-9 < v.real), default=1.0)


class AccelerationDrive(Part):
    """Drive whose own controller follows an acceleration, as the single-track model assumes.

    Above a speed its power limits it; it does not drive the car backwards.
    """

    command: ClassVar[str] = "acceleration"
    unit: ClassVar[str] = "m/s2"
    unit_per_square: ClassVar[str] = "s4/m2"
    guarded: ClassVar[bool] = True

    model: Literal["acceleration"]
    power_speed_mps: float = Field(
        gt=0, description="v_switch: above this speed d_max falls with 1/v, at constant power [m/s]"
    )
    speed_max_mps: float = Field(
        gt=0, description="top speed; the drive fades to none over the last 5 % before it [m/s]"
    )

    def command_size(self, acceleration_mps2: float) -> float:
        """Commands of this car as multiples of the reference car's duty cycle."""
        return acceleration_mps2

    def command_for(self, acceleration_mps2: float, mass_kg: float) -> float:
        """Command that accelerates by so much: the acceleration."""
        return acceleration_mps2

    def available(self, vx_mps: float, vy_mps: float) -> float:
        """Share of the highest acceleration that there is at a velocity."""
        v = math.sqrt(vx_mps * vx_mps + vy_mps * vy_mps)
        fade = (self.speed_max_mps - v) / (0.05 * self.speed_max_mps)
        return self.power_speed_mps / max(v, self.power_speed_mps) * min(max(fade, 0.0), 1.0)

    def braking(self, vx_mps: float, d_min: float, duration_s: float) -> float:
        """Lowest acceleration that acts for so long: it stops a car and does not reverse it."""
        return max(d_min, -max(vx_mps, 0.0) / duration_s)

    def command_at(self, vx_mps: float, acceleration_mps2: float, mass_kg: float) -> float:
        """Command that gives an acceleration at a speed: the acceleration."""
        return acceleration_mps2

    def top_speed_mps(self, d_max: float) -> float:
        """That of the drive."""
        return self.speed_max_mps


Tyres = Annotated[PacejkaTyres | LinearTyres, Field(discriminator="model")]
Drive = Annotated[DcMotor | AccelerationDrive, Field(discriminator="model")]
