"""``replay``, ``scenario``, ``shadow``, ``timing``: evidence about a controller, with verdicts."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import typer

from bayesrace.errors import InputError
from bayesrace.operation.cli import options
from bayesrace.operation.cli.declaration import Given, options_of

if TYPE_CHECKING:
    from bayesrace.studies.evidence.scenario.run import Result
    from bayesrace.studies.evidence.timing.settings import TimingSettings
    from bayesrace.studies.evidence.verdict import Verdict

__all__ = ["replay", "scenario", "shadow", "timing"]


def _with_folder(path: Path | None) -> Path | None:
    """Callback of ``--junit``: the file may be in the folder that ``--out`` is to make."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
    return options.writable(path)


_JUNIT: Final = options.value(
    "Write the verdict as JUnit XML to this file.",
    None,
    "--junit",
    metavar="FILE",
    callback=_with_folder,
)


def _end(verdict: "Verdict", junit: Path | None, left: Path | None = None) -> None:
    """Prints the verdict and where files are ``left``, and exits by it."""
    from bayesrace.operation.terminal.terminal import Terminal

    verdict.print(Terminal())
    if junit is not None:
        verdict.write_junit(junit)
    if left is not None:
        typer.echo(f"{left}")
    raise typer.Exit(verdict.exit_code)


def replay(
    logs: list[Path] = options.argument(
        "LOG...", "Logs (MCAP), run directories, or folders of either."
    ),
    controller: Path | None = options.value(
        "Folder of 'bayesrace build': answer by this controller.",
        metavar="ARTEFACT",
        shown="that of the race, or built for the car",
    ),
    weights: Path | None = options.value(
        "GP weights to answer with.", metavar="FILE", shown="those recorded"
    ),
    host: Literal["python", "c", "fmu"] = options.value(
        "What hosts the controller: python; c or fmu, for lockstep drives.", "python"
    ),
    tolerance: str = options.value(
        "Largest differences, as d=1e-9,delta_rate=1e-7; of one not named 0.",
        "",
        metavar="TOLERANCE",
        shown="0 for the recorded controller, none for another",
    ),
    against: Path | None = options.value(
        "Compare with an earlier --out, or other recordings of these drives.", metavar="FOLDER"
    ),
    car: str = options.value("Car: built-in name or TOML file.", "", shown="the recorded one"),
    track: str = options.value(
        "Built-in name or CSV file.", "", shown="race.csv or track.csv beside the log"
    ),
    raceline: Path | None = options.value(
        "Racing line.", shown="race_raceline.csv or raceline.csv beside the log, or computed"
    ),
    mpc: Path | None = options.value(
        "OCP settings (JSON).", None, "--settings", shown="mpc.json beside the log"
    ),
    junit: Path | None = _JUNIT,
    out: Path | None = options.out_folder("Folder for result, inputs and pictures."),
) -> None:
    """Feed a controller what another was told in recorded drives, and compare the inputs.

    By the recorded controller they are equal to the bit, in real time as well. Exit code 1 if a
    check fails; see docs/replay.md.
    """
    from bayesrace.studies.evidence.inputs import input_bounds
    from bayesrace.studies.evidence.replay.controller import Given as Replaced
    from bayesrace.studies.evidence.replay.run import replay as replay_all

    allowed = input_bounds("--tolerance", tolerance) if tolerance else None
    given = Replaced(controller, weights, host, car, track, raceline, mpc)
    with options.stages_shown() as stages:
        verdict = replay_all(logs, given, stages, allowed, against, out)
    _end(verdict, junit)


def scenario(
    files: list[str] = options.argument(
        "SCENARIO", "TOML files, or names of those that ship.", (), shown="none"
    ),
    every: bool = options.flag("--all", "All that ship."),
    listed: bool = options.flag("--list", "Name those that ship, and drive none."),
    changed: list[str] = options.value(
        "Value to change, as event.0.delay_ms=20; repeatable.",
        (),
        "--set",
        metavar="PLACE=VALUE",
        shown="none",
    ),
    workers: int = options.value(
        "Simulated drives at once.", 0, min=0, max=1024, shown="one a core"
    ),
    out: Path | None = options.out_folder(
        "Folder for recordings and report.", "runs/scenario-DATE-TIME"
    ),
    junit: Path | None = _JUNIT,
) -> None:
    """Drive scenarios, what happens in them included, and check what must hold.

    In simulated time, the same to the bit each time, or in real time, with processes. Leaves a page
    with a row each, scenarios.json and the recordings. Exit code 0 if everything holds, 1 if not.
    """
    from bayesrace.studies.evidence.scenario.description import read_scenario, shipped

    if listed:
        for name in shipped():
            typer.echo(f"{name}: {read_scenario(name).why}")
        return
    names = [*files, *(shipped() if every else ())]
    if not names:
        raise InputError("no scenario: name files, or those that --list names, or --all")
    values = dict(_set(one) for one in changed)
    scenarios = {one.name: one for one in (read_scenario(name, values) for name in names)}
    drive_and_judge(list(scenarios.values()), options.run_folder(out, "scenario-"), junit, workers)


def drive_and_judge(scenarios: Any, folder: Path, junit: Path | None, workers: int) -> None:
    """Drives, prints the verdict, leaves the report, and exits by it."""
    from bayesrace.operation.terminal import printable
    from bayesrace.studies.evidence.scenario.report import write_report
    from bayesrace.studies.evidence.scenario.run import run_scenarios, verdict_of

    def show(result: "Result") -> None:
        typer.echo(printable(f"{result.name}: {verdict_of([result]).text}"))

    with options.stages_shown() as stages:
        results = run_scenarios(scenarios, folder, stages, workers, show)
    _end(verdict_of(results), junit, write_report(results, folder))


def _set(given: str) -> tuple[str, Any]:
    """Place and value of ``--set``; a value that TOML does not know is a text."""
    from bayesrace.files import parse_toml

    place, equals, text = given.partition("=")
    if not equals:
        raise InputError(f"--set {given}: write PLACE=VALUE, as event.0.delay_ms=20")
    try:
        return place, parse_toml(f"value = {text}", "--set", "")["value"]
    except InputError:
        return place, text


def shadow(
    logs: list[Path] = options.argument("LOG...", "Logs (MCAP) of drives with shadows."),
    at_most: str = options.value(
        "Bounds on the differences of the inputs, p99, as d=0.1,delta_rate=1.",
        "",
        metavar="BOUNDS",
        shown="none",
    ),
    weights: Path | None = options.value(
        "The shadow's GP weights: judged by one-step errors with the inputs that acted."
    ),
    against: Path | None = options.value(
        "GP weights of the controller that drove, for --weights.", shown="no correction"
    ),
    car: str = options.value("TOML file of the weights' car if it is not built in.", ""),
    track: str | None = options.value("Track, for places along it: name or CSV file."),
    junit: Path | None = _JUNIT,
    out: Path | None = options.out_folder("Folder for shadow.json and pictures."),
) -> None:
    """Judge shadows ('bayesrace controller --shadow') by the drives that they were beside.

    Where they would have done otherwise, what their plans promised and what came, how long they
    took. Exit code 1 if a check fails; see docs/shadow.md.
    """
    from bayesrace.gp.weights import read_weights
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.evidence.inputs import input_bounds
    from bayesrace.studies.evidence.shadow.judgement import judge_shadows
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car

    if against is not None and weights is None:
        raise InputError("--against is for --weights: give both, or leave it out")
    new, old = (None if one is None else read_weights(one) for one in (weights, against))
    course = None if track is None else load_track(track)
    bounds, parameters = input_bounds("--at-most", at_most), get_car(car) if car else None
    verdict = judge_shadows(logs, bounds, new, old, parameters, course, out, Terminal())
    _end(verdict, junit)


@options_of(
    "bayesrace.studies.evidence.timing.settings.TimingSettings",
    "tracks problems cases count rate_hz budget at_most_ms exceedance horizon sensors weights "
    "artefact points seed car",
    file=True,
)
def timing(
    settings: "Given[TimingSettings]",
    logs: list[Path] = options.argument(
        "LOG", "Run logs (MCAP) whose states are solved again; without, tracks are driven.", ()
    ),
    out: Path | None = options.out_folder("Folder for results.", "runs/timing-DATE-TIME"),
    junit: Path | None = _JUNIT,
) -> None:
    """Show whether the controller answers in time: phases on recorded and on adversarial problems.

    Searches for the hardest starts, compares the work with its bounds by construction, and
    extrapolates. Leaves timing.json, a picture and all times. Exit code 0 if all checks hold, 1 if
    not; see docs/timing.md.
    """
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.evidence.timing.report import print_study, write_study
    from bayesrace.studies.evidence.timing.study import run_timing

    folder = options.run_folder(out, "timing-")
    with options.stages_shown() as stages:
        study = run_timing(settings(), logs, stages)
    write_study(study, folder)
    print_study(study, Terminal())
    _end(study.verdict, junit, folder)
