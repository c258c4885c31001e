"""Drives by pure pursuit, exact, and their logs as instruments would have made them."""

import functools
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec import structs
from rich.console import Console

from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.pure_pursuit import PurePursuit, PurePursuitSettings
from bayesrace.controller.python_controller import PythonController
from bayesrace.gp.weights import read_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.sources import dataset_from_log
from bayesrace.log import LogWriter
from bayesrace.messages import STATE, State, car_key, encode
from bayesrace.operation.closed_loop import ClosedLoop, Driven, built_in_car
from bayesrace.operation.collect import collect, room_beside, training_line
from bayesrace.operation.preparation import (
    Prepared,
    prepare,
    trained_weights,
    training_settings,
)
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.plant.sensors import SensorPlayer
from bayesrace.raceline import racing_line
from bayesrace.sensors import BUILT_IN, Sensors
from bayesrace.vehicles import Car, car_text, get_car

__all__ = ["NOISES", "TRIM", "coasted", "exact", "plain", "poses", "prepared_for", "raced", "seen"]

TRIM = 0.02
"""Steering angle at a commanded angle of 0 [rad]."""


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


def poses(mm: float, degrees: float, rate_hz: float) -> Sensors:
    """Poses that are 20 ms late, but in gaps of 100 ms every 2 s, and 1 % of them far off."""
    position = {"deviation": 1e-3 * mm, "outlier": 0.3}
    heading = {"deviation": float(np.deg2rad(degrees)), "outlier": 0.3}
    pose = {
        "rate_hz": rate_hz, "delay_s": 0.02, "jitter_s": 0.005, "gap_s": 0.1, "gap_every_s": 2.0,
        "outliers": 0.01, "x_m": position, "y_m": position, "heading_rad": heading,
    }  # fmt: skip
    return Sensors.model_validate({"pose": pose})


def seen(
    driven: Driven,
    path: Path,
    sensors: Sensors,
    late_s: Mapping[str, float] | None = None,
    count: int | None = None,
    seed: int = 0,
) -> Path:
    """The log of a drive, or of so many states of it, as instruments would have made it.

    ``late_s``: by how much later than true each instrument says that it has measured; ``seed``: of
    their errors.
    """
    player, late_s = SensorPlayer(sensors, seed), late_s or {}
    with _log(path, driven) as write:
        for state, x in list(zip(driven.states, driven.true_x, strict=False))[:count]:
            readings = tuple(
                structs.replace(one, time_s=one.time_s + late_s.get(one.instrument, 0.0))
                for one in player.report(state.time_s, x)
            )
            write(structs.replace(state, x=(0.0,) * 7, estimated=True, readings=readings))
    return path


NOISES = {
    "0.5 mm, 50 Hz": poses(0.5, 0.2, 50),
    "0.5 mm, 100 Hz": poses(0.5, 0.2, 100),
    "1 mm, 50 Hz": poses(1.0, 0.5, 50),
    "1 mm, 100 Hz": poses(1.0, 0.5, 100),
    "odometry": Sensors(BUILT_IN["odometry"].root | poses(0.5, 0.2, 25).root),
}
"""Instruments by a short name: poses of 0.5 mm and 0.2 degrees, or of 1 mm and 0.5 degrees; and few
of them beside wheel speed and gyro."""


def coasted(duration_s: float, slowest_mps: float) -> Driven:
    """An orca in a wide bend that alternates full throttle, up to nearly its top speed, and
    coasting, down to the slowest."""
    driven = exact("orca", 12.0)
    car, random = built_in_car(driven.car), np.random.default_rng(0)
    car.reset([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, TRIM])
    states, true_x, throttle, aim = [driven.states[0]], [tuple(car.x.tolist())], 1.0, TRIM
    for seq in range(1, round(duration_s / driven.step_s) + 1):
        throttle = 0.0 if car.x[3] > 3.9 else 1.0 if car.x[3] < slowest_mps else throttle
        aim = 0.8 * aim + random.normal(0.005, 0.01)
        car.step((throttle, float(np.clip((aim - car.x[6]) / driven.step_s, -5, 5))))
        made = {"seq": states[0].seq + seq, "time_s": car.time_s, "u_applied": car.u_applied}
        states.append(structs.replace(driven.states[1], **made))
        true_x.append(tuple(car.x.tolist()))
    return replace(driven, states=states, true_x=true_x)


def raced(true: Car, car: Car, folder: Path) -> Driven:
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


@contextmanager
def _log(path: Path, driven: Driven) -> Iterator[Callable[[State], None]]:
    log = LogWriter(path, {"collect": {"car": car_text(driven.car)}})
    key = car_key(STATE.key, driven.car.name)

    def write(state: State) -> None:
        log.write(key, encode(state), state.source_time_ns)

    yield write
    log.close()
