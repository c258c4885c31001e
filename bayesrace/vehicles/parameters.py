"""Cars as data: geometry, mass, drive, tyres, actuator limits and tuning, SI units.

What a driver can measure (geometry, mass, motor, one friction number) and what only system
identification gives (tyre curves, yaw inertia) live in one object but are used by different models:
the e-kinematic model and the racing line read the former only, the dynamic model reads all.

A car is a TOML file, see :mod:`.files`; this module is the form that all parts use.
"""

import hashlib
from collections.abc import Mapping
from typing import Any, Final

from pydantic import Field, ValidationInfo, field_validator
from pydantic_core import to_json

from bayesrace.errors import InputError
from bayesrace.vehicles.parts import GRAVITY_MPS2, Drive, LinearTyres, Part, Tyres
from bayesrace.vehicles.tuning import (
    REFERENCE_ACCELERATION_MPS2,
    REFERENCE_WHEELBASE_M,
    Scales,
    Tuning,
    scaled,
)

__all__ = ["ACTUATORS", "BODY", "CarParameters"]

BODY: Final = ("lf_m", "lr_m", "mass_kg", "inertia_kgm2")
ACTUATORS: Final = ("d_min", "d_max", "delta_max_rad", "delta_rate_max_radps")
"""Limits of the inputs and of the steering angle."""

_BRAKE_FADE_MPS: Final = 0.1
"""Of the reference car."""


def _scales(known: Mapping[str, Any]) -> Scales:
    """Of a car whose valid fields these are; those of the reference car if it has faults."""
    try:
        wheelbase_m = known["lf_m"] + known["lr_m"]
        acceleration_mps2 = known["friction"] * GRAVITY_MPS2
        command = known["drive"].command_size(acceleration_mps2)
    except KeyError:
        return Scales()
    return Scales(
        wheelbase_m / REFERENCE_WHEELBASE_M,
        acceleration_mps2 / REFERENCE_ACCELERATION_MPS2,
        command,
    )


class CarParameters(Part):
    """One car; symbols as in docs/equations.md."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9_-]{1,40}$", description="in message keys: letters, digits, '-', '_'"
    )
    lf_m: float = Field(gt=0, description="centre of gravity to front axle [m]")
    lr_m: float = Field(gt=0, description="centre of gravity to rear axle [m]")
    mass_kg: float = Field(gt=0, description="mass [kg]")
    inertia_kgm2: float = Field(gt=0, description="yaw moment of inertia Iz [kg m^2]")
    tyres: Tyres = Field(description="the tyres, by their model")
    drive: Drive = Field(description="the drive, by its model")
    d_min: float = Field(lt=0, description="lowest drive command, which brakes [command]")
    d_max: float = Field(gt=0, description="highest drive command [command]")
    delta_max_rad: float = Field(gt=0, description="steering angle limit, both sides [rad]")
    delta_rate_max_radps: float = Field(gt=0, description="steering rate limit, both sides [rad/s]")
    friction: float = Field(
        gt=0,
        le=5,
        description="one measured number: usable horizontal acceleration over gravity [-]",
    )
    width_m: float = Field(gt=0, description="width of the outline [m]")
    length_m: float = Field(gt=0, description="length of the outline [m]")
    mirrored_samples: bool = Field(
        False,
        strict=True,
        description="whether the mirror image of each sample is learned from, too: for a car that "
        "turns left as it turns right and whose whole state is measured [-]",
    )
    brake_fade_mps: float = Field(
        default_factory=lambda known: scaled(_BRAKE_FADE_MPS, "m/s", _scales(known)),
        gt=0,
        description="below this speed braking fades linearly to none, so that a car stops and "
        "stays: brakes do not drive a car back [m/s]",
    )
    train_track: str = Field(
        "paddock", min_length=1, description="track of training drives where none is named [-]"
    )
    race_track: str = Field(
        "harbour", min_length=1, description="track of races where none is named [-]"
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

    @property
    def equation_numbers(self) -> dict[str, float]:
        """What the dynamic model depends on, by flat name; ``front_b`` is ``tyres.front.b``."""
        drive = {} if self.drive.guarded else self.drive.numbers()
        return {name: float(getattr(self, name)) for name in BODY} | self.tyres.numbers() | drive

    @property
    def guard_numbers(self) -> dict[str, float]:
        """What the plant's guard depends on, by name."""
        drive = self.drive.numbers() if self.drive.guarded else {}
        return {name: float(getattr(self, name)) for name in ACTUATORS} | drive

    @property
    def brake_numbers(self) -> dict[str, float]:
        """How a car is braked without a controller, its steering held.

        Drive command: -(brake_d + brake_slow / vx^2), but not below d_min, and fading to none below
        brake_fade_mps. The tyres give the first two: a car that brakes harder may spin.
        """
        command = self.drive.command_for(1.0, self.mass_kg)
        steady, slow = self.tyres.steady_braking(self.lf_m, self.lr_m, -self.d_min / command)
        return {
            "brake_fade_mps": self.brake_fade_mps,
            "brake_d": steady * command,
            "brake_slow": slow * command,
        }

    def on_tyres(self, model: str) -> "CarParameters":
        """The same car on tyres of this model: its own, or saturating ones in place of linear ones.

        InputError for linear tyres in place of others.
        """
        if self.tyres.model == model:
            return self
        if not isinstance(self.tyres, LinearTyres):
            raise InputError(
                f"the car '{self.name}' has {self.tyres.model} tyres: write a car's file with the "
                f"numbers of {model} ones"
            )
        tyres = self.tyres.saturating(self.lf_m, self.lr_m, self.mass_kg)
        return self.model_copy(update={"tyres": tyres})

    def digest(self) -> str:
        """Short identity of the values that shape the models (not name, outline, grip, tuning)."""
        shape: dict[str, Any] = {name: getattr(self, name) for name in BODY}
        for part in (self.tyres, self.drive):
            shape |= part.model_dump(exclude={"model"})
        shape |= {name: getattr(self, name) for name in ACTUATORS}
        return hashlib.sha256(to_json(shape)).hexdigest()[:12]

    @property
    def identity(self) -> str:
        """Name and digest, as weights, manifests and racing lines name a car."""
        return f"{self.name}-{self.digest()}"
