"""Shows a measurement: a table on the terminal, and the files."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.text import Text

from bayesrace.files import write_whole
from operation.terminal.terminal import plain_table
from studies.latency.analysis import Analysis
from studies.latency.legs import ANSWER, BESIDE, LEGS
from studies.latency.plot import plot
from studies.latency.results import Distribution, LatencyResult

__all__ = ["RESULT", "print_report", "write_files"]

RESULT: Final = "latency.json"

_PARTS: Final = ("decode", "feedback", "encode")
"""Legs within the one before, or at the beginning of the one after."""


def write_files(out: Path, analysis: Analysis) -> None:
    """``latency.json``, ``latency.png``, and a histogram log of each leg and of what ran beside."""
    for name, series in analysis.series.items():
        title = LEGS[name][0] if name in LEGS else BESIDE[name]
        series.write_log(out / f"{name}.hlog", title, analysis.begin_s, analysis.edges_s)
    plot(out / "latency.png", analysis)
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
