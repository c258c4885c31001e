"""A race's outcome on the terminal."""

from collections.abc import Callable
from typing import Final, Literal, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from experiments.published import SOURCE, compare_gp, compare_laps
from experiments.results import GpMetrics, LapResult, RaceResult

__all__ = ["COLUMNS", "Column", "print_table"]


class Column(NamedTuple):
    """One column of the result table, on the terminal and in the report."""

    title: str
    unit: str
    cell: Callable[[LapResult], str]
    meaning: str
    number: bool = True


def _decimals(value: float | None, count: int) -> str:
    return "–" if value is None else f"{value:.{count}f}"


def _first_lap(lap: LapResult) -> str:
    return _decimals(lap.lap_time_s, 3) if lap.finished else "DNF"


def _solve(name: str) -> Callable[[LapResult], str]:
    def cell(lap: LapResult) -> str:
        return "–" if lap.solve_us is None else f"{getattr(lap.solve_us, name):.0f}"

    return cell


def _excursion(lap: LapResult) -> str:
    return _decimals(lap.off_track_max_m, 3) if lap.off_track_samples else "–"


COLUMNS: Final = (
    Column("controller", "", lambda lap: lap.controller, "who drove", number=False),
    Column(
        "weights",
        "",
        lambda lap: lap.weights_version or "–",
        "version of the residual's weights",
        number=False,
    ),
    Column("lap", "s", _first_lap, "first lap, from standstill; DNF: none finished"),
    Column(
        "flying",
        "s",
        lambda lap: _decimals(lap.flying_lap_time_s, 3),
        "best of the laps after the first",
    ),
    Column(
        "off", "", lambda lap: str(lap.off_track_samples), "samples with the centre of gravity off"
    ),
    Column("deepest", "m", _excursion, "deepest excursion"),
    Column(
        "dev ø",
        "m",
        lambda lap: _decimals(lap.deviation_mean_m, 3),
        "mean distance from the racing line",
    ),
    Column(
        "dev max",
        "m",
        lambda lap: _decimals(lap.deviation_max_m, 3),
        "largest distance from the racing line",
    ),
    Column("p50", "µs", _solve("p50"), "median execution time of the controller's step"),
    Column("p99", "µs", _solve("p99"), "99th percentile of the same"),
    Column("max", "µs", _solve("max"), "largest of the same"),
    Column("fb", "", lambda lap: str(lap.fallbacks), "cycles that the fallback drove"),
)
"""The result table's columns; the report shows the same cells."""


def _gp_table(result: RaceResult) -> Table:
    """One row the GPs, one column an output: RMSE with and without the GP, R², coverage."""
    table = Table(box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    table.add_column("GP")
    for output in result.gp or result.gp_updated:
        table.add_column(f"{output} RMSE (raw) R² cover", justify="right", overflow="fold")
    for name, metrics in (("bayesrace", result.gp), ("updated", result.gp_updated)):
        if metrics:
            table.add_row(name, *(_gp_cell(item) for item in metrics.values()))
    return table


def _gp_cell(metrics: GpMetrics) -> str:
    errors = f"{metrics.rmse:.3g} ({metrics.uncorrected_rmse:.3g})"
    return f"{errors} {metrics.r2:.3f} {metrics.coverage:.2f}"


def print_table(result: RaceResult, console: Console) -> None:
    """Prints one row a controller, the GP's lines, and what went wrong, if anything."""
    summary = result.settings
    console.print(
        Text(
            f"{summary.track} · {summary.car} · {summary.mode} · seed {summary.seed}"
            f" · trained on {summary.train_track}"
            f" · track constraints {'on' if summary.constraints else 'off'}"
            + (f" · car played by {summary.fmu}" if summary.fmu else ""),
            style="bold",
        )
    )
    table = Table(box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    for column in COLUMNS:
        # Where the terminal is narrow, names wrap: numbers are never cut.
        justify: Literal["left", "right"] = "right" if column.number else "left"
        table.add_column(
            f"{column.title}\n{column.unit}",
            justify=justify,
            no_wrap=column.number,
            overflow="fold",
        )
    for lap in result.laps:
        style = "" if lap.finished else "red"
        table.add_row(*(Text(column.cell(lap)) for column in COLUMNS), style=style)
    console.print(table)
    _print_notes(result, console)


def _print_published(result: RaceResult, console: Console) -> None:
    """The paper's numbers beside ours, on its track."""
    laps, outputs = compare_laps(result), compare_gp(result)
    if not laps:
        return
    console.print(Text(f"Beside the paper ({SOURCE})"))
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    table.add_column("controller")
    for title in ("paper\nlap s", "here\nlap s", "paper\noff / m", "here\noff / m"):
        table.add_column(title, justify="right", no_wrap=True)
    for lap in laps:
        table.add_row(lap.controller, lap.paper_lap, lap.our_lap, lap.paper_off, lap.our_off)
    console.print(table)
    if not outputs:
        return
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    table.add_column("GP")
    table.add_column("weights")
    for title in ("paper\nRMSE (raw) · R²", "here\nRMSE (raw) · R²"):
        table.add_column(title, justify="right", no_wrap=True)
    for row in outputs:
        table.add_row(row.output, "bayesrace", row.paper, row.ours)
        table.add_row("", "updated", row.paper_updated, row.ours_updated)
    console.print(table)


def _print_notes(result: RaceResult, console: Console) -> None:
    if result.gp or result.gp_updated:
        console.print(_gp_table(result))
    _print_published(result, console)
    if result.real_time_factor is not None:
        console.print(Text(f"lockstep at {result.real_time_factor:.1f} × real time"))
    for lap in result.laps:
        if not lap.finished:
            console.print(Text(f"{lap.controller} did not finish: {lap.ended}", style="red"))
        elif (count := len(lap.lap_times_s)) < result.settings.laps:
            text = f"{lap.controller} finished {count} of {result.settings.laps} laps: {lap.ended}"
            console.print(Text(text, style="yellow"))
    if result.judged_by == "measurement":
        text = "the log holds no truth: laps and GPs are judged by what was measured"
        console.print(Text(text, style="yellow"))
    if not result.complete:
        lost = (
            f"{result.gaps} message(s) missing" if result.gaps else "cut off or in part unreadable"
        )
        console.print(Text(f"the log is not complete: {lost}", style="yellow"))
