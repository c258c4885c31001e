"""Sensors that fail: what is reported in place of what was measured, from a time of the run on.

``--sensor-faults FILE`` names a TOML file of sections ``[[fault]]``. A fault of the whole measured
state is one of :data:`STATE_FAULTS`, one of an instrument one of :data:`READING_FAULTS`. The truth
stays as it is.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from operator import neg
from pathlib import Path
from typing import Annotated, Any, Final, Self

from msgspec.structs import replace
from pydantic import BeforeValidator, ConfigDict, Field, RootModel, model_validator

from bayesrace.defaults import Option
from bayesrace.errors import InputError
from bayesrace.files import read_form, write_whole
from bayesrace.messages import QUANTITIES, Reading, State
from bayesrace.sensors import Sensors
from bayesrace.strict import StrictModel

__all__ = ["READING_FAULTS", "STATE_FAULTS", "FaultPlayer", "ReadingFault", "SensorFault"]
__all__ += ["SensorFaults", "SensorFaultsSetting", "StateFault", "write_sensor_faults"]

_ROUNDING_S: Final = 1e-9

StateFault = Callable[[Sequence[State]], State]
"""What is reported in place of the last of the states measured since the fault began."""

ReadingFault = Callable[[Reading, Reading], Reading | None]
"""What an instrument reports in place of a reading, given its last one before the fault."""

_Number = Callable[[float], float]


# Of whole measured states ------------------------------------------------------------------------


def _changed(**what: _Number) -> StateFault:
    """These numbers of the state, so changed."""

    def report(states: Sequence[State]) -> State:
        x = zip(QUANTITIES, states[-1].x, strict=True)
        return replace(states[-1], x=tuple(what.get(name, float)(value) for name, value in x))

    return report


def _swapped(*order: int) -> StateFault:
    return lambda states: replace(states[-1], x=tuple(states[-1].x[i] for i in order))


def _held(every: int, first: int = 0, last: int = 7) -> StateFault:
    """These numbers of the state are renewed with each so manieth only; 0: never."""

    def report(states: Sequence[State]) -> State:
        old = states[(len(states) - 1) // every * every if every else 0].x[first:last]
        x = states[-1].x
        return replace(states[-1], x=(*x[:first], *old, *x[last:]))

    return report


def _late(states: Sequence[State]) -> State:
    """What was so five periods ago."""
    return replace(states[-1], x=states[max(len(states) - 6, 0)].x)


def _dated(by_s: float) -> StateFault:
    return lambda states: replace(states[-1], time_s=states[-1].time_s + by_s)


def _nought(_: float) -> float:
    return 0.0


STATE_FAULTS: Final[Mapping[str, StateFault]] = {
    "frozen": _held(0),
    "position frozen": _held(0, 0, 3),
    "jumped by 1 m": _changed(x=lambda x: x + 1),
    "jumped by 0.1 m": _changed(y=lambda y: y - 0.1),
    "heading turned round": _changed(psi=lambda psi: psi + math.pi),
    "heading in degrees": _changed(psi=math.degrees),
    "speed in km/h": _changed(vx=lambda v: 3.6 * v, vy=lambda v: 3.6 * v),
    "position in mm": _changed(x=lambda x: 1e3 * x, y=lambda y: 1e3 * y),
    "vx negative": _changed(vx=neg),
    "vy, omega, delta at 0": _changed(vy=_nought, omega=_nought, delta=_nought),
    "omega mirrored": _changed(omega=neg),
    "mirrored": _changed(y=neg, psi=neg, vy=neg, omega=neg, delta=neg),
    "x and y exchanged": _swapped(1, 0, 2, 3, 4, 5, 6),
    "vx and vy exchanged": _swapped(0, 1, 2, 4, 3, 5, 6),
    "late by 5 periods": _late,
    "dated 0.1 s ahead": _dated(0.1),
    "every fifth only": _held(5),
}
"""Of whole states, by name."""


# Of instruments ----------------------------------------------------------------------------------


def _reading(**what: _Number) -> ReadingFault:
    """These numbers of a reading, so changed; those that it has."""

    def report(one: Reading, _: Reading) -> Reading:
        values = {
            name: (what.get(name, float)(value), deviation)
            for name, (value, deviation) in one.values.items()
        }
        return replace(one, values=values)

    return report


def _dated_reading(by_s: float) -> ReadingFault:
    return lambda one, _: replace(one, time_s=one.time_s + by_s)


def _drifting(one: Reading, good: Reading) -> Reading | None:
    """By 1 m/s."""
    return _reading(x=lambda x: x + (one.time_s - good.time_s))(one, good)


READING_FAULTS: Final[Mapping[str, ReadingFault]] = {
    "frozen": lambda one, good: replace(one, values=good.values),
    "stopped": lambda _, __: None,
    "drifting": _drifting,
    "of the future": _dated_reading(0.1),
    "of the past": _dated_reading(-10.0),
    "jumped by 1 m": _reading(x=lambda x: x + 1),
    "jumped by 0.1 m": _reading(y=lambda y: y - 0.1),
    "heading turned round": _reading(psi=lambda psi: psi + math.pi),
    "speed at 0": _reading(vx=_nought),
    "speed in km/h": _reading(vx=lambda v: 3.6 * v),
    "speed negative": _reading(vx=neg),
    "yaw rate in degrees": _reading(omega=lambda omega: math.degrees(omega) + 30),
    "yaw rate jumped": _reading(omega=lambda omega: omega + 2),
}
"""Of an instrument, by name."""


# In a run ----------------------------------------------------------------------------------------


class SensorFault(StrictModel):
    """One fault: of what, which, and when."""

    fault: str = Field(description=f"one of {', '.join(STATE_FAULTS)}; of an instrument, one of "
                       f"{', '.join(READING_FAULTS)}")  # fmt: skip
    instrument: str = Field("", description="that fails; empty: the state, measured as a whole")
    from_s: float = Field(0.0, ge=0, le=1e6, description="time of the run at which it begins [s]")
    until_s: float = Field(1e6, gt=0, le=1e6, description="time at which it ends [s]")

    @model_validator(mode="after")
    def _known(self) -> Self:
        known: Mapping[str, Any] = READING_FAULTS if self.instrument else STATE_FAULTS
        if self.fault not in known:
            of = f"instrument '{self.instrument}'" if self.instrument else "a measured state"
            raise ValueError(f"no fault '{self.fault}' of {of}; there are {', '.join(known)}")
        if self.until_s <= self.from_s:
            raise ValueError(f"until_s {self.until_s:g} is not after from_s {self.from_s:g}")
        return self

    def check(self, sensors: Sensors) -> None:
        """InputError if what is to fail is not what measures this car."""
        if self.instrument and self.instrument not in sensors.root:
            there = ", ".join(sensors.root) or "none, the state is measured as a whole"
            raise InputError(f"fault of instrument '{self.instrument}': there is {there}")
        if sensors.root and not self.instrument:
            raise InputError(
                f"fault '{self.fault}': the state is not measured as a whole; name an instrument, "
                f"one of {', '.join(sensors.root)}"
            )

    def lasts(self, time_s: float) -> bool:
        """Whether it is there at this time of the run."""
        return self.from_s - _ROUNDING_S <= time_s < self.until_s - _ROUNDING_S


class FaultPlayer:
    """The faults of one run."""

    def __init__(self, faults: Sequence[SensorFault]) -> None:
        self._faults = faults
        self._since: dict[SensorFault, list[State]] = {one: [] for one in faults}
        self._good: dict[SensorFault, Reading] = {}

    def report(self, state: State) -> State:
        """What is reported in place of this state, the newest one."""
        time_s = state.time_s
        for fault in self._faults:
            if fault.instrument:
                known = (self._reported(fault, one) for one in state.readings)
                state = replace(state, readings=tuple(one for one in known if one is not None))
            elif fault.lasts(time_s):
                self._since[fault].append(state)
                state = STATE_FAULTS[fault.fault](self._since[fault])
        return state

    def _reported(self, fault: SensorFault, one: Reading) -> Reading | None:
        if one.instrument != fault.instrument:
            return one
        if not fault.lasts(one.time_s):
            self._good[fault] = one
            return one
        return READING_FAULTS[fault.fault](one, self._good.setdefault(fault, one))


class SensorFaults(RootModel[tuple[SensorFault, ...]]):
    """All faults of a run."""

    model_config = ConfigDict(frozen=True)

    root: tuple[SensorFault, ...] = Field((), max_length=100)


class _File(StrictModel):
    fault: SensorFaults


def _read(given: Any) -> Any:
    if not isinstance(given, str | Path):
        return given
    return read_form(Path(given), "the faults", "docs/scenarios.md shows one", _File).fault


def write_sensor_faults(path: Path, faults: SensorFaults) -> None:
    """As the option reads it."""
    lines = list[str]()
    for one in faults.root:
        values = one.model_dump(exclude_defaults=True).items()
        lines += ["[[fault]]", *(f"{name} = {json.dumps(value)}" for name, value in values)]
    write_whole(path, "\n".join(lines) + "\n")


SensorFaultsSetting = Annotated[
    SensorFaults | None,
    BeforeValidator(_read),
    Option(metavar="FILE"),
    Field(description="sensors that fail, when and how (TOML, docs/scenarios.md); None: none"),
]
"""Field of settings that accepts a file and holds all faults."""
