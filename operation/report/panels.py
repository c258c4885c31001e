"""Panels over the arc length of the centreline: inputs and cornering; and the execution times of
the control steps."""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesrace.arrays import Floats
from bayesrace.operation.analysis.race import DrivenRun
from bayesrace.operation.look import look
from bayesrace.operation.report.style import INK, panel
from bayesrace.tracks import Track
from bayesrace.vehicles import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["cornering_figure", "input_figures", "solve_figure"]

_LEAP_M: Final = 1.0
_DOTS: Final = (0, (1, 2))


class _Lap:
    """One lap of a run over the arc length of the centreline, [0, length]."""

    def __init__(self, run: DrivenRun, track: Track, number: int) -> None:
        self.run = run
        self.rows = run.shown(number)
        self.s_m: Floats = run.on_track.progress_m[self.rows] - number * track.length_m
        self.colour = look(run.controller, run.number).colour

    def plot(self, axes: Axes, values: Floats) -> None:
        """Values (n,) of all samples of the run; a leap to another piece of the track is left
        open."""
        leaps = np.flatnonzero(np.abs(np.diff(self.s_m)) > _LEAP_M) + 1
        s, y = (
            np.insert(np.asarray(one, dtype=float), leaps, np.nan)
            for one in (self.s_m, values[self.rows])
        )
        axes.plot(s, y, color=self.colour, linewidth=1.1)


def _first_laps(runs: Sequence[DrivenRun], track: Track) -> list[_Lap]:
    """The first lap of each run, or its part that was driven."""
    return [_Lap(run, track, 0) for run in runs if len(run.record.truth) > 1]


def _flying_laps(runs: Sequence[DrivenRun], track: Track) -> list[_Lap]:
    """The best lap after the first of each run that has one."""
    return [
        _Lap(run, track, 1 + int(np.argmin(run.laps.times_s[1:])))
        for run in runs
        if len(run.laps.times_s) > 1
    ]


class _Trace(NamedTuple):
    """What a panel shows of each lap."""

    title: str
    label: str
    values: Callable[[DrivenRun], Floats]
    """One for each sample of a run."""
    limits: tuple[float, ...] = ()
    """Drawn as dotted lines."""


def _figure(track: Track, laps: Sequence[_Lap], trace: _Trace) -> Figure:
    figure, axes = panel(2.0)
    axes.set(title=trace.title, ylabel=trace.label, xlabel="distance along the centreline s [m]")
    axes.set_xlim(0, track.length_m)
    for limit in trace.limits:
        axes.axhline(limit, color=INK, linewidth=0.6, linestyle=_DOTS)
    for lap in laps:
        lap.plot(axes, trace.values(lap.run))
    return figure


def input_figures(runs: Sequence[DrivenRun], track: Track, car: Car) -> list[Figure]:
    """Drive command, steering angle and steering rate on the first lap, with the car's limits."""
    unit, angle, rate = car.drive.unit, car.delta_max_rad, car.delta_rate_max_radps
    command = f"d [{ ({'1': '–', 'm/s2': 'm/s²'}[unit]) }]"
    traces = (
        _Trace(car.drive.command, command, lambda run: _held(run, 0), (car.d_min, car.d_max)),
        _Trace("steering angle", "δ [rad]", lambda run: run.record.x[:, 6], (-angle, angle)),
        _Trace("steering rate", "dδ/dt [rad/s]", lambda run: _held(run, 1), (-rate, rate)),
    )
    return [_figure(track, _first_laps(runs, track), trace) for trace in traces]


def cornering_figure(runs: Sequence[DrivenRun], track: Track, friction: float | None) -> Figure:
    """Lateral acceleration, with what the ``friction`` of the line would allow, on the best flying
    lap, or else on the first."""
    trace = _Trace(
        "acceleration across the way",
        "to the left [g]",
        lambda run: run.record.lateral_mps2 / GRAVITY_MPS2,
        () if friction is None else (-friction, friction),
    )
    return _figure(track, _flying_laps(runs, track) or _first_laps(runs, track), trace)


def _held(run: DrivenRun, column: int) -> Floats:
    """An input for each state: the last state's is not known, it keeps the one before."""
    u = run.record.u[:, column]
    return np.append(u, u[-1:]) if len(u) else np.zeros(1)


def solve_figure(runs: Sequence[DrivenRun], period_us: float) -> Figure:
    """The share of each run's steps that took longer than a time, up to the sampling period."""
    figure, axes = panel(3.2)
    for run in runs:
        if len(times := np.maximum(run.record.telemetry["solve_us"], 1e-3)):
            colour = look(run.controller, run.number).colour
            axes.ecdf(times, complementary=True, color=colour, linewidth=1.3)
    axes.axvline(period_us, color=INK, linewidth=0.6, linestyle=_DOTS)
    axes.set(xscale="log", yscale="log", ylabel="share of the steps that took longer")
    axes.set_xlabel("execution time of one step [µs]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")  # plain numbers read better than powers
    return figure
