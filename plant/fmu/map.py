"""The map of an FMU: TOML that says which of its variables mean what, checked against the FMU.

``ours = sign * scale * theirs + offset`` for outputs, ``theirs = sign * scale * ours + offset``
for inputs and start values; the scale follows from the unit unless it is given.

What fits becomes a :class:`~bayesrace.plant.fmu.wiring.Wiring`; constants get the type of their
variable. One error names all that is missing or wrong, each with what to write instead.
"""

import difflib
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import pydantic
from pydantic import Discriminator, Field, Tag

from bayesrace.errors import InputError, faults_in
from bayesrace.files import parse_toml, read_text
from bayesrace.plant.fmu.inspection import (
    is_readable,
    is_real,
    is_settable,
    items_of,
    range_of,
)
from bayesrace.plant.fmu.wiring import COMMANDS, QUANTITIES, STATES, VELOCITIES, Link, Wiring
from bayesrace.units import Affine, Section, factor_of

__all__ = ["FmuMap", "parse_map", "read_map", "wire"]


def _plain(value: Any) -> Any:
    if isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise ValueError("give a finite number, true, false or a text")


Value = Annotated[bool | int | float | str, pydantic.PlainValidator(_plain)]


class Pick(Affine):
    """One of the FMU's variables, as a quantity of ours."""

    named = "variable"
    variable: str


class Driven(Affine):
    """The quantity of ours that sets one of the FMU's variables."""

    named = "from"
    source: str = Field(alias="from")


def _form(entry: Any) -> str:
    """A quantity, by a table or by its name alone, or else a constant."""
    named = isinstance(entry, dict | Driven) or entry in (*COMMANDS, *QUANTITIES)
    return "driven" if named else "constant"


Setting = Annotated[
    Annotated[Driven, Tag("driven")] | Annotated[Value, Tag("constant")], Discriminator(_form)
]


class FmuSection(Section):
    """[fmu]: how the FMU is run."""

    step_s: float | None = Field(None, gt=0, description="communication step; must divide a period")
    timeout_s: float = Field(2.0, gt=0, description="an FMU that takes longer for a step hangs")
    startup_s: float = Field(
        8.0, gt=0, description="the same for loading it, and for each initialisation"
    )
    placed: bool = Field(
        False, description="move the FMU's world so that its own start is the asked start pose"
    )
    derived: frozenset[Literal["omega", "delta"]] = Field(
        frozenset(),
        description="what the FMU does not give: omega follows from the change of psi, delta is "
        "the sum of the steering rates that acted",
    )


class FmuMap(Section):
    """A whole map; for what it leaves out, variables with our own names are taken."""

    fmu: FmuSection = FmuSection()
    inputs: dict[str, Setting] = Field({})
    outputs: dict[
        Literal[
            "x", "y", "psi", "vx", "vy", "omega", "delta", "world_vx", "world_vy", "speed", "slip"
        ],
        Pick,
    ] = Field({})
    parameters: dict[str, Value] = Field({})
    start: dict[str, Setting] = Field({})


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


_NEEDED: Final = (
    ("the drive command d or its part `throttle`", ["d"], {"d", "throttle"}),
    (
        "the steering rate `delta_rate` [rad/s] or angle `delta` [rad]",
        ["delta_rate", "delta"],
        {"delta_rate", "delta"},
    ),
)
"""What an input must take, our own names for it, the quantities of which one must drive it."""


def wire(fmu: Any, map_: FmuMap | None = None, unit: str = "1") -> Wiring:
    """The wiring of an FMU by a map; for what the map leaves out, our own names are taken.

    ``unit``: of the car's drive command.

    Raises InputError with all that is missing or wrong, and what to put into the map.
    """
    name = fmu.modelName
    if fmu.coSimulation is None:
        raise InputError(
            f"the FMU '{name}' is for Model Exchange only: export it for Co-Simulation"
        )
    matching = _Matching(fmu, map_ or FmuMap())
    wiring = matching.wiring(COMMANDS | dict.fromkeys(("d", "throttle", "brake"), unit))
    if not matching.problems:
        return wiring
    title = f"the map does not fit the FMU '{name}'" if map_ else (
        f"the FMU '{name}' does not have our names and units, and no map says what its own are"
    )  # fmt: skip
    problems = "\n  - ".join(("", *matching.problems))
    raise InputError(
        f"{title}:{problems}\n`bayesrace fmu inspect` lists its variables and writes a map"
    )


class _Matching:
    """One pass over a map: each entry becomes a link or a constant, or else a problem."""

    def __init__(self, fmu: Any, map_: FmuMap) -> None:
        self._variables = {one.name: one for one in fmu.modelVariables}
        self._map = map_
        self._inputs: list[Link] = []
        self._outputs: list[Link] = []
        self._starts: list[Link] = []
        self._fixed: dict[str, Value] = {}
        self.problems: list[str] = []

    def wiring(self, commands: Mapping[str, str]) -> Wiring:
        """What the entries become; ``commands``: what can drive an input, with units."""
        map_ = self._map
        for quantity, pick in self._states():
            self._try(f"[outputs] {quantity}", self._output, quantity, pick)
        for section, entries, quantities in (
            ("inputs", map_.inputs | self._own_inputs(), commands),
            ("parameters", map_.parameters, {}),
            ("start", map_.start, QUANTITIES),
        ):
            for name, entry in entries.items():
                self._try(f"[{section}] {name}", self._setting, section, name, entry, quantities)
        starts = [*self._starts, *self._started_outputs()]
        return Wiring(self._inputs, self._outputs, starts, self._fixed, map_.fmu.placed)

    def _try(self, where: str, check: Callable[..., None], *arguments: object) -> None:
        try:
            check(*arguments)
        except InputError as error:
            self.problems.append(f"{where}: {error}")

    def _states(self) -> Iterator[tuple[str, Pick]]:
        """[outputs], and our own names where the map says nothing else."""
        outputs = dict[str, Pick](self._map.outputs.items())
        replaced = set[str](self._map.fmu.derived)
        if others := outputs.keys() - STATES.keys():
            replaced |= {"vx", "vy"}
            if others not in VELOCITIES:
                self.problems.append(
                    "[outputs] in place of vx and vy: give world_vx and world_vy, or speed and "
                    "slip, or speed alone, where the car moves where it points"
                )
        for quantity in sorted(outputs.keys() & replaced):
            self.problems.append(
                f"[outputs] {quantity} also follows from other entries of the map: remove one"
            )
        yield from outputs.items()
        for quantity in [one for one in STATES if one not in {*outputs, *replaced}]:
            own, unit = self._variables.get(quantity), STATES[quantity]
            if own and is_readable(own):
                yield quantity, Pick(variable=quantity)
                continue
            rule = f", or [fmu] derived = ['{quantity}']" if quantity in ("omega", "delta") else ""
            self.problems.append(
                f"nothing gives our {quantity} [{unit}]: add [outputs] {quantity} = "
                f'{{ variable = "…", unit = "{unit}" }}{rule}'
            )

    def _own_inputs(self) -> dict[str, Driven | Value]:
        """Drive and steering by our own names; what nothing sets needs a start value of its own."""
        named, own = self._map.inputs, dict[str, Driven | Value]()
        inputs = [one for one in self._variables.values() if one.causality == "input"]
        free = {one.name: one for one in inputs if one.name not in named}
        sources = {entry.source for entry in named.values() if isinstance(entry, Driven)}
        for words, names, quantities in _NEEDED:
            ours = next((name for name in names if name in free), None)
            if sources.isdisjoint(quantities) and ours:
                own[ours] = Driven(source=ours)
            elif sources.isdisjoint(quantities):
                self.problems.append(
                    f"no input of the FMU takes {words}: add to [inputs] "
                    f'variable = {{ from = "{names[0]}", unit = "…" }}'
                )
        self.problems += (
            f"the FMU's input '{name}' has neither a start value nor a place in the map: add a "
            f'constant to [inputs], as "{name}" = 0.0'
            for name, one in free.items()
            if name not in own and one.start is None and one.type not in ("Clock", "Binary")
        )
        return own

    def _started_outputs(self) -> Iterator[Link]:
        """Outputs whose start can be set are started, where the map says nothing else."""
        sources = {link.quantity for link in self._starts}
        for link in self._outputs:
            one = self._variables[link.variable]
            taken = link.quantity in sources or one.name in {*self._map.start, *self._fixed}
            starts = one.initial == "exact" and is_settable(one) and not taken
            if link.quantity in STATES and starts:
                scale, offset = 1.0 / link.scale, -link.offset / link.scale
                yield Link(one.name, link.quantity, scale, offset, *range_of(one))

    def _output(self, quantity: str, pick: Pick) -> None:
        variable = self._real(pick.variable)
        if not is_readable(variable):
            raise InputError(
                f"'{variable.name}' is of causality {variable.causality}: give an output"
            )
        factor = self._factor(pick, variable, QUANTITIES[quantity])
        self._outputs.append(Link(variable.name, quantity, pick.sign * factor, pick.offset))

    def _setting(
        self, section: str, name: str, entry: Driven | Value, quantities: Mapping[str, str]
    ) -> None:
        """A variable that is set: by one of the quantities, or once by a constant."""
        variable = self._find(name)
        wrong = section == "inputs" and variable.causality != "input"
        if wrong or not is_settable(variable):
            kind = f"{variable.variability} {variable.causality}"
            raise InputError(f"'{name}' is a {kind}: [{section}] cannot set it")
        if not isinstance(entry, Driven):
            self._fixed[name] = self._constant(variable, entry)
            return
        if entry.source not in quantities:
            raise InputError(f"from = '{entry.source}' is none of {', '.join(quantities)}")
        wanted = quantities[entry.source]
        links = self._inputs if section == "inputs" else self._starts
        scale = self._factor(entry, self._real(name), wanted)
        scale = scale if entry.scale else 1.0 / scale
        sign, offset = entry.sign, entry.offset
        links.append(Link(name, entry.source, sign * scale, offset, *range_of(variable)))

    def _find(self, name: str) -> Any:
        """The FMU's variable; InputError with names like it if there is none."""
        if name in self._variables:
            return self._variables[name]
        by_lower = {known.lower(): known for known in self._variables}
        near = difflib.get_close_matches(name.lower(), by_lower, n=3, cutoff=0.6)
        names = ", ".join(f"'{by_lower[one]}'" for one in near)
        raise InputError(f"the FMU has no variable '{name}'" + (f"; near: {names}" if near else ""))

    def _real(self, name: str) -> Any:
        """The same, a single real number."""
        variable = self._find(name)
        if variable.dimensions or not is_real(variable):
            what = "an array" if variable.dimensions else f"of type {variable.type}"
            raise InputError(f"'{name}' is {what}; a single real number is needed")
        return variable

    def _factor(self, entry: Pick | Driven, variable: Any, wanted: str) -> float:
        """The entry's scale, or else that from the variable's unit to ``wanted``; 1 if neither the
        map nor the FMU names a unit, which is SI then."""
        factor = entry.factor(variable.name, wanted, variable.unit)
        declared = None if entry.scale is not None else factor_of(variable.unit, wanted)
        if declared not in (None, factor):
            raise InputError(
                f"the map says '{variable.name}' is in '{entry.unit}', the FMU declares "
                f"'{variable.unit}'; leave the unit out, or give `scale` if the FMU is wrong"
            )
        return factor

    def _constant(self, variable: Any, value: Value) -> Value:
        """``value`` in the variable's type; InputError if it is of another or out of range."""
        result = None if variable.dimensions else _typed(variable, value)
        lowest, highest = range_of(variable)
        if result is None:
            names = f" with {', '.join(items_of(variable))}" if items_of(variable) else ""
            raise InputError(
                f"{value!r} does not suit '{variable.name}', which is of type "
                f"{variable.type}{names}"
            )
        if isinstance(result, str) or lowest <= result <= highest:
            return result
        raise InputError(
            f"{value!r} is outside {lowest:g} to {highest:g}, which '{variable.name}' allows"
        )


def _typed(variable: Any, value: Value) -> Value | None:
    """The value in the variable's type; None if it has no such value."""
    kind = variable.type
    if isinstance(value, str):
        return value if kind == "String" else items_of(variable).get(value)
    if kind == "Boolean":
        return bool(value) if value in (0, 1) else None
    if isinstance(value, bool) or kind in ("String", "Binary", "Clock"):
        return None
    if is_real(variable):
        return float(value)
    width = np.iinfo({"Integer": "int32", "Enumeration": "int64"}.get(kind, kind.lower()))
    return int(value) if value == int(value) and width.min <= value <= width.max else None
