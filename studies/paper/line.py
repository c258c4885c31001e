"""Laps on the paper's own racing line: what of its lap times is the line, what the controller."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.raceline import RaceLine, RaceLineSettings
from bayesrace.raceline.nodes import timed_line
from bayesrace.tracks import Track
from bayesrace.tracks.spline import fit_arc_length
from bayesrace.tracks.tables import read_table
from bayesrace.vehicles import CarParameters
from operation.analysis.published import LAPS_OFF, LAPS_ON
from operation.report.style import look
from studies.paper.experiment import Experiment
from studies.paper.finding import ELSEWHERE, Finding, Section
from studies.paper.loop import Laps, is_ethz, lap_text

__all__ = ["line_section", "published_line"]

_COLUMNS: Final = "s_m", "x_m", "y_m", "vx_mps", "t_s"
_JOIN_M: Final = 0.4
"""Of the track, before the start line: left out of the path, which a spline closes there."""
_NEAR: Final = 0.02
_TEXT: Final = (
    "The racing line of the paper's code, closed, at its own speeds, driven by the controllers of "
    "the other sections. It brakes with up to 9.8 m/s², where the car can do 2: no controller "
    "keeps to its speeds. Where our laps on it are as long as the published ones, the gain in lap "
    "time of the other sections comes from their line, not from the controller."
)


def published_line(path: Path, track: Track, car: CarParameters) -> RaceLine:
    """The line of a published file, closed: its first lap, from standstill, with its speeds.

    Where the file drives on beyond a lap, at speed, the closed line has the speeds of that second
    pass. InputError for a file that cannot be read.
    """
    table, _ = read_table(path, _COLUMNS)
    s = np.unwrap(track.project_path(table[:, 1:3]).s_m, period=track.length_m)
    lap = s < s[0] + track.length_m - _JOIN_M
    again = s[lap] + track.length_m
    speeds = np.where(again < s[-1], np.interp(again, s, table[:, 3]), table[lap, 3])
    curve = fit_arc_length(table[lap, 1:3])
    line = timed_line(track.name, curve, car, RaceLineSettings())
    v = np.interp(line.s_m, curve.knots, speeds, period=curve.period)
    step = np.diff(np.append(line.s_m, line.length_m))
    return replace(line, vx_mps=v, ax_mps2=(np.roll(v, -1) ** 2 - v**2) / (2 * step))


def line_section(one: Experiment, line: RaceLine, computed: Laps) -> Section:
    """BayesRace and BestCase on ``line``; ``computed``: their laps in the other sections."""
    findings, gains = [], []
    same = is_ethz(one.track)
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
            findings.append(Finding(what, left, lap_text(run), criterion, holds, reason))
            gains.append((ours_s - faster_s, published_s - faster_s))
    parts = ", ".join(f"{by_line:.3f} of {whole:.3f} s" for by_line, whole in gains)
    text = _TEXT + f" What the line makes of our gain, row by row: {parts}." * same
    return Section("On the paper's own racing line", "sections 4.3 and 4.4", text, {}, findings)
