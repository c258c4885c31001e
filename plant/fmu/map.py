"""A map checked against an FMU: what fits becomes a :class:`~plant.fmu.wiring.Wiring`.

All that is missing or wrong is told at once, with what to write into the map instead.
"""

from collections.abc import Mapping
from typing import Any, Final

from bayesrace.errors import InputError
from plant.fmu.checks import Checks, Value, a, listed
from plant.fmu.inspection import FmuDescription, Variable, describe
from plant.fmu.map_file import Driven, FmuMap, HeadingRule, Pick, VelocityRule, parse_map, read_map
from plant.fmu.wiring import (
    COMMANDS,
    STARTS,
    STATES,
    BodyVelocity,
    CosSin,
    Heading,
    InputLink,
    OutputLinks,
    Quaternion,
    Signal,
    SpeedSlip,
    StartLink,
    Velocity,
    Wiring,
    WorldVelocity,
)

__all__ = ["FmuMap", "parse_map", "read_map", "wire"]

_NOWHERE: Final = Signal(0)
"""Stands for a signal that is missing, which has been told: no wiring is made of it."""

_HINTS: Final = {
    "psi": "or, from a quaternion or cosine and sine, [derive] psi = …",
    "vx": "or [derive] velocity = { world_x, world_y } or { speed, slip }",
    "vy": "or [derive] velocity = { world_x, world_y } or { speed, slip }",
    "omega": 'or [derive] omega = "psi", from the change of heading',
    "delta": 'or [derive] delta = "delta_rate", integrated from the steering rate that acts',
}


def wire(description: Any, map_: FmuMap | None = None) -> Wiring:
    """The wiring of an FMU (fmpy's ModelDescription, or ours of it) by a map.

    What the map leaves out is looked for under our own names. Raises InputError with all that is
    missing or wrong, and what to put into the map.
    """
    fmu = description if isinstance(description, FmuDescription) else describe(description)
    if not fmu.co_simulation:
        has = " and ".join(fmu.interfaces) or "no interface"
        raise InputError(
            f"the FMU '{fmu.model_name}' has {has} only; export it for Co-Simulation to drive it"
        )
    return _Matching(fmu, map_ or FmuMap()).wiring(given=map_ is not None)


class _Matching:
    """One pass over a map; collects problems rather than stopping at the first."""

    def __init__(self, fmu: FmuDescription, map_: FmuMap) -> None:
        self._fmu = fmu
        self._map = map_
        self._checks = Checks(fmu.variables)
        self._outputs: list[str] = []

    def wiring(self, *, given: bool) -> Wiring:
        picks = self._picks()
        links = self._links(picks)
        inputs, fixed = self._inputs()
        fixed |= self._parameters()
        starts, constants = self._starts(picks)
        if self._checks.problems:
            raise InputError(self._report(given=given))
        section = self._map.fmu
        return Wiring(
            inputs=inputs,
            outputs=self._outputs,
            links=links,
            starts=starts,
            fixed=fixed | constants,
            step_s=section.step_s,
            timeout_s=section.timeout_s,
            startup_s=section.startup_s,
            placed=section.placed,
        )

    def _report(self, *, given: bool) -> str:
        name = self._fmu.model_name
        said = f"the map does not fit the FMU '{name}'" if given else (
            f"the FMU '{name}' does not have our names and units, and no map says what its own are"
        )  # fmt: skip
        problems = "".join(f"\n  - {problem}" for problem in self._checks.problems)
        return f"{said}:{problems}\n`bayesrace fmu inspect` lists its variables and writes a map"

    # -- outputs ------------------------------------------------------------------------------

    def _picks(self) -> dict[str, Pick]:
        """What [outputs] names, and our own names where neither it nor [derive] says anything."""
        derive = self._map.derive
        derived = {
            "psi": derive.psi,
            "vx": derive.velocity,
            "vy": derive.velocity,
            "omega": derive.omega,
            "delta": derive.delta,
        }
        picks: dict[str, Pick] = {}
        for quantity, unit in STATES.items():
            pick = self._map.outputs.get(quantity)  # type: ignore[call-overload]
            if pick is not None and derived.get(quantity) is not None:
                self._checks.problems.append(
                    f"{quantity} is in [outputs] and in [derive]: give one"
                )
            elif pick is not None:
                picks[quantity] = pick
            elif derived.get(quantity) is None:
                own = self._checks.variables.get(quantity)
                if own is not None and own.causality in ("output", "local"):
                    picks[quantity] = Pick(variable=quantity)
                else:
                    hint = f" {_HINTS[quantity]}" if quantity in _HINTS else ""
                    self._checks.problems.append(
                        f"nothing gives our {quantity} [{unit}]: add to [outputs] {quantity} = "
                        f'{{ variable = "…", unit = "{unit}" }}{hint}'
                    )
        return picks

    def _links(self, picks: Mapping[str, Pick]) -> OutputLinks:
        signals = {name: self._signal(pick, name) for name, pick in picks.items()}
        derive = self._map.derive
        psi: Heading = signals.get("psi", _NOWHERE)
        if derive.psi is not None:
            psi = self._heading(derive.psi)
        velocity: Velocity = BodyVelocity(signals.get("vx", _NOWHERE), signals.get("vy", _NOWHERE))
        if derive.velocity is not None:
            velocity = self._velocity(derive.velocity)
        return OutputLinks(
            x=signals.get("x", _NOWHERE),
            y=signals.get("y", _NOWHERE),
            psi=psi,
            velocity=velocity,
            omega=signals.get("omega"),
            delta=signals.get("delta"),
        )

    def _signal(self, pick: Pick, quantity: str, section: str = "outputs") -> Signal:
        wanted = STATES[quantity]
        return self._read(pick, wanted, f"[{section}] {quantity}")

    def _read(self, pick: Pick, wanted: str, where: str) -> Signal:
        variable = self._checks.real(pick.variable, where)
        if variable is None:
            return _NOWHERE
        if variable.causality not in ("output", "local"):
            self._checks.problems.append(
                f"{where}: '{variable.name}' is {a(variable.causality)}; an output is needed"
                + (f", {_HINTS['delta']}" if where.endswith("] delta") else "")
            )
            return _NOWHERE
        scale, offset = self._checks.conversion(pick, variable, wanted, where, outwards=False)
        if pick.variable not in self._outputs:
            self._outputs.append(pick.variable)
        return Signal(self._outputs.index(pick.variable), scale, offset)

    def _heading(self, rule: HeadingRule) -> Heading:
        where = "[derive] psi"
        offset = rule.offset
        if isinstance(offset, str):
            offset = self._checks.offset(offset, "rad", where)
        if rule.quaternion is not None:
            parts = {
                name: self._read(getattr(rule.quaternion, name), "1", f"{where}.quaternion.{name}")
                for name in ("w", "x", "y", "z")
            }
            return Quaternion(**parts, sign=rule.sign, offset=offset)
        assert rule.cos is not None  # noqa: S101  the model checks it
        assert rule.sin is not None  # noqa: S101
        cos, sin = self._read(rule.cos, "1", where), self._read(rule.sin, "1", where)
        return CosSin(cos, sin, sign=rule.sign, offset=offset)

    def _velocity(self, rule: VelocityRule) -> Velocity:
        where = "[derive] velocity"
        if rule.world_x is not None and rule.world_y is not None:
            return WorldVelocity(
                self._read(rule.world_x, "m/s", f"{where}.world_x"),
                self._read(rule.world_y, "m/s", f"{where}.world_y"),
            )
        assert rule.speed is not None  # noqa: S101  the model checks it
        speed = self._read(rule.speed, "m/s", f"{where}.speed")
        slip = None if rule.slip is None else self._read(rule.slip, "rad", f"{where}.slip")
        return SpeedSlip(speed, slip)

    # -- inputs, parameters, start values -----------------------------------------------------

    def _inputs(self) -> tuple[list[InputLink], dict[str, Value]]:
        links: list[InputLink] = []
        fixed: dict[str, Value] = {}
        for name, entry in self._map.inputs.items():
            where = f"[inputs] {name}"
            driven = Driven.of(entry, COMMANDS)
            if driven is None:
                variable = self._checks.find(name, where)
                if variable is not None and self._is_input(variable, where):
                    self._checks.fix(variable, entry, where, fixed)
            elif (link := self._input(name, driven, where)) is not None:
                links.append(link)
        entries = (Driven.of(entry, COMMANDS) for entry in self._map.inputs.values())
        links += self._own_inputs({one.source for one in entries if one is not None})
        self._check_rest({*self._map.inputs, *(link.variable for link in links)})
        return links, fixed

    def _is_input(self, variable: Variable, where: str) -> bool:
        if variable.causality == "input":
            return True
        remedy = " it goes into [parameters]" if variable.causality == "parameter" else ""
        self._checks.problems.append(
            f"{where}: '{variable.name}' is {a(variable.causality)}, not an input;{remedy}"
        )
        return False

    def _input(self, name: str, entry: Driven, where: str) -> InputLink | None:
        wanted = COMMANDS.get(entry.source)
        if wanted is None:
            self._checks.problems.append(
                f"{where}: from = '{entry.source}' is none of {listed(COMMANDS)}"
            )
            return None
        variable = self._checks.real(name, where)
        if variable is None or not self._is_input(variable, where):
            return None
        scale, offset = self._checks.conversion(entry, variable, wanted, where, outwards=True)
        return InputLink(name, entry.source, scale, offset, variable.lowest, variable.highest)

    def _own_inputs(self, sources: set[str]) -> list[InputLink]:
        """Drive and steering under our own names where the map says nothing of them."""
        links = []
        for needed, own, what in (
            ({"d", "throttle"}, ("d",), "the duty cycle d [1] or its part `throttle`"),
            (
                {"delta_rate", "delta"},
                ("delta_rate", "delta"),
                "the steering rate `delta_rate` [rad/s] or angle `delta` [rad]",
            ),
        ):
            if sources & needed:
                continue
            free = (name for name in own if name not in self._map.inputs)
            found = (self._checks.variables.get(name) for name in free)
            name = next((v.name for v in found if v is not None and v.causality == "input"), None)
            if name is None:
                self._checks.problems.append(
                    f"no input of the FMU takes {what}: add to [inputs] "
                    f'variable = {{ from = "{own[0]}", unit = "…" }}'
                )
            elif link := self._input(name, Driven(source=name), f"[inputs] {name}"):
                links.append(link)
        return links

    def _check_rest(self, covered: set[str]) -> None:
        for variable in self._fmu.variables:
            if variable.causality != "input" or variable.name in covered:
                continue
            if variable.start is None and variable.kind not in ("clock", "binary"):
                self._checks.problems.append(
                    f"the FMU's input '{variable.name}' has neither a start value nor a place in "
                    f'the map: add a constant to [inputs], as "{variable.name}" = 0.0'
                )

    def _parameters(self) -> dict[str, Value]:
        fixed: dict[str, Value] = {}
        for name, value in self._map.parameters.items():
            where = f"[parameters] {name}"
            variable = self._checks.find(name, where)
            if variable is None:
                continue
            if variable.causality == "parameter" and variable.variability != "constant":
                self._checks.fix(variable, value, where, fixed)
                continue
            what = variable.causality if variable.variability != "constant" else "constant"
            into = ""
            if variable.settable:
                into = f"; it goes into [{'inputs' if what == 'input' else 'start'}]"
            self._checks.problems.append(f"{where}: '{name}' is {a(what)}, not a parameter{into}")
        return fixed

    def _starts(self, picks: Mapping[str, Pick]) -> tuple[list[StartLink], dict[str, Value]]:
        links: list[StartLink] = []
        fixed: dict[str, Value] = {}
        for name, entry in self._map.start.items():
            where = f"[start] {name}"
            driven = Driven.of(entry, STARTS)
            variable = (
                self._checks.find(name, where) if driven is None else self._checks.real(name, where)
            )
            if variable is None:
                continue
            if not variable.settable or variable.causality == "input":
                hint = "a constant goes into [inputs]" if variable.causality == "input" else (
                    "it cannot be set before initialisation"
                )  # fmt: skip
                self._checks.problems.append(
                    f"{where}: '{name}' is {a(variable.causality)}: {hint}"
                )
            elif driven is None:
                self._checks.fix(variable, entry, where, fixed)
            elif (wanted := STARTS.get(driven.source)) is None:
                self._checks.problems.append(
                    f"{where}: from = '{driven.source}' is none of {listed(STARTS)}"
                )
            else:
                scale, offset = self._checks.conversion(
                    driven, variable, wanted, where, outwards=True
                )
                links.append(_start(variable, driven.source, scale, offset))
        return links + self._own_starts(picks, {link.source for link in links}), fixed

    def _own_starts(self, picks: Mapping[str, Pick], sources: set[str]) -> list[StartLink]:
        """Outputs whose start can be set are started, where the map says nothing else."""
        links = []
        for quantity, pick in picks.items():
            variable = self._checks.variables.get(pick.variable)
            if variable is None or variable.initial != "exact" or not variable.settable:
                continue
            if quantity in sources or pick.variable in self._map.start:
                continue
            before = len(self._checks.problems)  # what is wrong with the pick has been told
            where = f"[outputs] {quantity}"
            scale, offset = self._checks.conversion(
                pick, variable, STATES[quantity], where, outwards=False
            )
            del self._checks.problems[before:]
            links.append(_start(variable, quantity, 1.0 / scale, -offset / scale))
        return links


def _start(variable: Variable, source: str, scale: float, offset: float) -> StartLink:
    return StartLink(variable.name, source, scale, offset, variable.lowest, variable.highest)
