"""The result of a race on the terminal, legible from 80 columns on."""

import math
import re
from collections.abc import Callable
from typing import Final, NamedTuple

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bayesrace.gp.weights import UNITS
from bayesrace.operation.analysis.results import GpMetrics, LapResult, RaceResult
from bayesrace.operation.terminal.terminal import plain_table
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["COLUMNS", "GP_COLUMNS", "Column", "drive_text", "gp_cells", "print_table"]


_BEYOND: Final = 1.1
"""Of the friction: measured accelerations err by some per cent."""


class Column(NamedTuple):
    """One column of the result table, on the terminal and in the report."""

    title: str
    unit: str
    cell: Callable[[LapResult], str]
    meaning: str
    number: bool = True
    narrow: bool = True
    """Shown on the terminal, too, where there are 80 columns."""


def _decimals(value: float | None, count: int) -> str:
    return "–" if value is None else f"{value:.{count}f}"


def _metres(value: float | None) -> str:
    return _decimals(value, 3 if value is None or value < 10 else 0)


def _first_lap(lap: LapResult) -> str:
    return _decimals(lap.lap_time_s, 3) if lap.finished else "refused" if lap.refused else "DNF"


def _excursion(lap: LapResult) -> str:
    return _metres(lap.off_track_max_m) if lap.off_track_samples else "–"


def _ratio(ratios: list[float] | None, laps: slice) -> str:
    """The smallest of some laps' ratios to the limit."""
    return _decimals(min((ratios or [])[laps], default=None), 3)


def _lateral(lap: LapResult) -> str:
    return "–" if lap.lateral_max_mps2 is None else f"{lap.lateral_max_mps2 / GRAVITY_MPS2:.2f}"


def _slip(lap: LapResult) -> str:
    return "–" if lap.slip_max_rad is None else f"{math.degrees(lap.slip_max_rad):.0f}"


def _solve(name: str) -> Callable[[LapResult], str]:
    return lambda lap: _decimals(getattr(lap.solve_us, name, None), 0)


COLUMNS: Final = (
    Column("controller", "", lambda lap: lap.name, "name of the controller", number=False),
    Column("lap", "s", _first_lap, "first lap, from standstill; DNF: did not finish one; "
           "refused: the controller refused its weights, and was not driven"),
    Column("flying", "s", lambda lap: _decimals(lap.flying_lap_time_s, 3), "best later lap"),
    Column("lap / limit", "", lambda lap: _ratio(lap.limit_ratios, slice(1)),
           "first lap over the fastest that the car can drive from standstill", narrow=False),
    Column("flying / limit", "", lambda lap: _ratio(lap.limit_ratios, slice(1, None)),
           "best later lap over the fastest that the car can drive", narrow=False),
    Column("off track", "", lambda lap: str(lap.off_track_samples),
           "samples with the centre of gravity off the track"),
    Column("off track", "ms", lambda lap: _decimals(lap.off_track_ms, 0),
           "the same each millisecond, between the samples; –: not the built-in car", narrow=False),
    Column("deepest", "m", _excursion, "largest distance off the track"),
    Column("dev mean", "m", lambda lap: _metres(lap.deviation_mean_m),
           "mean distance from the racing line"),
    Column("dev max", "m", lambda lap: _metres(lap.deviation_max_m),
           "largest distance from the racing line"),
    Column("lateral", "g", _lateral, "largest acceleration across the way", narrow=False),
    Column("slip", "°", _slip, "largest angle between the car's axis and its velocity",
           narrow=False),
    Column("step p50", "µs", _solve("p50"), "median execution time of the control step"),
    Column("step p99", "µs", _solve("p99"), "99th percentile of the same"),
    Column("step max", "µs", _solve("max"), "largest of the same"),
    Column("fall-backs", "", lambda lap: str(lap.fallbacks), "cycles that the fallback drove"),
    Column("weights", "", lambda lap: lap.weights_version or "–",
           "version of the residual's weights", number=False, narrow=False),
)  # fmt: skip
"""The result table's columns; the report shows the same cells."""


GP_COLUMNS: Final = ("RMSE", "without GP", "R²", "95 % coverage", "log density")
"""Columns of :func:`gp_cells`."""


def gp_cells(one: GpMetrics) -> list[str]:
    """The scores of one output's GP, as all tables show them."""
    errors = [f"{value:.3g}" for value in (one.rmse, one.uncorrected_rmse)]
    return [*errors, f"{one.r2:.4f}", f"{one.coverage:.3f}", f"{one.log_density:.2f}"]


def _gp_table(result: RaceResult) -> Table:
    """One row an output and weights."""
    heads = ("\n".join(title.rsplit(" ", 1)) for title in GP_COLUMNS)
    table = plain_table("output", "GP of", *heads, left=2)
    for output in result.gp or result.gp_updated:
        name = f"{output} {UNITS[output]}"
        for weights, metrics in (("bayesrace", result.gp), ("updated", result.gp_updated)):
            if one := metrics.get(output):
                table.add_row(name, weights, *gp_cells(one))
                name = ""
    return table


def print_table(result: RaceResult, console: Console) -> None:
    """Prints one row a controller, the GP's lines, and what went wrong, if anything."""
    summary = result.settings
    console.print(
        Text(
            f"{summary.track} · {summary.car} · {summary.mode} · seed {summary.seed}"
            f" · trained on {summary.train_track}"
            f" · track constraints {'on' if summary.constraints else 'off'}"
            + (f" · car simulated by {summary.fmu}" if summary.fmu else ""),
            style="bold",
        )
    )
    columns = [column for column in COLUMNS if column.narrow]
    heads = ("\n".join([*re.split("(?<=-)| ", c.title), c.unit]).rstrip() for c in columns)
    table = plain_table(*heads, padding=0)
    for lap in result.laps:
        style = "" if lap.finished else "red"
        table.add_row(*(Text(column.cell(lap)) for column in columns), style=style)
    console.print(table)
    console.print(
        Text(
            "lap: first, from standstill; off track: samples, and the deepest; dev: distance from "
            "the racing line; step: time of a control step; fall-backs: cycles",
            style="dim",
        )
    )
    for lap in result.laps:
        if lap.weights_version:
            console.print(Text(f"{lap.name}: weights {lap.weights_version}"))
    if (training := result.training) is not None:
        style = "yellow" if training.off_track_samples else ""
        text = f"training drive on {summary.train_track}: {drive_text(training)}"
        console.print(Text(text, style=style))
    _print_limit(result, console)
    _print_cornering(result, console)
    _print_notes(result, console)


def _print_limit(result: RaceResult, console: Console) -> None:
    """Each lap over the limit, and where the car was between the samples."""
    known = ", ".join(f"{kind} {time_s:.3f} s" for kind, time_s in result.limit_s.items())
    if not known and all(lap.off_track_ms is None for lap in result.laps):
        return
    if not known and result.settings.tyres == "linear":
        known = "linear tyres have no limit"
    known = known or "not known; 'bayesrace limit' computes it, or says why not"
    console.print(Text(f"\nThe fastest that the car can drive: {known}"))
    heads = "controller", "each lap over it", "off track\nms", "deepest\nm"
    table = plain_table(*heads, left=2)
    for lap in result.laps:
        ratios = " ".join(f"{ratio:.3f}" for ratio in lap.limit_ratios or ()) or "–"
        deepest = _metres(lap.off_track_ms_max_m) if lap.off_track_ms else "–"
        table.add_row(lap.name, ratios, _decimals(lap.off_track_ms, 0), deepest)
    console.print(table)


def drive_text(drive: LapResult) -> str:
    """A training drive in a line."""
    laps = ", ".join(f"{time_s:.3f}" for time_s in drive.lap_times_s)
    off = f"{drive.off_track_samples or 'none'} of {drive.samples} samples off the track"
    if drive.off_track_samples:
        off += f" by up to {_metres(drive.off_track_max_m)} m"
    return (
        f"{f'laps {laps} s' if laps else 'no lap'}, {off}, "
        f"up to {_decimals(drive.speed_max_mps, 2)} m/s and {_slip(drive)}° of slip"
    )


def _print_cornering(result: RaceResult, console: Console) -> None:
    """Lateral acceleration and slip of each lap beyond the friction that the line assumes."""
    friction = result.settings.friction
    beyond = [
        lap
        for lap in result.laps
        if friction is not None
        and lap.finished
        and (lap.lateral_max_mps2 or 0.0) > _BEYOND * friction * GRAVITY_MPS2
    ]
    if not beyond:
        return
    console.print(Text(f"beyond the friction of {friction:g} g that the line assumes:"))
    for lap in beyond:
        text = f"  {lap.name}: {_lateral(lap)} g across the way, {_slip(lap)}° of slip"
        console.print(Text(text, style="yellow"))
    if result.settings.tyres == "linear":
        console.print(Text("  (linear tyres never saturate; 'race --tyres pacejka' does)"))


def _print_notes(result: RaceResult, console: Console) -> None:
    if result.gp or result.gp_updated:
        console.print(_gp_table(result), new_line_start=True)
    if result.real_time_factor is not None:
        console.print(Text(f"lockstep at {result.real_time_factor:.1f} × real time"))
    for lap in result.laps:
        for remark in lap.remarks:
            console.print(Text(f"{lap.name}: {remark}", style="yellow"))
        if lap.refused:
            console.print(Text(f"{lap.name}: refused: {lap.refused}", style="red"))
        elif not lap.passed:
            text = f"{lap.name} {lap.verdict}; {lap.ended}"
            console.print(Text(text, style="yellow" if lap.finished else "red"))
    if result.judged_by == "measurement":
        text = "the log holds no truth: laps and GPs are judged by the measurements"
        console.print(Text(text, style="yellow"))
    if not result.complete:
        lost = (
            f"{result.gaps} message(s) missing" if result.gaps else "cut off or in part unreadable"
        )
        console.print(Text(f"the log is not complete: {lost}", style="yellow"))
