"""Results of training and validation on the terminal."""

from collections.abc import Mapping, Sequence
from typing import Final

from rich.console import Console
from rich.text import Text

from bayesrace.gp.weights import OUTPUTS, UNITS
from bayesrace.learning.dataset import left_out
from bayesrace.learning.target import KernelScore
from bayesrace.operation.analysis.validation import DRIFTS, HorizonResult, Spread, ValidationResult
from bayesrace.operation.terminal.notation import SMOOTHNESS
from bayesrace.operation.terminal.race_table import GP_COLUMNS, gp_cells
from bayesrace.operation.terminal.terminal import plain_table

__all__ = ["print_beyond_limits", "print_kernels", "print_validation"]

_ERRORS: Final = "position m", "heading rad", "vx m/s", "vy m/s", "omega rad/s"


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


def print_beyond_limits(dropped: Mapping[str, int], kept: int, console: Console) -> None:
    """How to keep what exceeds the car's limits, where that is most of a drive."""
    if (beyond := dropped.get("outside limits", 0)) > kept:
        text = f"{beyond} samples are beyond the car's limits; --all-samples keeps them"
        console.print(Text(text, style="yellow"), soft_wrap=True)


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
