"""``bayesrace shadow``: checks of what shadows have decided, and what is printed and left of it."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from rich.console import Console

from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.checks import compare as compare_errors
from bayesrace.controller.weights.checks import slack_of
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.gp.weights import OUTPUTS, Weights
from bayesrace.learning.validation import discretisation_of
from bayesrace.operation.analysis.validation import validate_weights
from bayesrace.operation.terminal.terminal import plain_table
from bayesrace.studies.evidence.shadow.comparison import INPUTS, Compared, compare
from bayesrace.studies.evidence.shadow.cycles import read_cycles
from bayesrace.studies.evidence.shadow.picture import draw
from bayesrace.studies.evidence.verdict import Check, Verdict
from bayesrace.tracks import Track
from bayesrace.vehicles import Car, get_car

__all__ = ["bounds", "judge_shadows"]

_ANSWERED: Final = 0.99
_FEWER_SOLUTIONS: Final = 0.01
_MISSED: Final = 0.01
_WORSE, _WORSE_M = 1.2, 0.001
"""Factor on the plan's error of the controller that drives, and beyond it [m]."""
_LEAST_PLANS: Final = 20
_JUDGED_S: Final = 0.2


def bounds(text: str) -> dict[str, float]:
    """Bounds by input from ``d=0.1,delta_rate=1``; InputError for anything else."""
    found: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, _, number = part.partition("=")
        try:
            found[name.strip()] = float(number)
        except ValueError:
            found[""] = 0.0
    if found.keys() - set(INPUTS) or not all(value >= 0 for value in found.values()):
        raise InputError(f"--at-most {text}: give d, delta_rate or both, as d=0.1,delta_rate=1")
    return found


def judge_shadows(
    logs: Sequence[Path],
    at_most: Mapping[str, float],
    weights: Weights | None,
    against: Weights | None,
    car: Car | None,
    track: Track | None,
    out: Path | None,
    console: Console,
) -> Verdict:
    """Prints the tables; ``out`` receives ``shadow.json`` and a picture for each run and shadow.

    ``weights``: of a shadow, judged ``against`` those in use by one-step errors with the inputs
    that acted. InputError for logs without shadows.
    """
    checks: list[Check] = []
    results: list[Compared] = []
    for log in logs:
        for one in read_cycles(log):
            found = compare(one, track)
            results.append(found)
            subject = f"{log.name}: run {found.run}, shadow '{found.shadow}'"
            checks += _checks(subject, found, at_most)
            _print(subject, found, console)
            if out is not None:
                out.mkdir(parents=True, exist_ok=True)
                draw(one, subject, out / f"{log.stem}-{found.run}-{found.shadow}.png")
        if weights is not None:
            checks.append(_one_step(log, weights, against, car))
    if out is not None:
        content = json.dumps([one.model_dump() for one in results], indent=1)
        write_whole(out / "shadow.json", content + "\n")
    return Verdict("shadow", tuple(checks))


def _checks(subject: str, found: Compared, at_most: Mapping[str, float]) -> Iterator[Check]:
    answered = found.answered / max(found.inputs, 1)
    yield Check(
        subject, f"answers: at least {_ANSWERED:.0%} of the inputs", answered >= _ANSWERED,
        f"{found.answered} of {found.inputs}",
    )  # fmt: skip
    yield Check(
        subject, f"solutions: no fewer than the controller's, less {_FEWER_SOLUTIONS:.0%}",
        found.shadow_solutions >= found.driving_solutions - _FEWER_SOLUTIONS,
        f"{found.shadow_solutions:.1%}, the controller's {found.driving_solutions:.1%}",
    )  # fmt: skip
    if not found.lockstep:
        yield Check(
            subject, f"longer than a period: at most {_MISSED:.0%} of the cycles",
            found.shadow_missed <= _MISSED * found.answered, f"{found.shadow_missed}",
        )  # fmt: skip
    for name, bound in at_most.items():
        p99 = found.apart[name].p99
        yield Check(subject, f"{name} apart, p99: at most {bound:g}", p99 <= bound, f"{p99:.4g}")
    for one in found.promises:
        driving, shadow = one.controller.alike_m, one.shadow.alike_m
        if one.after_s == _JUDGED_S and one.alike >= _LEAST_PLANS and driving and shadow:
            most_m = _WORSE * driving.p50 + _WORSE_M
            yield Check(
                subject, f"plan after {one.after_s:g} s where alike, off p50: at most "
                f"{_WORSE:g} times the controller's and {1e3 * _WORSE_M:g} mm",
                shadow.p50 <= most_m, f"{1e3 * shadow.p50:.1f} mm, the controller's "
                f"{1e3 * driving.p50:.1f} mm, in {one.alike} plans",
            )  # fmt: skip


def _one_step(log: Path, new: Weights, old: Weights | None, car: Car | None) -> Check:
    """By the rule that a running controller judges new weights by, on the whole log."""
    car = car or get_car(new.car)
    judged = validate_weights(new, [log], car=car).result
    other = None if old is None else validate_weights(old, [log], car=car).result
    rmse = [getattr(judged, name).rmse for name in OUTPUTS]
    nominal = [getattr(judged, name).uncorrected_rmse for name in OUTPUTS]
    before = nominal if other is None else [getattr(other, name).rmse for name in OUTPUTS]
    slack = slack_of(car, discretisation_of(new.discretisation, car).step_s)
    found = compare_errors(GateSettings(), slack, judged.samples, rmse, before, nominal)
    beside = "no correction" if old is None else f"'{old.version}'"
    return Check(
        f"{log.name}: weights '{new.version}'",
        f"one-step errors: not worse than {beside}",
        not found.worse, f"{found.worse or 'none'} worse; {found.text}",
    )  # fmt: skip


def _print(subject: str, found: Compared, console: Console) -> None:
    console.print(f"\n{subject}", highlight=False)
    table = plain_table("inputs apart", "p50", "p99", "largest")
    for name, spread in found.apart.items():
        table.add_row(name, *(f"{value:.4g}" for value in (spread.p50, spread.p99, spread.max)))
    console.print(table)
    table = plain_table("largest", "x m", "y m", "s m", "controller", "shadow", "level")
    for at in found.places:
        place = (f"{value:.2f}" for value in (at.x_m, at.y_m))
        both = (f"{u[0]:.2f}, {u[1]:.2f}" for u in (at.driving, at.shadow))
        s_m = "" if at.s_m is None else f"{at.s_m:.2f}"
        table.add_row(f"at {at.time_s:.2f} s", *place, s_m, *both, f"{at.level}")
    console.print(table)
    table = plain_table(
        "plans off", "after s", "p50 mm", "p99 mm", "alike", "p50 mm", "way m", "came m", left=1
    )
    for name in ("controller", "shadow"):
        for one in found.promises:
            side = one.controller if name == "controller" else one.shadow
            alike = "–" if side.alike_m is None else f"{1e3 * side.alike_m.p50:.1f}"
            off = (f"{1e3 * value:.1f}" for value in (side.off_m.p50, side.off_m.p99))
            ways = (f"{value:.3f}" for value in (side.way_m, one.came_m))
            table.add_row(name, f"{one.after_s:g}", *off, f"{one.alike}", alike, *ways)
    console.print(table)
    table = plain_table("", "solutions", "step p50 µs", "p99", "largest")
    for name, share, spread in (
        ("controller", found.driving_solutions, found.driving_step_us),
        ("shadow", found.shadow_solutions, found.shadow_step_us),
    ):
        times = (f"{value:.0f}" for value in (spread.p50, spread.p99, spread.max))
        table.add_row(name, f"{share:.1%}", *times)
    console.print(table)
