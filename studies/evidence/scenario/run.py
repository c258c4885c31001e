"""Drives scenarios, as many at once as there are processors where time is simulated; in real time
one after the other. A campaign's grid is one scenario many times."""

import itertools
import json
import multiprocessing
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.files import parse_toml, read_text, temporary_folder
from bayesrace.operation.report.style import figure_style, inline_svg
from bayesrace.operation.terminal.terminal import Stages, stages_on
from bayesrace.studies.evidence.scenario.checks import Drive, judged
from bayesrace.studies.evidence.scenario.description import Scenario, read_scenario
from bayesrace.studies.evidence.scenario.picture import drive_picture
from bayesrace.studies.evidence.scenario.preparing import Ready, make_ready
from bayesrace.studies.evidence.verdict import Check, Verdict

__all__ = ["Result", "read_grid", "run_scenarios", "verdict_of"]


class Result(BaseModel):
    """One scenario, driven and judged; null: not known."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    scenario: Scenario
    passed: bool
    checks: tuple[Check, ...]
    laps_s: tuple[float, ...] = ()
    off_track_samples: int | None = None
    off_track_max_m: float | None = Field(None, description="negative: on the track")
    fallback_share: float | None = None
    latency_p50_ms: float | None = None
    latency_p99_ms: float | None = None
    trajectory_sha256: str = Field("", description="of all true states")
    seconds: float = Field(description="that it took")
    picture: str = Field("", exclude=True)


def verdict_of(results: Sequence[Result]) -> Verdict:
    """All checks of all scenarios."""
    return Verdict("scenario", tuple(check for one in results for check in one.checks))


def run_scenarios(
    scenarios: Sequence[Scenario], out: Path | None, stages: Stages, workers: int = 0
) -> list[Result]:
    """The results, in the order of the scenarios. ``out``: keeps the recordings, in a folder of the
    scenario's name; ``workers``: 0 for one a processor.

    InputError for what cannot be prepared. A drive that cannot be driven to its end is a check that
    fails.
    """
    # Once, before several look for it in the cache.
    for one in {_prepared_by(one): one for one in scenarios}.values():
        make_ready(one, stages)
    simulated = [one for one in scenarios if one.mode == "simulated"]
    results = dict[str, Result]()
    count = min(workers or multiprocessing.cpu_count(), len(simulated))
    with stages.stage(f"drive {len(scenarios)} scenarios") as stage:
        if count > 1:
            spawn = multiprocessing.get_context("spawn")  # the parent has threads
            with ProcessPoolExecutor(count, spawn) as pool:
                for result in pool.map(_driven, simulated, itertools.repeat(out)):
                    results[result.name] = result
                    stage.update(len(results) / len(scenarios), result.name)
        for one in scenarios:
            if one.name not in results:
                results[one.name] = _driven(one, out)
                stage.update(len(results) / len(scenarios), one.name)
    return [results[one.name] for one in scenarios]


def _prepared_by(scenario: Scenario) -> str:
    """What is made for it depends on that alone."""
    return f"{scenario.race.model_dump_json()} {scenario.track} {sorted(scenario.wanted_weights)}"


def _driven(scenario: Scenario, out: Path | None) -> Result:
    begun = time.perf_counter()
    with temporary_folder() as scratch, stages_on(Console(quiet=True)) as stages:
        folder = scratch if out is None else out / scenario.name
        folder.mkdir(parents=True, exist_ok=True)
        try:
            ready = make_ready(scenario, stages)
            drive = _recorded(ready, folder)
            compared = scenario.holds.lap_over_undisturbed is not None
            alone = Ready(scenario.undisturbed, ready.prepared, ready.named)
            undisturbed = _recorded(alone, folder / "undisturbed") if compared else None
        except InputError as error:
            failed = (Check(scenario.name, "drives to its end", False, str(error)),)
            seconds = time.perf_counter() - begun
            return Result(
                name=scenario.name, scenario=scenario, passed=False, checks=failed, seconds=seconds
            )
    checks = tuple(judged(scenario, drive, undisturbed))
    return _result(scenario, drive, checks, time.perf_counter() - begun)


def _recorded(ready: Ready, folder: Path) -> Drive:
    folder.mkdir(exist_ok=True)
    if ready.scenario.mode == "simulated":
        from bayesrace.studies.evidence.scenario.simulated import drive_simulated as drive
    else:
        from bayesrace.studies.evidence.scenario.real import drive_real as drive
    drive(ready, folder)
    return Drive.read(folder / "run.mcap", ready.prepared.first.track)


def _result(scenario: Scenario, drive: Drive, checks: tuple[Check, ...], seconds: float) -> Result:
    known: dict[str, Any] = {}
    if len(drive.truth):
        off = drive.off_track_m
        latencies = [drive.latency_ms(share) for share in (0.5, 0.99)]
        p50, p99 = (None if one != one else one for one in latencies)
        with figure_style():
            picture = inline_svg(drive_picture(scenario, drive))
        known = {
            "laps_s": drive.laps.times_s, "off_track_samples": int((off > 0).sum()),
            "off_track_max_m": float(off.max()), "fallback_share": drive.fallback_share,
            "latency_p50_ms": p50, "latency_p99_ms": p99, "trajectory_sha256": drive.digest,
            "picture": picture,
        }  # fmt: skip
    passed = all(one.passed for one in checks)
    return Result(
        name=scenario.name, scenario=scenario, passed=passed, checks=checks, seconds=seconds,
        **known,
    )  # fmt: skip


def read_grid(plan: Path, scenario: str | Path) -> list[Scenario]:
    """The scenario with all combinations of the values in the plan's ``[grid]``, whose names are
    places in the scenario, as ``event.0.delay_ms``. InputError names what is wrong."""
    remedy = "docs/scenarios.md shows a grid"
    content = parse_toml(read_text(plan, "the plan", remedy), plan, remedy)
    axes = _leaves(content.get("grid", {}))
    if set(content) != {"grid"} or not axes or not all(axes.values()):
        raise InputError(
            f"{plan}: the plan of a scenario has one table [grid], with lists of values: {remedy}"
        )
    found = []
    for values in itertools.product(*axes.values()):
        point = dict(zip(axes, values, strict=True))
        label = ", ".join(f"{name}={json.dumps(value)}" for name, value in point.items())
        one = read_scenario(scenario, point)
        found.append(one.model_copy(update={"name": f"{one.name} {label}"}))
    return found


def _leaves(given: Mapping[str, Any], before: str = "") -> dict[str, list[Any]]:
    """Lists of values by dotted names."""
    leaves: dict[str, list[Any]] = {}
    for key, value in given.items():
        if isinstance(value, dict):
            leaves |= _leaves(value, f"{before}{key}.")
        else:
            leaves[before + key] = value if isinstance(value, list) else [value]
    return leaves
