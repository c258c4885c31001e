"""The report: a table on the terminal, and the files."""

from pathlib import Path
from typing import Any, Final

from hdrh.log import HistogramLogWriter
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bayesrace.files import replacing, write_whole
from experiments.latency.bare_loop import BareRun
from experiments.latency.legs import ANSWER, LEGS
from experiments.latency.plot import plot
from experiments.latency.results import Distribution, LatencyResult

__all__ = ["RESULT", "print_report", "write_files"]

RESULT: Final = "latency.json"
_PICTURE: Final = "latency.png"
_BARE: Final = "bare_loop.hlog"

_PARTS: Final = ("decode", "feedback", "encode")
"""Legs within the one before, or at the beginning of the one after."""


def write_files(
    out: Path,
    result: LatencyResult,
    histograms: dict[str, Any],
    medians: dict[str, list[tuple[float, float]]],
    bare: BareRun | None,
) -> None:
    """``latency.json``, ``latency.png``, and the bare loop's histogram log beside the legs'."""
    write_whole(out / RESULT, result.model_dump_json(indent=1) + "\n")
    if bare is not None:
        with replacing(out / _BARE) as part, part.open("w", encoding="ascii") as file:
            log = HistogramLogWriter(file)
            log.output_comment("[bayesrace latency: bare loop, wake-up error; values in ns]")
            log.output_log_format_version()
            log.output_legend()
            log.output_interval_histogram(bare.histogram, 1e-6, result.duration_s, 1e3)
    plot(out / _PICTURE, result, histograms, medians, None if bare is None else bare.histogram)


def print_report(result: LatencyResult, console: Console) -> None:
    """One row a leg, then what else is to be known."""
    head = f"{result.car} · {result.track or 'track not known'} · {result.rate_hz:g} Hz"
    head += f" · {result.duration_s:.0f} s" + (f" · load {result.load}" if result.load else "")
    console.print(Text(head + (" · attached" if result.attached else ""), style="bold"))
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 0, 0, 1), pad_edge=False)
    table.add_column("leg [us]", no_wrap=True)
    for name in ("p50", "p90", "p99", "p99.9", "max", "±", "n"):
        table.add_column(name, justify="right", no_wrap=True)
    for leg in LEGS:
        found = result.legs_us.get(leg.name)
        if found is None:
            continue
        title = f"  {leg.title}" if leg.name in _PARTS else leg.title
        margin = f"{found.uncertainty_us:.0f}" if found.uncertainty_us else ""
        style = "bold" if leg.name == ANSWER else ""
        table.add_row(Text(title), *_cells(found, margin), style=style)
    if result.bare_loop_us is not None:
        table.add_row("bare loop's wake-up error", *_cells(result.bare_loop_us, ""), style="dim")
    console.print(table)
    for line, style in _lines(result):
        console.print(Text(line, style=style))


def _cells(found: Distribution, margin: str) -> list[str]:
    values = (found.p50, found.p90, found.p99, found.p999, found.max)
    return [*(_number(value) for value in values), margin, str(found.count)]


def _number(value: float) -> str:
    return f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _lines(result: LatencyResult) -> list[tuple[str, str]]:
    lines = [(_timing(result), ""), (_messages(result), _alarm(not _complete(result)))]
    drive = f"fallback cycles {result.fallbacks}"
    if result.laps is not None:
        drive += f" · laps {result.laps}"
    if result.off_track_samples is not None:
        drive += f" · off track {result.off_track_samples} of {result.states} samples"
    lines.append((drive, _alarm(bool(result.off_track_samples))))
    if result.rss_growth_bytes is not None:
        each = ", ".join(
            f"{name} {one.growth_bytes / 1024:.0f} kB on {one.begin_bytes / 2**20:.1f} MB"
            for name, one in result.rss.items()
        )
        lines.append((f"resident memory grew by {each}", ""))
    lines.append((f"clocks: {result.clocks.text}", ""))
    if result.attached:
        lines.append((f"the bare loop is that of this machine, {result.host}", ""))
    return lines + [(note, "yellow") for note in result.notes]


def _alarm(true: bool) -> str:
    return "yellow" if true else ""


def _timing(result: LatencyResult) -> str:
    bare = result.bare_loop_us
    line = (
        f"{result.ticks} ticks: {result.deadline_misses} deadlines missed "
        f"(bare loop {result.bare_loop_misses}), {result.skipped} skipped "
        f"({0 if bare is None else bare.skipped}), {result.overruns} overruns"
    )
    if result.mean_period_us is not None and result.rate_error is not None:
        line += f"; mean period {result.mean_period_us:.1f} us ({result.rate_error:+.4%})"
    return line


def _complete(result: LatencyResult) -> bool:
    return all(one.complete for one in result.traffic.values())


def _messages(result: LatencyResult) -> str:
    parts = []
    for name, one in result.traffic.items():
        line = f"{name} {one.sent} sent = {one.received} received + {one.lost} lost"
        if one.in_flight:
            what = "under way" if one.complete else "NOT ACCOUNTED FOR"
            line += f" {one.in_flight:+d} {what}"
        parts.append(line)
    return "; ".join(parts)
