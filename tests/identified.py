"""Drives by pure pursuit, exact, and their logs as instruments would have made them."""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from msgspec import structs
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.pure_pursuit import PurePursuit, PurePursuitSettings
from bayesrace.controller.python_controller import PythonController
from bayesrace.gp.weights import read_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.sources import dataset_from_log
from bayesrace.log import LogWriter
from bayesrace.messages import STATE, Reading, State, car_key, encode
from bayesrace.operation.closed_loop import ClosedLoop, Driven, built_in_car
from bayesrace.operation.collect import collect, room_beside, training_line
from bayesrace.operation.drive import RunPlan, run_request
from bayesrace.operation.preparation import (
    Prepared,
    prepare,
    trained_weights,
    training_settings,
)
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.raceline import racing_line
from bayesrace.vehicles import CarParameters, car_text, get_car

__all__ = ["GYRO_NOISE", "GYRO_OFFSET", "TRIM", "exact", "plain", "prepared_for", "raced", "seen"]

TRIM = 0.02
"""Steering angle at a commanded angle of 0 [rad]."""

GYRO_OFFSET, GYRO_NOISE = 0.05, 0.02
"""Of the yaw rate [rad/s]."""


@functools.cache
def prepared_for(car: str) -> Prepared:
    """With the default training drive."""
    with stages_on(Console(quiet=True)) as stages:
        settings = PreparationSettings(car=get_car(car))
        return prepare(settings, (get_car(car).race_track,), stages)


@functools.cache
def exact(name: str, duration_s: float, seed: int = 1, scale: float | None = None) -> Driven:
    """A training drive of a car whose steering is off by :data:`TRIM`, as it was."""
    car, files = get_car(name), prepared_for(name)
    assert files.training is not None
    track, line = files.training.driven_on.track, files.training.driven_on.line
    settings = PurePursuitSettings(seed=seed, speed_scale=scale)
    followed = training_line(track, line, car, settings.style)
    columns = followed.x_m, followed.y_m, followed.vx_mps
    law = PurePursuit(car, *columns, settings, room_m=room_beside(track, followed))
    loop = ClosedLoop(car, track, line, PythonController(files.artefacts[0], law))
    start = run_request(track, RunPlan(1, "", 0, duration_s, True, 0.1)).x0
    return loop.drive(0, duration_s, x0=[*start[:6], TRIM])


def seen(
    driven: Driven,
    path: Path,
    mm: float,
    degrees: float,
    *,
    stamped: bool = True,
    gyro: bool = False,
    pose: bool = True,
    count: int | None = None,
    seed: int = 0,
) -> Path:
    """The log of a drive of which poses are reported a period late, but in gaps of 100 ms every
    2 s, and 1 % of them nowhere near.

    ``stamped``: with the time at which they were measured. ``gyro``: of whose readings the times
    are a period late. ``count``: of states.
    """
    random = np.random.default_rng(seed)
    deviation = np.array([1e-3 * mm, 1e-3 * mm, np.deg2rad(degrees)])
    late_s = driven.step_s if stamped else 0.0
    with _log(path, driven) as write:
        before = [None, *driven.true_x]
        for state, x in zip(driven.states[:count], before, strict=False):
            readings: list[Reading] = []
            if x is not None and pose and (state.time_s + 1) % 2 > 0.1:
                value = random.normal(x[:3], deviation)
                value += (random.random() < 0.01) * random.normal(0, 0.3, 3)
                readings = [reading("pose", state.time_s - late_s, "x y psi", value, deviation)]
            if x is not None and gyro:
                turn = np.array([random.normal(x[5] + GYRO_OFFSET, GYRO_NOISE)])
                readings.append(reading("gyro", state.time_s, "omega", turn, [0.05]))
            write(structs.replace(state, x=(0.0,) * 7, estimated=True, readings=tuple(readings)))
    return path


def raced(true: CarParameters, car: CarParameters, folder: Path) -> Driven:
    """Three laps of ``true`` by a controller that knows ``car``, and has learned with it."""
    files, settings = prepared_for(true.name), PreparationSettings(car=car)
    assert files.training is not None
    trained_on, artefact = files.training.driven_on.track, build(BuildSettings(car=car))[0]
    line, log = racing_line(trained_on, car, settings.raceline), folder / "training.mcap"
    vehicle = built_in_car(true)
    collect(trained_on, line, car, artefact, log, 12.0, settings.pursuit, vehicle=vehicle)
    samples = dataset_from_log(log, car, PREDICTION.step_s)
    weights = read_weights(trained_weights(samples, PREDICTION, training_settings(settings)))
    track = files.first.track
    line = racing_line(track, car, settings.raceline)
    controller = compiled_controller(artefact, car, track, line, weights)
    return ClosedLoop(car, track, line, controller, vehicle=vehicle).drive(3)


def plain(driven: Driven, path: Path, u: tuple[float, float] | None = (0.0, 0.0)) -> Path:
    """The log with whole, exact states; ``u``: in place of what acted, unless it is zero; None:
    what acted in a period long before."""
    with _log(path, driven) as write:
        for k, state in enumerate(driven.states):
            acted = driven.states[k // 2].u_applied if u is None else u
            write(state if acted == (0.0, 0.0) else structs.replace(state, u_applied=acted))
    return path


def reading(
    instrument: str, time_s: float, of: str, value: Floats, deviation: Sequence[float] | Floats
) -> Reading:
    """One with such values."""
    pairs = zip(value.tolist(), map(float, deviation), strict=True)
    return Reading(
        instrument=instrument, time_s=time_s, values=dict(zip(of.split(), pairs, strict=True))
    )


@contextmanager
def _log(path: Path, driven: Driven) -> Iterator[Callable[[State], None]]:
    log = LogWriter(path, {"collect": {"car": car_text(driven.car)}})
    key = car_key(STATE.key, driven.car.name)

    def write(state: State) -> None:
        log.write(key, encode(state), state.source_time_ns)

    yield write
    log.close()
