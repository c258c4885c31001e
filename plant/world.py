"""What changes while a simulated car drives: grip that falls in a bend or with the time, a payload,
a motor that gets weak. ``--world FILE`` names a TOML file of sections ``[[world]]``.

No controller knows of it: weights, racing line and BestCase are those of the car in its file.
"""

import hashlib
import json
from pathlib import Path
from typing import Annotated, Final, Literal, Self, get_args

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    RootModel,
    model_validator,
)

from bayesrace.defaults import Option
from bayesrace.errors import InputError
from bayesrace.files import read_form, write_whole
from bayesrace.strict import StrictModel
from bayesrace.vehicles import Car
from bayesrace.vehicles.parts import DcMotor

__all__ = ["NONE", "UNCHANGED", "Change", "World", "WorldSetting", "changed_car", "get_world"]
__all__ += ["write_world"]

What = Literal["grip", "mass", "motor"]

_WHATS: Final[tuple[What, ...]] = get_args(What)


class Change(StrictModel):
    """One change: of what, by how much, when and where. Changes of the same are multiplied."""

    what: What = Field(description="grip (tyre forces), mass, or motor (its force)")
    share: float = Field(ge=0.05, le=5, description="of what it was [-]")
    from_s: float = Field(0.0, ge=0, le=1e6, description="time of the run at which it begins [s]")
    over_s: float = Field(
        0.0, ge=0, le=1e6, description="how long it grows until it is whole [s]; 0: at once"
    )
    until_s: float = Field(1e6, gt=0, le=1e6, description="time at which it ends [s]")
    x_m: float | None = Field(
        None, ge=-1e4, le=1e4, description="middle of the place that it is limited to [m]"
    )
    y_m: float | None = Field(None, ge=-1e4, le=1e4, description="the same across [m]")
    radius_m: float | None = Field(None, gt=0, le=1e4, description="radius of this place [m]")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        place = [self.x_m, self.y_m, self.radius_m]
        if any(one is None for one in place) and any(one is not None for one in place):
            raise ValueError("a place takes x_m, y_m and radius_m: give all three, or none")
        if self.until_s <= self.from_s:
            raise ValueError(
                f"until_s {self.until_s:g} is not after from_s {self.from_s:g}: it would never be"
            )
        return self

    def share_at(self, time_s: float, x_m: float, y_m: float) -> float:
        """Of what it was, at this time of the run and this place; 1: no change."""
        if not self.from_s <= time_s < self.until_s:
            return 1.0
        if not self._covers(x_m, y_m):
            return 1.0
        grown = (time_s - self.from_s) / self.over_s if self.over_s else 1.0
        return 1 + min(grown, 1.0) * (self.share - 1)

    def _covers(self, x_m: float, y_m: float) -> bool:
        if self.x_m is None or self.y_m is None or self.radius_m is None:
            return True
        return (x_m - self.x_m) ** 2 + (y_m - self.y_m) ** 2 <= self.radius_m**2


class World(RootModel[tuple[Change, ...]]):
    """All changes of a run; none: the car stays as it is."""

    model_config = ConfigDict(frozen=True)

    root: tuple[Change, ...] = Field((), max_length=100)

    def __hash__(self) -> int:
        return hash(self.root)

    @property
    def label(self) -> str:
        """What changes, with a digest of all values; empty: nothing does."""
        if not self.root:
            return ""
        whats = "+".join(dict.fromkeys(one.what for one in self.root))
        return f"{whats} ({hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:6]})"

    def shares(self, time_s: float, x_m: float, y_m: float) -> tuple[float, ...]:
        """Of grip, mass and motor, at this time of the run and this place."""
        products = dict.fromkeys(_WHATS, 1.0)
        for one in self.root:
            products[one.what] *= one.share_at(time_s, x_m, y_m)
        return tuple(products.values())

    def check(self, car: Car) -> None:
        """InputError if this car has no motor whose force could change."""
        if any(one.what == "motor" for one in self.root) and not isinstance(car.drive, DcMotor):
            raise InputError(
                f"world: {car.name} is driven by an acceleration, not by a motor; leave out the "
                "changes of its motor"
            )


UNCHANGED: Final = World(())

NONE: Final = "none"
"""In place of a file, where one has to be named."""


def changed_car(car: Car, shares: tuple[float, ...]) -> Car:
    """The car with these shares of its grip, mass and motor."""
    grip, mass, motor = shares
    drive = car.drive
    if isinstance(drive, DcMotor):
        force = {"cm1": motor * drive.cm1, "cm2": motor * drive.cm2}
        drive = drive.model_copy(update=force)
    tyres = car.true_tyres.with_grip(grip)
    return car.model_copy(update={"tyres": tyres, "mass_kg": mass * car.mass_kg, "drive": drive})


class _File(StrictModel):
    world: World


def get_world(path: str | Path) -> World:
    """What a TOML file says; ``none``: nothing changes. InputError where it cannot be used."""
    if str(path) == NONE:
        return UNCHANGED
    return read_form(Path(path), "the world", "docs/world.md shows one", _File).world


def write_world(path: Path, world: World) -> None:
    """As :func:`get_world` reads it."""
    lines = list[str]()
    for one in world.root:
        lines.append("[[world]]")
        for name, value in one.model_dump(exclude_defaults=True).items():
            lines.append(f"{name} = {json.dumps(value)}")
    write_whole(path, "\n".join(lines) + "\n")


WorldSetting = Annotated[
    World | None,
    BeforeValidator(lambda one: get_world(one) if isinstance(one, str | Path) else one),
    Option(metavar="FILE"),
    Field(
        description="what changes while the simulated car drives: grip, mass, motor, by time and "
        "place (TOML, docs/world.md); no controller knows of it, and training drives are without"
    ),
]
"""Field of settings that accepts a file and holds what it says."""
