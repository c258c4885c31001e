"""What happened along the lap: speed, time lost, inputs, deviation."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import CarParameters
from experiments.analysis import DrivenRun
from experiments.report.style import INK, MUTED, PAGE_WIDTH, look

__all__ = ["deviation_figure", "inputs_figure", "speed_figure"]

Floats = NDArray[np.float64]

_LEAP_M: Final = 1.0


class _Lap:
    """One lap of a run over the arc length of the centreline, [0, length]."""

    def __init__(self, run: DrivenRun, track: Track, number: int) -> None:
        self.run, self.length_m = run, track.length_m
        progress = run.on_track.progress_m
        self.rows = run.shown(number)
        self.s_m = progress[self.rows] - number * track.length_m

    def plot(self, axes: Axes, values: Floats, width: float = 1.2) -> None:
        """Values (n,) of the lap's samples; a leap to another piece of the track is left open."""
        s = np.asarray(self.s_m, dtype=float)
        leaps = np.flatnonzero(np.abs(np.diff(s)) > _LEAP_M) + 1
        appearance = look(self.run.controller)
        axes.plot(
            np.insert(s, leaps, np.nan),
            np.insert(values, leaps, np.nan),
            color=appearance.colour,
            linewidth=width,
            label=appearance.name,
        )

    def time_at(self, s: Floats) -> Floats:
        """Time since the lap's beginning at arc lengths s; the lap must be a finished one."""
        order = np.maximum.accumulate(self.s_m)
        time = self.run.record.time_s[self.rows]
        return np.asarray(np.interp(s, order, time) - np.interp(0.0, order, time))


def _first_laps(runs: Sequence[DrivenRun], track: Track) -> list[_Lap]:
    return [_Lap(run, track, 0) for run in runs if len(run.record.truth) > 1]


def _flying_laps(runs: Sequence[DrivenRun], track: Track) -> list[_Lap]:
    found = []
    for run in runs:
        times = run.laps.times_s
        if len(times) > 1:
            found.append(_Lap(run, track, 1 + int(np.argmin(times[1:]))))
    return found


def _figure(heights: Sequence[float], track: Track) -> tuple[Figure, list[Axes]]:
    total = sum(heights) + 0.45 * len(heights) + 0.4
    figure = Figure(figsize=(PAGE_WIDTH, total))
    grid = figure.subplots(
        len(heights), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    )
    panels = list(grid[:, 0])
    for axes in panels:
        axes.set_xlim(0, track.length_m)
    panels[-1].set_xlabel("distance along the centreline s [m]")
    figure.align_ylabels(panels)
    figure.subplots_adjust(
        left=0.06, right=0.99, top=1 - 0.42 / total, bottom=0.4 / total, hspace=0.3
    )
    return figure, panels


def _legend(figure: Figure, runs: Sequence[DrivenRun], more: Sequence[Line2D] = ()) -> None:
    looks = [look(run.controller) for run in runs if len(run.record.truth) > 1]
    lines = [Line2D([], [], color=item.colour, linewidth=2, label=item.name) for item in looks]
    figure.legend(handles=[*lines, *more], loc="upper right", ncols=len(lines) + len(more))


def speed_figure(runs: Sequence[DrivenRun], track: Track, line: RaceLine) -> Figure:
    """Speed on the first and on the best flying lap, and the time lost to the best lap on the way.

    The racing line's speed is that of a flying lap.
    """
    first, flying = _first_laps(runs, track), _flying_laps(runs, track)
    finished = [lap for lap in first if lap.run.finished]
    heights = [1.9] + ([1.9] if flying else []) + ([1.1] if len(finished) > 1 else [])
    figure, panels = _figure(heights, track)
    on_line = track.project_points(line.xy_m)
    order = np.argsort(on_line.s_m)[:: max(1, len(line.s_m) // 800)]
    titles = ("first lap, from standstill", "best flying lap")
    for axes, laps, title in zip(
        panels, [first, flying] if flying else [first], titles, strict=False
    ):
        axes.plot(
            on_line.s_m[order],
            line.vx_mps[order],
            color=MUTED,
            linewidth=0.9,
            linestyle=(0, (4, 2)),
        )
        for lap in laps:
            lap.plot(axes, lap.run.record.x[lap.rows, 3])
        axes.set(title=title, ylabel="vx [m/s]", ylim=(0, None))
    if len(finished) > 1:
        _draw_lost_time(panels[-1], finished, track)
    racing_line = Line2D(
        [], [], color=MUTED, linewidth=1, linestyle=(0, (4, 2)), label="racing line"
    )
    _legend(figure, runs, [racing_line])
    return figure


def _draw_lost_time(axes: Axes, laps: Sequence[_Lap], track: Track) -> None:
    best = min(laps, key=lambda lap: lap.run.laps.times_s[0])
    s = np.linspace(0.0, track.length_m, 500)
    reference = best.time_at(s)
    for lap in laps:
        appearance = look(lap.run.controller)
        axes.plot(s, lap.time_at(s) - reference, color=appearance.colour)
    name = look(best.run.controller).name
    axes.set(title=f"first lap: time lost to {name}, the fastest", ylabel="Δt [s]")


def inputs_figure(runs: Sequence[DrivenRun], track: Track, car: CarParameters) -> Figure:
    """Duty cycle and steering on the first lap, with the car's limits."""
    figure, panels = _figure([1.5, 1.5, 1.3], track)
    rows: list[tuple[str, str, tuple[float, float], Callable[[DrivenRun], Floats]]] = [
        ("duty cycle d, as it acted", "d [–]", (car.d_min, car.d_max), _duty),
        (
            "steering angle δ",
            "δ [rad]",
            (-car.delta_max_rad, car.delta_max_rad),
            lambda run: run.record.x[:, 6],
        ),
        (
            "steering rate, as it acted",
            "dδ/dt [rad/s]",
            (-car.delta_rate_max_radps, car.delta_rate_max_radps),
            _steering_rate,
        ),
    ]
    laps = _first_laps(runs, track)
    for axes, (title, label, limits, values) in zip(panels, rows, strict=True):
        for limit in limits:
            axes.axhline(limit, color=INK, linewidth=0.6, linestyle=(0, (1, 2)))
        for lap in laps:
            lap.plot(axes, values(lap.run)[lap.rows], width=0.9)
        axes.set(title=title, ylabel=label)
    dotted = Line2D([], [], color=INK, linewidth=0.8, linestyle=(0, (1, 2)), label="limit")
    _legend(figure, runs, [dotted])
    return figure


def _duty(run: DrivenRun) -> Floats:
    return _held(run.record.u[:, 0])


def _steering_rate(run: DrivenRun) -> Floats:
    return _held(run.record.u[:, 1])


def _held(u: Floats) -> Floats:
    """One value a state: the last state's input is not known, it keeps the one before."""
    return np.append(u, u[-1:]) if len(u) else np.zeros(1)


def deviation_figure(runs: Sequence[DrivenRun], track: Track) -> Figure:
    """Signed distance from the racing line on the first and on the best flying lap."""
    first, flying = _first_laps(runs, track), _flying_laps(runs, track)
    figure, panels = _figure([1.6, 1.6] if flying else [1.8], track)
    titles = ("first lap, from standstill", "best flying lap")
    reach = float(np.max(track.width_right_m + track.width_left_m)) / 2
    for axes, laps, title in zip(panels, (first, flying), titles, strict=False):
        axes.axhline(0, color=MUTED, linewidth=0.8, linestyle=(0, (4, 2)))
        for lap in laps:
            lap.plot(axes, lap.run.offset_m[lap.rows])
        largest = max(float(np.abs(lap.run.offset_m[lap.rows]).max()) for lap in laps)
        limit = min(1.08 * largest, 1.5 * reach)
        axes.set(title=title, ylabel="to the left [m]", ylim=(-limit, limit))
    _legend(figure, runs)
    return figure
