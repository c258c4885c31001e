"""Drives as identification needs them: what acted in each period, and what instruments measured.

A log with whole measured states, not estimated ones, has one instrument, ``state``, of all seven.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.arrays import AnyArray, Flags, Floats, Rows
from bayesrace.columns import Columns, LogColumns
from bayesrace.errors import InputError
from bayesrace.learning.dataset import consecutive
from bayesrace.learning.sources import log_facts
from bayesrace.messages import QUANTITIES, STATE
from bayesrace.vehicles import CarParameters, builtin_cars

__all__ = ["Readings", "Recorded", "Windows", "cut", "driven_car", "read_runs"]

_WHOLE: Final = "state"
_WHOLE_DEVIATION: Final = 1e-3
"""Of each number of a whole state, to begin with."""
_COLUMNS: Final = "seq run time_s x u_applied estimated readings"


@dataclass(frozen=True, eq=False)
class Readings:
    """Single numbers that were measured, (n,) each, in order of time."""

    time_s: Floats
    """Since the start of the run, as the instrument says."""
    of: Rows
    """Index of the quantity in ``QUANTITIES``."""
    instrument: Rows
    value: Floats
    """Headings without jumps."""
    deviation: Floats
    age_s: Floats
    """Time from the measurement to the state that reported it."""
    reading: Rows
    """Number of the reading that it came with."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """One run without a gap: ``u`` (n, 2) acted in the periods since its start."""

    step_s: float
    u: Floats
    readings: Readings
    angle_rad: float
    """Steering angle at the start, where it was measured; else 0."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Readings in windows of the same number of periods, (w, r) each, padded with weight 0."""

    run: Rows
    """Number of the run, (w,)."""
    first: Rows
    """Period of the run with which each begins, (w,)."""
    time_s: Floats
    """Since the beginning of the window."""
    of: Rows
    instrument: Rows
    value: Floats
    weight: Floats
    """One over the standard deviation; 0: not to be used."""
    reading: Rows

    def select(self, rows: Flags) -> "Windows":
        """Some of the windows."""
        return Windows(**{name: array[rows] for name, array in vars(self).items()})

    def without(self, bad: Flags) -> "Windows":
        """Without the readings of which a number is ``bad`` (w, r)."""
        rows = np.arange(len(bad))[:, None] << 32
        lost = np.isin(rows + self.reading, (rows + self.reading)[bad & (self.weight > 0)])
        return Windows(**{**vars(self), "weight": np.where(lost, 0.0, self.weight)})


def driven_car(
    paths: Sequence[Path], given: CarParameters | None, name: str
) -> tuple[CarParameters, str]:
    """The car to begin with, ``given`` or as the logs name it, and its name in the network.

    InputError if there is none, or if the logs hold another one.
    """
    if not paths:
        raise InputError("no log given; name the log of a drive, as 'bayesrace collect' writes it")
    facts = [log_facts(path) for path in paths]
    named = {one for fact in facts for one in fact.names}
    car = given or next((fact.car for fact in facts if fact.car), None)
    if car is None and len(named) == 1:
        car = builtin_cars().get(next(iter(named)))
    if car is None:
        raise InputError(f"no log names its car; name the file of {', '.join(named)} with --car")
    wanted = name or car.name
    for path, fact in zip(paths, facts, strict=True):
        if wanted not in fact.names:
            found = ", ".join(fact.names) or "no car"
            raise InputError(
                f"{path} holds states of {found}, not of '{wanted}': give the file of the car that "
                "drove with --car, or its name in the network with --name"
            )
    return car, wanted


def read_runs(paths: Sequence[Path], name: str) -> tuple[list[Recorded], tuple[str, ...]]:
    """The runs of the car of this name in the network, and the names of its instruments.

    What follows a lost state is left out: the steering angle commanded is the sum of all rates.
    InputError if there is no run, or if runs differ in their period.
    """
    instruments: dict[str, int] = {}
    runs: list[Recorded] = []
    for path in paths:
        states = LogColumns(path, {STATE: _COLUMNS}, name).read()[STATE]
        for run in dict.fromkeys(states["run"].tolist()):
            runs += _unbroken(states[states["run"] == run], instruments)
    if not runs:
        raise InputError(f"{paths[0]}: no two states follow one another; give the log of a drive")
    if len(steps := sorted({round(run.step_s, 6) for run in runs})) > 1:
        raise InputError(f"runs with periods of {steps} s cannot be mixed; give logs of one rate")
    return runs, tuple(instruments)


def _unbroken(states: Columns, instruments: dict[str, int]) -> list[Recorded]:
    """A run up to its first gap, if there is driving in it."""
    if len(states) < 2:
        return []
    step_s = float(np.median(np.diff(states["time_s"])))
    apart = ~consecutive(states, step_s)
    last = int(apart.argmax()) if apart.any() else len(apart)
    if last < 1:
        return []
    states = states[: last + 1]
    rows: list[tuple[float, ...]] = []
    begin_s, count = float(states["time_s"][0]), 0
    columns = (states[name].tolist() for name in ("time_s", "x", "estimated", "readings"))
    for time_s, x, estimated, readings in zip(*columns, strict=True):
        whole = {q: (value, _WHOLE_DEVIATION) for q, value in zip(QUANTITIES, x, strict=True)}
        given = [(one.instrument, one.time_s, one.values) for one in readings]
        for name, at_s, values in given if estimated else [(_WHOLE, time_s, whole)]:
            number, count = instruments.setdefault(name, len(instruments)), count + 1
            rows += [
                (at_s - begin_s, QUANTITIES.index(q), number, *pair, time_s - at_s, count)
                for q, pair in values.items()
            ]
    readings = _in_order(np.array(rows, dtype=np.float64).reshape(-1, 7))
    angle_rad = 0.0 if states["estimated"][0] else float(states["x"][0, 6])
    return [Recorded(step_s, states["u_applied"][1:], readings, angle_rad)]


def _in_order(rows: Floats) -> Readings:
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    time_s, of, instrument, value, deviation, age_s, reading = rows.T.copy()
    heading = of == QUANTITIES.index("psi")
    value[heading] = np.unwrap(value[heading])
    of, instrument, reading = (one.astype(np.int64) for one in (of, instrument, reading))
    return Readings(time_s, of, instrument, value, deviation, age_s, reading)


def cut(runs: Sequence[Recorded], periods: int, late_s: Floats) -> Windows:
    """All readings in windows of so many periods; ``late_s``: by how much the times of each
    instrument are late."""
    parts = []
    for number, run in enumerate(runs):
        one, length_s = run.readings, periods * run.step_s
        since_s = one.time_s - late_s[one.instrument]
        window = np.floor(since_s / length_s).astype(np.int64)
        for first in range(len(run.u) // periods):
            rows = np.flatnonzero(window == first)
            parts.append((number, first * periods, one.time_s[rows] - first * length_s, one, rows))
    width = max((len(rows) for *_, rows in parts), default=0)

    def padded(kind: type, columns: list[AnyArray]) -> AnyArray:
        table: AnyArray = np.zeros((len(parts), width), kind)
        for row, column in zip(table, columns, strict=True):
            row[: len(column)] = column
        return table

    return Windows(
        run=np.array([part[0] for part in parts], np.int64),
        first=np.array([part[1] for part in parts], np.int64),
        time_s=padded(float, [part[2] for part in parts]),
        of=padded(int, [one.of[rows] for *_, one, rows in parts]),
        instrument=padded(int, [one.instrument[rows] for *_, one, rows in parts]),
        value=padded(float, [one.value[rows] for *_, one, rows in parts]),
        weight=padded(float, [1 / one.deviation[rows] for *_, one, rows in parts]),
        reading=padded(int, [one.reading[rows] for *_, one, rows in parts]),
    )
