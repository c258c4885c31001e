"""The map file: TOML that says which of an FMU's variables mean what.

``ours = sign * scale * theirs + offset`` for outputs, ``theirs = sign * scale * ours + offset``
for inputs and start values; the scale follows from the unit unless it is given.
"""

import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainValidator,
    Tag,
    ValidationError,
    model_validator,
)

from bayesrace.errors import InputError
from bayesrace.files import read_text

__all__ = [
    "Derive",
    "Driven",
    "FmuMap",
    "FmuSection",
    "Pick",
    "Value",
    "parse_map",
    "read_map",
]


def _plain(value: Any) -> Any:
    if isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise ValueError("give a finite number, true, false or a text")


Value = Annotated[bool | int | float | str, PlainValidator(_plain)]


def _of_one(sign: float) -> float:
    if sign in (1.0, -1.0):
        return sign
    raise ValueError("sign is 1 or -1; a factor is `scale`")


Sign = Annotated[float, AfterValidator(_of_one)]


class _Section(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True
    )

    def _given(self) -> set[str]:
        """Names of the variables that are given."""
        return {name for name, value in self if isinstance(value, Pick | _Quaternion)}


class _Affine(_Section):
    unit: str | None = Field(None, description="the FMU variable's unit; default: as it declares")
    sign: Sign = Field(1.0, description="-1: positive the other way round")
    scale: float | None = Field(None, description="factor in place of the unit's")
    offset: float | str = Field(
        0.0, description="added after scaling, in the unit of the result, or with one: '90 deg'"
    )

    @model_validator(mode="after")
    def _one_conversion(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale is 0, which loses the value")
        if self.scale is not None and self.unit is not None:
            raise ValueError(
                "unit and scale both convert: give one of them (the other way round: sign = -1)"
            )
        return self


class Pick(_Affine):
    """One of the FMU's variables, as a quantity of ours."""

    variable: str


class Driven(_Affine):
    """The quantity of ours that sets one of the FMU's variables."""

    source: str = Field(alias="from")

    @classmethod
    def of(cls, entry: object, sources: Mapping[str, str]) -> Self | None:
        """The entry with its quantity, in short too (``gas = "throttle"``); None: a constant."""
        if isinstance(entry, cls):
            return entry
        return cls(source=entry) if isinstance(entry, str) and entry in sources else None


def _picked(entry: Any) -> Any:
    if isinstance(entry, str):
        return {"variable": entry}
    if not isinstance(entry, dict | Pick):
        raise ValueError('give the name of a variable of the FMU, or { variable = "name", … }')
    return entry


def _form(entry: Any) -> str:
    return "table" if isinstance(entry, dict | Driven) else "value"


Setting = Annotated[
    Annotated[Driven, Tag("table")] | Annotated[Value, Tag("value")], Discriminator(_form)
]
Picked = Annotated[Pick, BeforeValidator(_picked)]


class FmuSection(_Section):
    """[fmu]: how the FMU is run."""

    step_s: float | None = Field(None, gt=0, description="communication step; must divide a period")
    timeout_s: float = Field(2.0, gt=0, description="an FMU that takes longer for a step hangs")
    startup_s: float = Field(
        8.0, gt=0, description="the same for loading it, and for each initialisation"
    )
    placed: bool = Field(
        False, description="move the FMU's world so that its own start is the asked start pose"
    )


class _Quaternion(_Section):
    w: Picked
    x: Picked
    y: Picked
    z: Picked


class _Heading(_Section):
    quaternion: _Quaternion | None = Field(None, description="rotation body → world")
    cos: Picked | None = None
    sin: Picked | None = None
    sign: Sign = 1.0
    offset: float | str = 0.0

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self._given() in ({"quaternion"}, {"cos", "sin"}):
            return self
        raise ValueError("give either quaternion = { w, x, y, z }, or cos and sin")


class _Velocity(_Section):
    world_x: Picked | None = None
    world_y: Picked | None = None
    speed: Picked | None = None
    slip: Picked | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self._given() in ({"world_x", "world_y"}, {"speed"}, {"speed", "slip"}):
            return self
        raise ValueError(
            "give either world_x and world_y, or speed (and slip; without it the car is taken to "
            "move where it points)"
        )


class Derive(_Section):
    """[derive]: quantities that the FMU does not give and that follow from others."""

    psi: _Heading | None = None
    velocity: _Velocity | None = None
    omega: Literal["psi"] | None = None
    delta: Literal["delta_rate"] | None = None

    def derived(self) -> set[str]:
        """The quantities of [outputs] that follow from others."""
        rules = {name for name, rule in self if rule is not None}
        return rules - {"velocity"} | ({"vx", "vy"} if "velocity" in rules else set())

    def picks(self) -> Iterator[tuple[str, str, Pick]]:
        """Each variable that the rules read, with its quantity and its place in the map."""
        quaternion = self.psi.quaternion if self.psi else None
        for place, prefix, rule in (
            ("psi", "", self.psi),
            ("psi.quaternion", "q", quaternion),
            ("velocity", "", self.velocity),
        ):
            for name, pick in rule or ():
                if isinstance(pick, Pick):
                    yield prefix + name, f"[derive] {place}.{name}", pick


class FmuMap(_Section):
    """A whole map; for what it leaves out, variables with our own names are taken."""

    fmu: FmuSection = FmuSection()
    inputs: dict[str, Setting] = {}
    outputs: dict[Literal["x", "y", "psi", "vx", "vy", "omega", "delta"], Picked] = {}
    derive: Derive = Derive()
    parameters: dict[str, Value] = {}
    start: dict[str, Setting] = {}


def parse_map(text: str, name: str = "map") -> FmuMap:
    """The map written in TOML; InputError naming ``name`` and every fault."""
    try:
        return FmuMap.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name} is not TOML: {error}; names with dots need quotes") from None
    except ValidationError as error:
        raise InputError(f"{name}: {_faults(error)}; docs/fmu.md has the form") from None


def _faults(error: ValidationError) -> str:
    faults = []
    for one in error.errors():
        place = ".".join(str(part) for part in one["loc"] if part not in ("table", "value"))
        faults.append(f"{place}: {one['msg'].removeprefix('Value error, ')}")
    return "; ".join(faults)


def read_map(path: Path) -> FmuMap:
    """The map in a file; InputError if it cannot be read or is not one."""
    return parse_map(read_text(path, "the map"), str(path))
