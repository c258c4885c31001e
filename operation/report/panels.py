"""Panels over the arc length of the centreline: time lost, speed, inputs, cornering, deviation,
caution; and the execution times of the control steps."""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline

from bayesrace.arrays import Floats
from bayesrace.operation.analysis.race import DrivenRun
from bayesrace.operation.report.style import INK, MUTED, look, panel
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = [
    "Lap",
    "first_laps",
    "input_figures",
    "lap_figures",
    "reference_of",
    "solve_figure",
    "time_figures",
]

_SLOW_MPS: Final = 0.05
_POINTS, _SMOOTH = 600, 0.015
_LEAP_M: Final = 1.0
_NEAR_MS: Final = 300.0
"""A lap that ends farther from the reference leaves the picture, so that the others remain
legible."""
_DASHES: Final = (0, (4, 2))
_DOTS: Final = (0, (1, 2))
_STANDING: Final = "first lap, from standstill"
_FLYING: Final = "best flying lap"


class Lap:
    """One lap of a run over the arc length of the centreline, [0, length]."""

    def __init__(self, run: DrivenRun, track: Track, number: int) -> None:
        self.run, self.length_m, self.number = run, track.length_m, number
        self.rows = run.shown(number)
        self.s_m: Floats = run.on_track.progress_m[self.rows] - number * track.length_m
        self.colour = look(run.controller, run.number).colour

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
        axes.plot(s, y, color=self.colour, linewidth=1.1)


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
    within: float = np.inf
    """The axis shows no more to both sides of 0."""
    dashed: tuple[Floats, Floats] | None = None
    """Arc lengths and values to compare with."""


def _panel(track: Track, title: str, label: str, height: float = 2.0) -> tuple[Figure, Axes]:
    figure, axes = panel(height)
    axes.set(title=title, ylabel=label, xlabel="distance along the centreline s [m]")
    axes.set_xlim(0, track.length_m)
    return figure, axes


def _figure(track: Track, laps: Sequence[Lap], trace: _Trace) -> Figure:
    figure, axes = _panel(track, trace.title, trace.label)
    for limit in trace.limits:
        axes.axhline(limit, color=INK, linewidth=0.6, linestyle=_DOTS)
    if trace.dashed is not None:
        axes.plot(*trace.dashed, color=MUTED, linewidth=0.9, linestyle=_DASHES)
    for lap in laps:
        lap.plot(axes, trace.values(lap.run))
    low, high = axes.get_ylim() if trace.floor is None else (trace.floor, axes.get_ylim()[1])
    axes.set_ylim(max(low, -trace.within), min(high, trace.within))
    return figure


def time_figures(runs: Sequence[DrivenRun], track: Track) -> list[Figure]:
    """Time behind the reference lap along the track: a line that rises loses time there."""
    figures = []
    both = {_STANDING: first_laps(runs, track), _FLYING: _flying_laps(runs, track)}
    for title, laps in both.items():
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
            axes.plot(s, behind_ms, color=lap.colour, linewidth=1.3)
            if abs(behind_ms[-1]) < _NEAR_MS:
                near_ms.extend(behind_ms)
        room = 0.05 * (max(near_ms) - min(near_ms))
        axes.set_ylim(min(near_ms) - room, max(near_ms) + room)
        figures.append(figure)
    return figures


def input_figures(runs: Sequence[DrivenRun], track: Track, car: Car) -> list[Figure]:
    """Drive command, steering angle and steering rate on the first lap, with the car's limits."""
    unit, angle, rate = car.drive.unit, car.delta_max_rad, car.delta_rate_max_radps
    command = f"d [{ ({'1': '–', 'm/s2': 'm/s²'}[unit]) }]"
    traces = (
        _Trace(car.drive.command, command, lambda run: _held(run, 0), (car.d_min, car.d_max)),
        _Trace("steering angle", "δ [rad]", lambda run: run.record.x[:, 6], (-angle, angle)),
        _Trace("steering rate", "dδ/dt [rad/s]", lambda run: _held(run, 1), (-rate, rate)),
    )
    return [_figure(track, first_laps(runs, track), trace) for trace in traces]


def lap_figures(
    runs: Sequence[DrivenRun],
    track: Track,
    line: RaceLine,
    car: Car,
    friction: float | None,
) -> dict[str, list[Figure]]:
    """Panels with all laps, by the section of the report.

    Speed and signed distance from the racing line on the first and on the best flying lap; inputs
    on the first; lateral acceleration, with what the ``friction`` of the line would allow, and slip
    on the flying one. Where there was caution, what the uncertainty of the model does on the first
    lap: how far off the plan's last stage may be, the speed that the reference is left with, and by
    how much what is not known of the model's mismatch widens its band.
    """
    first, flying = first_laps(runs, track), _flying_laps(runs, track)
    by_s = np.argsort(s_m := track.project_points(line.xy_m).s_m)[:: max(1, len(line.s_m) // 800)]
    of_line = s_m[by_s], line.vx_mps[by_s]
    beside = np.array([0.0, track.length_m]), np.zeros(2)
    reach = 0.75 * float(np.max(track.width_right_m + track.width_left_m))
    grip = () if friction is None else (-friction, friction)
    speed = _Trace("", "vx [m/s]", lambda run: run.record.x[:, 3], floor=0, dashed=of_line)
    deviation = _Trace("", "to the left [m]", lambda run: run.offset_m, within=reach, dashed=beside)
    cornering = (
        _Trace("acceleration across the way", "to the left [g]",
               lambda run: run.record.lateral_mps2 / GRAVITY_MPS2, grip),
        _Trace("slip of the body", "β [°]", lambda run: np.degrees(run.record.slip_rad)),
    )  # fmt: skip
    caution = (
        _Trace("uncertainty at the end of the plan", "either side [m]",
               lambda run: _of_states(run, _ends_of_tube(run)), floor=0),
        _Trace("speed of the reference", "share of the line's",
               lambda run: _of_states(run, run.record.telemetry["pace"]), floor=0),
        _Trace("band of the model", "widened by",
               lambda run: _of_states(run, run.record.telemetry["widening"]), floor=0),
    )  # fmt: skip
    cautious = [lap for lap in first if _is_cautious(lap.run)]
    both = {title: some for title, some in ((_STANDING, first), (_FLYING, flying)) if some}

    def on_both(trace: _Trace) -> list[Figure]:
        return [_figure(track, laps, trace._replace(title=title)) for title, laps in both.items()]

    return {
        "speed": on_both(speed),
        "deviation": on_both(deviation),
        "inputs": input_figures(runs, track, car),
        "cornering": [_figure(track, flying or first, trace) for trace in cornering],
        "caution": [_figure(track, cautious, trace) for trace in caution if cautious],
    }


def _held(run: DrivenRun, column: int) -> Floats:
    """An input for each state: the last state's is not known, it keeps the one before."""
    u = run.record.u[:, column]
    return np.append(u, u[-1:]) if len(u) else np.zeros(1)


def _is_cautious(run: DrivenRun) -> bool:
    telemetry = run.record.telemetry
    return any(map(any, telemetry["tube_m"])) or bool((telemetry["pace"] < 1).any())


def _ends_of_tube(run: DrivenRun) -> Floats:
    tubes = run.record.telemetry["tube_m"]
    return np.array([tube_m[-1] if tube_m else np.nan for tube_m in tubes])


def _of_states(run: DrivenRun, values: Floats) -> Floats:
    """The value of each state's cycle; NaN where there was none."""
    known = dict(zip(run.record.telemetry["state_seq"].tolist(), values, strict=True))
    return np.array([known.get(seq, np.nan) for seq in run.record.truth["seq"].tolist()])


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
