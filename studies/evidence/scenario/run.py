"""Drives scenarios, as many at once as there are processors where time is simulated; in real time
one after the other. A campaign's grid is one scenario many times."""

import itertools
import json
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from pydantic import Field
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.files import parse_toml, read_text, temporary_folder, write_whole
from bayesrace.operation.analysis.results import ResultModel
from bayesrace.operation.report.style import figure_style, inline_svg
from bayesrace.operation.terminal.terminal import Stages, stages_on
from bayesrace.studies.evidence.scenario.checks import Drive, judged
from bayesrace.studies.evidence.scenario.description import Scenario, read_scenario
from bayesrace.studies.evidence.scenario.picture import drive_picture
from bayesrace.studies.evidence.scenario.preparing import Ready, make_ready
from bayesrace.studies.evidence.verdict import Check, Verdict

__all__ = ["Result", "read_grid", "run_scenarios", "verdict_of"]


class Result(ResultModel):
    """One scenario, driven and judged; null: not known."""

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
    scenarios: Sequence[Scenario],
    out: Path | None,
    stages: Stages,
    workers: int = 0,
    ended: Callable[[Result], None] = lambda _: None,
) -> list[Result]:
    """The results, in the order of the scenarios. ``out``: keeps the recordings, in a folder of the
    scenario's name; ``workers``: 0 for one a processor.

    ``ended`` is called with each as it ends. InputError for what cannot be prepared. A drive that
    cannot be driven to its end is a check that fails.
    """
    # Once, before several look for it in the cache.
    for one in {_prepared_by(one): one for one in scenarios}.values():
        make_ready(one, stages)
    results = dict[str, Result]()
    with stages.stage(f"drive {len(scenarios)} scenarios") as stage:
        for result in _each_driven(scenarios, out, workers):
            results[result.name] = result
            stage.update(len(results) / len(scenarios), result.name)
            ended(result)
    return [results[one.name] for one in scenarios]


def _each_driven(scenarios: Sequence[Scenario], out: Path | None, workers: int) -> Iterator[Result]:
    """As they end."""
    simulated = [one for one in scenarios if one.mode == "simulated"]
    count = min(workers or multiprocessing.cpu_count(), len(simulated))
    if count > 1:
        spawn = multiprocessing.get_context("spawn")  # the parent has threads
        with ProcessPoolExecutor(count, spawn) as pool:
            driven = [pool.submit(_driven, one, out) for one in simulated]
            yield from (one.result() for one in as_completed(driven))
        scenarios = [one for one in scenarios if one.mode != "simulated"]
    yield from (_driven(one, out) for one in scenarios)


def _prepared_by(scenario: Scenario) -> str:
    """What is made for it depends on that alone."""
    return f"{scenario.race.model_dump_json()} {scenario.track} {sorted(scenario.wanted_weights)}"


def _driven(scenario: Scenario, out: Path | None) -> Result:
    begun = time.perf_counter()
    known: dict[str, Any] = {}
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
            checks = [Check(scenario.name, "drives to its end", False, str(error))]
        else:
            checks, known = judged(scenario, drive, undisturbed), _numbers(scenario, drive)
    return Result(
        name=scenario.name, scenario=scenario, passed=all(one.passed for one in checks),
        checks=tuple(checks), seconds=time.perf_counter() - begun, **known,
    )  # fmt: skip


def _recorded(ready: Ready, folder: Path) -> Drive:
    folder.mkdir(exist_ok=True)
    write_whole(folder / "mpc.json", ready.scenario.mpc.model_dump_json(indent=1) + "\n")
    if ready.scenario.mode == "simulated":
        from bayesrace.studies.evidence.scenario.simulated import drive_simulated as drive
    else:
        from bayesrace.studies.evidence.scenario.real import drive_real as drive
    drive(ready, folder)
    return Drive.read(folder / "run.mcap", ready.prepared.first.track)


def _numbers(scenario: Scenario, drive: Drive) -> dict[str, Any]:
    """Of a result, where something was recorded, and the picture."""
    if not len(drive.truth):
        return {}
    p50_ms, p99_ms = drive.latency_p50_ms, drive.latency_p99_ms
    with figure_style():
        picture = inline_svg(drive_picture(scenario, drive))
    return {
        "laps_s": drive.laps.times_s, "off_track_samples": drive.off_track_samples,
        "off_track_max_m": float(drive.beyond_edge_m.max()),
        "fallback_share": drive.fallback_share, "trajectory_sha256": drive.digest,
        "latency_p50_ms": None if math.isnan(p50_ms) else p50_ms,
        "latency_p99_ms": None if math.isnan(p99_ms) else p99_ms, "picture": picture,
    }  # fmt: skip


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
