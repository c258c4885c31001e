"""Cars as data: geometry, mass, drive, tyres, actuator limits and tuning, SI units.

What a driver can measure (geometry, mass, motor, one friction number) and what only system
identification gives (tyre curves, yaw inertia) live in one object but are used by different models:
the e-kinematic model and the racing line read the former only, the dynamic model reads all.

A car is a TOML file, see :mod:`.files`; this module is the form that all parts use.
"""

import hashlib
from collections.abc import Mapping
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from bayesrace.vehicles.tuning import (
    GRAVITY_MPS2,
    REFERENCE_ACCELERATION_MPS2,
    REFERENCE_WHEELBASE_M,
    SPEED,
    Scales,
    Tuning,
    scaled,
)

__all__ = ["GRAVITY_MPS2", "CarParameters", "Pacejka"]

_BRAKE_FADE_MPS: Final = 0.1
"""Of the reference car."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Pacejka(_Frozen):
    """Lateral tyre force F = D sin(C atan(B alpha)), paper table 1."""

    b: float = Field(gt=0, description="stiffness factor B [1/rad]")
    c: float = Field(gt=0, description="shape factor C [-]")
    d: float = Field(gt=0, description="peak force D [N]")


def _scales(known: Mapping[str, Any]) -> Scales:
    """Of a car whose valid fields these are; those of the reference car if it has faults."""
    try:
        wheelbase_m = known["lf_m"] + known["lr_m"]
        acceleration_mps2 = known["friction"] * GRAVITY_MPS2
    except KeyError:
        return 1.0, 1.0
    return wheelbase_m / REFERENCE_WHEELBASE_M, acceleration_mps2 / REFERENCE_ACCELERATION_MPS2


class CarParameters(_Frozen):
    """One car; symbols as in docs/equations.md."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9_-]{1,40}$", description="in message keys: letters, digits, '-', '_'"
    )
    lf_m: float = Field(gt=0, description="centre of gravity to front axle [m]")
    lr_m: float = Field(gt=0, description="centre of gravity to rear axle [m]")
    mass_kg: float = Field(gt=0, description="mass [kg]")
    inertia_kgm2: float = Field(gt=0, description="yaw moment of inertia Iz [kg m^2]")
    front: Pacejka = Field(description="lateral force of the front tyres together")
    rear: Pacejka = Field(description="lateral force of the rear tyres together")
    cm1: float = Field(gt=0, description="motor force per duty cycle at standstill [N]")
    cm2: float = Field(ge=0, description="motor back-EMF coefficient [N s/m]")
    cr0: float = Field(ge=0, description="rolling resistance [N]")
    cr2: float = Field(ge=0, description="drag coefficient Cd [N s^2/m^2]")
    d_min: float = Field(lt=0, description="lowest duty cycle (brake) [-]")
    d_max: float = Field(gt=0, description="highest duty cycle [-]")
    delta_max_rad: float = Field(gt=0, description="steering angle limit, both sides [rad]")
    delta_rate_max_radps: float = Field(gt=0, description="steering rate limit, both sides [rad/s]")
    friction: float = Field(
        gt=0,
        le=5,
        description="one measured number: usable horizontal acceleration over gravity [-]",
    )
    width_m: float = Field(gt=0, description="width of the outline [m]")
    length_m: float = Field(gt=0, description="length of the outline [m]")
    brake_fade_mps: float = Field(
        default_factory=lambda known: scaled(_BRAKE_FADE_MPS, SPEED, _scales(known)),
        gt=0,
        description="below this speed braking fades linearly to none, so that a car stops and "
        "stays: brakes do not drive a car back [m/s]",
    )
    tuning: Tuning = Field(
        default_factory=dict,
        validate_default=True,
        description="numbers that depend on the car's size, derived where they are not given",
    )

    @field_validator("tuning", mode="before")
    @classmethod
    def _complete(cls, value: Any, info: ValidationInfo) -> Any:
        return Tuning.completed(value, _scales(info.data)) if isinstance(value, dict) else value

    @property
    def wheelbase_m(self) -> float:
        """Distance between the axles, lf + lr."""
        return self.lf_m + self.lr_m

    def digest(self) -> str:
        """Short identity of the values that shape the models (not name, outline, grip, tuning)."""
        apart = {"name", "friction", "width_m", "length_m", "brake_fade_mps", "tuning"}
        shape = self.model_dump_json(exclude=apart)
        return hashlib.sha256(shape.encode()).hexdigest()[:12]

    @property
    def identity(self) -> str:
        """Name and digest, as weights, manifests and racing lines name a car."""
        return f"{self.name}-{self.digest()}"
