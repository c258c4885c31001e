"""A map checked against an FMU: what fits becomes a :class:`~plant.fmu.wiring.Wiring`.

One error names all that is missing or wrong, each with what to write into the map instead.
"""

from collections.abc import Callable, Mapping
from typing import Final

from bayesrace.errors import InputError
from plant.fmu.checks import a, constant, conversion, find, offset_of, scalar
from plant.fmu.inspection import FmuDescription
from plant.fmu.map_file import Driven, FmuMap, Pick, Value
from plant.fmu.wiring import COMMANDS, READINGS, STARTS, STATES, Link, Wiring

__all__ = ["wire"]

_VELOCITY: Final = " or [derive] velocity = { world_x, world_y } or { speed, slip }"
_HINTS: Final = {
    "x": "",
    "y": "",
    "psi": " or, from a quaternion or cosine and sine, [derive] psi = …",
    "vx": _VELOCITY,
    "vy": _VELOCITY,
    "omega": ' or [derive] omega = "psi", from the change of heading',
    "delta": ' or [derive] delta = "delta_rate", integrated from the steering rate that acts',
}

_NEEDED: Final = (
    ({"d", "throttle"}, ("d",), "the duty cycle d [1] or its part `throttle`"),
    (
        {"delta_rate", "delta"},
        ("delta_rate", "delta"),
        "the steering rate `delta_rate` [rad/s] or angle `delta` [rad]",
    ),
)
"""The quantities of which one must drive an input, our own names for that input, and words."""


def wire(fmu: FmuDescription, map_: FmuMap | None = None) -> Wiring:
    """The wiring of an FMU by a map; for what the map leaves out, our own names are taken.

    Raises InputError with all that is missing or wrong, and what to put into the map.
    """
    if not fmu.co_simulation:
        has = " and ".join(fmu.interfaces) or "no interface"
        raise InputError(
            f"the FMU '{fmu.model_name}' has {has} only; export it for Co-Simulation to drive it"
        )
    matching = _Matching(fmu, map_ or FmuMap())
    wiring = matching.wiring()
    if wiring is not None:
        return wiring
    said = f"the map does not fit the FMU '{fmu.model_name}'"
    if map_ is None:
        said = (
            f"the FMU '{fmu.model_name}' does not have our names and units, and no map says what "
            "its own are"
        )
    problems = "".join(f"\n  - {problem}" for problem in matching.problems)
    raise InputError(
        f"{said}:{problems}\n`bayesrace fmu inspect` lists its variables and writes a map"
    )


class _Matching:
    """One pass over a map: each entry becomes a link or a constant, or else a problem."""

    def __init__(self, fmu: FmuDescription, map_: FmuMap) -> None:
        self._map = map_
        self._variables = {variable.name: variable for variable in fmu.variables}
        self._inputs: list[Link] = []
        self._outputs: list[Link] = []
        self._starts: list[Link] = []
        self._fixed: dict[str, Value] = {}
        self._heading = (1.0, 0.0)
        self.problems: list[str] = []

    def wiring(self) -> Wiring | None:
        """The wiring; None if there are problems."""
        map_ = self._map
        self._states()
        for quantity, where, pick in map_.derive.picks():
            self._try(where, self._output, quantity, pick)
        self._try("[derive] psi", self._derived_heading)
        for name, entry in map_.inputs.items():
            self._try(f"[inputs] {name}", self._input, name, entry)
        self._needed_inputs()
        self._other_inputs()
        for name, value in map_.parameters.items():
            self._try(f"[parameters] {name}", self._parameter, name, value)
        for name, entry in map_.start.items():
            self._try(f"[start] {name}", self._start, name, entry)
        if self.problems:
            return None
        self._started_outputs()
        return Wiring(
            self._inputs,
            self._outputs,
            self._starts,
            self._fixed,
            heading=self._heading,
            placed=map_.fmu.placed,
        )

    def _try(self, where: str, check: Callable[..., None], *arguments: object) -> None:
        try:
            check(*arguments)
        except InputError as error:
            self.problems.append(f"{where}: {error}")

    # -- outputs ------------------------------------------------------------------------------

    def _states(self) -> None:
        """[outputs], and our own names where neither it nor [derive] says anything."""
        derived, picks = self._map.derive.derived(), dict(self._map.outputs.items())
        for quantity, hint in _HINTS.items():
            pick = picks.get(quantity)  # type: ignore[call-overload]
            own = self._variables.get(quantity)
            if pick is None and own is not None and own.readable:
                pick = Pick(variable=quantity)
            if quantity in derived:
                if quantity in picks:
                    self.problems.append(f"{quantity} is in [outputs] and in [derive]: give one")
            elif pick is not None:
                self._try(f"[outputs] {quantity}", self._output, quantity, pick)
            else:
                unit = STATES[quantity]
                self.problems.append(
                    f"nothing gives our {quantity} [{unit}]: add to [outputs] {quantity} = "
                    f'{{ variable = "…", unit = "{unit}" }}{hint}'
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

    def _derived_heading(self) -> None:
        if (rule := self._map.derive.psi) is not None:
            self._heading = rule.sign, offset_of(rule.offset, "rad")

    # -- inputs and parameters ----------------------------------------------------------------

    def _link(self, name: str, driven: Driven, quantities: Mapping[str, str]) -> Link:
        wanted = quantities.get(driven.source)
        if wanted is None:
            raise InputError(f"from = '{driven.source}' is none of {', '.join(quantities)}")
        variable = scalar(self._variables, name)
        scale, offset = conversion(driven, variable, wanted, outwards=True)
        return Link(name, driven.source, scale, offset, variable.lowest, variable.highest)

    def _input(self, name: str, entry: Driven | Value) -> None:
        variable = find(self._variables, name)
        if variable.causality != "input":
            remedy = " it goes into [parameters]" if variable.causality == "parameter" else ""
            raise InputError(f"'{name}' is {a(variable.causality)}, not an input;{remedy}")
        if driven := Driven.of(entry, COMMANDS):
            self._inputs.append(self._link(name, driven, COMMANDS))
        elif not isinstance(entry, Driven):
            self._fixed[name] = constant(variable, entry)

    def _needed_inputs(self) -> None:
        """Drive and steering by inputs with our own names where the map says nothing of them."""
        entries = [Driven.of(entry, COMMANDS) for entry in self._map.inputs.values()]
        sources = {entry.source for entry in entries if entry is not None}
        inputs = {one.name for one in self._variables.values() if one.causality == "input"}
        for quantities, names, words in _NEEDED:
            own = [name for name in names if name in inputs and name not in self._map.inputs]
            if own and not sources & quantities:
                self._try(f"[inputs] {own[0]}", self._input, own[0], Driven(source=own[0]))
            elif not sources & quantities:
                self.problems.append(
                    f"no input of the FMU takes {words}: add to [inputs] "
                    f'variable = {{ from = "{names[0]}", unit = "…" }}'
                )

    def _other_inputs(self) -> None:
        """Inputs that nothing sets need a start value of the FMU's."""
        covered = {*self._map.inputs, *(link.variable for link in self._inputs)}
        for one in self._variables.values():
            open_ = one.causality == "input" and one.start is None and one.name not in covered
            if open_ and one.kind not in ("clock", "binary"):
                self.problems.append(
                    f"the FMU's input '{one.name}' has neither a start value nor a place in the "
                    f'map: add a constant to [inputs], as "{one.name}" = 0.0'
                )

    def _parameter(self, name: str, value: Value) -> None:
        variable = find(self._variables, name)
        what = variable.causality if variable.variability != "constant" else "constant"
        if what != "parameter":
            section = "inputs" if what == "input" else "start"
            into = f"; it goes into [{section}]" if variable.settable else ""
            raise InputError(f"'{name}' is {a(what)}, not a parameter{into}")
        self._fixed[name] = constant(variable, value)

    # -- start values -------------------------------------------------------------------------

    def _start(self, name: str, entry: Driven | Value) -> None:
        variable = find(self._variables, name)
        if not variable.settable or variable.causality == "input":
            hint = "it cannot be set before initialisation"
            if variable.causality == "input":
                hint = "a constant goes into [inputs]"
            raise InputError(f"'{name}' is {a(variable.causality)}: {hint}")
        if driven := Driven.of(entry, STARTS):
            self._starts.append(self._link(name, driven, STARTS))
        elif not isinstance(entry, Driven):
            self._fixed[name] = constant(variable, entry)

    def _started_outputs(self) -> None:
        """Outputs whose start can be set are started, where the map says nothing else."""
        sources = {link.quantity for link in self._starts}
        for link in self._outputs:
            one = self._variables[link.variable]
            free = link.quantity in STATES and link.quantity not in sources
            if free and one.initial == "exact" and one.settable and one.name not in self._map.start:
                scale, offset = 1.0 / link.scale, -link.offset / link.scale
                start = Link(one.name, link.quantity, scale, offset, one.lowest, one.highest)
                self._starts.append(start)
