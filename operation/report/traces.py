"""Panels over the arc length of the centreline: time lost, speed, inputs, deviation."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesrace.arrays import Floats
from bayesrace.columns import Columns
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2
from operation.analysis.race import DrivenRun
from operation.report.canvas import panel
from operation.report.laps import Lap, first_laps, flying_laps, reference_of
from operation.report.style import INK, MUTED, look

__all__ = [
    "caution_figures",
    "cornering_figures",
    "deviation_figures",
    "input_figures",
    "speed_figures",
    "time_figures",
]


_LEAP_M: Final = 1.0
_NEAR_MS: Final = 300.0
"""A lap that ends farther from the reference leaves the picture, so that the others remain
legible."""
_DASHES: Final = (0, (4, 2))


def _panel(track: Track, title: str, label: str, height: float = 2.0) -> tuple[Figure, Axes]:
    figure, axes = panel(height)
    axes.set(title=title, ylabel=label, xlabel="distance along the centreline s [m]")
    axes.set_xlim(0, track.length_m)
    return figure, axes


def _plot(axes: Axes, lap: Lap, values: Floats) -> None:
    """Values (n,) of the lap's samples; a leap to another piece of the track is left open."""
    leaps = np.flatnonzero(np.abs(np.diff(lap.s_m)) > _LEAP_M) + 1
    s, y = (np.insert(np.asarray(one, dtype=float), leaps, np.nan) for one in (lap.s_m, values))
    axes.plot(s, y, color=look(lap.run.controller, lap.run.number).colour, linewidth=1.1)


def _both(runs: Sequence[DrivenRun], track: Track) -> dict[str, list[Lap]]:
    """The first and, where there are any, the best flying laps by their title."""
    laps = {
        "first lap, from standstill": first_laps(runs, track),
        "best flying lap": flying_laps(runs, track),
    }
    return {title: some for title, some in laps.items() if some}


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
            axes.plot(
                s, behind_ms, color=look(lap.run.controller, lap.run.number).colour, linewidth=1.3
            )
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
            _plot(axes, lap, lap.run.record.x[lap.rows, 3])
        axes.set_ylim(0, None)
        figures.append(figure)
    return figures


def input_figures(runs: Sequence[DrivenRun], track: Track, car: CarParameters) -> list[Figure]:
    """Drive command and steering on the first lap, with the car's limits."""
    command, unit = car.drive.command, {"1": "–", "m/s2": "m/s²"}[car.drive.unit]
    rows: list[tuple[str, str, tuple[float, float], Callable[[DrivenRun], Floats]]] = [
        (command, f"d [{unit}]", (car.d_min, car.d_max), lambda run: _held(run.record.u[:, 0])),
        (
            "steering angle", "δ [rad]", (-car.delta_max_rad, car.delta_max_rad),
            lambda run: run.record.x[:, 6],
        ),
        (
            "steering rate", "dδ/dt [rad/s]",
            (-car.delta_rate_max_radps, car.delta_rate_max_radps),
            lambda run: _held(run.record.u[:, 1]),
        ),
    ]  # fmt: skip
    figures = []
    for title, label, limits, values in rows:
        figure, axes = _panel(track, title, label)
        for limit in limits:
            axes.axhline(limit, color=INK, linewidth=0.6, linestyle=(0, (1, 2)))
        for lap in first_laps(runs, track):
            _plot(axes, lap, values(lap.run)[lap.rows])
        figures.append(figure)
    return figures


def cornering_figures(
    runs: Sequence[DrivenRun], track: Track, friction: float | None
) -> list[Figure]:
    """Lateral acceleration, with what the friction would allow, and slip on the flying lap."""
    laps = flying_laps(runs, track) or first_laps(runs, track)
    rows: list[tuple[str, str, Callable[[DrivenRun], Floats], float | None]] = [
        (
            "acceleration across the way", "to the left [g]",
            lambda run: run.record.lateral_mps2 / GRAVITY_MPS2, friction,
        ),
        ("slip of the body", "β [°]", lambda run: np.degrees(run.record.slip_rad), None),
    ]  # fmt: skip
    figures = []
    for title, label, values, limit in rows:
        figure, axes = _panel(track, title, label)
        for side in () if limit is None else (-limit, limit):
            axes.axhline(side, color=INK, linewidth=0.6, linestyle=(0, (1, 2)))
        for lap in laps:
            _plot(axes, lap, values(lap.run)[lap.rows])
        figures.append(figure)
    return figures


def _held(u: Floats) -> Floats:
    """One value a state: the last state's input is not known, it keeps the one before."""
    return np.append(u, u[-1:]) if len(u) else np.zeros(1)


def caution_figures(runs: Sequence[DrivenRun], track: Track) -> list[Figure]:
    """What the uncertainty of the model does on the first lap: how far off the plan's last stage
    may be, the speed that the reference is left with, and by how much the errors that were seen
    have widened the model's band. Nothing if there was no caution."""
    laps = [
        lap
        for lap in first_laps(runs, track)
        if any(map(any, lap.run.record.telemetry["tube_m"]))
        or (lap.run.record.telemetry["pace"] < 1).any()
    ]
    rows: list[tuple[str, str, Callable[[Columns], Floats]]] = [
        ("uncertainty at the end of the plan", "either side [m]", _last_of_tube),
        ("speed of the reference", "share of the line's", lambda rows: rows["pace"]),
        ("band of the model", "widened by", lambda rows: rows["widening"]),
    ]
    figures = []
    for title, label, values in rows if laps else ():
        figure, axes = _panel(track, title, label)
        for lap in laps:
            _plot(axes, lap, _of_states(lap.run, values)[lap.rows])
        axes.set_ylim(0, None)
        figures.append(figure)
    return figures


def _last_of_tube(telemetry: Columns) -> Floats:
    return np.array([tube_m[-1] if tube_m else np.nan for tube_m in telemetry["tube_m"]])


def _of_states(run: DrivenRun, values: Callable[[Columns], Floats]) -> Floats:
    """A value of each state's cycle; NaN where there was none."""
    cycles = run.record.telemetry
    known = dict(zip(cycles["state_seq"].tolist(), values(cycles), strict=True))
    return np.array([known.get(seq, np.nan) for seq in run.record.truth["seq"].tolist()])


def deviation_figures(runs: Sequence[DrivenRun], track: Track) -> list[Figure]:
    """Signed distance from the racing line on the first and on the best flying lap."""
    figures = []
    reach = float(np.max(track.width_right_m + track.width_left_m)) / 2
    for title, laps in _both(runs, track).items():
        figure, axes = _panel(track, title, "to the left [m]")
        axes.axhline(0, color=MUTED, linewidth=0.8, linestyle=_DASHES)
        for lap in laps:
            _plot(axes, lap, lap.run.offset_m[lap.rows])
        largest = max(float(np.abs(lap.run.offset_m[lap.rows]).max()) for lap in laps)
        limit = min(1.08 * largest, 1.5 * reach)
        axes.set_ylim(-limit, limit)
        figures.append(figure)
    return figures
