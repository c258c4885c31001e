"""Drives as identification needs them: what acted in each period, and what instruments measured.

A log with whole measured states, not estimated ones, has one instrument, ``state``, of all seven.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.arrays import Flags, Floats, Rows
from bayesrace.columns import Columns, LogColumns
from bayesrace.errors import InputError
from bayesrace.learning.dataset import consecutive
from bayesrace.messages import QUANTITIES, STATE

__all__ = ["WHOLE", "Drives", "Windows", "cut", "read_drives"]

WHOLE: Final = "state"
"""Instrument of whole states."""
_WHOLE_DEVIATION: Final = 1e-3
"""Of each number of a whole state, to begin with."""
_COLUMNS: Final = "seq run time_s x u_applied estimated readings"

_READING: Final = np.dtype([
    ("run", np.int64),
    ("time_s", np.float64),  # since the start of the run, as the instrument says
    ("of", np.int64),  # index of the quantity in QUANTITIES
    ("instrument", np.int64),
    ("value", np.float64),  # headings without jumps
    ("deviation", np.float64),
    ("age_s", np.float64),  # from the measurement to the state that reported it
    ("reading", np.int64),  # number of the reading that it came with
])  # fmt: skip
"""A single number that was measured."""


@dataclass(frozen=True, eq=False)
class Drives:
    """Runs without a gap, in periods of the same length."""

    step_s: float
    instruments: tuple[str, ...]
    u: list[Floats]
    """Inputs (n, 2) that acted in the periods since the start of each run."""
    angle_rad: list[float]
    """Steering angle at the start of each, where it was measured; else 0."""
    readings: Columns
    """All that was measured, by run and time."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Readings in windows of the same number of periods, (w, r) each, padded with weight 0."""

    run: Rows
    """Number of the run, (w,)."""
    first: Rows
    """Period of the run with which each begins, (w,)."""
    readings: Columns
    time_s: Floats
    """Since the beginning of the window, less the delays that it was cut with."""
    weight: Floats
    """One over the standard deviation; 0: not to be used."""

    def select(self, rows: Flags) -> "Windows":
        """Some of the windows."""
        return Windows(**{name: array[rows] for name, array in vars(self).items()})

    def without(self, bad: Flags) -> "Windows":
        """Without the readings of which a number is ``bad`` (w, r)."""
        reading = self.readings["reading"]
        lost = np.isin(reading, reading[bad & (self.weight > 0)])
        return Windows(**vars(self) | {"weight": np.where(lost, 0.0, self.weight)})


def read_drives(drivers: Mapping[Path, str]) -> Drives:
    """The runs in logs of a car, by its name in the network of each.

    What follows a lost state is left out: the steering angle commanded is the sum of all rates.
    InputError if there is no run, or if runs differ in their period.
    """
    instruments: dict[str, int] = {}
    runs: list[Columns] = []
    for path, name in drivers.items():
        states = LogColumns(path, {STATE: _COLUMNS}, name).read()[STATE]
        runs += [_unbroken(states[states["run"] == run]) for run in dict.fromkeys(states["run"])]
    runs = [run for run in runs if len(run) > 1]
    if not runs:
        listed = ", ".join(map(str, drivers))
        raise InputError(f"{listed}: no two states follow one another; give the log of a drive")
    if len(steps := sorted({round(_step_s(run), 6) for run in runs})) > 1:
        raise InputError(f"runs with periods of {steps} s cannot be mixed; give logs of one rate")
    rows: list[tuple[float, ...]] = []
    for number, run in enumerate(runs):
        _read(number, run, instruments, rows)
    readings = np.array(rows, _READING)
    return Drives(
        step_s=_step_s(runs[0]),
        instruments=tuple(instruments),
        u=[run["u_applied"][1:] for run in runs],
        angle_rad=[0.0 if run["estimated"][0] else float(run["x"][0, 6]) for run in runs],
        readings=_in_order(readings),
    )


def _step_s(states: Columns) -> float:
    return float(np.median(np.diff(states["time_s"])))


def _unbroken(states: Columns) -> Columns:
    """The states of a run up to its first gap."""
    if len(states) < 2:
        return states
    apart = ~consecutive(states, _step_s(states))
    return states[: 1 + (int(apart.argmax()) if apart.any() else len(apart))]


def _read(
    run: int, states: Columns, instruments: dict[str, int], rows: list[tuple[float, ...]]
) -> None:
    """Appends all numbers that were measured in a run."""
    begin_s = float(states["time_s"][0])
    columns = (states[name].tolist() for name in ("time_s", "x", "estimated", "readings"))
    reading = rows[-1][-1] if rows else 0
    for time_s, x, estimated, readings in zip(*columns, strict=True):
        whole = {q: (value, _WHOLE_DEVIATION) for q, value in zip(QUANTITIES, x, strict=True)}
        given = [(one.instrument, one.time_s, one.values) for one in readings]
        for name, at_s, values in given if estimated else [(WHOLE, time_s, whole)]:
            number, reading = instruments.setdefault(name, len(instruments)), reading + 1
            rows += [
                (run, at_s - begin_s, QUANTITIES.index(q), number, *pair, time_s - at_s, reading)
                for q, pair in values.items()
            ]


def _in_order(readings: Columns) -> Columns:
    readings = readings[np.lexsort((readings["time_s"], readings["run"]))]
    heading = readings["of"] == QUANTITIES.index("psi")
    readings["value"][heading] = np.unwrap(readings["value"][heading])
    return readings


def cut(drives: Drives, periods: int, late_s: Floats) -> Windows:
    """All readings in windows of so many periods of commands; ``late_s``: from the command to what
    each instrument says of it."""
    counts = np.array([len(u) // periods for u in drives.u])
    run = np.repeat(np.arange(len(counts)), counts)
    first = periods * (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts))
    one, length_s = drives.readings, periods * drives.step_s
    since_s = one["time_s"] - late_s[one["instrument"]]
    window = np.floor(since_s / length_s).astype(np.int64)
    inside = np.flatnonzero((window >= 0) & (window < counts[one["run"]]))
    window = window[inside] + (np.cumsum(counts) - counts)[one["run"][inside]]
    inside = inside[order := np.argsort(window, kind="stable")]
    window = window[order]
    column = np.arange(len(window)) - np.searchsorted(window, window)
    rows = np.full((len(run), int(column.max(initial=-1)) + 1), -1)
    rows[window, column] = inside
    time_s = since_s[rows] - (first * drives.step_s)[:, None]
    return Windows(run, first, one[rows], time_s, np.where(rows < 0, 0, 1 / one["deviation"][rows]))
