"""A map checked against an FMU: what fits becomes a :class:`~plant.fmu.wiring.Wiring`.

One error names all that is missing or wrong, each with what to write into the map instead.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Final

from bayesrace.errors import InputError
from plant.fmu.checks import a, constant, conversion, find, offset_of, scalar
from plant.fmu.inspection import FmuDescription
from plant.fmu.map_file import Driven, FmuMap, Pick, Value
from plant.fmu.wiring import COMMANDS, READINGS, STARTS, STATES, Link, Wiring

__all__ = ["wire"]

_VELOCITY: Final = " or [derive] velocity = { world_x, world_y } or { speed, slip }"
_HINTS: Final = {
    "psi": " or, from a quaternion or cosine and sine, [derive] psi = …",
    "vx": _VELOCITY,
    "vy": _VELOCITY,
    "omega": ' or [derive] omega = "psi", from the change of heading',
    "delta": ' or [derive] delta = "delta_rate", integrated from the steering rate that acts',
}

_NEEDED: Final = (
    (("d",), {"d", "throttle"}, "the drive command d or its part `throttle`"),
    (
        ("delta_rate", "delta"),
        {"delta_rate", "delta"},
        "the steering rate `delta_rate` [rad/s] or angle `delta` [rad]",
    ),
)
"""Our own names for an input, the quantities of which one must drive an input, and words."""


def wire(fmu: FmuDescription, map_: FmuMap | None = None, unit: str = "1") -> Wiring:
    """The wiring of an FMU by a map; for what the map leaves out, our own names are taken.

    ``unit``: of the car's drive command.

    Raises InputError with all that is missing or wrong, and what to put into the map.
    """
    name = fmu.model_name
    if not fmu.co_simulation:
        has = " and ".join(fmu.interfaces) or "no interface"
        raise InputError(
            f"the FMU '{name}' has {has} only; export it for Co-Simulation to drive it"
        )
    matching = _Matching(fmu, map_ or FmuMap(), unit)
    matching.match()
    if not matching.problems:
        return matching.wiring()
    title = f"the map does not fit the FMU '{name}'" if map_ else (
        f"the FMU '{name}' does not have our names and units, and no map says what its own are"
    )  # fmt: skip
    problems = "\n  - ".join(("", *matching.problems))
    raise InputError(
        f"{title}:{problems}\n`bayesrace fmu inspect` lists its variables and writes a map"
    )


class _Matching:
    """One pass over a map: each entry becomes a link or a constant, or else a problem."""

    def __init__(self, fmu: FmuDescription, map_: FmuMap, unit: str) -> None:
        self._commands = COMMANDS | dict.fromkeys(("d", "throttle", "brake"), unit)
        self._map = map_
        self._variables = {variable.name: variable for variable in fmu.variables}
        self._inputs: list[Link] = []
        self._outputs: list[Link] = []
        self._starts: list[Link] = []
        self._fixed: dict[str, Value] = {}
        self._heading_offset = 0.0
        self.problems: list[str] = []

    def match(self) -> None:
        """Take the sections of the map in turn."""
        map_ = self._map
        self._states()
        for quantity, where, pick in map_.derive.read():
            self._try(where, self._output, quantity, pick)
        for name, entry in map_.inputs.items():
            self._try(f"[inputs] {name}", self._input, name, entry)
        self._other_inputs()
        for name, value in map_.parameters.items():
            self._try(f"[parameters] {name}", self._parameter, name, value)
        for name, entry in map_.start.items():
            self._try(f"[start] {name}", self._start, name, entry)
        self._try("[derive] psi", self._heading)

    def wiring(self) -> Wiring:
        """What the entries have become, if there are no problems."""
        heading = self._map.derive.psi
        return Wiring(
            self._inputs,
            self._outputs,
            [*self._starts, *self._started_outputs()],
            self._fixed,
            heading=(heading.sign if heading else 1.0, self._heading_offset),
            placed=self._map.fmu.placed,
        )

    def _try(self, where: str, check: Callable[..., None], *arguments: object) -> None:
        try:
            check(*arguments)
        except InputError as error:
            self.problems.append(f"{where}: {error}")

    def _states(self) -> None:
        """[outputs], and our own names where neither it nor [derive] says anything."""
        derived, picks = self._map.derive.derived(), dict[str, Pick](self._map.outputs.items())
        for quantity, unit in STATES.items():
            own = self._variables.get(quantity)
            if quantity in derived:
                if quantity in picks:
                    self.problems.append(f"{quantity} is in [outputs] and in [derive]: give one")
            elif quantity in picks or (own and own.readable):
                pick = picks.get(quantity) or Pick(variable=quantity)
                self._try(f"[outputs] {quantity}", self._output, quantity, pick)
            else:
                self.problems.append(
                    f"nothing gives our {quantity} [{unit}]: add to [outputs] {quantity} = "
                    f'{{ variable = "…", unit = "{unit}" }}{_HINTS.get(quantity, "")}'
                )

    def _output(self, quantity: str, pick: Pick) -> None:
        variable = scalar(self._variables, pick.variable)
        if not variable.readable:
            hint = f",{_HINTS['delta']}" if quantity == "delta" else ""
            raise InputError(
                f"'{variable.name}' is {a(variable.causality)}; an output is needed{hint}"
            )
        scale, offset = conversion(pick, variable, READINGS[quantity])
        self._outputs.append(Link(variable.name, quantity, scale, offset))

    def _heading(self) -> None:
        if self._map.derive.psi:
            self._heading_offset = offset_of(self._map.derive.psi.offset, "rad")

    def _link(self, name: str, driven: Driven, quantities: Mapping[str, str]) -> Link:
        if driven.source not in quantities:
            raise InputError(f"from = '{driven.source}' is none of {', '.join(quantities)}")
        variable = scalar(self._variables, name)
        scale, offset = conversion(driven, variable, quantities[driven.source], outwards=True)
        return Link(name, driven.source, scale, offset, variable.lowest, variable.highest)

    def _input(self, name: str, entry: Driven | Value) -> None:
        variable = find(self._variables, name)
        if variable.causality != "input":
            remedy = " it goes into [parameters]" if variable.causality == "parameter" else ""
            raise InputError(f"'{name}' is {a(variable.causality)}, not an input;{remedy}")
        if isinstance(entry, Driven):
            self._inputs.append(self._link(name, entry, self._commands))
        else:
            self._fixed[name] = constant(variable, entry)

    def _other_inputs(self) -> None:
        """Drive and steering by our own names; what nothing sets needs a start value of its own."""
        named = self._map.inputs
        free = {
            name: one
            for name, one in self._variables.items()
            if one.causality == "input" and name not in named
        }
        sources = {entry.source for entry in named.values() if isinstance(entry, Driven)}
        for names, quantities, words in _NEEDED:
            own = next((name for name in names if name in free), None)
            if sources & quantities:
                continue
            if own is not None:
                self._try(f"[inputs] {own}", self._input, own, Driven(source=own))
                del free[own]
            else:
                self.problems.append(
                    f"no input of the FMU takes {words}: add to [inputs] "
                    f'variable = {{ from = "{names[0]}", unit = "…" }}'
                )
        self.problems += (
            f"the FMU's input '{name}' has neither a start value nor a place in the map: add a "
            f'constant to [inputs], as "{name}" = 0.0'
            for name, one in free.items()
            if one.start is None and one.kind not in ("clock", "binary")
        )

    def _parameter(self, name: str, value: Value) -> None:
        variable = find(self._variables, name)
        what = variable.causality if variable.variability != "constant" else "constant"
        if what != "parameter":
            section = "inputs" if what == "input" else "start"
            into = f"; it goes into [{section}]" if variable.settable else ""
            raise InputError(f"'{name}' is {a(what)}, not a parameter{into}")
        self._fixed[name] = constant(variable, value)

    def _start(self, name: str, entry: Driven | Value) -> None:
        variable = find(self._variables, name)
        if variable.causality == "input":
            raise InputError(f"'{name}' is an input: a constant goes into [inputs]")
        if not variable.settable:
            is_ = a(variable.causality)
            raise InputError(f"'{name}' is {is_}: it cannot be set before initialisation")
        if isinstance(entry, Driven):
            self._starts.append(self._link(name, entry, STARTS))
        else:
            self._fixed[name] = constant(variable, entry)

    def _started_outputs(self) -> Iterator[Link]:
        """Outputs whose start can be set are started, where the map says nothing else."""
        sources = {link.quantity for link in self._starts}
        for link in self._outputs:
            one = self._variables[link.variable]
            free = link.quantity in STATES and link.quantity not in sources
            if free and one.initial == "exact" and one.settable and one.name not in self._map.start:
                scale, offset = 1.0 / link.scale, -link.offset / link.scale
                yield Link(one.name, link.quantity, scale, offset, one.lowest, one.highest)
