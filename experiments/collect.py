"""Training data: a pure-pursuit drive of the true car, logged as the processes log."""

import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesrace.log import LogWriter
from bayesrace.messages import ACTUATION, STATE, Actuation, State, car_key, encode
from bayesrace.raceline import RaceLine
from bayesrace.tracks import StartLine, Track
from bayesrace.vehicles import CarParameters, car_text
from bayesrace.vehicles.models import dynamic
from controller.pure_pursuit import PurePursuit, PurePursuitSettings
from plant.simulator import Simulator
from plant.vehicle import Vehicle

__all__ = ["collect", "drive_samples"]

Floats = NDArray[np.float64]


def drive_samples(
    track: Track,
    line: RaceLine,
    car: CarParameters,
    duration_s: float,
    settings: PurePursuitSettings,
    start_speed_mps: float = 0.1,
    vehicle: Vehicle | None = None,
) -> tuple[Floats, Floats]:
    """Drives for ``duration_s``: states (n + 1, 7), inputs that acted (n, 2).

    Driver and car take turns in one process, which is lockstep without a transport. The same
    settings give the same drive to the bit. ``vehicle``: what plays the car; the built-in
    equations without.
    """
    simulator = vehicle or Simulator(dynamic(car))
    x, y, psi = track.start_pose()
    simulator.reset([x, y, psi, start_speed_mps, 0.0, 0.0, 0.0])
    driver = PurePursuit(car, line.x_m, line.y_m, line.vx_mps, settings)
    driver.reset(_state(0, simulator.x, (0.0, 0.0), simulator.step_s, 0))
    states, inputs = [simulator.x.copy()], []
    for _ in range(round(duration_s / simulator.step_s)):
        u = driver.step(simulator.x, np.array(simulator.u_applied)).u
        simulator.step((float(u[0]), float(u[1])))
        states.append(simulator.x.copy())
        inputs.append(simulator.u_applied)
    return np.array(states), np.array(inputs)


def _state(seq: int, x: Floats, u_applied: tuple[float, float], step_s: float, lap: int) -> State:
    now_ns = time.monotonic_ns()
    return State(
        seq, now_ns, 0, 0, seq * step_s, tuple(x.tolist()), u_applied, lap, True, (), False
    )


def collect(
    track: Track,
    line: RaceLine,
    car: CarParameters,
    path: Path,
    duration_s: float,
    settings: PurePursuitSettings,
    start_speed_mps: float = 0.1,
    vehicle: Vehicle | None = None,
) -> int:
    """Drives and writes states and actuations to the log at ``path``; the number of samples.

    Pure pursuit saturates its commands as the car does: what it asked for is what acted.
    """
    states, inputs = drive_samples(track, line, car, duration_s, settings, start_speed_mps, vehicle)
    start_line, lap = StartLine(track), 0
    state_key, actuation_key = (car_key(topic.key, car.name) for topic in (STATE, ACTUATION))
    log = LogWriter(path, {"collect": {"track": track.name, "car": car_text(car)}})
    applied = (0.0, 0.0)
    try:
        for seq, x in enumerate(states):
            if seq:
                before, after = (tuple(states[k, :2].tolist()) for k in (seq - 1, seq))
                lap += start_line.crossing(before, after).direction
            state = _state(seq, x, applied, settings.step_s, lap)
            log.write(state_key, encode(state), state.source_time_ns, seq)
            if seq == len(inputs):
                break
            applied = (float(inputs[seq, 0]), float(inputs[seq, 1]))
            actuation = Actuation(
                seq, state.source_time_ns, 0, 0, seq, state.time_s, applied, "", 0
            )
            log.write(actuation_key, encode(actuation), state.source_time_ns, seq)
    finally:
        log.close()
    return len(inputs)
