"""The map file: TOML that says which of an FMU's variables mean what.

``ours = sign * scale * theirs + offset`` for outputs, ``theirs = sign * scale * ours + offset``
for inputs and start values; the scale follows from the unit unless it is given.
"""

import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import pydantic
from pydantic import Discriminator, Field, Tag, model_validator

from bayesrace.errors import InputError, faults_in
from bayesrace.files import parse_toml, read_text
from bayesrace.plant.fmu.wiring import COMMANDS, STARTS

__all__ = ["Driven", "FmuMap", "Pick", "Value", "parse_map", "read_map"]


def _plain(value: Any) -> Any:
    if isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise ValueError("give a finite number, true, false or a text")


Value = Annotated[bool | int | float | str, pydantic.PlainValidator(_plain)]
Sign = Literal[1, -1]


class _Section(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True
    )

    def picks(self, place: str) -> Iterator[tuple[str, str, "Pick"]]:
        """Quantity, place in the map and variable of what is read."""
        for name, value in self:
            at = f"{place}{type(self).model_fields[name].alias or name}"
            if isinstance(value, Pick):
                yield name, at, value
            elif isinstance(value, _Section):
                yield from value.picks(f"{at}.")


class _Affine(_Section):
    named: ClassVar[str]
    """The key of the text that will do alone."""

    unit: str | None = Field(None, description="the FMU variable's unit; default: as it declares")
    sign: Sign = Field(1, description="-1: positive the other way round; a factor is `scale`")
    scale: float | None = Field(None, description="factor in place of the unit's")
    offset: float | str = Field(
        0.0, description="added after scaling, in the unit of the result, or with one: '90 deg'"
    )

    @model_validator(mode="before")
    @classmethod
    def _short(cls, entry: Any) -> Any:
        if isinstance(entry, dict | cls):
            return entry
        if isinstance(entry, str):
            return {cls.named: entry}
        raise ValueError('give the name of a variable of the FMU, or { variable = "name", … }')

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

    named = "variable"
    variable: str


class Driven(_Affine):
    """The quantity of ours that sets one of the FMU's variables."""

    named = "from"
    source: str = Field(alias="from")


def _setting(quantities: Collection[str]) -> Discriminator:
    """A quantity, by a table or by its name alone, or else a constant."""

    def form(entry: Any) -> str:
        named = isinstance(entry, dict | Driven) or (isinstance(entry, str) and entry in quantities)
        return "driven" if named else "constant"

    return Discriminator(form)


Setting = Annotated[Driven, Tag("driven")] | Annotated[Value, Tag("constant")]


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


class _Rule(_Section):
    forms: ClassVar[tuple[set[str], ...]]
    """The keys with variables that it may have."""

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if {name for name, value in self if isinstance(value, _Section)} in self.forms:
            return self
        forms = ", or ".join(" and ".join(sorted(form)) for form in self.forms)
        raise ValueError(f"give either {forms}")


class _Quaternion(_Section):
    qw: Pick = Field(alias="w")
    qx: Pick = Field(alias="x")
    qy: Pick = Field(alias="y")
    qz: Pick = Field(alias="z")


class _Heading(_Rule):
    forms = ({"quaternion"}, {"cos", "sin"})
    quaternion: _Quaternion | None = Field(None, description="rotation body → world")
    cos: Pick | None = None
    sin: Pick | None = None
    sign: Sign = 1
    offset: float | str = 0.0


class _Velocity(_Rule):
    forms = ({"world_x", "world_y"}, {"speed"}, {"speed", "slip"})
    world_x: Pick | None = None
    world_y: Pick | None = None
    speed: Pick | None = None
    slip: Pick | None = Field(None, description="without it the car moves where it points")


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


class FmuMap(_Section):
    """A whole map; for what it leaves out, variables with our own names are taken."""

    fmu: FmuSection = FmuSection()
    inputs: dict[str, Annotated[Setting, _setting(COMMANDS)]] = {}
    outputs: dict[Literal["x", "y", "psi", "vx", "vy", "omega", "delta"], Pick] = {}
    derive: Derive = Derive()
    parameters: dict[str, Value] = {}
    start: dict[str, Annotated[Setting, _setting(STARTS)]] = {}


def parse_map(text: str, name: str = "map") -> FmuMap:
    """The map written in TOML; InputError naming ``name`` and every fault."""
    content = parse_toml(text, name, "names with dots need quotes")
    try:
        return FmuMap.model_validate(content)
    except pydantic.ValidationError as error:
        faults = faults_in(error, "the map", FmuMap, ("driven", "constant"))
        raise InputError(f"{name}: {faults}; docs/fmu.md has the form") from None


def read_map(path: Path) -> FmuMap:
    """The map in a file; InputError if it cannot be read or is not one."""
    return parse_map(read_text(path, "the map"), str(path))
