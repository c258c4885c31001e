"""``latency``: where a control cycle's time goes, in real time."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.vehicles import DEFAULT_CAR
from experiments.cli.options import Car, CarName, connect_to, writable

__all__ = ["register"]


def latency(
    rate: Annotated[float, typer.Option(min=1, max=500, help="Of plant and controller [Hz].")] = 50,
    duration: Annotated[
        float | None,
        typer.Option(min=1, max=20_000, help="Time that counts [s] [20; of a log all of it]."),
    ] = None,
    load: Annotated[int, typer.Option(min=0, max=1024, help="Busy processes beside.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder [runs/latency-DATE-TIME].")
    ] = None,
    json_file: Annotated[
        Path | None,
        typer.Option("--json", callback=writable, help="Write the numbers to this file as well."),
    ] = None,
    track: Annotated[
        str | None,
        typer.Option(
            help="Track: built-in name, random:SEED or CSV file. "
            "With --attach or --log: the one that was driven."
        ),
    ] = None,
    fifo: Annotated[
        int | None,
        typer.Option(min=1, max=99, help="SCHED_FIFO priority of the loops, the bare one too."),
    ] = None,
    lock_memory: Annotated[bool, typer.Option(help="Keep their memory from being paged.")] = False,
    weights: Annotated[Path | None, typer.Option(help="GP weights [trained].")] = None,
    artefact: Annotated[Path | None, typer.Option(help="Built controller [built].")] = None,
    raceline: Annotated[Path | None, typer.Option(help="Racing line [computed].")] = None,
    attach: Annotated[bool, typer.Option(help="Measure a run that is driven elsewhere.")] = False,
    endpoint: Annotated[
        list[str] | None,
        typer.Option(help="Attach: plant and controller, one each; the defaults of both without."),
    ] = None,
    log: Annotated[
        Path | None, typer.Option(help="Log of a run (MCAP), in place of a new run.")
    ] = None,
    car: Car = DEFAULT_CAR,
    name: CarName = "",
) -> None:
    """Measure where a control cycle's time goes, from sampling the state to acting.

    Starts plant and controller as processes of their own, drives around the track in real time and
    records the run; a loop beside them that only sleeps tells the machine's stalls from the
    program's. Leaves latency.json, a picture and HdrHistogram logs: docs/latency.md.
    """
    if endpoint and not attach:
        raise InputError("--endpoint is of a running system: add --attach, or leave it out")
    if (attach or log) and (weights or artefact or raceline):
        raise InputError("--weights, --artefact and --raceline are for what is started here")
    if log and (attach or load):
        raise InputError("--log is of a run that is over: leave out --attach and --load")

    from bayesrace.realtime import RealtimeSettings
    from bayesrace.tracks import DEFAULT_RACE_TRACK
    from bayesrace.vehicles import get_car
    from experiments.latency.measure import measure
    from experiments.latency.report import print_report
    from experiments.latency.settings import LatencySettings
    from experiments.progress import stages_on
    from experiments.terminal import Terminal

    here = not (attach or log)
    settings = LatencySettings(
        car=get_car(car), name=name, rate_hz=rate, load=load,
        duration_s=duration or (1e9 if log else 20.0), warm_up_s=0.0 if attach else 3.0,
        track=track if track is not None else DEFAULT_RACE_TRACK if here else "",
        realtime=RealtimeSettings(fifo=fifo, lock_memory=lock_memory),
        weights=weights, artefact=artefact, raceline=raceline, log=log,
        attach=connect_to(endpoint).connect if attach else (),
    )  # fmt: skip
    time = datetime.now(UTC).astimezone().strftime("%Y%m%d-%H%M%S")
    out = out or Path("runs") / f"latency-{time}"
    console = Terminal()
    with stages_on(console) as stages:
        result, run = measure(settings, out, stages)
    print_report(result, console)
    if json_file:
        write_whole(json_file, result.model_dump_json(indent=1) + "\n")
    console.print(f"{out}", highlight=False, soft_wrap=True)
    if run.error is not None:
        raise run.error


def register(app: typer.Typer) -> None:
    """Adds this module's subcommands."""
    app.command()(latency)
