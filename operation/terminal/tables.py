"""Results of a race, of training and of validation on the terminal, legible from 80 columns on."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bayesrace.gp.weights import OUTPUTS, UNITS, pack_weights
from bayesrace.learning.dataset import left_out
from bayesrace.learning.target import KernelScore
from bayesrace.operation.analysis.results import GpMetrics, LapResult, RaceResult
from bayesrace.operation.analysis.validation import DRIFTS, HorizonResult, Spread, ValidationResult
from bayesrace.operation.terminal import SMOOTHNESS
from bayesrace.operation.terminal.terminal import plain_table
from bayesrace.vehicles.parts import GRAVITY_MPS2

if TYPE_CHECKING:
    from bayesrace.learning.identification import Identified
    from bayesrace.operation.fewest_points import Attempt

__all__ = [
    "COLUMNS",
    "GP_COLUMNS",
    "Column",
    "drive_text",
    "gp_cells",
    "print_beyond_limits",
    "print_identified",
    "print_kernels",
    "print_points",
    "print_table",
    "print_validation",
]


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


_ERRORS: Final = "position m", "heading rad", "vx m/s", "vy m/s", "omega rad/s"

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
    """Prints one row a controller, what drove it, the GP's lines, and what went wrong, if
    anything."""
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
    _print_limit(result, console)
    for lap in result.laps:
        if facts := _facts(lap):
            console.print(Text(f"{lap.name}: {', '.join(facts)}"))
    drives = {f"practice on {on}": drive for on, drive in result.practices.items()}
    if result.training is not None:
        drives = {f"training drive on {summary.train_track}": result.training} | drives
    for what, drive in drives.items():
        style = "yellow" if drive.off_track_samples else ""
        console.print(Text(f"{what}: {drive_text(drive)}", style=style))
    if result.line_driven is not None:
        share = f"driven before: {100 * result.line_driven:.0f} % of the racing line's time"
        console.print(Text(f"{share}, by speed and lateral acceleration"))
    _print_notes(result, console)


def _facts(lap: LapResult) -> list[str]:
    """What drove, each lap over the limit, and where the car was between the samples."""
    facts = [f"weights {lap.weights_version}"] if lap.weights_version else []
    if lap.lost_s is not None:
        facts.append(f"{lap.lost_s:.2f} s a lap lost where they know too little")
    if lap.limit_ratios:
        ratios = " ".join(f"{ratio:.3f}" for ratio in lap.limit_ratios)
        facts.append(f"laps over the limit {ratios}")
    if lap.off_track_ms:
        facts.append(
            f"{lap.off_track_ms} ms off the track by up to {_metres(lap.off_track_ms_max_m)} m"
        )
    return facts


def _print_limit(result: RaceResult, console: Console) -> None:
    known = ", ".join(f"{kind} {time_s:.3f} s" for kind, time_s in result.limit_s.items())
    if not known and all(lap.off_track_ms is None for lap in result.laps):
        return
    if not known and result.settings.tyres == "linear":
        known = "linear tyres have no limit"
    known = known or "not known; 'bayesrace limit' computes it, or says why not"
    console.print(Text(f"the limit, the fastest that the car can drive: {known}"))


def drive_text(drive: LapResult) -> str:
    """A training drive in a line."""
    laps = ", ".join(f"{time_s:.3f}" for time_s in drive.lap_times_s)
    off = f"{drive.off_track_samples or 'none'} of {drive.samples} samples off the track"
    if drive.off_track_samples:
        off += f" by up to {_metres(drive.off_track_max_m)} m"
    faster = drive.run - 1
    before = f"after {faster} faster {'drives' if faster > 1 else 'drive'}, " if faster else ""
    end = "" if drive.passed else f"; {drive.ended}"
    return (
        f"{before}{f'laps {laps} s' if laps else 'no lap'}, {off}, "
        f"up to {_decimals(drive.speed_max_mps, 2)} m/s and {_slip(drive)}° of slip{end}"
    )


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


def print_kernels(scores: Sequence[KernelScore], console: Console) -> None:
    """The paper's appendix: held-out error against the kernel's smoothness, per output."""
    titles = [f"{output}\nRMSE {UNITS[output]}\nlog density" for output in OUTPUTS]
    table = plain_table("kernel", "ν", *titles, padding=0)
    found = {(score.output, score.kernel): score for score in scores}
    for kernel, nu in SMOOTHNESS.items():
        row = [found.get((output, kernel)) for output in OUTPUTS]
        if any(row):
            table.add_row(kernel, nu, *(_kernel_cell(score) for score in row))
    console.print(Text("Kernel by smoothness, held out by parts of the drive", style="bold"))
    console.print(table)
    chosen = {score.output: score.kernel for score in scores if score.chosen}
    text = ", ".join(f"{output}: {chosen[output]}" for output in OUTPUTS if output in chosen)
    console.print(Text(f"chosen by log predictive density: {text}"))


def _kernel_cell(score: KernelScore | None) -> Text:
    if score is None:
        return Text("–")
    text = f"{score.rmse:.3g} · {score.log_density:.2f}{' ✓' if score.chosen else '  '}"
    return Text(text, style="bold green" if score.chosen else "")


def print_points(attempts: Sequence["Attempt"], chosen: "Attempt", console: Console) -> None:
    """What fewer and fewer points cost."""
    errors = (f"RMSE {output}\n{UNITS[output]}" for output in OUTPUTS)
    table = plain_table("points", "laps\ns", "lost\n%", "±", "off\ntrack", *errors, "data\nkB")
    for one in attempts:
        weights, (lost, unsure) = one.training.weights, one.lost(attempts[0])
        table.add_row(
            f"{max(weights.counts)}{' ✓' if one is chosen else ''}",
            f"{one.laps_s.mean(1).sum():.3f}", f"{100 * lost:+.2f}", f"{100 * unsure:.2f}",
            f"{one.off_track}", *(f"{weights.metrics[name]['rmse']:.3g}" for name in OUTPUTS),
            f"{len(pack_weights(weights)) / 1000:.0f}",
        )  # fmt: skip
    console.print(Text("Flying laps of the learned car, one-step errors held out", style="bold"))
    console.print(table)


def print_beyond_limits(dropped: Mapping[str, int], kept: int, console: Console) -> None:
    """How to keep what exceeds the car's limits, where that is most of a drive."""
    if (beyond := dropped.get("outside limits", 0)) > kept:
        text = f"{beyond} samples are beyond the car's limits; --all-samples keeps them"
        console.print(Text(text, style="yellow"), soft_wrap=True)


def print_identified(found: "Identified", console: Console) -> None:
    """One row a number, with its standard error; how much was driven; what is still unknown."""
    table = plain_table("", "value", "± std. error", "unit", "meaning")
    table.columns[4].justify, table.columns[4].no_wrap = "left", False
    for one in found.values:
        table.add_row(one.name, f"{one.value:.4g}", f"{one.error:.2g}", one.unit, one.meaning)
    console.print(table)
    text = f"{found.used_s:.1f} s of {found.driven_s:.1f} s driven are used"
    console.print(Text(f"{text}; {found.refused} readings are far from all others"))
    for text in found.unknown:
        console.print(Text(text, style="yellow"))


def print_validation(result: ValidationResult, console: Console) -> None:
    """Metrics per output, and the drift over one step and over the horizon."""
    counts = f"{result.samples} samples (left out: {left_out(result.dropped)})"
    console.print(Text(f"{result.weights_version} on {counts}", style="bold"))
    print_beyond_limits(result.dropped, result.samples, console)
    if result.learned_from:
        text = "the weights were learned from these very samples: expect larger errors on others"
        console.print(Text(text, style="yellow"))
    table = plain_table("output", *GP_COLUMNS)
    for output in OUTPUTS:
        table.add_row(f"{output} {UNITS[output]}", *gp_cells(getattr(result, output)))
    console.print(table)
    large = f"largest sigma above {result.threshold:g}"
    console.print(Text(f"{large} at {result.uncertain} of {result.samples} samples"))
    for drift in (result.one_step, result.horizon):
        if drift is not None:
            _print_drift(drift, console)
    if result.horizon is None:
        console.print(Text("no stretch is long enough for the horizon", style="yellow"))


def _print_drift(drift: HorizonResult, console: Console) -> None:
    steps = "1 step" if drift.steps == 1 else f"{drift.steps} steps, open loop"
    titles = ("nominal\nmean", "\np95", "\nmax", "corrected\nmean", "\np95", "\nmax")
    table = plain_table("error", *titles)
    for label, name in zip(_ERRORS, DRIFTS, strict=True):
        table.add_row(label, *_cells(drift.nominal[name]), *_cells(drift.corrected[name]))
    console.print(Text(f"{steps} ({drift.predictions} predictions)", style="bold"))
    console.print(table)


def _cells(spread: Spread) -> list[str]:
    return [f"{value:.2g}" for value in (spread.mean, spread.p95, spread.max)]
