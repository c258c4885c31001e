"""Shows a measurement: a table on the terminal, and the files.

The picture shows how often each leg takes how long, and where a cycle's time goes as time passes.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.text import Text

from bayesrace.files import replacing, write_whole
from bayesrace.operation.report.style import INK, MUTED, figure_style, write_png
from bayesrace.operation.terminal.terminal import plain_table
from bayesrace.studies.latency.analysis import Analysis, Distribution, LatencyResult
from bayesrace.studies.latency.legs import ANSWER, BESIDE, LEGS

__all__ = ["RESULT", "print_report", "write_files"]

RESULT: Final = "latency.json"

_PARTS: Final = ("decode", "feedback", "encode")
"""Legs within the one before, or at the beginning of the one after."""

_STACKED: Final = ("state_transport", "release_wait", "compute", "actuation_transport")
"""Legs that follow one another from state to actuation."""

_COLOURS: Final = {
    ANSWER: INK,
    **dict(zip(_STACKED, ("#009E73", "#E69F00", "#0072B2", "#D55E00"), strict=True)),
    "wake_up": "#CC79A7",
    "bare_loop": MUTED,
    "round_trip": "#56B4E9",
}
"""Okabe and Ito's."""

_LEAST_US: Final = 1.0
"""Bottom of the logarithmic axis: what is shorter does not matter here."""

_POINTS: Final = 2000


def write_files(out: Path, analysis: Analysis) -> None:
    """``latency.json``, ``latency.png``, and ``legs.npz``: every value of each leg and of what ran
    beside, (2, n), times since the first state [s] above durations [ns]."""
    series = analysis.series
    values: dict[str, Any] = {leg: np.stack([one.at_s, one.ns]) for leg, one in series.items()}
    with replacing(out / "legs.npz") as path:
        np.savez_compressed(path, **values)
    _plot(out / "latency.png", analysis)
    write_whole(out / RESULT, analysis.result.model_dump_json(indent=1) + "\n")


def print_report(result: LatencyResult, console: Console) -> None:
    """Prints one row for each leg, then counts, clocks, memory and notes."""
    head = [result.car, result.track or "track not known", f"{result.rate_hz:g} Hz"]
    head += [f"{result.duration_s:.0f} s"] + ([f"load {result.load}"] if result.load else [])
    head += ["attached"] * result.attached + ["recorded"] * result.recorded
    console.print(Text(" · ".join(head), style="bold"))
    table = plain_table("leg [us]", "p50", "p90", "p99", "p99.9", "max", "±", "n", padding=0)
    for name, (title, _) in LEGS.items():
        if (leg := result.legs_us.get(name)) is not None:
            title = f"  {title}" if name in _PARTS else title
            style = "bold" if name == ANSWER else ""
            table.add_row(Text(title), *_cells(leg, leg.uncertainty_us), style=style)
    for name, title in BESIDE.items():
        if (beside := getattr(result, f"{name}_us")) is not None:
            table.add_row(title, *_cells(beside), style="dim")
    console.print(table)
    for line, alarming in _lines(result):
        console.print(Text(line, style="yellow" if alarming else ""))


def _cells(found: Distribution, margin_us: float = 0.0) -> list[str]:
    values = (found.p50, found.p90, found.p99, found.p999, found.max)
    numbers = [f"{value:.1f}" if value < 100 else f"{value:.0f}" for value in values]
    return [*numbers, f"{margin_us:.0f}" if margin_us else "", str(found.count)]


def _lines(result: LatencyResult) -> list[tuple[str, bool]]:
    """Lines below the table, and whether they are alarming."""
    complete = all(one.complete for one in result.traffic.values())
    drive = f"fallback cycles {result.fallbacks}"
    drive += "" if result.laps is None else f" · laps {result.laps}"
    if result.off_track_samples is not None:
        drive += f" · off track {result.off_track_samples} of {result.states} samples"
    text = result.clocks.text if result.clocks else "no state reports when an answer arrived"
    lines = [
        (_timing(result), False),
        ("; ".join(_messages(result)) or "messages not counted: no heartbeats", not complete),
        (drive, bool(result.off_track_samples)),
        (f"clocks: {text}", False),
    ]
    for name, one in result.rss.items():
        growth = f"{one.growth_bytes / 1024:.0f} kB on {one.begin_bytes / 2**20:.1f} MB"
        lines.append((f"resident memory of the {name} grew by {growth}", False))
    if result.attached:
        lines.append((f"what is bare is measured on this machine, {result.host}", False))
    return lines + [(note, True) for note in result.notes]


def _timing(result: LatencyResult) -> str:
    bare = result.bare_loop_us
    misses, skips = (f" (bare loop {bare.misses})", f" ({bare.skipped})") if bare else ("", "")
    line = f"{result.ticks} ticks: {result.deadline_misses} deadlines missed{misses}, "
    line += f"{result.skipped} skipped{skips}"
    line += "" if result.overruns is None else f", {result.overruns} overruns"
    line += f", {result.repeated_answers} repeated answers, {result.late_states} late states"
    if result.mean_period_us is not None and result.rate_error is not None:
        line += f"; mean period {result.mean_period_us:.1f} us ({result.rate_error:+.4%})"
    return line


def _messages(result: LatencyResult) -> Iterator[str]:
    for name, one in result.traffic.items():
        what = "in flight" if one.complete else "NOT ACCOUNTED FOR"
        left = f" {one.in_flight:+d} {what}" if one.in_flight else ""
        yield f"{name} {one.sent} sent = {one.received} received + {one.lost} lost{left}"


def _plot(path: Path, analysis: Analysis) -> None:
    """Writes the picture; what was not measured is left out of it."""
    result = analysis.result
    title = f"{result.car}, {result.rate_hz:g} Hz, {result.duration_s:.0f} s"
    title += f", {result.load} busy processes beside" if result.load else ""
    title += f": {result.deadline_misses} of {result.ticks} deadlines missed"
    title += f" (bare loop: {result.bare_loop_misses})" if result.bare_loop_us else ""
    with figure_style():
        figure = Figure(figsize=(11.0, 4.6), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
        _percentiles(left, analysis)
        _budget(right, analysis)
        for axes in (left, right):
            axes.yaxis.set_major_formatter(
                lambda us, _: f"{us:g} µs" if us < 1e3 else f"{us / 1e3:g} ms"
            )
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        write_png(figure, path, dpi=130)


def _percentiles(axes: Axes, analysis: Analysis) -> None:
    most = 10
    for name, colour in _COLOURS.items():
        if name in analysis.series:
            ns = np.sort(analysis.series[name].ns)
            most = max(most, len(ns))
            # Counted from the largest value, so that points are even on the logarithmic axis.
            k = np.unique(np.geomspace(1, len(ns), min(len(ns), _POINTS)).astype(int))
            axes.plot(
                len(ns) / k, np.maximum(ns[len(ns) - k] * 1e-3, _LEAST_US), color=colour,
                label=LEGS[name][0] if name in LEGS else BESIDE[name],
                linewidth=2.2 if name == ANSWER else 1.2,
            )  # fmt: skip
    axes.set(
        title="share of cycles below a time", xlabel="share of cycles, each step a nine more",
        xscale="log", yscale="log", xlim=(1.0, most * 1.1),
    )  # fmt: skip
    axes.set_ylim(bottom=_LEAST_US)
    nines = range(int(np.log10(most)) + 1)
    axes.set_xticks([10.0**k for k in nines], [f"{100 - 10.0 ** (2 - k):.7g} %" for k in nines])
    axes.minorticks_off()
    if axes.lines:
        axes.legend(loc="lower right", ncols=2)


def _budget(axes: Axes, analysis: Analysis) -> None:
    axes.set(title="where a cycle's time goes: medians as time passes", xlabel="time [s]")
    if not {ANSWER, *_STACKED} <= set(analysis.series):
        axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center")
        return
    edges_s, medians = analysis.edges_s, {}
    for leg in (*_STACKED, ANSWER):
        intervals = analysis.series[leg].intervals(edges_s)
        medians[leg] = [np.median(ns) * 1e-3 if len(ns) else np.nan for ns in intervals]
    tops = np.cumsum([np.zeros(len(edges_s) - 1), *(medians[leg] for leg in _STACKED)], axis=0)
    for k, leg in enumerate(_STACKED):
        axes.stairs(
            tops[k + 1], edges_s, baseline=tops[k], fill=True, color=_COLOURS[leg], linewidth=0,
            label=LEGS[leg][0],
        )  # fmt: skip
    axes.stairs(medians[ANSWER], edges_s, baseline=None, color=INK, label=LEGS[ANSWER][0])
    axes.set(
        xlim=(0.0, edges_s[-1]), ylim=(0.0, 1.45 * np.nanmax([*tops[-1], *medians[ANSWER], 1.0]))
    )
    axes.legend(loc="upper left", ncols=2, reverse=True)
