"""``plant`` and ``controller``: the two processes, to be run side by side or on two machines."""

from pathlib import Path
from typing import Annotated

import typer

from bayesrace.clock import die_with_parent
from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from operation.cli.configured import current, realtime
from operation.cli.options import (
    Car,
    CarName,
    Delay,
    FmuFile,
    FmuMap,
    LowLatency,
    Noise,
    ParentPid,
    RaceLineFile,
    Simulator,
    TrackName,
    sensor_noise,
)

__all__ = ["controller", "plant"]

_PLANT = "as configured; tcp/127.0.0.1:7447"
_CONTROLLER = "as configured; tcp/127.0.0.1:7448"

Rate = Annotated[float, typer.Option(metavar="HZ", min=1, max=500, help="Rate in real time [Hz].")]
Cpu = Annotated[
    int | None, typer.Option(metavar="N", min=0, help="CPU to bind the control thread to.")
]
Fifo = Annotated[
    int | None,
    typer.Option(metavar="N", min=1, max=99, help="SCHED_FIFO priority of the control thread."),
]
LockMemory = Annotated[
    bool, typer.Option("--lock-memory", help="Lock the memory of the process against paging.")
]


def plant(
    car: Car = DEFAULT_CAR,
    name: CarName = "",
    endpoint: Annotated[
        str | None,
        typer.Option(metavar="ENDPOINT", show_default=_PLANT, help="Zenoh endpoint to listen on."),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ENDPOINT",
            show_default="as configured",
            help="Endpoint to connect to, as of a router; repeatable.",
        ),
    ] = None,
    rate: Rate = 50.0,
    fmu: FmuFile = None,
    fmu_map: FmuMap = None,
    simulator: Simulator = "equations",
    delay: Delay = 0.0,
    noise: Noise = None,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of the noise.")] = 0,
    cpu: Cpu = None,
    fifo: Fifo = None,
    lock_memory: LockMemory = False,
    low_latency: LowLatency = False,
    parent_pid: ParentPid = None,
) -> None:
    """Simulate the car: waits for runs, as of 'bayesrace drive', until Ctrl-C."""
    die_with_parent(parent_pid)
    from bayesrace.vehicles import get_car
    from codegen.compiler import compiled
    from plant.process import PlantSettings, main

    settings = PlantSettings(
        car=get_car(car),
        name=name,
        endpoints=current().endpoints(
            "plant",
            listen=None if endpoint is None else (endpoint,),
            connect=connect or None,
            low_latency=low_latency,
        ),
        rate_hz=rate,
        delay_s=delay * 1e-3,
        noise=sensor_noise(noise),
        seed=seed,
        fmu=fmu,
        fmu_map=fmu_map,
        simulator=simulator,
        realtime=realtime(cpu, fifo, lock_memory),
        parent_pid=parent_pid,
    )
    raise typer.Exit(main(settings, compiled))


def controller(
    artefact: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder that 'bayesrace build' printed.")
    ],
    track: TrackName,
    raceline: RaceLineFile,
    weights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GP weights; without them, the uncorrected model."),
    ] = None,
    settings: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="OCP settings (JSON), see 'controller/settings.py'."),
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder that keeps accepted weights for the next start."),
    ] = None,
    car: Car = DEFAULT_CAR,
    name: CarName = "",
    endpoint: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", show_default=_PLANT, help="Zenoh endpoint of the plant."),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            show_default=_CONTROLLER,
            help="Zenoh endpoint to listen on, for recorders and senders of weights.",
        ),
    ] = None,
    rate: Rate = 50.0,
    budget: Annotated[
        float,
        typer.Option(
            metavar="SHARE", min=0.05, max=1, help="Share of the period that a cycle may take."
        ),
    ] = 0.8,
    delay: Annotated[
        str,
        typer.Option(
            metavar="DELAY",
            help="Delay over which the state is predicted: measured, off, or milliseconds.",
        ),
    ] = "measured",
    gate: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Thresholds for new weights (JSON), see docs/learning.md.",
        ),
    ] = None,
    hold: Annotated[
        bool, typer.Option("--hold", help="Do not drive before 'bayesrace go'.")
    ] = False,
    sensor_tolerance: Annotated[
        float,
        typer.Option(
            metavar="X",
            min=0,
            max=1000,
            help="Contradictions in measured states beyond which they are not believed, as a "
            "multiple of those by noise of motion capture; 0: every state is.",
        ),
    ] = 1.0,
    cpu: Cpu = None,
    fifo: Fifo = None,
    lock_memory: LockMemory = False,
    low_latency: LowLatency = False,
    parent_pid: ParentPid = None,
) -> None:
    """Drive the car of a plant process with the compiled controller, until Ctrl-C."""
    die_with_parent(parent_pid)
    from bayesrace.vehicles import get_car
    from controller.assembly import predictive_controller, read_settings
    from controller.process import ControllerSettings, main
    from controller.weights.settings import GateSettings

    parameters = get_car(car)
    process = ControllerSettings(
        car=parameters,
        name=name,
        endpoints=current().endpoints(
            "controller",
            listen=None if listen is None else (listen,),
            connect=endpoint or None,
            low_latency=low_latency,
        ),
        rate_hz=rate,
        budget=budget,
        compensation=_compensation(delay),
        hold=hold,
        sensor_tolerance=sensor_tolerance,
        gate=read_settings(gate, GateSettings),
        realtime=realtime(cpu, fifo, lock_memory),
        parent_pid=parent_pid,
    )
    driver = predictive_controller(
        artefact, parameters, track, raceline, settings, weights, store, process.gate
    )
    raise typer.Exit(main(process, driver))


def _compensation(delay: str) -> dict[str, str | float]:
    """The option's words as :class:`controller.cycle_settings.CompensationSettings`."""
    if delay in ("measured", "off"):
        return {"mode": delay}
    try:
        return {"mode": "fixed", "delay_s": float(delay) * 1e-3}
    except ValueError:
        raise InputError(
            f"--delay {delay}: give 'measured', 'off', or a number of milliseconds"
        ) from None
