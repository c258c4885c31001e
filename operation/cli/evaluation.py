"""``race``, ``drive``, ``report``, ``bench``: commands that run several parts together."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from operation.cli.configured import connect_to
from operation.cli.options import (
    Car,
    CarName,
    Caution,
    ControlProblem,
    Delay,
    DriveTime,
    Endpoint,
    FmuFile,
    FmuMap,
    GivenLine,
    Noise,
    ProblemChoice,
    Seed,
    SettingsFile,
    Simulator,
    Style,
    TrackName,
    Tyres,
    sensor_noise,
    settings_of,
    writable,
)

__all__ = ["bench", "drive", "race", "report"]


class Mode(StrEnum):
    """How time passes in a run."""

    lockstep = "lockstep"
    realtime = "realtime"


TimeMode = Annotated[
    Mode,
    typer.Option(metavar="MODE", help="lockstep: as fast as possible; realtime: by the clock."),
]


@contextmanager
def _uncollected() -> Iterator[None]:
    """No cyclic garbage collection within the block: the messages of a log live until its report is
    written, and looking for garbage among them takes a quarter of the time of both."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def race(
    context: typer.Context,
    car: Car = DEFAULT_CAR,
    tyres: Tyres = None,
    track: TrackName = "",
    train_track: Annotated[
        str,
        typer.Option(
            metavar="TRACK", show_default="the car's", help="Track of the training drive."
        ),
    ] = "",
    raceline: GivenLine = None,
    train_time: DriveTime = None,
    style: Style = "limit",
    laps: Annotated[
        int,
        typer.Option(metavar="N", min=1, max=100, help="Laps per controller, the first from rest."),
    ] = 2,
    problem: ControlProblem = ProblemChoice.tracking,
    progress_drives: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=0,
            max=20,
            show_default="3; 0 on linear tyres and with slipx",
            help="Runs of bayesrace-limit, which maximises progress, with an update between them.",
        ),
    ] = None,
    mode: TimeMode = Mode.lockstep,
    no_constraints: Annotated[
        bool, typer.Option("--no-constraints", help="OCP without track constraints.")
    ] = False,
    caution: Caution = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="DIR", show_default="runs/DATE-TIME", help="Run directory."
        ),
    ] = None,
    seed: Seed = 0,
    fmu: FmuFile = None,
    fmu_map: FmuMap = None,
    simulator: Simulator = "equations",
    delay: Delay = 0.0,
    noise: Noise = None,
    no_limit: Annotated[
        bool, typer.Option("--no-limit", help="Do not compare the laps with the limit.")
    ] = False,
    settings_file: SettingsFile = None,
) -> None:
    """Drive the paper's comparison: WorstCase, BayesRace, BayesRace-updated, BestCase; and
    BayesRace-limit, which maximises progress in place of tracking the line.

    Computes racing lines, drives the training track by pure pursuit, trains the GPs, builds the
    controllers, and drives them as two processes over Zenoh. Leaves a run directory with the log,
    result.json and report.html.
    """

    from bayesrace.transport import check_descriptors
    from bayesrace.vehicles import get_car
    from operation.race import race as drive_all
    from operation.settings import RaceSettings
    from operation.terminal.progress import stages_on
    from operation.terminal.terminal import Terminal

    check_descriptors()  # before the preparation, which takes a while
    driven = get_car(car) if tyres is None else get_car(car).on_tyres(tyres)
    settings = settings_of(RaceSettings, context, settings_file, {
        "car": {"car": driven}, "tyres": {"car": driven}, "track": {"track": track},
        "train_track": {"train_track": train_track}, "laps": {"laps": laps},
        "raceline": {"line": raceline},
        "mode": {"mode": mode.value}, "style": {"pursuit": {"style": style}},
        "train_time": {"collect_s": train_time}, "seed": {"seed": seed}, "fmu": {"fmu": fmu},
        "fmu_map": {"fmu_map": fmu_map}, "simulator": {"simulator": simulator},
        "delay": {"delay_s": 1e-3 * delay}, "noise": {"noise": sensor_noise(noise).model_dump()},
        "no_limit": {"limit": not no_limit}, "problem": {"problem": problem.value},
        "progress_drives": {"progress_drives": progress_drives},
        "no_constraints": {"mpc": {"constraints": not no_constraints}},
        "caution": {"mpc": {} if caution is None else {"caution": caution}},
    })  # fmt: skip
    out = out or Path("runs") / datetime.now(UTC).astimezone().strftime("%Y%m%d-%H%M%S")
    console = Terminal()
    with _uncollected(), stages_on(console) as stages:
        recording = drive_all(settings, out, stages)
        with stages.stage("result and report"):
            # They take a second to import, which the race does while its controllers start.
            from operation.analysis.race import RaceAnalysis
            from operation.report import write_report
            from operation.terminal.race_table import print_table

            analysis = RaceAnalysis(recording)
            report = write_report(out, analysis)
    print_table(analysis.result, console)
    console.print(f"{report}", highlight=False, soft_wrap=True)


def report(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", help="Run directory, or its log; also of a race that was interrupted."
        ),
    ],
) -> None:
    """Compute result.json, the table and report.html again from a run's log."""

    from operation.analysis.race import read_race
    from operation.report import write_report
    from operation.terminal.race_table import print_table
    from operation.terminal.terminal import Terminal

    if run.suffix == ".mcap" and run.is_file():
        run = run.parent
    with _uncollected():
        analysis = read_race(run)
        if not analysis.runs:
            raise InputError(f"{run}: no run in its log; drive again with 'bayesrace race'")
        page = write_report(run, analysis)
    print_table(analysis.result, Terminal())
    typer.echo(str(page))


def drive(
    track: TrackName = "",
    laps: Annotated[
        int, typer.Option(metavar="N", min=1, help="Laps to drive, the first from rest.")
    ] = 2,
    mode: TimeMode = Mode.lockstep,
    endpoint: Endpoint = None,
    max_time: Annotated[
        float, typer.Option(metavar="S", min=1, max=1e6, help="Time limit [s].")
    ] = 60.0,
    log: Annotated[
        Path, typer.Option(metavar="FILE", callback=writable, help="Log to write (MCAP).")
    ] = Path("run.mcap"),
    car: Car = DEFAULT_CAR,
    name: CarName = "",
) -> None:
    """Start a run on a plant and a controller that are already running, and record it.

    Exit code 0 if all laps were driven on the track, by the controller's solutions; 1 if not; 2 if
    the run could not be driven to its end.
    """
    from bayesrace.messages import EVENT, Event
    from bayesrace.recorder import Recorder
    from bayesrace.tracks import load_track
    from bayesrace.transport import Director, Publisher, open_session
    from bayesrace.vehicles import car_text, get_car
    from operation.analysis.verdict import judge_log
    from operation.drive import RunPlan, execute

    parameters = get_car(car)
    course = load_track(track or parameters.race_track, parameters.width_m)
    name = name or parameters.name
    endpoints = connect_to(endpoint, "director")
    endpoints.check_car(name)
    about = {"drive": {"car": car_text(parameters), "track": course.name}}
    with (
        open_session(endpoints, "director") as session,
        Recorder(session, name, log, about) as recorder,
    ):
        director = Director(session, name)
        director.wait_for(("plant", "controller"), 10.0)
        publisher: Publisher[Event] = Publisher(session, EVENT, name, "race")
        number = director.status("plant").run + 1
        plan = RunPlan(number, "manual", laps, max_time, mode is Mode.lockstep)
        end = execute(director, publisher, course, plan, recorder)
    verdict = judge_log(log, number, course, laps)
    typer.echo(f"{end.text}; log: {log}\n{verdict.text}")
    if not verdict.passed:
        raise typer.Exit(1)


def bench(
    json_file: Annotated[
        Path | None,
        typer.Option(
            "--json", metavar="FILE", callback=writable, help="Write the numbers to this file."
        ),
    ] = None,
    track: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TRACK",
            show_default="three with hairpins",
            help="Track to record problems on; repeatable.",
        ),
    ] = None,
    problems: Annotated[
        int,
        typer.Option(metavar="N", min=10, help="Problems for the compiled step."),
    ] = 900,
    peers: Annotated[
        int, typer.Option(metavar="N", min=1, help="Number of them that IPOPT solves, too.")
    ] = 25,
    points: Annotated[
        int, typer.Option(metavar="N", min=20, max=1024, help="Training points per GP.")
    ] = 400,
    seed: Seed = 0,
    car: Car = DEFAULT_CAR,
) -> None:
    """Time the compiled step and the paper's formulation (CasADi, IPOPT) on the same problems."""

    from bayesrace.vehicles import get_car
    from operation.terminal.progress import stages_on
    from operation.terminal.terminal import Terminal
    from studies.bench import BenchSettings, run_bench

    console = Terminal()
    with stages_on(console) as stages:
        chosen = {} if not track else {"tracks": tuple(track)}
        settings = BenchSettings(
            car=get_car(car), problems=problems, peers=peers, points=points, seed=seed, **chosen
        )
        result = run_bench(settings, stages)
    result.print(console)
    if json_file:
        write_whole(json_file, result.model_dump_json(indent=1) + "\n")
