"""``race``, ``report``, ``drive``, ``bench``, ``latency``, ``paper``, ``campaign``,
``campaign-report``, ``campaign-scheduler``, ``campaign-worker``, ``tune``: whole runs, and what is
measured with them."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer

from bayesrace.errors import InputError
from bayesrace.operation.cli import options
from bayesrace.operation.cli.declaration import Given, options_of

if TYPE_CHECKING:
    from bayesrace.configuration import Configuration
    from bayesrace.operation.analysis.race import RaceAnalysis
    from bayesrace.operation.settings import RaceSettings
    from bayesrace.studies.campaign.cluster import Remote
    from bayesrace.studies.latency.settings import LatencySettings
    from bayesrace.studies.settings import BenchSettings, PaperSettings, TuneSettings
    from bayesrace.transport import Endpoints

__all__ = [
    "bench",
    "campaign",
    "campaign_report",
    "campaign_scheduler",
    "campaign_worker",
    "drive",
    "latency",
    "paper",
    "race",
    "report",
    "tune",
]

_SCHEDULER: Final = options.value(
    "Scheduler of several machines, as tls://HOST:8786.", metavar="ADDRESS", shown="embedded"
)
_KEY: Final = options.value("The scheduler's key, with --scheduler.", metavar="FILE")
_WORKERS: Final = options.value(
    "Processes on this machine.", 0, min=0, max=1024, shown="one a core"
)


@options_of(
    "bayesrace.operation.settings.RaceSettings",
    "car track train_track line collect_s practice_laps practice_until pursuit.style laps "
    "every problem progress_drives mode mpc.constraints mpc.caution seed fmu fmu_map simulator "
    "delay_s sensors world limit",
    file=True,
)
def race(
    settings: "Given[RaceSettings]",
    tyres: options.Tyres = options.TYRES,
    out: Path | None = options.out_folder("Run directory.", "runs/DATE-TIME"),
) -> None:
    """Drive the paper's comparison: WorstCase, BayesRace, BayesRace-updated, BestCase; and
    BayesRace-limit, which maximises progress in place of tracking the line.

    Computes racing lines, drives the training track by pure pursuit, trains the GPs, builds the
    controllers, and drives them as two processes over Zenoh. Leaves a run directory with the log,
    result.json and report.html.
    """
    from bayesrace.operation.race import race as drive_all
    from bayesrace.realtime import uncollected
    from bayesrace.transport import check_descriptors

    check_descriptors()  # before the preparation, which takes a while
    chosen = settings()
    if tyres is not None:
        chosen = settings(car=chosen.car.on_tyres(tyres))
    folder = options.run_folder(out)
    with uncollected(), options.stages_shown() as stages:
        recording = drive_all(chosen, folder, stages)
        with stages.stage("result and report"):
            # They take a second to import, in which nothing would be seen of a race.
            from bayesrace.operation.analysis.race import RaceAnalysis
            from bayesrace.operation.report import write_report

            analysis = RaceAnalysis(recording)
            page = write_report(folder, analysis)
    _print_result(analysis, page)


def report(
    run: Path = options.argument(
        "DIR", "Run directory, or its log; also of a race that was interrupted."
    ),
) -> None:
    """Compute result.json, the table and report.html again from a run's log."""
    from bayesrace.operation.analysis.race import read_race
    from bayesrace.operation.report import write_report
    from bayesrace.realtime import uncollected

    if run.suffix == ".mcap" and run.is_file():
        run = run.parent
    with uncollected():
        analysis = read_race(run)
        if not analysis.runs:
            raise InputError(f"{run}: no run in its log; drive again with 'bayesrace race'")
        page = write_report(run, analysis)
    _print_result(analysis, page)


def _print_result(analysis: "RaceAnalysis", page: Path) -> None:
    from bayesrace.operation.terminal.tables import print_table
    from bayesrace.operation.terminal.terminal import Terminal

    print_table(analysis.result, Terminal())
    typer.echo(f"{page}")


@options_of("bayesrace.operation.settings.RaceSettings", "track mode car")
def drive(
    director: "Endpoints",
    configuration: "Configuration",
    settings: "Given[RaceSettings]",
    laps: int = options.value("Laps to drive, the first from rest.", 2, min=1),
    max_time: float = options.value("Time limit [s].", 60.0, min=1, max=1e6, metavar="S"),
    log: Path = options.new_file("Log to write (MCAP).", default=Path("run.mcap")),
    max_log: str | None = options.value(
        "Size of the log at most, as 500MB or 2GB: it goes on in new files, run.1.mcap and so on, "
        "and the oldest are deleted.",
        metavar="SIZE",
        shown="no limit",
    ),
    name: str = options.CAR_NAME,
    hold_to_run: bool = options.flag(
        "--hold-to-run",
        "Dead man's switch, in real time: the car stops when this command is not heard for 0.5 s.",
    ),
) -> None:
    """Start a run on a plant and a controller that are already running, and record it.

    Exit code 0 if all laps were driven on the track, by the controller's solutions; 1 if not; 2 if
    the run could not be driven to its end.
    """
    from bayesrace.log_parts import log_size
    from bayesrace.operation.drive import drive_and_judge
    from bayesrace.operation.run_plan import RunPlan
    from bayesrace.tracks import load_track

    chosen = settings()
    course = load_track(chosen.track, chosen.car.width_m)
    held = hold_to_run or configuration.drive.hold_to_run
    plan = RunPlan(0, "manual", laps, max_time, chosen.mode == "lockstep", held=held)
    limit = configuration.drive.max_log if max_log is None else log_size(max_log)
    name = name or chosen.car.name
    end, verdict = drive_and_judge(director, chosen.car, name, course, plan, log, limit)
    typer.echo(f"{end.text}; log: {log}\n{verdict.text}")
    if not verdict.passed:
        raise typer.Exit(1)


@options_of("bayesrace.studies.settings.BenchSettings", "tracks problems peers points seed car")
def bench(
    settings: "Given[BenchSettings]",
    json_file: Path | None = options.new_file("Write the numbers to this file.", "--json"),
) -> None:
    """Time the compiled step and the paper's formulation (CasADi, IPOPT) on the same problems."""
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.bench import run_bench

    with options.stages_shown() as stages:
        result = run_bench(settings(), stages)
    result.print(Terminal())
    options.write_json(json_file, result)


@options_of(
    "bayesrace.studies.latency.settings.LatencySettings",
    "rate_hz duration_s load track realtime.fifo realtime.lock_memory weights artefact raceline "
    "log car name",
    file=True,
)
def latency(
    network: "Configuration",
    settings: "Given[LatencySettings]",
    out: Path | None = options.out_folder("Folder for results.", "runs/latency-DATE-TIME"),
    json_file: Path | None = options.new_file("Write the numbers to this file as well.", "--json"),
    attach: bool = options.flag("--attach", "Measure a run started elsewhere, or wait for one."),
    endpoint: list[str] = options.ENDPOINT,
) -> None:
    """Measure each leg of a control cycle, from the sampled state to the acting input.

    Starts plant and controller as processes and drives the track in real time. A loop that only
    sleeps runs beside them: its delays are those of the machine, not of the program. Leaves
    latency.json, a picture and all values; see docs/latency.md.
    """
    chosen = settings()
    if endpoint and not attach:
        raise InputError("--endpoint is of a running system: add --attach, or leave it out")
    if (attach or chosen.log) and (chosen.weights or chosen.artefact or chosen.raceline):
        raise InputError("--weights, --artefact and --raceline are for what is started here")
    if chosen.log and (attach or chosen.load):
        raise InputError("--log is of a run that is over: leave out --attach and --load")
    if attach:
        from bayesrace.transport import check_session

        running = network.endpoints("director", connect=endpoint)
        check_session(running, "director")  # before imports that take seconds
        chosen = settings(attach=running, warm_up_s=0.0)

    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.latency.measure import measure
    from bayesrace.studies.latency.report import print_report

    folder = options.run_folder(out, "latency-")
    with options.stages_shown() as stages:
        result, run = measure(chosen, folder, stages)
    print_report(result, Terminal())
    options.write_json(json_file, result)
    typer.echo(f"{folder}")
    if run.error is not None:
        raise run.error


@options_of("bayesrace.studies.settings.PaperSettings", "tracks data raceline quick seed")
def paper(
    settings: "Given[PaperSettings]",
    out: Path = options.out_folder("Folder for page and figures.", default=Path("runs/paper")),
) -> None:
    """Make every figure and number of the paper from scratch, and compare them with it.

    Leaves paper.html, the figures as SVG and PDF, and numbers.json. What is computed is kept: the
    same command goes on after an interruption.
    """
    from bayesrace.operation.terminal import printable
    from bayesrace.studies.paper.make import make_paper

    with options.stages_shown() as stages:
        page, sections = make_paper(settings(), out, stages)
    for finding in (one for section in sections for one in section.findings):
        typer.echo(printable(f"{finding.verdict}: {finding.what}: {finding.ours}"))
    typer.echo(f"{page}")


def campaign(
    plan: Path = options.argument("PLAN", "TOML file that says what varies: docs/campaigns.md."),
    out: Path | None = options.out_folder("Folder of results.", "runs/NAME-OF-PLAN"),
    scheduler: str | None = _SCHEDULER,
    key: Path | None = _KEY,
    workers: int = _WORKERS,
    again: bool = options.flag("--again", "Compute cases that failed once more."),
    scenario: str | None = options.value(
        "Scenario that the plan's [grid] varies, as event.0.delay_ms: docs/scenarios.md.",
        metavar="FILE",
    ),
) -> None:
    """Drive all cases of a plan, on this machine or on many; one row a lap in Parquet.

    What is there already is not computed again: the same command goes on after an interruption.
    Leaves laps.parquet and report.html.
    """
    folder = out or Path("runs") / plan.stem
    if scenario is not None:
        from bayesrace.operation.cli.evidence import drive_and_judge
        from bayesrace.studies.evidence.scenario.run import read_grid

        if scheduler is not None or again:
            raise InputError("--scenario is driven anew, here: leave out --scheduler and --again")
        drive_and_judge(read_grid(plan, scenario), folder, None, workers)
        return
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.campaign.campaign import run_campaign
    from bayesrace.studies.campaign.plan import read_plan
    from bayesrace.studies.campaign.report import render_campaign

    remote = _remote(scheduler, key)
    read = read_plan(plan)
    console = Terminal()
    outcome = run_campaign(read, folder, console, remote, workers, again)
    console.print(f"{len(read.cases)} cases; computed now: {outcome}", highlight=False)
    console.print(f"{render_campaign(folder)}", highlight=False, soft_wrap=True)


def campaign_report(
    folder: Path = options.argument("DIR", "Folder of a campaign's results."),
) -> None:
    """Make the report of a campaign again from its Parquet files."""
    from bayesrace.studies.campaign.report import render_campaign

    typer.echo(str(render_campaign(folder)))


def campaign_scheduler(
    key: Path = options.value(
        "The key; made if it is not there.", ..., metavar="FILE", callback=options.writable
    ),
    listen: str = options.value("Address to listen at.", "tls://0.0.0.0:8786", metavar="ADDRESS"),
) -> None:
    """Hand out the cases of campaigns to workers on several machines, until interrupted.

    Whoever has the key can run code here and on the workers. Copy it to where they and the campaign
    run, readable by its user alone.
    """
    from bayesrace.studies.campaign.cluster import run_scheduler

    run_scheduler(listen, key)


def campaign_worker(
    scheduler: str = options.argument("ADDRESS", "As tls://HOST:8786."),
    key: Path = options.value("The scheduler's key.", ..., metavar="FILE"),
    workers: int = _WORKERS,
) -> None:
    """Compute for campaigns elsewhere until their scheduler ends."""
    from bayesrace.studies.campaign.cluster import Remote, run_worker

    run_worker(Remote.checked(scheduler, key), workers)


def _remote(scheduler: str | None, key: Path | None) -> "Remote | None":
    """The scheduler that is not embedded; InputError if it is not secured."""
    if scheduler is None:
        if key is not None:
            raise InputError("--key is of a scheduler: add --scheduler, or leave it out")
        return None
    from bayesrace.studies.campaign.cluster import Remote

    return Remote.checked(scheduler, key)


@options_of("bayesrace.studies.settings.TuneSettings", "track held_out trials batch car seed")
def tune(
    settings: "Given[TuneSettings]",
    out: Path = options.out_file(Path("tuned.toml")),
    study: Path | None = options.value(
        "SQLite of trials.", metavar="FILE", shown="beside --out", callback=options.writable
    ),
    scheduler: str | None = _SCHEDULER,
    key: Path | None = _KEY,
    workers: int = _WORKERS,
) -> None:
    """Search weights of the OCP, margin, line friction and horizon that lap faster.

    Held-out tracks judge what is found. Leaves a car's file with it, which every command takes as
    --car; the same command goes on with the study after an interruption.
    """
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.campaign.tune import print_verdict
    from bayesrace.studies.campaign.tune import tune as search

    remote = _remote(scheduler, key)
    with options.stages_shown() as stages:
        storage = study or out.with_suffix(".sqlite")
        verdict = search(settings(), out, storage, stages, remote, workers)
    print_verdict(verdict, Terminal())
    typer.echo(f"{out}")
