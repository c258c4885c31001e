"""Laps: prediction against the plant, and BayesRace against BestCase (sections 4.3 and 4.4); the
same on the paper's own racing line, which shows what of its lap times is the line and what the
controller; the F1TENTH car with and without correction (appendix B).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesrace.arrays import Floats
from bayesrace.operation.analysis.race import DrivenRun
from bayesrace.operation.look import look
from bayesrace.operation.report.maps import draw_edges, show_all
from bayesrace.operation.report.panels import input_figures
from bayesrace.operation.report.style import MUTED, WARNING, panel
from bayesrace.plant.simulator import PLANT
from bayesrace.raceline import RaceLine, RaceLineSettings
from bayesrace.raceline.friction import timed_line
from bayesrace.studies.paper.experiment import (
    ELSEWHERE,
    LAPS_OFF,
    LAPS_ON,
    Experiment,
    Figures,
    Finding,
    Section,
    at_most,
)
from bayesrace.tracks import Track
from bayesrace.tracks.spline import fit_arc_length
from bayesrace.tracks.tables import read_table
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["LIMITS", "course", "loop_sections", "line_section", "published_line"]
__all__ += ["tenth_section"]

_Laps = Mapping[tuple[str, bool], DrivenRun]
"""By controller, and whether with track constraints."""

_EVERY_S: Final = 0.5
_GREEN: Final = "#009E73"
_MEAN_M: Final = 0.034
_LARGEST_M: Final = 0.122
"""Published: position at the horizon's end, prediction against plant, with correction."""
_ETHZ_M: Final = 17.84
_STAGES: Final = {
    True: ("before", "section 4.3", "on", "the same pattern, drifting with time", 0.2),
    False: ("after", "section 4.4", "off, as in the paper", "nearly the same", 0.02),
}
"""Where laps with and without track constraints are compared, what the paper says of the inputs,
and the share of the largest steering angle that is taken for it."""
_HALF: Final = "ours is at least half of the published factor"
LIMITS: Final = "our training drive keeps to the car's limits and visits fewer states"
_YAW: Final = (
    "the published model multiplies the yaw acceleration by lf + lr, where the paper and ours "
    "divide; with that in our model, our WorstCase finishes, too (docs/paper.md)"
)
_TEXT: Final = (
    f"Every {_EVERY_S:g} s the controller's plan (red) and where the car goes by the planned "
    "inputs (green), without correction and with it; track constraints off, as the published "
    "WorstCase finishes no lap with them. A horizon is 0.4 s."
)
_COLUMNS: Final = "s_m", "x_m", "y_m", "vx_mps", "t_s"
_JOIN_M: Final = 0.4
"""Of the track, before the start line: left out of the path, which a spline closes there."""
_NEAR: Final = 0.02
_LINE_TEXT: Final = (
    "The racing line of the paper's code, closed, at its own speeds, driven by the controllers of "
    "the other sections. It brakes with up to 9.8 m/s², where the car can do 2: no controller "
    "keeps to its speeds. Where our laps on it are as long as the published ones, the gain in lap "
    "time of the other sections comes from their line, not from the controller."
)
_PUBLISHED_S: Final = 4.949
_PLAIN_S: Final = 8.351
"""Without correction, at this share of the line's speed."""
_SLOWED: Final = 0.6
_MAP2_M: Final = 27.44


def loop_sections(laps: _Laps, one: Experiment) -> list[Section]:
    """Mismatch; before the update; after the update."""
    return [
        _mismatch(laps, one),
        _comparison(laps, one, "bayesrace", True),
        _comparison(laps, one, "bayesrace-updated", False),
    ]


def _mismatch(laps: _Laps, one: Experiment) -> Section:
    figures: Figures = {}
    apart_m: dict[str, Floats] = {}
    runs = {name: laps[name, False] for name in ("worstcase", "bayesrace")}
    for name, run in runs.items():
        time_s, predicted, driven = _horizons(run, one)
        apart_m[name] = np.linalg.norm(predicted[:, -1] - driven[:, -1], axis=1)
        figure, axes = course(one.track, run.record.x[:, :2], look(name).name)
        axes.plot(*run.record.x[run.shown(), :2].T, color=MUTED, linewidth=0.8)
        shown = np.flatnonzero(np.diff(time_s // _EVERY_S, prepend=-1.0) > 0)
        for paths, colour in ((driven, _GREEN), (predicted, WARNING)):
            axes.plot(*paths[shown].transpose(2, 1, 0), color=colour, linewidth=1.4)
        figures[f"mismatch-{name}"] = figure
    plain_m, mean_m = (float(one.mean()) for one in apart_m.values())
    factor, same = plain_m / mean_m, _is_ethz(one.track)
    largest_m = float(apart_m["bayesrace"].max())
    at_end = "mismatch at the end of the horizon, with correction"
    findings = [
        at_most(f"mean {at_end}", _MEAN_M, mean_m, "m", LIMITS, same),
        at_most(f"largest {at_end}", _LARGEST_M, largest_m, "m", LIMITS, same),
        Finding("the correction divides the mean by", "6.5", f"{factor:.1f}", _HALF, factor > 3.25),
    ]
    for (name, run), what, reason in zip(
        runs.items(), ("without", "with"), (_YAW, ""), strict=True
    ):
        paper_s, own_s = LAPS_OFF[name].time_s or 0, run.result().lap_time_s
        findings.append(at_most(f"lap {what} correction", paper_s, own_s, "s", reason, same))
    return Section("Prediction against the car", "section 4.3", _TEXT, figures, findings)


def _horizons(run: DrivenRun, one: Experiment) -> tuple[Floats, Floats, Floats]:
    """Time of each plan of the lap (m,), its positions, and those that the car reaches by its
    inputs, (m, N + 1, 2)."""
    truth, plans = run.record.truth[run.shown()], run.record.telemetry
    shown = dict(zip(truth["seq"].tolist(), truth["time_s"].tolist(), strict=True))
    plans = plans[plans["plan_x"].astype(bool) & np.isin(plans["state_seq"], truth["seq"])]
    x = np.array(plans["plan_x"].tolist()).reshape(len(plans), -1, 7)
    u = np.array(plans["plan_u"].tolist()).reshape(len(plans), -1, 2)
    step, state, driven = PLANT.discretise(dynamic(one.car)), x[:, 0].T, [x[:, 0, :2]]
    for k in range(u.shape[1]):
        state = np.asarray(step(state, u[:, k].T))
        driven.append(state[:2].T)
    time_s = np.array([shown[seq] for seq in plans["state_seq"].tolist()])
    return time_s, x[..., :2], np.stack(driven, axis=1)


def _comparison(laps: _Laps, one: Experiment, controller: str, constraints: bool) -> Section:
    run, best = laps[controller, constraints], laps["bestcase", constraints]
    paper, same = LAPS_ON if constraints else LAPS_OFF, _is_ethz(one.track)
    findings, times = [], []
    for lap in (run, best):
        name, (time_s, off), own = look(lap.controller).name, paper[lap.controller], lap.result()
        left = own.off_track_samples
        findings.append(at_most(f"lap of {name}", time_s or 0, own.lap_time_s, "s", "", same))
        findings.append(at_most(f"samples off track, {name}", off or 0, left, "", "", same))
        times.append((time_s, own.lap_time_s))
    theirs, ours = (
        None if None in pair else abs(np.subtract(*pair)) for pair in zip(*times, strict=True)
    )
    findings.append(at_most("both laps apart", theirs or 0.0, ours, "s", "", same))
    stage, place, on, statement, limit = _STAGES[constraints]
    apart_rad, limit_rad = _unlike(run, best), limit * one.car.delta_max_rad
    what = "steering apart at the same place (RMS)"
    criterion = f"it is less than {100 * limit:g} % of the largest angle"
    ours_text, holds = f"{apart_rad:.4f} rad", apart_rad < limit_rad
    findings.append(Finding(what, statement, ours_text, criterion, holds))
    text = f"Position and inputs on the lap from standstill; track constraints {on}."
    title = f"BayesRace against BestCase, {stage} the update"
    return Section(title, place, text, _lap_figures(stage, [run, best], one), findings)


def _unlike(run: DrivenRun, best: DrivenRun) -> float:
    """RMS difference of the steering angle along the track [rad]."""
    s = np.linspace(0.0, float(best.on_track.progress_m[best.shown()].max()), 500)
    angles = []
    for one in (run, best):
        way = np.maximum.accumulate(one.on_track.progress_m[one.shown()])
        angles.append(np.interp(s, way, one.record.x[one.shown(), 6]))
    return float(np.sqrt(np.mean((angles[0] - angles[1]) ** 2)))


def _lap_figures(name: str, runs: Sequence[DrivenRun], one: Experiment) -> Figures:
    """Position and inputs of first laps."""
    figure, axes = course(one.track, runs[0].record.x[:, :2], "position")
    for run, dashes in zip(runs, ("solid", (0, (4, 2))), strict=True):
        xy, appearance = run.record.x[run.shown(), :2], look(run.controller)
        axes.plot(*xy.T, color=appearance.colour, linestyle=dashes, label=appearance.name)
    axes.legend(loc="best")
    inputs = zip(("drive", "angle", "rate"), input_figures(runs, one.track, one.car), strict=True)
    return {f"position-{name}": figure} | {f"{key}-{name}": drawn for key, drawn in inputs}


def course(track: Track | None, xy: Floats, title: str) -> tuple[Figure, Axes]:
    """Axes with the track, or with room for the points (n, 2) where it is not known."""
    edges = [] if track is None else [*track.boundaries(0.04)]
    corners = np.concatenate(edges or [xy])
    width, height = np.ptp(corners, axis=0)
    figure, axes = panel(min(max(4.3 * height / width + 0.8, 2.6), 6.0))
    if edges:
        draw_edges(axes, *edges)
    show_all(axes, corners)
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title)
    return figure, axes


def _lap_text(run: DrivenRun) -> str:
    """Time and excursions."""
    time_s, off = run.result().lap_time_s, run.result().off_track_samples
    return f"{'no lap' if time_s is None else f'{time_s:.3f} s'}, {off} samples off track"


def _is_ethz(track: Track) -> bool:
    """Whether published laps may be compared with."""
    return abs(track.length_m - _ETHZ_M) < 0.1


def published_line(path: Path, track: Track, car: Car) -> RaceLine:
    """The line of a published file, closed: its first lap, from standstill, with its speeds.

    Where the file drives on beyond a lap, at speed, the closed line has the speeds of that second
    pass. InputError for a file that cannot be read.
    """
    table, *_ = read_table(path, _COLUMNS)
    s = np.unwrap(track.project_path(table[:, 1:3]).s_m, period=track.length_m)
    lap = s < s[0] + track.length_m - _JOIN_M
    again = s[lap] + track.length_m
    speeds = np.where(again < s[-1], np.interp(again, s, table[:, 3]), table[lap, 3])
    curve = fit_arc_length(table[lap, 1:3])
    line = timed_line(track.name, curve, car, RaceLineSettings())
    v = np.interp(line.s_m, curve.knots, speeds, period=curve.period)
    step = np.diff(np.append(line.s_m, line.length_m))
    return replace(line, vx_mps=v, ax_mps2=(np.roll(v, -1) ** 2 - v**2) / (2 * step))


def line_section(one: Experiment, line: RaceLine, computed: _Laps) -> Section:
    """BayesRace and BestCase on ``line``; ``computed``: their laps in the other sections."""
    findings, gains = [], []
    same = _is_ethz(one.track)
    reason = "" if same else ELSEWHERE
    for paper, on in ((LAPS_OFF, False), (LAPS_ON, True)):
        for controller, weights in (("bayesrace", one.weights), ("bestcase", None)):
            run = one.drive(controller, weights, on, line=line)
            ours_s, faster_s = (
                lap.result().lap_time_s or np.nan for lap in (run, computed[controller, on])
            )
            published_s, off = paper[controller].time_s or np.nan, paper[controller].off_samples
            what = f"lap of {look(controller).name}, track constraints {'on' if on else 'off'}"
            left = f"{published_s:.3f} s, {off} samples off track"
            holds = abs(ours_s / published_s - 1) <= _NEAR if same else None
            criterion = f"ours is within {100 * _NEAR:g} % of the published one"
            findings.append(Finding(what, left, _lap_text(run), criterion, holds, reason))
            gains.append((ours_s - faster_s, published_s - faster_s))
    parts = ", ".join(f"{by_line:.3f} of {whole:.3f} s" for by_line, whole in gains)
    text = _LINE_TEXT + f" What the line makes of our gain, row by row: {parts}." * same
    return Section("On the paper's own racing line", "sections 4.3 and 4.4", text, {}, findings)


def tenth_section(one: Experiment) -> Section:
    """Laps with correction, without, and without at the published share of the speed."""
    corrected = one.drive("bayesrace", one.weights, constraints=False)
    plain = one.drive("worstcase", constraints=False)
    slowed = one.drive("worstcase", constraints=False, speed=_SLOWED)
    own, slow_s = corrected.result(), slowed.result().lap_time_s
    same = abs(one.track.length_m - _MAP2_M) < 0.1
    without = "without correction, at"
    what, ours, fails = f"{without} the line's speed", _lap_text(plain), "it finishes no lap"
    findings = [
        at_most("lap with correction", _PUBLISHED_S, own.lap_time_s, "s", "", same),
        Finding(what, "fails", ours, fails, not plain.finished),
        at_most(f"{without} {_SLOWED:g} of it", _PLAIN_S, slow_s, "s", _YAW, same),
    ]
    text = (
        f"Lap from standstill on {one.track.name}, trained on {one.train_track.name}, track "
        f"constraints off as in the published code. WorstCase is shown at {_SLOWED:g} of the "
        "racing line's speed, as published. "
        f"Tyres that never saturate gave up to {(own.lateral_max_mps2 or 0) / GRAVITY_MPS2:.2f} g "
        "to the corrected lap. Unlike the published plant, the car has limited actuators here."
    )
    figures = _lap_figures("tenth", [corrected, slowed], one)
    return Section("The F1TENTH car", "appendix B", text, figures, findings)
