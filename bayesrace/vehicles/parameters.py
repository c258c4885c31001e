"""Cars as data: geometry, mass, drive, tyres and actuator limits, SI units.

What a driver can measure (geometry, mass, motor, one friction number) and what only system
identification gives (tyre curves, yaw inertia) live in one object but are used by different models:
the e-kinematic model and the racing line read the former only, the dynamic model reads all.
"""

import hashlib
from typing import Final

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.errors import InputError

__all__ = ["BRAKE_FADE_MPS", "CARS", "CarParameters", "Pacejka", "get_car"]

GRAVITY_MPS2: Final = 9.81

BRAKE_FADE_MPS: Final = 0.1
"""Below this speed braking fades linearly to none, so that a car stops and stays: brakes do not
drive a car back."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Pacejka(_Frozen):
    """Lateral tyre force F = D sin(C atan(B alpha)), paper table 1."""

    b: float = Field(gt=0, description="stiffness factor B [1/rad]")
    c: float = Field(gt=0, description="shape factor C [-]")
    d: float = Field(gt=0, description="peak force D [N]")


class CarParameters(_Frozen):
    """One car; symbols as in docs/equations.md."""

    name: str
    lf_m: float = Field(gt=0, description="centre of gravity to front axle")
    lr_m: float = Field(gt=0, description="centre of gravity to rear axle")
    mass_kg: float = Field(gt=0, description="mass")
    inertia_kgm2: float = Field(gt=0, description="yaw moment of inertia Iz")
    front: Pacejka
    rear: Pacejka
    cm1: float = Field(gt=0, description="motor force per duty cycle at standstill [N]")
    cm2: float = Field(ge=0, description="motor back-EMF coefficient [N s/m]")
    cr0: float = Field(ge=0, description="rolling resistance [N]")
    cr2: float = Field(ge=0, description="drag coefficient Cd [N s^2/m^2]")
    d_min: float = Field(lt=0, description="lowest duty cycle (brake) [-]")
    d_max: float = Field(gt=0, description="highest duty cycle [-]")
    delta_max_rad: float = Field(gt=0, description="steering angle limit, both sides")
    delta_rate_max_radps: float = Field(gt=0, description="steering rate limit, both sides")
    friction: float = Field(
        gt=0, description="one measured number: usable horizontal acceleration over gravity"
    )
    width_m: float = Field(gt=0)
    length_m: float = Field(gt=0)

    @property
    def wheelbase_m(self) -> float:
        """Distance between the axles, lf + lr."""
        return self.lf_m + self.lr_m

    def digest(self) -> str:
        """Short identity of the values that shape the models (not the name or the outline)."""
        shape = self.model_dump_json(exclude={"name", "friction", "width_m", "length_m"})
        return hashlib.sha256(shape.encode()).hexdigest()[:12]


# ORCA 1:43: Liniger, Domahidi, Morari, "Optimization-based autonomous racing of 1:43 scale RC
# cars", 2015, with the paper's actuator limits. `friction` is the lateral acceleration over g that
# the car holds on a circle with steering in reserve (benchmarks/skid_pad.py: .751 at 70 % of the
# steering range, .773 at full lock).
_ORCA: Final = CarParameters(
    name="orca",
    lf_m=0.029,
    lr_m=0.033,
    mass_kg=0.041,
    inertia_kgm2=27.8e-6,
    front=Pacejka(b=2.579, c=1.2, d=0.192),
    rear=Pacejka(b=3.3852, c=1.2691, d=0.1737),
    cm1=0.287,
    cm2=0.0545,
    cr0=0.0518,
    cr2=0.00035,
    d_min=-0.1,
    d_max=1.0,
    delta_max_rad=0.35,
    delta_rate_max_radps=5.0,
    friction=0.75,
    width_m=0.05,
    length_m=0.1,
)

CARS: Final = {car.name: car for car in (_ORCA,)}


def get_car(name: str) -> CarParameters:
    """The built-in car called ``name``; raises InputError naming those there are."""
    try:
        return CARS[name]
    except KeyError:
        raise InputError(f"unknown car '{name}'; known: {', '.join(sorted(CARS))}") from None
