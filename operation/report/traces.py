"""Laps over the arc length of the centreline: time lost, speed, inputs, deviation."""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline

from bayesrace.arrays import Floats
from bayesrace.columns import Columns
from bayesrace.operation.analysis.race import DrivenRun
from bayesrace.operation.report.style import INK, MUTED, look, panel
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = [
    "Lap",
    "caution_figures",
    "cornering_figures",
    "deviation_figures",
    "first_laps",
    "input_figures",
    "reference_of",
    "speed_figures",
    "time_figures",
]

_SLOW_MPS: Final = 0.05
_POINTS, _SMOOTH = 600, 0.015
_LEAP_M: Final = 1.0
_NEAR_MS: Final = 300.0
"""A lap that ends farther from the reference leaves the picture, so that the others remain
legible."""
_DASHES: Final = (0, (4, 2))


class Lap:
    """One lap of a run over the arc length of the centreline, [0, length]."""

    def __init__(self, run: DrivenRun, track: Track, number: int) -> None:
        self.run, self.length_m, self.number = run, track.length_m, number
        self.rows = run.shown(number)
        self.s_m: Floats = run.on_track.progress_m[self.rows] - number * track.length_m

    def time_at(self, s: Floats) -> Floats:
        """Time since the start line at arc lengths (n,) [s]; the lap must be a finished one."""
        time_s = self.run.record.time_s[self.rows]
        progress = CubicSpline(time_s, self.s_m)  # smooth at standstill, as its inverse is not
        time = np.interp(s, np.maximum.accumulate(self.s_m), time_s)
        for _ in range(2):  # Newton's steps from the linear interpolation, which errs by 1 ms
            step = (s - progress(time)) / np.maximum(progress(time, 1), _SLOW_MPS)
            time = np.clip(time + step, time_s[0], time_s[-1])
        return np.asarray(time - time[0])

    def behind(self, other: "Lap") -> tuple[Floats, Floats]:
        """Arc lengths (n,) from the start line on, and the time behind another finished lap [s].

        Smoothed over :data:`_SMOOTH` of the lap: feet on a bent centreline jump by millimetres.
        """
        s: Floats = np.linspace(0.0, self.length_m, _POINTS)
        window = np.ones(round(_SMOOTH * _POINTS)) / round(_SMOOTH * _POINTS)
        padded = np.pad(self.time_at(s) - other.time_at(s), len(window) // 2, mode="edge")
        return s, np.convolve(padded, window, "valid")[:_POINTS]

    def plot(self, axes: Axes, values: Floats) -> None:
        """Values (n,) of all samples of the run; a leap to another piece of the track is left
        open."""
        leaps = np.flatnonzero(np.abs(np.diff(self.s_m)) > _LEAP_M) + 1
        s, y = (
            np.insert(np.asarray(one, dtype=float), leaps, np.nan)
            for one in (self.s_m, values[self.rows])
        )
        axes.plot(s, y, color=look(self.run.controller, self.run.number).colour, linewidth=1.1)


def first_laps(runs: Sequence[DrivenRun], track: Track) -> list[Lap]:
    """The first lap of each run, or its part that was driven."""
    return [Lap(run, track, 0) for run in runs if len(run.record.truth) > 1]


def _flying_laps(runs: Sequence[DrivenRun], track: Track) -> list[Lap]:
    """The best lap after the first of each run that has one."""
    return [
        Lap(run, track, 1 + int(np.argmin(run.laps.times_s[1:])))
        for run in runs
        if len(run.laps.times_s) > 1
    ]


def _both(runs: Sequence[DrivenRun], track: Track) -> dict[str, list[Lap]]:
    """The first and, where there are any, the best flying laps by their title."""
    laps = {
        "first lap, from standstill": first_laps(runs, track),
        "best flying lap": _flying_laps(runs, track),
    }
    return {title: some for title, some in laps.items() if some}


def reference_of(laps: Sequence[Lap]) -> Lap | None:
    """Of finished laps the one to compare with: BestCase's, or the fastest; None without any."""
    best = [lap for lap in laps if lap.run.controller == "bestcase"]
    return min(best or laps, key=lambda lap: lap.run.laps.times_s[lap.number], default=None)


class _Trace(NamedTuple):
    """What a panel shows of each lap."""

    title: str
    label: str
    values: Callable[[DrivenRun], Floats]
    """One for each sample of a run."""
    limits: tuple[float, ...] = ()
    """Drawn as dotted lines."""
    floor: float | None = None
    """Where the axis begins, if not where the values do."""


def _panel(track: Track, title: str, label: str, height: float = 2.0) -> tuple[Figure, Axes]:
    figure, axes = panel(height)
    axes.set(title=title, ylabel=label, xlabel="distance along the centreline s [m]")
    axes.set_xlim(0, track.length_m)
    return figure, axes


def _figures(track: Track, laps: Sequence[Lap], traces: Sequence[_Trace]) -> list[Figure]:
    """A panel for each trace, with all laps."""
    figures = []
    for trace in traces:
        figure, axes = _panel(track, trace.title, trace.label)
        for limit in trace.limits:
            axes.axhline(limit, color=INK, linewidth=0.6, linestyle=(0, (1, 2)))
        for lap in laps:
            lap.plot(axes, trace.values(lap.run))
        if trace.floor is not None:
            axes.set_ylim(trace.floor, None)
        figures.append(figure)
    return figures


def time_figures(runs: Sequence[DrivenRun], track: Track) -> list[Figure]:
    """Time behind the reference lap along the track: a line that rises loses time there."""
    figures = []
    for title, laps in _both(runs, track).items():
        finished = [lap for lap in laps if lap.run.finished]
        reference = reference_of(finished)
        if reference is None or len(finished) < 2:
            continue
        name = look(reference.run.controller, reference.run.number).name
        figure, axes = _panel(track, f"{title}: time behind {name}", "Δt [ms]", 2.4)
        near_ms = [0.1]
        for lap in finished:
            s, behind_s = lap.behind(reference)
            behind_ms = 1e3 * behind_s
            colour = look(lap.run.controller, lap.run.number).colour
            axes.plot(s, behind_ms, color=colour, linewidth=1.3)
            if abs(behind_ms[-1]) < _NEAR_MS:
                near_ms.extend(behind_ms)
        room = 0.05 * (max(near_ms) - min(near_ms))
        axes.set_ylim(min(near_ms) - room, max(near_ms) + room)
        figures.append(figure)
    return figures


def speed_figures(runs: Sequence[DrivenRun], track: Track, line: RaceLine) -> list[Figure]:
    """Speed on the first and on the best flying lap; the racing line's is that of a flying lap."""
    figures = []
    on_line = track.project_points(line.xy_m)
    order = np.argsort(on_line.s_m)[:: max(1, len(line.s_m) // 800)]
    for title, laps in _both(runs, track).items():
        figure, axes = _panel(track, title, "vx [m/s]")
        axes.plot(
            on_line.s_m[order], line.vx_mps[order], color=MUTED, linewidth=0.9, linestyle=_DASHES
        )
        for lap in laps:
            lap.plot(axes, lap.run.record.x[:, 3])
        axes.set_ylim(0, None)
        figures.append(figure)
    return figures


def deviation_figures(runs: Sequence[DrivenRun], track: Track) -> list[Figure]:
    """Signed distance from the racing line on the first and on the best flying lap."""
    figures = []
    reach = float(np.max(track.width_right_m + track.width_left_m)) / 2
    for title, laps in _both(runs, track).items():
        figure, axes = _panel(track, title, "to the left [m]")
        axes.axhline(0, color=MUTED, linewidth=0.8, linestyle=_DASHES)
        for lap in laps:
            lap.plot(axes, lap.run.offset_m)
        largest = max(float(np.abs(lap.run.offset_m[lap.rows]).max()) for lap in laps)
        limit = min(1.08 * largest, 1.5 * reach)
        axes.set_ylim(-limit, limit)
        figures.append(figure)
    return figures


def input_figures(runs: Sequence[DrivenRun], track: Track, car: CarParameters) -> list[Figure]:
    """Drive command and steering on the first lap, with the car's limits."""
    unit, angle, rate = car.drive.unit, car.delta_max_rad, car.delta_rate_max_radps
    command = f"d [{ ({'1': '–', 'm/s2': 'm/s²'}[unit]) }]"
    traces = (
        _Trace(car.drive.command, command, lambda run: _held(run, 0), (car.d_min, car.d_max)),
        _Trace("steering angle", "δ [rad]", lambda run: run.record.x[:, 6], (-angle, angle)),
        _Trace("steering rate", "dδ/dt [rad/s]", lambda run: _held(run, 1), (-rate, rate)),
    )
    return _figures(track, first_laps(runs, track), traces)


def _held(run: DrivenRun, column: int) -> Floats:
    """An input for each state: the last state's is not known, it keeps the one before."""
    u = run.record.u[:, column]
    return np.append(u, u[-1:]) if len(u) else np.zeros(1)


def cornering_figures(
    runs: Sequence[DrivenRun], track: Track, friction: float | None
) -> list[Figure]:
    """Lateral acceleration, with what the friction would allow, and slip on the flying lap."""
    limits = () if friction is None else (-friction, friction)
    traces = (
        _Trace("acceleration across the way", "to the left [g]",
               lambda run: run.record.lateral_mps2 / GRAVITY_MPS2, limits),
        _Trace("slip of the body", "β [°]", lambda run: np.degrees(run.record.slip_rad)),
    )  # fmt: skip
    return _figures(track, _flying_laps(runs, track) or first_laps(runs, track), traces)


def caution_figures(runs: Sequence[DrivenRun], track: Track) -> list[Figure]:
    """What the uncertainty of the model does on the first lap: how far off the plan's last stage
    may be, the speed that the reference is left with, and by how much the errors that were seen
    have widened the model's band. Nothing if there was no caution."""

    def cautious(telemetry: Columns) -> bool:
        return any(map(any, telemetry["tube_m"])) or bool((telemetry["pace"] < 1).any())

    laps = [lap for lap in first_laps(runs, track) if cautious(lap.run.record.telemetry)]
    traces = (
        _Trace("uncertainty at the end of the plan", "either side [m]",
               lambda run: _of_states(run, _ends_of_tube(run.record.telemetry)), floor=0),
        _Trace("speed of the reference", "share of the line's",
               lambda run: _of_states(run, run.record.telemetry["pace"]), floor=0),
        _Trace("band of the model", "widened by",
               lambda run: _of_states(run, run.record.telemetry["widening"]), floor=0),
    )  # fmt: skip
    return _figures(track, laps, traces) if laps else []


def _ends_of_tube(telemetry: Columns) -> Floats:
    return np.array([tube_m[-1] if tube_m else np.nan for tube_m in telemetry["tube_m"]])


def _of_states(run: DrivenRun, values: Floats) -> Floats:
    """The value of each state's cycle; NaN where there was none."""
    known = dict(zip(run.record.telemetry["state_seq"].tolist(), values, strict=True))
    return np.array([known.get(seq, np.nan) for seq in run.record.truth["seq"].tolist()])
