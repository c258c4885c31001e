"""``latency``: the time of each leg of a control cycle, in real time."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from operation.cli.configured import connect_to, realtime
from operation.cli.options import (
    Car,
    CarName,
    Endpoint,
    GivenLine,
    SettingsFile,
    settings_of,
    writable,
)
from operation.cli.parts import LockMemory

__all__ = ["latency"]


def latency(
    context: typer.Context,
    rate: Annotated[
        float, typer.Option(metavar="HZ", min=1, max=500, help="Rate of plant and controller [Hz].")
    ] = 50,
    duration: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            min=1,
            max=20_000,
            show_default="20; all of a log",
            help="Time that counts [s].",
        ),
    ] = None,
    load: Annotated[
        int, typer.Option(metavar="N", min=0, max=1024, help="Busy processes to start as load.")
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            show_default="runs/latency-DATE-TIME",
            help="Folder for results.",
        ),
    ] = None,
    json_file: Annotated[
        Path | None,
        typer.Option(
            "--json",
            metavar="FILE",
            callback=writable,
            help="Write the numbers to this file as well.",
        ),
    ] = None,
    track: Annotated[
        str | None,
        typer.Option(
            metavar="TRACK",
            help="Built-in name, random:SEED, random10:SEED or CSV file; with --attach or --log, "
            "that run's.",
        ),
    ] = None,
    fifo: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            max=99,
            help="SCHED_FIFO priority of the loops, the bare loop included.",
        ),
    ] = None,
    lock_memory: LockMemory = False,
    weights: Annotated[
        Path | None, typer.Option(metavar="FILE", show_default="trained", help="GP weights.")
    ] = None,
    artefact: Annotated[
        Path | None,
        typer.Option(metavar="DIR", show_default="built", help="Folder of 'bayesrace build'."),
    ] = None,
    raceline: GivenLine = None,
    attach: Annotated[
        bool, typer.Option("--attach", help="Measure a run started elsewhere, or wait for one.")
    ] = False,
    endpoint: Endpoint = None,
    log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Log of a run (MCAP), in place of a new run."),
    ] = None,
    car: Car = DEFAULT_CAR,
    name: CarName = "",
    settings_file: SettingsFile = None,
) -> None:
    """Measure each leg of a control cycle, from the sampled state to the acting input.

    Starts plant and controller as processes and drives the track in real time. A loop that only
    sleeps runs beside them: its delays are those of the machine, not of the program. Leaves
    latency.json, a picture and HdrHistogram logs; see docs/latency.md.
    """
    if endpoint and not attach:
        raise InputError("--endpoint is of a running system: add --attach, or leave it out")
    if (attach or log) and (weights or artefact or raceline):
        raise InputError("--weights, --artefact and --raceline are for what is started here")
    if log and (attach or load):
        raise InputError("--log is of a run that is over: leave out --attach and --load")
    from bayesrace.transport import try_links

    running = connect_to(endpoint, "director") if attach else None
    if running is not None:  # before imports that take seconds
        try_links(running, "director")

    from bayesrace.vehicles import get_car
    from operation.terminal.progress import stages_on
    from operation.terminal.terminal import Terminal
    from studies.latency.measure import measure
    from studies.latency.report import print_report
    from studies.latency.settings import LatencySettings

    here, parameters = not (attach or log), get_car(car)
    settings = settings_of(LatencySettings, context, settings_file, {
        "car": {"car": parameters}, "name": {"name": name}, "rate": {"rate_hz": rate},
        "load": {"load": load}, "duration": {"duration_s": duration or (1e9 if log else 20.0)},
        "attach": {
            "attach": running,
            "warm_up_s": 0.0 if attach else 3.0,
        },
        "track": {
            "track": track if track is not None else parameters.race_track if here else ""
        },
        "fifo": {"realtime": realtime(fifo=fifo, lock_memory=lock_memory)},
        "lock_memory": {"realtime": realtime(fifo=fifo, lock_memory=lock_memory)},
        "weights": {"weights": weights}, "artefact": {"artefact": artefact},
        "raceline": {"raceline": raceline}, "log": {"log": log},
    })  # fmt: skip
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
