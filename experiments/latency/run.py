"""Starts plant and controller as processes of their own, drives, and measures."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.tracks import load_track
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session
from bayesrace.vehicles import write_car
from experiments.drive import RunPlan, run_request, wait_for_both
from experiments.latency.settings import LatencySettings
from experiments.latency.stand import (
    Measured,
    Stand,
    check_new,
    explained,
    measure,
    measurement,
    open_folder,
)
from experiments.preparation import Prepared, prepare
from experiments.processes import child
from experiments.progress import Stages
from experiments.settings import PreparationSettings

__all__ = ["measure_latency"]

_START_S: Final = 60.0
"""For processes to start on a machine that is busy."""

_AFTERWARDS_S: Final = 60.0
"""The run's own time limit is this much later than its end by request."""


def measure_latency(settings: LatencySettings, out: Path, stages: Stages) -> Measured:
    """Prepares and starts everything, drives, measures; leaves the report's files in ``out``.

    Raises InputError for unusable settings, LatencyError when a process is lost before anything
    could be measured; no process outlives the call.
    """
    check_new(out)
    track = load_track(settings.track, settings.car.width_m)
    files = prepare(
        PreparationSettings(car=settings.car),
        (settings.track,),
        stages,
        raceline=settings.raceline,
        weights=settings.weights,
        artefact=settings.artefact,
    )
    open_folder(out, settings)
    with ExitStack() as stack:
        with stages.stage("start plant and controller"):
            stand = stack.enter_context(_started(settings, files, out))
            measured = measurement(settings, stand, settings.rate_hz, track, out)
            limit_s = settings.settle_s + settings.duration_s + _AFTERWARDS_S
            plan = RunPlan(1, "bayesrace", 0, limit_s, lockstep=False)
            stand.director.start(run_request(track, plan))
            stack.callback(_stop, stand.director)
        return measure(settings, stand, measured, out, stages)


def _stop(director: Director) -> None:
    with suppress(InputError):  # the plant may be what was lost
        director.stop("measured")


@contextmanager
def _started(settings: LatencySettings, files: Prepared, out: Path) -> Iterator[Stand]:
    """Plant and controller as processes of their own, ready for a run."""
    plant_endpoint, controller_endpoint = free_endpoint(), free_endpoint()
    realtime = settings.realtime
    car_file = out / "car.toml"
    write_car(car_file, settings.car)
    both = ["--car", str(car_file), "--name", settings.car_name]
    both += ["--rate", repr(settings.rate_hz), "--parent-pid", str(os.getpid())]
    both += ["--lock-memory"] if realtime.lock_memory else []
    both += ["--fifo", str(realtime.fifo)] if realtime.fifo else []
    plant = ["plant", "--endpoint", plant_endpoint, *both]
    controller = [
        "controller", *files.arguments,
        "--endpoint", plant_endpoint, "--listen", controller_endpoint, *both,
    ]  # fmt: skip
    with (
        child(plant, out / "plant.log") as first,
        child(controller, out / "controller.log") as second,
        open_session(Endpoints(connect=(plant_endpoint, controller_endpoint))) as session,
    ):
        children = [first, second]
        with explained(children):
            director = Director(session, settings.car_name)
            wait_for_both(director, children, _START_S)
            pids = {"plant": first.pid, "controller": second.pid}
            yield Stand(session, director, children, pids)
