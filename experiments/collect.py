"""Training data: a pure-pursuit drive of the true car, logged as the processes log."""

import time
from pathlib import Path

from bayesrace.log import LogWriter
from bayesrace.messages import ACTUATION, STATE, Actuation, State, car_key, encode
from bayesrace.raceline import RaceLine
from bayesrace.tracks import StartLine, Track
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.models import dynamic
from controller.pure_pursuit import PurePursuit, PurePursuitSettings
from plant.simulator import Simulator

__all__ = ["collect"]


def collect(
    track: Track,
    line: RaceLine,
    car: CarParameters,
    path: Path,
    duration_s: float,
    settings: PurePursuitSettings,
    start_speed_mps: float = 0.1,
) -> int:
    """Drives for ``duration_s`` and writes states and actuations to the log at ``path``.

    One process: driver and car take turns, which is lockstep without a transport. Returns the
    number of samples. The same settings give the same drive to the bit.
    """
    simulator = Simulator(dynamic(car))
    x, y, psi = track.start_pose()
    simulator.reset([x, y, psi, start_speed_mps, 0.0, 0.0, 0.0])
    driver = PurePursuit(car, line.x_m, line.y_m, line.vx_mps, settings)
    start_line, laps = StartLine(track), 0
    state_key, actuation_key = (car_key(topic.key, car.name) for topic in (STATE, ACTUATION))
    samples = round(duration_s / simulator.step_s)
    log = LogWriter(path, {"collect": {"track": track.name, "car": car.name}})
    try:
        for seq in range(samples + 1):
            now_ns = time.monotonic_ns()
            position = (float(simulator.x[0]), float(simulator.x[1]))
            state = State(
                seq,
                now_ns,
                0,
                simulator.time_s,
                tuple(simulator.x.tolist()),
                simulator.u_applied,
                laps,
                True,
            )
            log.write(state_key, encode(state), now_ns, seq)
            if seq == samples:
                break
            if seq == 0:
                driver.reset(state)
            u = driver.step(simulator.x, simulator.x[:2]).u
            command = (float(u[0]), float(u[1]))
            actuation = Actuation(seq, now_ns, 0, seq, command, "", 0)
            log.write(actuation_key, encode(actuation), now_ns, seq)
            simulator.step(command)
            after = (float(simulator.x[0]), float(simulator.x[1]))
            laps += start_line.crossing(position, after).direction
    finally:
        log.close()
    return samples
