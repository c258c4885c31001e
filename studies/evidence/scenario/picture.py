"""A small picture of a scenario's drive: the way on the track, and the speed over time."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesrace.operation.report.maps import draw_edges, show_all
from bayesrace.operation.report.style import INK, MUTED, WARNING
from bayesrace.studies.evidence.scenario.checks import Drive
from bayesrace.studies.evidence.scenario.description import Scenario

__all__ = ["drive_picture"]

_DRIVEN = "#0072B2"


def drive_picture(scenario: Scenario, drive: Drive) -> Figure:
    """Where a fallback drove is orange, what is off the track red; events are numbered in order."""
    figure = Figure(figsize=(5.2, 1.9))
    on_track, over_time = figure.add_axes((0, 0, 0.4, 1)), figure.add_axes((0.5, 0.24, 0.48, 0.64))
    right, left = drive.track.boundaries()
    draw_edges(on_track, right, left)
    show_all(on_track, np.concatenate([right, left]))
    on_track.set_axis_off()
    xy, fallback, off = drive.truth["x"][:, :2], drive.level > 0, drive.beyond_edge_m > 0
    on_track.plot(xy[:, 0], xy[:, 1], color=_DRIVEN, linewidth=0.7)
    on_track.plot(*xy[fallback].T, ".", color="#D55E00", markersize=2)
    on_track.plot(*xy[off].T, ".", color=WARNING, markersize=3)
    over_time.plot(drive.time_s, drive.speed_mps, color=_DRIVEN, linewidth=0.9)
    over_time.set(xlabel="s", ylabel="m/s", xlim=(0, drive.time_s[-1]), ylim=(0, None))
    _mark_events(scenario, drive, on_track, over_time)
    return figure


def _mark_events(scenario: Scenario, drive: Drive, on_track: Axes, over_time: Axes) -> None:
    last_s = drive.time_s[-1]
    for number, one in enumerate(scenario.event, 1):
        if one.at_s > last_s:
            continue
        end_s = min(one.end_s, last_s)
        over_time.axvspan(one.at_s, max(end_s, one.at_s + 0.01 * last_s), color=MUTED, alpha=0.3)
        over_time.text(one.at_s, over_time.get_ylim()[1], str(number), color=INK, fontsize=7)
        x, y = drive.truth["x"][np.searchsorted(drive.time_s, one.at_s), :2]
        on_track.plot(x, y, "o", color=INK, markersize=3)
        on_track.annotate(str(number), (x, y), (3, 3), textcoords="offset points", fontsize=7)
